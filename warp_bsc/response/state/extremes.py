"""The largest and the smallest of numbers that many threads have, none of them negative."""

import warp as wp


def _extreme(name: str) -> str:
    """Returns the native code that makes a value the extreme of itself and another one; ``name`` is min or max.

    On a GPU it compares bits, which are in the order of numbers that are not negative.
    """
    return f"""
#if defined(__CUDA_ARCH__)
    int bits = __float_as_int(value);
#if __CUDA_ARCH__ >= 800
    // one atomic for all threads of a warp that are here, if to one value: those on one address wait for each other
    const unsigned mask = __activemask();
    int same;
    __match_all_sync(mask, i, &same);
    if (same) {{
        bits = __reduce_{name}_sync(mask, bits);
        if ((threadIdx.x & 31) != __ffs(mask) - 1)
            return;
    }}
#endif
    atomic{name.capitalize()}((int*)values.data + i, bits);
#else
    values.data[i] = wp::{name}(values.data[i], value);
#endif
"""


@wp.func_native(snippet=_extreme("max"))
def raise_to(values: wp.array[float], i: int, value: float):
    """Raises a value to another one, both not negative."""
    ...


@wp.func_native(snippet=_extreme("min"))
def lower_to(values: wp.array[float], i: int, value: float):
    """Lowers a value to another one, as :func:`raise_to`."""
    ...
