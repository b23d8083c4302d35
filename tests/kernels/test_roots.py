"""Root counts and signs at roots: every certain answer holds for every polynomial within the bounds.

The device functions see coefficients with a bound on their errors. The truth comes from the exact checker's theorem of
Sturm and Tarski, for polynomials elsewhere within the bound, in its corners above all.
"""

import itertools
from fractions import Fraction
from math import comb
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp
from generators import mostly_hits, uniform
from sample_sizes import cases

from warp_bsc import checker
from warp_bsc.checker.polynomials import differentiate, trim
from warp_bsc.checker.roots import isolated_roots, sign_at_root
from warp_bsc.kernels import HIT, UNSURE, roots, signs
from warp_bsc.kernels.classification import classify, classify_with
from warp_bsc.kernels.motion import edge_edge_motion, vertex_face_motion
from warp_bsc.kernels.polynomials import InsideTests, coplanarity

ROUNDOFF = 2.0**-53
SHAPE_BOUND, QUADRATIC_BOUND = 13.0 * ROUNDOFF, 5.0 * ROUNDOFF  # of the size of the coefficients, the least allowed


@wp.kernel(enable_backward=False)
def answer(
    k: wp.array[wp.vec4d],
    k_bound: wp.array[wp.float64],
    q: wp.array[wp.vec3d],
    q_bound: wp.array[wp.float64],
    line: wp.array[wp.vec2d],
    line_bound: wp.array[wp.float64],
    shape: wp.array[int],
    count: wp.array[int],
    q_signs: wp.array[wp.vec2i],
    line_signs: wp.array[wp.vec2i],
):
    i = wp.tid()
    shape[i] = roots.curve_class(k[i], k_bound[i])
    count[i] = roots.UNKNOWN
    if shape[i] == roots.MONOTONE or shape[i] == roots.ONE_EXTREMUM:
        count[i] = roots.count_roots(k[i], k_bound[i], shape[i])
    if count[i] > 0:
        size = roots.largest(k[i])
        q_signs[i] = roots.quadratic_signs(q[i], q_bound[i], k[i], k_bound[i], size, count[i])
        line_signs[i] = roots.linear_signs(line[i], line_bound[i], k[i], k_bound[i], size, count[i])


@wp.kernel(enable_backward=False)
def classify_polynomials(
    k: wp.array[wp.vec4d],
    k_bound: wp.array[wp.float64],
    q: wp.array2d[wp.vec3d],
    q_bounds: wp.array[wp.vec4d],
    status: wp.array[int],
):
    i = wp.tid()
    tests = InsideTests()
    tests.q0 = q[i, 0]
    tests.q1 = q[i, 1]
    tests.q2 = q[i, 2]
    tests.q3 = q[i, 3]
    tests.bounds = q_bounds[i]
    status[i] = classify_with(k[i], k_bound[i], tests)


@wp.kernel(enable_backward=False)
def classify_queries(edges: bool, x: wp.array2d[wp.vec3d], shape: wp.array[int], status: wp.array[int]):
    i = wp.tid()
    if edges:
        motion = edge_edge_motion(
            x[i, 0], x[i, 1], x[i, 2], x[i, 3], x[i, 4], x[i, 5], x[i, 6], x[i, 7], signs.ROUNDOFF
        )
    else:
        motion = vertex_face_motion(
            x[i, 0], x[i, 1], x[i, 2], x[i, 3], x[i, 4], x[i, 5], x[i, 6], x[i, 7], signs.ROUNDOFF
        )
    y = coplanarity(motion)
    shape[i] = roots.curve_class(y.k, y.bound)
    status[i] = classify(motion, y)


def ask(k, k_bound, q, q_bound, line, line_bound):
    """The answers to rows of polynomials with their bounds, as NumPy arrays; signs are 0 where none are asked for."""
    n = len(k)
    inputs = [
        wp.array(np.broadcast_to(array, (n, *np.shape(array)[1:])), dtype=dtype)
        for array, dtype in (
            (k, wp.vec4d),
            (k_bound, wp.float64),
            (q, wp.vec3d),
            (q_bound, wp.float64),
            (line, wp.vec2d),
            (line_bound, wp.float64),
        )
    ]
    outputs = {
        "shape": wp.zeros(n, dtype=int),
        "count": wp.zeros(n, dtype=int),
        "q_signs": wp.zeros(n, dtype=wp.vec2i),
        "line_signs": wp.zeros(n, dtype=wp.vec2i),
    }
    wp.launch(answer, n, inputs=inputs, outputs=list(outputs.values()))
    return SimpleNamespace(**{name: array.numpy() for name, array in outputs.items()})


