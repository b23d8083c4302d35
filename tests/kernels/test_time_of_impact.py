"""Times of impact, contact points and normals: first contacts within the tolerance, and where features are closest."""

import functools
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp
from generators import GENERATORS, grazing, mostly_hits, one_ulp_apart, touching, uniform
from impacts import impact_kernel
from outputs import filled_with_nan
from sample_sizes import cases

import warp_bsc as bsc
from warp_bsc import checker
from warp_bsc.kernels import FREE, HIT, UNSURE
from warp_bsc.kernels.classification import classify
from warp_bsc.kernels.closest import between, closest_coordinates
from warp_bsc.kernels.motion import relative_motion
from warp_bsc.kernels.polynomials import coplanarity
from warp_bsc.kernels.signs import ROUNDOFF
from warp_bsc.kernels.time_of_impact import impact

KINDS = ("vertex_face", "edge_edge")
TRUTH = {"vertex_face": checker.vertex_face_toi, "edge_edge": checker.edge_edge_toi}
AIMED = (mostly_hits, uniform, one_ulp_apart, grazing, touching)
TOLERANCES = [2.0**-4, 2.0**-10, 2.0**-20, 2.0**-30]


@wp.kernel(enable_backward=False)
def find_closest(
    kind: int,
    uvw: wp.array2d[wp.vec3d],
    coordinates: wp.array[wp.vec2d],
    gap: wp.array[wp.vec3d],
):
    i = wp.tid()
    coordinates[i] = closest_coordinates(kind, uvw[i, 0], uvw[i, 1], uvw[i, 2])
    gap[i] = between(kind, coordinates[i], uvw[i, 0], uvw[i, 1], uvw[i, 2])


@wp.kernel(enable_backward=False)
def search(
    kind: int,
    tolerance: wp.float64,
    x: wp.array2d[wp.vec3d],
    status: wp.array2d[int],
    times: wp.array2d[wp.vec2d],
    contact: wp.array3d[wp.vec3d],
):
    i = wp.tid()
    motion = relative_motion(kind, x[i, 0], x[i, 1], x[i, 2], x[i, 3], x[i, 4], x[i, 5], x[i, 6], x[i, 7], ROUNDOFF)
    y = coplanarity(motion)
    for simple in range(2):
        found = impact(motion, y, classify(motion, y), tolerance, simple == 1)
        status[simple, i] = found.status
        times[simple, i] = wp.vec2d(found.toi, wp.float64(found.within_tolerance))
        contact[simple, i, 0] = found.coordinates
        contact[simple, i, 1] = found.normal


def impacts(kind, points, tolerance=2.0**-20):
    """What the device functions find for queries, as NumPy arrays."""
    n = len(points)
    outputs = {
        "status": wp.zeros(n, dtype=int),
        "within_tolerance": wp.zeros(n, dtype=int),
        "toi": filled_with_nan(n, wp.float64),
        "coordinates": filled_with_nan(n, wp.vec3d),
        "normal": filled_with_nan(n, wp.vec3d),
    }
    inputs = [kind == "edge_edge", tolerance, wp.array(points.astype(np.float64), dtype=wp.vec3d)]
    status, within_tolerance, *contacts = outputs.values()
    grazing = wp.zeros(n, dtype=int)  # says of gradients whether they are clamped
    wp.launch(impact_kernel(wp.vec3d), n, inputs=inputs, outputs=[status, within_tolerance, grazing, *contacts])
    return SimpleNamespace(**{name: array.numpy() for name, array in outputs.items()})


def gap_weights(kind, coordinates):
    """Weights that make of four points the vector from the second feature to the first at the coordinates."""
    if kind == "vertex_face":
        return np.concatenate([np.ones((len(coordinates), 1)), -coordinates], axis=1)
    s, r = coordinates[:, 0], coordinates[:, 1]
    return np.stack([1.0 - s, s, r - 1.0, -r], axis=1)


