"""Wide BVHs over elements on the CPU: packets of eight boxes, compared by SIMD instructions.

The trees are those of :mod:`warp_bsc.kernels.pipeline.wide_bvh`. Elements are sorted along a Hilbert curve of a grid
with 2^10 cells an axis, world by world. Along a Morton curve, packets are larger, and a third more of them overlap.
"""

from collections.abc import Sequence

import numpy as np
import warp as wp

from ...kernels.pairs import PairFilter
from ...kernels.pipeline.wide_bvh import WideBvh, fit_packet_of, pair_packet_of
from ..run.launch import Launch, launch_over, launch_together, made_once
from ..run.settings import NO_GRADIENTS, Count

_CODE_BITS = 10
"""Bits of a Hilbert code an axis."""
_LOOSE = 1.5
"""Trees are sorted again if the sum of the sizes of their packets has grown by this factor since they were sorted."""
_FEW = 2048
"""NumPy sorts fewer elements than these sooner than Warp, whose radix sort takes a fifth of a millisecond for none."""
_LARGEST_CELL = wp.constant(wp.float64((1 << _CODE_BITS) - 1))


@wp.func
def hilbert_transpose(cells: wp.vec3i) -> wp.vec3i:
    """Returns the position of a cell along a Hilbert curve: its bits alternate between those of the three numbers.

    John Skilling. "Programming the Hilbert Curve." AIP Conference Proceedings 707 (2004).
    https://doi.org/10.1063/1.1751381.
    """
    for level in range(_CODE_BITS - 1):
        bit = _CODE_BITS - 1 - level
        below = (1 << bit) - 1
        for axis in range(3):
            if (cells[axis] >> bit) & 1 == 1:
                cells[0] = cells[0] ^ below
            else:
                exchanged = (cells[0] ^ cells[axis]) & below
                cells[0] = cells[0] ^ exchanged
                cells[axis] = cells[axis] ^ exchanged
    cells[1] = cells[1] ^ cells[0]
    cells[2] = cells[2] ^ cells[1]
    turned = int(0)
    for bit in range(1, _CODE_BITS):
        if (cells[2] >> bit) & 1 == 1:
            turned = turned ^ ((1 << bit) - 1)
    return wp.vec3i(cells[0] ^ turned, cells[1] ^ turned, cells[2] ^ turned)


@made_once
def _kernels(dtype: type) -> tuple[wp.Kernel, wp.Kernel]:
    """Returns the kernels that encode elements and fit packets, for one type of position."""
    fit_packet = fit_packet_of(dtype)

    @wp.kernel(**NO_GRADIENTS)
    def encode(
        first: int,
        # in
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        corners: wp.array2d[int],
        worlds: wp.array[int],
        low: wp.vec3d,
        scale: wp.vec3d,
        # out
        codes: wp.array[wp.int64],
        order: wp.array[int],
    ):
        """Writes for each element its world and the Hilbert code of its first corner halfway, as one number to sort."""
        i = first + wp.tid()
        vertex = corners[i, 0]
        code = wp.int64(worlds[i])
        cells = wp.vec3i()
        for axis in range(3):
            x = wp.float64(0.5) * (wp.float64(x0[vertex][axis]) + wp.float64(x1[vertex][axis]))
            cells[axis] = wp.int32(wp.clamp((x - low[axis]) * scale[axis], wp.float64(0.0), _LARGEST_CELL))
        cells = hilbert_transpose(cells)
        for bit in range(_CODE_BITS):
            for axis in range(3):
                code = (code << wp.int64(1)) | wp.int64((cells[axis] >> (_CODE_BITS - 1 - bit)) & 1)
        codes[i] = code
        order[i] = i

    @wp.kernel(**NO_GRADIENTS)
    def fit_packets(
        first: int,
        # in
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        count: int,
        changed: wp.array[int],
        padding: wp.array[wp.float64],
        # in and out
        tree: WideBvh,
    ):
        """Writes the boxes of each packet, and its entry in its node."""
        packet = first + wp.tid()
        lanes = wp.min(8, count - 8 * packet)
        fit_packet(packet, lanes, x0, x1, changed, padding, tree)

    return encode, fit_packets


@wp.kernel(**NO_GRADIENTS)
def _fill_packets(
    first: int,
    # in
    corners: wp.array2d[int],
    numbers: wp.array[int],
    worlds: wp.array[int],
    order: wp.array[int],
    # out
    elements: wp.array2d[int],
    node_marks: wp.array3d[int],
):
    """Writes the elements of each packet in their order, and its worlds in its node."""
    packet = first + wp.tid()
    count = wp.min(8, corners.shape[0] - 8 * packet)
    for lane in range(count):
        i = order[8 * packet + lane]
        elements[packet, lane] = numbers[i]
        elements[packet, 32 + lane] = worlds[i]
        for corner in range(corners.shape[1]):
            elements[packet, 8 + 8 * corner + lane] = corners[i, corner]
    node_marks[packet / 8, 0, packet % 8] = elements[packet, 32]
    node_marks[packet / 8, 1, packet % 8] = elements[packet, 32 + count - 1]


