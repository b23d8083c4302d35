"""Results of elementary queries that stay on their device, and the buffers to find them without the host."""

from typing import Any

import numpy as np
import warp as wp

from ..._arguments import check_instance, checked_choice, checked_flag, checked_integer
from ...kernels.motion import all_finite
from ...kernels.pipeline.queues import take_slot
from ...kernels.signs import FREE, UNSURE
from ..narrow.narrow_phase import NarrowPhase
from ..narrow.pair_kernels import PairBuffers
from ..narrow.rules.contact import run_contacts
from ..run.host_function import run_on_host
from ..run.launch import launch_over, launch_over_queue, made_once
from ..run.phase_timer import PhaseTimer
from ..run.settings import METHODS, NO_GRADIENTS, Count, Method, PairCounts, PairKind, checked_tolerance
from ..run.start import checked_device
from .query_points import elements_of_rows

_MAX_QUERIES = 2**28 - 1
"""Their eight points each are numbered by int32."""

_FLOAT, _CONSERVATIVE, _EXACT = (wp.constant(METHODS.index(method)) for method in METHODS)


@wp.struct
class _Rows:
    """The results of queries, a row each; without times, the last three have no rows."""

    hit: wp.array[wp.bool]
    status: wp.array[wp.int8]
    toi: wp.array[wp.float64]
    coordinates: wp.array[wp.vec3d]
    normal: wp.array[wp.vec3d]


@made_once
def _begin_rows(dtype: type) -> wp.Kernel:
    """Returns the kernel that writes the rows of queries that are free, and of those that are not finite."""

    @wp.kernel(**NO_GRADIENTS)
    def begin_rows(
        first: int,
        # in
        x: wp.array[dtype],
        timed: bool,
        # out
        rows: _Rows,
        # in and out
        not_finite: wp.array[wp.int64],
    ):
        i = first + wp.tid()
        j = 8 * i
        finite = all_finite(x[j], x[j + 1], x[j + 2], x[j + 3], x[j + 4], x[j + 5], x[j + 6], x[j + 7])
        if not finite:
            take_slot(not_finite, 0)
        rows.hit[i] = not finite
        rows.status[i] = wp.int8(wp.where(finite, FREE, UNSURE))
        if timed:
            rows.toi[i] = wp.where(finite, wp.float64(2.0), wp.float64(0.0))
            rows.coordinates[i] = wp.vec3d(wp.float64(wp.nan))
            rows.normal[i] = wp.vec3d(wp.float64(wp.nan))

    return begin_rows


@wp.kernel(**NO_GRADIENTS)
def _write_contacts(
    first: int,
    # in
    buffers: PairBuffers,
    points: int,
    method: int,
    timed: bool,
    # out
    rows: _Rows,
    # in and out
    undecided: wp.array[wp.int64],
):
    """Writes the rows of the contacts that are not certified free, but for queries that are not finite."""
    slot = first + wp.tid()
    if wp.int64(slot) >= buffers.counts[Count.CONTACTS]:
        return
    contacts = buffers.contacts
    status = contacts.status[slot]
    i = contacts.pairs[slot][0] // points
    if status == wp.int8(FREE) or rows.hit[i]:
        return
    hit = method == _CONSERVATIVE or contacts.decided[slot] != wp.int8(FREE)
    rows.status[i] = status
    rows.hit[i] = hit
    is_late = timed and status != wp.int8(UNSURE) and not contacts.within_tolerance[slot]
    if method != _FLOAT and (is_late or (method == _EXACT and contacts.decided[slot] == wp.int8(UNSURE))):
        take_slot(undecided, 0)
    if timed and hit:
        rows.toi[i] = contacts.toi[slot]
        rows.coordinates[i] = contacts.coordinates[slot]
        rows.normal[i] = contacts.normal[slot]


