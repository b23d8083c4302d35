"""Meshes and the collision detector: all pairs by brute force, known scenes, the same answer always, bad input."""

import numpy as np
import pytest
import trimesh
import warp as wp
from benchmark_data import data_folder
from collision_results import assert_same
from sheets import crumpled, grid

import warp_bsc as bsc
from warp_bsc import checker
from warp_bsc.detection.at_rest.intersections import find_intersections
from warp_bsc.detection.broad.broad_phase_hierarchy import BroadPhaseHierarchy
from warp_bsc.detection.narrow.rules import contact
from warp_bsc.detection.pipeline import DetectionPipeline
from warp_bsc.detection.results.collision_finder import CollisionFinder
from warp_bsc.detection.run.launch import retry_until_fits
from warp_bsc.detection.run.settings import Count, PairKind
from warp_bsc.kernels.signs import FREE

METHODS = ("float", "conservative", "exact")


def all_collisions(mesh, x0, x1):
    """Every colliding pair of a small mesh, by asking the checker about all pairs that share no vertex."""
    vertices, faces = np.meshgrid(mesh.vertices, np.arange(len(mesh.faces)), indexing="ij")
    pairs = np.stack([vertices.ravel(), faces.ravel()], axis=1)
    corners = np.concatenate([pairs[:, :1], mesh.faces[pairs[:, 1]]], axis=1)
    keep = (corners[:, :1] != corners[:, 1:]).all(axis=1)
    vertex_face = pairs[keep][checker.vertex_face(np.concatenate([x0[corners[keep]], x1[corners[keep]]], axis=1))]
    first, second = np.triu_indices(len(mesh.edges), 1)
    pairs = np.stack([first, second], axis=1)
    corners = mesh.edges[pairs].reshape(-1, 4)
    keep = (corners[:, :2, None] != corners[:, None, 2:]).all(axis=(1, 2))
    edge_edge = pairs[keep][checker.edge_edge(np.concatenate([x0[corners[keep]], x1[corners[keep]]], axis=1))]
    return vertex_face, edge_edge


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("seed", range(3))
def test_exactly_the_colliding_pairs_are_found(seed, dtype, broad_phase):
    rng = np.random.default_rng(seed)
    x0 = rng.integers(-2, 3, (14, 3)).astype(dtype) if seed == 0 else rng.uniform(-1, 1, (14, 3)).astype(dtype)
    x1 = x0 + (rng.integers(-2, 3, (14, 3)) if seed == 0 else rng.uniform(-0.5, 0.5, (14, 3))).astype(dtype)
    mesh = bsc.CollisionMesh(rng.permuted(np.tile(np.arange(14), (10, 1)), axis=1)[:, :3], 14)
    vertex_face, edge_edge = all_collisions(mesh, x0, x1)
    assert len(vertex_face) and len(edge_edge)
    c = bsc.CollisionDetector(mesh, method="exact").detect(x0, x1)
    np.testing.assert_array_equal(c.vertex_face, vertex_face)
    np.testing.assert_array_equal(c.edge_edge, edge_edge)
    assert c.vertex_face.dtype == c.edge_edge.dtype == np.int32
    conservative = bsc.CollisionDetector(mesh).detect(x0, x1)
    assert {*map(tuple, vertex_face)} <= {*map(tuple, conservative.vertex_face)}
    assert {*map(tuple, edge_edge)} <= {*map(tuple, conservative.edge_edge)}


