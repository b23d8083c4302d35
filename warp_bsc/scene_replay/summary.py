"""A whole replay in numbers, as tables and files show them at the end."""

import functools
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TypeVar

from ..usd.scene import Scene
from .results import TOI_BINS, IgnoredPair, IntersectionSummary, IntervalSummary, Nearest, ProximitySummary
from .validation import Validation

_Span = TypeVar("_Span", bound="Span")
_AtRest = TypeVar("_AtRest", IntersectionSummary, ProximitySummary)

CERTIFIED_FOR = "vertices that move straight or turn about one axis between the times checked"
"""The motion that a certificate holds for."""


@dataclass(frozen=True)
class Span:
    """Consecutive intervals, or times, of a scene at all of which meshes do something.

    Attributes:
        meshes: Their names.
        since: Start of the first interval, or the first of the times, as a time code.
        until: End of the last interval, or the last of the times.
    """

    meshes: tuple[str, ...]
    since: float
    until: float

    @property
    def when(self) -> str:
        """The times, in words."""
        return f"at {self.since:g}" if self.since == self.until else f"from {self.since:g} to {self.until:g}"


@dataclass(frozen=True)
class CollisionSpan(Span):
    """Intervals in which two meshes collide, or a mesh collides with itself.

    Attributes:
        hits: Number of their pairs that collide.
    """

    meshes: tuple[str, str]
    hits: int


@dataclass(frozen=True)
class IntersectionSpan(Span):
    """Times at which two meshes intersect, a mesh intersects itself, or one is inside another, which comes second.

    Attributes:
        is_open: Whether the last time is the last that was checked, so that the intersection may continue.
        inside: Whether parts of the first mesh are wholly inside the second; otherwise edges of one meet faces of the
            other.
        becomes: The state of the meshes at the next time, "inside" or "crosses"; empty if they do not intersect then.
        first: Number of parts that are inside, or of edges that pass through faces or touch them, at the first time.
        last: That number at the last time.
        most: The largest of these numbers at all times.
        most_at: The first time with that number.
        crossings: Largest number of edges that pass through faces at a time; 0 if the meshes only touch, or are inside.
    """

    meshes: tuple[str, str]
    is_open: bool
    inside: bool
    becomes: str
    first: int
    last: int
    most: int
    most_at: float
    crossings: int

    @property
    def trend(self) -> str:
        """How the intersection develops.

        "heals", "then inside" or "then crosses" if it ends; else "grows", "shrinks" or "stays", by its numbers.
        """
        if not self.is_open:
            return f"then {self.becomes}" if self.becomes else "heals"
        return "grows" if self.last > self.first else "shrinks" if self.last < self.first else "stays"


@dataclass(frozen=True)
class ProximitySpan(Span):
    """Times at which two meshes, by their sorted names, are near each other, or a mesh is near itself.

    Attributes:
        distance: Their smallest distance at these times, in the scene's unit of length.
        nearest_at: The first time with that distance.
    """

    meshes: tuple[str, str]
    distance: float
    nearest_at: float


@dataclass(frozen=True)
class DuplicateSpan(Span):
    """Intervals in which meshes, in the scene's order, are duplicates of each other."""

    def describe(self, most: int) -> str:
        """Returns the duplicates in words, with at most some of their names."""
        names, more = ", ".join(self.meshes[:most]), len(self.meshes) - most
        others = f" and {more:,} more" if more > 0 else ""
        return f"{len(self.meshes):,} meshes are duplicates of each other, {self.when}: {names}{others}"


@dataclass(frozen=True)
class InversionSpan(Span):
    """Intervals in which tetrahedra of a mesh invert or are inverted.

    Attributes:
        most: Largest number of these tetrahedra in an interval.
        tetrahedron: The first, an index in ``tetVertexIndices``.
        time: Time code at which it inverts, or is inverted.
    """

    most: int
    tetrahedron: int
    time: float

    def describe(self) -> str:
        """Returns the inversions in words."""
        number = "1 tetrahedron is" if self.most == 1 else f"at most {self.most:,} tetrahedra are"
        first = f"the first is tetrahedron {self.tetrahedron}, at {self.time:.6g}"
        return f"{number} inverted in {self.meshes[0]}, {self.when}; {first}"


