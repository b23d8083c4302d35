"""Kernels of the contact layer."""

import warp as wp

from ...kernels.pipeline.queues import has_overflowed
from ..adjoint.structs import StateGradients
from ..contacts.constraints import pair_friction
from ..contacts.queue import PairQueue, has_pair, vertices_of
from ..state.fixed_sum import add_to_sum, from_units, sum_of, sums_of, to_units, with_delta
from ..state.motion import StateArrays
from ..state.poses import turned_pose
from ..state.structs import Motion, can_move
from ..state.vectors import ZERO, to_double, to_single
from .pushes import (
    Layer,
    arm_of,
    body_of_side,
    change_by_plane,
    contact_of_pair,
    contact_with_plane,
    gains,
    position_between,
    push_of,
    resistances_of_body,
    share_of,
)


@wp.kernel(enable_backward=False)
def place_vertices_between(layer: Layer, y: wp.array[wp.vec3]):
    """Writes the positions at which contacts act, to which the detection is near enough in single precision."""
    vertex = wp.tid()
    _kappa, theta = gains(layer.restitution[0])
    y[vertex] = to_single(position_between(layer.motion, vertex, theta))


@wp.kernel
def sum_shares(layer: Layer, queue: PairQueue, sums: wp.array[wp.int64], differentiable: wp.array[wp.float64]):
    """Adds the shares of contacts to the sums of their vertices, or to ``differentiable`` ones instead."""
    i = wp.tid()
    if not has_pair(queue, i):
        return
    corners = vertices_of(queue, i)
    weights, _normal, depth = contact_of_pair(layer, queue.kind, corners)
    if depth <= ZERO:
        return
    for j in range(4):
        share = wp.abs(weights[j]) * share_of(layer, depth)
        if differentiable:
            wp.atomic_add(differentiable, corners[j], share)
        else:
            wp.atomic_add(sums, corners[j], to_units(share))
    if layer.motion.bodies.of_vertex:
        for side in range(2):
            body = body_of_side(layer.motion, corners, side)
            if body >= 0:
                place = layer.motion.x0.shape[0] + body
                of_body = share_of(layer, depth)
                if differentiable:
                    wp.atomic_add(differentiable, place, of_body)
                else:
                    wp.atomic_add(sums, place, to_units(of_body))


@wp.kernel(enable_backward=False)
def find_depths(layer: Layer, queue: PairQueue, depths: wp.array[wp.float64]):
    """Finds the largest depth of a contact of each vertex [m]."""
    i = wp.tid()
    if not has_pair(queue, i):
        return
    corners = vertices_of(queue, i)
    _weights, _normal, depth = contact_of_pair(layer, queue.kind, corners)
    for j in range(4):
        wp.atomic_max(depths, corners[j], depth)


@wp.kernel(enable_backward=False)
def find_depths_at_planes(layer: Layer, depths: wp.array[wp.float64]):
    """Increases the largest depth of each particle to that of its contacts with planes [m]."""
    vertex = wp.tid()
    of_worlds, world = layer.planes.of_worlds, layer.motion.world[vertex]
    for place in range(of_worlds.shape[1]):
        if of_worlds[world, place] >= 0:
            _normal, depth = contact_with_plane(layer, of_worlds[world, place], vertex)
            depths[vertex] = wp.max(depths[vertex], depth)


@wp.kernel(enable_backward=False)
def finish_shares(
    layer: Layer,
    counts: wp.array[wp.int64],
    capacities: wp.array[wp.int64],
    # in and out
    sums: wp.array[wp.int64],
    layer_overflows: wp.array[wp.int64],
):
    """Adds the shares of contacts with planes, and writes the sums; zeros if pairs are missing: then nothing pushes."""
    vertex = wp.tid()  # or a body, whose contacts with planes are delegated to the inner solver
    share = from_units(sums[vertex])
    sums[vertex] = wp.int64(0)
    if vertex < layer.motion.x0.shape[0]:
        of_worlds, world = layer.planes.of_worlds, layer.motion.world[vertex]
        for place in range(of_worlds.shape[1]):
            if of_worlds[world, place] >= 0:
                _normal, depth = contact_with_plane(layer, of_worlds[world, place], vertex)
                share += share_of(layer, depth)
    if has_overflowed(counts, capacities):
        share = ZERO
        if vertex == 0:
            layer_overflows[0] += wp.int64(1)
    layer.shares[vertex] = share


