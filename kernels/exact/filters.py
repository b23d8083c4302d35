"""Signs of expressions in wide integers by floating point, where it can certify them; on a CPU.

Exact arithmetic takes most of its time for numbers of the highest degree, although few of them are zero or nearly so.
Each function evaluates an expression in double precision, from the leading 64 to 128 bits of its integers, and returns
its sign where that is certain, else "unknown", for exact arithmetic to decide. On a GPU they know no sign, so that its
kernels stay small.

The integers of one polynomial are scaled by a common power of two to absolute values below 1, which changes no sign.
One that is 2^960 times smaller than the largest counts as zero. A number then has an error of at most 2^-52 of itself,
or 2^-832 in all. Every expression here is a polynomial of at most degree 6 in the scaled numbers, in which no value has
more than 28 roundings on its way, counting that of each of its factors: the error is below 2^-47 of the same
expression in absolute values, and 2^-800 covers the rest, also that of products that underflow or are flushed to zero.
"""

import warp as wp

from .wide_integers import LIMBS, integer

UNKNOWN = wp.constant(9)
"""Stands for signs that are not certain."""

_NUMBERS = """
    struct Number { double value, size; };  // and the same expression in absolute values
    const auto plus = [](Number a, Number b) { return Number{a.value + b.value, a.size + b.size}; };
    const auto minus = [](Number a, Number b) { return Number{a.value - b.value, a.size + b.size}; };
    const auto times = [](Number a, Number b) { return Number{a.value * b.value, a.size * b.size}; };
    const auto by = [](double a, Number b) { return Number{a * b.value, a * b.size}; };
    const auto sign = [](Number a) -> int {
        const double error = 0x1p-47 * a.size + 0x1p-800;
        return (a.value > error) - (a.value < -error);
    };
    // writes integers divided by a common power of two
    const auto scale = [](const Integer* const* x, int count, Number* to) {
        constexpr int N = sizeof(Integer) / 8;
        int exponents[4], largest = 0;
        for (int j = 0; j < count; ++j) {
            const Integer& a = *x[j];
            const wp::uint64 mask = 0 - (a[N - 1] >> 63);
            int i = N - 1;
            while (i > 1 && a[i] == mask)
                --i;
            // below the two leading limbs, what is left out and the one that negation adds are less than a rounding
            unsigned __int128 bits = (unsigned __int128)(a[i] ^ mask) << 64 | (a[i - 1] ^ mask);
            if (i == 1)
                bits += mask & 1;
            const double size = (double)(wp::uint64)(bits >> 64) * 0x1p-64 + (double)(wp::uint64)bits * 0x1p-128;
            to[j].value = mask ? -size : size;
            exponents[j] = i;
            largest = i > largest ? i : largest;
        }
        for (int j = 0; j < count; ++j) {
            const int shift = 64 * (exponents[j] - largest);
            union { wp::uint64 bits; double value; } factor;
            factor.bits = shift > -960 ? (wp::uint64)(1023 + shift) << 52 : 0;
            to[j].value *= factor.value;
            to[j].size = to[j].value < 0.0 ? -to[j].value : to[j].value;
        }
    };
"""

_SIGNS_AT_ROOTS = f"""
#if defined(__CUDA_ARCH__)
    return 9;
#else
{_NUMBERS}
    const Integer* of_p[4] = {{&p0, &p1, &p2, &p3}};
    const Integer* of_q[3] = {{&c0, &c1, &leading}};
    Number p[4], q[3];
    scale(of_p, 4, p);
    scale(of_q, 3, q);
    const Number c = q[0], b = q[1], a = q[2];
    const Number g0 = times(a, p[0]);
    const Number g1 = minus(times(a, p[1]), times(p[3], c));
    const Number g2 = minus(times(a, p[2]), times(p[3], b));
    const Number k0 = minus(times(g0, a), times(g2, c)), k1 = minus(times(g1, a), times(g2, b));
    const int s0 = sign(k0), s1 = sign(k1);
    if (s0 == 0 || s1 == 0)
        return 9;
    const auto signs = [](int first, int second) {{ return 3 * first + second; }};
    if (s0 == s1)
        return signs(s1, s1);
    const Number j = minus(times(g0, b), times(g1, c));
    const int inside = sign(minus(times(k0, k0), times(k1, j)));
    if (inside == 0)
        return 9;
    if (roots == 1)
        return signs(-inside * s1, -inside * s1);
    if (inside < 0)
        return signs(-s1, s1);
    const int side = sign(minus(times(b, k1), times(by(2.0, a), k0))) * sign(a) * s1;
    return side == 0 ? 9 : signs(-side * s1, -side * s1);
#endif
"""

