"""Kernels that keep impulses: they read the multipliers that a step ends with, and change nothing of the step.

All that the response does to momentum it does in velocities, which begin with the impulses of its changes of
positions, see :func:`.solve.sweeps.initial_velocity_multiplier`. A velocity multiplier therefore is the impulse of a
contact on its first element by its second. Velocities that follow from a cut path, and the turn that restores angular
momentum, belong to no pair, and are kept apart.
"""

import warp as wp

from ..state.fixed_sum import sum_of, sums_of
from ..state.motion import StateArrays, continues, takes_part
from ..state.planes import MovingPlanes, signed_distance, time_of_entry
from ..state.poses import in_world
from ..state.structs import ContactKind, Motion, Step, body_of, can_move, constraint_count, has_final_velocity
from ..state.vectors import ONE, ZERO, relative, to_double, to_single
from .structs import Centres, KeptImpulses, Sides, Unpaired
from .sums import add_impulse, body_of_vertex, clear_kept

wp.set_module_options({"enable_backward": False})


@wp.func
def _centre_of(state: StateArrays, sides: Sides, body: int) -> wp.vec3d:
    return to_double(wp.transform_point(state.body_q[body], sides.com[body]))


@wp.kernel
def start_centres(state: StateArrays, motion: Motion, sides: Sides, remembers: bool, centres: Centres):
    """Writes the centres of mass of bodies at the start of a step.

    Where the step goes on from the last one, they are where that ended, as vertices are that the response cannot move.
    """
    body = wp.tid()
    goes_on = remembers and continues(motion, sides.body_world[body]) and wp.isfinite(centres.end[body])
    centres.start[body] = wp.where(goes_on, centres.end[body], _centre_of(state, sides, body))


@wp.kernel
def end_centres(state: StateArrays, sides: Sides, mask: wp.array[wp.bool], centres: Centres):
    """Writes the centres of mass of bodies at the end of a step, as predicted; not where worlds take no part in it."""
    body = wp.tid()
    if mask and not takes_part(mask, sides.body_world[body]):
        return
    centres.end[body] = _centre_of(state, sides, body)


@wp.func
def _body_of_side(sides: Sides, corners: wp.vec4i, plane: int, side: int) -> int:
    """Returns the body of one side of a contact, -1 for none."""
    if side == 1 and plane >= 0:
        return sides.plane_body[plane]
    return body_of_vertex(sides, corners[3 * side])


@wp.func
def torque_on(
    step: Step,
    sides: Sides,
    centres: Centres,
    share: wp.float64,
    corners: wp.vec4i,
    weights: wp.vec4d,
    plane: int,
    side: int,
    impulse: wp.vec3d,
) -> wp.vec3d:
    """Returns the torque of the impulse of a contact on the body of one of its sides; ``share`` of the step is over.

    The impulse is that on the first side. A plane, -1 for none, is a side without vertices, and is touched at the
    vertex.
    """
    x = step.vertices.x1
    body = _body_of_side(sides, corners, plane, side)
    if body < 0:
        return wp.vec3d()
    centre = (ONE - share) * centres.start[body] + share * centres.end[body]
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
def _time_at_plane(motion: Motion, planes: MovingPlanes, i: int, vertex: int) -> wp.float64:
    """Returns when a vertex enters the solid of a plane, in [0, 1]."""
    before, _error = signed_distance(planes.start[i], motion.x0[vertex])
    after, _error_after = signed_distance(planes.end[i], motion.x1[vertex])
    return time_of_entry(before, after)


