"""The broad phase of a GPU: one traversal of a hierarchy of boxes over the faces finds all pairs of elements."""

import threading
from typing import Any

import warp as wp

from ...kernels.pipeline.hierarchy import WIDTH, count_set_bits, lowest_set_bit
from ...kernels.pipeline.queues import take_slots, write
from ..mesh import CollisionMesh
from ..run.launch import THREADS_OF_MULTIPROCESSOR, launch
from ..run.settings import capacity_for
from .element_pairs import Pairs, pair_edges_with_faces_kernel, pair_elements_kernel, pair_points_kernel
from .face_hierarchy import box_bundles, bundle_count, fit_kernel, make_hierarchy, traversal_kernel

_WARPS_OF_MULTIPROCESSOR = 128
"""Number of warps to aim at for a multiprocessor of a GPU in a traversal."""
_MAX_WARPS_OF_CLUSTER = 16
_TRAVERSAL_BLOCK = 128
"""Threads of a block of a traversal."""


@wp.func
def _enqueue_faces(place: int, first: int, found: wp.uint32, queue: Pairs):
    slot = take_slots(queue.counts, 0, count_set_bits(found))
    while found != wp.uint32(0):
        write(wp.vec2i(place, first + lowest_set_bit(found)), queue.pairs, slot)
        found = found & (found - wp.uint32(1))
        slot += wp.int64(1)


