"""Shows the results of query files: tables for people, plain data for programs."""

import os
from collections.abc import Sequence
from operator import itemgetter
from pathlib import Path
from typing import Any

from rich.console import Console

from ..bench.tables import Column, count
from ..detection.queries.query import QueryResult
from .query_file import QueryFile
from .tables import print_table, say

_STATUS = ("free", "hit", "unsure")  # by the value of query_vertex_face(...).status


def results_of(file: QueryFile, result: QueryResult, milliseconds: float) -> dict[str, Any]:
    """Returns numbers of the results of a file as plain data for JSON, with the time to decide all of them [ms].

    ``certified`` has the numbers of queries that floating point certified as free, as hits, and could not certify;
    ``confusion`` those of true and false positives and negatives, None if the truth is not known.
    """
    hit, truth = result.hit, file.truth
    confusion = None
    if truth is not None:
        confusion = {
            "true_positives": int((hit & truth).sum()),
            "false_positives": int((hit & ~truth).sum()),
            "true_negatives": int((~hit & ~truth).sum()),
            "false_negatives": int((~hit & truth).sum()),
        }
    return {
        "path": str(file.path),
        "kind": file.kind,
        "queries": len(file.points),
        "hits": int(hit.sum()),
        "certified": {name: int((result.status == code).sum()) for code, name in enumerate(_STATUS)},
        "truth_path": str(file.truth_path) if file.truth_path else None,
        "confusion": confusion,
        "milliseconds": milliseconds,
    }


def answers_of(result: QueryResult) -> dict[str, Any]:
    """Returns the result of each query as plain data for JSON."""
    toi = None if result.toi is None else [toi if toi <= 1.0 else None for toi in result.toi]
    return {"hit": result.hit.tolist(), "status": [_STATUS[status] for status in result.status], "toi": toi}


def print_queries(console: Console, found: dict[str, Any]) -> None:
    """Prints the JSON of the results of query files, and compares them with the truth, where that is known."""
    rows = found["files"]
    folder = os.path.commonpath([Path(row["path"]).absolute().parent for row in rows])
    distance = f"; minimum distance {found['min_distance']:g}" if found["min_distance"] else ""
    where = f"method {found['method']} on {found['device']}{distance}"
    say(console, f"{count(len(rows), 'file')} in {folder}; {where}")
    say(console, "Free, hit and unsure: the certificates of floating point, the same for every method.")
    names = [os.path.relpath(Path(row["path"]).with_suffix(""), folder) for row in rows]
    numbers = [(row["queries"], row["hits"], *row["certified"].values(), row["milliseconds"]) for row in rows]
    _print_sums(console, ("File", "Queries", "Hits", "Free", "Hit", "Unsure", "ms"), names, numbers)
    known = [(name, row["confusion"]) for name, row in zip(names, rows, strict=True) if row["confusion"]]
    if known:
        console.print()
        headers = ("Against the truth", "True\npos.", "False\npos.", "True\nneg.", "False\nneg.")
        _print_sums(console, headers, [name for name, _ in known], [tuple(counts.values()) for _, counts in known])
    for row in rows:
        if row["truth_path"] and row["truth_path"] != row["path"]:
            say(console, f"Truth of {Path(row['path']).name} from {Path(row['truth_path']).name}.")


def _print_sums(
    console: Console, headers: Sequence[str], names: list[str], numbers: list[tuple[int | float, ...]]
) -> None:
    """Prints a row of numbers for each file and, if there are several, one of their sums."""

    def write(number: float) -> str:
        return f"{number:,.1f}" if isinstance(number, float) else f"{number:,}"

    columns = [Column(header, itemgetter(i), write) for i, header in enumerate(headers[1:])]
    total = tuple(map(sum, zip(*numbers, strict=True))) if len(numbers) > 1 else None
    print_table(console, headers[0], columns, zip(names, numbers, strict=True), total=total)
