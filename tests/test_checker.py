"""The exact checker against known truth, an independent brute force, invariances and cases decided by hand."""

import itertools
import subprocess
import sys
from decimal import Decimal, localcontext
from fractions import Fraction

import benchmark_data
import numpy as np
import pytest
from generators import GENERATORS, exact_contacts
from hypothesis import given, settings
from hypothesis import strategies as st

from warp_bsc import checker
from warp_bsc.checker.filters import triangles_may_touch
from warp_bsc.checker.queries import VERTEX_FACE

KINDS = ("vertex_face", "edge_edge")
COLLIDES = {"vertex_face": checker.vertex_face, "edge_edge": checker.edge_edge}
TOI = {"vertex_face": checker.vertex_face_toi, "edge_edge": checker.edge_edge_toi}


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


# --- Brute force: distances at all critical times, with 60 digits ---
# Nothing here is shared with the checker: polynomials come from interpolation, roots from bisection between roots of
# the derivative, contact from the distance of closest points. Between small integers no distance is tiny but not zero;
# is_zero fails when one is.

DIGITS, ZERO, NOT_ZERO = 60, Decimal("1e-45"), Decimal("1e-25")
TOLERANCE = Fraction(1, 10**40)


def minus(a, b):
    return [i - j for i, j in zip(a, b, strict=True)]


def dot(a, b):
    return sum(i * j for i, j in zip(a, b, strict=True))


def along(a, s, direction):
    return [i + s * j for i, j in zip(a, direction, strict=True)]


def cross(a, b):
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def is_zero(squared):
    assert squared < ZERO or squared > NOT_ZERO, squared
    return squared < ZERO


def point_segment(p, a, b):
    """Returns the squared distance of a point and a segment."""
    length = dot(minus(b, a), minus(b, a))
    s = 0 if is_zero(length) else min(max(dot(minus(p, a), minus(b, a)) / length, 0), 1)
    gap = minus(p, along(a, s, minus(b, a)))
    return dot(gap, gap)


def point_triangle(p, a, b, c):
    """Returns the squared distance of a point and a triangle: to the plane if the foot is inside, else to an edge."""
    u, v, w = minus(b, a), minus(c, a), minus(p, a)
    uu, uv, vv, uw, vw = dot(u, u), dot(u, v), dot(v, v), dot(u, w), dot(v, w)
    gram = uu * vv - uv * uv
    distances = [point_segment(p, *edge) for edge in ((a, b), (b, c), (c, a))]
    if not is_zero(gram):
        s, r = (vv * uw - uv * vw) / gram, (uu * vw - uv * uw) / gram
        if s >= 0 and r >= 0 and s + r <= 1:
            gap = minus(w, along(along([0, 0, 0], s, u), r, v))
            distances.append(dot(gap, gap))
    return min(distances)


def segment_segment(a, b, c, d):
    """Returns the squared distance of two segments: of the lines if closest inside, else from an end."""
    u, v, w = minus(b, a), minus(d, c), minus(c, a)
    uu, uv, vv, uw, vw = dot(u, u), dot(u, v), dot(v, v), dot(u, w), dot(v, w)
    gram = uu * vv - uv * uv
    distances = [point_segment(*three) for three in ((a, c, d), (b, c, d), (c, a, b), (d, a, b))]
    if not is_zero(gram):
        s, r = (vv * uw - uv * vw) / gram, (uv * uw - uu * vw) / gram
        if 0 <= s <= 1 and 0 <= r <= 1:
            gap = minus(along(w, r, v), along([0, 0, 0], s, u))
            distances.append(dot(gap, gap))
    return min(distances)


def interpolated(values):
    """Returns the coefficients, constant first, of the polynomial that has these values at 0, 1, 2, ..."""
    coefficients, basis = [Fraction(0)] * len(values), [Fraction(1)]
    differences = [Fraction(value) for value in values]
    for order in range(len(values)):
        for i, b in enumerate(basis):
            coefficients[i] += differences[0] * b
        # Newton's basis: t (t - 1) ... (t - order) / (order + 1)!
        basis = [(low - order * high) / (order + 1) for low, high in zip([0, *basis], [*basis, 0], strict=True)]
        differences = [b - a for a, b in itertools.pairwise(differences)]
    while coefficients and coefficients[-1] == 0:
        coefficients.pop()
    return coefficients


