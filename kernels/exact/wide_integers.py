"""Wide integers: vectors of 64-bit limbs, the lowest first, in two's complement.

Sums and products wrap around at the width of their type, as those of built-in integers do, so that a result is exact
if it fits, whether or not intermediate results do. Callers prove that it fits.

Nearly all arithmetic of exact predicates is a two by two determinant, :func:`minor`, of numbers of some width, with a
result twice as wide, or as wide as the wider factors.
"""

import warp as wp

LIMBS = (1, 2, 4, 8, 16, 32, 64)
"""Available widths, in limbs, each twice the one before."""


def integer(limbs: int) -> type:
    """Returns the type of integers of ``limbs`` 64-bit limbs."""
    return wp.types.vector(length=limbs, dtype=wp.uint64)


# p = x y for signed x, y: each taken as unsigned, then corrected, because a number below zero stands for itself plus
# 2^(64 limbs), which has added the other factor that much higher
_MULTIPLY = """
    const auto multiply = [](const auto& x, const auto& y, wp::uint64* p) {
        constexpr int A = sizeof(x) / 8, B = sizeof(y) / 8, R = sizeof(ret_type) / 8;
        for (int i = 0; i < R; ++i)
            p[i] = 0;
#if !defined(__CUDA_ARCH__)
        if constexpr (A * B >= 64) {
            // only the limbs that are not zero, of absolute values: most numbers are much narrower than their type
            struct Limbs { wp::uint64 of[A > B ? A : B]; int low, high; };
            const auto magnitude = [](const auto& a, Limbs& to) -> wp::uint64 {
                constexpr int N = sizeof(a) / 8;
                const wp::uint64 mask = 0 - (a[N - 1] >> 63);
                wp::uint64 carry = mask & 1;
                to.low = N, to.high = 0;
                for (int i = 0; i < N; ++i) {
                    to.of[i] = (a[i] ^ mask) + carry;
                    carry &= to.of[i] == 0;
                    if (to.of[i] != 0) {
                        to.low = to.low < i ? to.low : i;
                        to.high = i + 1;
                    }
                }
                return mask;
            };
            Limbs a, b;
            const wp::uint64 negative = magnitude(x, a) ^ magnitude(y, b);
            if (a.high == 0 || b.high == 0)
                return;
            for (int i = a.low; i < a.high; ++i) {
                unsigned __int128 sum = 0;
                int j = b.low;
                for (; j < b.high && i + j < R; ++j) {
                    sum = (unsigned __int128)a.of[i] * b.of[j] + p[i + j] + (wp::uint64)(sum >> 64);
                    p[i + j] = (wp::uint64)sum;
                }
                if (i + j < R)
                    p[i + j] = (wp::uint64)(sum >> 64);
            }
            if (negative) {
                wp::uint64 carry = 1;
                for (int i = 0; i < R; ++i) {
                    p[i] = ~p[i] + carry;
                    carry &= p[i] == 0;
                }
            }
            return;
        }
#endif
        // small ones without loops: an index that varies would put them into local memory on a GPU
        constexpr bool small = A * B <= 64;
#pragma unroll(small ? A : 1)
        for (int i = 0; i < A; ++i) {
            wp::uint64 carry = 0;
#pragma unroll(small ? B : 1)
            for (int j = 0; j < B; ++j) {
                if (i + j >= R)
                    break;
#if defined(__CUDA_ARCH__)
                wp::uint64 low = x[i] * y[j];
                wp::uint64 high = __umul64hi(x[i], y[j]);
                low += carry;
                high += low < carry;
                low += p[i + j];
                high += low < p[i + j];
                p[i + j] = low;
                carry = high;
#else
                const unsigned __int128 sum = (unsigned __int128)x[i] * y[j] + p[i + j] + carry;
                p[i + j] = (wp::uint64)sum;
                carry = (wp::uint64)(sum >> 64);
#endif
            }
            if (i + B < R)
                p[i + B] = carry;
        }
        const wp::uint64 x_mask = 0 - (x[A - 1] >> 63), y_mask = 0 - (y[B - 1] >> 63);
        wp::uint64 x_borrow = 0, y_borrow = 0;
        for (int i = A; i < R && i < A + B; ++i) {
            const wp::uint64 s = y[i - A] & x_mask, old = p[i];
            p[i] = old - s - x_borrow;
            x_borrow = (old < s) | ((old == s) & x_borrow);
        }
        for (int i = B; i < R && i < A + B; ++i) {
            const wp::uint64 s = x[i - B] & y_mask, old = p[i];
            p[i] = old - s - y_borrow;
            y_borrow = (old < s) | ((old == s) & y_borrow);
        }
    };
"""

_PRODUCT = f"""{_MULTIPLY}
    wp::uint64 p[sizeof(ret_type) / 8];
    multiply(a, b, p);
    ret_type r;
    for (int i = 0; i < (int)(sizeof(r) / 8); ++i)
        r[i] = p[i];
    return r;
"""

