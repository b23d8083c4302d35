"""Sets of up to 64 things as the bits of a number."""

import warp as wp


@wp.func_native(
    snippet="""
#if defined(__CUDA_ARCH__)
    return bits ? __ffsll((long long)bits) - 1 : 64;
#else
    return bits ? __builtin_ctzll(bits) : 64;
#endif
"""
)
def lowest_bit(bits: wp.uint64) -> int:
    """Returns the number of the lowest bit that is set; 64 if there is none."""
    ...


@wp.func_native(
    snippet="""
#if defined(__CUDA_ARCH__)
    return __popcll(bits);
#else
    return __builtin_popcountll(bits);
#endif
"""
)
def count_bits(bits: wp.uint64) -> int:
    """Returns how many bits are set."""
    ...
