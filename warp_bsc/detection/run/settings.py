"""Settings and counters that all parts of the detection share: kinds of pairs, methods, tolerances, kernel options."""

import enum
import itertools
from dataclasses import dataclass, replace
from operator import add
from typing import Literal, NamedTuple, get_args

import warp as wp

from ..._arguments import checked_number
from ...kernels import polynomials

Method = Literal["float", "conservative", "exact"]
"""What becomes of a pair that floating point cannot certify: its computed signs decide, it counts as a hit, or exact
arithmetic decides."""

METHODS: tuple[Method, ...] = get_args(Method)
"""The methods."""

TOLERANCE = 2.0**-20
"""Default tolerance of the time of impact, as a share of the step."""

UNLIMITED = 2**62
"""Capacity for entries that are only counted."""

NO_GRADIENTS = {"enable_backward": False, "module": "unique"}
"""Options of a kernel without gradients, in a module of its own."""

NO_FUSED_OPERATIONS = NO_GRADIENTS | {"module_options": {"fuse_fp": False}}
"""The same for a kernel that decides: without fused operations every device computes the same bits."""


class PairKind(enum.IntEnum):
    """The kinds of pairs, with their numbers in kernels; those of points have a minimum distance."""

    VERTEX_FACE = int(polynomials.VERTEX_FACE)
    EDGE_EDGE = int(polynomials.EDGE_EDGE)
    VERTEX_EDGE = int(polynomials.VERTEX_EDGE)
    VERTEX_VERTEX = int(polynomials.VERTEX_VERTEX)

    @property
    def label(self) -> str:
        """The name in attributes of results and in the checker: "vertex_face" and so on."""
        return self.name.lower()

    @property
    def display_name(self) -> str:
        """The name in tables and messages: "vertex-face" and so on."""
        return self.label.replace("_", "-")

    @property
    def point_order(self) -> list[int]:
        """The point of the pair for each of the four arguments of kernels: p a b a, p q q q."""
        if self == PairKind.VERTEX_EDGE:
            return [0, 1, 2, 1]
        return [0, 1, 1, 1] if self == PairKind.VERTEX_VERTEX else [0, 1, 2, 3]

    @property
    def points(self) -> int:
        """Number of points of a pair."""
        return max(self.point_order) + 1


SURFACE_KINDS = PairKind.VERTEX_FACE, PairKind.EDGE_EDGE
"""The kinds of pairs that touch without a minimum distance."""


def checked_tolerance(tolerance: float) -> float:
    """Returns a tolerance; raises TypeError or ValueError if it is not in [2^-38, 1]."""
    return checked_number(tolerance, "tolerance", 2.0**-38, 1.0)


def capacity_for(count: int, buffer: str) -> int:
    """Returns the capacity of a buffer that is to hold ``count`` entries, with a quarter to spare.

    Raises:
        ValueError: If the capacity would be out of range; names the buffer.
    """
    capacity = int(count) + int(count) // 4
    if capacity >= 2**31:
        raise ValueError(f"buffer {buffer!r} must hold {count} pairs, more than its largest capacity, {2**31 - 1}")
    return capacity


class Count(enum.IntEnum):
    """Indices of the counts of one kind of pair in an array, in the order of the phases."""

    # pairs enqueued for the narrow phase, the candidates: they share no vertex, their swept boxes overlap, and no
    # coordinate axis separates them at the start and at the end, on the same side
    QUEUED = 0
    SURVIVORS = 1  # queued pairs that no cull decides
    CONTACTS = 2  # survivors that classification, or advancement with a minimum distance, does not certify free
    FOUND = 3  # contacts that are not certified free when their time of impact is sought either
    UNSURE = 4  # found pairs that are not certified hits either
    FOR_EXACT = 5  # found pairs that the exact phase decides, or whose times it finds
    TOO_WIDE_1 = 6  # pairs of the exact phase whose exponents are too far apart for one limb
    TOO_WIDE_2 = 7  # pairs of the exact phase whose exponents are too far apart for two limbs
    TOO_WIDE_4 = 8  # pairs of the exact phase whose exponents are too far apart for four limbs, on a CPU
    # pairs of the exact phase whose exponents are too far apart for eight limbs or, with a minimum distance, that it
    # does not decide: delegated to the host
    TOO_WIDE_8 = 9
    REFUTED = 10  # found pairs that the exact phase decides to be free
    # contacts with a minimum distance that advancement leaves to subdivision; of many others on a GPU, those that a
    # simple search does
    SUBDIVIDED = 11
    FILTERED = 12  # pairs that would be candidates, but are left out by groups and masks


