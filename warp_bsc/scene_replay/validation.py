"""Compares a detection with the exact checker, on pairs found independently of the detector."""

from collections.abc import Iterator
from dataclasses import dataclass, fields

import numpy as np

from .. import checker
from .._sorted_keys import expand_in_chunks
from ..detection.detector import CollisionDetector, Collisions
from ..detection.queries.query_points import query_points

_FEWEST = 1 << 14  # fewest pairs in a call of the checker, as long as there are more: each call has a fixed cost
_NEIGHBOURS = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)


@dataclass(frozen=True)
class Validation:
    """Comparison of a detection with the exact checker.

    Attributes:
        hits: Number of reported collisions that the checker decided.
        others: Number of unreported pairs with overlapping swept boxes that the checker decided.
        decided: Number of pairs that the detector decided.
        certified: Number of these that floating point certified.
        disagreements: The pairs that the checker decides differently, a sentence each.
        false_hits: Number of reported pairs of method "conservative" that do not collide, as that method permits.
    """

    hits: int
    others: int
    decided: int
    certified: int
    disagreements: tuple[str, ...]
    false_hits: int

    def __add__(self, other: "Validation") -> "Validation":
        """Returns the comparison of both detections."""
        return Validation(*(getattr(self, field.name) + getattr(other, field.name) for field in fields(self)))


def validate(
    detector: CollisionDetector,
    collisions: Collisions,
    x0: np.ndarray,
    x1: np.ndarray,
    *,
    most: int | None,
    seed: int,
    counted: np.ndarray | None = None,
    turns: np.ndarray | None = None,
) -> Validation:
    """Compares a detection with the exact checker.

    Reported pairs must collide, at the reported time. Unreported pairs whose swept boxes overlap must not collide; they
    are found by a grid that shares no code with the detector.

    Args:
        detector: The detector.
        collisions: Its collisions.
        x0: Positions at the start, shape [vertex_count, 3].
        x1: Positions at the end, shape [vertex_count, 3].
        most: Number of reported pairs, and of others, that the checker decides, chosen at random; None for all.
        seed: Seed of the random choice.
        counted: Whether each reported pair may be chosen, vertex-face before edge-edge, bool; default: all.
        turns: Vertices that move on arcs, of which the checker decides nothing, bool, shape [vertex_count]; default:
            none.
    """
    mesh = detector.mesh
    random = np.random.default_rng(seed)
    disagreements = []
    decided_hits = decided_others = false_hits = 0
    vertices, faces, edges = np.arange(mesh.vertex_count)[:, None], mesh.faces, mesh.edges
    for kind, first, second in (("vertex_face", vertices, faces), ("edge_edge", edges, edges)):
        found, toi = getattr(collisions, kind), getattr(collisions, f"{kind}_toi")

        def are_straight(pairs, first=first, second=second):
            if turns is None:
                return np.ones(len(pairs), dtype=bool)
            return ~(turns[first[pairs[:, 0]]].any(axis=1) | turns[second[pairs[:, 1]]].any(axis=1))

        rows = np.arange(len(found))
        if counted is not None:
            rows, counted = np.flatnonzero(counted[: len(found)]), counted[len(found) :]
        rows = rows[are_straight(found[rows])]
        if most is not None and len(rows) > most:
            rows = np.sort(random.choice(rows, most, replace=False))
        decided_hits += len(rows)
        bounds = getattr(checker, f"{kind}_toi")(query_points(second, found[rows], x0, x1, kind=kind))
        for row, (earliest, latest) in zip(rows, bounds, strict=True):
            pair = f"{kind.replace('_', '-')} {found[row].tolist()}"
            if np.isnan(earliest) and detector.method == "conservative":
                false_hits += 1
            elif np.isnan(earliest):
                disagreements.append(f"{pair} was reported and does not collide")
            elif toi[row] > latest:
                disagreements.append(f"{pair} was reported at {toi[row]!r} and collides at {latest!r} already")
            elif detector.method == "exact" and toi[row] < earliest - detector.tolerance:
                disagreements.append(f"{pair} was reported at {toi[row]!r} and collides at {earliest!r} only")

        others = (p[are_straight(p)] for p in _unreported(mesh, kind, first, second, found, x0, x1))
        for pairs in _merged(others) if most is None else [_choose(others, most, random)]:
            decided_others += len(pairs)
            collides = getattr(checker, kind)(query_points(second, pairs, x0, x1, kind=kind))
            name = kind.replace("_", "-")
            disagreements += [f"{name} {pair} collides and was not reported" for pair in pairs[collides].tolist()]

    counts = collisions.stats.vertex_face, collisions.stats.edge_edge
    decided = sum(count.candidates for count in counts)
    certified = decided - sum(count.unsure for count in counts)
    return Validation(decided_hits, decided_others, decided, certified, tuple(disagreements), false_hits)


