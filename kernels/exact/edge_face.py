"""Exact decision whether an edge meets a face at rest, and passes through it, in wide integers.

The sign of the determinant of three differences of points is their orientation. With those of both ends and the face,
and of the edge's line and the sides:

- ends strictly on one side of the face's plane, or sides that the line passes with strictly opposite orientations, mean
  that the two do not meet, also where the face has collapsed;
- else, if an end is not in the plane, the line meets the plane in one point, which is in the edge and in the face;
- else all five points are in one plane, also those of a collapsed face: if they were in none, the line would pass two
  sides with opposite orientations. Some projection to a coordinate plane is then one to one, so that edge and face meet
  if their projections to all three do. In a plane, two convex polygons do not meet if a line along a side of one of
  them separates them strictly, or if one of both axes does, which matters where all points are in one line.

Scaling an axis changes no sign. So coordinates are divided along each axis by their lowest set bit, which makes
differences from the edge's first point integers of B bits, and all others of B + 1 bits. By Hadamard's inequality a
determinant is below 3 sqrt(3) 2^(3B+3), thus 2^(3B+6), and with one bit for the sign fits in 2 L limbs for

    B <= (128 L - 7) / 3:  83 bits for L = 2 limbs a coordinate, 339 for eight.

Single precision takes at most 278, its whole range.
"""

import functools
from typing import Any

import warp as wp

from ..not_inlined import NOT_INLINED
from ..signs import FREE, HIT, UNSURE
from .polygon import lowest_exponents, top_bits
from .wide_integers import SCALED, add, integer, minor, product, sign, subtract

BITS = {2: 83, 8: 339}
"""Largest B for each number of limbs of a coordinate."""

TOUCHES = wp.constant(3)
"""Status of an edge that meets a face, but does not pass through it."""

EdgeAndFace = wp.types.matrix(shape=(8, 3), dtype=wp.float64)
"""Points in double precision: rows p q of an edge, a b c of a face, and u v w, the third corners of its neighbours.

These are u of the neighbour at the side a b, v at b c, and w at c a; where there is none, the corner c, a or b.
"""
# indices of these points
_P = wp.constant(0)
_Q = wp.constant(1)
_CORNER = wp.constant(2)
_ACROSS = wp.constant(5)

_FROM_POINTS = f"""{SCALED}
    constexpr int L = sizeof(*points.data) / 8;
    for (int axis = 0; axis < 3; ++axis) {{
        wp::uint64 origin[L], x[L];
        scaled(given.data[0][axis], exponents[axis], origin);
        for (int i = 0; i < 8; ++i) {{
            scaled(given.data[i][axis], exponents[axis], x);
            difference(x, origin, points.data[3 * i + axis]);
        }}
    }}
"""

for _limbs in BITS:
    _Integer = integer(_limbs)

    @wp.func_native(snippet=_FROM_POINTS)
    def _subtract_origin(given: EdgeAndFace, exponents: wp.vec3i, points: wp.array[_Integer]):
        """Writes x, y, z of each point minus p, divided by 2^exponents, modulo 2 to their width."""
        ...


@wp.func(**NOT_INLINED)
def _difference(points: wp.array[Any], end: int, start: int, axis: int):
    """Returns a coordinate of the difference of two points."""
    return subtract(points[3 * end + axis], points[3 * start + axis])


@wp.func(**NOT_INLINED)
def _plane_minor(points: wp.array[Any], o: int, x: int, y: int, axis: int):
    """Returns a component of the cross product of x - o and y - o."""
    j = wp.where(axis == 2, 0, axis + 1)
    k = wp.where(j == 2, 0, j + 1)
    return minor(
        _difference(points, x, o, j),
        _difference(points, y, o, k),
        _difference(points, x, o, k),
        _difference(points, y, o, j),
    )


@wp.func(**NOT_INLINED)
def _orientation(points: wp.array[Any], o: int, x: int, y: int, z: int) -> int:
    """Returns the sign of the determinant of x - o, y - o and z - o."""
    volume = product(_plane_minor(points, o, x, y, 0), _difference(points, z, o, 0))
    axis = int(1)
    while axis < 3:
        volume = add(volume, product(_plane_minor(points, o, x, y, axis), _difference(points, z, o, axis)))
        axis += 1
    return sign(volume)


@wp.func(**NOT_INLINED)
def _plane_orientation(points: wp.array[Any], o: int, x: int, y: int, axis: int) -> int:
    """Returns the orientation of three points in the plane across an axis."""
    return sign(_plane_minor(points, o, x, y, axis))


