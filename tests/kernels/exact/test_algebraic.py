"""Signs at and order of roots in wide integers, against the checker's theorem of Sturm and Tarski."""

from math import comb

import numpy as np
import warp as wp
from outputs import filled_with_nan
from sample_sizes import cases

from warp_bsc.checker.polynomials import differentiate, trim
from warp_bsc.checker.roots import doubles_around, inner_part, isolated_roots, sign_at_root
from warp_bsc.kernels.exact import algebraic
from warp_bsc.kernels.exact.wide_integers import integer

DIGITS = 30
number = integer(2)


@wp.kernel(enable_backward=False, module="unique")
def answer(
    f: wp.array2d[number],
    q: wp.array2d[number],
    cubic_roots: wp.array[int],
    quadratic_roots: wp.array[int],
    signs: wp.array[wp.vec2i],
    cubic_signs: wp.array[wp.vec3i],
    times: wp.array2d[wp.float64],
):
    i = wp.tid()
    f0 = f[i, 0]
    f1 = f[i, 1]
    f2 = f[i, 2]
    f3 = f[i, 3]
    q0 = q[i, 0]
    q1 = q[i, 1]
    q2 = q[i, 2]
    roots = algebraic.count_cubic_roots(f0, f1, f2, f3)
    cubic_roots[i] = roots
    turns = algebraic.count_quadratic_roots(q0, q1, q2)
    quadratic_roots[i] = turns
    for index in range(3):
        if index >= 3 - roots:
            times[i, index] = algebraic.root_time(f0, f1, f2, f3, roots, index, wp.static(DIGITS))
    if turns > 0:
        signs[i] = algebraic.signs_at_roots(f0, f1, f2, f3, q0, q1, q2, turns)
    if roots > 0:
        cubic_signs[i] = algebraic.signs_at_cubic_roots(q0, q1, q2, turns, f0, f1, f2, f3, roots)


def to_limbs(values):
    """Limbs of small integers."""
    return np.stack([values, values >> 63], axis=-1).astype(np.uint64)


def ask(f, q):
    """Asks the device about cubics and quadratics in z, integer arrays of shapes (n, 4) and (n, 3)."""
    n = len(f)
    outputs = [wp.zeros(n, dtype=int), wp.zeros(n, dtype=int), wp.zeros(n, dtype=wp.vec2i)]
    outputs += [wp.zeros(n, dtype=wp.vec3i), filled_with_nan((n, 3), wp.float64)]
    inputs = [wp.array(to_limbs(x), dtype=number) for x in (f, q)]
    wp.launch(answer, n, inputs=inputs, outputs=outputs)
    return [output.numpy() for output in outputs]


def in_time(coefficients):
    """A polynomial in z as one in t, times (1 - t) to its degree: coefficients, constant first."""
    n = len(coefficients) - 1
    power_form = [0] * (n + 1)
    for i, c in enumerate(coefficients):
        for j in range(n - i + 1):
            power_form[i + j] += int(c) * comb(n - i, j) * (-1) ** j
    return trim(power_form)


def inner_roots(coefficients):
    """The polynomial without roots at the ends, and intervals around its roots strictly inside the step."""
    f = in_time(coefficients)
    if not f:
        return f, []
    f = inner_part(f)
    return f, list(isolated_roots(f))


def multiplicity(f, interval):
    """Of the root of f in an interval."""
    derivative, times = f, 0
    while sign_at_root(derivative, f, *interval) == 0:
        derivative = trim(differentiate(derivative))
        times += 1
    return times


def polynomials(rng, n):
    """Small integers, products of factors with roots in common, and large ones, zeros at both ends among them."""
    f, q = rng.integers(-4, 5, (n, 4)), rng.integers(-4, 5, (n, 3))
    lines = rng.integers(-3, 4, (4, n, 2))
    lines[:, :, 0] = -np.abs(lines[:, :, 0])

    def multiply(a, b):
        return np.stack([np.convolve(x, y) for x, y in zip(a, b, strict=True)])

    shared = rng.random(n) < 0.6
    second = np.where(rng.random((n, 1)) < 0.5, lines[0], lines[2])
    f[shared] = multiply(multiply(lines[0], lines[1]), second)[shared]
    q[shared] = multiply(np.where(rng.random((n, 1)) < 0.5, lines[0], lines[3]), lines[1])[shared]
    contained = rng.random(n) < 0.2  # roots in common that need not be rational
    f[contained] = multiply(q, lines[3])[contained]
    large = rng.random(n) < 0.2
    f[large] = rng.integers(-(2**30), 2**30, (n, 4))[large]
    q[large] = rng.integers(-(2**20), 2**20, (n, 3))[large]
    return f, q


def with_multiplicity(f, intervals):
    """The intervals, each as often as the root in it counts."""
    return [interval for interval in intervals for _ in range(multiplicity(f, interval))]


def test_roots_are_counted_and_signs_are_those_at_the_roots():
    rng = np.random.default_rng(0)
    f, q = polynomials(rng, 1000 + cases(3000))
    cubic_roots, quadratic_roots, signs, cubic_signs, times = ask(f, q)
    seen = set()
    for i in range(len(f)):
        f_inner, f_intervals = inner_roots(f[i])
        q_inner, q_intervals = inner_roots(q[i])
        f_intervals = with_multiplicity(f_inner, f_intervals)
        q_intervals = with_multiplicity(q_inner, q_intervals)
        # a polynomial that is zero has no roots to count
        assert cubic_roots[i] == len(f_intervals), (f[i], q[i])
        assert quadratic_roots[i] == len(q_intervals), (f[i], q[i])
        if q_intervals:
            expected = [sign_at_root(in_time(f[i]), q_inner, *interval) for interval in q_intervals]
            assert signs[i].tolist() == [expected[0], expected[-1]], (f[i], q[i])
        if f_intervals:
            expected = [sign_at_root(in_time(q[i]), f_inner, *interval) for interval in f_intervals]
            assert cubic_signs[i].tolist()[3 - len(expected) :] == expected, (f[i], q[i])
            for time, interval in zip(times[i][3 - len(expected) :], f_intervals, strict=True):
                low, high = doubles_around(f_inner, *interval)
                assert time <= high and low < time + 2.0**-DIGITS, (f[i], time)
        seen.add((len(f_intervals), len(q_intervals), len(set(f_intervals)) == len(f_intervals)))
    assert len(seen) >= 17, "the polynomials are of too few kinds"
