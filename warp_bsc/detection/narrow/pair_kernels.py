"""The kernels of the narrow phase on a GPU: culls, classification, times of impact, and contacts in order.

Those of a CPU that decide many pairs at once are in :mod:`.batch_kernels`.
"""

from typing import NamedTuple

import warp as wp

from ...kernels.arcs import Arcs, turns
from ...kernels.classification import classify
from ...kernels.closest import contact_at
from ...kernels.culling import centroid_direction, direction_separates, edge_edge_boxes_apart, vertex_face_boxes_apart
from ...kernels.motion import edge_edge_motion, relative_motion, vertex_face_motion
from ...kernels.pairs import vertices_of_pair
from ...kernels.pipeline.queues import append, is_filled, take_slot
from ...kernels.polynomials import EDGE_EDGE, VERTEX_FACE, coplanarity
from ...kernels.signs import FREE, HIT, UNSURE, certified_sign_cubic
from ...kernels.time_of_impact import Impact, impact
from ..run.launch import made_once
from ..run.settings import NO_FUSED_OPERATIONS, NO_GRADIENTS, Count, DistanceKind, PairKind
from .contact_buffer import ContactBuffer

__all__ = [
    "PairKernels",
    "PairStages",
    "culling_kernel",
    "gather_contacts",
    "pad_keys",
    "pair_kernels",
    "write_impact",
]

_QUEUED = wp.constant(int(Count.QUEUED))
_SURVIVORS = wp.constant(int(Count.SURVIVORS))
_CONTACTS = wp.constant(int(Count.CONTACTS))
_FOUND = wp.constant(int(Count.FOUND))
_UNSURE = wp.constant(int(Count.UNSURE))
_FOR_EXACT = wp.constant(int(Count.FOR_EXACT))
_REFUTED = wp.constant(int(Count.REFUTED))


@wp.struct
class PairStages:
    """The pairs of one kind in all stages of the narrow phase; without arrays there are none.

    Attributes:
        elements: Vertex indices of the faces or edges.
        counts: Counts by :class:`Count`.
        queue: The pairs to decide.
        survivors: Pairs that no cull decides.
        contacts: Survivors that classification does not certify free.
        keys: Sorting keys of the contacts.
        order: Indices of the contacts, to be sorted by their keys.
        for_exact: Indices of contacts for the exact stage, or for subdivision with a minimum distance.
        second_bits: Bits of the second element in a key.
        last_key: Key of rows that are no contacts, greater than those of contacts.
    """

    elements: wp.array2d[int]
    counts: wp.array[wp.int64]
    queue: wp.array[wp.vec2i]
    survivors: wp.array[wp.vec2i]
    contacts: ContactBuffer
    keys: wp.array[wp.int64]
    order: wp.array[int]
    for_exact: wp.array[int]
    second_bits: int
    last_key: wp.int64


class PairKernels(NamedTuple):
    """The kernels after the culls for one type of position, in the order in which they run.

    One launch covers both kinds of pair, because a launch costs time even if its queue is empty: first the capacity of
    the vertex-face pairs, then that of the edge-edge pairs.
    """

    classify_survivors: wp.Kernel
    find_impacts: wp.Kernel
    find_contact_points: wp.Kernel


@wp.func
def _kind_at(i: int, capacity: int):
    """Returns the kind of pair of a thread, and its index in the queue of that kind, from the capacity of the first."""
    if i < capacity:
        return VERTEX_FACE, i
    return EDGE_EDGE, i - capacity


@wp.func
def _pair_at(i: int, queue: wp.array[wp.vec2i], counts: wp.array[wp.int64], count: int):
    """Returns entry i of a queue, (-1, -1) if it has not been written."""
    if is_filled(i, queue, counts, count):
        return queue[i]
    return wp.vec2i(-1, -1)


