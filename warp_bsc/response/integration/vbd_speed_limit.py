"""The speed limit of VBD's self-contact, lifted where the collision stage certifies the motion instead.

Self-contact cuts the path of every particle, near something or not. The path between two detections is at most
``0.5 * dat_conservative_bound_relaxation * (margin + gap)``, and ends at planes between features that are near each
other. Where velocity, gravity and the forces of the program take a triangle farther in a step than nine tenths of that,
nothing in its world is cut in this step: VBD's forces move it, and the stage alone keeps elements apart. Elsewhere the
cuts stay. They damp cloth that is pressed until it jams, which otherwise trembles, as the stage takes back what the
forces did.

Cuts before rigid shapes stay in any case.
"""

import functools
from collections.abc import Callable
from typing import TypeGuard

import newton
import numpy as np
import warp as wp
from newton import ParticleFlags
from newton.solvers import SolverBase, SolverVBD

from ..._private_names.of_newton import displacements_since_detection, vbd_truncation, vbd_truncation_replaced
from ..tuning import FAST_PATH

wp.set_module_options({"enable_backward": False})


@wp.func
def _flag_of(is_fast: wp.array[int], world: int) -> int:
    """Returns the place of a world's flag: the last for what is in no world."""
    return wp.where(world < 0, is_fast.shape[0] - 1, world)


@wp.kernel
def find_fast_worlds(
    # in
    velocities: wp.array[wp.vec3],
    forces: wp.array[wp.vec3],
    inverse_masses: wp.array[float],
    flags: wp.array[wp.int32],
    world_of: wp.array[int],
    gravity: wp.array[wp.vec3],
    elements: wp.array[wp.vec3i],
    dt: float,
    path: float,
    # out
    is_fast: wp.array[int],
    any_is_fast: wp.array[int],
):
    """Marks the worlds in which an element moves farther in a step than a path.

    An element moves as its three particles do in the mean, so that one that trembles alone is not fast. What moves
    them is their velocity, gravity and the forces of the program.
    """
    element = elements[wp.tid()]
    way = wp.vec3()
    movable = int(0)
    for j in range(3):
        i = element[j]
        if inverse_masses[i] > 0.0 and (flags[i] & int(ParticleFlags.ACTIVE)) != 0:
            acceleration = gravity[wp.where(world_of[i] < 0, gravity.shape[0] - 1, world_of[i])]
            if forces:
                acceleration += inverse_masses[i] * forces[i]
            way += dt * (velocities[i] + dt * acceleration)
            movable += 1
    if wp.length(way) > float(movable) * path:
        is_fast[_flag_of(is_fast, world_of[element[0]])] = 1
        any_is_fast[0] = 1


@wp.kernel
def keep_displacements(displacements: wp.array[wp.vec3], kept: wp.array[wp.vec3]):
    """Copies displacements before they are cut; a launch, as a tape would record a copy."""
    i = wp.tid()
    kept[i] = displacements[i]


@wp.kernel
def undo_cuts(
    # in
    is_fast: wp.array[int],
    world_of: wp.array[int],
    start: wp.array[wp.vec3],
    kept: wp.array[wp.vec3],
    # out
    displacements: wp.array[wp.vec3],
    positions: wp.array[wp.vec3],
):
    """Restores the displacements of fast worlds."""
    i = wp.tid()
    if is_fast[_flag_of(is_fast, world_of[i])] == 1:
        displacements[i] = kept[i]
        positions[i] = start[i] + kept[i]


def has_self_contact(solver: SolverBase) -> TypeGuard[SolverVBD]:
    """Returns whether a solver is VBD with self-contact."""
    return isinstance(solver, SolverVBD) and solver.particle_enable_self_contact


def has_speed_limit(solver: SolverBase) -> TypeGuard[SolverVBD]:
    """Returns whether a solver is VBD with self-contact, whose limit can be lifted; warns if this Newton forbids it."""
    return has_self_contact(solver) and vbd_truncation(solver) is not None


class SpeedLimit:
    """Lifts the limit of VBD's self-contact in steps in which it would brake."""

    def __init__(self, solver: SolverVBD):
        """Allocates buffers for a solver for which :func:`has_speed_limit` is true."""
        self._solver, model = solver, solver.model
        # by world, what is in no world, and whether any of them is fast
        self._fast_worlds = wp.zeros(model.world_count + 2, dtype=int, device=model.device)
        self._is_fast, self._any_is_fast = self._fast_worlds[:-1], self._fast_worlds[-1:]
        faces = np.zeros((0, 3), dtype=int) if model.tri_indices is None else model.tri_indices.numpy().reshape(-1, 3)
        others = np.setdiff1d(np.arange(model.particle_count), faces)
        elements = np.concatenate([faces, np.stack([others] * 3, axis=1)])
        self._elements = wp.array(elements, dtype=wp.vec3i, device=model.device)
        self._kept = wp.empty(model.particle_count, dtype=wp.vec3, device=model.device)

    def step(self, step: Callable[[], None], state: newton.State, dt: float, *, can_branch: bool) -> None:
        """Takes a step of VBD without its limit in worlds in which something is fast at the start of the step.

        Args:
            step: Steps VBD.
            state: The state at the start of the step.
            dt: Length of the step [s].
            can_branch: Whether a graph may contain the step twice, with and without the limit, of which it takes one.
                The step with both, for each world, launches twice as many kernels to cut.
        """
        solver, model = self._solver, self._solver.model
        path = 0.5 * solver.dat_conservative_bound_relaxation
        path *= solver.particle_self_contact_margin + solver.particle_self_contact_gap
        self._fast_worlds.zero_()
        inputs = [state.particle_qd, state.particle_f, model.particle_inv_mass, model.particle_flags]
        inputs += [model.particle_world, model.gravity, self._elements, dt, FAST_PATH * path]
        self._launch(find_fast_worlds, inputs, [self._is_fast, self._any_is_fast], len(self._elements))
        if not can_branch:
            self._step_with(self._cut_where_slow, step)
            return
        cut = self._cut_where_slow if model.world_count > 1 else self._cut_before_shapes
        wp.capture_if(self._any_is_fast, lambda: self._step_with(cut, step), step)

    def _launch(self, kernel, inputs, outputs, size=None):
        model = self._solver.model
        size = model.particle_count if size is None else size
        wp.launch(kernel, size, inputs=inputs, outputs=outputs, device=model.device, record_tape=False)

    def _step_with(self, cut, step):
        """Takes a step in which VBD cuts displacements by another function."""
        start, displacements, own_cut = displacements_since_detection(self._solver)
        with vbd_truncation_replaced(self._solver, functools.partial(cut, start, displacements, own_cut)):
            step()

    def _cut_before_shapes(self, start, displacements, cut, state, contacts):
        """Cuts displacements as VBD does without self-contact."""
        solver = self._solver
        solver.particle_enable_self_contact = False
        try:
            cut(state, contacts)
        finally:
            solver.particle_enable_self_contact = True

    def _cut_where_slow(self, start, displacements, cut, state, contacts):
        """Cuts displacements as VBD does, in fast worlds as it does without self-contact."""
        if self._solver.rigid_soft_enable_dat:
            self._cut_before_shapes(start, displacements, cut, state, contacts)
        self._launch(keep_displacements, [displacements], [self._kept])
        cut(state, contacts)
        inputs = [self._is_fast, self._solver.model.particle_world, start, self._kept]
        self._launch(undo_cuts, inputs, [displacements, state.particle_q])
