"""Checks the intervals of a scene in one process, as a pipeline of three phases.

While the results of some intervals are named, the next one is detected and the one after it is read.
"""

import math
import threading
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Literal

import numpy as np

from ..detection.arcs.rigid_motion import RigidMotion
from ..detection.at_rest.containment import ContainmentFinder
from ..detection.at_rest.intersections import Intersections
from ..detection.at_rest.proximities import Proximities, ProximityFinder
from ..detection.detector import CollisionDetector, stats_by_world
from ..detection.inversions import Inversions
from ..detection.mesh import CollisionMesh
from ..detection.results.collisions import Collisions, DetectionStats, add_stats
from ..detection.run.settings import Method
from ..usd.interval import Interval, positions_of
from ..usd.scene import Scene
from ..usd.segment import Segment
from ..usd.selection import Selection
from .duplicates import Duplicates
from .results import IntervalResult, Work, summarize, summarize_inversions
from .scene_arcs import arcs_of
from .scene_contacts import compare_contacts, find_contacts, join_contacts
from .scene_intersections import name_intersections
from .scene_proximities import name_proximities
from .threads import map_ahead, read_ahead
from .validation import validate

FACES_AT_ONCE = 30_000
"""Most faces of all copies of a segment, one for each interval that is detected at once; a copy counts 500 more."""

_NAMING_THREADS = 4
"""Threads that name detected pairs, which NumPy does mostly without Python's lock."""


@dataclass(frozen=True)
class Checks:
    """The checks of every interval, and how they are done.

    Attributes:
        selection: The pairs of meshes that are checked.
        method: Method of detection.
        device: Name of the Warp device; None for Warp's default.
        intersections: Whether to find the intersections at each time, and the meshes inside others.
        clearance: Distance up to which proximities are found at each time; None finds none.
        validate: Number of hits, and of other pairs, that the exact checker decides again, or "all".
    """

    selection: Selection
    method: Method
    device: str | None
    intersections: bool
    clearance: float | None
    validate: int | Literal["all"]


class IntervalChecker:
    """Checks intervals of a scene. Consecutive intervals of a segment share buffers and trees."""

    def __init__(self, scene: Scene, checks: Checks, worker: str = ""):
        """Makes a checker of a scene; ``worker`` is the name of this process for :class:`Work`."""
        self.scene = scene
        self._checks = checks
        self._worker = worker
        self._of_segment: tuple[_SegmentDetector, _SegmentNamer] | None = None

    def check(self, first: int, stop: int, seconds: float = math.inf) -> Iterator[IntervalResult]:
        """Yields the results of some intervals, in order. Threads meanwhile read and detect the next ones.

        Args:
            first: Number of the first interval.
            stop: Number of the interval after the last one.
            seconds: Time [s] after which no other interval is read; those that have been read are checked.

        Raises:
            ValueError: If the positions at some time are broken, or there is no such method.
        """
        detections = self._detect(first, stop, time.monotonic() + seconds)
        for results in map_ahead(_named, detections, _NAMING_THREADS):
            yield from results

    def selection_without_initial(self) -> Selection:
        """Returns the selection that also ignores the pairs that cross, or are inside each other, at the first time."""
        interval = self.scene.interval(0)
        detector, namer = self._at(interval)
        moment = _Moment(interval.start, interval.x0)
        detector.find_at([moment])
        namer.name_at([moment])
        assert moment.intersections is not None
        found = moment.intersections.summary
        crossing = {(min(names), max(names)) for names, (crossings, _) in found.mesh_pairs.items() if crossings}
        selection = self._checks.selection
        return replace(
            selection,
            ignored_names=selection.ignored_names | crossing,
            ignored_inside=selection.ignored_inside | found.inside.keys(),
        )

    def _detect(
        self, first: int, stop: int, deadline: float
    ) -> Iterator[tuple[list[Work], "_SegmentNamer", "_Detection"]]:
        """Yields the work on some intervals, the namer of their segment, and what is detected in them."""
        for batch in read_ahead(_batches(self.scene.intervals(first, stop), deadline, self._checks)):
            started = time.perf_counter()
            detector, namer = self._at(batch[0][1])
            for detection in detector.detect([interval for _, interval in batch]):
                share = (time.perf_counter() - started) / len(batch)
                works = [Work(self._worker, detector.device, reading, share) for reading, _ in batch]
                yield works[: len(detection.intervals)], namer, detection
                del batch[: len(detection.intervals)]

    def _at(self, interval: Interval) -> tuple["_SegmentDetector", "_SegmentNamer"]:
        if self._of_segment is None or interval.segment is not self._of_segment[1].segment:
            self._of_segment = None  # before the next is made, to free its memory
            detector = _SegmentDetector(interval.segment, self._checks)
            self._of_segment = detector, _SegmentNamer(interval.segment, detector, self._checks)
        return self._of_segment


