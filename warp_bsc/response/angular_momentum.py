"""Angular momentum: what displacements have added to it is taken back, by a turn of all that has collided.

Only in worlds in which all that has collided is free: elsewhere it is not conserved.
"""

import warp as wp

from .constraints import PROJECTED, Constraints, Vertices, relative, to_double, to_single

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
    "sum_bodies",
    "sum_torques",
    "torque_of",
    "turn_vertices",
    "turns",
]

SUMS, MOMENTS, MASS, HELD = (wp.constant(i) for i in (15, 11, 3, 14))
"""How many sums of a world there are: of the torque and, from ``MASS`` on, so many moments, which are of mass, mass by
position, its six second moments, and mass by the square of the change of velocity; and at ``HELD`` of contacts with
what is not free."""
Moments = wp.types.vector(length=11, dtype=wp.float64)

_UNITS = wp.constant(wp.float64(2.0**32))
"""Sums are of integers in these units of kg, m and s, so that they are the same in any order."""
_LIMIT = wp.constant(wp.float64(0.1))
"""How large the turn may be, as a share of what the contacts have changed, root mean square."""
_ZERO = wp.constant(wp.float64(0.0))
_ONE = wp.constant(wp.float64(1.0))

_KERNEL = {"enable_backward": False}


@wp.func
def _add(sums: wp.array2d[wp.int64], world: int, place: int, x: wp.float64):
    wp.atomic_add(sums, world, place, wp.int64(wp.rint(_UNITS * x)))


@wp.func
def turns(vertices: Vertices, vertex: int) -> bool:
    """Whether a vertex has collided, and is free to turn."""
    return vertices.inverse_mass[vertex] > 0.0 and vertices.done[vertex] == PROJECTED


@wp.func
def torque_of(vertices: Vertices, constraints: Constraints, i: int) -> wp.vec3d:
    """What a contact between free bodies has done to the angular momentum.

    Displacements across the motion do something, and so do impulses at points that have slid apart since the contact.
    """
    weights = constraints.weights[i]
    corners = constraints.vertices[i]
    of_displacement = wp.cross(constraints.displacing[i], relative(weights, corners, vertices.wanted_velocity))
    return of_displacement + wp.cross(relative(weights, corners, vertices.x1), constraints.impulse[i])


@wp.func
def acts(constraints: Constraints, i: int) -> bool:
    """Whether a constraint has done anything."""
    return wp.length_sq(constraints.displacing[i]) + wp.length_sq(constraints.impulse[i]) > _ZERO


@wp.func
def is_held(vertices: Vertices, constraints: Constraints, i: int) -> bool:
    """Whether a contact is with something that is not free."""
    corners = constraints.vertices[i]
    held = corners[0] == corners[1]  # on a plane
    for j in range(4):
        held = held or (constraints.weights[i][j] != _ZERO and not turns(vertices, corners[j]))
    return held


@wp.kernel(**_KERNEL)
def sum_torques(vertices: Vertices, constraints: Constraints, sums: wp.array2d[wp.int64]):
    """Sums up what contacts between free bodies have done to the angular momentum.

    Displacements across the motion do something, and so do impulses at points that have slid apart since the contact.
    For a contact alone that cancels; for many at once, which share vertices, it need not.
    """
    i = wp.tid()
    if i >= constraints.count[0]:
        return
    world = vertices.world[constraints.vertices[i][0]]
    if sums[world, HELD] != wp.int64(0) or not acts(constraints, i):
        return
    if is_held(vertices, constraints, i):
        sums[world, HELD] = wp.int64(1)
        return
    added = torque_of(vertices, constraints, i)
    for axis in range(3):
        _add(sums, world, axis, added[axis])


@wp.func
def moments(vertices: Vertices, vertex: int) -> Moments:
    """What a vertex adds to the sums of a world, from :data:`MASS` on."""
    mass = _ONE / wp.float64(vertices.inverse_mass[vertex])
    x = to_double(vertices.x1[vertex])
    change = to_double(vertices.velocity[vertex]) - to_double(vertices.wanted_velocity[vertex])
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
def sum_bodies(vertices: Vertices, sums: wp.array2d[wp.int64]):
    """Sums up the moments of what has collided."""
    vertex = wp.tid()
    if not turns(vertices, vertex):
        return
    world = vertices.world[vertex]
    if sums[world, HELD] != wp.int64(0):
        return
    added = moments(vertices, vertex)
    for i in range(MOMENTS):
        _add(sums, world, MASS + i, added[i])


@wp.func
def change_by_turn(torque: wp.vec3d, total: Moments, x: wp.vec3d) -> wp.vec3d:
    """How a turn of a world, as a rigid body would turn, that takes a torque back changes the velocity at a place."""
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
def turn_vertices(vertices: Vertices, sums: wp.array2d[wp.int64]):
    """Turns what has collided in each world by the torque that contacts have added."""
    vertex = wp.tid()
    world = vertices.world[vertex]
    if not turns(vertices, vertex) or sums[world, HELD] != wp.int64(0):
        return
    torque = wp.vec3d()
    for axis in range(3):
        torque[axis] = wp.float64(sums[world, axis]) / _UNITS
    total = Moments()
    for i in range(MOMENTS):
        total[i] = wp.float64(sums[world, MASS + i]) / _UNITS
    change = change_by_turn(torque, total, to_double(vertices.x1[vertex]))
    vertices.velocity[vertex] = to_single(to_double(vertices.velocity[vertex]) + change)
