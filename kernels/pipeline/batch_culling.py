"""The culls of many pairs at once, by SIMD instructions of a CPU.

The box test compares one pair at a time, all coordinates of both ends in one vector. The other culls test the remaining
pairs in SIMD packets of eight: they consist of the same additions, multiplications and comparisons for every pair.
The operations are those of :mod:`warp_bsc.kernels.culling` and :mod:`warp_bsc.kernels.polynomials`, in the same order,
and the bounds on their errors are the same.

Pairs are not scaled: scaling by powers of two affects overflow and underflow alone. Overflow does not occur, because
pairs with vectors of 1e70 or more are culled by boxes only. Underflow changes each of at most four products of a
component of the normal by 2^-1074, or 2^-1022 where subnormal numbers are flushed, before the product with w. The error
is below the UNDERFLOW that bounds add, times the roundoff, 1e-156.

Flushing subnormal numbers changes each coordinate by less than delta, the smallest normal number, and u, v and w by
2 delta. A product of three vectors below m then changes by less than 6 delta m^2, and a coefficient of Y is a mean of
sums of six products. A comparison along a direction has three products for each of its components, and changes by less
than 6 delta times the sum of their sizes. The bounds therefore add 40 delta.

With a roundoff of zero (method "float") all bounds are zero.
"""

import functools

import warp as wp

from ..culling import DIRECTION_ERROR
from ..polynomials import COPLANARITY_ERROR
from ..signs import UNDERFLOW
from .simd import native_for_pairs

BATCH = wp.constant(64)
"""Pairs that one call culls."""

_LARGEST = 1.0e70

