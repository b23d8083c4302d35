"""Forces of VBD's self-contact as kernels over pairs of features, which Warp differentiates.

The form is that of :mod:`.elements`; an element has the four particles of a vertex and a triangle, or of two edges.
Where the closest points of both are nearer than a distance, a penalty pushes them apart that is logarithmic below half
of it, and damping while the gap closes; friction is Coulomb's, smoothed below a velocity. The closest points follow
from the positions at the end of the step, and are differentiated as well.

VBD has each pair of edges twice, once for each edge to push. Both have the same forces unless the edges are parallel,
where the closest points are not unique. So does this: an element of edges has forces on the first edge alone.

References:
    M. Li, Z. Ferguson, T. Schneider, T. Langlois, D. Zorin, D. Panozzo, C. Jiang and D. M. Kaufman, Incremental
    Potential Contact, ACM Transactions on Graphics 39(4), 2020, doi:10.1145/3386569.3392425.
    C. Ericson, Real-Time Collision Detection, 2005 (closest points, Sec. 5.1).
"""

import warp as wp

from .contact_forces import friction, normal_force

_ZERO = wp.constant(wp.float64(0.0))
_ONE = wp.constant(wp.float64(1.0))
_LEAST_CLOSING_SPEED = wp.constant(wp.float64(1.0e-6))  # of damping [m/s], as in VBD


@wp.struct
class SelfContactSettings:
    """Coefficients of self-contact."""

    distance: wp.float64  # nearer than which pairs push [m]
    ke: wp.float64  # [N/m]
    kd: wp.float64  # [N s/m]
    mu: wp.float64
    friction_velocity: wp.float64  # below which friction is smoothed [m/s]
    least_edge_squared: wp.float64  # squared length of an edge that counts as a point [m^2]


@wp.func
def _pair_force(dt: wp.float64, gap: wp.vec3d, gap_0: wp.vec3d, settings: SelfContactSettings):
    """Returns the force that pushes the first of two closest points away from the second, ``gap`` being between them.

    ``gap_0`` is between the same points of both at the start of the step.
    """
    distance = wp.length(gap)
    if distance == _ZERO or distance >= settings.distance:
        return wp.vec3d()
    normal = gap / distance
    load = normal_force(distance, settings.distance, settings.ke, 1)
    slid = gap - gap_0
    closing = wp.dot(normal, slid)
    push = load
    if closing < -_LEAST_CLOSING_SPEED * dt:
        push = push - settings.kd / dt * closing
    return push * normal + friction(settings.mu * load, slid - closing * normal, settings.friction_velocity * dt)


@wp.func
def _closest_on_triangle(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, p: wp.vec3d):
    """Returns the barycentric coordinates of the point of a triangle that is closest to p."""
    ab, ac = b - a, c - a
    d1, d2 = wp.dot(ab, p - a), wp.dot(ac, p - a)
    d3, d4 = wp.dot(ab, p - b), wp.dot(ac, p - b)
    d5, d6 = wp.dot(ab, p - c), wp.dot(ac, p - c)
    if d1 <= _ZERO and d2 <= _ZERO:
        return wp.vec3d(_ONE, _ZERO, _ZERO)
    if d3 >= _ZERO and d4 <= d3:
        return wp.vec3d(_ZERO, _ONE, _ZERO)
    if d6 >= _ZERO and d5 <= d6:
        return wp.vec3d(_ZERO, _ZERO, _ONE)
    vc = d1 * d4 - d3 * d2
    if vc <= _ZERO and d1 >= _ZERO and d3 <= _ZERO:
        v = d1 / (d1 - d3)
        return wp.vec3d(_ONE - v, v, _ZERO)
    vb = d5 * d2 - d1 * d6
    if vb <= _ZERO and d2 >= _ZERO and d6 <= _ZERO:
        w = d2 / (d2 - d6)
        return wp.vec3d(_ONE - w, _ZERO, w)
    va = d3 * d6 - d5 * d4
    if va <= _ZERO and d4 >= d3 and d5 >= d6:
        w = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        return wp.vec3d(_ZERO, _ONE - w, w)
    v, w = vb / (va + vb + vc), vc / (va + vb + vc)
    return wp.vec3d(_ONE - v - w, v, w)


