"""The meshes of a USD scene as motions between time samples: fixed faces, and positions in world space.

What is read
------------
Every ``UsdGeom.Mesh`` that is loaded and selected is read, wherever references, payloads, variants, native instances
and point instancers put it. Cubes, spheres, capsules, cylinders, cones and planes are read as polyhedra; linear
``UsdGeom.BasisCurves`` as edges, and ``UsdGeom.Points`` as points, with half their widths, lengthened as much as their
transform lengthens most, as radii; without widths, radii are 0. In what follows, these are meshes too. All meshes are
merged to one list of vertices and one of faces, so that collisions of a mesh with itself and with others are found
alike. A mesh with a subdivision scheme is read as its control cage. Polygons are cut into triangles once; holes and
points that no face refers to are left out. Blend shapes and joints move the points as UsdSkel computes them.

Vertices that are in one place at every time are welded to one. The two sides of a seam are an example, or a cloth that
was written as one mesh for each of its colours: unwelded, they would touch all the time.

What moves
----------
The points, the transforms and the skeleton of a mesh may all have time samples. A scene's times are those of all
meshes together; at a time that is not a mesh's own sample, USD interpolates. Rotating transforms and skeletons do not
move points straight from one sample to the next: they are sampled at every whole time code between as well, and splines
as finely as :func:`~warp_bsc.usd.stage.sample_times` says. From one time to the next each vertex is taken to move
straight, from its place at the first time to its place just before the second. A mesh that jumps at the second time,
from one value clip to the next or because a value was held, therefore ends where it was before the jump.

Times less than a millionth of a time code apart, or less than a millionth of the whole time if that is shorter, count
as one: rounding produces such times in files, and OpenUSD uses them to separate the end of a value clip from the start
of the next.

Where a mesh changes its topology, appears or vanishes, one :class:`~warp_bsc.usd.segment.Segment` ends and the next
begins.

Precision
---------
USD stores points in single precision, transforms in double. If every transform is the identity, positions are the
stored ones, in single precision; otherwise all are computed and returned in double precision.

What cannot be read
-------------------
Broken meshes and instances, and files that cannot be opened and may hold geometry, are left out from the time on at
which they are broken, and named in :attr:`Scene.left_out`. The rest is read as long as something in it moves. A scene
in which nothing ever moves is read at one time.

:attr:`Scene.warnings` names the contents that this module does not read (other curves and shapes without polygons,
unselected meshes) and the changes that it makes to the motion.
"""

# pyright: reportAttributeAccessIssue=false
# (OpenUSD's stubs leave out the classes of its modules.)

import math
import os
import threading
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from numbers import Integral

import numpy as np

from .._arguments import check_instance, checked_flag, checked_integer, checked_number, checked_strings, given
from .._one_thread import one_at_a_time
from .files import SceneFiles
from .interval import (
    Interval,
    LeftOutMesh,
    ReadingNotes,
    jump_warning,
    left_out_warning,
    message_warning,
    times_in_words,
)
from .segment import Segment
from .selection import Selection

__all__ = ["FrameRange", "Scene"]

_JUMP = 1e-4  # a jump is more than this share of a mesh's way in an interval; merged times make smaller gaps
_MOST_PARTS = 10_000  # of a step between two times
_NAMED = 5  # most parts left out, and most messages of OpenUSD, that the warnings list
_ROUNDING = 1e-12
_SAME_TIME = 1e-6

# If a crate file is mapped into memory, every page read counts as memory of this process, which then seems to grow with
# each frame. USD reads these variables when it is loaded; without the second it reports the first on standard error.
if "USDC_USE_ASSET" not in os.environ:
    os.environ["USDC_USE_ASSET"] = "1"
    os.environ.setdefault("TF_ENV_SETTING_ALERTS_ENABLED", "0")


