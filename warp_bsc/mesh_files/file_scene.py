"""Mesh files by frame as a scene: its times are the numbers of the frames, and vertices move straight between them."""

import contextlib
import threading
from collections.abc import Callable
from functools import lru_cache
from itertools import pairwise
from types import SimpleNamespace

import numpy as np

from .._atomic_file import OutputFile, naming
from ..usd.interval import ReadingRecord, times_in_words
from ..usd.jumps import JumpFinder
from ..usd.read.files import SceneFiles, file_stamp
from ..usd.scene import Scene
from ..usd.selection import Selection
from ..usd.write.points_layer import MovedFrame
from .frames import Frames
from .mesh_file import MeshFile

_UNKNOWN = "mesh files have no unit, no axis and no rate: metres, Y up and 24 frames a second stand for them"


class FileScene(Scene):
    """Mesh files as a scene, which is replayed and repaired as one of USD; without OpenUSD.

    Where a file has other faces than that of the frame before, the motion to it is not known, and a warning says so.

    Attributes:
        frames: The files.
        meshes: The files of each name.
    """

    def __init__(
        self,
        frames: Frames,
        progress: Callable[[int, int], None] | None = None,
        *,
        selection: Selection = Selection(),  # noqa: B008 (frozen)
    ):
        """Reads the files; ``progress`` is called with the number of frames that have been read, and their total.

        Raises:
            OSError: If a file cannot be read.
            ValueError: If a file is not as its format says, or a name is there twice.
        """
        self.frames, self.stage, self.left_out = frames, None, []
        self.path, self.selection = ", ".join(frames.names), selection
        self._lock, self._unreadable = threading.RLock(), ()
        self._collecting = lambda *_: contextlib.nullcontext()
        self._record, self._jumps, self._welds = ReadingRecord(), JumpFinder(), {}
        self._left_out = SimpleNamespace(reasons=self.left_out, notes=[])
        self._segment = self._span = None
        self.files = _Files(frames)
        columns = zip(frames.names, frames.are_several, zip(*frames.paths, strict=True), strict=True)
        self._usd_meshes = self.meshes = meshes = [
            FrameMesh(name, dict(zip(map(float, frames.numbers), paths, strict=True)), moves)
            for name, moves, paths in columns
        ]
        self._by_name = {mesh.name: mesh for mesh in meshes}
        if len(self._by_name) < len(meshes):
            raise ValueError(f"{self.path}: a file is named twice")
        self.times = list(map(float, frames.numbers))
        notes: dict[str, None] = {}
        for done, time in enumerate(self.times):
            if progress:
                progress(done, len(self.times))
            for mesh in meshes:
                notes.update(dict.fromkeys(mesh.look_at(time)))
        changes = {time for mesh in meshes for time in mesh.changes}
        self.dtype = np.dtype(np.float32 if all(mesh.is_single for mesh in meshes) else np.float64)
        if self.times[-1] in changes or len(self.times) == 1:
            self.times.append(self.times[-1])
        inner = [index for index, time in enumerate(self.times[:-1]) if index and time in changes]
        self._spans = list(pairwise([0, *inner, len(self.times) - 1]))
        self._warnings = [*notes, _UNKNOWN, *selection.unmatched(meshes)]
        for mesh in meshes:
            if mesh.changes:
                when = times_in_words(mesh.changes)
                self._warnings.append(f"{mesh.name} has other faces {when}: the motion to it is not checked")
        self.up_axis, self.meters_per_unit, self.time_codes_per_second, self.comments = "Y", 1.0, 24.0, []
        self.names = frames.names
        self.paths, self.display_names = {name: name for name in self.names}, dict.fromkeys(self.names, "")
        self.has_strands, self.turning = False, 0
        segment = self.segment(0)
        self.vertex_count, self.face_count = segment.vertex_count, len(segment.faces)