# --- The truth ---


def integer_polynomial(coefficients):
    """The polynomial with these Bernstein coefficients, times a positive number: integers, constant first."""
    n = len(coefficients) - 1
    differences, power_form = [Fraction(c) for c in coefficients], []
    for i in range(n + 1):
        power_form.append(comb(n, i) * differences[0])
        differences = [b - a for a, b in itertools.pairwise(differences)]
    denominator = np.lcm.reduce([c.denominator for c in power_form], dtype=object)
    return trim([int(c * denominator) for c in power_form])


def assert_true(answers, i, k, q, line):
    """Asserts that the certain ones of answers i are true for these polynomials."""
    shape, count = answers.shape[i], answers.count[i]
    if shape == roots.UNKNOWN or shape == roots.TWO_EXTREMA:
        return
    f = integer_polynomial(k)
    slope = trim(differentiate(f))
    assert slope[0] != 0
    assert sum(slope) != 0
    assert len(list(isolated_roots(slope))) == shape
    if count == roots.UNKNOWN:
        return
    assert f[0] != 0
    assert sum(f) != 0
    intervals = list(isolated_roots(f))
    assert len(intervals) == count
    for polynomial, certain in ((q, answers.q_signs[i]), (line, answers.line_signs[i])):
        for interval, sign in zip((intervals[0], intervals[-1]) if count else (), certain, strict=False):
            assert sign == 0 or sign == sign_at_root(integer_polynomial(polynomial), f, *interval)


# --- Polynomials that aim at trouble ---


def product(f, g):
    """Bernstein coefficients of products of polynomials, along the last axis."""
    m, n = f.shape[-1] - 1, g.shape[-1] - 1
    total = np.zeros((len(f), m + n + 1))
    for i in range(m + 1):
        for j in range(n + 1):
            total[:, i + j] += comb(m, i) * comb(n, j) / comb(m + n, i + j) * f[:, i] * g[:, j]
    return total


def root_at(t):
    """Lines with a root at t."""
    return np.stack([-t, 1.0 - t], axis=-1)


def polynomials(rng, n):
    """Cubics, quadratics and lines of size about 1, half of them random, the others with roots in chosen places.

    Cubics have roots close to each other or outside [0, 1], are almost of degree two, or steep; quadratics and lines
    have roots close to a root of the cubic.
    """
    first = np.where(rng.random(n) < 0.5, rng.uniform(0.0, 1.0, n), rng.integers(0, 2, n))
    first += 10.0 ** rng.uniform(-4.0, -1.0, n) * rng.choice([-1.0, 1.0], n)
    gap = 10.0 ** rng.uniform(-8.0, -0.5, n)
    third = rng.uniform(1.0, 3.0, n) * rng.choice([-1.0, 1.0], n) + 0.5
    third = np.where(rng.random(n) < 0.3, first + gap * rng.uniform(-3.0, 3.0, n), third)
    k = product(product(root_at(first), root_at(first + gap)), root_at(third))
    k += rng.choice([0.0, 1.0, -1.0], (n, 1)) * 10.0 ** rng.uniform(-12.0, -1.0, (n, 1))  # moves a double root off zero
    shape = rng.integers(0, 5, n)[:, None]
    k = np.where(shape == 0, rng.uniform(-1.0, 1.0, (n, 4)), k)
    k = np.where(shape == 2, rng.choice([-1.0, 1.0], (n, 4)) * rng.uniform(0.5, 1.0, (n, 4)), k)
    raised = product(rng.uniform(-1.0, 1.0, (n, 3)), np.ones((n, 2)))
    k = np.where(shape == 1, raised + 10.0 ** rng.uniform(-12.0, -1.0, (n, 1)) * rng.uniform(-1.0, 1.0, (n, 4)), k)
    near = first + 10.0 ** rng.uniform(-10.0, -0.5, n) * rng.choice([-1.0, 1.0], n)
    q = product(root_at(near), root_at(rng.uniform(-2.0, 2.0, n)))
    q = np.where(rng.random((n, 1)) < 0.5, rng.uniform(-1.0, 1.0, (n, 3)), q)
    line = np.where(rng.random((n, 1)) < 0.5, rng.uniform(-1.0, 1.0, (n, 2)), root_at(near))
    return tuple(f * rng.choice([-1.0, 1.0], (n, 1)) for f in (k, q, line))


