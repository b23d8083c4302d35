"""Krylov solves whose iterations are one launch a product, each world in a phase of its own.

The pipelined methods have one sum over all particles for each product with the matrix, which is complete when the next
product begins: other products follow from recurrences (Ghysels and Vanroose 2014, doi:10.1016/j.parco.2013.06.001;
Cools and Vanroose 2017, doi:10.1016/j.parco.2017.04.005). So a launch adds up the sums of the last one, decides what is
next for its world, computes a product, and changes all vectors.
"""

from enum import IntEnum

import warp as wp

from .matrix_kernels import Matrix, component, row_product, vector_at

wp.set_module_options({"enable_backward": False})

BLOCK = 128
"""Threads of a block on a GPU."""

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


class Phase(IntEnum):
    """What a launch computes for a world."""

    RESIDUAL = 0
    """The residual b - A x."""
    START = 1
    """The product with the residual."""
    CONJUGATE = 2
    """An iteration of conjugate residuals."""
    FIRST = 3
    """The first half of an iteration of BiCGSTAB."""
    SECOND = 4
    """The second half."""
    SOLVED = 5
    FAILED = 6


class Vector(IntEnum):
    """Vectors of a solve."""

    X = 0
    """The solution, scaled as the matrix."""
    RESIDUAL = 1
    DIRECTION = 2
    """The search direction."""
    ALONG = 3
    """A times the direction."""
    BEYOND = 4
    """A times that."""
    LAST = 5
    """A times that (BiCGSTAB)."""
    SHADOW = 6
    """The residual at the start (BiCGSTAB)."""
    PRODUCT = 7
    """A times the residual."""
    OTHER = 8
    """A times ``PRODUCT`` (BiCGSTAB); conjugate residuals write the next product here, and swap both."""


@wp.struct
class State:
    """State of the solve of a world.

    Attributes:
        phase: What the last launch computed, :class:`Phase`.
        attempt, iterations: Numbers of solves begun, and of iterations in all.
        is_indefinite: Whether the product of a vector and A times it was negative: A is not positive definite.
        limit: Largest squared norm of the residual.
        curvature: Product of the residual and A times it (conjugate residuals), or of residual and shadow (BiCGSTAB).
        divisor: What ``curvature`` is divided by to get the step.
        step, momentum, smoothing: Coefficients of the iteration.
    """

    phase: int
    attempt: int
    iterations: int
    is_indefinite: int
    limit: wp.float64
    curvature: wp.float64
    divisor: wp.float64
    step: wp.float64
    momentum: wp.float64
    smoothing: wp.float64


@wp.func
def _iterate(state: State, square: wp.float64, phase: int, max_iterations: int) -> State:
    """Begins an iteration, or ends the attempt: where its residual is small enough, or the method cannot go on."""
    goes_on = square > _AIM * state.limit and state.curvature != _ZERO and state.divisor != _ZERO  # not so for NaN
    if goes_on and state.iterations < max_iterations:
        state.step = state.curvature / state.divisor
        state.iterations += 1
        state.phase = phase
    else:
        state.phase = int(Phase.RESIDUAL)
    return state


@wp.func
def _next(state: State, sums: wp.vec4d, is_symmetric: bool, tolerance: wp.float64, max_iterations: int) -> State:
    """Returns what follows the sums of the last launch."""
    if state.phase == int(Phase.RESIDUAL):
        if state.attempt == 0:
            state.limit = tolerance * tolerance * sums[1]
        if sums[0] <= state.limit or sums[1] <= _LEAST_SQUARE:
            state.phase = int(Phase.SOLVED)
        elif sums[0] > state.limit and state.attempt < _ATTEMPTS and state.iterations < max_iterations:
            state.attempt += 1
            state.phase = int(Phase.START)
        else:
            state.phase = int(Phase.FAILED)
        return state
    if state.phase <= int(Phase.CONJUGATE) and sums[0] < _ZERO:
        state.is_indefinite = 1
    if state.phase == int(Phase.START):
        state.momentum = _ZERO
        state.smoothing = _ZERO
        if is_symmetric and state.attempt == 1:
            state.curvature = sums[0]
            state.divisor = sums[1]
            return _iterate(state, sums[3], int(Phase.CONJUGATE), max_iterations)
        state.curvature = sums[2]
        state.divisor = sums[0]
        return _iterate(state, sums[3], int(Phase.FIRST), max_iterations)
    if state.phase == int(Phase.CONJUGATE):
        state.momentum = sums[0] / state.curvature
        state.curvature = sums[0]
        state.divisor = sums[1] + state.momentum * (_TWO * sums[2] + state.momentum * state.divisor)
        return _iterate(state, sums[3], int(Phase.CONJUGATE), max_iterations)
    if state.phase == int(Phase.FIRST):
        state.smoothing = _ZERO
        if sums[1] > _ZERO:
            state.smoothing = sums[0] / sums[1]
        state.divisor = sums[2] - state.smoothing * sums[3]
        state.phase = int(Phase.SECOND)
        return state
    if state.phase == int(Phase.SECOND):
        if state.smoothing == _ZERO:
            state.divisor = _ZERO
        else:
            state.momentum = state.step / state.smoothing * sums[0] / state.curvature
            state.divisor = sums[1] + state.momentum * state.divisor
        state.curvature = sums[0]
        return _iterate(state, sums[2], int(Phase.FIRST), max_iterations)
    return state


