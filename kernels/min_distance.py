"""Whether two moving features come within a minimum distance d, certified by subdivision of the step.

The differences x of the points of two features fill a moving polygon: a point for two vertices, a segment for a vertex
and an edge, a triangle for a vertex and a face, a parallelogram for two edges. The features are within d when |x| <= d
for one of them. With q a corner, e and i the vectors along the two sides there, and n = e x i, linear and quadratic
functions of time, each of these proves that none is, over a whole part of the step:

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
gap where features turn; the others lose the square of their length only. At one time, two points of the features whose
distance is certainly at most d are a HIT.

Two searches look for such parts. Most queries end in the first one.

- **Advancement** evaluates the closest points at one time after another. Their direction clears all times around until
  the first corner comes within the distance along it; if that includes all from the start of what is left, the start
  advances to the end. Evaluated are the time at which the distance to the plane is about reached, by Newton's method on
  Y and |n|, and the start where that leads nowhere. If the distance is certainly reached, the plane is tried over all
  from the start to the tolerance before. This is given up where nothing advances, or after :data:`MAX_ADVANCES` times.
- **Subdivision** goes through the step from part to part: after a part that is free comes one twice as long, and a part
  that nothing decides is halved. Newton's method on the closest points proposes a time, half the tolerance after the
  one at which the distance is about reached; if the distance is certainly reached there, the next part ends within the
  tolerance before it. The search ends at the first part as short as :data:`SHORTEST` that nothing decides, or after
  :data:`MAX_VISITS` parts.

The start of what is left is a lower bound of the time at which the distance is reached.

**Bounds.** r is the roundoff, U the sum of the sizes of u, v and w, component by component. Components of u, v and w
at a time have at most 4 roundings: 1 of the difference of points, 3 of the interpolation between both ends; times are
multiples of SHORTEST, so that t and 1 - t are exact. Corners q are sums of at most three, 6r U; sides e and i, and
their differences, 5r of their own size. d is scaled exactly, but for a d below 2^-400 of the largest coordinate, which
is replaced by 0 for a HIT and by 2^-400 elsewhere. Norms are increased by 2^-48 of themselves, more than the few
roundings of a norm, of its product with d and of the comparison.

With a roundoff of 0 the bounds are zero, and the status is the one that floating point computes.
"""

import warp as wp

from .closest import between, closest_coordinates, contact_at
from .culling import DIRECTION_ERROR, centroid_direction, gaps_along
from .distance import nearest_pair
from .polynomials import EDGE_EDGE, VERTEX_EDGE, VERTEX_FACE, VERTEX_VERTEX, Motion, coplanarity, cross_middle
from .signs import FREE, HIT, UNDERFLOW, UNSURE
from .time_of_impact import Impact, clamped_tolerance, mix_vector, power_of_two, restrict_motion

SHORTEST = wp.constant(wp.float64(2.0**-40))
"""Length of the shortest part of a step."""
MAX_VISITS = wp.constant(128)
"""Number of parts after which subdivision stops, unsure."""
MAX_ADVANCES = wp.constant(12)
"""Number of times after which advancement is given up."""

_ZERO = wp.constant(wp.float64(0.0))
_HALF = wp.constant(wp.float64(0.5))
_AHEAD = wp.constant(wp.float64(0.75))
_ONE = wp.constant(wp.float64(1.0))
_TWO = wp.constant(wp.float64(2.0))
_FOUR = wp.constant(wp.float64(4.0))
_THIRD = wp.constant(wp.float64(1.0 / 3.0))
_SIXTH = wp.constant(wp.float64(1.0 / 6.0))
_THREE = wp.constant(wp.float64(3.0))
_NEWTON_STEPS = wp.constant(3)
_PLANE_NEWTON_STEPS = wp.constant(6)
_STEPS_TO_PLANE = wp.constant(3)
_UNKNOWN = wp.constant(wp.float64(-1.0))
_AWAY = wp.constant(wp.float64(1.0 + 2.0**-38))
_SMALLEST = wp.constant(wp.float64(2.0**-400))
_INFLATED = wp.constant(wp.float64(1.0 + 2.0**-48))
_POINT_ERROR = wp.constant(wp.float64(12.0))
_NORMAL_ERROR = wp.constant(wp.float64(16.0))
_PLANE_ERROR = wp.constant(wp.float64(2.0))
_CROSS_ERROR = wp.constant(wp.float64(20.0))
_SIDE_ERROR = wp.constant(wp.float64(8.0))
_DOT_ERROR = wp.constant(wp.float64(20.0))
_QUARTIC_ERROR = wp.constant(wp.float64(40.0))


