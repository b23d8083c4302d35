"""The motion of bodies that turn: vertices move along arcs, whose distance from their chords has a proven bound."""

import functools
import itertools

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..._arguments import as_numpy, check_finite, checked_coordinates, checked_distance, checked_number
from ...kernels.arcs import Arcs, arc_bounds, on_arc_of
from ...kernels.motion import double
from ..run.launch import launch, made_once
from ..run.settings import NO_FUSED_OPERATIONS, NO_GRADIENTS

_LARGEST_TURN = 4096.0
_SMALLEST_TURN = 2.0**-400
_LARGEST_COORDINATE = 2.0**500
_DEFAULT_TOLERANCE = 2.0**-12
"""Tolerance as a share of the largest distance of a vertex from its axis."""
_MISFIT = 2.0**-9
"""Largest distance of a vertex from where its body would put it at the end, if another vertex is in its place, as a
share of the distance from the centre; and, for positions that were rounded, this share of it of the coordinates."""
_ROUNDED_MISFIT = 2.0**-8
_ROUNDING = 2.0**-18
"""The same of a body that is rigid up to rounding, as a share of its coordinates, of the distance from the centre, and
of that distance for each radian. With u = 2^-24 and S the largest coordinate, a position that is rounded to single
precision is off by less than 2 u S, one that is also rotated in it by 12 u of the distance more. A quaternion that is
rounded turns by 2 u, a vector by u for each radian. Two vertices, which may be twice the distance apart, and two ends
make at most 8 u S, and 56 + 2 angle u of the distance; the constant is 64 u."""
NOT_RIGID = -2
"""In place of the body of a vertex: pairs within this body are looked at."""
_UP = 1.0 + 2.0**-40
"""Raises a few rounded operations above their exact result."""


@made_once
def _place_on_arcs(dtype: type) -> wp.Kernel:
    """Returns the kernel that computes positions at a time, for one type of position."""

    @wp.kernel(**NO_GRADIENTS)
    def place_on_arcs(x0: wp.array[dtype], x1: wp.array[dtype], arcs: Arcs, time: wp.float64, x: wp.array[wp.vec3d]):
        i = wp.tid()
        x[i] = on_arc_of(arcs, i, x0[i], x1[i], time)

    return place_on_arcs


