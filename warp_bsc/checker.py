"""Decides queries exactly in rational arithmetic: Python integers and NumPy, no Warp, no Bernstein signs.

What counts as a collision
--------------------------
Each point moves as x(t) = (1-t) x0 + t x1, its coordinates being exactly the floating-point numbers given. A
vertex-face pair collides when some t in the closed [0, 1] puts the point in the closed triangle; an edge-edge pair when
the closed segments meet at some t in the closed [0, 1]. Triangles and segments may degenerate. With a minimum distance
d, exactly the number given, a pair collides when some t in the closed [0, 1] puts its closed features within the closed
distance d of each other.

One question
------------
Every query asks whether a moving triangle with corners x(t), y(t), z(t) contains the origin:

- vertex-face: p is in the triangle a b c when the origin is in the triangle a-p, b-p, c-p;
- edge-edge: the differences of points of ab and of cd fill the parallelogram a-c, b-c, b-d, a-d. Its diagonal cuts it
  into two triangles, and the segments meet when one of these contains the origin;
- an edge meets a face when a vertex that runs along the edge meets the face at rest.

The answer at one time
----------------------
Let X = y x z, Y = z x x, Z = x x y (cross products), n = X + Y + Z (the normal) and volume = x.X.

- When the triangle contains the origin, volume = 0. Let it be so.
- When n != 0, the origin is in the triangle's plane, as x.n = y.n = z.n = volume. Its barycentric coordinates are n.X,
  n.Y and n.Z, each divided by n.n, which is their sum. It is in the triangle when none is negative.
- All three are zero exactly when n = 0. The triangle is then the union of its edges, and the origin is on the segment
  xy exactly when Z = 0 and x.y <= 0, for x = y and x = 0 too.

All are polynomials in t with integer coefficients, once a power of two has made the coordinates integers.

The times to look at
--------------------
The times of contact form a closed set, so there is a first one, t*. It is 0, or a root of

- volume, when that is not identically zero;
- else, when the origin always is in the plane, Z.Z of an edge xy, or x.y where Z is identically zero: were n(t*) != 0
  and all three barycentric coordinates positive, they would be so just before t* too, where there is no contact yet.
  So the origin is on an edge at t*: Z = 0 and x.y <= 0 there, and just before t* one of the two is not so.

A root of f is held between two times that are not roots, and the sign of q there comes from the theorem of Sturm and
Tarski: from the first time to the second, the sequence of signed remainders that starts with f and f' q loses as many
changes of sign as f has distinct roots between them with q > 0, less those with q < 0. With q = 1 it counts the roots.

A minimum distance
------------------
The differences of the points of two features fill a moving polygon: one point for two vertices, a segment for a vertex
and an edge, a triangle for a vertex and a face, a parallelogram for two edges. The query asks whether its distance from
the origin is at most d at some time. With corners q and r of a side, e = r - q and the polygon's normal n, the polygon
is within d at one time exactly when

- a corner is: q.q <= d^2;
- or a side is, with the foot of the perpendicular between its ends: e != 0, q.e <= 0 <= r.e, and
  |q x r|^2 <= d^2 e.e;
- or the plane is, with the foot inside: n != 0, n.(q x r) >= 0 for all sides, and (q.n)^2 <= d^2 n.n.

Each is a polynomial of degree at most 6. At the first time t* > 0 of the closed set of such times the distance is d,
and the closest point is a corner, or inside a side with e != 0, or inside the polygon with n != 0, because a polygon
without a normal is the union of its sides, and a side without length is a corner. In each case the line's last
condition is an equation at t*. Its polynomial is not identically zero: the foot moves continuously, so that it would be
inside, at the distance d, just before t* as well. Thus t* is 0 or a root of the last polynomial of a line, and the
other conditions of that line hold there.
"""

import bisect
import functools
import itertools
import math
from collections.abc import Callable, Iterable
from fractions import Fraction

import numpy as np
from numpy.typing import ArrayLike

from ._arguments import checked_coordinates, checked_distances

