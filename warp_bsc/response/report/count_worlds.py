"""Writes the results of a step by world."""

from typing import Any

import warp as wp

from ..state.status import SolveStatus
from ..state.structs import FROZEN, NOT_FINITE, TRUNCATED, Step, allocate
from ..state.workspace import Workspace
from .count_steps import StepResults
from .worlds import Worlds

wp.set_module_options({"enable_backward": False})


@wp.struct
class _Arrays:
    """The arrays of :class:`.worlds.Worlds` that a step writes."""

    certified: wp.array[wp.bool]
    truncated: wp.array[int]
    frozen: wp.array[int]
    not_finite: wp.array[int]
    predicted_contacts: wp.array[int]
    remaining: wp.array[int]
    filtered: wp.array[int]
    crossings: wp.array[int]
    inverting: wp.array[int]  # empty if they are not looked at, and what follows
    inverted_at_start: wp.array[int]


@wp.kernel
def _begin(status: SolveStatus, prevents_inversions: bool, first: bool, out: _Arrays):
    """Writes what follows from the contacts of each world, and clears the counts of vertices.

    If it is not the ``first`` substep of a step, it adds to what the others did, as :func:`.count_steps.merge_step`.
    """
    world = wp.tid()
    found = status.of_worlds
    if first:
        out.certified[world] = True
        out.predicted_contacts[world] = 0
        out.remaining[world] = 0
        out.filtered[world] = 0
        out.crossings[world] = 0
    if found.remaining[world] > 0:
        out.certified[world] = False
    out.predicted_contacts[world] += found.hits[world]
    out.remaining[world] += found.remaining[world]
    out.filtered[world] += found.filtered[world]
    out.crossings[world] = wp.max(out.crossings[world], status.crossings[world])
    if out.inverting:
        if first:
            out.inverting[world] = 0
            out.inverted_at_start[world] = 0
        if prevents_inversions and found.inverting[world] > 0:
            out.certified[world] = False
        out.inverting[world] += found.inverting[world]
        out.inverted_at_start[world] = wp.max(out.inverted_at_start[world], found.inverted[world])
    out.truncated[world] = 0
    out.frozen[world] = 0
    out.not_finite[world] = 0


@wp.func
def _count(outcome: int, world: int, out: _Arrays):
    """Counts a vertex or a body."""
    if outcome & TRUNCATED != 0:
        wp.atomic_add(out.truncated, world, 1)
    if outcome & FROZEN != 0:
        wp.atomic_add(out.frozen, world, 1)


@wp.kernel
def _count_vertices(
    # in
    step: Step,
    particle_count: int,
    not_finite: wp.array[wp.int64],
    results: StepResults,
    # out
    out: _Arrays,
):
    """Counts vertices and bodies that were cut or have no prediction; finds worlds not certified for a position.

    ``not_finite`` is the number of elements with a position at the start or the end that is not finite.
    """
    i = wp.tid()
    motion, vertices = step.motion, step.vertices
    if i < results.of_vertices.shape[0]:
        outcome = results.of_vertices[i]
        world = motion.world[i]
        _count(outcome, world, out)
        lost = outcome & NOT_FINITE != 0
        if lost and i < particle_count:
            wp.atomic_add(out.not_finite, world, 1)
        invalid = not_finite[0] > wp.int64(0) and not (wp.isfinite(motion.x0[i]) and wp.isfinite(vertices.x1[i]))
        if lost or invalid:
            out.certified[world] = False
    if i < results.of_bodies.shape[0]:
        world = motion.bodies.world[i]
        if world < 0 and out.frozen.shape[0] == 1:
            world = 0
        if world >= 0:  # a body that is in all of several worlds is never moved
            _count(results.of_bodies[i], world, out)


class WorldCounter:
    """Counts what a step did in each world, without a change of the step.

    Attributes:
        worlds: The results of the last step.
    """

    def __init__(
        self, work: Workspace, results: StepResults, *, strain: wp.array, find_inside: Any, max_impulse: wp.array | None
    ):
        """Allocates the results, and makes detections count by world; what is given is published with them."""
        self._work, self._results = work, results
        work.count_worlds()
        inverting = 0 if work.tetrahedra is None else work.worlds
        sizes = {"inverting": inverting, "inverted_at_start": inverting}
        self._out = allocate(_Arrays, work.worlds, work.device, **sizes)
        arrays = {name: getattr(self._out, name) for name in _Arrays.vars if inverting or name not in sizes}
        self.worlds = Worlds(**arrays, strain=strain, _find_inside=find_inside, _max_impulse=max_impulse)

    def count(self, *, first: bool) -> None:
        """Writes the results of a step, or adds those of a substep that is not the ``first`` one."""
        work = self._work
        work.launch(_begin, work.worlds, [work.status, work.ends is not None, first], [self._out])
        inputs = [work.step, work.particle_count, work.detector.counters.array, self._results]
        work.launch(_count_vertices, max(work.mesh.vertex_count, work.body_count), inputs, [self._out])
