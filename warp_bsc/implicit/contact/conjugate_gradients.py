"""Conjugate gradients that stop at negative curvature, each world by one block of threads."""

import warp as wp

from .matrix import Matrix
from .system import Contacts, Unknowns

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
        residual, direction, along: Of the iteration; the last is the product with the direction, and then the residual
            as it is preconditioned.
    """

    gradient: wp.array[wp.vec3]
    inverse: wp.array[wp.mat33]
    solution: wp.array[wp.vec3]
    residual: wp.array[wp.vec3]
    direction: wp.array[wp.vec3]
    along: wp.array[wp.vec3]


@wp.func_native(
    snippet="""
    const int parts = matrix.parts, width = matrix.width, blocks = team.blocks;
    const int first = unknowns.of_worlds.data[world], rows = unknowns.of_worlds.data[world + 1] - first;
    const int* is_free = unknowns.is_free.data + first;
    const wp::mat33* inverse = vectors.inverse.data + first;
    float* solution = (float*)(vectors.solution.data + first);
    float* residual = (float*)(vectors.residual.data + first);
    float* along = (float*)(vectors.along.data + first);
    const int first_coupled = contacts.coupled_first.data[world], end_coupled = contacts.coupled_end.data[world];
    const bool couples = end_coupled > first_coupled;
    int turn = 0;
#if defined(__CUDA_ARCH__)
    __shared__ float shared[3 * 1024];
    __shared__ double sums_of_warps[2][32];
    const int lane = threadIdx.x, threads = blockDim.x;
    float* direction = team.shares ? shared : (float*)(vectors.direction.data + first);
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
    auto sum_of_block = [&](double value) {
        double* sums = sums_of_warps[turn & 1];
        for (int offset = 16; offset; offset >>= 1) value += __shfl_xor_sync(~0u, value, offset);
        if ((lane & 31) == 0) sums[lane >> 5] = value;
        __syncthreads();
        value = (lane & 31) < (threads >> 5) ? sums[lane & 31] : 0.0;
        for (int offset = 16; offset; offset >>= 1) value += __shfl_xor_sync(~0u, value, offset);
        return value;
    };
    auto sum = [&](double value) {
        if (blocks == 1) {
            ++turn;
            return sum_of_block(value);
        }
        value = sum_of_block(value);
        double* sums = team.sums.data + (2 * world + ((turn + 1) & 1)) * blocks;
        if (lane == 0) sums[block] = value;
        wait();
        value = 0.0;
        for (int other = 0; other < blocks; ++other) value += sums[other];
        return value;
    };
    const unsigned sharers = (parts == 32 ? ~0u : (1u << parts) - 1u) << (lane & 31 & ~(parts - 1));
    auto sum_of_parts = [&](float value) {
        for (int offset = parts / 2; offset; offset >>= 1) value += __shfl_xor_sync(sharers, value, offset);
        return value;
    };
#else
    const int lane = 0, threads = 1;
    float* direction = (float*)(vectors.direction.data + first);
    auto wait = []() {};
    auto sum = [](double value) { return value; };
    auto sum_of_parts = [](float value) { return value; };
