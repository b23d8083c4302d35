"""Inversion of a moving tetrahedron by certified signs of its volume, a cubic in time (Sec. 3.2 and 5.5).

Six times the volume of a tetrahedron a b c d, positive if d is on the side of the triangle a b c from which this is
counterclockwise, is (d - a) . ((b - a) x (c - a)): the coplanarity of vertex d and face a b c, see
:mod:`.polynomials`. A tetrahedron **inverts** in a step if its volume is 0 or negative at some time of it, both ends
included.
"""

from typing import Any

import warp as wp

from .bernstein import restrict_cubic
from .custom_gradients import func_grad
from .motion import Query, query_motion, query_of
from .polynomials import VERTEX_FACE, coplanarity
from .signs import FREE, HALF, HIT, ONE, ROUNDOFF, UNSURE, ZERO, certified_sign, certified_sign_cubic
from .time_of_impact import FINEST, MAX_VISITS, clamped_tolerance, power_of_two

_NEVER = wp.constant(wp.float64(2.0))
_RESTRICTION = wp.constant(wp.float64(2.0))
"""Bound after restriction, in bounds of the coefficients: it interpolates thrice, 9r k <= E, see :mod:`.roots`."""


@wp.struct
class Inversion:
    """When a tetrahedron inverts first; if the status is UNSURE, it does not before ``toi``."""

    status: int  # FREE, HIT (it inverts) or UNSURE
    toi: wp.float64  # time of inversion, a lower bound in [0, 1]; 2 where the status is FREE
    within_tolerance: int  # 1 where the tetrahedron certainly inverts at most the tolerance after that time


@wp.func
def first_inversion(tetrahedron: Query, roundoff: wp.float64, tolerance: wp.float64) -> Inversion:
    """Returns the first inversion of a tetrahedron, by testing one interval after the other.

    In an interval all of whose coefficients are certainly positive, the tetrahedron does not invert; the next one is
    twice as long. Any other is halved, until it is as short as the tolerance and its volume is certainly negative at an
    end: its start is the time of inversion to within the tolerance. Or until it has the shortest length, a share of the
    tolerance; then it is not certain whether the tetrahedron inverts there, but whether it does so later may be.

    Args:
        tetrahedron: The points of vertex d and face a b c.
        roundoff: ROUNDOFF, or 0 for the signs that floating point computes.
        tolerance: Tolerance of the time, as a share of the step, see :func:`.time_of_impact.clamped_tolerance`.
    """
    result = Inversion()
    result.status = UNSURE
    if not wp.isfinite(tetrahedron):
        return result
    y = coplanarity(query_motion(VERTEX_FACE, tetrahedron, roundoff))
    if certified_sign_cubic(y.k, y.bound) > 0:
        result.status = FREE
        result.toi = _NEVER
        return result
    bound = _RESTRICTION * y.bound
    if certified_sign(y.k[3], y.bound) < 0:
        result.status = HIT
    length = power_of_two(clamped_tolerance(tolerance))
    shortest = FINEST * length
    start = ZERO
    end = ONE
    for _ in range(MAX_VISITS):
        k = restrict_cubic(y.k, start, end)
        width = end - start
        if certified_sign_cubic(k, bound) > 0:
            if end == ONE:
                result.status = FREE
                result.toi = _NEVER
                return result
            start = end
            end = wp.min(end + width + width, ONE)
        else:
            is_negative = certified_sign(k[0], bound) < 0 or certified_sign(k[3], bound) < 0
            if is_negative:
                result.status = HIT
            if is_negative and width <= length:
                result.within_tolerance = 1
                break
            if width <= shortest:
                break
            end = start + shortest * wp.floor(HALF * width / shortest)
    result.toi = start
    return result


@wp.func
def _find_inversion(tetrahedron: Query, tolerance: wp.float64) -> Inversion:
    """Returns the first inversion of a tetrahedron, constant for differentiation."""
    return first_inversion(tetrahedron, ROUNDOFF, tolerance)


@func_grad(_find_inversion, Inversion)
def _adjoint_of_find_inversion(tetrahedron: Query, tolerance: wp.float64, adj_ret: Inversion):
    """Does nothing, and keeps Warp from differentiating the code behind :func:`_find_inversion`."""


@wp.func
def inversion_tetrahedron(
    a0: Any, b0: Any, c0: Any, d0: Any, a1: Any, b1: Any, c1: Any, d1: Any, tolerance: wp.float64
) -> Inversion:
    """Returns when a moving tetrahedron a b c d first becomes flat, or is inverted already, without gradients.

    Args:
        a0: First vertex at the start, ``vec3`` or ``vec3d``.
        b0: Second vertex at the start.
        c0: Third vertex at the start.
        d0: Fourth vertex at the start; the volume is positive if (d - a) . ((b - a) x (c - a)) is.
        a1: First vertex at the end of the step.
        b1: Second vertex at the end.
        c1: Third vertex at the end.
        d1: Fourth vertex at the end.
        tolerance: Tolerance of the time, as a share of the step. It is clamped to [2^-38, 2^-10]; NaN counts as 2^-38.

    Returns:
        Status and time: FREE, the volume is certainly positive in the whole step; HIT, it is certainly 0 or negative at
        some time; UNSURE, floating point certifies neither, also if a point is not finite. Before the time it is
        certainly positive.
    """
    return _find_inversion(query_of(d0, a0, b0, c0, d1, a1, b1, c1), tolerance)
