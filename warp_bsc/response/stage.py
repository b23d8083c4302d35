"""What both stages behind a solver do: step it, keep the motion of the step, and count the step in a report."""

import contextlib
import functools
import time
from typing import Any

import newton
import warp as wp
from newton.solvers.experimental.coupled import SolverCoupled

from .._arguments import checked_number
from .._one_thread import one_at_a_time
from .._private_names.of_newton import SHAPES_CHANGE
from .._private_names.of_warp import paused_tape
from .._warnings import warn_caller
from .adjoint.between_steps import BetweenSteps
from .drive.coupled_check import CoupledCheck, has_elements_of_other_entries, unseen_shapes
from .drive.coupling import CouplingHooks
from .drive.world_mask import WorldMask, checked_mask
from .drive.wrapped_solver import innermost
from .report.count_steps import count_outrun, count_step, merge_step, note_crossings
from .report.count_worlds import WorldCounter
from .report.report import SolverReport
from .report.text import unseen_warning
from .state.kept_distances import KeptDistances
from .state.mesh import ModelMesh, unseen_strands
from .state.motion import ModelMotion, arrays_of, find_set_bodies
from .state.status import Loop
from .state.workspace import Workspace
from .step import prepare
from .tuning import MAX_ITERATIONS


def is_recorded(tape: wp.Tape | None, state_out: newton.State) -> bool:
    """Returns whether a tape, if there is one, records the gradients of a step."""
    end = state_out.particle_q
    return tape is not None and end is not None and end.requires_grad


