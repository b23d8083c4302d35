"""All sweeps over a world in one launch: the threads of a world wait for each other, and no world for another one.

Sweeps over a small world take less time than their launches, and a world whose constraints are met is not looked at
until those of all others are. On a GPU, the threads of a world are those of a thread block, or of a cluster of blocks
that run together (compute capability 9.0); on a CPU there is one. Worlds without constraints cost nothing.
"""

import warp as wp

from .status import Loop, SolveStatus, begin_sweeps
from .structs import Incidence, Step, constraint_count

wp.set_module_options({"enable_backward": False})

BLOCK = 256
"""Threads of a block at most: each needs up to 255 registers, as many as there are for so many."""
SMALLEST_BLOCK = 128
"""Threads of a block at least: 1,024 worlds of fewer, not all of which run at once, took longer than by launches."""
CLUSTER = 8
"""Blocks of a cluster, the most that every GPU has that has clusters."""
LARGE_BLOCK, LARGE_BLOCKS = int(__import__("os").environ.get("LB", "512")), 128  # TEMP
"""Threads of a block, and blocks at most, for the active set of a large world: each thread has 128 registers, and each
multiprocessor a block, as they wait for each other and must run together."""
PARTICLES = 4
"""Most particles of a world for each thread: larger worlds need more of the GPU."""


def threads_of_world(device: wp.Device, worlds: int, particles: int) -> int:
    """Returns how many threads sweep over each world in one launch; 0 if a world, or all together, ask for more.

    As many as run at once, for all worlds together.

    Args:
        device: The device.
        worlds: Number of worlds.
        particles: Particles of the largest world.
    """
    if device.is_cpu:
        return 1
    most = CLUSTER * BLOCK if device.arch >= 90 else BLOCK
    if particles > PARTICLES * most:
        return 0
    at_once = BLOCK * device.sm_count // worlds
    if at_once < SMALLEST_BLOCK:
        return 0
    if at_once >= most or particles > PARTICLES * BLOCK:
        return most
    threads = BLOCK
    while threads > max(SMALLEST_BLOCK, at_once) and particles <= PARTICLES * threads // 2:
        threads //= 2
    return threads


def threads_of_large_team(device: wp.Device) -> int:
    """Returns how many threads sweep together over a large world; 0 on a CPU, where launches of sweeps cost little."""
    return 0 if device.is_cpu else LARGE_BLOCK * min(LARGE_BLOCKS, device.sm_count)


@wp.func
def _world_of(step: Step, i: int) -> int:
    return step.motion.world[step.constraints.vertices[i][0]]


@wp.kernel
def count_constraints(step: Step, threads: int):
    """Counts the constraints of each world; the counts are 0 before."""
    for i in range(wp.tid(), constraint_count(step), threads):
        wp.atomic_add(step.constraints.number, _world_of(step, i), 1)


@wp.kernel
def begin_worlds(step: Step, status: SolveStatus):
    """Begins the sweeps of all worlds, and finds where the list of constraints of each begins, in any order."""
    world = wp.tid()
    constraints = step.constraints
    if world == 0:
        begin_sweeps(status)
    if not constraints.of_worlds:
        constraints.number[0] = constraint_count(step)
        return
    constraints.first[world] = wp.atomic_add(constraints.number, constraints.first.shape[0], constraints.number[world])
    constraints.number[world] = 0


@wp.kernel
def list_constraints(step: Step, threads: int):
    """Lists the constraints of each world, and counts them again."""
    for i in range(wp.tid(), constraint_count(step), threads):
        world = _world_of(step, i)
        place = step.constraints.first[world] + wp.atomic_add(step.constraints.number, world, 1)
        step.constraints.of_worlds[place] = i


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


@wp.func_native(
    snippet="""
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900
    asm volatile("barrier.cluster.arrive.release;" ::: "memory");
    asm volatile("barrier.cluster.wait.acquire;" ::: "memory");
#elif defined(__CUDA_ARCH__)
    __syncthreads();
#endif
"""
)
def _wait_for_cluster(): ...


@wp.func_native(snippet="\n#if defined(__CUDA_ARCH__)\n    __syncthreads();\n#endif\n")
def wait_for_block():
    """Waits for all threads of a block; each then sees what the others wrote. All of them have to call it."""
    ...


@wp.struct
class Team:
    """The threads that make sweeps over an active set together, and what they work on."""

    thread: int  # number of a thread
    threads: int  # how many there are
    block: int  # threads of a block
    blocks: int  # their blocks; 0 if these are a cluster
    first: int  # where the active set begins
    end: int  # and where it ends
    first_particle: int  # of those that it may move, in the list of the particles of worlds
    end_particle: int
    sweep: int  # number of the next sweep


@wp.func
def wait_for_others(status: SolveStatus, blocks: int):
    """Waits for all threads of a team in so many blocks; each then sees what the others wrote. All must call it."""
    if blocks == 0:
        _wait_for_cluster()
    else:
        wait_for_team(status.arrived, 0, blocks)


@wp.func
def team_of_world(step: Step, particles: Incidence, world: int, thread: int, threads: int) -> Team:
    """Returns the team that sweeps over the constraints of one world, without an active set."""
    team = Team()
    team.thread = thread
    team.threads = threads
    team.block = wp.min(threads, BLOCK)
    team.first = step.constraints.first[world]
    team.first_particle = particles.first[world]
    team.end_particle = particles.first[world + 1]
    return team


@wp.func
def in_one_block(team: Team, constraints: int) -> Team:
    """Returns the first block of a team for a world of few constraints, as it waits less; else the team."""
    if constraints <= 2 * team.block:
        team.blocks = 1
        team.threads = team.block
    return team


@wp.func
def large_team(step: Step, particles: Incidence, status: SolveStatus, thread: int, threads: int) -> Team:
    """Returns the team that sweeps over the active set of all worlds together."""
    team = Team()
    team.thread = thread
    team.threads = threads
    team.block = LARGE_BLOCK
    team.blocks = wp.max(threads / LARGE_BLOCK, 1)
    team.end = int(step.constraints.active_count[0])
    team.end_particle = particles.items.shape[0]
    team.sweep = status.loop[Loop.SWEEP]
    return team
