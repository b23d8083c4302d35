"""Tetrahedra: whether and when a moving one becomes flat or inverted."""

import numpy as np
from numpy.typing import ArrayLike

from .._arguments import checked_coordinates
from .coordinates import as_integers, decompose, flattened, scale_to_floats
from .polynomials import add, cross, dot, negate, sign_at, trim
from .roots import doubles_around, inner_part, isolated_roots

_MARGIN = 1e-12
"""More than the error of a Bernstein coefficient of the volume, see :func:`_may_invert`."""


def tetrahedron(points: ArrayLike) -> np.ndarray:
    """Returns which moving tetrahedra invert: their volume is 0 or negative at some time of the closed step.

    Six times the volume of a b c d is (d - a) . ((b - a) x (c - a)).

    Args:
        points: Positions, float32 or float64 array of shape (n, 8, 3), rows a0 b0 c0 d0 a1 b1 c1 d1: vertices at the
            start (0) and at the end (1) of the step.

    Returns:
        Bool array of shape (n,).

    Raises:
        TypeError: If the points are no array of numbers.
        ValueError: If their shape or type is wrong, entries are masked, or a coordinate is not finite.
    """
    points = checked_coordinates(points, (8, 3), "points")
    inverts = _may_invert(points)
    (unsure,) = np.nonzero(inverts)
    inverts[unsure] = [_first_time(f) is not None for f in _volumes(points[unsure])]
    return inverts


def tetrahedron_toi(points: ArrayLike) -> np.ndarray:
    """Returns bounds of the first time at which moving tetrahedra are flat or inverted.

    Args:
        points: As in :func:`tetrahedron`.

    Returns:
        Float64 array of shape (n, 2): the largest double that is not after that time, and the smallest one that is not
        before it, NaN for none.

    Raises:
        TypeError: As in :func:`tetrahedron`.
        ValueError: As in :func:`tetrahedron`.
    """
    points = checked_coordinates(points, (8, 3), "points")
    toi = np.full((len(points), 2), np.nan)
    (unsure,) = np.nonzero(_may_invert(points))
    for row, f in zip(unsure, _volumes(points[unsure]), strict=True):
        if (time := _first_time(f)) is not None:
            toi[row] = doubles_around(*time)
    return toi


def _may_invert(points) -> np.ndarray:
    """Returns which tetrahedra need exact arithmetic, bool (n,): of the others the volume is proven to be positive.

    The volume is positive if its Bernstein coefficients are. The bound, u = 2^-53: coordinates are scaled to at most 1,
    differences off by 2 u. A coefficient is a mean of at most 18 products of three of them, below 8 each, with at most
    24 roundings: off by less than 18 * 8 (3 + 24) u < 1e-12.
    """
    scaled = scale_to_floats(*decompose(flattened(points))).reshape(points.shape)
    sides = scaled.reshape(-1, 2, 4, 3)
    u, v, w = (sides[:, :, i] - sides[:, :, 0] for i in (1, 2, 3))

    def volume(i, j, k):
        return (w[:, i] * np.cross(u[:, j], v[:, k])).sum(axis=1)

    coefficients = [
        volume(0, 0, 0),
        (volume(1, 0, 0) + volume(0, 1, 0) + volume(0, 0, 1)) / 3.0,
        (volume(0, 1, 1) + volume(1, 0, 1) + volume(1, 1, 0)) / 3.0,
        volume(1, 1, 1),
    ]
    return np.array(np.stack(coefficients).min(axis=0) <= _MARGIN)


def _volumes(points):
    """Yields the volume of each tetrahedron, times some positive number: an integer polynomial in time."""
    for query in as_integers(points).reshape(-1, 2, 4, 3).tolist():
        a, b, c, d = ([[x, y - x] for x, y in zip(*ends, strict=True)] for ends in zip(*query, strict=True))
        u, v, w = ([add(f, negate(g)) for f, g in zip(x, a, strict=True)] for x in (b, c, d))
        yield trim(dot(w, cross(u, v)))


def _first_time(f):
    """Returns the first root or time at which a polynomial is not positive, as :func:`.roots.doubles_around` takes it.

    None if it is positive in the whole closed step.
    """
    if sign_at(f, 0) <= 0:
        return None, 0, 0
    inner = inner_part(f)
    for lower, upper in isolated_roots(inner):
        return inner, lower, upper
    return (None, 1, 1) if sign_at(f, 1) == 0 else None
