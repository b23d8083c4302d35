"""Checks the intervals of a scene in one process, as a pipeline of three phases.

While the results of one interval are named, the next one is detected (on a CPU) and the one after it is read.
"""

import itertools
import math
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal, TypeVar

import numpy as np

from ..detection.arcs.rigid_motion import RigidMotion
from ..detection.at_rest.containment import ContainmentFinder
from ..detection.at_rest.intersections import Intersections
from ..detection.at_rest.proximities import Proximities, ProximityFinder
from ..detection.detector import CollisionDetector
from ..detection.inversions import Inversions
from ..detection.mesh import CollisionMesh
from ..detection.results.collisions import Collisions, DetectionStats, add_stats
from ..detection.run.settings import Method
from ..detection.run.start import is_cpu
from ..usd.interval import Interval, positions_of
from ..usd.scene import Scene
from ..usd.segment import Segment
from ..usd.selection import Selection
from .duplicates import Duplicates
from .results import IntervalResult, Work, summarize, summarize_inversions
from .scene_arcs import arcs_of
from .scene_contacts import compare_contacts, find_contacts, join_contacts
from .scene_intersections import AtTime, SceneIntersections, name_intersections
from .scene_proximities import SceneProximities, name_proximities
from .threads import read_ahead
from .validation import validate

_Found, _Named = TypeVar("_Found"), TypeVar("_Named", SceneIntersections, SceneProximities)

_FACES_AT_ONCE = 30_000
"""Number of faces of all copies of a segment, of which as many as intervals are detected at once."""


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
        """Yields the results of some intervals, in order. Threads meanwhile read the next ones, and detect on a CPU.

        Args:
            first: Number of the first interval.
            stop: Number of the interval after the last one.
            seconds: Time [s] after which no other interval is read; those that have been read are checked.

        Raises:
            ValueError: If the positions at some time are broken, or there is no such method.
        """
        detections = self._detect(first, stop, time.monotonic() + seconds)
        if is_cpu(self._checks.device):
            detections = read_ahead(detections)
        for works, namer, detection in detections:
            started = time.perf_counter()
            results = namer.name(detection)
            share = (time.perf_counter() - started) / len(results)
            for work, result in zip(works, results, strict=True):
                yield replace(result, work=replace(work, checking=work.checking + share))

    def selection_without_initial(self) -> Selection:
        """Returns the selection that also ignores the pairs that cross, or are inside each other, at the first time."""
        interval = self.scene.interval(0)
        detector, namer = self._at(interval)
        found = namer.name_at_start(detector.find_intersections(interval)).summary
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
        for batch in read_ahead(self._batches(_timed(self.scene.intervals(first, stop), deadline))):
            started = time.perf_counter()
            detector, namer = self._at(batch[0][1])
            for detection in detector.detect([interval for _, interval in batch]):
                share = (time.perf_counter() - started) / len(batch)
                works = [Work(self._worker, detector.device, reading, share) for reading, _ in batch]
                yield works[: len(detection.intervals)], namer, detection
                del batch[: len(detection.intervals)]

    def _batches(self, intervals: Iterable[tuple[float, Interval]]) -> Iterator[list[tuple[float, Interval]]]:
        """Yields intervals, with the time to read each, in groups that are detected at once."""
        batch: list[tuple[float, Interval]] = []
        for reading, interval in intervals:
            alone = _is_alone(interval, self._checks)
            if batch and (alone or interval.segment is not batch[0][1].segment):
                yield batch
                batch = []
            batch = [*batch, (reading, interval)]
            if alone or len(batch) * len(interval.segment.faces) > _FACES_AT_ONCE - len(interval.segment.faces):
                yield batch
                batch = []
        if batch:
            yield batch

    def _at(self, interval: Interval) -> tuple["_SegmentDetector", "_SegmentNamer"]:
        if self._of_segment is None or interval.segment is not self._of_segment[1].segment:
            self._of_segment = None  # before the next is made, to free its memory
            detector = _SegmentDetector(interval.segment, self._checks)
            self._of_segment = detector, _SegmentNamer(interval.segment, detector, self._checks)
        return self._of_segment


