"""The options of a scene, with which another process opens it again."""

from dataclasses import dataclass

from .._arguments import check_instance, checked_flag, checked_integer, checked_strings
from .frames import FrameRange
from .selection import Selection

_MOST_PARTS = 10_000  # of a step between two times


class EmptySceneError(ValueError):
    """A scene can be read, and has no visible mesh, or none that is selected."""


@dataclass(frozen=True)
class SceneOptions:
    """The options with which a scene is opened, the arguments of :class:`~warp_bsc.usd.scene.Scene`."""

    selection: Selection | None
    frames: FrameRange | None
    subdivide: int
    sample_turns: bool
    strict: bool
    allow_missing: tuple[str, ...]

    @classmethod
    def of(cls, selection, frames, subdivide, sample_turns, strict, allow_missing) -> "SceneOptions":
        """Returns the options of arguments, with errors as of :class:`~warp_bsc.usd.scene.Scene`."""
        if selection is not None:
            check_instance(selection, "selection", Selection, "a Selection")
        if frames is not None:
            check_instance(frames, "frames", FrameRange, "a FrameRange")
        return cls(
            selection,
            frames,
            checked_integer(subdivide, "subdivide", 1, _MOST_PARTS),
            checked_flag(sample_turns, "sample_turns"),
            checked_flag(strict, "strict"),
            checked_strings(allow_missing, "allow_missing"),
        )
