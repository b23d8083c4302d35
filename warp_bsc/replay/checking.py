"""Checks the intervals of a scene one after another, in one process, holding one at a time."""

import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from ..detection.collisions import Collisions, add_stats
from ..detection.containment import ContainmentFinder
from ..detection.detector import CollisionDetector
from ..detection.intersections import Intersections
from ..detection.mesh import CollisionMesh
from ..detection.proximities import ProximityFinder
from ..usd.interval import Interval
from ..usd.scene import Scene
from ..usd.segment import Segment
from ..usd.selection import Selection
from .results import IntervalResult, Work, summarize, summarize_intersections
from .scene_contacts import compare_contacts, find_contacts, find_strand_contacts, join_contacts
from .scene_intersections import SceneIntersections, name_intersections
from .scene_proximities import SceneProximities, name_proximities
from .threads import read_ahead
from .validation import validate

__all__ = ["Checks", "IntervalChecker"]


@dataclass(frozen=True)
class Checks:
    """What is looked for in every interval, and how.

    Attributes:
        selection: Which pairs of meshes count.
        method: Method of detection.
        device: Name of the Warp device; None for Warp's default.
        intersections: Whether to find the intersections at each time, and what is inside what.
        min_distance: Distance up to which elements are near each other, None to look for none.
        validate_most: Number of hits, and of other pairs, that the exact checker decides again; None for all.
    """

    selection: Selection
    method: str
    device: str | None
    intersections: bool
    min_distance: float | None
    validate_most: int | None


class IntervalChecker:
    """Checks intervals of a scene. Buffers and trees stay from one to the next."""

    def __init__(self, scene: Scene, checks: Checks, worker: str = ""):
        """Takes the scene, what to look for, and the name of this process for :class:`Work`."""
        self.scene = scene
        self._checks = checks
        self._worker = worker
        self._of_segment: _SegmentChecker | None = None

    def check(self, first: int, stop: int) -> Iterator[IntervalResult]:
        """Finds the collisions in some intervals, in order. A thread reads the next one meanwhile.

        Args:
            first: Number of the first interval.
            stop: Number of the interval after the last one.

        Raises:
            ValueError: If the positions at some time are broken, or there is no such method.
        """
        for reading, interval in read_ahead(_timed(self.scene.intervals(first, stop))):
            started = time.perf_counter()
            checker = self._at(interval)
            result = checker.check(interval)
            yield replace(result, work=Work(self._worker, checker.device, reading, time.perf_counter() - started))

    def selection_without_initial(self) -> Selection:
        """Returns the selection that also ignores what crosses, and that something is inside, at the first time."""
        interval = self.scene.interval(0)
        found = summarize_intersections(self._at(interval).find(interval.x0, interval.start))
        crossing = {(min(names), max(names)) for names, (crossings, _) in found.mesh_pairs.items() if crossings}
        selection = self._checks.selection
        return replace(
            selection,
            ignored_names=selection.ignored_names | crossing,
            ignored_inside=selection.ignored_inside | found.inside.keys(),
        )

    def _at(self, interval: Interval) -> "_SegmentChecker":
        if self._of_segment is None or interval.segment is not self._of_segment.segment:
            self._of_segment = None  # before the next is made, to free its memory
            self._of_segment = _SegmentChecker(interval.segment, self.scene.is_still, self._checks)
        return self._of_segment


