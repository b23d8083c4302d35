"""Times of the phases of a detection."""

import contextlib
import itertools
import time
from collections.abc import Iterator
from typing import Any

import warp as wp


class PhaseTimer:
    """Measures phases that follow one another: by events on a GPU, without synchronizing, else by the clock.

    A phase lasts from the end of the phase before to its own. While a graph is captured nothing is measured.
    """

    def __init__(self, device: wp.Device | None):
        """Starts the first phase, on the device's current stream; without a device nothing is ever measured."""
        self._device = device
        self._ends: list[tuple[str, Any]] = []
        self.others: list[PhaseTimer] = []  # whose times are added
        self._start = None if self._is_idle() else self._now()

    @contextlib.contextmanager
    def phase(self, name: str) -> Iterator[None]:
        """Adds the time until the end of the context to a phase."""
        yield
        if not self._is_idle():
            self._ends.append((name, self._now()))

    def read(self) -> dict[str, float]:
        """Returns the time by phase [ms]; waits for the end of the last on a GPU."""
        milliseconds: dict[str, float] = {}
        start = self._start
        for name, end in self._ends:
            passed = wp.get_event_elapsed_time(start, end) if isinstance(end, wp.Event) else 1000.0 * (end - start)
            milliseconds[name] = milliseconds.get(name, 0.0) + passed
            start = end
        for name, passed in itertools.chain(*(other.read().items() for other in self.others)):
            milliseconds[name] = milliseconds.get(name, 0.0) + passed
        return milliseconds

    def _is_idle(self) -> bool:
        return self._device is None or self._device.is_capturing

    def _now(self) -> Any:  # wp.Event, or seconds
        assert self._device is not None  # else it is idle
        if not self._device.is_cuda:
            return time.perf_counter()
        event = wp.Event(self._device, enable_timing=True)
        wp.get_stream(self._device).record_event(event)
        return event