__all__ = [
    "edge_edge",
    "edge_edge_toi",
    "edge_face_crossings",
    "edges_pass_faces",
    "rays_pass_faces",
    "vertex_edge",
    "vertex_edge_toi",
    "vertex_face",
    "vertex_face_toi",
    "vertex_vertex",
    "vertex_vertex_toi",
]

# The triangles of a query, each corner a difference of two of its four points (first minus second).
_VERTEX_FACE = np.array([[(1, 0), (2, 0), (3, 0)]])
_EDGE_EDGE = np.array([[(0, 2), (1, 2), (1, 3)], [(0, 2), (1, 3), (0, 3)]])

# The polygon of a query, its corners in order around it, each a difference of two of its points.
_POLYGONS = {
    "vertex_vertex": np.array([(0, 1)]),
    "vertex_edge": np.array([(0, 1), (0, 2)]),
    "vertex_face": np.array([(0, 1), (0, 2), (0, 3)]),
    "edge_edge": np.array([(0, 2), (1, 2), (1, 3), (0, 3)]),
}

_BLOCK = 8192  # queries that go through the filter together: arrays of this length stay in the processor's cache
_PIECES = 8  # into which the filter cuts the step
_MARGIN = 1e-10  # more than the error of any value in the filter, see _may_touch
_RAY_ERROR = 2.0**-49  # relative to sums of absolute values: more than 8 roundings of 2^-53, see _ray_signs
_RAY_UNDERFLOW = 2.0**-900  # more than what underflows there
_HALVINGS = 7  # of the step in the filter of minimum distances
_DISTANCE_MARGIN = 1e-12  # more than the error of any value in it, see _near_by_filter


def vertex_face(points: ArrayLike, min_distance: ArrayLike = 0.0) -> np.ndarray:
    """Returns which vertex-face queries collide.

    Args:
        points: Positions, float32 or float64 array of shape (n, 8, 3), rows p0 a0 b0 c0 p1 a1 b1 c1.
        min_distance: Distance up to which a pair collides, in the unit of the positions, 0 or at least 2^-1021, taken
            as exact: one for all queries, or one each, shape (n,).

    Returns:
        Bool array of shape (n,).

    Raises:
        TypeError: If an argument is no number or array of numbers.
        ValueError: If a shape or a type is wrong, entries are masked, a coordinate is not finite, or a distance is out
            of range.
    """
    return _answer(_collides, "vertex_face", points, min_distance)


def edge_edge(points: ArrayLike, min_distance: ArrayLike = 0.0) -> np.ndarray:
    """Returns which edge-edge queries collide.

    Args:
        points: Positions, float32 or float64 array of shape (n, 8, 3), rows a0 b0 c0 d0 a1 b1 c1 d1; edges ab and cd.
        min_distance: As in :func:`vertex_face`.

    Returns:
        Bool array of shape (n,).

    Raises:
        ValueError: As in :func:`vertex_face`.
    """
    return _answer(_collides, "edge_edge", points, min_distance)


def vertex_edge(points: ArrayLike, min_distance: ArrayLike = 0.0) -> np.ndarray:
    """Returns which vertex-edge queries collide.

    Args:
        points: Positions, float32 or float64 array of shape (n, 6, 3), rows p0 a0 b0 p1 a1 b1; vertex p and edge ab.
        min_distance: As in :func:`vertex_face`.

    Returns:
        Bool array of shape (n,).

    Raises:
        ValueError: As in :func:`vertex_face`.
    """
    return _answer(_collides, "vertex_edge", points, min_distance)


def vertex_vertex(points: ArrayLike, min_distance: ArrayLike = 0.0) -> np.ndarray:
    """Returns which vertex-vertex queries collide.

    Args:
        points: Positions, float32 or float64 array of shape (n, 4, 3), rows p0 q0 p1 q1; vertices p and q.
        min_distance: As in :func:`vertex_face`.

    Returns:
        Bool array of shape (n,).

    Raises:
        ValueError: As in :func:`vertex_face`.
    """
    return _answer(_collides, "vertex_vertex", points, min_distance)


