"""The cull of many pairs with a turning vertex at once, by SIMD instructions of a CPU.

Their chords must stay farther apart than the bounds of the deviations of both elements together, see
:mod:`warp_bsc.kernels.arcs`. That is shown for the whole step by the plane of the pair or the direction through the
centroids, the first two proofs of :mod:`.separation_proof`; or by directions between the closest points at a few times,
each for the times around its own, as in the advancement of :mod:`warp_bsc.kernels.min_distance`. Bounds are theirs.
Pairs that :mod:`.simd` cannot use stay open.
"""

import functools

import warp as wp

from ..min_distance import AWAY, SHORTEST, SMALLEST
from ..pairs import ABOVE_SUM
from ..separation_proof import INFLATED, NORMAL_ERROR, PLANE_ERROR
from ..signs import ROUNDOFF
from .simd import native_for_pairs

_ROUNDS = 4
"""Times at which directions are tried: the start, the end, and the middle of what remains."""

_CONSTANTS = {
    "roundoff": float(ROUNDOFF),
    "inflated": float(INFLATED),
    "normal_error": float(NORMAL_ERROR),
    "plane_error": float(PLANE_ERROR),
    "smallest": float(SMALLEST),
    "above_sum": float(ABOVE_SUM),
    "rounds": _ROUNDS,
    "away": float(AWAY),
    "shortest": float(SHORTEST),
}


@functools.cache
def cull_arc_batch_of(dtype: type, vertex_face: bool) -> wp.Function:
    """Returns the function that culls a batch of pairs on arcs; arguments are those of :func:`.native_for_pairs`.

    It is a device function for the CPU. Its own arguments are the positions at both ends, the vertices of the elements,
    a queue of pairs, the bounds of the deviation of each vertex over the whole step, the first pair of the batch and
    the number of pairs in it, at most 64. It returns a bit for each pair, set where no proof decides the pair. Indices
    are not checked.
    """
    snippet = native_for_pairs(dtype, vertex_face, "batch_arc_culling.h", **_CONSTANTS)

    @wp.func_native(snippet)
    def cull_arc_batch(
        # mesh
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        elements: wp.array2d[int],
        # batch
        pairs: wp.array[wp.vec2i],
        deviation: wp.array[wp.float64],
        first: int,
        count: int,
    ) -> wp.uint64: ...

    return cull_arc_batch
