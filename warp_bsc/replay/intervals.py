"""Replays a USD scene: finds the collisions between each two consecutive times, holding one interval at a time."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..detection.collisions import Collisions, DetectionStats
from ..detection.detector import CollisionDetector
from ..detection.mesh import CollisionMesh
from ..detection.proximities import ProximityFinder
from ..usd.interval import Interval
from ..usd.scene import Scene
from ..usd.segment import Segment
from ..usd.selection import Selection
from .scene_contacts import PHASES, SceneContacts, find_contacts
from .scene_intersections import SceneIntersections, name_intersections
from .scene_pairs import count_by_meshes
from .scene_proximities import SceneProximities, name_proximities
from .threads import read_ahead
from .validation import Validation, validate

__all__ = [
    "TOI_BINS",
    "Contact",
    "IntersectionSummary",
    "IntervalResult",
    "IntervalSummary",
    "Nearest",
    "ProximitySummary",
    "replay",
]

TOI_BINS = 20
"""Number of equal parts of an interval in which times of impact are counted."""


@dataclass(frozen=True)
class Contact:
    """A collision of two meshes, or of a mesh with itself, in words.

    Attributes:
        meshes: Names of the two.
        elements: The two elements, in the prims' own numbers, such as ``"vertex 12"``, ``"face 3"`` or ``"edge 4-5"``.
        toi: Time of impact, 0 at the start of the interval and 1 at its end.
        time: The same as a time code.
    """

    meshes: tuple[str, str]
    elements: tuple[str, str]
    toi: float
    time: float


@dataclass(frozen=True)
class IntersectionSummary:
    """The edges that meet faces at one time of a scene, in numbers.

    Attributes:
        time: Time code.
        crossings: Number of edges that pass through faces: pairs of an edge and a face.
        touches: Number of edges that only touch faces.
        mesh_pairs: Both numbers for each two meshes that intersect, by their names, in order; a mesh that intersects
            itself is there twice.
    """

    time: float
    crossings: int
    touches: int
    mesh_pairs: dict[tuple[str, str], tuple[int, int]]


@dataclass(frozen=True)
class Nearest:
    """The nearest two elements of two meshes at one time, or of a mesh and itself, in words.

    Attributes:
        meshes: Names of the two meshes.
        elements: The two elements, as of :class:`Contact`.
        time: Time code.
        distance: Distance of the elements, in the scene's unit of length.
        position: Point halfway between their closest points, in world space.
        pairs: Number of pairs of elements of the two meshes that are near at that time.
    """

    meshes: tuple[str, str]
    elements: tuple[str, str]
    time: float
    distance: float
    position: tuple[float, float, float]
    pairs: int


@dataclass(frozen=True)
class ProximitySummary:
    """The pairs of elements that are near each other at one time of a scene, in numbers.

    Attributes:
        time: Time code.
        pairs: Number of pairs.
        nearest: The nearest elements of each two meshes that are near each other, the nearest first.
    """

    time: float
    pairs: int
    nearest: tuple[Nearest, ...]


@dataclass(frozen=True)
class IntervalSummary:
    """The collisions between two consecutive times of a scene, in numbers.

    Attributes:
        index: Number of the interval, from 0.
        start: Time code at which it starts.
        end: Time code at which it ends.
        vertex_face_hits: Number of vertex-face pairs that collide.
        edge_edge_hits: Number of edge-edge pairs that collide.
        toi_counts: Number of pairs by their time of impact, in equal parts of the interval.
        mesh_pairs: Number of pairs that collide for each two meshes, by their names, in order; a mesh that collides
            with itself is there twice.
        earliest: The earliest contact, None if there is none.
        certified: Whether floating point or exact arithmetic has shown that no collision is missing, for vertices that
            move straight from the start to the end.
        stats: Counts and times of the detector's stages; the counts include pairs that the selection excludes.
        validation: The comparison with the exact checker, None if none was asked for.
        intersections: The intersections at the start and at the end; None if they were not looked for. The end is the
            moment just before the end where a mesh jumps, as in :class:`~warp_bsc.usd.interval.Interval`.
        separate_hits: Number of pairs that collide and whose two meshes did not intersect at the start; None as above.
        ignored: Number of pairs that collide and are ignored, by the names of their meshes, in order.
        phases: Number of pairs that collide by :data:`~warp_bsc.replay.scene_contacts.PHASES`; None as above.
        proximities: The proximities at the start and at the end, as ``intersections``; None if they were not looked
            for.
    """

    index: int
    start: float
    end: float
    vertex_face_hits: int
    edge_edge_hits: int
    toi_counts: tuple[int, ...]
    mesh_pairs: dict[tuple[str, str], int]
    earliest: Contact | None
    certified: bool
    stats: DetectionStats
    validation: Validation | None
    intersections: tuple[IntersectionSummary, IntersectionSummary] | None
    ignored: dict[tuple[str, str], int]
    separate_hits: int | None
    phases: tuple[int, ...] | None
    proximities: tuple[ProximitySummary, ProximitySummary] | None

    @property
    def hits(self) -> int:
        """Number of pairs that collide."""
        return self.vertex_face_hits + self.edge_edge_hits

    @property
    def pairs_tested(self) -> int:
        """Number of candidate pairs."""
        return self.stats.vertex_face.candidates + self.stats.edge_edge.candidates

    @property
    def milliseconds(self) -> float:
        """Time of the detector's stages together [ms]."""
        return sum(self.stats.milliseconds.values())