def gaps(kind, points, coordinates):
    """That vector at the start and at the end."""
    return np.moveaxis(np.einsum("ni,neij->nej", gap_weights(kind, coordinates), points.reshape(-1, 2, 4, 3)), 1, 0)


def assert_valid_contact(kind, found, points, contact):
    """Coordinates are in the features; the normal is a unit vector against the relative motion there."""
    coordinates, normal = found.coordinates[contact], found.normal[contact]
    assert (coordinates >= -1e-15).all()
    assert (coordinates <= 1.0).all()
    if kind == "vertex_face":
        assert np.abs(coordinates.sum(axis=1) - 1.0).max(initial=0.0) < 1e-15
    else:
        assert (coordinates[:, 2] == 0.0).all()
    start, end = gaps(kind, points[contact], coordinates)
    assert np.abs(np.linalg.norm(normal, axis=1) - 1.0).max(initial=0.0) < 1e-14
    speed = ((end - start) * normal).sum(axis=1)
    assert (speed <= 1e-13 * np.abs(points[contact]).max(axis=(1, 2))).all()


def assert_exact_times(toi, tolerance):
    """Times are in the step, and multiples of the shortest interval, so that no rounding is in them."""
    assert ((toi >= 0.0) & (toi <= 1.0)).all()
    largest = 2.0**-10  # above which a tolerance counts as that
    assert (np.fmod(toi, 2.0**-8 * min(tolerance, largest)) == 0.0).all()


def sides(kind, points, time):
    """The two vectors that span the plane of contact, at a time each, shape (n, 2, 3)."""
    x = points[:, :4] + time[:, None, None] * (points[:, 4:] - points[:, :4])
    pairs = ((1, 2), (1, 3)) if kind == "vertex_face" else ((0, 1), (2, 3))
    return np.stack([x[:, j] - x[:, i] for i, j in pairs], axis=1)


@functools.cache
def passing(kind):
    """Queries that pass through each other, and the times between which their first contact is, shape (n, 2)."""
    points = mostly_hits(np.random.default_rng(1), 1000, kind, np.float64)
    times = TRUTH[kind](points)
    hits = ~np.isnan(times[:, 0])
    assert hits.mean() > 0.99
    return points[hits], times[hits]


# --- Time of impact ---


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("tolerance", TOLERANCES)
def test_contact_is_found_within_the_tolerance(kind, tolerance):
    points, times = passing(kind)
    found = impacts(kind, points, tolerance)
    within_tolerance = found.within_tolerance == 1
    assert (found.status == HIT).mean() > 0.999
    assert within_tolerance.mean() > 0.99
    assert (found.toi <= times[:, 1]).all()
    assert (found.toi >= times[:, 0] - tolerance)[within_tolerance].all()
    assert_exact_times(found.toi, tolerance)


@pytest.mark.parametrize("generator", AIMED, ids=lambda generator: generator.__name__)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("tolerance", [2.0**-10, 2.0**-30])
def test_a_simple_search_that_finds_a_contact_finds_that_of_the_whole_one(kind, generator, tolerance):
    """Bit for bit: a GPU that searches in two passes finds what a CPU does."""
    points = generator(np.random.default_rng(2), cases(2000), kind, np.float64)
    x = wp.array(points, dtype=wp.vec3d)
    outputs = [wp.zeros((2, len(points)), dtype=dtype) for dtype in (int, wp.vec2d)]
    outputs.append(wp.zeros((2, len(points), 2), dtype=wp.vec3d))
    wp.launch(search, len(points), inputs=[kind == "edge_edge", tolerance, x], outputs=outputs)
    status, times, contact = (values.numpy() for values in outputs)
    simple = times[1, :, 1] == 1.0
    for values in (status, times, contact):
        np.testing.assert_array_equal(values[1, simple], values[0, simple])
    if generator is mostly_hits:
        assert 0.3 < simple.mean() < 1.0


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("tolerance", TOLERANCES)
def test_features_meet_at_the_coordinates_with_the_normal(kind, tolerance):
    """Gap and tilt of the normal shrink with the tolerance; where u and v are almost parallel the normal may tilt.

    The coordinates are those at a root of the cubic's chord, much closer to the contact than the time of impact.
    """
    points, times = passing(kind)
    found = impacts(kind, points, tolerance)
    within_tolerance = found.within_tolerance == 1
    assert_valid_contact(kind, found, points, np.ones(len(points), dtype=bool))
    start, end = gaps(kind, points, found.coordinates)
    gap = start + found.toi[:, None] * (end - start)
    assert np.linalg.norm(gap, axis=1)[within_tolerance].max() < 5.0 * tolerance
    at_contact = np.linalg.norm(start + times[:, :1] * (end - start), axis=1)
    assert np.percentile(at_contact[within_tolerance], 95) < 20.0 * tolerance**2 + 1e-14
    spanning = sides(kind, points, found.toi)
    length = np.linalg.norm(spanning, axis=2)
    sine = np.linalg.norm(np.cross(spanning[:, 0], spanning[:, 1]), axis=1) / length.prod(axis=1)
    tilt = np.abs((spanning * found.normal[:, None]).sum(axis=2)) * sine[:, None] * length.min(axis=1, keepdims=True)
    assert tilt[within_tolerance].max() < 5.0 * tolerance


