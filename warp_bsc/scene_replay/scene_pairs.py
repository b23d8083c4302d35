"""Pairs of elements of a scene's meshes, in the prims' own numbers."""

from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import ClassVar, Self

import numpy as np

from ..usd.segment import Segment

KINDS = ("vertex-face", "edge-edge", "vertex-edge", "vertex-vertex", "edge-face")
"""Labels of the kinds of pair, by their numbers; the last is of intersections, the two before of points or curves."""

PHASES = ("passes", "enters", "leaves", "stays")
"""The phases of a contact, by 1 if the surfaces at its elements cross at the interval's end, plus 2 if at its start.

Surfaces that cross at neither time touch within the interval, or pass through each other and out again.
"""

ALL_PHASES = (*PHASES, "crosses", "touches", "inside", "near")
"""These, and what the elements of intersections and proximities do, by their numbers."""
CROSSES, TOUCHES, INSIDE, NEAR = range(len(PHASES), len(ALL_PHASES))

VERTEX, FACE, EDGE, DIAGONAL = range(4)
"""The kinds of element. A diagonal is an edge between two triangles of one polygon; the prim has no such edge."""

ELEMENT_WORDS = ("vertex", "face", "edge", "diagonal")
"""The words for the kinds of element, by their numbers."""

NO_PAIRS = {
    "kind": np.zeros(0, dtype=np.int64),
    "elements": np.zeros((0, 2), dtype=np.int64),
    "meshes": np.zeros((0, 2), dtype=np.int64),
    "indices": np.zeros((0, 2, 2), dtype=np.int64),
    "vertices": np.zeros((0, 2, 2), dtype=np.int64),
    "faces": np.zeros((0, 2), dtype=np.int64),
    "position": np.zeros((0, 3)),
}
"""The arrays of :class:`ScenePairs` without pairs. Most intervals have none; naming nothing would take half of their
time."""

_CHUNK = 256  # rows; more at a time would make Python's garbage collector scan their texts often


@dataclass(frozen=True)
class ScenePairs:
    """Pairs of elements of a segment: arrays with a row for each pair.

    Attributes:
        segment: The segment.
        kind: Index in :data:`KINDS`, shape [n].
        elements: Kinds of the two elements: :data:`VERTEX`, :data:`FACE`, :data:`EDGE` or :data:`DIAGONAL`, shape
            [n, 2].
        meshes: The two meshes, indices in ``segment.meshes``, shape [n, 2].
        indices: Indices of the two elements in their prims, shape [n, 2, 2]: the point and -1 for a vertex, the polygon
            and -1 for a face, the points at both ends for an edge or a diagonal.
        vertices: Vertices of the segment at the two elements, shape [n, 2, 2]: the vertex and -1 for a vertex, both
            ends for an edge or a diagonal, -1 twice for a face.
        faces: Face of the segment for a face, else -1, shape [n, 2].
        position: Points in which the two meet, in world space and the scene's unit of length, shape [n, 3].
    """

    segment: Segment = field(repr=False)
    kind: np.ndarray
    elements: np.ndarray
    meshes: np.ndarray
    indices: np.ndarray
    vertices: np.ndarray
    faces: np.ndarray
    position: np.ndarray

    BY_PAIR: ClassVar[tuple[str, ...]] = ("kind", "elements", "meshes", "indices", "vertices", "faces", "position")
    """Names of the arrays with a row for each pair."""

    def __len__(self) -> int:
        return len(self.meshes)

    def take(self, rows: np.ndarray) -> Self:
        """Returns some pairs, given their rows or a mask, without the others."""
        arrays = {name: getattr(self, name) for name in self.BY_PAIR}
        return replace(self, **{name: array[rows] for name, array in arrays.items() if array is not None})

    def chunks(self, rows: slice = slice(None)) -> list[slice]:
        """Returns rows, default all, as slices of limited length, as their text takes many times their memory."""
        first, stop, _ = rows.indices(len(self))
        return [slice(start, min(start + _CHUNK, stop)) for start in range(first, stop, _CHUNK)]

    def mesh_names(self, rows: slice) -> list[tuple[str, str]]:
        """Returns the names of the two meshes of some pairs."""
        return self._of_meshes("name", rows)

    def mesh_paths(self, rows: slice) -> list[tuple[str, str]]:
        """Returns the paths of the prims of the two meshes of some pairs."""
        return self._of_meshes("path", rows)

    def element_names(self, rows: slice) -> list[tuple[str, str]]:
        """Returns the elements of some pairs: ``"vertex 12"``, ``"face 3"``, ``"edge 4-5"`` or ``"diagonal 0-2"``."""
        words, indices = np.array(ELEMENT_WORDS)[self.elements[rows]].T.tolist(), self.indices[rows].transpose(1, 0, 2)
        sides = [
            [f"{word} {a}" if b < 0 else f"{word} {a}-{b}" for word, (a, b) in zip(own, numbers, strict=True)]
            for own, numbers in zip(words, indices.tolist(), strict=True)
        ]
        return list(zip(*sides, strict=True))

    def element_indices(self, rows: slice) -> list[tuple[list[int], list[int]]]:
        """Returns the indices of the two elements of some pairs in their prims, one or two numbers each."""
        return [([a, b][: 1 + (b >= 0)], [c, d][: 1 + (d >= 0)]) for (a, b), (c, d) in self.indices[rows].tolist()]

    def triangles(self, rows: slice) -> list[int | None]:
        """Returns the number of each pair's face among the triangles of its polygon, from 0; None without a face."""
        faces = self.faces[rows].max(axis=1)
        triangles = np.full(len(faces), None)
        triangles[faces >= 0] = self.segment.triangles_in_polygons(faces[faces >= 0])
        return triangles.tolist()

    def _of_meshes(self, attribute, rows) -> list[tuple[str, str]]:
        """Returns an attribute of the two meshes of some pairs; pairs of the same meshes share them."""
        meshes = self.segment.meshes
        keys, numbers = np.unique(self.meshes[rows] @ np.array([len(meshes), 1]), return_inverse=True)
        both = [tuple(getattr(meshes[mesh], attribute) for mesh in divmod(key, len(meshes))) for key in keys.tolist()]
        return [both[number] for number in numbers.tolist()]

    def mesh_keys(self) -> np.ndarray:
        """Returns a number for the two meshes of each pair, the same for both orders, shape [n]."""
        first, second = np.sort(self.meshes, axis=1).T
        return first * len(self.segment.meshes) + second


