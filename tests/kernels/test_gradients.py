"""Gradients of first contacts: against differences, exact derivatives and invariances; clamped and flagged if grazing.

The reference knows nothing of the kernels' formulas: it finds the root of the coplanarity by Newton's method on a
determinant, the coordinates by least squares, and their derivatives by central differences of the fourth order; or the
derivative of the time from the determinant's cofactors in rational numbers, at the root that the checker encloses.
"""

import functools
import gc
import os
from fractions import Fraction
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp
import warp.autograd
from generators import GENERATORS, mostly_hits
from hypothesis import given
from hypothesis import strategies as st
from impacts import impact_kernel
from outputs import filled_with_nan
from sample_sizes import cases
from sheets import crumpled

import warp_bsc as bsc
from warp_bsc import checker
from warp_bsc.kernels import FREE, HIT, UNSURE

KINDS = ("vertex_face", "edge_edge")
TRUTH = {"vertex_face": checker.vertex_face_toi, "edge_edge": checker.edge_edge_toi}
TOLERANCE = 2.0**-20
LARGEST = 2.0**33  # of the gradients of the time, over the largest coordinate of the relative motion


def impacts(kind, points, tolerance=TOLERANCE):
    """Contacts of queries with the derivatives of time, coordinates and normal, shape (n, 7, 8, 3)."""
    n = len(points)
    dtype = wp.vec3 if points.dtype == np.float32 else wp.vec3d
    x = wp.array(points, dtype=dtype, requires_grad=True)
    flags = [wp.zeros(n, dtype=int) for _ in range(3)]
    outputs = [filled_with_nan(n, t, requires_grad=True) for t in (wp.float64, wp.vec3d, wp.vec3d)]
    with wp.Tape() as tape:
        inputs = [kind == "edge_edge", tolerance, x]
        wp.launch(impact_kernel(dtype), n, inputs=inputs, outputs=[*flags, *outputs])
    derivatives = []
    for output, component in [(0, 0), *((i, j) for i in (1, 2) for j in range(3))]:
        tape.zero()
        seed = np.zeros((n, 3))
        seed[:, component] = 1.0
        outputs[output].grad.assign(seed if output else seed[:, 0])
        tape.backward()
        derivatives.append(x.grad.numpy().copy())
    names = ("status", "within_tolerance", "grazing", "toi", "coordinates", "normal")
    values = {name: array.numpy() for name, array in zip(names, [*flags, *outputs], strict=True)}
    return SimpleNamespace(**values, derivatives=np.stack(derivatives, axis=1))


def selected(found, mask):
    """Some of the contacts."""
    return SimpleNamespace(**{name: values[mask] for name, values in vars(found).items()})


def relative_motion(kind, points):
    """u, v, w at the start and their changes, each of shape (n, 3)."""
    ends = points[:, :4], points[:, 4:] - points[:, :4]
    if kind == "vertex_face":
        return [x[:, i] - x[:, 1] for x in ends for i in (2, 3, 0)]
    return [x[:, i] - x[:, j] for x in ends for i, j in ((1, 0), (3, 2), (2, 0))]


def size(kind, points):
    """The largest coordinate of the relative motion."""
    start, change = np.split(np.stack(relative_motion(kind, points), axis=1), 2, axis=1)
    return np.abs(np.concatenate([start, start + change], axis=1)).max(axis=(1, 2))


def reference(kind, points, times, normals):
    """Time, coordinates and normal of the contacts next to given ones, shape (n, 7), and how well they are defined.

    Also returned are dY/dt over the lengths of u, v and the relative velocity, and the shortest of these lengths.
    """
    u0, v0, w0, du, dv, dw = relative_motion(kind, points)
    t = times.copy()
    for _ in range(5):
        u, v, w = (x + t[:, None] * dx for x, dx in ((u0, du), (v0, dv), (w0, dw)))
        n = np.cross(u, v)
        rate = (dw * n + w * (np.cross(du, v) + np.cross(u, dv))).sum(axis=1)
        t = t - (w * n).sum(axis=1) / rate
    basis = np.stack([u, v], axis=2)
    transposed = np.swapaxes(basis, 1, 2)
    x, y = np.linalg.solve(transposed @ basis, transposed @ w[:, :, None])[..., 0].T
    coordinates = [1.0 - x - y, x, y] if kind == "vertex_face" else [x, -y, 0.0 * t]
    normal = n / np.linalg.norm(n, axis=1, keepdims=True)
    normal *= np.sign((normal * normals).sum(axis=1, keepdims=True))
    lengths = [np.linalg.norm(x, axis=1) for x in (u, v, dw - x[:, None] * du - y[:, None] * dv)]
    return np.column_stack([t, *coordinates, normal]), np.abs(rate) / np.prod(lengths, axis=0), np.min(lengths, axis=0)


