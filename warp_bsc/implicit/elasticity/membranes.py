"""The stable neo-Hookean energy of triangles, with damping by the change since the start of the step.

References:
    B. Smith, F. De Goes and T. Kim, Stable Neo-Hookean Flesh Simulation, ACM Transactions on Graphics 37(2), 2018,
    doi:10.1145/3180491.
"""

from typing import Any

import warp as wp

from ...response.state.vectors import HALF, ONE, ZERO
from .elements import ElementKind, Elements, first_block
from .matrices import cross_matrix, identity, store

wp.set_module_options({"enable_backward": False})

_TWO = wp.constant(wp.float64(2.0))
_LEAST_AREA_SQUARED = wp.constant(wp.float64(1.0e-20))  # as VBD has both
_LEAST_LAMBDA = wp.constant(wp.float64(1.0e-6))


@wp.func
def rest_stretch(mu: wp.float64, lame: wp.float64):
    """Returns the ratio of areas or volumes at which the volumetric term is at rest, alpha of Smith et al."""
    return ONE + mu / (wp.sign(lame) * wp.max(wp.abs(lame), _LEAST_LAMBDA))


@wp.func
def _frame(elements: Elements, e: int, x: wp.array[Any]):
    """Returns the columns of the deformation gradient of a triangle."""
    pose = elements.tri_poses[e]
    origin = wp.vec3d(x[elements.tri_indices[e, 0]])
    u = wp.vec3d(x[elements.tri_indices[e, 1]]) - origin
    v = wp.vec3d(x[elements.tri_indices[e, 2]]) - origin
    f0 = wp.float64(pose[0, 0]) * u + wp.float64(pose[1, 0]) * v
    f1 = wp.float64(pose[0, 1]) * u + wp.float64(pose[1, 1]) * v
    return f0, f1


@wp.func
def _material(elements: Elements, e: int):
    """Returns mu and lambda of the energy of a triangle."""
    mu, lame = wp.float64(elements.tri_materials[e, 0]), wp.float64(elements.tri_materials[e, 1])
    return mu, lame + mu


@wp.func
def _area(f0: wp.vec3d, f1: wp.vec3d):
    """Returns the normal of a triangle, and the ratio of its area to that at rest."""
    area_vector = wp.cross(f0, f1)
    ratio = wp.sqrt(wp.max(wp.length_sq(area_vector), _LEAST_AREA_SQUARED))
    return area_vector / ratio, ratio


@wp.func
def _change(elements: Elements, e: int, f0: wp.vec3d, f1: wp.vec3d, x0: wp.array[Any]) -> wp.vec3d:
    """Returns the change of the strain F^T F since the start: entries 00, 01 and 11."""
    g0, g1 = _frame(elements, e, x0)
    return wp.vec3d(wp.dot(f0, f0) - wp.dot(g0, g0), wp.dot(f0, f1) - wp.dot(g0, g1), wp.dot(f1, f1) - wp.dot(g1, g1))


@wp.func
def energy(elements: Elements, e: int, x: wp.array[Any], x0: wp.array[Any], dt: wp.float64):
    """Returns the energy of a triangle [J]."""
    mu, lame = _material(elements, e)
    f0, f1 = _frame(elements, e, x)
    _normal, area = _area(f0, f1)
    ratio = area - rest_stretch(mu, lame)
    rest = ONE - rest_stretch(mu, lame)
    energy = HALF * mu * (wp.length_sq(f0) + wp.length_sq(f1) - _TWO) + HALF * lame * (ratio * ratio - rest * rest)
    damping = wp.float64(elements.tri_materials[e, 2])
    if damping > ZERO:
        c = _change(elements, e, f0, f1, x0)
        energy += HALF * damping / dt * (c[0] * c[0] + _TWO * c[1] * c[1] + c[2] * c[2])
    return wp.float64(elements.tri_areas[e]) * energy


@wp.func
def _weights(elements: Elements, e: int):
    """Returns the derivatives of both columns of the deformation gradient by corners."""
    pose = elements.tri_poses[e]
    a, b = wp.float64(pose[0, 0]), wp.float64(pose[0, 1])
    c, d = wp.float64(pose[1, 0]), wp.float64(pose[1, 1])
    return wp.vec3d(-a - c, a, c), wp.vec3d(-b - d, b, d)


