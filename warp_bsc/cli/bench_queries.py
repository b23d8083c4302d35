"""The command ``warp-bsc bench queries``: measures how many elementary queries a second are decided."""

import argparse
from collections.abc import Generator
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from ..bench.measure.given_queries import METHODS, GivenQueries, benchmark_given_queries
from ..bench.measure.queries import MODES, SEED, QueryBenchmark, benchmark_copy, benchmark_queries, check_query_count
from ..bench.timing import count_threads, limited_threads
from ..detection.run.launch import cores
from ..detection.run.settings import PairKind
from .bench import JSON_FILE, Benchmark, name_place, report_runs
from .device import find_device, loading_kernels
from .options import DEVICE, THREADS, number, positive, repeat_options, several
from .query_file import find_query_files, read_query_file
from .tables import Column, Console, count, print_table, say

__all__ = ["BENCHMARK"]

_KINDS = {kind.display_name: kind for kind in PairKind}

_DESCRIPTION = """\
Measure how many elementary queries a second are decided. The queries are
random and the same on every device; a third of them survive the culls. Queries
and results stay on the device. On a GPU, replays of a CUDA graph are timed by
events. With files of queries, measure the time that each method takes for one
of them, beside a floating-point cubic solver."""

_EXAMPLES = """\
  warp-bsc bench queries
  warp-bsc bench queries --device cpu --threads 1 --count 1000000
  warp-bsc bench queries unit-tests 227vf.csv --device cpu --threads 1
  warp-bsc bench queries --json rates.json"""

_RESULTS = (
    Column("Queries", lambda found: len(found.status)),
    Column("Survivors", "survivors"),
    Column("Share", "survivor_share", ".1%"),
    Column("Free", "free"),
    Column("Hit", "hits"),
    Column("Unsure", "unsure"),
)
_RATES = (
    Column("ms", lambda took: took["milliseconds"], ",.2f"),
    Column("Million\nqueries/s", lambda took: took["queries_per_second"] / 1e6, ",.1f"),
    Column("Bytes\na query", lambda took: took["bytes_per_query"]),
    Column("GB/s", lambda took: took["bytes_per_second"] / 1e9, ",.1f"),
    Column("Share of\ncopying", lambda took: took["share_of_copy"], ".1%"),
)
_GIVEN = (
    Column("Number", "queries"),
    Column("Collide", lambda found: found.hits / found.queries, ".0%"),
    *(
        Column(
            method.replace("conservative", "conser-\nvative"),
            lambda found, method=method: found.nanoseconds[method],
            ",.1f",
        )
        for method in METHODS
    ),
    Column("float /\ncubic", lambda found: found.nanoseconds["float"] / found.nanoseconds["cubic"], ".2f"),
    Column("exact /\ncubic", lambda found: found.nanoseconds["exact"] / found.nanoseconds["cubic"], ".2f"),
)


def _run(arguments: argparse.Namespace) -> None:
    if arguments.count is not None:
        check_query_count(arguments.count)
    if arguments.paths and arguments.count is not None:
        raise ValueError("--count is for random queries: omit it, or the files")
    device = find_device(arguments.device)
    with limited_threads(arguments.threads):
        (_measure_files if arguments.paths else _measure_random)(arguments, device)


def _measure_random(arguments: argparse.Namespace, device: wp.Device) -> None:
    """Measures random queries in each mode."""
    options = {"device": device, "repeat": arguments.repeat}

    def measure() -> Generator[QueryBenchmark, None, None]:
        with loading_kernels(device):
            for kind in PairKind:
                benchmark_queries(kind, count=1, device=device, repeat=1)
        for kind in PairKind:
            yield benchmark_queries(kind, count=arguments.count, **options)

    copy_rate = benchmark_copy(**options)
    threads = count_threads()
    report_runs(
        arguments,
        device,
        measure(),
        name="queries",
        heading=f"Random queries on {name_place(device, threads)}; medians of {count(arguments.repeat, 'repetition')}",
        show=lambda console, benchmarks: _show_random(console, benchmarks, copy_rate),
        to_dict=lambda benchmarks: {
            "threads": threads,
            "repeat": arguments.repeat,
            "seed": SEED,
            "copy_bytes_per_second": copy_rate,
            "kinds": [_kind_to_dict(found, copy_rate) for found in benchmarks],
        },
    )