def differences(kind, points, found, steps):
    """Central differences of the fourth order of the reference, shape (n, 7, 8, 3)."""
    derivatives = np.zeros((len(points), 7, 8, 3))
    for i, j in np.ndindex(8, 3):
        for factor, weight in ((1.0, 8.0 / 12.0), (-1.0, -8.0 / 12.0), (2.0, -1.0 / 12.0), (-2.0, 1.0 / 12.0)):
            moved = points.copy()
            moved[:, i, j] += factor * steps
            derivatives[:, :, i, j] += weight * reference(kind, moved, found.toi, found.normal)[0]
    return derivatives / steps[:, None, None, None]


def relative_errors(derivatives, expected):
    """Of time, coordinates and normal, shape (3, n): norms of the difference over norms of the expected ones."""
    return np.array(
        [
            np.linalg.norm((derivatives - expected)[:, rows].reshape(len(expected), -1), axis=1)
            / np.linalg.norm(expected[:, rows].reshape(len(expected), -1), axis=1)
            for rows in (slice(0, 1), slice(1, 4), slice(4, 7))
        ]
    )


@functools.cache
def passing(kind, dtype):
    """Queries that pass through each other, what is found of them, and how well that is defined by the reference."""
    points = mostly_hits(np.random.default_rng(1), cases(10_500), kind, dtype)
    found = impacts(kind, points)
    assert (found.status == HIT).mean() > 0.999
    _, distance, shortest = reference(kind, points.astype(np.float64), found.toi, found.normal)
    return points, found, distance, shortest


# --- Against differences and exact derivatives ---


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("dtype", "bound"), [(np.float64, 1e-6), (np.float32, 2e-3)])
def test_gradients_are_those_of_central_differences(kind, dtype, bound):
    points, found, distance, shortest = passing(kind, dtype)
    away = (distance > 0.02) & (found.status == HIT)
    assert away.sum() >= cases(10_000)
    assert not found.grazing[away].any()
    points, found = points[away].astype(np.float64), selected(found, away)
    steps = 1e-3 * distance[away] ** 2 * np.minimum(shortest[away], 1.0)
    expected = differences(kind, points, found, steps)
    errors = relative_errors(found.derivatives, expected)
    assert errors.max() < bound


