"""Continuous collision detection of one query, callable from any Warp kernel, with or without gradients."""

import math
from typing import Any

import warp as wp

from .classification import classify
from .culling import centroid_direction, direction_separates, edge_edge_boxes_apart, vertex_face_boxes_apart
from .custom_gradients import func_grad
from .gradients import with_gradients
from .min_distance import min_distance_impact
from .motion import Query, all_finite, motion_and_distance, query_motion, query_of
from .polynomials import EDGE_EDGE, VERTEX_EDGE, VERTEX_FACE, VERTEX_VERTEX, Motion, coplanarity
from .signs import FREE, ROUNDOFF, UNSURE, ZERO, certified_sign_cubic
from .time_of_impact import Impact, impact

_TOLERANCE = wp.constant(wp.float64(2.0**-20))
_NAN = wp.constant(wp.float64(math.nan))


@wp.func
def solve(motion: Motion, timed: bool, tolerance: wp.float64) -> Impact:
    """Returns the status of a query that no coordinate axis separates and, if ``timed``, its first contact."""
    result = Impact()
    result.toi = wp.float64(2.0)
    y = coplanarity(motion)
    # this cull first: it decides more of the pairs whose boxes overlap than the other one, which is for flat sheets
    if certified_sign_cubic(y.k, y.bound) != 0 or direction_separates(motion, centroid_direction(motion)):
        return result
    status = classify(motion, y)
    result.status = status
    if status == UNSURE or (timed and status != FREE):
        return impact(motion, y, status, tolerance)
    return result


@wp.func
def _find_impact(kind: int, query: Query, timed: bool, tolerance: wp.float64) -> Impact:
    """Returns the status of a query and, if ``timed``, its first contact, both constants for differentiation."""
    result = Impact()
    if not wp.isfinite(query):
        result.status = UNSURE
        result.coordinates = wp.vec3d(_NAN)
        result.normal = wp.vec3d(_NAN)
        return result
    a0, b0, c0, d0 = query[0], query[1], query[2], query[3]
    a1, b1, c1, d1 = query[4], query[5], query[6], query[7]
    apart = bool(False)
    if kind == VERTEX_FACE:
        apart = vertex_face_boxes_apart(a0, b0, c0, d0, a1, b1, c1, d1)
    else:
        apart = edge_edge_boxes_apart(a0, b0, c0, d0, a1, b1, c1, d1)
    if apart:
        result.toi = wp.float64(2.0)
        return result
    return solve(query_motion(kind, query, ROUNDOFF), timed, tolerance)


@func_grad(_find_impact, Impact)
def _adjoint_of_find_impact(kind: int, query: Query, timed: bool, tolerance: wp.float64, adj_ret: Impact):
    """Does nothing, and keeps Warp from differentiating the code behind :func:`_find_impact`."""


@wp.func
def impact_vertex_face(
    p0: Any, a0: Any, b0: Any, c0: Any, p1: Any, a1: Any, b1: Any, c1: Any, tolerance: wp.float64
) -> Impact:
    """Returns the first contact of a moving vertex p with a moving triangle a b c.

    Args:
        p0: Vertex at the start, ``vec3`` or ``vec3d``.
        a0: First vertex of the triangle at the start.
        b0: Second vertex of the triangle at the start.
        c0: Third vertex of the triangle at the start.
        p1: Vertex at the end of the step.
        a1: First vertex of the triangle at the end.
        b1: Second vertex of the triangle at the end.
        c1: Third vertex of the triangle at the end.
        tolerance: Tolerance of the time of impact, as a share of the step. It is clamped to [2^-38, 2^-10]; NaN
            counts as 2^-38.

    Returns:
        Status, time of impact, barycentric coordinates and normal, in double precision. The last three are
        differentiable functions of the points; ``grazing`` is 1 where their gradients are clamped, see
        :mod:`.gradients`. If a point is not finite, the status is UNSURE, the time 0, coordinates and normal are NaN.
    """
    query = query_of(p0, a0, b0, c0, p1, a1, b1, c1)
    return with_gradients(VERTEX_FACE, query, _find_impact(VERTEX_FACE, query, True, tolerance), tolerance)


@wp.func
def impact_edge_edge(
    a0: Any, b0: Any, c0: Any, d0: Any, a1: Any, b1: Any, c1: Any, d1: Any, tolerance: wp.float64
) -> Impact:
    """Returns the first contact of a moving edge a b with a moving edge c d.

    Args:
        a0: First end of the first edge at the start, ``vec3`` or ``vec3d``.
        b0: Second end of the first edge at the start.
        c0: First end of the second edge at the start.
        d0: Second end of the second edge at the start.
        a1: First end of the first edge at the end of the step.
        b1: Second end of the first edge at the end.
        c1: First end of the second edge at the end.
        d1: Second end of the second edge at the end.
        tolerance: Tolerance of the time of impact, as a share of the step. It is clamped to [2^-38, 2^-10]; NaN
            counts as 2^-38.

    Returns:
        Status, time of impact, parameters along the edges and normal, in double precision. The last three are
        differentiable functions of the points; ``grazing`` is 1 where their gradients are clamped, see
        :mod:`.gradients`. If a point is not finite, the status is UNSURE, the time 0, coordinates and normal are NaN.
    """
    query = query_of(a0, b0, c0, d0, a1, b1, c1, d1)
    return with_gradients(EDGE_EDGE, query, _find_impact(EDGE_EDGE, query, True, tolerance), tolerance)


