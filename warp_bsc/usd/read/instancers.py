"""The instances of point instancers and their transforms. Imports pxr, which is slow: import this where used."""

import math
import os
from collections.abc import Iterable, Iterator

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom

from .samples import may_jump, sample_times
from .unreadable import LeftOut, UnreadableError, reading

# Prototypes are often below a class or an over, so that they are not drawn themselves.
_PROTOTYPES = Usd.TraverseInstanceProxies(Usd.PrimIsActive & Usd.PrimIsLoaded)


class Instance:
    """An instance of a prototype, which a point instancer places.

    Attributes:
        instancer: The point instancer, the same object for all of its instances.
        index: Number of the instance.
        name: The instancer and the number of the instance, such as ``"/World/Leaves[3]"``.
        root: The prototype's topmost prim.
    """

    def __init__(self, instancer: "Instancer", index: int, prototype: int, root: Usd.Prim):
        """Makes an instance, given the number of its prototype."""
        self.instancer, self.index, self._prototype, self.root = instancer, index, prototype, root
        self.name = f"{instancer.name}[{index}]"

    def name_of(self, path: Sdf.Path) -> str:
        """Returns the name that a prim of the prototype has in this instance, given its path."""
        return f"{self.name}/{path.MakeRelativePath(self.root.GetPath().GetParentPath())}"

    def prims(self) -> Iterator[Usd.Prim]:
        """Returns an iterator over the prims of the prototype, the topmost first."""
        return iter(Usd.PrimRange(self.root, _PROTOTYPES))

    def are_present(self, times: tuple[Usd.TimeCode, ...]) -> np.ndarray:
        """Returns whether the instance exists and is visible at each time, bool."""
        return self.instancer.prototypes(times)[:, self.index] == self._prototype

    def transform(self, prim: Usd.Prim, time: Usd.TimeCode) -> np.ndarray | None:
        """Returns the matrix that transforms points of a prim of the prototype, as rows, to world space, shape [4, 4].

        None if the instance does not exist, or the lengths of the instancer's arrays differ.
        """
        transforms, are_there = self.instancer.transforms(prim, self.root, time)
        return transforms[self.index] if are_there[self.index] else None

    def contains(self, prim: Usd.Prim) -> bool:
        """Returns whether an instancer places this instance or one around it; an instancer must not contain itself."""
        parent = self.instancer.parent
        return self.instancer.prim == prim or (parent is not None and parent.contains(prim))


