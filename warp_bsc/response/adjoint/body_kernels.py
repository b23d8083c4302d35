"""The small steps of a response that move bodies, as kernels that Warp differentiates, and those that go back.

A body is as its pose and velocity say, and its vertices follow from them. While constraints move it, its pose follows
from the pose that was predicted, and from the sums of the changes by constraints.
"""

import warp as wp

from ..contacts.first_contact import share_before
from ..solve.angular_momentum import body_moments, body_turns, change_by_turn
from ..solve.bodies import changed_velocity
from ..state.fixed_sum import sums_of
from ..state.motion import moves_with_body, predicted_velocity
from ..state.planes import transformed_plane
from ..state.poses import centre_of, inverse_inertia_at, pose_between, turned_pose, velocity_between, velocity_on_body
from ..state.record import NO_CONTACT, StepRecord, truncation_at
from ..state.structs import HELD, MASS, MOMENTS, Motion, Vertices, has_final_velocity
from ..state.vectors import ZERO, to_double, to_single
from .kernels import Cursor, torque_and_moments


@wp.struct
class BodyGradients:
    """Gradients with respect to bodies, and to changes of them by constraints, at the cursor."""

    pose: wp.array[wp.transform]
    velocity: wp.array[wp.spatial_vector]
    shift: wp.array[wp.spatial_vectord]  # with respect to changes of centres, and turns
    velocity_change: wp.array[wp.spatial_vectord]  # with respect to what constraints add to velocities
    vertices: wp.array[wp.vec3]  # with respect to positions or velocities of vertices, which become those of bodies


@wp.func
def _is_movable(motion: Motion, body: int) -> bool:
    return motion.bodies.inverse_mass[body] > 0.0


@wp.func
def _has_moved(motion: Motion, vertices: Vertices, body: int) -> bool:
    """Returns whether the response moved a body; others keep every bit of their pose."""
    return _is_movable(motion, body) and vertices.bodies.outcome[body] != 0


@wp.func
def _spatial(linear: wp.vec3d, angular: wp.vec3d) -> wp.spatial_vector:
    return wp.spatial_vector(to_single(linear), to_single(angular))


@wp.func
def _pose_by(motion: Motion, vertices: Vertices, sums: wp.array[wp.spatial_vectord], body: int) -> wp.transform:
    """Returns the pose of a body by what constraints did to it."""
    change = sums[body]
    pose = motion.bodies.end[body]
    if _has_moved(motion, vertices, body):
        pose = turned_pose(motion.bodies, body, pose, wp.spatial_top(change), wp.spatial_bottom(change))
    return pose


@wp.kernel
def project_poses(
    motion: Motion, vertices: Vertices, sums: wp.array[wp.spatial_vectord], poses: wp.array[wp.transform]
):
    """Computes the poses of bodies by what constraints did to them, see :func:`.bodies.move_bodies`."""
    body = wp.tid()
    poses[body] = _pose_by(motion, vertices, sums, body)


@wp.kernel
def project_vertices(
    motion: Motion, vertices: Vertices, sums: wp.array[wp.spatial_vectord], positions: wp.array[wp.vec3]
):
    """Computes the positions of vertices in these poses, see :func:`.bodies.place_vertices`."""
    vertex = motion.bodies.particle_count + wp.tid()
    body = motion.bodies.of_vertex[vertex]
    if body >= 0 and _is_movable(motion, body):
        pose = _pose_by(motion, vertices, sums, body)
        positions[vertex] = wp.transform_point(pose, motion.bodies.position[wp.tid()])


@wp.kernel
def place_vertices(motion: Motion, vertices: Vertices, positions: wp.array[wp.vec3]):
    """Computes the positions of vertices from the poses of their bodies, see :func:`.bodies.place_vertices`."""
    vertex = motion.bodies.particle_count + wp.tid()
    body = motion.bodies.of_vertex[vertex]
    if body >= 0 and _is_movable(motion, body):
        positions[vertex] = wp.transform_point(vertices.bodies.pose[body], motion.bodies.position[wp.tid()])


@wp.kernel
def vertex_velocities(motion: Motion, vertices: Vertices, velocities: wp.array[wp.vec3]):
    """Computes the velocities of vertices from those of their bodies, see :func:`.bodies.set_vertex_velocities`."""
    vertex = motion.bodies.particle_count + wp.tid()
    body = motion.bodies.of_vertex[vertex]
    if body >= 0 and _is_movable(motion, body):
        arm = to_double(vertices.x1[vertex]) - vertices.bodies.centre[body]
        velocities[vertex] = velocity_on_body(vertices.bodies.velocity[body], arm)


@wp.kernel
def set_centres(
    motion: Motion,
    poses: wp.array[wp.transform],
    centres: wp.array[wp.vec3d],
    inverse_inertias: wp.array[wp.mat33d],
):
    """Computes where impulses act on bodies in given poses, see :func:`.bodies.move_to_end`."""
    body = wp.tid()
    if _is_movable(motion, body):
        centres[body] = centre_of(motion.bodies, body, poses[body])
        inverse_inertias[body] = inverse_inertia_at(motion.bodies, body, poses[body])


