"""Time of impact by subdivision with certified signs (Sec. 5.5), which also decides queries that classification cannot.

Classification needs signs at roots, each the sign of a polynomial of a high degree. Over a short interval the signs of
coefficients of degree two and three are enough, so that subdivision certifies all queries that are not degenerate to
within rounding, and finds the first contact on the way.
"""

import warp as wp

from .bernstein import mix, restrict_cubic, restrict_quadratic
from .classification import constant_signs, verdict
from .closest import between, closest_coordinates, contact_at
from .culling import direction_separates
from .polynomials import EDGE_EDGE, Coplanarity, Motion, inside_tests, largest_axis
from .roots import largest
from .signs import FREE, HALF, HIT, ONE, THREE, UNSURE, ZERO, certified_sign, certified_sign_cubic

MAX_VISITS = wp.constant(256)
"""Number of intervals after which the search stops, unsure."""

MIN_DIGITS = 10
"""Smallest number of binary digits of a time of impact, for any tolerance."""

FINEST = wp.constant(wp.float64(2.0**-8))
"""Length of the shortest intervals, as a share of the tolerance."""

_PLANAR = wp.constant(wp.float64(64.0))  # longest interval that ends the search where Y is zero, in tolerances
_NEWTON_STEPS = wp.constant(12)
_NEWTON_END = wp.constant(wp.float64(2.0**-40))
_CUBIC_ERROR = wp.constant(wp.float64(2.0))
_SMALLEST_TOLERANCE = wp.constant(wp.float64(2.0**-38))
_LARGEST_TOLERANCE = wp.constant(wp.float64(2.0**-MIN_DIGITS))
_QUADRATIC_ERROR = wp.constant(wp.float64(2.5))

SEARCH_CONSTANTS = {
    "max_visits": int(MAX_VISITS),
    "finest": float(FINEST),
    "planar": float(_PLANAR),
    "newton_steps": int(_NEWTON_STEPS),
    "newton_end": float(_NEWTON_END),
    "cubic_error": float(_CUBIC_ERROR),
    "quadratic_error": float(_QUADRATIC_ERROR),
}
"""The constants of the search for the first contact, by name."""


@wp.struct
class Impact:
    """The first contact of a query; if the status is UNSURE, there is none before ``toi``.

    Coordinates and normal are those at the contact, up to rounding and the square of the tolerance; if
    ``within_tolerance`` is 0, those of the closest points at ``toi``. The normal of parallel edges and of a collapsed
    triangle, which have no plane, is along the velocity; where that is zero too, it is (0, 0, 1).

    Attributes:
        status: FREE, HIT or UNSURE.
        within_tolerance: 1 where contact certainly occurs within the tolerance after ``toi``, else 0.
        toi: Time of impact, a lower bound in [0, 1]; 2 where the status is FREE.
        coordinates: Of a vertex and a face, barycentric coordinates in the face; of two edges, (s, r, 0) along them.
        normal: Unit contact normal, against the motion of the vertex or first edge relative to the other.
        grazing: 1 where gradients are clamped, or the contact is not certain, see :mod:`.gradients`, else 0.
    """

    status: int
    within_tolerance: int
    toi: wp.float64
    coordinates: wp.vec3d
    normal: wp.vec3d
    grazing: int


@wp.func
def clamped_tolerance(tolerance: wp.float64) -> wp.float64:
    """Returns the tolerance clamped to [2^-38, 2^-10]; 2^-38 for NaN.

    Times are exact down to the lower limit. A tolerance above the upper one would save nothing, because the search goes
    straight to the root, but would leave intervals in which the cubic is not linear.
    """
    return wp.where(tolerance > _SMALLEST_TOLERANCE, wp.min(tolerance, _LARGEST_TOLERANCE), _SMALLEST_TOLERANCE)


@wp.func
def mix_vector(x0: wp.vec3d, x1: wp.vec3d, t: wp.float64) -> wp.vec3d:
    """Returns the position at time t of a point that moves from x0 to x1."""
    return (ONE - t) * x0 + t * x1


