"""Gradients of :class:`warp.Tape` through the steps of the solver with contact inside.

A step that a tape records keeps what it began and ended with, and the contacts at its end. Going back through it takes
one linear solve, see :mod:`.equations`, whatever the Newton steps were.
"""

import contextlib
import copy
import weakref
from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import Any

import newton
import warp as wp

from ...response.state.motion import StateArrays
from ...response.state.workspace import Workspace
from ..contact.newton_method import NewtonMethod
from . import energies, kernels
from .arrays import copied, copied_materials, launch_adjoint, materials_with_gradients, with_gradient, with_gradients
from .between_steps import BetweenSteps
from .bodies import end_bodies, find_solved, leave_out_solved, predict_goals
from .contact_forces import RecordedContacts
from .equations import SolvedBodies, SolvedStep, StepEquations
from .linear import LinearSolver
from .report import GradientReport, Place

_TOLERANCE, _MAX_ITERATIONS = 1e-6, 1000
"""Residual at which a linear solve ends, relative to its right-hand side, and iterations after which it does."""
_THREADS = 256
"""Threads for each world that copy its contacts on a GPU."""


@dataclass(eq=False)
class StartArrays:
    """Copies of arrays of the state at the start of a step; None where there is none."""

    particle_qd: wp.array | None
    particle_f: wp.array | None
    body_q: wp.array | None
    body_qd: wp.array | None
    body_f: wp.array | None

    @classmethod
    def of(cls, state: newton.State) -> "StartArrays":
        """Copies those of a state."""
        arrays = (getattr(state, field.name) for field in fields(cls))
        return cls(*(None if array is None else wp.clone(array, requires_grad=False) for array in arrays))


@dataclass(eq=False)
class StateGradients:
    """Gradients with respect to the arrays of the states at both ends of a step; None where there are none."""

    particle_q: wp.array | None
    particle_qd: wp.array | None
    particle_f: wp.array | None
    body_q: wp.array | None
    body_qd: wp.array | None
    body_f: wp.array | None
    end_particle_q: wp.array | None
    end_particle_qd: wp.array | None
    end_body_q: wp.array | None
    end_body_qd: wp.array | None


@dataclass(eq=False)
class RecordedStep:
    """A step of a tape.

    Attributes:
        step: What it solved.
        failed: 1 for worlds that it did not solve, int32, shape [worlds].
        of_particles, of_bodies: 1 for what is in worlds in which it began where the last one ended, int32.
        is_held: 1 for particles that attachments hold.
        number, norms: Number of the step on its tape, and the norms of its gradients, see :class:`.GradientReport`.
    """

    step: SolvedStep
    failed: wp.array
    of_particles: wp.array
    of_bodies: wp.array
    is_held: wp.array
    number: int
    norms: wp.array