@wp.func
def _enqueue_contact(pair: wp.vec2i, status: int, stages: PairStages):
    slot = take_slot(stages.counts, _CONTACTS)
    if slot < wp.int64(stages.contacts.pairs.shape[0]):
        stages.contacts.pairs[wp.int32(slot)] = pair
        stages.contacts.status[wp.int32(slot)] = wp.int8(status)


@wp.func
def write_impact(i: int, result: Impact, stages: PairStages):
    """Writes the first contact of a pair to a row of the contacts."""
    contacts = stages.contacts
    contacts.status[i] = wp.int8(result.status)
    contacts.within_tolerance[i] = result.within_tolerance == 1
    contacts.toi[i] = result.toi
    contacts.coordinates[i] = result.coordinates
    contacts.normal[i] = result.normal


@wp.func
def _decide(i: int, pair: wp.vec2i, status: int, timed: bool, stages: PairStages):
    """Counts a contact by its status, makes its sorting key, and enqueues it for the exact stage if that is needed."""
    contacts = stages.contacts
    contacts.decided[i] = wp.int8(status)
    stages.order[i] = i
    if status == FREE:
        stages.keys[i] = stages.last_key
        return
    stages.keys[i] = (wp.int64(pair[0]) << wp.int64(stages.second_bits)) | wp.int64(pair[1])
    take_slot(stages.counts, _FOUND)
    if status == UNSURE:
        take_slot(stages.counts, _UNSURE)
    if status == UNSURE or (timed and not contacts.within_tolerance[i]):
        stages.for_exact[wp.int32(take_slot(stages.counts, _FOR_EXACT))] = i


@made_once
def pair_kernels(dtype: type) -> PairKernels:
    """Returns the kernels for one type of position, each in a module of its own."""

    # fewer registers than the 252 that the compiler takes, so that twice as many warps hide its latency
    @wp.kernel(**NO_FUSED_OPERATIONS, cuda_max_registers=128)
    def classify_survivors(
        first: int,
        # mesh
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        roundoff: wp.float64,
        # in and out
        vertex_face: PairStages,
        edge_edge: PairStages,
    ):
        kind, i = _kind_at(first + wp.tid(), vertex_face.survivors.shape[0])
        pair = wp.vec2i()
        if kind == VERTEX_FACE:
            pair = _pair_at(i, vertex_face.survivors, vertex_face.counts, _SURVIVORS)
        else:
            pair = _pair_at(i, edge_edge.survivors, edge_edge.counts, _SURVIVORS)
        if pair[0] < 0:
            return
        v = wp.vec4i()
        if kind == VERTEX_FACE:
            v = vertices_of_pair(VERTEX_FACE, vertex_face.elements, pair)
        else:
            v = vertices_of_pair(EDGE_EDGE, edge_edge.elements, pair)
        a0, b0, c0, d0 = x0[v[0]], x0[v[1]], x0[v[2]], x0[v[3]]
        a1, b1, c1, d1 = x1[v[0]], x1[v[1]], x1[v[2]], x1[v[3]]
        motion = relative_motion(kind, a0, b0, c0, d0, a1, b1, c1, d1, roundoff)
        status = classify(motion, coplanarity(motion))
        if status != FREE:
            if kind == VERTEX_FACE:
                _enqueue_contact(pair, status, vertex_face)
            else:
                _enqueue_contact(pair, status, edge_edge)

    @wp.kernel(**NO_FUSED_OPERATIONS)
    def find_impacts(
        first: int,
        # mesh
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        roundoff: wp.float64,
        timed: bool,
        tolerance: wp.float64,
        # in and out
        vertex_face: PairStages,
        edge_edge: PairStages,
    ):
        kind, i = _kind_at(first + wp.tid(), vertex_face.contacts.pairs.shape[0])
        pair = wp.vec2i()
        if kind == VERTEX_FACE:
            pair = _pair_at(i, vertex_face.contacts.pairs, vertex_face.counts, _CONTACTS)
        else:
            pair = _pair_at(i, edge_edge.contacts.pairs, edge_edge.counts, _CONTACTS)
        if pair[0] < 0:
            return
        v = wp.vec4i()
        status = int(0)
        if kind == VERTEX_FACE:
            v = vertices_of_pair(VERTEX_FACE, vertex_face.elements, pair)
            status = int(vertex_face.contacts.status[i])
        else:
            v = vertices_of_pair(EDGE_EDGE, edge_edge.elements, pair)
            status = int(edge_edge.contacts.status[i])
        if timed or status != HIT:
            a0, b0, c0, d0 = x0[v[0]], x0[v[1]], x0[v[2]], x0[v[3]]
            a1, b1, c1, d1 = x1[v[0]], x1[v[1]], x1[v[2]], x1[v[3]]
            motion = relative_motion(kind, a0, b0, c0, d0, a1, b1, c1, d1, roundoff)
            result = impact(motion, coplanarity(motion), status, tolerance)
            status = result.status
            if kind == VERTEX_FACE:
                write_impact(i, result, vertex_face)
            else:
                write_impact(i, result, edge_edge)
        if kind == VERTEX_FACE:
            _decide(i, pair, status, timed, vertex_face)
        else:
            _decide(i, pair, status, timed, edge_edge)

    @wp.kernel(**NO_FUSED_OPERATIONS)
    def find_contact_points(
        # mesh
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        elements: wp.array2d[int],
        kind: int,
        # in
        pairs: wp.array[wp.vec2i],
        toi: wp.array[wp.float64],
        # out
        coordinates: wp.array[wp.vec3d],
        normal: wp.array[wp.vec3d],
    ):
        i = wp.tid()
        v = vertices_of_pair(kind, elements, pairs[i])
        a0, b0, c0, d0 = x0[v[0]], x0[v[1]], x0[v[2]], x0[v[3]]
        a1, b1, c1, d1 = x1[v[0]], x1[v[1]], x1[v[2]], x1[v[3]]
        motion = relative_motion(kind, a0, b0, c0, d0, a1, b1, c1, d1, wp.float64(0.0))
        at, direction = contact_at(motion, toi[i])
        coordinates[i] = at
        normal[i] = direction

    return PairKernels(classify_survivors, find_impacts, find_contact_points)


