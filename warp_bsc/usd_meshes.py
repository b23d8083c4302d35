"""Opens a USD file and reads one mesh of it at a time. Imports pxr: to be imported where it is used."""

from collections import Counter
from pathlib import Path

import numpy as np
from pxr import Tf, Usd, UsdGeom, UsdSkel, UsdUtils

from .triangulation import triangulate

__all__ = ["UsdMesh", "find_meshes", "open_stage"]


def open_stage(path) -> Usd.Stage:
    """Open a USD file with everything that it refers to.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is not USD, or refers to something that cannot be opened.
    """
    if not Path(path).exists():
        raise FileNotFoundError(f"{path}: no such file")
    if Path(path).is_dir():
        raise ValueError(f"{path}: a folder, not a USD file")

    # While it lives, the delegate keeps USD from printing what is raised here.
    delegate = UsdUtils.CoalescingDiagnosticDelegate()
    try:
        stage = Usd.Stage.Open(str(path))
    except Tf.ErrorException as error:
        raise ValueError(f"{path}: not a readable USD file: {_one_line(error.args[0].commentary)}") from None
    finally:
        delegate.TakeUncoalescedDiagnostics()
    if errors := stage.GetCompositionErrors():
        more = f" (and {len(errors) - 1} more errors)" if len(errors) > 1 else ""
        raise ValueError(f"{path}: {_one_line(str(errors[0]))}{more}")
    return stage


def find_meshes(stage, file) -> tuple[list["UsdMesh"], list[str]]:
    """The meshes of a stage that are visible at some time, and a sentence on each kind of thing that is passed over.

    Args:
        stage: The stage.
        file: Its file, for messages.
    """
    meshes, warnings, invisible, other = [], [], [], Counter()
    prims = iter(Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies()))
    for prim in prims:
        path = prim.GetPath()
        if prim.IsA(UsdGeom.PointInstancer):
            # Meshes below are its prototypes: they are not where they stand in the hierarchy.
            prims.PruneChildren()
            prototypes = map(stage.GetPrimAtPath, UsdGeom.PointInstancer(prim).GetPrototypesRel().GetTargets())
            if any(child.IsA(UsdGeom.Mesh) for root in filter(None, prototypes) for child in Usd.PrimRange(root)):
                warnings.append(f"{path} is a point instancer: its instances are not checked")
        elif not prim.IsA(UsdGeom.Gprim):
            continue
        elif not _is_ever_visible(prim):
            invisible.append(path)
        elif not prim.IsA(UsdGeom.Mesh):
            other[prim.GetTypeName()] += 1
        else:
            meshes.append(UsdMesh(prim, file))
            if UsdSkel.BindingAPI(prim).GetInheritedSkeleton():
                warnings.append(f"{path} is bound to a skeleton: skeletal animation is not evaluated")
    if invisible:
        warnings.append(f"invisible prims are not checked: {len(invisible)}, the first is {invisible[0]}")
    if other:
        shapes = ", ".join(f"{count} {name}" for name, count in sorted(other.items()))
        warnings.append(f"shapes that are not meshes are not checked: {shapes}")
    return meshes, warnings


