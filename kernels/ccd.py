"""Continuous collision detection of one query, to be called in any Warp kernel."""

from typing import Any

import warp as wp

from .classification import classify
from .culling import centroid_direction, direction_separates, edge_edge_boxes_apart, vertex_face_boxes_apart
from .polynomials import EDGE_EDGE, VERTEX_FACE, Motion, coplanarity
from .signs import FREE, ROUNDOFF, UNSURE, certified_sign_cubic
from .time_of_impact import Impact, impact

_SMALLEST = wp.constant(wp.float64(1.0e-280))
_LARGEST = wp.constant(wp.float64(1.0e300))
_TOLERANCE = wp.constant(wp.float64(2.0**-20))


@wp.func
def _double(x: Any) -> wp.vec3d:
    """The same point in double precision, exactly."""
    return wp.vec3d(wp.float64(x[0]), wp.float64(x[1]), wp.float64(x[2]))


@wp.func
def _finite(a0: Any, b0: Any, c0: Any, d0: Any, a1: Any, b1: Any, c1: Any, d1: Any) -> bool:
    """Whether all coordinates are finite: no sum of doubles is then anything else, but for some beyond 1e307."""
    start = _double(a0) + _double(b0) + _double(c0) + _double(d0)
    end = _double(a1) + _double(b1) + _double(c1) + _double(d1)
    return wp.isfinite(start + end)


@wp.func
def _size(x0: wp.vec3d, x1: wp.vec3d) -> wp.vec3d:
    return wp.max(wp.abs(x0), wp.abs(x1))


@wp.func
def _motion(
    kind: int,
    roundoff: wp.float64,
    u0: wp.vec3d,
    u1: wp.vec3d,
    v0: wp.vec3d,
    v1: wp.vec3d,
    w0: wp.vec3d,
    w1: wp.vec3d,
) -> Motion:
    """Relative motion, scaled by a power of two, which is exact, to coordinates below 2.

    It is zero, which nothing can certify, where scaling is impossible: all points equal, or less than 1e-280 or more
    than 1e300 apart.
    """
    motion = Motion()
    motion.kind = kind
    motion.roundoff = roundoff
    u_size = _size(u0, u1)
    v_size = _size(v0, v1)
    w_size = _size(w0, w1)
    size = wp.max(wp.max(u_size, wp.max(v_size, w_size)))
    if not (size > _SMALLEST and size < _LARGEST):
        return motion
    exponent = (wp.cast(size, wp.uint64) >> wp.uint64(52)) & wp.uint64(2047)
    scale = wp.cast((wp.uint64(2046) - exponent) << wp.uint64(52), wp.float64)
    motion.u0 = scale * u0
    motion.u1 = scale * u1
    motion.v0 = scale * v0
    motion.v1 = scale * v1
    motion.w0 = scale * w0
    motion.w1 = scale * w1
    motion.u_size = scale * u_size
    motion.v_size = scale * v_size
    motion.w_size = scale * w_size
    return motion


@wp.func
def vertex_face_motion(
    p0: Any, a0: Any, b0: Any, c0: Any, p1: Any, a1: Any, b1: Any, c1: Any, roundoff: wp.float64
) -> Motion:
    """Relative motion of a vertex and a triangle; of finite coordinates only."""
    origin0 = _double(a0)
    origin1 = _double(a1)
    return _motion(
        VERTEX_FACE,
        roundoff,
        _double(b0) - origin0,
        _double(b1) - origin1,
        _double(c0) - origin0,
        _double(c1) - origin1,
        _double(p0) - origin0,
        _double(p1) - origin1,
    )


@wp.func
def edge_edge_motion(
    a0: Any, b0: Any, c0: Any, d0: Any, a1: Any, b1: Any, c1: Any, d1: Any, roundoff: wp.float64
) -> Motion:
    """Relative motion of two edges; of finite coordinates only."""
    return _motion(
        EDGE_EDGE,
        roundoff,
        _double(b0) - _double(a0),
        _double(b1) - _double(a1),
        _double(d0) - _double(c0),
        _double(d1) - _double(c1),
        _double(c0) - _double(a0),
        _double(c1) - _double(a1),
    )


@wp.func
def solve(motion: Motion, timed: bool, tolerance: wp.float64) -> Impact:
    """Status of a query that no coordinate axis separates and, if ``timed``, its first contact."""
    result = Impact()
    result.toi = wp.float64(2.0)
    y = coplanarity(motion)
    # this cull first: of pairs whose boxes overlap it decides more than the other, which is for flat sheets
    if certified_sign_cubic(y.k, y.bound) != 0 or direction_separates(motion, centroid_direction(motion)):
        return result
    status = classify(motion, y)
    result.status = status
    if status == UNSURE or (timed and status != FREE):
        return impact(motion, y, status, tolerance)
    return result


