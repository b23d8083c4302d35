"""A whole replay in numbers, as every table and file gives it at the end."""

from collections import Counter
from dataclasses import dataclass, replace
from functools import cached_property

from ..usd.scene import Scene
from .intervals import TOI_BINS, IntervalSummary

__all__ = ["CERTIFIED_FOR", "Summary"]

CERTIFIED_FOR = "vertices that move straight between the times checked"
"""What a certificate is about."""


@dataclass(frozen=True)
class Summary:
    """A whole replay in numbers.

    Attributes:
        scene: The scene.
        method: The method that was used.
        device: The device that was used.
        intervals: Those that are finished, in order.
        stopped: Why there are no more; empty if these are all.
    """

    scene: Scene
    method: str
    device: str
    intervals: list[IntervalSummary]
    stopped: str = ""

    @property
    def is_complete(self) -> bool:
        """Whether all intervals of the scene are finished."""
        return len(self.intervals) == self.interval_count

    @property
    def interval_count(self) -> int:
        """How many intervals the scene has."""
        return len(self.scene)

    @cached_property
    def colliding(self) -> list[IntervalSummary]:
        """The intervals with collisions."""
        return [interval for interval in self.intervals if interval.hits]

    @cached_property
    def worst(self) -> list[IntervalSummary]:
        """The same, those with the most collisions first."""
        return sorted(self.colliding, key=lambda interval: -interval.hits)

    @property
    def hits(self) -> int:
        """Number of pairs that collide in some interval."""
        return sum(interval.hits for interval in self.intervals)

    @property
    def certified(self) -> bool:
        """Whether no collision of vertices that move straight can be missing in what is finished."""
        return all(interval.certified for interval in self.intervals)

    @cached_property
    def mesh_pairs(self) -> list[tuple[tuple[str, str], int]]:
        """Names of two meshes and the number of their pairs that collide, the most first."""
        total = Counter()
        for interval in self.intervals:
            total.update(interval.mesh_pairs)
        return total.most_common()

    @property
    def toi_counts(self) -> list[int]:
        """Number of pairs by their time of impact, in equal parts of an interval."""
        counts = [interval.toi_counts for interval in self.intervals]
        return [sum(column) for column in zip(*counts, strict=True)] or [0] * TOI_BINS

    @property
    def milliseconds(self) -> dict[str, float]:
        """Time by stage of the detector [ms]."""
        total = Counter()
        for interval in self.intervals:
            total.update(interval.stats.milliseconds)
        return dict(total)

    @property
    def validation(self) -> dict | None:
        """What the exact checker says of the answers, None if it was not asked."""
        found = [(interval, interval.validation) for interval in self.intervals if interval.validation]
        if not found:
            return None
        sums = {
            name: sum(getattr(validation, name) for _, validation in found)
            for name in ("hits", "others", "answers", "certified", "false_hits")
        }
        disagreements = [
            f"from time {interval.start:g} to {interval.end:g}: {line}"
            for interval, validation in found
            for line in validation.disagreements
        ]
        return {**sums, "disagreements": disagreements}

    @property
    def motion(self) -> str:
        """A sentence on what is taken for the motion between samples."""
        sentence = "Motion between time samples is taken to be linear."
        if turning := self.scene.turning:
            which = "1 mesh is" if turning == 1 else f"{turning} meshes are"
            sentence += (
                f" {which} moved by transforms or skeletons, which need not be: what turns is sampled at every whole "
                "time code too, unless --frames has a step; --subdivide N samples finer."
            )
        return sentence

    def first(self, count: int) -> "Summary":
        """What the first intervals are of it."""
        if count == len(self.intervals):
            return self
        return replace(self, intervals=self.intervals[:count], stopped=self.stopped or "no room for more")
