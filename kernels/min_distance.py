"""Whether two moving features come within a minimum distance d, certified by subdivision of the step.

The proofs of :mod:`.separation_proof` show that they do not, each over a whole part of the step. At one time, two
points of the features whose distance is certainly at most d are a HIT.

Two searches look for parts that are free. Most queries end in the first one.

- **Advancement** evaluates the closest points at one time after another. Their direction clears all times around until
  the first corner comes within the distance along it; if these include the start of the rest of the step, that start
  advances to their end. Newton's method on Y and |n| finds the time at which the distance to the plane is about
  reached; it is evaluated next or, where the method fails, the start. If the distance is certainly reached at a time,
  the plane is tried over the part from the start to the tolerance before that time. The search is given up where the
  start does not advance, or after :data:`MAX_ADVANCES` times.
- **Subdivision** goes through the step from part to part: after a part that is free comes one twice as long, and a part
  that nothing decides is halved. Newton's method on the closest points proposes a time, half the tolerance after the
  one at which the distance is about reached; if the distance is certainly reached there, the next part ends within the
  tolerance before it. The search ends at the first part as short as :data:`SHORTEST` that nothing decides, or after
  :data:`MAX_VISITS` parts.

The start of the rest is a lower bound of the time at which the distance is reached.

d is scaled exactly; a d below 2^-400 of the largest coordinate is replaced by 0 for a HIT and by 2^-400 elsewhere.
With a roundoff of 0 the bounds are zero, and the status is the one that floating point computes.
"""

import warp as wp

from .closest import between, closest_coordinates, contact_at, unit_scale
from .culling import DIRECTION_ERROR, centroid_direction
from .distance import nearest_pair
from .polynomials import VERTEX_EDGE, VERTEX_FACE, VERTEX_VERTEX, Motion, coplanarity
from .separation_proof import POINT_ERROR, direction_clears, norm_bound, plane_clears, polygon_clears, sum_of_size
from .signs import FREE, HALF, HIT, ONE, THREE, TWO, UNDERFLOW, UNSURE, ZERO
from .time_of_impact import Impact, clamped_tolerance, mix_vector, power_of_two, restrict_motion

SHORTEST = wp.constant(wp.float64(2.0**-40))
"""Length of the shortest part of a step."""
MAX_VISITS = wp.constant(128)
"""Number of parts after which subdivision stops, unsure."""
MAX_ADVANCES = wp.constant(12)
"""Number of times after which advancement is given up."""

_AHEAD = wp.constant(wp.float64(0.75))
_NEWTON_STEPS = wp.constant(3)
_PLANE_NEWTON_STEPS = wp.constant(6)
_STEPS_TO_PLANE = wp.constant(3)
_UNKNOWN = wp.constant(wp.float64(-1.0))
AWAY = wp.constant(wp.float64(1.0 + 2.0**-38))
SMALLEST = wp.constant(wp.float64(2.0**-400))


@wp.func
def clears_at_once(motion: Motion, distance: wp.float64) -> bool:
    """Returns whether the direction through the centroids, or the plane, keeps the features of a motion apart."""
    far = wp.max(distance, SMALLEST)
    return direction_clears(motion, unit_scale(centroid_direction(motion)), far) or plane_clears(motion, far)


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
        if slope == ZERO:
            return TWO
        time += (distance - size) * size / slope
        if not (time >= start and time <= end):
            return TWO
        at, gap = _nearest_at(motion, time)
    return time


@wp.func
def _is_within(motion: Motion, gap: wp.vec3d, distance: wp.float64) -> bool:
    """Returns whether the vector between two points of the features is certainly no longer than a distance.

    Bound: w has 4 roundings, u and v with the product 5, and the sum 2. Coordinates in a triangle may add up to
    1 + 3r: the sum that is compared, and quotients, are rounded. That is as far from the triangle as 3r of its size.
    """
    size = sum_of_size(motion.u_size + motion.v_size + motion.w_size)
    return norm_bound(gap) + POINT_ERROR * motion.roundoff * size + _underflow(motion.roundoff) <= distance