class StepGradients:
    """Records steps, and goes back through them.

    Attributes:
        work: The workspace of the steps.
        newton: Their solver.
        report: Where gradients are counted.
        equations: Those of the step that was gone back through last.
        between_steps: What a program moves between them.
        last: The tape of the last step, as a weak reference, and the norms of its gradients.
        taken: How many steps were taken so far, recorded or not.
    """

    def __init__(self, work: Workspace, newton: NewtonMethod, converged: wp.array[wp.bool], report: GradientReport):
        """Allocates buffers for steps of a solver that keeps contacts at their ends, and whose worlds ``converged``."""
        self.work, self.newton, self._converged, self.report = work, newton, converged, report
        self._model: Any = work.mesh.model
        model, self.equations = self._model, StepEquations(newton)
        limits = {"tolerance": _TOLERANCE, "max_iterations": _MAX_ITERATIONS}
        self._linear = LinearSolver(newton.problem.unknowns.of_worlds, **limits)
        vertices, particles, device = work.mesh.vertex_count, model.particle_count, work.device

        def zeros(n):
            return wp.zeros(n, dtype=wp.vec3d, device=device)

        self._of_x1, self._of_x0, self._of_v0 = zeros(vertices), zeros(vertices), zeros(particles)
        self._of_unknowns, self._carried_x = zeros(self.equations.count), zeros(particles)
        self._carried_poses = wp.zeros_like(model.body_q) if model.body_count else None
        self._room = 0  # contacts that the arrays of a step in a CUDA graph have room for
        self._largest = wp.zeros(work.worlds, dtype=wp.int64, device=device)
        self._carried_to: wp.array | None = None  # norms of a step
        self.between_steps = BetweenSteps(model, report.counts)
        self.taken, self._places = 0, None
        self.forget_last()

    def forget_last(self) -> None:
        """Lets gradients of what starts here go no further."""
        self.last: tuple = (lambda: None), None

    def add_step(self, tape: wp.Tape) -> tuple[Place, wp.array | None]:
        """Returns the place of another step of a tape, and the norms of the one that ended where it begins, if any."""
        last_tape, before = self.last
        place = next(self._places or iter([self.report.add_step(tape)]))
        self.last = weakref.ref(tape), place[1]
        return place, before if last_tape() is tape else None

    @contextlib.contextmanager
    def aside(self, places: Iterator[Place]) -> Iterator[None]:
        """Lets other tapes record steps, which have these places on the tape that goes on afterwards."""
        kept = self.between_steps, self.last
        self.between_steps, self._places = copy.copy(self.between_steps), places
        try:
            yield
        finally:
            self.between_steps, self.last = kept
            self._places = None

    def record(self, place: Place, dt: float, start: StartArrays, end: StateArrays) -> RecordedStep:
        """Returns a copy of a step that has been taken, before it ends for :class:`.LastStep`."""
        work, newton, model, device = self.work, self.newton, self._model, self.work.device
        motion, last, particles = work.motion.vertices, work.motion.last, model.particle_count
        x0, velocity = (wp.zeros(n, dtype=wp.vec3d, device=device) for n in (work.mesh.vertex_count, particles))
        work.launch(kernels.to_double, len(x0), [newton.problem.trial.origin], [x0])
        work.launch(kernels.to_double, particles, [start.particle_qd], [velocity])

        def found(kernel, count, inputs):
            values = wp.zeros(count, dtype=int, device=device)
            work.launch(kernel, count, inputs, [values])
            return values

        is_fixed = found(kernels.find_fixed, self.equations.count, [newton.problem.unknowns.is_free])
        is_held = wp.zeros(particles, dtype=int, device=device)
        if self.equations.attachments is not None:
            at = self.equations.attachments
            inputs = [at.particle, at.stiffness, at.enabled, work.step.motion]
            work.launch(kernels.find_held, len(at.particle), inputs, [is_held])
        failed = found(kernels.begin_failed, work.worlds, [self._converged])
        inputs = [newton.problem.trial, newton.problem.unknowns, end.particle_q, work.mesh.device_world]
        work.launch(kernels.find_changed, particles, inputs, [failed])
        of_particles = found(kernels.find_continuing, particles, [work.mesh.device_world, last.interrupted])
        of_bodies, poses, bodies = wp.zeros(model.body_count, dtype=int, device=device), (None, None), None
        if model.body_count:
            of_bodies = found(kernels.find_continuing, model.body_count, [model.body_world, last.interrupted])
            is_solved = wp.zeros(model.body_count, dtype=int, device=device)
            if self.equations.of_bodies is not None:
                inputs = [self.equations.of_bodies, is_fixed]
                work.launch(find_solved, model.body_count, inputs, [is_solved])
            poses = wp.clone(end.body_q, requires_grad=False), wp.clone(last.poses)
            work.launch(kernels.start_poses, model.body_count, [start.body_q, of_bodies, is_solved], [poses[1]])
            bodies = self._predict(dt, start, poses[1], is_solved)
        contacts = self._record_contacts(failed)
        of_motion = copied(motion, ["inverse_mass", "friction"])
        if work.mesh.distance_arrays is not None:
            of_motion.distances = copied(motion.distances, ["radius", "of_planes"])
        of_motion.materials = copied_materials(motion.materials)
        start_and_end = x0, wp.clone(newton.problem.trial.exact), velocity, start.particle_f
        planes, settings = copied(work.motion.planes, ["start", "end", "friction"]), copied(newton.settings, ["load"])
        step = SolvedStep(dt, *start_and_end, is_fixed, *contacts, of_motion, planes, settings, poses, bodies)
        return RecordedStep(step, failed, of_particles, of_bodies, is_held, *place)

    def _predict(self, dt, start, poses, is_solved):
        """Returns the bodies that the last step has solved for, and where inertia led them."""
        goals, velocities = wp.clone(poses), wp.zeros_like(start.body_qd, requires_grad=False)
        bodies = SolvedBodies(is_solved, start.body_qd, start.body_f, goals, velocities)
        if self.equations.of_bodies is not None:
            inputs = self._inputs_of_goals(bodies, poses, dt, self.work.motion.vertices.bodies)
            self.work.launch(predict_goals, len(poses), inputs, [goals, velocities])
        return bodies

    def _inputs_of_goals(self, bodies, poses, dt, of_motion):
        inputs = [bodies.is_solved, poses, bodies.velocities, bodies.force, self._model.gravity]
        return [*inputs, of_motion, float(dt)]

    def _record_contacts(self, failed):
        """Returns vertices, unknowns, and all else of the contacts at the end of a step.

        In a CUDA graph there is room for half as many again as steps outside of one have had; worlds fail whose
        contacts do not fit.
        """
        work, newton, device = self.work, self.newton, self.work.device
        capacity, size = len(newton.problem.contacts.corners), 4 if self.equations.of_bodies is None else 8
        if device.is_capturing and self._room:
            capacity = min(capacity, self._room)
        vertices, rows = (wp.full((capacity, n), -1, dtype=int, device=device) for n in (4, size))
        kind, plane = wp.full(capacity, -1, dtype=int, device=device), wp.zeros(capacity, dtype=int, device=device)
        count, threads = wp.zeros(1, dtype=int, device=device), _THREADS if device.is_cuda else 1
        inputs = [newton.problem.contacts, newton.problem.unknowns, threads, count]
        outputs = [vertices, rows, kind, plane, failed]
        work.launch(kernels.record_contacts, (threads, work.worlds), inputs, outputs)
        n = capacity
        if not device.is_capturing:
            n = int(count.numpy()[0])
            self._room = max(self._room, n + n // 2)
        contacts = RecordedContacts()
        contacts.kind, contacts.plane = _first(kind, n), _first(plane, n)
        contacts.fall = wp.clone(newton.problem.progress.fall)
        return _first(vertices, n), _first(rows, n), contacts

    def backward(self, recorded: RecordedStep, before: wp.array | None, of: StateGradients) -> None:
        """Turns gradients with respect to the end of a step into those with respect to all that it depends on.

        ``before`` are the norms of the step of the same tape that ended where it begins, None if there is none.
        """
        step, equations, model = recorded.step, self.equations, self._model
        particles, dt = model.particle_count, wp.float64(step.dt)
        if self._carried_to is not recorded.norms:
            self._carried_x.zero_()
            if self._carried_poses is not None:
                self._carried_poses.zero_()
        norms, world = recorded.norms, self.work.mesh.device_world
        for array in (self._of_x1, self._of_x0, self._of_v0, self._of_unknowns, norms, self._largest):
            array.zero_()
        inputs = [dt, of.end_particle_q, of.end_particle_qd, equations.unknown, step.is_fixed, recorded.is_held]
        outputs = [self._of_unknowns, self._of_x1, norms]
        self.work.launch(kernels.of_end, particles, [*inputs, self._carried_x, world], outputs)
        motion, of_motion = with_gradients(step.motion, ["inverse_mass", "friction"])
        table = self.work.motion.friction.materials.friction
        motion.materials, of_motion.materials = materials_with_gradients(step.motion.materials, table)
        distances = self.work.mesh.distance_arrays
        if distances is not None and distances.requires_grad:
            names = "radius", "of_planes"
            motion.distances, of_motion.distances = with_gradients(step.motion.distances, names)
        planes, of_planes = with_gradients(step.planes, ["start", "end", "friction"])
        contacts, of_contacts = with_gradients(step.contacts, ["fall"])
        bodies: Any = step.bodies
        poses: Any = step.poses
        of_poses: Any = None, None
        if model.body_count:
            of_poses = tuple(wp.zeros_like(pose, requires_grad=False) for pose in poses)
            poses = tuple(with_gradient(pose, of_pose) for pose, of_pose in zip(poses, of_poses, strict=True))
            wp.copy(of_poses[0], self._carried_poses)
            if of.end_body_q is not None:
                inputs = [bodies.is_solved, of.end_body_q]
                self.work.launch(kernels.split_end_poses, model.body_count, inputs, [of_poses[0]])
            if equations.of_bodies is not None:
                motion.bodies, of_motion.bodies = with_gradients(step.motion.bodies, ["inverse_mass"])
                of_goals = wp.zeros_like(bodies.goals), wp.zeros_like(bodies.goal_velocities)
                bodies = bodies._replace(
                    goals=with_gradient(bodies.goals, of_goals[0]),
                    goal_velocities=with_gradient(bodies.goal_velocities, of_goals[1]),
                    velocities=with_gradient(bodies.velocities, of.body_qd),
                    force=None if bodies.force is None else with_gradient(bodies.force, of.body_f),
                )
                self._from_end_of_bodies(step, bodies, motion.bodies, of)
        step = step._replace(contacts=contacts, motion=motion, planes=planes, poses=poses, bodies=bodies)
        equations.load(step)
        multipliers = self._linear.solve(equations.differentiate(transposed=True), self._of_unknowns)
        self.work.launch(kernels.set_failed, equations.count, [equations.world, recorded.failed], [multipliers])
        equations.add_gradients(multipliers, self._of_x1, self._of_x0, self._of_v0, of.particle_f)
        if model.body_count:
            self._go_to_poses(step, of_planes)
            if equations.of_bodies is not None:
                inputs = self._inputs_of_goals(bodies, poses[1], step.dt, motion.bodies)
                launch_adjoint(predict_goals, model.body_count, inputs, [*of_goals], self.work.device)
                if model.body_inv_mass.grad is not None:
                    inputs = [of_motion.bodies.inverse_mass]
                    self.work.launch(kernels.add_to, model.body_count, inputs, [model.body_inv_mass.grad])
            inputs = [recorded.of_bodies, bodies.is_solved, *of_poses]
            self.work.launch(kernels.finish_poses, model.body_count, inputs, [of.body_q, self._carried_poses])
        inputs = [dt, of.end_particle_qd, equations.unknown, step.is_fixed, recorded.is_held, recorded.of_particles]
        inputs += [self._of_x1, self._of_x0, self._of_v0, world]
        outputs = [of.particle_q, of.particle_qd, self._carried_x, norms, self._largest]
        self.work.launch(kernels.finish_gradients, particles, inputs, outputs)
        inputs = [recorded.number, recorded.failed, self._linear.failed, self._largest]
        self.work.launch(kernels.report_gradients, len(recorded.failed), inputs, [norms, self.report.counts])
        self.report.copy_counts()
        if model.particle_inv_mass.grad is not None:
            inputs = [of_motion.inverse_mass, step.motion.inverse_mass]
            self.work.launch(kernels.add_inverse_masses, particles, inputs, [model.particle_inv_mass.grad])
        if model.gravity.grad is not None:  # layers, by which barriers are stiffer, follow from it
            inputs = [wp.float32(step.dt), model.gravity]
            self._adjoint(energies.find_falls, self.work.worlds, inputs, of_contacts.fall)
        self.work.motion.friction.backward(of_motion.friction, of_planes.friction)
        if distances is not None and distances.requires_grad:
            distances.backward(of_motion.distances.radius, of_motion.distances.of_planes)
        self._carried_to = before
        # the step overwrote what they are of
        for gradient in (of.end_particle_q, of.end_particle_qd, of.end_body_q, of.end_body_qd):
            if gradient is not None:
                gradient.zero_()

    def _from_end_of_bodies(self, step, bodies, of_motion, of):
        """Turns gradients with respect to states at the end of bodies that are solved for into those of unknowns."""
        equations, n = self.equations, self._model.body_count
        ends = [of.end_body_q, of.end_body_qd]
        for k, array in enumerate((self._model.body_q, self._model.body_qd)):
            ends[k] = wp.zeros_like(array, requires_grad=False) if ends[k] is None else ends[k]
        changes = with_gradient(wp.zeros_like(self._of_unknowns), wp.zeros_like(self._of_unknowns))
        inputs = [bodies.is_solved, equations.of_bodies, changes, step.poses[0], bodies.goals, bodies.goal_velocities]
        launch_adjoint(end_bodies, n, [*inputs, of_motion, wp.float64(step.dt)], ends, self.work.device)
        inputs = [bodies.is_solved, equations.of_bodies, changes.grad]
        self.work.launch(kernels.add_of_bodies, n, inputs, [self._of_unknowns])

    def _go_to_poses(self, step, of_planes):
        """Turns gradients with respect to what moves with bodies into those with respect to their poses."""
        mesh, particles, at = self.work.mesh, self._model.particle_count, self.equations.attachments
        shapes, infinite, poses = mesh.device_shape_vertices, mesh.device_planes, step.poses
        if self.equations.of_bodies is not None:
            inputs = [step.bodies.is_solved, shapes.body, particles]
            self.work.launch(leave_out_solved, len(shapes.body), inputs, [self._of_x1])
        if at is not None:
            inputs = [at.particle.reshape((-1, 1)), at.body, at.body_point, at.stiffness, at.enabled, poses[0]]
            self._adjoint(energies.place_held, len(at.particle), inputs, self._of_x1)
        if len(shapes.body):
            for pose, gradient in zip(poses, (self._of_x1, self._of_x0), strict=True):
                inputs = [shapes.body, shapes.position, pose]
                self._adjoint(energies.place_shapes, len(shapes.body), inputs, gradient[particles:])
        if len(infinite.body):
            for pose, gradient in zip(poses, (of_planes.end, of_planes.start), strict=True):
                inputs = [infinite.body, infinite.point, infinite.normal, pose]
                self._adjoint(energies.place_planes, len(infinite.body), inputs, gradient)

    def _adjoint(self, kernel, size, inputs, gradient):
        launch_adjoint(kernel, size, inputs, [gradient], self.work.device)


def _first(array, n):
    """Returns a copy of the first elements of an array; Warp makes no empty slices."""
    if not n:
        return wp.empty((0, *array.shape[1:]), dtype=array.dtype, device=array.device)
    return array if n == len(array) else wp.clone(array[:n])
