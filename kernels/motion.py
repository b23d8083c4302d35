"""The relative motion of a query's features, from its eight points, in double precision and scaled."""

from typing import Any

import warp as wp

from .bernstein import inverse_power_of_two
from .polynomials import EDGE_EDGE, VERTEX_FACE, Motion

_ZERO = wp.constant(wp.float64(0.0))
_ONE = wp.constant(wp.float64(1.0))
_EIGHTH = wp.constant(wp.float64(0.125))
_QUARTER = wp.constant(wp.float64(0.25))
_SMALLEST = wp.constant(wp.float64(2.0**-480))
_LARGEST = wp.constant(wp.float64(2.0**1023))
_SMALLEST_WITH_GRADIENT = wp.constant(wp.float64(1.0e-280))
_LIFT = wp.constant(wp.float64(2.0**600))
_LIFTED_BIT = wp.constant(wp.float64(2.0**-474))  # the lowest bit of a number, times _LIFT
_TINY_DISTANCE = wp.constant(wp.float64(2.0**-400))
_LARGEST_GRADIENT = wp.constant(wp.float64(2.0**100))


@wp.func_native(
    snippet="""
#if defined(__CUDA_ARCH__)
    double value;
    asm("cvt.f64.f32 %0, %1;" : "=d"(value) : "f"(x));  // which fast math would flush
    return value;
#else
    union { float value; unsigned bits; } word;
    word.value = x;
    if (word.bits & 0x7f800000u)
        return x;
    const double value = (double)(int)(word.bits & 0x7fffffu) * 0x1p-149;
    return word.bits >> 31 ? -value : value;
#endif
"""
)
def _double(x: wp.float32) -> wp.float64:
    """Returns the same number in double precision, even where subnormal numbers are flushed to zero."""
    ...


@wp.func
def double(x: wp.vec3d) -> wp.vec3d:
    """Returns the same point in double precision."""
    return x


@wp.func
def double(x: wp.vec3) -> wp.vec3d:  # noqa: F811, an overload
    """Returns the same point in double precision, exactly."""
    return wp.vec3d(_double(x[0]), _double(x[1]), _double(x[2]))


@wp.func_grad(double)
def _adjoint_of_double(x: wp.vec3, adj_ret: wp.vec3d):
    """Adds the gradient in single precision, at most 2^100, so that a sum of many gradients does not overflow."""
    largest = wp.vec3d(_LARGEST_GRADIENT)
    gradient = wp.min(wp.max(adj_ret, -largest), largest)
    wp.adjoint[x] += wp.vec3(float(gradient[0]), float(gradient[1]), float(gradient[2]))


@wp.func
def doubles(a: Any, b: Any, c: Any, d: Any):
    """Returns the same points in double precision, exactly."""
    return double(a), double(b), double(c), double(d)


Query = wp.types.matrix(shape=(8, 3), dtype=wp.float64)
"""The points of a query in double precision: rows a0 b0 c0 d0 at the start, a1 b1 c1 d1 at the end of the step.

They are p a b c of a vertex and a face, a b c d of two edges, p a b a of a vertex and an edge, p q q q of two vertices.
"""


@wp.func
def query_of(a0: Any, b0: Any, c0: Any, d0: Any, a1: Any, b1: Any, c1: Any, d1: Any) -> Query:
    """Returns a query, given its points in any precision."""
    return wp.matrix_from_rows(
        double(a0), double(b0), double(c0), double(d0), double(a1), double(b1), double(c1), double(d1)
    )


@wp.func
def query_at(x0: wp.array[Any], x1: wp.array[Any], v: wp.vec4i) -> Query:
    """Returns a query, given positions at both ends of the step in any precision, and its vertices in order."""
    return query_of(x0[v[0]], x0[v[1]], x0[v[2]], x0[v[3]], x1[v[0]], x1[v[1]], x1[v[2]], x1[v[3]])


