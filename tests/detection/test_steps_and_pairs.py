"""What a detector tells beside collisions: free steps, candidates, least distances; and pairs that are left out."""

import numpy as np
import pytest
import warp as wp
from distances import ROUNDING, squared_distances
from sheets import crumpled, grid

import warp_bsc as bsc
from warp_bsc.detection import detector as detector_module
from warp_bsc.detection.results.collision_finder import CollisionFinder

KINDS = ("vertex_face", "edge_edge")
FALLING = np.array([[0, 0, 0], [4, 0, 0], [0, 4, 0], [1, 1, 1], [2, 1, 2], [1, 2, 2]], dtype=float)
FACES = [[0, 1, 2], [3, 4, 5]]


def elements(mesh, kind):
    return mesh.faces if kind == "vertex_face" else mesh.edges


def all_pairs(mesh, kind):
    """All pairs of a kind that share no vertex."""
    second = elements(mesh, kind)
    first = np.arange(mesh.vertex_count)[:, None] if kind == "vertex_face" else mesh.edges
    pairs = np.stack(np.meshgrid(np.arange(len(first)), np.arange(len(second)), indexing="ij"), axis=-1).reshape(-1, 2)
    pairs = pairs[pairs[:, 0] < pairs[:, 1]] if kind == "edge_edge" else pairs
    return pairs[(first[pairs[:, 0]][:, :, None] != second[pairs[:, 1]][:, None, :]).all(axis=(1, 2))]


def collide(mesh, x0, x1, pairs_of=all_pairs):
    """Whether pairs collide, by the exact checker, for each kind."""
    rows = {kind: bsc.query_points(elements(mesh, kind), pairs_of(mesh, kind), x0, x1) for kind in KINDS}
    return {kind: getattr(bsc.checker, kind)(points) for kind, points in rows.items()}


def test_a_mesh_says_how_many_vertices_take_part(device):
    mesh = bsc.CollisionMesh(FACES[:1], 6, edges=[(3, 4)], device=device)
    assert repr(mesh) == "CollisionMesh(1 faces, 4 edges, 0 points, 5 of 6 vertices)"


def test_the_truth_of_collisions_is_whether_there_are_any(device):
    detector = bsc.CollisionDetector(bsc.CollisionMesh(FACES, 6, device=device), method="exact")
    down = [0, 0, 4.0] * (np.arange(6) >= 3)[:, None]
    hits, none = detector.detect(FALLING, FALLING - down), detector.detect(FALLING, FALLING + down)
    assert hits and len(hits) == 3 and not hits.free
    assert not none and not len(none) and none.free
    assert repr(hits) == "Collisions(3 vertex-face, 0 edge-edge, certified)"
    computed = bsc.CollisionDetector(detector.mesh, method="float").detect(FALLING, FALLING + down)
    assert not computed and not computed.free
    assert repr(computed) == "Collisions(0 vertex-face, 0 edge-edge, not certified)"
    assert detector.has_intersections(FALLING - 1.5 / 4.0 * down)
    assert not detector.has_intersections(FALLING) and not detector.has_intersections(FALLING - down)


def test_the_truth_of_captured_collisions_is_an_error(device):
    detector = bsc.CollisionDetector(bsc.CollisionMesh(FACES, 6, device=device))
    x0, x1 = (wp.array(x, dtype=wp.vec3d, device=device) for x in (FALLING, FALLING - [0, 0, 0.5]))
    detector.detect(x0, x1)
    with wp.ScopedCapture(device) as capture:
        captured = detector.capture(x0, x1)
    with pytest.raises(TypeError, match=r"read\(\)"):
        bool(captured)
    wp.capture_launch(capture.graph)
    assert not captured.read()


@pytest.mark.parametrize("sampled_of", [8, 10**6])
@pytest.mark.parametrize("method", ["conservative", "exact"])
def test_a_free_step_ends_before_the_first_collision(method, sampled_of, device, monkeypatch):
    """The motion to its end is free by the exact checker, and a slightly longer one collides."""
    monkeypatch.setattr(detector_module, "_SAMPLED", 8)
    monkeypatch.setattr(detector_module, "_SAMPLED_OF", sampled_of)
    for seed in range(3):
        x0, x1, faces = crumpled(seed, n=6)
        mesh = bsc.CollisionMesh(faces, len(x0), device=device)
        detector = bsc.CollisionDetector(mesh, method=method)
        free = detector.collision_free_step(x0, x1)
        assert free.certified and free.x.dtype == np.float32
        assert not any(hits.any() for hits in collide(mesh, x0, free.x).values())
        later = (x0 + (free.step + 2.0**-16) * (x1.astype(float) - x0)).astype(float)
        assert any(hits.any() for hits in collide(mesh, x0.astype(float), later).values())
        np.testing.assert_allclose(free.x, x0 + free.step * (x1.astype(float) - x0), atol=1e-8)
        on_device = detector.collision_free_step(*(wp.array(x, dtype=wp.vec3, device=device) for x in (x0, x1)))
        assert on_device.step == free.step and np.array_equal(on_device.x.numpy(), free.x)


