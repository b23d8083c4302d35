"""Kernels that adjoints differentiate: what follows from poses of bodies alone. The contact layer uses them too."""

import warp as wp

from ..state.motion import moves_with_body, predicted_velocity
from ..state.planes import MovingPlanes, transformed_plane
from ..state.poses import centre_of, in_world
from ..state.structs import Motion, MovedBodies, can_move


@wp.kernel
def set_centres(motion: Motion, poses: wp.array[wp.transform], moved: MovedBodies):
    """Computes where impulses act on bodies in given poses, see :func:`.solve.bodies.move_to_end`."""
    body = wp.tid()
    if can_move(motion, body):
        moved.centre[body] = centre_of(motion.bodies, body, poses[body])
        moved.inverse_inertia[body] = in_world(motion.bodies.inverse_inertia[body], poses[body])


@wp.kernel
def place_shape_vertices(
    motion: Motion, bodies: wp.array[int], positions: wp.array[wp.vec3], particle_count: int, dt: float
):
    """Computes the predicted motion of vertices of shapes from that of their bodies, see :mod:`.state.motion`."""
    i = wp.tid()
    vertex = particle_count + i
    body = bodies[i]
    if body < 0 or motion.is_not_finite[vertex] != 0:
        return
    start = wp.transform_point(motion.bodies.start[body], positions[i])
    end = wp.transform_point(motion.bodies.end[body], positions[i])
    motion.x0[vertex] = start
    motion.x1[vertex] = end
    if moves_with_body(motion, vertex):
        motion.velocity[vertex] = predicted_velocity(motion, vertex, end)
    else:
        motion.velocity[vertex] = (end - start) / dt


@wp.kernel
def place_planes(
    motion: Motion, points: wp.array[wp.vec3], normals: wp.array[wp.vec3], bodies: wp.array[int], planes: MovingPlanes
):
    """Computes the planes at the start and at the end of a step, see :mod:`.state.motion`."""
    i = wp.tid()
    planes.start[i] = transformed_plane(points[i], normals[i], bodies[i], motion.bodies.start)
    planes.end[i] = transformed_plane(points[i], normals[i], bodies[i], motion.bodies.end)
