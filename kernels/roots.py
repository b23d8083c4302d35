"""Root counting and sign determination: signs at the roots of a cubic, without the roots (Sec. 4.1 and 4.2).

All functions take a cubic Y, whose signs at both ends are certain and which has at most one extremum between them, and
the bound on the error of its coefficients. Signs that they return are 0 where they are not certain.

Bounds are in terms of E (of Y's coefficients, at most k in size) and F (of a quadratic's, at most q in size). Because
E >= 13 r k and F >= 5 r q in :mod:`polynomials`, with r the roundoff, they cover the roundings of this
module: rounding a number of size c k costs c r k <= c E / 13.
"""

import warp as wp

from .bernstein import divide_cubic, evaluate_cubic, evaluate_quadratic
from .signs import FOUR, TWO, UNDERFLOW, certified_sign, certified_sign_quadratic

MONOTONE = wp.constant(0)
"""Curve without extremum (case c)."""
ONE_EXTREMUM = wp.constant(1)
"""Curve with one extremum (case b)."""
TWO_EXTREMA = wp.constant(2)
"""Curve that may have two extrema, with its inflection between them (case a, as far as it needs splitting)."""
UNKNOWN = wp.constant(-1)

_QUARTER = wp.constant(wp.float64(0.25))
_SIX = wp.constant(wp.float64(6.0))
_SEVEN = wp.constant(wp.float64(7.0))
_EIGHT = wp.constant(wp.float64(8.0))
_DIFFERENCE = wp.constant(wp.float64(2.5))
_DISCRIMINANT = wp.constant(wp.float64(24.0))
_TURNING = wp.constant(wp.float64(64.0))
_CROSSING = wp.constant(wp.float64(8.0))
_SLOPE_CROSSING = wp.constant(wp.float64(16.0))
_DIVISION_L = wp.constant(wp.float64(288.0))
_DIVISION_K = wp.constant(wp.float64(896.0))

ROOT_CONSTANTS = {
    "difference_of_cubic": float(_DIFFERENCE),
    "discriminant_error": float(_DISCRIMINANT),
    "turning_error": float(_TURNING),
    "crossing_error": float(_CROSSING),
    "slope_crossing_error": float(_SLOPE_CROSSING),
    "factor_error": float(_DIVISION_L),
    "division_error": float(_DIVISION_K),
}
"""The factors of bounds in this module, by name."""


@wp.func
def largest(k: wp.vec4d) -> wp.float64:
    """Returns the max-norm of a vector."""
    return wp.max(wp.max(wp.abs(k[0]), wp.abs(k[1])), wp.max(wp.abs(k[2]), wp.abs(k[3])))


@wp.func
def curve_class(k: wp.vec4d, bound: wp.float64) -> int:
    """Returns how many extrema a cubic has in [0, 1]: MONOTONE, ONE_EXTREMUM, TWO_EXTREMA, or UNKNOWN.

    The derivative is a quadratic with coefficients d. If its ends differ in sign, it has one root, with or without
    inflection (the paper splits at every inflection, but only two extrema need it). If they agree, it has none where d1
    agrees as well or the discriminant d1^2 - d0 d2 is negative.

    Bounds: of a difference, 2E and a rounding of size 2k; of the discriminant, 4 * 2.5E d for d the largest
    difference, 10E^2 <= 4E d, and roundings of size d^2 <= 2kd: below 24E d, apart from underflow.
    """
    d0 = k[1] - k[0]
    d1 = k[2] - k[1]
    d2 = k[3] - k[2]
    s0 = certified_sign(d0, _DIFFERENCE * bound)
    s1 = certified_sign(d1, _DIFFERENCE * bound)
    s2 = certified_sign(d2, _DIFFERENCE * bound)
    if s0 * s2 < 0:
        return ONE_EXTREMUM
    if s0 * s2 == 0:
        return UNKNOWN
    if s1 == s0:
        return MONOTONE
    size = wp.max(wp.abs(d0), wp.max(wp.abs(d1), wp.abs(d2)))
    if d1 * d1 - d0 * d2 < -bound * (_DISCRIMINANT * size + UNDERFLOW):
        return MONOTONE
    return wp.where(s1 == -s0, TWO_EXTREMA, UNKNOWN)


