"""The chamfer distance of clouds from surfaces against trimesh's closest points, its gradients against differences."""

import numpy as np
import pytest
import trimesh
import warp as wp

import warp_bsc as bsc

BALL = trimesh.creation.icosphere(subdivisions=1)
FACES = BALL.faces.astype(np.int32)
SURFACES, POINTS = 3, 60


def make(seed=1, clouds=SURFACES):
    """Bumpy balls, and points inside and outside of them."""
    rng = np.random.default_rng(seed)
    x = BALL.vertices + 0.1 * rng.normal(size=(SURFACES, *BALL.vertices.shape))
    return np.float32(x), rng.uniform(-1.6, 1.6, (clouds, POINTS, 3)).astype(np.float32)


def distance(points, x, faces=FACES, **options):
    """Distances of NumPy arrays, and the array of vertices, which requires gradients."""
    x = wp.array(x, dtype=wp.vec3, requires_grad=True)
    options = {
        name: wp.array(value, dtype=float) if isinstance(value, np.ndarray) else value
        for name, value in options.items()
    }
    found = bsc.chamfer_distance(wp.array(points, dtype=wp.vec3), x, wp.array(faces, dtype=int), **options)
    return found, x


def gradient(points, x, seed=(1.0,) * SURFACES, **options):
    """Distances, and the gradient of their sum with these factors."""
    with wp.Tape() as tape:
        found, x = distance(points, x, **options)
    tape.backward(grads={found: wp.array(seed, dtype=float)})
    return found.numpy(), x.grad.numpy()


def squared_distances(points, x):
    """Squared distances by trimesh."""
    surface = trimesh.Trimesh(x, FACES, process=False)
    return trimesh.proximity.closest_point_naive(surface, points)[1] ** 2


@pytest.mark.parametrize("clouds", [1, SURFACES])
def test_distances_are_those_of_trimesh(clouds):
    x, points = make(clouds=clouds)
    expected = [squared_distances(points[i % clouds], x[i]).mean() for i in range(SURFACES)]
    np.testing.assert_allclose(distance(points, x)[0].numpy(), expected, rtol=2e-6)


def test_gradients_are_differences_of_trimesh():
    x, points = make()
    seed = np.array([1.0, -2.0, 0.5])
    _, found = gradient(points, x, seed)
    for i, way in enumerate(np.random.default_rng(2).normal(size=x.shape)):
        above, below = (squared_distances(points[i], x[i] + side * 1e-5 * way).mean() for side in (1.0, -1.0))
        assert (found[i] * way).sum() == pytest.approx(seed[i] * (above - below) / 2e-5, rel=1e-4)


def test_points_on_the_sides_and_corners_of_a_triangle_pull_at_these():
    x = np.float32([[[0, 0, 0], [1, 0, 0], [0, 1, 0]]])
    cases = {
        (0.25, 0.25, 0.5): (0.25, [[0, 0, -0.5], [0, 0, -0.25], [0, 0, -0.25]]),
        (0.25, -0.5, 0.0): (0.25, [[0, 0.75, 0], [0, 0.25, 0], [0, 0, 0]]),
        (2.0, -1.0, 0.0): (2.0, [[0, 0, 0], [-2, 2, 0], [0, 0, 0]]),
        (1.0, 1.0, 0.0): (0.5, [[0, 0, 0], [-0.5, -0.5, 0], [-0.5, -0.5, 0]]),
    }
    for point, (expected, slopes) in cases.items():
        found, slope = gradient(np.float32([[point]]), x, [1.0], faces=[[0, 1, 2]])
        np.testing.assert_allclose(found, [expected], rtol=1e-6)
        np.testing.assert_allclose(slope[0], slopes, atol=1e-6)


def test_points_have_gradients():
    x, points = make(clouds=1)
    cloud = wp.array(points, dtype=wp.vec3, requires_grad=True)
    with wp.Tape() as tape:
        surface = wp.array(x, dtype=wp.vec3, requires_grad=True)
        found = bsc.chamfer_distance(cloud, surface, wp.array(FACES, dtype=int))
    tape.backward(grads={found: wp.array([1.0] * SURFACES, dtype=float)})
    np.testing.assert_allclose(cloud.grad.numpy().sum((0, 1)), -surface.grad.numpy().sum((0, 1)), atol=1e-5)


