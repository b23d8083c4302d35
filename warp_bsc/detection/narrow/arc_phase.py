"""The narrow phase of pairs with a turning body: whether they collide on their arcs, each decided by one thread.

All other pairs are those of the other phases, which leave these out. Nothing here depends on the host, so that a CUDA
graph may contain it; :mod:`.arc_search` decides the same pairs from the host, for bodies that make many turns.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from ...kernels.arcs import Arcs, any_turns, arc_bounds, are_of_one_group, impact_on_arcs, sagitta_of_part, turns
from ...kernels.min_distance import clears_at_once
from ...kernels.motion import motion_and_distance
from ...kernels.pairs import distance_of_corners, vertices_of_pair
from ...kernels.pipeline.batch_culling import BATCH
from ...kernels.pipeline.queues import append, is_filled, take_slot, take_slots
from ...kernels.polynomials import EDGE_EDGE, VERTEX_FACE
from ...kernels.signs import FREE, ROUNDOFF, UNSURE
from ..run.launch import launch_over, launch_over_queue, made_once
from ..run.settings import NO_FUSED_OPERATIONS, Count
from ..run.stage_timer import StageTimer
from .narrow_phase import NarrowPhase, launch_over_kinds
from .pair_kernels import PairStages, write_impact

__all__ = ["allocate_arcs", "bound_arc", "run_arc_phases"]

_QUEUED = wp.constant(int(Count.QUEUED))
_SURVIVORS = wp.constant(int(Count.SURVIVORS))
_CONTACTS = wp.constant(int(Count.CONTACTS))
_FOUND = wp.constant(int(Count.FOUND))
_UNSURE = wp.constant(int(Count.UNSURE))
_ONE = wp.constant(wp.float64(1.0))
_ZERO = wp.constant(wp.float64(0.0))


def allocate_arcs(body: np.ndarray, bodies: int, device: wp.Device, *, tolerance: float = 0.0) -> Arcs:
    """Returns the arcs of a mesh in which nothing turns yet; pairs within a body are excluded.

    Args:
        body: Body of each vertex, -1 for those that move straight, int, shape [vertex_count].
        bodies: Number of bodies.
        device: The device.
        tolerance: As of :class:`warp_bsc.kernels.arcs.Arcs`.
    """
    arcs = Arcs()
    arcs.turning = wp.zeros(1, dtype=int, device=device)
    arcs.body = wp.array(body, dtype=int, device=device)
    arcs.group = wp.array(body, dtype=int, device=device)
    arcs.centre = wp.zeros(bodies, dtype=wp.vec3d, device=device)
    arcs.turn = wp.zeros(bodies, dtype=wp.vec3d, device=device)
    arcs.bounds = wp.zeros(len(body), dtype=wp.vec3d, device=device)
    arcs.deviation = wp.zeros(len(body), dtype=wp.float64, device=device)
    arcs.tolerance = tolerance
    return arcs


@wp.func
def bound_arc(arcs: Arcs, vertex: int, x0: wp.vec3d, x1: wp.vec3d):
    """Writes how far a vertex is from its chord, and whether it turns, from its positions at both ends of the step."""
    deviation = _ZERO
    bounds = wp.vec3d()
    if wp.isfinite(x0) and wp.isfinite(x1):
        body = arcs.body[vertex]
        centre = wp.vec3d()
        turn = wp.vec3d()
        if body >= 0:
            centre = arcs.centre[body]
            turn = arcs.turn[body]
        bounds = arc_bounds(x0, x1, centre, turn)
        if wp.length_sq(turn) > _ZERO:
            deviation = sagitta_of_part(bounds, _ONE) + bounds[2]
            arcs.turning[0] = 1
    arcs.bounds[vertex] = bounds
    arcs.deviation[vertex] = deviation


@wp.func
def _decide(
    pair: wp.vec2i,
    # mesh
    x0: wp.array[Any],
    x1: wp.array[Any],
    arcs: Arcs,
    kind: int,
    # in and out
    stages: PairStages,
):
    """Adds a pair with a turning vertex to the contacts if it collides on its arcs, with its place in their order."""
    v = vertices_of_pair(kind, stages.elements, pair)
    a0, b0, c0, d0 = x0[v[0]], x0[v[1]], x0[v[2]], x0[v[3]]
    a1, b1, c1, d1 = x1[v[0]], x1[v[1]], x1[v[2]], x1[v[3]]
    result = impact_on_arcs(kind, v, a0, b0, c0, d0, a1, b1, c1, d1, arcs, _ZERO)
    if result.status == FREE:
        return
    slot = take_slot(stages.counts, _CONTACTS)
    take_slot(stages.counts, _FOUND)
    if result.status == UNSURE:
        take_slot(stages.counts, _UNSURE)
    contacts = stages.contacts
    if slot < wp.int64(contacts.pairs.shape[0]):
        k = wp.int32(slot)
        contacts.pairs[k] = pair
        contacts.decided[k] = wp.int8(result.status)
        write_impact(k, result, stages)
        stages.order[k] = k
        stages.keys[k] = (wp.int64(pair[0]) << wp.int64(stages.second_bits)) | wp.int64(pair[1])


@made_once
def _batch_kernel(dtype: type) -> wp.Kernel:
    """Returns the kernel that decides what the culls of a CPU left of each batch, for one type of position."""

    @wp.kernel(**NO_FUSED_OPERATIONS)
    def decide_arc_batches(
        first: int,
        # mesh
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        arcs: Arcs,
        kind: int,
        # in and out
        stages: PairStages,
    ):
        i = BATCH * (first + wp.tid())
        filled = wp.int32(wp.min(stages.counts[_QUEUED], wp.int64(stages.queue.shape[0])))
        end = wp.min(i + BATCH, filled)
        begin = i
        while i < end and stages.queue[i][0] >= 0:
            _decide(stages.queue[i], x0, x1, arcs, kind, stages)
            i += 1
        take_slots(stages.counts, _SURVIVORS, i - begin)

    return decide_arc_batches


@made_once
def _kernels(dtype: type) -> tuple[wp.Kernel, wp.Kernel]:
    """Returns the kernels that cull and decide on a GPU, for one type of position."""

    @wp.kernel(**NO_FUSED_OPERATIONS)
    def cull_arcs(
        first: int,
        # mesh
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        arcs: Arcs,
        kind: int,
        # in and out
        stages: PairStages,
    ):
        if not any_turns(arcs):
            return
        i = first + wp.tid()
        if not is_filled(i, stages.queue, stages.counts, _QUEUED):
            return
        pair = stages.queue[i]
        v = vertices_of_pair(kind, stages.elements, pair)
        if not turns(arcs, v) or are_of_one_group(arcs, v):
            return
        a0, b0, c0, d0 = x0[v[0]], x0[v[1]], x0[v[2]], x0[v[3]]
        a1, b1, c1, d1 = x1[v[0]], x1[v[1]], x1[v[2]], x1[v[3]]
        distance = distance_of_corners(kind, v, arcs.deviation)
        motion, scaled = motion_and_distance(kind, a0, b0, c0, d0, a1, b1, c1, d1, distance, ROUNDOFF)
        if not clears_at_once(motion, scaled):
            append(pair, stages.survivors, stages.counts, _SURVIVORS)

    @wp.kernel(**NO_FUSED_OPERATIONS)
    def decide_arcs(
        first: int,
        # mesh
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        arcs: Arcs,
        # in and out
        vertex_face: PairStages,
        edge_edge: PairStages,
    ):
        if not any_turns(arcs):
            return
        i = first + wp.tid()
        kind = int(VERTEX_FACE)
        stages = vertex_face
        if i >= vertex_face.survivors.shape[0]:
            i -= vertex_face.survivors.shape[0]
            kind = int(EDGE_EDGE)
            stages = edge_edge
        if not is_filled(i, stages.survivors, stages.counts, _SURVIVORS):
            return
        pair = stages.survivors[i]
        if turns(arcs, vertices_of_pair(kind, stages.elements, pair)):
            _decide(pair, x0, x1, arcs, kind, stages)

    return cull_arcs, decide_arcs


def run_arc_phases(
    phases: Sequence[tuple[NarrowPhase, wp.array]], x0: wp.array, x1: wp.array, arcs: Arcs, *, timer: StageTimer
) -> None:
    """Adds the contacts of queued pairs with a turning body, after the other phases, without synchronizing with a GPU.

    On a CPU the culls of :func:`.kernels.batch_culling_kernel` have left the pairs in their batches of the queue.

    Args:
        phases: The buffers of vertex-face and edge-edge pairs, with the vertex indices of their second elements.
        x0: Positions at the start of the step, array of vec3 or vec3d.
        x1: Positions at its end, of the same type.
        arcs: The arcs.
        timer: Measures the stage.
    """
    device = x0.device
    if device.is_cpu and not arcs.turning.numpy()[0]:
        return
    with timer.stage("classify"):
        if device.is_cpu:
            for phase, elements in phases:
                stages = phase.stages(elements)
                filled = min(len(stages.queue), int(phase.counts.numpy()[Count.QUEUED]))
                options = {"inputs": [x0, x1, arcs, int(phase.kind)], "outputs": [stages], "device": device}
                launch_over(_batch_kernel(x0.dtype), -(-filled // int(BATCH)), chunk=16, **options)
            return
        cull, decide = _kernels(x0.dtype)
        of_kinds = {phase.kind: phase.stages(elements) for phase, elements in phases}
        for kind, stages in of_kinds.items():
            options = {"inputs": [x0, x1, arcs, int(kind)], "outputs": [stages], "block_dim": 64}
            launch_over_queue(cull, stages.queue, stages.counts, Count.QUEUED, **options)
        launch_over_kinds(decide, of_kinds, "survivors", inputs=[x0, x1, arcs], block_dim=64)
