"""The surface that is repaired: its mesh without doubled vertices, its input, and its exact checks."""

import functools
import time
from collections.abc import Iterator

import numpy as np
import warp as wp

from ..detection.at_rest.body_parts import connect_cells
from ..detection.detector import CollisionDetector
from ..detection.mesh import CollisionMesh, changed_mesh
from .rigid import RigidGroups

_WRECKED = 0.25
"""Median strain of edges that have moved above which a surface is no result."""
_REACH = 0.25
"""Distance of pairs that a motion may bring together, in edges."""
_NO_TETRAHEDRA = np.zeros((0, 4), dtype=int)
_DIRECTION = np.array([0.48, 0.6, 0.64])
"""A direction across which few vertices of a mesh lie."""


def weld_borders(mesh: CollisionMesh, positions: np.ndarray, *labels: np.ndarray, tolerance: float = 0.0) -> np.ndarray:
    """Returns for each vertex the one that it is welded to, which is welded to itself, int, shape [n].

    The two sides of a seam are borders whose vertices have the same positions, world, groups and mask. Vertices inside
    a surface are not welded: there, two surfaces touch.

    Args:
        mesh: The mesh.
        positions: Positions of the vertices in one configuration or several, finite, shape [n, 3 k].
        labels: Only vertices of the same labels are welded, int, each of shape [n].
        tolerance: Distance up to which positions count as the same, in each configuration.
    """
    weld = np.arange(len(positions))
    border = np.bincount(mesh.face_edges.ravel() + 1, minlength=len(mesh.edges) + 1)[1:] == 1
    vertices = np.unique(mesh.edges[border])
    if len(vertices):
        bits = [values for values in (mesh.world, mesh.group, mesh.mask) if values is not None]
        marks = [values[vertices] for values in (*labels, *bits)]
        places = positions[vertices]
        if tolerance:
            places = connect_cells(_pairs_within(places, marks, tolerance), len(vertices))
        keys = np.column_stack([places, *marks])
        _, firsts, numbers = np.unique(keys, axis=0, return_index=True, return_inverse=True)
        weld[vertices] = vertices[firsts[numbers.reshape(-1)]]
    return weld


def _pairs_within(places: np.ndarray, labels: list[np.ndarray], tolerance: float) -> np.ndarray:
    """Returns the pairs of places of the same labels that are at most a distance apart, int, shape [m, 2]."""
    along = (places[:, :3] - places[0, :3]).astype(np.float64) @ _DIRECTION
    order = np.argsort(along)
    reach = 1.01 * tolerance + 2.0**-48 * np.abs(along).max()  # with rounding
    counts = np.searchsorted(along[order], along[order] + reach, side="right") - np.arange(len(order)) - 1
    first = np.repeat(np.arange(len(order)), counts)
    second = first + 1 + np.arange(len(first)) - np.repeat(np.cumsum(counts) - counts, counts)
    pairs = np.stack([order[first], order[second]], axis=1)
    ways = (places[pairs[:, 1]] - places[pairs[:, 0]]).reshape(len(pairs), -1, 3)
    near = (np.linalg.norm(ways, axis=2) <= tolerance).all(axis=1)
    for values in labels:
        near &= values[pairs[:, 0]] == values[pairs[:, 1]]
    return pairs[near]


def welded(mesh: CollisionMesh, weld: np.ndarray, radius: np.ndarray | None = None) -> CollisionMesh:
    """Returns the mesh whose faces and edges use no vertex that is welded to another one, with the same numbers.

    ``weld`` is the vertex that each one is welded to, int, shape [n]; ``radius`` replaces the radii of the mesh.
    """
    if mesh.radius is radius and not mesh.only_free and (weld == np.arange(len(weld))).all():
        return mesh
    edges = weld[mesh.edges[mesh.free_edges]]
    edges = edges[edges[:, 0] != edges[:, 1]]
    changes = {"faces": weld[mesh.faces], "edges": edges, "points": weld[mesh.points]}
    return changed_mesh(mesh, **changes, radius=radius, only_free=False)


def sums(rows: np.ndarray, values: np.ndarray, count: int) -> np.ndarray:
    """Returns the sums of the values, shape [n, k], of each row, in their order, shape [count, k]."""
    return np.stack([np.bincount(rows, column, count) for column in values.T], axis=1, dtype=float)  # also of no rows


