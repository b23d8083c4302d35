"""Buffers of results: kept while somebody holds a result, and used again afterwards."""

import copy
import gc
import weakref

import numpy as np
import pytest
import warp as wp
from collision_results import assert_same
from sheets import crumpled, grid

import warp_bsc as bsc
from warp_bsc.detection.narrow.contact_buffer import ContactBuffer

METHODS = ("float", "conservative", "exact")


def test_results_that_someone_holds_outlive_the_next_detection():
    x0, x1, faces = crumpled(0)
    detector = bsc.CollisionDetector(bsc.CollisionMesh(faces, len(x0)))
    held = [detector.detect(x0, x1), detector.detect(x0, x0), detector.detect(x0, x1)]
    detector.find_intersections(x1)
    assert len(held[1].edge_edge) == 0
    assert_same(held[0], held[2])


def buffers_of(c):
    """The buffers that a result owns, one for each kind of pair."""
    return [rows.buffer for rows in c._rows.values()]


def buffer_addresses(c):
    """Addresses of all arrays that a result owns on the device."""
    return {getattr(buffer, name).ptr for buffer in buffers_of(c) for name in ContactBuffer.vars}


@pytest.mark.parametrize("keep", [lambda c: c, copy.copy, lambda c: [c, c.vertex_face]], ids=["kept", "copied", "read"])
def test_buffers_of_a_result_that_someone_holds_are_not_used_again(keep):
    x0, x1, faces = crumpled(0)
    detector = bsc.CollisionDetector(bsc.CollisionMesh(faces, len(x0)))
    expected = bsc.CollisionDetector(detector.mesh).detect(x0, x1)
    addresses, kept = set(), []
    for i in range(6):
        c = detector.detect(x0, x1)
        assert not addresses & buffer_addresses(c)
        addresses |= buffer_addresses(c)
        kept.append(keep(c))
        detector.detect(x1, x0 + np.float32(0.001 * i))  # other collisions, in buffers that are free at once
    for c in kept:
        assert_same(c[0] if isinstance(c, list) else c, expected)


@pytest.mark.parametrize("collected", [False, True], ids=["dropped", "in a cycle"])
def test_buffers_of_results_that_are_garbage_are_used_again(collected):
    x0, x1, faces = crumpled(0)
    detector = bsc.CollisionDetector(bsc.CollisionMesh(faces, len(x0)))
    seen = []
    for _ in range(4 if collected else 100):  # collecting garbage takes long
        c = detector.detect(x0, x1)
        assert len(c.vertex_face) and len(c.edge_edge)
        seen.append(buffer_addresses(c))
        if collected:
            cycle = [c]
            cycle.append(cycle)
            del c, cycle
            gc.collect()
    assert seen[2] == seen[0]  # the second detection still holds the first result
    arrays = 2 * len(seen[0]) if not collected else len(seen[0])
    assert len(set.union(*seen)) == arrays


def test_buffers_with_too_few_rows_are_not_used_again():
    x0, x1, faces = crumpled(0)
    detector = bsc.CollisionDetector(bsc.CollisionMesh(faces, len(x0)))
    expected = detector.detect(x0, x1)
    assert len(expected.edge_edge) > 64
    for _ in range(3):
        assert len(detector.detect(x0, x0).edge_edge) == 0
        assert_same(detector.detect(x0, x1), expected)


def test_many_results_dropped_at_once_leave_few_buffers():
    x0, x1, faces = crumpled(0)
    detector = bsc.CollisionDetector(bsc.CollisionMesh(faces, len(x0)))
    results = [detector.detect(x0, x1) for _ in range(8)]
    addresses = [buffer_addresses(c) for c in results]
    pairs = [weakref.ref(buffer.pairs) for c in results for buffer in buffers_of(c)]
    results.clear()
    assert sum(array() is not None for array in pairs) <= 4
    again = [detector.detect(x0, x1) for _ in range(8)]
    reused = set.union(*addresses) & set.union(*(buffer_addresses(c) for c in again))
    assert len(reused) >= 2 * len(addresses[0])


def test_buffers_of_differentiable_results_stay_theirs(device):
    x0, x1, faces = crumpled(0)
    detector = bsc.CollisionDetector(bsc.CollisionMesh(faces, len(x0)))
    start = wp.array(x0, dtype=wp.vec3, device=device, requires_grad=True)
    end = wp.array(x1, dtype=wp.vec3, device=device)
    arrays = detector.detect(start, end).arrays
    pairs = arrays.edge_edge.numpy().copy()
    for _ in range(3):
        detector.detect(x1, x0)
    assert len(pairs) and np.array_equal(arrays.edge_edge.numpy(), pairs)


@pytest.mark.parametrize("method", METHODS)
def test_results_are_of_the_positions_detected_whatever_becomes_of_these(method):
    positions, faces = grid(2, np.float64)
    positions = np.concatenate([positions, [[0.005, 0.005, 0.01], [0.006, 0.005, 0.02], [0.005, 0.006, 0.02]]])
    end = positions.copy()
    end[9, 2] = 0.0  # ends on an edge and on a corner of faces: for exact arithmetic to decide
    mesh = bsc.CollisionMesh(np.concatenate([faces, [[9, 10, 11]]]), 12)
    detector = bsc.CollisionDetector(mesh, method=method)
    expected = detector.detect(positions, end)
    x0, x1 = (wp.array(x, dtype=wp.vec3d, device=mesh.device) for x in (positions, end))
    c = detector.detect(x0, x1)
    x1.assign(positions)
    assert len(c.vertex_face)
    assert_same(c, expected)
