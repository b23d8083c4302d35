"""Certified signs: what floating point may decide (paper, 4.3 and supplement 2, with absolute values throughout).

Every number that is computed here comes with a **bound** on its distance from the exact value, and its sign is certain
where it exceeds the bound. Bounds have the form

    c * roundoff * (the same expression in absolute values) + UNDERFLOW * roundoff,

valid to first order in the roundoff for every order of evaluation and with or without fused multiply-add (fusing only
leaves a rounding out); the constants c are rounded up by enough to cover the terms of second order. Each function
derives its own bound where it computes it. Because a query is scaled to coordinates below 2, no product overflows, and
what underflows is far below the UNDERFLOW that bounds add: 2^-1074 a product, or 2^-1022 an operation where another
library has told the processor to flush subnormal numbers to zero. Rounding is to nearest.

With ``roundoff = 0`` all bounds are zero: the signs that floating point computes, which is the paper's BSC-float.
"""

import warp as wp

FREE = wp.constant(0)
"""Status of a query: certainly no contact."""
HIT = wp.constant(1)
"""Status of a query: certainly contact."""
UNSURE = wp.constant(2)
"""Status of a query: floating point certifies neither."""

ROUNDOFF = wp.constant(wp.float64(2.0**-53))
"""Unit roundoff of double precision, with which signs are certified."""
UNDERFLOW = wp.constant(wp.float64(1.0e-140))
"""What every bound adds, times the roundoff, or times a bound, which is at least that: 1e-296 is still far above what
operations lose to underflow, 2^-1022 each."""


@wp.func
def certified_sign(value: wp.float64, bound: wp.float64) -> int:
    """Sign of a number known to within ``bound``: 1 or -1 where it is certain, 0 where it is not."""
    return int(value > bound) - int(value < -bound)


@wp.func
def certified_sign_quadratic(q: wp.vec3d, bound: wp.float64) -> int:
    """The one certain sign of all Bernstein coefficients, hence of the quadratic on [0, 1]; 0 where there is none."""
    low = wp.min(q[0], wp.min(q[1], q[2]))
    high = wp.max(q[0], wp.max(q[1], q[2]))
    return int(low > bound) - int(high < -bound)


@wp.func
def certified_sign_cubic(k: wp.vec4d, bound: wp.float64) -> int:
    """The one certain sign of all Bernstein coefficients, hence of the cubic on [0, 1]; 0 where there is none."""
    low = wp.min(wp.min(k[0], k[1]), wp.min(k[2], k[3]))
    high = wp.max(wp.max(k[0], k[1]), wp.max(k[2], k[3]))
    return int(low > bound) - int(high < -bound)
