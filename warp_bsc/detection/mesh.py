"""The collision mesh: the faces, edges and vertices for collision detection."""

import functools
from typing import Any, NamedTuple

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from .._arguments import as_numpy, checked_bits, checked_distances, checked_flag, checked_integer, checked_shape
from .._sorted_keys import expand_ranges
from ..kernels.pairs import PairFilter
from ..kernels.pipeline.corners import IS_FACE
from .face_order import order_faces
from .run.settings import PairKind
from .run.start import checked_device

_MOST_LISTED = 31


class ElementsOfParts(NamedTuple):
    """The elements that have each part, such as the faces of each edge."""

    first: np.ndarray  # where the elements of each part begin, int, shape [part_count + 1]
    elements: np.ndarray  # the elements, ascending for each part, int, shape [n]

    @classmethod
    def of(cls, parts: np.ndarray, count: int) -> "ElementsOfParts":
        """Returns the elements of ``count`` parts, given the parts of each, shape [n, k]; negative ones are none."""
        order = np.argsort(parts, axis=None, kind="stable")[np.count_nonzero(parts < 0) :]
        counts = np.bincount(parts.ravel()[order], minlength=count)
        return cls(np.concatenate([[0], np.cumsum(counts)]), order // parts.shape[1])

    def find(self, parts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns all elements that have some parts: the row of the part, and the element, each of shape [m]."""
        rows, places = expand_ranges(self.first[parts], self.first[parts + 1])
        return rows, self.elements[places]


class CollisionMesh:
    """The faces, edges and vertices of a mesh whose positions change and whose connectivity does not.

    Vertices that no face uses (such as the inner particles of a soft body) are excluded, unless they are ends of given
    edges (ropes, strands) or given points. Several bodies make one mesh: their faces index one array of positions.

    Attributes:
        faces: Vertex indices of the faces, int32, shape [face_count, 3].
        edges: Vertex indices of the edges, those of faces and given ones, smaller first, sorted, int32, shape
            [edge_count, 2].
        free_edges: Indices of the edges that no face has, sorted, int32, shape [free_edge_count].
        points: Indices of the given vertices that no face and no edge has, sorted, int32, shape [point_count].
        radius: Radius of each vertex, float64, shape [vertex_count]; None if all are 0. The radius of an edge or a face
            is the largest one of its vertices.
        face_edges: Edges of the faces, edge i from corner i to the next, -1 where both are one vertex, int32, shape
            [face_count, 3].
        tets: Vertex indices of the tetrahedra, int32, shape [tet_count, 4].
        vertices: Indices of the vertices that faces and edges use, and of the points, sorted, int32, shape
            [used_vertex_count].
        vertex_count: Number of positions.
        world: World of each vertex, int32, shape [vertex_count], or None if all are in one.
        group: Groups of each vertex as bits, uint32, shape [vertex_count], or None if no pair is left out.
        mask: Groups that each vertex meets as bits, uint32, shape [vertex_count], or None.
        only_free: Whether pairs are left out in which both elements belong to faces.
        device: Warp device of the arrays that the detector uses.
    """

    def __init__(
        self,
        faces: ArrayLike | wp.array,
        vertex_count: int,
        *,
        edges: ArrayLike | wp.array | None = None,
        points: ArrayLike | wp.array | None = None,
        tets: ArrayLike | wp.array | None = None,
        radius: ArrayLike | wp.array | None = None,
        world: ArrayLike | wp.array | None = None,
        group: ArrayLike | wp.array | None = None,
        mask: ArrayLike | wp.array | None = None,
        only_free: bool = False,
        device: wp.DeviceLike = None,
    ):
        """Finds the edges and puts the mesh on a device.

        Args:
            faces: Vertex indices, integers, shape [face_count, 3] with less than 2^28 faces, NumPy or Warp array.
            vertex_count: Number of positions.
            edges: Vertex indices of edges that are included although no face has them, integers, shape [n, 2], NumPy or
                Warp array. Edges of faces among them are not counted twice.
            points: Vertices that are included although no face has them, integers, shape [n], NumPy or Warp array.
            tets: Vertex indices of tetrahedra whose inversions can be found, integers, shape [n, 4], NumPy or Warp
                array: the volume of a b c d is positive if d is on the side of the triangle a b c from which this is
                counterclockwise. They do not collide: their surface is to be among the faces.
            radius: Radius of each vertex, in the unit of the positions, 0 or at least 2^-1021, float, shape
                [vertex_count], NumPy or Warp array; or one for all. A pair collides if it comes within the sum of its
                two radii.
            world: The world of each vertex, integers in [0, 2^31), shape [vertex_count], NumPy or Warp array:
                vertices in different worlds do not collide. Default: all are in one.
            group: The groups that each vertex is in, as the bits of integers in [0, 2^32), or -1 for all; shape
                [vertex_count], NumPy or Warp array, or one for all vertices. Default: 1, the first group.
            mask: The groups that each vertex meets, in the same form; default: -1, every group. Two vertices meet if
                each has a group that is in the mask of the other. A pair of elements is left out unless each vertex of
                one meets each vertex of the other: results do not have it, certificates do not cover it, and
                ``stats.filtered`` counts it. What is not left out and certified does not come to cross.
            only_free: Whether to find only the pairs with a vertex or an edge that no face has. The others, which
                another detector can find, then cost no time.
            device: Warp device; default: Warp's default.

        Raises:
            TypeError: If an argument has another type.
            ValueError: If the faces, edges, points, tetrahedra, radii, worlds, groups or masks have another shape or
                type or are out of range, an index is not in [0, vertex_count), that is not in [0, 2^31), an edge has
                one vertex twice, entries are masked, the worlds differ within a face or an edge, or the device does not
                exist.
        """
        if isinstance(vertex_count, list | tuple | np.ndarray | wp.array):  # CollisionMesh(x, faces), as elsewhere
            raise TypeError(
                "vertex_count must be an integer, the number of positions: CollisionMesh(faces, len(x)); a mesh has no "
                "positions, which detect(x0, x1) takes"
            )
        self.vertex_count = checked_integer(vertex_count, "vertex_count")
        self.only_free = checked_flag(only_free, "only_free")
        self.device = checked_device(device)
        self.faces = self._checked_indices(faces, 3, "face")
        given_edges = self._checked_indices(() if edges is None else edges, 2, "edge")
        same = np.flatnonzero(given_edges[:, 0] == given_edges[:, 1])
        if len(same):
            raise ValueError(f"edges[{same[0]}] has vertex {given_edges[same[0], 0]} twice")
        given_points = self._checked_indices(() if points is None else points, 1, "point")
        self.tets = self._checked_indices(() if tets is None else tets, 4, "tet")
        sides = np.sort(self.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        rows = np.concatenate([sides, np.sort(given_edges, axis=1)]).astype(np.int64)
        numbers = rows @ np.array([self.vertex_count, 1])  # one for each pair: NumPy sorts rows much more slowly
        keys, first_sides, edge_of_side = np.unique(numbers, return_index=True, return_inverse=True)
        all_edges = np.stack(np.divmod(keys, max(1, self.vertex_count)), axis=1).astype(np.int32)
        # a face that names a vertex twice has an edge without length: its point belongs to the other edge
        proper = all_edges[:, 0] != all_edges[:, 1]
        self.edges = all_edges[proper]
        face_edges = np.where(proper, np.cumsum(proper) - 1, -1)[edge_of_side.ravel()[: len(sides)]].reshape(-1, 3)
        self.free_edges = np.flatnonzero(first_sides[proper] >= len(sides)).astype(np.int32)
        is_used = np.zeros(self.vertex_count, dtype=bool)
        is_used[self.faces] = is_used[given_edges] = True
        self.points = np.unique(given_points[~is_used[given_points]])
        is_used[self.points] = True
        self.vertices = np.flatnonzero(is_used).astype(np.int32)
        self.face_edges = face_edges.astype(np.int32)
        self.device_vertices = wp.array(self.vertices, dtype=int, device=self.device)
        self.device_faces = wp.array(self.faces, dtype=int, device=self.device)
        self.device_edges = wp.array(self.edges, dtype=int, device=self.device)
        radii = checked_distances(0.0 if radius is None else radius, "radius", self.vertex_count)
        self.radius = np.broadcast_to(radii, self.vertex_count).copy() if radii.any() else None
        self.world = None if world is None else self._checked_world(world)
        self.group = self.mask = None
        if group is not None or mask is not None:
            self.group = checked_bits(1 if group is None else group, "group", self.vertex_count)
            self.mask = checked_bits(-1 if mask is None else mask, "mask", self.vertex_count)

    def __repr__(self) -> str:
        """Returns the number of elements, and of the vertices that take part."""
        counts = f"{len(self.faces):,} faces, {len(self.edges):,} edges, {len(self.points):,} points"
        return f"CollisionMesh({counts}, {len(self.vertices):,} of {self.vertex_count:,} vertices)"

    @functools.cached_property
    def pair_filter(self) -> PairFilter:
        """The groups and masks on the device."""
        pair_filter = PairFilter()
        if self.group is not None and self.mask is not None:
            arrays = (wp.array(bits.view(np.int32), dtype=int, device=self.device) for bits in (self.group, self.mask))
            pair_filter.group, pair_filter.mask = arrays
        return pair_filter

    @functools.cached_property
    def cells(self) -> np.ndarray:
        """Vertices of the faces, then of the free edges as faces a b b, then of the points, int32, shape [n, 3]."""
        edges, points = self.edges[self.free_edges], self.points
        return np.concatenate([self.faces, edges[:, [0, 1, 1]], np.stack([points] * 3, axis=1)]).astype(np.int32)

    @functools.cached_property
    def cell_edges(self) -> np.ndarray:
        """Edges of the cells, as ``face_edges``, int32, shape [n, 3]."""
        cell_edges = np.full((len(self.cells), 3), -1, dtype=np.int32)
        cell_edges[: len(self.faces)] = self.face_edges
        cell_edges[len(self.faces) : len(self.faces) + len(self.free_edges), 0] = self.free_edges
        return cell_edges

    @property
    def rows(self) -> np.ndarray:
        """The cells as a GPU pairs their elements, int32, shape [n, 7]: vertices, what each represents, and its edges.

        A row begins with its smallest vertex, so that the first two sides of a face have all edges that its neighbours
        have as their last one. The representative of an element is a face in which it comes early: hardly any face
        represents more than a corner and two sides, and threads that compare them seldom wait for others.
        """
        first, last = len(self.faces), len(self.faces) + len(self.free_edges)
        order = (np.argmin(self.cells, axis=1)[:, None] + np.arange(3)) % 3
        cells, edges = (np.take_along_axis(values, order, axis=1) for values in (self.cells, self.cell_edges))
        owned = np.repeat([IS_FACE, 8, 1], [first, last - first, len(self.points)])
        for elements, count, bit in ((cells, self.vertex_count, 1), (edges, len(self.edges), 8)):
            earliest = np.full(count + 1, -1)  # the last one is none
            earliest[elements[:first].T.ravel()[::-1]] = np.arange(3 * first)[::-1]  # the last one written stays
            earliest = earliest[:-1][earliest[:-1] >= 0]
            np.bitwise_or.at(owned, earliest % first, bit << (earliest // first))
        ends, first_ends = np.unique(cells[first:last, :2], return_index=True)
        first_ends = first_ends[~np.isin(ends, self.faces)]
        np.bitwise_or.at(owned, first + first_ends // 2, 1 << (first_ends % 2))
        return np.column_stack([cells, owned, edges]).astype(np.int32)

    @functools.cached_property
    def edge_faces(self) -> ElementsOfParts:
        """The faces of each edge."""
        return ElementsOfParts.of(self.face_edges, len(self.edges))

    @functools.cached_property
    def across(self) -> np.ndarray:
        """Third vertex of the only neighbour at each side of each face, int32, shape [face_count, 3].

        That of the face itself where there is no neighbour, or more than one.
        """
        sides = self.face_edges.ravel()
        opposite = np.roll(self.faces, 1, axis=1).ravel()  # side i goes from corner i to the next
        order = np.argsort(sides, kind="stable")
        of_edge = sides[order]
        are_neighbours = (of_edge[1:] == of_edge[:-1]) & (of_edge[1:] >= 0)
        first = np.flatnonzero(are_neighbours & (np.bincount(sides + 1)[of_edge[1:] + 1] == 2))
        one, other = order[first], order[first + 1]
        across = opposite.copy()
        across[one], across[other] = opposite[other], opposite[one]
        return across.reshape(-1, 3)

    @functools.cached_property
    def device_across(self) -> wp.array:
        """The same on the device, two-dimensional Warp array of int."""
        return wp.array(self.across, dtype=int, device=self.device)

    @functools.cached_property
    def face_order(self) -> np.ndarray:
        """Cell at each place of the broad phase's hierarchy, int32, see :func:`.face_order.order_faces`."""
        return order_faces(self.cells, None if self.world is None else self.world[self.cells[:, 0]])

    @functools.cached_property
    def device_places(self) -> tuple[wp.array, ...]:
        """What is at the places of the hierarchy, on the device, for detectors to share, arrays of int.

        The cell, -1 for none; its vertices, and what it is the representative of, shape [n, 4]; its edges, [n, 3].
        """
        order = self.face_order
        rows = self.rows[order] if len(order) else self.rows
        arrays = (order, rows[:, :4], rows[:, 4:])
        return tuple(wp.array(values, dtype=int, device=self.device) for values in arrays)

    @functools.cached_property
    def device_tets(self) -> wp.array:
        """Vertex indices of the tetrahedra on the device, two-dimensional Warp array of int."""
        return wp.array(self.tets, dtype=int, device=self.device)

    def elements(self, kind: PairKind) -> np.ndarray:
        """Returns the faces for pairs of a vertex and a face, else the edges."""
        return self.faces if kind == PairKind.VERTEX_FACE else self.edges

    def device_elements(self, kind: PairKind) -> wp.array:
        """Returns the vertex indices of the second elements of a kind of pair, two-dimensional Warp array of int.

        Those of two points are not used, and are the edges here.
        """
        return self.device_faces if kind == PairKind.VERTEX_FACE else self.device_edges

    def device_positions(self, x: ArrayLike | wp.array, name: str) -> wp.array:
        """Returns positions on the device as an array of vec3 or vec3d, unchanged or a copy; finite or not.

        Args:
            x: Positions, shape [vertex_count, 3], float32 or float64, NumPy or Warp array.
            name: What to call them in errors.

        Raises:
            TypeError: If they are no array of numbers.
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
        values = checked_shape(x, (3,), name)
        if len(values) != self.vertex_count:
            raise ValueError(f"{name} must have {self.vertex_count} rows, one a vertex, got {len(values)}")
        dtype = wp.vec3 if values.dtype == np.float32 else wp.vec3d
        return wp.array(np.ascontiguousarray(values), dtype=dtype, device=self.device)

    def _checked_indices(self, given: ArrayLike | wp.array, corners: int, name: str) -> np.ndarray:
        """Returns the vertex indices of elements, int32, shape [n, corners], or [n] for points."""
        shape = (0,) if corners == 1 else (0, corners)
        elements = as_numpy(given, f"{name}s")
        if elements.shape == (0,):
            elements = np.empty(shape, np.int32)
        if elements.ndim != len(shape) or elements.shape[1:] != shape[1:]:
            form = f"(n, {corners})" if corners > 1 else "(n,)"
            raise ValueError(f"{name}s must have shape {form}, not {elements.shape}")
        if not np.issubdtype(elements.dtype, np.integer):
            raise ValueError(f"{name}s must be integers, not {elements.dtype}")
        if len(elements) >= 2**28:  # queues start with a capacity of eight pairs a face, and are indexed by int32
            raise ValueError(f"{name}s must have less than 2^28 rows, not {len(elements)}")
        is_bad = (elements < 0) | (elements >= self.vertex_count)
        bad = np.flatnonzero(is_bad.reshape(len(elements), corners).any(axis=1))
        if len(bad):
            others = f" (so do {len(bad) - 1} other {name}s)" if len(bad) > 2 else ""
            element = f"{name}s[{bad[0]}] is {elements[bad[0]].tolist()}"
            raise ValueError(f"{element}, but the mesh has {self.vertex_count} vertices{others}")
        return np.ascontiguousarray(elements, dtype=np.int32)

    def _checked_world(self, world: ArrayLike | wp.array) -> np.ndarray:
        """Returns the world of each vertex, int32, shape [vertex_count], one for the vertices of a face or an edge."""
        worlds = as_numpy(world, "world")
        count = self.vertex_count
        if worlds.shape != (count,) or not np.issubdtype(worlds.dtype, np.integer):
            raise ValueError(f"world must be {count} integers, one a vertex, got {worlds.dtype} {worlds.shape}")
        bad = (worlds < 0) | (worlds >= 2**31)
        if bad.any():
            raise ValueError(f"world[{np.argmax(bad)}] must be in [0, 2^31), not {worlds[np.argmax(bad)]}")
        of_faces = worlds[self.faces]
        mixed = np.flatnonzero((of_faces != of_faces[:, :1]).any(axis=1))
        if len(mixed):
            raise ValueError(f"world must be one for a face, but faces[{mixed[0]}] has {of_faces[mixed[0]].tolist()}")
        mixed = np.flatnonzero(worlds[self.edges[:, 0]] != worlds[self.edges[:, 1]])
        if len(mixed):
            edge = self.edges[mixed[0]]
            raise ValueError(f"world must be one for an edge, but edge {edge.tolist()} has {worlds[edge].tolist()}")
        return worlds.astype(np.int32)


def changed_mesh(mesh: CollisionMesh, **changes: Any) -> CollisionMesh:
    """Returns a mesh with other arguments of the constructor, else with those of one, which has no tetrahedra."""
    names = "faces", "vertex_count", "points", "radius", "world", "group", "mask", "only_free", "device"
    own: dict[str, Any] = {name: getattr(mesh, name) for name in names}
    own["edges"] = mesh.edges[mesh.free_edges]
    return CollisionMesh(**(own | changes))


def leave_out(part: ArrayLike | wp.array, pairs: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Returns groups and masks of vertices that leave out the pairs of parts in a list.

    They are arguments of :class:`CollisionMesh` and of :class:`warp_bsc.CollisionFilter`::

        group, mask = bsc.leave_out(part, [(0, 0), (0, 1)])  # not within part 0, nor between 0 and 1
        mesh = bsc.CollisionMesh(faces, len(part), group=group, mask=mask)

    An element whose vertices are of several parts is left out with another one if some vertices of both are.

    Args:
        part: Part of each vertex, integers, shape [vertex_count].
        pairs: Pairs of parts that do not collide, in any order, integers, shape [n, 2], of at most 31 parts together.

    Returns:
        Groups and masks as bits, uint32, each of shape [vertex_count].

    Raises:
        TypeError: If an argument holds no integers.
        ValueError: If it has another shape, a pair names a part that no vertex has, or the pairs more than 31 parts.
    """
    parts, listed = (as_numpy(v, name, "an array of integers") for v, name in ((part, "part"), (pairs, "pairs")))
    listed = listed.reshape(0, 2).astype(int) if listed.shape == (0,) else listed
    for values, name in ((parts, "part"), (listed, "pairs")):
        if values.dtype.kind not in "iu":
            raise TypeError(f"{name} must be an array of integers, not of {values.dtype}")
    if parts.ndim != 1:
        raise ValueError(f"part must have shape (vertex_count,), not {parts.shape}")
    if listed.ndim != 2 or listed.shape[1] != 2:
        raise ValueError(f"pairs must have shape (n, 2), not {listed.shape}")
    numbers, bits = np.unique(listed, return_inverse=True)
    unknown = numbers[~np.isin(numbers, parts)]
    if len(unknown):
        raise ValueError(f"pairs name part {unknown[0]}, which no vertex has")
    if len(numbers) > _MOST_LISTED:
        raise ValueError(f"pairs must name at most {_MOST_LISTED} parts, not {len(numbers)}")
    group, mask = np.ones(len(parts), np.uint32), np.full(len(parts), 0xFFFFFFFF, np.uint32)
    for bit, number in enumerate(numbers):
        group[parts == number] = 2 << bit
    for (first, second), (bit, other) in zip(listed, bits.reshape(-1, 2).tolist(), strict=True):
        mask[parts == first] &= ~np.uint32(2 << other)
        mask[parts == second] &= ~np.uint32(2 << bit)
    return group, mask
