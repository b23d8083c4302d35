"""Culls of eight pairs at once: what they leave is what the scalar culls leave, and what they cull is free."""

import numpy as np
import pytest
import warp as wp
from generators import GENERATORS

from warp_bsc import checker
from warp_bsc.bench.measure.methods import Queries, QuerySet
from warp_bsc.detection.run.settings import PairKind
from warp_bsc.kernels.bits import lowest_bit
from warp_bsc.kernels.culling import (
    centroid_direction,
    direction_separates,
    edge_edge_boxes_apart,
    vertex_face_boxes_apart,
)
from warp_bsc.kernels.motion import edge_edge_motion, vertex_face_motion
from warp_bsc.kernels.pipeline.batch_culling import BATCH, cull_batch_of
from warp_bsc.kernels.polynomials import coplanarity
from warp_bsc.kernels.signs import ROUNDOFF, certified_sign_cubic

KINDS = ("vertex_face", "edge_edge")
_KERNEL = {"enable_backward": False, "module": "unique", "module_options": {"fuse_fp": False}}


def kernels_of(kind, dtype):
    """Kernels that write 1 for what the culls leave: one query a thread, and eight."""
    vertex_face = kind == "vertex_face"
    motion_of = vertex_face_motion if vertex_face else edge_edge_motion
    boxes_apart = vertex_face_boxes_apart if vertex_face else edge_edge_boxes_apart
    cull_batch = cull_batch_of(dtype, vertex_face)

    @wp.kernel(**_KERNEL)
    def cull(x0: wp.array[dtype], x1: wp.array[dtype], roundoff: wp.float64, left: wp.array[int]):
        i = wp.tid()
        j = 4 * i
        if boxes_apart(x0[j], x0[j + 1], x0[j + 2], x0[j + 3], x1[j], x1[j + 1], x1[j + 2], x1[j + 3]):
            return
        motion = motion_of(x0[j], x0[j + 1], x0[j + 2], x0[j + 3], x1[j], x1[j + 1], x1[j + 2], x1[j + 3], roundoff)
        y = coplanarity(motion)
        if certified_sign_cubic(y.k, y.bound) == 0 and not direction_separates(motion, centroid_direction(motion)):
            left[i] = 1

    @wp.kernel(**_KERNEL)
    def cull_batches(
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        elements: wp.array2d[int],
        pairs: wp.array[wp.vec2i],
        boxes_meet: bool,
        roundoff: wp.float64,
        left: wp.array[int],
    ):
        i = BATCH * wp.tid()
        bits = cull_batch(x0, x1, elements, pairs, i, wp.min(BATCH, pairs.shape[0] - i), boxes_meet, roundoff)
        while bits != wp.uint64(0):
            left[i + lowest_bit(bits)] = 1
            bits = bits & (bits - wp.uint64(1))

    return cull, cull_batches


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("kind", KINDS)
def test_culls_are_those_of_one_query(kind, dtype):
    """Bit by bit, but for numbers so small that scaling them matters."""
    rng = np.random.default_rng(6)
    number = 203  # no multiple of eight
    points = {name: generator(rng, number, kind, dtype) for name, generator in GENERATORS.items()}
    scaled = np.concatenate([points[name] for name in points if name not in ("subnormal_and_huge", "almost_coplanar")])
    extreme = np.concatenate([points["subnormal_and_huge"], points["almost_coplanar"]])
    for roundoff in (0.0, float(ROUNDOFF)):
        alone, together = cull(kind, scaled, roundoff)
        assert np.array_equal(alone, together)
        assert 0.2 < together.mean() < 0.95
        _, without_boxes = cull(kind, scaled, roundoff, boxes_meet=True)
        meet = boxes_meet(kind, scaled)
        assert (without_boxes & ~meet).any()  # what only boxes cull
        assert np.array_equal(without_boxes & meet, together)
    for points in (scaled, extreme):
        _, left = cull(kind, points, float(ROUNDOFF))
        culled = np.flatnonzero(~left)[:: 1 if points is scaled else 4]
        assert len(culled) > 10
        assert not getattr(checker, kind)(points[culled]).any()


@pytest.mark.parametrize("kind", KINDS)
def test_single_precision_decides_as_double_precision(kind):
    """What boxes leave is decided in single precision first where they are known to meet, else in double precision."""
    rng = np.random.default_rng(8)
    names = ("uniform", "mostly_hits", "integer_lattice", "one_ulp_apart", "resting_contact", "grazing", "touching")
    points = np.concatenate([GENERATORS[name](rng, 500, kind, np.float32) for name in names])
    for exponent in (-145, -60, -48, -45, -42, -36, -32, 0, 36, 40, 44, 100):
        scaled = np.ldexp(points, exponent + rng.integers(-2, 3, (len(points), 1, 1))).astype(np.float32)
        meet = boxes_meet(kind, scaled)
        for roundoff in (0.0, float(ROUNDOFF)):
            _, in_double = cull(kind, scaled, roundoff)
            _, in_single = cull(kind, scaled, roundoff, boxes_meet=True)
            assert np.array_equal(in_single & meet, in_double)


def boxes_meet(kind, points):
    """Whether no axis separates the boxes of the two elements at both ends."""
    ends = points.reshape(-1, 2, 4, 3)
    one, other = np.split(ends, [1 if kind == "vertex_face" else 2], axis=2)
    above = (one.min(axis=2) > other.max(axis=2)).all(axis=1)
    below = (one.max(axis=2) < other.min(axis=2)).all(axis=1)
    return ~(above | below).any(axis=1)


def cull(kind, points, roundoff, boxes_meet=False):
    """What the culls leave, one by one and eight at once, the latter without a look at boxes that are said to meet."""
    queries = QuerySet(Queries.of_points(PairKind[kind.upper()], points), "cpu")
    alone, together = (wp.zeros(queries.count + BATCH, dtype=int, device="cpu") for _ in range(2))
    one, eight = kernels_of(kind, queries.dtype)
    given = queries.given
    x0, x1, elements, pairs = given.x0, given.x1, given.elements, given.pairs
    wp.launch(one, queries.count, inputs=[x0, x1, roundoff], outputs=[alone], device="cpu")
    inputs = [x0, x1, elements, pairs, boxes_meet, roundoff]
    wp.launch(eight, -(-queries.count // BATCH), inputs=inputs, outputs=[together], device="cpu")
    assert not together.numpy()[queries.count :].any()
    return alone.numpy()[: queries.count] == 1, together.numpy()[: queries.count] == 1


def test_numbers_too_large_to_trust_are_left():
    """Where products could lose what matters to underflow, or overflow, nothing is culled but by boxes."""
    rng = np.random.default_rng(7)
    points = rng.uniform(-1.0, 1.0, (4000, 8, 3))
    points[:, 4] = -points[:, 0] * rng.uniform(0.2, 5.0, (4000, 3))  # passes the triangle, along each axis
    points *= np.where(np.arange(8) % 4 == 0, 1e60, 1e-60)[None, :, None]
    _, together = cull("vertex_face", points, float(ROUNDOFF))
    assert 0 < (~together).sum() < 1000
    assert not checker.vertex_face(points[~together]).any()
    points *= np.where(np.arange(8) % 4 == 0, 1e40, 1.0)[None, :, None]
    _, together = cull("vertex_face", points, float(ROUNDOFF))
    assert together.all()
