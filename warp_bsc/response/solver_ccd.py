"""The collision stage for Newton: a solver that lets another one step, and makes what it did free of collisions."""

import contextlib
import time

import numpy as np
import warp as wp
from newton.solvers import SolverBase

from ..detection.host_function import run_on_host
from ..detection.intersections import find_intersections
from .adjoint import Recording, Undoing
from .constraints import CERTIFIED, FIRST_HITS, REMAINING, ROUND, UNDETECTED
from .model_mesh import ModelMesh
from .response import FROZEN, TRUNCATED, Response
from .step_record import GRAZING

__all__ = ["SolverCCD", "SolverReport"]

_SEPARATION = 5e-3
"""Default distance that contacts are moved apart, as a share of the median length of an edge."""

_TOLERANCE = 0.1
"""How precisely constraints are solved, as a share of the separation. With gradients all iterations are made: whether a
constraint still acts would else depend on ever so little, and results would jump."""

_STEPS, _UNCERTIFIED_STEPS, _TRUNCATED_STEPS, _FROZEN_STEPS, _GRAZING, _LOST_GRADIENTS, _TOTALS = (
    wp.constant(i) for i in range(7)
)
"""Places in the array of totals, and how many there are."""


@wp.kernel(enable_backward=False)
def _start_velocities(
    particle_qd: wp.array[wp.vec3],
    x0: wp.array[wp.vec3],
    x1: wp.array[wp.vec3],
    dt: float,
    velocity: wp.array[wp.vec3],
):
    vertex = wp.tid()
    if vertex < particle_qd.shape[0]:
        velocity[vertex] = particle_qd[vertex]
    else:
        velocity[vertex] = (x1[vertex] - x0[vertex]) / dt


@wp.kernel(enable_backward=False)
def _write_back(
    done: wp.array[int],
    x1: wp.array[wp.vec3],
    velocity: wp.array[wp.vec3],
    particle_q: wp.array[wp.vec3],
    particle_qd: wp.array[wp.vec3],
    fallbacks: wp.array[int],
):
    """Only what the response has changed, so that the rest stays as it is bit for bit."""
    particle = wp.tid()
    if done[particle] != 0:
        particle_q[particle] = x1[particle]
        particle_qd[particle] = velocity[particle]
    if done[particle] & TRUNCATED != 0:
        fallbacks[0] = 1
    if done[particle] & FROZEN != 0:
        fallbacks[1] = 1


@wp.kernel(enable_backward=False)
def _count_step(steer: wp.array[int], fallbacks: wp.array[int], totals: wp.array[int]):
    totals[_STEPS] = totals[_STEPS] + 1
    totals[_UNCERTIFIED_STEPS] = totals[_UNCERTIFIED_STEPS] + 1 - steer[CERTIFIED]
    totals[_TRUNCATED_STEPS] = totals[_TRUNCATED_STEPS] + fallbacks[0]
    totals[_FROZEN_STEPS] = totals[_FROZEN_STEPS] + fallbacks[1]


@contextlib.contextmanager
def _paused_tape():
    """Keeps launches from being recorded on the tape that is active, if any, and gives it."""
    tape = wp._src.context.runtime.tape  # there is no public way to ask
    if tape is None:
        yield None
        return
    tape.__exit__(None, None, None)
    try:
        yield tape
    finally:
        tape.__enter__()


@wp.kernel(enable_backward=False)
def _count_recording(sizes: wp.array[int], complete: wp.array[int], totals: wp.array[int]):
    totals[_GRAZING] = totals[_GRAZING] + sizes[GRAZING]
    totals[_LOST_GRADIENTS] = totals[_LOST_GRADIENTS] + 1 - complete[0]


