"""The command ``warp-bsc query``: decides the elementary queries of CSV files."""

import argparse
import dataclasses
import json
import time
from collections.abc import Callable

import numpy as np

from ..detection.queries.query import QueryResult, query_edge_edge, query_vertex_face
from .device import find_device, loading_kernels
from .exit_status import ExitStatus, explain_statuses
from .options import JSON, Commands, add_command, add_fail_on, add_options, detection_options, distance, number, several
from .query_file import KINDS, find_query_files, read_query_file
from .query_tables import answers_of, print_queries, results_of
from .tables import Console

_DESCRIPTION = """\
Decide elementary queries and, if the truth is known, compare the results with
it. A query is eight rows of a CSV file, one a point; a row holds the numerators
and denominators of x, y and z and, if known, the true result, 0 or 1. The true
results may also be in NAME_mma_bool.json."""

_EPILOG = f"""\
examples:
  warp-bsc query 227vf.csv 227ee.csv
  warp-bsc query unit-tests --method float
  warp-bsc query pairs.csv --kind edge-edge --json > results.json
  warp-bsc query 227vf.csv --min-distance 0.001

{explain_statuses(ExitStatus.FOUND)}"""

_QUERIES: dict[str, Callable[..., QueryResult]] = dict(zip(KINDS, (query_vertex_face, query_edge_edge), strict=True))


def add_to(commands: Commands, summary: str) -> None:
    """Adds the command with its options, and a line for the list of commands."""
    command = add_command(commands, "query", _run, summary=summary, description=_DESCRIPTION, epilog=_EPILOG)
    add_options(
        command,
        {
            "paths": several("FILE", "a CSV file, or a folder: all CSV files in it and below", nargs="+"),
            "--kind": {
                "choices": KINDS,
                "help": "kind of the queries (default: that of a folder vertex-face or edge-edge, or a name ending in "
                "vf or ee)",
            },
            "--min-distance": number(
                distance,
                "count pairs that come within D of each other, in the unit of the points, as collisions (default: "
                "pairs that touch); the true results in the files, which hold without a distance, are not compared "
                "then",
                default=0.0,
                metavar="D",
            ),
            **detection_options("exact"),
            **JSON,
        },
    )
    add_fail_on(command, {"collisions": ""})


def _run(arguments: argparse.Namespace) -> int:
    files = [read_query_file(path, kind=arguments.kind) for path in find_query_files(arguments.paths)]
    device = find_device(arguments.device)
    if arguments.min_distance:
        files = [dataclasses.replace(file, truth=None, truth_path=None) for file in files]
    options = {"method": arguments.method, "min_distance": arguments.min_distance, "toi": arguments.json}
    options["device"] = device
    with loading_kernels(device):
        for kind in {file.kind for file in files}:
            _QUERIES[kind](np.zeros((1, 8, 3)), **options)
    rows = []
    for file in files:
        start = time.perf_counter()
        result = _QUERIES[file.kind](file.points, **options)
        row = results_of(file, result, 1e3 * (time.perf_counter() - start))
        rows.append(row | answers_of(result) if arguments.json else row)
    found = {"method": arguments.method, "device": str(device), "min_distance": arguments.min_distance, "files": rows}
    if arguments.json:
        print(json.dumps(found))
    else:
        print_queries(Console(), found)
    return ExitStatus.FOUND if arguments.fail_on and any(row["hits"] for row in rows) else ExitStatus.DONE
