"""The culls of many pairs at once, by SIMD instructions of a CPU.

The box test compares one pair at a time, all coordinates of both ends in one vector. The other culls test eight of the
remaining pairs at once, by the operations of :mod:`warp_bsc.kernels.culling` and :mod:`warp_bsc.kernels.polynomials` in
the same order, with the same bounds on their errors.

Pairs are not scaled: scaling by powers of two affects overflow and underflow alone. Overflow does not occur, because
pairs with vectors of 1e70 or more are culled by boxes only. Underflow changes each of at most four products of a
component of the normal by 2^-1074, or 2^-1022 where subnormal numbers are flushed, before the product with w. The error
is below the UNDERFLOW that bounds add, times the roundoff, 1e-156.

Flushing subnormal numbers changes each coordinate by less than delta, the smallest normal number, and u, v and w by
2 delta. A product of three vectors below m then changes by less than 6 delta m^2, and a coefficient of Y is a mean of
sums of six products. A comparison along a direction has three products for each of its components, and changes by less
than 6 delta times the sum of their sizes. The bounds therefore add 40 delta.

With a roundoff of zero (method "float") all bounds are zero.

Where positions are in single precision and boxes are known to meet, most pairs are first decided in single precision,
as double precision would decide them. If e is the largest component of u, v and w, rounding changes a coefficient of Y
by less than 68 * 2^-24 e^3, and a gap by less than 318 * 2^-24 e^2; flushing and double precision change them by much
less where e is between 2^-32 and 2^40. So signs of coefficients beyond 2^-17 e^3, and of gaps beyond 2^-15 e^2, are the
same in both. Where these signs neither cull a pair nor keep it, double precision decides.
"""

import functools

import warp as wp

from .simd import native_for_pairs

BATCH = wp.constant(64)
"""Pairs that one call culls."""


@functools.cache
def cull_batch_of(dtype: type, vertex_face: bool) -> wp.Function:
    """Returns the function that culls a batch of pairs; arguments are those of :func:`.native_for_pairs`.

    It is a device function for the CPU. Its own arguments are the positions at both ends, the vertices of the elements,
    a queue of pairs, the first of the batch, their number, at most :data:`BATCH`, whether boxes are known to meet, and
    the roundoff. It returns a bit for each pair, set where no cull decides it. Indices are not checked.
    """
    flushed = 40.0 * 2.0 ** (-126 if dtype is wp.vec3 else -1022)
    snippet = native_for_pairs(dtype, vertex_face, "batch_culling.h", batch=int(BATCH), flushed=flushed)

    @wp.func_native(snippet)
    def cull_batch(
        # mesh
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        elements: wp.array2d[int],
        # batch
        pairs: wp.array[wp.vec2i],
        first: int,
        count: int,
        boxes_meet: bool,
        # rounding
        roundoff: wp.float64,
    ) -> wp.uint64: ...

    return cull_batch
