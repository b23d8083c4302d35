"""Newton steps as one kernel: all that lies between two solves, phase after phase, read from top to bottom.

Each world has a team of threads, which take a share of each phase, and wait for each other behind it. What a phase
finds decides which comes next: without a launch, a host, or a condition of a CUDA graph in between. A world waits for
others only where it needs a search for candidates, until they end or need one as well.
"""

import warp as wp

from ...response.state.planes import MovingPlanes
from ...response.state.structs import Motion
from . import assembly, bodies, bounds, contact_lists, decisions, elasticity, held, merge, merit, near, steps
from .flow import Phase, Problem, Task, wait_for_team
from .pairs import BarrierSettings
from .system import end_of_contacts

wp.set_module_options({"enable_backward": False})

_TRUNCATIONS = wp.constant(4)
"""Passes in which the displacements of single vertices are cut, before those of their world are."""
_PREDICTIONS = wp.constant(2)
"""Solves of a Newton step after its first one, each of which holds what met in the one before."""


@wp.func
def _spread(thread: int, n: int) -> int:
    """Returns a number of a thread by which blocks take turns, warp by warp: each has its share of what is little."""
    if n == 1:
        return thread
    block, warp = thread // wp.block_dim(), thread % wp.block_dim() // 32
    return (warp * (n // wp.block_dim()) + block) * 32 + thread % 32


@wp.func
def _over_pairs(
    task: int,
    at_once: bool,
    is_shorter: bool,
    p: Problem,
    motion: Motion,
    planes: MovingPlanes,
    settings: BarrierSettings,
    solves: int,
    w: int,
    t: int,
    n: int,
):
    group = 1 + solves
    start, near_count = p.candidates.start[w], p.candidates.near[w]
    last = start + p.candidates.room[w] - 1
    # all candidates, with little to do for each, to list those with much: to be done at once by threads that have one
    lists, count = task == Task.LIST_NEAR or task == Task.LIST, p.candidates.listed[w] + int(0)
    if lists:
        count = near_count + p.candidates.far[w]
    for k in range(t, count, n):
        i, is_new = int(0), bool(True)
        if lists:
            i = wp.where(k < near_count, start + k, last - (k - near_count))
            if task == Task.LIST_NEAR:
                is_new = near.list_near(i, w, p.candidates, p.trial)
            else:
                is_new = bounds.list_pair(i, w, p.candidates, p.trial, p.progress, is_shorter)
        else:
            i = p.candidates.list[start + k] >> 1
            is_new = task != Task.BOUND or (p.candidates.list[start + k] & 1) != 0
        if not is_new or (lists and not at_once):
            continue
        if task == Task.FIND_NEAR or task == Task.LIST_NEAR:
            near.find_near(i, w, motion, p.candidates, settings, p.trial, p.unknowns, p.progress, p.contacts)
        elif task == Task.HOLD:
            held.hold_pair(i, w, p.candidates, p.trial, p.unknowns, p.vectors.inverse, p.limit, group, p.contacts)
        elif task == Task.BOUND or task == Task.LIST:
            bounds.bound_by_pair(i, w, p.candidates, p.trial, p.progress, p.limit)
        else:
            merit.add_pair_energy(i, w, motion, p.candidates, settings, p.trial, p.progress)
    if p.vertices_at_planes == 0 or (lists and not at_once):
        return
    for k in range(p.worlds.first_vertex[w] + t, p.worlds.first_given[w], n):
        v = p.worlds.vertices[k] + int(0)
        if v >= p.vertices_at_planes:
            continue
        if task == Task.FIND_NEAR or task == Task.LIST_NEAR:
            near.find_near_planes(
                v, w, motion, planes, p.plane_share, settings, p.trial, p.unknowns, p.progress, p.contacts
            )
        elif task == Task.HOLD:
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
        elif task == Task.BOUND or task == Task.LIST:
            bounds.bound_by_planes(v, w, motion, planes, p.plane_share, settings, p.trial, p.progress, p.limit)
        else:
            merit.add_plane_energies(v, w, motion, planes, p.plane_share, settings, p.trial, p.progress)


@wp.func
def _differentiate(k: int, order: int, p: Problem, motion: Motion, settings: BarrierSettings, is_far: bool):
    i = p.worlds.elements[k] + int(0)
    kind = elasticity.kind_of(p.elements, i)
    if order == 1:
        elasticity.find_gradient(i, kind, p.elements, p.trial.exact, motion.x0, settings.dt, p.derivatives)
    else:
        elasticity.find_hessian(i, kind, p.elements, p.trial.exact, motion.x0, settings.dt, is_far, p.derivatives)


@wp.func
def _add_element_energy(
    k: int, w: int, p: Problem, motion: Motion, settings: BarrierSettings, energy: wp.array[wp.int64]
):
    i = p.worlds.elements[k] + int(0)
    kind = elasticity.kind_of(p.elements, i)
    value = elasticity.element_energy(p.elements, i, kind, p.trial.moved, motion.x0, settings.dt)
    merit.add_energy(energy, w, value, settings.units)


def _advance(
    # in
    motion: Motion,
    planes: MovingPlanes,
    settings: BarrierSettings,
    least_change: float,
    far_change: float,
    max_steps: int,
    max_late_steps: int,
    resumes: int,
    # in and out
    p: Problem,
    n: int,
    blocks: int,
):
    """Goes on with the Newton steps of worlds until a solve, a search for candidates, or their end comes next.

    ``n`` threads, in so many blocks, are the team of a world. Those that waited for candidates or buffers go on where
    it ``resumes``. What decides about the next phase is not written in that, as some threads may still be reading it.
    """
    w, t = wp.tid() // n, wp.tid() % n
    phase, solves = p.flow.phase[w] + int(0), p.flow.solves[w] + int(0)
    progress, arrived = p.progress, p.flow.arrived
    if resumes != 0 and phase > Phase.SOLVE and phase < Phase.END:
        phase = int(Phase.DIFFERENTIATE)
    if phase >= Phase.SOLVE or (progress.active[w] == 0 and phase != Phase.PUBLISH):
        return
    # things of different kinds in one phase are for different threads, so that they take place at the same time
    from_end, from_middle = n - 1 - t, (t + n // 2) % n
    spread = _spread(t, n)
    first_vertex, end_of_vertices = p.worlds.first_vertex[w] + int(0), p.worlds.first_given[w] + int(0)
    if progress.given_moves[w] != 0:
        end_of_vertices = p.worlds.first_vertex[w + 1] + int(0)
    first_unknown, end_of_unknowns = p.unknowns.of_worlds[w] + int(0), p.unknowns.of_worlds[w + 1] + int(0)
    first_body = p.unknowns.first_of_bodies[w] + int(0)
    first_element, end_of_elements = p.worlds.first_element[w] + int(0), p.worlds.first_element[w + 1] + int(0)
    first_contact = p.contacts.start[w] + int(0)
    # of the phase over pairs: what it does, and which phase follows
    task, then = int(Task.BOUND), int(Phase.BOUNDED)
    passes, releases, is_listed = int(0), bool(False), bool(True)
    while phase < Phase.SOLVE:
        if phase == Phase.BEGIN:
            if t == 0:
                decisions.begin_newton_step(w, progress)
            phase = int(Phase.DIFFERENTIATE)
        elif phase == Phase.PUBLISH:  # what is near at the end
            merge.clear_buckets(w, t, n, p.contacts)
            if t == 0:
                p.contacts.count[w] = 0
            task, then, phase = int(Task.FIND_NEAR), int(Phase.END), int(Phase.PAIRS)
            if progress.steps[w] == 0:
                phase = int(Phase.END)
            elif p.candidates.listed[w] < 0:
                phase = int(Phase.BEGIN_LIST)
        elif phase == Phase.DIFFERENTIATE:
            solves = int(0)
            is_listed = p.candidates.listed[w] >= 0
            for k in range(first_vertex + from_end, end_of_vertices, n):
                steps.find_remaining(p.worlds.vertices[k], w, motion, p.unknowns, p.trial, progress)
            merge.clear_buckets(w, from_end, n, p.contacts)
            is_far = decisions.is_far(w, far_change, progress)
            for k in range(first_element + spread, end_of_elements, n):
                _differentiate(k, 1, p, motion, settings, is_far)
            for k in range(first_element + (spread + n // 4) % n, end_of_elements, n):
                _differentiate(k, 2, p, motion, settings, is_far)
            for k in range(first_element + (spread + n // 2) % n, end_of_elements, n):
                _add_element_energy(k, w, p, motion, settings, progress.energy)
            phase = int(Phase.LOADS)
        elif phase == Phase.LOADS:
            if t == 0:
                p.contacts.count[w] = 0
                contact_lists.clear_lists(w, p.contacts)
            for u in range(first_unknown + t, end_of_unknowns, n):
                assembly.find_loads(u, w, p.derivatives, p.rows, p.unknowns, progress, settings.load)
                steps.add_inertia(u, w, motion, settings, p.trial, p.goal, p.unknowns, p.bodies, progress.energy)
            for u in range(first_unknown + from_end, end_of_unknowns, n):
                p.contacts.end[u] = 0
            task, then, phase = int(Task.FIND_NEAR), int(Phase.COUNT), int(Phase.PAIRS)
            if not is_listed:
                phase = int(Phase.BEGIN_LIST)
        elif phase == Phase.BEGIN_LIST:
            if t == 0:
                p.candidates.listed[w] = 0
            task, phase = int(Task.LIST_NEAR), int(Phase.PAIRS)
        elif phase == Phase.RELEASE_HELD:
            if t == 0:
                decisions.begin_hold(w, progress)
            for i in range(first_contact + t, end_of_contacts(p.contacts, w), n):
                held.release_held(i, p.unknowns, p.vectors.solution, p.contacts)
            for u in range(first_unknown + t, end_of_unknowns, n):
                p.contacts.end[u] = 0
            if t == 0:
                contact_lists.clear_lists(w, p.contacts)
            task, then, phase = int(Task.HOLD), int(Phase.COUNT), int(Phase.PAIRS)
        elif phase == Phase.PAIRS:
            if task == Task.ENERGY:
                for k in range(first_element + from_end, end_of_elements, n):
                    _add_element_energy(k, w, p, motion, settings, progress.trial)
                for u in range(first_unknown + from_middle, end_of_unknowns, n):
                    steps.add_inertia(u, w, motion, settings, p.trial, p.goal, p.unknowns, p.bodies, progress.trial)
                for i in range(first_contact + from_middle, end_of_contacts(p.contacts, w), n):
                    merit.add_friction_energy(i, w, motion, p.contacts, settings, p.trial, progress.trial)
            at_once = p.candidates.near[w] + p.candidates.far[w] <= n
            _over_pairs(task, at_once, passes > 0, p, motion, planes, settings, solves, w, t, n)
            if at_once or (task != Task.LIST_NEAR and task != Task.LIST):
                phase = then
            if task == Task.LIST_NEAR:
                task = int(Task.FIND_NEAR)
            elif task == Task.LIST:
                task = int(Task.BOUND)
        elif phase == Phase.COUNT:
            for k in range(t, p.contacts.parts * (end_of_contacts(p.contacts, w) - first_contact), n):
                i, part = first_contact + k // p.contacts.parts, k % p.contacts.parts
                if solves == 0:
                    merge.merge_contact(i, part, w, p.contacts)
                if part == 0:
                    contact_lists.count_entries(i, w, p.contacts, p.unknowns)
                    if solves == 0:
                        merit.add_friction_energy(i, w, motion, p.contacts, settings, p.trial, progress.energy)
            phase = int(Phase.PLACE)
        elif phase == Phase.PLACE:
            if t == 0:
                contact_lists.place_coupled(w, p.contacts, p.lacks)
            for u in range(first_unknown + t, end_of_unknowns, n):
                contact_lists.place_entries(u, w, p.contacts)
            phase = wp.where(p.contacts.count[w] > 0, int(Phase.LIST), int(Phase.BLOCKS))
        elif phase == Phase.LIST:
            for i in range(first_contact + t, end_of_contacts(p.contacts, w), n):
                contact_lists.list_entries(i, w, p.contacts, p.unknowns)
            phase = int(Phase.SORT)
        elif phase == Phase.SORT:
            if n == 1:  # long lists in less than a thread for each entry takes
                for u in range(first_unknown, end_of_unknowns):
                    contact_lists.sort_list(u, p.contacts)
            else:
                first_entry = p.contacts.entries_of_each * first_contact
                for i in range(first_entry + t, first_entry + p.contacts.listed[w], n):
                    contact_lists.sort_entries(i, p.contacts)
            phase = int(Phase.BLOCKS)
        elif phase == Phase.BLOCKS:
            count = p.rows.first[end_of_unknowns] - p.rows.first[first_unknown]
            for i in range(t, p.parts * ((count + p.turns - 1) // p.turns), n):
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
                    p.parts,
                    p.turns,
                    p.matrix,
                )
            phase = int(Phase.ASSEMBLE)
        elif phase == Phase.ASSEMBLE:
            count = end_of_unknowns - first_unknown
            turns = wp.where(p.parts * count <= n, 1, p.turns)
            for i in range(t, p.parts * ((count + turns - 1) // turns), n):
                assembly.assemble(
                    i,
                    w,
                    p.derivatives,
                    p.contacts,
                    p.unknowns,
                    p.trial,
                    p.goal,
                    motion,
                    p.bodies,
                    settings.dt,
                    solves == 0,
                    p.rows,
                    p.matrix,
                    p.parts,
                    turns,
                    p.vectors,
                )
            if t == 0 and solves == 0:
                p.leaves[w] = 0
            phase = int(Phase.SOLVE)
        elif phase == Phase.DISPLACE:  # after a solve
            if t == 0 and releases:
                decisions.begin_release(w, progress)
            for u in range(first_body + 2 * t, end_of_unknowns, 2 * n):
                bodies.displace_body(u, motion, p.unknowns, p.vectors.solution, p.bodies)
            if first_body < end_of_unknowns:
                wait_for_team(arrived, w, blocks)
            for k in range(first_vertex + t, end_of_vertices, n):
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
                    progress,
                    p.limit,
                    p.leaves,
                )
            if t == 0:
                p.candidates.listed[w] = 0
            task, then, phase = int(Task.LIST), int(Phase.BOUNDED), int(Phase.PAIRS)
        elif phase == Phase.HOLD:  # what would meet on the displacements, and solve again
            for u in range(first_unknown + t, end_of_unknowns, n):
                if solves == 0:
                    p.first[u] = p.vectors.solution[u]
            solves += 1
            phase = int(Phase.RELEASE_HELD)
        elif phase == Phase.TAKE_BOUND:
            if t == 0:
                decisions.take_bound(w, progress)
            phase = int(Phase.DISPLACED)
        elif phase == Phase.DISPLACED:
            if t == 0:
                progress.bound[w] = 1.0
            if then == Phase.JUDGE and solves == 0:  # no pairs are held
                then = wp.where(decisions.may_cut(progress, w), int(Phase.BEGIN_CUTS), int(Phase.TAKE))
            for u in range(first_body + 2 * t, end_of_unknowns, 2 * n):
                bodies.move_body(u, w, motion, p.unknowns, progress, p.trial.share, p.vectors.solution, False, p.bodies)
            if first_body < end_of_unknowns:
                wait_for_team(arrived, w, blocks)
            for k in range(first_vertex + t, end_of_vertices, n):
                steps.write_moved(p.worlds.vertices[k], progress.scale[w], motion, p.unknowns, p.bodies, p.trial)
            task, phase = int(Task.ENERGY), int(Phase.PAIRS)
        elif phase == Phase.BEGIN_RELEASE:
            for u in range(first_unknown + t, end_of_unknowns, n):
                p.vectors.solution[u] = p.first[u]
            releases, phase = True, int(Phase.DISPLACE)
        elif phase == Phase.BEGIN_CUTS:  # of single vertices in place of their world, where energies are lower then
            for k in range(first_vertex + t, end_of_vertices, n):
                steps.begin_truncation(p.worlds.vertices[k], p.unknowns, p.lower, p.upper, p.trial)
            phase = int(Phase.CUT)  # the first time by the bounds of the displacements, which are known
        elif phase == Phase.CUT:
            if t == 0 and passes == 0:
                decisions.begin_cuts(w, p.whole, progress)
            for k in range(first_vertex + t, end_of_vertices, n):
                steps.truncate(p.worlds.vertices[k], p.unknowns, p.limit, passes == 0, p.trial)
            passes += 1
            then = int(Phase.CUT)
            if passes == _TRUNCATIONS:
                if t == 0:
                    progress.bound[w] = 1.0
                then = int(Phase.TAKE_CUT)
            if t == 0:
                p.candidates.listed[w] = 0
            task, phase = int(Task.LIST), int(Phase.PAIRS)
        elif phase == Phase.TAKE_CUT:
            if t == 0:
                decisions.take_cut(w, progress)
            then, phase = int(Phase.CHOOSE_CUTS), int(Phase.DISPLACED)
        elif phase == Phase.CHOOSE_CUTS:
            if t == 0:
                decisions.choose_truncation(w, p.whole, progress)
            phase = int(Phase.UNDO_CUTS)
        elif phase == Phase.UNDO_CUTS:
            for k in range(first_vertex + t, end_of_vertices, n):
                if progress.cuts[w] == 0:
                    p.trial.share[p.worlds.vertices[k]] = 1.0
            phase = int(Phase.TAKE)
        elif phase == Phase.TAKE:
            for u in range(first_body + 2 * t, end_of_unknowns, 2 * n):
                bodies.move_body(u, w, motion, p.unknowns, progress, p.trial.share, p.vectors.solution, True, p.bodies)
            if first_body < end_of_unknowns:
                wait_for_team(arrived, w, blocks)
            for k in range(first_vertex + t, end_of_vertices, n):
                steps.take(p.worlds.vertices[k], w, motion, p.unknowns, p.bodies, progress, p.trial)
            phase = int(Phase.DECIDE)
        elif phase == Phase.DECIDE:
            if t == 0:
                decisions.decide(w, least_change, far_change, max_steps, max_late_steps, progress, p.plane_share)
            phase = int(Phase.NEXT)
        wait_for_team(arrived, w, blocks)
        if (task == Task.FIND_NEAR or task == Task.HOLD) and phase == then and p.grows != 0:
            if end_of_contacts(p.contacts, w) - first_contact < p.contacts.count[w]:
                phase = int(Phase.GROW)
        if phase == Phase.BOUNDED:
            meets = progress.bound[w] < 1.0
            then, phase = int(Phase.JUDGE), int(Phase.DISPLACED)
            if releases:
                then, phase = int(Phase.END_RELEASE), int(Phase.TAKE_BOUND)
            elif meets and solves < _PREDICTIONS:
                phase = int(Phase.HOLD)
            elif meets:
                phase = int(Phase.TAKE_BOUND)
        elif phase == Phase.JUDGE and decisions.rises(w, progress):
            phase = int(Phase.BEGIN_RELEASE)
        elif phase == Phase.JUDGE or phase == Phase.END_RELEASE:
            phase = wp.where(decisions.may_cut(progress, w), int(Phase.BEGIN_CUTS), int(Phase.TAKE))
        elif phase == Phase.NEXT:
            phase = int(Phase.DIFFERENTIATE)
            if progress.searches[w] != 0:
                then, phase = int(Phase.TAKE), int(Phase.DISPLACED)
            elif progress.active[w] == 0:
                phase = int(Phase.END)
            elif p.leaves[w] != 0:
                phase = int(Phase.SEARCH_CANDIDATES)
    if t == 0:
        p.flow.solves[w] = solves
        progress.solving[w] = int(phase == Phase.SOLVE)
        if phase == Phase.SOLVE:
            p.flow.solves_next[0] = 1
            phase = int(Phase.DISPLACE)
        elif phase == Phase.END:
            p.leaves[w] = 0
        else:
            p.flow.goes_on[0] = 1
            progress.energy[w] = wp.int64(0)  # the Newton step begins anew
            progress.held[w] = 0
            if phase == Phase.SEARCH_CANDIDATES:
                p.any_leaves[0] = 1
        p.flow.phase[w] = phase


ADVANCE = {
    threads: wp.kernel(_advance, enable_backward=False, module=f"{__name__}.blocks_of_{threads}", launch_bounds=threads)
    for threads in (256, 512)
}
"""The kernel by the threads of its blocks on a GPU, one a multiprocessor: fewer have more registers each."""
