"""Rigid bodies: what constraints do to the pose and velocity of a body, whose vertices follow as one.

A constraint acts on a body at the contact point: the inverse mass along a normal n is 1/m + (r x n) I^-1 (r x n), with
the arm r from the centre of mass. Each constraint adds a change of the centre and a turn to the sums of its bodies, as
it adds changes of positions to those of particles; a body then moves by its sums, and its vertices follow from the
pose, rounded as ``newton.State.body_q`` stores it. Where paths are cut, that of a body is cut as one.
"""

import warp as wp

from .buffers import (
    DIVIDED,
    FROZEN,
    NEVER,
    PROJECTED,
    TRUNCATED,
    Bodies,
    Constraints,
    Motion,
    MovedBodies,
    Progress,
    Vertices,
    has_final_velocity,
)
from .constraints import NO_CONSTRAINT, TIME_UNITS, to_double, to_single
from .dividing_planes import DividingPlanes, has_all_planes, share_of_path
from .step_record import StepRecord, is_recording

__all__ = [
    "activate_bodies",
    "add_body_delta",
    "begin_bodies",
    "body_change",
    "body_inverse_masses",
    "centre_of",
    "change_body_velocities",
    "changed_velocity",
    "cut_bodies",
    "find_body_shares",
    "first_contact_of_body",
    "freeze_undetected_bodies",
    "inertia_at",
    "inverse_inertia_at",
    "move_bodies",
    "move_to_end",
    "place_vertices",
    "pose_between",
    "sagitta",
    "set_vertex_velocities",
    "share_before",
    "sums_of",
    "turn_between",
    "turned_pose",
    "velocity_between",
    "velocity_on_body",
]

_UNITS = wp.constant(wp.float64(2.0**40))
"""Units in a metre and in a radian, and in those per second; sums are of integers in these units."""
_SHARE = wp.constant(wp.float64(0.9))
"""Share of the way to its first contact that a body goes whose vertices have no dividing planes."""
_WHOLE = wp.constant(wp.int64(2**30))
"""The share of a path that is not cut, in units of TIME_UNITS."""
_FREEZES = wp.constant(wp.int64(-1))
"""In place of a share: the body is frozen."""
_SMALL = wp.constant(wp.float64(1e-12))
"""Squared angle [rad^2] up to which turns are by series, which have derivatives at 0 as well."""
_ZERO = wp.constant(wp.float64(0.0))
_ONE = wp.constant(wp.float64(1.0))

_KERNEL = {"enable_backward": False}


@wp.func
def _body_of_side(motion: Motion, corners: wp.vec4i, side: int) -> int:
    """Returns the body of the first or second element of a constraint, -1 if there is none; a plane is none."""
    if side == 1 and corners[0] == corners[3]:
        return -1
    return motion.bodies.of_vertex[corners[3 * side]]


@wp.func
def _lever(motion: Motion, vertices: Vertices, constraints: Constraints, i: int, side: int, x: wp.array[wp.vec3]):
    """Returns the lever of the first or second element of a constraint, at positions ``x`` of the vertices.

    Returns:
        The body, -1 if the side is no body that can be moved; the sum of the weights of its vertices, and the sum of
        their arms by weight [m].
    """
    corners = constraints.vertices[i]
    weights = constraints.weights[i]
    body = _body_of_side(motion, corners, side)
    if body >= 0 and motion.bodies.inverse_mass[body] == 0.0:
        body = -1
    weight = _ZERO
    arm = wp.vec3d()
    if body >= 0:
        for j in range(4):
            if motion.bodies.of_vertex[corners[j]] == body:  # the other element is of another body
                weight += weights[j]
                arm += weights[j] * (to_double(x[corners[j]]) - vertices.bodies.centre[body])
    return body, weight, arm


@wp.func
def activate_bodies(motion: Motion, vertices: Vertices, constraints: Constraints, i: int):
    """Counts an active constraint for its bodies."""
    for side in range(2):
        body = _body_of_side(motion, constraints.vertices[i], side)
        if body >= 0:
            wp.atomic_add(vertices.bodies.active, body, 1)