def real_roots(coefficients):
    """Returns the roots in [0, 1] of a polynomial that is not zero, multiple ones once or more often."""
    if len(coefficients) < 2:
        return []

    def value(t):
        result = Decimal(0)
        for a in reversed(coefficients):
            result = result * t + a
        return result

    stops = [Decimal(0), *real_roots([i * a for i, a in enumerate(coefficients)][1:]), Decimal(1)]
    roots = [t for t in stops if is_zero(value(t) ** 2)]
    for low, high in itertools.pairwise(stops):
        if value(low) * value(high) < 0 and low not in roots and high not in roots:
            below, above = (low, high) if value(high) > 0 else (high, low)
            while abs(above - below) > Decimal(10) ** (5 - DIGITS):
                middle = (below + above) / 2
                below, above = (below, middle) if value(middle) > 0 else (middle, above)
            roots.append(below)
    return sorted(roots)


def brute_force(kind, query):
    """Returns the earliest contact time of a query with small integers (over 8), as a Fraction, or None."""
    start, end = ([[Fraction(x) for x in point] for point in half] for half in (query[:4], query[4:]))

    def position(t):
        return [[(1 - t) * i + t * j for i, j in zip(a, b, strict=True)] for a, b in zip(start, end, strict=True)]

    def volume(a, b, c, d):
        return dot(minus(b, a), cross(minus(c, a), minus(d, a)))

    def squared_area(p, a, b):
        area = cross(minus(a, p), minus(b, p))
        return dot(area, area)

    def order(p, a, b):
        return dot(minus(a, p), minus(b, p))

    rows = ((0, 1, 2), (0, 2, 3), (0, 3, 1)) if kind == "vertex_face" else ((0, 2, 3), (1, 2, 3), (2, 0, 1), (3, 0, 1))
    functions = [(volume, 3, (0, 1, 2, 3)), *((f, d, row) for f, d in ((squared_area, 4), (order, 2)) for row in rows)]
    distance = point_triangle if kind == "vertex_face" else segment_segment
    with localcontext() as context:
        context.prec = DIGITS
        times = {Decimal(0), Decimal(1)}
        for function, degree, row in functions:
            values = [function(*(position(t)[i] for i in row)) for t in range(degree + 1)]
            times.update(real_roots([Decimal(a.numerator) / a.denominator for a in interpolated(values)]))
        start, end = (
            [[Decimal(x) for x in point] for point in half] for half in (query[:4].tolist(), query[4:].tolist())
        )
        return next((Fraction(t) for t in sorted(times) if is_zero(distance(*position(t)))), None)


def assert_brute_force_agrees(kind, points):
    """Compares answers and times with the brute force, and says how many collide."""
    toi = TOI[kind](points)
    assert np.array_equal(COLLIDES[kind](points), np.isfinite(toi[:, 0]))
    for query, (lower, upper) in zip(points, toi, strict=True):
        time = brute_force(kind, query)
        assert (time is None) == bool(np.isnan(lower)), query
        if time is not None:
            assert Fraction(lower) - TOLERANCE <= time <= Fraction(upper) + TOLERANCE, query
    return np.isfinite(toi[:, 0]).sum()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("size", [1, 2])
def test_brute_force_on_lattice(kind, size):
    points = np.random.default_rng(size).integers(-size, size + 1, (100, 8, 3)).astype(np.float64)
    assert 0 < assert_brute_force_agrees(kind, points) < len(points)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dimensions", [1, 2])
def test_brute_force_on_coplanar_lattice(kind, dimensions):
    points = np.random.default_rng(dimensions).integers(-2, 3, (100, 8, 3)).astype(np.float64)
    points[..., dimensions:] = 0.0
    assert 0 < assert_brute_force_agrees(kind, points) < len(points)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", ["collapsing", "touching", "resting_contact"])
def test_brute_force_on_degenerate_lattice(kind, name):
    points = GENERATORS[name](np.random.default_rng(3), 60, kind, np.float64)
    assert assert_brute_force_agrees(kind, points) > 0


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
@settings(max_examples=60, deadline=None)
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
        points = GENERATORS[name](np.random.default_rng(6), 30, kind, dtype)
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
@settings(max_examples=100, deadline=None)
def test_invariance_of_lattice_queries(kind, points, shift, exponent):
    moved = np.array(
        [points + np.array(shift), np.ldexp(points, exponent), np.ldexp(points + np.array(shift), exponent)]
    )
    answers = COLLIDES[kind](np.concatenate([relatives(kind, points), moved]))
    assert answers.all() == answers.any()


