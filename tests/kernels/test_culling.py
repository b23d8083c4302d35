"""Culls and certified answers of the device functions: what they say is true, and they say it where it matters.

The truth comes from the exact checker, or from exact arithmetic on the separation itself.
"""

import itertools
from fractions import Fraction
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp
from compilation import QUICK
from generators import GENERATORS, mostly_hits, uniform
from outputs import filled_with_nan
from sample_sizes import cases

import warp_bsc as bsc
from warp_bsc import checker
from warp_bsc.kernels import FREE, HIT, UNSURE, ccd_edge_edge, ccd_vertex_face, crossing, culling
from warp_bsc.kernels.motion import edge_edge_motion, vertex_face_motion
from warp_bsc.kernels.polynomials import Motion
from warp_bsc.kernels.signs import ROUNDOFF

KINDS = ("vertex_face", "edge_edge")
TRUTH = {"vertex_face": checker.vertex_face, "edge_edge": checker.edge_edge}
DTYPES = (np.float32, np.float64)
wp.set_module_options(QUICK)


@wp.kernel(enable_backward=False)
def ask_double(
    edges: bool,
    x: wp.array2d[wp.vec3d],
    direction: wp.array[wp.vec3d],
    boxes: wp.array[wp.bool],
    separated: wp.array2d[wp.bool],
    status: wp.array[int],
    axis: wp.array[wp.vec3d],
):
    i = wp.tid()
    motion = Motion()
    if edges:
        motion = edge_edge_motion(x[i, 0], x[i, 1], x[i, 2], x[i, 3], x[i, 4], x[i, 5], x[i, 6], x[i, 7], ROUNDOFF)
        boxes[i] = culling.edge_edge_boxes_apart(x[i, 0], x[i, 1], x[i, 2], x[i, 3], x[i, 4], x[i, 5], x[i, 6], x[i, 7])
        status[i] = ccd_edge_edge(x[i, 0], x[i, 1], x[i, 2], x[i, 3], x[i, 4], x[i, 5], x[i, 6], x[i, 7])
    else:
        motion = vertex_face_motion(x[i, 0], x[i, 1], x[i, 2], x[i, 3], x[i, 4], x[i, 5], x[i, 6], x[i, 7], ROUNDOFF)
        boxes[i] = culling.vertex_face_boxes_apart(
            x[i, 0], x[i, 1], x[i, 2], x[i, 3], x[i, 4], x[i, 5], x[i, 6], x[i, 7]
        )
        status[i] = ccd_vertex_face(x[i, 0], x[i, 1], x[i, 2], x[i, 3], x[i, 4], x[i, 5], x[i, 6], x[i, 7])
    separated[i, 0] = culling.direction_separates(motion, direction[i])
    axis[i] = culling.centroid_direction(motion)
    separated[i, 1] = culling.direction_separates(motion, axis[i])


@wp.kernel(enable_backward=False)
def ask_single(edges: bool, x: wp.array2d[wp.vec3], boxes: wp.array[wp.bool], status: wp.array[int]):
    i = wp.tid()
    if edges:
        boxes[i] = culling.edge_edge_boxes_apart(x[i, 0], x[i, 1], x[i, 2], x[i, 3], x[i, 4], x[i, 5], x[i, 6], x[i, 7])
        status[i] = ccd_edge_edge(x[i, 0], x[i, 1], x[i, 2], x[i, 3], x[i, 4], x[i, 5], x[i, 6], x[i, 7])
    else:
        boxes[i] = culling.vertex_face_boxes_apart(
            x[i, 0], x[i, 1], x[i, 2], x[i, 3], x[i, 4], x[i, 5], x[i, 6], x[i, 7]
        )
        status[i] = ccd_vertex_face(x[i, 0], x[i, 1], x[i, 2], x[i, 3], x[i, 4], x[i, 5], x[i, 6], x[i, 7])


