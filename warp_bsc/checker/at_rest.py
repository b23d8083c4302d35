"""Edges, rays and faces at one moment."""

import numpy as np
from numpy.typing import ArrayLike

from .._arguments import checked_coordinates
from .coordinates import as_integers
from .queries import VERTEX_FACE, collides, undecided_triangles

_RAY_ERROR = 2.0**-49  # relative to sums of absolute values: more than 8 roundings of 2^-53, see _ray_signs
_RAY_UNDERFLOW = 2.0**-900  # more than the underflow there


def edge_face_crossings(edges: ArrayLike, faces: ArrayLike) -> np.ndarray:
    """Returns which edges meet which faces, pair by pair, at one moment: closed segments, closed triangles.

    Args:
        edges: End points, float32 or float64 array of shape (n, 2, 3).
        faces: Corners, float32 or float64 array of shape (n, 3, 3).

    Returns:
        Bool array of shape (n,).

    Raises:
        TypeError: If an argument is no array of numbers.
        ValueError: If a shape or a type is wrong, the lengths differ, or a coordinate is not finite.
    """
    edges, faces = _checked_pairs(edges, faces)
    points = np.concatenate([edges[:, :1], faces, edges[:, 1:], faces], axis=1)
    return collides(undecided_triangles(points, VERTEX_FACE), np.zeros(len(points), dtype=bool))


def edges_pass_faces(edges: ArrayLike, faces: ArrayLike, across: ArrayLike) -> np.ndarray:
    """Returns which edges pass through which faces, pair by pair, at one moment.

    The ends of the edge are strictly on different sides of the face's plane, and it meets the inside of the face.
    Or it meets the inside of a side that the face shares with a neighbour, and its ends are strictly on different sides
    of the surface that both are. All other edges only touch their face: they end in it, or pass its border.

    Args:
        edges: End points, float32 or float64 array of shape (n, 2, 3).
        faces: Corners a, b, c, float32 or float64 array of shape (n, 3, 3).
        across: Third corners of the neighbours at the sides ab, bc and ca, array of the same type and shape; the face's
            own opposite corner, c, a or b, where it has no neighbour.

    Returns:
        Bool array of shape (n,).

    Raises:
        TypeError: If an argument is no array of numbers.
        ValueError: If a shape or a type is wrong, the lengths differ, or a coordinate is not finite.
    """
    edges, faces = _checked_pairs(edges, faces)
    across = checked_coordinates(across, (3, 3), "across")
    if len(across) != len(faces):
        raise ValueError(f"faces and across must have the same length, got {len(faces)} and {len(across)}")
    p, q, *corners = as_integers(np.concatenate([edges, faces, across], axis=1)).transpose(1, 2, 0)
    corners, across = corners[:3], corners[3:]

    def side(x, y, z):
        return np.sign((x * np.cross(y, z, axis=0)).sum(axis=0)).astype(int)

    a, b, c = corners
    start, end = side(p - a, b - a, c - a), side(q - a, b - a, c - a)
    passed = np.stack([side(q - p, corners[i] - p, corners[i - 2] - p) for i in range(3)])
    # Through a common side, the ends are in opposite directions from it: each is on one side of both faces, or none is.
    beyond = [side(p - corners[i], corners[i] - corners[i - 2], across[i] - corners[i - 2]) for i in range(3)]
    through_side = ((passed == 0) & (np.stack(beyond) == start)).any(axis=0) & (np.abs(passed.sum(axis=0)) == 2)
    return (start * end < 0) & ((np.abs(passed.sum(axis=0)) == 3) | through_side)


def rays_pass_faces(points: ArrayLike, faces: ArrayLike) -> np.ndarray:
    """Returns how rays from points along +x pass through faces, pair by pair.

    Each ray is moved off by (0, e, e^2) for an infinitely small e > 0. It then meets no edge and no vertex, so that for
    all faces of a closed, oriented surface the results add up to the number of times that the surface winds around the
    point, if the point is not on the surface. Points on a face count as if the face were behind them.

    Args:
        points: float32 or float64 array of shape (n, 3).
        faces: Corners, counterclockwise seen from outside, array of shape (n, 3, 3).

    Returns:
        Int8 array of shape (n,): 1 if the ray comes out through the face, -1 if it goes in, 0 if it does not meet it.

    Raises:
        TypeError: If an argument is no array of numbers.
        ValueError: If a shape or a type is wrong, the lengths differ, or a coordinate is not finite.
    """
    points = checked_coordinates(points, (3,), "points")
    faces = checked_coordinates(faces, (3, 3), "faces")
    if len(points) != len(faces):
        raise ValueError(f"points and faces must have the same length, got {len(points)} points and {len(faces)} faces")
    corners = np.concatenate([faces, points[:, None]], axis=1)
    signs, is_certain = _ray_signs(corners.astype(np.float64), is_exact=False)
    (unsure,) = np.nonzero(~is_certain)
    if len(unsure):
        signs[unsure], _ = _ray_signs(as_integers(corners[unsure]), is_exact=True)
    return signs


def _ray_signs(corners, is_exact):
    """Returns the results of :func:`rays_pass_faces`, and which are certain, for corners a, b, c and the point.

    In floating point, differences are off by one rounding, a turn by less than 4, a volume by less than 8 roundings of
    the sum of its absolute values.
    """
    with np.errstate(all="ignore"):  # what overflows is not certain
        sides = corners[:, :3] - corners[:, 3:]  # from the point
        x, y, z = sides.transpose(2, 1, 0)
        products = [(y[i] * z[i - 2], z[i] * y[i - 2]) for i in range(3)]  # of corners i and i - 2, the next one
        turns = np.stack([first - second for first, second in products])
        volume = (x[[2, 0, 1]] * turns).sum(axis=0)
        certain = np.ones(len(corners), dtype=bool)
        sign_of_turns, sign = np.sign(turns).astype(int), np.sign(volume).astype(int)
        if is_exact:  # a ray through the line of an edge is moved off
            for i in range(3):
                along_y, along_z = (np.sign(axis[i - 2] - axis[i]).astype(int) for axis in (y, z))
                aside = np.where(along_z != 0, -along_z, along_y)
                sign_of_turns[i] = np.where(sign_of_turns[i] == 0, aside, sign_of_turns[i])
        else:
            sizes = np.stack([np.abs(first) + np.abs(second) for first, second in products])
            is_sure = np.abs(turns) > _RAY_ERROR * sizes + _RAY_UNDERFLOW
            most = (np.abs(x[[2, 0, 1]]) * sizes).sum(axis=0)
            is_volume_sure = np.abs(volume) > _RAY_ERROR * most + _RAY_UNDERFLOW
            sure_signs = sign_of_turns * is_sure
            passes_by = (sure_signs > 0).any(axis=0) & (sure_signs < 0).any(axis=0)
            certain = passes_by | (is_sure.all(axis=0) & is_volume_sure)
    through = np.where(np.abs(sign_of_turns.sum(axis=0)) == 3, sign_of_turns[0], 0)
    return np.where(sign == through, through, 0).astype(np.int8), certain


def _checked_pairs(edges, faces):
    """Returns edges and faces as arrays; raises ValueError if they are not, or their lengths differ."""
    edges = checked_coordinates(edges, (2, 3), "edges")
    faces = checked_coordinates(faces, (3, 3), "faces")
    if len(edges) != len(faces):
        raise ValueError(f"edges and faces must have the same length, got {len(edges)} edges and {len(faces)} faces")
    return edges, faces