def test_times_and_counts_belong_to_the_pairs():
    positions, faces = grid(1)
    positions = np.concatenate([positions, [[0.004, 0.006, 0.01], [0.02, 0.02, 0.01], [0.02, 0.0, 0.01]]])
    mesh = bsc.CollisionMesh(np.concatenate([faces, [[4, 5, 6]]]), 7)
    end = positions.copy()
    end[4:, 2] = -0.03
    c = bsc.CollisionDetector(mesh, method="exact").detect(positions, end)
    assert (4, 0) in {*map(tuple, c.vertex_face)}
    np.testing.assert_allclose(c.vertex_face_toi, 0.25, atol=2.0**-20)
    assert (c.vertex_face_toi <= 0.25).all()
    assert c.earliest_toi == min(c.vertex_face_toi.min(), c.edge_edge_toi.min())
    np.testing.assert_allclose(np.abs(c.vertex_face_normal), [[0.0, 0.0, 1.0]] * len(c.vertex_face), atol=1e-12)
    np.testing.assert_allclose(c.vertex_face_coordinates.sum(axis=1), 1.0)
    for counts in (c.stats.vertex_face, c.stats.edge_edge):
        assert counts.candidates == counts.free + counts.hits + counts.unsure
        assert counts.survivors <= counts.candidates
    assert set(c.stats.milliseconds) == {"broad phase", "cull", "classify", "time of impact", "sort", "exact"}


def turned(positions, angle):
    """Positions turned in their plane."""
    turn = np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])
    return (positions.astype(np.float64) @ turn.T).astype(positions.dtype)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize(
    "motion",
    [
        lambda x: (x, x),
        lambda x: (x, x + np.array([0.003, -0.0071, 0.0], dtype=x.dtype)),
        lambda x: (x, x + np.array([0.0031, 0.002, 0.017], dtype=x.dtype)),
        lambda x: (x, turned(x, 0.05)),
        lambda x: (turned(x, 0.7), turned(x, 0.8)),
    ],
    ids=["at rest", "translating in its plane", "translating", "turning", "turning from an angle"],
)
def test_flat_cloth_does_not_hit_itself(motion, dtype):
    positions, faces = grid(64, dtype)
    x0, x1 = motion(positions)
    mesh = bsc.CollisionMesh(faces, len(positions))
    for method in METHODS:
        c = bsc.CollisionDetector(mesh, method=method).detect(x0, x1)
        assert len(c.vertex_face) == len(c.edge_edge) == 0
        candidates = c.stats.vertex_face.candidates + c.stats.edge_edge.candidates
        unsure = c.stats.vertex_face.unsure + c.stats.edge_edge.unsure
        assert candidates > 8_000
        assert unsure <= 0.001 * candidates


@pytest.fixture(scope="module")
def cloth_funnel():
    first, second = (
        trimesh.load(data_folder() / "frames" / "cloth-funnel" / f"{frame}.ply", process=False) for frame in (227, 228)
    )
    return np.array(first.vertices), np.array(second.vertices), np.array(first.faces)


@pytest.mark.data
def test_cloth_funnel_has_the_known_collisions(cloth_funnel, broad_phase):
    x0, x1, faces = cloth_funnel
    c = bsc.CollisionDetector(bsc.CollisionMesh(faces, len(x0)), method="exact").detect(x0, x1)
    assert x0.dtype == np.float64
    assert (len(c.vertex_face), len(c.edge_edge), c.certified) == (27, 107, True)


@pytest.mark.data
def test_answers_are_the_same_on_every_run_and_device(cloth_funnel):
    x0, x1, faces = cloth_funnel
    devices = ["cpu", *(device.alias for device in wp.get_cuda_devices()[:1])]
    results = []
    for device in [*devices, *devices]:
        detector = bsc.CollisionDetector(bsc.CollisionMesh(faces, len(x0), device=device))
        results.append(detector.detect(x0, x1))
        results.append(detector.detect(x0, x1))
    for other in results[1:]:
        for field in ("vertex_face", "edge_edge", "vertex_face_toi", "edge_edge_toi", "vertex_face_normal"):
            assert getattr(other, field).tobytes() == getattr(results[0], field).tobytes()


def test_candidates_that_do_not_fit_at_first_are_not_lost(broad_phase):
    rng = np.random.default_rng(0)
    x0 = rng.uniform(-1, 1, (300, 3))  # long triangles, turned inside out: nearly every pair is a candidate
    faces = np.arange(300).reshape(100, 3)
    mesh = bsc.CollisionMesh(faces, 300)
    c = bsc.CollisionDetector(mesh).detect(x0, -x0)
    assert c.stats.vertex_face.candidates > 0.9 * 300 * 99
    assert c.stats.edge_edge.candidates > 0.9 * 300 * 297 // 2


