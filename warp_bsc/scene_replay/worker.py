"""The program of a worker, which checks chunks of intervals, and the pickles that it exchanges with its starter."""

import contextlib
import io
import multiprocessing
import os
import pickle
import signal
import socket
import threading
import traceback
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from .._version import __version__
from ..detection.run.launch import cores, count_cores
from ..detection.run.start import device_names, find_device, gpu_count
from ..usd.interval import ReadingNotes
from ..usd.scene import Scene
from ..usd.segment import Segment
from ..usd.selection import Selection
from .checking import Checks, IntervalChecker
from .results import IntervalResult

_CHUNK_SECONDS = 15.0  # a chunk ends after this time: results that are not yet written can be lost

_ONE_CHUNK = threading.Lock()
"""Held while a chunk is checked: a worker of Dask has several threads."""

_local: tuple[int, int] | None = None
"""Number of this worker and number of all workers on this machine, None in a worker of Dask."""

_starter: socket.socket | None = None
"""The connection to the process that has started this worker, None in a worker of Dask."""


@dataclass
class _Opened:
    """The job of the last chunk of this worker.

    Attributes:
        job: The job.
        checker: Its checker.
        left_out: Number of meshes that the scene left out when it was opened.
        stop: Number of the interval after the last one that was read.
    """

    job: bytes
    checker: IntervalChecker
    left_out: int
    stop: int = 0

    def serves(self, job: bytes, first: int) -> bool:
        """Whether intervals of a job are read from ``first`` on as if no later one had been read before.

        Which vertices coincide depends on how long all meshes are there, and nobody else knows yet of a mesh that is
        found to be broken later.
        """
        goes_back = first < self.stop and len(self.checker.scene.left_out) > self.left_out
        return job == self.job and not goes_back


_opened: _Opened | None = None
"""What this worker has opened last."""


def device_of_worker(name: str | None, number: int, gpu_count: int) -> str | None:
    """Returns the name of the device that a worker on this machine uses, given its number, from 0.

    Workers use the devices whose names have commas between them, or, for None or ``"cuda"``, all GPUs, in turns.
    """
    if gpu_count and name in (None, "cuda"):
        return f"cuda:{number % gpu_count}"
    names = device_names(name)
    return names[number % len(names)]


def serve(connection: socket.socket, number: int, count: int) -> None:
    """Runs a local worker: calls the functions that it receives through a connection until that is closed.

    A function may send messages. An empty one follows, then what the function returns, and the error that it raises.
    """
    global _local, _starter
    _local, _starter = (number, count), connection
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes; the first one ends the others
    threading.Thread(target=_end_with_parent, daemon=True).start()
    with contextlib.suppress(EOFError, OSError):
        while True:
            function, arguments = pickle.loads(receive(connection))
            try:
                reply = function(*arguments), None
            except Exception as error:
                reply = None, _portable(error)
            send(connection, b"")
            send(connection, pickle.dumps(reply))


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent
    parent.join()
    os._exit(1)


def check_chunk(job: bytes, first: int, stop: int) -> list[bytes]:
    """Checks intervals and returns each result, and the error that stopped them, pickled for :func:`unpack`.

    A local worker sends each as soon as it is there, and returns none. After :data:`_CHUNK_SECONDS` no more intervals
    are read, so that the last ones may be missing; the first one never is.
    """
    global _opened  # noqa: PLW0603
    stream, parts = io.BytesIO(), []
    pickler = _Pickler(stream, pickle.HIGHEST_PROTOCOL)

    def hand_over(index: int, notes: ReadingNotes, result: IntervalResult | Exception) -> None:
        pickler.index = index
        stream.seek(0)  # new memory for each would take longer than to pickle it
        pickler.dump((index, notes))
        pickler.dump(result)
        stream.truncate()
        with stream.getbuffer() as part:
            send(_starter, part) if _starter else parts.append(bytes(part))

    with _ONE_CHUNK:
        checker = None
        try:
            opened = _open(job, first)
            checker = opened.checker
            with cores(_core_count()):
                for result in checker.check(first, stop, _CHUNK_SECONDS):
                    checker.scene.files.check()
                    index = result.summary.index
                    opened.stop = max(opened.stop, index + 1)
                    hand_over(index, result.contacts.interval.notes, result)
        except Exception as raised:
            _opened = None
            hand_over(first, checker.scene.take_notes() if checker else ReadingNotes(), _portable(raised))
    return parts