def exact_derivative(kind, points, time):
    """dt/dx = -(dY/dx) / (dY/dt) at the root of Y next to a time, by its cofactors in rationals, shape (8, 3)."""
    x = [[Fraction(value) for value in point] for point in points.tolist()]

    def cross(a, b):
        return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]

    def dot(a, b):
        return sum(p * q for p, q in zip(a, b, strict=True))

    def minus(a, b):
        return [p - q for p, q in zip(a, b, strict=True)]

    pairs = ((2, 1), (3, 1), (0, 1)) if kind == "vertex_face" else ((1, 0), (3, 2), (2, 0))
    velocity = [minus(x[i + 4], x[i]) for i in range(4)]
    changes = [minus(velocity[i], velocity[j]) for i, j in pairs]
    time = Fraction(time)
    for last in (False, True):  # one step of Newton's method
        at = [[p + time * q for p, q in zip(x[i], velocity[i], strict=True)] for i in range(4)]
        u, v, w = (minus(at[i], at[j]) for i, j in pairs)
        by = cross(v, w), cross(w, u), cross(u, v)  # the derivatives of Y by u, v and w
        rate = sum(map(dot, by, changes))
        if not last:
            time -= dot(w, by[2]) / rate
    derivative = np.zeros((8, 3))
    for (i, j), cofactor in zip(pairs, by, strict=True):
        for end, share in ((0, 1 - time), (4, time)):
            row = np.array([float(-share * a / rate) for a in cofactor])
            derivative[i + end] += row
            derivative[j + end] -= row
    return derivative


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_of_the_time_are_exact_at_the_root_of_the_checker(kind):
    """Of everything that is not flagged."""
    points, found, *_ = passing(kind, np.float64)
    points, found = points[: cases(1500)], selected(found, np.arange(len(found.toi)) < cases(1500))
    times = TRUTH[kind](points)[:, 0]
    expected = np.array([exact_derivative(kind, *row) for row in zip(points, times, strict=True)])
    errors = np.linalg.norm(found.derivatives[:, 0] - expected, axis=(1, 2)) / np.linalg.norm(expected, axis=(1, 2))
    exact = found.grazing == 0
    assert exact.mean() > 0.99
    assert errors[exact].max() < 1e-9


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_do_not_depend_on_the_tolerance(kind):
    """They are those at the root, however roughly its time is asked for, as far as it is certain which one that is."""
    points, found, *_ = passing(kind, np.float64)
    for tolerance, share in ((2.0**-2, 0.5), (2.0**-4, 0.8), (2.0**-8, 0.99), (2.0**-12, 0.998), (2.0**-38, 0.98)):
        other = impacts(kind, points, tolerance)
        certain = (found.status == HIT) & (found.grazing == 0) & (other.grazing == 0)
        certain &= (found.normal * other.normal).sum(axis=1) > 0.0
        assert certain.mean() > share
        assert relative_errors(other.derivatives[certain], found.derivatives[certain]).max() < 1e-9


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_pass_the_check_of_warp(kind, device):
    points, found, distance, _ = passing(kind, np.float64)
    points = points[np.flatnonzero((distance > 0.3) & (found.status == HIT))[:4]]
    x = wp.array(points, dtype=wp.vec3d, requires_grad=True)
    flags = [wp.zeros(4, dtype=int) for _ in range(3)]
    outputs = [filled_with_nan(4, t, requires_grad=True) for t in (wp.float64, wp.vec3d, wp.vec3d)]
    inputs = [kind == "edge_edge", 2.0**-38, x]
    options = {"eps": 1e-4, "atol": 1e-6, "rtol": 1e-5, "show_summary": False}
    assert wp.autograd.gradcheck(impact_kernel(wp.vec3d), 4, inputs, [*flags, *outputs], **options)


# --- Invariances ---


coordinate = st.floats(-1.0, 1.0, width=32)
queries = st.lists(coordinate, min_size=24, max_size=24).map(lambda x: np.array(x, dtype=np.float64).reshape(1, 8, 3))


def crossing(kind, points):
    """The points, moved so that the features pass through each other: those in the middle change places."""
    points = points.copy()
    weights = np.array([3.0, -1.0, -1.0, -1.0] if kind == "vertex_face" else [1.0, 1.0, -1.0, -1.0])
    start, end = (np.einsum("i,nij->nj", weights, x) / np.abs(weights[0]) for x in (points[:, :4], points[:, 4:]))
    movers = [4] if kind == "vertex_face" else [4, 5]
    points[:, movers] -= (start + end)[:, None] / (1.0 if kind == "vertex_face" else 2.0)
    return points


@pytest.mark.parametrize("kind", KINDS)
@given(points=queries)
def test_moving_everything_changes_nothing(kind, points):
    """Neither together from start to end, nor with the same velocity: derivatives along both are zero."""
    found = impacts(kind, crossing(kind, points))
    for rows in (slice(0, 4), slice(4, 8)):
        share = found.derivatives[:, :, rows]
        assert np.abs(share.sum(axis=2)).max() <= 1e-12 * np.abs(share).max()


