"""What the threads of a world do in each phase of its Newton steps, and which comes next; see :mod:`.advance`.

Each function takes the share of a thread of a phase. What decides about the next phase is not written in that, as some
threads may still be reading it.
"""

import warp as wp

from ...response.state.planes import MovingPlanes
from ...response.state.structs import Motion
from ..elasticity.derivatives import element_energy, find_derivatives
from ..elasticity.elements import kind_of
from . import assembly, bodies, bounds, contact_lists, decisions, held, merge, merit, near, steps
from .flow import Phase, Place, Problem, wait_for_team
from .pairs import BarrierSettings, Candidates, candidate, clear_list, far_ones_stay, listed, listed_count
from .system import Progress, Worlds, end_of_contacts

wp.set_module_options({"enable_backward": False})

_TRUNCATIONS = wp.constant(4)
"""Passes in which the displacements of single vertices are cut, before those of their world are."""


@wp.func
def _to(at: Place, phase: int) -> wp.vec4i:
    return wp.vec4i(phase, at.then, at.passes, at.solves)


@wp.func
def _to_pairs(at: Place, phase: int, then: int) -> wp.vec4i:
    """Goes on with phases over pairs, ``then`` with another one."""
    return wp.vec4i(phase, then, at.passes, at.solves)


# What follows takes parts of a Problem, as a compiler copies one that is passed on.


@wp.func
def _end_of_vertices(worlds: Worlds, progress: Progress, w: int) -> int:
    """Returns the end of the vertices that may move in a step."""
    return wp.where(progress.given_moves[w] != 0, worlds.first_vertex[w + 1], worlds.first_given[w])


@wp.func
def _end_at_planes(worlds: Worlds, vertices_at_planes: int, w: int) -> int:
    """Returns the end of the vertices of a world of which some may be at planes."""
    return wp.where(vertices_at_planes > 0, worlds.first_given[w], 0)


@wp.func
def _has_few(candidates: Candidates, at: Place) -> bool:
    """Returns whether threads have one candidate each at most: they list and do what comes then at once."""
    return candidates.near[at.world] + candidates.far[at.world] <= at.threads


@wp.func
def _pair_count(candidates: Candidates, progress: Progress, w: int, of_all: bool) -> int:
    """Returns the number of listed candidates of a world, or of all but those that are far in any case."""
    count = listed_count(candidates, w)
    if of_all:
        count = candidates.near[w] + int(0)
        if not far_ones_stay(progress, w):
            count += candidates.far[w]
    return count


# From the start of a Newton step to its solve


@wp.func
def begin(at: Place, p: Problem, motion: Motion, planes: MovingPlanes, settings: BarrierSettings) -> wp.vec4i:
    """Begins the first Newton step."""
    if at.thread == 0:
        decisions.begin_newton_step(at.world, p.progress)
    return _to(at, Phase.DIFFERENTIATE)


@wp.func
def differentiate(at: Place, p: Problem, motion: Motion, planes: MovingPlanes, settings: BarrierSettings) -> wp.vec4i:
    """Finds derivatives and energies of elements, and what is left of the ways that a program moves something."""
    # things of different kinds in one phase are for different threads, so that they take place at the same time
    w, n, from_end = at.world, at.threads, at.threads - 1 - at.thread
    for k in range(p.worlds.first_vertex[w] + from_end, _end_of_vertices(p.worlds, p.progress, w), n):
        steps.find_remaining(p.worlds.vertices[k], w, motion, p.unknowns, p.trial, p.progress)
    merge.clear_buckets(w, from_end, n, p.contacts)
    is_far = decisions.is_far(w, p.far_change, p.progress)
    for k in range(p.worlds.first_element[w] + at.spread, p.worlds.first_element[w + 1], n):
        i = p.worlds.elements[k] + int(0)
        if i < 0:
            continue
        kind = kind_of(p.elements, i)
        energy = find_derivatives(i, kind, p.elements, p.trial.exact, motion.x0, settings.dt, is_far, p.derivatives)
        merit.add_energy(p.progress.energy, w, energy, settings.units)
    return wp.vec4i(int(Phase.LOADS), at.then, 0, 0)