def test_a_free_motion_is_a_whole_step(device):
    detector = bsc.CollisionDetector(bsc.CollisionMesh(FACES, 6, device=device))
    up = FALLING + [0, 0, 1.0] * (np.arange(6) >= 3)[:, None]
    free = detector.collision_free_step(FALLING, up)
    assert free.step == 1.0 and free.certified and np.array_equal(free.x, up)


def test_no_step_is_free_where_elements_touch_at_the_start(device):
    touching = FALLING - [0, 0, 1.0] * (np.arange(6) >= 3)[:, None]
    detector = bsc.CollisionDetector(bsc.CollisionMesh(FACES, 6, device=device), method="exact")
    free = detector.collision_free_step(touching, touching - [0, 0, 1.0] * (np.arange(6) >= 3)[:, None])
    assert free.step == 0.0 and not free.certified and np.array_equal(free.x, touching)


@pytest.mark.parametrize("offset", [0.0, 1e3, 1e7])
def test_a_free_step_is_certified_as_its_end_is_rounded(offset, device):
    """Far from the origin in single precision, where positions before the contact are rounded to it, or beyond."""
    x0 = (FALLING + np.array([0, 0, offset])).astype(np.float32)
    x1 = x0 - np.float32([0, 0, 4]) * (np.arange(6) >= 3)[:, None].astype(np.float32)
    mesh = bsc.CollisionMesh(FACES, 6, device=device)
    free = bsc.CollisionDetector(mesh, method="exact").collision_free_step(x0, x1)
    assert free.certified and 0.0 < free.step < 0.25
    assert not any(hits.any() for hits in collide(mesh, x0, free.x).values())
    spacing = float(np.spacing(np.float32(offset + 1.0)))
    assert free.x[3, 2] - free.x[0, 2] <= 2.0 * spacing + 1e-5


def test_a_free_step_keeps_minimum_distances(device):
    x1 = FALLING - [0, 0, 4.0] * (np.arange(6) >= 3)[:, None]
    mesh = bsc.CollisionMesh(FACES, 6, device=device)
    free = bsc.CollisionDetector(mesh, min_distance=0.5).collision_free_step(FALLING, x1)
    assert free.certified and 0.125 - 1e-4 < free.step <= 0.125
    for kind in KINDS:
        rows = bsc.query_points(elements(mesh, kind), all_pairs(mesh, kind), FALLING, free.x)
        assert not getattr(bsc.checker, kind)(rows, 0.5).any()


def test_an_early_collision_takes_less_work_than_all(device, monkeypatch):
    x0, x1, faces = crumpled(1, n=40)
    x1 = x0 + 20.0 * (x1 - x0)
    detector = bsc.CollisionDetector(bsc.CollisionMesh(faces, len(x0), device=device))
    work, run = [], CollisionFinder.find

    def counted(self, *arguments, **options):
        found = run(self, *arguments, **options)
        stats = found.stats
        work.append(np.array([stats.vertex_face.candidates + stats.edge_edge.candidates, len(found)]))
        return found

    monkeypatch.setattr(CollisionFinder, "find", counted)
    assert detector.collision_free_step(x0, x1).certified
    candidates, contacts = sum(work)
    detector.detect(x0, x1)
    all_candidates, all_contacts = work[-1]
    assert candidates < 0.6 * all_candidates and contacts < 0.25 * all_contacts


def test_candidates_are_the_pairs_that_are_tested(device, broad_phase):
    x0, x1, faces = crumpled(2, n=6)
    mesh = bsc.CollisionMesh(faces, len(x0), device=device)
    detector = bsc.CollisionDetector(mesh)
    found, stats = detector.candidates(x0, x1), detector.detect(x0, x1).stats
    assert len(found) == len(found.vertex_face) + len(found.edge_edge)
    for kind in KINDS:
        pairs, every = list(map(tuple, getattr(found, kind).tolist())), all_pairs(mesh, kind)
        assert len(pairs) == len(set(pairs)) == getattr(stats, kind).candidates
        assert pairs == sorted(pairs) and set(pairs) < set(map(tuple, every.tolist()))
        hits = every[collide(mesh, x0, x1)[kind]]
        assert len(hits) and set(map(tuple, hits.tolist())) <= set(pairs)


