"""A span of a scene's time over which the same meshes, curves and points exist and keep their topology."""

from collections.abc import Callable, Iterator
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from .._sorted_keys import distinct, expand_ranges, search, search_ranges
from .read.position_reader import PositionReader
from .read.tetrahedra import Tetrahedra
from .scene_mesh import InPrims, SceneMesh
from .turns import Turn, find_turns
from .welding import first_by_hash, first_by_position

if TYPE_CHECKING:
    from .read.meshes import UsdMesh


class Segment:
    """Meshes merged to one list of vertices and one of faces, and their positions at the times of the segment.

    Curves are meshes of edges without faces, and points are meshes of vertices alone.

    Attributes:
        meshes: The meshes, in the order of their vertices.
        faces: Vertices of each face, shape [face_count, 3], int32.
        free_edges: Vertices of the edges of curves, shape [n, 2], int32.
        points: Vertices of points, int32.
        tetrahedra: The tetrahedra of the meshes.
        radius: Radius of each vertex, in the scene's unit of length; 0 at faces; shape [vertex_count].
        vertex_count: Number of vertices of all meshes, welded.
        welded: Number of vertices that were welded to another one.
        dtype: Type of the positions, float32 or float64.
        start_positions: Positions of all vertices in world space at the first time, shape [vertex_count, 3]; not to be
            written to.
    """

    meshes: list[SceneMesh]
    faces: np.ndarray

    def __init__(
        self,
        usd_meshes: "list[UsdMesh]",
        times: list[float],
        dtype: np.dtype,
        progress: Callable[[int, int], None] | None = None,
        welds: tuple[np.ndarray, np.ndarray] | None = None,
    ):
        """Reads the topology and welds vertices.

        Args:
            usd_meshes: The meshes.
            times: The segment's times, its first and its last included.
            dtype: Type of the positions.
            progress: Called with the number of times at which vertices have been compared, and their total.
            welds: :attr:`welds` of the same meshes and times, if known, so that not all times have to be read.

        Raises:
            UnreadableError: If a mesh is broken.
        """
        self._usd_meshes = usd_meshes
        self.tetrahedra = Tetrahedra(usd_meshes, times[0])
        self.dtype = dtype
        self.meshes, faces, edges, curves, points_alone, radius = [], [], [], [], [], []
        vertex_count = face_count = 0
        compact = {}  # by identity of the triangles, which instances share: used points, corners, and the triangles
        for mesh in usd_meshes:
            points = mesh.read_points(times[0])
            triangles, polygons = mesh.read_triangles(times[0], points)
            if mesh.is_strands:
                used, corners = np.arange(len(points)), triangles
                own_edges, own_curves, own_radius = mesh.read_strands(times, len(points))
                edges.append(own_edges + vertex_count)
                curves.append(np.where(own_curves < 0, -1, own_curves + vertex_count))  # unique in the segment
                points_alone.append(vertex_count + np.flatnonzero(own_curves < 0))
                radius.append(own_radius)
            else:
                if id(triangles) not in compact:
                    compact[id(triangles)] = *_renumber(triangles, len(points)), triangles
                used, corners, _ = compact[id(triangles)]
                curves.append(np.full(len(used), -1))
                radius.append(np.zeros(len(used)))
                if not mesh.instanced_prim:
                    compact.clear()
            faces.append(corners + vertex_count)
            self.meshes.append(
                SceneMesh(
                    path=mesh.path,
                    name=mesh.name,
                    moves=bool(mesh.times),
                    deforms=mesh.deforms,
                    vertices=slice(vertex_count, vertex_count + len(used)),
                    faces=slice(face_count, face_count + len(triangles)),
                    points=used,
                    point_count=len(points),
                    polygons=polygons,
                )
            )
            vertex_count += len(used)
            face_count += len(triangles)
        self._points = InPrims([mesh.points for mesh in self.meshes])  # of vertices, numbered before welding
        self._polygons = InPrims([mesh.polygons for mesh in self.meshes])  # of faces
        self._corners = np.concatenate([np.zeros((0, 3), dtype=np.int64), *faces])
        self._unwelded_edges = np.concatenate([np.zeros((0, 2), dtype=np.int64), *edges])
        curve_of_vertex, radii = (np.concatenate([[], *arrays]) for arrays in (curves, radius))
        alone = np.concatenate([np.zeros(0, dtype=np.int64), *points_alone])

        self.start_positions = np.zeros((vertex_count, 3), dtype)
        everything = np.arange(vertex_count)
        self._reader(everything, range(len(self.meshes))).read(self.start_positions, times[0], False)
        if welds is None:
            self._welded_to = self._find_welds(times, progress)
        else:
            self._welded_to = everything
            self._welded_to[welds[0]] = welds[1]
        used = [self._welded_to[part].reshape(-1) for part in (self._corners, self._unwelded_edges, alone)]
        self._kept, welded = _renumber(np.concatenate(used), vertex_count)
        corners, ends, points = np.split(welded.astype(np.int32), np.cumsum([len(used[0]), len(used[1])]))
        self.faces, self.free_edges, self.points = corners.reshape(-1, 3), ends.reshape(-1, 2), points
        self.vertex_count = len(self._kept)
        self.radius = np.zeros(self.vertex_count)
        self._curve_of_vertex = curve_of_vertex[self._kept].astype(np.int64)
        if self.has_strands:
            np.maximum.at(self.radius, np.searchsorted(self._kept, self._welded_to), radii)
            self.radius[self.faces] = 0.0  # curves welded to a mesh would thicken its faces
        self.welded = vertex_count - self.vertex_count
        self.start_positions = self.start_positions[self._kept]
        self._along, self._length = self._measure_curves()
        moving = [number for number, mesh in enumerate(self.meshes) if mesh.moves]
        jumping = [number for number in moving if usd_meshes[number].may_jump]
        self._moving = self._reader(self._kept, moving)
        self._jumping = self._reader(self._kept, jumping) if jumping else None

    def positions(self, time: float, *, before: bool = False, last: np.ndarray | None = None) -> np.ndarray:
        """Returns the positions of all vertices in world space.

        Args:
            time: Time code.
            before: Whether to read the moment just before that time, which differs for a mesh that jumps then.
            last: Positions just before that time, if known, so that only meshes that may jump are read again.

        Returns:
            Positions in the scene's unit of length, shape [vertex_count, 3], of type :attr:`dtype`; ``last`` itself if
            no mesh may jump.

        Raises:
            UnreadableError: If a mesh has another number of points than at first, or a coordinate is not finite.
        """
        if last is not None and not self._jumping:
            return last
        reader = self._moving if last is None else self._jumping
        assert reader
        positions = (self.start_positions if last is None else last).copy()
        reader.read(positions, time, before)
        return positions

    def turns(self, start: float, end: float) -> tuple[dict[int, Turn], list[str]]:
        """Returns the turns of meshes that only their transforms move, by their numbers; and names of those that bend.

        Args:
            start: Time code of the first time.
            end: Time code of the second one; of a mesh that jumps then, the turn ends before the jump.
        """

        def transform(number: int, share: float) -> np.ndarray | None:
            return self._usd_meshes[number].read_transform(start + share * (end - start), before=share == 1.0)

        turning = [mesh.turns and mesh.transforms.may_turn and not mesh.deforms for mesh in self._usd_meshes]
        turns, bent = find_turns(transform, np.flatnonzero(turning).tolist())
        return turns, [self.meshes[number].path for number in bent]

    @property
    def has_strands(self) -> bool:
        """Whether there are curves or points."""
        return bool(len(self.free_edges) + len(self.points))

    @property
    def may_jump(self) -> bool:
        """Whether the positions of a mesh just before a time may differ from those at that time."""
        return self._jumping is not None

    @property
    def welds(self) -> tuple[np.ndarray, np.ndarray]:
        """The welded vertices, numbered before welding, and the vertices that they are welded to."""
        (welded,) = np.nonzero(self._welded_to != np.arange(len(self._welded_to)))
        return welded, self._welded_to[welded]

    @property
    def face_meshes(self) -> np.ndarray:
        """Mesh of each face, shape [face_count]."""
        return self._polygons.meshes(np.arange(len(self.faces)))

    @property
    def vertex_meshes(self) -> np.ndarray:
        """Mesh of each vertex, the first of those welded there, shape [vertex_count]."""
        return self._points.meshes(self._kept)

    def locate_vertices(self, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the mesh of each vertex, the first of those welded there, and its index among the prim's points."""
        return self._points.locate(self._kept[vertices])

    def meshes_at_vertices(self, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns pairs of a row of ``vertices`` and a mesh with that vertex, welded or not, in two arrays."""
        unwelded, order = self._unwelded
        rows, indices = expand_ranges(*search_ranges(unwelded, self._kept[vertices]))
        return rows, self._points.meshes(order[indices])

    def meshes_at_edges(self, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns pairs of a row of ``ends``, shape [n, 2], smaller vertex first, and a mesh with it, in two arrays."""
        rows, sides = self._find_sides(ends)
        return rows, self._points.meshes(self._ends_of_sides(sides)[:, 0])

    def vertices_of(self, number: int) -> np.ndarray:
        """Returns the vertices of a mesh, in the order of :attr:`SceneMesh.points`, shape [n]."""
        return np.searchsorted(self._kept, self._welded_to[self.meshes[number].vertices])

    def locate_faces(self, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the mesh of each face, and the index of the prim's polygon that it is a part of."""
        return self._polygons.locate(np.asarray(faces))

    def triangles_in_polygons(self, faces: np.ndarray) -> np.ndarray:
        """Returns the number of each face among the triangles of its polygon, from 0, shape [n]."""
        triangles = np.zeros(len(faces), dtype=np.int64)
        for number, members in _by_mesh(self._polygons.meshes(faces)):
            mesh = self.meshes[number]
            own = faces[members] - mesh.faces.start
            triangles[members] = own - np.searchsorted(mesh.polygons, mesh.polygons[own])
        return triangles

    def find_faces(self, meshes: np.ndarray, polygons: np.ndarray, triangles: np.ndarray) -> np.ndarray:
        """Returns faces, shape [n]: the inverse of :meth:`locate_faces` and :meth:`triangles_in_polygons`."""
        faces = np.zeros(len(meshes), dtype=np.int64)
        for number, members in _by_mesh(meshes):
            mesh = self.meshes[number]
            faces[members] = mesh.faces.start + np.searchsorted(mesh.polygons, polygons[members]) + triangles[members]
        return faces

    def find_vertices(self, meshes: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Returns vertices, given meshes and the indices of points of their prims, shape [n]."""
        vertices = np.zeros(len(meshes), dtype=np.int64)
        for number, members in _by_mesh(meshes):
            mesh = self.meshes[number]
            vertices[members] = mesh.vertices.start + np.searchsorted(mesh.points, points[members])
        return np.searchsorted(self._kept, self._welded_to[vertices])

    def find_points(self, meshes: np.ndarray, vertices: np.ndarray) -> np.ndarray:
        """Returns the indices of vertices among the points of given meshes' prims, the first if welded, shape [n]."""
        unwelded, order = self._unwelded
        rows, indices = expand_ranges(*search_ranges(unwelded, self._kept[vertices]))
        own_meshes, points = self._points.locate(order[indices])
        (own,) = np.nonzero(own_meshes == meshes[rows])
        return points[own[np.unique(rows[own], return_index=True)[1]]]

    def locate_edges(self, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns the mesh of each edge, the indices of its ends among the prim's points, and whether it is a diagonal.

        Args:
            ends: Vertices, the smaller first, shape [n, 2].

        Returns:
            Indices of meshes, shape [n]; indices of points, the smaller first, shape [n, 2]; and whether each edge is
            a diagonal, bool, shape [n]: an edge inside a polygon, where two of its triangles meet.
        """
        keys, sides = self._sides
        own = self._side_keys(ends)
        first = search(keys, own)
        # The face's own corners, as the welded ends may belong to an earlier mesh.
        meshes, points = self._points.locate(self._ends_of_sides(sides[first]))

        # Triangles of one polygon are neighbours in the list.
        following = np.minimum(first + 1, max(0, len(keys) - 1))
        diagonal = (keys[following] == own) & (following > first) & (sides[following] < self._corners.size)
        (rows,) = np.nonzero(diagonal)
        if len(rows):
            face, other = (np.stack(self.locate_faces(sides[where[rows]] // 3)) for where in (first, following))
            diagonal[rows] = (face == other).all(axis=0)
        return meshes[:, 0], np.sort(points, axis=1), diagonal

    def faces_around(self, vertices: np.ndarray) -> np.ndarray:
        """Returns the faces that have any of the vertices as a corner, ascending."""
        marked = np.zeros(self.vertex_count, dtype=bool)
        marked[vertices] = True
        a, b, c = self.faces.T
        return np.flatnonzero(marked[a] | marked[b] | marked[c])

    def faces_of_edges(self, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns pairs of a row of ``ends``, shape [n, 2], smaller vertex first, and a face with it, in two arrays."""
        rows, sides = self._find_sides(ends)
        of_faces = sides < self._corners.size
        return rows[of_faces], sides[of_faces] // 3

    def are_neighbours(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """Returns whether the edges of each pair are close along one curve, so that thick ones always touch, bool.

        The part of the curve between them is then at most twice as long as the sum of their radii, at the segment's
        first time.

        Args:
            first: Vertices of an edge, shape [n, 2].
            second: Vertices of the other edge, shape [n, 2].
        """
        curves = self._curve_of_vertex[first].max(axis=1), self._curve_of_vertex[second].max(axis=1)
        (rows,) = np.nonzero((curves[0] >= 0) & (curves[0] == curves[1]))
        first, second = first[rows], second[rows]
        between = np.abs(self._along[first][:, :, None] - self._along[second][:, None, :])
        between = np.minimum(between, self._length[first].min(axis=1)[:, None, None] - between)
        between[np.isnan(between)] = np.inf  # welded to a mesh
        reach = self.radius[first].max(axis=1) + self.radius[second].max(axis=1)
        near = np.zeros(len(curves[0]), dtype=bool)
        near[rows] = between.min(axis=(1, 2)) <= 2.0 * reach
        return near

    def are_stiff(self, elements: np.ndarray, meshes: np.ndarray) -> np.ndarray:
        """Returns whether each element is paired with its own mesh, and only a transform moves that mesh.

        A vertex or an edge that is welded to others belongs to all of their meshes.

        Args:
            elements: Vertices, shape [n], or edges, shape [n, 2], smaller vertex first.
            meshes: The other element's mesh, shape [n].

        Returns:
            Bool array of shape [n].
        """
        stiff = np.array([mesh.moves and not mesh.deforms for mesh in self.meshes], dtype=bool)
        if not self.welded or not stiff.any():
            return stiff[meshes] & (self.locate_vertices(np.atleast_2d(elements.T)[0])[0] == meshes)
        rows, own = self.meshes_at_vertices(elements) if elements.ndim == 1 else self.meshes_at_edges(elements)
        return np.bincount(rows[stiff[own] & (own == meshes[rows])], minlength=len(elements)) > 0

    def faces_at_edges(self, ends: np.ndarray) -> np.ndarray:
        """Returns the faces that have any of the edges, shape [n, 2], smaller vertex first, as a side, ascending."""
        keys, sides = self._sides
        first, last = search_ranges(keys, self._side_keys(ends))
        begin, end = (np.bincount(places, minlength=len(keys) + 1) for places in (first, last))
        found = sides[np.cumsum(begin - end)[:-1] > 0]
        return distinct(found[found < self._corners.size] // 3)

    @cached_property
    def _unwelded(self):
        """The vertex that each unwelded vertex was welded to, ascending, and the index of each unwelded vertex."""
        order = np.argsort(self._welded_to, kind="stable")
        return self._welded_to[order], order

    @cached_property
    def _sides(self):
        """Keys of the sides of all faces and of free edges, ascending, and the numbers of these sides.

        Side number 3 face + corner is a side of a face; larger numbers are free edges.
        """
        sides = np.sort(self.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        if len(self.free_edges):
            sides = np.concatenate([sides, np.sort(self.free_edges, axis=1)])
        keys = self._side_keys(sides)
        order = np.argsort(keys, kind="stable")
        return keys[order], order

    def _find_sides(self, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns pairs of a row of ``ends``, shape [n, 2], smaller vertex first, and a side, in two arrays."""
        keys, sides = self._sides
        rows, indices = expand_ranges(*search_ranges(keys, self._side_keys(ends)))
        return rows, sides[indices]

    def _ends_of_sides(self, sides: np.ndarray) -> np.ndarray:
        """Returns the vertices at both ends of sides, numbered before welding, shape [n, 2]."""
        corners, of_faces = self._corners.reshape(-1), sides < self._corners.size
        ends = np.zeros((len(sides), 2), dtype=np.int64)
        own = sides[of_faces]
        ends[of_faces] = np.stack([corners[own], corners[np.where(own % 3 == 2, own - 2, own + 1)]], axis=1)
        ends[~of_faces] = self._unwelded_edges[sides[~of_faces] - self._corners.size]
        return ends

    def _measure_curves(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns the distance of each vertex from the start along its curve at the first time, and the curve's length.

        The distance is NaN without a curve; the length is infinity if it is not closed. Both are in the scene's unit.
        """
        ends, x = self._unwelded_edges, self.start_positions.astype(np.float64)
        lengths = np.linalg.norm(x[self.free_edges[:, 1]] - x[self.free_edges[:, 0]], axis=1)
        is_next = ends[:, 1] == ends[:, 0] + 1  # other edges close a curve
        steps = np.zeros(len(self._welded_to))
        steps[ends[is_next, 1]] = lengths[is_next]
        along = np.cumsum(steps)  # only differences within a curve are used
        curves = self._curve_of_vertex
        closed = np.full(int(curves.max(initial=-1)) + 2, np.inf)
        first, last = ends[~is_next].T
        starts = np.searchsorted(self._kept, self._welded_to[first])
        closed[curves[starts]] = along[last] - along[first] + lengths[~is_next]
        closed[-1] = np.inf
        return np.where(curves >= 0, along[self._kept], np.nan), closed[curves]

    def _side_keys(self, ends):
        return np.asarray(ends, dtype=np.int64) @ np.array([self.vertex_count, 1])

    def _reader(self, vertices, numbers) -> PositionReader:
        """Returns a reader of some vertices, numbered before welding, ascending, in the meshes of some numbers."""
        ends = np.searchsorted(vertices, [0, *(mesh.vertices.stop for mesh in self.meshes)]).tolist()
        parts = []
        for number in numbers:
            mesh, rows = self.meshes[number], slice(ends[number], ends[number + 1])
            points = mesh.points[vertices[rows] - mesh.vertices.start]
            parts.append((self._usd_meshes[number], mesh.point_count, rows, points))
        return PositionReader(parts, self.dtype)

    def _find_welds(self, times, progress) -> np.ndarray:
        """Returns for each vertex the first one that has the same position at every time, shape [vertex_count]."""
        welded_to = first_by_position(first_by_hash(self.start_positions), self.start_positions)
        (crowded,) = np.nonzero(np.bincount(welded_to, minlength=len(welded_to))[welded_to] > 1)
        owners = distinct(self._points.meshes(crowded)).tolist()
        moving = [number for number in owners if self.meshes[number].moves]
        if not moving:
            return welded_to
        jumping = any(self._usd_meshes[number].may_jump for number in moving)
        moments = [(time, before) for time in times[1:-1] for before in ([True] if jumping else []) + [False]]
        if times[-1] > times[-2]:
            moments.append((times[-1], True))
        reader = self._reader(crowded, moving)
        positions = self.start_positions[crowded]
        firsts = np.searchsorted(crowded, welded_to[crowded])
        for done, (time, before) in enumerate(moments):
            if progress:
                progress(done, len(moments))
            reader.read(positions, time, before)
            firsts = first_by_position(firsts, positions)
        welded_to[crowded] = crowded[firsts]
        return welded_to


def _by_mesh(meshes: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
    """Yields each of the given meshes with its rows."""
    order = np.argsort(meshes, kind="stable")
    numbers, starts = np.unique(meshes[order], return_index=True)
    yield from zip(numbers.tolist(), np.split(order, starts[1:]), strict=False)


def _renumber(indices: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns the distinct indices, ascending, and the number of each index among these."""
    is_used = np.zeros(count, dtype=bool)
    is_used[indices] = True
    return np.flatnonzero(is_used), (np.cumsum(is_used) - 1)[indices]
