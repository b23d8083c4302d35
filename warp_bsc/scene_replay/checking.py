"""Checks the intervals of a scene in one process, as a pipeline of three phases.

While the results of one interval are named, the next one is detected (on a CPU) and the one after it is read.
"""

import math
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Generic, Literal, TypeVar

import numpy as np

from ..detection.arcs.rigid_motion import RigidMotion
from ..detection.at_rest.containment import ContainmentFinder
from ..detection.at_rest.intersections import Intersections
from ..detection.at_rest.proximities import Proximities, ProximityFinder
from ..detection.detector import CollisionDetector
from ..detection.inversions import Inversions
from ..detection.mesh import CollisionMesh
from ..detection.results.collisions import Collisions, add_stats
from ..detection.run.settings import Method
from ..detection.run.start import is_cpu
from ..usd.interval import Interval
from ..usd.scene import Scene
from ..usd.segment import Segment
from ..usd.selection import Selection
from .duplicates import Duplicates
from .results import IntervalResult, Work, summarize, summarize_intersections, summarize_inversions
from .scene_arcs import arcs_of
from .scene_contacts import compare_contacts, find_contacts, join_contacts
from .scene_intersections import SceneIntersections, name_intersections
from .scene_proximities import SceneProximities, name_proximities
from .threads import read_ahead
from .validation import validate

_Found = TypeVar("_Found")


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
        for work, namer, detection in detections:
            started = time.perf_counter()
            result = namer.name(detection)
            yield replace(result, work=replace(work, checking=work.checking + time.perf_counter() - started))

    def selection_without_initial(self) -> Selection:
        """Returns the selection that also ignores the pairs that cross, or are inside each other, at the first time."""
        interval = self.scene.interval(0)
        detector, namer = self._at(interval)
        found = detector.find_intersections(interval.x0, interval.start)
        found = summarize_intersections(namer.name_intersections(found, interval.x0, interval.start))
        crossing = {(min(names), max(names)) for names, (crossings, _) in found.mesh_pairs.items() if crossings}
        selection = self._checks.selection
        return replace(
            selection,
            ignored_names=selection.ignored_names | crossing,
            ignored_inside=selection.ignored_inside | found.inside.keys(),
        )

    def _detect(self, first: int, stop: int, deadline: float) -> Iterator[tuple[Work, "_SegmentNamer", "_Detection"]]:
        """Yields the work on some intervals, the namers of their segments, and what is detected in them."""
        for reading, interval in read_ahead(_timed(self.scene.intervals(first, stop), deadline)):
            started = time.perf_counter()
            detector, namer = self._at(interval)
            detection = detector.detect(interval)
            yield Work(self._worker, detector.device, reading, time.perf_counter() - started), namer, detection

    def _at(self, interval: Interval) -> tuple["_SegmentDetector", "_SegmentNamer"]:
        if self._of_segment is None or interval.segment is not self._of_segment[1].segment:
            self._of_segment = None  # before the next is made, to free its memory
            detector = _SegmentDetector(interval.segment, self._checks)
            self._of_segment = detector, _SegmentNamer(interval.segment, detector, self._checks)
        return self._of_segment


@dataclass(frozen=True)
class _Detection:
    """The collisions, intersections and proximities that are detected in an interval.

    Attributes:
        interval: The interval.
        arcs: The motion of vertices on arcs; None if all move straight.
        collisions: Collisions of meshes.
        of_strands: Collisions of curves and points; None without any.
        intersections: Intersections at the start and at the end; None if they are not checked.
        proximities: Proximities at the start and at the end; None if they are not checked.
        inversions: The tetrahedra that invert; None without any tetrahedra.
        detector: The detector of the collisions of meshes if they are validated, else None.
    """

    interval: Interval
    arcs: RigidMotion | None
    collisions: Collisions
    of_strands: Collisions | None
    intersections: tuple[Intersections, Intersections] | None
    proximities: tuple[Proximities, Proximities] | None
    inversions: Inversions | None
    detector: CollisionDetector | None


