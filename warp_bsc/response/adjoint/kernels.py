"""The kernels that an adjoint differentiates: each computes what a kernel of a step changes, by the same functions.

For launches over vertices and bodies see :mod:`.adjoint.restore`.
"""

import warp as wp

from ...kernels.closest import contact_weights, weights_across
from ..contacts.collect import distances_from_plane, offset_from
from ..contacts.constraints import (
    approach_of,
    feasible,
    friction_on_plane,
    has_pushed,
    kind_of_pair,
    pair_friction,
    sagitta,
)
from ..contacts.first_contact import truncated_path
from ..contacts.impacts import contact_at, contact_within_reach, impact_of, kept_distance, time_at_distance
from ..schedule import is_reversible, widened
from ..solve.angular_momentum import (
    Moments,
    acts,
    body_moments,
    body_turns,
    change_by_turn,
    is_held,
    moments,
    torque_of,
    turns,
)
from ..solve.bodies import body_change
from ..solve.sweeps import (
    initial_velocity_multiplier,
    position_multiplier_after,
    velocity_multiplier_after,
    with_momentum,
)
from ..state.planes import signed_distance, time_of_entry
from ..state.poses import pose_between, turned_pose, velocity_between, velocity_on_body
from ..state.record import NO_CONTACT, truncation_at
from ..state.structs import HELD, MASS, MOMENTS, Constraints, ContactKind, Pace, Step, can_move
from ..state.vectors import ONE, ZERO, corners_of, relative, to_double, to_single
from ..tuning import SHARE_OF_PATH
from .structs import Paths, Projection, RestoredStep, entry_of


@wp.func
def _add_change(step: Step, i: int, change: wp.vec3d, swept: Projection):
    """Adds what the change of a multiplier does to its vertices and bodies.

    :func:`.solve.sweeps.add_delta` and :func:`.solve.bodies.add_body_delta` do it in integers.
    """
    for j in range(4):
        vertex = step.constraints.vertices[i][j]
        share = step.constraints.weights[i][j] * wp.float64(step.motion.inverse_mass[vertex])
        wp.atomic_add(swept.vertex_change, vertex, to_single(share * change))
    if step.motion.bodies.of_vertex:
        for side in range(2):
            body, shift, turn = body_change(step, i, side, change, swept.x)
            if body >= 0:
                added = wp.spatial_vectord(shift[0], shift[1], shift[2], turn[0], turn[1], turn[2])
                wp.atomic_add(swept.body_change, body, added)


@wp.kernel
def change_multipliers(restored: RestoredStep, swept: Projection):
    """Computes what a sweep changes.

    See :func:`.solve.positions.project_positions` and :func:`.solve.velocities.project_velocities`.
    """
    step, record = restored.step, restored.record
    entry = entry_of(record, restored.cursor.current_sweep[0], wp.tid())
    if entry < 0:
        return
    i = record.constraint[entry]
    old = swept.multiplier[i]
    multiplier = old
    if swept.of_velocities:
        multiplier = velocity_multiplier_after(step, i)
    else:
        pushes_only = not is_reversible(restored.status, step.constraints.pace[i] != Pace.FAST)
        multiplier = position_multiplier_after(step, i, pushes_only)
    previous = step.constraints.previous_multiplier[i]
    change = with_momentum(multiplier, previous, record.momentum[entry]) - old
    swept.multiplier_change[i] = change
    swept.previous_change[i] = multiplier - previous
    _add_change(step, i, change, swept)


@wp.kernel
def initialize_multipliers(restored: RestoredStep, swept: Projection):
    """Computes initial velocity multipliers, see :func:`.solve.velocities.initialize_velocity_multipliers`."""
    i = wp.tid()
    step = restored.step
    if i < step.constraints.count[0] and has_pushed(step, i):
        first = initial_velocity_multiplier(step, i)
        swept.multiplier_change[i] = first
        swept.previous_change[i] = first
        _add_change(step, i, first, swept)


@wp.kernel
def add_torques(step: Step, totals: wp.array2d[wp.float64]):
    """Adds the torques of contacts to the totals of their worlds, see :func:`.solve.angular_momentum.add_torques`."""
    i = wp.tid()
    if i >= step.constraints.count[0] or not acts(step, i):
        return
    world = step.motion.world[step.constraints.vertices[i][0]]
    if is_held(step, i):
        totals[world, HELD] = ONE
    else:
        torque = torque_of(step, i)
        for axis in range(3):
            wp.atomic_add(totals, world, axis, torque[axis])


@wp.kernel
def add_moments(step: Step, totals: wp.array2d[wp.float64]):
    """Adds the moments of vertices and bodies, and the torques of bodies, to the totals of their worlds.

    See :func:`.solve.angular_momentum.add_moments` and :func:`.solve.angular_momentum.sum_body_moments`.
    """
    vertex = wp.tid()
    body = vertex - step.motion.x0.shape[0]
    if body < 0:
        if turns(step, vertex):
            added = moments(step, vertex)
            for i in range(MOMENTS):
                wp.atomic_add(totals, step.motion.world[vertex], MASS + i, added[i])
    elif body_turns(step, body):
        world = wp.max(step.motion.bodies.world[body], 0)
        torque, of_body = body_moments(step, body)
        for axis in range(3):
            wp.atomic_add(totals, world, axis, torque[axis])
        for i in range(MOMENTS):
            wp.atomic_add(totals, world, MASS + i, of_body[i])