@wp.func
def _norm(x: wp.vec3d) -> wp.float64:
    """Returns an upper bound of the norm of a vector whose largest component is about 1, or of its size at least."""
    return wp.sqrt(wp.dot(x, x)) * _INFLATED


@wp.func
def _sum(x: wp.vec3d) -> wp.float64:
    """Returns the sum of the components of a size, which bounds its norm."""
    return x[0] + x[1] + x[2]


@wp.func
def _cross_size(x: wp.vec3d, y: wp.vec3d) -> wp.vec3d:
    """Returns bounds on the components of a cross product, from the sizes of the components of its factors."""
    return wp.vec3d(x[1] * y[2] + x[2] * y[1], x[2] * y[0] + x[0] * y[2], x[0] * y[1] + x[1] * y[0])


@wp.func
def _unit_scale(x: wp.vec3d) -> wp.vec3d:
    """Returns a vector divided by its largest component; zero stays zero."""
    size = wp.max(wp.abs(x))
    if size > _ZERO:
        return x / size
    return x


@wp.func
def _direction_clears(part: Motion, direction: wp.vec3d, distance: wp.float64) -> bool:
    """Returns whether a direction keeps the features of a part farther apart than a distance."""
    low, high, bound = gaps_along(part, direction)
    needed = distance * _norm(direction)
    return low - bound > needed or -high - bound > needed


@wp.func
def _plane_clears(part: Motion, distance: wp.float64) -> bool:
    """Returns whether the plane of the polygon stays farther away than a distance.

    Bounds: Y's is that of :func:`.polynomials.coplanarity`, whose u, v and w have 3 more roundings each: 21r P, less
    than twice its own. A component of n has 4 + 4 roundings of u and v, 1 of the product and 1 or 2 of the sum.
    """
    y = coplanarity(part)
    error = _NORMAL_ERROR * part.roundoff * _sum(_cross_size(part.u_size, part.v_size)) + part.roundoff * UNDERFLOW
    start = _norm(y.n0) + error
    middle = _norm(y.nh) + error
    end = _norm(y.n1) + error
    needed = (distance * _INFLATED) * wp.vec4d(
        start, (start + _TWO * middle) * _THIRD, (_TWO * middle + end) * _THIRD, end
    )
    bound = _PLANE_ERROR * y.bound
    above = y.k - needed
    below = -y.k - needed
    return (
        wp.min(wp.min(above[0], above[1]), wp.min(above[2], above[3])) > bound
        or wp.min(wp.min(below[0], below[1]), wp.min(below[2], below[3])) > bound
    )


@wp.func
def clears_at_once(motion: Motion, distance: wp.float64) -> bool:
    """Returns whether the direction through the centroids, or the plane, keeps the features of a motion apart."""
    far = wp.max(distance, _SMALLEST)
    return _direction_clears(motion, _unit_scale(centroid_direction(motion)), far) or _plane_clears(motion, far)


