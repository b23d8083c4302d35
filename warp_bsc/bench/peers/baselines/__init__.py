"""Other methods of the literature, as device code written from their papers, for the benchmarks to compare with."""

from .cubic_solver import cubic_solver_edge_edge, cubic_solver_vertex_face
from .reduced_inside_test import classify_reduced

__all__ = ["classify_reduced", "cubic_solver_edge_edge", "cubic_solver_vertex_face"]
