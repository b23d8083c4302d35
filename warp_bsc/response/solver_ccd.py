"""The collision stage for Newton: a solver that wraps another one, and makes its motion free of collisions."""

from collections.abc import Collection, Mapping
from typing import Literal, get_args

import numpy as np
import warp as wp
from newton.solvers import SolverBase, SolverStyle3D, SolverVBD

from .._arguments import checked_choice, checked_integer
from .._one_thread import one_at_a_time
from .._private_names.of_newton import body_q_prev
from ..detection.run.host_function import run_on_host
from .drive.inner_steps import InnerSteps
from .drive.style3d_springs import SpringSteps
from .drive.substeps import Substeps
from .options import (
    MAX_SUBSTEPS,
    Bodies,
    Inversions,
    Reported,
    checked_friction,
    checked_report,
    checked_restitution,
    checked_separation,
    default_separation,
    friction_of,
    moves_bodies,
)
from .report.forces.contact_forces import ContactForces
from .report.forces.contact_report import ContactReport
from .report.strain import StrainMeter
from .stage import CollisionStage
from .state.collision_filter import CollisionFilter, checked_filter
from .state.friction_table import FrictionTable
from .state.kept_distances import KeptDistances
from .state.mesh import ModelMesh
from .state.motion import ModelMotion, arrays_of
from .state.status import Loop
from .step import resolve, resolve_inversions
from .tuning import MAX_ITERATIONS
from .wrapped_solver import innermost
from .write_back import write_back

_PASSED_ON = "the inner solver has all contacts that were passed on"


