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
        self._points: list[np.ndarray] = []
        self._cache = UsdGeom.XformCache()

    def read(self, positions: np.ndarray, time: float, before: bool) -> bool:
        """Writes the positions at a time, or just before it, to the rows of the meshes; returns whether all are finite.

        Raises:
            UnreadableError: If the points of a mesh cannot be read.
        """
        if not self._points:
            self._points = [
                mesh.read_used_points(time, before=before, used=used, point_count=count, dtype=self._dtype)
                for mesh, count, _, used in self._parts
            ]
        at_code: dict[Usd.TimeCode, list[int]] = {}
        for number, (mesh, *_) in enumerate(self._parts):
            at_code.setdefault(mesh.time_code(time, before), []).append(number)
        are_finite = True
        with np.errstate(all="ignore"):
            for code, numbers in at_code.items():
                self._cache.SetTime(code)
                for number in numbers:
                    mesh, _, rows, _ = self._parts[number]
                    transform = mesh.transforms.compute(self._cache)
                    placed = positions[rows]
                    np.matmul(self._points[number], transform[:3, :3], out=placed)
                    placed += transform[3, :3]
            are_finite = all(np.isfinite(positions[rows]).all() for _, _, rows, _ in self._parts)
        return are_finite
