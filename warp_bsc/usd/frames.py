"""The part of a scene's time that is checked."""

import math
from dataclasses import dataclass

from .._arguments import checked_number


@dataclass(frozen=True)
class FrameRange:
    """A part of a scene's time; one time, at which the scene is checked at rest, if the start is the end.

    Attributes:
        start: First time code, None for that of the scene.
        end: Last time code, None for that of the scene.
        step: Time codes from one time to the next, more than 0, None for the samples that the scene has.

    Raises:
        TypeError: If one of them is not a number.
        ValueError: If one of them is not finite, the end is before the start, or the step is not more than 0.
    """

    start: float | None = None
    end: float | None = None
    step: float | None = None

    def __post_init__(self):
        """Checks the attributes."""
        for name in ("start", "end", "step"):
            value = getattr(self, name)
            if value is not None:
                limits = {"minimum": 0.0, "above": True} if name == "step" else {}
                object.__setattr__(self, name, checked_number(value, name, **limits))
        if self.start is not None and self.end is not None and self.end < self.start:
            raise ValueError(f"end must not be before the start, {self.start:g}, as {self.end:g} is")

    def bounds(self, samples: list[float]) -> tuple[float, float]:
        """Returns the first and the last time, given all times of the scene, ascending."""
        return (
            samples[0] if self.start is None else max(self.start, samples[0]),
            samples[-1] if self.end is None else min(self.end, samples[-1]),
        )

    def times(self, samples: list[float], changes: set[float]) -> list[float]:
        """Returns the times of this part, ascending, at least one.

        Args:
            samples: All times of the scene, ascending.
            changes: Times at which meshes change their topology, appear or vanish; steps never pass over these.

        Raises:
            ValueError: If there are none.
        """
        start = samples[0] if self.start is None else self.start
        end = samples[-1] if self.end is None else self.end
        low, high = self.bounds(samples)
        if self.step is None:
            times = {low, high, *samples}
        else:
            first, last = math.ceil((low - start) / self.step), math.floor((high - start) / self.step + 1e-9)
            times = {*(min(start + number * self.step, high) for number in range(first, last + 1)), *changes}
        times = sorted(time for time in times if low <= time <= high)
        if not times:
            raise ValueError(
                f"frames: no motion from time {start:g} to {end:g}; the scene moves from {samples[0]:g} to "
                f"{samples[-1]:g}"
            )
        return times
