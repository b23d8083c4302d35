"""Bernstein sign classification with the paper's own inside tests, reduced to degree two by elimination (paper, 3.5).

Multiples of the coplanarity cubic Y reduce a test m . n >= 0, of degree four in t, by two degrees: t^2 P = k0^2 m . n
modulo Y (supplement, 1, equations 18 to 23). P is of degree ten in the coordinates, and identically zero where k0 is.

Everything else, classes of curves, root counts and signs at roots, is :mod:`warp_bsc.kernels.classification`, so that
results differ by the inside tests alone.
"""

import warp as wp

from ....kernels.classification import classify_with
from ....kernels.polynomials import VERTEX_FACE, Coplanarity, InsideTests, Motion, cross_middle
from ....kernels.signs import FOUR, FREE, HALF, THREE, TWO, certified_sign_cubic


@wp.func
def _reduce(k: wp.vec4d, l0: wp.float64, l1: wp.float64, l2: wp.float64, l3: wp.float64, l4: wp.float64) -> wp.vec3d:
    """Returns P from Y and a quartic with Bernstein coefficients l (supplement 1, equations 20 and 23)."""
    s0 = FOUR * l1 * k[0] - l0 * (k[0] + THREE * k[1])
    s1 = TWO * l2 * k[0] - l0 * (k[1] + k[2])
    s2 = (FOUR * l3 * k[0] - l0 * (THREE * k[2] + k[3])) / THREE
    s3 = l4 * k[0] - l0 * k[3]
    return wp.vec3d(
        THREE * (s1 * k[0] - s0 * k[1]),
        THREE * HALF * (s2 * k[0] - s0 * k[2]),
        s3 * k[0] - s0 * k[3],
    )


@wp.func
def _reduced_test(y: Coplanarity, sign: wp.float64, x0: wp.vec3d, x1: wp.vec3d, y0: wp.vec3d, y1: wp.vec3d) -> wp.vec3d:
    """Returns P of the test sign (x cross y) . n >= 0 (paper, inequality 12 and supplement 1)."""
    m0 = sign * wp.cross(x0, y0)
    mh = sign * cross_middle(x0, x1, y0, y1)
    m1 = sign * wp.cross(x1, y1)
    return _reduce(
        y.k,
        wp.dot(m0, y.n0),
        HALF * (wp.dot(m0, y.nh) + wp.dot(mh, y.n0)),
        (wp.dot(m0, y.n1) + FOUR * wp.dot(mh, y.nh) + wp.dot(m1, y.n0)) / wp.float64(6.0),
        HALF * (wp.dot(mh, y.n1) + wp.dot(m1, y.nh)),
        wp.dot(m1, y.n1),
    )


@wp.func
def reduced_inside_tests(motion: Motion, y: Coplanarity) -> InsideTests:
    """Returns the paper's inside tests, quadratics that are not negative at contact, without error bounds.

    Vertex-face: three (paper, inequality 12), and a constant for the fourth. Edge-edge: four, with n = u x
    v, because the three of the supplement (3) say nothing of one end of the second edge.
    """
    tests = InsideTests()
    plus = wp.float64(1.0)
    minus = wp.float64(-1.0)
    u0 = motion.u0
    u1 = motion.u1
    v0 = motion.v0
    v1 = motion.v1
    w0 = motion.w0
    w1 = motion.w1
    if motion.kind == VERTEX_FACE:
        # (b - p) x (c - p), (c - p) x (a - p), (a - p) x (b - p)
        tests.q0 = _reduced_test(y, plus, u0 - w0, u1 - w1, v0 - w0, v1 - w1)
        tests.q1 = _reduced_test(y, minus, v0 - w0, v1 - w1, w0, w1)
        tests.q2 = _reduced_test(y, plus, u0 - w0, u1 - w1, w0, w1)
        tests.q3 = wp.vec3d(plus, plus, plus)
    else:
        # with n = u x v: s n = w x v, (1 - s) n = (u - w) x v, r n = w x u, (1 - r) n = -(w + v) x u
        tests.q0 = _reduced_test(y, plus, w0, w1, v0, v1)
        tests.q1 = _reduced_test(y, plus, u0 - w0, u1 - w1, v0, v1)
        tests.q2 = _reduced_test(y, plus, w0, w1, u0, u1)
        tests.q3 = _reduced_test(y, minus, w0 + v0, w1 + v1, u0, u1)
    return tests


@wp.func
def classify_reduced(motion: Motion, y: Coplanarity) -> int:
    """Status of a query as :func:`warp_bsc.kernels.classification.classify` finds it, by the paper's inside tests.

    Of a motion with roundoff 0: the signs are those that floating point computes.
    """
    if certified_sign_cubic(y.k, y.bound) != 0:
        return FREE
    return classify_with(y.k, y.bound, reduced_inside_tests(motion, y))
