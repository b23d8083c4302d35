"""A whole replay in numbers, as every table and file gives it at the end."""

from collections import Counter
from dataclasses import dataclass, replace
from functools import cached_property

from ..usd.scene import Scene
from .intervals import TOI_BINS, Contact, IntervalSummary

__all__ = ["CERTIFIED_FOR", "Summary", "ValidationSummary"]

CERTIFIED_FOR = "vertices that move straight between the times checked"
"""The motion that a certificate holds for."""


@dataclass(frozen=True)
class ValidationSummary:
    """Comparison of a whole replay with the exact checker.

    Attributes:
        hits: Number of reported collisions that the checker decided.
        others: Number of unreported pairs with overlapping swept boxes that the checker decided.
        answers: Number of pairs that the detector decided.
        certified: Number of these that floating point certified.
        false_hits: Number of reported pairs of method "conservative" that do not collide, as that method permits.
        disagreements: The pairs that the checker decides differently, a sentence with the interval each.
    """

    hits: int
    others: int
    answers: int
    certified: int
    false_hits: int
    disagreements: tuple[str, ...]


@dataclass(frozen=True)
class Summary:
    """A whole replay in numbers.

    Attributes:
        scene: The scene.
        method: Method of detection.
        device: Name of the Warp device.
        intervals: The finished intervals, in order.
        stopped: Why the replay ended before the scene did; empty if it did not.
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
        """Number of intervals of the scene."""
        return len(self.scene)

    @cached_property
    def colliding(self) -> list[IntervalSummary]:
        """The intervals with collisions."""
        return [interval for interval in self.intervals if interval.hits]

    @cached_property
    def worst(self) -> list[IntervalSummary]:
        """The intervals with collisions, those with the most first."""
        return sorted(self.colliding, key=lambda interval: -interval.hits)

    @property
    def first_contact(self) -> Contact | None:
        """The earliest contact, None if there is none."""
        return self.colliding[0].earliest if self.colliding else None

    @property
    def hits(self) -> int:
        """Number of pairs that collide in some interval."""
        return sum(interval.hits for interval in self.intervals)

    @property
    def certified(self) -> bool:
        """Whether no collision of vertices that move straight is missing in the finished intervals."""
        return all(interval.certified for interval in self.intervals)

    @cached_property
    def mesh_pairs(self) -> list[tuple[tuple[str, str], int]]:
        """Names of two meshes and their number of colliding pairs, the largest first."""
        total: Counter[tuple[str, str]] = Counter()
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
    def validation(self) -> ValidationSummary | None:
        """The comparison with the exact checker, None if none was asked for."""
        found = [(interval, interval.validation) for interval in self.intervals if interval.validation]
        if not found:
            return None
        return ValidationSummary(
            hits=sum(validation.hits for _, validation in found),
            others=sum(validation.others for _, validation in found),
            answers=sum(validation.answers for _, validation in found),
            certified=sum(validation.certified for _, validation in found),
            false_hits=sum(validation.false_hits for _, validation in found),
            disagreements=tuple(
                f"from time {interval.start:g} to {interval.end:g}: {line}"
                for interval, validation in found
                for line in validation.disagreements
            ),
        )

    @property
    def motion(self) -> str:
        """A sentence on the motion that is assumed between samples."""
        sentence = "Motion between time samples is taken to be linear."
        if turning := self.scene.turning:
            which = "1 mesh is" if turning == 1 else f"{turning} meshes are"
            sentence += (
                f" {which} moved by transforms or skeletons, which need not be: what turns is sampled at every whole "
                "time code too, unless --frames has a step; --subdivide N samples finer."
            )
        return sentence

    def first(self, count: int) -> "Summary":
        """Returns the summary of the first intervals alone."""
        if count == len(self.intervals):
            return self
        return replace(self, intervals=self.intervals[:count], stopped=self.stopped or "no room for more")
