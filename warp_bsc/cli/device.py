"""Finds the Warp device and loads kernels, with a message if they are compiled."""

import contextlib
import time
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt
import rich.console
import warp as wp

from ..detection.at_rest.proximities import ProximityFinder
from ..detection.detector import CollisionDetector
from ..detection.mesh import CollisionMesh
from ..detection.run import start
from ..detection.run.compilation import duration, reported_to
from ..detection.run.settings import Method
from .progress import LOG_SECONDS
from .tables import Console, say

_SILENT_SECONDS = 2.0


def find_device(name: str | None) -> wp.Device:
    """Returns the Warp device of a name, Warp's preferred one for None.

    Raises:
        ValueError: If there is no such device.
    """
    try:
        return start.find_device(name)
    except ValueError as error:
        raise ValueError(f"--device {error}") from None


def find_devices(names: str | None) -> list[wp.Device]:
    """Returns the Warp devices whose names have commas between them; errors are those of :func:`find_device`."""
    return [find_device(name) for name in start.device_names(names)]


@contextlib.contextmanager
def loading_kernels(device: wp.DeviceLike, console: rich.console.Console | None = None) -> Iterator[None]:
    """Prints a message if kernels are compiled in the block for more than two seconds, and then how many have been.

    A console may be that of a bar that shows progress; None is standard error.
    """
    console = Console(stderr=True) if console is None else console
    times = []  # of the compilations
    due = _SILENT_SECONDS

    def report() -> None:
        nonlocal due
        times.append(time.monotonic())
        seconds = times[-1] - times[0]
        if seconds > due:
            if due == _SILENT_SECONDS:
                needed = duration(wp.get_device(device).is_cpu)
                say(console, f"Compiling kernels for {device}, once for each version: {needed}.")
            else:
                say(console, f"Compiling kernels: {len(times) - 1} modules in {seconds:.0f} s.")
            due = seconds + LOG_SECONDS

    with reported_to(report):
        yield


def load_detector(
    method: Method,
    dtype: npt.DTypeLike,
    device: wp.Device,
    *,
    intersections: bool = False,
    proximities: bool = False,
    strands: bool = False,
) -> None:
    """Loads the detector's kernels for a type of positions, float32 or float64, which may compile them.

    Those that find intersections and proximities are loaded where asked for, and so are those for curves and points.
    """
    triangles = CollisionMesh(np.arange(6).reshape(2, 3), 6, device=device)
    points = np.zeros((6, 3), dtype)
    detector = CollisionDetector(triangles, method=method)
    detector.detect(points, points)
    if strands:
        face, edges, point = np.array([[0, 1, 2]]), np.array([[3, 4]]), np.array([5])
        rope = CollisionMesh(face, 6, edges=edges, points=point, radius=1.0, device=device)
        CollisionDetector(rope, method=method).detect(points, points)
    if intersections:
        detector.find_intersections(points)
    if proximities:
        ProximityFinder(triangles, 1.0).find(points)
