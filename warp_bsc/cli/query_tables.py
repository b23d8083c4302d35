"""Shows the results of query files: tables for people, plain data for programs."""

import os
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from rich.console import Console
from rich.table import Table

from ..detection.query import QueryResult
from .query_file import QueryFile
from .tables import count, make_table, say

__all__ = ["QueryResults", "print_queries", "queries_to_dict"]

_STATUS = ("free", "hit", "unsure")  # by the value of query_vertex_face(...).status


@dataclass(frozen=True)
class QueryResults:
    """The results of the queries of a file.

    Attributes:
        file: The queries.
        result: Their results.
        milliseconds: Time to decide all of them [ms].
    """

    file: QueryFile
    result: QueryResult
    milliseconds: float

    @property
    def hits(self) -> int:
        """Number of queries decided as collisions."""
        return int(self.result.hit.sum())

    @property
    def certified(self) -> dict[str, int]:
        """Number of queries that floating point certified as free, as hits, and could not certify."""
        return {name: int((self.result.status == code).sum()) for code, name in enumerate(_STATUS)}

    @property
    def confusion(self) -> dict[str, int] | None:
        """Number of true and false positives and negatives; None if the truth is not known."""
        hit, truth = self.result.hit, self.file.truth
        if truth is None:
            return None
        return {
            "true_positives": int((hit & truth).sum()),
            "false_positives": int((hit & ~truth).sum()),
            "true_negatives": int((~hit & ~truth).sum()),
            "false_negatives": int((~hit & truth).sum()),
        }


def print_queries(
    console: Console, results: list[QueryResults], *, method: str, device: str, min_distance: float
) -> None:
    """Prints the results of query files and compares them with the truth, where that is known.

    Args:
        console: The terminal or file to print to.
        results: The results of each file.
        method: The method.
        device: The device.
        min_distance: Distance up to which pairs collide; 0 if they must touch.
    """
    folder = os.path.commonpath([found.file.path.absolute().parent for found in results])
    distance = f"; minimum distance {min_distance:g}" if min_distance else ""
    say(console, f"{count(len(results), 'file')} in {folder}; method {method} on {device}{distance}")
    say(console, "Free, hit and unsure: the certificates of floating point, the same for every method.")
    table = make_table("File", "Queries", "Hits", "Free", "Hit", "Unsure", "ms")
    _add_files(
        table,
        folder,
        [(a.file, [len(a.file.points), a.hits, *a.certified.values(), a.milliseconds]) for a in results],
    )
    console.print(table)

    known = [(found.file, found.confusion) for found in results if found.confusion]
    if known:
        table = make_table("Against the truth", "True\npos.", "False\npos.", "True\nneg.", "False\nneg.")
        _add_files(table, folder, [(file, list(confusion.values())) for file, confusion in known])
        console.print()
        console.print(table)
    for file, _ in known:
        if file.truth_path and file.truth_path != file.path:
            say(console, f"Truth of {file.path.name} from {file.truth_path.name}.")


def queries_to_dict(results: list[QueryResults], *, method: str, device: str, min_distance: float) -> dict[str, Any]:
    """Returns the results as plain data for JSON; arguments as of :func:`print_queries`."""
    return {
        "method": method,
        "device": device,
        "min_distance": min_distance,
        "files": [
            {
                "path": str(found.file.path),
                "kind": found.file.kind,
                "queries": len(found.file.points),
                "hits": found.hits,
                "certified": found.certified,
                "truth_path": str(found.file.truth_path) if found.file.truth_path else None,
                "confusion": found.confusion,
                "milliseconds": found.milliseconds,
                "hit": found.result.hit.tolist(),
                "status": [_STATUS[status] for status in found.result.status],
                "toi": None if found.result.toi is None else [toi if toi <= 1.0 else None for toi in found.result.toi],
            }
            for found in results
        ],
    }


def _add_files(table: Table, folder: str, rows: list[tuple[QueryFile, list[int | float]]]) -> None:
    """Adds a row for each file and, if there are several, one for their sum."""

    def format_all(numbers: Iterable[int | float]) -> list[str]:
        return [f"{number:,.1f}" if isinstance(number, float) else f"{number:,}" for number in numbers]

    for file, numbers in rows:
        table.add_row(os.path.relpath(file.path.with_suffix(""), folder), *format_all(numbers))
    if len(rows) > 1:
        table.add_section()
        table.add_row("all", *format_all(map(sum, zip(*(numbers for _, numbers in rows), strict=True))))
