"""Kernels of linear algebra: the sparse matrix of a step, its preconditioner, and norms by world."""

import warp as wp

from .element_kernels import block
from .kernels import FIXED

wp.set_module_options({"enable_backward": False})

_ZERO = wp.constant(wp.float64(0.0))
_ONE = wp.constant(wp.float64(1.0))


@wp.kernel
def set_inertia(
    # in
    dt: wp.float64,
    mass: wp.array[float],
    is_fixed: wp.array[int],
    diagonal: wp.array2d[int],
    # out
    inertia: wp.array[wp.float64],
    values: wp.array[wp.mat33d],
):
    """Sets the blocks of the diagonal to the inertia m / dt^2 of particles, 1 for those that nothing moves."""
    i = wp.tid()
    value = _ONE
    if is_fixed[i] != FIXED:
        value = wp.float64(mass[i]) / (dt * dt)
    inertia[i] = value
    values[diagonal[i, 0]] = value * wp.identity(3, wp.float64)


@wp.kernel
def add_element_blocks(
    # in
    vertices: wp.array2d[int],
    is_fixed: wp.array[int],
    jacobian: wp.array3d[wp.vec3d],
    places: wp.array3d[int],
    # out
    values: wp.array[wp.mat33d],
):
    """Subtracts blocks of Jacobians at their places in a matrix."""
    e, i, j = wp.tid()
    v, w = vertices[e, i], vertices[e, j]
    if v >= 0 and w >= 0:
        if is_fixed[v] == 0 and is_fixed[w] == 0:
            wp.atomic_sub(values, places[e, i, j], block(jacobian, e, i, j))


@wp.kernel
def copy_diagonal(
    # in
    diagonal: wp.array2d[int],
    values: wp.array[wp.mat33d],
    # out
    blocks: wp.array[wp.mat33d],
):
    """Copies the blocks of the diagonal."""
    i = wp.tid()
    blocks[i] = values[diagonal[i, 0]]


@wp.kernel
def sparse_product(
    # in
    alpha: wp.float64,
    beta: wp.float64,
    offsets: wp.array[int],
    columns: wp.array[int],
    values: wp.array[wp.mat33d],
    x: wp.array[wp.vec3d],
    y: wp.array[wp.vec3d],
    # out
    z: wp.array[wp.vec3d],
):
    """Sets z to alpha A x + beta y, with a sparse matrix A of blocks by row; z may be y."""
    i = wp.tid()
    product = wp.vec3d()
    for k in range(offsets[i], offsets[i + 1]):
        product += values[k] * x[columns[k]]
    product = alpha * product
    if beta != _ZERO:
        product += beta * y[i]
    z[i] = product


@wp.kernel
def invert_blocks(
    # in
    inertia: wp.array[wp.float64],
    # in and out
    blocks: wp.array[wp.mat33d],
):
    """Inverts the symmetric parts of blocks, with eigenvalues made positive and at least the inertia.

    VBD leaves the negative terms of its blocks out, so that they are positive definite; this has the same purpose.
    """
    i = wp.tid()
    block = blocks[i]
    q, values = wp.eig3(wp.float64(0.5) * (block + wp.transpose(block)))
    for k in range(3):
        values[k] = _ONE / wp.max(wp.abs(values[k]), inertia[i])
    blocks[i] = q * wp.diag(values) * wp.transpose(q)


@wp.kernel
def apply_blocks(
    # in
    alpha: wp.float64,
    beta: wp.float64,
    blocks: wp.array[wp.mat33d],
    x: wp.array[wp.vec3d],
    y: wp.array[wp.vec3d],
    # out
    z: wp.array[wp.vec3d],
):
    """Sets z to alpha B x + beta y, with blocks B; z may be y."""
    i = wp.tid()
    product = alpha * (blocks[i] * x[i])
    if beta != _ZERO:
        product += beta * y[i]
    z[i] = product


@wp.kernel
def sum_squares(
    # in
    world: wp.array[int],
    a: wp.array[wp.vec3d],
    b: wp.array[wp.vec3d],
    # out
    sums: wp.array2d[wp.float64],
):
    """Adds squares to sums by world: of a to row 0, of b to row 1."""
    i = wp.tid()
    wp.atomic_add(sums, 0, world[i], wp.dot(a[i], a[i]))
    wp.atomic_add(sums, 1, world[i], wp.dot(b[i], b[i]))


@wp.kernel
def sum_products(
    # in
    world: wp.array[int],
    a: wp.array[wp.vec3d],
    b: wp.array[wp.vec3d],
    # out
    sums: wp.array[wp.float64],
):
    """Adds the products of two vectors to sums by world."""
    i = wp.tid()
    wp.atomic_add(sums, world[i], wp.dot(a[i], b[i]))


@wp.kernel
def find_failed(
    # in
    tolerance: wp.float64,
    sums: wp.array2d[wp.float64],
    # out
    failed: wp.array[int],
):
    """Finds the worlds whose residual, squared in row 0, is not below the tolerance times the norm, in row 1."""
    w = wp.tid()
    solved = sums[0, w] <= tolerance * tolerance * sums[1, w]  # false if one is not finite
    failed[w] = int(not solved)


@wp.kernel
def set_failed(
    # in
    world: wp.array[int],
    failed: wp.array[int],
    value: wp.float64,
    # in and out
    x: wp.array[wp.vec3d],
):
    """Sets a vector to a value in worlds that failed."""
    i = wp.tid()
    if failed[world[i]] != 0:
        x[i] = wp.vec3d(value, value, value)
