"""The instances of point instancers. Imports pxr: to be imported where it is used."""

from pxr import Gf, Usd, UsdGeom

from .stage import LeftOut, UnreadableError, reading, sample_times

__all__ = ["Instance", "find_instances", "is_shown", "transform_attributes", "transform_times", "visibility_times"]

# Prototypes are often kept under a class or an over, lest they be drawn where they stand.
_PROTOTYPES = Usd.TraverseInstanceProxies(Usd.PrimIsActive & Usd.PrimIsLoaded)


class Instance:
    """An instance of a prototype, and thus a place where the prims of the prototype stand.

    Attributes:
        name: The instancer and the number of the instance, such as ``"/World/Leaves[3]"``.
        root: The prototype's topmost prim.
        times: Time codes at which its transform to the world has a sample.
        break_times: Time codes at which it may appear or vanish.
    """

    def __init__(self, instancer, index, prototype, root, parent):
        self._instancer = instancer  # an _Instancer
        self._index = index
        self._prototype = prototype
        self._parent = parent
        path = instancer.prim.GetPath()
        self.name = f"{parent.name_of(path) if parent else path}[{index}]"
        self.root = root
        self.times = instancer.times | (parent.times if parent else set())
        self.break_times = instancer.break_times | (parent.break_times if parent else set())

    def name_of(self, path) -> str:
        """The name of a prim of the prototype, by its path, in this instance."""
        return f"{self.name}/{path.MakeRelativePath(self.root.GetPath().GetParentPath())}"

    def prims(self):
        """An iterator over the prims of the prototype, the topmost first."""
        return iter(Usd.PrimRange(self.root, _PROTOTYPES))

    def is_present(self, time: Usd.TimeCode) -> bool:
        """Whether the instance is there and visible."""
        numbers, mask = self._instancer.read_presence(time)
        return (
            self._index < len(numbers)
            and numbers[self._index] == self._prototype
            and (not mask or mask[self._index])
            and is_shown(self._instancer.prim, self._parent.root if self._parent else None, time)
            and (self._parent is None or self._parent.is_present(time))
        )

    def transform(self, prim, time: Usd.TimeCode):
        """The matrix that takes points of a prim of the prototype to world space, a ``Gf.Matrix4d``.

        None where the instance is not there, or the instancer's arrays do not fit each other.
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

    def contains(self, prim) -> bool:
        """Whether the instance is of, or inside one of, an instancer: such may not contain itself."""
        return self._instancer.prim == prim or (self._parent is not None and self._parent.contains(prim))


class _Instancer:
    """A point instancer, and the transforms that it had when last asked."""

    def __init__(self, prim, root):
        self.prim = prim
        self._instancer = UsdGeom.PointInstancer(prim)
        self._last = None, None
        self._last_presence = None, None
        self.times = transform_times(prim, root) | sample_times(
            self._instancer.GetPositionsAttr(),
            self._instancer.GetOrientationsAttr(),
            self._instancer.GetOrientationsfAttr(),
            self._instancer.GetScalesAttr(),
        )
        self.break_times = visibility_times(prim, root) | sample_times(
            self._instancer.GetProtoIndicesAttr(), self._instancer.GetInvisibleIdsAttr(), self._instancer.GetIdsAttr()
        )

    def read_transform(self, index, time):
        """The matrix of an instance, None if it has none.

        ``PointInstancer.ComputeInstanceTransformsAtTime`` does not know the moment before a time.
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
        if self._last_presence[0] != time:
            numbers = self._instancer.GetProtoIndicesAttr().Get(time) or ()
            self._last_presence = time, (numbers, list(self._instancer.ComputeMaskAtTime(time)))
        return self._last_presence[1]


def find_instances(prim, parent: Instance | None, file, left_out: LeftOut) -> list[Instance]:
    """All instances that a point instancer has at some time.

    Args:
        prim: The instancer.
        parent: The instance that it stands in, None if it stands in the scene.
        file: The file, for messages.
        left_out: An instancer that contains itself is left out, and instances are whose prototype is missing.

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


def transform_attributes(prim, root=None):
    """The attributes that make the transforms from a prim to the world, or to and with a root's."""
    while prim:
        if xformable := UsdGeom.Xformable(prim):
            yield from (op.GetAttr() for op in xformable.GetOrderedXformOps())
            if xformable.GetResetXformStack():
                break
        if prim == root:
            break
        prim = prim.GetParent()


def transform_times(prim, root=None) -> set[float]:
    """Times at which the transforms from a prim to the world, or to and with a root's, have samples.

    Of those transforms only that have two or more.
    """
    return sample_times(*transform_attributes(prim, root))


def visibility_times(prim, root=None) -> set[float]:
    """Times at which the visibility of a prim, or of what it inherits from up to a root, may change."""
    return sample_times(*(imageable.GetVisibilityAttr() for imageable in _imageables(prim, root)))


def is_shown(prim, root, time) -> bool:
    """Whether neither a prim nor what it inherits from, up to a root or the whole scene, is invisible at a time."""
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
