"""Says that kernels are compiled, and for how long, where they are not in Warp's cache."""

import contextlib
import functools
from collections.abc import Callable, Iterator

import warp as wp

from ..._private_names.of_warp import on_compilation

_listeners: list[Callable[[], None]] = []


@contextlib.contextmanager
def reported_to(listener: Callable[[], None]) -> Iterator[None]:
    """Has a function called before each compilation of a module of kernels of this package in the block."""
    _listeners.append(listener)
    try:
        yield
    finally:
        _listeners.remove(listener)


def duration(is_cpu: bool) -> str:
    """Returns about how long the compilation of all kernels of a replay or of a solver takes, in words."""
    return "half a minute of processor time, two minutes for a solver" if is_cpu else "up to a few minutes"


@functools.cache
def say_compiling(is_cpu: bool) -> None:
    """Prints, once for each kind of device, that kernels are compiled, how long it takes, and where they are kept."""
    device = "the CPU" if is_cpu else "the GPU"
    print(
        f"warp-bsc: compiling kernels for {device}, once for each version: {duration(is_cpu)}. "
        f"They are kept in {wp.config.kernel_cache_dir}"
    )


def report_compilation(is_cpu: bool) -> None:
    """Prints one line in each process, where Warp prints one for each module that it loads, and tells listeners."""
    if wp.config.log_level <= wp.LOG_INFO:
        say_compiling(is_cpu)
    for listener in _listeners:
        listener()


on_compilation(report_compilation)
