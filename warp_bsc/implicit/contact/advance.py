"""Newton steps as one kernel: all that lies between two solves, phase after phase.

Each world has a team of threads, which take a share of each phase, and wait for each other behind it. What a phase
finds decides which comes next: without a launch, a host, or a condition of a CUDA graph in between. A world waits for
others only where it needs a search for candidates, until they end or need one as well.

The function of a phase takes the share of a thread, and returns which phase comes next. What decides about that is not
written in the phase, as some threads may still be reading it.
"""

import warp as wp

from ...kernels.pipeline.queues import take_slot_int, take_slot_of
from . import assembly, bounds, contact_lists, decisions, held, merit, near, steps
from .flow import Flow, Phase, Place, Problem
from .system import end_of_contacts
from .team import count_block, on_gpu, wait_for_team

wp.set_module_options({"enable_backward": False})

_PREDICTIONS = wp.constant(2)
"""Solves of a Newton step after its first one, each of which holds what met in the one before."""

_FUNCTIONS = {
    Phase.BEGIN: decisions.begin,
    Phase.DIFFERENTIATE: assembly.differentiate,
    Phase.LOADS: assembly.find_loads,
    Phase.BEGIN_LIST: near.begin_list,
    Phase.LIST_NEAR: near.list_near,
    Phase.FIND_NEAR: near.find_near,
    Phase.COUNT: contact_lists.count_contacts,
    Phase.PLACE: contact_lists.place_contacts,
    Phase.LIST_CONTACTS: contact_lists.list_contacts,
    Phase.SORT: contact_lists.sort_contacts,
    Phase.BLOCKS: assembly.add_blocks,
    Phase.ASSEMBLE: assembly.assemble,
    Phase.DISPLACE: steps.displace,
    Phase.LIST_WAYS: bounds.list_ways,
    Phase.BOUND: bounds.bound,
    Phase.HOLD: held.hold,
    Phase.RELEASE_HELD: held.release_held,
    Phase.HOLD_PAIRS: held.hold_pairs,
    Phase.TAKE_BOUND: decisions.take_bound,
    Phase.MOVE: steps.move,
    Phase.ENERGY: merit.find_energy,
    Phase.BEGIN_RELEASE: held.begin_release,
    Phase.BEGIN_CUTS: steps.begin_cuts,
    Phase.CUT: steps.cut,
    Phase.TAKE_CUT: decisions.take_cut,
    Phase.CHOOSE_CUTS: decisions.choose_cuts,
    Phase.UNDO_CUTS: steps.undo_cuts,
    Phase.TAKE: steps.take,
    Phase.DECIDE: decisions.decide,
    Phase.PUBLISH: near.publish,
}
_ALSO = {Phase.FIND_NEAR: Phase.LIST_AND_FIND_NEAR, Phase.BOUND: Phase.LIST_AND_BOUND}
"""Phases that have the function of the one before them, whose code the kernel then has once."""
_DECIDED_AFTER = {Phase.FIND_NEAR, Phase.BOUND, Phase.HOLD_PAIRS, Phase.ENERGY, Phase.DECIDE}
"""Phases after which what all threads have found decides."""
_OF_PHASES = list(_FUNCTIONS.values())
_FIRST = [int(phase) for phase in _FUNCTIONS]
_LAST = [int(_ALSO.get(phase, phase)) for phase in _FUNCTIONS]


