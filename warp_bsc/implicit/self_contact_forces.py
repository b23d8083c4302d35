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
"""

import warp as wp

from ..kernels.closest import closest_weights
from ..kernels.polynomials import EDGE_EDGE, VERTEX_FACE
from .contact_forces import friction, normal_force

_ZERO = wp.constant(wp.float64(0.0))
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


@wp.kernel
def pair_forces(
    # in
    dt: wp.float64,
    x1: wp.array3d[wp.vec3d],
    x0: wp.array3d[wp.vec3d],
    vertices: wp.array2d[int],
    triangles: int,
    settings: SelfContactSettings,
    # out
    forces: wp.array3d[wp.vec3d],
):
    """Computes the forces between vertices and triangles, the first ``triangles`` pairs, and on edges from others."""
    e, row = wp.tid()
    for i in range(4):
        forces[e, row, i] = wp.vec3d()
    if vertices[e, 0] < 0:
        return
    a, b, c, d = x1[e, row, 0], x1[e, row, 1], x1[e, row, 2], x1[e, row, 3]
    p, q, r, s = x0[e, row, 0], x0[e, row, 1], x0[e, row, 2], x0[e, row, 3]
    w = wp.vec4d()
    if e < triangles:
        w = closest_weights(VERTEX_FACE, a, b, c, d)
    else:  # VBD takes short edges for points
        end = wp.where(wp.length_sq(b - a) <= settings.least_edge_squared, a, b)
        other = wp.where(wp.length_sq(d - c) <= settings.least_edge_squared, c, d)
        w = closest_weights(EDGE_EDGE, a, end, c, other)
    gap = w[0] * a + w[1] * b + w[2] * c + w[3] * d
    gap_0 = w[0] * p + w[1] * q + w[2] * r + w[3] * s
    force = _pair_force(dt, gap, gap_0, settings)
    forces[e, row, 0] = w[0] * force
    forces[e, row, 1] = w[1] * force
    if e < triangles:
        forces[e, row, 2] = w[2] * force
        forces[e, row, 3] = w[3] * force
