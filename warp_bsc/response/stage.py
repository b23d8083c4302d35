"""What stages behind a solver do: let it step, resolve the motion that it predicts, and count the step in a report."""

import contextlib
import functools
from typing import Any

import newton
import warp as wp
from newton.solvers.experimental.coupled import SolverCoupled

from .._arguments import checked_number
from .._one_thread import one_at_a_time
from .._private_names.of_newton import SHAPES_CHANGE, body_q_prev
from .._private_names.of_warp import paused_tape
from .._warnings import warn_caller
from ..detection.run.phase_timer import PhaseTimer
from .drive.coupled_check import CoupledCheck, has_elements_of_other_entries, unseen_shapes
from .drive.coupling import CouplingHooks
from .drive.inner_steps import InnerSteps, StepCall
from .drive.snapshot import Snapshot
from .drive.world_mask import WorldMask, checked_mask
from .report.count_steps import count_step, merge_step
from .report.count_worlds import WorldCounter
from .report.report import SolverReport
from .report.text import unseen_warning
from .state.kept_distances import KeptDistances
from .state.mesh import ModelMesh, unseen_strands
from .state.motion import arrays_of, find_set_bodies
from .state.status import Loop
from .state.workspace import Workspace
from .step import prepare
from .tuning import MAX_ITERATIONS
from .wrapped_solver import innermost


