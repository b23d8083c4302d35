"""Elementary queries: benchmark data with known truth, contracts of the result, bad input."""

import numpy as np
import pytest
import warp as wp
from benchmark_data import load_cloth_funnel_queries, load_queries
from certify_contacts import KINDS, judge
from generators import GENERATORS
from sample_sizes import cases

import warp_bsc as bsc
from warp_bsc import checker

CROSSING = np.array(
    [
        [0.25, 0.25, 1.0],
        [0.0, 0.0, 0.0],
        [1.0, 0.0, 0.0],
        [0.0, 1.0, 0.0],
        [0.25, 0.25, -3.0],
        [0.0, 0.0, 0.0],
        [1.0, 0.0, 0.0],
        [0.0, 1.0, 0.0],
    ]
)[None]


def query(kind, points, **options):
    return getattr(bsc, f"query_{kind}")(points, **options)


@pytest.fixture(scope="module")
def benchmark_queries():
    """Points and truth of all benchmark queries, by kind."""
    sets = [*load_queries(), *load_cloth_funnel_queries()]
    return {
        kind: (
            np.concatenate([points for _, k, points, _ in sets if k == kind]),
            np.concatenate([truth for _, k, _, truth in sets if k == kind]),
        )
        for kind in KINDS
    }


@pytest.mark.parametrize("kind", KINDS)
def test_normals_of_motion_in_one_plane_are_those_of_the_plane(kind, device):
    """The documented limit: perpendicular to the velocity; opposite to it only where the elements have no plane."""
    points = np.random.default_rng(3).normal(size=(200, 8, 3))
    points[..., 2] = 0.5
    result = query(kind, points, device=device)
    assert result.hit.sum() > 20
    np.testing.assert_allclose(np.abs(result.normal[result.hit]), [[0.0, 0.0, 1.0]] * result.hit.sum(), atol=1e-12)
    # edges along x, or a face that is one; the first element moves down, then nothing moves
    first = [[0.5, 0, 1], [1.5, 0, 1]] if kind == "edge_edge" else [[0.5, 0, 1]]
    start = np.array([*first, *[[0, 0, 0], [2, 0, 0], [1, 0, 0]][: 4 - len(first)]], float)
    end = np.where(np.arange(4)[:, None] < len(first), start - [0, 0, 2], start)
    rows = np.array([[start, end], [start * [1, 1, 0], start * [1, 1, 0]]]).reshape(2, 8, 3)
    result = query(kind, rows, device=device)
    assert result.hit.all()
    np.testing.assert_allclose(result.normal, [[0.0, 0.0, 1.0]] * 2, atol=1e-12)


@pytest.mark.data
@pytest.mark.parametrize("kind", KINDS)
def test_exact_is_right_on_the_benchmark(benchmark_queries, kind):
    points, truth = benchmark_queries[kind]
    assert np.array_equal(query(kind, points, method="exact").hit, truth)


@pytest.mark.data
@pytest.mark.parametrize("kind", KINDS)
def test_benchmark_certificates_and_times_are_right(benchmark_queries, kind):
    points, truth = benchmark_queries[kind]
    verdict = judge(kind, points)
    assert verdict.colliding == truth.sum()
    assert (verdict.wrong, verdict.missed, verdict.exact_wrong, verdict.late, verdict.early) == (0, 0, 0, 0, 0)


@pytest.mark.data
def test_conservative_and_float_err_no_more_than_promised():
    false_positives = false_negatives = computed_wrong = 0
    for _, kind, points, truth in load_queries():
        hit = query(kind, points, method="conservative", toi=False).hit
        false_positives += (hit & ~truth).sum()
        false_negatives += (~hit & truth).sum()
        computed_wrong += (query(kind, points, method="float", toi=False).hit != truth).sum()
    assert false_negatives == 0
    assert false_positives <= 100
    assert computed_wrong <= 20


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", GENERATORS)
def test_certified_answers_never_contradict_the_truth(name, kind, dtype):
    count = cases(20 if name == "subnormal_and_huge" else 250)
    verdict = judge(kind, GENERATORS[name](np.random.default_rng([7, *name.encode()]), count, kind, dtype))
    assert (verdict.wrong, verdict.missed, verdict.exact_wrong, verdict.late, verdict.early) == (0, 0, 0, 0, 0)
    if name in ("uniform", "mostly_hits"):
        assert verdict.unsure == 0


@pytest.mark.parametrize("method", ["float", "conservative", "exact"])
def test_first_contact_is_described(method):
    result = bsc.query_vertex_face(CROSSING, method=method)
    assert result.hit.tolist() == [True]
    assert result.status.dtype == np.int8 and result.status.tolist() == [1]
    assert 0.25 - 2.0**-20 <= result.toi[0] <= 0.25
    np.testing.assert_allclose(result.coordinates, [[0.5, 0.25, 0.25]], atol=1e-12)
    np.testing.assert_allclose(result.normal, [[0.0, 0.0, 1.0]], atol=1e-12)


