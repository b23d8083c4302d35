"""Checks the intervals of a scene in several processes, on this machine or on a Dask cluster.

The intervals are divided into chunks. A worker opens the scene by its path, checks a chunk at a time, and hands over
the pickled results, with numbers for segments, which the receiving process has as well: on this machine each as soon as
it is there, in a cluster a chunk at once. Results are yielded in the order of the intervals. What a worker that dies
has not handed over is checked again by another one.

A mesh found to be broken is left out from then on. Results of later intervals that workers have computed with it are
dropped, and their chunks are checked again.
"""

import contextlib
import itertools
import logging
import multiprocessing
import pickle
import signal
import socket
import threading
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from dataclasses import dataclass
from itertools import islice
from multiprocessing import resource_tracker
from multiprocessing.context import SpawnProcess
from queue import SimpleQueue
from typing import Any
from weakref import WeakKeyDictionary

from .._arguments import checked_integer, given
from ..detection.run.start import device_names
from ..usd.scene import Scene
from ..usd.selection import Selection
from .checking import Checks
from .results import IntervalResult
from .worker import check_chunk, name_device, pack, prepare, receive, selection_without_initial, send, serve, unpack

_CHUNK_BYTES = 512 << 20  # of positions that a worker sends at a time
_MOST_INTERVALS = 16  # in a chunk; each chunk reads and checks one time more than it has intervals
_CHUNKS_EACH, _FEWEST = 4, 4  # fewest chunks of each worker, for all to end at about the same time, if they are as long
_CONNECT_SECONDS = 10.0


class LocalWorkers:
    """Processes on this machine, which end when this one ends, even if it is killed.

    Each has its own connection, and a thread in this process that waits at it. (The pool of Python's
    ``concurrent.futures`` has one pipe for all results, and hangs if a process is killed while it writes to it.)

    Attributes:
        died: The error of a future of :meth:`submit` whose process has died.
        attempts: Number of times that a function is submitted before its processes' deaths are an error.
        count: Number of processes.
    """

    died: type[Exception] = ChildProcessError
    attempts = 3

    def __init__(self, count: int):
        """Makes so many processes, at least 1, each of which starts at its first call."""
        self.count = count
        self._numbers = itertools.count()
        self._of_thread = threading.local()
        self._processes: dict[int, tuple[SpawnProcess, socket.socket]] = {}  # by number of the thread
        self._parts: WeakKeyDictionary[Future, SimpleQueue[bytes]] = WeakKeyDictionary()  # that functions have sent
        self._is_closed = False
        self._threads = ThreadPoolExecutor(count, "worker", self._begin_thread)

    def start(self, devices: str | None) -> None:
        """Starts all processes, which import what they need and start their devices, the named ones."""
        for _ in range(self.count):
            self.submit(prepare, devices)

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future:
        """Returns a future of the function's result in one of the processes."""
        parts: SimpleQueue[bytes] = SimpleQueue()
        future = self._threads.submit(self._call, parts, function, arguments)
        future.add_done_callback(lambda _: parts.put(b""))
        self._parts[future] = parts
        return future

    def result(self, future: Future) -> Any:
        """Waits for a future of :meth:`submit` and returns its result, or raises the error of its function.

        If the function sends messages, an iterator of them is returned with the first. The process may die meanwhile.
        """
        parts = iter(self._parts.pop(future).get, b"")
        first = next(parts, None)
        return future.result() if first is None else itertools.chain([first], parts)

    def close(self) -> None:
        """Ends all processes at once."""
        self._is_closed = True
        for process, _ in list(self._processes.values()):
            process.kill()
        self._threads.shutdown(cancel_futures=True)
        for _, connection in self._processes.values():
            connection.close()

    def _begin_thread(self) -> None:
        self._of_thread.number = next(self._numbers)
        if hasattr(signal, "pthread_sigmask"):
            resource_tracker.ensure_running()  # the first process would start it, which unblocks the signal
            signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # inherited by the processes that it starts

    def _call(self, parts: SimpleQueue[bytes], function: Callable[..., Any], arguments: tuple) -> Any:
        """Returns the function's result in the process of this thread; puts the messages that it sends into a queue.

        Raises a ChildProcessError if the process dies. The next call starts another one.
        """
        number = self._of_thread.number
        _, connection = self._processes.get(number) or self._start(number)
        try:
            send(connection, pickle.dumps((function, arguments)))
            while part := receive(connection):
                parts.put(part)
            result, error = pickle.loads(receive(connection))
        except (EOFError, OSError, MemoryError) as error:  # its rest would be taken for the next message
            del self._processes[number]
            connection.close()
            raise ChildProcessError("a worker died") from error
        if error:
            raise error
        return result

    def _start(self, number: int) -> tuple[SpawnProcess, socket.socket]:
        """Starts a process and returns it with the connection to it."""
        context = multiprocessing.get_context("spawn")  # Warp's threads do not survive a fork
        connection, other = socket.socketpair()
        process = context.Process(target=serve, args=(other, number, self.count), daemon=True)
        process.start()
        other.close()  # so that the connection ends when the process does
        self._processes[number] = process, connection
        if self._is_closed:
            process.kill()
        return self._processes[number]