def differ(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Returns which rows of two arrays of vectors differ, bool, shape [n]."""
    differs = a != b
    return differs[:, 0] | differs[:, 1] | differs[:, 2]  # faster than any(axis=1)


class Surface:
    """A mesh without doubled vertices, the input, and what must stay. Positions are in units of its size.

    An offset and a unit, a power of 2, are taken from the coordinates without rounding, so that what is decided of
    positions in units holds for those of the input's type.

    Attributes:
        given: The mesh as it was given.
        weld: The vertex that each of its vertices is welded to, int, shape [n].
        mesh: The mesh, in which no face uses a doubled vertex.
        device: Its Warp device.
        edges: Vertices of the edges of the mesh, of the other edges of tetrahedra, and of links of rigid groups, int,
            shape [m, 2].
        ends: The first and the second vertices of the edges, shape [2, m].
        tetrahedra: Vertices of tetrahedra, whose inner vertices follow, int, shape [m, 4].
        home: Input positions, in units, float64, shape [n, 3].
        fixed: Vertices that stay, and those that no element uses, bool, shape [n].
        rigid: Groups that move as a whole.
        body: Group of each vertex, -1 for those that move by themselves, and one for all that are fixed, int, shape
            [n].
        unit: The unit, in the unit of the input.
        lengths: Length of each of the edges in the input, in units, float64, shape [m].
        edge: Median length of the edges, but for links.
        shortest: Length of the shortest edge of each vertex, at most the median, in units, float64, shape [n].
        min_distance: Distance that elements keep beside their radii, in units, 0 for none.
        radius: Radius of each vertex, in units, float64, shape [n]; None if all are 0.
        end: Time at which a search ends with what it has found, as of ``time.monotonic`` [s].
    """

    end = np.inf

    def __init__(
        self,
        mesh: CollisionMesh,
        x: np.ndarray,
        fixed: np.ndarray,
        min_distance: float = 0.0,
        *,
        weld: np.ndarray | None = None,
        tetrahedra: np.ndarray = _NO_TETRAHEDRA,
        rigid: np.ndarray | None = None,
    ):
        """Prepares detection.

        Args:
            mesh: The mesh.
            x: Input positions, finite, float32 or float64, shape [n, 3].
            fixed: Vertices that stay, bool, shape [n].
            min_distance: Distance that elements keep, in the unit of the input.
            weld: The vertex that each vertex is welded to, int, shape [n]; default: itself.
            tetrahedra: Vertices of tetrahedra, int, shape [m, 4]; default: none.
            rigid: Group of each vertex that moves as a whole, -1 for none, int, shape [n]; default: none.
        """
        self.weld = weld = np.arange(len(x)) if weld is None else weld
        self.given, self.mesh, self._input, self.device = mesh, welded(mesh, weld), x, mesh.device
        self.tetrahedra = weld[tetrahedra]
        mesh, self.edges = self.mesh, self.mesh.edges
        is_used = np.zeros(len(x), dtype=bool)
        is_used[mesh.vertices] = True
        if len(tetrahedra):
            is_used[self.tetrahedra] = True
            self.edges = _with_edges_of(self.tetrahedra, mesh.edges, len(x))
        fixed = np.bincount(weld, fixed, len(x)) > 0
        group = np.full(len(x), -1) if rigid is None else _joined_groups(rigid, weld)
        fixed |= (group >= 0) & np.isin(group, group[fixed])
        self.fixed = fixed | ~is_used
        self.rigid = RigidGroups(np.where(self.fixed, -1, group))
        self.body = np.where(self.fixed, len(x), self.rigid.of)
        count = len(self.edges)
        if len(self.rigid.links):
            self.edges = np.concatenate([self.edges, self.rigid.links])
        self.ends = np.ascontiguousarray(self.edges.T)
        self._is_used = is_used[:, None]
        self._offset, self.unit = _frame_of(x[is_used])
        most = float(np.finfo(x.dtype).max)
        # within a factor of 2 of the offset, differences from it are exact
        ends = np.sort([self._offset / 2.0, self._offset * 2.0], axis=0)
        self._ends = np.clip(np.where(self._offset == 0.0, [[-most], [most]], ends), -most, most)
        self.home = self.in_units(x)
        self.min_distance = min_distance / self.unit
        self.radius = None
        if self.given.radius is not None:
            self.radius = np.zeros(len(x))
            np.maximum.at(self.radius, weld, self.given.radius / self.unit)
        self.lengths = self._lengths_of(self.home, slice(None))
        lengths, ends = self.lengths[:count], self.ends[:, :count]
        self.edge = float(np.median(lengths)) if count else 1.0
        self.shortest = np.full(len(x), self.edge)
        np.minimum.at(self.shortest, ends, np.broadcast_to(lengths, ends.shape))
        self.detector = CollisionDetector(mesh)
        self._finder = self.detector.intersection_finder()

    @functools.cached_property
    def device_edges(self) -> wp.array:
        """Vertices of the edges on the device, shape [m, 2]."""
        return self.mesh.device_edges if self.edges is self.mesh.edges else self.array(self.edges, int)

    @functools.cached_property
    def piece(self) -> np.ndarray:
        """The first vertex of those that edges connect with each one, int, shape [n]."""
        return connect_cells(self.edges, len(self.home))

    @functools.cached_property
    def distance_detector(self) -> CollisionDetector:
        """A detector of pairs that come within the distance that they keep."""
        return CollisionDetector(self._thick_mesh, min_distance=self.min_distance)

    @functools.cached_property
    def reach_detector(self) -> CollisionDetector:
        """A detector of pairs that a motion may bring together."""
        return CollisionDetector(self._thick_mesh, min_distance=max(_REACH * self.edge, 1.01 * self.min_distance))

    @functools.cached_property
    def _thick_mesh(self) -> CollisionMesh:
        """The mesh with its radii."""
        return welded(self.mesh, self.weld, self.radius)

    @functools.cached_property
    def _inversion_detector(self) -> CollisionDetector:
        mesh = CollisionMesh(np.zeros((0, 3), int), len(self.home), tets=self.tetrahedra, device=self.device)
        return CollisionDetector(mesh)

    def inverted(self, x: np.ndarray) -> np.ndarray:
        """Returns the tetrahedra whose volume is not positive, exactly, at rounded positions in units, int."""
        return self._inversion_detector.find_inversions(self.detected(x))

    @property
    def keeps_distance(self) -> bool:
        """Whether elements keep a distance."""
        return self.min_distance > 0.0 or self.radius is not None

    @property
    def is_late(self) -> bool:
        """Whether a search has to end."""
        return time.monotonic() > self.end

    def in_units(self, x: np.ndarray) -> np.ndarray:
        """Returns positions in units, float64; 0 for vertices that are not used."""
        return (np.where(self._is_used, x, self._offset).astype(np.float64) - self._offset) / self.unit

    def strain(self, x: np.ndarray) -> float:
        """Returns the largest change of the length of an edge, as a share of its length in the input."""
        return float(self._strains(x)[1].max(initial=0.0))

    def is_wrecked(self, x: np.ndarray) -> bool:
        """Returns whether most edges that have moved are strained so much that the surface has lost its shape."""
        _, strains = self._strains(x)
        return bool(len(strains)) and float(np.median(strains)) > _WRECKED

    def strained(self, x: np.ndarray, limit: float) -> np.ndarray:
        """Returns the vertices of edges that are strained by more than a limit, int, shape [2 m]."""
        rows, strains = self._strains(x)
        return self.ends[:, rows[strains > limit]].ravel()

    def _strains(self, x):
        """Returns the edges that have moved, and how much they are strained."""
        moved = differ(x, self.home)
        (rows,) = np.nonzero(moved[self.ends[0]] | moved[self.ends[1]])
        change = np.abs(self._lengths_of(x, rows) - self.lengths[rows])
        return rows, change / np.where(self.lengths[rows] > 0.0, self.lengths[rows], np.inf)

    def _lengths_of(self, x: np.ndarray, rows: np.ndarray | slice) -> np.ndarray:
        """Returns the lengths of some edges at positions in units."""
        return np.linalg.norm(x[self.ends[1][rows]] - x[self.ends[0][rows]], axis=1)

    def moves(self, x: np.ndarray) -> np.ndarray:
        """Returns how far each vertex is from its input, in units."""
        return np.linalg.norm(x - self.home, axis=1)

    def positions(self, x: np.ndarray) -> np.ndarray:
        """Returns rounded positions in units as those of the input: of its type, its bits where nothing has moved."""
        moved = differ(x, self.home)[self.weld]
        places = (x[self.weld] * self.unit + self._offset).astype(self._input.dtype)
        return np.where(moved[:, None], places, self._input)

    def moved(self, x: np.ndarray) -> np.ndarray:
        """Returns the vertices that are not as in the input, or in a group with one that is not, bool, shape [n]."""
        return ~self.rigid.least(~differ(x, self.home))

    def rounded(self, x: np.ndarray) -> np.ndarray:
        """Returns positions in units as they will be returned: rigid groups as a whole, of the type of the input."""
        rounded, dtype = self.home.copy(), self._input.dtype
        coordinates = x[self.rigid.vertices] + self._offset / self.unit
        x = self.rigid.placed(x, self.home, float(np.finfo(dtype).eps) * np.abs(coordinates))
        (rows,) = np.nonzero(differ(x, self.home))
        moved = np.clip(x[rows] * self.unit + self._offset, *self._ends).astype(dtype).astype(np.float64)
        placed = ((moved - self._offset) / self.unit).astype(dtype).astype(np.float64)
        rounded[rows] = np.where(x[rows] == self.home[rows], rounded[rows], placed)
        return rounded

    def crossings(self, x: np.ndarray) -> np.ndarray:
        """Returns the edges that meet faces at rounded positions in units, exactly: (edge, face), shape [n, 2]."""
        return self._finder.find(self.detected(x)).pairs

    def detected(self, x: np.ndarray) -> np.ndarray:
        """Returns rounded positions in units in the type of the input, without a change."""
        return x.astype(self._input.dtype, copy=False)

    def counted(self, crossings: np.ndarray) -> np.ndarray:
        """Returns the crossings that count as faults: all."""
        return crossings

    def inside(self, x: np.ndarray) -> np.ndarray:
        """Returns the vertices inside solids at positions in units, int: a mesh alone has none."""
        return np.zeros(0, dtype=int)

    def starts(self, x: np.ndarray, movable: np.ndarray | None) -> Iterator[tuple[np.ndarray, np.ndarray | None]]:
        """Yields positions in units from which a search may begin, and vertices that may move in each."""
        yield x, movable

    def are_fixed(self, crossings: np.ndarray) -> np.ndarray:
        """Returns whether all vertices of edges and faces that cross are fixed, or of one group, bool, shape [m]."""
        vertices = np.hstack([self.mesh.edges[crossings[:, 0]], self.mesh.faces[crossings[:, 1]]])
        return self.are_of_one(self.body, vertices)

    @staticmethod
    def are_of_one(label: np.ndarray, vertices: np.ndarray) -> np.ndarray:
        """Returns which rows of vertices, shape [m, k], have one label that is not -1, bool, shape [m]."""
        labels = label[vertices]
        return np.asarray((labels == labels[:, :1]).all(axis=1) & (labels[:, 0] >= 0))

    def array(self, values: np.ndarray, dtype: type = wp.vec3d) -> wp.array:
        """Returns an array on the device."""
        return wp.array(values, dtype=dtype, device=self.device)


def _frame_of(x: np.ndarray) -> tuple[np.ndarray, float]:
    """Returns an offset, shape [3], and a unit, a power of 2, that positions lose no bit by: else 0 and 1."""
    unchanged = np.zeros(3), 1.0
    if not len(x):
        return unchanged
    low, high = x.min(axis=0).astype(np.float64), x.max(axis=0).astype(np.float64)
    nearest, farthest = np.sort(np.abs([low, high]), axis=0)
    # differences of numbers within a factor of 2 are exact (Sterbenz 1974)
    offset = np.where((np.sign(low) == np.sign(high)) & (farthest <= 1.5 * nearest), low, 0.0)
    size = float(np.max(high / 2.0 - low / 2.0))
    unit = 2.0 ** min(np.floor(np.log2(size)) + 1.0, 1023.0) if size > 0.0 else 1.0
    placed = ((x - offset) / unit).astype(x.dtype)
    return (offset, unit) if (placed.astype(np.float64) * unit == x - offset).all() else unchanged


def _joined_groups(rigid: np.ndarray, weld: np.ndarray) -> np.ndarray:
    """Returns the rigid group of each vertex, -1 for none, in which those that share a doubled vertex are one."""
    (members,) = np.nonzero(rigid >= 0)
    _, first, group = np.unique(rigid[members], return_index=True, return_inverse=True)
    links = weld[np.stack([members[first][group.reshape(-1)], members], axis=1)]
    return np.where(np.isin(np.arange(len(rigid)), links), connect_cells(links, len(rigid)), -1)


def _with_edges_of(tetrahedra: np.ndarray, edges: np.ndarray, count: int) -> np.ndarray:
    """Returns edges, then those of tetrahedra that are not among them, each with the smaller vertex first."""
    sides = np.sort(tetrahedra[:, [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]]].reshape(-1, 2), axis=1)
    sides = np.unique(sides, axis=0)
    key = np.array([count, 1])
    return np.concatenate([edges, sides[~np.isin(sides @ key, edges.astype(np.int64) @ key)]])