@wp.func
def _closest_on_edges(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d, least_squared: wp.float64):
    """Returns how far along the edges from a to b and from c to d their closest points are, as shares of the edges."""
    u, v, w = b - a, d - c, a - c
    uu, vv, uv, uw, vw = wp.dot(u, u), wp.dot(v, v), wp.dot(u, v), wp.dot(u, w), wp.dot(v, w)
    if uu <= least_squared and vv <= least_squared:
        return wp.vec2d(_ZERO, _ZERO)
    if uu <= least_squared:
        return wp.vec2d(_ZERO, wp.clamp(vw / vv, _ZERO, _ONE))
    if vv <= least_squared:
        return wp.vec2d(wp.clamp(-uw / uu, _ZERO, _ONE), _ZERO)
    determinant = uu * vv - uv * uv
    s = _ZERO
    if determinant > _ZERO:
        s = wp.clamp((uv * vw - uw * vv) / determinant, _ZERO, _ONE)
    t = (uv * s + vw) / vv
    if t < _ZERO:
        return wp.vec2d(wp.clamp(-uw / uu, _ZERO, _ONE), _ZERO)
    if t > _ONE:
        return wp.vec2d(wp.clamp((uv - uw) / uu, _ZERO, _ONE), _ONE)
    return wp.vec2d(s, t)


@wp.kernel
def vertex_triangle_forces(
    # in
    dt: wp.float64,
    x1: wp.array3d[wp.vec3d],
    x0: wp.array3d[wp.vec3d],
    vertices: wp.array2d[int],
    settings: SelfContactSettings,
    # out
    forces: wp.array3d[wp.vec3d],
):
    """Computes the forces between a vertex, the first particle, and a triangle."""
    e, row = wp.tid()
    for i in range(4):
        forces[e, row, i] = wp.vec3d()
    if vertices[e, 0] < 0:
        return
    p, a, b, c = x1[e, row, 0], x1[e, row, 1], x1[e, row, 2], x1[e, row, 3]
    weights = _closest_on_triangle(a, b, c, p)
    gap = p - weights[0] * a - weights[1] * b - weights[2] * c
    gap_0 = x0[e, row, 0] - weights[0] * x0[e, row, 1] - weights[1] * x0[e, row, 2] - weights[2] * x0[e, row, 3]
    force = _pair_force(dt, gap, gap_0, settings)
    forces[e, row, 0] = force
    forces[e, row, 1] = -weights[0] * force
    forces[e, row, 2] = -weights[1] * force
    forces[e, row, 3] = -weights[2] * force


@wp.kernel
def edge_edge_forces(
    # in
    dt: wp.float64,
    x1: wp.array3d[wp.vec3d],
    x0: wp.array3d[wp.vec3d],
    vertices: wp.array2d[int],
    settings: SelfContactSettings,
    # out
    forces: wp.array3d[wp.vec3d],
):
    """Computes the forces on an edge, the first two particles, from another edge."""
    e, row = wp.tid()
    for i in range(4):
        forces[e, row, i] = wp.vec3d()
    if vertices[e, 0] < 0:
        return
    a, b, c, d = x1[e, row, 0], x1[e, row, 1], x1[e, row, 2], x1[e, row, 3]
    shares = _closest_on_edges(a, b, c, d, settings.least_edge_squared)
    s, t = shares[0], shares[1]
    gap = a + s * (b - a) - c - t * (d - c)
    start, other = x0[e, row, 0], x0[e, row, 2]
    gap_0 = start + s * (x0[e, row, 1] - start) - other - t * (x0[e, row, 3] - other)
    force = _pair_force(dt, gap, gap_0, settings)
    forces[e, row, 0] = (_ONE - s) * force
    forces[e, row, 1] = s * force
