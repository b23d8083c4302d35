"""Continuous collision detection for deforming triangle meshes: no missed collision, no dropped pair."""

import importlib
from pathlib import Path

if not (Path(__file__).parent / "kernels").is_dir():
    # in a checkout the device code stands beside this package, not in it
    __path__.append(str(Path(__file__).parents[1]))

__version__ = "0.1.0"

_MODULES = {
    "CollisionArrays": "collision_arrays",
    "CollisionDetector": "detector",
    "CollisionMesh": "mesh",
    "Collisions": "detector",
    "DetectionStats": "detector",
    "QueryResult": "query",
    "SolverCCD": "solver",
    "SolverReport": "solver",
    "query_edge_edge": "query",
    "query_vertex_face": "query",
}

__all__ = [
    "CollisionArrays",
    "CollisionDetector",
    "CollisionMesh",
    "Collisions",
    "DetectionStats",
    "QueryResult",
    "SolverCCD",
    "SolverReport",
    "checker",
    "query_edge_edge",
    "query_vertex_face",
]


def __getattr__(name):
    """Imports a name when it is first used, so that the exact checker needs no Warp."""
    if name == "checker":
        return importlib.import_module(".checker", __name__)
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f".{_MODULES[name]}", __name__), name)
