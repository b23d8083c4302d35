"""Culls: cheap tests that prove most queries FREE (Sec. 4.3), all sound for linear motion.

A **fixed** direction that separates the two features at the start and at the end, on the same side, separates them
in between, because every difference of two points along it is linear in time.
"""

from typing import Any

import warp as wp

from .boxes import boxes_apart
from .polynomials import VERTEX_FACE, Motion
from .signs import HALF, UNDERFLOW

_THIRD = wp.constant(wp.float64(1.0 / 3.0))
DIRECTION_ERROR = wp.constant(wp.float64(10.0))


@wp.func
def vertex_face_boxes_apart(p0: Any, a0: Any, b0: Any, c0: Any, p1: Any, a1: Any, b1: Any, c1: Any) -> bool:
    """Returns whether a coordinate axis separates vertex and triangle."""
    low0 = wp.min(a0, wp.min(b0, c0))
    low1 = wp.min(a1, wp.min(b1, c1))
    high0 = wp.max(a0, wp.max(b0, c0))
    high1 = wp.max(a1, wp.max(b1, c1))
    return boxes_apart(p0, p0, p1, p1, low0, high0, low1, high1)


@wp.func
def edge_edge_boxes_apart(a0: Any, b0: Any, c0: Any, d0: Any, a1: Any, b1: Any, c1: Any, d1: Any) -> bool:
    """Returns whether a coordinate axis separates the edges."""
    return boxes_apart(
        wp.min(a0, b0),
        wp.max(a0, b0),
        wp.min(a1, b1),
        wp.max(a1, b1),
        wp.min(c0, d0),
        wp.max(c0, d0),
        wp.min(c1, d1),
        wp.max(c1, d1),
    )


@wp.func
def gaps_along(motion: Motion, direction: wp.vec3d):
    """Returns by how much a direction separates the features of a motion at both ends, on either side, and a bound.

    The differences of the points of the two features are w, w - u, w - v (vertex-face) and w, w - u, w + v,
    w - u + v (edge-edge).

    Bound: any direction is valid, so that it has no error. The products of a dot product have at most 4 roundings of
    the vector (a motion restricted in time has been interpolated), 1 of the product, 2 of the sum, and 2 of the
    difference: 9r times the sum of the sizes of all products.

    Returns:
        The smallest and the largest difference along the direction, and the bound on the error of both.
    """
    u0 = wp.dot(direction, motion.u0)
    u1 = wp.dot(direction, motion.u1)
    v0 = wp.dot(direction, motion.v0)
    v1 = wp.dot(direction, motion.v1)
    w0 = wp.dot(direction, motion.w0)
    w1 = wp.dot(direction, motion.w1)
    low = wp.float64(0.0)
    high = wp.float64(0.0)
    if motion.kind == VERTEX_FACE:
        low = wp.min(w0 - wp.max(wp.max(u0, v0), low), w1 - wp.max(wp.max(u1, v1), low))
        high = wp.max(w0 - wp.min(wp.min(u0, v0), high), w1 - wp.min(wp.min(u1, v1), high))
    else:
        low = wp.min(w0 - wp.max(u0, low) + wp.min(v0, high), w1 - wp.max(u1, low) + wp.min(v1, high))
        high = wp.max(w0 - wp.min(u0, high) + wp.max(v0, high), w1 - wp.min(u1, high) + wp.max(v1, high))
    size = wp.dot(wp.abs(direction), motion.u_size + motion.v_size + motion.w_size)
    return low, high, motion.roundoff * (DIRECTION_ERROR * size + UNDERFLOW)


@wp.func
def direction_separates(motion: Motion, direction: wp.vec3d) -> bool:
    """Returns whether a direction certainly separates the features of a motion at both ends, on the same side."""
    low, high, bound = gaps_along(motion, direction)
    return low > bound or high < -bound


@wp.func
def centroid_direction(motion: Motion) -> wp.vec3d:
    """Returns the direction through the centroids of the two features at half time."""
    w = motion.w0 + motion.w1
    u = motion.u0 + motion.u1
    v = motion.v0 + motion.v1
    if motion.kind == VERTEX_FACE:
        return w - _THIRD * (u + v)
    return w + HALF * (v - u)
