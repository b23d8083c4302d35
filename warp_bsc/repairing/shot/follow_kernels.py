"""Kernels that spread the displacement of some vertices over their neighbourhood, and find directions of contacts."""

import warp as wp

from ...kernels.closest import closest_weights
from ...kernels.polynomials import EDGE_EDGE, VERTEX_FACE

wp.set_module_options({"enable_backward": False})

_ZERO = wp.constant(wp.float64(0.0))
_SOONER = wp.constant(wp.float64(0.25))
"""Largest share of the time of a contact by which it is looked at before."""
_SOONER_GAPS = wp.constant(wp.float64(2.0))
"""Largest relative motion in between, as a multiple of the gap that the contact is to have."""


@wp.kernel
def smooth(
    # neighbours of each vertex: those of vertex i stand in [first[i], first[i + 1])
    first: wp.array[int],
    neighbours: wp.array[int],
    # in
    values: wp.array[wp.vec4],
    # out
    smoothed: wp.array[wp.vec4],
):
    """Averages the value of each vertex with the mean of its neighbours."""
    i = wp.tid()
    total = wp.vec4()
    for k in range(first[i], first[i + 1]):
        total += values[neighbours[k]]
    count = first[i + 1] - first[i]
    smoothed[i] = values[i]
    if count > 0:
        smoothed[i] = 0.5 * (values[i] + total / float(count))


@wp.func
def _position(x0: wp.array[wp.vec3], x1: wp.array[wp.vec3], vertex: int, time: wp.float64):
    """Returns the position of a vertex at a time of its motion."""
    return (wp.float64(1.0) - time) * wp.vec3d(x0[vertex]) + time * wp.vec3d(x1[vertex])


@wp.kernel
def find_directions(
    # motion
    x0: wp.array[wp.vec3],
    x1: wp.array[wp.vec3],
    # in
    vertices: wp.array[wp.vec4i],
    are_of_edges: wp.array[wp.bool],
    toi: wp.array[wp.float64],
    gap: wp.array[wp.float64],
    # in and out
    weights: wp.array[wp.vec4d],
    normals: wp.array[wp.vec3d],
):
    """Writes the weights of the closest points of contacts a moment before, and the directions between them.

    Elements that touch then keep theirs. Within both elements the direction is across both, which rounding hardly
    turns, however near they are.
    """
    i = wp.tid()
    corners = vertices[i]
    motion = wp.vec3d()
    for corner in range(4):
        vertex = corners[corner]
        motion += weights[i][corner] * (wp.vec3d(x1[vertex]) - wp.vec3d(x0[vertex]))
    sooner = _SOONER * toi[i]
    if wp.length(motion) * sooner > _SOONER_GAPS * gap[i]:
        sooner = _SOONER_GAPS * gap[i] / wp.length(motion)
    a = _position(x0, x1, corners[0], toi[i] - sooner)
    b = _position(x0, x1, corners[1], toi[i] - sooner)
    c = _position(x0, x1, corners[2], toi[i] - sooner)
    d = _position(x0, x1, corners[3], toi[i] - sooner)
    kind = wp.where(are_of_edges[i], EDGE_EDGE, VERTEX_FACE)
    at = closest_weights(kind, a, b, c, d)
    between = at[0] * a + at[1] * b + at[2] * c + at[3] * d
    across = wp.cross(c - b, d - b)
    are_within = at[1] < _ZERO
    if kind == EDGE_EDGE:
        across = wp.cross(b - a, d - c)
        are_within = at[0] > _ZERO and at[1] > _ZERO
    if are_within and at[2] < _ZERO and at[3] < _ZERO and wp.length_sq(across) > _ZERO:
        between = wp.where(wp.dot(across, between) < _ZERO, -across, across)
    if wp.length_sq(between) > _ZERO:
        weights[i] = at
        normals[i] = wp.normalize(between)