@dataclass(frozen=True)
class IntervalResult:
    """The collisions between two consecutive times of a scene.

    Attributes:
        summary: The numbers, which are small and can be kept for all intervals.
        contacts: Every pair that collides, and the positions of all vertices.
        intersections: Every edge that meets a face, at the start of the interval and at its end; None if they were not
            looked for. Where nothing jumps, those at the end are the next interval's at its start, the same object.
        proximities: The pairs of elements that are near each other, at both times, as ``intersections``.
    """

    summary: IntervalSummary
    contacts: SceneContacts
    intersections: tuple[SceneIntersections, SceneIntersections] | None
    proximities: tuple[SceneProximities, SceneProximities] | None


def replay(
    scene: Scene,
    *,
    method: str = "exact",
    device: Any = None,
    intersections: bool = True,
    ignore_initial: bool = False,
    min_distance: float | None = None,
    validate_most: int | None = 0,
) -> Iterator[IntervalResult]:
    """Finds the collisions in every interval between two consecutive times of a scene, one interval at a time.

    Meshes that never move are obstacles: contacts between these are not counted, nor are contacts of a mesh with itself
    if only its transform moves it. Vertices are taken to move straight from the start of an interval to its end. The
    edges that pass through faces at the times themselves are found as well, between obstacles too::

        import warp_bsc as bsc

        selection = bsc.Selection(exclude=("/World/Hair",))
        scene = bsc.Scene("scene.usd", frames=bsc.FrameRange(101.0, 150.0), selection=selection)
        for interval in bsc.replay(scene, ignore_initial=True):
            contacts = interval.contacts
            for rows in contacts.chunks():  # 4,096 pairs at a time, as text takes memory
                for meshes, elements in zip(contacts.mesh_names(rows), contacts.element_names(rows)):
                    print(interval.summary.start, meshes, elements)
            print(contacts.toi, contacts.position, contacts.separate)
            start, end = interval.intersections
            print(start.crossings, start.position[start.crosses], start.cuts.points)

    Args:
        scene: The scene; its selection says which pairs count.
        method: ``"float"``, ``"conservative"`` or ``"exact"``, for collisions; intersections are always exact.
        device: Warp device or its name; default: Warp's default.
        intersections: Whether to find the intersections at each time.
        ignore_initial: Whether to ignore all pairs of meshes that cross at the first time, and meshes that cross
            themselves then: their collisions and intersections are only counted.
        min_distance: Distance up to which elements are found to be near each other at each time, in the scene's unit of
            length: a vertex and a face, or two edges, that share no vertex and that no edge joins. No such pair is
            missing, see :meth:`~warp_bsc.detection.proximities.ProximityFinder.find`; but nothing is found between the
            times, and where an edge passes through a face, both may be far from each other's borders: these are
            intersections. None to look for none.
        validate_most: Number of hits, and of other pairs, of each interval that the exact checker decides again; None
            for all.

    Yields:
        IntervalResult: The collisions of one interval. Only what the caller keeps stays in memory. A thread reads the
        next interval meanwhile.

    Raises:
        ValueError: If the positions at some time are broken, there is no such method, initial intersections are to be
            ignored and none are to be found, or the distance is no finite number more than 0.
    """
    if ignore_initial and not intersections:
        raise ValueError("what crosses at first can be ignored only if intersections are found")
    selection, segment_replay = scene.selection, None
    for interval in read_ahead(scene):
        if segment_replay is None or interval.segment is not segment_replay.segment:
            is_first, segment_replay = segment_replay is None, None  # before the next is made, to free its memory
            segment_replay = _SegmentReplay(
                interval.segment, scene.is_still, method, device, intersections, min_distance
            )
            if is_first and ignore_initial:
                at_first = _summarize_intersections(segment_replay.find(interval.x0, interval.start, selection))
                crossing = {tuple(sorted(names)) for names, (crossings, _) in at_first.mesh_pairs.items() if crossings}
                selection = replace(selection, ignored_names=selection.ignored_names | crossing)
                segment_replay.forget()
        yield segment_replay.check(interval, selection, validate_most)


