"""Contacts of one vertex pair, or of a vertex and an edge, as one in a solve: each face and edge there has found it.

They have the same closest points, so that gradients, Hessians and friction add up. Impulses are those of each pair.
"""

import warp as wp

from ...response.state.vectors import ZERO, to_double, to_single
from .system import Contacts, raise_to, to_single_block

wp.set_module_options({"enable_backward": False})

_DIGITS = wp.constant(wp.float64(2.0**11))
"""A number, in the largest of some terms, beside which these are rounded so that their sum is exact in any order."""


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
        raise_to(contacts.most_of_bucket, 3 * bucket, wp.max(wp.abs(contacts.gradient[i])))
        raise_to(contacts.most_of_bucket, 3 * bucket + 1, wp.trace(contacts.hessian[i]))
        raise_to(contacts.most_of_bucket, 3 * bucket + 2, contacts.limit[i])


@wp.func
def clear_bucket(contacts: Contacts, bucket: int):
    """Takes all contacts out of a bucket."""
    contacts.bucket[bucket] = 0
    for k in range(3):
        contacts.most_of_bucket[3 * bucket + k] = 0.0


@wp.func
def merge_contact(i: int, contacts: Contacts):
    """Adds to a contact all that have its vertices, or takes its weights where another one, of a lower key, does so.

    The vector between the closest points is the other way round where the sides of the pair are.
    """
    feature, key = contacts.feature[i], contacts.key[i]
    if feature[0] < 0:
        return
    bucket = _bucket_of(contacts, feature)
    by_gradient = wp.vec3d(_DIGITS * wp.float64(contacts.most_of_bucket[3 * bucket]))
    hessian_digits = _DIGITS * wp.float64(contacts.most_of_bucket[3 * bucket + 1])
    by_hessian = wp.matrix_from_rows(wp.vec3d(hessian_digits), wp.vec3d(hessian_digits), wp.vec3d(hessian_digits))
    by_limit = _DIGITS * wp.float64(contacts.most_of_bucket[3 * bucket + 2])
    gradient, hessian, limit, count = wp.vec3d(), wp.mat33d(), wp.float64(0.0), int(0)
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
            gradient += (same * of_gradient + by_gradient) - by_gradient
            hessian += (of_hessian + by_hessian) - by_hessian
            limit += (of_limit + by_limit) - by_limit
    if count < 2:
        return
    contacts.gradient[i] = to_single(gradient)
    contacts.hessian[i] = to_single_block(hessian)
    contacts.limit[i] = float(limit)
