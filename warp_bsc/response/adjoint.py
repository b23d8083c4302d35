"""The adjoint of a step: carries gradients from its results to its inputs, going back through the record of the step.

A step is a long chain of small changes: contacts become constraints, each sweep changes multipliers and by them
positions, paths are truncated, and in the end velocities change. Which contacts there were, which constraints were
active and when sweeps ended are constants; everything else is differentiated as it was computed. Warp makes the adjoint
of each small change, see :mod:`.adjoint_kernels`; this module restores the values that each was computed from.
Multipliers are in the record, and positions follow exactly from the changes of multipliers, as sums are integers.
"""

from types import SimpleNamespace

import warp as wp

from .adjoint_kernels import (
    Cursor,
    add_moments,
    add_torques,
    change_position_multipliers,
    change_velocity_multipliers,
    entry_of,
    initialize_multipliers,
    make_constraints,
    truncate_paths,
    turn_velocities,
)
from .angular_momentum import SUMS, turns
from .buffers import PROJECTED, Constraints, Motion, Progress, SolveStatus, Vertices
from .constraints import MAX_TRUNCATIONS
from .planes import MovingPlanes
from .projection import SWEEPS_PER_BATCH, add_delta, count_active, with_delta
from .step_record import (
    OFFSETS,
    PER_ENTRY,
    PER_TRUNCATION,
    RecordCounts,
    StepRecord,
    name_elements,
)

__all__ = ["RecordedStep", "StepAdjoint"]

_CONSTRAINT_ARRAYS = (
    "vertices",
    "weights",
    "normal",
    "separation",
    "friction",
    "kind",
    "within_tolerance",
    "toi",
    "approach",
    "slow",
    "position_multiplier",
    "velocity_multiplier",
    "previous_multiplier",
)
_RESTORED_CONSTRAINT_ARRAYS = "position_multiplier", "velocity_multiplier", "previous_multiplier"
_DIFFERENTIABLE = "weights", "normal", "separation", "approach", *_RESTORED_CONSTRAINT_ARRAYS
_MOTION_ARRAYS = "x0", "x1", "velocity"
_VERTEX_ARRAYS = "x1", "velocity", "particle_delta_x", "particle_delta_v", "outcome"
_RESTORED_VERTEX_ARRAYS = "x1", "velocity", "particle_delta_x", "particle_delta_v"
_KERNEL = {"enable_backward": False}


@wp.struct
class _Gradients:
    """Gradients with respect to positions and velocities at the place of the cursor."""

    x1: wp.array[wp.vec3]
    velocity: wp.array[wp.vec3]
    more_x1: wp.array[wp.vec3]  # added to x1 once everything has read it
    more_velocity: wp.array[wp.vec3]
    velocity_change: wp.array[wp.vec3]  # with respect to what constraints add to velocities


@wp.kernel(**_KERNEL)
def _begin(
    # in
    motion: Motion,
    status: SolveStatus,
    particle_q: wp.array[wp.vec3],
    particle_qd: wp.array[wp.vec3],
    # out
    gradients: _Gradients,
    x0: wp.array[wp.vec3],
):
    """Initializes gradients by those of the results; where an undetected step froze everything, only that of x0."""
    vertex = wp.tid()
    x1 = wp.vec3()
    velocity = wp.vec3()
    if vertex < particle_q.shape[0]:
        x1 = particle_q[vertex]
        velocity = particle_qd[vertex]
    x0[vertex] = wp.vec3()
    if status.undetected[0] == 1 and motion.inverse_mass[vertex] > 0.0:
        x0[vertex] = x1
        x1 = wp.vec3()
        velocity = wp.vec3()
    gradients.x1[vertex] = x1
    gradients.velocity[vertex] = velocity


