"""Angular momentum: what displacements have added to it is taken back, by a turn of all that has collided.

Only in worlds in which all that has collided is free: elsewhere it is not conserved.
"""

import warp as wp

from .constraints import PROJECTED, Constraints, Vertices, relative, to_double, to_single

__all__ = ["SUMS", "sum_bodies", "sum_torques", "turn_vertices"]

SUMS = 15
"""Sums of a world: of the torque, of mass, mass times position, its six second moments, mass times the square of the
change of velocity, and of contacts with what is not free."""

_MASS, _FIRST, _SECOND, _SQUARE, _HELD = (wp.constant(i) for i in (3, 4, 7, 13, 14))
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
def _turns(vertices: Vertices, vertex: int) -> bool:
    return vertices.inverse_mass[vertex] > 0.0 and vertices.done[vertex] == PROJECTED


@wp.func
def _is_acting(constraints: Constraints, i: int) -> bool:
    return wp.length_sq(constraints.displacing[i]) + wp.length_sq(constraints.impulse[i]) > _ZERO


@wp.kernel(**_KERNEL)
def sum_torques(vertices: Vertices, constraints: Constraints, sums: wp.array2d[wp.int64]):
    """Sums up what contacts between free bodies have done to the angular momentum.

    Displacements across the motion do something, and so do impulses at points that have slid apart since the contact.
    For a contact alone that cancels; for many at once, which share vertices, it need not.
    """
    i = wp.tid()
    if i >= constraints.count[0]:
        return
    corners = constraints.vertices[i]
    weights = constraints.weights[i]
    world = vertices.world[corners[0]]
    if sums[world, _HELD] != wp.int64(0) or not _is_acting(constraints, i):
        return
    on_plane = corners[0] == corners[1]
    for j in range(4):
        if on_plane or (weights[j] != _ZERO and not _turns(vertices, corners[j])):
            sums[world, _HELD] = wp.int64(1)
            return
    torque = wp.cross(constraints.displacing[i], relative(weights, corners, vertices.wanted_velocity))
    torque += wp.cross(relative(weights, corners, vertices.x1), constraints.impulse[i])
    for axis in range(3):
        _add(sums, world, axis, torque[axis])


@wp.kernel(**_KERNEL)
def sum_bodies(vertices: Vertices, sums: wp.array2d[wp.int64]):
    """Sums up the moments of what has collided."""
    vertex = wp.tid()
    if not _turns(vertices, vertex):
        return
    world = vertices.world[vertex]
    if sums[world, _HELD] != wp.int64(0):
        return
    mass = _ONE / wp.float64(vertices.inverse_mass[vertex])
    x = to_double(vertices.x1[vertex])
    change = to_double(vertices.velocity[vertex]) - to_double(vertices.wanted_velocity[vertex])
    _add(sums, world, _MASS, mass)
    _add(sums, world, _SQUARE, mass * wp.dot(change, change))
    for axis in range(3):
        _add(sums, world, _FIRST + axis, mass * x[axis])
        _add(sums, world, _SECOND + axis, mass * x[axis] * x[axis])
        _add(sums, world, _SECOND + 3 + axis, mass * x[(axis + 1) % 3] * x[(axis + 2) % 3])


@wp.func
def _sum(sums: wp.array2d[wp.int64], world: int, place: int) -> wp.vec3d:
    return wp.vec3d(
        wp.float64(sums[world, place]) / _UNITS,
        wp.float64(sums[world, place + 1]) / _UNITS,
        wp.float64(sums[world, place + 2]) / _UNITS,
    )


@wp.kernel(**_KERNEL)
def turn_vertices(vertices: Vertices, sums: wp.array2d[wp.int64]):
    """Turns what has collided in each world, as a rigid body would, by the torque that contacts have added."""
    vertex = wp.tid()
    world = vertices.world[vertex]
    torque = _sum(sums, world, 0)
    if not _turns(vertices, vertex) or sums[world, _HELD] != wp.int64(0) or wp.dot(torque, torque) == _ZERO:
        return
    mass = wp.float64(sums[world, _MASS]) / _UNITS
    centre = _sum(sums, world, _FIRST) / mass
    squares = _sum(sums, world, _SECOND) - mass * wp.cw_mul(centre, centre)
    products = _sum(sums, world, _SECOND + 3)
    for axis in range(3):
        products[axis] -= mass * centre[(axis + 1) % 3] * centre[(axis + 2) % 3]
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
        return
    turn = -wp.inverse(inertia) * torque
    square = wp.float64(sums[world, _SQUARE]) / _UNITS
    most = _LIMIT * wp.sqrt(square / wp.max(wp.dot(turn, inertia * turn), wp.float64(1e-300)))
    turn = wp.min(most, _ONE) * turn
    change = wp.cross(turn, to_double(vertices.x1[vertex]) - centre)
    vertices.velocity[vertex] = to_single(to_double(vertices.velocity[vertex]) + change)
