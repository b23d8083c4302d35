"""The order of faces: every face once, clusters that are compact patches, components and worlds apart."""

import numpy as np
import pytest
from sheets import grid

from warp_bsc.detection.face_order import CLUSTER, order_faces


def assert_every_face_once(order, faces):
    assert len(order) % CLUSTER == 0 and len(order) <= 4 * len(faces) + CLUSTER
    assert sorted(order[order >= 0].tolist()) == list(range(len(faces)))
    assert (order[order < 0] == -1).all()


def cluster_boxes(order, x, faces):
    """Lowest and highest coordinates of the clusters."""
    low = np.where(order[:, None] >= 0, x[faces].min(axis=1)[order], np.inf)
    high = np.where(order[:, None] >= 0, x[faces].max(axis=1)[order], -np.inf)
    return low.reshape(-1, CLUSTER, 3).min(axis=1), high.reshape(-1, CLUSTER, 3).max(axis=1)


@pytest.mark.parametrize("n", [50, 130])
@pytest.mark.parametrize("shuffled", [False, True])
def test_clusters_of_a_sheet_are_round(n, shuffled):
    """Squares of 4 x 4 quads would fill the sheet without overlap, and each would touch 8 others."""
    x, faces = grid(n, np.float64)
    if shuffled:
        faces = np.random.default_rng(0).permutation(faces)
    order = order_faces(faces.astype(np.int32))
    assert_every_face_once(order, faces)
    assert len(order) - len(faces) < CLUSTER
    low, high = cluster_boxes(order, x, faces)
    areas = np.prod((high - low)[:, :2], axis=1)
    assert areas.sum() < 2.0 * (0.01 * n) ** 2
    meeting = ((low[:, None] <= high) & (low <= high[:, None])).all(axis=2).sum(axis=1)
    assert meeting.mean() < 10.0


def test_clusters_of_a_long_strip_are_short():
    n = 3000
    columns = np.arange(n)
    a = 2 * columns[:, None] + np.array([[0, 1, 2]])
    b = 2 * columns[:, None] + np.array([[1, 3, 2]])
    faces = np.concatenate([a, b])
    x = np.stack(np.broadcast_arrays(np.arange(n + 1)[:, None], np.arange(2), 0.0), axis=-1).reshape(-1, 3)
    low, high = cluster_boxes(order_faces(faces.astype(np.int32)), x, faces)
    assert (high - low)[:, 0].max() <= 18.0


def test_components_have_clusters_of_their_own():
    """Sheets of 8 to 200 faces far apart; of smaller ones several share a cluster."""
    sheets, x, offset = [], [], 0
    for i, n in enumerate([2, 3, 5, 10] * 5):
        positions, faces = grid(n, np.float64)
        sheets.append(faces + offset)
        x.append(positions + 10.0 * i)
        offset += len(positions)
    faces, x = np.concatenate(sheets), np.concatenate(x)
    faces = np.random.default_rng(1).permutation(faces)
    order = order_faces(faces.astype(np.int32))
    assert_every_face_once(order, faces)
    low, high = cluster_boxes(order, x, faces)
    assert (high - low).max() <= 0.1 + 1e-9
    separate = np.arange(3 * 1000, dtype=np.int32).reshape(-1, 3)
    assert len(order_faces(separate)) == 1024


def test_worlds_follow_one_another():
    _, faces = grid(4)
    faces = np.concatenate([faces + 25 * i for i in range(9)])
    world = np.repeat([3, 1, 2, 1, 0, 5, 4, 3, 3], 32)
    order = order_faces(faces.astype(np.int32), world)
    assert_every_face_once(order, faces)
    assert (np.diff(world[order[order >= 0]]) >= 0).all()


@pytest.mark.parametrize(
    "faces",
    [
        np.empty((0, 3)),
        [[0, 1, 2]],
        [[0, 0, 0]],
        [[0, 1, 2]] * 100,  # all linked in a chain
        [[0, 1, 1]] * 40 + [[1, 0, 2]] * 40,
        np.random.default_rng(0).integers(0, 40, (500, 3)),
        np.column_stack([np.zeros(5000), np.ones(5000), np.arange(2, 5002)]),  # an edge of 5,000 faces
        np.column_stack([np.zeros(5000), np.arange(1, 5001), np.arange(2, 5002)]),  # a fan
    ],
    ids=["none", "one", "point", "same", "degenerate", "soup", "star", "fan"],
)
def test_any_faces_have_an_order(faces):
    faces = np.asarray(faces, dtype=np.int32)
    order = order_faces(faces)
    assert order.dtype == np.int32
    assert_every_face_once(order, faces)
