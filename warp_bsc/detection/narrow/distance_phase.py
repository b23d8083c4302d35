"""The narrow phase of pairs with a minimum distance: culls -> advancement -> subdivision -> exact stage -> order.

The host decides the rest exactly. The stages write to the buffers of a :class:`.narrow_phase.NarrowPhase`, which sorts
the contacts. The minimum distance of a pair is the sum of two radii, rounded to double precision: the radius of a
vertex is its own, that of an edge or a face the largest one of its vertices.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import warp as wp

from ... import checker
from ...kernels.min_distance import Search, advance, begin_search, clears_at_once, closest_at, end_search, visit_part
from ...kernels.motion import all_finite, motion_and_distance, relative_motion
from ...kernels.pairs import distance_of_corners, firsts_of, points_of_pair
from ...kernels.pipeline.queues import append, is_filled, take_slot
from ...kernels.polynomials import EDGE_EDGE, VERTEX_FACE, Motion
from ...kernels.signs import FREE, HIT, ROUNDOFF, UNSURE
from ..run.launch import launch, launch_over, launch_over_queue, made_once
from ..run.settings import NO_FUSED_OPERATIONS, TOLERANCE, Count, DistanceKind, Method
from ..run.stage_timer import StageTimer
from .contact_buffer import HostContacts
from .exact_stage import launch_exact_distances
from .narrow_phase import NarrowPhase
from .pair_kernels import PairStages
from .rings import Rings, are_within_rings

__all__ = [
    "decide_distances_on_host",
    "pair_distances",
    "run_distance_phases",
]

_BLOCK = 64
"""Threads of a block that searches."""
_ADVANCING, _SUBDIVIDING = 384, 256
"""Threads of a multiprocessor that search, limited by their registers, each for one pair after another. On a CPU, each
thread searches for one pair."""

_QUEUED = wp.constant(int(Count.QUEUED))
_SURVIVORS = wp.constant(int(Count.SURVIVORS))
_CONTACTS = wp.constant(int(Count.CONTACTS))
_FOUND = wp.constant(int(Count.FOUND))
_UNSURE = wp.constant(int(Count.UNSURE))
_FOR_EXACT = wp.constant(int(Count.FOR_EXACT))
_SUBDIVIDED = wp.constant(int(Count.SUBDIVIDED))


@wp.func
def _are_of_one_body(corners: wp.vec4i, body: wp.array[int]) -> bool:
    """Returns whether all points of a pair belong to one body, from -1."""
    b = body[corners[0]]
    return b >= -1 and body[corners[1]] == b and body[corners[2]] == b and body[corners[3]] == b


@wp.func
def _enqueue_contact(pair: wp.vec2i, stages: PairStages) -> int:
    """Returns the index of a new contact, -1 if it does not fit."""
    slot = take_slot(stages.counts, _CONTACTS)
    if slot >= wp.int64(stages.contacts.pairs.shape[0]):
        return -1
    k = wp.int32(slot)
    stages.contacts.pairs[k] = pair
    stages.order[k] = k
    return k


@wp.struct
class _PairSearch:
    """A search, its motion, and the minimum distance in the scale of that."""

    motion: Motion
    distance: wp.float64
    search: Search


@wp.func
def _decide_contact(k: int, kind: int, at: _PairSearch, timed: bool, stages: PairStages):
    """Writes the result of a search to contact k, if that is not negative, and counts it if it is not free."""
    result = end_search(kind, at.motion, at.search)
    if result.status != FREE:
        take_slot(stages.counts, _FOUND)
    if result.status == UNSURE:
        take_slot(stages.counts, _UNSURE)
    if result.status == UNSURE or (timed and result.status == HIT and result.within_tolerance == 0):
        take_slot(stages.counts, _FOR_EXACT)
    if k >= 0:
        contacts = stages.contacts
        contacts.status[k] = wp.int8(result.status)
        contacts.decided[k] = wp.int8(result.status)
        contacts.within_tolerance[k] = result.within_tolerance == 1
        contacts.toi[k] = result.toi
        contacts.coordinates[k] = result.coordinates
        contacts.normal[k] = result.normal
        pair = contacts.pairs[k]
        stages.keys[k] = stages.last_key
        if result.status != FREE:
            stages.keys[k] = (wp.int64(pair[0]) << wp.int64(stages.second_bits)) | wp.int64(pair[1])


class _Kernels(NamedTuple):
    """The kernels for one type of position, in the order in which they run."""

    cull: wp.Kernel
    advance: wp.Kernel
    subdivide: wp.Kernel
    find_closest: wp.Kernel


@made_once
def _kernels(dtype: type) -> _Kernels:
    """Returns the kernels for one type of position, each in a module of its own."""

    @wp.kernel(**NO_FUSED_OPERATIONS)
    def cull_distances(
        first: int,
        # mesh
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        radius: wp.array[wp.float64],
        rings: Rings,
        body: wp.array[int],
        kind: int,
        roundoff: wp.float64,
        # in and out
        stages: PairStages,
    ):
        i = first + wp.tid()
        if not is_filled(i, stages.queue, stages.counts, _QUEUED):
            return
        pair = stages.queue[i]
        v = points_of_pair(kind, stages.elements, pair)
        if body and _are_of_one_body(v, body):
            return
        a0, b0, c0, d0 = x0[v[0]], x0[v[1]], x0[v[2]], x0[v[3]]
        a1, b1, c1, d1 = x1[v[0]], x1[v[1]], x1[v[2]], x1[v[3]]
        points = wp.where(kind == EDGE_EDGE, EDGE_EDGE, VERTEX_FACE)
        distance = distance_of_corners(kind, v, radius)
        motion, scaled = motion_and_distance(points, a0, b0, c0, d0, a1, b1, c1, d1, distance, roundoff)
        if clears_at_once(motion, scaled) or are_within_rings(v, firsts_of(kind), rings):
            return
        append(pair, stages.survivors, stages.counts, _SURVIVORS)

    @wp.func
    def search_next(
        before: _PairSearch,
        kind: int,
        # mesh
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        elements: wp.array2d[int],
        radius: wp.array[wp.float64],
        # next pair
        pairs: wp.array[wp.vec2i],
        index: int,
        # options
        roundoff: wp.float64,
        tolerance: wp.float64,
    ) -> _PairSearch:
        """Returns a search that has not ended as it is, otherwise one that begins with the next pair."""
        # this return keeps Warp from selecting between two searches, which takes registers for both
        if not before.search.ended:
            return before
        new = _PairSearch()
        v = points_of_pair(kind, elements, pairs[index])
        a0, b0, c0, d0 = x0[v[0]], x0[v[1]], x0[v[2]], x0[v[3]]
        a1, b1, c1, d1 = x1[v[0]], x1[v[1]], x1[v[2]], x1[v[3]]
        points = wp.where(kind == EDGE_EDGE, EDGE_EDGE, VERTEX_FACE)
        distance = distance_of_corners(kind, v, radius)
        motion, scaled = motion_and_distance(points, a0, b0, c0, d0, a1, b1, c1, d1, distance, roundoff)
        new.motion = motion
        new.distance = scaled
        new.search = begin_search(motion, scaled, tolerance)
        new.search.ended = not all_finite(a0, b0, c0, d0, a1, b1, c1, d1)
        return new

    @wp.kernel(**NO_FUSED_OPERATIONS)
    def advance_distances(
        first: int,
        # mesh
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        radius: wp.array[wp.float64],
        kind: int,
        roundoff: wp.float64,
        timed: bool,
        tolerance: wp.float64,
        threads: wp.uint32,
        # in and out
        stages: PairStages,
    ):
        filled = wp.uint32(wp.min(stages.counts[_SURVIVORS], wp.int64(stages.survivors.shape[0])))
        i = wp.uint32(first + wp.tid())
        at = _PairSearch()
        at.search.ended = True
        # the threads of a warp advance together, each with a pair of its own
        while i < filled:
            at = search_next(at, kind, x0, x1, stages.elements, radius, stages.survivors, int(i), roundoff, tolerance)
            at.search = advance(at.motion, at.distance, timed, at.search)
            if at.search.ended and at.search.status != FREE:
                k = _enqueue_contact(stages.survivors[int(i)], stages)
                if not at.search.given_up:
                    _decide_contact(k, kind, at, timed, stages)
                elif k >= 0:
                    stages.for_exact[wp.int32(take_slot(stages.counts, _SUBDIVIDED))] = k
            if at.search.ended:
                i += threads

    @wp.kernel(**NO_FUSED_OPERATIONS)
    def subdivide_distances(
        first: int,
        # mesh
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        radius: wp.array[wp.float64],
        kind: int,
        roundoff: wp.float64,
        timed: bool,
        tolerance: wp.float64,
        threads: wp.uint32,
        # in and out
        stages: PairStages,
    ):
        filled = wp.uint32(stages.counts[_SUBDIVIDED])
        i = wp.uint32(first + wp.tid())
        at = _PairSearch()
        at.search.ended = True
        while i < filled:
            k = stages.for_exact[int(i)]
            at = search_next(at, kind, x0, x1, stages.elements, radius, stages.contacts.pairs, k, roundoff, tolerance)
            at.search = visit_part(kind, at.motion, at.distance, timed, at.search)
            if at.search.ended:
                _decide_contact(k, kind, at, timed, stages)
                i += threads

    @wp.kernel(**NO_FUSED_OPERATIONS)
    def find_closest(
        # mesh
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        elements: wp.array2d[int],
        kind: int,
        # in
        pairs: wp.array[wp.vec2i],
        time: wp.array[wp.float64],
        # out
        coordinates: wp.array[wp.vec3d],
        normal: wp.array[wp.vec3d],
    ):
        i = wp.tid()
        v = points_of_pair(kind, elements, pairs[i])
        a0, b0, c0, d0 = x0[v[0]], x0[v[1]], x0[v[2]], x0[v[3]]
        a1, b1, c1, d1 = x1[v[0]], x1[v[1]], x1[v[2]], x1[v[3]]
        points = wp.where(kind == EDGE_EDGE, EDGE_EDGE, VERTEX_FACE)
        motion = relative_motion(points, a0, b0, c0, d0, a1, b1, c1, d1, wp.float64(0.0))
        at, direction = closest_at(kind, motion, time[i])
        coordinates[i] = at
        normal[i] = direction

    return _Kernels(cull_distances, advance_distances, subdivide_distances, find_closest)


def run_distance_phases(
    phases: Sequence[tuple[NarrowPhase, wp.array]],
    x0: wp.array,
    x1: wp.array,
    radius: wp.array,
    rings: Rings,
    *,
    method: Method,
    body: wp.array | None = None,
    timed: bool = True,
    tolerance: float = TOLERANCE,
    timer: StageTimer,
) -> None:
    """Launches all stages but the sorting over the queued pairs, without synchronizing with a GPU.

    Args:
        phases: The buffers of each kind, a :class:`DistanceKind`, with the vertex indices of its second elements.
        x0: Positions at the start of the step, array of vec3 or vec3d.
        x1: Positions at its end, of the same type.
        radius: Radius of each vertex, array of float64.
        rings: Vertices whose elements are excluded.
        method: One of :data:`METHODS`; with "exact", pairs that stay UNSURE are left to
            :func:`decide_distances_on_host`.
        body: Body of each vertex, array of int: pairs whose vertices are all of one body from -1 are excluded. None for
            none.
        timed: Whether to find times of impact within the tolerance.
        tolerance: Tolerance of the times of impact, as a share of the step.
        timer: Measures the stages.
    """
    kernels = _kernels(x0.dtype)
    roundoff = 0.0 if method == "float" else ROUNDOFF
    with timer.stage("cull"):
        for phase, elements in phases:
            inputs = [x0, x1, radius, rings, body, int(phase.kind), roundoff]
            stages = phase.stages(elements)
            launch_over_queue(kernels.cull, stages.queue, phase.counts, Count.QUEUED, inputs=inputs, outputs=[stages])
    device = x0.device
    for name, kernel, count, threads_of_multiprocessor in (
        ("classify", kernels.advance, Count.SURVIVORS, _ADVANCING),
        ("time of impact", kernels.subdivide, Count.SUBDIVIDED, _SUBDIVIDING),
    ):
        with timer.stage(name):
            for phase, elements in phases:
                stages = phase.stages(elements)
                entries = threads = threads_of_multiprocessor * device.sm_count
                if device.is_cpu:
                    entries = min(len(stages.survivors), int(phase.counts.numpy()[count]))
                    threads = 2**31
                inputs = [x0, x1, radius, int(phase.kind), roundoff, timed, tolerance, threads]
                launch_over(kernel, entries, inputs=inputs, outputs=[stages], device=device, block_dim=_BLOCK)
    if method == "exact":
        with timer.stage("exact"):
            for phase, elements in phases:
                stages = phase.stages(elements)
                launch_exact_distances(
                    x0, x1, radius, DistanceKind(phase.kind), timed=timed, tolerance=tolerance, stages=stages
                )


def pair_distances(
    kind: DistanceKind, elements: np.ndarray, pairs: np.ndarray, radius: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the vertices of pairs of a kind, int, shape [n, kind.points], and their minimum distances, shape [n].

    Args:
        kind: The kind of pair.
        elements: Vertex indices of faces or edges; not used for (vertex, vertex).
        pairs: (vertex, face) and so on, shape [n, 2].
        radius: Radius of each vertex, float64.
    """
    first = elements[pairs[:, 0]] if kind == DistanceKind.EDGE_EDGE else pairs[:, :1]
    second = pairs[:, 1:] if kind == DistanceKind.VERTEX_VERTEX else elements[pairs[:, 1]]
    distance = radius[first].max(axis=1, initial=0.0) + radius[second].max(axis=1, initial=0.0)
    return np.concatenate([first, second], axis=1), distance