@wp.func
def ccd_vertex_face(p0: Any, a0: Any, b0: Any, c0: Any, p1: Any, a1: Any, b1: Any, c1: Any) -> int:
    """Returns whether a moving vertex p meets a moving triangle a b c: FREE, HIT or UNSURE.

    Points are ``vec3`` or ``vec3d``, at the start (0) and at the end (1) of the step, and move linearly between.
    Time and triangle are closed: touching is contact. FREE and HIT are certain; treat UNSURE as contact. If a point is
    not finite, the status is UNSURE.
    """
    return _find_impact(VERTEX_FACE, query_of(p0, a0, b0, c0, p1, a1, b1, c1), False, _TOLERANCE).status


@wp.func
def ccd_edge_edge(a0: Any, b0: Any, c0: Any, d0: Any, a1: Any, b1: Any, c1: Any, d1: Any) -> int:
    """Returns whether a moving edge a b meets a moving edge c d: FREE, HIT or UNSURE.

    Points are ``vec3`` or ``vec3d``, at the start (0) and at the end (1) of the step, and move linearly between.
    Time and edges are closed: touching is contact. FREE and HIT are certain; treat UNSURE as contact. If a point is not
    finite, the status is UNSURE.
    """
    return _find_impact(EDGE_EDGE, query_of(a0, b0, c0, d0, a1, b1, c1, d1), False, _TOLERANCE).status


@wp.func
def impact_at_distance(
    kind: int,
    # points at the start
    a0: Any,
    b0: Any,
    c0: Any,
    d0: Any,
    # points at the end
    a1: Any,
    b1: Any,
    c1: Any,
    d1: Any,
    # minimum distance
    min_distance: wp.float64,
    roundoff: wp.float64,
    # time of impact
    timed: bool,
    tolerance: wp.float64,
) -> Impact:
    """Returns the status of a query with a minimum distance and, if ``timed``, the first time at which it is reached.

    Points are those of a vertex-face or edge-edge query; p a b a for a vertex and an edge, p q q q for two vertices. If
    a point or the distance is not finite, or the distance negative, the status is UNSURE.
    """
    result = Impact()
    if not (all_finite(a0, b0, c0, d0, a1, b1, c1, d1) and wp.isfinite(min_distance) and min_distance >= ZERO):
        result.status = UNSURE
        result.coordinates = wp.vec3d(_NAN)
        result.normal = wp.vec3d(_NAN)
        return result
    motion, distance = motion_and_distance(kind, a0, b0, c0, d0, a1, b1, c1, d1, min_distance, roundoff)
    return min_distance_impact(kind, motion, distance, timed, tolerance)


@wp.func
def ccd_vertex_face(  # noqa: F811, an overload
    p0: Any, a0: Any, b0: Any, c0: Any, p1: Any, a1: Any, b1: Any, c1: Any, min_distance: wp.float64
) -> int:
    """Returns whether a moving vertex p comes within a distance of a moving triangle a b c: FREE, HIT or UNSURE.

    Points are ``vec3`` or ``vec3d``, at the start (0) and at the end (1) of the step, and move linearly between.
    Time, triangle and distance are closed: a vertex at exactly ``min_distance`` counts. FREE and HIT are certain; treat
    UNSURE as contact. If a point or the distance is not finite, or the distance negative, the status is UNSURE. For a
    distance of 0 the function without it certifies more.
    """
    return impact_at_distance(
        VERTEX_FACE, p0, a0, b0, c0, p1, a1, b1, c1, min_distance, ROUNDOFF, False, _TOLERANCE
    ).status


@wp.func
def ccd_edge_edge(  # noqa: F811, an overload
    a0: Any, b0: Any, c0: Any, d0: Any, a1: Any, b1: Any, c1: Any, d1: Any, min_distance: wp.float64
) -> int:
    """Returns whether a moving edge a b comes within a distance of a moving edge c d: FREE, HIT or UNSURE.

    Points and distance as of :func:`ccd_vertex_face`.
    """
    return impact_at_distance(
        EDGE_EDGE, a0, b0, c0, d0, a1, b1, c1, d1, min_distance, ROUNDOFF, False, _TOLERANCE
    ).status


@wp.func
def ccd_vertex_edge(p0: Any, a0: Any, b0: Any, p1: Any, a1: Any, b1: Any, min_distance: wp.float64) -> int:
    """Returns whether a moving vertex p comes within a distance of a moving edge a b: FREE, HIT or UNSURE.

    Points and distance as of :func:`ccd_vertex_face`.
    """
    return impact_at_distance(
        VERTEX_EDGE, p0, a0, b0, a0, p1, a1, b1, a1, min_distance, ROUNDOFF, False, _TOLERANCE
    ).status


@wp.func
def ccd_vertex_vertex(p0: Any, q0: Any, p1: Any, q1: Any, min_distance: wp.float64) -> int:
    """Returns whether a moving vertex p comes within a distance of a moving vertex q: FREE, HIT or UNSURE.

    Points and distance as of :func:`ccd_vertex_face`.
    """
    return impact_at_distance(
        VERTEX_VERTEX, p0, q0, q0, q0, p1, q1, q1, q1, min_distance, ROUNDOFF, False, _TOLERANCE
    ).status
