"""Energies and derivatives of elements of all kinds, in float64, from positions and into blocks of either precision."""

from typing import Any

import numpy as np
import warp as wp

from ...response.state.vectors import ZERO, to_single
from ..vector_access import mat34, store_numbers
from . import bending, membranes, springs, tetrahedra
from .elements import ElementKind, Elements, element_size, first_block, first_corner, has_energy
from .matrices import mat43d, store

wp.set_module_options({"enable_backward": False})


@wp.struct
class Derivatives:
    """What :func:`find_derivatives` computes."""

    gradient: wp.array[wp.vec3]  # of each corner of each element [N], shape [corners]
    # hessians of each two corners of each element but those of bending, row by row [N/m], shape [blocks], each row with
    # a fourth number without meaning, so that a GPU reads and writes it at once
    block: wp.array[mat34]
    # of each corner of each element of bending [sqrt(N/m)], shape [4 count]: the outer products of those of two corners
    # are blocks of its Hessian, the fourth number is without meaning
    turn: wp.array[wp.vec4]


def make_derivatives(vertices: list[np.ndarray], device: wp.Device) -> Derivatives:
    """Returns buffers for derivatives of elements with the particles of :func:`.elements.elements_of_model`."""
    derivatives, bends = Derivatives(), len(vertices[ElementKind.BENDING])
    blocks = sum(v.size * v.shape[1] for kind, v in enumerate(vertices) if kind != ElementKind.BENDING)
    derivatives.gradient = wp.zeros(sum(v.size for v in vertices), dtype=wp.vec3, device=device)
    derivatives.block = wp.zeros(blocks, dtype=mat34, device=device)
    derivatives.turn = wp.zeros(4 * bends, dtype=wp.vec4, device=device)
    return derivatives


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
        return membranes.energy(elements, e, x, x0, dt)
    if kind == ElementKind.BENDING:
        return bending.energy(elements, e, x, x0, dt)
    if kind == ElementKind.TETRAHEDRON:
        return tetrahedra.energy(elements, e, x, x0, dt)
    return springs.energy(elements, e, x, x0, dt)


@wp.func
def element_gradient(
    elements: Elements, kind: int, e: int, x: wp.array[Any], x0: wp.array[Any], dt: wp.float64
) -> mat43d:
    """Returns the derivatives of the energy of an element of a kind by its corners, one a row, 0 for none [N]."""
    if not has_energy(elements, kind, e, x):
        return mat43d()
    if kind == ElementKind.MEMBRANE:
        return membranes.gradient(elements, e, x, x0, dt)
    if kind == ElementKind.BENDING:
        turn, _energy, moment, _curvature = bending.bend(elements, e, x, x0, dt)
        return moment * turn
    if kind == ElementKind.TETRAHEDRON:
        return tetrahedra.gradient(elements, e, x, x0, dt)
    along, _length, tension, _stiffness = springs.tension_of(elements, e, x, x0, dt)
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
            store(blocks, place + k, wp.mat33d())
    elif kind == ElementKind.MEMBRANE:
        membranes.store_hessian(elements, e, x, x0, dt, is_convex, blocks)
    elif kind == ElementKind.TETRAHEDRON:
        tetrahedra.store_hessian(elements, e, x, x0, dt, is_convex, blocks)
    else:
        springs.store_hessian(elements, e, x, x0, dt, is_convex, blocks)


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
        energy = membranes.energy(elements, e, x, x0, dt)
        gradient = membranes.gradient(elements, e, x, x0, dt)
        membranes.store_hessian(elements, e, x, x0, dt, is_convex, out.block)
    elif kind == ElementKind.BENDING:
        turn, curvature = mat43d(), ZERO
        if has:
            turn, energy, moment, curvature = bending.bend(elements, e, x, x0, dt)
            gradient = moment * turn
        root = wp.sqrt(wp.max(curvature, ZERO))
        for j in range(4):
            store_numbers(out.turn, 4 * e + j, to_single(root * turn[j]))
    elif kind == ElementKind.TETRAHEDRON and has:
        energy = tetrahedra.energy(elements, e, x, x0, dt)
        gradient = tetrahedra.gradient(elements, e, x, x0, dt)
        tetrahedra.store_hessian(elements, e, x, x0, dt, is_convex, out.block)
    elif kind == ElementKind.SPRING and has:
        energy = springs.energy(elements, e, x, x0, dt)
        along, _length, tension, _stiffness = springs.tension_of(elements, e, x, x0, dt)
        gradient = wp.matrix_from_rows(tension * along, -tension * along, wp.vec3d(), wp.vec3d())
        springs.store_hessian(elements, e, x, x0, dt, is_convex, out.block)
    else:
        for k in range(element_size(kind) * element_size(kind)):
            store(out.block, first_block(elements, kind, e) + k, wp.mat33d())
    for j in range(element_size(kind)):
        out.gradient[corner + j] = to_single(gradient[j])
    return energy
