"""Keeps tetrahedra from inverting: moves their inner vertices along, or puts back what would invert."""

import numpy as np

from ..detection.at_rest.body_parts import connect_cells
from .elastic import Springs
from .surface import Surface, differ

_SWEEPS = 200


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
        spread = Springs(surface, is_inner).spread(moves, ~is_inner, _SWEEPS)
        x = surface.rounded(np.where(is_inner[:, None], surface.home + spread, x))
    inverted = np.setdiff1d(surface.inverted(x), surface.inverted(surface.home))
    if not len(inverted):
        return x
    moved = differ(x, surface.home)
    part = connect_cells(surface.edges[moved[surface.edges].all(axis=1)], len(x))
    restored = np.isin(part, part[tetrahedra[inverted]]) & moved
    return np.where(restored[:, None], surface.home, x)
