"""Intersections of a mesh with itself in one configuration: edges that meet faces, exactly."""

import functools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ... import checker
from ..._arguments import check_finite, check_instance
from ..._one_thread import one_at_a_time
from ..._sorted_keys import distinct
from ...kernels.crossing import edge_beside_face, edge_crosses_face
from ...kernels.exact.edge_face import BITS, EdgeAndFace, edge_meets_face_in
from ...kernels.motion import double
from ...kernels.pipeline.queues import is_filled, take_slot
from ...kernels.signs import FREE, HIT, UNSURE
from ..broad.broad_phase import BroadPhase, make_broad_phase
from ..mesh import CollisionMesh, ElementsOfParts
from ..results.collisions import Collisions
from ..run.launch import launch_over, launch_over_queue, made_once, retry_until_fits
from ..run.settings import NO_GRADIENTS, UNLIMITED, Count, Counters, capacity_for

_PAIRS_OF_HIT = 8
"""Pairs of an edge and a face for each collision, roughly. If these are more than the edges, a search is faster."""


@made_once
def _keep_crossings(dtype: type) -> wp.Kernel:
    """Returns the kernel that keeps the pairs that are not certified apart, for one type of position."""

    @wp.kernel(**NO_GRADIENTS)
    def keep_crossings(
        first: int,
        # mesh
        x: wp.array[dtype],
        edges: wp.array2d[int],
        faces: wp.array2d[int],
        # in
        pairs: wp.array[wp.vec2i],
        # in and out
        counts: wp.array[wp.int64],
        # out
        kept: wp.array[wp.vec2i],
        status: wp.array[wp.int8],
    ):
        i = first + wp.tid()
        if not is_filled(i, pairs, counts, Count.QUEUED):
            return
        edge = pairs[i][0]
        face = pairs[i][1]
        p = x[edges[edge, 0]]
        q = x[edges[edge, 1]]
        a = x[faces[face, 0]]
        b = x[faces[face, 1]]
        c = x[faces[face, 2]]
        certified = edge_crosses_face(p, q, a, b, c)
        if certified == UNSURE:
            if edge_beside_face(p, q, a, b, c):
                certified = FREE
        if certified != FREE:
            slot = take_slot(counts, Count.FOUND)
            if slot < wp.int64(kept.shape[0]):
                kept[wp.int32(slot)] = pairs[i]
                status[wp.int32(slot)] = wp.int8(certified)

    return keep_crossings


@made_once
def _decide_exactly(dtype: type, limbs: int) -> wp.Kernel:
    """Returns the kernel that decides UNSURE pairs in wide integers, for one type of position and one width."""
    edge_meets_face = edge_meets_face_in(limbs)

    @wp.kernel(**NO_GRADIENTS)
    def decide_exactly(
        first: int,
        # mesh
        x: wp.array[dtype],
        edges: wp.array2d[int],
        faces: wp.array2d[int],
        across: wp.array2d[int],
        # in
        pairs: wp.array[wp.vec2i],
        # in and out
        status: wp.array[wp.int8],
    ):
        i = first + wp.tid()
        if int(status[i]) != UNSURE:
            return
        edge = pairs[i][0]
        face = pairs[i][1]
        points = EdgeAndFace()
        for j in range(2):
            points[j] = double(x[edges[edge, j]])
        for k in range(3):
            points[2 + k] = double(x[faces[face, k]])
            points[5 + k] = double(x[across[face, k]])
        status[i] = wp.int8(edge_meets_face(points))

    return decide_exactly


def _decided(
    mesh: CollisionMesh, x: wp.array, edges: wp.array, across: wp.array, pairs: wp.array, status: wp.array, count: int
) -> np.ndarray:
    """Returns the status of pairs (edge, face) after the exact phase, which overwrites ``status``.

    It is UNSURE only where exponents are too far apart. There is a pair at least.
    """
    for limbs in BITS:
        if not (status[:count].numpy() == UNSURE).any():
            break
        kernel, inputs = _decide_exactly(x.dtype, limbs), [x, edges, mesh.device_faces, across, pairs]
        launch_over(kernel, count, inputs=inputs, outputs=[status], device=mesh.device, block_dim=64)
    return status[:count].numpy()


