"""Measures how many elementary queries a second are decided; queries and results stay on the device."""

import functools
from dataclasses import dataclass

import numpy as np
import warp as wp

from ..._arguments import checked_integer
from ...detection.queries.query import query_edge_edge, query_vertex_face
from ...detection.queries.query_arrays import QueryArrays
from ...detection.run.launch import launch_over, launch_over_queue
from ...detection.run.settings import NO_FUSED_OPERATIONS, TOLERANCE, PairKind
from ...kernels.ccd import ccd_edge_edge, ccd_vertex_face, impact_edge_edge, impact_vertex_face
from ...kernels.classification import classify
from ...kernels.culling import centroid_direction, direction_separates, edge_edge_boxes_apart, vertex_face_boxes_apart
from ...kernels.exact.first_contact import NONE, decide_in
from ...kernels.motion import doubles, edge_edge_motion, vertex_face_motion
from ...kernels.pipeline.queues import take_slot
from ...kernels.polynomials import coplanarity
from ...kernels.signs import FREE, HIT, ROUNDOFF, UNSURE, certified_sign_cubic
from ...kernels.time_of_impact import impact
from ..timing import median_milliseconds

__all__ = [
    "MODES",
    "SEED",
    "QueryBenchmark",
    "benchmark_copy",
    "benchmark_queries",
    "check_query_count",
    "generate_queries",
    "generate_touching_queries",
]

MODES = {"status": 96 + 1, "impact": 96 + 57, "queued": 96 + 1, "exact": 96 + 1, "function": 96 + 58}
"""The modes that are measured, with the bytes of a query and its result.

- ``status``: finds the status, one thread a query.
- ``impact``: finds the time of impact, coordinates and normal as well.
- ``queued``: finds the status by two kernels: one culls, the other decides the survivors.
- ``exact``: finds the status by exact integers of one limb a coordinate, for as many queries that floating point cannot
  certify.
- ``function``: what a program calls: :func:`warp_bsc.query_vertex_face` or :func:`warp_bsc.query_edge_edge` with
  ``out=``, method "exact": hit, status, time of impact, coordinates and normal.
"""

SEED = 0
"""Seed of the random numbers."""

_MAX_QUERIES = 2**26
_COPIED_BYTES = 2**28  # more than a cache holds
_MISSES = {PairKind.VERTEX_FACE: 1.32, PairKind.EDGE_EDGE: 2.33}
"""The largest distance along an axis by which features that fly at each other miss; a third of the queries survive the
culls."""


@dataclass(frozen=True)
class QueryBenchmark:
    """Results of the queries of one kind, and the times to find them.

    Attributes:
        kind: Kind of pair.
        status: Status of each query, 0 FREE, 1 HIT, 2 UNSURE, int8, shape [query_count].
        survivors: Number of queries that no cull decides.
        milliseconds: Median time to decide all queries, by mode [ms].
    """

    kind: PairKind
    status: np.ndarray
    survivors: int
    milliseconds: dict[str, float]

    @property
    def survivor_share(self) -> float:
        """The share of the queries that no cull decides."""
        return self.survivors / len(self.status)

    @property
    def free(self) -> int:
        """Number of queries certified to be free."""
        return int((self.status == FREE).sum())

    @property
    def hits(self) -> int:
        """Number of queries certified to collide."""
        return int((self.status == HIT).sum())

    @property
    def unsure(self) -> int:
        """Number of queries that floating point could not certify."""
        return int((self.status == UNSURE).sum())

    @property
    def queries_per_second(self) -> dict[str, float]:
        """Queries answered per second, by mode [1/s]."""
        return {mode: 1e3 * len(self.status) / took for mode, took in self.milliseconds.items()}

    @property
    def bytes_per_second(self) -> dict[str, float]:
        """Bytes of queries read and of results written, by mode [1/s]."""
        return {mode: MODES[mode] * rate for mode, rate in self.queries_per_second.items()}


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


