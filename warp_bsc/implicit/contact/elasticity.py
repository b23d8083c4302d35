"""Energies that Newton's VBD gives to elements, with their gradients and Hessians by hand.

Stable neo-Hookean membranes and tetrahedra, dihedral bending, springs, and damping by the change since the start of the
step, as in :mod:`..energies`, whose forces are the negative gradients here. All is computed in float64; blocks of
Hessians are stored in float32.

References:
    B. Smith, F. De Goes and T. Kim, Stable Neo-Hookean Flesh Simulation, ACM Transactions on Graphics 37(2), 2018,
    doi:10.1145/3180491.
    R. Bridson, S. Marino and R. Fedkiw, Simulation of Clothing with Folds and Wrinkles, Symposium on Computer
    Animation, 2003 (the gradient of the dihedral angle).
"""

from enum import IntEnum
from typing import Any

import newton
import numpy as np
import warp as wp

from ...response.state.vectors import HALF, ONE, ZERO, to_double, to_single

wp.set_module_options({"enable_backward": False})

_TWO = wp.constant(wp.float64(2.0))
_THREE = wp.constant(wp.float64(3.0))
_SIX = wp.constant(wp.float64(6.0))
_PI = wp.constant(wp.float64(3.141592653589793))
_LEAST_AREA_SQUARED = wp.constant(wp.float64(1.0e-20))  # as VBD has these four
_LEAST_LAMBDA = wp.constant(wp.float64(1.0e-6))
_DEGENERATE = wp.constant(wp.float64(1.0e-6))
_LEAST_LENGTH = wp.constant(wp.float64(1.0e-8))


class ElementKind(IntEnum):
    """Kinds of elements, in the order in which they are numbered."""

    MEMBRANE = 0
    BENDING = 1
    TETRAHEDRON = 2
    SPRING = 3


SIZES = 3, 4, 4, 2
"""Particles of an element of each kind."""
_FIRST_CORNER, _FIRST_BLOCK = wp.constant(4), wp.constant(8)
"""Where the second and third group of numbers begin in :attr:`Elements.first`."""


@wp.struct
class Elements:
    """The elements of a model. They, their corners and their blocks are numbered, one kind behind the other.

    Attributes:
        first: First element of each kind, then first corner, then first block.
        tri_indices: Particles of triangles, and so on as in ``newton.Model``.
    """

    first: wp.array[int]
    tri_indices: wp.array2d[int]
    tri_poses: wp.array[wp.mat22]
    tri_areas: wp.array[float]
    tri_materials: wp.array2d[float]
    edge_indices: wp.array2d[int]
    edge_rest_angle: wp.array[float]
    edge_rest_length: wp.array[float]
    edge_properties: wp.array2d[float]
    tet_indices: wp.array2d[int]
    tet_poses: wp.array[wp.mat33]
    tet_materials: wp.array2d[float]
    spring_indices: wp.array2d[int]
    spring_rest_length: wp.array[float]
    spring_stiffness: wp.array[float]
    spring_damping: wp.array[float]


@wp.struct
class Derivatives:
    """What :func:`differentiate` computes.

    Attributes:
        gradient: Of each corner of each element [N], shape [corners].
        block: Hessians of each two corners of each element but those of bending, row by row [N/m], shape [blocks].
        turn: Derivatives of the angle of each element of bending by its corners [1/m], shape [4 count].
        curvature: Second derivative of its energy by the angle [J], shape [count].
    """

    gradient: wp.array[wp.vec3]
    block: wp.array[wp.mat33]
    turn: wp.array[wp.vec3]
    curvature: wp.array[float]