class _SegmentReplay:
    """Checks the intervals of one segment."""

    def __init__(
        self,
        segment: Segment,
        is_still: bool,
        method: str,
        device: Any,
        intersections: bool,
        min_distance: float | None,
    ):
        self.segment = segment
        self._is_still = is_still
        self._mesh = CollisionMesh(segment.faces, segment.vertex_count, device=device)
        self._detector = CollisionDetector(self._mesh, method=method)
        self._finder = self._detector.intersection_finder() if intersections else None
        self._last: SceneIntersections | None = None  # those found last
        self._proximity_finder = None if min_distance is None else ProximityFinder(self._mesh, min_distance)
        self._last_near: tuple[np.ndarray, SceneProximities] | None = None  # those found last, and where

    def check(self, interval: Interval, selection: Selection, validate_most: int | None) -> IntervalResult:
        """Returns the collisions of an interval."""
        detector = self._detector
        start = self.find(interval.x0, interval.start, selection) if self._finder else None
        if self._is_still:  # at rest, coplanar faces would be many collisions between obstacles
            nothing = CollisionMesh(np.empty((0, 3), int), 0, device=self._mesh.device)
            detector = CollisionDetector(nothing, method=detector.method)
            collisions = detector.detect(np.zeros((0, 3)), np.zeros((0, 3)))
        else:
            collisions = detector.detect(interval.x0, interval.x1)
        assert isinstance(collisions, Collisions)  # nothing is captured here
        intersections = None
        if start is not None:
            intersections = start, self.find(interval.x1, interval.end, selection, is_end=not self._is_still)
        proximities = None
        if self._proximity_finder:
            near = self._find_near(interval.x0, interval.start, selection)
            proximities = near, self._find_near(interval.x1, interval.end, selection)
        contacts = find_contacts(interval, self._mesh, collisions, selection, intersections)
        validation = None
        if validate_most != 0:
            validation = validate(
                detector,
                collisions,
                interval.x0,
                interval.x1,
                most=validate_most,
                seed=interval.index,
                counted=contacts.counted,
            )
        summary = _summarize(contacts, collisions, intersections, proximities, validation)
        return IntervalResult(summary, contacts, intersections, proximities)

    def find(self, x: np.ndarray, time: float, selection: Selection, *, is_end: bool = False) -> SceneIntersections:
        """Returns the intersections at a time, those found last if these are the ones.

        Args:
            x: Positions at that time, shape [vertex_count, 3].
            time: Time code.
            selection: Which pairs of meshes count.
            is_end: Whether a motion that ends there has just been detected.
        """
        last = self._last
        if last is None or last.time != time or not (last.x is x or np.array_equal(last.x, x)):
            assert self._finder
            found = self._finder.find(x, is_end=is_end)
            self._last = last = name_intersections(self.segment, self._mesh, found, x, time, selection)
        return last

    def _find_near(self, x: np.ndarray, time: float, selection: Selection) -> SceneProximities:
        """Returns the proximities at a time, those found last if these are the ones."""
        if self._last_near:
            last_x, last = self._last_near
            if last.time == time and (last_x is x or np.array_equal(last_x, x)):
                return last
        assert self._proximity_finder
        found = name_proximities(self.segment, self._mesh, self._proximity_finder.find(x), time, selection)
        self._last_near = x, found
        return found

    def forget(self) -> None:
        """Forgets what was found last: another selection counts."""
        self._last = None