class SolverCCD(CollisionStage):
    """Lets another solver step, then makes the motion that it predicted free of collisions.

    For cloth and soft bodies take :class:`warp_bsc.SolverImplicit`, which sees its contacts; this stage goes behind
    whatever solver there is: one step of that solver, then the contacts of its motion are detected and resolved.

    Cloth and the surfaces of soft bodies do not pass through each other, themselves, or rigid shapes that collide with
    particles. Particles push dynamic bodies back, see ``bodies``. All other attributes are those of the inner solver.

    A step is certified if its motion, as stored, is free of collisions. Excluded from the certificate are pairs of
    elements that cross or touch at the start of the step, vertices that begin in the solid of an infinite plane, and
    contacts of which no vertex can be moved: these are delegated to the inner solver. A particle whose predicted
    position or velocity is not finite, in the step or a substep, stays where it was; neither such a step nor one with a
    start position that is not finite is certified, in ``report.worlds`` the world of the particle alone.

    A kinematic particle or body that a program moves between two steps takes that way in the second step: it starts
    where the last step ended, and in the first step where the model puts it (``particle_q``, ``body_q``). If a movable
    particle has been moved as well, its world was set to another state, and starts there. So does everything after
    :meth:`reset`. A body that ``joint_q`` of the model puts elsewhere than ``body_q`` starts the first step where the
    state has it.

    The certificate covers the motion from the stored state at the start to the stored state at the end, of a step with
    ``substeps`` the motion in each of them: particles move straight, and bodies turn evenly, the shorter way, so that
    their vertices move on arcs, see ``state.turns``. A body that the response can move turns about its centre of mass,
    others about the axis of their screw. A body whose predicted pose or velocity is not finite is delegated to the
    inner solver, and the step is not certified.

    With ``min_distance`` or ``particle_radius`` the certificate is of distances: a pair that started farther apart
    stays at its minimum distance, and one that started closer comes no closer, beyond rounding (2^-20 of that distance
    and 2^-38 of the largest difference of coordinates of the pair). Pairs that touch at the start are excluded, and
    elements that an edge of the mesh joins only do not touch.

    A step carries no gradients: on a :class:`warp.Tape`, with a model that requires them, it raises
    NotImplementedError. Steps of :class:`warp_bsc.SolverImplicit` do.

    A step builds on the one before. A second thread that calls the stage while one is in it gets a RuntimeError: use
    one stage for each thread. Warp and Newton load their kernels in the first steps that need them, which two threads
    must not do at the same time: let one thread take first steps. A stage cannot be copied by :func:`copy.deepcopy`:
    put a new one behind a solver of the same model.

    Limitations:
        The stage follows the inner solver, which does not see the contacts, except for Style3D: where something pushes,
        steps must be short against the time of sound through an element, or contacts stretch elements. Shorter steps,
        or ``substeps``, stretch them less; ``report.strain`` says by how much they do.

    Attributes:
        solver: The inner solver.
        mesh: The triangles that collide, :class:`.state.mesh.ModelMesh`.
        report: What the stage found and did, :class:`.report.SolverReport`.
        separation: Distance that contacts are moved apart [m].
        friction: Coefficients of particles, Warp array of float, shape [1] or [particle_count].
        restitution: Share of the approaching velocity that comes back, Warp array of float, shape [1].
        substeps: Steps of the inner solver in a step, each with its contacts.
        max_iterations: Iterations of detect and project.
        work: The buffers of a step, ``state.workspace.Workspace``.
    """

    _near = 1.0  # share of the separation within which pairs near their distance are moved apart like contacts

    def __init__(
        self,
        solver: SolverBase,
        *,
        separation: float | None = None,
        friction: float | wp.array[float] | FrictionTable | None = None,
        restitution: float | wp.array[float] | None = None,
        substeps: int = 1,
        bodies: Bodies = "pushed",
        min_distance: float | Literal["model"] | wp.array[float] | None = None,
        particle_radius: float | np.ndarray | wp.array | None = None,
        collision_filter: CollisionFilter | None = None,
        inversions: Inversions = "allowed",
        max_iterations: int = MAX_ITERATIONS,
        report: Collection[Reported] | Mapping[Reported, int] = (),
    ):
        """Puts the stage behind a solver.

        Args:
            solver: Any Newton solver that moves particles.
            separation: Distance that contacts are moved apart [m]; default: 0.005 of the median edge length.
            friction: Coefficient of particles, at least 0; default: the model's ``particle_mu``. Shapes have that of
                their material, contacts the geometric mean. May be an array of float32, of length 1 or
                [particle_count]: each step reads it, and the coefficients of shapes, again. Negative values
                count as 0. A :class:`.state.friction_table.FrictionTable` has coefficients by pair of materials.
            restitution: Share of the approaching velocity that comes back, in [0, 1]; default: the model's
                ``soft_contact_restitution``. May be an array of float32 of length 1, like friction.
            substeps: Number of smaller steps of equal length in a step, 1 to 1024, each a step of the inner solver with
                the response to its contacts, see :mod:`.substeps`. The report is of all of them together. Coupled
                solvers raise NotImplementedError for more than one, as their entries take substeps themselves.
            bodies: What happens to dynamic bodies. ``"pushed"``: particles push them, by mass and inertia, with
                friction and restitution, so that momentum is kept, if the inner solver keeps bodies in maximal
                coordinates (VBD that integrates bodies, XPBD, semi-implicit). Contacts between bodies are delegated to
                the inner solver; ``report.body_contacts`` counts those that its motion passes. ``"separated"``: bodies
                are also kept apart from each other and from static shapes, as their flags, groups and filters of
                collision say, and certified; the inner solver must read ``body_q`` and ``body_qd`` of the state.
                ``"ignored"``: no body is pushed. The stage pushes no body into an infinite plane that it collides with,
                nor deeper than it was or is predicted to be; with ``"separated"``, no motion takes it there. Kinematic
                bodies, bodies without mass, static shapes and infinite planes are never pushed. If all bodies are
                kinematic at construction, they stay so.
            min_distance: Distance that pairs keep [m], vertices from faces and edges from edges, and particles from
                infinite planes: a pair that started farther apart stays so, and one that started closer comes no
                closer. Neighbours, elements that an edge of the mesh joins, only do not touch. The stage moves pairs
                apart to this distance and ``separation``. Springs and particles without faces take part. None or 0:
                pairs do not touch, and springs and particles without faces take no part; None warns where there are
                some that could meet something. ``"model"``: pairs keep the thickness that the model has, the radii of
                particles, or ``particle_radius`` where that is given, and the margins of shapes
                (``model.shape_margin``). Or a Warp array of float32 of length 1, which each step reads again, as it
                does radii and margins of a model that requires gradients; what is negative or NaN counts as 0.
            particle_radius: Radius of each particle [m], shape [particle_count], or one for all: pairs keep the sum of
                their radii beside ``min_distance``. That of an edge or a face is the largest one of its vertices, that
                of a shape 0, or its margin with ``min_distance="model"``. A Warp array must be of float32, and each
                step reads it again.
            collision_filter: Groups and masks of particles and shapes: pairs that they leave out are delegated to the
                inner solver, also if ``contacts`` are passed to :meth:`step`, see
                :class:`.state.collision_filter.CollisionFilter`. None for none. Shapes that do not collide with
                particles by their flags are left out in any case, pairs of shapes as ``bodies`` says.
            inversions: What happens to tetrahedra whose volume becomes, or may become, 0 or negative at a time of the
                step. ``"allowed"``: nothing. ``"reported"``: ``report.inverting`` counts those of the step as it is
                stored. ``"prevented"``: the paths of their vertices are cut as well, as they are for collisions, and a
                step with one that remains is not certified. Tetrahedra that were inverted at the start remain so, and
                are counted apart (``report.inverted_at_start``).
            max_iterations: Iterations of detect and project, 0 to 40; what still collides then is divided, see
                :mod:`.schedule`. Fewer bound the time of a step, and leave more vertices with cut paths.
            report: What the report of a step has beside its results. ``"contacts"``: contacts and their impulses, see
                :class:`.forces.contact_report.ContactReport`. ``"worlds"``: results by world, see
                :class:`.report.worlds.Worlds`. At most 8 contacts for each particle, or 4,096 if that is more, are
                listed in each substep; a mapping gives another number for the step: ``{"contacts": 20_000,
                "worlds": True}``. Sums have the contacts beyond that too.

        Raises:
            TypeError: If an argument has another type.
            ValueError: If a number, or the friction of a shape that collides with particles, is out of range.
            NotImplementedError: If the model has shapes that are not supported, see :class:`.state.mesh.ModelMesh`.
        """
        super().__init__(solver)
        separation, bodies = checked_separation(separation), checked_choice(bodies, "bodies", get_args(Bodies))
        self.friction, table, self._reads_friction = checked_friction(friction, self.model)
        self.restitution = checked_restitution(restitution, self.model)
        self.substeps = checked_integer(substeps, "substeps", 1, MAX_SUBSTEPS)
        self.max_iterations = checked_integer(max_iterations, "max_iterations", 0, MAX_ITERATIONS)
        inversions = checked_choice(inversions, "inversions", get_args(Inversions))
        distances = KeptDistances.of(self.model, min_distance, particle_radius, of_strands=self._keeps_strands)
        collision_filter = checked_filter(collision_filter, self.model)
        listed_contacts, counts_worlds = checked_report(report, self.model, self.substeps)
        of_mesh = {"separates_bodies": bodies == "separated", "uses_margins": distances.has_fixed_margins}
        mesh = ModelMesh(self.model, strands=distances.any, collision_filter=collision_filter, **of_mesh)
        self._warn_of_unseen(mesh, distances)
        self.separation = default_separation(mesh) if separation is None else separation
        if distances.any:
            mesh.keep_distances(distances, reach=self._near * self.separation)
        integrator = innermost(solver)
        moves, responds = moves_bodies(bodies, mesh, integrator), bodies == "separated"
        coefficients = friction_of(mesh, self.friction, table=table)
        motion = ModelMotion(mesh, coefficients, moves_bodies=moves, responds_to_bodies=responds, watches_turns=True)
        self._allocate(motion, self.separation, self.restitution, max_iterations=self.max_iterations)
        self.work.watch_inversions(inversions)
        self._meter = StrainMeter(self.work)
        self._inner = self._choose_steps(integrator)
        self._forces: ContactForces | None = None
        if listed_contacts:
            self._forces = forces = ContactForces(self.work, listed_contacts)
            self.report.keep_forces(ContactReport(self.model, forces.rows, forces.published, forces.shapes_of_worlds))
        self.report.impulses_elsewhere = self._inner.pushes_before
        if counts_worlds:
            self._count_worlds(None if self._forces is None else self._forces.published.max_impulse)
        self._prepare_entry()

    def _choose_steps(self, integrator):
        """Returns how the inner solver takes steps."""
        steps = InnerSteps(self)
        if isinstance(self.solver, SolverStyle3D):
            steps = SpringSteps(self, self.work)
        elif isinstance(integrator, SolverVBD) and integrator.particle_enable_self_contact:
            steps.pushes_before = "SolverVBD has self-contact"
        if self.substeps == 1:
            return steps
        return Substeps(steps, self._motion, self.substeps, integrator=integrator)

    def _check_tape(self, state_in, state_out, mask):
        raise NotImplementedError(
            "steps of SolverCCD carry no gradients, and the model requires them: take SolverImplicit, whose steps do, "
            "or step outside the tape"
        )

    def coupling_notify_iteration_restarts(self, enabled: bool) -> None:
        """Prepares for a coupled simulation, see :class:`.drive.coupling.CouplingHooks`.

        Raises:
            NotImplementedError: If a step has substeps: proxies would not follow them.
        """
        if self.substeps > 1:
            raise NotImplementedError(
                f"substeps={self.substeps} of SolverCCD in a coupled solver: give them to its SolverCoupled.Entry"
            )
        super().coupling_notify_iteration_restarts(enabled)
        self._inner = InnerSteps(self)  # springs would push proxies without a feedback

    def _resolve(self, step):
        has_some = step.contacts is not None and step.contacts.soft_contact_max > 0
        self.report.impulses_elsewhere = self._inner.pushes_before or (_PASSED_ON if has_some else None)
        self._resolve_end(step, arrays_of(step.state_out))

    def _resolve_end(self, step, end):
        run_on_host(lambda: self._resolve_motion(step, end), self.mesh.device)

    @one_at_a_time
    def _resolve_motion(self, step, end):
        """Resolves the motion from the start of a step to its end, as it was predicted, and changes the end."""
        if self._reads_friction:
            self._motion.friction.read()
        if self._forces is not None:
            self._forces.end(end, step.mask)
        with self._prepared(step, end):
            self._solve(step, end)
            if step.is_first:
                self.report.last_strain.zero_()
            self._measure_strain()
            resolve_inversions(self.work, step.dt)
            self._write_end(step, end)

    def _solve(self, step, end):
        """Makes the motion free of its contacts, see :func:`.step.resolve`."""
        resolve(self.work, step.dt)

    def _measure_strain(self):
        """Measures the strain by contacts of a whole step, for the report."""
        motion, strain = self._motion.vertices, self.report.last_strain
        wp.capture_if(
            self.work.loop[Loop.UNFINISHED], self._meter.measure, motion=motion, before=motion.x1, strain=strain
        )

    def _write_end(self, step, end):
        """Writes the resolved motion to the arrays of a state, and publishes the contacts."""
        size = max(self.mesh.vertex_count, self.model.body_count)
        poses = body_q_prev(self.solver) if self._motion.moves_bodies else None
        outputs = [end, poses, self.work.status]
        self.work.launch(write_back, size, [self.work.vertices], outputs)
        if self._forces is not None:
            self._forces.publish(step.number, step.count)

    def _follow_shapes(self):
        self._motion.friction.read_shapes(self.model)
        super()._follow_shapes()
