"""Bodies that turn: no collision on their arcs is missed, and what stays farther apart than the tolerance is none."""

import hypothesis
import hypothesis.strategies as st
import numpy as np
import pytest
import trimesh
import warp as wp
from arc_truth import path, sampled_distances, speed_bounds
from sheets import crumpled

import warp_bsc as bsc
from warp_bsc.detection.arcs import arc_pipeline
from warp_bsc.detection.arcs.rigid_motion import ArcBounds

KINDS = ("vertex_face", "edge_edge")
X, Y, Z = np.eye(3)


def rotation(turn):
    """The matrix of a turn."""
    angle = np.linalg.norm(turn)
    k = np.asarray(turn) / (angle or 1.0)
    cross = np.array([[0.0, -k[2], k[1]], [k[2], 0.0, -k[0]], [-k[1], k[0], 0.0]])
    return np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross


def moved(x, centre, turn, translation=0.0):
    return (x - centre) @ rotation(turn).T + centre + translation


def together(*meshes):
    """The faces of meshes as one, their positions, and the mesh of each vertex."""
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)])
    number = np.repeat(np.arange(len(meshes)), np.diff(starts))
    return faces, np.concatenate([mesh.vertices for mesh in meshes]), number


def random_scene(seed, dtype=np.float64):
    """Three small bodies that turn, one that moves straight and one at rest: mesh, positions and motion."""
    rng = np.random.default_rng(seed)
    solids = [
        trimesh.creation.icosahedron(),
        trimesh.creation.box((1.6, 0.5, 0.2)),
        trimesh.creation.box((0.2, 2, 0.4)),
    ]
    bodies = [solids[i].copy() for i in rng.integers(0, 3, 5)]
    for body in bodies:
        body.apply_transform(trimesh.transformations.random_rotation_matrix(rng.random(3)))
        body.apply_translation(rng.uniform(-1.5, 1.5, 3))
    faces, x0, number = together(*bodies)
    turn = rng.standard_normal((3, 3))
    turn *= rng.uniform(0.2, 9.0, (3, 1)) / np.linalg.norm(turn, axis=1, keepdims=True)
    centre = np.array([x0[number == i].mean(axis=0) for i in range(3)]) + rng.uniform(-0.6, 0.6, (3, 3))
    x1 = x0.copy()
    for i in range(3):
        x1[number == i] = moved(x0[number == i], centre[i], turn[i], rng.uniform(-1.0, 1.0, 3))
    x1[number == 3] += rng.uniform(-1.0, 1.0, 3)
    body = np.where(number < 3, number, -1)
    motion = bsc.RigidMotion(body, centre, turn, tolerance=float(rng.choice([0.05, 0.004])))
    return bsc.CollisionMesh(faces, len(x0)), x0.astype(dtype), x1.astype(dtype), motion, number


def pairs_of(mesh, kind):
    """All pairs of a kind that share no vertex, and their vertices."""
    firsts = np.arange(mesh.vertex_count if kind == "vertex_face" else len(mesh.edges))
    seconds = mesh.faces if kind == "vertex_face" else mesh.edges
    pairs = np.stack(np.meshgrid(firsts, np.arange(len(seconds)), indexing="ij"), axis=-1).reshape(-1, 2)
    if kind == "edge_edge":
        pairs = pairs[pairs[:, 0] < pairs[:, 1]]
    first = pairs[:, :1] if kind == "vertex_face" else mesh.edges[pairs[:, 0]]
    corners = np.concatenate([first, seconds[pairs[:, 1]]], axis=1)
    apart = (first[:, :, None] != seconds[pairs[:, 1]][:, None, :]).all(axis=(1, 2))
    return pairs[apart], corners[apart]


