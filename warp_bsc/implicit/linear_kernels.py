"""Krylov solves in one launch: the threads of a cluster make all iterations for a world, and wait for each other.

In most scenes an iteration takes less time than the launches of its kernels. What is left is waiting, so the iterations
are those that wait once for each product with the matrix: in the pipelined methods, products of vectors follow from
recurrences, and sums over all particles are complete when the next product begins (Ghysels and Vanroose 2014; Cools and
Vanroose 2017).
"""

import warp as wp

from ..response.solve.cluster import CLUSTER, wait_for_others
from .matrix_kernels import Matrix, row_product

wp.set_module_options({"enable_backward": False})

BLOCK = 512
"""Threads of a block."""
PARTS = 4
"""Threads of a particle on a GPU: they share the blocks of its row, and three of them own a component each."""

_ZERO = wp.constant(wp.float64(0.0))
_TWO = wp.constant(wp.float64(2.0))
_LEAST_SQUARE = wp.constant(wp.float64(1e-200))
"""Squared norm of a right-hand side at or below which it counts as 0."""
_AIM = wp.constant(wp.float64(0.25))
"""Squared norm of the residual at which iterations end, relative to the largest allowed.

The residual that iterations update drifts from the true one, which decides.
"""
_ATTEMPTS = wp.constant(5)
"""Solves that are tried, each from the solution of the one before: its residual is computed anew."""


@wp.struct
class Vectors:
    """Vectors of a solve, each of shape [particle_count].

    Attributes:
        x: The solution, scaled as the matrix.
        residual: b - A x; ``shadow``: the residual at the beginning (BiCGSTAB).
        direction: The search direction; ``along``: A times it; ``beyond``: A times that.
        products: A times the residual, of this iteration and the next in turn (conjugate residuals), or of this one and
            A times that (BiCGSTAB), shape [2, particle_count].
        last: A times ``beyond`` (BiCGSTAB).
    """

    x: wp.array[wp.vec3d]
    residual: wp.array[wp.vec3d]
    shadow: wp.array[wp.vec3d]
    direction: wp.array[wp.vec3d]
    along: wp.array[wp.vec3d]
    beyond: wp.array[wp.vec3d]
    products: wp.array2d[wp.vec3d]
    last: wp.array[wp.vec3d]


@wp.struct
class Team:
    """The threads that solve for a world.

    Attributes:
        world: The world.
        lane: Number of this thread among them.
        blocks: Number of blocks of threads.
        part, parts: Which part of a row the thread computes, of how many; it owns components part, part + parts, ...
        begin, end, stride: The particles of the thread.
        partials: Sums of each block of threads, of two sums in turn, shape [world_count, 2, blocks].
    """

    world: int
    lane: int
    blocks: int
    part: int
    parts: int
    begin: int
    end: int
    stride: int
    partials: wp.array3d[wp.vec4d]


