"""The tetrahedra of several meshes, in the spaces of their prims: transforms, mirrored ones too, invert none there."""

from itertools import accumulate
from typing import Any

import numpy as np


class Tetrahedra:
    """The tetrahedra of some meshes, merged to one list, and the positions of their vertices.

    Attributes:
        names: Names of the meshes that have tetrahedra.
        first: Number of the first tetrahedron of each of these, then of all tetrahedra, shape [len(names) + 1].
        corners: Vertices of each tetrahedron, whose volume is positive unless it is inverted, shape [tet_count, 4].
        vertex_count: Number of vertices.
        points: The numbers of the vertices, and the points of the prim that they are, by the names of the meshes.
    """

    def __init__(self, usd_meshes: list[Any], time: float):
        """Reads the tetrahedra of meshes, see :class:`~warp_bsc.usd.read.meshes.UsdMesh`, at a time code.

        Raises:
            UnreadableError: If a mesh is broken.
        """
        self._parts = []
        corners, counts = [np.zeros((0, 4), dtype=np.int64)], []
        self.vertex_count = 0
        self.points: dict[str, tuple[slice, np.ndarray]] = {}
        for mesh in usd_meshes:
            if mesh.has_tetrahedra:
                point_count = len(mesh.read_points(time))
                used, own = np.unique(mesh.read_tetrahedra(time, point_count), return_inverse=True)
                self._parts.append((mesh, point_count, used))
                corners.append(own.reshape(-1, 4) + self.vertex_count)
                counts.append(len(corners[-1]))
                self.points[mesh.name] = slice(self.vertex_count, self.vertex_count + len(used)), used
                self.vertex_count += len(used)
        self.corners = np.concatenate(corners)
        self.first = np.array([*accumulate(counts, initial=0)])
        self.names = [mesh.name for mesh, *_ in self._parts]

    def positions(self, time: float, *, before: bool = False) -> np.ndarray:
        """Returns the positions of the vertices in the spaces of their prims, float64, shape [vertex_count, 3].

        They are those at a time code, or ``before`` it, the moment just before.

        Raises:
            UnreadableError: If a mesh has another number of points than at first, or a coordinate is not finite.
        """
        positions = [np.zeros((0, 3))]
        for mesh, count, used in self._parts:
            points = mesh.read_used_points(time, before=before, used=used, point_count=count, dtype=np.dtype(float))
            mesh.check_finite(points, used, time)
            positions.append(points)
        return np.concatenate(positions)
