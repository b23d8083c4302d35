"""The polygons of a mesh, checked and triangulated. Imports pxr, which is slow: import this where used.

Errors are ValueErrors; :func:`~.unreadable.reading`, in which all of it is called, names the file and the prim.
"""

import bisect
import hashlib
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from pxr import Usd, Vt

from .samples import sample_times
from .shapes import Polygons
from .triangulation import triangulate

BROKEN = b"", b""
"""The digests of polygons of which a sample is blocked."""


class Topology(NamedTuple):
    """The polygons of a mesh at one time: of a ``UsdGeom.Mesh``, values of the attributes that are named here, int64.

    Attributes:
        counts: ``faceVertexCounts``, number of corners of each polygon, shape [polygon_count].
        indices: ``faceVertexIndices``, the points at the corners of all polygons, shape [sum(counts)].
        holes: ``holeIndices``, the polygons that are holes, shape [n].
        tets: ``tetVertexIndices`` of a ``UsdGeom.TetMesh``, one tetrahedron after the other.
    """

    counts: np.ndarray
    indices: np.ndarray
    holes: np.ndarray
    tets: np.ndarray = np.empty(0, dtype=np.int64)

    def digests(self) -> tuple[bytes, bytes]:
        """Returns a digest of the polygons, which differs where their points differ, and one of the holes."""
        polygons = hashlib.blake2b(len(self.counts).to_bytes(8, "little") + self.counts.tobytes())
        polygons.update(self.indices.tobytes() + self.tets.tobytes())
        return polygons.digest(), hashlib.blake2b(self.holes.tobytes()).digest()

    def triangles(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the polygons without the holes as triangles of the same orientation.

        The points, by which concave polygons are cut, have the shape [point_count, 3]. The triangles' points have the
        shape [triangle_count, 3]; and the polygon that each is a part of, [triangle_count].

        Raises:
            ValueError: If the polygons are broken, or all of them are holes.
        """
        counts, indices, holes, _ = self
        if not len(counts):
            raise ValueError("the mesh has no faces")
        if counts.min() < 3:
            face = int(np.argmin(counts))
            raise ValueError(f"face {face} has {counts[face]} vertices; 3 are the fewest")
        if counts.sum() != indices.size:
            raise ValueError(
                f"faceVertexCounts add up to {counts.sum()}, but there are {indices.size} faceVertexIndices"
            )
        outside = (indices < 0) | (indices >= len(points))
        if outside.any():
            corner = int(np.argmax(outside))
            face = int(np.searchsorted(np.cumsum(counts), corner, side="right"))
            raise ValueError(f"face {face} refers to vertex {indices[corner]}, but the mesh has {len(points)} points")
        triangles, polygons = triangulate(counts, indices, points)
        solid = ~np.isin(polygons, holes)
        if not solid.any():
            raise ValueError("all faces of the mesh are holes")
        return triangles[solid], polygons[solid]

    def tetrahedra(self, point_count: int) -> np.ndarray:
        """Returns the points of the tetrahedra, shape [tet_count, 4].

        Raises:
            ValueError: If there is no such point.
        """
        tets = self.tets.reshape(-1, 4)
        (bad,) = np.nonzero(((tets < 0) | (tets >= point_count)).any(axis=1))
        if len(bad):
            points = ", ".join(map(str, tets[bad[0]].tolist()))
            raise ValueError(f"tetrahedron {bad[0]} has the vertices {points}, but the mesh has {point_count} points")
        return tets


class Topologies:
    """The polygons of a mesh at all times.

    Attributes:
        times: Time codes from which on they may be others, ascending, the first minus infinity.
        codes: The same for OpenUSD.
        digests: Digests of the polygons at each time, None where there are none. A mesh may be empty for some time,
            such as a fluid before it flows. Where a sample is blocked it is not empty, but broken.
    """

    def __init__(self, polygons: Polygons, times: set[float], *, has_numbers: bool):
        """Reads the polygons.

        Args:
            polygons: Their attributes.
            times: Time codes at which the mesh changes for other reasons.
            has_numbers: Whether the polygons tell which points stay the same from one sample to the next.

        Raises:
            ValueError: If an attribute is not a list of integers.
        """
        self._polygons = polygons
        self.times = (-math.inf, *sorted(times | sample_times(*polygons.topology_attributes)))
        self.codes = (Usd.TimeCode.EarliestTime(), *map(Usd.TimeCode, self.times[1:]))
        self.digests: list[tuple[bytes, bytes] | None] = []
        is_empty, last = True, []
        for code in self.codes:
            values = polygons.read_topology(code)
            if not last or any(old is not new and old != new for old, new in zip(last, values, strict=True)):
                topology = as_topology(values)
                has_elements = len(topology.counts) > 0
                without = BROKEN if values[0] is None else None
                self.digests.append(topology.digests() if has_elements else without)
                is_empty &= not has_elements
            else:
                self.digests.append(self.digests[-1])  # reading the digests of equal values would take longer
            last = values
        if is_empty:
            self.digests = [None] * len(self.digests)
        # Points that are renumbered do not move to those of their number.
        are_renumbered = len({own for own, _ in filter(None, self.digests)}) > 1
        self._numbered_times = sorted(sample_times(*polygons.point_attributes)) * (are_renumbered and has_numbers)

    def read(self, time: Usd.TimeCode) -> Topology:
        """Returns the polygons at a time, with errors as of :func:`as_topology`."""
        return as_topology(self._polygons.read_topology(time))

    def held(self, code: Usd.TimeCode) -> Usd.TimeCode:
        """Returns the time code of the last sample of the points where the next one is of other polygons, else a code.

        USD holds points until the next sample if that has another number of points, and interpolates them if it has as
        many. Neither value is a motion if the points have other numbers.
        """
        times, time = self._numbered_times, code.GetValue()
        search = bisect.bisect_left if code.IsPreTime() else bisect.bisect_right
        following = search(times, time)
        if 0 < following < len(times):
            now = self.digests[max(0, search(self.times, time) - 1)]
            then = self.digests[bisect.bisect_right(self.times, times[following]) - 1]
            if now and then and now[0] != then[0]:
                return Usd.TimeCode(times[following - 1])
        return code


def as_topology(values: Sequence[Any]) -> Topology:
    """Returns the polygons of a mesh, given what :class:`~warp_bsc.usd.read.shapes.Polygons` read at a time.

    Missing attributes are read as empty ones.

    Raises:
        ValueError: If an attribute is not a list of integers.
    """

    def as_integers(name, value) -> np.ndarray:
        array = np.array(Vt.IntArray() if value is None else value)
        if array.ndim != 1 or array.dtype.kind not in "iu":
            raise ValueError(f"{name} is not a list of integers")
        return array.astype(np.int64)

    names = "faceVertexCounts", "faceVertexIndices", "holeIndices", "tetVertexIndices"
    return Topology(*map(as_integers, names, values))


def is_empty(value: Any) -> bool:
    """Returns whether a value that should be a list is missing or empty."""
    return value is None or (hasattr(value, "__len__") and len(value) == 0)
