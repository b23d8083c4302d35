"""Classification of a query by Bernstein signs: FREE, HIT or UNSURE (Algorithm 1)."""

import warp as wp

from .bernstein import scaled_weights, split_cubic, split_quadratic
from .closest import between, closest_coordinates
from .culling import direction_separates
from .polynomials import Coplanarity, InsideTests, Motion, inside_tests, largest_axis
from .roots import MONOTONE, ONE_EXTREMUM, TWO_EXTREMA, UNKNOWN, count_roots, curve_class, largest, quadratic_signs
from .signs import FREE, HIT, UNSURE, ZERO, certified_sign, certified_sign_cubic, certified_sign_quadratic

TINY = wp.constant(wp.float64(2.0**-80))
SPLIT_ERROR = wp.constant(wp.float64(2.5))


@wp.func
def constant_signs(tests: InsideTests) -> wp.vec4i:
    """Returns the sign of each inside test over the whole time, 0 where it is not certainly constant."""
    return wp.vec4i(
        certified_sign_quadratic(tests.q0, tests.bounds[0]),
        certified_sign_quadratic(tests.q1, tests.bounds[1]),
        certified_sign_quadratic(tests.q2, tests.bounds[2]),
        certified_sign_quadratic(tests.q3, tests.bounds[3]),
    )


@wp.func
def verdict(signs: wp.vec4i) -> int:
    """Returns the status at a time at which the four points lie in a plane, from the signs of the inside tests."""
    low = wp.min(wp.min(signs[0], signs[1]), wp.min(signs[2], signs[3]))
    high = wp.max(wp.max(signs[0], signs[1]), wp.max(signs[2], signs[3]))
    if low < 0 and high > 0:
        return FREE
    return wp.where(low == high and low != 0, HIT, UNSURE)


@wp.func
def either(first: int, second: int) -> int:
    """Returns the status of a query from those of two parts of its time."""
    if first == HIT or second == HIT:
        return HIT
    return wp.where(first == FREE and second == FREE, FREE, UNSURE)


@wp.func
def _half(q: wp.vec3d, a: wp.float64, b: wp.float64, first: bool) -> wp.vec3d:
    """Returns one part of a quadratic split at t = a / (a + b)."""
    left, right = split_quadratic(q, a, b)
    return wp.where(first, left, right)


@wp.func
def _classify_part(k: wp.vec4d, bound: wp.float64, tests: InsideTests, shape: int, first: bool) -> int:
    """Returns the status over the whole time, or over that before or after the inflection if there are two extrema.

    Bounds after splitting at weights with sum s, which count as exact: at most 10 roundings of coefficients of
    size s^3 k, below E s^3, so 2.5 s^3 E; likewise 2.5 s^2 F. The weights are scaled to 1 <= s < 4, so that these are
    no less than E and F, and cover underflow as well, as those do.
    """
    part_k, part_bound, part_shape = k, bound, shape
    part = InsideTests()
    part.bounds = tests.bounds
    part.q0 = tests.q0
    part.q1 = tests.q1
    part.q2 = tests.q2
    part.q3 = tests.q3
    if shape == TWO_EXTREMA:
        a, b = scaled_weights(wp.abs((k[2] - k[1]) - (k[1] - k[0])), wp.abs((k[3] - k[2]) - (k[2] - k[1])))
        square = (a + b) * (a + b)
        part_bound = SPLIT_ERROR * square * (a + b) * bound
        k_first, k_second = split_cubic(k, a, b)
        part_k = wp.where(first, k_first, k_second)
        part_shape = curve_class(part_k, part_bound)
        part.bounds = SPLIT_ERROR * square * tests.bounds
        part.q0 = _half(tests.q0, a, b, first)
        part.q1 = _half(tests.q1, a, b, first)
        part.q2 = _half(tests.q2, a, b, first)
        part.q3 = _half(tests.q3, a, b, first)
    if certified_sign_cubic(part_k, part_bound) != 0:
        return FREE
    if shape == TWO_EXTREMA:
        if verdict(constant_signs(part)) == FREE:
            return FREE
        end_signs = certified_sign(part_k[0], part_bound) * certified_sign(part_k[3], part_bound)
        if end_signs == 0 or (part_shape != MONOTONE and part_shape != ONE_EXTREMUM):
            return UNSURE
    roots = count_roots(part_k, part_bound, part_shape)
    if roots == 0:
        return FREE
    if roots == UNKNOWN:
        return UNSURE
    size = largest(part_k)
    s0 = quadratic_signs(part.q0, part.bounds[0], part_k, part_bound, size, roots)
    s1 = quadratic_signs(part.q1, part.bounds[1], part_k, part_bound, size, roots)
    s2 = quadratic_signs(part.q2, part.bounds[2], part_k, part_bound, size, roots)
    s3 = quadratic_signs(part.q3, part.bounds[3], part_k, part_bound, size, roots)
    return either(verdict(wp.vec4i(s0[0], s1[0], s2[0], s3[0])), verdict(wp.vec4i(s0[1], s1[1], s2[1], s3[1])))