@dataclass(frozen=True)
class _Detection:
    """The collisions, intersections and proximities that are detected in intervals of a segment.

    Attributes:
        intervals: The intervals.
        arcs: The motion of vertices on arcs; None if all move straight.
        mesh: The mesh, with a copy of the meshes of the segment for each interval.
        collisions: Collisions of that mesh.
        stats: Counts and times of each interval.
        of_strands: Collisions of curves and points; None without any.
        intersections: Intersections at the start and at the end of each interval; None if they are not checked.
        proximities: Proximities at both times; None if they are not checked.
        inversions: The tetrahedra that invert in each interval; None without any tetrahedra.
        detector: The detector of the collisions of meshes if they are validated, else None.
    """

    intervals: list[Interval]
    arcs: RigidMotion | None
    mesh: CollisionMesh
    collisions: Collisions
    stats: list[DetectionStats]
    of_strands: Collisions | None
    intersections: list[tuple[AtTime[Intersections], AtTime[Intersections]]] | None
    proximities: list[tuple[AtTime[Proximities], AtTime[Proximities]]] | None
    inversions: list[Inversions] | None
    detector: CollisionDetector | None


class _Copies:
    """The meshes of a segment, once for each of some intervals, which are detected at once: each copy is a world."""

    def __init__(self, segment: Segment, checks: Checks, count: int):
        self.count = count
        faces, world = segment.faces, None
        if count > 1:
            faces = (faces + segment.vertex_count * np.arange(count)[:, None, None]).reshape(-1, 3)
            world = np.repeat(np.arange(count), segment.vertex_count)
        self.mesh = CollisionMesh(faces, count * segment.vertex_count, world=world, device=checks.device)
        self.detector = CollisionDetector(self.mesh, method=checks.method)
        self.finder = self.detector.intersection_finder() if checks.intersections else None

    def find_intersections(self, x: np.ndarray, *, is_end: bool = False) -> list[Intersections]:
        """Returns the intersections of each copy, given the positions of all; see :meth:`.IntersectionFinder.find`."""
        assert self.finder
        found = self.finder.find(x, is_end=is_end)
        sizes = np.array([len(self.mesh.edges), len(self.mesh.faces)], dtype=np.int32) // self.count
        bounds = np.searchsorted(found.pairs[:, 0], sizes[0] * np.arange(self.count + 1)).tolist()
        return [
            Intersections(found.pairs[a:b] - number * sizes, found.crosses[a:b])
            for number, (a, b) in enumerate(pairwise(bounds))
        ]


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
        self._of_meshes: Intersections | None = None  # found last, those of meshes alone
        self._intersections: AtTime[Intersections] | None = None  # and all
        tets, self._inversions = segment.tetrahedra, None
        if len(tets.corners):
            mesh = CollisionMesh(np.empty((0, 3), int), tets.vertex_count, tets=tets.corners, device=checks.device)
            self._inversions = CollisionDetector(mesh, method=checks.method)
        clearance = checks.clearance
        self._proximity_finder = None if clearance is None else ProximityFinder(self.mesh, clearance)
        self._proximities: AtTime[Proximities] | None = None

    def detect(self, intervals: list[Interval]) -> Iterator[_Detection]:
        """Yields what is detected in intervals: in all at once, or one by one if the counts of each are not known."""
        if len(intervals) not in (1, self._copies.count):
            self._copies = _Copies(self._segment, self._checks, len(intervals))
        copies = self._alone if len(intervals) == 1 else self._copies
        interval, detector, (x0, x1) = intervals[0], copies.detector, positions_of(intervals)
        arcs, starts = arcs_of(interval), []
        for number, one in enumerate(intervals):
            before = intervals[number - 1]
            is_joined = number > 0 and AtTime(before.end, before.x1, None).is_at(one.x0, one.start)
            starts.append(None if is_joined or not copies.finder else self.find_intersections(one))
        if interval.is_at_rest:  # at rest, coplanar faces would be many collisions between obstacles
            nothing = CollisionMesh(np.empty((0, 3), int), 0, device=self.mesh.device)
            detector = CollisionDetector(nothing, method=detector.method)
            collisions = detector.detect(np.zeros((0, 3)), np.zeros((0, 3)))
        else:
            collisions = detector.detect(x0, x1, rigid_motion=arcs)
        stats = [collisions.stats] if len(intervals) == 1 else detector.stats_by_world(collisions)
        if stats is None:
            for one in intervals:
                yield from self.detect([one])
            return
        of_strands = self.strands.detect(interval, arcs) if self.strands and not interval.is_at_rest else None
        intersections = None
        if copies.finder:
            ends = self._find_at_ends(intervals, x1, copies, None if interval.is_at_rest or arcs else collisions)
            intersections = [(start or ends[number - 1], ends[number]) for number, start in enumerate(starts)]
        proximities = None
        if self._proximity_finder:
            proximities = [
                (self._find_proximities(one.x0, one.start), self._find_proximities(one.x1, one.end))
                for one in intervals
            ]
        inversions = None
        if self._inversions:
            inversions = [self._inversions.inversions(*one.tet_positions) for one in intervals]
        validated = detector if self._checks.validate != 0 else None
        found = intersections, proximities, inversions
        yield _Detection(intervals, arcs, copies.mesh, collisions, stats, of_strands, *found, validated)

    def find_intersections(self, interval: Interval) -> AtTime[Intersections]:
        """Returns the intersections at the start of an interval; those found last, if they are of that time."""
        if self._intersections is None or not self._intersections.is_at(interval.x0, interval.start):
            (found,) = self._alone.find_intersections(interval.x0)
            return self._keep(found, interval.x0, interval.start)
        return self._intersections

    def _find_at_ends(
        self, intervals: list[Interval], x1: np.ndarray, copies: _Copies, motion: Collisions | None
    ) -> list[AtTime[Intersections]]:
        """Returns the intersections at the ends of intervals, given the collisions that have just been detected."""
        interval, last = intervals[0], self._intersections
        assert last and self._of_meshes and copies.finder
        if len(intervals) == 1 and last.is_at(x1, interval.end):
            return [last]
        if len(intervals) == 1 and motion:
            found = [copies.finder.find_at_end(x1, self._of_meshes, motion)]
        else:
            found = copies.find_intersections(x1, is_end=motion is not None)
        return [self._keep(one, at.x1, at.end, motion) for one, at in zip(found, intervals, strict=True)]

    def _keep(
        self, found: Intersections, x: np.ndarray, time: float, motion: Collisions | None = None
    ) -> AtTime[Intersections]:
        """Keeps intersections of meshes as those found last, and returns them with those of curves.

        Args:
            found: The intersections.
            x: Positions at that time, shape [vertex_count, 3].
            time: Time code.
            motion: The collisions of the motion to these positions, if it has just been detected; else None.
        """
        self._of_meshes = found
        if self.strands:
            found = self.strands.with_intersections(found, x, is_end=motion is not None)
        self._intersections = AtTime(time, x, found)
        return self._intersections

    def _find_proximities(self, x: np.ndarray, time: float) -> AtTime[Proximities]:
        """Returns the proximities at a time; those found last, if they are of that time."""
        if self._proximities is None or not self._proximities.is_at(x, time):
            assert self._proximity_finder
            self._proximities = AtTime(time, x, self._proximity_finder.find(x))
        return self._proximities