@wp.func
def _side_clears(
    part: Motion,
    alone: bool,
    # corner, side along the line, side away from it; at both ends of the part
    q0: wp.vec3d,
    q1: wp.vec3d,
    e0: wp.vec3d,
    e1: wp.vec3d,
    i0: wp.vec3d,
    i1: wp.vec3d,
    # sizes of the sides
    e_size: wp.vec3d,
    i_size: wp.vec3d,
    distance: wp.float64,
) -> bool:
    """Returns whether a side of the polygon stays farther away than a distance, and the polygon beyond it.

    With ``alone`` the polygon is this side, and i is not used.

    Bounds: c = q x e has 6 + 5 roundings of its factors, 1 of the product and 1 or 2 of the sum, 14r C with C the sum
    of the sizes of its products; its product with the direction has 3 more. The norm of e is off by 5r of the sum of
    its components. c.(i x e) has 14 + 13 roundings of its factors, 1 of the product, 2 of the sum, 3 of the sum of
    three coefficients, and 2 of the sixth.
    """
    size = part.u_size + part.v_size + part.w_size
    c0 = wp.cross(q0, e0)
    ch = cross_middle(q0, q1, e0, e1)
    c1 = wp.cross(q1, e1)
    direction = _unit_scale(c0 + _TWO * ch + c1)
    c_size = _cross_size(size, e_size)
    slack = part.roundoff * UNDERFLOW
    bound = _CROSS_ERROR * part.roundoff * wp.dot(wp.abs(direction), c_size) + slack
    error = _SIDE_ERROR * part.roundoff * _sum(e_size) + slack
    start = _norm(e0) + error
    end = _norm(e1) + error
    needed = distance * _norm(direction) * _INFLATED
    if not (
        wp.dot(direction, c0) - bound > needed * start
        and wp.dot(direction, ch) - bound > needed * (_HALF * (start + end))
        and wp.dot(direction, c1) - bound > needed * end
    ):
        return False
    if alone:
        return True
    k0 = wp.cross(i0, e0)
    kh = cross_middle(i0, i1, e0, e1)
    k1 = wp.cross(i1, e1)
    away = _QUARTIC_ERROR * part.roundoff * wp.dot(c_size, _cross_size(i_size, e_size)) + slack
    return (
        wp.dot(c0, k0) >= away
        and _HALF * (wp.dot(c0, kh) + wp.dot(ch, k0)) >= away
        and (wp.dot(c0, k1) + _FOUR * wp.dot(ch, kh) + wp.dot(c1, k0)) * _SIXTH >= away
        and _HALF * (wp.dot(ch, k1) + wp.dot(c1, kh)) >= away
        and wp.dot(c1, k1) >= away
    )


@wp.func
def _points_away(q0: wp.vec3d, q1: wp.vec3d, e0: wp.vec3d, e1: wp.vec3d, bound: wp.float64) -> bool:
    """Returns whether q.e is certainly not negative over a part, in all its coefficients."""
    return wp.dot(q0, e0) >= bound and _HALF * (wp.dot(q0, e1) + wp.dot(q1, e0)) >= bound and wp.dot(q1, e1) >= bound


@wp.func
def _corner_clears(
    part: Motion,
    # corner and both sides at it, at both ends of the part
    q0: wp.vec3d,
    q1: wp.vec3d,
    e0: wp.vec3d,
    e1: wp.vec3d,
    i0: wp.vec3d,
    i1: wp.vec3d,
    # sizes of the sides
    e_size: wp.vec3d,
    i_size: wp.vec3d,
    distance: wp.float64,
) -> bool:
    """Returns whether a corner of the polygon stays farther away than a distance, and the polygon beyond it.

    Bounds: a product with the direction has 6 roundings of q, 1 of the product and 2 of the sum. q.e has 6 + 5
    roundings of its factors, 1 of the product, 2 of the sum and 1 of the sum of two.
    """
    size = part.u_size + part.v_size + part.w_size
    direction = _unit_scale(q0 + q1)
    slack = part.roundoff * UNDERFLOW
    bound = _POINT_ERROR * part.roundoff * wp.dot(wp.abs(direction), size) + slack
    needed = distance * _norm(direction)
    if not (wp.dot(direction, q0) - bound > needed and wp.dot(direction, q1) - bound > needed):
        return False
    factor = _DOT_ERROR * part.roundoff
    return _points_away(q0, q1, e0, e1, factor * wp.dot(size, e_size) + slack) and _points_away(
        q0, q1, i0, i1, factor * wp.dot(size, i_size) + slack
    )