class RigidMotion:
    """Bodies that turn at a constant rate about an axis of constant direction, while a point of each moves straight.

    A vertex of such a body begins at its position x0 at the start of the step and ends at x1 at the end. In between it
    is at x(t) = (1 - t) x0 + t x1 + (R(t) - t R(1) - (1 - t) I)(x0 - centre), where R(t) is the rotation by t times the
    turn: if x1 is where the turn and a translation put it, the centre moves straight and the body turns about it. A
    screw has its centre on its own axis. All other vertices move straight.

    A body is rigid if each of its vertices is there, up to one translation of the body and up to rounding: 2^-18 of the
    body's largest coordinate, of the largest distance of a vertex from the centre, and of that distance for each radian
    of the turn, together. Detections leave out pairs within a rigid body, as their distance does not change by more
    than twice that. A body may deform by up to 2^-9 of that distance; pairs within it are then looked at as others are.
    Arrays are read-only.

    Attributes:
        body: Body of each vertex, -1 for those that move straight, int32, shape [vertex_count].
        centre: A point of each body's axis at the start, float64, shape [body_count, 3].
        turn: Axis of each body times the angle of its turn [rad], float64, shape [body_count, 3].
        tolerance: Distance within which pairs may be reported that do not collide, in the unit of the positions, or
            None for 2^-12 of the largest distance of a vertex from its axis.
    """

    def __init__(
        self,
        body: ArrayLike | wp.array,
        centre: ArrayLike | wp.array,
        turn: ArrayLike | wp.array,
        *,
        tolerance: float | None = None,
    ):
        """Checks the motion.

        Args:
            body: Body of each vertex, -1 for those that move straight, integers, shape [vertex_count].
            centre: A point of each body's axis at the start, in the unit of the positions, float32 or float64, shape
                [body_count, 3].
            turn: Axis of each body times the angle of its turn over the step [rad], of the same shape. It may be any
                number of turns up to 4096 rad; an angle is 0 or at least 2^-400.
            tolerance: Distance within which pairs may be reported that do not collide, more than 0, in the unit of the
                positions; None for 2^-12 of the largest distance of a vertex from its axis.

        Raises:
            TypeError: If an argument has another type.
            ValueError: If it has another shape, is not finite or out of range, or a body has no centre.
        """
        self.centre = checked_coordinates(centre, (3,), "centre").astype(np.float64)
        self.turn = checked_coordinates(turn, (3,), "turn").astype(np.float64)
        if len(self.turn) != len(self.centre):
            raise ValueError(f"turn must have {len(self.centre)} rows, one a body, not {len(self.turn)}")
        largest = np.abs(self.centre).max(initial=0.0)
        if largest > _LARGEST_COORDINATE:
            raise ValueError(f"centre must have coordinates of at most 2^500, not {largest:g}")
        angle = np.linalg.norm(self.turn, axis=1)
        bad = ~((self.turn == 0.0).all(axis=1) | ((angle >= _SMALLEST_TURN) & (angle <= _LARGEST_TURN)))
        if bad.any():
            at = int(np.argmax(bad))
            raise ValueError(f"turn[{at}] must be 0, or from 2^-400 to {_LARGEST_TURN:g} rad, not {angle[at]:g}")
        bodies = as_numpy(body, "body", "an array of integers")
        if bodies.dtype.kind not in "iu":
            raise TypeError(f"body must be an array of integers, not of {bodies.dtype}")
        if bodies.ndim != 1:
            raise ValueError(f"body must have shape (vertex_count,), not {bodies.shape}")
        bad = (bodies < -1) | (bodies >= (count := len(self.centre)))
        if bad.any():
            at = int(np.argmax(bad))
            raise ValueError(f"body[{at}] must be -1 or one of {count} bodies from 0, not {bodies[at]}")
        self.body = bodies.astype(np.int32)
        for values in (self.body, self.centre, self.turn):  # copies, as detections keep them on the device
            values.flags.writeable = False
        self._copies: dict[str, Arcs] = {}
        self.tolerance = None if tolerance is None else checked_distance(tolerance, "tolerance", zero=False)

    @classmethod
    def between(
        cls,
        body: ArrayLike | wp.array,
        pose_0: ArrayLike | wp.array,
        pose_1: ArrayLike | wp.array,
        *,
        tolerance: float | None = None,
    ) -> "RigidMotion":
        """Returns the motion of bodies from one pose to another, the shorter way: their origins move straight.

        Half a turn has no shorter way: give the turn itself.

        Args:
            body: As of :class:`RigidMotion`.
            pose_0: Position of each body and the quaternion of its orientation at the start, x y z qx qy qz qw, as
                Warp's transforms, float32 or float64, shape [body_count, 7].
            pose_1: The same at the end.
            tolerance: As of :class:`RigidMotion`.

        Raises:
            TypeError: If an argument has another type.
            ValueError: As of :class:`RigidMotion`, or if a quaternion is not of length 1, to a thousandth, or the turn
                is half a turn, up to the rounding of the poses' type.
        """
        poses, rounding = [], 0.0
        for name, pose in (("pose_0", pose_0), ("pose_1", pose_1)):
            given = checked_coordinates(pose, (7,), name)
            values, rounding = given.astype(np.float64), max(rounding, float(np.finfo(given.dtype).eps))
            with np.errstate(over="ignore"):
                length = np.linalg.norm(values[:, 3:], axis=1)
            bad = ~(np.abs(length - 1.0) < 1e-3)
            if bad.any():
                which = int(np.argmax(bad))
                raise ValueError(f"{name}[{which}] must have a quaternion of length 1, not {length[which]:g}")
            poses.append(values)
        if len(poses[1]) != len(poses[0]):
            raise ValueError(f"pose_1 must have {len(poses[0])} rows, one a body, not {len(poses[1])}")
        v0, w0, v1, w1 = poses[0][:, 3:6], poses[0][:, 6:], poses[1][:, 3:6], poses[1][:, 6:]
        # q1 times the conjugate of q0, of the sign that turns the shorter way
        vector, scalar = w0 * v1 - w1 * v0 - np.cross(v1, v0), w1 * w0 + (v1 * v0).sum(axis=1, keepdims=True)
        if (half := np.abs(scalar[:, 0]) < 4.0 * rounding).any():
            which = int(np.argmax(half))
            raise ValueError(f"pose_1[{which}] is half a turn from pose_0[{which}], which tells no way: give the turn")
        vector = np.where(scalar < 0.0, -vector, vector)
        sine = np.linalg.norm(vector, axis=1, keepdims=True)
        still = sine < _SMALLEST_TURN
        angle = 2.0 * np.arctan2(sine, np.abs(scalar))
        turn = np.where(still, 0.0, vector / np.where(still, 1.0, sine) * angle)
        return cls(body, poses[0][:, :3], turn, tolerance=tolerance)

    def positions(self, x0: ArrayLike | wp.array, x1: ArrayLike | wp.array, time: float) -> np.ndarray:
        """Returns the positions of all vertices at a time, rounded, float64, shape [vertex_count, 3].

        Args:
            x0: Positions at the start, shape [vertex_count, 3], float32 or float64, NumPy or Warp array.
            x1: Positions at the end, of the same shape.
            time: Time in [0, 1].

        Raises:
            TypeError: If an argument has another type.
            ValueError: If the positions have another shape or are not finite, or the time is out of range.
        """
        start, end = checked_coordinates(x0, (3,), "x0"), checked_coordinates(x1, (3,), "x1")
        for name, x in (("x0", start), ("x1", end)):
            if len(x) != len(self.body):
                raise ValueError(f"{name} must have {len(self.body)} rows, one a vertex, not {len(x)}")
        return points_on_arcs(self, start, end, np.arange(len(self.body)), checked_number(time, "time", 0.0, 1.0))


