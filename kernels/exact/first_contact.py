"""Exact first contact of a query in wide integers, in all degenerate cases (BSC-exact).

Formulation
-----------
The differences of points of the two features fill a triangle with the corners p - a, p - b, p - c (vertex-face), or a
parallelogram with the corners c - a, c - b, d - b, d - a in this order (edge-edge). The features meet when this polygon
contains the origin. Its corners move linearly. Let

    V = P . (Q x R)  for its first, second and last corner: a cubic, zero when polygon and origin are in one plane;
    C_e = A x B  for each of its edges, from corner A to the next one B: three quadratics, by axis.

They are, up to sign, the coplanarity Y and the inside tests of :mod:`polynomials`: the areas of the triangles that the
origin forms with the edges. At a time at which V = 0:

- for any axis, if components of two C_e have strictly opposite signs, there is no contact;
- else, if any of them is not zero, there is contact;
- if all are zero for all axes, the polygon's normal, a sum of some C_e, is zero. It has collapsed to a segment or to a
  point, and is the union of its edges.

An edge contains the origin when C_e = 0, so that A and B are parallel, and A_i B_i <= 0 along every axis i.

Times of contact
----------------
If V is not identically zero, contact is possible at its roots. The order of those inside the step and of the roots of
the components of C_e gives the signs of the components, see :mod:`algebraic`. If all are zero at a root, the search
continues with **any** contact of an edge with the origin during the step, which is contact of the features as well.

If V is identically zero, the motion is planar, in a plane that may turn. The first contact is then at t = 0 or on an
edge: an origin that is strictly inside a polygon that has not collapsed was inside before. So the search tests the
start and all edges.

For an edge, if a component of C_e is not identically zero, contact is at a root of it at which the other two components
are zero and A_i B_i <= 0. If all components are identically zero, A and B are parallel all the time; A . B is positive
at the start, unless there is contact, and stays positive until the first contact.
"""

import functools
from typing import Any

import warp as wp

from ..motion import Query
from ..not_inlined import NOT_INLINED
from ..polynomials import EDGE_EDGE, VERTEX_FACE
from .algebraic import count_cubic_roots, count_quadratic_roots, root_time, signs_at_cubic_roots, signs_at_roots
from .polygon import BITS, coordinate, cross_component, make_narrow_polygon, make_polygon, sign_at_end, spread, volume
from .wide_integers import add, integer, product, sign, subtract, widen

NONE = wp.constant(wp.float64(2.0))
"""Time of impact where there is no contact."""

TOO_WIDE = wp.constant(wp.float64(-1.0))
"""Stands for a time of impact where the exponents of the query are too far apart for the width of the integers."""

_0 = wp.constant(wp.float64(0.0))
_1 = wp.constant(wp.float64(1.0))


@wp.func
def _next(corner: int, corners: int) -> int:
    """Returns the corner after a corner."""
    return wp.where(corner + 1 == corners, 0, corner + 1)


@wp.func(**NOT_INLINED)
def _touches_at_end(polygon: wp.array[Any], corners: int, end: int) -> int:
    """Returns whether a polygon coplanar with the origin at an end of the step contains it: 1, 0; -1 if collapsed."""
    axis = int(0)
    while axis < 3:
        low = int(0)
        high = int(0)
        corner = int(0)
        while corner < corners:
            s = sign_at_end(polygon, corner, _next(corner, corners), axis, end)
            low = wp.min(low, s)
            high = wp.max(high, s)
            corner += 1
        if low < 0 and high > 0:
            return 0
        if low < 0 or high > 0:
            return 1
        axis += 1
    return -1


@wp.func(**NOT_INLINED)
def _edge_touches_at_end(polygon: wp.array[Any], first: int, second: int, end: int) -> bool:
    """Returns whether the edge between two corners contains the origin at one end of the step."""
    axis = int(0)
    while axis < 3:
        if sign_at_end(polygon, first, second, axis, end) != 0:
            return False
        if sign(coordinate(polygon, first, end, axis)) * sign(coordinate(polygon, second, end, axis)) > 0:
            return False
        axis += 1
    return True


