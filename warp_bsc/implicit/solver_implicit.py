"""The solver with contact inside: inertia, elasticity, contact and friction in one solve of each step."""

import contextlib
import math
from collections.abc import Collection, Mapping, Sequence
from typing import Literal

import newton
import numpy as np
import warp as wp
from newton import BodyFlags, ParticleFlags
from newton.solvers import SolverBase
from newton.solvers.experimental.coupled import ModelView

from .._arguments import check_instance, checked_choice, checked_integer, given
from .._private_names.of_newton import attachment_arrays, check_observables
from .._private_names.of_warp import paused_tape
from ..detection.run.host_function import run_on_host
from ..response.options import Inversions, Reported
from ..response.solver_ccd import SolverCCD
from ..response.state.collision_filter import CollisionFilter
from ..response.state.friction_table import FrictionTable
from ..response.state.mesh import dynamic_bodies, host_array
from ..response.state.motion import arrays_of
from ..response.state.status import Loop
from ..response.state.structs import Bodies
from ..response.step import begin, detect_contacts, resolve_contacts
from .contact import steps
from .contact.bodies import predict_bodies
from .contact.newton_method import NewtonMethod
from .contact.results import StepResults
from .gradients.checkpoints import CheckpointedStep, Checkpoints
from .gradients.step_gradients import RecordedStep, StartArrays, StateGradients, StepGradients
from .report import ImplicitStepReport

MAX_STEPS, MAX_PRECISE_STEPS = 15, 100
"""Newton steps of a step, and of one whose gradients are wanted: after 48 steps with 15, scenes of ``bench response``
are within 0.4 mm of where many more lead, in the mean of their particles, but for the chaotic pile of cubes."""


def _find_jointed_body(model: newton.Model) -> int | None:
    """Returns a dynamic body that a joint holds, None if there is none. Joints of proxies are of another solver."""
    if not model.joint_count:
        return None
    holds = host_array(model.joint_enabled) & (host_array(model.joint_type) != newton.JointType.FREE)
    ends = np.concatenate([host_array(model.joint_child)[holds], host_array(model.joint_parent)[holds]])
    ends = ends[ends >= 0]
    is_proxy = (host_array(model.body_flags) & BodyFlags.PROXY) != 0
    jointed = ends[(dynamic_bodies(model) & ~is_proxy)[ends]]
    return int(jointed[0]) if len(jointed) else None


class _Inertia(SolverBase):
    """Moves particles and bodies as if nothing but gravity and external forces acted on them."""

    def __init__(self, model: newton.Model, *, moves_bodies: bool):
        super().__init__(model)
        self._bodies = Bodies() if moves_bodies and model.body_count else None
        if self._bodies is not None:
            self._bodies.com, self._bodies.world = model.body_com, model.body_world
            self._bodies.inertia, self._bodies.inverse_inertia = model.body_inertia, model.body_inv_inertia
            self._bodies.inverse_mass = model.body_inv_mass

    def step(self, state_in, state_out, control, contacts, dt, *, observables=None):
        """Writes the positions and velocities that inertia leads to; no tape records that."""
        check_observables(self, observables, contacts)
        with paused_tape():
            self._step(state_in, state_out, dt)

    def _step(self, state_in, state_out, dt):
        model = self.model
        if self._bodies is not None:
            inputs = [state_in.body_q, state_in.body_qd, state_in.body_f, model.body_flags, model.gravity]
            outputs = [state_out.body_q, state_out.body_qd]
            inputs = [*inputs, self._bodies, float(dt)]
            wp.launch(predict_bodies, model.body_count, inputs=inputs, outputs=outputs, device=model.device)
        elif state_in.body_q is not None and state_in is not state_out:
            wp.copy(state_out.body_q, state_in.body_q)
            wp.copy(state_out.body_qd, state_in.body_qd)
        inputs = [state_in.particle_q, state_in.particle_qd, state_in.particle_f, model.particle_inv_mass]
        inputs += [model.particle_flags, int(ParticleFlags.ACTIVE), model.gravity, model.particle_world, float(dt)]
        outputs = [state_out.particle_q, state_out.particle_qd]
        wp.launch(steps.predict_positions, model.particle_count, inputs=inputs, outputs=outputs, device=model.device)


