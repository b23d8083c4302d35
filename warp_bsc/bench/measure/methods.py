"""The methods that the paper's benchmarks compare.

All methods read the same arrays, positions by the vertices of a pair's elements, as a detector does, and decide whether
the two features meet. They differ as follows:

- ``float``, ``conservative``, ``exact``: the detector's own narrow phase,
  :class:`~warp_bsc.detection.narrow.narrow_phase.NarrowPhase`, with this method, from the queue of pairs to the results
  of the contacts, without sorting. UNSURE is a collision. Pairs that are too wide for the device, which the detector
  leaves to the host, stay UNSURE. On a GPU the narrow phase compares boxes last, because the detector's broad phase has
  compared them already. The benchmark's queries are all candidates, also those that this comparison would have
  excluded, which favors ``cubic``.
- ``cubic``: :mod:`..peers.baselines.cubic_solver`. It stops at the first root at which the features are close, so it
  finds a time as well; that time is not written.
- ``reduced``: ``float`` with the inside tests of the paper's Sec. 3.5, :mod:`..peers.baselines.reduced_inside_test`.
  The culls are those of the narrow phase, in the same order. The paper does not subdivide, so a query that
  classification leaves open is a collision at once, as the paper's weak inequalities imply.

No method finds times of impact, and none checks whether positions are finite, which the detector does once a vertex.

The phase that decides a query and its clock cycles come from a kernel of its own, which is never timed: see
:func:`trace`.
"""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from ...detection.narrow.narrow_phase import NarrowPhase
from ...detection.narrow.rules.contact import run_contacts
from ...detection.queries.query_points import elements_of_rows, query_points
from ...detection.run.launch import launch_over, launch_over_queue, retry_until_fits
from ...detection.run.phase_timer import PhaseTimer
from ...detection.run.settings import METHODS as NARROW_PHASE_METHODS
from ...detection.run.settings import NO_FUSED_OPERATIONS, TOLERANCE, Count, PairCounts, PairKind
from ...kernels.bits import lowest_bit
from ...kernels.classification import classify
from ...kernels.culling import centroid_direction, direction_separates, edge_edge_boxes_apart, vertex_face_boxes_apart
from ...kernels.motion import edge_edge_motion, vertex_face_motion
from ...kernels.pairs import ends_of, vertices_of_pair
from ...kernels.pipeline.batch_culling import BATCH, cull_batch_of
from ...kernels.pipeline.queues import take_slot
from ...kernels.polynomials import coplanarity
from ...kernels.signs import FREE, ROUNDOFF, UNSURE, certified_sign_cubic
from ...kernels.time_of_impact import impact
from ..peers.baselines import classify_reduced, cubic_solver_edge_edge, cubic_solver_vertex_face
from ..timing import median_milliseconds

METHODS: tuple[str, ...] = (*NARROW_PHASE_METHODS, "cubic", "reduced")
"""The methods that are compared."""

PHASES = ("axis boxes", "Bernstein signs", "separating direction", "classification", "subdivision", "exact")
"""The phases that decide queries, in the order of the culls on a CPU."""

_AXIS_BOXES, _BERNSTEIN_SIGNS, _SEPARATING_DIRECTION, _CLASSIFICATION, _SUBDIVISION, _EXACT = (
    wp.constant(phase) for phase in range(len(PHASES))
)

_WARP_SIZE = 32
_SMALLEST_LAUNCH = {False: 2**18, True: 2**22}
"""Queries of a launch on a CPU and on a GPU: fewer are repeated."""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return clock64();
#elif defined(__aarch64__)
    return (int64_t)__builtin_arm_rsr64("cntvct_el0");
#else
    return (int64_t)__builtin_readcyclecounter();
#endif
""")
def _clock() -> wp.int64: ...


@functools.cache
def _pairs_of(dtype: type) -> type:
    """Returns the struct that all methods read, for one type of position."""

    @wp.struct
    class MeshPairs:
        """Pairs of a mesh's elements, and positions of its vertices at both ends of the step."""

        x0: wp.array[dtype]
        x1: wp.array[dtype]
        elements: wp.array2d[int]
        pairs: wp.array[wp.vec2i]

    return MeshPairs