@dataclass(frozen=True)
class Summary:
    """A whole replay in numbers.

    Attributes:
        scene: The scene.
        method: Method of detection.
        device: Name of the Warp device.
        intervals: The finished intervals, in order.
        stopped: Reason why the replay ended before the scene; empty if it is complete.
        clearance: Distance up to which proximities were found, in the scene's unit of length; None without them.
        limit: Largest number of rows of each list of an interval in files, see :mod:`~warp_bsc.scene_replay.limit`;
            None if files list all.
        depths: The largest depth of each two meshes that intersect, in the scene's unit of length, and the first time
            with it, by their sorted names; empty if depths were not measured.
    """

    scene: Scene
    method: str
    device: str
    intervals: list[IntervalSummary]
    stopped: str = ""
    clearance: float | None = None
    limit: int | None = None
    depths: Mapping[tuple[str, str], tuple[float, float]] = field(default_factory=dict)

    @property
    def is_complete(self) -> bool:
        """Whether all intervals of the scene are finished."""
        return len(self.intervals) == len(self.scene)

    @cached_property
    def colliding(self) -> list[IntervalSummary]:
        """The intervals with collisions."""
        return [interval for interval in self.intervals if interval.hits]

    @cached_property
    def worst(self) -> list[IntervalSummary]:
        """The intervals with collisions, those with the most first."""
        return sorted(self.colliding, key=lambda interval: -interval.hits)

    @property
    def hits(self) -> int:
        """Number of pairs that collide in some interval."""
        return sum(interval.hits for interval in self.intervals)

    @cached_property
    def ignored(self) -> list[IgnoredPair]:
        """The pairs of meshes that meet and are ignored, those with the most collisions first."""
        hits, edges = Counter[tuple[str, str]](), Counter[tuple[str, str]]()
        for interval in self.intervals:
            hits.update({(min(meshes), max(meshes)): number for meshes, number in interval.ignored.items()})
        for sample in self.intersections:
            edges |= Counter({(min(meshes), max(meshes)): number for meshes, number in sample.ignored.items()})
        selection, prim_of = self.scene.selection, self.scene.prim_of
        pairs = (
            IgnoredPair(meshes, hits[meshes], edges[meshes], selection.meant(*map(prim_of, meshes)))
            for meshes in hits.keys() | edges.keys()
        )
        return sorted(pairs, key=lambda pair: (-pair.hits, -pair.edges, pair.meshes))

    @cached_property
    def collision_spans(self) -> list[CollisionSpan]:
        """The times over which two meshes collide, by their start, then by descending number of hits."""
        begun = (
            [CollisionSpan(pair, at.start, at.end, n) for pair, n in at.mesh_pairs.items()] for at in self.intervals
        )
        joined = _joined(begun, lambda a, b: replace(a, until=b.until, hits=a.hits + b.hits))
        return sorted(joined, key=lambda span: (span.since, -span.hits))

    @cached_property
    def intersections(self) -> list[IntersectionSummary]:
        """The intersections at all times of the finished intervals, in order; empty if none were searched."""
        return _at_all_times(interval.intersections for interval in self.intervals)

    @cached_property
    def intersection_spans(self) -> list[IntersectionSpan]:
        """The times over which two meshes intersect, by their start.

        For the same start, edges in faces come before parts inside, then larger numbers before smaller ones.
        """
        spans: list[IntersectionSpan] = []
        running: dict[tuple[bool, tuple[str, str]], list[tuple[float, int, int]]] = {}
        for sample in self.intersections:
            found = {(False, meshes): numbers for meshes, numbers in sample.mesh_pairs.items()}
            found |= {(True, meshes): (0, parts) for meshes, parts in sample.inside.items()}
            for key in [key for key in running if key not in found]:
                inside, meshes = key
                both = meshes, (meshes[1], meshes[0])
                if inside:
                    becomes = "crosses" * any(sample.mesh_pairs.get(pair, (0, 0))[0] for pair in both)
                else:
                    becomes = "inside" * any(pair in sample.inside for pair in both)
                spans.append(_span(inside, meshes, running.pop(key), False, becomes))
            for key, numbers in found.items():
                running.setdefault(key, []).append((sample.time, *numbers))
        spans += [_span(inside, meshes, samples, True, "") for (inside, meshes), samples in running.items()]
        return sorted(spans, key=lambda span: (span.since, span.inside, -span.most))

    @cached_property
    def proximities(self) -> list[ProximitySummary]:
        """The proximities at all times of the finished intervals, in order; empty if none were searched."""
        return _at_all_times(interval.proximities for interval in self.intervals)

    @cached_property
    def proximity_spans(self) -> list[ProximitySpan]:
        """The times over which two meshes are near each other, by their start, then by ascending distance."""
        begun = (
            [ProximitySpan((min(n.meshes), max(n.meshes)), at.time, at.time, n.distance, at.time) for n in at.nearest]
            for at in self.proximities
        )
        near = _joined(begun, lambda a, b: replace(b if b.distance < a.distance else a, since=a.since, until=b.until))
        return sorted(near, key=lambda span: (span.since, span.distance))

    @cached_property
    def duplicate_spans(self) -> list[DuplicateSpan]:
        """The times over which meshes are duplicates of each other, by their start."""
        begun = ([DuplicateSpan(meshes, at.start, at.end) for meshes in at.duplicates] for at in self.intervals)
        return sorted(_joined(begun, lambda a, b: replace(a, until=b.until)), key=lambda span: span.since)

    @cached_property
    def inversion_spans(self) -> list[InversionSpan]:
        """The times over which tetrahedra of a mesh are inverted, by their start."""
        begun = (
            [InversionSpan(n.meshes, at.start, at.end, n.number, n.tetrahedra[0], n.times[0]) for n in at.inverted]
            for at in self.intervals
        )
        joined = _joined(begun, lambda a, b: replace(a, until=b.until, most=max(a.most, b.most)))
        return sorted(joined, key=lambda span: span.since)

    @cached_property
    def nearest(self) -> list[Nearest]:
        """The nearest elements of each two meshes over all times (the first time if tied), by ascending distance."""
        smallest: dict[tuple[str, ...], Nearest] = {}
        for nearest in (nearest for sample in self.proximities for nearest in sample.nearest):
            before = smallest.setdefault(tuple(sorted(nearest.meshes)), nearest)
            if nearest.distance < before.distance:
                smallest[tuple(sorted(nearest.meshes))] = nearest
        return sorted(smallest.values(), key=lambda nearest: nearest.distance)

    @property
    def certified(self) -> bool:
        """Whether the finished intervals contain every collision, see :data:`CERTIFIED_FOR`."""
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
    def validation(self) -> Validation | None:
        """The comparison of all intervals with the exact checker, which names them; None without validation."""
        found = []
        for at in self.intervals:
            if at.validation:
                lines = (f"from time {at.start:g} to {at.end:g}: {line}" for line in at.validation.disagreements)
                found.append(replace(at.validation, disagreements=tuple(lines)))
        return functools.reduce(Validation.__add__, found) if found else None

    @property
    def motion(self) -> str:
        """The motion that is assumed between samples, in words."""
        if self.scene.is_still:
            return "At one time there are no collisions, only intersections at rest."
        text = "Motion between time samples is taken to be linear."
        if turning := self.scene.turning:
            which = "1 mesh is" if turning == 1 else f"{turning} meshes are"
            text += (
                f" {which} moved by transforms or skeletons, which need not be linear: what turns about one axis at a "
                "constant rate is checked on its arcs. Turning meshes are sampled at every whole time code too, unless "
                "the frames have a step; for other turns, subdividing the intervals samples finer."
            )
        return text

    @property
    def not_counted(self) -> str:
        """A sentence on the pairs of meshes that are meant to meet, or ignored; empty without any."""
        if not self.ignored:
            return ""
        meant, hits = sum(pair.meant is not None for pair in self.ignored), sum(pair.hits for pair in self.ignored)
        kinds = [(meant, "meant"), (len(self.ignored) - meant, "ignored")]
        pairs = " and ".join(counted(number, f"{kind} pair") for number, kind in kinds if number)
        return f"Not counted: {pairs} of meshes, {counted(hits, 'collision')}."

    @property
    def not_checked(self) -> str:
        """A sentence on the parts of the scene that are left out; empty if there are none."""
        parts = len(self.scene.left_out)
        return f"Not checked: {counted(parts, 'part')} that cannot be read, named as left out." if parts else ""

    def first(self, count: int) -> "Summary":
        """Returns the summary of the first intervals alone."""
        if count == len(self.intervals):
            return self
        return replace(self, intervals=self.intervals[:count], stopped=self.stopped or "the disk is full")


