"""Queries whose results stay on the device: what they find is what the host gets, and nothing bad is silent."""

import numpy as np
import pytest
import warp as wp
from generators import GENERATORS

import warp_bsc as bsc
from warp_bsc.detection.run.launch import cores

KINDS = ("vertex_face", "edge_edge")
METHODS = ("float", "conservative", "exact")
SOURCES = ("uniform", "mostly_hits", "touching", "grazing", "resting_contact", "coplanar", "integer_lattice")


def queries(kind, dtype, n=60, seed=1):
    rng = np.random.default_rng(seed)
    return np.concatenate([GENERATORS[name](rng, n, kind, dtype) for name in SOURCES])


def on(device, points):
    return wp.array(points, dtype=wp.vec3 if points.dtype == np.float32 else wp.vec3d, device=device)


def assert_as_on_host(kind, points, out, method):
    """Results on the device are those of the host, but for the queries that are counted as undecided: earlier hits."""
    expected = getattr(bsc, f"query_{kind}")(points, method=method, toi=out.toi is not None, device=out.device)
    different = out.hit.numpy() != expected.hit
    assert (out.hit.numpy() | ~expected.hit).all()
    if method != "float":
        np.testing.assert_array_equal(out.status.numpy(), expected.status)
    for name in ("toi", "coordinates", "normal"):
        values, others = getattr(out, name), getattr(expected, name)
        assert (values is None) == (others is None)
        if values is not None:
            same = (values.numpy() == others) | (np.isnan(values.numpy()) & np.isnan(others))
            different |= ~same.reshape(len(points), -1).all(axis=1)
    assert different.sum() <= out.undecided.numpy().item() < 0.02 * len(points)
    if out.toi is not None:
        assert (out.toi.numpy() <= expected.toi).all()


@pytest.mark.parametrize("toi", [True, False])
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("kind", KINDS)
def test_results_are_those_of_the_host(kind, method, toi, device):
    query = getattr(bsc, f"query_{kind}")
    for dtype in (np.float32, np.float64):
        points = queries(kind, dtype)
        out = bsc.DeviceQueryResult(len(points), toi=toi, device=device)
        assert query(on(device, points), method=method, toi=toi, out=out) is out
        assert 0.3 < out.hit.numpy().mean() < 0.95
        assert_as_on_host(kind, points, out, method)
        assert out.not_finite.numpy().item() == 0
        if dtype is np.float32:
            assert out.undecided.numpy().item() == 0  # nothing in single precision is too wide


def test_arrays_are_used_again_by_other_kinds_methods_and_types(device):
    out = bsc.DeviceQueryResult(60 * len(SOURCES), device=device)
    for seed, (kind, method, dtype) in enumerate(
        [("vertex_face", "exact", np.float64), ("edge_edge", "float", np.float32), ("vertex_face", "exact", np.float32)]
    ):
        points = queries(kind, dtype, seed=seed)
        scalars = wp.array(points, dtype=wp.float32 if dtype is np.float32 else wp.float64, device=device)
        getattr(bsc, f"query_{kind}")(scalars, method=method, out=out)
        assert_as_on_host(kind, points, out, method)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("kind", KINDS)
def test_a_graph_decides_what_the_array_then_holds(kind, method, device):
    """On the CPU too, where a graph runs the call at each replay."""
    query = getattr(bsc, f"query_{kind}")
    points = on(device, queries(kind, np.float32))
    out = bsc.DeviceQueryResult(len(points), device=device)
    query(points, method=method, out=out)
    with wp.ScopedCapture(device) as capture:
        query(points, method=method, out=out)
    for seed in (5, 6):
        replayed = queries(kind, np.float32, seed=seed)
        points.assign(replayed)
        wp.capture_launch(capture.graph)
        assert_as_on_host(kind, replayed, out, method)


@pytest.mark.gpu
def test_a_graph_needs_a_first_call(device):
    points = on(device, queries("vertex_face", np.float32))
    out = bsc.DeviceQueryResult(len(points), device=device)
    with wp.ScopedCapture(device), pytest.raises(RuntimeError, match="query once"):
        bsc.query_vertex_face(points, out=out)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("kind", KINDS)