def _summarize(contacts, collisions, intersections, proximities, validation) -> IntervalSummary:
    interval, earliest = contacts.interval, None
    if len(contacts):
        first = int(np.argmin(contacts.toi))
        row = slice(first, first + 1)
        earliest = Contact(
            contacts.mesh_names(row)[0],
            contacts.element_names(row)[0],
            float(contacts.toi[first]),
            float(contacts.time[first]),
        )
    at_rest = None
    if intersections:
        start, end = map(_summarize_intersections, intersections)
        at_rest = start, end
    near = None
    if proximities:
        start, end = map(_summarize_proximities, proximities)
        near = start, end
    hits_by_meshes = count_by_meshes(contacts.segment, contacts.meshes)
    edge_edge = int(contacts.kind.sum())
    return IntervalSummary(
        index=interval.index,
        start=interval.start,
        end=interval.end,
        vertex_face_hits=len(contacts) - edge_edge,
        edge_edge_hits=edge_edge,
        toi_counts=tuple(np.histogram(contacts.toi, bins=TOI_BINS, range=(0.0, 1.0))[0].tolist()),
        mesh_pairs={names: hits for names, (hits,) in hits_by_meshes.items()},
        earliest=earliest,
        certified=collisions.certified,
        stats=collisions.stats,
        validation=validation,
        intersections=at_rest,
        ignored=contacts.ignored,
        separate_hits=int(contacts.separate.sum()) if intersections else None,
        phases=tuple(np.bincount(contacts.phase, minlength=len(PHASES)).tolist()) if intersections else None,
        proximities=near,
    )


def _summarize_intersections(found: SceneIntersections) -> IntersectionSummary:
    by_meshes = count_by_meshes(found.segment, found.meshes, np.stack([found.crosses, ~found.crosses], axis=1))
    return IntersectionSummary(
        found.time, found.crossings, found.touches, {names: (a, b) for names, (a, b) in by_meshes.items()}
    )


def _summarize_proximities(found: SceneProximities) -> ProximitySummary:
    order = np.argsort(found.distance, kind="stable")
    _, firsts, numbers = np.unique(found.mesh_keys()[order], return_index=True, return_counts=True)
    nearest = []
    for place in np.argsort(firsts).tolist():
        row = int(order[firsts[place]])
        rows = slice(row, row + 1)
        x, y, z = found.position[row].tolist()
        nearest.append(
            Nearest(
                found.mesh_names(rows)[0],
                found.element_names(rows)[0],
                found.time,
                float(found.distance[row]),
                (x, y, z),
                int(numbers[place]),
            )
        )
    return ProximitySummary(found.time, len(found), tuple(nearest))