@pytest.mark.parametrize("kind", KINDS)
@given(data=st.data())
@settings(max_examples=20, deadline=None)
def test_invariance_of_any_floats(kind, data):
    largest = data.draw(st.sampled_from([1.0, 4.0, 1e30, 1.7e308]))
    points = data.draw(queries(st.floats(-largest, largest) | st.sampled_from([0.0, 1.0, 0.1, 1.0 - 2.0**-53])))
    answers = COLLIDES[kind](relatives(kind, points))
    assert answers.all() == answers.any()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", GENERATORS)
def test_invariance_of_adversarial_queries(kind, name):
    points = GENERATORS[name](np.random.default_rng(8), 20, kind, np.float32)
    answers = COLLIDES[kind](np.concatenate([relatives(kind, query) for query in points.astype(np.float64)]))
    assert np.array_equal(answers.reshape(len(points), -1).all(axis=1), answers.reshape(len(points), -1).any(axis=1))


@pytest.mark.parametrize("kind", KINDS)
def test_single_precision_is_widened(kind):
    points = GENERATORS["grazing"](np.random.default_rng(9), 100, kind, np.float32)
    assert np.array_equal(TOI[kind](points), TOI[kind](points.astype(np.float64)), equal_nan=True)


# --- Degenerate cases, each with its earliest time of contact (None: free) ---

FACE = [(0, 0, 0), (4, 0, 0), (0, 4, 0)]
SEGMENT_FACE = [(0, 0, 0), (4, 0, 0), (2, 0, 0)]
POINT_FACE = [(1, 1, 1)] * 3


def tangent_face(x, height=0.0):
    """Returns start and end of a query whose volume is 16 height - 16 (2t - 1)^2."""
    return tuple([(x, 1 + s, s + height), (0, 0, 0), (4, 0, 0), (0, 4, 4 * s)] for s in (-1, 1))


def tangent_edges(x, height=0.0):
    """Returns start and end of a query whose volume is 16 height - 16 (2t - 1)^2."""
    return tuple([(0, 0, 0), (4, 0, 0), (x, s - 1, height - s), (x, s + 3, height + 3 * s)] for s in (-1, 1))


