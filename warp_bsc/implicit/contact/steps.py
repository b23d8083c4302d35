"""Kernels of a Newton step: prediction, gradient, displacements, energies, and what each world does next."""

import warp as wp

from ...response.state.motion import StateArrays, predicted_velocity
from ...response.state.structs import Motion, Vertices
from ...response.state.vectors import HALF, ONE, ZERO, to_double, to_single
from .bodies import (
    SolvedBodies,
    arm_on_body,
    bend_of,
    body_vertex,
    exact_on_body,
    inertia_of_body,
    inertial_energy,
)
from .conjugate_gradients import Vectors
from .elasticity import Derivatives, Elements, element_energy, first_vertex, kind_of
from .matrix import Matrix, block_of, set_block
from .merit import add_energy
from .pairs import BarrierSettings, Trial, moved
from .rows import Rows, sum_of_blocks, sum_of_corners
from .system import (
    Contacts,
    Progress,
    Unknowns,
    block_sum_of_parts,
    contact_block,
    contact_gradient,
    displacement,
    is_solved,
    sum_of_parts,
    unknown_of_corner,
)

wp.set_module_options({"enable_backward": False})

_NOISE = wp.constant(wp.float64(1e-9))
"""Rise of energy that may be rounding, as a share of it."""
PATH = wp.constant(8)
"""Newton steps of which positions are kept."""
_LEAST_SCALE = wp.constant(float(2.0**-12))


@wp.kernel
def predict_positions(
    # in
    x0: wp.array[wp.vec3],
    v0: wp.array[wp.vec3],
    force: wp.array[wp.vec3],
    inverse_mass: wp.array[float],
    flags: wp.array[int],
    active_flag: int,
    gravity: wp.array[wp.vec3],
    world: wp.array[int],
    dt: float,
    # out
    x1: wp.array[wp.vec3],
    v1: wp.array[wp.vec3],
):
    """Moves particles as if nothing but gravity and external forces acted on them."""
    i = wp.tid()
    x, v = x0[i] + wp.vec3(), v0[i] + wp.vec3()
    if inverse_mass[i] > 0.0 and wp.isfinite(inverse_mass[i]) and (flags[i] & active_flag) != 0:
        acceleration = gravity[wp.max(world[i], 0) % gravity.shape[0]] + wp.vec3()
        if force:
            acceleration = acceleration + inverse_mass[i] * force[i]
        v = v + dt * acceleration
        x = x + dt * v
    x1[i] = x
    v1[i] = v


@wp.kernel
def begin_unknowns(
    # in
    motion: Motion,
    dt: wp.float64,
    # out
    unknowns: Unknowns,
    goal: wp.array[wp.vec3],
):
    """Finds which particles are solved for, their inertia, and where inertia alone leads."""
    u = wp.tid()
    p = unknowns.particle[u]
    if p < 0:
        return
    unknowns.is_free[u] = 0
    unknowns.inertia[u] = ZERO
    goal[p] = motion.x1[p]
    if motion.inverse_mass[p] > 0.0 and motion.is_not_finite[p] == 0 and wp.isfinite(motion.x0[p]):
        unknowns.is_free[u] = 1
        unknowns.inertia[u] = ONE / (wp.float64(motion.inverse_mass[p]) * dt * dt)


@wp.kernel
def begin_step(
    # in
    motion: Motion,
    margin: wp.array[float],
    unknowns: Unknowns,
    bodies: SolvedBodies,
    # out
    goal: wp.array[wp.vec3],
    lower: wp.array[wp.vec3],
    upper: wp.array[wp.vec3],
    trial: Trial,
    progress: Progress,
    plane_share: wp.array[float],
):
    """Takes the motion as predicted, and boxes around the way there. Worlds with unknowns become active."""
    v = wp.tid()
    if v < progress.active.shape[0]:
        progress.steps[v] = 0
        progress.scale[v] = 1.0
        progress.bound[v] = 1.0
        progress.change[v] = 0.0
        progress.remaining[v] = 0.0
        progress.plain[v] = 0
        progress.late[v] = 0
        plane_share[v] = 0.0
    if v >= trial.x.shape[0]:
        return
    x0, x1 = motion.x0[v], motion.x1[v]
    trial.x[v] = x0
    trial.exact[v] = to_double(x0)
    trial.displaced[v] = wp.vec3()
    trial.share[v] = 1.0
    trial.bend[v] = 0.0
    if not wp.isfinite(x0):  # without pairs, and without forces on others
        lower[v] = wp.vec3()
        upper[v] = wp.vec3()
        return
    pad = margin[v] + float(0.0)
    u = unknowns.of_vertex[v]
    if u < 0:
        goal[v] = x1
    elif unknowns.is_free[u] != 0:
        progress.active[motion.world[v]] = 1
    if is_solved(unknowns, v):
        pad += 0.25 * wp.length(x1 - x0)
        if u < 0:
            unknowns.arm[v] = arm_on_body(bodies, motion, v, x0)
    lower[v] = wp.min(x0, x1) - wp.vec3(pad)
    upper[v] = wp.max(x0, x1) + wp.vec3(pad)


