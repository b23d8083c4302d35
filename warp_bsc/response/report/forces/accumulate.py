"""Kernels that keep impulses: they read the multipliers that a step ends with, and change nothing of the step.

All that the response does to momentum it does in velocities, which begin with the impulses of its changes of
positions, see :func:`.solve.sweeps.initial_velocity_multiplier`. A velocity multiplier therefore is the impulse of a
contact on its first element by its second. Velocities that follow from a cut path, and the turn that restores angular
momentum, belong to no pair, and are kept apart.
"""

import warp as wp

from ...state.fixed_sum import sum_of, sums_of
from ...state.motion import StateArrays, takes_part
from ...state.planes import MovingPlanes, signed_distance, time_of_entry
from ...state.poses import in_world
from ...state.structs import Motion, Step, body_of, can_move, has_final_velocity
from ...state.vectors import ZERO, to_double, to_single
from .structs import Sides, Unpaired
from .sums import body_of_vertex

wp.set_module_options({"enable_backward": False})


@wp.func
def _centre_of(state: StateArrays, sides: Sides, body: int) -> wp.vec3d:
    return to_double(wp.transform_point(state.body_q[body], sides.com[body]))


@wp.kernel
def write_centres(state: StateArrays, sides: Sides, mask: wp.array[wp.bool], centres: wp.array[wp.vec3d]):
    """Writes the centres of mass of bodies at the end of a step, as predicted; not where worlds take no part in it."""
    body = wp.tid()
    if mask and not takes_part(mask, sides.body_world[body]):
        return
    centres[body] = _centre_of(state, sides, body)


@wp.func
def body_of_side(sides: Sides, corners: wp.vec4i, plane: int, side: int) -> int:
    """Returns the body of one side of a contact, -1 for none."""
    if side == 1 and plane >= 0:
        return sides.plane_body[plane]
    return body_of_vertex(sides, corners[3 * side])


@wp.func
def torque_on(
    step: Step,
    sides: Sides,
    centres: wp.array[wp.vec3d],
    corners: wp.vec4i,
    weights: wp.vec4d,
    plane: int,
    side: int,
    impulse: wp.vec3d,
) -> wp.vec3d:
    """Returns the torque of the impulse of a contact on the body of one of its sides.

    The impulse is that on the first side. A plane, -1 for none, is a side without vertices, and is touched at the
    vertex.
    """
    x = step.vertices.x1
    body = body_of_side(sides, corners, plane, side)
    if body < 0:
        return wp.vec3d()
    centre = centres[body] + wp.vec3d()
    if can_move(step.motion, body):
        centre = step.vertices.bodies.centre[body]
    if side == 1 and plane >= 0:
        return wp.cross(centre - to_double(x[corners[0]]), impulse)
    arm = wp.vec3d()
    for j in range(4):
        if body_of_vertex(sides, corners[j]) == body:  # the other element is of another body
            arm += weights[j] * (to_double(x[corners[j]]) - centre)
    return wp.cross(arm, impulse)


@wp.func
def time_at_plane(motion: Motion, planes: MovingPlanes, i: int, vertex: int) -> wp.float64:
    """Returns when a vertex enters the solid of a plane, in [0, 1]."""
    before, _error = signed_distance(planes.start[i], motion.x0[vertex])
    after, _error_after = signed_distance(planes.end[i], motion.x1[vertex])
    return time_of_entry(before, after)


@wp.func
def responds(step: Step, i: int) -> bool:
    """Returns whether a constraint changed a velocity, which it does not where a path gave those on both sides.

    Its multiplier is no impulse then: each sweep adds to it, without effect.
    """
    for j in range(4):
        vertex = step.constraints.vertices[i][j]
        body = body_of(step.motion, vertex)
        if step.constraints.weights[i][j] != ZERO:
            outcome = step.vertices.outcome[vertex]
            moves = step.motion.inverse_mass[vertex] > 0.0
            if can_move(step.motion, body):
                outcome = step.vertices.bodies.outcome[body]
                moves = True
            if moves and outcome != 0 and not has_final_velocity(outcome):
                return True
    return False


@wp.func
def _unpaired(predicted: wp.vec3, resolved: wp.vec3, by_contacts: wp.vec3d, outcome: int) -> wp.vec3d:
    """Returns the change of a velocity that contacts did not make.

    It is what followed the contacts, as their change was rounded; or, where a path gave the velocity, the change less
    that of contacts, which had no effect.
    """
    if outcome == 0:
        return -by_contacts
    if has_final_velocity(outcome):
        return to_double(resolved) - to_double(predicted) - by_contacts
    return to_double(resolved) - to_double(to_single(to_double(predicted) + by_contacts))


@wp.kernel
def keep_unpaired(step: Step, unpaired: Unpaired):
    """Adds the changes of momentum that no pair has: by the turn of a world, and by velocities that a path gave."""
    i = wp.tid()
    motion, vertices = step.motion, step.vertices
    if i < unpaired.of_particles.shape[0] and motion.inverse_mass[i] > 0.0:
        by_contacts = sum_of(vertices.particle_delta_v, i, 0)
        change = _unpaired(motion.velocity[i], vertices.velocity[i], by_contacts, vertices.outcome[i])
        unpaired.of_particles[i] += change / wp.float64(motion.inverse_mass[i])
    bodies, moved = motion.bodies, vertices.bodies
    if i < moved.outcome.shape[0] and bodies.inverse_mass[i] > 0.0:
        shift, turn = sums_of(moved.delta_v, i)
        outcome = moved.outcome[i]
        predicted, resolved = bodies.velocity[i], moved.velocity[i]
        linear = _unpaired(wp.spatial_top(predicted), wp.spatial_top(resolved), shift, outcome)
        angular = _unpaired(wp.spatial_bottom(predicted), wp.spatial_bottom(resolved), turn, outcome)
        unpaired.of_bodies[i, 0] += wp.float64(bodies.mass[i]) * linear
        unpaired.of_bodies[i, 1] += in_world(bodies.inertia[i], moved.pose[i]) * angular