@wp.kernel(**_KERNEL)
def _begin_adjoint(
    # in
    record: StepRecord,
    status: SolveStatus,
    max_iterations: int,
    complete: wp.array[int],
    # out
    cursor: Cursor,
    more_sweeps: wp.array[int],
    more_iterations: wp.array[int],
    iteration: wp.array[int],
):
    """Puts the cursor behind the last sweep on velocities; of an incomplete record, nothing is read."""
    cursor.current_sweep[0] = -1
    if complete[0] == 0:
        cursor.first_sweep[0] = 0
        cursor.next_sweep[0] = -1
        return
    last = wp.min(status.iteration[0], max_iterations + MAX_TRUNCATIONS + 1)
    cursor.iteration[0] = last
    cursor.first_sweep[0] = record.sweep_offsets[last + 1]
    cursor.next_sweep[0] = record.counts.sweeps[0] - 1
    more_sweeps[0] = wp.where(cursor.next_sweep[0] >= cursor.first_sweep[0], 1, 0)
    more_iterations[0] = 1
    iteration[0] = last


@wp.kernel(**_KERNEL)
def _begin_iteration(record: StepRecord, cursor: Cursor, more_sweeps: wp.array[int]):
    """Puts the cursor behind the last sweep on positions of its iteration."""
    iteration = cursor.iteration[0]
    cursor.first_sweep[0] = record.sweep_offsets[iteration]
    cursor.next_sweep[0] = record.sweep_offsets[iteration + 1] - 1
    more_sweeps[0] = wp.where(cursor.next_sweep[0] >= cursor.first_sweep[0], 1, 0)


@wp.kernel(**_KERNEL)
def _to_detection(cursor: Cursor, iteration: wp.array[int]):
    """Sets the iteration to that of the detection before the cursor's iteration."""
    iteration[0] = wp.max(cursor.iteration[0] - 1, 0)


@wp.kernel(**_KERNEL)
def _end_iteration(cursor: Cursor, more_iterations: wp.array[int]):
    """Moves the cursor to the iteration before."""
    cursor.iteration[0] = cursor.iteration[0] - 1
    more_iterations[0] = wp.where(cursor.iteration[0] >= 0, 1, 0)


@wp.kernel(**_KERNEL)
def _restore_multipliers(
    motion: Motion,
    vertices: Vertices,
    constraints: Constraints,
    record: StepRecord,
    cursor: Cursor,
    multiplier: wp.array[wp.vec3d],
    sums: wp.array2d[wp.int64],
):
    """Restores multipliers as they were before a sweep, and the sums of what they changed."""
    entry = entry_of(record, cursor.next_sweep[0], wp.tid())
    if cursor.next_sweep[0] < cursor.first_sweep[0] or entry < 0:
        return
    i = record.constraint[entry]
    old = record.multiplier[entry]
    add_delta(motion, constraints, i, old - multiplier[i], sums)
    multiplier[i] = old
    constraints.previous_multiplier[i] = record.previous_multiplier[entry]
    count_active(motion, vertices, constraints, i)


@wp.func
def _step_back(vertex: int, cursor: Cursor, more_sweeps: wp.array[int]):
    """Makes the next sweep the current one, and the one before it the next."""
    if vertex == 0:
        sweep = cursor.next_sweep[0]
        exists = sweep >= cursor.first_sweep[0]
        cursor.current_sweep[0] = wp.where(exists, sweep, -1)
        cursor.next_sweep[0] = wp.where(exists, sweep - 1, sweep)
        more_sweeps[0] = wp.where(cursor.next_sweep[0] >= cursor.first_sweep[0], 1, 0)


@wp.kernel(**_KERNEL)
def _restore_positions(
    motion: Motion, vertices: Vertices, gradients: _Gradients, cursor: Cursor, more_sweeps: wp.array[int]
):
    """Restores positions as they were before a sweep, and adds up their gradients."""
    vertex = wp.tid()
    _step_back(vertex, cursor, more_sweeps)
    gradients.x1[vertex] = gradients.x1[vertex] + gradients.more_x1[vertex]
    gradients.more_x1[vertex] = wp.vec3()
    if vertices.active[vertex] != 0 and motion.inverse_mass[vertex] > 0.0:
        vertices.x1[vertex] = with_delta(motion.x1[vertex], vertices.particle_delta_x, vertex)