class SolverImplicit(SolverCCD):
    """Steps cloth and soft bodies by one implicit solve a step, which has contact and friction in it.

    The end of a step minimizes inertia, the elastic energies that Newton's VBD has, barriers between elements that are
    near each other, and friction. Newton's method finds it, with conjugate gradients for each world and bounds that let
    no two elements meet. The motion is then detected and certified as that of any solver by
    :class:`warp_bsc.SolverCCD`, whose certificate, kinematic particles and bodies, and report this solver has; what is
    left to collide is resolved as there.

    Free bodies are solved for: they rest on each other, on cloth, on static shapes and on infinite planes, as their
    flags, groups and filters of collision say. Kinematic bodies and those without mass are where the program puts them.
    In an entry of a coupled solver, proxies are free bodies of their mass, whatever joints hold their sources: what the
    solve changes of their momentum is fed back. With ``mode="lagged"`` give the coupler two passes or more: with one,
    proxies that rest on something hard bounce ever higher, by a factor of 1.5 a step in theory; ``"staggered"`` needs
    one.

    Stiffness and reach of barriers follow from masses, edges, radii and elasticity; no option needs tuning. Contacts
    that are passed to :meth:`step` are not needed, and not used. Where gravity of more than 98.1, or edges of more than
    0.5 without gravity, tell at construction that lengths are not in metres, speeds that are given in m/s here are
    scaled, so that a model in centimetres moves as it does in metres.

    Each world is stepped as if it were alone, bit for bit as measured on CPUs, but for the distance by which contacts
    that the solve leaves are moved apart: 0.005 of the median edge length of all worlds, in eight bits.

    On a :class:`warp.Tape`, steps of a model that was finalized with ``requires_grad=True`` carry gradients: from
    positions and velocities of particles and bodies at their end to those at their start, to ``particle_f`` and
    ``body_f``, and to what requires gradients of ``particle_inv_mass``, ``body_inv_mass``, ``body_inertia``,
    ``body_inv_inertia`` and ``gravity``; ``tri_poses``, ``tri_areas``, ``tri_materials``, ``edge_rest_angle``,
    ``edge_rest_length``, ``edge_bending_properties``, ``tet_poses``, ``tet_materials``, ``spring_rest_length``,
    ``spring_stiffness`` and ``spring_damping``; points, stiffness and damping of attachments; coefficients of friction
    of particles, shapes and pairs; distances that pairs keep, as ``min_distance`` and ``particle_radius`` give them, or
    ``particle_radius`` and ``shape_margin`` of the model; and to kinematic particles and bodies that a program moves.
    The implicit function theorem makes them of each converged step, with friction and closest points as they move, by
    one linear solve, see :mod:`.gradients.equations`. They are NaN, and counted, in worlds whose step did not converge.
    Such a model is solved closer, in some two Newton steps more. Three things count as constant: which pairs are near,
    by how much barriers are stiffer where solids and taut elements press, and how far they reach, which radii of the
    model limit at construction. :mod:`.gradients.between_steps` says where gradients of kinematic particles and bodies
    are that a program moves between steps.

    Limitations:
        Restitution does not exist: contacts are without bounce, and implicit steps damp.
        On a GPU, the blocks of a kernel wait for each other, one on each multiprocessor: do not run steps of two such
        solvers at the same time on streams of different priorities, as each may hold what the other waits for.

    Attributes:
        mesh: The triangles that collide, :class:`.response.state.mesh.ModelMesh`.
        report: What a step found and did, :class:`.report.ImplicitStepReport`.
        friction: Coefficients of particles, Warp array of float, shape [1] or [particle_count].
        max_iterations: Newton steps of a step at most.
        gradients: What carries gradients of tapes through steps, None unless the model requires gradients.
        newton_method: How it solves a step, ``contact.newton_method.NewtonMethod``.
        work: The buffers of a step, ``response.state.workspace.Workspace``.
    """

    _near = 0.0  # no constraints for near pairs: barriers keep them apart
    _has_few_contacts = _keeps_strands = True
    report: ImplicitStepReport
    _report_type = ImplicitStepReport

    def __init__(
        self,
        model: newton.Model,
        *,
        friction: float | wp.array[float] | FrictionTable | None = None,
        bodies: Literal["solved", "ignored"] = "solved",
        min_distance: float | Literal["model"] | wp.array[float] | None = None,
        particle_radius: float | np.ndarray | wp.array | None = None,
        collision_filter: CollisionFilter | None = None,
        inversions: Inversions = "allowed",
        max_iterations: int | None = None,
        report: Collection[Reported] | Mapping[Reported, int] = (),
    ):
        """Prepares steps of a model.

        Args:
            model: A model with particles or free bodies.
            friction: Coefficient of particles, as of :class:`warp_bsc.SolverCCD`, like all that follow but for
                ``max_iterations``. Below a speed of 0.5 mm/s it is proportional to the speed.
            bodies: Whether the solver moves free dynamic bodies, or leaves all of them where a program, or another
                solver, puts them.
            min_distance: Distance that pairs keep [m], or ``"model"``. Barriers push beyond it. Without this and
                ``particle_radius``, springs and particles without faces, such as ropes and grains, collide by their
                radii, as they have no other surface; cloth and shapes keep no distance. Where those radii are 0, they
                take no part, and a warning says so. An array, of one element, may require gradients.
            particle_radius: Radius of each particle [m], or one for all. An array may require gradients.
            collision_filter: Groups and masks of particles and shapes.
            inversions: What happens to tetrahedra that invert: ``"allowed"``, ``"reported"`` or ``"prevented"``.
            max_iterations: Newton steps of a step at most; it ends earlier where they converge, in some 2 if nothing
                hits. Fewer bound the time of an impact, and let cloth lag behind its forces; ``report.converged`` says
                whether they sufficed. While something that a program moves is on its way, at least 16 are allowed. By
                default 15, and 100 if the model requires gradients: steps then go on until less is left, some 2 more.
            report: What the report of a step has beside its results; impulses of ``"contacts"`` are those of barriers
                and friction at its end.

        Raises:
            TypeError: If an argument has another type.
            ValueError: If a number, or the friction of a shape that collides with particles, is out of range, if the
                model has neither particles nor bodies, if a joint holds a body that the solver is to move, or if the
                particles of a world do not follow each other in it.
            NotImplementedError: If the model has shapes that are not supported, see
                :class:`.response.state.mesh.ModelMesh`, or attaches particles to a body that the solver is to move.
        """
        check_instance(model, "model", (newton.Model, ModelView), "a newton.Model")
        if not model.particle_count and not model.body_count:
            raise ValueError("model: it has neither particles nor bodies")
        moves = checked_choice(bodies, "bodies", ("solved", "ignored")) == "solved"
        jointed = _find_jointed_body(model) if moves else None
        if jointed is not None:
            raise ValueError(
                f"a joint holds body {jointed} ({model.body_label[jointed]!r}), and SolverImplicit solves for free "
                "bodies only: in a coupled solver (newton.solvers.experimental.coupled), give the body and the joint "
                "to another entry, and this one a proxy of it; or pass bodies='ignored' if something else writes poses"
            )
        attached = attachment_arrays(model) if moves else None
        if attached is not None:
            if dynamic_bodies(model)[host_array(attached.body)].any():
                raise NotImplementedError(
                    "model: it attaches particles to a body that SolverImplicit would move; make the body kinematic, "
                    "or pass bodies='ignored' if something else writes its pose"
                )
        if max_iterations is None:
            max_iterations = MAX_PRECISE_STEPS if model.requires_grad else MAX_STEPS
        max_steps = checked_integer(max_iterations, "max_iterations", 1)
        super().__init__(
            _Inertia(model, moves_bodies=moves),
            bodies="separated" if moves and dynamic_bodies(model).any() else "ignored",
            restitution=0.0,
            friction=friction,
            min_distance=min_distance,
            particle_radius=particle_radius,
            collision_filter=collision_filter,
            inversions=inversions,
            report=report,
        )
        self.max_iterations = max_steps
        counts = {"results": self.report.results, "unconverged_steps": self.report.unconverged}
        method = self.newton_method = NewtonMethod(
            self.work, max_steps=max_steps, precise=model.requires_grad, **counts
        )
        method.prepare(arrays_of(model))
        if self._forces is not None:
            method.keeps_contacts, self._forces.more = True, method.publish
        self.gradients: StepGradients | None = None
        if model.requires_grad:
            method.keeps_contacts = True
            self.gradients = StepGradients(self.work, method, self.report.results.converged, self.report.of_gradients)
        if self._counter is not None:
            vars(self.report.worlds).update({name: getattr(self.report.results, name) for name in StepResults.vars})

    def __deepcopy__(self, memo):
        """Raises a TypeError, as a stage does."""
        raise TypeError("a SolverImplicit cannot be copied: make a new one of the same model")

    def _check_tape(self, state_in, state_out, mask):
        if mask is not None:
            raise NotImplementedError("world_mask: steps on a tape are of all worlds; omit it")
        if state_in is state_out:
            raise ValueError("on a tape, state_out must not be state_in")
        if not self.model.particle_count:
            raise NotImplementedError("steps of a model without particles carry no gradients: step outside the tape")

    @contextlib.contextmanager
    def _entered(self, step):
        """Keeps gradients of the step apart from those of what a program moves before it, and after it."""
        watched = contextlib.nullcontext()
        if self.gradients is not None and step.is_recorded:
            watched = self.gradients.between_steps.watched(step.tape, step.state_in, step.state_out)
        with super()._entered(step), watched:
            yield

    def _record(self, step, end):
        """Solves a step; the tape records its adjoint."""
        start, gradients = step.state_in, self.gradients
        assert gradients is not None
        starts = [start.particle_q, start.particle_qd, start.particle_f, start.body_q, start.body_qd, start.body_f]
        arrays = [*starts, end.particle_q, end.particle_qd, end.body_q, end.body_qd]
        recorded: RecordedStep | None = None
        place, before = gradients.add_step(step.tape)

        def forward():
            nonlocal recorded
            copies = StartArrays.of(start)
            self._resolve_motion(step, end)
            recorded = gradients.record(place, step.dt, copies, end)

        def backward():
            assert recorded is not None
            of_arrays = (None if array is None else array.grad for array in arrays)
            gradients.backward(recorded, before, StateGradients(*of_arrays))

        run_on_host(forward, self.mesh.device)
        self._record_backward(step.tape, backward, arrays)

    def _record_backward(self, tape, function, arrays):
        """Lets a tape call a function that changes the gradients of arrays, and of those that steps read."""
        device = self.mesh.device

        def backward():
            with self._lock:
                function()
            if not device.is_capturing:
                self.report.warn()

        changed = [array for array in arrays if array is not None and array.requires_grad]
        tape.record_func(lambda: run_on_host(backward, device), changed + self._read_arrays())

    def _take_checkpointed(self, step, state_in, state_out, *options):
        """Takes the steps of :func:`checkpointed`, and records them on the active tape, if any."""
        gradients, report = self.gradients, self.report
        assert gradients is not None
        with paused_tape() as tape:
            totals = report.total_values, report.unconverged, report.set_steps
            checkpoints = Checkpoints(gradients, totals, step, *options)
            if tape is None:
                checkpoints.take(None, state_in, state_out)
                return
            with gradients.between_steps.watched(tape, state_in, state_out):
                checkpoints.take(tape, state_in, state_out)
                arrays = [x for state in (state_in, state_out) for x in vars(state).values() if isinstance(x, wp.array)]
                found = tape.gradients  # not the tape, which would then hold itself
                self._record_backward(tape, lambda: checkpoints.go_back(found, state_in, state_out), arrays)

    def _read_arrays(self):
        """Returns the arrays that steps read beside those of states and get gradients, which a tape sets to zero."""
        model, friction = self.model, self._motion.friction
        names = ["gravity", "particle_inv_mass", "body_inv_mass", "body_inertia", "body_inv_inertia"]
        names += ["tri_poses", "tri_areas", "tri_materials", "tet_poses", "tet_materials"]
        names += [f"edge_{name}" for name in ("rest_angle", "rest_length", "bending_properties")]
        names += [f"spring_{name}" for name in ("rest_length", "stiffness", "damping")]
        distances = [] if self.mesh.distance_arrays is None else self.mesh.distance_arrays.inputs
        arrays = [*friction.inputs, *distances, *(getattr(model, name) for name in names)]
        attached = attachment_arrays(model)
        if attached is not None:
            arrays += [attached.body_point, attached.stiffness, attached.damping]
        return [array for array in arrays if array is not None and len(array) and array.requires_grad]

    def _resolve_end(self, step, end):
        gradients = self.gradients
        if gradients is not None:
            gradients.taken += 1
        if step.is_recorded:
            self._record(step, end)
            return
        super()._resolve_end(step, end)
        if gradients is not None:
            gradients.forget_last()

    def _solve(self, step, end):
        """Solves with contact from the inertial prediction, and detects what the solve left.

        Worlds in which it left contacts end the step earlier on their way, where there are none; what still collides is
        resolved as behind any solver.
        """
        work = self.work
        begin(work)
        self.newton_method.solve(end, step.dt)
        detect_contacts(work)
        wp.capture_if(work.loop[Loop.UNFINISHED], self.newton_method.retreat, end=end, detect=self._detect)
        resolve_contacts(work, step.dt)

    def _detect(self):
        begin(self.work)
        detect_contacts(self.work)

    def _measure_strain(self):
        motion = self._motion.vertices
        self._meter.measure(motion, motion.x0, self.report.last_strain)

    def update_contacts(self, contacts, state=None):
        """Raises NotImplementedError: the contacts of the solve are no contacts of Newton's pipeline."""
        raise NotImplementedError(
            'SolverImplicit does not use contacts of Newton, and has no forces of them: pass report=["contacts"], and '
            "read report.forces.contacts and the impulses beside it"
        )

    def notify_model_changed(self, flags: int) -> None:
        """Reads masses, materials, gravity and shapes again, see :class:`warp_bsc.SolverCCD`."""
        super().notify_model_changed(flags)
        if self.gradients is not None:
            self.gradients.between_steps.refresh()
        self.newton_method.read_materials()


