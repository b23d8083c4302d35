"""Signs and order of algebraic numbers: roots of quadratics and cubics, in exact integers (Sec. 4.1 and 4.2).

Polynomials over the step are functions of z = t / (1 - t), which maps the inside of the step to z > 0: the Bernstein
coefficients of a cubic times 1, 3, 3, 1 are its coefficients in z, and the sign of its value is the same. The ends
t = 0 and t = 1 are z = 0 and infinity, where the polynomial has the signs of its first and last coefficient.

**Number of positive roots.** By Descartes' rule it is the number of sign changes along the coefficients, or less by an
even number. So 0 and 1 changes give the number. With two or three changes a cubic has at most one or no negative root:
if its discriminant is not negative, all roots are real, with multiplicity, and otherwise two are not.

**Sign at a root of a quadratic** q = c0 + c1 z + a z^2. Division gives a^2 P = L q + K with K = K1 z + K0 linear; the
sign of P at a root is that of K. Let g = a P - p3 z q, quadratic. Then

    K1 = a g1 - c1 g2,  K0 = a g0 - c0 g2,  K1^2 q(-K0 / K1) = a (K0^2 - K1 J)  with J = c1 g0 - c0 g1,

because c1 K0 - c0 K1 = a J. The sign of q at the root -K0 / K1 of K, and the side of the turning point -c1 / 2a that
it is on, tell where that root lies. Division of q(-K0 / K1) by the leading factor a leaves the degree in the
coefficients that the resultant of P and g has, the smallest possible apart from a.

If a = 0, substituting 1 / z for z exchanges the two ends of all polynomials, and q has one positive root at most.

**Order of a point and the roots of a cubic** (or quadratic) f whose roots a1 <= a2 <= a3 are real: with the sign of f
at infinity positive, f rises to a maximum, falls to a minimum and rises again, one root on each piece. The signs of f'
and f'' at a point tell on which piece it is (Thom's encoding), and the sign of f on which side of the root there. A
quadratic is a cubic without the first piece, with a1 at minus infinity. So the signs of f, f' and f'' at the roots of q
tell the order of the roots of f and of q, and hence the sign of q at the roots of f.

Widths: with coefficients of q below 2^(2B+2), the outer ones below 2^(2B+1), and of P below 2^(3B+5), as those of
:mod:`polygon` are, which derives the constants, g is below 2^(5B+6), K and J are below 2^(7B+9), and K0^2 - K1 J is
below 2^(14B+17).
"""

from typing import Any

import warp as wp

from ..not_inlined import NOT_INLINED
from .filters import (
    UNKNOWN,
    near_cubic_discriminant,
    near_quadratic_discriminant,
    near_sign_at_time,
    near_signs_at_roots,
)
from .wide_integers import add, minor, product, shift, sign, subtract, times, widen

_2 = wp.constant(wp.uint64(2))
_3 = wp.constant(wp.uint64(3))
_4 = wp.constant(wp.uint64(4))
_9 = wp.constant(wp.uint64(9))


@wp.func
def sign_changes(s0: int, s1: int, s2: int, s3: int) -> int:
    """Returns how often the sign changes along a sequence, without its zeros."""
    last = s0
    changes = wp.where(s1 * last < 0, 1, 0)
    last = wp.where(s1 != 0, s1, last)
    changes += wp.where(s2 * last < 0, 1, 0)
    last = wp.where(s2 != 0, s2, last)
    return changes + wp.where(s3 * last < 0, 1, 0)


@wp.func
def last_sign(s0: int, s1: int, s2: int, s3: int) -> int:
    """Returns the last sign of a sequence that is not zero: that of a polynomial beyond its largest root."""
    return wp.where(s3 != 0, s3, wp.where(s2 != 0, s2, wp.where(s1 != 0, s1, s0)))


@wp.func(**NOT_INLINED)
def count_quadratic_roots(c0: Any, c1: Any, c2: Any) -> int:
    """Returns the number of positive roots of a quadratic, with multiplicity: 0, 1 or 2; 0 for the zero polynomial."""
    changes = sign_changes(sign(c0), sign(c1), sign(c2), 0)
    if changes == 2:
        discriminant = near_quadratic_discriminant(c0, c1, c2)
        if discriminant == 0:
            discriminant = sign(minor(c1, c1, times(c0, _4), c2))
        return wp.where(discriminant >= 0, 2, 0)
    return changes