@wp.func
def _polygon_clears(kind: int, part: Motion, at: wp.vec2d, distance: wp.float64) -> bool:
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
    first_low = at[0] <= _ZERO
    first_high = at[0] >= _ONE
    second_low = at[1] <= _ZERO
    second_high = at[1] >= _ONE
    alone = kind == VERTEX_EDGE
    # the corner, both sides at it, and which of these are tried
    q0 = part.w0
    q1 = part.w1
    e0 = -part.u0
    e1 = -part.u1
    e_size = part.u_size
    i0 = -part.v0
    i1 = -part.v1
    i_size = part.v_size
    along_e = bool(False)
    along_i = bool(False)
    corner = bool(False)
    if kind == EDGE_EDGE:
        # x = s u - r v - w
        along_i = first_low or first_high
        along_e = second_low or second_high
        corner = along_e and along_i
        q0 = -q0
        q1 = -q1
        if first_high:
            q0 += part.u0
            q1 += part.u1
        else:
            e0 = part.u0
            e1 = part.u1
        if second_high:
            q0 -= part.v0
            q1 -= part.v1
            i0 = part.v0
            i1 = part.v1
    else:
        # x = w - beta u - gamma v
        third = at[0] + at[1] >= _ONE
        corner = (first_low and second_low) or first_high or second_high
        along_i = not alone and (corner or (first_low and not third))
        along_e = corner or ((third or second_low) and not along_i)
        if third and not second_high:  # from b on, along b c and b a; otherwise from c on, or from a on
            q0 -= part.u0
            q1 -= part.u1
            e0 = part.u0 - part.v0
            e1 = part.u1 - part.v1
            i0 = part.u0
            i1 = part.u1
            e_size = part.u_size + part.v_size
            i_size = part.u_size
        elif second_high:
            q0 -= part.v0
            q1 -= part.v1
            e0 = part.v0
            e1 = part.v1
            i0 = part.v0 - part.u0
            i1 = part.v1 - part.u1
            e_size = part.v_size
            i_size = part.u_size + part.v_size
        if alone and corner:  # one side, twice
            i0 = wp.where(first_high, part.u0, -part.u0)
            i1 = wp.where(first_high, part.u1, -part.u1)
            e0 = i0
            e1 = i1
            e_size = part.u_size
            i_size = part.u_size
    if corner and _corner_clears(part, q0, q1, e0, e1, i0, i1, e_size, i_size, distance):
        return True
    sides = int(2)  # not a constant, as the body would be repeated
    for side in range(sides):
        is_e = side == 0
        if wp.where(is_e, along_e, along_i) and _side_clears(
            part,
            alone,
            q0,
            q1,
            wp.where(is_e, e0, i0),
            wp.where(is_e, e1, i1),
            wp.where(is_e, i0, e0),
            wp.where(is_e, i1, e1),
            wp.where(is_e, e_size, i_size),
            wp.where(is_e, i_size, e_size),
            distance,
        ):
            return True
    return not alone and _plane_clears(part, distance)


@wp.func
def _nearest_at(motion: Motion, time: wp.float64):
    """Returns the coordinates of the closest points at a time, and the vector between them."""
    u = mix_vector(motion.u0, motion.u1, time)
    v = mix_vector(motion.v0, motion.v1, time)
    w = mix_vector(motion.w0, motion.w1, time)
    nearest = nearest_pair(motion.kind, u, v, w)
    at = wp.vec2d(nearest[0], nearest[1])
    return at, between(motion.kind, at, u, v, w)


@wp.func
def _about_reached(
    motion: Motion,
    distance: wp.float64,
    start: wp.float64,
    end: wp.float64,
    time: wp.float64,
    at: wp.vec2d,
    gap: wp.vec3d,
) -> wp.float64:
    """Returns about when a distance is reached between two times, by Newton's method from a time of a part.

    Args:
        motion: The motion.
        distance: The distance.
        start: Start of the part.
        end: Its end.
        time: Time from which to search.
        at: Coordinates of the closest points at that time.
        gap: The vector between them.

    Returns:
        The time; 2 if that is not between both.
    """
    steps = int(_NEWTON_STEPS)  # not a constant, as the body would be repeated
    for _ in range(steps):
        velocity = between(motion.kind, at, motion.u1 - motion.u0, motion.v1 - motion.v0, motion.w1 - motion.w0)
        size = wp.length(gap)
        slope = wp.dot(gap, velocity)
        if slope == _ZERO:
            return _TWO
        time += (distance - size) * size / slope
        if not (time >= start and time <= end):
            return _TWO
        at, gap = _nearest_at(motion, time)
    return time


@wp.func
def _is_within(motion: Motion, gap: wp.vec3d, distance: wp.float64) -> bool:
    """Returns whether the vector between two points of the features is certainly no longer than a distance.

    Bound: w has 4 roundings, u and v with the product 5, and the sum 2. Coordinates in a triangle may add up to
    1 + 3r: the sum that is compared, and quotients, are rounded. That is as far from the triangle as 3r of its size.
    """
    size = _sum(motion.u_size + motion.v_size + motion.w_size)
    return _norm(gap) + _POINT_ERROR * motion.roundoff * size + _underflow(motion.roundoff) <= distance


@wp.func
def _underflow(roundoff: wp.float64) -> wp.float64:
    """Returns more than a norm loses to the underflow of its squares; 0 for a roundoff of 0."""
    return wp.where(roundoff > _ZERO, UNDERFLOW, _ZERO)


