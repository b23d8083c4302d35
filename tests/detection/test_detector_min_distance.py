"""Detection with a minimum distance, radii, edges and points, against all pairs and the exact checker."""

import numpy as np
import pytest
import warp as wp
from sheets import crumpled, grid

import warp_bsc as bsc
from warp_bsc import checker
from warp_bsc.detection import pipeline
from warp_bsc.detection.at_rest import intersections
from warp_bsc.detection.broad.broad_phase_hierarchy import BroadPhaseHierarchy
from warp_bsc.detection.broad.broad_phase_simd import BroadPhaseSimd
from warp_bsc.detection.narrow.on_host import pair_distances
from warp_bsc.detection.narrow.rings import make_rings
from warp_bsc.detection.run.settings import PairKind


def scene(dtype, seed=1):
    """A crumpled sheet, a rope and loose points above it, all of it moving: mesh arguments and positions."""
    rng = np.random.default_rng(seed)
    x0, x1, faces = crumpled(seed, n=5)
    n, rope, points = len(x0), 8, 6
    low, high = x0.min(axis=0), x0.max(axis=0)
    more = rng.uniform(low, high, (rope + points, 3))
    more[:rope] = np.linspace(low, high, rope) + 0.002 * rng.standard_normal((rope, 3))
    more[rope:] = more[rng.integers(0, 3, points)] + 0.001 * rng.standard_normal((points, 3))
    x0 = np.concatenate([x0, more]).astype(dtype)
    x1 = np.concatenate([x1, more + 0.004 * rng.standard_normal(more.shape)]).astype(dtype)
    edges = np.stack([np.arange(rope - 1), np.arange(1, rope)], axis=1) + n
    given = np.arange(points) + n + rope
    radius = rng.choice([0.0, 0.0003, 0.001], len(x0))
    return {"faces": faces, "vertex_count": len(x0), "edges": edges, "points": given}, radius, x0, x1


def all_pairs(mesh, radius, x0, x1, rings):
    """The pairs of each kind that collide, and the bounds of their times, by comparing all."""
    joined = np.eye(mesh.vertex_count, dtype=bool)
    step = joined.copy()
    step[mesh.edges[:, 0], mesh.edges[:, 1]] = step[mesh.edges[:, 1], mesh.edges[:, 0]] = True
    for _ in range(rings):
        joined = joined @ step
    free = np.zeros(len(mesh.edges), dtype=bool)
    free[mesh.free_edges] = True
    found = {}
    for kind, firsts, seconds, elements in (
        (PairKind.VERTEX_FACE, mesh.vertices, np.arange(len(mesh.faces)), mesh.faces),
        (PairKind.EDGE_EDGE, np.arange(len(mesh.edges)), np.arange(len(mesh.edges)), mesh.edges),
        (PairKind.VERTEX_EDGE, mesh.points, mesh.free_edges, mesh.edges),
        (PairKind.VERTEX_VERTEX, mesh.points, mesh.points, mesh.edges),
    ):
        pairs = np.stack(np.meshgrid(firsts, seconds, indexing="ij"), axis=-1).reshape(-1, 2).astype(np.int32)
        if kind in (PairKind.EDGE_EDGE, PairKind.VERTEX_VERTEX):
            pairs = pairs[pairs[:, 0] < pairs[:, 1]]
        corners, distance = pair_distances(kind, elements, pairs, radius)
        first = 2 if kind == PairKind.EDGE_EDGE else 1
        apart = ~joined[corners[:, :first, None], corners[:, None, first:]].any(axis=(1, 2))
        if mesh.world is not None:
            apart &= mesh.world[corners[:, 0]] == mesh.world[corners[:, -1]]
        pairs, corners, distance = pairs[apart], corners[apart], distance[apart]
        points = np.concatenate([x0[corners], x1[corners]], axis=1)
        hit = getattr(checker, kind.label)(points, distance)
        toi = getattr(checker, f"{kind.label}_toi")(points[hit], distance[hit])
        found[kind.label] = pairs[hit], toi
    return found


def assert_same(collisions, expected, tolerance=2.0**-20):
    for label, (pairs, toi) in expected.items():
        np.testing.assert_array_equal(getattr(collisions, label), pairs, err_msg=label)
        times = getattr(collisions, f"{label}_toi")
        assert (times <= toi[:, 1]).all()
        assert (times >= toi[:, 0] - tolerance).all()