def _named(found: tuple[list[Work], "_SegmentNamer", "_Detection"]) -> list[IntervalResult]:
    """Returns the results of intervals, with the work on them."""
    works, namer, detection = found
    started = time.perf_counter()
    results = namer.name(detection)
    share = (time.perf_counter() - started) / len(results)
    pairs = zip(works, results, strict=True)
    return [replace(result, work=replace(work, checking=work.checking + share)) for work, result in pairs]


@dataclass(eq=False)
class _Moment:
    """A time, and what is found and named there, kept for the interval that starts then.

    Attributes:
        time: Time code.
        x: Positions of all vertices, shape [vertex_count, 3].
        of_meshes: The intersections of meshes alone; None, as the others, while not found.
        found: The intersections.
        near: The proximities.
        intersections: The intersections, named.
        proximities: The proximities, named.
    """

    time: float
    x: np.ndarray
    of_meshes: Intersections | None = None
    found: Intersections | None = None
    near: Proximities | None = None
    intersections: Any = None
    proximities: Any = None

    def is_at(self, x: np.ndarray, time: float) -> bool:
        """Returns whether it is of a time and of positions."""
        return self.time == time and (self.x is x or np.array_equal(self.x, x))


@dataclass(frozen=True)
class _Detection:
    """What is detected in intervals of a segment.

    Attributes:
        intervals: The intervals.
        moments: The start and the end of each, with intersections and proximities if these are checked.
        arcs: The motion of vertices on arcs; None if all move straight.
        detector: The detector, whose mesh has a copy of the segment's meshes for each interval.
        collisions: Collisions of that mesh.
        stats: Counts of each interval.
        of_strands: Collisions of curves and points; None without any.
        inversions: The tetrahedra that invert in each interval; empty without any tetrahedra.
    """

    intervals: list[Interval]
    moments: list[tuple[_Moment, _Moment]]
    arcs: RigidMotion | None
    detector: CollisionDetector
    collisions: Collisions
    stats: list[DetectionStats]
    of_strands: Collisions | None
    inversions: list[Inversions]


class _Copies:
    """The meshes of a segment, once for each of some intervals that are detected at once: each copy is a world."""

    def __init__(self, segment: Segment, checks: Checks, count: int):
        self.count, first = count, segment.vertex_count * np.arange(count)
        faces = segment.faces if count == 1 else (segment.faces + first[:, None, None]).reshape(-1, 3)
        world = None if count == 1 else np.repeat(np.arange(count), segment.vertex_count)
        self.mesh = CollisionMesh(faces, count * segment.vertex_count, world=world, device=checks.device)
        self.detector = CollisionDetector(self.mesh, method=checks.method)
        self.finder = self.detector.intersection_finder() if checks.intersections else None

    def find_intersections(self, x: np.ndarray, *, is_end: bool = False) -> list[Intersections]:
        """Returns the intersections of each copy, given the positions of all; see :meth:`.IntersectionFinder.find`."""
        assert self.finder
        found = self.finder.find(x, is_end=is_end)
        sizes = np.array([len(self.mesh.edges), len(self.mesh.faces)], dtype=np.int32) // self.count
        bounds = np.searchsorted(found.pairs[:, 0], sizes[0] * np.arange(self.count + 1)).tolist()
        rows = [slice(*both) for both in pairwise(bounds)]
        return [Intersections(found.pairs[own] - i * sizes, found.crosses[own]) for i, own in enumerate(rows)]


