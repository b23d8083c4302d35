"""The times of impact of many pairs at once, in SIMD packets of eight.

It is :func:`warp_bsc.kernels.time_of_impact.impact`, operation by operation, so that it finds the same bits. A pair
whose search ends makes room for the next one of the batch, so that no lane waits for a harder neighbour. Pairs that
:mod:`.simd` cannot use stay open.

**Touching.** Without times the search is omitted for features that certainly touch, but nowhere with strict signs: no
search could certify a hit, nor that they are free, so that they remain UNSURE. Obstacles along the axes make them
common. Where three points, two of one feature, have the same coordinate along an axis at both ends, the inside test of
their border is zero along the other axes, exactly. So there is contact at the only root of Y if the other three tests
have one strict sign there, which makes n non-zero, and the test is zero along all axes. If all four points have
the same coordinate, Y is zero, and they are in contact where all tests along that axis have one strict sign. Bits of
coordinates are compared, because subnormal numbers may be equal to zero.
"""

import functools

import warp as wp

from ..closest import FLAT
from ..roots import ROOT_CONSTANTS
from ..signs import FREE, HIT, UNSURE
from ..time_of_impact import SEARCH_CONSTANTS
from .simd import native_for_pairs

BATCH = wp.constant(64)
"""Pairs that one call decides."""

_CONSTANTS = ROOT_CONSTANTS | SEARCH_CONSTANTS | {"flat": float(FLAT), "batch": int(BATCH)}
_CONSTANTS |= {"FREE": int(FREE), "HIT": int(HIT), "UNSURE": int(UNSURE)}


@functools.cache
def impact_batch_of(dtype: type, vertex_face: bool) -> wp.Function:
    """Returns the function that finds the impacts of a batch; arguments are those of :func:`.native_for_pairs`.

    It is a device function for the CPU. Its own arguments are the positions at both ends, the vertices of the elements,
    an array of pairs, the first pair of the batch, the number of pairs in it, at most :data:`BATCH`, the roundoff,
    whether times are needed, the largest power of two that is at most the tolerance, and the arrays that it changes in
    the rows of the pairs: statuses by classification, HIT or UNSURE, and if times are needed whether they are within
    the tolerance, the times, and the coordinates and normals of those that are not FREE. Without times it only decides
    what is UNSURE. It returns two sets of pairs, as bits: those that remain open, and those that are touching. Indices
    are not checked.
    """
    snippet = native_for_pairs(dtype, vertex_face, "simd_roots.h", "append.h", "batch_impacts.h", **_CONSTANTS)

    @wp.func_native(snippet)
    def impact_batch(
        # mesh
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        elements: wp.array2d[int],
        # batch
        pairs: wp.array[wp.vec2i],
        first: int,
        count: int,
        # rounding and time
        roundoff: wp.float64,
        timed: bool,
        length: wp.float64,
        # in and out
        status: wp.array[wp.int8],
        # out
        within_tolerance: wp.array[wp.bool],
        toi: wp.array[wp.float64],
        coordinates: wp.array[wp.vec3d],
        normal: wp.array[wp.vec3d],
    ) -> wp.vec2ul: ...

    return impact_batch
