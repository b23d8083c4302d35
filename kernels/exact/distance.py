"""Exact decision whether a query comes within a minimum distance, at some times or never, in wide integers.

The polygon of the differences of points of the two features, see :mod:`polygon`, is within d of the origin at one time
exactly if the foot of the perpendicular from the origin is in a corner, a side or the plane, and at most d away. With
a corner q, the next one r, e = r - q and the polygon's normal n, directions g to the foot are

- of the corner: g = q;
- of the side, if e != 0 and q.e <= 0 <= r.e: g = (e.e) q - (q.e) e;
- of the plane, if n != 0 and n.(q x r) >= 0 for all sides: g = n or -n, with g.q >= 0.

The foot is at most d away if (g.q)^2 <= d^2 g.g. The query is then a HIT. If for some g all corners have
g.x > 0 and (g.x)^2 > d^2 g.g at the start and at the end, they have g.x > d |g| at all times, and the query is FREE.
This decides pairs that keep their distance, or move apart, or that a plane separates; and hits that last for a while,
at a multiple of 2^-k. The others stay UNSURE: pairs that come within the distance only between these times, or that no
single direction separates.

All axes are divided by the same power of two, and times m / 2^k make corners of B bits into integers of B + k bits,
d included. In units of a power of two to that, |e| and |i| < 2 sqrt(3), thus for a side |g| <= |q| |e|^2 < 20.8 and
g.q < 36, of degree 4, and (g.q)^2 < 2^11 and d^2 g.g < 2^9, of degree 8. With coordinates of L limbs, g and g.q of 4 L
and the rest of 8 L limbs, everything fits, with one bit for the sign, for

    B + k <= (512 L - 13) / 8:  126 bits for L = 2 limbs a coordinate, 254 for four.
"""

import functools
from typing import Any

import warp as wp

from ..motion import Query
from ..not_inlined import NOT_INLINED
from ..polynomials import EDGE_EDGE
from ..signs import FREE, HIT, UNSURE
from .polygon import coordinate, lowest_exponents, make_polygon, widest
from .wide_integers import (
    add,
    integer,
    lowest_bit,
    minor,
    product,
    scaled_like,
    shift,
    sign,
    subtract,
    times,
    top_bit_of_difference,
    widen,
)

BITS = {2: 126, 4: 254}
"""Largest B + k for each number of limbs of a coordinate."""

TOO_WIDE = wp.constant(-1)
"""Stands for a status where the exponents of the query are too far apart for the width of the integers."""

_BETWEEN = wp.constant(2)  # index of the corners at a time between the start, 0, and the end, 1


@wp.func
def _corner(polygon: wp.array[Any], corner: int, end: int):
    """Returns the coordinates of a corner at a time: at the start, at the end, or between."""
    return (
        coordinate(polygon, corner, end, 0),
        coordinate(polygon, corner, end, 1),
        coordinate(polygon, corner, end, 2),
    )


@wp.func(**NOT_INLINED)
def _dot(x0: Any, x1: Any, x2: Any, y0: Any, y1: Any, y2: Any):
    """Returns the dot product of two vectors."""
    return add(product(x0, y0), add(product(x1, y1), product(x2, y2)))


@wp.func(**NOT_INLINED)
def _cross(x0: Any, x1: Any, x2: Any, y0: Any, y1: Any, y2: Any):
    """Returns the cross product of two vectors."""
    return minor(x1, y2, x2, y1), minor(x2, y0, x0, y2), minor(x0, y1, x1, y0)


@wp.func(**NOT_INLINED)
def _direction_to_side(polygon: wp.array[Any], first: int, second: int, end: int):
    """Returns whether a foot is in a side, and the direction to it."""
    q0, q1, q2 = _corner(polygon, first, end)
    r0, r1, r2 = _corner(polygon, second, end)
    e0 = subtract(r0, q0)
    e1 = subtract(r1, q1)
    e2 = subtract(r2, q2)
    ee = _dot(e0, e1, e2, e0, e1, e2)
    qe = _dot(q0, q1, q2, e0, e1, e2)
    re = _dot(r0, r1, r2, e0, e1, e2)
    inside = sign(ee) > 0 and sign(qe) <= 0 and sign(re) >= 0
    g0 = minor(ee, widen(q0), qe, widen(e0))
    g1 = minor(ee, widen(q1), qe, widen(e1))
    g2 = minor(ee, widen(q2), qe, widen(e2))
    return inside, g0, g1, g2


@wp.func(**NOT_INLINED)
def _direction_to_plane(polygon: wp.array[Any], corners: int, end: int):
    """Returns whether the foot in the plane is in the polygon, and the direction to it."""
    x0, x1, x2 = _corner(polygon, 0, end)
    y0, y1, y2 = _corner(polygon, 1, end)
    z0, z1, z2 = _corner(polygon, 2, end)
    n0, n1, n2 = _cross(
        subtract(y0, x0), subtract(y1, x1), subtract(y2, x2), subtract(z0, y0), subtract(z1, y1), subtract(z2, y2)
    )
    inside = bool(sign(n0) != 0 or sign(n1) != 0 or sign(n2) != 0)
    first = int(0)
    while inside and first < corners:
        second = wp.where(first + 1 == corners, 0, first + 1)
        q0, q1, q2 = _corner(polygon, first, end)
        r0, r1, r2 = _corner(polygon, second, end)
        a0, a1, a2 = _cross(q0, q1, q2, r0, r1, r2)
        inside = sign(_dot(n0, n1, n2, a0, a1, a2)) >= 0
        first += 1
    g0 = widen(n0)
    g1 = widen(n1)
    g2 = widen(n2)
    if sign(_dot(n0, n1, n2, widen(x0), widen(x1), widen(x2))) < 0:
        zero = subtract(g0, g0)
        return inside, subtract(zero, g0), subtract(zero, g1), subtract(zero, g2)
    return inside, g0, g1, g2


