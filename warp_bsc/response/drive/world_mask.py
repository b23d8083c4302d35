"""Worlds that take no part in a step: nothing of them changes, and the stage looks at none of their elements."""

import contextlib
from collections.abc import Iterator

import newton
import numpy as np
import warp as wp
from newton.solvers import SolverBase

from ..._arguments import given
from ..._private_names.of_newton import body_q_prev
from ..state.mesh import host_array
from ..state.motion import ModelMotion, continues, takes_part
from ..state.structs import Motion
from ..state.workspace import Workspace
from .snapshot import Snapshot, restore_worlds

wp.set_module_options({"enable_backward": False})


@wp.kernel
def _restore_last_poses(
    # in
    saved: wp.array[wp.transform],
    state: wp.array[wp.transform],
    world: wp.array[int],
    mask: wp.array[wp.bool],
    motion: Motion,
    # out
    last: wp.array[wp.transform],
):
    """Restores the poses from which the inner solver takes velocities; a world that starts anew starts in its state."""
    body = wp.tid()
    if not takes_part(mask, world[body]):
        last[body] = wp.where(continues(motion, world[body]), saved[body], state[body])


@wp.struct
class _Held:
    """Data of the worlds that take no part in a step, kept until its end, and masses that are 0 in these worlds."""

    last: wp.array[wp.vec3]  # where vertices ended the last step
    planes: wp.array[wp.vec4d]
    inverse_mass: wp.array[float]  # 0 in these worlds
    body_inverse_mass: wp.array[float]
    active: wp.array[int]  # 1 of vertices in other worlds that can move


@wp.kernel
def _hold(
    # in
    mask: wp.array[wp.bool],
    inverse_mass: wp.array[float],
    plane_world: wp.array[int],
    can_move: wp.array[int],
    # in and out
    motion: Motion,
    plane_start: wp.array[wp.vec4d],
    plane_end: wp.array[wp.vec4d],
    held: _Held,
):
    """Lets vertices and planes of worlds that take no part stand where the last step left them, without mass."""
    i = wp.tid()
    if i < plane_start.shape[0] and not takes_part(mask, plane_world[i]):
        plane_start[i] = held.planes[i]
        plane_end[i] = held.planes[i]
    if i < motion.bodies.inverse_mass.shape[0]:
        body_mass = motion.bodies.inverse_mass[i]
        held.body_inverse_mass[i] = wp.where(takes_part(mask, motion.bodies.world[i]), body_mass, 0.0)
    if i < motion.x0.shape[0]:
        active = takes_part(mask, motion.world[i])
        held.active[i] = wp.where(active, can_move[i], 0)
        held.inverse_mass[i] = wp.where(active, inverse_mass[i], 0.0)
        if not active:
            x = motion.x0[i]
            if held.last and wp.isfinite(held.last[i]):
                x = held.last[i]
            motion.x0[i] = x
            motion.x1[i] = x
            motion.velocity[i] = wp.vec3()
            motion.is_not_finite[i] = 0


