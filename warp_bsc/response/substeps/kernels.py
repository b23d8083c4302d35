"""Kernels of substeps."""

import warp as wp

from ..contacts.constraints import NEVER_SWEPT, approach_of
from ..schedule import SolveStatus
from ..state.motion import moves_with_body, predicted_velocity
from ..state.structs import Constraints, ContactKind, Motion, Vertices

wp.set_module_options({"enable_backward": False})

_UNCOUPLED = wp.constant(-2)
"""Iteration of the last contact of a world without constraints, so that no projection moves its vertices."""

_NEVER_VIOLATED = wp.constant(wp.float64(-1e30))


@wp.kernel
def use_substeps(unfinished: wp.array[int], number: int, substeps: wp.array[int]):
    """Writes the number of substeps of a step that collides; 0 of others."""
    substeps[0] = number * unfinished[0]


@wp.kernel
def find_worlds(motion: Motion, constraints: Constraints, has_constraints: wp.array[int]):
    """Marks the worlds that have constraints."""
    i = wp.tid()
    if i < constraints.count[0]:
        has_constraints[motion.world[constraints.vertices[i][0]]] = 1


@wp.kernel
def keep_counts(constraints: Constraints, status: SolveStatus, detected: wp.array[int]):
    """Keeps the numbers of constraints and contacts."""
    detected[0] = constraints.count[0]
    detected[1] = status.results.first_hits[0]
    status.loop.recount[0] = 0  # the start remains where crossings are counted


@wp.kernel
def begin_substeps(
    # in
    has_constraints: wp.array[int],
    number: wp.array[int],
    substeps: int,
    # in and out
    status: SolveStatus,
    # out
    is_coupled: wp.array[int],
    remaining: wp.array[int],
):
    """Marks the worlds that have constraints and take this number of substeps, and starts the count."""
    world = wp.tid()
    if world == 0:
        remaining[0] = substeps
    is_coupled[world] = wp.where(number[world] == substeps, has_constraints[world], 0)
    status.contact_iteration[world] = wp.where(is_coupled[world] == 1, 0, _UNCOUPLED)


@wp.kernel
def start_substep(
    # in
    motion: Motion,
    start: wp.array[wp.vec4d],
    end: wp.array[wp.vec4d],
    substeps: int,
    dt: float,
    remaining: wp.array[int],
    detected: wp.array[int],
    particle_q: wp.array[wp.vec3],
    particle_qd: wp.array[wp.vec3],
    # in and out
    substep: Motion,
    constraints: Constraints,
    status: SolveStatus,
    # out
    substep_start: wp.array[wp.vec4d],
    substep_end: wp.array[wp.vec4d],
    vertices: Vertices,
):
    """Writes the motion of a substep.

    Particles, and bodies that the response can move, go where the inner solver wants them, shapes a share of their way.
    """
    i = wp.tid()
    before = float(substeps - remaining[0]) / float(substeps)
    after = float(substeps - remaining[0] + 1) / float(substeps)
    if i == 0:
        constraints.count[0] = detected[0]
        status.loop.iteration[0] = 0
    if i < start.shape[0]:
        substep_start[i] = start[i] + wp.float64(before) * (end[i] - start[i])
        substep_end[i] = start[i] + wp.float64(after) * (end[i] - start[i])
    if i >= motion.x0.shape[0]:
        return
    lost = int(0)
    if i < particle_q.shape[0]:
        x0 = substep.x0[i]
        x1 = particle_q[i]
        velocity = particle_qd[i]
        if not (wp.isfinite(x1) and wp.isfinite(velocity)):
            x1 = x0
            velocity = wp.vec3()
            lost = 1
    elif moves_with_body(substep, i):
        x0 = substep.x0[i]
        place = i - motion.bodies.particle_count
        x1 = wp.transform_point(substep.bodies.end[motion.bodies.of_vertex[i]], motion.bodies.position[place])
        velocity = predicted_velocity(substep, i, x1)
    else:
        path = motion.x1[i] - motion.x0[i]
        x0 = motion.x0[i] + before * path
        x1 = motion.x0[i] + after * path
        velocity = path / dt
        substep.x0[i] = x0
    substep.x1[i] = x1
    substep.velocity[i] = velocity
    substep.is_not_finite[i] = lost
    vertices.x1[i] = x1
    vertices.velocity[i] = velocity
    vertices.outcome[i] = 0
    vertices.active[i] = 0
    for axis in range(3):
        vertices.particle_delta_x[i, axis] = wp.int64(0)
        vertices.particle_delta_v[i, axis] = wp.int64(0)


@wp.kernel
def reset_constraints(
    # in
    substep: Motion,
    vertices: Vertices,
    detected: wp.array[int],
    # in and out
    constraints: Constraints,
    status: SolveStatus,
):
    """Prepares constraints for the sweeps of a substep; those of planes are collected anew in each substep."""
    i = wp.tid()
    if i == 0:
        status.loop.iteration[0] = 1
        status.loop.active[0] = 0  # positions and velocities are swept without regard to a detection
    if i >= constraints.count[0]:
        return
    constraints.position_multiplier[i] = wp.vec3d()
    constraints.velocity_multiplier[i] = wp.vec3d()
    constraints.previous_multiplier[i] = wp.vec3d()
    constraints.last_sweep[i] = NEVER_SWEPT
    if i < detected[0] and constraints.kind[i] == ContactKind.PLANE:
        constraints.separation[i] = _NEVER_VIOLATED
        return
    corners = constraints.vertices[i]
    constraints.approach[i] = approach_of(
        substep, vertices, corners, constraints.weights[i], constraints.normal[i], constraints.separation[i]
    )


