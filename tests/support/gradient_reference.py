"""Steps of the solver with contact inside in float64, solved until nothing is left: what gradients are judged by.

:class:`ReferenceSteps` takes the place of what records the steps of a :class:`warp_bsc.SolverImplicit` on a tape. Each
step goes on from where the solver ended it, by Newton's method on the same equations with the exact matrix, until the
forces that remain are rounding. Its positions and velocities stay in float64 from step to step, beside those of the
solver. The tape then has the adjoint of these steps, as it would have that of the solver's, and the positions at the
end are smooth enough in all inputs for differences of 1e-5 of these.

What barriers depend on and the adjoint holds constant is held constant in a run that is given what another one held:
the loads by which what presses hard has stiffer barriers, and the stiffness of solids, which the solver reads from
their materials before steps.
"""

from typing import NamedTuple

import numpy as np
import warp as wp
from step_forces import forces_of

from warp_bsc.implicit.contact.system import AT_PLANE
from warp_bsc.implicit.gradients.contact_forces import RecordedContacts
from warp_bsc.implicit.gradients.linear import LinearSolver

_NEWTON_STEPS = 40
_SHARES = 0.5 ** np.arange(12)
_LEAST_CHANGE = 1e-13
"""Change of positions at which a step ends [m]."""


class Held(NamedTuple):
    """What the adjoint of a step holds constant."""

    load: np.ndarray
    elasticity: np.ndarray