def points_on_arcs(
    motion: RigidMotion, x0: np.ndarray, x1: np.ndarray, vertices: np.ndarray, time: float | np.ndarray
) -> np.ndarray:
    """Returns positions of vertices at times, rounded, float64, of the shape of the vertices and 3.

    Args:
        motion: The motion.
        x0: Positions at the start, shape [vertex_count, 3].
        x1: Positions at the end.
        vertices: Indices of vertices, of any shape.
        time: Time of each, 0 at the start and 1 at the end; a number, or of a shape that broadcasts to theirs.
    """
    start, end = x0[vertices].astype(np.float64), x1[vertices].astype(np.float64)
    time = np.asarray(time, dtype=np.float64)[..., None]
    straight = (1.0 - time) * start + time * end
    body = motion.body[vertices]
    if not (body >= 0).any():
        return straight
    turn = np.where(body[..., None] >= 0, motion.turn[body], 0.0)
    angle = np.linalg.norm(turn, axis=-1, keepdims=True)
    axis = turn / np.where(angle == 0.0, 1.0, angle)
    across = np.cross(axis, start - motion.centre[body])
    sine = np.sin(time * angle) - time * np.sin(angle)
    versine = 2.0 * (np.sin(0.5 * time * angle) ** 2 - time * np.sin(0.5 * angle) ** 2)
    return straight + sine * across + versine * np.cross(axis, across)


@wp.struct
class _Extent:
    """How far a motion reaches, and how far vertices are from where arcs take their bodies."""

    # as of kernels.arcs.arc_bounds for each vertex that has elements, 0 for others
    bounds: wp.array[wp.vec3d]
    # of all vertices: coordinate at the start, at the end, rounding, distance from the axis; and whether a position is
    # not finite, five numbers
    largest: wp.array[wp.float64]
    reference: wp.array[int]  # the first vertex of each body
    distance: wp.array[wp.float64]  # largest distance of a vertex of each body from its centre at the start
    size: wp.array[wp.float64]  # largest coordinate of each body
    misfit: wp.array[wp.float64]  # largest distance of a vertex of each body from where arcs take it with the reference


@wp.func
def _raise_to(values: wp.array[wp.float64], i: int, value: wp.float64):
    if value > values[i]:  # seldom, so that few threads wait for one another
        wp.atomic_max(values, i, value)


