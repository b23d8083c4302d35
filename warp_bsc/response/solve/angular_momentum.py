"""Angular momentum: kernels for a rigid turn of all that collided, which removes what position multipliers added.

Only in worlds in which everything that collided is free: elsewhere angular momentum is not conserved.
"""

from typing import Any

import warp as wp

from ..state.fixed_sum import add_units, with_delta
from ..state.poses import centre_of, in_world
from ..state.structs import (
    DIVIDED,
    HELD,
    MASS,
    MOMENTS,
    Incidence,
    Step,
    body_of,
    constraint_at,
    constraint_count,
    has_final_velocity,
)
from ..state.vectors import HALF, ONE, ZERO, relative, to_double, to_single
from ..tuning import MAX_TURN

wp.set_module_options({"enable_backward": False})

Moments = wp.types.vector(length=11, dtype=wp.float64)
_Torque = wp.types.vector(length=3, dtype=wp.int64)
_Sums = wp.types.vector(length=14, dtype=wp.int64)
_UNITS = wp.constant(wp.float64(2.0**32))
"""Units in one kg, m and s; sums are of integers in these units, so that they are the same in any order."""


@wp.func
def _units(x: wp.float64) -> wp.int64:
    return wp.int64(wp.rint(_UNITS * x))


@wp.func
def _add(sums: wp.array2d[wp.int64], world: int, added: Any):
    """Adds what a thread has summed to the sums of a world."""
    for i in range(len(added)):
        if added[i] != wp.int64(0):
            add_units(sums[world], i, added[i])


@wp.func
def turns(step: Step, vertex: int) -> bool:
    """Returns whether a vertex collided, and is free to turn by itself."""
    outcome = step.vertices.outcome[vertex]
    return step.motion.inverse_mass[vertex] > 0.0 and outcome != 0 and not has_final_velocity(outcome)


@wp.func
def body_turns(step: Step, body: int) -> bool:
    """Returns whether a body collided, and is free to turn."""
    outcome = step.vertices.bodies.outcome[body]
    return step.motion.bodies.inverse_mass[body] > 0.0 and outcome != 0 and not has_final_velocity(outcome)


@wp.func
def torque_of(step: Step, i: int) -> wp.vec3d:
    """Returns the change of angular momentum by a contact between free vertices and bodies [kg m^2/s].

    Position changes across the motion change it, and so do impulses at points that slid apart since the contact. For
    the position changes of bodies, see :func:`sum_body_moments`.
    """
    motion, vertices, constraints = step.motion, step.vertices, step.constraints
    weights = constraints.weights[i]
    corners = constraints.vertices[i]
    moving = wp.vec4d(weights)
    for j in range(4):
        if body_of(motion, corners[j]) >= 0:
            moving[j] = ZERO
    of_positions = wp.cross(constraints.position_multiplier[i], relative(moving, corners, motion.velocity))
    return of_positions + wp.cross(relative(weights, corners, vertices.x1), constraints.velocity_multiplier[i])


@wp.func
def acts(step: Step, i: int) -> bool:
    """Returns whether a constraint moved anything."""
    of_velocity = wp.length_sq(step.constraints.velocity_multiplier[i])
    return wp.length_sq(step.constraints.position_multiplier[i]) + of_velocity > ZERO


@wp.func
def is_held(step: Step, i: int) -> bool:
    """Returns whether a contact is with something that is not free."""
    corners = step.constraints.vertices[i]
    held = corners[0] == corners[1]  # on a plane
    for j in range(4):
        free = turns(step, corners[j])
        body = body_of(step.motion, corners[j])
        if body >= 0:
            free = body_turns(step, body)
        held = held or (step.constraints.weights[i][j] != ZERO and not free)
    return held


@wp.func
def add_torques(step: Step, begin: int, end: int, threads: int, sums: wp.array2d[wp.int64]):
    """Sums the changes of angular momentum by contacts between free bodies, see :func:`torque_of`.

    For one contact they cancel; for many at once, which share vertices, they need not. A thread takes every
    ``threads``-th place from ``begin`` to ``end``, and sums several contacts before it adds to the sums of their world,
    which all threads share.
    """
    world = int(0)
    added = _Torque()
    for place in range(begin, end, threads):
        i = constraint_at(step, place)
        own = step.motion.world[step.constraints.vertices[i][0]]
        if own != world:
            _add(sums, world, added)
            added = _Torque()
            world = own
        if sums[world, HELD] == wp.int64(0) and acts(step, i):
            if is_held(step, i):
                sums[world, HELD] = wp.int64(1)
            else:
                torque = torque_of(step, i)
                for axis in range(3):
                    added[axis] += _units(torque[axis])
    _add(sums, world, added)


