"""Newton steps as one kernel: all that lies between two solves, phase after phase, read from top to bottom.

All threads of the device take a share of each phase, and wait for each other behind it. What a phase finds in some
world decides which comes next: without a launch, a host, or a condition of a CUDA graph in between.
"""

from enum import IntEnum

import warp as wp

from ...response.state.planes import MovingPlanes
from ...response.state.structs import Motion
from . import assembly, bodies, bounds, contact_lists, decisions, elasticity, held, merge, merit, near, steps
from .conjugate_gradients import Vectors
from .matrix import Matrix
from .pairs import BarrierSettings, Candidates, Trial
from .rows import Rows
from .system import Contacts, Flag, Progress, Unknowns, contact_count

wp.set_module_options({"enable_backward": False})

_TRUNCATIONS = wp.constant(4)
"""Passes in which the displacements of single vertices are cut, before those of their world are."""
_PREDICTIONS = wp.constant(2)
"""Solves of a Newton step after its first one, each of which holds what met in the one before."""


class Phase(IntEnum):
    """What all threads do until they wait for each other, or leave for what another kernel does."""

    BEGIN = 0
    DIFFERENTIATE = 1
    LOADS = 2
    RELEASE_HELD = 3
    PAIRS = 4
    COUNT = 5
    PLACE = 6
    LIST = 7
    SORT = 8
    BLOCKS = 9
    ASSEMBLE = 10
    DISPLACE = 11
    BOUNDED = 12
    HOLD = 13
    TAKE_BOUND = 14
    DISPLACED = 15
    JUDGE = 16
    JUDGED = 17
    BEGIN_RELEASE = 18
    END_RELEASE = 19
    BEGIN_CUTS = 20
    CUT = 21
    TAKE_CUT = 22
    CHOOSE_CUTS = 23
    UNDO_CUTS = 24
    TAKE = 25
    DECIDE = 26
    NEXT = 27
    PUBLISH = 28
    SOLVE = 29
    SEARCH_CANDIDATES = 30
    GROW = 31
    END = 32


class Task(IntEnum):
    """What the phase over pairs does."""

    FIND_NEAR = 0
    HOLD = 1
    BOUND = 2
    ENERGY = 3


@wp.struct
class Flow:
    """Where the Newton steps of all worlds are.

    Attributes:
        phase: The phase that comes next, shape [1].
        solves: Solves of the Newton step so far, shape [1].
        solves_next: 1 if a solve comes next, shape [1].
        goes_on: 1 if a solve, a search for candidates or larger buffers come next, shape [1].
        arrived: How often blocks of threads have waited, shape [1].
    """

    phase: wp.array[int]
    solves: wp.array[int]
    solves_next: wp.array[int]
    goes_on: wp.array[int]
    arrived: wp.array[int]


@wp.struct
class Problem:
    """What Newton steps read and write.

    Attributes:
        row_of_block: Row of each block of ``rows``.
        goal: Where inertia leads each vertex [m].
        lower, upper: Boxes of vertices within which the candidates are all that may come near each other [m].
        limit: Share of its displacement before each vertex meets something.
        plane_share: Share of their ways that infinite planes have gone, by world.
        whole: Share that each world takes without cuts of single vertices.
        first: Solution of the Newton step before pairs are held.
        leaves: 1 for each world of which a vertex leaves its box, and for any, last.
        lacks: See :func:`.step_report.write_results`.
        vertices_at_planes: Vertices that infinite planes may stop, 0 if there are none.
        parts: Threads that share rows and blocks.
        turns: Rows or blocks that they share, one after the other, no more than they are.
        grows: 1 if the host can enlarge the buffers of contacts, outside of CUDA graphs.
    """

    elements: elasticity.Elements
    derivatives: elasticity.Derivatives
    rows: Rows
    row_of_block: wp.array[int]
    matrix: Matrix
    vectors: Vectors
    unknowns: Unknowns
    bodies: bodies.SolvedBodies
    candidates: Candidates
    contacts: Contacts
    trial: Trial
    progress: Progress
    flow: Flow
    goal: wp.array[wp.vec3]
    lower: wp.array[wp.vec3]
    upper: wp.array[wp.vec3]
    limit: wp.array[float]
    plane_share: wp.array[float]
    whole: wp.array[float]
    first: wp.array[wp.vec3]
    leaves: wp.array[int]
    lacks: wp.array[int]
    element_count: int
    vertices_at_planes: int
    parts: int
    turns: int
    grows: int


