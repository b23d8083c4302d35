"""The broad phase of a CPU: a wide BVH of packets of eight boxes, which SIMD instructions compare at once."""

import functools

import numpy as np
import warp as wp

from ..kernels.pipeline.boxes import rounded
from ..kernels.pipeline.wide_bvh import pair_packet
from .launch import launch_over
from .mesh import CollisionMesh
from .settings import NO_GRADIENTS, UNLIMITED, Count

__all__ = ["BroadPhaseSimd"]

_CODE_BITS = 10
_CANDIDATES = wp.constant(int(Count.CANDIDATES))
_QUEUED = wp.constant(int(Count.QUEUED))
_LARGEST_CELL = wp.constant(wp.float64((1 << _CODE_BITS) - 1))


@functools.cache
def _kernels(dtype):
    """The kernels that read positions, for one type of them."""

    @wp.kernel(**NO_GRADIENTS)
    def encode(
        first: int,
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        corners: wp.array2d[int],
        worlds: wp.array[int],
        low: wp.vec3d,
        scale: wp.vec3d,
        codes: wp.array[wp.int64],
        order: wp.array[int],
    ):
        """Writes the place of each element's first corner along a Morton curve, one world behind the other."""
        i = first + wp.tid()
        vertex = corners[i, 0]
        code = wp.int64(worlds[i])
        cells = wp.vec3i()
        for axis in range(3):
            x = wp.float64(0.5) * (wp.float64(x0[vertex][axis]) + wp.float64(x1[vertex][axis]))
            cells[axis] = wp.int32(wp.clamp((x - low[axis]) * scale[axis], wp.float64(0.0), _LARGEST_CELL))
        for bit in range(_CODE_BITS):
            for axis in range(3):
                code = (code << wp.int64(1)) | wp.int64((cells[axis] >> (_CODE_BITS - 1 - bit)) & 1)
        codes[i] = code
        order[i] = i

    @wp.kernel(**NO_GRADIENTS)
    def fill_packets(
        first: int,
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        corners: wp.array2d[int],
        numbers: wp.array[int],
        worlds: wp.array[int],
        order: wp.array[int],
        changed: wp.array[int],
        boxes: wp.array3d[wp.float32],
        elements: wp.array2d[int],
        nodes: wp.array3d[wp.float32],
        node_worlds: wp.array3d[int],
    ):
        packet = first + wp.tid()
        count = wp.min(8, corners.shape[0] - 8 * packet)
        low = wp.vec3(wp.inf)
        high = wp.vec3(-wp.inf)
        changed_lanes = int(0)
        for lane in range(count):
            i = order[8 * packet + lane]
            low0 = wp.vec3(wp.inf)
            high0 = wp.vec3(-wp.inf)
            low1 = wp.vec3(wp.inf)
            high1 = wp.vec3(-wp.inf)
            elements[packet, lane] = numbers[i]
            elements[packet, 32 + lane] = worlds[i]
            for corner in range(corners.shape[1]):
                vertex = corners[i, corner]
                elements[packet, 8 + 8 * corner + lane] = vertex
                if not changed or changed[vertex] != 0:
                    changed_lanes = changed_lanes | (1 << lane)
                start = rounded(x0[vertex])
                end = rounded(x1[vertex])
                low0 = wp.min(low0, start)
                high0 = wp.max(high0, start)
                low1 = wp.min(low1, end)
                high1 = wp.max(high1, end)
            for axis in range(3):
                boxes[packet, 4 * axis, lane] = low0[axis]
                boxes[packet, 4 * axis + 1, lane] = high0[axis]
                boxes[packet, 4 * axis + 2, lane] = low1[axis]
                boxes[packet, 4 * axis + 3, lane] = high1[axis]
            low = wp.min(low, wp.min(low0, low1))
            high = wp.max(high, wp.max(high0, high1))
        elements[packet, 40] = changed_lanes
        for axis in range(3):
            nodes[packet / 8, 2 * axis, packet % 8] = low[axis]
            nodes[packet / 8, 2 * axis + 1, packet % 8] = high[axis]
        node_worlds[packet / 8, 0, packet % 8] = elements[packet, 32]
        node_worlds[packet / 8, 1, packet % 8] = elements[packet, 32 + count - 1]

    return encode, fill_packets


