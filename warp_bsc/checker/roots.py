"""Real roots of polynomials with integer coefficients, by the theorem of Sturm and Tarski."""

import bisect
import itertools
import math
from fractions import Fraction

import numpy as np

from .polynomials import differentiate, multiply, sign_at, trim

__all__ = ["doubles_around", "inner_part", "isolated_roots", "sign_at_root"]


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
    sequence = _signed_remainders(f, trim(multiply(differentiate(f), q)) if q else [])
    return _changes(sequence, lower) - _changes(sequence, upper)


def inner_part(f):
    """Returns f divided by t and by t - 1 as often as it goes, so that neither 0 nor 1 is a root."""
    while f[0] == 0:
        f = f[1:]
    while sum(f) == 0:
        f = list(itertools.accumulate(reversed(f)))[-2::-1]
    return f


def isolated_roots(f):
    """Yields (lower, upper) around each root of f inside (0, 1), in order; these times are no roots, nor 0 and 1."""
    sturm = _signed_remainders(f, differentiate(f))
    intervals = [(0, 1)]
    while intervals:
        lower, upper = intervals.pop()
        roots = _changes(sturm, lower) - _changes(sturm, upper)
        if roots == 1:
            yield lower, upper
        elif roots > 1:
            middle = Fraction(lower + upper, 2)
            while sign_at(f, middle) == 0:
                middle = (lower + middle) / 2
            intervals += [(middle, upper), (lower, middle)]


def doubles_around(f, lower, upper):
    """Returns the doubles around the only root of f between two times: equal when it is one, neighbours otherwise."""
    if f is None:
        return float(lower), float(upper)
    sturm = _signed_remainders(f, differentiate(f))
    changes = _changes(sturm, lower)

    def double(bits):
        return float(np.int64(bits).view(np.float64))

    def reached(bits):
        time = double(bits)
        if time <= lower or time >= upper:
            return time >= upper
        return sign_at(f, time) == 0 or _changes(sturm, time) != changes

    # The bits of doubles that are not negative, read as integers, are in the same order.
    one = int(np.float64(1.0).view(np.int64))
    after = double(bisect.bisect_left(range(one + 1), True, key=reached))
    exact = lower < after < upper and sign_at(f, after) == 0
    return after if exact else float(np.nextafter(after, 0.0)), after
