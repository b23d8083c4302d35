"""The adjoint of a step: carries gradients from its results to its inputs, back through the record of the step.

A step is a long chain of small changes: contacts become constraints, each sweep changes multipliers and by them
positions, paths are truncated, and in the end velocities change. Which contacts there were, which constraints were
active and when sweeps ended are constants; everything else is differentiated as it was computed. Warp makes the adjoint
of each small change, see :mod:`.adjoint.kernels`; the kernels of :mod:`.adjoint.restore` restore the values that each
was computed from. Multipliers are in the record, and positions follow exactly from the changes of multipliers, as sums
are integers.
"""

import warp as wp

from ..schedule import SWEEPS_PER_BATCH, LoopControl, views_of
from ..state.record import OFFSETS, PER_ENTRY, PER_TRUNCATION, RecordCounts, check_complete
from ..state.structs import SUMS, Constraints
from ..state.workspace import Workspace
from .arrays import attach_gradients, copied, launch_adjoint
from .kernels import (
    add_moments,
    add_torques,
    change_multipliers,
    find_truncation_times,
    initialize_multipliers,
    make_constraints,
    place_planes,
    place_shape_vertices,
    place_vertices,
    project_poses,
    project_vertices,
    set_centres,
    truncate_paths,
    turn_velocities,
    vertex_velocities,
)
from .restore import (
    BodyGradients,
    Cursor,
    Gradients,
    Move,
    RestoredStep,
    begin_gradients,
    collect_gradients_on_bodies,
    finish_body_gradients,
    finish_gradients,
    move_cursor,
    restore_multipliers,
    restore_paths,
    restore_positions,
    restore_unturned,
    restore_velocities,
)

_UNUSED_OF_CONSTRAINTS = {"count", "min_distance", "last_sweep", "active_set", "active_count"}

_MULTIPLIERS = "position_multiplier", "velocity_multiplier", "previous_multiplier"

_MOTION_OF_BODIES = "start", "end", "velocity", "inverse_mass"


class RecordedStep:
    """A copy of a step for its adjoint: its record and results, as far as they fit in the buffers of a CUDA graph.

    Attributes:
        dt: Length of the step [s].
        mesh: The mesh, :class:`.state.mesh.ModelMesh`.
        friction: The coefficients of its vertices and planes, :class:`.state.friction.Friction`.
        moves_bodies: Whether the response can move bodies.
        motion: The motion that the inner solver predicted, :class:`.state.structs.Motion`.
        planes: The planes, :class:`.state.planes.MovingPlanes`.
        vertices: The vertices at the end, :class:`.state.structs.Vertices`.
        constraints: The constraints at the end, :class:`.state.structs.Constraints`.
        undetected: Array of one int, 1 if the last detection was incomplete.
        iteration: Array of one int, the last iteration.
        record: What each sweep and truncation changed, :class:`.state.record.StepRecord`.
        complete: Array of one int, 1 if nothing is missing.
    """

    def __init__(self, motion, resolution, recorder, dt: float):
        """Copies a step.

        Args:
            motion: The :class:`.state.motion.ModelMotion` that was resolved.
            resolution: The :class:`.state.workspace.Resolution`.
            recorder: The :class:`.state.record.StepRecorder` that recorded it.
            dt: Length of the step [s].
        """
        self.dt, self.mesh, self.friction, self.moves_bodies = dt, motion.mesh, motion.friction, motion.moves_bodies
        constraints, record, device = resolution.constraints, recorder.record, recorder.counts.device
        if device.is_capturing:
            count, sweeps = len(constraints.vertices), len(record.sweep_ends)
            entries, truncations = len(record.constraint), len(record.vertex)
        else:
            counts = constraints.count, record.counts.sweeps, record.counts.entries, record.counts.truncations
            count, sweeps, entries, truncations = (int(array.numpy()[0]) for array in counts)
        self.undetected = wp.clone(resolution.status.results.undetected)
        self.iteration = wp.clone(resolution.status.loop.iteration)
        self.planes = copied(motion.planes, ("start", "end", "friction"))
        self.motion = copied(motion.vertices, ("x0", "x1", "velocity", "is_not_finite", "friction"))
        names = "x1", "velocity", "particle_delta_x", "particle_delta_v", "outcome"
        self.vertices = copied(resolution.vertices, names)
        if motion.keeps_poses:
            names = _MOTION_OF_BODIES if motion.moves_bodies else ("start", "end")
            self.motion.bodies = copied(motion.vertices.bodies, names)
        if motion.moves_bodies:
            names = "pose", "velocity", "delta_x", "delta_v", "outcome"
            self.vertices.bodies = copied(resolution.vertices.bodies, names)
        lengths = dict.fromkeys(Constraints.vars.keys() - _UNUSED_OF_CONSTRAINTS, count)
        self.constraints = copied(constraints, {**lengths, "count": 1})
        lengths = {"sweep_ends": sweeps, **dict.fromkeys(OFFSETS)}
        lengths |= {**dict.fromkeys(PER_ENTRY, entries), **dict.fromkeys(PER_TRUNCATION, truncations)}
        self.record = copied(record, lengths)
        self.record.counts = views_of(RecordCounts, wp.clone(recorder.counts))
        self.complete = wp.empty(1, dtype=int, device=device)
        wp.launch(check_complete, 1, [self.constraints, self.record], [self.complete], device=device)


