"""What the paper's benchmarks compare: each method as kernels that read a query's points and write its answer.

All read the same arrays, positions by the vertices of a pair's elements, as a detector does, and answer the same
question: whether the two features meet. What each does, and what not, so that the times can be compared:

- ``float``, ``conservative``: the stages of the detector, without and with error bounds: boxes, the signs of the
  Bernstein coefficients, a separating direction, on a CPU for eight queries at once; then, for what these leave, in a
  kernel of its own, classification, and with bounds the subdivision of what that leaves open. UNSURE is a collision.
- ``exact``: the same as ``conservative``, and the exact stage of the detector for what is UNSURE.
- ``cubic``: :mod:`warp_bsc.bench.baselines.cubic_solver`. It stops at the first root at which the features are close,
  so it knows a time, too; that time is not written.
- ``reduced``: ``float`` with the paper's own inside tests, :mod:`warp_bsc.bench.baselines.reduced_inside_test`. As
  there is no subdivision in the paper, what classification leaves open is a collision at once: weak inequalities, as
  it has them. Its culls are those of ``float``.

None is asked for a time of impact, and none looks whether numbers are finite, which is done once a vertex.
"""

import enum
import functools
from dataclasses import dataclass

import numpy as np
import warp as wp

from ..detection.contact_buffer import ContactBuffer
from ..detection.exact_stage import launch_exact_stage
from ..detection.launch import launch_over, launch_over_queue
from ..detection.settings import TOLERANCE, PairKind
from ..kernels.classification import classify
from ..kernels.culling import centroid_direction, direction_separates, edge_edge_boxes_apart, vertex_face_boxes_apart
from ..kernels.motion import edge_edge_motion, vertex_face_motion
from ..kernels.pipeline.batch_culling import BATCH, cull_batch_of, lowest_bit
from ..kernels.pipeline.queues import take_slot
from ..kernels.polynomials import coplanarity
from ..kernels.signs import FREE, ROUNDOFF, UNSURE, certified_sign_cubic
from ..kernels.time_of_impact import impact
from .baselines import classify_reduced, cubic_solver_edge_edge, cubic_solver_vertex_face
from .detector import median_milliseconds

__all__ = ["METHODS", "STAGES", "MethodRun", "Queries", "QuerySet", "measure_nanoseconds", "trace_stages"]

METHODS = ("float", "conservative", "exact", "cubic", "reduced")
"""What is compared."""

STAGES = ("axis boxes", "Bernstein signs", "separating direction", "classification", "subdivision", "exact")
"""What decides a query, in the order in which they are tried."""

_KERNEL = {"enable_backward": False, "module": "unique", "module_options": {"fuse_fp": False}}
"""Without fused operations every device computes the same bits."""

_CYCLES = """
#if defined(__CUDA_ARCH__)
    return clock64();
#elif defined(__aarch64__)
    return (int64_t)__builtin_arm_rsr64("cntvct_el0");
#else
    return (int64_t)__builtin_readcyclecounter();
#endif
"""


class _Count(enum.IntEnum):
    """Places of the counts of a run: queries that culls, floating point, each width, and classification leave."""

    SURVIVORS = 0
    UNSURE = 1
    WIDE = 2
    WIDER = 3
    WIDEST = 4
    REFUTED = 5
    OPEN = 6


_SURVIVORS = wp.constant(int(_Count.SURVIVORS))
_UNSURE = wp.constant(int(_Count.UNSURE))
_OPEN = wp.constant(int(_Count.OPEN))


@wp.func_native(_CYCLES)
def _cycles() -> wp.int64: ...