@wp.kernel
def add_shares_of_planes(layer: Layer, sums: wp.array[wp.float64]):
    """Adds as :func:`finish_shares`, differentiably, with a thread for each vertex and plane."""
    vertex, plane = wp.tid()
    _normal, depth = contact_with_plane(layer, plane, vertex)
    wp.atomic_add(sums, vertex, share_of(layer, depth))


@wp.kernel
def sum_pushes(
    layer: Layer,
    queue: PairQueue,
    # out, sums of vertices and then of bodies
    sums: wp.array2d[wp.int64],
    differentiable: wp.array[wp.vec3],
    differentiable_of_bodies: wp.array[wp.spatial_vectord],
):
    """Adds what contacts move vertices and bodies by to the sums of these, or to ``differentiable`` ones instead."""
    i = wp.tid()
    if not has_pair(queue, i):
        return
    motion = layer.motion
    corners = vertices_of(queue, i)
    weights, normal, depth = contact_of_pair(layer, queue.kind, corners)
    resistance = ZERO
    for j in range(4):
        vertex = corners[j]
        resistance += wp.abs(weights[j]) * wp.float64(motion.inverse_mass[vertex]) * layer.shares[vertex]
    across_resistance = resistance
    if motion.bodies.of_vertex and depth > ZERO:
        for side in range(2):
            body = body_of_side(motion, corners, side)
            if body >= 0:
                along, across = resistances_of_body(layer, body, arm_of(layer, corners, weights, body), normal)
                resistance += along
                across_resistance += across
    if depth <= ZERO or resistance <= ZERO:
        return
    path = wp.vec3d()
    for j in range(4):
        vertex = corners[j]
        path += weights[j] * (to_double(motion.x1[vertex]) - to_double(motion.x0[vertex]))
    friction = pair_friction(motion, corners)
    push = push_of(layer, normal, depth, path, resistance, across_resistance, friction)
    for j in range(4):
        change = weights[j] * wp.float64(motion.inverse_mass[corners[j]]) * push
        if differentiable:
            wp.atomic_add(differentiable, corners[j], to_single(change))
        else:
            add_to_sum(sums, corners[j], 0, change)
    if motion.bodies.of_vertex:
        for side in range(2):
            pushed = body_of_side(motion, corners, side)
            if pushed >= 0:
                arm = arm_of(layer, corners, weights, pushed)
                weight = wp.float64(1.0 - 2.0 * float(side))  # the sum of those of an element
                shift = weight * wp.float64(motion.bodies.inverse_mass[pushed]) * push
                turn = layer.bodies.inverse_inertia[pushed] * wp.cross(arm, push)
                if differentiable:
                    of_body = wp.spatial_vectord(shift[0], shift[1], shift[2], turn[0], turn[1], turn[2])
                    wp.atomic_add(differentiable_of_bodies, pushed, of_body)
                else:
                    add_to_sum(sums, motion.x0.shape[0] + pushed, 0, shift)
                    add_to_sum(sums, motion.x0.shape[0] + pushed, 3, turn)


@wp.kernel(enable_backward=False)
def move_particles(layer: Layer, sums: wp.array2d[wp.int64], end: StateArrays):
    """Moves each particle by the pushes of its contacts, in the motion and in the state; others keep every bit."""
    motion, vertex = layer.motion, wp.tid()
    of_worlds, world = layer.planes.of_worlds, motion.world[vertex]
    for place in range(of_worlds.shape[1]):
        if of_worlds[world, place] >= 0:
            add_to_sum(sums, vertex, 0, change_by_plane(layer, of_worlds[world, place], vertex))
    change = sum_of(sums, vertex, 0)
    if wp.length_sq(change) > ZERO and motion.is_not_finite[vertex] == 0:
        motion.x1[vertex] = with_delta(motion.x1[vertex], sums, vertex)
        motion.velocity[vertex] += to_single(change / wp.float64(layer.dt))
        end.particle_q[vertex] = motion.x1[vertex]
        end.particle_qd[vertex] = motion.velocity[vertex]
    for axis in range(3):
        sums[vertex, axis] = wp.int64(0)


