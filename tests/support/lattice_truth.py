"""The truth about queries with small integer coordinates, in 64-bit integers on a device, without code of kernels/.

One question
------------
A query collides when a moving triangle with corners x, y, z contains the origin: that of a-p, b-p, c-p for a vertex and
a face; one of a-c, b-c, b-d and a-c, b-d, a-d, the halves of the parallelogram of all differences, for two edges. Let
X = y x z, Y = z x x, Z = x x y (cross products), n = X + Y + Z (the normal) and V = x . X.

- At rest: contact takes V = 0. If n != 0, the barycentric coordinates of the origin are n . X, n . Y and n . Z over
  n . n, and none may be negative. If n = 0, the triangle is the union of its sides, and xy contains the origin when
  Z = 0 and x . y <= 0.
- In motion: both ends are tests at rest. Between, with s = t / (1 - t) > 0, a point is x0 + s x1 but for a positive
  factor, V is a cubic and the components of X, Y, Z are quadratics in s, all with integer coefficients. At a root of V
  the triangle is seen along an axis i with n_i != 0 without change of the order of its points, so that X_i, Y_i, Z_i
  must have one weak sign; along every axis they are barycentric coordinates times n_i, so that none has two signs. If
  n = 0 and a component is not zero, the sides lie in a line beside the origin, and the components of an axis, whose sum
  is 0, have two signs. So contact at the root is: some component is not zero, and along no axis two have opposite
  signs. If all are zero, the triangle has collapsed there.
- If it has collapsed at some root, or V is zero at all times (then a first contact that is not at the start is on a
  side: where the origin is inside, it was inside before), the sides are asked: for xy, at the roots of a component of
  Z that is not zero at all times, whether Z = 0 and x_i y_i <= 0 along every axis; if Z = 0 at all times, whether
  x . y <= 0 at some time.

Signs at roots of V
-------------------
A root r of a quadratic is (p + q sqrt(d)) / w with integers, w > 0, so that the sign of a polynomial there is that of a
number A + B sqrt(d), hence of A |A| + B |B| d. Sturm's sequence of V, taken just after r (by the first derivative that
is not zero there) and at infinity, counts the distinct roots of V beyond r. So each root of each component finds its
place among those of V, and the sign of a component at a root of V is its sign at infinity, changed once for each of its
roots in between, or zero if V is zero at that root of it.

No overflow
-----------
Let D be the largest difference of two coordinates along an axis, at both ends. A component's coefficients are at most
2, 4, 2 times D^2, those of V 4, 12, 12, 4 times D^3 (a determinant of numbers in [-1, 1] is at most 4). So
|p| <= 4 D^2, q = 1, -1 or 0, w <= 4 D^2 and d <= 16 + 16 = 32 D^4. The square and the cube of p + q sqrt(d) are at most
48 D^4 + (8 D^2) sqrt(d) and 448 D^6 + (80 D^4) sqrt(d). V w^3 = A + B sqrt(d) with

    |A| <= 4 * 4^3 + 12 * 4^2 * 4 + 12 * 4 * 48 + 4 * 448 = 5120 D^9,  |B| <= 12 * 4^2 + 12 * 4 * 8 + 4 * 80 = 896 D^7,

and A |A| and B |B| d, both below 2.63e7 D^18, are added: for D <= 4, 3.7e18 < 2^63 = 9.2e18. The other members of
Sturm's sequence, derivatives and components are smaller: V' has coefficients of at most 12, 24, 12 D^3, the third
member 576 and 288 D^6 but degree 1, and the discriminant is below 1.3e5 D^12. So coordinates may be in {-2, ..., 2}.
"""

import warp as wp
from compilation import QUICK

from warp_bsc.kernels.not_inlined import NOT_INLINED
from warp_bsc.kernels.polynomials import VERTEX_FACE
from warp_bsc.kernels.signs import FREE, HIT

wp.set_module_options({"enable_backward": False} | QUICK)

LARGEST = 2
"""The largest absolute value of a coordinate."""

_0 = wp.constant(wp.int64(0))
_1 = wp.constant(wp.int64(1))
_2 = wp.constant(wp.int64(2))
_3 = wp.constant(wp.int64(3))
_4 = wp.constant(wp.int64(4))

