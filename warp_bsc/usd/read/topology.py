"""The polygons of a mesh at one time, checked and triangulated. Imports pxr, which is slow: import this where used."""

# pyright: reportAttributeAccessIssue=false
# (OpenUSD's stubs leave out the classes of its modules.)

import hashlib
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from pxr import Vt

from .triangulation import triangulate
from .unreadable import UnreadableError

__all__ = ["BROKEN", "Topology", "as_topology", "is_empty"]

BROKEN = b"", b""
"""The digests of polygons of which a sample is blocked."""


class Topology(NamedTuple):
    """The polygons of a mesh: of a ``UsdGeom.Mesh``, the values of the attributes that are named here, int64.

    Attributes:
        counts: ``faceVertexCounts``, number of corners of each polygon, shape [polygon_count].
        indices: ``faceVertexIndices``, the points at the corners of all polygons, shape [sum(counts)].
        holes: ``holeIndices``, the polygons that are holes, shape [n].
    """

    counts: np.ndarray
    indices: np.ndarray
    holes: np.ndarray

    def digests(self) -> tuple[bytes, bytes]:
        """Returns a digest of the polygons, which differs where their points differ, and one of the holes."""
        polygons = hashlib.blake2b(len(self.counts).to_bytes(8, "little") + self.counts.tobytes())
        polygons.update(self.indices.tobytes())
        return polygons.digest(), hashlib.blake2b(self.holes.tobytes()).digest()

    def triangles(self, points: np.ndarray, where: str) -> tuple[np.ndarray, np.ndarray]:
        """Returns the polygons without the holes as triangles of the same orientation.

        Args:
            points: Points by which concave polygons are cut, shape [point_count, 3].
            where: File and prim, for messages.

        Returns:
            The triangles' points, shape [triangle_count, 3], and the polygon that each is a part of, shape
            [triangle_count].

        Raises:
            UnreadableError: If the polygons are broken, or all of them are holes.
        """
        counts, indices, holes = self
        if not len(counts):
            raise UnreadableError(f"{where}: the mesh has no faces")
        if counts.min() < 3:
            face = int(np.argmin(counts))
            raise UnreadableError(f"{where}: face {face} has {counts[face]} vertices; 3 are the fewest")
        if counts.sum() != indices.size:
            raise UnreadableError(
                f"{where}: faceVertexCounts add up to {counts.sum()}, but there are {indices.size} faceVertexIndices"
            )
        outside = (indices < 0) | (indices >= len(points))
        if outside.any():
            corner = int(np.argmax(outside))
            face = int(np.searchsorted(np.cumsum(counts), corner, side="right"))
            raise UnreadableError(
                f"{where}: face {face} refers to vertex {indices[corner]}, but the mesh has {len(points)} points"
            )
        triangles, polygons = triangulate(counts, indices, points)
        solid = ~np.isin(polygons, holes)
        if not solid.any():
            raise UnreadableError(f"{where}: all faces of the mesh are holes")
        return triangles[solid], polygons[solid]


def as_topology(values: Sequence[Any], where: str) -> Topology:
    """Returns the polygons of a mesh; missing attributes are read as empty ones.

    Args:
        values: What :class:`~warp_bsc.usd.read.shapes.Polygons` read at a time.
        where: File and prim, for messages.

    Raises:
        UnreadableError: If an attribute is not a list of integers.
    """

    def as_integers(name, value) -> np.ndarray:
        array = np.array(Vt.IntArray() if value is None else value)
        if array.ndim != 1 or array.dtype.kind not in "iu":
            raise UnreadableError(f"{where}: {name} is not a list of integers")
        return array.astype(np.int64)

    names = "faceVertexCounts", "faceVertexIndices", "holeIndices"
    return Topology(*map(as_integers, names, values))


def is_empty(value: Any) -> bool:
    """Returns whether a value that should be a list is missing or empty."""
    return value is None or (hasattr(value, "__len__") and len(value) == 0)