_MINOR = f"""{_MULTIPLY}
    constexpr int R = sizeof(ret_type) / 8;
    wp::uint64 p[R], q[R];
    multiply(a, b, p);
    multiply(c, d, q);
    ret_type r;
    wp::uint64 borrow = 0;
    for (int i = 0; i < R; ++i) {{
        r[i] = p[i] - q[i] - borrow;
        borrow = (p[i] < q[i]) | ((p[i] == q[i]) & borrow);
    }}
    return r;
"""

_SIGN = """
    constexpr int A = sizeof(a) / 8;
    if (a[A - 1] >> 63)
        return -1;
    wp::uint64 any = 0;
    for (int i = 0; i < A; ++i)
        any |= a[i];
    return any != 0;
"""

_ADD = """
    ret_type r;
    wp::uint64 carry = 0;
    for (int i = 0; i < (int)(sizeof(r) / 8); ++i) {
        const wp::uint64 partial = a[i] + carry;
        r[i] = partial + b[i];
        carry = (partial < carry) | (r[i] < partial);
    }
    return r;
"""

_SUBTRACT = """
    ret_type r;
    wp::uint64 borrow = 0;
    for (int i = 0; i < (int)(sizeof(r) / 8); ++i) {
        r[i] = a[i] - b[i] - borrow;
        borrow = (a[i] < b[i]) | ((a[i] == b[i]) & borrow);
    }
    return r;
"""

_WIDEN = """
    ret_type r;
    constexpr int A = sizeof(a) / 8;
    const wp::uint64 extension = 0 - (a[A - 1] >> 63);
    for (int i = 0; i < (int)(sizeof(r) / 8); ++i)
        r[i] = i < A ? a[i] : extension;
    return r;
"""

_TIMES = """
    ret_type r;
    wp::uint64 carry = 0;
    for (int i = 0; i < (int)(sizeof(r) / 8); ++i) {
#if defined(__CUDA_ARCH__)
        const wp::uint64 low = a[i] * factor + carry;
        carry = __umul64hi(a[i], factor) + (low < carry);
        r[i] = low;
#else
        const unsigned __int128 sum = (unsigned __int128)a[i] * factor + carry;
        r[i] = (wp::uint64)sum;
        carry = (wp::uint64)(sum >> 64);
#endif
    }
    return r;
"""

_SHIFT = """
    ret_type r;
    const int limbs = bits >> 6, rest = bits & 63;
    for (int i = (int)(sizeof(r) / 8) - 1; i >= 0; --i) {
        const int source = i - limbs;
        wp::uint64 limb = source >= 0 ? a[source] << rest : 0;
        if (rest > 0 && source > 0)
            limb |= a[source - 1] >> (64 - rest);
        r[i] = limb;
    }
    return r;
"""


SCALED = """
    const auto scaled = [](wp::float64 value, int exponent, auto& x) {
        constexpr int L = sizeof(x) / 8;
        union { wp::float64 value; wp::uint64 bits; } word;
        word.value = value;
        const int field = (int)((word.bits >> 52) & 2047);
        wp::uint64 mantissa = word.bits & ((1ull << 52) - 1);
        if (field > 0)
            mantissa |= 1ull << 52;
#if !defined(__CUDA_ARCH__)
        if constexpr (L == 1) {
            if (field > 0 && exponent > -1023 && exponent < 1023 && field - 1023 - exponent < 62) {
                word.bits = (wp::uint64)(1023 - exponent) << 52;
                x[0] = (wp::uint64)(long long)(value * word.value);
                return;
            }
        }
#endif
        int shift = (field > 0 ? field : 1) - 1075 - exponent;
        if (shift < 0) {
            mantissa = shift > -64 ? mantissa >> -shift : 0;
            shift = 0;
        }
        const wp::uint64 mask = 0 - (word.bits >> 63);
        wp::uint64 carry = word.bits >> 63;
        for (int i = 0; i < L; ++i) {
            const int from = 64 * i - shift;  // bit of the mantissa that is the lowest of this limb
            wp::uint64 limb = 0;
            if (from > -64 && from <= 0)
                limb = mantissa << -from;
            else if (from > 0 && from < 64)
                limb = mantissa >> from;
            x[i] = (limb ^ mask) + carry;
            carry &= x[i] == 0;
        }
    };
    const auto difference = [](const auto& x, const auto& y, auto& d) {
        wp::uint64 borrow = 0;
        for (int i = 0; i < (int)(sizeof(x) / 8); ++i) {
            d[i] = x[i] - y[i] - borrow;
            borrow = (x[i] < y[i]) | ((x[i] == y[i]) & borrow);
        }
    };
"""
"""For native functions: arrays of limbs of finite numbers divided by a power of two that divides them, and of
differences, modulo 2 to the width."""

