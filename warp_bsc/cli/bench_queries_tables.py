"""Shows the measurements of elementary queries: tables for people, plain data for programs."""

from typing import Any

import warp as wp
from rich.console import Console

from ..bench.queries import MODES, SEED, QueryBenchmark
from ..bench.query_files import METHODS, GivenQueries
from .tables import count, make_table, say

__all__ = ["given_queries_to_dict", "print_given_queries", "print_query_benchmarks", "query_benchmarks_to_dict"]


def print_query_benchmarks(
    console: Console,
    benchmarks: list[QueryBenchmark],
    *,
    copy_rate: float,
    device: wp.Device,
    threads: int,
    repeat: int,
) -> None:
    """Prints the results of random queries, and how many a second were decided.

    Args:
        console: The terminal or file to print to.
        benchmarks: The measurements of each kind of query.
        copy_rate: Bytes that a copy on the device reads and writes [1/s].
        device: The Warp device.
        threads: Number of CPU cores.
        repeat: Number of repetitions.
    """
    cores = count(threads, "core") if device.is_cpu else device.name
    say(console, f"Random queries on {device}, {cores}; medians of {count(repeat, 'repetition')}")
    caption = "Survivors: queries that no cull decides."
    table = make_table("Kind", "Queries", "Survivors", "Share", "Free", "Hit", "Unsure", caption=caption)
    for found in benchmarks:
        numbers = [len(found.status), found.survivors, found.free, found.hits, found.unsure]
        number, survivors, *statuses = (f"{number:,}" for number in numbers)
        table.add_row(found.kind.display_name, number, survivors, f"{found.survivor_share:.1%}", *statuses)
    console.print(table)
    console.print()

    table = make_table(
        "Mode",
        "ms",
        "Million\nqueries/s",
        "Bytes\na query",
        "GB/s",
        "Share of\ncopying",
    )
    for took in benchmarks:
        for mode, milliseconds in took.milliseconds.items():
            rate = took.bytes_per_second[mode]
            table.add_row(
                f"{took.kind.display_name}, {mode}",
                f"{milliseconds:,.2f}",
                f"{took.queries_per_second[mode] / 1e6:,.1f}",
                str(MODES[mode]),
                f"{rate / 1e9:,.1f}",
                f"{rate / copy_rate:.1%}",
            )
    console.print(table)
    console.print()
    say(console, "status: finds the status of each query, in one kernel.")
    say(console, "impact: finds the time of impact, coordinates and normal as well.")
    say(console, "queued: finds the status by two kernels: culls, and a decision of the survivors.")
    say(console, "exact: finds the status in integers, where floating point cannot certify it.")
    say(console, "function: query_vertex_face or query_edge_edge with out=, exact, with times.")
    say(console, f"A copy on this device reads and writes {copy_rate / 1e9:,.1f} GB/s.")


def query_benchmarks_to_dict(
    benchmarks: list[QueryBenchmark], *, copy_rate: float, device: wp.Device, threads: int, repeat: int
) -> dict[str, Any]:
    """Returns the measurements as plain data for JSON. Arguments: as of :func:`print_query_benchmarks`."""
    return {
        "benchmark": "queries",
        "device": str(device),
        "device_name": device.name,
        "threads": threads,
        "repeat": repeat,
        "seed": SEED,
        "copy_bytes_per_second": copy_rate,
        "kinds": [
            {
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
            for found in benchmarks
        ],
    }


def print_given_queries(
    console: Console, measured: list[GivenQueries], *, device: wp.Device, threads: int, repeat: int
) -> None:
    """Prints the times of the methods on given queries.

    Args:
        console: The terminal or file to print to.
        measured: The measurements.
        device: The Warp device.
        threads: Number of CPU cores.
        repeat: Number of turns.
    """
    cores = count(threads, "core") if device.is_cpu else device.name
    kind_of_time = "Nanoseconds of processor time" if device.is_cpu else "Nanoseconds"
    say(console, f"{kind_of_time} a query on {device}, {cores}; the fastest of {count(repeat, 'turn')}")
    caption = "cubic: a floating-point cubic solver, see warp-bsc bench. Times of impact are not sought."
    names = [method.replace("conservative", "conser-\nvative") for method in METHODS]
    table = make_table("Queries", "Number", "Collide", *names, "float /\ncubic", "exact /\ncubic", caption=caption)
    for found in measured:
        ns = found.nanoseconds
        table.add_row(
            f"{found.name}, {found.kind.display_name}",
            f"{found.queries:,}",
            f"{found.hits / found.queries:.0%}",
            *(f"{ns[method]:,.1f}" for method in METHODS),
            *(f"{ns[method] / ns['cubic']:.2f}" for method in ("float", "exact")),
        )
    console.print(table)


def given_queries_to_dict(
    measured: list[GivenQueries], *, device: wp.Device, threads: int, repeat: int
) -> dict[str, Any]:
    """Returns the measurements as plain data for JSON. Arguments: as of :func:`print_given_queries`."""
    return {
        "benchmark": "given queries",
        "device": str(device),
        "device_name": device.name,
        "threads": threads,
        "repeat": repeat,
        "queries": [
            {
                "name": found.name,
                "kind": found.kind.display_name,
                "queries": found.queries,
                "hits": found.hits,
                "nanoseconds": found.nanoseconds,
            }
            for found in measured
        ],
    }