@wp.func
def body_inverse_masses(
    motion: Motion,
    vertices: Vertices,
    constraints: Constraints,
    i: int,
    x: wp.array[wp.vec3],
    relaxation: wp.float64,
):
    """Returns what the bodies of a constraint add to its inverse mass [1/kg], along the normal and across it.

    The inverse mass of a body is a matrix. The two numbers are those of a matrix without products of the normal with
    other directions that exceeds it, so that sweeps converge.
    """
    normal = constraints.normal[i]
    along = _ZERO
    across = _ZERO
    for side in range(2):
        body, weight, arm = _lever(motion, vertices, constraints, i, side, x)
        if body >= 0:
            parts = wp.max(wp.float64(vertices.bodies.active[body]) / relaxation, _ONE)
            inverse_inertia = vertices.bodies.inverse_inertia[body]
            linear = weight * weight * wp.float64(motion.bodies.inverse_mass[body])
            turned = wp.cross(inverse_inertia * wp.cross(arm, normal), arm)
            turned_along = wp.dot(turned, normal)
            product = _ZERO
            if constraints.friction[i] > 0.0:
                product = wp.length(turned - turned_along * normal)
            trace = wp.trace(inverse_inertia) * wp.length_sq(arm)
            trace -= wp.dot(arm, inverse_inertia * arm)
            along += parts * (linear + turned_along + product)
            across += parts * (linear + trace - turned_along + product)
    return along, across


@wp.func
def body_change(
    motion: Motion,
    vertices: Vertices,
    constraints: Constraints,
    i: int,
    side: int,
    change: wp.vec3d,
    x: wp.array[wp.vec3],
):
    """Returns what the change of a multiplier does to the body on one side of its constraint.

    Returns:
        The body, -1 if there is none that can be moved; the change of its centre of mass and its turn, or of the
        velocities of both.
    """
    body, weight, arm = _lever(motion, vertices, constraints, i, side, x)
    shift = wp.vec3d()
    turn = wp.vec3d()
    if body >= 0:
        shift = weight * wp.float64(motion.bodies.inverse_mass[body]) * change
        turn = vertices.bodies.inverse_inertia[body] * wp.cross(arm, change)
    return body, shift, turn


@wp.func
def add_body_delta(
    motion: Motion,
    vertices: Vertices,
    constraints: Constraints,
    i: int,
    change: wp.vec3d,
    x: wp.array[wp.vec3],
    sums: wp.array2d[wp.int64],
):
    """Adds what the change of a multiplier does to the bodies of its constraint, at positions ``x`` of vertices."""
    for side in range(2):
        body, shift, turn = body_change(motion, vertices, constraints, i, side, change, x)
        if body >= 0:
            for axis in range(3):
                wp.atomic_add(sums, body, axis, wp.int64(wp.rint(_UNITS * shift[axis])))
                wp.atomic_add(sums, body, 3 + axis, wp.int64(wp.rint(_UNITS * turn[axis])))


@wp.func
def sums_of(sums: wp.array2d[wp.int64], body: int):
    """Returns the linear and the angular part of the sums of a body."""
    linear = wp.vec3d()
    angular = wp.vec3d()
    for axis in range(3):
        linear[axis] = wp.float64(sums[body, axis]) / _UNITS
        angular[axis] = wp.float64(sums[body, 3 + axis]) / _UNITS
    return linear, angular


@wp.func
def _rotation(pose: wp.transform) -> wp.quatd:
    q = wp.transform_get_rotation(pose)
    return wp.normalize(wp.quatd(wp.float64(q[0]), wp.float64(q[1]), wp.float64(q[2]), wp.float64(q[3])))


@wp.func
def _turned(rotation: wp.quatd, turn: wp.vec3d) -> wp.quatd:
    """Returns a rotation followed by a turn about a fixed axis, given as axis times angle [rad]."""
    square = wp.length_sq(turn)
    half = wp.float64(0.5) - square / wp.float64(48.0)  # sine of half the angle by the angle
    cosine = _ONE - square / wp.float64(8.0)
    if square > _SMALL:
        angle = wp.sqrt(square)
        half = wp.sin(wp.float64(0.5) * angle) / angle
        cosine = wp.cos(wp.float64(0.5) * angle)
    return wp.quatd(half * turn[0], half * turn[1], half * turn[2], cosine) * rotation


@wp.func
def turn_between(start: wp.transform, end: wp.transform) -> wp.vec3d:
    """Returns the shortest turn from one pose to another, as axis times angle [rad]."""
    q = _rotation(end) * wp.quat_inverse(_rotation(start))
    axis = wp.vec3d(q[0], q[1], q[2])
    square = wp.length_sq(axis)
    cosine = wp.abs(q[3])
    scale = wp.float64(2.0) / cosine  # the angle by the sine of its half
    if square > _SMALL:
        sine = wp.sqrt(square)
        scale = wp.float64(2.0) * wp.atan2(sine, cosine) / sine
    return wp.where(q[3] < _ZERO, -scale, scale) * axis