@made_once
def _measure_motion(dtype: type) -> tuple[wp.Kernel, wp.Kernel]:
    """Returns the kernels that measure a motion, and compare vertices with their bodies, for one type of position."""

    @wp.kernel(**NO_FUSED_OPERATIONS)
    def measure_motion(vertices: wp.array[int], x0: wp.array[dtype], x1: wp.array[dtype], arcs: Arcs, extent: _Extent):
        vertex = vertices[wp.tid()]
        start = double(x0[vertex])
        end = double(x1[vertex])
        if not (wp.isfinite(start) and wp.isfinite(end)):
            extent.largest[4] = wp.float64(1.0)
            return
        origin = wp.vec3d()
        axis = wp.vec3d()
        b = arcs.body[vertex]
        at_start = wp.max(wp.abs(start))
        at_end = wp.max(wp.abs(end))
        if b >= 0:
            origin = arcs.centre[b]
            axis = arcs.turn[b]
            if vertex < extent.reference[b]:
                wp.atomic_min(extent.reference, b, vertex)
            _raise_to(extent.distance, b, wp.length(start - origin))
            _raise_to(extent.size, b, wp.max(at_start, at_end))
        bounds = arc_bounds(start, end, origin, axis)
        extent.bounds[vertex] = bounds
        _raise_to(extent.largest, 0, at_start)
        _raise_to(extent.largest, 1, at_end)
        _raise_to(extent.largest, 2, bounds[2])
        _raise_to(extent.largest, 3, wp.float64(0.5) * bounds[1])

    @wp.func
    def moved(vertex: int, x0: wp.array[dtype], x1: wp.array[dtype], origin: wp.vec3d, axis: wp.vec3d) -> wp.vec3d:
        start = double(x0[vertex])
        r = start - origin
        turned = wp.quat_rotate(wp.quat_from_axis_angle(wp.normalize(axis), wp.length(axis)), r)
        return double(x1[vertex]) - start - (turned - r)

    @wp.kernel(**NO_FUSED_OPERATIONS)
    def compare_with_body(
        vertices: wp.array[int], x0: wp.array[dtype], x1: wp.array[dtype], arcs: Arcs, extent: _Extent
    ):
        vertex = vertices[wp.tid()]
        b = arcs.body[vertex]
        if b >= 0 and extent.largest[4] == wp.float64(0.0):
            of_reference = moved(extent.reference[b], x0, x1, arcs.centre[b], arcs.turn[b])
            misfit = wp.length(moved(vertex, x0, x1, arcs.centre[b], arcs.turn[b]) - of_reference)
            _raise_to(extent.misfit, b, misfit)

    return measure_motion, compare_with_body


def _copy_of(motion: RigidMotion, device: wp.Device) -> Arcs:
    """Returns arcs with body, centre and turn alone, copied to a device once."""
    if device.alias not in motion._copies:
        motion._copies[device.alias] = arcs = Arcs()
        arcs.centre, arcs.turn = (wp.array(v, dtype=wp.vec3d, device=device) for v in (motion.centre, motion.turn))
        arcs.body = wp.array(motion.body, dtype=int, device=device)
    return motion._copies[device.alias]