def count_by_meshes(
    segment: Segment, meshes: np.ndarray, weights: np.ndarray | None = None
) -> dict[tuple[str, str], tuple[int, ...]]:
    """Returns the number of pairs by the names of their two meshes, in the scene's order.

    Args:
        segment: The segment.
        meshes: The two meshes of each pair, indices in ``segment.meshes``, shape [n, 2].
        weights: Values to be added up instead of 1 for each pair, bool or integers, shape [n, k].
    """
    if not len(meshes):
        return {}
    keys = np.minimum(*meshes.T) * len(segment.meshes) + np.maximum(*meshes.T)
    pairs, numbers = np.unique(keys, return_inverse=True)
    columns = [None] if weights is None else weights.T
    sums = np.stack([np.bincount(numbers, column, len(pairs)) for column in columns], axis=1).astype(np.int64)
    names = [mesh.name for mesh in segment.meshes]
    return {
        (names[pair // len(names)], names[pair % len(names)]): tuple(row)
        for pair, row in zip(pairs.tolist(), sums.tolist(), strict=True)
    }


def name_elements(
    segment: Segment,
    vertices: np.ndarray,
    faces: np.ndarray,
    ends: np.ndarray,
    points: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None,
) -> dict[str, np.ndarray]:
    """Returns the arrays of :class:`ScenePairs` except the positions, for pairs given kind by kind.

    Args:
        segment: The segment.
        vertices: Vertices of the vertex-face pairs, shape [n].
        faces: Their faces, shape [n].
        ends: Vertices at both ends of both edges of the edge-edge pairs, the smaller first, shape [m, 2, 2].
        points: Vertices of vertex-edge pairs, shape [k], vertices at both ends of their edges, the smaller first, shape
            [k, 2], and vertices of vertex-vertex pairs, shape [l, 2]; None if there are none.
    """
    blocks = [(VERTEX, vertices, FACE, faces), (EDGE, ends[:, 0], EDGE, ends[:, 1])]
    if points:
        of_edges, edges, both = points
        blocks += [(VERTEX, of_edges, EDGE, edges), (VERTEX, both[:, 0], VERTEX, both[:, 1])]
    counts = [len(first) for _, first, _, _ in blocks]
    n = sum(counts)
    elements, meshes = np.zeros((n, 2), dtype=np.int64), np.zeros((n, 2), dtype=np.int64)
    indices, all_vertices = np.full((n, 2, 2), -1, dtype=np.int64), np.full((n, 2, 2), -1, dtype=np.int64)
    all_faces = np.full((n, 2), -1, dtype=np.int64)
    stop = 0
    for count, (first_element, first, second_element, second) in zip(counts, blocks, strict=True):
        rows, stop = slice(stop, stop + count), stop + count
        for side, (element, own) in enumerate(((first_element, first), (second_element, second))):
            elements[rows, side] = element
            if element == FACE:
                all_faces[rows, side] = own
                meshes[rows, side], indices[rows, side, 0] = segment.locate_faces(own)
            elif element == VERTEX:
                all_vertices[rows, side, 0] = own
                meshes[rows, side], indices[rows, side, 0] = segment.locate_vertices(own)
            else:
                all_vertices[rows, side] = own
                meshes[rows, side], indices[rows, side], diagonal = segment.locate_edges(own)
                elements[rows, side][diagonal] = DIAGONAL
    arrays = {"elements": elements, "meshes": meshes, "indices": indices, "vertices": all_vertices, "faces": all_faces}
    return {"kind": np.repeat(np.arange(len(blocks)), counts)} | arrays


def take_rows(arrays: dict[str, np.ndarray], which: np.ndarray) -> dict[str, np.ndarray]:
    """Returns some rows of arrays, given which, bool; the arrays themselves for all rows."""
    return arrays if which.all() else {name: array[which] for name, array in arrays.items()}


def split_rows(arrays: dict[str, np.ndarray], copies: np.ndarray, count: int) -> list[dict[str, np.ndarray]]:
    """Returns the rows of arrays that belong to each of some copies, given the copy of each row, in their order."""
    if count == 1:
        return [arrays]
    order = np.argsort(copies, kind="stable")
    bounds = np.searchsorted(copies[order], np.arange(count + 1)).tolist()
    ordered = {name: array[order] for name, array in arrays.items()}
    return [{name: array[a:b] for name, array in ordered.items()} for a, b in pairwise(bounds)]


def are_stiff(segment: Segment, vertices: np.ndarray, face_meshes: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Returns whether each pair, as of :func:`name_elements`, is of one mesh that only its transform moves, bool."""
    rows, meshes = segment.meshes_at_edges(ends[:, 1])
    of_edges = segment.are_stiff(ends[rows, 0], meshes)
    edges = np.zeros(len(ends), dtype=bool)
    edges[rows[of_edges]] = True
    return np.concatenate([segment.are_stiff(vertices, face_meshes), edges])
