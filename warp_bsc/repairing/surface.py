"""The surface that is repaired: its mesh without doubled vertices, its input, and its exact checks."""

import functools
import time

import numpy as np
import warp as wp

from ..detection.detector import CollisionDetector
from ..detection.mesh import CollisionMesh

_WRECKED = 0.25
"""Median strain of edges that have moved above which a surface is no result."""


def weld_borders(mesh: CollisionMesh, positions: np.ndarray, *labels: np.ndarray) -> np.ndarray:
    """Returns for each vertex the first one that it is welded to, int, shape [n].

    The two sides of a seam are borders whose vertices have the same positions, world, groups and mask. Vertices inside
    a surface are not welded: there, two surfaces touch.

    Args:
        mesh: The mesh.
        positions: Positions of the vertices in one configuration or several, finite, shape [n, 3 k].
        labels: Only vertices of the same labels are welded, int, each of shape [n].
    """
    weld = np.arange(len(positions))
    border = np.bincount(mesh.face_edges.ravel() + 1, minlength=len(mesh.edges) + 1)[1:] == 1
    vertices = np.unique(mesh.edges[border])
    if len(vertices):
        bits = [values for values in (mesh.world, mesh.group, mesh.mask) if values is not None]
        keys = np.column_stack([values[vertices] for values in (positions, *labels, *bits)])
        _, firsts, numbers = np.unique(keys, axis=0, return_index=True, return_inverse=True)
        weld[vertices] = vertices[firsts[numbers.reshape(-1)]]
    return weld


def welded(mesh: CollisionMesh, weld: np.ndarray) -> CollisionMesh:
    """Returns the mesh whose faces and edges use no vertex that is welded to another one, with the same numbers."""
    if mesh.radius is None and not mesh.only_free and (weld == np.arange(len(weld))).all():
        return mesh
    edges = weld[mesh.edges[mesh.free_edges]]
    return CollisionMesh(
        weld[mesh.faces],
        mesh.vertex_count,
        edges=edges[edges[:, 0] != edges[:, 1]],
        points=weld[mesh.points],
        world=mesh.world,
        group=mesh.group,
        mask=mesh.mask,
        device=mesh.device,
    )