class _SegmentDetector:
    """Detects collisions, intersections and proximities in the intervals of one segment.

    Attributes:
        mesh: The segment's meshes.
        device: Name of the Warp device.
        strands: Detects the collisions of its curves and points; None without any.
    """

    def __init__(self, segment: Segment, checks: Checks):
        self._segment, self._checks = segment, checks
        self._alone = self._copies = _Copies(segment, checks, 1)
        self.mesh = self._alone.mesh
        self.device = self.mesh.device.alias
        self.strands = _StrandChecker(segment, checks) if segment.has_strands else None
        self._last: _Moment | None = None  # the last one that was checked
        tets, self._inversions = segment.tetrahedra, None
        if len(tets.corners):
            mesh = CollisionMesh(np.empty((0, 3), int), tets.vertex_count, tets=tets.corners, device=checks.device)
            self._inversions = CollisionDetector(mesh, method=checks.method)
        clearance = checks.clearance
        self._proximity_finder = None if clearance is None else ProximityFinder(self.mesh, clearance)

    def detect(self, intervals: list[Interval]) -> Iterator[_Detection]:
        """Yields what is detected in intervals: in all at once, or one by one if the counts of each are not known."""
        if len(intervals) not in (1, self._copies.count):
            self._copies = _Copies(self._segment, self._checks, len(intervals))
        copies = self._alone if len(intervals) == 1 else self._copies
        interval, detector, (x0, x1) = intervals[0], copies.detector, positions_of(intervals)
        arcs, moments, last = arcs_of(interval), [], self._last
        for one in intervals:
            start = last if last and last.is_at(one.x0, one.start) else _Moment(one.start, one.x0)
            last = start if start.is_at(one.x1, one.end) else _Moment(one.end, one.x1)
            moments.append((start, last))
        starts, ends = zip(*moments, strict=True)
        self.find_at([start for start in starts if start not in ends])
        if interval.is_at_rest:  # at rest, coplanar faces would be many collisions between obstacles
            nothing = CollisionMesh(np.empty((0, 3), int), 0, device=self.mesh.device)
            detector = CollisionDetector(nothing, method=detector.method)
            collisions = detector.detect(np.zeros((0, 3)), np.zeros((0, 3)))
        else:
            collisions = detector.detect(x0, x1, rigid_motion=arcs)
        stats = [collisions.stats] if len(intervals) == 1 else stats_by_world(detector, collisions)
        if stats is None:
            for one in intervals:
                yield from self.detect([one])
            return
        of_strands = self.strands.detect(interval, arcs) if self.strands and not interval.is_at_rest else None
        motion = None if interval.is_at_rest or arcs else collisions
        if copies.finder and motion is not None:
            if len(intervals) == 1:
                ends[0].of_meshes = copies.finder.find_at_end(x1, starts[0].of_meshes, motion)
            else:
                for end, found in zip(ends, copies.find_intersections(x1, is_end=True), strict=True):
                    end.of_meshes = found
        self.find_at(ends, is_end=motion is not None)
        self._last = last
        inversions = [self._inversions.inversions(*one.tet_positions) for one in intervals if self._inversions]
        yield _Detection(intervals, moments, arcs, detector, collisions, stats, of_strands, inversions)

    def find_at(self, moments: Sequence[_Moment], *, is_end: bool = False) -> None:
        """Finds what is not known yet of some times; ``is_end``: a motion to these has just been detected."""
        for moment in moments:
            if moment.found is None and self._checks.intersections:
                if moment.of_meshes is None:
                    (moment.of_meshes,) = self._alone.find_intersections(moment.x)
                moment.found = moment.of_meshes
                if self.strands:
                    moment.found = self.strands.with_intersections(moment.found, moment.x, is_end=is_end)
            if moment.near is None and self._proximity_finder:
                moment.near = self._proximity_finder.find(moment.x)


