"""The motion of a scene from one of its times to the next, and what reading it reveals, in notes and warnings."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from .segment import Segment
from .turns import Turn

_LEFT_OUT = "left out: {}".format
_NAMED = 5  # largest number of parts left out, and of messages, in the warnings


@dataclass(frozen=True)
class LeftOutMesh:
    """A mesh that is left out of some intervals, because it cannot be read.

    Attributes:
        name: Its name.
        since: Number of the first interval without it.
        until: Number of the interval after the last one without it.
        reason: Why and when, a sentence.
    """

    name: str
    since: int
    until: int
    reason: str


@dataclass(frozen=True)
class ReadingNotes:
    """The left-out meshes, messages and jumps that reading an interval revealed.

    Attributes:
        left_out: The meshes left out of this interval or later ones.
        messages: Messages that are new, as of :class:`ReadingRecord`.
        jumps: Names of the meshes that do not start where the previous interval ended.
    """

    left_out: tuple[LeftOutMesh, ...] = ()
    messages: tuple[str, ...] = ()
    jumps: tuple[str, ...] = ()


class ReadingRecord:
    """What reading a scene has revealed so far.

    Attributes:
        parts: The meshes left out after the file was opened.
        messages: Sentences with messages of OpenUSD, and on the first mesh that turns off straight paths and arcs.
        welded: Largest number of welded vertices of a segment.
    """

    def __init__(self):
        self.parts: list[LeftOutMesh] = []
        self.messages: list[str] = []
        self.welded = 0
        self._jump_times: dict[str, set[float]] = {}  # by the mesh's name
        self._noted = 0, 0  # numbers of parts and of messages that notes contain

    def add_jumps(self, names: tuple[str, ...], time: float) -> None:
        """Adds the names of meshes that jump at a time."""
        for name in names:
            self._jump_times.setdefault(name, set()).add(time)

    def take(self, jumps: tuple[str, ...]) -> ReadingNotes:
        """Returns the notes since the last call, and given jumps."""
        parts, messages = self._noted
        self._noted = len(self.parts), len(self.messages)
        return ReadingNotes(tuple(self.parts[parts:]), tuple(self.messages[messages:]), jumps)

    def warnings(self, reasons: list[str], missing: list[str], others: list[str]) -> list[str]:
        """Returns sentences on all of it, and of what is too much the number.

        Args:
            reasons: Parts left out and why, a sentence each.
            missing: Parts that are missing and allowed to be, a sentence each.
            others: Sentences on unread contents and on changes to the motion.
        """
        sentences = [*map(_LEFT_OUT, reasons[:_NAMED])]
        if len(reasons) > _NAMED:
            sentences.append(f"left out: {len(reasons) - _NAMED} more, {len(reasons)} in all")
        sentences += self.messages[:_NAMED]
        sentences += missing[:_NAMED]
        if len(missing) > _NAMED:
            sentences.append(f"missing: {len(missing) - _NAMED} more, {len(missing)} in all")
        sentences += others
        sentences += (jump_warning(name, sorted(times)) for name, times in self._jump_times.items())
        if self.welded:
            sentences.append(f"vertices with the same position at all times were welded: {self.welded}")
        return sentences


@dataclass(frozen=True)
class Interval:
    """The motion of a scene from one of its times to the next: straight, but for the meshes that turn.

    An interval that starts and ends at one time is without motion: at the only time that is checked, or at the last one
    if meshes jump, appear, vanish or change their topology there.

    Attributes:
        index: Number of the interval, from 0.
        start: Time code at which it starts.
        end: Time code at which it ends.
        segment: The meshes that are present.
        x0: Positions of their vertices at the start, in world space and the scene's unit of length, float32 or float64,
            shape [vertex_count, 3].
        x1: Their positions at the end; where a mesh jumps at that time, those before the jump.
        is_joined: Whether the next interval surely starts where this one ends, with the same meshes. False for the last
            interval, and where a mesh may jump at the end.
        notes: The left-out meshes, messages and jumps that reading it revealed.
        tet_positions: Positions of the vertices of ``segment.tetrahedra`` at the start, and at the end.
        turns: The turns of meshes at a constant rate, by their indices in ``segment.meshes``.
    """

    index: int
    start: float
    end: float
    segment: Segment
    x0: np.ndarray = field(repr=False)
    x1: np.ndarray = field(repr=False)
    is_joined: bool
    notes: ReadingNotes
    tet_positions: tuple[np.ndarray, np.ndarray] = field(repr=False)
    turns: dict[int, Turn] = field(default_factory=dict)

    @property
    def is_at_rest(self) -> bool:
        """Whether it is without motion."""
        return self.start == self.end

    @property
    def jumps(self) -> tuple[str, ...]:
        """Names of the meshes that do not start where the previous interval ended.

        Empty unless that interval was the last one read, or intervals are read in order.
        """
        return self.notes.jumps

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences on the parts left out, messages of OpenUSD and jumps that reading this interval revealed."""
        return (
            *(_LEFT_OUT(part.reason) for part in self.notes.left_out),
            *self.notes.messages,
            *(jump_warning(name, [self.start]) for name in self.jumps),
        )


def positions_of(intervals: Sequence[Interval]) -> tuple[np.ndarray, np.ndarray]:
    """Returns the positions at the starts of intervals of one segment, one after the other, and those at the ends."""
    if len(intervals) == 1:
        return intervals[0].x0, intervals[0].x1
    return np.concatenate([at.x0 for at in intervals]), np.concatenate([at.x1 for at in intervals])


def jump_warning(name: str, times: Iterable[float]) -> str:
    """Returns the warning that a mesh jumps, given its name and the times."""
    return f"{name} jumps {times_in_words(times)}: what it jumps through is not checked"


def times_in_words(times: Iterable[float]) -> str:
    """Returns one or more times, ascending, in words."""
    times = list(times)
    return f"at time {times[0]:g}" if len(times) == 1 else f"{len(times)} times, first at time {times[0]:g}"