@wp.kernel
def truncate(
    # in
    unknowns: Unknowns,
    # in and out
    limit: wp.array[float],
    trial: Trial,
):
    """Takes the shares of vertices that are solved for down to their bounds, and clears these."""
    v = wp.tid()
    if trial.holder[v] == v and is_solved(unknowns, v):
        trial.share[v] = trial.share[v] * limit[v]
    limit[v] = 1.0


@wp.kernel
def take_bound(
    # in and out
    progress: Progress,
    # out
    cuts: wp.array[int],
):
    """Takes the share of each world down to its bound, and says whether one takes less than all."""
    w = wp.tid()
    progress.scale[w] = progress.scale[w] * progress.bound[w]
    progress.bound[w] = 1.0
    if _may_cut(progress, w):
        cuts[0] = 1


@wp.func
def _may_cut(progress: Progress, w: int) -> bool:
    """Returns whether cuts of vertices may let a world go further: not while something that a program moves comes."""
    return progress.active[w] != 0 and progress.scale[w] < 1.0 and progress.remaining[w] == 0.0


@wp.func
def _may_hold(progress: Progress, w: int) -> bool:
    """Returns whether something would meet in a world, and is to be held."""
    return progress.active[w] != 0 and progress.bound[w] < 1.0 and progress.plain[w] == 0


@wp.kernel
def find_meeting(
    # in
    progress: Progress,
    # out
    meets: wp.array[int],
):
    """Says whether something would meet in a world."""
    w = wp.tid()
    if _may_hold(progress, w):
        meets[0] = 1


@wp.kernel
def begin_hold(
    # in
    always: bool,
    # in and out
    progress: Progress,
    ahead: wp.array[int],
):
    """Lets worlds in which something would meet solve once more, ``always`` all of them, and clears their bounds."""
    w = wp.tid()
    ahead[w] = 0
    if _may_hold(progress, w) or (always and progress.active[w] != 0):
        ahead[w] = 1
        progress.bound[w] = 1.0
        progress.held[w] = int(not always)


@wp.func
def _falls(progress: Progress, w: int) -> bool:
    """Returns whether the energy of a world is lower at the displaced positions, as far as rounding tells."""
    before = wp.float64(progress.energy[w])
    return wp.float64(progress.trial[w]) <= before + _NOISE * wp.abs(before)


@wp.kernel
def find_rises(
    # in
    progress: Progress,
    # out
    rises: wp.array[int],
    any_rises: wp.array[int],
):
    """Says in which worlds the energy rises on displacements that are solved with pairs held."""
    w = wp.tid()
    rises[w] = 0
    if progress.active[w] != 0 and progress.held[w] != 0 and progress.remaining[w] == 0.0 and not _falls(progress, w):
        rises[w] = 1
        any_rises[0] = 1


@wp.kernel
def begin_release(
    # in
    unknowns: Unknowns,
    rises: wp.array[int],
    first: wp.array[wp.vec3],
    # in and out
    progress: Progress,
    solution: wp.array[wp.vec3],
):
    """Lets worlds in which the energy rises search along the solution without pairs held instead."""
    i = wp.tid()
    if i < solution.shape[0] and rises[unknowns.world[i]] != 0:
        solution[i] = first[i]
    if i < rises.shape[0]:
        progress.searches[i] = rises[i]
        if rises[i] != 0:
            progress.scale[i] = 1.0
            progress.trial[i] = wp.int64(0)


@wp.kernel
def end_release(
    # in and out
    progress: Progress,
):
    """Lets all worlds search again."""
    w = wp.tid()
    progress.searches[w] = progress.active[w]


@wp.func
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


