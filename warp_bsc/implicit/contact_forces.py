"""Forces of VBD in contacts and of attachments as kernels over elements, which Warp differentiates.

The form is that of :mod:`.elements`. An element of contact has the particles of a vertex, an edge or a face at a plane,
of a vertex and a triangle, or of two edges. A plane goes through a point of the shape, which collision detection found:
the point moves with the body, the normal does not. Within the radius of the particle a penalty pushes, and damping
while the gap closes; friction is Coulomb's, smoothed below a velocity.

Where the closest points of a pair of self-contact are nearer than a distance, the same pushes them apart; the penalty
is logarithmic below half of it. The points follow from the positions at the end of the step, and are differentiated as
well. VBD has each pair of edges twice, once for each edge to push. Both have the same forces unless the edges are
parallel, where the closest points are not unique. So does this: an element of edges has forces on the first edge alone.

An attachment pulls a particle to a point of a body. VBD iterates on a multiplier for it, whose limit is the force of a
damped spring of length zero. That is the force here, so that a step in which the multiplier is not there yet has a
residual. In the limit of infinite stiffness the particle is at the point.

References:
    M. Li, Z. Ferguson, T. Schneider, T. Langlois, D. Zorin, D. Panozzo, C. Jiang and D. M. Kaufman, Incremental
    Potential Contact, ACM Transactions on Graphics 39(4), 2020, doi:10.1145/3386569.3392425.
"""

import warp as wp

from ..kernels.closest import closest_weights
from ..kernels.polynomials import EDGE_EDGE, VERTEX_FACE
from .kernels import HELD

_ZERO = wp.constant(wp.float64(0.0))
_HALF = wp.constant(wp.float64(0.5))
_ONE = wp.constant(wp.float64(1.0))
_TWO = wp.constant(wp.float64(2.0))
_LEAST_CLOSING_SPEED = wp.constant(wp.float64(1.0e-6))  # of the damping of pairs [m/s], as in VBD
_LEAST_DISTANCE = wp.constant(wp.float64(1.0e-5))  # of the logarithmic barrier, as in VBD


@wp.struct
class ContactPlanes:
    """Contacts of a step, each as a plane of a shape, and the particles that touch it."""

    indices: wp.array[wp.vec3i]  # particles, -1 for none
    barycentric: wp.array[wp.vec3]  # of edges and faces
    shape: wp.array[int]
    body_pos: wp.array[wp.vec3]  # [m]
    body_vel: wp.array[wp.vec3]  # [m/s]
    normal: wp.array[wp.vec3]


@wp.struct
class ContactSettings:
    """Coefficients of contacts, and which elements are which."""

    first_pair: int  # of a vertex and a triangle
    first_edges: int  # pair of edges
    distance: wp.float64  # nearer than which pairs push [m]
    least_edge_squared: wp.float64  # squared length of an edge that counts as a point [m^2]

    ke: wp.float64  # of particles [N/m]
    kd: wp.float64  # of particles [N s/m]
    mu: wp.float64  # of particles
    friction_velocity: wp.float64  # below which friction is smoothed [m/s]
    has_barrier: int  # whether the penalty is logarithmic where particles are near
    particle_radius: wp.array[float]  # [m]
    shape_ke: wp.array[float]
    shape_kd: wp.array[float]
    shape_mu: wp.array[float]
    shape_margin: wp.array[float]  # [m]
    shape_body: wp.array[int]


@wp.func
def _rotate(pose: wp.transform, v: wp.vec3d):
    q = wp.transform_get_rotation(pose)
    return wp.quat_rotate(wp.quatd(wp.float64(q[0]), wp.float64(q[1]), wp.float64(q[2]), wp.float64(q[3])), v)


@wp.func
def _transform(pose: wp.transform, p: wp.vec3d):
    return _rotate(pose, p) + wp.vec3d(wp.transform_get_translation(pose))


