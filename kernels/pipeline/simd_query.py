"""Motion, polynomials and closest points of eight queries at once, for native functions.

Operations and their order are those of the functions for one query, which have the same names, in
:mod:`warp_bsc.kernels.motion`, :mod:`~warp_bsc.kernels.polynomials`, :mod:`~warp_bsc.kernels.closest` and
:mod:`~warp_bsc.kernels.culling`: both compute the same bits. Signs are sets of lanes, the bits of a number: those with
a positive and those with a negative value.

Lanes whose motion is out of range, or that have subnormal numbers in single precision, which a processor may flush to
zero, are not usable: they are delegated to the functions for one query.
"""

from ..culling import DIRECTION_ERROR
from ..polynomials import COPLANARITY_ERROR, DIFFERENCE_ERROR, PRODUCT_ERROR, REMAINDER_ERROR
from ..signs import UNDERFLOW

QUERY_CONSTANTS = {
    "coplanarity_error": float(COPLANARITY_ERROR),
    "product_error": float(PRODUCT_ERROR),
    "difference_error": float(DIFFERENCE_ERROR),
    "remainder_error": float(REMAINDER_ERROR),
    "direction_error": float(DIRECTION_ERROR),
    "underflow": float(UNDERFLOW),
}
"""Constants of the header ``simd_query.h``, by name; it needs an argument ``roundoff`` as well."""