@wp.kernel
def add_blocks(
    # in
    derivatives: Derivatives,
    contacts: Contacts,
    unknowns: Unknowns,
    row_of_block: wp.array[int],
    trial: Trial,
    goal: wp.array[wp.vec3],
    motion: Motion,
    bodies: SolvedBodies,
    dt: wp.float64,
    active: wp.array[int],
    rows: Rows,
    parts: int,
    # out
    matrix: Matrix,
):
    """Adds up the blocks of elements, of contacts that do not couple, and of inertia, in active worlds.

    So many threads share a block, as here and there an unknown has very many contacts.
    """
    k, part = wp.tid() // parts, wp.tid() % parts
    u, v = row_of_block[k], rows.column[k]
    if active[unknowns.world[u]] == 0:
        return
    total = block_sum_of_parts(contact_block(contacts, unknowns, u, v, part, parts), parts)
    if part != 0:
        return
    total += sum_of_blocks(rows, derivatives, k)
    if u == v and unknowns.is_free[u] != 0:
        _pull, inertia = _inertia(unknowns, trial, goal, motion, bodies, dt, u)
        total += inertia
    set_block(matrix, k, total)


@wp.kernel
def assemble(
    # in
    derivatives: Derivatives,
    contacts: Contacts,
    unknowns: Unknowns,
    trial: Trial,
    goal: wp.array[wp.vec3],
    motion: Motion,
    bodies: SolvedBodies,
    dt: wp.float64,
    active: wp.array[int],
    begins: bool,
    rows: Rows,
    matrix: Matrix,
    parts: int,
    # in and out
    vectors: Vectors,
):
    """Computes the gradient of the energy by each unknown, and what preconditions.

    The first solve of a Newton step ``begins``: displacements are then 0, those of particles that a program moves their
    ways. Later ones go on from where they are. So many threads share an unknown.
    """
    u, part = wp.tid() // parts, wp.tid() % parts
    if active[unknowns.world[u]] == 0:
        return
    if unknowns.is_free[u] == 0:
        if begins:
            vectors.gradient[u] = wp.vec3()
            vectors.solution[u] = wp.vec3()
            if unknowns.particle[u] >= 0:
                vectors.solution[u] = trial.displaced[unknowns.particle[u]]
            vectors.inverse[u] = wp.mat33()
            vectors.direction[u] = wp.vec3()
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


@wp.kernel
def find_loads(
    # in
    derivatives: Derivatives,
    rows: Rows,
    unknowns: Unknowns,
    progress: Progress,
    # in and out
    load: wp.array[float],
):
    """Writes the forces of elements on vertices that are solved for, in active worlds.

    That of an earlier Newton step of the step is kept where it is about right: barriers that change converge slowly.
    """
    u = wp.tid()
    world, p = unknowns.world[u], unknowns.particle[u]
    if p < 0 or progress.active[world] == 0:
        return
    if unknowns.is_free[u] == 0:
        load[p] = 0.0
        return
    force = wp.length(sum_of_corners(rows, derivatives, u))
    if progress.steps[world] == 0 or force > 2.0 * load[p] or force < 0.25 * load[p]:
        load[p] = force


@wp.kernel
def find_remaining(
    # in
    motion: Motion,
    unknowns: Unknowns,
    # out
    trial: Trial,
    progress: Progress,
):
    """Writes the ways that are left of what a program moves, before a solve."""
    v = wp.tid()
    world = motion.world[v]
    trial.share[v] = 1.0
    if progress.active[world] != 0 and not is_solved(unknowns, v) and wp.isfinite(trial.x[v]):
        d = motion.x1[v] - trial.x[v]
        trial.displaced[v] = d
        if wp.length_sq(d) > 0.0:
            wp.atomic_max(progress.remaining, world, wp.length(d))


