"""The exact phase: true answers in every width, no number beyond its bound, little left to the host."""

import numpy as np
import pytest
import warp as wp
from benchmark_data import load_cloth_funnel_queries, load_queries
from certify_contacts import KINDS
from compilation import QUICK
from exact_queries import decide_exactly
from generators import GENERATORS, _weights, _with_gap
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from sample_sizes import cases
from test_wide_integers import to_integers

import warp_bsc as bsc
from warp_bsc import checker
from warp_bsc.kernels.exact import algebraic
from warp_bsc.kernels.exact.algebraic import remainder
from warp_bsc.kernels.exact.polygon import BITS, coordinate, cross_component, make_polygon, spread, volume
from warp_bsc.kernels.exact.wide_integers import integer, minor, subtract, times
from warp_bsc.kernels.motion import query_of


def assert_true(kind, points, limbs, *, least=1.0):
    """Asserts that the answers and times in so many limbs are right, and that at least that share has some."""
    interval = getattr(checker, f"{kind}_toi")(points)
    truth = ~np.isnan(interval[:, 0])
    time, _ = decide_exactly(kind, points, limbs, timed=True)
    status, _ = decide_exactly(kind, points, limbs)
    decided = time >= 0.0
    assert decided.mean() >= least
    assert np.array_equal(decided, status >= 0.0)
    assert np.array_equal((time < 2.0)[decided], truth[decided])
    assert np.array_equal((status < 2.0)[decided], truth[decided])
    hit = decided & truth
    assert (time[hit] <= interval[hit, 1]).all()
    assert (time[hit] > interval[hit, 0] - 2.0**-20).all()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", GENERATORS)
def test_answers_are_true_in_every_width(name, kind, dtype):
    count = cases(8 if name == "subnormal_and_huge" else 40)
    points = GENERATORS[name](np.random.default_rng([13, *name.encode()]), count, kind, dtype)
    for limbs in BITS:
        assert_true(kind, points, limbs, least=1.0 if dtype == np.float32 and limbs == 8 else 0.0)


def turning_planes(rng, n, kind):
    """Queries in one plane all the time that turns: a fixed combination of moving points, half of which collapse."""
    position, velocity = rng.integers(-4, 5, (2, n, 4, 3)).astype(np.float64)
    collapse = rng.random(n) < 0.5
    third = 3 if kind == "vertex_face" else 1
    ratio = rng.integers(-1, 3, (n, 1, 1)).astype(np.float64)
    # at time 1/2 all edges are parallel to one another
    for k in {1, 2, 3} - {third}:
        position[collapse, k] = (position[:, :1] + ratio * (position[:, third : third + 1] - position[:, :1]))[
            collapse, 0
        ]
    weights = _weights(rng, n, kind)
    outside = rng.random(n) < 0.7
    weights[outside] += rng.integers(-2, 3, (outside.sum(), 1)) * (
        np.array([0.0, -1.0, 1.0, 0.0]) if kind == "vertex_face" else np.array([-1.0, 1.0, 0.0, 0.0])
    )
    ends = [_with_gap(position + shift * velocity, weights, kind) for shift in (-0.5, 0.5)]
    return np.concatenate(ends, axis=1)


@pytest.mark.parametrize("kind", KINDS)
def test_motion_in_a_turning_plane(kind):
    points = turning_planes(np.random.default_rng(3), cases(600), kind)
    truth = getattr(checker, kind)(points)
    assert cases(100) < truth.sum() < cases(500)
    for limbs in BITS:
        assert_true(kind, points, limbs)


