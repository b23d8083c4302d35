"""Meshes that are there twice or more: which are duplicates of each other, and what is inside all of them."""

import hashlib
from collections import defaultdict
from collections.abc import Callable, Hashable, Iterable

import numpy as np

from .._sorted_keys import distinct, expand_ranges
from ..detection.at_rest.containment import Containment
from ..usd.segment import Segment
from ..usd.selection import Selection


class Duplicates:
    """The duplicates among the meshes of a segment.

    Two meshes are duplicates if they have the same polygons, each with the same corners, at all times of the segment.
    Corners are the same where they are welded: their positions have the same bits. The order of polygons and of corners
    does not matter, nor to which side the polygons face, nor points that no polygon uses. All elements that lie on each
    other share their vertices, so that duplicates neither touch nor cross each other.

    Twins, which have the same triangles as well, are inside the same meshes, and contain the same: one is searched for
    all.
    """

    def __init__(self, segment: Segment):
        """Compares the meshes."""
        self._segment = segment
        starts = np.array([mesh.faces.start for mesh in segment.meshes], dtype=np.int64)
        counts = np.array([len(mesh.polygons) for mesh in segment.meshes], dtype=np.int64)
        (used,) = np.nonzero(counts)
        self._duplicates: list[list[int]] = []
        self._twin = np.arange(len(counts))  # the first of the twins of each mesh
        if len(used) < 2:
            return
        a, b, c = segment.faces.T
        low, high = (bound.reduceat(bound(bound(a, b), c), starts[used]) for bound in (np.minimum, np.maximum))
        alike = _alike(used.tolist(), zip(counts[used].tolist(), low.tolist(), high.tolist(), strict=True))
        for candidates in alike:
            meshes = [segment.meshes[number] for number in candidates]
            surfaces = (_surface(segment.faces[mesh.faces], mesh.polygons) for mesh in meshes)
            for same in _alike(candidates, surfaces):
                self._duplicates.append(same)
                triangles = (segment.faces[segment.meshes[number].faces] for number in same)
                for twins in _alike(same, (_surface(faces, np.arange(len(faces))) for faces in triangles)):
                    self._twin[twins] = twins[0]
        self._duplicates.sort()

    def named(self, selection: Selection) -> tuple[tuple[str, ...], ...]:
        """Returns the names of duplicates, without meshes of which all pairs are excluded or ignored."""
        meshes, found = self._segment.meshes, []
        for same in self._duplicates:
            numbers = np.array(same)
            if selection.chooses_pairs:
                pairs = numbers[np.stack(np.triu_indices(len(same), 1), axis=1)]
                counted = selection.counted_pairs(meshes, pairs) & ~selection.ignored_pairs(meshes, pairs)
                numbers = np.unique(pairs[counted])
            if len(numbers):
                found.append(tuple(meshes[number].name for number in numbers))
        return tuple(found)

    def without_twins(self, bodies: np.ndarray) -> np.ndarray:
        """Returns bodies of faces, then of other elements, with -1 for the faces of twins, but the first of each."""
        faces = self._segment.face_meshes
        is_twin = np.zeros(len(bodies), dtype=bool)
        is_twin[: len(faces)] = self._twin[faces] != faces
        return np.where(is_twin, -1, bodies)

    def may_be_checked(self, are_checked: Callable[[np.ndarray], np.ndarray]) -> Callable[[np.ndarray], np.ndarray]:
        """Returns which pairs of meshes are looked for, as :meth:`with_twins` decides of those that have twins."""
        has_twins = np.bincount(self._twin, minlength=len(self._twin)) > 1
        return lambda pairs: has_twins[pairs].any(axis=1) | are_checked(pairs)

    def with_twins(self, inside: Containment, are_checked: Callable[[np.ndarray], np.ndarray]) -> Containment:
        """Returns what is inside what, given what the first of all twins are, for all twins that are checked."""
        order = np.argsort(self._twin, kind="stable")
        sides = inside.bodies.T, inside.bodies.T + 1
        first, last = (np.searchsorted(self._twin[order], side) for side in sides)
        rows, inner = expand_ranges(first[0], last[0])
        again, outer = expand_ranges(first[1][rows], last[1][rows])
        rows, bodies = rows[again], order[np.stack([inner[again], outer], axis=1)]
        checked = are_checked(bodies)
        rows, bodies = rows[checked], bodies[checked]
        faces = inside.faces[rows]
        for number in np.unique(bodies[bodies[:, 1] != inside.bodies[rows, 1], 1]).tolist():
            mine, of_first = bodies[:, 1] == number, self._ordered_faces(int(self._twin[number]))
            faces[mine] = self._ordered_faces(number)[np.argsort(of_first)[faces[mine] - of_first.min()]]
        order = np.lexsort((inside.vertices[rows], bodies[:, 1], bodies[:, 0]))
        return Containment(bodies[order], inside.vertices[rows[order]], faces[order])

    def _ordered_faces(self, number: int) -> np.ndarray:
        """Returns the faces of a mesh in an order that its twins have as well."""
        faces = self._segment.meshes[number].faces
        return faces.start + np.lexsort(np.sort(self._segment.faces[faces], axis=1).T)


def _alike(items: list[int], keys: Iterable[Hashable]) -> list[list[int]]:
    """Returns the items of which some have the same key, by it."""
    found = defaultdict(list)
    for item, key in zip(items, keys, strict=True):
        found[key].append(item)
    return [same for same in found.values() if len(same) > 1]


def _surface(faces: np.ndarray, polygons: np.ndarray) -> bytes:
    """Returns a hash of the corners of polygons, regardless of their orders.

    Args:
        faces: Vertices of the triangles, shape [n, 3].
        polygons: Polygon of each triangle, ascending, shape [n].
    """
    keys = distinct(polygons[:, None].astype(np.int64) << 32 | faces)
    corners = (keys & 0xFFFFFFFF).astype(np.uint64)
    (starts,) = np.nonzero(np.diff(keys >> 32, prepend=-1))
    mixed = corners * np.uint64(0x9E3779B97F4A7C15)
    mixed = (mixed ^ mixed >> np.uint64(29)) * np.uint64(0xBF58476D1CE4E5B9)
    # polygons that this sum does not tell apart have the same corners, but for one in 2^64, which come in any order
    order = np.argsort(np.add.reduceat(mixed, starts), kind="stable")
    ends = np.append(starts[1:], len(keys))
    rows, places = expand_ranges(starts[order], ends[order])
    return hashlib.blake2b(np.stack([rows.astype(np.uint64), corners[places]]).tobytes()).digest()
