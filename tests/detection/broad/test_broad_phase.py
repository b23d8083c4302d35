"""Both broad phases against all pairs compared one by one: nothing dropped, nothing twice, nothing across worlds."""

import numpy as np
import pytest
import trimesh
import warp as wp
from hypothesis import example, given
from hypothesis import strategies as st
from sheets import crumpled, grid

import warp_bsc as bsc
from warp_bsc.detection.broad import broad_phase_hierarchy, face_hierarchy
from warp_bsc.detection.broad.broad_phase_hierarchy import BroadPhaseHierarchy
from warp_bsc.detection.broad.broad_phase_simd import BroadPhaseSimd
from warp_bsc.detection.broad.face_hierarchy import traversal_kernel
from warp_bsc.detection.broad.wide_tree import hilbert_transpose
from warp_bsc.detection.run.settings import Count
from warp_bsc.kernels.boxes import BoxRows, read_box
from warp_bsc.kernels.pipeline.hierarchy import coded_box, codes_apart, count_set_bits


def find_pairs(broad_phase, mesh, x0, x1, changed=None):
    """Counts and pairs of each kind, and the (edge, face) pairs at the start."""
    device = mesh.device
    if broad_phase is BroadPhaseSimd and device.is_cuda:
        pytest.skip("SIMD packets are for the CPU")
    dtype = wp.vec3 if x0.dtype == np.float32 else wp.vec3d
    x0, x1 = (wp.array(x, dtype=dtype, device=device) for x in (x0, x1))
    counts = wp.zeros((3, len(Count)), dtype=wp.int64, device=device)
    own_count = wp.zeros(1, dtype=wp.int64, device=device)
    # 9 worlds of 90 faces have at most 270 edges each, which make 326,835 pairs
    queues = [wp.full(400_000, wp.vec2i(-1, -1), dtype=wp.vec2i, device=device) for _ in range(3)]
    finder = broad_phase(mesh, own_count)
    finder.grow(1_000_000)
    changed = None if changed is None else wp.array(changed, dtype=int, device=device)
    finder.pair_elements(x0, x1, counts[0], queues[0], counts[1], queues[1], changed=changed)
    own_count.zero_()
    finder.pair_edges_with_faces(x0, counts[2], queues[2])
    counts = counts.numpy()
    found = [queue.numpy()[: count[Count.QUEUED]] for queue, count in zip(queues, counts, strict=True)]
    return [in_lexicographic_order(pairs) for pairs in found]


def all_pairs(mesh, x0, x1):
    """The same by comparing every pair."""
    near = []
    vertices, edges, faces = mesh.vertices[:, None], mesh.edges, mesh.faces
    world = np.zeros(mesh.vertex_count) if mesh.world is None else mesh.world
    kinds = [(vertices, faces, mesh.vertices, x1), (edges, edges, np.arange(len(edges)), x1)]
    for first, second, numbers, end in [*kinds, (edges, faces, np.arange(len(edges)), x0)]:
        a, b = ([x.astype(np.float32)[element] for x in (x0, end)] for element in (first, second))
        # ends, elements, axes
        (low, high), (other_low, other_high) = ([bound(x, axis=2) for bound in (np.min, np.max)] for x in (a, b))
        candidate = world[first[:, :1]] == world[second[:, 0]]
        for axis in range(3):
            candidate &= low[..., axis].min(axis=0)[:, None] <= other_high[..., axis].max(axis=0)
            candidate &= other_low[..., axis].min(axis=0) <= high[..., axis].max(axis=0)[:, None]
        if first is second:
            candidate = np.triu(candidate, 1)
        i, j = np.nonzero(candidate)
        distinct = ~(first[i][:, :, None] == second[j][:, None]).any(axis=(1, 2))
        i, j = i[distinct], j[distinct]
        below, above = (high[:, i] < other_low[:, j]).all(axis=0), (low[:, i] > other_high[:, j]).all(axis=0)
        meet = ~(below | above).any(axis=1)
        near.append(in_lexicographic_order(np.stack([numbers[i[meet]], j[meet]], axis=1)))
    return near


def in_lexicographic_order(pairs):
    """A list of pairs, each as one number: lists of tuples would take most of the time of these tests."""
    return np.sort(pairs.astype(np.int64) @ [2**32, 1]).tolist()


