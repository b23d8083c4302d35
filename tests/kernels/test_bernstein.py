"""Bernstein polynomials against exact arithmetic: values, parts, restrictions and the division of a cubic.

Coefficients and weights are small integers, times multiples of 1/8, so that floating point makes no error at all and
results must be equal, whatever the order of evaluation. All functions run over one batch, in one launch.
"""

import itertools
from fractions import Fraction
from math import comb
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp
from outputs import filled_with_nan

from warp_bsc.kernels import bernstein

COUNT = 300
TIMES = [Fraction(i, 5) for i in range(-1, 6)]  # more than a polynomial of degree three needs to be identified
ROUNDOFF = 2.0**-53


@wp.kernel(enable_backward=False)
def run_all(
    q: wp.array[wp.vec3d],
    k: wp.array[wp.vec4d],
    weights: wp.array[wp.vec2d],
    interval: wp.array[wp.vec2d],
    values: wp.array[wp.vec2d],
    mixed: wp.array[wp.float64],
    q_parts: wp.array2d[wp.vec3d],
    k_parts: wp.array2d[wp.vec4d],
    factor: wp.array[wp.vec2d],
    remainder: wp.array[wp.vec2d],
):
    i = wp.tid()
    a = weights[i][0]
    b = weights[i][1]
    start = interval[i][0]
    end = interval[i][1]
    values[i] = wp.vec2d(bernstein.evaluate_quadratic(q[i], a, b), bernstein.evaluate_cubic(k[i], a, b))
    mixed[i] = bernstein.mix(k[i][0], k[i][1], end)
    q_left, q_right = bernstein.split_quadratic(q[i], a, b)
    k_left, k_right = bernstein.split_cubic(k[i], a, b)
    q_parts[i, 0] = q_left
    q_parts[i, 1] = q_right
    q_parts[i, 2] = bernstein.restrict_quadratic(q[i], start, end)
    k_parts[i, 0] = k_left
    k_parts[i, 1] = k_right
    k_parts[i, 2] = bernstein.restrict_cubic(k[i], start, end)
    line, rest = bernstein.divide_cubic(k[i], q[i])
    factor[i] = line
    remainder[i] = rest


def run(q, k, weights, interval):
    """Runs every function on every row; returns the arguments as Python numbers and the results as arrays."""
    n = len(q)
    inputs = [
        wp.array(array, dtype=dtype)
        for array, dtype in ((q, wp.vec3d), (k, wp.vec4d), (weights, wp.vec2d), (interval, wp.vec2d))
    ]
    shapes = {
        "values": (n, wp.vec2d),
        "mixed": (n, wp.float64),
        "q_parts": ((n, 3), wp.vec3d),
        "k_parts": ((n, 3), wp.vec4d),
        "factor": (n, wp.vec2d),
        "remainder": (n, wp.vec2d),
    }
    outputs = {name: filled_with_nan(shape, dtype) for name, (shape, dtype) in shapes.items()}
    wp.launch(run_all, n, inputs=inputs, outputs=list(outputs.values()))
    return SimpleNamespace(
        q=exact(q),
        k=exact(k),
        weights=exact(weights),
        interval=exact(interval),
        **{name: exact(array.numpy()) for name, array in outputs.items()},
    )


def exact(array):
    """The same numbers as Fractions, in nested lists."""
    return np.vectorize(Fraction, otypes=[object])(array).tolist()


def value(coefficients, t):
    """The polynomial with these Bernstein coefficients at t, by definition."""
    n = len(coefficients) - 1
    return sum(comb(n, i) * c * t**i * (1 - t) ** (n - i) for i, c in enumerate(coefficients))


@pytest.fixture(scope="module")
def batch():
    """Integer polynomials, zero and linear ones among them, and weights that are zero now and then."""
    rng = np.random.default_rng(1)
    q = rng.integers(-200, 201, (COUNT, 3)).astype(float)
    k = rng.integers(-200, 201, (COUNT, 4)).astype(float)
    q[:3], k[2:5] = 0.0, 0.0
    q[5:20, 2] = 2 * q[5:20, 1] - q[5:20, 0]
    weights = rng.integers(0, 16, (COUNT, 2)).astype(float)
    weights[weights.sum(axis=1) == 0.0] = 1.0
    interval = np.sort(rng.integers(0, 9, (COUNT, 2)), axis=1) / 8.0
    return run(q, k, weights, interval)


@pytest.fixture(scope="module")
def rounded():
    """Polynomials, weights and intervals for which floating point has to round, of mixed sizes."""
    rng = np.random.default_rng(2)
    q, k = (rng.uniform(-1.0, 1.0, (COUNT, n)) * 10.0 ** rng.uniform(-8.0, 0.0, (COUNT, n)) for n in (3, 4))
    weights = rng.uniform(0.0, 1.0, (COUNT, 2)) * 10.0 ** rng.uniform(-3.0, 0.0, (COUNT, 2))
    interval = np.sort(rng.uniform(0.0, 1.0, (COUNT, 2)) ** rng.choice([1, 8], (COUNT, 1)), axis=1)
    return run(q, k, weights, interval)


