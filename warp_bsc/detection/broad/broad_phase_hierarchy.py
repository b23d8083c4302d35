"""The broad phase of a GPU: one traversal of a hierarchy of boxes over the faces finds all pairs of elements."""

import threading
from collections.abc import Callable, Sequence
from typing import Any

import warp as wp

from ...kernels.pipeline.hierarchy import WIDTH, count_set_bits, lowest_set_bit
from ...kernels.pipeline.queues import take_slots, write
from ..mesh import CollisionMesh
from ..run.launch import THREADS_OF_MULTIPROCESSOR, launch
from ..run.settings import NO_GRADIENTS, capacity_for
from .element_pairs import Pairs, pair_edges_with_faces_kernel, pair_elements_kernel, pair_points_kernel
from .face_hierarchy import box_parents, fit_kernel, make_hierarchy, round_kernel, traversal_kernel

_WARPS_OF_MULTIPROCESSOR = 128
"""Number of warps to aim at for a multiprocessor of a GPU in a traversal."""
_MAX_WARPS_OF_CLUSTER = 16
CLUSTERS_OF_PART = 2**15
"""Clusters that are traversed at once: a million faces, whose pairs then leave the queue before those of others."""
_TRAVERSAL_BLOCK = 128
"""Threads of a block of a traversal."""
_LaunchOverFaces = tuple[Callable[[bool, bool], wp.Kernel], Sequence[Any]]
"""A function that makes a kernel, and its inputs, see :meth:`BroadPhaseHierarchy.pair_faces`."""


