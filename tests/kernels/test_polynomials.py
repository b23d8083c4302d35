"""The polynomials of a query against exact arithmetic: values, equivalence with the paper's, error bounds."""

from fractions import Fraction
from math import comb
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp
from generators import GENERATORS, integer_lattice, uniform
from outputs import filled_with_nan
from sample_sizes import cases

from warp_bsc.kernels import polynomials, signs
from warp_bsc.kernels.motion import edge_edge_motion, vertex_face_motion

KINDS = ("vertex_face", "edge_edge")
AXES = range(3)


@wp.kernel(enable_backward=False)
def compute(
    edges: bool,
    single: bool,
    points: wp.array2d[wp.vec3d],
    ends: wp.array2d[wp.vec3d],
    sizes: wp.array2d[wp.vec3d],
    normal: wp.array2d[wp.vec3d],
    k: wp.array[wp.vec4d],
    k_bound: wp.array[wp.float64],
    q: wp.array3d[wp.vec3d],
    q_bounds: wp.array2d[wp.vec4d],
):
    i = wp.tid()
    p0 = points[i, 0]
    p1 = points[i, 1]
    p2 = points[i, 2]
    p3 = points[i, 3]
    p4 = points[i, 4]
    p5 = points[i, 5]
    p6 = points[i, 6]
    p7 = points[i, 7]
    motion = polynomials.Motion()
    if single:
        s0 = wp.vec3(p0)
        s1 = wp.vec3(p1)
        s2 = wp.vec3(p2)
        s3 = wp.vec3(p3)
        s4 = wp.vec3(p4)
        s5 = wp.vec3(p5)
        s6 = wp.vec3(p6)
        s7 = wp.vec3(p7)
        if edges:
            motion = edge_edge_motion(s0, s1, s2, s3, s4, s5, s6, s7, signs.ROUNDOFF)
        else:
            motion = vertex_face_motion(s0, s1, s2, s3, s4, s5, s6, s7, signs.ROUNDOFF)
    elif edges:
        motion = edge_edge_motion(p0, p1, p2, p3, p4, p5, p6, p7, signs.ROUNDOFF)
    else:
        motion = vertex_face_motion(p0, p1, p2, p3, p4, p5, p6, p7, signs.ROUNDOFF)
    ends[i, 0] = motion.u0
    ends[i, 1] = motion.v0
    ends[i, 2] = motion.w0
    ends[i, 3] = motion.u1
    ends[i, 4] = motion.v1
    ends[i, 5] = motion.w1
    sizes[i, 0] = motion.u_size
    sizes[i, 1] = motion.v_size
    sizes[i, 2] = motion.w_size
    y = polynomials.coplanarity(motion)
    normal[i, 0] = y.n0
    normal[i, 1] = y.nh
    normal[i, 2] = y.n1
    k[i] = y.k
    k_bound[i] = y.bound
    for axis in range(3):
        tests = polynomials.inside_tests(motion, y, axis)
        q[i, axis, 0] = tests.q0
        q[i, axis, 1] = tests.q1
        q[i, axis, 2] = tests.q2
        q[i, axis, 3] = tests.q3
        q_bounds[i, axis] = tests.bounds


def run(kind, points):
    """The polynomials that the device functions compute for queries, all results as NumPy arrays."""
    n = len(points)
    single = points.dtype == np.float32
    shapes = {
        "ends": ((n, 6), wp.vec3d),  # u v w at the start, u v w at the end
        "sizes": ((n, 3), wp.vec3d),
        "normal": ((n, 3), wp.vec3d),
        "k": (n, wp.vec4d),
        "k_bound": (n, wp.float64),
        "q": ((n, 3, 4), wp.vec3d),  # axis, test, coefficient
        "q_bounds": ((n, 3), wp.vec4d),
    }
    outputs = {name: filled_with_nan(shape, dtype) for name, (shape, dtype) in shapes.items()}
    inputs = [kind == "edge_edge", single, wp.array(points.astype(np.float64), dtype=wp.vec3d)]
    wp.launch(compute, n, inputs=inputs, outputs=list(outputs.values()))
    return SimpleNamespace(**{name: array.numpy() for name, array in outputs.items()})


# --- Exact arithmetic: NumPy arrays of Fractions, and polynomials as lists of coefficients, constant first ---

exact = np.vectorize(Fraction, otypes=[object])


def differences(kind, points):
    """u v w at the start and at the end, exact and not scaled, shape (n, 6, 3)."""
    p, q, r, s = np.moveaxis(exact(points).reshape(-1, 2, 4, 3), 2, 0)
    uvw = (q - p, s - r, r - p) if kind == "edge_edge" else (r - q, s - q, p - q)
    return np.stack(uvw, axis=2).reshape(-1, 6, 3)


