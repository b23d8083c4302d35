"""Finds and places the instances of point instancers. Imports pxr, which is slow: import this where it is used."""

# pyright: reportAttributeAccessIssue=false
# (OpenUSD's stubs leave out the classes of its modules.)

import os
from collections.abc import Iterator

from pxr import Gf, Sdf, Usd, UsdGeom

from .stage import LeftOut, UnreadableError, may_jump, reading, sample_times

__all__ = ["Instance", "find_instances", "is_shown", "transform_attributes", "transform_times", "visibility_times"]

# Prototypes are often kept under a class or an over, so that they are not drawn where they stand.
_PROTOTYPES = Usd.TraverseInstanceProxies(Usd.PrimIsActive & Usd.PrimIsLoaded)


class Instance:
    """An instance of a prototype: a place where the prims of the prototype stand.

    Attributes:
        name: The instancer and the number of the instance, such as ``"/World/Leaves[3]"``.
        root: The prototype's topmost prim.
        times: Time codes at which its transform to the world has a sample.
        break_times: Time codes at which it may appear or vanish.
        may_jump: Whether it may jump at a time, see :func:`~warp_bsc.usd.stage.may_jump`.
    """

    def __init__(self, instancer: "_Instancer", index: int, prototype: int, root: Usd.Prim, parent: "Instance | None"):
        """Takes the numbers of the instance and of its prototype, and the instance that the instancer stands in."""
        self._instancer = instancer
        self._index = index
        self._prototype = prototype
        self._parent = parent
        path = instancer.prim.GetPath()
        self.name = f"{parent.name_of(path) if parent else path}[{index}]"
        self.root = root
        self.times = instancer.times | (parent.times if parent else set())
        self.may_jump: bool = instancer.may_jump or (parent is not None and parent.may_jump)
        self.break_times = instancer.break_times | (parent.break_times if parent else set())

    def name_of(self, path: Sdf.Path) -> str:
        """Returns the name in this instance of a prim of the prototype, given its path."""
        return f"{self.name}/{path.MakeRelativePath(self.root.GetPath().GetParentPath())}"

    def prims(self) -> Iterator[Usd.Prim]:
        """Returns an iterator over the prims of the prototype, the topmost first."""
        return iter(Usd.PrimRange(self.root, _PROTOTYPES))

    def is_present(self, time: Usd.TimeCode) -> bool:
        """Returns whether the instance is there and visible."""
        numbers, mask = self._instancer.read_presence(time)
        return (
            self._index < len(numbers)
            and numbers[self._index] == self._prototype
            and (not mask or mask[self._index])
            and is_shown(self._instancer.prim, self._parent.root if self._parent else None, time)
            and (self._parent is None or self._parent.is_present(time))
        )

    def transform(self, prim: Usd.Prim, time: Usd.TimeCode) -> Gf.Matrix4d | None:
        """Returns the matrix that takes points of a prim of the prototype to world space.

        None where the instance is not there, or the lengths of the instancer's arrays differ.
        """
        placed = self._instancer.read_transform(self._index, time)
        cache = UsdGeom.XformCache(time)
        instancer = self._instancer.prim
        above = self._parent.transform(instancer, time) if self._parent else cache.GetLocalToWorldTransform(instancer)
        if placed is None or above is None:
            return None
        local, _ = cache.ComputeRelativeTransform(prim, self.root)
        if root := UsdGeom.Xformable(self.root):
            local *= root.GetLocalTransformation(time)
        return local * placed * above

    def contains(self, prim: Usd.Prim) -> bool:
        """Returns whether an instancer made this instance or one around it: an instancer may not contain itself."""
        return self._instancer.prim == prim or (self._parent is not None and self._parent.contains(prim))


