"""Checks of the arrays that users pass in."""

import numpy as np

__all__ = ["check_finite", "checked_coordinates", "checked_shape"]


def checked_shape(array, shape, name):
    """Returns an array of coordinates unchanged, as NumPy, finite or not.

    Args:
        array: Coordinates, float32 or float64, first dimension n, then ``shape``.
        shape: All dimensions but the first.
        name: What to call the array in errors.

    Returns:
        NumPy array.

    Raises:
        ValueError: If the shape or the type is another one.
    """
    array = np.asarray(array)
    if array.dtype not in (np.float32, np.float64):
        raise ValueError(f"{name} must be float32 or float64, got {array.dtype}")
    if array.shape[1:] != shape:
        raise ValueError(f"{name} must have shape (n, {', '.join(map(str, shape))}), got {array.shape}")
    return array


def check_finite(array, name, rows=None):
    """Raises a ValueError that names the first row of an array, or of some of its rows, that is not finite."""
    finite = np.isfinite(array if rows is None else array[rows]).all(axis=tuple(range(1, array.ndim)))
    if not finite.all():
        row = np.argmin(finite)
        raise ValueError(f"{name}[{row if rows is None else rows[row]}] has a coordinate that is not finite")


def checked_coordinates(array, shape, name):
    """Returns an array of coordinates unchanged, as NumPy, with arguments and errors of :func:`checked_shape`.

    Raises:
        ValueError: If the shape or the type is another one, or a coordinate is not finite.
    """
    array = checked_shape(array, shape, name)
    check_finite(array, name)
    return array
