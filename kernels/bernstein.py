"""Bernstein polynomials of degree one to three: evaluation, splitting, restriction and division (Sec. 3.2).

A polynomial is the vector of its Bernstein coefficients on [0, 1]. Two weights a, b >= 0 give a parameter
t = a / (a + b) **homogeneously**, and a polynomial of degree m is evaluated times (a + b)^m, so that its sign needs no
division (supplement, Sec. 4).
"""

import warp as wp

from .signs import THREE, TWO


@wp.func
def inverse_power_of_two(x: wp.float64) -> wp.float64:
    """Returns the power of two that scales a number in [2^-1022, 2^1023) to [1, 2)."""
    exponent = (wp.cast(x, wp.uint64) >> wp.uint64(52)) & wp.uint64(2047)
    return wp.cast((wp.uint64(2046) - exponent) << wp.uint64(52), wp.float64)


@wp.func
def evaluate_quadratic(q: wp.vec3d, a: wp.float64, b: wp.float64) -> wp.float64:
    """Returns the value of a quadratic at t = a / (a + b), times (a + b)^2."""
    return (q[0] * b + TWO * q[1] * a) * b + q[2] * a * a


@wp.func
def evaluate_cubic(k: wp.vec4d, a: wp.float64, b: wp.float64) -> wp.float64:
    """Returns the value of a cubic at t = a / (a + b), times (a + b)^3."""
    return ((k[0] * b + THREE * k[1] * a) * b + THREE * k[2] * a * a) * b + k[3] * a * a * a


@wp.func
def scaled_weights(a: wp.float64, b: wp.float64):
    """Returns weights of the same parameter whose larger one is in [1, 2), so that no power underflows."""
    scale = inverse_power_of_two(wp.max(a, b))
    return scale * a, scale * b


@wp.func
def split_quadratic(q: wp.vec3d, a: wp.float64, b: wp.float64):
    """Returns both parts of a quadratic split at t = a / (a + b), times (a + b)^2 (de Casteljau)."""
    sum = a + b
    q01 = b * q[0] + a * q[1]
    q12 = b * q[1] + a * q[2]
    middle = b * q01 + a * q12
    return wp.vec3d(sum * sum * q[0], sum * q01, middle), wp.vec3d(middle, sum * q12, sum * sum * q[2])


@wp.func
def split_cubic(k: wp.vec4d, a: wp.float64, b: wp.float64):
    """Returns both parts of a cubic split at t = a / (a + b), times (a + b)^3 (de Casteljau)."""
    sum = a + b
    k01 = b * k[0] + a * k[1]
    k12 = b * k[1] + a * k[2]
    k23 = b * k[2] + a * k[3]
    k012 = b * k01 + a * k12
    k123 = b * k12 + a * k23
    middle = b * k012 + a * k123
    square = sum * sum
    return (
        wp.vec4d(square * sum * k[0], square * k01, sum * k012, middle),
        wp.vec4d(middle, sum * k123, square * k23, square * sum * k[3]),
    )


@wp.func
def mix(a: wp.float64, b: wp.float64, t: wp.float64) -> wp.float64:
    """Returns (1 - t) a + t b.

    For t in [0, 1] the rounding error is at most 3 roundoff max(|a|, |b|).
    """
    return (wp.float64(1.0) - t) * a + t * b


@wp.func
def restrict_quadratic(q: wp.vec3d, start: wp.float64, end: wp.float64) -> wp.vec3d:
    """Returns the Bernstein coefficients of a quadratic on [start, end], a part of [0, 1]: its blossom at the ends."""
    s01 = mix(q[0], q[1], start)
    s12 = mix(q[1], q[2], start)
    e01 = mix(q[0], q[1], end)
    e12 = mix(q[1], q[2], end)
    return wp.vec3d(mix(s01, s12, start), mix(s01, s12, end), mix(e01, e12, end))


@wp.func
def restrict_cubic(k: wp.vec4d, start: wp.float64, end: wp.float64) -> wp.vec4d:
    """Returns the Bernstein coefficients of a cubic on [start, end], a part of [0, 1]: its blossom at the ends."""
    at_start = wp.vec3d(mix(k[0], k[1], start), mix(k[1], k[2], start), mix(k[2], k[3], start))
    at_end = wp.vec3d(mix(k[0], k[1], end), mix(k[1], k[2], end), mix(k[2], k[3], end))
    from_start = restrict_quadratic(at_start, start, end)
    from_end = restrict_quadratic(at_end, start, end)
    return wp.vec4d(from_start[0], from_start[1], from_start[2], from_end[2])


@wp.func
def divide_cubic(k: wp.vec4d, q: wp.vec3d):
    """Divides a cubic Y by a quadratic q: D^2 Y = L q + K, with D = q0 - 2 q1 + q2 (Eq. 15).

    This is the paper's decomposition with its determinant D^2 multiplied out. With the first differences d of q and the
    second differences e of Y, the solution of its 2 x 2 system is L_i = 3 e_i D - 2 d_i (e_1 - e_0).

    Returns:
        The linear polynomials L and K.
    """
    d0 = q[1] - q[0]
    d1 = q[2] - q[1]
    e0 = (k[2] - k[1]) - (k[1] - k[0])
    e1 = (k[3] - k[2]) - (k[2] - k[1])
    leading_q = d1 - d0
    leading_k = e1 - e0
    l0 = THREE * e0 * leading_q - TWO * d0 * leading_k
    l1 = THREE * e1 * leading_q - TWO * d1 * leading_k
    square = leading_q * leading_q
    return wp.vec2d(l0, l1), wp.vec2d(square * k[0] - l0 * q[0], square * k[3] - l1 * q[2])