@wp.func
def _normal_force(distance: wp.float64, radius: wp.float64, ke: wp.float64, has_barrier: int):
    """Returns the penalty of a contact, logarithmic below half the radius if it has a barrier."""
    tau = _HALF * radius
    force = ke * (radius - distance)
    if has_barrier != 0 and distance < tau:
        least = wp.min(_LEAST_DISTANCE, _HALF * tau)
        if distance > least:
            force = tau * tau * ke / distance
        else:
            force = tau * tau * ke * (_TWO * least - distance) / (least * least)
    return force


@wp.func
def _friction(limit: wp.float64, slid: wp.vec3d, smoothing: wp.float64):
    """Returns Coulomb's friction against sliding, whose magnitude falls below its limit where less than that slid."""
    length = wp.length(slid)
    scale = _ZERO
    if length > smoothing:
        scale = _ONE / length
    elif smoothing > _ZERO:
        scale = (_TWO - length / smoothing) / smoothing
    return -(limit * scale) * slid


@wp.func
def _plane_force(
    dt: wp.float64,
    x1: wp.vec3d,
    x0: wp.vec3d,
    radius: wp.float64,
    e: int,
    planes: ContactPlanes,
    settings: ContactSettings,
    pose_1: wp.array[wp.transform],
    pose_0: wp.array[wp.transform],
):
    """Returns the force on a point at a plane."""
    shape = planes.shape[e]
    if settings.shape_margin.shape[0] > 0:
        radius = radius + wp.float64(settings.shape_margin[shape])
    point = wp.vec3d(planes.body_pos[e])
    slid = dt * wp.vec3d(planes.body_vel[e])
    normal = wp.vec3d(planes.normal[e])
    body = settings.shape_body[shape]
    if body >= 0:
        start = _transform(pose_0[body], point)
        point = _transform(pose_1[body], point)
        slid = _rotate(pose_1[body], slid) + point - start
    distance = wp.dot(normal, x1 - point)
    if distance >= radius:
        return wp.vec3d()
    ke = _HALF * (settings.ke + wp.float64(settings.shape_ke[shape]))
    load = _normal_force(distance, radius, ke, settings.has_barrier)
    slid = x1 - x0 - slid
    closing = wp.dot(normal, slid)
    push = load
    if closing < _ZERO:
        push = push - _HALF * (settings.kd + wp.float64(settings.shape_kd[shape])) / dt * closing
    force = push * normal
    mu = settings.mu * wp.float64(settings.shape_mu[shape])
    if mu > _ZERO:
        force += _friction(wp.sqrt(mu) * load, slid - closing * normal, settings.friction_velocity * dt)
    return force


@wp.func
def _pair_force(dt: wp.float64, gap: wp.vec3d, gap_0: wp.vec3d, settings: ContactSettings):
    """Returns the force that pushes the first of two closest points away from the second, ``gap`` being between them.

    ``gap_0`` is between the same points of both at the start of the step.
    """
    distance = wp.length(gap)
    if distance == _ZERO or distance >= settings.distance:
        return wp.vec3d()
    normal = gap / distance
    load = _normal_force(distance, settings.distance, settings.ke, 1)
    slid = gap - gap_0
    closing = wp.dot(normal, slid)
    push = load
    if closing < -_LEAST_CLOSING_SPEED * dt:
        push = push - settings.kd / dt * closing
    return push * normal + _friction(settings.mu * load, slid - closing * normal, settings.friction_velocity * dt)