def differ(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Returns which rows of two arrays of vectors differ, bool, shape [n]."""
    differs = a != b
    return differs[:, 0] | differs[:, 1] | differs[:, 2]  # faster than any(axis=1)


class Surface:
    """A mesh without doubled vertices, the input, and what must stay. Positions are in units of its size.

    Attributes:
        mesh: The mesh, in which no face uses a doubled vertex.
        edges: Vertices of the edges of the mesh, then of the other edges of tetrahedra, int, shape [m, 2].
        ends: The first and the second vertices of the edges, shape [2, m].
        home: Input positions, in units, float64, shape [n, 3].
        fixed: Vertices that stay, and those that no element uses, bool, shape [n].
        unit: The unit, a power of 2, in the unit of the input.
        lengths: Length of each of the edges in the input, in units, float64, shape [m].
        edge: Median length of the edges.
        min_distance: Distance that elements keep, in units, 0 for none.
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
        tetrahedra: np.ndarray | None = None,
        counts_fixed: bool = True,
    ):
        """Prepares detection.

        Args:
            mesh: The mesh.
            x: Input positions, finite, float32 or float64, shape [n, 3].
            fixed: Vertices that stay, bool, shape [n].
            min_distance: Distance that elements keep, in the unit of the input.
            tetrahedra: Vertices of tetrahedra, whose inner vertices follow, int, shape [m, 4]; default: none.
            counts_fixed: Whether an edge and a face count as crossing if all of their vertices stay.
        """
        self.mesh, self._dtype, self._counts_fixed = mesh, x.dtype, counts_fixed
        self.edges = mesh.edges
        is_used = np.zeros(len(x), dtype=bool)
        is_used[mesh.vertices] = True
        if tetrahedra is not None and len(tetrahedra):
            is_used[tetrahedra] = True
            self.edges = _with_edges_of(tetrahedra, mesh.edges, len(x))
        self.ends = np.ascontiguousarray(self.edges.T)
        used = x[is_used].astype(np.float64)
        size = float(np.max(used.max(axis=0) - used.min(axis=0))) if len(used) else 0.0
        self.unit = 2.0 ** np.floor(np.log2(size)) if size > 0.0 else 1.0
        self._input, self._is_used = x, is_used[:, None]
        self.home = self.in_units(x)
        self.min_distance = min_distance / self.unit
        self.fixed = fixed | ~is_used
        self.lengths = self._lengths_of(self.home, slice(None))
        self.edge = float(np.median(self.lengths)) if len(self.lengths) else 1.0
        self.detector = CollisionDetector(mesh)
        self._finder = self.detector.intersection_finder()
        self._placed: tuple[np.ndarray, np.ndarray] | None = None

    @functools.cached_property
    def device_edges(self) -> wp.array:
        """Vertices of the edges on the device, shape [m, 2]."""
        return self.mesh.device_edges if self.edges is self.mesh.edges else self.array(self.edges, int)

    @functools.cached_property
    def distance_detector(self) -> CollisionDetector:
        """A detector of pairs that come within the minimum distance."""
        return CollisionDetector(self.mesh, min_distance=self.min_distance * self.unit)

    @property
    def is_late(self) -> bool:
        """Whether a search has to end."""
        return time.monotonic() > self.end

    def in_units(self, x: np.ndarray) -> np.ndarray:
        """Returns positions in units, float64; 0 for vertices that are not used."""
        return np.where(self._is_used, x, 0.0).astype(np.float64) / self.unit

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
        """Returns positions in units as those of the input: of its type, with its bits where nothing has moved."""
        if self._placed is None or self._placed[0] is not x:
            self.rounded(x)
        assert self._placed is not None
        return self._placed[1]

    def rounded(self, x: np.ndarray) -> np.ndarray:
        """Returns positions in units as they will be returned, rounded to the type of the input.

        Those that were rounded last are looked at next: their :meth:`positions` are kept, so they must not be changed.
        """
        rounded, positions = self.home.copy(), self._input.copy()
        (rows,) = np.nonzero(differ(x, self.home))
        with np.errstate(over="ignore"):
            moved = (x[rows] * self.unit).astype(self._dtype)
        stays = x[rows] == self.home[rows]
        positions[rows] = np.where(stays, positions[rows], moved)
        rounded[rows] = np.where(stays, rounded[rows], moved.astype(np.float64) / self.unit)
        self._placed = rounded, positions
        return rounded

    def crossings(self, x: np.ndarray) -> np.ndarray:
        """Returns the edges that meet faces at positions in units, exactly, as returned: (edge, face), shape [n, 2]."""
        pairs = self._finder.find(self.positions(x)).pairs
        return pairs if self._counts_fixed else pairs[~self.are_fixed(pairs)]

    def are_fixed(self, crossings: np.ndarray) -> np.ndarray:
        """Returns whether all vertices of edges and faces that cross are fixed, bool, shape [m]."""
        ends, corners = self.mesh.edges[crossings[:, 0]], self.mesh.faces[crossings[:, 1]]
        return np.asarray(self.fixed[ends].all(axis=1) & self.fixed[corners].all(axis=1))

    @property
    def device(self) -> wp.Device:
        """The Warp device."""
        return self.mesh.device

    def array(self, values: np.ndarray, dtype: type = wp.vec3d) -> wp.array:
        """Returns an array on the device."""
        return wp.array(values, dtype=dtype, device=self.device)


def _with_edges_of(tetrahedra: np.ndarray, edges: np.ndarray, count: int) -> np.ndarray:
    """Returns edges, then those of tetrahedra that are not among them, each with the smaller vertex first."""
    sides = np.sort(tetrahedra[:, [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]]].reshape(-1, 2), axis=1)
    sides = np.unique(sides, axis=0)
    key = np.array([count, 1])
    return np.concatenate([edges, sides[~np.isin(sides @ key, edges.astype(np.int64) @ key)]])