@pytest.mark.parametrize("kind", KINDS)
def test_contact_at_a_time_that_halving_hits_is_within_tolerance(kind):
    """Integer features meet inside both at t = 1/2 exactly, where halves of the step end."""
    rng = np.random.default_rng(2)
    n = 300
    corners = 16.0 * np.array([[0, 0, 0], [-1, -1, 0], [2, -1, 0], [-1, 2, 0]], dtype=float)
    if kind == "edge_edge":
        corners = 16.0 * np.array([[-1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0]], dtype=float)
    middle = corners + rng.integers(-2, 3, (n, 4, 3)) * np.array([1, 1, 0]) + rng.integers(-2, 3, (n, 1, 3))
    velocity = rng.integers(-4, 5, (n, 4, 3)).astype(float)
    rows = [0] if kind == "vertex_face" else [0, 1]
    velocity[:, rows, 2] = rng.choice([-1, 1], (n, 1)) * rng.integers(10, 20, (n, 1))
    points = np.concatenate([middle - velocity, middle + velocity], axis=1)
    times = TRUTH[kind](points)
    assert (times == 0.5).all()
    for tolerance in (2.0**-10, 2.0**-20):
        found = impacts(kind, points, tolerance)
        assert (found.within_tolerance == 1).all()
        assert (found.toi <= 0.5).all()
        assert (found.toi >= 0.5 - tolerance).all()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_no_contact_is_before_the_time_of_impact(kind, dtype):
    """For every query that aims at trouble: a lower bound always, and close where it is within the tolerance."""
    tolerance = 2.0**-12
    for name, generator in GENERATORS.items():
        rng = np.random.default_rng([3, *name.encode()])
        points = generator(rng, cases(40 if "scales" in name or "huge" in name else 100), kind, dtype)
        times = TRUTH[kind](points)
        found = impacts(kind, points, tolerance)
        contact = found.status != FREE
        hits = ~np.isnan(times[:, 0])
        assert not hits[~contact].any(), name
        assert (found.toi[~contact] == 2.0).all(), name
        assert hits[found.status == HIT].all(), name
        assert_exact_times(found.toi[contact], tolerance)
        assert (found.toi[hits] <= times[hits, 1]).all(), name
        within_tolerance = found.within_tolerance == 1
        assert (found.status[within_tolerance] == HIT).all(), name
        assert (found.toi[within_tolerance] >= times[within_tolerance, 0] - tolerance).all(), name