@dataclass(frozen=True)
class FrameRange:
    """A part of a scene's time.

    Attributes:
        start: First time code, None for that of the scene.
        end: Last time code, None for that of the scene.
        step: Time codes from one time to the next, more than 0, None for the samples that the scene has.

    Raises:
        TypeError: If one of them is no number.
        ValueError: If one of them is not finite, the end is not after the start, or the step is not more than 0.
    """

    start: float | None = None
    end: float | None = None
    step: float | None = None

    def __post_init__(self):
        """Checks the attributes."""
        for name in ("start", "end", "step"):
            value = getattr(self, name)
            if value is not None:
                limits = {"minimum": 0.0, "above": True} if name == "step" else {}
                object.__setattr__(self, name, checked_number(value, name, **limits))
        if self.start is not None and self.end is not None and self.end <= self.start:
            raise ValueError(f"end must be after the start, {self.start:g}, not {self.end:g}")

    def bounds(self, samples: list[float]) -> tuple[float, float]:
        """Returns the first and the last time, given all times of the scene, ascending."""
        return (
            samples[0] if self.start is None else max(self.start, samples[0]),
            samples[-1] if self.end is None else min(self.end, samples[-1]),
        )

    def times(self, samples: list[float], changes: set[float]) -> list[float]:
        """Returns the times of this part, ascending.

        Args:
            samples: All times of the scene, ascending.
            changes: Times at which meshes change their topology, appear or vanish: a step never passes over these.

        Raises:
            ValueError: If there are fewer than two times.
        """
        start = samples[0] if self.start is None else self.start
        end = samples[-1] if self.end is None else self.end
        low, high = self.bounds(samples)
        if self.step is None:
            times = {low, high, *samples}
        else:
            first, last = math.ceil((low - start) / self.step), math.floor((high - start) / self.step + 1e-9)
            times = {*(min(start + number * self.step, high) for number in range(first, last + 1)), *changes}
        times = sorted(time for time in times if low <= time <= high)
        if len(times) < 2:
            raise ValueError(
                f"frames: no motion from time {start:g} to {end:g}; the scene's goes from {samples[0]:g} to "
                f"{samples[-1]:g}"
            )
        return times


