"""Keeps tetrahedra from inverting: decides their orientation exactly, and moves their inner vertices along."""

from fractions import Fraction

import numpy as np

from ..detection.at_rest.body_parts import connect_cells
from .elastic import Springs
from .surface import Surface, differ

_ROUNDOFF = 2.0**-48
"""Bound on the rounding error of a determinant of differences, as a share of the product of their magnitudes."""
_SWEEPS = 200


def are_inverted(x: np.ndarray, tetrahedra: np.ndarray) -> np.ndarray:
    """Returns which tetrahedra have a volume that is not positive, exactly, bool, shape [m].

    Args:
        x: Positions, finite, float32 or float64, shape [n, 3].
        tetrahedra: Their vertices, int, shape [m, 4].
    """
    corners = x[tetrahedra].astype(np.float64)
    sides = corners[:, 1:] - corners[:, :1]
    volume = np.einsum("ij,ij->i", sides[:, 0], np.cross(sides[:, 1], sides[:, 2]))
    # the rounding of a difference is relative to the coordinates, not to the difference
    size = np.abs(corners).max(axis=(1, 2)) * 2.0**-52 + np.abs(sides).max(axis=(1, 2))
    bound = _ROUNDOFF * np.abs(corners).max(axis=(1, 2)) * size**2 * 12.0
    inverted = volume <= 0.0
    for row in np.flatnonzero(~(np.abs(volume) > bound)):
        a, b, c, d = ([Fraction(float(value)) for value in corner] for corner in corners[row])
        u, v, w = ([p - q for p, q in zip(corner, a, strict=True)] for corner in (b, c, d))
        normal = (v[1] * w[2] - v[2] * w[1], v[2] * w[0] - v[0] * w[2], v[0] * w[1] - v[1] * w[0])
        inverted[row] = sum(p * q for p, q in zip(u, normal, strict=True)) <= 0
    return inverted


def follow_surface(surface: Surface, x: np.ndarray) -> np.ndarray:
    """Returns positions at which the inner vertices of tetrahedra move as those around them move, and none inverts.

    A part with tetrahedra that have inverted, connected by vertices that have moved, is as in the input.

    Args:
        surface: The surface.
        x: Positions, in units, shape [n, 3]. Vertices of the surface keep them, unless their part does not.
    """
    tetrahedra = surface.tetrahedra
    is_inner = np.zeros(len(x), dtype=bool)
    is_inner[tetrahedra] = True
    is_inner[surface.mesh.vertices] = False
    is_inner &= ~surface.fixed
    if is_inner.any():
        moves = np.where(is_inner[:, None], 0.0, x - surface.home)
        spread = Springs(surface, is_inner).spread(moves, ~is_inner, _SWEEPS)
        x = surface.rounded(np.where(is_inner[:, None], surface.home + spread, x))
    inverted = are_inverted(surface.detected(x), tetrahedra) & ~are_inverted(surface.detected(surface.home), tetrahedra)
    if not inverted.any():
        return x
    moved = differ(x, surface.home)
    part = connect_cells(surface.edges[moved[surface.edges].all(axis=1)], len(x))
    restored = np.isin(part, part[tetrahedra[inverted]]) & moved
    return np.where(restored[:, None], surface.home, x)
