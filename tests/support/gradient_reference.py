"""Steps of the solver with contact inside in float64, solved until nothing is left: what gradients are judged by.

Each step begins where :class:`warp_bsc.SolverImplicit` ends it, and goes on by Newton's method on the same equations,
with the exact matrix, until the forces that remain are rounding. Positions and velocities stay in float64 from step to
step. Where elements press harder than masses tell, barriers are stiffer: those forces are lagged in the solver, and
are here those of the first run.
"""

import numpy as np
import warp as wp

from warp_bsc.implicit.contact.system import AT_PLANE
from warp_bsc.implicit.gradients.contact_forces import RecordedContacts
from warp_bsc.implicit.gradients.linear import LinearSolver
from warp_bsc.implicit.gradients.step_gradients import StartArrays, StateGradients

_NEWTON_STEPS = 40
_SHARES = 0.5 ** np.arange(12)
_LEAST_CHANGE = 1e-13
"""Change of positions at which a step ends [m]."""


class ReferenceSteps:
    """Steps a state in float64.

    Attributes:
        x, v: Positions and velocities of particles, float64, shape [particle_count, 3].
        recorded: The steps so far.
        residual: Largest force that remained in them, as a share of the weight of the lightest particle, by world.
        unsolved: Worlds in which the forces of a step did not balance.
    """

    def __init__(self, solver, dt, loads=None):
        """Begins a run; ``loads`` are those of another run, which this one takes."""
        self._solver, self._dt, self._given_loads = solver, dt, loads
        gradients = self._gradients = solver.gradients
        equations = gradients.equations
        self._linear = LinearSolver(
            gradients.newton.problem.unknowns.of_worlds, equations.world, tolerance=1e-9, max_iterations=4000
        )
        worlds = len(gradients.newton.problem.unknowns.of_worlds) - 1
        self.recorded, self.loads = [], []
        self.residual, self.unsolved = np.zeros(worlds), np.zeros(worlds, dtype=bool)

    def begin(self, state):
        """Starts in a state of Newton."""
        self._solver.reset(state)
        self._states = [state, self._solver.model.state()]
        self.x, self.v = state.particle_q.numpy().astype(float), state.particle_qd.numpy().astype(float)
        self.recorded, self.loads, self._tape = [], [], wp.Tape()

    def step(self, control=None):
        """Takes a step; ``control`` may change the state before it."""
        first, second = self._states
        if control is not None:
            control(first, len(self.recorded))
        solver, dt = self._solver, self._dt
        free = self._free()
        # what a program has written stands; all else is as exact as it can be
        given = first.particle_q.numpy().astype(float)
        self.x = np.where(free[:, None], self.x, given)
        solver.step(first, second, None, None, dt)
        gradients = self._gradients
        recorded = gradients.record(self._tape, dt, StartArrays.of(first), second)
        step = recorded.step
        n = len(self.x)
        x0 = step.x0.numpy()
        x0[:n][free] = self.x[free]
        v0 = self.v.copy()
        step.x0.assign(x0)
        step.v0.assign(v0)
        load = self._given_loads[len(self.recorded)] if self._given_loads else step.settings.load.numpy()
        step.settings.load.assign(load)
        self.loads.append(load)
        step = self._with_candidates(step)
        x1 = self._solve(step)
        recorded.step = step
        recorded.failed.zero_()
        self.recorded.append(recorded)
        new = x1[:n]
        self.v = np.where(free[:, None], (new - self.x) / dt, self.v)
        self.x = np.where(free[:, None], new, second.particle_q.numpy().astype(float))
        second.particle_q.assign(self.x.astype(np.float32))
        second.particle_qd.assign(self.v.astype(np.float32))
        self._states = [second, first]

    def _free(self):
        return self._solver.mesh.inverse_masses.numpy()[: len(self.x)] > 0

    def _with_candidates(self, step):
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
        particles, planes = np.flatnonzero(self._free()), np.arange(len(step.planes.friction))
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

    def _solve(self, step):
        """Returns positions of vertices where the forces of a step balance; worlds in which they do not are noted."""
        equations, newton = self._gradients.equations, self._gradients.newton
        n, unknown, world = len(self.x), equations.unknown.numpy(), newton.mesh.device_world.numpy()[: len(self.x)]
        weight = 9.81 / self._solver.mesh.inverse_masses.numpy()[:n][self._free()].max()
        of_unknowns, count = equations.world.numpy(), len(self.unsolved)

        def residuals(positions):
            step.x1.assign(positions)
            equations.load(step)
            found = np.zeros(count)
            np.maximum.at(found, of_unknowns, np.abs(equations.evaluate().numpy()).max(axis=1))
            return found

        x1 = step.x1.numpy()
        size, done = residuals(x1), np.zeros(count, dtype=bool)
        for _k in range(_NEWTON_STEPS):
            change = self._linear.solve(equations.differentiate(transposed=False), equations.forces).numpy()[unknown]
            failed = np.zeros(count, dtype=bool)
            np.logical_or.at(failed, world, ~np.isfinite(change).all(axis=1))
            change[failed[world] | done[world]] = 0.0
            largest = np.zeros(count)
            np.maximum.at(largest, world, np.abs(change).max(axis=1))
            taken = failed | done
            for share in _SHARES:
                tried = x1.copy()
                tried[:n][~taken[world]] += share * change[~taken[world]]
                found = residuals(tried)
                takes = ~taken & ((found < size) | (share * largest < _LEAST_CHANGE))
                x1[:n][takes[world]] = tried[:n][takes[world]]
                size[takes], taken = found[takes], taken | takes
                if taken.all():
                    break
            self.unsolved |= failed | ~taken
            done |= failed | ~taken | ((largest < 1e3 * _LEAST_CHANGE) & (size < 1e-9 * weight))
            residuals(x1)
            if done.all():
                break
        self.unsolved |= ~done
        self.residual = np.maximum(self.residual, size / weight)
        return x1

    def backward(self, of_x, of_v=None):
        """Returns the gradients with respect to positions and velocities at the start, given those at the end."""
        gradients, n, device = self._gradients, len(self.x), self._solver.model.device

        def array(values=None):
            zeros = wp.zeros(n, dtype=wp.vec3, device=device)
            if values is not None:
                zeros.assign(np.asarray(values, dtype=np.float32))
            return zeros

        end = array(of_x), array(of_v)
        for recorded, before in zip(self.recorded[::-1], [*self.recorded[-2::-1], None], strict=True):
            start = array(), array()
            of = StateGradients(*start, *[None] * 4, *end, None, None)
            gradients.backward(recorded, before, of)
            end = start
        return end[0].numpy(), end[1].numpy()
