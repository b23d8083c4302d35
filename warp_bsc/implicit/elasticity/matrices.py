"""Matrices in float64, and blocks of either precision that they are written to."""

import warp as wp

from ...response.state.vectors import ZERO
from ..vector_access import mat34, store_block

wp.set_module_options({"enable_backward": False})

mat43d = wp.types.matrix(shape=(4, 3), dtype=wp.float64)
"""A row for each corner of an element."""


@wp.func
def cross_matrix(a: wp.vec3d) -> wp.mat33d:
    """Returns the matrix [a] for which [a] b is the cross product of a and b."""
    return wp.mat33d(ZERO, -a[2], a[1], a[2], ZERO, -a[0], -a[1], a[0], ZERO)


@wp.func
def identity() -> wp.mat33d:
    """Returns the identity."""
    return wp.identity(n=3, dtype=wp.float64)


@wp.func
def store(blocks: wp.array[wp.mat33d], k: int, block: wp.mat33d):  # pyright: ignore[reportRedeclaration] (overload)
    """Writes a block."""
    blocks[k] = block


@wp.func
def store(blocks: wp.array[mat34], k: int, block: wp.mat33d):  # noqa: F811
    """Writes a block in single precision."""
    store_block(blocks, k, block)