@pytest.mark.parametrize("kind", KINDS)
def test_times_in_a_plane_are_as_near_as_others(kind):
    """Of features that stay in one plane no time is certain, but the bound is near the contact."""
    rng = np.random.default_rng(12)
    points = rng.uniform(-1.0, 1.0, (400, 8, 3))
    points[:, 4:] = points[:, :4]
    first = 1 if kind == "vertex_face" else 2
    points[:, 4 : 4 + first] += rng.uniform(-3.0, 3.0, (400, 1, 3))
    points[..., 2] = 0.25
    truth = TRUTH[kind](points)
    later = (truth[:, 0] > 0.01) & (truth[:, 0] < 1.0)
    assert later.sum() > 50
    query = getattr(bsc, f"query_{kind}")
    devices = ["cpu", *(str(device) for device in wp.get_cuda_devices())]
    for found in (impacts(kind, points), *(query(points, method="conservative", device=device) for device in devices)):
        assert (found.status[later] == UNSURE).all()
        assert (found.toi[later] <= truth[later, 1]).all()
        assert (truth[later, 0] - found.toi[later] < 4.0 * 2.0**-20).all()


@pytest.mark.parametrize("kind", KINDS)
def test_contacts_of_degenerate_features_are_valid(kind):
    """Collapsed triangles, parallel edges and points that do not move still give coordinates and a unit normal."""
    for name in (
        "collapsing",
        "resting_contact",
        "grazing",
        "touching",
        "coplanar",
        "shared_coordinates",
        "mixed_scales",
    ):
        rng = np.random.default_rng([4, *name.encode()])
        points = GENERATORS[name](rng, cases(400), kind, np.float64)
        found = impacts(kind, points)
        assert (found.status != FREE).sum() > cases(20)
        assert_valid_contact(kind, found, points, found.status != FREE)


@pytest.mark.parametrize("kind", KINDS)
def test_normals_of_features_without_a_plane_are_along_the_velocity(kind):
    """A triangle that is a segment, and parallel edges, both in passing with a constant velocity."""
    rng = np.random.default_rng(6)
    n = 200
    velocity = rng.uniform(-1.0, 1.0, (n, 3))
    side = rng.integers(-4, 5, (n, 3)) + np.array([0.0, 0.0, 9.0])
    zero = np.zeros((n, 3))
    if kind == "vertex_face":
        middle = np.stack([0.5 * side, zero, side, 2.0 * side], axis=1)
    else:
        middle = np.stack([0.5 * side, side, zero, side], axis=1)
    moves = np.array([1, 0, 0, 0] if kind == "vertex_face" else [1, 1, 0, 0])[:, None] * velocity[:, None]
    found = impacts(kind, np.concatenate([middle - moves, middle + moves], axis=1))
    assert (found.status == UNSURE).all()
    assert np.abs(found.normal + velocity / np.linalg.norm(velocity, axis=1, keepdims=True)).max() < 1e-12


@pytest.mark.parametrize("kind", KINDS)
def test_normals_are_unit_vectors_at_any_scale(kind):
    points = GENERATORS["subnormal_and_huge"](np.random.default_rng(4), 400, kind, np.float32).astype(np.float64)
    found = impacts(kind, points)
    assert_valid_contact(kind, found, points, found.status != FREE)


@pytest.mark.parametrize("kind", KINDS)
def test_points_that_are_all_the_same_are_in_contact_from_the_start(kind):
    points = np.ones((1, 8, 3))
    found = impacts(kind, points)
    assert found.status[0] == UNSURE
    assert found.toi[0] == 0.0
    assert_valid_contact(kind, found, points, np.array([True]))


# --- Any tolerance, any scale ---


@functools.cache
def aimed(kind):
    """Queries that aim at trouble, and the times between which their first contact is, shape (n, 2)."""
    points = np.concatenate([generator(np.random.default_rng(7), cases(100), kind, np.float64) for generator in AIMED])
    return points, TRUTH[kind](points)


@functools.cache
def random(kind):
    """Queries of which many pass through each other, and the times between which their first contact is."""
    rng = np.random.default_rng(8)
    points = np.concatenate([generator(rng, cases(300), kind, np.float64) for generator in (mostly_hits, uniform)])
    return points, TRUTH[kind](points)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("tolerance", [-np.inf, -1.0, 0.0, 1e-300, np.nan, 2.0**-38])