@wp.func
def _responds(step: Step, i: int) -> bool:
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
def _keep_impulse(
    step: Step,
    planes: MovingPlanes,
    sides: Sides,
    centres: Centres,
    substeps: int,
    remaining: wp.array[int],
    of_constraints: KeptImpulses,
    of_planes: KeptImpulses,
    unpaired: Unpaired,
    lost: wp.array[int],
    i: int,
):
    constraints, motion = step.constraints, step.motion
    impulse = constraints.velocity_multiplier[i]
    if wp.length_sq(impulse) == ZERO:
        return
    done = ZERO
    if remaining:
        done = wp.float64(substeps - remaining[0])
    share = (done + ONE) / wp.float64(substeps)
    kept = of_constraints
    place = i
    toi = constraints.toi[i]
    corners, weights, normal = constraints.vertices[i], constraints.weights[i], constraints.normal[i]
    plane = wp.where(constraints.kind[i] == ContactKind.PLANE, constraints.plane[i], -1)
    if not _responds(step, i):
        for j in range(4):
            if corners[j] < sides.particle_count and weights[j] != ZERO:
                add_impulse(unpaired.idle_of_particles, corners[j], 0, weights[j] * impulse, lost)
        for side in range(2):
            body = _body_of_side(sides, corners, plane, side)
            if can_move(motion, body):
                torque = torque_on(step, sides, centres, share, corners, weights, plane, side, impulse)
                add_impulse(unpaired.idle_of_bodies, body, 0, wp.where(side == 0, impulse, -impulse), lost)
                add_impulse(unpaired.idle_of_bodies, body, 3, torque, lost)
        return
    if plane >= 0:
        toi = (done + _time_at_plane(motion, planes, plane, corners[0])) / wp.float64(substeps)
        if remaining:
            kept = of_planes
            place = corners[0] * sides.planes_per_world + sides.plane_slot[plane]
    if wp.length_sq(kept.impulse[place]) == ZERO:
        kept.velocity[place] = to_single(relative(weights, corners, motion.velocity))
        kept.toi[place] = toi
    kept.impulse[place] += impulse
    kept.along[place] += wp.dot(impulse, normal)
    kept.normal[place] = normal
    if kept.torque:
        for side in range(2):
            torque = torque_on(step, sides, centres, share, corners, weights, plane, side, impulse)
            kept.torque[place, side] = kept.torque[place, side] + torque


@wp.kernel
def keep_impulses(
    # in
    step: Step,
    planes: MovingPlanes,
    sides: Sides,
    centres: Centres,
    substeps: int,
    remaining: wp.array[int],
    # in and out
    of_constraints: KeptImpulses,
    of_planes: KeptImpulses,
    unpaired: Unpaired,
    lost: wp.array[int],
    threads: int,
):
    """Adds the impulses of constraints in a substep, or without ``remaining``, after the step, to those that are kept.

    Constraints of planes are made anew in each substep, one for a vertex and a plane: theirs are kept by these.
    """
    count = constraint_count(step)
    if wp.tid() == 0:
        of_constraints.count[0] = wp.max(of_constraints.count[0], count)
    for i in range(wp.tid(), count, threads):
        _keep_impulse(step, planes, sides, centres, substeps, remaining, of_constraints, of_planes, unpaired, lost, i)


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


@wp.kernel
def restart_worlds(
    # in
    step: Step,
    restarts: wp.array[int],
    sides: Sides,
    # out
    of_constraints: KeptImpulses,
    of_planes: KeptImpulses,
    unpaired: Unpaired,
    threads: int,
):
    """Clears what is kept of worlds that repeat their substeps."""
    motion, constraints = step.motion, step.constraints
    for i in range(wp.tid(), wp.min(constraint_count(step), of_constraints.impulse.shape[0]), threads):
        if restarts[motion.world[constraints.vertices[i][0]]] == 1:
            clear_kept(of_constraints, i)
    for slot in range(wp.tid(), of_planes.impulse.shape[0], threads):
        if restarts[motion.world[slot / sides.planes_per_world]] == 1:
            clear_kept(of_planes, slot)
    for particle in range(wp.tid(), unpaired.of_particles.shape[0], threads):
        if restarts[motion.world[particle]] == 1:
            unpaired.of_particles[particle] = wp.vec3d()
    for body in range(wp.tid(), unpaired.of_bodies.shape[0], threads):
        if restarts[wp.max(sides.body_world[body], 0)] == 1:
            unpaired.of_bodies[body, 0] = wp.vec3d()
            unpaired.of_bodies[body, 1] = wp.vec3d()