@wp.func
def restrict_motion(motion: Motion, start: wp.float64, end: wp.float64) -> Motion:
    """Returns the part of a motion between two times; its sizes are those of the whole motion."""
    part = Motion()
    part.u0 = mix_vector(motion.u0, motion.u1, start)
    part.u1 = mix_vector(motion.u0, motion.u1, end)
    part.v0 = mix_vector(motion.v0, motion.v1, start)
    part.v1 = mix_vector(motion.v0, motion.v1, end)
    part.w0 = mix_vector(motion.w0, motion.w1, start)
    part.w1 = mix_vector(motion.w0, motion.w1, end)
    part.u_size = motion.u_size
    part.v_size = motion.v_size
    part.w_size = motion.w_size
    part.kind = motion.kind
    part.roundoff = motion.roundoff
    return part


@wp.func
def verdict_between(motion: Motion, y: Coplanarity, axis: int, start: wp.float64, end: wp.float64) -> int:
    """Returns the status wherever Y is zero over a part of the time, by the inside tests along an axis."""
    tests = inside_tests(motion, y, axis)
    tests.q0 = restrict_quadratic(tests.q0, start, end)
    tests.q1 = restrict_quadratic(tests.q1, start, end)
    tests.q2 = restrict_quadratic(tests.q2, start, end)
    tests.q3 = restrict_quadratic(tests.q3, start, end)
    tests.bounds = _QUADRATIC_ERROR * tests.bounds
    return verdict(constant_signs(tests))


@wp.func
def status_between(motion: Motion, y: Coplanarity, k: wp.vec4d, start: wp.float64, end: wp.float64) -> int:
    """Returns the status over a part of the time: HIT if contact certainly occurs in it, FREE if certainly not.

    The cubic k is Y restricted to that part.

    Bounds: restriction interpolates twice or thrice, 3r of the size each time: 9r k <= E for the cubic, 6r q <= 1.2F
    for the quadratics.
    """
    k_bound = _CUBIC_ERROR * y.bound
    if certified_sign_cubic(k, k_bound) != 0:
        return FREE
    part = restrict_motion(motion, start, end)
    u = HALF * (part.u0 + part.u1)
    v = HALF * (part.v0 + part.v1)
    w = HALF * (part.w0 + part.w1)
    axis = largest_axis(wp.cross(u, v))
    for attempt in range(3):
        status = verdict_between(motion, y, axis, start, end)
        if status == FREE:
            return FREE
        if status == HIT:
            return wp.where(certified_sign(k[0], k_bound) * certified_sign(k[3], k_bound) < 0, HIT, UNSURE)
        if attempt == 0:
            coordinates = closest_coordinates(motion.kind, u, v, w)
            if direction_separates(part, between(motion.kind, coordinates, u, v, w)):
                return FREE
        axis = wp.where(axis == 2, 0, axis + 1)
    return UNSURE


@wp.func
def approximate_root(k: wp.vec4d) -> wp.float64:
    """Returns a root of a cubic with opposite signs at 0 and at 1, by Newton's method with bisection as a safeguard."""
    low = ZERO
    high = ONE
    t = k[0] / (k[0] - k[3])
    for _ in range(_NEWTON_STEPS):
        k01 = mix(k[0], k[1], t)
        k12 = mix(k[1], k[2], t)
        k23 = mix(k[2], k[3], t)
        k012 = mix(k01, k12, t)
        k123 = mix(k12, k23, t)
        value = mix(k012, k123, t)
        if wp.abs(value) <= _NEWTON_END * wp.abs(k[3] - k[0]):
            break
        if (value > ZERO) == (k[0] > ZERO):
            low = t
        else:
            high = t
        t -= value / (THREE * (k123 - k012))
        if not (low < t < high):
            t = HALF * (low + high)
    return t


@wp.func
def approximate_extremum(k: wp.vec4d) -> wp.float64:
    """Returns where in [0, 1] a cubic with one sign at 0 and at 1 turns back from zero; 0 or 1 if nowhere."""
    d0 = k[1] - k[0]
    d1 = k[2] - k[1]
    d2 = k[3] - k[2]
    discriminant = d1 * d1 - d0 * d2
    if discriminant <= ZERO:
        return ZERO
    # the root at which the derivative d rises if Y is positive, or falls if Y is negative
    root = wp.where(k[0] > ZERO, wp.sqrt(discriminant), -wp.sqrt(discriminant))
    b = d0 - d1
    if b * root >= ZERO:
        return wp.clamp((b + root) / (b - d1 + d2), ZERO, ONE)
    return wp.clamp(d0 / (b - root), ZERO, ONE)


