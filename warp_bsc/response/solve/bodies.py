"""Rigid bodies: the changes of poses and velocities by constraints; the vertices of a body follow its pose.

A constraint acts on a body at the contact point: the inverse mass along a normal n is 1/m + (r x n) I^-1 (r x n), with
the arm r from the centre of mass. Each constraint adds a change of the centre and a turn to the sums of its bodies, as
it adds changes of positions to those of particles; a body then moves by its sums, and its vertices follow from the
pose, rounded as ``newton.State.body_q`` stores it. Where paths are cut, that of a body is cut as one.
"""

import warp as wp

from ..state.fixed_sum import add_to_sum, sums_of
from ..state.poses import centre_of, in_world, turned_pose, velocity_on_body
from ..state.structs import PROJECTED, Bodies, Motion, MovedBodies, Step, body_of, can_move, has_final_velocity
from ..state.vectors import ONE, ZERO, to_double, to_single

wp.set_module_options({"enable_backward": False})

WHOLE_PATH = wp.constant(wp.int64(2**30))
"""The share of a path that is not cut, in units of TIME_UNITS."""
FREEZES = wp.constant(wp.int64(-1))
"""In place of a share: the body is frozen."""


@wp.func
def _body_of_side(motion: Motion, corners: wp.vec4i, side: int) -> int:
    """Returns the body of the first or second element of a constraint, -1 if there is none; a plane is none."""
    if side == 1 and corners[0] == corners[3]:
        return -1
    return body_of(motion, corners[3 * side])


@wp.func
def _lever(step: Step, i: int, side: int, x: wp.array[wp.vec3]):
    """Returns the lever of the first or second element of a constraint, at positions ``x`` of the vertices.

    It is the body, -1 if the side is none that can be moved; the sum of the weights of its vertices, and of their arms
    by weight [m].
    """
    corners = step.constraints.vertices[i]
    weights = step.constraints.weights[i]
    body = _body_of_side(step.motion, corners, side)
    if not can_move(step.motion, body):
        body = -1
    weight = ZERO
    arm = wp.vec3d()
    if body >= 0:
        for j in range(4):
            if step.motion.bodies.of_vertex[corners[j]] == body:  # the other element is of another body
                weight += weights[j]
                arm += weights[j] * (to_double(x[corners[j]]) - step.vertices.bodies.centre[body])
    return body, weight, arm


@wp.func
def activate_bodies(step: Step, i: int):
    """Counts an active constraint for its bodies."""
    for side in range(2):
        body = _body_of_side(step.motion, step.constraints.vertices[i], side)
        if body >= 0:
            wp.atomic_add(step.vertices.bodies.active, body, 1)


@wp.func
def body_inverse_masses(step: Step, i: int, x: wp.array[wp.vec3], counted: wp.float64):
    """Returns what the bodies of a constraint add to its inverse mass [1/kg], along the normal and across it.

    The inverse mass of a body is a matrix. The two numbers belong to a larger one, without products of the normal with
    other directions, so that sweeps converge.
    """
    normal = step.constraints.normal[i]
    along = ZERO
    across = ZERO
    for side in range(2):
        body, weight, arm = _lever(step, i, side, x)
        if body >= 0:
            parts = wp.max(wp.float64(step.vertices.bodies.active[body]) * counted, ONE)
            inverse_inertia = step.vertices.bodies.inverse_inertia[body]
            linear = weight * weight * wp.float64(step.motion.bodies.inverse_mass[body])
            turned = wp.cross(inverse_inertia * wp.cross(arm, normal), arm)
            turned_along = wp.dot(turned, normal)
            product = ZERO
            if step.constraints.friction[i] > 0.0:
                product = wp.length(turned - turned_along * normal)
            trace = wp.trace(inverse_inertia) * wp.length_sq(arm)
            trace -= wp.dot(arm, inverse_inertia * arm)
            along += parts * (linear + turned_along + product)
            across += parts * (linear + trace - turned_along + product)
    return along, across


@wp.func
def body_change(step: Step, i: int, side: int, change: wp.vec3d, x: wp.array[wp.vec3]):
    """Returns what the change of a multiplier does to the body on one side of its constraint.

    It is the body, -1 if there is none that can be moved; the change of its centre of mass and its turn, or of the
    velocities of both.
    """
    body, weight, arm = _lever(step, i, side, x)
    shift = wp.vec3d()
    turn = wp.vec3d()
    if body >= 0:
        shift = weight * wp.float64(step.motion.bodies.inverse_mass[body]) * change
        turn = step.vertices.bodies.inverse_inertia[body] * wp.cross(arm, change)
    return body, shift, turn


