"""Forces on particles as kernels that Warp differentiates: inertia, and the work of elements along a displacement."""

import warp as wp

from .contact.elasticity import Elements, element_gradient, kind_of, vertex_of


@wp.kernel
def work_of_elements(
    # in
    elements: Elements,
    dt: wp.float64,
    x1: wp.array[wp.vec3d],
    x0: wp.array[wp.vec3d],
    multipliers: wp.array[wp.vec3d],
    # out
    work: wp.array[wp.float64],
):
    """Computes the product of the forces of each element and multipliers of its particles."""
    i = wp.tid()
    kind = kind_of(elements, i)
    e = i - elements.first[kind]
    gradient = element_gradient(elements, kind, e, x1, x0, dt)
    total = wp.float64(0.0)
    for j in range(4):
        v = vertex_of(elements, kind, e, j)
        if v >= 0:
            total -= wp.dot(multipliers[v], gradient[j])
    work[i] = total


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