@wp.func
def centre_of(bodies: Bodies, body: int, pose: wp.transform) -> wp.vec3d:
    """Returns the centre of mass of a body in a pose [m]."""
    return to_double(wp.transform_get_translation(pose)) + wp.quat_rotate(_rotation(pose), to_double(bodies.com[body]))


@wp.func
def _pose(bodies: Bodies, body: int, centre: wp.vec3d, rotation: wp.quatd) -> wp.transform:
    """Returns the pose of a body from its centre of mass and rotation, as nearly as it is stored."""
    q = wp.normalize(rotation)
    stored = wp.quat(float(q[0]), float(q[1]), float(q[2]), float(q[3]))
    origin = wp.transform(wp.vec3(), stored)
    return wp.transform(to_single(centre - wp.quat_rotate(_rotation(origin), to_double(bodies.com[body]))), stored)


@wp.func
def turned_pose(bodies: Bodies, body: int, pose: wp.transform, shift: wp.vec3d, turn: wp.vec3d) -> wp.transform:
    """Returns a pose whose centre is shifted, and which is turned about it."""
    return _pose(bodies, body, centre_of(bodies, body, pose) + shift, _turned(_rotation(pose), turn))


@wp.func
def pose_between(bodies: Bodies, body: int, start: wp.transform, end: wp.transform, share: wp.float64) -> wp.transform:
    """Returns the pose of a body after a share of its path: its centre moves straight, and it turns evenly."""
    before = centre_of(bodies, body, start)
    path = centre_of(bodies, body, end) - before
    return _pose(bodies, body, before + share * path, _turned(_rotation(start), share * turn_between(start, end)))


@wp.func
def velocity_between(
    bodies: Bodies, body: int, start: wp.transform, end: wp.transform, dt: wp.float64
) -> wp.spatial_vector:
    """Returns the velocity of a body that goes from one pose to another in a time ``dt``."""
    path = centre_of(bodies, body, end) - centre_of(bodies, body, start)
    return wp.spatial_vector(to_single(path / dt), to_single(turn_between(start, end) / dt))


@wp.func
def _in_world(matrix: wp.mat33, pose: wp.transform) -> wp.mat33d:
    """Returns a matrix in the frame of a body in the frame of the world."""
    rotation = wp.quat_to_matrix(_rotation(pose))
    return rotation * wp.mat33d(matrix) * wp.transpose(rotation)


@wp.func
def inertia_at(bodies: Bodies, body: int, pose: wp.transform) -> wp.mat33d:
    """Returns the inertia of a body in a pose about its centre of mass, in the frame of the world [kg m^2]."""
    return _in_world(bodies.inertia[body], pose)


@wp.func
def inverse_inertia_at(bodies: Bodies, body: int, pose: wp.transform) -> wp.mat33d:
    """Returns the inverse inertia of a body in a pose about its centre of mass, in the frame of the world."""
    return _in_world(bodies.inverse_inertia[body], pose)


@wp.func
def _set_centre(bodies: Bodies, moved: MovedBodies, body: int):
    """Makes the pose of a body that where impulses act."""
    pose = moved.pose[body]
    moved.centre[body] = centre_of(bodies, body, pose)
    moved.inverse_inertia[body] = inverse_inertia_at(bodies, body, pose)


@wp.func
def sagitta(motion: Motion, vertices: Vertices, corners: wp.vec4i, most: wp.float64) -> wp.float64:
    """Returns how far the arcs of vertices on turning bodies are from their chords at most [m], up to ``most``.

    The centre of mass moves straight, so that an arm r that turns by an angle a is off by r (1 - cos(a / 2)).
    """
    off = _ZERO
    if motion.bodies.of_vertex:
        for j in range(4):
            body = motion.bodies.of_vertex[corners[j]]
            if body >= 0 and motion.bodies.inverse_mass[body] > 0.0:
                turn = turn_between(motion.bodies.start[body], motion.bodies.end[body])
                half = wp.sin(wp.float64(0.25) * wp.length(turn))
                arm = to_double(motion.x1[corners[j]]) - vertices.bodies.centre[body]
                off = wp.max(off, wp.float64(2.0) * half * half * wp.length(arm))
    return wp.min(off, most)


