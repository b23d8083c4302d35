"""Free bodies of steps that are solved in float64: their inertia, the forces on them, and how they move."""

import numpy as np
from scipy.spatial.transform import Rotation


class ReferenceBodies:
    """The bodies that a solver moves, in float64; Warp has poses in float32 only.

    Attributes:
        poses, velocities: Of all bodies, shape [body_count, 7] and [body_count, 6].
    """

    def __init__(self, solver):
        """Takes the bodies of a solver that have unknowns."""
        self._model, self._equations = solver.model, solver.gradients.equations
        unknown = self._equations.of_bodies.numpy()
        self._bodies = np.flatnonzero(unknown >= 0)
        self._unknown = unknown[self._bodies]

    def begin(self, poses, velocities):
        """Begins a run with poses and velocities."""
        self.poses, self.velocities = np.array(poses, dtype=float), np.array(velocities, dtype=float)

    def predict(self, step):
        """Computes where inertia leads bodies in a step, which is written to it as well; returns poses at its start."""
        dt, i = step.dt, self._bodies
        names = "inertia", "inv_inertia", "inv_mass"
        inertia, inverse, self._inv_mass = (
            getattr(self._model, f"body_{name}").numpy()[i].astype(float) for name in names
        )
        gravity = self._model.gravity.numpy()[self._model.body_world.numpy()[i].clip(0) % len(self._model.gravity)]
        force, velocity = step.bodies.force.numpy()[i].astype(float), self.velocities[i]
        centre, rotation = self._split(self.poses)
        linear = velocity[:, :3] + dt * (gravity + self._inv_mass[:, None] * force[:, :3])
        spin = velocity[:, 3:]
        momentum = _times(_in_world(inertia, rotation), spin) + dt * force[:, 3:]
        for share in (0.5, 0.5, 0.5, 0.5, 1.0):
            turned = Rotation.from_rotvec(share * dt * spin) * rotation
            spin = _times(_in_world(inverse, turned), momentum)
        self._goal, self._goal_velocity = (centre + dt * linear, turned), np.hstack([linear, spin])
        self._inertia = _in_world(inertia, turned)
        goals, velocities = self.poses.copy(), self.velocities.copy()
        goals[i], velocities[i] = self._joined(*self._goal), self._goal_velocity
        arrays = step.bodies.goals, step.bodies.goal_velocities, step.bodies.velocities, step.poses[1]
        for array, values in zip(arrays, (goals, velocities, self.velocities, self.poses), strict=True):
            array.assign(values.astype(np.float32))
        return self.poses

    def correct(self, step, poses, forces):
        """Replaces the inertia in forces on unknowns, and the centres to which moments belong, by those in float64."""
        u, (centre, _) = self._unknown, self._split(poses)
        of_warp = self._equations._inertia_of_bodies.forces.numpy().reshape(-1, 2, 3)
        of_contacts = forces[u] - of_warp[:, 0]
        off, turned = self._off_goal(poses)
        forces[u] = of_contacts - off / (self._inv_mass[:, None] * step.dt**2)
        forces[u + 1] -= of_warp[:, 1] + _gradient_of_turn(self._inertia, turned) / step.dt**2
        forces[u + 1] += np.cross(self._split(poses.astype(np.float32))[0] - centre, of_contacts)

    def moved(self, poses, changes):
        """Returns poses after changes of unknowns."""
        (centre, rotation), u, poses = self._split(poses), self._unknown, poses.copy()
        poses[self._bodies] = self._joined(centre + changes[u], Rotation.from_rotvec(changes[u + 1]) * rotation)
        return poses

    def finish(self, poses, dt):
        """Takes the poses at the end of a step."""
        self.poses = poses
        self.velocities[self._bodies] = self._goal_velocity + np.hstack(self._off_goal(poses)) / dt

    def _split(self, poses):
        """Returns centres of mass and rotations."""
        of_bodies = poses[self._bodies].astype(float)
        rotation = Rotation.from_quat(of_bodies[:, 3:])
        return of_bodies[:, :3] + rotation.apply(self._model.body_com.numpy()[self._bodies]), rotation

    def _joined(self, centre, rotation):
        """Returns poses, given centres of mass and rotations."""
        return np.hstack([centre - rotation.apply(self._model.body_com.numpy()[self._bodies]), rotation.as_quat()])

    def _off_goal(self, poses):
        (centre, rotation), (goal, turned) = self._split(poses), self._goal
        return centre - goal, (rotation * turned.inv()).as_rotvec()


def _times(matrices, vectors):
    return (matrices @ vectors[..., None])[..., 0]


def _in_world(matrices, rotation):
    axes = rotation.as_matrix()
    return axes @ matrices @ axes.swapaxes(1, 2)


def _gradient_of_turn(inertia, turned):
    """Returns the gradients of halves of ``turned . inertia turned`` by turns after those of rotation vectors."""
    gradient, angle = _times(inertia, turned), np.linalg.norm(turned, axis=1, keepdims=True)
    is_small, angle = angle < 1e-3, np.maximum(angle, 1e-3)
    factor = np.where(is_small, 1.0 / 12.0, 1.0 / angle**2 - 0.5 / (angle * np.tan(0.5 * angle)))
    once = np.cross(turned, gradient)
    return gradient + 0.5 * once + factor * np.cross(turned, once)