def elements_of_model(model: newton.Model) -> tuple[Elements, list[np.ndarray]]:
    """Returns the elements of a model, and the particles of each kind of them, -1 for none, shape [n, size]."""
    elements, vertices = Elements(), []
    names = "tri", "edge", "tet", "spring"
    for name, size in zip(names, SIZES, strict=True):
        indices = getattr(model, f"{name}_indices")
        if indices is None or not len(indices):
            indices = wp.zeros((0, size), dtype=int, device=model.device)
        indices = indices.reshape((-1, size))
        setattr(elements, f"{name}_indices", indices)
        vertices.append(indices.numpy().astype(np.int64))
    elements.tri_poses, elements.tri_areas, elements.tri_materials = (
        model.tri_poses,
        model.tri_areas,
        model.tri_materials,
    )
    elements.edge_rest_angle, elements.edge_rest_length = model.edge_rest_angle, model.edge_rest_length
    elements.edge_properties = model.edge_bending_properties
    elements.tet_poses, elements.tet_materials = model.tet_poses, model.tet_materials
    elements.spring_rest_length, elements.spring_stiffness = model.spring_rest_length, model.spring_stiffness
    elements.spring_damping = model.spring_damping
    counts = np.array([len(v) for v in vertices])
    sizes = np.array(SIZES)
    blocks = counts * sizes * sizes
    blocks[ElementKind.BENDING] = 0
    first = [np.cumsum(np.append(0, n)[:-1]) for n in (counts, counts * sizes, blocks)]
    elements.first = wp.array(np.concatenate(first).astype(np.int32), dtype=int, device=model.device)
    return elements, vertices


def make_derivatives(vertices: list[np.ndarray], device: wp.Device) -> Derivatives:
    """Returns buffers for the derivatives of elements with the particles that :func:`elements_of_model` returns."""
    derivatives, bends = Derivatives(), len(vertices[ElementKind.BENDING])
    blocks = sum(v.size * v.shape[1] for kind, v in enumerate(vertices) if kind != ElementKind.BENDING)
    derivatives.gradient = wp.zeros(sum(v.size for v in vertices), dtype=wp.vec3, device=device)
    derivatives.block = wp.zeros(blocks, dtype=wp.mat33, device=device)
    derivatives.turn = wp.zeros(4 * bends, dtype=wp.vec3, device=device)
    derivatives.curvature = wp.zeros(bends, dtype=float, device=device)
    return derivatives


@wp.func
def kind_of(elements: Elements, i: int) -> int:
    """Returns the kind of an element."""
    kind = int(0)
    for k in range(1, 4):
        if i >= elements.first[k]:
            kind = k
    return kind


@wp.func
def first_vertex(elements: Elements, kind: int, e: int) -> int:
    """Returns a particle of an element of a kind."""
    if kind == ElementKind.MEMBRANE:
        return elements.tri_indices[e, 0]
    if kind == ElementKind.BENDING:
        return elements.edge_indices[e, 2]
    if kind == ElementKind.TETRAHEDRON:
        return elements.tet_indices[e, 0]
    return elements.spring_indices[e, 0]


@wp.func
def _is_finite(elements: Elements, kind: int, e: int, x: wp.array[Any]) -> bool:
    """Returns whether the particles of an element have finite positions."""
    if kind == ElementKind.MEMBRANE:
        v = elements.tri_indices
        return wp.isfinite(x[v[e, 0]]) and wp.isfinite(x[v[e, 1]]) and wp.isfinite(x[v[e, 2]])
    if kind == ElementKind.SPRING:
        return wp.isfinite(x[elements.spring_indices[e, 0]]) and wp.isfinite(x[elements.spring_indices[e, 1]])
    v = elements.tet_indices
    if kind == ElementKind.BENDING:
        v = elements.edge_indices
    finite = bool(True)
    for j in range(4):
        if v[e, j] >= 0:
            finite = finite and wp.isfinite(x[v[e, j]])
    return finite


@wp.func
def _rest_stretch(mu: wp.float64, lame: wp.float64):
    """Returns the ratio of areas or volumes at which the volumetric term is at rest, alpha of Smith et al."""
    return ONE + mu / (wp.sign(lame) * wp.max(wp.abs(lame), _LEAST_LAMBDA))


@wp.func
def _cross_matrix(a: wp.vec3d) -> wp.mat33d:
    """Returns the matrix [a] for which [a] b is the cross product of a and b."""
    return wp.mat33d(ZERO, -a[2], a[1], a[2], ZERO, -a[0], -a[1], a[0], ZERO)


@wp.func
def _single(m: wp.mat33d) -> wp.mat33:
    return wp.matrix_from_rows(to_single(m[0]), to_single(m[1]), to_single(m[2]))


@wp.func
def _identity() -> wp.mat33d:
    return wp.identity(n=3, dtype=wp.float64)


# Membranes


