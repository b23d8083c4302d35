"""Conjugate gradients that stop at negative curvature, each world by one block of threads."""

import warp as wp

from .matrix import Matrix, block_at
from .system import Contacts, Unknowns, coupled_product, pull_contact, sum_of_parts

_LARGEST_BLOCK = 1024
"""Threads of the only block of a world, at most."""
_BLOCK, _BLOCKS = 512, 128
"""Threads of each block of a larger world, and blocks of all worlds at most: a GPU runs them together."""


@wp.struct
class Team:
    """The threads that solve for a world: one block, or several that wait for each other.

    Attributes:
        blocks: Number of blocks.
        parts: Threads that share a row, a power of 2.
        shares: Whether the direction of a solve is in shared memory, where the threads of a block read it.
        arrived: How often blocks have waited for the others, shape [worlds].
        sums: Of the blocks of each world, of two sums in turn, shape [worlds, 2 blocks].
    """

    blocks: int
    parts: int
    shares: bool
    arrived: wp.array[int]
    sums: wp.array2d[wp.float64]


def make_team(unknowns: int, worlds: int, device: wp.Device) -> tuple[Team, int]:
    """Returns the team for worlds of so many unknowns at most, and the number of threads in its blocks."""
    team, threads = Team(), 1
    team.blocks = team.parts = 1
    if device.is_cuda:
        team.parts = 4
        while team.parts > 1 and team.parts * unknowns > _LARGEST_BLOCK:
            team.parts //= 2
        threads = min(_LARGEST_BLOCK, max(64, -(-team.parts * unknowns // 32) * 32))
        if unknowns > _LARGEST_BLOCK and worlds <= _BLOCKS // 2:
            team.parts, threads = 4, _BLOCK
            team.blocks = min(_BLOCKS // worlds, -(-team.parts * unknowns // _BLOCK))
    team.shares = device.is_cuda and unknowns <= _LARGEST_BLOCK
    team.arrived = wp.zeros(worlds, dtype=int, device=device)
    team.sums = wp.zeros((worlds, 2 * team.blocks), dtype=wp.float64, device=device)
    return team, threads


@wp.struct
class Vectors:
    """Vectors of a solve, each of one vec3 by unknown.

    Attributes:
        gradient: Of the energy [N].
        inverse: Inverted blocks of the diagonal, which precondition, shape [unknown_count].
        solution: The displacements [m]; those that are given, before.
        residual, direction, along: Of the iteration; the last is the product with the direction, then the residual as
            preconditioned.
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
    if (blocks > 1) {
        if (threadIdx.x == 0) {
            __threadfence();
            atomicAdd(&arrived.data[world], 1);
            while (*(volatile int*)&arrived.data[world] < turn * blocks) {}
            __threadfence();
        }
        __syncthreads();
    }
#endif
"""
)
def _wait(world: int, blocks: int, turn: int, arrived: wp.array[int]):
    """Waits for all threads of a world, for the ``turn``-th time; each then sees what the others wrote."""
    ...


@wp.func_native(
    snippet="""
#if defined(__CUDA_ARCH__)
    __shared__ double all_sums[64];
    double* sums = all_sums + 32 * (turn & 1);
    const int lane = threadIdx.x & 31;
    for (int offset = 16; offset; offset >>= 1) value += __shfl_xor_sync(~0u, value, offset);
    if (lane == 0) sums[threadIdx.x >> 5] = value;
    __syncthreads();
    value = lane < (blockDim.x >> 5) ? sums[lane] : 0.0;
    for (int offset = 16; offset; offset >>= 1) value += __shfl_xor_sync(~0u, value, offset);
#endif
    return value;
"""
)
def _sum_of_block(value: wp.float64, turn: int) -> wp.float64:
    """Returns the sum over the threads of a block, in each; in every other turn by the same memory."""
    ...


@wp.func_native(
    snippet="""
#if defined(__CUDA_ARCH__)
    __shared__ float shared[3 * 1024];
    if (shares) {
        float* at = shared + 3 * row;
        if (!writes) return wp::vec3(at[0], at[1], at[2]);
        at[0] = value[0];
        at[1] = value[1];
        at[2] = value[2];
    }
#endif
    if (writes) p.data[first + row] = value;
    return p.data[first + row];
"""
)
def _element(p: wp.array[wp.vec3], first: int, row: int, value: wp.vec3, writes: bool, shares: bool) -> wp.vec3:
    """Reads or writes an element of a vector, which is also in shared memory if the team ``shares``."""
    ...


@wp.func
def _product(
    matrix: Matrix,
    contacts: Contacts,
    unknowns: Unknowns,
    p: wp.array[wp.vec3],
    shares: bool,
    world: int,
    first: int,
    row: int,
    part: int,
):
    """Returns a row of a world of the product of the Hessian with a vector, summed over the threads that share it."""
    thread = row * matrix.parts + part
    group, lane = matrix.group[world] + thread // matrix.width, thread % matrix.width
    total = coupled_product(contacts, unknowns, first + row, part, matrix.parts)
    for entry in range(matrix.first[group], matrix.first[group + 1]):
        column = matrix.column[entry * matrix.width + lane]
        if column >= 0:
            block = block_at(matrix, 9 * entry * matrix.width + lane)
            total += block * _element(p, first, column - first, wp.vec3(), False, shares)
    return sum_of_parts(total, matrix.parts)


@wp.func
def _dot(a: wp.vec3, b: wp.vec3) -> wp.float64:
    return wp.float64(wp.dot(a, b))


@wp.func
def _sum(value: wp.float64, team: Team, world: int, block: int, lane: int, turn: int) -> wp.float64:
    """Returns the sum over the threads of a world, in each, which have waited ``turn`` times then."""
    total = _sum_of_block(value, turn)
    if team.blocks == 1:
        return total
    first = (turn % 2) * team.blocks
    if lane == 0:
        team.sums[world, first + block] = total
    _wait(world, team.blocks, turn, team.arrived)
    total = wp.float64(0.0)
    for other in range(team.blocks):
        total += team.sums[world, first + other]
    return total


@wp.kernel(module="unique", enable_backward=False, launch_bounds=_LARGEST_BLOCK)
def solve_worlds(
    # in
    matrix: Matrix,
    contacts: Contacts,
    unknowns: Unknowns,
    active: wp.array[int],
    tolerance: wp.float64,
    max_iterations: int,
    team: Team,
    # in and out
    vectors: Vectors,
    # out
    iterations: wp.array[int],
):
    """Solves H d = -g in active worlds, until the norm of the residual, preconditioned, is a share of its first one.

    Where the matrix is found not to be positive definite, the solution so far ends the solve, or the preconditioned
    negative gradient if there is none: both are directions in which the energy falls. What is given stays given.
    """
    thread = wp.tid()
    number, lane = thread // wp.block_dim(), thread % wp.block_dim()
    world, block = number // team.blocks, number % team.blocks
    if active[world] == 0:
        return
    part = lane % team.parts
    begin, stride = (block * wp.block_dim() + lane) // team.parts, team.blocks * wp.block_dim() // team.parts
    first = unknowns.of_worlds[world]
    end = unknowns.of_worlds[world + 1] - first
    turn = int(1)
    own = wp.float64(0.0)
    first_coupled = contacts.coupled_first[world] + block * wp.block_dim() + lane
    couples = contacts.coupled_end[world] > contacts.coupled_first[world]
    for n in range(first_coupled, contacts.coupled_end[world], team.blocks * wp.block_dim()):
        pull_contact(contacts, unknowns, contacts.coupled[n], vectors.solution)
    if couples:
        _wait(world, team.blocks, turn, team.arrived)
        turn += 1
    for row in range(begin, end, stride):
        u = first + row
        r = wp.vec3()
        if unknowns.is_free[u] != 0:
            p = _product(matrix, contacts, unknowns, vectors.solution, False, world, first, row, part)
            r = -vectors.gradient[u] - p
        if part == 0:
            z = vectors.inverse[u] * r
            vectors.residual[u] = r
            _element(vectors.direction, first, row, z, True, team.shares)
            own += _dot(r, z)
    squared = _sum(own, team, world, block, lane, turn)
    limit = tolerance * tolerance * squared
    count = int(0)
    goes_on = squared > wp.float64(0.0)
    while goes_on:
        own = wp.float64(0.0)
        if couples:
            for n in range(first_coupled, contacts.coupled_end[world], team.blocks * wp.block_dim()):
                pull_contact(contacts, unknowns, contacts.coupled[n], vectors.direction)
            turn += 1
            _wait(world, team.blocks, turn, team.arrived)
        for row in range(begin, end, stride):
            u = first + row
            if unknowns.is_free[u] != 0:
                p = _product(matrix, contacts, unknowns, vectors.direction, team.shares, world, first, row, part)
                if part == 0:
                    vectors.along[u] = p
                    own += _dot(_element(vectors.direction, first, row, p, False, team.shares), p)
        turn += 1
        curvature = _sum(own, team, world, block, lane, turn)
        is_convex = curvature > wp.float64(0.0)
        step = float(0.0)
        if is_convex:
            step = float(squared / curvature)
        elif count == 0:
            step = float(squared / wp.max(-curvature, wp.float64(1e-30) + wp.float64(0.01) * squared))
        count += 1
        own = wp.float64(0.0)
        for row in range(begin, end, stride):
            u = first + row
            if unknowns.is_free[u] != 0 and part == 0:
                d = _element(vectors.direction, first, row, wp.vec3(), False, team.shares)
                vectors.solution[u] = vectors.solution[u] + step * d
                r = vectors.residual[u] - step * vectors.along[u]
                z = vectors.inverse[u] * r
                vectors.residual[u] = r
                vectors.along[u] = z
                own += _dot(r, z)
        turn += 1
        after = _sum(own, team, world, block, lane, turn)
        goes_on = is_convex and after > limit and count < max_iterations
        momentum = float(after / squared)
        squared = after
        if goes_on:
            for row in range(begin, end, stride):
                u = first + row
                if unknowns.is_free[u] != 0 and part == 0:
                    d = _element(vectors.direction, first, row, wp.vec3(), False, team.shares)
                    _element(vectors.direction, first, row, vectors.along[u] + momentum * d, True, team.shares)
            turn += 1
            _wait(world, team.blocks, turn, team.arrived)
    if block == 0 and lane == 0:
        iterations[world] = iterations[world] + count