@wp.kernel
def sum_torques(step: Step, threads: int, sums: wp.array2d[wp.int64]):
    """Launches :func:`add_torques`."""
    add_torques(step, wp.tid(), constraint_count(step), threads, sums)


@wp.func
def _moments(mass: wp.float64, x: wp.vec3d, half: wp.float64, inertia: wp.mat33d, square: wp.float64) -> Moments:
    """Returns the moments of a mass with its centre at ``x``: second moments about the centre are half - inertia."""
    return Moments(
        mass,
        mass * x[0],
        mass * x[1],
        mass * x[2],
        mass * x[0] * x[0] + half - inertia[0, 0],
        mass * x[1] * x[1] + half - inertia[1, 1],
        mass * x[2] * x[2] + half - inertia[2, 2],
        mass * x[1] * x[2] - inertia[1, 2],
        mass * x[2] * x[0] - inertia[2, 0],
        mass * x[0] * x[1] - inertia[0, 1],
        square,
    )


@wp.func
def moments(step: Step, vertex: int) -> Moments:
    """Returns what a vertex adds to the sums of its world, from :data:`MASS` on."""
    motion, vertices = step.motion, step.vertices
    mass = ONE / wp.float64(motion.inverse_mass[vertex])
    change = to_double(vertices.velocity[vertex]) - to_double(motion.velocity[vertex])
    return _moments(mass, to_double(vertices.x1[vertex]), ZERO, wp.mat33d(), mass * wp.dot(change, change))


@wp.func
def add_moments(step: Step, particles: Incidence, begin: int, end: int, threads: int, sums: wp.array2d[wp.int64]):
    """Sums the moments of the vertices that collided, and the torques of those that were divided.

    A thread takes particles as contacts in :func:`add_torques`.
    """
    motion, vertices = step.motion, step.vertices
    world = int(0)
    added = _Sums()
    for place in range(begin, end, threads):
        vertex = int(particles.items[place])
        own = motion.world[vertex]
        if own != world:
            _add(sums, world, added)
            added = _Sums()
            world = own
        if turns(step, vertex) and sums[world, HELD] == wp.int64(0):
            moment = moments(step, vertex)
            for i in range(MOMENTS):
                added[MASS + i] += _units(moment[i])
            if vertices.outcome[vertex] & DIVIDED != 0:
                projected = with_delta(motion.x1[vertex], vertices.particle_delta_x, vertex)
                moved = to_double(vertices.x1[vertex]) - to_double(projected)
                torque = moment[0] * wp.cross(moved, to_double(motion.velocity[vertex]))
                for axis in range(3):
                    added[axis] += _units(torque[axis])
    _add(sums, world, added)


@wp.kernel
def sum_moments(step: Step, particles: Incidence, threads: int, sums: wp.array2d[wp.int64]):
    """Launches :func:`add_moments`."""
    add_moments(step, particles, wp.tid(), particles.items.shape[0], threads, sums)


@wp.func
def body_moments(step: Step, body: int):
    """Returns the torque by the change of the pose of a body, and what the body adds to the moments of its world."""
    bodies, moved = step.motion.bodies, step.vertices.bodies
    mass = wp.float64(bodies.mass[body])
    x = moved.centre[body]
    inertia = in_world(bodies.inertia[body], moved.pose[body])
    predicted = bodies.velocity[body]
    linear = to_double(wp.spatial_top(predicted))
    angular = to_double(wp.spatial_bottom(predicted))
    change = to_double(wp.spatial_top(moved.velocity[body])) - linear
    turn = to_double(wp.spatial_bottom(moved.velocity[body])) - angular
    torque = mass * wp.cross(x - centre_of(bodies, body, bodies.end[body]), linear)
    torque += (inertia - in_world(bodies.inertia[body], bodies.end[body])) * angular
    half = HALF * wp.trace(inertia)
    square = mass * wp.length_sq(change) + wp.dot(turn, inertia * turn)
    return torque, _moments(mass, x, half, inertia, square)