@wp.func
def _underflow(roundoff: wp.float64) -> wp.float64:
    """Returns an upper bound of the underflow of the squares in a norm; 0 for a roundoff of 0."""
    return wp.where(roundoff > ZERO, UNDERFLOW, ZERO)


@wp.func
def closest_at(kind: int, motion: Motion, time: wp.float64):
    """Returns contact coordinates and unit normal of the closest points at a time, not certified.

    Coordinates are barycentric in the face; (s, r, 0) along the edges; (s, 0, 0) along the edge of a vertex and an
    edge; or zero for two vertices. The normal points from the second feature (face, edge c d, edge, second vertex) to
    the first. If the points touch, it is that of :func:`.contact_at`.
    """
    at, gap = _nearest_at(motion, time)
    coordinates = wp.vec3d(at[0], at[1], ZERO)
    if kind == VERTEX_FACE:
        coordinates = wp.vec3d(ONE - at[0] - at[1], at[0], at[1])
    elif kind == VERTEX_EDGE:
        coordinates = wp.vec3d(at[0], ZERO, ZERO)
    elif kind == VERTEX_VERTEX:
        coordinates = wp.vec3d()
    size = wp.max(wp.abs(gap))
    if size > UNDERFLOW:
        return coordinates, wp.normalize(gap / size)
    _, normal = contact_at(motion, time)
    return coordinates, normal