@wp.func
def closest_at(kind: int, motion: Motion, time: wp.float64):
    """Returns contact coordinates and unit normal of the closest points at a time, not certified.

    Coordinates are barycentric in the face; (s, r, 0) along the edges; (s, 0, 0) along the edge of a vertex and an
    edge; or zero for two vertices. The normal points from the second feature (face, edge c d, edge, second vertex) to
    the first. If the points touch, it is that of :func:`.contact_at`.
    """
    at, gap = _nearest_at(motion, time)
    coordinates = wp.vec3d(at[0], at[1], _ZERO)
    if kind == VERTEX_FACE:
        coordinates = wp.vec3d(_ONE - at[0] - at[1], at[0], at[1])
    elif kind == VERTEX_EDGE:
        coordinates = wp.vec3d(at[0], _ZERO, _ZERO)
    elif kind == VERTEX_VERTEX:
        coordinates = wp.vec3d()
    size = wp.max(wp.abs(gap))
    if size > UNDERFLOW:
        return coordinates, wp.normalize(gap / size)
    _, normal = contact_at(motion, time)
    return coordinates, normal


@wp.struct
class Search:
    """How far the search through a step is."""

    near: wp.float64  # what is at most this far apart is a HIT
    far: wp.float64  # what is farther apart is free
    length: wp.float64  # tolerance of the time of impact
    start: wp.float64  # of the part that is next: what is before is free
    width: wp.float64  # of that part
    limit: wp.float64  # end of what is to be searched
    found: bool  # whether the distance is certainly reached at the limit
    aimed: bool  # whether the part ends within the tolerance before the limit
    time: wp.float64  # that advancement evaluates next; less than the start if it is to be found
    visits: int
    status: int  # FREE if the whole step is free, else UNSURE
    ended: bool
    given_up: bool  # whether advancement has ended without a result


@wp.func
def begin_search(motion: Motion, distance: wp.float64, tolerance: wp.float64) -> Search:
    """Returns the search of :func:`min_distance_impact`, whose arguments these are, before its first part."""
    search = Search()
    search.length = clamped_tolerance(tolerance)
    search.near = wp.where(distance >= _SMALLEST, distance, _ZERO)
    search.far = wp.max(distance, _SMALLEST)
    if motion.roundoff == _ZERO:
        search.near = distance
        search.far = distance
    search.width = _ONE
    search.limit = _ONE
    search.time = _UNKNOWN
    search.status = UNSURE
    return search


@wp.func
def _plane_reached(motion: Motion, distance: wp.float64, time: wp.float64) -> wp.float64:
    """Returns about when the plane of the polygon comes within a distance, by Newton's method from a time.

    The first steps approach the time at which the plane is reached, and are cheaper.

    Returns:
        The time, any number, not finite where that leads nowhere.
    """
    y = coplanarity(motion)
    linear = _THREE * (y.k[1] - y.k[0])
    square = _THREE * (y.k[2] - _TWO * y.k[1] + y.k[0])
    cube = y.k[3] - y.k[0] + _THREE * (y.k[1] - y.k[2])
    reached = time
    for step in range(_PLANE_NEWTON_STEPS):
        t = reached
        value = y.k[0] + t * (linear + t * (square + t * cube))
        slope = linear + t * (_TWO * square + t * _THREE * cube)
        if step < _STEPS_TO_PLANE:
            reached = t - value / slope
        else:
            s = _ONE - t
            normal = s * s * y.n0 + _TWO * s * t * y.nh + t * t * y.n1
            turn = s * (y.nh - y.n0) + t * (y.n1 - y.nh)
            side = wp.where(slope < _ZERO, _ONE, -_ONE)  # from which Y approaches zero
            size = wp.length(normal)
            # of side Y - d |n|
            reached = t - (side * value - distance * size) * size / (
                side * slope * size - _TWO * distance * wp.dot(normal, turn)
            )
    return reached


@wp.func
def _lowest_at(
    kind: int,
    # products of u, v and w with the direction, at both ends
    u: wp.vec2d,
    v: wp.vec2d,
    w: wp.vec2d,
    time: wp.float64,
) -> wp.float64:
    """Returns the least product of a corner of the polygon with a direction at a time."""
    both = wp.vec2d(_ONE - time, time)
    a = wp.dot(u, both)
    b = wp.dot(v, both)
    if kind == VERTEX_FACE:
        return wp.dot(w, both) - wp.max(wp.max(a, b), _ZERO)
    return wp.dot(w, both) - wp.max(a, _ZERO) + wp.min(b, _ZERO)


