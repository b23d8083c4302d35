"""Blocks of threads: kernels whose threads wait for each other, which all are in one block of a GPU; one on a CPU."""

import warp as wp


@wp.func_native("""
#if defined(__CUDA_ARCH__)
__syncthreads();
#endif
""")
def synchronize_block():
    """Waits for all threads of the block, and makes what they wrote visible to each other."""
    ...