#endif
    const int part = lane % parts, stride = blocks * threads / parts, begin = (block * threads + lane) / parts;
    auto pull = [&](const float* p) {  // products of contacts that couple with a vector
        if (!couples) return;
        for (int n = first_coupled + block * threads + lane; n < end_coupled; n += blocks * threads) {
            const int i = contacts.coupled.data[n];
            const wp::vec4i corners = contacts.corners.data[i];
            const wp::vec4 weights = contacts.weights.data[i];
            float x = 0.0f, y = 0.0f, z = 0.0f;
            for (int j = 0; j < 4; ++j) {
                const int u = unknowns.of_vertex.data[corners[j]];
                if (weights[j] == 0.0f || u == -1) continue;
                const float* d = p + 3 * ((u >= 0 ? u : -2 - u) - first);
                x += weights[j] * d[0];
                y += weights[j] * d[1];
                z += weights[j] * d[2];
                if (u < -1) {  // of a body: its turn follows its shift
                    const wp::vec3 arm = unknowns.arm.data[corners[j]];
                    x += weights[j] * (d[4] * arm[2] - d[5] * arm[1]);
                    y += weights[j] * (d[5] * arm[0] - d[3] * arm[2]);
                    z += weights[j] * (d[3] * arm[1] - d[4] * arm[0]);
                }
            }
            contacts.pull.data[i] = wp::mul(contacts.hessian.data[i], wp::vec3(x, y, z));
        }
        wait();
    };
    auto multiply = [&](int row, const float* p, float* result) {
        const int thread = row * parts + part, u = first + row;
        const int group = matrix.group.data[world] + thread / width, end = matrix.first.data[group + 1];
        int entry = matrix.first.data[group];
        const float* v = matrix.value.data + 9 * entry * width + thread % width;
        const int* column = matrix.column.data + entry * width + thread % width;
        float x = 0.0f, y = 0.0f, z = 0.0f;
#if defined(__CUDA_ARCH__)
#pragma unroll 4
#endif
        for (; entry < end; ++entry, v += 9 * width, column += width) {
            const int c = *column;
            if (c < 0) continue;
            const float* d = p + 3 * (c - first);
            x += v[0] * d[0] + v[width] * d[1] + v[2 * width] * d[2];
            y += v[3 * width] * d[0] + v[4 * width] * d[1] + v[5 * width] * d[2];
            z += v[6 * width] * d[0] + v[7 * width] * d[1] + v[8 * width] * d[2];
        }
        if (couples) {
            const bool of_body = unknowns.particle.data[u] < 0;
            for (int n = contacts.middle.data[u] + part; n < contacts.end.data[u]; n += parts) {
                const int i = contacts.entries.data[n] >> 2, place = contacts.entries.data[n] & 3;
                wp::vec3 force = contacts.weights.data[i][place] * contacts.pull.data[i];
                const int vertex = of_body ? contacts.corners.data[i][place] : 0;
                if (of_body && unknowns.of_vertex.data[vertex] == -1 - u)
                    force = wp::cross(unknowns.arm.data[vertex], force);
                x += force[0];
                y += force[1];
                z += force[2];
            }
        }
        result[0] = sum_of_parts(x);
        result[1] = sum_of_parts(y);
        result[2] = sum_of_parts(z);
    };
    pull(solution);
    double own = 0.0;
    for (int row = begin; row < rows; row += stride) {
        wp::vec3 r, p;
        if (is_free[row]) {
            multiply(row, solution, &p[0]);
            r = -vectors.gradient.data[first + row] - p;
        }
        if (part == 0) {
            const wp::vec3 z = wp::mul(inverse[row], r);
            for (int c = 0; c < 3; ++c) {
                residual[3 * row + c] = r[c];
                direction[3 * row + c] = z[c];
            }
            own += wp::dot(r, z);
        }
    }
    double squared = sum(own);
    const double limit = tolerance * tolerance * squared;
    int count = 0;
    bool goes_on = squared > 0.0;
    while (goes_on) {
        pull(direction);
        own = 0.0;
        for (int row = begin; row < rows; row += stride) {
            if (!is_free[row]) continue;
            wp::vec3 p;
            multiply(row, direction, &p[0]);
            if (part != 0) continue;
            for (int c = 0; c < 3; ++c) along[3 * row + c] = p[c];
            const float* d = direction + 3 * row;
            own += d[0] * p[0] + d[1] * p[1] + d[2] * p[2];
        }
        const double curvature = sum(own);
        const bool is_convex = curvature > 0.0;
        float step = 0.0f;
        if (is_convex) step = (float)(squared / curvature);
        else if (count == 0) step = (float)(squared / wp::max(-curvature, 1e-30 + 0.01 * squared));
        ++count;
        own = 0.0;
        for (int row = begin; row < rows; row += stride) {
            if (!is_free[row] || part != 0) continue;
            wp::vec3 r;
            for (int c = 0; c < 3; ++c) {
                solution[3 * row + c] += step * direction[3 * row + c];
                residual[3 * row + c] = r[c] = residual[3 * row + c] - step * along[3 * row + c];
            }
            const wp::vec3 z = wp::mul(inverse[row], r);
            for (int c = 0; c < 3; ++c) along[3 * row + c] = z[c];
            own += wp::dot(r, z);
        }
        const double after = sum(own);
        goes_on = is_convex && after > limit && count < max_iterations;
        const float momentum = (float)(after / squared);
        squared = after;
        if (!goes_on) break;
        for (int row = begin; row < rows; row += stride) {
            if (!is_free[row] || part != 0) continue;
            for (int c = 0; c < 3; ++c)
                direction[3 * row + c] = along[3 * row + c] + momentum * direction[3 * row + c];
        }
        wait();
    }
    return count;
"""
)
def _solve(
    matrix: Matrix,
    contacts: Contacts,
    unknowns: Unknowns,
    tolerance: wp.float64,
    max_iterations: int,
    team: Team,
    vectors: Vectors,
    world: int,
    block: int,
) -> int:
    """Solves for a world by the threads of one block, or several, and returns the number of iterations.

    By hand, with plain pointers: most of an iteration would otherwise be the arithmetic of addresses.
    """
    ...


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
    count = _solve(matrix, contacts, unknowns, tolerance, max_iterations, team, vectors, world, block)
    if block == 0 and lane == 0:
        iterations[world] = iterations[world] + count
