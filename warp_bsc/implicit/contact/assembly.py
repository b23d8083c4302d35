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
def add_block(
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
    matrix: Matrix,
):
    """Adds up a block of elements, of contacts that do not couple, and of inertia, in worlds that solve.

    So many threads share a block, as here and there an unknown has very many contacts.
    """
    k, part = i // parts, i % parts
    u, v = row_of_block[k], rows.column[k]
    if progress.solving[unknowns.world[u]] == 0:
        return
    total = block_sum_of_parts(contact_block(contacts, unknowns, u, v, part, parts), parts)
    if part != 0:
        return
    total += sum_of_blocks(rows, derivatives, k)
    if u == v and unknowns.is_free[u] != 0:
        _pull, inertia = _inertia(unknowns, trial, goal, motion, bodies, dt, u)
        total += inertia
    set_block(matrix, k, total)


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
    vectors: Vectors,
):
    """Computes the gradient of the energy by an unknown, and what preconditions, in worlds that solve.

    The first solve of a Newton step ``begins``: displacements are then 0, those of particles that a program moves their
    ways. Later ones go on from where they are. So many threads share an unknown.
    """
    u, part = i // parts, i % parts
    if progress.solving[unknowns.world[u]] == 0:
        return
    if unknowns.is_free[u] == 0:
        if begins:
            vectors.gradient[u] = wp.vec3()
            vectors.solution[u] = wp.vec3()
            if unknowns.particle[u] >= 0:
                vectors.solution[u] = trial.displaced[unknowns.particle[u]]
            vectors.inverse[u] = wp.mat33()
        return
    gradient, block = contact_gradient(contacts, unknowns, u, part, parts)
    gradient, block = sum_of_parts(gradient, parts), block_sum_of_parts(block, parts)
    if part != 0:
        return
    pull, inertia = _inertia(unknowns, trial, goal, motion, bodies, dt, u)
    vectors.gradient[u] = gradient + sum_of_corners(rows, derivatives, u) + pull
    vectors.inverse[u] = _inverse(block_of(matrix, rows.first[u]) + block, wp.min(wp.get_diag(inertia)))
    if begins:
        vectors.solution[u] = wp.vec3()


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
