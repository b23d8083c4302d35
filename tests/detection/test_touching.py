"""Meshes that touch exactly, such as copies of one another: the device decides, and agrees with the exact checker."""

import numpy as np
import pytest
from sheets import grid

import warp_bsc as bsc
from warp_bsc import checker
from warp_bsc.detection.at_rest.containment import ContainmentFinder
from warp_bsc.detection.at_rest.intersections import IntersectionFinder

_CHECKS = ("edge_face_crossings", "edges_pass_faces")


def copies(count, resolution, dtype, turn=None):
    """Flat sheets in one place: positions and faces."""
    x, faces = grid(resolution)
    x = (x if turn is None else x @ turn).astype(dtype)
    return np.tile(x, (count, 1)), np.concatenate([faces + i * len(x) for i in range(count)])


def all_pairs(mesh):
    """All pairs of an edge and a face that share no vertex."""
    edges, faces = (numbers.ravel() for numbers in np.indices((len(mesh.edges), len(mesh.faces))))
    apart = (mesh.edges[edges][:, :, None] != mesh.faces[faces][:, None, :]).all(axis=(1, 2))
    return np.stack([edges[apart], faces[apart]], axis=1)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_copies_of_a_sheet_need_no_checker(dtype, monkeypatch):
    turned, _ = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))
    for turn in (None, turned):
        x, faces = copies(3, 3, dtype, turn)
        mesh = bsc.CollisionMesh(faces, len(x))
        pairs = all_pairs(mesh)
        expected = pairs[checker.edge_face_crossings(x[mesh.edges[pairs[:, 0]]], x[faces[pairs[:, 1]]])]
        with monkeypatch.context() as patch:
            for name in _CHECKS:
                patch.setattr(checker, name, lambda *_: pytest.fail("the host has decided a pair"))
            found = IntersectionFinder(mesh).find(x)
        np.testing.assert_array_equal(found.pairs, expected)
        if turn is None:
            assert len(found.pairs) > 500
            assert not found.crosses.any()  # all is in one plane


def test_touching_pairs_too_wide_for_the_device_go_to_the_checker(monkeypatch):
    """Triangles in one plane with a corner in common and others 2^-500 from there."""
    x = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 0), (2.0**-500, 2.0**-500, 0), (0, 2.0**-500, 0)])
    mesh = bsc.CollisionMesh([[0, 1, 2], [3, 4, 5]], 6)
    decided = []
    for name in _CHECKS:
        check = getattr(checker, name)
        monkeypatch.setattr(checker, name, lambda *pairs, check=check: decided.append(len(pairs[0])) or check(*pairs))
    found = IntersectionFinder(mesh).find(x)
    assert sum(decided) > 0
    pairs = all_pairs(mesh)
    expected = checker.edge_face_crossings(x[mesh.edges[pairs[:, 0]]], x[mesh.faces[pairs[:, 1]]])
    np.testing.assert_array_equal(found.pairs, pairs[expected])


def test_vertices_on_a_touching_body_need_no_checker(monkeypatch):
    """Boxes in one place, and a smaller one that touches a wall from within."""
    x = np.array([(i, j, k) for i in (0, 1) for j in (0, 1) for k in (0, 1)], dtype=np.float32)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    box = np.array([corners for a, b, c, d in quads for corners in ((a, b, c), (a, c, d))])
    bodies = np.repeat([0, 1], len(box))
    mesh = bsc.CollisionMesh(np.concatenate([box, box + 8]), 16)
    monkeypatch.setattr(checker, "edge_face_crossings", lambda *_: pytest.fail("the host has decided a pair"))
    for other, inside in ((x, []), (0.5 * x + np.float32([0, 0.25, 0.25]), [[1, 0]])):
        positions = np.concatenate([x, other])
        found = IntersectionFinder(mesh).find(positions)
        contained = ContainmentFinder(mesh, bodies).find(
            positions, found, lambda pairs: np.ones(len(pairs), dtype=bool)
        )
        assert contained.bodies.tolist() == inside


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_proximities_exactly_at_the_distance_need_no_checker(dtype, monkeypatch):
    """Sheets one above the other, at the distance and at its neighbours in floating point, in the scale of each."""
    x, faces = copies(2, 3, dtype)
    x[len(x) // 2 :, 2] = dtype(0.01)
    mesh = bsc.CollisionMesh(faces, len(x))
    height = float(x[-1, 2])
    truth = {}
    for distance in (np.nextafter(height, 0.0), height, np.nextafter(height, 1.0)):
        rows = np.indices((len(x), len(faces))).reshape(2, -1).T
        rows = rows[rows[:, 0] // (len(x) // 2) != rows[:, 1] // (len(faces) // 2)]  # not of the same sheet
        points = np.concatenate([x[rows[:, 0], None], x[faces[rows[:, 1]]]], axis=1)
        truth[distance] = rows[checker.vertex_face(np.concatenate([points, points], axis=1), distance)]
    for kind in ("vertex_face", "edge_edge"):
        monkeypatch.setattr(checker, kind, lambda *_: pytest.fail("the host has decided a pair"))
    for distance, expected in truth.items():
        found = bsc.CollisionDetector(mesh).find_proximities(x, distance, rings=9)
        np.testing.assert_array_equal(found.vertex_face, expected)
    assert len({len(expected) for expected in truth.values()}) > 1