@wp.func_native(
    snippet="""
#if defined(__CUDA_ARCH__)
    __syncthreads();
    if (gridDim.x > 1) {
        if (threadIdx.x == 0) {
            __threadfence();
            const unsigned before = atomicAdd((unsigned*)arrived.data, 1u);
            const unsigned all = (before / gridDim.x + 1u) * gridDim.x;
            while ((int)(*(volatile unsigned*)arrived.data - all) < 0) {}
            __threadfence();
        }
        __syncthreads();
    }
#endif
"""
)
def wait_for_all(arrived: wp.array[int]):
    """Waits until all threads of the launch are here, and sees what they have written; they must all be running."""
    ...


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
    is_shorter: bool,
    p: Problem,
    motion: Motion,
    planes: MovingPlanes,
    settings: BarrierSettings,
    solves: int,
    t: int,
    n: int,
):
    group = 1 + solves
    near_count = p.candidates.near[0]
    for k in range(t, near_count + p.candidates.far[0], n):
        i = wp.where(k < near_count, k, p.candidates.corners.shape[0] - 1 - (k - near_count))
        if task == Task.FIND_NEAR:
            near.find_near(i, motion, p.candidates, settings, p.trial, p.unknowns, p.progress, p.contacts)
        elif task == Task.HOLD:
            held.hold_pair(
                i,
                p.candidates,
                p.trial,
                p.unknowns,
                p.vectors.inverse,
                p.progress,
                p.limit,
                group,
                p.contacts,
            )
        elif task == Task.BOUND:
            bounds.bound_by_pair(i, p.candidates, p.trial, p.progress, p.limit, is_shorter)
        else:
            merit.add_pair_energy(i, motion, p.candidates, settings, p.trial, p.progress)
    for v in range(t, p.vertices_at_planes, n):
        if task == Task.FIND_NEAR:
            near.find_near_planes(
                v, motion, planes, p.plane_share, settings, p.trial, p.unknowns, p.progress, p.contacts
            )
        elif task == Task.HOLD:
            held.hold_at_planes(
                v,
                motion,
                planes,
                p.plane_share,
                settings,
                p.trial,
                p.unknowns,
                p.vectors.inverse,
                p.progress,
                group,
                p.contacts,
            )
        elif task == Task.BOUND:
            bounds.bound_by_planes(v, motion, planes, p.plane_share, settings, p.trial, p.progress, p.limit)
        else:
            merit.add_plane_energies(v, motion, planes, p.plane_share, settings, p.trial, p.progress)


@wp.func
def _differentiate(i: int, order: int, p: Problem, motion: Motion, settings: BarrierSettings, far_change: float):
    kind = elasticity.kind_of(p.elements, i)
    world = motion.world[elasticity.first_vertex(p.elements, kind, i - p.elements.first[kind])]
    if p.progress.solving[world] == 0:
        return
    if order == 1:
        elasticity.find_gradient(i, kind, p.elements, p.trial.exact, motion.x0, settings.dt, p.derivatives)
    else:
        is_far = decisions.is_far(world, far_change, p.progress)
        elasticity.find_hessian(i, kind, p.elements, p.trial.exact, motion.x0, settings.dt, is_far, p.derivatives)


@wp.func
def _add_element_energy(
    i: int, p: Problem, motion: Motion, settings: BarrierSettings, mask: wp.array[int], energy: wp.array[wp.int64]
):
    kind = elasticity.kind_of(p.elements, i)
    world = motion.world[elasticity.first_vertex(p.elements, kind, i - p.elements.first[kind])]
    if mask[world] == 0:
        return
    value = elasticity.element_energy(p.elements, i, kind, p.trial.moved, motion.x0, settings.dt)
    merit.add_energy(energy, world, value, settings.units)


@wp.func
def _add_inertia(
    u: int, p: Problem, motion: Motion, settings: BarrierSettings, mask: wp.array[int], energy: wp.array[wp.int64]
):
    world = p.unknowns.world[u]
    if mask[world] != 0:
        steps.add_inertia(u, motion, settings, p.trial, p.goal, p.unknowns, p.bodies, world, energy)


