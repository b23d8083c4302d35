"""Signs at roots and doubles around roots, of polynomials whose roots are known fractions of any order."""

import functools
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from warp_bsc.checker.polynomials import multiply, sign_at
from warp_bsc.checker.roots import doubles_around, isolated_roots, sign_at_root

INSIDE = st.fractions(0, 1, max_denominator=1000).filter(lambda root: 0 < root < 1)
NEAR = st.builds(lambda root, k: root + k * Fraction(1, 2**60), INSIDE, st.integers(-3, 3))


def from_roots(roots):
    """The polynomial with these roots, as often as they are listed."""
    return functools.reduce(multiply, ([-root.numerator, root.denominator] for root in roots), [1])


def sign(value):
    return (value > 0) - (value < 0)


@given(st.lists(st.tuples(INSIDE, st.integers(1, 3)), min_size=1, max_size=3), st.lists(NEAR | INSIDE, max_size=2))
def test_signs_at_roots(roots_and_orders, others):
    """Polynomials with roots elsewhere, next to the root and at it, and some polynomial without a root nearby."""
    roots = sorted({root for root, _ in roots_and_orders})
    f = from_roots([root for root, order in roots_and_orders for _ in range(order)])
    intervals = list(isolated_roots(f))
    assert len(intervals) == len(roots)
    for root, (lower, upper) in zip(roots, intervals, strict=True):
        assert lower < root < upper
        assert sign_at(f, lower) and sign_at(f, upper)
        for zeros in (others, [*others, root], [root + Fraction(1, 2**80)], []):
            q = from_roots(zeros)
            assert sign_at_root(q, f, lower, upper) == np.prod([sign(root - zero) for zero in zeros], dtype=int)
        assert sign_at_root([], f, lower, upper) == 0


@given(st.lists(st.tuples(INSIDE, st.integers(1, 3)), min_size=1, max_size=3))
def test_doubles_around_roots(roots_and_orders):
    f = from_roots([root for root, order in roots_and_orders for _ in range(order)])
    for root, interval in zip(sorted({root for root, _ in roots_and_orders}), isolated_roots(f), strict=True):
        before, after = doubles_around(f, *interval)
        assert before <= root <= after
        assert before == after if Fraction(float(root)) == root else np.nextafter(before, 1.0) == after


@pytest.mark.parametrize("order", [1, 2, 3])
@pytest.mark.parametrize("bits", [1, 3, 25, 60])
def test_a_root_that_halving_hits(order, bits):
    root = Fraction(1, 2**bits)
    ((lower, upper),) = isolated_roots(from_roots([root] * order))
    assert lower < root < upper
    assert doubles_around(from_roots([root] * order), lower, upper) == (float(root), float(root))