@wp.func(**NOT_INLINED)
def _between_at_roots(
    polygon: wp.array[Any], first: int, second: int, axis: int, c0: Any, c1: Any, c2: Any, roots: int
):
    """Returns whether an edge contains the origin at the positive roots of a component of its cross product.

    Args:
        polygon: The polygon.
        first: Corner at which the edge starts.
        second: Corner at which it ends.
        axis: Axis of the component.
        c0: Constant coefficient of the component.
        c1: Coefficient of z in the component.
        c2: Coefficient of z^2 in the component.
        roots: Number of its positive roots, with multiplicity, 1 or 2.

    Returns:
        Two Booleans, for the smaller root first; for a single root, twice the same.
    """
    at_first = bool(True)
    at_second = bool(True)
    zero = subtract(c0, c0)
    i = int(0)
    while i < 3 and (at_first or at_second):
        if i != axis:
            p0, p1, p2 = cross_component(polygon, first, second, i)
            s = signs_at_roots(p0, p1, p2, zero, c0, c1, c2, roots)
            at_first = at_first and s[0] == 0
            at_second = at_second and s[1] == 0
        i += 1
    i = int(0)
    while i < 3 and (at_first or at_second):
        a0 = widen(coordinate(polygon, first, 0, i))
        a1 = widen(coordinate(polygon, first, 1, i))
        b0 = widen(coordinate(polygon, second, 0, i))
        b1 = widen(coordinate(polygon, second, 1, i))
        a = signs_at_roots(a0, a1, zero, zero, c0, c1, c2, roots)
        b = signs_at_roots(b0, b1, zero, zero, c0, c1, c2, roots)
        at_first = at_first and a[0] * b[0] <= 0
        at_second = at_second and a[1] * b[1] <= 0
        i += 1
    return at_first, at_second


@wp.func(**NOT_INLINED)
def edge_contact(polygon: wp.array[Any], first: int, second: int, digits: int) -> wp.float64:
    """Returns when an edge of the polygon first contains the origin, rounded down to a multiple of 2^-digits, or NONE.

    Args:
        polygon: The polygon.
        first: Corner at which the edge starts.
        second: Corner at which it ends.
        digits: Binary digits of the time, at most 38.
    """
    if _edge_touches_at_end(polygon, first, second, 0):
        return _0
    result = NONE
    if _edge_touches_at_end(polygon, first, second, 1):
        result = _1
    axis = int(0)
    while axis < 3:
        c0, c1, c2 = cross_component(polygon, first, second, axis)
        if sign(c0) != 0 or sign(c1) != 0 or sign(c2) != 0:
            roots = count_quadratic_roots(c0, c1, c2)
            if roots > 0:
                at_first, at_second = _between_at_roots(polygon, first, second, axis, c0, c1, c2, roots)
                if at_first or at_second:
                    # the only positive root is the third of a cubic, two are the second and the third
                    index = wp.where(roots == 2 and at_first, 1, 2)
                    return root_time(c0, c1, c2, subtract(c0, c0), roots, index, digits)
            return result
        axis += 1
    # A and B are parallel all the time: the roots of A . B, a quadratic
    a0 = coordinate(polygon, first, 0, 0)
    a1 = coordinate(polygon, first, 1, 0)
    b0 = coordinate(polygon, second, 0, 0)
    b1 = coordinate(polygon, second, 1, 0)
    d0 = product(a0, b0)
    d1 = add(product(a0, b1), product(a1, b0))
    d2 = product(a1, b1)
    axis = int(1)
    while axis < 3:
        a0 = coordinate(polygon, first, 0, axis)
        a1 = coordinate(polygon, first, 1, axis)
        b0 = coordinate(polygon, second, 0, axis)
        b1 = coordinate(polygon, second, 1, axis)
        d0 = add(d0, product(a0, b0))
        d1 = add(d1, add(product(a0, b1), product(a1, b0)))
        d2 = add(d2, product(a1, b1))
        axis += 1
    roots = count_quadratic_roots(d0, d1, d2)
    if roots > 0:
        return root_time(d0, d1, d2, subtract(d0, d0), roots, 3 - roots, digits)
    return result


@wp.func(**NOT_INLINED)
def _component_signs(
    polygon: wp.array[Any],
    first: int,
    second: int,
    axis: int,
    v0: Any,
    v1: Any,
    v2: Any,
    v3: Any,
    roots: int,
    constant: bool,
):
    """Returns the signs of a component of the cross product of an edge's corners at the roots of V.

    Args:
        polygon: The polygon.
        first: Corner at which the edge starts.
        second: Corner at which it ends.
        axis: Axis of the component.
        v0: Constant coefficient of V.
        v1: Coefficient of z in V.
        v2: Coefficient of z^2 in V.
        v3: Coefficient of z^3 in V.
        roots: Number of positive roots of V, with multiplicity.
        constant: Whether to return signs only of a component that has no positive root.

    Returns:
        Signs at the roots a1 <= a2 <= a3 of V, whose positive ones are the last, or zeros; and whether the component
        has positive roots.
    """
    c0, c1, c2 = cross_component(polygon, first, second, axis)
    turns = count_quadratic_roots(c0, c1, c2)
    if turns > 0 and constant:
        return wp.vec3i(0, 0, 0), True
    return signs_at_cubic_roots(c0, c1, c2, turns, v0, v1, v2, v3, roots), turns > 0