class StepAdjoint:
    """Goes back through a recorded step, and carries gradients along."""

    def __init__(self, recorded: RecordedStep, work: Workspace):
        """Copies what going back changes.

        Args:
            recorded: The step.
            work: The workspace in which it was resolved.
        """
        self._recorded, self._work, self._mesh = recorded, work, recorded.mesh
        model, device = recorded.mesh.model, recorded.mesh.device
        vertices, bodies = len(recorded.motion.x0), model.body_count if recorded.moves_bodies else 0
        self._moves_bodies, self._bodies, self._vertices_and_bodies = recorded.moves_bodies, bodies, vertices + bodies
        self._shape_vertices = len(self._mesh.shape_vertices.body) if recorded.moves_bodies else 0
        self._constraints, self._truncations = len(recorded.constraints.vertices), len(recorded.record.vertex)

        def zeros(count, *dtypes):
            return [wp.zeros(count, dtype=dtype, device=device) for dtype in dtypes]

        self._gradients, of_bodies = Gradients(), BodyGradients()
        for struct, count in ((of_bodies, bodies), (self._gradients, vertices)):
            for name, var in struct._cls.vars.items():
                if name != "bodies":
                    setattr(struct, name, wp.zeros(count, dtype=var.type.dtype, device=device))
        self._gradients.bodies = of_bodies
        self._step = step = RestoredStep()
        planes, motion = copied(recorded.planes, ()), copied(recorded.motion, ())
        self._of_planes = attach_gradients(planes, ("start", "end", "friction"))
        self._of_motion = attach_gradients(motion, ("x0", "x1", "velocity", "inverse_mass", "friction"))
        if model.body_count:
            moving = copied(motion.bodies, ())
            names = _MOTION_OF_BODIES if recorded.moves_bodies else ("start", "end")
            self._of_bodies = attach_gradients(moving, names)
            motion.bodies = moving
        moved = copied(recorded.vertices, ("x1", "velocity", "particle_delta_x", "particle_delta_v"))
        (moved.active,) = zeros(vertices, int)
        of_vertices = {"x1": self._gradients.more_x1, "velocity": self._gradients.more_velocity}
        attach_gradients(moved, of_vertices, of_vertices)
        if recorded.moves_bodies:
            moved_bodies = copied(moved.bodies, ("pose", "velocity", "delta_x", "delta_v"))
            moved_bodies.active, moved_bodies.centre, moved_bodies.inverse_inertia = zeros(
                bodies, int, wp.vec3d, wp.mat33d
            )
            given = {"pose": of_bodies.pose, "velocity": of_bodies.velocity}
            names = "pose", "velocity", "centre", "inverse_inertia"
            self._of_moved_bodies = attach_gradients(moved_bodies, names, given)
            moved.bodies = moved_bodies
        constraints = copied(recorded.constraints, _MULTIPLIERS)
        names = "weights", "normal", "separation", "friction", "approach", *_MULTIPLIERS
        self._of_constraints = attach_gradients(constraints, names)
        (self._sums,) = zeros(bodies, wp.spatial_vectord)
        self._sums.grad = of_bodies.shift
        (self._times,) = zeros(self._truncations, wp.float64)
        (self._times.grad,) = zeros(self._truncations, wp.float64)
        self._of_paths = zeros(self._truncations, wp.vec3, wp.vec3, wp.transform, wp.spatial_vector)
        self._changes = [*zeros(vertices, wp.vec3), *zeros(bodies, wp.spatial_vectord)]  # which adjoints do not read
        status = copied(work.status, ())
        status.loop = views_of(LoopControl, zeros(len(LoopControl.vars), int)[0])
        step.motion, step.planes, step.vertices, step.constraints = motion, planes, moved, constraints
        step.status, step.record = status, recorded.record
        step.cursor = views_of(Cursor, zeros(len(Cursor.vars), int)[0])
        step.restitution, step.separation, step.dt = work.restitution, work.separation, recorded.dt

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
        recorded, step, gradients, of_motion = self._recorded, self._step, self._gradients, self._of_motion
        motion, cursor, count = step.motion, step.cursor, len(recorded.motion.x0)
        wp.copy(step.status.loop.iteration, recorded.iteration)
        of_starts = self._of_bodies.start if self._bodies else None
        inputs = [motion, recorded.undetected, particle_q, particle_qd, body_q, body_qd]
        self._launch(begin_gradients, self._vertices_and_bodies, *inputs, gradients, of_motion.x0, of_starts)
        self._move_cursor(Move.END)
        self._set_centres(step.vertices.bodies.pose)
        self._through_turn()
        wp.capture_while(cursor.more_sweeps, self._batch, through=self._through_velocity_sweep)
        self._through_initialization()
        self._through_centres(step.vertices.bodies.pose)
        self._set_centres(motion.bodies.end)
        wp.capture_while(cursor.more_iterations, self._through_iteration)
        self._through_placement(place_vertices)
        inputs = [motion, gradients, recorded.complete, of_motion.x0, of_motion.inverse_mass]
        inputs += [of_motion.x1, of_motion.velocity, of_motion.friction, start_q]
        inputs += [self._mesh.model.particle_inv_mass.grad, self._work.restitution.grad]
        self._launch(finish_gradients, count, *inputs, particle_q, particle_qd)
        if self._mesh.model.body_count:
            self._finish_bodies(start_body_q, body_q, body_qd)
        recorded.friction.backward(of_motion.friction, self._of_planes.friction)

    def _finish_bodies(self, of_starts, of_ends, of_velocities):
        """Writes the gradients of poses and velocities at the start and as predicted at the end of the step.

        Those of vertices of shapes, and of planes, become those of their bodies.
        """
        motion, of_motion, mesh = self._step.motion, self._of_motion, self._mesh
        self._through_centres(motion.bodies.end)
        self._through_projection()
        shapes, planes, model = mesh.device_shape_vertices, mesh.device_planes, mesh.model
        inputs = [motion, shapes.body, shapes.position, model.particle_count, self._recorded.dt]
        of_outputs = [of_motion.x0, of_motion.x1, of_motion.velocity]
        self._launch_adjoint(place_shape_vertices, len(shapes.body), inputs, of_outputs)
        inputs = [motion, planes.point, planes.normal, planes.body]
        self._launch_adjoint(place_planes, len(planes.body), inputs, [self._of_planes.start, self._of_planes.end])
        inputs = [motion, self._gradients.bodies, self._recorded.complete]
        inputs += [getattr(self._of_bodies, name, None) for name in _MOTION_OF_BODIES]
        of_model = model.body_inv_mass, model.body_inv_inertia, model.body_mass, model.body_inertia
        outputs = [of_starts, of_ends, of_velocities, *(array.grad for array in of_model)]
        self._launch(finish_body_gradients, model.body_count, *inputs, *outputs)

    def _through_turn(self):
        """Goes back through the turn that restores angular momentum."""
        motion, vertices, constraints = self._step.motion, self._step.vertices, self._step.constraints
        both, gradients, shape = self._vertices_and_bodies, self._gradients, (self._work.worlds, int(SUMS))
        totals = wp.zeros(shape, dtype=wp.float64, device=self._mesh.device, requires_grad=True)
        self._launch(restore_unturned, both, motion, vertices)
        self._launch(add_torques, self._constraints, motion, vertices, constraints, totals)
        self._launch(add_moments, both, motion, vertices, totals)
        of_outputs = [gradients.velocity, gradients.bodies.velocity]
        self._launch_adjoint(turn_velocities, both, [motion, vertices, totals], of_outputs)
        self._launch_adjoint(add_moments, both, [motion, vertices], [totals.grad])
        self._launch_adjoint(add_torques, self._constraints, [motion, vertices, constraints], [totals.grad])

    def _batch(self, through):
        for _ in range(SWEEPS_PER_BATCH):
            through()

    def _through_velocity_sweep(self):
        """Goes back through a sweep on velocities."""
        vertices, gradients = self._step.vertices, self._gradients
        sums = vertices.particle_delta_v, vertices.bodies.delta_v
        self._restore_multipliers(vertices.x1, self._step.constraints.velocity_multiplier, *sums)
        self._restore_velocities()
        of_changes = [gradients.velocity_change, gradients.bodies.velocity_change]
        self._through_change(True, vertices.x1, self._of_constraints.velocity_multiplier, of_changes)
        self._collect(gradients.velocity, gradients.more_velocity)
        inputs = [self._step.motion, vertices]
        self._launch_adjoint(vertex_velocities, self._shape_vertices, inputs, [gradients.on_bodies])

    def _through_initialization(self):
        """Goes back through the initial velocity multipliers."""
        of_constraints, gradients = self._of_constraints, self._gradients
        self._restore_velocities()
        of_outputs = [of_constraints.velocity_multiplier, of_constraints.previous_multiplier]
        of_changes = [gradients.velocity_change, gradients.bodies.velocity_change]
        self._launch_adjoint(initialize_multipliers, self._constraints, [self._step], of_outputs, of_changes)
        of_constraints.previous_multiplier.zero_()

    def _through_iteration(self):
        """Goes back through an iteration: truncation, sweeps, and the constraints that its detection added."""
        self._restore_positions()
        self._through_placement(place_vertices)
        self._through_truncation()
        self._move_cursor(Move.SWEEPS)
        if self._moves_bodies:
            wp.capture_if(self._step.cursor.more_sweeps, self._through_projection)
        wp.capture_while(self._step.cursor.more_sweeps, self._batch, through=self._through_position_sweep)
        self._move_cursor(Move.DETECTION)
        names = "weights", "normal", "separation", "friction", "approach"
        of_outputs = [getattr(self._of_constraints, name) for name in names]
        self._launch_adjoint(make_constraints, self._constraints, [self._step, self._recorded.constraints], of_outputs)

    def _through_position_sweep(self):
        """Goes back through a sweep on positions."""
        x, vertices, gradients = self._step.motion.x1, self._step.vertices, self._gradients
        sums = vertices.particle_delta_x, vertices.bodies.delta_x
        self._restore_multipliers(x, self._step.constraints.position_multiplier, *sums)
        self._restore_positions()
        self._place()
        of_changes = [gradients.x1, gradients.bodies.shift]
        self._through_change(False, x, self._of_constraints.position_multiplier, of_changes)
        self._through_placement(project_vertices, self._sums)

    def _through_change(self, of_velocities, x, of_multiplier, of_changes):
        """Goes back through what a sweep changes, at positions ``x``, given the gradients by what it changes."""
        of_outputs = [of_multiplier, self._of_constraints.previous_multiplier]
        inputs = [self._step, of_velocities, x]
        self._launch_adjoint(change_multipliers, self._constraints, inputs, of_outputs, of_changes)
        self._step.vertices.active.zero_()
        if self._moves_bodies:
            self._step.vertices.bodies.active.zero_()

    def _through_truncation(self):
        """Goes back through the truncation of paths."""
        step, times, of_paths, count = self._step, self._times, self._of_paths, self._truncations
        self._launch(restore_paths, count, step, self._gradients, *of_paths)
        self._place()
        self._launch(find_truncation_times, count, step, times)
        self._launch_adjoint(truncate_paths, count, [step, times], of_paths)
        self._launch_adjoint(find_truncation_times, count, [step], [times.grad])

    def _through_placement(self, kernel, *inputs):
        """Turns gradients with respect to positions of vertices into those of poses, or of what constraints did."""
        self._collect(self._gradients.x1, self._gradients.more_x1)
        inputs = [self._step.motion, self._step.vertices, *inputs]
        self._launch_adjoint(kernel, self._shape_vertices, inputs, [self._gradients.on_bodies])

    def _through_projection(self):
        """Turns gradients with respect to poses into those with respect to what constraints did to them."""
        of_poses = self._gradients.bodies.pose
        inputs = [self._step.motion, self._step.vertices, self._sums]
        self._launch_adjoint(project_poses, self._bodies, inputs, [of_poses])
        of_poses.zero_()

    def _through_centres(self, poses):
        """Turns gradients with respect to where impulses act into those with respect to the poses given."""
        if self._moves_bodies:
            of_centres = [self._of_moved_bodies.centre, self._of_moved_bodies.inverse_inertia]
            self._launch_adjoint(set_centres, self._bodies, [self._step.motion, poses], of_centres)
            for of in of_centres:
                of.zero_()

    def _set_centres(self, poses):
        """Makes given poses those where impulses act."""
        moved = self._step.vertices.bodies
        self._launch(set_centres, self._bodies, self._step.motion, poses, moved.centre, moved.inverse_inertia)

    def _move_cursor(self, move):
        self._launch(move_cursor, 1, self._step, int(move), self._recorded.complete)

    def _restore_multipliers(self, x, multiplier, sums, body_sums):
        self._launch(restore_multipliers, self._constraints, self._step, x, multiplier, sums, body_sums)

    def _restore_positions(self):
        self._launch(restore_positions, self._vertices_and_bodies, self._step, self._gradients, self._sums)

    def _restore_velocities(self):
        motion, vertices = self._step.motion, self._step.vertices
        self._launch(restore_velocities, self._vertices_and_bodies, self._step, self._gradients)
        self._launch(vertex_velocities, self._shape_vertices, motion, vertices, vertices.velocity)

    def _place(self):
        """Moves vertices of bodies to where their poses say."""
        motion, vertices = self._step.motion, self._step.vertices
        self._launch(place_vertices, self._shape_vertices, motion, vertices, vertices.x1)

    def _collect(self, of_vertices, more):
        inputs = [self._step.motion, self._gradients, of_vertices, more]
        self._launch(collect_gradients_on_bodies, self._shape_vertices, *inputs)

    def _launch(self, kernel, dim, *arguments):
        wp.launch(kernel, dim, inputs=arguments, device=self._mesh.device)

    def _launch_adjoint(self, kernel, dim, inputs, of_outputs, of_changes=()):
        """Launches the adjoint of a kernel, given the gradients with respect to its outputs.

        ``of_changes`` are those with respect to changes of vertices and of bodies, which functions add to.
        """
        outputs = [*of_outputs, *(self._changes if of_changes else ())]
        launch_adjoint(kernel, dim, inputs, outputs, [*of_outputs, *of_changes], self._mesh.device)
