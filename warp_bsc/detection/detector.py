"""The collision detector: every collision of a mesh that moves from one configuration to another."""

import functools
import time
import weakref
from dataclasses import dataclass

import numpy as np
import warp as wp

from .. import checker
from .._arrays import check_finite, checked_shape
from ..kernels.crossing import edge_crosses_face
from ..kernels.signs import HIT, UNSURE
from .broad_phase_bvh import BvhBroadPhase
from .broad_phase_simd import BlockBroadPhase
from .differentiable import CollisionArrays, put, take
from .host_function import run_on_host
from .narrow_phase import TOLERANCE, Count, NarrowPhase, check_method, check_tolerance, decide_exactly, roomy

__all__ = ["CollisionDetector", "Collisions", "DetectionStats", "StageCounts"]

_NOT_FINITE, _BROAD_PHASE, _VERTEX_FACE = range(3)
_EDGE_EDGE = _VERTEX_FACE + len(Count)
_COUNTS = _EDGE_EDGE + len(Count)
"""Places of the counts in one array; those of a kind of pair are by :class:`Count` from its place on."""


def _broad_phase(mesh, count):
    """The broad phase for the mesh's device."""
    return (BlockBroadPhase if mesh.device.is_cpu else BvhBroadPhase)(mesh, count)


@functools.cache
def _kernels(dtype):
    """The kernels for one type of position, each in a module of its own."""

    @wp.kernel(enable_backward=False, module="unique")
    def count_not_finite(x0: wp.array[dtype], x1: wp.array[dtype], vertices: wp.array[int], counts: wp.array[wp.int64]):
        vertex = wp.tid()
        if vertices:
            vertex = vertices[vertex]
        if not (wp.isfinite(x0[vertex]) and wp.isfinite(x1[vertex])):
            wp.atomic_add(counts, _NOT_FINITE, wp.int64(1))

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

    return count_not_finite, classify_crossings


@dataclass(frozen=True)
class StageCounts:
    """How many pairs of one kind entered or left each stage.

    Attributes:
        candidates: Pairs that share no vertex and whose swept boxes overlap.
        survivors: Candidates that the culls leave.
        free: Candidates certified free, by the culls or later.
        hits: Candidates certified to collide.
        unsure: Candidates that floating point could not certify either way.
        exact: Candidates that exact arithmetic decided on the device, or whose time of impact it found there.
        host: Candidates whose exponents are too far apart for that. The host decides them, but not in a CUDA graph,
            where they stay unsure.
    """

    candidates: int
    survivors: int
    free: int
    hits: int
    unsure: int
    exact: int
    host: int


@dataclass(frozen=True)
class DetectionStats:
    """What a detection did.

    Attributes:
        vertex_face: How many vertex-face pairs entered or left each stage.
        edge_edge: How many edge-edge pairs entered or left each stage.
        milliseconds: Time by stage: "broad phase", "cull", "classify", "time of impact", "sort", "exact". Empty for a
            detection in a CUDA graph.
    """

    vertex_face: StageCounts
    edge_edge: StageCounts
    milliseconds: dict[str, float]


class _StageClock:
    """Time between the ends of stages: by events on a GPU, which nobody waits for, else by the wall."""

    def __init__(self, device):
        self._device = device
        self._laps = []
        self.lap(None)

    def lap(self, stage):
        if self._device.is_cuda:
            event = wp.Event(self._device, enable_timing=True)
            wp.get_stream(self._device).record_event(event)
            self._laps.append((stage, event))
        else:
            self._laps.append((stage, time.perf_counter()))

    def read(self):
        milliseconds = {}
        for (_, start), (stage, end) in zip(self._laps, self._laps[1:], strict=False):
            passed = wp.get_event_elapsed_time(start, end) if self._device.is_cuda else 1000.0 * (end - start)
            milliseconds[stage] = milliseconds.get(stage, 0.0) + passed
        return milliseconds


