"""From pairs of faces to pairs of elements: representative triangles (Curtis et al. 2008); and on to vertices.

Every vertex and every edge belongs to one face that has it, its representative. Two elements with overlapping boxes
have representatives with overlapping boxes, so that one traversal over faces finds all pairs, each of them once.
"""

import warp as wp

from ..polynomials import VERTEX_EDGE, VERTEX_FACE, VERTEX_VERTEX


@wp.func
def owns_vertex(owned: int, corner: int) -> bool:
    """Whether a face is the representative of the vertex at a corner."""
    return (owned >> corner) & 1 == 1


@wp.func
def owns_edge(owned: int, side: int) -> bool:
    """Whether a face is the representative of the edge from corner ``side`` to the next."""
    return (owned >> (3 + side)) & 1 == 1


@wp.func
def vertices_of_pair(kind: int, elements: wp.array2d[int], pair: wp.vec2i) -> wp.vec4i:
    """The vertices of (vertex, face) or (edge, edge), in the order of a query's points; elements: faces or edges."""
    first = pair[0]
    second = pair[1]
    if kind == VERTEX_FACE:
        return wp.vec4i(first, elements[second, 0], elements[second, 1], elements[second, 2])
    return wp.vec4i(elements[first, 0], elements[first, 1], elements[second, 0], elements[second, 1])


@wp.func
def points_of_pair(kind: int, elements: wp.array2d[int], pair: wp.vec2i) -> wp.vec4i:
    """The vertices of a pair of any kind, as queries with a minimum distance take them: p a b a, or p q q q.

    Elements are faces, or edges for (edge, edge) and (vertex, edge); (vertex, vertex) has none.
    """
    if kind == VERTEX_EDGE:
        return wp.vec4i(pair[0], elements[pair[1], 0], elements[pair[1], 1], elements[pair[1], 0])
    if kind == VERTEX_VERTEX:
        return wp.vec4i(pair[0], pair[1], pair[1], pair[1])
    return vertices_of_pair(kind, elements, pair)