@wp.kernel(**_KERNEL)
def begin_bodies(motion: Motion, vertices: Vertices):
    """Initializes the bodies by what is wanted of them, and clears everything else."""
    body = wp.tid()
    moved = vertices.bodies
    moved.pose[body] = motion.bodies.end[body]
    moved.velocity[body] = motion.bodies.velocity[body]
    _set_centre(motion.bodies, moved, body)
    for axis in range(6):
        moved.delta_x[body, axis] = wp.int64(0)
        moved.delta_v[body, axis] = wp.int64(0)
    moved.active[body] = 0
    moved.moved[body] = 0
    moved.share[body] = _WHOLE
    moved.first_contact[body] = NEVER
    moved.loose[body] = 0
    moved.outcome[body] = 0


@wp.kernel(**_KERNEL)
def move_bodies(motion: Motion, vertices: Vertices, last: bool):
    """Moves each body by the sum of what its constraints did to it in a sweep; ``last`` empties its active set."""
    body = wp.tid()
    moved = vertices.bodies
    active = moved.active[body] != 0 and motion.bodies.inverse_mass[body] > 0.0
    moved.moved[body] = wp.where(active, 1, 0)
    if last:
        moved.active[body] = 0
    if active:
        shift, turn = sums_of(moved.delta_x, body)
        moved.pose[body] = turned_pose(motion.bodies, body, motion.bodies.end[body], shift, turn)
        moved.outcome[body] = moved.outcome[body] | PROJECTED


@wp.kernel(**_KERNEL)
def place_vertices(motion: Motion, vertices: Vertices):
    """Moves the vertices of bodies that moved."""
    vertex = motion.bodies.particle_count + wp.tid()
    body = motion.bodies.of_vertex[vertex]
    if body >= 0 and vertices.bodies.moved[body] != 0:
        vertices.x1[vertex] = wp.transform_point(vertices.bodies.pose[body], motion.bodies.position[wp.tid()])
        vertices.changed[vertex] = 1


@wp.kernel(**_KERNEL)
def move_to_end(motion: Motion, vertices: Vertices):
    """Makes the poses at the end of the step those where impulses act."""
    body = wp.tid()
    if motion.bodies.inverse_mass[body] > 0.0:
        _set_centre(motion.bodies, vertices.bodies, body)


@wp.func
def changed_velocity(wanted: wp.spatial_vector, sums: wp.array2d[wp.int64], body: int) -> wp.spatial_vector:
    """Returns the velocity of a body by the one that was wanted, and the sum of what constraints did to it."""
    linear, angular = sums_of(sums, body)
    linear += to_double(wp.spatial_top(wanted))
    angular += to_double(wp.spatial_bottom(wanted))
    return wp.spatial_vector(to_single(linear), to_single(angular))


@wp.kernel(**_KERNEL)
def change_body_velocities(motion: Motion, vertices: Vertices, last: bool):
    """Changes the velocity of each body that was not truncated; ``last`` empties its active set."""
    body = wp.tid()
    moved = vertices.bodies
    active = moved.active[body] != 0 and motion.bodies.inverse_mass[body] > 0.0
    if last:
        moved.active[body] = 0
    if active and not has_final_velocity(moved.outcome[body]):
        moved.velocity[body] = changed_velocity(motion.bodies.velocity[body], moved.delta_v, body)


@wp.func
def velocity_on_body(velocity: wp.spatial_vector, arm: wp.vec3d) -> wp.vec3:
    """Returns the velocity of a point of a body [m/s], from that of the body and the arm from its centre [m]."""
    turning = wp.cross(to_double(wp.spatial_bottom(velocity)), arm)
    return to_single(to_double(wp.spatial_top(velocity)) + turning)


@wp.kernel(**_KERNEL)
def set_vertex_velocities(motion: Motion, vertices: Vertices):
    """Makes the velocities of vertices those of their bodies."""
    vertex = motion.bodies.particle_count + wp.tid()
    body = motion.bodies.of_vertex[vertex]
    if body >= 0 and motion.bodies.inverse_mass[body] > 0.0:
        arm = to_double(vertices.x1[vertex]) - vertices.bodies.centre[body]
        vertices.velocity[vertex] = velocity_on_body(vertices.bodies.velocity[body], arm)


