"""All sweeps over a world in one launch: the threads of a world wait for each other, and no world for another one.

Sweeps over a small world take less time than their launches, and a world whose constraints are met is not looked at
until those of all others are. On a GPU, the threads of a world are those of a thread block, or of a cluster of blocks
that run together (compute capability 9.0); on a CPU there is one. Worlds without constraints cost nothing.
"""

import warp as wp

from .structs import Step, constraint_count

wp.set_module_options({"enable_backward": False})

BLOCK = 256
"""Threads of a block at most: each needs up to 255 registers, as many as there are for so many."""
SMALLEST_BLOCK = 128
"""Threads of a block at least: 1,024 worlds of fewer, not all of which run at once, took longer than by launches."""
CLUSTER = 8
"""Blocks of a cluster, the most that every GPU has that has clusters."""
PARTICLES = 4
"""Most particles of a world for each thread: larger worlds need more of the GPU."""


def threads_of_world(device: wp.Device, worlds: int, particles: int) -> int:
    """Returns how many threads sweep over each world in one launch, given the particles of the largest one.

    As many as run at once, for all worlds together; 0 if a world, or all together, ask for more.
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


@wp.func
def _world_of(step: Step, i: int) -> int:
    return step.motion.world[step.constraints.vertices[i][0]]


@wp.kernel
def count_constraints(step: Step, threads: int):
    """Counts the constraints of each world; the counts are 0 before."""
    for i in range(wp.tid(), constraint_count(step), threads):
        wp.atomic_add(step.constraints.number, _world_of(step, i), 1)


@wp.kernel
def begin_worlds(step: Step):
    """Finds where the list of constraints of each world begins, in any order."""
    world = wp.tid()
    constraints = step.constraints
    constraints.first[world] = wp.atomic_add(constraints.number, constraints.first.shape[0], constraints.number[world])
    constraints.number[world] = 0


@wp.kernel
def list_constraints(step: Step, threads: int):
    """Lists the constraints of each world, and counts them again."""
    for i in range(wp.tid(), constraint_count(step), threads):
        world = _world_of(step, i)
        place = step.constraints.first[world] + wp.atomic_add(step.constraints.number, world, 1)
        step.constraints.of_worlds[place] = i


@wp.func
def constraints_of_world(step: Step, world: int) -> int:
    """Returns the number of constraints of a world, which are all if there is no list by worlds."""
    if step.constraints.of_worlds:
        return step.constraints.number[world]
    return constraint_count(step)


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
def wait_for_others():
    """Waits for all threads of the world; each then sees what the others wrote. All of them have to call it."""
    ...


@wp.func_native(snippet="\n#if defined(__CUDA_ARCH__)\n    __syncthreads();\n#endif\n")
def wait_for_block():
    """Waits as :func:`wait_for_others`, for those of the same block."""
    ...
