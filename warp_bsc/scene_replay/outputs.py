"""The interface of all files that a replay writes, and the base class of files that are lists of records."""

import os
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from typing import TypeVar

from .._atomic_file import OutputFile
from .results import IntervalResult
from .summary import Summary

_Item = TypeVar("_Item")


class ReplayOutput(ABC):
    """A file to which the intervals of a replay are written.

    Attributes:
        file: The file, which appears at its path when the output is finished.
    """

    def __init__(self, path: str | os.PathLike):
        """Opens the file.

        Raises:
            OSError: If it cannot be written.
        """
        self.file = OutputFile(path)

    @abstractmethod
    def add(self, result: IntervalResult) -> None:
        """Adds an interval.

        Raises:
            OSError: If the disk is full. After that the output can only be shrunk, finished or discarded.
        """

    @abstractmethod
    def finish(self, summary: Summary) -> None:
        """Completes the file and moves it to its path.

        Args:
            summary: The whole replay. The last of its intervals may be missing in this file.

        Raises:
            OSError: If the disk is full. After shrinking, finishing may be tried again.
        """

    @abstractmethod
    def shrink(self) -> bool:
        """Drops the last eighth of the intervals to save space, and returns whether the file becomes smaller."""

    def discard(self) -> None:
        """Removes all temporary files; a finished file stays."""
        self.file.discard()


class RecordFile(ReplayOutput):
    """A text file of a head, one record for each interval, and a tail.

    The finished file contains only whole records.
    """

    def __init__(self, path: str | os.PathLike):
        """Opens the file, with errors as of :class:`ReplayOutput`."""
        super().__init__(path)
        self._ends = []  # offsets at which the head and each record end

    @abstractmethod
    def head(self) -> str:
        """Returns the text before the first record."""

    @abstractmethod
    def record(self, result: IntervalResult) -> Iterator[str | bytes]:
        """Yields the text of an interval in parts, bytes in UTF-8."""

    @abstractmethod
    def tail(self, summary: Summary) -> str:
        """Returns the text after the last record, given a summary of the intervals in the file."""

    @property
    def record_count(self) -> int:
        """Number of records in the file."""
        return max(0, len(self._ends) - 1)

    def add(self, result: IntervalResult) -> None:
        """Appends the record of an interval."""
        if not self._ends:
            self._append([self.head()])
        self._append(self.record(result))

    def finish(self, summary: Summary) -> None:
        """Appends the tail and moves the file to its path."""
        # An interruption or a full disk may have cut the last record.
        del self._ends[len(summary.intervals) + 1 :]
        self.file.truncate(self._ends[-1] if self._ends else 0)
        if not self._ends:
            self._append([self.head()])
        self.file.write(self.tail(summary.first(self.record_count)))
        self.file.commit()

    def shrink(self) -> bool:
        """Drops the last records."""
        if not self.record_count:
            return False
        self._ends[1:] = without_last_eighth(self._ends[1:])
        self.file.truncate(self._ends[-1])
        return True

    def _append(self, texts: Iterable[str | bytes]) -> None:
        for text in texts:
            self.file.write(text)
        self._ends.append(self.file.tell())


def without_last_eighth(items: list[_Item]) -> list[_Item]:
    """Returns all items except the last eighth of them, at least the last one."""
    return items[: len(items) - max(1, len(items) // 8)]
