"""The motion of a scene from one of its times to the next."""

from dataclasses import dataclass, field

import numpy as np

from .segment import Segment

__all__ = ["Interval"]


@dataclass(frozen=True)
class Interval:
    """The motion of a scene from one of its times to the next, in which every vertex moves straight.

    Attributes:
        index: Number of the interval, from 0.
        start: Time code at which it starts.
        end: Time code at which it ends.
        segment: The meshes that are there.
        x0: Positions of their vertices at the start, in world space and the scene's unit of length, float32 or float64,
            shape [vertex_count, 3].
        x1: The same at the end; where a mesh jumps at that time, before the jump.
        jumps: Names of the meshes that do not start where the interval before ended. Empty unless that interval was the
            last one read.
        warnings: What reading this interval revealed, a sentence each: parts left out, messages of OpenUSD, jumps.
    """

    index: int
    start: float
    end: float
    segment: Segment
    x0: np.ndarray = field(repr=False)
    x1: np.ndarray = field(repr=False)
    jumps: tuple[str, ...]
    warnings: tuple[str, ...]
