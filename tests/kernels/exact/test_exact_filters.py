"""Signs of wide integers by floating point: right where they are certain, and certain where nothing is nearly zero."""

import numpy as np
import warp as wp
from sample_sizes import cases

from warp_bsc.kernels.exact import filters
from warp_bsc.kernels.exact.wide_integers import integer

LIMBS = 8
DIGITS = 12
number = integer(LIMBS)


@wp.kernel(enable_backward=False, module="unique")
def find_signs(
    p: wp.array2d[number],
    q: wp.array2d[number],
    roots: wp.array[int],
    at_roots: wp.array[int],
    quadratic: wp.array[int],
    cubic: wp.array[int],
    at_time: wp.array[int],
):
    i = wp.tid()
    at_time[i] = filters.near_sign_at_time(p[i, 0], p[i, 1], p[i, 2], p[i, 3], wp.uint64(i), wp.static(DIGITS))
    at_roots[i] = filters.near_signs_at_roots(p[i, 0], p[i, 1], p[i, 2], p[i, 3], q[i, 0], q[i, 1], q[i, 2], roots[i])
    quadratic[i] = filters.near_quadratic_discriminant(q[i, 0], q[i, 1], q[i, 2])
    cubic[i] = filters.near_cubic_discriminant(p[i, 0], p[i, 1], p[i, 2], p[i, 3])


def sign(x):
    return (x > 0) - (x < 0)


def to_limbs(rows):
    """Limbs of Python's integers, in two's complement."""
    raw = b"".join(x.to_bytes(8 * LIMBS, "little", signed=True) for row in rows for x in row)
    return np.frombuffer(raw, dtype=np.uint64).reshape(len(rows), -1, LIMBS)


def discriminants(p, q):
    p0, p1, p2, p3 = p
    h0, h1, h2 = p1 * p1 - 3 * p0 * p2, p1 * p2 - 9 * p0 * p3, p2 * p2 - 3 * p1 * p3
    return sign(q[1] ** 2 - 4 * q[0] * q[2]), sign(4 * h0 * h2 - h1 * h1)


def signs_at_roots(p, q, roots):
    """The signs of p at the positive roots of q, the smaller first, by the formulas of the exact arithmetic."""
    p0, p1, p2, p3 = p
    c0, c1, a = q
    g0, g1, g2 = a * p0, a * p1 - p3 * c0, a * p2 - p3 * c1
    k0, k1, j = g0 * a - g2 * c0, g1 * a - g2 * c1, g0 * c1 - g1 * c0
    s0, s1 = sign(k0), sign(k1)
    if s0 * s1 >= 0:
        return (s1 or s0,) * 2
    inside = sign(k0 * k0 - k1 * j)
    if roots == 1:
        return (-inside * s1,) * 2
    if inside < 0:
        return -s1, s1
    side = sign(c1 * k1 - 2 * a * k0) * sign(a) * s1
    if inside > 0:
        return (-side * s1,) * 2
    return -s1 if side > 0 else 0, s1 if side < 0 else 0


def random_rows(rng, n):
    """Cubics and quadratics whose coefficients have 1 to 300 bits, are zero, or make an expression nearly zero."""
    rows = []
    for i in range(n):
        bits = rng.integers(1, 301, 7) if i % 3 else np.full(7, rng.integers(1, 301))
        values = [(-1) ** int(rng.integers(2)) * int.from_bytes(rng.bytes(40), "little") % (1 << int(b)) for b in bits]
        signed = [int(v) * (-1) ** int(rng.integers(2)) for v in values]
        p, q = signed[:4], signed[4:]
        if i % 4 == 1:  # q^2 and p have double roots, or all but
            r, s = signed[0] >> 160, signed[1] >> 160
            q = [r * r, -2 * r * s, s * s + int(rng.integers(-1, 2))]
            p = [q[0] * s, q[1] * s + q[0] * r, q[2] * s + q[1] * r, q[2] * r]
        if i % 4 == 2:  # p vanishes at a root of q, or all but
            r, s, t = (v >> 150 for v in signed[:3])
            q = [r * s, -(r * t + s * t), t * t]
            p = [r * q[1], -t * q[1] + r * q[2], -t * q[2], int(rng.integers(-1, 2))]
        rows.append((p, q))
    return rows


def test_signs_are_right_where_they_are_certain():
    rows = [row for row in random_rows(np.random.default_rng(1), cases(4000)) if row[1][2] != 0]
    n = len(rows)
    roots = np.resize([1, 2], n).astype(np.int32)
    p, q = (wp.array(to_limbs([row[part] for row in rows]), dtype=number, device="cpu") for part in (0, 1))
    outputs = [wp.zeros(n, dtype=int, device="cpu") for _ in range(4)]
    inputs = [p, q, wp.array(roots, dtype=int, device="cpu")]
    wp.launch(find_signs, n, inputs=inputs, outputs=outputs, device="cpu")
    at_roots, quadratic, cubic, at_time = (array.numpy() for array in outputs)
    for i, row in enumerate(rows):
        if at_roots[i] != filters.UNKNOWN:
            first, second = signs_at_roots(*row, roots[i])
            assert at_roots[i] == 3 * first + second, row
        expected = discriminants(*row)
        s = 2**DIGITS - i
        value = sum(c * s ** (3 - j) * i**j for j, c in enumerate(row[0]))
        assert at_time[i] in (0, sign(value)), row
        assert quadratic[i] in (0, expected[0]) and cubic[i] in (0, expected[1]), row
    for certain in (at_roots != filters.UNKNOWN, quadratic != 0, cubic != 0, at_time != 0):
        assert 0.4 < certain.mean() < 0.999
