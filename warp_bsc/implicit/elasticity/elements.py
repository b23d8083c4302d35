"""The elements of a model, numbered by kind: triangles, bending edges, tetrahedra, and springs."""

from enum import IntEnum
from typing import Any

import newton
import numpy as np
import warp as wp

wp.set_module_options({"enable_backward": False})


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
    """The elements of a model. They, their corners and their blocks are numbered, one kind behind the other."""

    first: wp.array[int]  # first element of each kind, then first corner, then first block
    tri_indices: wp.array2d[int]  # particles of triangles, and so on as in ``newton.Model``
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
    for name in ("tri_poses", "tri_areas", "tri_materials"):
        setattr(elements, name, getattr(model, name))
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
