"""Contacts of one vertex pair, or of a vertex and an edge, as one in a solve: each face and edge there has found it.

They have the same closest points, so that gradients, Hessians and friction add up. Impulses are those of each pair.
"""

from typing import Any

import warp as wp

from ...response.state.vectors import ZERO, to_double
from ..vector_access import store_block, stored_block
from .system import Contacts, sum_of_parts

wp.set_module_options({"enable_backward": False})


@wp.func
def _lost(a: Any, b: Any, total: Any):
    """Returns what rounding takes from a sum of two: with it, sums do not depend on the order of their terms.

    Knuth, The Art of Computer Programming, volume 2, section 4.2.2, theorem B.
    """
    rounded = total - a
    return (a - (total - rounded)) + (b - rounded)


@wp.func_native(
    snippet="""
#if defined(__CUDA_ARCH__)
    const unsigned mask = ((1u << parts) - 1u) << (threadIdx.x & 31u & ~(unsigned)(parts - 1));
    for (int offset = parts / 2; offset > 0; offset /= 2) {
        const double other = __shfl_xor_sync(mask, value, offset), more = __shfl_xor_sync(mask, lost, offset);
        const double total = value + other, rounded = total - value;
        lost += more + ((value - (total - rounded)) + (other - rounded));
        value = total;
    }
#endif
    return (float)(value + lost);
"""
)
def _sum_of_parts(value: wp.float64, lost: wp.float64, parts: int) -> float:
    """Returns the sum of the values of ``parts`` threads, and of what they lost; 1 on a CPU."""
    ...


@wp.func
def _first_bucket(contacts: Contacts, world: int, feature: wp.vec3i) -> int:
    number = wp.uint32(feature[0]) * wp.uint32(73856093) + wp.uint32(feature[1]) * wp.uint32(19349663)
    number += wp.uint32(feature[2]) * wp.uint32(83492791)
    first, end = contacts.first_bucket[world], contacts.first_bucket[world + 1]
    return contacts.parts * (first + int((number ^ (number >> wp.uint32(15))) % wp.uint32(end - first)))


@wp.func
def clear_buckets(world: int, thread: int, threads: int, contacts: Contacts):
    """Empties the buckets of a world, as one of so many threads."""
    first, end = contacts.first_bucket[world], contacts.first_bucket[world + 1]
    for k in range(contacts.parts * first + thread, contacts.parts * end, threads):
        contacts.bucket[k] = 0


@wp.func
def link_contact(contacts: Contacts, world: int, i: int, corners: wp.vec4i, weights: wp.vec4d):
    """Notes the vertices of a contact, where it has no more than three, for :func:`merge_contact`."""
    low, high, count = wp.vec2i(2147483647), wp.vec2i(-1), wp.vec2i()
    for j in range(4):
        if weights[j] != ZERO:
            side = int(weights[j] < ZERO)
            low[side] = wp.min(low[side], corners[j])
            high[side] = wp.max(high[side], corners[j])
            count[side] += 1
    contacts.feature[i] = wp.vec3i(-1)
    if count[0] * count[1] == 1 or count[0] * count[1] == 2:
        # a vertex, of two that of the lower number, and the other vertex twice or those of the edge
        one = int(count[0] > count[1] or (count[0] == count[1] and low[0] > low[1]))
        feature = wp.vec3i(low[one], low[1 - one], high[1 - one])
        bucket = _first_bucket(contacts, world, feature) + i % contacts.parts
        contacts.feature[i] = feature
        contacts.next[i] = wp.atomic_exch(contacts.bucket, bucket, i + 1)


@wp.func
def merge_contact(i: int, part: int, world: int, contacts: Contacts):
    """Adds to a contact all that have its vertices, or takes its weights where another one, of a lower key, does so.

    The vector between the closest points is the other way round where the sides of the pair are. So many threads share
    a contact, each with a bucket.
    """
    feature, key = contacts.feature[i] + wp.vec3i(), contacts.key[i] + wp.int64(0)
    if feature[0] < 0:
        return
    first = contacts.bucket[_first_bucket(contacts, world, feature) + part] + int(0)
    lower, count, n, parts = float(0.0), float(0.0), int(first), contacts.parts
    while n > 0:
        # read side by side: most of the time is waiting for memory
        k = n - 1
        of_feature, of_key = contacts.feature[k] + wp.vec3i(), contacts.key[k] + wp.int64(0)
        n = contacts.next[k] + int(0)
        if of_feature == feature:
            count += 1.0
            if of_key < key:
                lower, n = 1.0, 0
    found = sum_of_parts(wp.vec3(lower, count, 0.0), parts)
    if found[0] > 0.0:
        contacts.weights[i] = wp.vec4()
        contacts.couples[i] = 0
    elif found[1] > 1.0:
        gradient, hessian, limit = wp.vec3d(), wp.mat33d(), wp.float64(0.0)
        gradient_lost, hessian_lost, limit_lost = wp.vec3d(), wp.mat33d(), wp.float64(0.0)
        normal = contacts.normal[i] + wp.vec3()
        n = first
        while n > 0:
            k = n - 1
            n = contacts.next[k] + int(0)
            if contacts.feature[k] == feature:
                same = wp.float64(wp.sign(wp.dot(contacts.normal[k], normal)))
                of_gradient = same * to_double(contacts.gradient[k])
                of_hessian, of_limit = wp.mat33d(stored_block(contacts.hessian, k)), wp.float64(contacts.limit[k])
                gradient_lost += _lost(gradient, of_gradient, gradient + of_gradient)
                hessian_lost += _lost(hessian, of_hessian, hessian + of_hessian)
                limit_lost += _lost(limit, of_limit, limit + of_limit)
                gradient, hessian, limit = gradient + of_gradient, hessian + of_hessian, limit + of_limit
        total, block = wp.vec3(), wp.mat33()
        for a in range(3):
            total[a] = _sum_of_parts(gradient[a], gradient_lost[a], parts)
            for b in range(3):
                block[a, b] = _sum_of_parts(hessian[a, b], hessian_lost[a, b], parts)
        contacts.gradient[i] = total
        store_block(contacts.hessian, i, wp.mat33d(block))
        contacts.limit[i] = _sum_of_parts(limit, limit_lost, parts)
