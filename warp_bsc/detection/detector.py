"""The collision detector: every collision of a mesh that moves from one configuration to another."""

from dataclasses import replace

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from .._arguments import as_numpy, check_instance, checked_distance
from .._one_thread import one_at_a_time
from .arcs.arc_detector import ArcDetector
from .arcs.rigid_motion import RigidMotion
from .at_rest.intersections import IntersectionFinder, find_intersections
from .at_rest.proximities import Proximities, ProximityFinder, least_distance
from .inversions import Inversions, inversions_of_motion
from .mesh import CollisionMesh
from .pipeline import DetectionPipeline
from .results.collision_finder import CollisionFinder
from .results.collisions import Candidates, CapturedCollisions, Collisions, DetectionStats, FreeStep
from .run.host_function import run_on_host
from .run.launch import retry_until_fits
from .run.settings import TOLERANCE, Counts, Method, PairKind

_SAMPLED = 64
"""Vertices whose collisions bound the earliest time of impact. In 92,230 triangles these take a twelfth of all."""
_SAMPLED_OF = 16 * _SAMPLED
"""Vertices of a mesh from which a sample is worth its time."""


class CollisionDetector:
    """Finds all collisions of a moving mesh: vertices with faces and edges with edges that share no vertex.

    Groups and masks of the mesh leave out pairs, here and in intersections and proximities.

    With a minimum distance, or with radii of the mesh, a pair collides if it comes within the sum of its two radii and
    that distance, touching included. The radius of an edge or a face is the largest one of its vertices. Radii are
    added and rounded in double precision; the sum counts as exact. Points of the mesh then also collide with edges that
    no face has, and with each other. Pairs that a few edges join are excluded, since neighbours are always near.

    Run one detection first to size the buffers. After that :meth:`capture` adds a detection to a CUDA graph, where it
    allocates nothing and does not synchronize, and which is replayed on new positions in the same arrays.

    Threads may share a detector: each detection waits for the one before, and its results do not change. To detect at
    the same time, make a detector for each thread; they may share the mesh.

    Attributes:
        mesh: The mesh.
        method: The method.
        tolerance: Tolerance of the times of impact, as a share of the step.
        min_distance: The minimum distance, in the unit of the positions.
    """

    def __init__(
        self,
        mesh: CollisionMesh,
        *,
        method: Method = "conservative",
        tolerance: float = TOLERANCE,
        min_distance: float = 0.0,
        rings: int = 1,
    ):
        """Prepares detection for a mesh, on its device.

        Args:
            mesh: The mesh.
            method: How to decide pairs that floating point cannot certify: "float" by the signs that it computes,
                "conservative" as hits, "exact" by exact arithmetic.
            tolerance: Of the times of impact, as a share of the step, in [2^-38, 1].
            min_distance: Distance up to which pairs collide, beside the radii of the mesh, in the unit of the
                positions: 0, or from 2^-1021 to 2^1000. With 0 and without radii pairs collide that touch.
            rings: With a minimum distance, pairs are excluded if a vertex of one is within this number of edges of the
                mesh of a vertex of the other; 0 excludes only those that share a vertex. With the default of 1 a flat
                grid at rest has no collisions at a distance below half of its shortest edge; triangles much thinner
                than their edges are long need more. Vertices must not have more than 256 others within it on average.

        Raises:
            TypeError: If an argument has another type.
            ValueError: If the method is unknown, or the tolerance, the distance or the rings are out of range.
        """
        check_instance(mesh, "mesh", CollisionMesh, "a CollisionMesh")
        self.mesh = mesh
        self._pipeline = DetectionPipeline(
            mesh, method=method, tolerance=tolerance, min_distance=min_distance, rings=rings, only_used_vertices=True
        )
        self.method: Method = method
        self.tolerance = self._pipeline.tolerance
        self.min_distance = checked_distance(min_distance, "min_distance")
        self._lock = self._pipeline.broad_phase.lock
        self._has_run = False
        self._finder = CollisionFinder(self._pipeline, self._lock)
        self._arcs = ArcDetector(self._pipeline, min_distance=self.min_distance, rings=rings)

    @one_at_a_time
    def detect(
        self,
        x0: ArrayLike | wp.array,
        x1: ArrayLike | wp.array,
        *,
        vertices: ArrayLike | None = None,
        rigid_motion: RigidMotion | None = None,
    ) -> Collisions:
        """Returns all collisions of a motion.

        With ``rigid_motion``, the vertices of turning bodies move along arcs, and no collision on these is missed. A
        pair with such a vertex may be reported that does not collide, if it comes within ``rigid_motion.tolerance`` of
        that, whatever the method. Its time of impact is a lower bound, before which it does not collide; its
        coordinates and normal are those of points within that distance. Pairs within a body that is rigid up to
        rounding, see :class:`.RigidMotion`, are left out, as they stay as they are; pairs without a turning body are
        those found without ``rigid_motion``. Counts are those of all parts of the step together. Without a body
        ``rigid_motion`` change nothing.

        Args:
            x0: Positions at the start, any unit of length, shape [vertex_count, 3], float32 or float64, NumPy or Warp
                array. They are taken as exact; those of vertices that no face uses may be anything. If it requires
                gradients, a Warp array of vec3 or vec3d on the mesh's device.
            x1: Positions at the end, of the same type; each vertex moves linearly from one to the other.
            vertices: Those of interest, bool, shape [vertex_count]: collisions that have none of them may be missing,
                at less cost. None for all.
            rigid_motion: The bodies that turn and how; None if all vertices move straight.

        Raises:
            TypeError: If the positions are no arrays of numbers, or ``rigid_motion`` is no :class:`.RigidMotion`.
            ValueError: If they or ``vertices`` have another shape or type, if the positions differ in type, or if they
                are not finite; with ``rigid_motion``, also if it is for another number of vertices, ``x1`` is too far
                from where it takes its bodies, coordinates are more than 2^500, its tolerance is too small for the
                rounding of positions, or the positions require gradients.
            RuntimeError: If the device captures a graph, see :meth:`capture`.
            MemoryError: If the memory of the device does not suffice; the message names what for, and what needs less.
        """
        self._check_not_capturing("call capture(x0, x1) there", " instead of detect")
        x0, x1 = self._checked_positions(x0, x1)
        changed = None if vertices is None else self._checked_vertices(vertices)
        arcs = self._checked_arcs(rigid_motion)
        if arcs is not None:
            return self._arcs.find(arcs, x0, x1, changed)
        self._has_run = True
        return self._finder.find(x0, x1, changed=changed)

    @one_at_a_time
    def collision_free_step(self, x0: ArrayLike | wp.array, x1: ArrayLike | wp.array) -> FreeStep:
        """Returns how far a motion goes before its first collision, and the positions there.

        On a CPU this takes less time than to detect all collisions of a motion that has an early one: those of a few
        vertices bound the earliest time, pairs are sought up to there, and tested on motions that are shortened until
        one is free. On a GPU, where all are soon detected, its several detections take more. Positions at its end are
        certified as they are rounded: go on from ``FreeStep.x``. The step ends before the earliest time of impact by
        about the tolerance of the detector, or by more where rounded positions collide. Positions and errors are those
        of :meth:`detect`.

        Returns:
            FreeStep: The whole motion if it is free, with ``x1``; ``x0``, not certified, if elements touch or are
            within the minimum distance there, or if "conservative" cannot tell.
        """
        self._check_not_capturing("find the step")
        start, end = (wp.clone(x, requires_grad=False) for x in self._checked_positions(x0, x1))
        ends, vertices = (start.numpy(), end.numpy().copy()), self.mesh.vertices  # the end is overwritten
        step = 1.0
        if len(vertices) >= _SAMPLED_OF:
            sample = np.zeros(self.mesh.vertex_count, dtype=bool)
            sample[vertices[:: len(vertices) // _SAMPLED]] = True
            step = min(1.0, self.detect(start, end, vertices=sample).earliest_toi)
        x, queued, retreat = ends[1], False, 2.0**-20  # where the rounded end collides, it is further back each time
        while True:
            x = _partway(*ends, step, x)
            end.assign(x)
            found = self._finder.find(start, end, keep_separated=True, queued=queued)
            if not found or step == 0.0:
                reached = wp.array(x, dtype=end.dtype, device=x1.device) if isinstance(x1, wp.array) else x
                return FreeStep(step, reached, found.free)
            step *= found.earliest_toi * (1.0 - retreat)
            queued, retreat = True, 2.0 * retreat

    @one_at_a_time
    def candidates(self, x0: ArrayLike | wp.array, x1: ArrayLike | wp.array) -> Candidates:
        """Returns the pairs that a detection tests, because their swept boxes overlap.

        Pairs share no vertex, and no coordinate axis separates them at the start and at the end, on the same side.
        Those that groups and masks leave out are not among them, but those within the rings of a minimum distance are.
        Positions and errors are those of :meth:`detect`; for one configuration give its positions twice.
        """
        self._check_not_capturing("find candidates")
        x0, x1 = self._checked_positions(x0, x1)
        pipeline = self._pipeline
        retry_until_fits(lambda: pipeline.find_candidates(x0, x1), pipeline, self.mesh.device)
        self._finder.check_counted_finite(x0, x1)
        found = {kind.label: np.zeros((0, 2), dtype=np.int32) for kind in PairKind}
        for phase in pipeline.narrow_phases:
            pairs = phase.queue.numpy()[: pipeline.counts.pairs[phase.kind].queued]
            found[phase.kind.label] = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
        return Candidates(**found)

    @one_at_a_time
    def capture(self, x0: wp.array, x1: wp.array, *, rigid_motion: RigidMotion | None = None) -> CapturedCollisions:
        """Adds a detection to the graph that the device captures, and returns its results, to be read after a replay.

        Each replay detects the collisions of the positions that the arrays then hold::

            detector.detect(x0, x1)
            with wp.ScopedCapture(device) as capture:
                captured = detector.capture(x0, x1)
            wp.capture_launch(capture.graph)
            collisions = captured.read()

        Args:
            x0: Positions at the start, as of :meth:`detect`, Warp array of vec3 or vec3d on the mesh's device. On the
                CPU it must not require gradients.
            x1: Positions at the end, of the same type.
            rigid_motion: The bodies that turn and how, as of :meth:`detect`, in each replay alike. On a GPU, detect
                with them once before; a replay in which a body is not rigid that was rigid then is not certified.

        Raises:
            TypeError: If the positions are no arrays of numbers, or ``rigid_motion`` is no :class:`.RigidMotion`.
            ValueError: If they have another shape or type, differ in type, are elsewhere, or require gradients on the
                CPU or with ``rigid_motion``.
            NotImplementedError: If a GPU is to capture ``rigid_motion`` of more than a quarter of a turn, or with a
                minimum distance or radii.
            RuntimeError: If the device captures no graph, or if a GPU captures one before the first :meth:`detect`, or
                before that with ``rigid_motion``.
        """
        device = self.mesh.device
        if not device.is_capturing:
            raise RuntimeError(f"{device} captures no graph: call capture(x0, x1) within wp.ScopedCapture, or detect")
        x0, x1 = self._checked_positions(x0, x1)
        arcs = self._checked_arcs(rigid_motion)
        if device.is_cpu:
            return self._capture_on_cpu(x0, x1, arcs)
        if arcs is None:
            if not self._has_run:
                raise RuntimeError(
                    "detect once before capturing, so that kernels are loaded and buffers are large enough"
                )
            return self._finder.capture(x0, x1)
        return self._arcs.capture(arcs, x0, x1)

    def find_intersections(self, x: ArrayLike | wp.array) -> np.ndarray:
        """Returns the edges that meet faces in one configuration, exactly.

        Args:
            x: Positions, any unit of length, shape [vertex_count, 3], float32 or float64, NumPy or Warp array. Those of
                vertices that no face uses may be anything.

        Returns:
            (edge, face) for every closed edge that meets a closed face it shares no vertex with, edges as in
            ``mesh.edges``, sorted, int32, shape [n, 2].

        Raises:
            TypeError: If the positions are no array of numbers.
            ValueError: If they have another shape or type, or are not finite.
        """
        return find_intersections(self.mesh, x)

    def has_intersections(self, x: ArrayLike | wp.array) -> bool:
        """Returns whether an edge meets a face in one configuration, exactly.

        Positions and errors are those of :meth:`find_intersections`.
        """
        return len(self.find_intersections(x)) > 0

    def inversions(self, x0: ArrayLike | wp.array, x1: ArrayLike | wp.array) -> Inversions:
        """Returns the tetrahedra of the mesh whose volume is 0 or negative at some time of a motion.

        Decided as by the method of the detector: "conservative" counts those that floating point cannot certify.

        Args:
            x0: Positions at the start, as of :meth:`detect`; those of vertices that no tetrahedron uses may be
                anything.
            x1: Positions at the end, of the same type.

        Raises:
            TypeError: If the positions are no arrays of numbers.
            ValueError: If they have another shape or type, differ in type, or are not finite.
            RuntimeError: If the device captures a graph.
        """
        self._check_not_capturing("find inversions")
        x0, x1 = self._checked_positions(x0, x1)
        return inversions_of_motion(self.mesh, x0, x1, method=self.method, tolerance=self.tolerance)

    def find_inversions(self, x: ArrayLike | wp.array) -> np.ndarray:
        """Returns the tetrahedra of the mesh whose volume is 0 or negative in one configuration, exactly.

        They are rows in ``mesh.tets``, sorted, int32, shape [n]. Positions and errors are those of :meth:`inversions`.
        """
        self._check_not_capturing("find inversions")
        x = self.mesh.device_positions(x, "x")
        return inversions_of_motion(self.mesh, x, x, method="exact", tolerance=self.tolerance).tets

    def find_proximities(self, x: ArrayLike | wp.array, distance: float, *, rings: int = 1) -> Proximities:
        """Returns the pairs of elements that are near each other in one configuration, exactly.

        Pairs are those of :meth:`detect`, points included, whether or not the detector has a minimum distance. Radii of
        the mesh are not counted.

        Args:
            x: Positions, any unit of length, shape [vertex_count, 3], float32 or float64, NumPy or Warp array. Those of
                vertices that no element uses may be anything.
            distance: Distance up to which pairs are near, in the unit of the positions, more than 0, taken as exact.
            rings: Pairs are excluded if a vertex of one is within this number of edges of a vertex of the other.

        Raises:
            TypeError: If an argument has another type.
            ValueError: If the positions have another shape or type, are not finite or more than 2^1000, the distance is
                not finite, less than 2^-1021 or out of the range of their type, or the rings are out of range.
        """
        return ProximityFinder(self.mesh, distance, rings=rings).find(x)

    def least_distance(self, x: ArrayLike | wp.array, *, rings: int = 1) -> float:
        """Returns the least distance of two elements in one configuration, in the unit of the positions.

        It is infinite without a pair. Pairs are those of :meth:`find_proximities`, whose arguments, accuracy and errors
        it has. An edge that passes through a face is no pair: ask :meth:`has_intersections` as well.
        """
        return least_distance(self.mesh, x, rings)

    def intersection_finder(self) -> IntersectionFinder:
        """Returns a finder of intersections that shares trees with this detector on a CPU, and its lock."""
        return IntersectionFinder(self.mesh, self._pipeline.broad_phase)

    def _check_not_capturing(self, what: str, instead: str = " outside of it") -> None:
        if self.mesh.device.is_capturing:
            raise RuntimeError(f"{self.mesh.device} captures a graph: {what}{instead}")

    def _checked_arcs(self, arcs: RigidMotion | None) -> RigidMotion | None:
        """Returns the motion of bodies, None if no vertex has one."""
        if arcs is None:
            return None
        check_instance(arcs, "rigid_motion", RigidMotion, "a RigidMotion")
        if len(arcs.body) != (count := self.mesh.vertex_count):
            raise ValueError(f"rigid_motion must have a body for {count} vertices, not {len(arcs.body)}")
        return arcs if (arcs.body >= 0).any() else None

    def _checked_vertices(self, vertices: ArrayLike) -> wp.array:
        """Returns which vertices are given, on the device, array of int."""
        mask, shape = as_numpy(vertices, "vertices", "an array of bool"), (self.mesh.vertex_count,)
        if mask.dtype != bool or mask.shape != shape:
            raise ValueError(f"vertices must be bool of shape {shape}, not {mask.dtype} {mask.shape}")
        return wp.array(mask, dtype=int, device=self.mesh.device)

    def _checked_positions(self, x0: ArrayLike | wp.array, x1: ArrayLike | wp.array) -> tuple[wp.array, wp.array]:
        """Returns the positions of a motion on the device, of one type."""
        x0 = self.mesh.device_positions(x0, "x0")
        x1 = self.mesh.device_positions(x1, "x1")
        if x0.dtype != x1.dtype:
            one, other = ("float32" if x.dtype == wp.vec3 else "float64" for x in (x0, x1))
            raise ValueError(f"x1 must be {one} as x0, not {other}: convert one of them, exactly if it becomes float64")
        return x0, x1

    def _capture_on_cpu(self, x0: wp.array, x1: wp.array, arcs: RigidMotion | None) -> CapturedCollisions:
        """Adds a detection to the graph that the CPU captures."""
        if x0.requires_grad or x1.requires_grad:
            raise ValueError("x0 and x1 must not require gradients in a graph on the CPU: detect outside the graph")
        replayed: list[Collisions] = []

        def detect() -> None:
            replayed[:] = [self.detect(x0, x1, rigid_motion=arcs)]

        def read() -> Collisions:
            if not replayed:
                raise RuntimeError("the graph in which this detection was captured has not been launched")
            return replayed[0]

        run_on_host(detect, self.mesh.device)
        return CapturedCollisions(None, read)


def _partway(x0: np.ndarray, x1: np.ndarray, share: float, last: np.ndarray) -> np.ndarray:
    """Returns positions after a share of a motion, rounded, between those at the start and the last ones."""
    with np.errstate(invalid="ignore", over="ignore"):  # of vertices that are not used
        x = ((1.0 - share) * x0.astype(np.float64) + share * x1.astype(np.float64)).astype(x0.dtype)
    return np.clip(x, np.minimum(x0, last), np.maximum(x0, last))


def stats_by_world(detector: CollisionDetector, collisions: Collisions) -> list[DetectionStats] | None:
    """Returns the counts of the last detection in each world of a mesh of faces, and the times of all.

    They are not known, None, if the exponents of a pair are too far apart for two limbs.

    Args:
        detector: The detector.
        collisions: The result of that detection, without ``rigid_motion``.
    """
    pipeline, mesh = detector._pipeline, detector.mesh
    if any(counts.too_wide_2 for counts in pipeline.counts.pairs.values()):
        return None
    assert mesh.world is not None
    worlds = mesh.world, mesh.world[mesh.edges[:, 0]]
    counts = [phase.counts_by_world(of) for phase, of in zip(pipeline.narrow_phases, worlds, strict=True)]
    return [replace(collisions, _counts=Counts(0, 0, *both)).stats for both in zip(*counts, strict=True)]