@functools.cache
def _kernels(kind: PairKind, dtype: type):
    """Returns the kernels for one kind of query and one type of position, each in a module of its own.

    Returns:
        Kernels that solve cubics, cull on a GPU, cull on a CPU, classify by the reduced inside tests, and trace.
    """
    vertex_face = kind == PairKind.VERTEX_FACE
    motion_of = vertex_face_motion if vertex_face else edge_edge_motion
    boxes_apart = vertex_face_boxes_apart if vertex_face else edge_edge_boxes_apart
    solve_cubic = cubic_solver_vertex_face if vertex_face else cubic_solver_edge_edge
    kind_number, MeshPairs = int(kind), _pairs_of(dtype)

    @wp.func
    def read(given: MeshPairs, i: int):
        return ends_of(given.x0, given.x1, vertices_of_pair(kind_number, given.elements, given.pairs[i]))

    @wp.kernel(**NO_FUSED_OPERATIONS)
    def cubic(first: int, given: MeshPairs, status: wp.array[wp.int8]):
        i = first + wp.tid()
        a0, b0, c0, d0, a1, b1, c1, d1 = read(given, i)
        status[i] = wp.int8(solve_cubic(a0, b0, c0, d0, a1, b1, c1, d1))

    @wp.kernel(**NO_FUSED_OPERATIONS)
    def cull(first: int, given: MeshPairs, survivors: wp.array[int], survivor_count: wp.array[wp.int64]):
        i = first + wp.tid()
        a0, b0, c0, d0, a1, b1, c1, d1 = read(given, i)
        motion = motion_of(a0, b0, c0, d0, a1, b1, c1, d1, wp.float64(0.0))
        y = coplanarity(motion)
        if certified_sign_cubic(y.k, y.bound) != 0:
            return
        if direction_separates(motion, centroid_direction(motion)):
            return
        if boxes_apart(a0, b0, c0, d0, a1, b1, c1, d1):
            return
        survivors[wp.int32(take_slot(survivor_count, 0))] = i

    cull_batch = cull_batch_of(dtype, vertex_face)

    @wp.kernel(**NO_FUSED_OPERATIONS)
    def cull_batches(first: int, given: MeshPairs, survivors: wp.array[int], survivor_count: wp.array[wp.int64]):
        i = BATCH * (first + wp.tid())
        count = wp.min(BATCH, given.pairs.shape[0] - i)
        left = cull_batch(given.x0, given.x1, given.elements, given.pairs, i, count, False, wp.float64(0.0))
        while left != wp.uint64(0):
            survivors[wp.int32(take_slot(survivor_count, 0))] = i + lowest_bit(left)
            left = left & (left - wp.uint64(1))

    @wp.kernel(**NO_FUSED_OPERATIONS)
    def classify_survivors(
        first: int,
        # in
        given: MeshPairs,
        survivors: wp.array[int],
        survivor_count: wp.array[wp.int64],
        # out
        status: wp.array[wp.int8],
    ):
        slot = first + wp.tid()
        if wp.int64(slot) >= survivor_count[0]:
            return
        i = survivors[slot]
        a0, b0, c0, d0, a1, b1, c1, d1 = read(given, i)
        motion = motion_of(a0, b0, c0, d0, a1, b1, c1, d1, wp.float64(0.0))
        status[i] = wp.int8(classify_reduced(motion, coplanarity(motion)))

    @wp.kernel(**NO_FUSED_OPERATIONS)
    def trace(
        first: int,
        # in
        given: MeshPairs,
        lanes: int,
        solves_cubic: bool,
        reduced: bool,
        roundoff: wp.float64,
        # out
        phase: wp.array[wp.int8],
        cycles: wp.array[wp.int64],
    ):
        i = (first + wp.tid()) // lanes
        start = _clock()
        a0, b0, c0, d0, a1, b1, c1, d1 = read(given, i)
        decided = _AXIS_BOXES
        if solves_cubic:
            # any phase: only the time counts, and the status must be computed
            decided = wp.int32(solve_cubic(a0, b0, c0, d0, a1, b1, c1, d1))
        elif not boxes_apart(a0, b0, c0, d0, a1, b1, c1, d1):
            motion = motion_of(a0, b0, c0, d0, a1, b1, c1, d1, roundoff)
            y = coplanarity(motion)
            if certified_sign_cubic(y.k, y.bound) != 0:
                decided = _BERNSTEIN_SIGNS
            elif direction_separates(motion, centroid_direction(motion)):
                decided = _SEPARATING_DIRECTION
            elif reduced:
                decided = wp.where(classify_reduced(motion, y) != UNSURE, _CLASSIFICATION, _SUBDIVISION)
            elif classify(motion, y) != UNSURE:
                decided = _CLASSIFICATION
            elif impact(motion, y, UNSURE, wp.float64(TOLERANCE)).status != UNSURE:
                decided = _SUBDIVISION
            else:
                decided = _EXACT
        phase[i] = wp.int8(decided)
        cycles[i] = _clock() - start

    return cubic, cull, cull_batches, classify_survivors, trace


