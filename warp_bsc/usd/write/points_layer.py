"""Writes a layer over a scene that gives meshes other points, with the normals, extents and velocities of these."""

import os
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from ..._atomic_file import OutputFile
from ..scene import Scene
from ..segment import Segment
from .layer import SceneLayer, just_before

if TYPE_CHECKING:
    from ..read.meshes import UsdMesh  # which imports pxr


@dataclass(frozen=True)
class MovedFrame:
    """The vertices that are moved at one time.

    Attributes:
        time: Time code.
        before: Whether the moment just before that time is meant, at which a mesh then jumps or a segment ends.
        segment: The meshes.
        vertices: The moved vertices, shape [n]; after those of the segment, the ones of its tetrahedra inside surfaces.
        x: Their positions in world space, float64, shape [n, 3].
    """

    time: float
    before: bool
    segment: Segment = field(repr=False)
    vertices: np.ndarray = field(repr=False)
    x: np.ndarray = field(repr=False)

    def by_mesh(self) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
        """Yields the number of each mesh with moved vertices, these among its prim's points, and their positions."""
        count, tetrahedra = self.segment.vertex_count, self.segment.tetrahedra
        rows = np.full(count + tetrahedra.vertex_count, -1)
        rows[self.vertices] = np.arange(len(self.vertices))
        for number, mesh in enumerate(self.segment.meshes):
            own, points = rows[self.segment.vertices_of(number)], mesh.points
            if mesh.name in tetrahedra.points:
                numbers, inner = tetrahedra.points[mesh.name]
                own, points = np.append(own, rows[count:][numbers]), np.append(points, inner)
            if (own >= 0).any():
                yield number, points[own >= 0], self.x[own[own >= 0]]


