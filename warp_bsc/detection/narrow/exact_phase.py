"""The exact phase: wide integers decide, on the device, the contacts that floating point cannot.

Contacts that the previous phase has enqueued are decided in integers of one limb a coordinate, see
:mod:`warp_bsc.kernels.exact.first_contact`. Those whose exponents are too far apart for that go to the next queue,
for two limbs, on a CPU then to that for four, and at last to the queue for eight, which suffice for every query in
single precision. Contacts that are too wide for eight limbs are counted and delegated to the host. Each width has its
own kernel, so that the usual one stays small.

Contacts with a minimum distance are decided as far as :mod:`warp_bsc.kernels.exact.distance` can. The host decides the
others, and those that are too wide.
"""

import math

import numpy as np
import warp as wp

from ...kernels.closest import contact_at
from ...kernels.exact.distance import BITS as DISTANCE_BITS
from ...kernels.exact.distance import decide_distance_in
from ...kernels.exact.first_contact import NONE, TOO_WIDE, decide_in
from ...kernels.exact.polygon import BITS
from ...kernels.motion import query_at, query_motion
from ...kernels.pairs import distance_of_corners, form_of, points_of_pair, vertices_of_pair
from ...kernels.pipeline.queues import take_slot
from ...kernels.signs import FREE, HIT, UNSURE
from ...kernels.time_of_impact import MIN_DIGITS
from ..run.launch import launch_over_queue, made_once
from ..run.settings import NO_FUSED_OPERATIONS, Count, PairKind
from .contact_buffer import make_contact_buffer
from .pair_kernels import PairBuffers

_WIDTHS_ON_GPU = (1, 2, 8)
"""Limbs of the integers on a GPU, where a launch over an empty queue takes longer than four limbs would save."""


@wp.func
def _refute(i: int, buffers: PairBuffers):
    """Writes that a contact is none."""
    buffers.contacts.decided[i] = wp.int8(FREE)
    buffers.keys[i] = buffers.last_key
    take_slot(buffers.counts, Count.REFUTED)


@made_once
def _kernel(dtype: type, limbs: int) -> wp.Kernel:
    """Returns the kernel for one type of position and one width, in a module of its own."""
    decide = decide_in(limbs)

    @wp.kernel(**NO_FUSED_OPERATIONS)
    def decide_contacts(
        first: int,
        # mesh
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        kind: int,
        timed: bool,
        digits: int,
        # in
        queue: wp.array[int],
        filled: int,
        too_wide: int,
        # in and out
        buffers: PairBuffers,
        # out
        left: wp.array[int],
    ):
        slot = first + wp.tid()
        if wp.int64(slot) >= buffers.counts[filled]:
            return
        i = queue[slot]
        contacts = buffers.contacts
        if not timed and contacts.decided[i] == wp.int8(HIT):
            return
        v = vertices_of_pair(kind, buffers.elements, contacts.pairs[i])
        query = query_at(x0, x1, v)
        time = decide(kind, query, timed, digits)
        if time == TOO_WIDE:
            left[wp.int32(take_slot(buffers.counts, too_wide))] = i
        elif time == NONE:
            _refute(i, buffers)
        else:
            contacts.decided[i] = wp.int8(HIT)
            if timed:
                # the time at which floating point has stopped is a lower bound too
                time = wp.max(time, contacts.toi[i])
                motion = query_motion(kind, query, wp.float64(0.0))
                at, direction = contact_at(motion, time)
                contacts.within_tolerance[i] = True
                contacts.toi[i] = time
                contacts.coordinates[i] = at
                contacts.normal[i] = direction

    return decide_contacts


