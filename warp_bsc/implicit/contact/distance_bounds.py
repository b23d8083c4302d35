"""Lower bounds of the distance of a pair, of which many are found, and directions in 30 bits along which they are.

In single precision, where a GPU has instructions for min and max, with points seen from the last one, so that rounding
hardly counts: :func:`rounding_of` says by how much, and what a bound is compared with takes it off. The distance along
a direction is as good a bound as the distance itself if that is nearly the direction of the closest points.
"""

from typing import Any

import warp as wp

from ...kernels.polynomials import EDGE_EDGE
from ...response.state.vectors import to_single

wp.set_module_options({"enable_backward": False})

ROUNDED_DOWN, ROUNDED_UP = wp.constant(float(1.0 - 2.0**-20)), wp.constant(float(1.0 + 2.0**-20))
"""What keeps numbers in single precision, as they are rounded, from being more or less than they are."""
_ROUNDING = wp.constant(float(2.0**-18))
"""More than rounding changes distances, as a share of the largest component of what they are found from."""
_TINY = wp.constant(float(2.0**-60))
"""Length below which the square of a component is rounded to 0 or nearly [m]."""
_LARGEST, _UNIT = wp.constant(wp.float64(511.0)), wp.constant(float(1.0 / 511.0))
"""Of a component in ten bits, and what 1 there stands for."""
_SHORTER = wp.constant(wp.float64(1.0 - 2.0**-9))
"""With it, rounding to multiples of 1 / 511 leaves a unit vector shorter than 1."""


@wp.func
def seen_from_last(x: wp.array[Any], corners: wp.vec4i):
    """Returns the first three of four vertices as seen from the last one."""
    d = x[corners[3]]
    return to_single(x[corners[0]] - d), to_single(x[corners[1]] - d), to_single(x[corners[2]] - d)


@wp.func
def rounding_of(a: wp.vec3, b: wp.vec3, c: wp.vec3) -> float:
    """Returns by how much more than they are rounding makes distances that are found from what is seen from d."""
    return _ROUNDING * wp.max(wp.max(wp.max(wp.abs(a)), wp.max(wp.abs(b))), wp.max(wp.abs(c))) + _TINY


@wp.func
def distance_of_boxes(kind: int, a: wp.vec3, b: wp.vec3, c: wp.vec3) -> float:
    """Returns the distance of the boxes around two elements, at most that of the elements, but for its rounding."""
    of_first, of_second = wp.where(kind == EDGE_EDGE, b, a), wp.where(kind == EDGE_EDGE, c, b)
    first, last = wp.min(a, of_first), wp.max(a, of_first)
    lower, upper = wp.min(wp.min(of_second, c), wp.vec3()), wp.max(wp.max(of_second, c), wp.vec3())
    return wp.length(wp.max(wp.max(lower - last, first - upper), wp.vec3()))


@wp.func
def distance_along(kind: int, n: wp.vec3, a: wp.vec3, b: wp.vec3, c: wp.vec3) -> float:
    """Returns the distance of two elements along a vector from the second to the first.

    With one no longer than 1, it is at most their distance, but for its rounding.
    """
    along_a, along_b, along_c = wp.dot(n, a), wp.dot(n, b), wp.dot(n, c)
    of_first = wp.where(kind == EDGE_EDGE, along_b, along_a)
    of_second = wp.where(kind == EDGE_EDGE, along_c, along_b)
    return wp.min(along_a, of_first) - wp.max(wp.max(of_second, along_c), 0.0)


@wp.func
def distance_of_ways(
    kind: int,
    # points
    a: wp.vec3,
    b: wp.vec3,
    c: wp.vec3,
    # their ways
    p: wp.vec3,
    q: wp.vec3,
    r: wp.vec3,
    s: wp.vec3,
) -> float:
    """Returns the distance of the boxes around the ways of two elements, at most that of the elements on them.

    But for its rounding. Where the points take the same part of their ways, these may be seen from the fourth one as
    well, whose own is 0 then; otherwise they may take any parts.
    """
    low, high = wp.min(b, b + q), wp.max(b, b + q)
    first, last = wp.min(a, a + p), wp.max(a, a + p)
    lower, upper = wp.min(wp.min(c, c + r), wp.min(wp.vec3(), s)), wp.max(wp.max(c, c + r), wp.max(wp.vec3(), s))
    if kind == EDGE_EDGE:
        first, last = wp.min(first, low), wp.max(last, high)
    else:
        lower, upper = wp.min(lower, low), wp.max(upper, high)
    return wp.length(wp.max(wp.max(lower - last, first - upper), wp.vec3()))


@wp.func
def way_together(kind: int, p: wp.vec3, q: wp.vec3, r: wp.vec3) -> float:
    """Returns how much nearer ways of points bring two elements at most: what all do does not count."""
    of_p, of_q, of_r = wp.length(p), wp.length(q), wp.length(r)
    way = wp.where(kind == EDGE_EDGE, wp.max(of_p, of_q) + of_r, of_p + wp.max(of_q, of_r))
    return ROUNDED_UP * way + _TINY


@wp.func
def _bits_of(component: wp.float64) -> int:
    return int(wp.rint(_LARGEST * _SHORTER * component)) & 1023


@wp.func
def direction_in_bits(n: wp.vec3d) -> int:
    """Returns a unit vector in 30 bits, for :func:`direction_of_bits`."""
    return _bits_of(n[0]) | (_bits_of(n[1]) << 10) | (_bits_of(n[2]) << 20)


@wp.func
def _component_of(bits: int) -> float:
    return _UNIT * float(((bits & 1023) ^ 512) - 512)


@wp.func
def direction_of_bits(bits: int) -> wp.vec3:
    """Returns a vector no longer than 1, within 0.005 of the unit vector; 0 for 0."""
    return wp.vec3(_component_of(bits), _component_of(bits >> 10), _component_of(bits >> 20))