@pytest.mark.slow
@pytest.mark.parametrize("broad_phase", [BroadPhaseSimd, BroadPhaseHierarchy])
@given(
    dtype=st.sampled_from([np.float32, np.float64]),
    faces=st.integers(1, 60),
    size=st.floats(0.05, 3.0),
    worlds=st.integers(1, 9),
    flat=st.booleans(),
    seed=st.integers(0),
)
@example(dtype=np.float32, faces=73, size=0.125, worlds=9, flat=True, seed=8)  # all pairs of a world overlap
def test_all_pairs_are_found_once(broad_phase, dtype, faces, size, worlds, flat, seed):
    rng = np.random.default_rng(seed)
    connectivity = rng.integers(0, 2 * faces + 3, (faces, 3))  # vertices shared, unused, and twice in a face
    x0 = rng.uniform(-1.0, 1.0, (2 * faces + 3, 3)) * size
    if flat:
        x0 = np.round(x0 * 4.0) / 4.0  # boxes that touch, and boxes without volume
    x1 = x0 + rng.uniform(-1.0, 1.0, x0.shape) * rng.choice([0.0, 0.1, 1.0])
    world = None
    if worlds > 1:
        connectivity = np.concatenate([connectivity + len(x0) * i for i in range(worlds)])
        world = np.repeat(rng.permutation(1000)[:worlds], len(x0))
        x0, x1 = (np.tile(x, (worlds, 1)) for x in (x0, x1))
    x0, x1 = x0.astype(dtype), x1.astype(dtype)
    mesh = bsc.CollisionMesh(connectivity, len(x0), world=world)
    assert find_pairs(broad_phase, mesh, x0, x1) == all_pairs(mesh, x0, x1)


@pytest.mark.parametrize("broad_phase", [BroadPhaseSimd, BroadPhaseHierarchy])
@pytest.mark.parametrize("rounded_to_zero", [-1e-60, -0.0, 0.0, 1e-60])
def test_zeros_of_both_signs_are_one(broad_phase, rounded_to_zero):
    x = np.array([[-1, 0, 0], [rounded_to_zero, 0, 1], [-1, 1, 0], [1, 0, 0], [0, 0, 1], [1, 1, 0]])
    mesh = bsc.CollisionMesh([[0, 1, 2], [3, 4, 5]], 6)
    for ends in (x, x), (-x, -x):
        pairs = find_pairs(broad_phase, mesh, *ends)
        assert pairs == all_pairs(mesh, *ends)
        assert all(pairs)


@pytest.mark.parametrize("broad_phase", [BroadPhaseSimd, BroadPhaseHierarchy])
def test_trees_of_several_levels(broad_phase):
    """A strip long enough for four levels of packets, whose pairs are known by counting."""
    n = 6000
    columns = np.arange(n + 1)
    x0 = np.stack(np.broadcast_arrays(columns[:, None], np.arange(2), 0.0), axis=-1).reshape(-1, 3).astype(np.float32)
    a = 2 * columns[:-1, None] + np.array([[0, 1, 2]])
    b = 2 * columns[:-1, None] + np.array([[1, 3, 2]])
    mesh = bsc.CollisionMesh(np.concatenate([a, b])[np.random.default_rng(0).permutation(2 * n)], len(x0))
    vertex_face, edge_edge, edge_face = find_pairs(broad_phase, mesh, x0, x0)
    # each vertex touches the boxes of the triangles of two quads, and is in three of these, the ends one of two or two
    assert len(vertex_face) == 2 * (n + 1) * 4 - 8 - 3 * len(mesh.faces)
    expected = all_pairs(bsc.CollisionMesh(np.concatenate([a[:50], b[:50]]), 102), x0[:102], x0[:102])
    longer = all_pairs(bsc.CollisionMesh(np.concatenate([a[:60], b[:60]]), 122), x0[:122], x0[:122])
    for found, short, long in zip([vertex_face, edge_edge, edge_face], expected, longer, strict=True):
        assert len(found) == len(set(found))
        assert len(found) == len(long) + (n - 60) * (len(long) - len(short)) // 10


@pytest.mark.parametrize("faces", [[], [[0, 1, 2]], [[0, 1, 1]], [[0, 1, 2]] * 70, [[0, 1, 2], [3, 4, 5]] * 20])
def test_few_faces_and_many_alike(faces):
    x0 = np.random.default_rng(0).uniform(-1.0, 1.0, (7, 3)).astype(np.float32)
    mesh = bsc.CollisionMesh(np.array(faces, dtype=np.int32), len(x0))
    x1 = x0[::-1].copy()
    assert find_pairs(BroadPhaseHierarchy, mesh, x0, x1) == all_pairs(mesh, x0, x1)


