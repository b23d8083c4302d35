"""The relative motion of a query's features, from its eight points, in double precision and scaled."""

from typing import Any

import warp as wp

from .polynomials import EDGE_EDGE, VERTEX_FACE, Motion

_SMALLEST = wp.constant(wp.float64(1.0e-280))
_LARGEST = wp.constant(wp.float64(1.0e300))
_LARGEST_GRADIENT = wp.constant(wp.float64(2.0**100))


@wp.func
def double(x: wp.vec3d) -> wp.vec3d:
    """The same point in double precision."""
    return x


@wp.func
def double(x: wp.vec3) -> wp.vec3d:  # noqa: F811, an overload
    """The same point in double precision, exactly."""
    return wp.vec3d(wp.float64(x[0]), wp.float64(x[1]), wp.float64(x[2]))


@wp.func_grad(double)
def _adjoint_of_double(x: wp.vec3, adj_ret: wp.vec3d):
    """Rounded to single precision, at most 2^100, so that the sum of many does not overflow."""
    largest = wp.vec3d(_LARGEST_GRADIENT)
    gradient = wp.min(wp.max(adj_ret, -largest), largest)
    wp.adjoint[x] += wp.vec3(float(gradient[0]), float(gradient[1]), float(gradient[2]))


@wp.func
def doubles(a: Any, b: Any, c: Any, d: Any):
    """The same points in double precision, exactly."""
    return double(a), double(b), double(c), double(d)


@wp.func
def all_finite(a0: Any, b0: Any, c0: Any, d0: Any, a1: Any, b1: Any, c1: Any, d1: Any) -> bool:
    """Whether all coordinates are finite: no sum of doubles is then anything else, but for some beyond 1e307."""
    start = double(a0) + double(b0) + double(c0) + double(d0)
    end = double(a1) + double(b1) + double(c1) + double(d1)
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
    motion.scale = scale
    return motion


@wp.func
def vertex_face_motion(
    p0: Any, a0: Any, b0: Any, c0: Any, p1: Any, a1: Any, b1: Any, c1: Any, roundoff: wp.float64
) -> Motion:
    """Relative motion of a vertex and a triangle; of finite coordinates only."""
    origin0 = double(a0)
    origin1 = double(a1)
    return _motion(
        VERTEX_FACE,
        roundoff,
        double(b0) - origin0,
        double(b1) - origin1,
        double(c0) - origin0,
        double(c1) - origin1,
        double(p0) - origin0,
        double(p1) - origin1,
    )


@wp.func
def edge_edge_motion(
    a0: Any, b0: Any, c0: Any, d0: Any, a1: Any, b1: Any, c1: Any, d1: Any, roundoff: wp.float64
) -> Motion:
    """Relative motion of two edges; of finite coordinates only."""
    return _motion(
        EDGE_EDGE,
        roundoff,
        double(b0) - double(a0),
        double(b1) - double(a1),
        double(d0) - double(c0),
        double(d1) - double(c1),
        double(c0) - double(a0),
        double(c1) - double(a1),
    )


@wp.func
def relative_motion(
    kind: int, a0: Any, b0: Any, c0: Any, d0: Any, a1: Any, b1: Any, c1: Any, d1: Any, roundoff: wp.float64
) -> Motion:
    """Relative motion of a query of either kind, in the order of its points; of finite coordinates only."""
    if kind == VERTEX_FACE:
        return vertex_face_motion(a0, b0, c0, d0, a1, b1, c1, d1, roundoff)
    return edge_edge_motion(a0, b0, c0, d0, a1, b1, c1, d1, roundoff)
