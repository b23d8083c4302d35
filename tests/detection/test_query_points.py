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
    rows = bsc.query_points(EDGES, np.array([[1, 0], [0, 2]]), X0, X1)
    order = [[2, 3, 0, 1], [0, 1, 1, 2]]
    np.testing.assert_array_equal(rows, np.concatenate([X0[order], X1[order]], axis=1))


@pytest.mark.parametrize("elements", [FACES, EDGES], ids=["faces", "edges"])
def test_no_pair(elements):
    assert bsc.query_points(elements, np.zeros((0, 2), dtype=np.int32), X0, X1).shape == (0, 8, 3)


@pytest.mark.parametrize("elements", [np.zeros((2, 4), dtype=np.int32), np.zeros(3, dtype=np.int32)])
def test_elements_that_are_neither_faces_nor_edges(elements):
    with pytest.raises(ValueError, match=r"elements must have shape \(n, 3\) for faces or \(n, 2\) for edges"):
        bsc.query_points(elements, np.zeros((1, 2), dtype=np.int32), X0, X1)