@wp.func
def _sum(team: Team, turn: int, values: wp.vec4d) -> wp.vec4d:
    """Returns the sums of values over all threads, the same in each, after all have come here.

    Between two calls with the same ``turn``, 0 or 1, threads have to wait for each other elsewhere.
    """
    of_block = wp.tile_sum(wp.tile(values, preserve_type=True))
    if team.lane % wp.block_dim() == 0:
        team.partials[team.world, turn, team.lane // wp.block_dim()] = of_block[0]
    wait_for_others()
    total = wp.vec4d()
    for block in range(team.blocks):
        total += team.partials[team.world, turn, block]
    return total


@wp.func
def _begin(team: Team, matrix: Matrix, b: wp.array[wp.vec3d], of: Vectors) -> wp.vec4d:
    """Computes the residual b - A x; returns the squared norms of the residual and of b."""
    wait_for_others()
    sums = wp.vec4d()
    for i in range(team.begin, team.end, team.stride):
        residual = wp.transpose(matrix.roots[i]) * b[i] - row_product(matrix, i, of.x, team.part, team.parts)
        for c in range(team.part, 3, team.parts):
            of.residual[i][c] = residual[c]
            sums += wp.vec4d(_square(matrix, i, c, residual[c]), b[i][c] * b[i][c], _ZERO, _ZERO)
    return _sum(team, 0, sums)


@wp.func
def _square(matrix: Matrix, i: int, c: int, residual: wp.float64) -> wp.float64:
    """Returns the share of a component in the squared norm of the residual before it was scaled."""
    return residual * residual * matrix.eigenvalues[i][c]


@wp.func
def _conjugate_residuals(team: Team, matrix: Matrix, of: Vectors, limit: wp.float64, most: int) -> int:
    """Makes iterations of pipelined conjugate residuals, which need a symmetric matrix; returns their number.

    The squared norm of A times the next direction follows from sums over the last one.
    """
    wait_for_others()
    sums = wp.vec4d()
    for i in range(team.begin, team.end, team.stride):
        product = row_product(matrix, i, of.residual, team.part, team.parts)
        for c in range(team.part, 3, team.parts):
            residual, along = of.residual[i][c], product[c]
            of.products[0, i][c] = along
            of.direction[i][c] = _ZERO
            of.along[i][c] = _ZERO
            of.beyond[i][c] = _ZERO
            sums += wp.vec4d(residual * along, along * along, _ZERO, _square(matrix, i, c, residual))
    sums = _sum(team, 1, sums)
    curvature, length, momentum = sums[0], sums[1], wp.float64(0.0)
    iteration = int(0)
    while iteration < most and sums[3] > limit and curvature != _ZERO and length > _ZERO:  # not so for NaN
        step = curvature / length
        now = iteration % 2
        sums = wp.vec4d()
        for i in range(team.begin, team.end, team.stride):
            product = row_product(matrix, i, of.products[now], team.part, team.parts)
            for c in range(team.part, 3, team.parts):
                before = of.products[now, i][c]
                beyond = product[c] + momentum * of.beyond[i][c]
                along = before + momentum * of.along[i][c]
                direction = of.residual[i][c] + momentum * of.direction[i][c]
                residual = of.residual[i][c] - step * along
                after = before - step * beyond
                of.beyond[i][c] = beyond
                of.along[i][c] = along
                of.direction[i][c] = direction
                of.x[i][c] += step * direction
                of.residual[i][c] = residual
                of.products[1 - now, i][c] = after
                sums += wp.vec4d(residual * after, after * after, after * along, _square(matrix, i, c, residual))
        sums = _sum(team, now, sums)
        momentum = sums[0] / curvature
        curvature = sums[0]
        length = sums[1] + momentum * (_TWO * sums[2] + momentum * length)
        iteration += 1
    return iteration


@wp.func
def _bicgstab(team: Team, matrix: Matrix, of: Vectors, limit: wp.float64, most: int) -> int:
    """Makes iterations of pipelined BiCGSTAB, for any matrix; returns their number."""
    wait_for_others()
    sums = wp.vec4d()
    for i in range(team.begin, team.end, team.stride):
        product = row_product(matrix, i, of.residual, team.part, team.parts)
        for c in range(team.part, 3, team.parts):
            residual = of.residual[i][c]
            of.products[0, i][c] = product[c]
            of.shadow[i][c] = residual
            of.direction[i][c] = _ZERO
            of.along[i][c] = _ZERO
            of.beyond[i][c] = _ZERO
            of.last[i][c] = _ZERO
            sums += wp.vec4d(residual * residual, residual * product[c], _square(matrix, i, c, residual), _ZERO)
    sums = _sum(team, 1, sums)
    correlation, divisor, momentum, smoothing = sums[0], sums[1], wp.float64(0.0), wp.float64(0.0)
    iteration = int(0)
    while iteration < most and sums[2] > limit and correlation != _ZERO and divisor != _ZERO:  # not so for NaN
        step = correlation / divisor
        sums = wp.vec4d()
        for i in range(team.begin, team.end, team.stride):
            product = row_product(matrix, i, of.products[0], team.part, team.parts)
            for c in range(team.part, 3, team.parts):
                residual, before, shadow = of.residual[i][c], of.products[0, i][c], of.shadow[i][c]
                direction = residual + momentum * (of.direction[i][c] - smoothing * of.along[i][c])
                along = before + momentum * (of.along[i][c] - smoothing * of.beyond[i][c])
                beyond = product[c] + momentum * (of.beyond[i][c] - smoothing * of.last[i][c])
                of.products[1, i][c] = product[c]
                of.direction[i][c] = direction
                of.along[i][c] = along
                of.beyond[i][c] = beyond
                half, of_half = residual - step * along, before - step * beyond
                sums += wp.vec4d(half * of_half, of_half * of_half, shadow * along, shadow * beyond)
        sums = _sum(team, 0, sums)
        smoothing = _ZERO
        if sums[1] > _ZERO:
            smoothing = sums[0] / sums[1]
        of_along, of_beyond = sums[2], sums[3]
        sums = wp.vec4d()
        for i in range(team.begin, team.end, team.stride):
            product = row_product(matrix, i, of.beyond, team.part, team.parts)
            for c in range(team.part, 3, team.parts):
                half = of.residual[i][c] - step * of.along[i][c]
                of_half = of.products[0, i][c] - step * of.beyond[i][c]
                residual = half - smoothing * of_half
                after = of_half - smoothing * (of.products[1, i][c] - step * product[c])
                of.last[i][c] = product[c]
                of.x[i][c] += step * of.direction[i][c] + smoothing * half
                of.residual[i][c] = residual
                of.products[0, i][c] = after
                shadow = of.shadow[i][c]
                sums += wp.vec4d(shadow * residual, shadow * after, _square(matrix, i, c, residual), _ZERO)
        sums = _sum(team, 1, sums)
        momentum, divisor = _ZERO, _ZERO
        if smoothing != _ZERO:
            momentum = step / smoothing * sums[0] / correlation
            divisor = sums[1] + momentum * (of_along - smoothing * of_beyond)
        correlation = sums[0]
        iteration += 1
    return iteration


@wp.kernel(module="unique", enable_backward=False, cluster_dim=CLUSTER, launch_bounds=BLOCK)
def solve(
    # in
    matrix: Matrix,
    particles: wp.array[int],
    b: wp.array[wp.vec3d],
    tolerance: wp.float64,
    max_iterations: int,
    failure: wp.float64,
    threads: int,
    parts: int,
    # buffers
    partials: wp.array3d[wp.vec4d],
    of: Vectors,
    # out
    x: wp.array[wp.vec3d],
    failed: wp.array[int],
):
    """Solves A x = b in each world; ``particles`` are the first ones of the worlds, and the end of the last."""
    team = Team()
    team.world = wp.tid() // threads
    team.lane = wp.tid() % threads
    team.blocks = partials.shape[2]
    team.part = team.lane % parts
    team.parts = parts
    team.begin = particles[team.world] + team.lane // parts
    team.end = particles[team.world + 1]
    team.stride = threads // parts
    team.partials = partials
    for i in range(team.begin, team.end, team.stride):
        for c in range(team.part, 3, parts):
            of.x[i][c] = _ZERO
    sums = _begin(team, matrix, b, of)
    limit = tolerance * tolerance * sums[1]
    is_solved = sums[1] <= _LEAST_SQUARE
    iterations = int(0)
    for attempt in range(_ATTEMPTS):
        if not is_solved and iterations < max_iterations:
            most = max_iterations - iterations
            if attempt == 0 and matrix.unsymmetric[team.world] == 0:
                iterations += _conjugate_residuals(team, matrix, of, _AIM * limit, most)
            else:
                iterations += _bicgstab(team, matrix, of, _AIM * limit, most)
            sums = _begin(team, matrix, b, of)
            is_solved = sums[0] <= limit  # not so for NaN
    wait_for_others()
    for i in range(team.begin, team.end, team.stride):
        if team.part == 0:
            x[i] = wp.vec3d(failure, failure, failure)
            if is_solved:
                x[i] = matrix.roots[i] * of.x[i]
    if team.lane == 0:
        failed[team.world] = int(not is_solved)