@wp.func
def _membrane_frame(elements: Elements, e: int, x: wp.array[Any]):
    """Returns the columns of the deformation gradient of a triangle."""
    pose = elements.tri_poses[e]
    origin = to_double(x[elements.tri_indices[e, 0]])
    u = to_double(x[elements.tri_indices[e, 1]]) - origin
    v = to_double(x[elements.tri_indices[e, 2]]) - origin
    f0 = wp.float64(pose[0, 0]) * u + wp.float64(pose[1, 0]) * v
    f1 = wp.float64(pose[0, 1]) * u + wp.float64(pose[1, 1]) * v
    return f0, f1


@wp.func
def _membrane_energy(elements: Elements, e: int, x: wp.array[wp.vec3d], x0: wp.array[wp.vec3], dt: wp.float64):
    mu, lame = wp.float64(elements.tri_materials[e, 0]), wp.float64(elements.tri_materials[e, 1])
    if mu <= ZERO and lame <= ZERO:
        return ZERO
    lame = lame + mu
    f0, f1 = _membrane_frame(elements, e, x)
    area_vector = wp.cross(f0, f1)
    ratio = wp.sqrt(wp.max(wp.length_sq(area_vector), _LEAST_AREA_SQUARED)) - _rest_stretch(mu, lame)
    rest = ONE - _rest_stretch(mu, lame)
    energy = HALF * mu * (wp.length_sq(f0) + wp.length_sq(f1) - _TWO) + HALF * lame * (ratio * ratio - rest * rest)
    damping = wp.float64(elements.tri_materials[e, 2])
    if damping > ZERO:
        g0, g1 = _membrane_frame(elements, e, x0)
        c00 = wp.dot(f0, f0) - wp.dot(g0, g0)
        c01 = wp.dot(f0, f1) - wp.dot(g0, g1)
        c11 = wp.dot(f1, f1) - wp.dot(g1, g1)
        energy += HALF * damping / dt * (c00 * c00 + _TWO * c01 * c01 + c11 * c11)
    return wp.float64(elements.tri_areas[e]) * energy


@wp.func
def _differentiate_membrane(
    elements: Elements,
    e: int,
    x: wp.array[wp.vec3d],
    x0: wp.array[wp.vec3],
    dt: wp.float64,
    is_convex: bool,
    out: Derivatives,
):
    corner, place = elements.first[_FIRST_CORNER] + 3 * e, elements.first[_FIRST_BLOCK] + 9 * e
    mu, lame = wp.float64(elements.tri_materials[e, 0]), wp.float64(elements.tri_materials[e, 1])
    if mu <= ZERO and lame <= ZERO:
        for i in range(3):
            out.gradient[corner + i] = wp.vec3()
        for k in range(9):
            out.block[place + k] = wp.mat33()
        return
    lame = lame + mu
    f0, f1 = _membrane_frame(elements, e, x)
    area_vector = wp.cross(f0, f1)
    ratio = wp.sqrt(wp.max(wp.length_sq(area_vector), _LEAST_AREA_SQUARED))
    normal = area_vector / ratio
    pressure = lame * (ratio - _rest_stretch(mu, lame))
    g0, g1 = wp.cross(f1, normal), wp.cross(normal, f0)  # derivatives of the ratio of areas
    stress_0, stress_1 = mu * f0 + pressure * g0, mu * f1 + pressure * g1
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
    plane = _identity() - nn
    h00 = mu * plane + lame * wp.outer(g0, g0) + s00 * nn
    h11 = mu * plane + lame * wp.outer(g1, g1) + s11 * nn
    h01 = lame * wp.outer(g0, g1) + s01 * nn - within * _cross_matrix(normal)
    damping = wp.float64(elements.tri_materials[e, 2])
    if damping > ZERO:
        r0, r1 = _membrane_frame(elements, e, x0)
        scale = _TWO * damping / dt
        rate_00 = scale * (wp.dot(f0, f0) - wp.dot(r0, r0))
        rate_01 = scale * (wp.dot(f0, f1) - wp.dot(r0, r1))
        rate_11 = scale * (wp.dot(f1, f1) - wp.dot(r1, r1))
        stress_0 += rate_00 * f0 + rate_01 * f1
        stress_1 += rate_01 * f0 + rate_11 * f1
        p00, p11 = wp.outer(f0, f0), wp.outer(f1, f1)
        h00 += scale * (_TWO * p00 + p11)
        h11 += scale * (_TWO * p11 + p00)
        h01 += scale * wp.outer(f1, f0)
        if not is_convex:
            h00 += rate_00 * _identity()
            h11 += rate_11 * _identity()
            h01 += rate_01 * _identity()
    pose, area = elements.tri_poses[e], wp.float64(elements.tri_areas[e])
    a, b = wp.float64(pose[0, 0]), wp.float64(pose[0, 1])
    c, d = wp.float64(pose[1, 0]), wp.float64(pose[1, 1])
    along_0, along_1 = wp.vec3d(-a - c, a, c), wp.vec3d(-b - d, b, d)  # derivatives of f0 and f1 by corners
    h10 = wp.transpose(h01)
    for i in range(3):
        s, t = area * along_0[i], area * along_1[i]
        out.gradient[corner + i] = to_single(s * stress_0 + t * stress_1)
        by_0, by_1 = s * h00 + t * h10, s * h01 + t * h11
        for j in range(3):
            out.block[place + 3 * i + j] = _single(along_0[j] * by_0 + along_1[j] * by_1)


