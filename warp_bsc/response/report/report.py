"""The report of the collision stage: what it found and did, read from the device on access."""

import functools
from collections.abc import Callable
from dataclasses import fields
from typing import Any

import numpy as np
import warp as wp
from newton.viewer import ViewerBase

from ..._arguments import check_instance, checked_number
from ...detection.at_rest.intersections import find_intersections
from ...detection.run.phase_timer import PhaseTimer
from ..state.status import Result, views_of
from ..state.structs import FROZEN, NOT_FINITE, TRUNCATED, UNCERTIFIED, ContactKind
from ..state.workspace import Workspace
from .count_steps import StepResults
from .drawing import Drawing
from .forces.contact_report import ContactReport
from .inside import Inside, InsideFinder
from .outcomes import Outcomes
from .step_warnings import StepWarnings
from .text import line_of
from .totals import Penetrated, StepTotals, Totals
from .worlds import Worlds

_NOT_DRAWN = 'report.draw draws contacts only if a stage keeps them: SolverCCD(solver, report=["contacts"])'
_INCOMPLETE = 'report.draw lacks contacts: allow more of them than now, report={"contacts": number}'
_NO_CONTACTS = 'a stage keeps contacts only if it is asked to: SolverCCD(solver, report=["contacts"])'
_NO_WORLDS = 'a stage counts worlds only if it is asked to: pass report=["worlds"]'
_NOT_WATCHED = "a stage counts inversions only if it is asked to: pass inversions='reported' or 'prevented'"


