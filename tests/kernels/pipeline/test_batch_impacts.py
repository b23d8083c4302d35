"""Times of impact of eight pairs at once: what they find is what one pair finds, bit by bit."""

import numpy as np
import pytest
import warp as wp
from flushing import subnormals_flushed
from generators import GENERATORS
from outputs import filled_with_nan
from sample_sizes import cases
from simd_packets import in_normal_range

from warp_bsc import checker
from warp_bsc.bench.measure.methods import Queries, QuerySet
from warp_bsc.detection.run.settings import NO_FUSED_OPERATIONS, PairKind
from warp_bsc.kernels.classification import classify
from warp_bsc.kernels.motion import relative_motion
from warp_bsc.kernels.pipeline.batch_impacts import BATCH, impact_batch_of
from warp_bsc.kernels.polynomials import coplanarity
from warp_bsc.kernels.signs import FREE, HIT, ROUNDOFF, UNSURE
from warp_bsc.kernels.time_of_impact import clamped_tolerance, impact, power_of_two

KINDS = ("vertex_face", "edge_edge")


def kernels_of(kind, dtype):
    """Kernels that classify and find the impact of one query a thread, and the impacts of a batch."""
    number = int(PairKind[kind.upper()])
    impact_batch = impact_batch_of(dtype, kind == "vertex_face")

    @wp.kernel(**NO_FUSED_OPERATIONS)
    def find_one(
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        roundoff: wp.float64,
        tolerance: wp.float64,
        classified: wp.array[wp.int8],
        status: wp.array[wp.int8],
        within_tolerance: wp.array[wp.bool],
        toi: wp.array[wp.float64],
        coordinates: wp.array[wp.vec3d],
        normal: wp.array[wp.vec3d],
    ):
        i = wp.tid()
        j = 4 * i
        a0, b0, c0, d0 = x0[j], x0[j + 1], x0[j + 2], x0[j + 3]
        a1, b1, c1, d1 = x1[j], x1[j + 1], x1[j + 2], x1[j + 3]
        motion = relative_motion(number, a0, b0, c0, d0, a1, b1, c1, d1, roundoff)
        y = coplanarity(motion)
        found = classify(motion, y)
        classified[i] = wp.int8(found)
        if found == FREE:
            return
        result = impact(motion, y, found, tolerance)
        status[i] = wp.int8(result.status)
        within_tolerance[i] = result.within_tolerance == 1
        toi[i] = result.toi
        coordinates[i] = result.coordinates
        normal[i] = result.normal

    @wp.kernel(**NO_FUSED_OPERATIONS)
    def find_batches(
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        elements: wp.array2d[int],
        pairs: wp.array[wp.vec2i],
        roundoff: wp.float64,
        timed: bool,
        tolerance: wp.float64,
        status: wp.array[wp.int8],
        within_tolerance: wp.array[wp.bool],
        toi: wp.array[wp.float64],
        coordinates: wp.array[wp.vec3d],
        normal: wp.array[wp.vec3d],
        left: wp.array[int],
        touching: wp.array[int],
    ):
        i = BATCH * wp.tid()
        length = power_of_two(clamped_tolerance(tolerance))
        number = wp.min(BATCH, pairs.shape[0] - i)
        masks = impact_batch(
            x0,
            x1,
            elements,
            pairs,
            i,
            number,
            roundoff,
            timed,
            length,
            status,
            within_tolerance,
            toi,
            coordinates,
            normal,
        )
        for k in range(number):
            left[i + k] |= int((masks[0] >> wp.uint64(k)) & wp.uint64(1))
            touching[i + k] = int((masks[1] >> wp.uint64(k)) & wp.uint64(1))

    return find_one, find_batches


def outputs_of(n):
    """Status, whether times are within the tolerance, times, coordinates and normals, floats as NaN."""
    types = (wp.int8, wp.bool, wp.float64, wp.vec3d, wp.vec3d)
    return [filled_with_nan(n, t, "cpu") if t in types[2:] else wp.zeros(n, dtype=t, device="cpu") for t in types]


