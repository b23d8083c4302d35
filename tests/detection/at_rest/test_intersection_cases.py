"""The meshes of the page "Intersections, exactly": stated answers, those of the checker and ours are the same."""

import itertools
from collections import Counter

import numpy as np
import pytest
from intersection_cases import TOUCHING_IN_LINE, ULP, cases_by_definition, definite_cases, parts_of, soup, true_pairs
from sample_sizes import cases

import warp_bsc as bsc

CASES = [*definite_cases(), *cases_by_definition()]
each_case = pytest.mark.parametrize("case", CASES, ids=[case.name.replace(" ", "-") for case in CASES])
each_type = pytest.mark.parametrize("dtype", [np.float32, np.float64])
METHODS = "float", "conservative", "exact"


def found(x, faces, method="conservative"):
    """The pairs that we find."""
    return bsc.CollisionDetector(bsc.CollisionMesh(faces, len(x)), method=method).find_intersections(x)


def as_vertices(pairs, faces, count, number=None):
    """How often an edge and a face of some vertices are a pair, with the numbers that vertices had before."""
    mesh = bsc.CollisionMesh(faces, count)
    number = np.arange(count) if number is None else number
    edges, corners = (np.sort(number[rows]) for rows in (mesh.edges[pairs[:, 0]], mesh.faces[pairs[:, 1]]))
    return Counter(map(tuple, np.concatenate([edges, corners], axis=1).tolist()))


def reordered(rng, x, faces):
    """A mesh with its vertices, its faces and the corners of each in another order, and their numbers before."""
    order = rng.permutation(len(x))
    corners = rng.permuted(faces[rng.permutation(len(faces))], axis=1)
    return x[order], np.argsort(order)[corners], order


def moved_exactly(x, offset):
    """Positions plus an offset, None if a sum is rounded (D. E. Knuth, TwoSum)."""
    total = x + offset
    part = total - x
    rounded = (x - (total - part)) + (offset - part)
    return None if rounded.any() else total


@each_type
@each_case
def test_answer(case, dtype, broad_phase):
    x = case.x.astype(dtype)
    truth = true_pairs(x, case.faces)
    assert len(truth) == case.pairs_of(dtype)
    for method in METHODS:
        np.testing.assert_array_equal(found(x, case.faces, method), truth)
    detector = bsc.CollisionDetector(bsc.CollisionMesh(case.faces, len(x)))
    assert detector.has_intersections(x) == (case.pairs_of(dtype) > 0)


@each_type
@each_case
def test_order_and_mirrors_change_nothing(case, dtype):
    x, rng = case.x.astype(dtype), np.random.default_rng(2)
    pairs = as_vertices(found(x, case.faces), case.faces, len(x))
    axes = itertools.product(itertools.permutations(range(3)), itertools.product([1, -1], repeat=3))
    for i, (columns, signs) in enumerate(axes):
        if i % 5 == 0:  # also of the two orders of the axes alone
            turned, faces, order = reordered(rng, x[:, columns] * dtype(1) * np.array(signs, dtype), case.faces)
            assert as_vertices(found(turned, faces), faces, len(x), order) == pairs


@each_type
@each_case
def test_scale_and_place_change_nothing(case, dtype):
    x = case.x.astype(dtype)
    pairs = found(x, case.faces)
    for scale in (2.0**-60, 2.0**-9, 2.0**60):
        np.testing.assert_array_equal(found(x * dtype(scale), case.faces), pairs)
    offsets = (dtype(sign * 2.0**power) for power, sign in itertools.product(range(-30, 40, 3), (1, -1)))
    moved = [x_moved for offset in offsets if (x_moved := moved_exactly(x, offset)) is not None]
    for x_moved in moved[:: max(1, len(moved) // 3)]:
        np.testing.assert_array_equal(found(x_moved, case.faces), pairs)


def test_many_cases_are_moved():
    """The test above moves most: where coordinates use all digits, no sum is exact."""
    offsets = [2.0**power for power in range(-30, 40, 3)]
    moved = [any(moved_exactly(case.x, offset) is not None for offset in offsets) for case in CASES]
    assert np.mean(moved) > 0.8


@each_type
@pytest.mark.parametrize("shift", [0, 1])
def test_all_orders_of_two_triangles_that_touch_in_a_line(dtype, shift):
    """They touch in a segment of the line x = 3, y = 5, in all 36 orders of corners; an ulp apart they do not."""
    first, second = np.array(TOUCHING_IN_LINE, dtype)
    second[second == 3.0] += dtype(shift * (ULP if dtype is np.float32 else 2.0**-51))
    for one, other in itertools.product(itertools.permutations(first), itertools.permutations(second)):
        x, faces = soup(one, other)
        assert len(found(x.astype(dtype), faces)) == (0 if shift else 3)


def test_triangles_that_share_a_vertex_meet_elsewhere_if_and_only_if_a_pair_is_found():
    """As the page says: the checker tells whether one meets the other cut off near the shared vertex."""
    rng = np.random.default_rng(3)
    faces = np.array([[0, 1, 2], [0, 3, 4]])
    answers = []
    for _ in range(cases(600)):
        x = np.concatenate([np.zeros((1, 3)), rng.integers(-2, 3, (4, 3))])
        if any(not np.cross(x[a], x[b]).any() for a, b in ((1, 2), (3, 4))):
            continue
        near = np.concatenate([x[1:3] / 64, x[1:3], x[3:] / 64, x[3:]])  # each as two triangles of its far part
        far_parts = np.array([[0, 1, 2], [1, 2, 3], [4, 5, 6], [5, 6, 7]])
        edges, corners = bsc.CollisionMesh(far_parts, 8).edges, near[far_parts]
        pairs = [(e, f) for e in range(len(edges)) for f in range(4) if (edges[e, 0] < 4) != (f < 2)]
        rows, columns = np.array(pairs).T
        meets = bsc.checker.edge_face_crossings(near[edges[rows]], corners[columns]).any()
        assert (len(found(x, faces)) > 0) == meets
        answers.append(meets)
    assert cases(50) < np.sum(answers) < len(answers) - cases(50)


def test_parts():
    faces = np.array([[4, 2, 1], [0, 3, 5], [5, 6, 3], [7, 8, 1]])
    assert [part.tolist() for part in parts_of(faces)] == [[[0, 3, 5], [5, 6, 3]], [[4, 2, 1], [7, 8, 1]]]
