"""Writes files that appear complete or not at all."""

import codecs
import contextlib
import os
import secrets
import shutil
import stat
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

STDOUT = "-"
"""The path of standard output."""


def unfinished_path(path: str | os.PathLike) -> Path:
    """Returns where a file is that :meth:`OutputFile.save` has saved and that is not committed, given its path."""
    return Path(os.path.realpath(path) + ".part")


@contextlib.contextmanager
def naming(what: str | os.PathLike) -> Iterator[None]:
    """Puts the name of a file before the system's message in errors of the context.

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
    """A file that is written elsewhere and moved to its path when it is complete.

    A symbolic link stays, and the file that it points to is replaced. A stream, such as ``/dev/null``, a named pipe or
    ``/dev/stdout``, is not replaced: the whole content is written to it at the end.

    Attributes:
        path: The path of the file, :data:`STDOUT` for standard output.
        name: The same in words.
        is_stream: Whether the path is that of a stream, not of a regular file.
        folder: The folder of the temporary file.
    """

    def __init__(self, path: str | os.PathLike):
        """Opens a temporary file; without a name where the system allows, so that nothing of it remains after a crash.

        Raises:
            OSError: If the temporary file or the path cannot be written.
        """
        self.path = Path(path)
        if self.path.is_dir():
            raise IsADirectoryError(f"{path}: a folder, not a file")
        with naming(path):
            self._stream = _open_stream(path)
        self.is_stream = self._stream is not None
        self.name = "standard output" if str(path) == STDOUT else str(path)
        self._target = Path(os.path.realpath(path))
        self.folder = tempfile.gettempdir() if self.is_stream else self._target.parent
        if not os.path.isdir(self.folder):
            folder = self.folder if self.path.is_symlink() else self.path.parent
            raise FileNotFoundError(f"{path}: there is no folder {folder}")
        with naming(path):
            self._file, self._temporary = _open_temporary(self.folder)
        self._unfinished = unfinished_path(path)
        self._is_saved = False

    def write(self, text: str | bytes) -> None:
        """Writes the whole of a text.

        Raises:
            OSError: If the disk is full. A part of the text may have been written.
        """
        rest = memoryview(text.encode() if isinstance(text, str) else text)
        while rest:
            rest = rest[self._file.write(rest) :]

    def flush(self) -> None:
        """Does nothing, for writers that ask for it: nothing is buffered."""

    def tell(self) -> int:
        """Returns the number of bytes that have been written."""
        return self._file.tell()

    def truncate(self, size: int) -> None:
        """Removes all but the first ``size`` bytes."""
        self._file.seek(size)
        self._file.truncate()

    def adopt(self, path: str | os.PathLike) -> None:
        """Makes a file in :attr:`folder`, which another library wrote, the temporary file.

        Raises:
            OSError: If it cannot be opened.
        """
        file = open(path, "r+b", buffering=0)  # noqa: SIM115 (closed when discarded)
        self._remove_temporary()
        self._file, self._temporary = file, Path(path)

    def save(self) -> None:
        """Saves the content so far: if this process is killed, it stays at :func:`unfinished_path`.

        What is written after the first call stays as well, unless the whole machine stops before the next call. A file
        that was there before is replaced. Only for files that are no streams.

        Raises:
            OSError: If that fails.
        """
        os.fsync(self._file.fileno())
        if not self._is_saved:
            self._temporary = self._temporary or _give_name(self._file, self.folder)
            os.replace(self._temporary, self._unfinished)
            self._temporary, self._is_saved = self._unfinished, True

    def commit(self) -> None:
        """Moves the file to its path, with the permissions of the file that was there.

        Raises:
            OSError: If that fails. A file that was there before is unchanged.
        """
        if self._stream is not None:
            self._file.seek(0)
            try:
                shutil.copyfileobj(self._file, self._stream)
                self._stream.flush()
            except OSError as error:
                raise type(error)(error.strerror) from None  # no number: a shorter file would not help
        else:
            os.fsync(self._file.fileno())
            if self._temporary is None:
                self._temporary = _give_name(self._file, self.folder)
            if not self._is_at(self._temporary):
                raise FileExistsError(f"another process, which writes the same file, has replaced {self._temporary}")
            with contextlib.suppress(FileNotFoundError):
                os.chmod(self._temporary, stat.S_IMODE(os.stat(self._target).st_mode))
            self._file.close()
            os.replace(self._temporary, self._target)
        self.discard()

    def discard(self) -> None:
        """Removes the temporary file. A committed file stays, and so does a saved one."""
        if self._stream is not None:
            with contextlib.suppress(OSError):  # commit has raised it already
                self._stream.close()
        self._remove_temporary()

    def _is_at(self, path) -> bool:
        """Returns whether the temporary file is at a path."""
        with contextlib.suppress(FileNotFoundError):
            return os.path.samestat(os.fstat(self._file.fileno()), os.stat(path))
        return False

    def _remove_temporary(self):
        self._file.close()
        if self._temporary and not self._is_saved:
            with contextlib.suppress(FileNotFoundError):
                self._temporary.unlink()


class _StandardOutput:
    """Standard output for bytes of UTF-8, which it gets in its own encoding."""

    def __init__(self):
        self._decoder = codecs.getincrementaldecoder("utf-8")()

    def write(self, data: bytes) -> None:
        sys.stdout.write(self._decoder.decode(data))

    def flush(self) -> None:
        sys.stdout.flush()

    def close(self) -> None:
        pass


def _open_stream(path):
    """Opens the stream that a path names; returns None for a regular file or where there is none yet."""
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
    """Returns the descriptor of this process that a path such as ``/dev/stderr`` names, None for other paths."""
    while True:
        folder, name = os.path.realpath(os.path.dirname(path)), os.path.basename(path)
        if folder in ("/dev/fd", f"/proc/{os.getpid()}/fd"):
            return int(name)
        if not os.path.islink(path):
            return None
        path = os.path.join(folder, os.readlink(path))


def _open_temporary(folder):
    """Opens a temporary file. Returns it and its path, None for a file without a name, which closing removes."""
    if hasattr(os, "O_TMPFILE"):
        with contextlib.suppress(OSError):  # the file system has no files without a name, or cannot name them later
            flags = os.O_TMPFILE | os.O_RDWR
            with open(os.open(folder, flags, 0o666), "wb", buffering=0) as trial:
                _give_name(trial, folder).unlink()
            return open(os.open(folder, flags, 0o666), "w+b", buffering=0), None
    path = _new_name(folder)
    return open(os.open(path, os.O_CREAT | os.O_EXCL | os.O_RDWR, 0o666), "w+b", buffering=0), path


def _give_name(file, folder) -> Path:
    """Links a temporary file without a name into a folder. Returns its path."""
    path = _new_name(folder)
    # Python calls the function that follows links only if given a folder's descriptor, which an absolute path ignores.
    os.link(f"/proc/self/fd/{file.fileno()}", path, src_dir_fd=file.fileno())
    return path


def _new_name(folder) -> Path:
    return Path(folder, f".warp-bsc-{secrets.token_hex(8)}.tmp")