@wp.kernel(enable_backward=False)
def sum_body_pushes(layer: Layer, sums: wp.array2d[wp.int64]):
    """Writes what the pushes of its contacts change each body by."""
    body = wp.tid()
    row = layer.motion.x0.shape[0] + body
    shift, turn = sums_of(sums, row)
    layer.changes[body] = wp.spatial_vectord(shift[0], shift[1], shift[2], turn[0], turn[1], turn[2])
    for axis in range(6):
        sums[row, axis] = wp.int64(0)


@wp.kernel
def push_poses(layer: Layer, poses: wp.array[wp.transform]):
    """Computes the poses of bodies by the pushes of their contacts; others keep every bit."""
    body, bodies = wp.tid(), layer.motion.bodies
    change = layer.changes[body]
    pose = bodies.end[body]
    if wp.length_sq(change) > ZERO and can_move(layer.motion, body):
        pose = turned_pose(bodies, body, pose, wp.spatial_top(change), wp.spatial_bottom(change))
    poses[body] = pose


@wp.kernel(enable_backward=False)
def move_bodies(layer: Layer, poses: wp.array[wp.transform], end: StateArrays, body_q_prev: wp.array[wp.transform]):
    """Moves each body that was pushed in the state; VBD takes its next velocity from ``body_q_prev``, if it has it."""
    body = wp.tid()
    change = layer.changes[body]
    if wp.length_sq(change) > ZERO and can_move(layer.motion, body):
        end.body_q[body] = poses[body]
        velocity = end.body_qd[body]
        for i in range(6):
            velocity[i] = velocity[i] + float(change[i] / wp.float64(layer.dt))
        end.body_qd[body] = velocity
        if body_q_prev:
            body_q_prev[body] = poses[body]


@wp.kernel
def add_pushes_of_planes(layer: Layer, changes: wp.array[wp.vec3]):
    """Adds as :func:`move_particles`, differentiably, with a thread for each particle and plane."""
    vertex, plane = wp.tid()
    wp.atomic_add(changes, vertex, to_single(change_by_plane(layer, plane, vertex)))


@wp.kernel(enable_backward=False)
def begin_backward(
    layer: Layer, particle_q: wp.array[wp.vec3], particle_qd: wp.array[wp.vec3], changes: wp.array[wp.vec3]
):
    """Writes the gradient with respect to what contacts move particles by."""
    particle = wp.tid()
    if layer.motion.is_not_finite[particle] == 0:
        changes[particle] = particle_q[particle] + particle_qd[particle] / layer.dt


@wp.kernel(enable_backward=False)
def begin_body_backward(layer: Layer, body_qd: wp.array[wp.spatial_vector], changes: wp.array[wp.spatial_vectord]):
    """Adds the gradient of the velocities of bodies with respect to what contacts change the bodies by."""
    body = wp.tid()
    if can_move(layer.motion, body):
        for i in range(6):
            added = wp.float64(body_qd[body][i]) / wp.float64(layer.dt)
            changes[body][i] = changes[body][i] + added


@wp.kernel(enable_backward=False)
def finish_body_backward(layer: Layer, of_motion: Motion, of_state: StateGradients, body_inv_mass: wp.array[float]):
    """Adds to the gradients of poses, and writes those of poses that pushes computed."""
    body = wp.tid()
    of_state.start_body_q[body] = of_state.start_body_q[body] + of_motion.bodies.start[body]
    end = of_motion.bodies.end[body]
    if not layer.changes:  # no body is pushed
        end = end + of_state.body_q[body]
    of_state.body_q[body] = end
    if body_inv_mass and can_move(layer.motion, body):
        body_inv_mass[body] = body_inv_mass[body] + of_motion.bodies.inverse_mass[body]


@wp.kernel(enable_backward=False)
def finish_backward(
    of_motion: Motion, start_q: wp.array[wp.vec3], particle_q: wp.array[wp.vec3], particle_inv_mass: wp.array[float]
):
    """Adds to the gradients of the inputs of the step."""
    particle = wp.tid()
    start_q[particle] += of_motion.x0[particle]
    particle_q[particle] += of_motion.x1[particle]
    if particle_inv_mass:
        particle_inv_mass[particle] += of_motion.inverse_mass[particle]