@wp.kernel
def displace(
    # in
    motion: Motion,
    unknowns: Unknowns,
    vectors: Vectors,
    lower: wp.array[wp.vec3],
    upper: wp.array[wp.vec3],
    bodies: SolvedBodies,
    active: wp.array[int],
    # out
    trial: Trial,
    progress: Progress,
    limit: wp.array[float],
    leaves: wp.array[int],
):
    """Writes the displacements of vertices after a solve, and whether some leave the boxes of the candidates."""
    v = wp.tid()
    world = motion.world[v]
    if active[world] == 0:
        return
    limit[v] = 1.0
    if not is_solved(unknowns, v):
        return
    d = displacement(unknowns, v, vectors.solution)
    gradient = vectors.gradient[unknown_of_corner(unknowns, v)]
    u = unknowns.of_vertex[v]
    if u < 0:
        d = body_vertex(bodies.moved, motion, v) - trial.x[v]
        trial.bend[v] = bend_of(unknowns.arm[v], vectors.solution[-1 - u])
    if not (wp.isfinite(d) and wp.isfinite(gradient)):  # as a start is not: its world stands
        trial.displaced[v] = wp.vec3()
        progress.bound[world] = 0.0
        progress.change[world] = wp.inf
        return
    trial.displaced[v] = d
    share = _share_within(trial.x[v], d, lower[v], upper[v])
    if share < 1.0:
        wp.atomic_min(progress.bound, world, share)
        leaves[world] = 1
        leaves[leaves.shape[0] - 1] = 1


@wp.kernel
def renew_boxes(
    # in
    motion: Motion,
    unknowns: Unknowns,
    margin: wp.array[float],
    trial: Trial,
    leaves: wp.array[int],
    # in and out
    lower: wp.array[wp.vec3],
    upper: wp.array[wp.vec3],
):
    """Makes the boxes of vertices those around their last displacement, from where they are now.

    Only in worlds in which one left its box, so that each is as if it were alone.
    """
    v = wp.tid()
    if leaves[motion.world[v]] == 0:
        return
    x, d = trial.x[v], trial.displaced[v] + wp.vec3()
    if not wp.isfinite(x):
        return
    pad = margin[v] + float(0.0)
    if unknowns.of_vertex[v] != -1:
        pad += 0.5 * wp.length(d)
    else:
        d = motion.x1[v] - x
    lower[v] = wp.min(x, x + d) - wp.vec3(pad)
    upper[v] = wp.max(x, x + d) + wp.vec3(pad)


@wp.func
def _share_within(x: wp.vec3, d: wp.vec3, lower: wp.vec3, upper: wp.vec3) -> float:
    """Returns the share of a displacement that stays in a box."""
    share = float(1.0)
    for axis in range(3):
        if x[axis] + d[axis] > upper[axis]:
            share = wp.min(share, (upper[axis] - x[axis]) / d[axis])
        elif x[axis] + d[axis] < lower[axis]:
            share = wp.min(share, (lower[axis] - x[axis]) / d[axis])
    return wp.max(share, 0.0)


@wp.kernel
def begin_truncation(
    # in
    unknowns: Unknowns,
    lower: wp.array[wp.vec3],
    upper: wp.array[wp.vec3],
    # in and out
    trial: Trial,
    progress: Progress,
    whole: wp.array[float],
    limit: wp.array[float],
):
    """Lets worlds that take less than all of their displacements try to cut those of single vertices instead."""
    v = wp.tid()
    if v < progress.active.shape[0]:
        progress.searches[v] = 0
        if progress.active[v] != 0:
            whole[v] = progress.scale[v]
            if _may_cut(progress, v):
                progress.searches[v] = 1
            progress.scale[v] = 1.0
            progress.bound[v] = 1.0
    if v >= trial.x.shape[0]:
        return
    limit[v] = 1.0
    if is_solved(unknowns, v):
        wp.atomic_min(trial.share, trial.holder[v], _share_within(trial.x[v], trial.displaced[v], lower[v], upper[v]))


@wp.kernel
def choose_truncation(
    # in
    whole: wp.array[float],
    # in and out
    progress: Progress,
):
    """Keeps the cuts of single vertices in worlds whose energy is lower with them."""
    w = wp.tid()
    if progress.active[w] == 0:
        return
    cuts = progress.searches[w] != 0 and progress.trial_cut[w] < progress.trial[w]
    if cuts:
        progress.trial[w] = progress.trial_cut[w]
    else:
        progress.scale[w] = whole[w]
    progress.cuts[w] = int(cuts)
    progress.searches[w] = 1


@wp.kernel
def undo_truncation(
    # in
    motion: Motion,
    progress: Progress,
    # out
    trial: Trial,
):
    """Lets vertices take all that their world takes, where it cuts none."""
    v = wp.tid()
    if progress.cuts[motion.world[v]] == 0:
        trial.share[v] = 1.0


