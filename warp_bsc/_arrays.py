"""Checks the arrays that users pass in."""

import numpy as np
from numpy.typing import ArrayLike

__all__ = ["check_finite", "checked_coordinates", "checked_shape"]


def checked_shape(array: ArrayLike, shape: tuple[int, ...], name: str) -> np.ndarray:
    """Returns an array of coordinates unchanged, as NumPy, finite or not.

    Args:
        array: Coordinates, float32 or float64, first dimension n, then ``shape``.
        shape: All dimensions except the first.
        name: Name of the array in errors.

    Returns:
        NumPy array.

    Raises:
        ValueError: If the shape or the type is wrong.
    """
    array = np.asarray(array)
    if array.dtype not in (np.float32, np.float64):
        raise ValueError(f"{name} must be float32 or float64, got {array.dtype}")
    if array.shape[1:] != shape:
        raise ValueError(f"{name} must have shape (n, {', '.join(map(str, shape))}), got {array.shape}")
    return array


def check_finite(array: np.ndarray, name: str, rows: np.ndarray | None = None) -> None:
    """Raises a ValueError that names the first row that is not finite, of an array or of some of its rows."""
    if np.isfinite(array).all():  # copying rows takes a hundred times as long
        return
    finite = np.isfinite(array if rows is None else array[rows]).all(axis=tuple(range(1, array.ndim)))
    if not finite.all():
        row = np.argmin(finite)
        raise ValueError(f"{name}[{row if rows is None else rows[row]}] has a coordinate that is not finite")


def checked_coordinates(array: ArrayLike, shape: tuple[int, ...], name: str) -> np.ndarray:
    """Returns an array of coordinates unchanged, as NumPy, with arguments and errors of :func:`checked_shape`.

    Raises:
        ValueError: If the shape or the type is wrong, or a coordinate is not finite.
    """
    array = checked_shape(array, shape, name)
    check_finite(array, name)
    return array
