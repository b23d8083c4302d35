"""The collision stage for Newton: a solver that wraps another one, and checks its motion or makes it collision-free."""

import contextlib
import time
from typing import Literal, NamedTuple

import newton
import numpy as np
import warp as wp
from newton import BodyFlags
from newton.solvers import SolverBase, SolverSemiImplicit, SolverVBD, SolverXPBD

from .._arguments import (
    check_instance,
    checked_distance,
    checked_distances,
    checked_flag,
    checked_integer,
    checked_number,
    given,
)
from .._one_thread import Occupied, one_at_a_time
from ..detection.host_function import run_on_host
from .adjoint.adjoint import RecordedStep, StepAdjoint
from .integration.coupling_interface import CouplingHooks
from .integration.private import (
    body_q_prev,
    check_versions,
    has_external_rigid_solver,
    paused_tape,
    without_own_contacts,
)
from .integration.vbd_speed_limit import has_speed_limit, without_speed_limit
from .layer.contact_layer import ContactLayer
from .report import SolverReport, StepTotals
from .schedule import MAX_ITERATIONS, MAX_SWEEPS_PER_STEP, SolveStatus
from .state.friction import Friction
from .state.mesh import ModelMesh
from .state.motion import ModelMotion
from .state.record import RecordCounts, StepRecorder
from .state.structs import FROZEN, NOT_FINITE, TRUNCATED, MovedBodies
from .state.workspace import Workspace
from .step import inspect, resolve
from .substeps.inner_contacts import InnerContacts
from .substeps.substeps import Substeps
from .tuning import SEPARATION, SUBSTEPS

_MOST_SUBSTEPS = 1024


@wp.kernel(enable_backward=False)
def _write_back(
    # in
    outcome: wp.array[int],
    x1: wp.array[wp.vec3],
    velocity: wp.array[wp.vec3],
    # out
    particle_q: wp.array[wp.vec3],
    particle_qd: wp.array[wp.vec3],
    status: SolveStatus,
):
    """Writes the particles that the response changed; the others keep every bit of what they are."""
    particle = wp.tid()
    if particle >= particle_q.shape[0]:  # a vertex of a shape, which moves with its body, wherever that is
        if outcome[particle] & NOT_FINITE != 0:
            status.results.certified[0] = 0
        return
    if outcome[particle] != 0:
        particle_q[particle] = x1[particle]
        particle_qd[particle] = velocity[particle]
    if outcome[particle] & TRUNCATED != 0:
        status.results.truncated[0] = 1
    if outcome[particle] & FROZEN != 0:
        status.results.frozen[0] = 1
    if outcome[particle] & NOT_FINITE != 0:
        wp.atomic_add(status.results.not_finite, 0, 1)


@wp.kernel(enable_backward=False)
def _write_back_bodies(
    # in
    bodies: MovedBodies,
    # out
    body_q: wp.array[wp.transform],
    body_qd: wp.array[wp.spatial_vector],
    body_q_prev: wp.array[wp.transform],
    status: SolveStatus,
):
    """Writes the bodies that the response changed; the others keep every bit of what they are.

    VBD takes the velocity of its next step from ``body_q_prev``, where it has that array.
    """
    body = wp.tid()
    outcome = bodies.outcome[body]
    if outcome == 0:
        return
    body_q[body] = bodies.pose[body]
    body_qd[body] = bodies.velocity[body]
    if body_q_prev:
        body_q_prev[body] = bodies.pose[body]
    if outcome & TRUNCATED != 0:
        status.results.truncated[0] = 1
    if outcome & FROZEN != 0:
        status.results.frozen[0] = 1


@wp.kernel(enable_backward=False)
def _finish_inspection(
    # in
    outcome: wp.array[int],
    particle_count: int,
    # out
    status: SolveStatus,
):
    """Makes the status of an inspection that of a step in which nothing was changed.

    The inspection took vertices without a finite end to stand. Their motion as it is stored is not certified.
    """
    vertex = wp.tid()
    if vertex == 0:
        status.results.first_hits[0] = status.results.remaining[0]
        status.results.iterations[0] = 0
    if outcome[vertex] & NOT_FINITE != 0:
        status.results.certified[0] = 0
        if vertex < particle_count:
            wp.atomic_add(status.results.not_finite, 0, 1)