def size(f):
    """The largest coefficients of polynomials, along the last axis."""
    return np.abs(f).max(axis=-1)


def test_answers_without_bounds_are_true_where_nothing_rounds():
    """Small integers: what floating point computes is exact."""
    rng = np.random.default_rng(1)
    k, q, line = (rng.integers(-4, 5, (3000, n)).astype(float) for n in (4, 3, 2))
    zero = np.zeros(len(k))
    answers = ask(k, zero, q, zero, line, zero)
    for i in range(len(k)):
        assert_true(answers, i, k[i], q[i], line[i])
    assert (answers.count == 1).sum() > 500
    assert (answers.count == 2).sum() > 20


def test_double_roots_are_never_counted():
    """Cubics touch zero exactly at the root of the chord of their slope, at scales where its products underflow too."""
    rng = np.random.default_rng(5)
    a, b = rng.integers(1, 2**20, (2, 200000)) * 2.0**-20
    square = np.stack([a * a, -a * b, b * b], axis=-1)
    exponent = np.where(rng.random((len(a), 1)) < 0.9, rng.integers(-262, -254, (len(a), 1)), 0)
    k = 3.0 * product(square, np.ones((len(a), 2))) * 2.0**exponent
    one = np.ones(len(k))
    answers = ask(k, SHAPE_BOUND * size(k) + ROUNDOFF * 1e-140, k[:, :3], one, k[:, :2], one)
    assert (answers.shape == roots.ONE_EXTREMUM).mean() > 0.9
    assert (answers.count == roots.UNKNOWN).all()


@pytest.mark.parametrize("scale", [1.0, 2.0**-60], ids=["large", "small"])
def test_answers_hold_within_rounding_errors(scale):
    """Perturbs doubles by errors as large as the least bounds allow, to both sides."""
    rng = np.random.default_rng(2)
    k, q, line = (scale * f for f in polynomials(rng, cases(2000)))
    bounds = [unit * (ROUNDOFF * 1e-140 + size(f)) for unit, f in ((SHAPE_BOUND, k), (QUADRATIC_BOUND, q))]
    line_bound = QUADRATIC_BOUND * size(line)
    computed = []
    for f, bound in ((k, bounds[0]), (q, bounds[1]), (line, line_bound)):
        # rounding the sum may add half a roundoff
        computed.append(f + 0.9 * bound[:, None] * rng.choice([-1.0, 1.0, 0.5], f.shape))
    answers = ask(computed[0], 1.1 * bounds[0], computed[1], 1.1 * bounds[1], computed[2], 1.1 * line_bound)
    assert (answers.count >= 0).mean() > 0.5
    for i in range(len(k)):
        assert_true(answers, i, k[i], q[i], line[i])


LEVELS = 2.0 ** -np.arange(1.0, 25.0, 0.5)


def corners(rng):
    """Signs of errors for the coefficients of cubic, quadratic and line: all shifts up or down, some at random."""
    for k_sign, sign in itertools.product([-1, 1], repeat=2):
        yield [k_sign] * 4, [sign] * 3, [sign] * 2
    for _ in range(3):
        yield tuple(rng.choice([-1, 1], n).tolist() for n in (4, 3, 2))


