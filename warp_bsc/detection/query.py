"""Elementary queries: many vertex-face or edge-edge pairs at once, each given by its eight points."""

from dataclasses import dataclass

import numpy as np
import warp as wp

from .._arrays import check_finite, checked_shape
from ..kernels.signs import FREE, HIT, UNSURE
from .contact_buffer import HostContacts, read_contacts
from .launch import retry_until_fits
from .narrow_phase import NarrowPhase, decide_on_host
from .settings import TOLERANCE, Count, PairCounts, PairKind, check_method, check_tolerance
from .stage_timer import StageTimer

__all__ = ["QueryResult", "query_edge_edge", "query_vertex_face"]


@dataclass(frozen=True)
class QueryResult:
    """Answers to elementary queries, one row each, without gradients: :mod:`warp_bsc.kernels` has those.

    Attributes:
        hit: Whether the query collides, by the method, bool, shape [n].
        status: What floating point could certify, whatever the method: 0 FREE, 1 HIT, 2 UNSURE, int8, shape [n].
        toi: Time of impact as a share of the step, a lower bound, float64, shape [n]; 2.0 where there is no hit. None
            if not wanted.
        coordinates: Where they touch, float64, shape [n, 3]: barycentric coordinates in the face, or (s, r, 0)
            along the edges; NaN where there is no hit. None if no times were wanted.
        normal: Unit normal of the contact, against the velocity of the vertex or first edge relative to the other
            feature, float64, shape [n, 3]; NaN where there is no hit. None if no times were wanted.
    """

    hit: np.ndarray
    status: np.ndarray
    toi: np.ndarray | None
    coordinates: np.ndarray | None
    normal: np.ndarray | None


def query_vertex_face(
    points: np.ndarray | wp.array,
    *,
    method: str = "exact",
    toi: bool = True,
    tolerance: float = TOLERANCE,
    device: wp.DeviceLike = None,
) -> QueryResult:
    """Returns which moving vertices meet their moving triangles.

    Args:
        points: Positions, float32 or float64, NumPy or Warp array of shape [n, 8, 3], rows p0 a0 b0 c0 p1 a1 b1 c1:
            vertex p and triangle a b c at the start (0) and at the end (1) of the step. Any unit of length.
        method: What becomes of queries that floating point cannot certify, one of :data:`METHODS`.
        toi: Whether to find times of impact, coordinates and normals as well.
        tolerance: Of the times of impact, as a share of the step, in [2^-38, 1].
        device: Warp device to compute on; default: the points' own, or Warp's default for NumPy.

    Returns:
        QueryResult: One row a query.

    Raises:
        ValueError: If the points have another shape or type, are not finite or 2^29 rows or more, or there is no such
            method.
    """
    return _query(PairKind.VERTEX_FACE, points, method, toi, tolerance, device)


def query_edge_edge(
    points: np.ndarray | wp.array,
    *,
    method: str = "exact",
    toi: bool = True,
    tolerance: float = TOLERANCE,
    device: wp.DeviceLike = None,
) -> QueryResult:
    """Returns which pairs of moving edges meet.

    Args:
        points: Positions, float32 or float64, NumPy or Warp array of shape [n, 8, 3], rows a0 b0 c0 d0 a1 b1 c1 d1:
            edges a b and c d at the start (0) and at the end (1) of the step. Any unit of length.
        method: What becomes of queries that floating point cannot certify, one of :data:`METHODS`.
        toi: Whether to find times of impact, coordinates and normals as well.
        tolerance: Of the times of impact, as a share of the step, in [2^-38, 1].
        device: Warp device to compute on; default: the points' own, or Warp's default for NumPy.

    Returns:
        QueryResult: One row a query.

    Raises:
        ValueError: If the points have another shape or type, are not finite or 2^29 rows or more, or there is no such
            method.
    """
    return _query(PairKind.EDGE_EDGE, points, method, toi, tolerance, device)


