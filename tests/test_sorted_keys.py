"""Distinct and sought integers are those of NumPy, for few values and many."""

import numpy as np
import pytest

from warp_bsc._sorted_keys import KeySet, distinct, expand_ranges, search, search_ranges


@pytest.mark.parametrize("count", [0, 1, 2, 50, 5000])
@pytest.mark.parametrize("largest", [0, 7, 2**62])
def test_results_are_those_of_numpy(count, largest):
    rng = np.random.default_rng(count)
    values = rng.integers(0, largest, count, endpoint=True)
    keys = np.sort(np.concatenate([values[::2], rng.integers(0, largest, 300, endpoint=True)]))
    given = values.copy()
    np.testing.assert_array_equal(distinct(values), np.unique(values))
    np.testing.assert_array_equal(search(keys, values), np.searchsorted(keys, values))
    first, last = search_ranges(keys, values)
    np.testing.assert_array_equal(first, np.searchsorted(keys, values))
    np.testing.assert_array_equal(last, np.searchsorted(keys, values, side="right"))
    np.testing.assert_array_equal(KeySet(keys).has(values), np.isin(values, keys))
    np.testing.assert_array_equal(values, given)


def test_values_of_any_shape_are_made_distinct():
    values = np.array([[[3, 1], [2, 3]], [[1, 1], [9, -4]]])
    assert distinct(values).tolist() == [-4, 1, 2, 3, 9]
    assert search(np.zeros(0, dtype=np.int64), np.arange(2000)).tolist() == [0] * 2000
    assert not KeySet(np.zeros(0, dtype=np.int64)).has(values.reshape(-1)[:5]).any()


def test_ranges_are_expanded_one_after_the_other():
    rows, indices = expand_ranges(np.array([3, 7, 0]), np.array([5, 7, 3]))
    assert rows.tolist() == [0, 0, 2, 2, 2]
    assert indices.tolist() == [3, 4, 0, 1, 2]