def vertex_face_toi(points: ArrayLike, min_distance: ArrayLike = 0.0) -> np.ndarray:
    """Returns bounds of the earliest contact time of vertex-face queries.

    Args:
        points: As in :func:`vertex_face`.
        min_distance: As in :func:`vertex_face`.

    Returns:
        Float64 array of shape (n, 2): the largest double that is not after the earliest contact, and the smallest one
        that is not before it. They are equal when that time is a double, neighbours otherwise, NaN for no collision.

    Raises:
        ValueError: As in :func:`vertex_face`.
    """
    return _answer(_earliest, "vertex_face", points, min_distance)


def edge_edge_toi(points: ArrayLike, min_distance: ArrayLike = 0.0) -> np.ndarray:
    """Returns bounds of the earliest contact time of edge-edge queries.

    Args:
        points: As in :func:`edge_edge`.
        min_distance: As in :func:`vertex_face`.

    Returns:
        Float64 array of shape (n, 2), as in :func:`vertex_face_toi`.

    Raises:
        ValueError: As in :func:`vertex_face`.
    """
    return _answer(_earliest, "edge_edge", points, min_distance)


def vertex_edge_toi(points: ArrayLike, min_distance: ArrayLike = 0.0) -> np.ndarray:
    """Returns bounds of the earliest contact time of vertex-edge queries.

    Args:
        points: As in :func:`vertex_edge`.
        min_distance: As in :func:`vertex_face`.

    Returns:
        Float64 array of shape (n, 2), as in :func:`vertex_face_toi`.

    Raises:
        ValueError: As in :func:`vertex_face`.
    """
    return _answer(_earliest, "vertex_edge", points, min_distance)


def vertex_vertex_toi(points: ArrayLike, min_distance: ArrayLike = 0.0) -> np.ndarray:
    """Returns bounds of the earliest contact time of vertex-vertex queries.

    Args:
        points: As in :func:`vertex_vertex`.
        min_distance: As in :func:`vertex_face`.

    Returns:
        Float64 array of shape (n, 2), as in :func:`vertex_face_toi`.

    Raises:
        ValueError: As in :func:`vertex_face`.
    """
    return _answer(_earliest, "vertex_vertex", points, min_distance)


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
    return _collides(_undecided_triangles(points, _VERTEX_FACE), np.zeros(len(points), dtype=bool))


def edges_pass_faces(edges: ArrayLike, faces: ArrayLike, across: ArrayLike) -> np.ndarray:
    """Returns which edges pass through which faces, pair by pair, at one moment.

    The ends of such an edge are strictly on different sides of the face's plane, and it meets the inside of the face.
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
    p, q, *corners = _integers(np.concatenate([edges, faces, across], axis=1)).transpose(1, 2, 0)
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
    all faces of a closed, oriented surface the answers add up to the number of times that the surface winds around the
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
    answer, is_certain = _ray_signs(corners.astype(np.float64), is_exact=False)
    (unsure,) = np.nonzero(~is_certain)
    if len(unsure):
        answer[unsure], _ = _ray_signs(_integers(corners[unsure]), is_exact=True)
    return answer


def _ray_signs(corners, is_exact):
    """Returns the answers of :func:`rays_pass_faces`, and which are certain, for corners a, b, c and the point.

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
    """Returns edges and faces as arrays; raises ValueError if they are none, or no pairs."""
    edges = checked_coordinates(edges, (2, 3), "edges")
    faces = checked_coordinates(faces, (3, 3), "faces")
    if len(edges) != len(faces):
        raise ValueError(f"edges and faces must have the same length, got {len(edges)} edges and {len(faces)} faces")
    return edges, faces


def _answer(
    ask: Callable[[Iterable, np.ndarray], np.ndarray], kind: str, points: ArrayLike, min_distance: ArrayLike
) -> np.ndarray:
    """Returns what ``ask`` makes of the queries of a kind; raises ValueError as :func:`vertex_face`."""
    points = checked_coordinates(points, (2 * (_POLYGONS[kind].max() + 1), 3), "points")
    distance = np.broadcast_to(checked_distances(min_distance, "min_distance", len(points)), len(points))
    answer = np.zeros(len(points), dtype=bool) if ask is _collides else np.full((len(points), 2), np.nan)
    triangles = {"vertex_face": _VERTEX_FACE, "edge_edge": _EDGE_EDGE}.get(kind)
    touching = (distance == 0.0) & (triangles is not None)
    if touching.any():
        answer[touching] = ask(_undecided_triangles(points[touching], triangles), answer[touching])
    which = np.flatnonzero(~touching)
    near, hit = _near_by_filter(points[which], _POLYGONS[kind], distance[which])
    if ask is _collides:
        answer[which[hit]] = True
        near &= ~hit
    which = which[near]
    answer[which] = ask(_polygons(points[which], _POLYGONS[kind], distance[which]), answer[which])
    return answer