@wp.kernel
def sum_body_moments(step: Step, sums: wp.array2d[wp.int64]):
    """Sums the moments of the bodies that collided, and the torques by changes of their poses."""
    body = wp.tid()
    world = wp.max(step.motion.bodies.world[body], 0)
    if not body_turns(step, body) or sums[world, HELD] != wp.int64(0):
        return
    torque, total = body_moments(step, body)
    added = _Sums()
    for axis in range(3):
        added[axis] = _units(torque[axis])
    for i in range(MOMENTS):
        added[MASS + i] = _units(total[i])
    _add(sums, world, added)


@wp.func
def _turn_of(torque: wp.vec3d, total: Moments):
    """Returns the turn of a world that removes a torque [rad/s], and the point that it is about."""
    square = total[10]
    if wp.dot(torque, torque) == ZERO or square <= ZERO:
        return wp.vec3d(), wp.vec3d()
    mass = total[0]
    centre = wp.vec3d(total[1], total[2], total[3]) / mass
    squares = wp.vec3d(total[4], total[5], total[6]) - mass * wp.cw_mul(centre, centre)
    products = wp.vec3d(
        total[7] - mass * centre[1] * centre[2],
        total[8] - mass * centre[2] * centre[0],
        total[9] - mass * centre[0] * centre[1],
    )
    inertia = wp.matrix_from_rows(
        wp.vec3d(squares[1] + squares[2], -products[2], -products[1]),
        wp.vec3d(-products[2], squares[0] + squares[2], -products[0]),
        wp.vec3d(-products[1], -products[0], squares[0] + squares[1]),
    )
    if wp.determinant(inertia) <= ZERO:
        return wp.vec3d(), wp.vec3d()
    turn = -wp.inverse(inertia) * torque
    most = MAX_TURN * wp.sqrt(square / wp.max(wp.dot(turn, inertia * turn), wp.float64(1e-300)))
    return wp.min(most, ONE) * turn, centre


@wp.func
def change_by_turn(torque: wp.vec3d, total: Moments, x: wp.vec3d):
    """Returns the change of velocity at ``x`` by the turn of a world that removes a torque [m/s], and that turn."""
    turn, centre = _turn_of(torque, total)
    return wp.cross(turn, x - centre), turn


@wp.func
def _totals(sums: wp.array2d[wp.int64], world: int):
    """Returns the torque on a world and its moments."""
    torque = wp.vec3d()
    for axis in range(3):
        torque[axis] = wp.float64(sums[world, axis]) / _UNITS
    total = Moments()
    for i in range(MOMENTS):
        total[i] = wp.float64(sums[world, MASS + i]) / _UNITS
    return torque, total


@wp.func
def turn_vertex(step: Step, sums: wp.array2d[wp.int64], vertex: int):
    """Turns a vertex with all that collided in its world, which removes the torque that contacts added."""
    world = step.motion.world[vertex]
    if not turns(step, vertex) or sums[world, HELD] != wp.int64(0):
        return
    torque, total = _totals(sums, world)
    change, _turn = change_by_turn(torque, total, to_double(step.vertices.x1[vertex]))
    step.vertices.velocity[vertex] = to_single(to_double(step.vertices.velocity[vertex]) + change)


@wp.kernel
def turn_vertices(step: Step, sums: wp.array2d[wp.int64]):
    """Launches :func:`turn_vertex`."""
    turn_vertex(step, sums, wp.tid())


@wp.kernel
def turn_bodies(step: Step, sums: wp.array2d[wp.int64]):
    """Turns the bodies that collided as :func:`turn_vertex` does the vertices of their world."""
    body = wp.tid()
    world = wp.max(step.motion.bodies.world[body], 0)
    if not body_turns(step, body) or sums[world, HELD] != wp.int64(0):
        return
    torque, total = _totals(sums, world)
    change, turn = change_by_turn(torque, total, step.vertices.bodies.centre[body])
    velocity = step.vertices.bodies.velocity[body]
    linear = to_double(wp.spatial_top(velocity)) + change
    angular = to_double(wp.spatial_bottom(velocity)) + turn
    step.vertices.bodies.velocity[body] = wp.spatial_vector(to_single(linear), to_single(angular))
