"""What the paper's benchmarks compare: each method as a kernel that reads a query's points and writes its answer.

All read the same arrays, one query a thread, and answer the same question: whether the two features meet. What each
does, and what not, so that the times can be compared:

- ``float``, ``conservative``: the stages of the detector, without and with error bounds: boxes, the signs of the
  Bernstein coefficients, a separating direction; then, for what these leave, in a kernel of its own, classification
  and the subdivision of what that leaves open. UNSURE is a collision.
- ``exact``: the same as ``conservative``, and the exact stage of the detector for what is UNSURE.
- ``cubic``: :mod:`warp_bsc.baselines.cubic_solver`. It stops at the first root at which the features are close, so it
  knows a time, too; that time is not written.
- ``reduced``: ``float`` with the paper's own inside tests, :mod:`warp_bsc.baselines.reduced_inside_test`. As there is
  no subdivision in the paper, what classification leaves open is a collision at once: weak inequalities, as it has
  them.

None is asked for a time of impact, and none looks whether numbers are finite, which is done once a vertex.
"""

import enum
import functools

import numpy as np
import warp as wp

from .baselines import classify_reduced, cubic_solver_edge_edge, cubic_solver_vertex_face
from .bench import median_milliseconds
from .exact_stage import launch_exact_stage
from .kernels.ccd import edge_edge_motion, vertex_face_motion
from .kernels.classification import classify
from .kernels.culling import centroid_direction, direction_separates, edge_edge_boxes_apart, vertex_face_boxes_apart
from .kernels.polynomials import coplanarity
from .kernels.queues import take_slot
from .kernels.signs import FREE, ROUNDOFF, UNSURE, certified_sign_cubic
from .kernels.time_of_impact import impact
from .launching import launch_over, launch_over_queue
from .narrow_phase import TOLERANCE

__all__ = ["METHODS", "STAGES", "MethodRun", "QuerySet", "measure_nanoseconds", "trace_stages"]

METHODS = ("float", "conservative", "exact", "cubic", "reduced")
"""What is compared."""

STAGES = ("axis boxes", "Bernstein signs", "separating direction", "classification", "subdivision", "exact")
"""What decides a query, in the order in which they are tried."""

_KERNEL = {"enable_backward": False, "module": "unique", "module_options": {"fuse_fp": False}}
"""Without fused operations every device computes the same bits."""

_CYCLES = """
#if defined(__CUDA_ARCH__)
    return clock64();
#else
    return (int64_t)__builtin_readcyclecounter();
#endif
"""


class _Count(enum.IntEnum):
    """Places of the counts of a run: the queries that the culls leave, that floating point does, that are too wide."""

    SURVIVORS = 0
    UNSURE = 1
    WIDE = 2
    WIDER = 3
    WIDEST = 4
    REFUTED = 5


_SURVIVORS = wp.constant(int(_Count.SURVIVORS))
_UNSURE = wp.constant(int(_Count.UNSURE))


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
    def read(x: wp.array[dtype], i: int):
        return x[4 * i], x[4 * i + 1], x[4 * i + 2], x[4 * i + 3]

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
        roundoff: wp.float64,
        status: wp.array[wp.int8],
        survivors: wp.array[int],
        counts: wp.array[wp.int64],
        ticks: wp.array[wp.int64],
    ):
        i = first + wp.tid()
        start = started(ticks)
        a0, b0, c0, d0 = read(x0, i)
        a1, b1, c1, d1 = read(x1, i)
        status[i] = wp.int8(FREE)
        if not boxes_apart(a0, b0, c0, d0, a1, b1, c1, d1):
            motion = motion_of(a0, b0, c0, d0, a1, b1, c1, d1, roundoff)
            y = coplanarity(motion)
            if certified_sign_cubic(y.k, y.bound) == 0:
                if not direction_separates(motion, centroid_direction(motion)):
                    survivors[wp.int32(take_slot(counts, _SURVIVORS))] = i
        stop(ticks, i, start)

    @wp.kernel(**_KERNEL)
    def classify_survivors(
        first: int,
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        roundoff: wp.float64,
        survivors: wp.array[int],
        status: wp.array[wp.int8],
        unsure: wp.array[int],
        counts: wp.array[wp.int64],
        ticks: wp.array[wp.int64],
    ):
        slot = first + wp.tid()
        if wp.int64(slot) >= counts[_SURVIVORS]:
            return
        i = survivors[slot]
        start = started(ticks)
        a0, b0, c0, d0 = read(x0, i)
        a1, b1, c1, d1 = read(x1, i)
        motion = motion_of(a0, b0, c0, d0, a1, b1, c1, d1, roundoff)
        y = coplanarity(motion)
        answer = classify(motion, y)
        if answer == UNSURE:
            result = impact(motion, y, answer, wp.float64(TOLERANCE))
            answer = result.status
        status[i] = wp.int8(answer)
        if answer == UNSURE:
            unsure[wp.int32(take_slot(counts, _UNSURE))] = i
        stop(ticks, i, start)

    @wp.kernel(**_KERNEL)
    def classify_survivors_reduced(
        first: int,
        x0: wp.array[dtype],
        x1: wp.array[dtype],
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
        a0, b0, c0, d0 = read(x0, i)
        a1, b1, c1, d1 = read(x1, i)
        motion = motion_of(a0, b0, c0, d0, a1, b1, c1, d1, wp.float64(0.0))
        status[i] = wp.int8(classify_reduced(motion, coplanarity(motion)))
        stop(ticks, i, start)

    @wp.kernel(**_KERNEL)
    def cubic(
        first: int,
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        status: wp.array[wp.int8],
        ticks: wp.array[wp.int64],
    ):
        i = first + wp.tid()
        start = started(ticks)
        a0, b0, c0, d0 = read(x0, i)
        a1, b1, c1, d1 = read(x1, i)
        status[i] = wp.int8(solve_cubic(a0, b0, c0, d0, a1, b1, c1, d1))
        stop(ticks, i, start)

    @wp.kernel(**_KERNEL)
    def trace(first: int, x0: wp.array[dtype], x1: wp.array[dtype], roundoff: wp.float64, stage: wp.array[wp.int8]):
        i = first + wp.tid()
        a0, b0, c0, d0 = read(x0, i)
        a1, b1, c1, d1 = read(x1, i)
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
        "classify_survivors": classify_survivors,
        "classify_survivors_reduced": classify_survivors_reduced,
        "cubic": cubic,
        "trace": trace,
    }