def checkpointed(
    solver: SolverImplicit,
    step: CheckpointedStep,
    state_in: newton.State,
    state_out: newton.State,
    steps: int,
    *,
    every: int | None = None,
    outputs: Sequence[wp.array] = (),
) -> None:
    """Takes steps of a solver of which a tape keeps every ``every``-th state alone, see :doc:`/newton/gradients`.

    On its way back, the tape takes the steps again, ``every`` of them at a time, and has of these what it otherwise
    has of all. Gradients, their counts and norms are those of steps that are recorded one by one; totals of the report
    have each step once. Its results of the last step are those of the last one that was taken.

    Steps that end elsewhere when they are taken again, by a single bit, make gradients NaN, which
    ``report.gradient_counts.unrepeated`` counts, and a warning says so. Gradients with respect to positions that
    ``step`` writes into its states, rather than a kernel on the tape, are in none of its arrays.

    Args:
        solver: A solver whose model was finalized with ``requires_grad=True``.
        step: Takes a step, given its number from 0 on and the states in which it starts and is to end, by one call of
            ``solver.step`` or several. On a tape it is called twice for each number, and must do the same each time:
            it depends on nothing else that earlier steps change. What it launches is differentiated. Forces are 0 at
            the start of each step but the first.
        state_in: The state at the start.
        state_out: The state at the end.
        steps: How many steps to take, at least 1.
        every: Steps between two states that are kept, at least 1; by default the root of ``steps``, which needs the
            least memory.
        outputs: Arrays beside the states that steps write and that they have not made, such as a loss that they add
            to; no step reads them. They are set back after steps were taken again.

    Raises:
        TypeError: If an argument has another type.
        ValueError: If a number is out of range, if the model has no gradients, if ``state_out`` is ``state_in``, if
            ``step`` takes no step of the solver, or if the first step writes an array that ``outputs`` lacks.
    """
    check_instance(solver, "solver", SolverImplicit, "a SolverImplicit")
    gradients = solver.gradients
    if gradients is None:
        raise ValueError("solver: its model has no gradients; finalize it with requires_grad=True")
    if not callable(step):
        raise TypeError(f"step must be a function, not {given(step)}")
    for name, state in (("state_in", state_in), ("state_out", state_out)):
        check_instance(state, name, newton.State, "a newton.State")
    if state_out is state_in:
        raise ValueError("state_out must not be state_in")
    count = checked_integer(steps, "steps", 1)
    every = math.isqrt(count - 1) + 1 if every is None else checked_integer(every, "every", 1)
    check_instance(outputs, "outputs", (list, tuple), "a list of arrays")
    for array in outputs:
        check_instance(array, "outputs", wp.array, "a list of arrays")
    solver._take_checkpointed(step, state_in, state_out, count, every, outputs)