@wp.func
def _source(state: State) -> int:
    """Returns the vector that the next product is with."""
    if state.phase == int(Phase.RESIDUAL):
        return int(Vector.X)
    if state.phase == int(Phase.START):
        return int(Vector.RESIDUAL)
    if state.phase == int(Phase.SECOND):
        return int(Vector.BEYOND)
    return _product(state)


@wp.func
def _product(state: State) -> int:
    """Returns the vector that is A times the residual."""
    if state.phase == int(Phase.CONJUGATE):
        return wp.where(state.iterations % 2 == 1, int(Vector.PRODUCT), int(Vector.OTHER))
    return int(Vector.PRODUCT)


@wp.func
def _advance(state: State, of: wp.array2d[wp.float64], n: int, product: wp.float64, square: wp.float64) -> wp.vec4d:
    """Changes component n of all vectors, given that of the product; returns its share in the sums.

    ``square`` is the factor by which the square of a residual was scaled.
    """
    residual = of[int(Vector.RESIDUAL), n] + _ZERO
    if state.phase == int(Phase.START):
        of[int(Vector.PRODUCT), n] = product
        of[int(Vector.SHADOW), n] = residual
        for k in range(int(Vector.DIRECTION), int(Vector.LAST) + 1):
            of[k, n] = _ZERO
        return wp.vec4d(residual * product, product * product, residual * residual, square * residual * residual)
    before = of[_product(state), n] + _ZERO
    if state.phase == int(Phase.CONJUGATE):
        beyond = product + state.momentum * of[int(Vector.BEYOND), n]
        along = before + state.momentum * of[int(Vector.ALONG), n]
        direction = residual + state.momentum * of[int(Vector.DIRECTION), n]
        residual -= state.step * along
        after = before - state.step * beyond
        of[int(Vector.X), n] += state.step * direction
        of[int(Vector.RESIDUAL), n] = residual
        of[int(Vector.DIRECTION), n] = direction
        of[int(Vector.ALONG), n] = along
        of[int(Vector.BEYOND), n] = beyond
        of[int(Vector.PRODUCT) + int(Vector.OTHER) - _product(state), n] = after
        return wp.vec4d(residual * after, after * after, after * along, square * residual * residual)
    if state.phase == int(Phase.FIRST):
        old_along, old_beyond = of[int(Vector.ALONG), n] + _ZERO, of[int(Vector.BEYOND), n] + _ZERO
        direction = residual + state.momentum * (of[int(Vector.DIRECTION), n] - state.smoothing * old_along)
        along = before + state.momentum * (old_along - state.smoothing * old_beyond)
        beyond = product + state.momentum * (old_beyond - state.smoothing * of[int(Vector.LAST), n])
        of[int(Vector.DIRECTION), n] = direction
        of[int(Vector.ALONG), n] = along
        of[int(Vector.BEYOND), n] = beyond
        of[int(Vector.OTHER), n] = product
        half, of_half = residual - state.step * along, before - state.step * beyond
        shadow = of[int(Vector.SHADOW), n] + _ZERO
        return wp.vec4d(half * of_half, of_half * of_half, shadow * along, shadow * beyond)
    half = residual - state.step * of[int(Vector.ALONG), n]
    of_half = before - state.step * of[int(Vector.BEYOND), n]
    residual = half - state.smoothing * of_half
    after = of_half - state.smoothing * (of[int(Vector.OTHER), n] - state.step * product)
    of[int(Vector.X), n] += state.step * of[int(Vector.DIRECTION), n] + state.smoothing * half
    of[int(Vector.RESIDUAL), n] = residual
    of[int(Vector.PRODUCT), n] = after
    of[int(Vector.LAST), n] = product
    shadow = of[int(Vector.SHADOW), n] + _ZERO
    return wp.vec4d(shadow * residual, shadow * after, square * residual * residual, _ZERO)