def _collides(undecided, hit):
    """Returns which queries collide, bool (n,): those that ``hit`` has, and the undecided ones that have a contact."""
    for query, shape in undecided:
        hit[query] = hit[query] or any(True for _ in _contacts(shape))
    return hit


def _earliest(undecided, toi):
    """Returns the doubles around each query's earliest contact, float64 (n, 2), NaN as in ``toi`` where none is."""
    for query, shape in undecided:
        for contact in _contacts(shape):
            # Rounding is monotone, so the earlier of two times has the smaller bounds.
            toi[query] = np.fmin(toi[query], _doubles_around(*contact))
    return toi


def _undecided_triangles(points, pairs):
    """Yields (query, _Triangle) for every triangle that the filter leaves to exact arithmetic, query by query."""
    for start in range(0, len(points), _BLOCK):
        block = points[start : start + _BLOCK]
        queries, triangles = np.nonzero(_may_touch(block, pairs))
        corners = _corners(_integers(block[queries]), pairs)[np.arange(len(queries)), triangles]
        for query, (x, y, z) in zip(queries, np.moveaxis(corners, 2, 3).tolist(), strict=True):
            yield start + query, _Triangle(*([[a, b - a] for a, b in corner] for corner in (x, y, z)))


def _polygons(points, pairs, distance):
    """Yields (query, _Polygon) for every query."""
    # the distance as one more coordinate, scaled with the others
    parts = zip(
        _decomposed(points.reshape(len(points), 3 * points.shape[1])), _decomposed(distance[:, None]), strict=True
    )
    integers = _scaled_integers(*(np.concatenate(part, axis=1) for part in parts))
    corners = np.moveaxis(_corners(integers[:, :-1].reshape(points.shape), pairs), 2, 3)
    for query, (polygon, d) in enumerate(zip(corners.tolist(), integers[:, -1].tolist(), strict=True)):
        yield query, _Polygon([[[a, b - a] for a, b in corner] for corner in polygon], d)