@wp.kernel(**_KERNEL)
def _restore_unturned(motion: Motion, vertices: Vertices):
    """Restores velocities as they were before vertices were turned."""
    vertex = wp.tid()
    if turns(motion, vertices, vertex):
        vertices.velocity[vertex] = with_delta(motion.velocity[vertex], vertices.particle_delta_v, vertex)


@wp.kernel(**_KERNEL)
def _restore_velocities(
    motion: Motion, vertices: Vertices, gradients: _Gradients, cursor: Cursor, more_sweeps: wp.array[int]
):
    """Restores velocities as they were before a sweep, and adds up their gradients."""
    vertex = wp.tid()
    _step_back(vertex, cursor, more_sweeps)
    gradients.velocity[vertex] = gradients.velocity[vertex] + gradients.more_velocity[vertex]
    gradients.more_velocity[vertex] = wp.vec3()
    gradients.velocity_change[vertex] = wp.vec3()
    if motion.inverse_mass[vertex] > 0.0 and vertices.outcome[vertex] <= PROJECTED:
        gradients.velocity_change[vertex] = gradients.velocity[vertex]
        vertices.velocity[vertex] = with_delta(motion.velocity[vertex], vertices.particle_delta_v, vertex)


@wp.kernel(**_KERNEL)
def _restore_paths(
    # in
    vertices: Vertices,
    gradients: _Gradients,
    record: StepRecord,
    cursor: Cursor,
    # out
    end: wp.array[wp.vec3],
    velocity: wp.array[wp.vec3],
):
    """Restores the ends of truncated paths; the gradients of their vertices move to ``end`` and ``velocity``."""
    iteration = cursor.iteration[0]
    entry = record.truncation_offsets[iteration] + wp.tid()
    if entry >= record.truncation_offsets[iteration + 1]:
        return
    vertex = record.vertex[entry]
    end[entry] = gradients.x1[vertex]
    velocity[entry] = gradients.velocity[vertex]
    gradients.x1[vertex] = wp.vec3()
    gradients.velocity[vertex] = wp.vec3()
    vertices.x1[vertex] = record.end[entry]


@wp.kernel(**_KERNEL)
def _finish(
    # in
    gradients: _Gradients,
    x0: wp.array[wp.vec3],
    wanted_x1: wp.array[wp.vec3],
    wanted_velocity: wp.array[wp.vec3],
    complete: wp.array[int],
    # out
    start_q: wp.array[wp.vec3],
    particle_q: wp.array[wp.vec3],
    particle_qd: wp.array[wp.vec3],
):
    """Writes the gradients of the inputs of the step; NaN if its record is incomplete."""
    particle = wp.tid()
    missing = float(0.0)
    if complete[0] == 0:
        missing = wp.nan
    x1 = gradients.x1[particle] + gradients.more_x1[particle] + wanted_x1[particle]
    velocity = gradients.velocity[particle] + gradients.more_velocity[particle] + wanted_velocity[particle]
    particle_q[particle] = x1 + wp.vec3(missing)
    particle_qd[particle] = velocity + wp.vec3(missing)
    start_q[particle] = start_q[particle] + x0[particle] + wp.vec3(missing)


@wp.kernel(**_KERNEL)
def _check_complete(constraints: wp.array[int], record: StepRecord, capacity: int, complete: wp.array[int]):
    """Sets ``complete`` to 1 if everything that a step did fits in its record, else to 0."""
    counts = record.counts
    fits = constraints[0] <= capacity and counts.dropped[0] == 0
    fits = fits and counts.sweeps[0] <= record.sweep_ends.shape[0]
    fits = fits and counts.entries[0] <= record.constraint.shape[0]
    fits = fits and counts.truncations[0] <= record.vertex.shape[0]
    complete[0] = wp.where(fits, 1, 0)


