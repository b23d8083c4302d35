"""Conjugate gradients that stop at negative curvature, each world by one block of threads."""

import warp as wp

from .rows import Rows
from .system import Contacts, Unknowns, product

wp.set_module_options({"enable_backward": False})

MAX_BLOCK = 1024
"""Most threads of a block on a GPU."""


def block_of_world(unknowns: int, device: wp.Device) -> tuple[int, int]:
    """Returns how many threads solve for a world of so many unknowns, and how many of these share a row."""
    if device.is_cpu:
        return 1, 1
    parts = 4
    while parts > 1 and parts * unknowns > MAX_BLOCK:
        parts //= 2
    return min(MAX_BLOCK, max(64, -(-parts * unknowns // 32) * 32)), parts


@wp.struct
class Vectors:
    """Vectors of a solve, each of one vec3 by unknown.

    Attributes:
        gradient: Of the energy [N].
        inverse: Inverted blocks of the diagonal, which precondition, shape [unknown_count].
        solution: The displacements [m]; those that are given, before.
        residual, direction, along: Of the iteration; the last is the product with the direction.
    """

    gradient: wp.array[wp.vec3]
    inverse: wp.array[wp.mat33]
    solution: wp.array[wp.vec3]
    residual: wp.array[wp.vec3]
    direction: wp.array[wp.vec3]
    along: wp.array[wp.vec3]


@wp.func_native(
    snippet="""
#if defined(__CUDA_ARCH__)
    __syncthreads();
#endif
"""
)
def _wait_for_block():
    """Waits for all threads of the block; each then sees what the others wrote."""
    ...


@wp.func_native(
    snippet="""
#if defined(__CUDA_ARCH__)
    const unsigned mask = ((1u << parts) - 1u) << (threadIdx.x & 31u & ~(unsigned)(parts - 1));
    for (int offset = parts / 2; offset > 0; offset /= 2)
        for (int c = 0; c < 3; ++c)
            value[c] += __shfl_xor_sync(mask, value[c], offset);
#endif
    return value;
"""
)
def _sum_of_parts(value: wp.vec3, parts: int) -> wp.vec3:
    """Returns the sum of the values of ``parts`` threads that follow each other, a power of 2 below 32, in each."""
    ...


@wp.func
def _dot(a: wp.vec3, b: wp.vec3) -> wp.float64:
    return wp.float64(wp.dot(a, b))


@wp.func
def _sum(value: wp.float64) -> wp.float64:
    """Returns the sum over the threads of a block, in each."""
    return wp.tile_sum(wp.tile(value))[0]


@wp.kernel
def solve_worlds(
    # in
    rows: Rows,
    contacts: Contacts,
    unknowns: Unknowns,
    active: wp.array[int],
    tolerance: wp.float64,
    max_iterations: int,
    parts: int,
    # in and out
    vectors: Vectors,
    # out
    iterations: wp.array[int],
):
    """Solves H d = -g in active worlds, until the norm of the residual, preconditioned, is a share of its first one.

    Where the matrix is found not to be positive definite, the solution so far ends the solve, or the preconditioned
    negative gradient if there is none: both are directions in which the energy falls. What is given stays given.
    """
    world, lane = wp.tid() // wp.block_dim(), wp.tid() % wp.block_dim()
    if active[world] == 0:
        return
    begin, end = unknowns.of_worlds[world] + lane // parts, unknowns.of_worlds[world + 1]
    stride, share = wp.block_dim() // parts, lane % parts
    part = wp.float64(0.0)
    for u in range(begin, end, stride):
        r = wp.vec3()
        if unknowns.is_free[u] != 0:
            p = product(rows, contacts, unknowns, u, vectors.solution, share, parts)
            r = -vectors.gradient[u] - _sum_of_parts(p, parts)
        if share == 0:
            z = vectors.inverse[u] * r
            vectors.residual[u] = r
            vectors.direction[u] = z
            part += _dot(r, z)
    squared = _sum(part)
    _wait_for_block()
    limit = tolerance * tolerance * squared
    count = int(0)
    goes_on = squared > wp.float64(0.0)
    while goes_on:
        part = wp.float64(0.0)
        for u in range(begin, end, stride):
            if unknowns.is_free[u] != 0:
                p = _sum_of_parts(product(rows, contacts, unknowns, u, vectors.direction, share, parts), parts)
                if share == 0:
                    vectors.along[u] = p
                    part += _dot(vectors.direction[u], p)
        curvature = _sum(part)
        is_convex = curvature > wp.float64(0.0)
        step = float(0.0)
        if is_convex:
            step = float(squared / curvature)
        elif count == 0:
            step = float(squared / wp.max(-curvature, wp.float64(1e-30) + wp.float64(0.01) * squared))
        count += 1
        part = wp.float64(0.0)
        for u in range(begin, end, stride):
            if unknowns.is_free[u] != 0 and share == 0:
                vectors.solution[u] = vectors.solution[u] + step * vectors.direction[u]
                r = vectors.residual[u] - step * vectors.along[u]
                vectors.residual[u] = r
                part += _dot(r, vectors.inverse[u] * r)
        after = _sum(part)
        goes_on = is_convex and after > limit and count < max_iterations
        momentum = float(after / squared)
        squared = after
        if goes_on:
            for u in range(begin, end, stride):
                if unknowns.is_free[u] != 0 and share == 0:
                    vectors.direction[u] = vectors.inverse[u] * vectors.residual[u] + momentum * vectors.direction[u]
        _wait_for_block()
    if lane == 0:
        iterations[world] = iterations[world] + count
