"""Detection on the device alone: broad phase and narrow phases, without results on the host."""

import numpy as np
import warp as wp

from .._arguments import checked_choice, checked_distance, checked_integer
from ..kernels.arcs import Arcs
from ..kernels.pairs import ABOVE_SUM
from .broad.broad_phase import BroadPhase, make_broad_phase
from .mesh import CollisionMesh
from .narrow.narrow_phase import NarrowPhase
from .narrow.rings import Rings, make_rings
from .narrow.rules.approach import MinDistances, run_approaches
from .narrow.rules.arc import run_arcs
from .narrow.rules.contact import run_contacts
from .narrow.rules.distance import run_distances
from .run.launch import launch
from .run.phase_timer import PhaseTimer
from .run.settings import (
    METHODS,
    NO_GRADIENTS,
    TOLERANCE,
    Counters,
    Counts,
    Method,
    PairCounts,
    PairKind,
    checked_tolerance,
)

MIN_CAPACITY = 2**17
"""Smallest capacity of a queue for a given number of pairs a face, as a small mesh can have many pairs a face."""

_LARGEST_RADIUS = 2.0**1000
"""The sum of two is finite."""

_ZERO = wp.constant(wp.float64(0.0))

_UNTIMED = PhaseTimer(None)


@wp.kernel(**NO_GRADIENTS)
def _add_deviations(
    # in
    padding: wp.array[wp.float64],
    deviation: wp.array[wp.float64],
    # out
    padding_on_arcs: wp.array[wp.float64],
):
    """Writes paddings of boxes that arcs do not leave either; those of vertices that move straight stay the same."""
    vertex = wp.tid()
    added = deviation[vertex]
    pad = padding[vertex]
    padding_on_arcs[vertex] = wp.where(added > _ZERO, ABOVE_SUM * (pad + added), pad)


def _radius(mesh: CollisionMesh, min_distance: float) -> np.ndarray | None:
    """Returns the radius of each vertex with half of the minimum distance, float64; None if all are 0."""
    if mesh.radius is None and min_distance == 0.0:
        return None
    radius = np.full(mesh.vertex_count, 0.5 * min_distance)
    if mesh.radius is not None:
        radius += mesh.radius
    if radius.max(initial=0.0) > _LARGEST_RADIUS:
        raise ValueError(f"min_distance / 2 and radius must be at most 2^1000 together, not {radius.max():g}")
    return radius


def _queues(*narrow_phases: NarrowPhase) -> list[wp.array]:
    """Returns counts and queue of each narrow phase, in the order of a broad phase's arguments."""
    return [queue for narrow_phase in narrow_phases for queue in (narrow_phase.counts, narrow_phase.queue)]


