"""What a repair returns: positions, what it moved, and the contours that it could not free."""

from dataclasses import dataclass

import numpy as np
import warp as wp

from .contours import ContourKind


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
            moved vertex keeps the minimum distance, or the distance of the input if that was less. Elements that share
            a vertex, or a doubled one, are excluded: they may touch.
        crossings_before: Number of edges that meet a face in the input, each counted once a face.
        crossings: Number of those in ``x``, never more.
        near_before: Number of pairs of elements that are at most the minimum distance apart in the input, 0 without
            one. Neighbours do not count, see :class:`warp_bsc.CollisionDetector`.
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
