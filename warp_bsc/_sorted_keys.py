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


class KeySet:
    """A set of integers of at least 0: a table that has for each hash one key, and the others, ascending."""

    def __init__(self, keys: np.ndarray):
        """Makes it of keys, some of which may be equal."""
        self._bits = (2 * len(keys) + 1).bit_length()
        places = self._places(keys)
        self._table = np.full(1 << self._bits, -1)
        self._table[places] = keys
        self._others = distinct(keys[self._table[places] != keys])

    def has(self, values: np.ndarray) -> np.ndarray:
        """Returns which values are in it, as :func:`numpy.isin` does, which sorts."""
        keys = self._table[self._places(values)]
        found = keys == values
        rest = np.flatnonzero(~found & (keys >= 0))
        found[rest] = np.isin(values[rest], self._others)
        return found

    def _places(self, keys: np.ndarray) -> np.ndarray:
        hashes = keys.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
        return (hashes >> np.uint64(64 - self._bits)).view(np.int64)


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