class _Instancer:
    """A point instancer, and its transforms at the time that was read last."""

    def __init__(self, prim, root):
        self.prim = prim
        self._instancer = UsdGeom.PointInstancer(prim)
        self._last: tuple[Usd.TimeCode | None, tuple] = None, ()
        self._last_presence: tuple[Usd.TimeCode | None, tuple] = None, ()
        placing = (
            self._instancer.GetPositionsAttr(),
            self._instancer.GetOrientationsAttr(),
            self._instancer.GetOrientationsfAttr(),
            self._instancer.GetScalesAttr(),
        )
        self.times = transform_times(prim, root) | sample_times(*placing)
        self.may_jump = may_jump([*transform_attributes(prim, root), *placing])
        self.break_times = visibility_times(prim, root) | sample_times(
            self._instancer.GetProtoIndicesAttr(), self._instancer.GetInvisibleIdsAttr(), self._instancer.GetIdsAttr()
        )

    def read_transform(self, index, time):
        """Returns the matrix of an instance, None if it has none.

        ``PointInstancer.ComputeInstanceTransformsAtTime`` cannot evaluate the moment just before a time.
        """
        if self._last[0] != time:
            instancer = self._instancer
            orientations = instancer.GetOrientationsfAttr().Get(time) or instancer.GetOrientationsAttr().Get(time)
            arrays = instancer.GetPositionsAttr().Get(time), orientations, instancer.GetScalesAttr().Get(time)
            self._last = time, arrays
        positions, orientations, scales = self._last[1]
        if not positions or any(index >= len(values) for values in self._last[1] if values):
            return None
        matrix = Gf.Matrix4d().SetTranslate(Gf.Vec3d(positions[index]))
        if orientations:
            matrix = Gf.Matrix4d().SetRotate(Gf.Quatd(orientations[index])) * matrix
        if scales:
            matrix = Gf.Matrix4d().SetScale(Gf.Vec3d(scales[index])) * matrix
        return matrix

    def read_presence(self, time) -> tuple:
        """Returns the prototypes of the instances, and the mask of those that are not hidden."""
        if self._last_presence[0] != time:
            numbers = self._instancer.GetProtoIndicesAttr().Get(time) or ()
            self._last_presence = time, (numbers, list(self._instancer.ComputeMaskAtTime(time)))
        return self._last_presence[1]


def find_instances(
    prim: Usd.Prim, parent: Instance | None, file: str | os.PathLike, left_out: LeftOut
) -> list[Instance]:
    """Finds all instances that a point instancer has at some time.

    Args:
        prim: The instancer.
        parent: The instance that it stands in, None if it stands in the scene.
        file: The file, for messages.
        left_out: Takes instancers that contain themselves, and instances whose prototype is missing.

    Raises:
        UnreadableError: If these may not be left out.
    """
    where = f"{file}: {prim.GetPath()}"
    try:
        with reading(where):
            if parent and parent.contains(prim):
                raise UnreadableError(f"{where}: the point instancer contains itself")
            instancer = _Instancer(prim, parent.root if parent else None)
            stage, schema = prim.GetStage(), UsdGeom.PointInstancer(prim)
            roots = [stage.GetPrimAtPath(path) for path in schema.GetPrototypesRel().GetForwardedTargets()]
            numbers = schema.GetProtoIndicesAttr()
            times = [Usd.TimeCode.EarliestTime(), *map(Usd.TimeCode, numbers.GetTimeSamples())]
            pairs = sorted({pair for time in times for pair in enumerate(numbers.Get(time) or ())})
            lost = [(index, number) for index, number in pairs if not 0 <= number < len(roots) or not roots[number]]
    except UnreadableError as error:
        left_out.add(error)
        return []
    if lost:
        (index, number), more = lost[0], f"; {len(lost) - 1} more" * (len(lost) > 1)
        left_out.add(UnreadableError(f"{where}: instance {index} is of prototype {number}, which is not there{more}"))
    present = sorted({*pairs} - {*lost})
    return [Instance(instancer, index, number, roots[number], parent) for index, number in present]


def transform_attributes(prim: Usd.Prim, root: Usd.Prim | None = None) -> Iterator[Usd.Attribute]:
    """Yields the attributes of the transforms from a prim to the world, or up to a root, its own included."""
    while prim:
        if xformable := UsdGeom.Xformable(prim):
            yield from (op.GetAttr() for op in xformable.GetOrderedXformOps())
            if xformable.GetResetXformStack():
                break
        if prim == root:
            break
        prim = prim.GetParent()


def transform_times(prim: Usd.Prim, root: Usd.Prim | None = None) -> set[float]:
    """Returns the times of the samples of those transforms, where an attribute has two or more."""
    return sample_times(*transform_attributes(prim, root))


def visibility_times(prim: Usd.Prim, root: Usd.Prim | None = None) -> set[float]:
    """Returns the times at which the visibility of a prim, or of one above it up to a root, may change."""
    return sample_times(*(imageable.GetVisibilityAttr() for imageable in _imageables(prim, root)))


def is_shown(prim: Usd.Prim, root: Usd.Prim | None, time: Usd.TimeCode) -> bool:
    """Returns whether a prim and all above it, up to a root or to the top of the scene, are visible at a time."""
    return all(
        imageable.GetVisibilityAttr().Get(time) != UsdGeom.Tokens.invisible for imageable in _imageables(prim, root)
    )


def _imageables(prim, root):
    while prim:
        if imageable := UsdGeom.Imageable(prim):
            yield imageable
        if prim == root:
            break
        prim = prim.GetParent()