def scales(vectors):
    """The powers of two that bring the largest coordinate of each query into [1, 2), shape (n, 1, 1)."""
    largest = abs(vectors).max(axis=(1, 2))
    return np.array([Fraction(2) ** (1 - int(np.frexp(float(size))[1])) for size in largest])[:, None, None]


def cross(x, y):
    """Cross products along the last axis."""
    x0, x1, x2 = np.moveaxis(x, -1, 0)
    y0, y1, y2 = np.moveaxis(y, -1, 0)
    return np.stack([x1 * y2 - x2 * y1, x2 * y0 - x0 * y2, x0 * y1 - x1 * y0], axis=-1)


def value(coefficients, t):
    """Polynomials with these Bernstein coefficients along the last axis, at t, by definition."""
    n = coefficients.shape[-1] - 1
    return sum(comb(n, i) * coefficients[..., i] * t**i * (1 - t) ** (n - i) for i in range(n + 1))


def times(f, g):
    """The product of two polynomials."""
    product = [Fraction(0)] * (len(f) + len(g) - 1)
    for i, a in enumerate(f):
        for j, b in enumerate(g):
            product[i + j] += a * b
    return product


def plus(f, g, factor=1):
    """f + factor g."""
    n = max(len(f), len(g))
    return [(f[i] if i < len(f) else 0) + factor * (g[i] if i < len(g) else 0) for i in range(n)]


def power_form(coefficients):
    """The polynomial with these Bernstein coefficients."""
    n = len(coefficients) - 1
    total = [Fraction(0)]
    for i, c in enumerate(coefficients):
        basis = [Fraction(comb(n, i))]
        for factor in [[0, 1]] * i + [[1, -1]] * (n - i):
            basis = times(basis, factor)
        total = plus(total, basis, c)
    return total


def remainder(f, g):
    """The remainder of f divided by g, without its zeros: the empty list where g divides f."""
    f, g = list(f), list(g)
    while g[-1] == 0:
        g.pop()
    while len(f) >= len(g):
        factor = f[-1] / g[-1]
        for i, b in enumerate(g, start=len(f) - len(g)):
            f[i] -= factor * b
        f.pop()
    while f and f[-1] == 0:
        f.pop()
    return f


# --- Values ---


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_motion_is_scaled_by_a_power_of_two(kind, dtype):
    rng = np.random.default_rng(1)
    points = 2.0 ** rng.integers(-20, 21, (cases(200), 1, 1)) * integer_lattice(rng, cases(200), kind, np.float64)
    points = points.astype(dtype)
    computed = run(kind, points)
    expected = differences(kind, points)
    expected = expected * scales(expected)
    assert np.array_equal(exact(computed.ends), expected)
    assert np.array_equal(exact(computed.sizes), np.maximum(abs(expected[:, :3]), abs(expected[:, 3:])))


@pytest.mark.parametrize("kind", KINDS)
def test_motion_to_cull_that_one_power_of_two_cannot_scale_is_zero(kind):
    points = uniform(np.random.default_rng(1), 4, kind, np.float64)
    points[0] = points[0, 0]  # all the same
    points[1] *= 1e-290
    points[2] *= 1.7e308
    points[3, :, 0] = 1.5e308 * (-1.0) ** np.arange(8)  # differences overflow
    computed = run(kind, points)
    assert not computed.ends.any()
    assert not computed.k.any()


@pytest.mark.parametrize("kind", KINDS)
def test_polynomials_have_the_values_of_their_products(kind):
    """Coordinates are small multiples of 3: nothing rounds, not even the thirds, and values are equal."""
    points = 3.0 * np.random.default_rng(2).integers(-40, 41, (cases(150), 8, 3))
    computed = run(kind, points)
    ends = differences(kind, points)
    ends = ends * scales(ends)
    k, normal, q = exact(computed.k), exact(computed.normal), exact(computed.q)
    for t in (Fraction(0), Fraction(2, 7), Fraction(3, 5), Fraction(1), Fraction(-4, 3)):
        u, v, w = np.moveaxis((1 - t) * ends[:, :3] + t * ends[:, 3:], 1, 0)
        n, w_v, u_w, w_u = cross(u, v), cross(w, v), cross(u, w), cross(w, u)
        tests = (w_v, u_w, n - w_v - u_w, n) if kind == "vertex_face" else (w_v, n - w_v, w_u, n - w_u)
        assert np.array_equal(value(np.moveaxis(normal, 1, -1), t), n)
        assert np.array_equal(value(k, t), (w * n).sum(axis=1))
        assert np.array_equal(value(q, t), np.stack(tests, axis=2))


