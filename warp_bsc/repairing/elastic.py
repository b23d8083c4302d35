"""Springs that keep the shape of the input, in the part of a surface that may move."""

import numpy as np
import warp as wp

from ..detection.at_rest.body_parts import connect_cells
from ..detection.run.launch import launch, launch_in_turn
from .contacts import Contacts, as_planes
from .kernels import Planes, grow_ring, relax_springs, spread_moves
from .surface import Surface, differ

_BENDING = 0.3
_SHORTEST = 10.0
"""Median length of an edge, in lengths of a spring, up to which shorter springs are stiffer, so that strains even out.
"""
_NOT_REACHED = 2**31 - 1
_INNER_SWEEPS = 200


def near(surface: Surface, vertices: np.ndarray, rings: int) -> np.ndarray:
    """Returns which vertices are within some edges of given ones and not fixed, bool, shape [n]."""
    return within(surface, vertices, rings) & ~surface.fixed


def within(surface: Surface, vertices: np.ndarray, rings: int) -> np.ndarray:
    """Returns which vertices are within some edges of given ones, a mask or indices, bool, shape [n]."""
    reached = np.zeros(len(surface.home), dtype=bool)
    reached[vertices] = True
    return _grown(reached, surface.device_edges, rings)


def _grown(reached: np.ndarray, edges: wp.array, rings: int) -> np.ndarray:
    """Returns which vertices are within some edges, whose vertices are given, of those that are reached."""
    if not reached.any():
        return reached
    ring_of = wp.array(np.where(reached, 0, _NOT_REACHED), dtype=int, device=edges.device)
    for ring in range(rings):
        launch(grow_ring, len(edges), inputs=[edges, ring], outputs=[ring_of], device=edges.device)
    return ring_of.numpy() < _NOT_REACHED


class Springs:
    """Springs along edges and across them, between the two vertices opposite an edge, at rest in the input.

    Attributes:
        movable: Vertices that they move, bool, shape [n].
    """

    def __init__(self, surface: Surface, movable: np.ndarray, bending: float = _BENDING):
        """Finds the springs that may move ``movable`` vertices, bool, shape [n].

        ``bending`` is the stiffness of those across edges, which keep dihedral angles, as a share of that of edges.
        """
        self._surface, self.movable = surface, movable
        vertices = self._vertices = np.flatnonzero(movable)
        first, second = surface.ends
        edges = np.flatnonzero(movable[first] | movable[second])
        self._edges = surface.array(surface.edges[edges], int)
        across = _vertices_across(surface, movable)
        self._ends = np.concatenate([surface.edges[edges], across])
        self._stiffness = np.repeat([1.0, bending], [len(edges), len(across)])
        both = np.concatenate([self._ends, self._ends[:, ::-1]])
        order = np.argsort(both[:, 0], kind="stable")
        order = self._order = order[movable[both[order, 0]]]
        starts = np.append(np.searchsorted(both[order, 0], vertices), len(order))
        self._springs = [surface.array(values, int) for values in (vertices, starts, both[order, 1])]
        self.rest_at(surface.home, surface.edge)

    def rest_at(self, x: np.ndarray, edge: float) -> None:
        """Lets the springs rest at positions, shape [n, 3], in any unit, that of :meth:`relax` from then on.

        ``edge`` is the median length of an edge there.
        """
        lengths = np.linalg.norm(x[self._ends[:, 1]] - x[self._ends[:, 0]], axis=1)
        shortness = np.clip(edge / np.maximum(lengths, 1e-30), 0.1, _SHORTEST)
        self._lengths, self._even, self._by_strain = (
            self._surface.array(np.tile(values, 2)[self._order], wp.float64)
            for values in (lengths, self._stiffness, self._stiffness * shortness**2)
        )

    def around(self, vertices: np.ndarray, rings: int) -> np.ndarray:
        """Returns the movable vertices within some edges, that springs follow, of given ones, bool, shape [n]."""
        return _grown(vertices, self._edges, rings) & self.movable

    def spread(self, moves: np.ndarray, given: np.ndarray, sweeps: int) -> np.ndarray:
        """Returns moves of all vertices, which join those of given vertices smoothly; Jacobi sweeps.

        Args:
            moves: Moves, 0 where not given, in units, shape [n, 3].
            given: Vertices whose moves stay, bool, shape [n].
            sweeps: Number of sweeps, about as many edges as moves spread over.
        """
        is_given = self._surface.array(given, bool)
        return self._sweep(spread_moves, len(self._vertices), [*self._springs, is_given], moves, sweeps)

    def relax(
        self,
        x: np.ndarray,
        sweeps: int,
        slack: float = 0.0,
        *,
        momentum: float = 0.0,
        contacts: Contacts | None = None,
        around: np.ndarray | None = None,
    ) -> np.ndarray:
        """Returns positions with strains that are smaller, or at most ``slack`` if there are enough sweeps.

        Args:
            x: Positions, in units, shape [n, 3].
            sweeps: Number of Jacobi sweeps.
            slack: Strain that needs no change.
            momentum: Share of the last move that each sweep makes once more, less than 1: more than 0 spreads strains
                as far as the square of as many sweeps, and evens out strains rather than changes of length.
            contacts: Contacts that are kept apart meanwhile, nearly; default: none.
            around: The movable vertices that move, bool, shape [n]; default: all.
        """
        planes, rows, count = Planes(), None, len(self._vertices)
        if contacts is not None and len(contacts.toi):
            row = np.where(self.movable, np.cumsum(self.movable) - 1, -1)
            planes = as_planes(contacts, row, self._surface.fixed, self._surface.device)
        if around is not None:
            (moving,) = np.nonzero(around[self._vertices])
            rows, count = self._surface.array(moving, int), len(moving)
        stiffness = self._by_strain if momentum else self._even
        numbers = wp.float64(slack), wp.float64(momentum)
        inputs = [rows, *self._springs, self._lengths, stiffness, planes, *numbers]
        return self._sweep(relax_springs, count, inputs, x, sweeps)

    def _sweep(self, kernel: wp.Kernel, dim: int, inputs: list, values: np.ndarray, sweeps: int) -> np.ndarray:
        """Returns values after some launches of a kernel that writes those of movable vertices."""
        given = self._surface.array(values)
        return launch_in_turn(kernel, dim, sweeps, inputs=inputs, values=[given, wp.clone(given)]).numpy()


