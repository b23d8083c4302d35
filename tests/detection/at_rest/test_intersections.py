"""Intersections at the samples: exactly those of all pairs, touching included."""

import numpy as np
import pytest
from collision_results import assert_same
from sheets import grid

import warp_bsc as bsc
from warp_bsc import checker
from warp_bsc.detection.at_rest.intersections import IntersectionFinder, find_intersections
from warp_bsc.detection.mesh import ElementsOfParts


def test_intersections_are_exactly_those_of_all_pairs(broad_phase):
    rng = np.random.default_rng(4)
    x = rng.integers(-4, 5, (18, 3)).astype(np.float32)
    mesh = bsc.CollisionMesh(np.arange(18).reshape(6, 3), 18)
    edges, faces = np.meshgrid(np.arange(len(mesh.edges)), np.arange(6), indexing="ij")
    pairs = np.stack([edges.ravel(), faces.ravel()], axis=1)
    pairs = pairs[mesh.edges[pairs[:, 0], 0] // 3 != pairs[:, 1]]
    expected = pairs[checker.edge_face_crossings(x[mesh.edges[pairs[:, 0]]], x[mesh.faces[pairs[:, 1]]])]
    assert len(expected)
    np.testing.assert_array_equal(bsc.CollisionDetector(mesh).find_intersections(x), expected)


def test_touching_configurations_intersect_and_flat_ones_do_not():
    positions, faces = grid(8)
    detector = bsc.CollisionDetector(bsc.CollisionMesh(faces, len(positions)))
    assert len(detector.find_intersections(positions)) == 0
    folded = positions.copy()
    folded[-1] = positions[0]
    assert len(detector.find_intersections(folded))


def test_a_finder_of_intersections_is_used_again(broad_phase):
    """Trees kept from one configuration to the next give the pairs that new ones give, and exactly those that cross."""
    rng = np.random.default_rng(7)
    faces = np.arange(300).reshape(100, 3)
    mesh = bsc.CollisionMesh(faces, 300)
    finder = IntersectionFinder(mesh)
    for scale in (8.0, 7.5, 0.01, 40.0, 3.0):
        corner = rng.uniform(-scale, scale, (100, 1, 3))
        x = (corner + rng.uniform(-2, 2, (100, 3, 3))).reshape(300, 3).astype(np.float32)
        found = finder.find(x)
        edges, others = (numbers.ravel() for numbers in np.indices((len(mesh.edges), len(faces))))
        pairs = np.stack([edges, others], axis=1)[mesh.edges[edges, 0] // 3 != others]
        expected = pairs[checker.edge_face_crossings(x[mesh.edges[pairs[:, 0]]], x[faces[pairs[:, 1]]])]
        np.testing.assert_array_equal(found.pairs, expected)
        assert found.crosses.all()  # no three random points are in line with a fourth


def test_an_edge_that_touches_a_face_does_not_cross_it(broad_phase):
    face = [(0, 0, 0), (4, 0, 0), (0, 4, 0)]
    edges = {
        ((1, 1, -1), (1, 1, 1)): True,
        ((1, 1, 0), (1, 1, 1)): False,  # an end is in the face
        ((0, 1, -1), (0, 1, 1)): False,  # passes its boundary
        ((0, 0, -1), (0, 0, 1)): False,  # passes a corner
        ((1, 1, 0), (2, 1, 0)): False,  # lies in it
        ((-1, 1, 0), (5, 1, 0)): False,
        ((1, 1, 0), (1, 1, 0)): False,  # a point
    }
    x = np.array([*face, *(end for edge in edges for end in edge)], dtype=np.float64)
    corners = [[3 + 2 * i, 4 + 2 * i, 4 + 2 * i] for i in range(len(edges))]
    mesh = bsc.CollisionMesh([[0, 1, 2], *corners], len(x))
    found = IntersectionFinder(mesh).find(x)
    of_face = found.pairs[:, 1] == 0
    own = dict(zip(map(tuple, mesh.edges[found.pairs[of_face, 0]]), found.crosses[of_face], strict=True))
    assert own == {(3 + 2 * i, 4 + 2 * i): crosses for i, crosses in enumerate(edges.values())}


@pytest.mark.parametrize("ridge", [-1.0, 0.0, 1.0])
def test_an_edge_crosses_two_faces_where_it_passes_their_common_side(ridge, broad_phase):
    """The faces are a roof with a ridge at height 0 along y, a flat sheet, or a gutter; their outer sides are lower."""
    x = [(0, -4, 0), (0, 4, 0), (-4, 0, ridge), (4, 0, ridge)]
    edges = {
        ((0, 1, -1), (0, 1, 1)): True,
        ((-1, 2, -4), (1, 2, 4)): True,
        ((-4, 1, -1), (4, 1, 1)): ridge == 0.0,  # flatter than the roof: it touches the ridge
        ((0, 1, 0), (0, 1, 1)): False,
        ((0, -4, -1), (0, -4, 1)): False,
    }
    x = np.array([*x, *(end for edge in edges for end in edge)], dtype=np.float64)
    corners = [[4 + 2 * i, 5 + 2 * i, 5 + 2 * i] for i in range(len(edges))]
    for faces in ([[0, 1, 2], [1, 0, 3]], [[2, 0, 1], [0, 1, 3]]):  # also of mixed orientation
        mesh = bsc.CollisionMesh([*faces, *corners], len(x))
        found = IntersectionFinder(mesh).find(x)
        for face in (0, 1):
            of_face = found.pairs[:, 1] == face
            own = dict(zip(map(tuple, mesh.edges[found.pairs[of_face, 0]]), found.crosses[of_face], strict=True))
            assert own == {(4 + 2 * i, 5 + 2 * i): crosses for i, crosses in enumerate(edges.values())}
    mesh = bsc.CollisionMesh([[0, 1, 2], [1, 0, 3], [0, 1, 3], *corners], len(x))
    assert not IntersectionFinder(mesh).find(x).crosses.any()  # three faces have that side


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_flat_sheets_at_rest_need_no_exact_arithmetic(dtype, monkeypatch, broad_phase):
    """Pairs of one plane, which no orientation in space decides, are apart in a coordinate plane."""
    positions, faces = grid(24)
    turned, _ = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))
    decided = []
    decide = checker.edge_face_crossings
    monkeypatch.setattr(checker, "edge_face_crossings", lambda *pair: decided.append(len(pair[0])) or decide(*pair))
    for turn in (np.eye(3), np.eye(3)[[2, 0, 1]], turned):
        x = (positions @ turn).astype(dtype)
        mesh = bsc.CollisionMesh(faces, len(x))
        assert len(IntersectionFinder(mesh).find(x).pairs) == 0
    assert sum(decided) <= len(faces) // 100


