"""Arrays for the outputs of kernels, filled with a value that no correct kernel leaves."""

import math

import warp as wp


def filled_with_nan(shape, dtype, device=None, **options):
    """Returns an array of floats that are NaN: an element that the kernel does not write fails every comparison.

    Args:
        shape: Shape of the array.
        dtype: A floating-point type, or a vector or matrix of one.
        device: Device of the array; the default device if None.
        options: Other arguments of ``warp.empty``.
    """
    array = wp.empty(shape, dtype=dtype, device=device, **options)
    array.fill_(math.nan)
    return array