def decide_distances_on_host(
    kind: DistanceKind,
    x0: wp.array,
    x1: wp.array,
    elements: wp.array,
    radius: np.ndarray,
    contacts: HostContacts,
    which: np.ndarray,
    *,
    timed: bool = True,
) -> None:
    """Decides some contacts with the exact checker, on the host, and changes their rows.

    Args:
        kind: The kind of pair.
        x0: Positions at the start of the step, Warp array.
        x1: Positions at its end.
        elements: Vertex indices of faces or edges, Warp array.
        radius: Radius of each vertex, float64.
        contacts: The contacts.
        which: Which of them to decide, bool, shape [n].
        timed: Whether to find times of impact, coordinates and normals.
    """
    if not which.any():
        return
    corners, distance = pair_distances(kind, elements.numpy(), contacts.pairs[which], radius)
    points = np.concatenate([x0.numpy()[corners], x1.numpy()[corners]], axis=1)
    if not timed:
        contacts.decided[which] = np.where(getattr(checker, kind.label)(points, distance), HIT, FREE)
        return
    toi = contacts.toi
    toi[which] = getattr(checker, f"{kind.label}_toi")(points, distance)[:, 0]
    contacts.decided[which] = np.where(np.isnan(toi[which]), FREE, HIT)
    toi[~contacts.hit] = 2.0
    contacts.within_tolerance[which] = contacts.hit[which]
    again = np.flatnonzero(which & contacts.hit)
    outputs = [wp.empty(len(again), dtype=wp.vec3d, device=x0.device) for _ in range(2)]
    timed_pairs = wp.array(contacts.pairs[again], dtype=wp.vec2i, device=x0.device)
    inputs = [x0, x1, elements, int(kind), timed_pairs, wp.array(toi[again], dtype=wp.float64, device=x0.device)]
    kernel = _kernels(x0.dtype).find_closest
    launch(kernel, len(again), inputs=inputs, outputs=outputs, device=x0.device, record_tape=False)
    contacts.coordinates[again], contacts.normal[again] = (output.numpy() for output in outputs)