def follow_surface(surface: Surface, x: np.ndarray) -> np.ndarray:
    """Returns positions at which the inner vertices of tetrahedra move as those around them move, and none inverts.

    A part with tetrahedra that have inverted, connected by vertices that have moved, is as in the input; other vertices
    of the surface keep their positions, which are in units, shape [n, 3].
    """
    tetrahedra = surface.tetrahedra
    if not len(tetrahedra):
        return x
    is_inner = np.zeros(len(x), dtype=bool)
    is_inner[tetrahedra] = True
    is_inner[surface.mesh.vertices] = is_inner[surface.fixed] = False
    if is_inner.any():
        moves = np.where(is_inner[:, None], 0.0, x - surface.home)
        spread = Springs(surface, is_inner).spread(moves, ~is_inner, _INNER_SWEEPS)
        x = surface.rounded(np.where(is_inner[:, None], surface.home + spread, x))
    inverted = np.setdiff1d(surface.inverted(x), surface.inverted(surface.home))
    if not len(inverted):
        return x
    moved = differ(x, surface.home)
    part = connect_cells(surface.edges[moved[surface.edges].all(axis=1)], len(x))
    restored = np.isin(part, part[tetrahedra[inverted]]) & moved
    return np.where(restored[:, None], surface.home, x)


def _vertices_across(surface: Surface, movable: np.ndarray) -> np.ndarray:
    """Returns the pairs of vertices opposite an edge in two of its faces, near movable vertices, int, shape [m, 2]."""
    mesh = surface.mesh
    (faces,) = np.nonzero((movable[mesh.faces] | movable[mesh.across]).any(axis=1))
    opposite, across = np.roll(mesh.faces[faces], 1, axis=1).ravel(), mesh.across[faces].ravel()
    # both faces of an edge have the pair
    rows = (opposite < across) & (movable[opposite] | movable[across])
    return np.stack([opposite[rows], across[rows]], axis=1)
