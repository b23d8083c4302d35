"""The barrier between elements that are near each other, and friction, by their closest points.

The energy of a gap g below a reach D is -k (g - D)^2 ln(g / D): infinite where elements touch, and smooth at D. Within
a Newton step the closest points are fixed. Friction is Coulomb's, smoothed below a velocity, under the load of the
Newton step.

References:
    M. Li, Z. Ferguson, T. Schneider, T. Langlois, D. Zorin, D. Panozzo, C. Jiang and D. M. Kaufman, Incremental
    Potential Contact, ACM Transactions on Graphics 39(4), 2020, doi:10.1145/3386569.3392425.
    M. Li, D. M. Kaufman and C. Jiang, Codimensional Incremental Potential Contact, ACM Transactions on Graphics 40(4),
    2021, doi:10.1145/3450626.3459767 (thickness).
"""

from typing import Any

import warp as wp

from ...kernels.distance import closest_points, nearest_pair
from ...kernels.not_inlined import NOT_INLINED
from ...kernels.polynomials import EDGE_EDGE, VERTEX_FACE
from ...response.state.vectors import HALF, ONE, ZERO, to_single

wp.set_module_options({"enable_backward": False})

_TWO = wp.constant(wp.float64(2.0))
_FOUR = wp.constant(wp.float64(4.0))
CURVATURE_AT_HALF = 6.386294361119891
"""Curvature of the barrier at half of its reach, in its stiffness."""
_NEXT = wp.constant(wp.float64(0.999))
"""Share of a safe time by which the search for an impact goes on: it may be rounded up."""
_STALLED = wp.constant(wp.float64(1e-3))
"""Share of displacements by which it goes on at least; it ends early, and safe, where it does not."""
FLOOR = wp.constant(wp.float64(0.03))
"""Share of the reach of a barrier below which it is too steep to solve for in one step."""
FORCE_AT_FLOOR = 38.1660556541341
"""Force of the barrier at that gap, in the product of its stiffness and its reach."""
MOST_LEFT = 0.3
"""Share of the reach that a pair keeps at most."""
_PLANES = wp.constant(24)
"""Most planes that it takes."""
ROUNDED_DOWN, ROUNDED_UP = wp.constant(float(1.0 - 2.0**-20)), wp.constant(float(1.0 + 2.0**-20))
"""What keeps numbers in single precision, as they are rounded, from being more or less than they are."""
_ROUNDING = wp.constant(float(2.0**-18))
"""More than rounding changes distances, as a share of the largest component of what they are found from."""
_TINY = wp.constant(float(2.0**-60))
"""Length below which the square of a component is rounded to 0 or nearly [m]."""


@wp.func
def barrier_energy(gap: wp.float64, reach: wp.float64) -> wp.float64:
    """Returns the energy of a gap, more than 0, for a stiffness of 1."""
    if gap >= reach:
        return ZERO
    short = gap - reach
    return -short * short * wp.log(gap / reach)


@wp.func
def barrier_slope(gap: wp.float64, reach: wp.float64) -> wp.float64:
    """Returns the derivative of :func:`barrier_energy` by the gap."""
    short = gap - reach
    return -_TWO * short * wp.log(gap / reach) - short * short / gap


@wp.func
def barrier_curvature(gap: wp.float64, reach: wp.float64) -> wp.float64:
    """Returns the second derivative of :func:`barrier_energy` by the gap."""
    short = (gap - reach) / gap
    return -_TWO * wp.log(gap / reach) - _FOUR * short + short * short


@wp.func
def friction_energy(slid: wp.float64, smoothing: wp.float64) -> wp.float64:
    """Returns the work of smoothed friction over a slid length, under a limit of 1."""
    if slid >= smoothing:
        return slid - HALF * smoothing
    return HALF * slid * slid / smoothing


@wp.func
def friction_slope(slid: wp.float64, smoothing: wp.float64) -> wp.float64:
    """Returns the derivative of :func:`friction_energy` over the slid length.

    A constant below the smoothing length: one Newton step finds the force of what friction holds.
    """
    return ONE / wp.max(slid, smoothing)


@wp.func
def friction_curvature(slid: wp.float64, smoothing: wp.float64) -> wp.float64:
    """Returns the second derivative of :func:`friction_energy`."""
    return wp.where(slid >= smoothing, ZERO, ONE / smoothing)


@wp.func(**NOT_INLINED)  # once in the code of a kernel, of which instructions are a large part of the time
def closest_weights_and_gap(kind: int, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d):
    """Returns the weights of four points in the vector between the closest points of two elements, and its length.

    Points are in the range of single precision: fourth powers of their differences are then in that of double.
    """
    if kind == EDGE_EDGE:
        at = nearest_pair(EDGE_EDGE, b - a, d - c, c - a)
        return wp.vec4d(ONE - at[0], at[0], at[1] - ONE, -at[1]), wp.sqrt(at[2])
    at = nearest_pair(VERTEX_FACE, c - b, d - b, a - b)
    return wp.vec4d(ONE, at[0] + at[1] - ONE, -at[0], -at[1]), wp.sqrt(at[2])