def test_tolerances_that_are_too_small_are_the_smallest(kind, tolerance):
    points, times = aimed(kind)
    found = impacts(kind, points, tolerance)
    expected = impacts(kind, points, 2.0**-38)
    for name, values in vars(found).items():
        assert np.array_equal(values, vars(expected)[name]), name
    hits = ~np.isnan(times[:, 0])
    assert not hits[found.status == FREE].any()
    assert hits[found.status == HIT].all()
    assert (found.toi[hits] <= times[hits, 1]).all()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("tolerance", [2.0**-2, 0.3, 0.5, 1.0, 2.0, np.inf])
def test_features_meet_at_the_coordinates_also_where_the_tolerance_is_the_step(kind, tolerance):
    points, times = random(kind)
    found = impacts(kind, points, tolerance)
    hits = ~np.isnan(times[:, 0])
    assert hits[found.status == HIT].all()
    assert not hits[found.status == FREE].any()
    assert (found.toi[hits] <= times[hits, 1]).all()
    within_tolerance = found.within_tolerance == 1
    assert within_tolerance[hits].mean() > 0.99
    assert (found.toi[within_tolerance] >= times[within_tolerance, 0] - tolerance).all()
    assert_valid_contact(kind, found, points, found.status != FREE)
    start, end = gaps(kind, points[within_tolerance], found.coordinates[within_tolerance])
    velocity = end - start
    time = -(start * velocity).sum(axis=1) / (velocity**2).sum(axis=1)
    toi = found.toi[within_tolerance]
    assert ((time > toi - 2.0**-10) & (time < np.minimum(toi + tolerance, 1.0) + 2.0**-10)).all()
    gap = np.linalg.norm(start + time[:, None] * velocity, axis=1)
    assert gap.max() < 5.0 * 2.0**-10
    assert np.percentile(gap, 95) < 20.0 * 2.0**-20


