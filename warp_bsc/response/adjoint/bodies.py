"""The part of the adjoint of a step that goes back through rigid bodies, see :mod:`.adjoint`."""

import warp as wp

from ..state.structs import Bodies, Motion, MovedBodies, Vertices
from .arrays import attach_gradients, copy_arrays, launch_adjoint
from .body_kernels import (
    BodyGradients,
    add_body_moments,
    begin_body_gradients,
    collect_vertex_gradients,
    finish_body_gradients,
    place_planes,
    place_shape_vertices,
    place_vertices,
    project_poses,
    project_vertices,
    restore_body_paths,
    restore_body_velocities,
    restore_poses,
    restore_unturned_bodies,
    set_centres,
    truncate_body_paths,
    turn_body_velocities,
    vertex_velocities,
)

BODY_MOTION_ARRAYS = "start", "end", "velocity", "inverse_mass"

_OF_MODEL = {"com": "body_com", "mass": "body_mass", "inertia": "body_inertia", "inverse_inertia": "body_inv_inertia"}


class BodyAdjoint:
    """Carries gradients back through the bodies of a recorded step, in which the response may have moved them.

    Attributes:
        shift: Gradient with respect to what constraints add to the poses of bodies, Warp array of spatial_vectord.
        velocity_change: Gradient with respect to what they add to velocities, of the same kind.
        changes: Stands for these changes in adjoints of sweeps, which do not read it, of the same kind.
    """

    def __init__(self, step, gradients, motion: Motion, of_motion, vertices: Vertices):
        """Copies what going back changes, and gives gradients to the bodies of ``motion`` and ``vertices``.

        Args:
            step: The :class:`.adjoint.RecordedStep`.
            gradients: Those with respect to vertices at the cursor.
            motion: The motion.
            of_motion: The gradients with respect to its arrays, by name.
            vertices: The vertices.
        """
        self._step, self._gradients, self._motion, self._of_motion = step, gradients, motion, of_motion
        self._vertices, self._mesh = vertices, step.mesh
        self._device = device = step.mesh.device
        self.moves = step.moves_bodies
        count = step.mesh.model.body_count
        bodies, names = Bodies(), BODY_MOTION_ARRAYS[: 4 if self.moves else 2]
        self.shift = self.velocity_change = self.changes = None
        if not count:
            return
        for name in Bodies.vars if self.moves else names:
            setattr(bodies, name, getattr(step.motion.bodies, name))
        self._of_bodies = attach_gradients(bodies, names)
        of_bodies = BodyGradients()
        if self.moves:
            for name in ("shift", "velocity_change"):
                setattr(self, name, wp.zeros(count, dtype=wp.spatial_vectord, device=device))
                setattr(of_bodies, name, getattr(self, name))
            self.changes = wp.empty(count, dtype=wp.spatial_vectord, device=device)
            of_bodies.pose = wp.zeros(count, dtype=wp.transform, device=device)
            of_bodies.velocity = wp.zeros(count, dtype=wp.spatial_vector, device=device)
            of_bodies.vertices = wp.zeros(len(motion.x0), dtype=wp.vec3, device=device)
            sums = wp.zeros(count, dtype=wp.spatial_vectord, device=device)
            sums.grad = self.shift
            self._sums = sums
            moved = step.vertices.bodies
            mine = copy_arrays(moved, MovedBodies(), dict.fromkeys(("pose", "velocity", "delta_x", "delta_v")))
            mine.outcome = moved.outcome
            mine.active = wp.zeros(count, dtype=int, device=device)
            mine.centre = wp.zeros(count, dtype=wp.vec3d, device=device)
            mine.inverse_inertia = wp.zeros(count, dtype=wp.mat33d, device=device)
            given = {"pose": of_bodies.pose, "velocity": of_bodies.velocity}
            self._of_moved = attach_gradients(mine, ("pose", "velocity", "centre", "inverse_inertia"), given)
            vertices.bodies = mine
            truncations = len(step.record.vertex)
            self._of_paths = [
                wp.zeros(truncations, dtype=dtype, device=device) for dtype in (wp.transform, wp.spatial_vector)
            ]
            for name, of_model in _OF_MODEL.items():  # whose gradients are the model's own
                setattr(bodies, name, getattr(step.mesh.model, of_model))
        motion.bodies = bodies
        self._of = of_bodies

    def begin(self, of_poses, of_velocities):
        """Begins with the gradients of the poses and velocities at the end of the step."""
        if not self.moves:
            return
        inputs = [self._motion, self._step.undetected, of_poses, of_velocities]
        self._launch(begin_body_gradients, [*inputs, self._of, self._of_bodies.start])
        self._set_centres(self._vertices.bodies.pose)
        self._restore_poses()

    def restore_unturned(self):
        """Restores velocities as they were before bodies were turned."""
        if self.moves:
            self._launch(restore_unturned_bodies, [self._motion, self._vertices])

    def add_moments(self, totals):
        """Adds the moments of bodies to the totals of worlds."""
        if self.moves:
            self._launch(add_body_moments, [self._motion, self._vertices, totals])

    def through_turn(self, totals):
        """Goes back through the turn of bodies, to the totals of worlds."""
        if self.moves:
            self._launch_adjoint(turn_body_velocities, [self._motion, self._vertices, totals], [self._of.velocity])

    def through_moments(self, totals):
        """Goes back through the moments of bodies."""
        if self.moves:
            self._launch_adjoint(add_body_moments, [self._motion, self._vertices], [totals.grad])

    def restore_velocities(self):
        """Restores velocities of bodies and their vertices as they were before a sweep."""
        if self.moves:
            self._launch(restore_body_velocities, [self._motion, self._vertices, self._of])
            self._launch_over_vertices(vertex_velocities, [self._motion, self._vertices, self._vertices.velocity])

    def through_vertex_velocities(self):
        """Turns gradients with respect to velocities of vertices into those with respect to their bodies."""
        if self.moves:
            self._collect(self._gradients.velocity, self._gradients.more_velocity)
            self._launch_adjoint_over_vertices(vertex_velocities, [self._motion, self._vertices])

    def through_move_to_end(self):
        """Goes from changes of velocities on to those of positions, whose impulses act elsewhere."""
        if self.moves:
            self._through_centres(self._vertices.bodies.pose)
            self._set_centres(self._motion.bodies.end)

    def through_placement(self):
        """Turns gradients with respect to positions of vertices into those with respect to poses."""
        if self.moves:
            self._collect(self._gradients.x1, self._gradients.more_x1)
            self._launch_adjoint_over_vertices(place_vertices, [self._motion, self._vertices])

    def through_projection(self):
        """Turns gradients with respect to poses into those with respect to what constraints did to them."""
        if self.moves:
            self._launch_adjoint(project_poses, [self._motion, self._vertices, self._sums], [self._of.pose])
            self._of.pose.zero_()

    def restore_positions(self):
        """Restores poses and positions of vertices as they were before a sweep."""
        if self.moves:
            self._restore_poses()
            self._place()

    def through_projected_placement(self):
        """Turns gradients with respect to positions of vertices into those with respect to what constraints did."""
        if self.moves:
            self._collect(self._gradients.x1, self._gradients.more_x1)
            self._launch_adjoint_over_vertices(project_vertices, [self._motion, self._vertices, self._sums])

    def restore_paths(self, cursor):
        """Restores poses as they were before paths were truncated."""
        if self.moves:
            inputs = [self._vertices, self._of, self._step.record, cursor, *self._of_paths]
            wp.launch(restore_body_paths, len(self._step.record.vertex), inputs=inputs, device=self._device)
            self._place()

    def through_truncation(self, cursor, times):
        """Goes back through the truncation of paths, to their poses and to the times of their contacts."""
        if self.moves:
            step = self._step
            inputs = [self._motion, self._vertices, times, step.record, cursor, step.dt]
            truncations = len(step.record.vertex)
            launch_adjoint(truncate_body_paths, truncations, inputs, self._of_paths, self._of_paths, self._device)

    def finish(self, of_planes, of_starts, of_ends, of_velocities):
        """Writes the gradients of poses and velocities at the start and as predicted at the end of the step.

        Those of vertices of shapes, and of planes, become those of their bodies.
        """
        mesh = self._mesh
        if not mesh.model.body_count:
            return
        of_bodies, of_motion = self._of_bodies, self._of_motion
        if self.moves:
            self._through_centres(self._motion.bodies.end)
            self.through_projection()
        shapes, model = mesh.device_shape_vertices, mesh.model
        inputs = [self._motion, shapes.body, shapes.position, model.particle_count, self._step.dt]
        outputs = [of_motion.x0, of_motion.x1, of_motion.velocity]
        launch_adjoint(place_shape_vertices, len(shapes.body), inputs, outputs, outputs, self._device)
        planes = mesh.device_planes
        inputs = [self._motion, planes.point, planes.normal, planes.body]
        outputs = [of_planes.start, of_planes.end]
        launch_adjoint(place_planes, len(planes.body), inputs, outputs, outputs, self._device)
        inputs = [self._motion, self._of]
        inputs += [getattr(of_bodies, name, None) for name in BODY_MOTION_ARRAYS]
        of_model = [model.body_inv_mass, model.body_inv_inertia, model.body_mass, model.body_inertia]
        inputs += [self._step.complete, of_starts, of_ends, of_velocities]
        self._launch(finish_body_gradients, [*inputs, *(array.grad for array in of_model)])

    def _set_centres(self, poses):
        """Makes given poses those where impulses act."""
        moved = self._vertices.bodies
        self._launch(set_centres, [self._motion, poses, moved.centre, moved.inverse_inertia])

    def _through_centres(self, poses):
        """Turns gradients with respect to where impulses act into those with respect to the poses given."""
        of_centres = [self._of_moved.centre, self._of_moved.inverse_inertia]
        self._launch_adjoint(set_centres, [self._motion, poses], of_centres)
        for of in of_centres:
            of.zero_()

    def _restore_poses(self):
        self._launch(restore_poses, [self._motion, self._vertices, self._sums])

    def _place(self):
        self._launch_over_vertices(place_vertices, [self._motion, self._vertices, self._vertices.x1])

    def _collect(self, of_vertices, more):
        self._launch_over_vertices(collect_vertex_gradients, [self._motion, of_vertices, more, self._of])

    def _launch(self, kernel, inputs):
        wp.launch(kernel, self._mesh.model.body_count, inputs=inputs, device=self._device)

    def _launch_over_vertices(self, kernel, inputs):
        wp.launch(kernel, len(self._mesh.shape_vertices.body), inputs=inputs, device=self._device)

    def _launch_adjoint(self, kernel, inputs, of_outputs):
        launch_adjoint(kernel, self._mesh.model.body_count, inputs, of_outputs, of_outputs, self._device)

    def _launch_adjoint_over_vertices(self, kernel, inputs):
        of_outputs = [self._of.vertices]
        launch_adjoint(kernel, len(self._mesh.shape_vertices.body), inputs, of_outputs, of_outputs, device=self._device)
