"""Energies that Newton's VBD gives to elements, with their gradients and Hessians by hand.

Stable neo-Hookean membranes and tetrahedra, dihedral bending, springs, and damping by the change since the start of the
step. All is computed in float64, from positions and into blocks of either precision.

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

from ...response.state.vectors import HALF, ONE, ZERO, to_single
from .vector_access import mat34, store_block, store_numbers

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


mat43d = wp.types.matrix(shape=(4, 3), dtype=wp.float64)

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
    """What :func:`find_derivatives` computes.

    Attributes:
        gradient: Of each corner of each element [N], shape [corners].
        block: Hessians of each two corners of each element but those of bending, row by row [N/m], shape [blocks],
            each row with a fourth number without meaning, so that a GPU reads and writes it at once.
        turn: Of each corner of each element of bending [sqrt(N/m)], shape [4 count]: the outer products of those of
            two corners are blocks of its Hessian, the fourth number is without meaning.
    """

    gradient: wp.array[wp.vec3]
    block: wp.array[mat34]
    turn: wp.array[wp.vec4]


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
    derivatives.block = wp.zeros(blocks, dtype=mat34, device=device)
    derivatives.turn = wp.zeros(4 * bends, dtype=wp.vec4, device=device)
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
def vertex_of(elements: Elements, kind: int, e: int, j: int) -> int:
    """Returns a particle of an element of a kind, -1 for none, as of the fourth corner of a triangle."""
    if kind == ElementKind.MEMBRANE:
        return wp.where(j < 3, elements.tri_indices[e, wp.min(j, 2)], -1)
    if kind == ElementKind.BENDING:
        return elements.edge_indices[e, j]
    if kind == ElementKind.TETRAHEDRON:
        return elements.tet_indices[e, j]
    return wp.where(j < 2, elements.spring_indices[e, wp.min(j, 1)], -1)


@wp.func
def first_vertex(elements: Elements, kind: int, e: int) -> int:
    """Returns a particle of an element of a kind."""
    if kind == ElementKind.BENDING:
        return vertex_of(elements, kind, e, 2)
    return vertex_of(elements, kind, e, 0)


@wp.func
def has_energy(elements: Elements, kind: int, e: int, x: wp.array[Any]) -> bool:
    """Returns whether an element has a material, and all particles that it takes, in finite positions."""
    materials = elements.tet_materials
    if kind == ElementKind.MEMBRANE:
        materials = elements.tri_materials
    if kind == ElementKind.MEMBRANE or kind == ElementKind.TETRAHEDRON:
        if materials[e, 0] <= 0.0 and materials[e, 1] <= 0.0:
            return False
    elif kind == ElementKind.BENDING:
        if elements.edge_properties[e, 0] <= 0.0 or elements.edge_indices[e, 0] < 0 or elements.edge_indices[e, 1] < 0:
            return False
    finite = bool(True)
    for j in range(4):
        v = vertex_of(elements, kind, e, j)
        if v >= 0:
            finite = finite and wp.isfinite(x[v])
    return finite


@wp.func
def element_size(kind: int) -> int:
    """Returns the number of particles of an element of a kind."""
    if kind == ElementKind.MEMBRANE:
        return 3
    if kind == ElementKind.SPRING:
        return 2
    return 4


@wp.func
def first_corner(elements: Elements, kind: int, e: int) -> int:
    """Returns the number of the first corner of an element of a kind."""
    return elements.first[_FIRST_CORNER + kind] + element_size(kind) * e


@wp.func
def first_block(elements: Elements, kind: int, e: int) -> int:
    """Returns the number of the first block of an element of any kind but bending."""
    return elements.first[_FIRST_BLOCK + kind] + element_size(kind) * element_size(kind) * e


@wp.func
def _rest_stretch(mu: wp.float64, lame: wp.float64):
    """Returns the ratio of areas or volumes at which the volumetric term is at rest, alpha of Smith et al."""
    return ONE + mu / (wp.sign(lame) * wp.max(wp.abs(lame), _LEAST_LAMBDA))


@wp.func
def cross_matrix(a: wp.vec3d) -> wp.mat33d:
    """Returns the matrix [a] for which [a] b is the cross product of a and b."""
    return wp.mat33d(ZERO, -a[2], a[1], a[2], ZERO, -a[0], -a[1], a[0], ZERO)


@wp.func
def _store(blocks: wp.array[wp.mat33d], k: int, block: wp.mat33d):  # pyright: ignore[reportRedeclaration] (overload)
    """Writes a block."""
    blocks[k] = block


@wp.func
def _store(blocks: wp.array[mat34], k: int, block: wp.mat33d):
    """Writes a block in single precision."""
    store_block(blocks, k, block)


@wp.func
def identity() -> wp.mat33d:
    """Returns the identity."""
    return wp.identity(n=3, dtype=wp.float64)


# Membranes


@wp.func
def _membrane_frame(elements: Elements, e: int, x: wp.array[Any]):
    """Returns the columns of the deformation gradient of a triangle."""
    pose = elements.tri_poses[e]
    origin = wp.vec3d(x[elements.tri_indices[e, 0]])
    u = wp.vec3d(x[elements.tri_indices[e, 1]]) - origin
    v = wp.vec3d(x[elements.tri_indices[e, 2]]) - origin
    f0 = wp.float64(pose[0, 0]) * u + wp.float64(pose[1, 0]) * v
    f1 = wp.float64(pose[0, 1]) * u + wp.float64(pose[1, 1]) * v
    return f0, f1


@wp.func
def _membrane_material(elements: Elements, e: int):
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
def _membrane_change(elements: Elements, e: int, f0: wp.vec3d, f1: wp.vec3d, x0: wp.array[Any]) -> wp.vec3d:
    """Returns the change of the strain F^T F since the start: entries 00, 01 and 11."""
    g0, g1 = _membrane_frame(elements, e, x0)
    return wp.vec3d(wp.dot(f0, f0) - wp.dot(g0, g0), wp.dot(f0, f1) - wp.dot(g0, g1), wp.dot(f1, f1) - wp.dot(g1, g1))


@wp.func
def _membrane_energy(elements: Elements, e: int, x: wp.array[Any], x0: wp.array[Any], dt: wp.float64):
    mu, lame = _membrane_material(elements, e)
    f0, f1 = _membrane_frame(elements, e, x)
    _normal, area = _area(f0, f1)
    ratio = area - _rest_stretch(mu, lame)
    rest = ONE - _rest_stretch(mu, lame)
    energy = HALF * mu * (wp.length_sq(f0) + wp.length_sq(f1) - _TWO) + HALF * lame * (ratio * ratio - rest * rest)
    damping = wp.float64(elements.tri_materials[e, 2])
    if damping > ZERO:
        c = _membrane_change(elements, e, f0, f1, x0)
        energy += HALF * damping / dt * (c[0] * c[0] + _TWO * c[1] * c[1] + c[2] * c[2])
    return wp.float64(elements.tri_areas[e]) * energy


@wp.func
def _membrane_weights(elements: Elements, e: int):
    """Returns the derivatives of both columns of the deformation gradient by corners."""
    pose = elements.tri_poses[e]
    a, b = wp.float64(pose[0, 0]), wp.float64(pose[0, 1])
    c, d = wp.float64(pose[1, 0]), wp.float64(pose[1, 1])
    return wp.vec3d(-a - c, a, c), wp.vec3d(-b - d, b, d)


@wp.func
def _membrane_gradient(elements: Elements, e: int, x: wp.array[Any], x0: wp.array[Any], dt: wp.float64):
    mu, lame = _membrane_material(elements, e)
    f0, f1 = _membrane_frame(elements, e, x)
    normal, ratio = _area(f0, f1)
    pressure = lame * (ratio - _rest_stretch(mu, lame))
    stress_0 = mu * f0 + pressure * wp.cross(f1, normal)
    stress_1 = mu * f1 + pressure * wp.cross(normal, f0)
    damping = wp.float64(elements.tri_materials[e, 2])
    if damping > ZERO:
        rate = _TWO * damping / dt * _membrane_change(elements, e, f0, f1, x0)
        stress_0 += rate[0] * f0 + rate[1] * f1
        stress_1 += rate[1] * f0 + rate[2] * f1
    along_0, along_1 = _membrane_weights(elements, e)
    area = wp.float64(elements.tri_areas[e])
    return wp.matrix_from_rows(
        area * along_0[0] * stress_0 + area * along_1[0] * stress_1,
        area * along_0[1] * stress_0 + area * along_1[1] * stress_1,
        area * along_0[2] * stress_0 + area * along_1[2] * stress_1,
        wp.vec3d(),
    )


@wp.func
def _store_membrane_hessian(
    elements: Elements, e: int, x: wp.array[Any], x0: wp.array[Any], dt: wp.float64, is_convex: bool, out: wp.array[Any]
):
    place = first_block(elements, ElementKind.MEMBRANE, e)
    mu, lame = _membrane_material(elements, e)
    f0, f1 = _membrane_frame(elements, e, x)
    normal, ratio = _area(f0, f1)
    pressure = lame * (ratio - _rest_stretch(mu, lame))
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
            rate = scale * _membrane_change(elements, e, f0, f1, x0)
            h00 += rate[0] * identity()
            h11 += rate[2] * identity()
            h01 += rate[1] * identity()
    area = wp.float64(elements.tri_areas[e])
    along_0, along_1 = _membrane_weights(elements, e)
    h10 = wp.transpose(h01)
    for i in range(3):
        s, t = area * along_0[i], area * along_1[i]
        by_0, by_1 = s * h00 + t * h10, s * h01 + t * h11
        for j in range(3):
            _store(out, place + 3 * i + j, along_0[j] * by_0 + along_1[j] * by_1)


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
def edge_corners(elements: Elements, e: int, x: wp.array[Any]):
    """Returns the positions of the particles of two triangles: those off their edge, then those of the edge."""
    v = elements.edge_indices
    return wp.vec3d(x[v[e, 0]]), wp.vec3d(x[v[e, 1]]), wp.vec3d(x[v[e, 2]]), wp.vec3d(x[v[e, 3]])


@wp.func
def _bending_change(elements: Elements, e: int, angle: wp.float64, x0: wp.array[Any]):
    """Returns the change of an angle since the start, and the damping of it, 0 where there is none."""
    damping = wp.float64(elements.edge_properties[e, 1])
    if damping <= ZERO:
        return ZERO, ZERO
    p, q, r, s = edge_corners(elements, e, x0)
    if _is_degenerate(p, q, r, s):
        return ZERO, ZERO
    change = angle - _dihedral_angle(p, q, r, s)
    if change > _PI:
        change = change - _TWO * _PI
    elif change < -_PI:
        change = change + _TWO * _PI
    return change, damping


@wp.func
def _bending_energy(elements: Elements, e: int, x: wp.array[Any], x0: wp.array[Any], dt: wp.float64):
    a, b, c, d = edge_corners(elements, e, x)
    if _is_degenerate(a, b, c, d):
        return ZERO
    angle = _dihedral_angle(a, b, c, d)
    bent = angle - wp.float64(elements.edge_rest_angle[e])
    change, damping = _bending_change(elements, e, angle, x0)
    energy = wp.float64(elements.edge_properties[e, 0]) * bent * bent + damping / dt * change * change
    return HALF * wp.float64(elements.edge_rest_length[e]) * energy


@wp.func
def bend(elements: Elements, e: int, x: wp.array[Any], x0: wp.array[Any], dt: wp.float64):
    """Returns the derivatives of the angle by corners, the energy, and both its derivatives by the angle, or zeros."""
    a, b, c, d = edge_corners(elements, e, x)
    if _is_degenerate(a, b, c, d):
        return mat43d(), ZERO, ZERO, ZERO
    n1, n2, edge = wp.cross(c - a, d - a), wp.cross(d - b, c - b), d - c
    length = wp.length(edge)
    along = edge / length
    m1, m2 = n1 / wp.dot(n1, n1), n2 / wp.dot(n2, n2)
    angle = _dihedral_angle(a, b, c, d)
    bent = angle - wp.float64(elements.edge_rest_angle[e])
    change, damping = _bending_change(elements, e, angle, x0)
    rest, stiffness = wp.float64(elements.edge_rest_length[e]), wp.float64(elements.edge_properties[e, 0])
    energy = HALF * rest * (stiffness * bent * bent + damping / dt * change * change)
    moment = rest * (stiffness * bent + damping / dt * change)
    turn = wp.matrix_from_rows(
        -length * m1,
        -length * m2,
        -(wp.dot(a - d, along) * m1 + wp.dot(b - d, along) * m2),
        wp.dot(a - c, along) * m1 + wp.dot(b - c, along) * m2,
    )
    return turn, energy, moment, rest * (stiffness + damping / dt)


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
    origin = wp.vec3d(x[v[e, 0]])
    sides = wp.matrix_from_cols(
        wp.vec3d(x[v[e, 1]]) - origin, wp.vec3d(x[v[e, 2]]) - origin, wp.vec3d(x[v[e, 3]]) - origin
    )
    return sides * pose


@wp.func
def _column(m: wp.mat33d, j: int) -> wp.vec3d:
    return wp.vec3d(m[0, j], m[1, j], m[2, j])


@wp.func
def _solid_material(elements: Elements, e: int):
    """Returns mu and lambda of the energy of a tetrahedron."""
    mu, lame = wp.float64(elements.tet_materials[e, 0]), wp.float64(elements.tet_materials[e, 1])
    return mu, lame + mu


@wp.func
def _tetrahedron_change(elements: Elements, e: int, pose: wp.mat33d, f: wp.mat33d, x0: wp.array[Any]) -> wp.mat33d:
    """Returns the change of the strain F^T F since the start."""
    g = _tetrahedron_frame(elements, e, pose, x0)
    return wp.transpose(f) * f - wp.transpose(g) * g


@wp.func
def _tetrahedron_energy(elements: Elements, e: int, x: wp.array[Any], x0: wp.array[Any], dt: wp.float64):
    mu, lame = _solid_material(elements, e)
    pose = _double(elements.tet_poses[e])
    f = _tetrahedron_frame(elements, e, pose, x)
    ratio = wp.determinant(f) - _rest_stretch(mu, lame)
    rest = ONE - _rest_stretch(mu, lame)
    energy = HALF * mu * (wp.ddot(f, f) - _THREE) + HALF * lame * (ratio * ratio - rest * rest)
    damping = wp.float64(elements.tet_materials[e, 2])
    if damping > ZERO:
        change = _tetrahedron_change(elements, e, pose, f, x0)
        energy += HALF * damping / dt * wp.ddot(change, change)
    return energy / (_SIX * wp.determinant(pose))


@wp.func
def _corner_weights(pose: wp.mat33d, i: int) -> wp.vec3d:
    """Returns the derivatives of the columns of the deformation gradient by a corner."""
    if i == 0:
        return -(pose[0] + pose[1] + pose[2])
    return pose[i - 1]


@wp.func
def _tetrahedron_gradient(elements: Elements, e: int, x: wp.array[Any], x0: wp.array[Any], dt: wp.float64):
    mu, lame = _solid_material(elements, e)
    pose = _double(elements.tet_poses[e])
    volume = ONE / (_SIX * wp.determinant(pose))
    f = _tetrahedron_frame(elements, e, pose, x)
    f0, f1, f2 = _column(f, 0), _column(f, 1), _column(f, 2)
    g0, g1, g2 = wp.cross(f1, f2), wp.cross(f2, f0), wp.cross(f0, f1)
    pressure = lame * (wp.dot(f0, g0) - _rest_stretch(mu, lame))
    s0, s1, s2 = mu * f0 + pressure * g0, mu * f1 + pressure * g1, mu * f2 + pressure * g2
    damping = wp.float64(elements.tet_materials[e, 2])
    if damping > ZERO:
        rate = _TWO * damping / dt * _tetrahedron_change(elements, e, pose, f, x0)
        s0 += rate[0, 0] * f0 + rate[0, 1] * f1 + rate[0, 2] * f2
        s1 += rate[1, 0] * f0 + rate[1, 1] * f1 + rate[1, 2] * f2
        s2 += rate[2, 0] * f0 + rate[2, 1] * f1 + rate[2, 2] * f2
    stress = wp.matrix_from_rows(s0, s1, s2)
    by_1, by_2, by_3 = volume * (pose[0] * stress), volume * (pose[1] * stress), volume * (pose[2] * stress)
    return wp.matrix_from_rows(volume * (_corner_weights(pose, 0) * stress), by_1, by_2, by_3)


@wp.func
def _store_tetrahedron_hessian(
    elements: Elements, e: int, x: wp.array[Any], x0: wp.array[Any], dt: wp.float64, is_convex: bool, out: wp.array[Any]
):
    place = first_block(elements, ElementKind.TETRAHEDRON, e)
    mu, lame = _solid_material(elements, e)
    pose = _double(elements.tet_poses[e])
    volume = ONE / (_SIX * wp.determinant(pose))
    f = _tetrahedron_frame(elements, e, pose, x)
    f0, f1, f2 = _column(f, 0), _column(f, 1), _column(f, 2)
    g0, g1, g2 = wp.cross(f1, f2), wp.cross(f2, f0), wp.cross(f0, f1)  # derivatives of the ratio of volumes
    pressure = lame * (wp.dot(f0, g0) - _rest_stretch(mu, lame))
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
            rate = scale * _tetrahedron_change(elements, e, pose, f, x0)
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
            _store(out, place + 4 * i + j, c[0] * by_0 + c[1] * by_1 + c[2] * by_2)


# Springs


@wp.func
def _spring_energy(elements: Elements, e: int, x: wp.array[Any], x0: wp.array[Any], dt: wp.float64):
    a, b = elements.spring_indices[e, 0], elements.spring_indices[e, 1]
    length = wp.max(wp.length(wp.vec3d(x[a]) - wp.vec3d(x[b])), _LEAST_LENGTH)
    length_0 = wp.max(wp.length(wp.vec3d(x0[a]) - wp.vec3d(x0[b])), _LEAST_LENGTH)
    stretch, change = length - wp.float64(elements.spring_rest_length[e]), length - length_0
    energy = wp.float64(elements.spring_stiffness[e]) * stretch * stretch
    return HALF * (energy + wp.float64(elements.spring_damping[e]) / dt * change * change)


@wp.func
def _tension(elements: Elements, e: int, x: wp.array[Any], x0: wp.array[Any], dt: wp.float64):
    """Returns direction, length and tension of a spring, and the derivative of the tension by the length."""
    a, b = elements.spring_indices[e, 0], elements.spring_indices[e, 1]
    between = wp.vec3d(x[a]) - wp.vec3d(x[b])
    length = wp.max(wp.length(between), _LEAST_LENGTH)
    length_0 = wp.max(wp.length(wp.vec3d(x0[a]) - wp.vec3d(x0[b])), _LEAST_LENGTH)
    stiffness, damping = wp.float64(elements.spring_stiffness[e]), wp.float64(elements.spring_damping[e]) / dt
    tension = stiffness * (length - wp.float64(elements.spring_rest_length[e])) + damping * (length - length_0)
    return between / length, length, tension, stiffness + damping


@wp.func
def _store_spring_hessian(
    elements: Elements, e: int, x: wp.array[Any], x0: wp.array[Any], dt: wp.float64, is_convex: bool, out: wp.array[Any]
):
    place = first_block(elements, ElementKind.SPRING, e)
    along, length, tension, stiffness = _tension(elements, e, x, x0, dt)
    outer = wp.outer(along, along)
    across = tension / length
    if is_convex:
        across = wp.max(across, ZERO)
    block = stiffness * outer + across * (identity() - outer)
    _store(out, place, block)
    _store(out, place + 1, -block)
    _store(out, place + 2, -block)
    _store(out, place + 3, block)


# All kinds


@wp.func
def element_energy(
    elements: Elements, i: int, kind: int, x: wp.array[Any], x0: wp.array[Any], dt: wp.float64
) -> wp.float64:
    """Returns the energy of an element of a kind above that at rest [J], damping included.

    It is 0 where a particle has no finite position, like the derivatives.
    """
    e = i - elements.first[kind]
    if not has_energy(elements, kind, e, x):
        return ZERO
    if kind == ElementKind.MEMBRANE:
        return _membrane_energy(elements, e, x, x0, dt)
    if kind == ElementKind.BENDING:
        return _bending_energy(elements, e, x, x0, dt)
    if kind == ElementKind.TETRAHEDRON:
        return _tetrahedron_energy(elements, e, x, x0, dt)
    return _spring_energy(elements, e, x, x0, dt)


@wp.func
def element_gradient(
    elements: Elements, kind: int, e: int, x: wp.array[Any], x0: wp.array[Any], dt: wp.float64
) -> mat43d:
    """Returns the derivatives of the energy of an element of a kind by its corners, one a row, 0 for none [N]."""
    if not has_energy(elements, kind, e, x):
        return mat43d()
    if kind == ElementKind.MEMBRANE:
        return _membrane_gradient(elements, e, x, x0, dt)
    if kind == ElementKind.BENDING:
        turn, _energy, moment, _curvature = bend(elements, e, x, x0, dt)
        return moment * turn
    if kind == ElementKind.TETRAHEDRON:
        return _tetrahedron_gradient(elements, e, x, x0, dt)
    along, _length, tension, _stiffness = _tension(elements, e, x, x0, dt)
    return wp.matrix_from_rows(tension * along, -tension * along, wp.vec3d(), wp.vec3d())


@wp.func
def store_hessian(
    elements: Elements,
    kind: int,
    e: int,
    x: wp.array[Any],
    x0: wp.array[Any],
    dt: wp.float64,
    is_convex: bool,
    blocks: wp.array[Any],
):
    """Writes the Hessian of an element of any kind but bending, convex or exact."""
    if not has_energy(elements, kind, e, x):
        place = first_block(elements, kind, e)
        for k in range(element_size(kind) * element_size(kind)):
            _store(blocks, place + k, wp.mat33d())
    elif kind == ElementKind.MEMBRANE:
        _store_membrane_hessian(elements, e, x, x0, dt, is_convex, blocks)
    elif kind == ElementKind.TETRAHEDRON:
        _store_tetrahedron_hessian(elements, e, x, x0, dt, is_convex, blocks)
    else:
        _store_spring_hessian(elements, e, x, x0, dt, is_convex, blocks)


@wp.func
def find_derivatives(
    i: int,
    kind: int,
    elements: Elements,
    x: wp.array[wp.vec3d],
    x0: wp.array[wp.vec3],
    dt: wp.float64,
    is_convex: bool,
    out: Derivatives,
) -> wp.float64:
    """Computes the gradient and the Hessian of an element, convex or exact, and returns its energy [J].

    That of bending is the Hessian of Gauss and Newton: without the curvature of the angle. All is read before anything
    is written, so that a compiler reads it once.
    """
    e = i - elements.first[kind]
    has, energy, gradient = has_energy(elements, kind, e, x), ZERO, mat43d()
    corner = first_corner(elements, kind, e)
    if kind == ElementKind.MEMBRANE and has:
        energy = _membrane_energy(elements, e, x, x0, dt)
        gradient = _membrane_gradient(elements, e, x, x0, dt)
        _store_membrane_hessian(elements, e, x, x0, dt, is_convex, out.block)
    elif kind == ElementKind.BENDING:
        turn, curvature = mat43d(), ZERO
        if has:
            turn, energy, moment, curvature = bend(elements, e, x, x0, dt)
            gradient = moment * turn
        root = wp.sqrt(wp.max(curvature, ZERO))
        for j in range(4):
            store_numbers(out.turn, 4 * e + j, to_single(root * turn[j]))
    elif kind == ElementKind.TETRAHEDRON and has:
        energy = _tetrahedron_energy(elements, e, x, x0, dt)
        gradient = _tetrahedron_gradient(elements, e, x, x0, dt)
        _store_tetrahedron_hessian(elements, e, x, x0, dt, is_convex, out.block)
    elif kind == ElementKind.SPRING and has:
        energy = _spring_energy(elements, e, x, x0, dt)
        along, _length, tension, _stiffness = _tension(elements, e, x, x0, dt)
        gradient = wp.matrix_from_rows(tension * along, -tension * along, wp.vec3d(), wp.vec3d())
        _store_spring_hessian(elements, e, x, x0, dt, is_convex, out.block)
    else:
        for k in range(element_size(kind) * element_size(kind)):
            _store(out.block, first_block(elements, kind, e) + k, wp.mat33d())
    for j in range(element_size(kind)):
        out.gradient[corner + j] = to_single(gradient[j])
    return energy