def test_frames_add_up_and_weights_leave_out_points():
    x, points = make()
    weights = np.zeros((SURFACES, POINTS), dtype=np.float32)
    weights[:, :20] = 1.0 / 20.0
    filled = points.copy()
    filled[:, 20:] = np.nan
    out = wp.array([1.0, 2.0, 3.0], dtype=float, requires_grad=True)
    found, slopes = gradient(filled, x, weights=weights, out=out)
    expected, expected_slopes = gradient(points[:, :20], x)
    np.testing.assert_allclose(found, expected + np.array([1.0, 2.0, 3.0]), rtol=1e-6)
    np.testing.assert_allclose(slopes, expected_slopes, rtol=1e-5, atol=1e-8)


def test_the_same_bits_in_each_run():
    x, points = make()
    first, second = (gradient(points, x) for _ in range(2))
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("what", ["point", "vertex", "weight"])
def test_what_is_not_finite_is_nan_in_its_surface_alone(what, value):
    x, points = make()
    weights = np.full((SURFACES, POINTS), 1.0 / POINTS, dtype=np.float32)
    expected, _ = gradient(points, x)
    {"point": points[1, 5], "vertex": x[1, 7], "weight": weights[1, 3:4]}[what][0] = value
    found, slopes = gradient(points, x, weights=weights)
    np.testing.assert_allclose(found[[0, 2]], expected[[0, 2]], rtol=1e-6)
    assert np.isnan(found[1])
    np.testing.assert_array_equal(np.isnan(slopes).any(axis=-1), np.arange(SURFACES)[:, None] == np.full(42, 1))


@pytest.mark.parametrize("vertex", [-1, 42])
def test_faces_without_such_a_vertex_are_nan(vertex):
    x, points = make()
    faces = FACES.copy()
    faces[3, 1] = vertex
    assert np.isnan(distance(points, x, faces)[0].numpy()).all()


def test_a_recorded_graph_follows_the_positions(device):
    x, points = make()
    cloud, faces = wp.array(points, dtype=wp.vec3), wp.array(FACES, dtype=int)
    surface, out = wp.array(x, dtype=wp.vec3, requires_grad=True), wp.zeros(SURFACES, dtype=float, requires_grad=True)
    bsc.chamfer_distance(cloud, surface, faces, out=out)
    tape, seed = wp.Tape(), wp.array([1.0] * SURFACES, dtype=float)
    with wp.ScopedCapture(device) as capture:
        out.zero_()
        with tape:
            bsc.chamfer_distance(cloud, surface, faces, out=out)
        tape.zero()
        tape.backward(grads={out: seed})
    moved = x + np.float32(0.1)
    surface.assign(moved)
    wp.capture_launch(capture.graph)
    expected, slopes = gradient(points, moved)
    np.testing.assert_allclose(out.numpy(), expected, rtol=1e-6)
    np.testing.assert_allclose(surface.grad.numpy(), slopes, atol=1e-6)


def test_wrong_arguments():
    x, points = (wp.array(values, dtype=wp.vec3) for values in make())
    faces = wp.array(FACES, dtype=int)
    bad = {
        r"^points must have shape \(3, -1\)": {"points": wp.zeros((2, 5), dtype=wp.vec3)},
        r"^points must have shape \(-1, -1\).*\(3, 0\)": {"points": wp.zeros((3, 0), dtype=wp.vec3)},
        r"^x must have shape \(-1, -1\).*\(4,\)": {"x": wp.zeros(4, dtype=wp.vec3)},
        r"^faces must have shape \(-1, 3\)": {"faces": wp.zeros((5, 4), dtype=int)},
        r"^faces must have shape \(-1, 3\).*\(0, 3\)": {"faces": wp.zeros((0, 3), dtype=int)},
        r"^weights must have shape \(3, 60\)": {"weights": wp.zeros((1, POINTS), dtype=float)},
        r"^out must have shape \(3,\)": {"out": wp.zeros(2, dtype=float)},
    }
    for message, arguments in bad.items():
        with pytest.raises(ValueError, match=message):
            bsc.chamfer_distance(**{"points": points, "x": x, "faces": faces} | arguments)
    with pytest.raises(TypeError, match=r"^points must be a Warp array, not"):
        bsc.chamfer_distance(points.numpy(), x, faces)
    with pytest.raises(TypeError, match=r"^x must be an array of vec3"):
        bsc.chamfer_distance(points, wp.zeros((3, 42), dtype=wp.vec3d), faces)
    with pytest.raises(TypeError, match=r"^weights must be an array of float32, not of float64"):
        bsc.chamfer_distance(points, x, faces, weights=wp.zeros((3, POINTS), dtype=wp.float64))
