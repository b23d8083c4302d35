"""Kernels between particles and elements: gather, scatter, and blocks of the Jacobians of elements."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def gather(
    # in
    vertices: wp.array2d[int],
    of_particles: wp.array[wp.vec3d],
    # out
    of_elements: wp.array3d[wp.vec3d],
):
    """Copies values of particles to the elements that have them; 0 for a vertex that an element lacks."""
    e, i = wp.tid()
    v = vertices[e, i]
    if v >= 0:
        of_elements[e, 0, i] = of_particles[v]
    else:
        of_elements[e, 0, i] = wp.vec3d()


@wp.kernel
def scatter(
    # in
    vertices: wp.array2d[int],
    of_elements: wp.array3d[wp.vec3d],
    # out
    of_particles: wp.array[wp.vec3d],
):
    """Adds values of elements to those of their particles."""
    e, i = wp.tid()
    v = vertices[e, i]
    if v >= 0:
        wp.atomic_add(of_particles, v, of_elements[e, 0, i])


@wp.func
def block(jacobian: wp.array3d[wp.vec3d], e: int, i: int, j: int):
    """Returns the derivative of the force on particle i of an element with respect to particle j."""
    return wp.matrix_from_rows(jacobian[e, 3 * i, j], jacobian[e, 3 * i + 1, j], jacobian[e, 3 * i + 2, j])


@wp.kernel
def add_blocks(
    # in
    unknowns: wp.array2d[int],
    is_fixed: wp.array[int],
    leave_out: wp.array[int],
    jacobian: wp.array3d[wp.vec3d],
    # out
    blocks: wp.array[wp.mat33d],
):
    """Subtracts the blocks of Jacobians on the diagonal. Several places of an element may have one unknown."""
    e, i = wp.tid()
    if leave_out:
        if leave_out[e] != 0:
            return
    u = unknowns[e, i]
    if u >= 0:
        if is_fixed[u] == 0:
            for j in range(unknowns.shape[1]):
                if unknowns[e, j] == u:
                    wp.atomic_sub(blocks, u, block(jacobian, e, i, j))
