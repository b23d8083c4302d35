"""Proximities against all pairs in NumPy, and distances against rational arithmetic."""

from fractions import Fraction

import numpy as np
import pytest
import warp as wp
from distances import squared_distances
from sheets import crumpled

import warp_bsc as bsc
from warp_bsc.detection.at_rest import proximities
from warp_bsc.detection.at_rest.proximities import ProximityFinder
from warp_bsc.detection.broad.broad_phase_hierarchy import BroadPhaseHierarchy
from warp_bsc.detection.broad.broad_phase_simd import BroadPhaseSimd
from warp_bsc.kernels.distance import closest_points
from warp_bsc.kernels.polynomials import EDGE_EDGE, VERTEX_FACE

KINDS = {"vertex_face": int(VERTEX_FACE), "edge_edge": int(EDGE_EDGE)}


@wp.kernel(enable_backward=False, module="unique")
def find_distances(
    kind: int, u: wp.array[wp.vec3d], v: wp.array[wp.vec3d], w: wp.array[wp.vec3d], found: wp.array2d[wp.float64]
):
    i = wp.tid()
    coordinates, distance, error = closest_points(kind, u[i], v[i], w[i])
    found[i, 0] = coordinates[0]
    found[i, 1] = coordinates[1]
    found[i, 2] = distance
    found[i, 3] = error


def hard_cases(rng, n):
    """Slivers, nearly parallel edges, collapsed and touching ones, near and far, at all scales."""
    u, v, w = rng.standard_normal((3, n, 3))
    angle = 10.0 ** rng.uniform(-17, 0, (n, 1)) * rng.choice([0, 1, 1, 1], (n, 1))
    v = rng.choice([-1, 1], (n, 1)) * u * rng.uniform(0, 2, (n, 1)) + angle * v
    s, r = rng.choice([0, 1, 0.5, 0.25, 1.5], (2, n, 1))
    normal = np.cross(u, v)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    height = 10.0 ** rng.uniform(-17, 3, (n, 1)) * rng.choice([0, 1, 1], (n, 1))
    w = np.where(rng.uniform(size=(n, 1)) < 0.8, s * u + rng.choice([-1, 1]) * r * v + height * normal, w)
    u[::17], v[::19], w[::23] = 0, 0, 0
    scale = 10.0 ** rng.integers(-140, 140, (n, 1)).astype(float)
    return u * scale, v * scale, w * scale


@pytest.mark.parametrize("kind", KINDS)
def test_distances_are_within_their_bound(kind):
    u, v, w = hard_cases(np.random.default_rng(3), 3000)
    arrays = [wp.array(x, dtype=wp.vec3d) for x in (u, v, w)]
    found = wp.zeros((len(u), 4), dtype=wp.float64)
    wp.launch(find_distances, len(u), inputs=[KINDS[kind], *arrays], outputs=[found])
    found = found.numpy()
    assert ((found[:, :2] >= 0) & (found[:, :2] <= 1)).all()
    exact = [np.vectorize(Fraction, otypes=[object])(x) for x in (u, v, w)]
    squares = squared_distances(kind, *exact)
    sizes = np.abs([u, v, w]).max(axis=(0, 2))
    np.testing.assert_allclose(found[:, 3], sizes * 2.0**-40, rtol=1e-15)
    for distance, error, square in zip(*found.T[2:].tolist(), squares.tolist(), strict=True):
        # a tenth of the bound is not reached, so that a loss of accuracy shows here before a pair is missed
        computed, tenth = Fraction(distance), Fraction(error) / 10
        assert max(computed - tenth, 0) ** 2 <= square <= (computed + tenth) ** 2


def all_near(mesh, x, distance):
    """Pairs of both kinds that are near, by comparing all, as dictionaries of distances."""
    neighbours = {(a, b) for edge in mesh.edges.tolist() for a, b in (edge, edge[::-1])}
    neighbours |= {(vertex, vertex) for vertex in range(mesh.vertex_count)}
    joined = np.zeros((mesh.vertex_count,) * 2, dtype=bool)
    joined[tuple(np.array(sorted(neighbours)).T)] = True
    x = x.astype(np.float64)
    near = []
    for kind, elements, firsts in (
        ("vertex_face", mesh.faces, mesh.vertices[:, None]),
        ("edge_edge", mesh.edges, mesh.edges),
    ):
        i, j = (index.ravel() for index in np.indices((len(firsts), len(elements))))
        first, second = firsts[i], elements[j]
        apart = ~joined[first[:, :, None], second[:, None, :]].any(axis=(1, 2))
        if mesh.world is not None:
            apart &= mesh.world[first[:, 0]] == mesh.world[second[:, 0]]
        if kind == "edge_edge":
            apart &= i < j
        i, j, first, second = i[apart], j[apart], x[first[apart]], x[second[apart]]
        if kind == "edge_edge":
            u, v, w = first[:, 1] - first[:, 0], second[:, 1] - second[:, 0], second[:, 0] - first[:, 0]
        else:
            u, v, w = second[:, 1] - second[:, 0], second[:, 2] - second[:, 0], first[:, 0] - second[:, 0]
            i = mesh.vertices[i]
        distances = np.sqrt(squared_distances(kind, u, v, w))
        kept = distances <= distance
        near.append(
            {pair: d for *pair, d in zip(i[kept], j[kept], distances[kept], strict=True) for pair in [tuple(pair)]}
        )
    return near


