"""Forces of VBD between particles and bodies as kernels over contacts and attachments, which Warp differentiates.

The form is that of :mod:`.elements`. An element of contact has the particles of a vertex, an edge or a face. A contact
is a plane through a point of the shape, which collision detection found: the point moves with the body, the normal does
not. Within the radius of the particle a penalty pushes, and damping while the gap closes; friction is Coulomb's,
smoothed below a velocity.

An attachment pulls a particle to a point of a body. VBD iterates on a multiplier for it, whose limit is the force of a
damped spring of length zero. That is the force here, so that a step in which the multiplier is not there yet has a
residual. In the limit of infinite stiffness the particle is at the point.
"""

import warp as wp

from .kernels import HELD

_ZERO = wp.constant(wp.float64(0.0))
_HALF = wp.constant(wp.float64(0.5))
_ONE = wp.constant(wp.float64(1.0))
_TWO = wp.constant(wp.float64(2.0))
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
    """Coefficients of contacts."""

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
def normal_force(distance: wp.float64, radius: wp.float64, ke: wp.float64, has_barrier: int):
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
def friction(limit: wp.float64, slid: wp.vec3d, smoothing: wp.float64):
    """Returns Coulomb's friction against sliding, whose magnitude falls below its limit where less than that slid."""
    length = wp.length(slid)
    scale = _ZERO
    if length > smoothing:
        scale = _ONE / length
    elif smoothing > _ZERO:
        scale = (_TWO - length / smoothing) / smoothing
    return -(limit * scale) * slid


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
    for i in range(3):
        forces[e, row, i] = wp.vec3d()
    a, b, c = vertices[e, 0], vertices[e, 1], vertices[e, 2]
    if a < 0:
        return
    weights = wp.vec3d(_ONE, _ZERO, _ZERO)
    radius = wp.float64(settings.particle_radius[a])
    if b >= 0:
        weights = wp.vec3d(planes.barycentric[e])
        radius = wp.max(radius, wp.float64(settings.particle_radius[b]))
    if c >= 0:
        radius = wp.max(radius, wp.float64(settings.particle_radius[c]))
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
    x = weights[0] * x1[e, row, 0] + weights[1] * x1[e, row, 1] + weights[2] * x1[e, row, 2]
    distance = wp.dot(normal, x - point)
    if distance >= radius:
        return
    load = normal_force(
        distance, radius, _HALF * (settings.ke + wp.float64(settings.shape_ke[shape])), settings.has_barrier
    )
    slid = x - weights[0] * x0[e, row, 0] - weights[1] * x0[e, row, 1] - weights[2] * x0[e, row, 2] - slid
    closing = wp.dot(normal, slid)
    push = load
    if closing < _ZERO:
        push = push - _HALF * (settings.kd + wp.float64(settings.shape_kd[shape])) / dt * closing
    force = push * normal
    mu = settings.mu * wp.float64(settings.shape_mu[shape])
    if mu > _ZERO:
        force += friction(wp.sqrt(mu) * load, slid - closing * normal, settings.friction_velocity * dt)
    for i in range(3):
        forces[e, row, i] = weights[i] * force


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