@dataclass(frozen=True)
class _At(Generic[_Found]):
    """Intersections or proximities of one time, kept for the interval that starts then."""

    time: float
    x: np.ndarray
    found: _Found

    def is_at(self, x: np.ndarray, time: float) -> bool:
        """Returns whether they are of a time and of positions."""
        return self.time == time and (self.x is x or np.array_equal(self.x, x))


class _SegmentDetector:
    """Detects collisions, intersections and proximities in the intervals of one segment.

    Attributes:
        mesh: The segment's meshes.
        device: Name of the Warp device.
        strands: Detects the collisions of its curves and points; None without any.
    """

    def __init__(self, segment: Segment, checks: Checks):
        self._is_validated = checks.validate != 0
        self.mesh = CollisionMesh(segment.faces, segment.vertex_count, device=checks.device)
        self.device = self.mesh.device.alias
        self._detector = CollisionDetector(self.mesh, method=checks.method)
        self.strands = _StrandChecker(segment, checks) if segment.has_strands else None
        self._finder = self._detector.intersection_finder() if checks.intersections else None
        self._intersections: _At[tuple[Intersections, Intersections]] | None = None  # of meshes, and of all
        tets, self._inversions = segment.tetrahedra, None
        if len(tets.corners):
            mesh = CollisionMesh(np.empty((0, 3), int), tets.vertex_count, tets=tets.corners, device=checks.device)
            self._inversions = CollisionDetector(mesh, method=checks.method)
        clearance = checks.clearance
        self._proximity_finder = None if clearance is None else ProximityFinder(self.mesh, clearance)
        self._proximities: _At[Proximities] | None = None

    def detect(self, interval: Interval) -> _Detection:
        """Returns the detected collisions, intersections and proximities of an interval."""
        detector, arcs = self._detector, arcs_of(interval)
        start = self.find_intersections(interval.x0, interval.start) if self._finder else None
        if interval.is_at_rest:  # at rest, coplanar faces would be many collisions between obstacles
            nothing = CollisionMesh(np.empty((0, 3), int), 0, device=self.mesh.device)
            detector = CollisionDetector(nothing, method=detector.method)
            collisions = detector.detect(np.zeros((0, 3)), np.zeros((0, 3)))
        else:
            collisions = detector.detect(interval.x0, interval.x1, rigid_motion=arcs)
        of_strands = self.strands.detect(interval, arcs) if self.strands and not interval.is_at_rest else None
        intersections = None
        if start:
            motion = None if interval.is_at_rest or arcs else collisions
            intersections = start, self.find_intersections(interval.x1, interval.end, motion)
        proximities = None
        if self._proximity_finder:
            at_start = self._find_proximities(interval.x0, interval.start)
            proximities = at_start, self._find_proximities(interval.x1, interval.end)
        inversions = self._inversions and self._inversions.inversions(*interval.tet_positions)
        validated = detector if self._is_validated else None
        return _Detection(interval, arcs, collisions, of_strands, intersections, proximities, inversions, validated)

    def find_intersections(self, x: np.ndarray, time: float, collisions: Collisions | None = None) -> Intersections:
        """Returns the intersections at a time; those found last, if they are of that time.

        Args:
            x: Positions at that time, shape [vertex_count, 3].
            time: Time code.
            collisions: Those of the motion to these positions from the positions of the intersections found last, if
                it has just been detected; else None.
        """
        last = self._intersections
        if last is None or not last.is_at(x, time):
            assert self._finder
            if last and collisions:
                of_meshes = self._finder.find_at_end(x, last.found[0], collisions)
            else:
                of_meshes = self._finder.find(x)
            found = of_meshes
            if self.strands:
                found = self.strands.with_intersections(of_meshes, x, is_end=collisions is not None)
            self._intersections = last = _At(time, x, (of_meshes, found))
        return last.found[1]

    def _find_proximities(self, x: np.ndarray, time: float) -> Proximities:
        """Returns the proximities at a time; those found last, if they are of that time."""
        if self._proximities is None or not self._proximities.is_at(x, time):
            assert self._proximity_finder
            self._proximities = _At(time, x, self._proximity_finder.find(x))
        return self._proximities.found


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
        self._intersections: tuple[Intersections, SceneIntersections] | None = None  # those named last
        self._proximities: tuple[Proximities, SceneProximities] | None = None

    def name(self, detection: _Detection) -> IntervalResult:
        """Returns the result of an interval."""
        interval, collisions, selection = detection.interval, detection.collisions, self._checks.selection
        intersections = proximities = None
        if detection.intersections:
            start, end = detection.intersections
            named = self.name_intersections(start, interval.x0, interval.start)
            intersections = named, self.name_intersections(end, interval.x1, interval.end)
        if detection.proximities:
            start, end = detection.proximities
            proximities = self._name_proximities(start, interval.start), self._name_proximities(end, interval.end)
        contacts = find_contacts(interval, self._mesh, collisions, selection, detection.arcs)
        certified, stats = collisions.certified, collisions.stats
        if detection.of_strands:
            assert self._strand_mesh
            more = find_contacts(interval, self._strand_mesh, detection.of_strands, selection, detection.arcs)
            contacts, stats = join_contacts(contacts, more), add_stats(stats, detection.of_strands.stats)
            certified &= detection.of_strands.certified
        if intersections:
            contacts = compare_contacts(contacts, *intersections)
        validation = None
        if detection.detector:
            validation = validate(
                detection.detector,
                collisions,
                interval.x0,
                interval.x1,
                most=None if self._checks.validate == "all" else self._checks.validate,
                seed=interval.index,
                counted=contacts.counted,
                turns=None if detection.arcs is None else detection.arcs.body >= 0,
            )
        summary = summarize(
            contacts,
            intersections,
            proximities,
            certified=certified,
            stats=stats,
            validation=validation,
            duplicates=self._named_duplicates,
            inverted=summarize_inversions(detection.inversions, interval) if detection.inversions else (),
        )
        return IntervalResult(summary, contacts, intersections, proximities, None)

    def name_intersections(self, found: Intersections, x: np.ndarray, time: float) -> SceneIntersections:
        """Returns the named intersections of a time, with the parts inside meshes; those named last, if the same.

        Arguments are those of :func:`.scene_intersections.name_intersections`.
        """
        if self._intersections is None or self._intersections[0] is not found:
            assert self._containment and self._duplicates
            selection, meshes = self._checks.selection, self.segment.meshes

            def are_checked(pairs: np.ndarray) -> np.ndarray:
                ignored = selection.ignored_pairs(meshes, pairs) | selection.may_be_inside(meshes, pairs)
                return selection.counted_pairs(meshes, pairs) & ~ignored

            inside = self._containment.find(x, found, self._duplicates.may_be_checked(are_checked))
            inside = self._duplicates.with_twins(inside, are_checked)
            mesh = self._strand_mesh or self._mesh
            self._intersections = (found, name_intersections(self.segment, mesh, found, inside, x, time, selection))
        return self._intersections[1]

    def _name_proximities(self, found: Proximities, time: float) -> SceneProximities:
        """Returns the named proximities of a time; those named last, if the same."""
        if self._proximities is None or self._proximities[0] is not found:
            named = name_proximities(self.segment, self._mesh, found, time, self._checks.selection)
            self._proximities = found, named
        return self._proximities[1]


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


def _timed(intervals: Iterable[Interval], deadline: float) -> Iterator[tuple[float, Interval]]:
    """Yields intervals, at least one, with the time to read each [s], until a deadline."""
    started = time.perf_counter()
    for interval in intervals:
        yield time.perf_counter() - started, interval
        if time.monotonic() > deadline:
            return
        started = time.perf_counter()