VERTEX_FACE_CASES = {
    "all points equal": ([(1, 2, 3)] * 4, [(4, 5, 6)] * 4, 0),
    "all points equal at the end only": ([(0, 0, 1), *FACE], [(1, 1, 1)] * 4, 1),
    "resting inside, k0 = 0": ([(1, 1, 0), *FACE], [(1, 1, 0), *FACE], 0),
    "resting on a corner": ([(0, 0, 0), *FACE], [(0, 0, 0), *FACE], 0),
    "in the plane beside the face, at rest": ([(3, 3, 0), *FACE], [(3, 3, 0), *FACE], None),
    "lifting off": ([(1, 1, 0), *FACE], [(1, 1, 1), *FACE], 0),
    "landing at the end": ([(1, 1, 1), *FACE], [(1, 1, 0), *FACE], 1),
    "landing at the end on an edge": ([(2, 2, 1), *FACE], [(2, 2, 0), *FACE], 1),
    "landing at the end beside the face": ([(3, 3, 1), *FACE], [(3, 3, 0), *FACE], None),
    "passing through an edge": ([(2, 0, 1), *FACE], [(2, 0, -1), *FACE], 0.5),
    "passing through a corner": ([(4, 0, 1), *FACE], [(4, 0, -3), *FACE], 0.25),
    "passing beside a corner": ([(5, 0, 1), *FACE], [(5, 0, -1), *FACE], None),
    "parallel to the face, above it": ([(-9, 1, 1), *FACE], [(9, 1, 1), *FACE], None),
    "sliding in the plane into the face": ([(-1, 1, 0), *FACE], [(1, 1, 0), *FACE], 0.5),
    "sliding in the plane along an edge's line into a corner": ([(-4, 0, 0), *FACE], [(4, 0, 0), *FACE], 0.5),
    "sliding in the plane past the face": ([(5, -1, 0), *FACE], [(5, 9, 0), *FACE], None),
    "sliding in the plane through a corner": ([(3, -1, 0), *FACE], [(5, 1, 0), *FACE], 0.5),
    "sliding in the plane, there at the end only": ([(8, 0, 0), *FACE], [(4, 0, 0), *FACE], 1),
    "sliding in the plane out of the face": ([(1, 1, 0), *FACE], [(9, 1, 0), *FACE], 0),
    "double root inside the face": (*tangent_face(1), 0.5),
    "double root beside the face": (*tangent_face(5), None),
    "near miss of a double root": (*tangent_face(1, -(2.0**-50)), None),
    "two roots near a double root": (*tangent_face(1, 2.0**-50), 0.5 - 2.0**-26),
    "segment for a face, hit": ([(1, 0, 1), *SEGMENT_FACE], [(1, 0, -1), *SEGMENT_FACE], 0.5),
    "segment for a face, hit from within its plane": ([(1, 1, 0), *SEGMENT_FACE], [(1, -1, 0), *SEGMENT_FACE], 0.5),
    "segment for a face, missed on its line": ([(5, 1, 0), *SEGMENT_FACE], [(5, -1, 0), *SEGMENT_FACE], None),
    "segment for a face, along its line": ([(6, 0, 0), *SEGMENT_FACE], [(2, 0, 0), *SEGMENT_FACE], 0.5),
    "segment for a face, along its line without arriving": (
        [(6, 0, 0), *SEGMENT_FACE],
        [(5, 0, 0), *SEGMENT_FACE],
        None,
    ),
    "point for a face, hit": ([(0, 0, 0), *POINT_FACE], [(4, 4, 4), *POINT_FACE], 0.25),
    "point for a face, missed": ([(0, 0, 0), *POINT_FACE], [(4, 4, 5), *POINT_FACE], None),
    "point for a face, at rest upon it": ([(1, 1, 1), *POINT_FACE], [(1, 1, 1), *POINT_FACE], 0),
    "collapses to a point on the vertex": (
        [(0, 0, 0), (4, 0, 0), (0, 4, 0), (4, 4, 1)],
        [(0, 0, 0), (-4, 0, 0), (0, -4, 0), (-4, -4, -1)],
        0.5,
    ),
    "collapses to a segment away from the vertex": (
        [(9, 0, 1), (0, -1, 0), (4, 0, 0), (0, 1, 0)],
        [(9, 0, -1), (0, 1, 0), (4, 0, 0), (0, -1, 0)],
        None,
    ),
    "collapses to a segment on the vertex": (
        [(1, 0, 1), (0, -1, 0), (4, 0, 0), (0, 1, 0)],
        [(1, 0, -1), (0, 1, 0), (4, 0, 0), (0, -1, 0)],
        0.5,
    ),
    "always collinear, vertex overtakes": (
        [(0, 0, 0), (1, 0, 0), (2, 0, 0), (3, 0, 0)],
        [(4, 0, 0), (1, 0, 0), (2, 0, 0), (3, 0, 0)],
        0.25,
    ),
    "always collinear, carried along ahead": (
        [(0, 0, 0), (1, 0, 0), (2, 0, 0), (3, 0, 0)],
        [(4, 0, 0), (5, 0, 0), (6, 0, 0), (7, 0, 0)],
        None,
    ),
}

ALONG_X = [(0, 0, 0), (4, 0, 0)]
POINT_EDGE = [(1, 0, 0), (1, 0, 0)]

