"""Holds the time samples of a USD layer in a temporary file until the layer is written."""

import os
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..usd.write.layer import just_before
from ..usd.write.layer_writer import SHAPES
from .outputs import without_last_eighth

Key = tuple[str, ...]
"""What has samples: a prim, by the names of its parents and itself."""


class Sample(NamedTuple):
    """The values of a prim from one time to the next.

    Attributes:
        arrays: Values by attribute.
        moved: A time just before the next sample, and the values of ``points`` at that time; None if they stay.
    """

    arrays: dict[str, np.ndarray]
    moved: tuple[float, np.ndarray] | None = None


class SampleSpool:
    """The time samples of a layer's prims, in the order of time.

    They are written to a temporary file, the spool, so that memory grows by some numbers a sample only. Where a prim
    has no sample it is empty. USD interpolates between samples; values that must not move have an empty sample just
    before the next one.
    """

    def __init__(self, folder: str | os.PathLike, types: Mapping[str, Mapping[str, str]]):
        """Opens the temporary file.

        Args:
            folder: Its folder.
            types: Types of attributes, of :data:`~.write.layer_writer.SHAPES`, by name of a prim and attribute.

        Raises:
            OSError: If it cannot be opened.
        """
        self._types = types
        self._file = tempfile.TemporaryFile(buffering=0, dir=folder)  # noqa: SIM115 (closed when discarded)
        self._ends: list[int] = []  # offset at the end of each complete interval
        self._samples: dict[Key, list[_Stored]] = {}
        self._start: float | None = None

    @property
    def interval_count(self) -> int:
        """Number of complete intervals."""
        return len(self._ends)

    def add(self, time: float, found: Mapping[Key, Sample]) -> None:
        """Adds the samples of all prims at the start of an interval, which is complete afterwards."""
        self._add(time, found, len(self._ends))
        self._ends.append(self._file.tell())

    def add_last(self, time: float, found: Mapping[Key, Sample]) -> None:
        """Adds the samples of all prims at the end of the last complete interval."""
        self._add(time, found, len(self._ends) - 1)

    def keep(self, count: int) -> None:
        """Drops all intervals but the first ones, and what an error has left of an incomplete one."""
        del self._ends[count:]

    def shrink(self) -> bool:
        """Drops the last eighth of the intervals, and returns whether there were any."""
        if not self._ends:
            return False
        self._ends = without_last_eighth(self._ends)
        self._file.truncate(self._ends[-1] if self._ends else 0)
        return True

    def discard(self) -> None:
        """Removes the temporary file."""
        self._file.close()

    def keys(self) -> list[Key]:
        """Returns the prims that are not always empty, in the order in which they came."""
        return [key for key in self._samples if any(not sample.is_empty for sample in self._complete(key))]

    def time_samples(self, key: Key, attribute: str, end: float) -> Iterator[tuple[float, np.ndarray]]:
        """Yields the time samples of an attribute up to the end of the last interval, in order."""
        value_type = self._types[key[-1]][attribute]
        empty = self._load(value_type, _Array(0, 0)) if attribute != "extent" else np.zeros((2, 3), np.float32)
        samples = self._complete(key)
        for index, sample in enumerate(samples):
            if sample.is_empty:
                yield sample.time, empty
                continue
            value = self._load(value_type, sample.arrays[attribute])
            yield sample.time, value
            is_last = index + 1 == len(samples)
            following = end if is_last else samples[index + 1].time
            if attribute == "points" and sample.moved:
                yield sample.moved[0], self._load(value_type, sample.moved[1])
            # Between two values USD interpolates, which would show points on the way from one contact to another.
            elif value_type.startswith(("float", "point")) and (before := just_before(following)) > sample.time:
                yield before, value if attribute == "extent" else empty
            if is_last and end > sample.time:
                yield end, empty

    def _add(self, time: float, found: Mapping[Key, Sample], interval: int) -> None:
        self._start = time if self._start is None else self._start
        self._file.seek(0, os.SEEK_END)
        for key, sample in found.items():
            # USD holds the first sample before its time
            samples = self._samples.setdefault(key, [_Stored(0, self._start, {}, None)] * (time > self._start))
            types = self._types[key[-1]]
            stored = {name: self._store(types[name], array) for name, array in sample.arrays.items()}
            moved = (sample.moved[0], self._store(types["points"], sample.moved[1])) if sample.moved else None
            samples.append(_Stored(interval, time, stored, moved))
        for key, samples in self._samples.items():
            if key not in found and not samples[-1].is_empty:
                samples.append(_Stored(interval, time, {}, None))

    def _complete(self, key: Key) -> "list[_Stored]":
        """Returns the samples of a prim that belong to complete intervals."""
        return [sample for sample in self._samples[key] if sample.interval < len(self._ends)]

    def _store(self, value_type: str, array: np.ndarray) -> "_Array":
        """Appends an array to the spool."""
        data = np.ascontiguousarray(array, dtype=SHAPES[value_type][0])
        stored = _Array(self._file.tell(), data.nbytes)
        rest = memoryview(data.tobytes())
        while rest:
            rest = rest[self._file.write(rest) :]
        return stored

    def _load(self, value_type: str, stored: "_Array") -> np.ndarray:
        """Reads an array from the spool."""
        dtype, width = SHAPES[value_type]
        self._file.seek(stored.offset)
        data = self._file.read(stored.size)
        if len(data) != stored.size:
            raise RuntimeError("the spool of the overlay is truncated")
        return np.frombuffer(data, dtype).reshape((-1, width) if width > 1 else -1)


class _Array(NamedTuple):
    """An array in the spool, by its offset and size [bytes]."""

    offset: int
    size: int


@dataclass(frozen=True)
class _Stored:
    """A sample of a prim in the spool.

    Attributes:
        interval: Number of the interval.
        time: Time code.
        arrays: Its arrays, by attribute; none for an empty sample.
        moved: A time just before the next sample, and the points at that time, if they move.
    """

    interval: int
    time: float
    arrays: dict[str, _Array]
    moved: tuple[float, _Array] | None

    @property
    def is_empty(self) -> bool:
        """Whether the prim is empty at that time."""
        return not self.arrays
