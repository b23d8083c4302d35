"""The collision mesh: the part of a triangle mesh that takes part in collision detection."""

import functools
from numbers import Integral

import numpy as np
import warp as wp

from .._arrays import checked_shape
from .face_order import order_faces
from .settings import PairKind

__all__ = ["CollisionMesh"]


class CollisionMesh:
    """The faces, edges and vertices of a triangle mesh whose positions change and whose faces do not.

    Vertices that no face uses (the inner particles of a soft body, say) take no part. Several bodies make one mesh:
    their faces index one array of positions.

    Attributes:
        faces: Vertex indices of the faces, int32, shape [face_count, 3].
        edges: Vertex indices of the edges, smaller first, sorted, int32, shape [edge_count, 2].
        face_edges: Edges of the faces, edge i from corner i to the next, -1 where both are one vertex, int32, shape
            [face_count, 3].
        owned: What each face is the representative of, see :mod:`warp_bsc.kernels.pipeline.pairs`, int32, shape
            [face_count].
        vertices: Indices of the vertices that faces use, sorted, int32, shape [used_vertex_count].
        vertex_count: Number of positions.
        world: World of each vertex, int32, shape [vertex_count], or None if all are in one.
        device: Warp device of the arrays that the detector uses.
    """

    def __init__(
        self,
        faces: np.ndarray | wp.array,
        vertex_count: int,
        *,
        world: np.ndarray | wp.array | None = None,
        device: wp.DeviceLike = None,
    ):
        """Finds the edges and puts the mesh on a device.

        Args:
            faces: Vertex indices, integers, shape [face_count, 3] with less than 2^28 faces, NumPy or Warp array.
            vertex_count: Number of positions.
            world: The world of each vertex, integers in [0, 2^31), shape [vertex_count], NumPy or Warp array:
                vertices in different worlds do not collide. Default: all are in one.
            device: Warp device; default: Warp's default.

        Raises:
            ValueError: If the faces have another shape or type, an index is not in [0, vertex_count), that is no
                integer in [0, 2^31), or the worlds have another shape or type, are out of range, or differ within a
                face.
        """
        faces = np.asarray(faces.numpy() if isinstance(faces, wp.array) else faces)
        if faces.shape == (0,):
            faces = np.empty((0, 3), np.int32)
        if faces.ndim != 2 or faces.shape[1] != 3:
            raise ValueError(f"faces must have shape (n, 3), not {faces.shape}")
        if len(faces) >= 2**28:  # queues have room for eight pairs a face from the start, and are indexed by int32
            raise ValueError(f"a mesh must have less than 2^28 faces, not {len(faces)}")
        if not np.issubdtype(faces.dtype, np.integer):
            raise ValueError(f"faces must be integers, not {faces.dtype}")
        if not isinstance(vertex_count, Integral) or not 0 <= vertex_count < 2**31:
            raise ValueError(f"vertex_count must be an integer in [0, 2^31), not {vertex_count!r}")
        bad = np.flatnonzero(((faces < 0) | (faces >= vertex_count)).any(axis=1))
        if len(bad):
            raise ValueError(
                f"face {bad[0]} is {faces[bad[0]].tolist()}, but the mesh has {vertex_count} vertices"
                + (f" ({len(bad)} such faces)" if len(bad) > 1 else "")
            )
        self.faces = np.ascontiguousarray(faces, dtype=np.int32)
        sides = np.sort(self.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        edges, first_sides, edge_of_side = np.unique(sides, axis=0, return_index=True, return_inverse=True)
        # a face that names a vertex twice has an edge without length: its point belongs to the other edge
        proper = edges[:, 0] != edges[:, 1]
        self.edges = edges[proper]
        face_edges = np.where(proper, np.cumsum(proper) - 1, -1)[edge_of_side].reshape(-1, 3)
        self.vertices, first_corners = np.unique(self.faces, return_index=True)
        # the representative of an element is the first face that has it: bits 0 to 2 corners, 3 to 5 edges
        owned = np.zeros(len(self.faces), dtype=np.int32)
        np.bitwise_or.at(owned, first_corners // 3, 1 << (first_corners % 3))
        first_sides = first_sides[proper]
        np.bitwise_or.at(owned, first_sides // 3, 8 << (first_sides % 3))
        self.face_edges, self.owned = face_edges.astype(np.int32), owned
        self.vertex_count = int(vertex_count)
        self.device = wp.get_device(device)
        self.device_vertices = wp.array(self.vertices, dtype=int, device=self.device)
        self.device_faces = wp.array(self.faces, dtype=int, device=self.device)
        self.device_edges = wp.array(self.edges, dtype=int, device=self.device)
        self.world = None
        if world is not None:
            self.world = self._checked_world(world)

    @functools.cached_property
    def face_order(self) -> np.ndarray:
        """Face at each place of the broad phase's hierarchy, int32, see :func:`.face_order.order_faces`."""
        return order_faces(self.faces, None if self.world is None else self.world[self.faces[:, 0]])

    def device_elements(self, kind: PairKind) -> wp.array:
        """Returns the vertex indices of the second elements of a kind of pair, two-dimensional Warp array of int."""
        return self.device_faces if kind == PairKind.VERTEX_FACE else self.device_edges

    def device_positions(self, x: np.ndarray | wp.array, name: str) -> wp.array:
        """Returns positions on the device as an array of vec3 or vec3d, unchanged or a copy; finite or not.

        Args:
            x: Positions, shape [vertex_count, 3], float32 or float64, NumPy or Warp array.
            name: What to call them in errors.

        Raises:
            ValueError: If they have another shape or type; or if a graph is captured or they require gradients, and
                they are no Warp array of vec3 or vec3d on the device.
        """
        if isinstance(x, wp.array) and x.device == self.device and x.dtype in (wp.vec3, wp.vec3d):
            if x.shape != (self.vertex_count,):
                raise ValueError(f"{name} must have {self.vertex_count} rows, one a vertex, got {x.shape}")
            return x
        capturing = self.device.is_capturing
        if capturing or (isinstance(x, wp.array) and x.requires_grad):
            when = "in a graph" if capturing else "to have gradients"
            raise ValueError(f"{when} {name} must be a Warp array of vec3 or vec3d on {self.device}")
        values = checked_shape(x.numpy() if isinstance(x, wp.array) else x, (3,), name)
        if len(values) != self.vertex_count:
            raise ValueError(f"{name} must have {self.vertex_count} rows, one a vertex, got {len(values)}")
        dtype = wp.vec3 if values.dtype == np.float32 else wp.vec3d
        return wp.array(np.ascontiguousarray(values), dtype=dtype, device=self.device)

    def _checked_world(self, world: np.ndarray | wp.array) -> np.ndarray:
        """The world of each vertex, int32, shape [vertex_count], the same for the vertices of a face."""
        world = np.asarray(world.numpy() if isinstance(world, wp.array) else world)
        if world.shape != (self.vertex_count,) or not np.issubdtype(world.dtype, np.integer):
            raise ValueError(
                f"world must be {self.vertex_count} integers, one a vertex, got {world.dtype} {world.shape}"
            )
        bad = (world < 0) | (world >= 2**31)
        if bad.any():
            raise ValueError(f"vertex {np.argmax(bad)} is in world {world[np.argmax(bad)]}; worlds are in [0, 2^31)")
        worlds = world[self.faces]
        mixed = np.flatnonzero((worlds != worlds[:, :1]).any(axis=1))
        if len(mixed):
            raise ValueError(f"face {mixed[0]} has vertices in worlds {worlds[mixed[0]].tolist()}")
        return world.astype(np.int32)
