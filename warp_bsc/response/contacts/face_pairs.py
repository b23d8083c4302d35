"""The pairs of elements that two faces of a hierarchy represent, for threads that look at them where they find them."""

import warp as wp

from ...detection.broad.face_hierarchy import FaceHierarchy
from ...kernels.polynomials import EDGE_EDGE, VERTEX_FACE


@wp.func
def pair_of_bit(mesh: FaceHierarchy, place: int, other: int, bit: int):
    """Returns kind, elements and vertices of a pair of :class:`.broad.element_pairs.PairFunctions`."""
    if bit < 6:
        of = wp.where(bit < 3, place, other)
        face = wp.where(bit < 3, other, place)
        vertex = mesh.faces[of, bit % 3]
        corners = wp.vec4i(vertex, mesh.faces[face, 0], mesh.faces[face, 1], mesh.faces[face, 2])
        return VERTEX_FACE, wp.vec2i(vertex, mesh.order[face]), corners
    edge = mesh.face_edges[place, (bit - 6) / 3]
    other_edge = mesh.face_edges[other, (bit - 6) % 3]
    a = wp.min(edge, other_edge)
    b = wp.max(edge, other_edge)
    return EDGE_EDGE, wp.vec2i(a, b), wp.vec4i(mesh.edges[a, 0], mesh.edges[a, 1], mesh.edges[b, 0], mesh.edges[b, 1])
