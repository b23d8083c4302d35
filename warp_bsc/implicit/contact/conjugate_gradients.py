"""Conjugate gradients that stop at negative curvature, each world by one block of threads."""

import functools

import warp as wp

from .matrix import Matrix
from .system import Contacts, Unknowns

_LARGEST_BLOCK = 1024
"""Threads of the only block of a world, at most."""
_KEPT = {320: 13, 640: 4, _LARGEST_BLOCK: 0}
"""Blocks of the Hessian that a thread keeps in registers, in thread blocks of so many threads at most."""
_BLOCK, _BLOCKS = 512, 128
"""Threads of each block of a larger world, and blocks of all worlds at most; no more than multiprocessors, as they wait
for each other and must run together."""


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
    sums: wp.array2d[float]


def make_team(unknowns: int, worlds: int, device: wp.Device) -> tuple[Team, int]:
    """Returns the team for worlds of so many unknowns at most, and the number of threads in its blocks."""
    team, threads = Team(), 1
    team.blocks = team.parts = 1
    if device.is_cuda:
        team.parts = 4
        while team.parts > 1 and team.parts * unknowns > min(_KEPT):
            team.parts //= 2
        threads = min(_LARGEST_BLOCK, max(64, -(-team.parts * unknowns // 32) * 32))
        most = min(_BLOCKS, device.sm_count)
        if unknowns > _LARGEST_BLOCK and worlds <= most // 2:
            team.parts, threads = 4, _BLOCK
            team.blocks = min(most // worlds, -(-team.parts * unknowns // _BLOCK))
    team.shares = device.is_cuda and unknowns <= _LARGEST_BLOCK
    team.arrived = wp.zeros(worlds, dtype=int, device=device)
    team.sums = wp.zeros((worlds, 2 * team.blocks), dtype=float, device=device)
    return team, threads


@wp.struct
class Vectors:
    """Vectors of a solve, each of one vec3 by unknown.

    Attributes:
        gradient: Of the energy [N].
        inverse: Inverted blocks of the diagonal, which precondition, shape [unknown_count].
        solution: The displacements [m]; those that are given, before.
        residual, direction, along: Of the iteration; the last is the product with the direction, and then the residual
            as it is preconditioned.
    """

    gradient: wp.array[wp.vec3]
    inverse: wp.array[wp.mat33]
    solution: wp.array[wp.vec3]
    residual: wp.array[wp.vec3]
    direction: wp.array[wp.vec3]
    along: wp.array[wp.vec3]


_SOLVE = """
#define INLINE __attribute__((always_inline))
    const int parts = matrix.parts, width = matrix.width, blocks = team.blocks;
    const int first = unknowns.of_worlds.data[world], rows = unknowns.of_worlds.data[world + 1] - first;
    const int* is_free = unknowns.is_free.data + first;
    const int first_coupled = contacts.coupled_first.data[world];
    const int coupled = contacts.coupled_end.data[world] - first_coupled;
    float* pulls = (float*)(contacts.pull.data + first_coupled);
    float* direction = (float*)(vectors.direction.data + first);
    float* solution = (float*)(vectors.solution.data + first);
    float* residual = (float*)(vectors.residual.data + first);
    float* along = (float*)(vectors.along.data + first);
#if defined(__CUDA_ARCH__)
    __shared__ float shared_direction[3 * 1024], shared_pulls[3 * 512];
    __shared__ float sums_of_warps[2][32];
    typedef float real;
    const int lane = threadIdx.x, threads = blockDim.x;
    if (team.shares) direction = shared_direction;
    if (blocks == 1 && coupled <= 512) pulls = shared_pulls;
    int turn = 0;
    auto wait = [&]() {
        ++turn;
        __syncthreads();
        if (blocks > 1) {
            if (lane == 0) {
                __threadfence();
                atomicAdd(&team.arrived.data[world], 1);
                while (*(volatile int*)&team.arrived.data[world] < turn * blocks) {}
                __threadfence();
            }
            __syncthreads();
        }
    };
    // in single precision: a sum of a tree of warps is as good as its terms
    auto sum = [&](float value) INLINE {
        float* sums = sums_of_warps[turn & 1];
        for (int offset = 16; offset; offset >>= 1) value += __shfl_xor_sync(~0u, value, offset);
        if ((lane & 31) == 0) sums[lane >> 5] = value;
        __syncthreads();
        value = 0.0f;
        for (int warp = 0; warp < threads >> 5; ++warp) value += sums[warp];
        if (blocks == 1) {
            ++turn;
            return value;
        }
        float* of_blocks = team.sums.data + (2 * world + (turn & 1)) * blocks;
        if (lane == 0) of_blocks[block] = value;
        wait();
        value = 0.0f;
        for (int other = 0; other < blocks; ++other) value += ((volatile float*)of_blocks)[other];
        return value;
    };
    const unsigned sharers = (parts == 32 ? ~0u : (1u << parts) - 1u) << (lane & 31 & ~(parts - 1));
    auto sum_of_parts = [&](float value) INLINE {
        for (int offset = parts / 2; offset; offset >>= 1) value += __shfl_xor_sync(sharers, value, offset);
        return value;
    };
#else
    const int lane = 0, threads = 1;
    auto wait = []() {};
    auto sum = [](double value) { return value; };
    typedef double real;
    auto sum_of_parts = [](float value) { return value; };
#endif
    const int part = lane % parts, stride = blocks * threads / parts, begin = (block * threads + lane) / parts;
    // a thread with one row has what it needs of it in registers: also some blocks
    const bool keeps = KEPT > 0 && rows <= stride;
    wp::vec3 own_x, own_r, own_z;
    auto get = [&](const wp::vec3& own, const float* all, int row) {
        return keeps ? own : wp::vec3(all[3 * row], all[3 * row + 1], all[3 * row + 2]);
    };
    auto put = [&](wp::vec3& own, float* all, int row, const wp::vec3& value) {
        if (keeps) own = value;
        else for (int c = 0; c < 3; ++c) all[3 * row + c] = value[c];
    };
    const int* first_entries = matrix.first.data + matrix.group.data[world];
    auto first_entry = [&](int row) { return first_entries + (row * parts + part) / width; };
    const int of_group = (begin * parts + part) % width;  // so it is for all rows of the thread
    float kept[KEPT + 1][9];
    int kept_column[KEPT + 1];
    wp::mat33 own_inverse;
    if (keeps && begin < rows) {
        own_inverse = vectors.inverse.data[first + begin];
        const int entry = first_entry(begin)[0], end = first_entry(begin)[1];
#pragma unroll
        for (int k = 0; k < KEPT; ++k) {
            const int at = (entry + k) * width + of_group;
            const int column = entry + k < end ? matrix.column.data[at] : -1;
            kept_column[k] = column < 0 ? 0 : 3 * (column - first);
            for (int c = 0; c < 9; ++c)
                kept[k][c] = column < 0 ? 0.0f : matrix.value.data[9 * (at - of_group) + c * width + of_group];
        }
    }
    auto pull = [&](const float* p) INLINE {  // products of contacts that couple with a vector
        if (coupled == 0) return;
        for (int n = block * threads + lane; n < coupled; n += blocks * threads) {
            const int i = contacts.coupled.data[first_coupled + n];
            const wp::vec4i corners = contacts.coupled_unknowns.data[first_coupled + n];
            const wp::vec4 weights = contacts.weights.data[i];
            wp::vec3 apart;
            for (int j = 0; j < 4; ++j) {
                const int u = corners[j];
                const float* d = p + 3 * (u >= 0 ? u - first : u < -1 ? -2 - u - first : 0);
                const float weight = u == -1 ? 0.0f : weights[j];
                apart += weight * wp::vec3(d[0], d[1], d[2]);
                if (u < -1)  // of a body: its turn follows its shift
                    apart += weight * wp::cross(
                        wp::vec3(d[3], d[4], d[5]), unknowns.arm.data[contacts.corners.data[i][j]]
                    );
            }
            apart = wp::mul(contacts.hessian.data[i], apart);
            for (int c = 0; c < 3; ++c) pulls[3 * n + c] = apart[c];
        }
        wait();
    };
    auto multiply = [&](int row, const float* p) INLINE {
        const int u = first + row;
        wp::vec3 total;
        int entry = first_entry(row)[0];
        const int end = first_entry(row)[1];
        if (keeps) {
#pragma unroll
            for (int k = 0; k < KEPT; ++k) {
                const float* d = p + kept_column[k];
                for (int c = 0; c < 3; ++c)
                    total[c] += kept[k][3 * c] * d[0] + kept[k][3 * c + 1] * d[1] + kept[k][3 * c + 2] * d[2];
            }
            entry += KEPT;
        }
        const float* v = matrix.value.data + 9 * entry * width + of_group;
        for (; entry < end; ++entry, v += 9 * width) {
            const int column = matrix.column.data[entry * width + of_group];
            if (column < 0) break;
            const float* d = p + 3 * (column - first);
            for (int c = 0; c < 3; ++c)
                total[c] += v[3 * c * width] * d[0] + v[(3 * c + 1) * width] * d[1] + v[(3 * c + 2) * width] * d[2];
        }
        if (coupled) {
            const bool of_body = unknowns.particle.data[u] < 0;
#pragma unroll 4
            for (int n = contacts.middle.data[u] + part; n < contacts.end.data[u]; n += parts) {
                const float* by = pulls + 3 * contacts.pulled.data[n];
                const float weight = contacts.entry_weight.data[n];
                wp::vec3 force(weight * by[0], weight * by[1], weight * by[2]);
                if (of_body) {
                    const int entry = contacts.entries.data[n];
                    const int vertex = contacts.corners.data[entry >> 2][entry & 3];
                    if (unknowns.of_vertex.data[vertex] == -1 - u)
                        force = wp::cross(unknowns.arm.data[vertex], force);
                }
                total += force;
            }
        }
        for (int c = 0; c < 3; ++c) total[c] = sum_of_parts(total[c]);
        return total;
    };
    pull(solution);
    real own = 0.0f;
    for (int row = begin; row < rows; row += stride) {
        wp::vec3 r;
        if (is_free[row]) r = -vectors.gradient.data[first + row] - multiply(row, solution);
        if (part) continue;
        const wp::vec3 z = wp::mul(vectors.inverse.data[first + row], r);
        if (keeps) own_x = vectors.solution.data[first + row];
        put(own_r, residual, row, r);
        for (int c = 0; c < 3; ++c) direction[3 * row + c] = z[c];
        own += wp::dot(r, z);
    }
    real squared = sum(own);
    const real limit = tolerance * tolerance * squared;
    int count = 0;
    bool goes_on = squared > 0.0f;
    while (goes_on) {
        pull(direction);
        own = 0.0f;
        for (int row = begin; row < rows; row += stride) {
            if (!is_free[row]) continue;
            const wp::vec3 p = multiply(row, direction);
            if (part) continue;
            put(own_z, along, row, p);
            own += direction[3 * row] * p[0] + direction[3 * row + 1] * p[1] + direction[3 * row + 2] * p[2];
        }
        const real curvature = sum(own);
        const bool is_convex = curvature > 0.0f;
        float step = 0.0f;
        if (is_convex) step = (float)(squared / curvature);
        else if (count == 0) step = (float)(squared / wp::max(-curvature, (real)1e-30f + (real)0.01f * squared));
        ++count;
        own = 0.0f;
        for (int row = begin; row < rows; row += stride) {
            if (!is_free[row] || part) continue;
            const wp::vec3 d(direction[3 * row], direction[3 * row + 1], direction[3 * row + 2]);
            const wp::vec3 x = get(own_x, solution, row) + step * d;
            const wp::vec3 r = get(own_r, residual, row) - step * get(own_z, along, row);
            const wp::vec3 z = wp::mul(keeps ? own_inverse : vectors.inverse.data[first + row], r);
            put(own_x, solution, row, x);
            put(own_r, residual, row, r);
            put(own_z, along, row, z);
            own += wp::dot(r, z);
        }
        const real after = sum(own);
        goes_on = is_convex && after > limit && count < max_iterations;
        const float momentum = (float)(after / squared);
        squared = after;
        if (!goes_on) break;
        for (int row = begin; row < rows; row += stride) {
            if (!is_free[row] || part) continue;
            const wp::vec3 z = get(own_z, along, row);
            for (int c = 0; c < 3; ++c) direction[3 * row + c] = z[c] + momentum * direction[3 * row + c];
        }
        wait();
    }
    if (keeps && part == 0 && begin < rows && is_free[begin]) vectors.solution.data[first + begin] = own_x;
    return count;
"""


@functools.cache
def make_solve_kernel(threads: int):
    """Returns the kernel that solves for worlds, by blocks of so many threads.

    By hand, with plain pointers and registers: most of an iteration would otherwise be arithmetic of addresses, and
    waiting for memory.
    """
    bounds = min(size for size in _KEPT if threads <= size)
    kept = 0 if threads == 1 else _KEPT[bounds]

    @wp.func_native(snippet=_SOLVE.replace("KEPT", str(kept)))
    def solve(
        matrix: Matrix,
        contacts: Contacts,
        unknowns: Unknowns,
        tolerance: float,
        max_iterations: int,
        team: Team,
        vectors: Vectors,
        world: int,
        block: int,
    ) -> int: ...

    @wp.kernel(module="unique", enable_backward=False, launch_bounds=bounds)
    def solve_worlds(
        # in
        matrix: Matrix,
        contacts: Contacts,
        unknowns: Unknowns,
        active: wp.array[int],
        tolerance: float,
        max_iterations: int,
        team: Team,
        # in and out
        vectors: Vectors,
        # out
        iterations: wp.array[int],
    ):
        """Solves H d = -g in active worlds, until the norm of the residual, preconditioned, is a share of its first.

        Where the matrix is found not to be positive definite, the solution so far ends the solve, or the preconditioned
        negative gradient if there is none: both are directions in which the energy falls. What is given stays given.
        """
        thread = wp.tid()
        number, lane = thread // wp.block_dim(), thread % wp.block_dim()
        world, block = number // team.blocks, number % team.blocks
        if active[world] == 0:
            return
        count = solve(matrix, contacts, unknowns, tolerance, max_iterations, team, vectors, world, block)
        if block == 0 and lane == 0:
            iterations[world] = iterations[world] + count

    return solve_worlds