@dataclass(frozen=True)
class Queries:
    """Queries of one kind as pairs of a mesh's elements."""

    kind: PairKind  # kind of pair
    x0: np.ndarray  # positions of the mesh at the start of the step, float32 or float64, shape [vertex_count, 3]
    x1: np.ndarray  # positions at its end, of the same type
    # vertices of its faces (VERTEX_FACE) or edges (EDGE_EDGE), int32, shape [element_count, 3 or 2]
    elements: np.ndarray
    pairs: np.ndarray  # (vertex, face) or (edge, edge), no pair twice, int32, shape [n, 2]

    @classmethod
    def of_points(cls, kind: PairKind, points: np.ndarray) -> "Queries":
        """Returns queries with four vertices of their own each, from rows as of :func:`warp_bsc.query_vertex_face`."""
        n = len(points)
        x0, x1 = (np.ascontiguousarray(x).reshape(-1, 3) for x in (points[:, :4], points[:, 4:]))
        return cls(kind, x0, x1, *elements_of_rows(kind, np.arange(4 * n, dtype=np.int32).reshape(n, 4)))

    def points(self, which: slice | np.ndarray | list[int] = slice(None)) -> np.ndarray:
        """Returns the points of some queries, rows as of :func:`warp_bsc.query_vertex_face`, shape [n, 8, 3]."""
        return query_points(self.elements, self.pairs[which], self.x0, self.x1, kind=self.kind.label)

    def __len__(self) -> int:
        """Returns the number of queries."""
        return len(self.pairs)


class QuerySet:
    """Queries of one kind on a device.

    Attributes:
        kind: Kind of pair.
        count: Number of queries.
        pairs: The queries' pairs on the host, without repetitions, int32, shape [n, 2].
        given: What all methods read: positions at the start and at the end, Warp arrays of vec3 or vec3d; elements,
            two-dimensional array of int; and pairs, array of vec2i.
    """

    def __init__(self, queries: Queries, device: wp.DeviceLike, *, repeated: int = 1):
        """Copies queries to a device, with their pairs ``repeated`` times one after the other."""
        self.kind = queries.kind
        self.device = wp.get_device(device)
        self.dtype = wp.vec3 if queries.x0.dtype == np.float32 else wp.vec3d
        self.pairs = queries.pairs
        self.count = repeated * len(queries)
        self.given = given = _pairs_of(self.dtype)()
        given.x0, given.x1 = (wp.array(x, dtype=self.dtype, device=device) for x in (queries.x0, queries.x1))
        given.elements = wp.array(queries.elements, dtype=int, device=device)
        given.pairs = wp.array(np.tile(queries.pairs, (repeated, 1)), dtype=wp.vec2i, device=device)