@wp.func
def _first_below(corner: wp.vec2d, needed: wp.float64, before: wp.float64) -> wp.float64:
    """Returns about when the product of a corner with a direction falls to what is needed, if that is before a time."""
    if corner[1] < needed:
        return wp.min(before, (corner[0] - needed) / (corner[0] - corner[1]))
    return before


@wp.func
def _cleared_until(motion: Motion, direction: wp.vec3d, start: wp.float64, distance: wp.float64) -> wp.float64:
    """Returns a time until which a direction keeps the features farther apart than a distance, from a start on.

    The direction points from the second feature to the first for a vertex and a face, otherwise from the first to the
    second: along it lie the differences of points of :func:`.culling.gaps_along`.

    Bound: products of a dot product have 1 rounding of the vector, 1 of the product and 2 of the sum; the interpolation
    between both ends, by exact factors, has 2 more, and the differences 2: less than those of ``gaps_along``.

    Returns:
        The time, the start itself if the direction does not clear it.
    """
    u = wp.vec2d(wp.dot(direction, motion.u0), wp.dot(direction, motion.u1))
    v = wp.vec2d(wp.dot(direction, motion.v0), wp.dot(direction, motion.v1))
    w = wp.vec2d(wp.dot(direction, motion.w0), wp.dot(direction, motion.w1))
    size = wp.dot(wp.abs(direction), motion.u_size + motion.v_size + motion.w_size)
    bound = motion.roundoff * (DIRECTION_ERROR * size + UNDERFLOW)
    needed = distance * _norm(direction)
    if not _lowest_at(motion.kind, u, v, w, start) - bound > needed:
        return start
    # not certain, but checked: a little more than needed
    more = needed * _AWAY + _TWO * bound
    end = _first_below(w - u, more, _first_below(w, more, _ONE))
    if motion.kind == VERTEX_FACE:
        end = _first_below(w - v, more, end)
    else:
        end = _first_below(w + v - u, more, _first_below(w + v, more, end))
    end = SHORTEST * wp.floor(end / SHORTEST)
    if end > start and _lowest_at(motion.kind, u, v, w, end) - bound > needed:
        return end
    return start


@wp.func
def advance(motion: Motion, distance: wp.float64, timed: bool, before: Search) -> Search:
    """Returns a search by advancement after its next time; it has ended if nothing is left to do, or is given up."""
    if before.ended:
        return before
    search = before
    start = search.start
    limit = search.limit
    first = search.visits == 0
    time = search.time
    if time < start:
        reached = _plane_reached(motion, distance, wp.where(first, _HALF, start))
        time = SHORTEST * wp.floor((reached + _HALF * search.length) / SHORTEST)
        if not (time > start and time < limit):
            time = wp.where(first, _HALF, start)
    u = mix_vector(motion.u0, motion.u1, time)
    v = mix_vector(motion.v0, motion.v1, time)
    w = mix_vector(motion.w0, motion.w1, time)
    at = closest_coordinates(motion.kind, u, v, w)
    gap = between(motion.kind, at, u, v, w)
    velocity = between(motion.kind, at, motion.u1 - motion.u0, motion.v1 - motion.v0, motion.w1 - motion.w0)
    size = wp.length(gap)
    reached = time + (distance - size) * size / wp.dot(gap, velocity)
    reached = SHORTEST * wp.floor((reached + _HALF * search.length) / SHORTEST)
    if _is_within(motion, gap, search.near):
        limit = time
        search.limit = time
        search.found = True
        search.ended = not timed or time == start
    else:
        direction = _unit_scale(wp.where(motion.kind == VERTEX_FACE, gap, -gap))
        search.start = _cleared_until(motion, direction, start, search.far)
        search.ended = search.start >= limit
        if search.ended and not search.found:
            search.status = FREE
    if not search.ended:
        stays = search.start == start
        search.time = wp.where(stays, start, _UNKNOWN)
        if search.found:
            aim = SHORTEST * wp.floor((limit - _AHEAD * search.length) / SHORTEST)
            if aim <= search.start:
                search.ended = True
            elif _plane_clears(restrict_motion(motion, search.start, aim), search.far):
                search.start = aim
                search.ended = True
            search.time = wp.where(time == start, aim, search.start)
        if (search.found or (stays and time == start)) and reached > search.start and reached < limit:
            search.time = reached
        search.given_up = search.time == time
    search.visits += 1
    search.given_up = not search.ended and (search.given_up or search.visits == MAX_ADVANCES)
    search.ended = search.ended or search.given_up
    return search


