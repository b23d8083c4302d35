"""Coordinates as integers and as numbers of at most 1, each query scaled by a power of two."""

import numpy as np


def corners_of(points, pairs):
    """Returns the corners of the queries' polygons around the origin: shape (n, ..., corners, 2 ends, 3)."""
    points = points.reshape(len(points), 2, points.shape[1] // 2, 3)
    return np.moveaxis(points[:, :, pairs[..., 0]] - points[:, :, pairs[..., 1]], 1, -2)


def decompose(points):
    """Returns integers m, e with points = m 2^e, from their bits: a processor may take subnormal numbers for zero."""
    stored = np.finfo(points.dtype).nmant
    bits = np.ascontiguousarray(points).view(f"i{points.itemsize}").astype(np.int64)
    field = (bits >> stored) & (2 ** (8 * points.itemsize - 1 - stored) - 1)
    mantissa = (bits & (2**stored - 1)) | (np.minimum(field, 1) << stored)
    return np.where(bits < 0, -mantissa, mantissa), np.maximum(field, 1) + (np.finfo(points.dtype).minexp - 1 - stored)


def flattened(points):
    """Returns the coordinates of each query in one row, shape (n, m), from those of its points, shape (n, k, 3)."""
    return points.reshape(len(points), 3 * points.shape[1])


def decompose_with_distance(points, distance):
    """Returns the integers of :func:`decompose` for the coordinates of each query and its distance, the last column."""
    parts = zip(decompose(flattened(points)), decompose(distance[:, None]), strict=True)
    return tuple(np.concatenate(part, axis=1) for part in parts)


def as_integers(points):
    """Returns each query times a power of two that makes its coordinates integers: an object array of these."""
    mantissa, exponent = decompose(flattened(points))
    return scale_to_integers(mantissa, exponent).reshape(points.shape)


def scale_to_integers(mantissa, exponent):
    """Returns mantissa 2^exponent, each row times a power of two that makes it integers: an object array."""
    zeros = np.where(mantissa == 0, 0, np.frexp((mantissa & -mantissa).astype(np.float64))[1] - 1)
    mantissa = mantissa >> zeros  # Trailing zeros go to the exponent, which keeps the integers of coarse data small.
    exponent = exponent + zeros
    lowest = np.where(mantissa == 0, np.iinfo(exponent.dtype).max, exponent).min(axis=1, keepdims=True)
    shift = np.where(mantissa == 0, 0, exponent - lowest)
    return mantissa.astype(object) << shift.astype(object)


def scale_to_floats(mantissa, exponent):
    """Returns mantissa 2^exponent, each row times a power of two that makes its largest number at most 1."""
    share, power = np.frexp(mantissa.astype(np.float64))
    power = np.where(share == 0.0, -4096, power + exponent)
    return np.ldexp(share, power - power.max(axis=1, keepdims=True, initial=-4096))
