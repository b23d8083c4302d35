"""The collision stage for Newton: a solver that wraps another one, and makes its motion free of collisions."""

import contextlib
import functools
from typing import Literal

import newton
import numpy as np
import warp as wp
from newton.solvers import SolverBase, SolverStyle3D, SolverVBD

from .._arguments import checked_number
from .._one_thread import one_at_a_time
from .._private_names.of_newton import body_q_prev, has_external_rigid_solver, has_room, may_allocate, with_contacts
from .._private_names.of_warp import paused_tape
from ..detection.host_function import run_on_host
from .adjoint.adjoint import RecordedStep, StepAdjoint
from .contacts.arc_check import check_arcs
from .forces.contact_forces import ContactForces
from .integration.vbd_speed_limit import SpeedLimit, has_self_contact, has_speed_limit
from .integration.wrapped_solver import innermost
from .layer.contact_layer import ContactLayer
from .options import StageOptions, default_separation, friction_of
from .schedule import MAX_ITERATIONS, MAX_SWEEPS_PER_STEP, Loop
from .stage import CollisionStage, is_recorded
from .state.collision_filter import CollisionFilter
from .state.friction_table import FrictionTable
from .state.mesh import ModelMesh
from .state.motion import ModelMotion, arrays_of
from .state.record import StepRecorder
from .step import resolve, resolve_inversions
from .substeps.inner_contacts import InnerContacts
from .substeps.small_steps import SmallSteps
from .substeps.strain import StrainMeter
from .substeps.style3d_contacts import Style3DContacts
from .substeps.substeps import Substeps, reason_to_omit_substeps
from .tuning import SUBSTEPS
from .write_back import count_record, write_back

_COUPLED = "a coupled solver steps the stage"
_PASSED_ON = "the inner solver has all contacts that were passed on"