@wp.kernel
def add_body_moments(motion: Motion, vertices: Vertices, totals: wp.array2d[wp.float64]):
    """Adds the moments of bodies to the totals of their worlds, see :func:`.angular_momentum.sum_body_moments`."""
    body = wp.tid()
    if body_turns(motion, vertices, body):
        world = wp.max(motion.bodies.world[body], 0)
        torque, added = body_moments(motion, vertices, body)
        for axis in range(3):
            wp.atomic_add(totals, world, axis, torque[axis])
        for i in range(MOMENTS):
            wp.atomic_add(totals, world, MASS + i, added[i])


@wp.kernel
def turn_body_velocities(
    motion: Motion, vertices: Vertices, totals: wp.array2d[wp.float64], changes: wp.array[wp.spatial_vector]
):
    """Computes what the turn of each world changes, see :func:`.angular_momentum.turn_bodies`."""
    body = wp.tid()
    world = wp.max(motion.bodies.world[body], 0)
    if body_turns(motion, vertices, body) and totals[world, HELD] == ZERO:
        torque, total = torque_and_moments(totals, world)
        change, turn = change_by_turn(torque, total, vertices.bodies.centre[body])
        changes[body] = _spatial(change, turn)


@wp.kernel
def truncate_body_paths(
    # in
    motion: Motion,
    vertices: Vertices,
    times: wp.array[wp.float64],
    record: StepRecord,
    cursor: Cursor,
    dt: wp.float64,
    # out
    poses: wp.array[wp.transform],
    velocities: wp.array[wp.spatial_vector],
):
    """Computes the poses and velocities of bodies whose paths were truncated, see :func:`.bodies.cut_bodies`."""
    entry = truncation_at(record, cursor.iteration[0], wp.tid())
    if entry < 0:
        return
    body = record.body[entry]
    if body < 0:
        return
    start = motion.bodies.start[body]
    if record.kind[entry] == NO_CONTACT:
        poses[entry] = start
        velocities[entry] = wp.spatial_vector()
    else:
        share = share_before(times[entry])
        end = pose_between(motion.bodies, body, start, vertices.bodies.pose[body], share)
        poses[entry] = end
        velocities[entry] = velocity_between(motion.bodies, body, start, end, dt)


@wp.kernel
def place_shape_vertices(
    # in
    motion: Motion,
    bodies: wp.array[int],
    positions: wp.array[wp.vec3],
    particle_count: int,
    dt: float,
    # out
    x0: wp.array[wp.vec3],
    x1: wp.array[wp.vec3],
    velocities: wp.array[wp.vec3],
):
    """Computes the predicted motion of vertices of shapes from that of their bodies, see :mod:`.model_motion`."""
    i = wp.tid()
    vertex = particle_count + i
    body = bodies[i]
    if body < 0 or motion.is_not_finite[vertex] != 0:
        return
    start = wp.transform_point(motion.bodies.start[body], positions[i])
    end = wp.transform_point(motion.bodies.end[body], positions[i])
    x0[vertex] = start
    x1[vertex] = end
    if moves_with_body(motion, vertex):
        velocities[vertex] = predicted_velocity(motion, vertex, end)
    else:
        velocities[vertex] = (end - start) / dt


@wp.kernel
def place_planes(
    # in
    motion: Motion,
    points: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    bodies: wp.array[int],
    # out
    starts: wp.array[wp.vec4d],
    ends: wp.array[wp.vec4d],
):
    """Computes the planes at the start and at the end of a step, see :mod:`.model_motion`."""
    i = wp.tid()
    starts[i] = transformed_plane(points[i], normals[i], bodies[i], motion.bodies.start)
    ends[i] = transformed_plane(points[i], normals[i], bodies[i], motion.bodies.end)


@wp.kernel(enable_backward=False)
def begin_body_gradients(
    # in
    motion: Motion,
    undetected: wp.array[int],
    body_q: wp.array[wp.transform],
    body_qd: wp.array[wp.spatial_vector],
    # out
    gradients: BodyGradients,
    starts: wp.array[wp.transform],
):
    """Initializes gradients by those of the results; where an undetected step froze everything, only that of starts."""
    body = wp.tid()
    pose = body_q[body]
    velocity = body_qd[body]
    if undetected[0] == 1 and _is_movable(motion, body):
        starts[body] = pose
        pose = wp.transform(wp.vec3(), wp.quat())
        velocity = wp.spatial_vector()
    gradients.pose[body] = pose
    gradients.velocity[body] = velocity


@wp.kernel(enable_backward=False)
def restore_unturned_bodies(motion: Motion, vertices: Vertices):
    """Restores velocities as they were before bodies were turned."""
    body = wp.tid()
    moved = vertices.bodies
    if body_turns(motion, vertices, body):
        moved.velocity[body] = changed_velocity(motion.bodies.velocity[body], moved.delta_v, body)