@pytest.mark.parametrize("broad_phase", [BroadPhaseSimd, BroadPhaseHierarchy])
@pytest.mark.parametrize("padded", [False, True])
@pytest.mark.parametrize("parts", [1, 3])
def test_pairs_of_clipped_paths_are_found_among_those_of_the_run_before(
    broad_phase, padded, parts, device, monkeypatch
):
    """Traversed once, or again in a large mesh, they are those of a run of their own."""
    if broad_phase is BroadPhaseSimd and wp.get_device(device).is_cuda:
        pytest.skip("SIMD packets are for the CPU")
    monkeypatch.setattr(broad_phase_hierarchy, "CLUSTERS_OF_PART", 8 if parts > 1 else 2**15)
    rng = np.random.default_rng(0)
    centres, ways = rng.uniform(-1.0, 1.0, (500, 1, 3)), rng.uniform(-0.3, 0.3, (500, 1, 3))
    x0 = centres + rng.uniform(-0.05, 0.05, (500, 3, 3))
    x0, x1 = ((x0 + way).reshape(-1, 3).astype(np.float32) for way in (0.0, ways))
    ends = np.where(rng.integers(0, 2, x0.shape) == 1, x0, x1)
    mesh = bsc.CollisionMesh(np.arange(1500).reshape(-1, 3), len(x0), device=device)
    padding = wp.full(len(x0), 0.02, dtype=wp.float64, device=device) if padded else None
    x0, x1, ends = (wp.array(x, dtype=wp.vec3, device=device) for x in (x0, x1, ends))
    found = []
    for again in (False, True):
        finder = broad_phase(mesh, wp.zeros(1, dtype=wp.int64, device=device), padding=padding)
        finder.grow(1_000_000)
        counts = wp.zeros((2, len(Count)), dtype=wp.int64, device=device)
        queues = [wp.zeros(400_000, dtype=wp.vec2i, device=device) for _ in range(2)]
        out = counts[0], queues[0], counts[1], queues[1]
        if again:
            finder.pair_elements(x0, x1, *out, keep_separated=True)
            more = counts.numpy()[:, Count.QUEUED].copy()
            counts.zero_()
            finder.pair_elements_again(x0, ends, *out)
            assert (more > counts.numpy()[:, Count.QUEUED]).all()
        else:
            finder.pair_elements(x0, ends, *out, keep_separated=True)
        numbers = counts.numpy()[:, Count.QUEUED]
        found.append([in_lexicographic_order(q.numpy()[:n]) for q, n in zip(queues, numbers, strict=True)])
    assert found[0] == found[1] and all(found[0])


def face_pairs(mesh, x0, x1, changed=None, keep_separated=False):
    """Pairs of faces that a hierarchy enqueues, sorted within and among each other, shape [n, 2]."""
    device = mesh.device
    count = wp.zeros(1, dtype=wp.int64, device=device)
    finder = BroadPhaseHierarchy(mesh, count, capacity=4_000_000)
    positions = [wp.array(x, dtype=wp.vec3, device=device) for x in (x0, x1)]
    changed = None if changed is None else wp.array(changed, dtype=int, device=device)
    finder.pair_faces(*positions, changed, keep_separated)
    pairs = mesh.face_order[finder.face_pairs.numpy()[: count.numpy()[0]]]
    return in_order(pairs, len(mesh.faces))


def in_order(pairs, count):
    """Pairs of numbers below a count, sorted within and among each other."""
    return np.stack(np.divmod(np.sort(np.sort(pairs.astype(np.int64), axis=1) @ [count, 1]), count), axis=1)


