"""The broad phase for a device."""

import numpy as np
import warp as wp

from ..mesh import CollisionMesh
from .broad_phase_hierarchy import BroadPhaseHierarchy
from .broad_phase_simd import BroadPhaseSimd

BroadPhase = BroadPhaseHierarchy | BroadPhaseSimd
"""Finds the candidates of a mesh: pairs of elements that share no vertex, and whose swept boxes overlap.

Of these, pairs that a coordinate axis separates at the start and at the end, on the same side, are left out.

A run only enqueues. Counts stay on the device, and the caller provides the queues of the results. Boxes are in single
precision, rounded so that no overlap is missed. An element with a position that is not finite has no pairs.

A run keeps the tree of the one before, and only fits its boxes; nothing is allocated on a GPU. The tree of a CPU is
sorted again where boxes have become much larger. The pairs are the same.
"""


def make_broad_phase(
    mesh: CollisionMesh,
    count: wp.array,
    *,
    capacity: int | None = None,
    not_finite: wp.array | None = None,
    only_used_vertices: bool = False,
    padding: wp.array | None = None,
) -> BroadPhase:
    """Returns the broad phase for a mesh's device.

    Args:
        mesh: The mesh.
        count: Number of pairs of faces found, zero before each run, array of one int64.
        capacity: Capacity for pairs of faces at first, on a GPU; None for the default.
        not_finite: Number of vertices with a position that is not finite, array of one int64, which a run adds to; None
            to count none.
        only_used_vertices: Whether vertices that no face uses are not counted.
        padding: How far the box of each vertex reaches beyond it, those of an edge or a face as far as the largest of
            its vertices, array of float64; None for boxes without a padding.
    """
    options = {"not_finite": not_finite, "checked": None, "padding": padding}
    if only_used_vertices and len(mesh.vertices) < mesh.vertex_count:
        used = np.isin(np.arange(mesh.vertex_count), mesh.vertices)
        options["checked"] = wp.array(used, dtype=int, device=mesh.device)
    if mesh.device.is_cpu:
        return BroadPhaseSimd(mesh, count, **options)
    return BroadPhaseHierarchy(mesh, count, capacity=capacity, **options)
