"""Wide integers: vectors of 64-bit limbs, the lowest first, in two's complement.

Sums and products wrap around at the width of their type, as those of built-in integers do, so that a result is exact
if it fits, whether or not intermediate results do. Callers prove that it fits.

Nearly all arithmetic of exact predicates is a two by two determinant, :func:`minor`, of numbers of some width, with a
result twice as wide, or as wide as the wider factors.
"""

import warp as wp

from ..native_text import definitions, header

LIMBS = (1, 2, 4, 8, 16, 32, 64)
"""Available widths, in limbs, each twice the one before."""


def integer(limbs: int) -> type:
    """Returns the type of integers of ``limbs`` 64-bit limbs."""
    return wp.types.vector(length=limbs, dtype=wp.uint64)


def limbs_type(limbs: int) -> str:
    """Returns the name in C++ of the type of integers of ``limbs`` 64-bit limbs."""
    return f"wp::vec_t<{limbs}, wp::uint64>"


# p = x y for signed x, y: each taken as unsigned, then corrected, because a number below zero stands for itself plus
# 2^(64 limbs), which has added the other factor that much higher
_MULTIPLY = header(__file__, "multiply.h")

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


SCALED = header(__file__, "scaled.h")
"""For native functions: arrays of limbs of finite numbers divided by a power of two that divides them, and of
differences, modulo 2 to the width."""

_SCALED_LIKE = f"""{SCALED}
    ret_type r;
    scaled(x, exponent, r);
    return r;
"""


def _returning(snippet: str, limbs: int) -> str:
    """Returns a snippet preceded by the definition of its return type."""
    return definitions({"ret_type": limbs_type(limbs)}) + snippet


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
