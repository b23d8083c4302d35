"""How deep meshes are behind the surfaces of others, from the intersections at one time.

An edge that passes through a surface an odd number of times has its ends on different sides of it. Such edges divide a
mesh into sides: all vertices that other edges connect are on one side, if the surface goes on beside them. The depth of
a mesh behind a surface is the largest distance of a vertex from the surface, on the side where that is smaller. For a
part that is wholly inside a mesh, it is the largest distance of its vertices from that mesh.

The depth of two meshes is the larger one of the first behind the second and the second behind the first; of two meshes
with borders, such as two sheets, the smaller one, as either extends far on both sides of a fin that cuts into it. Where
no edges divide a mesh, as a surface ends there, it is the distance of the nearer end of an edge from the plane of the
face that it passes through, at most.
"""

from functools import cached_property
from typing import NamedTuple

import numpy as np

from ..detection.at_rest.body_parts import connect_cells
from ..detection.at_rest.closest_points import ClosestPointFinder
from ..usd.segment import Segment
from .scene_intersections import SceneIntersections

_ON_SIDE = 1e-5  # barycentric coordinate up to which the closest point of a face is on a side of it
_FIRST_REACH = 0.005  # part of the size of a mesh or a surface up to which vertices are searched first
_MOST_WORK, _MOST_AT_ONCE, _OF_A_PAIR = 1_000_000, 4_000_000, 1_000
"""Number of vertices whose distances are measured, over all times and at one, and as many as two meshes count for."""
_GROWTH = 0.1
_SAME_POINT = 1e-6  # part of an edge within which it passes through two neighbouring faces at once: at their side


class DepthFinder:
    """Finds depths at one time after another; meshes of the same segment are prepared once."""

    def __init__(self):
        """Prepares nothing yet."""
        self._segment: Segment | None = None
        self._shapes: dict[int, _Shape] = {}

    def find(self, found: SceneIntersections) -> dict[tuple[str, str], float]:
        """Returns the depth of each two meshes that intersect, in the scene's unit of length, by their sorted names.

        It is 0 for meshes that only touch. Distances are computed in single precision.

        Args:
            found: The intersections at one time.
        """
        segment = found.segment
        if segment is not self._segment:
            self._segment, self._shapes = segment, {}
        x = found.x.astype(np.float64)
        x = (x - x.mean(axis=0)).astype(np.float32) if len(x) else found.x
        surfaces: dict[int, _Surface] = {}
        inside = np.arange(len(found))[found.inside_rows]
        crossing = np.delete(np.arange(len(found)), inside)
        crossing = crossing[np.argsort(found.meshes[crossing, 1], kind="stable")]  # by the outer mesh
        outer_of_crossing = found.meshes[crossing, 1]
        behind: dict[tuple[int, int], list[_Depth]] = {}
        for mesh, outer in np.unique(found.meshes, axis=0).tolist():
            shape = self._shape(mesh)
            if outer not in surfaces:
                surfaces[outer] = _Surface(self._shape(outer), x)
            surface = surfaces[outer]
            rows = crossing[slice(*np.searchsorted(outer_of_crossing, (outer, outer + 1)))]
            parts = found.vertices[inside[(found.meshes[inside] == (mesh, outer)).all(axis=1)]]
            crossings = _Crossings(shape, found, rows)
            found_here = behind.setdefault((min(mesh, outer), max(mesh, outer)), [])
            found_here.append(_depth_of_parts(shape, surface, x, parts))
            of_sides = (
                _depth_within(shape, x, crossings) if mesh == outer else _depth_behind(shape, surface, x, crossings)
            )
            found_here.append(of_sides)
        depths = {}
        for pair, found_here in behind.items():
            names = sorted(segment.meshes[number].name for number in pair)
            depths[names[0], names[1]] = _joined(found_here, all(self._shape(number).has_border for number in pair))
        return depths

    def _shape(self, mesh: int) -> "_Shape":
        if mesh not in self._shapes:
            assert self._segment is not None
            self._shapes[mesh] = _Shape(self._segment, mesh)
        return self._shapes[mesh]


