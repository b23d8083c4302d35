"""The exact checker against known truth and truth by construction, invariances, and its input."""

import itertools
import subprocess
import sys
from fractions import Fraction

import benchmark_data
import numpy as np
import pytest
from checker_functions import COLLIDES, KINDS, TOI
from generators import GENERATORS, exact_contacts
from hypothesis import given, settings
from hypothesis import strategies as st
from sample_sizes import cases

from warp_bsc import checker
from warp_bsc.checker.filters import triangles_may_touch
from warp_bsc.checker.queries import VERTEX_FACE

# --- Benchmark queries ---


@pytest.mark.data
@pytest.mark.parametrize(
    ("load", "queries", "collisions"), [("load_queries", 2324, 308), ("load_cloth_funnel_queries", 355, 134)]
)
def test_benchmark_truth(load, queries, collisions):
    files = getattr(benchmark_data, load)()
    assert sum(len(truth) for *_, truth in files) == queries
    assert sum(truth.sum() for *_, truth in files) == collisions
    for family, kind, points, truth in files:
        assert np.array_equal(COLLIDES[kind](points), truth), (family, kind)
        assert np.array_equal(np.isfinite(TOI[kind](points)).all(axis=1), truth), (family, kind)


# --- Truth by construction ---


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("kind", KINDS)
def test_constructed_contact_is_found_and_not_after_its_time(kind, dtype):
    points, time = exact_contacts(np.random.default_rng(4), 500, kind, dtype)
    lower, upper = TOI[kind](points).T
    assert COLLIDES[kind](points).all()
    assert (lower <= time).all()
    assert (upper <= time).all()
    assert (lower == time).mean() > 0.5


@pytest.mark.parametrize("kind", KINDS)
def test_pairs_that_a_moving_plane_separates_are_free(kind):
    rng = np.random.default_rng(5)
    points, normal = rng.integers(-9, 10, (500, 2, 4, 3)), rng.integers(-3, 4, (500, 3))
    side = np.einsum("nepi,ni->nep", points, normal)
    first = np.array([1, -1, -1, -1] if kind == "vertex_face" else [1, 1, -1, -1])
    points = points * (np.sign(side) * first)[..., None] + rng.integers(-9, 10, (500, 2, 1, 3))
    separated = (side != 0).all(axis=(1, 2))
    assert separated.sum() > 200
    assert not COLLIDES[kind](points[separated].reshape(-1, 8, 3).astype(np.float64)).any()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_one_ulp_of_height_decides(kind, dtype):
    points = np.zeros((2, 8, 3))
    flat = {"vertex_face": [[1, 1], [0, 0], [4, 0], [0, 4]], "edge_edge": [[1, -1], [1, 3], [0, 0], [4, 0]]}[kind]
    points[..., :2] = np.array(flat + flat)
    points = points.astype(dtype)
    points[..., 2] = dtype(0.1)
    first = [0, 4] if kind == "vertex_face" else [0, 1, 4, 5]
    points[1, first, 2] = np.nextafter(dtype(0.1), dtype(1))
    assert COLLIDES[kind](points).tolist() == [True, False]


@given(st.floats(0, 1.7e308, exclude_min=True), st.floats(-1.7e308, 0, exclude_max=True))
@settings(max_examples=cases(60), deadline=None)
def test_time_of_a_fall_onto_a_face(start, end):
    side = 1e300
    face = [[-side, -side, 0], [side, -side, 0], [0, side, 0]]
    points = np.array([[[0, 0, start], *face, [0, 0, end], *face]])
    lower, upper = checker.vertex_face_toi(points)[0]
    time = Fraction(start) / (Fraction(start) - Fraction(end))
    assert Fraction(lower) <= time <= Fraction(upper)
    assert upper in (lower, np.nextafter(lower, 1.0))
    assert (lower == upper) == (time in (Fraction(lower), Fraction(upper)))


# --- Invariances ---


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", GENERATORS)
def test_filter_agrees_with_exact_arithmetic(kind, name, monkeypatch):
    for dtype in (np.float32, np.float64):
        points = GENERATORS[name](np.random.default_rng(6), cases(30), kind, dtype)
        monkeypatch.undo()
        filtered = COLLIDES[kind](points)
        monkeypatch.setattr(
            "warp_bsc.checker.queries.triangles_may_touch",
            lambda points, pairs: np.ones((len(points), len(pairs)), dtype=bool),
        )
        assert np.array_equal(filtered, COLLIDES[kind](points))


def test_filter_knows_what_underflows_beside_large_coordinates():
    rng = np.random.default_rng(13)
    middle, half, corner = rng.integers(-(2**40), 2**40, (3, 200, 2))
    points = np.full((200, 4, 3), 2.0**997)
    points[..., 1:] = np.ldexp(
        np.stack([middle, middle - half, middle + half, corner], axis=1).astype(np.float64), -100
    )
    assert checker.vertex_face(np.concatenate([points, points], axis=1)).all()


def test_filter_spares_exact_arithmetic_most_queries():
    points = GENERATORS["uniform"](np.random.default_rng(7), 2000, "vertex_face", np.float64)
    assert triangles_may_touch(points, VERTEX_FACE).mean() < 0.3