@wp.func
def least_distance(kind: int, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d) -> wp.float64:
    """Returns a lower bound of the distance of two elements, 0 where they may touch."""
    if kind == EDGE_EDGE:
        _at, distance, error = closest_points(EDGE_EDGE, b - a, d - c, c - a)
        return wp.max(distance - _TWO * error, ZERO)
    _there, found, rounding = closest_points(VERTEX_FACE, c - b, d - b, a - b)
    return wp.max(found - _TWO * rounding, ZERO)


# Bounds of distances, of which many are found: in single precision, with points seen from the fourth one, so that
# rounding hardly counts. On GPUs, that takes a fifth of the instructions.


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
) -> float:
    """Returns the distance of the boxes around the ways of two elements, at most that of the elements on them.

    But for its rounding, and ways are seen from the fourth point as well.
    """
    low, high = wp.min(b, b + q), wp.max(b, b + q)
    first, last = wp.min(a, a + p), wp.max(a, a + p)
    lower, upper = wp.min(wp.min(c, c + r), wp.vec3()), wp.max(wp.max(c, c + r), wp.vec3())
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
def _closing_time(first: wp.float64, second: wp.float64, rate: wp.float64, other: wp.float64, least: wp.float64):
    """Returns when a point at ``first``, along a direction, comes as near as ``least`` to one at ``second``."""
    closing = other - rate
    if closing <= ZERO:
        return _TWO
    return (first - second - least) / closing


@wp.func
def safe_share(
    kind: int,
    # points
    a: wp.vec3d,
    b: wp.vec3d,
    c: wp.vec3d,
    d: wp.vec3d,
    # their displacements
    p: wp.vec3d,
    q: wp.vec3d,
    r: wp.vec3d,
    s: wp.vec3d,
    least: wp.float64,
    most: float,
    bends: wp.vec2d,
) -> wp.float64:
    """Returns a share of the displacements up to which two elements stay as far apart as ``least``, 1 for all of them.

    They start farther apart. Conservative advancement: a plane across the closest points separates two elements until
    a vertex of one comes as near as that to a vertex of the other along its normal; then another plane is taken.
    Shares of more than ``most``, rounded as they are kept, are of no use, and are 1.
    Displacements are chords: at a share t, elements may be nearer by t (b - t c), where ``bends`` are b and c.
    """
    time = ZERO
    for _k in range(_PLANES):
        e, f, g, h = a + time * p, b + time * q, c + time * r, d + time * s
        weights, distance = closest_weights_and_gap(kind, e, f, g, h)
        n = (weights[0] * e + weights[1] * f + weights[2] * g + weights[3] * h) / distance
        ea, fa, ga, ha = wp.dot(n, e), wp.dot(n, f), wp.dot(n, g), wp.dot(n, h)
        near = least + time * (bends[0] - time * bends[1])
        more = wp.max(bends[0] - _TWO * time * bends[1], ZERO)
        pa, qa, ra, sa = wp.dot(n, p), wp.dot(n, q), wp.dot(n, r), wp.dot(n, s)
        ahead = wp.min(_closing_time(ea, ga, pa, ra + more, near), _closing_time(ea, ha, pa, sa + more, near))
        if kind == EDGE_EDGE:
            ahead = wp.min(ahead, _closing_time(fa, ga, qa, ra + more, near))
            ahead = wp.min(ahead, _closing_time(fa, ha, qa, sa + more, near))
        else:
            ahead = wp.min(ahead, _closing_time(ea, fa, pa, qa + more, near))
        time += _NEXT * wp.max(ahead, ZERO)
        if time >= ONE or float(time) > most:
            return ONE
        if ahead < _STALLED:
            return time
    return time


@wp.func
def floor_gap(gap: wp.float64, reach: wp.float64) -> wp.float64:
    """Returns the gap below which a pair hardly comes nearer in a step, where its barrier would be too steep.

    It depends on the gap at the start: what is pressed together comes as near as it must in some steps.
    """
    return wp.min(FLOOR * reach, wp.float64(0.45) * gap)


@wp.func
def least_gap(gap: Any, reach: Any, floor: Any):
    """Returns the gap that a pair keeps in a Newton step: half of it, or less where it is large, more where small."""
    least = wp.min(type(gap)(0.5) * gap, type(gap)(MOST_LEFT) * reach)
    return wp.max(least, wp.min(floor, type(gap)(0.9) * gap))


@wp.func
def goal_gap(gap: wp.float64, reach: wp.float64, floor: wp.float64) -> wp.float64:
    """Returns the gap at which a pair is held that would come nearer than :func:`least_gap`."""
    return wp.max(wp.min(wp.float64(0.6) * reach, wp.float64(0.75) * gap), _TWO * floor)