class Cluster:
    """The workers of a running Dask cluster, with the attributes and methods of :class:`LocalWorkers`."""

    attempts = 1  # Dask itself repeats a call whose worker dies

    def __init__(self, address: str):
        """Connects to the cluster.

        Args:
            address: Address of its scheduler, such as ``"tcp://head:8786"``.

        Raises:
            ModuleNotFoundError: If Dask is not installed.
            OSError: If the scheduler cannot be reached.
        """
        try:
            from distributed import Client, KilledWorker  # noqa: PLC0415 (optional)
            from distributed.comm.core import CommClosedError  # noqa: PLC0415
        except ModuleNotFoundError as error:
            raise ModuleNotFoundError("workers: a cluster needs Dask: pip install 'warp-bsc[cluster]'") from error
        self.died: type[Exception] = KilledWorker
        self._address = address
        self._disconnected = CancelledError, CommClosedError
        # The loss of the scheduler, which it logs on standard error, is raised here as an error.
        logging.getLogger("distributed.client").setLevel(logging.CRITICAL)
        try:
            self._client = Client(address, timeout=_CONNECT_SECONDS, set_as_default=False)
        except (OSError, ValueError) as error:
            raise OSError(f"workers: {address}: cannot reach the scheduler of a Dask cluster: {error}") from error

    @property
    def count(self) -> int:
        """Current number of workers, at least 1."""
        with self._connected(Exception):  # of several types; the block has no other errors
            threads: Any = self._client.nthreads()  # by worker; a coroutine only for asynchronous clients
        return max(1, len(threads))

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Returns a future of the function's result in one of the workers."""
        with self._connected(Exception):
            return self._client.submit(function, *arguments, pure=False)

    def result(self, future: Any) -> Any:
        """Waits for a future of :meth:`submit` and returns its result, or raises the error of its function."""
        with self._connected(*self._disconnected):  # a lost scheduler cancels its futures
            return future.result()

    def close(self) -> None:
        """Disconnects from the cluster, which drops its waiting calls."""
        self._client.close()

    @contextlib.contextmanager
    def _connected(self, *errors: type[Exception]) -> Iterator[None]:
        """Turns errors into a ConnectionError that names the scheduler."""
        try:
            yield
        except errors as error:
            raise ConnectionError(f"workers: {self._address}: lost the scheduler of the Dask cluster") from error


Workers = LocalWorkers | Cluster
"""Processes to which functions can be submitted."""


def selection_without_initial_in_workers(scene: Scene, checks: Checks, workers: Workers) -> Selection:
    """Returns :func:`.selection_without_initial` of a worker, with arguments and errors of :func:`check_in_workers`."""
    call = WorkerCall("checked the first time", selection_without_initial, (pack(scene, checks),))
    (selection,) = results_in_order(workers, deque([call]))
    return selection


