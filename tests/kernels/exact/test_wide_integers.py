"""Wide integers against those of Python: every operation in every width, signs and ends of the range above all."""

import numpy as np
import pytest
import warp as wp
from flushing import subnormals_flushed

from warp_bsc.kernels.exact.wide_integers import (
    LIMBS,
    add,
    integer,
    lowest_bit,
    minor,
    product,
    shift,
    sign,
    subtract,
    times,
    top_bit_of_difference,
    widen,
)


def to_integers(limbs):
    """Python integers from limbs, the lowest first, along the last axis."""
    width = 64 * limbs.shape[-1]
    values = sum(limbs[..., i].astype(object) << (64 * i) for i in range(limbs.shape[-1]))
    return np.where(values >> (width - 1), values - (1 << width), values)


def wrapped(values, limbs):
    """What is left of integers in so many limbs, in two's complement."""
    half = 1 << (64 * limbs - 1)
    return (values + half) % (2 * half) - half


def random_limbs(rng, n, limbs):
    """Limbs of random numbers, of numbers near the ends of the range, and of small ones, shape (n, 4, limbs)."""
    x = rng.integers(0, 2**64, (n, 4, limbs), dtype=np.uint64)
    ends = rng.choice(np.array([0, 1, 2**63, 2**63 - 1, 2**64 - 1], dtype=np.uint64), (n, 4, limbs))
    x = np.where(rng.random((n, 4, limbs)) < rng.choice([0.0, 0.5, 1.0], (n, 4, 1)), ends, x)
    for used in (1, 2):
        small = rng.random((n, 4)) < 0.2
        x[small, used:] = np.where(rng.random(small.sum()) < 0.5, np.uint64(0), np.uint64(2**64 - 1))[:, None]
    return x


@pytest.mark.parametrize("limbs", LIMBS[:-1])
def test_operations_are_those_of_integers(limbs):
    single, double = integer(limbs), integer(2 * limbs)

    @wp.kernel(enable_backward=False, module="unique")
    def compute(
        x: wp.array2d[single],
        factor: wp.array[wp.uint64],
        bits: wp.array[int],
        same: wp.array2d[single],
        wide: wp.array2d[double],
        signs: wp.array2d[int],
    ):
        i = wp.tid()
        a = x[i, 0]
        b = x[i, 1]
        c = x[i, 2]
        d = x[i, 3]
        same[i, 0] = add(a, b)
        same[i, 1] = subtract(a, b)
        same[i, 2] = times(a, factor[i])
        same[i, 3] = shift(a, bits[i])
        wide[i, 0] = product(a, b)
        wide[i, 1] = minor(a, b, c, d)
        wide[i, 2] = widen(a)
        wide[i, 3] = product(wide[i, 1], c)
        wide[i, 4] = minor(wide[i, 0], c, wide[i, 1], d)
        signs[i, 0] = sign(a)
        signs[i, 1] = sign(subtract(a, a))
        signs[i, 2] = sign(wide[i, 1])

    n = 400
    rng = np.random.default_rng(limbs)
    x = random_limbs(rng, n, limbs)
    factor = rng.choice(np.array([0, 1, 9, 2**38, 2**64 - 1], dtype=np.uint64), n)
    bits = rng.integers(0, 64 * limbs, n).astype(np.int32)
    same, wide = wp.zeros((n, 4), dtype=single), wp.zeros((n, 5), dtype=double)
    signs = wp.zeros((n, 3), dtype=int)
    inputs = [wp.array(x, dtype=single), wp.array(factor), wp.array(bits)]
    wp.launch(compute, n, inputs=inputs, outputs=[same, wide, signs])
    a, b, c, d = to_integers(x).T
    first, second = wrapped(a * b, 2 * limbs), wrapped(a * b - c * d, 2 * limbs)
    expected = [a + b, a - b, a * factor.astype(object), a << bits.astype(object)]
    assert np.array_equal(to_integers(same.numpy().reshape(n, 4, limbs)).T, [wrapped(v, limbs) for v in expected])
    expected = [first, second, a, second * c, first * c - second * d]
    assert np.array_equal(
        to_integers(wide.numpy().reshape(n, 5, 2 * limbs)).T, [wrapped(v, 2 * limbs) for v in expected]
    )
    assert np.array_equal(signs.numpy().T, [np.sign(a), 0 * a, np.sign(second)])


def test_bits_of_doubles():
    @wp.kernel(enable_backward=False, module="unique")
    def find_bits(x: wp.array[wp.float64], y: wp.array[wp.float64], low: wp.array[int], top: wp.array[int]):
        i = wp.tid()
        low[i] = lowest_bit(x[i])
        top[i] = top_bit_of_difference(x[i], y[i])

    rows = [
        # x, y, exponent of the lowest bit of x, a power of two that the difference is below
        (1.0, 0.0, 0, 1),
        (-1.0, -2.0, 0, 1),
        (3.0, 0.0, 0, 2),
        (3.0, 2.0, 0, 1),
        (3.0, 3.0, 0, -4096),
        (2.0**-1074, 0.0, -1074, -1021),
        (3.0 * 2.0**-1074, -(2.0**-1074), -1074, -1021),
        (2.0**-1022, -(2.0**-1022), -1022, -1020),
        (2.0**-968, 2.0**-1074, -968, -967),
        (-(2.0**1023), 0.0, 1023, 1024),
        (1.0 + 2.0**-52, 1.0, -52, -51),
        (0.75, 0.0, -2, 0),
        (0.0, 0.0, 4096, -4096),
    ]
    rows += [(2.0**1023, -(2.0**1023), 1023, 8192), (np.inf, 0.0, None, 8192), (np.nan, 0.0, None, 8192)]
    x, y, expected_low, expected_top = zip(*rows, strict=True)

    def find(device):
        inputs = [wp.array(numbers, dtype=wp.float64, device=device) for numbers in (x, y)]
        low, top = (wp.zeros(len(rows), dtype=int, device=device) for _ in range(2))
        wp.launch(find_bits, len(rows), inputs=inputs, outputs=[low, top], device=device)
        return low.numpy(), top.numpy()

    low, top = find(None)
    assert low[:-2].tolist() == list(expected_low[:-2])
    assert top.tolist() == list(expected_top)
    with subnormals_flushed():
        flushed = find("cpu")
    assert (np.array(flushed) == [low, top]).all()
