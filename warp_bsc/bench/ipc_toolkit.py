"""The IPC Toolkit's answers to single queries, and what they take, for the paper's benchmarks.

Its queries are asked one by one from Python, and such a call takes longer than many a query. What a call takes is
measured on a query of features so far apart that it is out at once, and taken off. All that a query costs which is out
at once is taken off with it: to the peer's advantage. Times are of one core, without searching for a worst case.
"""

import importlib.metadata
import importlib.util
import statistics
import time
from dataclasses import dataclass

import numpy as np

__all__ = ["PEERS", "PeerMeasurement", "ask_peer", "has_peers", "measure_peer", "version_of_peers"]

PEERS = {"tight inclusion": "TightInclusionCCD", "additive": "AdditiveCCD"}
"""Methods of the IPC Toolkit, with the names of their classes, whose defaults are used."""

_FAR = 1e3


@dataclass(frozen=True)
class PeerMeasurement:
    """What a method of the IPC Toolkit answered, and what it took.

    Attributes:
        queries: How many queries were timed, a random part of the scene's.
        nanoseconds: Mean time of a query, without the call from Python [ns].
        call_nanoseconds: What such a call takes, which was taken off [ns].
        checked: How many answers were compared with the truth.
        false_positives: How many of them are wrongly collisions.
        false_negatives: How many of them are wrongly none.
    """

    queries: int
    nanoseconds: float
    call_nanoseconds: float
    checked: int
    false_positives: int
    false_negatives: int


def has_peers() -> bool:
    """Whether the IPC Toolkit is installed."""
    return importlib.util.find_spec("ipctk") is not None


def version_of_peers() -> str | None:
    """Version of the IPC Toolkit, None if it is not installed."""
    return importlib.metadata.version("ipctk") if has_peers() else None


def _ask(peer, kind):
    """The function that answers one query of this kind."""
    import ipctk  # noqa: PLC0415 (optional)

    ccd = getattr(ipctk, PEERS[peer])()
    return ccd.point_triangle_ccd if kind == "vertex_face" else ccd.edge_edge_ccd


def ask_peer(peer, kind, points) -> np.ndarray:
    """Answers to queries.

    Args:
        peer: One of :data:`PEERS`.
        kind: "vertex_face" or "edge_edge".
        points: Queries, shape [n, 8, 3].

    Returns:
        Whether each collides, bool, shape [n].
    """
    ask = _ask(peer, kind)
    return np.array([ask(*query)[0] for query in np.asarray(points, dtype=np.float64)], dtype=bool)


def measure_peer(peer, kind, points, *, repeat=3) -> tuple[float, float]:
    """Times queries that are asked one by one.

    Args:
        peer: One of :data:`PEERS`.
        kind: "vertex_face" or "edge_edge".
        points: Queries, shape [n, 8, 3].
        repeat: How many repetitions to take the median of.

    Returns:
        Mean time of a query without the call [ns], and that of a call [ns].
    """
    ask = _ask(peer, kind)
    queries = [tuple(query) for query in np.asarray(points, dtype=np.float64)]
    far = np.asarray(points[0], dtype=np.float64).copy()
    first = [0, 4] if kind == "vertex_face" else [0, 1, 4, 5]
    far[first] += _FAR * (1.0 + np.abs(far).max())
    whole = _mean_nanoseconds(ask, queries, repeat)
    call = _mean_nanoseconds(ask, [tuple(far)] * len(queries), repeat)
    return max(whole - call, 0.0), call


def _mean_nanoseconds(ask, queries, repeat):
    times = []
    for _ in range(repeat):
        start = time.perf_counter()
        for query in queries:
            ask(*query)
        times.append(time.perf_counter() - start)
    return 1e9 * statistics.median(times) / len(queries)