class ArcBounds:
    """The motion of a mesh's vertices by a :class:`RigidMotion` in parts of the step, with bounds of their deviation.

    Attributes:
        motion: The motion.
        tolerance: Distance within which pairs may be reported that do not collide.
        body: Body of each vertex, within which pairs are left out: -1 for vertices that move straight, and
            :data:`NOT_RIGID` for those of a body that deforms, int32, shape [vertex_count].
    """

    def __init__(self, motion: RigidMotion, vertices: wp.array, x0: wp.array, x1: wp.array):
        """Bounds the motion from one configuration to another.

        Args:
            motion: The motion.
            vertices: The vertices that have elements, Warp array of int; positions of others may be anything.
            x0: Positions at the start, Warp array of vec3 or vec3d on the same device.
            x1: Positions at the end, of the same type.

        Raises:
            ValueError: If a position is not finite, a coordinate is more than 2^500, the positions at the end are not
                those of the motion, or the tolerance is too small for their rounding.
        """
        self.motion = motion
        self._vertices, self._arcs = vertices, _copy_of(motion, x0.device)
        bodies, count = len(motion.centre), len(motion.body)
        self._extent = extent = _Extent()
        extent.bounds = wp.zeros(count, dtype=wp.vec3d, device=x0.device)
        extent.reference = wp.empty(bodies, dtype=int, device=x0.device)
        self._measured = wp.empty(5 + 3 * bodies, dtype=wp.float64, device=x0.device)
        ends = [5 + i * bodies for i in range(4)]
        extent.largest = self._measured[:5]
        extent.distance, extent.size, extent.misfit = (self._measured[a:b] for a, b in itertools.pairwise(ends))
        self.measure(x0, x1)
        values = self._measured.numpy()
        if values[4]:
            for name, x in (("x0", x0), ("x1", x1)):
                check_finite(x.numpy(), name, vertices.numpy())
        for name, size in zip(("x0", "x1"), values[:2], strict=True):
            if size > _LARGEST_COORDINATE:
                raise ValueError(f"{name} must have coordinates of at most 2^500 with arcs, not {size:g}")
        distance, size, misfit = values[5:].reshape(3, bodies)
        excess = misfit - (_MISFIT * distance + _MISFIT * _ROUNDED_MISFIT * size)
        if (excess > 0.0).any():
            worst = int(np.argmax(excess))
            where = f"x1 must be where arcs take body {worst}, up to a translation"
            raise ValueError(f"{where}: a vertex is {misfit[worst]:g} away from there")
        self.body = np.where(np.append(self.are_rigid(), True)[motion.body], motion.body, NOT_RIGID).astype(np.int32)
        least = 16.0 * float(values[2])  # that parts of the step can reach
        if motion.tolerance is not None and motion.tolerance < least:
            why = "as positions between the ends are rounded"
            raise ValueError(f"arcs.tolerance must be at least {least:g}, {why}, not {motion.tolerance:g}")
        self.tolerance: float = motion.tolerance or max(_DEFAULT_TOLERANCE * float(values[3]), least)

    def measure(self, x0: wp.array, x1: wp.array) -> None:
        """Measures the motion from one configuration to another, without synchronizing; also in a CUDA graph."""
        self._ends, extent = (x0, x1), self._extent
        extent.reference.fill_(len(self.motion.body))
        self._measured.zero_()
        inputs = [self._vertices, x0, x1, self._arcs]
        for kernel in _measure_motion(x0.dtype):
            launch(kernel, len(self._vertices), inputs=inputs, outputs=[extent], device=x0.device, record_tape=False)

    def are_rigid(self) -> np.ndarray:
        """Returns which bodies were rigid up to rounding when they were measured last, bool, shape [body_count]."""
        measured = self._measured.numpy()
        distance, size, misfit = measured[5:].reshape(3, -1)
        angle = np.linalg.norm(self.motion.turn, axis=1)
        return (measured[4] == 0.0) & (misfit <= _ROUNDING * (size + (1.0 + angle) * distance))

    @functools.cached_property
    def lever(self) -> np.ndarray:
        """Bound of the distance of each vertex from its axis, 0 for those that move straight, shape [vertex_count]."""
        return 0.5 * self._extent.bounds.numpy()[:, 1]

    def deviation(self, level: int) -> np.ndarray:
        """Returns how far each vertex is from its chord at most, in parts of the step that last 2^-level.

        The chord is between positions as of :meth:`place`, whose rounding is included. Float64, shape [vertex_count].
        """
        whole, most, rounding = self._extent.bounds.numpy().T
        return _UP * (np.minimum(whole * 4.0**-level, most) + rounding)

    def place(self, time: float) -> wp.array:
        """Returns the positions at a time, Warp array of vec3d on the device of the positions.

        Args:
            time: A multiple of 2^-52 in [0, 1].
        """
        x0, x1 = self._ends
        x = wp.empty(len(x0), dtype=wp.vec3d, device=x0.device)
        inputs = [x0, x1, self._arcs, wp.float64(time)]
        launch(_place_on_arcs(x0.dtype), len(x), inputs=inputs, outputs=[x], device=x0.device, record_tape=False)
        return x