@pytest.mark.parametrize("kind", KINDS)
@given(points=queries, exponent=st.integers(-900, 900))
def test_gradients_are_inversely_proportional_to_the_size(kind, points, exponent):
    points = np.where(np.abs(points) < 1e-6, 0.0, crossing(kind, points))
    found, scaled = impacts(kind, points), impacts(kind, np.ldexp(points, exponent))
    for name in ("status", "grazing", "toi", "coordinates", "normal"):
        np.testing.assert_array_equal(getattr(scaled, name), getattr(found, name))
    np.testing.assert_array_equal(np.ldexp(scaled.derivatives, exponent), found.derivatives)


# --- Grazing, degenerate, tiny, huge ---


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_gradients_are_finite_bounded_and_flagged_for_whatever_is_asked(kind, dtype):
    """What is not flagged is a hit whose time is known; what is not in contact has no gradient."""
    flagged = {}
    for name, generator in GENERATORS.items():
        points = generator(np.random.default_rng([5, *name.encode()]), 200, kind, dtype)
        found = impacts(kind, points)
        assert np.isfinite(found.derivatives).all(), name
        contact = found.status != FREE
        assert not found.derivatives[~contact].any(), name
        assert not found.grazing[~contact].any(), name
        assert (found.within_tolerance[contact & (found.grazing == 0)] == 1).all(), name
        largest = np.abs(found.derivatives[:, 0]).max(axis=(1, 2)).astype(np.float64)
        assert (largest * size(kind, points.astype(np.float64)) <= LARGEST).all(), name
        flagged[name] = found.grazing[contact].mean()
    assert flagged["coplanar"] == flagged["resting_contact"] == 1.0
    assert flagged["mostly_hits"] < 0.02
    assert flagged["uniform"] < 0.05


def sliding(kind, slopes):
    """Features in or along the plane z = 0, one of which passes the other at a speed of one, falling with a slope."""
    n = len(slopes)
    if kind == "vertex_face":
        middle = np.array([[0.0, 0.0, 0.0], [-2.0, -2.0, 0.0], [4.0, -2.0, 0.0], [-2.0, 4.0, 0.0]])
    else:
        middle = np.array([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 1.0, 0.0]])
    movers = [0] if kind == "vertex_face" else [0, 1]
    change = np.zeros((n, 4, 3))
    change[:, movers] = np.stack([0.5 + 0.0 * slopes, 0.0 * slopes, -slopes], axis=1)[:, None]
    return np.concatenate([middle - 0.5 * change, middle + 0.5 * change], axis=1)


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_of_grazing_contact_are_clamped(kind):
    """They grow with 1 / slope down to the clamp at 1/1024, and from there on shrink to zero, without a jump."""
    slopes = np.append(2.0 ** -np.arange(0.0, 60.0, 0.25), 0.0)
    points = sliding(kind, slopes)
    found = impacts(kind, points)
    assert (found.status != FREE).all()
    sine = slopes / np.hypot(slopes, 0.5)
    np.testing.assert_array_equal(found.grazing == 1, sine < 2.0**-10)
    assert found.grazing.sum() > 100
    # raising the mover by dz at the start, and as much at the end, delays the contact by dz / slope
    delay = found.derivatives[:, 0, [0, 4] if kind == "vertex_face" else [0, 1, 4, 5], 2].sum(axis=1)
    limit = 2.0**-10 * np.hypot(slopes, 0.5)
    np.testing.assert_allclose(delay, slopes / np.maximum(slopes, limit) ** 2, rtol=1e-9)
    assert delay[-1] == 0.0


