"""Exact decision whether a moving tetrahedron inverts, in wide integers (Sec. 4.1).

Its volume is the cubic V of the polygon of vertex d and face a b c, see :mod:`.polygon`, which derives how wide numbers
become. It is not positive at some time if it is not at one of both ends, or has a root in between.
"""

import functools

import warp as wp

from ..motion import Query
from ..polynomials import VERTEX_FACE
from ..signs import FREE, HIT, UNSURE
from .algebraic import count_cubic_roots
from .polygon import BITS, make_polygon, spread, volume
from .wide_integers import integer, sign

_LAST_CORNER = wp.constant(2)

for _limbs in BITS:
    _Integer = integer(_limbs)

    @wp.func
    def _inverts(polygon: wp.array[_Integer]) -> bool:
        """Returns whether a tetrahedron inverts, from the polygon of vertex d and face a b c."""
        v0, v1, v2, v3 = volume(polygon, _LAST_CORNER)
        # the corners of the polygon are d - a, d - b and d - c: V is six times the volume
        if sign(v0) <= 0 or sign(v3) <= 0:
            return True
        return count_cubic_roots(v0, v1, v2, v3) > 0


@functools.cache
def tetrahedron_inverts_in(limbs: int) -> wp.Function:
    """Returns a device function that decides in integers of ``limbs`` limbs per coordinate, a key of BITS."""
    number = integer(limbs)
    largest = BITS[limbs]

    @wp.func
    def tetrahedron_inverts(tetrahedron: Query) -> int:
        """Returns whether the volume of a tetrahedron is not positive at some time: FREE or HIT; UNSURE if too wide.

        Args:
            tetrahedron: The points of vertex d and face a b c.
        """
        exponents, bits = spread(VERTEX_FACE, tetrahedron)
        if bits > largest:
            return UNSURE
        polygon = wp.zeros(shape=(24,), dtype=number)
        make_polygon(False, tetrahedron, exponents, polygon)
        return wp.where(_inverts(polygon), HIT, FREE)

    return tetrahedron_inverts
