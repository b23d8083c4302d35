"""Repairs a shot: its meshes follow it, and leave it where it collides, before and after that as little as needed."""

import itertools
from collections.abc import Callable, Container, Iterable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from ..._arguments import check_instance, checked_distance, checked_integer
from ...detection.arcs.rigid_motion import RigidMotion
from ...detection.at_rest.body_parts import connect_cells
from ...detection.detector import CollisionDetector
from ...detection.mesh import CollisionMesh
from ...scene_replay.scene_arcs import arcs_of
from ...usd.interval import Interval, times_in_words
from ...usd.scene import Scene
from ...usd.segment import Segment
from ...usd.write.points_layer import MovedFrame
from ..contacts import Contacts
from ..repair import repair
from .blend import MARGIN, blend
from .findings import Finding, kept_meshes, matching_meshes
from .follow import Follower
from .insides import Insides, Moment
from .mesh_groups import groups_of
from .stretch import RepairedStretch, ShotFrame, StretchRecorder

_FADING = 0.7
"""Share of a displacement that the next frame begins with, while the displacements are sought."""
_FADED = 0.002
"""Displacement, as a share of the median edge length, below which the next frame begins with none."""
_SOUGHT, _ACCEPTED = 0.02, 0.05
"""Displacement of vertices alone, as a share of that length, that they keep while displacements are sought, and
afterwards."""
_WINDOW = 4
"""Frames, the last of which wait for later ones, to be relaxed between better ones."""
_MORE_DISTANCE = 1.0 + 2.0**-8
"""Distance that is kept, as a multiple of the minimum distance: the points of a layer are rounded."""


def repair_shot(
    scene: Scene,
    findings: list[Finding],
    *,
    keep: Iterable[str] = (),
    rigid: Iterable[str] = (),
    max_move: float | None = None,
    min_distance: float = 0.0,
    device: Any = None,
    start: int = 0,
    progress: Callable[[int], None] | None = None,
) -> Iterator[RepairedStretch]:
    """Moves the deforming meshes of a scene where it collides, so that it does not, one stretch of it at a time.

    A stretch begins and ends at frames of the scene itself, a few intervals before a collision and after it, or later,
    when the meshes have returned. It is followed twice. The first time finds the displacements that are needed. They
    are then spread over the frames before and after, smoothly, and the second time follows the shot with these. Frames
    outside the stretches, and vertices that are not displaced, keep every bit.

    The first frame of the scene, or after a jump, is repaired by itself, see :func:`warp_bsc.repair`.

    Pairs of meshes that the findings leave or ignore, and kept meshes among themselves, are not kept apart: nothing
    moves because of them, and no certificate covers them.

    Args:
        scene: The scene.
        findings: What a replay has found in each interval, in order, see :func:`~.findings.find_collisions`.
        keep: Patterns of meshes that are not moved, but are obstacles. Those that only a transform moves, shapes,
            curves, points, and instances are never moved.
        rigid: Patterns of meshes of hard parts, such as buttons: each connected piece moves as a whole, and has the
            shape that it has in the shot.
        max_move: Largest distance of a vertex from the shot, in the scene's unit of length, more than 0. A stretch that
            needs more stays as it is.
        min_distance: Distance that pairs keep in the stretches, in that unit: 0 or at least 2^-1021. It is certified
            for the motion from frame to frame. Pairs that are nearer at the start of a stretch come no nearer;
            elements that an edge of the mesh joins only do not touch.
        device: Warp device or its name; default: Warp's default.
        start: Number of the interval at which the last stretch of an earlier run ended.
        progress: Called with the number of intervals that are done.

    Yields:
        RepairedStretch: The stretches, in order. The moved vertices and the contacts of one are in memory.

    Raises:
        TypeError: If an argument has another type.
        ValueError: If a number is out of range, a pattern matches no mesh, the scene is broken at some time, or meshes
            stay as they are in more combinations than :func:`~.mesh_groups.groups_of` can tell apart.
    """
    check_instance(scene, "scene", Scene, "a Scene")
    kept, hard = kept_meshes(scene, keep), matching_meshes(scene, rigid, "rigid")
    if max_move is not None:
        max_move = checked_distance(max_move, "max_move", zero=False)
    distance = checked_distance(min_distance, "min_distance")
    done = checked_integer(start, "start", 0, len(scene))
    return _repair_shot(_Shot(scene, findings, kept, hard, distance * _MORE_DISTANCE, device), max_move, done, progress)


