"""Random elementary queries, the same on every device."""

import warp as wp

from ...detection.run.launch import launch_over
from ...detection.run.settings import NO_FUSED_OPERATIONS, PairKind

SEED = 0
"""Seed of the random numbers."""

_MISSES = {PairKind.VERTEX_FACE: 1.32, PairKind.EDGE_EDGE: 2.33}
"""The largest distance along an axis by which features that fly at each other miss; a third of the queries survive the
culls."""


@wp.kernel(**NO_FUSED_OPERATIONS)
def _generate_queries(
    first: int,
    # in
    seed: int,
    miss: float,
    first_points: int,
    # out
    points: wp.array2d[wp.vec3],
):
    """Writes two features of unit size that fly at each other from a random distance and deform a little."""
    i = first + wp.tid()
    random = wp.rand_init(seed, i)
    apart = 2.0 * wp.sample_unit_cube(random)
    relative = 2.0 * miss * wp.sample_unit_cube(random) - 2.0 * apart
    for j in range(4):
        point = wp.sample_unit_cube(random)
        motion = 0.25 * wp.sample_unit_cube(random)
        if j >= first_points:
            point = point + apart
            motion = motion + relative
        points[i, j] = point
        points[i, 4 + j] = point + motion


@wp.func
def _rounded(x: wp.vec3) -> wp.vec3:
    """Returns the nearest multiples of 2^-8."""
    return wp.vec3(wp.round(256.0 * x[0]), wp.round(256.0 * x[1]), wp.round(256.0 * x[2])) / 256.0


@wp.kernel(**NO_FUSED_OPERATIONS)
def _make_touch(
    first: int,
    # in
    other: int,
    # in and out
    points: wp.array2d[wp.vec3],
):
    """Moves the first point of each query onto the edge from point ``other`` to the next, at half time.

    After rounding, all numbers are small multiples of 2^-11, so that this is exact.
    """
    i = first + wp.tid()
    for j in range(8):
        points[i, j] = _rounded(points[i, j])
    start = 3.0 * points[i, other] + points[i, other + 1]
    end = 3.0 * points[i, other + 4] + points[i, other + 5]
    gap = 0.5 * (points[i, 0] + points[i, 4]) - 0.125 * (start + end)
    points[i, 0] = points[i, 0] - gap
    points[i, 4] = points[i, 4] - gap


def generate_queries(kind: PairKind, count: int, *, device: wp.DeviceLike = None) -> wp.array:
    """Returns random queries, the same on every device; a larger number begins with the queries of a smaller one.

    Args:
        kind: Kind of pair.
        count: Number of queries.
        device: Warp device; default: Warp's default.

    Returns:
        Positions, rows as of :func:`warp_bsc.query_vertex_face` or :func:`warp_bsc.query_edge_edge`, array of vec3,
        shape [count, 8].
    """
    device = wp.get_device(device)
    points = wp.empty((count, 8), dtype=wp.vec3, device=device)
    inputs = [SEED, _MISSES[kind], 1 if kind == PairKind.VERTEX_FACE else 2]
    launch_over(_generate_queries, count, inputs=inputs, outputs=[points], device=device)
    return points


def generate_touching_queries(kind: PairKind, count: int, *, device: wp.DeviceLike = None) -> wp.array:
    """Returns random queries whose first point touches an edge at half time: floating point can certify almost none.

    Arguments and result: as of :func:`generate_queries`, whose queries they are made from.
    """
    points = generate_queries(kind, count, device=device)
    other = 1 if kind == PairKind.VERTEX_FACE else 2
    launch_over(_make_touch, count, inputs=[other], outputs=[points], device=points.device)
    return points
