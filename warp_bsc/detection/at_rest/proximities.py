"""Proximities of a mesh with itself in one configuration: pairs of elements that are at most some distance apart."""

from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ... import checker
from ..._arguments import check_finite, check_instance, checked_choice, checked_coordinates, checked_distance
from ..._one_thread import one_at_a_time
from ...kernels.distance import DISTANCE_ERROR, closest_points
from ...kernels.motion import double
from ...kernels.pairs import points_of_pair
from ...kernels.pipeline.queues import is_filled, take_slot
from ...kernels.polynomials import EDGE_EDGE, VERTEX_FACE
from ..broad.broad_phase import make_broad_phase
from ..mesh import CollisionMesh
from ..narrow.exact_phase import are_within_distance
from ..narrow.on_host import pair_distances
from ..narrow.rings import Rings, are_within_rings, make_rings
from ..queries.query_points import mesh_of_rows
from ..run.launch import launch_over_queue, made_once, retry_until_fits
from ..run.settings import NO_GRADIENTS, Count, Counters, PairCounts, PairKind, capacity_for
from ..run.start import checked_device

_LARGEST = 2.0**1000
"""Largest coordinate: differences and their sums stay finite."""
_SMALLEST = 2.0**-1000
_FIRST_SEARCHED = 0.125
"""Distance within which the least distance is sought first, as a share of the mean length of an edge."""


@made_once
def _keep_proximities(dtype: type) -> wp.Kernel:
    """Returns the kernel that keeps the pairs that are near and not within the rings, for one type of position."""

    @wp.kernel(**NO_GRADIENTS)
    def keep_proximities(
        first: int,
        # mesh
        x: wp.array[dtype],
        kind: int,
        elements: wp.array2d[int],
        rings: Rings,
        # in
        distance: wp.float64,
        pairs: wp.array[wp.vec2i],
        # in and out
        counts: wp.array[wp.int64],
        # out
        kept: wp.array[wp.vec2i],
        kept_distance: wp.array[wp.float64],
        kept_position: wp.array[wp.vec3d],
    ):
        i = first + wp.tid()
        if not is_filled(i, pairs, counts, Count.QUEUED):
            return
        corners = points_of_pair(kind, elements, pairs[i])
        p = double(x[corners[0]])
        q = double(x[corners[1]])
        r = double(x[corners[2]])
        s = double(x[corners[3]])
        # vertex p with face q r s, which may have collapsed, or edge p q with edge r s
        u = r - q
        v = s - q
        w = p - q
        firsts = int(1)
        points = int(VERTEX_FACE)
        if kind == EDGE_EDGE:
            points = int(EDGE_EDGE)
            u = q - p
            v = s - r
            w = r - p
            firsts = 2
        coordinates, found, error = closest_points(points, u, v, w)
        if found > distance + error:
            return
        if are_within_rings(corners, firsts, rings):
            return
        slot = take_slot(counts, Count.FOUND)
        if slot < wp.int64(kept.shape[0]):
            one = p
            other = q + coordinates[0] * u + coordinates[1] * v
            if kind == EDGE_EDGE:
                one = p + coordinates[0] * u
                other = r + coordinates[1] * v
            k = wp.int32(slot)
            kept[k] = pairs[i]
            kept_distance[k] = found
            kept_position[k] = one + wp.float64(0.5) * (other - one)

    return keep_proximities


@dataclass(frozen=True, eq=False)
class Proximities:
    """The pairs of elements that are near each other in one configuration.

    Attributes:
        vertex_face: (vertex, face), sorted, int32, shape [n, 2].
        edge_edge: (edge, edge), the smaller first, edges as in ``mesh.edges``, sorted, int32, shape [m, 2].
        vertex_edge: (point, edge), edges that no face has, sorted, int32, shape [k, 2].
        vertex_vertex: (point, point), the smaller first, sorted, int32, shape [l, 2].
        distance: Distances of the pairs in the order of the attributes above, in the unit of the positions,
            float64, shape [n + m + k + l].
        position: Points halfway between the closest points, float64, shape [n + m + k + l, 3].
        filtered: Number of pairs that may be near, but that groups and masks of the mesh leave out.
    """

    vertex_face: np.ndarray
    edge_edge: np.ndarray
    vertex_edge: np.ndarray
    vertex_vertex: np.ndarray
    distance: np.ndarray
    position: np.ndarray
    filtered: int = 0


