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
from ...response.state.vectors import HALF, ONE, ZERO

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
Corners = wp.types.matrix(shape=(4, 3), dtype=wp.float64)
"""Rows for the corners of a pair: their places, or their displacements."""


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


@wp.func
def _closing_time(first: wp.float64, second: wp.float64, rate: wp.float64, other: wp.float64, least: wp.float64):
    """Returns when a point at ``first``, along a direction, comes as near as ``least`` to one at ``second``."""
    closing = other - rate
    if closing <= ZERO:
        return _TWO
    return (first - second - least) / closing


@wp.func
def safe_share(
    kind: int, x: Corners, displaced: Corners, least: wp.float64, most: float, bends: wp.vec2d
) -> wp.float64:
    """Returns a share of the displacements up to which two elements stay as far apart as ``least``, 1 for all of them.

    They start farther apart. Conservative advancement: a plane across the closest points separates two elements until
    a vertex of one comes as near as that to a vertex of the other along its normal; then another plane is taken.
    Shares of more than ``most``, rounded as they are kept, are of no use, and are 1.
    Displacements are chords: at a share t, elements may be nearer by t (b - t c), where ``bends`` are b and c.
    """
    time = ZERO
    for _k in range(_PLANES):
        now = x + time * displaced
        weights, distance = closest_weights_and_gap(kind, now[0], now[1], now[2], now[3])
        n = (weights * now) / distance
        at, way = now * n, displaced * n
        near = least + time * (bends[0] - time * bends[1])
        more = wp.max(bends[0] - _TWO * time * bends[1], ZERO)
        ahead = _TWO
        for j in range(1, 4):
            if j >= 2 or kind != EDGE_EDGE:
                ahead = wp.min(ahead, _closing_time(at[0], at[j], way[0], way[j] + more, near))
            if j >= 2 and kind == EDGE_EDGE:
                ahead = wp.min(ahead, _closing_time(at[1], at[j], way[1], way[j] + more, near))
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
