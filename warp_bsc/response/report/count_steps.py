"""Kernels that count a step in the report."""

import warp as wp

from ..state.certificate import is_certified
from ..state.status import Loop, Result, SolveStatus
from ..state.structs import INVALID, UNCERTIFIED, Step
from ..tuning import MAX_STRAIN
from .totals import StepTotals

wp.set_module_options({"enable_backward": False})


@wp.struct
class StepResults:
    """What a step did, over all its substeps."""

    results: wp.array[int]  # by Result: sums, but the most of crossings and inverted tetrahedra, certified if all are
    of_vertices: wp.array[int]  # outcomes, each bit of any substep
    of_bodies: wp.array[int]


@wp.func
def _merged(result: int, before: int, found: int) -> int:
    """Returns a result of substeps so far, given that before a substep, and that of the substep."""
    if result == Result.CERTIFIED:
        return wp.min(before, found)
    if result == Result.CROSSINGS or result == Result.INVERTED:
        return wp.max(before, found)
    return before + found


@wp.func
def _marks(step: Step, vertex: int, is_particle: bool, responds: bool) -> int:
    """Returns the bits of a vertex for what a certificate lacks, if a response or none resolved the step."""
    motion, vertices = step.motion, step.vertices
    bits = int(0)
    replaced = motion.is_not_finite[vertex] != 0
    if vertices.changed[vertex] != 0 or replaced:
        bits = int(UNCERTIFIED)
    finite = wp.isfinite(motion.x0[vertex]) and wp.isfinite(vertices.x1[vertex])
    if not finite or (replaced and not (is_particle and responds)):  # a response leaves particles where they were
        bits = bits | UNCERTIFIED | INVALID
    return bits


@wp.kernel
def merge_step(step: Step, status: SolveStatus, particle_count: int, responds: bool, first: bool, out: StepResults):
    """Adds what a step, or a substep, did to the results, in place of those of the last step if it is the ``first``."""
    i = wp.tid()
    if i == 0:  # the next one counts crossings at its start, unless nothing crossed, and this motion is certified
        results = status.results
        unchanged = is_certified(results) and results[Result.CROSSINGS] == 0 and results[Result.EXCLUDED] == 0
        status.loop[Loop.RECOUNT] = wp.where(unchanged, 0, 1)
    if i < out.results.shape[0]:
        found = status.results[i]
        out.results[i] = wp.where(first, found, _merged(i, out.results[i], found))
    if i < out.of_vertices.shape[0]:
        outcome = step.vertices.outcome[i] + int(0)
        if not is_certified(status.results):
            outcome = outcome | _marks(step, i, i < particle_count, responds)
        out.of_vertices[i] = outcome | wp.where(first, 0, out.of_vertices[i])
    if i < out.of_bodies.shape[0]:
        out.of_bodies[i] = step.vertices.bodies.outcome[i] | wp.where(first, 0, out.of_bodies[i])


@wp.kernel
def count_step(results: wp.array[int], strain: wp.array[float], totals: StepTotals):
    """Adds a step to the totals."""
    totals.steps[0] += wp.int64(1)
    totals.uncertified_steps[0] += wp.int64(1 - results[Result.CERTIFIED])
    totals.truncated_steps[0] += wp.int64(wp.min(results[Result.TRUNCATED], 1))
    totals.frozen_steps[0] += wp.int64(wp.min(results[Result.FROZEN], 1))
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