EDGE_EDGE_CASES = {
    "all points equal": ([(1, 2, 3)] * 4, [(4, 5, 6)] * 4, 0),
    "crossing at rest": ([*ALONG_X, (1, -1, 0), (1, 1, 0)], [*ALONG_X, (1, -1, 0), (1, 1, 0)], 0),
    "passing through": ([*ALONG_X, (1, -1, 1), (1, 1, 1)], [*ALONG_X, (1, -1, -1), (1, 1, -1)], 0.5),
    "passing beside": ([*ALONG_X, (5, -1, 1), (5, 1, 1)], [*ALONG_X, (5, -1, -1), (5, 1, -1)], None),
    "end touches an edge": ([*ALONG_X, (1, 0, 1), (1, 1, 1)], [*ALONG_X, (1, 0, -1), (1, 1, -1)], 0.5),
    "end touches an end": ([*ALONG_X, (4, 0, 1), (5, 1, 1)], [*ALONG_X, (4, 0, -1), (5, 1, -1)], 0.5),
    "landing at the end": ([*ALONG_X, (1, -1, 1), (1, 1, 1)], [*ALONG_X, (1, -1, 0), (1, 1, 0)], 1),
    "lifting off": ([*ALONG_X, (1, -1, 0), (1, 1, 0)], [*ALONG_X, (1, -1, 1), (1, 1, 1)], 0),
    "parallel, falling onto each other": ([*ALONG_X, (1, 0, 1), (2, 0, 1)], [*ALONG_X, (1, 0, -1), (2, 0, -1)], 0.5),
    "parallel, falling beside on one line": (
        [*ALONG_X, (5, 0, 1), (9, 0, 1)],
        [*ALONG_X, (5, 0, -1), (9, 0, -1)],
        None,
    ),
    "parallel, falling end to end": ([*ALONG_X, (4, 0, 1), (9, 0, 1)], [*ALONG_X, (4, 0, -1), (9, 0, -1)], 0.5),
    "parallel at rest": ([*ALONG_X, (0, 1, 0), (4, 1, 0)], [*ALONG_X, (0, 1, 0), (4, 1, 0)], None),
    "parallel when in one plane, side by side": (
        [(0, -1, 0), (4, 1, 0), (0, 1, 1), (4, 3, 1)],
        [(0, 1, 0), (4, -1, 0), (0, 3, -1), (4, 1, -1)],
        None,
    ),
    "collinear, overlapping at rest": ([*ALONG_X, (3, 0, 0), (9, 0, 0)], [*ALONG_X, (3, 0, 0), (9, 0, 0)], 0),
    "collinear, apart at rest": ([*ALONG_X, (5, 0, 0), (9, 0, 0)], [*ALONG_X, (5, 0, 0), (9, 0, 0)], None),
    "collinear, inside each other at rest": ([*ALONG_X, (1, 0, 0), (2, 0, 0)], [*ALONG_X, (1, 0, 0), (2, 0, 0)], 0),
    "collinear, running into each other": ([*ALONG_X, (6, 0, 0), (9, 0, 0)], [*ALONG_X, (2, 0, 0), (5, 0, 0)], 0.5),
    "collinear, touching at the end only": ([*ALONG_X, (6, 0, 0), (9, 0, 0)], [*ALONG_X, (4, 0, 0), (7, 0, 0)], 1),
    "collinear, swapping order as points": (
        [*POINT_EDGE, (0, 0, 0), (0, 0, 0)],
        [*POINT_EDGE, (2, 0, 0), (2, 0, 0)],
        0.5,
    ),
    "in one plane, sliding into each other": ([*ALONG_X, (1, 1, 0), (1, 2, 0)], [*ALONG_X, (1, -1, 0), (1, 0, 0)], 0.5),
    "in one plane, sliding past": ([*ALONG_X, (5, 1, 0), (5, 2, 0)], [*ALONG_X, (5, -2, 0), (5, -1, 0)], None),
    "zero-length edge, hit": ([*ALONG_X, (1, 1, 1), (1, 1, 1)], [*ALONG_X, (1, -1, -1), (1, -1, -1)], 0.5),
    "zero-length edge, missed": ([*ALONG_X, (1, 1, 1), (1, 1, 1)], [*ALONG_X, (1, -1, -2), (1, -1, -2)], None),
    "zero-length edge, on the line but beside": (
        [*ALONG_X, (5, 1, 1), (5, 1, 1)],
        [*ALONG_X, (5, -1, -1), (5, -1, -1)],
        None,
    ),
    "zero-length edges, meeting": ([*POINT_EDGE, (1, 0, 4), (1, 0, 4)], [*POINT_EDGE, (1, 0, 0), (1, 0, 0)], 1),
    "zero-length edges, apart": ([*POINT_EDGE, (1, 1, 4), (1, 1, 4)], [*POINT_EDGE, (1, 1, 0), (1, 1, 0)], None),
    "double root inside the edges": (*tangent_edges(1), 0.5),
    "double root beside the edges": (*tangent_edges(5), None),
    "near miss of a double root": (*tangent_edges(1, -(2.0**-50)), None),
    "two roots near a double root": (*tangent_edges(1, 2.0**-50), 0.5 - 2.0**-26),
    "an edge turns into a point on the other": (
        [(0, -1, 1), (2, 1, -1), *ALONG_X],
        [(2, 1, -1), (0, -1, 1), *ALONG_X],
        0,
    ),
    "an edge collapses to a point upon the other": (
        [(1, -1, 2), (1, 1, 2), *ALONG_X],
        [(1, 1, -2), (1, -1, -2), *ALONG_X],
        0.5,
    ),
    "an edge collapses to a point beside the other": (
        [(5, -1, 2), (5, 1, 2), *ALONG_X],
        [(5, 1, -2), (5, -1, -2), *ALONG_X],
        None,
    ),
}