def _advance(
    # in
    motion: Motion,
    planes: MovingPlanes,
    settings: BarrierSettings,
    least_change: float,
    far_change: float,
    max_steps: int,
    max_late_steps: int,
    # in and out
    p: Problem,
    n: int,
):
    """Goes on with the Newton steps of all worlds until a solve, a search for candidates, or their end comes next."""
    # things of different kinds in one phase are for different threads, so that they take place at the same time
    t = wp.tid()
    from_end, from_middle = n - 1 - t, (t + n // 2) % n
    spread = _spread(t, n)
    progress = p.progress
    vertices, unknowns, worlds = p.trial.x.shape[0], p.vectors.solution.shape[0], p.progress.active.shape[0]
    body_count = p.bodies.unknown.shape[0]
    phase, solves = p.flow.phase[0] + int(0), p.flow.solves[0] + int(0)
    # of the phase over pairs: what it does, and which phase follows
    task, then = int(Task.BOUND), int(Phase.BOUNDED)
    passes, releases = int(0), bool(False)
    while phase < Phase.SOLVE:
        if phase == Phase.BEGIN:
            for w in range(t, worlds, n):
                decisions.begin_newton_step(w, progress)
            phase = int(Phase.DIFFERENTIATE)
        elif phase == Phase.PUBLISH:  # what is near at the end
            for w in range(t, worlds, n):
                progress.solving[w] = progress.steps[w]
            for v in range(t, p.contacts.bucket.shape[0], n):
                p.contacts.bucket[v] = 0
            if t == 0:
                p.contacts.count[0] = 0
            task, then, phase = int(Task.FIND_NEAR), int(Phase.END), int(Phase.PAIRS)
        elif phase == Phase.DIFFERENTIATE:
            solves = int(0)
            for v in range(from_end, vertices, n):
                steps.find_remaining(v, motion, p.unknowns, p.trial, progress)
            for k in range(from_end, p.contacts.bucket.shape[0], n):
                p.contacts.bucket[k] = 0
            for i in range(spread, p.element_count, n):
                _differentiate(i, 1, p, motion, settings, far_change)
            for i in range((spread + n // 4) % n, p.element_count, n):
                _differentiate(i, 2, p, motion, settings, far_change)
            for i in range((spread + n // 2) % n, p.element_count, n):
                _add_element_energy(i, p, motion, settings, progress.solving, progress.energy)
            phase = int(Phase.LOADS)
        elif phase == Phase.LOADS:
            if t == 0:
                p.contacts.count[0] = 0
            for u in range(t, unknowns, n):
                assembly.find_loads(u, p.derivatives, p.rows, p.unknowns, progress, settings.load)
                _add_inertia(u, p, motion, settings, progress.solving, progress.energy)
            for u in range(from_end, wp.max(unknowns, worlds), n):
                contact_lists.clear_lists(u, p.contacts)
            task, then, phase = int(Task.FIND_NEAR), int(Phase.COUNT), int(Phase.PAIRS)
        elif phase == Phase.RELEASE_HELD:
            for i in range(t, contact_count(p.contacts), n):
                held.release_held(i, motion, p.unknowns, p.vectors.solution, progress, p.contacts)
            for u in range(t, wp.max(unknowns, worlds), n):
                contact_lists.clear_lists(u, p.contacts)
            task, then, phase = int(Task.HOLD), int(Phase.COUNT), int(Phase.PAIRS)
        elif phase == Phase.PAIRS:
            if task == Task.ENERGY:
                if t == 0:
                    progress.flags[Flag.SEARCHES] = 0
                for i in range(from_end, p.element_count, n):
                    _add_element_energy(i, p, motion, settings, progress.searches, progress.trial)
                for u in range(from_middle, unknowns, n):
                    _add_inertia(u, p, motion, settings, progress.searches, progress.trial)
                for i in range(from_middle, contact_count(p.contacts), n):
                    if progress.searches[motion.world[p.contacts.corners[i][0]]] != 0:
                        merit.add_friction_energy(i, motion, p.contacts, settings, p.trial, progress.trial)
            _over_pairs(task, passes > 0, p, motion, planes, settings, solves, t, n)
            phase = then
        elif phase == Phase.COUNT:
            for k in range(t, p.contacts.parts * contact_count(p.contacts), n):
                i, part = k // p.contacts.parts, k % p.contacts.parts
                if solves == 0:
                    merge.merge_contact(i, part, p.contacts)
                if part == 0:
                    contact_lists.count_entries(i, motion, p.contacts, p.unknowns)
                    if solves == 0:
                        merit.add_friction_energy(i, motion, p.contacts, settings, p.trial, progress.energy)
            phase = int(Phase.PLACE)
        elif phase == Phase.PLACE:
            for u in range(t, wp.max(unknowns, worlds), n):
                contact_lists.place_entries(u, p.contacts, p.lacks)
            phase = int(Phase.LIST)
        elif phase == Phase.LIST:
            for i in range(t, contact_count(p.contacts), n):
                contact_lists.list_entries(i, motion, p.contacts, p.unknowns)
            phase = int(Phase.SORT)
        elif phase == Phase.SORT:
            if n == 1:  # long lists in less than a thread for each entry takes
                for u in range(unknowns):
                    contact_lists.sort_list(u, p.contacts)
            else:
                for i in range(t, p.contacts.listed[0], n):
                    contact_lists.sort_entries(i, p.contacts)
            phase = int(Phase.BLOCKS)
        elif phase == Phase.BLOCKS:
            for i in range(t, p.parts * ((p.row_of_block.shape[0] + p.turns - 1) // p.turns), n):
                assembly.add_blocks(
                    i,
                    p.derivatives,
                    p.contacts,
                    p.unknowns,
                    p.row_of_block,
                    p.trial,
                    p.goal,
                    motion,
                    p.bodies,
                    settings.dt,
                    progress,
                    p.rows,
                    p.parts,
                    p.turns,
                    p.matrix,
                )
            phase = int(Phase.ASSEMBLE)
        elif phase == Phase.ASSEMBLE:
            for i in range(t, p.parts * ((unknowns + p.turns - 1) // p.turns), n):
                assembly.assemble(
                    i,
                    p.derivatives,
                    p.contacts,
                    p.unknowns,
                    p.trial,
                    p.goal,
                    motion,
                    p.bodies,
                    settings.dt,
                    progress,
                    solves == 0,
                    p.rows,
                    p.matrix,
                    p.parts,
                    p.turns,
                    p.vectors,
                )
            for w in range(t, worlds + 1, n):
                if solves == 0:
                    p.leaves[w] = 0
                    if w < worlds:
                        progress.searches[w] = progress.active[w]
            if t == 0:
                for k in range(progress.flags.shape[0]):
                    progress.flags[k] = 0
            phase = int(Phase.SOLVE)
        elif phase == Phase.DISPLACE:  # after a solve
            for b in range(t, body_count, n):
                bodies.displace_bodies(b, motion, p.unknowns, progress, p.vectors.solution, p.bodies)
            if body_count > 0:
                wait_for_all(p.flow.arrived)
            for v in range(t, vertices, n):
                steps.displace(
                    v, motion, p.unknowns, p.vectors, p.lower, p.upper, p.bodies, p.trial, progress, p.limit, p.leaves
                )
            task, then, phase = int(Task.BOUND), int(Phase.BOUNDED), int(Phase.PAIRS)
        elif phase == Phase.HOLD:  # what would meet on the displacements, and solve again
            for w in range(t, worlds, n):
                decisions.begin_hold(w, progress)
            for u in range(t, unknowns, n):
                if solves == 0:
                    p.first[u] = p.vectors.solution[u]
            solves += 1
            phase = int(Phase.RELEASE_HELD)
        elif phase == Phase.TAKE_BOUND:
            for w in range(t, worlds, n):
                decisions.take_bound(w, progress)
            phase = int(Phase.DISPLACED)
        elif phase == Phase.DISPLACED:
            for b in range(t, body_count, n):
                bodies.move_bodies(b, motion, p.unknowns, progress, p.trial.share, p.vectors.solution, False, p.bodies)
            if body_count > 0:
                wait_for_all(p.flow.arrived)
            for v in range(t, vertices, n):
                steps.write_moved(v, motion, p.unknowns, p.bodies, progress, p.trial)
            if then == Phase.JUDGE and solves == 0:  # no pairs are held
                then = wp.where(progress.flags[Flag.CUTS] != 0, int(Phase.BEGIN_CUTS), int(Phase.TAKE))
            task, phase = int(Task.ENERGY), int(Phase.PAIRS)
        elif phase == Phase.JUDGE:
            for w in range(t, worlds, n):
                decisions.find_rises(w, progress)
            phase = int(Phase.JUDGED)
        elif phase == Phase.BEGIN_RELEASE:
            for w in range(t, worlds, n):
                decisions.begin_release(w, progress)
            for u in range(t, unknowns, n):
                if progress.solving[p.unknowns.world[u]] != 0:
                    p.vectors.solution[u] = p.first[u]
            releases, phase = True, int(Phase.DISPLACE)
        elif phase == Phase.END_RELEASE:
            for w in range(t, worlds, n):
                decisions.end_release(w, progress)
            phase = wp.where(progress.flags[Flag.CUTS] != 0, int(Phase.BEGIN_CUTS), int(Phase.TAKE))
        elif phase == Phase.BEGIN_CUTS:  # of single vertices in place of their world, where energies are lower then
            for v in range(t, wp.max(vertices, worlds), n):
                steps.begin_truncation(v, p.unknowns, p.lower, p.upper, p.trial, progress, p.whole)
            phase = int(Phase.CUT)  # the first time by the bounds of the displacements, which are known
        elif phase == Phase.CUT:
            for v in range(t, vertices, n):
                steps.truncate(v, p.unknowns, p.limit, passes == 0, p.trial)
            passes += 1
            then = int(Phase.CUT)
            if passes == _TRUNCATIONS:
                for w in range(t, worlds, n):
                    progress.bound[w] = 1.0
                then = int(Phase.TAKE_CUT)
            task, phase = int(Task.BOUND), int(Phase.PAIRS)
        elif phase == Phase.TAKE_CUT:
            for w in range(t, worlds, n):
                decisions.take_cut(w, progress)
            then, phase = int(Phase.CHOOSE_CUTS), int(Phase.DISPLACED)
        elif phase == Phase.CHOOSE_CUTS:
            for w in range(t, worlds, n):
                decisions.choose_truncation(w, p.whole, progress)
            phase = int(Phase.UNDO_CUTS)
        elif phase == Phase.UNDO_CUTS:
            for v in range(t, vertices, n):
                steps.undo_truncation(v, motion, progress, p.trial)
            phase = int(Phase.TAKE)
        elif phase == Phase.TAKE:
            for b in range(t, body_count, n):
                bodies.move_bodies(b, motion, p.unknowns, progress, p.trial.share, p.vectors.solution, True, p.bodies)
            if body_count > 0:
                wait_for_all(p.flow.arrived)
            for v in range(t, vertices, n):
                steps.take(v, motion, p.unknowns, p.bodies, progress, p.trial)
            phase = int(Phase.DECIDE)
        elif phase == Phase.DECIDE:
            for w in range(t, worlds, n):
                decisions.decide(w, least_change, far_change, max_steps, max_late_steps, progress, p.plane_share)
            phase = int(Phase.NEXT)
        wait_for_all(p.flow.arrived)
        if task == Task.FIND_NEAR and phase == then and p.grows != 0:
            if p.contacts.count[0] > p.contacts.corners.shape[0]:
                phase = int(Phase.GROW)
        if phase == Phase.BOUNDED:
            meets = progress.flags[Flag.MEETS] != 0
            then, phase = int(Phase.JUDGE), int(Phase.DISPLACED)
            if releases:
                then, phase = int(Phase.END_RELEASE), int(Phase.TAKE_BOUND)
            elif meets and solves < _PREDICTIONS:
                phase = int(Phase.HOLD)
            elif meets:
                phase = int(Phase.TAKE_BOUND)
        elif phase == Phase.JUDGED:
            phase = wp.where(progress.flags[Flag.CUTS] != 0, int(Phase.BEGIN_CUTS), int(Phase.TAKE))
            if progress.flags[Flag.RISES] != 0:
                phase = int(Phase.BEGIN_RELEASE)
        elif phase == Phase.NEXT:
            phase = int(Phase.DIFFERENTIATE)
            if progress.flags[Flag.SEARCHES] != 0:
                then, phase = int(Phase.TAKE), int(Phase.DISPLACED)
            elif progress.flags[Flag.GOES_ON] == 0:
                phase = int(Phase.END)
            elif p.leaves[worlds] != 0:
                phase = int(Phase.SEARCH_CANDIDATES)
    if t == 0:
        solves_next = int(phase == Phase.SOLVE)
        p.flow.solves_next[0] = solves_next
        p.flow.goes_on[0] = wp.where(phase == Phase.END, 0, 1)
        p.flow.solves[0] = solves
        p.flow.phase[0] = wp.where(solves_next != 0, int(Phase.DISPLACE), int(Phase.DIFFERENTIATE))
        if phase == Phase.GROW:
            p.flow.phase[0] = wp.where(then == Phase.END, int(Phase.PUBLISH), int(Phase.BEGIN))


ADVANCE = {
    threads: wp.kernel(_advance, enable_backward=False, module=f"{__name__}.blocks_of_{threads}", launch_bounds=threads)
    for threads in (256, 512)
}
"""The kernel by the threads of its blocks on a GPU, one a multiprocessor: fewer have more registers each."""
