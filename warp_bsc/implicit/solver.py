"""Gradients through VBD: a solver around it whose steps are differentiated by the implicit function theorem."""

import functools
import math
import weakref
from typing import Any

import newton
import warp as wp
from newton.solvers import SolverVBD

from .._arguments import check_instance, checked_integer, checked_number
from .._one_thread import one_at_a_time
from .._private_names.of_newton import (
    attachment_arrays,
    displacements_since_detection,
    has_surface_contacts,
    vbd_switch,
)
from .._private_names.of_warp import paused_tape
from ..detection.run.host_function import run_on_host
from ..response.adjoint.between_steps import BetweenSteps
from ..response.wrapped_solver import WrappedSolver
from . import kernels, matrix_kernels
from .attachments import check_attachments
from .bodies import BodyPoses, Poses
from .contacts import record_contacts, record_pairs
from .equations import Equations, Step
from .linear import LinearSolver
from .polish import Polish
from .report import RESIDUAL_LIMIT, ImplicitReport
from .worlds import Worlds

_STANDARD_GRAVITY = 9.80665


def _no_tape():
    """Stands in for a weak reference to a tape."""


class SolverImplicitAdjoint(WrappedSolver):
    """Lets VBD step, bit for bit as without it, and carries gradients of :class:`warp.Tape` through its steps.

    The end of a step of VBD balances inertia and forces on each particle. The implicit function theorem makes gradients
    of that balance, see :mod:`.equations`: going back through a step takes one linear solve, whatever the iterations of
    VBD were, and its memory is three vectors for each particle, and the contacts.

    On a tape, a step carries gradients if ``state_out.particle_q`` requires them: from positions and velocities of
    particles at its end to those at its start, to ``state_in.particle_f``, and to what requires gradients of
    ``particle_mass``, ``particle_inv_mass`` and ``gravity``; ``tri_poses``, ``tri_areas``, ``tri_materials``,
    ``edge_rest_angle``, ``edge_rest_length``, ``edge_bending_properties``, ``tet_poses``, ``tet_materials``,
    ``spring_rest_length``, ``spring_stiffness`` and ``spring_damping``; ``shape_material_ke``, ``shape_material_kd``,
    ``shape_material_mu``, ``shape_margin`` and ``particle_radius``; ``attachment_particle_body_body_point``,
    ``attachment_particle_body_stiffness`` and ``attachment_particle_body_damping``; poses of bodies that particles
    touch or are attached to; and ``soft_contact_body_pos``, ``soft_contact_body_vel``, ``soft_contact_normal`` and
    ``soft_contact_barycentric`` of contacts. Masses and inverse masses are separate inputs, as VBD reads both. The set
    of contacts is constant. How the planes of contacts follow from positions is differentiated by Newton, if the tape
    records the detection, for which each step needs a :class:`newton.Contacts` of its own; otherwise planes are
    constant.

    Self-contact of VBD (``particle_enable_self_contact``) carries gradients to positions at both ends of a step; its
    coefficients and its distance are numbers, which have none. Its pairs are those of the last detection in the step.
    Where they did not fit into the buffers of VBD, gradients are NaN, and ``report.overflowed_steps`` counts the step.
    VBD cuts displacements so that nothing passes through, and so does ``polish`` at its end: a step with cuts is not
    solved, and its residual says so. Shorter steps have fewer.

    Gradients are those of a solved step. As VBD makes a number of iterations, and not as many as it takes, the report
    has the force that is left in every step on a tape, and a step with much of it warns. ``polish`` removes it. Where
    more than 0.01 of the weight is left and the matrix is not positive definite, gradients are NaN, and
    ``report.rejected_solves`` counts them.

    Behind the collision stage, ``SolverCCD(SolverImplicitAdjoint(SolverVBD(model)))``, gradients go through both.

    Limitations:
        On a tape, or with ``polish``, a step raises NotImplementedError with dynamic bodies that VBD integrates,
        self-contact between particles of a world and of none, contacts of a collision pipeline of VBD's own, truncation
        before shapes (``rigid_soft_enable_dat``), contacts with features of meshes, and penalties of contacts that grow
        (``rigid_avbd_linear_beta``). Velocities of bodies at the end carry no gradients.

        Kinematic particles and bodies that a program moves between steps, on the tape or not, have their gradient in
        the array that it writes: that of a state of its own for each step. Positions and poses that are those that the
        step left have theirs at its start, and NaN between the steps: a program that writes the same does so on the
        tape, as by :func:`warp.copy`. Where it cannot be known what a gradient is of, it is NaN as well, and
        ``report.ambiguous_moves`` counts it, see :mod:`.response.adjoint.between_steps`.

    References:
        A. H. Chen, Z. Liu, Y. Yang and C. Yuksel, Vertex Block Descent, ACM Transactions on Graphics 43(4), 2024,
        doi:10.1145/3658179.
        M. Geilinger, D. Hahn, J. Zehnder, M. Baecher, B. Thomaszewski and S. Coros, ADD: Analytically Differentiable
        Dynamics for Multi-Body Systems with Frictional Contact, ACM Transactions on Graphics 39(6), 2020,
        doi:10.1145/3414685.3417766.

    Attributes:
        solver: VBD.
        report: Residuals of steps and failures of linear solves, :class:`.report.ImplicitReport`.
        polish: Newton steps after the iterations of VBD.
    """

    def __init__(self, solver: SolverVBD, *, polish: int = 0, tolerance: float = 1e-6, max_iterations: int = 1000):
        """Puts the adjoint around VBD.

        Args:
            solver: VBD of a model with particles.
            polish: Newton steps after the iterations of VBD, 0 to 100, on a tape or not; see :mod:`.polish`. With 0 the
                result is that of VBD. One to three finish a step of ten iterations, for about the price of a step
                back each.
            tolerance: Largest residual of a linear solve of a gradient, relative to its right-hand side. Gradients of a
                world whose solve ends above it are NaN, and counted: ``report.failed_solves``.
            max_iterations: Iterations after which a linear solve ends.

        Raises:
            TypeError: If an argument has another type; the solver must be a ``SolverVBD``.
            ValueError: If a number is out of range, or the model has no particles.
            NotImplementedError: If the particles of a world do not follow each other in the model, or several
                attachments of infinite stiffness hold one particle.
        """
        check_instance(solver, "solver", SolverVBD, "a newton.solvers.SolverVBD")
        super().__init__(solver)
        model = self.model
        if not model.particle_count:
            raise ValueError("solver: the model has no particles")
        self.polish = checked_integer(polish, "polish", 0, 100)
        tolerance = checked_number(tolerance, "tolerance", 0.0, 0.1, above=True)
        max_iterations = checked_integer(max_iterations, "max_iterations", 1)
        check_attachments(model)
        worlds = self._worlds = Worlds(model)
        self._equations = equations = Equations(solver, worlds)
        self._linear = LinearSolver(equations, worlds, tolerance=tolerance, max_iterations=max_iterations)
        self._polish = Polish(equations, worlds, self.polish, max_iterations) if self.polish else None
        self._poses = BodyPoses(solver)
        self._has_dynamic_bodies = self._poses.has_dynamic()
        self.report = ImplicitReport(worlds, self.polish)
        moves_bodies, counts = not solver.integrate_with_external_rigid_solver, self.report.device_counts[5:6]
        self._between_steps = BetweenSteps(model, counts, bodies=moves_bodies)
        self._sums = wp.zeros((2, worlds.count), dtype=wp.float64, device=model.device)
        self._rejected = wp.zeros(worlds.count, dtype=int, device=model.device)
        self._tape, self._first, self._launches, self._detected = _no_tape, None, 0, []
        self._of_end, self._free = equations.zeros(), equations.zeros()
        self._x0 = wp.zeros(model.particle_count, dtype=wp.vec3, device=model.device)

    @one_at_a_time
    def step(
        self,
        state_in: newton.State,
        state_out: newton.State,
        control: newton.Control | None,
        contacts: newton.Contacts | None,
        dt: float,
        **options: Any,
    ) -> None:
        """Steps VBD; arguments are its own.

        A step that a tape records leaves the positions of ``state_in`` as they were; others may change them, as those
        of VBD do.

        Raises:
            TypeError: If ``dt`` is no number.
            ValueError: If ``dt`` is not finite or not more than 0, or if a tape records the step, and ``state_out`` is
                ``state_in``.
            NotImplementedError: If a tape records the step or ``polish`` is more than 0, and the step has forces that
                are not differentiated, see above.
            RuntimeError: If another thread is using this solver.
        """
        checked_number(dt, "dt", 0.0, above=True)
        with paused_tape() as tape:
            end = state_out.particle_q
            recording = tape is not None and end is not None and end.requires_grad
            if not recording and self._polish is None:
                self.solver.step(state_in, state_out, control, contacts, dt, **options)
                return
            self._check(contacts)
            if not recording:
                poses = self._poses.read(state_in, state_out, None)
                wp.copy(self._x0, state_in.particle_q)
                self.solver.step(state_in, state_out, control, contacts, dt, **options)
                finish = functools.partial(
                    self._finish, state_in, state_out, self._x0, contacts, poses, dt, self._cuts()
                )
                run_on_host(finish, self.model.device)
                return
            if state_in is state_out:
                raise ValueError("on a tape, state_out must not be state_in")
            self._check_detections(tape, contacts)
            with self._between_steps.watched(tape, state_in, state_out):
                poses = self._poses.read(state_in, state_out, tape)
                x0 = wp.clone(state_in.particle_q, requires_grad=False)
                self.solver.step(state_in, state_out, control, contacts, dt, **options)
                wp.copy(state_in.particle_q, x0)
                self._record(tape, state_in, state_out, x0, contacts, poses, dt)
        if not self.model.device.is_capturing:
            self.report.warn()

    def _check(self, contacts):
        """Raises an error if a step has forces that are not differentiated."""
        solver = self.solver
        assert isinstance(solver, SolverVBD)
        reasons = {
            "dynamic bodies that VBD integrates": self._has_dynamic_bodies,
            "self-contact between particles of a world and of none": (
                solver.particle_enable_self_contact and self._worlds.count > 1 and -1 in self._worlds.ids
            ),
            "contacts of a collision pipeline of VBD's own": solver.collision_pipeline is not None,
            "truncation before shapes (rigid_soft_enable_dat)": vbd_switch(solver, "rigid_soft_enable_dat"),
            "penalties of contacts that grow (rigid_avbd_linear_beta)": solver.rigid_contact_k_start_value >= 0.0,
            "contacts with features of meshes": (
                contacts is not None and contacts.soft_contact_max > 0 and has_surface_contacts(contacts)
            ),
        }
        for reason, applies in reasons.items():
            if applies:
                raise NotImplementedError(f"gradients through VBD, and polish, do not support {reason}")

    def _check_detections(self, tape, contacts):
        """Raises an error if a tape has detected two sets of contacts in the same arrays: the first is overwritten."""
        first = id(tape.launches[0]) if tape.launches else None  # another one if the tape was reset
        if self._tape() is not tape or self._first != first or len(tape.launches) < self._launches:
            self._tape, self._first, self._launches, self._detected = weakref.ref(tape), first, 0, []
        new, self._launches = tape.launches[self._launches :], len(tape.launches)
        if contacts is None or not contacts.soft_contact_max:
            return
        normal = contacts.soft_contact_normal
        launches = (launch for launch in new if not callable(launch))
        if any(array is normal for launch in launches for array in (*launch[3], *launch[4])):
            if any(array is normal for array in self._detected):
                raise ValueError(
                    "contacts: on a tape that records their detection, each step needs contacts of its own, as going "
                    "back reads them; or detect outside the tape, so that contact planes are constant"
                )
            self._detected.append(normal)
        if self._first is None and tape.launches:
            self._first = id(tape.launches[0])

    def _cuts(self):
        """Returns what :func:`.displacements_since_detection` does; None without self-contact or polish."""
        solver = self.solver
        assert isinstance(solver, SolverVBD)
        has_cuts = self._polish is not None and solver.particle_enable_self_contact
        return displacements_since_detection(solver) if has_cuts else None

    def _finish(self, state_in, state_out, x0, contacts, poses, dt, cuts):
        """Polishes the end of a step that is not recorded."""
        recorded = record_contacts(contacts, copies=False)
        pairs, (v0, force) = self._record_pairs(), (state_in.particle_qd, state_in.particle_f)
        self._equations.load(Step(dt, x0, v0, state_out.particle_q, force, recorded, pairs, poses))
        self._polish_end(x0, state_out, dt, cuts)

    def _polish_end(self, x0, state_out, dt, cuts):
        x1 = state_out.particle_q
        assert self._polish is not None
        self._polish.run(x1)
        if cuts is not None:  # VBD ends no step beyond its planes, and nor does polish
            start, displacements, cut = cuts
            self._launch(kernels.set_velocity, len(x1), [1.0, start, x1], [displacements])
            cut(state_out)
            self._equations.load_end(x1)
        self._launch(kernels.set_velocity, len(x1), [float(dt), x0, x1], [state_out.particle_qd])

    def _record(self, tape, state_in, state_out, x0, contacts, poses, dt):
        """Measures the end of a step, polished if that is asked for; the tape records its adjoint."""
        device = self.model.device
        ends = state_out.particle_q, state_out.particle_qd
        starts = state_in.particle_q, state_in.particle_qd, state_in.particle_f
        step: Step | None = None
        residuals: wp.array | None = None
        cuts = self._cuts()

        def forward():
            nonlocal step, residuals
            v0 = wp.clone(starts[1], requires_grad=False)
            force = None if starts[2] is None else wp.clone(starts[2], requires_grad=False)
            recorded, pairs = record_contacts(contacts, copies=True), self._record_pairs()
            self._equations.load(Step(dt, x0, v0, ends[0], force, recorded, pairs, poses))
            if self._polish is not None:
                self._polish_end(x0, state_out, dt, cuts)
            self._measure(pairs)
            residuals = wp.clone(self.report.device_residuals[0])
            step = Step(dt, x0, v0, wp.clone(ends[0], requires_grad=False), force, recorded, pairs, poses)

        def backward():
            assert step is not None
            with self._lock:
                gradients = (None if array is None else array.grad for array in (*starts, *ends))
                self._backward(step, poses, residuals, *gradients)

        run_on_host(forward, device)
        arrays = [array for array in (*starts, *ends) if array is not None and array.requires_grad]
        tape.record_func(lambda: run_on_host(backward, device), arrays + self._read_arrays(contacts))

    def _read_arrays(self, contacts):
        """Returns the arrays of the model and of contacts that get gradients, which a tape sets to zero."""
        model = self.model
        names = [f"particle_{name}" for name in ("mass", "inv_mass", "radius")] + ["gravity", "shape_margin"]
        names += [f"tri_{name}" for name in ("poses", "areas", "materials")] + ["tet_poses", "tet_materials"]
        names += [f"edge_{name}" for name in ("rest_angle", "rest_length", "bending_properties")]
        names += [f"spring_{name}" for name in ("rest_length", "stiffness", "damping")]
        names += [f"shape_material_{name}" for name in ("ke", "kd", "mu")]
        arrays = [getattr(model, name) for name in names]
        attached = attachment_arrays(model)
        if attached is not None:
            arrays += [attached.body_point, attached.stiffness, attached.damping]
        if contacts is not None and contacts.soft_contact_max:
            arrays += [getattr(contacts, f"soft_contact_{name}") for name in ("body_pos", "body_vel", "normal")]
            arrays.append(contacts.soft_contact_barycentric)
        return [array for array in arrays if array is not None and len(array) and array.requires_grad]

    def _record_pairs(self):
        assert isinstance(self.solver, SolverVBD)
        return record_pairs(self.solver, self._worlds)

    def _measure(self, pairs):
        """Reports the residual of the step that the equations have loaded, and whether pairs were dropped."""
        equations, model, report = self._equations, self.model, self.report
        forces = equations.evaluate()
        self._sums.zero_()
        inputs = [equations.is_fixed, model.particle_mass, model.gravity, model.particle_world]
        inputs += [wp.float64(_STANDARD_GRAVITY), self._worlds.of_particles, forces]
        self._launch(kernels.sum_residuals, len(forces), inputs, [self._sums])
        outputs = [report.device_residuals, report.device_counts]
        self._launch(kernels.report_residuals, 1, [wp.float64(RESIDUAL_LIMIT), self._sums], outputs)
        if pairs is not None:
            self._launch(kernels.count_dropped, 1, [pairs.dropped], [report.device_counts])
        report.copy_counts()

    def _backward(self, step: Step, poses: Poses, residuals, of_x0, of_v0, of_force, of_x1, of_v1):
        """Turns gradients with respect to the end of a step into those with respect to all that it depends on."""
        equations, n = self._equations, len(step.x0)
        equations.load(step)
        dt = wp.float64(step.dt)
        self._launch(kernels.of_end, n, [dt, of_x1, of_v1, equations.is_fixed], [self._of_end, self._free])
        equations.differentiate(transposed=True)
        multipliers = self._linear.solve(self._free)
        inputs = [wp.float64(RESIDUAL_LIMIT), residuals, self._linear.failed, self._linear.indefinite]
        outputs = [self._rejected, self.report.device_counts]
        self._launch(kernels.count_solves, self._worlds.count, inputs, outputs)
        for lost in [self._rejected] + ([] if step.pairs is None else [step.pairs.dropped]):
            inputs = [self._worlds.of_particles, lost, wp.float64(math.nan)]
            self._launch(matrix_kernels.set_failed, n, inputs, [multipliers])
        self.report.copy_counts()
        by_forces = equations.add_gradients(multipliers, self._of_end, of_v0, of_force)
        if of_x0 is not None:
            inputs = [dt, of_v1, equations.is_fixed, self._of_end, *by_forces]
            self._launch(kernels.add_of_start, n, inputs, [of_x0])
        if poses.finish is not None:
            poses.finish()
        for gradient in (of_x1, of_v1):  # the step overwrote what they are of
            if gradient is not None:
                gradient.zero_()

    def _launch(self, kernel, size, inputs, outputs):
        wp.launch(kernel, size, inputs=inputs, outputs=outputs, device=self.model.device)

    @one_at_a_time
    def notify_model_changed(self, flags: int) -> None:
        """Notifies VBD, reads again what is kinematic and which bodies it moves, and checks attachments again.

        Raises:
            NotImplementedError: If several attachments of infinite stiffness hold one particle.
        """
        super().notify_model_changed(flags)
        self._has_dynamic_bodies = self._poses.has_dynamic()
        self._between_steps.refresh()
        check_attachments(self.model)