@made_once
def _pairing_kernel(**constants: bool | int) -> wp.Kernel:
    """Returns the kernel that enqueues the pairs of two trees, see :func:`.wide_bvh.pair_packet_of`."""
    pair_packet = pair_packet_of(**constants, queued=int(Count.QUEUED), filtered=int(Count.FILTERED))

    @wp.kernel(**NO_GRADIENTS)
    def pair_packets(
        first: int,
        tree: WideBvh,
        traversed: WideBvh,
        pair_filter: PairFilter,
        keep_separated: int,
        # out
        counts: wp.array[wp.int64],
        filtered_of_worlds: wp.array[wp.int64],
        pairs: wp.array[wp.vec2i],
    ):
        """Enqueues the pairs of a packet's elements with those of a tree, a packet a thread."""
        packet = first + wp.tid()
        pair_packet(packet, tree, traversed, pair_filter, keep_separated, counts, filtered_of_worlds, pairs)

    return pair_packets


@wp.kernel(**NO_GRADIENTS)
def _join_nodes(
    first: int,
    # in
    start: int,
    above: int,
    # in and out
    nodes: wp.array3d[wp.float32],
    node_marks: wp.array3d[int],
):
    """Writes the box and the marks of each node of a level to the level above, given where both levels start."""
    i = first + wp.tid()
    node = start + i
    parent = above + i / 8
    lane = i % 8
    for row in range(6):  # low and high of an axis at one end
        low = wp.float32(wp.inf)
        high = wp.float32(-wp.inf)
        for child in range(8):
            low = wp.min(low, nodes[node, 2 * row, child])
            high = wp.max(high, nodes[node, 2 * row + 1, child])
        nodes[parent, 2 * row, lane] = low
        nodes[parent, 2 * row + 1, lane] = high
    last = int(-1)
    changed = int(0)
    for child in range(8):
        last = wp.max(last, node_marks[node, 1, child])
        changed = wp.max(changed, node_marks[node, 2, child])
    node_marks[parent, 0, lane] = node_marks[node, 0, 0]
    node_marks[parent, 1, lane] = last
    node_marks[parent, 2, lane] = changed