class Scene:
    """The moving meshes of a USD file, as intervals between consecutive times: ``for interval in scene``.

    A scene holds one segment of the motion in memory and reads others when an interval needs them. Threads may share a
    scene: each interval that one reads waits for the one before. Jumps are found between intervals read in order.

    It can be pickled, for another process that reads other intervals of the same files: the pickle holds its path, its
    options, and what reading has revealed so far. Unpickling opens the file again, and raises a ValueError if it is not
    the same one.

    Attributes:
        path: The file.
        selection: Which of its meshes are checked.
        stage: The open ``Usd.Stage``.
        files: The files that the stage is read from.
        times: Time codes between which motion is straight, ascending, at least two. If nothing moves, appears or
            vanishes, it is one time code, twice: one interval without motion.
        time_codes_per_second: Number of time codes in a second.
        meters_per_unit: The scene's unit of length [m].
        up_axis: "Y" or "Z".
        dtype: Type of the positions, float32 or float64.
        names: Names of all meshes that are checked at some time.
        display_names: Display names in the file, by name; empty where there is none.
        comments: Comment and documentation of the file, pairs of a title and a text.
        vertex_count: Number of vertices of the first segment, welded.
        face_count: Number of triangles of the first segment.
        turning: Number of meshes that transforms or skeletons move, which is not straight between samples.
        has_strands: Whether it has curves or points that are checked at some time.
    """

    times: list[float]

    def __init__(
        self,
        path: str | os.PathLike,
        *,
        selection: Selection | None = None,
        frames: FrameRange | None = None,
        subdivide: int = 1,
        sample_turns: bool = True,
        strict: bool = False,
        allow_missing: Iterable[str] = (),
        progress: Callable[[int, int], None] | None = None,
    ):
        """Opens the file and finds its meshes.

        Args:
            path: A ``.usd``, ``.usda``, ``.usdc`` or ``.usdz`` file, as OpenUSD's asset resolver finds it.
            selection: Which of its meshes are checked; default: those to be rendered.
            frames: The part of its time; default: all.
            subdivide: Number of intervals, 1 to 10,000, into which each step between two times is divided.
            sample_turns: Whether rotating transforms and skeletons are sampled at every whole time code too, if
                ``frames`` has no step.
            strict: Whether unreadable parts are an error instead of being left out.
            allow_missing: Patterns of files, and of prims, that may be missing: a warning names them, and they neither
                are in :attr:`left_out` nor an error. ``*`` matches any text. A pattern is matched with the path of a
                missing file, its end from any folder on, and the path of the prim that refers to it or to a missing
                prim; it includes the prims below. Files that cannot hold geometry, such as materials and textures,
                always may be missing.
            progress: Called while vertices are welded, which reads the scene once: with the number of its times that
                have been compared, and of all.

        Raises:
            TypeError: If an argument has another type.
            FileNotFoundError: If there is no such file.
            ValueError: If the file is not USD, has no mesh that can be read, or a selection selects nothing; if
                ``strict``, also if a part cannot be read. The message names the file, the prim and the time.
        """
        check_instance(path, "path", (str, os.PathLike), "the path of a file")
        if selection is not None:
            check_instance(selection, "selection", Selection, "a Selection")
        if frames is not None:
            check_instance(frames, "frames", FrameRange, "a FrameRange")
        if progress is not None and not callable(progress):
            raise TypeError(f"progress must be a function, not {given(progress)}")
        options = _Options(
            selection,
            frames,
            checked_integer(subdivide, "subdivide", 1, _MOST_PARTS),
            checked_flag(sample_turns, "sample_turns"),
            checked_flag(strict, "strict"),
            checked_strings(allow_missing, "allow_missing"),
        )
        self._open(path, options, _Revealed(), progress)

    def _open(
        self,
        path: str | os.PathLike,
        options: "_Options",
        revealed: "_Revealed",
        progress: Callable[[int, int], None] | None = None,
    ) -> None:
        """Opens the file and finds its meshes, as of ``__init__``, given what reading it has revealed earlier."""
        from pxr import UsdGeom  # noqa: PLC0415 (slow)

        from . import meshes as usd_meshes  # noqa: PLC0415 (import pxr)
        from . import stage as usd_stage  # noqa: PLC0415

        self._lock = threading.RLock()
        self._options = options
        self.path = str(path)
        self.selection = options.selection or Selection()
        self._unreadable = usd_stage.UnreadableError
        self._left_out = usd_stage.LeftOut(path, options.strict, options.allow_missing)
        self.stage = usd_stage.open_stage(path, self._left_out)  # prims expire with their stage
        self.files = SceneFiles(self.stage)
        self._messages = []  # OpenUSD's
        self._collecting = usd_stage.collecting
        with self._collecting(self._messages, path):
            self.time_codes_per_second = self.stage.GetTimeCodesPerSecond()
            # Old exporters store it in single precision, which UsdGeom.GetStageMetersPerUnit rejects.
            self.meters_per_unit = float(self.stage.GetMetadata("metersPerUnit"))
            self.up_axis = str(UsdGeom.GetStageUpAxis(self.stage))
            texts = {"Comment": "comment", "Documentation": "documentation"}
            self.comments = [(title, text) for title, key in texts.items() if (text := self.stage.GetMetadata(key))]
            self._usd_meshes, self._warnings = usd_meshes.find_meshes(self.stage, path, self.selection, self._left_out)
            self._check_meshes(bool(options.selection))
            self.dtype = np.dtype(np.float32 if all(mesh.is_placed for mesh in self._usd_meshes) else np.float64)
            changes = self._find_times(options.frames or FrameRange(), options.subdivide, options.sample_turns)
            self._note_changes()
            inner = [index for index, time in enumerate(self.times[:-1]) if index and time in changes]
            self._spans = list(pairwise([0, *inner, len(self.times) - 1]))
            self._segment: Segment | None = None
            self._span: tuple[int, int] | None = None
            self._last = None  # index, segment and positions of the last interval that was read
            self._jump_times = {}  # by the mesh's name
            self._welded = 0
            self._parts: list[LeftOutMesh] = []  # left out after the file was opened
            self._noted = 0, 0  # numbers of these and of messages that notes contain
            self._welds = {}  # by span
            for part in revealed.left_out:
                self._left_out.reasons.append(part.reason)
                self._apply(part)
            self._welds.update(revealed.welds)
            segment = self.segment(0, progress)
        self.vertex_count, self.face_count = segment.vertex_count, len(segment.faces)
        read = [mesh for mesh in self._usd_meshes if any(mesh.states.values())]
        self.names = [mesh.name for mesh in read]
        self.display_names = {mesh.name: mesh.display_name for mesh in read}
        self.has_strands = any(mesh.is_strands for mesh in read)
        self.turning = sum(mesh.turns for mesh in read)

    @property
    def left_out(self) -> list[str]:
        """The parts left out so far because they could not be read, and why, a sentence each."""
        return self._left_out.reasons

    @property
    def warnings(self) -> list[str]:
        """Sentences on unread contents and on changes to the motion; on jumps in the intervals read so far."""
        warnings = [*map(left_out_warning, self.left_out[:_NAMED])]
        if len(self.left_out) > _NAMED:
            warnings.append(f"left out: {len(self.left_out) - _NAMED} more, {len(self.left_out)} in all")
        warnings += map(message_warning, self._messages[:_NAMED])
        warnings += self._left_out.notes[:_NAMED]
        if len(self._left_out.notes) > _NAMED:
            warnings.append(f"missing: {len(self._left_out.notes) - _NAMED} more, {len(self._left_out.notes)} in all")
        warnings += self._warnings
        warnings += (jump_warning(name, sorted(times)) for name, times in self._jump_times.items())
        if self._welded:
            warnings.append(f"vertices in one place at all times were welded: {self._welded}")
        return warnings

    @property
    def is_still(self) -> bool:
        """Whether nothing moves, appears or vanishes."""
        return self.times[0] == self.times[-1]

    def __len__(self) -> int:
        """Returns the number of intervals, at least 1."""
        return len(self.times) - 1

    def __iter__(self) -> Iterator[Interval]:
        """Reads all intervals in order, each when it is reached. Errors are those of :meth:`interval`."""
        return self.intervals()

    def __reduce__(self):
        """Returns what opens the scene again."""
        path = os.path.abspath(self.path) if os.path.exists(self.path) else self.path
        revealed = _Revealed(tuple(self._parts), self._welds)
        return _open_again, (path, self._options, revealed, self.files.versions(), self._contents())

    def intervals(self, first: int = 0, stop: int | None = None) -> Iterator[Interval]:
        """Reads intervals in order, each when it is reached, with the jumps from the one before the first, too.

        Args:
            first: Number of the first interval.
            stop: Number of the interval after the last one; default: all.

        Raises:
            TypeError: If a number is no integer.
            IndexError: If there is no such interval.
            ValueError: As of :meth:`interval`.
        """
        first = self._checked_index(first, "first", len(self))
        stop = len(self) if stop is None else self._checked_index(stop, "stop", len(self))
        return self._intervals(first, stop)

    def _intervals(self, first: int, stop: int) -> Iterator[Interval]:
        self.take_notes()
        if 0 < first < stop and self.segment(first).may_jump and not (self._last and self._last[0] == first - 1):
            self._read_positions(first - 1)
        for index in range(first, stop):
            yield self._read(index)

    def interval(self, index: int) -> Interval:
        """Reads the motion from one time to the next.

        Args:
            index: Number of the interval, from 0: it starts at that one of :attr:`times`.

        Raises:
            TypeError: If a number is no integer.
            IndexError: If there is no such interval.
            ValueError: If a mesh is broken and may not be left out, or nothing that moves is left.
        """
        index = self._checked_index(index, "index", len(self) - 1)
        self.take_notes()
        return self._read(index)

    @one_at_a_time
    def segment(self, index: int, progress: Callable[[int, int], None] | None = None) -> Segment:
        """Returns the segment that an interval is in: the one in memory if possible.

        Args:
            index: Number of the interval.
            progress: As of the constructor.

        Raises:
            ValueError: As of :meth:`interval`.
        """
        while self._segment is None or self._span is None or not self._span[0] <= index < self._span[1]:
            span = next(span for span in self._spans if span[0] <= index < span[1])
            start, stop = span
            present = [mesh for mesh in self._usd_meshes if _state_at(mesh, self.times[start]) is not None]
            self._segment = self._span = self._last = None  # before the next is read, to free memory
            try:
                times, welds = self.times[start : stop + 1], self._welds.get(span)
                self._segment = Segment(present, times, self.dtype, progress, welds)
            except self._unreadable as error:
                self._leave_out(error, start)
            else:
                self._span = span
                self._welds[span] = self._segment.welds
                self._welded = max(self._welded, self._segment.welded)
        return self._segment

    @one_at_a_time
    def take_notes(self, jumps: tuple[str, ...] = ()) -> ReadingNotes:
        """Returns what reading has revealed since this was called last, or since the scene was opened; and jumps."""
        parts, messages = self._noted
        self._noted = len(self._parts), len(self._messages)
        return ReadingNotes(tuple(self._parts[parts:]), tuple(self._messages[messages:]), jumps)

    @one_at_a_time
    def note(self, index: int, notes: ReadingNotes) -> None:
        """Records what reading an interval has revealed in another process, as if this scene had read it.

        Args:
            index: Number of the interval.
            notes: What has been revealed. That of all intervals before must have been recorded.
        """
        for part in notes.left_out:
            self._left_out.reasons.append(part.reason)
            self._apply(part)
        self._messages += [message for message in notes.messages if message not in self._messages]
        for name in notes.jumps:
            self._jump_times.setdefault(name, set()).add(self.times[index])

    @one_at_a_time
    def _read(self, index) -> Interval:
        """Reads an interval, with all that reading has revealed since notes were taken last."""
        segment, x0, x1, jumps = self._read_positions(index)
        start, end = self.times[index : index + 2]
        is_joined = not segment.may_jump and bool(self._span and index + 1 < self._span[1])
        return Interval(index, start, end, segment, x0, x1, is_joined, self.take_notes(jumps))

    @one_at_a_time
    def _read_positions(self, index) -> tuple[Segment, np.ndarray, np.ndarray, tuple[str, ...]]:
        """Reads the segment of an interval, the positions at its start and end, and the names of meshes that jump."""
        start, end = self.times[index : index + 2]
        with self._collecting(self._messages, self.path):
            while True:
                segment = self.segment(index)
                try:
                    last = self._last
                    known = last[3] if last and last[:2] == (index - 1, segment) else None
                    x0 = segment.positions(start, last=known)
                    x1 = segment.positions(end, before=True)
                    break
                except self._unreadable as error:
                    self._leave_out(error, index)
        jumps = self._find_jumps(index, segment, x0, x1)
        for name in jumps:
            self._jump_times.setdefault(name, set()).add(start)
        return segment, x0, x1, jumps

    def _checked_index(self, index, name, last) -> int:
        """Returns the number of an interval; raises a TypeError, or an IndexError if it is not in [0, last]."""
        if not isinstance(index, Integral) or isinstance(index, bool):
            raise TypeError(f"{name} must be an integer, not {given(index)}")
        if not 0 <= int(index) <= last:
            number = given(int(index))
            raise IndexError(f"{self.path}: {name}: there is no interval {number}, they go from 0 to {len(self) - 1}")
        return int(index)

    def _contents(self) -> tuple:
        """Returns facts of the scene that another process must find, too."""
        return self.times, [mesh.name for mesh in self._usd_meshes], len(self.left_out)

    def _check_meshes(self, is_selection):
        """Raises a ValueError if there are no meshes."""
        reason = f"; left out: {self.left_out[0]}" if self.left_out else ""
        if not self._usd_meshes:
            none_selected = ", or none is selected" * is_selection
            reason = reason or "".join(f"; {warning}" for warning in self._warnings[:1])
            raise ValueError(f"{self.path}: no visible mesh in the scene{none_selected}{reason}")

    def _find_times(self, frames, subdivide, sample_turns) -> set[float]:
        """Sets :attr:`times`. Returns those at which meshes change their topology, appear or vanish."""
        own = set().union(*(mesh.times | mesh.states.keys() for mesh in self._usd_meshes)) - {-math.inf}
        if not any(mesh.times for mesh in self._usd_meshes):
            own.add(self.stage.GetStartTimeCode())  # what appears and vanishes does so between moments at rest
        if len(own) == 1:
            self.times = [*own, *own]
            self._warnings.append(f"nothing moves: checked at rest, at time {self.times[0]:g}")
            return set()
        whole = set()
        if sample_turns and frames.step is None:
            low, high = frames.bounds(sorted(own))
            whole = whole.union(*(mesh.turning_times(low, high) for mesh in self._usd_meshes))
        scene_times = _merge(own | whole)
        for mesh in self._usd_meshes:
            mesh.take_times(scene_times)
        changes = {time for mesh in self._usd_meshes for time in mesh.states if time != -math.inf}
        samples = sorted(set(scene_times.values()))
        self.times = frames.times(samples, changes)
        if skipped := sum(self.times[0] < time < self.times[-1] for time in set(samples) - set(self.times)):
            self._warnings.append(f"--frames steps over {skipped} time samples: motion is straight from step to step")
        if subdivide > 1:
            self.times = [
                start + (end - start) * part / subdivide
                for start, end in pairwise(self.times)
                for part in range(subdivide)
            ] + self.times[-1:]
        return changes

    def _leave_out(self, error, index):
        """Leaves out the mesh of an error from the interval on in which it breaks, or from ``index`` on if later."""
        since = max(index, self.times.index(error.time) - 1)
        self._left_out.add(error, f"from time {self.times[since]:g} on: " if since else "")
        self._apply(LeftOutMesh(error.mesh.name, since, self.left_out[-1]))
        if not any((mesh.times or self.is_still) and _is_there(mesh, self.times[since]) for mesh in self._usd_meshes):
            raise error

    def _apply(self, part: LeftOutMesh) -> None:
        """Removes a mesh from an interval on."""
        self._parts.append(part)
        since = part.since
        mesh = next(mesh for mesh in self._usd_meshes if mesh.name == part.name)
        mesh.leave_out(self.times[since] if since else -math.inf)
        first, last = next(span for span in self._spans if span[0] <= since < span[1])
        self._welds.pop((first, last), None)
        if first < since:
            place = self._spans.index((first, last))
            self._spans[place : place + 1] = [(first, since), (since, last)]
        self._span = self._last = None

    def _find_jumps(self, index, segment, start, end) -> tuple[str, ...]:
        """Returns the names of the meshes that do not start an interval where they ended the one before."""
        last, self._last = self._last, (index, segment, start, end)
        if last is None or last[:2] != (index - 1, segment) or start is last[3] or np.array_equal(start, last[3]):
            return ()
        _, _, last_start, last_end = last
        gaps = np.abs(start - last_end).max(axis=1)
        ways = np.maximum(np.abs(last_end - last_start).max(axis=1), np.abs(end - start).max(axis=1))
        rounding = _ROUNDING * np.abs(start).max()
        meshes = segment.vertex_meshes
        names = []
        for number in np.unique(meshes[gaps > rounding]):
            own = meshes == number
            if gaps[own].max() > _JUMP * ways[own].max() + rounding:
                names.append(segment.meshes[number].name)
        return tuple(names)

    def _note_changes(self):
        """Adds a warning for each way in which a mesh appears, vanishes or changes its topology."""
        for mesh in self._usd_meshes:
            times_of = {}
            for (_, old), (time, new) in pairwise(mesh.states.items()):
                if self.times[0] < time <= self.times[-1]:
                    what = "appears" if old is None else "vanishes" if new is None else "changes its topology"
                    times_of.setdefault(what, []).append(time)
            for what, times in times_of.items():
                at = times_in_words(times)
                self._warnings.append(f"{mesh.name} {what} {at}: its motion is split there, a jump is not checked")


