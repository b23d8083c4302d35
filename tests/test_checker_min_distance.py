"""The exact checker with a minimum distance, against brute force, known distances, closed forms and invariances."""

import itertools
from fractions import Fraction

import distances
import numpy as np
import pytest
from generators import GENERATORS
from hypothesis import given, settings
from hypothesis import strategies as st
from sample_sizes import cases

from warp_bsc import checker
from warp_bsc.checker import queries
from warp_bsc.checker.filters import polygons_near

KINDS = distances.KINDS
COLLIDES = {kind: getattr(checker, kind) for kind in KINDS}
TOI = {kind: getattr(checker, f"{kind}_toi") for kind in KINDS}


@pytest.mark.parametrize("kind", KINDS)
def test_distance_that_is_reached_exactly_decides_to_the_last_bit(kind):
    rng = np.random.default_rng(1)
    points, distance = distances.reached(rng, cases(250), kind)
    distance, truth = distances.nudged(rng, distance)
    points, distance = distances.scaled(rng, points, distance)
    assert 0.3 < truth.mean() < 0.9
    assert (distance < 1e-250).any()
    assert (distance > 1e250).any()
    assert np.array_equal(COLLIDES[kind](points, distance), truth)


@pytest.mark.parametrize("kind", KINDS)
def test_brute_force_brackets_the_answer(kind):
    points, distance = distances.adversarial(np.random.default_rng(2), 400, kind)
    hit, free = distances.brute_force(kind, points, distance)
    answer = COLLIDES[kind](points, distance)
    assert (hit | free).mean() > 0.8
    assert min(hit.sum(), free.sum()) > 20
    assert answer[hit].all()
    assert not answer[free].any()


def lattice(kind):
    count = 6 * distances.POINTS[kind]
    return st.lists(st.integers(-3, 3), min_size=count, max_size=count).map(
        lambda values: np.array(values, dtype=np.float64).reshape(1, count // 3, 3)
    )


@pytest.mark.parametrize("kind", KINDS)
@given(data=st.data(), exponent=st.integers(-1020, 1000))
@settings(max_examples=cases(25))
def test_lattice(kind, data, exponent):
    """Integer coordinates, whose distances are often exactly the one asked for, at any scale."""
    points = data.draw(lattice(kind))
    distance = data.draw(st.sampled_from([0.5, 1.0, 1.5, 2.0, 3.0, 5.0]))
    hit, free = distances.brute_force(kind, points, np.array([distance]))
    answer = COLLIDES[kind](points, distance)[0]
    assert answer or not hit[0]
    assert not answer or not free[0]
    half = distances.POINTS[kind]
    for other in (np.roll(points, half, axis=1), points[..., [2, 0, 1]], -points, points + 1.0):
        assert COLLIDES[kind](other, distance)[0] == answer
    assert COLLIDES[kind](np.ldexp(points, exponent), np.ldexp(distance, exponent))[0] == answer
    assert COLLIDES[kind](points.astype(np.float32), distance)[0] == answer
    assert np.isfinite(TOI[kind](points, distance)).all() == answer


@pytest.mark.parametrize("kind", ["vertex_face", "edge_edge"])
@pytest.mark.parametrize("name", ["integer_lattice", "collapsing", "coplanar", "grazing"])
def test_distance_of_zero_is_contact_in_its_own_polynomials_too(kind, name):
    points = GENERATORS[name](np.random.default_rng(3), cases(40), kind, np.float64)
    shapes = list(queries.polygons(points, queries.POLYGONS[kind], np.zeros(len(points))))
    collides = queries.collides(shapes, np.zeros(len(points), dtype=bool))
    assert collides.sum() > 0
    assert np.array_equal(collides, COLLIDES[kind](points))
    toi = queries.earliest(shapes, np.full((len(points), 2), np.nan))
    assert np.array_equal(toi, TOI[kind](points), equal_nan=True)


@pytest.mark.parametrize("kind", KINDS)
def test_filter_agrees_with_exact_arithmetic(kind):
    points, distance = distances.adversarial(np.random.default_rng(4), cases(120), kind)
    shapes = queries.polygons(points, queries.POLYGONS[kind], distance)
    exact = queries.collides(shapes, np.zeros(len(points), dtype=bool))
    near, hit = polygons_near(points, queries.POLYGONS[kind], distance)
    assert exact[hit].all()
    assert not exact[~near].any()
    assert (hit | ~near).mean() > 0.6


@given(
    st.floats(1e-290, 1e290),
    st.floats(1e-290, 1e290),
    st.floats(-1e290, 1e290),
    st.sampled_from([(0.0, 0.0), (1.0, 0.5), (1.0, 0.0)]),
)
@settings(max_examples=cases(20))
def test_time_of_a_fall_to_a_distance(distance, start, end, foot):
    """A point that falls onto the plane, a side or a corner of a face, straight down."""
    side = 1e291
    face = [[-side, -side, 0], [side, -side, 0], [0, side, 0]]
    over = {(0.0, 0.0): [0.0, 0.0], (1.0, 0.5): [0.0, -side], (1.0, 0.0): [side, -side]}[foot]
    points = np.array([[[*over, start], *face, [*over, end], *face]])
    lower, upper = checker.vertex_face_toi(points, distance)[0]
    if start <= distance:
        assert lower == upper == 0.0
    elif end > distance:
        assert np.isnan(lower)
    else:
        time = (Fraction(start) - Fraction(distance)) / (Fraction(start) - Fraction(end))
        assert Fraction(lower) <= time <= Fraction(upper)
        assert upper in (lower, np.nextafter(lower, 1.0))


@pytest.mark.parametrize("corners", list(itertools.permutations(range(3))))
def test_collapsed_face_is_its_longest_side(corners):
    """A face in a line, from (0, 0, 0) by (1, 0, 0) to (4, 0, 0); a point that passes at a distance of 5."""
    face = np.array([[0, 0, 0], [1, 0, 0], [4, 0, 0]], dtype=np.float64)[list(corners)]
    for start, end in (([2, 5, -9], [2, 5, 9]), ([7, 4, -9], [7, 4, 9]), ([-9, 3, 4], [9, 3, 4])):
        points = np.array([[start, *face, end, *face]], dtype=np.float64)
        assert checker.vertex_face(points, 5.0).all()
        assert not checker.vertex_face(points, np.nextafter(5.0, 0.0)).any()


def test_distances_of_their_own():
    points = np.array([[[0, 0, 0], [z, 0, 0]] * 2 for z in range(4)], dtype=np.float32)
    assert checker.vertex_vertex(points, [0.0, 0.5, 2.0, 3.5]).tolist() == [True, False, True, True]
    assert checker.vertex_vertex(points, 1.0).tolist() == [True, True, False, False]
    assert checker.vertex_vertex(points).tolist() == [True, False, False, False]


@pytest.mark.parametrize("function", [*COLLIDES.values(), *TOI.values()])
def test_bad_input_is_refused(function):
    rows = {"vertex_edge": 6, "vertex_vertex": 4}.get(function.__name__.removesuffix("_toi"), 8)
    points = np.zeros((3, rows, 3))
    for distance in (-1.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="finite and at least 0"):
            function(points, distance)
    with pytest.raises(ValueError, match=r"one number or have shape \(3,\)"):
        function(points, [1.0, 2.0])
    with pytest.raises(ValueError, match=rf"shape \(n, {rows}, 3\)"):
        function(np.zeros((3, rows + 1, 3)))
    assert len(function(points[:0], 1.0)) == 0
