"""The dancer of the scenes Dancer and Flamenco: a mannequin that turns and sways, on legs or in a petticoat."""

import numpy as np
import warp as wp
from paper_scene import add_collider, grid_faces, lathe

WAIST_HEIGHT, WAIST_RADIUS = 1.06, 0.135  # m, where skirts are fastened, just off the body
FLATNESS = 0.8  # depth of the trunk and of waists, as a share of their width
TRUNK = [  # radius and height [m], from below the hips to the top of the head
    *[(0.0, 0.86), (0.09, 0.868), (0.14, 0.895), (0.162, 0.94), (0.155, 0.99), (0.13, 1.04), (0.122, 1.09)],
    *[(0.132, 1.17), (0.15, 1.26), (0.152, 1.32), (0.14, 1.38), (0.1, 1.425), (0.052, 1.45), (0.046, 1.5)],
    *[(0.06, 1.525), (0.082, 1.57), (0.09, 1.62), (0.084, 1.68), (0.06, 1.725), (0.0, 1.74)],
]
HIP = wp.constant(wp.vec3(0.095, 0.0, 0.765))  # joint of the left leg [m]; parts have gaps between, and never touch
LEG = [  # radius and height over the joint [m]
    *[(0.0, -0.74), (0.04, -0.73), (0.042, -0.7), (0.034, -0.62), (0.05, -0.45), (0.046, -0.38)],
    *[(0.066, -0.15), (0.073, 0.0), (0.062, 0.045), (0.036, 0.068), (0.0, 0.075)],
]
PETTICOAT = [(0.0, 0.2), (0.26, 0.21), (0.22, 0.45), (0.17, 0.7), (0.14, 0.82), (0.0, 0.835)]
ARM = [  # path [m] and radius of the left one, over the head
    *[((0.19, 0.0, 1.385), 0.03), ((0.2, 0.0, 1.4), 0.042), ((0.26, 0.0, 1.44), 0.042), ((0.34, 0.0, 1.5), 0.038)],
    *[((0.39, 0.0, 1.56), 0.036), ((0.39, 0.0, 1.64), 0.034), ((0.34, 0.0, 1.74), 0.03), ((0.27, 0.0, 1.83), 0.024)],
    *[((0.2, 0.0, 1.89), 0.03), ((0.15, 0.0, 1.92), 0.014)],
]
SETTLING, RAMP = wp.constant(0.3), wp.constant(0.5)  # s, rest before the dance, and time until it is in full swing


@wp.kernel(enable_backward=False)
def dance(
    # in
    time: wp.array[float],
    rate: float,
    turn: float,
    sway: float,
    stride: float,
    # out
    body_q: wp.array[wp.transform],
):
    """Writes the poses of trunk and legs.

    Args:
        time: One clock [s].
        rate: Turns to and fro per second [Hz].
        turn: Angle that the trunk turns to each side [rad].
        sway: Distance that it moves to each side [m].
        stride: Angle that each leg swings to the front and to the back [rad].
        body_q: Poses of the trunk and, if there are any, of the left and right leg.
    """
    t = wp.max(time[0] - SETTLING, 0.0)
    ease = wp.clamp(t / RAMP, 0.0, 1.0)
    ease = ease * ease * (3.0 - 2.0 * ease)
    phase = 2.0 * wp.pi * rate * t
    yaw = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), ease * turn * wp.sin(phase))
    trunk = wp.transform(wp.vec3(ease * sway * wp.sin(0.5 * phase), 0.0, 0.0), yaw)
    swing = ease * stride * wp.sin(phase)
    body_q[0] = trunk
    for leg in range(body_q.shape[0] - 1):
        side = 1.0 - 2.0 * float(leg)
        joint = wp.vec3(side * HIP[0], HIP[1], HIP[2])
        body_q[1 + leg] = trunk * wp.transform(joint, wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), side * swing))


def tube(path, segments=16):
    """Returns positions and faces of a closed tube along points (position, radius) in the plane of x and z."""
    centre = np.array([point for point, _ in path])
    radius = np.array([radius for _, radius in path])
    along = np.gradient(centre, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    forward = np.array([0.0, 1.0, 0.0])
    angle = 2.0 * np.pi / segments * np.arange(segments)
    across = np.cos(angle)[:, None] * np.cross(forward, along)[:, None] + np.sin(angle)[:, None] * forward
    rings = (centre[:, None] + radius[:, None, None] * across).reshape(-1, 3)
    first, last = len(rings), len(rings) + 1
    ring = np.arange(segments)
    start = np.stack([np.full(segments, first), ring, np.roll(ring, -1)], axis=1)
    end = np.stack([np.full(segments, last), np.roll(ring, -1), ring], axis=1)
    end[:, 1:] += segments * (len(path) - 1)
    positions = np.concatenate([rings, [centre[0] - 0.5 * radius[0] * along[0]], [centre[-1] + radius[-1] * along[-1]]])
    return positions, np.concatenate([grid_faces(len(path), segments, around=True), start, end])


def add_mannequin(builder, friction, below):
    """Adds the trunk with head and arms, and legs or a petticoat, as the first bodies of the model, for :func:`dance`.

    Args:
        builder: The builder.
        friction: Coefficient of all parts.
        below: "legs", each a body, or "petticoat", which hides them and moves with the trunk.
    """
    trunk = builder.add_body(is_kinematic=True)
    arm, faces = tube(ARM)
    add_collider(builder, trunk, arm, faces, friction)
    add_collider(builder, trunk, arm * (-1.0, 1.0, 1.0), faces[:, ::-1], friction)
    for profile in [TRUNK, PETTICOAT] if below == "petticoat" else [TRUNK]:
        positions, faces = lathe(profile, 32)
        add_collider(builder, trunk, positions * (1.0, FLATNESS, 1.0), faces, friction)
    for side in (1.0, -1.0) if below == "legs" else ():
        joint = wp.vec3(side * HIP[0], HIP[1], HIP[2])
        leg = builder.add_body(xform=wp.transform(joint, wp.quat_identity()), is_kinematic=True)
        add_collider(builder, leg, *lathe(LEG, 20), friction)