@wp.func
def find_loads(at: Place, p: Problem, motion: Motion, planes: MovingPlanes, settings: BarrierSettings) -> wp.vec4i:
    """Finds the forces of elements, and the energy of inertia."""
    w, t, n = at.world, at.thread, at.threads
    first, end, energy = p.unknowns.of_worlds[w] + int(0), p.unknowns.of_worlds[w + 1] + int(0), p.progress.energy
    if t == 0:
        p.contacts.count[w] = 0
        contact_lists.clear_lists(w, p.contacts)
    for u in range(first + t, end, n):
        assembly.find_loads(u, w, p.derivatives, p.rows, p.unknowns, p.progress, settings.load, p.vectors.elastic)
        steps.add_inertia(u, w, motion, settings, p.trial, p.goal, p.unknowns, p.bodies, energy)
    for u in range(first + n - 1 - t, end, n):
        p.contacts.end[u] = 0
    phase = wp.where(listed_count(p.candidates, w) >= 0, int(Phase.FIND_NEAR), int(Phase.BEGIN_LIST))
    return _to_pairs(at, phase, Phase.COUNT)


@wp.func
def publish(at: Place, p: Problem, motion: Motion, planes: MovingPlanes, settings: BarrierSettings) -> wp.vec4i:
    """Finds what is near at the end of a step."""
    merge.clear_buckets(at.world, at.thread, at.threads, p.contacts)
    if at.thread == 0:
        p.contacts.count[at.world] = 0
    phase = wp.where(listed_count(p.candidates, at.world) >= 0, int(Phase.FIND_NEAR), int(Phase.BEGIN_LIST))
    return _to_pairs(at, wp.where(p.progress.steps[at.world] == 0, int(Phase.END), phase), Phase.END)


@wp.func
def begin_list(at: Place, p: Problem, motion: Motion, planes: MovingPlanes, settings: BarrierSettings) -> wp.vec4i:
    """Empties the list of candidates."""
    if at.thread == 0:
        clear_list(p.candidates, at.world)
    return _to(at, wp.where(_has_few(p.candidates, at), int(Phase.LIST_AND_FIND_NEAR), int(Phase.LIST_NEAR)))


@wp.func
def list_near(at: Place, p: Problem, motion: Motion, planes: MovingPlanes, settings: BarrierSettings) -> wp.vec4i:
    """Lists candidates that may be near each other: little for each of all, so that what follows has few."""
    for k in range(at.thread, _pair_count(p.candidates, p.progress, at.world, True), at.threads):
        near.list_near(candidate(p.candidates, at.world, k), at.world, p.candidates, p.trial)
    return _to(at, Phase.FIND_NEAR)


@wp.func
def find_near(at: Place, p: Problem, motion: Motion, planes: MovingPlanes, settings: BarrierSettings) -> wp.vec4i:
    """Finds contacts, of listed candidates or of all."""
    w, at_once = at.world, at.phase == Phase.LIST_AND_FIND_NEAR
    for k in range(at.thread, _pair_count(p.candidates, p.progress, at.world, at_once), at.threads):
        i, is_near = int(0), bool(True)
        if at_once:
            i = candidate(p.candidates, at.world, k)
            is_near = near.list_near(i, w, p.candidates, p.trial)
        else:
            i = listed(p.candidates, w, k) >> 1
        if is_near:
            near.find_near(i, w, motion, p.candidates, settings, p.trial, p.unknowns, p.progress, p.contacts)
    for k in range(p.worlds.first_vertex[w] + at.thread, _end_at_planes(p.worlds, p.vertices_at_planes, w), at.threads):
        v = p.worlds.vertices[k] + int(0)
        if v < p.vertices_at_planes:
            near.find_near_planes(
                v, w, motion, planes, p.plane_share, settings, p.trial, p.unknowns, p.progress, p.contacts
            )
    return _to(at, at.then)


@wp.func
def count_contacts(at: Place, p: Problem, motion: Motion, planes: MovingPlanes, settings: BarrierSettings) -> wp.vec4i:
    """Merges contacts, and counts those of each unknown."""
    w, first, parts = at.world, p.contacts.start[at.world] + int(0), p.contacts.parts
    for k in range(at.thread, parts * (end_of_contacts(p.contacts, w) - first), at.threads):
        i, part = first + k // parts, k % parts
        if at.solves == 0:
            merge.merge_contact(i, part, w, p.contacts)
        if part == 0:
            contact_lists.count_entries(i, w, p.contacts, p.unknowns)
            if at.solves == 0:
                merit.add_friction_energy(i, w, motion, p.contacts, settings, p.trial, p.progress.energy)
    return _to(at, Phase.PLACE)


