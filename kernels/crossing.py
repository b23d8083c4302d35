"""Intersection of an edge and a face at rest, by certified signs of orientations in space and in coordinate planes."""

from typing import Any

import warp as wp

from .motion import double
from .signs import FREE, HIT, ROUNDOFF, UNDERFLOW, UNSURE, certified_sign

_ERROR = wp.constant(wp.float64(9.0))
_PLANE_ERROR = wp.constant(wp.float64(6.0))
_LONGEST = wp.constant(wp.float64(1.0e70))


@wp.func
def _orientation(x: wp.vec3d, y: wp.vec3d, z: wp.vec3d) -> int:
    """Returns the certified sign of the determinant of three vectors, each with one rounding.

    Bound, with P the sum of the sizes of its six products: 3 roundings of the vectors, 2 of the products, 3 of the
    sums, 8r P to first order. The underflow of products of three is less than the added UNDERFLOW, also where subnormal
    numbers are flushed, 2^-1022 in a vector, as long as no coordinate exceeds 1e70. If one does, no sign is certain.
    """
    ax = wp.abs(x)
    ay = wp.abs(y)
    az = wp.abs(z)
    if wp.max(wp.max(ax), wp.max(wp.max(ay), wp.max(az))) > _LONGEST:
        return 0
    size = (
        ax[0] * (ay[1] * az[2] + ay[2] * az[1])
        + ax[1] * (ay[2] * az[0] + ay[0] * az[2])
        + ax[2] * (ay[0] * az[1] + ay[1] * az[0])
    )
    return certified_sign(wp.dot(x, wp.cross(y, z)), ROUNDOFF * (_ERROR * size + UNDERFLOW))


@wp.func
def edge_crosses_face(p: Any, q: Any, a: Any, b: Any, c: Any) -> int:
    """Returns whether the closed edge p q meets the closed triangle a b c: FREE, HIT or UNSURE.

    The line through p and q meets the triangle if it passes all sides with one orientation, and misses it if two
    orientations are strictly opposite. It meets the triangle within the edge if p and q lie on opposite sides.
    """
    ab = double(b) - double(a)
    ac = double(c) - double(a)
    side_p = _orientation(ab, ac, double(p) - double(a))
    side_q = _orientation(ab, ac, double(q) - double(a))
    if side_p * side_q > 0:
        return FREE
    pq = double(q) - double(p)
    pa = double(a) - double(p)
    pb = double(b) - double(p)
    pc = double(c) - double(p)
    past_ab = _orientation(pq, pa, pb)
    past_bc = _orientation(pq, pb, pc)
    past_ca = _orientation(pq, pc, pa)
    low = wp.min(past_ab, wp.min(past_bc, past_ca))
    high = wp.max(past_ab, wp.max(past_bc, past_ca))
    if low < 0 and high > 0:
        return FREE
    return wp.where(side_p * side_q < 0 and low == high and low != 0, HIT, UNSURE)


@wp.func
def _plane_orientation(a: wp.vec2d, b: wp.vec2d, p: wp.vec2d) -> int:
    """Returns on which side of the line from a to b a point lies: 1 for left, -1 for right, 0 if not certain.

    Bound, with P the sum of the sizes of both products: 2 roundings of the differences, 1 of the products, 1 of the
    sum, 4r P to first order. No sign is certain if a coordinate exceeds 1e70.
    """
    u = b - a
    v = p - a
    if wp.max(wp.max(wp.abs(u)), wp.max(wp.abs(v))) > _LONGEST:
        return 0
    left = u[0] * v[1]
    right = u[1] * v[0]
    return certified_sign(left - right, ROUNDOFF * (_PLANE_ERROR * (wp.abs(left) + wp.abs(right)) + UNDERFLOW))


@wp.func
def _edge_beside_face(p: wp.vec2d, q: wp.vec2d, a: wp.vec2d, b: wp.vec2d, c: wp.vec2d) -> bool:
    """Returns whether a line along a side of the triangle, or the edge, certainly separates the two in a plane."""
    of_a = _plane_orientation(p, q, a)
    apart = of_a != 0 and of_a == _plane_orientation(p, q, b) and of_a == _plane_orientation(p, q, c)
    for _side in range(3):
        inside = _plane_orientation(a, b, c)
        of_p = _plane_orientation(a, b, p)
        apart = apart or (inside != 0 and of_p == -inside and _plane_orientation(a, b, q) == -inside)
        corner = a
        a = b
        b = c
        c = corner
    return apart


@wp.func
def edge_beside_face(p: Any, q: Any, a: Any, b: Any, c: Any) -> bool:
    """Returns whether the edge p q and the triangle a b c are certainly apart in a coordinate plane, thus in space.

    This decides most pairs in one plane, such as those of a flat floor, where no orientation in space is certain.
    """
    beside = bool(False)
    for axis in range(3):
        i = (axis + 1) % 3
        j = (axis + 2) % 3
        beside = beside or _edge_beside_face(
            wp.vec2d(wp.float64(p[i]), wp.float64(p[j])),
            wp.vec2d(wp.float64(q[i]), wp.float64(q[j])),
            wp.vec2d(wp.float64(a[i]), wp.float64(a[j])),
            wp.vec2d(wp.float64(b[i]), wp.float64(b[j])),
            wp.vec2d(wp.float64(c[i]), wp.float64(c[j])),
        )
    return beside
