"""The gradient and the Hessian of a Newton step, added up by unknown: elements, contacts, and inertia."""

import warp as wp

from ...kernels.not_inlined import NOT_INLINED
from ...response.state.structs import Motion
from ...response.state.vectors import to_double, to_single
from ..elasticity.derivatives import find_derivatives
from ..elasticity.elements import kind_of
from .bodies import SolvedBodies, inertia_of_body
from .contact_lists import clear_lists
from .decisions import is_far
from .flow import Phase, Place, Problem, end_of_vertices, go_on, go_on_with_pairs
from .matrix import block_of, set_block
from .merge import clear_buckets
from .merit import add_energy, add_inertia
from .pairs import Trial, listed_count
from .rows import sum_of_blocks, sum_of_corners
from .steps import way_of
from .system import Unknowns, block_sum_of_parts, contact_block, contact_gradient, is_solved, raise_to, sum_of_parts

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
def _inertia(unknowns: Unknowns, trial: Trial, motion: Motion, bodies: SolvedBodies, dt: wp.float64, u: int):
    """Returns the gradient of the inertia by an unknown, and its block of the diagonal."""
    p = unknowns.particle[u]
    if p < 0:
        return inertia_of_body(bodies, motion, unknowns.body[u], u, dt)
    inertia = unknowns.inertia[u]
    pull = to_single(inertia * (trial.exact[p] - to_double(trial.goal[p])))
    return pull, float(inertia) * wp.identity(n=3, dtype=float)


@wp.func
def differentiate(at: Place, p: Problem) -> wp.vec4i:
    """Finds derivatives and energies of elements, and what is left of the ways that a program moves something."""
    # things of different kinds in one phase are for different threads, so that they take place at the same time
    w, n, from_end = at.world, at.threads, at.threads - 1 - at.thread
    for k in range(p.worlds.first_vertex[w] + from_end, end_of_vertices(p.worlds, p.progress, w), n):
        v = p.worlds.vertices[k] + int(0)
        p.trial.share[v] = 1.0
        if not is_solved(p.unknowns, v) and wp.isfinite(p.trial.x[v]):
            d = p.motion.x1[v] - p.trial.x[v]
            p.trial.displaced[v] = d
            if wp.length_sq(d) > 0.0:
                raise_to(p.progress.remaining, w, wp.length(d))
                raise_to(p.progress.given_way, w, way_of(p.motion, p.trial, v))
    clear_buckets(w, from_end, n, p.contacts)
    convex = is_far(w, p.far_change, p.progress)
    for k in range(p.worlds.first_element[w] + at.spread, p.worlds.first_element[w + 1], n):
        i = p.worlds.elements[k] + int(0)
        if i < 0:
            continue
        energy = find_derivatives(
            i, kind_of(p.elements, i), p.elements, p.trial.exact, p.motion.x0, p.settings.dt, convex, p.derivatives
        )
        add_energy(p.progress.energy, w, energy, p.settings.units)
    return wp.vec4i(int(Phase.LOADS), at.then, 0, 0)


@wp.func
def find_loads(at: Place, p: Problem) -> wp.vec4i:
    """Finds the energy of inertia, the gradient of that of elements, and forces on vertices that are solved for.

    Those of an earlier Newton step of the step are kept where they are about right: barriers that change converge
    slowly.
    """
    w, n, load = at.world, at.threads, p.settings.load
    first, end = p.unknowns.of_worlds[w] + int(0), p.unknowns.of_worlds[w + 1] + int(0)
    if at.thread == 0:
        p.contacts.count[w] = 0
        clear_lists(w, p.contacts)
    for u in range(first + at.thread, end, n):
        v = p.unknowns.particle[u] + int(0)
        if v >= 0 and p.unknowns.is_free[u] == 0:
            load[v] = 0.0
        elif v >= 0:
            gradient = sum_of_corners(p.rows, p.derivatives, p.rows.first_corner[u], p.rows.first_corner[u + 1], 0, 1)
            p.vectors.elastic[u] = gradient
            force = wp.length(gradient)
            if p.progress.steps[w] == 0 or force > 2.0 * load[v] or force < 0.25 * load[v]:
                load[v] = force
        add_inertia(u, w, p.motion, p.settings, p.trial, p.unknowns, p.bodies, p.progress.energy)
    for u in range(first + n - 1 - at.thread, end, n):
        p.contacts.end[u] = 0
    phase = wp.where(listed_count(p.candidates, w) >= 0, int(Phase.FIND_NEAR), int(Phase.BEGIN_LIST))
    return go_on_with_pairs(at, phase, Phase.COUNT)


