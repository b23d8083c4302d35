"""The polygon of a query around the origin, in wide integers, and polynomials of its corners.

Scaling an axis changes no status. So coordinates are divided along each axis by their lowest set bit, which makes them
and the corners integers of B bits on the widest axis, |x| < 2^B. Then, in z = t / (1 - t),
the outer coefficients of a component of C_e have two products of coordinates, below 2^(2B+1), and the middle one has
four, below 2^(2B+2). The outer coefficients of V are determinants, below 3 sqrt(3) 2^3B by Hadamard's inequality, thus
2^(3B+3), and the inner ones are sums of three, below 15.6 * 2^3B. With these, in units of a power of 2^B,

    g   = a P - p3 z q      52      < 2^6,   5B: 2 * 15.6 + 5.2 * 4
    K0                      124.8   < 2^7,   7B: 2 * 10.4 + 2 * 52, of V' as well
    K1, J                   291.2   < 2^9,   7B: 2 * 41.6 + 4 * 52; of V' 249.6
    K1 of V' reversed       561.6   < 2^10,  7B: 2 * 31.2 + 4 * (2 * 31.2 + 4 * 15.6), where K0 and J are 0
    K0^2 - K1 J             77,900  < 2^17, 14B: 124.8^2 + 249.6^2 for V'; 51,900 for V itself
    Hessian of V            487     < 2^9,   6B: 15.6^2 + 3 * 5.2 * 15.6
    discriminant of V       1.2e6   < 2^21, 12B
    turning point minus root        < 2^11,  9B

and one bit for the sign. With coordinates of L limbs, V and C_e of 2 L, g and K of 4 L and signs of numbers of
8 L limbs, everything fits for

    B <= min((512 L - 18) / 14, (256 L - 11) / 7):  35 bits in one limb, 71 in two, 144 in four, 291 in eight.

Single precision takes at most 278, its whole range.
"""

from typing import Any

import warp as wp

from ..motion import Query
from ..native_text import definitions, header
from ..not_inlined import NOT_INLINED
from ..polynomials import VERTEX_FACE
from .wide_integers import LIMBS, SCALED, add, integer, lowest_bit, minor, product, sign, top_bit_of_difference

BITS = {1: 35, 2: 71, 4: 144, 8: 291}
"""Largest B for each number of limbs of a coordinate."""

_FROM_POINTS = f"""{SCALED}
    // both points of the difference that each corner is; 0 to 3: the points of the query in order
    const int first[2][4] = {{{{0, 0, 0, 0}}, {{2, 2, 3, 3}}}}, second[2][4] = {{{{1, 2, 3, 3}}, {{0, 1, 1, 0}}}};
    constexpr int L = sizeof(*polygon.data) / 8;
    for (int axis = 0; axis < 3; ++axis) {{
        for (int end = 0; end < 2; ++end) {{
            wp::uint64 x[4][L];
            for (int point = 0; point < 4; ++point)
                scaled(query.data[4 * end + point][axis], exponents[axis], x[point]);
            for (int corner = 0; corner < 4; ++corner)
                difference(
                    x[first[edges][corner]], x[second[edges][corner]], polygon.data[(end * 4 + corner) * 3 + axis]
                );
        }}
    }}
"""


@wp.func_native(snippet=definitions({}, largest_bits=BITS[1]) + header(__file__, "narrow_polygon.h"))
def make_narrow_polygon(edges: bool, query: Query, polygon: wp.array[integer(1)]) -> int:
    """Does what :func:`spread` and :func:`make_polygon` do for one limb a coordinate, in SIMD instructions of a CPU.

    Returns:
        1; 0 if the corners have more than BITS; -1 if it cannot tell: on a GPU, with subnormal coordinates, or with
        coordinates far larger than their differences.
    """
    ...


for _limbs in LIMBS[:4]:
    _Integer = integer(_limbs)

    @wp.func_native(snippet=_FROM_POINTS)
    def make_polygon(edges: bool, query: Query, exponents: wp.vec3i, polygon: wp.array[_Integer]):
        """Writes the polygon of a query: x, y, z of each corner at the start, then at the end, modulo 2 to their width.

        Args:
            edges: Whether it is an edge-edge query; the polygon of a vertex-face query has its last corner twice.
            query: The points.
            exponents: Exponent for each axis of a power of two that divides all coordinates.
            polygon: Array of 24 integers to write to.
        """
        ...


@wp.func
def coordinate(polygon: wp.array[Any], corner: int, end: int, axis: int):
    """Returns a coordinate of a corner at the start (0) or at the end (1)."""
    return polygon[(end * 4 + corner) * 3 + axis]


