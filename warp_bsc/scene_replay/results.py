"""The result of a replay in one interval, in full and in numbers."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from ..detection.inversions import Inversions
from ..detection.results.collisions import DetectionStats
from ..detection.run.settings import PairKind
from ..usd.interval import Interval
from ..usd.selection import Meant
from .scene_contacts import SceneContacts
from .scene_intersections import IntersectionSummary, SceneIntersections
from .scene_pairs import KINDS, PHASES, count_by_meshes
from .scene_proximities import SceneProximities
from .validation import Validation

MOST_TETRAHEDRA = 1000
"""Largest number of tetrahedra of a mesh that a summary names."""

TOI_BINS = 20
"""Number of equal parts of an interval in which times of impact are counted."""

_ENDS_OF_BINS = np.linspace(0.0, 1.0, TOI_BINS + 1)[1:]


AnyPairs = SceneContacts | SceneIntersections | SceneProximities
"""Pairs of an interval, or of a time."""

_Found, _Made = TypeVar("_Found"), TypeVar("_Made")


@dataclass(frozen=True)
class Contact:
    """A collision of two meshes, or of a mesh with itself, in words.

    Attributes:
        meshes: Names of the two.
        elements: The two elements, in the prims' own numbers, such as ``"vertex 12"``, ``"face 3"`` or ``"edge 4-5"``.
        toi: Time of impact, 0 at the start of the interval and 1 at its end.
        time: The same as a time code.
        position: Point in which they meet, in world space and the scene's unit of length.
    """

    meshes: tuple[str, str]
    elements: tuple[str, str]
    toi: float
    time: float
    position: tuple[float, float, float]


@dataclass(frozen=True)
class IgnoredPair:
    """Two meshes whose collisions and intersections are only counted.

    Attributes:
        meshes: Names of the two, sorted.
        hits: Number of their pairs that collide.
        edges: Largest number of edges of one that meet faces of the other at a time.
        meant: The entry of the triage by which they are meant to meet; None if an option ignores them.
    """

    meshes: tuple[str, str]
    hits: int
    edges: int
    meant: Meant | None

    def __str__(self) -> str:
        """Returns the numbers, the meshes and the reason, in words."""
        first, second = self.meshes
        edges = f", at most {self.edges:,} edges in faces" * bool(self.edges)
        reason = f": {self.meant}" if self.meant else ""
        return f"{self.hits:,} of {first} with {'itself' if first == second else second}{edges}{reason}"


@dataclass(frozen=True)
class Nearest:
    """The nearest two elements of two meshes, or of a mesh and itself, at one time, in words.

    Attributes:
        meshes: Names of the two meshes.
        elements: The two elements, as of :class:`Contact`.
        time: Time code.
        distance: Distance of the elements, in the scene's unit of length.
        position: Point halfway between their closest points, in world space.
        pairs: Number of proximities of the two meshes at that time.
    """

    meshes: tuple[str, str]
    elements: tuple[str, str]
    time: float
    distance: float
    position: tuple[float, float, float]
    pairs: int


@dataclass(frozen=True)
class ProximitySummary:
    """The proximities at one time of a scene, in numbers.

    Attributes:
        time: Time code.
        pairs: Number of pairs.
        nearest: The nearest elements of each two meshes with a proximity, by ascending distance.
    """

    time: float
    pairs: int
    nearest: tuple[Nearest, ...]


@dataclass(frozen=True)
class InvertedTetrahedra:
    """The tetrahedra of a mesh whose volume, in the space of its prim, is not positive at some time of an interval.

    Attributes:
        meshes: Name of the mesh.
        number: Number of the tetrahedra.
        tetrahedra: Their indices in ``tetVertexIndices``, those that invert first coming first, at most
            :data:`MOST_TETRAHEDRA`.
        times: Time code at which each of these inverts; the start of the interval if it is inverted there.
    """

    meshes: tuple[str]
    number: int
    tetrahedra: tuple[int, ...]
    times: tuple[float, ...]


@dataclass(frozen=True)
class IntervalSummary:
    """The collisions between two consecutive times of a scene, in numbers.

    Attributes:
        index: Number of the interval, from 0.
        start: Time code at which it starts.
        end: Time code at which it ends.
        vertex_face_hits: Number of vertex-face pairs that collide.
        edge_edge_hits: Number of edge-edge pairs that collide.
        vertex_edge_hits: Number of pairs of a point and an edge of a curve that collide.
        vertex_vertex_hits: Number of pairs of points that collide.
        toi_counts: Number of pairs by their time of impact, in equal parts of the interval.
        mesh_pairs: Number of pairs that collide by the names of their two meshes, in the scene's order; twice the same
            name for a mesh that collides with itself.
        earliest: The earliest contact, None if there is none.
        certified: Whether floating point or exact arithmetic has certified that no collision is missing, for vertices
            that move straight from the start to the end.
        stats: Counts and times of the detector's phases; the counts include pairs that the selection excludes.
        validation: The comparison with the exact checker, None without validation.
        intersections: The intersections at the start and at the end; None if they were not checked. The end is the
            moment just before the end where a mesh jumps, as in :class:`~warp_bsc.usd.interval.Interval`.
        separate_hits: Number of pairs that collide and whose two meshes did not intersect at the start; None if
            intersections were not checked.
        ignored: Number of pairs that collide and are ignored, by the names of their two meshes, in the scene's order.
        phases: Number of pairs of meshes that collide by :data:`~warp_bsc.scene_replay.scene_pairs.PHASES`; None if
            intersections were not checked.
        proximities: The proximities at the start and at the end, as ``intersections``; None without a clearance.
        duplicates: Names of duplicates, see :class:`~warp_bsc.scene_replay.duplicates.Duplicates`, by
            their names, in the scene's order; empty if intersections were not checked.
        inverted: The tetrahedra that invert or are inverted, by mesh, in the scene's order.
    """

    index: int
    start: float
    end: float
    vertex_face_hits: int
    edge_edge_hits: int
    vertex_edge_hits: int
    vertex_vertex_hits: int
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
    duplicates: tuple[tuple[str, ...], ...]
    inverted: tuple[InvertedTetrahedra, ...]

    @property
    def hits(self) -> int:
        """Number of pairs that collide."""
        return self.vertex_face_hits + self.edge_edge_hits + self.vertex_edge_hits + self.vertex_vertex_hits

    @property
    def pairs_tested(self) -> int:
        """Number of candidate pairs."""
        return sum(getattr(self.stats, kind.label).candidates for kind in PairKind)

    @property
    def unsure(self) -> int:
        """Number of candidate pairs that floating point could not certify."""
        return sum(getattr(self.stats, kind.label).unsure for kind in PairKind)


@dataclass(frozen=True)
class Work:
    """A measurement of the work for one interval.

    Attributes:
        worker: Name of the process; empty for the one that writes the results.
        device: Name of the Warp device that it used.
        reading: Time to read the scene's samples [s]. Other intervals may be read and checked meanwhile.
        checking: Time to check them [s].
    """

    worker: str
    device: str
    reading: float
    checking: float


@dataclass(frozen=True)
class IntervalResult:
    """The collisions between two consecutive times of a scene.

    Attributes:
        summary: The numbers, small enough to be kept for all intervals.
        contacts: Every pair that collides, and the positions of all vertices.
        intersections: Every edge that meets a face, at the start of the interval and at its end; None if they were not
            checked. Where nothing jumps, those at the end are the same object as the next interval's at its start.
        proximities: The proximities at both times, as ``intersections``; None without a clearance.
        work: The process and its times; None for a result of an earlier replay.
    """

    summary: IntervalSummary
    contacts: SceneContacts
    intersections: tuple[SceneIntersections, SceneIntersections] | None
    proximities: tuple[SceneProximities, SceneProximities] | None
    work: Work | None

    def pairs(self, *, is_last: bool) -> list[AnyPairs]:
        """Returns all pairs in the order of files: contacts, then those at rest.

        Those at the end of an interval are those at the start of the next: only the last interval has both.
        """
        times = 2 if is_last and self.summary.end > self.summary.start else 1
        return [self.contacts, *(self.intersections or ())[:times], *(self.proximities or ())[:times]]


def at_both(make: Callable[[_Found], _Made], found: tuple[_Found, _Found] | None) -> tuple[_Made, _Made] | None:
    """Returns what a function makes of findings at the start and at the end of an interval; None without findings."""
    return (make(found[0]), make(found[1])) if found else None


def summarize(
    contacts: SceneContacts,
    intersections: tuple[SceneIntersections, SceneIntersections] | None,
    proximities: tuple[SceneProximities, SceneProximities] | None,
    **others: Any,
) -> IntervalSummary:
    """Returns the numbers of an interval; the arguments are attributes of its result, and others of its summary."""
    interval, earliest = contacts.interval, None
    if len(contacts):
        first = int(np.argmin(contacts.toi))
        meshes, elements, place = _in_words(contacts, first)
        earliest = Contact(meshes, elements, float(contacts.toi[first]), float(contacts.time[first]), place)
    of = contacts.phase
    phases = None if of is None else tuple(np.bincount(of[of >= 0], minlength=len(PHASES)).tolist())
    hits_by_meshes = count_by_meshes(contacts.segment, contacts.meshes)
    bins = np.minimum(np.searchsorted(_ENDS_OF_BINS, contacts.toi, side="right"), TOI_BINS - 1)
    by_kind = np.bincount(contacts.kind, minlength=len(KINDS)).tolist()
    return IntervalSummary(
        index=interval.index,
        start=interval.start,
        end=interval.end,
        **{f"{kind.label}_hits": by_kind[kind] for kind in PairKind},
        toi_counts=tuple(np.bincount(bins, minlength=TOI_BINS).tolist()),
        mesh_pairs={names: hits for names, (hits,) in hits_by_meshes.items()},
        earliest=earliest,
        intersections=at_both(lambda found: found.summary, intersections),
        ignored=contacts.ignored,
        separate_hits=None if contacts.separate is None else int(contacts.separate.sum()),
        phases=phases,
        proximities=at_both(_summarize_proximities, proximities),
        **others,
    )


def summarize_inversions(found: Inversions, interval: Interval) -> tuple[InvertedTetrahedra, ...]:
    """Returns the tetrahedra of each mesh that invert in an interval."""
    tetrahedra, inverted = interval.segment.tetrahedra, []
    mesh_of = np.searchsorted(tetrahedra.first, found.tets, side="right") - 1
    times = interval.start + found.toi * (interval.end - interval.start)
    for mesh in np.unique(mesh_of).tolist():
        (rows,) = np.nonzero(mesh_of == mesh)
        first = rows[np.argsort(times[rows], kind="stable")][:MOST_TETRAHEDRA]
        numbers = (found.tets[first] - tetrahedra.first[mesh]).tolist()
        names = (tetrahedra.names[mesh],)
        inverted.append(InvertedTetrahedra(names, len(rows), tuple(numbers), tuple(times[first].tolist())))
    return tuple(inverted)


def _in_words(pairs: AnyPairs, row: int) -> tuple[tuple[str, str], tuple[str, str], tuple[float, float, float]]:
    """Returns the names of the meshes and the elements of a pair, and its position."""
    (meshes,), (elements,) = (names(slice(row, row + 1)) for names in (pairs.mesh_names, pairs.element_names))
    x, y, z = pairs.position[row].tolist()
    return meshes, elements, (x, y, z)


def _summarize_proximities(found: SceneProximities) -> ProximitySummary:
    order = np.argsort(found.distance, kind="stable")
    _, firsts, numbers = np.unique(found.mesh_keys()[order], return_index=True, return_counts=True)
    nearest = []
    for pair in np.argsort(firsts).tolist():
        row = int(order[firsts[pair]])
        meshes, elements, place = _in_words(found, row)
        nearest.append(Nearest(meshes, elements, found.time, float(found.distance[row]), place, int(numbers[pair])))
    return ProximitySummary(found.time, len(found), tuple(nearest))