# Bending


@wp.func
def _is_degenerate(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d):
    least_normal = wp.min(wp.length(wp.cross(c - a, d - a)), wp.length(wp.cross(d - b, c - b)))
    return wp.min(least_normal, wp.length(d - c)) < _DEGENERATE


@wp.func
def _dihedral_angle(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d):
    """Returns the angle between the normals of the triangles a, c, d and b, d, c at the edge from c to d."""
    n1, n2, e = wp.cross(c - a, d - a), wp.cross(d - b, c - b), d - c
    return wp.atan2(wp.dot(wp.cross(n1, n2), e) / wp.length(e), wp.dot(n1, n2))


@wp.func
def _bends(elements: Elements, e: int):
    v = elements.edge_indices
    return v[e, 0] >= 0 and v[e, 1] >= 0 and elements.edge_properties[e, 0] > 0.0


@wp.func
def _edge_corners(elements: Elements, e: int, x: wp.array[Any]):
    v = elements.edge_indices
    return to_double(x[v[e, 0]]), to_double(x[v[e, 1]]), to_double(x[v[e, 2]]), to_double(x[v[e, 3]])


@wp.func
def _bending_change(elements: Elements, e: int, angle: wp.float64, x0: wp.array[wp.vec3]):
    """Returns the change of an angle since the start, and the damping of it, 0 where there is none."""
    damping = wp.float64(elements.edge_properties[e, 1])
    if damping <= ZERO:
        return ZERO, ZERO
    p, q, r, s = _edge_corners(elements, e, x0)
    if _is_degenerate(p, q, r, s):
        return ZERO, ZERO
    change = angle - _dihedral_angle(p, q, r, s)
    if change > _PI:
        change = change - _TWO * _PI
    elif change < -_PI:
        change = change + _TWO * _PI
    return change, damping


@wp.func
def _bending_energy(elements: Elements, e: int, x: wp.array[wp.vec3d], x0: wp.array[wp.vec3], dt: wp.float64):
    if not _bends(elements, e):
        return ZERO
    a, b, c, d = _edge_corners(elements, e, x)
    if _is_degenerate(a, b, c, d):
        return ZERO
    angle = _dihedral_angle(a, b, c, d)
    bent = angle - wp.float64(elements.edge_rest_angle[e])
    change, damping = _bending_change(elements, e, angle, x0)
    energy = wp.float64(elements.edge_properties[e, 0]) * bent * bent + damping / dt * change * change
    return HALF * wp.float64(elements.edge_rest_length[e]) * energy


