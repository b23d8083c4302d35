"""Angular momentum: a rigid turn of all vertices that collided removes what the position multipliers added to it.

Only in worlds in which everything that collided is free: elsewhere angular momentum is not conserved.
"""

import warp as wp

from .buffers import DIVIDED, Constraints, Motion, Vertices, has_final_velocity
from .constraints import relative, to_double, to_single
from .projection import with_delta

__all__ = [
    "HELD",
    "MASS",
    "MOMENTS",
    "SUMS",
    "Moments",
    "acts",
    "change_by_turn",
    "is_held",
    "moments",
    "sum_moments",
    "sum_torques",
    "torque_of",
    "turn_vertices",
    "turns",
]

SUMS, MOMENTS, MASS, HELD = (wp.constant(i) for i in (15, 11, 3, 14))
"""Columns of the sums of a world: their number; the number of moments, which are mass, mass by position, its six second
moments, and mass by the squared change of velocity; where they begin, behind the torque; and the column that is not 0
if a contact is with something that is not free."""
Moments = wp.types.vector(length=11, dtype=wp.float64)

_UNITS = wp.constant(wp.float64(2.0**32))
"""Units in one kg, m and s; sums are of integers in these units, so that they are the same in any order."""
_LIMIT = wp.constant(wp.float64(0.1))
"""Largest turn as a share of the velocity changes by contacts, root mean square."""
_ZERO = wp.constant(wp.float64(0.0))
_ONE = wp.constant(wp.float64(1.0))

_KERNEL = {"enable_backward": False}


@wp.func
def _add(sums: wp.array2d[wp.int64], world: int, place: int, x: wp.float64):
    wp.atomic_add(sums, world, place, wp.int64(wp.rint(_UNITS * x)))


@wp.func
def turns(motion: Motion, vertices: Vertices, vertex: int) -> bool:
    """Returns whether a vertex collided, and is free to turn."""
    outcome = vertices.outcome[vertex]
    return motion.inverse_mass[vertex] > 0.0 and outcome != 0 and not has_final_velocity(outcome)


@wp.func
def torque_of(motion: Motion, vertices: Vertices, constraints: Constraints, i: int) -> wp.vec3d:
    """Returns the change of angular momentum by a contact between free bodies [kg m^2/s].

    Position changes across the motion change it, and so do impulses at points that slid apart since the contact.
    """
    weights = constraints.weights[i]
    corners = constraints.vertices[i]
    of_positions = wp.cross(constraints.position_multiplier[i], relative(weights, corners, motion.velocity))
    return of_positions + wp.cross(relative(weights, corners, vertices.x1), constraints.velocity_multiplier[i])


@wp.func
def acts(constraints: Constraints, i: int) -> bool:
    """Returns whether a constraint moved anything."""
    position, velocity = constraints.position_multiplier[i], constraints.velocity_multiplier[i]
    return wp.length_sq(position) + wp.length_sq(velocity) > _ZERO


@wp.func
def is_held(motion: Motion, vertices: Vertices, constraints: Constraints, i: int) -> bool:
    """Returns whether a contact is with something that is not free."""
    corners = constraints.vertices[i]
    held = corners[0] == corners[1]  # on a plane
    for j in range(4):
        held = held or (constraints.weights[i][j] != _ZERO and not turns(motion, vertices, corners[j]))
    return held


@wp.kernel(**_KERNEL)
def sum_torques(motion: Motion, vertices: Vertices, constraints: Constraints, sums: wp.array2d[wp.int64]):
    """Sums the changes of angular momentum by contacts between free bodies, see :func:`torque_of`.

    For one contact they cancel; for many at once, which share vertices, they need not.
    """
    i = wp.tid()
    if i >= constraints.count[0]:
        return
    world = motion.world[constraints.vertices[i][0]]
    if sums[world, HELD] != wp.int64(0) or not acts(constraints, i):
        return
    if is_held(motion, vertices, constraints, i):
        sums[world, HELD] = wp.int64(1)
        return
    added = torque_of(motion, vertices, constraints, i)
    for axis in range(3):
        _add(sums, world, axis, added[axis])