@wp.func
def place_contacts(at: Place, p: Problem, motion: Motion, planes: MovingPlanes, settings: BarrierSettings) -> wp.vec4i:
    """Gives each unknown room for its contacts."""
    w = at.world
    if at.thread == 0:
        contact_lists.place_coupled(w, p.contacts, p.lacks)
    for u in range(p.unknowns.of_worlds[w] + at.thread, p.unknowns.of_worlds[w + 1], at.threads):
        contact_lists.place_entries(u, w, p.contacts)
    return _to(at, wp.where(p.contacts.count[w] > 0, int(Phase.LIST_CONTACTS), int(Phase.BLOCKS)))


@wp.func
def list_contacts(at: Place, p: Problem, motion: Motion, planes: MovingPlanes, settings: BarrierSettings) -> wp.vec4i:
    """Lists contacts by unknown."""
    for i in range(p.contacts.start[at.world] + at.thread, end_of_contacts(p.contacts, at.world), at.threads):
        contact_lists.list_entries(i, at.world, p.contacts, p.unknowns)
    return _to(at, Phase.SORT)


@wp.func
def sort_contacts(at: Place, p: Problem, motion: Motion, planes: MovingPlanes, settings: BarrierSettings) -> wp.vec4i:
    """Puts the contacts of each unknown into an order that does not depend on threads."""
    w = at.world
    if at.threads == 1:  # long lists in less than a thread for each entry takes
        for u in range(p.unknowns.of_worlds[w], p.unknowns.of_worlds[w + 1]):
            contact_lists.sort_list(u, p.contacts)
    else:
        first = p.contacts.entries_of_each * p.contacts.start[w]
        for i in range(first + at.thread, first + p.contacts.listed[w], at.threads):
            contact_lists.sort_entries(i, p.contacts)
    return _to(at, Phase.BLOCKS)


@wp.func
def add_blocks(at: Place, p: Problem, motion: Motion, planes: MovingPlanes, settings: BarrierSettings) -> wp.vec4i:
    """Adds up the blocks of the Hessian."""
    w = at.world
    count = assembly.block_count(p.rows, p.unknowns, w)
    parts = wp.where(p.parts * count <= at.threads, p.parts, 1)
    for i in range(at.thread, parts * count, at.threads):
        assembly.add_blocks(
            i,
            w,
            p.derivatives,
            p.contacts,
            p.unknowns,
            p.row_of_block,
            p.trial,
            p.goal,
            motion,
            p.bodies,
            settings.dt,
            p.rows,
            parts,
            p.matrix,
        )
    return _to(at, Phase.ASSEMBLE)


