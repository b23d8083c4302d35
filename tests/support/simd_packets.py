"""Which queries SIMD packets decide, and leave none to the functions for one query."""

import numpy as np


def in_normal_range(points):
    """Whether a packet can use queries: their size is in range, and no number is subnormal in single precision."""
    x = np.abs(points.astype(np.float64))
    subnormal = (x > 0.0) & (x < np.finfo(np.float32).smallest_normal) & (points.dtype == np.float32)
    return ~subnormal.any(axis=(1, 2)) & (x.max(axis=(1, 2)) < 2.0**500) & (np.ptp(points, axis=1).max(axis=1) > 2e-144)