def test_values_are_those_of_the_polynomials_times_a_power_of_the_weights(batch):
    for q, k, (a, b), values in zip(batch.q, batch.k, batch.weights, batch.values, strict=True):
        t = a / (a + b)
        assert values == [(a + b) ** 2 * value(q, t), (a + b) ** 3 * value(k, t)]


def test_the_parts_of_a_split_are_the_polynomial_on_both_sides(batch):
    for degree, wholes, parts in ((2, batch.q, batch.q_parts), (3, batch.k, batch.k_parts)):
        for whole, (left, right, _), (a, b) in zip(wholes, parts, batch.weights, strict=True):
            t = a / (a + b)
            for s in TIMES:
                assert value(left, s) == (a + b) ** degree * value(whole, t * s)
                assert value(right, s) == (a + b) ** degree * value(whole, t + (1 - t) * s)


def test_a_restriction_is_the_polynomial_between_two_times(batch):
    for wholes, parts in ((batch.q, batch.q_parts), (batch.k, batch.k_parts)):
        for whole, (*_, part), (start, end) in zip(wholes, parts, batch.interval, strict=True):
            assert all(value(part, s) == value(whole, start + (end - start) * s) for s in TIMES)


def test_mix_interpolates(batch):
    for k, (_, t), mixed in zip(batch.k, batch.interval, batch.mixed, strict=True):
        assert mixed == (1 - t) * k[0] + t * k[1]


def test_the_division_is_a_polynomial_identity(batch):
    for q, k, factor, remainder in zip(batch.q, batch.k, batch.factor, batch.remainder, strict=True):
        square = (q[0] - 2 * q[1] + q[2]) ** 2
        for t in TIMES:
            assert square * value(k, t) == value(factor, t) * value(q, t) + value(remainder, t)


def test_the_division_is_the_decomposition_of_the_paper(batch):
    """Compares with the determinants of the Polynomial Decomposition Theorem, multiplied by the one they divide by."""
    for j, i, (l0, l1), (k0, k1) in zip(batch.q, batch.k, batch.factor, batch.remainder, strict=True):
        determinant = 4 * (j[1] - j[2]) * (j[1] - j[0]) - (j[0] - j[2]) * (j[2] - j[0])
        right0, right1 = 3 * i[1] - 2 * i[0] - i[3], 3 * i[2] - 2 * i[3] - i[0]
        assert determinant == (j[0] - 2 * j[1] + j[2]) ** 2
        assert l0 == 2 * (j[1] - j[2]) * right0 - (j[0] - j[2]) * right1
        assert l1 == 2 * (j[1] - j[0]) * right1 - (j[2] - j[0]) * right0
        assert k0 == determinant * i[0] - l0 * j[0]
        assert k1 == determinant * i[3] - l1 * j[2]


def test_rounding_of_an_interpolation_stays_within_three_roundoffs(rounded):
    for k, (_, t), mixed in zip(rounded.k, rounded.interval, rounded.mixed, strict=True):
        assert abs(mixed - (1 - t) * k[0] - t * k[1]) <= 3 * ROUNDOFF * max(abs(k[0]), abs(k[1]))


def blossom(coefficients, times):
    """The polar form of a polynomial: its Bernstein coefficients on an interval, where the times are its ends."""
    for t in times:
        coefficients = [(1 - t) * x + t * y for x, y in itertools.pairwise(coefficients)]
    return coefficients[0]


def test_rounding_of_a_restriction_stays_within_three_roundoffs_a_degree(rounded):
    for degree, wholes, parts in ((2, rounded.q, rounded.q_parts), (3, rounded.k, rounded.k_parts)):
        for whole, (*_, part), (start, end) in zip(wholes, parts, rounded.interval, strict=True):
            bound = 3 * degree * ROUNDOFF * max(map(abs, whole))
            for i, coefficient in enumerate(part):
                assert abs(coefficient - blossom(whole, [start] * (degree - i) + [end] * i)) <= bound


def test_rounding_of_a_split_stays_within_ten_roundoffs(rounded):
    for degree, wholes, parts in ((2, rounded.q, rounded.q_parts), (3, rounded.k, rounded.k_parts)):
        for whole, (left, right, _), (a, b) in zip(wholes, parts, rounded.weights, strict=True):
            t, scale = a / (a + b), (a + b) ** degree
            bound = 10 * ROUNDOFF * scale * max(map(abs, whole))
            for i in range(degree + 1):
                assert abs(left[i] - scale * blossom(whole, [0] * (degree - i) + [t] * i)) <= bound
                assert abs(right[i] - scale * blossom(whole, [t] * (degree - i) + [1] * i)) <= bound