def sorted_face_pairs(mesh, x0, x1, keep_separated=False):
    """The same from boxes sorted along an axis, world by world."""
    x0, x1 = x0.astype(np.float32), x1.astype(np.float32)
    lows = np.stack([x[mesh.faces].min(axis=1) for x in (x0, x1)])
    highs = np.stack([x[mesh.faces].max(axis=1) for x in (x0, x1)])
    world = np.zeros(len(mesh.faces)) if mesh.world is None else mesh.world[mesh.faces[:, 0]]
    found = []
    for number in np.unique(world):
        order = np.flatnonzero(world == number)
        order = order[np.argsort(lows[:, order, 0].min(axis=0), kind="stable")]
        (low_x, low_y, low_z), (_, high_y, high_z) = (
            lows[:, order].min(axis=0).T.copy(),
            highs[:, order].max(axis=0).T.copy(),
        )
        for i, stop in enumerate(np.searchsorted(low_x, highs[:, order, 0].max(axis=0), side="right")):
            others = slice(i + 1, stop)
            overlap = (low_y[i] <= high_y[others]) & (low_y[others] <= high_y[i])
            overlap &= (low_z[i] <= high_z[others]) & (low_z[others] <= high_z[i])
            found.append(order[np.stack(np.broadcast_arrays(i, i + 1 + np.flatnonzero(overlap)), axis=1)])
    a, b = np.concatenate(found).T
    if not keep_separated:
        below, above = highs[:, a] < lows[:, b], lows[:, a] > highs[:, b]
        together = ~(below.all(axis=0) | above.all(axis=0)).any(axis=1)
        a, b = a[together], b[together]
    return in_order(np.stack([a, b], axis=1), len(mesh.faces))


def assert_contains(found, expected):
    """Pairs of faces are in order, each once; boxes in coded form may keep a few that an axis separates."""
    assert len(np.unique(found, axis=0)) == len(found)
    assert len(np.unique(np.concatenate([found, expected]), axis=0)) == len(found) <= 1.001 * len(expected)


@wp.kernel(module="unique", enable_backward=False)
def _compare_codes(boxes: wp.array2d[wp.vec3], node: BoxRows, apart: wp.array2d[int]):
    i, j = wp.tid()
    if codes_apart(coded_box(read_box(boxes, i), node), coded_box(read_box(boxes, j), node)):
        apart[i, j] = 1


@pytest.mark.parametrize("kind", ["extremes", "neighbours", "far from zero", "ordinary"])
def test_coded_boxes_are_apart_only_if_boxes_are(kind, device):
    """For coordinates of any size, of which many are equal or next to each other, in a node and partly beyond it."""
    random, largest = np.random.default_rng(0), np.finfo(np.float32).max
    values = {
        "extremes": np.array([0.0, 1e-45, 3e-39, 1e-30, 1.0, 2.0, 1e30, 0.5 * largest, largest]),
        "neighbours": 1.0 + 2.0**-23 * np.arange(12.0),
        "far from zero": 1e6 + 0.0625 * np.arange(400.0),
        "ordinary": random.uniform(-1.0, 1.0, 10_000),
    }[kind]
    values = np.concatenate([values, -values]) if kind == "extremes" else values
    ends = np.sort(random.choice(values, (300, 2, 2, 3)), axis=2).astype(np.float32)  # box, end, low and high
    boxes, inside = ends.reshape(-1, 4, 3), slice(0, 3)
    node = np.stack([getattr(boxes[inside, row], ("min", "max")[row % 2])(axis=0) for row in range(4)])
    apart = wp.zeros((300, 300), dtype=int, device=device)
    given = wp.array(boxes, dtype=wp.vec3, device=device)
    wp.launch(
        _compare_codes, (300, 300), inputs=[given, BoxRows(*node.ravel().tolist())], outputs=[apart], device=device
    )
    a, b = boxes[:, None].astype(np.float64), boxes[None].astype(np.float64)
    gap = np.maximum(*(np.minimum(*(y[:, :, k] - x[:, :, k + 1] for k in (0, 2))) for x, y in ((a, b), (b, a)))).max(
        axis=2
    )
    found = apart.numpy() != 0
    assert found.any() and not (found & (gap <= 0.0)).any()
    if kind == "ordinary":  # a pair of one in the node is told apart where the gap is more than a step
        step = (node[[1, 3]] - node[[0, 2]]).max() / 509.0
        assert found[inside][gap[inside] > step].all()