@wp.func(**NOT_INLINED)
def _direction(polygon: wp.array[Any], corners: int, line: int, end: int):
    """Returns whether a foot is in a corner, a side or the plane, and the direction to it, four times as wide."""
    if line == 2 * corners:
        return _direction_to_plane(polygon, corners, end)
    if line >= corners:
        first = line - corners
        return _direction_to_side(polygon, first, wp.where(first + 1 == corners, 0, first + 1), end)
    q0, q1, q2 = _corner(polygon, line, end)
    return True, widen(widen(q0)), widen(widen(q1)), widen(widen(q2))


@wp.func(**NOT_INLINED)
def _is_beyond(polygon: wp.array[Any], corner: int, end: int, g0: Any, g1: Any, g2: Any, needed: Any) -> bool:
    """Returns whether a corner x is farther than d along a direction: g.x > 0 and (g.x)^2 > d^2 g.g, ``needed``."""
    x0, x1, x2 = _corner(polygon, corner, end)
    along = add(product(g0, widen(x0)), add(product(g1, widen(x1)), product(g2, widen(x2))))
    return sign(along) > 0 and sign(subtract(product(along, along), needed)) > 0


@wp.func(**NOT_INLINED)
def _decide_at(polygon: wp.array[Any], corners: int, end: int, squared: Any, squared_at: Any) -> int:
    """Returns HIT if the distance is reached at a time, FREE if a direction of that time shows that it never is.

    Args:
        polygon: The polygon.
        corners: Number of its corners.
        end: The time: at the start, at the end, or between.
        squared: Square of the distance, in the scale of the start and the end.
        squared_at: The same in the scale of the time.
    """
    line = int(0)
    while line <= 2 * corners:
        inside, g0, g1, g2 = _direction(polygon, corners, line, end)
        if inside:
            square = _dot(g0, g1, g2, g0, g1, g2)
            corner = wp.where(line < corners, line, wp.where(line < 2 * corners, line - corners, 0))
            if not _is_beyond(polygon, corner, end, g0, g1, g2, product(square, squared_at)):
                return HIT
            needed = product(square, squared)
            apart = bool(True)
            i = int(0)
            while apart and i < 2 * corners:
                at_end = wp.where(i < corners, 0, 1)
                apart = _is_beyond(polygon, i - at_end * corners, at_end, g0, g1, g2, needed)
                i += 1
            if apart:
                return FREE
        line += 1
    return UNSURE


@wp.func
def _decide_query(
    polygon: wp.array[Any], corners: int, distance: Any, time: wp.uint64, digits: int, timed: bool
) -> int:
    """Returns HIT if the distance is reached at the start or at time / 2^digits, if not ``timed`` also at the end."""
    squared = widen(product(distance, distance))
    status = _decide_at(polygon, corners, 0, squared, squared)
    if status != UNSURE:
        return status
    is_end = time >> wp.uint64(digits) != wp.uint64(0)
    if not is_end:
        before = (wp.uint64(1) << wp.uint64(digits)) - time
        i = int(0)
        while i < 12:
            polygon[12 * _BETWEEN + i] = add(times(polygon[i], before), times(polygon[12 + i], time))
            i += 1
        status = _decide_at(polygon, corners, _BETWEEN, squared, shift(squared, 2 * digits))
    if status == UNSURE and (is_end or not timed):
        status = _decide_at(polygon, corners, 1, squared, squared)
    return status


for _limbs in BITS:
    _Integer = integer(_limbs)

    @wp.func
    def _decide(
        polygon: wp.array[_Integer], corners: int, distance: _Integer, time: wp.uint64, digits: int, timed: bool
    ) -> int:
        """Returns :func:`_decide_query`; an array of a known type is not copied at each call."""
        return _decide_query(polygon, corners, distance, time, digits, timed)


@functools.cache
def decide_distance_in(limbs: int) -> wp.Function:
    """Returns a device function that decides queries in integers of ``limbs`` limbs per coordinate, a key of BITS."""
    number = integer(limbs)
    most = BITS[limbs]

    @wp.func
    def decide_distance(
        kind: int, query: Query, distance: wp.float64, toi: wp.float64, digits: int, timed: bool
    ) -> int:
        """Returns whether a query comes within a distance, if that is so at the times that are looked at.

        Args:
            kind: VERTEX_FACE or EDGE_EDGE; faces may be degenerate, as those that stand for edges or vertices.
            query: The points.
            distance: The distance, at least 0.
            toi: Time in [0, 1] before which the distance is not reached.
            digits: Binary digits of the tolerance of the time of impact, and one more.
            timed: Whether the time matters: then a HIT reaches the distance at most 2^(1 - digits) after ``toi``.

        Returns:
            FREE, HIT, TOO_WIDE, or UNSURE where neither is proven.
        """
        lowest = wp.min(wp.min(lowest_exponents(query)), lowest_bit(distance))
        top = wp.max(wp.max(widest(kind, query)), top_bit_of_difference(distance, wp.float64(0.0)))
        if wp.max(top - lowest, 0) + digits > most:
            return TOO_WIDE
        polygon = wp.zeros(shape=(36,), dtype=number)
        make_polygon(kind == EDGE_EDGE, query, wp.vec3i(lowest, lowest, lowest), polygon)
        scale = wp.float64(wp.uint64(1) << wp.uint64(digits))
        time = wp.uint64(wp.floor(toi * scale)) + wp.uint64(2)
        corners = wp.where(kind == EDGE_EDGE, 4, 3)
        return _decide(polygon, corners, scaled_like(polygon[0], distance, lowest), time, digits, timed)

    return decide_distance
