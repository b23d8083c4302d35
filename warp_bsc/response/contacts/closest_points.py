"""Closest points of two elements."""

import warp as wp

from ...kernels.closest import closest_weights
from ...kernels.polynomials import EDGE_EDGE
from ..state.structs import Motion
from ..state.vectors import ZERO, corners_of, relative


@wp.func
def _are_within(weights: wp.vec4d, kind: int) -> bool:
    """Returns whether closest points are within both elements, not on their borders."""
    of_second = weights[2] < ZERO and weights[3] < ZERO
    if kind == EDGE_EDGE:
        return of_second and weights[0] > ZERO and weights[1] > ZERO
    return of_second and weights[1] < ZERO


@wp.func
def closest_vector(motion: Motion, corners: wp.vec4i, kind: int):
    """Returns the weights of the closest points of two elements at the start, and the vector between them [m]."""
    a, b, c, d = corners_of(motion.x0, corners)
    weights = closest_weights(kind, a, b, c, d)
    return weights, relative(weights, corners, motion.x0)


@wp.func
def closest_direction(motion: Motion, corners: wp.vec4i, kind: int) -> wp.vec3d:
    """Returns the unit vector from the second to the first of two elements at the start; zero if they touch.

    Within both elements it is across both, which rounding hardly turns, however near they are.
    """
    weights, between = closest_vector(motion, corners, kind)
    if _are_within(weights, kind):
        a, b, c, d = corners_of(motion.x0, corners)
        across = wp.cross(c - b, d - b)
        if kind == EDGE_EDGE:
            across = wp.cross(b - a, d - c)
        if wp.length_sq(across) > ZERO:
            between = wp.where(wp.dot(across, between) < ZERO, -across, across)
    return wp.normalize(between)
