"""The kernels of the narrow phase: culls, classification, times of impact, and contacts in order."""

import functools
from typing import NamedTuple

import warp as wp

from ..kernels.classification import classify
from ..kernels.closest import contact_at
from ..kernels.culling import (
    centroid_direction,
    direction_separates,
    edge_edge_boxes_apart,
    vertex_face_boxes_apart,
)
from ..kernels.motion import edge_edge_motion, relative_motion, vertex_face_motion
from ..kernels.pipeline.batch_culling import BATCH, cull_batch_of, lowest_bit
from ..kernels.pipeline.queues import append, is_filled, take_slot
from ..kernels.polynomials import coplanarity
from ..kernels.signs import FREE, HIT, UNSURE, certified_sign_cubic
from ..kernels.time_of_impact import impact
from .contact_buffer import ContactBuffer
from .settings import NO_FUSED_OPERATIONS, NO_GRADIENTS, Count, PairKind

__all__ = ["PairKernels", "gather_contacts", "pair_kernels"]

_QUEUED = wp.constant(int(Count.QUEUED))
_SURVIVORS = wp.constant(int(Count.SURVIVORS))
_CONTACTS = wp.constant(int(Count.CONTACTS))
_FOUND = wp.constant(int(Count.FOUND))
_UNSURE = wp.constant(int(Count.UNSURE))
_FOR_EXACT = wp.constant(int(Count.FOR_EXACT))
_REFUTED = wp.constant(int(Count.REFUTED))


class PairKernels(NamedTuple):
    """The kernels for one kind of pair and one type of position, in the order in which they run."""

    cull: wp.Kernel
    cull_batches: wp.Kernel
    classify_survivors: wp.Kernel
    find_impacts: wp.Kernel
    find_contact_points: wp.Kernel


