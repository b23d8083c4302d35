"""Elementary queries with a minimum distance, of vertices, edges and faces."""

import enum
import functools

import numpy as np
import warp as wp

from .. import checker
from ..kernels import polynomials
from ..kernels.ccd import impact_at_distance
from ..kernels.min_distance import closest_at
from ..kernels.motion import relative_motion
from ..kernels.polynomials import EDGE_EDGE, VERTEX_FACE
from ..kernels.signs import FREE, HIT, ROUNDOFF, UNSURE
from .settings import NO_FUSED_OPERATIONS

__all__ = ["DistanceAnswers", "DistanceKind", "answer_at_distance", "checked_distance"]


class DistanceKind(enum.IntEnum):
    """The kinds of pairs that may have a minimum distance, with the values that kernels take."""

    VERTEX_FACE = int(polynomials.VERTEX_FACE)
    EDGE_EDGE = int(polynomials.EDGE_EDGE)
    VERTEX_EDGE = int(polynomials.VERTEX_EDGE)
    VERTEX_VERTEX = int(polynomials.VERTEX_VERTEX)

    @property
    def label(self) -> str:
        """The name in attributes of results and in the checker: "vertex_face" and so on."""
        return self.name.lower()

    @property
    def point_order(self) -> list[int]:
        """The point of the pair at each of the four places that kernels take: p a b a, p q q q."""
        if self == DistanceKind.VERTEX_EDGE:
            return [0, 1, 2, 1]
        return [0, 1, 1, 1] if self == DistanceKind.VERTEX_VERTEX else [0, 1, 2, 3]

    @property
    def points(self) -> int:
        """Number of points of a pair."""
        return max(self.point_order) + 1


def checked_distance(
    min_distance: float | np.ndarray, shape: tuple[int, ...], name: str = "min_distance"
) -> np.ndarray:
    """Returns a distance, or one each, in double precision.

    Raises:
        ValueError: If the distances are neither one number nor of the shape, or not finite and at least 0.
    """
    distance = np.asarray(min_distance, dtype=np.float64)
    if distance.shape not in ((), shape):
        raise ValueError(f"min_distance must be one number or have shape {shape}, not {distance.shape}")
    if not (np.isfinite(distance) & (distance >= 0.0)).all():
        raise ValueError("min_distance must be finite and at least 0")
    return distance


@functools.cache
def _kernels(dtype: type) -> tuple[wp.Kernel, wp.Kernel]:
    """Returns the kernels that decide queries and that find closest points, for one type of position."""

    @wp.kernel(**NO_FUSED_OPERATIONS)
    def decide(
        # in
        kind: int,
        points: wp.array2d[dtype],
        distance: wp.array[wp.float64],
        roundoff: wp.float64,
        timed: bool,
        tolerance: wp.float64,
        # out
        status: wp.array[wp.int8],
        within_tolerance: wp.array[wp.bool],
        toi: wp.array[wp.float64],
        coordinates: wp.array[wp.vec3d],
        normal: wp.array[wp.vec3d],
    ):
        i = wp.tid()
        result = impact_at_distance(
            kind,
            points[i, 0],
            points[i, 1],
            points[i, 2],
            points[i, 3],
            points[i, 4],
            points[i, 5],
            points[i, 6],
            points[i, 7],
            distance[i],
            roundoff,
            timed,
            tolerance,
        )
        status[i] = wp.int8(result.status)
        within_tolerance[i] = result.within_tolerance == 1
        toi[i] = result.toi
        coordinates[i] = result.coordinates
        normal[i] = result.normal

    @wp.kernel(**NO_FUSED_OPERATIONS)
    def find_closest(
        # in
        kind: int,
        points: wp.array2d[dtype],
        time: wp.array[wp.float64],
        # out
        coordinates: wp.array[wp.vec3d],
        normal: wp.array[wp.vec3d],
    ):
        i = wp.tid()
        motion = relative_motion(
            wp.where(kind == EDGE_EDGE, EDGE_EDGE, VERTEX_FACE),
            points[i, 0],
            points[i, 1],
            points[i, 2],
            points[i, 3],
            points[i, 4],
            points[i, 5],
            points[i, 6],
            points[i, 7],
            wp.float64(0.0),
        )
        at, direction = closest_at(kind, motion, time[i])
        coordinates[i] = at
        normal[i] = direction

    return decide, find_closest