_SNIPPET = """
    // box test, pair by pair: x y z of both ends in one vector
    int near[batch];
    int near_count = 0;
    for (int i = 0; i < count; ++i) {
        int corner[4];
        corners_of(first + i, corner);
        auto later = [](int a, int b) { return a > b ? a : b; };
        const bool has_fourth = later(later(corner[0], corner[1]), later(corner[2], corner[3])) < last;
        auto ends = [&](int i) { return both(position(x0, corner[i]), position(x1, corner[i]), has_fourth); };
        const Scalars a = ends(0), b = ends(1), c = ends(2), d = ends(3);
        Scalars low = a, high = a;
        Scalars other_low = __builtin_elementwise_min(c, d), other_high = __builtin_elementwise_max(c, d);
        if (vertex_face) {
            other_low = __builtin_elementwise_min(other_low, b);
            other_high = __builtin_elementwise_max(other_high, b);
        } else {
            low = __builtin_elementwise_min(a, b);
            high = __builtin_elementwise_max(a, b);
        }
        const int above = bits(other_low > high), below = bits(low > other_high);
        const int apart = ((above & (above >> 4)) | (below & (below >> 4))) & 7;
        near[near_count] = i;
        near_count += apart == 0;
    }

    unsigned long long left = 0;
    for (int group = 0; group < near_count; group += 8) {
        const int filled = near_count - group < 8 ? near_count - group : 8;
        int slots[8];
        for (int lane = 0; lane < 8; ++lane)
            slots[lane] = first + near[group + (lane < filled ? lane : 0)];
        Scalars points[24];
        read_points(slots, points);

        // Bernstein signs
        const Relative r = relative(points);
        const Vectors u0 = r.u0, v0 = r.v0, w0 = r.w0, u1 = r.u1, v1 = r.v1, w1 = r.w1;
        const Vectors n0 = cross(u0, v0), n1 = cross(u1, v1);
        const Vectors twice_nh = plus(cross(u0, v1), cross(u1, v0));
        const Doubles k0 = dot(w0, n0), k3 = dot(w1, n1);
        const Doubles k1 = (dot(w0, twice_nh) + dot(w1, n0)) * (1.0 / 3.0);
        const Doubles k2 = (dot(w1, twice_nh) + dot(w0, n1)) * (1.0 / 3.0);
        // bounds take longer than signs: only where some lane has one sign; with a roundoff of zero they are zero
        int unsure = (1 << filled) - 1;
        const Doubles lowest_k = least(least(k0, k1), least(k2, k3)), highest_k = most(most(k0, k1), most(k2, k3));
        if (bits((lowest_k > 0.0) | (highest_k < 0.0)) & unsure) {
            Doubles bound = 0.0;
            int trusted = 255;
            if (roundoff > 0.0) {
                const Vectors u = sizes(u0, u1), v = sizes(v0, v1), w = sizes(w0, w1);
                const Vectors uv = {u.y * v.z + u.z * v.y, u.z * v.x + u.x * v.z, u.x * v.y + u.y * v.x};
                const Vectors size = plus(plus(u, v), w);
                const Doubles extent = most(most(size.x, size.y), size.z);
                bound = roundoff * (coplanarity_error * dot(w, uv) + underflow) + flushed * extent * extent;
                trusted = bits(extent < largest_size);
            }
            unsure &= ~(bits((lowest_k > bound) | (highest_k < -bound)) & trusted);
            if (!unsure)
                continue;
        }

        // separating direction
        const Vectors us = plus(u0, u1), vs = plus(v0, v1), ws = plus(w0, w1);
        const Vectors direction
            = vertex_face ? minus(ws, times(1.0 / 3.0, plus(us, vs))) : plus(ws, times(0.5, minus(vs, us)));
        const Doubles du0 = dot(direction, u0), du1 = dot(direction, u1), zero = 0.0;
        const Doubles dv0 = dot(direction, v0), dv1 = dot(direction, v1);
        const Doubles dw0 = dot(direction, w0), dw1 = dot(direction, w1);
        Doubles lowest, highest;
        if (vertex_face) {
            lowest = least(dw0 - most(most(du0, dv0), zero), dw1 - most(most(du1, dv1), zero));
            highest = most(dw0 - least(least(du0, dv0), zero), dw1 - least(least(du1, dv1), zero));
        } else {
            lowest = least(dw0 - most(du0, zero) + least(dv0, zero), dw1 - most(du1, zero) + least(dv1, zero));
            highest = most(dw0 - least(du0, zero) + most(dv0, zero), dw1 - least(du1, zero) + most(dv1, zero));
        }
        if (bits((lowest > 0.0) | (highest < 0.0)) & unsure) {
            Doubles slack = 0.0;
            int trusted = 255;
            if (roundoff > 0.0) {
                const Vectors along = sizes(direction, direction);
                const Vectors size = plus(plus(sizes(u0, u1), sizes(v0, v1)), sizes(w0, w1));
                slack = roundoff * (direction_error * dot(along, size) + underflow)
                    + flushed * (along.x + along.y + along.z);
                trusted = bits(most(most(size.x, size.y), size.z) < largest_size);
            }
            unsure &= ~(bits((lowest > slack) | (highest < -slack)) & trusted);
        }
        for (int lane = 0; lane < filled; ++lane)
            left |= (unsigned long long)((unsure >> lane) & 1) << near[group + lane];
    }
    return left;
"""


@functools.cache
def cull_batch_of(dtype: type, vertex_face: bool) -> wp.Function:
    """Returns the function that culls a batch of pairs, for one type of position and one kind of pair.

    Args:
        dtype: Type of a position, vec3 or vec3d.
        vertex_face: Whether pairs are (vertex, face); otherwise (edge, edge).

    Returns:
        Device function for the CPU. Its arguments are the positions at both ends, the vertices of the elements, a queue
        of pairs, the first pair of the batch, the number of pairs in it, at most :data:`BATCH`, and the roundoff. It
        returns a bit for each pair, set where no cull decides the pair. Indices are not checked.
    """
    snippet = native_for_pairs(
        dtype,
        vertex_face,
        _SNIPPET,
        batch=int(BATCH),
        coplanarity_error=float(COPLANARITY_ERROR),
        direction_error=float(DIRECTION_ERROR),
        underflow=float(UNDERFLOW),
        largest_size=_LARGEST,
        flushed=40.0 * 2.0 ** (-126 if dtype is wp.vec3 else -1022),
    )

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
        # rounding
        roundoff: wp.float64,
    ) -> wp.uint64: ...

    return cull_batch