@wp.kernel(enable_backward=False)
def _count_step(status: SolveStatus, substeps: wp.array[int], totals: StepTotals):
    """Adds a step to the totals."""
    # a certified motion of elements that did not cross makes no crossings
    unchanged = (
        status.results.certified[0] == 1 and status.results.crossings[0] == 0 and status.results.excluded[0] == 0
    )
    status.loop.recount[0] = wp.where(unchanged, 0, 1)
    totals.steps[0] += wp.int64(1)
    totals.coupled_steps[0] += wp.int64(wp.min(substeps[0], 1))
    totals.uncertified_steps[0] += wp.int64(1 - status.results.certified[0])
    totals.undetected_steps[0] += wp.int64(status.results.undetected[0])
    totals.truncated_steps[0] += wp.int64(status.results.truncated[0])
    totals.frozen_steps[0] += wp.int64(status.results.frozen[0])
    totals.not_finite_steps[0] += wp.int64(wp.min(status.results.not_finite[0], 1))
    totals.remaining[0] += wp.int64(status.results.remaining[0])
    totals.excluded[0] += wp.int64(status.results.excluded[0])


@wp.kernel(enable_backward=False)
def _count_record(counts: RecordCounts, complete: wp.array[int], totals: StepTotals):
    """Adds the record of a step to the totals."""
    totals.grazing[0] += wp.int64(counts.grazing[0])
    totals.lost_gradients[0] += wp.int64(1 - complete[0])


class _Arrays(NamedTuple):
    """The arrays of a state, which an attribute of the state may replace later."""

    particle_q: wp.array | None
    particle_qd: wp.array | None
    body_q: wp.array | None
    body_qd: wp.array | None


def _arrays(state):
    return _Arrays(*(getattr(state, name) for name in _Arrays._fields))