@pytest.mark.parametrize("kind", KINDS)
def test_features_without_a_plane_are_flagged(kind):
    """A collapsed triangle, and parallel edges: only the time has a gradient, along the velocity."""
    rng = np.random.default_rng(6)
    velocity, side = rng.uniform(-1.0, 1.0, (2, 50, 3)) + np.array([0.0, 0.0, 2.0])
    zero = np.zeros((50, 3))
    middle = np.stack([0.5 * side, zero, side, 2.0 * side] if kind == "vertex_face" else [0.5 * side, side, zero, side])
    moves = np.array([1, 0, 0, 0] if kind == "vertex_face" else [1, 1, 0, 0])[:, None, None] * velocity
    points = np.moveaxis(np.concatenate([middle - moves, middle + moves]), 0, 1)
    found = impacts(kind, points)
    assert (found.status == UNSURE).all()
    assert found.grazing.all()
    assert np.abs(found.derivatives[:, 1:]).max() < 1e-9
    expected = -velocity / (2.0 * (velocity**2).sum(axis=1, keepdims=True))
    movers = [0, 4] if kind == "vertex_face" else [0, 1, 4, 5]
    np.testing.assert_allclose(found.derivatives[:, 0, movers].sum(axis=1), expected, rtol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_points_that_are_not_finite_have_no_gradient(kind, value):
    points = mostly_hits(np.random.default_rng(7), 24, kind, np.float64)
    points.reshape(24, 24)[np.diag_indices(24)] = value
    found = impacts(kind, points)
    assert (found.status == UNSURE).all()
    assert found.grazing.all()
    assert not found.derivatives.any()


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_that_would_be_out_of_range_are_zero(kind):
    points = mostly_hits(np.random.default_rng(8), 20, kind, np.float64)
    points /= np.abs(points).max()
    for scale in (0.0, 1e-290, 1e-310, 1.7e308):
        found = impacts(kind, scale * points)
        assert (found.status == (UNSURE if scale == 0.0 else HIT)).all()
        assert found.grazing.mean() > 0.5 if scale > 1.0 else found.grazing.all()
        assert not found.derivatives[found.grazing == 1].any()


# --- Through the detector ---


def on_tape(detector, x0, x1):
    """A detection on a tape, with the arrays of its positions."""
    dtype = wp.vec3 if x0.dtype == np.float32 else wp.vec3d
    positions = [wp.array(x, dtype=dtype, requires_grad=True, device=detector.mesh.device) for x in (x0, x1)]
    with wp.Tape() as tape:
        c = detector.detect(*positions)
    return c, tape, positions


def assert_arrays_are_those_of_the_host(c):
    for kind in KINDS:
        for field in ("", "_toi", "_coordinates", "_normal"):
            np.testing.assert_array_equal(getattr(c.arrays, kind + field).numpy(), getattr(c, kind + field))
        assert len(getattr(c.arrays, f"{kind}_grazing")) == len(getattr(c, kind))


@pytest.mark.parametrize("method", ["conservative", "exact"])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_gradients_of_a_detection_are_those_of_its_pairs(dtype, method, device):
    x0, x1, faces = crumpled(0)
    x0, x1 = x0.astype(dtype), x1.astype(dtype)
    mesh = bsc.CollisionMesh(faces, len(x0), device=device)
    c, tape, positions = on_tape(bsc.CollisionDetector(mesh, method=method), x0, x1)
    assert_arrays_are_those_of_the_host(c)
    expected = np.zeros((2, len(x0), 3))
    for kind in KINDS:
        pairs = getattr(c, kind)
        assert len(pairs) > 100
        first = pairs[:, :1] if kind == "vertex_face" else mesh.edges[pairs[:, 0]]
        corners = np.concatenate([first, (mesh.faces if kind == "vertex_face" else mesh.edges)[pairs[:, 1]]], axis=1)
        found = impacts(kind, np.concatenate([x0[corners], x1[corners]], axis=1))
        grazing = getattr(c.arrays, f"{kind}_grazing").numpy()
        same = found.within_tolerance == 1
        assert same.mean() > 0.95
        np.testing.assert_array_equal(grazing[same], found.grazing[same] == 1)
        seed = np.random.default_rng(9).uniform(-1.0, 1.0, (len(pairs), 7)) * (same & ~grazing)[:, None]
        for name, part in (("toi", seed[:, 0]), ("coordinates", seed[:, 1:4]), ("normal", seed[:, 4:])):
            getattr(c.arrays, f"{kind}_{name}").grad.assign(part)
        shares = np.einsum("nk,nkij->nij", seed, found.derivatives.astype(np.float64))
        for end in range(2):
            np.add.at(expected[end], corners, shares[:, 4 * end : 4 * end + 4])
    tape.backward()
    for x, gradient in zip(positions, expected, strict=True):
        np.testing.assert_allclose(
            x.grad.numpy(), gradient, rtol=0.0, atol=(1e-5 if dtype == np.float32 else 1e-9) * np.abs(gradient).max()
        )


def test_a_tape_records_nothing_but_the_results(device):
    x0, x1, faces = crumpled(0)
    detector = bsc.CollisionDetector(bsc.CollisionMesh(faces, len(x0), device=device))
    _, tape, _ = on_tape(detector, x0, x1)
    assert len(tape.launches) == 2
    assert all(launch[0].key.endswith("differentiate") for launch in tape.launches)
    with wp.Tape() as tape:
        c = detector.detect(x0, x1)
    assert not tape.launches
    assert c.arrays is None


def test_detections_of_one_tape_do_not_disturb_one_another(device):
    """Each keeps what it found for the way back, though the queues are those of the last."""
    motions = [crumpled(seed) for seed in range(3)]
    faces = motions[0][2]
    detector = bsc.CollisionDetector(bsc.CollisionMesh(faces, len(motions[0][0]), device=device))
    positions, held, alone = [], [], []
    with wp.Tape() as tape:
        for x0, x1, _ in motions:
            positions.append([wp.array(x, dtype=wp.vec3, requires_grad=True, device=device) for x in (x0, x1)])
            held.append(detector.detect(*positions[-1]))
    for x0, x1, _ in motions:
        c, own_tape, (start, _) = on_tape(detector, x0, x1)
        c.arrays.edge_edge_toi.grad.fill_(1.0)
        own_tape.backward()
        alone.append(start.grad.numpy())
    for c in held:
        c.arrays.edge_edge_toi.grad.fill_(1.0)
    tape.backward()
    assert all(gradient.any() for gradient in alone)
    for (start, _), expected in zip(positions, alone, strict=True):
        np.testing.assert_allclose(start.grad.numpy(), expected, rtol=0.0, atol=1e-5 * np.abs(expected).max())


def test_collisions_that_the_host_decides_are_in_the_arrays(device):
    """A vertex that rests on a triangle, with exponents too far apart for the device."""
    x = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.25, 0.25, 0], [0.25, 0.25, 1], [0.5, 0.25, 1]], dtype=float)
    x[3, 0] += 2.0**-40
    x[0, 0] = 1e-250
    detector = bsc.CollisionDetector(bsc.CollisionMesh([[0, 1, 2], [3, 4, 5]], 6, device=device), method="exact")
    c, tape, positions = on_tape(detector, x, x)
    assert c.stats.vertex_face.host > 0
    assert c.vertex_face.tolist() == [[3, 0]]
    assert_arrays_are_those_of_the_host(c)
    assert c.arrays.vertex_face_grazing.numpy().all()
    c.arrays.vertex_face_toi.grad.fill_(1.0)
    tape.backward()
    for x in positions:
        assert np.isfinite(x.grad.numpy()).all()