@pytest.mark.parametrize(
    ("broad_phase", "dtype", "how"),
    [
        (BroadPhaseSimd, np.float32, "distance"),
        (BroadPhaseSimd, np.float64, "both"),
        (BroadPhaseHierarchy, np.float32, "both"),
        (BroadPhaseHierarchy, np.float64, "radius"),
    ],
)
def test_all_pairs_are_found(monkeypatch, device, broad_phase, dtype, how):
    if broad_phase is BroadPhaseSimd and device.is_cuda:
        pytest.skip("SIMD packets are for the CPU")

    def make_broad_phase(mesh, count, *, padding, **_):
        return broad_phase(mesh, count, padding=padding)

    monkeypatch.setattr(pipeline, "make_broad_phase", make_broad_phase)
    arguments, radius, x0, x1 = scene(dtype)
    distance = 0.0 if how == "radius" else 0.0007
    rings = 2 if how == "both" else 1
    radius = np.zeros(len(x0)) if how == "distance" else radius
    mesh = bsc.CollisionMesh(**arguments, radius=radius)
    detector = bsc.CollisionDetector(mesh, method="exact", min_distance=distance, rings=rings)
    expected = all_pairs(mesh, radius + 0.5 * distance, x0, x1, rings)
    if how != "radius":
        assert min(len(pairs) for pairs, _ in expected.values()) > 0
    collisions = detector.detect(x0, x1)
    assert collisions.certified
    assert_same(collisions, expected)
    assert_same(detector.detect(x0, x1), expected)  # with the trees of the run before
    assert collisions.earliest_toi == min(getattr(collisions, f"{label}_toi").min(initial=2.0) for label in expected)


@pytest.mark.parametrize("broad_phase", [BroadPhaseSimd, BroadPhaseHierarchy])
def test_only_pairs_with_what_no_face_has(monkeypatch, device, broad_phase):
    """A rope tied to the cloth, a string between two of its vertices, and points; pairs of the cloth are left out."""
    if broad_phase is BroadPhaseSimd and device.is_cuda:
        pytest.skip("SIMD packets are for the CPU")

    def make_broad_phase(mesh, count, *, padding=None, **_):
        return broad_phase(mesh, count, padding=padding)

    for module in (pipeline, intersections):
        monkeypatch.setattr(module, "make_broad_phase", make_broad_phase)
    arguments, radius, x0, x1 = scene(np.float32)
    arguments["edges"] = np.concatenate([arguments["edges"], [[2, arguments["edges"][0, 0]], [1, 30]]])
    meshes = [bsc.CollisionMesh(**arguments, radius=radius, only_free=only_free) for only_free in (False, True)]
    mesh = meshes[0]
    everything, found = (bsc.CollisionDetector(one, method="exact", min_distance=0.0007) for one in meshes)
    for start, end in ((x0, x1), (x1, x0)):
        whole, part = everything.detect(start, end), found.detect(start, end)
        is_free = ~np.isin(whole.vertex_face[:, 0], mesh.faces)
        np.testing.assert_array_equal(part.vertex_face, whole.vertex_face[is_free])
        is_free = np.isin(whole.edge_edge, mesh.free_edges).any(axis=1)
        np.testing.assert_array_equal(part.edge_edge, whole.edge_edge[is_free])
        assert 0 < len(part.edge_edge) < len(whole.edge_edge) and 0 < len(part.vertex_face) < len(whole.vertex_face)
        assert part.stats.edge_edge.candidates < whole.stats.edge_edge.candidates
        for label in ("vertex_edge", "vertex_vertex"):
            np.testing.assert_array_equal(getattr(part, label), getattr(whole, label))
        mixed = np.random.default_rng(0).permutation(end)
        for x, is_end in ((end, True), (mixed, False)):
            crossing = everything.find_intersections(x)
            of_free = crossing[np.isin(crossing[:, 0], mesh.free_edges)]
            assert 0 < len(of_free) <= len(crossing) - (not is_end)
            np.testing.assert_array_equal(found.find_intersections(x), of_free)
            np.testing.assert_array_equal(found.intersection_finder().find(x, is_end=is_end).pairs, of_free)


