"""From pairs of faces to pairs of elements by representative triangles, and to vertices.

Every vertex and every edge belongs to one face that has it, its representative. Two elements with overlapping boxes
have representatives with overlapping boxes, so that one traversal over faces finds all pairs, each of them once.

References:
    Sean Curtis, Rasmus Tamstorf, and Dinesh Manocha. "Fast Collision Detection for Deformable Models Using
    Representative-Triangles." Symposium on Interactive 3D Graphics and Games (2008).
    https://doi.org/10.1145/1342250.1342260.
"""

from typing import Any

import warp as wp

from .polynomials import EDGE_EDGE, VERTEX_EDGE, VERTEX_FACE, VERTEX_VERTEX

ABOVE_SUM = wp.constant(wp.float64(1.0 + 2.0**-50))
"""Raises a distance so that a rounded sum is at least the exact one."""


@wp.struct
class PairFilter:
    """Which pairs of elements are left out, by their vertices; without arrays none.

    Two vertices meet if each has a group that is in the mask of the other. A pair of elements is left out unless each
    vertex of one meets each vertex of the other. So where a pair of an edge and a face is not left out, neither are
    those of their parts, whose contacts are the only way in which the two can come to cross.
    """

    group: wp.array[int]  # of each vertex, as bits
    mask: wp.array[int]  # groups that each vertex meets, as bits


@wp.func
def groups_meet(group: int, mask: int, other_group: int, other_mask: int) -> bool:
    """Returns whether each of two has a group that is in the mask of the other."""
    return (group & other_mask) != 0 and (other_group & mask) != 0


@wp.func
def is_filtered(pair_filter: PairFilter, element: wp.vec3i, other: wp.vec3i) -> bool:
    """Returns whether a pair of elements is left out, each given as p p p, a b b or a b c."""
    if not pair_filter.group:
        return False
    for i in range(3):
        group = pair_filter.group[element[i]]
        mask = pair_filter.mask[element[i]]
        for j in range(3):
            if not groups_meet(group, mask, pair_filter.group[other[j]], pair_filter.mask[other[j]]):
                return True
    return False


@wp.func
def finite_elements(owned: int, a: bool, b: bool, c: bool) -> int:
    """Returns what a face represents without the elements that have a corner that is not finite.

    Bits 0 to 2 of ``owned`` are the vertices at the corners, bits 3 to 5 the edges from a corner to the next, bit 6 the
    face itself.
    """
    finite = wp.where(a, 1, 0) | wp.where(b, 2, 0) | wp.where(c, 4, 0)
    next = (finite >> 1) | ((finite & 1) << 2)
    return owned & (finite | ((finite & next) << 3) | wp.where(finite == 7, 64, 0))


@wp.func
def vertices_of_pair(kind: int, elements: wp.array2d[int], pair: wp.vec2i) -> wp.vec4i:
    """Returns the vertices of (vertex, face) or (edge, edge) in the order of a query's points, from faces or edges."""
    first = pair[0]
    second = pair[1]
    if kind == VERTEX_FACE:
        return wp.vec4i(first, elements[second, 0], elements[second, 1], elements[second, 2])
    return wp.vec4i(elements[first, 0], elements[first, 1], elements[second, 0], elements[second, 1])


@wp.func
def points_of_pair(kind: int, elements: wp.array2d[int], pair: wp.vec2i) -> wp.vec4i:
    """Returns the vertices of a pair of any kind, in the order of queries with a minimum distance: p a b a, or p q q q.

    Elements are faces, or edges for (edge, edge) and (vertex, edge); (vertex, vertex) has none.
    """
    if kind == VERTEX_EDGE:
        return wp.vec4i(pair[0], elements[pair[1], 0], elements[pair[1], 1], elements[pair[1], 0])
    if kind == VERTEX_VERTEX:
        return wp.vec4i(pair[0], pair[1], pair[1], pair[1])
    return vertices_of_pair(kind, elements, pair)


@wp.func
def ends_of(x0: wp.array[Any], x1: wp.array[Any], v: wp.vec4i):
    """Returns the positions of four vertices at the start, then at the end."""
    return x0[v[0]], x0[v[1]], x0[v[2]], x0[v[3]], x1[v[0]], x1[v[1]], x1[v[2]], x1[v[3]]


@wp.func
def form_of(kind: int) -> int:
    """Returns the form of the four points of a pair of any kind: EDGE_EDGE or VERTEX_FACE."""
    return wp.where(kind == EDGE_EDGE, EDGE_EDGE, VERTEX_FACE)


@wp.func
def firsts_of(kind: int) -> int:
    """Returns how many of the four vertices of a pair belong to the first element."""
    return wp.where(kind == EDGE_EDGE, 2, 1)


@wp.func
def distance_of_corners(kind: int, v: wp.vec4i, radius: wp.array[wp.float64]) -> wp.float64:
    """Returns the minimum distance of a pair."""
    a = radius[v[0]]
    b = radius[v[1]]
    other = wp.max(radius[v[2]], radius[v[3]])
    if kind == EDGE_EDGE:
        return wp.max(a, b) + other
    return a + wp.max(b, other)
