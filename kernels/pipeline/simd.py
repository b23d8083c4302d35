"""What native functions of pairs share: the motion, polynomials and closest points of eight queries at once.

Native functions are text. They use the vector extensions of Clang, which Warp compiles CPU kernels with, so that the
width of the instructions is that of the processor.

Operations and their order are those of the functions for one query, which have the same names, in
:mod:`warp_bsc.kernels.motion`, :mod:`~warp_bsc.kernels.polynomials`, :mod:`~warp_bsc.kernels.closest` and
:mod:`~warp_bsc.kernels.culling`: both compute the same bits. Signs are sets of lanes, the bits of a number: those with
a positive and those with a negative value.

Lanes whose motion is out of range, or that have subnormal numbers in single precision, which a processor may flush to
zero, are not usable: they are delegated to the functions for one query.
"""

import warp as wp

from ..culling import DIRECTION_ERROR
from ..native_text import definitions, header
from ..polynomials import COPLANARITY_ERROR, DIFFERENCE_ERROR, PRODUCT_ERROR, REMAINDER_ERROR
from ..signs import UNDERFLOW

_CONSTANTS = {
    "coplanarity_error": float(COPLANARITY_ERROR),
    "product_error": float(PRODUCT_ERROR),
    "difference_error": float(DIFFERENCE_ERROR),
    "remainder_error": float(REMAINDER_ERROR),
    "direction_error": float(DIRECTION_ERROR),
    "underflow": float(UNDERFLOW),
}


def native_for_pairs(dtype: type, vertex_face: bool, *headers: str, **constants: float) -> str:
    """Returns the text of a native function of pairs of elements, with arguments x0, x1, elements, pairs and roundoff.

    Args:
        dtype: Type of a position, vec3 or vec3d.
        vertex_face: Whether pairs are (vertex, face); otherwise (edge, edge).
        headers: Headers of this folder's ``native`` that make the function, after those that all have.
        constants: Numbers that they use, by name; ``roundoff`` too, if it is no argument.
    """
    scalar = {"Scalar": "float" if dtype is wp.vec3 else "double"}
    text = header(__file__, "lanes.h", "positions.h", "simd.h", "simd_query.h", *headers)
    return definitions(scalar, vertex_face=vertex_face, **_CONSTANTS, **constants) + text