@wp.kernel(**NO_GRADIENTS)
def _keep_largest(
    # in
    counts: wp.array[wp.int64],
    # out
    largest: wp.array[wp.int64],
):
    """Writes the largest of some counts."""
    for i in range(counts.shape[0]):
        largest[0] = wp.max(largest[0], counts[i])


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
        face_pairs: The queue of the pairs of faces that a run finds, by place, array of vec2i; of a large mesh those of
            one part after the other, of which the count is the largest.
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
            capacity: Capacity of the queue at first; default: eight pairs a face of a part.
            not_finite: Number of vertices with a position that is not finite, which a run adds to, array of one int64;
                None to count none.
            checked: Nonzero for each vertex that is counted, array of int; None for all.
            padding: How far the boxes of each vertex and its elements reach beyond them, array of float64, or None.
        """
        self.lock = threading.RLock()
        self._padding, self._has_points, self._vertex_count = padding, len(mesh.points) > 0, mesh.vertex_count
        self._device = device = mesh.device
        self._count = count
        self._not_finite, self._checked = not_finite, checked
        self.hierarchy = make_hierarchy(mesh, padded=padding is not None)
        places = len(mesh.face_order)
        self._clusters = places // WIDTH
        self._warps_of_cluster = 1
        if device.is_cuda and self._clusters:
            warps = _WARPS_OF_MULTIPROCESSOR * device.sm_count // self._clusters
            self._warps_of_cluster = max(1, min(_MAX_WARPS_OF_CLUSTER, warps))
        self._part_counts = wp.zeros(max(1, self._clusters // CLUSTERS_OF_PART), dtype=wp.int64, device=device)
        capacity = 8 * len(mesh.cells) // len(self._part_counts) if capacity is None else capacity
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
                (edge, edge), the smaller first; if pairs of points are sought also those for (point, edge), of edges
                that no face has, and for (point, point), the smaller first.
            changed: Nonzero for each vertex whose pairs are sought, array of int; None for all. More than 1, by body,
                for those of rigid bodies, within which none are. What is not sought may be found as well.
            keep_separated: Whether to enqueue the pairs that an axis separates, too.
        """
        launches = [(pair_elements_kernel, _queues_of(*out[:4]))]
        if self._has_points and out[4:]:
            launches.append((pair_points_kernel, _queues_of(*out[4:])))
        self.pair_faces(x0, x1, changed, keep_separated, *launches)

    def pair_elements_again(self, x0: wp.array, x1: wp.array, *out: wp.array) -> None:
        """Enqueues as with ``keep_separated``, after a run with it whose paths contain those of now, axis by axis.

        All that is sought is then among the pairs of faces of that run; only a large mesh is traversed again.
        """
        if len(self._part_counts) > 1:
            self.pair_elements(x0, x1, *out, keep_separated=True)
            return
        self._fit_faces(x0, x1, None, rows_only=True)
        pairs = _queues_of(self._count, self.face_pairs)
        self._launch_over_faces(pairs, True, (pair_elements_kernel, _queues_of(*out[:4])))

    def pair_edges_with_faces(self, x: wp.array, counts: wp.array, pairs: wp.array, *, is_end: bool = False) -> None:
        """Enqueues the pairs (edge, face) of one configuration that share no vertex and whose boxes overlap.

        Args:
            x: Positions, array of vec3 or vec3d.
            counts: By :class:`Count`, array of int64.
            pairs: Queue for (edge, face), array of vec2i.
            is_end: Whether the positions are those at the end of the motion in the last :meth:`pair_elements`, whose
                boxes are reused on a CPU.
        """
        self.pair_faces(x, x, None, False, (pair_edges_with_faces_kernel, _queues_of(counts, pairs)))

    def fit(self, x0: wp.array, x1: wp.array, changed: wp.array | None = None, *, keep_separated: bool = False) -> None:
        """Writes the corners and the boxes of all faces, and boxes all nodes; arguments as of :meth:`pair_elements`."""
        tree, options = self.hierarchy, {"device": self._device, "record_tape": False}
        tree.swept = keep_separated
        self._fit_faces(x0, x1, changed)
        for children, parents in ((tree.clusters, tree.bundles), (tree.bundles, tree.groups)):
            if parents.boxes is not None:
                launch(box_parents, WIDTH * len(parents.boxes), inputs=[children, parents], **options)

    def _fit_faces(self, x0, x1, changed, *, rows_only=False):
        """Writes the corners and the boxes of faces; with ``rows_only`` no boxes, unless one kernel writes both."""
        tree, options = self.hierarchy, {"device": self._device, "record_tape": False}
        if not self.is_padded or self._not_finite is not None:
            inputs, outputs = [x0, x1, self._checked], [None if self.is_padded else tree.corners, self._not_finite]
            launch(round_kernel(x0.dtype), self._vertex_count, inputs=inputs, outputs=outputs, **options)
        if self.is_padded or not rows_only:
            inputs = [x0, x1, changed, self._padding, tree]
            launch(fit_kernel(x0.dtype, self.is_padded), len(tree.order), inputs=inputs, **options)

    def traverse(self, kernel: wp.Kernel, arguments: Any, first: int = 0, end: int | None = None) -> None:
        """Launches a kernel of :func:`traversal_kernel` over the hierarchy, whose boxes were fitted, on no tape.

        Args:
            kernel: The kernel.
            arguments: Its last argument.
            first: First cluster whose pairs with itself and later ones are visited.
            end: Last one, plus one; None for all.
        """
        threads = ((self._clusters if end is None else end) - first) * self._warps_of_cluster * WIDTH
        inputs = [self.hierarchy, first, self._warps_of_cluster, arguments]
        launch(kernel, threads, inputs=inputs, device=self._device, block_dim=_TRAVERSAL_BLOCK, record_tape=False)

    def pair_faces(
        self,
        x0: wp.array,
        x1: wp.array,
        changed: wp.array | None = None,
        keep_separated: bool = False,
        *launches: _LaunchOverFaces,
    ) -> None:
        """Enqueues the pairs of faces that no axis separates and few others, or all whose swept boxes overlap.

        Those of each part of a large mesh take the place of those of the part before, once kernels have gone over them:
        functions that make a kernel for boxes with a padding or without, swept or not, and its inputs, which follow the
        hierarchy and the queue; the last one is its threads.
        """
        self.fit(x0, x1, changed, keep_separated=keep_separated)
        parts = len(self._part_counts)
        if parts > 1:
            self._part_counts.zero_()
        for part in range(parts):
            count = self._part_counts[part : part + 1] if parts > 1 else self._count
            ends = [self._clusters * i // parts for i in (part, part + 1)]
            pairs = _queues_of(count, self.face_pairs)
            self.traverse(traversal_kernel(_enqueue_faces, Pairs, self.is_padded), *pairs, *ends)
            self._launch_over_faces(pairs, keep_separated, *launches)
        if parts > 1:
            options = {"device": self._device, "record_tape": False}
            launch(_keep_largest, 1, inputs=[self._part_counts], outputs=[self._count], **options)

    def _launch_over_faces(self, pairs, swept, *launches):
        threads = WIDTH if self._device.is_cpu else THREADS_OF_MULTIPROCESSOR * self._device.sm_count
        for make_kernel, others in launches:
            inputs = [self.hierarchy, *pairs, *others, threads]
            launch(make_kernel(self.is_padded, swept), threads, inputs=inputs, device=self._device, record_tape=False)


def _queues_of(*arrays):
    """Returns queues, each of its counts and its pairs."""
    queues = []
    for counts, pairs in zip(arrays[::2], arrays[1::2], strict=True):
        queue = Pairs()
        queue.counts, queue.pairs = counts, pairs
        queues.append(queue)
    return queues