_vec4l = wp.types.vector(length=4, dtype=wp.int64)


@wp.struct
class Root:
    """The number (p + q sqrt(d)) / w with w > 0 and d >= 0."""

    p: wp.int64
    q: wp.int64
    d: wp.int64
    w: wp.int64


@wp.struct
class Sturm:
    """Sturm's sequence of a polynomial, coefficients from the constant on, and the degree of the first member."""

    s0: _vec4l
    s1: _vec4l
    s2: _vec4l
    s3: _vec4l
    degree: int


@wp.func
def _sign(x: wp.int64) -> int:
    return int(x > _0) - int(x < _0)


@wp.func
def _sign_with_root(a: wp.int64, b: wp.int64, d: wp.int64) -> int:
    """Returns the sign of a + b sqrt(d)."""
    return _sign(a * wp.abs(a) + b * wp.abs(b) * d)


@wp.func
def _sign_at(f: _vec4l, degree: int, at: Root) -> int:
    """Returns the sign of a polynomial of at most that degree, at a number, by Horner's rule: a + b sqrt(d)."""
    a = f[degree]
    b = wp.int64(0)
    w = wp.int64(1)
    k = degree - 1
    while k >= 0:
        w *= at.w
        c = a * at.p + b * at.q * at.d + f[k] * w
        b = a * at.q + b * at.p
        a = c
        k -= 1
    return _sign_with_root(a, b, at.d)


@wp.func
def _derivative(f: _vec4l) -> _vec4l:
    return _vec4l(f[1], _2 * f[2], _3 * f[3], _0)


@wp.func
def _sign_after(f: _vec4l, degree: int, at: Root) -> int:
    """Returns the sign of a polynomial just after a number, 0 for the zero polynomial."""
    g = f
    k = degree
    s = _sign_at(g, k, at)
    while s == 0 and k > 0:
        g = _derivative(g)
        k -= 1
        s = _sign_at(g, k, at)
    return s


@wp.func
def _leading_sign(f: _vec4l) -> int:
    """Returns the sign of a polynomial at infinity."""
    return _sign(wp.where(f[3] != _0, f[3], wp.where(f[2] != _0, f[2], wp.where(f[1] != _0, f[1], f[0]))))


@wp.func
def _variations(s0: int, s1: int, s2: int, s3: int) -> int:
    """Returns the number of changes of sign along a sequence without its zeros."""
    changes = int(0)
    last = s0
    if s1 != 0:
        changes += int(s1 * last < 0)
        last = s1
    if s2 != 0:
        changes += int(s2 * last < 0)
        last = s2
    if s3 != 0:
        changes += int(s3 * last < 0)
    return changes


@wp.func
def _sturm(v: _vec4l) -> Sturm:
    """Returns Sturm's sequence of a polynomial that is not zero, each member but for a positive factor."""
    f = Sturm()
    f.s0 = v
    f.s1 = _derivative(v)
    if v[3] != _0:
        f.degree = 3
        side = wp.int64(_sign(v[3]))
        slope = side * (_2 * v[2] * v[2] - wp.int64(6) * v[1] * v[3])
        f.s2 = _vec4l(side * (v[1] * v[2] - wp.int64(9) * v[0] * v[3]), slope, _0, _0)
        # where the slope is zero, the sequence ends before: two constant members change nothing
        discriminant = (
            wp.int64(18) * v[0] * v[1] * v[2] * v[3]
            - _4 * v[2] * v[2] * v[2] * v[0]
            + v[1] * v[1] * v[2] * v[2]
            - _4 * v[3] * v[1] * v[1] * v[1]
            - wp.int64(27) * v[3] * v[3] * v[0] * v[0]
        )
        f.s3 = _vec4l(side * wp.int64(_sign(discriminant)), _0, _0, _0)
    elif v[2] != _0:
        f.degree = 2
        f.s2 = _vec4l(wp.int64(_sign(v[2])) * (v[1] * v[1] - _4 * v[0] * v[2]), _0, _0, _0)
    else:
        f.degree = wp.where(v[1] != _0, 1, 0)
    return f


