"""The adjoint of a step: carries gradients from its results to its inputs, going back through the record of the step.

A step is a long chain of small changes: contacts become constraints, each sweep changes multipliers and by them
positions, paths are truncated, and in the end velocities change. Which contacts there were, which constraints were
active and when sweeps ended are constants; everything else is differentiated as it was computed. Warp makes the adjoint
of each small change, see :mod:`.adjoint_kernels`; this module restores the values that each was computed from.
Multipliers are in the record, and positions follow exactly from the changes of multipliers, as sums are integers.
"""

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
from .bodies import add_body_delta
from .body_adjoint import BodyAdjoint, copied, give_gradients, launch_adjoint
from .buffers import PROJECTED, Bodies, Constraints, Motion, MovedBodies, Progress, SolveStatus, Vertices
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
    truncation_at,
)

__all__ = ["RecordedStep", "StepAdjoint"]

_CONSTRAINT_ARRAYS = (
    "vertices",
    "weights",
    "normal",
    "separation",
    "friction",
    "kind",
    "plane",
    "within_tolerance",
    "toi",
    "approach",
    "slow",
    "position_multiplier",
    "velocity_multiplier",
    "previous_multiplier",
)
_RESTORED_CONSTRAINT_ARRAYS = "position_multiplier", "velocity_multiplier", "previous_multiplier"
_DIFFERENTIABLE = "weights", "normal", "separation", "friction", "approach", *_RESTORED_CONSTRAINT_ARRAYS
_MOTION_ARRAYS = "x0", "x1", "velocity"
_BODY_MOTION_ARRAYS = "start", "end", "velocity", "inverse_mass"
_MOVED_BODY_ARRAYS = "pose", "velocity", "delta_x", "delta_v", "outcome"
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
    x: wp.array[wp.vec3],
    body_sums: wp.array2d[wp.int64],
):
    """Restores multipliers as they were before a sweep, and the sums of what they changed, at positions ``x``."""
    entry = entry_of(record, cursor.next_sweep[0], wp.tid())
    if cursor.next_sweep[0] < cursor.first_sweep[0] or entry < 0:
        return
    i = record.constraint[entry]
    old = record.multiplier[entry]
    add_delta(motion, constraints, i, old - multiplier[i], sums)
    if motion.bodies.of_vertex:
        add_body_delta(motion, vertices, constraints, i, old - multiplier[i], x, body_sums)
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
    entry = truncation_at(record, cursor.iteration[0], wp.tid())
    if entry < 0:
        return
    vertex = record.vertex[entry]
    if vertex < 0:
        return
    end[entry] = gradients.x1[vertex]
    velocity[entry] = gradients.velocity[vertex]
    gradients.x1[vertex] = wp.vec3()
    gradients.velocity[vertex] = wp.vec3()
    vertices.x1[vertex] = record.end[entry]