@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=cases(25))
@given(
    coordinates=arrays(np.int64, (40, 8, 3), elements=st.integers(-3, 3)),
    axes=st.permutations(range(3)),
    data=st.data(),
)
def test_answers_do_not_depend_on_names_scales_or_the_direction_of_time(kind, coordinates, axes, data):
    points = coordinates.astype(np.float64)
    hit = decide_exactly(kind, points, 1)[0] < 2.0
    assert np.array_equal(hit, getattr(checker, kind)(points))
    order = [0, 2, 3, 1] if kind == "vertex_face" else [3, 2, 0, 1]
    renamed = points.reshape(-1, 2, 4, 3)[:, ::-1, order][..., axes].reshape(-1, 8, 3)
    assert np.array_equal(decide_exactly(kind, renamed, 1)[0] < 2.0, hit)
    scale = 2.0 ** np.array(data.draw(st.tuples(*[st.integers(-900, 900)] * 3)))
    assert np.array_equal(decide_exactly(kind, points * scale, 1)[0] < 2.0, hit)


@pytest.mark.data
@pytest.mark.parametrize("kind", KINDS)
def test_answers_to_the_benchmark_are_true(kind):
    queries = [*load_queries(), *load_cloth_funnel_queries()]
    of_kind = [(points, truth) for _, k, points, truth in queries if k == kind]
    assert of_kind
    for points, truth in of_kind:
        time, _ = decide_exactly(kind, points, 8)
        assert (time >= 0.0).all()
        assert np.array_equal(time < 2.0, truth)
        time, _ = decide_exactly(kind, points, 2)
        decided = time >= 0.0
        assert np.array_equal((time < 2.0)[decided], truth[decided])


@pytest.mark.parametrize("kind", KINDS)
def test_single_precision_within_forty_binary_orders_takes_two_limbs(kind):
    rng = np.random.default_rng(8)
    size = 2.0 ** rng.integers(-100, 60, (20000, 1, 1))
    points = rng.choice([-1.0, 1.0], (20000, 8, 3)) * rng.uniform(1.0, 2.0, (20000, 8, 3))
    points = (size * points * 2.0 ** rng.uniform(0.0, 39.0, (20000, 8, 3))).astype(np.float32)
    assert np.isfinite(points).all()
    _, bits = decide_exactly(kind, points, 1)
    assert 60 < bits.max() <= BITS[2]


@pytest.mark.parametrize("kind", KINDS)
def test_no_single_precision_is_too_wide(kind):
    points = np.random.default_rng(9).integers(0, 2**32, (20000, 8, 3), dtype=np.uint32).view(np.float32)
    points = np.where(np.isfinite(points), points, np.float32(1e-45))
    points[0] = np.finfo(np.float32).max * np.where(np.arange(24).reshape(8, 3) % 2, 1, -1)
    points[0, 0], points[0, 4] = np.finfo(np.float32).max, -np.finfo(np.float32).max
    points[0, 1], points[0, 5] = -np.finfo(np.float32).max, 1e-45
    _, bits = decide_exactly(kind, points, 1)
    assert 270 < bits.max() <= 278 <= BITS[8]


def passing(size, beside):
    """A face, and another one with a corner that passes an edge of the first: positions at the start and at the end.

    Args:
        size: How far along the edge, y = x / 2 from the origin.
        beside: How far inside of the edge, as a share of that.
    """
    start = np.array(
        [[0, 0, 0], [1, 0.5, 0], [0, 1, 0], [size, size * (0.5 + beside), 1], [0.5, 0.25, 2], [0.25, 0.5, 2]]
    )
    end = start.copy()
    end[3, 2] = -1.0
    return start, end


@pytest.mark.parametrize(
    ("size", "beside", "hits", "host"),
    [
        (0.25, 0.0, 1, 0),
        (0.25, -(2.0**-53), 0, 0),
        (2.0**-400, 0.0, 1, 1),
        (2.0**-400, 2.0**-53, 1, 1),
        (2.0**-400, -(2.0**-53), 0, 1),
    ],
)
def test_what_is_too_wide_goes_to_the_host(device, size, beside, hits, host):
    mesh = bsc.CollisionMesh([[0, 1, 2], [3, 4, 5]], 6, device=device)
    c = bsc.CollisionDetector(mesh, method="exact").detect(*passing(size, beside))
    assert c.vertex_face.tolist() == [[3, 0]] * hits
    assert c.certified
    assert ((c.vertex_face_toi > 0.5 - 2.0**-20) & (c.vertex_face_toi <= 0.5)).all()
    stats = c.stats.vertex_face
    assert (stats.hits, stats.unsure, stats.exact, stats.host) == (0, 1, 1 - host, host)