class WorldMask:
    """Lets worlds take no part in a step of a stage.

    The inner solver steps all worlds, as it knows no mask; of worlds that take no part, the state at the start is put
    back. The stage takes their elements to stand, and to have no mass, so that it looks at no pair of them.
    """

    def __init__(self, solver: SolverBase, work: Workspace, motion: ModelMotion):
        """Allocates buffers for the inner solver, the workspace of steps, and their motion."""
        self._solver, self._work, self._motion = solver, work, motion
        model, device = motion.mesh.model, work.device
        self._last = Snapshot(motion.last.arrays, worlds=motion.last.worlds)
        self._held, of_vertices = _Held(), motion.vertices
        held = self._held
        last, held.planes, *_ = self._last.saved
        if motion.last.starts is not None:
            held.last = last
        held.inverse_mass = wp.empty_like(of_vertices.inverse_mass)
        held.active = wp.zeros(len(held.inverse_mass), dtype=int, device=device)
        if motion.moves_bodies:
            held.body_inverse_mass = wp.empty_like(of_vertices.bodies.inverse_mass)
        self._worlds: dict[str, wp.array] = {}  # of the elements of arrays
        for name, world in (("particle", model.particle_world), ("body", model.body_world)):
            if world is not None:
                self._worlds[name] = world
        if model.joint_count:
            world = host_array(model.joint_world)
            for name in ("joint_q", "joint_qd"):
                counts = np.diff(host_array(getattr(model, f"{name}_start")))
                self._worlds[name] = wp.array(np.repeat(world, counts), dtype=int, device=device)
        self._saved = {name: wp.empty_like(array) for name, array, _world in self._arrays(model)}
        poses = body_q_prev(solver)
        self._last_poses = None if poses is None else wp.empty_like(poses)

    def _arrays(self, state):
        """Yields the arrays of a state that belong to worlds, with the world of each of their elements."""
        for name in ("particle_q", "particle_qd", "body_q", "body_qd", "joint_q", "joint_qd"):
            array, world = getattr(state, name, None), self._worlds.get(name, self._worlds.get(name.split("_")[0]))
            if array is not None and len(array) and world is not None:
                yield name, array, world

    def begin(self, state: newton.State) -> None:
        """Copies the state at the start of a step, before the inner solver changes it."""
        for name, array, _world in self._arrays(state):
            wp.copy(self._saved[name], array, count=len(self._saved[name]))
        if self._last_poses is not None:
            wp.copy(self._last_poses, body_q_prev(self._solver))
        self._last.save()

    def restore(self, mask: wp.array[wp.bool], state: newton.State) -> None:
        """Puts back the state at the start, in worlds that take no part."""
        for name, array, world in self._arrays(state):
            restore_worlds(self._saved[name], world, mask, array)
        if self._last_poses is not None:
            poses, world = body_q_prev(self._solver), self._worlds["body"]
            inputs = [self._last_poses, self._saved["body_q"], world, mask, self._motion.vertices]
            self._work.launch(_restore_last_poses, len(world), inputs, [poses])

    @contextlib.contextmanager
    def applied(self, mask: wp.array[wp.bool]) -> Iterator[None]:
        """Lets the stage look at the worlds alone that take part; the predicted motion is complete before."""
        work, motion, held = self._work, self._motion, self._held
        vertices, planes = motion.vertices, motion.planes
        masses, body_masses = vertices.inverse_mass, vertices.bodies.inverse_mass
        size = max(len(vertices.x0), len(planes.start), motion.mesh.model.body_count)
        outputs = [vertices, planes.start, planes.end, held]
        work.launch(_hold, size, [mask, masses, planes.world, work.can_move], outputs)
        vertices.inverse_mass = held.inverse_mass
        if motion.moves_bodies:
            vertices.bodies.inverse_mass = held.body_inverse_mass
        work.motion, work.active, work.unmasked = motion, held.active, (masses, body_masses)
        try:
            yield
        finally:
            vertices.inverse_mass, vertices.bodies.inverse_mass = masses, body_masses
            work.motion, work.active, work.unmasked = motion, work.can_move, None

    def end(self, mask: wp.array[wp.bool]) -> None:
        """Puts back where the last step ended, in worlds that take no part."""
        self._last.restore(mask)


def checked_mask(world_mask, model: newton.Model) -> wp.array | None:
    """Returns the argument ``world_mask`` of a step.

    Raises:
        TypeError: If it is no Warp array of bool.
        ValueError: If it has another shape, or is on another device.
    """
    if world_mask is None:
        return None
    if not isinstance(world_mask, wp.array):
        raise TypeError(f"world_mask must be a Warp array of bool, not {given(world_mask)}")
    if world_mask.dtype is not wp.bool:
        raise TypeError(f"world_mask must be a Warp array of bool, not of {world_mask.dtype.__name__}")
    shape = (max(1, model.world_count) + 1,)
    if world_mask.shape != shape:
        raise ValueError(f"world_mask must have shape {shape}, not {world_mask.shape}")
    if world_mask.device != model.device:
        raise ValueError(f"world_mask must be on device {model.device}, not {world_mask.device}")
    return world_mask