@wp.struct
class Search:
    """The state of the search through a step."""

    near: wp.float64  # features at most this far apart are a HIT
    far: wp.float64  # features farther apart are free
    length: wp.float64  # tolerance of the time of impact
    start: wp.float64  # of the next part; all before it is free
    width: wp.float64  # of that part
    limit: wp.float64  # end of the times to search
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
    search.near = wp.where(distance >= SMALLEST, distance, ZERO)
    search.far = wp.max(distance, SMALLEST)
    if motion.roundoff == ZERO:
        search.near = distance
        search.far = distance
    search.width = ONE
    search.limit = ONE
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
    linear = THREE * (y.k[1] - y.k[0])
    square = THREE * (y.k[2] - TWO * y.k[1] + y.k[0])
    cube = y.k[3] - y.k[0] + THREE * (y.k[1] - y.k[2])
    reached = time
    for step in range(_PLANE_NEWTON_STEPS):
        t = reached
        value = y.k[0] + t * (linear + t * (square + t * cube))
        slope = linear + t * (TWO * square + t * THREE * cube)
        if step < _STEPS_TO_PLANE:
            reached = t - value / slope
        else:
            s = ONE - t
            normal = s * s * y.n0 + TWO * s * t * y.nh + t * t * y.n1
            turn = s * (y.nh - y.n0) + t * (y.n1 - y.nh)
            side = wp.where(slope < ZERO, ONE, -ONE)  # from which Y approaches zero
            size = wp.length(normal)
            # of side Y - d |n|
            reached = t - (side * value - distance * size) * size / (
                side * slope * size - TWO * distance * wp.dot(normal, turn)
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
    """Returns the smallest product of a corner of the polygon with a direction at a time."""
    both = wp.vec2d(ONE - time, time)
    a = wp.dot(u, both)
    b = wp.dot(v, both)
    if kind == VERTEX_FACE:
        return wp.dot(w, both) - wp.max(wp.max(a, b), ZERO)
    return wp.dot(w, both) - wp.max(a, ZERO) + wp.min(b, ZERO)


@wp.func
def _first_below(corner: wp.vec2d, needed: wp.float64, before: wp.float64) -> wp.float64:
    """Returns about when the product of a corner with a direction falls below a bound, or a given time if earlier."""
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
    needed = distance * norm_bound(direction)
    if not _lowest_at(motion.kind, u, v, w, start) - bound > needed:
        return start
    # not certain, but checked: a little more than needed
    more = needed * AWAY + TWO * bound
    end = _first_below(w - u, more, _first_below(w, more, ONE))
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
    """Returns a search by advancement after its next time; it has ended if nothing remains to do, or is given up."""
    if before.ended:
        return before
    search = before
    start = search.start
    limit = search.limit
    first = search.visits == 0
    time = search.time
    if time < start:
        reached = _plane_reached(motion, distance, wp.where(first, HALF, start))
        time = SHORTEST * wp.floor((reached + HALF * search.length) / SHORTEST)
        if not (time > start and time < limit):
            time = wp.where(first, HALF, start)
    u = mix_vector(motion.u0, motion.u1, time)
    v = mix_vector(motion.v0, motion.v1, time)
    w = mix_vector(motion.w0, motion.w1, time)
    at = closest_coordinates(motion.kind, u, v, w)
    gap = between(motion.kind, at, u, v, w)
    velocity = between(motion.kind, at, motion.u1 - motion.u0, motion.v1 - motion.v0, motion.w1 - motion.w0)
    size = wp.length(gap)
    reached = time + (distance - size) * size / wp.dot(gap, velocity)
    reached = SHORTEST * wp.floor((reached + HALF * search.length) / SHORTEST)
    if _is_within(motion, gap, search.near):
        limit = time
        search.limit = time
        search.found = True
        search.ended = not timed or time == start
    else:
        direction = unit_scale(wp.where(motion.kind == VERTEX_FACE, gap, -gap))
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
            elif plane_clears(restrict_motion(motion, search.start, aim), search.far):
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
    """Returns a search by subdivision after its next part; it has ended if nothing remains to do."""
    if before.ended:
        return before
    search = before
    start = search.start
    limit = search.limit
    end = wp.min(start + search.width, limit)
    span = end - start
    time = start + SHORTEST * wp.floor(HALF * span / SHORTEST)
    at, gap = _nearest_at(motion, time)
    if _is_within(motion, gap, search.near):
        search.limit = time
        search.found = True
        search.aimed = False
        search.ended = time == start  # in a shortest part
    else:
        part = restrict_motion(motion, start, end)
        if direction_clears(part, unit_scale(gap), search.far) or polygon_clears(kind, part, at, search.far):
            search.start = end
            search.width = TWO * search.width
            search.aimed = False
            search.ended = end == limit
            if search.ended and not search.found:
                search.status = FREE
        elif span <= SHORTEST:
            search.ended = True
        else:
            reached = _about_reached(motion, distance, start, limit, time, at, gap)
            is_reached = reached < limit
            reached = wp.min(SHORTEST * wp.floor((reached + HALF * search.length) / SHORTEST), limit)
            # then, in the first part, the ends of the step
            times = wp.where(search.visits == 0, 3, 1)
            for i in range(times):
                time = wp.where(i == 0, reached, wp.where(i == 1, ONE, ZERO))
                at, gap = _nearest_at(motion, time)
                if (i > 0 or is_reached) and _is_within(motion, gap, search.near):
                    search.found = True
                    search.limit = wp.min(search.limit, time)
                    search.ended = time == ZERO
            aim = search.limit - _AHEAD * search.length - start
            aim = SHORTEST * wp.floor(aim / SHORTEST)
            search.aimed = search.found and not search.aimed and aim > ZERO and aim < span
            search.width = wp.where(search.aimed, aim, wp.max(HALF * power_of_two(span), SHORTEST))
    search.visits += 1
    if search.found and (not timed or search.limit - search.start <= search.length):
        search.ended = True
    search.ended = search.ended or search.visits == MAX_VISITS
    return search


@wp.func
def end_search(kind: int, motion: Motion, search: Search) -> Impact:
    """Returns the first contact that a search has found, once it has ended."""
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
    if motion.size == ZERO:  # the features are one point, at any distance of at least 0
        result.status = HIT
        result.within_tolerance = 1
        result.toi = ZERO
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
