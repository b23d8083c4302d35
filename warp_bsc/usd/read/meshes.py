"""Reads a mesh of a USD stage, or curves or points of a prim. Imports pxr, which is slow: import this where used."""

# pyright: reportAttributeAccessIssue=false
# (OpenUSD's stubs leave out the classes of its modules.)

import bisect
import copy
import math
import os
from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from pxr import Usd, UsdGeom

from .instancers import (
    Instance,
    are_finite,
    is_shown,
    masking_attributes,
    transform_attributes,
    transform_ops,
    transform_times,
    visibility_times,
)
from .mesh_prims import MeshPrim
from .samples import as_time_code, may_jump, sample_times
from .shapes import MeshPolygons, Polygons, ShapePolygons, is_shape
from .skinning import Skin
from .strands import Strands, is_strands
from .topology import BROKEN, Topology, as_topology, is_empty
from .unreadable import UnreadableError, reading

__all__ = ["UsdMesh"]

_BETWEEN = 0.382  # where between two samples transforms are tested for bends; halfway, two whole turns look like none
_MOST_TIMES = 1_000_000
_ROUNDING = 1e-6  # of transforms that USD interpolates in single precision

_States = dict[float, tuple[bytes, bytes] | None]


class UsdMesh:
    """A mesh prim, or one instance of it.

    Attributes:
        path: The prim's path.
        name: The path, with the number of the instance if a point instancer places it.
        group: The same value for all instances of a prim that one instancer places; empty without an instancer.
        display_name: Display name in the file, empty if there is none.
        type_name: Type of the prim.
        is_shape: Whether it is a shape, see :class:`~warp_bsc.usd.read.shapes.ShapePolygons`.
        is_strands: Whether it is curves or points, see :class:`~warp_bsc.usd.read.strands.Strands`.
        times: Time codes at which its points or its transform to the world have a sample; empty if it does not move.
        states: Its states by the time from which on they hold, the first by minus infinity: None where it is invisible,
            absent or empty, else digests of its topology.
        turns: Whether a transform or a skeleton moves it, so that it may move nonlinearly between the samples.
        deforms: Whether anything except its transform moves it.
        may_jump: Whether its positions just before a time may differ from those at that time.
        is_placed: Whether its transform is the identity at all times, so that its points are in world space.
        is_empty: Whether it has no faces, and no edges or points, at any time.
        is_nowhere: Whether its transform is not finite at any time.
    """

    def __init__(self, found: MeshPrim, file: str | os.PathLike):
        """Finds the times at which a mesh changes and moves.

        Args:
            found: The prim, or the instance.
            file: Its file, for messages.

        Raises:
            UnreadableError: If the value of an attribute is invalid.
        """
        prim, instance = found.prim, found.instance
        self._file = file
        self.path = found.path
        self.display_name = prim.GetDisplayName()
        self.type_name = str(prim.GetTypeName())
        self.is_shape = is_shape(prim)
        self._prim = prim
        self._strands = Strands(prim) if is_strands(prim) else None
        self.is_strands = self._strands is not None
        shaped = ShapePolygons if self.is_shape else MeshPolygons
        self._polygons: Polygons = self._strands or shaped(prim)
        self._skin = skin = Skin(*found.binding, where=f"{file}: {self.path}") if found.binding else None
        self._root = instance.root if instance else None
        # Joints move points to the space of their skeleton.
        self._frame = skin.skeleton if skin and skin.skeleton else prim
        self._masking = () if instance else masking_attributes(self._frame)
        self._where = f"{file}: {found.name}"
        instancer = instance.instancer if instance else None
        self.group = (id(instancer), self.path) if instancer else ()
        self._last_points: dict[tuple, np.ndarray] = {}  # these two are shared by all instances
        self._last_triangles: dict[tuple, tuple[np.ndarray, np.ndarray, int]] = {}

        breaks = visibility_times(prim, self._root) | sample_times(*self._polygons.topology_attributes)
        if instancer:
            breaks |= instancer.break_times
        self._breaks = (-math.inf, *sorted(breaks))
        self._break_codes = tuple(
            Usd.TimeCode.EarliestTime() if time == -math.inf else Usd.TimeCode(time) for time in self._breaks
        )
        self._topologies = self._read_topologies()
        self.is_empty = not any(self._topologies)
        self._states = [
            topology if topology and is_shown(prim, self._root, code) else None
            for code, topology in zip(self._break_codes, self._topologies, strict=True)
        ]
        # Points that are renumbered do not move to those of their number.
        are_renumbered = len({polygons for polygons, _ in filter(None, self._topologies)}) > 1
        has_numbers = not self._strands or self._strands.has_edges  # points without edges have ids
        self._numbered_times = sorted(sample_times(*self._polygons.point_attributes)) * (are_renumbered and has_numbers)
        self._deformed_times = frozenset(
            sample_times(*self._polygons.point_attributes) | (skin.times if skin else set())
        )
        self.deforms = bool(self._deformed_times)
        self.may_jump = (
            may_jump(transform_attributes(self._frame, self._root))
            or self._polygons.may_jump
            or bool(instancer and instancer.may_jump)
            or bool(skin and skin.may_jump)
        )

        self._transform_times = sorted(
            transform_times(self._frame, self._root) | (instancer.times if instancer else set())
        )
        # Between samples as well, because a whole turn ends where it began.
        between = [start + _BETWEEN * (end - start) for start, end in pairwise(self._transform_times)]
        codes = [Usd.TimeCode.EarliestTime(), *map(Usd.TimeCode, sorted([*self._transform_times, *between]))]
        first, were_there = (values.copy() for values in self._read_transforms(instance, codes[0]))
        # Some writers sample a transform at every time although it never changes.
        self._moved = np.zeros(len(first), dtype=bool)
        for code in codes[1:]:
            transforms, are_there = self._read_transforms(instance, code)
            differs = (transforms != first) & ~(np.isnan(transforms) & np.isnan(first))
            self._moved |= are_there & were_there & differs.any(axis=(1, 2))
            appears = are_there & ~were_there
            first[appears] = transforms[appears]
            were_there |= are_there
            if (self._moved & were_there).all():
                break
        self._stays: np.ndarray = (first == np.eye(4)).all(axis=(1, 2))
        self._is_finite: np.ndarray = np.isfinite(first).all(axis=(1, 2))
        self._bent: dict[tuple[float, float], np.ndarray] = {}
        self._set_instance(found)

    def again(self, found: MeshPrim) -> "UsdMesh":
        """Returns another instance of the same prim, placed by the same instancer."""
        mesh = copy.copy(self)
        mesh._set_instance(found)
        return mesh

    def _set_instance(self, found: MeshPrim) -> None:
        """Sets what differs between instances."""
        self.name = found.name
        self._where = f"{self._file}: {self.name}"
        self._instance = instance = found.instance
        self._whole: _States = {}  # its states before parts are left out, if any are
        self._own_times = {}  # by time of the scene: the first and the last of the mesh's times that it stands for
        states = self._states
        if instance:
            present = instance.are_present(self._break_codes)
            states = [state if here else None for state, here in zip(states, present.tolist(), strict=True)]
        self.states: _States = {}
        last = b"", b""
        for time, state in zip(self._breaks, states, strict=True):
            if state != last:
                self.states[time] = last = state
        self.is_placed = bool(self._stays[self.index]) and not self._moved[self.index]
        self.is_nowhere = not (self._is_finite[self.index] or self._moved[self.index])
        self._placed_times = self._transform_times if self._moved[self.index] else []
        self.times = self._deformed_times | set(self._placed_times)
        self.turns = bool(self._placed_times) or bool(self._skin and self._skin.times)

    @property
    def may_thicken(self) -> bool:
        """Whether the radii of curves or points may change."""
        return self._strands is not None and (
            self._strands.width_attribute.ValueMightBeTimeVarying()
            or float(np.ptp(self._scales(self._placed_times))) > 0
        )

    def turning_times(self, start: float, end: float) -> set[float]:
        """Returns the whole time codes between samples at which the mesh is not on the straight path between them.

        Args:
            start: Time code after which they are.
            end: Time code before which they are.

        Raises:
            ValueError: If there are more than a million.
        """
        gaps = [(*gap, True) for gap in pairwise(sorted(self._skin.times))] if self._skin else []
        gaps += [(*gap, False) for gap in pairwise(self._placed_times)]
        times = set()
        for first, last, bends in gaps:
            low, high = math.floor(max(first, start)) + 1, math.ceil(min(last, end)) - 1
            if high - low >= _MOST_TIMES - len(times):
                raise ValueError(
                    f"frames: {self._where} turns from time {first:g} to {last:g} and is sampled at every whole time "
                    "code, more than a million; a step takes fewer"
                )
            if low <= high and (bends or self._bends(first, last)):
                times.update(map(float, range(low, high + 1)))
        return times

    def take_times(self, scene_times: dict[float, float]) -> None:
        """Replaces the mesh's times by the scene's, which stand for several times that differ by rounding.

        The moment before such a time is read just before the first of the mesh's own times, the time at the last.

        Args:
            scene_times: The scene's time for each time found in any mesh.
        """
        if all(time == merged for time, merged in scene_times.items()):
            return
        for time in sorted({*self.times, *self.states} - {-math.inf}):
            first, _ = self._own_times.get(scene_times[time], (time, time))
            self._own_times[scene_times[time]] = first, time
        self.times = {scene_times[time] for time in self.times}
        self.states = {scene_times.get(time, time): state for time, state in self.states.items()}
        self.may_jump |= any(first != last for first, last in self._own_times.values())

    def state_at(self, time: float) -> tuple[bytes, bytes] | None:
        """Returns its state at a time, see :attr:`states`."""
        return _state_at(self.states, time)

    def changes(self) -> Iterator[tuple[float, str]]:
        """Yields the times at which it changes and, in words, what it does then; without those at which it breaks."""
        for (_, old), (time, new) in pairwise(self.states.items()):
            if BROKEN not in (old, new):
                yield time, "appears" if old is None else "vanishes" if new is None else "changes its topology"

    def can_be_read(self, time: float) -> bool:
        """Returns whether all of it can be read at a time, or it is not there; parts left out before do not matter."""
        if _state_at(self._whole or self.states, time) is None:
            return True
        try:
            points = self.read_points(time)
            triangles, _, _ = self.read_triangles(time, points)
            self.read_strands([time], len(points))
            used = np.arange(len(points)) if self.is_strands else np.unique(triangles)
            self.read_positions(time, used=used, point_count=len(points), dtype=points.dtype)
        except UnreadableError:
            return False
        return True

    def leave_out(self, since: float, until: float) -> None:
        """Removes the mesh from a time, minus infinity for the first, up to before another, infinity for the last."""
        self._whole = self._whole or self.states
        last = {} if until == math.inf else {until: self.state_at(until)}
        kept = {time: state for time, state in self.states.items() if not since <= time <= until}
        self.states = dict(sorted((kept | {since: None} | last).items()))

    @property
    def why_not_written(self) -> str | None:
        """Why a layer over the scene cannot give the mesh points of its own, in words; None if it can."""
        if self._instance:
            return "a point instancer places it"
        if self._prim.IsInstanceProxy():
            return "it is in an instance, which shares its points with others"
        if self.is_shape or self.is_strands:
            return f"a {self.type_name} has no faces of its own"
        return None

    @property
    def why_not_repaired(self) -> str | None:
        """Why a repair does not move the mesh, in words; None if it may."""
        if self.why_not_written or self.deforms:
            return self.why_not_written
        return "its points do not move, only its transform" if self.times else "it does not move"

    @property
    def prim(self) -> Usd.Prim:
        """The prim."""
        return self._prim

    @property
    def is_skinned(self) -> bool:
        """Whether a skeleton or blend shapes deform it."""
        return self._skin is not None

    def read_own_points(self, time: float, *, before: bool = False) -> np.ndarray:
        """Returns the points in the space of the prim itself, also if a skeleton deforms them, shape [point_count, 3].

        Those that nothing deforms have the bits of the file. Arguments and errors are those of :meth:`read_points`.
        """
        points = self.read_points(time, before=before)
        if self._frame is self._prim:
            return points
        transform = self._transform(time, before=before)
        return self.to_own_space(points @ transform[:3, :3] + transform[3, :3], time, before=before)

    def to_own_space(self, positions: np.ndarray, time: float, *, before: bool = False) -> np.ndarray:
        """Returns positions in world space, shape [n, 3], as points of the prim, float32.

        Args:
            positions: The positions.
            time: Time code.
            before: Whether the moment just before that time is meant.
        """
        if self.is_placed:
            return positions.astype(np.float32)
        code = self.time_code(time, before)
        inverse = np.linalg.inv(np.array(UsdGeom.Imageable(self._prim).ComputeLocalToWorldTransform(code)))
        return (positions @ inverse[:3, :3] + inverse[3, :3]).astype(np.float32)

    def read_points(self, time: float, *, before: bool = False) -> np.ndarray:
        """Returns the stored points, or those that a skeleton and blend shapes deform, shape [point_count, 3].

        Args:
            time: Time code.
            before: Whether to read the moment just before that time, which differs where the mesh jumps at it.

        Raises:
            UnreadableError: If there are no points, or the binding to the skeleton is broken.
        """
        with reading(self._where, self.name, time):
            code = self.time_code(time, before)
            key = code.GetValue(), code.IsPreTime(), before and time not in self.states
            if key in self._last_points:
                return self._last_points[key]
            # A number of points that changes without the topology is an error, which the moment before would hide.
            at_time = before and time not in self.states
            points = self._polygons.read_points(self._held(Usd.TimeCode(code.GetValue()) if at_time else code))
            if is_empty(points):
                raise UnreadableError(f"{self._where}: the mesh has no points at time {time:g}")
            if self._skin:
                self._skin.deform(points, code)
            array = np.array(points)
            if array.ndim != 2 or array.shape[1] != 3 or array.dtype.kind != "f":
                raise UnreadableError(f"{self._where}: attribute points holds {type(points).__name__}, not point3f[]")
            if self.group:
                self._last_points.clear()
                self._last_points[key] = array
            return array

    def read_positions(
        self, time: float, *, before: bool = False, used: np.ndarray, point_count: int, dtype: np.dtype
    ) -> np.ndarray:
        """Returns the positions of some points in world space.

        Args:
            time: Time code.
            before: Whether to read the moment just before that time, which differs where the mesh jumps at it.
            used: Indices of the points, shape [count].
            point_count: Number of points that the mesh must have.
            dtype: float32 only if :attr:`is_placed`, else float64.

        Returns:
            Positions, shape [count, 3].

        Raises:
            UnreadableError: If the number of points differs, or a position is not finite.
        """
        positions = self.read_used_points(time, before=before, used=used, point_count=point_count, dtype=dtype)
        with reading(self._where, self.name, time):
            if not self.is_placed:
                transform = self._transform(time, before=before)
                positions = positions @ transform[:3, :3] + transform[3, :3]
            if not np.isfinite(positions).all():
                first = int(np.argmin(np.isfinite(positions).all(axis=1)))
                raise UnreadableError(
                    f"{self._where}: vertex {used[first]} is not finite at time {time:g}: {positions[first].tolist()}"
                )
            return positions

    def read_used_points(
        self, time: float, *, before: bool = False, used: np.ndarray, point_count: int, dtype: np.dtype
    ) -> np.ndarray:
        """Returns some points as :meth:`read_points` does; arguments and errors are those of :meth:`read_positions`."""
        points = self.read_points(time, before=before)
        with reading(self._where, self.name, time):
            if len(points) != point_count:
                raise UnreadableError(
                    f"{self._where}: {len(points)} points at time {time:g}, but {point_count} at first"
                )
            return points[used].astype(dtype)

    def read_transform(self, time: float, *, before: bool = False) -> np.ndarray | None:
        """Returns the matrix that transforms points, as rows, to world space, shape [4, 4]; None if it has none then.

        Args:
            time: Time code, of the scene or between its times.
            before: As of :meth:`read_positions`.
        """
        return self._find_transform(self.time_code(time, before))

    def read_instances(
        self, time: float, instances: np.ndarray, point_count: int, *, before: bool = False
    ) -> np.ndarray | None:
        """Returns the positions of all points in several instances of one :attr:`group` in world space, float64.

        Args:
            time: Time code.
            instances: Numbers of the instances, shape [n].
            point_count: As of :meth:`read_positions`.
            before: As of :meth:`read_positions`.

        Returns:
            Positions, shape [n, point_count, 3]; None if an instance is broken, for which its :meth:`read_positions`
            raises the error.

        Raises:
            UnreadableError: If the points cannot be read.
        """
        points = self.read_points(time, before=before).astype(np.float64)
        with reading(self._where, self.name, time):
            transforms, are_there = self._read_transforms(self._instance, self.time_code(time, before))
            transforms = transforms[instances]
            if len(points) != point_count or not are_there[instances].all() or not np.isfinite(transforms).all():
                return None
            return points @ transforms[:, :3, :3] + transforms[:, 3:, :3]

    @property
    def instance(self) -> Instance | None:
        """The instance that it is, None for a mesh without an instancer."""
        return self._instance

    def transform_ops(self) -> Iterator[UsdGeom.XformOp]:
        """Yields the operations of its transform to the world, except those of instancers on their instances."""
        yield from transform_ops(self._frame, self._root)
        instance = self._instance
        while instance:
            instancer = instance.instancer
            instance = instancer.parent
            yield from transform_ops(instancer.prim, instance.root if instance else None)

    @property
    def index(self) -> int:
        """Number of the instance, 0 for a mesh without an instancer."""
        return self._instance.index if self._instance else 0

    def read_triangles(self, time: float, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
        """Returns the polygons without the holes, as triangles that turn counterclockwise seen from outside.

        Args:
            time: Time code.
            points: Points by which concave polygons are cut, shape [point_count, 3].

        Returns:
            The triangles' points, shape [triangle_count, 3], the polygon that each is a part of, shape
            [triangle_count], and the number of polygons, holes included.

        Raises:
            UnreadableError: If the faces are broken, or there are none.
        """
        if self._strands:
            return np.zeros((0, 3), dtype=np.int64), np.zeros(0, dtype=np.int64), 0
        with reading(self._where, self.name, time):
            is_mirrored = bool(np.linalg.det(self._transform(time)[:3, :3]) < 0)
            code = self.time_code(time, False)
            if not self.group:
                return self._find_triangles(code, points, is_mirrored)
            if any(value != code.GetValue() for value, _ in self._last_triangles):
                self._last_triangles.clear()
            key = code.GetValue(), is_mirrored
            if key not in self._last_triangles:
                self._last_triangles[key] = self._find_triangles(code, points, is_mirrored)
            return self._last_triangles[key]

    def read_strands(self, times: list[float], point_count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns the edges of curves, and the radii of curves and points; empty and zero for a mesh with faces.

        Args:
            times: Times, ascending; the topology is the same from the first to just before the last.
            point_count: Number of points.

        Returns:
            The points at both ends of each edge, shape [n, 2]; the curve of each point, -1 for none, shape
            [point_count]; and radii in world space, the largest of all times, shape [point_count].

        Raises:
            UnreadableError: If the curves or widths are broken.
        """
        if not self._strands:
            return np.zeros((0, 2), dtype=np.int64), np.full(point_count, -1), np.zeros(point_count)
        with reading(self._where, self.name, times[0]):
            topology = self._read_topology(self.time_code(times[0], False))
            edges, curves = self._strands.read_edges(topology.counts, point_count, self._where)
        own = sample_times(self._strands.width_attribute)
        radius = np.zeros(point_count)
        for time in sorted({*times, *(time for time in own if times[0] < time < times[-1])}) if own else times[:1]:
            with reading(self._where, self.name, time):
                code = self.time_code(time, time == times[-1] > times[0])
                radius = np.maximum(radius, 0.5 * self._strands.read_widths(code, curves, self._where))
        return edges, curves, radius * max(self._scales(times if self._placed_times else times[:1]))

    def _scales(self, times: list[float]) -> list[float]:
        """Returns the largest stretch of the transform at each time, to nine digits; [1] without times."""
        found = [self._find_transform(self.time_code(time, False)) for time in times if not self.is_placed]
        scales = [
            np.linalg.norm(transform[:3, :3], 2)
            for transform in found
            if transform is not None and np.isfinite(transform).all()  # reading positions reports the others
        ]
        return [float(f"{scale:.9g}") for scale in scales] or [1.0]

    def _find_triangles(self, code, points, is_mirrored) -> tuple[np.ndarray, np.ndarray, int]:
        """Returns the result of :meth:`read_triangles`."""
        topology = self._read_topology(code)
        triangles, polygons = topology.triangles(points, self._where)
        is_left_handed = UsdGeom.Gprim(self._prim).GetOrientationAttr().Get() == UsdGeom.Tokens.leftHanded
        if is_left_handed != is_mirrored:
            triangles = triangles[:, ::-1]
        return triangles, polygons, len(topology.counts)

    def time_code(self, time: float, before: bool) -> Usd.TimeCode:
        """Returns the mesh's own time code for a time of the scene, or for the moment just before it."""
        first, last = self._own_times.get(time, (time, time))
        # Reading the moment before a time takes twice as long, as USD interpolates from the previous sample.
        return as_time_code(first if before else last, before=before and (self.may_jump or time in self.states))

    def _transform(self, time, *, before=False) -> np.ndarray:
        """Returns the matrix that transforms points, as rows, to world space, shape [4, 4]."""
        transform = self._find_transform(self.time_code(time, before))
        if transform is None:
            raise UnreadableError(f"{self._where}: its instancer has no valid transform for it at time {time:g}")
        if not np.isfinite(transform).all():
            raise UnreadableError(f"{self._where}: its transform is not finite at time {time:g}")
        return transform

    def _bends(self, start, end) -> bool:
        """Returns whether the transform leaves the straight path from one sample to the next."""
        if (start, end) not in self._bent:
            codes = Usd.TimeCode(start), Usd.TimeCode(start + _BETWEEN * (end - start)), Usd.TimeCode.PreTime(end)
            (first, *_), (between, *_), (last, *_) = found = [self._read_transforms(self._instance, c) for c in codes]
            off = np.abs(between - (first + _BETWEEN * (last - first)))
            size = np.maximum(np.abs(first), np.abs(last))
            self._bent[start, end] = np.zeros(len(first), dtype=bool)
            for rows in (slice(0, 3), slice(3, 4)):
                self._bent[start, end] |= off[:, rows].max(axis=(1, 2)) > _ROUNDING * size[:, rows].max(axis=(1, 2))
            self._bent[start, end] &= np.all([are_there for _, are_there in found], axis=0)
        return bool(self._bent[start, end][self.index])

    def _find_transform(self, time) -> np.ndarray | None:
        if not self._instance:
            return self._read_transforms(None, time)[0][0]
        return self._instance.transform(self._frame, time)

    def _read_transforms(self, instance, time) -> tuple[np.ndarray, np.ndarray]:
        """Returns the result of :meth:`Instancer.transforms`, or one matrix for a mesh without an instancer."""
        if instance:
            return instance.instancer.transforms(self._frame, instance.root, time)
        return self.compute_transform(UsdGeom.XformCache(time))[None], np.ones(1, dtype=bool)

    def compute_transform(self, cache: UsdGeom.XformCache) -> np.ndarray:
        """Returns the matrix of a mesh without an instancer, finite or not, at the time of a cache, shape [4, 4]."""
        transform = np.array(cache.GetLocalToWorldTransform(self._frame))
        if not are_finite(self._masking, cache.GetTime()):
            transform[:] = np.nan
        return transform

    def _read_topology(self, time) -> Topology:
        return as_topology(self._polygons.read_topology(time), self._where)

    def _read_topologies(self) -> list[tuple[bytes, bytes] | None]:
        """Returns digests of the topology at each time at which it may change; None where it is empty.

        A mesh may be empty for some time, such as a fluid before it flows. Where a sample is blocked it is not empty,
        but broken.
        """
        topologies, is_empty, last = [], True, []
        for code in self._break_codes:
            values = self._polygons.read_topology(code)
            if not last or any(old is not new and old != new for old, new in zip(last, values, strict=True)):
                topology = as_topology(values, self._where)
                has_elements = len(topology.counts) > 0
                without = BROKEN if values[0] is None else None
                topologies.append(topology.digests() if has_elements else without)
                is_empty &= not has_elements
            else:
                topologies.append(topologies[-1])  # reading the digests of equal values would take longer
            last = values
        return [None] * len(topologies) if is_empty else topologies

    def _held(self, code: Usd.TimeCode) -> Usd.TimeCode:
        """Returns the time code of the last sample of the points where the next one is of other polygons, else a code.

        USD holds points until the next sample if that has another number of points, and interpolates them if it has as
        many. Neither value is a motion if the points have other numbers.
        """
        times, time = self._numbered_times, code.GetValue()
        search = bisect.bisect_left if code.IsPreTime() else bisect.bisect_right
        following = search(times, time)
        if 0 < following < len(times):
            topologies = (
                self._topologies[max(0, search(self._breaks, time) - 1)],
                self._topologies[bisect.bisect_right(self._breaks, times[following]) - 1],
            )
            now, then = (topology and topology[0] for topology in topologies)
            if now and then and now != then:
                return Usd.TimeCode(times[following - 1])
        return code


def _state_at(states: _States, time: float) -> tuple[bytes, bytes] | None:
    return next(state for since, state in reversed(states.items()) if since <= time)
