"""The slowest query of each method: found by the clock of the processor, confirmed by many copies of it.

A clock that is read before and after a query sees interrupts and waits for memory as well, so that all queries are
measured a few times, the fewest cycles of each count, and the slowest few dozen are measured once more: each one alone,
in so many copies that reading the clock, and starting a kernel, no longer matters; the shortest of several launches
counts, as interrupts are no part of a query. On a GPU the copies fill it, so that every warp is full of the same query.
"""

from dataclasses import dataclass

import numpy as np
import warp as wp

from ..kernels.signs import UNSURE
from .methods import METHODS, MethodRun, Queries, QuerySet, measure_nanoseconds

__all__ = ["WorstQuery", "adversarial_queries", "find_worst"]

_LOOKS = 3
_SUSPECTS = 24
_FEWEST_COPIES, _MOST_COPIES = 256, 2**16
_GPU_COPIES = 2**18
_CPU_NANOSECONDS = 4e6  # that a launch of copies takes on the CPU at least, if the copies are not too many


@dataclass(frozen=True)
class WorstQuery:
    """The slowest query of a method.

    Attributes:
        method: The method.
        kind: "vertex_face" or "edge_edge".
        index: Which of the queries of its kind.
        points: Its points, as of :func:`warp_bsc.query_vertex_face`, shape [8, 3].
        nanoseconds: Time that it takes by each method [ns].
    """

    method: str
    kind: str
    index: int
    points: np.ndarray
    nanoseconds: dict[str, float]


def find_worst(queries, device, *, repeat) -> dict[str, WorstQuery]:
    """Finds the slowest query of each method.

    Args:
        queries: The :class:`~warp_bsc.bench.methods.Queries`.
        device: Warp device.
        repeat: How many repetitions to take the shortest of.

    Returns:
        By method.
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
        slowest[method] = WorstQuery(method, kind, index, points, took)
    return slowest


def adversarial_queries(kind, count, *, seed=0) -> Queries:
    """Queries that aim at trouble, a third each, with small integers for coordinates, so that much is exactly zero.

    Points anywhere, which touch at corners and edges, rest, and turn back from zero; motion in one plane; and features
    that start in one plane and leave it.
    """
    random = np.random.default_rng(seed)
    points = random.integers(-2, 3, (count, 8, 3)).astype(np.float32)
    points[::3, :, 2] = 0.0
    points[1::3, :4, 2] = 0.0
    return Queries.of_points(kind, points)


def _find_suspects(method, queries):
    """The queries that seem to be slowest, by their numbers."""
    run = MethodRun(method, queries)
    fewest = np.full(queries.count, np.iinfo(np.int64).max)
    ticks = wp.empty(queries.count, dtype=wp.int64, device=queries.device)
    for _ in range(_LOOKS):
        ticks.zero_()
        run.launch(ticks=ticks)
        fewest = np.minimum(fewest, ticks.numpy())
    count = min(_SUSPECTS, queries.count)
    suspects = np.argpartition(fewest, -count)[-count:]
    if method == "exact":
        # the clock does not run in the exact stage
        unsure = MethodRun("conservative", queries)
        unsure.launch()
        left = np.flatnonzero(unsure.status.numpy() == UNSURE)
        suspects = np.concatenate([suspects, np.random.default_rng(0).permutation(left)[:count]])
    return suspects


def _time_alone(method, kind, points, device, repeat) -> float:
    """Time of a query [ns] among copies of itself."""
    if device.is_cuda:
        copies = _GPU_COPIES
    else:
        copies = _FEWEST_COPIES
        estimate = _time_copies(method, kind, points, copies, device, 1)
        copies = int(np.clip(_CPU_NANOSECONDS / estimate, _FEWEST_COPIES, _MOST_COPIES))
    return _time_copies(method, kind, points, copies, device, repeat)


def _time_copies(method, kind, points, copies, device, repeat):
    queries = QuerySet(Queries.of_points(kind, points[None]), device, repeated=copies)
    run = MethodRun(method, queries)
    return min(measure_nanoseconds(run, repeat=1) for _ in range(repeat))
