"""Proofs that two moving features stay farther apart than a distance d over a whole part of the step.

The differences x of the points of two features fill a moving polygon: a point for two vertices, a segment for a vertex
and an edge, a triangle for a vertex and a face, a parallelogram for two edges. The features are within d when |x| <= d
for one of them. With q a corner, e and i the vectors along the two sides there, and n = e x i, linear and quadratic
functions of time, each of these proves that |x| > d for all of them, over a whole part of the step:

- **direction**: some fixed g has g.x > d |g| for all corners at both ends of the part. Each g.x is linear in time, and
  |x| >= g.x / |g|. This suffices far away, and for two vertices.
- **plane**: Y = q.n, a cubic, satisfies Y > d |n|, or -Y > d |n|, as x.n = q.n for all x. The norm of a Bernstein
  polynomial is at most the Bernstein polynomial of the norms of its coefficients, so that coefficients decide.
- **side**: the line of the side at q along e is farther than d, |q x e| > d |e|, because g.(q x e) > d |g| |e| for some
  fixed g, decided by coefficients as before. And i points away from it, (q x e).(i x e) >= 0, a polynomial of degree
  four: with h = q |e|^2 - e (q.e), the perpendicular to the line times |e|^2, h.i >= 0, so that
  h.x >= h.q = |h| |h| / |e|^2 for all x, and |x| >= |h| / |e|^2, the distance of the line.
- **corner**: some fixed g has g.q > d |g| at both ends, and both sides point away from q: q.e >= 0, q.i >= 0, in all
  coefficients. Then x = q + s e + r i has x.q >= q.q.

Fixed directions are those of the closest points at some time. A fixed direction alone would need parts as short as the
gap where features turn; the others lose only the square of their length.

**Bounds.** r is the roundoff, U the sum of the sizes of u, v and w, component by component. Components of u, v and w
at a time have at most 4 roundings: 1 of the difference of points, 3 of the interpolation between both ends; times are
multiples of SHORTEST, so that t and 1 - t are exact. Corners q are sums of at most three, 6r U; sides e and i, and
their differences, 5r of their own size. Norms are increased by 2^-48 of themselves, more than the few roundings of a
norm, of its product with d and of the comparison.
"""

import warp as wp

from .closest import unit_scale
from .culling import gaps_along
from .polynomials import EDGE_EDGE, VERTEX_EDGE, VERTEX_VERTEX, Motion, coplanarity, cross_middle, cross_size
from .signs import FOUR, HALF, ONE, TWO, UNDERFLOW, ZERO

_THIRD = wp.constant(wp.float64(1.0 / 3.0))
_SIXTH = wp.constant(wp.float64(1.0 / 6.0))
INFLATED = wp.constant(wp.float64(1.0 + 2.0**-48))
POINT_ERROR = wp.constant(wp.float64(12.0))
NORMAL_ERROR = wp.constant(wp.float64(16.0))
PLANE_ERROR = wp.constant(wp.float64(2.0))
_CROSS_ERROR = wp.constant(wp.float64(20.0))
_SIDE_ERROR = wp.constant(wp.float64(8.0))
_DOT_ERROR = wp.constant(wp.float64(20.0))
_QUARTIC_ERROR = wp.constant(wp.float64(40.0))


@wp.func
def norm_bound(x: wp.vec3d) -> wp.float64:
    """Returns an upper bound of the norm of a vector, apart from the underflow of squares."""
    return wp.sqrt(wp.dot(x, x)) * INFLATED


@wp.func
def sum_of_size(x: wp.vec3d) -> wp.float64:
    """Returns the sum of the components of a size, which bounds its norm."""
    return x[0] + x[1] + x[2]


@wp.func
def direction_clears(part: Motion, direction: wp.vec3d, distance: wp.float64) -> bool:
    """Returns whether a direction keeps the features of a part farther apart than a distance."""
    low, high, bound = gaps_along(part, direction)
    needed = distance * norm_bound(direction)
    return low - bound > needed or -high - bound > needed


