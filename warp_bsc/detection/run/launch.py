"""Launches in any thread, over queues whose length is on the device, repeated until the buffers suffice.

The process crashes where Warp loads one module in two threads at once, or two modules of one name, such as those of a
kernel that was made twice. Here, one lock is held while a kernel is made, and while it is launched first.
"""

import contextlib
import contextvars
import copy
import functools
import os
import threading
import weakref
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, ParamSpec, Protocol, TypeVar

import warp as wp

from ..._private_names.of_warp import may_run_in_threads
from . import compilation, memory  # noqa: F401 (both say so: where kernels are compiled, where memory is short)

THREADS_OF_MULTIPROCESSOR = 1024
"""Threads of a launch over a queue for each multiprocessor of a GPU."""

_threads: contextvars.ContextVar[int] = contextvars.ContextVar("threads")

_KERNELS = threading.RLock()
"""Held while a kernel is made or loaded."""

_loaded: weakref.WeakKeyDictionary[wp.Kernel, set[tuple[str, int]]] = weakref.WeakKeyDictionary()
"""Devices and thread block sizes for which a kernel has been launched; 0 for the default size, as on the CPU."""

Launch = tuple[wp.Kernel, int, list, list]
"""A kernel with its number of threads, its inputs, without the first where a part starts, and its outputs."""

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")