class DetectionPipeline:
    """Finds the contacts of a moving mesh and leaves them on the device, unsorted, with buffers that it reuses.

    Once its buffers are large enough, a run allocates nothing and does not synchronize with a GPU, and can be captured
    in a CUDA graph::

        pipeline = DetectionPipeline(mesh)
        retry_until_fits(lambda: pipeline.find_contacts(x0, x1), pipeline, mesh.device)
        for narrow_phase in pipeline.narrow_phases:
            narrow_phase.kind, narrow_phase.contacts, narrow_phase.counts

    Attributes:
        mesh: The mesh.
        method: One of :data:`METHODS`.
        tolerance: Of the times of impact, as a share of the step.
        counters: Counts of the last run, on the device.
        counts: The same on the host, as the last :meth:`grow` has read them.
        capacities: Capacities for the counts, in the order of the counters, and 0 for positions that are not finite,
            Warp array of int64: where a count is larger, contacts are missing.
        broad_phase: The broad phase, whose boxes are those of the last run.
        vertex_face: The narrow phase of vertex-face pairs.
        edge_edge: The narrow phase of edge-edge pairs.
        points: The narrow phases of pairs of a point and an edge, and of two points; none without a minimum distance
            or without points.
        radius: Radius of each vertex, half of the minimum distance included, float64, shape [vertex_count]; None if
            pairs collide that touch.
        device_radius: The same on the device, Warp array of float64, or None.
        generation: How often buffers have been replaced. Graphs captured before still write to the old buffers.
    """

    def __init__(
        self,
        mesh: CollisionMesh,
        *,
        method: Method = "conservative",
        tolerance: float = TOLERANCE,
        min_distance: float = 0.0,
        rings: int = 1,
        min_distances: "MinDistances | None" = None,
        body: np.ndarray | None = None,
        arcs: "Arcs | None" = None,
        only_used_vertices: bool = False,
        pairs: int | None = None,
    ):
        """Allocates the buffers on the mesh's device.

        Args:
            mesh: The mesh.
            method: How to decide pairs that floating point cannot certify, see :class:`CollisionDetector`.
            tolerance: Of the times of impact, as a share of the step, in [2^-38, 1].
            min_distance: Distance up to which pairs collide, see :class:`CollisionDetector`.
            rings: Pairs within this number of edges are excluded, see :class:`CollisionDetector`.
            min_distances: Minimum distances of a response, see :mod:`.approach`, in place of those from radii and
                ``min_distance``; None for these.
            body: Body of each vertex, int, shape [vertex_count]: pairs whose vertices are all of one body from -1 are
                excluded, and :meth:`add_to_radius` must be called before each run. None for none.
            arcs: The arcs of bodies that turn, which the caller writes before each run; with them, pairs keep the
                distances of ``min_distances`` or none. None if nothing turns.
            only_used_vertices: Whether positions of vertices that no face uses may be anything. Otherwise they are
                counted too if they are not finite.
            pairs: Pairs that fit into both queues at first, a quarter of them of vertices and faces, and at least
                :data:`MIN_CAPACITY` into each; twice as many pairs of faces, a half of them survivors, an eighth
                contacts (of many millions half of that). A large capacity costs memory, but no time. Default: for two
                faces, sixteen pairs of faces of a part of the mesh, one vertex-face and four edge-edge pairs.

        Raises:
            ValueError: If the method is unknown, or the tolerance, the distance or the rings are out of range.
        """
        checked_choice(method, "method", METHODS)
        tolerance, rings = checked_tolerance(tolerance), checked_integer(rings, "rings")
        min_distance = checked_distance(min_distance, "min_distance")
        self.mesh = mesh
        self.method: Method = method
        self.tolerance = tolerance
        self.generation = 0
        self._captured = False
        self._retired: list = []  # buffers that a CUDA graph may still write to
        self.counters = Counters(mesh.device)
        self._filtered_of_worlds: wp.array | None = None
        self.counts = self.counters.read()
        vertices, edges, faces = mesh.vertex_count, len(mesh.edges), len(mesh.faces)
        self._min_distances = min_distances
        if min_distances is None:
            self.radius = _radius(mesh, min_distance)
        else:
            self.radius = min_distances.radius.numpy() + 0.5 * min_distances.reach
        self._rings = Rings() if self.radius is None or min_distances is not None else make_rings(mesh, rings)
        self._body: wp.array | None = None
        if body is not None:
            self._body = wp.array(body, dtype=int, device=mesh.device)
            self.radius = np.zeros(vertices) if self.radius is None else self.radius
        self.device_radius = self._padding = None
        if self.radius is not None:
            self.device_radius = wp.empty(vertices, dtype=wp.float64, device=mesh.device)
            self._padding = wp.empty_like(self.device_radius)
            self._set_radius(self.radius)
        self._arcs = arcs
        padding = self._padding
        if arcs is not None:
            assert self.radius is None or min_distances is not None
            padding = arcs.deviation if self._padding is None else wp.empty_like(self._padding)
        self._padding_on_arcs = padding
        elements = faces + len(mesh.free_edges) + len(mesh.points)
        face_pairs, vertex_face, edge_edge = None, elements // 2 + 1, 2 * elements
        if pairs is not None:
            # of sheets that lie on each other, three of four pairs are of edges, and most pairs of faces have none
            sizes = [min(max(n * pairs // 4, MIN_CAPACITY), 2**31 - 1) for n in (1, 3, 8)]
            vertex_face, edge_edge, face_pairs = sizes
        self.broad_phase: BroadPhase = make_broad_phase(
            mesh,
            self.counters.face_pairs,
            capacity=face_pairs,
            not_finite=self.counters.not_finite,
            only_used_vertices=only_used_vertices,
            padding=padding,
        )
        self.vertex_face = NarrowPhase(
            PairKind.VERTEX_FACE, self.counters.vertex_face, vertex_face, elements=(vertices, faces)
        )
        self.edge_edge = NarrowPhase(PairKind.EDGE_EDGE, self.counters.edge_edge, edge_edge, elements=(edges, edges))
        self.points: tuple[NarrowPhase, ...] = ()
        if self.radius is not None and len(mesh.points):
            self.points = (
                NarrowPhase(PairKind.VERTEX_EDGE, self.counters.vertex_edge, edge_edge, elements=(vertices, edges)),
                NarrowPhase(
                    PairKind.VERTEX_VERTEX, self.counters.vertex_vertex, edge_edge, elements=(vertices, vertices)
                ),
            )
        self.update_capacities()

    def count_filtered_by_world(self, counts: wp.array) -> None:
        """Makes each run write how many pairs groups and masks leave out in each world, beside those of all.

        Args:
            counts: Pairs by world, Warp array of int64, shape [number of worlds].
        """
        self._filtered_of_worlds = counts
        self.broad_phase.count_filtered_by_world(counts)

    def set_bodies(self, body: np.ndarray) -> None:
        """Sets the body of each vertex for the next runs of a pipeline that has some."""
        assert self._body is not None
        self._body.assign(body)

    def add_to_radius(self, deviation: np.ndarray) -> None:
        """Sets the minimum distance of each pair, for the next runs, to at least what it is with larger radii.

        Args:
            deviation: What is added to the radius of each vertex, float64, shape [vertex_count].
        """
        assert self.radius is not None
        self._set_radius(float(ABOVE_SUM) * (self.radius + deviation))

    def _set_radius(self, radius: np.ndarray) -> None:
        assert self.device_radius is not None and self._padding is not None
        self.device_radius.assign(radius)
        # the minimum distance of a pair, a rounded sum, is at most the sum of these
        self._padding.assign(np.nextafter(radius, np.inf))

    @property
    def narrow_phases(self) -> tuple[NarrowPhase, ...]:
        """The narrow phases of vertex-face and of edge-edge pairs, and those of points."""
        return self.vertex_face, self.edge_edge, *self.points

    def find_contacts(
        self,
        x0: wp.array,
        x1: wp.array,
        *,
        changed: wp.array | None = None,
        proximities: bool = True,
        sort: bool = False,
        keep_separated: bool = False,
        queued: bool = False,
        timer: PhaseTimer = _UNTIMED,
        side_stream: wp.Stream | None = None,
    ) -> None:
        """Launches the broad phase and the narrow phases, whose ``contacts`` are the result.

        Args:
            x0: Positions at the start, Warp array of vec3 or vec3d on the mesh's device.
            x1: Positions at the end, of the same type.
            changed: Nonzero for each vertex whose motion has changed since the run before, or that was in a contact
                then. Pairs without one of these vertices have no contact again, and are excluded. Warp array of int;
                None for all.
            proximities: Whether contacts with minimum distances of a response include pairs that are only near.
            sort: Whether to sort the contacts for :meth:`NarrowPhase.ordered_contacts`.
            keep_separated: As of :meth:`.BroadPhaseHierarchy.pair_elements`.
            queued: Whether to take the candidates of the last run, which kept those that an axis separates, in place of
                seeking them: each position at the end is to be between its own there and that at the start.
            timer: Measures the phases.
            side_stream: Stream on which to sort the vertex-face contacts; None to sort one kind after the other.
        """
        self._captured |= bool(self.mesh.device.is_capturing)
        if self._filtered_of_worlds is not None:
            self._filtered_of_worlds.zero_()
        with timer.phase("broad phase"):
            if queued:
                counts = {kind.label: PairCounts(queued=counts.queued) for kind, counts in self.counts.pairs.items()}
                self.counters.array.assign(Counts(0, 0, **counts).values())
            else:
                self.find_candidates(x0, x1, changed=changed, keep_separated=keep_separated)
        narrow_phases = [(n, self.mesh.device_elements(n.kind)) for n in self.narrow_phases]
        options = {"method": self.method, "tolerance": self.tolerance, "timer": timer}
        if self._min_distances is not None:
            options = {"tolerance": self.tolerance, "arcs": self._arcs, "timer": timer}
            run_approaches(narrow_phases, x0, x1, self._min_distances, proximities=proximities, **options)
        elif self.device_radius is None:
            boxes_meet = self._arcs is None and not (keep_separated or queued)
            run_contacts(narrow_phases, x0, x1, arcs=self._arcs, boxes_meet=boxes_meet, **options)
            if self._arcs is not None:
                run_arcs(narrow_phases, x0, x1, self._arcs, timer=timer)
        else:
            options["body"] = self._body
            run_distances(narrow_phases, x0, x1, self.device_radius, self._rings, **options)
        if not sort:
            return
        for narrow_phase in self.narrow_phases:
            stream = side_stream if narrow_phase is self.vertex_face else None
            with wp.ScopedStream(stream), timer.phase("sort"):
                narrow_phase.sort()
        if side_stream is not None:
            wp.wait_stream(side_stream)

    def _pad_arcs(self) -> None:
        """Makes boxes reach as far beyond elements as their arcs do, and as their minimum distances."""
        if self._arcs is None or self._padding is None:
            return
        inputs, outputs = [self._padding, self._arcs.deviation], [self._padding_on_arcs]
        device = self.mesh.device
        launch(_add_deviations, len(self._padding), inputs=inputs, outputs=outputs, device=device, record_tape=False)

    def find_candidates(
        self, x0: wp.array, x1: wp.array, *, changed: wp.array | None = None, keep_separated: bool = False
    ) -> None:
        """Enqueues the candidates in the queues of the narrow phases, which do not run.

        Arguments are those of :meth:`find_contacts`.
        """
        self._pad_arcs()
        self.counters.array.zero_()
        queues = _queues(*self.narrow_phases)
        self.broad_phase.pair_elements(x0, x1, *queues, changed=changed, keep_separated=keep_separated)

    def find_edges_with_faces(self, x: wp.array) -> None:
        """Enqueues the pairs (edge, face) of one configuration whose boxes overlap, in the queue of edge-edge pairs.

        Args:
            x: Positions, Warp array of vec3 or vec3d on the mesh's device.
        """
        self.counters.array.zero_()
        self.broad_phase.pair_edges_with_faces(x, self.edge_edge.counts, self.edge_edge.queue)

    def find_overlapping(self, x0: wp.array, x1: wp.array, *, again: bool = False) -> None:
        """Enqueues all pairs whose swept boxes overlap, as :meth:`find_candidates` does those that it finds.

        Where ``again``, see :meth:`.BroadPhaseHierarchy.pair_elements_again`, pairs of faces stay counted.
        """
        self._pad_arcs()
        queues = _queues(self.vertex_face, self.edge_edge)
        if again:
            self.counters.pairs.zero_()
            self.broad_phase.pair_elements_again(x0, x1, *queues)
        else:
            self.counters.array.zero_()
            self.broad_phase.pair_elements(x0, x1, *queues, keep_separated=True)

    def grow(self) -> bool:
        """Enlarges the buffers that were too small in the last run; synchronizes with the device.

        Returns:
            Whether the run is to be repeated. Where a position was not finite, its elements have no pairs.

        Raises:
            ValueError: If a buffer cannot be large enough.
        """
        counts = self.counts = self.counters.read()
        if not self.overflows(counts) and self._known_capacities == self._host_capacities():
            return False  # nor has memory run out, the last time, before the device knew what had grown
        self.generation += 1
        if self._captured:
            self._retired += [*self.broad_phase.buffers, self.capacities]
            for narrow_phase in self.narrow_phases:
                self._retired += narrow_phase.buffers
        self.broad_phase.grow(counts.face_pairs)
        for narrow_phase in self.narrow_phases:
            narrow_phase.grow(counts.pairs[narrow_phase.kind])
        self.update_capacities()
        return True

    def overflows(self, counts: Counts) -> list[str]:
        """Names each buffer that is too small for the counts, with count and capacity."""
        return counts.overflows(self._host_capacities())

    def _host_capacities(self) -> Counts:
        pairs = {phase.kind.label: phase.capacities for phase in self.narrow_phases}
        return Counts(0, self.broad_phase.capacity, **pairs)

    def allocate_contacts(self, candidates_of_contact: int) -> None:
        """Replaces the buffers of contacts, with room for one of so many candidates."""
        for narrow_phase in self.narrow_phases:
            narrow_phase.allocate_contacts(len(narrow_phase.queue) // candidates_of_contact)
        self.update_capacities()

    def update_capacities(self) -> None:
        """Makes ``capacities`` anew, after a buffer was replaced."""
        capacities = self._host_capacities()
        self.capacities = wp.array(capacities.values(), dtype=wp.int64, device=self.mesh.device)
        self._known_capacities = capacities  # once the device has them