@wp.kernel
def end_substep(
    # in
    vertices: Vertices,
    # in and out
    remaining: wp.array[int],
    # out
    substep: Motion,
    particle_q: wp.array[wp.vec3],
    particle_qd: wp.array[wp.vec3],
):
    """Makes the end of a substep the start of the next."""
    vertex = wp.tid()
    if vertex == 0:
        remaining[0] = remaining[0] - 1
    if vertex < particle_q.shape[0]:
        substep.x0[vertex] = vertices.x1[vertex]
        particle_q[vertex] = vertices.x1[vertex]
        particle_qd[vertex] = vertices.velocity[vertex]
    elif moves_with_body(substep, vertex):
        substep.x0[vertex] = vertices.x1[vertex]


@wp.kernel
def end_body_substep(
    # in
    substep: Motion,
    vertices: Vertices,
    # out
    body_q: wp.array[wp.transform],
    body_qd: wp.array[wp.spatial_vector],
    body_q_prev: wp.array[wp.transform],
):
    """Makes the poses and velocities at the end of a substep those at the start of the next."""
    body = wp.tid()
    if substep.bodies.inverse_mass[body] > 0.0:
        body_q[body] = vertices.bodies.pose[body]
        body_qd[body] = vertices.bodies.velocity[body]
        if body_q_prev:
            body_q_prev[body] = vertices.bodies.pose[body]


@wp.kernel
def move_bodies(
    # in
    motion: Motion,
    body_q_start: wp.array[wp.transform],
    body_q_end: wp.array[wp.transform],
    substeps: int,
    remaining: wp.array[int],
    # out
    body_q_in: wp.array[wp.transform],
    body_q_out: wp.array[wp.transform],
):
    """Writes poses at both ends of a substep, between those of the whole step, of bodies that cannot be moved."""
    body = wp.tid()
    if motion.bodies.of_vertex:
        if motion.bodies.inverse_mass[body] > 0.0:
            return
    for end in range(2):
        share = float(substeps - remaining[0] + end) / float(substeps)
        start_pose = body_q_start[body]
        end_pose = body_q_end[body]
        p = wp.transform_get_translation(start_pose)
        p += share * (wp.transform_get_translation(end_pose) - p)
        r = wp.quat_slerp(wp.transform_get_rotation(start_pose), wp.transform_get_rotation(end_pose), share)
        if end == 0:
            body_q_in[body] = wp.transform(p, r)
        else:
            body_q_out[body] = wp.transform(p, r)


@wp.kernel
def end_substeps(
    # in
    is_coupled: wp.array[int],
    particle_q: wp.array[wp.vec3],
    particle_qd: wp.array[wp.vec3],
    # in and out
    motion: Motion,
    # out
    particle_q_out: wp.array[wp.vec3],
    particle_qd_out: wp.array[wp.vec3],
    vertices: Vertices,
):
    """Makes the substeps the predicted motion, in worlds that have constraints, and puts vertices back to the start."""
    particle = wp.tid()
    vertices.x1[particle] = motion.x0[particle]
    if particle >= particle_q.shape[0]:
        return
    if (
        is_coupled[motion.world[particle]] == 0
        or motion.is_not_finite[particle] != 0
        or motion.inverse_mass[particle] == 0.0
    ):
        return
    motion.x1[particle] = particle_q[particle]
    motion.velocity[particle] = particle_qd[particle]
    particle_q_out[particle] = particle_q[particle]
    particle_qd_out[particle] = particle_qd[particle]


@wp.kernel
def end_body_substeps(
    # in
    is_coupled: wp.array[int],
    body_q: wp.array[wp.transform],
    body_qd: wp.array[wp.spatial_vector],
    # in and out
    motion: Motion,
    # out
    body_q_out: wp.array[wp.transform],
    body_qd_out: wp.array[wp.spatial_vector],
):
    """Makes the poses after the substeps the predicted ones, in worlds that have constraints."""
    body = wp.tid()
    if motion.bodies.inverse_mass[body] == 0.0 or is_coupled[wp.max(motion.bodies.world[body], 0)] == 0:
        return
    motion.bodies.end[body] = body_q[body]
    motion.bodies.velocity[body] = body_qd[body]
    body_q_out[body] = body_q[body]
    body_qd_out[body] = body_qd[body]


@wp.kernel
def place_bodies(motion: Motion):
    """Writes the predicted positions and velocities of the vertices of bodies."""
    place = wp.tid()
    vertex = motion.bodies.particle_count + place
    if moves_with_body(motion, vertex):
        x1 = wp.transform_point(motion.bodies.end[motion.bodies.of_vertex[vertex]], motion.bodies.position[place])
        motion.x1[vertex] = x1
        motion.velocity[vertex] = predicted_velocity(motion, vertex, x1)


@wp.kernel
def restore_fast(has_fast: wp.array[int], status: SolveStatus):
    """Counts worlds with fast or pushing contacts in the motion that the inner solver predicted as such.

    Where something immovable pushes, substeps that obey it may end in contacts that do not look like it; but to divide
    them could leave vertices in its way.
    """
    world = wp.tid()
    status.is_fast[world] = wp.max(status.is_fast[world], has_fast[world])


@wp.kernel
def restore_hits(detected: wp.array[int], status: SolveStatus):
    """Makes the contacts of the step the inner solver predicted those that the status counts."""
    status.results.first_hits[0] = detected[1]
