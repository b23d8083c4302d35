"""The results of a detection."""

import functools
from collections import Counter
from collections.abc import Callable
from dataclasses import astuple, dataclass, field

import numpy as np
import warp as wp

from ..narrow.contact_buffer import ContactRows, HostContacts, empty_contacts
from ..run.phase_timer import PhaseTimer
from ..run.settings import Counts, Method, PairCounts, PairKind
from .differentiable import DifferentiableContacts


@dataclass(frozen=True, eq=False)
class Candidates:
    """The pairs that a detection tests: the swept boxes of no others overlap. Their number is their length.

    Attributes:
        vertex_face: (vertex, face), sorted, int32, shape [n, 2].
        edge_edge: (edge, edge), the smaller first, edges as in ``mesh.edges``, sorted, int32, shape [m, 2].
        vertex_edge: (point, edge), edges that no face has, with a minimum distance only, sorted, int32, shape [k, 2].
        vertex_vertex: (point, point), the smaller first, likewise, sorted, int32, shape [l, 2].
    """

    vertex_face: np.ndarray
    edge_edge: np.ndarray
    vertex_edge: np.ndarray
    vertex_vertex: np.ndarray

    def __len__(self) -> int:
        """Returns the number of pairs of all kinds."""
        return sum(len(pairs) for pairs in vars(self).values())


@dataclass(frozen=True, eq=False)
class FreeStep:
    """The part of a motion before its first collision.

    Attributes:
        step: Its share of the motion, in [0, 1].
        x: Positions at its end, between ``x0`` and ``x1``, of their type, an array of the kind of ``x1``.
        certified: Whether the motion from ``x0`` to ``x`` is certified to be free of collisions.
    """

    step: float
    x: np.ndarray | wp.array
    certified: bool


@dataclass(frozen=True)
class PhaseCounts:
    """Numbers of pairs of one kind that entered or left each phase.

    Attributes:
        candidates: Pairs that share no vertex, whose swept boxes overlap, and that no coordinate axis separates at the
            start and at the end, on the same side.
        survivors: Candidates that no cull decides.
        free: Candidates that are certified free, by the culls or later.
        hits: Candidates certified to collide.
        unsure: Candidates that floating point could not certify either way.
        exact: Candidates that exact arithmetic decided on the device, or whose time of impact it found there.
        host: Candidates whose exponents are too far apart for that, or that may come within a minimum distance only for
            a moment of the step. The host decides them, except in a CUDA graph, where they stay unsure.
        filtered: Pairs that would be candidates, but that groups and masks of the mesh leave out.
    """

    candidates: int = 0
    survivors: int = 0
    free: int = 0
    hits: int = 0
    unsure: int = 0
    exact: int = 0
    host: int = 0
    filtered: int = 0

    @classmethod
    def of(cls, counts: PairCounts, *, exact: bool) -> "PhaseCounts":
        """Returns the numbers of one kind of pair from its counters; ``exact``: whether there was an exact phase."""
        return cls(
            candidates=counts.queued,
            survivors=counts.survivors,
            free=counts.queued - counts.found,
            hits=counts.found - counts.unsure,
            unsure=counts.unsure,
            exact=counts.for_exact - counts.too_wide_8 if exact else 0,
            host=counts.too_wide_8 if exact else 0,
            filtered=counts.filtered,
        )


@dataclass(frozen=True)
class DetectionStats:
    """Counts and times of a detection.

    Attributes:
        vertex_face: Numbers of vertex-face pairs that entered or left each phase.
        edge_edge: Numbers of edge-edge pairs that entered or left each phase.
        vertex_edge: Numbers of pairs of a point and an edge that no face has.
        vertex_vertex: Numbers of pairs of points.
        milliseconds: Time by phase: "broad phase", "cull", "classify", "time of impact", "sort", "exact". Empty for a
            detection in a CUDA graph.
    """

    vertex_face: PhaseCounts
    edge_edge: PhaseCounts
    vertex_edge: PhaseCounts
    vertex_vertex: PhaseCounts
    milliseconds: dict[str, float]

    @property
    def filtered(self) -> int:
        """Number of pairs of all kinds that groups and masks of the mesh leave out, see :class:`PhaseCounts`."""
        return sum(getattr(self, kind.label).filtered for kind in PairKind)


