"""Reads the positions of vertices of several meshes at a time."""

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from .meshes import UsdMesh  # which imports pxr


class PositionReader:
    """Reads positions of some vertices of meshes, those of instances of one prim and of rigid meshes together."""

    def __init__(self, parts: "list[tuple[UsdMesh, int, slice, np.ndarray]]", dtype: np.dtype):
        """Makes a reader.

        Args:
            parts: For each mesh the mesh, the number of its points, the rows of its vertices in the result, and the
                indices of these among its points.
            dtype: Type of the positions.
        """
        self._dtype = dtype
        self._rigid_parts = [part for part in parts if part[0].is_rigid]
        self._rigid = None
        if self._rigid_parts:
            from .rigid_meshes import RigidMeshes  # noqa: PLC0415 (imports pxr)

            self._rigid = RigidMeshes(self._rigid_parts, dtype)
        parts = [part for part in parts if not part[0].is_rigid]
        instanced: dict[tuple, list] = {}
        self._single = []
        for part in parts:
            (instanced.setdefault(part[0].instanced_prim, []) if part[0].instanced_prim else self._single).append(part)
        self._instanced = []
        for members in instanced.values():
            instances = np.array([mesh.index for mesh, *_ in members])
            rows = np.concatenate([np.arange(rows.start, rows.stop) for _, _, rows, _ in members])
            taken = np.concatenate([number * count + points for number, (_, count, _, points) in enumerate(members)])
            self._instanced.append((members, instances, rows, taken))

    def read(self, positions: np.ndarray, time: float, before: bool) -> None:
        """Writes the positions at a time, or just before it, to the rows of the meshes.

        Raises:
            UnreadableError: If a mesh is broken at that time.
        """
        singles = list(self._single)
        for members, instances, rows, taken in self._instanced:
            first, count, *_ = members[0]
            together = first.read_instances(time, instances, count, before=before)
            found = None if together is None else together.reshape(-1, 3)[taken]
            if found is not None and np.isfinite(found).all():
                positions[rows] = found
            else:
                singles += members  # one of them is broken; reading it raises the error
        if self._rigid and not self._rigid.read(positions, time, before):
            singles += self._rigid_parts
        for mesh, count, rows, points in singles:
            positions[rows] = mesh.read_positions(
                time, before=before, used=points, point_count=count, dtype=self._dtype
            )
