"""Queries that aim at trouble, made on a device: those of generators.py, two more, and the lattice {-1, 0, 1}^24.

A generator fills the eight points of one query, in the order p a b c or a b c d at the start, then at the end, from
random bits that a seed and the query's number determine. ``single`` asks for coordinates in single precision.
``make_queries`` and ``make_lattice_queries`` are the kernels.

As in generators.py, most generators work with the gap of a pair: sum(w_i x_i) for signed weights w. A pair touches when
weights in range make it zero. A position is in the first four points and a velocity in the last four, until ``_move``.
"""

import enum

import warp as wp
from compilation import QUICK
from device_random import chance, eighths, integer, lattice, next_number, power, power_of_two, real, seeded, vector

from warp_bsc.kernels.polynomials import VERTEX_FACE

LATTICE = 3**24
"""Number of queries with coordinates in {-1, 0, 1}."""

wp.set_module_options({"enable_backward": False} | QUICK)

_0 = wp.constant(wp.float64(0.0))
_1 = wp.constant(wp.float64(1.0))
_DIGIT = wp.constant(wp.uint64(3))


# --- Points, weights and motions ---


@wp.func
def _rounded(x: wp.array[wp.vec3d], single: bool):
    """Rounds all points to single precision, if asked for."""
    if single:
        for k in range(8):
            p = x[k]
            x[k] = wp.vec3d(wp.float64(wp.float32(p[0])), wp.float64(wp.float32(p[1])), wp.float64(wp.float32(p[2])))


@wp.func
def _move_by_an_ulp(random: wp.array[wp.uint32], single: bool, x: wp.array[wp.vec3d]):
    """Moves one coordinate to the next number, up or down; the points are of the precision already."""
    k = integer(random, 0, 7)
    axis = integer(random, 0, 2)
    p = x[k]
    p[axis] = next_number(p[axis], chance(random, 50), single)
    x[k] = p


@wp.func
def _face_weights(first: wp.float64, second: wp.float64, third: wp.float64) -> wp.vec4d:
    return wp.vec4d(_1, -first, -second, -third)


@wp.func
def _edge_weights(s: wp.float64, r: wp.float64) -> wp.vec4d:
    return wp.vec4d(s - _1, -s, _1 - r, r)


@wp.func
def _weights(random: wp.array[wp.uint32], kind: int, touching: bool) -> wp.vec4d:
    """Returns weights of points of both features, multiples of 1/4; if touching, of corners and sides or ends only."""
    quarter = wp.float64(0.25)
    i = integer(random, 0, 4)
    if kind == VERTEX_FACE:
        j = integer(random, 0, 4 - i)
        if touching:
            j = 4 - i
        first = quarter * wp.float64(i)
        second = quarter * wp.float64(j)
        third = _1 - first - second
        turn = integer(random, 0, 2)
        if turn == 0:
            return _face_weights(first, second, third)
        if turn == 1:
            return _face_weights(second, third, first)
        return _face_weights(third, first, second)
    j = integer(random, 0, 4)
    if touching:
        j = 4 * integer(random, 0, 1)
    if chance(random, 50):
        return _edge_weights(quarter * wp.float64(i), quarter * wp.float64(j))
    return _edge_weights(quarter * wp.float64(j), quarter * wp.float64(i))


@wp.func
def _inner_weights(random: wp.array[wp.uint32], kind: int) -> wp.vec4d:
    """Returns weights of points well inside both features."""
    low = wp.float64(0.1)
    u = real(random, low, wp.float64(0.9))
    v = real(random, low, wp.float64(0.9))
    if kind == VERTEX_FACE:
        first = wp.min(u, v)
        second = wp.max(u, v) - first
        return _face_weights(first, second, _1 - first - second)
    return _edge_weights(u, v)


@wp.func
def _set_gap(kind: int, first: int, weights: wp.vec4d, gap: wp.vec3d, x: wp.array[wp.vec3d]):
    """Translates the vertex or the second edge, at the start or in the last four points, until the gap is as given."""
    shift = gap
    for k in range(4):
        shift -= weights[k] * x[first + k]
    if kind == VERTEX_FACE:
        x[first] = x[first] + shift
    else:
        x[first + 2] = x[first + 2] + shift
        x[first + 3] = x[first + 3] + shift


@wp.func
def _move(time: wp.float64, x: wp.array[wp.vec3d]):
    """Makes start and end of positions at a time, in the first four points, and velocities, in the last four."""
    for k in range(4):
        position = x[k]
        velocity = x[4 + k]
        x[k] = position - time * velocity
        x[4 + k] = position + (_1 - time) * velocity


