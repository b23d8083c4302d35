"""The meshes of a USD scene as motions between time samples: fixed faces, and positions in world space.

What is read
------------
Every ``UsdGeom.Mesh`` that is loaded and selected, wherever references, payloads, variants, native instances and point
instancers put it, merged to one list of vertices and one of faces: collisions of a mesh with itself and with others
are then found alike. A mesh with a subdivision scheme is read as its control cage. Polygons become triangles and stay
cut that way; holes and points that no face refers to are left out. Blend shapes and joints move the points as UsdSkel
has it.

Vertices that are in one place at every time are welded to one. Such are the two sides of a seam, or of a cloth that was
written as one mesh for each of its colours: they belong together, and not welded would touch for ever.

What moves
----------
The points, the transforms and the skeleton of a mesh may all have time samples. A scene's times are those of all
meshes together; at a time that is not a mesh's own sample, USD interpolates. From one time to the next each vertex is
taken to move straight, from where USD has it at the first to where USD has it when the second comes: what jumps there
ends where it was before.

Where a mesh changes its topology, appears or vanishes, one :class:`~warp_bsc.segment.Segment` ends and the next begins.

Precision
---------
USD stores points in single precision, transforms in double. Where every transform is the identity, positions are those
stored, in single precision; otherwise all are computed and returned in double precision.

What the file has but this module does not read (spheres and other shapes that are not meshes, what is not selected) is
named in :attr:`Scene.warnings`, and so is what becomes of the motion.
"""

import math
import os
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from .scene_files import SceneFiles
from .segment import Segment
from .selection import Selection

__all__ = ["FrameRange", "Scene"]

# Mapped into memory, every page of a crate file that has been read counts as memory of this process, which would then
# seem to grow with each frame. USD looks at this when it is loaded, and would else say so on standard error.
if "USDC_USE_ASSET" not in os.environ:
    os.environ["USDC_USE_ASSET"] = "1"
    os.environ.setdefault("TF_ENV_SETTING_ALERTS_ENABLED", "0")


@dataclass(frozen=True)
class FrameRange:
    """A part of a scene's time.

    Attributes:
        start: First time code, None for that of the scene.
        end: Last time code, None for that of the scene.
        step: Time codes from one time to the next, None for the samples that the scene has.
    """

    start: float | None = None
    end: float | None = None
    step: float | None = None

    def times(self, samples: list[float], changes: set[float]) -> list[float]:
        """The times to look at.

        Args:
            samples: All times of the scene, ascending.
            changes: Those at which meshes change their topology, appear or vanish, which are not stepped over.

        Raises:
            ValueError: If there are not two of them.
        """
        start = samples[0] if self.start is None else self.start
        end = samples[-1] if self.end is None else self.end
        low, high = max(start, samples[0]), min(end, samples[-1])
        if self.step is None:
            times = {low, high, *samples}
        else:
            first, last = math.ceil((low - start) / self.step), math.floor((high - start) / self.step + 1e-9)
            times = {*(min(start + number * self.step, high) for number in range(first, last + 1)), *changes}
        times = sorted(time for time in times if low <= time <= high)
        if len(times) < 2:
            raise ValueError(
                f"--frames: no motion from time {start:g} to {end:g}; the scene's goes from {samples[0]:g} to "
                f"{samples[-1]:g}"
            )
        return times