def _measure_files(arguments: argparse.Namespace, device: wp.Device) -> None:
    """Measures the methods on the queries of files."""
    points: dict[tuple[str, str], list[np.ndarray]] = {}
    for path in arguments.paths:
        for file in find_query_files([path]):
            queries = read_query_file(file)
            points.setdefault((path, queries.kind), []).append(queries.points)
    threads = count_threads()

    def measure() -> Generator[GivenQueries, None, None]:
        with cores(threads):
            with loading_kernels(device):
                for kind in {kind for _, kind in points}:
                    benchmark_given_queries("", _KINDS[kind], np.zeros((1, 8, 3)), device=device, repeat=1)
            for (path, kind), parts in points.items():
                queries = np.concatenate(parts)
                yield benchmark_given_queries(
                    Path(path).name, _KINDS[kind], queries, device=device, repeat=arguments.repeat
                )

    time = "Nanoseconds of processor time" if device.is_cpu else "Nanoseconds"
    place = name_place(device, threads)
    report_runs(
        arguments,
        device,
        measure(),
        name="given queries",
        heading=f"{time} a query on {place}; the fastest of {count(arguments.repeat, 'turn')}",
        show=_show_given,
        to_dict=lambda measured: {
            "threads": threads,
            "repeat": arguments.repeat,
            "queries": [vars(found) | {"kind": found.kind.display_name} for found in measured],
        },
    )


def _show_random(console: Console, benchmarks: list[QueryBenchmark], copy_rate: float) -> None:
    """Prints the results of random queries, and how many a second were decided."""
    rows = [(found.kind.display_name, found) for found in benchmarks]
    print_table(console, "Kind", _RESULTS, rows, caption="Survivors: queries that no cull decides.")
    console.print()
    modes = [
        (f"{kind}, {mode}", took)
        for kind, found in rows
        for mode, took in _kind_to_dict(found, copy_rate)["modes"].items()
    ]
    print_table(console, "Mode", _RATES, modes)
    console.print()
    say(console, "status: finds the status of each query, in one kernel.")
    say(console, "impact: finds the time of impact, coordinates and normal as well.")
    say(console, "queued: finds the status by two kernels: culls, and a decision of the survivors.")
    say(console, "exact: finds the status in integers, where floating point cannot certify it.")
    say(console, "function: query_vertex_face or query_edge_edge with out=, exact, with times.")
    say(console, f"A copy on this device reads and writes {copy_rate / 1e9:,.1f} GB/s.")


def _kind_to_dict(found: QueryBenchmark, copy_rate: float) -> dict[str, Any]:
    return {
        "kind": found.kind.display_name,
        "queries": len(found.status),
        "survivors": found.survivors,
        "survivor_share": found.survivor_share,
        "certified": {"free": found.free, "hit": found.hits, "unsure": found.unsure},
        "modes": {
            mode: {
                "milliseconds": milliseconds,
                "queries_per_second": found.queries_per_second[mode],
                "bytes_per_query": MODES[mode],
                "bytes_per_second": found.bytes_per_second[mode],
                "share_of_copy": found.bytes_per_second[mode] / copy_rate,
            }
            for mode, milliseconds in found.milliseconds.items()
        },
    }


def _show_given(console: Console, measured: list[GivenQueries]) -> None:
    """Prints the times of the methods on given queries."""
    rows = [(f"{found.name}, {found.kind.display_name}", found) for found in measured]
    caption = "cubic: a floating-point cubic solver, see warp-bsc bench. Times of impact are not sought."
    print_table(console, "Queries", _GIVEN, rows, caption=caption)


BENCHMARK = Benchmark(
    _run,
    _DESCRIPTION,
    _EXAMPLES,
    {
        "paths": several(
            "FILE",
            "a CSV file as of warp-bsc query, or a folder: all CSV files in it and below, in one row for each kind",
        ),
        "--count": number(positive, "queries of each kind (default: 2^24 on a GPU, 2^18 on the CPU)"),
        **repeat_options(20),
        **THREADS,
        **DEVICE,
        **JSON_FILE,
    },
)