class _SegmentChecker:
    """Checks the intervals of one segment."""

    def __init__(self, segment: Segment, is_still: bool, checks: Checks):
        self.segment = segment
        self._is_still = is_still
        self._checks = checks
        self._mesh = CollisionMesh(segment.faces, segment.vertex_count, device=checks.device)
        self._detector = CollisionDetector(self._mesh, method=checks.method)
        self._strands = _StrandChecker(segment, checks) if segment.has_strands else None
        self._finder = self._containment = None
        if checks.intersections:
            self._finder = self._detector.intersection_finder()
            if self._strands:
                self._containment = ContainmentFinder(self._strands.mesh, self._strands.bodies)
            else:
                self._containment = ContainmentFinder(self._mesh, segment.face_meshes)
        self._last: SceneIntersections | None = None  # those found last
        self._found: Intersections | None = None  # those of meshes found last
        distance = checks.min_distance
        self._proximity_finder = None if distance is None else ProximityFinder(self._mesh, distance)
        self._last_near: tuple[np.ndarray, SceneProximities] | None = None  # those found last, and where

    @property
    def device(self) -> str:
        """Name of the Warp device."""
        return self._mesh.device.alias

    def check(self, interval: Interval) -> IntervalResult:
        """Returns the collisions of an interval."""
        detector, most = self._detector, self._checks.validate_most
        start = self.find(interval.x0, interval.start) if self._finder else None
        if self._is_still:  # at rest, coplanar faces would be many collisions between obstacles
            nothing = CollisionMesh(np.empty((0, 3), int), 0, device=self._mesh.device)
            detector = CollisionDetector(nothing, method=detector.method)
            collisions = detector.detect(np.zeros((0, 3)), np.zeros((0, 3)))
        else:
            collisions = detector.detect(interval.x0, interval.x1)
        assert isinstance(collisions, Collisions)  # nothing is captured here
        strands = of_strands = None
        if self._strands and not self._is_still:
            strands, of_strands = self._strands, self._strands.detect(interval)
        intersections = None
        if start is not None:
            intersections = start, self.find(interval.x1, interval.end, None if self._is_still else collisions)
        proximities = None
        if self._proximity_finder:
            near = self._find_near(interval.x0, interval.start)
            proximities = near, self._find_near(interval.x1, interval.end)
        contacts = find_contacts(interval, self._mesh, collisions, self._checks.selection)
        certified, stats = collisions.certified, collisions.stats
        if strands and of_strands:
            more = find_strand_contacts(interval, strands.mesh, of_strands, self._checks.selection)
            contacts, stats = join_contacts(contacts, more), add_stats(stats, of_strands.stats)
            certified &= of_strands.certified
        if intersections:
            contacts = compare_contacts(contacts, *intersections)
        validation = None
        if most != 0:
            validation = validate(
                detector,
                collisions,
                interval.x0,
                interval.x1,
                most=most,
                seed=interval.index,
                counted=contacts.counted,
            )
        summary = summarize(
            contacts,
            intersections,
            proximities,
            certified=certified,
            stats=stats,
            validation=validation,
        )
        return IntervalResult(summary, contacts, intersections, proximities, None)

    def find(self, x: np.ndarray, time: float, collisions: Collisions | None = None) -> SceneIntersections:
        """Returns the intersections at a time, those found last if these are the ones.

        Args:
            x: Positions at that time, shape [vertex_count, 3].
            time: Time code.
            collisions: Those of the motion that has just been detected, from where intersections were found last to
                these positions; None if there is none.
        """
        last = self._last
        if last is None or last.time != time or not (last.x is x or np.array_equal(last.x, x)):
            assert self._finder and self._containment
            selection, meshes = self._checks.selection, self.segment.meshes
            if collisions and self._found:
                self._found = self._finder.find_at_end(x, self._found, collisions)
            else:
                self._found = self._finder.find(x)
            found, mesh = self._found, self._mesh
            if self._strands:
                found = self._strands.with_intersections(found, x, is_end=collisions is not None)
                mesh = self._strands.mesh

            def are_wanted(pairs: np.ndarray) -> np.ndarray:
                ignored = selection.ignored_pairs(meshes, pairs) | selection.may_be_inside(meshes, pairs)
                return selection.counted_pairs(meshes, pairs) & ~ignored

            inside = self._containment.find(x, found, are_wanted)
            self._last = last = name_intersections(self.segment, mesh, found, inside, x, time, selection)
        return last

    def _find_near(self, x: np.ndarray, time: float) -> SceneProximities:
        """Returns the proximities at a time, those found last if these are the ones."""
        if self._last_near:
            last_x, last = self._last_near
            if last.time == time and (last_x is x or np.array_equal(last_x, x)):
                return last
        assert self._proximity_finder
        found = self._proximity_finder.find(x)
        found = name_proximities(self.segment, self._mesh, found, time, self._checks.selection)
        self._last_near = x, found
        return found


class _StrandChecker:
    """Finds the collisions of the curves and points of a segment, and the faces that its curves pass through.

    Attributes:
        mesh: The segment's meshes, curves and points.
    """

    def __init__(self, segment: Segment, checks: Checks):
        self._segment = segment
        self.mesh = CollisionMesh(
            segment.faces,
            segment.vertex_count,
            edges=segment.free_edges,
            points=segment.points,
            radius=segment.radius,
            only_free=True,
            device=checks.device,
        )
        self._detector = CollisionDetector(self.mesh, method=checks.method)
        self._finder = self._detector.intersection_finder() if checks.intersections else None
        self._edges_of_faces = np.setdiff1d(np.arange(len(self.mesh.edges)), self.mesh.free_edges)

    @property
    def bodies(self) -> np.ndarray:
        """Number of the scene's mesh that each face is in, then of the curves that each edge without faces is in."""
        ends = self.mesh.edges[self.mesh.free_edges].astype(np.int64)
        return np.concatenate([self._segment.face_meshes, self._segment.locate_edges(ends)[0]])

    def detect(self, interval: Interval) -> Collisions:
        """Returns the collisions of curves and points in an interval."""
        collisions = self._detector.detect(interval.x0, interval.x1)
        assert isinstance(collisions, Collisions)  # nothing is captured here
        return collisions

    def with_intersections(self, found: Intersections, x: np.ndarray, *, is_end: bool) -> Intersections:
        """Returns intersections of the meshes with those of curves after them, edges as in :attr:`mesh`.

        Args:
            found: Intersections of the meshes alone.
            x: Positions, shape [vertex_count, 3].
            is_end: Whether a motion that ends there has just been detected.
        """
        assert self._finder
        more = self._finder.find(x, is_end=is_end)
        own = np.stack([self._edges_of_faces[found.pairs[:, 0]], found.pairs[:, 1]], axis=1)
        return Intersections(np.concatenate([own, more.pairs]), np.concatenate([found.crosses, more.crosses]))


def _timed(intervals: Iterable[Interval]) -> Iterator[tuple[float, Interval]]:
    """Yields intervals with the time to read each [s]."""
    started = time.perf_counter()
    for interval in intervals:
        yield time.perf_counter() - started, interval
        started = time.perf_counter()
