"""Gradients of the times at which pairs come within their minimum distance, against the exact checker."""

import numpy as np
import pytest
import warp as wp
from test_detector_min_distance import scene

import warp_bsc as bsc
from warp_bsc import checker
from warp_bsc.detection.narrow.on_host import pair_distances
from warp_bsc.detection.run.settings import PairKind


def detect(device, method="conservative"):
    """Collisions with a minimum distance on a tape, with the mesh, the radii, and the positions at both ends."""
    arguments, radius, x0, x1 = scene(np.float64)
    radius = radius + 2e-4
    mesh = bsc.CollisionMesh(**arguments, radius=radius, device=device)
    positions = [wp.array(x, dtype=wp.vec3d, requires_grad=True, device=device) for x in (x0, x1)]
    with wp.Tape() as tape:
        collisions = bsc.CollisionDetector(mesh, method=method).detect(*positions)
    return collisions, tape, mesh, radius, positions


def test_gradients_are_those_of_central_differences_of_the_exact_times(device):
    """Of vertices and faces, edges, vertices and edges, and vertices; random directions of all points of a pair."""
    collisions, tape, mesh, radius, positions = detect(device)
    x = np.stack([array.numpy() for array in positions])
    rng = np.random.default_rng(3)
    checked = 0
    for kind in PairKind:
        pairs, toi = getattr(collisions, kind.label), getattr(collisions.arrays, f"{kind.label}_toi")
        grazing = getattr(collisions.arrays, f"{kind.label}_grazing").numpy()
        np.testing.assert_array_equal(toi.numpy(), getattr(collisions, f"{kind.label}_toi"))
        np.testing.assert_array_equal(grazing, toi.numpy() == 0.0)  # these are within their distance from the start
        elements = mesh.faces if kind == PairKind.VERTEX_FACE else mesh.edges
        corners, distances = pair_distances(kind, elements, pairs, radius)
        for i in rng.permutation(np.flatnonzero(~grazing))[:12]:
            tape.zero()
            toi.grad.assign(np.arange(len(pairs)) == i)
            tape.backward()
            gradient = np.stack([array.grad.numpy() for array in positions])
            direction = 2e-3 * rng.standard_normal(gradient.shape)
            step = 1e-5
            times = []
            for sign in (1.0, -1.0):
                points = (x + sign * step * direction)[:, corners[i]].reshape(1, -1, 3)
                times.append(getattr(checker, f"{kind.label}_toi")(points, distances[i])[0].mean())
            expected = (times[0] - times[1]) / (2.0 * step)
            scale = 2e-3 * np.abs(gradient).max()
            np.testing.assert_allclose((gradient * direction).sum(), expected, rtol=1e-6, atol=1e-7 * scale)
            checked += 1
    assert checked > 24


def test_pairs_that_start_within_their_distance_have_none(device):
    """Their time is 0 whatever the points; coordinates and normals have no gradients at all."""
    collisions, tape, _mesh, _radius, positions = detect(device, "exact")
    for kind in PairKind:
        grazing = getattr(collisions.arrays, f"{kind.label}_grazing").numpy()
        assert grazing.any()
        getattr(collisions.arrays, f"{kind.label}_toi").grad.assign(grazing.astype(float))
        for name in ("normal", "coordinates") if kind != PairKind.VERTEX_VERTEX else ("normal",):
            array = getattr(collisions.arrays, f"{kind.label}_{name}")
            np.testing.assert_array_equal(array.numpy(), getattr(collisions, f"{kind.label}_{name}"))
            assert not array.requires_grad
    tape.backward()
    assert all(not array.grad.numpy().any() for array in positions)


def test_gradients_in_a_graph_are_those_without(device):
    if not device.is_cuda:
        pytest.skip("a graph on a CPU captures no gradients, and says so")
    arguments, radius, x0, x1 = scene(np.float32)
    mesh = bsc.CollisionMesh(**arguments, radius=radius, device=device)
    detector = bsc.CollisionDetector(mesh, method="conservative")
    positions = [wp.array(x, dtype=wp.vec3, requires_grad=True, device=device) for x in (x0, x1)]
    gradients = []
    for captures in (False, True):
        tape = wp.Tape()
        if captures:
            with wp.ScopedCapture(device) as capture, tape:
                collisions = detector.capture(*positions)
            wp.capture_launch(capture.graph)
        else:
            with tape:
                collisions = detector.detect(*positions)
        for kind in PairKind:
            getattr(collisions.arrays, f"{kind.label}_toi").grad.fill_(1.0)
        tape.backward()
        gradients.append([array.grad.numpy() for array in positions])
        tape.zero()
    np.testing.assert_allclose(gradients[1], gradients[0], rtol=1e-5, atol=1e-5 * np.abs(gradients[0]).max())