def _unreported(mesh, kind, first, second, found, x0, x1) -> Iterator[np.ndarray]:
    """Yields the unreported pairs of elements that share no vertex and whose swept boxes overlap."""
    used = mesh.vertices if kind == "vertex_face" else np.arange(len(first))

    def boxes(elements):
        corners = np.concatenate([x0[elements], x1[elements]], axis=1).astype(np.float64)
        return corners.min(axis=1), corners.max(axis=1)

    reported = found.astype(np.int64) @ np.array([len(second), 1])
    for rows, columns in overlapping_boxes(boxes(first[used]), boxes(second)):
        pairs = np.stack([used[rows], columns], axis=1)
        if kind == "edge_edge":
            pairs = pairs[pairs[:, 0] < pairs[:, 1]]
        apart = (first[pairs[:, 0]][:, :, None] != second[pairs[:, 1]][:, None, :]).all(axis=(1, 2))
        pairs = pairs[apart]
        yield pairs[~np.isin(pairs @ np.array([len(second), 1]), reported)]


def overlapping_boxes(
    first: tuple[np.ndarray, np.ndarray], second: tuple[np.ndarray, np.ndarray]
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Finds all pairs of boxes that overlap or touch, a chunk at a time.

    Boxes are in classes by size. For two classes, a grid puts each box in the cell of its lowest corner; cells are as
    large as the larger boxes, so that overlapping boxes are in the same cell or in neighbouring ones.

    Args:
        first: Lowest and highest corners of the boxes, two arrays of shape [n, 3].
        second: Those of the other boxes, shape [m, 3].

    Yields:
        Indices of the first and of the second boxes, each shape [k].
    """
    both = np.concatenate([*first, *second])
    if not len(first[0]) or not len(second[0]):
        return
    origin, weights = both.min(axis=0), np.array([1 << 42, 1 << 21, 1])
    smallest = max(np.ptp(both, axis=0).max() * 2.0**-20, np.finfo(np.float64).tiny)  # cells fit into 21 bits

    def by_size(low, high):
        sizes = np.ceil(np.log2(np.maximum((high - low).max(axis=1), smallest) / smallest)).astype(int)
        return {int(size): np.flatnonzero(sizes == size) for size in np.unique(sizes)}

    for size_a, a in by_size(*first).items():
        for size_b, b in by_size(*second).items():
            cell = smallest * 2.0 ** max(size_a, size_b) * (1.0 + 1e-6)  # cells are numbered with rounding
            cells_a = np.floor((first[0][a] - origin) / cell).astype(np.int64)
            cells_b = np.floor((second[0][b] - origin) / cell).astype(np.int64)
            keys = (cells_b + 1) @ weights
            order = np.argsort(keys, kind="stable")
            keys = keys[order]
            for step in _NEIGHBOURS:
                neighbours = (cells_a + step + 1) @ weights
                begin, end = np.searchsorted(keys, neighbours), np.searchsorted(keys, neighbours, side="right")
                for rows, columns in expand_in_chunks(begin, end):
                    i, j = a[rows], b[order[columns]]
                    for axis in range(3):
                        overlap = first[0][i, axis] <= second[1][j, axis]
                        overlap &= second[0][j, axis] <= first[1][i, axis]
                        i, j = i[overlap], j[overlap]
                    yield i, j


def _merged(chunks: Iterator[np.ndarray]) -> Iterator[np.ndarray]:
    """Yields the pairs of all chunks in their order, in fewer and larger chunks."""
    waiting, count = [], 0
    for pairs in chunks:
        waiting.append(pairs)
        count += len(pairs)
        if count >= _FEWEST:
            yield np.concatenate(waiting)
            waiting, count = [], 0
    if count:
        yield np.concatenate(waiting)


def _choose(chunks, most, random) -> np.ndarray:
    """Returns some of all pairs, each with the same probability."""
    chosen, lots = np.zeros((0, 2), dtype=np.int64), np.zeros(0)
    for pairs in chunks:
        chosen = np.concatenate([chosen, pairs])
        lots = np.concatenate([lots, random.random(len(pairs))])
        if len(chosen) > most:
            keep = np.argpartition(lots, most)[:most]
            chosen, lots = chosen[keep], lots[keep]
    return chosen
