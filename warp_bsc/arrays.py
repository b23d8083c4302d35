"""Checks of the arrays that users pass in."""

import numpy as np

__all__ = ["checked_coordinates"]


def checked_coordinates(array, shape, name):
    """Returns an array of coordinates unchanged, as NumPy.

    Args:
        array: Coordinates, float32 or float64, first dimension n, then ``shape``.
        shape: All dimensions but the first.
        name: What to call the array in errors.

    Returns:
        NumPy array.

    Raises:
        ValueError: If the shape or the type is another one, or a coordinate is not finite.
    """
    array = np.asarray(array)
    if array.dtype not in (np.float32, np.float64):
        raise ValueError(f"{name} must be float32 or float64, got {array.dtype}")
    if array.shape[1:] != shape:
        raise ValueError(f"{name} must have shape (n, {', '.join(map(str, shape))}), got {array.shape}")
    finite = np.isfinite(array).all(axis=tuple(range(1, array.ndim)))
    if not finite.all():
        raise ValueError(f"{name}[{np.argmin(finite)}] has a coordinate that is not finite")
    return array
