"""Elementary queries: many pairs of vertices, edges and faces at once, each given by its points."""

from dataclasses import dataclass
from typing import Any, Protocol, overload

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..._arguments import check_finite, checked_choice, checked_distances, checked_flag, checked_shape
from ...kernels.signs import FREE, HIT, UNSURE
from ..narrow.contact_buffer import HostContacts, read_contacts
from ..narrow.narrow_phase import NarrowPhase
from ..narrow.on_host import decide_on_host
from ..narrow.rings import Rings
from ..narrow.rules.contact import run_contacts
from ..narrow.rules.distance import run_distances
from ..run.launch import retry_until_fits
from ..run.phase_timer import PhaseTimer
from ..run.settings import METHODS, SURFACE_KINDS, TOLERANCE, Count, Method, PairCounts, PairKind, checked_tolerance
from ..run.start import checked_device
from .query_arrays import DeviceQueryResult, query_into
from .query_points import mesh_of_rows


@dataclass(frozen=True)
class QueryResult:
    """The results of elementary queries, one row each, without gradients: :mod:`warp_bsc.kernels` has those.

    Attributes:
        hit: Whether the query collides, by the method, bool, shape [n].
        status: Certified status by floating point, for any method: 0 FREE, 1 HIT, 2 UNSURE, int8, shape [n].
        toi: Time of impact as a share of the step, a lower bound, float64, shape [n]; 2.0 where there is no hit. None
            for a query without times.
        coordinates: Where they touch or come within the minimum distance, float64, shape [n, 3]: barycentric
            coordinates in the face, (s, r, 0) along the edges, (s, 0, 0) along the edge of a vertex-edge pair; NaN
            where there is no hit. None for a query without times.
        normal: Unit normal of the face, or of both edges, against the velocity of the vertex or first edge
            relative to the other feature, see :attr:`.Collisions.vertex_face_normal` for motion in one plane; with a
            minimum distance from the other feature to it. float64, shape [n, 3]; NaN where there is no hit. None for a
            query without times.
    """

    hit: np.ndarray
    status: np.ndarray
    toi: np.ndarray | None
    coordinates: np.ndarray | None
    normal: np.ndarray | None


class _Query(Protocol):
    """The types of a query: with ``out``, its results are that."""

    @overload
    def __call__(
        self,
        points: ArrayLike | wp.array,
        *,
        min_distance: ArrayLike = 0.0,
        method: Method = "exact",
        toi: bool = True,
        tolerance: float = TOLERANCE,
        device: wp.DeviceLike = None,
        out: None = None,
    ) -> QueryResult: ...
    @overload
    def __call__(
        self,
        points: wp.array,
        *,
        method: Method = "exact",
        toi: bool = True,
        tolerance: float = TOLERANCE,
        out: DeviceQueryResult,
    ) -> DeviceQueryResult: ...


def _typed(query: Any) -> _Query:
    return query


@_typed
def query_vertex_face(
    points: ArrayLike | wp.array,
    *,
    min_distance: ArrayLike = 0.0,
    method: Method = "exact",
    toi: bool = True,
    tolerance: float = TOLERANCE,
    device: wp.DeviceLike = None,
    out: DeviceQueryResult | None = None,
) -> QueryResult | DeviceQueryResult:
    """Returns which moving vertices meet their moving triangles.

    Args:
        points: Positions, float32 or float64, NumPy or Warp array of shape [n, 8, 3], rows p0 a0 b0 c0 p1 a1 b1 c1:
            vertex p and triangle a b c at the start (0) and at the end (1) of the step. Any unit of length.
        min_distance: Distance up to which a pair collides, in the unit of the positions, 0 or at least 2^-1021, taken
            as exact: one for all queries, or one each, shape [n].
        method: What becomes of queries that floating point cannot certify, one of :data:`METHODS`.
        toi: Whether to find times of impact, coordinates and normals as well.
        tolerance: Of the times of impact, as a share of the step, in [2^-38, 1].
        device: Warp device to compute on; default: the points' own, or Warp's default for NumPy.
        out: Results that stay on the device, to write to: nothing waits for the device, and a graph may capture the
            call, see :class:`DeviceQueryResult`. The points must be a contiguous Warp array on the same device, and
            there must be no minimum distance.

    Returns:
        QueryResult: One row a query; or ``out``.

    Raises:
        TypeError: If an argument has another type.
        ValueError: If the points have another shape or type, are not finite or 2^29 rows or more, a distance or the
            tolerance is out of range, or the method is unknown. With ``out``: if it has another
            number of rows or another device than the points, the points are not contiguous, ``toi`` is not as in it, or
            there is a minimum distance.
        RuntimeError: With ``out``: if a GPU captures a graph before the first such call.
    """
    return _query(PairKind.VERTEX_FACE, points, min_distance, method, toi, tolerance, device, out)


@_typed
def query_edge_edge(
    points: ArrayLike | wp.array,
    *,
    min_distance: ArrayLike = 0.0,
    method: Method = "exact",
    toi: bool = True,
    tolerance: float = TOLERANCE,
    device: wp.DeviceLike = None,
    out: DeviceQueryResult | None = None,
) -> QueryResult | DeviceQueryResult:
    """Returns which pairs of moving edges meet, with arguments, result and errors as of :func:`query_vertex_face`.

    The points have shape [n, 8, 3], rows a0 b0 c0 d0 a1 b1 c1 d1: edges a b and c d at the start (0) and at the end (1)
    of the step.
    """
    return _query(PairKind.EDGE_EDGE, points, min_distance, method, toi, tolerance, device, out)


