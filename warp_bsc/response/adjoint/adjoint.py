"""The adjoint of a step: carries gradients from its results to its inputs, back through the record of the step.

A step is a long chain of small changes: contacts become constraints, each sweep changes multipliers and by them
positions, paths are truncated, and in the end velocities change. Which contacts there were, which constraints were
active and when sweeps ended are constants; everything else is differentiated as it was computed. Warp makes the adjoint
of each small change, see :mod:`.adjoint.kernels`; the kernels of :mod:`.adjoint.restore` restore the values that each
was computed from. Multipliers are in the record, and positions follow exactly from the changes of multipliers, as sums
are integers.
"""

import warp as wp

from ..state.record import GROWING, OFFSETS, RecordCounts, check_complete
from ..state.structs import SUMS, Constraints, add_zeros, allocate
from ..state.workspace import Workspace
from ..tuning import SWEEPS_PER_BATCH
from . import kernels, pose_kernels, restore, structs
from .arrays import copied, copied_materials, filled, launch_adjoint, materials_with_gradients, with_gradients
from .structs import Move, Projection, RestoredStep

_UNUSED_OF_CONSTRAINTS = {
    "count",
    "min_distance",
    "last_sweep",
    "active_set",
    "active_count",
    "of_worlds",
    "first",
    "number",
}

_MULTIPLIERS = "position_multiplier", "velocity_multiplier", "previous_multiplier"

_MOTION_OF_BODIES = "start", "end", "velocity", "inverse_mass"


class RecordedStep:
    """A copy of a step for its adjoint: its record and results, as far as they fit in the buffers of a CUDA graph.

    Attributes:
        restored: The step at its end, :class:`.adjoint.structs.RestoredStep` without a cursor.
        mesh: The mesh, :class:`.state.mesh.ModelMesh`.
        friction: The coefficients of its vertices and planes, :class:`.state.friction.Friction`.
        moves_bodies: Whether the response can move bodies.
        counts: Sizes of the record, and whether it is complete, :class:`.state.record.RecordCounts`.
    """

    def __init__(self, work: Workspace, dt: float):
        """Copies the step that was recorded in a workspace, of length ``dt`` [s]."""
        motion, constraints, record = work.motion, work.constraints, work.record
        self.mesh, self.friction, self.moves_bodies = motion.mesh, motion.friction, motion.moves_bodies
        self.restored = restored = RestoredStep()
        restored.status, restored.step = copied(work.status, ["loop", "results"]), work.step
        restored.planes = copied(motion.planes, ("start", "end", "friction"))
        step = restored.step
        step.dt = dt
        step.motion = copied(motion.vertices, ("x0", "x1", "velocity", "is_not_finite", "friction"))
        step.motion.materials = copied_materials(motion.vertices.materials)
        names = "x1", "velocity", "particle_delta_x", "particle_delta_v", "outcome"
        step.vertices = copied(work.vertices, names)
        if motion.keeps_poses:
            names = _MOTION_OF_BODIES if motion.moves_bodies else ("start", "end")
            step.motion.bodies = copied(motion.vertices.bodies, names)
        if motion.moves_bodies:
            names = "pose", "velocity", "delta_x", "delta_v", "outcome"
            step.vertices.bodies = copied(work.vertices.bodies, names)
        names = Constraints.vars.keys() - _UNUSED_OF_CONSTRAINTS
        lengths = dict.fromkeys(names, filled(constraints.vertices, constraints.count))
        step.constraints = copied(constraints, {**lengths, "count": 1})
        lengths = dict.fromkeys(OFFSETS) | {"sweep_ends": filled(record.sweep_ends, record.counts.sweeps)}
        for kind, names in GROWING.items():
            lengths |= dict.fromkeys(names, filled(getattr(record, names[0]), getattr(record.counts, kind)))
        restored.record = copied(record, lengths)
        self.counts = restored.record.counts = copied(record.counts, list(RecordCounts.vars))
        work.launch(check_complete, 1, [step.constraints, restored.record])


