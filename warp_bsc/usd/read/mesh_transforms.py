"""Reads transforms of a mesh, or of its instances, to the world. Imports pxr, which is slow: import this where used."""

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from pxr import Usd, UsdGeom

from ..turns import BETWEEN, are_bent
from .instancers import Instance, are_finite, masking_attributes, transform_attributes, transform_ops, transform_times
from .samples import may_jump

TRANSLATIONS = {
    UsdGeom.XformOp.TypeTranslate,
    UsdGeom.XformOp.TypeTranslateX,
    UsdGeom.XformOp.TypeTranslateY,
    UsdGeom.XformOp.TypeTranslateZ,
}


class MeshTransforms:
    """The transforms to the world of a prim, or of all of its instances that one instancer places.

    Attributes:
        times: Time codes at which they have a sample, ascending.
        may_jump: Whether they may jump at a time.
        may_turn: Whether anything but translations changes them.
        moves: Whether the transform of each instance ever changes, shape [count], one without an instancer.
        stays: Whether it is the identity when the instance first exists, likewise.
        is_finite: Whether it is finite then, likewise.
    """

    def __init__(self, frame: Usd.Prim, instance: Instance | None):
        """Finds the times at which they change, given the prim whose space points are in, and one of the instances."""
        self._frame = frame
        self._masking = () if instance else masking_attributes(frame)
        self._root = instance.root if instance else None
        instancer = instance.instancer if instance else None
        self.times = sorted(transform_times(frame, self._root) | (instancer.times if instancer else set()))
        self.may_jump = may_jump(transform_attributes(frame, self._root)) or bool(instancer and instancer.may_jump)
        varying = (op.GetOpType() for op in self.ops(instance) if op.MightBeTimeVarying())
        self.may_turn = any(kind not in TRANSLATIONS for kind in varying) or bool(instancer and instancer.may_turn)
        self._cache = UsdGeom.XformCache()
        # Between samples as well, because a whole turn ends where it began.
        between = [start + BETWEEN * (end - start) for start, end in pairwise(self.times)]
        codes = [Usd.TimeCode.EarliestTime(), *map(Usd.TimeCode, sorted([*self.times, *between]))]
        first, were_there = (values.copy() for values in self.read(instance, codes[0]))
        # Some writers sample a transform at every time although it never changes.
        self.moves = np.zeros(len(first), dtype=bool)
        for code in codes[1:]:
            transforms, are_there = self.read(instance, code)
            differs = (transforms != first) & ~(np.isnan(transforms) & np.isnan(first))
            self.moves |= are_there & were_there & differs.any(axis=(1, 2))
            appears = are_there & ~were_there
            first[appears] = transforms[appears]
            were_there |= are_there
            if (self.moves & were_there).all():
                break
        self.stays: np.ndarray = (first == np.eye(4)).all(axis=(1, 2))
        self.is_finite = np.asarray(np.isfinite(first).all(axis=(1, 2)))
        self._bent: dict[tuple[float, float], np.ndarray] = {}

    def read(self, instance: Instance | None, time: Usd.TimeCode) -> tuple[np.ndarray, np.ndarray]:
        """Returns the result of :meth:`.Instancer.transforms`, or one matrix for a mesh without an instancer."""
        if instance:
            return instance.instancer.transforms(self._frame, instance.root, time)
        self._cache.SetTime(time)
        return self.compute(self._cache)[None], np.ones(1, dtype=bool)

    def read_one(self, instance: Instance | None, time: Usd.TimeCode) -> np.ndarray | None:
        """Returns the matrix of one instance, shape [4, 4]; None if it has none then."""
        return instance.transform(self._frame, time) if instance else self.read(None, time)[0][0]

    def compute(self, cache: UsdGeom.XformCache) -> np.ndarray:
        """Returns the matrix of a mesh without an instancer, finite or not, at the time of a cache, shape [4, 4]."""
        transform = np.array(cache.GetLocalToWorldTransform(self._frame))
        if not are_finite(self._masking, cache.GetTime()):
            transform[:] = np.nan
        return transform

    def bend(self, instance: Instance | None, start: float, end: float) -> np.ndarray:
        """Returns whether the transform of each instance leaves the straight path from one sample to the next."""
        if (start, end) not in self._bent:
            codes = Usd.TimeCode(start), Usd.TimeCode.PreTime(end), Usd.TimeCode(start + BETWEEN * (end - start))
            transforms, are_there = zip(*(self.read(instance, code) for code in codes), strict=True)
            self._bent[start, end] = are_bent(*transforms) & np.all(are_there, axis=0)
        return self._bent[start, end]

    def scales(self, instance: Instance | None, times: list[Usd.TimeCode]) -> list[float]:
        """Returns the largest stretch by an instance's transform at each time, to nine digits; [1] without times."""
        found = [self.read_one(instance, time) for time in times]
        scales = [
            np.linalg.norm(transform[:3, :3], 2)
            for transform in found
            if transform is not None and np.isfinite(transform).all()  # reading positions reports the others
        ]
        return [float(f"{scale:.9g}") for scale in scales] or [1.0]

    def ops(self, instance: Instance | None) -> Iterator[UsdGeom.XformOp]:
        """Yields the operations of an instance's transform, except those of instancers on their instances."""
        yield from transform_ops(self._frame, self._root)
        while instance:
            instancer = instance.instancer
            instance = instancer.parent
            yield from transform_ops(instancer.prim, instance.root if instance else None)