@wp.func
def count_roots(k: wp.vec4d, bound: wp.float64, shape: int) -> int:
    """Returns the number of roots in [0, 1] of a MONOTONE or ONE_EXTREMUM cubic: 0, 1, 2, or UNKNOWN (Figure 3).

    The sign at the extremum t, the root of Y' = H with Bernstein coefficients d, decides between none and two. There Y
    is the quadratic G = (k0, k1, k2) as well, because Y(t) = (1 - t) G(t) + t (G + H)(t) and H(t) = 0. Eliminating the
    leading coefficient gives A Y = T with A = e1 - e0 and T linear: T_0 = A k0 - e0 d0, T_1 = A k3 - e1 d2; sign
    determination for T against H then gives the sign of T at t. Where A is small, T vanishes with it, but then H is
    nearly its chord, which differs from H by |A| / 4 at most, and Y at the root t' of the chord is close: with s =
    |d0| + |d2|, |t - t'| <= |A| / 4s, and |Y'| = 3 |H| <= 3 |A| / 2 between, so that |Y(t) - Y(t')| <= 3/8 A^2 / s.

    Bounds: the cubic with the computed coefficients is within E of Y on [0, 1], so it suffices that its sign at its own
    extremum exceeds E; its differences have roundings only (a sixth of E against s >= 5E), hence 7/16 for 3/8. Of
    A, 10E; of T, with e within 4.6E and E <= k: (10 + 8 + 10) E k + (4 * 2.2 + 2 * 4.6 + 10.2) E k and roundings of
    size 32k^2, 2.5E k: below 64E k, apart from underflow. Of H at the root of T, as in :func:`linear_signs`.
    """
    end_signs = certified_sign(k[0], bound) * certified_sign(k[3], bound)
    if end_signs < 0:
        return 1
    if end_signs == 0:
        return UNKNOWN
    if shape == MONOTONE:
        return 0
    start = certified_sign(k[0], bound)
    d0 = k[1] - k[0]
    d1 = k[2] - k[1]
    d2 = k[3] - k[2]
    if certified_sign(d0, _DIFFERENCE * bound) == start:
        return 0  # Y moves away from zero before it turns
    a = wp.abs(d0)
    b = wp.abs(d2)
    sum = a + b
    leading = (d2 - d1) - (d1 - d0)
    spread = wp.abs(leading) + _TURNING * bound
    value = evaluate_cubic(k, a, b)
    rounding = TWO * bound * sum * sum * sum + UNDERFLOW * bound
    deviation = _SEVEN * (_QUARTER * spread) * (_QUARTER * spread) * sum * sum
    if certified_sign(value, rounding) == -start:
        return 2  # a witness between the ends
    if certified_sign(value, rounding + deviation) == start:
        return 0
    size = largest(k)
    t0 = leading * k[0] - (d1 - d0) * d0
    t1 = leading * k[3] - (d2 - d1) * d2
    t_bound = bound * (_TURNING * size + UNDERFLOW)
    s0 = certified_sign(t0, t_bound)
    s1 = certified_sign(t1, t_bound)
    at_extremum = wp.where(s0 == s1, s0, 0)
    if s0 * s1 < 0:
        # H changes sign once: its sign at the root of T tells on which side of the root of H that lies
        ta = wp.abs(t0)
        tb = wp.abs(t1)
        side_bound = (ta + tb) * (_SIX * bound * (ta + tb) + _SLOPE_CROSSING * size * t_bound) + UNDERFLOW * bound
        side = certified_sign(evaluate_quadratic(wp.vec3d(d0, d1, d2), ta, tb), side_bound)
        if side != 0:
            at_extremum = wp.where(side == certified_sign(d0, bound), s1, s0)
    at_extremum = at_extremum * certified_sign(leading, _TURNING * bound)
    if at_extremum == start:
        return 0
    return wp.where(at_extremum == -start, 2, UNKNOWN)


