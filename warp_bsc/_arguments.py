"""Checks the arguments that users pass in: numbers, flags, choices, arrays. Errors begin with the argument's name.

A wrong type is a TypeError, a wrong value a ValueError. NumPy's scalars count as Python's; neither a string nor a bool
is a number.
"""

import math
import reprlib
from collections.abc import Iterable, Sequence
from numbers import Integral, Real
from typing import Any, TypeVar

import numpy as np

SMALLEST_DISTANCE = 2.0**-1021
"""Smallest distance or radius that is not 0: half of it is a normal number, which no processor flushes to 0."""

_SMALLEST_BITS = int(np.float64(SMALLEST_DISTANCE).view(np.int64))

_LARGEST_INTEGER = 2**31 - 1

_Choice = TypeVar("_Choice", bound=str)


def given(value: object) -> str:
    """Returns a value in the form in which errors show it."""
    is_array = type(value).__name__ == "array"  # which reprlib takes for one of Python's own
    text = reprlib.aRepr.repr_instance(value, 0) if is_array else reprlib.repr(value)
    return text if isinstance(value, str | Real | None) else f"{type(value).__name__} {text}"


def checked_integer(value: Any, name: str, minimum: int = 0, maximum: int = _LARGEST_INTEGER) -> int:
    """Returns an integer in [minimum, maximum].

    Raises:
        TypeError: If it is no integer.
        ValueError: If it is out of range.
    """
    if not isinstance(value, Integral) or isinstance(value, bool):
        raise TypeError(f"{name} must be an integer, not {given(value)}")
    integer = int(value)
    if not minimum <= integer <= maximum:
        bounds = (
            f"of at least {minimum}, less than 2^31" if maximum == _LARGEST_INTEGER else f"in [{minimum}, {maximum}]"
        )
        raise ValueError(f"{name} must be an integer {bounds}, not {given(value)}")
    return integer


def checked_number(
    value: Any, name: str, minimum: float = -math.inf, maximum: float = math.inf, *, above: bool = False
) -> float:
    """Returns a finite number in [minimum, maximum], in (minimum, maximum] if ``above``.

    Raises:
        TypeError: If it is no number.
        ValueError: If it is out of range or not finite.
    """
    if not isinstance(value, Real) or isinstance(value, bool):
        raise TypeError(f"{name} must be a number, not {given(value)}")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number) or not minimum <= number <= maximum or (above and number == minimum):
        bounds = "finite"
        if math.isfinite(minimum):
            bounds += f" and {'more than' if above else 'at least'} {minimum:g}"
        if math.isfinite(maximum):
            bounds += f" and at most {maximum:g}"
        raise ValueError(f"{name} must be {bounds}, not {given(value)}")
    return number


def checked_flag(value: Any, name: str) -> bool:
    """Returns True or False.

    Raises:
        TypeError: If it is neither.
    """
    if not isinstance(value, bool | np.bool_):
        raise TypeError(f"{name} must be True or False, not {given(value)}")
    return bool(value)


def checked_choice(value: Any, name: str, choices: Sequence[_Choice]) -> _Choice:
    """Returns one of some strings.

    Raises:
        TypeError: If it is no string.
        ValueError: If it is none of these.
    """
    if not isinstance(value, str):
        raise TypeError(f"{name} must be one of {', '.join(choices)}, not {given(value)}")
    for choice in choices:
        if value == choice:
            return choice
    raise ValueError(f"{name} must be one of {', '.join(choices)}, not {given(value)}")


def checked_strings(values: Any, name: str) -> tuple[str, ...]:
    """Returns strings as a tuple.

    Raises:
        TypeError: If they are no sequence of strings; a string alone is none.
    """
    if isinstance(values, str) or not isinstance(values, Iterable):
        raise TypeError(f"{name} must be a tuple of strings, not {given(values)}")
    values = tuple(values)
    for value in values:
        if not isinstance(value, str):
            raise TypeError(f"{name} must be a tuple of strings, not {given(values)}")
    return values


def check_instance(value: Any, name: str, types: type | tuple[type, ...], what: str) -> None:
    """Raises a TypeError if a value is no instance of a type, which ``what`` describes: "a CollisionMesh"."""
    if not isinstance(value, types):
        raise TypeError(f"{name} must be {what}, not {given(value)}")


def as_numpy(array: Any, name: str, what: str = "an array of numbers") -> np.ndarray:
    """Returns an array of numbers, or ``what`` errors call it, as NumPy, in this machine's order of bytes.

    A Warp array may be on any device.

    Raises:
        TypeError: If its entries are no numbers.
        ValueError: If its rows have different lengths, or entries are masked.
    """
    if hasattr(array, "__cuda_array_interface__") and hasattr(array, "numpy"):  # on a GPU, which NumPy cannot read
        array = array.numpy()
    if np.ma.is_masked(array):
        raise ValueError(f"{name} must have no masked entries, which have no value")
    try:
        values = np.asarray(array)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} must be an array with rows of the same length: {error}") from None
    if values.dtype.kind not in "biufc":
        raise TypeError(f"{name} must be {what}, not {given(array)}")
    return values if values.dtype.isnative else values.astype(values.dtype.newbyteorder("="))