def test_answers_hold_for_every_polynomial_within_large_bounds():
    """Takes the largest bound at which an answer is certain and asks for the truth in corners of what it allows."""
    rng = np.random.default_rng(3)
    count = cases(700)
    k, q, line = (np.round(1024.0 * f) for f in polynomials(rng, count))
    ratio = 2.0 ** rng.integers(-8, 9, (count, 1))
    k_bound = np.maximum(size(k), 1.0)[:, None] * LEVELS
    q_bound, line_bound = (np.maximum(size(f), 1.0)[:, None] * LEVELS * ratio for f in (q, line))
    rows = [np.repeat(f, len(LEVELS), axis=0) for f in (k, q, line)]
    answers = ask(rows[0], k_bound.ravel(), rows[1], q_bound.ravel(), rows[2], line_bound.ravel())
    certain = {
        "shape": np.isin(answers.shape, (roots.MONOTONE, roots.ONE_EXTREMUM)),
        "roots": answers.count >= 0,
        "quadratic at first": answers.q_signs[:, 0] != 0,
        "quadratic at last": answers.q_signs[:, 1] != 0,
        "line at first": answers.line_signs[:, 0] != 0,
        "line at last": answers.line_signs[:, 1] != 0,
    }
    for name, is_certain in certain.items():
        largest = is_certain.reshape(count, -1).argmax(axis=1)
        asked = 0
        for case in range(count):
            i = case * len(LEVELS) + largest[case]
            if not is_certain[i]:
                continue
            asked += 1
            bounds = [bound.flat[i] for bound in (k_bound, q_bound, line_bound)]
            for k_signs, q_signs, line_signs in corners(rng):
                within = [
                    [Fraction(c) + sign * Fraction(bound) for c, sign in zip(f[i], signs, strict=True)]
                    for f, bound, signs in zip(rows, bounds, (k_signs, q_signs, line_signs), strict=True)
                ]
                assert_true(answers, i, *within)
        assert asked > count / 5, name
        assert LEVELS[largest].max() > 0.05, name


def turning(k):
    """Both ends of the line T whose sign at an extremum is that of the cubic, up to the sign of its leading term."""
    d = np.diff(k, axis=-1)
    e = np.diff(d, axis=-1)
    leading = e[..., 1] - e[..., 0]
    return np.stack([leading * k[..., 0] - e[..., 0] * d[..., 0], leading * k[..., 3] - e[..., 1] * d[..., 2]], axis=-1)


def division(k, q):
    """Both ends of the lines L and K of D^2 Y = L q + K."""
    d, e = np.diff(q, axis=-1), np.diff(k, n=2, axis=-1)
    leading_q, leading_k = d[..., 1] - d[..., 0], e[..., 1] - e[..., 0]
    factor = 3.0 * e * leading_q[..., None] - 2.0 * d * leading_k[..., None]
    return factor, (leading_q**2)[..., None] * k[..., [0, 3]] - factor * q[..., [0, 2]]


def test_constants_cover_the_corners_of_all_polynomials():
    """Errors are largest, relative to coefficients and bounds, where all of these are as large as they may be."""
    k_corners, q_corners = (np.array(list(itertools.product([-1.0, 1.0], repeat=n))) for n in (4, 3))
    k, k_error = k_corners[:, None], k_corners[None, :]
    worst = dict.fromkeys(("_DISCRIMINANT", "_TURNING", "_DIVISION_L", "_DIVISION_K"), 0.0)

    def note(name, error):
        worst[name] = max(worst[name], np.abs(error).max(initial=0.0))

    for k_bound in 2.0 ** np.array([0.0, -1.0, -4.0, -20.0]):
        k_true = k + k_bound * k_error
        note("_TURNING", (turning(k_true) - turning(k)) / k_bound)
        d, d_true = np.broadcast_arrays(np.diff(k, axis=-1), np.diff(k_true, axis=-1))
        asked = (np.abs(d) > 2.5 * k_bound)[..., [0, 2]].all(axis=-1)
        error = (d_true[..., 1] ** 2 - d_true[..., 0] * d_true[..., 2]) - (d[..., 1] ** 2 - d[..., 0] * d[..., 2])
        note("_DISCRIMINANT", (error / np.abs(d).max(axis=-1, initial=1e-9) / k_bound)[asked])
        for q_bound in 2.0 ** np.array([0.0, -1.0, -4.0, -20.0]):
            q = q_corners[:, None, None, None]
            q_true = q + q_bound * q_corners[:, None, None]
            factor, remainder = division(k, q)
            factor_true, remainder_true = division(k_true, q_true)
            note("_DIVISION_L", (factor_true - factor) / (k_bound + q_bound))
            note("_DIVISION_K", (remainder_true - remainder) / (k_bound + q_bound))
    for name, error in worst.items():
        constant = float(getattr(roots, name))
        assert constant / 16.0 < error < constant, name