def test_no_contact_is_marked():
    apart = CROSSING + np.where(np.arange(8) % 4 == 0, 0.0, 5.0)[:, None]
    result = bsc.query_vertex_face(apart)
    assert result.hit.tolist() == [False]
    assert result.toi.tolist() == [2.0]
    assert np.isnan(result.coordinates).all() and np.isnan(result.normal).all()
    assert bsc.query_vertex_face(apart, toi=False).toi is None


@pytest.mark.parametrize("tolerance", [0.5, 2.0**-10, 2.0**-30])
@pytest.mark.parametrize("kind", KINDS)
def test_times_are_lower_bounds_within_the_tolerance_asked_for(kind, tolerance):
    points = GENERATORS["mostly_hits"](np.random.default_rng(3), 200, kind, np.float64)
    interval = getattr(checker, f"{kind}_toi")(points)
    toi = query(kind, points, tolerance=tolerance).toi
    assert (toi <= interval[:, 1]).all()
    assert (toi >= interval[:, 0] - tolerance).all()


def test_touching_is_contact_that_floating_point_leaves_open():
    touching = CROSSING.copy()
    touching[0, 4, 2] = 0.0
    assert bsc.query_vertex_face(touching, method="conservative").status.tolist() == [2]
    for method in ("float", "conservative", "exact"):
        assert bsc.query_vertex_face(touching, method=method).hit.tolist() == [True]
    assert bsc.query_vertex_face(touching, method="exact").toi.tolist() == [1.0]


@pytest.mark.parametrize("kind", KINDS)
def test_float_decides_zeros_without_subdivision(kind):
    """Contact at rest, where the cubic starts at zero or is zero, and features apart in one plane or on one line."""
    query = getattr(bsc, f"query_{kind}")
    points = GENERATORS["resting_contact"](np.random.default_rng(9), 400, kind, np.float32)
    truth = getattr(checker, kind)(points)
    assert 100 < truth.sum() < 350
    found = query(points, method="float")
    assert (found.hit != truth).sum() <= 4
    assert np.array_equal(found.hit, query(points, method="float", toi=False).hit)
    on_a_line = np.zeros((8, 3))
    on_a_line[:, 0] = [5, 0, 1, 2, 5, 0, 1, 2] if kind == "vertex_face" else [0, 1, 3, 5, 0, 1, 3, 5]
    assert not query(on_a_line[None], method="float").hit.any()


def test_float_points_are_taken_as_the_doubles_they_are():
    points = GENERATORS["uniform"](np.random.default_rng(5), 500, "edge_edge", np.float32)
    single = bsc.query_edge_edge(points)
    double = bsc.query_edge_edge(points.astype(np.float64))
    for field in ("hit", "status", "toi", "coordinates", "normal"):
        np.testing.assert_array_equal(getattr(single, field), getattr(double, field))


def test_warp_arrays_are_accepted(device):
    points = CROSSING.astype(np.float32)
    expected = bsc.query_vertex_face(points).toi
    for array in (wp.array(points, dtype=wp.float32, device="cpu"), wp.array(points, dtype=wp.vec3, device="cpu")):
        np.testing.assert_array_equal(bsc.query_vertex_face(array, device=device).toi, expected)


def test_no_queries_give_no_answers():
    result = bsc.query_edge_edge(np.zeros((0, 8, 3)))
    assert result.hit.shape == (0,) and result.normal.shape == (0, 3)


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.zeros((3, 8, 3), dtype=int), "float32 or float64"),
        (np.zeros((3, 8, 2)), r"shape \(n, 8, 3\)"),
        (np.zeros((8, 3)), r"shape \(n, 8, 3\)"),
        (np.broadcast_to(0.0, (2**29, 8, 3)), r"points must have at most 2\^29 - 1 rows"),
        (np.where(np.arange(72).reshape(3, 8, 3) == 30, np.nan, 0.0), r"points\[1\]"),
        (np.where(np.arange(72).reshape(3, 8, 3) == 70, np.inf, 0.0), r"points\[2\]"),
    ],
)
def test_bad_points_are_refused(points, message):
    with pytest.raises(ValueError, match=message):
        bsc.query_vertex_face(points)


def test_bad_options_are_refused():
    with pytest.raises(ValueError, match="float, conservative, exact"):
        bsc.query_edge_edge(CROSSING, method="fast")
    with pytest.raises(ValueError, match="tolerance"):
        bsc.query_edge_edge(CROSSING, tolerance=0.0)
