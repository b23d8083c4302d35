"""Time of impact by subdivision with certified signs (paper, 5.5), which also decides much that classification cannot.

Classification asks for signs at roots, and a polynomial of a high degree stands behind each. Over a short interval the
signs of the coefficients of degree two and three are enough, so that halving the step certifies what is not degenerate
to within rounding, and finds the first contact on the way.
"""

import warp as wp

from .bernstein import THREE, mix, restrict_cubic, restrict_quadratic
from .classification import constant_signs, verdict
from .closest import between, closest_coordinates, contact_at
from .culling import direction_separates
from .polynomials import Coplanarity, Motion, inside_tests, largest_axis
from .signs import FREE, HIT, UNSURE, certified_sign, certified_sign_cubic

MAX_VISITS = wp.constant(256)
"""Intervals visited after which a query is given up."""

FINEST = wp.constant(wp.float64(2.0**-8))
"""Length of the intervals that are given up if they stay undecided, as a share of the tolerance."""

_ZERO = wp.constant(wp.float64(0.0))
_HALF = wp.constant(wp.float64(0.5))
_ONE = wp.constant(wp.float64(1.0))
_NEWTON_STEPS = wp.constant(12)
_NEWTON_END = wp.constant(wp.float64(2.0**-40))
_CUBIC_ERROR = wp.constant(wp.float64(2.0))
_QUADRATIC_ERROR = wp.constant(wp.float64(2.5))


@wp.struct
class Impact:
    """First contact of a query. Where the status is UNSURE, there is none before ``toi``."""

    status: int
    localized: int  # 1 where contact certainly occurs within the tolerance after ``toi``
    toi: wp.float64  # time of impact, a lower bound in [0, 1]; 2 where the status is FREE
    coordinates: wp.vec3d  # vertex-face: barycentric coordinates in the face; edge-edge: (s, r, 0) along the edges
    normal: wp.vec3d  # unit contact normal, against the motion of the vertex or first edge relative to the other


@wp.func
def mix_vector(x0: wp.vec3d, x1: wp.vec3d, t: wp.float64) -> wp.vec3d:
    """Position at time t of a point that moves from x0 to x1."""
    return (_ONE - t) * x0 + t * x1


@wp.func
def restrict_motion(motion: Motion, start: wp.float64, end: wp.float64) -> Motion:
    """The part of a motion between two times; sizes stay those of the whole."""
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
def status_between(motion: Motion, y: Coplanarity, start: wp.float64, end: wp.float64) -> int:
    """Status over a part of the time: HIT if contact certainly occurs in it, FREE if certainly not.

    Bounds: restriction interpolates twice or thrice, 3r of the size each time: 9r k <= E for the cubic, 6r q <= 1.2F
    for the quadratics.
    """
    k = restrict_cubic(y.k, start, end)
    k_bound = _CUBIC_ERROR * y.bound
    if certified_sign_cubic(k, k_bound) != 0:
        return FREE
    part = restrict_motion(motion, start, end)
    u = _HALF * (part.u0 + part.u1)
    v = _HALF * (part.v0 + part.v1)
    w = _HALF * (part.w0 + part.w1)
    axis = largest_axis(wp.cross(u, v))
    for attempt in range(3):
        tests = inside_tests(motion, y, axis)
        tests.q0 = restrict_quadratic(tests.q0, start, end)
        tests.q1 = restrict_quadratic(tests.q1, start, end)
        tests.q2 = restrict_quadratic(tests.q2, start, end)
        tests.q3 = restrict_quadratic(tests.q3, start, end)
        tests.bounds = _QUADRATIC_ERROR * tests.bounds
        status = verdict(constant_signs(tests))
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
    """A root of a cubic that has opposite signs at 0 and at 1, by Newton's method, kept in place by bisection.

    Nothing is certified: it only says where to look.
    """
    low = _ZERO
    high = _ONE
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
        if (value > _ZERO) == (k[0] > _ZERO):
            low = t
        else:
            high = t
        t -= value / (THREE * (k123 - k012))
        if not (low < t < high):
            t = _HALF * (low + high)
    return t


@wp.func
def power_of_two(x: wp.float64) -> wp.float64:
    """The largest power of two up to a positive number."""
    return wp.cast((wp.cast(x, wp.uint64) >> wp.uint64(52)) << wp.uint64(52), wp.float64)


@wp.func
def first_contact(motion: Motion, y: Coplanarity, tolerance: wp.float64):
    """Time before which there is certainly no contact, found by halving the step, earlier halves first.

    The search ends at the first interval that certainly contains contact and is short enough, which makes its start the
    time of impact to within the tolerance; or at the first that stays undecided, after which nothing is known.
    Contact at a time that halving hits exactly stays undecided on both sides: intervals shorter than half the tolerance
    are therefore tried again stretched to the whole of it.

    Most queries have one root, so the interval around it at which halving would end is tried first: that it contains
    contact, and that all before it is free, are two tests in place of twenty.

    Returns:
        Status (FREE, HIT, UNSURE), time, exact in double precision, 2 if FREE, and the end of the interval that the
        search ended at.
    """
    if y.k[0] * y.k[3] < _ZERO:
        length = power_of_two(tolerance)
        guess = length * wp.floor(approximate_root(y.k) / length)
        if status_between(motion, y, guess, guess + length) == HIT:
            if guess == _ZERO or status_between(motion, y, _ZERO, guess) == FREE:
                return HIT, guess, guess + length
    start = _ZERO
    width = _ONE
    index = wp.int64(0)
    stretched = bool(False)
    for _visit in range(MAX_VISITS):
        end = wp.where(stretched, wp.min(start + tolerance, _ONE), start + width)
        status = status_between(motion, y, start, end)
        if status == HIT and (stretched or width <= tolerance):
            return HIT, start, end
        if stretched:
            stretched = False
        elif status == FREE:
            index += wp.int64(1)
            while width < _ONE and index % wp.int64(2) == wp.int64(0):
                index /= wp.int64(2)
                width += width
            if index == wp.int64(1) and width == _ONE:
                return FREE, wp.float64(2.0), end
            start = wp.float64(index) * width
            continue
        elif width + width <= tolerance:
            stretched = True
            continue
        if width <= FINEST * tolerance:
            return UNSURE, start, end
        index *= wp.int64(2)
        width *= _HALF
    return UNSURE, start, start


@wp.func
def impact(motion: Motion, y: Coplanarity, status: int, tolerance: wp.float64) -> Impact:
    """First contact of a query that classification found to be HIT or UNSURE.

    Args:
        motion: The query.
        y: Its coplanarity.
        status: What classification found.
        tolerance: Of the time of impact, as a share of the step.
    """
    result = Impact()
    found, toi, end = first_contact(motion, y, tolerance)
    if status == HIT and found == FREE:
        # cannot be, unless signs are those that floating point computes: then all that is known is that it starts at 0
        found = UNSURE
        toi = _ZERO
    result.status = wp.where(found == UNSURE, status, found)
    result.localized = wp.where(found == HIT, 1, 0)
    result.toi = toi
    if found == FREE:
        return result

    time = toi
    if found == HIT:
        # between the ends of so short an interval the cubic is all but linear
        k = restrict_cubic(y.k, toi, end)
        time = mix(toi, end, k[0] / (k[0] - k[3]))
    coordinates, normal = contact_at(motion, time)
    result.coordinates = coordinates
    result.normal = normal
    return result