class Collisions:
    """The collisions of one motion, sorted, the same on every run and every device.

    They stay on the device until an attribute is asked for, or until the next detection would overwrite them. Those of
    a detection in a graph are read anew each time: on CUDA they say what the detector found last, on the CPU what the
    last replay found.

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
        edge_edge_normal: Unit normals, against the velocity of the first edge relative to the second, float64, shape
            [m, 3].
        earliest_toi: The earliest time of impact, 2.0 if there is none.
        overflowed: Whether a queue was too small, so that collisions are missing. Only a detection in a CUDA graph can
            overflow: detect once outside a graph, which makes the queues larger, and capture again.
        certified: Whether no collision of the motion can be missing, and for method "exact" none is that is none. False
            for method "float", and if a queue overflowed, a position was not finite, or a pair was left to the host in
            a CUDA graph.
        stats: Counts and times of every stage.
        arrays: The collisions on the device, with gradients, :class:`CollisionArrays`; None unless ``x0`` or ``x1``
            requires gradients.
    """

    def __init__(self, detector, clock):
        self.arrays = None
        self._detector = detector
        self._clock = clock  # None in a CUDA graph
        self._run = detector._run
        self._growth = detector._growth
        self._read = None
        self._replayed = None  # on the CPU the results of the last replay

    def _results(self):
        """The results by name, from the device if need be."""
        if self._read is not None:
            return self._read
        if self._replayed is not None:
            return self._replayed._results()
        if self._clock is None:
            if self._detector.mesh.device.is_cpu:
                raise RuntimeError("the graph in which this detection was captured has not been launched")
            if self._growth != self._detector._growth:
                raise RuntimeError("the detector's queues have grown since this detection was captured: capture again")
            return self._detector._read(None)
        if self._run != self._detector._run:
            raise RuntimeError("these collisions were not read before another detection was captured, and are gone")
        self._keep()
        return self._read

    def _keep(self, *positions):
        """Reads the results, unless they have been read or are gone."""
        if self._read is None and self._run == self._detector._run:
            self._read = self._detector._read(self._clock, *positions)

    def __getattr__(self, name):
        """Reads the results from the device."""
        if name.startswith("_"):
            raise AttributeError(name)
        results = self._results()
        if name not in results:
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        return results[name]


