"""The command ``warp-bsc bench queries``: measures how many elementary queries a second are decided."""

import argparse
from pathlib import Path

import numpy as np
import warp as wp

from .._atomic_file import STDOUT
from ..bench.provenance import with_record
from ..bench.queries import benchmark_copy, benchmark_queries, check_query_count
from ..bench.query_files import benchmark_given_queries
from ..bench.timing import count_threads, limited_threads
from ..detection.launch import cores
from ..detection.settings import PairKind
from .bench_queries_tables import (
    given_queries_to_dict,
    print_given_queries,
    print_query_benchmarks,
    query_benchmarks_to_dict,
)
from .bench_runs import add_json_file, open_json
from .device import find_device, loading_kernels
from .exit_status import explain_statuses
from .options import (
    Commands,
    add_command,
    add_device,
    add_repeat,
    add_threads,
    positive,
)
from .query_file import find_query_files, read_query_file
from .tables import Console

__all__ = ["add_to"]

_KINDS = {kind.display_name: kind for kind in PairKind}

_DESCRIPTION = """\
Measure how many elementary queries a second are decided. The queries are
random and the same on every device; a third of them survive the culls. Queries
and results stay on the device. On a GPU, replays of a CUDA graph are timed by
events. With files of queries, measure the time that each method takes for one
of them, beside a floating-point cubic solver."""

_EPILOG = f"""\
examples:
  warp-bsc bench queries
  warp-bsc bench queries --device cpu --threads 1 --count 1000000
  warp-bsc bench queries unit-tests 227vf.csv --device cpu --threads 1
  warp-bsc bench queries --json rates.json

{explain_statuses()}"""


def add_to(commands: Commands, summary: str) -> None:
    """Adds the command with its options, and a line for the list of commands."""
    command = add_command(commands, "queries", _run, summary=summary, description=_DESCRIPTION, epilog=_EPILOG)
    command.add_argument(
        "paths",
        metavar="FILE",
        nargs="*",
        help="a CSV file as of warp-bsc query, or a folder: all CSV files in it and below, in one row for each kind",
    )
    command.add_argument(
        "--count", type=positive, metavar="N", help="queries of each kind (default: 2^24 on a GPU, 2^18 on the CPU)"
    )
    add_repeat(command, default=20)
    add_threads(command)
    add_device(command)
    add_json_file(command)


def _run(arguments: argparse.Namespace) -> int:
    if arguments.count is not None:
        check_query_count(arguments.count)
    if arguments.paths and arguments.count is not None:
        raise ValueError("--count is for random queries: omit it, or the files")
    device = find_device(arguments.device)
    if arguments.paths:
        return _measure_files(arguments, device)
    options = {"device": device, "repeat": arguments.repeat}
    with open_json(arguments.json) as write, limited_threads(arguments.threads):
        with loading_kernels(device):
            for kind in PairKind:
                benchmark_queries(kind, count=1, device=device, repeat=1)
        benchmarks = [benchmark_queries(kind, count=arguments.count, **options) for kind in PairKind]
        settings = {"copy_rate": benchmark_copy(**options), "threads": count_threads(), **options}
        if arguments.json != STDOUT:
            print_query_benchmarks(Console(), benchmarks, **settings)
        write(with_record(query_benchmarks_to_dict(benchmarks, **settings), arguments.command_line, [device]))
    return 0


def _measure_files(arguments: argparse.Namespace, device: wp.Device) -> int:
    """Measures the methods on the queries of files."""
    points: dict[tuple[str, str], list[np.ndarray]] = {}
    for path in arguments.paths:
        for file in find_query_files([path]):
            queries = read_query_file(file)
            points.setdefault((path, queries.kind), []).append(queries.points)
    options = {"device": device, "repeat": arguments.repeat}
    with open_json(arguments.json) as write, limited_threads(arguments.threads), cores(count_threads()):
        with loading_kernels(device):
            for kind in {kind for _, kind in points}:
                benchmark_given_queries("", _KINDS[kind], np.zeros((1, 8, 3)), device=device, repeat=1)
        measured = [
            benchmark_given_queries(Path(path).name, _KINDS[kind], np.concatenate(parts), **options)
            for (path, kind), parts in points.items()
        ]
        settings = {"threads": count_threads(), **options}
        if arguments.json != STDOUT:
            print_given_queries(Console(), measured, **settings)
        write(with_record(given_queries_to_dict(measured, **settings), arguments.command_line, [device]))
    return 0