def test_edges_beside_faces_do_not_meet_them(broad_phase):
    """Edges and faces with small integer coordinates in one plane, of all positions to each other."""
    rng = np.random.default_rng(8)
    x = rng.integers(0, 5, (4000, 5, 3)).astype(np.float64)
    x[..., 2] = x[..., 0] - 2 * x[..., 1]
    x += 100.0 * np.stack(np.indices((20, 20, 10)), axis=-1).reshape(-1, 1, 3)  # queries are far from each other
    faces = np.arange(20000).reshape(4000, 5)
    mesh = bsc.CollisionMesh(np.concatenate([faces[:, 2:], faces[:, [0, 1, 1]]]), 20000)
    found = IntersectionFinder(mesh).find(x.reshape(-1, 3))
    found = {
        (*edge, *face) for edge, face in zip(mesh.edges[found.pairs[:, 0]], mesh.faces[found.pairs[:, 1]], strict=True)
    }
    truth = checker.edge_face_crossings(x[:, :2], x[:, 2:])
    assert 1000 < truth.sum() < 3000
    for query, meets in zip(faces.tolist(), truth.tolist(), strict=True):
        if not (x[query[0] // 5, 0] == x[query[0] // 5, 1]).all():
            assert (tuple(query) in found) == meets


def test_intersections_at_the_end_of_a_motion(broad_phase):
    """A finder that shares the detector's trees finds the same, at the end of a motion and elsewhere."""
    rng = np.random.default_rng(5)
    mesh = bsc.CollisionMesh(np.arange(600).reshape(200, 3), 600)
    detector = bsc.CollisionDetector(mesh)
    finder = detector.intersection_finder()
    for scale in (3.0, 3.1, 0.5, 12.0, 4.0):
        corner = rng.uniform(-scale, scale, (200, 1, 3))
        x0, x1 = ((corner + rng.uniform(-2, 2, (200, 3, 3))).reshape(-1, 3) for _ in range(2))
        at_start = finder.find(x0)
        expected = bsc.CollisionDetector(mesh).detect(x0, x1)
        assert_same(detector.detect(x0, x1), expected)
        at_end = finder.find(x1, is_end=True)
        np.testing.assert_array_equal(at_start.pairs, find_intersections(mesh, x0))
        np.testing.assert_array_equal(at_end.pairs, find_intersections(mesh, x1))
        assert len(at_end.pairs)


def test_elements_are_found_by_their_parts():
    found = ElementsOfParts.of(np.array([[0, 1], [1, -1], [3, 0]]), 4)
    assert found.first.tolist() == [0, 2, 4, 4, 5]
    assert found.elements.tolist() == [0, 2, 0, 1, 2]
    rows, elements = found.find(np.array([1, 2, 0]))
    assert rows.tolist() == [0, 0, 2, 2]
    assert elements.tolist() == [0, 1, 0, 2]
