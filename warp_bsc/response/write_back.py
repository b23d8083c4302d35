"""Kernels that write a resolved step to a state, and count it in the report."""

import warp as wp

from .report import StepTotals
from .schedule import Loop, Result, SolveStatus
from .state.record import RecordCounts
from .state.structs import FROZEN, NOT_FINITE, TRUNCATED, MovedBodies

wp.set_module_options({"enable_backward": False})


@wp.kernel
def write_back(
    # in
    outcome: wp.array[int],
    x1: wp.array[wp.vec3],
    velocity: wp.array[wp.vec3],
    # out
    particle_q: wp.array[wp.vec3],
    particle_qd: wp.array[wp.vec3],
    status: SolveStatus,
):
    """Writes the particles that the response changed; the others keep every bit of what they are."""
    particle = wp.tid()
    if particle >= particle_q.shape[0]:  # a vertex of a shape, which moves with its body, wherever that is
        if outcome[particle] & NOT_FINITE != 0:
            status.results[Result.CERTIFIED] = 0
        return
    if outcome[particle] != 0:
        particle_q[particle] = x1[particle]
        particle_qd[particle] = velocity[particle]
    if outcome[particle] & TRUNCATED != 0:
        status.results[Result.TRUNCATED] = 1
    if outcome[particle] & FROZEN != 0:
        status.results[Result.FROZEN] = 1
    if outcome[particle] & NOT_FINITE != 0:
        wp.atomic_add(status.results, int(Result.NOT_FINITE), 1)


@wp.kernel
def write_back_bodies(
    # in
    bodies: MovedBodies,
    # out
    body_q: wp.array[wp.transform],
    body_qd: wp.array[wp.spatial_vector],
    body_q_prev: wp.array[wp.transform],
    status: SolveStatus,
):
    """Writes the bodies that the response changed; the others keep every bit of what they are.

    VBD takes the velocity of its next step from ``body_q_prev``, where it has that array.
    """
    body = wp.tid()
    outcome = bodies.outcome[body]
    if outcome == 0:
        return
    body_q[body] = bodies.pose[body]
    body_qd[body] = bodies.velocity[body]
    if body_q_prev:
        body_q_prev[body] = bodies.pose[body]
    if outcome & TRUNCATED != 0:
        status.results[Result.TRUNCATED] = 1
    if outcome & FROZEN != 0:
        status.results[Result.FROZEN] = 1


@wp.kernel
def finish_inspection(
    # in
    outcome: wp.array[int],
    particle_count: int,
    # out
    status: SolveStatus,
):
    """Makes the status of an inspection that of a step in which nothing was changed.

    The inspection took vertices without a finite end to stand. Their motion as it is stored is not certified.
    """
    vertex = wp.tid()
    if vertex == 0:
        status.results[Result.FIRST_HITS] = status.results[Result.REMAINING]
        status.results[Result.ITERATIONS] = 0
    if outcome[vertex] & NOT_FINITE != 0:
        status.results[Result.CERTIFIED] = 0
        if vertex < particle_count:
            wp.atomic_add(status.results, int(Result.NOT_FINITE), 1)


@wp.kernel
def count_step(status: SolveStatus, substeps: wp.array[int], totals: StepTotals):
    """Adds a step to the totals."""
    # a certified motion of elements that did not cross makes no crossings
    results = status.results
    unchanged = results[Result.CERTIFIED] == 1 and results[Result.CROSSINGS] == 0 and results[Result.EXCLUDED] == 0
    status.loop[Loop.RECOUNT] = wp.where(unchanged, 0, 1)
    totals.steps[0] += wp.int64(1)
    totals.substepped_steps[0] += wp.int64(wp.min(substeps[0], 1))
    totals.uncertified_steps[0] += wp.int64(1 - status.results[Result.CERTIFIED])
    totals.undetected_steps[0] += wp.int64(status.results[Result.UNDETECTED])
    totals.truncated_steps[0] += wp.int64(status.results[Result.TRUNCATED])
    totals.frozen_steps[0] += wp.int64(status.results[Result.FROZEN])
    totals.not_finite_steps[0] += wp.int64(wp.min(status.results[Result.NOT_FINITE], 1))
    totals.remaining[0] += wp.int64(status.results[Result.REMAINING])
    totals.excluded[0] += wp.int64(status.results[Result.EXCLUDED])


@wp.kernel
def count_record(counts: RecordCounts, complete: wp.array[int], totals: StepTotals):
    """Adds the record of a step to the totals."""
    totals.grazing[0] += wp.int64(counts.grazing[0])
    totals.lost_gradients[0] += wp.int64(1 - complete[0])