@wp.func
def _differentiate_bending(
    elements: Elements, e: int, x: wp.array[wp.vec3d], x0: wp.array[wp.vec3], dt: wp.float64, out: Derivatives
):
    corner = elements.first[_FIRST_CORNER + 1] + 4 * e
    flat = not _bends(elements, e)
    a, b, c, d = wp.vec3d(), wp.vec3d(), wp.vec3d(), wp.vec3d()
    if not flat:
        a, b, c, d = _edge_corners(elements, e, x)
        flat = _is_degenerate(a, b, c, d)
    if flat:
        for i in range(4):
            out.gradient[corner + i] = wp.vec3()
        out.curvature[e] = 0.0
        return
    n1, n2, edge = wp.cross(c - a, d - a), wp.cross(d - b, c - b), d - c
    length = wp.length(edge)
    along = edge / length
    m1, m2 = n1 / wp.dot(n1, n1), n2 / wp.dot(n2, n2)
    angle = _dihedral_angle(a, b, c, d)
    change, damping = _bending_change(elements, e, angle, x0)
    rest = wp.float64(elements.edge_rest_length[e])
    stiffness = wp.float64(elements.edge_properties[e, 0])
    moment = rest * (stiffness * (angle - wp.float64(elements.edge_rest_angle[e])) + damping / dt * change)
    out.curvature[e] = float(rest * (stiffness + damping / dt))
    by = wp.matrix_from_rows(
        -length * m1,
        -length * m2,
        wp.vec3d(-(wp.dot(a - d, along) * m1 + wp.dot(b - d, along) * m2)),
        wp.vec3d(wp.dot(a - c, along) * m1 + wp.dot(b - c, along) * m2),
    )
    for i in range(4):
        out.gradient[corner + i] = to_single(moment * by[i])
        out.turn[4 * e + i] = to_single(by[i])


# Tetrahedra


@wp.func
def _double(m: wp.mat33) -> wp.mat33d:
    rows = wp.mat33d()
    for i in range(3):
        for j in range(3):
            rows[i, j] = wp.float64(m[i, j])
    return rows


@wp.func
def _tetrahedron_frame(elements: Elements, e: int, pose: wp.mat33d, x: wp.array[Any]) -> wp.mat33d:
    """Returns the deformation gradient of a tetrahedron."""
    v = elements.tet_indices
    origin = to_double(x[v[e, 0]])
    sides = wp.matrix_from_cols(
        to_double(x[v[e, 1]]) - origin, to_double(x[v[e, 2]]) - origin, to_double(x[v[e, 3]]) - origin
    )
    return sides * pose


@wp.func
def _column(m: wp.mat33d, j: int) -> wp.vec3d:
    return wp.vec3d(m[0, j], m[1, j], m[2, j])


@wp.func
def _tetrahedron_energy(elements: Elements, e: int, x: wp.array[wp.vec3d], x0: wp.array[wp.vec3], dt: wp.float64):
    mu, lame = wp.float64(elements.tet_materials[e, 0]), wp.float64(elements.tet_materials[e, 1])
    if mu <= ZERO and lame <= ZERO:
        return ZERO
    lame = lame + mu
    pose = _double(elements.tet_poses[e])
    f = _tetrahedron_frame(elements, e, pose, x)
    ratio = wp.determinant(f) - _rest_stretch(mu, lame)
    rest = ONE - _rest_stretch(mu, lame)
    energy = HALF * mu * (wp.ddot(f, f) - _THREE) + HALF * lame * (ratio * ratio - rest * rest)
    damping = wp.float64(elements.tet_materials[e, 2])
    if damping > ZERO:
        g = _tetrahedron_frame(elements, e, pose, x0)
        rate = wp.transpose(f) * f - wp.transpose(g) * g
        energy += HALF * damping / dt * wp.ddot(rate, rate)
    return energy / (_SIX * wp.determinant(pose))


