"""Minimum distances of device functions in a user's own kernel, whose module fuses multiply and add as it likes."""

import distances
import numpy as np
import pytest
import warp as wp
from sample_sizes import cases

from warp_bsc import checker
from warp_bsc.kernels import ccd_edge_edge, ccd_vertex_edge, ccd_vertex_face, ccd_vertex_vertex

KINDS = distances.KINDS


@wp.kernel(enable_backward=False)
def ask(kind: int, x: wp.array2d[wp.vec3d], distance: wp.array[wp.float64], status: wp.array[int]):
    i = wp.tid()
    d = distance[i]
    if kind == 0:
        status[i] = ccd_vertex_face(x[i, 0], x[i, 1], x[i, 2], x[i, 3], x[i, 4], x[i, 5], x[i, 6], x[i, 7], d)
    elif kind == 1:
        status[i] = ccd_edge_edge(x[i, 0], x[i, 1], x[i, 2], x[i, 3], x[i, 4], x[i, 5], x[i, 6], x[i, 7], d)
    elif kind == 2:
        status[i] = ccd_vertex_edge(x[i, 0], x[i, 1], x[i, 2], x[i, 3], x[i, 4], x[i, 5], d)
    else:
        status[i] = ccd_vertex_vertex(x[i, 0], x[i, 1], x[i, 2], x[i, 3], d)


def answers(kind, points, distance):
    status = wp.zeros(len(points), dtype=int)
    inputs = [KINDS.index(kind), wp.array(points, dtype=wp.vec3d), wp.array(distance, dtype=wp.float64)]
    wp.launch(ask, len(points), inputs=inputs, outputs=[status])
    return status.numpy()


@pytest.mark.parametrize("kind", KINDS)
def test_known_distances(kind):
    """To the last bit most answers are unsure, 2^-40 away few are; none is wrong, from 1e-300 to 1e300."""
    rng = np.random.default_rng(1)
    reached, of_reached = distances.reached(rng, cases(3000), kind)
    for by, most_unsure in (("2^-40", 0.02), ("ulp", 1.0)):
        distance, truth = distances.nudged(rng, of_reached, by)
        status = answers(kind, *distances.scaled(rng, reached, distance))
        assert (status[truth] != 0).all()
        assert (status[~truth] != 1).all()
        assert (status == 2).mean() <= most_unsure


@pytest.mark.parametrize("kind", KINDS)
def test_adversarial_queries(kind):
    points, distance = distances.adversarial(np.random.default_rng(2), cases(260), kind)
    status, truth = answers(kind, points, distance), getattr(checker, kind)(points, distance)
    assert (status[truth] != 0).all()
    assert (status[~truth] != 1).all()
    assert (status == 2).mean() < 0.12
    assert min(truth.sum(), (~truth).sum()) > cases(20)


@pytest.mark.parametrize("kind", KINDS)
def test_features_that_are_one_point_are_at_any_distance(kind):
    points = np.full((2, 2 * distances.POINTS[kind], 3), 0.1)
    assert answers(kind, points, np.array([0.0, 1e-320])).tolist() == [1, 1]


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_no_number_is_unsure(kind):
    half = distances.POINTS[kind]
    points = np.zeros((5, 2 * half, 3))
    points[:, [0, half] if kind != "edge_edge" else [0, 1, 4, 5]] = 1e3
    points[4, 1, 2] = np.inf
    assert answers(kind, points, np.array([np.nan, np.inf, -1.0, 1.0, 1.0])).tolist() == [2, 2, 2, 0, 2]


@pytest.mark.parametrize("scale", [5e-324, 2.0**-1040, 1e-200, 1e200, 2.0**1019])
def test_all_scales(scale):
    """A vertex that comes within 4 of a face, between numbers whose differences may be subnormal or overflow."""
    face = [[-10, -10, 0], [10, -10, 0], [0, 10, 0]]
    points = scale * np.array([[[0, 0, 7], *face, [0, 0, 4], *face]] * 4, dtype=np.float64)
    distance = scale * np.array([3.0, 5.0, 1.0, 10.0])
    assert answers("vertex_face", points, distance).tolist() == [0, 1, 0, 1]
    assert answers("vertex_face", points, np.array([1e-300, 1e300, 5e-324, 1.0])).tolist()[0] == (scale < 1e-308)


def test_distance_much_larger_or_smaller_than_the_query():
    points = np.array([[[0, 0, 1e-250], [0, 0, 0]] * 2] * 4)
    assert answers("vertex_vertex", points, np.array([1e200, 1e-10, 1e-260, 0.0])).tolist() == [1, 1, 0, 0]