@wp.kernel
def begin_newton_step(
    # in and out
    progress: Progress,
):
    """Clears what a Newton step measures."""
    w = wp.tid()
    progress.searches[w] = progress.active[w]
    if progress.active[w] == 0:
        return
    progress.change[w] = 0.0
    progress.remaining[w] = 0.0
    progress.cuts[w] = 0
    progress.held[w] = 0
    progress.scale[w] = 1.0
    progress.bound[w] = 1.0
    progress.energy[w] = wp.int64(0)
    progress.trial[w] = wp.int64(0)
    progress.trial_cut[w] = wp.int64(0)


@wp.kernel
def add_energies(
    # in
    elements: Elements,
    element_count: int,
    motion: Motion,
    settings: BarrierSettings,
    trial: Trial,
    goal: wp.array[wp.vec3],
    unknowns: Unknowns,
    bodies: SolvedBodies,
    progress: Progress,
    displaced: bool,
    # in and out
    energy: wp.array[wp.int64],
):
    """Adds the energies of elements, and the inertia of particles, at positions or at the displaced ones."""
    i = wp.tid()
    if i < element_count:
        kind = kind_of(elements, i)
        world = motion.world[first_vertex(elements, kind, i - elements.first[kind])]
        if progress.active[world] == 0 or (displaced and progress.searches[world] == 0):
            return
        value = element_energy(elements, i, kind, trial.moved, motion.x0, settings.dt)
        add_energy(energy, world, value, settings.units)
        return
    u = i - element_count
    world = unknowns.world[u]
    if progress.active[world] == 0 or (displaced and progress.searches[world] == 0) or unknowns.is_free[u] == 0:
        return
    p = unknowns.particle[u]
    if p < 0:
        body = unknowns.body[u]
        if u == bodies.unknown[body]:
            add_energy(energy, world, inertial_energy(bodies, motion, body, settings.dt), settings.units)
        return
    off = trial.moved[p] - to_double(goal[p])
    add_energy(energy, world, HALF * unknowns.inertia[u] * wp.dot(off, off), settings.units)


@wp.kernel
def write_moved(
    # in
    motion: Motion,
    unknowns: Unknowns,
    bodies: SolvedBodies,
    progress: Progress,
    displaced: bool,
    # out
    trial: Trial,
):
    """Writes positions, or the displaced ones."""
    v = wp.tid()
    world = motion.world[v]
    if progress.active[world] != 0:
        x = moved(trial, wp.where(displaced, progress.scale[world], 0.0), v)
        if unknowns.of_vertex[v] < 0 and is_solved(unknowns, v):
            x = exact_on_body(bodies.moved, bodies.low_moved, motion, v)
        trial.moved[v] = x


@wp.kernel
def decide_search(
    # in and out
    progress: Progress,
    # out
    search: wp.array[int],
):
    """Halves the shares of worlds whose energy has not fallen enough; not while something a program moves is coming."""
    w = wp.tid()
    if progress.active[w] == 0 or progress.searches[w] == 0:
        progress.trial[w] = wp.int64(0)
        return
    falls = _falls(progress, w)
    progress.trial[w] = wp.int64(0)
    if falls or progress.remaining[w] > 0.0:
        progress.searches[w] = 0
        return
    progress.scale[w] = 0.5 * progress.scale[w]
    if progress.scale[w] < _LEAST_SCALE:
        progress.scale[w] = 0.0
        progress.searches[w] = 0
        return
    search[0] = 1


@wp.kernel
def take(
    # in
    motion: Motion,
    unknowns: Unknowns,
    bodies: SolvedBodies,
    # in and out
    progress: Progress,
    trial: Trial,
):
    """Moves vertices by the shares of their worlds; what a program moves arrives exactly."""
    v = wp.tid()
    world = motion.world[v]
    if progress.active[world] == 0:
        return
    scale = progress.scale[world]
    given = not is_solved(unknowns, v)
    if given and scale == 1.0:
        trial.x[v] = motion.x1[v]
        trial.exact[v] = to_double(motion.x1[v])
    elif given or unknowns.of_vertex[v] >= 0:
        trial.exact[v] = moved(trial, scale, v)
        trial.x[v] = to_single(trial.exact[v])
    else:
        trial.x[v] = body_vertex(bodies.pose, motion, v)
        trial.exact[v] = exact_on_body(bodies.pose, bodies.low, motion, v)
        unknowns.arm[v] = arm_on_body(bodies, motion, v, trial.x[v])
    trial.path[wp.min(progress.steps[world], trial.path.shape[0] - 1), v] = trial.x[v]
    if not given:
        wp.atomic_max(progress.change, world, wp.length(trial.displaced[v]))


