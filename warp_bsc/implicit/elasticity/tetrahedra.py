"""The stable neo-Hookean energy of tetrahedra, with damping by the change since the start of the step.

References: as :mod:`.membranes`.
"""

from typing import Any

import warp as wp

from ...response.state.vectors import HALF, ONE, ZERO
from .elements import ElementKind, Elements, first_block
from .matrices import cross_matrix, identity, store
from .membranes import rest_stretch

wp.set_module_options({"enable_backward": False})

_TWO, _THREE, _SIX = wp.constant(wp.float64(2.0)), wp.constant(wp.float64(3.0)), wp.constant(wp.float64(6.0))


@wp.func
def _double(m: wp.mat33) -> wp.mat33d:
    rows = wp.mat33d()
    for i in range(3):
        for j in range(3):
            rows[i, j] = wp.float64(m[i, j])
    return rows


@wp.func
def _frame(elements: Elements, e: int, pose: wp.mat33d, x: wp.array[Any]) -> wp.mat33d:
    """Returns the deformation gradient of a tetrahedron."""
    v = elements.tet_indices
    origin = wp.vec3d(x[v[e, 0]])
    sides = wp.matrix_from_cols(
        wp.vec3d(x[v[e, 1]]) - origin, wp.vec3d(x[v[e, 2]]) - origin, wp.vec3d(x[v[e, 3]]) - origin
    )
    return sides * pose


@wp.func
def _column(m: wp.mat33d, j: int) -> wp.vec3d:
    return wp.vec3d(m[0, j], m[1, j], m[2, j])


@wp.func
def _material(elements: Elements, e: int):
    """Returns mu and lambda of the energy of a tetrahedron."""
    mu, lame = wp.float64(elements.tet_materials[e, 0]), wp.float64(elements.tet_materials[e, 1])
    return mu, lame + mu


@wp.func
def _change(elements: Elements, e: int, pose: wp.mat33d, f: wp.mat33d, x0: wp.array[Any]) -> wp.mat33d:
    """Returns the change of the strain F^T F since the start."""
    g = _frame(elements, e, pose, x0)
    return wp.transpose(f) * f - wp.transpose(g) * g


@wp.func
def energy(elements: Elements, e: int, x: wp.array[Any], x0: wp.array[Any], dt: wp.float64):
    """Returns the energy of a tetrahedron [J]."""
    mu, lame = _material(elements, e)
    pose = _double(elements.tet_poses[e])
    f = _frame(elements, e, pose, x)
    ratio = wp.determinant(f) - rest_stretch(mu, lame)
    rest = ONE - rest_stretch(mu, lame)
    energy = HALF * mu * (wp.ddot(f, f) - _THREE) + HALF * lame * (ratio * ratio - rest * rest)
    damping = wp.float64(elements.tet_materials[e, 2])
    if damping > ZERO:
        change = _change(elements, e, pose, f, x0)
        energy += HALF * damping / dt * wp.ddot(change, change)
    return energy / (_SIX * wp.determinant(pose))


@wp.func
def _corner_weights(pose: wp.mat33d, i: int) -> wp.vec3d:
    """Returns the derivatives of the columns of the deformation gradient by a corner."""
    if i == 0:
        return -(pose[0] + pose[1] + pose[2])
    return pose[i - 1]