class CollisionStage(CouplingHooks):
    """A stage behind another solver: a :class:`.solver_ccd.SolverCCD` or a :class:`.monitor.CollisionMonitor`."""

    mesh: ModelMesh
    report: SolverReport
    _report_type: type[SolverReport] = SolverReport
    _has_few_contacts = False  # of a solver that leaves hardly any
    _keeps_strands = False  # apart by the radii of the model, without arguments
    _counter: WorldCounter | None = None  # of results by world, if the report is asked for them
    _inner: InnerSteps  # how the inner solver takes a step
    _start: Snapshot | None = None  # what a step that fails puts back

    def _allocate(self, motion, separation, restitution, *, max_iterations=MAX_ITERATIONS, responds=True):
        """Allocates the workspace of steps, and makes the report."""
        self.mesh, self._motion, self._responds = motion.mesh, motion, responds
        options = {"max_iterations": max_iterations, "has_few_contacts": self._has_few_contacts}
        self.work = Workspace(motion, separation=separation, restitution=restitution, **options)
        prepare(self.work)
        self._recount_crossings()
        motion.last.begin()
        self.report = self._report_type(self.work, responds=responds)
        self._watches_bodies = motion.moves_bodies
        coupled: Any = innermost(self.solver)
        if isinstance(coupled, SolverCoupled):
            for stage in map(coupled.solver, coupled.entry_names()):
                if isinstance(stage, CollisionStage):
                    stage.report.leave_state_to_other_stage()

    def _warn_of_unseen(self, mesh: ModelMesh, distances: KeptDistances):
        """Warns of springs and particles that take no part, unless the program chose that by a number."""
        unseen = None if distances.any or distances.is_chosen else unseen_strands(mesh)
        if unseen is not None:
            warn_caller(
                f"{unseen} take no part: faces and springs do not stop them, and certificates do not cover them. Pass "
                f"min_distance='model', for the radii of particles and the margins of shapes, or a number; "
                "min_distance=0 leaves them out without this warning"
            )

    def _make_check(self):
        unseen = unseen_shapes(self.model)
        if unseen:
            warn_caller(unseen_warning(unseen))
        if not has_elements_of_other_entries(self.mesh):
            return None
        worlds = None if self._counter is None else self._counter.worlds.certified
        results = self.report.step_results.results
        self.report.coupled = CoupledCheck(self.work, results, self.report.device_totals, worlds)
        return self.report.coupled

    def _count_worlds(self, max_impulse: wp.array | None = None):
        """Makes the report have results by world."""
        find_inside = self.report.find_inside_by_world()
        published = {"strain": self.report.last_strain, "find_inside": find_inside, "max_impulse": max_impulse}
        self._counter = WorldCounter(self.work, self.report.step_results, **published)
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

        A step is taken as a whole unless ``substeps=`` of :class:`.solver_ccd.SolverCCD` divides it: each substep is
        then solved, detected and resolved by itself, and the report has them together.
        :class:`.solver_ccd.SolverCCD` then changes positions and velocities of the particles and bodies that collide.

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
            ValueError: If ``dt`` is not finite or not more than 0, or if ``world_mask`` has another shape or device; on
                a tape, also if ``state_out`` is ``state_in``.
            NotImplementedError: If a tape is active and the model requires gradients, and the step carries none: that
                of a :class:`.solver_ccd.SolverCCD`, or of a part of the worlds.
            RuntimeError: If another thread is using this stage, or if the first ``world_mask`` is given in a graph.
            MemoryError: If the memory of the device does not suffice. After any error in a step outside graphs,
                ``state_in`` and the report are as before; another ``state_out`` holds nothing.
        """
        call = self._checked_call(state_in, state_out, control, contacts, dt, world_mask, options)
        with self._restored_on_error(state_in):
            for step in self._inner.parts(call):  # the step itself, or its substeps
                with self._entered(step):  # keeps its start, and whatever the inner solver must not change
                    self._inner.take(step)  # the inner solver predicts its end
                    with paused_tape():
                        if step.mask is not None:
                            self._world_mask.restore(step.mask, step.state_out)  # worlds that take no part
                        self._resolve(step)  # detects the contacts of the motion, and resolves them
        if not self.mesh.device.is_capturing:
            self.report.warn()

    @contextlib.contextmanager
    def _restored_on_error(self, state):
        """Restores the state at the start of a step, and the report, if the step fails: some solvers write to both.

        A graph whose capture fails is never launched.
        """
        report, start = self.report, None
        kept = [vars(state), vars(report), vars(report.step_results), {"poses": body_q_prev(self.solver)}]
        arrays = [x for values in kept for x in values.values() if isinstance(x, wp.array) and x.size]
        with paused_tape():
            if not self.mesh.device.is_capturing:
                start = self._start = Snapshot([*arrays, *self._motion.last.arrays], before=self._start)
        try:
            yield
        except Exception:
            with paused_tape():
                if start is not None:
                    start.restore()
            raise

    def _checked_call(self, state_in, state_out, control, contacts, dt, world_mask, options):
        """Returns the arguments of a step, checked, with the active tape if the model requires gradients."""
        checked_number(dt, "dt", 0.0, above=True)
        mask = checked_mask(world_mask, self.model)
        with paused_tape() as active:
            tape = active if self.model.requires_grad else None
            if tape is not None:
                self._check_tape(state_in, state_out, mask)
        return StepCall(state_in, state_out, control, contacts, dt, options, mask, tape)

    def _check_tape(self, state_in, state_out, mask):
        """Raises an error if a tape would record a step that carries no gradients."""
        if mask is not None:
            raise NotImplementedError("world_mask: steps on a tape are of all worlds; omit it")

    @contextlib.contextmanager
    def _entered(self, step):
        """Keeps where a step starts, and after it where it ended."""
        with paused_tape():
            start = step.state_in if self._coupled is None else self._coupled.start_of(step.state_in)
            self._motion.set_start(arrays_of(start))  # now: some solvers overwrite it
            if self._watches_bodies and self._coupled is None:
                self._find_set_bodies(start)
            if step.mask is not None:
                self._world_mask.begin(start)
        yield
        with paused_tape():
            self._motion.last.end(step.state_out.body_q, self._motion.planes.end)
            if step.mask is not None:
                self._world_mask.end(step.mask)
            if self._coupled is not None:
                self._coupled.finish()
                self.report.copy_totals()

    def _find_set_bodies(self, start):
        """Counts dynamic bodies whose pose a program writes between steps, which the stage takes to be there."""
        work, report = self.work, self.report
        inputs = [self._motion.vertices, start.body_q, work.vertices.bodies.pose]
        work.launch(find_set_bodies, work.body_count, inputs, [report.set_steps, report.device_totals.set_bodies])

    @functools.cached_property
    def _world_mask(self):
        """Holds worlds that take no part in a step; made where it is first needed.

        Raises:
            RuntimeError: If that is in a graph.
        """
        if self.mesh.device.is_capturing:
            raise RuntimeError("world_mask needs memory: step once with one before capturing")
        return WorldMask(self.solver, self.work, self._motion)

    def _resolve(self, step):
        """Detects the collisions of a step after the inner solver, and resolves them if the stage does that.

        Within :meth:`_prepared`, a :class:`.monitor.CollisionMonitor` inspects the motion. A
        :class:`.solver_ccd.SolverCCD` solves it, by :func:`.step.resolve` or, with contact inside, by Newton's method
        and then the same response; it measures the strain, and looks for inversions and arcs that collide.
        """
        raise NotImplementedError

    @contextlib.contextmanager
    def _prepared(self, step, end):
        """Prepares the motion to the end that the inner solver predicted, in worlds that take part; counts the step."""
        with self._timed(step.number):
            if self.mesh.distance_arrays is not None:
                self.mesh.distance_arrays.read()
            self._motion.set_end(end, step.dt)
            with contextlib.nullcontext() if step.mask is None else self._world_mask.applied(step.mask):
                yield
                self._count_step(step)

    def _count_step(self, step):
        """Adds a substep to the results of its step, which the last one adds to the totals."""
        work, report, first = self.work, self.report, step.is_first
        found = report.step_results
        size = max(self.mesh.vertex_count, work.body_count, len(found.results))
        inputs = [work.step, work.status, work.particle_count, self._responds, first]
        work.launch(merge_step, size, inputs, [found])
        if self._counter is not None:
            self._counter.count(first=first)
        if step.is_last:
            work.launch(count_step, 1, [found.results, report.last_strain], [report.device_totals])
        wp.copy(work.last_crossings, work.crossings_of_edges)
        report.copy_totals()

    def _recount_crossings(self):
        """Makes the next step count the crossings at its start, even if it begins where the last one ended."""
        self.work.loop[Loop.RECOUNT].fill_(1)

    @contextlib.contextmanager
    def _timed(self, substep):
        """Measures the time of a step, or a substep, for the report; does nothing while capturing."""
        timer = PhaseTimer(self.mesh.device)
        with timer.phase("step"):
            yield
        if not self.mesh.device.is_capturing:
            self.report.timers = [*self.report.timers[:substep], timer]

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
        self._recount_crossings()

    def _follow_shapes(self):
        if self._coupled is not None:
            self._coupled.lose(None)
        self._motion.follow_shapes(self.report.device_totals.shape_not_followed)
        if not self.mesh.device.is_capturing:
            self.report.copy_totals()
            self.report.warn()

    @one_at_a_time
    def reset(self, state, world_mask=None, flags=None):
        """Resets the inner solver, and lets the next step of the worlds begin where its state is."""
        super().reset(state, world_mask, flags)
        self._motion.last.interrupt(world_mask)
        self.work.forget_crossings(world_mask)
        if self._coupled is not None:
            self._coupled.lose(world_mask)