@wp.func(**NOT_INLINED)
def _roots_after(f: Sturm, at: Root) -> int:
    """Returns the number of distinct roots of a polynomial that are larger than a number."""
    after = _variations(
        _sign_after(f.s0, f.degree, at),
        _sign_after(f.s1, wp.max(f.degree - 1, 0), at),
        _sign_after(f.s2, wp.where(f.degree == 3, 1, 0), at),
        _sign_after(f.s3, 0, at),
    )
    return after - _variations(_leading_sign(f.s0), _leading_sign(f.s1), _leading_sign(f.s2), _leading_sign(f.s3))


@wp.func
def _is_zero(f: _vec4l) -> bool:
    return f[0] == _0 and f[1] == _0 and f[2] == _0 and f[3] == _0


@wp.func
def _real_roots(q: _vec4l) -> int:
    """Returns how many real roots a quadratic has, with multiplicity; those of the zero polynomial do not count."""
    if q[2] != _0:
        return wp.where(q[1] * q[1] - _4 * q[0] * q[2] >= _0, 2, 0)
    return wp.where(q[1] != _0, 1, 0)


@wp.func
def _root(q: _vec4l, second: bool) -> Root:
    """Returns a real root of a quadratic or linear polynomial."""
    at = Root()
    if q[2] != _0:
        side = wp.int64(_sign(q[2]))
        at.p = -side * q[1]
        at.q = wp.where(second, _1, -_1)
        at.d = q[1] * q[1] - _4 * q[0] * q[2]
        at.w = _2 * wp.abs(q[2])
    else:
        at.p = -wp.int64(_sign(q[1])) * q[0]
        at.w = wp.abs(q[1])
    return at


@wp.func
def _cross_component(x0: wp.vec3l, x1: wp.vec3l, y0: wp.vec3l, y1: wp.vec3l, axis: int) -> _vec4l:
    """Returns the component of (x0 + s x1) cross (y0 + s y1) along an axis, a quadratic in s."""
    j = (axis + 1) % 3
    k = (axis + 2) % 3
    return _vec4l(
        x0[j] * y0[k] - x0[k] * y0[j],
        x0[j] * y1[k] - x0[k] * y1[j] + x1[j] * y0[k] - x1[k] * y0[j],
        x1[j] * y1[k] - x1[k] * y1[j],
        _0,
    )


@wp.func
def _side_at_rest(x: wp.vec3l, y: wp.vec3l) -> bool:
    """Returns whether the segment xy contains the origin."""
    z = wp.cross(x, y)
    return z[0] == _0 and z[1] == _0 and z[2] == _0 and wp.dot(x, y) <= _0


@wp.func
def _at_rest(x: wp.vec3l, y: wp.vec3l, z: wp.vec3l) -> bool:
    """Returns whether the triangle xyz contains the origin."""
    yz = wp.cross(y, z)
    zx = wp.cross(z, x)
    xy = wp.cross(x, y)
    if wp.dot(x, yz) != _0:
        return False
    n = yz + zx + xy
    if n[0] == _0 and n[1] == _0 and n[2] == _0:
        return _side_at_rest(x, y) or _side_at_rest(y, z) or _side_at_rest(z, x)
    return wp.dot(n, yz) >= _0 and wp.dot(n, zx) >= _0 and wp.dot(n, xy) >= _0


@wp.func(**NOT_INLINED)
def _side_in_motion(x0: wp.vec3l, x1: wp.vec3l, y0: wp.vec3l, y1: wp.vec3l) -> bool:
    """Returns whether the segment xy contains the origin at a time between the ends, at both of which it does not."""
    for axis in range(3):
        q = _cross_component(x0, x1, y0, y1, axis)
        if not _is_zero(q):
            roots = _real_roots(q)
            for k in range(roots):
                at = _root(q, k == 1)
                contact = _sign_with_root(at.p, at.q, at.d) > 0
                for i in range(3):
                    contact = contact and _sign_at(_cross_component(x0, x1, y0, y1, i), 2, at) == 0
                    x = _sign_at(_vec4l(x0[i], x1[i], _0, _0), 1, at)
                    contact = contact and x * _sign_at(_vec4l(y0[i], y1[i], _0, _0), 1, at) <= 0
                if contact:
                    return True
            return False
    d0 = wp.dot(x0, y0)
    d1 = wp.dot(x0, y1) + wp.dot(x1, y0)
    d2 = wp.dot(x1, y1)
    return d1 < _0 and d1 * d1 >= _4 * d0 * d2


