"""Linear solves with the matrix of a step, for all worlds by one launch: the threads of a world stay with it.

References:
    H. A. van der Vorst, Bi-CGSTAB: A Fast and Smoothly Converging Variant of Bi-CG, SIAM Journal on Scientific and
    Statistical Computing 13(2), 1992, doi:10.1137/0913035.
"""

import math
from enum import IntEnum

import numpy as np
import warp as wp

from ..contact.team import wait_for_team
from .matrix_kernels import Matrix, row_product

wp.set_module_options({"enable_backward": False})

_BLOCK, _PARTS = 512, 4
"""Threads of a block on a GPU, and those of them that share a row."""
_ZERO = wp.constant(wp.float64(0.0))
_LEAST_SQUARE = wp.constant(wp.float64(1e-200))
"""Squared norm of a right-hand side at or below which it counts as 0."""
_AIM = wp.constant(wp.float64(0.25))
"""Squared norm of the residual at which iterations end, relative to the largest allowed.

The residual that iterations update drifts from the true one, which decides.
"""
_ATTEMPTS = wp.constant(6)
"""Residuals that are computed anew, each but the last for a solve from the solution of the one before."""


class Vector(IntEnum):
    """Vectors of a solve, those of the method; all are scaled as the matrix."""

    X = 0
    """The solution."""
    R = 1
    """The residual."""
    SHADOW = 2
    """The residual at the start."""
    P = 3
    """The direction."""
    V = 4
    """The product with it."""
    S = 5
    """The residual in the middle of an iteration."""


@wp.struct
class Team:
    """The threads that solve for a world: one block, or several that wait for each other."""

    blocks: int
    parts: int  # threads that share a row, a power of 2
    arrived: wp.array[int]  # how often blocks have waited for the others, shape [worlds]
    sums: wp.array2d[wp.vec2d]  # two of each block of each world, shape [worlds, 2 blocks]


@wp.func_native(
    snippet="""
#if defined(__CUDA_ARCH__)
    __shared__ double of_warps[2][32];
    for (int c = 0; c < 2; ++c) {
        for (int offset = 16; offset > 0; offset /= 2) value[c] += __shfl_xor_sync(~0u, value[c], offset);
        if (threadIdx.x % 32 == 0) of_warps[c][threadIdx.x / 32] = value[c];
    }
    __syncthreads();
    for (int c = 0; c < 2; ++c) {
        value[c] = 0.0;
        for (int k = 0; k < blockDim.x / 32; ++k) value[c] += of_warps[c][k];
    }
    __syncthreads();
#endif
    return value;
"""
)
def _sum_of_block(value: wp.vec2d) -> wp.vec2d:
    """Returns the sum of the values of all threads of a block, in each of them."""
    ...


@wp.func
def _sum(value: wp.vec2d, team: Team, world: int, block: int, turn: int) -> wp.vec2d:
    """Returns the sum of the values of all threads of a world; ``turn`` is 0 in one sum, and 1 in the next."""
    total = _sum_of_block(value)
    if team.blocks > 1:
        team.sums[world, turn * team.blocks + block] = total
        wait_for_team(team.arrived, world, team.blocks)
        total = wp.vec2d()
        for k in range(team.blocks):
            total += team.sums[world, turn * team.blocks + k]
    return total


