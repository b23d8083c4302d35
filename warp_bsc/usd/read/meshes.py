"""Reads a mesh of a USD stage, or curves or points of a prim. Imports pxr, which is slow: import this where used."""

import copy
import math
import os
from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from pxr import Usd, UsdGeom

from ..._sorted_keys import distinct
from .instancers import is_shown, visibility_times
from .mesh_prims import MeshPrim
from .mesh_transforms import MeshTransforms
from .samples import sample_times
from .shapes import MeshPolygons, Polygons, ShapePolygons, TetPolygons, is_shape
from .skinning import Skin
from .strands import Strands, is_strands
from .topology import BROKEN, Topologies, is_empty
from .unreadable import UnreadableError, reading

_MOST_TIMES = 1_000_000

_States = dict[float, tuple[bytes, bytes] | None]


class UsdMesh:
    """A mesh prim, or one instance of it.

    Attributes:
        prim: The prim.
        path: Its path.
        name: The path, with the number of the instance if a point instancer places it.
        instance: The instance that it is, None for a mesh without an instancer.
        index: Number of the instance, 0 without an instancer.
        transforms: The transforms of all instances to the world.
        instanced_prim: The same for all instances of a prim that one instancer places; empty without an instancer.
        display_name: Display name in the file, empty if there is none.
        type_name: Type of the prim.
        is_shape: Whether it is a shape, see :class:`~warp_bsc.usd.read.shapes.ShapePolygons`.
        has_tetrahedra: Whether it is the surface of tetrahedra.
        is_strands: Whether it is curves or points, see :class:`~warp_bsc.usd.read.strands.Strands`.
        times: Time codes at which its points or its transform to the world have a sample; empty if it does not move.
        states: Its states by the time from which on they hold, the first by minus infinity: None where it is invisible,
            absent or empty, else digests of its topology.
        turns: Whether a transform or a skeleton moves it, so that it may move nonlinearly between the samples.
        is_skinned: Whether a skeleton or blend shapes deform it.
        has_skeleton: Whether a skeleton does, so that its points are in the space of that.
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
        self.prim = prim
        self.path = found.path
        self.display_name = prim.GetDisplayName()
        self.type_name = str(prim.GetTypeName())
        self.is_shape = is_shape(prim)
        self._strands = Strands(prim) if is_strands(prim) else None
        self.is_strands = self._strands is not None
        self.has_tetrahedra = prim.IsA(UsdGeom.TetMesh)
        shaped = ShapePolygons if self.is_shape else TetPolygons if self.has_tetrahedra else MeshPolygons
        self._polygons: Polygons = self._strands or shaped(prim)
        self._skin = skin = Skin(*found.binding, where=f"{file}: {self.path}") if found.binding else None
        self.is_skinned = skin is not None
        self.has_skeleton = bool(skin and skin.skeleton)
        self.instanced_prim = found.instanced_prim
        self._last_points: dict[tuple, np.ndarray] = {}  # these two are shared by all instances
        self._last_triangles: dict[tuple, tuple[np.ndarray, np.ndarray]] = {}

        root, breaks = (instance.root, instance.instancer.break_times) if instance else (None, set())
        breaks = breaks | visibility_times(prim, root)
        has_numbers = not self._strands or self._strands.has_edges  # points without edges have ids
        self._topologies = topologies = Topologies(self._polygons, breaks, has_numbers=has_numbers)
        self.is_empty = not any(topologies.digests)
        self._states = [
            topology if topology and is_shown(prim, root, code) else None
            for code, topology in zip(topologies.codes, topologies.digests, strict=True)
        ]
        point_times = sample_times(*self._polygons.point_attributes)
        self._deformed_times = frozenset(point_times | (skin.times if skin else set()))
        self.deforms = bool(self._deformed_times)
        # Joints move points to the space of their skeleton.
        self.transforms = MeshTransforms((skin and skin.skeleton) or prim, instance)
        self.may_jump = self.transforms.may_jump or self._polygons.may_jump or bool(skin and skin.may_jump)
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
        self.instance = instance = found.instance
        self.index = instance.index if instance else 0
        self._whole: _States = {}  # its states before parts are left out, if any are
        self._own_times = {}  # by time of the scene: the first and the last of the mesh's times that it stands for
        states = self._states
        if instance:
            present = instance.are_present(self._topologies.codes)
            states = [state if here else None for state, here in zip(states, present.tolist(), strict=True)]
        self.states: _States = {}
        last = b"", b""
        for time, state in zip(self._topologies.times, states, strict=True):
            if state != last:
                self.states[time] = last = state
        moves = bool(self.transforms.moves[self.index])
        self.is_placed = bool(self.transforms.stays[self.index]) and not moves
        self.is_nowhere = not (self.transforms.is_finite[self.index] or moves)
        self._placed_times = self.transforms.times if moves else []
        self.times = self._deformed_times | set(self._placed_times)
        self.turns = bool(self._placed_times) or bool(self._skin and self._skin.times)

    @property
    def may_thicken(self) -> bool:
        """Whether the radii of curves or points may change."""
        return self._strands is not None and (
            self._strands.width_attribute.ValueMightBeTimeVarying() or len({*self._scales(self._placed_times)}) > 1
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
            if low <= high and (bends or self.transforms.bend(self.instance, first, last)[self.index]):
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
            triangles, _ = self.read_triangles(time, points)
            self.read_strands([time], len(points))
            used = np.arange(len(points)) if self.is_strands else distinct(triangles)
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
    def is_rigid(self) -> bool:
        """Whether only its transform moves its points, and no point instancer places it."""
        return not (self.deforms or self.is_skinned or self.may_jump or self.is_placed or self.instanced_prim)

    @property
    def why_not_written(self) -> str | None:
        """Why a layer over the scene cannot give the mesh points of its own, in words; None if it can."""
        if self.instance:
            return "a point instancer places it"
        if self.prim.IsInstanceProxy():
            return "it is in an instance, which shares its points with others"
        if self.is_shape or self.is_strands:
            return f"a {self.type_name} has no faces of its own"
        if self.has_tetrahedra and self.is_skinned:
            return "a skeleton or blend shapes deform its tetrahedra"
        return None

    @property
    def why_not_repaired(self) -> str | None:
        """Why a repair does not move the mesh, in words; None if it may."""
        if self.why_not_written or self.deforms:
            return self.why_not_written
        return "its points do not move, only its transform" if self.times else "it does not move"

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
            held = self._topologies.held(Usd.TimeCode(code.GetValue()) if at_time else code)
            points = self._polygons.read_points(held)
            if is_empty(points):
                raise ValueError(f"the mesh has no points at time {time:g}")
            if self._skin:
                self._skin.deform(points, code)
            array = np.array(points)
            if array.ndim != 2 or array.shape[1] != 3 or array.dtype.kind != "f":
                raise ValueError(f"attribute points holds {type(points).__name__}, not point3f[]")
            if self.instanced_prim:
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
        self.check_finite(positions, used, time)
        return positions

    def check_finite(self, positions: np.ndarray, used: np.ndarray, time: float) -> None:
        """Raises an UnreadableError if a position of some points at a time is not finite."""
        if not np.isfinite(positions).all():
            first = int(np.argmin(np.isfinite(positions).all(axis=1)))
            text = f"vertex {used[first]} is not finite at time {time:g}: {positions[first].tolist()}"
            raise UnreadableError(f"{self._where}: {text}", self.name, time)

    def read_used_points(
        self, time: float, *, before: bool = False, used: np.ndarray, point_count: int, dtype: np.dtype
    ) -> np.ndarray:
        """Returns some points as :meth:`read_points` does; arguments and errors are those of :meth:`read_positions`."""
        points = self.read_points(time, before=before)
        with reading(self._where, self.name, time):
            if len(points) != point_count:
                raise ValueError(f"{len(points)} points at time {time:g}, but {point_count} at first")
            return points[used].astype(dtype)

    def read_transform(self, time: float, *, before: bool = False) -> np.ndarray | None:
        """Returns the matrix that transforms points, as rows, to world space, shape [4, 4]; None if it has none then.

        The time code is one of the scene or between its times; ``before`` is as of :meth:`read_positions`.
        """
        return self.transforms.read_one(self.instance, self.time_code(time, before))

    def read_instances(
        self, time: float, instances: np.ndarray, point_count: int, *, before: bool = False
    ) -> np.ndarray | None:
        """Returns the positions of all points in instances of one :attr:`instanced_prim` in world space, float64.

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
            transforms, are_there = self.transforms.read(self.instance, self.time_code(time, before))
            transforms = transforms[instances]
            if len(points) != point_count or not are_there[instances].all() or not np.isfinite(transforms).all():
                return None
            return points @ transforms[:, :3, :3] + transforms[:, 3:, :3]

    def read_triangles(self, time: float, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the polygons without the holes, as triangles that turn counterclockwise seen from outside.

        Args:
            time: Time code.
            points: Points by which concave polygons are cut, shape [point_count, 3].

        Returns:
            The triangles' points, shape [triangle_count, 3], and the polygon that each is a part of, shape
            [triangle_count].

        Raises:
            UnreadableError: If the faces are broken, or there are none.
        """
        if self._strands:
            return np.zeros((0, 3), dtype=np.int64), np.zeros(0, dtype=np.int64)
        with reading(self._where, self.name, time):
            is_mirrored = bool(np.linalg.det(self._transform(time)[:3, :3]) < 0)
            code = self.time_code(time, False)
            if not self.instanced_prim:
                return self._find_triangles(code, points, is_mirrored)
            if any(value != code.GetValue() for value, _ in self._last_triangles):
                self._last_triangles.clear()
            key = code.GetValue(), is_mirrored
            if key not in self._last_triangles:
                self._last_triangles[key] = self._find_triangles(code, points, is_mirrored)
            return self._last_triangles[key]

    def read_tetrahedra(self, time: float, point_count: int) -> np.ndarray:
        """Returns the points of the tetrahedra, shape [n, 4]; in the prim's space, volumes are positive.

        Raises:
            UnreadableError: If they refer to points that are not there.
        """
        with reading(self._where, self.name, time):
            topology = self._topologies.read(self.time_code(time, False))
            tets = topology.tetrahedra(point_count)
            return tets[:, [1, 0, 2, 3]] if self._is_left_handed else tets

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
            topology = self._topologies.read(self.time_code(times[0], False))
            edges, curves = self._strands.read_edges(topology.counts, point_count)
        own = sample_times(self._strands.width_attribute)
        radius = np.zeros(point_count)
        for time in sorted({*times, *(time for time in own if times[0] < time < times[-1])}) if own else times[:1]:
            with reading(self._where, self.name, time):
                code = self.time_code(time, time == times[-1] > times[0])
                radius = np.maximum(radius, 0.5 * self._strands.read_widths(code, curves))
        return edges, curves, radius * max(self._scales(times if self._placed_times else times[:1]))

    def _scales(self, times: list[float]) -> list[float]:
        return self.transforms.scales(self.instance, [self.time_code(time, False) for time in times])

    def _find_triangles(self, code, points, is_mirrored) -> tuple[np.ndarray, np.ndarray]:
        """Returns the result of :meth:`read_triangles`."""
        triangles, polygons = self._topologies.read(code).triangles(points)
        return triangles[:, ::-1] if self._is_left_handed != is_mirrored else triangles, polygons

    @property
    def _is_left_handed(self) -> bool:
        return UsdGeom.Gprim(self.prim).GetOrientationAttr().Get() == UsdGeom.Tokens.leftHanded

    def time_code(self, time: float, before: bool) -> Usd.TimeCode:
        """Returns the mesh's own time code for a time of the scene, or for the moment just before it."""
        first, last = self._own_times.get(time, (time, time))
        # Reading the moment before a time takes twice as long, as USD interpolates from the previous sample.
        if before and (self.may_jump or time in self.states):
            return Usd.TimeCode.PreTime(first)
        return Usd.TimeCode(first if before else last)

    def _transform(self, time, *, before=False) -> np.ndarray:
        """Returns the matrix that transforms points, as rows, to world space, shape [4, 4]."""
        transform = self.read_transform(time, before=before)
        if transform is None:
            raise ValueError(f"its instancer has no valid transform for it at time {time:g}")
        if not np.isfinite(transform).all():
            raise ValueError(f"its transform is not finite at time {time:g}")
        return transform


def _state_at(states: _States, time: float) -> tuple[bytes, bytes] | None:
    return next(state for since, state in reversed(states.items()) if since <= time)