class RecordedStep:
    """A copy of a step for its adjoint: its record and results, as far as they fit in the buffers of a CUDA graph.

    Attributes:
        dt: Length of the step [s].
        motion: The motion that the inner solver wanted, :class:`.buffers.Motion`.
        planes: The planes, :class:`.planes.MovingPlanes`.
        vertices: The vertices at the end, :class:`.buffers.Vertices`.
        constraints: The constraints at the end, :class:`.buffers.Constraints`.
        status: The solve status at the end, :class:`.buffers.SolveStatus`.
        record: What each sweep and truncation changed, :class:`.step_record.StepRecord`.
        complete: Array of one int, 1 if nothing is missing.
    """

    def __init__(self, motion, resolution, recorder, dt: float):
        """Copies a step.

        Args:
            motion: The :class:`.model_motion.ModelMotion` that was resolved.
            resolution: The :class:`.response.Resolution`.
            recorder: The :class:`.step_record.StepRecorder` that recorded it.
            dt: Length of the step [s].
        """
        self.dt = dt
        constraints, record, device = resolution.constraints, recorder.record, recorder.counts.device
        if device.is_capturing:
            count, sweeps = len(constraints.vertices), len(record.sweep_ends)
            entries, truncations = len(record.constraint), len(record.vertex)
        else:
            count = int(constraints.count.numpy()[0])
            sweeps, entries, truncations = (
                int(getattr(record.counts, name).numpy()[0]) for name in ("sweeps", "entries", "truncations")
            )
        self.status = name_elements(SolveStatus, wp.clone(resolution.status_values))
        self.planes = _copied(motion.planes, MovingPlanes(), dict.fromkeys(("start", "end")))
        self.motion = _copied(motion.vertices, Motion(), dict.fromkeys(_MOTION_ARRAYS))
        for name in ("inverse_mass", "friction", "world"):
            setattr(self.motion, name, getattr(motion.vertices, name))
        self.vertices = _copied(resolution.vertices, Vertices(), dict.fromkeys(_VERTEX_ARRAYS))
        lengths = {**dict.fromkeys(_CONSTRAINT_ARRAYS, count), "count": 1}
        self.constraints = _copied(constraints, Constraints(), lengths)
        lengths = {"sweep_ends": sweeps, **dict.fromkeys(OFFSETS)}
        lengths |= {**dict.fromkeys(PER_ENTRY, entries), **dict.fromkeys(PER_TRUNCATION, truncations)}
        self.record = _copied(record, StepRecord(), lengths)
        self.record.counts = name_elements(RecordCounts, wp.clone(recorder.counts))
        self.complete = wp.empty(1, dtype=int, device=device)
        inputs = [constraints.count, record, count]
        wp.launch(_check_complete, 1, inputs=inputs, outputs=[self.complete], device=device)


def _copied(struct, into, lengths):
    """Copies the first elements of a struct's arrays, by name, into one of the same type; None: all."""
    for name, length in lengths.items():
        array = getattr(struct, name)
        if length == 0:  # Warp makes no empty slices
            setattr(into, name, wp.empty(0, dtype=array.dtype, device=array.device))
        else:
            setattr(into, name, wp.clone(array if length is None else array[:length]))
    return into


def _give_gradients(struct, names, gradients=None):
    """Replaces arrays of a struct by aliases with gradients, given or new ones; returns the gradients by name."""
    into = SimpleNamespace(**(gradients or {}))
    for name in names:
        array = getattr(struct, name)
        if not hasattr(into, name):
            setattr(into, name, wp.zeros_like(array))
        if len(array):
            alias = array[:]
            alias.grad = getattr(into, name)
            setattr(struct, name, alias)
    return into