class DistanceAnswers:
    """Answers to queries of one kind, rows of NumPy arrays.

    Attributes:
        status: FREE, HIT or UNSURE, int8, shape [n].
        within_tolerance: Whether the distance is reached within the tolerance after ``toi``, bool, shape [n].
        toi: A time before which it is certainly not reached, 2 where it never is, float64, shape [n].
        coordinates: As of :func:`.closest_at`, float64, shape [n, 3].
        normal: As of :func:`.closest_at`, float64, shape [n, 3].
    """

    def __init__(
        self,
        kind: DistanceKind,
        points: np.ndarray,
        distance: np.ndarray,
        *,
        certified: bool,
        timed: bool,
        tolerance: float,
        device: wp.Device,
    ):
        """Answers queries in floating point.

        Args:
            kind: The kind of pair.
            points: Positions, finite, float32 or float64, shape [n, 2 kind.points, 3].
            distance: Minimum distances, shape [n].
            certified: Whether to account for rounding; otherwise the computed signs decide.
            timed: Whether to find the times at which the distance is reached, within the tolerance.
            tolerance: Of these times, as a share of the step.
            device: Device to compute on.
        """
        n, half = len(points), kind.points
        self._kind, self._points, self._distance = kind, points, distance
        order = kind.point_order
        dtype = wp.vec3 if points.dtype == np.float32 else wp.vec3d
        rows = np.ascontiguousarray(points[:, order + [half + i for i in order]])
        self._device_points = wp.array(rows, dtype=dtype, device=device)
        types = wp.int8, wp.bool, wp.float64, wp.vec3d, wp.vec3d
        outputs = [wp.empty(n, dtype=dtype, device=device) for dtype in types]
        roundoff = ROUNDOFF if certified else 0.0
        distances = wp.array(distance, dtype=wp.float64, device=device)
        inputs = [int(kind), self._device_points, distances, roundoff, timed, tolerance]
        wp.launch(_kernels(dtype)[0], n, inputs=inputs, outputs=outputs, device=device, record_tape=False)
        self.status, self.within_tolerance, self.toi, self.coordinates, self.normal = (
            output.numpy().copy() for output in outputs
        )

    def decide_on_host(self, which: np.ndarray, *, timed: bool) -> np.ndarray:
        """Decides some queries with the exact checker, and changes their rows other than ``status``.

        Args:
            which: The queries, bool, shape [n].
            timed: Whether to find times, coordinates and normals.

        Returns:
            Whether each query of ``which`` collides, in order, bool.
        """
        points, distance = self._points[which], self._distance[which]
        if not timed:
            return getattr(checker, self._kind.label)(points, distance)
        toi = getattr(checker, f"{self._kind.label}_toi")(points, distance)[:, 0]
        hit = ~np.isnan(toi)
        rows = np.flatnonzero(which)
        self.toi[rows] = np.where(hit, toi, 2.0)
        self.within_tolerance[rows] = hit
        rows = rows[hit]
        if len(rows):
            device, dtype = self._device_points.device, self._device_points.dtype
            on_device = wp.array(self._device_points.numpy()[rows], dtype=dtype, device=device)
            outputs = [wp.empty(len(rows), dtype=wp.vec3d, device=device) for _ in range(2)]
            inputs = [int(self._kind), on_device, wp.array(self.toi[rows], dtype=wp.float64, device=device)]
            wp.launch(_kernels(dtype)[1], len(rows), inputs=inputs, outputs=outputs, device=device, record_tape=False)
            self.coordinates[rows], self.normal[rows] = (output.numpy() for output in outputs)
        return hit


def answer_at_distance(
    kind: DistanceKind,
    points: np.ndarray,
    distance: np.ndarray,
    *,
    method: str,
    timed: bool,
    tolerance: float,
    device: wp.Device,
) -> tuple[np.ndarray, np.ndarray, DistanceAnswers]:
    """Answers queries of one kind by a method.

    Args:
        kind: The kind of pair.
        points: As of :class:`DistanceAnswers`.
        distance: Minimum distances, shape [n].
        method: One of :data:`.settings.METHODS`.
        timed: Whether to find times, coordinates and normals.
        tolerance: Of the times, as a share of the step.
        device: Device to compute on.

    Returns:
        Which queries collide, bool; what floating point certifies, int8; and the answers.
    """
    options = {"timed": timed, "tolerance": tolerance, "device": device}
    answers = DistanceAnswers(kind, points, distance, certified=True, **options)
    status = answers.status
    if method == "float":
        answers = DistanceAnswers(kind, points, distance, certified=False, **options)
    hit = answers.status != FREE
    if method != "float":
        left = (status == HIT) & ~answers.within_tolerance & timed
        if method == "exact":
            left |= status == UNSURE
        hit[left] = answers.decide_on_host(left, timed=timed)
    return hit, status, answers
