"""The collision detector: every collision of a mesh that moves from one configuration to another."""

import functools
import time
from dataclasses import dataclass

import numpy as np
import warp as wp

from . import checker
from .arrays import checked_coordinates
from .broad_phase import BroadPhase
from .kernels.crossing import edge_crosses_face
from .kernels.signs import HIT, UNSURE
from .narrow_phase import TOLERANCE, StageCounts, check_method, check_tolerance, find_contacts

__all__ = ["CollisionDetector", "Collisions", "DetectionStats"]


@functools.cache
def _classify_crossings(dtype):
    """The kernel that says which edges meet which faces at rest, for one type of position."""

    @wp.kernel(enable_backward=False, module="unique")
    def classify_crossings(
        x: wp.array[dtype],
        edges: wp.array2d[int],
        faces: wp.array2d[int],
        pairs: wp.array[wp.vec2i],
        status: wp.array[int],
    ):
        i = wp.tid()
        edge = pairs[i][0]
        face = pairs[i][1]
        status[i] = edge_crosses_face(
            x[edges[edge, 0]], x[edges[edge, 1]], x[faces[face, 0]], x[faces[face, 1]], x[faces[face, 2]]
        )

    return classify_crossings


@dataclass(frozen=True)
class DetectionStats:
    """What a detection did.

    Attributes:
        vertex_face: How many vertex-face pairs entered or left each stage.
        edge_edge: How many edge-edge pairs entered or left each stage.
        milliseconds: Wall time by stage: "broad phase", "cull", "classify", "time of impact", "exact".
    """

    vertex_face: StageCounts
    edge_edge: StageCounts
    milliseconds: dict[str, float]


@dataclass(frozen=True)
class Collisions:
    """The collisions of one motion, sorted, the same on every run and every device.

    Attributes:
        vertex_face: (vertex, face), int32, shape [n, 2].
        edge_edge: (edge, edge), the smaller first, as in ``mesh.edges``, int32, shape [m, 2].
        vertex_face_toi: Times of impact as a share of the step, float64, shape [n]: no contact of the pair comes
            earlier. The first contact comes at most the tolerance later, but for what floating point could not
            certify and method "exact" was not asked to decide.
        edge_edge_toi: The same for the edges, float64, shape [m].
        vertex_face_coordinates: Barycentric coordinates of the contact in the face, float64, shape [n, 3].
        edge_edge_coordinates: (s, r, 0) along the two edges, float64, shape [m, 3].
        vertex_face_normal: Unit normals, against the velocity of the vertex relative to the face, float64, shape
            [n, 3].
        edge_edge_normal: Unit normals, against the velocity of the first edge relative to the second, float64,
            shape [m, 3].
        certified: Whether no collision of the motion can be missing. False for method "float".
        stats: Counts and times of every stage.
    """

    vertex_face: np.ndarray
    edge_edge: np.ndarray
    vertex_face_toi: np.ndarray
    edge_edge_toi: np.ndarray
    vertex_face_coordinates: np.ndarray
    edge_edge_coordinates: np.ndarray
    vertex_face_normal: np.ndarray
    edge_edge_normal: np.ndarray
    certified: bool
    stats: DetectionStats

    @property
    def earliest_toi(self):
        """The earliest time of impact, 2.0 if there is none."""
        return float(min(self.vertex_face_toi.min(initial=2.0), self.edge_edge_toi.min(initial=2.0)))