class StepAdjoint:
    """Goes back through a recorded step, and carries gradients along."""

    def __init__(self, step: RecordedStep, response):
        """Copies what going back changes.

        Args:
            step: The step.
            response: The :class:`.response.Response` that resolved it.
        """
        self._step, self._response, self._device = step, response, response.device
        self._constraint_count = len(step.constraints.vertices)
        device, n = self._device, len(step.motion.x0)
        self._gradients = gradients = _Gradients()
        for name in _Gradients.vars:
            setattr(gradients, name, wp.zeros(n, dtype=wp.vec3, device=device))
        self._motion = motion = Motion()
        for name in (*_MOTION_ARRAYS, "inverse_mass", "friction", "world"):
            setattr(motion, name, getattr(step.motion, name))
        self._of_motion = _give_gradients(motion, _MOTION_ARRAYS)
        self._vertices = vertices = _copied(step.vertices, Vertices(), dict.fromkeys(_RESTORED_VERTEX_ARRAYS))
        vertices.outcome = step.vertices.outcome
        vertices.active = wp.zeros(n, dtype=int, device=device)
        of_vertices = {"x1": gradients.more_x1, "velocity": gradients.more_velocity}
        _give_gradients(vertices, of_vertices, of_vertices)
        self._constraints = constraints = _copied(
            step.constraints, Constraints(), dict.fromkeys(_RESTORED_CONSTRAINT_ARRAYS)
        )
        for name in set(_CONSTRAINT_ARRAYS) - set(_RESTORED_CONSTRAINT_ARRAYS) | {"count"}:
            setattr(constraints, name, getattr(step.constraints, name))
        self._of_constraints = _give_gradients(constraints, _DIFFERENTIABLE)
        truncations = len(step.record.vertex)
        self._of_truncations = [wp.zeros(truncations, dtype=wp.vec3, device=device) for _ in range(2)]
        self._vertex_changes = wp.empty(n, dtype=wp.vec3, device=device)
        self._progress = Progress()
        self._progress.status = name_elements(SolveStatus, wp.zeros(len(SolveStatus.vars), dtype=int, device=device))
        self._cursor = name_elements(Cursor, wp.zeros(len(Cursor.vars), dtype=int, device=device))
        self._more_sweeps, self._more_iterations = (wp.zeros(1, dtype=int, device=device) for _ in range(2))

    def backward(
        self, start_q: wp.array[wp.vec3], particle_q: wp.array[wp.vec3], particle_qd: wp.array[wp.vec3]
    ) -> None:
        """Turns gradients with respect to the results of the step into those with respect to its inputs, in place.

        Args:
            start_q: Gradient with respect to positions at the start, shape [particle_count]; is added to.
            particle_q: Gradient with respect to the positions at the end, shape [particle_count]; becomes that with
                respect to the positions that the inner solver wanted.
            particle_qd: The same for the velocities.
        """
        step, motion, gradients, of_motion = self._step, self._motion, self._gradients, self._of_motion
        iteration = self._progress.status.iteration
        inputs, outputs = [motion, step.status, particle_q, particle_qd], [gradients, of_motion.x0]
        self._launch(_begin, len(motion.x0), inputs, outputs)
        inputs = [step.record, step.status, self._response.max_iterations, step.complete]
        outputs = [self._cursor, self._more_sweeps, self._more_iterations, iteration]
        self._launch(_begin_adjoint, 1, inputs, outputs)
        self._through_turn()
        wp.capture_while(self._more_sweeps, self._batch, through=self._through_velocity_sweep)
        self._through_initialization()
        wp.capture_while(self._more_iterations, self._through_iteration)
        inputs = [gradients, of_motion.x0, of_motion.x1, of_motion.velocity, step.complete]
        self._launch(_finish, len(particle_q), inputs, [start_q, particle_q, particle_qd])

    def _through_turn(self):
        """Goes back through the turn that conserves angular momentum."""
        motion, vertices, constraints = self._motion, self._vertices, self._constraints
        n = len(motion.x0)
        self._launch(_restore_unturned, n, [motion, vertices])
        totals = wp.zeros((self._response.worlds, int(SUMS)), dtype=wp.float64, device=self._device, requires_grad=True)
        self._launch(add_torques, self._constraint_count, [motion, vertices, constraints], [totals])
        self._launch(add_moments, n, [motion, vertices], [totals])
        self._adjoin(turn_velocities, n, [motion, vertices, totals], [self._gradients.velocity])
        self._adjoin(add_moments, n, [motion, vertices], [totals.grad])
        self._adjoin(add_torques, self._constraint_count, [motion, vertices, constraints], [totals.grad])

    def _batch(self, through):
        for _ in range(SWEEPS_PER_BATCH):
            through()

    def _through_velocity_sweep(self):
        """Goes back through a sweep on velocities."""
        constraints, of_constraints = self._constraints, self._of_constraints
        self._restore_multipliers(constraints.velocity_multiplier, self._vertices.particle_delta_v)
        self._restore(_restore_velocities)
        self._adjoin(
            change_velocity_multipliers,
            self._constraint_count,
            [self._motion, self._vertices, constraints, self._step.record, self._cursor, self._response.restitution],
            [of_constraints.velocity_multiplier, of_constraints.previous_multiplier, self._gradients.velocity_change],
        )
        self._vertices.active.zero_()

    def _through_initialization(self):
        """Goes back through the initial velocity multipliers."""
        of_constraints = self._of_constraints
        self._restore(_restore_velocities)
        self._adjoin(
            initialize_multipliers,
            self._constraint_count,
            [self._motion, self._constraints, self._step.dt],
            [of_constraints.velocity_multiplier, of_constraints.previous_multiplier, self._gradients.velocity_change],
        )
        of_constraints.previous_multiplier.zero_()

    def _through_iteration(self):
        """Goes back through an iteration: truncation, sweeps, and the constraints that its detection added."""
        self._restore(_restore_positions)
        self._through_truncation()
        self._launch(_begin_iteration, 1, [self._step.record, self._cursor], [self._more_sweeps])
        wp.capture_while(self._more_sweeps, self._batch, through=self._through_position_sweep)
        self._launch(_to_detection, 1, [self._cursor], [self._progress.status.iteration])
        step, of_constraints, separation = self._step, self._of_constraints, self._response.separation
        self._adjoin(
            make_constraints,
            self._constraint_count,
            [self._motion, self._vertices, step.constraints, self._progress, step.record, self._cursor, separation],
            [of_constraints.weights, of_constraints.normal, of_constraints.separation, of_constraints.approach],
        )
        self._launch(_end_iteration, 1, [self._cursor], [self._more_iterations])

    def _through_position_sweep(self):
        """Goes back through a sweep on positions."""
        constraints, of_constraints = self._constraints, self._of_constraints
        self._restore_multipliers(constraints.position_multiplier, self._vertices.particle_delta_x)
        self._restore(_restore_positions)
        self._adjoin(
            change_position_multipliers,
            self._constraint_count,
            [self._motion, self._vertices, constraints, self._progress, self._step.record, self._cursor],
            [of_constraints.position_multiplier, of_constraints.previous_multiplier, self._gradients.x1],
        )
        self._vertices.active.zero_()

    def _through_truncation(self):
        """Goes back through the truncation of paths."""
        motion, vertices, step = self._motion, self._vertices, self._step
        truncations = len(step.record.vertex)
        inputs = [vertices, self._gradients, step.record, self._cursor]
        self._launch(_restore_paths, truncations, inputs, self._of_truncations)
        inputs = [motion, vertices, step.planes, step.record, self._cursor, step.dt]
        self._adjoin(truncate_paths, truncations, inputs, self._of_truncations)

    def _restore(self, kernel):
        """Restores positions or velocities as they were before a sweep."""
        inputs = [self._motion, self._vertices, self._gradients, self._cursor, self._more_sweeps]
        self._launch(kernel, len(self._motion.x0), inputs)

    def _restore_multipliers(self, multiplier, sums):
        inputs = [self._motion, self._vertices, self._constraints, self._step.record, self._cursor, multiplier]
        self._launch(_restore_multipliers, self._constraint_count, inputs, [sums])

    def _launch(self, kernel, dim, inputs, outputs=()):
        wp.launch(kernel, dim, inputs=inputs, outputs=outputs, device=self._device)

    def _adjoin(self, kernel, dim, inputs, of_outputs):
        """Launches the adjoint of a kernel, given the gradients with respect to its outputs.

        The adjoint does not read or write outputs, so their gradients stand in for them, except for the changes of
        vertices, which functions add to.
        """
        gradients = self._gradients
        added_to = gradients.x1, gradients.velocity_change
        outputs = [self._vertex_changes if any(of is x for x in added_to) else of for of in of_outputs]
        of_inputs = [value._cls() if hasattr(value, "_cls") else None for value in inputs]
        wp.launch(
            kernel,
            dim,
            inputs=inputs,
            outputs=outputs,
            adj_inputs=of_inputs,
            adj_outputs=of_outputs,
            adjoint=True,
            device=self._device,
        )
