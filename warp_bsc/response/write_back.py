"""Kernels that write a resolved step to a state, and count it in the report."""

import warp as wp

from .report_totals import StepTotals
from .schedule import Loop, Result, SolveStatus
from .state.motion import StateArrays
from .state.record import RecordCounts
from .state.structs import FROZEN, NOT_FINITE, TRUNCATED, Vertices
from .tuning import MAX_STRAIN

wp.set_module_options({"enable_backward": False})


@wp.func
def _write_cuts(outcome: int, status: SolveStatus):
    """Writes to the status whether a path was truncated, or something was frozen."""
    if outcome & TRUNCATED != 0:
        status.results[Result.TRUNCATED] = 1
    if outcome & FROZEN != 0:
        status.results[Result.FROZEN] = 1


@wp.func
def _count_if_not_finite(outcome: int, is_particle: bool, status: SolveStatus):
    """Counts a particle without a finite prediction. A step with one, or with such a vertex of a shape, is uncertified.

    What stands in its place is no result of the inner solver.
    """
    if outcome & NOT_FINITE != 0:
        status.results[Result.CERTIFIED] = 0
        if is_particle:
            wp.atomic_add(status.results, int(Result.NOT_FINITE), 1)


@wp.kernel
def write_back(vertices: Vertices, end: StateArrays, body_q_prev: wp.array[wp.transform], status: SolveStatus):
    """Writes the particles and bodies that the response changed; the others keep every bit of what they are.

    VBD takes the velocity of its next step from ``body_q_prev``, where it has that array.
    """
    i = wp.tid()
    bodies = vertices.bodies
    if i < bodies.outcome.shape[0] and bodies.outcome[i] != 0:
        end.body_q[i] = bodies.pose[i]
        end.body_qd[i] = bodies.velocity[i]
        if body_q_prev:
            body_q_prev[i] = bodies.pose[i]
        _write_cuts(bodies.outcome[i], status)
    if i >= vertices.outcome.shape[0]:
        return
    outcome = vertices.outcome[i]
    _count_if_not_finite(outcome, i < end.particle_q.shape[0], status)
    if i >= end.particle_q.shape[0]:  # a vertex of a shape, which moves with its body, wherever that is
        return
    if outcome != 0:
        end.particle_q[i] = vertices.x1[i]
        end.particle_qd[i] = vertices.velocity[i]
    _write_cuts(outcome, status)


@wp.kernel
def finish_inspection(outcome: wp.array[int], particle_count: int, status: SolveStatus):
    """Makes the status of an inspection that of a step in which nothing was changed.

    The inspection took vertices without a finite end to stand. Their motion as it is stored is not certified.
    """
    vertex = wp.tid()
    if vertex == 0:
        status.results[Result.FIRST_HITS] = status.results[Result.REMAINING]
        status.results[Result.ITERATIONS] = 0
    _count_if_not_finite(outcome[vertex], vertex < particle_count, status)


@wp.kernel
def count_step(status: SolveStatus, substeps: wp.array[int], strain: wp.array[float], totals: StepTotals):
    """Adds a step to the totals."""
    results = status.results
    # a certified motion of elements that did not cross makes no crossings
    unchanged = results[Result.CERTIFIED] == 1 and results[Result.CROSSINGS] == 0 and results[Result.EXCLUDED] == 0
    status.loop[Loop.RECOUNT] = wp.where(unchanged, 0, 1)
    totals.steps[0] += wp.int64(1)
    totals.substepped_steps[0] += wp.int64(wp.min(substeps[0], 1))
    totals.uncertified_steps[0] += wp.int64(1 - results[Result.CERTIFIED])
    totals.undetected_steps[0] += wp.int64(results[Result.UNDETECTED])
    totals.truncated_steps[0] += wp.int64(results[Result.TRUNCATED])
    totals.frozen_steps[0] += wp.int64(results[Result.FROZEN])
    totals.not_finite_steps[0] += wp.int64(wp.min(results[Result.NOT_FINITE], 1))
    totals.remaining[0] += wp.int64(results[Result.REMAINING])
    totals.excluded[0] += wp.int64(results[Result.EXCLUDED])
    for world in range(strain.shape[0]):
        if strain[world] > MAX_STRAIN:
            totals.strained_steps[0] += wp.int64(1)
            break
    if results[Result.INVERTING] > 0:
        totals.inverting_steps[0] += wp.int64(1)
    if results[Result.CROSSINGS] > 0:
        totals.crossing_steps[0] += wp.int64(1)
    if results[Result.REMAINING] > 0 or results[Result.NEW_CROSSINGS] > 0:
        totals.penetrated_steps[0] += wp.int64(1)


@wp.kernel
def count_record(counts: RecordCounts, totals: StepTotals):
    """Adds the record of a step to the totals."""
    totals.grazing[0] += wp.int64(counts.grazing[0])
    totals.lost_gradients[0] += wp.int64(1 - counts.complete[0])


@wp.kernel
def count_outrun(status: SolveStatus, totals: StepTotals):
    """Counts a step in which a contact layer left contacts to the stage."""
    totals.outrun_steps[0] += wp.int64(wp.min(status.results[Result.FIRST_HITS], 1))