def test_a_graph_decides_all_but_what_is_too_wide(device):
    if not device.is_cuda:
        pytest.skip("CUDA graphs need a GPU")
    x0, x1 = (wp.array(x, dtype=wp.vec3d, device=device) for x in passing(0.25, 0.0))
    detector = bsc.CollisionDetector(bsc.CollisionMesh([[0, 1, 2], [3, 4, 5]], 6, device=device), method="exact")
    detector.detect(x0, x1)
    with wp.ScopedCapture(device) as capture:
        c = detector.capture(x0, x1)
    # what is left to the host counts as a hit
    for size, hits, certified in ((0.25, 0, True), (2.0**-400, 1, False)):
        for array, positions in zip((x0, x1), passing(size, -(2.0**-53)), strict=True):
            array.assign(positions)
        wp.capture_launch(capture.graph)
        assert (c.read().vertex_face.tolist(), c.read().certified) == ([[3, 0]] * hits, certified)


# --- Widths ---


def phases_kernel(limbs):
    """A kernel that computes what the exact phase does, step by step."""
    one, two, four, eight = (integer(limbs * times) for times in (1, 2, 4, 8))

    # As the exact phase does, functions take the polygon as an array: Warp keeps one instance of a generic function for
    # arrays in memory and those of a kernel, whichever came first.
    @wp.func
    def coordinate_of(polygon: wp.array[one], corner: int, end: int, axis: int):
        return coordinate(polygon, corner, end, axis)

    @wp.func
    def volume_of(polygon: wp.array[one], last: int):
        return volume(polygon, last)

    @wp.func
    def cross_component_of(polygon: wp.array[one], first: int, second: int, axis: int):
        return cross_component(polygon, first, second, axis)

    @wp.kernel(enable_backward=False, module="unique", module_options=QUICK)
    def compute(
        kind: int,
        points: wp.array2d[wp.vec3d],
        bits: wp.array[int],
        corners: wp.array2d[one],
        v: wp.array2d[two],
        c: wp.array2d[two],
        k: wp.array2d[four],
        end: wp.array2d[eight],
    ):
        i = wp.tid()
        x = points[i]
        query = query_of(x[0], x[1], x[2], x[3], x[4], x[5], x[6], x[7])
        exponents, width = spread(kind, query)
        bits[i] = width
        polygon = wp.zeros(shape=(24,), dtype=one)
        make_polygon(kind == 1, query, exponents, polygon)
        for corner in range(4):
            for axis in range(3):
                corners[i, 6 * corner + axis] = coordinate_of(polygon, corner, 0, axis)
                corners[i, 6 * corner + 3 + axis] = coordinate_of(polygon, corner, 1, axis)
        v0, v1, v2, v3 = volume_of(polygon, 2 + kind)
        v[i, 0] = v0
        v[i, 1] = v1
        v[i, 2] = v2
        v[i, 3] = v3
        q0, q1, q2 = cross_component_of(polygon, 0, 1, i % 3)
        c[i, 0] = q0
        c[i, 1] = q1
        c[i, 2] = q2
        k0, k1, j = remainder(v0, v1, v2, v3, q0, q1, q2)
        k[i, 0] = k0
        k[i, 1] = k1
        k[i, 2] = j
        end[i, 0] = minor(k0, k0, k1, j)
        zero = subtract(v0, v0)
        k0, k1, j = remainder(v1, times(v2, wp.uint64(2)), times(v3, wp.uint64(3)), zero, q0, q1, q2)
        k[i, 3] = k0
        k[i, 4] = k1
        k[i, 5] = j
        end[i, 1] = minor(k0, k0, k1, j)
        h0 = minor(v1, v1, times(v0, wp.uint64(3)), v2)
        h1 = minor(v1, v2, times(v0, wp.uint64(9)), v3)
        h2 = minor(v2, v2, times(v1, wp.uint64(3)), v3)
        k[i, 6] = h0
        k[i, 7] = h1
        k[i, 8] = h2
        end[i, 2] = minor(times(h0, wp.uint64(4)), h2, h1, h1)

    return compute