def test_degenerate_meshes_are_handled(broad_phase):
    x = np.zeros((4, 3), dtype=np.float32)
    for faces in (np.zeros((0, 3), dtype=int), [[0, 1, 2]], [[0, 0, 1], [2, 2, 3]]):
        c = bsc.CollisionDetector(bsc.CollisionMesh(faces, 4), method="exact").detect(x, x)
        assert c.certified
        assert len(c.edge_edge) == (1 if len(faces) == 2 else 0)
        assert c.earliest_toi == (0.0 if len(faces) == 2 else 2.0)


def test_huge_double_positions_keep_their_pairs(broad_phase):
    """Positions beyond the range of float still get candidates."""
    x0 = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.2, 0.2, 1], [0.3, 0.2, 2], [0.2, 0.3, 2]]) * 1e60
    x1 = x0.copy()
    x1[3:, 2] -= 3e60
    c = bsc.CollisionDetector(bsc.CollisionMesh([[0, 1, 2], [3, 4, 5]], 6)).detect(x0, x1)
    assert c.vertex_face.tolist() == [[3, 0], [4, 0], [5, 0]]


def test_bad_meshes_are_refused():
    for faces, message in [
        ([[0, 1, 9]], r"faces\[0\] is \[0, 1, 9\], but the mesh has 4 vertices"),
        ([[0, 1, -1]], r"faces\[0\]"),
        ([[0, 1]], r"shape \(n, 3\)"),
        ([[0.0, 1.0, 2.0]], "integers"),
        ([[0, 1, 2**32]], r"faces\[0\]"),
        (np.zeros((0, 4), int), r"shape \(n, 3\)"),
        (np.zeros((3, 0), int), r"shape \(n, 3\)"),
        (np.broadcast_to(0, (2**28, 3)), r"less than 2\^28 rows"),
    ]:
        with pytest.raises(ValueError, match=message):
            bsc.CollisionMesh(faces, 4)
    for vertex_count in (-1, 2**31, 6.5, 6.0, np.nan, "6", None):
        error = ValueError if isinstance(vertex_count, int) else TypeError
        with pytest.raises(error, match=f"vertex_count must be an integer.* not {vertex_count!r}"):
            bsc.CollisionMesh([[0, 1, 2]], vertex_count)


def test_meshes_of_any_integers_are_taken():
    for faces in ([], np.zeros((0, 3), int), wp.zeros((0, 3), dtype=int)):
        assert bsc.CollisionMesh(faces, np.int64(6)).faces.shape == (0, 3)
    for faces in (np.array([[0, 1, 2]], np.uint8), wp.array([[0, 1, 2]], dtype=wp.vec3i)):
        assert bsc.CollisionMesh(faces, np.uint8(3)).faces.tolist() == [[0, 1, 2]]


def test_positions_in_place_of_a_number_are_told_where_they_belong():
    for arguments in ((np.zeros((3, 3)), [[0, 1, 2]]), ([[0, 1, 2]], np.zeros((3, 3)))):
        with pytest.raises(TypeError, match=r"number of positions: CollisionMesh\(faces, len\(x\)\).*detect\(x0, x1\)"):
            bsc.CollisionMesh(*arguments)