@wp.kernel(enable_backward=False)
def restore_body_velocities(motion: Motion, vertices: Vertices, gradients: BodyGradients):
    """Restores velocities of bodies as they were before a sweep."""
    body = wp.tid()
    moved = vertices.bodies
    change = wp.spatial_vectord()
    if _is_movable(motion, body) and not has_final_velocity(moved.outcome[body]):
        for i in range(6):
            change[i] = wp.float64(gradients.velocity[body][i])
        if moved.active[body] != 0:
            moved.velocity[body] = changed_velocity(motion.bodies.velocity[body], moved.delta_v, body)
    gradients.velocity_change[body] = change


@wp.kernel(enable_backward=False)
def restore_poses(motion: Motion, vertices: Vertices, sums: wp.array[wp.spatial_vectord]):
    """Restores poses and sums of changes of bodies as they were before a sweep."""
    body = wp.tid()
    moved = vertices.bodies
    shift, turn = sums_of(moved.delta_x, body)
    sums[body] = wp.spatial_vectord(shift[0], shift[1], shift[2], turn[0], turn[1], turn[2])
    if moved.active[body] != 0 and _is_movable(motion, body):
        pose = motion.bodies.end[body]
        if wp.length_sq(shift) + wp.length_sq(turn) > ZERO:
            pose = turned_pose(motion.bodies, body, pose, shift, turn)
        moved.pose[body] = pose


@wp.kernel(enable_backward=False)
def collect_vertex_gradients(
    motion: Motion, of_vertices: wp.array[wp.vec3], more: wp.array[wp.vec3], gradients: BodyGradients
):
    """Moves the gradients with respect to vertices of bodies to ``gradients.vertices``."""
    vertex = motion.bodies.particle_count + wp.tid()
    body = motion.bodies.of_vertex[vertex]
    collected = wp.vec3()
    if body >= 0 and _is_movable(motion, body):
        collected = of_vertices[vertex] + more[vertex]
        of_vertices[vertex] = wp.vec3()
        more[vertex] = wp.vec3()
    gradients.vertices[vertex] = collected


@wp.kernel(enable_backward=False)
def restore_body_paths(
    # in
    vertices: Vertices,
    gradients: BodyGradients,
    record: StepRecord,
    cursor: Cursor,
    # out
    poses: wp.array[wp.transform],
    velocities: wp.array[wp.spatial_vector],
):
    """Restores the poses before truncation; the gradients of their bodies move to ``poses`` and ``velocities``."""
    entry = truncation_at(record, cursor.iteration[0], wp.tid())
    if entry < 0:
        return
    body = record.body[entry]
    if body < 0:
        return
    poses[entry] = gradients.pose[body]
    velocities[entry] = gradients.velocity[body]
    gradients.pose[body] = wp.transform(wp.vec3(), wp.quat())
    gradients.velocity[body] = wp.spatial_vector()
    vertices.bodies.pose[body] = record.pose[entry]


@wp.kernel(enable_backward=False)
def finish_body_gradients(
    # in
    motion: Motion,
    gradients: BodyGradients,
    motion_starts: wp.array[wp.transform],
    motion_ends: wp.array[wp.transform],
    motion_velocities: wp.array[wp.spatial_vector],
    motion_inverse_masses: wp.array[float],
    complete: wp.array[int],
    # out
    starts: wp.array[wp.transform],
    ends: wp.array[wp.transform],
    velocities: wp.array[wp.spatial_vector],
    inverse_masses: wp.array[float],
    inverse_inertias: wp.array[wp.mat33],
    masses: wp.array[float],
    inertias: wp.array[wp.mat33],
):
    """Writes the gradients of poses, velocities and masses of bodies; NaN if the record of the step is incomplete.

    Where the response moves no bodies, all that it adds to are those of poses.
    """
    body = wp.tid()
    missing = float(0.0)
    if complete[0] == 0:
        missing = wp.nan
    start = starts[body] + motion_starts[body]
    end = motion_ends[body]
    if motion.bodies.of_vertex:
        velocity = gradients.velocity[body] + motion_velocities[body]
        for i in range(6):
            velocity[i] = velocity[i] + missing
        velocities[body] = velocity
        if _is_movable(motion, body):
            if inverse_masses:
                inverse_masses[body] = inverse_masses[body] + motion_inverse_masses[body] + missing
            if inverse_inertias:
                inverse_inertias[body] = inverse_inertias[body] + missing * wp.identity(3, dtype=float)
            if masses:
                masses[body] = masses[body] + missing
            if inertias:
                inertias[body] = inertias[body] + missing * wp.identity(3, dtype=float)
    else:
        end = end + ends[body]
    for i in range(7):
        start[i] = start[i] + missing
        end[i] = end[i] + missing
    starts[body] = start
    ends[body] = end
