"""Launches over the entries of a queue, of which only the device knows how many there are; on no tape."""

import contextlib
import contextvars
import functools
import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import warp as wp

__all__ = ["launch_over", "launch_over_queue", "one_core"]

_THREADS = os.cpu_count() or 1

_threads = contextvars.ContextVar("threads", default=_THREADS)


@contextlib.contextmanager
def one_core() -> Iterator[None]:
    """Keeps launches on the CPU that are made within to the thread that makes them."""
    token = _threads.set(1)
    try:
        yield
    finally:
        _threads.reset(token)


@functools.cache
def _pool():
    """Threads for the CPU: Warp runs a kernel on one, but lets others run meanwhile."""
    return ThreadPoolExecutor(_THREADS)


def _may_share(kernel) -> bool:
    """Whether several threads may run a kernel at once.

    Warp's kernels on a CPU share a pointer to the stack of the thread that set it last, for their tiles. A kernel
    without tiles does not follow it, once it is optimized.
    """
    options = kernel.module.options
    mode, level = options["mode"] or wp.config.mode, options["optimization_level"]
    level = wp.config.optimization_level if level is None else level
    return mode == "release" and level != 0


def launch_over(kernel, count, *, inputs, outputs, device, block_dim=256, chunk=1024):
    """Launches a kernel over ``count`` entries, on all cores where the device is the CPU.

    The kernel's first argument is the entry at which its part starts: ``i = first + wp.tid()``. Small blocks of threads
    suit kernels of which few threads work long; a chunk, at least so large, is what a core takes at a time.

    Raises:
        RuntimeError: If the CPU captures a graph: it would hold the count of now, see :mod:`.host_function`.
    """
    if device.is_cuda:
        inputs = [0, *inputs]
        wp.launch(kernel, count, inputs=inputs, outputs=outputs, device=device, block_dim=block_dim, record_tape=False)
        return
    if device.is_capturing:
        raise RuntimeError("a graph on the CPU cannot capture this, as the host reads results between launches")
    threads = _threads.get() if _may_share(kernel) else 1
    chunk = max(chunk, -(-count // (8 * threads if threads > 1 else 1)))
    # Threads only run what this one has prepared: Warp loads a kernel and packs its arguments for one thread at a time.
    options = {"outputs": outputs, "device": device, "record_tape": False, "record_cmd": True}
    commands = [
        wp.launch(kernel, min(chunk, count - first), inputs=[first, *inputs], **options)
        for first in range(0, count, chunk)
    ]
    run = map if len(commands) < 2 else _pool().map
    list(run(wp.Launch.launch, commands))


def launch_over_queue(kernel, queue, counts, count, *, inputs, outputs, block_dim=256):
    """Launches a kernel over a queue: as far as it is filled on the CPU, over all of it on a GPU, without asking."""
    device = queue.device
    entries = len(queue)
    if device.is_cpu:
        entries = min(entries, int(counts.numpy()[count]))
    launch_over(kernel, entries, inputs=inputs, outputs=outputs, device=device, block_dim=block_dim)
