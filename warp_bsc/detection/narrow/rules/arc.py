"""The narrow phase of pairs with a turning body: whether they collide on their arcs, each decided by one thread.

All other pairs are those of the other phases, which leave these out. Nothing here depends on the host, so that a CUDA
graph may contain it; :mod:`.arc_search` decides the same pairs from the host, for bodies that make many turns.
"""

from typing import Any

import numpy as np
import warp as wp

from ....kernels.arcs import Arcs, arc_bounds, impact_on_arcs, move_as_one, sagitta_of_part
from ....kernels.min_distance import clears_at_once
from ....kernels.motion import motion_and_distance, query_at
from ....kernels.pairs import distance_of_corners, ends_of, vertices_of_pair
from ....kernels.pipeline.batch_culling import BATCH
from ....kernels.pipeline.queues import filled_entries, take_slots
from ....kernels.signs import FREE, ONE, ROUNDOFF, ZERO
from ...run.launch import launch_over, made_once
from ...run.phase_timer import PhaseTimer
from ...run.settings import NO_FUSED_OPERATIONS, Count
from ..narrow_phase import Phases, buffers_of, launch_culls, launch_decisions
from ..pair_kernels import PairBuffers, PairRule, add_contact


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
    arcs.body, arcs.rigid_id = (wp.array(body, dtype=int, device=device) for _ in range(2))
    arcs.centre, arcs.turn = (wp.zeros(bodies, dtype=wp.vec3d, device=device) for _ in range(2))
    arcs.bounds = wp.zeros(len(body), dtype=wp.vec3d, device=device)
    arcs.deviation = wp.zeros(len(body), dtype=wp.float64, device=device)
    arcs.tolerance = tolerance
    return arcs


@wp.func
def bound_arc(arcs: Arcs, vertex: int, x0: wp.vec3d, x1: wp.vec3d):
    """Writes how far a vertex is from its chord, and whether it turns, from its positions at both ends of the step."""
    deviation = ZERO
    bounds = wp.vec3d()
    if wp.isfinite(x0) and wp.isfinite(x1):
        body = arcs.body[vertex]
        centre = wp.vec3d()
        turn = wp.vec3d()
        if body >= 0:
            centre = arcs.centre[body]
            turn = arcs.turn[body]
        bounds = arc_bounds(x0, x1, centre, turn)
        if wp.length_sq(turn) > ZERO:
            deviation = sagitta_of_part(bounds, ONE) + bounds[2]
            arcs.turning[0] = 1
    arcs.bounds[vertex] = bounds
    arcs.deviation[vertex] = deviation


@wp.struct
class Options:
    """Options of the rule."""

    arcs: Arcs


@wp.func
def _excludes(options: Options, kind: int, v: wp.vec4i) -> bool:
    return move_as_one(options.arcs, v)


@wp.func
def _clears(options: Options, kind: int, v: wp.vec4i, x0: wp.array[Any], x1: wp.array[Any]) -> bool:
    a0, b0, c0, d0, a1, b1, c1, d1 = ends_of(x0, x1, v)
    distance = distance_of_corners(kind, v, options.arcs.deviation)
    motion, scaled = motion_and_distance(kind, a0, b0, c0, d0, a1, b1, c1, d1, distance, ROUNDOFF)
    return clears_at_once(motion, scaled)


@wp.func
def _decide(options: Options, kind: int, v: wp.vec4i, x0: wp.array[Any], x1: wp.array[Any]):
    result = impact_on_arcs(kind, v, query_at(x0, x1, v), options.arcs, ZERO)
    return result, result.status != FREE


_RULE = PairRule(Options, _excludes, _clears, _decide, turning=True)


@made_once
def _batch_kernel(dtype: type) -> wp.Kernel:
    """Returns the kernel that decides what the culls of a CPU left of each batch, for one type of position."""

    @wp.kernel(**NO_FUSED_OPERATIONS)
    def decide_arc_batches(
        first: int,
        # mesh
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        # in
        options: Options,
        kind: int,
        # in and out
        buffers: PairBuffers,
    ):
        i = BATCH * (first + wp.tid())
        end = wp.min(i + BATCH, filled_entries(buffers.queue, buffers.counts, Count.QUEUED))
        begin = i
        while i < end and buffers.queue[i][0] >= 0:
            pair = buffers.queue[i]
            v = vertices_of_pair(kind, buffers.elements, pair)
            result, is_contact = _decide(options, kind, v, x0, x1)
            if is_contact:
                add_contact(pair, result, buffers)
            i += 1
        take_slots(buffers.counts, Count.SURVIVORS, i - begin)

    return decide_arc_batches


def run_arcs(phases: Phases, x0: wp.array, x1: wp.array, arcs: Arcs, *, timer: PhaseTimer) -> None:
    """Adds the contacts of queued pairs with a turning body, after those of :mod:`.contact`, without synchronizing.

    Arguments are those of :func:`.run_contacts`. On a CPU, :func:`.batch_culling_kernel` has left the pairs in their
    batches of the queue.
    """
    device = x0.device
    if device.is_cpu and not arcs.turning.numpy()[0]:
        return
    options, buffers = Options(), buffers_of(phases)
    options.arcs = arcs
    with timer.phase("classify"):
        if not device.is_cpu:
            launch_culls(_RULE, buffers, x0, x1, options)
            launch_decisions(_RULE, buffers, x0, x1, options)
            return
        for kind, s in buffers.items():
            filled = min(len(s.queue), int(s.counts.numpy()[Count.QUEUED]))
            inputs = [x0, x1, options, int(kind)]
            batches = -(-filled // int(BATCH))
            launch_over(_batch_kernel(x0.dtype), batches, inputs=inputs, outputs=[s], device=device, chunk=16)