class Instancer:
    """A point instancer, or one instance of it, with the values that were read last.

    Attributes:
        prim: The instancer.
        parent: The instance that contains it, None in the scene itself.
        name: Its path, with the number of the instance that contains it.
        count: Largest number of instances at any time.
        times: Time codes at which transforms of its instances to the world have a sample.
        break_times: Time codes at which instances may appear or vanish.
        may_jump: Whether instances may jump at a time, see :func:`~warp_bsc.usd.read.samples.may_jump`.
        may_turn: Whether its orientations, or those of an instancer around it, change.
    """

    count: int = 0

    def __init__(self, prim: Usd.Prim, parent: Instance | None):
        """Finds the times at which the instances move, appear or vanish."""
        self.prim = prim
        self.parent = parent
        self.name = parent.name_of(prim.GetPath()) if parent else str(prim.GetPath())
        self._instancer = instancer = UsdGeom.PointInstancer(prim)
        self._last_placed: tuple[Usd.TimeCode | None, np.ndarray] = None, np.zeros((0, 4, 4))
        self._last_transforms: dict[Sdf.Path, tuple[Usd.TimeCode, tuple[np.ndarray, np.ndarray]]] = {}
        self._last_prototypes: tuple[tuple, np.ndarray] = (), np.zeros((0, 0), dtype=int)
        root = parent.root if parent else None
        self._masking = () if parent else masking_attributes(prim)  # a parent considers its own
        self._masking_of: dict[Sdf.Path, tuple[Usd.Attribute, ...]] = {}  # by prim of a prototype
        placing = (
            instancer.GetPositionsAttr(),
            instancer.GetOrientationsAttr(),
            instancer.GetOrientationsfAttr(),
            instancer.GetScalesAttr(),
        )
        self.times = transform_times(prim, root) | sample_times(*placing)
        self.break_times = visibility_times(prim, root) | sample_times(
            instancer.GetProtoIndicesAttr(), instancer.GetInvisibleIdsAttr(), instancer.GetIdsAttr()
        )
        self.may_jump: bool = may_jump([*transform_attributes(prim, root), *placing])
        self.may_turn = any(attribute.ValueMightBeTimeVarying() for attribute in placing[1:3])
        if parent:
            self.times |= parent.instancer.times
            self.break_times |= parent.instancer.break_times
            self.may_jump |= parent.instancer.may_jump
            self.may_turn |= parent.instancer.may_turn

    def transforms(self, prim: Usd.Prim, root: Usd.Prim, time: Usd.TimeCode) -> tuple[np.ndarray, np.ndarray]:
        """Returns the matrices that transform points of a prim of a prototype, as rows, to world space, by instance.

        Args:
            prim: The prim.
            root: The prototype's topmost prim.
            time: Time code.

        Returns:
            Matrices, shape [count, 4, 4], finite or not, the identity for instances that do not exist; and whether each
            instance exists, shape [count].
        """
        last = self._last_transforms.get(prim.GetPath())
        if last and last[0] == time:
            return last[1]
        cache = UsdGeom.XformCache(time)
        above = self.parent.transform(self.prim, time) if self.parent else cache.GetLocalToWorldTransform(self.prim)
        local, _ = cache.ComputeRelativeTransform(prim, root)
        if xformable := UsdGeom.Xformable(root):
            local *= xformable.GetLocalTransformation(time)
        if prim.GetPath() not in self._masking_of:
            self._masking_of[prim.GetPath()] = (*self._masking, *masking_attributes(prim, root))
        transforms = np.tile(np.eye(4), (self.count, 1, 1))
        are_there = np.zeros(self.count, dtype=bool)
        if above is not None:
            placed = self._read_placed(time)[: self.count]
            transforms[: len(placed)] = np.array(local) @ placed @ np.array(above)
            are_there[: len(placed)] = True
            if not are_finite(self._masking_of[prim.GetPath()], time):
                transforms[are_there] = np.nan
        self._last_transforms[prim.GetPath()] = time, (transforms, are_there)
        return transforms, are_there

    def prototypes(self, times: tuple[Usd.TimeCode, ...]) -> np.ndarray:
        """Returns the prototype of each instance at each time, shape [len(times), count]; -1 if it is not visible."""
        if self._last_prototypes[0] != times:
            prototypes = np.full((len(times), self.count), -1)
            parent = self.parent
            shown = parent.are_present(times) if parent else np.ones(len(times), dtype=bool)
            for row, time in enumerate(times):
                if shown[row] and is_shown(self.prim, parent.root if parent else None, time):
                    numbers = np.array(self._instancer.GetProtoIndicesAttr().Get(time) or (), dtype=int)[: self.count]
                    mask = np.array(self._instancer.ComputeMaskAtTime(time), dtype=bool)[: len(numbers)]
                    prototypes[row, : len(numbers)] = np.where(mask, numbers, -1) if len(mask) else numbers
            self._last_prototypes = times, prototypes
        return self._last_prototypes[1]

    def zero_scales(self, times: list[float]) -> dict[int, float]:
        """Returns the first of some times, ascending, or between them, at which an instance has a scale of 0."""
        scales = self._instancer.GetScalesAttr()
        found: dict[int, float] = {}  # by instance
        for time in (times[0], *(time for time in scales.GetTimeSamples() if times[0] < time <= times[-1])):
            are_zero = ~np.array(scales.Get(time) or np.ones((1, 3))).any(axis=1)
            found = {index: time for index in np.flatnonzero(are_zero).tolist()} | found
        return found

    def _read_placed(self, time) -> np.ndarray:
        """Returns the matrices of the instances in the instancer, shape [n, 4, 4], for the length of its shortest list.

        ``PointInstancer.ComputeInstanceTransformsAtTime`` cannot evaluate the moment just before a time.
        """
        if self._last_placed[0] != time:
            instancer = self._instancer
            positions = instancer.GetPositionsAttr().Get(time)
            orientations = instancer.GetOrientationsfAttr().Get(time) or instancer.GetOrientationsAttr().Get(time)
            scales = instancer.GetScalesAttr().Get(time)
            count = min(map(len, [positions or (), *filter(None, (orientations, scales))]))
            placed = np.tile(np.eye(4), (count, 1, 1))
            if orientations:
                placed[:, :3, :3] = _rotations(np.array(orientations, dtype=np.float64)[:count])
            if scales:
                placed[:, :3, :3] *= np.array(scales, dtype=np.float64)[:count, :, None]
            if count:
                placed[:, 3, :3] = np.array(positions)[:count]
            self._last_placed = time, placed
        return self._last_placed[1]


def _rotations(quaternions: np.ndarray) -> np.ndarray:
    """Returns rotations, for points as rows, shape [n, 3, 3], of quaternions, imaginary parts first, shape [n, 4].

    They equal those of ``Gf.Matrix4d.SetRotate``.
    """
    x, y, z, w = quaternions.T
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (z * x - y * w)),
        (2 * (x * y - z * w), 1 - 2 * (z * z + x * x), 2 * (y * z + x * w)),
        (2 * (z * x + y * w), 2 * (y * z - x * w), 1 - 2 * (y * y + x * x)),
    )
    return np.moveaxis(np.array(rows), 2, 0)


