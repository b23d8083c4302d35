"""Files that appear complete or not at all, and what is written to them one interval after the other."""

import contextlib
import os
import tempfile
from pathlib import Path

__all__ = ["OutputFile", "StreamedFile"]


class OutputFile:
    """A file that is written beside its place, and takes it when it is complete.

    Attributes:
        path: Its place.
    """

    def __init__(self, path):
        """Opens a temporary file in the same folder.

        Raises:
            OSError: If that cannot be written.
        """
        self.path = Path(path)
        if self.path.is_dir():
            raise IsADirectoryError(f"{path}: a folder, not a file")
        if not self.path.parent.is_dir():
            raise FileNotFoundError(f"{path}: there is no folder {self.path.parent}")
        handle, name = tempfile.mkstemp(prefix=f".{self.path.name}.", suffix=".tmp", dir=self.path.parent)
        self._temporary = Path(name)
        self._file = os.fdopen(handle, "wb", buffering=0)

    def write(self, text: str | bytes):
        """Write all of a text.

        Raises:
            OSError: If there is no room; some of it may have been written then.
        """
        rest = memoryview(text.encode() if isinstance(text, str) else text)
        while rest:
            rest = rest[self._file.write(rest) :]

    def tell(self) -> int:
        """How many bytes have been written."""
        return self._file.tell()

    def truncate(self, size: int):
        """Take back what has been written after the first bytes."""
        self._file.seek(size)
        self._file.truncate()

    def commit(self):
        """Put the file in its place.

        Raises:
            OSError: If that cannot be done; what was there before is as it was.
        """
        os.fsync(self._file.fileno())
        self._file.close()
        mask = os.umask(0)
        os.umask(mask)
        os.chmod(self._temporary, 0o666 & ~mask)
        os.replace(self._temporary, self.path)

    def discard(self):
        """Leave nothing behind, unless the file is in its place already."""
        self._file.close()
        with contextlib.suppress(FileNotFoundError):
            self._temporary.unlink()


class StreamedFile:
    """A text of a head, a record for each interval, and a tail: the base of the formats that are such.

    A record is there as a whole or not at all. Where the disk is full, the last ones make room for the tail.
    """

    def __init__(self, path):
        """Opens the file.

        Raises:
            OSError: If it cannot be written.
        """
        self.path = Path(path)
        self._output = OutputFile(path)
        self._ends = []  # of the head and of each record

    @property
    def record_count(self) -> int:
        """How many records there are."""
        return max(0, len(self._ends) - 1)

    def add(self, interval, contacts):
        """Append the record of an interval.

        Raises:
            OSError: If there is no room for it. Only finishing the file is possible then.
        """
        if not self._ends:
            self._append([self.head()])
        self._append(self.record(interval, contacts))

    def finish(self, outcome):
        """Append the tail and put the file in its place.

        Args:
            outcome: All that was found, of which the last intervals may be missing in this file.

        Raises:
            OSError: If there is no room. The last records have made room for the tail then, and the file is in its
                place all the same, unless there is no room even for that.
        """
        shortage = None
        if not self._ends:
            self._output.truncate(0)
            self._append([self.head()])
        self._output.truncate(self._ends[-1])  # an interruption may have come in the middle of a record
        while True:
            try:
                self._output.write(self.tail(outcome.first(self.record_count)))
                break
            except OSError as error:
                if self.record_count == 0:
                    raise
                shortage = error
                self._ends.pop()
                self._output.truncate(self._ends[-1])
        self._output.commit()
        if shortage:
            raise shortage

    def discard(self):
        """Leave nothing behind, unless the file is finished."""
        self._output.discard()

    def _append(self, texts):
        for text in texts:
            self._output.write(text)
        self._ends.append(self._output.tell())
