"""Writes the results of a step by world."""

from collections.abc import Callable

import numpy as np
import warp as wp

from ..schedule import Result, SolveStatus
from ..state.structs import FROZEN, NOT_FINITE, TRUNCATED, Step, allocate
from ..state.workspace import Workspace
from .world_report import Worlds

wp.set_module_options({"enable_backward": False})


@wp.struct
class _Arrays:
    """The arrays of :class:`.world_report.Worlds` that a step writes."""

    certified: wp.array[wp.bool]
    truncated: wp.array[int]
    frozen: wp.array[int]
    not_finite: wp.array[int]
    substeps: wp.array[int]


@wp.kernel
def _begin(status: SolveStatus, prevents_inversions: bool, taken: wp.array[int], out: _Arrays):
    """Writes what follows from the contacts of each world, and clears the counts of vertices."""
    world = wp.tid()
    detected = status.results[Result.UNDETECTED] == 0
    out.certified[world] = detected and status.of_worlds.remaining[world] == 0
    if prevents_inversions and status.of_worlds.inverting[world] > 0:
        out.certified[world] = False
    out.truncated[world] = 0
    out.frozen[world] = 0
    out.not_finite[world] = 0
    out.substeps[world] = 0
    if taken:
        out.substeps[world] = taken[world]


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
    # out
    out: _Arrays,
):
    """Counts vertices and bodies that were cut or have no prediction; finds worlds not certified for a position.

    ``not_finite`` is the number of elements with a position at the start or the end that is not finite.
    """
    i = wp.tid()
    motion, vertices = step.motion, step.vertices
    if i < vertices.outcome.shape[0]:
        outcome = vertices.outcome[i]
        world = motion.world[i]
        _count(outcome, world, out)
        lost = outcome & NOT_FINITE != 0
        if lost and i < particle_count:
            wp.atomic_add(out.not_finite, world, 1)
        invalid = not_finite[0] > wp.int64(0) and not (wp.isfinite(motion.x0[i]) and wp.isfinite(vertices.x1[i]))
        if lost or invalid:
            out.certified[world] = False
    if i < vertices.bodies.outcome.shape[0]:
        world = motion.bodies.world[i]
        if world < 0 and out.frozen.shape[0] == 1:
            world = 0
        if world >= 0:  # a body that is in all of several worlds is never moved
            _count(vertices.bodies.outcome[i], world, out)


class WorldCounter:
    """Counts what a step did in each world, without a change of the step.

    Attributes:
        worlds: The results of the last step.
    """

    def __init__(
        self,
        work: Workspace,
        *,
        strain: wp.array[float],
        find_inside: Callable[[], np.ndarray],
        max_impulse: wp.array[float] | None = None,
    ):
        """Allocates the results, and makes detections count by world; what is given is published with them."""
        self._work = work
        found = work.count_worlds()
        self._out = allocate(_Arrays, work.worlds, work.device)
        arrays = {name: getattr(self._out, name) for name in _Arrays.vars}
        counts = {name: getattr(found, name) for name in ("hits", "remaining", "filtered")}
        counts["crossings"] = work.status.crossings
        if work.tetrahedra is not None:
            counts |= {"inversions": found.inverting, "inverted": found.inverted}
        self.worlds = Worlds(**arrays, **counts, strain=strain, _find_inside=find_inside, _max_impulse=max_impulse)

    def count(self, taken: wp.array[int] | None = None) -> None:
        """Writes the results of a step, given the substeps that each world took, None for none."""
        work = self._work
        work.launch(_begin, work.worlds, [work.status, work.ends is not None, taken], [self._out])
        inputs = [work.step, work.particle_count, work.detector.counters.array]
        work.launch(_count_vertices, max(work.mesh.vertex_count, work.body_count), inputs, [self._out])