def expected_phases(kind, corners, axes):
    """The same in Python's integers, from corners of shape (n, 4, 2, 3): lists by stage of arrays by query."""

    def multiply(f, g):
        product = [0] * (len(f) + len(g) - 1)
        for i, a in enumerate(f):
            for j, b in enumerate(g):
                product[i + j] = product[i + j] + a * b
        return product

    def subtracted(f, g):
        return [a - b for a, b in zip(f, g, strict=True)]

    def cross(x, y):
        pairs = ((1, 2), (2, 0), (0, 1))
        return [subtracted(multiply(x[j], y[k]), multiply(x[k], y[j])) for j, k in pairs]

    x = [[[corners[:, corner, 0, axis], corners[:, corner, 1, axis]] for axis in range(3)] for corner in range(4)]
    n = cross(x[1], x[2 if kind == "vertex_face" else 3])
    terms = [multiply(x[0][axis], n[axis]) for axis in range(3)]
    v = [sum(parts) for parts in zip(*terms, strict=True)]
    first = cross(x[0], x[1])
    c = [np.choose(axes, [first[axis][i] for axis in range(3)]) for i in range(3)]

    def divide(p):
        g0, g1, g2 = c[2] * p[0], c[2] * p[1] - p[3] * c[0], c[2] * p[2] - p[3] * c[1]
        return c[2] * g0 - c[0] * g2, c[2] * g1 - c[1] * g2, c[1] * g0 - c[0] * g1

    k, slope = divide(v), divide([v[1], 2 * v[2], 3 * v[3], 0 * v[0]])
    h = v[1] * v[1] - 3 * v[0] * v[2], v[1] * v[2] - 9 * v[0] * v[3], v[2] * v[2] - 3 * v[1] * v[3]
    ends = [a * a - b * j for a, b, j in (k, slope)]
    return v, c, [*k, *slope, *h], [*ends, 4 * h[0] * h[2] - h[1] * h[1]]


def bounds(b):
    """Bits that each number takes at most, without its sign: those of the corners, V, C, K and J and H, and signs."""
    v = [3 * b + 3, 3 * b + 4, 3 * b + 4, 3 * b + 3]
    k = [7 * b + 7, 7 * b + 9, 7 * b + 7]
    slope = [7 * b + 7, 7 * b + 8, 7 * b + 8]
    return v, [2 * b + 1, 2 * b + 2, 2 * b + 1], [*k, *slope, *[6 * b + 9] * 3], [14 * b + 17, 14 * b + 17, 12 * b + 21]


def widest_queries(rng, n, kind, limbs):
    """Queries with corners as large as they may be, and of signs as extreme as can be."""
    b = BITS[limbs]
    if kind == "vertex_face":  # of a vertex that rests at the origin
        largest = np.nextafter(2.0**b, 0.0) if b > 53 else 2.0**b - 1.0
        x = largest * rng.choice([-1.0, 1.0], (n, 8, 3))
        x[:, [0, 4]] = 0.0
    else:
        x = (
            2.0 ** (b - 1)
            * rng.choice([-1.0, 1.0], (n, 8, 3))
            * rng.choice([1.0, 0.5, 0.0], (n, 8, 3), p=[0.9, 0.05, 0.05])
        )
    x[:, 1] = np.where(rng.random((n, 3)) < 0.02, 1.0, x[:, 1])  # of the lowest bit
    return x


