"""Polynomials of a query: coplanarity and inside tests in Bernstein form, with error bounds (Sec. 3.4 and 3.5).

One form serves both queries. Vertex p against triangle a b c: u = b - a, v = c - a, w = p - a. Edge a b against edge
c d: u = b - a, v = d - c, w = c - a. Each is linear in t, so the normal n = u x v is quadratic and the coplanarity
Y = w . n is cubic; the four points lie in one plane exactly when Y = 0.

The inside tests are **components** of cross products, quadratics too. At a root of Y with n != 0, w lies in the plane
of u and v, and w x v, u x w, w x u are multiples of n:

- vertex-face: p = a + beta u + gamma v with beta n = w x v and gamma n = u x w;
- edge-edge: a + s u = c + r v with s n = w x v and r n = w x u.

So for an axis i with n_i != 0, contact needs one weak sign of (w x v)_i, (u x w)_i and n_i - (w x v)_i - (u x w)_i;
or of (w x v)_i, n_i - (w x v)_i, (w x u)_i and n_i - (w x u)_i. This is the paper's test m . n >= 0 without its
degree four in t and without the factor k0^2 that its reduction to degree two costs, which vanishes for resting
contact.

Certified signs decide contact for **any** axis and at any time at which Y = 0 (n = 0 included):

- two of these quadratics have strictly opposite signs: no contact at that time. If n != 0, all are multiples of n_i
  with factors that contact makes nonnegative. If n = 0, then n_i = 0 and contact makes all of them zero: the two edges
  of the collapsed triangle are parallel to w, or the edges lie on one line;
- all have one strict sign: contact, because n_i, the sum of some of them, is not zero.
"""

import warp as wp

from .signs import HALF, TWO, UNDERFLOW

VERTEX_FACE = wp.constant(0)
EDGE_EDGE = wp.constant(1)
VERTEX_EDGE = wp.constant(2)
"""Kind of a query with a minimum distance: its motion is that of a vertex and the collapsed triangle a b a."""
VERTEX_VERTEX = wp.constant(3)
"""Kind of a query with a minimum distance: its motion is that of a vertex and the collapsed triangle q q q."""

_THIRD = wp.constant(wp.float64(1.0 / 3.0))
COPLANARITY_ERROR = wp.constant(wp.float64(14.0))
PRODUCT_ERROR = wp.constant(wp.float64(6.0))
DIFFERENCE_ERROR = wp.constant(wp.float64(7.0))
REMAINDER_ERROR = wp.constant(wp.float64(8.0))


@wp.struct
class Motion:
    """Relative motion of the four points of a query, scaled so that the largest coordinate lies in [1, 2)."""

    u0: wp.vec3d
    u1: wp.vec3d
    v0: wp.vec3d
    v1: wp.vec3d
    w0: wp.vec3d
    w1: wp.vec3d
    u_size: wp.vec3d  # largest absolute value of each component over both ends
    v_size: wp.vec3d
    w_size: wp.vec3d
    kind: int  # VERTEX_FACE or EDGE_EDGE
    roundoff: wp.float64  # ROUNDOFF, or 0 for the signs that floating point computes
    size: wp.float64  # the largest coordinate before scaling
    scale: wp.float64  # factor of the scaling, a power of two; 0 where gradients are out of range


@wp.struct
class Coplanarity:
    """The cubic Y, the bound on the error of its coefficients, and the Bernstein coefficients of the normal n."""

    k: wp.vec4d
    bound: wp.float64
    n0: wp.vec3d
    nh: wp.vec3d
    n1: wp.vec3d


@wp.struct
class InsideTests:
    """The four quadratics that share a weak sign at contact, and the bounds on the errors of their coefficients."""

    q0: wp.vec3d
    q1: wp.vec3d
    q2: wp.vec3d
    q3: wp.vec3d
    bounds: wp.vec4d


@wp.func
def cross_middle(x0: wp.vec3d, x1: wp.vec3d, y0: wp.vec3d, y1: wp.vec3d) -> wp.vec3d:
    """Returns the middle Bernstein coefficient of x(t) cross y(t): the paper's n-hat, without its cancellation."""
    return HALF * (wp.cross(x0, y1) + wp.cross(x1, y0))


@wp.func
def cross_size(x: wp.vec3d, y: wp.vec3d) -> wp.vec3d:
    """Returns bounds on the components of a cross product, from the sizes of the components of its factors."""
    return wp.vec3d(x[1] * y[2] + x[2] * y[1], x[2] * y[0] + x[0] * y[2], x[0] * y[1] + x[1] * y[0])


