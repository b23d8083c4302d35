"""Forces on particles as kernels that Warp differentiates: inertia, and those of elements."""

import warp as wp

from .elasticity.derivatives import element_gradient
from .elasticity.elements import Elements, element_size, first_corner, kind_of


@wp.kernel
def elastic_forces(
    # in
    elements: Elements,
    dt: wp.float64,
    x1: wp.array[wp.vec3d],
    x0: wp.array[wp.vec3d],
    # out
    forces: wp.array[wp.vec3d],
):
    """Computes the force of each element on each of its corners."""
    i = wp.tid()
    kind = kind_of(elements, i)
    e = i - elements.first[kind]
    gradient = element_gradient(elements, kind, e, x1, x0, dt)
    corner, size = first_corner(elements, kind, e), element_size(kind)
    for j in range(4):
        if j < size:
            forces[corner + j] = -gradient[j]


@wp.kernel
def inertial_forces(
    # in
    dt: wp.float64,
    x1: wp.array[wp.vec3d],
    x0: wp.array[wp.vec3d],
    velocity: wp.array[wp.vec3],
    force: wp.array[wp.vec3],
    mass: wp.array[float],
    inverse_mass: wp.array[float],
    gravity: wp.array[wp.vec3],
    world: wp.array[int],
    is_fixed: wp.array[int],
    # out
    forces: wp.array[wp.vec3d],
):
    """The force that moves a particle to where it would be without others, from VBD's predicted position."""
    i = wp.tid()
    if is_fixed[i] != 0:
        forces[i] = wp.vec3d()
        return
    moved = x0[i] - x1[i]
    if inverse_mass[i] != 0.0:
        acceleration = wp.vec3d(gravity[world[i]])
        if force:
            acceleration = acceleration + wp.float64(inverse_mass[i]) * wp.vec3d(force[i])
        moved = moved + dt * (wp.vec3d(velocity[i]) + dt * acceleration)
    forces[i] = wp.float64(mass[i]) / (dt * dt) * moved