@wp.func
def linear_signs(
    line: wp.vec2d, line_bound: wp.float64, k: wp.vec4d, bound: wp.float64, size: wp.float64, roots: int
) -> wp.vec2i:
    """Returns the signs of a line at the first and the last root of Y (Sign Determination Theorems I and II).

    If the line's ends have opposite signs, its root is t' = a / (a + b) with a = |l0|, b = |l1|. The sign of Y(t')
    tells on which side of the roots of Y it lies or, if Y has two roots and t' is not between them, the sign of Y'(t')
    does. Any function that stays within ``line_bound`` = F of the line may replace the line: it has the line's sign
    beyond the roots of all lines with ends within F.

    Bound of Y(t') times (a + b)^3: Y is known to within E, with roundings 2E; moving the ends by F moves t' by at most
    F / (a + b - 2F), along a cubic whose computed coefficients give it a slope of at most 6k, and a sign that is
    certain in spite of 8k F / (a + b) implies 8F < a + b, which makes 8k F / (a + b) enough. Of Y'(t') / 3 likewise:
    5E, and for a slope of at most 8k, 16k F / (a + b). If one end's sign is uncertain, its exact value is at most 2F.
    With the other end b >= 8F, the roots of all these lines lie at 2F / (F + b) <= 4F / (4F + b) at most: a = 4F takes
    their place, and only the other end's sign can follow.
    """
    s0 = certified_sign(line[0], line_bound)
    s1 = certified_sign(line[1], line_bound)
    if s0 == s1:
        return wp.vec2i(s0, s0)
    a = wp.where(s0 == 0, FOUR * line_bound, wp.abs(line[0]))
    b = wp.where(s1 == 0, FOUR * line_bound, wp.abs(line[1]))
    if s0 * s1 == 0 and wp.max(a, b) < _EIGHT * line_bound:
        return wp.vec2i(0, 0)
    sum = a + b
    square = sum * sum
    start = certified_sign(k[0], bound)
    y_bound = square * (TWO * bound * sum + _CROSSING * size * line_bound) + UNDERFLOW * bound
    side = certified_sign(evaluate_cubic(k, a, b), y_bound) * start
    if side == 0:
        return wp.vec2i(0, 0)
    if roots == 1:
        return wp.where(side > 0, wp.vec2i(s1, s1), wp.vec2i(s0, s0))
    if side < 0:
        return wp.vec2i(s0, s1)
    d = wp.vec3d(k[1] - k[0], k[2] - k[1], k[3] - k[2])
    slope_bound = sum * (TWO * _DIFFERENCE * bound * sum + _SLOPE_CROSSING * size * line_bound) + UNDERFLOW * bound
    slope = certified_sign(evaluate_quadratic(d, a, b), slope_bound)
    # Y returns towards zero between its ends: before the extremum its slope has the sign opposite to its own
    before = slope * start
    if before == 0:
        return wp.vec2i(0, 0)
    return wp.where(before < 0, wp.vec2i(s1, s1), wp.vec2i(s0, s0))


@wp.func
def quadratic_signs(
    q: wp.vec3d, q_bound: wp.float64, k: wp.vec4d, bound: wp.float64, size: wp.float64, roots: int
) -> wp.vec2i:
    """Returns the signs of a quadratic at the first and the last root of Y (Sec. 4.2).

    It makes three attempts: the sign of all its coefficients; its chord, from which it differs by D t (1 - t), at most
    |D| / 4, with D = q0 - 2 q1 + q2; and the division D^2 Y = L q + K, by which q = -K / L at a root of Y.

    Bounds, of the differences d, e and the leading coefficients D, A of q and Y: 2.5F, 5E, 6F, 11E, with |d| <= 2q,
    |e| <= 4k, |D| <= 4q, |A| <= 8k and, where a sign is certain at all, E <= k and F <= q. Of L = 3 e D - 2 d A, of
    size 80kq: 3 (4k 6F + 4q 5E + 30EF) + 2 (2q 11E + 8k 2.5F + 28EF) = 112kF + 104qE + 146EF and roundings: 288 (kF
    + qE). Of K = D^2 Y - L q, of size 96q^2 k: 84qF k + 16q^2 E + 84qF E for the first term, (258kF + 104qE) (q +
    F) + 80kq F for the second, and roundings: 896 q (kF + qE).
    """
    constant = certified_sign_quadratic(q, q_bound)
    if constant != 0:
        return wp.vec2i(constant, constant)
    chord_bound = q_bound + _QUARTER * (wp.abs((q[2] - q[1]) - (q[1] - q[0])) + _SIX * q_bound)
    signs = linear_signs(wp.vec2d(q[0], q[2]), chord_bound, k, bound, size, roots)
    if signs[0] != 0 and signs[1] != 0:
        return signs
    factor, remainder = divide_cubic(k, q)
    q_size = wp.max(wp.abs(q[0]), wp.max(wp.abs(q[1]), wp.abs(q[2])))
    unit = size * q_bound + q_size * bound
    factor_bound = _DIVISION_L * unit + UNDERFLOW * bound
    remainder_bound = _DIVISION_K * q_size * unit + UNDERFLOW * bound
    factor_signs = linear_signs(factor, factor_bound, k, bound, size, roots)
    remainder_signs = linear_signs(remainder, remainder_bound, k, bound, size, roots)
    return wp.vec2i(
        wp.where(signs[0] != 0, signs[0], -factor_signs[0] * remainder_signs[0]),
        wp.where(signs[1] != 0, signs[1], -factor_signs[1] * remainder_signs[1]),
    )