@made_once
def culling_kernel(kind: PairKind | DistanceKind, dtype: type) -> wp.Kernel:
    """Returns the kernel that culls on a GPU, for one kind of pair and one type of position.

    Each kind has its own, because one for both takes an eighth more registers, which costs more than a launch.
    """
    vertex_face = kind == PairKind.VERTEX_FACE
    kind_number = int(kind)
    motion_of = vertex_face_motion if vertex_face else edge_edge_motion
    boxes_apart = vertex_face_boxes_apart if vertex_face else edge_edge_boxes_apart

    @wp.kernel(**NO_FUSED_OPERATIONS)
    def cull(
        first: int,
        # mesh
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        roundoff: wp.float64,
        arcs: Arcs,
        # in and out
        stages: PairStages,
    ):
        pair = _pair_at(first + wp.tid(), stages.queue, stages.counts, _QUEUED)
        if pair[0] < 0:
            return
        v = vertices_of_pair(kind_number, stages.elements, pair)
        if turns(arcs, v):
            return
        a0, b0, c0, d0 = x0[v[0]], x0[v[1]], x0[v[2]], x0[v[3]]
        a1, b1, c1, d1 = x1[v[0]], x1[v[1]], x1[v[2]], x1[v[3]]
        motion = motion_of(a0, b0, c0, d0, a1, b1, c1, d1, roundoff)
        y = coplanarity(motion)
        if certified_sign_cubic(y.k, y.bound) != 0:
            return
        if direction_separates(motion, centroid_direction(motion)):
            return
        # last, because in single precision queued pairs always pass; but exact at any scale
        if boxes_apart(a0, b0, c0, d0, a1, b1, c1, d1):
            return
        append(pair, stages.survivors, stages.counts, _SURVIVORS)

    return cull


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
    if wp.int64(i) >= counts[_CONTACTS]:
        keys[i] = last_key


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