@wp.func
def _torque_and_moments(totals: wp.array2d[wp.float64], world: int):
    """Returns the torque on a world and its moments."""
    torque = wp.vec3d(totals[world, 0], totals[world, 1], totals[world, 2])
    total = Moments()
    for i in range(MOMENTS):
        total[i] = totals[world, MASS + i]
    return torque, total


@wp.kernel
def turn_velocities(
    step: Step, totals: wp.array2d[wp.float64], changes: wp.array[wp.vec3], body_changes: wp.array[wp.spatial_vector]
):
    """Computes how the turn of each world changes the velocities of its vertices and bodies.

    See :func:`.solve.angular_momentum.turn_vertex` and :func:`.solve.angular_momentum.turn_bodies`.
    """
    vertex = wp.tid()
    body = vertex - step.motion.x0.shape[0]
    if body < 0:
        world = step.motion.world[vertex]
        if turns(step, vertex) and totals[world, HELD] == ZERO:
            torque, total = _torque_and_moments(totals, world)
            of_vertex, _turn = change_by_turn(torque, total, to_double(step.vertices.x1[vertex]))
            changes[vertex] = to_single(of_vertex)
    else:
        own = wp.max(step.motion.bodies.world[body], 0)
        if body_turns(step, body) and totals[own, HELD] == ZERO:
            own_torque, own_total = _torque_and_moments(totals, own)
            of_body, turn = change_by_turn(own_torque, own_total, step.vertices.bodies.centre[body])
            body_changes[body] = wp.spatial_vector(to_single(of_body), to_single(turn))


@wp.kernel
def make_constraints(restored: RestoredStep, found: Constraints):
    """Computes the constraints that a detection ``found``, from contacts and proximities; the cursor is ahead of it.

    See :func:`.contacts.collect.collect_contacts` and :func:`.contacts.proximities.collect_proximities`.
    """
    step, record, iteration = restored.step, restored.record, restored.cursor.iteration[0]
    motion, constraints = step.motion, step.constraints
    i = wp.tid()
    if iteration >= 0:
        i += record.constraint_offsets[iteration]
    if i >= record.constraint_offsets[iteration + 1]:
        return
    corners = found.vertices[i]
    kind = found.kind[i]
    weight = found.weights[i]
    normal = found.normal[i]
    separation = found.separation[i]
    friction = float(0.0)
    if kind == ContactKind.PLANE:
        plane = restored.planes.end[found.plane[i]]
        normal = wp.vec3d(plane[0], plane[1], plane[2])
        separation = offset_from(step, restored.planes, found.plane[i], corners[0], restored.status)
        if motion.distances.radius:
            of_plane, _reach = distances_from_plane(motion, restored.planes, found.plane[i], corners[0])
            separation += wp.max(of_plane, ZERO)
        friction = friction_on_plane(motion, restored.planes, found.plane[i], corners[0])
    else:
        friction = pair_friction(motion, corners)
    kept, reach = kept_distance(motion, corners, kind)
    if kind < ContactKind.PLANE and motion.distances.radius:
        at_distance, towards = contact_within_reach(step, corners, kind, weight, normal, kept, iteration <= 0, reach)
        weight = at_distance
        normal = towards
        separation = widened(step.separation, restored.status)
    elif kind < ContactKind.PLANE:
        coordinates = wp.vec3d(-weight[1], -weight[2], -weight[3])
        if kind == ContactKind.EDGE_EDGE:
            coordinates = wp.vec3d(weight[1], -weight[3], ZERO)
        within_tolerance = found.within_tolerance[i]
        impact = impact_of(step, corners, kind, within_tolerance, found.toi[i], coordinates, normal)
        weight = contact_weights(kind_of_pair(kind), impact.coordinates)
        normal = impact.normal
        separation = widened(step.separation, restored.status)
    if kind < ContactKind.PLANE:
        if found.pace[i] == Pace.SLOW:
            before = wp.dot(normal, relative(weight, corners, motion.x0)) - kept
            separation = feasible(step, corners, separation, before)
        separation += sagitta(step, corners) + kept
    elif kind > ContactKind.PLANE:
        a, b, c, d = corners_of(motion.x0, corners)
        across, direction, distance = weights_across(kind_of_pair(kind), a, b, c, d)
        weight = across
        normal = direction
        separation = kept + feasible(step, corners, step.separation, distance - kept)
    constraints.weights[i] = weight
    constraints.normal[i] = normal
    constraints.separation[i] = separation
    constraints.friction[i] = friction
    constraints.approach[i] = approach_of(step, corners, weight, normal, separation)