@wp.func
def assemble(at: Place, p: Problem, motion: Motion, planes: MovingPlanes, settings: BarrierSettings) -> wp.vec4i:
    """Adds up the gradient, and what preconditions."""
    w, n = at.world, at.threads
    count = p.unknowns.of_worlds[w + 1] - p.unknowns.of_worlds[w]
    turns = wp.where(p.parts * count <= n, 1, p.turns)
    for i in range(at.thread, p.parts * ((count + turns - 1) // turns), n):
        assembly.assemble(
            i,
            w,
            p.contacts,
            p.unknowns,
            p.trial,
            p.goal,
            motion,
            p.bodies,
            settings.dt,
            at.solves == 0,
            p.rows,
            p.matrix,
            p.parts,
            turns,
            p.vectors,
        )
    if at.thread == 0:
        p.progress.longest[w] = p.progress.remaining[w]
        if at.solves == 0:
            p.leaves[w] = 0
    return _to_pairs(at, Phase.SOLVE, Phase.BOUNDED)


# After a solve: displacements, and what bounds them


@wp.func
def displace(at: Place, p: Problem, motion: Motion, planes: MovingPlanes, settings: BarrierSettings) -> wp.vec4i:
    """Displaces vertices by the solution, and begins the list of candidates that this may bring together."""
    w, t, n = at.world, at.thread, at.threads
    if t == 0 and at.then == Phase.RELEASED:
        decisions.begin_release(w, p.progress)
    first_body, end = p.unknowns.first_of_bodies[w] + int(0), p.unknowns.of_worlds[w + 1] + int(0)
    for u in range(first_body + 2 * t, end, 2 * n):
        bodies.displace_body(u, motion, p.unknowns, p.vectors.solution, p.bodies)
    if first_body < end:
        wait_for_team(p.flow.arrived, w, at.blocks)
    if at.solves == 0 and at.then == Phase.BOUNDED:
        for u in range(p.unknowns.of_worlds[w] + t, first_body, n):
            steps.compare_solutions(u, w, settings, p.unknowns, p.vectors.solution, p.last, p.progress)
    for k in range(p.worlds.first_vertex[w] + t, _end_of_vertices(p.worlds, p.progress, w), n):
        steps.displace(
            p.worlds.vertices[k],
            w,
            motion,
            p.unknowns,
            p.vectors,
            p.lower,
            p.upper,
            p.bodies,
            p.trial,
            p.progress,
            p.limit,
            p.leaves,
        )
    if t == 0:
        clear_list(p.candidates, w)
    return _to(at, wp.where(_has_few(p.candidates, at), int(Phase.LIST_AND_BOUND), int(Phase.LIST_WAYS)))


@wp.func
def list_ways(at: Place, p: Problem, motion: Motion, planes: MovingPlanes, settings: BarrierSettings) -> wp.vec4i:
    """Lists candidates that displacements may bring together."""
    w, count = at.world, _pair_count(p.candidates, p.progress, at.world, True)
    following, of_following = int(0), wp.vec4()
    for k in range(at.thread - at.threads, count, at.threads):
        i, last = int(following), wp.vec4(of_following)
        if k + at.threads < count:
            following = candidate(p.candidates, w, k + at.threads)
            of_following = bounds.last_of_pair(following, p.candidates)
        if k >= 0:
            bounds.list_pair(i, last, w, p.candidates, p.trial, p.progress, at.passes > 0)
    return _to(at, Phase.BOUND)


@wp.func
def bound(at: Place, p: Problem, motion: Motion, planes: MovingPlanes, settings: BarrierSettings) -> wp.vec4i:
    """Finds the share of displacements before something meets, by listed candidates or by all."""
    w, at_once = at.world, at.phase == Phase.LIST_AND_BOUND
    for k in range(at.thread, _pair_count(p.candidates, p.progress, at.world, at_once), at.threads):
        i, is_new = int(0), bool(False)
        if at_once:
            i = candidate(p.candidates, at.world, k)
            last = bounds.last_of_pair(i, p.candidates)
            is_new = bounds.list_pair(i, last, w, p.candidates, p.trial, p.progress, at.passes > 0)
        else:
            entry = listed(p.candidates, w, k)
            i, is_new = entry >> 1, (entry & 1) != 0
        if is_new:
            bounds.bound_by_pair(i, w, p.candidates, p.trial, p.progress, p.limit)
    for k in range(p.worlds.first_vertex[w] + at.thread, _end_at_planes(p.worlds, p.vertices_at_planes, w), at.threads):
        v = p.worlds.vertices[k] + int(0)
        if v < p.vertices_at_planes:
            bounds.bound_by_planes(v, w, motion, planes, p.plane_share, settings, p.trial, p.progress, p.limit)
    return _to(at, at.then)


@wp.func
def hold(at: Place, p: Problem, motion: Motion, planes: MovingPlanes, settings: BarrierSettings) -> wp.vec4i:
    """Keeps the first solution, before pairs that would meet are held in another solve."""
    for u in range(p.unknowns.of_worlds[at.world] + at.thread, p.unknowns.of_worlds[at.world + 1], at.threads):
        if at.solves == 0:
            p.first[u] = p.vectors.solution[u]
    return wp.vec4i(int(Phase.RELEASE_HELD), at.then, at.passes, at.solves + 1)


@wp.func
def release_held(at: Place, p: Problem, motion: Motion, planes: MovingPlanes, settings: BarrierSettings) -> wp.vec4i:
    """Lets pairs go that the last solution would pull together."""
    w, t, n = at.world, at.thread, at.threads
    if t == 0:
        decisions.begin_hold(w, p.progress)
        contact_lists.clear_lists(w, p.contacts)
    for i in range(p.contacts.start[w] + t, end_of_contacts(p.contacts, w), n):
        held.release_held(i, p.unknowns, p.vectors.solution, p.contacts)
    for u in range(p.unknowns.of_worlds[w] + t, p.unknowns.of_worlds[w + 1], n):
        p.contacts.end[u] = 0
    return _to_pairs(at, Phase.HOLD_PAIRS, Phase.COUNT)


@wp.func
def hold_pairs(at: Place, p: Problem, motion: Motion, planes: MovingPlanes, settings: BarrierSettings) -> wp.vec4i:
    """Holds pairs that would meet."""
    w, group = at.world, 1 + at.solves
    for k in range(at.thread, _pair_count(p.candidates, p.progress, at.world, False), at.threads):
        i = listed(p.candidates, w, k) >> 1
        held.hold_pair(i, w, p.candidates, p.trial, p.unknowns, p.vectors.inverse, p.limit, group, p.contacts)
    for k in range(p.worlds.first_vertex[w] + at.thread, _end_at_planes(p.worlds, p.vertices_at_planes, w), at.threads):
        v = p.worlds.vertices[k] + int(0)
        if v < p.vertices_at_planes:
            held.hold_at_planes(
                v,
                w,
                motion,
                planes,
                p.plane_share,
                settings,
                p.trial,
                p.unknowns,
                p.vectors.inverse,
                group,
                p.contacts,
            )
    return _to(at, at.then)


@wp.func
def take_bound(at: Place, p: Problem, motion: Motion, planes: MovingPlanes, settings: BarrierSettings) -> wp.vec4i:
    """Takes the share of the world down to its bound."""
    if at.thread == 0:
        decisions.take_bound(at.world, p.progress)
    return _to(at, Phase.MOVE)


# Energies, cuts, and the end of a Newton step


@wp.func
def move(at: Place, p: Problem, motion: Motion, planes: MovingPlanes, settings: BarrierSettings) -> wp.vec4i:
    """Moves vertices by their shares, to find the energy there."""
    w, t, n, then = at.world, at.thread, at.threads, at.then + int(0)
    if t == 0:
        p.progress.bound[w] = 1.0
    if then == Phase.JUDGE and at.solves == 0:  # no pairs are held
        then = wp.where(decisions.may_cut(p.progress, w), int(Phase.BEGIN_CUTS), int(Phase.TAKE))
    first_body, end = p.unknowns.first_of_bodies[w] + int(0), p.unknowns.of_worlds[w + 1] + int(0)
    solution = p.vectors.solution
    for u in range(first_body + 2 * t, end, 2 * n):
        bodies.move_body(u, w, motion, p.unknowns, p.progress, p.trial.share, solution, False, p.bodies)
    if first_body < end:
        wait_for_team(p.flow.arrived, w, at.blocks)
    for k in range(p.worlds.first_vertex[w] + t, _end_of_vertices(p.worlds, p.progress, w), n):
        steps.write_moved(p.worlds.vertices[k], p.progress.scale[w], motion, p.unknowns, p.bodies, p.trial)
    return _to_pairs(at, Phase.ENERGY, then)


@wp.func
def find_energy(at: Place, p: Problem, motion: Motion, planes: MovingPlanes, settings: BarrierSettings) -> wp.vec4i:
    """Finds the energy where vertices are moved to."""
    w, t, n, energy = at.world, at.thread, at.threads, p.progress.trial
    from_middle = (t + n // 2) % n
    for k in range(p.worlds.first_element[w] + n - 1 - t, p.worlds.first_element[w + 1], n):
        i = p.worlds.elements[k] + int(0)
        if i < 0:
            continue
        kind = kind_of(p.elements, i)
        value = element_energy(p.elements, i, kind, p.trial.moved, motion.x0, settings.dt)
        merit.add_energy(energy, w, value, settings.units)
    for u in range(p.unknowns.of_worlds[w] + from_middle, p.unknowns.of_worlds[w + 1], n):
        steps.add_inertia(u, w, motion, settings, p.trial, p.goal, p.unknowns, p.bodies, energy)
    for i in range(p.contacts.start[w] + from_middle, end_of_contacts(p.contacts, w), n):
        merit.add_friction_energy(i, w, motion, p.contacts, settings, p.trial, energy)
    for k in range(t, _pair_count(p.candidates, p.progress, at.world, False), n):
        i = listed(p.candidates, w, k) >> 1
        merit.add_pair_energy(i, w, p.candidates, settings, p.trial, p.progress)
    for k in range(p.worlds.first_vertex[w] + t, _end_at_planes(p.worlds, p.vertices_at_planes, w), n):
        v = p.worlds.vertices[k] + int(0)
        if v < p.vertices_at_planes:
            merit.add_plane_energies(v, w, motion, planes, p.plane_share, settings, p.trial, p.progress)
    return _to(at, at.then)


@wp.func
def begin_release(at: Place, p: Problem, motion: Motion, planes: MovingPlanes, settings: BarrierSettings) -> wp.vec4i:
    """Goes back to the first solution."""
    for u in range(p.unknowns.of_worlds[at.world] + at.thread, p.unknowns.of_worlds[at.world + 1], at.threads):
        p.vectors.solution[u] = p.first[u]
    return _to_pairs(at, Phase.DISPLACE, Phase.RELEASED)


@wp.func
def begin_cuts(at: Place, p: Problem, motion: Motion, planes: MovingPlanes, settings: BarrierSettings) -> wp.vec4i:
    """Begins to cut single vertices in place of their world, where energies are lower then."""
    first, end = p.worlds.first_vertex[at.world] + at.thread, _end_of_vertices(p.worlds, p.progress, at.world)
    for k in range(first, end, at.threads):
        steps.begin_truncation(p.worlds.vertices[k], p.unknowns, p.lower, p.upper, p.trial)
    return _to(at, Phase.CUT)  # the first time by the bounds of the displacements, which are known


@wp.func
def cut(at: Place, p: Problem, motion: Motion, planes: MovingPlanes, settings: BarrierSettings) -> wp.vec4i:
    """Cuts displacements of vertices to their bounds."""
    w, t, begins, passes, then = at.world, at.thread, at.passes == 0, at.passes + 1, int(Phase.CUT)
    if t == 0 and begins:
        decisions.begin_cuts(w, p.whole, p.progress)
    for k in range(p.worlds.first_vertex[w] + t, _end_of_vertices(p.worlds, p.progress, w), at.threads):
        steps.truncate(p.worlds.vertices[k], p.unknowns, p.limit, begins, p.trial)
    if passes == _TRUNCATIONS:
        if t == 0:
            p.progress.bound[w] = 1.0
        then = int(Phase.TAKE_CUT)
    if t == 0:
        clear_list(p.candidates, w)
    return wp.vec4i(
        wp.where(_has_few(p.candidates, at), int(Phase.LIST_AND_BOUND), int(Phase.LIST_WAYS)), then, passes, at.solves
    )


@wp.func
def take_cut(at: Place, p: Problem, motion: Motion, planes: MovingPlanes, settings: BarrierSettings) -> wp.vec4i:
    """Takes the bound of what is cut."""
    if at.thread == 0:
        decisions.take_cut(at.world, p.progress)
    return _to_pairs(at, Phase.MOVE, Phase.CHOOSE_CUTS)


@wp.func
def choose_cuts(at: Place, p: Problem, motion: Motion, planes: MovingPlanes, settings: BarrierSettings) -> wp.vec4i:
    """Chooses between cuts of vertices and of their world."""
    if at.thread == 0:
        decisions.choose_truncation(at.world, p.whole, p.progress)
    return _to(at, Phase.UNDO_CUTS)


@wp.func
def undo_cuts(at: Place, p: Problem, motion: Motion, planes: MovingPlanes, settings: BarrierSettings) -> wp.vec4i:
    """Takes back cuts that were not chosen."""
    first, end = p.worlds.first_vertex[at.world] + at.thread, _end_of_vertices(p.worlds, p.progress, at.world)
    for k in range(first, end, at.threads):
        if p.progress.cuts[at.world] == 0:
            p.trial.share[p.worlds.vertices[k]] = 1.0
    return _to(at, Phase.TAKE)


@wp.func
def take(at: Place, p: Problem, motion: Motion, planes: MovingPlanes, settings: BarrierSettings) -> wp.vec4i:
    """Moves vertices for good."""
    w, t, n, solution = at.world, at.thread, at.threads, p.vectors.solution
    first_body, end = p.unknowns.first_of_bodies[w] + int(0), p.unknowns.of_worlds[w + 1] + int(0)
    for u in range(first_body + 2 * t, end, 2 * n):
        bodies.move_body(u, w, motion, p.unknowns, p.progress, p.trial.share, solution, True, p.bodies)
    if first_body < end:
        wait_for_team(p.flow.arrived, w, at.blocks)
    for k in range(p.worlds.first_vertex[w] + t, _end_of_vertices(p.worlds, p.progress, w), n):
        steps.take(p.worlds.vertices[k], w, motion, p.unknowns, p.bodies, p.progress, p.trial)
    return _to(at, Phase.DECIDE)


@wp.func
def decide(at: Place, p: Problem, motion: Motion, planes: MovingPlanes, settings: BarrierSettings) -> wp.vec4i:
    """Decides whether the world takes another Newton step, or tries a smaller share."""
    if at.thread == 0:
        decisions.decide(
            at.world, p.least_change, p.far_change, p.max_steps, p.max_late_steps, p.progress, p.plane_share
        )
    return _to(at, Phase.NEXT)