@wp.kernel(**_KERNEL)
def _finish(
    # in
    motion: Motion,
    gradients: _Gradients,
    x0: wp.array[wp.vec3],
    wanted_x1: wp.array[wp.vec3],
    wanted_velocity: wp.array[wp.vec3],
    inverse_mass: wp.array[float],
    friction: wp.array[float],
    complete: wp.array[int],
    # out
    start_q: wp.array[wp.vec3],
    particle_q: wp.array[wp.vec3],
    particle_qd: wp.array[wp.vec3],
    particle_inv_mass: wp.array[float],
    restitution: wp.array[float],
):
    """Writes the gradients of the inputs of the step; NaN if its record is incomplete.

    Those of vertices of shapes remain gradients with respect to what was wanted of them.
    """
    particle = wp.tid()
    missing = float(0.0)
    if complete[0] == 0:
        missing = wp.nan
    x1 = gradients.x1[particle] + gradients.more_x1[particle] + wanted_x1[particle]
    velocity = gradients.velocity[particle] + gradients.more_velocity[particle] + wanted_velocity[particle]
    friction[particle] = friction[particle] + missing
    if particle == 0 and restitution:
        restitution[0] = restitution[0] + missing
    if particle >= particle_q.shape[0]:
        wanted_x1[particle] = x1
        wanted_velocity[particle] = velocity
        return
    if particle_inv_mass and motion.inverse_mass[particle] > 0.0:
        particle_inv_mass[particle] = particle_inv_mass[particle] + inverse_mass[particle] + missing
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
        mesh: The mesh, :class:`.model_mesh.ModelMesh`.
        friction: The coefficients of its vertices and planes, :class:`.friction.Friction`.
        moves_bodies: Whether the response can move bodies.
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
        self.dt, self.mesh, self.friction, self.moves_bodies = dt, motion.mesh, motion.friction, motion.moves_bodies
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
        self.planes = copied(motion.planes, MovingPlanes(), dict.fromkeys(("start", "end", "friction")))
        self.motion = copied(motion.vertices, Motion(), dict.fromkeys((*_MOTION_ARRAYS, "is_lost", "friction")))
        for name in ("inverse_mass", "world"):
            setattr(self.motion, name, getattr(motion.vertices, name))
        self.vertices = copied(resolution.vertices, Vertices(), dict.fromkeys(_VERTEX_ARRAYS))
        if motion.keeps_poses:
            bodies = Bodies()
            for name in Bodies.vars:
                setattr(bodies, name, getattr(motion.vertices.bodies, name))
            names = _BODY_MOTION_ARRAYS if motion.moves_bodies else ("start", "end")
            self.motion.bodies = copied(bodies, bodies, dict.fromkeys(names))
        if motion.moves_bodies:
            moved = copied(resolution.vertices.bodies, MovedBodies(), dict.fromkeys(_MOVED_BODY_ARRAYS))
            self.vertices.bodies = moved
        lengths = {**dict.fromkeys(_CONSTRAINT_ARRAYS, count), "count": 1}
        self.constraints = copied(constraints, Constraints(), lengths)
        lengths = {"sweep_ends": sweeps, **dict.fromkeys(OFFSETS)}
        lengths |= {**dict.fromkeys(PER_ENTRY, entries), **dict.fromkeys(PER_TRUNCATION, truncations)}
        self.record = copied(record, StepRecord(), lengths)
        self.record.counts = name_elements(RecordCounts, wp.clone(recorder.counts))
        self.complete = wp.empty(1, dtype=int, device=device)
        inputs = [constraints.count, record, count]
        wp.launch(_check_complete, 1, inputs=inputs, outputs=[self.complete], device=device)


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
        differentiable = *_MOTION_ARRAYS, "inverse_mass", "friction"
        for name in (*differentiable, "world", "is_lost"):
            setattr(motion, name, getattr(step.motion, name))
        self._of_motion = give_gradients(motion, differentiable)
        self._planes = planes = MovingPlanes()
        for name in ("start", "end", "friction"):
            setattr(planes, name, getattr(step.planes, name))
        self._of_planes = give_gradients(planes, ("start", "end", "friction"))
        self._vertices = vertices = copied(step.vertices, Vertices(), dict.fromkeys(_RESTORED_VERTEX_ARRAYS))
        vertices.outcome = step.vertices.outcome
        vertices.active = wp.zeros(n, dtype=int, device=device)
        of_vertices = {"x1": gradients.more_x1, "velocity": gradients.more_velocity}
        give_gradients(vertices, of_vertices, of_vertices)
        self._constraints = constraints = copied(
            step.constraints, Constraints(), dict.fromkeys(_RESTORED_CONSTRAINT_ARRAYS)
        )
        for name in set(_CONSTRAINT_ARRAYS) - set(_RESTORED_CONSTRAINT_ARRAYS) | {"count"}:
            setattr(constraints, name, getattr(step.constraints, name))
        self._of_constraints = give_gradients(constraints, _DIFFERENTIABLE)
        truncations = len(step.record.vertex)
        self._of_truncations = [wp.zeros(truncations, dtype=wp.vec3, device=device) for _ in range(2)]
        self._vertex_changes = wp.empty(n, dtype=wp.vec3, device=device)
        self._bodies = BodyAdjoint(step, gradients, motion, self._of_motion, vertices)
        self._progress = Progress()
        self._progress.status = name_elements(SolveStatus, wp.zeros(len(SolveStatus.vars), dtype=int, device=device))
        self._cursor = name_elements(Cursor, wp.zeros(len(Cursor.vars), dtype=int, device=device))
        self._more_sweeps, self._more_iterations = (wp.zeros(1, dtype=int, device=device) for _ in range(2))

    def backward(
        self,
        start_q: wp.array[wp.vec3],
        particle_q: wp.array[wp.vec3],
        particle_qd: wp.array[wp.vec3],
        start_body_q: wp.array[wp.transform] | None = None,
        body_q: wp.array[wp.transform] | None = None,
        body_qd: wp.array[wp.spatial_vector] | None = None,
    ) -> None:
        """Turns gradients with respect to the results of the step into those with respect to its inputs, in place.

        Adds to the gradients of the model with respect to masses, inertias and coefficients, where it has such arrays.

        Args:
            start_q: Gradient with respect to positions at the start, shape [particle_count]; is added to.
            particle_q: Gradient with respect to the positions at the end, shape [particle_count]; becomes that with
                respect to the positions that the inner solver wanted.
            particle_qd: The same for the velocities.
            start_body_q: As ``start_q`` for poses of bodies, shape [body_count]; None if the model has none.
            body_q: As ``particle_q`` for poses of bodies.
            body_qd: As ``particle_q`` for velocities of bodies.
        """
        step, motion, gradients, of_motion = self._step, self._motion, self._gradients, self._of_motion
        iteration = self._progress.status.iteration
        inputs, outputs = [motion, step.status, particle_q, particle_qd], [gradients, of_motion.x0]
        self._launch(_begin, len(motion.x0), inputs, outputs)
        inputs = [step.record, step.status, self._response.max_iterations, step.complete]
        outputs = [self._cursor, self._more_sweeps, self._more_iterations, iteration]
        self._launch(_begin_adjoint, 1, inputs, outputs)
        self._bodies.begin(body_q, body_qd)
        self._through_turn()
        wp.capture_while(self._more_sweeps, self._batch, through=self._through_velocity_sweep)
        self._through_initialization()
        self._bodies.leave_velocities()
        wp.capture_while(self._more_iterations, self._through_iteration)
        self._bodies.take_positions()
        inputs = [motion, gradients, of_motion.x0, of_motion.x1, of_motion.velocity]
        inputs += [of_motion.inverse_mass, of_motion.friction, step.complete]
        outputs = [start_q, particle_q, particle_qd, step.mesh.model.particle_inv_mass.grad]
        self._launch(_finish, len(motion.x0), inputs, [*outputs, self._response.restitution.grad])
        self._bodies.finish(self._of_planes, start_body_q, body_q, body_qd)
        step.friction.adjoin(of_motion.friction, self._of_planes.friction)

    def _through_turn(self):
        """Goes back through the turn that conserves angular momentum."""
        motion, vertices, constraints = self._motion, self._vertices, self._constraints
        n = len(motion.x0)
        self._launch(_restore_unturned, n, [motion, vertices])
        self._bodies.restore_unturned()
        totals = wp.zeros((self._response.worlds, int(SUMS)), dtype=wp.float64, device=self._device, requires_grad=True)
        self._launch(add_torques, self._constraint_count, [motion, vertices, constraints], [totals])
        self._launch(add_moments, n, [motion, vertices], [totals])
        self._bodies.add_moments(totals)
        self._adjoin(turn_velocities, n, [motion, vertices, totals], [self._gradients.velocity])
        self._bodies.through_turn(totals)
        self._adjoin(add_moments, n, [motion, vertices], [totals.grad])
        self._bodies.through_moments(totals)
        self._adjoin(add_torques, self._constraint_count, [motion, vertices, constraints], [totals.grad])

    def _batch(self, through):
        for _ in range(SWEEPS_PER_BATCH):
            through()

    def _through_velocity_sweep(self):
        """Goes back through a sweep on velocities."""
        constraints, of_constraints, vertices = self._constraints, self._of_constraints, self._vertices
        multiplier, sums = constraints.velocity_multiplier, vertices.particle_delta_v
        self._restore_multipliers(multiplier, sums, vertices.x1, vertices.bodies.delta_v)
        self._restore(_restore_velocities)
        self._bodies.restore_velocities()
        self._adjoin(
            change_velocity_multipliers,
            self._constraint_count,
            [self._motion, vertices, constraints, self._step.record, self._cursor, self._response.restitution],
            [of_constraints.velocity_multiplier, of_constraints.previous_multiplier],
            [self._gradients.velocity_change, self._bodies.velocity_change],
        )
        vertices.active.zero_()
        self._bodies.take_velocities()

    def _through_initialization(self):
        """Goes back through the initial velocity multipliers."""
        of_constraints = self._of_constraints
        self._restore(_restore_velocities)
        self._bodies.restore_velocities()
        self._adjoin(
            initialize_multipliers,
            self._constraint_count,
            [self._motion, self._vertices, self._constraints, self._step.dt],
            [of_constraints.velocity_multiplier, of_constraints.previous_multiplier],
            [self._gradients.velocity_change, self._bodies.velocity_change],
        )
        of_constraints.previous_multiplier.zero_()

    def _through_iteration(self):
        """Goes back through an iteration: truncation, sweeps, and the constraints that its detection added."""
        self._restore(_restore_positions)
        self._bodies.take_positions()
        self._through_truncation()
        self._launch(_begin_iteration, 1, [self._step.record, self._cursor], [self._more_sweeps])
        if self._bodies.moves:
            wp.capture_if(self._more_sweeps, self._bodies.project)
        wp.capture_while(self._more_sweeps, self._batch, through=self._through_position_sweep)
        self._launch(_to_detection, 1, [self._cursor], [self._progress.status.iteration])
        step, of_constraints, separation = self._step, self._of_constraints, self._response.separation
        self._adjoin(
            make_constraints,
            self._constraint_count,
            [
                self._motion,
                self._vertices,
                self._planes,
                step.constraints,
                self._progress,
                step.record,
                self._cursor,
                separation,
            ],
            [
                of_constraints.weights,
                of_constraints.normal,
                of_constraints.separation,
                of_constraints.friction,
                of_constraints.approach,
            ],
        )
        self._launch(_end_iteration, 1, [self._cursor], [self._more_iterations])

    def _through_position_sweep(self):
        """Goes back through a sweep on positions."""
        constraints, of_constraints, vertices = self._constraints, self._of_constraints, self._vertices
        multiplier, sums = constraints.position_multiplier, vertices.particle_delta_x
        self._restore_multipliers(multiplier, sums, self._motion.x1, vertices.bodies.delta_x)
        self._restore(_restore_positions)
        self._bodies.restore_positions()
        self._adjoin(
            change_position_multipliers,
            self._constraint_count,
            [self._motion, vertices, constraints, self._progress, self._step.record, self._cursor],
            [of_constraints.position_multiplier, of_constraints.previous_multiplier],
            [self._gradients.x1, self._bodies.shift],
        )
        vertices.active.zero_()
        self._bodies.take_projected_positions()

    def _through_truncation(self):
        """Goes back through the truncation of paths."""
        motion, vertices, step, planes = self._motion, self._vertices, self._step, self._planes
        truncations = len(step.record.vertex)
        inputs = [vertices, self._gradients, step.record, self._cursor]
        self._launch(_restore_paths, truncations, inputs, self._of_truncations)
        self._bodies.restore_paths(self._cursor)
        inputs = [motion, vertices, planes, step.record, self._cursor, step.dt]
        self._adjoin(truncate_paths, truncations, inputs, self._of_truncations)
        self._bodies.through_truncation(self._cursor, planes)

    def _restore(self, kernel):
        """Restores positions or velocities as they were before a sweep."""
        inputs = [self._motion, self._vertices, self._gradients, self._cursor, self._more_sweeps]
        self._launch(kernel, len(self._motion.x0), inputs)

    def _restore_multipliers(self, multiplier, sums, x, body_sums):
        inputs = [self._motion, self._vertices, self._constraints, self._step.record, self._cursor, multiplier]
        self._launch(_restore_multipliers, self._constraint_count, [*inputs, sums, x, body_sums])

    def _launch(self, kernel, dim, inputs, outputs=()):
        wp.launch(kernel, dim, inputs=inputs, outputs=outputs, device=self._device)

    def _adjoin(self, kernel, dim, inputs, of_outputs, of_changes=()):
        """Launches the adjoint of a kernel, given the gradients with respect to its outputs.

        ``of_changes`` are those with respect to changes of vertices and of bodies, which functions add to.
        """
        outputs = [*of_outputs, *((self._vertex_changes, self._bodies.changes) if of_changes else ())]
        launch_adjoint(kernel, dim, inputs, outputs, [*of_outputs, *of_changes], self._device)