@wp.func
def coplanarity(motion: Motion) -> Coplanarity:
    """Returns Y(t) = w . n as a cubic in Bernstein form (Eq. 11).

    Bound, with r the roundoff and P the determinant of the sizes of u, v, w with all six terms added (their
    permanent), which bounds every k: the components of u, v, w have one rounding each. A component of n sums at
    most four products, halved, each with at most 2 + 1 + 2 roundings. Y's k1 sums nine products w n, over three,
    with 5 roundings of n, 1 of w, 1 of the product, 3 of the sums and 2 of the third: 12r P.
    """
    y = Coplanarity()
    y.n0 = wp.cross(motion.u0, motion.v0)
    y.nh = cross_middle(motion.u0, motion.u1, motion.v0, motion.v1)
    y.n1 = wp.cross(motion.u1, motion.v1)
    y.k = wp.vec4d(
        wp.dot(motion.w0, y.n0),
        (TWO * wp.dot(motion.w0, y.nh) + wp.dot(motion.w1, y.n0)) * _THIRD,
        (TWO * wp.dot(motion.w1, y.nh) + wp.dot(motion.w0, y.n1)) * _THIRD,
        wp.dot(motion.w1, y.n1),
    )
    size = wp.dot(motion.w_size, cross_size(motion.u_size, motion.v_size))
    y.bound = motion.roundoff * (COPLANARITY_ERROR * size + UNDERFLOW)
    return y


@wp.func
def component(x: wp.vec3d, axis: int) -> wp.float64:
    """Returns x[axis] by selection: a variable index would put x into local memory on a GPU."""
    return wp.where(axis == 0, x[0], wp.where(axis == 1, x[1], x[2]))


@wp.func
def _cross_component(x0: wp.vec3d, x1: wp.vec3d, y0: wp.vec3d, y1: wp.vec3d, axis: int) -> wp.vec3d:
    """Returns the Bernstein coefficients of the component of x(t) cross y(t) along an axis."""
    j = wp.where(axis == 2, 0, axis + 1)
    k = wp.where(j == 2, 0, j + 1)
    x0j = component(x0, j)
    x0k = component(x0, k)
    x1j = component(x1, j)
    x1k = component(x1, k)
    y0j = component(y0, j)
    y0k = component(y0, k)
    y1j = component(y1, j)
    y1k = component(y1, k)
    return wp.vec3d(
        x0j * y0k - x0k * y0j, HALF * ((x0j * y1k - x0k * y1j) + (x1j * y0k - x1k * y0j)), x1j * y1k - x1k * y1j
    )


@wp.func
def largest_axis(x: wp.vec3d) -> int:
    """Returns the axis along which x is largest in absolute value."""
    ax = wp.abs(x[0])
    ay = wp.abs(x[1])
    az = wp.abs(x[2])
    return wp.where(ax >= ay, wp.where(ax >= az, 0, 2), wp.where(ay >= az, 1, 2))


@wp.func
def inside_tests(motion: Motion, y: Coplanarity, axis: int) -> InsideTests:
    """Returns the quadratics of the inside tests along an axis.

    Vertex-face: beta, gamma, n - beta - gamma, and n, which decides where one of the others changes sign.
    Edge-edge: s, n - s, r, n - r.

    Bounds, as in :func:`coplanarity`, with P the sum of the sizes of a component's two products: 5r P for a cross
    product; a difference of two adds their bounds and one rounding, one of three two.
    """
    n = wp.vec3d(component(y.n0, axis), component(y.nh, axis), component(y.n1, axis))
    w_v = _cross_component(motion.w0, motion.w1, motion.v0, motion.v1, axis)
    uv = component(cross_size(motion.u_size, motion.v_size), axis)
    wv = component(cross_size(motion.w_size, motion.v_size), axis)
    wu = component(cross_size(motion.w_size, motion.u_size), axis)
    tests = InsideTests()
    tests.q0 = w_v
    if motion.kind == VERTEX_FACE:
        u_w = _cross_component(motion.u0, motion.u1, motion.w0, motion.w1, axis)
        tests.q1 = u_w
        tests.q2 = n - w_v - u_w
        tests.q3 = n
        tests.bounds = motion.roundoff * wp.vec4d(
            PRODUCT_ERROR * wv + UNDERFLOW,
            PRODUCT_ERROR * wu + UNDERFLOW,
            REMAINDER_ERROR * (uv + wv + wu) + UNDERFLOW,
            PRODUCT_ERROR * uv + UNDERFLOW,
        )
    else:
        w_u = _cross_component(motion.w0, motion.w1, motion.u0, motion.u1, axis)
        tests.q1 = n - w_v
        tests.q2 = w_u
        tests.q3 = n - w_u
        tests.bounds = motion.roundoff * wp.vec4d(
            PRODUCT_ERROR * wv + UNDERFLOW,
            DIFFERENCE_ERROR * (uv + wv) + UNDERFLOW,
            PRODUCT_ERROR * wu + UNDERFLOW,
            DIFFERENCE_ERROR * (uv + wu) + UNDERFLOW,
        )
    return tests
