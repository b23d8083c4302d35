"""The exact checker against an independent brute force: distances at all critical times, with 60 digits."""

import itertools
from decimal import Decimal, localcontext
from fractions import Fraction

import numpy as np
import pytest
from checker_functions import COLLIDES, KINDS, TOI
from exact_vectors import along, cross, dot, minus
from generators import GENERATORS
from sample_sizes import cases

# Nothing here is shared with the checker: polynomials come from interpolation, roots from bisection between roots of
# the derivative, contact from the distance of closest points. Between small integers no distance is tiny but not zero;
# is_zero fails when one is.

DIGITS, ZERO, NOT_ZERO = 60, Decimal("1e-45"), Decimal("1e-25")
TOLERANCE = Fraction(1, 10**40)


def is_zero(squared):
    assert squared < ZERO or squared > NOT_ZERO, squared
    return squared < ZERO


def point_segment(p, a, b):
    """Returns the squared distance of a point and a segment."""
    length = dot(minus(b, a), minus(b, a))
    s = 0 if is_zero(length) else min(max(dot(minus(p, a), minus(b, a)) / length, 0), 1)
    gap = minus(p, along(a, s, minus(b, a)))
    return dot(gap, gap)


def point_triangle(p, a, b, c):
    """Returns the squared distance of a point and a triangle: to the plane if the foot is inside, else to an edge."""
    u, v, w = minus(b, a), minus(c, a), minus(p, a)
    uu, uv, vv, uw, vw = dot(u, u), dot(u, v), dot(v, v), dot(u, w), dot(v, w)
    gram = uu * vv - uv * uv
    distances = [point_segment(p, *edge) for edge in ((a, b), (b, c), (c, a))]
    if not is_zero(gram):
        s, r = (vv * uw - uv * vw) / gram, (uu * vw - uv * uw) / gram
        if s >= 0 and r >= 0 and s + r <= 1:
            gap = minus(w, along(along([0, 0, 0], s, u), r, v))
            distances.append(dot(gap, gap))
    return min(distances)


def segment_segment(a, b, c, d):
    """Returns the squared distance of two segments: of the lines if closest inside, else from an end."""
    u, v, w = minus(b, a), minus(d, c), minus(c, a)
    uu, uv, vv, uw, vw = dot(u, u), dot(u, v), dot(v, v), dot(u, w), dot(v, w)
    gram = uu * vv - uv * uv
    distances = [point_segment(*three) for three in ((a, c, d), (b, c, d), (c, a, b), (d, a, b))]
    if not is_zero(gram):
        s, r = (vv * uw - uv * vw) / gram, (uv * uw - uu * vw) / gram
        if 0 <= s <= 1 and 0 <= r <= 1:
            gap = minus(along(w, r, v), along([0, 0, 0], s, u))
            distances.append(dot(gap, gap))
    return min(distances)


def interpolated(values):
    """Returns the coefficients, constant first, of the polynomial that has these values at 0, 1, 2, ..."""
    coefficients, basis = [Fraction(0)] * len(values), [Fraction(1)]
    differences = [Fraction(value) for value in values]
    for order in range(len(values)):
        for i, b in enumerate(basis):
            coefficients[i] += differences[0] * b
        # Newton's basis: t (t - 1) ... (t - order) / (order + 1)!
        basis = [(low - order * high) / (order + 1) for low, high in zip([0, *basis], [*basis, 0], strict=True)]
        differences = [b - a for a, b in itertools.pairwise(differences)]
    while coefficients and coefficients[-1] == 0:
        coefficients.pop()
    return coefficients


def real_roots(coefficients):
    """Returns the roots in [0, 1] of a polynomial that is not zero, multiple ones once or more often."""
    if len(coefficients) < 2:
        return []

    def value(t):
        result = Decimal(0)
        for a in reversed(coefficients):
            result = result * t + a
        return result

    stops = [Decimal(0), *real_roots([i * a for i, a in enumerate(coefficients)][1:]), Decimal(1)]
    roots = [t for t in stops if is_zero(value(t) ** 2)]
    for low, high in itertools.pairwise(stops):
        if value(low) * value(high) < 0 and low not in roots and high not in roots:
            below, above = (low, high) if value(high) > 0 else (high, low)
            while abs(above - below) > Decimal(10) ** (5 - DIGITS):
                middle = (below + above) / 2
                below, above = (below, middle) if value(middle) > 0 else (middle, above)
            roots.append(below)
    return sorted(roots)


def brute_force(kind, query):
    """Returns the earliest contact time of a query with small integers (over 8), as a Fraction, or None."""
    start, end = ([[Fraction(x) for x in point] for point in half] for half in (query[:4], query[4:]))

    def position(t):
        return [[(1 - t) * i + t * j for i, j in zip(a, b, strict=True)] for a, b in zip(start, end, strict=True)]

    def volume(a, b, c, d):
        return dot(minus(b, a), cross(minus(c, a), minus(d, a)))

    def squared_area(p, a, b):
        area = cross(minus(a, p), minus(b, p))
        return dot(area, area)

    def order(p, a, b):
        return dot(minus(a, p), minus(b, p))

    rows = ((0, 1, 2), (0, 2, 3), (0, 3, 1)) if kind == "vertex_face" else ((0, 2, 3), (1, 2, 3), (2, 0, 1), (3, 0, 1))
    functions = [(volume, 3, (0, 1, 2, 3)), *((f, d, row) for f, d in ((squared_area, 4), (order, 2)) for row in rows)]
    distance = point_triangle if kind == "vertex_face" else segment_segment
    with localcontext() as context:
        context.prec = DIGITS
        times = {Decimal(0), Decimal(1)}
        positions = [position(t) for t in range(max(degree for _, degree, _ in functions) + 1)]
        for function, degree, row in functions:
            values = [function(*(x[i] for i in row)) for x in positions[: degree + 1]]
            times.update(real_roots([Decimal(a.numerator) / a.denominator for a in interpolated(values)]))
        start, end = (
            [[Decimal(x) for x in point] for point in half] for half in (query[:4].tolist(), query[4:].tolist())
        )
        return next((Fraction(t) for t in sorted(times) if is_zero(distance(*position(t)))), None)


def assert_brute_force_agrees(kind, points):
    """Compares answers and times with the brute force, and says how many collide."""
    toi = TOI[kind](points)
    assert np.array_equal(COLLIDES[kind](points), np.isfinite(toi[:, 0]))
    for query, (lower, upper) in zip(points, toi, strict=True):
        time = brute_force(kind, query)
        assert (time is None) == bool(np.isnan(lower)), query
        if time is not None:
            assert Fraction(lower) - TOLERANCE <= time <= Fraction(upper) + TOLERANCE, query
    return np.isfinite(toi[:, 0]).sum()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("size", [1, 2])
def test_brute_force_on_lattice(kind, size):
    points = np.random.default_rng(size).integers(-size, size + 1, (cases(100), 8, 3)).astype(np.float64)
    assert 0 < assert_brute_force_agrees(kind, points) < len(points)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dimensions", [1, 2])
def test_brute_force_on_coplanar_lattice(kind, dimensions):
    points = np.random.default_rng(dimensions).integers(-2, 3, (20 + cases(80), 8, 3)).astype(np.float64)
    points[..., dimensions:] = 0.0
    assert 0 < assert_brute_force_agrees(kind, points) < len(points)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", ["collapsing", "touching", "resting_contact"])
def test_brute_force_on_degenerate_lattice(kind, name):
    points = GENERATORS[name](np.random.default_rng(3), cases(60), kind, np.float64)
    assert assert_brute_force_agrees(kind, points) > 0