class DeviceQueryResult:
    """Results of elementary queries as arrays on their device, for ``out=`` of the functions that query.

    Nothing is copied to the host, and nothing waits for the device. After a first call, which allocates buffers and
    loads kernels, a CUDA graph may capture the calls; each replay decides the points that the array then holds::

        out = bsc.DeviceQueryResult(len(points), device=points.device)
        bsc.query_vertex_face(points, out=out)
        with wp.ScopedCapture(points.device) as capture:
            bsc.query_vertex_face(points, out=out)
        wp.capture_launch(capture.graph)

    What would be an error on the host cannot be raised there. It is counted, and the queries in question are hits.

    Attributes:
        hit: Whether the query collides, by the method, array of bool, shape [n].
        status: Certified status by floating point, 0 FREE, 1 HIT, 2 UNSURE, array of int8, shape [n]. By method "float"
            it is the status by the signs that floating point computes, which certify nothing.
        toi: Time of impact as a share of the step, a lower bound, array of float64, shape [n]; 2.0 where there is no
            hit. None without times.
        coordinates: As of :class:`QueryResult`, array of vec3d, shape [n]. None without times.
        normal: As of :class:`QueryResult`, array of vec3d, shape [n]. None without times.
        not_finite: Number of queries with a point that is not finite, array of one int64. They are hits at time 0 with
            the status UNSURE, without coordinates and normal (NaN).
        undecided: Number of queries that exact arithmetic would have to decide, or whose times it would have to find,
            and that are too wide for it on the device, array of one int64: in double precision, with exponents some 290
            apart. They stay as floating point has them: those that are UNSURE are hits, and times are lower bounds, but
            may be earlier than the tolerance allows.
    """

    hit: wp.array
    status: wp.array
    toi: wp.array | None
    coordinates: wp.array | None
    normal: wp.array | None
    not_finite: wp.array
    undecided: wp.array

    def __init__(self, count: int, *, toi: bool = True, device: wp.DeviceLike = None):
        """Allocates results.

        Args:
            count: Number of queries, n, less than 2^28.
            toi: Whether there are times of impact, coordinates and normals.
            device: Warp device; default: Warp's default.

        Raises:
            TypeError: If an argument has another type.
            ValueError: If the number of queries is out of range, or the device does not exist.
        """
        n = checked_integer(count, "count", 0)
        if n > _MAX_QUERIES:
            raise ValueError(f"count must be less than 2^28, not {n}")
        self.device = checked_device(device)
        self.count = n
        timed = checked_flag(toi, "toi")
        self._rows = rows = _Rows()
        rows.hit = self.hit = wp.zeros(n, dtype=wp.bool, device=self.device)
        rows.status = self.status = wp.zeros(n, dtype=wp.int8, device=self.device)
        self.toi = self.coordinates = self.normal = None
        if timed:
            rows.toi = self.toi = wp.full(n, 2.0, dtype=wp.float64, device=self.device)
            rows.coordinates = self.coordinates = wp.empty(n, dtype=wp.vec3d, device=self.device)
            rows.normal = self.normal = wp.empty(n, dtype=wp.vec3d, device=self.device)
        self.not_finite, self.undecided = (wp.zeros(1, dtype=wp.int64, device=self.device) for _ in range(2))
        self._counts = wp.zeros(len(Count), dtype=wp.int64, device=self.device)
        self._start_counts = wp.array(PairCounts(queued=n), dtype=wp.int64, device=self.device)
        self._narrow_phases: dict[PairKind, tuple[NarrowPhase, wp.array]] = {}
        self._loaded: set[tuple[PairKind, type, Method]] = set()

    def _buffers(self, kind: PairKind) -> tuple[NarrowPhase, wp.array]:
        """Returns the narrow phase of a kind, with the queries in its queue, and the vertices of its elements."""
        if kind not in self._narrow_phases:
            # points at the start of query i are vertices 8 i to 8 i + 3
            vertices = np.arange(0, 8 * self.count, 8, dtype=np.int32)[:, None] + np.arange(4, dtype=np.int32)
            elements, pairs = elements_of_rows(kind, vertices)
            narrow_phase = NarrowPhase(kind, self._counts, self.count, pairs[-1] + 1 if self.count else (1, 1))
            narrow_phase.fit_all()
            narrow_phase.queue.assign(pairs)
            self._narrow_phases[kind] = narrow_phase, wp.array(elements, dtype=int, device=self.device)
        return self._narrow_phases[kind]

    def _find(self, kind: PairKind, x: wp.array, method: Method, tolerance: float) -> None:
        """Finds the results of queries whose points are the rows of an array, eight each."""
        narrow_phase, elements = self._buffers(kind)
        device, timed = self.device, self.toi is not None
        wp.copy(self._counts, self._start_counts)
        self.not_finite.zero_()
        self.undecided.zero_()
        if not self.count:
            return
        inputs, outputs = [x, timed], [self._rows, self.not_finite]
        launch_over(_begin_rows(x.dtype), self.count, inputs=inputs, outputs=outputs, device=device)
        # the exact phase also finds the times of certified hits that floating point did not find within the tolerance
        buffers = "exact" if method == "conservative" and timed else method
        options = {"method": buffers, "timed": timed, "tolerance": tolerance, "timer": PhaseTimer(None)}
        run_contacts([(narrow_phase, elements)], x, x[4:], **options)
        buffers = narrow_phase.pair_buffers(elements)
        points = 8 if kind == PairKind.VERTEX_FACE else 2
        inputs, outputs = [buffers, points, METHODS.index(method), timed], [self._rows, self.undecided]
        queue = buffers.order, self._counts, Count.CONTACTS
        launch_over_queue(_write_contacts, *queue, inputs=inputs, outputs=outputs)


