"""Finds the meshes that jump between two intervals of a scene."""

import numpy as np

from .segment import Segment

_JUMP = 1e-4  # a jump is more than this share of a mesh's way in an interval; merged times make smaller gaps
_ROUNDING = 1e-12


class JumpFinder:
    """Compares the positions at the start of each interval with those at the end of the one before."""

    def __init__(self):
        self._last: tuple[int, Segment, np.ndarray, np.ndarray] | None = None

    def has_read(self, index: int) -> bool:
        """Returns whether the last interval compared is the one of a number."""
        return self._last is not None and self._last[0] == index

    def end_of(self, index: int, segment: Segment) -> np.ndarray | None:
        """Returns the positions at the end of an interval of a segment, None if it is not the last one compared."""
        return self._last[3] if self._last and self._last[:2] == (index, segment) else None

    def forget(self) -> None:
        """Drops the last interval, so that nothing is compared with it."""
        self._last = None

    def find(self, index: int, segment: Segment, x0: np.ndarray, x1: np.ndarray) -> tuple[str, ...]:
        """Returns the names of the meshes that do not start an interval where they ended the one before.

        Args:
            index: Number of the interval. If the one before was not compared last, no mesh jumps.
            segment: Its segment.
            x0: Positions at its start, shape [vertex_count, 3].
            x1: Positions at its end.
        """
        last, self._last = self._last, (index, segment, x0, x1)
        if last is None or last[:2] != (index - 1, segment) or x0 is last[3] or np.array_equal(x0, last[3]):
            return ()
        _, _, last_x0, last_x1 = last
        gaps = np.abs(x0 - last_x1).max(axis=1)
        ways = np.maximum(np.abs(last_x1 - last_x0).max(axis=1), np.abs(x1 - x0).max(axis=1))
        rounding = _ROUNDING * np.abs(x0).max()
        meshes = segment.vertex_meshes
        names = []
        for number in np.unique(meshes[gaps > rounding]):
            own = meshes == number
            if gaps[own].max() > _JUMP * ways[own].max() + rounding:
                names.append(segment.meshes[number].name)
        return tuple(names)


def jumps_at(time: float, segment: Segment) -> bool:
    """Returns whether a mesh jumps at a time, the last of a segment that has two.

    Raises:
        UnreadableError: If a mesh is broken then.
    """
    finder, end = JumpFinder(), segment.positions(time)
    finder.find(0, segment, segment.start_positions, segment.positions(time, before=True))
    return bool(finder.find(1, segment, end, end))