@wp.func(**NOT_INLINED)
def count_cubic_roots(c0: Any, c1: Any, c2: Any, c3: Any) -> int:
    """Returns the number of positive roots of a cubic, with multiplicity: 0 to 3; 0 for the zero polynomial.

    The discriminant is (4 h0 h2 - h1^2) / 3 with the coefficients h of the Hessian. It is homogeneous: a cubic whose
    first or last coefficients are zero has roots at 0 or at infinity, and its discriminant has the sign of that of the
    other roots.
    """
    changes = sign_changes(sign(c0), sign(c1), sign(c2), sign(c3))
    if changes < 2:
        return changes
    discriminant = near_cubic_discriminant(c0, c1, c2, c3)
    if discriminant == 0:
        h0 = minor(c1, c1, times(c0, _3), c2)
        h1 = minor(c1, c2, times(c0, _9), c3)
        h2 = minor(c2, c2, times(c1, _3), c3)
        discriminant = sign(minor(times(h0, _4), h2, h1, h1))
    return wp.where(discriminant >= 0, changes, changes - 2)


@wp.func
def remainder(p0: Any, p1: Any, p2: Any, p3: Any, q0: Any, q1: Any, q2: Any):
    """Returns K0, K1 and J of the module docstring, for the cubic P and the quadratic q."""
    g0 = product(q2, p0)
    g1 = minor(q2, p1, p3, q0)
    g2 = minor(q2, p2, p3, q1)
    return minor(g0, q2, g2, q0), minor(g1, q2, g2, q1), minor(g0, q1, g1, q0)