@pytest.mark.parametrize("seed", [1, 4, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (3, 8))])
def test_all_that_collides_is_found_and_nothing_far(seed, device):
    """Against 200 samples of every pair, with a bound of what lies between them."""
    dtype = np.float32 if seed % 2 else np.float64
    mesh, x0, x1, motion, number = random_scene(seed, dtype)
    found = bsc.CollisionDetector(mesh).detect(x0, x1, rigid_motion=motion)
    assert found.certified
    samples = 200
    times = np.arange(samples + 1) / samples
    x = np.stack([motion.positions(x0, x1, time) for time in times])
    speed = speed_bounds(motion, x0.astype(float), x1.astype(float))
    hits = 0
    for kind in KINDS:
        pairs, corners = pairs_of(mesh, kind)
        different = number[corners[:, 0]] != number[corners[:, -1]]
        pairs, corners = pairs[different], corners[different]
        distance = np.stack([sampled_distances(kind, x[i][corners]) for i in range(samples + 1)])
        first = 1 if kind == "vertex_face" else 2
        between = (speed[corners[:, :first]].max(axis=1) + speed[corners[:, first:]].max(axis=1)) * 0.5 / samples
        turning = (motion.body[corners] >= 0).any(axis=1)
        allowed = np.where(turning, motion.tolerance, 0.0)
        reported = dict(
            zip(map(tuple, getattr(found, kind).tolist()), getattr(found, f"{kind}_toi").tolist(), strict=True)
        )
        assert len(reported) == len(getattr(found, kind))
        for row, pair in enumerate(map(tuple, pairs.tolist())):
            near = distance[:, row].min()
            if pair in reported:
                assert near <= allowed[row] + between[row], (kind, pair, near)
                # it does come within the tolerance, not long after that time
                at = np.flatnonzero(distance[:, row] <= allowed[row] + between[row])[0] / samples
                assert reported[pair] >= at - 1.0 / samples
                hits += 1
        assert set(reported) <= set(map(tuple, pairs.tolist()))  # none within a body
    # the samples in which edges pass through faces come after the first time of impact of their two bodies
    finder = bsc.CollisionDetector(mesh)

    def crossing(i):
        rows = finder.find_intersections(x[i])
        return set(
            map(frozenset, np.stack([number[mesh.edges[rows[:, 0], 0]], number[mesh.faces[rows[:, 1], 0]]], 1).tolist())
        )

    at_start, crossings = crossing(0), 0
    for i in range(8, samples + 1, 8):
        for two in crossing(i) - at_start:
            assert len(two) == 2 and earliest_between(mesh, found, number, two) <= times[i]
            crossings += 1
    assert hits > 0 and crossings > 0


def earliest_between(mesh, found, number, two):
    """The first time of impact of two bodies, 2 without any."""
    first = 2.0
    for kind in KINDS:
        elements = mesh.faces if kind == "vertex_face" else mesh.edges
        pairs, toi = getattr(found, kind), getattr(found, f"{kind}_toi")
        firsts = number[pairs[:, 0]] if kind == "vertex_face" else number[mesh.edges[pairs[:, 0], 0]]
        seconds = number[elements[pairs[:, 1], 0]]
        for a, b, time in zip(firsts.tolist(), seconds.tolist(), toi.tolist(), strict=True):
            if frozenset((a, b)) == two:
                first = min(first, time)
    return first


@hypothesis.given(st.integers(0, 2**32 - 1))
def test_two_bodies_that_meet_at_some_time_are_found_by_then(seed):
    """A vertex passes through a face, or an edge through an edge, at a time that the scene is built for."""
    rng = np.random.default_rng(seed)
    kind = KINDS[rng.integers(2)]
    time = rng.uniform(0.02, 0.98)
    centre = rng.uniform(-1.0, 1.0, (2, 3))
    turn = rng.standard_normal((2, 3))
    turn *= rng.uniform(0.1, 12.0, (2, 1)) / np.linalg.norm(turn, axis=1, keepdims=True)
    translation = rng.uniform(-1.0, 1.0, (2, 3))
    n = 3 if kind == "vertex_face" else 4
    meeting = rng.uniform(-1.0, 1.0, (n + (kind == "vertex_face"), 3))  # where all are at that time
    if kind == "vertex_face":
        meeting[0] = rng.dirichlet((3.0, 3.0, 3.0)) @ meeting[1:]
    else:
        s, r = rng.uniform(0.2, 0.8, 2)
        meeting[2:] += meeting[0] + s * (meeting[1] - meeting[0]) - meeting[2] - r * (meeting[3] - meeting[2])
    number = np.array([0, 1, 1, 1] if kind == "vertex_face" else [0, 0, 1, 1])
    x0, x1 = np.empty_like(meeting), np.empty_like(meeting)
    for i in range(2):
        own = number == i
        at = meeting[own] - centre[i] - time * translation[i]
        x0[own] = at @ rotation(time * turn[i]) + centre[i]
        x1[own] = moved(x0[own], centre[i], turn[i], translation[i])
    motion = bsc.RigidMotion(number, centre, turn, tolerance=0.01)
    before, after = (motion.positions(x0, x1, time + step) for step in (-1e-5, 1e-5))
    if kind == "vertex_face":
        mesh, pair = bsc.CollisionMesh([[1, 2, 3], [0, 0, 0]], 4), [0, 0]
    else:
        mesh, pair = bsc.CollisionMesh([], 4, edges=[[0, 1], [2, 3]]), [0, 1]
    volumes = [np.linalg.det(x[1:] - x[0]) for x in (before, after)]
    hypothesis.assume(volumes[0] * volumes[1] < 0 and min(map(abs, volumes)) > 1e-8)
    found = bsc.CollisionDetector(mesh).detect(x0, x1, rigid_motion=motion)
    assert pair in getattr(found, kind).tolist()
    row = getattr(found, kind).tolist().index(pair)
    assert getattr(found, f"{kind}_toi")[row] <= time + 1e-9