@wp.kernel(enable_backward=False, launch_bounds=_BLOCK)
def solve_worlds(
    # in
    matrix: Matrix,
    b: wp.array[wp.vec3d],
    of_worlds: wp.array[int],
    tolerance: wp.float64,
    max_iterations: int,
    failure: wp.float64,
    team: Team,
    # in and out
    of: wp.array2d[wp.vec3d],
    # out
    x: wp.array[wp.vec3d],
    failed: wp.array[int],
):
    """Solves A x = b in each world by BiCGSTAB, preconditioned from both sides; x of what fails is ``failure``."""
    number, lane = wp.tid() // wp.block_dim(), wp.tid() % wp.block_dim()
    world, block, parts = number // team.blocks, number % team.blocks, team.parts
    thread, part = block * wp.block_dim() + lane, lane % parts
    first, end, step = of_worlds[world] + thread // parts, of_worlds[world + 1], team.blocks * wp.block_dim() // parts
    solved, attempt, iterations, limit = bool(False), int(0), int(0), wp.float64(0.0)
    for i in range(first, end, step):
        if part == 0:
            of[int(Vector.X), i] = wp.vec3d()
    while attempt < _ATTEMPTS and not solved:
        wait_for_team(team.arrived, world, team.blocks)
        squares, rho = wp.vec2d(), wp.vec2d()
        for i in range(first, end, step):
            product = row_product(matrix, i, of[int(Vector.X)], part, parts)
            if part == 0:
                r = wp.transpose(matrix.roots[i]) * b[i] - product
                of[int(Vector.R), i] = r
                of[int(Vector.SHADOW), i] = r
                of[int(Vector.P), i] = r
                squares += wp.vec2d(wp.dot(r, wp.cw_mul(matrix.eigenvalues[i], r)), wp.length_sq(b[i]))
                rho += wp.vec2d(wp.length_sq(r), _ZERO)
        squares = _sum(squares, team, world, block, 0)
        rho = _sum(rho, team, world, block, 1)
        if attempt == 0:
            limit = tolerance * tolerance * squares[1]
        solved = squares[0] <= limit or squares[1] <= _LEAST_SQUARE
        attempt = wp.where(iterations < max_iterations and wp.isfinite(squares[0]), attempt + 1, _ATTEMPTS)
        goes_on = not solved and attempt < _ATTEMPTS
        while goes_on:
            iterations += 1
            wait_for_team(team.arrived, world, team.blocks)
            along, halves, rest = wp.vec2d(), wp.vec2d(), wp.vec2d()
            for i in range(first, end, step):
                v = row_product(matrix, i, of[int(Vector.P)], part, parts)
                if part == 0:
                    of[int(Vector.V), i] = v
                    along += wp.vec2d(wp.dot(of[int(Vector.SHADOW), i], v), _ZERO)
            along = _sum(along, team, world, block, 0)
            alpha = wp.where(along[0] == _ZERO, _ZERO, rho[0] / along[0])
            for i in range(first, end, step):
                if part == 0:
                    of[int(Vector.S), i] = of[int(Vector.R), i] - alpha * of[int(Vector.V), i]
            wait_for_team(team.arrived, world, team.blocks)
            for i in range(first, end, step):
                t = row_product(matrix, i, of[int(Vector.S)], part, parts)
                if part == 0:
                    of[int(Vector.R), i] = t  # until omega is known
                    halves += wp.vec2d(wp.dot(t, of[int(Vector.S), i]), wp.length_sq(t))
            halves = _sum(halves, team, world, block, 1)
            omega = wp.where(halves[1] == _ZERO, _ZERO, halves[0] / halves[1])
            for i in range(first, end, step):
                if part == 0:
                    s = of[int(Vector.S), i] + wp.vec3d()
                    r = s - omega * of[int(Vector.R), i]
                    of[int(Vector.X), i] = of[int(Vector.X), i] + alpha * of[int(Vector.P), i] + omega * s
                    of[int(Vector.R), i] = r
                    rest += wp.vec2d(
                        wp.dot(of[int(Vector.SHADOW), i], r), wp.dot(r, wp.cw_mul(matrix.eigenvalues[i], r))
                    )
            rest = _sum(rest, team, world, block, 0)
            beta = rest[0] / rho[0] * alpha / omega  # not finite where something was 0: solves begin anew
            for i in range(first, end, step):
                if part == 0:
                    p = of[int(Vector.P), i] - omega * of[int(Vector.V), i]
                    of[int(Vector.P), i] = of[int(Vector.R), i] + beta * p
            rho = wp.vec2d(rest[0], _ZERO)
            goes_on = rest[1] > _AIM * limit and wp.isfinite(beta) and beta != _ZERO and iterations < max_iterations
            if not wp.isfinite(rest[1]):  # nothing goes on from there
                attempt = int(_ATTEMPTS)
    for i in range(first, end, step):
        if part == 0:
            x[i] = wp.vec3d(failure, failure, failure)
            if solved:
                x[i] = matrix.roots[i] * of[int(Vector.X), i]
    if thread == 0:
        failed[world] = int(not solved)


class LinearSolver:
    """Solves A x = b, preconditioned by the blocks of the diagonal; A need be neither symmetric nor definite.

    Worlds are independent systems, each of which stops when its residual is small enough. Nothing is read by the host.

    Attributes:
        failed: 1 for worlds whose last system was not solved, int32, shape [world_count].
    """

    def __init__(self, of_worlds: wp.array, *, tolerance: float, max_iterations: int):
        """Allocates buffers.

        Args:
            of_worlds: First unknown of each world, and the end of the last, int32.
            tolerance: Largest norm of the residual of a solution, relative to that of the right-hand side.
            max_iterations: Number of iterations after which a solve ends.
        """
        self._of_worlds, self._limits = of_worlds, [wp.float64(tolerance), max_iterations]
        device, first = of_worlds.device, of_worlds.numpy()
        worlds, team = len(first) - 1, Team()
        self._team, self._threads = team, 1
        team.blocks = team.parts = 1
        if device.is_cuda:
            # blocks that wait for each other must run together: one on each multiprocessor
            needed = -(-_PARTS * int(np.diff(first).max()) // _BLOCK)
            team.parts, team.blocks = _PARTS, int(np.clip(device.sm_count // worlds, 1, needed))
            self._threads = worlds * team.blocks * _BLOCK
        else:
            self._threads = worlds
        team.arrived = wp.zeros(worlds, dtype=int, device=device)
        team.sums = wp.zeros((worlds, 2 * team.blocks), dtype=wp.vec2d, device=device)
        self._vectors = wp.zeros((len(Vector), int(first[-1])), dtype=wp.vec3d, device=device)
        self._solution = wp.zeros(int(first[-1]), dtype=wp.vec3d, device=device)
        self.failed = wp.zeros(worlds, dtype=int, device=device)

    def solve(self, matrix: Matrix, b: wp.array, failure: float = math.nan) -> wp.array:
        """Returns the solution x of A x = b; the next call overwrites it.

        Args:
            matrix: A.
            b: The right-hand side, vec3d, shape [unknown_count].
            failure: The solution of worlds that were not solved.
        """
        self._team.arrived.zero_()
        inputs = [matrix, b, self._of_worlds, *self._limits, wp.float64(failure), self._team]
        options = {"outputs": [self._vectors, self._solution, self.failed], "device": self._solution.device}
        wp.launch(solve_worlds, self._threads, inputs=inputs, **options, block_dim=_BLOCK)
        return self._solution