def test_answers_to_random_polynomials_are_nearly_always_certain():
    """Counts what stays open with the least bounds allowed."""
    rng = np.random.default_rng(4)
    k, q, line = (rng.uniform(-1.0, 1.0, (50000, n)) for n in (4, 3, 2))
    answers = ask(k, SHAPE_BOUND * size(k), q, QUADRATIC_BOUND * size(q), line, QUADRATIC_BOUND * size(line))
    assert (answers.shape == roots.UNKNOWN).mean() < 1e-4
    whole = np.isin(answers.shape, (roots.MONOTONE, roots.ONE_EXTREMUM))
    assert whole.mean() > 0.5
    assert (answers.count[whole] == roots.UNKNOWN).mean() < 1e-4
    crossing = answers.count > 0
    assert (answers.q_signs[crossing] == 0).mean() < 1e-4
    assert (answers.line_signs[crossing] == 0).mean() < 1e-4


def test_cubics_that_are_split_are_classified_at_any_scale():
    """Three roots, the middle one often at the inflection; as certain at 2^-60, where no power of Y's size matters."""
    rng = np.random.default_rng(7)
    n = 20000
    root = np.sort(rng.integers(1, 255, (3, n)), axis=0) / 256.0
    root[1] = np.where(rng.random(n) < 0.7, (root[0] + root[2]) / 2.0, root[1])
    k = product(product(root_at(root[0]), root_at(root[1])), root_at(root[2])) * rng.choice([-1.0, 1.0], (n, 1))
    tests = np.empty((n, 4, 3))
    for i in range(4):
        near = root[rng.integers(0, 3, n), np.arange(n)]
        crossing = product(root_at(near), root_at(rng.integers(-512, 512, n) / 256.0))
        tests[:, i] = np.where(rng.random((n, 1)) < 0.6, crossing, rng.integers(1, 9, (n, 3)) / 8.0)
        tests[:, i] *= rng.choice([-1.0, 1.0], (n, 1))
    least = ROUNDOFF * 1e-140

    def classified(scale):
        status = wp.zeros(n, dtype=int)
        k_bound, q_bounds = SHAPE_BOUND * size(scale * k) + least, QUADRATIC_BOUND * size(tests) + least
        arrays = ((scale * k, wp.vec4d), (k_bound, wp.float64), (tests, wp.vec3d), (q_bounds, wp.vec4d))
        inputs = [wp.array(array, dtype=dtype) for array, dtype in arrays]
        wp.launch(classify_polynomials, n, inputs=inputs, outputs=[status])
        return status.numpy()

    expected = classified(1.0)
    assert 0.2 < (expected != UNSURE).mean() < 0.8
    assert np.array_equal(classified(2.0**-60), expected)
    for exponent in (*range(-300, -240, 4), -400):
        status = classified(2.0**exponent)
        certain = status != UNSURE
        assert np.array_equal(status[certain], expected[certain])
        assert certain.sum() > 0.8 * (expected != UNSURE).sum()


@pytest.mark.parametrize("kind", ["vertex_face", "edge_edge"])
def test_classification_alone_decides_nearly_all_random_queries(kind):
    """Without subdivision, the cubics with two extrema, which are split, as often as the others."""
    rng = np.random.default_rng(6)
    points = np.concatenate([generator(rng, cases(4000), kind, np.float64) for generator in (uniform, mostly_hits)])
    n = len(points)
    shape, status = wp.zeros(n, dtype=int), wp.zeros(n, dtype=int)
    inputs = [kind == "edge_edge", wp.array(points, dtype=wp.vec3d)]
    wp.launch(classify_queries, n, inputs=inputs, outputs=[shape, status])
    shape, status = shape.numpy(), status.numpy()
    truth = getattr(checker, kind)(points)
    assert np.array_equal((status == HIT)[status != UNSURE], truth[status != UNSURE])
    for queries in (status, status[shape == roots.TWO_EXTREMA]):
        assert len(queries) > 50
        assert (queries == UNSURE).mean() < 1e-3
