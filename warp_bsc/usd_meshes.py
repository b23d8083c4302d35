"""Finds the meshes of a USD stage and reads one at a time. Imports pxr: to be imported where it is used."""

import hashlib
import math
from collections import Counter

import numpy as np
from pxr import Usd, UsdGeom, UsdSkel

from .triangulation import triangulate
from .usd_instancers import Instance, find_instances, is_shown, transform_times, visibility_times
from .usd_skinning import Skin, find_skins
from .usd_stage import as_time_code, sample_times

__all__ = ["UsdMesh", "find_meshes"]


def find_meshes(stage, file, selection) -> tuple[list["UsdMesh"], list[str]]:
    """The meshes of a stage that are selected and visible at some time, and a sentence on each kind of thing left out.

    Args:
        stage: The stage.
        file: Its file, for messages.
        selection: What is checked.

    Raises:
        ValueError: If a point instancer is broken, or a pattern of the selection matches nothing.
    """
    finder = _Finder(file)
    finder.walk(iter(Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies())), None)
    selection.check_patterns([mesh.path for mesh in finder.meshes])

    meshes, invisible, passed_over, warnings = [], [], Counter(), finder.warnings
    for mesh in finder.meshes:
        if not selection.includes(mesh.path):
            continue
        if mesh.purpose not in selection.purposes:
            passed_over[mesh.purpose] += 1
        elif not any(mesh.states.values()):
            invisible.append(mesh.name)
        else:
            meshes.append(mesh)
    if invisible:
        warnings.append(f"invisible prims are not checked: {len(invisible)}, the first is {invisible[0]}")
    for purpose, count in sorted(passed_over.items()):
        warnings.append(f"meshes of purpose {purpose} are not checked: {count}; --purpose {purpose} checks them")
    if finder.other:
        shapes = ", ".join(f"{count} {name}" for name, count in sorted(finder.other.items()))
        warnings.append(f"shapes that are not meshes are not checked: {shapes}")
    return meshes, warnings


class _Finder:
    """Walks a stage, and into the prototypes of point instancers once for each instance."""

    def __init__(self, file):
        self._file = file
        self._skins = {}
        self.meshes = []
        self.other = Counter()
        self.warnings = []

    def walk(self, prims, instance):
        for prim in prims:
            if prim.IsA(UsdGeom.PointInstancer):
                # Meshes below are its prototypes: they are not where they stand in the hierarchy.
                prims.PruneChildren()
                for inner in find_instances(prim, instance, self._file):
                    self.walk(inner.prims(), inner)
            elif prim.IsA(UsdSkel.Root):
                if prim.GetPath() not in self._skins:
                    self._skins[prim.GetPath()] = None
                    self._skins.update(find_skins(prim, self._file))
            elif prim.IsA(UsdGeom.Mesh):
                skin = self._skins.get(prim.GetPath())
                if skin is None and UsdSkel.BindingAPI(prim).GetInheritedSkeleton():
                    self.warnings.append(f"{prim.GetPath()} is bound to a skeleton in a way that USD does not evaluate")
                self.meshes.append(UsdMesh(prim, self._file, instance=instance, skin=skin))
            elif prim.IsA(UsdGeom.Gprim) and is_shown(prim, None, Usd.TimeCode.EarliestTime()):
                self.other[prim.GetTypeName()] += 1