@pytest.mark.parametrize("method", ["conservative", "exact"])
def test_contact_on_an_edge_has_the_gradients_of_the_plane_once_it_is_certain(method, device):
    """A vertex falls at 2 m a step from 1 m onto the edge of a triangle: raised by dz, it arrives dz / 4 m later."""
    x0 = np.array([[0, 0, 0], [2, 0, 0], [0, 2, 0], [1, 1, 1], [3, 3, 1], [3, 4, 1]], dtype=np.float32)
    x1 = x0 - np.array([0, 0, 2], dtype=np.float32) * (np.arange(6) >= 3)[:, None]
    mesh = bsc.CollisionMesh([[0, 1, 2], [3, 4, 5]], 6, device=device)
    c, tape, positions = on_tape(bsc.CollisionDetector(mesh, method=method), x0, x1)
    assert c.vertex_face.tolist() == [[3, 0]]
    assert bool(c.arrays.vertex_face_grazing.numpy()[0]) == (method == "conservative")
    c.arrays.vertex_face_toi.grad.fill_(1.0)
    tape.backward()
    for x in positions:
        np.testing.assert_allclose(x.grad.numpy()[3], [0.0, 0.0, 0.25], atol=1e-5)


def test_a_motion_without_collisions_has_empty_arrays(device):
    x = np.eye(3, dtype=np.float32)
    c, tape, (start, _) = on_tape(bsc.CollisionDetector(bsc.CollisionMesh([[0, 1, 2]], 3, device=device)), x, x)
    assert_arrays_are_those_of_the_host(c)
    tape.backward()
    assert not start.grad.numpy().any()