@wp.func
def _sides(kind: int, first: int, x: wp.array[wp.vec3d]):
    """Returns two sides: of the face, or both edges."""
    if kind == VERTEX_FACE:
        return x[first + 2] - x[first + 1], x[first + 3] - x[first + 1]
    return x[first + 1] - x[first], x[first + 3] - x[first + 2]


@wp.func
def _fill(random: wp.array[wp.uint32], first: int, last: int, size: int, x: wp.array[wp.vec3d]):
    """Fills points with integers up to size, or uniform in [-1, 1]^3 if size is 0."""
    for k in range(first, last):
        if size == 0:
            x[k] = vector(random)
        else:
            x[k] = lattice(random, size)


# --- Generators ---


@wp.func
def _mostly_hits(random: wp.array[wp.uint32], kind: int, x: wp.array[wp.vec3d]):
    """Pairs that pass through each other well inside both features."""
    _fill(random, 0, 8, 0, x)
    weights = _inner_weights(random, kind)
    offset = vector(random)
    _set_gap(kind, 0, weights, offset, x)
    _set_gap(kind, 4, weights, -real(random, wp.float64(0.2), wp.float64(2.0)) * offset, x)


@wp.func
def _near_degenerate(random: wp.array[wp.uint32], kind: int, x: wp.array[wp.vec3d]):
    """Sliver triangles and nearly parallel edges, by 2^-1 to 2^-60, at both ends of a step through each other."""
    thickness = power(real(random, wp.float64(-60.0), -_1))
    weights = _weights(random, kind, False)
    offset = vector(random)
    _fill(random, 0, 8, 0, x)
    for end in range(2):
        first = 4 * end
        base = wp.where(kind == VERTEX_FACE, first + 1, first)
        side = x[base + 1] - x[base]
        origin = x[wp.where(kind == VERTEX_FACE, first + 1, first + 2)]
        x[first + 3] = origin + thickness * vector(random) + real(random, -_1, _1) * side
        _set_gap(kind, first, weights, wp.where(end == 0, offset, -offset), x)


@wp.func
def _coplanar(random: wp.array[wp.uint32], kind: int, x: wp.array[wp.vec3d]):
    """Motion in one plane exactly, parallel to axes or oblique; every other query touches at some time."""
    _fill(random, 0, 8, 8, x)
    if chance(random, 50):
        _set_gap(kind, 0, _weights(random, kind, False), wp.vec3d(), x)
    _move(eighths(random), x)
    along = lattice(random, 3)
    across = lattice(random, 3)
    shift = wp.vec3d()
    if chance(random, 50):
        axis = integer(random, 0, 2)
        along = wp.vec3d()
        across = wp.vec3d()
        along[axis] = _1
        across[(axis + 1) % 3] = _1
        shift = lattice(random, 8)
    for k in range(8):
        p = x[k]
        x[k] = p[0] * along + p[1] * across + shift


@wp.func
def _sliding(random: wp.array[wp.uint32], kind: int, x: wp.array[wp.vec3d]):
    """Features that slide in one plane parallel to axes, with any coordinates in it; most nearly touch at some time."""
    _fill(random, 0, 8, 0, x)
    weights = _weights(random, kind, True)
    if chance(random, 50):
        weights = _inner_weights(random, kind)
    _set_gap(kind, 0, weights, power(real(random, wp.float64(-60.0), _0)) * vector(random), x)
    _move(wp.where(chance(random, 50), eighths(random), real(random, _0, _1)), x)
    axis = integer(random, 0, 2)
    height = real(random, -_1, _1)
    for k in range(8):
        p = x[k]
        p[axis] = height
        x[k] = p


@wp.func
def _exact_contact(random: wp.array[wp.uint32], kind: int, touching: bool, x: wp.array[wp.vec3d]):
    """Exact contact at a known time; if touching, of a vertex with a vertex or an edge."""
    _fill(random, 0, 8, 8, x)
    _set_gap(kind, 0, _weights(random, kind, touching), wp.vec3d(), x)
    _move(eighths(random), x)


@wp.func
def _mixed_scales(random: wp.array[wp.uint32], kind: int, x: wp.array[wp.vec3d]):
    """Scales from 2^-100 to 2^100: one for each query, for each of its points, or for each coordinate."""
    _mostly_hits(random, kind, x)
    low = wp.float64(-100.0)
    high = wp.float64(100.0)
    how = integer(random, 0, 2)
    scale = wp.vec3d(power(real(random, low, high)))
    for k in range(8):
        if how == 1:
            scale = wp.vec3d(power(real(random, low, high)))
        elif how == 2:
            scale = wp.vec3d(
                power(real(random, low, high)), power(real(random, low, high)), power(real(random, low, high))
            )
        x[k] = wp.cw_mul(x[k], scale)


