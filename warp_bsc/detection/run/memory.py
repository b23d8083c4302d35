"""Says what did not fit where the memory of a device is short, and what needs less."""

import functools
import linecache
import math
import os
import re
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import warp as wp

from ..._private_names.of_warp import replace_allocation

_PACKAGE = Path(__file__).parents[2]


class DeviceMemoryError(MemoryError, RuntimeError):
    """The memory of a device does not suffice. What was called is as before, and can be called again."""


def _explain(device: wp.Device, shape: tuple[int, ...], dtype: Any) -> DeviceMemoryError | None:
    """Returns the error of an array for which there is no memory, None if nothing in this package allocates it."""
    stack = [(Path(frame.f_code.co_filename), frame.f_code.co_qualname, at) for frame, at in traceback.walk_stack(None)]
    places = [place for place in stack if _PACKAGE in place[0].parents and place[0] != Path(__file__)]
    if not places:
        return None
    file, function, line = next((place for place in places if "." in place[1].partition(".<locals>")[0]), places[0])
    function = function.partition(".<locals>")[0]
    called = [name.removesuffix(".__init__") for path, name, _ in places if path.parent.name != "cli"]
    public = [name for name in called if not re.search(r"(^|\.)[_<]", name)]
    target, is_assignment, _ = linecache.getline(str(file), line).strip().partition(" = ")
    count, size = math.prod(shape), wp.types.type_size_in_bytes(dtype)
    free = device.free_memory if device.is_cuda else 0
    if device.is_cpu and "SC_AVPHYS_PAGES" in getattr(os, "sysconf_names", {}):
        free = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    left = f"; {free / 1e6:,.6g} MB are free, enough for {free // size:,}" if free else ""
    name = f"{target} in {function}" if is_assignment else function
    return DeviceMemoryError(
        f"out of memory on {device}: {[function, *public][-1]} needs {count * size / 1e6:,.6g} MB for {name} "
        f"({file.name}:{line}), {count:,} of {dtype.__name__}{left}. Less is needed by fewer worlds, a part of the "
        "mesh at a time, a smaller distance, or fewer processes on a device"
    )


def _explained(allocate: Callable[..., None]) -> Callable[..., None]:
    """Returns Warp's function that allocates an array with another error where there is no memory."""

    @functools.wraps(allocate)
    def explained(self: wp.array, dtype: Any, shape: tuple[int, ...], strides: Any, device: Any, pinned: bool) -> None:
        try:
            allocate(self, dtype, shape, strides, device, pinned)
        except (RuntimeError, MemoryError) as error:
            is_short = isinstance(error, MemoryError) or str(error).startswith("Failed to allocate")
            if is_short and (explanation := _explain(wp.get_device(device), shape, dtype)):
                raise explanation from error
            raise

    return explained


replace_allocation(_explained)
