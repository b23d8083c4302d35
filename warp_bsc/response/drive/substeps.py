"""Substeps: takes a step in a number of smaller ones, each with all that a step does: inner solver, contacts, response.

A step of length dt becomes n steps of length dt / n. Control and contacts of the program are the same in all of them,
and so are its forces on particles and bodies. What a program moves, particles and bodies that are kinematic, goes an
equal share of its way in each.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import warp as wp
from newton import BodyFlags
from newton.solvers import SolverBase, SolverStyle3D

from ..._private_names.of_newton import has_external_rigid_solver
from ..._private_names.of_warp import paused_tape
from ..state.mesh import host_array
from ..state.motion import ModelMotion, StateArrays, arrays_of, continues, takes_part
from ..state.structs import Motion
from .inner_steps import InnerSteps, StepCall

wp.set_module_options({"enable_backward": False})
_FORCES = "particle_f", "body_f"


@wp.struct
class _Way:
    """Where what a program moves is before and after a step."""

    x0: wp.array[wp.vec3]  # of particles; those that can be moved are not looked at
    x1: wp.array[wp.vec3]
    pose0: wp.array[wp.transform]  # of bodies
    pose1: wp.array[wp.transform]
    is_moved: wp.array[bool]  # whether the inner solver leaves a body where a program puts it
    ends_in_out: bool  # whether a program writes poses at the end of a step, and not at its start


@wp.kernel
def _find_way(
    # in
    motion: Motion,
    last: wp.array[wp.vec3],
    last_body_q: wp.array[wp.transform],
    body_world: wp.array[int],
    mask: wp.array[wp.bool],
    start: StateArrays,
    end: StateArrays,
    # out
    way: _Way,
):
    """Writes the way of what a program moves in a step: from where the last one ended, unless its world starts anew.

    Nothing moves in worlds that the ``mask`` leaves out.
    """
    i = wp.tid()
    if i < way.x0.shape[0]:
        way.x0[i] = start.particle_q[i]
        way.x1[i] = start.particle_q[i]
        world = motion.world[i]
        if last and (not mask or takes_part(mask, world)) and continues(motion, world) and wp.isfinite(last[i]):
            way.x0[i] = last[i]
    if i < way.is_moved.shape[0]:
        way.pose0[i] = start.body_q[i]
        way.pose1[i] = start.body_q[i]
        of_body = body_world[i]
        if not mask or takes_part(mask, of_body):
            if way.ends_in_out:
                way.pose1[i] = end.body_q[i]
            if last and continues(motion, of_body) and wp.isfinite(wp.transform_get_translation(last_body_q[i])):
                way.pose0[i] = last_body_q[i]


@wp.func
def _pose_on(before: wp.transform, after: wp.transform, share: float) -> wp.transform:
    p0, p1 = wp.transform_get_translation(before), wp.transform_get_translation(after)
    q0, q1 = wp.transform_get_rotation(before), wp.transform_get_rotation(after)
    if share == 1.0 or (wp.length_sq(p1 - p0) == 0.0 and wp.length_sq(q1 - q0) == 0.0):
        return after
    if wp.dot(q0, q1) < 0.0:
        q1 = -q1
    return wp.transform(p0 + share * (p1 - p0), wp.quat_slerp(q0, q1, share))


@wp.kernel
def _go_on(motion: Motion, way: _Way, i: int, number: int, start: StateArrays, end: StateArrays):
    """Writes where what a program moves is in a substep: after it, but at its start if a program writes poses there."""
    k = wp.tid()
    share = float(i + 1) / float(number)
    if k < way.x0.shape[0] and motion.inverse_mass[k] == 0.0:
        start.particle_q[k] = wp.where(i + 1 == number, way.x1[k], way.x0[k] + share * (way.x1[k] - way.x0[k]))
    if k < way.is_moved.shape[0] and way.is_moved[k]:
        pose = _pose_on(way.pose0[k], way.pose1[k], share)
        if way.ends_in_out:
            start.body_q[k] = _pose_on(way.pose0[k], way.pose1[k], float(i) / float(number))
            end.body_q[k] = pose
        else:
            start.body_q[k] = pose
            if i + 1 < number:  # for solvers that do not write it
                end.body_q[k] = pose


class Substeps(InnerSteps):
    """Divides steps into a number of smaller ones.

    Attributes:
        number: The number, at least 2.
        pushes_before: As of the ``steps`` that it divides into.
    """

    def __init__(self, steps: InnerSteps, motion: ModelMotion, number: int, *, integrator: SolverBase):
        """Allocates the states between the smaller steps, each of which the inner solver takes as one of ``steps``.

        If the ``integrator`` moves no body, a program writes where they are at the end of a step.
        """
        self.number, self._steps, self._motion, self._model = number, steps, motion, motion.mesh.model
        self.pushes_before = steps.pushes_before
        leaves_bodies = has_external_rigid_solver(integrator) or isinstance(integrator, SolverStyle3D)
        model, device = self._model, self._model.device
        self._states = [model.state(requires_grad=False) for _ in range(2)]
        self._forces = {n: wp.clone(array, requires_grad=False) for n, array in _forces_of(self._states[0]).items()}
        self._way, particles, bodies = _Way(), model.particle_count, model.body_count
        self._way.x0, self._way.x1 = (wp.zeros(particles, dtype=wp.vec3, device=device) for _ in range(2))
        self._way.pose0, self._way.pose1 = (wp.zeros(bodies, dtype=wp.transform, device=device) for _ in range(2))
        moved = np.zeros(0, dtype=bool)
        if bodies:
            kinematic = (host_array(model.body_flags) & BodyFlags.KINEMATIC) != 0
            moved = kinematic | (host_array(model.body_inv_mass) == 0.0) | leaves_bodies
        self._way.is_moved = wp.array(moved, dtype=bool, device=device)
        self._way.ends_in_out = leaves_bodies

    def take(self, call: StepCall) -> None:
        """Steps the inner solver, see :class:`.inner_steps.InnerSteps`."""
        self._steps.take(call)

    def parts(self, call: StepCall) -> Iterator[StepCall]:
        """Yields the smaller steps."""
        for name, array in _forces_of(call.state_in).items():  # before the inner solver adds its own
            wp.copy(self._forces[name], array)
        start = self._states[1]
        self._begin(call.state_in, call.state_out, start, call.mask)
        for i in range(self.number):
            end = self._states[i % 2] if i < self.number - 1 else call.state_out
            self._launch(_go_on, [self._way, i, self.number], [arrays_of(start), arrays_of(end)])
            dt = call.dt / self.number
            yield replace(call, state_in=start, state_out=end, dt=dt, number=i, count=self.number)
            if end is not call.state_out:
                for name in _forces_of(call.state_in):
                    wp.copy(getattr(end, name), self._forces[name])
            start = end

    def _begin(self, state_in, state_out, start, mask):
        """Copies the state at the start, and finds the way of what a program has moved."""
        motion = self._motion
        with paused_tape():
            start.assign(state_in)
            motion.set_start(arrays_of(state_in))  # which finds worlds that a program set to another state
        inputs = [motion.last.starts, motion.last.poses, self._model.body_world, mask, arrays_of(state_in)]
        self._launch(_find_way, [*inputs, arrays_of(state_out)], [self._way])

    def _launch(self, kernel, inputs, outputs):
        model, motion = self._model, self._motion.vertices
        size = max(model.particle_count, model.body_count)
        with paused_tape():
            wp.launch(kernel, size, inputs=[motion, *inputs], outputs=outputs, device=model.device)


def _forces_of(state):
    arrays = {name: getattr(state, name) for name in _FORCES}
    return {name: array for name, array in arrays.items() if array is not None}
