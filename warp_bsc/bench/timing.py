"""Measures times: medians of repetitions, replays of CUDA graphs, and a limit on the CPU cores."""

import contextlib
import os
import statistics
import time
from collections.abc import Callable, Iterator

import warp as wp


def median_milliseconds(run: Callable[[], None], device: wp.Device, repeat: int) -> float:
    """Returns the median time of a run [ms]: on a GPU of a replay of it as a CUDA graph, on the CPU of a call.

    A first run, which loads the kernels, is not timed.
    """
    run()
    if device.is_cuda:
        with wp.ScopedCapture(device) as capture:
            run()
        assert capture.graph
        return replay_graph(capture.graph, device, replays=repeat)
    seconds = []
    for _ in range(repeat):
        start = time.perf_counter()
        run()
        seconds.append(time.perf_counter() - start)
    return 1e3 * statistics.median(seconds)


def replay_graph(graph: wp.Graph, device: wp.Device, *, replays: int) -> float:
    """Returns the median time of a replay of a CUDA graph [ms], measured by events; a first replay is not timed."""
    stream = wp.get_stream(device)
    wp.capture_launch(graph)
    milliseconds = []
    for _ in range(replays):
        start, end = (wp.Event(device, enable_timing=True) for _ in range(2))
        stream.record_event(start)
        wp.capture_launch(graph)
        stream.record_event(end)
        milliseconds.append(wp.get_event_elapsed_time(start, end))
    return statistics.median(milliseconds)


@contextlib.contextmanager
def limited_threads(count: int | None) -> Iterator[None]:
    """Limits the threads that the block starts to a number of cores; None sets no limit.

    Raises:
        ValueError: If there are fewer cores, or the system cannot limit threads.
    """
    if count is None:
        yield
        return
    if not hasattr(os, "sched_setaffinity"):
        raise ValueError("this system cannot limit the number of threads")
    available = os.sched_getaffinity(0)
    if not 1 <= count <= len(available):
        raise ValueError(f"the number of threads must be in [1, {len(available)}], not {count}")
    os.sched_setaffinity(0, sorted(available)[:count])
    try:
        yield
    finally:
        os.sched_setaffinity(0, available)