_SCALED_LIKE = f"""{SCALED}
    ret_type r;
    scaled(x, exponent, r);
    return r;
"""


def _returning(snippet: str, limbs: int) -> str:
    """Returns a snippet preceded by the definition of its return type."""
    return f"    using ret_type = wp::vec_t<{limbs}, wp::uint64>;{snippet}"


for _limbs in LIMBS:
    _Single = integer(_limbs)
    _Double = integer(2 * _limbs)

    @wp.func_native(snippet=_SIGN)
    def sign(a: _Single) -> int:
        """Returns the sign of an integer: -1, 0 or 1."""
        ...

    @wp.func_native(snippet=_returning(_ADD, _limbs))
    def add(a: _Single, b: _Single) -> _Single:
        """Returns the sum a + b."""
        ...

    @wp.func_native(snippet=_returning(_SUBTRACT, _limbs))
    def subtract(a: _Single, b: _Single) -> _Single:
        """Returns the difference a - b."""
        ...

    @wp.func_native(snippet=_returning(_TIMES, _limbs))
    def times(a: _Single, factor: wp.uint64) -> _Single:
        """Returns the product of an integer and a factor that is not negative."""
        ...

    @wp.func_native(snippet=_returning(_SHIFT, _limbs))
    def shift(a: _Single, bits: int) -> _Single:
        """Returns the integer times 2^bits."""
        ...

    @wp.func_native(snippet=_returning(_SCALED_LIKE, _limbs))
    def scaled_like(a: _Single, x: wp.float64, exponent: int) -> _Single:
        """Returns a finite number divided by a power of two that divides it, as wide as an integer."""
        ...

    if _limbs < LIMBS[-1]:

        @wp.func_native(snippet=_returning(_WIDEN, 2 * _limbs))
        def widen(a: _Single) -> _Double:
            """Returns the same integer, twice as wide."""
            ...

        @wp.func_native(snippet=_returning(_PRODUCT, 2 * _limbs))
        def product(a: _Single, b: _Single) -> _Double:
            """Returns the product a b, twice as wide as its factors."""
            ...

        @wp.func_native(snippet=_returning(_PRODUCT, 2 * _limbs))
        def product(a: _Double, b: _Single) -> _Double:  # noqa: F811 (an overload)
            """Returns the product a b, as wide as its wider factor."""
            ...

        @wp.func_native(snippet=_returning(_MINOR, 2 * _limbs))
        def minor(a: _Single, b: _Single, c: _Single, d: _Single) -> _Double:
            """Returns the determinant a b - c d, twice as wide as its factors."""
            ...

        @wp.func_native(snippet=_returning(_MINOR, 2 * _limbs))
        def minor(a: _Double, b: _Single, c: _Double, d: _Single) -> _Double:  # noqa: F811 (an overload)
            """Returns the determinant a b - c d, as wide as its wider factors."""
            ...


@wp.func_native(
    snippet="""
    union { wp::float64 value; wp::uint64 bits; } word;
    word.value = x;
    const int field = (int)((word.bits >> 52) & 2047);
    wp::uint64 mantissa = word.bits & ((1ull << 52) - 1);
    if (field > 0)
        mantissa |= 1ull << 52;
    if (mantissa == 0)
        return 4096;
#if defined(__CUDA_ARCH__)
    const int zeros = __ffsll((long long)mantissa) - 1;
#else
    const int zeros = __builtin_ctzll(mantissa);
#endif
    return (field > 0 ? field : 1) - 1075 + zeros;
"""
)
def lowest_bit(x: wp.float64) -> int:
    """Returns the exponent of the lowest set bit of a finite number: 2^e is its largest divisor; 4096 for 0."""
    ...


@wp.func_native(
    snippet="""
    union { wp::float64 value; wp::uint64 bits; } a, b, d;
    a.value = x;
    b.value = y;
    if (a.bits == b.bits)
        return -4096;
    d.value = x - y;
    int field = (int)((d.bits >> 52) & 2047);
    if (field > 53)
        return field == 2047 ? 8192 : field - 1022;
    // so small that a subnormal part may have been flushed to zero
    const int x_field = (int)((a.bits >> 52) & 2047), y_field = (int)((b.bits >> 52) & 2047);
    field = x_field > y_field ? x_field : y_field;
    return field - 1021;
"""
)
def top_bit_of_difference(x: wp.float64, y: wp.float64) -> int:
    """Returns an e with |x - y| < 2^e for finite numbers, the smallest unless it is tiny; 8192 if they are too large.

    It is -4096 if the numbers are the same. Rounding takes a difference below 2^e at most to 2^e itself, which counts
    as below 2^(e + 1). Where subnormal numbers are flushed, one number of a difference of 2^-969 or more may become 0,
    which is less than the lowest bit of the other.
    """
    ...