@wp.func(**NOT_INLINED)
def _triangle(x0: wp.vec3l, y0: wp.vec3l, z0: wp.vec3l, x1: wp.vec3l, y1: wp.vec3l, z1: wp.vec3l) -> bool:
    """Returns whether a moving triangle contains the origin at some time of the step."""
    if _at_rest(x0, y0, z0) or _at_rest(x1, y1, z1):
        return True
    n0 = wp.cross(y0, z0)
    nh = wp.cross(y0, z1) + wp.cross(y1, z0)
    n1 = wp.cross(y1, z1)
    v = _vec4l(wp.dot(x0, n0), wp.dot(x0, nh) + wp.dot(x1, n0), wp.dot(x0, n1) + wp.dot(x1, nh), wp.dot(x1, n1))
    ask_sides = bool(_is_zero(v))
    if not ask_sides:
        f = _sturm(v)
        start = Root()
        start.w = _1
        roots = _roots_after(f, start)
        # by root of V, from the largest on
        opposite = wp.vec3i(0, 0, 0)
        strict = wp.vec3i(0, 0, 0)
        axis = int(0)
        while axis < 3 and roots > 0:
            low = wp.vec3i(0, 0, 0)
            high = wp.vec3i(0, 0, 0)
            side = int(0)
            while side < 3:
                q = _cross_component(x0, x1, y0, y1, axis)
                if side == 1:
                    q = _cross_component(y0, y1, z0, z1, axis)
                elif side == 2:
                    q = _cross_component(z0, z1, x0, x1, axis)
                last = _leading_sign(q)
                signs = wp.vec3i(last, last, last)
                real = _real_roots(q)
                for k in range(real):
                    at = _root(q, k == 1)
                    if _sign_with_root(at.p, at.q, at.d) >= 0:
                        beyond = _roots_after(f, at)
                        is_root = _sign_at(v, f.degree, at) == 0
                        for j in range(3):
                            if j == beyond and is_root:
                                signs[j] = 0
                            elif j >= beyond:
                                signs[j] = -signs[j]
                low = wp.min(low, signs)
                high = wp.max(high, signs)
                side += 1
            for j in range(3):
                opposite[j] = wp.max(opposite[j], int(low[j] < 0 and high[j] > 0))
                strict[j] = wp.max(strict[j], int(low[j] < 0 or high[j] > 0))
            axis += 1
        for j in range(3):
            if j < roots and opposite[j] == 0:
                if strict[j] == 1:
                    return True
                ask_sides = True
    return ask_sides and (
        _side_in_motion(x0, x1, y0, y1) or _side_in_motion(y0, y1, z0, z1) or _side_in_motion(z0, z1, x0, x1)
    )


@wp.func
def _integers(x: wp.vec3d) -> wp.vec3l:
    return wp.vec3l(wp.int64(x[0]), wp.int64(x[1]), wp.int64(x[2]))


@wp.func
def _collides(kind: int, x: wp.array[wp.vec3d]) -> bool:
    """Returns whether a query collides, VERTEX_FACE or EDGE_EDGE, eight points with coordinates in {-2, ..., 2}."""
    a0 = _integers(x[0])
    b0 = _integers(x[1])
    c0 = _integers(x[2])
    d0 = _integers(x[3])
    a1 = _integers(x[4])
    b1 = _integers(x[5])
    c1 = _integers(x[6])
    d1 = _integers(x[7])
    if kind == VERTEX_FACE:
        return _triangle(b0 - a0, c0 - a0, d0 - a0, b1 - a1, c1 - a1, d1 - a1)
    first = _triangle(a0 - c0, b0 - c0, b0 - d0, a1 - c1, b1 - c1, b1 - d1)
    return first or _triangle(a0 - c0, b0 - d0, a0 - d0, a1 - c1, b1 - d1, a1 - d1)


@wp.kernel
def decide_lattice(kind: int, points: wp.array2d[wp.vec3d], truth: wp.array[int]):
    """Writes HIT or FREE for each query."""
    i = wp.tid()
    truth[i] = wp.where(_collides(kind, points[i]), HIT, FREE)
