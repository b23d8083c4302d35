"""Threads that share the work of worlds: they wait for each other, or take one world after the other.

On a GPU a world has one block of threads or several. On a CPU it has one thread, and each core takes other worlds.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func_native(snippet="\n#if defined(__CUDA_ARCH__)\n    return 1;\n#else\n    return 0;\n#endif\n")
def on_gpu() -> int:
    """Returns 1 on a GPU, 0 on a CPU, as a constant."""
    ...


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
#if defined(__CUDA_ARCH__)
    __shared__ int number;
    __syncthreads();
    if (threadIdx.x == 0) {
        __threadfence();
        number = atomicAdd(values.data, 1);
    }
    __syncthreads();
    const int found = number;
    __syncthreads();
    return found;
#else
    return __atomic_fetch_add(values.data, 1, __ATOMIC_ACQ_REL);
#endif
"""
)
def count_block(values: wp.array[int]) -> int:
    """Adds 1 to a number for the block of a thread, where all of its threads are here, and returns what it was."""
    ...


@wp.func_native(
    snippet="""
#if defined(__CUDA_ARCH__)
    return wp::atomic_min(values, i, value);
#else
    return __atomic_fetch_min(values.data + i, value, __ATOMIC_ACQ_REL);
#endif
"""
)
def lower_int_to(values: wp.array[int], i: int, value: int) -> int:
    """Lowers a number to another one, also on several cores of a CPU, and returns what it was."""
    ...
