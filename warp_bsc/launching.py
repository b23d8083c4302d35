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


@functools.cache
def _load(kernel):
    """Compiles a kernel, which several threads must not try at once."""
    kernel.module.load("cpu")


def launch_over(kernel, count, *, inputs, outputs, device, block_dim=256, chunk=1024):
    """Launches a kernel over ``count`` entries, on all cores where the device is the CPU.

    The kernel's first argument is the entry at which its part starts: ``i = first + wp.tid()``. Small blocks of threads
    suit kernels of which few threads work long; a chunk, at least so large, is what a core takes at a time.
    """
    if device.is_cuda:
        inputs = [0, *inputs]
        wp.launch(kernel, count, inputs=inputs, outputs=outputs, device=device, block_dim=block_dim, record_tape=False)
        return
    threads = _threads.get()
    chunk = max(chunk, -(-count // (8 * threads if threads > 1 else 1)))

    def launch(first):
        dim = min(chunk, count - first)
        wp.launch(kernel, dim, inputs=[first, *inputs], outputs=outputs, device=device, record_tape=False)

    starts = range(0, count, chunk)
    if len(starts) < 2:
        for first in starts:
            launch(first)
    else:
        _load(kernel)
        list(_pool().map(launch, starts))


def launch_over_queue(kernel, queue, counts, count, *, inputs, outputs, block_dim=256):
    """Launches a kernel over a queue: as far as it is filled on the CPU, over all of it on a GPU, without asking."""
    device = queue.device
    entries = len(queue)
    if device.is_cpu:
        entries = min(entries, int(counts.numpy()[count]))
    launch_over(kernel, entries, inputs=inputs, outputs=outputs, device=device, block_dim=block_dim)