@wp.kernel(enable_backward=False)
def ask_crossings(x: wp.array2d[wp.vec3d], rounded: wp.array2d[wp.vec3], status: wp.array2d[int]):
    i = wp.tid()
    status[i, 0] = crossing.edge_crosses_face(x[i, 0], x[i, 1], x[i, 2], x[i, 3], x[i, 4])
    status[i, 1] = crossing.edge_crosses_face(rounded[i, 0], rounded[i, 1], rounded[i, 2], rounded[i, 3], rounded[i, 4])


def ask(kind, points, direction=None):
    """Boxes, separation (along the direction, along the axis through the centroids) and status of queries."""
    n = len(points)
    boxes, status = wp.zeros(n, dtype=wp.bool), wp.zeros(n, dtype=int)
    if points.dtype == np.float32:
        inputs = [kind == "edge_edge", wp.array(points, dtype=wp.vec3)]
        wp.launch(ask_single, n, inputs=inputs, outputs=[boxes, status])
        answers = ask(kind, points.astype(np.float64), direction)
        assert np.array_equal(answers.boxes, boxes.numpy())
        answers.status = status.numpy()
        return answers
    direction = np.ones((n, 3)) if direction is None else direction
    separated, axis = wp.zeros((n, 2), dtype=wp.bool), filled_with_nan(n, wp.vec3d)
    inputs = [kind == "edge_edge", wp.array(points, dtype=wp.vec3d), wp.array(direction, dtype=wp.vec3d)]
    wp.launch(ask_double, n, inputs=inputs, outputs=[boxes, separated, status, axis])
    return SimpleNamespace(boxes=boxes.numpy(), separated=separated.numpy(), status=status.numpy(), axis=axis.numpy())


def normals(kind, points):
    """Normals of queries at the start, from points scaled to a size of about 1."""
    exponent = np.frexp(np.abs(points).max(axis=(1, 2)))[1]
    p, q, r, s = np.moveaxis(np.ldexp(points[:, :4].astype(np.float64), -exponent[:, None, None]), 1, 0)
    return np.cross(r - q, s - q) if kind == "vertex_face" else np.cross(q - p, s - r)


def assert_certain_answers(status, truth):
    assert not (status[truth] == FREE).any()
    assert not (status[~truth] == HIT).any()


def features(kind, array):
    """The rows of the two features at the start and at the end: start, start, end, end."""
    i = 1 if kind == "vertex_face" else 2
    return array[:, :i], array[:, i:4], array[:, 4 : 4 + i], array[:, 4 + i :]


def exact_gap(kind, points, direction):
    """How far a direction separates the features of queries at both ends on the same side: exact, negative if not."""
    exact = np.vectorize(Fraction, otypes=[object])
    heights = (exact(points) * exact(direction)[:, None]).sum(axis=2)
    p0, q0, p1, q1 = features(kind, heights)
    above = np.minimum(p0.min(axis=1) - q0.max(axis=1), p1.min(axis=1) - q1.max(axis=1))
    below = np.minimum(q0.min(axis=1) - p0.max(axis=1), q1.min(axis=1) - p1.max(axis=1))
    return np.maximum(above, below)


# --- Culls ---


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dtype", DTYPES)
def test_culls_and_certified_answers_are_true(kind, dtype):
    """Also along directions that are aimed at: a normal at the start, rounded, of any length."""
    for name, generator in GENERATORS.items():
        rng = np.random.default_rng([1, *name.encode()])
        points = generator(rng, cases(60 if "scales" in name or "huge" in name else 150), kind, dtype)
        truth = TRUTH[kind](points)
        answers = ask(kind, points, normals(kind, points) * 2.0 ** rng.integers(-30, 30, (len(points), 1)))
        assert not answers.boxes[truth].any(), name
        assert not answers.separated[truth].any(), name
        assert_certain_answers(answers.status, truth)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dtype", DTYPES)
