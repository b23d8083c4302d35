"""Continuous collision detection for deforming triangle meshes: no missed collision, no dropped pair."""

import contextlib
import importlib
import importlib.util
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from ._garbage import paused_collection
from ._version import __version__ as __version__

_KERNELS = Path(__file__).parents[1] / "kernels" / "__init__.py"
"""The device code, which in a checkout stands beside this package, not in it."""


class _KernelsFinder:
    """Finds the device code in a checkout, and nothing else of what stands beside this package."""

    @staticmethod
    def find_spec(name, path=None, target=None):
        if name == f"{__name__}.kernels":
            return importlib.util.spec_from_file_location(name, _KERNELS)
        return None


if not (Path(__file__).parent / "kernels").is_dir():
    sys.meta_path.insert(0, _KernelsFinder)  # before those of another checkout that may be installed

if TYPE_CHECKING:  # type checkers and editors do not look into __getattr__
    from . import checker
    from .detection.arcs.rigid_motion import RigidMotion
    from .detection.at_rest.chamfer_distance import chamfer_distance
    from .detection.at_rest.proximities import distances
    from .detection.detector import CollisionDetector
    from .detection.mesh import CollisionMesh, leave_out
    from .detection.queries.query import (
        QueryResult,
        query_edge_edge,
        query_vertex_edge,
        query_vertex_face,
        query_vertex_vertex,
    )
    from .detection.queries.query_arrays import DeviceQueryResult
    from .detection.queries.query_points import query_points
    from .detection.results.collisions import CapturedCollisions, Collisions, DetectionStats
    from .detection.results.differentiable import DifferentiableContacts
    from .implicit.solver_implicit import SolverImplicit, checkpointed
    from .mesh_files.check import MeshCheck, check
    from .repairing.repair import repair
    from .repairing.results import RepairResult, UnresolvedContour
    from .repairing.state import StateRepairResult, repair_state
    from .response.captured_steps import CapturedSteps
    from .response.contact_sensor import ContactSensor
    from .response.monitor import CollisionMonitor
    from .response.report.report import SolverReport
    from .response.solver_ccd import SolverCCD
    from .response.state.collision_filter import CollisionFilter
    from .response.state.friction_table import FrictionTable
    from .scene_replay.intervals import replay
    from .scene_replay.results import IntervalResult, IntervalSummary
    from .scene_replay.scene_contacts import SceneContacts
    from .scene_replay.scene_intersections import SceneIntersections
    from .scene_replay.scene_proximities import SceneProximities
    from .usd.frames import FrameRange
    from .usd.read.triage import read_triage
    from .usd.scene import Scene
    from .usd.selection import Selection

_MODULES = {
    "CapturedCollisions": "detection.results.collisions",
    "CapturedSteps": "response.captured_steps",
    "DifferentiableContacts": "detection.results.differentiable",
    "CollisionDetector": "detection.detector",
    "CollisionFilter": "response.state.collision_filter",
    "CollisionMesh": "detection.mesh",
    "CollisionMonitor": "response.monitor",
    "Collisions": "detection.results.collisions",
    "ContactSensor": "response.contact_sensor",
    "DetectionStats": "detection.results.collisions",
    "FrameRange": "usd.frames",
    "FrictionTable": "response.state.friction_table",
    "IntervalResult": "scene_replay.results",
    "IntervalSummary": "scene_replay.results",
    "MeshCheck": "mesh_files.check",
    "DeviceQueryResult": "detection.queries.query_arrays",
    "QueryResult": "detection.queries.query",
    "RepairResult": "repairing.results",
    "RigidMotion": "detection.arcs.rigid_motion",
    "Scene": "usd.scene",
    "SceneContacts": "scene_replay.scene_contacts",
    "SceneIntersections": "scene_replay.scene_intersections",
    "SceneProximities": "scene_replay.scene_proximities",
    "Selection": "usd.selection",
    "SolverCCD": "response.solver_ccd",
    "SolverImplicit": "implicit.solver_implicit",
    "SolverReport": "response.report.report",
    "StateRepairResult": "repairing.state",
    "UnresolvedContour": "repairing.results",
    "chamfer_distance": "detection.at_rest.chamfer_distance",
    "check": "mesh_files.check",
    "checkpointed": "implicit.solver_implicit",
    "distances": "detection.at_rest.proximities",
    "leave_out": "detection.mesh",
    "query_edge_edge": "detection.queries.query",
    "query_points": "detection.queries.query_points",
    "query_vertex_edge": "detection.queries.query",
    "query_vertex_face": "detection.queries.query",
    "query_vertex_vertex": "detection.queries.query",
    "read_triage": "usd.read.triage",
    "repair": "repairing.repair",
    "repair_state": "repairing.state",
    "replay": "scene_replay.intervals",
}

__all__ = [
    "CapturedCollisions",
    "CapturedSteps",
    "CollisionDetector",
    "CollisionFilter",
    "CollisionMesh",
    "CollisionMonitor",
    "Collisions",
    "ContactSensor",
    "DetectionStats",
    "DeviceQueryResult",
    "DifferentiableContacts",
    "FrameRange",
    "FrictionTable",
    "IntervalResult",
    "IntervalSummary",
    "MeshCheck",
    "QueryResult",
    "RepairResult",
    "RigidMotion",
    "Scene",
    "SceneContacts",
    "SceneIntersections",
    "SceneProximities",
    "Selection",
    "SolverCCD",
    "SolverImplicit",
    "SolverReport",
    "StateRepairResult",
    "UnresolvedContour",
    "chamfer_distance",
    "check",
    "checker",
    "checkpointed",
    "distances",
    "leave_out",
    "query_edge_edge",
    "query_points",
    "query_vertex_edge",
    "query_vertex_face",
    "query_vertex_vertex",
    "read_triage",
    "repair",
    "repair_state",
    "replay",
]


def __getattr__(name):
    """Imports a name when it is first used: the exact checker needs no Warp, and Warp no PyTorch or JAX."""
    if name in ("checker", "jax", "torch"):
        return importlib.import_module(f".{name}", __name__)
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = f"{__name__}.{_MODULES[name]}"
    with contextlib.nullcontext() if module in sys.modules else paused_collection():
        return getattr(importlib.import_module(module), name)
