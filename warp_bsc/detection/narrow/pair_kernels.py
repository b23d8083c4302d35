"""The kernels of the narrow phase, made from a rule: queue -> cull -> decide -> contacts, and contacts in order.

A rule says which pairs of the queue are left out, which are certainly free, and what is found of the others. Those of a
CPU that cull and classify many pairs at once are in :mod:`.batch_kernels`.
"""

from typing import NamedTuple

import warp as wp

from ...kernels.arcs import any_turns, turns
from ...kernels.pairs import points_of_pair
from ...kernels.pipeline.queues import append, is_filled, take_slot
from ...kernels.signs import FREE, UNSURE
from ...kernels.time_of_impact import Impact
from ..run.launch import made_once
from ..run.settings import NO_FUSED_OPERATIONS, NO_GRADIENTS, Count
from .contact_buffer import ContactBuffer


@wp.struct
class PairBuffers:
    """The pairs of one kind in all phases of the narrow phase; without arrays there are none."""

    elements: wp.array2d[int]  # vertex indices of the faces or edges
    counts: wp.array[wp.int64]  # by Count
    queue: wp.array[wp.vec2i]  # the pairs to decide
    survivors: wp.array[wp.vec2i]  # pairs that no cull decides
    contacts: ContactBuffer  # survivors that classification does not certify free
    keys: wp.array[wp.int64]  # sorting keys of the contacts
    order: wp.array[int]  # indices of the contacts, to be sorted by their keys
    for_exact: wp.array[int]  # contacts for the exact phase, or for subdivision with a minimum distance
    for_search: wp.array[int]  # contacts whose times of impact take a longer search
    second_bits: int  # bits of the second element in a key
    last_key: wp.int64  # of rows that are no contacts, greater than those of contacts


@wp.func
def _vertices_at(
    i: int, kind: int, queue: wp.array[wp.vec2i], elements: wp.array2d[int], counts: wp.array[wp.int64], count: int
) -> wp.vec4i:
    """Returns the vertices of entry i of a queue, -1 if it has not been written."""
    if not is_filled(i, queue, counts, count):
        return wp.vec4i(-1)
    return points_of_pair(kind, elements, queue[i])


@wp.func
def entry_of_two(
    i: int,
    kinds: wp.vec2i,
    queue: wp.array[wp.vec2i],
    other_queue: wp.array[wp.vec2i],
    one: PairBuffers,
    other: PairBuffers,
    count: int,
):
    """Returns the kind, the index in its queue, and the vertices of entry i of two queues, -1 if it is not written.

    The entries of the other queue follow the capacity of the one.
    """
    if i < queue.shape[0]:
        return kinds[0], i, _vertices_at(i, kinds[0], queue, one.elements, one.counts, count)
    k = i - queue.shape[0]
    return kinds[1], k, _vertices_at(k, kinds[1], other_queue, other.elements, other.counts, count)


@wp.func
def take_contact(pair: wp.vec2i, buffers: PairBuffers) -> int:
    """Returns the row of a new contact, to which the pair is written; -1 if no row remains."""
    slot = take_slot(buffers.counts, Count.CONTACTS)
    if slot >= wp.int64(buffers.contacts.pairs.shape[0]):
        return -1
    k = wp.int32(slot)
    buffers.contacts.pairs[k] = pair
    return k


@wp.func
def write_impact(k: int, result: Impact, buffers: PairBuffers):
    """Writes the first contact of a pair to a row of the contacts."""
    contacts = buffers.contacts
    contacts.status[k] = wp.int8(result.status)
    contacts.within_tolerance[k] = result.within_tolerance == 1
    contacts.toi[k] = result.toi
    contacts.coordinates[k] = result.coordinates
    contacts.normal[k] = result.normal


@wp.func
def write_decision(k: int, status: int, buffers: PairBuffers):
    """Writes what is decided of a row of the contacts, and its place in their order, the last one if it is free."""
    buffers.contacts.decided[k] = wp.int8(status)
    buffers.order[k] = k
    buffers.keys[k] = buffers.last_key
    if status != FREE:
        pair = buffers.contacts.pairs[k]
        buffers.keys[k] = (wp.int64(pair[0]) << wp.int64(buffers.second_bits)) | wp.int64(pair[1])


@wp.func
def count_found(status: int, buffers: PairBuffers):
    """Counts a contact that is found."""
    take_slot(buffers.counts, Count.FOUND)
    if status == UNSURE:
        take_slot(buffers.counts, Count.UNSURE)


@wp.func
def add_contact(pair: wp.vec2i, result: Impact, buffers: PairBuffers):
    """Counts a pair as found, and adds it to the contacts if a row remains."""
    k = take_contact(pair, buffers)
    count_found(result.status, buffers)
    if k >= 0:
        write_impact(k, result, buffers)
        write_decision(k, result.status, buffers)


@wp.func
def add_open_contact(pair: wp.vec2i, result: Impact, buffers: PairBuffers):
    """Adds a pair to the contacts with its status alone, if a row remains."""
    k = take_contact(pair, buffers)
    if k >= 0:
        buffers.contacts.status[k] = wp.int8(result.status)