@wp.kernel(**NO_GRADIENTS)
def _pair_packets(
    first: int,
    boxes: wp.array[wp.float32],
    elements: wp.array[int],
    corners: int,
    other_boxes: wp.array[wp.float32],
    other_elements: wp.array[int],
    other_corners: int,
    other_nodes: wp.array[wp.float32],
    other_node_worlds: wp.array[int],
    level_starts: wp.array[int],
    symmetric: int,
    keep_separated: int,
    counts: wp.array[wp.int64],
    pairs: wp.array[wp.vec2i],
):
    pair_packet(
        first + wp.tid(),
        boxes,
        elements,
        corners,
        other_boxes,
        other_elements,
        other_corners,
        other_nodes,
        other_node_worlds,
        level_starts,
        symmetric,
        keep_separated,
        counts,
        _CANDIDATES,
        _QUEUED,
        pairs,
    )


class _Tree:
    """A tree over the elements of one kind: vertices, edges or faces. See :mod:`warp_bsc.kernels.pipeline.wide_bvh`."""

    def __init__(self, corners, numbers, world):
        """Makes an empty tree.

        Args:
            corners: Vertex indices of the elements, int32, shape [n, 1 to 3].
            numbers: What the elements are called in pairs, int32, shape [n].
            world: World of each vertex, int32, or None: all in one.
        """
        n = len(corners)
        packets = -(-n // 8)
        starts = [0]
        width = packets
        while True:
            width = -(-width // 8)
            starts.append(starts[-1] + width)
            if width <= 1:
                break
        worlds = np.zeros(n, np.int32) if world is None else world[corners[:, 0]]
        device = "cpu"
        self._corners = wp.array(corners, dtype=int, device=device)
        self._numbers = wp.array(numbers, dtype=int, device=device)
        self._worlds = wp.array(worlds, dtype=int, device=device)
        self._level_starts = wp.array(starts, dtype=int, device=device)
        self._codes = wp.empty(2 * n, dtype=wp.int64, device=device)
        self._order = wp.empty(2 * n, dtype=int, device=device)
        # empty boxes, which overlap nothing, where there are less than eight; worlds of no element
        empty = np.array([np.inf, -np.inf], dtype=np.float32).reshape(1, 2, 1)
        self._boxes = wp.array(np.tile(empty, (packets, 6, 8)), dtype=wp.float32, device=device)
        self._elements = wp.full((packets, 41), -1, dtype=int, device=device)
        self._nodes = wp.array(np.tile(empty, (starts[-1], 3, 8)), dtype=wp.float32, device=device)
        self._node_worlds = wp.full((starts[-1], 2, 8), -1, dtype=int, device=device)

    def sort(self, x0, x1, low, scale):
        """Sorts the elements of a motion along a Morton curve.

        Args:
            x0: Positions at the start, Warp array of vec3 or vec3d.
            x1: Positions at the end, of the same type.
            low: Lowest coordinates of all, shape [3].
            scale: Cells of the sorting grid per unit of length, for each axis, shape [3].
        """
        encode, _ = _kernels(x0.dtype)
        n, device = len(self._corners), self._corners.device
        inputs = [x0, x1, self._corners, self._worlds, wp.vec3d(low), wp.vec3d(scale)]
        launch_over(encode, n, inputs=inputs, outputs=[self._codes, self._order], device=device, chunk=16384)
        wp.utils.radix_sort_pairs(self._codes, self._order, n)

    def fit(self, x0, x1, changed=None):
        """Boxes the elements of a motion, in the order that they are in.

        Args:
            x0: Positions at the start, Warp array of vec3 or vec3d.
            x1: Positions at the end, of the same type.
            changed: Which vertices have changed, array of int, None for all.
        """
        _, fill_packets = _kernels(x0.dtype)
        inputs = [x0, x1, self._corners, self._numbers, self._worlds, self._order, changed]
        outputs = [self._boxes, self._elements, self._nodes, self._node_worlds]
        device = self._corners.device
        launch_over(fill_packets, len(self._boxes), inputs=inputs, outputs=outputs, device=device, chunk=2048)
        nodes, worlds, starts = self._nodes.numpy(), self._node_worlds.numpy(), self._level_starts.numpy()
        for start, end, above in zip(starts, starts[1:], starts[2:], strict=False):
            _join(nodes[start:end, 0::2].min(axis=2), nodes[end:above, 0::2])
            _join(nodes[start:end, 1::2].max(axis=2), nodes[end:above, 1::2])
            _join(worlds[start:end, :1, 0], worlds[end:above, :1])
            _join(worlds[start:end, 1:].max(axis=2), worlds[end:above, 1:])

    def pair(self, other, counts, pairs, *, keep_separated=False):
        """Enqueues pairs of elements of this tree and of another or the same.

        See :func:`warp_bsc.kernels.pipeline.wide_bvh.pair_packet`.

        Args:
            other: The other tree.
            counts: By :class:`Count`, array of int64.
            pairs: Queue of the candidates that no axis separates, array of vec2i.
            keep_separated: Whether to enqueue those that an axis separates as well.
        """
        inputs = [
            self._boxes.flatten(),
            self._elements.flatten(),
            self._corners.shape[1],
            other._boxes.flatten(),
            other._elements.flatten(),
            other._corners.shape[1],
            other._nodes.flatten(),
            other._node_worlds.flatten(),
            other._level_starts,
            other is self,
            keep_separated,
            counts,
        ]
        launch_over(_pair_packets, len(self._boxes), inputs=inputs, outputs=[pairs], device=pairs.device, chunk=64)


def _join(children, parents):
    """Writes values of children, shape [n, m], to the lanes of their parents, shape [ceil(n / 8), m, 8]."""
    for lane in range(8):
        lanes = children[lane::8]
        parents[: len(lanes), :, lane] = lanes


class BroadPhaseSimd:
    """The broad phase by trees of SIMD packets, see :class:`warp_bsc.detection.broad_phase.BroadPhase`.

    It pairs elements directly, and has no queue for pairs of faces.
    """

    buffers: tuple[wp.array, ...] = ()
    capacity: int = UNLIMITED

    def __init__(self, mesh: CollisionMesh, count: wp.array):
        """Allocates trees over the vertices, the edges and the faces of a mesh; the count stays as it is."""
        self._used = mesh.vertices if len(mesh.vertices) < mesh.vertex_count else slice(None)
        self._vertices = _Tree(mesh.vertices.reshape(-1, 1), mesh.vertices, mesh.world)
        self._edges = _Tree(mesh.edges, np.arange(len(mesh.edges)), mesh.world)
        self._faces = _Tree(mesh.faces, np.arange(len(mesh.faces)), mesh.world)

    def grow(self, count: int) -> None:
        """Does nothing, as there is no queue."""

    def pair_elements(
        self,
        x0: wp.array,
        x1: wp.array,
        vertex_face_counts: wp.array,
        vertex_face: wp.array,
        edge_edge_counts: wp.array,
        edge_edge: wp.array,
        *,
        refit: bool = False,
        changed: wp.array | None = None,
    ) -> None:
        """Counts the candidates, and enqueues those that no coordinate axis separates."""
        self._build([self._vertices, self._edges, self._faces], x0, x1, refit, changed)
        self._vertices.pair(self._faces, vertex_face_counts, vertex_face)
        self._edges.pair(self._edges, edge_edge_counts, edge_edge)

    def pair_overlapping_elements(
        self, vertex_face_counts: wp.array, vertex_face: wp.array, edge_edge_counts: wp.array, edge_edge: wp.array
    ) -> None:
        """Enqueues all candidates of the last run."""
        self._vertices.pair(self._faces, vertex_face_counts, vertex_face, keep_separated=True)
        self._edges.pair(self._edges, edge_edge_counts, edge_edge, keep_separated=True)

    def pair_edges_with_faces(self, x: wp.array, counts: wp.array, pairs: wp.array) -> None:
        """Enqueues the pairs (edge, face) of one configuration that share no vertex and whose boxes overlap."""
        self._build([self._edges, self._faces], x, x, False)
        self._edges.pair(self._faces, counts, pairs)

    def _build(self, trees, x0, x1, refit, changed=None):
        """Builds trees for a motion, sorted on one grid around all that is used of it, or refits them."""
        if not refit:
            _sort(trees, x0, x1, self._used)
        for tree in trees:
            tree.fit(x0, x1, changed)


def _sort(trees, x0, x1, used):
    ends = x0.numpy()[used], x1.numpy()[used]
    low = np.array([min(x[:, axis].min(initial=np.inf) for x in ends) for axis in range(3)])
    high = np.array([max(x[:, axis].max(initial=-np.inf) for x in ends) for axis in range(3)])
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        scale = np.nan_to_num((1 << _CODE_BITS) / (high - low), posinf=0.0)
    for tree in trees:
        tree.sort(x0, x1, low, scale)