class CollisionDetector:
    """Finds all collisions of a moving mesh: vertices with faces and edges with edges that share no vertex."""

    def __init__(self, mesh, *, method="conservative", tolerance=TOLERANCE):
        """Prepares detection for a mesh, on its device.

        Args:
            mesh: The :class:`CollisionMesh`.
            method: What becomes of pairs that floating point cannot certify: "float" takes the signs that it computes,
                "conservative" counts them as hits, "exact" decides them exactly.
            tolerance: Of the times of impact, as a share of the step, in [2^-38, 1].

        Raises:
            ValueError: If there is no such method, or the tolerance is out of range.
        """
        check_method(method)
        check_tolerance(tolerance)
        self.mesh = mesh
        self.method = method
        self.tolerance = tolerance
        self._broad_phase = BroadPhase(mesh)

    def detect(self, x0, x1):
        """Finds the collisions of a motion.

        Args:
            x0: Positions at the start, any unit of length, shape [vertex_count, 3], float32 or float64, NumPy or Warp
                array. They are taken as exact.
            x1: Positions at the end, of the same type; each vertex moves linearly from one to the other.

        Returns:
            Collisions: All of them.

        Raises:
            ValueError: If the positions have another shape or type, differ in type, or are not finite.
        """
        x0 = self._positions(x0, "x0")
        x1 = self._positions(x1, "x1")
        if x0.dtype != x1.dtype:
            raise ValueError("x0 and x1 must have the same type")
        milliseconds = {"broad phase": 0.0}
        found = {}
        for kind, elements in (("vertex_face", self.mesh.device_faces), ("edge_edge", self.mesh.device_edges)):
            start = time.perf_counter()
            candidates = getattr(self._broad_phase, kind)(x0, x1)
            milliseconds["broad phase"] += 1000.0 * (time.perf_counter() - start)
            contacts = find_contacts(
                kind,
                x0,
                x1,
                elements,
                candidates,
                method=self.method,
                localize=self.method == "exact",
                tolerance=self.tolerance,
            )
            for stage, duration in contacts.milliseconds.items():
                milliseconds[stage] = milliseconds.get(stage, 0.0) + duration
            found[kind] = contacts
        vf, ee = found["vertex_face"], found["edge_edge"]
        return Collisions(
            vertex_face=vf.pairs[vf.hit],
            edge_edge=ee.pairs[ee.hit],
            vertex_face_toi=vf.toi[vf.hit],
            edge_edge_toi=ee.toi[ee.hit],
            vertex_face_coordinates=vf.coordinates[vf.hit],
            edge_edge_coordinates=ee.coordinates[ee.hit],
            vertex_face_normal=vf.normal[vf.hit],
            edge_edge_normal=ee.normal[ee.hit],
            certified=self.method != "float",
            stats=DetectionStats(vf.counts, ee.counts, milliseconds),
        )

    def find_intersections(self, x):
        """Finds the edges that meet faces in one configuration, exactly.

        Args:
            x: Positions, any unit of length, shape [vertex_count, 3], float32 or float64, NumPy or Warp array.

        Returns:
            (edge, face) for every closed edge that meets a closed face it shares no vertex with, edges as in
            ``mesh.edges``, sorted, int32, shape [n, 2].

        Raises:
            ValueError: If the positions have another shape or type, or are not finite.
        """
        x = self._positions(x, "x")
        mesh = self.mesh
        candidates = self._broad_phase.edge_face(x)
        status = wp.empty(len(candidates), dtype=int, device=mesh.device)
        wp.launch(
            _classify_crossings(x.dtype),
            len(candidates),
            inputs=[x, mesh.device_edges, mesh.device_faces, candidates],
            outputs=[status],
            device=mesh.device,
        )
        status = status.numpy()
        pairs = candidates.numpy().reshape(-1, 2)
        unsure = pairs[status == UNSURE]
        positions = x.numpy()
        crossing = checker.edge_face_crossings(positions[mesh.edges[unsure[:, 0]]], positions[mesh.faces[unsure[:, 1]]])
        pairs = np.concatenate([pairs[status == HIT], unsure[crossing]])
        return pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]

    def _positions(self, x, name):
        """Positions on the mesh's device as an array of vec3 or vec3d, checked."""
        values = checked_coordinates(x.numpy() if isinstance(x, wp.array) else x, (3,), name)
        if len(values) != self.mesh.vertex_count:
            raise ValueError(f"{name} must have {self.mesh.vertex_count} rows, one a vertex, got {len(values)}")
        dtype = wp.vec3 if values.dtype == np.float32 else wp.vec3d
        if isinstance(x, wp.array) and x.device == self.mesh.device and x.dtype == dtype:
            return x
        return wp.array(np.ascontiguousarray(values), dtype=dtype, device=self.mesh.device)