class PairRule(NamedTuple):
    """What the narrow phase decides of a pair, by device functions.

    All take the options of the rule, the kind of pair and its vertices; all but the first also the positions at the
    start and at the end of the step, arrays of vec3 or vec3d.
    """

    options: type  # the struct of the options
    excludes: wp.Function  # returns whether a pair of the queue is left out
    clears: wp.Function  # returns whether a pair is certainly free, so that it is no survivor
    # returns the :class:`.Impact` of a survivor, and whether it is a contact; None where the rule has other kernels for
    # survivors
    decide: wp.Function | None = None
    # adds a contact with its impact: :func:`add_contact`, or :func:`add_open_contact` where another kernel finds all
    # but its status
    add: wp.Function = add_contact
    # whether the pairs of the rule are those with a turning vertex, by its ``options.arcs``, or those without; None if
    # ``excludes`` says so, and all survivors are of this rule
    turning: bool | None = None
    culls_by_kind: bool = False  # whether each kind of pair has a kernel of its own to cull
    max_registers: int = 0  # largest number of registers of a thread that decides; 0 for the compiler's choice


@made_once
def cull_kernel(rule: PairRule, dtype: type, of_kind: int = -1) -> wp.Kernel:
    """Returns the kernel from the queue to the survivors, for one type of position, and for one kind if that is given.

    A kernel of one kind takes fewer registers where the kinds differ in more than their vertices.
    """
    excludes, clears, turning = rule.excludes, rule.clears, rule.turning

    @wp.kernel(**NO_FUSED_OPERATIONS)
    def cull(
        first: int,
        # mesh
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        # in
        options: rule.options,
        kind: int,
        # in and out
        buffers: PairBuffers,
    ):
        if wp.static(turning is True):
            if not any_turns(options.arcs):
                return
        if wp.static(of_kind >= 0):
            kind = wp.static(of_kind)
        i = first + wp.tid()  # and no pair, which would take registers until the end
        v = _vertices_at(i, kind, buffers.queue, buffers.elements, buffers.counts, Count.QUEUED)
        if v[0] < 0:
            return
        if wp.static(turning is not None):
            if turns(options.arcs, v) != wp.static(turning is True):
                return
        if excludes(options, kind, v):
            return
        if not clears(options, kind, v, x0, x1):
            append(buffers.queue[i], buffers.survivors, buffers.counts, Count.SURVIVORS)

    return cull


@made_once
def decide_kernel(rule: PairRule, dtype: type) -> wp.Kernel:
    """Returns the kernel from the survivors to the contacts, for one type of position and pairs of two kinds.

    One launch covers two kinds, because a launch costs time even if its queue is empty: first the capacity of the one,
    then that of the other.
    """
    decide, add, turning = rule.decide, rule.add, rule.turning
    assert decide is not None, "the rule has other kernels"
    limits = {"cuda_max_registers": rule.max_registers} if rule.max_registers else {}

    @wp.kernel(**NO_FUSED_OPERATIONS, **limits)
    def decide_survivors(
        first: int,
        # mesh
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        # in
        options: rule.options,
        kinds: wp.vec2i,
        # in and out
        one: PairBuffers,
        other: PairBuffers,
    ):
        if wp.static(turning is True):
            if not any_turns(options.arcs):
                return
        i = first + wp.tid()
        kind, k, v = entry_of_two(i, kinds, one.survivors, other.survivors, one, other, Count.SURVIVORS)
        if v[0] < 0:
            return
        if wp.static(turning is not None):
            if turns(options.arcs, v) != wp.static(turning is True):
                return
        result, is_contact = decide(options, kind, v, x0, x1)
        if not is_contact:
            return
        if kind == kinds[0]:
            add(one.survivors[k], result, one)
        else:
            add(other.survivors[k], result, other)

    return decide_survivors


@wp.kernel(**NO_GRADIENTS)
def pad_keys(
    first: int,
    # in
    counts: wp.array[wp.int64],
    last_key: wp.int64,
    # out
    keys: wp.array[wp.int64],
):
    """Writes the last key to the rows after the contacts."""
    i = first + wp.tid()
    if wp.int64(i) >= counts[Count.CONTACTS]:
        keys[i] = last_key


@wp.func_native(
    snippet="""
#if !defined(__CUDA_ARCH__)
    const size_t row = i < order.shape[0] ? order.data[i] : 0;  // any: what is at no address is not loaded
    __builtin_prefetch(&contacts.pairs.data[row]);
    __builtin_prefetch(&contacts.toi.data[row]);
    for (int byte = 0; byte < 32; byte += 16) {  // a vector may be on two cache lines
        __builtin_prefetch((char*)&contacts.coordinates.data[row] + byte);
        __builtin_prefetch((char*)&contacts.normal.data[row] + byte);
    }
#endif
"""
)
def _prefetch(i: int, order: wp.array[int], contacts: ContactBuffer):
    """Makes a CPU load a row of contacts that is needed soon."""
    ...


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
    if wp.int64(i) >= counts[Count.FOUND] - counts[Count.REFUTED]:
        ordered.pairs[i] = wp.vec2i(-1, -1)
        return
    _prefetch(i + 24, order, contacts)
    source = order[i]
    ordered.pairs[i] = contacts.pairs[source]
    ordered.status[i] = contacts.status[source]
    ordered.decided[i] = contacts.decided[source]
    ordered.within_tolerance[i] = contacts.within_tolerance[source]
    ordered.toi[i] = contacts.toi[source]
    ordered.coordinates[i] = contacts.coordinates[source]
    ordered.normal[i] = contacts.normal[source]
