"""Where the last step ended: the one keeper of what the next step begins with, beside its state."""

from typing import Any

import newton
import numpy as np
import warp as wp

from .mesh import ModelMesh

wp.set_module_options({"enable_backward": False})

SAME_POSE = wp.constant(1e-5)
"""Largest difference of two poses of a body that are the same but for rounding [m], and of their quaternions."""


@wp.kernel
def _interrupt(world_mask: wp.array[wp.bool], interrupted: wp.array[int]):
    """Marks worlds as interrupted, and as the last entry everything that is in all worlds, if any world is."""
    i = wp.tid()
    last = world_mask.shape[0] - 1
    if world_mask[wp.min(i, last)] or world_mask[last]:
        interrupted[i] = 1
        interrupted[interrupted.shape[0] - 1] = 1


def interrupt_worlds(interrupted: wp.array[int], world_mask: wp.array[wp.bool] | None) -> None:
    """Marks worlds as interrupted, with a mask as of :meth:`LastStep.interrupt`."""
    if world_mask is None:
        interrupted.fill_(1)
    else:
        wp.launch(_interrupt, len(interrupted), inputs=[world_mask, interrupted], device=interrupted.device)


def _find_misplaced_bodies(model: newton.Model) -> np.ndarray:
    """Returns the bodies that joint coordinates of a model put elsewhere than ``body_q``, which a model may not set."""
    if model.joint_type is None or (model.joint_type.numpy() == newton.JointType.FREE).all():
        return np.empty(0, dtype=int)
    state = model.state()
    assert model.joint_q is not None and model.joint_qd is not None and model.body_q is not None
    assert state.body_q is not None
    newton.eval_fk(model, model.joint_q, model.joint_qd, state)
    placed, given = state.body_q.numpy(), model.body_q.numpy().copy()  # of the CPU, it is the model's own memory
    given[(placed[:, 3:] * given[:, 3:]).sum(axis=1) < 0.0, 3:] *= -1.0  # the same rotation
    return np.flatnonzero(np.abs(placed - given).max(axis=1) > SAME_POSE)


class LastStep:
    """Where the last step ended, and which worlds do not go on from there.

    Attributes:
        positions: Positions of the vertices at its end [m], until the response begins to move those of the next step.
        planes, poses: Infinite planes, and poses of the bodies, at its end, until the next step ends.
        interrupted: By world, then of any: 1 where the next step begins where its state is, until that step ends.
        starts: The positions, after :meth:`begin`; None if steps begin where their state is.
        arrays: All of them: to restore them lets a program repeat a step.
        worlds: The worlds of the elements of each, -1 for all worlds.
    """

    def __init__(self, mesh: ModelMesh):
        """Allocates the arrays, which a motion and the response write."""
        device, model, planes, worlds = mesh.device, mesh.model, mesh.device_planes, max(1, mesh.model.world_count)
        self._mesh, self.starts = mesh, None
        self.positions = wp.zeros(mesh.vertex_count, dtype=wp.vec3, device=device)
        self.planes = wp.zeros(len(planes.world), dtype=wp.vec4d, device=device)
        self.poses = wp.zeros(model.body_count, dtype=wp.transform, device=device)
        self.interrupted = wp.zeros(worlds + 1, dtype=int, device=device)
        self.arrays: list[wp.array] = [self.positions, self.planes, self.poses, self.interrupted]
        each = wp.array([*range(worlds), -1], dtype=int, device=device)
        self.worlds: list[Any] = [mesh.device_world, planes.world, model.body_world, each]

    def begin(self) -> None:
        """Makes what the response cannot move start each step where it ended the last one.

        Worlds in which a movable particle is elsewhere than at that end were set to another state, and start there. The
        first step starts where the model puts vertices, planes and bodies. Those of bodies that joint coordinates of
        the model put elsewhere start where the state of the step has them, since a program that evaluates the joints
        does not move them.
        """
        mesh, model = self._mesh, self._mesh.model
        self.starts, misplaced = self.positions, _find_misplaced_bodies(model)
        poses, planes = self.poses.numpy().copy(), self.planes.numpy().copy()
        poses[misplaced], planes[np.isin(mesh.planes.body, misplaced)] = np.nan, np.nan
        self.poses.assign(poses)
        self.planes.assign(planes)
        mesh.positions(model.particle_q, self.poses, self.positions)

    def end(self, body_q: wp.array[wp.transform] | None, planes: wp.array[wp.vec4d]) -> None:
        """Copies poses and planes at the end of a step, whose response has written the positions."""
        if body_q is not None:
            wp.copy(self.poses, body_q)
        wp.copy(self.planes, planes)
        self.interrupted.zero_()

    def interrupt(self, world_mask: wp.array[wp.bool] | None = None) -> None:
        """Makes the next step begin where its state is, in the worlds of a mask, or everywhere.

        Its last entry says whether also everything that is in all worlds does, shape [world_count + 1].
        """
        interrupt_worlds(self.interrupted, world_mask)