@wp.func
def plane_clears(part: Motion, distance: wp.float64) -> bool:
    """Returns whether the plane of the polygon stays farther away than a distance.

    Bounds: Y's is that of :func:`.polynomials.coplanarity`, whose u, v and w have 3 more roundings each: 21r P, less
    than twice its own. A component of n has 4 + 4 roundings of u and v, 1 of the product and 1 or 2 of the sum.
    """
    y = coplanarity(part)
    error = NORMAL_ERROR * part.roundoff * sum_of_size(cross_size(part.u_size, part.v_size)) + part.roundoff * UNDERFLOW
    start = norm_bound(y.n0) + error
    middle = norm_bound(y.nh) + error
    end = norm_bound(y.n1) + error
    needed = (distance * INFLATED) * wp.vec4d(
        start, (start + TWO * middle) * _THIRD, (TWO * middle + end) * _THIRD, end
    )
    bound = PLANE_ERROR * y.bound
    above = y.k - needed
    below = -y.k - needed
    return (
        wp.min(wp.min(above[0], above[1]), wp.min(above[2], above[3])) > bound
        or wp.min(wp.min(below[0], below[1]), wp.min(below[2], below[3])) > bound
    )


_Ends = wp.types.matrix(shape=(2, 3), dtype=wp.float64)
"""A vector at both ends of a part."""


@wp.func
def _side_clears(
    part: Motion, alone: bool, q: _Ends, e: _Ends, i: _Ends, e_size: wp.vec3d, i_size: wp.vec3d, distance: wp.float64
) -> bool:
    """Returns whether a side of the polygon stays farther away than a distance, and the polygon beyond it.

    It is the side e from the corner q on, and i is the side away from the line. With ``alone`` the polygon is this
    side, and i is not used.

    Bounds: c = q x e has 6 + 5 roundings of its factors, 1 of the product and 1 or 2 of the sum, 14r C with C the sum
    of the sizes of its products; its product with the direction has 3 more. The norm of e is off by 5r of the sum of
    its components. c.(i x e) has 14 + 13 roundings of its factors, 1 of the product, 2 of the sum, 3 of the sum of
    three coefficients, and 2 of the sixth.
    """
    size = part.u_size + part.v_size + part.w_size
    c0 = wp.cross(q[0], e[0])
    ch = cross_middle(q[0], q[1], e[0], e[1])
    c1 = wp.cross(q[1], e[1])
    direction = unit_scale(c0 + TWO * ch + c1)
    c_size = cross_size(size, e_size)
    slack = part.roundoff * UNDERFLOW
    bound = _CROSS_ERROR * part.roundoff * wp.dot(wp.abs(direction), c_size) + slack
    error = _SIDE_ERROR * part.roundoff * sum_of_size(e_size) + slack
    start = norm_bound(e[0]) + error
    end = norm_bound(e[1]) + error
    needed = distance * norm_bound(direction) * INFLATED
    if not (
        wp.dot(direction, c0) - bound > needed * start
        and wp.dot(direction, ch) - bound > needed * (HALF * (start + end))
        and wp.dot(direction, c1) - bound > needed * end
    ):
        return False
    if alone:
        return True
    k0 = wp.cross(i[0], e[0])
    kh = cross_middle(i[0], i[1], e[0], e[1])
    k1 = wp.cross(i[1], e[1])
    away = _QUARTIC_ERROR * part.roundoff * wp.dot(c_size, cross_size(i_size, e_size)) + slack
    return (
        wp.dot(c0, k0) >= away
        and HALF * (wp.dot(c0, kh) + wp.dot(ch, k0)) >= away
        and (wp.dot(c0, k1) + FOUR * wp.dot(ch, kh) + wp.dot(c1, k0)) * _SIXTH >= away
        and HALF * (wp.dot(ch, k1) + wp.dot(c1, kh)) >= away
        and wp.dot(c1, k1) >= away
    )


@wp.func
def _points_away(q: _Ends, e: _Ends, bound: wp.float64) -> bool:
    """Returns whether q.e is certainly not negative over a part, in all its coefficients."""
    middle = HALF * (wp.dot(q[0], e[1]) + wp.dot(q[1], e[0]))
    return wp.dot(q[0], e[0]) >= bound and middle >= bound and wp.dot(q[1], e[1]) >= bound


