"""Certified signs of floating-point results (Sec. 4.3 and supplement, Sec. 2, with absolute values throughout).

Every computed number comes with a **bound** on its distance from the exact value; its sign is certain where its
absolute value exceeds the bound. Bounds have the form

    c * roundoff * (the same expression in absolute values) + UNDERFLOW * roundoff,

valid to first order in the roundoff for every order of evaluation and with or without fused multiply-add (fusing only
leaves a rounding out); the constants c are rounded up by enough to cover the terms of second order. The docstring of
each function derives its bound. Because a query is scaled to coordinates below 2, no product overflows, and underflow
changes far less than the UNDERFLOW that bounds add: 2^-1074 in a product, or 2^-1022 in an operation of a processor
that flushes subnormal numbers to zero. Rounding is to nearest.

With ``roundoff = 0`` all bounds are zero, and signs are those that floating point computes: the paper's BSC-float.
"""

import warp as wp

FREE = wp.constant(0)
"""Status of a query: certainly no contact."""
HIT = wp.constant(1)
"""Status of a query: certainly contact."""
UNSURE = wp.constant(2)
"""Status of a query: floating point certifies neither."""

ROUNDOFF = wp.constant(wp.float64(2.0**-53))
"""Unit roundoff of double precision, for certified signs."""
UNDERFLOW = wp.constant(wp.float64(1.0e-140))
"""Every bound adds this times the roundoff, or times a bound, which is at least as large. The underflow of an operation
is far below 1e-296: 2^-1022."""

ZERO, HALF, ONE, TWO, THREE, FOUR = (wp.constant(wp.float64(x)) for x in (0.0, 0.5, 1.0, 2.0, 3.0, 4.0))
"""Numbers in double precision, as kernels need them."""


@wp.func
def certified_sign(value: wp.float64, bound: wp.float64) -> int:
    """Returns the sign of a number known to within ``bound``: 1 or -1 where it is certain, 0 where it is not."""
    return int(value > bound) - int(value < -bound)


@wp.func
def certified_sign_quadratic(q: wp.vec3d, bound: wp.float64) -> int:
    """Returns the certain sign that all Bernstein coefficients share, hence the quadratic on [0, 1]; 0 if none."""
    low = wp.min(q[0], wp.min(q[1], q[2]))
    high = wp.max(q[0], wp.max(q[1], q[2]))
    return int(low > bound) - int(high < -bound)


@wp.func
def certified_sign_cubic(k: wp.vec4d, bound: wp.float64) -> int:
    """Returns the certain sign that all Bernstein coefficients share, hence the cubic on [0, 1]; 0 if none."""
    low = wp.min(wp.min(k[0], k[1]), wp.min(k[2], k[3]))
    high = wp.max(wp.max(k[0], k[1]), wp.max(k[2], k[3]))
    return int(low > bound) - int(high < -bound)
