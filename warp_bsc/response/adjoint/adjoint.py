"""The adjoint of a step: carries gradients from its results to its inputs, going back through the record of the step.

A step is a long chain of small changes: contacts become constraints, each sweep changes multipliers and by them
positions, paths are truncated, and in the end velocities change. Which contacts there were, which constraints were
active and when sweeps ended are constants; everything else is differentiated as it was computed. Warp makes the adjoint
of each small change, see :mod:`.adjoint_kernels`; this module restores the values that each was computed from.
Multipliers are in the record, and positions follow exactly from the changes of multipliers, as sums are integers.
"""

import warp as wp

from ..schedule import SWEEPS_PER_BATCH, allocate_status, views_of
from ..state.planes import MovingPlanes
from ..state.record import OFFSETS, PER_ENTRY, PER_TRUNCATION, RecordCounts, StepRecord
from ..state.structs import SUMS, Bodies, Constraints, Motion, MovedBodies, Vertices
from ..state.workspace import Workspace
from .arrays import attach_gradients, copy_arrays, launch_adjoint
from .bodies import BODY_MOTION_ARRAYS, BodyAdjoint
from .kernels import (
    Cursor,
    Gradients,
    add_moments,
    add_torques,
    begin_adjoint,
    begin_gradients,
    change_multipliers,
    check_complete,
    enter_iteration,
    find_truncation_times,
    finish_gradients,
    initialize_multipliers,
    leave_iteration,
    make_constraints,
    restore_multipliers,
    restore_paths,
    restore_positions,
    restore_unturned,
    restore_velocities,
    set_detection_iteration,
    truncate_paths,
    turn_velocities,
)

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
    "pace",
    "position_multiplier",
    "velocity_multiplier",
    "previous_multiplier",
)

_RESTORED_CONSTRAINT_ARRAYS = "position_multiplier", "velocity_multiplier", "previous_multiplier"

_DIFFERENTIABLE = "weights", "normal", "separation", "friction", "approach", *_RESTORED_CONSTRAINT_ARRAYS

_MOTION_ARRAYS = "x0", "x1", "velocity"

_MOVED_BODY_ARRAYS = "pose", "velocity", "delta_x", "delta_v", "outcome"

_VERTEX_ARRAYS = "x1", "velocity", "particle_delta_x", "particle_delta_v", "outcome"

_RESTORED_VERTEX_ARRAYS = "x1", "velocity", "particle_delta_x", "particle_delta_v"