def test_points_that_are_not_finite_are_counted_and_hits(kind, method, device):
    points = queries(kind, np.float64)
    n = len(points)
    bad = np.arange(0, n, 7)
    values = np.resize([np.nan, np.inf, -np.inf], len(bad))
    points[bad, np.resize(np.arange(8), len(bad)), np.resize(np.arange(3), len(bad))] = values
    out = bsc.DeviceQueryResult(n, device=device)
    getattr(bsc, f"query_{kind}")(on(device, points), method=method, out=out)
    assert out.not_finite.numpy().item() == len(bad)
    assert out.hit.numpy()[bad].all() and (out.status.numpy()[bad] == 2).all()
    assert (out.toi.numpy()[bad] == 0.0).all()
    assert np.isnan(out.coordinates.numpy()[bad]).all() and np.isnan(out.normal.numpy()[bad]).all()
    good = np.setdiff1d(np.arange(n), bad)
    expected = getattr(bsc, f"query_{kind}")(points[good], method=method, device=device)
    different = (out.hit.numpy()[good] != expected.hit) | (out.toi.numpy()[good] != expected.toi)
    assert different.sum() <= out.undecided.numpy().item() < 0.02 * n
    getattr(bsc, f"query_{kind}")(on(device, np.zeros_like(points)), method=method, out=out)
    assert out.not_finite.numpy().item() == 0


def test_what_is_too_wide_for_the_device_is_counted_and_a_hit(device):
    """Vertices that come to touch a triangle, or pass just beside it; some have exponents too far apart."""
    touching = GENERATORS["touching"](np.random.default_rng(3), 40, "vertex_face", np.float64)
    points = np.concatenate([touching, touching])
    points[40:, :, 0] *= 2.0**-500
    points[40:, [0, 4], 0] += 1.0
    points[40:, [1, 5], 0] += 1.0
    out = bsc.DeviceQueryResult(80, device=device)
    bsc.query_vertex_face(on(device, points), out=out)
    left = out.undecided.numpy().item()
    assert 0 < left < 40
    expected = bsc.query_vertex_face(points, device=device)
    np.testing.assert_array_equal(out.status.numpy(), expected.status)
    assert (out.hit.numpy() | ~expected.hit).all()
    different = (out.hit.numpy() != expected.hit) | (out.toi.numpy() != expected.toi)
    assert 0 < different.sum() <= left
    assert (out.toi.numpy() <= expected.toi).all()
    bsc.query_vertex_face(on(device, points), method="conservative", out=out)
    np.testing.assert_array_equal(out.hit.numpy(), out.status.numpy() != 0)


def test_no_queries_need_no_memory(device):
    out = bsc.DeviceQueryResult(0, device=device)
    assert bsc.query_edge_edge(wp.empty((0, 8), dtype=wp.vec3, device=device), out=out).hit.shape == (0,)


def test_calls_on_one_core_and_on_all_find_the_same(device):
    points = queries("edge_edge", np.float64, n=600)
    out = bsc.DeviceQueryResult(len(points), device=device)
    bsc.query_edge_edge(on(device, points), out=out)
    toi = out.toi.numpy().copy()
    with cores(1):
        bsc.query_edge_edge(on(device, points), out=out)
    np.testing.assert_array_equal(out.toi.numpy(), toi)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"points": np.zeros((3, 8, 3))}, TypeError, "points must be a Warp array"),
        ({"points": wp.zeros((3, 8, 3), dtype=int, device="cpu")}, TypeError, "float32 or float64"),
        (
            {"points": wp.zeros((4, 8), dtype=wp.vec3, device="cpu")},
            ValueError,
            r"shape \(3, 8, 3\), as out has 3 rows",
        ),
        ({"points": wp.zeros((3, 9), dtype=wp.vec3, device="cpu")[:, :8]}, ValueError, "contiguous"),
        ({"toi": False}, ValueError, "toi must be True"),
        ({"min_distance": 0.1}, ValueError, "min_distance must be 0"),
        ({"method": "fast"}, ValueError, "method"),
        ({"tolerance": 2.0}, ValueError, "tolerance"),
        ({"out": np.zeros(3)}, TypeError, "out must be a DeviceQueryResult"),
    ],
)
def test_bad_arguments_are_refused(change, error, message):
    arguments = {"points": wp.zeros((3, 8), dtype=wp.vec3, device="cpu"), "out": bsc.DeviceQueryResult(3, device="cpu")}
    with pytest.raises(error, match=message):
        bsc.query_vertex_face(**(arguments | change))


@pytest.mark.parametrize("count", [-1, 2**28, 1.5])
def test_bad_counts_are_refused(count):
    with pytest.raises((TypeError, ValueError), match="count"):
        bsc.DeviceQueryResult(count, device="cpu")