@wp.func
def _lowest_bits(x: wp.vec3d) -> wp.vec3i:
    return wp.vec3i(lowest_bit(x[0]), lowest_bit(x[1]), lowest_bit(x[2]))


@wp.func
def top_bits(x: wp.vec3d, y: wp.vec3d) -> wp.vec3i:
    """Returns an exponent e for each axis, so that the difference of two points is below 2^e."""
    return wp.vec3i(
        top_bit_of_difference(x[0], y[0]), top_bit_of_difference(x[1], y[1]), top_bit_of_difference(x[2], y[2])
    )


@wp.func
def lowest_exponents(query: Query) -> wp.vec3i:
    """Returns the exponents of the lowest bits of all points, for each axis."""
    lowest = _lowest_bits(query[0])
    for i in range(1, 8):
        lowest = wp.min(lowest, _lowest_bits(query[i]))
    return lowest


@wp.func
def _widest_at(kind: int, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d) -> wp.vec3i:
    """Returns an exponent e for each axis, so that the corners of the polygon at one time are below 2^e."""
    if kind == VERTEX_FACE:
        return wp.max(top_bits(a, b), wp.max(top_bits(a, c), top_bits(a, d)))
    return wp.max(wp.max(top_bits(c, a), top_bits(c, b)), wp.max(top_bits(d, a), top_bits(d, b)))


@wp.func
def widest(kind: int, query: Query) -> wp.vec3i:
    """Returns an exponent e for each axis, so that the corners of the polygon at both times are below 2^e."""
    at_start = _widest_at(kind, query[0], query[1], query[2], query[3])
    return wp.max(at_start, _widest_at(kind, query[4], query[5], query[6], query[7]))


@wp.func
def spread(kind: int, query: Query):
    """Returns the exponent of the power of two to divide each axis by, and the bits B of the corners after that."""
    lowest = lowest_exponents(query)
    return lowest, wp.max(wp.max(widest(kind, query) - lowest), 0)


@wp.func(**NOT_INLINED)
def cross_component(polygon: wp.array[Any], first: int, second: int, axis: int):
    """Returns the coefficients in z of a component of the cross product of two corners."""
    j = wp.where(axis == 2, 0, axis + 1)
    k = wp.where(j == 2, 0, j + 1)
    x0j = coordinate(polygon, first, 0, j)
    x0k = coordinate(polygon, first, 0, k)
    x1j = coordinate(polygon, first, 1, j)
    x1k = coordinate(polygon, first, 1, k)
    y0j = coordinate(polygon, second, 0, j)
    y0k = coordinate(polygon, second, 0, k)
    y1j = coordinate(polygon, second, 1, j)
    y1k = coordinate(polygon, second, 1, k)
    return (
        minor(x0j, y0k, x0k, y0j),
        add(minor(x0j, y1k, x0k, y1j), minor(x1j, y0k, x1k, y0j)),
        minor(x1j, y1k, x1k, y1j),
    )


@wp.func(**NOT_INLINED)
def volume(polygon: wp.array[Any], last: int):
    """Returns the coefficients in z of the cubic V, given the index of the last corner."""
    n0, n1, n2 = cross_component(polygon, 1, last, 0)
    start = coordinate(polygon, 0, 0, 0)
    end = coordinate(polygon, 0, 1, 0)
    v0 = product(n0, start)
    v1 = add(product(n1, start), product(n0, end))
    v2 = add(product(n2, start), product(n1, end))
    v3 = product(n2, end)
    axis = int(1)
    while axis < 3:
        n0, n1, n2 = cross_component(polygon, 1, last, axis)
        start = coordinate(polygon, 0, 0, axis)
        end = coordinate(polygon, 0, 1, axis)
        v0 = add(v0, product(n0, start))
        v1 = add(v1, add(product(n1, start), product(n0, end)))
        v2 = add(v2, add(product(n2, start), product(n1, end)))
        v3 = add(v3, product(n2, end))
        axis += 1
    return v0, v1, v2, v3


@wp.func
def sign_at_end(polygon: wp.array[Any], first: int, second: int, axis: int, end: int) -> int:
    """Returns the sign of a component of the cross product of two corners at the start (0) or at the end (1)."""
    j = wp.where(axis == 2, 0, axis + 1)
    k = wp.where(j == 2, 0, j + 1)
    xj = coordinate(polygon, first, end, j)
    xk = coordinate(polygon, first, end, k)
    yj = coordinate(polygon, second, end, j)
    yk = coordinate(polygon, second, end, k)
    return sign(minor(xj, yk, xk, yj))