@wp.func
def visit_part(kind: int, motion: Motion, distance: wp.float64, timed: bool, before: Search) -> Search:
    """Returns a search by subdivision after its next part; it has ended if nothing is left to do."""
    if before.ended:
        return before
    search = before
    start = search.start
    limit = search.limit
    end = wp.min(start + search.width, limit)
    span = end - start
    time = start + SHORTEST * wp.floor(_HALF * span / SHORTEST)
    at, gap = _nearest_at(motion, time)
    if _is_within(motion, gap, search.near):
        search.limit = time
        search.found = True
        search.aimed = False
        search.ended = time == start  # in a shortest part
    else:
        part = restrict_motion(motion, start, end)
        if _direction_clears(part, _unit_scale(gap), search.far) or _polygon_clears(kind, part, at, search.far):
            search.start = end
            search.width = _TWO * search.width
            search.aimed = False
            search.ended = end == limit
            if search.ended and not search.found:
                search.status = FREE
        elif span <= SHORTEST:
            search.ended = True
        else:
            reached = _about_reached(motion, distance, start, limit, time, at, gap)
            is_reached = reached < limit
            reached = wp.min(SHORTEST * wp.floor((reached + _HALF * search.length) / SHORTEST), limit)
            # then, in the first part, the ends of the step
            times = wp.where(search.visits == 0, 3, 1)
            for i in range(times):
                time = wp.where(i == 0, reached, wp.where(i == 1, _ONE, _ZERO))
                at, gap = _nearest_at(motion, time)
                if (i > 0 or is_reached) and _is_within(motion, gap, search.near):
                    search.found = True
                    search.limit = wp.min(search.limit, time)
                    search.ended = time == _ZERO
            aim = search.limit - _AHEAD * search.length - start
            aim = SHORTEST * wp.floor(aim / SHORTEST)
            search.aimed = search.found and not search.aimed and aim > _ZERO and aim < span
            search.width = wp.where(search.aimed, aim, wp.max(_HALF * power_of_two(span), SHORTEST))
    search.visits += 1
    if search.found and (not timed or search.limit - search.start <= search.length):
        search.ended = True
    search.ended = search.ended or search.visits == MAX_VISITS
    return search


@wp.func
def end_search(kind: int, motion: Motion, search: Search) -> Impact:
    """Returns what a search that has ended has found."""
    result = Impact()
    if search.status == FREE:
        result.status = FREE
        result.toi = wp.float64(2.0)
        return result
    result.status = wp.where(search.found, HIT, UNSURE)
    result.within_tolerance = wp.where(search.found and search.limit - search.start <= search.length, 1, 0)
    result.toi = search.start
    coordinates, normal = closest_at(kind, motion, wp.where(search.found, search.limit, search.start))
    result.coordinates = coordinates
    result.normal = normal
    if motion.size == _ZERO:  # the features are one point, at any distance of at least 0
        result.status = HIT
        result.within_tolerance = 1
        result.toi = _ZERO
    return result


@wp.func
def min_distance_impact(kind: int, motion: Motion, distance: wp.float64, timed: bool, tolerance: wp.float64) -> Impact:
    """Returns the status of a query with a minimum distance and, if ``timed``, the first time at which it is reached.

    Args:
        kind: VERTEX_FACE, EDGE_EDGE, VERTEX_EDGE or VERTEX_VERTEX.
        motion: Motion of the query; that of a vertex and a collapsed triangle for the last two.
        distance: The distance in the scale of the motion, at least 0.
        timed: Whether to find the time of a HIT within the tolerance. Otherwise ``toi`` is only a lower bound.
        tolerance: Tolerance of the time of impact, as a share of the step, see :func:`.clamped_tolerance`.

    Returns:
        Coordinates and normal are those of :func:`closest_at`, at the contact.
    """
    search = begin_search(motion, distance, tolerance)
    while not search.ended:
        search = advance(motion, distance, timed, search)
    if search.given_up:
        search = begin_search(motion, distance, tolerance)
        while not search.ended:
            search = visit_part(kind, motion, distance, timed, search)
    return end_search(kind, motion, search)