class _SegmentNamer:
    """Names the detected pairs of the intervals of one segment by prims and elements, on the host."""

    def __init__(self, segment: Segment, detector: _SegmentDetector, checks: Checks):
        self.segment = segment
        self._checks = checks
        self._mesh = detector.mesh
        self._strand_mesh = detector.strands.mesh if detector.strands else None
        bodies = detector.strands.bodies if detector.strands else segment.face_meshes
        self._duplicates = self._containment = None
        if checks.intersections:
            self._duplicates = Duplicates(segment)
            bodies = self._duplicates.without_twins(bodies)
            self._containment = ContainmentFinder(self._strand_mesh or self._mesh, bodies)
        self._named_duplicates = self._duplicates.named(checks.selection) if self._duplicates else ()
        self._intersections: dict[AtTime, SceneIntersections] = {}  # those named last
        self._proximities: dict[AtTime, SceneProximities] = {}

    def name(self, detection: _Detection) -> list[IntervalResult]:
        """Returns the results of intervals."""
        intervals, collisions, arcs = detection.intervals, detection.collisions, detection.arcs
        selection, inversions = self._checks.selection, detection.inversions
        intersections = _named(self._intersections, detection.intersections, self._name_intersections)
        proximities = _named(self._proximities, detection.proximities, self._name_proximities)
        contacts = find_contacts(intervals, detection.mesh, collisions, selection, arcs)
        certified, stats = collisions.certified, detection.stats
        if detection.of_strands:
            assert self._strand_mesh
            more = find_contacts(intervals, self._strand_mesh, detection.of_strands, selection, arcs)
            contacts, stats = [join_contacts(*contacts, *more)], [add_stats(*stats, detection.of_strands.stats)]
            certified &= detection.of_strands.certified
        results = []
        if intersections:
            contacts = compare_contacts(contacts, intersections)
        for number, (interval, found) in enumerate(zip(intervals, contacts, strict=True)):
            validation = None
            if detection.detector:
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
            at_rest = intersections and intersections[number], proximities and proximities[number]
            summary = summarize(
                found,
                *at_rest,
                certified=certified,
                stats=stats[number],
                validation=validation,
                duplicates=self._named_duplicates,
                inverted=summarize_inversions(inversions[number], interval) if inversions else (),
            )
            results.append(IntervalResult(summary, found, *at_rest, None))
        return results

    def name_at_start(self, found: AtTime[Intersections]) -> SceneIntersections:
        """Returns the named intersections of a time, with the parts inside meshes."""
        return self._name_intersections([found])[0]

    def _name_intersections(self, found: list[AtTime[Intersections]]) -> list[SceneIntersections]:
        assert self._containment and self._duplicates
        selection, meshes = self._checks.selection, self.segment.meshes

        def are_checked(pairs: np.ndarray) -> np.ndarray:
            ignored = selection.ignored_pairs(meshes, pairs) | selection.may_be_inside(meshes, pairs)
            return selection.counted_pairs(meshes, pairs) & ~ignored

        is_sought = self._duplicates.may_be_checked(are_checked)
        inside = [self._containment.find(at.x, at.found, is_sought) for at in found]
        inside = [self._duplicates.with_twins(one, are_checked) for one in inside]
        return name_intersections(self.segment, self._strand_mesh or self._mesh, found, inside, selection)

    def _name_proximities(self, found: list[AtTime[Proximities]]) -> list[SceneProximities]:
        selection = self._checks.selection
        return [name_proximities(self.segment, self._mesh, at.found, at.time, selection) for at in found]


