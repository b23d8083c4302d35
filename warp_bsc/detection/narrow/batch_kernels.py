"""The kernels of the narrow phase on a CPU: culls, classification and times of impact of many pairs at once.

They decide as those of :mod:`.pair_kernels`, pair by pair where SIMD instructions leave one open.
"""

import warp as wp

from ...kernels.arcs import Arcs, any_turns, move_as_one, turns
from ...kernels.bits import count_bits, lowest_bit
from ...kernels.classification import classify
from ...kernels.motion import relative_motion
from ...kernels.pairs import ends_of, vertices_of_pair
from ...kernels.pipeline.batch_arc_culling import cull_arc_batch_of
from ...kernels.pipeline.batch_classification import BATCH as CLASSIFIED
from ...kernels.pipeline.batch_classification import OPEN, classify_batch_of
from ...kernels.pipeline.batch_culling import BATCH, cull_batch_of
from ...kernels.pipeline.batch_impacts import BATCH as DECIDED
from ...kernels.pipeline.batch_impacts import impact_batch_of
from ...kernels.pipeline.queues import filled_entries, raise_count, take_slot, take_slots, write
from ...kernels.polynomials import coplanarity
from ...kernels.signs import FREE, HIT, UNSURE
from ...kernels.time_of_impact import clamped_tolerance, impact, power_of_two
from ..run.launch import made_once
from ..run.settings import NO_FUSED_OPERATIONS, Count, PairKind
from .pair_kernels import PairBuffers, write_decision, write_impact

_LOWER_BITS = wp.constant(wp.uint64(0x5555555555555555))
"""The lower of the two bits of each status of a batch."""


@wp.func
def _move_turning_pairs(kind: int, buffers: PairBuffers, arcs: Arcs, first: int, count: int) -> int:
    """Moves the pairs with a turning vertex to the end of a part of the queue, and returns the number of the others."""
    straight = int(0)
    end = int(count)
    while straight < end:
        pair = buffers.queue[first + straight]
        if turns(arcs, vertices_of_pair(kind, buffers.elements, pair)):
            end -= 1
            buffers.queue[first + straight] = buffers.queue[first + end]
            buffers.queue[first + end] = pair
        else:
            straight += 1
    return straight


@made_once
def batch_culling_kernel(kind: PairKind, dtype: type, on_arcs: bool) -> wp.Kernel:
    """Returns the kernel that culls on the CPU, in batches, for one kind of pair and one type of position.

    If a vertex turns, each batch of the queue then begins with the pairs on arcs that remain, for :mod:`.arc`,
    and (-1, -1) after them. Without ``on_arcs`` nothing turns.
    """
    cull_batch = cull_batch_of(dtype, kind == PairKind.VERTEX_FACE)
    cull_arc_batch = cull_arc_batch_of(dtype, kind == PairKind.VERTEX_FACE)
    kind_number = int(kind)

    @wp.kernel(**NO_FUSED_OPERATIONS)
    def cull_batches(
        first: int,
        # mesh
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        roundoff: wp.float64,
        boxes_meet: bool,
        arcs: Arcs,
        # in and out
        buffers: PairBuffers,
    ):
        i = BATCH * (first + wp.tid())
        filled = wp.int32(wp.min(buffers.counts[Count.QUEUED], wp.int64(buffers.queue.shape[0])))
        count = wp.min(BATCH, filled - i)
        straight = count
        if wp.static(on_arcs):
            if any_turns(arcs):
                straight = _move_turning_pairs(kind_number, buffers, arcs, i, count)
        left = cull_batch(x0, x1, buffers.elements, buffers.queue, i, straight, boxes_meet, roundoff)
        slot = take_slots(buffers.counts, Count.SURVIVORS, count_bits(left))
        while left != wp.uint64(0):
            write(buffers.queue[i + lowest_bit(left)], buffers.survivors, slot)
            slot += wp.int64(1)
            left = left & (left - wp.uint64(1))
        if wp.static(on_arcs):
            if any_turns(arcs):
                kept = int(0)
                turning = i + straight
                left = cull_arc_batch(
                    x0, x1, buffers.elements, buffers.queue, arcs.deviation, turning, count - straight
                )
                while left != wp.uint64(0):
                    pair = buffers.queue[turning + lowest_bit(left)]
                    if not move_as_one(arcs, vertices_of_pair(kind_number, buffers.elements, pair)):
                        buffers.queue[i + kept] = pair
                        kept += 1
                    left = left & (left - wp.uint64(1))
                if kept < count:
                    buffers.queue[i + kept] = wp.vec2i(-1, -1)

    return cull_batches


