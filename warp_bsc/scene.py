"""The meshes of a USD scene as one motion: fixed faces, and positions in world space at any time.

What is read
------------
Every ``UsdGeom.Mesh`` that is loaded and visible at some time, of any purpose, natively instanced ones included, merged
to one list of vertices and one of faces: collisions of a mesh with itself and with others are then found alike. A mesh
with a subdivision scheme is read as its control cage. Polygons become triangles at the first time, and stay cut that
way; holes and points that no face refers to are left out.

Vertices that are in one place at every time are welded to one. Such are the two sides of a seam, or of a cloth that was
written as one mesh for each of its colours: they belong together, and not welded would touch for ever.

What moves
----------
The points and the transforms of a mesh may both have time samples. A scene's times are those of all meshes together; at
a time that is not a mesh's own sample, USD interpolates. From one time to the next each vertex is taken to move
straight.

Precision
---------
USD stores points in single precision, transforms in double. Where every transform is the identity, positions are those
stored, in single precision; otherwise all are computed and returned in double precision.

What the file has but this module does not read (point instancers, spheres and other shapes that are not meshes,
skeletal animation) is named in :attr:`Scene.warnings`.
"""

from dataclasses import dataclass

import numpy as np

__all__ = ["Scene", "SceneMesh"]


@dataclass(frozen=True)
class SceneMesh:
    """A mesh prim's part of the scene.

    Attributes:
        path: The prim's path.
        moves: Whether its points or its transform change with time.
        vertices: Its vertices, among those of all meshes before they were welded.
        faces: Its faces, among those of all meshes.
        points: The prim's point that each vertex is, shape [len(vertices)].
        point_count: Number of the prim's points.
        polygons: The prim's polygon that each face is a part of, shape [len(faces)].
    """

    path: str
    moves: bool
    vertices: slice
    faces: slice
    points: np.ndarray
    point_count: int
    polygons: np.ndarray


class Scene:
    """The meshes of a USD file. Holds its structure and one set of positions, and reads others when asked for.

    Args:
        path: A ``.usd``, ``.usda``, ``.usdc`` or ``.usdz`` file.

    Attributes:
        path: The file.
        meshes: The meshes, in the order of their vertices.
        faces: Vertices of each face, shape [face_count, 3], int32.
        vertex_count: Number of vertices of all meshes, welded.
        times: Time codes at which a mesh has a sample, ascending, at least two.
        time_codes_per_second: How many time codes make a second.
        dtype: Of the positions, float32 or float64.
        warnings: What is passed over or changed, a sentence each.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the file is not USD, refers to something that cannot be opened, has no mesh or none that moves,
            or has a mesh that is broken or changes its topology. The message names the file, the prim and the time.
    """

    def __init__(self, path):
        from . import usd_meshes  # noqa: PLC0415 (imports pxr)

        self.path = str(path)
        self._stage = usd_meshes.open_stage(path)  # prims expire with their stage
        self._usd_meshes, self.warnings = usd_meshes.find_meshes(self._stage, path)
        if not self._usd_meshes:
            raise ValueError(f"{path}: no visible mesh in the scene")
        self.time_codes_per_second = self._stage.GetTimeCodesPerSecond()
        self.times = sorted(set().union(*(mesh.times for mesh in self._usd_meshes)))
        if len(self.times) < 2:
            raise ValueError(f"{path}: nothing moves: no mesh has points or a transform that change with time")
        self.dtype = np.dtype(np.float32 if all(mesh.is_placed for mesh in self._usd_meshes) else np.float64)

        self.meshes, faces = [], []
        vertex_count = face_count = 0
        for mesh in self._usd_meshes:
            points = mesh.read_points(self.times[0])
            triangles, polygons = mesh.read_triangles(points)
            used, corners = np.unique(triangles, return_inverse=True)
            faces.append(corners.reshape(-1, 3) + vertex_count)
            self.meshes.append(
                SceneMesh(
                    path=mesh.path,
                    moves=bool(mesh.times),
                    vertices=slice(vertex_count, vertex_count + len(used)),
                    faces=slice(face_count, face_count + len(triangles)),
                    points=used,
                    point_count=len(points),
                    polygons=polygons,
                )
            )
            vertex_count += len(used)
            face_count += len(triangles)
        self._vertex_ends = np.array([mesh.vertices.stop for mesh in self.meshes])
        self._face_ends = np.array([mesh.faces.stop for mesh in self.meshes])

        self._start = np.concatenate(
            [self._read_positions(number, self.times[0]) for number in range(len(self.meshes))]
        )
        welded_to = self._find_welds()
        self._kept, corners = np.unique(welded_to[np.concatenate(faces)], return_inverse=True)
        self.faces = corners.reshape(-1, 3).astype(np.int32)
        self.vertex_count = len(self._kept)
        if self.vertex_count < vertex_count:
            self.warnings.append(f"vertices in one place at all times were welded: {vertex_count - self.vertex_count}")

    def positions(self, time: float) -> np.ndarray:
        """Positions of all vertices in world space.

        Args:
            time: Time code.

        Returns:
            Positions in the scene's unit of length, shape [vertex_count, 3], of type :attr:`dtype`.

        Raises:
            ValueError: If a mesh has another number of points than at first, or a coordinate is not finite.
        """
        return self._unwelded_positions(time)[self._kept]

    def meshes_of_vertices(self, vertices) -> np.ndarray:
        """Indices into :attr:`meshes` of the mesh, or of the first of those welded there, that each vertex is of."""
        return np.searchsorted(self._vertex_ends, self._kept[vertices], side="right")

    def meshes_of_faces(self, faces) -> np.ndarray:
        """Indices into :attr:`meshes` of the mesh that each face is of."""
        return np.searchsorted(self._face_ends, faces, side="right")

    def locate_vertex(self, vertex: int) -> tuple[str, int]:
        """The path of the prim that a vertex is of, and its index among the prim's points."""
        mesh = self.meshes[self.meshes_of_vertices(vertex)]
        return mesh.path, int(mesh.points[self._kept[vertex] - mesh.vertices.start])

    def locate_face(self, face: int) -> tuple[str, int]:
        """The path of the prim that a face is of, and the index there of the polygon that it is a part of."""
        mesh = self.meshes[self.meshes_of_faces(face)]
        return mesh.path, int(mesh.polygons[face - mesh.faces.start])

    def _unwelded_positions(self, time) -> np.ndarray:
        positions = self._start.copy()
        for number, mesh in enumerate(self.meshes):
            if mesh.moves:
                positions[mesh.vertices] = self._read_positions(number, time)
        return positions

    def _read_positions(self, number, time) -> np.ndarray:
        mesh = self.meshes[number]
        return self._usd_meshes[number].read_positions(
            time, used=mesh.points, point_count=mesh.point_count, dtype=self.dtype
        )

    def _find_welds(self) -> np.ndarray:
        """The first of the vertices that are in the same place as each one at every time, shape [vertex_count]."""
        _, places, counts = np.unique(self._start, axis=0, return_inverse=True, return_counts=True)
        places = places.reshape(-1)  # NumPy 2.0 shapes it otherwise
        (crowded,) = np.nonzero(counts[places] > 1)
        welded_to = np.arange(len(places))
        if len(crowded):
            groups = places[crowded]
            for time in self.times[1:]:
                motion = np.column_stack([groups, self._unwelded_positions(time)[crowded]])
                groups = np.unique(motion, axis=0, return_inverse=True)[1].reshape(-1)
            _, firsts, groups = np.unique(groups, return_index=True, return_inverse=True)
            welded_to[crowded] = crowded[firsts[groups]]
        return welded_to