class ReferenceSteps:
    """Solves the steps that a solver records in float64.

    Attributes:
        x, v: Positions and velocities of particles, float64, shape [particle_count, 3].
        held: What the adjoint of each step so far holds constant.
        contacts: Number of contacts at the end of each of them.
        residual: Largest force that remained in them, as a share of the weight of the lightest particle.
        unsolved: Worlds in which the forces of a step did not balance.
    """

    def __init__(self, solver):
        """Takes the place of what records the steps of a solver; :meth:`begin` begins a run."""
        self._solver, self._gradients = solver, solver.gradients
        self._record, solver.gradients.record = solver.gradients.record, self.record
        gradients = self._gradients
        self._linear = LinearSolver(gradients.newton.problem.unknowns.of_worlds, tolerance=1e-9, max_iterations=4000)

    def begin(self, x, v, held=None):
        """Begins a run where particles are, in float64, with what another run held constant."""
        self.x, self.v, self._given = np.array(x, dtype=float), np.array(v, dtype=float), held
        self.held, self.contacts, self.residual = [], [], 0.0
        self.unsolved = np.zeros(len(self._gradients.newton.problem.unknowns.of_worlds) - 1, dtype=bool)

    def end(self):
        """Lets the solver record its own steps again."""
        self._solver.gradients.record = self._record

    def record(self, place, dt, start, end):
        """Returns the step that was taken last, as ``StepGradients.record`` does, after solving it in float64."""
        recorded = self._record(place, dt, start, end)
        self.contacts.append(int((recorded.step.contacts.kind.numpy() >= 0).sum()))
        step, n = recorded.step, len(self.x)
        free = self._solver.mesh.inverse_masses.numpy()[:n] > 0.0
        x0, x1 = step.x0.numpy().copy(), step.x1.numpy().copy()
        x0[:n][free] = self.x[free]
        v0 = np.where(free[:, None], self.v, step.v0.numpy())
        self._place_bodies(step, x0, x1)
        step.v0.assign(v0)
        self._hold(step)
        step = recorded.step = self._with_candidates(step, free)
        x1 = self._solve(step, x1)
        recorded.failed.zero_()
        self.x, self.v = x1[:n], np.where(free[:, None], (x1[:n] - x0[:n]) / dt, v0)
        return recorded

    def _place_bodies(self, step, x0, x1):
        """Places what moves with bodies in float64, and writes the positions at both ends of a step."""
        if step.poses[0] is not None:
            mesh, n = self._solver.mesh, len(self.x)
            ends, starts = (pose.numpy().astype(float) for pose in step.poses)
            self._place_held(ends, x1)
            shapes, planes = mesh.device_shape_vertices, mesh.device_planes
            body = shapes.body.numpy()
            moves = body >= 0
            for x, poses in ((x1, ends), (x0, starts)):
                x[n:][moves] = _placed(poses[body[moves]], shapes.position.numpy()[moves])
            body = planes.body.numpy()
            moves = body >= 0
            for array, poses in ((step.planes.end, ends), (step.planes.start, starts)):
                values, at = array.numpy().copy(), poses[body[moves]]
                normal = _placed(at, planes.normal.numpy()[moves]) - at[:, :3]
                normal /= np.linalg.norm(normal, axis=1, keepdims=True)
                offset = (normal * _placed(at, planes.point.numpy()[moves])).sum(axis=1, keepdims=True)
                values[moves] = np.concatenate([normal, offset], axis=1)
                array.assign(values)
        step.x0.assign(x0)
        step.x1.assign(x1)

    def _place_held(self, poses, x1):
        """Places particles that attachments hold."""
        attached = self._gradients.equations.attachments
        if attached is not None:
            held = np.isinf(attached.stiffness.numpy()) & attached.enabled.numpy()
            body, point = attached.body.numpy()[held], attached.body_point.numpy()[held]
            x1[attached.particle.numpy()[held]] = _placed(poses[body], point)

    def _hold(self, step):
        """Lets a step hold what that of another run held, and keeps it."""
        held = Held(step.settings.load, step.settings.elasticity)
        if self._given is not None:
            for array, values in zip(held, self._given[len(self.held)], strict=True):
                array.assign(values)
        self.held.append(Held(*(array.numpy().copy() for array in held)))

    def _with_candidates(self, step, free):
        """Returns a step whose contacts are all pairs that may come near each other, and all particles at all planes.

        Those beyond their reach have no force, so that forces are smooth in positions.
        """
        newton = self._gradients.newton
        found, device = newton.problem.candidates, step.x0.device
        corners, keys, parts = found.corners.numpy(), found.key.numpy(), []
        start, room, near, far = (getattr(found, name).numpy() for name in ("start", "room", "near", "far"))
        for w in range(len(start)):
            last = start[w] + room[w]
            parts += [np.arange(start[w], start[w] + near[w]), np.arange(last - far[w], last)]
        index = np.concatenate(parts)
        vertices, kind = corners[index].astype(np.int32), (keys[index] >> 56).astype(np.int32)
        particles, planes = np.flatnonzero(free), np.arange(len(step.planes.friction))
        at = np.stack(np.meshgrid(particles, planes, indexing="ij"), -1).reshape(-1, 2)
        of_world, of_plane = newton.mesh.device_world.numpy()[at[:, 0]], step.planes.world.numpy()[at[:, 1]]
        at = at[(of_plane < 0) | (of_plane == of_world)]
        vertices = np.concatenate([vertices, np.repeat(at[:, :1], 4, axis=1).astype(np.int32)])
        kind = np.concatenate([kind, np.full(len(at), int(AT_PLANE), dtype=np.int32)])
        plane = np.concatenate([np.zeros(len(index), dtype=np.int32), at[:, 1].astype(np.int32)])
        rows = np.maximum(newton.problem.unknowns.of_vertex.numpy()[vertices], -1).astype(np.int32)
        contacts = RecordedContacts()
        contacts.kind, contacts.plane = wp.array(kind, device=device), wp.array(plane, device=device)
        contacts.fall = step.contacts.fall
        return step._replace(
            vertices=wp.array(vertices, device=device), rows=wp.array(rows, device=device), contacts=contacts
        )

    def _solve(self, step, x1):
        """Returns where the vertices of a step end, which it is written to as well.

        Worlds in which the forces do not balance are noted.
        """
        equations, n = self._gradients.equations, len(self.x)
        unknown, of_unknowns, count = equations.unknown.numpy(), equations.world.numpy(), len(self.unsolved)
        world, weight = of_unknowns[unknown], 9.81 / self._solver.mesh.inverse_masses.numpy()[:n].max()

        def residuals(positions):
            step.x1.assign(positions)
            equations.load(step)
            found = np.zeros(count)
            forces = forces_of(equations)
            np.maximum.at(found, of_unknowns, np.abs(forces).max(axis=1))
            return found, wp.array(forces, dtype=wp.vec3d, device=equations.device)

        (size, forces), done = residuals(x1), np.zeros(count, dtype=bool)
        for _k in range(_NEWTON_STEPS):
            change = self._linear.solve(equations.differentiate(transposed=False), forces).numpy()[unknown]
            failed, largest = np.zeros(count, dtype=bool), np.zeros(count)
            np.logical_or.at(failed, world, ~np.isfinite(change).all(axis=1))
            change[(failed | done)[world]] = 0.0
            np.maximum.at(largest, world, np.abs(change).max(axis=1))
            taken = failed | done
            for share in _SHARES:
                tried, goes = x1.copy(), ~taken[world]
                tried[:n][goes] += share * change[goes]
                found = residuals(tried)[0]
                takes = ~taken & ((found < size) | (share * largest < _LEAST_CHANGE))
                x1[:n][takes[world]] = tried[:n][takes[world]]
                size[takes], taken = found[takes], taken | takes
                if taken.all():
                    break
            self.unsolved |= failed | ~taken
            done |= failed | ~taken | ((largest < 1e3 * _LEAST_CHANGE) & (size < 1e-9 * weight))
            forces = residuals(x1)[1]
            if done.all():
                break
        self.unsolved |= ~done
        self.residual = max(self.residual, (size[~self.unsolved] / weight).max(initial=0.0))
        return x1


def _placed(poses, points):
    """Returns points of bodies in float64, given their poses."""
    rotation = poses[:, 3:] / np.linalg.norm(poses[:, 3:], axis=1, keepdims=True)
    axis, w = rotation[:, :3], rotation[:, 3:]
    turned = (2.0 * w * w - 1.0) * points + 2.0 * w * np.cross(axis, points)
    return poses[:, :3] + turned + 2.0 * (axis * points).sum(axis=1, keepdims=True) * axis