@pytest.mark.parametrize(
    "worlds, few_nodes",
    [
        (1, 0),
        (3, face_hierarchy.FEW_NODES),
        pytest.param(1, face_hierarchy.FEW_NODES, marks=pytest.mark.slow),
        pytest.param(3, 0, marks=pytest.mark.slow),
    ],
)
def test_many_bundles(worlds, few_nodes, monkeypatch):
    """More bundles than a warp tests at once, of one sheet that moves through itself; with groups of them as well."""
    monkeypatch.setattr(face_hierarchy, "FEW_NODES", few_nodes)
    n = 132 if worlds == 1 else 76
    x0, x1, faces = crumpled(0, n)
    world = None
    if worlds > 1:
        world = np.repeat(np.arange(worlds)[::-1], len(x0))
        faces = np.concatenate([faces + len(x0) * i for i in range(worlds)])
        x0, x1 = (np.tile(x, (worlds, 1)) for x in (x0, x1))
    mesh = bsc.CollisionMesh(faces, len(x0), world=world)
    assert len(mesh.face_order) > 33 * 1024 or worlds > 1
    for keep_separated in (False, True):
        found = face_pairs(mesh, x0, x1, keep_separated=keep_separated)
        assert len(found) > 10 * len(faces)
        assert_contains(found, sorted_face_pairs(mesh, x0, x1, keep_separated))