@functools.cache
def _kernels(kind: PairKind):
    """Returns the kernels for one kind of query, each in a module of its own."""
    vertex_face = kind == PairKind.VERTEX_FACE
    number = int(kind)
    ccd = ccd_vertex_face if vertex_face else ccd_edge_edge
    first_impact = impact_vertex_face if vertex_face else impact_edge_edge
    boxes_apart = vertex_face_boxes_apart if vertex_face else edge_edge_boxes_apart
    motion_of = vertex_face_motion if vertex_face else edge_edge_motion

    @wp.func
    def read(p: wp.array2d[wp.vec3], i: int):
        return p[i, 0], p[i, 1], p[i, 2], p[i, 3], p[i, 4], p[i, 5], p[i, 6], p[i, 7]

    @wp.kernel(**NO_FUSED_OPERATIONS)
    def find_status(
        first: int,
        # in
        points: wp.array2d[wp.vec3],
        # out
        status: wp.array[wp.int8],
    ):
        i = first + wp.tid()
        a0, b0, c0, d0, a1, b1, c1, d1 = read(points, i)
        status[i] = wp.int8(ccd(a0, b0, c0, d0, a1, b1, c1, d1))

    @wp.kernel(**NO_FUSED_OPERATIONS)
    def find_impact(
        first: int,
        # in
        points: wp.array2d[wp.vec3],
        tolerance: wp.float64,
        # out
        status: wp.array[wp.int8],
        toi: wp.array[wp.float64],
        coordinates: wp.array[wp.vec3d],
        normal: wp.array[wp.vec3d],
    ):
        i = first + wp.tid()
        a0, b0, c0, d0, a1, b1, c1, d1 = read(points, i)
        result = first_impact(a0, b0, c0, d0, a1, b1, c1, d1, tolerance)
        status[i] = wp.int8(result.status)
        toi[i] = result.toi
        coordinates[i] = result.coordinates
        normal[i] = result.normal

    @wp.kernel(**NO_FUSED_OPERATIONS)
    def cull(
        first: int,
        # in
        points: wp.array2d[wp.vec3],
        # out
        status: wp.array[wp.int8],
        survivors: wp.array[int],
        # in and out
        counts: wp.array[wp.int64],
    ):
        i = first + wp.tid()
        a0, b0, c0, d0, a1, b1, c1, d1 = read(points, i)
        status[i] = wp.int8(FREE)
        # all points are finite
        if boxes_apart(a0, b0, c0, d0, a1, b1, c1, d1):
            return
        motion = motion_of(a0, b0, c0, d0, a1, b1, c1, d1, ROUNDOFF)
        y = coplanarity(motion)
        if certified_sign_cubic(y.k, y.bound) != 0:
            return
        if direction_separates(motion, centroid_direction(motion)):
            return
        survivors[wp.int32(take_slot(counts, 0))] = i

    @wp.kernel(**NO_FUSED_OPERATIONS)
    def classify_survivors(
        first: int,
        # in
        points: wp.array2d[wp.vec3],
        tolerance: wp.float64,
        survivors: wp.array[int],
        counts: wp.array[wp.int64],
        # out
        status: wp.array[wp.int8],
    ):
        slot = first + wp.tid()
        if wp.int64(slot) >= counts[0]:
            return
        i = survivors[slot]
        a0, b0, c0, d0, a1, b1, c1, d1 = read(points, i)
        motion = motion_of(a0, b0, c0, d0, a1, b1, c1, d1, ROUNDOFF)
        y = coplanarity(motion)
        certified = classify(motion, y)
        if certified == UNSURE:
            result = impact(motion, y, certified, tolerance)
            certified = result.status
        status[i] = wp.int8(certified)

    decide = decide_in(1)

    @wp.kernel(**NO_FUSED_OPERATIONS)
    def find_exact_status(
        first: int,
        # in
        points: wp.array2d[wp.vec3],
        # out
        status: wp.array[wp.int8],
    ):
        i = first + wp.tid()
        a0, b0, c0, d0, a1, b1, c1, d1 = read(points, i)
        a0d, b0d, c0d, d0d = doubles(a0, b0, c0, d0)
        a1d, b1d, c1d, d1d = doubles(a1, b1, c1, d1)
        time = decide(number, a0d, b0d, c0d, d0d, a1d, b1d, c1d, d1d, False, 0)
        status[i] = wp.int8(wp.where(time < NONE, HIT, FREE))

    return find_status, find_impact, cull, classify_survivors, find_exact_status


def check_query_count(count: int) -> None:
    """Raises ValueError if there are too few or too many queries."""
    if not 1 <= count <= _MAX_QUERIES:
        raise ValueError(f"count must be in [1, {_MAX_QUERIES}], not {count}")


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