def test_boxes_are_apart_exactly_where_an_axis_separates_at_both_ends(kind, dtype):
    """Small integers, so that boxes often touch."""
    points = np.random.default_rng(2).integers(-3, 4, (20000, 8, 3)).astype(dtype)
    points[:, features(kind, np.arange(8)[None])[0][0]] += dtype(1)
    p0, q0, p1, q1 = features(kind, points)
    above = (p0.min(axis=1) > q0.max(axis=1)) & (p1.min(axis=1) > q1.max(axis=1))
    below = (p0.max(axis=1) < q0.min(axis=1)) & (p1.max(axis=1) < q1.min(axis=1))
    apart = (above | below).any(axis=1)
    assert np.array_equal(ask(kind, points).boxes, apart)
    assert 0.01 < apart.mean() < 0.9


@pytest.mark.parametrize("kind", KINDS)
def test_a_direction_separates_down_to_rounding(kind):
    """Features a tiny gap apart along a random direction: never said without one, nearly always said with one."""
    rng = np.random.default_rng(3)
    n = 1500
    direction = rng.uniform(-1.0, 1.0, (n, 3)) * 2.0 ** rng.integers(-40, 40, (n, 1))
    points = rng.uniform(-1.0, 1.0, (n, 8, 3))
    offset = rng.choice([-1.0, 1.0], n) * 10.0 ** rng.uniform(-18.0, -1.0, n)
    side = rng.choice([-1.0, 1.0], n)
    rows = features(kind, np.arange(8)[None])
    for first, second in (rows[:2], rows[2:]):
        heights = side[:, None] * np.einsum("nij,nj->ni", points, direction)
        shift = heights[:, second[0]].max(axis=1) - heights[:, first[0]].min(axis=1)
        shift += offset * np.abs(direction).max(axis=1)
        points[:, first[0]] += (side * shift / (direction**2).sum(axis=1))[:, None, None] * direction[:, None]
    gap = exact_gap(kind, points, direction)
    separated = ask(kind, points, direction).separated[:, 0]
    assert not separated[gap <= 0].any()
    assert separated[gap > 2e-14 * np.abs(direction).max(axis=1)].all()
    assert 0.2 < separated.mean() < 0.6


@pytest.mark.parametrize("kind", KINDS)
def test_the_centroid_axis_joins_the_centroids_at_half_time(kind):
    points = uniform(np.random.default_rng(4), 100, kind, np.float64)
    p0, q0, p1, q1 = (x.mean(axis=1) for x in features(kind, points))
    between = p0 + p1 - q0 - q1
    axis = ask(kind, points).axis
    assert np.abs(np.cross(axis, between)).max() < 1e-14
    assert (np.abs(axis).max(axis=1) > 0.1 * np.abs(between).max(axis=1)).all()


@pytest.mark.parametrize("kind", KINDS)
def test_nothing_separates_along_no_direction(kind):
    points = uniform(np.random.default_rng(4), 100, kind, np.float64) + 5.0 * np.arange(8)[:, None]
    assert not ask(kind, points, np.zeros((100, 3))).separated[:, 0].any()


