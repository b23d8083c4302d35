"""A repaired stretch of a shot: its moved vertices, and how far they moved, in numbers."""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from ...detection.arcs.rigid_motion import RigidMotion
from ...usd.write.points_layer import MovedFrame
from ..contacts import Contacts

_GOOD_EDGES = 1.0 / 3.0, 2.0
"""Smallest and largest length of an edge in a frame that is good, as shares of its length in the shot."""

_SHORTEST_EDGE = 1e-3
"""Length of an edge in the shot, as a share of the median one, up to which it does not count: when it moves at all, it
is shorter or longer by any factor."""


@dataclass(frozen=True)
class RepairedStretch:
    """Consecutive frames of a shot of which some are moved.

    Attributes:
        start: Time code of its first frame.
        end: Time code of its last frame.
        frames: The frames with moved vertices.
        largest_moves: Largest distance of a vertex from the shot in each of these, in its unit of length.
        moved: Number of moved vertices, the most of all frames.
        largest_move: The largest of all these.
        mean_move: Mean of the distances of moved vertices.
        edge_length: Median edge length of the meshes that may move, at the start.
        edge_ratios: Smallest and largest length of an edge in each of the frames, as shares of its length in the shot,
            without edges that are shorter in the shot than a thousandth of ``edge_length``.
        acceleration: Largest second difference of the displacement of a vertex over three frames, and of its position
            in the shot, in the unit of length.
        uncertified: Times of the frames whose motion from the frame before is not certified.
        reasons: Why collisions remain, in words; empty where none should be.
        held: Names of the meshes that are moved less somewhere, as their tetrahedra would invert.
    """

    start: float
    end: float
    frames: tuple[MovedFrame, ...] = field(repr=False)
    largest_moves: tuple[float, ...] = field(repr=False)
    moved: int
    largest_move: float
    mean_move: float
    edge_length: float
    edge_ratios: tuple[tuple[float, float], ...] = field(repr=False)
    acceleration: tuple[float, float]
    uncertified: tuple[float, ...]
    reasons: tuple[str, ...]
    held: tuple[str, ...] = ()

    @property
    def edge_ratio(self) -> tuple[float, float]:
        """Smallest and largest length of an edge in all of its frames, as shares of its length in the shot."""
        lows, highs = zip((1.0, 1.0), *self.edge_ratios, strict=True)
        return min(lows), max(highs)

    def distorted(self) -> dict[float, tuple[float, float]]:
        """Returns smallest and largest lengths of edges in frames that are not good, by their times."""
        rows = zip(self.frames, self.edge_ratios, strict=True)
        return {frame.time: ends for frame, ends in rows if ends[0] < _GOOD_EDGES[0] or ends[1] > _GOOD_EDGES[1]}


class InnerVertices(NamedTuple):
    """Moved vertices of tetrahedra inside surfaces: numbers, positions in world space, and distances from the shot."""

    numbers: np.ndarray = np.zeros(0, dtype=int)
    x: np.ndarray = np.zeros((0, 3))
    moves: np.ndarray = np.zeros(0)


@dataclass(frozen=True, eq=False)
class ShotFrame:
    """A frame of a stretch: the shot, the positions that follow it, and what was added to it.

    Attributes:
        given: Positions in the shot, float32, shape [vertex_count, 3].
        x: Positions that follow it, likewise.
        displacement: What was added to the shot before the last contacts were moved apart, likewise.
        certified: Whether the motion from the frame before, straight or on arcs, is free of collisions, and keeps the
            distance.
        contacts: The contacts that are kept apart there.
        arcs: The obstacles that turn on the way to it, and how; None if all move straight.
        inner: What moves inside the surfaces of tetrahedra.
    """

    given: np.ndarray
    x: np.ndarray
    displacement: np.ndarray
    certified: bool = True
    contacts: Contacts = field(default_factory=Contacts.none)
    arcs: RigidMotion | None = None
    inner: InnerVertices = field(default_factory=InnerVertices)

    @staticmethod
    def of_shot(given: np.ndarray, arcs: RigidMotion | None = None) -> "ShotFrame":
        """Returns the frame that is as in the shot."""
        return ShotFrame(given, given, np.zeros_like(given), arcs=arcs)

    @property
    def differs(self) -> bool:
        """Whether it differs from the shot."""
        return self.x is not self.given and not np.array_equal(self.x, self.given)


