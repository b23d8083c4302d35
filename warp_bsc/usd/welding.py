"""Finds vertices that have the same position."""

import numpy as np


def first_by_hash(positions: np.ndarray) -> np.ndarray:
    """Returns for each position the first one with the same hash, shape [n]."""
    bits = (positions + positions.dtype.type(0.0)).view(f"u{positions.itemsize}").astype(np.uint64)  # no -0.0
    hashes = np.zeros(len(positions), dtype=np.uint64)
    for column in bits.T:
        hashes = (hashes ^ column) * np.uint64(0x9E3779B97F4A7C15)
        hashes ^= hashes >> np.uint64(29)
    _, firsts, numbers = np.unique(hashes, return_index=True, return_inverse=True)
    return firsts[numbers]


def first_by_position(candidates: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Returns for each vertex the first one that has the same position, among those of one candidate, shape [n].

    Args:
        candidates: The same vertex for all that may have one position: the first of them, shape [n].
        positions: Positions of the vertices, shape [n, 3].
    """
    (rows,) = np.nonzero((positions != positions[candidates]).any(axis=1))
    if len(rows):
        keys = np.column_stack([candidates[rows], positions[rows].astype(np.float64)])
        _, firsts, numbers = np.unique(keys, axis=0, return_index=True, return_inverse=True)
        candidates = candidates.copy()
        candidates[rows] = rows[firsts[numbers.reshape(-1)]]  # NumPy 2.0 returns another shape
    return candidates