@wp.func
def first_contact_exactly(kind: int, polygon: wp.array[Any], timed: bool, digits: int, is_wide: bool) -> wp.float64:
    """Returns the time of the first contact of a query, rounded down to a multiple of 2^-digits, or NONE.

    Args:
        kind: VERTEX_FACE or EDGE_EDGE.
        polygon: The polygon of the query, of at most BITS.
        timed: Whether the time is needed; if not, any time of at most 1 stands for contact.
        digits: Binary digits of the time, at most 38.
        is_wide: Whether signs at roots take much longer than components.
    """
    corners = wp.where(kind == VERTEX_FACE, 3, 4)
    v0, v1, v2, v3 = volume(polygon, corners - 1)
    s0 = sign(v0)
    s3 = sign(v3)
    collapses = s0 == 0 and s3 == 0 and sign(v1) == 0 and sign(v2) == 0
    toi = NONE
    if s0 == 0:
        touches = _touches_at_end(polygon, corners, 0)
        if touches > 0:
            return _0
        collapses = collapses or touches < 0
    if s3 == 0:
        touches = _touches_at_end(polygon, corners, 1)
        if touches > 0:
            toi = _1
            if not timed:
                return toi
        collapses = collapses or touches < 0

    roots = count_cubic_roots(v0, v1, v2, v3)
    is_open = wp.vec3i(wp.where(roots == 3, 1, 0), wp.where(roots > 1, 1, 0), wp.where(roots > 0, 1, 0))
    hit = wp.vec3i(0, 0, 0)
    # of wide integers, components without roots along all axes first: most often they decide the query
    attempt = wp.where(is_wide, 0, 3)
    while attempt < 6 and wp.max(is_open) > 0:
        low = wp.vec3i(0, 0, 0)
        high = wp.vec3i(0, 0, 0)
        later = int(0)  # the components with roots, as bits
        step = int(0)
        while step < wp.where(attempt < 3, corners, 2 * corners):
            corner = wp.where(step < corners, step, step - corners)
            is_next = step < corners or ((later >> corner) & 1) == 1
            if is_next and wp.max(wp.cw_mul(is_open, wp.vec3i(1, 1, 1) + wp.cw_mul(low, high))) > 0:
                signs, turns = _component_signs(
                    polygon, corner, _next(corner, corners), attempt % 3, v0, v1, v2, v3, roots, step < corners
                )
                if turns and step < corners:
                    later = later | (1 << corner)
                low = wp.min(low, signs)
                high = wp.max(high, signs)
            step += 1
        is_known = wp.where(attempt < 3 and later != 0, 0, 1)
        for root in range(3):
            one_sign = is_open[root] * (high[root] - low[root])  # 0: all are zero, 1: one weak sign, 2: opposite signs
            hit[root] += wp.where(one_sign == 1, is_known, 0)
            is_open[root] = wp.where(one_sign == 2 or (one_sign == 1 and is_known == 1), 0, is_open[root])
        attempt += 1
    if wp.max(hit) > 0:
        if not timed:
            return _0
        index = wp.where(hit[0] > 0, 0, wp.where(hit[1] > 0, 1, 2))
        toi = wp.min(toi, root_time(v0, v1, v2, v3, roots, index, digits))
    if collapses or wp.max(is_open) > 0:
        corner = int(0)
        while corner < corners:
            toi = wp.min(toi, edge_contact(polygon, corner, _next(corner, corners), digits))
            corner += 1
    return toi


for _limbs in BITS:
    _Integer = integer(_limbs)

    @wp.func
    def _decide(kind: int, polygon: wp.array[_Integer], timed: bool, digits: int, is_wide: bool) -> wp.float64:
        """Returns :func:`first_contact_exactly`; an array of a known type is not copied at each call."""
        return first_contact_exactly(kind, polygon, timed, digits, is_wide)


@functools.cache
def decide_in(limbs: int) -> wp.Function:
    """Returns a device function that decides queries in integers of ``limbs`` limbs per coordinate, a key of BITS."""
    number = integer(limbs)
    largest = BITS[limbs]

    @wp.func
    def decide(kind: int, query: Query, timed: bool, digits: int) -> wp.float64:
        """Returns :func:`first_contact_exactly` of a query, or TOO_WIDE.

        Args:
            kind: VERTEX_FACE or EDGE_EDGE.
            query: The points.
            timed: Whether the time is needed, see :func:`first_contact_exactly`.
            digits: Binary digits of the time, at most 38.
        """
        polygon = wp.zeros(shape=(24,), dtype=number)
        fits = int(-1)
        if wp.static(limbs == 1):
            fits = make_narrow_polygon(kind == EDGE_EDGE, query, polygon)
        if fits < 0:
            exponents, bits = spread(kind, query)
            if bits > largest:
                return TOO_WIDE
            make_polygon(kind == EDGE_EDGE, query, exponents, polygon)
        elif fits == 0:
            return TOO_WIDE
        return _decide(kind, polygon, timed, digits, wp.static(limbs > 1))

    return decide