@wp.func
def classify_with(k: wp.vec4d, bound: wp.float64, tests: InsideTests) -> int:
    """Returns the status of a query whose cubic may have roots, from the given inside tests."""
    constant = verdict(constant_signs(tests))
    if constant == FREE:
        return FREE
    end_signs = certified_sign(k[0], bound) * certified_sign(k[3], bound)
    if constant == HIT and end_signs < 0:
        return HIT
    shape = curve_class(k, bound)
    if end_signs == 0 or shape == UNKNOWN:
        return UNSURE
    status = int(FREE)
    # a loop that is not unrolled: threads of a warp with one part and with two run the same code
    for part in range(wp.where(shape == TWO_EXTREMA, 2, 1)):
        status = either(status, _classify_part(k, bound, tests, shape, part == 0))
    return status


@wp.func
def _weakly_inside(a: wp.float64, b: wp.float64, c: wp.float64, d: wp.float64) -> bool:
    """Returns whether inside tests at one time have one weak sign, and not all are zero."""
    low = wp.min(wp.min(a, b), wp.min(c, d))
    high = wp.max(wp.max(a, b), wp.max(c, d))
    return (low >= ZERO and high > ZERO) or (high <= ZERO and low < ZERO)


@wp.func
def _touches(k: wp.vec4d, tests: InsideTests) -> bool:
    """Returns whether a query touches at the start or at the end, by the signs that floating point computes."""
    q0 = tests.q0
    q1 = tests.q1
    q2 = tests.q2
    q3 = tests.q3
    starts = k[0] == ZERO and _weakly_inside(q0[0], q1[0], q2[0], q3[0])
    ends = k[3] == ZERO and _weakly_inside(q0[2], q1[2], q2[2], q3[2])
    return starts or ends


@wp.func
def _without_zeros(k: wp.vec4d) -> wp.vec4d:
    """Returns the cubic with zeros at its ends moved, far less than a rounding, to the sign of the next coefficient."""
    tiny = TINY * largest(k)
    start = wp.where(k[1] != ZERO, k[1], wp.where(k[2] != ZERO, k[2], k[3]))
    end = wp.where(k[2] != ZERO, k[2], wp.where(k[1] != ZERO, k[1], k[0]))
    return wp.vec4d(
        wp.where(k[0] == ZERO, wp.where(start < ZERO, -tiny, tiny), k[0]),
        k[1],
        k[2],
        wp.where(k[3] == ZERO, wp.where(end < ZERO, -tiny, tiny), k[3]),
    )


@wp.func
def classify(motion: Motion, y: Coplanarity) -> int:
    """Returns the status of a query from the signs of its polynomials: FREE, HIT or UNSURE (Algorithm 1).

    Constant signs decide most queries. For the others it counts the roots of Y and determines the signs of the inside
    tests there; where Y may have two extrema it is split at its inflection first, homogeneously.

    With roundoff 0, signs are those that floating point computes, and zeros need no subdivision: the inside tests at an
    end of the step decide contact there. A query that is still open counts as contact, as by the paper's weak
    inequalities, unless the direction between the closest points at half time separates the features.
    """
    if certified_sign_cubic(y.k, y.bound) != 0:
        return FREE
    tests = inside_tests(motion, y, largest_axis(y.n0 + y.nh + y.nh + y.n1))
    k = y.k
    status = UNSURE
    for _ in range(2):
        status = classify_with(k, y.bound, tests)
        if status != UNSURE or motion.roundoff > ZERO:
            return status
        if k[0] != ZERO and k[3] != ZERO:
            break
        if _touches(k, tests):
            return HIT
        k = _without_zeros(k)
        if certified_sign_cubic(k, ZERO) != 0:
            return FREE
    u = motion.u0 + motion.u1
    v = motion.v0 + motion.v1
    w = motion.w0 + motion.w1
    direction = between(motion.kind, closest_coordinates(motion.kind, u, v, w), u, v, w)
    return wp.where(direction_separates(motion, direction), FREE, HIT)