def selection_without_initial(job: bytes) -> Selection:
    """Returns the selection that also ignores the pairs that cross, or are inside each other, at the first time."""
    try:
        with _ONE_CHUNK, cores(_core_count()):
            opened = _open(job, 0)
            opened.stop = max(opened.stop, 1)
            return opened.checker.selection_without_initial()
    except Exception as error:
        raise _portable(error) from None


def name_device(name: str | None) -> str:
    """Returns the name of the device that this worker uses, of the requested ones; starts Warp."""
    return find_device(device_of_worker(name, _local[0], gpu_count()) if _local else name).alias


def prepare(devices: str | None) -> None:
    """Imports what opens a scene, and starts Warp, before the first chunk of this worker."""
    from ..usd.read import find_meshes  # noqa: F401, PLC0415 (imports pxr)

    name_device(devices)


def _open(job: bytes, first: int) -> _Opened:
    """Returns a job that is opened to check intervals from ``first`` on, the last one if it serves."""
    global _opened  # noqa: PLW0603
    if _opened is None or not _opened.serves(job, first):
        _opened = None  # before the next scene is opened, to free memory
        stream = io.BytesIO(job)
        version = pickle.load(stream)
        if version != __version__:
            raise ValueError(f"{_worker_name()}: this worker has version {__version__} of warp-bsc, not {version}")
        scene, checks = pickle.load(stream)
        checks = replace(checks, device=name_device(checks.device))
        _opened = _Opened(job, IntervalChecker(scene, checks, _worker_name()), len(scene.left_out))
    return _opened


def _core_count() -> int:
    """Returns the number of cores for this worker: its share of the machine, or the threads that Dask gives it."""
    if _local:
        return max(1, count_cores() // _local[1])
    from distributed import get_worker  # noqa: PLC0415 (optional)

    return get_worker().state.nthreads


def _worker_name() -> str:
    return f"{socket.gethostname()}:{os.getpid()}"


def _portable(error: Exception) -> Exception:
    """Returns an error with the same message that can be sent to another process."""
    if isinstance(error, OSError):
        return OSError(error.errno, error.strerror, error.filename) if error.strerror else OSError(str(error))
    for kind in (ValueError, MemoryError):
        if isinstance(error, kind):
            return kind(str(error))
    frame = traceback.extract_tb(error.__traceback__)[-1]
    place = f"{Path(frame.filename).name}:{frame.lineno}"
    return RuntimeError(f"{type(error).__name__}: {error} (in worker {_worker_name()}, {place})")


# Messages between the processes ----------------------------------------------------------------------------------


def pack(scene: Scene, checks: Checks) -> bytes:
    """Returns a scene and checks as a worker opens them, equal bytes for equal content."""
    return pickle.dumps(__version__) + pickle.dumps((scene, checks))


class _Pickler(pickle.Pickler):
    """Writes the number of an interval instead of its segment."""

    index = 0

    def persistent_id(self, obj: Any) -> int | None:
        return self.index if isinstance(obj, Segment) else None


class _Unpickler(pickle.Unpickler):
    """Reads numbers of intervals as their segments in a scene."""

    def __init__(self, stream: io.BytesIO, scene: Scene):
        super().__init__(stream)
        self._scene = scene

    def persistent_load(self, pid: int) -> Segment:
        return self._scene.segment(pid)


def unpack(scene: Scene, parts: Iterable[bytes]) -> Iterator[IntervalResult]:
    """Yields the results of a chunk, records the scene's reading notes, and raises the error that stopped the chunk."""
    stream = io.BytesIO()
    unpickler = _Unpickler(stream, scene)  # one for all, as consecutive intervals share objects
    for part in parts:
        stream.__init__(part)  # makes no copy
        scene.note(*unpickler.load())
        result = unpickler.load()
        if isinstance(result, Exception):
            raise result
        yield result


def send(connection: socket.socket, message: bytes | memoryview) -> None:
    """Sends bytes that :func:`receive` returns."""
    connection.sendall(len(message).to_bytes(8, "little"))
    connection.sendall(message)


def receive(connection: socket.socket, size: int | None = None) -> bytes:
    """Returns what :func:`send` has sent, or so many bytes; raises an EOFError or OSError if the sender has ended.

    (A ``multiprocessing.Connection`` would take 0.2 MB at a time, and wait for Python's lock each time.)
    """
    size = int.from_bytes(receive(connection, 8), "little") if size is None else size
    message = b""
    while len(message) < size:  # usually once
        more = connection.recv(size - len(message), socket.MSG_WAITALL)
        if not more:
            raise EOFError
        message += more
    return message