@wp.kernel
def decide_step(
    # in
    least_change: float,
    max_steps: int,
    max_late_steps: int,
    # in and out
    progress: Progress,
    plane_share: wp.array[float],
    # out
    goes_on: wp.array[int],
):
    """Ends worlds whose unknowns hardly change, or that have taken all their Newton steps.

    They are counted from when what a program moves arrives, if it does.
    """
    w = wp.tid()
    if progress.active[w] == 0:
        return
    scale = progress.scale[w]
    plane_share[w] = wp.where(scale == 1.0, 1.0, plane_share[w] + (1.0 - plane_share[w]) * scale)
    progress.steps[w] = progress.steps[w] + 1
    arrived = scale == 1.0 or progress.remaining[w] == 0.0
    steps = progress.steps[w]
    if progress.remaining[w] > 0.0:
        progress.late[w] = steps - 1
    ends = arrived and (progress.change[w] <= least_change or steps - progress.late[w] >= max_steps)
    stands = scale == 0.0
    if stands and arrived and progress.plain[w] != 0:
        ends = True
    progress.plain[w] = int(stands)
    if ends or (steps >= max_late_steps and not arrived):
        progress.active[w] = 0
        return
    goes_on[0] = 1


@wp.kernel
def finish(
    # in
    trial: Trial,
    unknowns: Unknowns,
    dt: float,
    # in and out
    motion: Motion,
    vertices: Vertices,
    end: StateArrays,
):
    """Writes where the step ends, and the predicted velocity with what the step has added to it."""
    v = wp.tid()
    x = trial.x[v]
    if not is_solved(unknowns, v):
        return
    # not by the way from the start, which in short steps is rounding
    off = to_single(trial.exact[v] - to_double(motion.x1[v]))
    velocity = motion.velocity[v] + off / dt
    if unknowns.of_vertex[v] < 0:
        velocity = predicted_velocity(motion, v, x)
    else:
        end.particle_q[v] = x
        end.particle_qd[v] = velocity
    motion.x1[v] = x
    motion.velocity[v] = velocity
    vertices.x1[v] = x
    vertices.velocity[v] = velocity


@wp.func
def _moves_bodies(unknowns: Unknowns, w: int) -> bool:
    """Returns whether a body is solved for in a world, whose last unknowns are those of bodies."""
    u = unknowns.of_worlds[w + 1] - 1
    moves = bool(False)
    while u >= unknowns.of_worlds[w] and unknowns.body[u] >= 0:
        moves = moves or unknowns.is_free[u] != 0
        u -= 1
    return moves


@wp.kernel
def go_back(
    # in
    progress: Progress,
    unknowns: Unknowns,
    contact_iteration: wp.array[int],
    begins: bool,
    # in and out
    place: wp.array[int],
    # out
    converged: wp.array[wp.bool],
    goes_back: wp.array[int],
    any_goes_back: wp.array[int],
):
    """Lets worlds whose straight way has contacts end a Newton step earlier, down to the first.

    It ``begins`` at the last one. They are not converged. A push out of a contact that the solve knows nothing of would
    give vertices much energy. Worlds in which bodies are solved for stay, as the ways of bodies are not kept.
    """
    w = wp.tid()
    goes_back[w] = 0
    if begins:
        place[w] = wp.where(_moves_bodies(unknowns, w), -1, wp.min(progress.steps[w], PATH) - 1)
    if contact_iteration[w] >= 0 and place[w] >= 0:
        converged[w] = False
        if place[w] > 0:
            place[w] = place[w] - 1
            goes_back[w] = 1
            any_goes_back[0] = 1


@wp.kernel
def retreat(
    # in
    trial: Trial,
    unknowns: Unknowns,
    dt: float,
    goes_back: wp.array[int],
    place: wp.array[int],
    # in and out
    motion: Motion,
    end: StateArrays,
):
    """Ends the step of worlds that go back where an earlier Newton step led."""
    v = wp.tid()
    world = motion.world[v]
    if goes_back[world] == 0 or unknowns.of_vertex[v] < 0 or not is_solved(unknowns, v):
        return
    x = trial.path[place[world], v]
    velocity = motion.velocity[v] + (x - motion.x1[v]) / dt
    end.particle_q[v] = x
    end.particle_qd[v] = velocity
    motion.x1[v] = x
    motion.velocity[v] = velocity
