"""Exact decision whether the features of a query meet at rest, for points in single precision.

Orientations of these points are sums of exact products in double precision: for three points in a plane, of two
coordinates, 48 bits each; for four points in space, of three coordinates, each split into two products of at most 48
bits. None leaves the range of double precision: they are 0 or between 2^-447 and 2^384. The sum is kept as an
expansion, doubles that do not overlap; the sign of the largest is that of the sum (Shewchuk's GROW-EXPANSION). Since
all products are exact, it does not matter whether a compiler fuses multiplications with additions.

References:
    Jonathan Richard Shewchuk. "Adaptive Precision Floating-Point Arithmetic and Fast Robust Geometric Predicates."
    Discrete & Computational Geometry 18 (1997). https://doi.org/10.1007/PL00009321.
"""

import warp as wp

from ..motion import doubles
from ..not_inlined import NOT_INLINED
from ..polynomials import VERTEX_FACE

_ADD = """
    double sum[48];  // ordered by size, without zeros
    int count = 0;
    const auto add = [&](double x) {
        int kept = 0;
        for (int i = 0; i < count; ++i) {
            const double total = x + sum[i], part = total - x, rest = (x - (total - part)) + (sum[i] - part);
            x = total;
            if (rest != 0.0)
                sum[kept++] = rest;
        }
        if (x != 0.0)
            sum[kept++] = x;
        count = kept;
    };
"""

_SIGN = """
    return count == 0 ? 0 : (sum[count - 1] > 0.0) - (sum[count - 1] < 0.0);
"""


@wp.func_native(
    snippet=f"""{_ADD}
    const wp::vec_t<3, wp::float64> points[4] = {{a, b, c, d}};
    for (int i = 0; i < 4; ++i) {{  // the determinant of the other three points, with alternating signs
        const auto& x = points[i == 0 ? 1 : 0];
        const auto& y = points[i <= 1 ? 2 : 1];
        const auto& z = points[i <= 2 ? 3 : 2];
        for (int axis = 0; axis < 3; ++axis) {{
            const int j = (axis + 1) % 3, k = (axis + 2) % 3;
            const double factor = i % 2 == 0 ? x[axis] : -x[axis];
            const double products[2] = {{y[j] * z[k], -(y[k] * z[j])}};
            for (int n = 0; n < 2; ++n) {{
                union {{ double value; wp::uint64 bits; }} high;
                high.value = products[n];
                high.bits &= ~((1ull << 29) - 1);
                add(high.value * factor);
                add((products[n] - high.value) * factor);
            }}
        }}
    }}{_SIGN}"""
)
def orientation(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d) -> int:
    """Returns on which side of the plane of three points a fourth one is: 1, -1, or 0 if they are in one plane."""
    ...


@wp.func_native(
    snippet=f"""{_ADD}
    add(ax * by);
    add(-(ay * bx));
    add(bx * cy);
    add(-(by * cx));
    add(cx * ay);
    add(-(cy * ax));{_SIGN}"""
)
def plane_orientation(
    ax: wp.float64, ay: wp.float64, bx: wp.float64, by: wp.float64, cx: wp.float64, cy: wp.float64
) -> int:
    """Returns how three points of a plane turn: 1 to the left, -1 to the right, 0 if they are on one line."""
    ...


@wp.func(**NOT_INLINED)
def _turn(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, axis: int) -> int:
    """Returns the orientation of three points in the coordinate plane across an axis."""
    i = (axis + 1) % 3
    j = (axis + 2) % 3
    return plane_orientation(a[i], a[j], b[i], b[j], c[i], c[j])


@wp.func(**NOT_INLINED)
def _separated_across(p: wp.vec3d, q: wp.vec3d, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, axis: int) -> bool:
    """Returns whether the line of the edge p q or of a side of a b c separates both in the plane across an axis."""
    of_a = _turn(p, q, a, axis)
    if of_a != 0 and of_a == _turn(p, q, b, axis) and of_a == _turn(p, q, c, axis):
        return True
    for _side in range(3):
        of_p = _turn(a, b, p, axis)
        if of_p != 0 and of_p == _turn(a, b, q, axis) and of_p != _turn(a, b, c, axis):
            return True
        corner = a
        a = b
        b = c
        c = corner
    return False


@wp.func(**NOT_INLINED)
def meet_at_rest(kind: int, a: wp.vec3, b: wp.vec3, c: wp.vec3, d: wp.vec3) -> bool:
    """Returns whether the features of a query that stands still meet, exactly; points are finite.

    Points that are not in one plane belong to features that do not meet. In one plane, some projection along an axis is
    one to one, so that features meet if their projections along all three axes do. In a plane, convex polygons do not
    meet if the line of a side of one of them separates them strictly or, where all points are on one line, if an axis
    does.

    Args:
        kind: VERTEX_FACE (a vertex, then a triangle) or EDGE_EDGE (the ends of two edges).
        a: First point.
        b: Second point.
        c: Third point.
        d: Fourth point.
    """
    p, q, x, y = doubles(a, b, c, d)
    if orientation(p, q, x, y) != 0:
        return False
    z = y  # two edges, the second one as a triangle
    if kind == VERTEX_FACE:
        z = q
        q = p
    low = wp.min(x, wp.min(y, z))
    high = wp.max(x, wp.max(y, z))
    for axis in range(3):
        if wp.max(p[axis], q[axis]) < low[axis] or wp.min(p[axis], q[axis]) > high[axis]:
            return False
        if _separated_across(p, q, x, y, z, axis):
            return False
    return True