def add_stats(first: DetectionStats, second: DetectionStats) -> DetectionStats:
    """Returns the counts and times of two detections together."""
    both = [(kind.label, *(astuple(getattr(stats, kind.label)) for stats in (first, second))) for kind in PairKind]
    counts = {label: PhaseCounts(*(a + b for a, b in zip(*pair, strict=True))) for label, *pair in both}
    milliseconds = Counter(first.milliseconds)
    milliseconds.update(second.milliseconds)
    return DetectionStats(**counts, milliseconds=dict(milliseconds))


@dataclass(frozen=True)
class _Column:
    """An attribute of :class:`Collisions`: an array of the pairs of one kind."""

    kind: PairKind
    name: str

    def __get__(self, collisions: "Collisions", _class: type) -> np.ndarray:
        return getattr(collisions._contacts(self.kind), self.name)


@dataclass(frozen=True, eq=False)
class Collisions:
    """The collisions of one motion, sorted, the same on every run and every device.

    Their number is their length, so that ``if collisions`` asks whether there are any; it does not read the device.
    They are in arrays of their own, on the device until they are first read, which later detections do not change. A
    detector reuses these arrays once no reference to the result remains.

    Attributes:
        certified: Whether no collision of the motion can be missing; with method "exact", every reported pair collides
            as well. False for method "float", and if a buffer overflowed, a position was not finite, or a pair was
            left to the host in a CUDA graph, or in one of a GPU a body deforms that was rigid when it was captured.
            Pairs that groups and masks of the mesh leave out are not covered; ``stats.filtered`` counts those whose
            swept boxes overlap. Nor are pairs within a rigid body on arcs, see :class:`.RigidMotion`.
        overflows: Each buffer that was too small, so that collisions are missing, with its count and capacity. Only a
            detection in a CUDA graph can overflow: detect once outside a graph, which enlarges the buffers, and capture
            again.
        arrays: The collisions on the device, with gradients; None unless ``x0`` or ``x1`` requires gradients.
        vertex_face: (vertex, face), int32, shape [n, 2].
        edge_edge: (edge, edge), the smaller first, as in ``mesh.edges``, int32, shape [m, 2].
        vertex_face_toi: Times of impact as a share of the step, float64, shape [n]: no contact of the pair comes
            earlier. They are at most the tolerance before the first contact, except for UNSURE pairs of "float" and
            "conservative".
        edge_edge_toi: Times of impact of the edges, as :attr:`vertex_face_toi`, float64, shape [m].
        vertex_face_coordinates: Barycentric coordinates of the contact in the face, float64, shape [n, 3].
        edge_edge_coordinates: (s, r, 0) along the two edges, float64, shape [m, 3].
        vertex_face_normal: Unit normals of the faces at contact, float64, shape [n, 3]. They are on the side from which
            the vertex comes: against its velocity relative to the face. A vertex that moves in the plane of the face
            comes from neither: its normal is that of the plane, of either sign, perpendicular to the velocity, so that
            a push along it parts nothing. A face that has collapsed has no plane: the normal is opposite to the
            velocity, and (0, 0, 1) where there is none. With a minimum distance those of all pairs are along the
            closest points, from the second element to the first.
        edge_edge_normal: Unit normals of both edges at contact, float64, shape [m, 3]. They are perpendicular to both,
            against the velocity of the first relative to the second, and otherwise as :attr:`vertex_face_normal`:
            perpendicular to that velocity for edges that move in their plane, opposite to it for edges that are
            parallel.
        vertex_edge: (point, edge), points as in ``mesh.points``, edges of no face, int32, shape [k, 2]. With a minimum
            distance only, as :attr:`vertex_vertex`: pairs of points with faces are in :attr:`vertex_face`.
        vertex_vertex: (point, point), the smaller first, int32, shape [l, 2].
        vertex_edge_toi: Times of impact of points with edges, as :attr:`vertex_face_toi`, float64, shape [k].
        vertex_vertex_toi: Times of impact of points with points, as :attr:`vertex_face_toi`, float64, shape [l].
        vertex_edge_coordinates: (s, 0, 0) along the edge, float64, shape [k, 3].
        vertex_edge_normal: Unit normals from the edge to the point, float64, shape [k, 3].
        vertex_vertex_normal: Unit normals from the second point to the first, float64, shape [l, 3].
    """

    certified: bool
    overflows: tuple[str, ...]
    arrays: DifferentiableContacts | None
    _method: Method = field(repr=False)
    _counts: Counts = field(repr=False)
    _rows: dict[PairKind, ContactRows] = field(repr=False)
    _timer: PhaseTimer = field(repr=False)
    _read: dict[PairKind, HostContacts] = field(default_factory=dict, init=False, repr=False)

    vertex_face = _Column(PairKind.VERTEX_FACE, "pairs")
    edge_edge = _Column(PairKind.EDGE_EDGE, "pairs")
    vertex_face_toi = _Column(PairKind.VERTEX_FACE, "toi")
    edge_edge_toi = _Column(PairKind.EDGE_EDGE, "toi")
    vertex_face_coordinates = _Column(PairKind.VERTEX_FACE, "coordinates")
    edge_edge_coordinates = _Column(PairKind.EDGE_EDGE, "coordinates")
    vertex_face_normal = _Column(PairKind.VERTEX_FACE, "normal")
    edge_edge_normal = _Column(PairKind.EDGE_EDGE, "normal")
    vertex_edge = _Column(PairKind.VERTEX_EDGE, "pairs")
    vertex_vertex = _Column(PairKind.VERTEX_VERTEX, "pairs")
    vertex_edge_toi = _Column(PairKind.VERTEX_EDGE, "toi")
    vertex_vertex_toi = _Column(PairKind.VERTEX_VERTEX, "toi")
    vertex_edge_coordinates = _Column(PairKind.VERTEX_EDGE, "coordinates")
    vertex_edge_normal = _Column(PairKind.VERTEX_EDGE, "normal")
    vertex_vertex_normal = _Column(PairKind.VERTEX_VERTEX, "normal")

    def __len__(self) -> int:
        """Returns the number of pairs of all kinds."""
        return sum(rows.count for rows in self._rows.values())

    def __repr__(self) -> str:
        """Returns the number of pairs of each kind that the mesh has, and whether they are certified to be all."""
        counts = [f"{rows.count:,} {kind.display_name}" for kind, rows in self._rows.items()]
        flags = ["certified" if self.certified else "not certified", *self.overflows]
        return f"Collisions({', '.join(counts + flags)})"

    @property
    def free(self) -> bool:
        """Whether the motion is certified to be free of collisions."""
        return self.certified and not len(self)

    def _contacts(self, kind: PairKind) -> HostContacts:
        """Returns the contacts of a kind of pair, read once; only meshes with points have those of points."""
        if kind not in self._read:
            self._read[kind] = self._rows[kind].read() if kind in self._rows else empty_contacts()
        return self._read[kind]

    @functools.cached_property
    def earliest_toi(self) -> float:
        """The earliest time of impact, 2.0 if there is none."""
        times = self.vertex_face_toi, self.edge_edge_toi, self.vertex_edge_toi, self.vertex_vertex_toi
        return float(min(toi.min(initial=2.0) for toi in times))

    @property
    def overflowed(self) -> bool:
        """Whether a buffer was too small, so that collisions are missing; :attr:`overflows` says which."""
        return bool(self.overflows)

    @functools.cached_property
    def stats(self) -> DetectionStats:
        """Counts and times of every phase."""
        milliseconds = self._timer.read()
        if milliseconds:
            milliseconds["exact"] = milliseconds.pop("exact", 0.0)
        exact = self._method == "exact"
        buffers = {kind.label: PhaseCounts.of(counts, exact=exact) for kind, counts in self._counts.pairs.items()}
        return DetectionStats(**buffers, milliseconds=milliseconds)


@dataclass(frozen=True, eq=False)
class CapturedCollisions:
    """The collisions of a detection that is part of a graph.

    Attributes:
        arrays: The collisions of the last replay on the device, with gradients; None unless ``x0`` or ``x1`` requires
            gradients.
    """

    arrays: DifferentiableContacts | None
    _read: Callable[[], Collisions] = field(repr=False)

    def __bool__(self) -> bool:
        """Raises a TypeError: there is a number of collisions once :meth:`read` has read them from the device."""
        raise TypeError("the truth of captured collisions is that of read(), which waits for the device")

    def read(self) -> Collisions:
        """Returns the collisions of the last replay; on CUDA those of the detector's last detection, in a graph or not.

        Raises:
            RuntimeError: If the graph must be captured again, as the detector's buffers have been replaced since, or on
                the CPU if it has not been launched.
        """
        return self._read()