class MethodRun:
    """A method on a set of queries, with its buffers on the device.

    Attributes:
        method: One of :data:`METHODS`.
        queries: The queries.
    """

    def __init__(self, method: str, queries: QuerySet):
        """Allocates buffers that are large enough for all launches."""
        self.method = method
        self.queries = queries
        n, device = queries.count, queries.device
        if method not in NARROW_PHASE_METHODS:
            self._status = wp.zeros(n, dtype=wp.int8, device=device)
            self._survivors = wp.empty(n, dtype=int, device=device)
            self._survivor_count = wp.zeros(1, dtype=wp.int64, device=device)
            return
        given = queries.given
        first_elements = len(given.x0) if queries.kind == PairKind.VERTEX_FACE else len(given.elements)
        self._counts = wp.zeros(len(Count), dtype=wp.int64, device=device)
        self._start_counts = wp.array(PairCounts(queued=n), dtype=wp.int64, device=device)
        self._narrow_phase = NarrowPhase(queries.kind, self._counts, n, (first_elements, len(given.elements)))
        wp.copy(self._narrow_phase.queue, given.pairs)
        retry_until_fits(self.launch, self._narrow_phase, device)

    def launch(self) -> None:
        """Decides all queries; on a GPU without synchronizing with the device."""
        queries = self.queries
        given, device = queries.given, queries.device
        if self.method in NARROW_PHASE_METHODS:
            wp.copy(self._counts, self._start_counts)
            phases = [(self._narrow_phase, given.elements)]
            run_contacts(phases, given.x0, given.x1, method=self.method, timed=False, timer=PhaseTimer(None))
            return
        cubic, cull, cull_batches, classify_survivors, _ = _kernels(queries.kind, queries.dtype)
        if self.method == "cubic":
            launch_over(cubic, queries.count, inputs=[given], outputs=[self._status], device=device)
            return
        self._status.zero_()  # FREE, unless a query survives the culls
        self._survivor_count.zero_()
        outputs = [self._survivors, self._survivor_count]
        if device.is_cpu:
            batches = -(-queries.count // BATCH)
            launch_over(cull_batches, batches, inputs=[given], outputs=outputs, device=device, chunk=16)
        else:
            launch_over(cull, queries.count, inputs=[given], outputs=outputs, device=device)
        queue, inputs = (self._survivors, self._survivor_count), [given, self._survivors, self._survivor_count]
        launch_over_queue(classify_survivors, *queue, 0, inputs=inputs, outputs=[self._status])

    def read_status(self) -> np.ndarray:
        """Returns the status of each query after a launch: FREE, HIT or UNSURE, int8, shape [n]; not if repeated."""
        if self.method not in NARROW_PHASE_METHODS:
            return self._status.numpy().copy()
        status, contacts = np.full(self.queries.count, FREE, dtype=np.int8), self._narrow_phase.contacts
        found = contacts.decided if self.method == "exact" else contacts.status
        count = int(self._counts.numpy()[Count.CONTACTS])
        keys, of_contacts = (
            np.ascontiguousarray(pairs, dtype=np.int32).view(np.int64)[:, 0]
            for pairs in (self.queries.pairs, contacts.pairs.numpy()[:count])
        )
        order = np.argsort(keys)
        status[order[np.searchsorted(keys, of_contacts, sorter=order)]] = found.numpy()[:count]
        return status

    def find_hits(self) -> np.ndarray:
        """Returns whether each query collides by the method, bool, shape [n]: whether it is not decided to be free."""
        return self.read_status() != FREE


def measure_nanoseconds(run: MethodRun, *, repeat: int) -> float:
    """Returns the median time of a query [ns] in launches of all queries: replays of a CUDA graph, calls on the CPU.

    A first launch, which loads the kernels, is not timed.

    Args:
        run: The method and its queries.
        repeat: Number of repetitions; their median counts.
    """
    return 1e6 * median_milliseconds(run.launch, run.queries.device, repeat) / run.queries.count


def time_in_turns(
    methods: Sequence[str], queries: Queries, device: wp.Device, turns: int, measure: Callable[[MethodRun], float]
) -> dict[str, float]:
    """Returns what is measured of each method in turns, of which the fastest counts: other work can only slow one down.

    The first launch of each method, which loads its kernels, is not measured. Few queries are repeated.
    """
    repeated = QuerySet(queries, device, repeated=-(-_SMALLEST_LAUNCH[device.is_cuda] // len(queries)))
    runs = {method: MethodRun(method, repeated) for method in methods}
    for run in runs.values():
        run.launch()
    measured = [{method: measure(run) for method, run in runs.items()} for _ in range(turns)]
    return {method: min(turn[method] for turn in measured) for method in methods}


def trace(queries: QuerySet, method: str) -> tuple[np.ndarray, np.ndarray]:
    """Finds the phase that decides each query, and the clock cycles that the query takes up to there.

    One kernel runs all phases of a query one after the other, without the queues and vector instructions of the narrow
    phase and without exact arithmetic. Cycles therefore rank queries; they do not measure a method. On a GPU each query
    has a warp of its own, because lanes of a warp wait for each other.

    Args:
        queries: The queries.
        method: One of :data:`METHODS`. The phases of "cubic" have no meaning.

    Returns:
        Indices into :data:`PHASES`, int8, shape [n]; cycles, int64, shape [n].
    """
    n, device = queries.count, queries.device
    phase = wp.empty(n, dtype=wp.int8, device=device)
    cycles = wp.empty(n, dtype=wp.int64, device=device)
    lanes = _WARP_SIZE if device.is_cuda else 1
    roundoff = 0.0 if method in ("float", "reduced") else ROUNDOFF
    inputs = [queries.given, lanes, method == "cubic", method == "reduced", roundoff]
    *_, kernel = _kernels(queries.kind, queries.dtype)
    launch_over(kernel, lanes * n, inputs=inputs, outputs=[phase, cycles], device=device)
    return phase.numpy().copy(), cycles.numpy().copy()