class SolverCCD(CollisionStage):
    """Lets another solver step, then makes the motion that it predicted free of collisions.

    Cloth and the surfaces of soft bodies do not pass through each other, themselves, or rigid shapes that collide with
    particles. Particles push dynamic bodies back, see ``bodies``. All other attributes are those of the inner solver.

    A step is certified if its motion, as stored, is free of collisions. Excluded from the certificate are pairs of
    elements that cross or touch at the start of the step, vertices that begin in the solid of an infinite plane, and
    contacts of which no vertex can be moved: these are left to the inner solver. A particle whose predicted position or
    velocity is not finite, in the step or a substep, stays where it was; neither such a step nor one with a start
    position that is not finite is certified, in ``report.worlds`` the world of the particle alone.

    A kinematic particle or body that a program moves between two steps takes that way in the second step: it starts
    where the last step ended, and in the first step where the model puts it (``particle_q``, ``body_q``). If a movable
    particle has been moved as well, its world was set to another state, and starts there. So does everything after
    :meth:`reset`, and with ``requires_grad``. A body that ``joint_q`` of the model puts elsewhere than ``body_q``
    starts the first step where the state has it.

    The certificate covers the motion from the stored state at the start to the stored state at the end: particles move
    straight, and bodies turn evenly, the shorter way, so that their vertices move on arcs, see ``state.turns``. A
    body that the response can move turns about its centre of mass, others about the axis of their screw. With
    ``requires_grad`` the response resolves contacts of straight paths, and a step in which only an arc collides is not
    certified. A body whose predicted pose or velocity is not finite is left to the inner solver, and the step is not
    certified.

    With ``min_distance`` or ``particle_radius`` the certificate is of distances: a pair that started farther apart
    stays at its minimum distance, and one that started closer comes no closer, beyond rounding (2^-20 of that distance
    and 2^-38 of the largest difference of coordinates of the pair). Pairs that touch at the start are excluded, and
    elements that an edge of the mesh joins only do not touch.

    On a :class:`warp.Tape`, a step carries gradients if the model was finalized with ``requires_grad=True`` and the
    inner solver is differentiable: from positions and velocities of particles and poses and velocities of bodies at its
    end to the predicted ones, to positions and poses at its start, to ``particle_inv_mass``, ``body_inv_mass``,
    ``body_inv_inertia``, ``body_mass``, ``body_inertia`` and ``shape_material_mu`` of the model, and to coefficients of
    friction, also of pairs, and restitution that are arrays. The set of contacts is constant; everything else is
    differentiated as it was computed, see :mod:`.adjoint.adjoint`. With ``requires_grad`` all sweeps are made, so that
    results do not jump, and the stage puts a :class:`.layer.contact_layer.ContactLayer` around the inner solver, see
    ``contact_layer``. :mod:`.adjoint.between_steps` says where gradients of kinematic particles and bodies are that a
    program moves between steps.

    A step builds on the one before. A second thread that calls the stage while one is in it gets a RuntimeError: use
    one stage for each thread. Warp and Newton load their kernels in the first steps that need them, which two threads
    must not do at the same time: let one thread take first steps. A stage cannot be copied by :func:`copy.deepcopy`:
    put a new one behind a solver of the same model.

    Limitations:
        The stage follows the inner solver, which does not see the contacts, except for Style3D. Without ``substeps``,
        steps must be short against the time of sound through an element. With ``substeps="auto"``, whole steps in
        which nothing has touched yet are the inner solver's, however far it stretches cloth in them; after a contact,
        steps are taken in substeps until a whole step strains no element by more than 1%, also if nothing touches.

    Attributes:
        solver: The inner solver, or the contact layer around it.
        mesh: The triangles that collide, :class:`.state.mesh.ModelMesh`.
        report: What the stage found and did, :class:`.report.SolverReport`.
        separation: Distance that contacts are moved apart [m].
        friction: Coefficients of particles, Warp array of float, shape [1] or [particle_count].
        restitution: Share of the approaching velocity that comes back, Warp array of float, shape [1].
        substeps: Substeps of a step that collides, ``"auto"``, or None.
        max_iterations: Iterations of detect and project.
    """

    _near = 1.0  # share of the separation within which pairs near their distance are moved apart like contacts

    def __init__(
        self,
        solver: SolverBase,
        *,
        separation: float | None = None,
        friction: float | wp.array[float] | None = None,
        friction_table: FrictionTable | None = None,
        restitution: float | wp.array[float] | None = None,
        substeps: int | Literal["auto"] | None = "auto",
        bodies: Literal["pushed", "separated", "left"] = "pushed",
        min_distance: float | Literal["model"] | None = None,
        particle_radius: float | np.ndarray | wp.array | None = None,
        collision_filter: CollisionFilter | None = None,
        inversions: Literal["left", "reported", "prevented"] = "left",
        contact_layer: bool = True,
        lift_speed_limit: bool = True,
        max_iterations: int = MAX_ITERATIONS,
        report_contacts: bool | int = False,
        report_worlds: bool = False,
    ):
        """Puts the stage behind a solver.

        Args:
            solver: Any Newton solver that moves particles.
            separation: Distance that contacts are moved apart [m]; default: 0.005 of the median edge length.
            friction: Coefficient of particles, at least 0; default: the model's ``particle_mu``. Shapes have that of
                their material, contacts the geometric mean. May be an array of float32, of length 1 or of one for each
                particle, which each step reads again, and which may require gradients; so are then the coefficients of
                shapes, as with ``requires_grad``. Negative values count as 0.
            friction_table: Coefficients by pair of materials, where they are another than the geometric mean, see
                :class:`.state.friction_table.FrictionTable`. None for none.
            restitution: Share of the approaching velocity that comes back, in [0, 1]; default: the model's
                ``soft_contact_restitution``. May be an array of float32 of length 1, like friction.
            substeps: Substeps of the inner solver in a step that collides, so that it reacts to the contacts, see
                :mod:`.substeps.substeps`: ``"auto"``, 2 to 1024, or None for none. With ``"auto"``, a step whose
                contacts strain cloth, soft bodies or springs by more than 2% is taken in 16 or 32 substeps, and the
                next ones in 2 to 32 while they need it. It takes none behind Style3D, whose iterations see the contacts
                instead, see :mod:`.substeps.style3d_contacts`, where gradients are asked for, in coupled solvers, and
                in CUDA graphs behind solvers whose steps allocate; ``report.substeps_omitted`` says why. If the model
                requires gradients, and behind a contact layer, a number makes as many steps of each, each with its
                contacts and one of its own in the report, see :mod:`.substeps.small_steps`. In steps that may have
                substeps, and behind Style3D, the stage resolves contacts of particles with shapes alone, also if
                ``contacts`` are passed to :meth:`step`: cloth rests at the shape, or with ``particle_radius`` at that
                distance. Not so in short steps, in which weight moves what is at rest by no more than 1% of the median
                edge length: ``SolverVBD`` gets all of ``contacts``, see :mod:`.substeps.inner_contacts`. If an edge is
                strained by more than 20% in a step, or a substep, the stage warns once.
            bodies: What happens to dynamic bodies. ``"pushed"``: particles push them, by mass and inertia, with
                friction and restitution, so that momentum is kept, if the inner solver keeps bodies in maximal
                coordinates (VBD that integrates bodies, XPBD, semi-implicit). Contacts between bodies are left to the
                inner solver; ``report.body_contacts`` counts those that its motion passes. ``"separated"``: bodies are
                also kept apart from each other and from static shapes, as their flags, groups and filters of collision
                say, and certified; the inner solver must read ``body_q`` and ``body_qd`` of the state. ``"left"``: no
                body is pushed. The stage pushes no body into an infinite plane that it collides with, nor deeper than
                it was or is predicted to be; with ``"separated"``, no motion takes it there. Kinematic bodies, bodies
                without mass, static shapes and infinite planes are never pushed. If all bodies are kinematic at
                construction, they stay so.
            min_distance: Distance that pairs keep [m], vertices from faces and edges from edges, and particles from
                infinite planes: a pair that started farther apart stays so, and one that started closer comes no
                closer. Neighbours, elements that an edge of the mesh joins, only do not touch. The stage moves pairs
                apart to this distance and ``separation``. Springs and particles without faces take part. None or 0:
                pairs do not touch, and springs and particles without faces take no part; None warns where there are
                some that could meet something. ``"model"``: pairs keep the thickness that the model has, the radii of
                particles, or ``particle_radius`` where that is given, and the margins of shapes
                (``model.shape_margin``).
            particle_radius: Radius of each particle [m], shape [particle_count], or one for all: pairs keep the sum of
                their radii beside ``min_distance``. That of an edge or a face is the largest one of its vertices, that
                of a shape 0, or its margin with ``min_distance="model"``.
            collision_filter: Groups and masks of particles and shapes: pairs that they leave out are left to the inner
                solver, also if ``contacts`` are passed to :meth:`step`, see
                :class:`.state.collision_filter.CollisionFilter`. None for none. Shapes that do not collide with
                particles by their flags are left out in any case, pairs of shapes as ``bodies`` says.
            inversions: What happens to tetrahedra whose volume becomes, or may become, 0 or negative at a time of the
                step. ``"left"``: nothing. ``"reported"``: ``report.inversions`` counts those of the step as it is
                stored. ``"prevented"``: the paths of their vertices are cut as well, as they are for collisions, and a
                step with one that is left is not certified. Tetrahedra that were inverted at the start are left, and
                counted apart (``report.inverted``).
            contact_layer: Whether to put a :class:`.layer.contact_layer.ContactLayer` of default thickness around the
                inner solver if the model requires gradients; ``report.layer_thickness`` says how thick it is. Without a
                layer, results jump where a contact comes or goes, and gradients miss those jumps.
            lift_speed_limit: Whether VBD with self-contact moves particles as its forces say in the steps in which it
                would brake something, so that the stage alone keeps them apart. Otherwise VBD cuts the path of every
                particle in every step, see :mod:`.integration.vbd_speed_limit`. If its iterations are too few for the
                step, VBD does not hold heavy bodies, and only the limit brakes them: they sink faster without it,
                behind the stage or not. Has no effect on other solvers; ``report.speed_limit_lifted`` is true where it
                has.
            max_iterations: Iterations of detect and project, 0 to 40; what still collides then is divided, see
                :mod:`.schedule`. Fewer bound the time of a step, and leave more vertices with cut paths.
            report_contacts: Whether ``report`` has the contacts of each step and their impulses, see
                :class:`.forces.contact_report.ContactReport`. A number is that of the contacts that are listed at most;
                True stands for 8 for each particle, and at least 4,096. Sums have the contacts beyond that too.
            report_worlds: Whether ``report.worlds`` has results by world, :class:`.worlds.world_report.Worlds`.

        Raises:
            TypeError: If an argument has another type.
            ValueError: If a number, or the friction of a shape that collides with particles, is out of range.
            NotImplementedError: If the model has shapes that are not supported, see :class:`.state.mesh.ModelMesh`.
        """
        super().__init__(solver)
        options = StageOptions.of(
            self.model,
            separation=separation,
            friction=friction,
            friction_table=friction_table,
            restitution=restitution,
            substeps=substeps,
            bodies=bodies,
            min_distance=min_distance,
            particle_radius=particle_radius,
            collision_filter=collision_filter,
            inversions=inversions,
            contact_layer=contact_layer,
            lift_speed_limit=lift_speed_limit,
            max_iterations=max_iterations,
            report_contacts=report_contacts,
            report_worlds=report_worlds,
        )
        self._reads_friction = options.reads_friction
        self.friction, self.restitution = options.friction, options.restitution
        self.substeps, self.max_iterations = options.substeps, options.max_iterations
        separates, keeps_distances = options.bodies == "separated", options.distances.any
        of_mesh = {"separates_bodies": separates, "uses_margins": isinstance(min_distance, str)}
        mesh = ModelMesh(self.model, strands=keeps_distances, collision_filter=collision_filter, **of_mesh)
        self._warn_of_unseen(mesh, options.distances)
        self.separation = default_separation(mesh) if options.separation is None else options.separation
        if keeps_distances:
            mesh.distances = mesh.min_distances(options.distances, reach=self._near * self.separation)
        inner = solver.solver if isinstance(solver, ContactLayer) else solver
        integrator = innermost(solver)
        moves = options.moves_bodies(mesh, integrator)
        coefficients = friction_of(mesh, self.friction, table=friction_table)
        moving = {"moves_bodies": moves, "responds_to_bodies": separates, "watches_turns": True}
        motion = ModelMotion(mesh, coefficients, **moving)
        self._allocate(motion, self.separation, self.restitution, max_iterations=self.max_iterations)
        self._work.watch_inversions(options.inversions)
        if options.contact_layer and self.model.requires_grad and inner is solver:
            self.solver = ContactLayer(
                solver,
                friction=self.friction,
                friction_table=friction_table,
                restitution=self.restitution,
                min_distance=min_distance,
                particle_radius=particle_radius,
                collision_filter=collision_filter,
                bodies=options.bodies,
            )
        if isinstance(self.solver, ContactLayer):
            self.report.layerless_steps, self.report.thickness = self.solver.skipped, self.solver.thickness_values
        lifts = options.lift_speed_limit
        self._speed_limit = SpeedLimit(integrator) if lifts and has_speed_limit(integrator) else None
        self.report.speed_limit_lifted = self._speed_limit is not None
        self._watch_between_steps(bodies=not has_external_rigid_solver(integrator))
        self._recorder = StepRecorder(mesh.device, max_sweeps=MAX_SWEEPS_PER_STEP)
        self._meter = StrainMeter(self._work)
        self._substepping: tuple[Substeps, InnerContacts] | None = None
        self._in_substeps: Substeps | None = None  # of the step in progress, if it may have some
        self._has_springs = isinstance(integrator, SolverVBD)  # as contacts: XPBD makes velocities of their depth
        if self.substeps == "auto":
            self.report.substeps_omitted = reason_to_omit_substeps(solver)
        self._inner_rows: Style3DContacts | None = None
        if self.substeps == "auto" and self.report.substeps_omitted is None and isinstance(inner, SolverStyle3D):
            self.report.substeps_omitted = "SolverStyle3D sees the contacts in its iterations"
            self._inner_rows = Style3DContacts(self._work)
        self._small_steps: SmallSteps | None = None
        if isinstance(self.substeps, int) and (self.model.requires_grad or isinstance(self.solver, ContactLayer)):
            self._small_steps = SmallSteps(self.model, self.substeps)
            self.report.last_substeps.fill_(self.substeps)
        elif self.substeps is not None and self.report.substeps_omitted is None:
            choices = SUBSTEPS if self.substeps == "auto" else (self.substeps,)
            substeps_of_steps = Substeps(self._step_solver, solver, self._work, self._meter, choices)
            self._substepping = substeps_of_steps, InnerContacts(mesh, moves_bodies=motion.moves_bodies)
            self.report.last_substeps, self.report.last_strain = substeps_of_steps.substeps, substeps_of_steps.strain
        self._forces: ContactForces | None = None
        if options.report_contacts:
            in_substeps = self._substepping is not None
            self._forces = ContactForces(self._work, options.report_contacts, in_substeps=in_substeps)
            self.report.keep_contacts(self._forces.rows, self._forces.published, self._forces.shapes_of_worlds)
            if self._substepping is not None:
                self._substepping[0].forces = self._forces
        self._pushes_before: str | None = None  # in all steps
        if self._inner_rows is not None:
            self._pushes_before = "SolverStyle3D pushes in its iterations"
        elif isinstance(self.solver, ContactLayer):
            self._pushes_before = "the contact layer pushes before the stage"
        elif has_self_contact(integrator):
            self._pushes_before = "SolverVBD has self-contact"
        self.report.impulses_elsewhere = self._pushes_before
        if options.report_worlds:
            self._count_worlds(None if self._forces is None else self._forces.published.max_impulse)
            if self._substepping is not None:
                self._substepping[0].taken = wp.zeros(self._work.worlds, dtype=int, device=mesh.device)

    @property
    def _predicted_substeps(self):
        return None if self._substepping is None else self._substepping[0].predicted

    @one_at_a_time
    def step(
        self,
        state_in: newton.State,
        state_out: newton.State,
        control: newton.Control | None,
        contacts: newton.Contacts | None,
        dt: float,
        **options,
    ) -> None:
        """Steps the inner solver, and resolves the collisions of its motion, see :meth:`.stage.CollisionStage.step`.

        On a tape, minimum distances raise NotImplementedError only if there are particles without faces and springs.
        """
        if self._small_steps is None:
            super().step(state_in, state_out, control, contacts, dt, **options)
            return
        checked_number(dt, "dt", 0.0, above=True)
        with paused_tape() as tape:
            self._check_tape(tape, state_in, state_out)

        def step(start, end, small_dt):
            super(SolverCCD, self).step(start, end, control, contacts, small_dt, **options)

        on_tape = tape is not None and self.model.requires_grad
        self._small_steps.take(step, state_in, state_out, dt, on_tape=on_tape)

    def _check_tape(self, tape, state_in, state_out):
        if tape is None or not self.model.requires_grad:
            return
        if state_in is state_out:
            raise ValueError("on a tape, state_out must not be state_in")
        if self._work.detector.points:
            raise NotImplementedError(
                "on a tape, particles without faces and springs that keep a distance carry no gradients: "
                "omit min_distance and particle_radius"
            )
        if self._work.ends is not None:
            raise NotImplementedError("inversions='prevented' has no gradients: on a tape, pass 'reported' or 'left'")

    def _begin_step(self, state, contacts, dt):
        self._in_substeps, self._inner_contacts = None, None
        if self._forces is not None:
            self._forces.begin(arrays_of(state), remembers=not self.model.requires_grad)
        if self._coupled is not None and self._inner_rows is not None:
            self._inner_rows, self.report.substeps_omitted = None, _COUPLED
        if self._substepping is None:
            return contacts
        in_substeps, inner_contacts = self._substepping
        if self.substeps == "auto":
            self.report.substeps_omitted = self._reason_to_omit_substeps(in_substeps)
            if self.report.substeps_omitted is not None:
                return contacts
        self._in_substeps = in_substeps
        in_substeps.begin(state)
        if self._has_springs and inner_contacts.is_short(dt):
            return contacts
        self._inner_contacts = inner_contacts
        external = has_external_rigid_solver(self.solver)
        return inner_contacts.take_out(contacts, state, leaves_bodies=self._coupled is not None or not external)

    def _reason_to_omit_substeps(self, in_substeps):
        """Returns why ``"auto"`` takes no substeps in the step that begins; None if it may."""
        device = self.mesh.device
        if self._coupled is not None:
            return _COUPLED
        if device.is_cuda and device.is_capturing and in_substeps.may_allocate:
            return f"{type(self.solver).__name__} may allocate memory, in a graph"
        return None

    def _step_inner(self, *arguments, **options):
        if self._inner_rows is not None:
            state_in, dt = arguments[0], arguments[-1]
            with paused_tape():
                run_on_host(functools.partial(self._inner_rows.find, state_in, dt), self.mesh.device)
        if self._in_substeps is None:
            self._step_solver(*arguments, **options)
        else:
            self._in_substeps.take_whole_step(*arguments, can_branch=self._can_branch(*arguments), **options)

    def _step_solver(self, *arguments, **options):
        step = functools.partial(self.solver.step, *arguments, **options)
        with contextlib.ExitStack() as stack:
            if self._coupled is None and (self._substepping is not None or self._inner_rows is not None):
                stack.enter_context(with_contacts(self.solver, self._inner_rows))
            if self._speed_limit is None:
                step()
            else:
                state_in, dt = arguments[0], arguments[-1]
                self._speed_limit.step(step, state_in, dt, can_branch=self._can_branch(*arguments))

    def _can_branch(self, state_in, state_out, control, contacts, dt):
        """Returns whether the body of a condition may step the inner solver: not if it allocates memory in a graph."""
        allocates = may_allocate(self.solver) or not has_room(self.solver, contacts)
        return not (self.mesh.device.is_capturing and allocates)

    def _finish_step(self, state_in, state_out, control, contacts, passed, dt, options, tape):
        device, end = self.mesh.device, arrays_of(state_out)
        mask = self._mask
        has_all = passed is contacts is not None and contacts.soft_contact_max > 0
        self.report.impulses_elsewhere = self._pushes_before or (_PASSED_ON if has_all else None)
        if self._in_substeps is not None:
            if self._inner_contacts is not None:
                self._inner_contacts.unpack(getattr(options.get("observables"), "contact_f", None), contacts)
            solve = functools.partial(self._in_substeps.resolve, state_out, control, passed, dt)
            run_on_host(lambda: self._resolve(end, dt, solve, mask), device)
        elif is_recorded(tape, state_out):
            self._record(arrays_of(state_in), end, dt, tape)
        else:
            solve = functools.partial(resolve, self._work, dt)
            run_on_host(lambda: self._resolve(end, dt, solve, mask), device)

    def _record(self, start, end, dt, tape):
        """Resolves the motion to a state, and changes it; a tape records the adjoint."""
        device, model, friction = self.mesh.device, self.model, self._motion.friction
        arrays = [start.particle_q, end.particle_q, end.particle_qd]
        if model.body_count:
            arrays += [start.body_q, end.body_q, end.body_qd]
        read = [*friction.inputs, self.restitution, model.particle_inv_mass]
        read += [model.body_inv_mass, model.body_inv_inertia, model.body_mass, model.body_inertia, model.body_com]
        read = [array for array in read if array is not None and len(array) and array.requires_grad]
        recorded: RecordedStep | None = None

        def forward():
            nonlocal recorded
            self._resolve(end, dt, functools.partial(resolve, self._work, dt, self._recorder))
            recorded = None
            if device.is_capturing or self._work.has_changed():
                recorded = RecordedStep(self._work, dt)
                self._work.launch(count_record, 1, [recorded.counts], [self.report.device_totals])

        def backward():
            with self._lock:
                if recorded is not None:
                    StepAdjoint(recorded).backward(*(array.grad for array in arrays))

        run_on_host(forward, device)
        tape.record_func(lambda: run_on_host(backward, device), [*arrays, *read])

    @one_at_a_time
    def _resolve(self, end, dt, solve, mask=None):
        """Solves the motion from the start of the step to its end, as it was predicted, and changes the end."""
        with self._timed():
            if self._reads_friction:
                self._motion.friction.read()
            self._motion.set_end(end, dt)
            if self._forces is not None:
                self._forces.end(end, mask)
            with self._masked(mask):
                solve()
                if self._in_substeps is None:
                    if self._substepping is not None:
                        self._substepping[0].substeps.zero_()
                    self.report.last_strain.zero_()
                    self._measure_strain()
                resolve_inversions(self._work, dt)
                check_arcs(self._work)
                self._write_end(end)

    def _measure_strain(self):
        """Measures the strain by contacts of a whole step, for the report."""
        measure = functools.partial(self._meter.measure, self._motion.vertices, self.report.last_strain)
        wp.capture_if(self._work.loop[Loop.UNFINISHED], measure)

    def _write_end(self, end):
        """Writes the resolved motion to the arrays of a state, and counts the step."""
        size = max(self.mesh.vertex_count, self.model.body_count)
        poses = body_q_prev(self.solver) if self._motion.moves_bodies else None
        outputs = [end, poses, self._work.status]
        self._work.launch(write_back, size, [self._work.vertices], outputs)
        if self._forces is not None:
            self._forces.publish()
        if self._counter is not None:
            self._counter.count(None if self._in_substeps is None else self._in_substeps.taken)
        self._count_step()

    @one_at_a_time
    def notify_model_changed(self, flags: int) -> None:
        """Notifies the inner solver, and reads masses, gravity and shapes again, see :class:`.stage.CollisionStage`."""
        super().notify_model_changed(flags)
        if self._substepping is not None and flags & newton.ModelFlags.MODEL_PROPERTIES:
            self._substepping[1].read_gravity()

    def _follow_shapes(self):
        self._motion.friction.read_shapes(self.model)
        super()._follow_shapes()
        if self._substepping is not None:
            self._substepping[1].read_shapes()

    def update_contacts(self, contacts, state=None):
        """Delegates to the inner solver, for the contacts that it got."""
        inner = self._inner_contacts
        if inner is None:
            super().update_contacts(contacts, state)
        else:
            super().update_contacts(inner.packed(contacts), state)
            inner.unpack(contacts.force, contacts)
