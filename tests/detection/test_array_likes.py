"""Lists and tuples are as good as arrays, for the code and for pyright, which checks this file."""

import numpy as np

import warp_bsc as bsc

X0 = [[0, 0, 0], [4, 0, 0], [0, 4, 0], [1, 1, 1], [2, 1, 2]]
X1 = [[0, 0, 0], [4, 0, 0], [0, 4, 0], [1, 1, -3], [2, 1, 2]]


def test_lists_of_whole_numbers_are_positions(device):
    mesh = bsc.CollisionMesh([(0, 1, 2)], 5, points=[3], edges=[[3, 4]], world=[0] * 5, group=[1] * 5, device=device)
    detector = bsc.CollisionDetector(mesh, min_distance=0.5)
    found, expected = detector.detect(X0, X1), detector.detect(np.array(X0, float), np.array(X1, float))
    assert found.vertex_face.tolist() == [[3, 0]]
    assert found.vertex_face_toi[0] == expected.vertex_face_toi[0]
    assert len(detector.detect(X0, X1, vertices=[False] * 4 + [True])) <= len(found)
    assert detector.has_intersections(X1) and detector.least_distance(X0) == 1.0
    assert detector.collision_free_step(X0, X1).certified and len(detector.candidates(X0, X1)) > 0
    assert detector.find_proximities(X0, 1.5).vertex_face.tolist() == [[3, 0]]


def test_lists_are_rows_and_bodies(device):
    arcs = bsc.RigidMotion([0, 0, 0, -1, -1], [(0, 0, 0)], [[0.0, 0.0, 1.0]])
    assert arcs.positions(X0, X0, 1).tolist() == X0
    rows = bsc.query_points([[0, 1, 2]], [(3, 0)], X0, X1)
    assert bsc.query_vertex_face(rows.tolist(), device=device).hit.all()
    assert bsc.distances([X0[:2]], "vertex_vertex", device=device).tolist() == [4.0]
    group, _mask = bsc.leave_out([0, 0, 0, 1, 1], [(0, 1)])
    assert group.tolist() == [2, 2, 2, 4, 4]