@wp.func
def approximate_contact_time(k: wp.vec4d) -> wp.float64:
    """Returns an uncertified time in (0, 1) at which a cubic is about zero or nearest to it; 0 or 1 if none."""
    if k[0] * k[3] < ZERO:
        return approximate_root(k)
    return approximate_extremum(k)


@wp.func
def _first_crossing(before: wp.float64, at_start: wp.float64, at_end: wp.float64) -> wp.float64:
    """Returns when a number that changes linearly falls to zero, if that is earlier than a given time."""
    if at_end < ZERO:
        return wp.min(before, at_start / (at_start - at_end))
    return before


@wp.func
def approximate_meeting_time(motion: Motion, start: wp.float64, end: wp.float64) -> wp.float64:
    """Returns an uncertified time of a part of the step at which features meet that stay in a plane, 1 if they do not.

    The direction between their closest points at the start of the part separates them until then, 0 standing for the
    start of the part and 1 for its end. It may be any number, or NaN, where that leads nowhere.
    """
    part = restrict_motion(motion, start, end)
    coordinates = closest_coordinates(motion.kind, part.u0, part.v0, part.w0)
    direction = between(motion.kind, coordinates, part.u0, part.v0, part.w0)
    if motion.kind == EDGE_EDGE:
        direction = -direction
    u0 = wp.dot(direction, part.u0)
    v0 = wp.dot(direction, part.v0)
    w0 = wp.dot(direction, part.w0)
    u1 = wp.dot(direction, part.u1)
    v1 = wp.dot(direction, part.v1)
    w1 = wp.dot(direction, part.w1)
    time = _first_crossing(_first_crossing(ONE, w0, w1), w0 - u0, w1 - u1)
    if motion.kind == EDGE_EDGE:
        return _first_crossing(_first_crossing(time, w0 + v0, w1 + v1), w0 - u0 + v0, w1 - u1 + v1)
    return _first_crossing(time, w0 - v0, w1 - v1)


@wp.func
def power_of_two(x: wp.float64) -> wp.float64:
    """Returns the largest power of two that is at most a positive number."""
    return wp.cast((wp.cast(x, wp.uint64) >> wp.uint64(52)) << wp.uint64(52), wp.float64)


@wp.func
def first_contact(motion: Motion, y: Coplanarity, status: int, tolerance: wp.float64):
    """Returns a time before which there is certainly no contact, by testing one interval after the other.

    After an interval that is certainly free comes the other half, or one twice as long. An unsure interval becomes
    shorter: it ends half the tolerance before a root of Y, so that it is usually free and the next one, as long as the
    tolerance, certainly contains contact; or before Y turns back from zero; or, if Y is zero, before the direction
    between the closest points at its start no longer separates the features; or it is halved.

    The search ends at the first interval that certainly contains contact and is short enough: its start is the time of
    impact to within the tolerance. Or it ends at an interval that stays unsure, with an unknown status from there
    on. That interval has the shortest length; or the length of the tolerance, with an unsure shortest interval
    around the root; or it is the whole step, if the features may touch at the start and the shortest interval there is
    unsure; or Y is zero in it to within its bound, so that no part of it certainly contains contact, and it is short
    enough for a lower bound of the time.

    All times are multiples of the shortest length, a power of two, and hence exact.

    Args:
        motion: Motion of the query.
        y: Coplanarity of the query.
        status: Status from classification; if it is HIT, the search does not test the whole step again.
        tolerance: Tolerance of the time, as a share of the step, see :func:`clamped_tolerance`.

    Returns:
        Status (FREE, HIT, UNSURE); time, exact in double precision, 2 if FREE; end of the last interval.
    """
    length = power_of_two(clamped_tolerance(tolerance))
    shortest = FINEST * length
    start = ZERO
    end = ONE
    root = ZERO
    ahead = bool(False)  # whether a root may be half the tolerance after the end of the interval
    passing = bool(False)  # whether the interval is the one around that root
    halved = bool(False)  # whether the interval is half of an unsure one
    probing = bool(False)  # whether the shortest interval around the root is tested, not the interval
    probed = certified_sign(y.k[0], y.bound) != 0
    current = status
    k = y.k
    for visit in range(MAX_VISITS):
        width = end - start
        if visit > 0 or status != HIT:
            low = wp.where(probing, wp.max(root - shortest, start), start)
            high = wp.where(probing, wp.min(root + shortest, end), end)
            k = restrict_cubic(y.k, low, high)
            current = status_between(motion, y, k, low, high)
        half = shortest * wp.floor(HALF * width / shortest)
        is_planar = largest(k) <= _CUBIC_ERROR * y.bound
        if probing:
            if current == UNSURE:
                return UNSURE, start, end
            probing = False
            probed = True
            end = start + half
            halved = True
        elif current == HIT and width <= length:
            return HIT, start, end
        elif current == FREE:
            if end == ONE:
                return FREE, wp.float64(2.0), end
            start = end
            width = wp.where(ahead, length, wp.where(halved, width, width + width))
            end = wp.where(passing, ONE, wp.min(start + width, ONE))
            passing = ahead
            ahead = False
            halved = False
            probed = False
        elif width <= shortest or (width <= _PLANAR * length and is_planar):
            return UNSURE, start, end
        elif start == ZERO and not probed:
            probing = True
        else:
            time = wp.float64(0.0)
            if is_planar:  # noqa: SIM108 (of an expression Warp would evaluate both)
                time = approximate_meeting_time(motion, start, end)
            else:
                time = approximate_contact_time(k)
            root = start + shortest * wp.floor(width * time / shortest)
            ahead = False
            passing = False
            halved = False
            if not (time > ZERO and time < ONE) or (probed and width <= length):
                end = start + half
                halved = True
            elif root - HALF * length > start:
                end = root - HALF * length
                ahead = True
            elif width > length:
                end = start + length
                passing = True
            else:
                probing = True
    return UNSURE, start, end


