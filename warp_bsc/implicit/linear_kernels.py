"""Krylov solves in one launch: the threads of a cluster make all iterations for a world, and wait for each other.

An iteration takes less time than the launches of its kernels, in scenes for which this is the most of a step back.
"""

import warp as wp

from ..response.solve.cluster import BLOCK, CLUSTER, wait_for_others
from .matrix_kernels import Matrix, row_product

wp.set_module_options({"enable_backward": False})

_ZERO = wp.constant(wp.float64(0.0))
_ONE = wp.constant(wp.float64(1.0))
_TWO = wp.constant(wp.float64(2.0))
_LEAST_SQUARE = wp.constant(wp.float64(1e-200))
"""Squared norm of a right-hand side at or below which it counts as 0."""
_AIM = wp.constant(wp.float64(0.25))
"""Squared norm of the residual at which iterations end, relative to the largest allowed.

The residual that iterations update drifts from the true one, which decides.
"""
ATTEMPTS = wp.constant(3)
"""Solves that are tried, each from the solution of the one before: its residual is computed anew."""


@wp.struct
class Vectors:
    """Vectors of a solve, each of shape [particle_count].

    Attributes:
        x: The solution.
        residual: b - A x; ``shadow``: it at the beginning (of BiCGSTAB).
        direction, along: The search direction, and its product with A.
        product: Product with A of the residual.
    """

    x: wp.array[wp.vec3d]
    residual: wp.array[wp.vec3d]
    shadow: wp.array[wp.vec3d]
    direction: wp.array[wp.vec3d]
    along: wp.array[wp.vec3d]
    product: wp.array[wp.vec3d]


@wp.struct
class Team:
    """The threads that solve for a world.

    Attributes:
        world: The world.
        lane: Number of this thread among them.
        threads: Number of threads.
        begin, end: The particles of the world.
        partials: Sums of each block of threads, shape [world_count, CLUSTER].
    """

    world: int
    lane: int
    threads: int
    begin: int
    end: int
    partials: wp.array2d[wp.vec4d]


