"""Measures how many elementary queries a second are decided; queries and results stay on the device."""

import functools
from collections.abc import Iterator
from typing import Any

import numpy as np
import warp as wp

from ..._arguments import checked_integer
from ...detection.queries.query import query_edge_edge, query_vertex_face
from ...detection.queries.query_arrays import DeviceQueryResult
from ...detection.run.launch import launch_over, launch_over_queue
from ...detection.run.settings import NO_FUSED_OPERATIONS, TOLERANCE, PairKind
from ...kernels.ccd import ccd_edge_edge, ccd_vertex_face, impact_edge_edge, impact_vertex_face
from ...kernels.classification import classify
from ...kernels.culling import centroid_direction, direction_separates, edge_edge_boxes_apart, vertex_face_boxes_apart
from ...kernels.exact.first_contact import NONE, decide_in
from ...kernels.motion import edge_edge_motion, query_of, vertex_face_motion
from ...kernels.pipeline.queues import take_slot
from ...kernels.polynomials import coplanarity
from ...kernels.signs import FREE, HIT, ROUNDOFF, UNSURE, certified_sign_cubic
from ...kernels.time_of_impact import impact
from ..record import name_place
from ..scenes.queries import generate_queries, generate_touching_queries
from ..tables import Column, Table, count
from ..timing import median_milliseconds

DESCRIPTION = """\
Measure how many elementary queries a second are decided. The queries are
random and the same on every device; a third of them survive the culls. Queries
and results stay on the device. On a GPU, replays of a CUDA graph are timed by
events. With files of queries, measure the time that each method takes for one
of them, beside a floating-point cubic solver."""

EXAMPLES = """\
examples:
  warp-bsc bench queries
  warp-bsc bench queries --device cpu --threads 1 --count 1000000
  warp-bsc bench queries unit-tests 227vf.csv --device cpu --threads 1
  warp-bsc bench queries --json rates.json"""

MODES = {"status": 96 + 1, "impact": 96 + 57, "queued": 96 + 1, "exact": 96 + 1, "function": 96 + 58}
"""The modes that are measured, with the bytes of a query and its result.

See the last lines of :func:`show`. ``exact`` has integers of one limb a coordinate, for as many queries that floating
point cannot certify; ``function`` finds hit, status, time of impact, coordinates and normal.
"""

_RESULTS = (
    Column("Queries", "queries"),
    Column("Survivors", "survivors"),
    Column("Share", "survivor_share", ".1%"),
    *(Column(name.capitalize(), f"certified.{name}") for name in ("free", "hit", "unsure")),
)
_RATES = (
    Column("ms", "milliseconds", ",.2f"),
    Column("Million\nqueries/s", lambda took: took["queries_per_second"] / 1e6, ",.1f"),
    Column("Bytes\na query", "bytes_per_query"),
    Column("GB/s", lambda took: took["bytes_per_second"] / 1e9, ",.1f"),
    Column("Share of\ncopying", "share_of_copy", ".1%"),
)

_MAX_QUERIES = 2**26
_COPIED_BYTES = 2**28  # more than a cache holds


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
        time = decide(number, query_of(a0, b0, c0, d0, a1, b1, c1, d1), False, 0)
        status[i] = wp.int8(wp.where(time < NONE, HIT, FREE))

    return find_status, find_impact, cull, classify_survivors, find_exact_status


def check_query_count(count: int) -> None:
    """Raises ValueError if there are too few or too many queries."""
    if not 1 <= count <= _MAX_QUERIES:
        raise ValueError(f"count must be in [1, {_MAX_QUERIES}], not {count}")