@wp.func
def all_finite(a0: Any, b0: Any, c0: Any, d0: Any, a1: Any, b1: Any, c1: Any, d1: Any) -> bool:
    """Returns whether all coordinates are finite: then the mean of eight points is finite as well."""
    start = _EIGHTH * double(a0) + _EIGHTH * double(b0) + _EIGHTH * double(c0) + _EIGHTH * double(d0)
    end = _EIGHTH * double(a1) + _EIGHTH * double(b1) + _EIGHTH * double(c1) + _EIGHTH * double(d1)
    return wp.isfinite(start + end)


@wp.func
def _size(x0: wp.vec3d, x1: wp.vec3d) -> wp.vec3d:
    """Returns the largest absolute value of each component of two vectors."""
    return wp.max(wp.abs(x0), wp.abs(x1))


@wp.func
def _scaled(
    kind: int, roundoff: wp.float64, u0: wp.vec3d, u1: wp.vec3d, v0: wp.vec3d, v1: wp.vec3d, w0: wp.vec3d, w1: wp.vec3d
) -> Motion:
    """Returns a relative motion, scaled exactly, by a power of two, to coordinates below 2.

    The motion is zero, which makes all its signs uncertain, if its size, its largest coordinate, is zero or out of
    range.

    Flushing subnormal numbers to zero changes each of two points and their difference by at most 2^-1022, less than
    2^-540 after scaling. A product of three changes by less than 2^-532, below the UNDERFLOW that bounds add, times the
    roundoff, 2^-518. Numbers that scaling makes subnormal are smaller still.
    """
    motion = Motion()
    motion.kind = kind
    motion.roundoff = roundoff
    u_size = _size(u0, u1)
    v_size = _size(v0, v1)
    w_size = _size(w0, w1)
    size = wp.max(wp.max(u_size, wp.max(v_size, w_size)))
    motion.size = size
    if not (size >= _SMALLEST and size < _LARGEST):
        return motion
    scale = inverse_power_of_two(size)
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
def _out_of_range(x: wp.vec3d, size: wp.float64) -> bool:
    """Returns whether a motion of that size, of points in double precision, needs :func:`_rescaled` points."""
    return not (size >= _SMALLEST and size < _LARGEST)


@wp.func
def _out_of_range(x: wp.vec3, size: wp.float64) -> bool:
    """Returns False: different numbers in single precision differ by at least 2^-149."""
    return False


@wp.func
def _rescaled_coordinate(x: wp.float64, size: wp.float64) -> wp.float64:
    """Returns a coordinate of a :func:`_rescaled` point."""
    if size > _ONE:
        return _QUARTER * x
    bits = wp.cast(x, wp.uint64)
    exponent = (bits >> wp.uint64(52)) & wp.uint64(2047)
    if exponent > wp.uint64(1023 - 400):
        return x
    if exponent > wp.uint64(0):
        return wp.cast(bits + (wp.uint64(600) << wp.uint64(52)), wp.float64)
    lifted = wp.float64(bits & ((wp.uint64(1) << wp.uint64(52)) - wp.uint64(1))) * _LIFTED_BIT
    return wp.where(bits >> wp.uint64(63) == wp.uint64(0), lifted, -lifted)


@wp.func
def _rescaled(x: wp.vec3d, size: wp.float64) -> wp.vec3d:
    """Returns a point of a motion whose size is out of range, in a scale in which all differences are in range.

    Large coordinates are divided by four, so that differences do not overflow. Small ones are multiplied by 2^600, bit
    by bit, because processors may flush subnormal numbers to zero. Among these, coordinates of 2^-400 or more stay as
    they are: the next numbers are farther away than the size of the motion, so that only equal ones are subtracted.
    """
    return wp.vec3d(
        _rescaled_coordinate(x[0], size), _rescaled_coordinate(x[1], size), _rescaled_coordinate(x[2], size)
    )


@wp.func
def _rescaled_query(query: Query, size: wp.float64) -> Query:
    """Returns a query of :func:`_rescaled` points."""
    result = Query()
    for i in range(8):
        result[i] = _rescaled(query[i], size)
    return result