def test_method_conservative_misses_nothing():
    arguments, radius, x0, x1 = scene(np.float32, seed=2)
    mesh = bsc.CollisionMesh(**arguments, radius=radius)
    exact = bsc.CollisionDetector(mesh, method="exact", min_distance=0.0007).detect(x0, x1)
    conservative = bsc.CollisionDetector(mesh, min_distance=0.0007).detect(x0, x1)
    for label in ("vertex_face", "edge_edge", "vertex_edge", "vertex_vertex"):
        found, certain = (set(map(tuple, getattr(c, label).tolist())) for c in (conservative, exact))
        stats = getattr(conservative.stats, label)
        assert certain <= found
        assert len(found) == stats.hits + stats.unsure
        assert len(found - certain) <= stats.unsure <= 2
    assert conservative.certified


@pytest.mark.parametrize("shear", [0.0, 0.5])
def test_flat_cloth_at_rest_has_no_hit(shear):
    """Below half of its shortest edge; nor has it one as it turns, or moves in its plane."""
    x, faces = grid(12)
    x[:, 0] += np.float32(shear) * x[:, 1]
    mesh = bsc.CollisionMesh(faces, len(x))
    shortest = np.linalg.norm(np.diff(x[mesh.edges], axis=1)[:, 0], axis=1).min()
    detector = bsc.CollisionDetector(mesh, min_distance=0.4 * float(shortest))
    turned = x[:, [1, 2, 0]]
    for end in (x, x + np.float32(0.013), turned):
        collisions = detector.detect(x, end)
        assert len(collisions.vertex_face) + len(collisions.edge_edge) == 0
        assert collisions.stats.vertex_face.unsure + collisions.stats.edge_edge.unsure == 0


def test_neighbours_are_excluded_by_rings():
    """A straight strand of five edges of 1: the distance of two of its edges is the number of edges between."""
    x = np.stack([np.arange(6.0), np.zeros(6), np.zeros(6)], axis=1)
    edges = np.stack([np.arange(5), np.arange(1, 6)], axis=1)
    mesh = bsc.CollisionMesh([], 6, edges=edges)
    for rings, least in ((0, 2), (1, 3), (2, 4), (3, 5)):
        for distance in (1.0, 2.0, 3.0):
            found = bsc.CollisionDetector(mesh, method="exact", min_distance=distance, rings=rings).detect(x, x)
            expected = [[i, j] for i in range(5) for j in range(i + least, 5) if j - i - 1 <= distance]
            assert found.edge_edge.tolist() == expected


def test_worlds_are_apart():
    x = np.zeros((4, 3))
    mesh = bsc.CollisionMesh([], 4, points=np.arange(4), world=[0, 1, 0, 1])
    found = bsc.CollisionDetector(mesh, min_distance=1.0).detect(x, x)
    assert found.vertex_vertex.tolist() == [[0, 2], [1, 3]]
    assert found.vertex_vertex_toi.tolist() == [0.0, 0.0]


def test_radii_of_elements_are_the_largest_of_their_vertices():
    """A point over the middle of an edge whose ends have radii 0 and 0.5, and over one of a face."""
    x = np.array([[0, 0, 0], [2, 0, 0], [1, 0, 1.0]])
    for distance, hits in ((0.5, []), (0.75, [[2, 0]])):
        mesh = bsc.CollisionMesh([], 3, edges=[[0, 1]], points=[2], radius=[0.0, 0.5, distance - 0.25])
        assert bsc.CollisionDetector(mesh, method="exact").detect(x, x).vertex_edge.tolist() == hits
    x = np.array([[0, 0, 0], [4, 0, 0], [0, 4, 0], [1, 1, 1.0]])
    mesh = bsc.CollisionMesh([[0, 1, 2]], 4, points=[3], radius=[0.0, 0.75, 0.0, 0.25])
    assert bsc.CollisionDetector(mesh, method="exact").detect(x, x).vertex_face.tolist() == [[3, 0]]


def test_distance_that_is_reached_to_the_last_bit():
    """Only exact arithmetic knows: at an end of the step on the device, in between on the host."""
    mesh = bsc.CollisionMesh([], 2, points=[0, 1])
    for start, end, host in ((7.0, 0.1, 0), (0.1, 0.1, 0), (0.1, 3.0, 0), ([-1, 0, 0.1], [2, 0, 0.1], 1)):
        x0, x1 = (np.array([np.broadcast_to([0, 0, z] if np.isscalar(z) else z, 3), np.zeros(3)]) for z in (start, end))
        for distance, hits in ((0.1, 1), (np.nextafter(0.1, 0.0), 0)):
            exact = bsc.CollisionDetector(mesh, method="exact", min_distance=distance).detect(x0, x1)
            assert len(exact.vertex_vertex) == hits
            assert (exact.stats.vertex_vertex.exact, exact.stats.vertex_vertex.host) == (1 - host, host)
            conservative = bsc.CollisionDetector(mesh, min_distance=distance).detect(x0, x1)
            assert len(conservative.vertex_vertex) == conservative.stats.vertex_vertex.unsure == 1


