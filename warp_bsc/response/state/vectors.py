"""Vectors in single and double precision."""

from typing import Any

import warp as wp

ZERO, HALF, ONE = (wp.constant(wp.float64(x)) for x in (0.0, 0.5, 1.0))
"""Numbers in double precision, as kernels need them."""


@wp.func
def to_double(x: Any) -> wp.vec3d:
    """Returns the vector, which may be in single precision, in double precision."""
    return wp.vec3d(wp.float64(x[0]), wp.float64(x[1]), wp.float64(x[2]))


@wp.func
def to_single(x: Any) -> wp.vec3:
    """Returns the nearest vector in single precision."""
    return wp.vec3(wp.float32(x[0]), wp.float32(x[1]), wp.float32(x[2]))


@wp.func
def corners_of(x: wp.array[Any], corners: wp.vec4i):
    """Returns the positions of four vertices in double precision."""
    return to_double(x[corners[0]]), to_double(x[corners[1]]), to_double(x[corners[2]]), to_double(x[corners[3]])


@wp.func
def relative(weights: wp.vec4d, corners: wp.vec4i, x: wp.array[wp.vec3]) -> wp.vec3d:
    """Returns the vector from the second contact point to the first, or its velocity."""
    result = wp.vec3d()
    for j in range(4):
        result += weights[j] * to_double(x[corners[j]])
    return result