def query_into(
    out: Any, kind: PairKind, points: Any, min_distance: Any, method: Any, timed: Any, tolerance: Any, device: Any
) -> DeviceQueryResult:
    """Decides queries on the device of their points, or adds this to the graph that the device captures.

    Arguments, result and errors are those of :func:`warp_bsc.query_vertex_face` with ``out``.
    """
    check_instance(out, "out", DeviceQueryResult, "a DeviceQueryResult")
    if not isinstance(points, wp.array):
        raise TypeError(f"points must be a Warp array if there is out, not {type(points).__name__}")
    checked_choice(method, "method", METHODS)
    if checked_flag(timed, "toi") != (out.toi is not None):
        raise ValueError(f"toi must be {out.toi is not None}, as out was made with")
    if device is not None and checked_device(device) != out.device:
        raise ValueError(f"device must be that of out, {out.device}, not {device}")
    if not isinstance(min_distance, (int, float)) or min_distance != 0.0:
        raise ValueError("min_distance must be 0 if there is out")
    tolerance, x = checked_tolerance(tolerance), _vectors_of(points, out)
    key: tuple[PairKind, type, Method] = (kind, x.dtype, method)
    if out.device.is_cuda and out.device.is_capturing and key not in out._loaded:
        raise RuntimeError(
            "query once with this out, method and type of points before capturing, so that kernels are loaded and "
            "buffers are there"
        )
    run_on_host(lambda: out._find(kind, x, method, tolerance), out.device)
    out._loaded.add(key)
    return out


def _vectors_of(points: wp.array, out: DeviceQueryResult) -> wp.array:
    """Returns the points of queries as a view, array of vec3 or vec3d, shape [8 n], see :func:`query_into`."""
    dtypes = {wp.float32: wp.vec3, wp.float64: wp.vec3d, wp.vec3: wp.vec3, wp.vec3d: wp.vec3d}
    if points.dtype not in dtypes:
        raise TypeError(f"points must be float32 or float64, not {points.dtype.__name__}")
    is_scalar = points.dtype in (wp.float32, wp.float64)
    shape = tuple(points.shape) if is_scalar else (*points.shape, 3)
    if shape != (out.count, 8, 3):
        raise ValueError(f"points must have shape ({out.count}, 8, 3), as out has {out.count} rows, not {shape}")
    if points.device != out.device:
        raise ValueError(f"points must be on {out.device}, as out is, not on {points.device}")
    if not points.is_contiguous:
        raise ValueError("points must be contiguous if there is out")
    return points.view(dtypes[points.dtype]).flatten()
