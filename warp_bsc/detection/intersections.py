"""Intersections of a mesh with itself in one configuration: edges that meet faces, exactly."""

import functools

import numpy as np
import warp as wp

from .. import checker
from .._arrays import check_finite
from ..kernels.crossing import edge_crosses_face
from ..kernels.signs import HIT, UNSURE
from .broad_phase import make_broad_phase
from .launch import retry_until_fits
from .mesh import CollisionMesh
from .settings import NO_GRADIENTS, Counters, capacity_for

__all__ = ["CrossingCandidates", "find_intersections"]


@functools.cache
def _classify_crossings(dtype: type) -> wp.Kernel:
    """The kernel that classifies pairs, for one type of position."""

    @wp.kernel(**NO_GRADIENTS)
    def classify_crossings(
        # mesh
        x: wp.array[dtype],
        edges: wp.array2d[int],
        faces: wp.array2d[int],
        # in
        pairs: wp.array[wp.vec2i],
        # out
        status: wp.array[int],
    ):
        i = wp.tid()
        edge = pairs[i][0]
        face = pairs[i][1]
        status[i] = edge_crosses_face(
            x[edges[edge, 0]], x[edges[edge, 1]], x[faces[face, 0]], x[faces[face, 1]], x[faces[face, 2]]
        )

    return classify_crossings


class CrossingCandidates:
    """The pairs (edge, face) whose boxes overlap.

    Attributes:
        pairs: Queue of the pairs, array of vec2i.
        counts: Counts of the pairs by :class:`Count`, on the device, array of int64.
        count: Number of pairs that the last :meth:`grow` has read.
    """

    def __init__(self, mesh: CollisionMesh):
        self._counters = Counters(mesh.device)
        self._broad_phase = make_broad_phase(mesh, self._counters.face_pairs)
        # the counts of the edges' pairs with faces take the place of those with edges
        self.counts = self._counters.edge_edge
        self.pairs = wp.empty(2 * len(mesh.faces), dtype=wp.vec2i, device=mesh.device)
        self.count = 0

    def find(self, x: wp.array) -> None:
        """Launches the broad phase."""
        self._counters.array.zero_()
        self._broad_phase.pair_edges_with_faces(x, self.counts, self.pairs)

    def grow(self) -> bool:
        """Enlarges the queues that were too small, and returns whether any was; synchronizes with the device."""
        counts = self._counters.read()
        self.count = counts.edge_edge.queued
        if counts.face_pairs <= self._broad_phase.capacity and self.count <= len(self.pairs):
            return False
        self._broad_phase.grow(counts.face_pairs)
        if self.count > len(self.pairs):
            capacity = capacity_for(self.count, "edge-face pairs")
            self.pairs = wp.empty(capacity, dtype=wp.vec2i, device=self.pairs.device)
        return True


def find_intersections(mesh: CollisionMesh, x: np.ndarray | wp.array) -> np.ndarray:
    """Returns the edges that meet faces in one configuration, exactly.

    Args:
        mesh: The mesh.
        x: Positions, any unit of length, shape [vertex_count, 3], float32 or float64, NumPy or Warp array. Those of
            vertices that no face uses may be anything.

    Returns:
        (edge, face) for every closed edge that meets a closed face it shares no vertex with, edges as in
        ``mesh.edges``, sorted, int32, shape [n, 2].

    Raises:
        ValueError: If the positions have another shape or type, or are not finite.
    """
    x = mesh.device_positions(x, "x")
    positions = x.numpy()
    check_finite(positions, "x", mesh.vertices)
    candidates = CrossingCandidates(mesh)
    retry_until_fits(lambda: candidates.find(x), candidates, mesh.device)
    status = wp.empty(candidates.count, dtype=int, device=mesh.device)
    inputs = [x, mesh.device_edges, mesh.device_faces, candidates.pairs]
    kernel = _classify_crossings(x.dtype)
    wp.launch(kernel, candidates.count, inputs=inputs, outputs=[status], device=mesh.device, record_tape=False)
    status = status.numpy()
    pairs = candidates.pairs.numpy()[: candidates.count]
    unsure = pairs[status == UNSURE]
    crossing = checker.edge_face_crossings(positions[mesh.edges[unsure[:, 0]]], positions[mesh.faces[unsure[:, 1]]])
    pairs = np.concatenate([pairs[status == HIT], unsure[crossing]])
    return pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