@made_once
def batch_classification_kernel(kind: PairKind, dtype: type) -> wp.Kernel:
    """Returns the kernel that classifies survivors on the CPU, in batches, for one kind and one type of position."""
    kind_number = int(kind)
    classify_batch = classify_batch_of(dtype, kind == PairKind.VERTEX_FACE)

    @wp.kernel(**NO_FUSED_OPERATIONS)
    def classify_batches(
        first: int,
        # mesh
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        roundoff: wp.float64,
        # in and out
        buffers: PairBuffers,
    ):
        i = CLASSIFIED * (first + wp.tid())
        number = wp.min(CLASSIFIED, filled_entries(buffers.survivors, buffers.counts, Count.SURVIVORS) - i)
        statuses = classify_batch(x0, x1, buffers.elements, buffers.survivors, i, number, roundoff)
        left = statuses & (statuses >> wp.uint64(1)) & _LOWER_BITS
        while left != wp.uint64(0):
            bit = lowest_bit(left)
            v = vertices_of_pair(kind_number, buffers.elements, buffers.survivors[i + bit // 2])
            a0, b0, c0, d0, a1, b1, c1, d1 = ends_of(x0, x1, v)
            motion = relative_motion(kind_number, a0, b0, c0, d0, a1, b1, c1, d1, roundoff)
            status = classify(motion, coplanarity(motion))
            statuses = statuses ^ (wp.uint64(OPEN ^ status) << wp.uint64(bit))
            left = left & (left - wp.uint64(1))
        contacts = (statuses | (statuses >> wp.uint64(1))) & _LOWER_BITS
        slot = take_slots(buffers.counts, Count.CONTACTS, count_bits(contacts))
        while contacts != wp.uint64(0):
            bit = lowest_bit(contacts)
            if slot < wp.int64(buffers.contacts.pairs.shape[0]):
                buffers.contacts.pairs[wp.int32(slot)] = buffers.survivors[i + bit // 2]
                buffers.contacts.status[wp.int32(slot)] = wp.int8((statuses >> wp.uint64(bit)) & wp.uint64(3))
            slot += wp.int64(1)
            contacts = contacts & (contacts - wp.uint64(1))

    return classify_batches


@wp.func
def _decide_batch(first: int, count: int, timed: bool, touching: wp.uint64, buffers: PairBuffers):
    """Decides contacts as the kernel of a GPU does, with one atomic operation for the counts of all."""
    contacts = buffers.contacts
    found = int(0)
    unsure = int(0)
    for i in range(first, first + count):
        status = int(contacts.status[i])
        is_touching = (touching >> wp.uint64(i - first)) & wp.uint64(1) == wp.uint64(1)
        write_decision(i, wp.where(is_touching, HIT, status), buffers)
        found += int(status != FREE)
        unsure += int(status == UNSURE)
        if status == UNSURE or (status == HIT and timed and not contacts.within_tolerance[i]):
            buffers.for_exact[wp.int32(take_slot(buffers.counts, Count.FOR_EXACT))] = i
    raise_count(buffers.counts, Count.FOUND, found)
    raise_count(buffers.counts, Count.UNSURE, unsure)


@made_once
def batch_impact_kernel(kind: PairKind, dtype: type) -> wp.Kernel:
    """Returns the kernel that finds times of impact on the CPU, in batches, for one kind and one type of position."""
    kind_number = int(kind)
    impact_batch = impact_batch_of(dtype, kind == PairKind.VERTEX_FACE)

    @wp.kernel(**NO_FUSED_OPERATIONS)
    def find_impact_batches(
        first: int,
        # mesh
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        roundoff: wp.float64,
        timed: bool,
        tolerance: wp.float64,
        # in and out
        buffers: PairBuffers,
    ):
        contacts = buffers.contacts
        i = DECIDED * (first + wp.tid())
        number = wp.min(DECIDED, filled_entries(contacts.pairs, buffers.counts, Count.CONTACTS) - i)
        masks = impact_batch(
            x0,
            x1,
            buffers.elements,
            contacts.pairs,
            i,
            number,
            roundoff,
            timed,
            power_of_two(clamped_tolerance(tolerance)),
            contacts.status,
            contacts.within_tolerance,
            contacts.toi,
            contacts.coordinates,
            contacts.normal,
        )
        while masks[0] != wp.uint64(0):
            row = i + lowest_bit(masks[0])
            v = vertices_of_pair(kind_number, buffers.elements, contacts.pairs[row])
            a0, b0, c0, d0, a1, b1, c1, d1 = ends_of(x0, x1, v)
            motion = relative_motion(kind_number, a0, b0, c0, d0, a1, b1, c1, d1, roundoff)
            write_impact(row, impact(motion, coplanarity(motion), int(contacts.status[row]), tolerance), buffers)
            masks[0] = masks[0] & (masks[0] - wp.uint64(1))
        _decide_batch(i, number, timed, masks[1], buffers)

    return find_impact_batches