@wp.func(**NOT_INLINED)
def _signs_at_roots(p0: Any, p1: Any, p2: Any, p3: Any, c0: Any, c1: Any, a: Any, roots: int) -> wp.vec2i:
    """Returns :func:`signs_at_roots` of a quadratic whose leading coefficient a is not zero."""
    near = near_signs_at_roots(p0, p1, p2, p3, c0, c1, a, roots)
    if near != UNKNOWN:
        return wp.vec2i((near + 4) // 3 - 1, (near + 4) % 3 - 1)
    k0, k1, j = remainder(p0, p1, p2, p3, c0, c1, a)
    s0 = sign(k0)
    s1 = sign(k1)
    if s0 * s1 >= 0:
        s = wp.where(s1 != 0, s1, s0)
        return wp.vec2i(s, s)
    inside = sign(minor(k0, k0, k1, j))  # negative where the root of K lies between the roots of q
    if roots == 1:  # the other root is not positive
        return wp.vec2i(-inside * s1, -inside * s1)
    if inside < 0:
        return wp.vec2i(-s1, s1)
    # which side of the turning point the root of K is on
    side = sign(minor(widen(c1), k1, widen(times(a, _2)), k0)) * sign(a) * s1
    if inside > 0:
        return wp.vec2i(-side * s1, -side * s1)
    return wp.vec2i(wp.where(side > 0, -s1, 0), wp.where(side < 0, s1, 0))


@wp.func
def signs_at_roots(p0: Any, p1: Any, p2: Any, p3: Any, c0: Any, c1: Any, c2: Any, roots: int) -> wp.vec2i:
    """Returns the signs of a cubic P at the positive roots of a quadratic q, the smaller one first; of one root, twice.

    Args:
        p0: Constant coefficient of P.
        p1: Coefficient of z in P.
        p2: Coefficient of z^2 in P.
        p3: Coefficient of z^3 in P.
        c0: Constant coefficient of q.
        c1: Coefficient of z in q.
        c2: Coefficient of z^2 in q.
        roots: Number of positive roots of q, with multiplicity, 1 or 2.
    """
    if sign(c2) != 0:
        return _signs_at_roots(p0, p1, p2, p3, c0, c1, c2, roots)
    return _signs_at_roots(p3, p2, p1, p0, c2, c1, c0, roots)


@wp.func
def order(roots: int, value: int, slope: int, bend: int) -> wp.vec3i:
    """Returns the signs of the point minus each of the roots a1 <= a2 <= a3 of a cubic.

    Args:
        roots: Number of positive roots, which are the last ones, with multiplicity. If it is one, ``slope`` and
            ``bend`` have no effect.
        value: Sign of the cubic at the point, times its sign at infinity.
        slope: Sign of its derivative there, times the same.
        bend: Sign of its second derivative there, times the same.
    """
    if roots == 1:
        return wp.vec3i(1, 1, value)
    if value == 0 and slope == 0:
        return wp.vec3i(wp.where(bend > 0, 1, 0), 0, wp.where(bend < 0, -1, 0))
    if slope > 0:
        if bend < 0:
            return wp.vec3i(value, -1, -1)
        return wp.vec3i(1, 1, value)
    return wp.vec3i(1, -value, -1)


@wp.func
def signs_at_cubic_roots(
    c0: Any, c1: Any, c2: Any, turns: int, v0: Any, v1: Any, v2: Any, v3: Any, roots: int
) -> wp.vec3i:
    """Returns the signs of a quadratic q at the roots a1 <= a2 <= a3 of a cubic, valid at the positive ones, the last.

    Args:
        c0: Constant coefficient of q.
        c1: Coefficient of z in q.
        c2: Coefficient of z^2 in q.
        turns: Number of positive roots of q, with multiplicity.
        v0: Constant coefficient of the cubic.
        v1: Coefficient of z in the cubic.
        v2: Coefficient of z^2 in the cubic.
        v3: Coefficient of z^3 in the cubic.
        roots: Number of positive roots of the cubic, with multiplicity, at least 1.
    """
    s = last_sign(sign(c0), sign(c1), sign(c2), 0)
    signs = wp.vec3i(s, s, s)
    if turns == 0:
        return signs
    end = last_sign(sign(v0), sign(v1), sign(v2), sign(v3))
    value = end * signs_at_roots(v0, v1, v2, v3, c0, c1, c2, turns)
    slope = wp.vec2i(0, 0)
    bend = wp.vec2i(0, 0)
    if roots > 1:
        zero = subtract(v0, v0)
        slope = end * signs_at_roots(v1, times(v2, _2), times(v3, _3), zero, c0, c1, c2, turns)
        bend = end * signs_at_roots(v2, times(v3, _3), zero, zero, c0, c1, c2, turns)
    # beyond all roots of q its sign is the last one, and it changes at each root
    signs = wp.cw_mul(signs, -order(roots, value[0], slope[0], bend[0]))
    if turns == 2:
        signs = wp.cw_mul(signs, -order(roots, value[1], slope[1], bend[1]))
    return signs


@wp.func(**NOT_INLINED)
def _sign_at_time(p0: Any, p1: Any, p2: Any, p3: Any, time: wp.uint64, digits: int) -> int:
    """Returns the sign of a cubic in z at t = time / 2^digits, by Horner's rule in t."""
    near = near_sign_at_time(p0, p1, p2, p3, time, digits)
    if near != 0:
        return near
    m1 = subtract(p1, times(p0, _3))
    m2 = add(subtract(p2, times(p1, _2)), times(p0, _3))
    m3 = subtract(add(p3, p1), add(p2, p0))
    value = add(times(widen(m3), time), shift(widen(m2), digits))
    value = add(times(value, time), shift(widen(m1), 2 * digits))
    return sign(add(times(value, time), shift(widen(p0), 3 * digits)))


@wp.func(**NOT_INLINED)
def root_time(c0: Any, c1: Any, c2: Any, c3: Any, roots: int, index: int, digits: int) -> wp.float64:
    """Returns the last multiple of 2^-digits that is not after a root of a cubic, as a time t in [0, 1).

    With coefficients below 2^(3B+5), all integers here are below 2^(3B+9+3 digits).

    Args:
        c0: Constant coefficient of the cubic.
        c1: Coefficient of z in the cubic.
        c2: Coefficient of z^2 in the cubic.
        c3: Coefficient of z^3 in the cubic.
        roots: Number of its positive roots, with multiplicity.
        index: Index of the root among a1 <= a2 <= a3, from 0; the positive roots are the last ones.
        digits: Binary digits of the time, at most 38.
    """
    end = last_sign(sign(c0), sign(c1), sign(c2), sign(c3))
    zero = subtract(c0, c0)
    low = wp.uint64(0)
    high = wp.uint64(1) << wp.uint64(digits)
    while high - low > wp.uint64(1):
        time = (low + high) >> wp.uint64(1)
        slope = int(0)
        bend = int(0)
        if roots > 1:
            slope = end * _sign_at_time(c1, times(c2, _2), times(c3, _3), zero, time, digits)
            bend = end * _sign_at_time(c2, times(c3, _3), zero, zero, time, digits)
        place = order(roots, end * _sign_at_time(c0, c1, c2, c3, time, digits), slope, bend)
        if place[index] <= 0:
            low = time
        else:
            high = time
    return wp.float64(low) / wp.float64(wp.uint64(1) << wp.uint64(digits))