@wp.func
def _sum(team: Team, values: wp.vec4d) -> wp.vec4d:
    """Returns the sums of values over all threads, the same in each. Between two calls, all have to wait once."""
    of_block = wp.tile_sum(wp.tile(values, preserve_type=True))
    if team.lane % wp.block_dim() == 0:
        team.partials[team.world, team.lane // wp.block_dim()] = of_block[0]
    wait_for_others()
    total = wp.vec4d()
    for block in range(team.threads // wp.block_dim()):
        total += team.partials[team.world, block]
    return total


@wp.func
def _begin(team: Team, matrix: Matrix, b: wp.array[wp.vec3d], of: Vectors) -> wp.vec4d:
    """Computes the residual b - A x; returns the squared norms of the residual and of b, and of the scaled residual."""
    wait_for_others()
    sums = wp.vec4d()
    for i in range(team.begin + team.lane, team.end, team.threads):
        residual = wp.transpose(matrix.roots[i]) * b[i] - row_product(matrix, i, of.x)
        of.residual[i] = residual
        sums += wp.vec4d(_square(matrix, i, residual), wp.length_sq(b[i]), wp.length_sq(residual), _ZERO)
    return _sum(team, sums)


@wp.func
def _square(matrix: Matrix, i: int, residual: wp.vec3d) -> wp.float64:
    """Returns the squared norm of a residual before it was scaled."""
    return wp.dot(wp.cw_mul(residual, residual), matrix.eigenvalues[i])


@wp.func
def _conjugate_residuals(team: Team, matrix: Matrix, of: Vectors, limit: wp.float64, most: int) -> int:
    """Makes iterations of conjugate residuals (Stiefel 1955), which need a symmetric matrix; returns their number.

    The squared norm of the product of the next direction follows from sums over the last one, so that an iteration has
    one sum over all threads, after a product (Chronopoulos and Gear 1989).
    """
    wait_for_others()
    sums = wp.vec4d()
    for i in range(team.begin + team.lane, team.end, team.threads):
        residual = of.residual[i]
        product = row_product(matrix, i, of.residual)
        of.direction[i] = residual
        of.along[i] = product
        sums += wp.vec4d(wp.dot(residual, product), wp.length_sq(product), _ZERO, _square(matrix, i, residual))
    sums = _sum(team, sums)
    curvature, length = sums[0], sums[1]
    iteration = int(0)
    while iteration < most and sums[3] > limit and curvature != _ZERO and length > _ZERO:  # not so for NaN
        step = curvature / length
        for i in range(team.begin + team.lane, team.end, team.threads):
            of.x[i] += step * of.direction[i]
            of.residual[i] -= step * of.along[i]
        wait_for_others()
        sums = wp.vec4d()
        for i in range(team.begin + team.lane, team.end, team.threads):
            residual = of.residual[i]
            product = row_product(matrix, i, of.residual)
            of.product[i] = product
            sums += wp.vec4d(
                wp.dot(residual, product),
                wp.length_sq(product),
                wp.dot(product, of.along[i]),
                _square(matrix, i, residual),
            )
        sums = _sum(team, sums)
        momentum = sums[0] / curvature
        for i in range(team.begin + team.lane, team.end, team.threads):
            of.direction[i] = of.residual[i] + momentum * of.direction[i]
            of.along[i] = of.product[i] + momentum * of.along[i]
        curvature = sums[0]
        length = sums[1] + momentum * (_TWO * sums[2] + momentum * length)
        iteration += 1
    return iteration


@wp.func
def _stabilized_biconjugate_gradients(team: Team, matrix: Matrix, of: Vectors, limit: wp.float64, most: int) -> int:
    """Makes iterations of BiCGSTAB (van der Vorst 1992), for any matrix; returns their number."""
    sums = wp.vec4d()
    for i in range(team.begin + team.lane, team.end, team.threads):
        residual = of.residual[i]
        of.shadow[i] = residual
        of.direction[i] = residual
        sums[0] += wp.length_sq(residual)
    wait_for_others()
    sums = _sum(team, sums)
    correlation = sums[0]
    iteration = int(0)
    more = iteration < most
    while more:
        wait_for_others()
        sums = wp.vec4d()
        for i in range(team.begin + team.lane, team.end, team.threads):
            along = row_product(matrix, i, of.direction)
            of.along[i] = along
            sums += wp.vec4d(wp.dot(of.shadow[i], along), _square(matrix, i, of.residual[i]), _ZERO, _ZERO)
        sums = _sum(team, sums)
        more = sums[1] > limit and sums[0] != _ZERO and correlation != _ZERO
        if more:
            step = correlation / sums[0]
            for i in range(team.begin + team.lane, team.end, team.threads):
                of.residual[i] -= step * of.along[i]
            wait_for_others()
            sums = wp.vec4d()
            for i in range(team.begin + team.lane, team.end, team.threads):
                product = row_product(matrix, i, of.residual)
                of.product[i] = product
                sums += wp.vec4d(
                    wp.dot(product, of.residual[i]),
                    wp.length_sq(product),
                    wp.dot(of.shadow[i], of.residual[i]),
                    wp.dot(of.shadow[i], product),
                )
            sums = _sum(team, sums)
            smoothing = _ZERO
            if sums[1] > _ZERO:
                smoothing = sums[0] / sums[1]
            after = sums[2] - smoothing * sums[3]
            momentum = _ZERO
            if smoothing != _ZERO:
                momentum = after / correlation * step / smoothing
            for i in range(team.begin + team.lane, team.end, team.threads):
                of.x[i] += step * of.direction[i] + smoothing * of.residual[i]
                remaining = of.residual[i] - smoothing * of.product[i]
                of.residual[i] = remaining
                of.direction[i] = remaining + momentum * (of.direction[i] - smoothing * of.along[i])
            correlation = after
            iteration += 1
            more = iteration < most
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
    # buffers
    partials: wp.array2d[wp.vec4d],
    of: Vectors,
    # out
    failed: wp.array[int],
):
    """Solves A x = b in each world; ``particles`` are the first ones of the worlds, and the end of the last."""
    team = Team()
    team.world = wp.tid() // threads
    team.lane = wp.tid() % threads
    team.threads = threads
    team.begin = particles[team.world]
    team.end = particles[team.world + 1]
    team.partials = partials
    for i in range(team.begin + team.lane, team.end, threads):
        of.x[i] = wp.vec3d()
    sums = _begin(team, matrix, b, of)
    limit = tolerance * tolerance * sums[1]
    is_zero = sums[1] <= _LEAST_SQUARE
    is_solved = is_zero
    iterations = int(0)
    for attempt in range(ATTEMPTS):
        if not is_solved and iterations < max_iterations:
            most = max_iterations - iterations
            if attempt == 0 and matrix.unsymmetric[team.world] == 0:
                iterations += _conjugate_residuals(team, matrix, of, _AIM * limit, most)
            else:
                iterations += _stabilized_biconjugate_gradients(team, matrix, of, _AIM * limit, most)
            sums = _begin(team, matrix, b, of)
            is_solved = sums[0] <= limit  # not so for NaN
    wait_for_others()
    for i in range(team.begin + team.lane, team.end, threads):
        if is_solved:
            of.x[i] = matrix.roots[i] * of.x[i]
        else:
            of.x[i] = wp.vec3d(failure, failure, failure)
    if team.lane == 0:
        failed[team.world] = int(not is_solved)