CASES = [
    (kind, name)
    for kind, cases in (("vertex_face", VERTEX_FACE_CASES), ("edge_edge", EDGE_EDGE_CASES))
    for name in cases
]


@pytest.mark.parametrize(("kind", "name"), CASES)
def test_degenerate_case(kind, name):
    start, end, time = (VERTEX_FACE_CASES if kind == "vertex_face" else EDGE_EDGE_CASES)[name]
    points = np.array([[*start, *end]], dtype=np.float64)
    assert COLLIDES[kind](points).tolist() == [time is not None]
    expected = [np.nan, np.nan] if time is None else [time, time]
    assert np.array_equal(TOI[kind](points)[0], expected, equal_nan=True)


# --- Static crossings ---


def clipped(edge, face):
    """Says whether an edge meets a face that is no segment: clips it exactly by the face's and its edges' planes."""
    (p, q), (a, b, c) = ([[Fraction(x) for x in point] for point in points.tolist()] for points in (edge, face))
    normal = cross(minus(b, a), minus(c, a))
    low, high = Fraction(0), Fraction(1)
    sides = [(a, normal), (a, [-x for x in normal])]
    sides += [(start, cross(normal, minus(end, start))) for start, end in ((a, b), (b, c), (c, a))]
    for origin, inward in sides:
        at_p, slope = dot(minus(p, origin), inward), dot(minus(q, p), inward)
        if slope == 0 and at_p < 0:
            return False
        if slope > 0:
            low = max(low, -at_p / slope)
        if slope < 0:
            high = min(high, -at_p / slope)
    return low <= high


@pytest.mark.parametrize("dimensions", [2, 3])
def test_edge_face_crossings_against_clipping(dimensions):
    rng = np.random.default_rng(10)
    points = rng.integers(-2, 3, (600, 5, 3)).astype(np.float64)
    points[..., dimensions:] = 1.0
    edges, faces = points[:, :2], points[:, 2:]
    proper = np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0]).any(axis=1)
    edges, faces = edges[proper], faces[proper]
    truth = [clipped(edge, face) for edge, face in zip(edges, faces, strict=True)]
    assert 0 < sum(truth) < len(truth)
    assert checker.edge_face_crossings(edges, faces).tolist() == truth


@pytest.mark.parametrize(
    ("edge", "face", "truth"),
    [
        ([(1, 1, -1), (1, 1, 1)], FACE, True),
        ([(1, 1, 1), (1, 1, 2)], FACE, False),
        ([(1, 1, 1), (1, 1, 0)], FACE, True),
        ([(2, 2, -1), (2, 2, 1)], FACE, True),
        ([(-1, 1, 0), (9, 1, 0)], FACE, True),
        ([(1, 1, 0), (1, 2, 0)], FACE, True),
        ([(5, 0, 0), (0, 5, 0)], FACE, False),
        ([(1, 1, 0), (1, 1, 0)], FACE, True),
        ([(3, 3, 0), (3, 3, 0)], FACE, False),
        ([(1, 0, -1), (1, 0, 1)], SEGMENT_FACE, True),
        ([(5, 0, 0), (9, 0, 0)], SEGMENT_FACE, False),
        ([(4, 0, 0), (9, 0, 0)], SEGMENT_FACE, True),
        ([(0, 0, 0), (2, 2, 2)], POINT_FACE, True),
        ([(0, 0, 0), (2, 2, 3)], POINT_FACE, False),
        ([(1, 1, 1), (1, 1, 1)], POINT_FACE, True),
    ],
)
def test_edge_face_crossing(edge, face, truth):
    answer = checker.edge_face_crossings(np.array([edge], dtype=np.float32), np.array([face], dtype=np.float64))
    assert answer.tolist() == [truth]


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
