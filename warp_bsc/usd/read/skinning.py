"""Deforms meshes by skeletons and blend shapes, with UsdSkel. Imports pxr, which is slow: import this where used."""

import numpy as np
from pxr import Sdf, Usd, UsdSkel, Vt

from .samples import may_jump, sample_times
from .unreadable import UnreadableError


class Skin:
    """The deformation of one mesh: blend shapes, then joints.

    Attributes:
        skeleton: The prim to whose space the joints transform the points, None if only blend shapes deform the mesh.
        times: Time codes at which the animation has a sample, or a weight is that of an in-between of a blend shape.
        may_jump: Whether it may jump at a time, see :func:`~warp_bsc.usd.read.samples.may_jump`.
    """

    def __init__(
        self,
        skinning: UsdSkel.SkinningQuery,
        skeleton: UsdSkel.Skeleton,
        skeleton_query: UsdSkel.SkeletonQuery,
        where: str,
    ):
        """Finds the animation of a binding, as of :func:`find_bindings`; messages say ``where``, file and prim."""
        self._where, self._skinning, self._query = where, skinning, skeleton_query
        self._animation = skeleton_query.GetAnimQuery()
        prim = skinning.GetPrim()
        self._blend_shapes: UsdSkel.BlendShapeQuery | None = None
        self._inbetweens: dict[int, set[float]] = {}  # weights at which its points bend, by shape with in-betweens
        if skinning.HasBlendShapes() and self._animation:
            self._blend_shapes = query = UsdSkel.BlendShapeQuery(UsdSkel.BindingAPI(prim))
            for number in range(query.GetNumSubShapes()):
                if inbetween := query.GetInbetween(number):
                    weight = inbetween.GetWeight() or 0.0
                    if not np.isfinite(weight):  # OpenUSD skips it
                        raise UnreadableError(f"{where}: the weight of an in-between of its blend shapes is not finite")
                    self._inbetweens.setdefault(query.GetBlendShapeIndex(number), {0.0, 1.0}).add(weight)
        # The prim of the query would be that of the prototype if the skeleton is in an instance.
        self.skeleton = skeleton.GetPrim() if skinning.HasJointInfluences() else None
        self._broken_joints = _find_broken_joints(skeleton_query) if self.skeleton else []
        self.times = set()
        animated = list(self._animation.GetPrim().GetAttributes()) if self._animation else []
        if self._animation:
            if self.skeleton:
                self._add_times(self._animation.GetJointTransformTimeSamples())
            if self._blend_shapes:
                self._add_times(self._animation.GetBlendShapeWeightTimeSamples())
                self.times |= self._find_bends()
        if self.skeleton:
            binding = UsdSkel.BindingAPI(prim)
            bound = binding.GetJointIndicesAttr(), binding.GetJointWeightsAttr(), binding.GetGeomBindTransformAttr()
            self.times |= sample_times(*bound)
            animated += bound
        self.may_jump = may_jump(animated)

    def deform(self, points: Vt.Vec3fArray, time: Usd.TimeCode) -> None:
        """Deforms points in place.

        Raises:
            UnreadableError: If the bindings are broken.
        """
        if self._blend_shapes:
            self._apply_blend_shapes(self._blend_shapes, points, time)
        if self.skeleton:
            self._check_joints(time)
            transforms = self._query.ComputeSkinningTransforms(time)
            if not transforms or not self._skinning.ComputeSkinnedPoints(transforms, points, time):
                raise UnreadableError(f"{self._where}: the binding to {self.skeleton.GetPath()} is broken")

    def _check_joints(self, time):
        """Raises an UnreadableError if the points follow a joint with a broken bind transform."""
        if self._broken_joints:
            indices, weights = map(np.array, self._skinning.ComputeJointInfluences(time))
            order = self._skinning.GetJointOrder() or self._query.GetJointOrder()
            used = {order[index] for index in indices[weights != 0.0].tolist() if 0 <= index < len(order)}
            for joint in self._broken_joints:
                if joint in used:
                    raise UnreadableError(f"{self._where}: the bind transform of joint {joint} has no inverse")

    def _find_bends(self) -> set[float]:
        """Returns the times between samples of the weights at which points bend, as a weight passes an in-between."""
        times = np.array(self._animation.GetBlendShapeWeightTimeSamples())
        if not self._inbetweens or len(times) < 2:
            return set()
        weights = [np.array(self._read_weights(Usd.TimeCode(time)) or (), dtype=float) for time in times.tolist()]
        bends = set()
        for shape, bent in self._inbetweens.items():
            values = np.array([some[shape] if shape < len(some) else np.nan for some in weights])
            for weight in bent:
                (passed,) = np.nonzero((values[:-1] - weight) * (values[1:] - weight) < 0.0)
                shares = (weight - values[passed]) / (values[passed + 1] - values[passed])
                bends.update((times[passed] + shares * (times[passed + 1] - times[passed])).tolist())
        return bends

    def _read_weights(self, time):
        """Returns the weights of the blend shapes of the mesh."""
        weights = self._animation.ComputeBlendShapeWeights(time)
        mapper = self._skinning.GetBlendShapeMapper()
        return mapper.Remap(weights) if mapper and not mapper.IsNull() else weights

    def _apply_blend_shapes(self, query, points, time):
        shapes = query.ComputeSubShapeWeights(self._read_weights(time))
        if not query.ComputeDeformedPoints(
            *shapes, query.ComputeBlendShapePointIndices(), query.ComputeSubShapePointOffsets(), points
        ):
            raise UnreadableError(f"{self._where}: the blend shapes do not fit the mesh")

    def _add_times(self, times):
        if len(times) > 1:
            self.times.update(times)


def _find_broken_joints(query: UsdSkel.SkeletonQuery) -> list[str]:
    """Returns the joints whose bind transforms have no inverse; OpenUSD replaces it by an arbitrary large matrix."""
    joints, transforms = query.GetJointOrder(), query.GetJointWorldBindTransforms()
    return [
        joint
        for joint, transform in zip(joints, transforms, strict=False)  # different numbers break the binding anyway
        if transform.GetDeterminant() == 0.0 or not np.isfinite(np.array(transform)).all()
    ]


def find_bindings(root: Usd.Prim) -> dict[Sdf.Path, tuple]:
    """Returns the bindings of the meshes below a ``SkelRoot``, the first three arguments of :class:`Skin`, by path."""
    cache = UsdSkel.Cache()
    schema = UsdSkel.Root(root)
    predicate = Usd.TraverseInstanceProxies()
    cache.Populate(schema, predicate)
    return {
        skinning.GetPrim().GetPath(): (skinning, binding.GetSkeleton(), cache.GetSkelQuery(binding.GetSkeleton()))
        for binding in cache.ComputeSkelBindings(schema, predicate)
        for skinning in binding.GetSkinningTargets()
    }