def relatives(kind, points):
    """Returns queries with the answer of one query, shape (8, 3): renamed points, reversed time, other axes."""
    if kind == "vertex_face":
        orders = [[0, *face] for face in itertools.permutations((1, 2, 3))]
    else:
        orders = [[0, 1, 2, 3], [1, 0, 2, 3], [0, 1, 3, 2], [2, 3, 0, 1], [3, 2, 1, 0]]
    renamed = [points[[*order, *(i + 4 for i in order)]] for order in orders]
    return np.array(
        [*renamed, points[[4, 5, 6, 7, 0, 1, 2, 3]], points[:, [1, 2, 0]], points[:, [0, 2, 1]], points * [1, -1, 1]]
    )


def queries(elements):
    return st.lists(elements, min_size=24, max_size=24).map(
        lambda values: np.array(values, dtype=np.float64).reshape(8, 3)
    )


@pytest.mark.parametrize("kind", KINDS)
@given(
    points=queries(st.integers(-2, 2)), shift=st.tuples(*[st.integers(-9, 9)] * 3), exponent=st.integers(-1070, 1000)
)
@settings(max_examples=cases(100), deadline=None)
def test_invariance_of_lattice_queries(kind, points, shift, exponent):
    moved = np.array(
        [points + np.array(shift), np.ldexp(points, exponent), np.ldexp(points + np.array(shift), exponent)]
    )
    answers = COLLIDES[kind](np.concatenate([relatives(kind, points), moved]))
    assert answers.all() == answers.any()


@pytest.mark.parametrize("kind", KINDS)
@given(data=st.data())
@settings(max_examples=cases(20), deadline=None)
def test_invariance_of_any_floats(kind, data):
    largest = data.draw(st.sampled_from([1.0, 4.0, 1e30, 1.7e308]))
    points = data.draw(queries(st.floats(-largest, largest) | st.sampled_from([0.0, 1.0, 0.1, 1.0 - 2.0**-53])))
    answers = COLLIDES[kind](relatives(kind, points))
    assert answers.all() == answers.any()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", GENERATORS)
def test_invariance_of_adversarial_queries(kind, name):
    points = GENERATORS[name](np.random.default_rng(8), cases(20), kind, np.float32)
    answers = COLLIDES[kind](np.concatenate([relatives(kind, query) for query in points.astype(np.float64)]))
    assert np.array_equal(answers.reshape(len(points), -1).all(axis=1), answers.reshape(len(points), -1).any(axis=1))


@pytest.mark.parametrize("kind", KINDS)
def test_single_precision_is_widened(kind):
    points = GENERATORS["grazing"](np.random.default_rng(9), 100, kind, np.float32)
    assert np.array_equal(TOI[kind](points), TOI[kind](points.astype(np.float64)), equal_nan=True)


# --- Input ---


@pytest.mark.parametrize("function", [*COLLIDES.values(), *TOI.values()])
def test_bad_input_is_refused(function):
    with pytest.raises(ValueError, match=r"shape \(n, 8, 3\), got \(8, 3\)"):
        function(np.zeros((8, 3)))
    with pytest.raises(ValueError, match="float32 or float64, got int64"):
        function(np.zeros((1, 8, 3), dtype=np.int64))
    points = np.zeros((5, 8, 3))
    points[3, 1, 2] = np.inf
    with pytest.raises(ValueError, match=r"points\[3\] has a coordinate that is not finite"):
        function(points)


def test_bad_crossings_are_refused():
    with pytest.raises(ValueError, match="1 edges and 2 faces"):
        checker.edge_face_crossings(np.zeros((1, 2, 3)), np.zeros((2, 3, 3)))
    with pytest.raises(ValueError, match=r"faces must have shape \(n, 3, 3\)"):
        checker.edge_face_crossings(np.zeros((1, 2, 3)), np.zeros((1, 2, 3)))


def test_no_queries():
    points = np.zeros((0, 8, 3))
    for kind in KINDS:
        assert COLLIDES[kind](points).shape == (0,)
        assert TOI[kind](points).shape == (0, 2)
    assert checker.edge_face_crossings(np.zeros((0, 2, 3)), np.zeros((0, 3, 3))).shape == (0,)


def test_input_is_left_alone():
    points = GENERATORS["uniform"](np.random.default_rng(11), 50, "vertex_face", np.float64)
    before = points.copy()
    checker.vertex_face_toi(points)
    assert np.array_equal(points, before)


def test_needs_no_warp():
    code = "import sys, warp_bsc.checker; sys.exit('warp' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


# --- Generators ---


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("name", GENERATORS)
def test_generator(name, kind, dtype):
    points = GENERATORS[name](np.random.default_rng(12), 100, kind, dtype)
    assert points.shape == (100, 8, 3)
    assert points.dtype == dtype
    assert np.isfinite(points).all()
    again = GENERATORS[name](np.random.default_rng(12), 100, kind, dtype)
    assert np.array_equal(points, again)
    assert COLLIDES[kind](points[:25]).any()