class FrameFiles:
    """The files of a scene's frames, written again one by one, each whole.

    Attributes:
        frames: The files that are written, and in place of those that are not, the scene's.
        end: Last frame that is written; None writes all.
    """

    def __init__(self, scene: FileScene, outputs: list[list[str | None]]):
        """Checks that files of the first frame can be written to ``outputs``, which has None for those that are not.

        Raises:
            OSError: If one cannot be.
        """
        self._scene, self._outputs, self._written = scene, outputs, set()
        self.end: float | None = None
        pairs = zip(scene.frames.paths, outputs, strict=True)
        paths = [[to or path for path, to in zip(*pair, strict=True)] for pair in pairs]
        self.frames = scene.frames._replace(paths=paths)
        for output in filter(None, outputs[0]):
            OutputFile(output).discard()

    def add(self, frame: MovedFrame) -> None:
        """Writes the files of a frame with its moved vertices.

        Raises:
            OSError: If the disk is full.
        """
        if frame.before:
            return  # there is no file of the moment before the faces change
        self._write(frame.time, {number: (points, x) for number, points, x in frame.by_mesh()})

    def finish(self, _facts: dict) -> None:
        """Writes the other frames, which are as they were; errors as of :meth:`add`."""
        for time in sorted({*self._scene.times} - self._written):
            if self.end is None or time <= self.end:
                self._write(time, {})

    def shrink(self) -> bool:
        """Returns False: files that were written are whole, and stay."""
        return False

    def discard(self) -> None:
        """Does nothing: no file is open between two frames."""

    def _write(self, time: float, moved: dict[int, tuple[np.ndarray, np.ndarray]]) -> None:
        """Writes the files of a frame, given the moved vertices and their positions by number of the file."""
        for number, output in enumerate(self._outputs[self._scene.frames.numbers.index(int(time))]):
            if output is None:
                continue
            mesh = self._scene.meshes[number].read(time)
            x = mesh.x.copy()
            if number in moved:
                vertices, positions = moved[number]
                x[vertices] = positions
            file = OutputFile(output)
            try:
                with naming(output):
                    file.write(mesh.with_positions(x))
                    file.commit()
            finally:
                file.discard()
        self._written.add(time)


class _Files(SceneFiles):
    """The files of a scene of mesh files."""

    def __init__(self, frames: Frames):
        self._stamps = {path: file_stamp(path) for paths in frames.paths for path in paths}
        self._changes = []

    def _find(self):
        """Does nothing: all files are known."""


class FrameMesh:
    """The files of one name, as a segment reads a mesh."""

    instanced_prim = ""
    is_strands = is_rigid = may_jump = has_tetrahedra = False
    why_not_written = None

    def __init__(self, name: str, paths: dict[float, str], moves: bool):
        self.name = self.path = name
        self._paths = paths
        self.times = set(paths) if moves else set()
        self.deforms = moves
        self.changes: list[float] = []
        self.is_single = True
        self.why_not_repaired = None if moves or len(paths) == 1 else "it is one file for all frames"
        self._before = dict(zip([*paths][1:], paths, strict=False))
        self._load = lru_cache(2)(MeshFile)

    def read(self, time: float) -> MeshFile:
        """Returns the file of a frame."""
        return self._load(self._paths[time])

    def look_at(self, time: float) -> list[str]:
        """Compares a frame with the one before, and returns what is to be said of it."""
        mesh = self.read(time)
        self.is_single &= mesh.x.dtype == np.float32
        if time in self._before:
            before = self.read(self._before[time])
            if len(before.x) != len(mesh.x) or not np.array_equal(before.faces, mesh.faces):
                self.changes.append(time)
        return [f"{self.name}: {note}" for note in mesh.notes]

    def state_at(self, _time: float) -> bool:
        """Returns True: there is a file at all frames."""
        return True

    def read_points(self, time: float) -> np.ndarray:
        """Returns the positions at a frame, shape [point_count, 3]."""
        return self.read(time).x

    def read_triangles(self, time: float, _points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the triangles, and the polygon of each."""
        mesh = self.read(time)
        return mesh.faces, mesh.polygons

    def read_positions(
        self, time: float, *, before: bool, used: np.ndarray, point_count: int, dtype: np.dtype
    ) -> np.ndarray:
        """Returns positions of vertices at a frame; before one with other faces, those of the frame before it."""
        if before and time in self.changes:
            time = self._before[time]
        return self.read(time).x[used].astype(dtype)
