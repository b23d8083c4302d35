"""Sums of impulses in fixed point, and what kernels of contact forces share."""

import warp as wp

from .structs import Sides

wp.set_module_options({"enable_backward": False})

_UNITS, _UNIT = wp.constant(wp.float64(2.0**46)), wp.constant(wp.float64(2.0**-46))
"""Units in 1 N s or N m s, and a unit: sums reach 130,000 N s, in steps of 1.5e-14 N s."""
_MAX_IMPULSE, _MAX_UNITS = wp.constant(wp.float64(2.0**16)), wp.constant(wp.int64(2**63 - 1))


@wp.func
def add_impulse(sums: wp.array2d[wp.int64], i: int, column: int, x: wp.vec3d, lost: wp.array[int]):
    """Adds a vector to three columns of a sum, from ``column`` on; counts in ``lost`` what it cannot hold."""
    for axis in range(3):
        if not wp.abs(x[axis]) < _MAX_IMPULSE:  # nor if it is not a number
            wp.atomic_add(lost, 0, 1)
        else:
            units = wp.int64(wp.rint(_UNITS * x[axis]))
            if units != wp.int64(0):
                before = wp.atomic_add(sums, i, column + axis, units)
                if units > wp.int64(0) and before > _MAX_UNITS - units:
                    wp.atomic_add(lost, 0, 1)
                if units < wp.int64(0) and before < -_MAX_UNITS - units:
                    wp.atomic_add(lost, 0, 1)


@wp.func
def take_impulse(sums: wp.array2d[wp.int64], i: int, column: int) -> wp.vec3d:
    """Returns a sum, and clears it for the next step."""
    total = wp.vec3d()
    for axis in range(3):
        total[axis] = _UNIT * wp.float64(sums[i, column + axis])
        sums[i, column + axis] = wp.int64(0)
    return total


@wp.func
def shape_of(sides: Sides, vertex: int) -> int:
    """Returns the shape of a vertex, -1 for a particle."""
    if vertex < sides.particle_count:
        return -1
    return sides.shape[vertex - sides.particle_count]


@wp.func
def body_of_vertex(sides: Sides, vertex: int) -> int:
    """Returns the body of a vertex of a shape, also of one that the response cannot move; else -1."""
    if vertex < sides.particle_count:
        return -1
    return sides.body[vertex - sides.particle_count]