def made_once(make: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Returns a function that makes kernels as the given one does, once for the same arguments, in any thread."""
    cached = functools.cache(make)

    @functools.wraps(make)
    def get(*arguments: _Arguments.args, **options: _Arguments.kwargs) -> _Result:
        with _KERNELS:
            return cached(*arguments, **options)

    return get


@contextlib.contextmanager
def _loading(kernel: wp.Kernel, device: wp.Device, block_dim: int) -> Iterator[None]:
    """Keeps other threads from loading kernels in the context, if this kernel is not loaded."""
    key, loaded = (device.alias, block_dim), _loaded.setdefault(kernel, set())
    if key in loaded:
        yield
        return
    with _KERNELS:
        yield
    loaded.add(key)


def launch(kernel: wp.Kernel, dim: int | tuple[int, ...], *, device: wp.DeviceLike, **options: Any) -> None:
    """Launches a kernel as :func:`warp.launch` does, from any thread; does nothing for a dimension of 0."""
    device = wp.get_device(device)
    if dim:
        with _loading(kernel, device, options.get("block_dim", 0)):
            wp.launch(kernel, dim, device=device, **options)


def launch_in_turn(kernel: wp.Kernel, dim: int, times: int, *, inputs: list, values: list[wp.array]) -> wp.array:
    """Launches a kernel several times, each time from the results of the time before, and returns the last ones.

    Args:
        kernel: The kernel, whose last input is an array and whose only output is one like it.
        dim: Number of threads; with 0, nothing is launched.
        times: Number of launches.
        inputs: The inputs before that array.
        values: Two arrays, of which the first is the input of the first launch; both are overwritten.
    """
    there_and_back = [(kernel, dim, [*inputs, before], [after]) for before, after in (values, values[::-1])]
    launch_repeatedly(there_and_back, times // 2, device=values[0].device)
    launch_repeatedly(there_and_back[:1], times % 2, device=values[0].device)
    return values[times % 2 if dim else 0]


def launch_repeatedly(kernels: Sequence[Launch], times: int, *, device: wp.DeviceLike) -> None:
    """Launches kernels one after the other, several times.

    Args:
        kernels: The kernels, with all of their inputs.
        times: How often to launch all.
        device: The device of their arrays.
    """
    device = wp.get_device(device)
    commands = [_command(*arguments, device) for arguments in kernels if arguments[1]]
    for _ in range(times):
        for command in commands:
            command.launch()


def count_cores() -> int:
    """Returns the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextlib.contextmanager
def cores(count: int) -> Iterator[None]:
    """Limits launches on the CPU to ``count`` threads in the context; if 1, to the thread that launches."""
    token = _threads.set(count)
    try:
        yield
    finally:
        _threads.reset(token)


@functools.cache
def thread_pool(threads: int) -> ThreadPoolExecutor:
    """Returns threads for the CPU: Warp runs a kernel on one, and other threads run at the same time."""
    return ThreadPoolExecutor(threads)


def max_blocks(device: wp.Device, block_dim: int) -> int:
    """Returns the largest number of blocks of a launch over a queue, so that unused capacity takes next to no time.

    Warp's loop around a kernel takes their threads on to further entries. Up to four times the number that runs at once
    balances the work; more take time where the queue is empty.

    Args:
        device: The device.
        block_dim: Threads of a block.

    Returns:
        The number of blocks; 0, without a limit, for the CPU and where Warp is configured to make no loops. Versions
        without this configuration always make them.
    """
    if device.is_cpu or not getattr(wp.config, "default_grid_stride", True):
        return 0
    return device.sm_count * max(1, THREADS_OF_MULTIPROCESSOR // block_dim)


def launch_over(
    kernel: wp.Kernel,
    count: int,
    *,
    inputs: list,
    outputs: list,
    device: wp.Device,
    block_dim: int = 256,
    chunk: int = 1024,
    max_blocks: int = 0,
) -> None:
    """Launches a kernel over ``count`` entries, on all cores where the device is the CPU.

    The kernel's first argument is the entry at which its part starts: ``i = first + wp.tid()``. Small thread blocks
    suit kernels in which few threads work long. A core takes at least ``chunk`` entries at a time. At most
    ``max_blocks`` blocks run on a GPU, 0 for any number.

    Raises:
        RuntimeError: If the CPU captures a graph, which would keep the present count, see :mod:`.host_function`.
    """
    if device.is_cuda:
        options = {"max_blocks": max_blocks, "block_dim": block_dim, "record_tape": False}
        launch(kernel, count, inputs=[0, *inputs], outputs=outputs, device=device, **options)
        return
    launch_together([(kernel, count, inputs, outputs)], device=device, chunk=chunk)


def launch_together(kernels: Sequence[Launch], *, device: wp.Device, chunk: int = 1024) -> None:
    """Launches kernels on all cores of the CPU, as :func:`launch_over` one, in no order: no core waits between them."""
    if device.is_capturing:
        raise RuntimeError("a graph on the CPU cannot capture this, as the host reads results between launches")
    left = sum(count for _, count, _, _ in kernels)
    threads = min((cores_for(kernel, device) for kernel, *_ in kernels), default=1)
    parts = []
    for kernel, count, inputs, outputs in kernels:
        first, command = 0, _command(kernel, count, [0, *inputs], outputs, device) if count else None
        while first < count:
            # a share of what is left, so that the last parts are small, and all threads end at about the same time
            part = min(count - first, max(chunk, -(-left // (2 * threads if threads > 1 else 1))))
            parts.append((command, first, part))
            first, left = first + part, left - part
    _run(parts, threads)


def launch_on_cores(
    kernel: wp.Kernel, count: int, *, inputs: list, outputs: Sequence[Any] = (), device: wp.Device, block_dim: int = 256
) -> None:
    """Launches a kernel whose threads take numbers as they come on a CPU: on each core ``wp.tid()`` begins anew."""
    threads = cores_for(kernel, device)
    if device.is_cuda or min(threads, count) <= 1:
        launch(kernel, count, inputs=inputs, outputs=outputs, device=device, block_dim=block_dim)
        return
    command, part = _command(kernel, count, inputs, outputs, device), -(-count // (8 * threads))
    _run([(command, None, min(part, count - first)) for first in range(0, count, part)], threads)


def cores_for(kernel: wp.Kernel, device: wp.Device) -> int:
    """Returns how many cores of the CPU run a kernel at once: one while it captures a graph."""
    return _threads.get(count_cores()) if may_run_in_threads(kernel) and not device.is_capturing else 1


def _command(kernel: wp.Kernel, count: int, inputs: list, outputs: Sequence[Any], device: wp.Device) -> wp.Launch:
    """Returns a launch with its arguments packed, which takes longer than many a part of it."""
    with _loading(kernel, device, 0):
        return wp.launch(kernel, count, inputs, outputs, device=device, record_tape=False, record_cmd=True)


def _run(parts: Sequence[tuple[wp.Launch, int | None, int]], threads: int) -> None:
    """Runs parts of launches in this thread and, as soon as they are free, in others, so that short ones wait for none.

    The others only run commands: Warp cannot load a kernel and pack arrays in several threads at once. A part is a
    launch with its first argument there, None for that of all, and its number of threads.
    """
    waiting = iter(parts)

    def work() -> None:
        for whole, first, count in waiting:
            command = copy.copy(whole)
            command.params = list(command.params)
            if first is not None:
                command.set_param_at_index(0, first)
            command.set_dim(count)
            command.launch()

    others = [thread_pool(threads).submit(work) for _ in range(min(threads, len(parts)) - 1)]
    try:
        work()
    finally:
        for other in others:
            if not other.cancel():
                other.result()


def launch_over_queue(
    kernel: wp.Kernel, queue: wp.array, counts: wp.array, row: int, *, inputs: list, outputs: list, block_dim: int = 256
) -> None:
    """Launches a kernel over a queue: its filled entries on the CPU; its capacity on a GPU, without synchronizing.

    On a GPU a large capacity takes next to no time, see :func:`max_blocks`.

    Args:
        kernel: The kernel, with a first argument as for :func:`launch_over`.
        queue: The queue.
        counts: Counts of several queues, array of int64.
        row: Index of the queue's count in it.
        inputs: Arguments of the kernel after the first.
        outputs: The rest of its arguments.
        block_dim: Threads of a block on a GPU.
    """
    device = queue.device
    entries = len(queue)
    if device.is_cpu:
        entries = min(entries, int(counts.numpy()[row]))
    options = {"device": device, "block_dim": block_dim, "max_blocks": max_blocks(device, block_dim)}
    launch_over(kernel, entries, inputs=inputs, outputs=outputs, **options)


class GrowingBuffers(Protocol):
    """Buffers with counts on the device of the entries that they would have to hold."""

    def grow(self) -> bool:
        """Enlarges the buffers that were too small, and returns whether any was; synchronizes with the device."""
        ...


def retry_until_fits(launch: Callable[[], _Result], buffers: GrowingBuffers, device: wp.Device) -> _Result:
    """Launches until the buffers suffice, enlarging those that were too small; only once where a graph is captured.

    Args:
        launch: Launches everything that writes to the buffers, from the start.
        buffers: The buffers. In a graph they keep their capacities, and their counts show an overflow.
        device: The device.

    Returns:
        What the last call of ``launch`` returned.
    """
    while True:
        result = launch()
        if device.is_capturing or not buffers.grow():
            return result
