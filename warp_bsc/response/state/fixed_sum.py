"""Sums in fixed point, which are the same in any order of threads."""

import warp as wp

from .vectors import to_double, to_single

_UNITS = wp.constant(wp.float64(2.0**40))
"""Units in a metre; sums are of integers in these units, so that they are the same in any order."""


@wp.func
def _add(sums: wp.array2d[wp.int64], vertex: int, x: wp.vec3d):
    for axis in range(3):
        wp.atomic_add(sums, vertex, axis, wp.int64(wp.rint(_UNITS * x[axis])))


@wp.func
def with_delta(x: wp.vec3, sums: wp.array2d[wp.int64], vertex: int) -> wp.vec3:
    """Returns a position or velocity plus the sum of what constraints did to it."""
    y = to_double(x)
    for axis in range(3):
        y[axis] += wp.float64(sums[vertex, axis]) / _UNITS
    return to_single(y)


@wp.func
def sums_of(sums: wp.array2d[wp.int64], body: int):
    """Returns the linear and the angular part of the sums of a body."""
    linear = wp.vec3d()
    angular = wp.vec3d()
    for axis in range(3):
        linear[axis] = wp.float64(sums[body, axis]) / _UNITS
        angular[axis] = wp.float64(sums[body, 3 + axis]) / _UNITS
    return linear, angular