def test_bad_positions_are_refused():
    detector = bsc.CollisionDetector(bsc.CollisionMesh([[0, 1, 2]], 4))
    x = np.zeros((4, 3))
    with pytest.raises(ValueError, match="x1 must have 4 rows"):
        detector.detect(x, np.zeros((5, 3)))
    with pytest.raises(ValueError, match="x0 must have shape"):
        detector.detect(np.zeros((4, 2)), x)
    with pytest.raises(ValueError, match="float32 or float64"):
        detector.detect(x.astype(int), x)
    with pytest.raises(ValueError, match="x0 must have integers of at most 2"):
        detector.detect((x.astype(int) - 2**53 - 1).tolist(), x)
    with pytest.raises(ValueError, match=r"x1 must be .* as x0"):
        detector.detect(x, x.astype(np.float32))
    bad = x.copy()
    bad[2, 1] = np.nan
    with pytest.raises(ValueError, match=r"x1\[2\]"):
        detector.detect(x, bad)
    with pytest.raises(ValueError, match=r"x\[2\]"):
        detector.find_intersections(bad)
    with pytest.raises(ValueError, match="method"):
        bsc.CollisionDetector(detector.mesh, method="fast")


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("on_device", [False, True])
def test_vertices_that_no_face_uses_take_no_part(value, on_device, broad_phase):
    """Wherever they are, if anywhere; where one that takes part is not finite, it is named, and not they."""
    x0, x1, faces = crumpled(0)
    expected = bsc.CollisionDetector(bsc.CollisionMesh(faces, len(x0))).detect(x0, x1)
    crossing = find_intersections(bsc.CollisionMesh(faces, len(x0)), x0)
    assert len(expected.vertex_face) and len(expected.edge_edge)
    x0, x1 = (np.concatenate([[[value] * 3], x, [[0.0, value, -value]]]).astype(np.float32) for x in (x0, x1))
    detector = bsc.CollisionDetector(bsc.CollisionMesh(faces + 1, len(x0)))

    def positions(x):
        return wp.array(x, dtype=wp.vec3) if on_device else x

    c = detector.detect(positions(x0), positions(x1))
    assert c.certified
    np.testing.assert_array_equal(c.vertex_face, expected.vertex_face + np.array([1, 0]))
    np.testing.assert_array_equal(c.edge_edge, expected.edge_edge)
    np.testing.assert_array_equal(detector.find_intersections(positions(x0)), crossing)
    x1[7] = np.nan
    with pytest.raises(ValueError, match=r"x1\[7\]"):
        detector.detect(positions(x0), positions(x1))
    with pytest.raises(ValueError, match=r"x\[7\]"):
        detector.find_intersections(positions(x1))


def test_queues_with_room_for_one_entry_grow(broad_phase):
    x0, x1, faces = crumpled(0)
    mesh = bsc.CollisionMesh(faces, len(x0))
    expected = bsc.CollisionDetector(mesh).detect(x0, x1)
    assert len(expected.vertex_face) > 20 and len(expected.edge_edge) > 20
    pipeline = DetectionPipeline(mesh, only_used_vertices=True)
    assert bool(pipeline.broad_phase.buffers) == (broad_phase is BroadPhaseHierarchy)
    if broad_phase is BroadPhaseHierarchy:
        pipeline.broad_phase.face_pairs = wp.empty(1, dtype=wp.vec2i)
    for narrow_phase in pipeline.narrow_phases:
        narrow_phase.queue = wp.empty(1, dtype=wp.vec2i)
        narrow_phase.allocate_survivors(1)
        narrow_phase.allocate_contacts(1)
    finder = CollisionFinder(pipeline, pipeline.broad_phase.lock)
    c = finder.find(*(wp.array(x, dtype=wp.vec3, device=mesh.device) for x in (x0, x1)))
    assert_same(c, expected)
    assert c.certified and not c.overflowed


@pytest.mark.parametrize("n", [2, 48])
def test_capacities_for_a_number_of_pairs_a_face(n):
    """At first 32 and 96 pairs a face fit, at least 131,072, and 256 pairs of faces; the contacts are the same."""
    x0, x1, faces = crumpled(0, n)
    mesh = bsc.CollisionMesh(faces, len(x0))
    pipeline, other = DetectionPipeline(mesh, pairs=128 * len(mesh.faces)), DetectionPipeline(mesh)
    for narrow_phase, pairs in zip(pipeline.narrow_phases, (32, 96), strict=True):
        expected = max(2**17, pairs * len(faces))
        capacities = narrow_phase.capacities
        assert capacities.queued == expected
        assert capacities.survivors >= expected // 2 and capacities.contacts >= expected // 8
    assert pipeline.capacities.numpy()[1] == pipeline.broad_phase.capacity
    assert mesh.device.is_cpu or pipeline.broad_phase.capacity == max(2**17, 256 * len(faces))
    positions = [wp.array(x, dtype=wp.vec3, device=mesh.device) for x in (x0, x1)]
    for p in (pipeline, other):
        retry_until_fits(lambda p=p: p.find_contacts(*positions), p, mesh.device)
    assert pipeline.generation == 0
    assert found_pairs(pipeline.narrow_phases) == found_pairs(other.narrow_phases)
    assert pipeline.counts == other.counts


