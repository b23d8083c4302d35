"""Limits the rows of an interval that files list. The summary of the interval stays that of all rows."""

from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from .results import IntervalResult, at_both
from .scene_contacts import SceneContacts
from .scene_intersections import SceneIntersections
from .scene_proximities import SceneProximities
from .summary import Summary, counted

_Pairs = TypeVar("_Pairs", SceneContacts, SceneProximities)


def limit_rows(result: IntervalResult, limit: int) -> IntervalResult:
    """Returns the result of an interval with at most ``limit`` rows, at least 1, of each list, in their order.

    The lists are the collisions of the interval and, at its start and at its end, the edges that meet faces, the parts
    inside others and the proximities. The first row of each two meshes is kept, as far as there is room, then the first
    others. First are the earliest collisions and the nearest proximities; of edges those that belong to the first pairs
    of triangles, so that the curves along which these cut are whole. Rows are the same for any number of workers.
    """
    return replace(
        result,
        contacts=_first(result.contacts, result.contacts.toi, limit),
        intersections=at_both(lambda found: _limit_intersections(found, limit), result.intersections),
        proximities=at_both(lambda found: _first(found, found.distance, limit), result.proximities),
    )


@dataclass(frozen=True)
class NotListed:
    """Numbers of rows that a limit keeps out of files.

    Attributes:
        limit: The limit.
        collisions: Number of collisions that are not listed, and of all.
        intersections: The same of edges that meet faces and of parts inside others.
        proximities: The same of proximities.
    """

    limit: int
    collisions: tuple[int, int]
    intersections: tuple[int, int]
    proximities: tuple[int, int]

    def __str__(self) -> str:
        """Returns a sentence, empty if all rows are listed."""
        kinds = {
            "collisions": (self.collisions, ", the earliest"),
            "intersections at rest": (self.intersections, ""),
            "proximities": (self.proximities, ", the nearest"),
        }
        parts = [
            f"{found - missing:,} of {found:,} {name}{which}"
            for name, ((missing, found), which) in kinds.items()
            if missing
        ]
        if not parts:
            return ""
        return (
            f"Listed are at most {counted(self.limit, 'row')} of a kind and interval, one of each two meshes first: "
            f"{'; '.join(parts)}. Counts are those of all."
        )


def not_listed(summary: Summary, *, with_end: bool) -> NotListed | None:
    """Returns how many rows a file leaves out; None without a limit.

    Args:
        summary: The replay, as far as it is in the file.
        with_end: Whether the file lists what is at the end of the last interval.
    """
    if summary.limit is None:
        return None
    count = len(summary.intersections or summary.proximities) if with_end else len(summary.intervals)
    lists = (
        [interval.hits for interval in summary.intervals],
        [n for at in summary.intersections[:count] for n in (at.crossings + at.touches, sum(at.inside.values()))],
        [at.pairs for at in summary.proximities[:count]],
    )
    numbers = [(sum(max(0, rows - summary.limit) for rows in found), sum(found)) for found in lists]
    return NotListed(summary.limit, *numbers)


def _limit_intersections(found: SceneIntersections, limit: int) -> SceneIntersections:
    edges, parts = found.edge_rows.stop, len(found) - found.edge_rows.stop
    if max(edges, parts) <= limit:
        return found
    keys, order = found.mesh_keys(), np.argsort(_first_pairs_of_triangles(found), kind="stable")
    inside = edges + np.arange(parts)
    return found.take(np.concatenate([_choose(keys, order, limit), _choose(keys, inside, limit)]))


def _first_pairs_of_triangles(found: SceneIntersections) -> np.ndarray:
    """Returns a number for each edge that meets a face: of the first pair of a triangle at the edge and that face.

    All edges of a pair of triangles have at most its number. Edges of curves, which have no triangle, come last.
    """
    edges = found.edge_rows
    count = len(found.segment.faces)
    rows, sides = found.segment.faces_of_edges(found.vertices[edges, 0])
    both = np.sort(np.stack([sides, found.faces[rows, 1]], axis=1), axis=1)
    numbers = np.full(edges.stop, count**2)
    np.minimum.at(numbers, rows, both[:, 0] * count + both[:, 1])
    return numbers


def _first(pairs: _Pairs, values: np.ndarray, limit: int) -> _Pairs:
    """Returns the pairs with the smallest values."""
    if len(pairs) <= limit:
        return pairs
    return pairs.take(_choose(pairs.mesh_keys(), np.argsort(values, kind="stable"), limit))


def _choose(keys: np.ndarray, order: np.ndarray, limit: int) -> np.ndarray:
    """Returns rows, ascending: the first of each key, as far as there is room, then the first others.

    Args:
        keys: Numbers of the two meshes of each row.
        order: The rows, the first first.
        limit: Largest number of rows.
    """
    firsts = np.sort(np.unique(keys[order], return_index=True)[1])
    others = np.delete(np.arange(len(order)), firsts)
    return np.sort(order[np.concatenate([firsts, others])[:limit]])
