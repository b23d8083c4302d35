"""Shows the results of query files: tables for people, plain data for programs."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from operator import itemgetter
from typing import Any

from rich.console import Console

from ..bench.tables import Column, count
from ..detection.queries.query import QueryResult
from .query_file import QueryFile
from .tables import print_table, say

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
    names = [os.path.relpath(found.file.path.with_suffix(""), folder) for found in results]
    numbers = [(len(a.file.points), a.hits, *a.certified.values(), a.milliseconds) for a in results]
    _print_sums(console, ("File", "Queries", "Hits", "Free", "Hit", "Unsure", "ms"), names, numbers)
    known = [(name, found.confusion) for name, found in zip(names, results, strict=True) if found.confusion]
    if known:
        console.print()
        headers = ("Against the truth", "True\npos.", "False\npos.", "True\nneg.", "False\nneg.")
        _print_sums(console, headers, [name for name, _ in known], [tuple(counts.values()) for _, counts in known])
    for file in (found.file for found in results):
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


def _print_sums(
    console: Console, headers: Sequence[str], names: list[str], numbers: list[tuple[int | float, ...]]
) -> None:
    """Prints a row of numbers for each file and, if there are several, one of their sums."""

    def write(number: float) -> str:
        return f"{number:,.1f}" if isinstance(number, float) else f"{number:,}"

    columns = [Column(header, itemgetter(i), write) for i, header in enumerate(headers[1:])]
    total = tuple(map(sum, zip(*numbers, strict=True))) if len(numbers) > 1 else None
    print_table(console, headers[0], columns, zip(names, numbers, strict=True), total=total)