@wp.func
def share_before(time: wp.float64) -> wp.float64:
    """Returns the share of the path of a body that is left before a contact, at ``time`` in [0, 1]."""
    return _SHARE * time


@wp.func
def first_contact_of_body(key: wp.int64, vertex: int) -> wp.int64:
    """Returns a key that orders the first contacts of the vertices of a body by time, then by vertex."""
    return ((key >> wp.int64(32)) << wp.int64(32)) | wp.int64(vertex)


@wp.kernel(**_KERNEL)
def find_body_shares(
    motion: Motion, vertices: Vertices, progress: Progress, dividing: DividingPlanes, record: StepRecord
):
    """Finds the share of the path of each body up to which its vertices are above their dividing planes.

    The vertices go straight here, but in an arc where the body turns: if one ends below its plane for that and
    collides, the next iteration cuts the path again. Where a contact has no plane, the path ends before that contact.
    After ``max_truncations`` iterations, a body that still collides is frozen. If the step is recorded, first contacts
    are left for :func:`.kernels.record_body_truncations`.
    """
    vertex = motion.bodies.particle_count + wp.tid()
    key = vertices.first_contact[vertex]
    body = motion.bodies.of_vertex[vertex]
    if key == NEVER or body < 0:
        return
    if is_recording(record):
        wp.atomic_min(vertices.bodies.first_contact, body, first_contact_of_body(key, vertex))
    else:
        vertices.first_contact[vertex] = NEVER
    if motion.bodies.inverse_mass[body] == 0.0:
        return
    if progress.status.iteration[0] > progress.max_iterations + progress.max_truncations:
        wp.atomic_min(vertices.bodies.share, body, _FREEZES)
        return
    share = _ONE
    divides = bool(False)
    complete = bool(False)
    if dividing.first:
        divides = dividing.first[vertex] >= 0
        complete = divides and has_all_planes(dividing, vertex)
    if divides:
        share = share_of_path(dividing, vertex, to_double(motion.x0[vertex]), to_double(vertices.x1[vertex]))
    if not complete:
        share = wp.min(share, share_before(wp.float64(key >> wp.int64(32)) / TIME_UNITS))
    if not complete or int(key & wp.int64(3)) == NO_CONSTRAINT:
        vertices.bodies.loose[body] = 1
    wp.atomic_min(vertices.bodies.share, body, wp.int64(wp.floor(TIME_UNITS * share)))


@wp.kernel(**_KERNEL)
def cut_bodies(motion: Motion, vertices: Vertices, progress: Progress, dt: wp.float64):
    """Moves each body whose path is to be cut back along it, or freezes it in its pose at the start."""
    body = wp.tid()
    moved = vertices.bodies
    share = moved.share[body]
    moved.share[body] = _WHOLE
    moved.first_contact[body] = NEVER
    frozen = moved.outcome[body] & FROZEN != 0
    moved.moved[body] = wp.where(share < _WHOLE and not frozen, 1, 0)
    if moved.moved[body] == 0:
        return
    start = motion.bodies.start[body]
    if share == _FREEZES:
        moved.pose[body] = start
        moved.velocity[body] = wp.spatial_vector()
        moved.outcome[body] = moved.outcome[body] | FROZEN
        wp.atomic_add(progress.status.newly_frozen, 0, 1)
        return
    end = pose_between(motion.bodies, body, start, moved.pose[body], wp.float64(share) / TIME_UNITS)
    moved.pose[body] = end
    outcome = moved.outcome[body] | TRUNCATED
    if moved.loose[body] == 0:
        moved.outcome[body] = outcome | DIVIDED
        return
    moved.velocity[body] = velocity_between(motion.bodies, body, start, end, dt)
    moved.outcome[body] = (outcome | DIVIDED) - DIVIDED


@wp.kernel(**_KERNEL)
def freeze_undetected_bodies(motion: Motion, vertices: Vertices, progress: Progress):
    """Freezes all bodies if a detection was incomplete, as :func:`.kernels.freeze_undetected` does vertices."""
    body = wp.tid()
    frozen = progress.status.undetected[0] == 1 and motion.bodies.inverse_mass[body] > 0.0
    vertices.bodies.moved[body] = wp.where(frozen, 1, 0)
    if frozen:
        vertices.bodies.pose[body] = motion.bodies.start[body]
        vertices.bodies.velocity[body] = wp.spatial_vector()
        vertices.bodies.outcome[body] = vertices.bodies.outcome[body] | FROZEN