def test_buffers_grow():
    """More pairs than the buffers of a small mesh hold: all points at one place."""
    n = 60
    x = np.zeros((n, 3), np.float32)
    mesh = bsc.CollisionMesh([], n, points=np.arange(n))
    found = bsc.CollisionDetector(mesh, min_distance=1.0).detect(x, x)
    assert found.vertex_vertex.tolist() == [[i, j] for i in range(n) for j in range(i + 1, n)]


def test_detection_in_a_graph(device):
    arguments, _, start, end = scene(np.float32)
    mesh = bsc.CollisionMesh(**arguments)
    detector = bsc.CollisionDetector(mesh, min_distance=0.0007)
    x0, x1 = wp.array(start, dtype=wp.vec3), wp.array(start, dtype=wp.vec3)
    detector.detect(x0, wp.array(end, dtype=wp.vec3))
    with wp.ScopedCapture(device) as capture:
        captured = detector.capture(x0, x1)
    x1.assign(end)
    wp.capture_launch(capture.graph)
    replayed, expected = captured.read(), detector.detect(start, end)
    assert replayed.certified
    for name in ("vertex_face", "edge_edge", "vertex_edge", "vertex_vertex"):
        assert len(getattr(expected, name)) > 0
        for suffix in ("", "_toi", "_normal"):
            assert np.array_equal(getattr(replayed, name + suffix), getattr(expected, name + suffix))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_proximities_of_one_configuration(dtype):
    arguments, radius, x, _ = scene(dtype, seed=3)
    detector = bsc.CollisionDetector(bsc.CollisionMesh(**arguments, radius=radius))
    for distance, rings in ((0.001, 1), (0.003, 2)):
        found = detector.find_proximities(x, distance, rings=rings)
        expected = all_pairs(detector.mesh, np.full(len(x), 0.5 * distance), x, x, rings)
        for label, (pairs, _) in expected.items():
            np.testing.assert_array_equal(getattr(found, label), pairs, err_msg=label)
        assert len(found.distance) == len(found.position) == sum(len(pairs) for pairs, _ in expected.values())
        assert (found.distance <= distance * (1.0 + 2.0**-38)).all()
    assert min(len(pairs) for pairs, _ in expected.values()) > 0


def test_proximities_are_exact_to_the_last_bit():
    x = np.array([[0, 0, 0.1], [0, 0, 0], [2, 0, 0], [-1, 1, 0], [-1, -1, 0]])
    mesh = bsc.CollisionMesh([[2, 3, 4]], 5, points=[0, 1])
    detector = bsc.CollisionDetector(mesh)
    for distance, hits in ((0.1, [[0, 1]]), (np.nextafter(0.1, 0.0), [])):
        found = detector.find_proximities(x, float(distance))
        assert found.vertex_vertex.tolist() == hits
        assert found.vertex_face.tolist() == [[0, 0]] * len(hits) + [[1, 0]]


def test_elements_of_a_mesh():
    mesh = bsc.CollisionMesh([[0, 1, 2]], 9, edges=[[1, 0], [5, 4], [2, 4]], points=[8, 4, 7, 0], radius=0.5)
    assert mesh.edges.tolist() == [[0, 1], [0, 2], [1, 2], [2, 4], [4, 5]]
    assert mesh.free_edges.tolist() == [3, 4]
    assert mesh.face_edges.tolist() == [[0, 2, 1]]
    assert mesh.points.tolist() == [7, 8]
    assert mesh.vertices.tolist() == [0, 1, 2, 4, 5, 7, 8]
    assert mesh.radius.tolist() == [0.5] * 9
    assert bsc.CollisionMesh([], 1, radius=0.0).radius is None


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"edges": [[0, 9]]}, r"edges\[0\] is \[0, 9\], but the mesh has 3 vertices"),
        ({"edges": [[1, 1]]}, r"edges\[0\] has vertex 1 twice"),
        ({"edges": [[0, 1, 2]]}, r"edges must have shape \(n, 2\)"),
        ({"points": [-1]}, r"points\[0\] is -1, but the mesh has 3 vertices"),
        ({"points": [0.5]}, "points must be integers"),
        ({"radius": [1.0, 2.0]}, r"radius must be one number or have shape \(3,\)"),
        ({"radius": -1.0}, "finite and at least 0"),
        ({"edges": [[0, 1]], "world": [0, 1, 1]}, r"world must be one for an edge, but edge \[0, 1\] has \[0, 1\]"),
    ],
)
def test_bad_meshes_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        bsc.CollisionMesh([], 3, **arguments)