@pytest.mark.parametrize("limbs", [1, 2])
@pytest.mark.parametrize("kind", KINDS)
def test_no_number_exceeds_its_bound(kind, limbs):
    rng = np.random.default_rng(limbs)
    names = [name for name in GENERATORS if name != "subnormal_and_huge"]
    points = [GENERATORS[name](rng, cases(150), kind, np.float64) for name in names]
    points = np.concatenate([*points, widest_queries(rng, cases(4000), kind, limbs)])
    _, bits = decide_exactly(kind, points, limbs)
    points, bits = points[bits <= BITS[limbs]], bits[bits <= BITS[limbs]]
    assert bits.max() == BITS[limbs]
    n = len(points)
    one, two, four, eight = (integer(limbs * times) for times in (1, 2, 4, 8))
    shapes = [(24, one), (4, two), (3, two), (9, four), (3, eight)]
    outputs = [wp.zeros(n, dtype=int), *(wp.zeros((n, count), dtype=number) for count, number in shapes)]
    inputs = [int(kind == "edge_edge"), wp.array(points, dtype=wp.vec3d)]
    wp.launch(phases_kernel(limbs), n, inputs=inputs, outputs=outputs)
    found = [to_integers(a.numpy().reshape(n, count, -1)) for a, (count, _) in zip(outputs[1:], shapes, strict=True)]
    corners = found[0].reshape(n, 4, 2, 3)
    width = np.vectorize(lambda x: abs(int(x)).bit_length(), otypes=[int])
    assert (width(found[0]).max(axis=1) <= bits).all()
    expected = expected_phases(kind, corners, np.arange(n) % 3)
    closest = []
    for computed, truth, bound in zip(found[1:], expected, zip(*map(bounds, bits), strict=True), strict=True):
        assert np.array_equal(computed.T, truth)
        slack = np.array(bound) - width(computed)
        assert (slack >= 0).all()
        closest.append(slack.min(axis=0).tolist())
    if kind == "vertex_face":  # they are as small as can be, but for a few bits
        assert np.max(closest[0]) <= 1 and np.max(closest[1]) == 0
        assert np.max(closest[2]) <= 3 and np.max(closest[3]) <= 6


def test_all_that_is_asked_about_roots_fits(monkeypatch):
    """Sums of absolute values, by the device function itself: of every remainder that is taken, by powers of 2^B."""
    outer, inner = 3.0 * 3.0**0.5, 9.0 * 3.0**0.5  # of V, by Hadamard's inequality: three determinants inside
    monkeypatch.setattr(algebraic, "product", lambda a, b: a * b)
    monkeypatch.setattr(algebraic, "minor", lambda a, b, c, d: a * b + c * d)
    v, slope, bend = (outer, inner, inner, outer), (inner, 2 * inner, 3 * outer, 0.0), (inner, 3 * outer, 0.0, 0.0)
    k_bits, end_bits = [], []
    for p in (v, slope, bend):
        for coefficients in (
            (*p, 2.0, 4.0, 2.0),
            (*p[::-1], 0.0, 4.0, 2.0),  # where the quadratic has no leading coefficient
        ):
            k0, k1, j = algebraic.remainder.func(*coefficients)
            k_bits += [np.ceil(np.log2(size)) for size in (k0, k1, j) if size > 0.0]
            if k0 > 0.0:  # else there is nothing more to ask
                end_bits.append(np.ceil(np.log2(k0 * k0 + k1 * j)))
                assert 4.0 * k1 + 4.0 * k0 < 2.0**11
    assert (max(k_bits), max(end_bits)) == (10, 17)
    for limbs, b in BITS.items():
        assert 7 * b + max(k_bits) + 1 <= 256 * limbs
        assert 14 * b + max(end_bits) + 1 <= 512 * limbs
