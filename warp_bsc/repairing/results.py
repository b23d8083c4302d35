"""What a repair returns: positions, what it moved, and the contours that it could not free, and why."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from .contours import ContourKind, trace_contours
from .motion import Faults
from .surface import Surface

_FIXED = "both of its sides are fixed"
_RIGID = "both of its sides are of one rigid group"
_BORDER = "it runs from border to border, so that both sides may be the right one: order or x_previous would tell"
_LATE = "the time limit ended the search for positions without it"
_NOT_FOUND = "no positions without it were found: order or x_previous may tell where its sides belong"


@dataclass(frozen=True, eq=False)
class UnresolvedContour:
    """A contour along which the returned positions still cross.

    Attributes:
        elements: (edge, face) along the contour, edges as in ``CollisionMesh.edges``, sorted, int32, shape [n, 2].
        kind: "closed"; "border" if it ends at borders of the surface alone; "open" if it ends at a vertex that both
            sides share, or where elements touch.
        reason: Why it was not freed.
    """

    elements: np.ndarray
    kind: ContourKind
    reason: str


@dataclass(frozen=True, eq=False)
class RepairResult:
    """The result of :func:`warp_bsc.repair`. Numbers of crossings count doubled vertices of borders as one.

    Attributes:
        x: Positions, as given: float32 or float64, NumPy or Warp. What has not moved has the bits of the input.
        certified: Whether no edge meets a face at these positions, decided exactly in their type, and each pair with a
            moved vertex keeps the minimum distance and its radii, or the distance of the input if that was less.
            Elements that share a vertex, or a doubled one, are excluded: they may touch.
        crossings_before: Number of edges that meet a face in the input, each counted once a face.
        crossings: Number of those in ``x``, never more.
        near_before: Number of pairs of elements that are at most the minimum distance and their radii apart in the
            input, 0 without them. Neighbours do not count, see :class:`warp_bsc.CollisionDetector`.
        near: Number of those in ``x``.
        moved: Distance of each vertex from its input, in the unit of the positions, float64, shape [vertex_count].
        max_strain: Largest change of the length of an edge, as a share of its length in the input.
        doubled: Number of vertices that count as one with another, at seams.
        unresolved: The contours that remain.
        order: Sheets that had changed places and were put into an order that nobody told, as the argument ``order``
            has them: the number of each vertex from inside to outside, -1 for none, int, shape [vertex_count]; pass
            another one to choose. None if there was nothing to choose.
    """

    x: np.ndarray | wp.array
    certified: bool
    crossings_before: int
    crossings: int
    near_before: int
    near: int
    moved: np.ndarray
    max_strain: float
    doubled: int
    unresolved: tuple[UnresolvedContour, ...]
    order: np.ndarray | None

    def __str__(self) -> str:
        """Returns a line that says whether nothing crosses, and what that does not count."""
        line = f"{self.crossings_before:,} crossings before, {self.crossings:,} after"
        line += ", certified" if self.certified else ", not certified"
        if self.doubled:
            line += (
                f"; {self.doubled:,} vertices of seams count as one with another: find_intersections of the faces as "
                "given lists pairs that touch there"
            )
        return line


def describe(surface: Surface, before: Faults, after: Faults, chosen: np.ndarray, count: int) -> dict[str, Any]:
    """Returns what every result of a repair tells, by the names of :class:`.RepairResult`, but for the positions.

    Args:
        surface: The surface.
        before: What is wrong with its input.
        after: What is wrong with the result.
        chosen: Sheet of each vertex whose order was chosen, -1 for none, int, shape [n].
        count: Number of the first vertices that the result is about.
    """
    chosen = chosen[surface.weld][:count]
    is_chosen = len(np.unique(chosen[chosen >= 0])) > 1
    return {
        "certified": not after.count and bool(np.isin(after.near, before.near).all()),
        "crossings_before": len(before.crossings),
        "crossings": len(after.crossings),
        "near_before": len(before.near),
        "near": len(after.near),
        "moved": (surface.moves(after.x)[surface.weld] * surface.unit)[:count],
        "max_strain": surface.strain(after.x),
        "doubled": int((surface.weld != np.arange(len(surface.weld))).sum()),
        "unresolved": _unresolved_contours(surface, after.crossings),
        "order": chosen if is_chosen else None,
    }


def _unresolved_contours(surface: Surface, crossings: np.ndarray) -> tuple[UnresolvedContour, ...]:
    """Returns the contours of crossings, (edge, face) of the surface, with the edges of the mesh as it was given."""
    if not len(crossings):
        return ()
    contours, late = trace_contours(surface.mesh, crossings), surface.is_late
    fixed, key = surface.are_fixed(crossings), np.array([len(surface.weld), 1])
    keys = np.sort(surface.weld[surface.given.edges], axis=1).astype(np.int64) @ key
    unique, first = np.unique(keys, return_index=True)  # an edge of the given mesh for each one of the welded mesh
    welded_keys = surface.mesh.edges[crossings[:, 0]].astype(np.int64) @ key
    elements = np.column_stack([first[np.searchsorted(unique, welded_keys)], crossings[:, 1]]).astype(np.int32)
    found = []
    for number, kind in enumerate(contours.kinds):
        rows = contours.number == number
        reason = _LATE if late else _BORDER if kind == "border" else _NOT_FOUND
        if fixed[rows].all():
            reason = _FIXED if surface.fixed[surface.mesh.edges[crossings[rows, 0]]].any() else _RIGID
        found.append(UnresolvedContour(elements[rows][np.lexsort(elements[rows].T[::-1])], kind, reason))
    return tuple(found)
