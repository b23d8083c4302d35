"""Contacts of one vertex pair, or of a vertex and an edge, as one in a solve: each face and edge there has found it.

They have the same closest points, so that gradients, Hessians and friction add up. Impulses are those of each pair.
"""

from typing import Any

import warp as wp

from ...response.state.vectors import ZERO, to_double, to_single
from .system import Contacts, to_single_block

wp.set_module_options({"enable_backward": False})


@wp.func
def _lost(a: Any, b: Any, total: Any):
    """Returns what rounding takes from a sum of two: with it, sums do not depend on the order of their terms.

    Knuth, The Art of Computer Programming, volume 2, section 4.2.2, theorem B.
    """
    rounded = total - a
    return (a - (total - rounded)) + (b - rounded)


@wp.func
def _bucket_of(contacts: Contacts, feature: wp.vec3i) -> int:
    number = wp.uint32(feature[0]) * wp.uint32(73856093) + wp.uint32(feature[1]) * wp.uint32(19349663)
    number += wp.uint32(feature[2]) * wp.uint32(83492791)
    return int((number ^ (number >> wp.uint32(15))) % wp.uint32(contacts.bucket.shape[0]))


@wp.func
def link_contact(contacts: Contacts, i: int, corners: wp.vec4i, weights: wp.vec4d):
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
        bucket = _bucket_of(contacts, feature)
        contacts.feature[i] = feature
        contacts.next[i] = wp.atomic_exch(contacts.bucket, bucket, i + 1)


@wp.func
def merge_contact(i: int, contacts: Contacts):
    """Adds to a contact all that have its vertices, or takes its weights where another one, of a lower key, does so.

    The vector between the closest points is the other way round where the sides of the pair are.
    """
    feature, key = contacts.feature[i], contacts.key[i]
    if feature[0] < 0:
        return
    bucket = _bucket_of(contacts, feature)
    gradient, hessian, limit, count = wp.vec3d(), wp.mat33d(), wp.float64(0.0), int(0)
    gradient_lost, hessian_lost, limit_lost = wp.vec3d(), wp.mat33d(), wp.float64(0.0)
    normal, n = contacts.normal[i] + wp.vec3(), contacts.bucket[bucket] + int(0)
    while n > 0:
        k = n - 1
        # read side by side: most of the time is waiting for memory
        n, of_feature, of_key = (
            contacts.next[k] + int(0),
            contacts.feature[k] + wp.vec3i(),
            contacts.key[k] + wp.int64(0),
        )
        of_gradient, of_hessian = to_double(contacts.gradient[k]), wp.mat33d(contacts.hessian[k])
        of_limit, same = wp.float64(contacts.limit[k]), wp.float64(wp.sign(wp.dot(contacts.normal[k], normal)))
        if of_feature == feature:
            if of_key < key:
                contacts.weights[i] = wp.vec4()
                contacts.couples[i] = 0
                return
            count += 1
            of_gradient = same * of_gradient
            gradient_lost += _lost(gradient, of_gradient, gradient + of_gradient)
            hessian_lost += _lost(hessian, of_hessian, hessian + of_hessian)
            limit_lost += _lost(limit, of_limit, limit + of_limit)
            gradient, hessian, limit = gradient + of_gradient, hessian + of_hessian, limit + of_limit
    if count < 2:
        return
    contacts.gradient[i] = to_single(gradient + gradient_lost)
    contacts.hessian[i] = to_single_block(hessian + hessian_lost)
    contacts.limit[i] = float(limit + limit_lost)