@wp.func
def add_body_delta(step: Step, i: int, change: wp.vec3d, x: wp.array[wp.vec3], sums: wp.array2d[wp.int64]):
    """Adds what the change of a multiplier does to the bodies of its constraint, at positions ``x`` of vertices."""
    for side in range(2):
        body, shift, turn = body_change(step, i, side, change, x)
        if body >= 0:
            add_to_sum(sums, body, 0, shift)
            add_to_sum(sums, body, 3, turn)


@wp.func
def _set_centre(bodies: Bodies, moved: MovedBodies, body: int):
    """Sets the centre and inverse inertia of a body, where impulses act, to those of its pose."""
    pose = moved.pose[body]
    moved.centre[body] = centre_of(bodies, body, pose)
    moved.inverse_inertia[body] = in_world(bodies.inverse_inertia[body], pose)


@wp.kernel
def begin_bodies(step: Step):
    """Initializes the bodies by their prediction, and clears everything else."""
    body = wp.tid()
    bodies, moved = step.motion.bodies, step.vertices.bodies
    moved.pose[body] = bodies.end[body]
    moved.velocity[body] = bodies.velocity[body]
    _set_centre(bodies, moved, body)
    for axis in range(6):
        moved.delta_x[body, axis] = wp.int64(0)
        moved.delta_v[body, axis] = wp.int64(0)
    moved.active[body] = 0
    moved.moved[body] = 0
    moved.share[body] = WHOLE_PATH
    moved.loose[body] = 0
    moved.outcome[body] = 0


@wp.kernel
def move_bodies(step: Step, last: bool):
    """Moves each body by the sum of its changes by constraints; the ``last`` sweep empties its active set."""
    body = wp.tid()
    bodies, moved = step.motion.bodies, step.vertices.bodies
    moves = moved.active[body] != 0 and bodies.inverse_mass[body] > 0.0
    moved.moved[body] = wp.where(moves, 1, 0)
    if last:
        moved.active[body] = 0
    if moves:
        pose = bodies.end[body]
        shift, turn = sums_of(moved.delta_x, body)
        if wp.length_sq(shift) + wp.length_sq(turn) > ZERO:  # else it keeps every bit of its pose
            pose = turned_pose(bodies, body, pose, shift, turn)
        moved.pose[body] = pose
        moved.outcome[body] = moved.outcome[body] | PROJECTED


@wp.kernel
def place_vertices(step: Step):
    """Moves the vertices of bodies that moved."""
    bodies, moved = step.motion.bodies, step.vertices.bodies
    vertex = bodies.particle_count + wp.tid()
    body = bodies.of_vertex[vertex]
    if body >= 0 and moved.moved[body] != 0:
        step.vertices.x1[vertex] = wp.transform_point(moved.pose[body], bodies.position[wp.tid()])
        step.vertices.changed[vertex] = 1


@wp.kernel
def move_to_end(step: Step):
    """Makes impulses act on bodies in their poses at the end of the step."""
    body = wp.tid()
    if step.motion.bodies.inverse_mass[body] > 0.0:
        _set_centre(step.motion.bodies, step.vertices.bodies, body)


@wp.kernel
def change_body_velocities(step: Step, last: bool):
    """Changes the velocity of each body that was not truncated; ``last`` empties its active set."""
    body = wp.tid()
    bodies, moved = step.motion.bodies, step.vertices.bodies
    is_free = bodies.inverse_mass[body] > 0.0 and not has_final_velocity(moved.outcome[body])
    if is_free and moved.active[body] != 0:
        linear, angular = sums_of(moved.delta_v, body)
        linear += to_double(wp.spatial_top(bodies.velocity[body]))
        angular += to_double(wp.spatial_bottom(bodies.velocity[body]))
        moved.velocity[body] = wp.spatial_vector(to_single(linear), to_single(angular))
    if last:
        moved.active[body] = 0


@wp.kernel
def set_vertex_velocities(step: Step):
    """Sets the velocities of vertices to those of their bodies."""
    bodies, moved = step.motion.bodies, step.vertices.bodies
    vertex = bodies.particle_count + wp.tid()
    body = bodies.of_vertex[vertex]
    if can_move(step.motion, body):
        arm = to_double(step.vertices.x1[vertex]) - moved.centre[body]
        step.vertices.velocity[vertex] = velocity_on_body(moved.velocity[body], arm)
