"""Classification of eight pairs at once: the statuses are those of one pair, bit by bit."""

import numpy as np
import pytest
import warp as wp
from generators import GENERATORS
from sample_sizes import cases
from simd_packets import in_normal_range

from warp_bsc.bench.measure.methods import Queries, QuerySet
from warp_bsc.detection.run.settings import NO_FUSED_OPERATIONS, PairKind
from warp_bsc.kernels.classification import classify
from warp_bsc.kernels.motion import relative_motion
from warp_bsc.kernels.pipeline.batch_classification import BATCH, OPEN, classify_batch_of
from warp_bsc.kernels.polynomials import coplanarity
from warp_bsc.kernels.signs import FREE, HIT, ROUNDOFF, UNSURE

KINDS = ("vertex_face", "edge_edge")


def kernels_of(kind, dtype):
    """Kernels that write the status of each pair: one query a thread, and a batch."""
    number = int(PairKind[kind.upper()])
    classify_batch = classify_batch_of(dtype, kind == "vertex_face")

    @wp.kernel(**NO_FUSED_OPERATIONS)
    def classify_one(x0: wp.array[dtype], x1: wp.array[dtype], roundoff: wp.float64, status: wp.array[int]):
        i = wp.tid()
        j = 4 * i
        a0, b0, c0, d0 = x0[j], x0[j + 1], x0[j + 2], x0[j + 3]
        a1, b1, c1, d1 = x1[j], x1[j + 1], x1[j + 2], x1[j + 3]
        motion = relative_motion(number, a0, b0, c0, d0, a1, b1, c1, d1, roundoff)
        status[i] = classify(motion, coplanarity(motion))

    @wp.kernel(**NO_FUSED_OPERATIONS)
    def classify_batches(
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        elements: wp.array2d[int],
        pairs: wp.array[wp.vec2i],
        roundoff: wp.float64,
        status: wp.array[int],
    ):
        i = BATCH * wp.tid()
        statuses = classify_batch(x0, x1, elements, pairs, i, wp.min(BATCH, pairs.shape[0] - i), roundoff)
        for lane in range(BATCH):
            status[i + lane] = int((statuses >> wp.uint64(2 * lane)) & wp.uint64(3))

    return classify_one, classify_batches


def classify_both_ways(kind, points, roundoff):
    """The statuses, one by one and in batches."""
    queries = QuerySet(Queries.of_points(PairKind[kind.upper()], points), "cpu")
    alone, together = (wp.full(queries.count + int(BATCH), 7, dtype=int, device="cpu") for _ in range(2))
    one, many = kernels_of(kind, queries.dtype)
    given = queries.given
    x0, x1, elements, pairs = given.x0, given.x1, given.elements, given.pairs
    wp.launch(one, queries.count, inputs=[x0, x1, roundoff], outputs=[alone], device="cpu")
    inputs = [x0, x1, elements, pairs, roundoff]
    wp.launch(many, -(-queries.count // BATCH), inputs=inputs, outputs=[together], device="cpu")
    past = together.numpy()[queries.count :]
    assert not past[past != 7].any()
    return alone.numpy()[: queries.count], together.numpy()[: queries.count]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("kind", KINDS)
def test_statuses_are_those_of_one_query(kind, dtype):
    rng = np.random.default_rng(8)
    number = cases(1003)  # no multiple of eight
    for roundoff in (0.0, float(ROUNDOFF)):
        found = {status: 0 for status in (int(FREE), int(HIT), int(UNSURE), int(OPEN))}
        for name, generator in GENERATORS.items():
            points = generator(rng, number, kind, dtype)
            alone, together = classify_both_ways(kind, points, roundoff)
            decided = together != OPEN
            assert decided[in_normal_range(points)].all(), name
            assert np.array_equal(alone[decided], together[decided]), (name, roundoff)
            for status in found:
                found[status] += int((together == status).sum())
        assert all(found[status] > cases(100) for status in (FREE, HIT, OPEN) + (UNSURE,) * (roundoff > 0.0)), found