def _query(
    kind: PairKind,
    points: np.ndarray | wp.array,
    method: str,
    timed: bool,
    tolerance: float,
    device: wp.DeviceLike,
) -> QueryResult:
    check_method(method)
    check_tolerance(tolerance)
    if isinstance(points, wp.array):
        device = points.device if device is None else device
        points = points.numpy()
    points = checked_shape(points, (8, 3), "points")
    n = len(points)
    if n >= 2**29:  # their vertices are numbered by int32
        raise ValueError(f"at most 2^29 - 1 queries can be decided at once, not {n}")
    check_finite(points, "points")
    device = wp.get_device(device)
    # a mesh in which each query has four vertices of its own
    dtype = wp.vec3 if points.dtype == np.float32 else wp.vec3d
    x0 = wp.array(np.ascontiguousarray(points[:, :4]).reshape(-1, 3), dtype=dtype, device=device)
    x1 = wp.array(np.ascontiguousarray(points[:, 4:]).reshape(-1, 3), dtype=dtype, device=device)
    vertices = np.arange(4 * n, dtype=np.int32).reshape(n, 4)
    rows = np.arange(n, dtype=np.int32)
    if kind == PairKind.VERTEX_FACE:
        elements, pairs = vertices[:, 1:], np.stack([4 * rows, rows], axis=1)
    else:
        elements, pairs = vertices.reshape(-1, 2), np.stack([2 * rows, 2 * rows + 1], axis=1)
    elements = wp.array(np.ascontiguousarray(elements), dtype=int, device=device)
    counts = wp.zeros(len(Count), dtype=wp.int64, device=device)
    narrow_phase = NarrowPhase(kind, counts, n, pairs[-1] + 1 if n else (1, 1))
    narrow_phase.queue.assign(pairs)
    all_queued = PairCounts(queued=n).values()

    def solve(method: str) -> tuple[HostContacts, np.ndarray]:
        """The contacts by a method, and the query of each."""
        # exactly also the times of certified hits that floating point could not find within the tolerance
        stages = "exact" if method == "conservative" and timed else method

        def launch() -> None:
            counts.assign(all_queued)
            options = {"method": stages, "timed": timed, "tolerance": tolerance, "timer": StageTimer(None)}
            narrow_phase.run(x0, x1, elements, **options)

        retry_until_fits(launch, narrow_phase, device)
        contacts = read_contacts(narrow_phase.contacts, int(counts.numpy()[Count.CONTACTS]))
        contacts = contacts.rows(contacts.status != FREE)
        if method == "conservative":
            contacts.decided[:] = HIT  # whatever the exact stage has decided
        if method != "float":
            left = contacts.hit & ~contacts.within_tolerance & timed & (contacts.status == HIT)
            if method == "exact":
                left |= contacts.decided == UNSURE
            decide_on_host(kind, x0, x1, elements, contacts, left, timed=timed)
        rows = contacts.pairs[:, 1] if kind == PairKind.VERTEX_FACE else contacts.pairs[:, 0] // 2
        return contacts, rows

    certified, certified_rows = solve("conservative" if method == "float" else method)
    status = np.zeros(n, dtype=np.int8)
    status[certified_rows] = certified.status
    decided, decided_rows = solve("float") if method == "float" else (certified, certified_rows)
    found = decided.hit
    decided_rows = decided_rows[found]
    hit = np.zeros(n, dtype=bool)
    hit[decided_rows] = True
    if not timed:
        return QueryResult(hit, status, None, None, None)
    toi = np.full(n, 2.0)
    coordinates = np.full((n, 3), np.nan)
    normal = np.full((n, 3), np.nan)
    toi[decided_rows] = decided.toi[found]
    coordinates[decided_rows] = decided.coordinates[found]
    normal[decided_rows] = decided.normal[found]
    return QueryResult(hit, status, toi, coordinates, normal)