@pytest.mark.parametrize("broad_phase", [BroadPhaseSimd, BroadPhaseHierarchy])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("distance", [0.0004, 0.004, 0.03])
def test_all_near_pairs_are_found(monkeypatch, broad_phase, dtype, distance):
    if broad_phase is BroadPhaseSimd and wp.get_device().is_cuda:
        pytest.skip("SIMD packets are for the CPU")
    monkeypatch.setattr(proximities, "make_broad_phase", broad_phase)
    _, x, faces = crumpled(1, n=6)
    x = x.astype(dtype) + np.asarray([100.0, 0.0, 0.0], dtype)  # where single precision is coarse
    world = np.repeat([4, 2], len(x))
    mesh = bsc.CollisionMesh(np.concatenate([faces, faces + len(x)]), 2 * len(x), world=world)
    finder = ProximityFinder(mesh, distance)
    for offset in (0.0, 0.01):
        both = np.concatenate([x, x + np.asarray([0, 0, offset], dtype)])
        found = finder.find(both)
        vertex_face, edge_edge = all_near(mesh, both, distance)
        assert [tuple(pair) for pair in found.vertex_face.tolist()] == sorted(vertex_face)
        assert [tuple(pair) for pair in found.edge_edge.tolist()] == sorted(edge_edge)
        expected = [of[pair] for of in (vertex_face, edge_edge) for pair in sorted(of)]
        np.testing.assert_allclose(found.distance, expected, rtol=0, atol=1e-14)
        assert len(expected) > 5 or distance < 0.001


def test_touching_boxes_and_a_distance_that_is_exactly_the_limit():
    faces = [[0, 1, 2], [3, 4, 5]]
    x = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.25, 0.25, 0.1], [2, 2, 1], [2, 1, 1]], dtype=np.float32)
    mesh = bsc.CollisionMesh(faces, 6)
    limit = float(np.float32(0.1))
    found = ProximityFinder(mesh, limit).find(x)
    assert found.vertex_face.tolist() == [[3, 0]] and found.distance[0] == pytest.approx(limit, rel=1e-15)
    np.testing.assert_allclose(found.position[0], [0.25, 0.25, limit / 2], atol=1e-15)
    assert len(ProximityFinder(mesh, limit - 1e-9).find(x).distance) == 0


def test_a_distance_that_single_precision_would_round_down():
    below, above = -(2.0**-25), 1.0
    x = [[0, 0, below], [2, 0, below], [0, 2, below], [0.5, 0.5, above], [3, 3, 2], [3, 2, 2]]
    mesh = bsc.CollisionMesh([[0, 1, 2], [3, 4, 5]], 6)
    assert float(np.float32((above - below) / 2)) < (above - below) / 2
    found = ProximityFinder(mesh, above - below).find(np.array(x, np.float32))
    assert found.vertex_face.tolist() == [[3, 0]]


def test_nothing_to_find_and_what_cannot_be():
    mesh = bsc.CollisionMesh([], 0)
    assert len(ProximityFinder(mesh, 1.0).find(np.zeros((0, 3))).distance) == 0
    for distance in (0.0, -1.0, np.inf, np.nan):
        with pytest.raises(ValueError, match="distance"):
            ProximityFinder(mesh, distance)
    mesh = bsc.CollisionMesh([[0, 1, 2]], 3)
    with pytest.raises(ValueError, match="not finite"):
        ProximityFinder(mesh, 1.0).find(np.full((3, 3), np.nan))
    with pytest.raises(ValueError, match="at most 2\\^1000"):
        ProximityFinder(mesh, 1.0).find(np.full((3, 3), 1e305))
    with pytest.raises(ValueError, match="distance must be in the range"):
        ProximityFinder(mesh, 1e39).find(np.zeros((3, 3), np.float32))