@wp.func
def _differentiate_tetrahedron(
    elements: Elements,
    e: int,
    x: wp.array[wp.vec3d],
    x0: wp.array[wp.vec3],
    dt: wp.float64,
    is_convex: bool,
    out: Derivatives,
):
    corner, place = elements.first[_FIRST_CORNER + 2] + 4 * e, elements.first[_FIRST_BLOCK + 2] + 16 * e
    mu, lame = wp.float64(elements.tet_materials[e, 0]), wp.float64(elements.tet_materials[e, 1])
    if mu <= ZERO and lame <= ZERO:
        for i in range(4):
            out.gradient[corner + i] = wp.vec3()
        for k in range(16):
            out.block[place + k] = wp.mat33()
        return
    lame = lame + mu
    pose = _double(elements.tet_poses[e])
    volume = ONE / (_SIX * wp.determinant(pose))
    f = _tetrahedron_frame(elements, e, pose, x)
    f0, f1, f2 = _column(f, 0), _column(f, 1), _column(f, 2)
    g0, g1, g2 = wp.cross(f1, f2), wp.cross(f2, f0), wp.cross(f0, f1)  # derivatives of the ratio of volumes
    pressure = lame * (wp.dot(f0, g0) - _rest_stretch(mu, lame))
    s0, s1, s2 = mu * f0 + pressure * g0, mu * f1 + pressure * g1, mu * f2 + pressure * g2
    h00 = mu * _identity() + lame * wp.outer(g0, g0)
    h11 = mu * _identity() + lame * wp.outer(g1, g1)
    h22 = mu * _identity() + lame * wp.outer(g2, g2)
    within = pressure
    if is_convex:
        most = mu / wp.sqrt(wp.max(wp.ddot(f, f) / _THREE, ONE))
        within = wp.clamp(pressure, -most, most)
    h01 = lame * wp.outer(g0, g1) - within * _cross_matrix(f2)
    h02 = lame * wp.outer(g0, g2) + within * _cross_matrix(f1)
    h12 = lame * wp.outer(g1, g2) - within * _cross_matrix(f0)
    damping = wp.float64(elements.tet_materials[e, 2])
    if damping > ZERO:
        g = _tetrahedron_frame(elements, e, pose, x0)
        scale = _TWO * damping / dt
        rate = scale * (wp.transpose(f) * f - wp.transpose(g) * g)
        s0 += rate[0, 0] * f0 + rate[0, 1] * f1 + rate[0, 2] * f2
        s1 += rate[1, 0] * f0 + rate[1, 1] * f1 + rate[1, 2] * f2
        s2 += rate[2, 0] * f0 + rate[2, 1] * f1 + rate[2, 2] * f2
        p = wp.outer(f0, f0) + wp.outer(f1, f1) + wp.outer(f2, f2)
        h00 += scale * (wp.outer(f0, f0) + p)
        h11 += scale * (wp.outer(f1, f1) + p)
        h22 += scale * (wp.outer(f2, f2) + p)
        h01 += scale * wp.outer(f1, f0)
        h02 += scale * wp.outer(f2, f0)
        h12 += scale * wp.outer(f2, f1)
        if not is_convex:
            h00 += rate[0, 0] * _identity()
            h11 += rate[1, 1] * _identity()
            h22 += rate[2, 2] * _identity()
            h01 += rate[0, 1] * _identity()
            h02 += rate[0, 2] * _identity()
            h12 += rate[1, 2] * _identity()
    h10, h20, h21 = wp.transpose(h01), wp.transpose(h02), wp.transpose(h12)
    for i in range(4):
        b = _corner_weights(pose, i)
        out.gradient[corner + i] = to_single(volume * (b[0] * s0 + b[1] * s1 + b[2] * s2))
        by_0 = volume * (b[0] * h00 + b[1] * h10 + b[2] * h20)
        by_1 = volume * (b[0] * h01 + b[1] * h11 + b[2] * h21)
        by_2 = volume * (b[0] * h02 + b[1] * h12 + b[2] * h22)
        for j in range(4):
            c = _corner_weights(pose, j)
            out.block[place + 4 * i + j] = _single(c[0] * by_0 + c[1] * by_1 + c[2] * by_2)


@wp.func
def _corner_weights(pose: wp.mat33d, i: int) -> wp.vec3d:
    """Returns the derivatives of the columns of the deformation gradient by a corner."""
    if i == 0:
        return -(pose[0] + pose[1] + pose[2])
    return pose[i - 1]


# Springs


@wp.func
def _spring_energy(elements: Elements, e: int, x: wp.array[wp.vec3d], x0: wp.array[wp.vec3], dt: wp.float64):
    a, b = elements.spring_indices[e, 0], elements.spring_indices[e, 1]
    length = wp.max(wp.length(x[a] - x[b]), _LEAST_LENGTH)
    length_0 = wp.max(wp.length(to_double(x0[a]) - to_double(x0[b])), _LEAST_LENGTH)
    stretch, change = length - wp.float64(elements.spring_rest_length[e]), length - length_0
    energy = wp.float64(elements.spring_stiffness[e]) * stretch * stretch
    return HALF * (energy + wp.float64(elements.spring_damping[e]) / dt * change * change)


