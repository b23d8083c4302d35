"""Forces of barriers and friction as a kernel over contacts, which Warp differentiates, and their Jacobians by hand.

The form is that of :mod:`.elements`. An element is a pair of :mod:`..contact.pairs`, or a particle near an infinite
plane. All follows from positions at both ends of the step as in the solve, in float64: the closest points, the reach of
the barrier, which depends on the distance at the start, and its stiffness. The gradient of a distance does not depend
on how closest points move, so that forces are exact; their derivatives do, and have it.
"""

import warp as wp

from ...detection.narrow.rules.approach import distances_of_pair
from ...kernels.polynomials import EDGE_EDGE
from ...response.contacts.constraints import friction_on_plane, pair_friction
from ...response.state.planes import MovingPlanes, signed_distance
from ...response.state.structs import Motion
from ...response.state.vectors import ONE, ZERO
from ..contact import barrier
from ..contact.pairs import (
    PARALLEL,
    BarrierSettings,
    barrier_of,
    carrying_stiffness,
    gap_at_plane,
    reach_of,
    share_of_parallel,
    stiffness_at_plane,
    stiffness_by_mass,
)
from ..contact.system import AT_PLANE

_ON_EDGE = wp.constant(wp.float64(1e-15))
"""Weight of a vertex of a face below which the closest point is on the edge across from it."""
_SINGULAR = wp.constant(wp.float64(1e-14))
"""Square of the sine of the angle below which edges are parallel."""


@wp.struct
class RecordedContacts:
    """Contacts at the end of a step."""

    kind: wp.array[int]  # kind of each, -1 beyond their number
    plane: wp.array[int]  # the plane of a contact at one
    fall: wp.array[float]  # how far gravity moves what is at rest in the step, by world [m]


@wp.func
def _barrier_of_pair(
    motion: Motion,
    settings: BarrierSettings,
    fall: float,
    kind: int,
    corners: wp.vec4i,
    p: wp.vec3d,
    q: wp.vec3d,
    r: wp.vec3d,
    s: wp.vec3d,
):
    """Returns level, reach and stiffness of a barrier, and whether the angle between edges changes the last."""
    kept = ZERO
    start = barrier.least_distance(kind, p, q, r, s)
    if motion.distances.radius:
        start, kept = distances_of_pair(motion.distances, kind, corners, p, q, r, s)
    level, reach = barrier_of(settings, start, kept, reach_of(settings, corners))
    by_mass = stiffness_by_mass(motion, settings, fall, corners, kind == EDGE_EDGE, reach)
    return level, reach, carrying_stiffness(by_mass, settings, corners, reach), by_mass < ZERO


@wp.func
def _friction_force(slid: wp.vec3d, normal: wp.vec3d, limit: wp.float64, smoothing: wp.float64) -> wp.vec3d:
    """Returns the force of friction against sliding, whose magnitude is at most the limit."""
    across = slid - wp.dot(slid, normal) * normal
    return -limit * barrier.friction_slope(wp.length(across), smoothing) * across


@wp.kernel
def contact_forces(
    # in
    dt: wp.float64,
    x1: wp.array3d[wp.vec3d],
    x0: wp.array3d[wp.vec3d],
    vertices: wp.array2d[int],
    contacts: RecordedContacts,
    motion: Motion,
    planes: MovingPlanes,
    settings: BarrierSettings,
    # out
    forces: wp.array3d[wp.vec3d],
):
    """Computes the forces of contacts on their corners."""
    e, row = wp.tid()
    for i in range(4):
        forces[e, row, i] = wp.vec3d()
    kind = contacts.kind[e]
    if kind < 0:
        return
    corners = wp.vec4i(vertices[e, 0], vertices[e, 1], vertices[e, 2], vertices[e, 3])
    a, b, c, d = x1[e, row, 0], x1[e, row, 1], x1[e, row, 2], x1[e, row, 3]
    p, q, r, s = x0[e, row, 0], x0[e, row, 1], x0[e, row, 2], x0[e, row, 3]
    fall = contacts.fall[motion.world[corners[0]]]
    if kind == AT_PLANE:
        plane, vertex = contacts.plane[e], corners[0]
        place = planes.end[plane]
        distance, _error = signed_distance(place, a)
        _kept, level, reach, _floor = gap_at_plane(motion, planes, settings, plane, vertex, p)
        gap = distance - level
        if gap >= reach or gap <= ZERO:
            return
        stiffness = stiffness_at_plane(motion, settings, fall, vertex, reach)
        load = -stiffness * barrier.barrier_slope(gap, reach)
        normal = wp.vec3d(place[0], place[1], place[2])
        limit = wp.float64(friction_on_plane(motion, planes, plane, vertex)) * load
        forces[e, row, 0] = load * normal + _friction_force(a - p, normal, limit, settings.smoothing)
        return
    level, reach, stiffness, by_angle = _barrier_of_pair(motion, settings, fall, kind, corners, p, q, r, s)
    w, distance = barrier.closest_weights_and_gap(kind, a, b, c, d)
    gap = distance - level
    if gap >= reach or gap <= ZERO:
        return
    if by_angle:
        stiffness = stiffness * share_of_parallel(a, b, c, d)
    load = -stiffness * barrier.barrier_slope(gap, reach)
    normal = (w[0] * a + w[1] * b + w[2] * c + w[3] * d) / distance
    slid = w[0] * (a - p) + w[1] * (b - q) + w[2] * (c - r) + w[3] * (d - s)
    limit = wp.float64(pair_friction(motion, corners)) * load
    force = load * normal + _friction_force(slid, normal, limit, settings.smoothing)
    forces[e, row, 0] = w[0] * force
    forces[e, row, 1] = w[1] * force
    forces[e, row, 2] = w[2] * force
    forces[e, row, 3] = w[3] * force


