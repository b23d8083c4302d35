"""Queries: whether and when moving features meet, or come within a minimum distance."""

from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import ArrayLike

from .._arguments import checked_coordinates, checked_distances
from .contact import Polygon, Triangle, contacts
from .coordinates import as_integers, corners_of, decompose_with_distance, scale_to_integers
from .filters import polygons_near, triangles_may_touch
from .roots import doubles_around

# The triangles of a query, each corner a difference of two of its four points (first minus second).
VERTEX_FACE = np.array([[(1, 0), (2, 0), (3, 0)]])
_EDGE_EDGE = np.array([[(0, 2), (1, 2), (1, 3)], [(0, 2), (1, 3), (0, 3)]])

# The polygon of a query, its corners in order around it, each a difference of two of its points.
POLYGONS = {
    "vertex_vertex": np.array([(0, 1)]),
    "vertex_edge": np.array([(0, 1), (0, 2)]),
    "vertex_face": np.array([(0, 1), (0, 2), (0, 3)]),
    "edge_edge": np.array([(0, 2), (1, 2), (1, 3), (0, 3)]),
}

_BLOCK = 8192  # queries that go through the filter together: arrays of this length stay in the processor's cache


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
    return _decide(collides, "vertex_face", points, min_distance)


def edge_edge(points: ArrayLike, min_distance: ArrayLike = 0.0) -> np.ndarray:
    """Returns which edge-edge queries collide, with arguments, result and errors as of :func:`vertex_face`.

    The points have shape (n, 8, 3), rows a0 b0 c0 d0 a1 b1 c1 d1; edges ab and cd.
    """
    return _decide(collides, "edge_edge", points, min_distance)


def vertex_edge(points: ArrayLike, min_distance: ArrayLike = 0.0) -> np.ndarray:
    """Returns which vertex-edge queries collide, with arguments, result and errors as of :func:`vertex_face`.

    The points have shape (n, 6, 3), rows p0 a0 b0 p1 a1 b1; vertex p and edge ab.
    """
    return _decide(collides, "vertex_edge", points, min_distance)


def vertex_vertex(points: ArrayLike, min_distance: ArrayLike = 0.0) -> np.ndarray:
    """Returns which vertex-vertex queries collide, with arguments, result and errors as of :func:`vertex_face`.

    The points have shape (n, 4, 3), rows p0 q0 p1 q1; vertices p and q.
    """
    return _decide(collides, "vertex_vertex", points, min_distance)


def vertex_face_toi(points: ArrayLike, min_distance: ArrayLike = 0.0) -> np.ndarray:
    """Returns bounds of the earliest contact time of vertex-face queries.

    Arguments and errors are those of :func:`vertex_face`.

    Returns:
        Float64 array of shape (n, 2): the largest double that is not after the earliest contact, and the smallest one
        that is not before it. They are equal when that time is a double, neighbours otherwise, NaN for no collision.
    """
    return _decide(earliest, "vertex_face", points, min_distance)


def edge_edge_toi(points: ArrayLike, min_distance: ArrayLike = 0.0) -> np.ndarray:
    """Returns bounds of the earliest contact time of edge-edge queries, as of :func:`vertex_face_toi`.

    Arguments are those of :func:`edge_edge`.
    """
    return _decide(earliest, "edge_edge", points, min_distance)


def vertex_edge_toi(points: ArrayLike, min_distance: ArrayLike = 0.0) -> np.ndarray:
    """Returns bounds of the earliest contact time of vertex-edge queries, as of :func:`vertex_face_toi`.

    Arguments are those of :func:`vertex_edge`.
    """
    return _decide(earliest, "vertex_edge", points, min_distance)


def vertex_vertex_toi(points: ArrayLike, min_distance: ArrayLike = 0.0) -> np.ndarray:
    """Returns bounds of the earliest contact time of vertex-vertex queries, as of :func:`vertex_face_toi`.

    Arguments are those of :func:`vertex_vertex`.
    """
    return _decide(earliest, "vertex_vertex", points, min_distance)


def _decide(
    decide: Callable[[Iterable, np.ndarray], np.ndarray], kind: str, points: ArrayLike, min_distance: ArrayLike
) -> np.ndarray:
    """Returns the results of :func:`collides` or :func:`earliest` for queries; errors as :func:`vertex_face`."""
    points = checked_coordinates(points, (2 * (POLYGONS[kind].max() + 1), 3), "points")
    distance = np.broadcast_to(checked_distances(min_distance, "min_distance", len(points)), len(points))
    result = np.zeros(len(points), dtype=bool) if decide is collides else np.full((len(points), 2), np.nan)
    triangles = {"vertex_face": VERTEX_FACE, "edge_edge": _EDGE_EDGE}.get(kind)
    touching = (distance == 0.0) & (triangles is not None)
    if touching.any():
        result[touching] = decide(undecided_triangles(points[touching], triangles), result[touching])
    which = np.flatnonzero(~touching)
    near, hit = polygons_near(points[which], POLYGONS[kind], distance[which])
    if decide is collides:
        result[which[hit]] = True
        near &= ~hit
    which = which[near]
    result[which] = decide(polygons(points[which], POLYGONS[kind], distance[which]), result[which])
    return result


def collides(undecided, hit):
    """Returns which queries collide, bool (n,): those that ``hit`` has, and the undecided ones that have a contact."""
    for query, shape in undecided:
        hit[query] = hit[query] or any(True for _ in contacts(shape))
    return hit


def earliest(undecided, toi):
    """Returns the doubles around each query's earliest contact, float64 (n, 2), NaN as in ``toi`` where none is."""
    for query, shape in undecided:
        for contact in contacts(shape):
            # Rounding is monotone, so the earlier of two times has the smaller bounds.
            toi[query] = np.fmin(toi[query], doubles_around(*contact))
    return toi


def undecided_triangles(points, pairs):
    """Yields (query, Triangle) for every triangle that the filter leaves to exact arithmetic, query by query."""
    for start in range(0, len(points), _BLOCK):
        block = points[start : start + _BLOCK]
        queries, triangles = np.nonzero(triangles_may_touch(block, pairs))
        corners = corners_of(as_integers(block[queries]), pairs)[np.arange(len(queries)), triangles]
        for query, (x, y, z) in zip(queries, np.moveaxis(corners, 2, 3).tolist(), strict=True):
            yield start + query, Triangle(*([[a, b - a] for a, b in corner] for corner in (x, y, z)))


def polygons(points, pairs, distance):
    """Yields (query, Polygon) for every query."""
    # the distance as one more coordinate, scaled with the others
    integers = scale_to_integers(*decompose_with_distance(points, distance))
    corners = np.moveaxis(corners_of(integers[:, :-1].reshape(points.shape), pairs), 2, 3)
    for query, (polygon, d) in enumerate(zip(corners.tolist(), integers[:, -1].tolist(), strict=True)):
        yield query, Polygon([[[a, b - a] for a, b in corner] for corner in polygon], d)
