"""Conjugate gradients that stop at negative curvature, each world by one block of threads.

Both sums of an iteration are of one product, so that threads wait for each other once for them.

References:
    A. T. Chronopoulos and C. W. Gear, s-step iterative methods for symmetric linear systems, Journal of Computational
    and Applied Mathematics 25(2), 1989, doi:10.1016/0377-0427(89)90045-9.
"""

import functools

import warp as wp

from ...kernels.native_text import header
from ...kernels.pipeline.queues import take_slot_int
from .matrix import Matrix
from .system import Contacts, Unknowns
from .team import on_gpu

_LARGEST_BLOCK = 1024
"""Threads of the only block of a world, at most."""
_KEPT = {320: 13, 640: 4, _LARGEST_BLOCK: 0}
"""Blocks of the Hessian that a thread keeps in registers, in thread blocks of so many threads at most."""
_SHARED_MEMORY, _OF_CONTACT = 44 * 1024, 68
"""Bytes of shared memory that a block takes at most, with some to spare, and those of a contact there."""
_AGAIN = 0.1
"""A solve that goes on from the one before ends at this share of the square of its first residual, or below."""
_BLOCK, _BLOCKS = 512, 128
"""Threads of each block of a larger world, and blocks of all worlds at most; no more than multiprocessors, as they wait
for each other and must run together."""


@wp.struct
class Team:
    """The threads that solve for a world: one block, or several that wait for each other."""

    blocks: int  # number of blocks
    parts: int  # threads that share a row, a power of 2
    # how often blocks have waited for the others, shape [worlds]; on a CPU the first counts threads
    arrived: wp.array[int]
    sums: wp.array2d[float]  # two of each block of each world, shape [worlds, 2 blocks]
    limit: wp.array[float]  # square of the residual at which the first solve of a Newton step ends, shape [worlds]


def make_team(unknowns: int, worlds: int, device: wp.Device) -> tuple[Team, int, wp.Kernel]:
    """Returns the team for worlds of so many unknowns at most, threads of a block, and the kernel that solves."""
    team, threads = Team(), 1
    team.blocks = team.parts = 1
    shared = device.is_cuda and unknowns <= _LARGEST_BLOCK
    if device.is_cuda:
        team.parts = 4
        while team.parts > 1 and team.parts * unknowns > min(_KEPT):
            team.parts //= 2
        threads = min(_LARGEST_BLOCK, max(64, -(-team.parts * unknowns // 32) * 32))
        most = min(_BLOCKS, device.sm_count)
        if not shared and worlds <= most // 2:
            team.parts, threads, most = 4, _BLOCK, most // worlds
            while team.parts < 32 and 2 * team.parts * unknowns <= most * _BLOCK:
                team.parts *= 2
            team.blocks = min(most, -(-team.parts * unknowns // _BLOCK))
    team.arrived = wp.zeros(worlds, dtype=int, device=device)
    team.sums = wp.zeros((worlds, 2 * team.blocks), dtype=float, device=device)
    team.limit = wp.zeros(worlds, dtype=float, device=device)
    bounds = min(size for size in _KEPT if threads <= size)
    kept = -(-_KEPT[bounds] // team.parts) if device.is_cuda else 0
    return team, threads, _make_solve_kernel(bounds, team.parts, kept, shared)


@wp.struct
class Vectors:
    """Vectors of a solve, each of one vec3 by unknown."""

    elastic: wp.array[wp.vec3]  # gradient of the energy of elements [N]
    gradient: wp.array[wp.vec3]  # of the energy [N]
    inverse: wp.array[wp.mat33]  # inverted blocks of the diagonal, which precondition, shape [unknown_count]
    solution: wp.array[wp.vec3]  # the displacements [m]; those that are given, before
    residual: wp.array[wp.vec3]  # of the iteration
    preconditioned: wp.array[wp.vec3]  # the residual by ``inverse``
    product: wp.array[wp.vec3]  # of the Hessian and ``preconditioned``
    direction: wp.array[wp.vec3]  # in which the solution changes
    along: wp.array[wp.vec3]  # the product of the Hessian with it
    first: wp.array[wp.vec3]  # solution of the Newton step before pairs are held
    last: wp.array[wp.vec3]  # the same of the Newton step before


@functools.cache
def _make_solve_kernel(bounds: int, parts: int, kept: int, shared: bool):
    """Returns the kernel that solves for worlds, by blocks of so many threads at most, each of which keeps some blocks.

    What is multiplied is in ``shared`` memory, if it fits there. By hand, with plain pointers and registers: most of an
    iteration would otherwise be arithmetic of addresses, and waiting for memory.
    """
    sizes = {"SHARED": int(shared), "WIDE": 4 if shared else 3, "THREADS": bounds, "PARTS": parts, "KEPT": kept}
    inverses = 9 * bounds if kept and shared and bounds == min(_KEPT) else 0
    left = _SHARED_MEMORY - 4 * (inverses + 4 * bounds) if shared else 0
    sizes |= {"INVERSES": inverses, "COUPLED": max(left // _OF_CONTACT, 1)}
    sizes |= {"UNROLLED": 1 if shared else 4, "AGAIN": _AGAIN}
    macros = "".join(f"#define {name} {size}\n" for name, size in sizes.items())

    @wp.func_native(snippet=macros + header(__file__, "solve.h"))
    def solve(
        matrix: Matrix,
        contacts: Contacts,
        unknowns: Unknowns,
        tolerance: float,
        max_iterations: int,
        solves: wp.array[int],
        team: Team,
        vectors: Vectors,
        world: int,
        block: int,
    ) -> int: ...

    @wp.kernel(module="unique", enable_backward=False, launch_bounds=bounds)
    def solve_worlds(
        # in
        matrix: Matrix,
        contacts: Contacts,
        unknowns: Unknowns,
        active: wp.array[int],
        tolerance: wp.array[float],
        max_iterations: int,
        solves: wp.array[int],
        team: Team,
        # in and out
        vectors: Vectors,
        # out
        iterations: wp.array[int],
        solves_next: wp.array[int],
    ):
        """Solves H d = -g in active worlds, until the norm of the residual, preconditioned, is a share of its first.

        The first of ``solves`` of a Newton step counts; those that follow it go on from there, with what is held since.
        ``solves_next`` becomes 0.
        Where the matrix is found not to be positive definite, the solution so far ends the solve, or the preconditioned
        negative gradient if there is none: both are directions in which the energy falls. What is given stays given.
        """
        thread = wp.tid()
        if on_gpu() == 0:
            thread = take_slot_int(team.arrived)
        number, lane = thread // wp.block_dim(), thread % wp.block_dim()
        world, block = number // team.blocks, number % team.blocks
        if thread == 0:
            solves_next[0] = 0
        if active[world] == 0:
            return
        count = solve(matrix, contacts, unknowns, tolerance[world], max_iterations, solves, team, vectors, world, block)
        if block == 0 and lane == 0:
            iterations[world] = iterations[world] + count

    return solve_worlds