def _named(
    known: dict[AtTime[_Found], _Named],
    found: list[tuple[AtTime[_Found], AtTime[_Found]]] | None,
    name: Callable[[list[AtTime[_Found]]], list[_Named]],
) -> list[tuple[_Named, _Named]] | None:
    """Returns findings at both times of intervals with names; keeps those of the last time, and names what is new."""
    if found is None:
        return None
    new = [at for at in dict.fromkeys(itertools.chain(*found)) if at not in known]
    known.update(zip(new, name(new) if new else [], strict=True))
    named = [(known[start], known[end]) for start, end in found]
    known.clear()
    known[found[-1][1]] = named[-1][1]
    return named


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
        self._edges_of_faces = np.setdiff1d(np.arange(len(self.mesh.edges)), self.mesh.free_edges)

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


def _is_alone(interval: Interval, checks: Checks) -> bool:
    """Returns whether an interval is detected by itself: without motion, with turns, or with more than meshes."""
    return interval.is_at_rest or bool(interval.turns) or interval.segment.has_strands or checks.validate != 0


def _timed(intervals: Iterable[Interval], deadline: float) -> Iterator[tuple[float, Interval]]:
    """Yields intervals, at least one, with the time to read each [s], until a deadline."""
    started = time.perf_counter()
    for interval in intervals:
        yield time.perf_counter() - started, interval
        if time.monotonic() > deadline:
            return
        started = time.perf_counter()