class DepthRecorder:
    """Measures the depths at the times of a replay.

    These are all times until that has taken :data:`_MOST_WORK`, which few scenes take; then those at which more edges
    pass through faces than at any before, by a share of :data:`_GROWTH`. A time that would take more than
    :data:`_MOST_AT_ONCE` is left out, as where thousands of pairs of meshes intersect.
    """

    def __init__(self):
        """Begins before the first interval."""
        self._finder = DepthFinder()
        self._largest: dict[tuple[str, str], tuple[float, float]] = {}
        self._last: SceneIntersections | None = None  # at the end of the last interval
        self._work, self._most = 0, 0

    def add(self, intersections: tuple[SceneIntersections, SceneIntersections]) -> None:
        """Measures the depths at the start of an interval, which follows the last one that was added."""
        start, self._last = intersections
        self._measure(start)

    def largest(self) -> dict[tuple[str, str], tuple[float, float]]:
        """Returns the largest depth of each two meshes, and the first time with it, by their sorted names."""
        if self._last:
            self._measure(self._last)
            self._last = None
        return self._largest

    def _measure(self, found: SceneIntersections) -> None:
        if self._work > _MOST_WORK and len(found) <= (1.0 + _GROWTH) * self._most:
            return
        meshes, inner = found.segment.meshes, np.unique(found.meshes, axis=0)[:, 0].tolist()
        work = sum(_OF_A_PAIR + len(meshes[mesh].points) for mesh in inner)
        if work > _MOST_AT_ONCE:
            return
        self._most, self._work = max(self._most, len(found)), self._work + work
        for names, depth in self._finder.find(found).items():
            if depth > self._largest.get(names, (-1.0, 0.0))[0]:
                self._largest[names] = depth, found.time


class _Depth(NamedTuple):
    """The depth of a mesh behind a surface.

    Attributes:
        of_sides: The depth where edges divide the mesh; None if they divide it nowhere.
        at_edges: Largest distance of the nearer end of an edge from the plane of the face that it passes through.
    """

    of_sides: float | None
    at_edges: float


def _joined(depths: list[_Depth], have_borders: bool) -> float:
    """Returns the depth of two meshes, given those of one behind the other and the other behind the first."""
    of_sides = [depth.of_sides for depth in depths if depth.of_sides is not None]
    if not of_sides:
        return max(depth.at_edges for depth in depths)
    return min(of_sides) if have_borders else max(of_sides)


class _Shape:
    """The vertices, faces and edges of one mesh, with vertices numbered for it alone.

    Attributes:
        vertices: Its vertices in the segment, ascending, shape [n].
        faces: Vertices of its faces, shape [face_count, 3], int32.
        edges: Vertices of its edges, the smaller first, shape [m, 2].
    """

    def __init__(self, segment: Segment, number: int):
        faces = segment.faces[segment.meshes[number].faces]
        self.vertices = np.unique(segment.vertices_of(number))
        self.faces = np.searchsorted(self.vertices, faces).astype(np.int32)
        free = segment.free_edges[np.isin(segment.free_edges, self.vertices).all(axis=1)]
        self._sides = np.sort(self.faces[:, [[1, 2], [2, 0], [0, 1]]], axis=2)  # opposite each corner
        sides = np.concatenate([self._sides.reshape(-1, 2), np.sort(np.searchsorted(self.vertices, free), axis=1)])
        keys, self._of_sides, counts = np.unique(self.keys(sides), return_inverse=True, return_counts=True)
        self._edge_keys, self._counts = keys, counts
        self.edges = np.stack(np.divmod(keys, len(self.vertices)), axis=1)

    def keys(self, edges: np.ndarray) -> np.ndarray:
        """Returns a number for each pair of vertices."""
        return edges[:, 0].astype(np.int64) * len(self.vertices) + edges[:, 1]

    def find_edges(self, ends: np.ndarray) -> np.ndarray:
        """Returns the edge between two vertices of the segment, -1 if the mesh has none, shape [n]."""
        places = np.searchsorted(self.vertices, ends)
        own = np.sort(np.minimum(places, len(self.vertices) - 1), axis=1)
        edges = np.minimum(np.searchsorted(self._edge_keys, self.keys(own)), len(self.edges) - 1)
        is_own = (self.vertices[np.minimum(places, len(self.vertices) - 1)] == ends).all(axis=1)
        return np.where(is_own & (self._edge_keys[edges] == self.keys(own)), edges, -1)

    @cached_property
    def parts(self) -> np.ndarray:
        """A number of the connected part of each vertex, shape [n]."""
        return connect_cells(self.edges, len(self.vertices))

    @property
    def has_border(self) -> bool:
        """Whether an edge has one face only, or none."""
        return bool((self._counts == 1).any())

    @cached_property
    def borders(self) -> tuple[np.ndarray, np.ndarray]:
        """Whether no other face has the side opposite each corner, shape [face_count, 3], and the border vertices."""
        alone = (self._counts == 1)[self._of_sides.reshape(-1)[: self.faces.size]].reshape(-1, 3)
        vertices = np.zeros(len(self.vertices), dtype=bool)
        vertices[self._sides[alone]] = True
        return alone, vertices