@wp.func
def gradient(elements: Elements, e: int, x: wp.array[Any], x0: wp.array[Any], dt: wp.float64):
    """Returns the derivatives of the energy of a triangle by its corners, a row for each [N]."""
    mu, lame = _material(elements, e)
    f0, f1 = _frame(elements, e, x)
    normal, ratio = _area(f0, f1)
    pressure = lame * (ratio - rest_stretch(mu, lame))
    stress_0 = mu * f0 + pressure * wp.cross(f1, normal)
    stress_1 = mu * f1 + pressure * wp.cross(normal, f0)
    damping = wp.float64(elements.tri_materials[e, 2])
    if damping > ZERO:
        rate = _TWO * damping / dt * _change(elements, e, f0, f1, x0)
        stress_0 += rate[0] * f0 + rate[1] * f1
        stress_1 += rate[1] * f0 + rate[2] * f1
    along_0, along_1 = _weights(elements, e)
    area = wp.float64(elements.tri_areas[e])
    return wp.matrix_from_rows(
        area * along_0[0] * stress_0 + area * along_1[0] * stress_1,
        area * along_0[1] * stress_0 + area * along_1[1] * stress_1,
        area * along_0[2] * stress_0 + area * along_1[2] * stress_1,
        wp.vec3d(),
    )


@wp.func
def store_hessian(
    elements: Elements, e: int, x: wp.array[Any], x0: wp.array[Any], dt: wp.float64, is_convex: bool, out: wp.array[Any]
):
    """Writes the Hessian of the energy of a triangle, convex or exact, a block for each two corners [N/m]."""
    place = first_block(elements, ElementKind.MEMBRANE, e)
    mu, lame = _material(elements, e)
    f0, f1 = _frame(elements, e, x)
    normal, ratio = _area(f0, f1)
    pressure = lame * (ratio - rest_stretch(mu, lame))
    g0, g1 = wp.cross(f1, normal), wp.cross(normal, f0)  # derivatives of the ratio of areas
    # d^2 ratio = n n^T (f1.f1, -f0.f1; -f0.f1, f0.f0) / ratio, and (0, -[n]; [n], 0)
    s00 = mu + pressure / ratio * wp.dot(f1, f1)
    s11 = mu + pressure / ratio * wp.dot(f0, f0)
    s01 = -pressure / ratio * wp.dot(f0, f1)
    within = pressure
    if is_convex:
        within = wp.clamp(pressure, -mu, mu)
        mean, half = HALF * (s00 + s11), HALF * (s00 - s11)
        radius = wp.sqrt(half * half + s01 * s01)
        if mean - radius < ZERO:
            top = wp.max(mean + radius, ZERO)
            scale_p = ZERO
            if radius > ZERO:
                scale_p = HALF * top / radius
            s00 = HALF * top + scale_p * half
            s11 = HALF * top - scale_p * half
            s01 = scale_p * s01
    nn = wp.outer(normal, normal)
    plane = identity() - nn
    h00 = mu * plane + lame * wp.outer(g0, g0) + s00 * nn
    h11 = mu * plane + lame * wp.outer(g1, g1) + s11 * nn
    h01 = lame * wp.outer(g0, g1) + s01 * nn - within * cross_matrix(normal)
    damping = wp.float64(elements.tri_materials[e, 2])
    if damping > ZERO:
        scale = _TWO * damping / dt
        p00, p11 = wp.outer(f0, f0), wp.outer(f1, f1)
        h00 += scale * (_TWO * p00 + p11)
        h11 += scale * (_TWO * p11 + p00)
        h01 += scale * wp.outer(f1, f0)
        if not is_convex:
            rate = scale * _change(elements, e, f0, f1, x0)
            h00 += rate[0] * identity()
            h11 += rate[2] * identity()
            h01 += rate[1] * identity()
    area = wp.float64(elements.tri_areas[e])
    along_0, along_1 = _weights(elements, e)
    h10 = wp.transpose(h01)
    for i in range(3):
        s, t = area * along_0[i], area * along_1[i]
        by_0, by_1 = s * h00 + t * h10, s * h01 + t * h11
        for j in range(3):
            store(out, place + 3 * i + j, along_0[j] * by_0 + along_1[j] * by_1)