class BroadPhaseHierarchy:
    """The broad phase by a hierarchy over the faces, see :data:`warp_bsc.detection.broad.broad_phase.BroadPhase`.

    Attributes:
        lock: Held by each user of the broad phase from a run until its queues have been read.
        hierarchy: The hierarchy on the device; a run fits its boxes.
        face_pairs: The queue of the pairs of faces that a run finds, by place, array of vec2i.
    """

    def __init__(
        self,
        mesh: CollisionMesh,
        count: wp.array,
        *,
        capacity: int | None = None,
        not_finite: wp.array | None = None,
        checked: wp.array | None = None,
        padding: wp.array | None = None,
    ):
        """Allocates the hierarchy and the queue for pairs of faces.

        Args:
            mesh: The mesh.
            count: Number of pairs of faces found, zero before each run, array of one int64.
            capacity: Capacity of the queue at first; default: eight pairs a face.
            not_finite: Number of vertices with a position that is not finite, which a run adds to, array of one int64;
                None to count none.
            checked: Nonzero for each vertex that is counted, array of int; None for all.
            padding: How far the boxes of each vertex and its elements reach beyond them, array of float64, or None.
        """
        self.lock = threading.RLock()
        self._padding, self._swept = padding, False
        self._device = device = mesh.device
        self._count = count
        self._not_finite, self._checked = not_finite, checked
        self.hierarchy = make_hierarchy(mesh, padded=padding is not None)
        places = len(mesh.face_order)
        self._fitted = places + (0 if not_finite is None else mesh.vertex_count)
        self._clusters = places // WIDTH
        self._bundles = bundle_count(places)
        self._warps_of_cluster = 1
        if device.is_cuda and self._clusters:
            warps = _WARPS_OF_MULTIPROCESSOR * device.sm_count // self._clusters
            self._warps_of_cluster = max(1, min(_MAX_WARPS_OF_CLUSTER, warps))
        capacity = 8 * len(mesh.cells) if capacity is None else capacity
        self.face_pairs = wp.empty(capacity, dtype=wp.vec2i, device=device)

    @property
    def is_padded(self) -> bool:
        """Whether boxes reach beyond their elements."""
        return self._padding is not None

    @property
    def buffers(self) -> list[wp.array]:
        """All arrays that a run writes to and that may be replaced."""
        return [self.face_pairs]

    @property
    def capacity(self) -> int:
        """Capacity for pairs of faces."""
        return len(self.face_pairs)

    def grow(self, count: int) -> None:
        """Enlarges the queue if it is too small for the count."""
        if count > self.capacity:
            self.face_pairs = wp.empty(capacity_for(count, "face pairs"), dtype=wp.vec2i, device=self._device)

    def count_filtered_by_world(self, counts: wp.array) -> None:
        """Makes runs add the pairs of elements that groups and masks leave out to counts by world, array of int64."""
        self.hierarchy.filtered_of_worlds = counts

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
        self.pair_faces(x0, x1, changed, keep_separated)
        self._launch_over_pairs(pair_elements_kernel, *out)

    def pair_points(
        self, x0: wp.array, x1: wp.array, *out: wp.array, changed: wp.array | None = None, keep_separated: bool = False
    ) -> None:
        """Enqueues the candidates of points with the edges that no face has, and with points.

        Call it after :meth:`pair_elements`, whose pairs of cells it reads, with the same arguments but queues for
        (point, edge) and (point, point), the smaller first. A mesh without points has none.
        """
        self._launch_over_pairs(pair_points_kernel, *out)

    def pair_edges_with_faces(self, x: wp.array, counts: wp.array, pairs: wp.array, *, is_end: bool = False) -> None:
        """Enqueues the pairs (edge, face) of one configuration that share no vertex and whose boxes overlap.

        Args:
            x: Positions, array of vec3 or vec3d.
            counts: By :class:`Count`, array of int64.
            pairs: Queue for (edge, face), array of vec2i.
            is_end: Whether the positions are those at the end of the motion in the last :meth:`pair_elements`, whose
                boxes are reused on a CPU.
        """
        self.pair_faces(x, x)
        self._launch_over_pairs(pair_edges_with_faces_kernel, counts, pairs)

    def fit(self, x0: wp.array, x1: wp.array, changed: wp.array | None = None, *, keep_separated: bool = False) -> None:
        """Writes the corners and the boxes of all faces, and boxes all nodes; arguments as of :meth:`pair_elements`."""
        self._swept = keep_separated
        inputs = [x0, x1, changed, self._checked, self._padding, keep_separated, self.hierarchy]
        outputs = [self._not_finite]
        kernel = fit_kernel(x0.dtype, self.is_padded)
        launch(kernel, self._fitted, inputs=inputs, outputs=outputs, device=self._device, record_tape=False)
        if self._bundles:
            inputs = [self.hierarchy.clusters, self.hierarchy.bundles]
            launch(box_bundles, WIDTH * self._bundles, inputs=inputs, device=self._device, record_tape=False)

    def traverse(self, kernel: wp.Kernel, arguments: Any) -> None:
        """Launches a kernel of :func:`traversal_kernel` over the hierarchy, whose boxes were fitted, on no tape."""
        threads = self._clusters * self._warps_of_cluster * WIDTH
        inputs = [self.hierarchy, self._warps_of_cluster, arguments]
        launch(kernel, threads, inputs=inputs, device=self._device, block_dim=_TRAVERSAL_BLOCK, record_tape=False)

    def pair_faces(self, x0: wp.array, x1: wp.array, changed: wp.array | None = None, keep_separated=False) -> None:
        """Enqueues the pairs of faces that no axis separates, or all whose swept boxes overlap, each once."""
        self.fit(x0, x1, changed, keep_separated=keep_separated)
        self.traverse(traversal_kernel(_enqueue_faces, Pairs), _queue_of(self._count, self.face_pairs))

    def _launch_over_pairs(self, make_kernel, *out):
        threads = WIDTH if self._device.is_cpu else THREADS_OF_MULTIPROCESSOR * self._device.sm_count
        queues = [_queue_of(counts, pairs) for counts, pairs in zip(out[::2], out[1::2], strict=True)]
        inputs = [self.hierarchy, _queue_of(self._count, self.face_pairs), *queues, threads]
        launch(make_kernel(self.is_padded, self._swept), threads, inputs=inputs, device=self._device, record_tape=False)


def _queue_of(counts, pairs):
    queue = Pairs()
    queue.counts, queue.pairs = counts, pairs
    return queue
