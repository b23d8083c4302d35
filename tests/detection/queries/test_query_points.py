"""The points of pairs as rows of elementary queries."""

import numpy as np
import pytest

import warp_bsc as bsc

FACES = np.array([[0, 1, 2], [1, 3, 2]], dtype=np.int32)
EDGES = np.array([[0, 1], [2, 3], [1, 2]], dtype=np.int32)
X0 = np.arange(12, dtype=np.float32).reshape(4, 3)
X1 = X0 + 100


def test_a_vertex_and_a_face():
    rows = bsc.query_points(FACES, np.array([[3, 0], [0, 1]]), X0, X1)
    assert rows.dtype == np.float32
    order = [[3, 0, 1, 2], [0, 1, 3, 2]]
    np.testing.assert_array_equal(rows, np.concatenate([X0[order], X1[order]], axis=1))


def test_two_edges():
    rows = bsc.query_points(EDGES, np.array([[1, 0], [0, 2]]), X0, X1, kind="edge_edge")
    order = [[2, 3, 0, 1], [0, 1, 1, 2]]
    np.testing.assert_array_equal(rows, np.concatenate([X0[order], X1[order]], axis=1))


@pytest.mark.parametrize("elements", [FACES, EDGES], ids=["faces", "edges"])
def test_no_pair(elements):
    assert bsc.query_points(elements, np.zeros((0, 2), dtype=np.int32), X0, X1).shape == (0, 8, 3)


@pytest.mark.parametrize("elements", [np.zeros((2, 4), dtype=np.int32), np.zeros(3, dtype=np.int32)])
def test_elements_that_are_neither_faces_nor_edges(elements):
    with pytest.raises(ValueError, match=r"elements must have shape \(n, 3\) for faces or \(n, 2\) for edges"):
        bsc.query_points(elements, np.zeros((1, 2), dtype=np.int32), X0, X1)


def test_pairs_with_points_have_rows_of_their_own():
    """A point near an edge, and two points: the rows of a detection collide by the exact checker at its distance."""
    x0 = [[0, 0, 0], [4, 0, 0], [1, 3, 0], [2, 3, 1], [9, 9, 9]]
    x1 = [[0, 0, 0], [4, 0, 0], [1, 0, 0], [1, 0, 1], [9, 9, 9]]
    mesh = bsc.CollisionMesh([], 5, edges=[[0, 1]], points=[2, 3, 4], device="cpu")
    found = bsc.CollisionDetector(mesh, min_distance=1.0, method="exact").detect(x0, x1)
    assert found.vertex_edge.tolist() == [[2, 0], [3, 0]] and found.vertex_vertex.tolist() == [[2, 3]]
    edges = bsc.query_points(mesh.edges, found.vertex_edge, x0, x1, kind="vertex_edge")
    points = bsc.query_points(None, found.vertex_vertex, x0, x1)
    np.testing.assert_array_equal(edges, np.array([[x[i] for x in (x0, x1) for i in (j, 0, 1)] for j in (2, 3)]))
    np.testing.assert_array_equal(points, [[x0[2], x0[3], x1[2], x1[3]]])
    assert bsc.checker.vertex_edge(edges, 1.0).all() and bsc.checker.vertex_vertex(points, 1.0).all()
    assert not bsc.checker.vertex_edge(edges[1:], 0.999).any()


def test_pairs_that_are_none_of_edges_need_a_kind():
    for pairs in ([[0, 0]], [[0, 1], [1, 0]], [[0, 1], [0, 2]]):
        with pytest.raises(ValueError, match=rf"pairs\[{len(pairs) - 1}\].* is no pair of edges of a detector"):
            bsc.query_points(EDGES, pairs, X0, X1)
    with pytest.raises(ValueError, match="kind must be of elements with 2 vertices, not vertex_face"):
        bsc.query_points(EDGES, [[0, 1]], X0, X1, kind="vertex_face")
