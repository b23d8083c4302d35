"""Meshes that many tests detect on: a flat sheet, and one that passes through itself."""

import numpy as np


def grid(n, dtype=np.float32):
    """A flat sheet of n x n quads of 1 cm: positions and faces."""
    x, y = np.meshgrid(np.arange(n + 1), np.arange(n + 1), indexing="ij")
    positions = 0.01 * np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    corner = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    a, b, c, d = corner, corner + 1, corner + n + 2, corner + n + 1
    return positions.astype(dtype), np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


def crumpled(seed, n=24):
    """A folded sheet whose upper half passes through the lower one: start and end positions, and faces."""
    positions, faces = grid(n, np.float64)
    offset = positions[:, 0] - positions[:, 0].mean()
    upper = offset > 0.0
    start = positions.copy()
    start[:, 0] = -np.abs(offset)
    start[:, 2] = np.where(upper, 0.002 + 0.1 * offset, 0.0)
    end = start + 0.0005 * np.random.default_rng(seed).standard_normal(start.shape)
    end[:, 2] -= np.where(upper, 0.2 * offset, 0.0)
    return start.astype(np.float32), end.astype(np.float32), faces