def _box(places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the lowest and the highest corner of the box of some positions."""
    columns = np.ascontiguousarray(places.T)  # faster to reduce
    return columns.min(axis=1), columns.max(axis=1)


class _Surface:
    """The surface of a mesh at one time, for distances from it."""

    def __init__(self, shape: _Shape, x: np.ndarray, faces: np.ndarray | None = None):
        """Builds it of some faces, default all."""
        self._shape = shape
        self._faces = np.arange(len(shape.faces)) if faces is None else faces
        places = x[shape.vertices]
        self._low, self._high = _box(places)
        self._finder = ClosestPointFinder(places, shape.faces[self._faces])

    @property
    def size(self) -> float:
        """Diagonal of the mesh's box."""
        return float(np.linalg.norm(self._high - self._low))

    def may_be_near(self, points: np.ndarray, reach: float) -> np.ndarray:
        """Returns which points are in the mesh's box, enlarged by a distance, shape [n]."""
        columns = zip(points.T, self._low - reach, self._high + reach, strict=True)
        return np.logical_and.reduce([(column >= low) & (column <= high) for column, low, high in columns])

    def distances(self, points: np.ndarray, reach: float = np.inf) -> tuple[np.ndarray, np.ndarray]:
        """Returns the distances of points, shape [n], and whether the closest point is on a border of the mesh.

        Distances larger than ``reach`` are infinite.
        """
        closest = self._finder.find(points, reach)
        sides, vertices = self._shape.borders
        face, on_side = self._faces[closest.faces], closest.coordinates < _ON_SIDE
        at_corner = on_side.sum(axis=1) == 2
        corner = self._shape.faces[face, np.argmin(on_side, axis=1)]
        at_border = np.where(at_corner, vertices[corner], (on_side & sides[face]).any(axis=1))
        return closest.distances, at_border & np.isfinite(closest.distances)


class _Crossings:
    """The edges of a mesh that meet a surface.

    Attributes:
        odd: Edges that pass through it an odd number of times, ascending, shape [m].
        near: Distance of the nearer end of each from the plane of a face that it passes through, shape [m].
        open: Which edges of the mesh connect vertices on one side: those that pass through it an even number of times,
            and do not touch it otherwise.
    """

    def __init__(self, shape: _Shape, found: SceneIntersections, rows: np.ndarray):
        edges = shape.find_edges(found.vertices[rows, 0])
        rows, edges = rows[edges >= 0], edges[edges >= 0]
        self.open = np.ones(len(shape.edges), dtype=bool)
        self.open[edges[~found.crosses[rows]]] = False
        rows, edges = rows[found.crosses[rows]], edges[found.crosses[rows]]
        ends, faces = found.vertices[rows, 0], found.segment.faces[found.faces[rows, 1]]
        p, q = found.x[ends].astype(np.float64).transpose(1, 0, 2)
        length = np.maximum(np.linalg.norm(q - p, axis=1), np.finfo(float).tiny)
        along = np.linalg.norm(found.position[rows] - p, axis=1) / length
        a, b, c = found.x[faces].astype(np.float64).transpose(1, 0, 2)
        normal = np.cross(b - a, c - a)
        normal /= np.maximum(np.linalg.norm(normal, axis=1), np.finfo(float).tiny)[:, None]
        near = np.minimum(*(np.abs(np.einsum("ni,ni->n", end - a, normal)) for end in (p, q)))
        order = np.lexsort((along, edges))
        edges, along, faces, near = edges[order], along[order], faces[order], near[order]
        # An edge that passes through a side of two faces is in two rows, and passes through the surface once.
        again = (np.diff(edges) == 0) & (np.diff(along) < _SAME_POINT)
        again &= (faces[1:, :, None] == faces[:-1, None, :]).sum(axis=(1, 2)) == 2
        counts = np.bincount(edges[np.append(True, ~again)[: len(edges)]], minlength=len(self.open))
        self.odd = np.flatnonzero(counts % 2)
        self.open[self.odd] = False
        largest = np.zeros(len(self.open))
        np.maximum.at(largest, edges, near)
        self.near = largest[self.odd]


class _Sides(NamedTuple):
    """The sides of a surface that vertices are on.

    Attributes:
        region: A number of the region of each vertex: connected on one side, shape [n].
        piece: The piece of surface of each region, whose edges connect both sides; -1 if it has no two sides.
        is_second: Whether each region is on the second side of its piece.
    """

    region: np.ndarray
    piece: np.ndarray
    is_second: np.ndarray


def _find_sides(shape: _Shape, crossings: _Crossings, left_out: np.ndarray) -> _Sides:
    """Returns the sides of a surface that the vertices of a mesh are on; some vertices are left out."""
    is_used = ~(left_out[shape.edges[:, 0]] | left_out[shape.edges[:, 1]])
    roots = connect_cells(shape.edges[crossings.open & is_used], len(shape.vertices))
    is_root = roots == np.arange(len(roots))
    region, count = (np.cumsum(is_root) - 1)[roots], int(is_root.sum())
    first, second = region[shape.edges[crossings.odd[is_used[crossings.odd]]]].T
    # Each region twice, on either side: a crossing connects one region on one side with the other one on the other.
    links = np.concatenate([np.stack([first, second + count], axis=1), np.stack([first + count, second], axis=1)])
    sides = connect_cells(links, 2 * count)
    one, other = np.split(sides, 2)
    has_sides = np.zeros(count, dtype=bool)
    has_sides[first] = has_sides[second] = True
    piece = np.where(has_sides & (one != other), np.minimum(one, other), -1)
    return _Sides(region, piece, one > other)


def _depth_behind(shape: _Shape, surface: _Surface, x: np.ndarray, crossings: _Crossings) -> _Depth:
    """Returns the depth of a mesh behind the surface of another one that its edges pass through.

    Vertices are searched up to some distance from the surface, which grows until one side of each piece is within it.
    """
    if not len(crossings.odd):
        return _Depth(None, 0.0)
    at_edges = float(crossings.near.max())
    places, of_parts = x[shape.vertices], np.isin(shape.parts, shape.parts[shape.edges[crossings.odd, 0]])
    ends = places[shape.edges[crossings.odd]]
    low, high = _box(places)
    size = max(surface.size, float(np.linalg.norm(high - low)))
    reach = max(2.0 * float(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).max()), _FIRST_REACH * size)
    distance, at_border = np.full(len(places), np.inf), np.zeros(len(places), dtype=bool)
    while True:
        near = np.flatnonzero(of_parts & (distance == np.inf) & surface.may_be_near(places, reach))
        distance[near], at_border[near] = surface.distances(places[near], reach)
        is_far = distance == np.inf
        sides = _find_sides(shape, crossings, at_border | is_far)
        piece = np.where(at_border | is_far, -1, sides.piece[sides.region])
        side = sides.is_second[sides.region].astype(int)
        if piece.max() < 0:
            return _Depth(None, at_edges)
        largest = np.zeros((len(sides.piece) + 1, 2))
        np.maximum.at(largest, (piece, side), np.where(is_far, 0.0, distance))
        if is_far.any():
            first, second = shape.edges.T
            first, second = shape.edges[crossings.open & (is_far[first] != is_far[second])].T
            beside = np.where(is_far[first], second, first)
            largest[piece[beside], side[beside]] = np.inf
        depth = float(largest[:-1].min(axis=1).max())
        if np.isfinite(depth):
            return _Depth(depth, at_edges)
        reach *= 4.0