@pytest.mark.parametrize("kind", KINDS)
def test_contacts_are_the_same_in_any_unit_of_length(kind):
    """From where all is subnormal to where differences overflow; where a coordinate is huge, but never differs, too."""
    rng = np.random.default_rng(9)
    passing = mostly_hits(rng, 300, kind, np.float64)
    passing /= np.abs(passing).max(axis=(1, 2), keepdims=True)
    points = np.concatenate([passing, uniform(rng, 300, kind, np.float64)])
    points = np.round(points * 2.0**28) / 2.0**30
    flat = points * np.array([0.0, 1.0, 1.0])
    huge = np.array([2.0**1022, 0.0, 0.0])
    expected = [impacts(kind, x) for x in (points, flat)]
    assert (expected[0].status == HIT).sum() > 250
    for exponent in (-1044, -1030, -1000, -930, -600, -500, -481, -480, -479, -470, 600, 990, 1000, 1023, 1025):
        scale = np.ldexp(1.0, exponent // 2), np.ldexp(1.0, exponent - exponent // 2)
        scaled = [x * scale[0] * scale[1] for x in (points, flat)]
        answers = [impacts(kind, x) for x in scaled]
        truths = list(expected)
        if exponent < 900:
            answers.append(impacts(kind, scaled[1] + huge))
            truths.append(expected[1])
        for found, truth in zip(answers, truths, strict=True):
            for name, values in vars(found).items():
                assert np.array_equal(values, vars(truth)[name]), (exponent, name)


@pytest.mark.parametrize("kind", KINDS)
def test_exact_contacts_are_the_same_in_any_unit_of_length(kind):
    points = np.round(mostly_hits(np.random.default_rng(10), 200, kind, np.float64) * 2.0**20) / 2.0**24
    query = getattr(bsc, f"query_{kind}")
    expected = query(points)
    assert expected.hit.sum() > 190
    for exponent in (-1040, -900, 900, 1023):
        found = query(np.ldexp(points, exponent))
        for name in ("hit", "toi", "coordinates", "normal"):
            assert np.array_equal(getattr(found, name), getattr(expected, name), equal_nan=True), (exponent, name)


@pytest.mark.parametrize("kind", KINDS)
def test_points_that_are_not_finite_say_so(kind):
    points = np.repeat(passing(kind)[0][:1], 72, axis=0)
    points.reshape(72, 24)[np.arange(72), np.arange(72) % 24] = np.repeat([np.nan, np.inf, -np.inf], 24)
    found = impacts(kind, points)
    assert (found.status == UNSURE).all()
    assert (found.toi == 0.0).all()
    assert np.isnan(found.coordinates).all()
    assert np.isnan(found.normal).all()


# --- Closest points ---


def feasible(kind, coordinates):
    """The coordinates moved into the range that the features have."""
    coordinates = np.clip(coordinates, 0.0, 1.0)
    if kind == "vertex_face":
        coordinates /= np.maximum(coordinates.sum(axis=-1, keepdims=True), 1.0)
    return coordinates


def distance(kind, uvw, coordinates):
    """Distances of the points at coordinates of shape (m, n, 2), for n rows u v w."""
    x, y = coordinates[..., :1], coordinates[..., 1:]
    u, v, w = np.moveaxis(uvw, 1, 0)
    return np.linalg.norm(w - x * u - y * v if kind == "vertex_face" else x * u - y * v - w, axis=-1)


def vectors(rng, n):
    """Rows u v w: random, small integers, and degenerate: parallel, equal or zero, exactly and nearly."""
    uvw = rng.uniform(-1.0, 1.0, (n, 3, 3))
    uvw = np.where(rng.random((n, 1, 1)) < 0.3, rng.integers(-2, 3, (n, 3, 3)), uvw)
    parallel = rng.random(n) < 0.4
    ratio = rng.choice([-2.0, -1.0, 0.0, 0.5, 1.0, 2.0], (n, 1))
    off = rng.choice([0.0, 1.0], (n, 1)) * 2.0 ** rng.uniform(-60.0, -4.0, (n, 1)) * rng.uniform(-1.0, 1.0, (n, 3))
    uvw[parallel, 1] = (ratio * uvw[:, 0] + off)[parallel]
    uvw[rng.random(n) < 0.1, 0] = 0.0
    uvw[rng.random(n) < 0.05, 2] = 0.0
    return uvw * 2.0 ** rng.integers(-30, 31, (n, 1, 1))


@pytest.mark.parametrize("kind", KINDS)
def test_coordinates_are_those_of_the_closest_points(kind):
    """Nothing closer among points all over the features, nor in steps of any size from the answer.

    The distance is convex, so that what no small step improves is best.
    """
    rng = np.random.default_rng(5)
    n = 3000
    uvw = vectors(rng, n)
    found, gap = filled_with_nan(n, wp.vec2d), filled_with_nan(n, wp.vec3d)
    wp.launch(find_closest, n, inputs=[KINDS.index(kind), wp.array(uvw, dtype=wp.vec3d)], outputs=[found, gap])
    found, gap = found.numpy(), gap.numpy()
    size = np.abs(uvw).max(axis=(1, 2))
    least = distance(kind, uvw, found[None])[0]
    assert (np.abs(np.linalg.norm(gap, axis=1) - least) <= 1e-15 * size).all()
    assert np.abs(found - feasible(kind, found)).max() < 1e-15
    grid = np.stack(np.meshgrid(*2 * [np.linspace(0.0, 1.0, 21)]), axis=-1).reshape(-1, 1, 2)
    excess = least - distance(kind, uvw, feasible(kind, grid)).min(axis=0)
    angle = np.linspace(0.0, 2.0 * np.pi, 8, endpoint=False)
    around = np.stack([np.cos(angle), np.sin(angle)], axis=-1)[:, None]
    for step in 10.0 ** -np.arange(1.0, 7.0):
        near = distance(kind, uvw, feasible(kind, found[None] + step * around))
        excess = np.maximum(excess, least - near.min(axis=0))
    # lines within 1e-8 of parallel are as close anywhere, to within as much
    assert (excess <= (1e-14 if kind == "vertex_face" else 1e-8) * size).all()