def test_two_passes_find_the_same_contacts(device, monkeypatch):
    """The kernels of a GPU, on a CPU as well: of many contacts they find those first that take a short search."""
    x0, x1, faces = crumpled(0, 48)
    mesh, found, left = bsc.CollisionMesh(faces, len(x0), device=device), [], []
    for in_batches, many in ((True, 2**30), (False, 2**30), (False, 0)):
        monkeypatch.setattr(contact, "decides_in_batches", lambda of, value=in_batches: value and of.is_cpu)
        monkeypatch.setattr("warp_bsc.detection.narrow.rules.contact._MANY", many)
        pipeline = DetectionPipeline(mesh)
        finder = CollisionFinder(pipeline, pipeline.broad_phase.lock)
        found.append(finder.find(*(wp.array(x, dtype=wp.vec3, device=device) for x in (x0, x1))))
        left.append(pipeline.counts.pairs[PairKind.EDGE_EDGE].subdivided)
    assert_same(found[0], found[1])
    assert_same(found[0], found[2])
    assert left[:2] == [0, 0] and 0 < left[2] < 0.8 * len(found[0].edge_edge)


def test_large_meshes_begin_with_room_for_fewer_contacts(monkeypatch):
    """Half as many survivors and contacts a face, from a number of pairs on; all are found, as queues grow."""
    x0, x1, faces = crumpled(0, 48)
    mesh, found = bsc.CollisionMesh(faces, len(x0)), []
    for many in (2**22, 1000):
        monkeypatch.setattr("warp_bsc.detection.narrow.narrow_phase._MANY", many)
        pipeline = DetectionPipeline(mesh)
        found.append([(n.capacities.survivors, n.capacities.contacts) for n in pipeline.narrow_phases])
        finder = CollisionFinder(pipeline, pipeline.broad_phase.lock)
        found[-1].append(finder.find(*(wp.array(x, dtype=wp.vec3, device=mesh.device) for x in (x0, x1))).earliest_toi)
    vertex_face, edge_edge = len(faces) // 2 + 1, 2 * len(faces)
    assert found[0][:2] == [(n // 2 + 64, n // 8 + 64) for n in (vertex_face, edge_edge)]
    assert found[1][:2] == [(n // 4 + 64, n // 16 + 64) for n in (vertex_face, edge_edge)]
    assert found[0][2] == found[1][2]


def found_pairs(narrow_phases):
    """What a detection that was not sorted found, as a set for each kind."""
    found = []
    for narrow_phase in narrow_phases:
        count = int(narrow_phase.counts.numpy()[Count.CONTACTS])
        real = narrow_phase.contacts.status.numpy()[:count] != FREE
        found.append({tuple(pair) for pair in narrow_phase.contacts.pairs.numpy()[:count][real].tolist()})
    return found


def test_of_what_has_changed_all_contacts_are_found_again(broad_phase, device):
    """Pairs of which no vertex has changed may be left out, and all that is found is right."""
    x0, x1, faces = crumpled(1)
    mesh = bsc.CollisionMesh(faces, len(x0), device=device)
    pipeline = DetectionPipeline(mesh)

    def find(*positions, **options):
        retry_until_fits(lambda: pipeline.find_contacts(*positions, **options), pipeline, device)
        return found_pairs(pipeline.narrow_phases)

    random = np.random.default_rng(0)
    for share in (0.0, 0.02, 0.3, 1.0):
        moved = random.random(len(x0)) < share
        after = x1 + (0.002 * moved[:, None] * random.standard_normal(x1.shape)).astype(np.float32)
        start, first, second = (wp.array(x, dtype=wp.vec3, device=device) for x in (x0, x1, after))
        everything = find(start, second)
        find(start, first)
        changed = wp.array(moved, dtype=int, device=device)
        again = find(start, second, changed=changed)
        candidates = sum(int(n.counts.numpy()[Count.QUEUED]) for n in pipeline.narrow_phases)
        assert (share == 0.0) == (candidates == 0)
        for full, part, (one, other) in zip(
            everything, again, ((mesh.vertices[:, None], mesh.faces), (mesh.edges, mesh.edges)), strict=True
        ):
            concerned = {(a, b) for a, b in full if moved[one[a]].any() or moved[other[b]].any()}
            assert concerned <= part <= full
            assert share < 0.3 or len(part) > 10


def test_collisions_of_the_vertices_of_interest_are_found(broad_phase):
    x0, x1, faces = crumpled(1)
    mesh = bsc.CollisionMesh(faces, len(x0))
    detector = bsc.CollisionDetector(mesh)
    full = detector.detect(x0, x1)
    for share in (0.0, 0.02, 0.3, 1.0):
        only = np.random.default_rng(0).random(len(x0)) < share
        found = detector.detect(x0, x1, vertices=only)
        for name, corners in (
            ("vertex_face", lambda pairs: np.column_stack([pairs[:, 0], mesh.faces[pairs[:, 1]]])),
            ("edge_edge", lambda pairs: mesh.edges[pairs].reshape(-1, 4)),
        ):
            everything, part = getattr(full, name), getattr(found, name)
            of_interest = everything[only[corners(everything)].any(axis=1)]
            pairs, all_pairs, sought = ({*map(tuple, rows)} for rows in (part, everything, of_interest))
            assert sought <= pairs <= all_pairs
            assert share < 0.3 or len(sought) > 10
    assert_same(detector.detect(x0, x1), full)


def test_all_overlapping_pairs_can_be_had(broad_phase, device):
    """Those as well that an axis separates, which are no candidates."""
    x0, x1, faces = crumpled(2)
    mesh = bsc.CollisionMesh(faces, len(x0), device=device)
    pipeline = DetectionPipeline(mesh)
    positions = [wp.array(x, dtype=wp.vec3, device=device) for x in (x0, x1)]
    retry_until_fits(lambda: pipeline.find_overlapping(*positions), pipeline, device)
    overlapping = pipeline.counts.vertex_face.queued, pipeline.counts.edge_edge.queued
    stats = bsc.CollisionDetector(mesh).detect(x0, x1).stats
    candidates = stats.vertex_face.candidates, stats.edge_edge.candidates
    for count, of_these in zip(overlapping, candidates, strict=True):
        assert count > of_these > 0


def test_every_pair_overlaps(broad_phase, device):
    """2,000 triangles whose swept boxes all overlap: a tree that separates nothing must still find all pairs."""
    x0 = np.random.default_rng(1).uniform(-1, 1, (6000, 3))
    mesh = bsc.CollisionMesh(np.arange(6000).reshape(2000, 3), 6000, device=device)
    pipeline = DetectionPipeline(mesh)
    positions = [wp.array(x, dtype=wp.vec3, device=device) for x in (x0 - 10.0, x0 + 10.0)]
    retry_until_fits(lambda: pipeline.find_overlapping(*positions), pipeline, device)
    assert pipeline.counts.vertex_face.queued == 6000 * 1999
    assert pipeline.counts.edge_edge.queued == 6000 * 5997 // 2


def test_detectors_side_by_side_do_not_disturb_one_another():
    x0, x1, faces = crumpled(0)
    mesh = bsc.CollisionMesh(faces, len(x0))
    first, second = bsc.CollisionDetector(mesh), bsc.CollisionDetector(mesh)
    a, b = first.detect(x0, x1), second.detect(x1, x0)
    assert_same(a, bsc.CollisionDetector(mesh).detect(x0, x1))
    assert_same(b, bsc.CollisionDetector(mesh).detect(x1, x0))


def test_worlds_do_not_collide_with_one_another(broad_phase):
    scenes = [crumpled(seed) for seed in range(3)]
    faces = scenes[0][2]
    n = len(scenes[0][0])
    x0, x1 = (np.concatenate([scene[end] for scene in scenes]) for end in (0, 1))
    mesh = bsc.CollisionMesh(np.concatenate([faces + n * i for i in range(3)]), 3 * n, world=np.repeat(np.arange(3), n))
    c = bsc.CollisionDetector(mesh).detect(x0, x1)
    for i, (start, end, _) in enumerate(scenes):
        alone = bsc.CollisionDetector(bsc.CollisionMesh(faces, n)).detect(start, end)
        here = c.vertex_face[:, 0] // n == i
        np.testing.assert_array_equal(c.vertex_face[here] - [n * i, len(faces) * i], alone.vertex_face)
        np.testing.assert_array_equal(c.vertex_face_toi[here], alone.vertex_face_toi)
        edges = len(mesh.edges) // 3
        here = c.edge_edge[:, 0] // edges == i
        np.testing.assert_array_equal(c.edge_edge[here] - edges * i, alone.edge_edge)


def test_bad_worlds_are_refused():
    for world, message in [
        ([0, 0, 1], r"world must be one for a face, but faces\[0\] has \[0, 0, 1\]"),
        ([0, 0], "3 integers"),
        ([0, -1, 0], r"world\[1\] must be in \[0, 2\^31\), not -1"),
        ([0, 0, 2**31], rf"world\[2\] must be .*, not {2**31}"),
        (np.full(3, 2**32), rf"world\[0\] must be .*, not {2**32}"),
        (np.full(3, 2**64 - 1, np.uint64), rf"world\[0\] must be .*, not {2**64 - 1}"),
        (wp.full(3, 2**31, dtype=wp.int64), rf"world\[0\] must be .*, not {2**31}"),
        ([0.0, 0.0, 0.0], "3 integers"),
    ]:
        with pytest.raises(ValueError, match=message):
            bsc.CollisionMesh([[0, 1, 2]], 3, world=world)


def test_worlds_of_any_number_are_kept_apart(broad_phase):
    """One triangle falls through another in world 0 and in the last world that there may be, and not across."""
    faces = np.arange(12).reshape(4, 3)
    low, high = np.array([[0, 0, 0], [4, 0, 0], [0, 4, 0]]), np.array([[1, 1, 1], [2, 1, 2], [1, 2, 2]])
    x0 = np.concatenate([low, high, low, high]).astype(np.float32)
    x1 = x0.copy()
    x1[[3, 4, 5, 9, 10, 11], 2] -= 4.0
    for last in (1, 2**16, 2**31 - 1):
        world = np.repeat([0, last], 6)
        c = bsc.CollisionDetector(bsc.CollisionMesh(faces, 12, world=wp.array(world, dtype=wp.int64))).detect(x0, x1)
        assert c.vertex_face.tolist() == [[3, 0], [4, 0], [5, 0], [9, 2], [10, 2], [11, 2]]


def test_a_detector_used_again_forgets_nothing(broad_phase):
    """Trees are kept from one detection to the next, also where everything has moved elsewhere meanwhile."""
    rng = np.random.default_rng(2)
    faces = np.arange(600).reshape(200, 3)
    mesh = bsc.CollisionMesh(faces, 600)
    detector = bsc.CollisionDetector(mesh)
    for scale in (3.0, 3.1, 0.5, 50.0, 4.0):
        x0 = (rng.uniform(-scale, scale, (200, 1, 3)) + rng.uniform(-1, 1, (200, 3, 3))).reshape(-1, 3)
        x1 = x0 + rng.uniform(-1, 1, x0.shape)
        again, first = detector.detect(x0, x1), bsc.CollisionDetector(mesh).detect(x0, x1)
        assert_same(again, first)
        assert again.stats.vertex_face == first.stats.vertex_face
        assert again.stats.edge_edge == first.stats.edge_edge