@pytest.mark.parametrize("depth", [1e-12, 1e-7, 1e-3])
def test_a_tip_that_reaches_a_wall_in_the_middle_of_a_turn_only(depth, device, broad_phase):
    """It is in the wall for a moment, by less than the chords of any part that is looked at are within it."""
    x0 = np.array([[1.0, -1.0, 0.0], [-1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [0, 0, 0], [0, 0, 0], [0, 0, 0]])
    tip = rotation(-0.7 * Z) @ X
    x0[:3] = [tip, 0.3 * tip, 0.3 * tip + 0.1 * Z]
    x1 = x0.copy()
    x1[:3] = moved(x0[:3], 0.0, 1.4 * Z)
    wall = 1.0 - depth
    x0[3:] = x1[3:] = [[wall, -2, -2], [wall, 2, -2], [wall, 0, 3]]
    body, mesh = [0, 0, 0, -1, -1, -1], bsc.CollisionMesh([[0, 1, 2], [3, 4, 5]], 6)
    arcs = bsc.RigidMotion(body, [[0.0, 0, 0]], [1.4 * Z], tolerance=1e-4)
    assert path(x0[0], x1[0], arcs.centre[0], arcs.turn[0], 0.5)[0] > wall  # the truth
    detector = bsc.CollisionDetector(mesh, method="exact")
    assert len(detector.detect(x0, x1).vertex_face) == 0  # the chord does not reach it
    found = detector.detect(x0, x1, rigid_motion=arcs)
    assert found.vertex_face.tolist() == [[0, 1]] and found.certified
    true_time = 0.5 - np.arccos(wall) / 1.4
    within = np.arccos(min(1.0, wall - 1.1e-4)) / 1.4  # half of the time that it spends within the tolerance
    assert 0.5 - within - 2.0**-5 * 0.1 <= found.vertex_face_toi[0] <= true_time
    np.testing.assert_allclose(found.vertex_face_normal[0], -X, atol=0.02)
    x0[3:, 0] = x1[3:, 0] = 1.0 + 1.01e-4
    assert len(detector.detect(x0, x1, rigid_motion=arcs).vertex_face) == 0


def test_inside_of_an_arc_no_pair_is_reported_beyond_the_tolerance(device):
    """In the middle of a part whose chord is 0.95 of the tolerance inside of the arc."""
    deviation = (1.0 / 8.0) ** 2 / 8.0
    tolerance = deviation / 0.95
    for distance, hits in ((1e-9, [[0, 1]]), (1.02, []), (1.5, []), (1.8, [])):
        at = rotation(5.5 / 8.0 * Z) @ ((1.0 - distance * tolerance) * X)
        x0 = np.stack([X - Z, X + Z, at - 0.5 * Z, at + 0.5 * Z])
        x1 = x0.copy()
        x1[:2] = moved(x0[:2], 0.0, Z)
        arcs = bsc.RigidMotion([0, 0, -1, -1], [[0.0, 0, 0]], [Z], tolerance=tolerance)
        mesh = bsc.CollisionMesh([], 4, edges=[[0, 1], [2, 3]])
        assert bsc.CollisionDetector(mesh).detect(x0, x1, rigid_motion=arcs).edge_edge.tolist() == hits


def test_a_screw_reaches_the_obstacle_in_its_third_turn(device):
    x0 = np.array([[1, 0, 0], [0.5, 0, 0], [0.5, 0, 0.01], [0.8, -0.2, 0.5], [0.8, 0.2, 0.5], [1.4, 0.0, 0.5]], float)
    turn, rise = 4.0 * 2.0 * np.pi * Z, 0.8 * Z
    x1 = x0.copy()
    x1[:3] = moved(x0[:3], 0.0, turn, rise)
    arcs = bsc.RigidMotion([0, 0, 0, -1, -1, -1], [[0.0, 0, 0]], [turn], tolerance=1e-4)
    mesh = bsc.CollisionMesh([[0, 1, 2], [3, 4, 5]], 6)
    found = bsc.CollisionDetector(mesh).detect(x0, x1, rigid_motion=arcs)
    # at z = 0.5, after two and a half turns, it is on the other side, at the height of the next pass below or above
    assert found.earliest_toi == 2.0
    x0[3:, 2] = x1[3:, 2] = 0.6
    found = bsc.CollisionDetector(mesh).detect(x0, x1, rigid_motion=arcs)
    assert 0.74 < found.earliest_toi < 0.75  # of the edge to the vertex that is higher
    assert [0, 1] in found.vertex_face.tolist()


def test_pairs_that_do_not_turn_are_those_without_arcs(device, broad_phase):
    """Cloth beside a body: the same rows, bit for bit; and with groups, whose pairs are counted as before."""
    x0, x1, faces = crumpled(1, n=12)
    ball = trimesh.creation.icosphere(1, 0.02)
    n = len(x0)
    start = ball.vertices + np.float32([0.5, 0, 0])
    turn = 2.0 * Z
    end = moved(start, [0.5, 0, 0], turn)
    all_x = [np.concatenate([x, b]).astype(np.float32) for x, b in ((x0, start), (x1, end))]
    all_faces = np.concatenate([faces, ball.faces + n])
    body = np.where(np.arange(n + len(start)) < n, -1, 0)
    arcs = bsc.RigidMotion(body, [[0.5, 0, 0]], [turn])
    for options in ({}, {"min_distance": 0.0003}):
        for method in ("conservative", "exact", "float"):
            mesh = bsc.CollisionMesh(all_faces, len(body))
            detector = bsc.CollisionDetector(mesh, method=method, **options)
            plain, found = detector.detect(*all_x), detector.detect(*all_x, rigid_motion=arcs)
            assert found.certified == (method != "float")
            for kind in KINDS:
                pairs = getattr(plain, kind)
                of_cloth = pairs[:, 1] < (len(faces) if kind == "vertex_face" else np.searchsorted(mesh.edges[:, 0], n))
                for name in ("", "_toi", "_coordinates", "_normal"):
                    values = getattr(plain, kind + name)[of_cloth]
                    np.testing.assert_array_equal(getattr(found, kind + name), values)
                assert len(pairs)
    rng = np.random.default_rng(0)
    bits = {"group": 1 << rng.integers(0, 2, len(body)), "mask": rng.integers(1, 4, len(body))}
    mesh = bsc.CollisionMesh(all_faces, len(body), **bits)
    plain, found = (bsc.CollisionDetector(mesh).detect(*all_x, rigid_motion=a) for a in (None, arcs))
    cloth = plain.edge_edge[:, 1] < np.searchsorted(mesh.edges[:, 0], n)
    np.testing.assert_array_equal(found.edge_edge, plain.edge_edge[cloth])
    assert found.stats.filtered > 0
    one_body = bsc.RigidMotion(np.zeros(len(body), int), [[0.5, 0, 0]], [turn])
    turned = moved(all_x[0].astype(float), [0.5, 0, 0], turn)
    assert bsc.CollisionDetector(mesh).detect(all_x[0].astype(float), turned, rigid_motion=one_body).earliest_toi == 2.0


def test_minimum_distances_radii_points_and_edges_turn_too(device, broad_phase):
    """A point on a circle of 1 passes an edge, another point and a face at distances of 0.2, 0.3 and 0.4."""
    tip, of_edge, of_point, of_face = (rotation(angle * Z) for angle in (0.0, 0.5, 1.0, 1.5))
    face = np.array([[1.4, -1.0, -1.0], [1.4, 0.0, 1.0], [1.4, 1.0, -1.0]]) @ of_face.T
    x0 = np.stack([tip @ X, of_edge @ (1.2 * X - Z), of_edge @ (1.2 * X + Z), of_point @ (1.3 * X), *face])
    x1 = x0.copy()
    x1[0] = moved(x0[:1], 0.0, 2.0 * Z)[0]
    body = np.array([0, *[-1] * 6])
    arcs = bsc.RigidMotion(body, [[0.0, 0, 0]], [2.0 * Z], tolerance=0.001)
    for distance, kinds in ((0.19, ()), (0.21, ("vertex_edge",)), (0.31, ("vertex_edge", "vertex_vertex"))):
        for radius in (0.0, 0.04):
            mesh = bsc.CollisionMesh([[4, 5, 6]], 7, edges=[[1, 2]], points=[0, 3], radius=radius)
            detector = bsc.CollisionDetector(mesh, min_distance=distance - 2 * radius)
            found = detector.detect(x0, x1, rigid_motion=arcs)
            assert {kind for kind in ("vertex_edge", "vertex_vertex") if len(getattr(found, kind))} == set(kinds)
    assert 0 < found.vertex_edge_toi[0] < 0.25 < found.vertex_vertex_toi[0] < 0.5
    for distance, hits in ((0.39, []), (0.41, [0])):
        found = bsc.CollisionDetector(mesh, min_distance=distance - 0.08).detect(x0, x1, rigid_motion=arcs)
        assert [row for row, (vertex, _face) in enumerate(found.vertex_face) if vertex == 0] == hits
    assert 0.6 < found.vertex_face_toi[0] < 0.75
    only = np.zeros(7, dtype=bool)
    only[3] = True
    detector = bsc.CollisionDetector(mesh, min_distance=0.33)
    assert detector.detect(x0, x1, rigid_motion=arcs, vertices=only).vertex_vertex.tolist() == [[0, 3]]


def test_a_strip_that_is_tied_to_a_body_is_found_on_its_own_arc(device):
    """A face with two vertices of a body and one that does not move, and a sheet that only their arcs reach."""
    x0 = np.array([[1, 0, 0], [1, 0, 0.5], [0, -1, 0], [-1, 0.9, -1], [1, 0.9, -1], [0, 0.9, 3]], float)
    x1 = x0.copy()
    x1[:2] = moved(x0[:2], 0.0, np.pi * Z)
    mesh = bsc.CollisionMesh([[0, 1, 2], [3, 4, 5]], 6)
    arcs = bsc.RigidMotion([0, 0, *[-1] * 4], [[0.0, 0, 0]], [np.pi * Z])
    detector = bsc.CollisionDetector(mesh)
    found = detector.detect(x0, x1, rigid_motion=arcs)
    assert detector.detect(x0, x1).earliest_toi == 2.0
    assert {(0, 1), (1, 1)} <= set(map(tuple, found.vertex_face.tolist()))
    times = found.vertex_face_toi[(found.vertex_face[:, 0] < 2)]
    np.testing.assert_allclose(times, np.arcsin(0.9) / np.pi, atol=1e-3)
    crossing = detector.find_intersections(arcs.positions(x0, x1, 0.5))
    assert len(crossing) and found.earliest_toi < 0.5


def test_a_body_collides_with_what_is_tied_to_it(device, broad_phase):
    """A sheet from its hub to two points that do not move, through which its tip passes after an eighth of a turn."""
    out = rotation(0.25 * np.pi * Z) @ X
    x0 = np.stack([2.0 * out - Z, 2.0 * out + Z, 0.1 * X, X, 0.8 * X, 0.8 * X + 0.1 * Z])
    x1 = x0.copy()
    x1[2:] = moved(x0[2:], 0.0, 0.5 * np.pi * Z)
    arcs = bsc.RigidMotion([-1, -1, 0, 0, 0, 0], [[0.0, 0, 0]], [0.5 * np.pi * Z])
    found = bsc.CollisionDetector(bsc.CollisionMesh([[0, 1, 2], [3, 4, 5]], 6)).detect(x0, x1, rigid_motion=arcs)
    assert [3, 0] in found.vertex_face.tolist()
    assert found.vertex_face[:, 1].max() == 0
    np.testing.assert_allclose(found.vertex_face_toi, 0.5, atol=0.02)


@pytest.mark.parametrize("angle", [0.5, pytest.param(2.0, marks=pytest.mark.slow)])
def test_pairs_within_a_body_that_deforms_are_looked_at(angle, device):
    """Along the axis deformations turn into themselves: pairs collide as on straight paths in the frame of the body."""
    rng = np.random.default_rng(int(angle))
    x0 = [2.0, 0.0, 0.0] + [0.05, 0.05, 0.002] * rng.uniform(-1.0, 1.0, (20, 1, 3))
    x0 = (x0 + [0.1, 0.1, 0.0005] * rng.uniform(-1.0, 1.0, (20, 3, 3))).reshape(-1, 3)
    end = x0 + 2.0**-9.1 * rng.uniform(-1.0, 1.0, (len(x0), 1)) * Z  # as far as a body may deform, twice the distance
    mesh = bsc.CollisionMesh(np.arange(len(x0)).reshape(-1, 3), len(x0), device=device)
    arcs = bsc.RigidMotion([0] * len(x0), [[0.0, 0, 0]], [angle * Z], tolerance=1e-5)
    found = bsc.CollisionDetector(mesh).detect(x0, moved(end, 0.0, angle * Z), rigid_motion=arcs)
    assert found.certified
    for kind in KINDS:
        pairs, corners = pairs_of(mesh, kind)
        rows = np.concatenate([x0[corners], end[corners]], axis=1)
        one, other = np.split(rows.reshape(-1, 2, 4, 3), [1 + KINDS.index(kind)], axis=2)
        overlap = (one.min(axis=(1, 2)) <= other.max(axis=(1, 2))).all(axis=1)
        overlap &= (other.min(axis=(1, 2)) <= one.max(axis=(1, 2))).all(axis=1)
        pairs, rows = pairs[overlap], rows[overlap]
        collide = getattr(bsc.checker, kind)(rows)
        reported = set(map(tuple, getattr(found, kind).tolist()))
        assert set(map(tuple, pairs[collide].tolist())) <= reported
        assert 0 < collide.sum() <= len(reported) <= 1.05 * collide.sum()  # what comes within the tolerance


def two_plates(gap):
    """Two parallel triangles, one above the other."""
    plate = np.array([[1, 0, 0], [1.2, 0, 0], [1, 0.2, 0]])
    return np.concatenate([plate, plate + np.array([0.03, 0.03, gap])])


@pytest.mark.parametrize("turns", [1.0, 3.0])
def test_pairs_within_a_body_that_is_rigid_up_to_rounding_are_left_out(turns, device):
    """Two plates that touch, with positions and poses in single precision: nothing is found, all is certified."""
    x0 = two_plates(0.0).astype(np.float32) + np.float32(10.0)
    turn = np.float32([0.3, -0.4, 0.7]) * np.float32(turns)
    x1 = moved(x0.astype(float), 9.5, turn.astype(float), [3.0, 0, 0]).astype(np.float32)
    mesh = bsc.CollisionMesh([[0, 1, 2], [3, 4, 5]], 6, device=device)
    arcs = bsc.RigidMotion([0] * 6, np.full((1, 3), 9.5), turn[None])
    found = bsc.CollisionDetector(mesh, method="exact").detect(x0, x1, rigid_motion=arcs)
    assert found.certified and found.earliest_toi == 2.0


def test_arcs_without_bodies_change_nothing(device):
    mesh, x0, x1, _ = blade_and_post()
    mesh = bsc.CollisionMesh(mesh.faces, 6, device=device)
    x1[:3] += [0.5, 2.0, 0.0]
    detector = bsc.CollisionDetector(mesh)
    expected = detector.detect(x0, x1)
    assert len(expected.edge_edge)
    start, end = (wp.array(x, dtype=wp.vec3d, device=device) for x in (x0, x1))
    for centre, body in ((np.zeros((0, 3)), [-1] * 6), (np.zeros((2, 3)), np.full(6, -1))):
        arcs = bsc.RigidMotion(body, centre, centre)
        with wp.ScopedCapture(device) as capture:
            captured = detector.capture(start, end, rigid_motion=arcs)
        wp.capture_launch(capture.graph)
        for found in (detector.detect(x0, x1, rigid_motion=arcs), captured.read()):
            assert found.edge_edge.tolist() == expected.edge_edge.tolist()
            assert found.vertex_face.tolist() == expected.vertex_face.tolist()


def test_poses_give_the_turn_between_them():
    rng = np.random.default_rng(4)
    turn = rng.standard_normal((5, 3))
    turn *= np.array([[1e-9], [0.5], [1.5], [3.0], [0.0]]) / np.linalg.norm(turn, axis=1, keepdims=True)
    pose_0, pose_1 = rng.standard_normal((2, 5, 7))
    for i in range(5):
        first = trimesh.transformations.random_rotation_matrix(rng.random(3))
        last = np.eye(4)
        last[:3, :3] = rotation(turn[i]) @ first[:3, :3]
        for pose, matrix, sign in ((pose_0, first, 1.0), (pose_1, last, rng.choice([-1.0, 1.0]))):
            w, *vector = trimesh.transformations.quaternion_from_matrix(matrix)
            pose[i, 3:] = sign * np.array([*vector, w])
    motion = bsc.RigidMotion.between(np.arange(5), pose_0, pose_1)
    np.testing.assert_allclose(motion.turn, turn, atol=1e-14)
    np.testing.assert_array_equal(motion.centre, pose_0[:, :3])


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_half_a_turn_has_no_shorter_way(dtype):
    start = np.array([[0, 0, 0, 0, 0, 0, 1], [1, 0, 0, 0.5, 0.5, 0.5, 0.5]], dtype)
    for share, is_half in ((1.0, True), (1.0 - 1e-7, dtype == np.float32), (1.0 + 1e-4, False)):
        sine, cosine = np.sin(0.5 * np.pi * share), np.cos(0.5 * np.pi * share)
        end = np.stack([start[0], [1, 0, 0, *(0.5 * (cosine + sine * np.array([-1, 1, 1]))), 0.5 * (cosine - sine)]])
        if is_half:
            with pytest.raises(ValueError, match=r"pose_1\[1\] is half a turn from pose_0\[1\]"):
                bsc.RigidMotion.between([0, 1], start, end.astype(dtype))
        else:
            turn = bsc.RigidMotion.between([0, 1], start, end.astype(dtype)).turn
            expected = np.pi * (share if share < 1.0 else share - 2.0) * Z
            np.testing.assert_allclose(turn, [0.0 * Z, expected], atol=1e-6)


def test_what_does_not_fit_is_an_error(device):
    x0 = np.array([[1, 0, 0], [2, 0, 0], [1, 1, 0], [5, 0, 0], [6, 0, 0], [5, 1, 0]], float)
    x1 = x0.copy()
    x1[:3] = moved(x0[:3], 0.0, Z)
    body = np.array([0, 0, 0, -1, -1, -1])
    detector = bsc.CollisionDetector(bsc.CollisionMesh([[0, 1, 2], [3, 4, 5]], 6))
    with pytest.raises(ValueError, match="read-only"):
        bsc.RigidMotion(body, [[0.0, 0, 0]], [Z]).turn[0] = 0.0
    detector.detect(x0, x1 + [0, 0, 3.0] * (body >= 0)[:, None], rigid_motion=bsc.RigidMotion(body, [[0.0, 0, 0]], [Z]))
    for error, end, arcs in (
        ("x1 must be where arcs take body 0", x1, bsc.RigidMotion(body, [[0.0, 0, 0]], [1.1 * Z])),
        ("x1 must be where arcs take body 0", x0, bsc.RigidMotion(body, [[0.0, 0, 0]], [Z])),
        ("rigid_motion must have a body for 6 vertices, not 5", x1, bsc.RigidMotion(body[:5], [[0.0, 0, 0]], [Z])),
        ("arcs.tolerance must be at least", x1, bsc.RigidMotion(body, [[0.0, 0, 0]], [Z], tolerance=1e-15)),
        ("x1 must have coordinates of at most 2", 1e200 * x1, bsc.RigidMotion(body, [[0.0, 0, 0]], [Z])),
    ):
        with pytest.raises(ValueError, match=error):
            detector.detect(x0, end, rigid_motion=arcs)
    with pytest.raises(ValueError, match=r"x1\[4\] has a coordinate that is not finite"):
        detector.detect(
            x0, np.where(np.arange(6)[:, None] == 4, np.nan, x1), rigid_motion=bsc.RigidMotion(body, [X], [Z])
        )


def blade_and_post():
    """A blade that turns by 80 degrees about z, and a post on the arc of its tip: mesh, both ends and motion."""
    x0 = np.array([[0.5, 0, 0], [2, 0, 0], [2, 0, 0.2], [1.6, 1.1, -1], [1.7, 1.1, -1], [1.6, 1.1, 1]], float)
    turn = np.radians(80.0) * Z
    x1 = x0.copy()
    x1[:3] = moved(x0[:3], 0.0, turn)
    return (
        bsc.CollisionMesh([[0, 1, 2], [3, 4, 5]], 6),
        x0,
        x1,
        bsc.RigidMotion([0, 0, 0, -1, -1, -1], [[0.0] * 3], [turn]),
    )


@pytest.mark.slow
def test_one_pass_finds_what_parts_of_the_step_do(device, monkeypatch):
    """In random scenes with turns of at most a quarter, the same pairs up to the tolerance, at times that agree."""
    pairs = 0
    for seed in range(6):
        mesh, x0, _x1, motion, number = random_scene(seed)
        turn = 0.49 * np.pi * motion.turn / np.linalg.norm(motion.turn, axis=1, keepdims=True)
        x1 = x0.copy()
        for i in range(3):
            x1[number == i] = moved(x0[number == i], motion.centre[i], turn[i])
        motion = bsc.RigidMotion(motion.body, motion.centre, turn, tolerance=1e-7)
        found = bsc.CollisionDetector(mesh).detect(x0, x1, rigid_motion=motion)
        with monkeypatch.context() as patch:
            patch.setattr(arc_pipeline.ArcPipeline, "is_for", staticmethod(lambda bounds: False))
            expected = bsc.CollisionDetector(mesh).detect(x0, x1, rigid_motion=motion)
        for kind in KINDS:
            assert getattr(found, kind).tolist() == getattr(expected, kind).tolist()
            np.testing.assert_allclose(getattr(found, f"{kind}_toi"), getattr(expected, f"{kind}_toi"), atol=1e-3)
            pairs += len(getattr(found, kind))
    assert pairs > 50


def test_a_graph_detects_on_arcs(device):
    mesh, x0, x1, arcs = blade_and_post()
    mesh = bsc.CollisionMesh(mesh.faces, 6, device=device)
    detector = bsc.CollisionDetector(mesh)
    expected = detector.detect(x0, x1, rigid_motion=arcs)
    assert len(expected.vertex_face) + len(expected.edge_edge) > 0 == len(detector.detect(x0, x1).edge_edge)
    start, end = (wp.array(x, dtype=wp.vec3d, device=device) for x in (x0, x1))
    with wp.ScopedCapture(device) as capture:
        captured = detector.capture(start, end, rigid_motion=arcs)
    for offset in (3.0, 0.0):
        start.assign(np.where(np.arange(6)[:, None] < 3, x0, x0 + offset * Z))
        end.assign(np.where(np.arange(6)[:, None] < 3, x1, x1 + offset * Z))
        wp.capture_launch(capture.graph)
        found = captured.read()
        assert found.certified
        for kind in KINDS:
            rows = [] if offset else getattr(expected, kind).tolist()
            assert getattr(found, kind).tolist() == rows


def test_a_graph_in_which_a_body_deforms_finds_its_pairs_or_is_not_certified(device):
    """Two plates of a body, rigid before the capture; in the replay the second passes through the first."""
    x0 = two_plates(0.001)
    x1, sinks = moved(x0, 0.0, 0.5 * Z), [[0.0] * 3] * 3 + [[0, 0, -0.0015]] * 3
    detector = bsc.CollisionDetector(bsc.CollisionMesh([[0, 1, 2], [3, 4, 5]], 6, device=device))
    arcs = bsc.RigidMotion([0] * 6, [[0.0] * 3], [0.5 * Z])
    assert detector.detect(x0, x1, rigid_motion=arcs).certified
    start, end = (wp.array(x, dtype=wp.vec3d, device=device) for x in (x0, x1))
    with wp.ScopedCapture(device) as capture:
        captured = detector.capture(start, end, rigid_motion=arcs)
    for off, sunk in ((0.0, False), (sinks, True)):
        end.assign(x1 + off)
        wp.capture_launch(capture.graph)
        found = captured.read()
        assert found.certified == (device.is_cpu or not sunk)
        assert found.vertex_face.tolist() == ([[3, 0]] if device.is_cpu and sunk else [])
    # what a GPU measures in the graph
    ends = (wp.array(x, dtype=wp.vec3d, device=device) for x in (x0, x1))
    bounds = ArcBounds(arcs, detector.mesh.device_vertices, *ends)
    for off, rigid in ((0.0, True), (sinks, False)):
        bounds.measure(start, wp.array(x1 + off, dtype=wp.vec3d, device=device))
        assert bounds.are_rigid().tolist() == [rigid]


@pytest.mark.gpu
def test_what_a_graph_of_a_gpu_cannot_hold_is_an_error(device):
    mesh, x0, x1, arcs = blade_and_post()
    mesh = bsc.CollisionMesh(mesh.faces, 6, device=device)
    x0, x1 = (wp.array(x, dtype=wp.vec3d, device=device) for x in (x0, x1))
    wide = bsc.RigidMotion(arcs.body, arcs.centre, 2.0 * arcs.turn)
    for error, message, given, options in (
        (RuntimeError, "detect with this rigid_motion once before", arcs, {}),
        (NotImplementedError, "at most a quarter of a turn", wide, {}),
        (NotImplementedError, "none with min_distance", arcs, {"min_distance": 0.01}),
    ):
        detector = bsc.CollisionDetector(mesh, **options)
        with pytest.raises(error, match=message), wp.ScopedCapture(device):
            detector.capture(x0, x1, rigid_motion=given)