def test_parts_of_a_large_mesh(monkeypatch, device):
    """The queue of pairs of faces need only hold those of one part, whose count is the largest."""
    x0, x1, faces = crumpled(0)
    mesh = bsc.CollisionMesh(faces, len(x0), device=device)
    positions = [wp.array(x, dtype=wp.vec3, device=mesh.device) for x in (x0, x1)]
    found = []
    for clusters in (1000, 3):
        monkeypatch.setattr(broad_phase_hierarchy, "CLUSTERS_OF_PART", clusters)
        count = wp.zeros(1, dtype=wp.int64, device=mesh.device)
        finder = BroadPhaseHierarchy(mesh, count, capacity=found[0][0] // 2 if found else 1_000_000)
        counts = wp.zeros((2, len(Count)), dtype=wp.int64, device=mesh.device)
        queues = [wp.empty(400_000, dtype=wp.vec2i, device=mesh.device) for _ in range(2)]
        finder.pair_elements(*positions, counts[0], queues[0], counts[1], queues[1])
        sizes = counts.numpy()[:, Count.QUEUED]
        pairs = [in_lexicographic_order(queue.numpy()[:size]) for queue, size in zip(queues, sizes, strict=True)]
        found.append((int(count.numpy()[0]), pairs))
    assert 0 < found[1][0] < found[0][0] // 2
    assert min(len(pairs) for pairs in found[0][1]) > 1000
    assert found[0][1] == found[1][1]


def test_pairs_of_faces_of_which_one_has_changed():
    x0, x1, faces = crumpled(0)
    mesh = bsc.CollisionMesh(faces, len(x0))
    everything = sorted_face_pairs(mesh, x0, x1)
    random = np.random.default_rng(0)
    for share in (0.0, 0.001, 0.1, 1.0):
        changed = (random.random(len(x0)) < share).astype(np.int32) * random.integers(1, 3, len(x0)).astype(np.int32)
        changes = (changed[mesh.faces] != 0).any(axis=1)
        expected = everything[changes[everything].any(axis=1)]
        assert_contains(face_pairs(mesh, x0, x1, changed), expected)


def test_no_face_of_a_closed_surface_represents_its_last_side():
    """Nor does another face represent what one has: numbers of vertices and the order of faces are random."""
    random = np.random.default_rng(0)
    sphere = trimesh.creation.icosphere(3)
    faces = random.permutation(len(sphere.vertices))[random.permutation(sphere.faces)]
    faces = np.stack([np.roll(face, turn) for face, turn in zip(faces, random.integers(0, 3, len(faces)), strict=True)])
    mesh = bsc.CollisionMesh(faces, len(sphere.vertices), edges=[[0, 200]])
    cells, owned, edges = np.split(mesh.rows, [3, 4], axis=1)
    assert (cells[:, 0] == mesh.cells.min(axis=1)).all()
    for j in range(3):
        ends = np.sort(cells[:, [j, (j + 1) % 3]], axis=1)
        assert (mesh.edges[edges[:-1, j]] == ends[:-1]).all()
    for elements, count, first in ((cells, mesh.vertex_count, 0), (edges, len(mesh.edges), 3)):
        is_owned = (owned >> np.arange(first, first + 3)) & 1 == 1
        assert (np.sort(elements[is_owned]) == np.arange(count)).all()
        assert not is_owned[:-1, 2].any()
    assert (owned[:-1] & 8 != 0).all()


def test_simd_packets_leave_out_pairs_within_a_rigid_body():
    """And those of what has not changed: 1 marks cloth, 0 shapes that stand, more are bodies."""
    random = np.random.default_rng(0)
    faces = np.arange(180).reshape(60, 3)
    mark = np.repeat(random.integers(0, 4, 60), 3)
    x0, x1 = random.uniform(0.0, 1.0, (2, 180, 3)).astype(np.float32)
    mesh = bsc.CollisionMesh(faces, len(x0))
    found = find_pairs(BroadPhaseSimd, mesh, x0, x1, mark)
    everything = all_pairs(mesh, x0, x1)
    for k, (first, second) in enumerate([(np.arange(180), faces[:, 0]), (mesh.edges[:, 0], mesh.edges[:, 0])]):
        i, j = np.divmod(everything[k], 2**32)
        marks, others = mark[first[i]], mark[second[j]]
        sought = (marks != others) | (marks == 1)
        assert 0 < sought.sum() < len(sought)
        assert found[k] == np.array(everything[k])[sought].tolist()


@wp.struct
class _Visits:
    faces: wp.array[int]


@wp.func
def _count_visit(place: int, first: int, found: wp.uint32, visits: _Visits):
    wp.atomic_add(visits.faces, place, count_set_bits(found))


def test_a_traversal_with_another_visit():
    """A kernel that counts, for each face, the pairs that it is visited for."""
    x, faces = grid(20)
    mesh = bsc.CollisionMesh(faces, len(x))
    device = mesh.device
    finder = BroadPhaseHierarchy(mesh, wp.zeros(1, dtype=wp.int64, device=device))
    x = wp.array(x, dtype=wp.vec3, device=device)
    finder.fit(x, x)
    visits = _Visits()
    visits.faces = wp.zeros(len(mesh.face_order), dtype=int, device=device)
    finder.traverse(traversal_kernel(_count_visit, _Visits, finder.is_padded), visits)
    counted = visits.faces.numpy()
    assert counted[mesh.face_order < 0].sum() == 0
    # each quad has one pair within, and four with each of its 8 neighbours
    assert counted.sum() == 400 + 4 * (2 * 20 * 19 + 2 * 19 * 19)


@pytest.mark.parametrize("broken", [0, 12])
def test_faces_that_an_axis_separates_are_left_out(broken):
    """Layers that fall together have few pairs of faces, and all their candidates, also next to what is not finite."""
    random = np.random.default_rng(broken)
    x, faces = grid(8)
    layers = np.arange(12)[:, None, None]
    x0 = (x + 0.05 * layers * [0.0, 0.0, 1.0] + random.normal(scale=0.02, size=(12, *x.shape))).reshape(-1, 3)
    x1 = x0 + np.array([0.0, 0.1, -0.4]) + random.normal(scale=0.02, size=x0.shape)
    faces = (faces + len(x) * layers).reshape(-1, 3)
    x1[random.choice(len(x1), broken, replace=False), 1] = np.nan
    mesh = bsc.CollisionMesh(faces, len(x0))
    found, count = find_pairs(BroadPhaseHierarchy, mesh, x0, x1), wp.zeros(1, dtype=wp.int64, device=mesh.device)
    for pairs, expected in zip(found, all_pairs(mesh, x0, x1), strict=True):
        assert pairs == expected
        assert len(expected) > 1000
    x0, x1 = (wp.array(x, dtype=wp.vec3d, device=mesh.device) for x in (x0, x1))
    counts = []
    for keep_separated in (False, True):
        count.zero_()
        finder = BroadPhaseHierarchy(mesh, count, capacity=10)
        queues = [
            wp.zeros(size, dtype=dtype, device=mesh.device) for size, dtype in [(len(Count), wp.int64), (1, wp.vec2i)]
        ]
        finder.pair_elements(x0, x1, *queues, *queues, keep_separated=keep_separated)
        counts.append(int(count.numpy()[0]))
    assert counts[0] < 0.7 * counts[1]


@pytest.mark.parametrize("dtype", [wp.vec3, wp.vec3d])
def test_positions_that_are_not_finite_are_counted(dtype):
    x0, _, faces = crumpled(0, 8)
    mesh = bsc.CollisionMesh(faces, len(x0) + 2)
    device = mesh.device
    x0 = np.concatenate([x0, [[np.nan] * 3, [np.inf] * 3]])
    x1 = x0.copy()
    x0[3, 1], x1[3, 0], x1[50, 2] = np.nan, np.inf, -np.inf
    used = wp.array(np.isin(np.arange(mesh.vertex_count), mesh.vertices), dtype=int, device=device)
    for checked, expected in ((None, 4), (used, 2)):
        counts = [wp.zeros(1, dtype=wp.int64, device=device) for _ in range(2)]
        finder = BroadPhaseHierarchy(mesh, counts[0], not_finite=counts[1], checked=checked)
        finder.fit(*(wp.array(x, dtype=dtype, device=device) for x in (x0, x1)))
        assert counts[1].numpy()[0] == expected


@pytest.mark.parametrize("broad_phase", [BroadPhaseSimd, BroadPhaseHierarchy])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("at_end", [False, True])
def test_elements_without_finite_positions_have_no_pairs(broad_phase, dtype, at_end):
    """All pairs of other elements are found."""
    random = np.random.default_rng(1)
    x0, x1, faces = crumpled(1, 12)
    mesh = bsc.CollisionMesh(faces, len(x0))
    x0, x1 = x0.astype(dtype), x1.astype(dtype)
    everything = all_pairs(mesh, x0, x1)
    broken = random.random(len(x0)) < 0.05
    values = random.choice(np.array([np.nan, np.inf, -np.inf], dtype=dtype), (len(x0), 3))
    some = broken[:, None] & (random.random((len(x0), 3)) < 0.5)
    some[broken, 0] |= ~some[broken].any(axis=1)
    wrong = [np.where(some & (at_end == bool(i)), values, x) for i, x in enumerate((x0, x1))]
    found = find_pairs(broad_phase, mesh, *wrong)
    of_faces, of_edges, of_vertices = broken[faces].any(axis=1), broken[mesh.edges].any(axis=1), broken
    kinds = [(of_vertices, of_faces, True), (of_edges, of_edges, True), (of_edges, of_faces, not at_end)]
    for pairs, expected, (first, second, moves) in zip(found, everything, kinds, strict=True):
        a, b = np.divmod(expected, 2**32)
        left = np.array(expected)[~(moves & (first[a] | second[b]))].tolist()
        assert pairs == left
        assert left and (len(left) < len(expected) or not moves)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("keep_separated", [False, True])
@pytest.mark.parametrize("padding", [None, "equal", "different"])
def test_both_broad_phases_find_the_same(device, dtype, keep_separated, padding):
    """All kinds of pairs of sheets, ropes and points, with paddings, a filter, and what is not finite.

    The hierarchy pads all elements of a cell as its widest vertex: where paddings differ it finds some more pairs.
    """
    random = np.random.default_rng(4)
    x, sheet = grid(7)
    count = 3 * len(x)
    faces = (sheet + len(x) * np.arange(3)[:, None, None]).reshape(-1, 3)
    ropes = count + np.array([[i, i + 1] for i in range(29) if i % 10 != 9])
    ends = np.array([[0, count], [len(x), count + 10]])  # ropes that are tied to sheets
    vertices = count + 30 + 170
    layers = x + np.arange(3)[:, None, None] * [0.0, 0.0, 0.1]
    x0 = np.concatenate([*layers, random.uniform(0.0, 1.0, (200, 3)) * [1.0, 1.0, 0.4]])
    x0 = (x0 + random.normal(scale=0.03, size=x0.shape)).astype(dtype)
    x1 = (x0 + random.normal(scale=0.1, size=x0.shape)).astype(dtype)
    x1[random.choice(vertices, 9, replace=False), 1] = np.nan
    meshes = [
        bsc.CollisionMesh(
            faces,
            vertices,
            edges=np.concatenate([ropes, ends]),
            points=np.arange(count + 30, vertices),
            group=random.choice([1, 3], vertices),
            mask=random.choice([1, 2, 3], vertices),
            device=of,
        )
        for of in ("cpu", device)
        for random in [np.random.default_rng(5)]
    ]
    padded = {
        None: None,
        "equal": np.full(vertices, 0.02),
        "different": 0.05 * random.random(vertices) * (random.random(vertices) < 0.8),
    }[padding]
    found = []
    for broad_phase, mesh in zip((BroadPhaseSimd, BroadPhaseHierarchy), meshes, strict=True):
        type_of = wp.vec3 if dtype == np.float32 else wp.vec3d
        ends = [wp.array(x, dtype=type_of, device=mesh.device) for x in (x0, x1)]
        own_count = wp.zeros(1, dtype=wp.int64, device=mesh.device)
        paddings = None if padded is None else wp.array(padded, dtype=wp.float64, device=mesh.device)
        finder = broad_phase(mesh, own_count, padding=paddings)
        finder.grow(200_000)
        counts = [wp.zeros(len(Count), dtype=wp.int64, device=mesh.device) for _ in range(4)]
        queues = [wp.zeros(100_000, dtype=wp.vec2i, device=mesh.device) for _ in range(4)]
        inputs = [array for pair in zip(counts, queues, strict=True) for array in pair]
        finder.pair_elements(*ends, *inputs, keep_separated=keep_separated)
        numbers = [count.numpy() for count in counts]
        of_kinds = [queue.numpy()[: n[Count.QUEUED]] for queue, n in zip(queues, numbers, strict=True)]
        found.append(([in_lexicographic_order(pairs) for pairs in of_kinds], [n[Count.FILTERED] for n in numbers]))
    if padding == "different":
        for pairs, more in zip(found[0][0], found[1][0], strict=True):
            assert set(pairs) <= set(more) and len(pairs) <= len(more) < 1.3 * len(pairs)
    else:
        assert found[0] == found[1]
    assert [len(pairs) > n for pairs, n in zip(found[0][0], (300, 300, 5, 5), strict=True)] == [True] * 4
    assert min(found[0][1]) > 5


@wp.kernel
def transpose_cells(cells: wp.array[wp.vec3i], places: wp.array[wp.vec3i]):
    places[wp.tid()] = hilbert_transpose(cells[wp.tid()])


@pytest.mark.parametrize("corner", [0, 1008])
def test_a_hilbert_curve_goes_from_each_cell_to_one_beside_it(corner, device):
    """The curve passes all 4,096 cells of a cube of its grid before it leaves the cube."""
    cells = np.stack(np.indices((16, 16, 16)), axis=-1).reshape(-1, 3) + corner
    places = wp.empty(len(cells), dtype=wp.vec3i, device=device)
    wp.launch(transpose_cells, len(cells), [wp.array(cells, dtype=wp.vec3i, device=device), places], device=device)
    bits = (places.numpy()[:, None] >> np.arange(9, -1, -1)[:, None]) & 1  # of each number in turn, the highest first
    codes = bits.reshape(-1, 30) @ (1 << np.arange(29, -1, -1))
    order = np.argsort(codes)
    np.testing.assert_array_equal(codes[order], codes.min() + np.arange(len(cells)))
    assert (np.abs(np.diff(cells[order], axis=0)).sum(axis=1) == 1).all()


@pytest.mark.parametrize("only_free", [False, True])
def test_pairs_of_strands_and_faces_of_which_one_has_changed(device, only_free):
    """Both broad phases seek those of a face that has changed with a rope or a point that has not."""
    random, seen = np.random.default_rng(0), 0
    for _ in range(40):
        counts = random.integers(0, 4, 3)
        ends = np.cumsum(counts * [3, 2, 1])
        vertices = random.permutation(ends[-1] + 1)
        faces, edges, points, _ = np.split(vertices, ends)
        x0 = random.normal(size=(len(vertices), 3))
        positions = x0, x0 + 0.3 * random.normal(size=x0.shape)
        changed = random.integers(0, 2, len(vertices)).astype(np.int32)
        found = []
        for broad_phase, of in ((BroadPhaseSimd, wp.get_device("cpu")), (BroadPhaseHierarchy, device)):
            strands = {"edges": edges.reshape(-1, 2), "points": points, "only_free": only_free}
            mesh = bsc.CollisionMesh(faces.reshape(-1, 3), len(vertices), **strands, device=of)
            padding = wp.full(len(vertices), 0.1, dtype=wp.float64, device=of)
            finder = broad_phase(mesh, wp.zeros(1, dtype=wp.int64, device=of), padding=padding)
            finder.grow(10_000)
            queues = [
                wp.zeros((4, len(Count)), dtype=wp.int64, device=of),
                wp.empty((4, 2000), dtype=wp.vec2i, device=of),
            ]
            out = [queue[k] for k in range(4) for queue in queues]
            given = [wp.array(x, dtype=wp.vec3d, device=of) for x in positions]
            finder.pair_elements(*given, *out, changed=wp.array(changed, dtype=int, device=of))
            counted, pairs = (queue.numpy() for queue in queues)
            found.append([(k, *pair) for k in range(4) for pair in pairs[k, : counted[k, Count.QUEUED]].tolist()])
        assert set(found[0]) <= set(found[1]) and len(set(found[1])) == len(found[1])
        seen += len(found[0])
    assert seen > 200