def benchmark_queries(
    kind: PairKind, *, count: int | None = None, device: wp.DeviceLike = None, repeat: int = 20
) -> tuple[dict[str, Any], np.ndarray]:
    """Measures the time of random queries in each mode: replays of a CUDA graph, launches on the CPU.

    A first run of each mode is not timed.

    Args:
        kind: Kind of pair.
        count: Number of queries; default: 2^24 on a GPU, 2^18 on the CPU.
        device: Warp device; default: Warp's default.
        repeat: Number of repetitions; their medians count.

    Returns:
        Plain data for JSON: ``kind``; ``queries``, the number of queries; ``survivors``, the number and
        ``survivor_share``, the share of those that no cull decides; ``certified``, numbers of queries that are
        certified to be ``free``, certified to collide, ``hit``, or that floating point could not certify, ``unsure``;
        ``modes``, the median time to decide all queries by mode [ms]. And the status of each query, 0 FREE, 1 HIT, 2
        UNSURE, int8, shape [count].

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
    out = DeviceQueryResult(count, device=device)
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
            which = f"{different} of {count} {kind.display_name} queries"
            raise RuntimeError(f"{which} were decided differently by mode {mode}")
    answers, survivors_left = results["status"].copy(), int(counts.numpy()[0])
    names = {"free": FREE, "hit": HIT, "unsure": UNSURE}
    measured = {
        "kind": kind.display_name,
        "queries": count,
        "survivors": survivors_left,
        "survivor_share": survivors_left / count,
        "certified": {name: int((answers == answer).sum()) for name, answer in names.items()},
        "modes": milliseconds,
    }
    return measured, answers


def benchmark_copy(*, device: wp.DeviceLike = None, repeat: int = 20) -> float:
    """Measures the rate at which a device copies a large array: bytes read plus bytes written [1/s].

    Arguments and errors are those of :func:`benchmark_queries`.
    """
    repeat = checked_integer(repeat, "repeat", 1)
    device = wp.get_device(device)
    source = wp.full(_COPIED_BYTES, 1, dtype=wp.uint8, device=device)
    target = wp.empty_like(source)
    milliseconds = median_milliseconds(lambda: wp.copy(target, source), device, repeat)
    return 2e3 * _COPIED_BYTES / milliseconds


def to_dict(benchmarks: list[dict[str, Any]], **settings: Any) -> dict[str, Any]:
    """Returns results as plain data for JSON, with settings, of which one is the rate of :func:`benchmark_copy`."""

    def rates(mode: str, milliseconds: float, queries: int) -> dict[str, float]:
        """Returns what a mode does in a second, by its time for all queries."""
        rate = 1e3 * queries / milliseconds
        return {
            "milliseconds": milliseconds,
            "queries_per_second": rate,
            "bytes_per_query": MODES[mode],
            "bytes_per_second": MODES[mode] * rate,
            "share_of_copy": MODES[mode] * rate / settings["copy_bytes_per_second"],
        }

    return settings | {
        "kinds": [
            found | {"modes": {mode: rates(mode, took, found["queries"]) for mode, took in found["modes"].items()}}
            for found in benchmarks
        ]
    }


def show(found: dict[str, Any]) -> Iterator[Table | str]:
    """Yields the tables of the JSON of a measurement: results, and how many queries a second were decided."""
    yield f"Random queries on {name_place(found)}; medians of {count(found['repeat'], 'repetition')}"
    rows = [(row["kind"], row) for row in found["kinds"]]
    yield Table("Kind", _RESULTS, rows, caption="Survivors: queries that no cull decides.")
    yield ""
    modes = [(f"{kind}, {mode}", took) for kind, row in rows for mode, took in row["modes"].items()]
    yield Table("Mode", _RATES, modes)
    yield ""
    yield "status: finds the status of each query, in one kernel."
    yield "impact: finds the time of impact, coordinates and normal as well."
    yield "queued: finds the status by two kernels: culls, and a decision of the survivors."
    yield "exact: finds the status in integers, where floating point cannot certify it."
    yield "function: query_vertex_face or query_edge_edge with out=, exact, with times."
    yield f"A copy on this device reads and writes {found['copy_bytes_per_second'] / 1e9:,.1f} GB/s."