@wp.func
def simple_contact(motion: Motion, y: Coplanarity, status: int, tolerance: wp.float64):
    """Returns what :func:`first_contact` does, if that takes two intervals of a HIT query; else UNSURE.

    The first interval, up to a root, is free by the sign of Y, and the second has a contact by its first axis.
    """
    length = power_of_two(clamped_tolerance(tolerance))
    shortest = FINEST * length
    bound = _CUBIC_ERROR * y.bound
    start = shortest * wp.floor(approximate_contact_time(y.k) / shortest) - HALF * length
    end = wp.min(start + length, ONE)
    k = restrict_cubic(y.k, start, end)
    part = restrict_motion(motion, start, end)
    axis = largest_axis(wp.cross(HALF * (part.u0 + part.u1), HALF * (part.v0 + part.v1)))
    found = status == HIT and start > ZERO and start < ONE - HALF * length
    found = found and certified_sign_cubic(restrict_cubic(y.k, ZERO, start), bound) != 0
    found = found and certified_sign(k[0], bound) * certified_sign(k[3], bound) < 0
    found = found and verdict_between(motion, y, axis, start, end) == HIT
    return wp.where(found, HIT, UNSURE), start, end


@wp.func
def impact(motion: Motion, y: Coplanarity, status: int, tolerance: wp.float64, simple: bool = False) -> Impact:
    """Returns the first contact of a query that is HIT or UNSURE by classification.

    Args:
        motion: Motion of the query.
        y: Coplanarity of the query.
        status: Status from classification.
        tolerance: Tolerance of the time of impact, as a share of the step, see :func:`clamped_tolerance`.
        simple: Whether to search by :func:`simple_contact`; the result counts only if it is within the tolerance.
    """
    result = Impact()
    found = int(UNSURE)
    toi = wp.float64(0.0)
    end = wp.float64(1.0)
    if not simple:
        found, toi, end = first_contact(motion, y, status, tolerance)
    else:
        found, toi, end = simple_contact(motion, y, status, tolerance)
    if status == HIT and found == FREE:
        # possible only with signs that floating point computes, roundoff 0: then the only lower bound is 0
        found = UNSURE
        toi = ZERO
    result.status = wp.where(found == UNSURE, status, found)
    result.within_tolerance = wp.where(found == HIT, 1, 0)
    result.toi = toi
    if found == FREE:
        return result

    time = toi
    if found == HIT:
        # the interval is so short that the cubic is nearly linear in it, and its signs at the ends are opposite
        k = restrict_cubic(y.k, toi, end)
        time = mix(toi, end, k[0] / (k[0] - k[3]))
    coordinates, normal = contact_at(motion, time)
    result.coordinates = coordinates
    result.normal = normal
    return result
