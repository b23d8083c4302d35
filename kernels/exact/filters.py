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

from ..native_text import definitions, header
from .wide_integers import LIMBS, integer, limbs_type

UNKNOWN = wp.constant(9)
"""Stands for signs that are not certain."""


def _on_cpu(unknown: int, limbs: int, text: str) -> str:
    """Returns the text of a native function that computes with numbers on a CPU, and returns "unknown" on a GPU."""
    defined = definitions({"Integer": limbs_type(limbs)}, unknown=unknown)
    return f"{defined}#if defined(__CUDA_ARCH__)\nreturn unknown;\n#else\n{header(__file__, 'numbers.h')}{text}#endif\n"


_QUADRATIC_DISCRIMINANT = """
    const Integer* of_c[3] = {&c0, &c1, &c2};
    Number c[3];
    scale(of_c, 3, c);
    return sign(c[1] * c[1] - c[0] * c[2] * 4.0);
"""

_CUBIC_DISCRIMINANT = """
    const Integer* of_c[4] = {&c0, &c1, &c2, &c3};
    Number c[4];
    scale(of_c, 4, c);
    const Number h0 = c[1] * c[1] - c[0] * c[2] * 3.0;
    const Number h1 = c[1] * c[2] - c[0] * c[3] * 9.0;
    const Number h2 = c[2] * c[2] - c[1] * c[3] * 3.0;
    return sign(h0 * h2 * 4.0 - h1 * h1);
"""

_SIGN_AT_TIME = """
    const Integer* of_p[4] = {&p0, &p1, &p2, &p3};
    Number p[4];
    scale(of_p, 4, p);
    const double whole = (double)(1ull << digits), t = (double)time / whole, s = 1.0 - t;  // all exact
    return sign(p[0] * (s * s * s) + p[3] * (t * t * t) + (p[1] * (s * s * t) + p[2] * (s * t * t)));
"""

for _limbs in LIMBS[1:]:
    _Integer = integer(_limbs)

    @wp.func_native(snippet=_on_cpu(UNKNOWN, _limbs, header(__file__, "signs_at_roots.h")))
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

    @wp.func_native(snippet=_on_cpu(0, _limbs, _QUADRATIC_DISCRIMINANT))
    def near_quadratic_discriminant(c0: _Integer, c1: _Integer, c2: _Integer) -> int:
        """Returns the sign of the discriminant of a quadratic, or 0 if it is not certain."""
        ...

    @wp.func_native(snippet=_on_cpu(0, _limbs, _CUBIC_DISCRIMINANT))
    def near_cubic_discriminant(c0: _Integer, c1: _Integer, c2: _Integer, c3: _Integer) -> int:
        """Returns the sign of the discriminant of a cubic, or 0 if it is not certain."""
        ...

    @wp.func_native(snippet=_on_cpu(0, _limbs, _SIGN_AT_TIME))
    def near_sign_at_time(p0: _Integer, p1: _Integer, p2: _Integer, p3: _Integer, time: wp.uint64, digits: int) -> int:
        """Returns the sign of a cubic in z at t = time / 2^digits, of at most 38 digits, or 0 if it is not certain."""
        ...