@wp.func
def _friction_jacobian(
    slid: wp.vec3d,
    normal: wp.vec3d,
    limit: wp.float64,
    smoothing: wp.float64,
    by_slid: wp.mat33d,
    by_normal: wp.mat33d,
    by_limit: wp.vec3d,
) -> wp.mat33d:
    """Returns the derivative of :func:`_friction_force`, given those of what it depends on."""
    along = wp.dot(slid, normal)
    across = slid - along * normal
    by_across = by_slid - along * by_normal
    by_across -= wp.outer(normal, slid * by_normal + normal * by_slid)
    length = wp.length(across)
    slope = barrier.friction_slope(length, smoothing)
    if length > smoothing:
        by_across -= wp.outer(across, across * by_across) / (length * length)
    return -slope * (wp.outer(across, by_limit) + limit * by_across)


@wp.func
def _shares(kind: int, w: wp.vec4d):
    """Returns how weights change where the closest points move, in up to two ways; 0 for those that they cannot go."""
    first, second = wp.vec4d(ZERO, ONE, -ONE, ZERO), wp.vec4d(ZERO, ONE, ZERO, -ONE)
    if kind == EDGE_EDGE:
        first, second = wp.vec4d(-ONE, ONE, ZERO, ZERO), wp.vec4d(ZERO, ZERO, ONE, -ONE)
        if w[0] == ZERO or w[1] == ZERO:
            first = wp.vec4d()
        if w[2] == ZERO or w[3] == ZERO:
            second = wp.vec4d()
        return first, second
    at_b, at_c, at_d = wp.abs(w[1]) < _ON_EDGE, w[2] == ZERO, w[3] == ZERO
    if at_b:  # on the edge across from b, if not at one of its ends
        first, second = wp.vec4d(ZERO, ZERO, ONE, -ONE), wp.vec4d()
    if at_c or (at_b and at_d):
        first = wp.vec4d()
    if at_d or (at_b and at_c):
        second = wp.vec4d()
    return first, second


@wp.func
def _parallel_by_edge(u: wp.vec3d, v: wp.vec3d) -> wp.vec3d:
    """Returns the derivative of :func:`.pairs.share_of_parallel` by the first of two edges, over that share."""
    uu, vv, uv = wp.length_sq(u), wp.length_sq(v), wp.dot(u, v)
    scaled = wp.length_sq(wp.cross(u, v)) / (PARALLEL * uu * vv)
    if scaled >= ONE or scaled <= ZERO:
        return wp.vec3d()
    by_edge = (wp.float64(2.0) * uv / (PARALLEL * uu * vv)) * (uv / uu * u - v)
    return (wp.float64(2.0) * (ONE - scaled) / (scaled * (wp.float64(2.0) - scaled))) * by_edge


@wp.func
def _weighted(w: wp.vec4d, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d) -> wp.vec3d:
    """Returns the sum of four vectors by weights."""
    return w[0] * a + w[1] * b + w[2] * c + w[3] * d


