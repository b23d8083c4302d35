"""Answers stay true where another library has told the processor to take subnormal numbers for zero."""

import numpy as np
import pytest
import warp as wp
from exact_queries import decide_exactly
from flushing import subnormals_flushed
from generators import GENERATORS
from impacts import impact_kernel
from outputs import filled_with_nan

import warp_bsc as bsc
from warp_bsc import checker
from warp_bsc.detection.run.launch import cores
from warp_bsc.kernels import FREE, HIT, UNSURE, roots
from warp_bsc.kernels.exact.polygon import BITS

KINDS = ("vertex_face", "edge_edge")
DTYPES = (np.float32, np.float64)
SOURCES = ("uniform", "mostly_hits", "integer_lattice", "one_ulp_apart", "resting_contact", "grazing", "touching")


def around_underflow(rng, n, kind, dtype):
    """Returns queries along whose axes all is about as small as the smallest normal number, but for some axes."""
    points = np.stack([GENERATORS[name](rng, n, kind, np.float64) for name in SOURCES])
    points = points[rng.integers(0, len(SOURCES), n), np.arange(n)]
    info = np.finfo(dtype)
    exponents = rng.integers(info.minexp - info.nmant, info.minexp + 6, (n, 1, 3))
    others = rng.choice([0, 20, info.minexp // 2], exponents.shape)
    return np.ldexp(points, np.where(rng.random(exponents.shape) < 0.4, others, exponents)).astype(dtype)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("kind", KINDS)
def test_answers_are_true(kind, dtype):
    rng = np.random.default_rng(1)
    points = around_underflow(rng, 500, kind, dtype)
    points = np.concatenate([points, GENERATORS["subnormal_and_huge"](rng, 20, kind, dtype)])
    n = len(points)
    interval = getattr(checker, f"{kind}_toi")(points)
    truth = ~np.isnan(interval[:, 0])
    latest = interval[:, 1] + 2.0**-1022
    status, _, _, toi, *_ = outputs = [
        *(wp.zeros(n, dtype=int, device="cpu") for _ in range(3)),
        *(filled_with_nan(n, t, "cpu") for t in (wp.float64, wp.vec3d, wp.vec3d)),
    ]
    point = wp.vec3 if dtype is np.float32 else wp.vec3d
    inputs = [kind == "edge_edge", 2.0**-20, wp.array(points, dtype=point, device="cpu")]
    query = getattr(bsc, f"query_{kind}")
    with subnormals_flushed(), cores(1):
        conservative, exact = (query(points, method=method, device="cpu") for method in ("conservative", "exact"))
        wp.launch(impact_kernel(point), n, inputs=inputs, outputs=outputs, device="cpu")
        checked = getattr(checker, kind)(points)
        times = [decide_exactly(kind, points, limbs, device="cpu")[0] for limbs in BITS if dtype is np.float64]
    assert np.array_equal(checked, truth)
    assert np.array_equal(exact.hit, truth)
    for certain in (conservative.status, status.numpy()):
        assert not truth[certain == FREE].any()
        assert truth[certain == HIT].all()
        assert (certain == UNSURE).mean() < 0.9
    for time in (conservative.toi, exact.toi, toi.numpy()):
        assert (time[truth] <= latest[truth]).all()
    for time in times:
        assert np.array_equal(time[time >= 0.0] < 2.0, truth[time >= 0.0])


@pytest.mark.parametrize("dtype", DTYPES)
def test_intersections_are_true(dtype):
    """Pairs of triangles, each far from the others along the first axis, which is large."""
    n = 300
    x = around_underflow(np.random.default_rng(2), n, "vertex_face", dtype)[:, :6]
    x[..., 0] = (2.0 * np.arange(n)[:, None] + np.sign(x[..., 0]) / 2.0).astype(dtype)
    x = x.reshape(-1, 3)
    mesh = bsc.CollisionMesh(np.arange(6 * n).reshape(-1, 3), 6 * n, device="cpu")
    edges = np.arange(len(mesh.edges))
    faces = mesh.edges[:, 0] // 3 ^ 1  # the other one of the pair
    truth = checker.edge_face_crossings(x[mesh.edges], x[mesh.faces[faces]])
    assert 50 < truth.sum() < len(edges) - 50
    with subnormals_flushed(), cores(1):
        found = bsc.CollisionDetector(mesh).find_intersections(x)
    assert np.array_equal(found, np.stack([edges, faces], axis=1)[truth])


@wp.kernel(enable_backward=False)
def find_classes(k: wp.array[wp.vec4d], bound: wp.float64, shape: wp.array[int]):
    i = wp.tid()
    shape[i] = roots.curve_class(k[i], bound)


def test_a_discriminant_of_flushed_products_is_not_certain():
    """Y' = d (1, -1 +- c, 1) has roots or none within the bound: its squares are about the smallest normal number."""
    c = np.random.default_rng(3).uniform(-1e-3, 1e-3, 2000)
    slopes = 2.0**-511 * np.stack([np.ones(len(c)), c - 1.0, np.ones(len(c))], axis=1)
    k = np.concatenate([np.full((len(c), 1), 2.0**-511), 2.0**-511 + np.cumsum(slopes, axis=1)], axis=1)
    bound = 2.0**-53 * 1e-140
    assert (2.0 * bound / 2.0**-511 > np.abs(c)).all()
    shape = wp.zeros(len(c), dtype=int, device="cpu")
    x = wp.array(k, dtype=wp.vec4d, device="cpu")
    with subnormals_flushed():
        wp.launch(find_classes, len(c), inputs=[x, bound], outputs=[shape], device="cpu")
    assert (shape.numpy() != roots.MONOTONE).all()
