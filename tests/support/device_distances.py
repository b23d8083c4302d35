"""Queries with minimum distances, made on a device: distances that are reached exactly, and any others."""

import warp as wp
from compilation import QUICK
from device_random import integer, real, seeded

from warp_bsc.kernels.polynomials import EDGE_EDGE, VERTEX_EDGE, VERTEX_VERTEX
from warp_bsc.kernels.signs import FREE, HIT

wp.set_module_options({"enable_backward": False} | QUICK)

_0 = wp.constant(wp.float64(0.0))
_1 = wp.constant(wp.float64(1.0))
_2 = wp.constant(wp.float64(2.0))
_3 = wp.constant(wp.float64(3.0))
_4 = wp.constant(wp.float64(4.0))
_5 = wp.constant(wp.float64(5.0))
_6 = wp.constant(wp.float64(6.0))
_7 = wp.constant(wp.float64(7.0))
_SMALLEST = wp.constant(wp.float64(2.0**-1021))
_LARGEST = wp.constant(wp.float64(2.0**1000))
_SHARE = wp.constant(wp.float64(2.0**-40))
_NEXT = wp.constant(wp.uint64(1))


@wp.func
def _as_kind(kind: int, first: int, x: wp.array[wp.vec3d]):
    """Makes the face of a vertex and an edge, or of two vertices, from one of a vertex and a face."""
    if kind == VERTEX_EDGE:
        x[first + 3] = x[first + 1]
    elif kind == VERTEX_VERTEX:
        x[first + 2] = x[first + 1]
        x[first + 3] = x[first + 1]


@wp.func
def _in_plane(random: wp.array[wp.uint32], size: int, depth: wp.float64) -> wp.vec3d:
    """Returns a point of a lattice of multiples of 4 along x and y, at a depth along z."""
    x = wp.float64(4 * integer(random, -size, size))
    return wp.vec3d(x, wp.float64(4 * integer(random, -size, size)), depth)


@wp.func
def _touching_point(random: wp.array[wp.uint32], first: int, last: int, x: wp.array[wp.vec3d]) -> wp.vec3d:
    """Returns an integer point of a feature in its plane, z = 0: of up to three points, the first of which is in it."""
    quarters = int(4)
    point = wp.vec3d()
    for k in range(first + 1, last):
        position = x[k]
        if position[2] == _0:
            weight = integer(random, 0, quarters)
            point += wp.float64(weight) * position
            quarters -= weight
    point += wp.float64(quarters) * x[first]
    return point / wp.float64(4.0)


@wp.func
def _frame(number: int):
    """Returns three orthogonal vectors of integers, of the same length, which is an integer, and that."""
    if number == 1:
        return wp.vec3d(_1, _2, _2), wp.vec3d(_2, _1, -_2), wp.vec3d(_2, -_2, _1), _3
    if number == 2:
        return wp.vec3d(_2, _3, _6), wp.vec3d(_3, -_6, _2), wp.vec3d(_6, _2, -_3), _7
    if number == 3:
        return wp.vec3d(_4, _3, _0), wp.vec3d(-_3, _4, _0), wp.vec3d(_0, _0, _5), _5
    return wp.vec3d(_1, _0, _0), wp.vec3d(_0, _1, _0), wp.vec3d(_0, _0, _1), _1


@wp.func
def _nudged(random: wp.array[wp.uint32], reached: wp.float64) -> wp.float64:
    """Returns a distance, or the next number, or one that differs by 2^-40 of it, either way."""
    least = reached
    how = integer(random, 0, 4)
    if how == 1:
        least = wp.cast(wp.cast(reached, wp.uint64) + _NEXT, wp.float64)
    elif how == 2:
        least = wp.cast(wp.cast(reached, wp.uint64) - _NEXT, wp.float64)
    elif how == 3:
        least = reached + _SHARE * reached
    elif how == 4:
        least = reached - _SHARE * reached
    return least