@wp.func
def moments(motion: Motion, vertices: Vertices, vertex: int) -> Moments:
    """Returns what a vertex adds to the sums of its world, from :data:`MASS` on."""
    mass = _ONE / wp.float64(motion.inverse_mass[vertex])
    x = to_double(vertices.x1[vertex])
    change = to_double(vertices.velocity[vertex]) - to_double(motion.velocity[vertex])
    return Moments(
        mass,
        mass * x[0],
        mass * x[1],
        mass * x[2],
        mass * x[0] * x[0],
        mass * x[1] * x[1],
        mass * x[2] * x[2],
        mass * x[1] * x[2],
        mass * x[2] * x[0],
        mass * x[0] * x[1],
        mass * wp.dot(change, change),
    )


@wp.kernel(**_KERNEL)
def sum_moments(motion: Motion, vertices: Vertices, sums: wp.array2d[wp.int64]):
    """Sums the moments of the vertices that collided, and the torques of those that were divided."""
    vertex = wp.tid()
    if not turns(motion, vertices, vertex):
        return
    world = motion.world[vertex]
    if sums[world, HELD] != wp.int64(0):
        return
    added = moments(motion, vertices, vertex)
    for i in range(MOMENTS):
        _add(sums, world, MASS + i, added[i])
    if vertices.outcome[vertex] & DIVIDED != 0:
        projected = with_delta(motion.x1[vertex], vertices.particle_delta_x, vertex)
        moved = to_double(vertices.x1[vertex]) - to_double(projected)
        torque = added[0] * wp.cross(moved, to_double(motion.velocity[vertex]))
        for axis in range(3):
            _add(sums, world, axis, torque[axis])


@wp.func
def change_by_turn(torque: wp.vec3d, total: Moments, x: wp.vec3d) -> wp.vec3d:
    """Returns the change of velocity at ``x`` by a rigid turn of a world that removes a torque [m/s]."""
    square = total[10]
    if wp.dot(torque, torque) == _ZERO or square <= _ZERO:
        return wp.vec3d()
    mass = total[0]
    centre = wp.vec3d(total[1], total[2], total[3]) / mass
    squares = wp.vec3d(total[4], total[5], total[6]) - mass * wp.cw_mul(centre, centre)
    products = wp.vec3d(
        total[7] - mass * centre[1] * centre[2],
        total[8] - mass * centre[2] * centre[0],
        total[9] - mass * centre[0] * centre[1],
    )
    inertia = wp.mat33d(
        squares[1] + squares[2],
        -products[2],
        -products[1],
        -products[2],
        squares[0] + squares[2],
        -products[0],
        -products[1],
        -products[0],
        squares[0] + squares[1],
    )
    if wp.determinant(inertia) <= _ZERO:
        return wp.vec3d()
    turn = -wp.inverse(inertia) * torque
    most = _LIMIT * wp.sqrt(square / wp.max(wp.dot(turn, inertia * turn), wp.float64(1e-300)))
    return wp.cross(wp.min(most, _ONE) * turn, x - centre)


@wp.kernel(**_KERNEL)
def turn_vertices(motion: Motion, vertices: Vertices, sums: wp.array2d[wp.int64]):
    """Turns the vertices that collided in each world, which removes the torque that contacts added."""
    vertex = wp.tid()
    world = motion.world[vertex]
    if not turns(motion, vertices, vertex) or sums[world, HELD] != wp.int64(0):
        return
    torque = wp.vec3d()
    for axis in range(3):
        torque[axis] = wp.float64(sums[world, axis]) / _UNITS
    total = Moments()
    for i in range(MOMENTS):
        total[i] = wp.float64(sums[world, MASS + i]) / _UNITS
    change = change_by_turn(torque, total, to_double(vertices.x1[vertex]))
    vertices.velocity[vertex] = to_single(to_double(vertices.velocity[vertex]) + change)