@wp.func
def _motion_of_kind(kind: int, query: Query, roundoff: wp.float64) -> Motion:
    """Returns the scaled relative motion of a query of any kind; those without a face and two edges count as a face."""
    a0, b0, c0, d0 = query[0], query[1], query[2], query[3]
    a1, b1, c1, d1 = query[4], query[5], query[6], query[7]
    if kind == EDGE_EDGE:
        return _scaled(EDGE_EDGE, roundoff, b0 - a0, b1 - a1, d0 - c0, d1 - c1, c0 - a0, c1 - a1)
    return _scaled(VERTEX_FACE, roundoff, c0 - b0, c1 - b1, d0 - b0, d1 - b1, a0 - b0, a1 - b1)


@wp.func
def vertex_face_motion(
    p0: Any, a0: Any, b0: Any, c0: Any, p1: Any, a1: Any, b1: Any, c1: Any, roundoff: wp.float64
) -> Motion:
    """Returns the relative motion of a vertex and a triangle with finite coordinates.

    The motion is zero, so that culls do not decide it, if its size is out of range. :func:`relative_motion` rescales
    the points then; in culls that would cost registers.
    """
    return _motion_of_kind(VERTEX_FACE, query_of(p0, a0, b0, c0, p1, a1, b1, c1), roundoff)


@wp.func
def edge_edge_motion(
    a0: Any, b0: Any, c0: Any, d0: Any, a1: Any, b1: Any, c1: Any, d1: Any, roundoff: wp.float64
) -> Motion:
    """Returns the relative motion of two edges with finite coordinates, zero as in :func:`vertex_face_motion`."""
    return _motion_of_kind(EDGE_EDGE, query_of(a0, b0, c0, d0, a1, b1, c1, d1), roundoff)


@wp.func
def relative_motion(
    kind: int, a0: Any, b0: Any, c0: Any, d0: Any, a1: Any, b1: Any, c1: Any, d1: Any, roundoff: wp.float64
) -> Motion:
    """Returns the relative motion of a query with finite coordinates, of any kind and at any scale."""
    query = query_of(a0, b0, c0, d0, a1, b1, c1, d1)
    motion = _motion_of_kind(kind, query, roundoff)
    size = motion.size
    if _out_of_range(a0, size):
        motion = _motion_of_kind(kind, _rescaled_query(query, size), roundoff)
        motion.scale = wp.where(size > _SMALLEST_WITH_GRADIENT and size < _ONE, _LIFT * motion.scale, _ZERO)
    return motion


@wp.func
def query_motion(kind: int, query: Query, roundoff: wp.float64) -> Motion:
    """Returns the relative motion of a query as of :func:`relative_motion`."""
    return relative_motion(
        kind, query[0], query[1], query[2], query[3], query[4], query[5], query[6], query[7], roundoff
    )


@wp.func
def motion_and_distance(
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
    distance: wp.float64,
    # rounding
    roundoff: wp.float64,
):
    """Returns the relative motion of a query as of :func:`relative_motion`, and a distance in the same scale.

    A distance out of the range of that scale becomes infinite, where it is more than all distances of the query, or
    changes by up to 2^-1022 of the largest coordinate.
    """
    query = query_of(a0, b0, c0, d0, a1, b1, c1, d1)
    motion = _motion_of_kind(kind, query, roundoff)
    size = motion.size
    rescaled = distance
    if _out_of_range(a0, size):
        motion = _motion_of_kind(kind, _rescaled_query(query, size), roundoff)
        rescaled = _rescaled_coordinate(distance, size)
        if size < _ONE and distance >= _TINY_DISTANCE:
            rescaled = wp.float64(wp.inf)
    if motion.size > _ZERO and wp.isfinite(rescaled):
        rescaled = rescaled * inverse_power_of_two(motion.size)
    return motion, rescaled