def test_positions_that_would_lose_their_gradients_are_refused(device):
    detector = bsc.CollisionDetector(bsc.CollisionMesh([[0, 1, 2]], 3, device=device))
    x = wp.zeros((3, 3), dtype=float, requires_grad=True, device=device)
    with pytest.raises(ValueError, match="to have gradients x0 must be a Warp array of vec3 or vec3d"):
        detector.detect(x, x)


@pytest.mark.slow
def test_many_iterations_do_not_take_more_memory(device):
    x = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.2, 0.2, 1], [0.3, 0.2, 2], [0.2, 0.3, 2]], dtype=np.float32)
    end = x.copy()
    end[3:, 2] -= 3.0
    detector = bsc.CollisionDetector(bsc.CollisionMesh([[0, 1, 2], [3, 4, 5]], 6, device=device))
    positions = [wp.array(p, dtype=wp.vec3, requires_grad=True, device=device) for p in (x, end)]

    def iterate(count):
        for _ in range(count):
            with wp.Tape() as tape:
                c = detector.detect(*positions)
            c.arrays.vertex_face_toi.grad.fill_(1.0)
            tape.backward()
            assert positions[0].grad.numpy().any()
            tape.zero()

    def used():
        gc.collect()
        return wp.get_mempool_used_mem_current(device) if device.is_cuda and device.is_mempool_enabled else resident()

    sizes = []
    for _ in range(6):  # garbage that waits to be collected is no leak
        iterate(100)
        sizes.append(used())
    assert sizes[-1] - sizes[0] < 2**18


def resident():
    """Bytes of memory that this process holds, where the system tells."""
    try:
        with open("/proc/self/statm") as file:
            return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return 0


@wp.kernel(module="unique")
def add_times(pairs: wp.array[wp.vec2i], toi: wp.array[wp.float64], total: wp.array[wp.float64]):
    i = wp.tid()
    if pairs[i][0] >= 0:
        wp.atomic_add(total, 0, toi[i])


@pytest.mark.gpu
def test_forward_and_backward_fit_in_one_graph():
    device = "cuda:0"
    x0, x1, faces = crumpled(0)
    detector = bsc.CollisionDetector(bsc.CollisionMesh(faces, len(x0), device=device))
    start, end = (wp.array(x, dtype=wp.vec3, requires_grad=True, device=device) for x in (x0, x1))
    total = wp.zeros(1, dtype=wp.float64, requires_grad=True, device=device)

    def iterate():
        for array in (start.grad, end.grad, total, total.grad):
            array.zero_()
        with wp.Tape() as tape:
            detect = detector.capture if detector.mesh.device.is_capturing else detector.detect
            arrays = detect(start, end).arrays
            for kind in KINDS:
                pairs, toi = getattr(arrays, kind), getattr(arrays, f"{kind}_toi")
                wp.launch(add_times, len(pairs), inputs=[pairs, toi], outputs=[total], device=device)
        tape.backward(total)
        return tape

    def results():
        return total.numpy()[0], start.grad.numpy(), end.grad.numpy()

    iterate()
    with wp.ScopedCapture(device=device) as capture:
        tape = iterate()
    for seed in (0, 1, 2):
        x0, x1, _ = crumpled(seed)
        start.assign(x0)
        end.assign(x1)
        iterate()
        expected = results()
        for _ in range(3):
            wp.capture_launch(capture.graph)
            for value, other in zip(results(), expected, strict=True):
                np.testing.assert_allclose(value, other, rtol=0.0, atol=1e-5 * np.abs(other).max())
    assert len(tape.launches) == 4