def check_in_workers(scene: Scene, checks: Checks, workers: Workers, first: int = 0) -> Iterator[IntervalResult]:
    """Checks intervals in other processes and yields the results in order.

    Args:
        scene: The scene. All intervals before the first have been read.
        checks: The checks.
        workers: The processes.
        first: Number of the first interval.

    Raises:
        ChildProcessError: If worker after worker dies while it checks the same intervals.
        Exception: Errors of checking an interval, after the results of all intervals before it.
    """
    job = pack(scene, checks)
    calls = deque(_chunk_call(scene, job, *chunk) for chunk in cut_in_chunks(scene, first, workers.count))
    for found in results_in_order(workers, calls):
        left_out = len(scene.left_out)
        for result in unpack(scene, found):
            yield result
            first = result.summary.index + 1
        if len(scene.left_out) > left_out:
            job = pack(scene, checks)
            for call in calls:
                call.withdraw()
                call.arguments = (job, *call.arguments[1:])
        if first < (stop := calls[0].arguments[1] if calls else len(scene)):  # the chunk has ended early
            calls.appendleft(_chunk_call(scene, job, first, stop))


def checked_address(address: str) -> str:
    """Returns the argument ``workers``; raises a ValueError if it is no address such as ``"tcp://head:8786"``."""
    protocol, separator, host = address.partition("://")
    if not (protocol and separator and host):
        raise ValueError(f'workers must be an integer or an address such as "tcp://head:8786", not {given(address)}')
    return address


def checked_workers(workers: Any, devices: str | None) -> int | str | LocalWorkers:
    """Returns a number of processes, by default that of the devices, or the address of a scheduler, or processes.

    Raises TypeError or ValueError if it is neither, less than the devices, or of a cluster that is to use several.
    """
    count = len(device_names(devices))
    if isinstance(workers, LocalWorkers):
        return workers
    if not isinstance(workers, str):
        return checked_integer(count if workers is None else workers, "workers", count)
    if count > 1:
        raise ValueError(
            f"workers: a cluster takes one device, such as cuda, of which each worker has its own: {devices}"
        )
    return checked_address(workers)


def device_of_cluster(address: str, name: str | None) -> str:
    """Returns the name of the Warp device that a worker of a cluster uses, given the requested one.

    Raises errors of :class:`Cluster`, and a ValueError if a worker has no such device.
    """
    with contextlib.closing(Cluster(str(checked_workers(address, name)))) as cluster:
        return cluster.result(cluster.submit(name_device, name))


@dataclass
class WorkerCall:
    """A call of a function in a worker.

    Attributes:
        activity: What the worker does, in words, such as "checked time 0 to 8".
        function: The function.
        arguments: Its arguments.
        future: Future of its result, None before it is submitted.
        deaths: Number of workers that have died in this call.
    """

    activity: str
    function: Callable[..., Any]
    arguments: tuple
    future: Any = None
    deaths: int = 0

    def withdraw(self) -> None:
        """Cancels the call, so that it can be submitted again."""
        if self.future:
            self.future.cancel()
            self.future = None


def results_in_order(workers: Workers, calls: deque[WorkerCall]) -> Iterator[Any]:
    """Makes calls in workers and yields their results in order. A call whose worker dies is made again.

    Each call is removed when its result is there. Between two results, the caller may withdraw and change the remaining
    ones, and add others before them. Raises a ChildProcessError if worker after worker dies in the same call.
    """
    while calls:
        for call in islice(calls, 2 * workers.count):
            call.future = call.future or workers.submit(call.function, *call.arguments)
        call = calls[0]
        try:
            result = workers.result(call.future)
        except workers.died as error:
            call.future = None
            call.deaths += 1
            if call.deaths == workers.attempts:
                raise ChildProcessError(f"worker after worker died while it {call.activity}: out of memory?") from error
            continue
        calls.popleft()
        yield result


def _chunk_call(scene: Scene, job: bytes, first: int, stop: int) -> WorkerCall:
    """Returns the call that checks a chunk."""
    activity = f"checked time {scene.times[first]:g} to {scene.times[stop]:g}"
    return WorkerCall(activity, check_chunk, (job, first, stop))


def cut_in_chunks(scene: Scene, first: int, worker_count: int) -> Iterator[tuple[int, int]]:
    """Yields the chunks: the first interval and the one after the last of each."""
    position_bytes = max(1, 3 * scene.vertex_count * scene.dtype.itemsize)
    left, most = len(scene) - first, max(1, min(_MOST_INTERVALS, _CHUNK_BYTES // position_bytes))
    each = min(_CHUNKS_EACH, max(1, left // (_FEWEST * worker_count)))
    count = min(left, max(each * worker_count, -(-left // most)))
    for number in range(count):
        yield first + left * number // count, first + left * (number + 1) // count