def find_both_ways(kind, points, roundoff, tolerance):
    """Returns what one query finds, what batches find, the same without times, and the pairs left open and touching."""
    one, many = kernels_of(kind, wp.vec3 if points.dtype == np.float32 else wp.vec3d)
    queries = QuerySet(Queries.of_points(PairKind[kind.upper()], points), "cpu")
    classified, *alone = wp.zeros(len(points), dtype=wp.int8, device="cpu"), *outputs_of(len(points))
    given = queries.given
    inputs = [given.x0, given.x1, roundoff, tolerance]
    wp.launch(one, len(points), inputs=inputs, outputs=[classified, *alone], device="cpu")
    contacts = classified.numpy() != FREE
    alone = [array.numpy()[contacts] for array in alone]
    n = int(contacts.sum())
    pairs = wp.array(queries.pairs[contacts], dtype=wp.vec2i, device="cpu")
    results = []
    left, touching = (wp.zeros(n, dtype=int, device="cpu") for _ in range(2))
    for timed in (True, False):
        status, *others = outputs_of(n)
        status.assign(classified.numpy()[contacts])
        inputs = [given.x0, given.x1, given.elements, pairs, roundoff, timed, tolerance]
        wp.launch(many, -(-n // BATCH), inputs=inputs, outputs=[status, *others, left, touching], device="cpu")
        assert not (timed and touching.numpy().any())
        results.append([array.numpy() for array in (status, *others)])
    return alone, *results, left.numpy() == 1, touching.numpy() == 1, contacts


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("kind", KINDS)
def test_impacts_are_those_of_one_query(kind, dtype):
    rng = np.random.default_rng(9)
    for roundoff, tolerance in ((float(ROUNDOFF), 2.0**-20), (0.0, 2.0**-20), (float(ROUNDOFF), 2.0**-37)):
        number = cases(403 if tolerance > 2.0**-30 else 103)
        seen = dict.fromkeys((int(FREE), int(HIT), int(UNSURE)), 0)
        for name, generator in GENERATORS.items():
            points = generator(rng, number, kind, dtype)
            alone, timed, untimed, left, _, contacts = find_both_ways(kind, points, roundoff, tolerance)
            assert not left[in_normal_range(points[contacts])].any(), name
            reported = ~left & (alone[0] != FREE)
            for values in (alone, timed):
                for array in values[3:]:
                    array[~reported] = 0.0  # those of other rows have no meaning
            for expected, found in zip(alone, timed, strict=True):
                assert np.array_equal(expected[~left], found[~left], equal_nan=True), (name, roundoff, tolerance)
            assert np.array_equal(untimed[0][~left], alone[0][~left])
            assert not untimed[1].any() and all(np.isnan(array).all() for array in untimed[2:])  # not written
            for status in seen:
                seen[status] += int((alone[0] == status).sum())
        assert all(seen[status] > cases(20) for status in seen if roundoff > 0.0 or status == HIT), seen


def points_in_planes(rng, n, kind, dtype, together):
    """Queries of which so many points have the same coordinate along an axis at both ends; some on a grid."""
    points = rng.integers(-3, 4, (n, 8, 3)) + rng.choice([0.0, 0.1], (n, 1, 1)) * rng.normal(size=(n, 8, 3))
    for query, axis in zip(points, rng.integers(0, 3, n), strict=True):
        which = rng.permutation(4)[:together]
        query[which, axis], query[which + 4, axis] = query[which[0], axis], query[which[0] + 4, axis]
    return points.astype(dtype)


@pytest.mark.parametrize("together", [3, 4])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("kind", KINDS)
def test_touching_queries_collide_and_no_search_certifies_it(kind, dtype, together):
    points = points_in_planes(np.random.default_rng(4), cases(2003), kind, dtype, together)
    alone, _, untimed, _, touching, contacts = find_both_ways(kind, points, float(ROUNDOFF), 2.0**-20)
    assert touching.sum() > cases(60)
    assert (alone[0][touching] == UNSURE).all() and np.array_equal(untimed[0], alone[0])
    assert getattr(checker, kind)(points[contacts][touching]).all()


def test_subnormal_numbers_that_compare_as_equal_do_not_touch():
    points = points_in_planes(np.random.default_rng(4), cases(2003), "edge_edge", np.float64, 4)
    zeros = points == 0.0
    points[zeros] = np.random.default_rng(5).integers(1, 99, zeros.sum()) * 2.0**-1074
    with subnormals_flushed():
        touching, contacts = find_both_ways("edge_edge", points, float(ROUNDOFF), 2.0**-20)[-2:]
    assert checker.edge_edge(points[contacts][touching]).all()