class CollisionStage(CouplingHooks):
    """A stage behind another solver: a :class:`.solver_ccd.SolverCCD` or a :class:`.monitor.CollisionMonitor`."""

    mesh: ModelMesh
    report: SolverReport
    _report_type: type[SolverReport] = SolverReport
    _has_few_contacts = False  # of a solver that leaves hardly any
    _between_steps: BetweenSteps | None = None  # of a stage whose steps carry gradients
    _counter: WorldCounter | None = None  # of results by world, if the report is asked for them
    _mask: wp.array | None = None  # of the step in progress, if worlds take no part in it

    def _allocate(
        self,
        motion: ModelMotion,
        separation: float,
        restitution: wp.array,
        *,
        max_iterations: int = MAX_ITERATIONS,
        responds: bool = True,
    ):
        """Allocates the workspace of steps, and makes the report."""
        self.mesh, self._motion, self._responds, model = motion.mesh, motion, responds, self.model
        options = {"max_iterations": max_iterations, "responds": responds, "has_few_contacts": self._has_few_contacts}
        self._work = Workspace(motion, separation=separation, restitution=restitution, **options)
        motion.set_start(arrays_of(model))
        motion.set_end(arrays_of(model), 1.0)
        prepare(self._work)
        self._recount_crossings()
        if not model.requires_grad:
            motion.remember(self._work.vertices.x1)
        self.report = self._report_type(self._work, responds=responds)
        self._watches_bodies = motion.moves_bodies and not model.requires_grad
        coupled: Any = innermost(self.solver)
        if isinstance(coupled, SolverCoupled):
            for stage in map(coupled.solver, coupled.entry_names()):
                if isinstance(stage, CollisionStage):
                    stage.report.leave_state_to_other_stage()

    def _warn_of_unseen(self, mesh: ModelMesh, distances: KeptDistances):
        """Warns of springs and particles that take no part, unless the program chose that by a number."""
        unseen = None if distances.any or distances.is_chosen else unseen_strands(mesh)
        if unseen is not None:
            but = ", which steps on a tape do not take" if self.model.requires_grad else ""
            warn_caller(
                f"{unseen} take no part: faces and springs do not stop them, and certificates do not cover them. Pass "
                f"min_distance='model', for the radii of particles and the margins of shapes, or a number{but}; "
                "min_distance=0 leaves them out without this warning"
            )

    def _watch_between_steps(self, *, bodies: bool):
        """Keeps gradients apart of what a program moves between steps; ``bodies`` as of :class:`BetweenSteps`."""
        if self.model.requires_grad:
            self._between_steps = BetweenSteps(self.model, self.report.device_totals.ambiguous_moves, bodies=bodies)

    def _make_check(self):
        unseen = unseen_shapes(self.model)
        if unseen:
            warn_caller(unseen_warning(unseen))
        if not has_elements_of_other_entries(self.mesh):
            return None
        worlds = None if self._counter is None else self._counter.worlds.certified
        results = self.report.step_results.results
        self.report.coupled = CoupledCheck(self._work, results, self.report.device_totals, worlds)
        return self.report.coupled

    def _count_worlds(self, max_impulse: wp.array | None = None):
        """Makes the report have results by world."""
        find_inside = self.report.find_inside_by_world()
        published = {"strain": self.report.last_strain, "find_inside": find_inside, "max_impulse": max_impulse}
        self._counter = WorldCounter(self._work, self.report.step_results, **published)
        self.report.keep_worlds(self._counter.worlds)

    @one_at_a_time
    def step(
        self,
        state_in: newton.State,
        state_out: newton.State,
        control: newton.Control | None,
        contacts: newton.Contacts | None,
        dt: float,
        *,
        world_mask: wp.array[wp.bool] | None = None,
        **options,
    ) -> None:
        """Steps the inner solver, and detects the collisions of its motion.

        :class:`.solver_ccd.SolverCCD` then changes positions and velocities of the particles and bodies that collide.
        What is said of tapes holds for it alone.

        Args:
            state_in: The state at the start; the inner solver may change it.
            state_out: The state at the end. May be the same, except on a tape.
            control: As for the inner solver.
            contacts: As for the inner solver, which gets them as they are.
            dt: Length of the step [s], more than 0.
            world_mask: Which worlds take part in the step, and as the last entry whether everything that is in all
                worlds does, shape [world_count + 1], as of :meth:`reset`; None for all. The others end the step in the
                state in which they begin it, bit by bit, and the stage looks at none of their elements. The inner
                solver steps them all the same, as solvers of Newton know no mask: what it keeps of them beside the
                state, such as multipliers of its own contacts, may change. Custom attributes of the state are the inner
                solver's in all worlds.
            options: As for the inner solver; with substeps, observables are of the last one.

        Raises:
            TypeError: If ``dt`` is no number, or ``world_mask`` no array of bool.
            ValueError: If ``dt`` is not finite or not more than 0, if ``world_mask`` has another shape or device, or if
                a tape records gradients of the response, and ``state_out`` is ``state_in``.
            NotImplementedError: If a tape records gradients of a response that keeps a distance, or in a part of the
                worlds.
            RuntimeError: If another thread is using this stage, or if a tape records gradients in a CUDA graph, and it
                recorded no step outside one before, or if the first ``world_mask`` is given in a graph.
        """
        checked_number(dt, "dt", 0.0, above=True)
        mask = checked_mask(world_mask, self.model)
        with paused_tape() as tape:
            self._check_tape(tape, state_in, state_out)
            if mask is not None and tape is not None and self.model.requires_grad:
                raise NotImplementedError("world_mask: steps on a tape are of all worlds; omit it")
            start = state_in if self._coupled is None else self._coupled.start_of(state_in)
            self._motion.set_start(arrays_of(start))  # now: some solvers overwrite it
            if self._watches_bodies and self._coupled is None:
                self._find_set_bodies(start)
            self._mask = mask
            if mask is not None:
                self._world_mask.begin(start)
        with self._watched(tape, state_in, state_out):
            self._step_inner(state_in, state_out, control, contacts, dt, **options)
            with paused_tape():
                if mask is not None:
                    self._world_mask.restore(mask, state_out)
                self._finish_step(state_in, state_out, contacts, dt, tape)
        with paused_tape():
            if self._coupled is not None:
                self._coupled.finish(state_out, self._motion.vertices, self._work.vertices)
                self.report.copy_totals()
        if not self.mesh.device.is_capturing:
            self.report.warn()

    def _find_set_bodies(self, start):
        """Counts dynamic bodies whose pose a program writes between steps, which the stage takes to be there."""
        work, report = self._work, self.report
        inputs = [self._motion.vertices, start.body_q, work.vertices.bodies.pose]
        work.launch(find_set_bodies, work.body_count, inputs, [report.set_steps, report.device_totals.set_bodies])

    def _watched(self, tape, state_in, state_out):
        """Keeps the gradients of a step on a tape apart from those of what a program moves before it, and after it."""
        if tape is None or self._between_steps is None or not is_recorded(tape, state_out):
            return contextlib.nullcontext()
        return self._between_steps.watched(tape, state_in, state_out)

    @functools.cached_property
    def _world_mask(self):
        """Holds worlds that take no part in a step; made where it is first needed.

        Raises:
            RuntimeError: If that is in a graph.
        """
        if self.mesh.device.is_capturing:
            raise RuntimeError("world_mask needs memory: step once with one before capturing")
        return WorldMask(self.solver, self._work, self._motion)

    def _masked(self, mask):
        """Lets the stage look at the worlds alone that take part, at all if there is no mask."""
        return contextlib.nullcontext() if mask is None else self._world_mask.applied(mask)

    def _check_tape(self, tape, state_in, state_out):
        """Raises an error if the step cannot be recorded on a tape."""

    def _step_inner(self, *arguments, **options):
        """Steps the inner solver."""
        self.solver.step(*arguments, **options)

    def _finish_step(self, state_in, state_out, contacts, dt, tape):
        """Detects the collisions of the step after the inner solver, which was passed contacts."""
        raise NotImplementedError

    def _count_step(self, substep=0, substeps=1):
        """Adds a substep to the results of its step, which the last one adds to the totals."""
        work, report, first = self._work, self.report, substep == 0
        found = report.step_results
        size = max(self.mesh.vertex_count, work.body_count, len(found.results))
        inputs = [work.step, work.status, work.particle_count, self._responds, first]
        work.launch(merge_step, size, inputs, [found])
        work.launch(note_crossings, 1, [work.status])
        if self._counter is not None:
            self._counter.count(first=first)
        if substep == substeps - 1:
            if report.thickness is not None:
                work.launch(count_outrun, 1, [found.results], [report.device_totals])
            work.launch(count_step, 1, [found.results, report.last_strain], [report.device_totals])
        wp.copy(work.last_crossings, work.crossings_of_edges)
        report.copy_totals()

    def _recount_crossings(self):
        """Makes the next step count the crossings at its start, even if it begins where the last one ended."""
        self._work.loop[Loop.RECOUNT].fill_(1)

    @contextlib.contextmanager
    def _timed(self, substep=0):
        """Measures the time of a step, or a substep, for the report; does nothing while capturing."""
        device = self.mesh.device
        if device.is_capturing:
            yield
            return

        def now():
            if device.is_cuda:
                return wp.record_event(wp.Event(device, enable_timing=True))
            return time.perf_counter()

        start = now()
        yield
        self.report.spans = [*self.report.spans[:substep], (start, now())]

    @one_at_a_time
    def notify_model_changed(self, flags: int) -> None:
        """Notifies the inner solver, and reads masses and flags of particles again, and of shapes if they changed.

        With ``SHAPE_PROPERTIES`` the stage follows poses, scales and friction of shapes, in each world. A shape that
        changes jumps, as in a reset: the next step begins with the new surface, and what is then inside it, or crosses
        it, counts as that. What is not followed is warned of once, see :class:`.state.mesh.ModelMesh`.
        """
        super().notify_model_changed(flags)
        self.mesh.refresh_inverse_masses()
        if flags & SHAPES_CHANGE:
            self._follow_shapes()
        if self._between_steps is not None:
            self._between_steps.refresh()
        self._recount_crossings()

    def _follow_shapes(self):
        if self._coupled is not None:
            self._coupled.lose(None)
        self._motion.follow_shapes(self._work.vertices, self.report.device_totals.shape_not_followed)
        if not self.mesh.device.is_capturing:
            self.report.copy_totals()
            self.report.warn()

    @one_at_a_time
    def reset(self, state, world_mask=None, flags=None):
        """Resets the inner solver, and lets the next step of the worlds begin where its state is."""
        super().reset(state, world_mask, flags)
        self._motion.interrupt(world_mask)
        self._work.forget_crossings(world_mask)
        if self._coupled is not None:
            self._coupled.lose(world_mask)