_QUADRATIC_DISCRIMINANT = f"""
#if defined(__CUDA_ARCH__)
    return 0;
#else
{_NUMBERS}
    const Integer* of_c[3] = {{&c0, &c1, &c2}};
    Number c[3];
    scale(of_c, 3, c);
    return sign(minus(times(c[1], c[1]), times(by(4.0, c[0]), c[2])));
#endif
"""

_CUBIC_DISCRIMINANT = f"""
#if defined(__CUDA_ARCH__)
    return 0;
#else
{_NUMBERS}
    const Integer* of_c[4] = {{&c0, &c1, &c2, &c3}};
    Number c[4];
    scale(of_c, 4, c);
    const Number h0 = minus(times(c[1], c[1]), times(by(3.0, c[0]), c[2]));
    const Number h1 = minus(times(c[1], c[2]), times(by(9.0, c[0]), c[3]));
    const Number h2 = minus(times(c[2], c[2]), times(by(3.0, c[1]), c[3]));
    return sign(minus(times(by(4.0, h0), h2), times(h1, h1)));
#endif
"""

_SIGN_AT_TIME = f"""
#if defined(__CUDA_ARCH__)
    return 0;
#else
{_NUMBERS}
    const Integer* of_p[4] = {{&p0, &p1, &p2, &p3}};
    Number p[4];
    scale(of_p, 4, p);
    const double whole = (double)(1ull << digits), t = (double)time / whole, s = 1.0 - t;  // all exact
    const Number ends = plus(by(s * s * s, p[0]), by(t * t * t, p[3]));
    return sign(plus(ends, plus(by(s * s * t, p[1]), by(s * t * t, p[2]))));
#endif
"""

for _limbs in LIMBS[1:]:
    _Integer = integer(_limbs)
    _define = f"    typedef wp::vec_t<{_limbs}, wp::uint64> Integer;"

    @wp.func_native(snippet=_define + _SIGNS_AT_ROOTS)
    def near_signs_at_roots(
        p0: _Integer,
        p1: _Integer,
        p2: _Integer,
        p3: _Integer,
        c0: _Integer,
        c1: _Integer,
        leading: _Integer,
        roots: int,
    ) -> int:
        """Returns :func:`.algebraic.signs_at_roots` as 3 times the first sign plus the second, or UNKNOWN."""
        ...

    @wp.func_native(snippet=_define + _QUADRATIC_DISCRIMINANT)
    def near_quadratic_discriminant(c0: _Integer, c1: _Integer, c2: _Integer) -> int:
        """Returns the sign of the discriminant of a quadratic, or 0 if it is not certain."""
        ...

    @wp.func_native(snippet=_define + _CUBIC_DISCRIMINANT)
    def near_cubic_discriminant(c0: _Integer, c1: _Integer, c2: _Integer, c3: _Integer) -> int:
        """Returns the sign of the discriminant of a cubic, or 0 if it is not certain."""
        ...

    @wp.func_native(snippet=_define + _SIGN_AT_TIME)
    def near_sign_at_time(p0: _Integer, p1: _Integer, p2: _Integer, p3: _Integer, time: wp.uint64, digits: int) -> int:
        """Returns the sign of a cubic in z at t = time / 2^digits, of at most 38 digits, or 0 if it is not certain."""
        ...
