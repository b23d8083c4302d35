"""Intersection of an edge and a face at rest, by certified signs of orientations."""

from typing import Any

import warp as wp

from .motion import double
from .signs import FREE, HIT, ROUNDOFF, UNDERFLOW, UNSURE, certified_sign

_ERROR = wp.constant(wp.float64(9.0))
_LONGEST = wp.constant(wp.float64(1.0e70))


@wp.func
def _orientation(x: wp.vec3d, y: wp.vec3d, z: wp.vec3d) -> int:
    """Returns the certified sign of the determinant of three vectors, each with one rounding.

    Bound, with P the sum of the sizes of its six products: 3 roundings of the vectors, 2 of the products, 3 of the
    sums, 8r P to first order. Products of three lose less to underflow than the added UNDERFLOW, also where subnormal
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