@dataclass(frozen=True)
class _Options:
    """The options with which a scene is opened, see :class:`Scene`."""

    selection: Selection | None
    frames: FrameRange | None
    subdivide: int
    sample_turns: bool
    strict: bool
    allow_missing: tuple[str, ...]


@dataclass(frozen=True)
class _Revealed:
    """What reading a scene has revealed: the meshes left out, and the welds of segments, by the span of intervals."""

    left_out: tuple[LeftOutMesh, ...] = ()
    welds: dict[tuple[int, int], tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)


def _open_again(path, options, revealed, versions, contents) -> Scene:
    """Opens a scene that another process has opened.

    Raises:
        OSError: If there is no such file here.
        ValueError: If it is not the same scene here.
    """
    scene = Scene.__new__(Scene)
    scene._open(path, options, revealed)
    if changed := scene.files.differing(versions):
        raise ValueError(f"{changed}: not the version of the file that the replay was started with")
    if scene._contents() != contents:
        raise ValueError(f"{path}: this process does not read the same meshes as the one that started the replay")
    return scene


def _merge(times) -> dict[float, float]:
    """Returns for each time the one that represents all that count as one: the nearest of them to a whole time code."""
    times = sorted(times)
    most = _SAME_TIME * min(1.0, times[-1] - times[0])
    groups = []
    for time in times:
        if groups and time - groups[-1][0] <= most:
            groups[-1].append(time)
        else:
            groups.append([time])
    return {time: min(group, key=lambda time: abs(time - round(time))) for group in groups for time in group}


def _is_there(mesh, time) -> bool:
    """Returns whether a mesh is there at a time or later."""
    return _state_at(mesh, time) is not None or any(state for since, state in mesh.states.items() if since > time)


def _state_at(mesh, time):
    """Returns the state of a mesh at a time, see :attr:`UsdMesh.states`."""
    return next(state for since, state in reversed(mesh.states.items()) if since <= time)