@wp.kernel
def find_truncation_times(restored: RestoredStep, times: wp.array[wp.float64]):
    """Computes the times of the contacts that an iteration truncated paths before."""
    step, planes, record = restored.step, restored.planes, restored.record
    entry = truncation_at(record, restored.cursor.iteration[0], wp.tid())
    if entry < 0 or record.kind[entry] == NO_CONTACT:
        return
    corners = record.contact[entry]
    if record.kind[entry] == ContactKind.PLANE:
        vertex = corners[0]
        plane = corners[1]
        before, _error = signed_distance(planes.start[plane], step.motion.x0[vertex])
        after, _error_after = signed_distance(planes.end[plane], step.vertices.x1[vertex])
        lowest, _reach = distances_from_plane(step.motion, planes, plane, vertex)
        times[entry] = time_of_entry(before - lowest, after - lowest)
    else:
        kind, within_tolerance, toi = record.kind[entry], record.within_tolerance[entry], record.toi[entry]
        if step.motion.distances.radius:
            weights, direction = contact_at(step, corners, record.kind[entry], toi)
            kept, _reach_of_pair = kept_distance(step.motion, corners, record.kind[entry])
            times[entry] = time_at_distance(step, corners, weights, direction, kept)
            return
        coordinates, normal = record.coordinates[entry], record.normal[entry]
        impact = impact_of(step, corners, kind, within_tolerance, toi, coordinates, normal)
        times[entry] = impact.toi


@wp.kernel
def truncate_paths(restored: RestoredStep, times: wp.array[wp.float64], paths: Paths):
    """Computes the ends and velocities of truncated paths of vertices and bodies.

    See :func:`.solve.division.truncate_vertices` and :func:`.solve.division.cut_bodies`. Frozen paths have time 0.
    """
    motion, vertices, record = restored.step.motion, restored.step.vertices, restored.record
    entry = truncation_at(record, restored.cursor.iteration[0], wp.tid())
    if entry < 0:
        return
    vertex = record.vertex[entry]
    body = record.body[entry]
    if vertex >= 0:
        x0 = to_double(motion.x0[vertex])
        path = truncated_path(x0, to_double(vertices.x1[vertex]), times[entry])
        paths.end[entry] = to_single(x0 + path)
        paths.velocity[entry] = to_single(path / restored.step.dt)
    elif body >= 0:
        start = motion.bodies.start[body]
        if record.kind[entry] == NO_CONTACT:
            paths.pose[entry] = start
            paths.twist[entry] = wp.spatial_vector()
        else:
            share = SHARE_OF_PATH * times[entry]
            end = pose_between(motion.bodies, body, start, vertices.bodies.pose[body], share)
            paths.pose[entry] = end
            paths.twist[entry] = velocity_between(motion.bodies, body, start, end, restored.step.dt)


@wp.func
def _pose_by(step: Step, sums: wp.array[wp.spatial_vectord], body: int) -> wp.transform:
    """Returns the pose of a body by what constraints did to it; without any it keeps every bit."""
    change = sums[body]
    motion = step.motion
    pose = motion.bodies.end[body]
    if can_move(motion, body) and step.vertices.bodies.outcome[body] != 0:
        pose = turned_pose(motion.bodies, body, pose, wp.spatial_top(change), wp.spatial_bottom(change))
    return pose


@wp.kernel
def project_poses(step: Step, sums: wp.array[wp.spatial_vectord], poses: wp.array[wp.transform]):
    """Computes the poses of bodies by what constraints did to them, see :func:`.solve.bodies.move_bodies`."""
    body = wp.tid()
    poses[body] = _pose_by(step, sums, body)


@wp.kernel
def project_vertices(step: Step, sums: wp.array[wp.spatial_vectord], positions: wp.array[wp.vec3]):
    """Computes the positions of vertices in these poses, see :func:`.solve.bodies.place_vertices`."""
    motion = step.motion
    vertex = motion.bodies.particle_count + wp.tid()
    body = motion.bodies.of_vertex[vertex]
    if can_move(motion, body):
        pose = _pose_by(step, sums, body)
        positions[vertex] = wp.transform_point(pose, motion.bodies.position[wp.tid()])


@wp.kernel
def place_vertices(step: Step, positions: wp.array[wp.vec3]):
    """Computes the positions of vertices from poses, see :func:`.solve.bodies.place_vertices`."""
    motion = step.motion
    vertex = motion.bodies.particle_count + wp.tid()
    body = motion.bodies.of_vertex[vertex]
    if can_move(motion, body):
        positions[vertex] = wp.transform_point(step.vertices.bodies.pose[body], motion.bodies.position[wp.tid()])


@wp.kernel
def vertex_velocities(step: Step, velocities: wp.array[wp.vec3]):
    """Computes the velocities of vertices, see :func:`.solve.bodies.set_vertex_velocities`."""
    motion, vertices = step.motion, step.vertices
    vertex = motion.bodies.particle_count + wp.tid()
    body = motion.bodies.of_vertex[vertex]
    if can_move(motion, body):
        arm = to_double(vertices.x1[vertex]) - vertices.bodies.centre[body]
        velocities[vertex] = velocity_on_body(vertices.bodies.velocity[body], arm)