def _repair_shot(shot, max_move, done, progress) -> Iterator[RepairedStretch]:
    """Yields the stretches of :func:`repair_shot`, whose arguments have been checked."""
    for begin, stop in shot.stretches():
        first = max(begin, done)
        if first >= stop:
            continue
        stretch, done = shot.repair(first, stop, max_move)
        if stretch is not None:
            yield stretch
        if progress:
            progress(done)


class _Shot:
    """A scene that is repaired, and the follower of the segment in progress."""

    def __init__(self, scene, findings, kept, rigid, min_distance, device):
        self._scene, self._findings, self._kept, self._hard = scene, findings, kept, rigid
        self._min_distance, self._device = min_distance, device
        self._segment: Segment | None = None
        self._passing = {pair for finding in findings for pair in (*finding.unrepaired_pairs, *finding.ignored_pairs)}

    def stretches(self) -> list[tuple[int, int]]:
        """Returns the first intervals of the stretches and those after their last, ascending; they may overlap."""
        found: list[tuple[int, int]] = []
        for index, finding in enumerate(self._findings):
            if not finding.is_free:
                low, high = self._span(index)
                first, stop = max(low, index - MARGIN), min(high, index + 1 + MARGIN)
                if found and found[-1][1] >= first and found[-1][1] > low:
                    first, _ = found.pop()
                found.append((first, stop))
        return found

    def repair(self, first: int, stop: int, max_move: float | None) -> tuple[RepairedStretch | None, int]:
        """Follows the shot twice through a stretch, and further until it is reached again.

        Returns the stretch, None if nothing of it can be moved, and the interval after it.
        """
        interval = self._take_segment(first)
        last = self._span(first)[1]
        if not self._is_movable.any():
            return None, stop
        reasons = []
        start = self._start(first, interval, reasons)
        contacts: dict[int, Contacts] = {}
        frames = itertools.chain([start], self._follow(first, stop, last, start, contacts))
        sought = [_nonzero(frame.displacement) for frame in frames]
        stop = min(last, max(stop, first + len(sought) - 1 + MARGIN))
        used, displacements = _joined(sought, stop - first + 1)
        recorder = self._recorder()
        frame, number = start, 0
        frames = self._follow(first, stop, last, start, contacts, used, blend(displacements))
        frames, held = self._with_insides(first, itertools.chain([start], self._relaxed(start, frames)), reasons)
        for number, frame in enumerate(frames):
            self._record(recorder, first, frame, number)
        stop = first + number
        is_free = all(finding.is_free for finding in self._findings[max(first, stop - 2 * MARGIN) : stop])
        if is_free and frame.differs:
            time = self._scene.times[stop]
            reasons.append(f"the meshes have not returned to the shot at time {time:g}, where it ends or jumps")
        stretch = recorder.finish(reasons, held)
        if max_move is not None and stretch.largest_move > max_move:
            reason = f"kept as it is: a move of {stretch.largest_move:g} is needed, more than {max_move:g}"
            recorder = self._recorder()
            self._record(recorder, first, ShotFrame.of_shot(start.given), 0)
            stretch = replace(recorder.finish([reason]), end=self._scene.times[stop])
        return stretch, stop

    def _span(self, index) -> tuple[int, int]:
        """Returns the intervals around one that are joined: the first, and the one after the last."""
        low, high = index, index + 1
        while low and self._findings[low].is_joined:
            low -= 1
        while high < len(self._findings) and self._findings[high].is_joined:
            high += 1
        return low, high

    def _take_segment(self, index) -> Interval:
        """Returns an interval, and makes a follower if its segment is another one."""
        segment = self._scene.segment(index)
        if segment is not self._segment:
            self._segment = segment
            self._is_movable = is_movable = ~_are_of(segment, self._kept)
            group, mask = groups_of(segment, self._kept.keys(), self._passing)
            # The same for all stretches of the segment, wherever a run begins.
            x = segment.start_positions
            # The stage works in single precision: near the origin it is finer.
            self._is_single = x.dtype == np.float32
            self._origin = np.zeros(3) if self._is_single else x.mean(axis=0)
            mesh = CollisionMesh(segment.faces, len(x), group=group, mask=mask, device=self._device)
            pieces = connect_cells(mesh.edges, len(x)) if self._hard else -1
            self._rigid = rigid = np.where(_are_of(segment, self._hard), pieces, -1)
            self._follower = Follower(mesh, self._single(x), is_movable, rigid=rigid, min_distance=self._min_distance)
            self._insides = None
            if any(name not in self._kept for name in segment.tetrahedra.names):
                given, _ = self._scene.interval(index).tet_positions
                options: dict[str, Any] = {"rigid": self._hard, "device": self._device}
                self._insides = Insides(self._scene, segment, is_movable, given, self._origin, **options)
        return self._scene.interval(index)

    def _single(self, x) -> np.ndarray:
        """Returns positions of the scene in single precision, relative to the origin."""
        return x if self._is_single else (x - self._origin).astype(np.float32)

    def _arcs(self, interval) -> RigidMotion | None:
        """Returns the turns of the meshes of an interval, relative to the origin."""
        arcs = arcs_of(interval)
        if arcs is None or self._is_single:
            return arcs
        return RigidMotion(arcs.body, arcs.centre - self._origin, arcs.turn, tolerance=arcs.tolerance)

    def _start(self, first, interval, reasons) -> ShotFrame:
        """Returns the first frame, repaired if it crosses; adds to ``reasons`` what still does."""
        given = self._single(interval.x0)
        if not self._findings[first].crossings[0]:
            return ShotFrame.of_shot(given)
        fixed, distance = ~self._is_movable, self._min_distance
        result = repair(self._follower.mesh, given, fixed=fixed, rigid=self._rigid, min_distance=distance)
        if result.unresolved:
            pairs = sorted({" and ".join(dict.fromkeys(names)) for names in self._findings[first].crossing_meshes})
            why = "; ".join(dict.fromkeys(contour.reason for contour in result.unresolved))
            reasons.append(
                f"the frame at time {interval.start:g} crosses itself, with {result.crossings} edges through faces, of "
                f"{', '.join(pairs)}: {why}"
            )
        x = np.asarray(result.x)
        return ShotFrame(given, x, x - given)

    def _follow(self, first, stop, last, start, contacts, used=None, displacements=None) -> Iterator[ShotFrame]:
        """Yields the frames of a stretch after its first one, until the shot is reached at ``stop`` or later.

        At ``last`` the segment ends, or its meshes jump. Without ``displacements`` of the vertices ``used`` at each
        frame, shape [frames, n, 3], these are sought, and fade from frame to frame. ``contacts`` by interval are
        written then, and known from the start later.
        """
        frame, known = start, Contacts.none()
        for index in range(first, last):
            if index >= stop and not frame.differs:
                break
            interval = self._scene.interval(index)
            if interval.is_at_rest:  # the first frame, which is repaired by itself
                yield frame
                continue
            given, arcs = self._single(interval.x1), self._arcs(interval)
            if displacements is None:
                displacement = _FADING * frame.displacement
                size = np.linalg.norm(displacement, axis=1, keepdims=True)
                displacement = np.where(size < _FADED * self._follower.length, np.float32(0.0), displacement)
            else:
                displacement = np.zeros_like(given)
                if index - first + 1 < len(displacements):
                    displacement[used] = displacements[index - first + 1]
            is_free, follow = self._findings[index].is_free, self._follower.follow
            if is_free and not frame.differs and not displacement.any():
                frame, known = ShotFrame.of_shot(given, arcs), Contacts.none()
            else:
                free_start = frame.given if is_free and self._is_single else None
                options: dict[str, Any] = {"arcs": arcs, "free_start": free_start}
                if displacements is None:
                    known = self._follower.near(known, frame.x)
                    found = follow(frame.x, given, displacement, tolerance=_SOUGHT, known=known, **options)
                    known = contacts[index] = found.contacts
                    added = found.displacement
                else:
                    known = contacts.get(index, Contacts.none())
                    found = follow(frame.x, given, displacement, tolerance=_ACCEPTED, known=known, **options)
                    added = found.x - given
                frame = replace(found, displacement=added.astype(np.float32))
            yield frame

    def _relaxed(self, start: ShotFrame, frames: Iterator[ShotFrame]) -> Iterator[ShotFrame]:
        """Yields the frames after a first one, relaxed: each several times, between those before and after it."""
        window: list[ShotFrame] = [start]
        for frame in (*frames, None):
            if frame is not None:
                window.append(frame)
            for i in range(len(window) - 1 - (frame is not None), 0, -1):
                after = window[i + 1] if i + 1 < len(window) else None
                window[i : i + 2] = filter(None, self._follower.relax(window[i - 1], window[i], after))
            if len(window) > _WINDOW:
                window.pop(0)
                yield window[0]
        yield from window[1:]

    def _with_insides(self, first, frames, reasons) -> tuple[Iterable[ShotFrame], tuple[str, ...]]:
        """Returns frames from that at the start of an interval on with what moves inside tetrahedra.

        Also returns the meshes of which parts are moved less, which ``reasons`` get as well.
        """
        if self._insides is None:
            return frames, ()
        frames = list(frames)
        starts = [first, *range(first, first + len(frames) - 1)]
        given = [self._scene.interval(index).tet_positions[number > 0] for number, index in enumerate(starts)]
        moments = [self._moment(first, number) for number in range(len(frames))]
        frames, held = self._insides.follow(frames, given, moments)
        if held and self._scene.interval(first).is_at_rest:  # then it does not cross more than it did
            finder, (frame, *_) = CollisionDetector(self._follower.mesh), frames
            if len(finder.find_intersections(frame.x)) > len(finder.find_intersections(frame.given)):
                frames = [ShotFrame.of_shot(frame.given)] * len(frames)
        reasons += [
            f"{name} is moved less than contacts need {times_in_words(times)}, as its tetrahedra would invert"
            for name, times in held.items()
        ]
        return frames, tuple(held)

    def _moment(self, first, number) -> Moment:
        """Returns the moment of the frame of a number, counted from that at the start of the first interval."""
        index = first + number
        before = number > 0 and index < len(self._findings) and not self._findings[index].is_joined
        return self._scene.times[index], before

    def _recorder(self) -> StretchRecorder:
        return StretchRecorder(self._is_movable, self._follower.edges, self._follower.length)

    def _record(self, recorder, first, frame, number) -> None:
        """Adds the frame of a number, counted from that at the start of the first interval, to a stretch."""
        assert self._segment is not None
        (vertices,) = np.nonzero((frame.x != frame.given).any(axis=1))
        x = frame.x[vertices].astype(np.float64) + self._origin
        vertices, x = np.append(vertices, len(frame.x) + frame.inner.numbers), np.concatenate([x, frame.inner.x])
        recorder.add(frame, MovedFrame(*self._moment(first, number), self._segment, vertices, x))


def _are_of(segment: Segment, names: Container[str]) -> np.ndarray:
    """Returns whether each vertex is of a mesh, or of one of several meshes, of some names, bool, shape [n]."""
    found = np.zeros(segment.vertex_count, dtype=bool)
    for number, mesh in enumerate(segment.meshes):
        found[segment.vertices_of(number)] |= mesh.name in names
    return found


def _nonzero(displacement) -> tuple[np.ndarray, np.ndarray]:
    """Returns the displaced vertices and their displacements."""
    (vertices,) = np.nonzero(displacement.any(axis=1))
    return vertices, displacement[vertices]


def _joined(sought, count) -> tuple[np.ndarray, np.ndarray]:
    """Returns the vertices displaced at some frame, and their displacements, float32, shape [count, n, 3]."""
    used = np.unique(np.concatenate([vertices for vertices, _ in sought]))
    displacements = np.zeros((count, len(used), 3), np.float32)
    for frame, (vertices, values) in zip(displacements, sought, strict=False):
        frame[np.searchsorted(used, vertices)] = values
    return used, displacements