@made_once
def _distance_kernel(dtype: type, limbs: int) -> wp.Kernel:
    """Returns the kernel for contacts with a minimum distance, for one type of position and one width."""
    decide = decide_distance_in(limbs)
    is_last = limbs == max(DISTANCE_BITS)

    @wp.kernel(**NO_FUSED_OPERATIONS)
    def decide_distances(
        first: int,
        # mesh
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        radius: wp.array[wp.float64],
        kind: int,
        timed: bool,
        digits: int,
        # in and out
        buffers: PairBuffers,
    ):
        k = first + wp.tid()
        contacts = buffers.contacts
        if k >= contacts.pairs.shape[0] or wp.int64(k) >= buffers.counts[Count.CONTACTS]:
            return
        known = int(contacts.decided[k])
        if known == FREE or (known == HIT and (contacts.within_tolerance[k] or not timed)):
            return
        v = points_of_pair(kind, buffers.elements, contacts.pairs[k])
        query = query_at(x0, x1, v)
        distance = distance_of_corners(kind, v, radius)
        status = decide(form_of(kind), query, distance, contacts.toi[k], digits, timed)
        if status == FREE:
            _refute(k, buffers)
        elif status == HIT:
            # coordinates and normal are those at the time of impact already
            contacts.decided[k] = wp.int8(status)
            contacts.within_tolerance[k] = timed
        elif wp.static(is_last):
            take_slot(buffers.counts, Count.TOO_WIDE_8)

    return decide_distances


def are_within_distance(
    kind: PairKind, x: wp.array, elements: wp.array, pairs: np.ndarray, distance: float
) -> tuple[np.ndarray, np.ndarray]:
    """Returns which pairs at rest are within a distance, and which pairs are decided; bool, each of shape [n].

    Args:
        kind: The kind of pair.
        x: Positions, array of vec3 or vec3d.
        elements: Vertex indices of the faces or edges, two-dimensional array of int.
        pairs: The pairs, int32, shape [n, 2].
        distance: The distance, more than 0.
    """
    n, device = len(pairs), x.device
    buffers = PairBuffers()
    buffers.elements = elements
    buffers.counts = wp.zeros(len(Count), dtype=wp.int64, device=device)
    buffers.counts[Count.CONTACTS : Count.CONTACTS + 1].fill_(n)
    buffers.contacts = make_contact_buffer(n, device)
    buffers.contacts.pairs.assign(pairs)
    buffers.contacts.decided.fill_(int(UNSURE))
    buffers.contacts.toi.zero_()
    buffers.keys = wp.empty(n, dtype=wp.int64, device=device)
    half = wp.full(len(x), 0.5 * distance, dtype=wp.float64, device=device)  # whose double is exact
    if 2.0 * (0.5 * distance) == distance:
        launch_exact_distances(x, x, half, kind, timed=False, tolerance=1.0, buffers=buffers)
    decided = buffers.contacts.decided.numpy()
    return decided == HIT, decided != UNSURE


def launch_exact_distances(
    x0: wp.array, x1: wp.array, radius: wp.array, kind: PairKind, *, timed: bool, tolerance: float, buffers: PairBuffers
) -> None:
    """Decides contacts with a minimum distance exactly, and counts those delegated to the host; does not synchronize.

    Arguments are those of :func:`.run_distances`, for one kind of pair, with the buffers of its narrow phase.
    """
    digits = 1 + max(MIN_DIGITS, math.ceil(-math.log2(tolerance)))
    for limbs in DISTANCE_BITS:
        kernel, pairs = _distance_kernel(x0.dtype, limbs), buffers.contacts.pairs
        inputs = [x0, x1, radius, int(kind), timed, digits]
        launch_over_queue(kernel, pairs, buffers.counts, Count.CONTACTS, inputs=inputs, outputs=[buffers], block_dim=64)


def launch_exact_phase(
    kind: PairKind, x0: wp.array, x1: wp.array, *, timed: bool, tolerance: float, buffers: PairBuffers, left: wp.array
) -> None:
    """Decides contacts exactly, without synchronizing with a GPU.

    Arguments are those of :func:`launch_exact_distances`, and a queue for contacts that are too wide, as long as
    ``buffers.for_exact``, array of int; both are overwritten. Without times, of the contacts only ``pairs`` and
    ``decided`` are used.
    """
    digits = max(MIN_DIGITS, math.ceil(-math.log2(tolerance)))
    queue, filled = buffers.for_exact, Count.FOR_EXACT
    for limbs in BITS if queue.device.is_cpu else _WIDTHS_ON_GPU:
        too_wide = Count[f"TOO_WIDE_{limbs}"]
        inputs = [x0, x1, int(kind), timed, digits, queue, int(filled), int(too_wide)]
        kernel, outputs = _kernel(x0.dtype, limbs), [buffers, left]
        launch_over_queue(kernel, queue, buffers.counts, filled, inputs=inputs, outputs=outputs, block_dim=64)
        queue, left, filled = left, queue, too_wide
