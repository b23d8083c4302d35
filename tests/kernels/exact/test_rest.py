"""Features that meet at rest, in single precision, against the exact checker."""

import itertools

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st
from sample_sizes import cases

from warp_bsc import checker
from warp_bsc.kernels.exact.rest import meet_at_rest
from warp_bsc.kernels.polynomials import EDGE_EDGE, VERTEX_FACE

KINDS = {"vertex_face": int(VERTEX_FACE), "edge_edge": int(EDGE_EDGE)}


@wp.kernel(enable_backward=False)
def decide(kind: int, points: wp.array2d[wp.vec3], meets: wp.array[wp.bool]):
    i = wp.tid()
    meets[i] = meet_at_rest(kind, points[i, 0], points[i, 1], points[i, 2], points[i, 3])


def check(points, device):
    """Asserts that the function and the checker say the same of queries at rest; returns how many meet."""
    points = np.asarray(points, dtype=np.float32)
    count = 0
    for label, kind in KINDS.items():
        meets = wp.zeros(len(points), dtype=bool, device=device)
        inputs = [kind, wp.array(points, dtype=wp.vec3, device=device)]
        wp.launch(decide, len(points), inputs=inputs, outputs=[meets], device=device)
        truth = getattr(checker, label)(np.concatenate([points, points], axis=1).astype(float))
        np.testing.assert_array_equal(meets.numpy(), truth)
        count += truth.sum()
    return count


def test_every_small_lattice(device):
    """Points of a small lattice are degenerate in every way."""
    rng = np.random.default_rng(3)
    corners = np.array(list(itertools.product(range(3), repeat=3)), dtype=np.float32)
    points = corners[rng.integers(0, 27, (6000, 4))]
    points[:3000, :, 2] = 0.0
    points[:1000, :, 1] = points[:1000, :, 0]
    assert check(points, device) > 1000


@pytest.mark.parametrize("size", [1e-45, 1e-30, 1e-17, 1.0, 1e18, 1e37])
def test_almost_degenerate(size, device):
    """A coordinate is off by one bit, or differs from the others by any power of two."""
    rng, count = np.random.default_rng(4), cases(3000)
    points = np.float32(size) * rng.integers(-2, 3, (count, 4, 3)).astype(np.float32)
    flat = rng.random(count) < 0.7
    points[flat, :, rng.integers(0, 3)] = 0.0
    rows, corner, axis = np.arange(count), rng.integers(0, 4, count), rng.integers(0, 3, count)
    moved = points[rows, corner, axis]
    moved = np.where(rng.random(count) < 0.5, np.nextafter(moved, np.float32(np.inf)), moved)
    tiny = np.float32(2.0) ** rng.integers(-149, -20, count)
    points[rows, corner, axis] = np.where(rng.random(count) < 0.3, tiny, moved)
    assert check(points, device) > cases(20)


@settings(max_examples=cases(50), deadline=None)
@given(st.lists(st.floats(width=32, allow_nan=False, allow_infinity=False), min_size=12, max_size=12))
def test_any_numbers(values):
    check(np.reshape(values, (1, 4, 3)), "cpu")