class Scene:
    """The meshes of a USD file. Holds one segment of its motion and reads others when asked for.

    Attributes:
        path: The file.
        selection: Which of its meshes are checked.
        stage: The open ``Usd.Stage``.
        files: The files that it is read from.
        times: Time codes between which motion is straight, ascending, at least two.
        time_codes_per_second: How many time codes make a second.
        meters_per_unit: How many metres make the scene's unit of length.
        up_axis: "Y" or "Z".
        dtype: Of the positions, float32 or float64.
        names: Of all meshes that are checked at some time.
        display_names: What the file says to show instead, by name, empty if nothing.
        comments: What the file says of itself, pairs of a title and a text.
        vertex_count: Number of vertices of the first segment, welded.
        face_count: Number of triangles of the first segment.
        turning: How many of them transforms or skeletons move, which is not straight between samples.
    """

    def __init__(self, path, *, selection: Selection | None = None, frames: FrameRange | None = None, subdivide=1):
        """Opens the file and finds its meshes.

        Args:
            path: A ``.usd``, ``.usda``, ``.usdc`` or ``.usdz`` file.
            selection: Which of its meshes are checked; default: those to be rendered.
            frames: The part of its time; default: all.
            subdivide: Into how many intervals each one between samples is divided.

        Raises:
            FileNotFoundError: If there is no such file.
            ValueError: If the file is not USD, refers to something that cannot be opened, has no mesh or none that
                moves, or a selection selects nothing. The message names the file, the prim and the time.
        """
        from pxr import UsdGeom  # noqa: PLC0415 (slow)

        from . import usd_meshes, usd_stage  # noqa: PLC0415 (import pxr)

        self.path = str(path)
        self.selection = selection or Selection()
        self.stage = usd_stage.open_stage(path)  # prims expire with their stage
        self.files = SceneFiles(self.stage)
        self._usd_meshes, self._warnings = usd_meshes.find_meshes(self.stage, path, self.selection)
        if not self._usd_meshes:
            raise ValueError(f"{path}: no visible mesh in the scene" + (", or none is selected" * bool(selection)))
        self.time_codes_per_second = self.stage.GetTimeCodesPerSecond()
        self.meters_per_unit = float(self.stage.GetMetadata("metersPerUnit"))  # some programs write it as a float
        self.up_axis = str(UsdGeom.GetStageUpAxis(self.stage))
        self.names = [mesh.name for mesh in self._usd_meshes]
        self.display_names = {mesh.name: mesh.display_name for mesh in self._usd_meshes}
        texts = {"Comment": "comment", "Documentation": "documentation"}
        self.comments = [(title, text) for title, key in texts.items() if (text := self.stage.GetMetadata(key))]
        self.turning = sum(mesh.turns for mesh in self._usd_meshes)
        self.dtype = np.dtype(np.float32 if all(mesh.is_placed for mesh in self._usd_meshes) else np.float64)

        if not any(mesh.times for mesh in self._usd_meshes):
            raise ValueError(f"{path}: nothing moves: no mesh has points or a transform that change with time")
        changes = {time for mesh in self._usd_meshes for time in mesh.states if time != -math.inf}
        samples = sorted(changes.union(*(mesh.times for mesh in self._usd_meshes)))
        self.times = frames.times(samples, changes) if frames else samples
        if skipped := sum(self.times[0] < time < self.times[-1] for time in set(samples) - set(self.times)):
            self._warnings.append(f"--frames steps over {skipped} time samples: motion is straight from step to step")
        if subdivide > 1:
            self.times = [
                start + (end - start) * part / subdivide
                for start, end in pairwise(self.times)
                for part in range(subdivide)
            ] + self.times[-1:]
        self._note_changes()
        inner = [index for index, time in enumerate(self.times[:-1]) if index and time in changes]
        self._spans = list(pairwise([0, *inner, len(self.times) - 1]))
        self._segment, self._span = None, None
        self._welded = 0
        segment = self._segment_at(0)
        self.vertex_count, self.face_count = segment.vertex_count, len(segment.faces)

    @property
    def warnings(self) -> list[str]:
        """What is passed over or changed, a sentence each; of what jumps, what has been read so far."""
        warnings = list(self._warnings)
        for mesh in self._usd_meshes:
            if mesh.jump_times:
                at = _times_in_words(sorted(mesh.jump_times))
                warnings.append(f"{mesh.name} holds its place and jumps {at}: what it jumps through is not checked")
        if self._welded:
            warnings.append(f"vertices in one place at all times were welded: {self._welded}")
        return warnings

    def interval(self, index: int) -> tuple[Segment, np.ndarray, np.ndarray]:
        """The motion from one time to the next.

        Args:
            index: Of the time in :attr:`times`.

        Returns:
            The meshes that are there, and the positions of their vertices at the start and at the end, in the scene's
            unit of length, shape [vertex_count, 3].

        Raises:
            ValueError: If a mesh is broken, or a coordinate is not finite.
        """
        segment = self._segment_at(index)
        start, end = self.times[index : index + 2]
        return segment, segment.positions(start), segment.positions(end, before=True)

    def _segment_at(self, index) -> Segment:
        """The segment of an interval: the last one, if it is of that."""
        if self._span is None or not self._span[0] <= index < self._span[1]:
            self._span = next(span for span in self._spans if span[0] <= index < span[1])
            start, stop = self._span
            present = [mesh for mesh in self._usd_meshes if _state_at(mesh, self.times[start]) is not None]
            self._segment = None  # before the next is read, for the sake of memory
            self._segment = Segment(present, self.times[start : stop + 1], self.dtype)
            self._welded = max(self._welded, self._segment.welded)
        return self._segment

    def _note_changes(self):
        for mesh in self._usd_meshes:
            times_of = {}
            for (_, old), (time, new) in pairwise(mesh.states.items()):
                if self.times[0] < time <= self.times[-1]:
                    what = "appears" if old is None else "vanishes" if new is None else "changes its topology"
                    times_of.setdefault(what, []).append(time)
            for what, times in times_of.items():
                at = _times_in_words(times)
                self._warnings.append(f"{mesh.name} {what} {at}: its motion is split there, a jump is not checked")


def _times_in_words(times) -> str:
    return f"at time {times[0]:g}" if len(times) == 1 else f"{len(times)} times, first at time {times[0]:g}"


def _state_at(mesh, time):
    """What a mesh is at a time, see :attr:`UsdMesh.states`."""
    return next(state for since, state in reversed(mesh.states.items()) if since <= time)