@wp.kernel(enable_backward=False)
def contact_jacobians(
    # in
    x1: wp.array3d[wp.vec3d],
    x0: wp.array3d[wp.vec3d],
    vertices: wp.array2d[int],
    contacts: RecordedContacts,
    motion: Motion,
    planes: MovingPlanes,
    settings: BarrierSettings,
    # out
    jacobian: wp.array3d[wp.vec3d],
):
    """Computes the derivatives of :func:`contact_forces` by the position of a corner at the end of the step.

    A thread has one corner. Forces are weights times one vector, and all follows from how that, and the two numbers by
    which closest points move on their elements, change with the corner.
    """
    e, j = wp.tid()
    for k in range(12):
        jacobian[e, k, j] = wp.vec3d()
    kind = contacts.kind[e]
    if kind < 0:
        return
    corners = wp.vec4i(vertices[e, 0], vertices[e, 1], vertices[e, 2], vertices[e, 3])
    a, b, c, d = x1[e, 0, 0], x1[e, 0, 1], x1[e, 0, 2], x1[e, 0, 3]
    p, q, r, s = x0[e, 0, 0], x0[e, 0, 1], x0[e, 0, 2], x0[e, 0, 3]
    fall = contacts.fall[motion.world[corners[0]]]
    one = wp.identity(n=3, dtype=wp.float64)
    if kind == AT_PLANE:
        if j > 0:
            return
        plane, vertex = contacts.plane[e], corners[0]
        place = planes.end[plane]
        away, _error = signed_distance(place, a)
        _kept, low, wide, _floor = gap_at_plane(motion, planes, settings, plane, vertex, p)
        if away - low >= wide or away - low <= ZERO:
            return
        stiff = stiffness_at_plane(motion, settings, fall, vertex, wide)
        up = wp.vec3d(place[0], place[1], place[2])
        by_load = -stiff * barrier.barrier_curvature(away - low, wide) * up
        mu = wp.float64(friction_on_plane(motion, planes, plane, vertex))
        limit_there = -mu * stiff * barrier.barrier_slope(away - low, wide)
        by_place = wp.outer(up, by_load)
        by_place += _friction_jacobian(a - p, up, limit_there, settings.smoothing, one, wp.mat33d(), mu * by_load)
        for k in range(3):
            jacobian[e, k, 0] = by_place[k]
        return
    level, reach, stiffness, by_angle = _barrier_of_pair(motion, settings, fall, kind, corners, p, q, r, s)
    w, distance = barrier.closest_weights_and_gap(kind, a, b, c, d)
    gap = distance - level
    if gap >= reach or gap <= ZERO:
        return
    if by_angle:
        stiffness = stiffness * share_of_parallel(a, b, c, d)
    load = -stiffness * barrier.barrier_slope(gap, reach)
    apart = _weighted(w, a, b, c, d)
    normal = apart / distance
    slid = _weighted(w, a - p, b - q, c - r, d - s)
    friction = wp.float64(pair_friction(motion, corners))
    force = load * normal + _friction_force(slid, normal, friction * load, settings.smoothing)
    # how closest points move: both ways stay across from the vector between them
    first, second = _shares(kind, w)
    t, u = _weighted(first, a, b, c, d), _weighted(second, a, b, c, d)
    by_t, by_u = -(first[j] * apart + w[j] * t), -(second[j] * apart + w[j] * u)
    tt, tu, uu = wp.length_sq(t), wp.dot(t, u), wp.length_sq(u)
    determinant = tt * uu - tu * tu
    of_first, of_second = wp.vec3d(), wp.vec3d()
    if determinant > _SINGULAR * tt * uu:
        of_first, of_second = (uu * by_t - tu * by_u) / determinant, (tt * by_u - tu * by_t) / determinant
    elif uu > ZERO:
        of_second = by_u / uu
    elif tt > ZERO:
        of_first = by_t / tt
    by_apart = w[j] * one + wp.outer(t, of_first) + wp.outer(u, of_second)
    by_normal = (by_apart - wp.outer(normal, normal * by_apart)) / distance
    by_slid = w[j] * one + wp.outer(_weighted(first, a - p, b - q, c - r, d - s), of_first)
    by_slid += wp.outer(_weighted(second, a - p, b - q, c - r, d - s), of_second)
    by_load = (-stiffness * barrier.barrier_curvature(gap, reach) * w[j]) * normal
    if by_angle:
        by_edge = _parallel_by_edge(b - a, d - c)
        if j >= 2:
            by_edge = _parallel_by_edge(d - c, b - a)
        by_load += (wp.where(j % 2 == 0, -ONE, ONE) * load) * by_edge
    by_force = wp.outer(normal, by_load) + load * by_normal
    by_force += _friction_jacobian(
        slid, normal, friction * load, settings.smoothing, by_slid, by_normal, friction * by_load
    )
    for i in range(4):
        by_corner = w[i] * by_force + wp.outer(force, first[i] * of_first + second[i] * of_second)
        for k in range(3):
            jacobian[e, 3 * i + k, j] = by_corner[k]