class RecordedStep:
    """A copy of a step for its adjoint: its record and results, as far as they fit in the buffers of a CUDA graph.

    Attributes:
        dt: Length of the step [s].
        mesh: The mesh, :class:`.model_mesh.ModelMesh`.
        friction: The coefficients of its vertices and planes, :class:`.friction.Friction`.
        moves_bodies: Whether the response can move bodies.
        motion: The motion that the inner solver predicted, :class:`.buffers.Motion`.
        planes: The planes, :class:`.planes.MovingPlanes`.
        vertices: The vertices at the end, :class:`.buffers.Vertices`.
        constraints: The constraints at the end, :class:`.buffers.Constraints`.
        undetected: Array of one int, 1 if the last detection was incomplete.
        iteration: Array of one int, the last iteration.
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
        self.undetected = wp.clone(resolution.status.results.undetected)
        self.iteration = wp.clone(resolution.status.loop.iteration)
        self.planes = copy_arrays(motion.planes, MovingPlanes(), dict.fromkeys(("start", "end", "friction")))
        self.motion = copy_arrays(
            motion.vertices, Motion(), dict.fromkeys((*_MOTION_ARRAYS, "is_not_finite", "friction"))
        )
        for name in ("inverse_mass", "world"):
            setattr(self.motion, name, getattr(motion.vertices, name))
        self.vertices = copy_arrays(resolution.vertices, Vertices(), dict.fromkeys(_VERTEX_ARRAYS))
        if motion.keeps_poses:
            bodies = Bodies()
            for name in Bodies.vars:
                setattr(bodies, name, getattr(motion.vertices.bodies, name))
            names = BODY_MOTION_ARRAYS if motion.moves_bodies else ("start", "end")
            self.motion.bodies = copy_arrays(bodies, bodies, dict.fromkeys(names))
        if motion.moves_bodies:
            moved = copy_arrays(resolution.vertices.bodies, MovedBodies(), dict.fromkeys(_MOVED_BODY_ARRAYS))
            self.vertices.bodies = moved
        lengths = {**dict.fromkeys(_CONSTRAINT_ARRAYS, count), "count": 1}
        self.constraints = copy_arrays(constraints, Constraints(), lengths)
        lengths = {"sweep_ends": sweeps, **dict.fromkeys(OFFSETS)}
        lengths |= {**dict.fromkeys(PER_ENTRY, entries), **dict.fromkeys(PER_TRUNCATION, truncations)}
        self.record = copy_arrays(record, StepRecord(), lengths)
        self.record.counts = views_of(RecordCounts, wp.clone(recorder.counts))
        self.complete = wp.empty(1, dtype=int, device=device)
        inputs = [constraints.count, record, count]
        wp.launch(check_complete, 1, inputs=inputs, outputs=[self.complete], device=device)


class StepAdjoint:
    """Goes back through a recorded step, and carries gradients along."""

    def __init__(self, step: RecordedStep, work: Workspace):
        """Copies what going back changes.

        Args:
            step: The step.
            work: The workspace in which it was resolved.
        """
        self._step, self._work, self._device = step, work, work.device
        self._constraint_count = len(step.constraints.vertices)
        device, n = self._device, len(step.motion.x0)
        self._gradients = gradients = Gradients()
        for name in Gradients.vars:
            setattr(gradients, name, wp.zeros(n, dtype=wp.vec3, device=device))
        self._motion = motion = Motion()
        differentiable = *_MOTION_ARRAYS, "inverse_mass", "friction"
        for name in (*differentiable, "world", "is_not_finite"):
            setattr(motion, name, getattr(step.motion, name))
        self._of_motion = attach_gradients(motion, differentiable)
        self._planes = planes = MovingPlanes()
        for name in ("start", "end", "friction"):
            setattr(planes, name, getattr(step.planes, name))
        self._of_planes = attach_gradients(planes, ("start", "end", "friction"))
        self._vertices = vertices = copy_arrays(step.vertices, Vertices(), dict.fromkeys(_RESTORED_VERTEX_ARRAYS))
        vertices.outcome = step.vertices.outcome
        vertices.active = wp.zeros(n, dtype=int, device=device)
        of_vertices = {"x1": gradients.more_x1, "velocity": gradients.more_velocity}
        attach_gradients(vertices, of_vertices, of_vertices)
        self._constraints = constraints = copy_arrays(
            step.constraints, Constraints(), dict.fromkeys(_RESTORED_CONSTRAINT_ARRAYS)
        )
        for name in set(_CONSTRAINT_ARRAYS) - set(_RESTORED_CONSTRAINT_ARRAYS) | {"count"}:
            setattr(constraints, name, getattr(step.constraints, name))
        self._of_constraints = attach_gradients(constraints, _DIFFERENTIABLE)
        truncations = len(step.record.vertex)
        self._truncation_times = wp.zeros(truncations, dtype=wp.float64, device=device, requires_grad=True)
        self._of_paths = [wp.zeros(truncations, dtype=wp.vec3, device=device) for _ in range(2)]
        self._vertex_changes = wp.empty(n, dtype=wp.vec3, device=device)
        self._bodies = BodyAdjoint(step, gradients, motion, self._of_motion, vertices)
        self._status, _values = allocate_status(1, device, max_iterations=work.status.max_iterations, recorded=True)
        self._cursor = views_of(Cursor, wp.zeros(len(Cursor.vars), dtype=int, device=device))
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
                respect to the positions that the inner solver predicted.
            particle_qd: The same for the velocities.
            start_body_q: As ``start_q`` for poses of bodies, shape [body_count]; None if the model has none.
            body_q: As ``particle_q`` for poses of bodies.
            body_qd: As ``particle_q`` for velocities of bodies.
        """
        step, motion, gradients, of_motion = self._step, self._motion, self._gradients, self._of_motion
        work, iteration = self._work, self._status.loop.iteration
        inputs, outputs = [motion, step.undetected, particle_q, particle_qd], [gradients, of_motion.x0]
        self._launch(begin_gradients, len(motion.x0), inputs, outputs)
        inputs = [step.record, step.iteration, work.status.max_iterations, step.complete]
        outputs = [self._cursor, self._more_sweeps, self._more_iterations, iteration]
        self._launch(begin_adjoint, 1, inputs, outputs)
        self._bodies.begin(body_q, body_qd)
        self._through_turn()
        wp.capture_while(self._more_sweeps, self._batch, through=self._through_velocity_sweep)
        self._through_initialization()
        self._bodies.through_move_to_end()
        wp.capture_while(self._more_iterations, self._through_iteration)
        self._bodies.through_placement()
        inputs = [motion, gradients, of_motion.x0, of_motion.x1, of_motion.velocity]
        inputs += [of_motion.inverse_mass, of_motion.friction, step.complete]
        outputs = [start_q, particle_q, particle_qd, step.mesh.model.particle_inv_mass.grad]
        self._launch(finish_gradients, len(motion.x0), inputs, [*outputs, self._work.restitution.grad])
        self._bodies.finish(self._of_planes, start_body_q, body_q, body_qd)
        step.friction.backward(of_motion.friction, self._of_planes.friction)

    def _through_turn(self):
        """Goes back through the turn that conserves angular momentum."""
        motion, vertices, constraints = self._motion, self._vertices, self._constraints
        n = len(motion.x0)
        self._launch(restore_unturned, n, [motion, vertices])
        self._bodies.restore_unturned()
        totals = wp.zeros((self._work.worlds, int(SUMS)), dtype=wp.float64, device=self._device, requires_grad=True)
        self._launch(add_torques, self._constraint_count, [motion, vertices, constraints], [totals])
        self._launch(add_moments, n, [motion, vertices], [totals])
        self._bodies.add_moments(totals)
        self._launch_adjoint(turn_velocities, n, [motion, vertices, totals], [self._gradients.velocity])
        self._bodies.through_turn(totals)
        self._launch_adjoint(add_moments, n, [motion, vertices], [totals.grad])
        self._bodies.through_moments(totals)
        self._launch_adjoint(add_torques, self._constraint_count, [motion, vertices, constraints], [totals.grad])

    def _batch(self, through):
        for _ in range(SWEEPS_PER_BATCH):
            through()

    def _through_velocity_sweep(self):
        """Goes back through a sweep on velocities."""
        vertices = self._vertices
        sums = vertices.particle_delta_v, vertices.bodies.delta_v
        self._restore_multipliers(self._constraints.velocity_multiplier, vertices.x1, *sums)
        self._restore(restore_velocities)
        self._bodies.restore_velocities()
        changes = [self._gradients.velocity_change, self._bodies.velocity_change]
        self._through_change(True, vertices.x1, self._of_constraints.velocity_multiplier, changes)
        self._bodies.through_vertex_velocities()

    def _through_initialization(self):
        """Goes back through the initial velocity multipliers."""
        of_constraints = self._of_constraints
        self._restore(restore_velocities)
        self._bodies.restore_velocities()
        self._launch_adjoint(
            initialize_multipliers,
            self._constraint_count,
            [self._motion, self._vertices, self._constraints, self._step.dt],
            [of_constraints.velocity_multiplier, of_constraints.previous_multiplier],
            [self._gradients.velocity_change, self._bodies.velocity_change],
        )
        of_constraints.previous_multiplier.zero_()

    def _through_iteration(self):
        """Goes back through an iteration: truncation, sweeps, and the constraints that its detection added."""
        self._restore(restore_positions)
        self._bodies.through_placement()
        self._through_truncation()
        self._launch(enter_iteration, 1, [self._step.record, self._cursor], [self._more_sweeps])
        if self._bodies.moves:
            wp.capture_if(self._more_sweeps, self._bodies.through_projection)
        wp.capture_while(self._more_sweeps, self._batch, through=self._through_position_sweep)
        self._launch(set_detection_iteration, 1, [self._cursor], [self._status.loop.iteration])
        step, of_constraints, separation = self._step, self._of_constraints, self._work.separation
        self._launch_adjoint(
            make_constraints,
            self._constraint_count,
            [
                self._motion,
                self._vertices,
                self._planes,
                step.constraints,
                self._status,
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
        self._launch(leave_iteration, 1, [self._cursor], [self._more_iterations])

    def _through_position_sweep(self):
        """Goes back through a sweep on positions."""
        vertices, x = self._vertices, self._motion.x1
        sums = vertices.particle_delta_x, vertices.bodies.delta_x
        self._restore_multipliers(self._constraints.position_multiplier, x, *sums)
        self._restore(restore_positions)
        self._bodies.restore_positions()
        changes = [self._gradients.x1, self._bodies.shift]
        self._through_change(False, x, self._of_constraints.position_multiplier, changes)
        self._bodies.through_projected_placement()

    def _through_change(self, of_velocities, x, of_multiplier, of_changes):
        """Goes back through what a sweep changes, at positions ``x``, given the gradients by what it changes."""
        inputs = [self._motion, self._vertices, self._constraints, self._status, self._step.record, self._cursor]
        inputs += [self._work.restitution, of_velocities, x]
        of_outputs = [of_multiplier, self._of_constraints.previous_multiplier]
        self._launch_adjoint(change_multipliers, self._constraint_count, inputs, of_outputs, of_changes)
        self._vertices.active.zero_()
        if self._bodies.moves:
            self._vertices.bodies.active.zero_()

    def _through_truncation(self):
        """Goes back through the truncation of paths."""
        motion, vertices, record, planes = self._motion, self._vertices, self._step.record, self._planes
        cursor, times, of_paths, truncations = self._cursor, self._truncation_times, self._of_paths, len(record.vertex)
        self._launch(restore_paths, truncations, [vertices, self._gradients, record, cursor], of_paths)
        self._bodies.restore_paths(cursor)
        inputs = [motion, vertices, planes, record, cursor]
        self._launch(find_truncation_times, truncations, inputs, [times])
        self._launch_adjoint(
            truncate_paths, truncations, [motion, vertices, times, record, cursor, self._step.dt], of_paths
        )
        self._bodies.through_truncation(cursor, times)
        self._launch_adjoint(find_truncation_times, truncations, inputs, [times.grad])

    def _restore(self, kernel):
        """Restores positions or velocities as they were before a sweep."""
        inputs = [self._motion, self._vertices, self._gradients, self._cursor, self._more_sweeps]
        self._launch(kernel, len(self._motion.x0), inputs)

    def _restore_multipliers(self, multiplier, x, sums, body_sums):
        inputs = [self._motion, self._vertices, self._constraints, self._step.record, self._cursor, multiplier]
        self._launch(restore_multipliers, self._constraint_count, [*inputs, sums, x, body_sums])

    def _launch(self, kernel, dim, inputs, outputs=()):
        wp.launch(kernel, dim, inputs=inputs, outputs=outputs, device=self._device)

    def _launch_adjoint(self, kernel, dim, inputs, of_outputs, of_changes=()):
        """Launches the adjoint of a kernel, given the gradients with respect to its outputs.

        ``of_changes`` are those with respect to changes of vertices and of bodies, which functions add to.
        """
        outputs = [*of_outputs, *((self._vertex_changes, self._bodies.changes) if of_changes else ())]
        launch_adjoint(kernel, dim, inputs, outputs, [*of_outputs, *of_changes], self._device)