def checked_shape(array: Any, shape: tuple[int, ...], name: str) -> np.ndarray:
    """Returns an array of coordinates, as NumPy, finite or not.

    Args:
        array: Coordinates, float32 or float64, first dimension n, then ``shape``; in lists also integers of at most
            2^53, which are no type that somebody chose.
        shape: All dimensions except the first.
        name: Name of the array in errors.

    Returns:
        NumPy array, float64 for lists.

    Raises:
        TypeError: If its entries are no numbers.
        ValueError: If the shape or the type is wrong, entries are masked, or an integer is larger.
    """
    is_list = isinstance(array, list | tuple)
    array = as_numpy(array, name)
    if array.dtype.kind in "iu" and is_list:
        if array.size and max(int(array.max()), -int(array.min())) > 2**53:
            raise ValueError(f"{name} must have integers of at most 2^53, which are exact in float64")
        array = array.astype(np.float64)
    if array.dtype not in (np.float32, np.float64):
        raise ValueError(f"{name} must be float32 or float64, got {array.dtype}")
    if array.ndim == 0 or array.shape[1:] != shape:
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


def checked_coordinates(array: Any, shape: tuple[int, ...], name: str) -> np.ndarray:
    """Returns an array of coordinates, as NumPy, with arguments and errors of :func:`checked_shape`.

    Raises:
        ValueError: Also if a coordinate is not finite.
    """
    array = checked_shape(array, shape, name)
    check_finite(array, name)
    return array


def checked_distances(distances: Any, name: str, count: int) -> np.ndarray:
    """Returns distances or radii, one or many, in double precision.

    Bits are compared, because processors that flush subnormal numbers to zero also do so in comparisons.

    Args:
        distances: One number, or an array of shape (count,).
        name: Name of the argument in errors.
        count: Number of distances.

    Raises:
        TypeError: If they are no numbers.
        ValueError: If they have another shape, are masked, negative or not finite, or are less than
            :data:`SMALLEST_DISTANCE` and not 0.
    """
    what = "one number or an array of numbers"
    values = as_numpy(distances, name, what)
    if values.dtype.kind not in "iuf":
        raise TypeError(f"{name} must be {what}, not {given(distances)}")
    if values.shape not in ((), (count,)):
        raise ValueError(f"{name} must be one number or have shape ({count},), not {values.shape}")
    converted = np.ascontiguousarray(_as_double(values)).reshape(values.shape)
    bits = converted.view(np.int64)
    is_zero = bits << 1 == 0
    if values.dtype.itemsize > 8:  # of numbers that are longer than doubles, some become 0
        is_zero &= values == 0
    bad = ~(np.isfinite(converted) & (is_zero | (bits >= _SMALLEST_BITS)))
    if bad.any():
        which = np.flatnonzero(bad)[0]
        where = f"{name}[{which}]" if values.ndim else name
        raise ValueError(
            f"{where} must be finite and at least 0, and at least 2^-1021 if not 0, not {values.reshape(-1)[which]}"
        )
    return converted


def checked_distance(distance: Any, name: str, *, zero: bool = True) -> float:
    """Returns one distance in double precision, more than 0 unless ``zero``; errors as :func:`checked_distances`."""
    if not isinstance(distance, Real) or isinstance(distance, bool):
        raise TypeError(f"{name} must be a number, not {given(distance)}")
    checked = checked_distances(distance, name, 0)
    if not zero and checked == 0.0:
        raise ValueError(f"{name} must be more than 0, not {given(distance)}")
    return float(checked)


def checked_integers(integers: Any, name: str, count: int, end: int) -> np.ndarray:
    """Returns an integer for each of some things, int32, shape (count,).

    Args:
        integers: Integers in [0, end); one, or an array of shape (count,).
        name: Name of the argument in errors.
        count: Number of things.
        end: The first integer that is too large.

    Raises:
        TypeError: If they are no integers.
        ValueError: If they have another shape, are masked, or are out of range.
    """
    return _checked_integers(integers, name, count, 0, end, f"in [0, {end})").astype(np.int32)


def checked_bits(bits: Any, name: str, count: int) -> np.ndarray:
    """Returns 32 bits for each of some things, uint32, shape (count,), with errors as of :func:`checked_integers`.

    They are integers in [0, 2^32), or -1 for all bits; one, or an array of shape (count,).
    """
    return _checked_integers(bits, name, count, -1, 2**32, "in [0, 2^32), or -1 for all bits").astype(np.uint32)


def _checked_integers(integers, name, count, first, end, range_):
    """Returns integers in [first, end) for each of some things, which errors describe as a range."""
    what = "one integer or an array of integers"
    values = as_numpy(integers, name, what)
    if values.dtype.kind not in "iu":
        raise TypeError(f"{name} must be {what}, not {given(integers)}")
    if values.shape not in ((), (count,)):
        raise ValueError(f"{name} must be one integer or have shape ({count},), not {values.shape}")
    bad = (values < first) | (values >= end)
    if bad.any():
        which = np.flatnonzero(bad)[0]
        where = f"{name}[{which}]" if values.ndim else name
        raise ValueError(f"{where} must be {range_}, not {values.reshape(-1)[which]}")
    return np.broadcast_to(values, count)


def _as_double(values: np.ndarray) -> np.ndarray:
    """Returns numbers in double precision; subnormal numbers of single precision as well if processors flush these."""
    if values.dtype != np.float32:
        with np.errstate(over="ignore"):
            return values.astype(np.float64)
    bits = np.ascontiguousarray(values).reshape(values.shape).view(np.int32)
    sizes = bits & 0x7FFFFFFF
    subnormal = sizes < 2**23
    return np.where(subnormal, np.where(bits < 0, -1.0, 1.0) * sizes * 2.0**-149, values.astype(np.float64))