class SolverReport:
    """What a :class:`SolverCCD` found and did. It stays on the device, and is read from there when asked."""

    def __init__(self, mesh, response, totals):
        """Of which solver, by its parts."""
        self._mesh, self._response, self._totals = mesh, response, totals
        self._start, self._end = None, None  # of the last step, in seconds, or events on a GPU

    @property
    def certified(self) -> bool:
        """Whether the motion of the last step, as stored, was detected to be free of collisions, with none dropped."""
        return bool(self._steer(CERTIFIED))

    @property
    def hits(self) -> int:
        """Contacts of the motion that the inner solver wanted for the last step."""
        return self._steer(FIRST_HITS)

    @property
    def remaining(self) -> int:
        """Contacts of the motion of the last step that could not be resolved, as what is kinematic leaves no room."""
        return self._steer(REMAINING)

    @property
    def undetected(self) -> bool:
        """Whether the last step stood still because it could not be detected.

        Positions were not finite, or a CUDA graph had too little room: step without it, which makes room, and capture
        anew.
        """
        return bool(self._steer(UNDETECTED))

    @property
    def rounds(self) -> int:
        """Rounds of response in the last step."""
        return self._steer(ROUND)

    @property
    def truncated(self) -> int:
        """Vertices whose paths were cut before a contact in the last step."""
        return self._done(TRUNCATED)

    @property
    def frozen(self) -> int:
        """Vertices that were left where they were in the last step."""
        return self._done(FROZEN)

    @property
    def intersections(self) -> np.ndarray:
        """(edge, face) that cross at the start of the last step, of the solver's ``mesh``, int32, shape [n, 2].

        What crosses already is not what the promise is about. Shapes that cross each other are left out. Looked for
        when asked, by exact arithmetic.
        """
        mesh, particles = self._mesh, self._mesh.model.particle_count
        pairs = find_intersections(self._response.detector.mesh, self._response.vertices.x0)
        of_particles = [(elements < particles).any(axis=1) for elements in (mesh.edges, mesh.faces)]
        return pairs[of_particles[0][pairs[:, 0]] | of_particles[1][pairs[:, 1]]]

    @property
    def milliseconds(self) -> float | None:
        """Time of the last step that was not captured, without the inner solver's [ms]; None if there was none."""
        if self._start is None:
            return None
        if isinstance(self._start, wp.Event):
            return wp.get_event_elapsed_time(self._start, self._end)
        return 1e3 * (self._end - self._start)

    @property
    def steps(self) -> int:
        """Steps taken so far."""
        return self._total(_STEPS)

    @property
    def uncertified_steps(self) -> int:
        """Steps so far that were not certified."""
        return self._total(_UNCERTIFIED_STEPS)

    @property
    def truncated_steps(self) -> int:
        """Steps so far in which a path was cut."""
        return self._total(_TRUNCATED_STEPS)

    @property
    def frozen_steps(self) -> int:
        """Steps so far in which a vertex was left where it was."""
        return self._total(_FROZEN_STEPS)

    @property
    def grazing(self) -> int:
        """Contacts so far, in steps on a tape, whose gradients are clamped.

        Features that slide along each other, or have no plane, have no derivative that is of any use; what is taken
        instead is finite, see :mod:`warp_bsc.kernels.gradients`.
        """
        return self._total(_GRAZING)

    @property
    def lost_gradients(self) -> int:
        """Steps so far on a tape, in a CUDA graph, that found too little room to be taken down.

        Gradients that go back through such a step are NaN. Step without the graph, on a tape, which makes room, and
        capture anew.
        """
        return self._total(_LOST_GRADIENTS)

    def __str__(self):
        """The steps so far, in a line."""
        line = (
            f"{self.steps} steps, {self.truncated_steps} with truncation, {self.frozen_steps} with vertices "
            f"left standing, {self.uncertified_steps} not certified"
        )
        if self.grazing or self.lost_gradients:
            line += f"; gradients: {self.grazing} grazing contacts, {self.lost_gradients} steps lost"
        return line

    def _steer(self, place):
        return int(self._response.steer.numpy()[int(place)])

    def _done(self, bit):
        return int(np.count_nonzero(self._response.vertices.done.numpy() & int(bit)))

    def _total(self, place):
        return int(self._totals.numpy()[int(place)])