class WideTree:
    """A wide BVH over the elements of one kind: vertices, edges or faces."""

    def __init__(
        self,
        corners: np.ndarray,
        numbers: np.ndarray,
        world: np.ndarray | None,
        padding: wp.array | None = None,
        pair_filter: "PairFilter | None" = None,
    ):
        """Allocates a tree without boxes.

        Args:
            corners: Vertex indices of the elements, int32, shape [n, 1 to 3].
            numbers: Number of each element in pairs, int32, shape [n].
            world: World of each vertex, int32, shape [vertex_count]; None for one world.
            padding: How far boxes reach beyond an element, for each vertex, the largest of an element's, array of
                float64; None for boxes without a padding.
            pair_filter: Pairs that are left out; None for none.
        """
        self._padding = padding
        self._filter = PairFilter() if pair_filter is None else pair_filter
        n = len(corners)
        packets = -(-n // 8)
        width = -(-packets // 8)
        starts = [0, width]
        while width > 1:
            width = -(-width // 8)
            starts.append(starts[-1] + width)
        worlds = np.zeros(n, np.int32) if world is None else world[corners[:, 0]]
        device = "cpu"
        self._corners = wp.array(corners, dtype=int, device=device)
        self._numbers = wp.array(numbers, dtype=int, device=device)
        self._worlds = wp.array(worlds, dtype=int, device=device)
        self._codes = wp.empty(2 * n, dtype=wp.int64, device=device)
        self._order = wp.empty(2 * n, dtype=int, device=device)
        # lanes without an element keep an empty box, which overlaps no other, and the world -1
        empty = np.array([np.inf, -np.inf], dtype=np.float32).reshape(1, 2, 1)
        self._boxes = wp.array(np.tile(empty, (packets, 6, 8)), dtype=wp.float32, device=device)
        self._elements = wp.full((packets, 48), -1, dtype=int, device=device)
        self._nodes = wp.array(np.tile(empty, (starts[-1], 6, 8)), dtype=wp.float32, device=device)
        self._node_marks = wp.full((starts[-1], 3, 8), -1, dtype=int, device=device)
        self._starts = starts
        self._tree = tree = WideBvh()
        tree.corners, tree.level_starts = corners.shape[1], wp.array(starts, dtype=int, device=device)
        for name in ("boxes", "elements", "nodes", "node_marks"):
            setattr(tree, name, getattr(self, f"_{name}").flatten())
        self._size = self._sorted_size = 0.0  # of all packets, when fitted and when sorted
        self.is_sorted = False

    @property
    def is_loose(self) -> bool:
        """Whether the boxes fitted last are larger than those after sorting by more than a factor of :data:`_LOOSE`."""
        return self._size > _LOOSE * self._sorted_size

    def sort(self, x0: wp.array, x1: wp.array, low: np.ndarray, scale: np.ndarray) -> None:
        """Sorts the elements along a Hilbert curve of a grid from ``low`` on, with ``scale`` cells to a unit."""
        encode, _ = _kernels(x0.dtype)
        n, device = len(self._corners), self._corners.device
        inputs = [x0, x1, self._corners, self._worlds, wp.vec3d(low), wp.vec3d(scale)]
        launch_over(encode, n, inputs=inputs, outputs=[self._codes, self._order], device=device, chunk=16384)
        if n < _FEW:
            self._order.numpy()[:n] = np.argsort(self._codes.numpy()[:n], kind="stable")
        else:
            wp.utils.radix_sort_pairs(self._codes, self._order, n)
        inputs, outputs = [self._corners, self._numbers, self._worlds, self._order], [self._elements, self._node_marks]
        launch_over(_fill_packets, len(self._boxes), inputs=inputs, outputs=outputs, device=device, chunk=2048)
        self._sorted_size, self.is_sorted = 0.0, True

    def measure(self) -> None:
        """Computes the size of all packets, after they were fitted."""
        rows = self._nodes.numpy()[: self._starts[1]].reshape(-1, 3, 4, 8)
        with np.errstate(over="ignore"):
            sizes = np.maximum(rows[:, :, 1], rows[:, :, 3]) - np.minimum(rows[:, :, 0], rows[:, :, 2])
        self._size = float(np.clip(sizes, 0.0, np.finfo(np.float32).max).sum(dtype=np.float64))
        self._sorted_size = self._sorted_size or self._size

    def pairing(
        self,
        other: "WideTree",
        counts: wp.array,
        pairs: wp.array,
        *,
        ordered: bool = False,
        keep_separated: bool = False,
        at_end: bool = False,
        filtered_of_worlds: wp.array | None = None,
    ) -> Launch:
        """Returns the launch that enqueues the candidates between this tree and another, or within this tree.

        Args:
            other: The other tree, or this tree.
            counts: By :class:`Count`, array of int64.
            pairs: Queue of the candidates, array of vec2i.
            ordered: Whether the smaller number comes first; else that of this tree does.
            keep_separated: Whether to enqueue overlapping pairs that a coordinate axis separates, too.
            at_end: Whether to enqueue the pairs that overlap at the end of the motion.
            filtered_of_worlds: Counts of the pairs that are left out, by world, array of int64; None for none.
        """
        corners = {"corners": self._tree.corners, "other_corners": other._tree.corners}
        kernel = _pairing_kernel(**corners, symmetric=other is self, ordered=ordered, at_end=at_end)
        inputs = [self._tree, other._tree, self._filter, keep_separated, counts, filtered_of_worlds]
        return kernel, len(self._boxes) if len(other._boxes) else 0, inputs, [pairs]


def fit_trees(trees: Sequence[WideTree], x0: wp.array, x1: wp.array, changed: wp.array | None) -> None:
    """Fits packets and nodes of trees to a motion; arguments as of :meth:`.BroadPhaseHierarchy.pair_elements`."""
    _, fit_packets = _kernels(x0.dtype)
    inputs = [[x0, x1, len(tree._corners), changed, tree._padding] for tree in trees]
    fits = [(fit_packets, len(tree._boxes), of_tree, [tree._tree]) for tree, of_tree in zip(trees, inputs, strict=True)]
    launch_together(fits, device=x0.device, chunk=256)
    for level in range(max(len(tree._starts) for tree in trees) - 2):
        joins = []
        for tree in (tree for tree in trees if level < len(tree._starts) - 2):
            start, above = tree._starts[level : level + 2]
            joins.append((_join_nodes, above - start, [start, above], [tree._nodes, tree._node_marks]))
        launch_together(joins, device=x0.device, chunk=512)
    for tree in trees:
        tree.measure()


def sort_trees(trees: Sequence[WideTree], x0: wp.array, x1: wp.array, used: np.ndarray | slice) -> None:
    """Sorts trees on one grid around the used vertices of a motion."""
    ends = x0.numpy()[used], x1.numpy()[used]
    low = np.array([min(x[:, axis].min(initial=np.inf) for x in ends) for axis in range(3)])
    high = np.array([max(x[:, axis].max(initial=-np.inf) for x in ends) for axis in range(3)])
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        scale = np.nan_to_num((1 << _CODE_BITS) / (high - low), posinf=0.0)
    for tree in trees:
        tree.sort(x0, x1, low, scale)