class StretchRecorder:
    """Collects the frames of a stretch, in order. It holds the moved vertices alone."""

    def __init__(self, is_movable: np.ndarray, edges: np.ndarray, length: float):
        """Begins without frames, given vertices that may move, bool, their edges, and the median length of these."""
        self._is_movable, self._edges, self._length = is_movable, edges, length
        self._frames: list[MovedFrame] = []
        self._times: list[float] = []
        self._uncertified: list[float] = []
        self._largest: list[float] = []
        self._sum = 0.0
        self._ratios: list[tuple[float, float]] = []
        self._last: list[tuple[np.ndarray, np.ndarray]] = []  # displacements and positions of the last two frames
        self._acceleration = 0.0, 0.0

    def add(self, frame: ShotFrame, moved: MovedFrame) -> None:
        """Adds a frame; ``moved`` has its moved vertices."""
        self._times.append(moved.time)
        if not frame.certified:
            self._uncertified.append(moved.time)
        added = frame.x - frame.given
        own = frame.given[self._is_movable]
        if len(self._last) == 2:
            (a, x), (b, y) = self._last
            differences = (_largest(a - 2.0 * b + added), _largest(x - 2.0 * y + own))
            self._acceleration = tuple(map(max, self._acceleration, differences))
        self._last = [*self._last[-1:], (added, own)]
        if not len(moved.vertices):
            return
        self._frames.append(moved)
        moves = np.linalg.norm(added[moved.vertices[moved.vertices < len(added)]], axis=1)
        moves = np.append(moves, frame.inner.moves)
        self._largest.append(float(moves.max()))
        self._sum += float(moves.sum(dtype=np.float64))
        ratio = edge_ratios(frame, self._edges, self._length)
        self._ratios.append((float(ratio.min(initial=1.0)), float(ratio.max(initial=1.0))))

    def finish(self, reasons: list[str], held: tuple[str, ...] = ()) -> RepairedStretch:
        """Returns the stretch; ``reasons`` and ``held`` are those of :class:`RepairedStretch`."""
        counts = [len(frame.vertices) for frame in self._frames]
        return RepairedStretch(
            start=self._times[0],
            end=self._times[-1],
            frames=tuple(self._frames),
            largest_moves=tuple(self._largest),
            moved=max(counts, default=0),
            largest_move=max(self._largest, default=0.0),
            mean_move=self._sum / max(1, sum(counts)),
            edge_length=self._length,
            edge_ratios=tuple(self._ratios),
            acceleration=(self._acceleration[0], self._acceleration[1]),
            uncertified=tuple(self._uncertified),
            reasons=tuple(reasons),
            held=held,
        )


def edge_ratios(frame: ShotFrame, edges: np.ndarray, length: float) -> np.ndarray:
    """Returns the lengths of edges as shares of those in the shot, of all that count by the median ``length``."""
    lengths, rest = (np.linalg.norm(x[edges[:, 0]] - x[edges[:, 1]], axis=1) for x in (frame.x, frame.given))
    counts = rest > _SHORTEST_EDGE * length
    return lengths[counts] / rest[counts]


def distortion(ends: tuple[float, float]) -> float:
    """Returns the factor by which edges are longer or shorter at most, of the smallest and the largest ratio."""
    return max(1.0 / max(ends[0], 1e-9), ends[1])


def _largest(vectors: np.ndarray) -> float:
    """Returns the largest length of some vectors."""
    return float(np.linalg.norm(vectors, axis=1).max(initial=0.0))
