"""Sums in fixed point, which are the same in any order of threads."""

import warp as wp

from .vectors import to_double, to_single

_UNITS, _UNIT = wp.constant(wp.float64(2.0**40)), wp.constant(wp.float64(2.0**-40))
"""Units in 1, a metre, a radian, and in these per second; and a unit."""


@wp.func
def to_units(x: wp.float64) -> wp.int64:
    """Returns a number in units, rounded."""
    return wp.int64(wp.rint(_UNITS * x))


@wp.func
def from_units(units: wp.int64) -> wp.float64:
    """Returns the number that an integer in units stands for."""
    return _UNIT * wp.float64(units)


@wp.func
def add_to_sum(sums: wp.array2d[wp.int64], i: int, column: int, x: wp.vec3d):
    """Adds a vector to three columns of the sums of a vertex or body, from ``column`` on."""
    for axis in range(3):
        wp.atomic_add(sums, i, column + axis, to_units(x[axis]))


@wp.func
def sum_of(sums: wp.array2d[wp.int64], i: int, column: int) -> wp.vec3d:
    """Returns what :func:`add_to_sum` has added."""
    total = wp.vec3d()
    for axis in range(3):
        total[axis] = from_units(sums[i, column + axis])
    return total


@wp.func
def with_delta(x: wp.vec3, sums: wp.array2d[wp.int64], vertex: int) -> wp.vec3:
    """Returns a position or velocity plus the sum of what constraints did to it."""
    return to_single(to_double(x) + sum_of(sums, vertex, 0))


@wp.func
def sums_of(sums: wp.array2d[wp.int64], body: int):
    """Returns the linear and the angular part of the sums of a body."""
    return sum_of(sums, body, 0), sum_of(sums, body, 3)


@wp.func_native(
    snippet="""
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 800
    // one atomic for all threads of a warp that are here, if to one sum; in parts whose sums fit into 32 bits
    const unsigned mask = __activemask();
    int same;
    __match_all_sync(mask, (unsigned long long)&sums.data[i], &same);
    if (same) {
        unsigned long long bits = (unsigned long long)units;
        const unsigned low = __reduce_add_sync(mask, (unsigned)(bits & 0x3fffffu));
        const unsigned middle = __reduce_add_sync(mask, (unsigned)((bits >> 22) & 0x1fffffu));
        const unsigned high = __reduce_add_sync(mask, (unsigned)(bits >> 43));
        bits = low + ((unsigned long long)middle << 22) + ((unsigned long long)high << 43);
        if ((threadIdx.x & 31) == __ffs(mask) - 1)
            atomicAdd((unsigned long long*)&sums.data[i], bits);
        return;
    }
#endif
#if defined(__CUDA_ARCH__)
    atomicAdd((unsigned long long*)&sums.data[i], (unsigned long long)units);
#else
    sums.data[i] += units;
#endif
"""
)
def add_units(sums: wp.array[wp.int64], i: int, units: wp.int64):
    """Adds units to a sum that all threads share."""
    ...