def benchmark_queries(
    kind: PairKind, *, count: int | None = None, device: wp.DeviceLike = None, repeat: int = 20
) -> QueryBenchmark:
    """Measures the time of random queries in each mode: replays of a CUDA graph, launches on the CPU.

    A first run of each mode is not timed.

    Args:
        kind: Kind of pair.
        count: Number of queries; default: 2^24 on a GPU, 2^18 on the CPU.
        device: Warp device; default: Warp's default.
        repeat: Number of repetitions; their medians count.

    Raises:
        TypeError: If ``repeat`` is no integer.
        ValueError: If ``count`` or ``repeat`` is out of range.
        RuntimeError: If two modes find different results, or exact arithmetic misses features that touch.
    """
    repeat = checked_integer(repeat, "repeat", 1)
    device = wp.get_device(device)
    if count is None:
        count = 2**24 if device.is_cuda else 2**18
    check_query_count(count)
    find_status, find_impact, cull, classify_survivors, find_exact_status = _kernels(kind)
    points = generate_queries(kind, count, device=device)
    query = query_vertex_face if kind == PairKind.VERTEX_FACE else query_edge_edge
    out = QueryArrays(count, device=device)
    touching = generate_touching_queries(kind, count, device=device)
    # no status is -1
    status = {mode: wp.full(count, -1, dtype=wp.int8, device=device) for mode in MODES} | {"function": out.status}
    toi = wp.empty(count, dtype=wp.float64, device=device)
    coordinates, normal = (wp.empty(count, dtype=wp.vec3d, device=device) for _ in range(2))
    survivors = wp.empty(count, dtype=int, device=device)
    counts = wp.zeros(1, dtype=wp.int64, device=device)

    def run_status():
        launch_over(find_status, count, inputs=[points], outputs=[status["status"]], device=device)

    def run_impact():
        outputs = [status["impact"], toi, coordinates, normal]
        launch_over(find_impact, count, inputs=[points, TOLERANCE], outputs=outputs, device=device)

    def run_queued():
        counts.zero_()
        outputs = [status["queued"], survivors, counts]
        launch_over(cull, count, inputs=[points], outputs=outputs, device=device)
        inputs = [points, TOLERANCE, survivors, counts]
        launch_over_queue(classify_survivors, survivors, counts, 0, inputs=inputs, outputs=[status["queued"]])

    def run_exact():
        outputs = [status["exact"]]
        launch_over(find_exact_status, count, inputs=[touching], outputs=outputs, device=device, block_dim=64)

    def run_function():
        query(points, out=out)

    runs = {"status": run_status, "impact": run_impact, "queued": run_queued, "exact": run_exact}
    runs["function"] = run_function
    milliseconds = {mode: median_milliseconds(runs[mode], device, repeat) for mode in MODES}
    results = {mode: array.numpy() for mode, array in status.items()}
    missed = int((results["exact"] != HIT).sum())
    if missed:
        raise RuntimeError(f"{missed} of {count} touching {kind.display_name} queries were found to be free")
    for mode in runs.keys() - {"exact"}:
        different = int((results[mode] != results["status"]).sum())
        if different:
            raise RuntimeError(
                f"{different} of {count} {kind.display_name} queries were decided differently by mode {mode}"
            )
    return QueryBenchmark(kind, results["status"].copy(), int(counts.numpy()[0]), milliseconds)


def benchmark_copy(*, device: wp.DeviceLike = None, repeat: int = 20) -> float:
    """Measures the rate at which a device copies a large array: bytes read plus bytes written [1/s].

    Args:
        device: Warp device; default: Warp's default.
        repeat: Number of repetitions; their median counts.

    Raises:
        TypeError: If ``repeat`` is no integer.
        ValueError: If ``repeat`` is less than 1.
    """
    repeat = checked_integer(repeat, "repeat", 1)
    device = wp.get_device(device)
    source = wp.full(_COPIED_BYTES, 1, dtype=wp.uint8, device=device)
    target = wp.empty_like(source)
    milliseconds = median_milliseconds(lambda: wp.copy(target, source), device, repeat)
    return 2e3 * _COPIED_BYTES / milliseconds
