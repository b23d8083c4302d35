"""Steps of the solver with contact inside in float64, solved until nothing is left: what gradients are judged by.

:class:`ReferenceSteps` takes the place of what records the steps of a :class:`warp_bsc.SolverImplicit` on a tape. Each
step goes on from where the solver ended it, by Newton's method on the same equations with the exact matrix, until the
forces that remain are rounding. Its positions and velocities stay in float64 from step to step, beside those of the
solver, as do poses and velocities of free bodies. The tape then has the adjoint of these steps, as it would have that
of the solver's, and where they end is smooth enough in all inputs for differences of 1e-6 of these.

What barriers depend on and the adjoint holds constant is held constant in a run that is given what another one held:
the loads by which what presses hard has stiffer barriers, and the stiffness of solids, which the solver reads from
their materials before steps.
"""

from typing import NamedTuple

import numpy as np
import warp as wp
from gradient_bodies import ReferenceBodies
from step_forces import forces_of

from warp_bsc.implicit.contact.system import AT_PLANE
from warp_bsc.implicit.gradients.contact_forces import RecordedContacts
from warp_bsc.implicit.gradients.linear import LinearSolver
from warp_bsc.kernels.polynomials import EDGE_EDGE, VERTEX_FACE

KINDS = {"vertex-face": int(VERTEX_FACE), "edge-edge": int(EDGE_EDGE), "plane": int(AT_PLANE)}
"""Kinds of contacts by name; beside them, those between two free bodies are counted."""
BETWEEN_BODIES = "body-body"

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
        bodies: The bodies that the solver moves, with their poses and velocities, None if it moves none.
        held: What the adjoint of each step so far holds constant.
        contacts: Number of contacts that push at the end of each of them, by kind.
        residual: Largest force that remained in them, as a share of the weight of the lightest particle.
        unsolved: Worlds in which the forces of a step did not balance.
    """

    def __init__(self, solver):
        """Takes the place of what records the steps of a solver; :meth:`begin` begins a run."""
        self._solver, self._gradients = solver, solver.gradients
        self._record, solver.gradients.record = solver.gradients.record, self.record
        gradients = self._gradients
        self._linear = LinearSolver(gradients.newton.problem.unknowns.of_worlds, tolerance=1e-9, max_iterations=4000)
        self.bodies = None if gradients.equations.of_bodies is None else ReferenceBodies(solver)

    def begin(self, held, x, v, *bodies):
        """Begins a run with what another one held constant, or None, and where particles are, in float64.

        ``bodies`` are poses and velocities, if the solver moves any.
        """
        if self.bodies is not None:
            self.bodies.begin(*bodies)
        self.x, self.v, self._given = np.array(x, dtype=float), np.array(v, dtype=float), held
        self.held, self.contacts, self.residual = [], [], 0.0
        self.unsolved = np.zeros(len(self._gradients.newton.problem.unknowns.of_worlds) - 1, dtype=bool)

    def ends(self):
        """Returns where the last step ended, by the names of arrays of a state."""
        found = {"particle_q": self.x, "particle_qd": self.v}
        if self.bodies is not None:
            found |= {"body_q": self.bodies.poses, "body_qd": self.bodies.velocities}
        return found

    def end(self):
        """Lets the solver record its own steps again."""
        self._solver.gradients.record = self._record

    def record(self, place, dt, start, end):
        """Returns the step that was taken last, as ``StepGradients.record`` does, after solving it in float64."""
        recorded = self._record(place, dt, start, end)
        step, n = recorded.step, len(self.x)
        free = self._solver.mesh.inverse_masses.numpy()[:n] > 0.0
        x0, x1 = step.x0.numpy().copy(), step.x1.numpy().copy()
        x0[:n][free] = self.x[free]
        v0 = np.where(free[:, None], self.v, step.v0.numpy())
        ends = self._place_bodies(step, x0, x1)
        step.v0.assign(v0)
        self._hold(step)
        step = recorded.step = self._with_candidates(step, free)
        x1 = self._solve(step, x1, ends)
        self.contacts.append(self._count(step))
        recorded.failed.zero_()
        self.x, self.v = x1[:n], np.where(free[:, None], (x1[:n] - x0[:n]) / dt, v0)
        return recorded

    def _place_bodies(self, step, x0, x1):
        """Places what moves with bodies in float64, and writes the positions at both ends of a step.

        Returns:
            Poses at the end, None without bodies.
        """
        ends = None
        if step.poses[0] is not None:
            planes = self._solver.mesh.device_planes
            ends, starts = (pose.numpy().astype(float) for pose in step.poses)
            if self.bodies is not None:
                starts = self.bodies.predict(step)
            self._place_held(ends, x1)
            for x, poses in ((x1, ends), (x0, starts)):
                self._place_shapes(poses, x)
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
        return ends

    def _place_shapes(self, poses, x):
        """Places vertices of shapes of bodies."""
        shapes = self._solver.mesh.device_shape_vertices
        body = shapes.body.numpy()
        moves = body >= 0
        x[len(self.x) :][moves] = _placed(poses[body[moves]], shapes.position.numpy()[moves])

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
        of_vertex = newton.problem.unknowns.of_vertex.numpy()
        moves = of_vertex < -1
        moves[: len(free)] = free
        planes = np.arange(len(step.planes.friction))
        at = np.stack(np.meshgrid(np.flatnonzero(moves), planes, indexing="ij"), -1).reshape(-1, 2)
        of_world, of_plane = newton.mesh.device_world.numpy()[at[:, 0]], step.planes.world.numpy()[at[:, 1]]
        at = at[(of_plane < 0) | (of_plane == of_world)]
        vertices = np.concatenate([vertices, np.repeat(at[:, :1], 4, axis=1).astype(np.int32)])
        kind = np.concatenate([kind, np.full(len(at), int(AT_PLANE), dtype=np.int32)])
        plane = np.concatenate([np.zeros(len(index), dtype=np.int32), at[:, 1].astype(np.int32)])
        of_vertex = of_vertex[vertices]
        rows = np.where(of_vertex < -1, -2 - of_vertex, of_vertex)  # those of bodies have the first of two
        if self.bodies is not None:
            rows = np.hstack([rows, np.where(of_vertex < -1, rows + 1, -1)])
        rows = rows.astype(np.int32)
        contacts = RecordedContacts()
        contacts.kind, contacts.plane = wp.array(kind, device=device), wp.array(plane, device=device)
        contacts.fall = step.contacts.fall
        return step._replace(
            vertices=wp.array(vertices, device=device), rows=wp.array(rows, device=device), contacts=contacts
        )

    def _count(self, step):
        """Returns how many contacts of a step push, by kind."""
        if not len(step.vertices):
            return {}
        pushes = self._gradients.equations._in_contact.forces.numpy()[: len(step.vertices), 0].any(axis=(1, 2))
        kind, is_pair = step.contacts.kind.numpy(), (step.vertices.numpy() >= len(self.x)).all(axis=1)
        found = {name: int((pushes & (kind == k)).sum()) for name, k in KINDS.items()}
        return found | {BETWEEN_BODIES: int((pushes & is_pair & (kind != AT_PLANE)).sum())}

    def _moved(self, x1, poses, changes):
        """Returns positions of vertices and poses after changes of unknowns."""
        x1 = x1.copy()
        x1[: len(self.x)] += changes[self._gradients.equations.unknown.numpy()]
        if self.bodies is not None:
            poses = self.bodies.moved(poses, changes)
            self._place_shapes(poses, x1)
        return x1, poses

    def _solve(self, step, x1, poses):
        """Returns where the vertices of a step end, which it is written to as well.

        Worlds in which the forces do not balance are noted.
        """
        equations, n = self._gradients.equations, len(self.x)
        world, count = equations.world.numpy(), len(self.unsolved)
        weight = 9.81 / self._solver.mesh.inverse_masses.numpy()[:n].max()

        def residuals(positions, poses):
            step.x1.assign(positions)
            if self.bodies is not None:
                step.poses[0].assign(poses.astype(np.float32))
            equations.load(step)
            forces, found = forces_of(equations), np.zeros(count)
            if self.bodies is not None:
                self.bodies.correct(step, poses, forces)
            np.maximum.at(found, world, np.abs(forces).max(axis=1))
            return found, wp.array(forces, dtype=wp.vec3d, device=equations.device)

        (size, forces), done = residuals(x1, poses), np.zeros(count, dtype=bool)
        for _k in range(_NEWTON_STEPS):
            change = self._linear.solve(equations.differentiate(transposed=False), forces).numpy().copy()
            failed, largest = np.zeros(count, dtype=bool), np.zeros(count)
            np.logical_or.at(failed, world, ~np.isfinite(change).all(axis=1))
            change[(failed | done)[world]] = 0.0
            np.maximum.at(largest, world, np.abs(change).max(axis=1))
            taken = failed | done
            for share in _SHARES:
                of_rest = np.where(taken[world][:, None], 0.0, share * change)
                found, forces = residuals(*self._moved(x1, poses, of_rest))
                takes = ~taken & ((found < size) | (share * largest < _LEAST_CHANGE))
                x1, poses = self._moved(x1, poses, np.where(takes[world][:, None], of_rest, 0.0))
                size[takes], taken = found[takes], taken | takes
                if taken.all():
                    break
            else:
                forces = residuals(x1, poses)[1]
            self.unsolved |= failed | ~taken
            done |= failed | ~taken | ((largest < 1e3 * _LEAST_CHANGE) & (size < 1e-9 * weight))
            if done.all():
                break
        self.unsolved |= ~done
        self.residual = max(self.residual, (size[~self.unsolved] / weight).max(initial=0.0))
        if self.bodies is not None:
            self.bodies.finish(poses, step.dt)
        return x1


def _placed(poses, points):
    """Returns points of bodies in float64, given their poses."""
    rotation = poses[:, 3:] / np.linalg.norm(poses[:, 3:], axis=1, keepdims=True)
    axis, w = rotation[:, :3], rotation[:, 3:]
    turned = (2.0 * w * w - 1.0) * points + 2.0 * w * np.cross(axis, points)
    return poses[:, :3] + turned + 2.0 * (axis * points).sum(axis=1, keepdims=True) * axis