class SolverReport:
    """Results of the steps of a :class:`.solver_ccd.SolverCCD`; reading one synchronizes with the device.

    Of steps that are not certified, are not finite, strain, cross or invert something it warns once each.

    :attr:`totals` are sums over all steps so far; all others are of the last step. In a
    step with substeps, numbers are sums over these, but for :attr:`crossings` and :attr:`inverted_at_start`, the most
    at the start of one. It is certified if all of them are; a vertex counts as truncated, frozen, not finite or
    uncertified if it is in any.

    Without a response (:class:`.monitor.CollisionMonitor`) the motion that the inner solver predicted is the motion
    that is stored: :attr:`remaining` equals :attr:`predicted_contacts`, a step is certified if both are 0, and nothing
    is truncated or frozen.

    Attributes:
        step_results: What the last step did, on the device, which the other attributes read.
        outcomes: What became of each vertex and body in it, read on the host.
        impulses_elsewhere: What resolves contacts before the stage in the last step, so that its impulses on them are
            small; None if nothing is known to.
    """

    impulses_elsewhere: str | None = None
    strain_cause: str = ", as its solver does not see the contacts, or its iterations are too few for the step"
    shorter_steps: str = "take shorter steps, or raise substeps"
    strain_advice: str = f"give it more iterations, {shorter_steps}, or step cloth and soft bodies by SolverImplicit"

    def __init__(self, work: Workspace, *, responds: bool = True):
        """Reports on the steps in which a response resolves a motion, or only inspects it."""
        self._motion, self._work, self._mesh, self.responds = work.motion, work, work.mesh, responds
        self.model, self.shape_of_vertices = work.mesh.model, work.mesh.shape_vertices.shape
        self.step_results = StepResults()
        self.step_results.results = wp.zeros(len(Result), dtype=int, device=work.device)
        self.step_results.of_vertices = wp.zeros_like(work.vertices.outcome)
        self.step_results.of_bodies = wp.zeros(work.body_count, dtype=int, device=work.device)
        self.outcomes = Outcomes(work.mesh, self.step_results)
        self.last_strain = wp.zeros(work.worlds, dtype=float, device=work.device)  # by world
        self.set_steps = wp.zeros(work.body_count, dtype=int, device=work.device)  # of bodies, see find_set_bodies
        self.total_values = wp.zeros(len(StepTotals.vars), dtype=wp.int64, device=work.device)
        self.device_totals = views_of(StepTotals, self.total_values)
        self._host_totals = wp.zeros(len(StepTotals.vars), dtype=wp.int64, device="cpu", pinned=work.device.is_cuda)
        self._warnings = StepWarnings(self)
        self._forces: ContactReport | None = None
        self._worlds: Worlds | None = None
        self.coupled: Any = None  # the check of steps in the state of the program, of an entry of a coupled solver
        self.timers: list[PhaseTimer] = []  # of each substep of the last step

    def copy_totals(self) -> None:
        """Copies the totals to the host, without waiting for the device, also in a CUDA graph."""
        wp.copy(self._host_totals, self.total_values)

    def warn(self) -> None:
        """Warns once each of steps with predictions that are not finite, and of others that are not certified.

        So it does of strain above 0.2, crossings, inversions and dynamic bodies that a program moves.

        Known is what the host knows already; the device is only waited for to warn. A step on a GPU may end before the
        host knows of it: then the next one warns, or the first number that is read, which waits for the device.
        """
        self._warnings.warn(dict(zip(StepTotals.vars, self._host_totals.numpy(), strict=True)))

    def leave_state_to_other_stage(self) -> None:
        """Makes the report warn of no step that is not certified in the state of the program alone.

        A stage around the coupled solver says so of what it makes of that state.
        """
        self._warnings.leave_out("revoked")

    def keep_forces(self, forces: ContactReport) -> None:
        """Makes the report have contacts and impulses."""
        self._forces = forces

    def keep_worlds(self, worlds: Worlds) -> None:
        """Makes the report have results by world."""
        self._worlds = worlds

    @property
    def forces(self) -> ContactReport:
        """The contacts of the last step and their impulses, on the device.

        Raises:
            RuntimeError: If the stage was not asked to keep contacts.
        """
        if self._forces is None:
            raise RuntimeError(_NO_CONTACTS)
        return self._forces

    @property
    def worlds(self) -> Worlds:
        """Results of the last step by world, on the device.

        Raises:
            RuntimeError: If the stage was not asked for them.
        """
        if self._worlds is None:
            raise RuntimeError(_NO_WORLDS)
        return self._worlds

    def _read(self, values):
        """Returns the largest number of an array, and warns: the totals were copied before, on the same stream."""
        value = values.numpy().max().item()
        self.warn()
        return value

    def _read_result(self, result):
        """Returns one of the results of the last step, and warns."""
        return self._read(self.step_results.results[result : result + 1])

    @property
    def certified(self) -> bool:
        """Whether detection found the motion of the last step, as stored, to be free of collisions.

        With minimum distances, a collision is a pair that comes nearer than it may, here and in what follows.

        Contacts that :attr:`excluded` counts, pairs that filters leave out (:attr:`filtered`), and contacts of which no
        vertex can be moved, are not part of this. A step with a position or velocity that is not finite, at the start
        or as it is predicted, is not certified. With ``inversions="prevented"``, :attr:`inverting` is 0 in a certified
        step. :attr:`uncertified_vertices` lists the particles concerned. Behind a coupled
        solver, a step is not certified until its end in the state of the program is seen, see :class:`.CouplingHooks`.
        """
        return bool(self._read_result(Result.CERTIFIED))

    @property
    def predicted_contacts(self) -> int:
        """Contacts of the motion that the inner solver predicted in the last step, without those excluded."""
        return self._read_result(Result.FIRST_HITS)

    @property
    def remaining(self) -> int:
        """Contacts that the motion of the last step has as it is stored.

        With a response, they could not be resolved, because kinematic vertices leave no space.
        """
        return self._read_result(Result.REMAINING)

    @property
    def excluded(self) -> int:
        """Contacts of the motion of the last step that were delegated to the inner solver.

        Their elements crossed or touched at the start of the step, or their vertex began in the solid of a plane.
        """
        return self._read_result(Result.EXCLUDED)

    @property
    def filtered(self) -> int:
        """Pairs that filters left out of the last step, so that its certificate does not cover them.

        These are the pairs that ``collision_filter`` leaves out and whose boxes overlap in the motion that the inner
        solver predicted, near each other or not, but for those of static shapes alone, and particles in solids of
        infinite planes that it leaves out. With
        ``bodies="separated"`` particles count with shapes that collide with shapes alone. If the response moves bodies,
        so do contacts of shapes whose flags, groups or ``shape_collision_filter_pairs`` keep them from colliding. In a
        CUDA graph the number is a lower bound if its queues are too small. :attr:`worlds` has the numbers by world.
        """
        return self._read_result(Result.FILTERED)

    @property
    def body_contacts(self) -> int:
        """Contacts between bodies in the motion of the last step as it is stored, delegated to the inner solver.

        These are pairs of meshes that are to collide, of two bodies, or of a body and a static shape, without elements
        that crossed or touched at the start of the step. If it is 0, their motion is certified as well. It is also 0 if
        the response moves no bodies, and counts nothing that it keeps apart (``bodies="separated"``).
        """
        return self._read_result(Result.BODY_CONTACTS)

    @property
    def crossings(self) -> int:
        """Edges that cross faces at the start of the last step, pair by pair, as far as a vertex of theirs can move.

        Only pairs that floating point certifies to cross count; :attr:`intersections` lists all of them. In a CUDA
        graph the number is a lower bound if there are more candidates than its queues hold. Behind a coupled solver,
        it is at least that of the state of the program at the start of the last step whose end was seen.
        """
        crossings = self._read_result(Result.CROSSINGS)
        return crossings if self.coupled is None else max(crossings, self.coupled.crossings)

    @property
    def inverting(self) -> int:
        """Tetrahedra that the motion of the last step as it is stored inverts, or may invert.

        Counted are those whose volume certainly was positive at the start, and is not certainly positive in the whole
        step. Those of which no vertex can be moved are left out.

        Raises:
            RuntimeError: If the stage was not asked to count them.
        """
        return self._read_inversions(Result.INVERTING)

    @property
    def inverted_at_start(self) -> int:
        """Tetrahedra whose volume at the start of the last step was 0 or negative, or not certainly positive.

        No cut of a path changes that, and they are delegated to the inner solver. Those of which no vertex can be moved
        are left out.

        Raises:
            RuntimeError: If the stage was not asked to count them.
        """
        return self._read_inversions(Result.INVERTED)

    def _read_inversions(self, result):
        if self._work.tetrahedra is None:
            raise RuntimeError(_NOT_WATCHED)
        return self._read_result(result)

    @property
    def not_finite(self) -> int:
        """Particles whose position or velocity was not finite after the inner solver in the last step, or a substep.

        They stood where they were at its start, and the step is not certified. Without a response they stay as the
        inner solver made them.
        """
        count = int(np.count_nonzero(self.outcomes.find(NOT_FINITE)[: self._mesh.model.particle_count]))
        self.warn()
        return count

    @property
    def uncertified_vertices(self) -> np.ndarray:
        """Particles that the certificate of the last step lacks, sorted, int32, shape [n]; empty if it is certified.

        They are the particles of contacts that remain, of tetrahedra that invert where that is prevented, of elements
        with a start position that is not finite, and those that :attr:`not_finite` counts. Vertices of rigid shapes
        are not listed, so that the array is also empty if nothing but the position of a body is not finite. Gathered on
        the host, on each access.
        """
        listed = self.outcomes.find_uncertified()[: self._mesh.model.particle_count]
        self.warn()
        return np.flatnonzero(listed).astype(np.int32)

    @property
    def uncertified_bodies(self) -> np.ndarray:
        """Bodies that the certificate of the last step lacks, sorted, int32, shape [n]; empty if it is certified.

        They are bodies of contacts that remain, if the response moves bodies, and those without a finite pose or
        velocity. Behind a coupled solver, they are also bodies of other entries, all until the end of the step is seen.
        Gathered on the host, on each access.
        """
        model = self._mesh.model
        if self.certified or not model.body_count:
            return np.empty(0, dtype=np.int32)
        first = model.particle_count
        bodies = np.unique(self._mesh.shape_vertices.body[self.outcomes.find(UNCERTIFIED)[first:]])
        if self.coupled is not None:
            bodies = np.union1d(bodies, self.coupled.find_bodies())
        return bodies[bodies >= 0].astype(np.int32)

    @property
    def iterations(self) -> int:
        """Iterations of detection and projection, division or truncation in the last step; 0 without a response."""
        return self._read_result(Result.ITERATIONS)

    @property
    def truncated(self) -> int:
        """Vertices and bodies whose paths were truncated in the last step, so that they stay on their side."""
        return self._count(TRUNCATED)

    @property
    def frozen(self) -> int:
        """Vertices and bodies that were frozen where they were at the start of the last step."""
        return self._count(FROZEN)

    @property
    def intersections(self) -> np.ndarray:
        """Edges and faces of the solver's ``mesh`` that meet at the start of the last step, int32, shape [n, 2].

        Pairs of rigid shapes are left out, those of kinematic particles are not. Touching counts. Computed on each
        access, in exact arithmetic; :attr:`crossings` is a number that costs less.

        Raises:
            ValueError: If a position at the start is not finite.
        """
        mesh = self._mesh
        particles = mesh.model.particle_count
        pairs = find_intersections(mesh, self._motion.vertices.x0)
        of_particles = [elements.min(axis=1) < particles for elements in (mesh.edges, mesh.faces)]
        return pairs[of_particles[0][pairs[:, 0]] | of_particles[1][pairs[:, 1]]]

    @property
    def inside(self) -> Inside:
        """Particles inside rigid shapes, soft bodies or the solids of infinite planes at the end of the last step.

        What has passed a surface wholly, in a step that was not certified or in a start that a program has set, crosses
        nothing any more: later steps are certified, and leave it where it is. See :class:`.inside.InsideFinder` for
        what counts. Computed on each access, on the host.
        """
        return self._inside_finder.find(*self._placed)

    def find_shapes_at(self, particles: np.ndarray) -> np.ndarray:
        """Returns the shapes that have a constraint with one of some particles, in the last substep, sorted."""
        constraints, first = self._work.constraints, self.model.particle_count
        count, names = int(constraints.count.numpy()[0]), ("vertices", "kind", "plane")
        corners, kind, plane = (getattr(constraints, name).numpy()[:count] for name in names)
        at = np.isin(corners, particles).any(axis=1)
        of_planes = self._motion.planes.shape.numpy()[plane[at & (kind == ContactKind.PLANE)]]
        return np.union1d(of_planes, self.shape_of_vertices[corners[at][corners[at] >= first] - first])

    @property
    def penetrated(self) -> Penetrated:
        """What passed through something, in the last step and so far: false if nothing did.

        It is about triangles, springs and particles that take part, and pairs that no filter leaves out. With minimum
        distances, a pair that came nearer than it may counts as passed. What crosses in a first step is not counted,
        :attr:`crossings` has it; nor is a surface that a program puts wholly on the other side of another between two
        steps, unless it is inside a solid then. Computed on each access, on the host.
        """
        crossed = self._read_result(Result.NEW_CROSSINGS)
        inside = len(np.unique(self.inside.particles))
        return Penetrated(self.remaining, crossed, inside, self.totals.penetrated_steps)

    @functools.cached_property
    def _inside_finder(self):
        return InsideFinder(self._mesh)

    @property
    def _placed(self):
        return self._work.vertices.x1, self._motion.planes.end

    def find_inside_by_world(self) -> Callable[[], np.ndarray]:
        """Returns a function that counts the particles inside solids at the end of the last step in each world."""
        return functools.partial(self._inside_finder.count_by_world, *self._placed)

    @property
    def milliseconds(self) -> float | None:
        """Time of the last step that was not captured [ms]; None if there was none.

        Without the inner solver.
        """
        return sum(sum(timer.read().values()) for timer in self.timers) if self.timers else None

    @property
    def strain(self) -> float:
        """Largest strain of an edge by the contacts of the last step, beyond what the inner solver predicted.

        That is the elongation of an edge of a triangle or a spring beyond its length at rest, or a quarter of its
        compression, and the change of length of an edge in a soft body, as a share of its length at rest. Of a step in
        substeps, it is the largest of a substep.
        """
        return self._read(self.last_strain)

    @property
    def totals(self) -> Totals:
        """Totals over all steps so far, as of this access."""
        totals = dict(zip(StepTotals.vars, self.total_values.numpy().tolist(), strict=True))
        self.warn()
        return Totals(**{field.name: totals[field.name] for field in fields(Totals)})

    def draw(self, viewer: ViewerBase, *, impulse_scale: float | None = None) -> None:
        """Draws the last step in a frame of a viewer: call it between ``begin_frame`` and ``end_frame``.

        It draws normals of contacts as green lines, their impulses on the first of both elements as magenta arrows,
        truncated vertices in orange, frozen ones in blue, and those that the certificate lacks in red. Minimum
        distances are transparent shells around all surfaces, which touch where two are as near as they may come. All is
        where the step ended, under ``/ccd``, and without the offsets of worlds and layers of a viewer, as Newton draws
        cloth. Synchronizes with the device.

        Args:
            viewer: Any viewer of Newton.
            impulse_scale: Length of an arrow by its impulse [m/(N s)]; None for one by which nine of ten arrows are at
                most two median edges long, in the steps that were drawn so far.

        Raises:
            TypeError: If an argument has another type.
            ValueError: If ``impulse_scale`` is not more than 0.
        """
        check_instance(viewer, "viewer", ViewerBase, "a viewer of Newton")
        if impulse_scale is not None:
            impulse_scale = checked_number(impulse_scale, "impulse_scale", 0.0, above=True)
        contacts = None
        if self._forces is not None:
            contacts = self.forces.contacts.numpy()
            if not self.forces.contacts.complete:
                self._warnings.once("undrawn", lambda: _INCOMPLETE)
        elif self.responds:
            self._warnings.once("undrawn", lambda: _NOT_DRAWN)
        vertices = {"truncated": self.outcomes.find(TRUNCATED), "frozen": self.outcomes.find(FROZEN)}
        vertices["uncertified"] = self.outcomes.find_uncertified()
        self._drawing.draw(viewer, self._work.vertices.x1.numpy(), contacts, vertices, impulse_scale)

    @functools.cached_property
    def _drawing(self):
        return Drawing(self._mesh)

    def __str__(self) -> str:
        """Returns the steps so far in one line, what crosses at the start of the last, and is inside solids at its end.

        Searches for what is inside, on the host.
        """
        return line_of(self)

    @property
    def prevents_inversions(self) -> bool:
        """Whether the stage keeps tetrahedra from inverting, so that its certificate covers that."""
        return self._work.ends is not None

    def _count(self, bit):
        """Returns the number of vertices and bodies that have a bit of the outcome, and warns."""
        count = self.outcomes.count(bit)
        self.warn()
        return count