def test_candidates_of_points_and_bad_positions(device):
    mesh = bsc.CollisionMesh([], 5, edges=[[0, 1]], points=[2, 3, 4], device=device)
    x = np.array([[0, 0, 0], [4, 0, 0], [1, 0.5, 0], [2, 0.5, 0.5], [9, 9, 9]], float)
    found = bsc.CollisionDetector(mesh, min_distance=1.5).candidates(x, x)
    assert [2, 0] in found.vertex_edge.tolist() and [2, 3] in found.vertex_vertex.tolist()
    assert not (found.vertex_edge == 4).any() and not (found.vertex_vertex == 4).any()
    with pytest.raises(ValueError, match=r"x1\[2\] has a coordinate that is not finite"):
        bsc.CollisionDetector(mesh, min_distance=1.5).candidates(x, np.where(np.arange(5)[:, None] == 2, np.nan, x))


def distance_of_rows(kind, points):
    """Distances in NumPy, of other code."""
    p, a, b, c = (points[:, min(i, points.shape[1] - 1)] for i in range(4))
    if kind == "vertex_vertex":
        b = c = a
    if kind == "edge_edge":
        return np.sqrt(squared_distances(kind, a - p, c - b, b - p))
    return np.sqrt(squared_distances("vertex_face", b - a, c - a, p - a))


@pytest.mark.parametrize(
    "kind, count", [("vertex_face", 4), ("edge_edge", 4), ("vertex_edge", 3), ("vertex_vertex", 2)]
)
def test_distances_of_rows(kind, count, device):
    points = np.random.default_rng(count).normal(size=(300, count, 3))
    for dtype in (np.float64, np.float32):
        given = points.astype(dtype)
        expected = distance_of_rows(kind, given.astype(float))
        np.testing.assert_allclose(bsc.distances(given, kind, device=device), expected, atol=10 * ROUNDING)
    assert bsc.distances(points[:0], kind, device=device).shape == (0,)
    assert not bsc.distances(np.zeros((3, count, 3)), kind, device=device).any()


def test_the_least_distance_is_that_of_all_pairs(device):
    x0, _x1, faces = crumpled(3, n=6)
    mesh = bsc.CollisionMesh(faces, len(x0), device=device)
    detector = bsc.CollisionDetector(mesh)
    rows = {k: bsc.query_points(elements(mesh, k), all_pairs(mesh, k), x0, x0)[:, :4].astype(float) for k in KINDS}
    least = min(distance_of_rows(kind, points).min() for kind, points in rows.items())
    assert detector.least_distance(x0, rings=0) == pytest.approx(least, abs=1e-12)
    assert detector.least_distance(x0) >= least
    flat, faces = grid(3, np.float64)
    for gap in (3.7, 1e-7, 0.0):  # far beyond the edges, and far within
        two = bsc.CollisionMesh(np.concatenate([faces, faces + len(flat)]), 2 * len(flat), device=device)
        x = np.concatenate([flat, flat + np.array([0.0, 0.0, gap])])
        assert bsc.CollisionDetector(two).least_distance(x, rings=6) == pytest.approx(gap, abs=1e-12)
    alone = bsc.CollisionDetector(bsc.CollisionMesh([[0, 1, 2]], 3, device=device))
    assert alone.least_distance(FALLING[:3]) == np.inf
    assert alone.least_distance(np.zeros((3, 3))) == np.inf
    assert bsc.CollisionDetector(bsc.CollisionMesh([], 0, device=device)).least_distance(np.zeros((0, 3))) == np.inf


def test_pairs_of_parts_are_left_out(device):
    """Against rows of a detection without filters, whose elements have one part each."""
    x0, x1, faces = crumpled(4, n=6)
    part = np.arange(3).repeat(len(x0))
    faces = np.concatenate([faces + i * len(x0) for i in range(3)])
    x0, x1 = (np.concatenate([x + np.float32([0, 0, 0.0001 * i]) for i in range(3)]) for x in (x0, x1))
    whole = bsc.CollisionMesh(faces, len(part), device=device)
    every = bsc.CollisionDetector(whole).detect(x0, x1)
    for listed in ([], [(0, 0)], [(2, 1)], [(0, 1), (1, 1), (2, 0)]):
        group, mask = bsc.leave_out(part, listed)
        mesh = bsc.CollisionMesh(faces, len(part), group=group, mask=mask, device=device)
        found = bsc.CollisionDetector(mesh).detect(x0, x1)
        for kind in KINDS:
            pairs = getattr(every, kind)
            first = part[pairs[:, 0]] if kind == "vertex_face" else part[mesh.edges[pairs[:, 0], 0]]
            second = part[elements(mesh, kind)[pairs[:, 1], 0]]
            kept = [(a, b) not in listed and (b, a) not in listed for a, b in zip(first, second, strict=True)]
            assert getattr(found, kind).tolist() == pairs[kept].tolist()
            assert sum(kept) < len(kept) or not listed
    with pytest.raises(ValueError, match="pairs name part 7, which no vertex has"):
        bsc.leave_out(part, [(0, 7)])