class StepAdjoint:
    """Goes back through a recorded step, and carries gradients along."""

    def __init__(self, recorded: RecordedStep):
        """Copies what going back through a step changes."""
        self._recorded, self._mesh, given = recorded, recorded.mesh, recorded.restored.step
        model, device = self._mesh.model, self._mesh.device
        vertices, bodies = len(given.motion.x0), model.body_count if recorded.moves_bodies else 0
        self._moves_bodies, self._bodies, self._vertices_and_bodies = recorded.moves_bodies, bodies, vertices + bodies
        self._shape_vertices = len(self._mesh.shape_vertices.body) if recorded.moves_bodies else 0
        self._constraints, self._truncations = len(given.constraints.vertices), len(recorded.restored.record.vertex)
        self._gradients = gradients = allocate(structs.Gradients, vertices, device)
        gradients.bodies = of_bodies = allocate(structs.BodyGradients, bodies, device)
        self._restored = restored = copied(recorded.restored)
        restored.cursor = allocate(structs.Cursor, 1, device)
        restored.status = copied(restored.status, ["loop"])
        restored.planes, self._of_planes = with_gradients(restored.planes, ("start", "end", "friction"))
        self._step = step = restored.step
        names = "x0", "x1", "velocity", "inverse_mass", "friction"
        step.motion, self._of_motion = with_gradients(given.motion, names)
        materials = materials_with_gradients(given.motion.materials, recorded.friction.materials.friction)
        step.motion.materials, self._of_motion.materials = materials
        if model.body_count:
            names = _MOTION_OF_BODIES if recorded.moves_bodies else ("start", "end")
            step.motion.bodies, self._of_motion.bodies = with_gradients(given.motion.bodies, names)
        moved = copied(given.vertices, ("x1", "velocity", "particle_delta_x", "particle_delta_v"))
        add_zeros(moved, ["active"], vertices, device)
        step.vertices, _ = with_gradients(moved, x1=gradients.more_x1, velocity=gradients.more_velocity)
        if recorded.moves_bodies:
            names = "centre", "inverse_inertia"
            moved = copied(given.vertices.bodies, ("pose", "velocity", "delta_x", "delta_v"))
            add_zeros(moved, ("active", *names), bodies, device)
            of_moved = {"pose": of_bodies.pose, "velocity": of_bodies.velocity}
            step.vertices.bodies, self._of_moved_bodies = with_gradients(moved, names, **of_moved)
        names = "weights", "normal", "separation", "friction", "approach", *_MULTIPLIERS
        constraints = copied(given.constraints, _MULTIPLIERS)
        step.constraints, self._of_constraints = with_gradients(constraints, names)
        self._sums = wp.zeros(bodies, dtype=wp.spatial_vectord, device=device)
        self._sums.grad = of_bodies.shift
        self._times = wp.zeros(self._truncations, dtype=wp.float64, device=device, requires_grad=True)
        paths = allocate(structs.Paths, self._truncations, device)
        self._paths, self._of_paths = with_gradients(paths, structs.Paths.vars)
        moved = step.vertices
        sums, of_changes = (moved.particle_delta_x, moved.bodies.delta_x), (gradients.x1, of_bodies.shift)
        self._positions = self._projection(step.motion.x1, "position_multiplier", sums, of_changes)
        sums = moved.particle_delta_v, moved.bodies.delta_v
        of_changes = gradients.velocity_change, of_bodies.velocity_change
        self._velocities = self._projection(moved.x1, "velocity_multiplier", sums, of_changes)

    def _projection(self, x, multiplier, sums, of_changes):
        """Returns the sweeps on a multiplier, given the gradients with respect to changes of vertices and bodies."""
        swept, of_constraints = Projection(), self._of_constraints
        swept.of_velocities, swept.x = multiplier == "velocity_multiplier", x
        swept.multiplier = getattr(self._step.constraints, multiplier)
        swept.sums, swept.body_sums = sums
        of_multipliers = getattr(of_constraints, multiplier), of_constraints.previous_multiplier
        names = "multiplier_change", "previous_change", "vertex_change", "body_change"
        gradients = dict(zip(names, (*of_multipliers, *of_changes), strict=True))
        for name, gradient in gradients.items():
            setattr(swept, name, wp.zeros_like(gradient))
        return with_gradients(swept, **gradients)[0]

    def backward(self, *of_state: wp.array | None) -> None:
        """Turns gradients with respect to the results of the step into those with respect to its inputs, in place.

        Adds to the gradients of the model with respect to masses, inertias and coefficients, where it has such arrays.

        Args:
            of_state: The arrays of :class:`.adjoint.structs.StateGradients`, in its order; those of bodies may be
                omitted if the model has none.
        """
        recorded, restored, gradients, of_motion = self._recorded, self._restored, self._gradients, self._of_motion
        step, cursor, both = self._step, restored.cursor, self._vertices_and_bodies
        motion = step.motion
        of_states, of_model = structs.StateGradients(), structs.ModelGradients()
        for name, array in zip(structs.StateGradients.vars, of_state, strict=False):
            setattr(of_states, name, array)
        for name in structs.ModelGradients.vars:
            array = step.restitution if name == "restitution" else getattr(self._mesh.model, name)
            setattr(of_model, name, array.grad)
        wp.copy(restored.status.loop, recorded.restored.status.loop)
        self._launch(restore.begin_gradients, both, restored, of_states, gradients, of_motion)
        self._launch(restore.restore_velocities, both, restored, gradients)  # as they were before the turn
        self._move_cursor(Move.END)
        self._launch(pose_kernels.set_centres, self._bodies, motion, step.vertices.bodies.pose, step.vertices.bodies)
        self._through_turn()
        wp.capture_while(cursor.more_sweeps, self._batch, through=self._through_velocity_sweep)
        self._through_initialization()
        self._through_centres(step.vertices.bodies.pose)
        self._launch(pose_kernels.set_centres, self._bodies, motion, motion.bodies.end, step.vertices.bodies)
        wp.capture_while(cursor.more_iterations, self._through_iteration)
        self._through_vertices_of_bodies(kernels.place_vertices, "x1")
        inputs = [restored, gradients, of_motion, of_states, of_model]
        self._launch(restore.finish_gradients, len(motion.x0), *inputs)
        if self._mesh.model.body_count:
            self._through_motion_of_bodies()
            self._launch(restore.finish_body_gradients, self._mesh.model.body_count, *inputs)
        recorded.friction.backward(of_motion.friction, self._of_planes.friction)

    def _through_motion_of_bodies(self):
        """Turns gradients with respect to vertices of shapes and planes into those with respect to poses of bodies."""
        step, mesh = self._step, self._mesh
        self._through_centres(step.motion.bodies.end)
        self._through_poses()
        shapes, planes = mesh.device_shape_vertices, mesh.device_planes
        inputs = [step.motion, shapes.body, shapes.position, mesh.model.particle_count, step.dt]
        self._launch_adjoint(pose_kernels.place_shape_vertices, len(shapes.body), inputs)
        inputs = [step.motion, planes.point, planes.normal, planes.body, self._restored.planes]
        self._launch_adjoint(pose_kernels.place_planes, len(planes.body), inputs)

    def _through_turn(self):
        """Goes back through the turn that restores angular momentum."""
        both, gradients, worlds = self._vertices_and_bodies, self._gradients, len(self._restored.status.is_fast)
        totals = wp.zeros((worlds, int(SUMS)), dtype=wp.float64, device=self._mesh.device, requires_grad=True)
        inputs = [self._step, totals]
        self._launch(kernels.add_torques, self._constraints, *inputs)
        self._launch(kernels.add_moments, both, *inputs)
        of_outputs = [gradients.velocity, gradients.bodies.velocity]
        self._launch_adjoint(kernels.turn_velocities, both, inputs, of_outputs)
        self._launch_adjoint(kernels.add_moments, both, inputs)
        self._launch_adjoint(kernels.add_torques, self._constraints, inputs)

    def _batch(self, through):
        for _ in range(SWEEPS_PER_BATCH):
            through()

    def _through_velocity_sweep(self):
        """Goes back through a sweep on velocities."""
        self._launch(restore.restore_multipliers, self._constraints, self._restored, self._velocities)
        self._restore_velocities()
        self._through_change(self._velocities)
        self._through_vertices_of_bodies(kernels.vertex_velocities, "velocity")

    def _through_initialization(self):
        """Goes back through the initial velocity multipliers."""
        self._restore_velocities()
        self._launch_adjoint(kernels.initialize_multipliers, self._constraints, [self._restored, self._velocities])
        self._of_constraints.previous_multiplier.zero_()

    def _through_iteration(self):
        """Goes back through an iteration: truncation, sweeps, and the constraints that its detection added."""
        self._restore_positions()
        self._through_vertices_of_bodies(kernels.place_vertices, "x1")
        self._through_truncation()
        self._move_cursor(Move.SWEEPS)
        if self._moves_bodies:
            wp.capture_if(self._restored.cursor.more_sweeps, self._through_poses)
        wp.capture_while(self._restored.cursor.more_sweeps, self._batch, through=self._through_position_sweep)
        self._move_cursor(Move.DETECTION)
        inputs = [self._restored, self._recorded.restored.step.constraints]
        self._launch_adjoint(kernels.make_constraints, self._constraints, inputs)

    def _through_position_sweep(self):
        """Goes back through a sweep on positions."""
        self._launch(restore.restore_multipliers, self._constraints, self._restored, self._positions)
        self._restore_positions()
        self._place()
        self._through_change(self._positions)
        self._through_vertices_of_bodies(kernels.project_vertices, "x1", self._sums)

    def _through_change(self, swept):
        """Goes back through what a sweep changes."""
        self._launch_adjoint(kernels.change_multipliers, self._constraints, [self._restored, swept])
        self._step.vertices.active.zero_()
        if self._moves_bodies:
            self._step.vertices.bodies.active.zero_()

    def _through_truncation(self):
        """Goes back through the truncation of paths."""
        restored, times, count = self._restored, self._times, self._truncations
        self._launch(restore.restore_paths, count, restored, self._gradients, self._of_paths)
        self._place()
        self._launch(kernels.find_truncation_times, count, restored, times)
        self._launch_adjoint(kernels.truncate_paths, count, [restored, times, self._paths])
        self._launch_adjoint(kernels.find_truncation_times, count, [restored, times])

    def _through_vertices_of_bodies(self, kernel, name, *inputs):
        """Turns gradients with respect to positions or velocities of vertices into those with respect to bodies."""
        gradients = self._gradients
        collected = [self._step.motion, gradients, getattr(gradients, name), getattr(gradients, f"more_{name}")]
        self._launch(restore.collect_gradients_on_bodies, self._shape_vertices, *collected)
        self._launch_adjoint(kernel, self._shape_vertices, [self._step, *inputs], [gradients.on_bodies])

    def _through_poses(self):
        """Turns gradients with respect to poses into those with respect to what constraints did to them."""
        of_poses = self._gradients.bodies.pose
        self._launch_adjoint(kernels.project_poses, self._bodies, [self._step, self._sums], [of_poses])
        of_poses.zero_()

    def _through_centres(self, poses):
        """Turns gradients with respect to where impulses act into those with respect to the poses given."""
        if self._moves_bodies:
            inputs = [self._step.motion, poses, self._step.vertices.bodies]
            self._launch_adjoint(pose_kernels.set_centres, self._bodies, inputs)
            self._of_moved_bodies.centre.zero_()
            self._of_moved_bodies.inverse_inertia.zero_()

    def _move_cursor(self, move):
        self._launch(restore.move_cursor, 1, self._restored, int(move))

    def _restore_positions(self):
        self._launch(restore.restore_positions, self._vertices_and_bodies, self._restored, self._gradients, self._sums)

    def _restore_velocities(self):
        self._launch(restore.restore_velocities, self._vertices_and_bodies, self._restored, self._gradients)
        self._launch(kernels.vertex_velocities, self._shape_vertices, self._step, self._step.vertices.velocity)

    def _place(self):
        """Moves vertices of bodies to where their poses say."""
        self._launch(kernels.place_vertices, self._shape_vertices, self._step, self._step.vertices.x1)

    def _launch(self, kernel, dim, *arguments):
        wp.launch(kernel, dim, inputs=arguments, device=self._mesh.device)

    def _launch_adjoint(self, kernel, dim, inputs, of_outputs=()):
        launch_adjoint(kernel, dim, inputs, of_outputs, self._mesh.device)
