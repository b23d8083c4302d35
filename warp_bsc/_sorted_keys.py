"""Distinct integers, integers sought in sorted arrays, and ranges: if many, many times faster than in NumPy."""

from collections.abc import Iterator

import numpy as np

_FEW = 1000
_CHUNK = 1 << 20  # elements in memory at a time


def distinct(values: np.ndarray) -> np.ndarray:
    """Returns the distinct ones of some integers, ascending, as :func:`numpy.unique` does, which hashes them."""
    values = np.sort(values, axis=None)
    is_first = np.ones(len(values), dtype=bool)
    np.not_equal(values[1:], values[:-1], out=is_first[1:])
    return values[is_first]


def search(keys: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Returns where values would be inserted in ascending keys, before equal ones, as :func:`numpy.searchsorted` does.

    In ascending order, most of the keys that are compared are those of the value before, and in the cache.
    """
    if len(values) < _FEW:
        return np.searchsorted(keys, values)
    order = np.argsort(values)
    places = np.empty(len(values), dtype=np.int64)
    places[order] = np.searchsorted(keys, values[order])
    return places


def search_ranges(keys: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the first of the ascending keys that equals each value, and the one after the last."""
    if len(values) < _FEW:
        return np.searchsorted(keys, values), np.searchsorted(keys, values, side="right")
    order = np.argsort(values)
    ascending = values[order]
    first, last = np.empty((2, len(values)), dtype=np.int64)
    first[order] = np.searchsorted(keys, ascending)
    last[order] = np.searchsorted(keys, ascending, side="right")
    return first, last


def expand_ranges(first: np.ndarray, last: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the elements of some ranges one after the other: the number of the range of each, and the elements."""
    counts = last - first
    rows = np.repeat(np.arange(len(counts)), counts)
    return rows, np.arange(len(rows)) - np.repeat(np.cumsum(counts) - counts - first, counts)


def expand_in_chunks(first: np.ndarray, last: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yields what :func:`expand_ranges` returns, about a chunk at a time, without empty ranges."""
    (ranges,) = np.nonzero(last > first)
    totals = np.cumsum((last - first)[ranges])
    at = 0
    while at < len(ranges):
        before = totals[at - 1] if at else 0
        stop = max(at + 1, int(np.searchsorted(totals, before + _CHUNK, side="right")))
        rows, places = expand_ranges(first[ranges[at:stop]], last[ranges[at:stop]])
        yield ranges[at + rows], places
        at = stop
