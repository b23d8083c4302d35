"""Random numbers of one query on a device, from a seed and the query's number, and steps of floating point.

The state of the random numbers is an array of one element, so that functions may advance it.
"""

import warp as wp

_0 = wp.constant(wp.float64(0.0))
_1 = wp.constant(wp.float64(1.0))
_UPPER = wp.constant(wp.float64(2.0**-27))
_LOWER = wp.constant(wp.float64(2.0**-53))
_NEXT = wp.constant(wp.uint64(1))

# --- Random numbers ---


@wp.func
def seeded(seed: int, number: wp.int64) -> wp.uint32:
    """Returns the state of the random numbers of one query, another one for each of 2^32 consecutive numbers."""
    return wp.rand_init(seed + int(number >> wp.int64(32)), int(number & wp.int64(0xFFFFFFFF)))


@wp.func
def bits(random: wp.array[wp.uint32]) -> wp.uint32:
    """Returns 32 random bits, and advances the state."""
    state = random[0]
    drawn = wp.randu(state)
    random[0] = state
    return drawn


@wp.func
def integer(random: wp.array[wp.uint32], low: int, high: int) -> int:
    """Returns an integer from low to high."""
    return low + int((bits(random) >> wp.uint32(1)) % wp.uint32(high - low + 1))


@wp.func
def real(random: wp.array[wp.uint32], low: wp.float64, high: wp.float64) -> wp.float64:
    """Returns a number from low to high, uniform, of 53 bits."""
    upper = wp.float64(bits(random) >> wp.uint32(5))
    lower = wp.float64(bits(random) >> wp.uint32(6))
    return low + (high - low) * (upper * _UPPER + lower * _LOWER)


@wp.func
def chance(random: wp.array[wp.uint32], percent: int) -> bool:
    """Returns True in so many of 100 cases."""
    return integer(random, 0, 99) < percent


@wp.func
def power(exponent: wp.float64) -> wp.float64:
    """Returns 2 to any exponent."""
    return wp.pow(wp.float64(2.0), exponent)


@wp.func
def vector(random: wp.array[wp.uint32]) -> wp.vec3d:
    """Returns a vector uniform in [-1, 1]^3."""
    return wp.vec3d(real(random, -_1, _1), real(random, -_1, _1), real(random, -_1, _1))


@wp.func
def lattice(random: wp.array[wp.uint32], size: int) -> wp.vec3d:
    """Returns a vector of integers up to size."""
    return wp.vec3d(
        wp.float64(integer(random, -size, size)),
        wp.float64(integer(random, -size, size)),
        wp.float64(integer(random, -size, size)),
    )


@wp.func
def eighths(random: wp.array[wp.uint32]) -> wp.float64:
    """Returns a time in [0, 1], a multiple of 1/8, the ends as often as all others."""
    count = wp.where(chance(random, 50), 8 * integer(random, 0, 1), integer(random, 1, 7))
    return wp.float64(count) / wp.float64(8.0)


# --- Floating point ---


@wp.func
def next_number(x: wp.float64, up: bool, single: bool) -> wp.float64:
    """Returns the next number of the precision, from a finite one that is not the last."""
    if single:
        bits = wp.cast(wp.float32(x), wp.uint32)
        if x == _0:
            bits = wp.uint32(1) + wp.where(up, wp.uint32(0), wp.uint32(1) << wp.uint32(31))
        elif up == (x > _0):
            bits += wp.uint32(1)
        else:
            bits -= wp.uint32(1)
        return wp.float64(wp.cast(bits, wp.float32))
    wide = wp.cast(x, wp.uint64)
    if x == _0:
        wide = _NEXT + wp.where(up, wp.uint64(0), _NEXT << wp.uint64(63))
    elif up == (x > _0):
        wide += _NEXT
    else:
        wide -= _NEXT
    return wp.cast(wide, wp.float64)


@wp.func
def power_of_two(exponent: int) -> wp.float64:
    """Returns a power of two that may be subnormal."""
    if exponent >= -1022:
        return wp.cast(wp.uint64(exponent + 1023) << wp.uint64(52), wp.float64)
    return wp.cast(_NEXT << wp.uint64(exponent + 1074), wp.float64)