class QuerySet:
    """Queries of one kind on a device.

    Attributes:
        kind: "vertex_face" or "edge_edge".
        count: How many.
        x0: Their points at the start, four in a row each, Warp array of vec3 or vec3d.
        x1: Their points at the end.
        elements: Faces or edges of the mesh in which each query has four vertices of its own.
        pairs: The queries as pairs of elements of that mesh, array of vec2i.
    """

    def __init__(self, kind, points, device):
        """Copies queries to a device.

        Args:
            kind: "vertex_face" or "edge_edge".
            points: NumPy array, rows as of :func:`warp_bsc.query_vertex_face`, shape [n, 8, 3].
            device: Warp device.
        """
        self.kind = kind
        self.device = wp.get_device(device)
        self.count = n = len(points)
        dtype = wp.vec3 if points.dtype == np.float32 else wp.vec3d
        self.x0, self.x1 = (
            wp.array(np.ascontiguousarray(x).reshape(-1, 3), dtype=dtype, device=device)
            for x in (points[:, :4], points[:, 4:])
        )
        vertices, rows = np.arange(4 * n, dtype=np.int32).reshape(n, 4), np.arange(n, dtype=np.int32)
        if kind == "vertex_face":
            elements, pairs = vertices[:, 1:], np.stack([4 * rows, rows], axis=1)
        else:
            elements, pairs = vertices.reshape(-1, 2), np.stack([2 * rows, 2 * rows + 1], axis=1)
        self.elements = wp.array(np.ascontiguousarray(elements), dtype=int, device=device)
        self.pairs = wp.array(pairs, dtype=wp.vec2i, device=device)


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
        self._survivors, *self._unsure = (wp.empty(n, dtype=int, device=device) for _ in range(3))
        self._keys = wp.empty(n if method == "exact" else 0, dtype=wp.int64, device=device)

    def launch(self, *, ticks=None):
        """Answers all queries, without asking the device anything.

        Args:
            ticks: To which the clock cycles of each query are added, but for exact arithmetic's, Warp array of int64.
        """
        queries = self.queries
        kernels = _kernels(queries.kind, queries.x0.dtype)
        points = [queries.x0, queries.x1]
        if self.method == "cubic":
            outputs = [self.status, ticks]
            launch_over(kernels["cubic"], queries.count, inputs=points, outputs=outputs, device=queries.device)
            return
        counts = self._counts
        counts.zero_()
        roundoff = 0.0 if self.method in ("float", "reduced") else ROUNDOFF
        outputs = [self.status, self._survivors, counts, ticks]
        inputs = [*points, roundoff]
        launch_over(kernels["cull"], queries.count, inputs=inputs, outputs=outputs, device=queries.device)
        entries = [self._survivors, counts, _Count.SURVIVORS]
        if self.method == "reduced":
            inputs, outputs = [*points, self._survivors], [self.status, counts, ticks]
            launch_over_queue(kernels["classify_survivors_reduced"], *entries, inputs=inputs, outputs=outputs)
            return
        inputs, outputs = [*points, roundoff, self._survivors], [self.status, self._unsure[0], counts, ticks]
        launch_over_queue(kernels["classify_survivors"], *entries, inputs=inputs, outputs=outputs)
        if self.method == "exact":
            launch_exact_stage(
                queries.kind,
                *points,
                queries.elements,
                timed=False,
                tolerance=TOLERANCE,
                queues=self._unsure,
                counts=counts,
                asked=int(_Count.UNSURE),
                too_wide=[int(_Count.WIDE), int(_Count.WIDER), int(_Count.WIDEST)],
                refuted=int(_Count.REFUTED),
                contacts=[queries.pairs, self.status, *[None] * 4],
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
    inputs = [queries.x0, queries.x1, ROUNDOFF]
    trace = _kernels(queries.kind, queries.x0.dtype)["trace"]
    launch_over(trace, queries.count, inputs=inputs, outputs=[stage], device=queries.device)
    stages = stage.numpy().copy()
    conservative = MethodRun("conservative", queries)
    conservative.launch()
    stages[conservative.status.numpy() == UNSURE] = STAGES.index("exact")
    return stages