def coplanar_at_half(kind, count):
    """Queries that lie in one plane at t = 1/2, and the coordinates of the point or of the lines' crossing there.

    All coordinates are multiples of 3, small enough for exact products and thirds.
    """
    rng = np.random.default_rng(3)
    u, v, velocity_u, velocity_v, velocity_w = 12.0 * rng.integers(-9, 10, (5, count, 1, 3))
    beta, gamma = rng.choice([-4, -1, 0, 1, 2, 3, 4, 6], (2, count, 1, 1)) / 4.0
    w = beta * u + gamma * v if kind == "vertex_face" else beta * u - gamma * v
    points = []
    for s in (-0.5, 0.5):
        u_end, v_end, w_end, zero = u + s * velocity_u, v + s * velocity_v, w + s * velocity_w, np.zeros_like(u)
        points += [w_end, zero, u_end, v_end] if kind == "vertex_face" else [zero, u_end, w_end, w_end + v_end]
    return np.concatenate(points, axis=1), beta[:, 0, 0], gamma[:, 0, 0]


@pytest.mark.parametrize("kind", KINDS)
def test_opposite_signs_tell_contact_from_none_along_every_axis(kind):
    points, beta, gamma = coplanar_at_half(kind, 200)
    computed = run(kind, points)
    half = Fraction(1, 2)
    assert not value(exact(computed.k), half).any()
    q = value(exact(computed.q), half)
    opposite = (q.min(axis=2) < 0) & (q.max(axis=2) > 0)
    largest = beta + gamma if kind == "vertex_face" else np.maximum(beta, gamma)
    touching = (np.minimum(beta, gamma) >= 0.0) & (largest <= 1.0)
    normal = value(np.moveaxis(exact(computed.normal), 1, -1), half)
    assert np.array_equal(opposite, ~touching[:, None] & (normal != 0))
    assert 40 < touching.sum() < 160


# --- Equivalence with the paper's polynomials ---


def paper_quadratic(x0, y0, x1, y1):
    """x(t) cross y(t) as the paper has it: its n-hat comes from the ends and the velocities."""
    start, end = cross(x0, y0), cross(x1, y1)
    return start, (start + end - cross(x1 - x0, y1 - y0)) / 2, end


def paper_cubic(w0, w1, n):
    """k_0 ... k_3 of the paper's Coplanarity Test Theorem."""
    n0, nh, n1 = n
    return [w0 @ n0, (2 * w0 @ nh + w1 @ n0) / 3, (2 * w1 @ nh + w0 @ n1) / 3, w1 @ n1]


def paper_quartic(m, n):
    """l_0 ... l_4 of the paper's Inside Test Theorem."""
    (m0, mh, m1), (n0, nh, n1) = m, n
    return [
        m0 @ n0,
        (m0 @ nh + mh @ n0) / 2,
        (m0 @ n1 + 4 * mh @ nh + m1 @ n0) / 6,
        (mh @ n1 + m1 @ nh) / 2,
        m1 @ n1,
    ]


def paper_reduction(k, g):
    """p_0 ... p_2 of the paper's Simplified Inside Test Theorem, by way of its k' and s."""
    raised = [k[0], (k[0] + 3 * k[1]) / 4, (k[1] + k[2]) / 2, (3 * k[2] + k[3]) / 4, k[3]]
    s = [
        scale * (g[i] * raised[0] - g[0] * raised[i])
        for i, scale in enumerate((Fraction(4), Fraction(2), Fraction(4, 3), Fraction(1)), start=1)
    ]
    return [
        scale * (s[i] * k[0] - s[0] * k[i])
        for i, scale in enumerate((Fraction(3), Fraction(3, 2), Fraction(1)), start=1)
    ]


def paper_tests(kind, points):
    """The paper's n, k and its three inside tests of one query, each with the test of ours that takes its place.

    Its edge-edge tests (supplement 3) leave n open. With n = u x v they are our n - s, s and n - r up to signs, and
    the fourth, r >= 0, is missing, so it comes last here; with the normal of a b c they suffice unless r = 0.

    Returns:
        (n, k, [(m, sign, index), ...]): m is parallel to sign times our test of that index.
    """
    start, end = points[:4], points[4:]

    def difference(i, j):
        return start[i] - start[j], end[i] - end[j]

    def product(x, y):
        return paper_quadratic(x[0], y[0], x[1], y[1])

    if kind == "vertex_face":
        p, a, b, c = range(4)
        n = product(difference(b, a), difference(c, a))
        corners = ((b, c, 2), (c, a, 0), (a, b, 1))
        return (
            n,
            paper_cubic(*difference(p, a), n),
            [(product(difference(i, p), difference(j, p)), 1, index) for i, j, index in corners],
        )
    a, b, c, d = range(4)
    n = product(difference(b, a), difference(d, c))
    corners = ((b, c, -1, 1), (c, a, -1, 0), (a, b, 1, 3))
    return (
        n,
        paper_cubic(*difference(c, a), n),
        [(product(difference(i, d), difference(j, d)), sign, index) for i, j, sign, index in corners]
        + [(product(difference(a, c), difference(b, c)), -1, 2)],
    )


