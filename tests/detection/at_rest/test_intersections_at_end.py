"""Intersections at the end of a motion, found from those at its start and its collisions, against a search."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sheets import crumpled

import warp_bsc as bsc
from warp_bsc.detection.at_rest import intersections
from warp_bsc.detection.at_rest.intersections import IntersectionFinder

_search = IntersectionFinder.find


def assert_same(found, mesh, x):
    """Asserts that intersections are those that a search of all pairs finds."""
    expected = _search(IntersectionFinder(mesh), x)
    np.testing.assert_array_equal(found.pairs, expected.pairs)
    np.testing.assert_array_equal(found.crosses, expected.crosses)


@pytest.fixture
def searches(monkeypatch):
    """Whether each search of all pairs was at the end of a motion."""
    done = []

    def find(self, x, *, is_end=False):
        done.append(is_end)
        return _search(self, x, is_end=is_end)

    monkeypatch.setattr(IntersectionFinder, "find", find)
    return done


@pytest.fixture
def any_number(device, monkeypatch):
    """However many collisions there are, intersections at the end come from them."""
    if device.is_cuda:
        pytest.skip("on a GPU all pairs are searched")
    monkeypatch.setattr(intersections, "_PAIRS_OF_HIT", 0)


@pytest.mark.parametrize(("method", "dtype"), [("exact", np.float32), ("conservative", np.float64)])
def test_small_integers_in_all_positions(method, dtype, any_number):
    """Faces that share vertices, touch, lie in one plane, or are a segment, over several motions."""

    @settings(max_examples=12)
    @given(seed=st.integers(0), size=st.integers(1, 5), flat=st.booleans())
    def check(seed, size, flat):
        rng = np.random.default_rng(seed)
        faces = rng.integers(0, 14, (10, 3))
        faces = faces[(faces != faces[:, :1]).any(axis=1)]  # a point has no edge, see below
        mesh = bsc.CollisionMesh(faces, 14)
        detector = bsc.CollisionDetector(mesh, method=method)
        finder = detector.intersection_finder()
        x = rng.integers(0, size + 1, (5, 14, 3)).astype(dtype)
        x[2:, ::2] = x[2, ::2]  # half of the vertices rest later
        if flat:
            x[..., 2] = 0.0
        found = finder.find(x[0])
        for x0, x1 in itertools.pairwise(x):
            found = finder.find_at_end(x1, found, detector.detect(x0, x1))
            assert_same(found, mesh, x1)

    check()


def test_sheets_that_pass_through_each_other(any_number, searches):
    """Crossings begin, stay and end."""
    start, end, faces = crumpled(0)
    mesh = bsc.CollisionMesh(faces, len(start))
    detector = bsc.CollisionDetector(mesh, method="exact")
    finder = detector.intersection_finder()
    x = [(start + share * (end - start)).astype(np.float32) for share in (0.0, 0.7, 1.0, 1.0, 0.9, 0.0)]
    found = finder.find(x[0])
    counts = [len(found.pairs)]
    for x0, x1 in itertools.pairwise(x):
        found = finder.find_at_end(x1, found, detector.detect(x0, x1))
        assert_same(found, mesh, x1)
        counts.append(len(found.pairs))
    assert counts[2] == counts[3] != counts[4] > 0 == counts[0] == counts[5]
    assert searches == [False]


@pytest.mark.parametrize("method", ["float", "exact"])
def test_all_pairs_are_searched_where_collisions_are_not_certified_or_many(method, searches):
    """A stack of triangles falls through another, or in the first case one triangle of it."""
    low = np.array([[0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [0.0, 4.0, 0.0]])
    x0 = (np.stack([low, low + 1.0])[:, None] + 10.0 * np.arange(9)[:, None, None] * [1.0, 0.0, 0.0]).reshape(-1, 3)
    x1 = x0.copy()
    x1[27 : 30 if method == "float" else 54 : 3, 2] -= 2.0
    mesh = bsc.CollisionMesh(np.arange(54).reshape(18, 3), 54)
    detector = bsc.CollisionDetector(mesh, method=method)
    finder = detector.intersection_finder()
    start = finder.find(x0)
    found = finder.find_at_end(x1, start, detector.detect(x0, x1))
    assert searches == [False, True]
    assert_same(found, mesh, x1)
    assert len(found.pairs)


def test_an_edge_that_passes_over_a_face_without_an_edge(searches):
    """A face that names one vertex three times is a point, which no query of the detection compares with an edge."""
    mesh = bsc.CollisionMesh([[0, 0, 0], [1, 2, 3]], 4)
    x0 = np.array([[0.0, 0.0, 0.0], [-1.0, 0.0, 1.0], [1.0, 0.0, 1.0], [0.0, 5.0, 1.0]])
    x1 = x0 * [1.0, 1.0, 0.0]
    detector = bsc.CollisionDetector(mesh, method="exact")
    finder = detector.intersection_finder()
    start = finder.find(x0)
    found = finder.find_at_end(x1, start, detector.detect(x0, x1))
    assert mesh.edges[found.pairs[:, 0]].tolist() == [[1, 2]] and found.pairs[:, 1].tolist() == [0]
    assert searches == [False, True]


def test_positions_that_are_not_finite_are_refused(any_number):
    x = np.random.default_rng(0).uniform(size=(6, 3))
    detector = bsc.CollisionDetector(bsc.CollisionMesh([[0, 1, 2], [3, 4, 5]], 6))
    finder = detector.intersection_finder()
    start = finder.find(x)
    collisions = detector.detect(x, x)
    x[4, 1] = np.nan
    with pytest.raises(ValueError, match=r"x\[4\] has a coordinate that is not finite"):
        finder.find_at_end(x, start, collisions)