@wp.func
def gradient(elements: Elements, e: int, x: wp.array[Any], x0: wp.array[Any], dt: wp.float64):
    """Returns the derivatives of the energy of a tetrahedron by its corners, a row for each [N]."""
    mu, lame = _material(elements, e)
    pose = _double(elements.tet_poses[e])
    volume = ONE / (_SIX * wp.determinant(pose))
    f = _frame(elements, e, pose, x)
    f0, f1, f2 = _column(f, 0), _column(f, 1), _column(f, 2)
    g0, g1, g2 = wp.cross(f1, f2), wp.cross(f2, f0), wp.cross(f0, f1)
    pressure = lame * (wp.dot(f0, g0) - rest_stretch(mu, lame))
    s0, s1, s2 = mu * f0 + pressure * g0, mu * f1 + pressure * g1, mu * f2 + pressure * g2
    damping = wp.float64(elements.tet_materials[e, 2])
    if damping > ZERO:
        rate = _TWO * damping / dt * _change(elements, e, pose, f, x0)
        s0 += rate[0, 0] * f0 + rate[0, 1] * f1 + rate[0, 2] * f2
        s1 += rate[1, 0] * f0 + rate[1, 1] * f1 + rate[1, 2] * f2
        s2 += rate[2, 0] * f0 + rate[2, 1] * f1 + rate[2, 2] * f2
    stress = wp.matrix_from_rows(s0, s1, s2)
    by_1, by_2, by_3 = volume * (pose[0] * stress), volume * (pose[1] * stress), volume * (pose[2] * stress)
    return wp.matrix_from_rows(volume * (_corner_weights(pose, 0) * stress), by_1, by_2, by_3)


@wp.func
def store_hessian(
    elements: Elements, e: int, x: wp.array[Any], x0: wp.array[Any], dt: wp.float64, is_convex: bool, out: wp.array[Any]
):
    """Writes the Hessian of the energy of a tetrahedron, convex or exact, a block for each two corners [N/m]."""
    place = first_block(elements, ElementKind.TETRAHEDRON, e)
    mu, lame = _material(elements, e)
    pose = _double(elements.tet_poses[e])
    volume = ONE / (_SIX * wp.determinant(pose))
    f = _frame(elements, e, pose, x)
    f0, f1, f2 = _column(f, 0), _column(f, 1), _column(f, 2)
    g0, g1, g2 = wp.cross(f1, f2), wp.cross(f2, f0), wp.cross(f0, f1)  # derivatives of the ratio of volumes
    pressure = lame * (wp.dot(f0, g0) - rest_stretch(mu, lame))
    h00 = mu * identity() + lame * wp.outer(g0, g0)
    h11 = mu * identity() + lame * wp.outer(g1, g1)
    h22 = mu * identity() + lame * wp.outer(g2, g2)
    within = pressure
    if is_convex:
        most = mu / wp.sqrt(wp.max(wp.ddot(f, f) / _THREE, ONE))
        within = wp.clamp(pressure, -most, most)
    h01 = lame * wp.outer(g0, g1) - within * cross_matrix(f2)
    h02 = lame * wp.outer(g0, g2) + within * cross_matrix(f1)
    h12 = lame * wp.outer(g1, g2) - within * cross_matrix(f0)
    damping = wp.float64(elements.tet_materials[e, 2])
    if damping > ZERO:
        scale = _TWO * damping / dt
        p = wp.outer(f0, f0) + wp.outer(f1, f1) + wp.outer(f2, f2)
        h00 += scale * (wp.outer(f0, f0) + p)
        h11 += scale * (wp.outer(f1, f1) + p)
        h22 += scale * (wp.outer(f2, f2) + p)
        h01 += scale * wp.outer(f1, f0)
        h02 += scale * wp.outer(f2, f0)
        h12 += scale * wp.outer(f2, f1)
        if not is_convex:
            rate = scale * _change(elements, e, pose, f, x0)
            h00 += rate[0, 0] * identity()
            h11 += rate[1, 1] * identity()
            h22 += rate[2, 2] * identity()
            h01 += rate[0, 1] * identity()
            h02 += rate[0, 2] * identity()
            h12 += rate[1, 2] * identity()
    h10, h20, h21 = wp.transpose(h01), wp.transpose(h02), wp.transpose(h12)
    for i in range(4):
        b = _corner_weights(pose, i)
        by_0 = volume * (b[0] * h00 + b[1] * h10 + b[2] * h20)
        by_1 = volume * (b[0] * h01 + b[1] * h11 + b[2] * h21)
        by_2 = volume * (b[0] * h02 + b[1] * h12 + b[2] * h22)
        for j in range(4):
            c = _corner_weights(pose, j)
            store(out, place + 4 * i + j, c[0] * by_0 + c[1] * by_1 + c[2] * by_2)