class SolverCCD(SolverBase, CouplingHooks):
    """Lets another solver step, then makes the motion that it predicted free of collisions.

    Cloth and the surfaces of soft bodies do not pass through each other, themselves, or rigid shapes that collide with
    particles. Particles push dynamic bodies back, see ``bodies``. All other attributes are those of the inner solver.

    Elements that cross or touch at the start of a step, and vertices that begin in the solid of an infinite plane, are
    left to the inner solver. So are contacts of which no vertex can be moved. Everything else is certified. A particle
    whose predicted position or velocity is not finite stays where it was. A position at the start that is not finite
    leaves the step uncertified, without its elements.

    Kinematic particles and bodies that a program moves between steps, as animations do, take that way in the next step:
    it begins where the last one ended, and the first one where the model puts them (``particle_q``, ``body_q``). Where
    a movable particle has been moved as well, its world was set to another state, and begins there. So does everything
    after :meth:`reset`, and with ``requires_grad``. A body that ``joint_q`` of the model puts elsewhere than ``body_q``
    begins the first step where the state has it.

    The certificate is of straight motion: of all vertices between the stored state at the start and the stored state at
    the end, those of shapes between the poses of their bodies. The vertices of a body that turns go in arcs, whose
    distance from their chords (the sagitta) the response adds to the separation of contacts with that body, up to 4
    times the separation; the arcs themselves are not certified. A body whose predicted pose or velocity is not finite
    is left to the inner solver, and the step is not certified.

    With ``min_distance`` or ``radius`` the certificate is of distances: no pair that started farther apart comes within
    its minimum distance, and none that started nearer comes nearer than it was, beyond rounding: 2^-30 of that distance
    and 2^-38 of the largest difference of coordinates of the pair.
    Elements that touch at the start are set aside, and elements that an edge of the mesh joins only do not touch.

    With ``respond=False`` the stage detects the collisions of each step, reports them, and changes nothing. A step on a
    tape then records what the inner solver records.

    A step on a :class:`warp.Tape` carries gradients, if the model was finalized with ``requires_grad=True`` and the
    inner solver is differentiable: from positions and velocities of particles, poses and velocities of bodies at its
    end to those that the inner solver predicted, to positions and poses at its start, to ``particle_inv_mass``,
    ``body_inv_mass``, ``body_inv_inertia``, ``body_mass``, ``body_inertia`` and ``shape_material_mu`` of the model, and
    to coefficients of friction and restitution that are arrays. The set of contacts is constant; everything else is
    differentiated as it was computed, see :mod:`.adjoint`. With ``requires_grad`` all sweeps are made, so that results
    do not jump.

    A step builds on the one before. A second thread that calls the stage while one is in it gets a RuntimeError: use
    one stage for each thread. Warp and Newton load their kernels in the first steps that need them, which two threads
    must not do at the same time: let one thread take first steps. A stage cannot be copied by :func:`copy.deepcopy`:
    put a new one behind a solver of the same model.

    Attributes:
        solver: The inner solver.
        respond: Whether the stage responds to collisions, or only reports them.
        mesh: The triangles that collide, :class:`ModelMesh`.
        report: What the stage found and did, :class:`.report.SolverReport`.
    """

    def __init__(
        self,
        solver: SolverBase,
        *,
        separation: float | None = None,
        friction: float | wp.array[float] | None = None,
        restitution: float | wp.array[float] | None = None,
        coupling: int | Literal["auto"] | None = None,
        bodies: bool | None = None,
        min_distance: float | None = None,
        radius: float | np.ndarray | wp.array | None = None,
        contact_layer: float | None = None,
        lift_speed_limit: bool = True,
        respond: bool = True,
    ):
        """Puts the stage behind a solver.

        Args:
            solver: Any Newton solver that moves particles.
            separation: Distance that contacts are moved apart [m]; default: 0.005 of the median edge length.
            friction: Coefficient of particles; default: the model's ``particle_mu``. Shapes have that of their
                material, contacts the geometric mean. May be an array of float32, of length 1 or of one for each
                particle, which each step reads again, and which may require gradients; so are then the coefficients of
                shapes, as with ``requires_grad``. Negative values count as 0.
            restitution: Share of the approaching velocity that comes back, in [0, 1]; default: the model's
                ``soft_contact_restitution``. May be an array of float32 of length 1, like friction.
            coupling: Substeps in which the inner solver takes a step that collides, 2 to 1024, so that it pulls
                against the contacts, see :mod:`.coupling`; None for none. ``"auto"`` takes a step again only where
                contacts strain cloth or soft bodies by more than 1% against the prediction of the inner solver, in up to
                32 substeps. The stage then resolves contacts of particles with shapes alone, also where ``contacts`` are
                passed to :meth:`step`: cloth rests at the shape, or with ``radius`` at that distance.
            bodies: Whether dynamic bodies are pushed: their poses and velocities change by mass and inertia, with
                friction and restitution, so that momentum is kept. Default: particles push them if the inner solver
                keeps bodies in maximal coordinates (VBD that integrates bodies, XPBD, semi-implicit); contacts between
                bodies are left to the inner solver, and those that its motion passes are counted, see
                ``report.body_contacts``. True: bodies are kept apart from each other and from static shapes as well, as
                their flags, groups and filters of collision say, and certified; this needs an inner solver that reads
                ``body_q`` and ``body_qd`` of the state. False: no body is pushed. Pushes by the stage take no body into
                an infinite plane that it collides with, nor deeper than it was or is predicted to be; with True, no
                motion does. Kinematic bodies, bodies without mass, static shapes and infinite planes are never pushed. Bodies
                that are all kinematic at construction stay so.
            min_distance: Distance that pairs keep [m], vertices from faces and edges from edges, and particles from
                infinite planes: a pair that started farther apart stays so, and one that started nearer does not come
                nearer. Neighbours, elements that an edge of the mesh joins, only do not touch. The stage moves pairs
                apart to this distance and ``separation``. Springs and particles that no face has take part. None or 0:
                pairs do not touch.
            radius: Radius of each particle [m], shape [particle_count], or one for all, such as
                ``model.particle_radius``: pairs keep the sum of their radii beside ``min_distance``. That of an edge or
                a face is the largest one of its vertices, that of a shape 0.
            contact_layer: Thickness of a layer around all surfaces [m], above their minimum distances, in which
                contacts push gradually, see :mod:`.contact_layer`; what it leaves is resolved where it hits. Results
                are then continuous in what the inner solver wants, and gradients hold across changes of the contacts.
                It should be thicker than the longest path of a step, and thinner than half of the shortest edge, as
                neighbours beyond the next push each other as well. Cloth rests on the layer, and should start outside
                of it: within a few steps, it is pushed out. None: contacts act where they hit.
            lift_speed_limit: Whether VBD with self-contact moves particles as its forces say, so that the stage alone
                keeps them apart. Otherwise VBD cuts the path of every particle, near something or not, see
                :mod:`.speed_limit`. Where its iterations are too few for the step, VBD does not hold heavy bodies, and
                only the limit brakes them: they sink faster without it, behind the stage or not. Has no effect on other
                solvers, and none without a response; ``report.speed_limit_lifted`` is true where it has.
            respond: Whether to respond to collisions. False detects and reports them, and changes no position and no
                velocity; separation, friction, restitution, coupling and bodies then have no meaning, and must not be
                given. With a minimum distance, it counts the pairs that come nearer than they may.

        Raises:
            TypeError: If an argument has another type.
            ValueError: If a number or the friction of a shape that collides with particles is out of range, or an
                argument is given without a response.
            NotImplementedError: If the model has shapes that are not supported, see :class:`ModelMesh`, or if a coupled
                solver is to be differentiated, or to have a contact layer.
        """
        check_instance(solver, "solver", SolverBase, "a solver of Newton")
        check_versions()
        respond, lift_speed_limit = checked_flag(respond, "respond"), checked_flag(lift_speed_limit, "lift_speed_limit")
        bodies = None if bodies is None else checked_flag(bodies, "bodies")
        coupling = self._checked_coupling(coupling)
        min_distance = 0.0 if min_distance is None else checked_distance(min_distance, "min_distance")
        for name, distance in (("separation", separation), ("contact_layer", contact_layer)):
            if distance is not None:
                checked_distance(distance, name, zero=False)
        self._lock = Occupied(type(self).__name__)
        self.solver = solver
        super().__init__(solver.model)
        self.collision_pipeline = solver.collision_pipeline
        self.supports_collision_pipeline = solver.supports_collision_pipeline
        self.supports_body_pair_reduced_contacts = solver.supports_body_pair_reduced_contacts
        model = solver.model
        self.respond = respond
        if not respond:
            numbers = {"separation": separation, "friction": friction, "restitution": restitution, "coupling": coupling}
            numbers |= {"bodies": bodies, "contact_layer": contact_layer}
            for name, value in numbers.items():
                if value is not None:
                    raise ValueError(f"{name} has no meaning without a response: omit it, or let respond be True")
        self._reads_friction = model.requires_grad or isinstance(friction, wp.array)
        most = float(np.finfo(np.float32).max)
        friction = model.particle_mu if friction is None else friction
        friction = self._coefficients("friction", friction, most, lengths=(1, model.particle_count))
        restitution = model.soft_contact_restitution if restitution is None else restitution
        restitution = self._coefficients("restitution", restitution, 1.0, lengths=(1,))
        if coupling is not None and model.requires_grad:
            raise NotImplementedError("coupled steps carry no gradients: omit coupling, or requires_grad")
        if contact_layer is not None and coupling is not None:
            raise NotImplementedError("coupled steps have no contact layer: omit coupling, or contact_layer")
        radii = radius.numpy() if isinstance(radius, wp.array) else 0.0 if radius is None else radius
        radii = checked_distances(radii, "radius", model.particle_count)
        keeps_distances = min_distance > 0.0 or bool(radii.any())
        self.mesh = mesh = ModelMesh(model, strands=keeps_distances)
        if separation is None:
            separation = SEPARATION * self._median_edge()
        if keeps_distances:
            mesh.keep_distances(min_distance, radii, reach=separation if respond else 0.0)
        self._moves_bodies = self._find_moves_bodies(bodies)
        self._motion = ModelMotion(
            mesh, self._friction(friction), moves_bodies=self._moves_bodies, responds_to_bodies=bodies is True
        )
        self._work = Workspace(
            mesh,
            separation=float(separation),
            restitution=restitution,
            differentiable=model.requires_grad,
            moves_bodies=self._moves_bodies,
            max_iterations=MAX_ITERATIONS,
        )
        self._motion.set_start(model.particle_q, model.body_q)
        self._motion.set_end(model.particle_q, model.particle_qd, model.body_q, 1.0, model.body_qd)
        self._prepare()
        self._recount_crossings()
        if not model.requires_grad:
            self._motion.remember(self._work.vertices.x1)
        self._limited = solver if respond and lift_speed_limit and has_speed_limit(solver) else None
        self._coupling = None
        if coupling is not None:
            self._inner_contacts = InnerContacts(mesh, moves_bodies=self._moves_bodies)
            choices = SUBSTEPS if coupling == "auto" else (coupling,)
            arguments = self._step_inner, solver, mesh, self._motion, self._work, choices
            self._coupling = Substeps(*arguments, moves_bodies=self._moves_bodies)
        no_substeps = wp.zeros(1, dtype=int, device=mesh.device)
        self._substeps = no_substeps if self._coupling is None else self._coupling.substeps
        self._recorder = StepRecorder(mesh.device, max_sweeps=MAX_SWEEPS_PER_STEP)
        lifts = self._limited is not None
        self.report = SolverReport(self._motion, self._work, self._substeps, responds=respond, lifts=lifts)
        self._layer = self._pushed = None
        if contact_layer is not None:
            self._layer = ContactLayer(
                mesh,
                self._motion.friction,
                thickness=float(contact_layer),
                restitution=restitution,
                distances=mesh.min_distances(min_distance, radii, reach=float(contact_layer)),
                layerless_steps=self.report._totals.layerless_steps,
            )
            self._layer.prepare(self._motion)

    @staticmethod
    def _checked_coupling(coupling):
        """Returns the argument ``coupling``: None, "auto" or a number of substeps."""
        if coupling is None or (isinstance(coupling, str) and coupling == "auto"):
            return coupling
        if isinstance(coupling, str):
            raise ValueError(f"coupling takes 2 substeps or more, or 'auto', not {given(coupling)}")
        return checked_integer(coupling, "coupling", 2, _MOST_SUBSTEPS)

    def _find_moves_bodies(self, bodies):
        """Returns whether the response can move bodies, as the argument ``bodies`` says."""
        model, mesh, solver = self.model, self.mesh, self.solver
        if not self.respond or bodies is False or not model.body_count:
            return False
        if bodies is None:
            integrates = isinstance(solver, SolverXPBD | SolverSemiImplicit | SolverVBD)
            if not integrates or has_external_rigid_solver(solver):
                return False
        shaped = np.unique(mesh.shape_vertices.body[mesh.shape_vertices.body >= 0])
        assert model.body_flags is not None and model.body_inv_mass is not None
        kinematic = (model.body_flags.numpy() & BodyFlags.KINEMATIC) != 0
        return bool(((model.body_inv_mass.numpy() > 0.0) & ~kinematic)[shaped].any())

    @property
    def _has_shapes_on_bodies(self):
        """Whether a vertex or a plane moves with a body."""
        return bool((self.mesh.shape_vertices.body >= 0).any() or (self.mesh.planes.body >= 0).any())

    def _coefficients(self, name, value, most, lengths):
        """Returns an argument that is a coefficient, or an array of some, as an array; checks it for the response."""
        if not isinstance(value, wp.array):
            values = np.full(1, checked_number(value, name))
        elif value.dtype is not wp.float32 or value.ndim != 1 or len(value) not in lengths:
            allowed = " or ".join(map(str, dict.fromkeys(lengths)))
            raise ValueError(f"{name} must be a number, or an array of float32 of length {allowed}")
        else:
            values = value.numpy()
        if self.respond and not ((values >= 0.0) & (values <= most)).all():
            limits = "in [0, 1]" if most == 1.0 else "at least 0, and finite in single precision"
            raise ValueError(f"{name} must be {limits}, not {value!r}")
        if isinstance(value, wp.array):
            return value
        return wp.array(values, dtype=float, device=self.model.device)

    def _friction(self, of_particles):
        """Returns the coefficients of vertices and of infinite planes."""
        model, mesh = self.model, self.mesh
        of_shapes = model.shape_material_mu
        if of_shapes is None:
            of_shapes = wp.zeros(0, dtype=float, device=mesh.device)
        values = of_shapes.numpy()
        for shape in np.union1d(mesh.shape_vertices.shape, mesh.planes.shape) if self.respond else ():
            if not values[shape] >= 0.0:
                raise ValueError(f"shape {shape} ({model.shape_label[shape]!r}) has friction {values[shape]}")
        return Friction(mesh, of_particles, of_shapes)

    def _prepare(self):
        """Resolves a motion to allocate buffers, which a CUDA graph cannot; clears the results."""
        resolve(self._work, self._motion, 1.0)
        for values in self._work.status_values:
            values.zero_()
        self._work.vertices.outcome.zero_()

    def _recount_crossings(self):
        """Makes the next step count the crossings at its start, even if it begins where the last one ended."""
        self._work.status.loop.recount.fill_(1)

    def _median_edge(self):
        """Returns the median edge length of cloth, soft bodies and ropes at rest [m]; 1 if they have no edges."""
        particle_q = self.model.particle_q
        rest = np.zeros((0, 3)) if particle_q is None else particle_q.numpy()
        edges = self.mesh.edges[self.mesh.edges[:, 1] < self.model.particle_count]
        lengths = np.linalg.norm(rest[edges[:, 1]] - rest[edges[:, 0]], axis=1)
        return float(np.median(lengths)) if lengths.any() else 1.0

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
        """Steps the inner solver, and changes positions and velocities of particles whose motion collides.

        Changes nothing after the inner solver if :attr:`respond` is False.

        Args:
            state_in: The state at the start; the inner solver may change it.
            state_out: The state at the end. May be the same.
            control: As for the inner solver.
            contacts: As for the inner solver. With ``coupling``, it gets those that the stage does not resolve only,
                see :mod:`.inner_contacts`.
            dt: Length of the step [s], more than 0.
            options: As for the inner solver.

        Raises:
            TypeError: If the length is no number.
            ValueError: If the length is not finite or not more than 0, or if a tape records gradients of the response,
                and both states are the same.
            NotImplementedError: If a tape records gradients of a response that keeps a minimum distance, or of one with
                a contact layer where shapes move with bodies.
            RuntimeError: If a tape records gradients in a CUDA graph, and it recorded no step outside one before.
            RuntimeError: If another thread is using this stage.
            NotImplementedError: If ``coupling="auto"`` is captured in a CUDA graph behind a solver that may allocate
                memory, such as ``SolverXPBD``.
        """
        checked_number(dt, "dt", 0.0, above=True)
        with paused_tape() as tape:
            if self.respond and tape is not None and state_in is state_out and self.model.requires_grad:
                raise ValueError("gradients need the state at the start: step into another state")
            if self.respond and tape is not None and self.model.requires_grad and self.mesh.distances is not None:
                raise NotImplementedError("steps that keep a distance carry no gradients: omit min_distance and radius")
            if tape is not None and self.model.requires_grad and self._layer is not None and self._has_shapes_on_bodies:
                raise NotImplementedError("a contact layer carries no gradients to poses of bodies: omit contact_layer")
            start = state_in if self._coupled is None else self._coupled.start_of(state_in)
            self._motion.set_start(start.particle_q, start.body_q)  # now: some solvers overwrite it
            if self._coupling is not None:
                self._coupling.save(state_in)
            passed = contacts
            if self._inner_contacts is not None:
                external = has_external_rigid_solver(self.solver)
                leaves_bodies = self._coupled is not None or not external
                contacts = self._inner_contacts.take_out(passed, state_in, leaves_bodies=leaves_bodies)
        self._step_inner(state_in, state_out, control, contacts, dt, **options)
        with paused_tape() as tape:
            if self._inner_contacts is not None:
                self._inner_contacts.unpack(getattr(options.get("observables"), "contact_f", None), passed)
            if self._coupling is not None:
                run_on_host(lambda: self._couple(state_out, control, contacts, dt), self.mesh.device)
            elif self.respond:
                self._respond(state_in, state_out, dt, tape)
            else:
                run_on_host(lambda: self._inspect(_arrays(state_out), dt), self.mesh.device)
            if self._coupled is not None:
                self._coupled.finish(state_out, self._motion.vertices, self._work.vertices)

    def _step_inner(self, *arguments, **options):
        """Steps the inner solver."""
        with contextlib.ExitStack() as stack:
            if self._limited:
                stack.enter_context(without_speed_limit(self._limited))
            if self._inner_contacts is not None:
                stack.enter_context(without_own_contacts(self.solver))
            self.solver.step(*arguments, **options)

    @one_at_a_time
    def _inspect(self, end, dt):
        """Detects the collisions of the motion from the start of the step to a state, and counts the step."""
        with self._timed():
            self._set_end(end, dt)
            resolution = inspect(self._work, self._motion)
            inputs, outputs = [resolution.vertices.outcome, self.model.particle_count], [resolution.status]
            self._launch(_finish_inspection, self.mesh.vertex_count, inputs, outputs)
            self._count_step(resolution)

    def _launch(self, kernel, size, inputs, outputs):
        wp.launch(kernel, size, inputs=inputs, outputs=outputs, device=self.mesh.device)

    def _respond(self, state_in, state_out, dt, tape):
        """Resolves the motion to a state, and changes it; a tape records the adjoint."""
        device = self.mesh.device
        end = _arrays(state_out)
        if tape is None or end.particle_q is None or not end.particle_q.requires_grad:
            run_on_host(lambda: self._resolve(end, dt), device)
            return
        recorded = pushed = None
        arrays = [state_in.particle_q, end.particle_q, end.particle_qd]
        if self.model.body_count:
            arrays += [state_in.body_q, end.body_q, end.body_qd]
        model, motion = self.model, self._motion
        read = [motion.friction.of_particles, motion.friction.of_shapes, self._work.restitution]
        read += [model.particle_inv_mass, model.body_inv_mass, model.body_inv_inertia, model.body_mass]
        read += [model.body_inertia, model.body_com]
        read = [array for array in read if array is not None and len(array) and array.requires_grad]

        def forward():
            nonlocal recorded, pushed
            resolution = self._resolve(end, dt, self._recorder)
            pushed, recorded = self._pushed, None
            if device.is_capturing or self._changed(resolution.vertices):
                recorded = RecordedStep(self._motion, resolution, self._recorder, dt)
                inputs, outputs = [self._recorder.record.counts, recorded.complete], [self.report._totals]
                self._launch(_count_record, 1, inputs, outputs)

        def backward():
            with self._lock:
                go_back()

        def go_back():
            if recorded is not None:
                StepAdjoint(recorded, self._work).backward(*(array.grad for array in arrays))
            if pushed is not None:
                assert self._layer is not None
                self._layer.backward(pushed, *(array.grad for array in arrays[:3]))

        run_on_host(forward, device)
        tape.record_func(lambda: run_on_host(backward, device), [*arrays, *read])

    def _changed(self, vertices):
        """Returns whether the response changed a particle or a body. Synchronizes with the device."""
        outcomes = [vertices.outcome, vertices.bodies.outcome] if self._moves_bodies else [vertices.outcome]
        return any(outcome.numpy().any() for outcome in outcomes)

    def _set_end(self, end, dt):
        self._motion.set_end(end.particle_q, end.particle_qd, end.body_q, dt, end.body_qd)

    @one_at_a_time
    def _resolve(self, end, dt, record=None):
        """Resolves the motion from the start of the step to a state, and changes it."""
        with self._timed():
            if self._reads_friction:
                self._motion.friction.read()
            self._set_end(end, dt)
            if self._layer is not None and end.particle_q is not None:
                arrays = end.particle_q, end.particle_qd
                self._pushed = self._layer.push(self._motion, *arrays, dt, record=record is not None)
            resolution = resolve(self._work, self._motion, dt, record)
            self._finish(resolution, end)
        return resolution

    @one_at_a_time
    def _couple(self, state, control, contacts, dt):
        """Resolves the motion from the start of the step to a state, in substeps if it collides, and changes it."""
        with self._timed():
            if self._reads_friction:
                self._motion.friction.read()
            self._set_end(_arrays(state), dt)
            assert self._coupling is not None
            resolution = self._coupling.resolve(state, control, contacts, dt)
            self._finish(resolution, _arrays(state))

    def _finish(self, resolution, end):
        """Writes a resolved motion to the arrays of a state, and counts the step."""
        vertices = resolution.vertices
        inputs = [vertices.outcome, vertices.x1, vertices.velocity]
        outputs = [end.particle_q, end.particle_qd, resolution.status]
        self._launch(_write_back, self.mesh.vertex_count, inputs, outputs)
        if self._moves_bodies:
            outputs = [end.body_q, end.body_qd, body_q_prev(self.solver), resolution.status]
            self._launch(_write_back_bodies, self.model.body_count, [vertices.bodies], outputs)
        self._count_step(resolution)

    def _count_step(self, resolution):
        self._launch(_count_step, 1, [resolution.status, self._substeps], [self.report._totals])

    @contextlib.contextmanager
    def _timed(self):
        """Measures the time of a step for the report; does nothing while capturing."""
        device = self.mesh.device
        if device.is_capturing:
            yield
            return

        def now():
            if device.is_cuda:
                return wp.record_event(wp.Event(device, enable_timing=True))
            return time.perf_counter()

        self.report._start = now()
        yield
        self.report._end = now()

    @one_at_a_time
    def notify_model_changed(self, flags: int) -> None:
        """Notifies the inner solver, and reads masses and flags of particles again; shapes stay as they were."""
        self.solver.notify_model_changed(flags)
        self.mesh.refresh_inverse_masses()
        self._recount_crossings()

    @property
    def contacts(self):
        """Delegates to the inner solver."""
        return self.solver.contacts

    @contacts.setter
    def contacts(self, value):
        self.solver.contacts = value

    @property
    def collision_frequency(self):
        """Delegates to the inner solver."""
        return self.solver.collision_frequency

    @property
    def collision_frequency_type(self):
        """Delegates to the inner solver."""
        return self.solver.collision_frequency_type

    @property
    def supported_observables(self):
        """Delegates to the inner solver."""
        return self.solver.supported_observables

    def set_collision_frequency(self, **options):
        """Delegates to the inner solver."""
        self.solver.set_collision_frequency(**options)

    def observables(self, *arguments, **options):
        """Delegates to the inner solver."""
        return self.solver.observables(*arguments, **options)

    def validate_observables(self, *arguments, **options):
        """Delegates to the inner solver."""
        return self.solver.validate_observables(*arguments, **options)

    @one_at_a_time
    def reset(self, state, world_mask=None, flags=None):
        """Resets the inner solver, and lets the next step of the worlds begin where its state is."""
        self.solver.reset(state, world_mask, flags)
        self._motion.interrupt(world_mask)

    def update_contacts(self, contacts, state=None):
        """Delegates to the inner solver."""
        inner = self._inner_contacts
        if inner is None:
            self.solver.update_contacts(contacts, state)
        else:
            self.solver.update_contacts(inner.packed(contacts), state)
            inner.unpack(contacts.force, contacts)

    def __deepcopy__(self, memo):
        """Raises a TypeError: buffers on the device, and graphs that write to them, cannot be copied."""
        raise TypeError(f"a {type(self).__name__} cannot be copied: put a new one behind a solver of the same model")

    def __getattr__(self, name):
        """Delegates other attributes to the inner solver."""
        if name == "solver":
            raise AttributeError(name)
        return getattr(self.solver, name)


class CollisionMonitor(SolverCCD):
    """Lets another solver step, and reports the collisions of its motion; changes no bit of its results.

    The plain name of ``SolverCCD(solver, respond=False)``, and nothing more. Each step costs one detection. The
    certificate is that of :class:`SolverCCD`: a certified step is free of collisions, except for those of elements that
    crossed or touched at its start. The :attr:`report` counts a contact among its ``hits`` in the step that passes it.
    Elements that cross from then on are counted in ``crossings``, and their contacts as ``excluded``.
    """

    def __init__(self, solver: SolverBase):
        """Puts the monitor behind a solver.

        Args:
            solver: Any Newton solver that moves particles.

        Raises:
            TypeError: If it is no solver of Newton.
            NotImplementedError: If the model has shapes that are not supported, see :class:`ModelMesh`.
        """
        super().__init__(solver, respond=False)