@wp.func
def _differentiate_spring(
    elements: Elements,
    e: int,
    x: wp.array[wp.vec3d],
    x0: wp.array[wp.vec3],
    dt: wp.float64,
    is_convex: bool,
    out: Derivatives,
):
    corner, place = elements.first[_FIRST_CORNER + 3] + 2 * e, elements.first[_FIRST_BLOCK + 3] + 4 * e
    a, b = elements.spring_indices[e, 0], elements.spring_indices[e, 1]
    between = x[a] - x[b]
    length = wp.max(wp.length(between), _LEAST_LENGTH)
    length_0 = wp.max(wp.length(to_double(x0[a]) - to_double(x0[b])), _LEAST_LENGTH)
    stiffness, damping = wp.float64(elements.spring_stiffness[e]), wp.float64(elements.spring_damping[e]) / dt
    tension = stiffness * (length - wp.float64(elements.spring_rest_length[e])) + damping * (length - length_0)
    along = between / length
    outer = wp.outer(along, along)
    across = tension / length
    if is_convex:
        across = wp.max(across, ZERO)
    block = _single((stiffness + damping) * outer + across * (_identity() - outer))
    force = to_single(tension * along)
    out.gradient[corner] = force
    out.gradient[corner + 1] = -force
    out.block[place] = block
    out.block[place + 1] = -block
    out.block[place + 2] = -block
    out.block[place + 3] = block


# All kinds


@wp.func
def element_energy(
    elements: Elements, i: int, kind: int, x: wp.array[wp.vec3d], x0: wp.array[wp.vec3], dt: wp.float64
) -> wp.float64:
    """Returns the energy of an element of a kind above that at rest [J], damping included.

    It is 0 where a particle has no finite position, like the derivatives.
    """
    e = i - elements.first[kind]
    if not _is_finite(elements, kind, e, x):
        return ZERO
    if kind == ElementKind.MEMBRANE:
        return _membrane_energy(elements, e, x, x0, dt)
    if kind == ElementKind.BENDING:
        return _bending_energy(elements, e, x, x0, dt)
    if kind == ElementKind.TETRAHEDRON:
        return _tetrahedron_energy(elements, e, x, x0, dt)
    return _spring_energy(elements, e, x, x0, dt)


@wp.func
def _clear(elements: Elements, kind: int, e: int, out: Derivatives):
    """Writes derivatives of 0."""
    size = 4
    if kind == ElementKind.MEMBRANE:
        size = 3
    elif kind == ElementKind.SPRING:
        size = 2
    corner, place = (
        elements.first[_FIRST_CORNER + kind] + size * e,
        elements.first[_FIRST_BLOCK + kind] + size * size * e,
    )
    for i in range(size):
        out.gradient[corner + i] = wp.vec3()
    if kind == ElementKind.BENDING:  # has no blocks
        out.curvature[e] = 0.0
        return
    for k in range(size * size):
        out.block[place + k] = wp.mat33()


@wp.kernel
def differentiate(
    # in
    elements: Elements,
    x: wp.array[wp.vec3d],
    x0: wp.array[wp.vec3],
    dt: wp.float64,
    world: wp.array[int],
    active: wp.array[int],
    convex: wp.array[int],
    # out
    out: Derivatives,
):
    """Computes the gradient and the Hessian of each element, in active worlds.

    The Hessian of bending is that of Gauss and Newton: without the curvature of the angle. In ``convex`` worlds, those
    of others are without their negative curvature too, or more.
    """
    i = wp.tid()
    kind = kind_of(elements, i)
    e = i - elements.first[kind]
    in_world = world[first_vertex(elements, kind, e)]
    if active[in_world] == 0:
        return
    is_convex = convex[in_world] != 0
    if not _is_finite(elements, kind, e, x):
        _clear(elements, kind, e, out)
        return
    if kind == ElementKind.MEMBRANE:
        _differentiate_membrane(elements, e, x, x0, dt, is_convex, out)
    elif kind == ElementKind.BENDING:
        _differentiate_bending(elements, e, x, x0, dt, out)
    elif kind == ElementKind.TETRAHEDRON:
        _differentiate_tetrahedron(elements, e, x, x0, dt, is_convex, out)
    else:
        _differentiate_spring(elements, e, x, x0, dt, is_convex, out)
