"""The functions of the exact checker, by kind of query."""

from warp_bsc import checker

KINDS = ("vertex_face", "edge_edge")
COLLIDES = {"vertex_face": checker.vertex_face, "edge_edge": checker.edge_edge}
TOI = {"vertex_face": checker.vertex_face_toi, "edge_edge": checker.edge_edge_toi}