@wp.func
def impact_vertex_face(
    p0: Any, a0: Any, b0: Any, c0: Any, p1: Any, a1: Any, b1: Any, c1: Any, tolerance: wp.float64
) -> Impact:
    """First contact of a moving vertex p with a moving triangle a b c.

    Args:
        p0: Vertex at the start, ``vec3`` or ``vec3d``.
        a0: First vertex of the triangle at the start.
        b0: Second vertex of the triangle at the start.
        c0: Third vertex of the triangle at the start.
        p1: Vertex at the end of the step.
        a1: First vertex of the triangle at the end.
        b1: Second vertex of the triangle at the end.
        c1: Third vertex of the triangle at the end.
        tolerance: Of the time of impact, as a share of the step.

    Returns:
        Status, time of impact, barycentric coordinates and normal, in double precision.
    """
    result = Impact()
    if not _finite(p0, a0, b0, c0, p1, a1, b1, c1):
        result.status = UNSURE
        return result
    if vertex_face_boxes_apart(p0, a0, b0, c0, p1, a1, b1, c1):
        result.toi = wp.float64(2.0)
        return result
    return solve(vertex_face_motion(p0, a0, b0, c0, p1, a1, b1, c1, ROUNDOFF), True, tolerance)


@wp.func
def impact_edge_edge(
    a0: Any, b0: Any, c0: Any, d0: Any, a1: Any, b1: Any, c1: Any, d1: Any, tolerance: wp.float64
) -> Impact:
    """First contact of a moving edge a b with a moving edge c d.

    Args:
        a0: First end of the first edge at the start, ``vec3`` or ``vec3d``.
        b0: Second end of the first edge at the start.
        c0: First end of the second edge at the start.
        d0: Second end of the second edge at the start.
        a1: First end of the first edge at the end of the step.
        b1: Second end of the first edge at the end.
        c1: First end of the second edge at the end.
        d1: Second end of the second edge at the end.
        tolerance: Of the time of impact, as a share of the step.

    Returns:
        Status, time of impact, parameters along the edges and normal, in double precision.
    """
    result = Impact()
    if not _finite(a0, b0, c0, d0, a1, b1, c1, d1):
        result.status = UNSURE
        return result
    if edge_edge_boxes_apart(a0, b0, c0, d0, a1, b1, c1, d1):
        result.toi = wp.float64(2.0)
        return result
    return solve(edge_edge_motion(a0, b0, c0, d0, a1, b1, c1, d1, ROUNDOFF), True, tolerance)


@wp.func
def ccd_vertex_face(p0: Any, a0: Any, b0: Any, c0: Any, p1: Any, a1: Any, b1: Any, c1: Any) -> int:
    """Whether a moving vertex p meets a moving triangle a b c: FREE, HIT or UNSURE.

    Points are ``vec3`` or ``vec3d``, at the start (0) and at the end (1) of the step, and move linearly between.
    Time and triangle are closed: touching is contact. FREE and HIT are certain; treat UNSURE as contact. Points
    that are not finite are UNSURE.
    """
    if not _finite(p0, a0, b0, c0, p1, a1, b1, c1):
        return UNSURE
    if vertex_face_boxes_apart(p0, a0, b0, c0, p1, a1, b1, c1):
        return FREE
    return solve(vertex_face_motion(p0, a0, b0, c0, p1, a1, b1, c1, ROUNDOFF), False, _TOLERANCE).status


@wp.func
def ccd_edge_edge(a0: Any, b0: Any, c0: Any, d0: Any, a1: Any, b1: Any, c1: Any, d1: Any) -> int:
    """Whether a moving edge a b meets a moving edge c d: FREE, HIT or UNSURE.

    Points are ``vec3`` or ``vec3d``, at the start (0) and at the end (1) of the step, and move linearly between.
    Time and edges are closed: touching is contact. FREE and HIT are certain; treat UNSURE as contact. Points that
    are not finite are UNSURE.
    """
    if not _finite(a0, b0, c0, d0, a1, b1, c1, d1):
        return UNSURE
    if edge_edge_boxes_apart(a0, b0, c0, d0, a1, b1, c1, d1):
        return FREE
    return solve(edge_edge_motion(a0, b0, c0, d0, a1, b1, c1, d1, ROUNDOFF), False, _TOLERANCE).status
