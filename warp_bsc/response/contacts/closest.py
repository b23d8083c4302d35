"""Closest points of two elements at the start of a step."""

import warp as wp

from ...kernels.closest import closest_coordinates
from ...kernels.polynomials import EDGE_EDGE, VERTEX_FACE
from ..state.structs import Motion
from ..state.vectors import ONE, ZERO, relative, to_double


@wp.func
def _are_positive(a: wp.float64, b: wp.float64) -> bool:
    return a > ZERO and b > ZERO


@wp.func
def closest_weights(kind: int, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d) -> wp.vec4d:
    """Returns the weights of four points in the vector between the closest points of two elements."""
    if kind == EDGE_EDGE:
        at = closest_coordinates(EDGE_EDGE, b - a, d - c, c - a)
        return wp.vec4d(ONE - at[0], at[0], at[1] - ONE, -at[1])
    at = closest_coordinates(VERTEX_FACE, c - b, d - b, a - b)
    return wp.vec4d(ONE, at[0] + at[1] - ONE, -at[0], -at[1])


@wp.func
def _closest_weights(motion: Motion, corners: wp.vec4i, edges: int) -> wp.vec4d:
    """Returns the weights of four vertices in the vector between the closest points of two elements at the start."""
    a = to_double(motion.x0[corners[0]])
    b = to_double(motion.x0[corners[1]])
    c = to_double(motion.x0[corners[2]])
    d = to_double(motion.x0[corners[3]])
    return closest_weights(wp.where(edges == 1, EDGE_EDGE, VERTEX_FACE), a, b, c, d)


@wp.func
def _is_within(weights: wp.vec4d, edges: int) -> bool:
    """Returns whether closest points are within both elements, not on their borders."""
    if edges == 1 and not _are_positive(weights[0], weights[1]):
        return False
    return _are_positive(-weights[2], -weights[3]) and (edges == 1 or weights[1] < ZERO)


@wp.func
def closest_vector(motion: Motion, corners: wp.vec4i, edges: int):
    """Returns the weights of the closest points of two elements at the start, and the vector between them [m]."""
    weights = _closest_weights(motion, corners, edges)
    return weights, relative(weights, corners, motion.x0)


@wp.func
def closest_direction(motion: Motion, corners: wp.vec4i, edges: int) -> wp.vec3d:
    """Returns the unit vector from the second to the first of two elements at the start; zero if they touch.

    Within both elements it is across both, which rounding hardly turns, however near they are.
    """
    weights, between = closest_vector(motion, corners, edges)
    if _is_within(weights, edges):
        b = to_double(motion.x0[corners[1]])
        c = to_double(motion.x0[corners[2]])
        d = to_double(motion.x0[corners[3]])
        across = wp.cross(c - b, d - b)
        if edges == 1:
            across = wp.cross(b - to_double(motion.x0[corners[0]]), d - c)
        if wp.length_sq(across) > ZERO:
            between = wp.where(wp.dot(across, between) < ZERO, -across, across)
    return wp.normalize(between)
