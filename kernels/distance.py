"""Closest points of the two features of a query at rest, and their distance with a bound on its error.

Features are given as in :mod:`.closest`. The distance is the minimum over several pairs of points: the closest points
of all borders, and those of the insides. Each of these is a valid pair, so that the distance is an upper bound up to
the rounding of the vector between them, a few roundoffs of the size s, the largest component of u, v and w.

It is a lower bound as well, up to a few roundoffs r of s. A point and an edge: the square of the distance along the
edge is a parabola, and an error of r |w| / |u| in the coordinate of the closest point moves this by r |w|. The insides
of two edges at an angle a: one coordinate comes from cross products, with errors of about r s / (|u| sin a) and
r d / (|u| sin^2 a) at the distance d; the other one is the closest to it. The point then moves by r s + r d / sin a
across the second edge. The distance grows by at most r s and d (r / sin a)^2 / 2. The borders are compared as well, and
are farther by at most s sin a and (s sin a)^2 / (2 d). The lesser of these is a few r s at any angle. If the second
coordinate is clamped, the closest point of the border is as near. A vertex and the inside of a triangle is the same
problem on another domain. Together that is below 2^10 roundoffs of s; :data:`DISTANCE_ERROR` is 2^13.
"""

import warp as wp

from .closest import between, ratio
from .polynomials import VERTEX_FACE

DISTANCE_ERROR = wp.constant(wp.float64(2.0**-40))
"""Bound on the error of a distance, as a share of the largest component of u, v and w."""

_ZERO = wp.constant(wp.float64(0.0))
_ONE = wp.constant(wp.float64(1.0))


@wp.func
def _along(x: wp.vec3d, edge: wp.vec3d) -> wp.float64:
    """Returns the coordinate of the point of the segment 0, edge that is closest to x."""
    return ratio(wp.dot(x, edge), wp.dot(edge, edge))


@wp.func
def _nearer(nearest: wp.vec3d, kind: int, s: wp.float64, r: wp.float64, u: wp.vec3d, v: wp.vec3d, w: wp.vec3d):
    """Returns two coordinates and the square of the distance there, or those found before if they are nearer."""
    squared = wp.length_sq(between(kind, wp.vec2d(s, r), u, v, w))
    if squared < nearest[2]:
        return wp.vec3d(s, r, squared)
    return nearest


@wp.func
def nearest_pair(kind: int, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d) -> wp.vec3d:
    """Returns the coordinates of the closest points of two features, and the square of their distance.

    Args:
        kind: VERTEX_FACE or EDGE_EDGE.
        a: Vector u, scaled so that squares neither overflow nor underflow where it matters.
        b: Vector v, in the same scale.
        c: Vector w, in the same scale.
    """
    n = wp.cross(a, b)
    nn = wp.dot(n, n)
    nearest = wp.vec3d(_ZERO, _ZERO, wp.float64(wp.inf))
    if kind == VERTEX_FACE:
        nearest = _nearer(nearest, kind, _along(c, a), _ZERO, a, b, c)
        nearest = _nearer(nearest, kind, _ZERO, _along(c, b), a, b, c)
        third = _along(c - a, b - a)
        nearest = _nearer(nearest, kind, _ONE - third, third, a, b, c)
        gamma = ratio(wp.dot(wp.cross(a, c), n), nn)
        beta = wp.min(_along(c - gamma * b, a), _ONE - gamma)
        nearest = _nearer(nearest, kind, beta, gamma, a, b, c)
    else:
        nearest = _nearer(nearest, kind, _ZERO, _along(-c, b), a, b, c)
        nearest = _nearer(nearest, kind, _ONE, _along(a - c, b), a, b, c)
        nearest = _nearer(nearest, kind, _along(c, a), _ZERO, a, b, c)
        nearest = _nearer(nearest, kind, _along(c + b, a), _ONE, a, b, c)
        s = ratio(wp.dot(wp.cross(c, b), n), nn)
        nearest = _nearer(nearest, kind, s, _along(s * a - c, b), a, b, c)
    return nearest


@wp.func
def closest_points(kind: int, u: wp.vec3d, v: wp.vec3d, w: wp.vec3d):
    """Returns the closest points of two features and their distance.

    Returns:
        Coordinates of the two points as of :func:`.closest.closest_coordinates`; their distance; and the bound on its
        error. All differences of points must be finite.
    """
    size = wp.max(wp.max(wp.max(wp.abs(u)), wp.max(wp.abs(v))), wp.max(wp.abs(w)))
    scale = wp.where(size > _ZERO, size, _ONE)
    nearest = nearest_pair(kind, u / scale, v / scale, w / scale)
    return wp.vec2d(nearest[0], nearest[1]), wp.sqrt(nearest[2]) * size, DISTANCE_ERROR * size