@wp.kernel
def contact_forces(
    # in
    dt: wp.float64,
    x1: wp.array3d[wp.vec3d],
    x0: wp.array3d[wp.vec3d],
    vertices: wp.array2d[int],
    planes: ContactPlanes,
    settings: ContactSettings,
    pose_1: wp.array[wp.transform],
    pose_0: wp.array[wp.transform],
    # out
    forces: wp.array3d[wp.vec3d],
):
    """Computes the forces of contacts."""
    e, row = wp.tid()
    for i in range(4):
        forces[e, row, i] = wp.vec3d()
    if vertices[e, 0] < 0:
        return
    a, b, c, d = x1[e, row, 0], x1[e, row, 1], x1[e, row, 2], x1[e, row, 3]
    p, q, r, s = x0[e, row, 0], x0[e, row, 1], x0[e, row, 2], x0[e, row, 3]
    w, radius = wp.vec4d(_ONE, _ZERO, _ZERO, _ZERO), _ZERO
    if e < settings.first_pair:
        radius = wp.float64(settings.particle_radius[vertices[e, 0]])
        if vertices[e, 1] >= 0:
            shares = wp.vec3d(planes.barycentric[e])
            w = wp.vec4d(shares[0], shares[1], shares[2], _ZERO)
            radius = wp.max(radius, wp.float64(settings.particle_radius[vertices[e, 1]]))
        if vertices[e, 2] >= 0:
            radius = wp.max(radius, wp.float64(settings.particle_radius[vertices[e, 2]]))
    elif e < settings.first_edges:
        w = closest_weights(VERTEX_FACE, a, b, c, d)
    else:  # VBD takes short edges for points
        end = wp.where(wp.length_sq(b - a) <= settings.least_edge_squared, a, b)
        other = wp.where(wp.length_sq(d - c) <= settings.least_edge_squared, c, d)
        w = closest_weights(EDGE_EDGE, a, end, c, other)
    gap = w[0] * a + w[1] * b + w[2] * c + w[3] * d
    gap_0 = w[0] * p + w[1] * q + w[2] * r + w[3] * s
    force = wp.vec3d()
    if e < settings.first_pair:
        force = _plane_force(dt, gap, gap_0, radius, e, planes, settings, pose_1, pose_0)
    else:
        force = _pair_force(dt, gap, gap_0, settings)
    forces[e, row, 0] = w[0] * force
    forces[e, row, 1] = w[1] * force
    if e < settings.first_edges:
        forces[e, row, 2] = w[2] * force
        forces[e, row, 3] = w[3] * force


@wp.kernel
def attachment_forces(
    # in
    dt: wp.float64,
    x1: wp.array3d[wp.vec3d],
    x0: wp.array3d[wp.vec3d],
    body: wp.array[int],
    body_point: wp.array[wp.vec3],
    stiffness: wp.array[float],
    damping: wp.array[float],
    enabled: wp.array[wp.bool],
    pose_1: wp.array[wp.transform],
    pose_0: wp.array[wp.transform],
    # out
    forces: wp.array3d[wp.vec3d],
):
    """Computes the forces of attachments of finite stiffness."""
    e, row = wp.tid()
    forces[e, row, 0] = wp.vec3d()
    if not enabled[e] or wp.isinf(stiffness[e]):
        return
    b, point = body[e], wp.vec3d(body_point[e])
    offset = x1[e, row, 0] - _transform(pose_1[b], point)
    force = wp.float64(wp.max(stiffness[e], 0.0)) * offset
    if damping[e] > 0.0:
        offset_0 = x0[e, row, 0] - _transform(pose_0[b], point)
        force = force + wp.float64(damping[e]) / dt * (offset - offset_0)
    forces[e, row, 0] = -force


@wp.kernel
def hold_forces(
    # in
    dt: wp.float64,
    x1: wp.array3d[wp.vec3d],
    x0: wp.array3d[wp.vec3d],
    body: wp.array[int],
    body_point: wp.array[wp.vec3],
    stiffness: wp.array[float],
    enabled: wp.array[wp.bool],
    vertices: wp.array2d[int],
    mass: wp.array[float],
    is_fixed: wp.array[int],
    pose_1: wp.array[wp.transform],
    # out
    forces: wp.array3d[wp.vec3d],
):
    """Computes the forces that move particles to where attachments of infinite stiffness hold them."""
    e, row = wp.tid()
    forces[e, row, 0] = wp.vec3d()
    particle = vertices[e, 0]
    if not enabled[e] or not wp.isinf(stiffness[e]) or is_fixed[particle] != HELD:
        return
    offset = x1[e, row, 0] - _transform(pose_1[body[e]], wp.vec3d(body_point[e]))
    forces[e, row, 0] = -(wp.float64(mass[particle]) / (dt * dt)) * offset
