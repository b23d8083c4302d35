"""Elementary queries with a minimum distance, by all methods, against the exact checker and closed forms."""

import distances
import numpy as np
import pytest
from flushing import subnormals_flushed

import warp_bsc as bsc
from warp_bsc import checker
from warp_bsc.detection.at_rest.proximities import ProximityFinder
from warp_bsc.detection.run.launch import cores

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


@pytest.mark.parametrize("kind", KINDS)
def test_the_least_distances_are_right_on_a_processor_that_flushes_subnormals(kind):
    """Lattices as small as the distances, and distances that are reached exactly, or missed by one in eight."""
    half = distances.POINTS[kind]
    points = np.random.default_rng(8).integers(-3, 4, (60, 2 * half, 3)).astype(np.float64)
    for exponent in (-1021, -1019, -1000):
        distance = np.ldexp(np.resize([1.0, 1.125, 2.0, 3.0], 60), exponent)
        rows = np.ldexp(points, exponent)
        truth = getattr(checker, kind)(points, np.ldexp(distance, -exponent))
        assert 0 < truth.sum() < 60
        assert np.array_equal(getattr(checker, kind)(rows, distance), truth)
        with subnormals_flushed(), cores(1):
            checked = getattr(checker, kind)(rows, distance)
            exact = QUERIES[kind](rows, min_distance=distance, device="cpu")
            conservative = QUERIES[kind](rows, min_distance=distance, method="conservative", device="cpu")
        assert np.array_equal(checked, truth)
        assert np.array_equal(exact.hit, truth)
        assert conservative.hit[truth].all()
        assert truth[conservative.status == 1].all() and not truth[conservative.status == 0].any()


def refused():
    """Calls that have a distance or a radius, by name."""
    points, mesh = np.zeros((3, 8, 3)), bsc.CollisionMesh([[0, 1, 2]], 3, device="cpu")
    return {
        "query": lambda d: bsc.query_vertex_face(points, min_distance=d, device="cpu"),
        "queries": lambda d: bsc.query_edge_edge(points, min_distance=[0.0, 1.0, d], device="cpu"),
        "checker": lambda d: checker.edge_edge(points, d),
        "mesh": lambda d: bsc.CollisionMesh([[0, 1, 2]], 3, radius=d, device="cpu"),
        "radii": lambda d: bsc.CollisionMesh([[0, 1, 2]], 3, radius=[0.0, d, 1.0], device="cpu"),
        "detector": lambda d: bsc.CollisionDetector(mesh, min_distance=d),
        "proximities": lambda d: ProximityFinder(mesh, d),
    }


@pytest.mark.parametrize("name", refused())
@pytest.mark.parametrize("flushed", [False, True])
def test_smaller_distances_are_refused(name, flushed):
    """Also where the processor takes them for 0, which is allowed."""
    call = refused()[name]
    for distance in (2.0**-1074, 2.0**-1060, 2.0**-1040, 2.0**-1022, np.nextafter(2.0**-1021, 0.0)):
        with pytest.raises(ValueError, match=r"(min_distance|distance|radius).* at least 2\^-1021"):
            if flushed:
                with subnormals_flushed(), cores(1):
                    call(distance)
            else:
                call(distance)
    call(2.0**-1021)


@pytest.mark.parametrize("flushed", [False, True])
def test_distances_in_single_precision_may_be_subnormal_there(flushed):
    """As doubles they are normal."""
    given = np.array([0.0, 1e-45, 1e-38, 2.0], dtype=np.float32)
    expected = given.astype(np.float64)
    if flushed:
        with subnormals_flushed(), cores(1):
            radius = bsc.CollisionMesh([], 4, radius=given, device="cpu").radius
    else:
        radius = bsc.CollisionMesh([], 4, radius=given, device="cpu").radius
    assert radius.tobytes() == expected.tobytes()