def _at_all_times(intervals: Iterable[tuple[_AtRest, _AtRest] | None]) -> list[_AtRest]:
    """Returns what is at the starts of intervals, and at the end of the last one."""
    found = [both for both in intervals if both]
    return [start for start, _ in found] + [end for _, end in found[-1:] if end.time != found[-1][0].time]


def counted(number: int, one: str, ending: str = "s") -> str:
    """Returns a number of things, given the word for one and what more than one add to it."""
    return f"{number:,} {one}{ending * (number != 1)}"


def _joined(times: Iterable[list[_Span]], join: Callable[[_Span, _Span], _Span]) -> list[_Span]:
    """Returns the spans of consecutive times, given those of each time, and what joins two of the same meshes."""
    spans, running = [], {}
    for found in ({span.meshes: span for span in begun} for begun in times):
        spans += [span for meshes, span in running.items() if meshes not in found]
        both = {meshes: join(span, found[meshes]) for meshes, span in running.items() if meshes in found}
        running = both | {meshes: span for meshes, span in found.items() if meshes not in both}
    return [*spans, *running.values()]


def _span(inside, meshes, samples, is_open, becomes) -> IntersectionSpan:
    """Returns a span of samples: time, crossings, and touches or parts inside each."""
    numbers = [crossings + touches for _, crossings, touches in samples]
    most, crossings = max(numbers), max(crossings for _, crossings, _ in samples)
    most_at, times = samples[numbers.index(most)][0], (samples[0][0], samples[-1][0])
    state, number = (is_open, inside, becomes), (numbers[0], numbers[-1], most)
    return IntersectionSpan(meshes, *times, *state, *number, most_at, crossings)
