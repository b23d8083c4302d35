"""Real roots of polynomials with integer coefficients, by Taylor series or else by the theorem of Sturm and Tarski."""

import bisect
import functools
import itertools
import math
from fractions import Fraction

import numpy as np

from .polynomials import differentiate, multiply, sign_at, sign_at_ratio, trim

_HALVINGS = 24
"""Of an interval with a root. In one of this length, a polynomial that is not zero at the root is seldom zero."""


def _signed_remainders(f, g):
    """Returns f, g and their signed remainders, each times some positive number that keeps its coefficients integer."""
    sequence = [f]
    while g:
        sequence.append(g)
        remainder, scale = sequence[-2], abs(g[-1])
        while len(remainder) >= len(g):
            factor = remainder[-1] if g[-1] > 0 else -remainder[-1]
            rest = [scale * a for a in remainder[:-1]]
            for i, a in enumerate(g[:-1], start=len(remainder) - len(g)):
                rest[i] -= factor * a
            remainder = rest
        g = trim(remainder)
        content = math.gcd(*g)
        g = [-a // content for a in g]
    return sequence


def _changes(sequence, time):
    """Counts the changes of sign along a sequence of polynomials at a time, zeros left out."""
    signs = [sign for f in sequence if (sign := sign_at(f, time))]
    return sum(a != b for a, b in itertools.pairwise(signs))


def sign_at_root(q, f, lower, upper):
    """Returns the sign of q at the only root of f between two times that are not roots of f."""
    if sign := _sign_between(q, lower, upper):
        return sign
    sequence = _signed_remainders(f, trim(multiply(differentiate(f), q)) if q else [])
    return _changes(sequence, lower) - _changes(sequence, upper)


def _sign_between(f, lower, upper):
    """Returns the sign that f has everywhere between two times; 0 if its Taylor series at the first does not tell."""
    (start, scale), (end, other) = lower.as_integer_ratio(), upper.as_integer_ratio()
    start, width, scale = start * other, end * scale - start * other, scale * other
    taylor, power = [0], 1
    for a in reversed(f):  # Horner's rule for f((start + s) / scale) scale^degree, a polynomial in s
        taylor = [start * low + high for low, high in zip([*taylor, 0], [0, *taylor], strict=True)]
        taylor[0] += a * power
        power *= scale
    rest = sum(abs(a) * width**i for i, a in enumerate(taylor[1:], start=1))
    return (taylor[0] > rest) - (taylor[0] < -rest)


def inner_part(f):
    """Returns f divided by t and by t - 1 as often as it goes, so that neither 0 nor 1 is a root."""
    while f[0] == 0:
        f = f[1:]
    while sum(f) == 0:
        f = list(itertools.accumulate(reversed(f)))[-2::-1]
    return f


def isolated_roots(f):
    """Yields (lower, upper) around each root of f inside (0, 1), in order, narrow unless a root is of even order.

    These times are no roots of f, which has none at 0 and 1.
    """
    sturm = _signed_remainders(f, differentiate(f))
    intervals = [(0, 1)]
    while intervals:
        lower, upper = intervals.pop()
        roots = _changes(sturm, lower) - _changes(sturm, upper)
        if roots == 1:
            yield _narrowed(f, lower, upper)
        elif roots > 1:
            middle = Fraction(lower + upper, 2)
            while sign_at(f, middle) == 0:
                middle = (lower + middle) / 2
            intervals += [(middle, upper), (lower, middle)]


def _narrowed(f, lower, upper):
    """Returns times closer together around the only root of f between two, unless it is a root of even order."""
    (low, scale), (high, other) = lower.as_integer_ratio(), upper.as_integer_ratio()
    low, high, scale = low * other, high * scale, scale * other
    before = sign_at_ratio(f, low, scale)
    if before == sign_at_ratio(f, high, scale):
        return lower, upper
    for _ in range(_HALVINGS):
        low, middle, high, scale = 4 * low, 2 * (low + high), 4 * high, 4 * scale
        sign = sign_at_ratio(f, middle, scale)
        if sign == 0:
            low, high = (low + middle) // 2, (middle + high) // 2
        elif sign == before:
            low = middle
        else:
            high = middle
    return Fraction(low, scale), Fraction(high, scale)


def doubles_around(f, lower, upper):
    """Returns the doubles around the only root of f between two times: equal when it is one, neighbours otherwise."""
    if f is None:
        return float(lower), float(upper)
    if sign_at(f, lower) != sign_at(f, upper):  # else a root of even order
        side_of = functools.partial(sign_at, f)
    else:
        side_of = functools.partial(_changes, _signed_remainders(f, differentiate(f)))
    before = side_of(lower)

    def double(bits):
        return float(np.int64(bits).view(np.float64))

    def reached(bits):
        time = double(bits)
        if time <= lower or time >= upper:
            return time >= upper
        return sign_at(f, time) == 0 or side_of(time) != before

    # The bits of doubles that are not negative, read as integers, are in the same order.
    low, high = (int(np.float64(time).view(np.int64)) for time in (lower, upper))
    bits = range(max(low - 1, 0), high + 2)
    after = double(bits[bisect.bisect_left(bits, True, key=reached)])
    exact = lower < after < upper and sign_at(f, after) == 0
    return after if exact else float(np.nextafter(after, 0.0)), after