def test_bad_detectors_are_refused():
    mesh = bsc.CollisionMesh([[0, 1, 2]], 3)
    for distance in (-1.0, np.inf, np.nan):
        with pytest.raises(ValueError, match="finite and at least 0"):
            bsc.CollisionDetector(mesh, min_distance=distance)
    with pytest.raises(ValueError, match="at least 2"):
        bsc.CollisionDetector(mesh, min_distance=5e-324)
    with pytest.raises(ValueError, match="at most 2"):
        bsc.CollisionDetector(bsc.CollisionMesh([], 1, radius=1e308))
    with pytest.raises(ValueError, match="rings must be"):
        bsc.CollisionDetector(mesh, min_distance=1.0, rings=-1)


def test_edges_and_points_without_a_distance():
    """A strand falls across the side of a face, a point onto its inside; another strand passes through it at rest."""
    x0 = np.array([[0, 0, 0], [4, 0, 0], [0, 4, 0], [1, -1, 1], [1, 1, 1], [2, 1, 3], [1, 2, -1], [1, 2, 1]], float)
    x1 = x0.copy()
    x1[3:6, 2] -= 4.0
    mesh = bsc.CollisionMesh([[0, 1, 2]], 8, edges=[[3, 4], [6, 7]], points=[5])
    detector = bsc.CollisionDetector(mesh, method="exact")
    found = detector.detect(x0, x1)
    strand, passing = mesh.free_edges.tolist()
    side = mesh.edges.tolist().index([0, 1])
    assert found.vertex_face.tolist() == [[4, 0], [5, 0]]
    assert found.vertex_face_toi == pytest.approx([0.25, 0.75], abs=2.0**-20)
    assert found.edge_edge.tolist() == [sorted([side, strand])]
    assert len(found.vertex_edge) == len(found.vertex_vertex) == 0
    assert detector.find_intersections(x0).tolist() == [[passing, 0]]


def test_rings_are_those_of_a_search_by_breadth():
    x, faces = grid(5)
    n = len(x)
    mesh = bsc.CollisionMesh(faces, n, device="cpu")
    joined = np.eye(n, dtype=bool)
    joined[mesh.edges[:, 0], mesh.edges[:, 1]] = joined[mesh.edges[:, 1], mesh.edges[:, 0]] = True
    near = joined
    for rings in (*range(1, 12), 10**9, np.int64(40)):
        found = make_rings(mesh, rings)
        starts = found.starts.numpy()
        reached = np.eye(n, dtype=bool)
        reached[np.repeat(np.arange(n), np.diff(starts)), found.neighbours.numpy()] = True
        assert np.array_equal(reached, near if rings < 12 else np.ones((n, n)))
        near = near.astype(int) @ joined > 0


def test_rings_that_hold_too_much_are_refused_at_once():
    """One vertex in all faces: all are within two edges of each other."""
    n = 30_000
    fan = np.stack([np.zeros(n - 2, int), np.arange(1, n - 1), np.arange(2, n)], axis=1)
    mesh = bsc.CollisionMesh(fan, n, device="cpu")
    for rings in (2, 10**9):
        with pytest.raises(ValueError, match=f"rings must be less for this mesh, not {rings}"):
            bsc.CollisionDetector(mesh, min_distance=1.0, rings=rings)
    for rings in (-1, 2**31):  # with a distance or without one
        with pytest.raises(ValueError, match="rings must be an integer of at least 0, less than"):
            bsc.CollisionDetector(mesh, rings=rings)
    with pytest.raises(TypeError, match="rings must be an integer, not None"):
        bsc.CollisionDetector(mesh, rings=None)
