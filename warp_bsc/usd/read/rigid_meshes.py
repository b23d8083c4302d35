"""Reads meshes that only their transforms move: their points once. Imports pxr: import this where used."""

import numpy as np
from pxr import Usd, UsdGeom

from .meshes import UsdMesh


class RigidMeshes:
    """Reads positions of some points of rigid meshes. Transforms of prims above several meshes are computed once."""

    def __init__(self, parts: list[tuple[UsdMesh, int, slice, np.ndarray]], dtype: np.dtype):
        """Makes a reader; arguments are those of :class:`~warp_bsc.usd.read.position_reader.PositionReader`."""
        self._parts = parts
        self._dtype = dtype
        self._groups: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        """Of parts with the same number of points: their numbers, their rows, and their points."""
        self._cache = UsdGeom.XformCache()

    def read(self, positions: np.ndarray, time: float, before: bool) -> bool:
        """Writes the positions at a time, or just before it, to the rows of the meshes; returns whether all are finite.

        Raises:
            UnreadableError: If the points of a mesh cannot be read.
        """
        self._groups = self._groups or self._read_points(time, before)
        at_code: dict[Usd.TimeCode, list[int]] = {}
        for number, (mesh, *_) in enumerate(self._parts):
            at_code.setdefault(mesh.time_code(time, before), []).append(number)
        transforms = np.empty((len(self._parts), 4, 4))
        for code, numbers in at_code.items():
            self._cache.SetTime(code)
            for number in numbers:
                transforms[number] = self._parts[number][0].transforms.compute(self._cache)
        are_finite = True
        with np.errstate(all="ignore"):
            for numbers, rows, points in self._groups:
                placed = (points @ transforms[numbers, :3, :3]).astype(self._dtype, copy=False)
                placed += transforms[numbers, 3:, :3]
                positions[rows] = placed
                are_finite &= bool(np.isfinite(placed).all())
        return are_finite

    def _read_points(self, time: float, before: bool) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Returns the parts with their points, by their number of points; arguments and errors as of :meth:`read`."""
        by_count: dict[int, list[tuple[int, np.ndarray, np.ndarray]]] = {}
        for number, (mesh, count, rows, used) in enumerate(self._parts):
            points = mesh.read_used_points(time, before=before, used=used, point_count=count, dtype=self._dtype)
            by_count.setdefault(len(used), []).append((number, np.arange(rows.start, rows.stop), points))
        groups = []
        for members in by_count.values():
            numbers, rows, points = zip(*members, strict=True)
            groups.append((np.array(numbers), np.array(rows), np.array(points)))
        return groups
