"""The gradient and the Hessian of a Newton step, added up by unknown: elements, contacts, and inertia."""

import warp as wp

from ...response.state.structs import Motion
from ...response.state.vectors import to_double, to_single
from .bodies import SolvedBodies, inertia_of_body
from .conjugate_gradients import Vectors
from .elasticity import Derivatives
from .matrix import Matrix, block_of, set_block
from .pairs import Trial
from .rows import Rows, sum_of_blocks, sum_of_corners
from .system import Contacts, Progress, Unknowns, block_sum_of_parts, contact_block, contact_gradient, sum_of_parts

wp.set_module_options({"enable_backward": False})


@wp.func(inline=False)
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
def add_blocks(
    i: int,
    derivatives: Derivatives,
    contacts: Contacts,
    unknowns: Unknowns,
    row_of_block: wp.array[int],
    trial: Trial,
    goal: wp.array[wp.vec3],
    motion: Motion,
    bodies: SolvedBodies,
    dt: wp.float64,
    progress: Progress,
    rows: Rows,
    parts: int,
    turns: int,
    matrix: Matrix,
):
    """Adds up blocks of elements, of contacts that do not couple, and of inertia, in worlds that solve.

    So many threads share as many blocks as they take ``turns``: they add up the contacts of one after the other
    together, as here and there an unknown has very many, and the rest each for one.
    """
    first, part = i // parts * turns, i % parts
    own, total = first + part, wp.mat33()
    is_own = part < turns and own < row_of_block.shape[0]
    if is_own:
        is_own = progress.solving[unknowns.world[row_of_block[own]]] != 0
    if is_own:
        u = row_of_block[own]
        total = sum_of_blocks(rows, derivatives, own)
        if u == rows.column[own] and unknowns.is_free[u] != 0:
            _pull, inertia = _inertia(unknowns, trial, goal, motion, bodies, dt, u)
            total += inertia
    for k in range(first, wp.min(first + turns, row_of_block.shape[0])):
        u = row_of_block[k]
        if contacts.first[u] < contacts.middle[u] and progress.solving[unknowns.world[u]] != 0:
            of_contacts = contact_block(contacts, unknowns, u, rows.column[k], part, parts)
            of_contacts = block_sum_of_parts(of_contacts, parts)
            if k == own:
                total += of_contacts
    if is_own:
        set_block(matrix, own, total)


@wp.func
def assemble(
    i: int,
    derivatives: Derivatives,
    contacts: Contacts,
    unknowns: Unknowns,
    trial: Trial,
    goal: wp.array[wp.vec3],
    motion: Motion,
    bodies: SolvedBodies,
    dt: wp.float64,
    progress: Progress,
    begins: bool,
    rows: Rows,
    matrix: Matrix,
    parts: int,
    turns: int,
    vectors: Vectors,
):
    """Computes the gradient of the energy by unknowns, and what preconditions, in worlds that solve.

    The first solve of a Newton step ``begins``: displacements are then 0, those of particles that a program moves their
    ways. Later ones go on from where they are. Threads share unknowns as blocks in :func:`add_blocks`.
    """
    first, part = i // parts * turns, i % parts
    own, count = first + part, unknowns.world.shape[0]
    gradient, block = wp.vec3(), wp.mat33()
    for u in range(first, wp.min(first + turns, count)):
        if contacts.first[u] < contacts.end[u] and progress.solving[unknowns.world[u]] != 0:
            of_contacts, of_coupled = contact_gradient(contacts, unknowns, u, part, parts)
            of_contacts, of_coupled = sum_of_parts(of_contacts, parts), block_sum_of_parts(of_coupled, parts)
            if u == own:
                gradient, block = of_contacts, of_coupled
    if part >= turns or own >= count:
        return
    if progress.solving[unknowns.world[own]] == 0:
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
    vectors.gradient[own] = gradient + sum_of_corners(rows, derivatives, own) + pull
    vectors.inverse[own] = _inverse(block_of(matrix, rows.first[own]) + block, wp.min(wp.get_diag(inertia)))
    if begins:
        vectors.solution[own] = wp.vec3()


@wp.func
def find_loads(
    u: int,
    derivatives: Derivatives,
    rows: Rows,
    unknowns: Unknowns,
    progress: Progress,
    load: wp.array[float],
):
    """Writes the forces of elements on vertices that are solved for, in active worlds.

    That of an earlier Newton step of the step is kept where it is about right: barriers that change converge slowly.
    """
    world, p = unknowns.world[u], unknowns.particle[u]
    if p < 0 or progress.active[world] == 0:
        return
    if unknowns.is_free[u] == 0:
        load[p] = 0.0
        return
    force = wp.length(sum_of_corners(rows, derivatives, u))
    if progress.steps[world] == 0 or force > 2.0 * load[p] or force < 0.25 * load[p]:
        load[p] = force