class _ProximityQueue:
    """The queue of candidates of one kind, and the proximities among them."""

    def __init__(self, kind: PairKind, counts: wp.array, capacity: int):
        self.kind, self.counts, self._device = kind, counts, counts.device
        self.candidates = wp.empty(capacity, dtype=wp.vec2i, device=self._device)
        self._allocate(capacity)
        self._count = 0

    def _allocate(self, capacity: int) -> None:
        made = (wp.empty(capacity, dtype=dtype, device=self._device) for dtype in (wp.vec2i, wp.float64, wp.vec3d))
        self.pairs, self.distance, self.position = made  # all or none

    def grow(self, queued: int, found: int) -> bool:
        """Enlarges the buffers that were too small for some counts, and returns whether any was."""
        self._count = found
        grows = queued > len(self.candidates) or found > len(self.pairs)
        if queued > len(self.candidates):
            capacity = capacity_for(queued, f"{self.kind.display_name} candidates")
            self.candidates = wp.empty(capacity, dtype=wp.vec2i, device=self._device)
        if found > len(self.pairs):
            self._allocate(capacity_for(found, f"{self.kind.display_name} proximities"))
        return grows

    def read(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns pairs, distances and positions, sorted by pair."""
        pairs = self.pairs.numpy()[: self._count]
        order = np.lexsort((pairs[:, 1], pairs[:, 0]))
        return pairs[order], self.distance.numpy()[: self._count][order], self.position.numpy()[: self._count][order]

    def launch(self, x: wp.array, elements: wp.array, rings: Rings, distance: float) -> None:
        """Keeps the candidates that are at most a distance apart, or may be."""
        inputs = [x, int(self.kind), elements, rings, wp.float64(distance), self.candidates]
        outputs = [self.counts, self.pairs, self.distance, self.position]
        queue = self.candidates, self.counts, Count.QUEUED
        launch_over_queue(_keep_proximities(x.dtype), *queue, inputs=inputs, outputs=outputs)


class ProximityFinder:
    """Finds the pairs of elements that are near each other in one configuration after another, with the same buffers.

    A pair is a vertex and a face, two edges, a point and an edge that no face has, or two points. Radii of the mesh are
    not counted. Pairs that share a vertex or that a few edges of the mesh join are excluded, since neighbours are
    always near. Threads may share a finder: each call waits for the one before.
    """

    def __init__(self, mesh: CollisionMesh, distance: float, *, rings: int = 1):
        """Allocates the buffers on the mesh's device; arguments as of :meth:`.CollisionDetector.find_proximities`."""
        check_instance(mesh, "mesh", CollisionMesh, "a CollisionMesh")
        self._mesh = mesh
        self._distance = checked_distance(distance, "distance", zero=False)
        self._counters = Counters(mesh.device)
        self._broad_phase = make_broad_phase(mesh, self._counters.face_pairs)
        self._lock = self._broad_phase.lock
        elements = len(mesh.faces) + len(mesh.free_edges) + len(mesh.points)
        self._queues = [_ProximityQueue(kind, getattr(self._counters, kind.label), 2 * elements) for kind in PairKind]
        self._rings = make_rings(mesh, rings)

    @one_at_a_time
    def find(self, x: ArrayLike | wp.array) -> Proximities:
        """Returns the proximities of one configuration.

        The pairs are exactly those whose distance is at most the given one: exact arithmetic decides where the computed
        distance is not certain. Distances are computed in double precision and off by at most 2^-40 of the
        largest component of the vectors along both edges of the face or along the two edges, and between the first
        corners.

        Args:
            x: Positions, any unit of length, shape [vertex_count, 3], float32 or float64, NumPy or Warp array, taken as
                exact. Those of vertices that no face uses may be anything.

        Raises:
            ValueError: If the positions have another shape or type, are not finite or more than 2^1000, or if the
                distance added to them is out of the range of their type.
        """
        mesh = self._mesh
        x = mesh.device_positions(x, "x")
        positions = x.numpy()
        check_finite(positions, "x", mesh.vertices)
        largest = float(np.abs(positions[mesh.vertices]).max(initial=0.0))
        if largest > _LARGEST:
            raise ValueError(f"x must be at most 2^1000 to have distances, not {largest:g}")
        lower, upper = self._enlarge(positions)
        retry_until_fits(lambda: self._launch(x, lower, upper), self, mesh.device)
        found = [self._decide(queue, x, largest) for queue in self._queues]
        vertex_face, edge_edge, vertex_edge, vertex_vertex = (pairs for pairs, _, _ in found)
        distance, position = (np.concatenate([rows[i] for rows in found]) for i in (1, 2))
        filtered = sum(counts.filtered for counts in self._counters.read().pairs.values())
        return Proximities(vertex_face, edge_edge, vertex_edge, vertex_vertex, distance, position, filtered)

    def _decide(self, queue: _ProximityQueue, x: wp.array, largest: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns pairs, distances and positions of a kind, without the pairs that are farther apart."""
        pairs, distance, position = queue.read()
        # differences of positions are at most twice the largest coordinate
        unsure = distance >= self._distance - 4.0 * float(DISTANCE_ERROR) * largest
        if not unsure.any():
            return pairs, distance, position
        elements = self._mesh.device_elements(queue.kind)
        (rows,) = np.nonzero(unsure)
        kept = np.ones(len(pairs), dtype=bool)
        kept[rows], known = are_within_distance(queue.kind, x, elements, pairs[rows], self._distance)
        rows = rows[~known]
        if len(rows):
            positions = x.numpy()
            corners, _ = pair_distances(queue.kind, elements.numpy(), pairs[rows], np.zeros(len(positions)))
            points = positions[corners]
            kept[rows] = getattr(checker, queue.kind.label)(np.concatenate([points, points], axis=1), self._distance)
        return pairs[kept], distance[kept], position[kept]

    def grow(self) -> bool:
        """Enlarges the buffers that were too small, and returns whether any was; synchronizes with the device."""
        counts = self._counters.read()
        grown = counts.face_pairs > self._broad_phase.capacity
        self._broad_phase.grow(counts.face_pairs)
        for queue in self._queues:
            grown |= queue.grow(counts.pairs[queue.kind].queued, counts.pairs[queue.kind].found)
        return grown

    def _enlarge(self, positions: np.ndarray) -> tuple[wp.array, wp.array]:
        """Returns positions moved down and up along all axes, by half of the distance or slightly more.

        The boxes of elements that move from one to the other are the boxes at rest, enlarged by as much on each side.
        Those of two elements overlap if the elements are at most the distance apart: rounding keeps the order of sums,
        if half of the distance is rounded up.
        """
        kind = positions.dtype.type
        with np.errstate(over="ignore", invalid="ignore"):
            pad = np.nextafter(kind(0.5 * self._distance), kind(np.inf))
            moved = positions - pad, positions + pad
        if not all(np.isfinite(x[self._mesh.vertices]).all() for x in moved):
            raise ValueError(f"distance must be in the range of the type of the positions, not {self._distance:g}")
        dtype = wp.vec3 if kind is np.float32 else wp.vec3d
        lower, upper = (wp.array(x, dtype=dtype, device=self._mesh.device) for x in moved)
        return lower, upper

    def _launch(self, x: wp.array, lower: wp.array, upper: wp.array) -> None:
        self._counters.array.zero_()
        queues = [array for queue in self._queues for array in (queue.counts, queue.candidates)]
        # all positions move from lower to upper: an axis that separates two elements at both ends may not separate
        # their enlarged boxes
        self._broad_phase.pair_elements(lower, upper, *queues, keep_separated=True)
        for queue in self._queues:
            queue.launch(x, self._mesh.device_elements(queue.kind), self._rings, self._distance)


def least_distance(mesh: CollisionMesh, x: ArrayLike | wp.array, rings: int) -> float:
    """Returns the least distance of two elements, see :meth:`.detector.CollisionDetector.least_distance`."""
    x = mesh.device_positions(x, "x")
    positions = x.numpy().astype(np.float64)
    check_finite(positions, "x", mesh.vertices)
    used, ends = positions[mesh.vertices], positions[mesh.edges]
    extent = float(np.linalg.norm(np.ptp(used, axis=0))) if len(used) else 0.0
    lengths = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    distance = max(_FIRST_SEARCHED * float(lengths.mean()) if len(lengths) else 0.0, 2.0**-20 * extent, _SMALLEST)
    while True:
        found = ProximityFinder(mesh, distance, rings=rings).find(x).distance
        if len(found):
            return float(found.min())
        if distance > extent:
            return np.inf
        distance *= 8.0


def distances(points: ArrayLike | wp.array, kind: str, *, device: wp.DeviceLike = None) -> np.ndarray:
    """Returns the distance of each pair of elements at rest.

    It is computed in double precision, and off by at most 2^-40 of the largest component of the vectors along both
    edges of the face or along the two edges, and between the first corners.

    Args:
        points: Positions, float32 or float64, rows p a b c of a vertex and a face or a b c d of two edges, shape
            [n, 4, 3]; rows p a b of a vertex and an edge, shape [n, 3, 3]; rows p q of two vertices, shape [n, 2, 3].
            Any unit of length. Those of the first half of a row of :func:`warp_bsc.query_points`.
        kind: "vertex_face", "edge_edge", "vertex_edge" or "vertex_vertex".
        device: Warp device to compute on; default: the points' own, or Warp's default for NumPy.

    Returns:
        Distances, float64, shape [n].

    Raises:
        TypeError: If an argument has another type.
        ValueError: If the points have another shape or type, are not finite, more than 2^1000 or 2^29 rows or more, or
            the kind or the device is unknown.
    """
    name = checked_choice(kind, "kind", [kind.label for kind in PairKind])
    of_kind = PairKind[name.upper()]
    if isinstance(points, wp.array):
        device = points.device if device is None else device
    points = checked_coordinates(points, (of_kind.points, 3), "points")
    largest = float(np.abs(points).max(initial=0.0))
    if largest > _LARGEST:
        raise ValueError(f"points must be at most 2^1000 to have distances, not {largest:g}")
    device = checked_device(device)
    x, elements, pairs = mesh_of_rows(of_kind, points, device)
    queue = _ProximityQueue(of_kind, wp.zeros(len(Count), dtype=wp.int64, device=device), len(points))
    queue.candidates.assign(pairs)
    queue.counts.assign(PairCounts(queued=len(points)))
    queue.launch(x, elements, Rings(), np.inf)
    queue.grow(len(points), len(points))
    return queue.read()[1]