class _SegmentNamer:
    """Names the detected pairs of the intervals of one segment by prims and elements, on the host."""

    def __init__(self, segment: Segment, detector: _SegmentDetector, checks: Checks):
        self.segment = segment
        self._checks = checks
        self._lock = threading.Lock()  # intervals share their times, which are named once
        self._mesh = detector.mesh
        self._strand_mesh = detector.strands.mesh if detector.strands else None
        bodies = detector.strands.bodies if detector.strands else segment.face_meshes
        self._duplicates = self._containment = None
        if checks.intersections:
            self._duplicates = Duplicates(segment)
            bodies = self._duplicates.without_twins(bodies)
            self._containment = ContainmentFinder(self._strand_mesh or self._mesh, bodies)
        self._named_duplicates = self._duplicates.named(checks.selection) if self._duplicates else ()

    def name(self, detection: _Detection) -> list[IntervalResult]:
        """Returns the results of intervals."""
        intervals, collisions, arcs = detection.intervals, detection.collisions, detection.arcs
        selection = self._checks.selection
        moments, nothing = detection.moments, [None] * len(intervals)
        with self._lock:
            self.name_at([moment for both in moments for moment in both])
        at_rest = [(a.intersections, b.intersections) for a, b in moments] if self._checks.intersections else nothing
        near = [(a.proximities, b.proximities) for a, b in moments] if self._checks.clearance is not None else nothing
        contacts = find_contacts(intervals, detection.detector.mesh, collisions, selection, arcs)
        certified, stats = collisions.certified, detection.stats
        if detection.of_strands:
            assert self._strand_mesh
            more = find_contacts(intervals, self._strand_mesh, detection.of_strands, selection, arcs)
            contacts, stats = [join_contacts(contacts[0], more[0])], [add_stats(stats[0], detection.of_strands.stats)]
            certified &= detection.of_strands.certified
        if self._checks.intersections:
            contacts = compare_contacts(contacts, [both for both in at_rest if both])
        results = []
        for number, (interval, found) in enumerate(zip(intervals, contacts, strict=True)):
            validation = None
            if self._checks.validate != 0:
                validation = validate(
                    detection.detector,
                    collisions,
                    interval.x0,
                    interval.x1,
                    most=None if self._checks.validate == "all" else self._checks.validate,
                    seed=interval.index,
                    counted=found.counted,
                    turns=None if arcs is None else arcs.body >= 0,
                )
            summary = summarize(
                found,
                at_rest[number],
                near[number],
                certified=certified,
                stats=stats[number],
                validation=validation,
                duplicates=self._named_duplicates,
                inverted=summarize_inversions(detection.inversions[number], interval) if detection.inversions else (),
            )
            results.append(IntervalResult(summary, found, at_rest[number], near[number], None))
        return results

    def name_at(self, moments: Iterable[_Moment]) -> None:
        """Names the intersections, with the parts inside meshes, and the proximities of some times, once."""
        selection, meshes = self._checks.selection, self.segment.meshes

        def are_checked(pairs: np.ndarray) -> np.ndarray:
            ignored = selection.ignored_pairs(meshes, pairs) | selection.may_be_inside(meshes, pairs)
            return selection.counted_pairs(meshes, pairs) & ~ignored

        new = [moment for moment in dict.fromkeys(moments) if moment.found is not None and moment.intersections is None]
        rows = []
        for moment in new:
            assert self._containment and self._duplicates and moment.found
            inside = self._containment.find(moment.x, moment.found, self._duplicates.may_be_checked(are_checked))
            inside = self._duplicates.with_twins(inside, are_checked)
            rows.append((moment.time, moment.x, moment.found, inside))
        named = name_intersections(self.segment, self._strand_mesh or self._mesh, rows, selection) if new else []
        for moment, intersections in zip(new, named, strict=True):
            moment.intersections = intersections
        for moment in moments:
            if moment.near is not None and moment.proximities is None:
                moment.proximities = name_proximities(self.segment, self._mesh, moment.near, moment.time, selection)


