"""All sweeps in one launch: threads that wait for each other, of one thread block cluster of a GPU, or one on a CPU.

Sweeps over a small scene take less time than their launches. A cluster is blocks of threads that a GPU runs together,
so that they can wait for each other; before compute capability 9.0 it is one block.
"""

import warp as wp

BLOCK = 256
"""Threads of a block: each needs up to 255 registers, as many as there are for so many."""
CLUSTER = 8
"""Blocks of a cluster, the most that every GPU has that has clusters."""
MAX_PARTICLES = 1024
"""Most particles of a scene that are swept in one launch, for each block: larger ones need more of the GPU."""


def threads_of_cluster(device: wp.Device, particles: int) -> int:
    """Returns how many threads sweep over a scene in one launch; 0 if there are too many particles."""
    if device.is_cpu:
        return 1
    blocks = CLUSTER if device.arch >= 90 else 1
    return blocks * BLOCK if particles <= blocks * MAX_PARTICLES else 0


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
    """Waits for all threads of the cluster; each then sees what the others wrote. All of them have to call it."""
    ...
