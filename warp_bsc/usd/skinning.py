"""Meshes that a skeleton deforms, as UsdSkel itself computes them. Imports pxr: to be imported where it is used."""

from pxr import Usd, UsdSkel

from .stage import UnreadableError, sample_times

__all__ = ["Skin", "find_bindings"]


class Skin:
    """What deforms one mesh: blend shapes, then joints.

    Attributes:
        skeleton: The prim in whose space the points are when joints have moved them, None if only blend shapes do.
        times: Time codes at which the animation has a sample.
    """

    def __init__(self, skinning, skeleton, skeleton_query, where):
        self._where = where
        self._skinning = skinning
        self._query = skeleton_query
        self._animation = skeleton_query.GetAnimQuery()
        prim = skinning.GetPrim()
        self._blend_shapes = None
        if skinning.HasBlendShapes() and self._animation:
            self._blend_shapes = UsdSkel.BlendShapeQuery(UsdSkel.BindingAPI(prim))
        # Not the query's, which is that of the prototype if the skeleton is in an instance.
        self.skeleton = skeleton.GetPrim() if skinning.HasJointInfluences() else None
        self.times = set()
        if self._animation:
            if self.skeleton:
                self._add_times(self._animation.GetJointTransformTimeSamples())
            if self._blend_shapes:
                self._add_times(self._animation.GetBlendShapeWeightTimeSamples())
        if self.skeleton:
            binding = UsdSkel.BindingAPI(prim)
            self.times |= sample_times(
                binding.GetJointIndicesAttr(), binding.GetJointWeightsAttr(), binding.GetGeomBindTransformAttr()
            )

    def deform(self, points, time: Usd.TimeCode):
        """Deform points, a ``Vt.Vec3fArray``, in place.

        Raises:
            UnreadableError: If the bindings are broken.
        """
        if self._blend_shapes:
            self._apply_blend_shapes(points, time)
        if self.skeleton:
            transforms = self._query.ComputeSkinningTransforms(time)
            if not transforms or not self._skinning.ComputeSkinnedPoints(transforms, points, time):
                raise UnreadableError(f"{self._where}: the binding to {self.skeleton.GetPath()} is broken")

    def _apply_blend_shapes(self, points, time):
        weights = self._animation.ComputeBlendShapeWeights(time)
        mapper = self._skinning.GetBlendShapeMapper()
        if mapper and not mapper.IsNull():
            weights = mapper.Remap(weights)
        query = self._blend_shapes
        shapes = query.ComputeSubShapeWeights(weights)
        if not query.ComputeDeformedPoints(
            *shapes, query.ComputeBlendShapePointIndices(), query.ComputeSubShapePointOffsets(), points
        ):
            raise UnreadableError(f"{self._where}: the blend shapes do not fit the mesh")

    def _add_times(self, times):
        if len(times) > 1:
            self.times.update(times)


def find_bindings(root) -> dict:
    """What the meshes below a ``SkelRoot`` are bound to, by their paths: the first arguments of :class:`Skin`."""
    cache = UsdSkel.Cache()
    root = UsdSkel.Root(root)
    predicate = Usd.TraverseInstanceProxies()
    cache.Populate(root, predicate)
    return {
        skinning.GetPrim().GetPath(): (skinning, binding.GetSkeleton(), cache.GetSkelQuery(binding.GetSkeleton()))
        for binding in cache.ComputeSkelBindings(root, predicate)
        for skinning in binding.GetSkinningTargets()
    }