@functools.cache
def pair_kernels(kind: PairKind, dtype: type) -> PairKernels:
    """Returns the kernels for one kind of pair and one type of position, each in a module of its own."""
    kind_number = int(kind)
    vertex_face = kind == PairKind.VERTEX_FACE
    motion_of = vertex_face_motion if vertex_face else edge_edge_motion
    boxes_apart = vertex_face_boxes_apart if vertex_face else edge_edge_boxes_apart

    if vertex_face:

        @wp.func
        def four_points(x: wp.array[dtype], elements: wp.array2d[int], pair: wp.vec2i):
            face = pair[1]
            return x[pair[0]], x[elements[face, 0]], x[elements[face, 1]], x[elements[face, 2]]
    else:

        @wp.func
        def four_points(x: wp.array[dtype], elements: wp.array2d[int], pair: wp.vec2i):
            first = pair[0]
            second = pair[1]
            return x[elements[first, 0]], x[elements[first, 1]], x[elements[second, 0]], x[elements[second, 1]]

    @wp.kernel(**NO_FUSED_OPERATIONS)
    def cull(
        first: int,
        # mesh
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        elements: wp.array2d[int],
        roundoff: wp.float64,
        # in
        queue: wp.array[wp.vec2i],
        # in and out
        counts: wp.array[wp.int64],
        # out
        survivors: wp.array[wp.vec2i],
    ):
        i = first + wp.tid()
        if not is_filled(i, queue, counts, _QUEUED):
            return
        pair = queue[i]
        a0, b0, c0, d0 = four_points(x0, elements, pair)
        a1, b1, c1, d1 = four_points(x1, elements, pair)
        motion = motion_of(a0, b0, c0, d0, a1, b1, c1, d1, roundoff)
        y = coplanarity(motion)
        if certified_sign_cubic(y.k, y.bound) != 0:
            return
        if direction_separates(motion, centroid_direction(motion)):
            return
        # last, because in single precision queued pairs always pass; but exact at any scale
        if boxes_apart(a0, b0, c0, d0, a1, b1, c1, d1):
            return
        append(pair, survivors, counts, _SURVIVORS)

    cull_batch = cull_batch_of(dtype, vertex_face)

    @wp.kernel(**NO_FUSED_OPERATIONS)
    def cull_batches(
        first: int,
        # mesh
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        elements: wp.array2d[int],
        roundoff: wp.float64,
        # in
        queue: wp.array[wp.vec2i],
        # in and out
        counts: wp.array[wp.int64],
        # out
        survivors: wp.array[wp.vec2i],
    ):
        i = BATCH * (first + wp.tid())
        filled = wp.int32(wp.min(counts[_QUEUED], wp.int64(queue.shape[0])))
        left = cull_batch(x0, x1, elements, queue, i, wp.min(BATCH, filled - i), roundoff)
        while left != wp.uint64(0):
            lane = lowest_bit(left)
            append(queue[i + lane], survivors, counts, _SURVIVORS)
            left = left & (left - wp.uint64(1))

    @wp.kernel(**NO_FUSED_OPERATIONS)
    def classify_survivors(
        first: int,
        # mesh
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        elements: wp.array2d[int],
        roundoff: wp.float64,
        # in
        survivors: wp.array[wp.vec2i],
        # in and out
        counts: wp.array[wp.int64],
        # out
        contacts: ContactBuffer,
    ):
        i = first + wp.tid()
        if not is_filled(i, survivors, counts, _SURVIVORS):
            return
        pair = survivors[i]
        a0, b0, c0, d0 = four_points(x0, elements, pair)
        a1, b1, c1, d1 = four_points(x1, elements, pair)
        motion = relative_motion(kind_number, a0, b0, c0, d0, a1, b1, c1, d1, roundoff)
        status = classify(motion, coplanarity(motion))
        if status != FREE:
            slot = take_slot(counts, _CONTACTS)
            if slot < wp.int64(contacts.pairs.shape[0]):
                contacts.pairs[wp.int32(slot)] = pair
                contacts.status[wp.int32(slot)] = wp.int8(status)

    @wp.kernel(**NO_FUSED_OPERATIONS)
    def find_impacts(
        first: int,
        # mesh
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        elements: wp.array2d[int],
        roundoff: wp.float64,
        timed: bool,
        tolerance: wp.float64,
        first_bits: int,
        second_bits: int,
        # in and out
        counts: wp.array[wp.int64],
        contacts: ContactBuffer,
        # out
        keys: wp.array[wp.int64],
        order: wp.array[int],
        for_exact: wp.array[int],
    ):
        i = first + wp.tid()
        if i >= contacts.pairs.shape[0]:
            return
        order[i] = i
        # stays where there is no contact, which sorts it behind the others
        keys[i] = wp.int64(1) << wp.int64(first_bits + second_bits)
        if not is_filled(i, contacts.pairs, counts, _CONTACTS):
            return
        pair = contacts.pairs[i]
        status = int(contacts.status[i])
        if timed or status != HIT:
            a0, b0, c0, d0 = four_points(x0, elements, pair)
            a1, b1, c1, d1 = four_points(x1, elements, pair)
            motion = relative_motion(kind_number, a0, b0, c0, d0, a1, b1, c1, d1, roundoff)
            result = impact(motion, coplanarity(motion), status, tolerance)
            status = result.status
            contacts.status[i] = wp.int8(status)
            contacts.within_tolerance[i] = result.localized == 1
            contacts.toi[i] = result.toi
            contacts.coordinates[i] = result.coordinates
            contacts.normal[i] = result.normal
        contacts.decided[i] = wp.int8(status)
        if status != FREE:
            keys[i] = (wp.int64(pair[0]) << wp.int64(second_bits)) | wp.int64(pair[1])
            take_slot(counts, _FOUND)
            if status == UNSURE:
                take_slot(counts, _UNSURE)
            if status == UNSURE or (timed and not contacts.within_tolerance[i]):
                for_exact[wp.int32(take_slot(counts, _FOR_EXACT))] = i

    @wp.kernel(**NO_FUSED_OPERATIONS)
    def find_contact_points(
        # mesh
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        elements: wp.array2d[int],
        # in
        pairs: wp.array[wp.vec2i],
        toi: wp.array[wp.float64],
        # out
        coordinates: wp.array[wp.vec3d],
        normal: wp.array[wp.vec3d],
    ):
        i = wp.tid()
        a0, b0, c0, d0 = four_points(x0, elements, pairs[i])
        a1, b1, c1, d1 = four_points(x1, elements, pairs[i])
        motion = relative_motion(kind_number, a0, b0, c0, d0, a1, b1, c1, d1, wp.float64(0.0))
        at, direction = contact_at(motion, toi[i])
        coordinates[i] = at
        normal[i] = direction

    return PairKernels(cull, cull_batches, classify_survivors, find_impacts, find_contact_points)


@wp.kernel(**NO_GRADIENTS)
def gather_contacts(
    first: int,
    # in
    counts: wp.array[wp.int64],
    order: wp.array[int],
    contacts: ContactBuffer,
    # out
    ordered: ContactBuffer,
):
    """Writes contacts in an order, and the pair (-1, -1) where there are no more."""
    i = first + wp.tid()
    if wp.int64(i) >= counts[_FOUND] - counts[_REFUTED]:
        ordered.pairs[i] = wp.vec2i(-1, -1)
        return
    source = order[i]
    ordered.pairs[i] = contacts.pairs[source]
    ordered.status[i] = contacts.status[source]
    ordered.decided[i] = contacts.decided[source]
    ordered.within_tolerance[i] = contacts.within_tolerance[source]
    ordered.toi[i] = contacts.toi[source]
    ordered.coordinates[i] = contacts.coordinates[source]
    ordered.normal[i] = contacts.normal[source]
