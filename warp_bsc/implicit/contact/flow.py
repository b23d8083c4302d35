"""The flow of Newton steps: phases of worlds, and what they read and write."""

from enum import IntEnum

import warp as wp

from ...response.state.planes import MovingPlanes
from ...response.state.structs import Motion
from ..elasticity.derivatives import Derivatives
from ..elasticity.elements import Elements
from .bodies import SolvedBodies
from .conjugate_gradients import Vectors
from .matrix import Matrix
from .pairs import BarrierSettings, Candidates, Trial, far_ones_stay, listed_count
from .rows import Rows
from .system import Contacts, Progress, Unknowns, Worlds

wp.set_module_options({"enable_backward": False})


class Phase(IntEnum):
    """What all threads of a world do until they wait for each other, or leave for what another kernel does."""

    BEGIN = 0
    DIFFERENTIATE = 1
    LOADS = 2
    BEGIN_LIST = 3
    LIST_NEAR = 4
    FIND_NEAR = 5
    LIST_AND_FIND_NEAR = 6
    COUNT = 7
    PLACE = 8
    LIST_CONTACTS = 9
    SORT = 10
    BLOCKS = 11
    ASSEMBLE = 12
    DISPLACE = 13
    LIST_WAYS = 14
    BOUND = 15
    LIST_AND_BOUND = 16
    HOLD = 17
    RELEASE_HELD = 18
    HOLD_PAIRS = 19
    TAKE_BOUND = 20
    MOVE = 21
    ENERGY = 22
    BEGIN_RELEASE = 23
    BEGIN_CUTS = 24
    CUT = 25
    TAKE_CUT = 26
    CHOOSE_CUTS = 27
    UNDO_CUTS = 28
    TAKE = 29
    DECIDE = 30
    PUBLISH = 31
    SOLVE = 32
    SEARCH_CANDIDATES = 33
    GROW = 34
    END = 35
    # where what all threads have found decides what comes next
    BOUNDED = 36
    RELEASED = 37
    JUDGE = 38
    END_RELEASE = 39
    NEXT = 40


@wp.struct
class Flow:
    """Where the Newton steps are."""

    phase: wp.array[int]  # the phase of each world that comes next
    solves: wp.array[int]  # solves of each world in its Newton step so far
    solves_next: wp.array[int]  # 1 if a solve comes next for one, shape [1]
    goes_on: wp.array[int]  # 1 if a search for candidates or larger buffers come next for one, shape [1]
    arrived: wp.array[int]  # how often blocks of threads of each world have waited
    # worlds whose solve comes next, in any order: of this launch, and of the next one, shape [2 worlds]
    listed: wp.array[int]
    turn: wp.array[int]  # which of both lists this launch has, shape [1]
    count: wp.array[int]  # length of both lists, shape [2]
    taken: wp.array[int]  # worlds that blocks have taken after their first ones, shape [1]
    ended: wp.array[int]  # blocks that have ended, shape [1]
    any_leaves: wp.array[int]  # 1 if a vertex leaves its box, shape [1]
    lacks: wp.array[int]  # see results.write_results, shape [2]


@wp.struct
class Place:
    """A thread in a phase of its world."""

    world: int
    thread: int  # number of the thread
    threads: int  # threads of the world
    blocks: int  # their blocks
    spread: int  # number of the thread by which blocks take turns, warp by warp: each has its share of what is little
    phase: int  # phase of the world
    then: int  # the one after those over pairs
    passes: int  # passes in which displacements were cut
    solves: int  # solves in the Newton step so far


@wp.struct
class Problem:
    """What Newton steps read and write."""

    motion: Motion
    planes: MovingPlanes
    settings: BarrierSettings
    elements: Elements
    derivatives: Derivatives
    rows: Rows
    matrix: Matrix
    vectors: Vectors
    unknowns: Unknowns
    bodies: SolvedBodies
    candidates: Candidates
    contacts: Contacts
    trial: Trial
    progress: Progress
    flow: Flow
    worlds: Worlds
    vertices_at_planes: int  # vertices that infinite planes may stop, 0 if there are none
    parts: int  # threads that share rows and blocks
    turns: int  # rows that they share, one after the other, no more than they are
    grows: int  # 1 if the host can enlarge the buffers of contacts, outside of CUDA graphs
    least_change: float  # change by which no unknown changes any more where a step ends [m]
    far_change: float  # change by which one that changes still is far from its end [m]
    max_steps: int  # Newton steps of a step at most
    max_late_steps: int  # the same while something that a program moves comes


@wp.func
def go_on(at: Place, phase: int) -> wp.vec4i:
    """Goes on with a phase."""
    return wp.vec4i(phase, at.then, at.passes, at.solves)


@wp.func
def go_on_with_pairs(at: Place, phase: int, then: int) -> wp.vec4i:
    """Goes on with phases over pairs, ``then`` with another one."""
    return wp.vec4i(phase, then, at.passes, at.solves)


# These take parts of a Problem, as a compiler copies one that is passed on.


@wp.func
def end_of_vertices(worlds: Worlds, progress: Progress, w: int) -> int:
    """Returns the end of the vertices that may move in a step."""
    return wp.where(progress.given_moves[w] != 0, worlds.first_vertex[w + 1], worlds.first_given[w])


@wp.func
def end_at_planes(worlds: Worlds, vertices_at_planes: int, w: int) -> int:
    """Returns the end of the vertices of a world of which some may be at planes."""
    return wp.where(vertices_at_planes > 0, worlds.first_given[w], 0)


@wp.func
def has_few(candidates: Candidates, at: Place) -> bool:
    """Returns whether threads have one candidate each at most: they list and do what comes then at once."""
    return candidates.near[at.world] + candidates.far[at.world] <= at.threads


@wp.func
def pair_count(candidates: Candidates, progress: Progress, w: int, of_all: bool) -> int:
    """Returns the number of listed candidates of a world, or of all but those that are far in any case."""
    count = listed_count(candidates, w)
    if of_all:
        count = candidates.near[w] + int(0)
        if not far_ones_stay(progress, w):
            count += candidates.far[w]
    return count