@functools.cache
def _kernels(kind, dtype):
    """The kernels for one kind of query and one type of position, each in a module of its own, by name."""
    vertex_face = kind == "vertex_face"
    motion_of = vertex_face_motion if vertex_face else edge_edge_motion
    boxes_apart = vertex_face_boxes_apart if vertex_face else edge_edge_boxes_apart
    solve_cubic = cubic_solver_vertex_face if vertex_face else cubic_solver_edge_edge

    @wp.func
    def read(x: wp.array[dtype], elements: wp.array2d[int], pair: wp.vec2i):
        first = pair[0]
        second = pair[1]
        if wp.static(vertex_face):
            return x[first], x[elements[second, 0]], x[elements[second, 1]], x[elements[second, 2]]
        return x[elements[first, 0]], x[elements[first, 1]], x[elements[second, 0]], x[elements[second, 1]]

    @wp.func
    def started(ticks: wp.array[wp.int64]) -> wp.int64:
        if ticks:
            return _cycles()
        return wp.int64(0)

    @wp.func
    def stop(ticks: wp.array[wp.int64], i: int, start: wp.int64):
        if ticks:
            wp.atomic_add(ticks, i, _cycles() - start)

    @wp.kernel(**_KERNEL)
    def cull(
        first: int,
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        elements: wp.array2d[int],
        pairs: wp.array[wp.vec2i],
        roundoff: wp.float64,
        survivors: wp.array[int],
        counts: wp.array[wp.int64],
        ticks: wp.array[wp.int64],
    ):
        i = first + wp.tid()
        start = started(ticks)
        a0, b0, c0, d0 = read(x0, elements, pairs[i])
        a1, b1, c1, d1 = read(x1, elements, pairs[i])
        if not boxes_apart(a0, b0, c0, d0, a1, b1, c1, d1):
            motion = motion_of(a0, b0, c0, d0, a1, b1, c1, d1, roundoff)
            y = coplanarity(motion)
            if certified_sign_cubic(y.k, y.bound) == 0:
                if not direction_separates(motion, centroid_direction(motion)):
                    survivors[wp.int32(take_slot(counts, _SURVIVORS))] = i
        stop(ticks, i, start)

    cull_batch = cull_batch_of(dtype, vertex_face)

    @wp.kernel(**_KERNEL)
    def cull_batches(
        first: int,
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        elements: wp.array2d[int],
        pairs: wp.array[wp.vec2i],
        roundoff: wp.float64,
        survivors: wp.array[int],
        counts: wp.array[wp.int64],
        ticks: wp.array[wp.int64],
    ):
        i = BATCH * (first + wp.tid())
        start = started(ticks)
        count = wp.min(BATCH, pairs.shape[0] - i)
        left = cull_batch(x0, x1, elements, pairs, i, count, roundoff)
        while left != wp.uint64(0):
            lane = lowest_bit(left)
            survivors[wp.int32(take_slot(counts, _SURVIVORS))] = i + lane
            left = left & (left - wp.uint64(1))
        if ticks:
            passed = _cycles() - start
            for lane in range(count):
                wp.atomic_add(ticks, i + lane, passed // wp.int64(count))

    @wp.kernel(**_KERNEL)
    def classify_survivors(
        first: int,
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        elements: wp.array2d[int],
        pairs: wp.array[wp.vec2i],
        roundoff: wp.float64,
        survivors: wp.array[int],
        status: wp.array[wp.int8],
        open: wp.array[int],
        counts: wp.array[wp.int64],
        ticks: wp.array[wp.int64],
    ):
        slot = first + wp.tid()
        if wp.int64(slot) >= counts[_SURVIVORS]:
            return
        i = survivors[slot]
        start = started(ticks)
        a0, b0, c0, d0 = read(x0, elements, pairs[i])
        a1, b1, c1, d1 = read(x1, elements, pairs[i])
        motion = motion_of(a0, b0, c0, d0, a1, b1, c1, d1, roundoff)
        answer = classify(motion, coplanarity(motion))
        status[i] = wp.int8(answer)
        if answer == UNSURE:
            open[wp.int32(take_slot(counts, _OPEN))] = i
        stop(ticks, i, start)

    @wp.kernel(**_KERNEL)
    def subdivide(
        first: int,
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        elements: wp.array2d[int],
        pairs: wp.array[wp.vec2i],
        roundoff: wp.float64,
        open: wp.array[int],
        status: wp.array[wp.int8],
        unsure: wp.array[int],
        counts: wp.array[wp.int64],
        ticks: wp.array[wp.int64],
    ):
        slot = first + wp.tid()
        if wp.int64(slot) >= counts[_OPEN]:
            return
        i = open[slot]
        start = started(ticks)
        a0, b0, c0, d0 = read(x0, elements, pairs[i])
        a1, b1, c1, d1 = read(x1, elements, pairs[i])
        motion = motion_of(a0, b0, c0, d0, a1, b1, c1, d1, roundoff)
        answer = impact(motion, coplanarity(motion), UNSURE, wp.float64(TOLERANCE)).status
        status[i] = wp.int8(answer)
        if answer == UNSURE:
            unsure[wp.int32(take_slot(counts, _UNSURE))] = i
        stop(ticks, i, start)

    @wp.kernel(**_KERNEL)
    def classify_survivors_reduced(
        first: int,
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        elements: wp.array2d[int],
        pairs: wp.array[wp.vec2i],
        survivors: wp.array[int],
        status: wp.array[wp.int8],
        counts: wp.array[wp.int64],
        ticks: wp.array[wp.int64],
    ):
        slot = first + wp.tid()
        if wp.int64(slot) >= counts[_SURVIVORS]:
            return
        i = survivors[slot]
        start = started(ticks)
        a0, b0, c0, d0 = read(x0, elements, pairs[i])
        a1, b1, c1, d1 = read(x1, elements, pairs[i])
        motion = motion_of(a0, b0, c0, d0, a1, b1, c1, d1, wp.float64(0.0))
        status[i] = wp.int8(classify_reduced(motion, coplanarity(motion)))
        stop(ticks, i, start)

    @wp.kernel(**_KERNEL)
    def cubic(
        first: int,
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        elements: wp.array2d[int],
        pairs: wp.array[wp.vec2i],
        status: wp.array[wp.int8],
        ticks: wp.array[wp.int64],
    ):
        i = first + wp.tid()
        start = started(ticks)
        a0, b0, c0, d0 = read(x0, elements, pairs[i])
        a1, b1, c1, d1 = read(x1, elements, pairs[i])
        status[i] = wp.int8(solve_cubic(a0, b0, c0, d0, a1, b1, c1, d1))
        stop(ticks, i, start)

    @wp.kernel(**_KERNEL)
    def trace(
        first: int,
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        elements: wp.array2d[int],
        pairs: wp.array[wp.vec2i],
        roundoff: wp.float64,
        stage: wp.array[wp.int8],
    ):
        i = first + wp.tid()
        a0, b0, c0, d0 = read(x0, elements, pairs[i])
        a1, b1, c1, d1 = read(x1, elements, pairs[i])
        motion = motion_of(a0, b0, c0, d0, a1, b1, c1, d1, roundoff)
        y = coplanarity(motion)
        decided = int(4)
        if boxes_apart(a0, b0, c0, d0, a1, b1, c1, d1):
            decided = int(0)
        elif certified_sign_cubic(y.k, y.bound) != 0:
            decided = int(1)
        elif direction_separates(motion, centroid_direction(motion)):
            decided = int(2)
        elif classify(motion, y) != UNSURE:
            decided = int(3)
        stage[i] = wp.int8(decided)

    return {
        "cull": cull,
        "cull_batches": cull_batches,
        "classify_survivors": classify_survivors,
        "subdivide": subdivide,
        "classify_survivors_reduced": classify_survivors_reduced,
        "cubic": cubic,
        "trace": trace,
    }


@dataclass(frozen=True)
class Queries:
    """Queries of one kind as pairs of a mesh's elements.

    Attributes:
        kind: "vertex_face" or "edge_edge".
        x0: Positions of the mesh at the start, float32 or float64, shape [vertex_count, 3].
        x1: Positions at its end, of the same type.
        elements: Vertices of its faces (vertex_face) or edges (edge_edge), int32, shape [element_count, 3 or 2].
        pairs: (vertex, face) or (edge, edge), int32, shape [n, 2].
    """

    kind: str
    x0: np.ndarray
    x1: np.ndarray
    elements: np.ndarray
    pairs: np.ndarray

    @classmethod
    def of_points(cls, kind, points) -> "Queries":
        """Queries with four vertices each of their own, from rows as of :func:`warp_bsc.query_vertex_face`."""
        n = len(points)
        x0, x1 = (np.ascontiguousarray(x).reshape(-1, 3) for x in (points[:, :4], points[:, 4:]))
        vertices, rows = np.arange(4 * n, dtype=np.int32).reshape(n, 4), np.arange(n, dtype=np.int32)
        if kind == "vertex_face":
            return cls(kind, x0, x1, np.ascontiguousarray(vertices[:, 1:]), np.stack([4 * rows, rows], axis=1))
        return cls(kind, x0, x1, vertices.reshape(-1, 2), np.stack([2 * rows, 2 * rows + 1], axis=1))

    def points(self, which=slice(None)) -> np.ndarray:
        """Points of some queries, rows as of :func:`warp_bsc.query_vertex_face`, shape [n, 8, 3]."""
        pairs = self.pairs[which]
        first = pairs[:, :1] if self.kind == "vertex_face" else self.elements[pairs[:, 0]]
        corners = np.concatenate([first, self.elements[pairs[:, 1]]], axis=1)
        return np.concatenate([self.x0[corners], self.x1[corners]], axis=1)

    def __len__(self):
        """How many queries there are."""
        return len(self.pairs)


class QuerySet:
    """Queries of one kind on a device.

    Attributes:
        kind: "vertex_face" or "edge_edge".
        count: How many.
        arrays: What all methods read: positions at the start and at the end, Warp arrays of vec3 or vec3d; elements,
            two-dimensional array of int; and pairs, array of vec2i.
    """

    def __init__(self, queries, device, *, repeated=1):
        """Copies :class:`Queries` to a device, their pairs so many times one after the other."""
        self.kind = queries.kind
        self.device = wp.get_device(device)
        self.dtype = wp.vec3 if queries.x0.dtype == np.float32 else wp.vec3d
        pairs = np.tile(queries.pairs, (repeated, 1))
        self.count = len(pairs)
        self.arrays = [
            *(wp.array(x, dtype=self.dtype, device=device) for x in (queries.x0, queries.x1)),
            wp.array(queries.elements, dtype=int, device=device),
            wp.array(pairs, dtype=wp.vec2i, device=device),
        ]


class MethodRun:
    """A method on a set of queries, with its arrays on the device.

    Attributes:
        method: One of :data:`METHODS`.
        queries: The queries.
        status: Of each query after a launch, FREE, HIT or UNSURE, Warp array of int8.
    """

    def __init__(self, method, queries):
        """Makes the arrays."""
        self.method = method
        self.queries = queries
        n, device = queries.count, queries.device
        self.status = wp.zeros(n, dtype=wp.int8, device=device)
        self._counts = wp.zeros(len(_Count), dtype=wp.int64, device=device)
        self._survivors, self._open, *self._unsure = (wp.empty(n, dtype=int, device=device) for _ in range(4))
        self._keys = wp.empty(n if method == "exact" else 0, dtype=wp.int64, device=device)

    def launch(self, *, ticks=None):
        """Answers all queries, without asking the device anything.

        Args:
            ticks: To which the clock cycles of each query are added, but for exact arithmetic's, Warp array of int64.
        """
        queries = self.queries
        kernels = _kernels(queries.kind, queries.dtype)
        arrays = queries.arrays
        if self.method == "cubic":
            outputs = [self.status, ticks]
            launch_over(kernels["cubic"], queries.count, inputs=arrays, outputs=outputs, device=queries.device)
            return
        counts = self._counts
        counts.zero_()
        self.status.zero_()  # FREE, but for what the culls leave
        roundoff = 0.0 if self.method in ("float", "reduced") else ROUNDOFF
        outputs = [self._survivors, counts, ticks]
        inputs = [*arrays, roundoff]
        if queries.device.is_cpu:
            batches = -(-queries.count // BATCH)
            launch_over(
                kernels["cull_batches"], batches, inputs=inputs, outputs=outputs, device=queries.device, chunk=16
            )
        else:
            launch_over(kernels["cull"], queries.count, inputs=inputs, outputs=outputs, device=queries.device)
        entries = [self._survivors, counts, _Count.SURVIVORS]
        if self.method == "reduced":
            inputs, outputs = [*arrays, self._survivors], [self.status, counts, ticks]
            launch_over_queue(kernels["classify_survivors_reduced"], *entries, inputs=inputs, outputs=outputs)
            return
        inputs, outputs = [*arrays, roundoff, self._survivors], [self.status, self._open, counts, ticks]
        launch_over_queue(kernels["classify_survivors"], *entries, inputs=inputs, outputs=outputs)
        if self.method == "float":
            return  # nothing is open
        inputs, outputs = [*arrays, roundoff, self._open], [self.status, self._unsure[0], counts, ticks]
        launch_over_queue(
            kernels["subdivide"], self._open, counts, _Count.OPEN, inputs=inputs, outputs=outputs, block_dim=32
        )
        if self.method == "exact":
            contacts = ContactBuffer()
            contacts.pairs, contacts.decided = arrays[3], self.status
            launch_exact_stage(
                PairKind[queries.kind.upper()],
                *arrays[:3],
                timed=False,
                tolerance=TOLERANCE,
                queues=self._unsure,
                counts=counts,
                filled=_Count.UNSURE,
                too_wide=[_Count.WIDE, _Count.WIDER, _Count.WIDEST],
                refuted=_Count.REFUTED,
                contacts=contacts,
                keys=self._keys,
                last_key=0,
            )

    def find_hits(self):
        """Which queries collide by the method after a launch, bool, shape [n]: all that it has not shown to be free."""
        return self.status.numpy() != FREE


def measure_nanoseconds(run, *, repeat):
    """Median time of a query [ns], all being launched at once: replays of a CUDA graph, launches on the CPU.

    A first launch, which loads the kernels, is not timed.

    Args:
        run: The :class:`MethodRun`.
        repeat: How many repetitions to take the median of.
    """
    return 1e6 * median_milliseconds(run.launch, run.queries.device, repeat) / run.queries.count


def trace_stages(queries):
    """Which of :data:`STAGES` decides each query by method "exact", int8, shape [n]."""
    stage = wp.empty(queries.count, dtype=wp.int8, device=queries.device)
    trace = _kernels(queries.kind, queries.dtype)["trace"]
    launch_over(trace, queries.count, inputs=[*queries.arrays, ROUNDOFF], outputs=[stage], device=queries.device)
    stages = stage.numpy().copy()
    conservative = MethodRun("conservative", queries)
    conservative.launch()
    stages[conservative.status.numpy() == UNSURE] = STAGES.index("exact")
    return stages