class PointsLayer:
    """A layer whose sublayer is the scene, so that opening it shows the scene with the moved points.

    A moved mesh has a sample of its points at each time of the scene and of its own; one that has no samples has none
    here either, but other points. Points that are not moved have the bits of the scene. Meshes that are not moved at
    any time have no opinion in the layer. A skeleton or blend shapes no longer deform a moved mesh: its points are
    those that they would give it. Authored normals turn with the surface, authored extents are computed again where
    points move, authored velocities get the velocity of the displacement, and authored accelerations are blocked.

    Attributes:
        file: The file.
        end: Last time code of a partial layer; None writes all times.
    """

    def __init__(self, path: str | os.PathLike, *, scene: Scene):
        """Opens the file.

        Args:
            path: The file, with a name that ends in ``.usda``, ``.usdc`` or ``.usd``.
            scene: The scene.

        Raises:
            OSError: If the file cannot be written.
            ValueError: If its name has another suffix, or the scene has no file.
        """
        self._scene, self._layer = scene, SceneLayer(path, scene, "a layer of USD")
        self._moved: dict[str, dict[tuple[float, bool], tuple[int, int]]] = {}  # by name: places in the file, numbers
        self.end: float | None = None
        self.file = OutputFile(path)
        self._moves = tempfile.TemporaryFile(buffering=0, dir=self.file.folder)  # noqa: SIM115 (closed by discard)

    def add(self, frame: MovedFrame) -> None:
        """Adds the moved vertices of one time.

        Raises:
            OSError: If the disk is full.
        """
        for number, points, positions in frame.by_mesh():
            name = frame.segment.meshes[number].name
            x = to_own_space(self._scene.prim_of(name), positions, frame.time, frame.before)
            self._moved.setdefault(name, {})[frame.time, frame.before] = self._moves.tell(), len(points)
            rest = memoryview(points.astype(np.int64).tobytes() + x.tobytes())
            while rest:
                rest = rest[self._moves.write(rest) :]

    def finish(self, facts: dict[str, Any]) -> None:
        """Writes the layer and moves it to its path.

        Args:
            facts: What was done, for programs.

        Raises:
            OSError: If the file cannot be written.
            ValueError: If the scene cannot be read again.
        """
        documentation = "Points moved by warp-bsc repair, so that meshes do not collide."
        if self.end is not None:
            documentation += f" Partial: it ends at time {self.end:g}."
        custom = {"repair": facts | {"complete": self.end is None}}
        with self._layer.writing(self.file, documentation, custom, self.end) as (layer, add):
            for name in self._moved:
                self._write_mesh(layer, name, add)

    def shrink(self) -> bool:
        """Drops the last eighth of the times, and returns whether the layer becomes shorter."""
        times = [time for time in self._scene.times if self.end is None or time <= self.end]
        if len(times) < 2 or not self._moved:
            return False
        self.end = times[-1 - max(1, len(times) // 8)]
        return True

    def discard(self) -> None:
        """Removes the temporary files."""
        self._moves.close()
        self.file.discard()

    def _write_mesh(self, layer, name, add) -> None:
        """Writes the samples of one mesh by ``add``."""
        from pxr import Sdf  # noqa: PLC0415 (slow)

        mesh = self._scene.prim_of(name)
        spec = Sdf.CreatePrimInLayer(layer, mesh.path)
        surface = _Surface(mesh)
        if mesh.is_skinned:
            skeleton = Sdf.RelationshipSpec(spec, "skel:skeleton", False)
            skeleton.targetPathList.ClearEditsAndMakeExplicit()
        if mesh.prim.GetAttribute("accelerations").HasAuthoredValue():
            blocked = Sdf.AttributeSpec(spec, "accelerations", Sdf.ValueTypeNames.Vector3fArray)
            blocked.default = Sdf.ValueBlock()
        frames = [(*key, *self._points(mesh, *key)) for key in self._times(mesh)]
        for index, (time, before, old, new) in enumerate(frames):
            code = None if not mesh.times else just_before(time) if before else time
            following = frames[index + 1] if index + 1 < len(frames) else None
            if following is not None and following[0] > time and len(following[2]) == len(old):
                seconds = (following[0] - time) / self._scene.time_codes_per_second
                added = ((following[3] - following[2]) - (new - old)) / seconds
            else:
                added = np.zeros_like(new)
            for attribute, kind, value in surface.samples(old, new, added, time):
                if not spec.attributes.get(attribute):
                    Sdf.AttributeSpec(spec, attribute, Sdf.ValueTypeNames.Find(kind))
                add(f"{mesh.path}.{attribute}", kind, code, value)

    def _times(self, mesh: "UsdMesh") -> list[tuple[float, bool]]:
        """Returns the times at which a mesh gets points, and whether the moment just before each is meant."""
        keys = []
        for time in sorted(mesh.times | set(self._scene.times)):
            if self.end is not None and time > self.end:
                break
            jumps = mesh.may_jump or (time, True) in self._moved[mesh.name]
            before = max((since for since in mesh.states if since < time), default=None)
            if jumps and keys and before is not None and mesh.states[before] is not None:
                keys.append((time, True))
            if mesh.state_at(time) is not None:
                keys.append((time, False))
        return keys

    def _points(self, mesh, time, before) -> tuple[np.ndarray, np.ndarray]:
        """Returns the points of a mesh in the scene and in the layer, shapes [point_count, 3]."""
        old = _own_points(mesh, time, before)
        if (time, before) not in self._moved[mesh.name]:
            return old, old
        new, (place, count) = old.copy(), self._moved[mesh.name][time, before]
        self._moves.seek(place)
        points = np.frombuffer(self._moves.read(8 * count), np.int64)
        new[points] = np.frombuffer(self._moves.read(12 * count), np.float32).reshape(-1, 3)
        self._moves.seek(0, os.SEEK_END)
        return old, new


class _Surface:
    """What is authored on a mesh beside its points, for other points."""

    def __init__(self, mesh: "UsdMesh"):
        from pxr import UsdGeom  # noqa: PLC0415 (slow)

        self._mesh, self._schema = mesh, UsdGeom.Mesh(mesh.prim)
        primvar = UsdGeom.PrimvarsAPI(mesh.prim).GetPrimvar("normals")
        has_primvar = primvar and primvar.HasAuthoredValue() and not primvar.IsIndexed()
        self._normals = primvar.GetAttr() if has_primvar else self._schema.GetNormalsAttr()
        self._interpolation = primvar.GetInterpolation() if has_primvar else self._schema.GetNormalsInterpolation()
        self._velocities = self._schema.GetVelocitiesAttr()
        self._extent = self._schema.GetExtentAttr()

    def samples(self, old, new, added, time) -> Iterator[tuple[str, str, np.ndarray]]:
        """Yields names, types and values of the attributes at a time.

        ``old`` and ``new`` are the points in the scene and in the layer, shape [point_count, 3]; ``added`` are the
        velocities of the displacement, in a unit a second.
        """
        yield "points", "point3f[]", new
        if self._extent.HasAuthoredValue():
            same = new is old and self._extent.Get(time) is not None
            box = np.array(self._extent.Get(time)) if same else np.stack([new.min(axis=0), new.max(axis=0)])
            yield "extent", "float3[]", box
        if self._velocities.HasAuthoredValue():
            velocities = np.array(self._velocities.Get(time))
            if len(velocities) == len(new):
                yield "velocities", "vector3f[]", velocities + added
        if self._normals.HasAuthoredValue():
            normals = np.array(self._normals.Get(time))
            turned = normals if new is old else self._turn(normals, old, new, time)
            yield self._normals.GetName(), "normal3f[]", turned

    def _turn(self, normals, old, new, time) -> np.ndarray:
        """Returns authored normals turned with the surface; those of a constant or of another number stay."""
        if self._mesh.has_tetrahedra:
            corners = self._mesh.read_triangles(time, old)[0].ravel()
            counts = np.full(len(corners) // 3, 3)
        else:
            counts = np.array(self._schema.GetFaceVertexCountsAttr().Get(time))
            corners = np.array(self._schema.GetFaceVertexIndicesAttr().Get(time))
        (a_faces, a_points), (b_faces, b_points) = (_normals_of(x, counts, corners) for x in (old, new))
        both = {"uniform": (a_faces, b_faces), "faceVarying": (a_points[corners], b_points[corners])}
        both |= dict.fromkeys(("vertex", "varying"), (a_points, b_points))
        a, b = both.get(str(self._interpolation), (normals, normals))
        if len(a) != len(normals):
            return normals
        changed = (a != b).any(axis=1)
        across, along = np.cross(a, b), (a * b).sum(axis=1, keepdims=True)
        once = np.cross(across, normals)
        turned = normals * 1.0 + once + np.cross(across, once) / np.maximum(1.0 + along, 1e-6)
        return np.where(changed[:, None], turned, normals)


def _own_points(mesh: "UsdMesh", time: float, before: bool) -> np.ndarray:
    """Returns the points of a mesh at, or just before, a time in its prim's space, also if a skeleton deforms them.

    Those that nothing deforms have the bits of the file.
    """
    points = mesh.read_points(time, before=before)
    if not mesh.has_skeleton:
        return points
    transform = mesh.read_transform(time, before=before)
    assert transform is not None  # no instancer places it
    return to_own_space(mesh, points @ transform[:3, :3] + transform[3, :3], time, before)


def to_own_space(mesh: "UsdMesh", positions: np.ndarray, time: float, before: bool) -> np.ndarray:
    """Returns positions in world space at, or just before, a time in the space of a mesh's prim, float32."""
    from pxr import UsdGeom  # noqa: PLC0415 (slow)

    if mesh.is_placed:
        return positions.astype(np.float32)
    code = mesh.time_code(time, before)
    inverse = np.linalg.inv(np.array(UsdGeom.Imageable(mesh.prim).ComputeLocalToWorldTransform(code)))
    return (positions @ inverse[:3, :3] + inverse[3, :3]).astype(np.float32)


def _normals_of(x, counts, corners) -> tuple[np.ndarray, np.ndarray]:
    """Returns the unit normals of polygons and of points."""
    x = x.astype(np.float64)
    faces = np.repeat(np.arange(len(counts)), counts)
    last = np.cumsum(counts) - 1
    following = np.arange(len(corners)) + 1
    following[last] = last - counts + 1
    crossed = np.cross(x[corners], x[corners[following]])
    of_faces = np.stack([np.bincount(faces, crossed[:, axis], len(counts)) for axis in range(3)], axis=1)
    spread = of_faces[faces]
    of_points = np.stack([np.bincount(corners, spread[:, axis], len(x)) for axis in range(3)], axis=1)
    return _unit(of_faces), _unit(of_points)


def _unit(vectors) -> np.ndarray:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0)
