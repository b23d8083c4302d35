"""Kernels between particles and elements: gather, scatter, and blocks of the Jacobians of elements."""

import warp as wp

wp.set_module_options({"enable_backward": False})

_ONE = wp.constant(wp.float64(1.0))


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


@wp.kernel
def set_units(
    # out
    units: wp.array3d[wp.vec3d],
):
    """Sets row 3 i + j of each element to the unit vector j of its vertex i."""
    e, row, i = wp.tid()
    unit = wp.vec3d()
    if row // 3 == i:
        unit[row % 3] = _ONE
    units[e, row, i] = unit


@wp.func
def block(jacobian: wp.array3d[wp.vec3d], e: int, i: int, j: int):
    """Returns the derivative of the force on particle i of an element with respect to particle j."""
    return wp.matrix_from_rows(jacobian[e, 3 * i, j], jacobian[e, 3 * i + 1, j], jacobian[e, 3 * i + 2, j])


@wp.kernel
def add_blocks(
    # in
    vertices: wp.array2d[int],
    is_fixed: wp.array[int],
    jacobian: wp.array3d[wp.vec3d],
    # out
    blocks: wp.array[wp.mat33d],
):
    """Subtracts the blocks of Jacobians on the diagonal."""
    e, i = wp.tid()
    v = vertices[e, i]
    if v >= 0:
        if is_fixed[v] == 0:
            wp.atomic_sub(blocks, v, block(jacobian, e, i, i))


@wp.kernel
def set_contact_vertices(
    # in
    count: wp.array[int],
    indices: wp.array[wp.vec3i],
    # out
    vertices: wp.array2d[int],
):
    """Writes the particles of contacts, -1 beyond their number."""
    e, i = wp.tid()
    vertex = int(-1)
    if i < 3 and e < wp.min(count[0], indices.shape[0]):
        vertex = indices[e][i]
    vertices[e, i] = vertex


@wp.kernel
def collect_pairs(
    # in
    primitives: wp.array2d[int],
    pairs: wp.array[int],
    offsets: wp.array[int],
    sizes: wp.array[int],
    counts: wp.array[int],
    starts: wp.array[int],
    first: int,
    world: wp.array[int],
    # out
    vertices: wp.array2d[int],
    dropped: wp.array[int],
):
    """Writes the particles of pairs of vertices and triangles, or of edges; marks worlds whose pairs did not all fit.

    The primitives are triangles, or edges as Newton has them: the particles of an edge are the last two of four.
    """
    i = wp.tid()
    for k in range(wp.min(counts[i], sizes[i])):
        row, other = first + starts[i] + k, pairs[2 * (offsets[i] + k) + 1]
        if primitives.shape[1] == 3:
            vertices[row, 0] = i
            for j in range(3):
                vertices[row, j + 1] = primitives[other, j]
        else:
            for j in range(2):
                vertices[row, j] = primitives[i, j + 2]
                vertices[row, j + 2] = primitives[other, j + 2]
    if counts[i] > sizes[i]:
        vertex = int(i)
        if primitives.shape[1] == 4:
            vertex = primitives[i, 2]
        dropped[world[vertex]] = 1
