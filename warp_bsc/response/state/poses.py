"""Kinematics of rigid bodies: poses, turns and velocities in double precision."""

import warp as wp

from .structs import Bodies
from .vectors import HALF, ONE, ZERO, to_double, to_single

_SMALL = wp.constant(wp.float64(1e-12))
"""Squared angle [rad^2] up to which turns are by series, which have derivatives at 0 as well."""


@wp.func
def rotation_of(pose: wp.transform) -> wp.quatd:
    """Returns the rotation of a pose."""
    q = wp.transform_get_rotation(pose)
    return wp.normalize(wp.quatd(wp.float64(q[0]), wp.float64(q[1]), wp.float64(q[2]), wp.float64(q[3])))


@wp.func
def turned_by(rotation: wp.quatd, turn: wp.vec3d) -> wp.quatd:
    """Returns a rotation followed by a turn about a fixed axis, given as axis times angle [rad]."""
    square = wp.length_sq(turn)
    half = HALF - square / wp.float64(48.0)  # sine of half the angle by the angle
    cosine = ONE - square / wp.float64(8.0)
    if square > _SMALL:
        angle = wp.sqrt(square)
        half = wp.sin(HALF * angle) / angle
        cosine = wp.cos(HALF * angle)
    return wp.quatd(half * turn[0], half * turn[1], half * turn[2], cosine) * rotation


@wp.func
def turn_of(q: wp.quatd) -> wp.vec3d:
    """Returns the shortest turn that is a rotation, as axis times angle [rad]."""
    axis = wp.vec3d(q[0], q[1], q[2])
    square = wp.length_sq(axis)
    cosine = wp.abs(q[3])
    scale = wp.float64(2.0) / cosine  # the angle by the sine of its half
    if square > _SMALL:
        sine = wp.sqrt(square)
        scale = wp.float64(2.0) * wp.atan2(sine, cosine) / sine
    return wp.where(q[3] < ZERO, -scale, scale) * axis


@wp.func
def turn_between(start: wp.transform, end: wp.transform) -> wp.vec3d:
    """Returns the shortest turn from one pose to another, as axis times angle [rad]."""
    return turn_of(rotation_of(end) * wp.quat_inverse(rotation_of(start)))


@wp.func
def point_of(pose: wp.transform, point: wp.vec3) -> wp.vec3d:
    """Returns a point of a body in the frame of the world [m]."""
    return to_double(wp.transform_get_translation(pose)) + wp.quat_rotate(rotation_of(pose), to_double(point))


@wp.func
def centre_of(bodies: Bodies, body: int, pose: wp.transform) -> wp.vec3d:
    """Returns the centre of mass of a body in a pose [m]."""
    return point_of(pose, bodies.com[body])


@wp.func
def _pose(bodies: Bodies, body: int, centre: wp.vec3d, rotation: wp.quatd) -> wp.transform:
    """Returns the pose of a body from its centre of mass and rotation, as nearly as it is stored."""
    q = wp.normalize(rotation)
    stored = wp.quat(float(q[0]), float(q[1]), float(q[2]), float(q[3]))
    origin = wp.transform(wp.vec3(), stored)
    return wp.transform(to_single(centre - wp.quat_rotate(rotation_of(origin), to_double(bodies.com[body]))), stored)


@wp.func
def turned_pose(bodies: Bodies, body: int, pose: wp.transform, shift: wp.vec3d, turn: wp.vec3d) -> wp.transform:
    """Returns a pose whose centre is shifted, and which is turned about it."""
    return _pose(bodies, body, centre_of(bodies, body, pose) + shift, turned_by(rotation_of(pose), turn))


@wp.func
def pose_between(bodies: Bodies, body: int, start: wp.transform, end: wp.transform, share: wp.float64) -> wp.transform:
    """Returns the pose of a body after a share of its path: its centre moves straight, and it turns evenly."""
    before = centre_of(bodies, body, start)
    path = centre_of(bodies, body, end) - before
    return _pose(bodies, body, before + share * path, turned_by(rotation_of(start), share * turn_between(start, end)))


@wp.func
def velocity_between(
    bodies: Bodies, body: int, start: wp.transform, end: wp.transform, dt: wp.float64
) -> wp.spatial_vector:
    """Returns the velocity of a body that goes from one pose to another in a time ``dt``."""
    path = centre_of(bodies, body, end) - centre_of(bodies, body, start)
    return wp.spatial_vector(to_single(path / dt), to_single(turn_between(start, end) / dt))


@wp.func
def in_world(matrix: wp.mat33, pose: wp.transform) -> wp.mat33d:
    """Returns an inertia, or its inverse, of a body in the frame of the world, given that in the frame of the body."""
    rotation = wp.quat_to_matrix(rotation_of(pose))
    return rotation * wp.mat33d(matrix) * wp.transpose(rotation)


@wp.func
def velocity_on_body(velocity: wp.spatial_vector, arm: wp.vec3d) -> wp.vec3:
    """Returns the velocity of a point of a body [m/s], from that of the body and the arm from its centre [m]."""
    turning = wp.cross(to_double(wp.spatial_bottom(velocity)), arm)
    return to_single(to_double(wp.spatial_top(velocity)) + turning)
