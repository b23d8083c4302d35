"""The meshes of a USD scene as motion between time samples: fixed faces, and positions in world space.

Every ``UsdGeom.Mesh`` that is loaded and selected is read, including those of references, payloads, variants, native
instances and point instancers, with blend shapes and joints. Cubes, spheres, capsules, cylinders, cones and planes are
read as polyhedra, linear ``UsdGeom.BasisCurves`` as edges, and ``UsdGeom.Points`` as points; all count as meshes. They
are merged to one list of vertices and one of faces. One with a subdivision scheme is read as its control cage. Polygons
are cut into triangles once; holes and points without faces are omitted. Vertices that have the same position at every
time are welded to one: those on the two sides of a seam would touch all the time. Broken meshes are left out while they
are broken, and named.

A scene's times are those of the points, transforms and skeletons of all meshes together; at a time that is not a mesh's
own sample, USD interpolates. Rotating transforms and skeletons do not move points straight from one sample to the next:
they are sampled at every whole time code between as well, and splines as :func:`~.read.samples.sample_times` describes.
From one time to the next, each vertex moves straight, to its position just before the second; a mesh that only its
transform moves turns instead, if :mod:`~warp_bsc.usd.turns` finds that it does. Where a mesh changes its topology,
appears or vanishes, one :class:`~warp_bsc.usd.segment.Segment` ends and the next begins.

USD stores points in single precision, transforms in double. If every transform is the identity, positions are the
stored ones in single precision; otherwise all are computed and returned in double precision.
"""

import math
import os
import threading
from collections.abc import Callable, Iterable, Iterator
from itertools import pairwise
from numbers import Integral
from typing import TYPE_CHECKING

import numpy as np

from .._arguments import given
from .._one_thread import one_at_a_time
from .frames import FrameRange
from .interval import Interval, LeftOutMesh, ReadingNotes, ReadingRecord
from .jumps import JumpFinder, jumps_at
from .read.files import SceneFiles
from .read.openusd import check_openusd
from .scene_options import EmptySceneError, SceneOptions
from .scene_times import find_times
from .segment import Segment
from .selection import Selection

if TYPE_CHECKING:
    from pxr import Sdf, Usd

    from .read.meshes import UsdMesh  # which imports pxr

# If a crate file is mapped into memory, every page read counts as memory of this process, which seems to grow with each
# frame. USD reads these variables when it is loaded; without the second one it reports the first on standard error.
if "USDC_USE_ASSET" not in os.environ:
    os.environ["USDC_USE_ASSET"] = "1"
    os.environ.setdefault("TF_ENV_SETTING_ALERTS_ENABLED", "0")