class PairCounts(NamedTuple):
    """Counts of one kind of pair, or capacities for them, on the host, in the order of :class:`Count`."""

    queued: int = 0
    survivors: int = 0
    contacts: int = 0
    found: int = 0
    unsure: int = 0
    for_exact: int = 0
    too_wide_1: int = 0
    too_wide_2: int = 0
    too_wide_4: int = 0
    too_wide_8: int = 0
    refuted: int = 0
    subdivided: int = 0
    filtered: int = 0

    @property
    def collisions(self) -> int:
        """Number of pairs that are reported."""
        return self.found - self.refuted

    def overflows(self, capacities: "PairCounts", kind: PairKind) -> list[str]:
        """Names each buffer of a kind that is too small for these counts, with count and capacity."""
        return [
            f"{kind.label} {count.name.lower()}: {needed} do not fit in the capacity {capacity}"
            for count, needed, capacity in zip(Count, self, capacities, strict=True)
            if needed > capacity
        ]


_NO_PAIRS = PairCounts()


class Counter(enum.IntEnum):
    """Indices of the counts of a detection in one array."""

    NOT_FINITE = 0  # vertices with a position that is not finite
    FACE_PAIRS = 1
    PAIRS = 2  # the first of those of each kind of pair, by :class:`Count`


FILTERED_COUNTS = range(Counter.PAIRS + Count.FILTERED, Counter.PAIRS + len(PairKind) * len(Count), len(Count))
"""Indices of the pairs that are filtered, of each kind."""


@dataclass(frozen=True)
class Counts:
    """Counts of a detection, or the capacities for them, on the host."""

    not_finite: int  # vertices with a position that is not finite; there is no capacity for these
    face_pairs: int  # pairs of faces whose swept boxes overlap, of a broad phase that has a queue for them
    vertex_face: PairCounts  # counts of vertex-face pairs
    edge_edge: PairCounts  # counts of edge-edge pairs
    vertex_edge: PairCounts = _NO_PAIRS  # counts of pairs of a point and an edge that no face has
    vertex_vertex: PairCounts = _NO_PAIRS  # counts of pairs of points

    @property
    def pairs(self) -> dict[PairKind, PairCounts]:
        """The counts of each kind of pair."""
        return {kind: getattr(self, kind.label) for kind in PairKind}

    def without_filtered(self) -> "Counts":
        """Returns the counts with no pair that is filtered."""
        return replace(self, **{kind.label: counts._replace(filtered=0) for kind, counts in self.pairs.items()})

    def values(self) -> list[int]:
        """Returns all counts in the order of :class:`Counters`."""
        return [self.not_finite, self.face_pairs, *itertools.chain(*self.pairs.values())]

    def overflows(self, capacities: "Counts") -> list[str]:
        """Names each buffer that is too small for these counts, with count and capacity."""
        faces = []
        if self.face_pairs > capacities.face_pairs:
            faces = [f"face pairs: {self.face_pairs} do not fit in the capacity {capacities.face_pairs}"]
        others = capacities.pairs
        return [*faces, *(line for kind, counts in self.pairs.items() for line in counts.overflows(others[kind], kind))]


def add_counts(first: Counts, second: Counts) -> Counts:
    """Returns the counts of two detections together."""
    pairs = {kind.label: PairCounts(*map(add, counts, second.pairs[kind])) for kind, counts in first.pairs.items()}
    return Counts(first.not_finite + second.not_finite, first.face_pairs + second.face_pairs, **pairs)


class Counters:
    """The counts of a detection on its device, which any of its threads may raise.

    Attributes:
        array: All counts, zero before each detection, Warp array of int64.
        not_finite: Number of vertices with a position that is not finite, array of one int64.
        face_pairs: Number of pairs of faces, array of one int64.
        pairs: Counts of all kinds of pair, array of int64.
        vertex_face: Counts of vertex-face pairs by :class:`Count`, array of int64.
        edge_edge: Counts of edge-edge pairs by :class:`Count`, array of int64.
        vertex_edge: Counts of pairs of a point and an edge by :class:`Count`, array of int64.
        vertex_vertex: Counts of pairs of points by :class:`Count`, array of int64.
    """

    def __init__(self, device: wp.Device):
        """Allocates the counters on a device, all zero."""
        n = len(Count)
        self.array = wp.zeros(Counter.PAIRS + n * len(PairKind), dtype=wp.int64, device=device)
        self.not_finite = self.array[Counter.NOT_FINITE : Counter.FACE_PAIRS]
        self.face_pairs = self.array[Counter.FACE_PAIRS : Counter.PAIRS]
        self.pairs = self.array[Counter.PAIRS :]
        self.vertex_face, self.edge_edge, self.vertex_edge, self.vertex_vertex = (
            self.pairs[n * kind : n * (kind + 1)] for kind in PairKind
        )

    def read(self) -> Counts:
        """Returns the counts on the host; synchronizes with the device."""
        not_finite, face_pairs, *pairs = self.array.numpy().tolist()
        n = len(Count)
        return Counts(not_finite, face_pairs, *(PairCounts(*pairs[n * kind : n * (kind + 1)]) for kind in PairKind))