def query_vertex_edge(
    points: ArrayLike | wp.array,
    *,
    min_distance: ArrayLike = 0.0,
    method: Method = "exact",
    toi: bool = True,
    tolerance: float = TOLERANCE,
    device: wp.DeviceLike = None,
) -> QueryResult:
    """Returns which moving vertices come within a distance of their moving edges.

    The points have shape [n, 6, 3], rows p0 a0 b0 p1 a1 b1: vertex p and edge a b at the start (0) and at the end (1)
    of the step. Other arguments, result and errors are those of :func:`query_vertex_face`.
    """
    return _query(PairKind.VERTEX_EDGE, points, min_distance, method, toi, tolerance, device)


def query_vertex_vertex(
    points: ArrayLike | wp.array,
    *,
    min_distance: ArrayLike = 0.0,
    method: Method = "exact",
    toi: bool = True,
    tolerance: float = TOLERANCE,
    device: wp.DeviceLike = None,
) -> QueryResult:
    """Returns which pairs of moving vertices come within a distance of each other.

    The points have shape [n, 4, 3], rows p0 q0 p1 q1: vertices p and q at the start (0) and at the end (1) of the step.
    Other arguments, result and errors are those of :func:`query_vertex_face`.
    """
    return _query(PairKind.VERTEX_VERTEX, points, min_distance, method, toi, tolerance, device)


def _query(kind, points, min_distance, method, timed, tolerance, device, out=None) -> Any:
    if out is not None:
        return query_into(out, kind, points, min_distance, method, timed, tolerance, device)
    checked_choice(method, "method", METHODS)
    tolerance = checked_tolerance(tolerance)
    timed = checked_flag(timed, "toi")
    if isinstance(points, wp.array):
        device = points.device if device is None else device
        points = points.numpy()
    points = checked_shape(points, (2 * kind.points, 3), "points")
    n = len(points)
    if n >= 2**29:  # their vertices are numbered by int32
        raise ValueError(f"points must have at most 2^29 - 1 rows, not {n}")
    check_finite(points, "points")
    distance = checked_distances(min_distance, "min_distance", n)
    device = checked_device(device)
    half = kind.points
    x0, elements, pairs = mesh_of_rows(kind, points[:, :half], device)
    x1 = mesh_of_rows(kind, points[:, half:], device)[0]
    counts = wp.zeros(len(Count), dtype=wp.int64, device=device)
    narrow_phase = NarrowPhase(kind, counts, n, pairs[-1] + 1 if n else (1, 1))
    narrow_phase.queue.assign(pairs)
    # without a distance: the narrow phase of contacts
    contact = kind in SURFACE_KINDS and not distance.any()
    radius = np.zeros((n, half))  # 0 of all vertices but those of the first element, so that the sum of two is exact
    radius[:, : 2 if kind == PairKind.EDGE_EDGE else 1] = distance.reshape(-1, 1)
    radius = radius.ravel()
    device_radius = wp.array(radius, dtype=wp.float64, device=device)

    def solve(method: Method) -> tuple[HostContacts, np.ndarray]:
        """Returns the contacts by a method, and the query of each."""
        # the exact phase also finds the times of certified hits that floating point did not find within the tolerance
        buffers = "exact" if method == "conservative" and timed else method

        def launch() -> None:
            counts.assign(PairCounts(queued=n))
            options = {"method": buffers, "timed": timed, "tolerance": tolerance, "timer": PhaseTimer(None)}
            if contact:
                run_contacts([(narrow_phase, elements)], x0, x1, **options)
            else:
                run_distances([(narrow_phase, elements)], x0, x1, device_radius, Rings(), **options)

        retry_until_fits(launch, narrow_phase, device)
        contacts = read_contacts(narrow_phase.contacts, int(counts.numpy()[Count.CONTACTS]))
        contacts = contacts.rows(contacts.status != FREE)
        if method == "conservative":
            contacts.decided[:] = HIT  # also those that the exact phase has refuted
        if method != "float":
            left = contacts.hit & ~contacts.within_tolerance & timed & (contacts.status == HIT)
            if method == "exact":
                left |= contacts.decided == UNSURE
            decide_on_host(kind, x0, x1, elements, None if contact else radius, contacts, left, timed=timed)
        return contacts, contacts.pairs[:, 0] // (2 if kind == PairKind.EDGE_EDGE else half)

    found, rows = solve("conservative" if method == "float" else method)
    status = np.zeros(n, dtype=np.int8)
    status[rows] = found.status
    if method == "float":
        found, rows = solve("float")
    found, rows = found.rows(found.hit), rows[found.hit]
    hit = np.zeros(n, dtype=bool)
    hit[rows] = True
    if not timed:
        return QueryResult(hit, status, None, None, None)
    toi, coordinates, normal = np.full(n, 2.0), np.full((n, 3), np.nan), np.full((n, 3), np.nan)
    toi[rows], coordinates[rows], normal[rows] = found.toi, found.coordinates, found.normal
    return QueryResult(hit, status, toi, coordinates, normal)
