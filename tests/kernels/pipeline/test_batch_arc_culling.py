"""Culls of eight pairs on arcs at once: what they cull keeps its distance, by exact arithmetic, and that is most."""

import numpy as np
import pytest
import warp as wp
from generators import GENERATORS

import warp_bsc as bsc
from warp_bsc import checker
from warp_bsc.kernels.bits import lowest_bit
from warp_bsc.kernels.pipeline.batch_arc_culling import cull_arc_batch_of
from warp_bsc.kernels.pipeline.batch_culling import BATCH

KINDS = ("vertex_face", "edge_edge")
_KERNEL = {"enable_backward": False, "module": "unique", "module_options": {"fuse_fp": False}}


def cull(kind, points, deviation):
    """Which queries the cull leaves, bool; deviation: of each vertex, shape [n, 4]."""
    dtype = wp.vec3 if points.dtype == np.float32 else wp.vec3d
    cull_arc_batch = cull_arc_batch_of(dtype, kind == "vertex_face")

    @wp.kernel(**_KERNEL)
    def cull_batches(
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        elements: wp.array2d[int],
        pairs: wp.array[wp.vec2i],
        deviation: wp.array[wp.float64],
        left: wp.array[int],
    ):
        i = BATCH * wp.tid()
        bits = cull_arc_batch(x0, x1, elements, pairs, deviation, i, wp.min(BATCH, pairs.shape[0] - i))
        while bits != wp.uint64(0):
            left[i + lowest_bit(bits)] = 1
            bits = bits & (bits - wp.uint64(1))

    n = len(points)
    corners = np.arange(4 * n).reshape(n, 4)
    if kind == "vertex_face":
        elements, pairs = corners[:, 1:], np.stack([corners[:, 0], np.arange(n)], axis=1)
    else:
        elements, pairs = corners.reshape(-1, 2), np.arange(2 * n).reshape(n, 2)
    left = wp.zeros(n, dtype=int, device="cpu")
    inputs = [
        *(
            wp.array(np.ascontiguousarray(x).reshape(-1, 3), dtype=dtype, device="cpu")
            for x in (points[:, :4], points[:, 4:])
        ),
        wp.array(np.ascontiguousarray(elements), dtype=int, device="cpu"),
        wp.array(pairs, dtype=wp.vec2i, device="cpu"),
        wp.array(deviation.ravel(), dtype=wp.float64, device="cpu"),
    ]
    wp.launch(cull_batches, -(-n // int(BATCH)), inputs=inputs, outputs=[left], device="cpu")
    return left.numpy() == 1


def near_misses(random, points, kind):
    """Deviations of few bits, so that sums are exact, from none to more than the distances of queries."""
    firsts = 1 if kind == "vertex_face" else 2
    size = np.abs(points.astype(np.float64)).max(axis=(1, 2))
    share = 2.0 ** random.integers(-40, 0, len(points)) * (random.random(len(points)) < 0.9)
    scale = 2.0 ** np.floor(np.log2(np.maximum(size, 1e-300))) * share
    deviation = scale[:, None] * random.integers(0, 16, (len(points), 4)) / 16.0
    distance = deviation[:, :firsts].max(axis=1) + deviation[:, firsts:].max(axis=1)
    return deviation, distance


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("kind", KINDS)
def test_what_is_culled_keeps_its_distance(kind, dtype):
    random = np.random.default_rng(8)
    names = [name for name in GENERATORS if name != "subnormal_and_huge"]  # out of the range of distances
    points = np.concatenate([GENERATORS[name](random, 41, kind, dtype) for name in names])
    deviation, distance = near_misses(random, points, kind)
    left = cull(kind, points, deviation)
    culled = np.flatnonzero(~left)
    assert not getattr(checker, kind)(points[culled], distance[culled]).any()
    free = np.array(
        [
            not getattr(bsc, f"query_{kind}")(points[i : i + 1], min_distance=distance[i]).hit[0]
            for i in range(0, len(points), 5)
        ]
    )
    assert (~left[::5])[free].mean() > 0.8


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("kind", KINDS)
def test_subnormal_and_huge_queries_are_culled_only_if_free(kind, dtype):
    points = GENERATORS["subnormal_and_huge"](np.random.default_rng(9), 200, kind, dtype)
    left = cull(kind, points, np.zeros((len(points), 4)))
    assert not getattr(checker, kind)(points[~left]).any()


@pytest.mark.parametrize("kind", KINDS)
def test_a_pair_is_left_where_it_comes_exactly_as_near_as_it_may(kind):
    """A vertex or an edge that moves across a plane at the distance of the deviations, whichever vertices have them."""
    base = np.array([[-1.0, -1.0, 0.0], [2.0, -1.0, 0.0], [-1.0, 2.0, 0.0]])
    firsts = 1 if kind == "vertex_face" else 2
    if kind == "vertex_face":
        start = np.array([[0.0, 0.0, 0.25], *base])
    else:
        start = np.array([[-1.0, 0.0, 0.25], [1.0, 0.0, 0.25], [0.0, -1.0, 0.0], [0.0, 1.0, 0.0]])
    end = start.copy()
    end[:firsts, :2] += 0.125
    deviation = []
    for first in range(firsts):
        for second in range(firsts, 4):
            row = np.zeros(4)
            row[[first, second]] = 0.125
            deviation += [row, row * (1.0 - 2.0**-30), row * (1.0 + 2.0**-30)]
    points = np.stack([np.concatenate([start, end])] * len(deviation))
    assert cull(kind, points, np.array(deviation)).tolist() == [True, False, True] * (len(deviation) // 3)