class Scene:
    """The moving meshes of a USD file or stage, as intervals between consecutive times: ``for interval in scene``.

    A scene holds one segment of the motion in memory and reads another one when an interval needs it. Threads may share
    a scene: they read one interval at a time. Jumps are found between intervals that are read in order.

    It can be pickled, for another process that reads other intervals of the same files: the pickle holds its path, its
    options, and what reading has revealed so far. Unpickling opens the file again, and raises a ValueError if the file
    has changed.

    A USD stage in memory is read as it is, with edits that are not saved, session layer and population mask::

        scene = bsc.Scene(stage)
        found = [(result.summary.start, len(result.contacts)) for result in bsc.replay(scene)]

    For other processes it is flattened and written to a temporary file, which warns.

    Attributes:
        path: The file; of a USD stage in memory the identifier of its root layer.
        selection: The meshes that are checked, and the pairs of them.
        stage: The open ``Usd.Stage``.
        files: The files that the stage is read from.
        times: Time codes between which motion is straight, ascending, at least two. The last one is there twice, as an
            interval without motion, if meshes jump, appear, vanish or change their topology then, or if it is the only
            one: nothing moves, appears or vanishes, or the frames are one time alone.
        time_codes_per_second: Number of time codes in a second.
        meters_per_unit: The scene's unit of length [m].
        up_axis: "Y" or "Z".
        dtype: Type of the positions, float32 or float64.
        names: Names of all meshes that are checked at some time.
        paths: Paths of the prims that they are read from, by name.
        display_names: Display names in the file, by name; empty where there is none.
        comments: Comment and documentation of the file, pairs of a title and a text.
        vertex_count: Number of vertices of the first segment, welded.
        face_count: Number of triangles of the first segment.
        turning: Number of meshes that transforms or skeletons move, which is not straight between samples.
        has_strands: Whether it has curves or points that are checked at some time.
        left_out: The parts that were left out so far because they could not be read, and the reasons, a sentence each.
    """

    times: list[float]

    def __init__(
        self,
        source: "str | os.PathLike | Usd.Stage | Sdf.Layer",
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
            source: A ``.usd``, ``.usda``, ``.usdc`` or ``.usdz`` file, as OpenUSD's asset resolver finds it; or a
                ``Usd.Stage`` or ``Sdf.Layer`` in memory, which the program must not change meanwhile.
            selection: Selects the meshes that are checked, and the pairs of them; default: those to be rendered.
            frames: The part of its time; default: all.
            subdivide: Number of intervals, 1 to 10,000, into which each step between two times is divided.
            sample_turns: Whether rotating transforms and skeletons are sampled at every whole time code too, if
                ``frames`` has no step.
            strict: Whether unreadable parts are an error instead of being left out.
            allow_missing: Patterns of files and prims that may be missing: a warning names them; they are neither in
                :attr:`left_out` nor an error. ``*`` matches any text. A pattern is matched with the path of a missing
                file, its end from any folder on, and the path of the prim that refers to it or to a missing prim; it
                includes the prims below. Files that cannot hold geometry, for example materials and textures, may
                always be missing.
            progress: Called while vertices are welded, which reads the scene once, with the number of its times that
                have been compared, and their total.

        Raises:
            ImportError: If OpenUSD is missing or too old.
            TypeError: If an argument has another type.
            FileNotFoundError: If there is no such file.
            ValueError: If the file is not USD, has no mesh, or no mesh is selected; if ``strict``, also if a
                part cannot be read. The message names the argument, or the file, the prim and the time.
        """
        check_openusd()
        stage, path = None, source
        if not isinstance(source, (str, os.PathLike)):
            from .read.stage import given_stage, name_of  # noqa: PLC0415 (imports pxr)

            stage = given_stage(source)
            path = name_of(stage)
        options = SceneOptions.of(selection, frames, subdivide, sample_turns, strict, allow_missing)
        if progress is not None and not callable(progress):
            raise TypeError(f"progress must be a function, not {given(progress)}")
        self._open(path, options, progress=progress, stage=stage)

    def _open(
        self,
        path: str | os.PathLike,
        options: SceneOptions,
        left_out: Iterable[LeftOutMesh] = (),
        welds: dict[tuple[int, int], tuple[np.ndarray, np.ndarray]] | None = None,
        *,
        progress: Callable[[int, int], None] | None = None,
        stage: "Usd.Stage | None" = None,
    ) -> None:
        """Opens the file or takes a stage, and finds its meshes; left-out ones and welds are of another process."""
        from pxr import UsdGeom  # noqa: PLC0415 (slow)

        from .read.find_meshes import find_meshes  # noqa: PLC0415 (imports pxr)
        from .read.stage import check_stage, open_stage  # noqa: PLC0415
        from .read.unreadable import LeftOut, UnreadableError, collecting  # noqa: PLC0415
        from .transform_warnings import transform_warnings  # noqa: PLC0415

        self._lock = threading.RLock()
        self._options = options
        self.path = str(path)
        self.selection = options.selection or Selection()
        self._unreadable = UnreadableError
        self._left_out = LeftOut(path, options.strict, options.allow_missing)
        self.left_out = self._left_out.reasons
        self._is_given, self._written = stage is not None, None
        self.stage = open_stage(path, self._left_out) if stage is None else stage  # prims expire with their stage
        if stage is not None:
            check_stage(stage, path, self._left_out)
        self.files = SceneFiles(self.stage)
        self._record = record = ReadingRecord()
        self._collecting = collecting
        with collecting(record.messages, path):
            self.time_codes_per_second = self.stage.GetTimeCodesPerSecond()
            # Old exporters store it in single precision, which UsdGeom.GetStageMetersPerUnit rejects.
            self.meters_per_unit = float(self.stage.GetMetadata("metersPerUnit"))
            self.up_axis = str(UsdGeom.GetStageUpAxis(self.stage))
            texts = {"Comment": "comment", "Documentation": "documentation"}
            self.comments = [(title, text) for title, key in texts.items() if (text := self.stage.GetMetadata(key))]
            self._usd_meshes, self._warnings = find_meshes(self.stage, path, self.selection, self._left_out)
            if not self._usd_meshes and not self.left_out:
                none = ", or none is selected" * bool(options.selection)
                reason = "".join(f"; {warning}" for warning in self._warnings[:1])
                raise EmptySceneError(f"{path}: no visible mesh in the scene{none}{reason}")
            self._by_name = {mesh.name: mesh for mesh in self._usd_meshes}
            self.dtype = np.dtype(np.float32 if all(mesh.is_placed for mesh in self._usd_meshes) else np.float64)
            frames = options.frames or FrameRange()
            own_start = self.stage.GetStartTimeCode()
            found = find_times(self._usd_meshes, frames, options.subdivide, options.sample_turns, own_start)
            self.times = found.times
            self._warnings += found.warnings + transform_warnings(self._usd_meshes, self.times)
            inner = [index for index, time in enumerate(self.times[:-1]) if index and time in found.changes]
            self._spans = list(pairwise([0, *inner, len(self.times) - 1]))
            if self.times[-2] < self.times[-1] and self._jumps_at_end():
                self.times.append(self.times[-1])
                self._spans[-1] = self._spans[-1][0], len(self.times) - 1
            self._segment: Segment | None = None
            self._span: tuple[int, int] | None = None
            self._jumps = JumpFinder()
            self._welds = {}  # by span
            for part in left_out:
                self.left_out.append(part.reason)
                self._apply(part)
            self._welds.update(welds or {})
            segment = self.segment(0, progress)
        self.vertex_count, self.face_count = segment.vertex_count, len(segment.faces)
        read = [mesh for mesh in self._usd_meshes if any(mesh.states.values())]
        self.names = [mesh.name for mesh in read]
        self.paths = {mesh.name: mesh.path for mesh in read}
        self.display_names = {mesh.name: mesh.display_name for mesh in read}
        self.has_strands = any(mesh.is_strands for mesh in read)
        self.turning = sum(mesh.turns for mesh in read)

    @property
    def warnings(self) -> list[str]:
        """Sentences on unread contents and on changes to the motion; on jumps in the intervals read so far."""
        return self._record.warnings(self.left_out, self._left_out.notes, self._warnings)

    @property
    def has_file(self) -> bool:
        """Whether there is a file, over which a USD layer can be put; not if it is a USD stage in memory alone."""
        return not self._is_given or bool(self.stage.GetRootLayer().realPath)

    @property
    def is_still(self) -> bool:
        """Whether one time alone is checked, as nothing moves, appears or vanishes, or as the frames say."""
        return self.times[0] == self.times[-1]

    def __len__(self) -> int:
        """Returns the number of intervals, at least 1."""
        return len(self.times) - 1

    def __iter__(self) -> Iterator[Interval]:
        """Yields all intervals in order, reading each when it is reached; errors as of :meth:`interval`."""
        return self.intervals()

    def __reduce__(self):
        """Returns the call that opens the scene again."""
        revealed = tuple(self._record.parts), self._welds
        if self._is_given:
            from .read.stage import write_for_others  # noqa: PLC0415 (imports pxr)

            self.files.check()
            self._written = self._written or write_for_others(self.stage, self)
            return _open_again, (self._written, self._options, revealed, {}, self._contents()[:2])
        path = os.path.abspath(self.path) if os.path.exists(self.path) else self.path
        return _open_again, (path, self._options, revealed, self.files.versions(), self._contents())

    def intervals(self, first: int = 0, stop: int | None = None) -> Iterator[Interval]:
        """Yields intervals in order, reading each when it is reached, and the one before the first to find jumps.

        Args:
            first: Number of the first interval.
            stop: Number of the interval after the last one; default: all.

        Raises:
            TypeError: If a number is not an integer.
            IndexError: If there is no such interval.
            ValueError: As of :meth:`interval`.
        """
        first = self._checked_index(first, "first", len(self))
        stop = len(self) if stop is None else self._checked_index(stop, "stop", len(self))
        return self._intervals(first, stop)

    def _intervals(self, first: int, stop: int) -> Iterator[Interval]:
        self.take_notes()
        if 0 < first < stop and self.segment(first).may_jump and not self._jumps.has_read(first - 1):
            self._read_positions(first - 1)
        for index in range(first, stop):
            yield self._read(index)

    def interval(self, index: int) -> Interval:
        """Returns the motion from one time to the next.

        Args:
            index: Number of the interval, from 0; it starts at ``times[index]``.

        Raises:
            TypeError: If a number is not an integer.
            IndexError: If there is no such interval.
            ValueError: If a mesh is broken and may not be left out, nothing that moves remains, or the stage has
                changed.
        """
        index = self._checked_index(index, "index", len(self) - 1)
        self.take_notes()
        return self._read(index)

    @one_at_a_time
    def segment(self, index: int, progress: Callable[[int, int], None] | None = None) -> Segment:
        """Returns the segment of an interval, the one in memory if possible.

        Args:
            index: Number of the interval.
            progress: As of :class:`Scene`.

        Raises:
            ValueError: As of :meth:`interval`.
        """
        while self._segment is None or self._span is None or not self._span[0] <= index < self._span[1]:
            span = next(span for span in self._spans if span[0] <= index < span[1])
            start, stop = span
            present = [mesh for mesh in self._usd_meshes if mesh.state_at(self.times[start]) is not None]
            self._segment = self._span = None  # before the next is read, to free memory
            self._jumps.forget()
            try:
                times, welds = self.times[start : stop + 1], self._welds.get(span)
                self._segment = Segment(present, times, self.dtype, progress, welds)
            except self._unreadable as error:
                self._leave_out(error, start)
            else:
                self._span = span
                self._welds[span] = self._segment.welds
                self._record.welded = max(self._record.welded, self._segment.welded)
        return self._segment

    def prim_of(self, name: str) -> "UsdMesh":
        """Returns the prim, or the instance of one, that is read as the mesh of a name."""
        return self._by_name[name]

    @one_at_a_time
    def take_notes(self, jumps: tuple[str, ...] = ()) -> ReadingNotes:
        """Returns the notes on reading since the last call, or since the scene was opened, and given jumps."""
        return self._record.take(jumps)

    @one_at_a_time
    def note(self, index: int, notes: ReadingNotes) -> None:
        """Records notes on reading an interval in another process, as if this scene had read it.

        Args:
            index: Number of the interval.
            notes: The notes. Those of all previous intervals must have been recorded.
        """
        for part in notes.left_out:
            self.left_out.append(part.reason)
            self._apply(part)
        messages = self._record.messages
        messages += [message for message in notes.messages if message not in messages]
        self._record.add_jumps(notes.jumps, self.times[index])

    @one_at_a_time
    def _read(self, index) -> Interval:
        """Returns an interval, with the notes on reading since the last call of :meth:`take_notes`."""
        self.files.check_stage()
        segment, x0, x1, tet_positions, jumps = self._read_positions(index)
        start, end = self.times[index : index + 2]
        with self._collecting(self._record.messages, self.path):
            turns, bent = segment.turns(start, end) if self.turning and end > start else ({}, [])
        notes = [f"subdivide: {n} moves on curves, not by a turn at one rate: checked on straight paths" for n in bent]
        self._record.messages += [note for note in notes[:1] if note not in self._record.messages]
        is_joined = not segment.may_jump and bool(self._span and index + 1 < self._span[1])
        return Interval(index, start, end, segment, x0, x1, is_joined, self.take_notes(jumps), tet_positions, turns)

    @one_at_a_time
    def _read_positions(self, index) -> tuple[Segment, np.ndarray, np.ndarray, tuple, tuple[str, ...]]:
        """Returns an interval's segment, positions at start and end, those of tetrahedra, and meshes that jump."""
        start, end = self.times[index : index + 2]
        with self._collecting(self._record.messages, self.path):
            while True:
                segment = self.segment(index)
                try:
                    x0 = segment.positions(start, last=self._jumps.end_of(index - 1, segment))
                    x1 = segment.positions(end, before=True) if end > start else x0
                    tets = segment.tetrahedra
                    tet_positions = tets.positions(start), tets.positions(end, before=end > start)
                    break
                except self._unreadable as error:
                    self._leave_out(error, index)
        jumps = self._jumps.find(index, segment, x0, x1)
        self._record.add_jumps(jumps, start)
        return segment, x0, x1, tet_positions, jumps

    def _checked_index(self, index, name, last) -> int:
        """Returns the number of an interval; raises a TypeError, or an IndexError if it is not in [0, last]."""
        if not isinstance(index, Integral) or isinstance(index, bool):
            raise TypeError(f"{name} must be an integer, not {given(index)}")
        if not 0 <= int(index) <= last:
            raise IndexError(f"{name}: {self.path} has no interval {given(int(index))}, only 0 to {len(self) - 1}")
        return int(index)

    def _contents(self) -> tuple:
        """Returns facts of the scene that must be the same in another process."""
        return self.times, [mesh.name for mesh in self._usd_meshes], len(self.left_out)

    def _jumps_at_end(self) -> bool:
        """Returns whether a mesh jumps at the last time, or cannot be read at it."""
        times = self.times[-2:]
        jumping = [mesh for mesh in self._usd_meshes if mesh.may_jump and mesh.state_at(times[0]) is not None]
        if not jumping:
            return False
        nothing = np.zeros(0, dtype=np.int64)
        try:
            return jumps_at(times[1], Segment(jumping, times, self.dtype, welds=(nothing, nothing)))
        except self._unreadable:
            return True

    def _leave_out(self, error, index):
        """Leaves out the mesh of an error from the interval in which it breaks, or from ``index`` if that is later.

        It is there again from the first later interval at whose start it can be read.
        """
        since = max(index, self.times.index(error.time) - 1)
        mesh, later = self.prim_of(error.mesh), range(since + 1, len(self))
        until = next((number for number in later if mesh.can_be_read(self.times[number])), len(self))
        start = f"from time {self.times[since]:g} " if since or until < len(self) else ""
        end = f"to {self.times[until]:g}: " if until < len(self) else "on: " * bool(since)
        self._left_out.add(error, start + end)
        self._apply(LeftOutMesh(mesh.name, since, until, self.left_out[-1]))

    def _apply(self, part: LeftOutMesh) -> None:
        """Leaves a mesh out of intervals."""
        self._record.parts.append(part)
        since, until = part.since, part.until
        times = self.times[since] if since else -math.inf, self.times[until] if until < len(self) else math.inf
        self.prim_of(part.name).leave_out(*times)
        self._welds = {span: welds for span, welds in self._welds.items() if span[1] <= since or span[0] >= until}
        cuts = {since, until} | {number for span in self._spans for number in span}
        self._spans = list(pairwise(sorted(cuts)))
        self._span = None
        self._jumps.forget()


def _open_again(path, options, revealed, versions, contents) -> Scene:
    """Opens a scene that another process has opened; a ValueError if the file or the scene differs here."""
    check_openusd()
    scene = Scene.__new__(Scene)
    scene._open(path, options, *revealed)
    if changed := scene.files.differing(versions):
        raise ValueError(f"{changed}: not the version of the file that the replay was started with")
    if scene._contents()[: len(contents)] != contents:
        raise ValueError(f"{path}: this process does not read the same meshes as the one that started the replay")
    return scene