def find_instances(
    prim: Usd.Prim, parent: Instance | None, file: str | os.PathLike, left_out: LeftOut
) -> list[Instance]:
    """Returns all instances that a point instancer has at some time.

    Args:
        prim: The instancer.
        parent: The instance that contains it, None in the scene itself.
        file: The file, for messages.
        left_out: Records instancers that contain themselves, and instances whose prototype is missing.

    Raises:
        UnreadableError: If these may not be left out.
    """
    where = f"{file}: {prim.GetPath()}"
    try:
        with reading(where):
            if parent and parent.contains(prim):
                raise UnreadableError(f"{where}: the point instancer contains itself")
            instancer = Instancer(prim, parent)
            stage, schema = prim.GetStage(), UsdGeom.PointInstancer(prim)
            roots = [stage.GetPrimAtPath(path) for path in schema.GetPrototypesRel().GetForwardedTargets()]
            numbers = schema.GetProtoIndicesAttr()
            times = [Usd.TimeCode.EarliestTime(), *map(Usd.TimeCode, numbers.GetTimeSamples())]
            pairs = sorted({pair for time in times for pair in enumerate(numbers.Get(time) or ())})
            missing = [(index, number) for index, number in pairs if not 0 <= number < len(roots) or not roots[number]]
    except UnreadableError as error:
        left_out.add(error)
        return []
    if missing:
        (index, number), more = missing[0], f"; {len(missing) - 1} more" * (len(missing) > 1)
        error = UnreadableError(f"{where}: instance {index} is of prototype {number}, which does not exist{more}")
        left_out.add_missing(error, prim)
    present = sorted({*pairs} - {*missing})
    instancer.count = 1 + max((index for index, _ in present), default=-1)
    return [Instance(instancer, index, number, roots[number]) for index, number in present]


def transform_attributes(prim: Usd.Prim, root: Usd.Prim | None = None) -> Iterator[Usd.Attribute]:
    """Yields the attributes of the transforms from a prim to the world, or up to and including a root."""
    return (op.GetAttr() for op in transform_ops(prim, root))


def masking_attributes(prim: Usd.Prim, root: Usd.Prim | None = None) -> tuple[Usd.Attribute, ...]:
    """Returns those of these attributes whose values may be not finite although OpenUSD's matrix is finite.

    OpenUSD turns a quaternion that is not a number into the identity, and the inverse of an infinite scale into 0.
    """
    ops = transform_ops(prim, root)
    return tuple(op.GetAttr() for op in ops if op.GetOpType() == UsdGeom.XformOp.TypeOrient or op.IsInverseOp())


def are_finite(attributes: Iterable[Usd.Attribute], time: Usd.TimeCode) -> bool:
    """Returns whether the values of attributes of transforms are finite or missing at a time."""
    for attribute in attributes:
        value = attribute.Get(time)
        if hasattr(value, "GetImaginary"):  # a quaternion; this is faster than by NumPy
            finite = math.isfinite(Gf.Quatd(value).GetLength())
        else:
            finite = value is None or bool(np.isfinite(np.array(value, dtype=np.float64)).all())
        if not finite:
            return False
    return True


def transform_ops(prim: Usd.Prim, root: Usd.Prim | None = None) -> Iterator[UsdGeom.XformOp]:
    """Yields the operations of the transforms from a prim to the world, or up to and including a root."""
    while prim:
        if xformable := UsdGeom.Xformable(prim):
            yield from xformable.GetOrderedXformOps()
            if xformable.GetResetXformStack():
                break
        if prim == root:
            break
        prim = prim.GetParent()


def transform_times(prim: Usd.Prim, root: Usd.Prim | None = None) -> set[float]:
    """Returns the times of the samples of these attributes, for attributes that have two or more."""
    return sample_times(*transform_attributes(prim, root))


def visibility_times(prim: Usd.Prim, root: Usd.Prim | None = None) -> set[float]:
    """Returns the times at which the visibility of a prim, or of a prim above it up to a root, may change."""
    return sample_times(*(imageable.GetVisibilityAttr() for imageable in _imageables(prim, root)))


def is_shown(prim: Usd.Prim, root: Usd.Prim | None, time: Usd.TimeCode) -> bool:
    """Returns whether a prim and all prims above it, up to a root or the top of the scene, are visible at a time."""
    return all(
        imageable.GetVisibilityAttr().Get(time) != UsdGeom.Tokens.invisible for imageable in _imageables(prim, root)
    )


def is_ever_shown(prim: Usd.Prim, root: Usd.Prim | None) -> bool:
    """Returns whether they are at some time."""
    times = [Usd.TimeCode.EarliestTime(), *map(Usd.TimeCode, sorted(visibility_times(prim, root)))]
    return any(is_shown(prim, root, time) for time in times)


def _imageables(prim, root):
    while prim:
        if imageable := UsdGeom.Imageable(prim):
            yield imageable
        if prim == root:
            break
        prim = prim.GetParent()