@wp.func
def add_blocks(at: Place, p: Problem) -> wp.vec4i:
    """Adds up the blocks of the Hessian: of elements, of contacts that do not couple, and of inertia.

    Several threads add up one block together, where there are enough. Those of the diagonal, which have many terms,
    come before all others, in warps of their own.
    """
    first_row, end_row = p.unknowns.of_worlds[at.world] + int(0), p.unknowns.of_worlds[at.world + 1] + int(0)
    diagonals = (end_row - first_row + 31) // 32 * 32  # up to that of the threads of the last warp
    first_block = p.rows.first[first_row] + int(0)
    count = diagonals + p.rows.first[end_row] - first_block
    parts = wp.where(p.parts * count <= at.threads, p.parts, 1)
    for i in range(at.thread, parts * count, at.threads):
        number, part = i // parts, i % parts
        k = first_block + number - diagonals
        if number < diagonals:
            if first_row + number >= end_row:
                continue
            k = p.rows.first[first_row + number] + int(0)
        row, column = p.rows.row[k] + int(0), p.rows.column[k] + int(0)
        if row == column and number >= diagonals:
            continue
        first = wp.where(row == column, p.contacts.first[row], p.contacts.several[row])
        block = contact_block(p.contacts, first, p.contacts.middle[row], column, part, parts)
        block += sum_of_blocks(p.rows, p.derivatives, p.rows.first_source[k], p.rows.first_source[k + 1], part, parts)
        if part == 0:
            if row == column and p.unknowns.is_free[row] != 0:
                _pull, inertia = _inertia(p.unknowns, p.trial, p.motion, p.bodies, p.settings.dt, row)
                block += inertia
            set_block(p.matrix, k, block)
    return go_on(at, Phase.ASSEMBLE)


@wp.func
def assemble(at: Place, p: Problem) -> wp.vec4i:
    """Adds up the gradient of the energy, and what preconditions.

    In the first solve of a Newton step, displacements are then 0, those of particles that a program moves their ways.
    Later ones go on from where they are. Several threads share unknowns, as here and there one has very many contacts:
    as many unknowns as they take turns, of which each ends one.
    """
    w, begins, parts = at.world, at.solves == 0, p.parts
    first_row, end_row = p.unknowns.of_worlds[w] + int(0), p.unknowns.of_worlds[w + 1] + int(0)
    turns = wp.where(parts * (end_row - first_row) <= at.threads, 1, p.turns)
    for i in range(at.thread, parts * ((end_row - first_row + turns - 1) // turns), at.threads):
        first, part = first_row + i // parts * turns, i % parts
        own, gradient, block = int(-1), wp.vec3(), wp.mat33()
        for u in range(first, wp.min(first + turns, end_row)):
            of_contacts, of_coupled = contact_gradient(p.contacts, p.unknowns, u, part, parts)
            force = sum_of_parts(of_contacts, parts) + p.vectors.elastic[u]
            of_coupled = block_sum_of_parts(of_coupled, parts)
            if u - first == part:
                own, gradient, block = u, force, of_coupled
        if own < 0:
            continue
        if p.unknowns.is_free[own] != 0:
            pull, inertia = _inertia(p.unknowns, p.trial, p.motion, p.bodies, p.settings.dt, own)
            p.vectors.gradient[own] = gradient + pull
            diagonal = block_of(p.matrix, p.rows.first[own]) + block
            p.vectors.inverse[own] = _inverse(diagonal, wp.min(wp.get_diag(inertia)))
            if begins:
                p.vectors.solution[own] = wp.vec3()
        elif begins:
            p.vectors.gradient[own] = wp.vec3()
            p.vectors.solution[own] = wp.vec3()
            if p.unknowns.particle[own] >= 0:
                p.vectors.solution[own] = p.trial.displaced[p.unknowns.particle[own]]
            p.vectors.inverse[own] = wp.mat33()
    if at.thread == 0:
        p.progress.longest[w] = p.progress.remaining[w]
        if begins:
            p.progress.leaves[w] = 0
    return go_on_with_pairs(at, Phase.SOLVE, Phase.BOUNDED)
