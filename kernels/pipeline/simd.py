"""What native functions for SIMD packets of eight pairs share: vectors of eight numbers, and the points of eight pairs.

Native functions are text. They use the vector extensions of Clang, which Warp compiles CPU kernels with, so that the
width of the instructions is that of the processor.
"""

import warp as wp

from ..native_text import definitions, header


def native_for_pairs(dtype: type, vertex_face: bool, *headers: str, **constants: float) -> str:
    """Returns the text of a native function of pairs of elements, with arguments x0, x1, elements and pairs.

    Args:
        dtype: Type of a position, vec3 or vec3d.
        vertex_face: Whether pairs are (vertex, face); otherwise (edge, edge).
        headers: Headers of this folder's ``native`` that make the function, after ``positions.h`` and ``simd.h``.
        constants: Numbers that they use, by name.
    """
    scalar = {"Scalar": "float" if dtype is wp.vec3 else "double"}
    texts = [header(__file__, name) for name in ("positions.h", "simd.h", *headers)]
    return definitions(scalar, vertex_face=vertex_face, **constants) + "".join(texts)
