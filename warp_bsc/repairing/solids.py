"""Puts vertices that are inside a solid outside of it, part by part, on the shortest way that keeps a part whole."""

import numpy as np

from ..detection.at_rest.body_parts import connect_cells
from .closest import closest_points, exit_distances
from .elastic import Springs, near
from .surface import Surface

_GAP = 0.25
"""Distance from the solid at which a vertex is put, in edges."""
_SAMPLES = 16
"""Vertices of a part whose own ways out are tried as the direction of all."""
_LONGEST = 1.5
"""Longest way in a common direction, as a multiple of the longest way to the closest points, with which all vertices
of a part take it. What wraps around a solid, such as a sleeve, leaves it on all sides instead."""
_RINGS = _SWEEPS = 12
"""Edges over which moves out of solids spread."""


def leave_solid(surface: Surface, x: np.ndarray, faces: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """Returns the moves of vertices inside a solid that put them outside, in units, shape [m, 3].

    Positions ``x`` of the surface are in units, shape [n, 3]; ``faces`` are those of the solid, and the vertices, shape
    [m], are sorted.
    """
    closest, normals = closest_points(surface, x, faces, x[vertices])
    ways = closest - x[vertices]
    depths = np.linalg.norm(ways, axis=1)
    moves = ways + _GAP * surface.edge * normals
    is_inside = np.zeros(len(x), dtype=bool)
    is_inside[vertices] = True
    part = connect_cells(surface.edges[is_inside[surface.edges].all(axis=1)], len(x))[vertices]
    for number in np.unique(part):
        (rows,) = np.nonzero(part == number)
        direction, exits = _common_way(surface, x, faces, vertices[rows], ways[rows])
        if exits.max() <= _LONGEST * depths[rows].max():
            moves[rows] = (exits[:, None] + _GAP * surface.edge) * direction
    return moves


def leave_solid_whole(
    surface: Surface, x: np.ndarray, faces: np.ndarray, vertices: np.ndarray, body: np.ndarray, moves: np.ndarray
) -> None:
    """Writes the moves of all vertices that put the bodies of vertices inside a solid outside of it.

    Arguments are those of :func:`leave_solid`, the body of each vertex, which moves as a whole, int, shape [n], and the
    moves, in units, shape [n, 3].
    """
    closest, _ = closest_points(surface, x, faces, x[vertices])
    for number in np.unique(body[vertices]):
        (rows,) = np.nonzero(body[vertices] == number)
        direction, exits = _common_way(surface, x, faces, vertices[rows], (closest - x[vertices])[rows])
        if np.isfinite(exits).all():
            moves[body == number] = (exits.max() + _GAP * surface.edge) * direction


def _common_way(
    surface: Surface, x: np.ndarray, faces: np.ndarray, vertices: np.ndarray, ways: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the direction in which vertices leave a solid soonest, all of them, and how far each one is from outside.

    ``ways`` are theirs to the closest points of the solid, in units, shape [m, 3].
    """
    deepest = np.argsort(-np.linalg.norm(ways, axis=1), kind="stable")
    chosen = deepest[np.linspace(0, len(ways) - 1, _SAMPLES).astype(int)]
    directions = np.concatenate([ways[chosen], ways.sum(axis=0, keepdims=True)])
    lengths = np.linalg.norm(directions, axis=1)
    if not lengths.any():
        return np.zeros(3), np.full(len(vertices), np.inf)
    directions = directions[lengths > 0.0] / lengths[lengths > 0.0, None]
    exits = exit_distances(surface, x, faces, x[vertices], directions)
    best = np.argmin(exits.max(axis=0))
    return directions[best], exits[:, best]


def spread_exits(
    surface: Surface, x: np.ndarray, moves: np.ndarray, moved: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Returns positions after moves of some vertices that others join, and which vertices may have moved.

    Positions, and moves, 0 where there are none, are in units, shape [n, 3]; ``moved`` are the vertices that they are
    for, bool, shape [n].
    """
    reach = near(surface, np.flatnonzero(moved), _RINGS)
    return surface.rounded(x + Springs(surface, reach).spread(moves, moved, _SWEEPS)), reach