def flat_sheet():
    """A grid of triangles in the plane z = 0: positions, and for each kind the pairs that share no vertex, (n, 4)."""
    size = 5
    position = np.array([(i, j, 0.0) for i in range(size) for j in range(size)]) / 7.0
    faces, edges = [], []
    for i, j in itertools.product(range(size), repeat=2):
        a, b, c, d = (size * (i + k) + j + m for k, m in ((0, 0), (1, 0), (0, 1), (1, 1)))
        if i + 1 < size and j + 1 < size:
            faces += [(a, b, c), (b, d, c)]
            edges.append((b, c))
        edges += [(a, b)] * (i + 1 < size) + [(a, c)] * (j + 1 < size)
    return position, {
        "vertex_face": np.array([(p, *face) for p in range(size**2) for face in faces if p not in face]),
        "edge_edge": np.array([(*e, *f) for e, f in itertools.combinations(edges, 2) if not set(e) & set(f)]),
    }


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dtype", DTYPES)
def test_a_flat_sheet_that_moves_in_its_plane_is_free(kind, dtype):
    """Rests, translates, turns, stretches or shears, in a plane along axes or in an oblique one, in which it rounds."""
    position, pairs = flat_sheet()
    tilt = np.linalg.qr(np.random.default_rng(5).uniform(-1.0, 1.0, (3, 3)))[0]
    cosine, sine = np.cos(0.4), np.sin(0.4)
    for motion in (
        np.eye(3),
        np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]]),
        np.diag([1.1, 0.9, 1.0]),
        np.array([[1.0, 0.3, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
    ):
        for plane, shift in itertools.product((np.eye(3), tilt), (0.0, np.array([0.3, -0.2, 0.0]))):
            ends = [(x @ plane + 0.6).astype(dtype) for x in (position, position @ motion + shift)]
            points = np.concatenate([x[pairs[kind]] for x in ends], axis=1)
            assert (ask(kind, points).status == FREE).all()


# --- Certified answers ---


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dtype", DTYPES)
def test_points_that_are_not_finite_are_never_certain(kind, dtype):
    """Each coordinate of features far apart, then of features that meet; some of them twice, so that they cancel."""
    rng = np.random.default_rng(6)
    for points in (uniform(rng, 288, kind, dtype), mostly_hits(rng, 288, kind, dtype)):
        apart = points.copy()
        features(kind, apart)[0][...] += dtype(9)
        features(kind, apart)[2][...] += dtype(9)
        for queries in (points, apart):
            bad = queries.reshape(288, 24)
            for i in range(288):
                bad[i, i % 24] = (np.nan, np.inf, -np.inf)[i // 24 % 3]
                if i >= 144:
                    bad[i, rng.integers(0, 24)] = bad[i, i % 24]
            assert (ask(kind, queries).status == UNSURE).all()


@pytest.mark.parametrize("kind", KINDS)
def test_certified_answers_are_true_where_differences_overflow(kind):
    """Finite points whose differences are not."""
    points = mostly_hits(np.random.default_rng(7), 500, kind, np.float64)
    points *= 1.7e308 / np.ceil(np.abs(points).max())
    truth = TRUTH[kind](points)
    status = ask(kind, points).status
    assert_certain_answers(status, truth)
    assert (status == UNSURE).mean() < 0.1


@pytest.mark.parametrize("kind", KINDS)
def test_answers_survive_squeezing_space(kind):
    """Powers of two, one for each axis, change no contact, but bring products close to underflow and beyond it."""
    rng = np.random.default_rng(8)
    for name in ("uniform", "one_ulp_apart", "grazing", "touching", "collapsing", "integer_lattice"):
        points = GENERATORS[name](rng, 200, kind, np.float32).astype(np.float64)
        truth = TRUTH[kind](points)
        for _ in range(10):
            thin = rng.integers(-140, -120, (200, 1, 3)) * (np.arange(3) != rng.integers(0, 3, (200, 1, 1)))
            exponent = np.where(rng.random((200, 1, 1)) < 0.5, thin, rng.integers(-400, 1, (200, 1, 3)))
            assert_certain_answers(ask(kind, np.ldexp(points, exponent)).status, truth)


# --- Crossings of an edge and a face at rest ---


def ask_crossing(points):
    """Statuses of an edge p q against a face a b c, for rows p q a b c as they are and rounded to single precision."""
    status = wp.zeros((len(points), 2), dtype=int)
    inputs = [wp.array(points, dtype=wp.vec3d), wp.array(points.astype(np.float32), dtype=wp.vec3)]
    wp.launch(ask_crossings, len(points), inputs=inputs, outputs=[status])
    return status.numpy().T


def crossing_truth(points):
    return checker.edge_face_crossings(points[:, :2], points[:, 2:])


def crossings(rng, n):
    """Edges that meet a face at points of it, corners and sides often, from where they end or pass through.

    Multiples of 1/32; the edge is beside the face in a third, collapsed faces and edges occur.
    """
    face = rng.integers(-6, 7, (n, 3, 3)).astype(float)
    collapsed = rng.random(n) < 0.2
    face[collapsed, 2] = (face[:, 0] + rng.integers(-1, 3, (n, 1)) * (face[:, 1] - face[:, 0]))[collapsed]
    weights = np.diff(np.sort(rng.integers(0, 5, (n, 2)), axis=1) / 4.0, axis=1, prepend=0.0, append=1.0)
    weights += (rng.random((n, 1)) < 0.3) * np.array([0.5, -0.25, -0.25])
    point = np.einsum("ni,nij->nj", weights, face)
    along = rng.integers(-6, 7, (n, 3)).astype(float)
    along = np.where(rng.random((n, 1)) < 0.2, face[:, 1] - face[:, 0], along)  # in the face's plane
    t = rng.integers(-1, 10, (n, 1)) / 8.0
    return np.concatenate([(point - t * along)[:, None], (point + (1.0 - t) * along)[:, None], face], axis=1)


def test_crossings_are_true():
    """Exact contact, contact missed or overdone by an ulp, random features; at scales from 1e-30 to 1e30."""
    rng = np.random.default_rng(9)
    count = cases(3000)
    touching = crossings(rng, count)
    near = np.where(
        rng.random((count, 5, 3)) < 0.2, np.nextafter(touching, rng.choice([-9.0, 9.0], (count, 5, 3))), touching
    )
    single = near.astype(np.float32)
    up = rng.choice([-9.0, 9.0], (count, 5, 3)).astype(np.float32)
    single = np.where(rng.random((count, 5, 3)) < 0.2, np.nextafter(single, up), single).astype(np.float64)
    free = rng.uniform(-1.0, 1.0, (count, 5, 3))
    scaled = touching * 10.0 ** rng.uniform(-30.0, 30.0, (count, 1, 1))
    mixed = touching * 10.0 ** rng.uniform(-30.0, 30.0, (count, 1, 3))
    for points in (touching, near, single.astype(np.float64), free, scaled, mixed):
        double, rounded = ask_crossing(points)
        assert_certain_answers(double, crossing_truth(points))
        assert_certain_answers(rounded, crossing_truth(points.astype(np.float32)))


def test_crossings_are_certain_unless_degenerate():
    """Nearly all of random features; of exact contacts those that pass through the inside."""
    rng = np.random.default_rng(10)
    points = rng.uniform(-1.0, 1.0, (20000, 5, 3))
    truth = crossing_truth(points)
    status = ask_crossing(points)
    assert (status != UNSURE).mean() > 0.9999
    assert np.array_equal(status[0] == HIT, truth)
    assert 0.02 < truth.mean() < 0.5


def test_touching_is_no_certain_crossing():
    """An edge that ends in the face, or passes its side, has an orientation of zero, which nothing certifies."""
    points = crossings(np.random.default_rng(11), 3000)
    ab, ac = points[:, 3] - points[:, 2], points[:, 4] - points[:, 2]
    heights = np.einsum("nij,nj->ni", points[:, :2] - points[:, 2:3], np.cross(ab, ac))
    ends_in_plane = (heights == 0.0).any(axis=1)
    assert ends_in_plane.mean() > 0.2
    assert not (ask_crossing(points)[0][ends_in_plane] == HIT).any()


def test_points_that_are_not_finite_never_cross_for_certain():
    points = crossings(np.random.default_rng(12), 15 * 3 * 8)
    for i, point in enumerate(points.reshape(-1, 15)):
        point[i % 15] = (np.nan, np.inf, -np.inf)[i // 15 % 3]
    assert (ask_crossing(points) == UNSURE).all()


def test_crossings_are_not_certified_beyond_the_range_of_the_bound():
    """Products of such coordinates underflow by more than any bound allows for."""
    scale = np.ldexp(1.0, [985, -536, -535])
    edge = np.array([[[0.25, 0.75, -7.25], [3.25, -5.25, -1.25]]]) * scale
    face = np.array([[[3, -2, -6], [-5, 3, -5], [2.9999999999999996, -2, -6.000000000000001]]]) * scale
    assert checker.edge_face_crossings(edge, face).tolist() == [True]
    x = np.concatenate([edge[0], face[0]])
    mesh = bsc.CollisionMesh([[2, 3, 4], [0, 1, 1]], 5)
    assert [0, 0] in bsc.CollisionDetector(mesh).find_intersections(x).tolist()