@wp.func
def _corner_clears(
    part: Motion, q: _Ends, e: _Ends, i: _Ends, e_size: wp.vec3d, i_size: wp.vec3d, distance: wp.float64
) -> bool:
    """Returns whether a corner q of the polygon stays farther away than a distance, and the polygon beyond it.

    Both sides at it are e and i.

    Bounds: a product with the direction has 6 roundings of q, 1 of the product and 2 of the sum. q.e has 6 + 5
    roundings of its factors, 1 of the product, 2 of the sum and 1 of the sum of two.
    """
    size = part.u_size + part.v_size + part.w_size
    direction = unit_scale(q[0] + q[1])
    slack = part.roundoff * UNDERFLOW
    bound = POINT_ERROR * part.roundoff * wp.dot(wp.abs(direction), size) + slack
    needed = distance * norm_bound(direction)
    if not (wp.dot(direction, q[0]) - bound > needed and wp.dot(direction, q[1]) - bound > needed):
        return False
    factor = _DOT_ERROR * part.roundoff
    away_from_e = _points_away(q, e, factor * wp.dot(size, e_size) + slack)
    return away_from_e and _points_away(q, i, factor * wp.dot(size, i_size) + slack)


@wp.func
def polygon_clears(kind: int, part: Motion, at: wp.vec2d, distance: wp.float64) -> bool:
    """Returns whether the corner, the side or the plane with the closest points keeps the features apart over a part.

    Where the closest point is a corner, its sides and the plane are tried as well, and the plane where it is on a side:
    the closest point may move from one to the other within the part.

    Args:
        kind: The kind of query.
        part: The part.
        at: Coordinates of about the closest points; any are valid.
        distance: The distance.
    """
    if kind == VERTEX_VERTEX:
        return False
    first_low = at[0] <= ZERO
    first_high = at[0] >= ONE
    second_low = at[1] <= ZERO
    second_high = at[1] >= ONE
    alone = kind == VERTEX_EDGE
    # the corner, both sides at it, and which of these are tried
    u = wp.matrix_from_rows(part.u0, part.u1)
    v = wp.matrix_from_rows(part.v0, part.v1)
    q = wp.matrix_from_rows(part.w0, part.w1)
    e = -u
    i = -v
    e_size = part.u_size
    i_size = part.v_size
    along_e = bool(False)
    along_i = bool(False)
    corner = bool(False)
    if kind == EDGE_EDGE:
        # x = s u - r v - w
        along_i = first_low or first_high
        along_e = second_low or second_high
        corner = along_e and along_i
        q = -q
        if first_high:
            q += u
        else:
            e = u
        if second_high:
            q -= v
            i = v
    else:
        # x = w - beta u - gamma v
        third = at[0] + at[1] >= ONE
        corner = (first_low and second_low) or first_high or second_high
        along_i = not alone and (corner or (first_low and not third))
        along_e = corner or ((third or second_low) and not along_i)
        if third and not second_high:  # from b on, along b c and b a; otherwise from c on, or from a on
            q -= u
            e = u - v
            i = u
            e_size = part.u_size + part.v_size
            i_size = part.u_size
        elif second_high:
            q -= v
            e = v
            i = v - u
            e_size = part.v_size
            i_size = part.u_size + part.v_size
        if alone and corner:  # one side, twice
            i = wp.where(first_high, u, -u)
            e = i
            e_size = part.u_size
            i_size = part.u_size
    if corner and _corner_clears(part, q, e, i, e_size, i_size, distance):
        return True
    sides = int(2)  # not a constant, as the body would be repeated
    for side in range(sides):
        is_e = side == 0
        if wp.where(is_e, along_e, along_i):
            along = wp.where(is_e, e, i)
            away = wp.where(is_e, i, e)
            size = wp.where(is_e, e_size, i_size)
            if _side_clears(part, alone, q, along, away, size, wp.where(is_e, i_size, e_size), distance):
                return True
    return not alone and plane_clears(part, distance)