@wp.kernel
def advance(
    # in
    matrix: Matrix,
    b: wp.array[wp.vec3d],
    particles: wp.array[int],
    world_of_block: wp.array[int],
    blocks: wp.array[int],
    tolerance: wp.float64,
    max_iterations: int,
    turn: int,
    parts: int,
    # in and out
    states: wp.array2d[State],
    partials: wp.array2d[wp.vec4d],
    of: wp.array2d[wp.float64],
):
    """Computes the next product of each world.

    States and sums of blocks are read at ``turn``, 0 or 1, and written at the other. ``particles`` and ``blocks`` are
    the first ones of the worlds, and the end of the last. A particle has ``parts`` threads, 1, 2 or 4: they share the
    blocks of its row, and each owns some of its components.
    """
    block, lane = wp.tid() // wp.block_dim(), wp.tid() % wp.block_dim()
    world = world_of_block[block]
    first_block = blocks[world]
    count = blocks[world + 1] - first_block
    state = states[turn, world]
    sums = wp.vec4d()
    for k in range(lane, count, wp.block_dim()):
        sums += partials[turn, first_block + k]
    sums = wp.tile_sum(wp.tile(sums, preserve_type=True))[0]
    if state.attempt >= 0:
        state = _next(state, sums, matrix.unsymmetric[world] == 0, tolerance, max_iterations)
    else:
        state.attempt = 0  # the first launch
    if block == first_block and lane == 0:
        states[1 - turn, world] = state
    sums = wp.vec4d()
    if state.phase < int(Phase.SOLVED):
        begin, part = particles[world], lane % parts
        thread = (block - first_block) * wp.block_dim() + lane
        for i in range(begin + thread // parts, particles[world + 1], count * wp.block_dim() // parts):
            product = row_product(matrix, i, of[_source(state)], part, parts)
            if state.phase == int(Phase.RESIDUAL):
                product = wp.transpose(matrix.roots[i]) * b[i] - product
            for c in range(part, 3, parts):
                n = 3 * i + c
                value, square = component(product, c), matrix.eigenvalues[n] + _ZERO
                if state.phase == int(Phase.RESIDUAL):
                    of_b = component(b[i], c)
                    of[int(Vector.RESIDUAL), n] = value
                    sums += wp.vec4d(square * value * value, of_b * of_b, _ZERO, _ZERO)
                else:
                    sums += _advance(state, of, n, value, square)
    sums = wp.tile_sum(wp.tile(sums, preserve_type=True))[0]
    if lane == 0:
        partials[1 - turn, block] = sums


@wp.kernel
def begin(
    # out
    states: wp.array2d[State],
):
    """Sets the states before the first launch."""
    world = wp.tid()
    state = State()
    state.phase = int(Phase.RESIDUAL)
    state.attempt = -1
    states[0, world] = state


@wp.kernel
def find_unfinished(
    # in
    states: wp.array2d[State],
    # out
    unfinished: wp.array[int],
):
    """Sets a number to 1 if a world is not finished."""
    if states[0, wp.tid()].phase < int(Phase.SOLVED):
        unfinished[0] = 1


@wp.kernel
def finish(
    # in
    world: wp.array[int],
    states: wp.array2d[State],
    roots: wp.array[wp.mat33d],
    of: wp.array2d[wp.float64],
    failure: wp.float64,
    # out
    x: wp.array[wp.vec3d],
    failed: wp.array[int],
    indefinite: wp.array[int],
):
    """Computes the solution, not scaled, or a value in worlds that failed; marks these, and those not definite."""
    i = wp.tid()
    w = world[i]
    is_solved = states[0, w].phase == int(Phase.SOLVED)
    failed[w] = int(not is_solved)
    indefinite[w] = states[0, w].is_indefinite
    x[i] = wp.vec3d(failure, failure, failure)
    if is_solved:
        x[i] = roots[i] * vector_at(of[int(Vector.X)], i)
