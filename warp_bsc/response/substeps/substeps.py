"""Substeps: repeats a step that collides in substeps of the inner solver, each with a projection onto the contacts.

The inner solver steps, then a projection onto the contacts of the whole step follows. The elastic solve of each substep
therefore begins with positions and velocities that include the contacts, and pulls against them for a fraction of the
step only. The stretch between solver and contacts falls with the length of the substep. Contacts are detected once,
before the substeps; the motion of the whole step is detected and certified after them.

With ``"auto"``, a world takes whole steps first. If contacts strain an element by more than ``WHOLE_STRAIN`` against
the prediction of the inner solver, the step is repeated, in ``IMPACT_SUBSTEPS`` or the smallest number of ``SUBSTEPS``
above it that brings the strain below ``STRAIN``, if it is in proportion to the length of a substep. The next step
begins in substeps, as many as the strain of these asks for, fewer only after a while; without bodies, behind a solver
that only moves particles, it takes no whole step before them, and the contacts are those of particles that fly on. If
substeps turn out to be too few, or if contacts that they did not know strain an element after them, the step is
repeated with more, or with these contacts too.

Where nothing touches any more, the next step is a whole one first. Whole steps of the inner solver may stretch elements
that substeps do not, as its iterations converge less: substeps go on until a whole step strains elements by no more
than ``STRAIN``, and begin again if one of the next ``CALM_STEPS`` whole steps does by more than ``WHOLE_STRAIN``.

Substeps share the iterations of VBD and Style3D, each with at least ``SUBSTEP_ITERATIONS``: many substeps of few
iterations converge better than few of many (Macklin et al. 2019). A substep begins with the position multipliers of the
one before.

Contacts that a program passes on are shared out before the step, see :mod:`.substeps.inner_contacts`: whole steps and
substeps get the same ones, in short steps of VBD all of them. Those between bodies were found at the start of the step,
and remain for all substeps.

References:
    M. Macklin, K. Storey, M. Lu, P. Terdiman, N. Chentanez, S. Jeschke and M. Mueller, Small Steps in Physics
    Simulation, Symposium on Computer Animation, 2019, doi:10.1145/3309486.3340247.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import newton
import warp as wp
from newton.solvers import SolverBase, SolverSemiImplicit

from ..._private_names.of_newton import attributes_of, body_q_prev, iterations_shared, may_allocate
from ..contacts.detect import detect_penetrations
from ..forces.contact_forces import ContactForces
from ..solve import positions, velocities
from ..solve.bodies import begin_bodies
from ..state.motion import ModelMotion, arrays_of
from ..state.workspace import Workspace
from ..step import add_proximities, begin, detect_contacts, find_contacts, resolve_contacts
from ..tuning import SUBSTEP_ITERATIONS
from . import kernels
from .strain import StrainMeter, choose_substeps, predict_substeps, review_substeps


class _Step(NamedTuple):
    """What a step of the inner solver takes, and its arrays, each with the copy from which it is restored."""

    state: newton.State
    control: newton.Control | None
    contacts: newton.Contacts | None
    dt: float
    arrays: list[tuple[wp.array, wp.array]]


class Substeps:
    """Repeats steps that collide in substeps, in which the inner solver and a projection alternate.

    Worlds without contacts keep the result of the inner solver for the whole step, bit by bit. So do, in all worlds,
    bodies that the response cannot move: in the substeps, they move evenly between their poses at both ends. Arrays of
    the inner solver are restored after the substeps, so that histories and clocks advance once a step. Options of a
    step, such as observables, are those of the whole step.

    The inner solver determines what a substep is. VBD and Style3D solve the forces of a shorter step. XPBD makes all
    its iterations in each, and its multipliers start anew, with the compliance of its length: it is XPBD in small
    steps, which stays stable where long ones diverge. An explicit solver (``SolverSemiImplicit``)
    needs no substeps: it is stable only at steps in which contacts strain elements little. A given number of substeps
    is taken all the same, and ``"auto"`` takes none.

    Limitations:
        In a CUDA graph, a step that allocates memory, such as that of ``SolverXPBD``, cannot be left out where nothing
        touches. The substeps then cost their time in each step, and ``"auto"`` takes none. Only ``SolverVBD``
        itself and, on a CPU, ``SolverStyle3D`` are known not to allocate, see
        :func:`warp_bsc._private_names.of_newton.may_allocate`. Python attributes that the inner solver changes in
        place, and not by assignment, are not restored.

        An inner solver that finds contacts of particles itself, by a ``collision_pipeline`` of its own or by VBD's
        self-contact, resolves them beside the stage: a whole step may leave stretch that substeps release. Contacts
        of Style3D itself are disabled; with ``"auto"`` it takes no substeps, see :mod:`.style3d_contacts`.

    Attributes:
        substeps: Substeps of the last step, the most of all worlds, on the device; 0 if it was not taken in substeps.
        strain: Largest strain by contacts of the last step, or of one of its substeps, in each world, on the device.
        forces: Keeps the impulses of contacts, if the report is to have them.
        taken: Substeps of the last step in each world, if the report is to have them, on the device.
    """

    def __init__(
        self,
        step: Callable[..., None],
        solver: SolverBase,
        work: Workspace,
        meter: StrainMeter,
        substeps: Sequence[int],
    ):
        """Allocates buffers.

        Args:
            step: Steps the inner solver, with the arguments of its ``step``.
            solver: The inner solver.
            work: The workspace, with the motion of the whole step.
            meter: Measures strain.
            substeps: Numbers to choose from, each at least 2, sorted; one alone is taken by every step that collides.

        Raises:
            RuntimeError: If the state of the inner solver cannot be restored, see :mod:`warp_bsc._private_names`.
        """
        self._choices, self._chooses = substeps, len(substeps) > 1
        self._step, self._solver, self._meter = step, solver, meter
        self._mesh, self._motion, self._work = work.mesh, work.motion, work
        self._moves_bodies, self.may_allocate = work.motion.moves_bodies, may_allocate(solver)
        self._substep = ModelMotion(work.mesh, work.motion.friction, moves_bodies=self._moves_bodies)
        model, device, worlds = work.mesh.model, work.device, work.worlds
        self._start, self._in, self._out = model.state(), model.state(), model.state()
        self._copies: dict[str, wp.array] = {}  # of arrays of the inner solver
        self.substeps = wp.zeros(1, dtype=int, device=device)
        self._number = wp.zeros(worlds, dtype=int, device=device)  # of substeps, by world
        self._needs_whole_step = wp.zeros(1, dtype=int, device=device)
        self._has_constraints = wp.zeros(worlds, dtype=int, device=device)
        self.strain = self._strain = wp.zeros(worlds, dtype=float, device=device)
        self._is_pending = wp.zeros(worlds, dtype=int, device=device)  # 1 while a world has substeps to take
        self._takes_substeps = wp.zeros(worlds, dtype=int, device=device)
        self._is_fast = wp.zeros(worlds, dtype=int, device=device)  # as in SolveStatus, of the predicted motion
        self._detected = wp.zeros(3, dtype=int, device=device)  # constraints, contacts and filtered pairs
        self._remaining = wp.zeros(1, dtype=int, device=device)  # substeps
        if self._chooses:
            self._strain, self._final_strain = (wp.zeros(worlds, dtype=float, device=device) for _ in range(2))
            self._calm = wp.zeros(worlds, dtype=int, device=device)  # steps with fewer
            self._fewest, self._is_extrapolated = (wp.zeros(worlds, dtype=int, device=device) for _ in range(2))
            self._own_strain = wp.zeros(worlds, dtype=float, device=device)  # of the whole step, without contacts
            self._missed_strain, self._lasting = (wp.zeros(worlds, dtype=float, device=device) for _ in range(2))
            self._device_choices = wp.array(self._choices, dtype=int, device=device)
            self._is_chosen = wp.zeros(len(self._choices), dtype=int, device=device)
            self._passes = wp.zeros(1, dtype=int, device=device)
            self._repeats = wp.zeros(1, dtype=int, device=device)
            self._must_choose = wp.zeros(1, dtype=int, device=device)
        # a program may move bodies, or what it likes, within a step of the inner solver that is not Newton's own
        moves_alone = not model.body_count and not self.may_allocate and "step" not in attributes_of(solver)
        self._extrapolates = self._chooses and moves_alone
        self.forces: ContactForces | None = None
        self.taken: wp.array[int] | None = None
        self._hits, self._filtered = (wp.zeros(worlds, dtype=int, device=device) for _ in range(2))  # as predicted
        self._arrays_of_solver()

    @property
    def predicted(self) -> wp.array[int]:
        """Predicted number of substeps of each world in the next step, 0 for none."""
        return self._number

    def begin(self, state: newton.State) -> None:
        """Copies the state at the start of the step, before the inner solver changes it."""
        self._start.assign(state)
        if self._chooses:
            self._needs_whole_step.zero_()
            inputs = [self._motion.vertices.interrupted, self._has_constraints, self._extrapolates]
            inputs += [self._number, self._calm, self._fewest, self._lasting]
            outputs = [self._is_extrapolated, self._needs_whole_step, self._own_strain, self._strain]
            outputs += [self._final_strain, self._is_chosen, self._must_choose]
            self._work.launch(kernels.begin_step, self._work.worlds, inputs, outputs)

    def take_whole_step(self, *arguments, can_branch: bool, **options) -> None:
        """Steps the inner solver, with its arguments, unless no world needs it, as all have predicted substeps.

        Where a step cannot be in the body of a condition, the inner solver takes it in any case.
        """
        if self._extrapolates and can_branch and not options:
            wp.capture_if(self._needs_whole_step, lambda: self._step(*arguments))
        else:
            self._step(*arguments, **options)

    def _arrays_of_solver(self):
        """Returns the arrays of the inner solver, each with one of its size, allocated here where memory can be."""
        pairs, device = [], self._mesh.device
        for name, array in attributes_of(self._solver).items():
            if isinstance(array, wp.array) and array.size and array.device == device:
                saved = self._copies.get(name)
                if saved is None or saved.shape != array.shape or saved.dtype != array.dtype:
                    saved = wp.empty_like(array, requires_grad=False)
                    if not device.is_capturing:  # memory of a graph is of no use outside it
                        self._copies[name] = saved
                pairs.append((array, saved))
        return pairs

    def resolve(
        self, state: newton.State, control: newton.Control | None, contacts: newton.Contacts | None, dt: float
    ) -> None:
        """Makes the motion free of its contacts, like :func:`.step.resolve`; writes the end of substeps to a state.

        Args:
            state: The state at the end of the step, as the inner solver predicted it.
            control: As for the inner solver.
            contacts: As for the inner solver.
            dt: Length of the step [s].
        """
        work, in_graph = self._work, self._mesh.device.is_capturing
        work.motion = self._motion  # also after an error in a substep
        if self._extrapolates:
            model, start = work.mesh.model, self._start
            inputs = [arrays_of(start), start.particle_f, model.particle_world, model.gravity, dt]
            inputs.append(self._is_extrapolated)
            outputs = [self._motion.vertices, arrays_of(state)]
            work.launch(kernels.extrapolate, model.particle_count, inputs, outputs)
        self.strain.zero_()
        if self._chooses:
            self._meter.measure(self._motion.vertices, self._own_strain, own=True)
        if self.taken is not None:
            self.taken.zero_()
        find_contacts(work)
        self._has_constraints.zero_()
        work.launch_over_constraints(kernels.find_worlds, self._has_constraints)
        if self._chooses:
            self._choose(dt)
        else:
            inputs = [self._has_constraints, self._choices[0], work.status]
            work.launch(kernels.use_substeps, work.worlds, inputs, [self._number, self.substeps])
        step = _Step(state, control, contacts, dt, self._arrays_of_solver())
        if in_graph and self.may_allocate:
            self._take_substeps(step)
        else:
            wp.capture_if(self.substeps, self._take_substeps, step=step)

    def _choose(self, dt):
        """Chooses the substeps of each world: the predicted ones, or those that follow from a resolved whole step."""
        work = self._work
        self.substeps.zero_()
        inputs = [work.step, self._has_constraints, self._is_extrapolated, self._device_choices]
        inputs += [work.status, self._calm, self._own_strain, self._number]
        outputs = [self._is_chosen, self.substeps, self._must_choose]
        work.launch(kernels.use_predicted_substeps, work.worlds, inputs, outputs)
        wp.capture_if(self._must_choose, self._resolve_and_choose, dt=dt)

    def _resolve_and_choose(self, dt):
        """Resolves the motion, chooses substeps by its strain, and if there are any, detects its contacts again."""
        work = self._work
        resolve_contacts(work, dt)
        self._meter.measure(self._motion.vertices, self._strain)
        inputs = [self._own_strain, self._strain, self._has_constraints, self._device_choices, work.status]
        inputs += [self._number, self._calm, self._fewest, self._lasting]
        outputs = [self._is_chosen, self.substeps, self.strain]
        work.launch(choose_substeps, work.worlds, inputs, outputs)
        wp.capture_if(self.substeps, self._find_contacts_again)

    def _find_contacts_again(self):
        work = self._work
        wp.copy(work.vertices.x1, self._motion.vertices.x0)  # where crossings are counted
        find_contacts(work)

    def _take_substeps(self, step):
        """Repeats the step in substeps, and writes the end to the predicted motion and to the state."""
        work = self._work
        add_proximities(work, in_substeps=True)
        inputs = [work.step, work.status, self._detected, self._is_fast]
        work.launch(kernels.keep_detection, work.worlds, inputs)
        if self.taken is not None:
            wp.copy(self._hits, work.status.of_worlds.hits)
            wp.copy(self._filtered, work.status.of_worlds.filtered)
        for array, saved in step.arrays:
            wp.copy(saved, array)
        self._is_pending.fill_(1)
        if self._chooses:
            self._passes.zero_()
            self._repeats.fill_(1)
            wp.capture_while(self._repeats, self._take_chosen_numbers, step=step)
            self._report_worlds()
            inputs = [self._own_strain, self._strain, self._final_strain, self._device_choices]
            outputs = [self._number, self._calm, self._fewest, self._lasting]
            work.launch(predict_substeps, work.worlds, inputs, outputs)
        else:
            self._take_number_of_substeps(self._choices[0], step)
            self._finish(step.dt)
            self._report_worlds()
            self._meter.measure(self._motion.vertices, self.strain)

    def _report_worlds(self):
        """Reports the substeps of each world, and contacts and filtered pairs of the motion as it was predicted."""
        if self.taken is not None:
            wp.copy(self.taken, self._number)
            wp.copy(self._work.status.of_worlds.hits, self._hits)
            wp.copy(self._work.status.of_worlds.filtered, self._filtered)

    def _take_chosen_numbers(self, step):
        """Takes the substeps of all worlds that have still to, and decides which worlds repeat theirs."""
        work = self._work
        work.launch_over_constraints(kernels.disable_constraints, self._detected, self._is_pending)
        work.launch(kernels.begin_pass, 1, [work.step, self._passes, self._detected])
        for i, substeps in enumerate(self._choices):
            wp.capture_if(self._is_chosen[i : i + 1], self._take_number_of_substeps, substeps=substeps, step=step)
        self._finish(step.dt)
        for array in (self._final_strain, self._is_chosen, self._repeats):
            array.zero_()
        self._meter.measure(self._motion.vertices, self._final_strain)
        inputs = [self._strain, self._final_strain, self._device_choices, self._passes]
        inputs += [self._has_constraints, self._number, self._missed_strain, self._lasting]
        outputs = [self._is_pending, self._is_chosen, self.substeps, self._repeats, self.strain]
        work.launch(review_substeps, work.worlds, inputs, outputs)

    def _take_number_of_substeps(self, substeps, step):
        """Repeats the step in worlds with this number of substeps."""
        work, mesh, start = self._work, self._mesh, self._in
        self._remaining.fill_(substeps)
        outputs = [work.status, self._takes_substeps, self._strain]
        work.launch(kernels.begin_substeps, work.worlds, [self._number, self._is_pending, substeps], outputs)
        if self.forces is not None:
            self.forces.restart_worlds(self._takes_substeps)
        attributes = attributes_of(self._solver)
        kept = dict(attributes)
        start.assign(self._start)
        wp.copy(self._substep.vertices.x0, self._motion.vertices.x0)
        poses = body_q_prev(self._solver) if self._moves_bodies else None
        if poses is not None:
            wp.copy(poses, self._start.body_q)
        with iterations_shared(self._solver, substeps, SUBSTEP_ITERATIONS):
            if mesh.device.is_capturing and self.may_allocate:
                for _ in range(substeps):
                    self._take_substep(substeps, step)
            else:
                wp.capture_while(self._remaining, self._take_substep, substeps=substeps, step=step)
        attributes.update(kept)
        for array, saved in step.arrays:
            wp.copy(array, saved)
        work.motion = self._motion
        inputs = [work.step, self._takes_substeps, arrays_of(start), arrays_of(step.state)]
        if self._moves_bodies:
            work.launch(kernels.end_body_substeps, mesh.model.body_count, inputs)
        work.launch(kernels.end_substeps, mesh.vertex_count, inputs)

    def _take_substep(self, substeps, step):
        """Steps the inner solver, and projects its motion onto the constraints."""
        work, mesh, motion, substep = self._work, self._mesh, self._motion, self._substep
        start, end, bodies = self._in, self._out, mesh.model.body_count
        starts = arrays_of(start)  # now: solvers may replace arrays of a state
        if bodies:
            inputs = [motion.vertices, self._start.body_q, step.state.body_q, substeps, self._remaining]
            work.launch(kernels.move_bodies, bodies, inputs, [start.body_q, end.body_q])
        substep_dt = step.dt / substeps
        if self._moves_bodies:
            wp.copy(substep.vertices.bodies.start, start.body_q)  # now: some solvers overwrite it
        self._step(start, end, step.control, step.contacts, substep_dt)
        if work.motion is not substep:  # which copies structs, and takes longer than the launch of a kernel
            work.motion = substep
        if self._moves_bodies:
            substep.set_body_ends(arrays_of(end))
            work.launch_over_bodies(begin_bodies)
        inputs = [
            motion.vertices,
            motion.planes,
            substeps,
            step.dt,
            self._remaining,
            self._detected,
            self._takes_substeps,
            arrays_of(end),
            work.arcs,
        ]
        size = max(mesh.vertex_count, len(motion.planes.start))
        work.launch(kernels.start_substep, size, [*inputs, work.step, work.status, substep.planes])
        if work.max_penetrations:
            work.reserve(work.max_penetrations)
            detect_penetrations(work, ahead=True)
        inputs = [work.status, self._detected, self._remaining, substeps]
        work.launch_over_constraints(kernels.reset_constraints, *inputs)
        positions.project(work, 1.0 / substeps, in_substep=True)  # creep adds up over substeps
        self._meter.measure(substep.vertices, self._strain)
        velocities.project(work, substep_dt)
        if self.forces is not None:
            self.forces.keep(substeps, self._remaining)
        start.assign(self._start)
        poses = body_q_prev(self._solver) if self._moves_bodies else None
        inputs = [work.step, self._remaining, starts, poses]
        work.launch(kernels.end_substep, max(mesh.vertex_count, bodies), inputs)

    def _finish(self, dt):
        """Detects and resolves the contacts of the motion that the substeps made, beside their own constraints."""
        work = self._work
        begin(work)
        wp.copy(work.constraints.count, self._detected, count=1)
        work.launch_over_constraints(kernels.keep_constraints, self._detected, self._number)
        detect_contacts(work)
        inputs = [work.step, self._detected, self._is_fast, work.status]
        work.launch(kernels.restore_detection, work.worlds, inputs)
        resolve_contacts(work, dt)


def reason_to_omit_substeps(solver: SolverBase) -> str | None:
    """Returns why ``"auto"`` takes no substeps behind a solver; None if it can."""
    if solver.model.requires_grad:
        return "the model requires gradients"
    if isinstance(solver, SolverSemiImplicit):
        return "SolverSemiImplicit is explicit, its steps are small"
    try:
        attributes = attributes_of(solver).values()
    except RuntimeError as error:
        return str(error)
    if any(map(_holds_solver, attributes)):
        return f"{type(solver).__name__} steps other solvers, whose state cannot be restored"
    return None


def _holds_solver(value):
    """Returns whether a value is a solver, or a collection of solvers or of entries with one."""
    values = value.values() if isinstance(value, dict) else value if isinstance(value, (list, tuple)) else [value]
    return any(isinstance(x, SolverBase) or isinstance(getattr(x, "solver", None), SolverBase) for x in values)
