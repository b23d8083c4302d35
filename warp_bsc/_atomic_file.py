"""Files that appear complete or not at all."""

import codecs
import contextlib
import os
import secrets
import shutil
import stat
import sys
import tempfile
from pathlib import Path

__all__ = ["STDOUT", "OutputFile", "naming"]

STDOUT = "-"
"""The path of standard output."""


@contextlib.contextmanager
def naming(what):
    """Put the name of a file before what is wrong with it, as the system has it.

    Raises:
        OSError: If one is raised in the block.
    """
    try:
        yield
    except OSError as error:
        named = type(error)(f"{what}: {error.strerror or error}")
        named.errno = error.errno
        raise named from error


class OutputFile:
    """A file that is written elsewhere, and takes its place when it is complete.

    A link stays, and the file that it points to is replaced. What is no regular file, such as ``/dev/null``, a named
    pipe or ``/dev/stdout``, is not replaced: all is written to it at the end.

    Attributes:
        path: Its place, :data:`STDOUT` for standard output.
        name: The same in words.
        is_stream: Whether it is no regular file.
        folder: Where it waits until it is complete.
    """

    def __init__(self, path):
        """Opens a temporary file: one without a name, of which nothing is ever left, where the system has such.

        Raises:
            OSError: If that or the place cannot be written.
        """
        self.path = Path(path)
        if self.path.is_dir():
            raise IsADirectoryError(f"{path}: a folder, not a file")
        with naming(path):
            self._stream = _open_stream(path)
        self.is_stream = self._stream is not None
        self.name = "standard output" if str(path) == STDOUT else str(path)
        self._place = Path(os.path.realpath(path))
        self.folder = tempfile.gettempdir() if self.is_stream else self._place.parent
        if not os.path.isdir(self.folder):
            folder = self.folder if self.path.is_symlink() else self.path.parent
            raise FileNotFoundError(f"{path}: there is no folder {folder}")
        with naming(path):
            self._file, self._temporary = _open_temporary(self.folder)

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
        """Put the file in its place, with the permissions of the file that was there.

        Raises:
            OSError: If that cannot be done; what was there before is as it was.
        """
        if self.is_stream:
            self._file.seek(0)
            try:
                shutil.copyfileobj(self._file, self._stream)
                self._stream.flush()
            except OSError as error:
                raise type(error)(error.strerror) from None  # without its number: to keep less would not help
        else:
            os.fsync(self._file.fileno())
            if self._temporary is None:
                self._temporary = _give_name(self._file, self.folder)
            with contextlib.suppress(FileNotFoundError):
                os.chmod(self._temporary, stat.S_IMODE(os.stat(self._place).st_mode))
            self._file.close()
            os.replace(self._temporary, self._place)
        self.discard()

    def discard(self):
        """Leave nothing behind, unless the file is in its place already."""
        self._file.close()
        if self.is_stream:
            with contextlib.suppress(OSError):  # of what could not be written, which was said then
                self._stream.close()
        if self._temporary:
            with contextlib.suppress(FileNotFoundError):
                self._temporary.unlink()


class _StandardOutput:
    """Standard output for bytes of UTF-8, to which it may give another encoding."""

    def __init__(self):
        self._decoder = codecs.getincrementaldecoder("utf-8")()

    def write(self, data):
        sys.stdout.write(self._decoder.decode(data))

    def flush(self):
        sys.stdout.flush()

    def close(self):
        pass


def _open_stream(path):
    """What to write to if a path names no regular file, None if it does or could."""
    if str(path) == STDOUT:
        return _StandardOutput()
    try:
        is_regular = stat.S_ISREG(os.stat(path).st_mode)
    except FileNotFoundError:
        return None
    descriptor = _find_descriptor(path)
    if descriptor is not None:
        return open(os.dup(descriptor), "wb")
    return None if is_regular else open(path, "wb")


def _find_descriptor(path) -> int | None:
    """The open file of this process that a path names, as ``/dev/stderr`` does, even if that is a regular one."""
    while True:
        folder, name = os.path.realpath(os.path.dirname(path)), os.path.basename(path)
        if folder in ("/dev/fd", f"/proc/{os.getpid()}/fd"):
            return int(name)
        if not os.path.islink(path):
            return None
        path = os.path.join(folder, os.readlink(path))


def _open_temporary(folder):
    """A temporary file, and its path, None if it has no name: the system then removes it as soon as it is closed."""
    if hasattr(os, "O_TMPFILE"):
        with contextlib.suppress(OSError):  # where the file system has no such files, or gives them no names
            flags = os.O_TMPFILE | os.O_RDWR
            with open(os.open(folder, flags, 0o666), "wb", buffering=0) as trial:
                _give_name(trial, folder).unlink()
            return open(os.open(folder, flags, 0o666), "w+b", buffering=0), None
    path = _new_name(folder)
    return open(os.open(path, os.O_CREAT | os.O_EXCL | os.O_RDWR, 0o666), "w+b", buffering=0), path


def _give_name(file, folder) -> Path:
    """A new name in a folder for a temporary file without one."""
    path = _new_name(folder)
    # Given a folder's descriptor, of which an absolute path makes no use, Python calls the function that follows links.
    os.link(f"/proc/self/fd/{file.fileno()}", path, src_dir_fd=file.fileno())
    return path


def _new_name(folder) -> Path:
    return Path(folder, f".warp-bsc-{secrets.token_hex(8)}.tmp")
