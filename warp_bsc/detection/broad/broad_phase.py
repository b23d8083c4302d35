"""The interface of a broad phase, and the broad phase for a device."""

import threading
from collections.abc import Sequence
from typing import Protocol

import numpy as np
import warp as wp

from ..mesh import CollisionMesh
from .broad_phase_hierarchy import BroadPhaseHierarchy
from .broad_phase_simd import BroadPhaseSimd


class BroadPhase(Protocol):
    """Finds the candidates of a mesh: pairs of elements that share no vertex, and whose swept boxes overlap.

    Of these, pairs that a coordinate axis separates at the start and at the end, on the same side, are left out.

    A run only enqueues. Counts stay on the device, and the caller provides the queues of the results. Boxes are in
    single precision, rounded so that no overlap is missed. An element with a position that is not finite has no pairs.

    A run keeps the tree of the one before, and only fits its boxes; nothing is allocated on a GPU. The tree of a CPU is
    sorted again where boxes have become much larger. The pairs are the same.

    Attributes:
        lock: Held by each user of the broad phase from a run until its queues have been read.
    """

    lock: threading.RLock

    @property
    def buffers(self) -> Sequence[wp.array]:
        """All arrays that a run writes to and that may be replaced."""
        ...

    @property
    def capacity(self) -> int:
        """Capacity for pairs of faces, :data:`UNLIMITED` without a queue for them."""
        ...

    def grow(self, count: int) -> None:
        """Enlarges the queue of pairs of faces if it is too small for the count."""
        ...

    def count_filtered_by_world(self, counts: wp.array) -> None:
        """Makes runs add the pairs of elements that groups and masks leave out to counts by world, array of int64."""
        ...

    def pair_elements(
        self, x0: wp.array, x1: wp.array, *out: wp.array, changed: wp.array | None = None, keep_separated: bool = False
    ) -> None:
        """Enqueues the candidates.

        Args:
            x0: Positions at the start, array of vec3 or vec3d.
            x1: Positions at the end, of the same type.
            out: Counts by :class:`Count`, array of int64, and queue for (vertex, face), array of vec2i; then those for
                (edge, edge), the smaller first.
            changed: Nonzero for each vertex whose pairs are sought, array of int; None for all. More than 1, by body,
                for those of rigid bodies, within which none are. What is not sought may be found as well.
            keep_separated: Whether to enqueue the pairs that an axis separates, too.
        """
        ...

    def pair_points(
        self, x0: wp.array, x1: wp.array, *out: wp.array, changed: wp.array | None = None, keep_separated: bool = False
    ) -> None:
        """Enqueues the candidates of points with the edges that no face has, and with points.

        Call it after :meth:`pair_elements`, with the same arguments but queues for (point, edge) and (point, point),
        the smaller first. A mesh without points has none.
        """
        ...

    def pair_edges_with_faces(self, x: wp.array, counts: wp.array, pairs: wp.array, *, is_end: bool = False) -> None:
        """Enqueues the pairs (edge, face) of one configuration that share no vertex and whose boxes overlap.

        Args:
            x: Positions, array of vec3 or vec3d.
            counts: By :class:`Count`, array of int64.
            pairs: Queue for (edge, face), array of vec2i.
            is_end: Whether the positions are those at the end of the motion in the last :meth:`pair_elements`, whose
                boxes are reused on a CPU.
        """
        ...


def make_broad_phase(
    mesh: CollisionMesh,
    count: wp.array,
    *,
    capacity: int | None = None,
    not_finite: wp.array | None = None,
    checked_vertices: np.ndarray | None = None,
    padding: wp.array | None = None,
) -> BroadPhase:
    """Returns the broad phase for a mesh's device.

    Args:
        mesh: The mesh.
        count: Number of pairs of faces found, zero before each run, array of one int64.
        capacity: Capacity for pairs of faces at first, on a GPU; None for the default.
        not_finite: Number of vertices with a position that is not finite, array of one int64, which a run on a GPU adds
            to; None to count none.
        checked_vertices: Indices of the vertices that are counted; None for all.
        padding: How far the box of each vertex reaches beyond it, those of an edge or a face as far as the largest of
            its vertices, array of float64; None for boxes without a padding.
    """
    if mesh.device.is_cpu:
        return BroadPhaseSimd(mesh, count, padding=padding)
    checked = None
    if checked_vertices is not None and len(checked_vertices) < mesh.vertex_count:
        checked = wp.array(np.isin(np.arange(mesh.vertex_count), checked_vertices), dtype=int, device=mesh.device)
    return BroadPhaseHierarchy(
        mesh,
        count,
        capacity=capacity,
        not_finite=not_finite,
        checked=checked,
        padding=padding,
    )