def _corners(points, pairs):
    """Returns the corners of the queries' polygons around the origin: shape (n, ..., corners, 2 ends, 3)."""
    points = points.reshape(len(points), 2, points.shape[1] // 2, 3)
    return np.moveaxis(points[:, :, pairs[..., 0]] - points[:, :, pairs[..., 1]], 1, -2)


def _decomposed(points):
    """Returns integers m, e with points = m 2^e, from their bits: a processor may take subnormal numbers for zero."""
    stored = np.finfo(points.dtype).nmant
    bits = np.ascontiguousarray(points).view(f"i{points.itemsize}").astype(np.int64)
    field = (bits >> stored) & (2 ** (8 * points.itemsize - 1 - stored) - 1)
    mantissa = (bits & (2**stored - 1)) | (np.minimum(field, 1) << stored)
    return np.where(bits < 0, -mantissa, mantissa), np.maximum(field, 1) + (np.finfo(points.dtype).minexp - 1 - stored)


def _integers(points):
    """Scales each query by a power of two that makes its coordinates integers: an object array of Python integers."""
    mantissa, exponent = _decomposed(points.reshape(len(points), 3 * points.shape[1]))
    return _scaled_integers(mantissa, exponent).reshape(points.shape)


def _scaled_integers(mantissa, exponent):
    """Returns mantissa 2^exponent, each row times a power of two that makes it integers: an object array."""
    zeros = np.where(mantissa == 0, 0, np.frexp((mantissa & -mantissa).astype(np.float64))[1] - 1)
    mantissa = mantissa >> zeros  # Trailing zeros go to the exponent, which keeps the integers of coarse data small.
    exponent = exponent + zeros
    lowest = np.where(mantissa == 0, np.iinfo(exponent.dtype).max, exponent).min(axis=1, keepdims=True)
    shift = np.where(mantissa == 0, 0, exponent - lowest)
    return mantissa.astype(object) << shift.astype(object)


# --- The filter: floating point with proven bounds ---


def _may_touch(points, pairs):
    """Returns which triangles of which queries need exact arithmetic, bool (n, triangles): False is proven to be free.

    A triangle stays clear of the origin when along some axis its corners have one strict sign at both ends, thus
    always; or when in each piece of the step its volume has one strict sign, or one of n.X, n.Y and n.Z is negative.

    The bound, u = 2^-53: coordinates are scaled to at most 1, and in a piece each is mid + half s, |s| <= 1, with mid
    and half at most 1 and off by at most 4 u. Written out, the volume has 6 * 2^3 products of three such numbers, which
    pass through less than 24 roundings: it is off by less than 48 (3 * 4 + 24) u < 1e-12. A weight has 3 * 24 * 8 = 576
    products of four and less than 48 roundings: it is off by less than 576 (4 * 4 + 48) u < 1e-11. Both leave room
    within _MARGIN for the rounding of the sums of absolute values.
    """
    # |points| <= 1 cannot overflow. What underflows here is off by less than 2^-1022, nothing beside a size of 2^-500.
    corners = _corners(
        _scaled_floats(*_decomposed(points.reshape(len(points), 3 * points.shape[1]))).reshape(points.shape), pairs
    )
    # Differences have the sign of the exact ones, or are 0.
    sides = np.sign(corners).sum(axis=(2, 3))
    may_touch = (np.abs(sides) < 6).all(axis=-1)

    size = np.abs(corners).max(axis=(2, 3, 4), initial=0.0)
    filtered = may_touch & (size > 2.0**-500)
    corners = np.ldexp(corners[filtered], -np.frexp(size[filtered])[1][:, None, None, None])
    # From here on a triangle is three corners of three coordinates, each a polynomial in s.
    start, end = np.ascontiguousarray(corners.transpose(2, 1, 3, 0))
    unsure = np.zeros(len(corners), dtype=bool)
    half = (end - start) * (0.5 / _PIECES)
    for piece in range(_PIECES):
        time = (piece + 0.5) / _PIECES
        mid = (1.0 - time) * start + time * end
        x, y, z = ([[mid[i, j], half[i, j]] for j in range(3)] for i in range(3))
        areas = _areas(x, y, z)
        volume, *weights = _dot(x, areas[0]), *_weights(areas)
        free = np.abs(volume[0]) > _variation(volume)
        for weight in weights:
            free |= -weight[0] > _variation(weight)
        unsure |= ~free
    may_touch[filtered] = unsure
    return may_touch


def _scaled_floats(mantissa, exponent):
    """Returns mantissa 2^exponent, each row times a power of two that makes its largest number at most 1."""
    share, power = np.frexp(mantissa.astype(np.float64))
    power = np.where(share == 0.0, -4096, power + exponent)
    return np.ldexp(share, power - power.max(axis=1, keepdims=True, initial=-4096))


def _near_by_filter(points, pairs, distance):
    """Returns which queries are not proven to be free, and which are proven to collide; two bool arrays (n,).

    In a part of the step a polygon stays farther than d from the origin when along a fixed direction g all its corners
    are farther than d at both ends, thus always. It is within d when one of its points is, at one time. Where both
    fail in a part, its halves are tried.

    The bound, u = 2^-53: coordinates and d are scaled to at most 1, and the components of g are at most 1. A corner is
    the difference of two coordinates, interpolated: off by less than 10 u in each component, and a product with g by
    less than 100 u. A point of the polygon has weights that add up to 1 but for 4 u, and is off by less than 40 u.
    """
    parts = zip(
        _decomposed(points.reshape(len(points), 3 * points.shape[1])), _decomposed(distance[:, None]), strict=True
    )
    scaled = _scaled_floats(*(np.concatenate(part, axis=1) for part in parts))
    corners, limit = _corners(scaled[:, :-1].reshape(points.shape), pairs), scaled[:, -1]
    hit = np.zeros(len(points), dtype=bool)
    queries, starts, width = np.arange(len(points)), np.zeros(len(points)), 1.0
    for _ in range(_HALVINGS):
        of_part, far = corners[queries], limit[queries] + _DISTANCE_MARGIN

        def at(time, ends=of_part):
            return (1.0 - time)[:, None, None] * ends[:, :, 0] + time[:, None, None] * ends[:, :, 1]

        low, middle, high = at(starts), at(starts + 0.5 * width), at(starts + width)
        nearest = _nearest_point(middle)
        hit[queries[np.linalg.norm(nearest, axis=1) + _DISTANCE_MARGIN <= limit[queries]]] = True
        size = np.abs(nearest).max(axis=1, keepdims=True)
        g = np.divide(nearest, size, out=np.zeros_like(nearest), where=size > 1e-100)
        along = np.minimum(*((g[:, None] * end).sum(axis=2).min(axis=1) for end in (low, high)))
        unsure = ~(along > far * np.linalg.norm(g, axis=1) + _DISTANCE_MARGIN) & ~hit[queries]
        queries, starts, width = np.repeat(queries[unsure], 2), np.repeat(starts[unsure], 2), 0.5 * width
        starts[1::2] += width
    near = hit.copy()
    near[queries] = True
    return near, hit


def _nearest_point(polygons):
    """Returns about the nearest point to the origin of each polygon, shape (n, corners, 3): one of its points."""
    best, least = polygons[:, 0], (polygons[:, 0] ** 2).sum(axis=1)

    def compare(candidates):
        nonlocal best, least
        square = (candidates**2).sum(axis=1)
        best = np.where((square < least)[:, None], candidates, best)
        least = np.minimum(least, square)

    n = polygons.shape[1]
    with np.errstate(divide="ignore", invalid="ignore"):
        for i in range(n if n > 2 else n - 1):
            q, e = polygons[:, i], polygons[:, (i + 1) % n] - polygons[:, i]
            s = np.nan_to_num(-(q * e).sum(axis=1) / (e * e).sum(axis=1), nan=0.0)
            compare(q + s.clip(0.0, 1.0)[:, None] * e)
        for i in range(1, n - 1):
            x, y, z = (polygons[:, j] for j in (0, i, i + 1))
            areas = np.stack([np.cross(y, z), np.cross(z, x), np.cross(x, y)], axis=1)
            weights = (areas * areas.sum(axis=1, keepdims=True)).sum(axis=2)
            weights = np.where((weights >= 0.0).all(axis=1, keepdims=True), weights, np.nan)
            weights /= weights.sum(axis=1, keepdims=True)
            inside = np.isfinite(weights).all(axis=1)
            weights[~inside] = 1.0, 0.0, 0.0
            compare((weights[:, :, None] * np.stack([x, y, z], axis=1)).sum(axis=1))
    return best


def _variation(f):
    """Returns how far a polynomial can be from its value at 0 for |s| <= 1, rounding included."""
    return sum(np.abs(coefficient) for coefficient in f[1:]) + _MARGIN


# --- Polynomials: lists of coefficients, constant first, these integers (or arrays, in the filter) ---


def _add(f, g):
    return [a + b for a, b in itertools.zip_longest(f, g, fillvalue=0)]


def _multiply(f, g):
    product = [0] * (len(f) + len(g) - 1)
    for i, a in enumerate(f):
        for j, b in enumerate(g):
            product[i + j] = product[i + j] + a * b
    return product


def _dot(x, y):
    return functools.reduce(_add, map(_multiply, x, y))


def _negated(f):
    return [-a for a in f]


def _cross(x, y):
    minus_y = [_negated(f) for f in y]
    return [_add(_multiply(x[i], y[j]), _multiply(x[j], minus_y[i])) for i, j in ((1, 2), (2, 0), (0, 1))]


def _areas(x, y, z):
    """Returns the vectors X, Y, Z of the module docstring."""
    return _cross(y, z), _cross(z, x), _cross(x, y)


def _weights(areas):
    """Returns n.X, n.Y and n.Z, the barycentric coordinates of the origin times n.n."""
    normal = [functools.reduce(_add, components) for components in zip(*areas, strict=True)]
    return [_dot(normal, area) for area in areas]


def _trimmed(f):
    """Returns the polynomial without leading zeros; the zero polynomial is the empty list."""
    degree = len(f)
    while degree and f[degree - 1] == 0:
        degree -= 1
    return f[:degree]


def _derivative(f):
    return [i * a for i, a in enumerate(f)][1:]


def _sign_at(f, time):
    """Returns the sign of f at a time: an int, a Fraction or a float, taken exactly."""
    numerator, denominator = time.as_integer_ratio()
    value, power = 0, 1
    for a in reversed(f):  # Horner's rule, times denominator^degree
        value = value * numerator + a * power
        power *= denominator
    return (value > 0) - (value < 0)


# --- Real roots: the theorem of Sturm and Tarski ---


def _signed_remainders(f, g):
    """Returns f, g and their signed remainders, each times some positive number that keeps its coefficients integer."""
    sequence = [f]
    while g:
        sequence.append(g)
        remainder, scale = sequence[-2], abs(g[-1])
        while len(remainder) >= len(g):
            factor = remainder[-1] if g[-1] > 0 else -remainder[-1]
            rest = [scale * a for a in remainder[:-1]]
            for i, a in enumerate(g[:-1], start=len(remainder) - len(g)):
                rest[i] -= factor * a
            remainder = rest
        g = _trimmed(remainder)
        content = math.gcd(*g)
        g = [-a // content for a in g]
    return sequence


def _changes(sequence, time):
    """Counts the changes of sign along a sequence of polynomials at a time, zeros left out."""
    signs = [sign for f in sequence if (sign := _sign_at(f, time))]
    return sum(a != b for a, b in itertools.pairwise(signs))


def _sign_at_root(q, f, lower, upper):
    """Returns the sign of q at the only root of f between two times that are not roots of f."""
    sequence = _signed_remainders(f, _trimmed(_multiply(_derivative(f), q)) if q else [])
    return _changes(sequence, lower) - _changes(sequence, upper)


def _inner_part(f):
    """Returns f divided by t and by t - 1 as often as it goes, so that neither 0 nor 1 is a root."""
    while f[0] == 0:
        f = f[1:]
    while sum(f) == 0:
        f = list(itertools.accumulate(reversed(f)))[-2::-1]
    return f


def _isolated_roots(f):
    """Yields (lower, upper) around each root of f inside (0, 1), in order; these times are no roots, nor 0 and 1."""
    sturm = _signed_remainders(f, _derivative(f))
    intervals = [(0, 1)]
    while intervals:
        lower, upper = intervals.pop()
        roots = _changes(sturm, lower) - _changes(sturm, upper)
        if roots == 1:
            yield lower, upper
        elif roots > 1:
            middle = Fraction(lower + upper, 2)
            while _sign_at(f, middle) == 0:
                middle = (lower + middle) / 2
            intervals += [(middle, upper), (lower, middle)]


def _doubles_around(f, lower, upper):
    """Returns the doubles around the only root of f between two times: equal when it is one, neighbours otherwise."""
    if f is None:
        return float(lower), float(upper)
    sturm = _signed_remainders(f, _derivative(f))
    changes = _changes(sturm, lower)

    def double(bits):
        return float(np.int64(bits).view(np.float64))

    def reached(bits):
        time = double(bits)
        if time <= lower or time >= upper:
            return time >= upper
        return _sign_at(f, time) == 0 or _changes(sturm, time) != changes

    # The bits of doubles that are not negative, read as integers, are in the same order.
    one = int(np.float64(1.0).view(np.int64))
    after = double(bisect.bisect_left(range(one + 1), True, key=reached))
    exact = lower < after < upper and _sign_at(f, after) == 0
    return after if exact else float(np.nextafter(after, 0.0)), after


# --- Contact ---


class _Triangle:
    """The polynomials of the module docstring for one moving triangle; each corner is three polynomials."""

    def __init__(self, x, y, z):
        areas = _areas(x, y, z)
        self.volume = _trimmed(_dot(x, areas[0]))
        self.weights = [_trimmed(weight) for weight in _weights(areas)]
        self._corners = x, y, z
        self._areas = areas

    @functools.cached_property
    def edges(self):
        """For each edge xy the polynomials Z.Z and x.y."""
        x, y, z = self._corners
        pairs = (y, z), (z, x), (x, y)
        return [
            (_trimmed(_dot(area, area)), _trimmed(_dot(*pair))) for area, pair in zip(self._areas, pairs, strict=True)
        ]

    def touches(self, sign):
        """Returns whether the origin is in the triangle at the time at which sign(polynomial) gives the signs."""
        if sign(self.volume) != 0:
            return False
        signs = [sign(weight) for weight in self.weights]
        if any(signs):
            return min(signs) >= 0
        return any(sign(square) == 0 and sign(dot) <= 0 for square, dot in self.edges)

    def critical(self):
        """Yields the polynomials among whose roots the first time of contact is, unless it is 0, each with a test."""
        if self.volume:
            yield self.volume, self.touches
        else:
            for square, dot in self.edges:
                if critical := square or dot:
                    yield critical, self.touches


class _Polygon:
    """The polynomials of the module docstring for one moving polygon and a distance; a corner is three polynomials.

    Attributes:
        lines: The lines of the docstring, each as the polynomial of its last condition, which is at most 0; those that
            must be positive; and those that must not be negative.
    """

    def __init__(self, corners, distance):
        minus_d2 = -distance * distance

        def line(square, length, *inside):
            positive = [_trimmed(length)] if length != [1] else []
            last = _add(square, [minus_d2 * a for a in length])
            return _trimmed(last), positive, [_trimmed(f) for f in inside]

        def minus(x, y):
            return [_add(f, _negated(g)) for f, g in zip(x, y, strict=True)]

        n = len(corners)
        sides = [(corners[i], corners[(i + 1) % n]) for i in range(n if n > 2 else n - 1)]
        areas = [_cross(q, r) for q, r in sides]
        self.lines = [line(_dot(q, q), [1]) for q in corners]
        for (q, r), area in zip(sides, areas, strict=True):
            e = minus(r, q)
            self.lines.append(line(_dot(area, area), _dot(e, e), _negated(_dot(q, e)), _dot(r, e)))
        if n > 2:
            x, y, z = corners[:3]
            normal = _cross(minus(y, x), minus(z, y))
            volume = _dot(x, normal)
            self.lines.append(
                line(_multiply(volume, volume), _dot(normal, normal), *(_dot(normal, area) for area in areas))
            )

    def touches(self, sign):
        """Returns whether the polygon is within the distance at the time at which sign(polynomial) gives the signs."""
        return any(sign(last) <= 0 and self._foot_is_inside(i, sign) for i, (last, *_) in enumerate(self.lines))

    def critical(self):
        """Yields the polynomials among whose roots the first time of contact is, unless it is 0, each with a test."""
        for i, (last, *_) in enumerate(self.lines):
            if last:
                yield last, functools.partial(self._foot_is_inside, i)

    def _foot_is_inside(self, i, sign):
        """Returns whether all conditions but the last of a line hold."""
        _, positive, inside = self.lines[i]
        return all(sign(f) > 0 for f in positive) and all(sign(f) >= 0 for f in inside)


def _contacts(shape):
    """Yields times of contact of a _Triangle or a _Polygon, the earliest one among them.

    Yields:
        (f, lower, upper): the only root of f between two times; or (None, time, time).
    """
    if shape.touches(lambda q: _sign_at(q, 0)):
        yield None, 0, 0
        return
    for critical, touches in shape.critical():
        f = _inner_part(critical)
        for lower, upper in _isolated_roots(f):
            if touches(lambda q, f=f, lower=lower, upper=upper: _sign_at_root(q, f, lower, upper)):
                yield f, lower, upper
                break
    if shape.touches(lambda q: _sign_at(q, 1)):
        yield None, 1, 1
