"""Elementary queries with a minimum distance, by all methods, against the exact checker and closed forms."""

import distances
import numpy as np
import pytest

import warp_bsc as bsc
from warp_bsc import checker

KINDS = distances.KINDS
QUERIES = {kind: getattr(bsc, f"query_{kind}") for kind in KINDS}


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("kind", KINDS)
def test_methods(kind, dtype):
    points, distance = distances.adversarial(np.random.default_rng(5), 80, kind, dtype)
    interval = getattr(checker, f"{kind}_toi")(points, distance)
    truth = ~np.isnan(interval[:, 0])
    exact = QUERIES[kind](points, min_distance=distance)
    conservative = QUERIES[kind](points, min_distance=distance, method="conservative")
    computed = QUERIES[kind](points, min_distance=distance, method="float")
    assert np.array_equal(exact.hit, truth)
    assert np.array_equal(QUERIES[kind](points, min_distance=distance, toi=False).hit, truth)
    assert np.array_equal(conservative.hit, conservative.status != 0)
    assert np.array_equal(conservative.status, computed.status)
    assert (computed.hit != truth).mean() < 0.05
    for answer in (exact, conservative):
        assert (answer.toi[truth] <= interval[truth, 1]).all()
        certain = truth & ((answer.status == 1) | (answer is exact))
        assert (answer.toi[certain] >= interval[certain, 0] - 2.0**-20).all()
        assert (answer.toi[~answer.hit] == 2.0).all()
        np.testing.assert_allclose(np.linalg.norm(answer.normal[answer.hit], axis=1), 1.0)
        assert np.isnan(answer.normal[~answer.hit]).all()


@pytest.mark.parametrize("kind", KINDS)
def test_coordinates_and_normal_are_those_of_the_closest_points(kind):
    """At the time of impact the points with these coordinates are the distance apart, along the normal."""
    rng = np.random.default_rng(6)
    half = distances.POINTS[kind]
    points = rng.uniform(-1.0, 1.0, (300, 2 * half, 3))
    answer = QUERIES[kind](points, min_distance=0.2)
    inside = answer.hit & (answer.toi > 0.0)
    assert inside.sum() > 5
    time = answer.toi[inside, None, None]
    x = np.moveaxis((1.0 - time) * points[inside, :half] + time * points[inside, half:], 1, 0)
    a, b, c = answer.coordinates[inside].T[..., None]
    first, second = {
        "vertex_face": lambda: (x[0], a * x[1] + b * x[2] + c * x[3]),
        "edge_edge": lambda: ((1.0 - a) * x[0] + a * x[1], (1.0 - b) * x[2] + b * x[3]),
        "vertex_edge": lambda: (x[0], (1.0 - a) * x[1] + a * x[2]),
        "vertex_vertex": lambda: (x[0], x[1]),
    }[kind]()
    np.testing.assert_allclose(first - second, 0.2 * answer.normal[inside], atol=1e-5)


def test_distance_of_zero_is_contact():
    points = np.random.default_rng(7).uniform(-1.0, 1.0, (300, 8, 3))
    for query in (bsc.query_vertex_face, bsc.query_edge_edge):
        without, zero = query(points), query(points, min_distance=np.zeros(300))
        for name in ("hit", "status", "toi", "coordinates", "normal"):
            assert np.array_equal(getattr(without, name), getattr(zero, name), equal_nan=True)


def test_a_distance_for_each_query():
    points = np.array([[[0, 0, 2], [0, 0, 0], [0, 0, 2], [0, 0, 1]]] * 3, dtype=np.float32)
    answer = bsc.query_vertex_vertex(points, min_distance=[0.5, 1.5, 2.0])
    assert answer.hit.tolist() == [False, True, True]
    assert answer.toi.tolist() == pytest.approx([2.0, 0.5, 0.0], abs=2.0**-20)


def test_bad_distances_are_refused():
    points = np.zeros((3, 8, 3))
    for distance in (-1.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="min_distance must be finite and at least 0"):
            bsc.query_vertex_face(points, min_distance=distance)
    with pytest.raises(ValueError, match=r"one number or have shape \(3,\), not \(2,\)"):
        bsc.query_edge_edge(points, min_distance=[1.0, 1.0])
    with pytest.raises(ValueError, match=r"shape \(n, 6, 3\)"):
        bsc.query_vertex_edge(points, min_distance=1.0)