@wp.func
def _spread(thread: int, n: int) -> int:
    """Returns a number of a thread by which blocks take turns, warp by warp: each has its share of what is little."""
    if n == 1:
        return thread
    block, warp = thread // wp.block_dim(), thread % wp.block_dim() // 32
    return (warp * (n // wp.block_dim()) + block) * 32 + thread % 32


@wp.func
def _decide(before: int, found: wp.vec4i, w: int, p: Problem) -> wp.vec4i:
    """Returns the phase that follows where what all threads have found decides about it."""
    phase, then, solves = found[0], found[1], found[3]
    progress = p.progress
    if p.grows != 0 and (before == Phase.FIND_NEAR or before == Phase.LIST_AND_FIND_NEAR or before == Phase.HOLD_PAIRS):
        if end_of_contacts(p.contacts, w) - p.contacts.start[w] < p.contacts.count[w]:
            phase = int(Phase.GROW)
    if phase == Phase.BOUNDED:
        meets = progress.bound[w] < 1.0
        then, phase = int(Phase.JUDGE), int(Phase.MOVE)
        if meets and solves < _PREDICTIONS:
            phase = int(Phase.HOLD)
        elif meets:
            phase = int(Phase.TAKE_BOUND)
    elif phase == Phase.RELEASED:
        then, phase = int(Phase.END_RELEASE), int(Phase.TAKE_BOUND)
    elif phase == Phase.JUDGE and decisions.rises(w, progress):
        phase = int(Phase.BEGIN_RELEASE)
    elif phase == Phase.JUDGE or phase == Phase.END_RELEASE:
        phase = wp.where(decisions.may_cut(progress, w), int(Phase.BEGIN_CUTS), int(Phase.TAKE))
    elif phase == Phase.NEXT:
        phase = int(Phase.DIFFERENTIATE)
        if progress.searches[w] != 0:
            then, phase = int(Phase.TAKE), int(Phase.MOVE)
        elif progress.active[w] == 0:
            phase = int(Phase.END)
        elif p.progress.leaves[w] != 0:
            phase = int(Phase.SEARCH_CANDIDATES)
    return wp.vec4i(phase, then, found[2], solves)


@wp.func
def _leave(w: int, state: wp.vec4i, p: Problem):
    """Writes what comes next for a world, by one of its threads."""
    phase = state[0]
    p.flow.solves[w] = state[3]
    p.progress.solving[w] = int(phase == Phase.SOLVE)
    if phase == Phase.SOLVE:
        p.flow.solves_next[0] = 1
        phase = int(Phase.DISPLACE)
        if p.flow.phase.shape[0] > 1:
            following = 1 - p.flow.turn[0]
            place = following * p.flow.phase.shape[0]
            if on_gpu() == 0:
                place += take_slot_of(p.flow.count, following)
            else:
                place += wp.atomic_add(p.flow.count, following, 1)
            p.flow.listed[place] = w
    elif phase == Phase.END:
        p.progress.leaves[w] = 0
    else:
        p.flow.goes_on[0] = 1
        p.progress.energy[w] = wp.int64(0)  # the Newton step begins anew
        p.progress.square[w] = wp.int64(0)
        p.progress.product[w] = wp.int64(0)
        p.progress.held[w] = 0
        if phase == Phase.SEARCH_CANDIDATES:
            p.flow.any_leaves[0] = 1
    p.flow.phase[w] = phase


@wp.func
def _end_launch(flow: Flow, lane: int, n: int, blocks: int):
    """Lets the next launch have the list of worlds that this one has written, by the last block that ends."""
    turn = flow.turn[0] + int(0)
    if count_block(flow.ended) < blocks - 1:
        return
    for w in range(lane, flow.phase.shape[0], n):
        flow.arrived[w] = 0
    if lane == 0:
        flow.count[turn] = 0
        flow.turn[0] = 1 - turn
        flow.taken[0] = 0
        flow.ended[0] = 0


def _advance(
    # in
    resumes: int,
    of_all: int,
    n: int,
    blocks: int,
    # in and out
    p: Problem,
):
    """Goes on with the Newton steps of worlds until a solve, a search for candidates, or their end comes next.

    Blocks of ``n`` threads, which must all be running, take one world after the other, or several of them one together
    where worlds are fewer: worlds that have been solved for, or it is ``of_all``. Those that waited for candidates or
    buffers go on where it ``resumes``.
    """
    block, lane, worlds = wp.tid() // n, wp.tid() % n, p.flow.phase.shape[0]
    turn, count = p.flow.turn[0] + int(0), int(worlds)
    if of_all == 0:
        count = p.flow.count[turn] + int(0)
    together = wp.max(1, blocks // wp.max(1, count))
    if on_gpu() == 0:
        together = 1
    at = Place()
    at.thread = block % together * n + lane
    at.threads = together * n
    at.blocks = together
    at.spread = _spread(at.thread, at.threads)
    number = block // together
    if on_gpu() == 0:
        number = take_slot_int(p.flow.taken)
    while number < count:
        w = number
        if of_all == 0:
            w = p.flow.listed[turn * worlds + number] + int(0)
        phase = p.flow.phase[w] + int(0)
        if resumes != 0 and phase > Phase.SOLVE and phase < Phase.END:
            phase = int(Phase.DIFFERENTIATE)
        if phase < Phase.SOLVE and (p.progress.active[w] != 0 or phase == Phase.PUBLISH):
            at.world = w
            state = wp.vec4i(phase, int(Phase.BOUNDED), 0, p.flow.solves[w])
            # most phases follow each other as they stand here, so that one pass through this code takes many
            while state[0] < Phase.SOLVE:
                for k in range(wp.static(len(_OF_PHASES))):
                    if state[0] >= wp.static(_FIRST[k]) and state[0] <= wp.static(_LAST[k]):
                        at.phase = state[0]
                        at.then = state[1]
                        at.passes = state[2]
                        at.solves = state[3]
                        state = wp.static(_OF_PHASES[k])(at, p)
                        wait_for_team(p.flow.arrived, w, together)
                        if wp.static(_FIRST[k] in _DECIDED_AFTER):
                            state = _decide(at.phase, state, w, p)
            if at.thread == 0:
                _leave(w, state, p)
        number = int(count)
        if together == 1:
            number = blocks * on_gpu() + count_block(p.flow.taken)
    if worlds > 1 or on_gpu() == 0:
        _end_launch(p.flow, lane, n, blocks)


BLOCKS = {False: (256, 1), True: (512, 1)}
"""Threads of a block on a GPU, and blocks of a multiprocessor, by whether there are many vertices for each thread: each
has more registers where there are few."""
ADVANCE = {
    is_many: wp.kernel(
        _advance, enable_backward=False, module=f"{__name__}.of_{'many' if is_many else 'few'}", launch_bounds=blocks
    )
    for is_many, blocks in BLOCKS.items()
}
"""The kernel for these blocks, all of which run at the same time."""
