"""The gradient and the Hessian of a Newton step, added up by unknown: elements, contacts, and inertia."""

import warp as wp

from ...kernels.not_inlined import NOT_INLINED
from ...response.state.structs import Motion
from ...response.state.vectors import to_double, to_single
from ..elasticity.derivatives import Derivatives
from .bodies import SolvedBodies, inertia_of_body
from .conjugate_gradients import Vectors
from .matrix import Matrix, block_of, set_block
from .pairs import Trial
from .rows import Rows, sum_of_blocks, sum_of_corners
from .system import Contacts, Progress, Unknowns, block_sum_of_parts, contact_block, contact_gradient, sum_of_parts

wp.set_module_options({"enable_backward": False})


@wp.func(**NOT_INLINED)
def _inverse(block: wp.mat33, least: float) -> wp.mat33:
    """Returns the inverse of a symmetric block; of its absolute value where that is not positive definite."""
    a, b = block[0, 0], block[0, 1]
    d, f = block[1, 1], block[2, 2]
    minor = a * d - b * b
    determinant = wp.determinant(block)
    size = wp.max(a, wp.max(d, f))
    if a > 0.0 and minor > 1.0e-6 * a * d and determinant > 1.0e-6 * minor * f:
        return wp.inverse(block)
    q, values = wp.eig3(0.5 * (block + wp.transpose(block)))
    for k in range(3):
        values[k] = 1.0 / wp.max(wp.abs(values[k]), wp.max(least, 1.0e-6 * size))
    return q * wp.diag(values) * wp.transpose(q)


@wp.func
def _inertia(
    unknowns: Unknowns,
    trial: Trial,
    goal: wp.array[wp.vec3],
    motion: Motion,
    bodies: SolvedBodies,
    dt: wp.float64,
    u: int,
):
    """Returns the gradient of the inertia by an unknown, and its block of the diagonal."""
    p = unknowns.particle[u]
    if p < 0:
        return inertia_of_body(bodies, motion, unknowns.body[u], u, dt)
    inertia = unknowns.inertia[u]
    pull = to_single(inertia * (trial.exact[p] - to_double(goal[p])))
    return pull, float(inertia) * wp.identity(n=3, dtype=float)


@wp.func
def _diagonal_count(unknowns: Unknowns, world: int) -> int:
    """Returns the number of blocks of the diagonal of a world, up to that of the threads of its last warp."""
    return (unknowns.of_worlds[world + 1] - unknowns.of_worlds[world] + 31) // 32 * 32


@wp.func
def block_count(rows: Rows, unknowns: Unknowns, world: int) -> int:
    """Returns for how many numbers :func:`add_blocks` does something, or nothing, in a world."""
    blocks = rows.first[unknowns.of_worlds[world + 1]] - rows.first[unknowns.of_worlds[world]]
    return _diagonal_count(unknowns, world) + blocks


@wp.func
def add_blocks(
    i: int,
    world: int,
    derivatives: Derivatives,
    contacts: Contacts,
    unknowns: Unknowns,
    row_of_block: wp.array[int],
    trial: Trial,
    goal: wp.array[wp.vec3],
    motion: Motion,
    bodies: SolvedBodies,
    dt: wp.float64,
    rows: Rows,
    parts: int,
    matrix: Matrix,
):
    """Adds up blocks of elements, of contacts that do not couple, and of inertia, of a world.

    So many threads add up one block together. Those of the diagonal, which have many terms, come before all others, in
    warps of their own: of a world, there are :func:`block_count`.
    """
    number, part = i // parts, i % parts
    first_row, diagonals = unknowns.of_worlds[world] + int(0), _diagonal_count(unknowns, world)
    k = rows.first[first_row] + number - diagonals
    if number < diagonals:
        if first_row + number >= unknowns.of_worlds[world + 1]:
            return
        k = rows.first[first_row + number] + int(0)
    row, column = row_of_block[k] + int(0), rows.column[k] + int(0)
    if row == column and number >= diagonals:
        return
    first = wp.where(row == column, contacts.first[row], contacts.several[row])
    of_contacts = contact_block(contacts, first, contacts.middle[row], column, part, parts)
    block = of_contacts + sum_of_blocks(rows, derivatives, rows.first_source[k], rows.first_source[k + 1], part, parts)
    if part == 0:
        if row == column and unknowns.is_free[row] != 0:
            _pull, inertia = _inertia(unknowns, trial, goal, motion, bodies, dt, row)
            block += inertia
        set_block(matrix, k, block)


@wp.func
def assemble(
    i: int,
    world: int,
    contacts: Contacts,
    unknowns: Unknowns,
    trial: Trial,
    goal: wp.array[wp.vec3],
    motion: Motion,
    bodies: SolvedBodies,
    dt: wp.float64,
    begins: bool,
    rows: Rows,
    matrix: Matrix,
    parts: int,
    turns: int,
    vectors: Vectors,
):
    """Computes the gradient of the energy by unknowns of a world, and what preconditions.

    The first solve of a Newton step ``begins``: displacements are then 0, those of particles that a program moves their
    ways. Later ones go on from where they are. So many threads share unknowns, as here and there one has very many
    contacts: as many unknowns as they take ``turns``, of which each ends one.
    """
    first, part = unknowns.of_worlds[world] + i // parts * turns, i % parts
    own, gradient, block = int(-1), wp.vec3(), wp.mat33()
    for u in range(first, wp.min(first + turns, unknowns.of_worlds[world + 1])):
        of_contacts, of_coupled = contact_gradient(contacts, unknowns, u, part, parts)
        force = sum_of_parts(of_contacts, parts) + vectors.elastic[u]
        of_coupled = block_sum_of_parts(of_coupled, parts)
        if u - first == part:
            own, gradient, block = u, force, of_coupled
    if own < 0:
        return
    if unknowns.is_free[own] == 0:
        if begins:
            vectors.gradient[own] = wp.vec3()
            vectors.solution[own] = wp.vec3()
            if unknowns.particle[own] >= 0:
                vectors.solution[own] = trial.displaced[unknowns.particle[own]]
            vectors.inverse[own] = wp.mat33()
        return
    pull, inertia = _inertia(unknowns, trial, goal, motion, bodies, dt, own)
    vectors.gradient[own] = gradient + pull
    vectors.inverse[own] = _inverse(block_of(matrix, rows.first[own]) + block, wp.min(wp.get_diag(inertia)))
    if begins:
        vectors.solution[own] = wp.vec3()


@wp.func
def find_loads(
    u: int,
    world: int,
    derivatives: Derivatives,
    rows: Rows,
    unknowns: Unknowns,
    progress: Progress,
    load: wp.array[float],
    elastic: wp.array[wp.vec3],
):
    """Writes the gradient of the energy of elements, and the forces on vertices that are solved for.

    That of an earlier Newton step of the step is kept where it is about right: barriers that change converge slowly.
    """
    p = unknowns.particle[u]
    if p < 0:
        return
    if unknowns.is_free[u] == 0:
        load[p] = 0.0
        return
    gradient = sum_of_corners(rows, derivatives, rows.first_corner[u], rows.first_corner[u + 1], 0, 1)
    elastic[u] = gradient
    force = wp.length(gradient)
    if progress.steps[world] == 0 or force > 2.0 * load[p] or force < 0.25 * load[p]:
        load[p] = force
