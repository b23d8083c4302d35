"""Repairs a shot: its meshes follow it, and leave it where it collides, before and after that as little as needed."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .._arguments import check_instance, checked_distance, checked_strings
from ..replay.results import IntervalResult
from ..usd.points_layer import MovedFrame
from ..usd.scene import Scene
from ..usd.segment import Segment
from ..usd.selection import Selection
from .follow import Follower
from .repair import repair

__all__ = ["BLEND", "Finding", "RepairedStretch", "find_collisions", "kept_meshes", "repair_shot"]

BLEND = 4
"""Intervals over which a displacement grows before a collision, and fades after it."""
_SMOOTHINGS = 2
"""Times that displacements are averaged with those of the frames before and after."""
_MARGIN = BLEND + _SMOOTHINGS
"""Intervals by which a displacement precedes and outlasts what needs it."""
_FADING = 0.7
"""Share of a displacement that the next frame begins with, while the displacements are sought."""
_FADED = 0.002
"""Displacement, as a share of the median edge length, below which the next frame begins with none."""


@dataclass(frozen=True)
class Finding:
    """What a replay found in an interval, as far as a repair needs it.

    Attributes:
        hits: Number of pairs that collide.
        crossings: Numbers of edges that meet faces at the start and at the end.
        crossing_meshes: Names of the pairs of meshes that intersect at the start.
        is_joined: Whether the interval starts where the one before ends, with the same meshes.
    """

    hits: int
    crossings: tuple[int, int]
    crossing_meshes: tuple[tuple[str, str], ...]
    is_joined: bool

    @property
    def is_free(self) -> bool:
        """Whether nothing collides or intersects."""
        return not self.hits and not any(self.crossings)


@dataclass(frozen=True)
class RepairedStretch:
    """Consecutive frames of a shot of which some are moved.

    Attributes:
        start: Time code of its first frame.
        end: Time code of its last frame.
        frames: The frames with moved vertices.
        moved: Number of moved vertices, the most of all frames.
        largest_move: Largest distance of a vertex from the shot, in its unit of length.
        mean_move: Mean of the distances of moved vertices.
        edge_length: Median edge length of the meshes that may move, at the start.
        edge_ratio: Smallest and largest length of an edge, as shares of its length in the shot at the same time.
        acceleration: Largest second difference of the displacement of a vertex over three frames, and of its position
            in the shot, in the unit of length.
        uncertified: Times of the frames whose motion from the frame before is not certified.
        left: Why collisions are left, in words; empty where none should be.
    """

    start: float
    end: float
    frames: tuple[MovedFrame, ...] = field(repr=False)
    moved: int
    largest_move: float
    mean_move: float
    edge_length: float
    edge_ratio: tuple[float, float]
    acceleration: tuple[float, float]
    uncertified: tuple[float, ...]
    left: tuple[str, ...]


def find_collisions(results: Iterable[IntervalResult]) -> Iterator[Finding]:
    """Yields what a repair needs of each interval of a replay with intersections."""
    last: Segment | None = None
    for result in results:
        interval, summary = result.contacts.interval, result.summary
        assert summary.intersections is not None
        crossings = tuple(at.crossings + at.touches for at in summary.intersections)
        is_joined = interval.segment is last and not interval.jumps
        last = interval.segment
        hits = sum(summary.mesh_pairs.values())
        yield Finding(hits, (crossings[0], crossings[1]), tuple(summary.intersections[0].mesh_pairs), is_joined)


def kept_meshes(scene: Scene, keep: Iterable[str] = ()) -> dict[str, str]:
    """Returns the meshes of a scene that a repair does not move, and why, by their names.

    Args:
        scene: The scene.
        keep: Patterns of meshes, as those of a selection, that are obstacles.

    Raises:
        TypeError: If ``keep`` is not a sequence of strings.
        ValueError: If a pattern matches no mesh.
    """
    patterns = checked_strings(keep, "keep")
    prims = [scene.prim_of(name) for name in scene.names]
    for pattern in patterns:
        if not any(Selection(prims=(pattern,)).includes(prim) for prim in prims):
            raise ValueError(f"keep: no mesh matches {pattern}")
    kept = {}
    for prim in prims:
        if patterns and Selection(prims=patterns).includes(prim):
            kept[prim.name] = "it is to be kept"
        elif prim.why_not_written:
            kept[prim.name] = prim.why_not_written
        elif not prim.deforms:
            kept[prim.name] = "its points do not move, only its transform" if prim.times else "it does not move"
    return kept


def repair_shot(
    scene: Scene,
    findings: list[Finding],
    *,
    keep: Iterable[str] = (),
    max_move: float | None = None,
    separation: float | None = None,
    device: Any = None,
    progress: Callable[[int], None] | None = None,
) -> Iterator[RepairedStretch]:
    """Moves the deforming meshes of a scene where it collides, so that it does not, one stretch of it at a time.

    A stretch begins and ends at frames of the scene itself, a few intervals before a collision and after it, or later,
    when the meshes have returned. It is followed twice. The first time finds the displacements that are needed. They
    are then spread over the frames before and after, smoothly, and the second time follows the shot with these. Frames
    outside the stretches, and vertices that are not displaced, keep every bit.

    The first frame of the scene, or after a jump, is repaired by itself, see :func:`warp_bsc.repair`.

    Args:
        scene: The scene.
        findings: What a replay has found in each interval, in order, see :func:`find_collisions`.
        keep: Patterns of meshes that are not moved, but are obstacles. Those that only a transform moves, shapes,
            curves, points, and instances are never moved.
        max_move: Largest distance of a vertex from the shot, in the scene's unit of length, more than 0. A stretch that
            needs more is left as it is.
        separation: Distance that contacts are moved apart, in that unit; default: 0.005 of the median edge length.
        device: Warp device or its name; default: Warp's default.
        progress: Called with the number of intervals that are done.

    Yields:
        RepairedStretch: The stretches, in order. The frames of one are in memory.

    Raises:
        TypeError: If an argument has another type.
        ValueError: If a number is out of range, a pattern matches no mesh, or the scene is broken at some time.
    """
    check_instance(scene, "scene", Scene, "a Scene")
    kept = kept_meshes(scene, keep)
    if max_move is not None:
        max_move = checked_distance(max_move, "max_move", zero=False)
    if separation is not None:
        separation = checked_distance(separation, "separation", zero=False)
    return _repair_shot(_Shot(scene, findings, kept, separation, device), max_move, progress)


def _repair_shot(shot, max_move, progress) -> Iterator[RepairedStretch]:
    """Yields the stretches of :func:`repair_shot`, whose arguments have been checked."""
    done = 0
    for begin, stop in shot.stretches():
        first = max(begin, done)
        if first >= stop:
            continue
        stretch, done = shot.repair(first, stop, max_move)
        if stretch is not None:
            yield stretch
        if progress:
            progress(done)


@dataclass
class _Frame:
    """A frame of a stretch, in single precision: the shot, the positions that follow it, and what was added to it."""

    given: np.ndarray
    x: np.ndarray
    displacement: np.ndarray
    certified: bool = True


class _Shot:
    """A scene that is repaired, and the follower of the segment in progress."""

    def __init__(self, scene, findings, kept, separation, device):
        self._scene, self._findings, self._kept = scene, findings, kept
        self._separation, self._device = separation, device
        self._segment: Segment | None = None

    def stretches(self) -> list[tuple[int, int]]:
        """Returns the first intervals of the stretches and those after their last, ascending; they may overlap."""
        found: list[tuple[int, int]] = []
        for index, finding in enumerate(self._findings):
            if not finding.is_free:
                low, high = self._span(index)
                first, stop = max(low, index - _MARGIN), min(high, index + 1 + _MARGIN)
                if found and found[-1][1] >= first and found[-1][1] > low:
                    first, _ = found.pop()
                found.append((first, stop))
        return found

    def repair(self, first: int, stop: int, max_move: float | None) -> tuple[RepairedStretch | None, int]:
        """Follows the shot twice through a stretch, and further until it is reached again.

        Returns:
            The stretch, None if nothing of it can be moved, and the interval after it.
        """
        interval = self._scene.interval(first)
        self._take_segment(interval)
        last = self._span(first)[1]
        if not self._is_movable.any():
            return None, stop
        left = []
        start = self._start(first, interval, left)
        frames = self._follow(first, stop - first, last - first, [start], ())
        stop = min(last, max(stop, first + len(frames) - 1 + _MARGIN))
        needed = np.stack([frame.displacement for frame in frames])
        needed = np.concatenate([needed, np.zeros((stop - first + 1 - len(frames), *needed.shape[1:]), np.float32)])
        frames = self._follow(first, stop - first, last - first, [start], blend(needed))
        stop = first + len(frames) - 1
        is_free = all(finding.is_free for finding in self._findings[max(first, stop - 2 * _MARGIN) : stop])
        if is_free and self._differs(frames[-1]):
            time = self._scene.times[stop]
            left.append(f"the meshes have not returned to the shot at time {time:g}, where it ends or jumps")
        stretch = self._describe(first, frames, left)
        if max_move is not None and stretch.largest_move > max_move:
            reason = f"left as it is: a move of {stretch.largest_move:g} is needed, more than {max_move:g}"
            start = _Frame(start.given, start.given, np.zeros_like(start.given))
            stretch = self._describe(first, [start], [reason], end=self._scene.times[stop])
        return stretch, stop

    def _span(self, index) -> tuple[int, int]:
        """Returns the intervals around one that are joined: the first, and the one after the last."""
        low, high = index, index + 1
        while low and self._findings[low].is_joined:
            low -= 1
        while high < len(self._findings) and self._findings[high].is_joined:
            high += 1
        return low, high

    def _take_segment(self, interval) -> None:
        """Makes a follower if the segment is another one."""
        segment = interval.segment
        if segment is self._segment:
            return
        self._segment = segment
        self._is_movable = np.zeros(segment.vertex_count, dtype=bool)
        are_kept = [mesh.name in self._kept for mesh in segment.meshes]
        for is_movable in (True, False):  # a vertex of two meshes is kept if one of them is
            for number, is_kept in enumerate(are_kept):
                if is_kept != is_movable:
                    self._is_movable[segment.vertices_of(number)] = is_movable
        # The stage works in single precision: near the origin it is finer.
        x = interval.x0
        self._origin = np.zeros(3) if x.dtype == np.float32 else x.mean(axis=0)
        self._follower = Follower(
            segment.faces,
            self._single(x),
            self._is_movable,
            separation=self._separation,
            device=self._device,
        )

    def _single(self, x) -> np.ndarray:
        """Returns positions of the scene in single precision, relative to the origin."""
        return x if x.dtype == np.float32 else (x - self._origin).astype(np.float32)

    def _start(self, first, interval, left) -> _Frame:
        """Returns the first frame, repaired if it crosses; adds to ``left`` what still does."""
        given = self._single(interval.x0)
        nothing = np.zeros_like(given)
        if not self._findings[first].crossings[0]:
            return _Frame(given, given, nothing)
        result = repair(interval.segment.faces, given, fixed=~self._is_movable, device=self._device)
        if result.unresolved:
            pairs = sorted({" and ".join(dict.fromkeys(names)) for names in self._findings[first].crossing_meshes})
            reasons = "; ".join(dict.fromkeys(contour.reason for contour in result.unresolved))
            left.append(
                f"the frame at time {interval.start:g} crosses itself, with {result.crossings} edges through faces, of "
                f"{', '.join(pairs)}: {reasons}"
            )
        x = np.asarray(result.x)
        return _Frame(given, x, x - given)

    def _follow(self, first, count, most, frames, displacements) -> list[_Frame]:
        """Returns the frames of a stretch: those given, then those that follow.

        Args:
            first: Number of the first interval.
            count: Number of intervals; more are followed until the shot is reached.
            most: Largest number of intervals.
            frames: The first frame.
            displacements: Displacement at each frame; empty where they are sought, and fade from frame to frame.
        """
        frames = list(frames)
        for index in range(most):
            if index >= count and not self._differs(frames[-1]):
                break
            given = self._single(self._scene.interval(first + index).x1)
            if index + 1 < len(displacements):
                displacement = displacements[index + 1]
            elif len(displacements):
                displacement = np.zeros_like(given)
            else:
                displacement = _FADING * frames[-1].displacement
                size = np.linalg.norm(displacement, axis=1, keepdims=True)
                displacement = np.where(size < _FADED * self._follower.length, 0.0, displacement)
            found = self._follower.follow(frames[-1].x, given, displacement)
            added = found.displacement if not len(displacements) else found.x - given
            frames.append(_Frame(given, found.x, added.astype(np.float32), found.certified))
        return frames

    def _differs(self, frame) -> bool:
        """Returns whether a frame differs from the shot."""
        return not np.array_equal(frame.x, frame.given)

    def _describe(self, first, frames, left, end=None) -> RepairedStretch:
        """Returns the stretch that frames are, the first of them at the start of an interval."""
        times, edges, follower = self._scene.times, self._follower.edges, self._follower
        segment = self._segment
        assert segment is not None
        moved, moves, ratios, sizes = [], [0.0], [1.0], [0.0]
        last = first + len(frames) - 1
        for number, frame in enumerate(frames):
            (vertices,) = np.nonzero((frame.x != frame.given).any(axis=1))
            if not len(vertices):
                continue
            index = first + number
            before = number > 0 and index < len(self._findings) and not self._findings[index].is_joined
            x = frame.x[vertices].astype(np.float64) + self._origin
            moved.append(MovedFrame(times[index], before, segment, vertices, x))
            sizes.append(len(vertices))
            moves.append(np.linalg.norm(frame.x[vertices] - frame.given[vertices], axis=1))
            lengths = [np.linalg.norm(x[edges[:, 0]] - x[edges[:, 1]], axis=1) for x in (frame.x, frame.given)]
            ratio = lengths[0] / np.maximum(lengths[1], 1e-12 * follower.length)
            ratios += [ratio.min(), ratio.max()]
        moves = np.concatenate([np.atleast_1d(part) for part in moves])
        return RepairedStretch(
            start=times[first],
            end=times[last] if end is None else end,
            frames=tuple(moved),
            moved=int(max(sizes)),
            largest_move=float(moves.max()),
            mean_move=float(moves[1:].mean()) if len(moves) > 1 else 0.0,
            edge_length=follower.length,
            edge_ratio=(float(min(ratios)), float(max(ratios))),
            acceleration=(
                _second_difference([frame.x - frame.given for frame in frames]),
                _second_difference([frame.given[self._is_movable] for frame in frames]),
            ),
            uncertified=tuple(times[first + n] for n, frame in enumerate(frames) if not frame.certified),
            left=tuple(left),
        )


def blend(displacements: np.ndarray) -> np.ndarray:
    """Returns displacements that grow before those given and fade after them, and are not much smaller anywhere.

    The one of a vertex at a frame is the largest of those at the frames around it, each weighted by a smooth step that
    falls to 0 over :data:`BLEND` frames, then averaged over neighbouring frames. The first frame keeps its own.

    Args:
        displacements: Shape [frames, vertex_count, 3].
    """
    used = displacements.any(axis=(0, 2))
    given = displacements[:, used].astype(np.float64)
    count = len(given)
    size = np.linalg.norm(given, axis=2)
    blended, largest = np.zeros_like(given), np.zeros_like(size)
    for shift in range(-BLEND, BLEND + 1):
        share = 1.0 - abs(shift) / (BLEND + 1)
        weight = share * share * (3.0 - 2.0 * share)
        for frame in range(max(0, -shift), min(count, count - shift)):
            is_larger = weight * size[frame + shift] > largest[frame]
            largest[frame, is_larger] = weight * size[frame + shift, is_larger]
            blended[frame, is_larger] = weight * given[frame + shift, is_larger]
    for _ in range(_SMOOTHINGS):
        blended[1:-1] = 0.25 * blended[:-2] + 0.5 * blended[1:-1] + 0.25 * blended[2:]
    result = np.zeros_like(displacements)
    result[:, used] = blended
    result[0] = displacements[0]
    return result


def _second_difference(frames) -> float:
    """Returns the largest second difference of positions over three consecutive frames."""
    return max(
        (
            float(np.linalg.norm(a - 2.0 * b + c, axis=1).max(initial=0.0))
            for a, b, c in zip(frames, frames[1:], frames[2:], strict=False)
        ),
        default=0.0,
    )
