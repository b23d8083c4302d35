"""The classification of many pairs at once, in SIMD packets of eight.

It is :func:`warp_bsc.kernels.classification.classify`, operation by operation, so that it finds the same statuses. It
leaves open the few pairs whose cubic is to be split at its inflection, those that :mod:`.simd` cannot use,
and with a roundoff of zero (method "float") those that remain unsure, whose zeros need more cases.
"""

import functools

import warp as wp

from ..classification import SPLIT_ERROR, TINY
from ..roots import ROOT_CONSTANTS
from .simd import native_for_pairs

BATCH = wp.constant(32)
"""Pairs that one call classifies."""

OPEN = wp.constant(3)
"""Stands for a status, where a pair remains open."""

_CONSTANTS = ROOT_CONSTANTS | {"split_error": float(SPLIT_ERROR), "tiny_share": float(TINY)}


@functools.cache
def classify_batch_of(dtype: type, vertex_face: bool) -> wp.Function:
    """Returns the function that classifies a batch of pairs; arguments are those of :func:`.native_for_pairs`.

    It is a device function for the CPU. Its own arguments are the positions at both ends, the vertices of the elements,
    a queue of pairs, the first pair of the batch, the number of pairs in it, at most :data:`BATCH`, and the roundoff.
    It returns two bits for each pair: its status, or :data:`OPEN`. Indices are not checked.
    """
    snippet = native_for_pairs(dtype, vertex_face, "simd_roots.h", "batch_classification.h", **_CONSTANTS)

    @wp.func_native(snippet)
    def classify_batch(
        # mesh
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        elements: wp.array2d[int],
        # batch
        pairs: wp.array[wp.vec2i],
        first: int,
        count: int,
        # rounding
        roundoff: wp.float64,
    ) -> wp.uint64: ...

    return classify_batch