@wp.kernel
def make_reached_queries(
    kind: int,
    single: bool,
    seed: int,
    first: wp.int64,
    points: wp.array2d[wp.vec3d],
    distance: wp.array[wp.float64],
    truth: wp.array[int],
):
    """Makes queries that come exactly as near as a known distance, and minimum distances that are this or nearly this.

    At all times one feature is behind the plane z = 0, the other beyond z = height. At one time both have points in
    these planes, one above the other, so that their distance is the height there, and nowhere less: the planes move
    apart before and after, or points slide in them. Turned, and scaled by a power of two.
    """
    i = wp.tid()
    x = points[i]
    random = wp.zeros(shape=(1,), dtype=wp.uint32)
    random[0] = seeded(seed, first + wp.int64(i))
    second = wp.where(kind == EDGE_EDGE, 2, 1)
    degenerate = integer(random, 0, 2) == 0
    parallel = degenerate and kind == EDGE_EDGE and integer(random, 0, 2) > 0
    moves = integer(random, 0, 9) > 0
    # small numbers, with which floating point hardly rounds, or large ones, still exact in the precision when turned
    size = wp.where(integer(random, 0, 1) == 0, 8, wp.where(single, 512, 67108864))
    for k in range(4):
        depth = _0
        if k != 0 and k != second and integer(random, 0, 1) > 0 and not parallel:
            depth = wp.float64(integer(random, 1, size))
        x[k] = _in_plane(random, size, depth)
        x[4 + k] = wp.where(moves, _in_plane(random, size // 4, _0), wp.vec3d())
    if parallel:
        x[3] = x[2] + x[1] - x[0]
    elif degenerate:
        x[3] = x[2]
    _as_kind(kind, 0, x)
    _as_kind(kind, 4, x)
    # the second feature above the first
    shift = _touching_point(random, 0, second, x) - _touching_point(random, second, 4, x)
    height = wp.float64(integer(random, 1, size))
    when = integer(random, 0, 4)
    time = wp.where(when == 0, _0, wp.where(when == 1, _1, wp.float64(when) * wp.float64(0.25) - wp.float64(0.125)))
    rise = wp.float64(integer(random, 0, size)) * wp.where(when == 0, _1, wp.where(when == 1, -_1, _0))
    for k in range(4):
        position = x[k]
        velocity = x[4 + k]
        if k < second:
            position[2] = -position[2]
        else:
            position += wp.vec3d(shift[0], shift[1], height)
            velocity[2] = rise
        x[k] = position - time * velocity
        x[4 + k] = position + (_1 - time) * velocity
    # nudged, turned and scaled
    along, across, up, length = _frame(integer(random, 0, 3))
    reached = height * length
    least = _nudged(random, reached)
    exponent = wp.where(single, integer(random, -100, 100), integer(random, -950, 950))
    scale = wp.cast(wp.uint64(exponent + 1023) << wp.uint64(52), wp.float64)
    for k in range(8):
        p = x[k]
        x[k] = scale * (p[0] * along + p[1] * across + p[2] * up)
    distance[i] = scale * least
    truth[i] = wp.where(least >= reached, HIT, FREE)


@wp.kernel
def choose_distances(
    kind: int,
    seed: int,
    first: wp.int64,
    points: wp.array2d[wp.vec3d],
    distance: wp.array[wp.float64],
):
    """Chooses minimum distances for queries: about those of some points of theirs at some time, or any at all."""
    i = wp.tid()
    x = points[i]
    _as_kind(kind, 0, x)
    _as_kind(kind, 4, x)
    random = wp.zeros(shape=(1,), dtype=wp.uint32)
    random[0] = seeded(seed, first + wp.int64(i))
    largest = wp.float64(0.0)
    for k in range(8):
        p = x[k]
        largest = wp.max(largest, wp.max(wp.abs(p[0]), wp.max(wp.abs(p[1]), wp.abs(p[2]))))
    size = wp.max(largest, _SMALLEST)
    how = integer(random, 0, 19)
    chosen = largest * wp.pow(wp.float64(10.0), real(random, wp.float64(-12.0), wp.float64(0.5)))
    if how == 0:
        chosen = wp.pow(wp.float64(10.0), real(random, wp.float64(-300.0), wp.float64(300.0)))
    elif how < 11:
        time = wp.float64(integer(random, 0, 8)) / wp.float64(8.0)
        a = integer(random, 0, wp.where(kind == EDGE_EDGE, 1, 0))
        b = integer(random, wp.where(kind == EDGE_EDGE, 2, 1), 3)
        start = x[b] / size - x[a] / size
        end = x[4 + b] / size - x[4 + a] / size
        chosen = size * wp.length((_1 - time) * start + time * end)
    distance[i] = wp.where(chosen < _SMALLEST, _0, wp.min(chosen, _LARGEST))
