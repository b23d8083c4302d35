"""The slowest query of each method: suspects by the processor's clock, times by copies of a query.

A tracing kernel reads the clock before and after each query, a few times, as interrupts and waits for memory lengthen a
query; the smallest number of cycles counts. Cycles only select suspects. Each suspect is then timed by the method
itself, in a launch of copies that is long compared with the start of a kernel. The shortest of several launches counts.
On a GPU the copies fill the device, so that all threads of a warp have the same query.
"""

from typing import Any

import numpy as np
import warp as wp

from ...detection.run.settings import PairKind
from .methods import METHODS, PHASES, MethodRun, Queries, QuerySet, measure_nanoseconds, trace

_LOOKS = 3
_SUSPECTS = 24
_MIN_COPIES, _MAX_COPIES = 256, 2**16
_GPU_COPIES = 2**18
_CPU_NANOSECONDS = 4e6  # shortest launch of copies on the CPU, unless it would need too many copies


def find_worst(queries: Queries, device: wp.Device, *, repeat: int) -> dict[str, dict[str, Any]]:
    """Finds the slowest query of each method.

    Args:
        queries: The queries to search.
        device: Warp device.
        repeat: Number of repetitions; the shortest counts.

    Returns:
        The slowest query by method, as plain data for JSON: ``kind``, the label of its kind of pair; ``number``, its
        index among the queries; ``points``, a row as of :func:`warp_bsc.query_vertex_face`; ``nanoseconds``, its time
        by each method [ns].
    """
    kind = queries.kind
    on_device = QuerySet(queries, device)
    slowest = {}
    for method in METHODS:
        suspects = _find_suspects(method, on_device)
        times = [_time_alone(method, kind, points, device, repeat) for points in queries.points(suspects)]
        index = int(suspects[np.argmax(times)])
        points = queries.points([index])[0]
        took = {other: _time_alone(other, kind, points, device, repeat) for other in METHODS}
        slowest[method] = {"kind": kind.label, "number": index, "points": points.tolist(), "nanoseconds": took}
    return slowest


def adversarial_queries(kind: PairKind, count: int, *, seed: int = 0) -> Queries:
    """Returns random degenerate queries: coordinates are small integers, so that many polynomials are exactly zero.

    A third of them move in one plane, a third start in one plane and leave it, and a third have points anywhere: these
    touch at corners and edges, rest, or turn back from zero.
    """
    random = np.random.default_rng(seed)
    points = random.integers(-2, 3, (count, 8, 3)).astype(np.float32)
    points[::3, :, 2] = 0.0
    points[1::3, :4, 2] = 0.0
    return Queries.of_points(kind, points)


def _find_suspects(method: str, queries: QuerySet) -> np.ndarray:
    """Returns the indices of the queries that are likely to be the slowest."""
    phases, cycles = trace(queries, method)
    for _ in range(_LOOKS - 1):
        cycles = np.minimum(cycles, trace(queries, method)[1])
    count = min(_SUSPECTS, queries.count)
    suspects = np.argpartition(cycles, -count)[-count:]
    if method == "exact":
        # the trace has no exact arithmetic
        left_to_exact = np.flatnonzero(phases == PHASES.index("exact"))
        suspects = np.concatenate([suspects, np.random.default_rng(0).permutation(left_to_exact)[:count]])
    return suspects


def _time_alone(method: str, kind: PairKind, points: np.ndarray, device: wp.Device, repeat: int) -> float:
    """Returns the time of a query [ns] among copies of itself."""
    if device.is_cuda:
        copies = _GPU_COPIES
    else:
        copies = _MIN_COPIES
        estimate = _time_copies(method, kind, points, copies, device, 1)
        copies = int(np.clip(_CPU_NANOSECONDS / estimate, _MIN_COPIES, _MAX_COPIES))
    return _time_copies(method, kind, points, copies, device, repeat)


def _time_copies(method: str, kind: PairKind, points: np.ndarray, copies: int, device: wp.Device, repeat: int) -> float:
    queries = QuerySet(Queries.of_points(kind, points[None]), device, repeated=copies)
    run = MethodRun(method, queries)
    return min(measure_nanoseconds(run, repeat=1) for _ in range(repeat))
