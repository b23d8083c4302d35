"""Measures the methods on given queries, such as those of public benchmarks."""

import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import warp as wp

from ..._arguments import checked_integer
from ...detection.run.settings import METHODS as NARROW_PHASE_METHODS
from ...detection.run.settings import PairKind
from ..record import name_place
from ..tables import Column, Table, count, two
from .methods import MethodRun, Queries, QuerySet, measure_nanoseconds, time_in_turns

METHODS = (*NARROW_PHASE_METHODS, "cubic")
"""The methods, see :mod:`.methods`."""

COLUMNS = (
    Column("Collide", lambda row: row["hits"] / row["queries"], ".0%", title="collide"),
    *(
        Column(
            method.replace("conservative", "conser-\nvative"),
            f"nanoseconds.{method}",
            ",.1f",
            title="cubic solver" if method == "cubic" else f"`{method}`",
            page_format=two,
        )
        for method in METHODS
    ),
    *(
        Column(
            f"{method} /\ncubic",
            lambda row, method=method: row["nanoseconds"][method] / row["nanoseconds"]["cubic"],
            ".2f",
            title=f"`{method}` / cubic",
            page_format=two,
        )
        for method in ("float", "exact")
    ),
)
"""Columns of what :func:`benchmark_given_queries` returns."""


def _nanoseconds(run: MethodRun) -> float:
    """Returns the time of a query in a launch of all queries [ns]."""
    if run.queries.device.is_cuda:
        return measure_nanoseconds(run, repeat=1)
    start = time.process_time()
    run.launch()
    return 1e9 * (time.process_time() - start) / run.queries.count


def benchmark_given_queries(
    name: str, kind: PairKind, points: np.ndarray, *, device: wp.DeviceLike = None, repeat: int = 20
) -> dict[str, Any]:
    """Measures all methods on queries in turns, see :func:`.methods.time_in_turns`.

    Args:
        name: Name of the queries.
        kind: Kind of pair.
        points: Positions, as of :func:`warp_bsc.query_vertex_face`, NumPy array, shape [n, 8, 3], n more than 0.
        device: Warp device; default: Warp's default.
        repeat: Number of turns.

    Returns:
        Plain data for JSON: ``name``; ``kind``; ``queries``, the number of queries; ``hits``, the number of them that
        collide, by method "exact"; ``nanoseconds``, the time of a query by method, on a CPU processor time, that of all
        cores [ns].

    Raises:
        TypeError: If ``repeat`` is no integer.
        ValueError: If ``repeat`` is less than 1.
    """
    repeat = checked_integer(repeat, "repeat", 1)
    device = wp.get_device(device)
    queries = Queries.of_points(kind, points)
    exact = MethodRun("exact", QuerySet(queries, device))
    exact.launch()
    fastest = time_in_turns(METHODS, queries, device, repeat, _nanoseconds)
    hits = int(exact.find_hits().sum())
    return {"name": name, "kind": kind.display_name, "queries": len(queries), "hits": hits, "nanoseconds": fastest}


def to_dict(measured: list[dict[str, Any]], **settings: Any) -> dict[str, Any]:
    """Returns measurements as plain data for JSON, with settings."""
    return settings | {"queries": measured}


def show(found: dict[str, Any]) -> Iterator[Table | str]:
    """Yields the table of the JSON of measurements, and the line above it."""
    time = "Nanoseconds of processor time" if found["device"] == "cpu" else "Nanoseconds"
    yield f"{time} a query on {name_place(found)}; the fastest of {count(found['repeat'], 'turn')}"
    rows = [(f"{row['name']}, {row['kind']}", row) for row in found["queries"]]
    caption = "cubic: a floating-point cubic solver, see warp-bsc bench. Times of impact are not sought."
    yield Table("Queries", [Column("Number", "queries"), *COLUMNS], rows, caption=caption)