@pytest.mark.parametrize("kind", KINDS)
def test_inside_tests_are_those_of_the_paper_modulo_coplanarity(kind):
    """Shows t^2 P = k0^2 G and G n_i = q_i n.n modulo Y, for each inside test G, its reduction P and each axis i.

    So at a root of Y the paper's P, its G and our q_i n_i have one sign wherever k0 != 0 (so that the root is not 0)
    and n != 0.
    """
    lattice = 3.0 * np.random.default_rng(4).integers(-4, 5, (cases(25), 8, 3))
    points = np.concatenate([lattice, coplanar_at_half(kind, cases(25))[0]])
    computed = run(kind, points)
    points = exact(points) * scales(differences(kind, points))
    compared = 0
    for row in range(len(points)):
        n, k, tests = paper_tests(kind, points[row])
        assert exact(computed.k[row]).tolist() == k
        y = power_form(k)
        assert any(y)
        normal = [power_form([x[axis] for x in n]) for axis in AXES]
        square = plus(plus(times(normal[0], normal[0]), times(normal[1], normal[1])), times(normal[2], normal[2]))
        for m, sign, index in tests:
            g = paper_quartic(m, n)
            p = paper_reduction(k, g)
            assert remainder(plus(times([0, 0, 1], power_form(p)), power_form(g), -(k[0] ** 2)), y) == []
            ours = exact(computed.q[row, :, index])
            for axis in AXES:
                q = power_form(sign * ours[axis])
                assert remainder(plus(times(power_form(g), normal[axis]), times(q, square), -1), y) == []
            if row >= len(lattice) and k[0] != 0:  # the root t = 1/2
                paper = value(np.array(p), Fraction(1, 2))
                for axis in AXES:
                    q, n_i = (value(f, Fraction(1, 2)) for f in (sign * ours[axis], np.array([x[axis] for x in n])))
                    if n_i != 0:
                        compared += 1
                        assert np.sign(float(paper)) == np.sign(float(q * n_i))
    assert compared > cases(100)


# --- Error bounds ---


def exact_polynomials(kind, ends):
    """Bernstein coefficients of Y, shape (n, 4), and of the inside tests, shape (n, 3 axes, 4 tests, 3)."""
    u0, v0, w0, u1, v1, w1 = np.moveaxis(ends, 1, 0)

    def product(x0, x1, y0, y1):
        return np.stack([cross(x0, y0), (cross(x0, y1) + cross(x1, y0)) / 2, cross(x1, y1)], axis=-1)

    def dot(x, y):
        return (x * y).sum(axis=1)

    n, w_v, w_u = product(u0, u1, v0, v1), product(w0, w1, v0, v1), product(w0, w1, u0, u1)
    n0, nh, n1 = np.moveaxis(n, -1, 0)
    k = [dot(w0, n0), (2 * dot(w0, nh) + dot(w1, n0)) / 3, (2 * dot(w1, nh) + dot(w0, n1)) / 3, dot(w1, n1)]
    tests = (w_v, -w_u, n - w_v + w_u, n) if kind == "vertex_face" else (w_v, n - w_v, w_u, n - w_u)
    return np.stack(k, axis=1), np.stack(tests, axis=2)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_errors_stay_within_their_bounds(kind, dtype):
    """Holds for every coefficient; what is used of a bound, about a tenth to a third, says that none is loose."""
    rng = np.random.default_rng(5)
    count = 40 if dtype == np.float32 else 60
    points = [
        generator(rng, 4 * count if generator is uniform else count, kind, dtype)
        for name, generator in GENERATORS.items()
        if name != "subnormal_and_huge"
    ]
    points = np.concatenate(points)
    vectors = differences(kind, points)
    moving = vectors.any(axis=(1, 2)).astype(bool)
    points, vectors = points[moving], vectors[moving]
    computed = run(kind, points)
    k, q = exact_polynomials(kind, vectors * scales(vectors))
    k_share = abs(exact(computed.k) - k).max(axis=1) / exact(computed.k_bound)
    q_share = abs(exact(computed.q) - q).max(axis=3) / exact(computed.q_bounds)
    assert k_share.max() <= 1
    assert q_share.max() <= 1
    assert k_share.max() > 0.01
    assert q_share.max(axis=(0, 1)).min() > 0.01