class SolverCCD(SolverBase):
    """Lets another solver step, then makes the motion that it wanted free of collisions.

    The cloth and the surfaces of soft bodies do not pass through each other, themselves, or rigid shapes that collide
    with particles. Everything else is the inner solver's: what is not defined here is asked of it.

    A step on a :class:`warp.Tape` carries gradients, if the model was finalized with ``requires_grad=True`` and the
    inner solver is differentiable: from positions and velocities of particles at its end to those at its start, and to
    those that the inner solver wanted. Which contacts there were is taken as given; the rest is the derivative of what
    was computed, see :mod:`.adjoint`. The motion of bodies is a constant. With ``requires_grad`` all
    iterations are made, so that results do not jump.

    Attributes:
        solver: The inner solver.
        mesh: The triangles that collide, :class:`ModelMesh`.
        report: What was found and done, :class:`SolverReport`.
    """

    def __init__(self, solver, *, separation=None, friction=None, restitution=None):
        """Puts the stage behind a solver.

        Args:
            solver: Any Newton solver that moves particles.
            separation: How far contacts are moved apart [m]; default: 0.005 of the median length of an edge.
            friction: Coefficient of particles; default: the model's ``particle_mu``. That of shapes is their
                material's, that of a contact the geometric mean.
            restitution: Which part of the approaching velocity comes back, in [0, 1]; default: the model's
                ``soft_contact_restitution``.

        Raises:
            ValueError: If a number is out of range, or the friction of a shape that collides with particles is.
            NotImplementedError: If the model has shapes that are not supported, see :class:`ModelMesh`.
        """
        self.solver = solver
        super().__init__(solver.model)
        self.collision_pipeline = solver.collision_pipeline
        self.supports_collision_pipeline = solver.supports_collision_pipeline
        self.supports_body_pair_reduced_contacts = solver.supports_body_pair_reduced_contacts
        model = solver.model
        friction = model.particle_mu if friction is None else friction
        restitution = model.soft_contact_restitution if restitution is None else restitution
        if not 0.0 <= friction <= float(np.finfo(np.float32).max):
            raise ValueError(f"friction must be at least 0, and finite in single precision, not {friction!r}")
        if not 0.0 <= restitution <= 1.0:
            raise ValueError(f"restitution must be in [0, 1], not {restitution!r}")
        self.mesh = mesh = ModelMesh(model)
        if separation is None:
            separation = _SEPARATION * self._median_edge()
        elif not 0.0 < separation < np.inf:
            raise ValueError(f"separation must be more than 0, not {separation!r}")
        shape_friction = np.zeros(0) if model.shape_material_mu is None else model.shape_material_mu.numpy()
        for shape in np.union1d(mesh.shape_vertices.shape, mesh.planes.shape):
            if not shape_friction[shape] >= 0.0:
                raise ValueError(f"shape {shape} ({model.shape_label[shape]!r}) has friction {shape_friction[shape]}")
        vertex_friction = np.full(mesh.vertex_count, friction, dtype=np.float32)
        vertex_friction[model.particle_count :] = shape_friction[mesh.shape_vertices.shape]
        self._response = Response(
            mesh,
            wp.array(vertex_friction, dtype=float, device=mesh.device),
            wp.array(shape_friction[mesh.planes.shape], dtype=float, device=mesh.device),
            separation=float(separation),
            restitution=float(restitution),
            tolerance=0.0 if model.requires_grad else _TOLERANCE,
        )
        self._response.prepare()
        self._fallbacks = wp.zeros(2, dtype=int, device=mesh.device)
        self._totals = wp.zeros(int(_TOTALS), dtype=int, device=mesh.device)
        self.report = SolverReport(mesh, self._response, self._totals)

    def _median_edge(self):
        """The median length of an edge of the cloth and soft bodies at rest [m]; 1 if they have none."""
        rest = self.model.particle_q.numpy() if self.model.particle_count else np.zeros((0, 3))
        edges = self.mesh.edges[self.mesh.edges[:, 1] < self.model.particle_count]
        lengths = np.linalg.norm(rest[edges[:, 1]] - rest[edges[:, 0]], axis=1)
        return float(np.median(lengths)) if lengths.any() else 1.0

    def step(self, state_in, state_out, control, contacts, dt, **options):
        """Steps the inner solver, and changes positions and velocities of particles where their motion collides.

        Args:
            state_in: The state at the start; the inner solver may change it.
            state_out: The state at the end. May be the same.
            control: As for the inner solver.
            contacts: As for the inner solver.
            dt: Length of the step [s].
            options: As for the inner solver.

        Raises:
            ValueError: If gradients are to be taken down on a tape, and both states are the same.
            RuntimeError: If they are, in a CUDA graph, and there was no such step outside one.
        """
        response = self._response
        with _paused_tape() as tape:
            if tape is not None and state_in is state_out and self.model.requires_grad:
                raise ValueError("gradients need the state at the start: step into another state")
            response.start(state_in.particle_q, state_in.body_q)  # now: some solvers overwrite it
        self.solver.step(state_in, state_out, control, contacts, dt, **options)
        with _paused_tape() as tape:
            self._respond(state_in, state_out, dt, tape)

    def _respond(self, state_in, state_out, dt, tape):
        """Changes what the inner solver has made of a state; a tape takes down how gradients go back."""
        device = self.mesh.device
        particle_q, particle_qd, body_q = state_out.particle_q, state_out.particle_qd, state_out.body_q
        if tape is None or particle_q is None or not particle_q.requires_grad:
            run_on_host(lambda: self._resolve(particle_q, particle_qd, body_q, dt), device)
            return
        recording = None
        arrays = [state_in.particle_q, particle_q, particle_qd]

        def record():
            nonlocal recording
            self._resolve(particle_q, particle_qd, body_q, dt, records=True)
            recording = None
            if device.is_capturing or self._response.vertices.done.numpy().any():
                recording = Recording(self._response, dt)
                inputs = [self._response.history.arrays.sizes, recording.complete]
                wp.launch(_count_recording, 1, inputs=inputs, outputs=[self._totals], device=device)

        def go_back():
            if recording is not None:
                Undoing(recording, self._response).backward(*(array.grad for array in arrays))

        run_on_host(record, device)
        tape.record_func(lambda: run_on_host(go_back, device), arrays)

    def _resolve(self, particle_q, particle_qd, body_q, dt, *, records=False):
        """Resolves the motion from where the step started to these positions, and changes them."""
        response, device = self._response, self.mesh.device
        vertices = response.vertices
        self._lap(start=True)
        response.end(particle_q, body_q)
        inputs = [particle_qd, vertices.x0, vertices.x1, dt]
        wp.launch(_start_velocities, len(vertices.x0), inputs=inputs, outputs=[vertices.velocity], device=device)
        response.resolve(dt, records=records)
        self._fallbacks.zero_()
        inputs = [vertices.done, vertices.x1, vertices.velocity]
        outputs = [particle_q, particle_qd, self._fallbacks]
        wp.launch(_write_back, self.model.particle_count, inputs=inputs, outputs=outputs, device=device)
        inputs, outputs = [response.steer, self._fallbacks], [self._totals]
        wp.launch(_count_step, 1, inputs=inputs, outputs=outputs, device=device)
        self._lap(start=False)

    def _lap(self, *, start):
        device = self.mesh.device
        if device.is_capturing:
            return
        now = time.perf_counter()
        if device.is_cuda:
            now = wp.record_event(wp.Event(device, enable_timing=True))
        if start:
            self.report._start = now
        else:
            self.report._end = now

    def notify_model_changed(self, flags):
        """Tells the inner solver, and reads masses and flags of particles again. Shapes stay what they were."""
        self.solver.notify_model_changed(flags)
        self.mesh.refresh_inverse_masses()

    @property
    def contacts(self):
        """The inner solver's."""
        return self.solver.contacts

    @contacts.setter
    def contacts(self, value):
        self.solver.contacts = value

    @property
    def collision_frequency(self):
        """The inner solver's."""
        return self.solver.collision_frequency

    @property
    def collision_frequency_type(self):
        """The inner solver's."""
        return self.solver.collision_frequency_type

    @property
    def supported_observables(self):
        """The inner solver's."""
        return self.solver.supported_observables

    def set_collision_frequency(self, **options):
        """Sets the inner solver's."""
        self.solver.set_collision_frequency(**options)

    def observables(self, *arguments, **options):
        """The inner solver's."""
        return self.solver.observables(*arguments, **options)

    def validate_observables(self, *arguments, **options):
        """Asks the inner solver."""
        return self.solver.validate_observables(*arguments, **options)

    def reset(self, state, *arguments, **options):
        """Resets the inner solver; the stage itself remembers nothing from one step to the next."""
        self.solver.reset(state, *arguments, **options)

    def update_contacts(self, contacts, state=None):
        """Updates the inner solver's."""
        self.solver.update_contacts(contacts, state)

    def __getattr__(self, name):
        """What is not defined here, of the inner solver."""
        if name == "solver":
            raise AttributeError(name)
        return getattr(self.solver, name)