def points_on_faces(mesh: CollisionMesh, x: np.ndarray, points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Returns which points are on which faces, exactly, pair by pair.

    Args:
        mesh: The mesh.
        x: Positions, finite, any unit of length, shape [vertex_count, 3], float32 or float64.
        points: The points, finite, of the same type, shape [n, 3].
        faces: The faces, integers, shape [n].

    Returns:
        Bool array of shape [n].
    """
    device, n = mesh.device, len(points)
    if not n:
        return np.zeros(0, dtype=bool)
    dtype = wp.vec3 if x.dtype == np.float32 else wp.vec3d
    positions = wp.array(np.concatenate([x, points]), dtype=dtype, device=device)
    rows = np.arange(n)
    edges = wp.array(np.repeat(len(x) + rows[:, None], 2, axis=1), dtype=int, device=device)  # both ends at one point
    pairs = wp.array(np.stack([rows, faces], axis=1), dtype=wp.vec2i, device=device)
    status = wp.full(n, int(UNSURE), dtype=wp.int8, device=device)
    # whether an edge passes through a face does not matter, so that any vertices across its sides will do
    status = _decided(mesh, positions, edges, mesh.device_faces, pairs, status, n)
    on_face = status != FREE
    (unsure,) = np.nonzero(status == UNSURE)
    if len(unsure):
        ends = np.repeat(points[unsure, None], 2, axis=1)
        on_face[unsure] = checker.edge_face_crossings(ends, x[mesh.faces[faces[unsure]]])
    return on_face


@dataclass(frozen=True, eq=False)
class Intersections:
    """The edges that meet faces in one configuration, exactly.

    Attributes:
        pairs: (edge, face) for every closed edge that meets a closed face it shares no vertex with, edges as in
            ``mesh.edges``, sorted, int32, shape [n, 2].
        crosses: Whether the edge passes through the face, as :func:`warp_bsc.checker.edges_pass_faces` defines it. All
            other edges only touch their face. Bool, shape [n].
        filtered: Number of pairs whose boxes overlap, but that groups and masks of the mesh leave out.
    """

    pairs: np.ndarray
    crosses: np.ndarray
    filtered: int = 0


class IntersectionFinder:
    """Finds the intersections of a mesh in one configuration after another, with buffers and trees that it reuses.

    Threads may share a finder: each call waits for the one before. Where it shares the trees of a detector, no other
    thread may detect a motion between the one whose end is given and that call.
    """

    def __init__(self, mesh: CollisionMesh, broad_phase: BroadPhase | None = None):
        """Allocates the buffers on the mesh's device.

        Args:
            mesh: The mesh.
            broad_phase: A broad phase that is shared if it has no queue of its own; otherwise a new one is made.
        """
        check_instance(mesh, "mesh", CollisionMesh, "a CollisionMesh")
        self._mesh, self._counters = mesh, Counters(mesh.device)
        if broad_phase is None or broad_phase.capacity < UNLIMITED:
            broad_phase = make_broad_phase(mesh, self._counters.face_pairs)
        self._broad_phase, self._lock = broad_phase, broad_phase.lock
        self._counts = self._counters.edge_edge  # serves for pairs (edge, face)
        self._pairs = wp.empty(2 * len(mesh.faces), dtype=wp.vec2i, device=mesh.device)
        self._allocate(len(mesh.faces))

    def find(self, x: ArrayLike | wp.array, *, is_end: bool = False) -> Intersections:
        """Returns the intersections of one configuration.

        Positions and errors are those of :meth:`.CollisionDetector.find_intersections`. With ``is_end`` the positions
        are those at the end of the motion that the given broad phase has boxed last, with all vertices of interest.
        """
        options = {"counts": self._counts, "is_end": is_end}
        return self._find(x, lambda x: self._broad_phase.pair_edges_with_faces(x, pairs=self._pairs, **options))

    def find_at_end(self, x: ArrayLike | wp.array, start: Intersections, collisions: Collisions) -> Intersections:
        """Returns the intersections at the end of a motion: those of :meth:`find`, on a CPU in less time.

        An edge and a face that are apart at the start and meet at the end have a first contact in between. There, an
        end of the edge is in the face, or the edge meets a side of the face: if only their interiors met, they would
        have met shortly before. The motion has a collision for either. Therefore only pairs that met at the start, and
        those of collisions, are decided.

        Args:
            x: Positions at the end, as of :meth:`find`.
            start: The intersections at the start.
            collisions: The collisions of the motion, the one that the given broad phase has boxed last, from a
                detector of the same mesh without a minimum distance.

        Raises:
            ValueError: As :meth:`find`.
        """
        hits = len(collisions.vertex_face) + len(collisions.edge_edge)
        is_slower = self._mesh.device.is_cuda or _PAIRS_OF_HIT * hits > len(self._mesh.edges)
        if is_slower or not collisions.certified or not self._has_sides:
            return self.find(x, is_end=True)
        pairs = self._pairs_that_may_meet(start, collisions)
        return self._find(x, lambda _: self._enqueue(pairs))

    def _enqueue(self, pairs: np.ndarray) -> None:
        """Enqueues given pairs, int32, shape [n, 2]."""
        self._counts[Count.QUEUED : Count.QUEUED + 1].fill_(len(pairs))
        if len(pairs) > len(self._pairs):
            self._pairs = wp.empty(len(pairs), dtype=wp.vec2i, device=self._pairs.device)
        if len(pairs):
            wp.copy(self._pairs, wp.array(pairs, dtype=wp.vec2i, device=self._pairs.device), count=len(pairs))

    @one_at_a_time
    def _find(self, x: ArrayLike | wp.array, enqueue: Callable[[wp.array], None]) -> Intersections:
        """Returns which of the pairs that a function enqueues for positions on the device meet."""
        mesh, given = self._mesh, x
        x = mesh.device_positions(x, "x")
        positions = x.numpy() if isinstance(given, wp.array) else np.asarray(given)
        check_finite(positions, "x", mesh.vertices)

        def launch() -> None:
            self._counters.array.zero_()
            enqueue(x)
            inputs = [x, mesh.device_edges, mesh.device_faces, self._pairs]
            outputs = [self._counts, self._kept, self._status]
            queue = self._pairs, self._counts, Count.QUEUED
            launch_over_queue(_keep_crossings(x.dtype), *queue, inputs=inputs, outputs=outputs)

        retry_until_fits(launch, self, mesh.device)
        if not self._count:
            return Intersections(np.zeros((0, 2), dtype=np.int32), np.zeros(0, dtype=bool), self._filtered)
        status = _decided(mesh, x, mesh.device_edges, mesh.device_across, self._kept, self._status, self._count)
        pairs = self._kept[: self._count].numpy()
        meets, crosses = status != FREE, status == HIT
        (unsure,) = np.nonzero(status == UNSURE)
        if len(unsure):
            edges, faces = pairs[unsure].T
            both = positions[mesh.edges[edges]], positions[mesh.faces[faces]]
            meets[unsure] = checker.edge_face_crossings(*both)
            crosses[unsure] = checker.edges_pass_faces(*both, positions[mesh.across[faces]])
        pairs, crosses = pairs[meets], crosses[meets]
        order = np.lexsort((pairs[:, 1], pairs[:, 0]))
        return Intersections(pairs[order], crosses[order], self._filtered)

    def grow(self) -> bool:
        """Enlarges the buffers that were too small, and returns whether any was; synchronizes with the device."""
        counts = self._counters.read()
        queued, found = counts.edge_edge.queued, counts.edge_edge.found
        self._count, self._filtered = found, counts.edge_edge.filtered
        grows = counts.face_pairs > self._broad_phase.capacity or queued > len(self._pairs) or found > len(self._kept)
        self._broad_phase.grow(counts.face_pairs)
        if queued > len(self._pairs):
            capacity = capacity_for(queued, "edge-face pairs")
            self._pairs = wp.empty(capacity, dtype=wp.vec2i, device=self._pairs.device)
        if found > len(self._kept):
            self._allocate(capacity_for(found, "intersections"))
        return grows

    def _allocate(self, capacity: int) -> None:
        made = (wp.empty(capacity, dtype=dtype, device=self._mesh.device) for dtype in (wp.vec2i, wp.int8))
        self._kept, self._status = made  # both or none

    def _pairs_that_may_meet(self, start: Intersections, collisions: Collisions) -> np.ndarray:
        """Returns the pairs (edge, face) that met at the start, or that a collision of their parts implies may meet.

        Pairs that share a vertex are excluded; each other pair is listed once. Shape [n, 2], int32.
        """
        mesh = self._mesh
        rows, edges = self._edges_of_vertices.find(collisions.vertex_face[:, 0])
        pairs = [start.pairs, np.stack([edges, collisions.vertex_face[rows, 1]], axis=1)]
        for one, other in (collisions.edge_edge.T, collisions.edge_edge[:, ::-1].T):
            rows, faces = mesh.edge_faces.find(other)
            pairs.append(np.stack([one[rows], faces], axis=1))
        keys = distinct(np.concatenate(pairs).astype(np.int64) @ np.array([len(mesh.faces), 1]))
        edges, faces = np.divmod(keys, max(1, len(mesh.faces)))
        apart = (mesh.edges[edges][:, :, None] != mesh.faces[faces][:, None, :]).all(axis=(1, 2))
        return np.stack([edges[apart], faces[apart]], axis=1).astype(np.int32)

    @functools.cached_property
    def _has_sides(self) -> bool:
        """Whether every face has an edge; one that names a vertex three times has none."""
        return not self._mesh.only_free and bool((self._mesh.face_edges >= 0).any(axis=1).all())

    @functools.cached_property
    def _edges_of_vertices(self) -> ElementsOfParts:
        return ElementsOfParts.of(self._mesh.edges, self._mesh.vertex_count)


def find_intersections(mesh: CollisionMesh, x: ArrayLike | wp.array) -> np.ndarray:
    """Returns the edges that meet faces in one configuration, exactly: :attr:`Intersections.pairs`.

    Arguments and errors are those of :meth:`IntersectionFinder.find`.
    """
    return IntersectionFinder(mesh).find(x).pairs
