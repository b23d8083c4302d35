"""Starts Warp without messages on standard error, and finds its devices."""

import os
import sys

import warp as wp

from ..._arguments import check_instance


def start_warp() -> None:
    """Initializes Warp without the line that its native library prints to standard error if there is no CUDA driver."""
    wp.config.log_level = wp.LOG_WARNING
    sys.stderr.flush()
    stderr = os.dup(2)
    try:
        with open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), 2)
            wp.init()
    finally:
        os.dup2(stderr, 2)
        os.close(stderr)


def checked_device(device: wp.DeviceLike) -> wp.Device:
    """Returns a Warp device; Warp's default for None.

    Raises:
        TypeError: If it is neither a device nor the name of one.
        ValueError: If the device does not exist.
    """
    if device is not None:
        check_instance(device, "device", (str, wp.Device), "a Warp device or its name")
    try:
        return wp.get_device(device)
    except (RuntimeError, ValueError) as error:
        raise ValueError(f"device must be one of this machine, not {device!r}: {error}") from None


def device_names(names: str | None) -> list:
    """Returns the names of devices between commas; None for Warp's default."""
    return [None] if names is None else names.split(",")


def find_device(name: str | None) -> wp.Device:
    """Returns the Warp device of a name, Warp's preferred one for None.

    Raises:
        ValueError: If the device does not exist.
    """
    start_warp()
    if name is None:
        return wp.get_preferred_device()
    known = [device.alias for device in wp.get_devices()] + ["cuda"] * wp.is_cuda_available()
    if name not in known:
        raise ValueError(f"{name}: there is no such device here, only {', '.join(known)}")
    return wp.get_device(name)


def gpu_count() -> int:
    """Returns the number of GPUs of this machine that Warp can use."""
    start_warp()
    return wp.get_cuda_device_count()