@wp.func
def _shared_coordinates(random: wp.array[wp.uint32], x: wp.array[wp.vec3d]):
    """Random points that have coordinates of one another, and points that repeat, at one end or throughout."""
    _fill(random, 0, 8, 0, x)
    for _ in range(6):
        axis = integer(random, 0, 2)
        k = integer(random, 0, 7)
        p = x[k]
        other = x[integer(random, 0, 7)]
        p[axis] = other[axis]
        x[k] = p
    if chance(random, 50):
        x[integer(random, 0, 7)] = x[integer(random, 0, 7)]
    if chance(random, 30):
        target = integer(random, 0, 3)
        source = integer(random, 0, 3)
        x[target] = x[source]
        x[4 + target] = x[4 + source]


@wp.func
def _resting_contact(random: wp.array[wp.uint32], kind: int, x: wp.array[wp.vec3d]):
    """One plane at t = 0: held, carried along, lifting or sliding; two thirds of them touch there."""
    _fill(random, 0, 4, 8, x)
    weights = _weights(random, kind, False)
    if chance(random, 33):
        # weights out of range put the pair in one plane without contact
        out = wp.float64(integer(random, 1, 2))
        weights += out * wp.where(kind == VERTEX_FACE, wp.vec4d(_0, -_1, _1, _0), wp.vec4d(-_1, _1, _0, _0))
    _set_gap(kind, 0, weights, wp.vec3d(), x)
    how = integer(random, 0, 3)
    velocity = lattice(random, 4)
    if how == 3:
        velocity = wp.float64(integer(random, -1, 1)) * (x[1] - x[2])
    for k in range(4):
        is_mover = wp.where(kind == VERTEX_FACE, k == 0, k > 1)
        x[4 + k] = wp.where(how == 1 or (how > 1 and is_mover), velocity, wp.vec3d())
    _move(_0, x)


@wp.func
def _grazing(random: wp.array[wp.uint32], kind: int, single: bool, x: wp.array[wp.vec3d]):
    """Contact without relative velocity along the normal, a double root, exactly or with a coordinate an ulp off."""
    _fill(random, 0, 8, 4, x)
    weights = _weights(random, kind, False)
    _set_gap(kind, 0, weights, wp.vec3d(), x)
    first, second = _sides(kind, 0, x)
    slide = wp.float64(integer(random, -1, 1)) * first + wp.float64(integer(random, -1, 1)) * second
    _set_gap(kind, 4, weights, slide, x)
    _move(eighths(random), x)
    if chance(random, 50):
        _move_by_an_ulp(random, single, x)


@wp.func
def _near_double_roots(random: wp.array[wp.uint32], kind: int, x: wp.array[wp.vec3d]):
    """Relative velocity that is nearly in the plane of a near contact at any time: two roots nearby, or none."""
    _fill(random, 0, 8, 0, x)
    weights = _inner_weights(random, kind)
    if chance(random, 30):
        weights = _weights(random, kind, True)
    off = power(real(random, wp.float64(-56.0), wp.float64(-4.0)))
    _set_gap(kind, 0, weights, off * vector(random), x)
    first, second = _sides(kind, 0, x)
    slide = real(random, -_1, _1) * first + real(random, -_1, _1) * second
    off = power(real(random, wp.float64(-56.0), wp.float64(-4.0)))
    _set_gap(kind, 4, weights, slide + off * vector(random), x)
    _move(real(random, _0, _1), x)


@wp.func
def _collapse(kind: int, first: int, ratio: int, to_point: bool, x: wp.array[wp.vec3d]):
    """Makes the face a segment or a point, or the edges parallel or one of them, or both, a point."""
    i = wp.where(kind == VERTEX_FACE, first + 1, first)
    j = i + 1
    base = x[wp.where(kind == VERTEX_FACE, first + 1, first + 2)]
    x[first + 3] = base + wp.float64(ratio) * (x[j] - x[i])
    if to_point:
        x[j] = x[i]
        if ratio > 0:
            x[first + 3] = base


