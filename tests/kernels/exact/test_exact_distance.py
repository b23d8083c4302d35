"""Minimum distances in wide integers: no untrue answer, and none left open where features rest or move together."""

import distances
import numpy as np
import pytest
import warp as wp
from compilation import QUICK
from sample_sizes import cases

from warp_bsc import checker
from warp_bsc.kernels import FREE, HIT, UNSURE
from warp_bsc.kernels.exact.distance import BITS, TOO_WIDE, decide_distance_in
from warp_bsc.kernels.motion import query_of

DIGITS = 21


def kernel(limbs):
    decide_distance = decide_distance_in(limbs)

    @wp.kernel(enable_backward=False, module="unique", module_options=QUICK)
    def decide(
        kind: int,
        x: wp.array2d[wp.vec3d],
        distance: wp.array[wp.float64],
        toi: wp.array[wp.float64],
        timed: bool,
        status: wp.array[int],
    ):
        i = wp.tid()
        query = query_of(x[i, 0], x[i, 1], x[i, 2], x[i, 3], x[i, 4], x[i, 5], x[i, 6], x[i, 7])
        status[i] = decide_distance(kind, query, distance[i], toi[i], wp.static(DIGITS), timed)

    return decide


KERNELS = {limbs: kernel(limbs) for limbs in BITS}


def decide(kind, points, distance, limbs, toi=None):
    """Statuses of queries, timed if lower bounds of their times are given."""
    n = len(points)
    x = wp.array(distances.as_four_points(kind, points).astype(np.float64), dtype=wp.vec3d)
    status = wp.zeros(n, dtype=int)
    times = wp.array(np.zeros(n) if toi is None else toi, dtype=wp.float64)
    inputs = [int(kind == "edge_edge"), x, wp.array(distance, dtype=wp.float64), times, toi is not None]
    wp.launch(KERNELS[limbs], n, inputs=inputs, outputs=[status])
    return status.numpy()


def assert_true(kind, points, distance, *, decided=0.0, limbs=tuple(BITS)):
    """Asserts that no status is untrue, nor a time, and that at least that share of the queries is decided."""
    interval = getattr(checker, f"{kind}_toi")(points, distance)
    truth = ~np.isnan(interval[:, 0])
    rng = np.random.default_rng(1)
    # lower bounds of the times: about half of them within the tolerance
    latest = np.where(truth, interval[:, 0], 1.0 - 2.0**-30)
    earlier = rng.choice([0.0, 2.0**-24, 2.0**-22, 2.0**-10], len(points))
    toi = np.floor(np.maximum(latest - earlier, 0.0) * 2.0**40) * 2.0**-40
    for width in limbs:
        for bound in (None, toi):
            status = decide(kind, points, distance, width, bound)
            assert not truth[status == FREE].any()
            assert truth[status == HIT].all()
            if bound is not None:
                assert (interval[status == HIT, 0] <= bound[status == HIT] + 2.0 ** (1 - DIGITS)).all()
            assert np.isin(status, (FREE, HIT)).mean() >= decided
    return truth


@pytest.mark.parametrize("kind", distances.KINDS)
def test_no_answer_is_untrue(kind):
    rng = np.random.default_rng([2, *kind.encode()])
    points, distance = distances.reached(rng, 50 + cases(100), kind)
    distance, truth = distances.nudged(rng, distance)
    points, distance = distances.scaled(rng, points, distance, -40, 40)
    np.testing.assert_array_equal(assert_true(kind, points, distance, decided=0.4), truth)
    assert_true(kind, *distances.adversarial(rng, 20, kind), limbs=[max(BITS)])


@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize("kind", distances.KINDS)
def test_all_that_rest_or_move_together_are_decided(kind, moving):
    """Features with small integer coordinates, at distances that many of them have, and next to these."""
    rng = np.random.default_rng([3, *kind.encode()])
    half = distances.POINTS[kind]
    points = rng.integers(-2, 3, (300, 2 * half, 3)).astype(np.float64)
    points[:, half:] = points[:, :half] + moving * rng.integers(-8, 9, (300, 1, 3))
    distance = rng.integers(0, 5, 300).astype(np.float64)
    distance[150:] = distances.distances_at(kind, points[150:], np.zeros(150))
    distance = np.where(distance > 1e-9, distances.nudged(rng, distance, "ulp")[0], 0.0)
    truth = getattr(checker, kind)(points, distance)
    assert 30 < truth.sum() < 270
    for limbs in BITS:
        for toi in (None, np.zeros(300)):
            np.testing.assert_array_equal(decide(kind, points, distance, limbs, toi), np.where(truth, HIT, FREE))


@pytest.mark.parametrize("kind", ["vertex_face", "edge_edge"])
@pytest.mark.parametrize("limbs", BITS)
def test_the_widest_queries_fit(kind, limbs):
    """Corners as large as a width takes, in the directions in which numbers are the largest; one bit more does not."""
    rng = np.random.default_rng([4, limbs])
    n = 400
    x = rng.choice([-0.5, 0.5], (n, 4, 3)) * (1.0 - rng.integers(1, 4, (n, 4, 3)) * 2.0**-53)
    x[:, 3] = np.where(rng.random((n, 1)) < 0.5, x[:, 3], -x[:, 2])
    points = np.concatenate([x, x], axis=1)
    distance = np.full(n, 1.0 - 2.0**-53)
    # differences and distances are below 2^0, and one coordinate is the lowest bit
    for bits, fits in ((BITS[limbs] - DIGITS, True), (BITS[limbs] - DIGITS + 1, False)):
        points[:, 0, 0] = np.ldexp(1.0, -bits)
        points[:, 4] = points[:, 0]
        status = decide(kind, points, distance, limbs)
        if fits:
            truth = getattr(checker, kind)(points, distance)
            assert not (status == TOO_WIDE).any()
            np.testing.assert_array_equal(status, np.where(truth, HIT, FREE))
            assert 0 < truth.sum() < n
        else:
            assert (status == TOO_WIDE).all()


def test_a_distance_reached_for_a_moment_only_is_left_open():
    """A point passes another one at t = 1/3, exactly at the distance."""
    points = np.array([[[-1, 3, 0], [0, 0, 0], [2, 3, 0], [0, 0, 0]]], dtype=np.float64)
    assert checker.vertex_vertex(points, 3.0).all()
    for limbs in BITS:
        assert decide("vertex_vertex", points, [3.0], limbs).tolist() == [UNSURE]