class CollisionDetector:
    """Finds all collisions of a moving mesh: vertices with faces and edges with edges that share no vertex.

    Once its queues are large enough, which a detection sees to that is not captured, a detection allocates nothing and
    asks the device nothing, and can be captured in a CUDA graph and replayed on new positions in the same arrays.

    Attributes:
        mesh: The mesh.
        method: The method.
        tolerance: Of the times of impact, as a share of the step.
        counts: What the last detection counted, Warp array of int64.
        capacities: How much room there is for each count, and none for positions that are not finite, Warp array of
            int64: where a count is larger, something is missing.
    """

    def __init__(self, mesh, *, method="conservative", tolerance=TOLERANCE):
        """Prepares detection for a mesh, on its device.

        Args:
            mesh: The :class:`CollisionMesh`.
            method: What becomes of pairs that floating point cannot certify: "float" takes the signs that it
                computes, "conservative" counts them as hits, "exact" decides them exactly.
            tolerance: Of the times of impact, as a share of the step, in [2^-38, 1].

        Raises:
            ValueError: If there is no such method, or the tolerance is out of range.
        """
        check_method(method)
        check_tolerance(tolerance)
        self.mesh = mesh
        self.method = method
        self.tolerance = tolerance
        self._run = 0
        self._growth = 0
        self._captured = False
        self._retired = []  # queues that a CUDA graph may still write to
        self._last = lambda: None  # the last results, as long as someone holds them
        self._side_stream = wp.Stream(mesh.device) if mesh.device.is_cuda else None
        self.counts = wp.zeros(_COUNTS, dtype=wp.int64, device=mesh.device)
        faces = len(mesh.faces)
        self._broad_phase = _broad_phase(mesh, self.counts[_BROAD_PHASE:_VERTEX_FACE])
        self._vertex_face = NarrowPhase(
            "vertex_face", self.counts[_VERTEX_FACE:_EDGE_EDGE], faces, (mesh.vertex_count, faces)
        )
        self._edge_edge = NarrowPhase(
            "edge_edge", self.counts[_EDGE_EDGE:_COUNTS], 2 * faces, (len(mesh.edges), len(mesh.edges))
        )

        self.capacities = wp.array(self._room(), dtype=wp.int64, device=mesh.device)

    def detect(self, x0, x1):
        """Finds the collisions of a motion.

        Args:
            x0: Positions at the start, any unit of length, shape [vertex_count, 3], float32 or float64, NumPy or Warp
                array. They are taken as exact; those of vertices that no face uses are not looked at. In a CUDA graph,
                or if it requires gradients, a Warp array of vec3 or vec3d on the mesh's device.
            x1: Positions at the end, of the same type; each vertex moves linearly from one to the other.

        Returns:
            Collisions: All of them.

        Raises:
            ValueError: If the positions have another shape or type, differ in type, or are not finite.
            RuntimeError: If the first detection is captured in a CUDA graph.
        """
        capturing = self.mesh.device.is_capturing
        x0 = self._positions(x0, "x0", capturing)
        x1 = self._positions(x1, "x1", capturing)
        if x0.dtype != x1.dtype:
            raise ValueError("x0 and x1 must have the same type")
        if capturing and self.mesh.device.is_cpu:
            return self._capture_on_cpu(x0, x1)
        if capturing and self._run == 0:
            raise RuntimeError("detect once before capturing, so that kernels are loaded and queues are large enough")
        if capturing:
            self._run += 1
            self._captured = True
            self._launch(x0, x1)
            collisions = Collisions(self, None)
            if x0.requires_grad or x1.requires_grad:
                found = {n.kind: take(n.contacts, n.counts) for n in self.narrow_phases}
                collisions.arrays = CollisionArrays(x0, x1, self.mesh, self.tolerance, found)
            return collisions
        last = self._last()
        if last is not None:
            last._keep()
        self._run += 1
        while True:
            clock = _StageClock(self.mesh.device)
            self._launch(x0, x1, clock)
            counts = self.counts.numpy()
            if counts[_NOT_FINITE]:
                for name, x in (("x0", x0), ("x1", x1)):
                    check_finite(x.numpy(), name, self.mesh.vertices)
            if not self._overflowed(counts):
                break
            self._grow(counts)
        collisions = Collisions(self, clock)
        self._last = weakref.ref(collisions)
        left = counts[[_VERTEX_FACE + Count.WIDEST, _EDGE_EDGE + Count.WIDEST]].any()
        if left:
            collisions._keep(x0, x1)  # what is left to the host, now, while the positions are what they were
        if x0.requires_grad or x1.requires_grad:
            if left:
                found = {n.kind: put(collisions._results(), n.kind, self.mesh.device) for n in self.narrow_phases}
            else:
                found = {n.kind: take(n.contacts, n.counts, n.counts.numpy()) for n in self.narrow_phases}
            collisions.arrays = CollisionArrays(x0, x1, self.mesh, self.tolerance, found)
        return collisions

    def _capture_on_cpu(self, x0, x1):
        """Adds a detection to the graph that the CPU captures."""
        if x0.requires_grad or x1.requires_grad:
            raise ValueError("a graph on the CPU cannot capture gradients of collisions: detect outside the graph")
        collisions = Collisions(self, None)

        def detect():
            collisions._replayed = self.detect(x0, x1)

        run_on_host(detect, self.mesh.device)
        return collisions

    def find_intersections(self, x):
        """Finds the edges that meet faces in one configuration, exactly.

        Args:
            x: Positions, any unit of length, shape [vertex_count, 3], float32 or float64, NumPy or Warp array. Those of
                vertices that no face uses are not looked at.

        Returns:
            (edge, face) for every closed edge that meets a closed face it shares no vertex with, edges as in
            ``mesh.edges``, sorted, int32, shape [n, 2].

        Raises:
            ValueError: If the positions have another shape or type, or are not finite.
        """
        x = self._positions(x, "x", False)
        mesh = self.mesh
        check_finite(x.numpy(), "x", mesh.vertices)
        candidates = wp.empty(2 * len(mesh.faces), dtype=wp.vec2i, device=mesh.device)
        counts = wp.zeros(1 + len(Count), dtype=wp.int64, device=mesh.device)
        broad_phase = _broad_phase(mesh, counts[:1])
        while True:
            broad_phase.pair_edges_with_faces(x, counts[1:], candidates)
            pairs, found = (int(count) for count in counts.numpy()[[0, 1 + Count.NEAR]])
            if pairs <= broad_phase.capacity and found <= len(candidates):
                break
            broad_phase.grow(pairs)
            if found > len(candidates):
                candidates = wp.empty(roomy(found), dtype=wp.vec2i, device=mesh.device)
            counts.zero_()
        status = wp.empty(found, dtype=int, device=mesh.device)
        inputs = [x, mesh.device_edges, mesh.device_faces, candidates]
        _, classify_crossings = _kernels(x.dtype)
        wp.launch(classify_crossings, found, inputs=inputs, outputs=[status], device=mesh.device, record_tape=False)
        status = status.numpy()
        pairs = candidates.numpy()[:found]
        unsure = pairs[status == UNSURE]
        positions = x.numpy()
        crossing = checker.edge_face_crossings(positions[mesh.edges[unsure[:, 0]]], positions[mesh.faces[unsure[:, 1]]])
        pairs = np.concatenate([pairs[status == HIT], unsure[crossing]])
        return pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]

    def _positions(self, x, name, capturing):
        """Positions on the mesh's device as an array of vec3 or vec3d; whether they are finite is seen to there."""
        mesh = self.mesh
        if isinstance(x, wp.array) and x.device == mesh.device and x.dtype in (wp.vec3, wp.vec3d):
            if x.shape != (mesh.vertex_count,):
                raise ValueError(f"{name} must have {mesh.vertex_count} rows, one a vertex, got {x.shape}")
            return x
        if capturing or (isinstance(x, wp.array) and x.requires_grad):
            when = "in a graph" if capturing else "to have gradients"
            raise ValueError(f"{when} {name} must be a Warp array of vec3 or vec3d on {mesh.device}")
        values = checked_shape(x.numpy() if isinstance(x, wp.array) else x, (3,), name)
        if len(values) != mesh.vertex_count:
            raise ValueError(f"{name} must have {mesh.vertex_count} rows, one a vertex, got {len(values)}")
        dtype = wp.vec3 if values.dtype == np.float32 else wp.vec3d
        return wp.array(np.ascontiguousarray(values), dtype=dtype, device=mesh.device)

    def _launch(self, x0, x1, clock=None):
        """Launches the whole pipeline, without asking the device anything.

        With a clock one stage runs after the other; without, in a CUDA graph, the two kinds of pair side by side.
        """
        mesh, counts = self.mesh, self.counts
        counts.zero_()
        vertex_face, edge_edge = self._vertex_face, self._edge_edge
        self._broad_phase.pair_elements(x0, x1, vertex_face.counts, vertex_face.near, edge_edge.counts, edge_edge.near)
        options = {"method": self.method, "tolerance": self.tolerance}
        if clock:
            self._count_not_finite(x0, x1, mesh.device_vertices)
            clock.lap("broad phase")
            vertex_face.run(x0, x1, mesh.device_faces, **options, lap=clock.lap)
            edge_edge.run(x0, x1, mesh.device_edges, **options, lap=clock.lap)
            for narrow_phase in (vertex_face, edge_edge):
                narrow_phase.sort()
            clock.lap("sort")
            return
        with wp.ScopedStream(self._side_stream):
            self._count_not_finite(x0, x1, mesh.device_vertices)
            vertex_face.run(x0, x1, mesh.device_faces, **options)
            vertex_face.sort()
        edge_edge.run(x0, x1, mesh.device_edges, **options)
        edge_edge.sort()
        wp.wait_stream(self._side_stream)

    def find_contacts(self, x0, x1, *, refit=False, changed=None):
        """Launches a detection without sorting, on one stream, for those who respond to it on the device.

        They may move vertices that no face uses as well: positions of all must be finite.

        Args:
            x0: Positions at the start, Warp array of vec3 or vec3d on the mesh's device.
            x1: Positions at the end, of the same type.
            refit: Whether the hierarchy of the detection before will do, because little has moved since. Then this can
                be captured in the body of a conditional node.
            changed: Nonzero for each vertex whose motion has changed since the detection before, or that was in a
                contact then: the other pairs have no contact again, and are not asked. Warp array of int; None for all.

        Returns:
            The narrow phases of vertex-face and edge-edge pairs, whose ``unsorted`` are the contacts.
        """
        counts, vertex_face, edge_edge = self.counts, self._vertex_face, self._edge_edge
        self._run += 1
        self._captured |= bool(self.mesh.device.is_capturing)
        counts.zero_()
        self._count_not_finite(x0, x1)
        queues = vertex_face.counts, vertex_face.near, edge_edge.counts, edge_edge.near
        self._broad_phase.pair_elements(x0, x1, *queues, refit=refit, changed=changed)
        for narrow_phase, elements in ((vertex_face, self.mesh.device_faces), (edge_edge, self.mesh.device_edges)):
            narrow_phase.run(x0, x1, elements, method=self.method, tolerance=self.tolerance)
        return self.narrow_phases

    @property
    def narrow_phases(self):
        """The narrow phases of vertex-face and of edge-edge pairs."""
        return self._vertex_face, self._edge_edge

    def find_candidates(self):
        """Finds all pairs again whose swept boxes overlapped in the last detection, and does nothing more with them.

        That detection must have found room for all, see :meth:`grow`.

        Returns:
            The narrow phases of vertex-face and edge-edge pairs, whose ``near`` are the pairs.
        """
        counts, vertex_face, edge_edge = self.counts, self._vertex_face, self._edge_edge
        self._run += 1
        counts[_VERTEX_FACE:].zero_()
        self._broad_phase.pair_overlapping_elements(
            vertex_face.counts, vertex_face.near, edge_edge.counts, edge_edge.near
        )
        return self.narrow_phases

    def grow(self):
        """Makes queues larger that were too small; returns whether any was. Asks the device."""
        counts = self.counts.numpy()
        overflowed = self._overflowed(counts)
        if overflowed:
            self._grow(counts)
        return overflowed

    def _count_not_finite(self, x0, x1, vertices=None):
        """Counts the vertices, of some or of all, whose positions are not finite."""
        count_not_finite, _ = _kernels(x0.dtype)
        dim = self.mesh.vertex_count if vertices is None else len(vertices)
        inputs, device = [x0, x1, vertices, self.counts], self.mesh.device
        wp.launch(count_not_finite, dim, inputs=inputs, device=device, record_tape=False)

    def _room(self):
        """How much room there is for what each count counts; none for positions that are not finite."""
        queues = [*self._vertex_face.capacities, *self._edge_edge.capacities]
        return np.array([0, self._broad_phase.capacity, *queues], dtype=np.int64)

    def _overflowed(self, counts):
        return bool((counts > self._room())[_BROAD_PHASE:].any())

    def _grow(self, counts):
        self._growth += 1
        if self._captured:
            self._retired += [*self._broad_phase.queues, *self._vertex_face.queues, *self._edge_edge.queues]
            self._retired.append(self.capacities)
        self._broad_phase.grow(counts[_BROAD_PHASE])
        self._vertex_face.grow(counts[_VERTEX_FACE:_EDGE_EDGE])
        self._edge_edge.grow(counts[_EDGE_EDGE:_COUNTS])
        self.capacities = wp.array(self._room(), dtype=wp.int64, device=self.mesh.device)

    def _read(self, clock, *positions):
        """The results of the last run, by the names of the attributes of Collisions.

        Args:
            clock: None in a CUDA graph.
            positions: If given, contacts that the device leaves open are decided.
        """
        counts = self.counts.numpy()
        overflowed = self._overflowed(counts)
        results = {
            "overflowed": overflowed,
            "certified": self.method != "float" and not overflowed and not counts[_NOT_FINITE],
        }
        milliseconds = clock.read() if clock else {}
        if clock:
            milliseconds["exact"] = milliseconds.pop("exact", 0.0)
        stage_counts = {}
        earliest = 2.0
        for narrow_phase, place, elements in (
            (self._vertex_face, _VERTEX_FACE, self.mesh.device_faces),
            (self._edge_edge, _EDGE_EDGE, self.mesh.device_edges),
        ):
            kind = narrow_phase.kind
            kind_counts = counts[place : place + len(Count)]
            contacts = narrow_phase.contacts.read(kind_counts[Count.FOUND] - kind_counts[Count.REFUTED])
            left = int(kind_counts[Count.WIDEST])
            results["certified"] &= bool(positions) or not left
            if positions:
                ask = (contacts["answers"] == UNSURE) | ~contacts["localized"]
                start = time.perf_counter()
                decide_exactly(kind, *positions, elements, contacts, ask)
                milliseconds["exact"] += 1000.0 * (time.perf_counter() - start)
            hit = contacts["hit"]
            results[kind] = contacts["pairs"][hit]
            results[f"_{kind}_localized"] = contacts["localized"][hit]
            for name in ("toi", "coordinates", "normal"):
                results[f"{kind}_{name}"] = contacts[name][hit]
            earliest = min(earliest, float(results[f"{kind}_toi"].min(initial=2.0)))
            unsure = int(kind_counts[Count.UNSURE])
            stage_counts[kind] = StageCounts(
                candidates=int(kind_counts[Count.CANDIDATES]),
                survivors=int(kind_counts[Count.SURVIVORS]),
                free=int(kind_counts[Count.CANDIDATES] - kind_counts[Count.FOUND]),
                hits=int(kind_counts[Count.FOUND]) - unsure,
                unsure=unsure,
                exact=int(kind_counts[Count.OPEN]) - left if self.method == "exact" else 0,
                host=left,
            )
        results["earliest_toi"] = earliest
        results["stats"] = DetectionStats(**stage_counts, milliseconds=milliseconds)
        return results