class _StrandChecker:
    """Finds the collisions of the curves and points of a segment, and the faces that its curves pass through.

    Attributes:
        mesh: The segment's meshes, curves and points.
    """

    def __init__(self, segment: Segment, checks: Checks):
        self._segment = segment
        ends = segment.free_edges
        edges = ends[ends[:, 0] != ends[:, 1]]  # the others join points of a curve that are always in one place
        alone = np.setdiff1d(ends, np.concatenate([edges.ravel(), segment.faces.ravel()]))
        self.mesh = CollisionMesh(
            segment.faces,
            segment.vertex_count,
            edges=edges,
            points=np.concatenate([segment.points, alone]),
            radius=segment.radius,
            only_free=True,
            device=checks.device,
        )
        self._detector = CollisionDetector(self.mesh, method=checks.method)
        self._finder = self._detector.intersection_finder() if checks.intersections else None
        self._edges_of_faces = np.delete(np.arange(len(self.mesh.edges)), self.mesh.free_edges)

    @property
    def bodies(self) -> np.ndarray:
        """Number of the scene's mesh that each face belongs to, then of the one that each free edge belongs to."""
        ends = self.mesh.edges[self.mesh.free_edges].astype(np.int64)
        return np.concatenate([self._segment.face_meshes, self._segment.locate_edges(ends)[0]])

    def detect(self, interval: Interval, arcs: RigidMotion | None) -> Collisions:
        """Returns the collisions of curves and points in an interval, some of whose vertices may move on arcs."""
        return self._detector.detect(interval.x0, interval.x1, rigid_motion=arcs)

    def with_intersections(self, found: Intersections, x: np.ndarray, *, is_end: bool) -> Intersections:
        """Returns intersections of meshes followed by those of curves, with the edges numbered as in :attr:`mesh`.

        Args:
            found: Intersections of the meshes alone.
            x: Positions, shape [vertex_count, 3].
            is_end: Whether a motion that ends at these positions has just been detected.
        """
        assert self._finder
        more = self._finder.find(x, is_end=is_end)
        own = np.stack([self._edges_of_faces[found.pairs[:, 0]], found.pairs[:, 1]], axis=1)
        return Intersections(np.concatenate([own, more.pairs]), np.concatenate([found.crosses, more.crosses]))


def _batches(intervals: Iterable[Interval], deadline: float, checks: Checks) -> Iterator[list[tuple[float, Interval]]]:
    """Yields intervals, at least one, with the time to read each [s], until a deadline: those detected at once."""
    batch: list[tuple[float, Interval]] = []
    started = time.perf_counter()
    try:
        for interval in intervals:
            segment, is_late = interval.segment, time.monotonic() > deadline
            is_alone = interval.is_at_rest or interval.turns or segment.has_strands or checks.validate != 0
            if batch and (is_alone or segment is not batch[0][1].segment):
                yield batch
                batch = []
            batch.append((time.perf_counter() - started, interval))
            if is_alone or is_late or (len(batch) + 1) * (len(segment.faces) + 500) > FACES_AT_ONCE:
                yield batch
                batch = []
            if is_late:
                return
            started = time.perf_counter()
    except Exception:  # what has been read is checked before it is raised
        if batch:
            yield batch
        raise
    if batch:
        yield batch