@wp.func
def _collapsing(random: wp.array[wp.uint32], kind: int, x: wp.array[wp.vec3d]):
    """Triangles that are segments or points, edges that are parallel or points, once or always; most touch then."""
    _fill(random, 0, 8, 4, x)
    to_point = chance(random, 40)
    ratio = integer(random, -2, 2)
    _collapse(kind, 0, ratio, to_point, x)
    if chance(random, 30):
        _collapse(kind, 4, ratio, to_point, x)
    if chance(random, 70):
        _set_gap(kind, 0, _weights(random, kind, False), wp.vec3d(), x)
    _move(eighths(random), x)


@wp.func
def _subnormal_and_huge(random: wp.array[wp.uint32], kind: int, single: bool, x: wp.array[wp.vec3d]):
    """Exact contacts, half of them an ulp apart, scaled to subnormal or huge numbers, by query or by point."""
    _exact_contact(random, kind, False, x)
    # the points are multiples of 2^-3 below 2^6
    small = power_of_two(wp.where(single, -146, -1071))
    huge = power_of_two(wp.where(single, 122, 1018))
    by_point = chance(random, 30)
    is_small = chance(random, 50)
    for k in range(8):
        if by_point:
            is_small = chance(random, 50)
        x[k] = wp.where(is_small, small, huge) * x[k]
    if chance(random, 50):
        _move_by_an_ulp(random, single, x)


class Generator(enum.IntEnum):
    """The generators, by their numbers in ``make_queries``."""

    UNIFORM = 0
    MOSTLY_HITS = 1
    NEAR_DEGENERATE = 2
    COPLANAR = 3
    ALMOST_COPLANAR = 4
    SLIDING = 5
    ONE_ULP_APART = 6
    MIXED_SCALES = 7
    INTEGER_LATTICE = 8
    SHARED_COORDINATES = 9
    RESTING_CONTACT = 10
    GRAZING = 11
    NEAR_DOUBLE_ROOTS = 12
    COLLAPSING = 13
    TOUCHING = 14
    SUBNORMAL_AND_HUGE = 15


@wp.kernel
def make_queries(
    generator: int,
    kind: int,
    single: bool,
    seed: int,
    first: wp.int64,
    points: wp.array2d[wp.vec3d],
):
    i = wp.tid()
    x = points[i]
    random = wp.zeros(shape=(1,), dtype=wp.uint32)
    random[0] = seeded(seed, first + wp.int64(i))
    if generator == Generator.UNIFORM:
        _fill(random, 0, 8, 0, x)
    elif generator == Generator.MOSTLY_HITS:
        _mostly_hits(random, kind, x)
    elif generator == Generator.NEAR_DEGENERATE:
        _near_degenerate(random, kind, x)
    elif generator == Generator.COPLANAR:
        _coplanar(random, kind, x)
    elif generator == Generator.ALMOST_COPLANAR:
        _coplanar(random, kind, x)
        for _ in range(integer(random, 1, 3)):
            _move_by_an_ulp(random, single, x)
    elif generator == Generator.SLIDING:
        _sliding(random, kind, x)
    elif generator == Generator.ONE_ULP_APART:
        _exact_contact(random, kind, False, x)
        _move_by_an_ulp(random, single, x)
    elif generator == Generator.MIXED_SCALES:
        _mixed_scales(random, kind, x)
    elif generator == Generator.INTEGER_LATTICE:
        _fill(random, 0, 8, 2, x)
    elif generator == Generator.SHARED_COORDINATES:
        _shared_coordinates(random, x)
    elif generator == Generator.RESTING_CONTACT:
        _resting_contact(random, kind, x)
    elif generator == Generator.GRAZING:
        _grazing(random, kind, single, x)
    elif generator == Generator.NEAR_DOUBLE_ROOTS:
        _near_double_roots(random, kind, x)
    elif generator == Generator.COLLAPSING:
        _collapsing(random, kind, x)
    elif generator == Generator.TOUCHING:
        _exact_contact(random, kind, True, x)
    else:
        _subnormal_and_huge(random, kind, single, x)
    _rounded(x, single)


@wp.kernel
def make_lattice_queries(first: wp.int64, stride: wp.int64, points: wp.array2d[wp.vec3d]):
    """Makes queries of {-1, 0, 1}^24: coordinate k of number n is the digit of n in base 3 that counts 3^k, less 1."""
    i = wp.tid()
    number = wp.uint64(first + stride * wp.int64(i))
    for k in range(8):
        p = wp.vec3d()
        for axis in range(3):
            p[axis] = wp.float64(number % _DIGIT) - _1
            number = number / _DIGIT
        points[i, k] = p
