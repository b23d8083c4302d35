"""The options of a scene and the results of reading it with which another process opens it again."""

from dataclasses import dataclass, field

import numpy as np

from .frames import FrameRange
from .interval import LeftOutMesh
from .selection import Selection

__all__ = ["Revealed", "SceneOptions"]


@dataclass(frozen=True)
class SceneOptions:
    """The options with which a scene is opened, the arguments of :class:`~warp_bsc.usd.scene.Scene`."""

    selection: Selection | None
    frames: FrameRange | None
    subdivide: int
    sample_turns: bool
    strict: bool
    allow_missing: tuple[str, ...]


@dataclass(frozen=True)
class Revealed:
    """The meshes left out while reading a scene, and the welds of its segments by their span of intervals."""

    left_out: tuple[LeftOutMesh, ...] = ()
    welds: dict[tuple[int, int], tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)
