"""Continuous collision detection for deforming triangle meshes: no missed collision, no dropped pair."""

from .detector import CollisionDetector, Collisions, DetectionStats
from .mesh import CollisionMesh
from .query import QueryResult, query_edge_edge, query_vertex_face

__all__ = [
    "CollisionDetector",
    "CollisionMesh",
    "Collisions",
    "DetectionStats",
    "QueryResult",
    "query_edge_edge",
    "query_vertex_face",
]