class UsdMesh:
    """A mesh prim.

    Attributes:
        path: The prim's path.
        times: Time codes at which its points or its transform to the world have a sample; empty if it does not move.
        is_placed: Whether its points are in world space as they are: its transform is the identity at all times.
    """

    def __init__(self, prim, file):
        self.path = str(prim.GetPath())
        self._where = f"{file}: {self.path}"
        self._mesh = UsdGeom.Mesh(prim)

        point_times = self._mesh.GetPointsAttr().GetTimeSamples()
        self.times = set(point_times) if len(point_times) > 1 else set()
        transform = self._transform(Usd.TimeCode.EarliestTime())
        self.is_placed = np.array_equal(transform, np.eye(4))
        transform_times = _transform_times(prim)
        # Some writers sample a transform at every time that never changes.
        if any(not np.array_equal(self._transform(time), transform) for time in transform_times):
            self.times |= transform_times
            self.is_placed = False

    def read_points(self, time: float) -> np.ndarray:
        """The points as they are stored, shape [point_count, 3].

        Raises:
            ValueError: If there are none.
        """
        points = self._mesh.GetPointsAttr().Get(time)
        if not points:
            raise ValueError(f"{self._where}: the mesh has no points at time {time:g}")
        return np.array(points)

    def read_positions(self, time: float, *, used: np.ndarray, point_count: int, dtype: np.dtype) -> np.ndarray:
        """Positions in world space of some of the points.

        Args:
            time: Time code.
            used: The points, shape [count].
            point_count: How many points the mesh must have in all.
            dtype: float32 only if :attr:`is_placed`, else float64.

        Returns:
            Positions, shape [count, 3].

        Raises:
            ValueError: If the number of points is another, or a position is not finite.
        """
        points = self.read_points(time)
        if len(points) != point_count:
            raise ValueError(f"{self._where}: {len(points)} points at time {time:g}, but {point_count} at first")
        positions = points[used].astype(dtype)
        if not self.is_placed:
            transform = self._transform(time)
            with np.errstate(over="ignore", invalid="ignore"):  # raised below
                positions = positions @ transform[:3, :3] + transform[3, :3]
        finite = np.isfinite(positions).all(axis=1)
        if not finite.all():
            first = int(np.argmin(finite))
            raise ValueError(
                f"{self._where}: vertex {used[first]} is not finite at time {time:g}: {positions[first].tolist()}"
            )
        return positions

    def read_triangles(self, points) -> tuple[np.ndarray, np.ndarray]:
        """The polygons that are no holes, as triangles.

        Args:
            points: The points at the time that says which polygons are concave, shape [point_count, 3].

        Returns:
            The triangles' points, shape [triangle_count, 3], and the polygon that each is a part of, shape
            [triangle_count].

        Raises:
            ValueError: If the faces are broken, not the same at all times, or none.
        """
        counts = self._read_fixed(self._mesh.GetFaceVertexCountsAttr())
        indices = self._read_fixed(self._mesh.GetFaceVertexIndicesAttr())
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
        solid = ~np.isin(polygons, self._read_fixed(self._mesh.GetHoleIndicesAttr()))
        if not solid.any():
            raise ValueError(f"{self._where}: all faces of the mesh are holes")
        return triangles[solid], polygons[solid]

    def _transform(self, time) -> np.ndarray:
        """The matrix that takes points, as rows, to world space, shape [4, 4]."""
        return np.array(self._mesh.ComputeLocalToWorldTransform(time))

    def _read_fixed(self, attribute) -> np.ndarray:
        """The value of a topology attribute, which must be the same at all times."""
        times = attribute.GetTimeSamples()
        value = attribute.Get(times[0]) if times else attribute.Get()
        for time in times[1:]:
            if not np.array_equal(attribute.Get(time), value):
                raise ValueError(
                    f"{self._where}: {attribute.GetName()} at time {time:g} differ from those at time {times[0]:g}; "
                    "a mesh must keep its topology"
                )
        return np.array(value if value is not None else (), dtype=np.int64)


def _one_line(text: str) -> str:
    return " ".join(text.split())


def _transform_times(prim) -> set[float]:
    """Times at which the transforms from a prim to the world have samples, of those that have two or more."""
    times = set()
    while prim:
        if xformable := UsdGeom.Xformable(prim):
            if xformable.TransformMightBeTimeVarying():
                times.update(xformable.GetTimeSamples())
            if xformable.GetResetXformStack():
                break
        prim = prim.GetParent()
    return times


def _is_ever_visible(prim) -> bool:
    times = {Usd.TimeCode.EarliestTime()}
    ancestor = prim
    while ancestor:
        if imageable := UsdGeom.Imageable(ancestor):
            times.update(map(Usd.TimeCode, imageable.GetVisibilityAttr().GetTimeSamples()))
        ancestor = ancestor.GetParent()
    imageable = UsdGeom.Imageable(prim)
    return any(imageable.ComputeVisibility(time) != UsdGeom.Tokens.invisible for time in times)
