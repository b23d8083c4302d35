"""The flow of Newton steps: phases of worlds, what they read and write, and the threads that wait for each other."""

from enum import IntEnum

import warp as wp

from .bodies import SolvedBodies
from .conjugate_gradients import Vectors
from .elasticity import Derivatives, Elements
from .matrix import Matrix
from .pairs import Candidates, Trial
from .rows import Rows
from .system import Contacts, Progress, Unknowns, Worlds

wp.set_module_options({"enable_backward": False})


class Phase(IntEnum):
    """What all threads do until they wait for each other, or leave for what another kernel does."""

    BEGIN = 0
    DIFFERENTIATE = 1
    LOADS = 2
    RELEASE_HELD = 3
    BEGIN_LIST = 4
    PAIRS = 5
    COUNT = 6
    PLACE = 7
    LIST = 8
    SORT = 9
    BLOCKS = 10
    ASSEMBLE = 11
    DISPLACE = 12
    BOUNDED = 13
    HOLD = 14
    TAKE_BOUND = 15
    DISPLACED = 16
    JUDGE = 17
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

    LIST_NEAR = 0
    FIND_NEAR = 1
    HOLD = 2
    LIST = 3
    BOUND = 4
    ENERGY = 5


@wp.struct
class Flow:
    """Where the Newton steps are.

    Attributes:
        phase: The phase of each world that comes next.
        solves: Solves of each world in its Newton step so far.
        solves_next: 1 if a solve comes next for one, shape [1].
        goes_on: 1 if a search for candidates or larger buffers come next for one, shape [1].
        arrived: How often blocks of threads of each world have waited.
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
        leaves: 1 for each world of which a vertex leaves its box.
        any_leaves: 1 if there is one, shape [1].
        lacks: See :func:`.step_report.write_results`.
        vertices_at_planes: Vertices that infinite planes may stop, 0 if there are none.
        parts: Threads that share rows and blocks.
        turns: Rows or blocks that they share, one after the other, no more than they are.
        grows: 1 if the host can enlarge the buffers of contacts, outside of CUDA graphs.
    """

    elements: Elements
    derivatives: Derivatives
    rows: Rows
    row_of_block: wp.array[int]
    matrix: Matrix
    vectors: Vectors
    unknowns: Unknowns
    bodies: SolvedBodies
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
    any_leaves: wp.array[int]
    lacks: wp.array[int]
    worlds: Worlds
    vertices_at_planes: int
    parts: int
    turns: int
    grows: int


@wp.func_native(
    snippet="""
#if defined(__CUDA_ARCH__)
    __syncthreads();
    if (blocks > 1) {
        if (threadIdx.x == 0) {
            __threadfence();
            unsigned* count = (unsigned*)arrived.data + world;
            const unsigned before = atomicAdd(count, 1u);
            const unsigned all = (before / blocks + 1u) * blocks;
            while ((int)(*(volatile unsigned*)count - all) < 0) {}
            __threadfence();
        }
        __syncthreads();
    }
#endif
"""
)
def wait_for_team(arrived: wp.array[int], world: int, blocks: int):
    """Waits until all threads of a world are here, and sees what they have written; its blocks must all be running."""
    ...
