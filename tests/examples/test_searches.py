"""The searches of the examples: how fast they find a minimum, and what they do where a gradient is NaN."""

import numpy as np
import pytest
from searches import FittedNewton, QuasiNewton

CURVATURES = np.array([[900.0, 60.0, -6.0], [60.0, 12.0, 1.5], [-6.0, 1.5, 1.0]])
GOAL = np.array([0.3, -0.4, 0.5])
FIRST, LONGEST = 0.5, 1.0


def valley(x):
    """A long valley, and its gradient."""
    off = x - GOAL
    return 0.5 * off @ CURVATURES @ off, CURVATURES @ off


def search(method, start, evaluations, lost=()):
    """Searches the valley, where some evaluations have no gradient; returns the search and the best values."""
    found, values = method(np.array(start), FIRST, LONGEST), []
    for number in range(evaluations):
        value, gradient = valley(found.trial)
        found.take(value, np.full(3, np.nan) if number in lost else gradient)
        values.append(valley(found.x)[0])
        assert np.isfinite(found.trial).all()
        assert np.linalg.norm(found.trial - found.x) < 1.01 * LONGEST
    return found, values


def test_fitted_hessians_find_the_end_of_a_valley():
    assert np.linalg.eigvalsh(CURVATURES).min() > 0.0
    found, values = search(FittedNewton, [-0.5, 0.5, -0.4], 12)
    np.testing.assert_allclose(found.x, GOAL, atol=0.01)
    assert (np.diff(values) <= 0.0).all()
    assert values[-1] < 1e-3 * search(QuasiNewton, [-0.5, 0.5, -0.4], 12)[1][-1]


@pytest.mark.parametrize("method", [FittedNewton, QuasiNewton])
@pytest.mark.parametrize("lost", [{0}, {0, 1, 2}, {1}, {3, 4, 7}])
def test_evaluations_without_a_gradient_end_no_search(method, lost):
    start = [-0.5, 0.5, -0.4]
    found, values = search(method, start, 24, lost)
    assert values[-1] < 0.02 * valley(np.array(start))[0]
    if method is FittedNewton:
        np.testing.assert_allclose(found.x, GOAL, atol=1e-3)


@pytest.mark.parametrize("method", [FittedNewton, QuasiNewton])
def test_trials_without_any_gradient_stay_near_the_start(method):
    found, _ = search(method, GOAL + 0.2, 6, range(6))
    np.testing.assert_array_equal(found.x, GOAL + 0.2)
    assert 0.0 < np.linalg.norm(found.trial - found.x) < LONGEST