class UsdMesh:
    """A mesh prim, or one instance of it.

    Attributes:
        path: The prim's path.
        name: The same, with the number of the instance if a point instancer places it.
        display_name: What the file says to show instead, empty if nothing.
        purpose: One of :data:`warp_bsc.selection.PURPOSES`.
        times: Time codes at which its points or its transform to the world have a sample; empty if it does not move.
        states: What it is at first, at minus infinity, and from each time on at which that changes: None where it is
            invisible, not there or empty, else bytes that are others for another topology.
        turns: Whether a transform or a skeleton moves it, which is not linear between the samples.
        jump_times: Time codes at which its transform was found to be held, and to jump there.
        is_placed: Whether its points are in world space as they are: its transform is the identity at all times.
    """

    def __init__(self, prim, file, *, instance: Instance | None, skin: Skin | None):
        self.path = str(prim.GetPath())
        self.name = instance.name_of(prim.GetPath()) if instance else self.path
        self.display_name = prim.GetDisplayName()
        self._where = f"{file}: {self.name}"
        self._mesh = UsdGeom.Mesh(prim)
        self._instance = instance
        self._skin = skin
        self._root = instance.root if instance else None
        self.purpose = str(self._mesh.ComputePurpose())
        # Joints move points to the space of their skeleton.
        self._frame = skin.skeleton if skin and skin.skeleton else prim

        mesh = self._mesh
        breaks = visibility_times(prim, self._root) | sample_times(
            mesh.GetFaceVertexCountsAttr(), mesh.GetFaceVertexIndicesAttr(), mesh.GetHoleIndicesAttr()
        )
        self.states = self._find_states(breaks | (instance.break_times if instance else set()))
        self.times = sample_times(mesh.GetPointsAttr()) | (skin.times if skin else set())
        self.jump_times = set()
        self.turns = bool(skin and skin.times)
        times = transform_times(self._frame, self._root) | (instance.times if instance else set())
        codes = [Usd.TimeCode.EarliestTime(), *map(Usd.TimeCode, sorted(times))]
        # None where an instance is not there.
        transforms = (transform for code in codes if (transform := self._find_transform(code)) is not None)
        first = next(transforms, np.eye(4))
        self.is_placed = np.array_equal(first, np.eye(4))
        # Some writers sample a transform at every time that never changes.
        if any(not np.array_equal(transform, first) for transform in transforms):
            self.times |= times
            self.turns = True
            self.is_placed = False

    def read_points(self, time: float, *, before: bool = False) -> np.ndarray:
        """The points as they are stored, or as a skeleton moves them, shape [point_count, 3].

        Args:
            time: Time code.
            before: Whether the moment before it is meant, where something jumps at that time.

        Raises:
            ValueError: If there are none.
        """
        code = as_time_code(time, before=before)
        # Elsewhere another number of points is an error, which the moment before would hide.
        points = self._mesh.GetPointsAttr().Get(code if time in self.states else Usd.TimeCode(time))
        if not points:
            raise ValueError(f"{self._where}: the mesh has no points at time {time:g}")
        if self._skin:
            self._skin.deform(points, code)
        return np.array(points)

    def read_positions(
        self, time: float, *, before: bool = False, used: np.ndarray, point_count: int, dtype: np.dtype
    ) -> np.ndarray:
        """Positions in world space of some of the points.

        Args:
            time: Time code.
            before: Whether the moment before it is meant, where something jumps at that time.
            used: The points, shape [count].
            point_count: How many points the mesh must have in all.
            dtype: float32 only if :attr:`is_placed`, else float64.

        Returns:
            Positions, shape [count, 3].

        Raises:
            ValueError: If the number of points is another, or a position is not finite.
        """
        points = self.read_points(time, before=before)
        if len(points) != point_count:
            raise ValueError(f"{self._where}: {len(points)} points at time {time:g}, but {point_count} at first")
        positions = points[used].astype(dtype)
        if not self.is_placed:
            transform = self._transform(as_time_code(time, before=before))
            if before and time not in self.states:
                if not np.array_equal(transform, self._transform(Usd.TimeCode(time))):
                    self.jump_times.add(time)
            with np.errstate(over="ignore", invalid="ignore"):  # raised below
                positions = positions @ transform[:3, :3] + transform[3, :3]
        finite = np.isfinite(positions).all(axis=1)
        if not finite.all():
            first = int(np.argmin(finite))
            raise ValueError(
                f"{self._where}: vertex {used[first]} is not finite at time {time:g}: {positions[first].tolist()}"
            )
        return positions

    def read_triangles(self, time: float, points) -> tuple[np.ndarray, np.ndarray, int]:
        """The polygons that are no holes, as triangles that turn to the left seen from outside.

        Args:
            time: Time code.
            points: The points at the time that says which polygons are concave, shape [point_count, 3].

        Returns:
            The triangles' points, shape [triangle_count, 3], the polygon that each is a part of, shape
            [triangle_count], and the number of polygons, holes included.

        Raises:
            ValueError: If the faces are broken, or none.
        """
        counts, indices, holes = self._read_topology(Usd.TimeCode(time))
        if counts.size == 0:
            raise ValueError(f"{self._where}: the mesh has no faces")
        if counts.min() < 3:
            face = int(np.argmin(counts))
            raise ValueError(f"{self._where}: face {face} has {counts[face]} vertices; 3 are the fewest")
        if counts.sum() != indices.size:
            raise ValueError(
                f"{self._where}: faceVertexCounts add up to {counts.sum()}, "
                f"but there are {indices.size} faceVertexIndices"
            )
        outside = (indices < 0) | (indices >= len(points))
        if outside.any():
            corner = int(np.argmax(outside))
            face = int(np.searchsorted(np.cumsum(counts), corner, side="right"))
            raise ValueError(
                f"{self._where}: face {face} refers to vertex {indices[corner]}, but the mesh has {len(points)} points"
            )

        triangles, polygons = triangulate(counts, indices, points)
        solid = ~np.isin(polygons, holes)
        if not solid.any():
            raise ValueError(f"{self._where}: all faces of the mesh are holes")
        is_left_handed = self._mesh.GetOrientationAttr().Get() == UsdGeom.Tokens.leftHanded
        is_mirrored = np.linalg.det(self._transform(Usd.TimeCode(time))[:3, :3]) < 0
        if is_left_handed != is_mirrored:
            triangles = triangles[:, ::-1]
        return triangles[solid], polygons[solid], len(counts)

    def _transform(self, time) -> np.ndarray:
        """The matrix that takes points, as rows, to world space, shape [4, 4]."""
        transform = self._find_transform(time)
        if transform is None:
            raise ValueError(f"{self._where}: its instancer has no valid transform for it at time {time.GetValue():g}")
        return transform

    def _find_transform(self, time) -> np.ndarray | None:
        if not self._instance:
            return np.array(UsdGeom.Imageable(self._frame).ComputeLocalToWorldTransform(time))
        transform = self._instance.transform(self._frame, time)
        return None if transform is None else np.array(transform)

    def _read_topology(self, time) -> list[np.ndarray]:
        """Counts, indices and holes at a time."""
        mesh = self._mesh
        attributes = mesh.GetFaceVertexCountsAttr(), mesh.GetFaceVertexIndicesAttr(), mesh.GetHoleIndicesAttr()
        values = [attribute.Get(time) for attribute in attributes]
        return [np.array(value if value is not None else (), dtype=np.int64) for value in values]

    def _find_states(self, times) -> dict[float, bytes | None]:
        states, last = {}, b""
        for time in [-math.inf, *sorted(times)]:
            code = Usd.TimeCode.EarliestTime() if time == -math.inf else Usd.TimeCode(time)
            state = self._topology_digest(code) if self._is_present(code) else None
            if state != last:
                states[time] = last = state
        return states

    def _is_present(self, time) -> bool:
        """Whether the mesh is there, visible and not empty."""
        if not is_shown(self._mesh.GetPrim(), self._root, time):
            return False
        if self._instance and not self._instance.is_present(time):
            return False
        # As where a fluid has not begun to flow.
        values = [
            attribute.Get(time) for attribute in (self._mesh.GetPointsAttr(), self._mesh.GetFaceVertexCountsAttr())
        ]
        return not all(value is not None and len(value) == 0 for value in values)

    def _topology_digest(self, time) -> bytes:
        digest = hashlib.blake2b()
        for values in self._read_topology(time):
            digest.update(len(values).to_bytes(8, "little") + values.tobytes())
        return digest.digest()