@wp.func
def _next(side: int) -> int:
    """Returns the side after one of three."""
    return wp.where(side == 2, 0, side + 1)


@wp.func(**NOT_INLINED)
def _separated_along(points: wp.array[Any], axis: int) -> bool:
    """Returns whether the edge and the face are strictly separated along an axis."""
    from_p = wp.vec3i(0, 0, 0)
    from_q = wp.vec3i(0, 0, 0)
    i = int(0)
    while i < 3:
        from_p[i] = sign(_difference(points, _CORNER + i, _P, axis))
        from_q[i] = sign(_difference(points, _CORNER + i, _Q, axis))
        i += 1
    return wp.min(wp.min(from_p), wp.min(from_q)) > 0 or wp.max(wp.max(from_p), wp.max(from_q)) < 0


@wp.func(**NOT_INLINED)
def _separated_across(points: wp.array[Any], axis: int) -> bool:
    """Returns whether a line along the edge or a side separates edge and face strictly in the plane across an axis."""
    low = int(1)
    high = int(-1)
    side = int(0)
    while side < 3:
        start = _CORNER + side
        end = _CORNER + _next(side)
        corner = _plane_orientation(points, _P, _Q, start, axis)
        low = wp.min(low, corner)
        high = wp.max(high, corner)
        of_p = _plane_orientation(points, start, end, _P, axis)
        if of_p != 0 and of_p == _plane_orientation(points, start, end, _Q, axis):
            # the face is on the other side, or in the line
            if _plane_orientation(points, start, end, _CORNER + _next(_next(side)), axis) != of_p:
                return True
        side += 1
    return low > 0 or high < 0


@wp.func
def _edge_meets_face(points: wp.array[Any]) -> int:
    """Returns whether an edge meets a face: FREE, TOUCHES, or HIT if it passes through."""
    start = _orientation(points, _CORNER, _P, _CORNER + 1, _CORNER + 2)
    end = _orientation(points, _CORNER, _Q, _CORNER + 1, _CORNER + 2)
    if start * end > 0:
        return FREE
    low = int(1)
    high = int(-1)
    sum = int(0)
    met = int(0)  # the last side whose line the edge's line meets
    side = int(0)
    while side < 3:
        passed = _orientation(points, _P, _Q, _CORNER + side, _CORNER + _next(side))
        low = wp.min(low, passed)
        high = wp.max(high, passed)
        sum += passed
        met = wp.where(passed == 0, side, met)
        side += 1
    if low < 0 and high > 0:
        return FREE
    if start * end < 0:
        if wp.abs(sum) == 3:
            return HIT
        # inside a side that has a neighbour, the ends are on different sides of both faces
        if wp.abs(sum) == 2:
            beyond = _orientation(points, _CORNER + met, _P, _ACROSS + met, _CORNER + _next(met))
            return wp.where(beyond == start, HIT, TOUCHES)
        return TOUCHES
    if start != 0 or end != 0:
        return TOUCHES
    axis = int(0)
    while axis < 3:
        if _separated_along(points, axis) or _separated_across(points, axis):
            return FREE
        axis += 1
    return TOUCHES


for _limbs in BITS:
    _Integer = integer(_limbs)

    @wp.func
    def _decide(points: wp.array[_Integer]) -> int:
        """Returns :func:`_edge_meets_face`; an array of a known type is not copied at each call."""
        return _edge_meets_face(points)


@functools.cache
def edge_meets_face_in(limbs: int) -> wp.Function:
    """Returns a device function that decides in integers of ``limbs`` limbs per coordinate, a key of BITS."""
    number = integer(limbs)
    most = BITS[limbs]

    @wp.func
    def edge_meets_face(given: EdgeAndFace) -> int:
        """Returns whether the closed edge p q meets the closed triangle a b c, and passes through it.

        Returns:
            FREE; TOUCHES; HIT if the edge passes through, as :func:`warp_bsc.checker.edges_pass_faces` defines it; or
            UNSURE if the exponents are too far apart for the width.
        """
        lowest = lowest_exponents(given)
        top = top_bits(given[1], given[0])
        for i in range(2, 8):
            top = wp.max(top, top_bits(given[i], given[0]))
        if wp.max(top - lowest) > most:
            return UNSURE
        points = wp.zeros(shape=(24,), dtype=number)
        _subtract_origin(given, lowest, points)
        return _decide(points)

    return edge_meets_face