def _depth_within(shape: _Shape, x: np.ndarray, crossings: _Crossings) -> _Depth:
    """Returns the depth of a mesh behind its own surface.

    That of a region of vertices is measured from the faces that have none of them, on the side with fewer vertices.
    """
    if not len(crossings.odd):
        return _Depth(None, 0.0)
    sides = _find_sides(shape, crossings, np.zeros(len(shape.vertices), dtype=bool))
    piece, at_edges, depth = sides.piece[sides.region], float(crossings.near.max()), 0.0
    if piece.max() < 0:
        return _Depth(None, at_edges)
    sizes = np.zeros((len(sides.piece) + 1, 2), dtype=np.int64)
    np.add.at(sizes, (piece, sides.is_second[sides.region].astype(int)), 1)
    is_smaller = (sizes[:, 1] < sizes[:, 0])[sides.piece] == sides.is_second
    regions = np.flatnonzero(is_smaller & (sides.piece >= 0))
    places = x[shape.vertices]
    low, high = _boxes(shape, places, crossings, sides)
    # A region's border is on the surface: no vertex of it is farther from the surface than the size of its box.
    reach = np.linalg.norm(high - low, axis=1)
    face_low, face_high = (getattr(places[shape.faces], name)(axis=1) for name in ("min", "max"))
    for region in regions[np.argsort(-reach[regions], kind="stable")].tolist():
        if reach[region] <= depth:
            break
        is_own = sides.region == region
        others = ~is_own[shape.faces].any(axis=1)
        near = ((face_low <= high[region] + reach[region]) & (face_high >= low[region] - reach[region])).all(axis=1)
        if (near & others).any():
            distance, _ = _Surface(shape, x, np.flatnonzero(near & others)).distances(places[is_own])
            depth = max(depth, min(float(distance.max()), float(reach[region])))
    return _Depth(depth, at_edges)


def _boxes(shape: _Shape, places: np.ndarray, crossings: _Crossings, sides: _Sides) -> tuple[np.ndarray, np.ndarray]:
    """Returns the lowest and highest corners of boxes around regions and the edges that leave them."""
    low, high = np.full((len(sides.piece), 3), np.inf), np.full((len(sides.piece), 3), -np.inf)
    ends = shape.edges[crossings.odd]
    for region, points in (
        (sides.region, places),
        *((sides.region[ends[:, i]], places[ends[:, 1 - i]]) for i in (0, 1)),
    ):
        np.minimum.at(low, region, points)
        np.maximum.at(high, region, points)
    return low, high


def _depth_of_parts(shape: _Shape, surface: _Surface, x: np.ndarray, vertices: np.ndarray) -> _Depth:
    """Returns the depth of parts that are wholly inside a mesh, given a vertex of each, shape [n, 2, 2]."""
    if not len(vertices):
        return _Depth(None, 0.0)
    own = shape.parts[np.searchsorted(shape.vertices, vertices[:, 0, 0])]
    distance, _ = surface.distances(x[shape.vertices[np.isin(shape.parts, own)]])
    return _Depth(float(distance.max()), 0.0)
