"""Says what did not fit where the memory of a device is short, and what needs less."""

import linecache
import math
import os
import re
import traceback
from pathlib import Path

import warp as wp

from ..._private_names.of_warp import on_failed_allocation

_PACKAGE = Path(__file__).parents[2]


class DeviceMemoryError(MemoryError, RuntimeError):
    """The memory of a device does not suffice. The message names the array, its size, what is free, and what needs less.

    The call that raises it leaves states, reports and buffers as they were before it, and succeeds once there is memory.
    """


def _free_bytes(device: wp.Device) -> int:
    """Returns the free memory of a device, 0 if that is not known."""
    if device.is_cuda:
        return device.free_memory
    try:
        return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):  # not on Linux
        return 0


def _amount(size: float) -> str:
    """Returns a number of bytes in words."""
    for unit in ("bytes", "kB", "MB"):
        if size < 1000.0:
            return f"{size:.3g} {unit}"
        size /= 1000.0
    return f"{size:,.4g} GB"


def explain(device: wp.Device, shape: tuple[int, ...], dtype: type) -> DeviceMemoryError | None:
    """Returns the error of an array that could not be allocated, None if nothing in this package allocates it."""
    stack = [
        (Path(frame.f_code.co_filename), frame.f_code.co_qualname, line) for frame, line in traceback.walk_stack(None)
    ]
    own = [
        place for place in stack if _PACKAGE in place[0].parents and place[0].name not in ("memory.py", "of_warp.py")
    ]
    if not own:
        return None
    file, function, line = own[0][0], own[0][1].partition(".<locals>")[0], own[0][2]
    called = [name for path, name, _ in own if "cli" not in path.parts and not re.search(r"(^|\.)[_<]", name)]
    target, is_assignment, _ = linecache.getline(str(file), line).strip().partition(" = ")
    count, free = math.prod(shape), _free_bytes(device)
    size = count * wp.types.type_size_in_bytes(dtype)
    fits = f", enough for {count * free // size:,}" if free < size else ""
    return DeviceMemoryError(
        f"out of memory on {device}: {[function, *called][-1]} needs {_amount(size)} for "
        f"{f'{target} of ' if is_assignment else ''}{function} ({file.name}:{line}), {count:,} of "
        f"{wp.types.type_repr(dtype)}{f'; {_amount(free)} are free{fits}' if free else ''}. Less is needed by fewer worlds, "
        "a part of the mesh at a time, a smaller distance, or fewer processes on the device"
    )


on_failed_allocation(explain)
