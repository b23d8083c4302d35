"""Elastic forces of a step, their exact Hessians, and gradients with respect to all that they depend on."""

import newton
import numpy as np
import warp as wp

from ..._private_names.of_warp import struct_fields
from ..contact.rows import make_rows
from ..elasticity.bending import bend, edge_corners
from ..elasticity.derivatives import store_hessian
from ..elasticity.elements import SIZES, ElementKind, Elements, elements_of_model, has_energy, kind_of
from ..elasticity.matrices import cross_matrix, identity, mat43d
from . import energies
from .arrays import launch_adjoint
from .element_kernels import gather

wp.set_module_options({"enable_backward": False})

_TWO = wp.constant(wp.float64(2.0))


class Elastic:
    """The elements of a model, in float64.

    Attributes:
        elements: The elements.
        count: Their number.
        corners: Unknowns of their corners, -1 for none, int32, shape [n, 1].
        rows: Sparse rows of their Hessian, one for each unknown.
        blocks: Hessians of elements but those of bending, as :attr:`.rows.Rows.source` counts them.
        bends: Those of bending, 16 for each element.
    """

    def __init__(self, model: newton.Model, unknown: np.ndarray, count: int):
        """Allocates buffers; ``unknown`` is that of each particle, of so many."""
        self.elements, vertices = elements_of_model(model)
        self.device = model.device
        self.rows = make_rows(vertices, unknown, count, model.device)
        self.count = sum(map(len, vertices))
        bends = 16 * len(vertices[ElementKind.BENDING])
        blocks = sum(v.size * size for v, size in zip(vertices, SIZES, strict=True)) - bends

        def zeros(count, dtype):
            return wp.zeros(count, dtype=dtype, device=model.device)

        corners = np.concatenate([v.ravel() for v in vertices])
        corners = np.where(corners >= 0, unknown[np.maximum(corners, 0)], -1) if len(unknown) else corners
        self.corners = wp.array(corners.astype(np.int32).reshape(-1, 1), dtype=int, device=model.device)
        self._forces = zeros((len(corners), 1, 1), wp.vec3d)
        self.blocks, self.bends = zeros(blocks, wp.mat33d), zeros(bends, wp.mat33d)

    def differentiate(self, dt: float, x1: wp.array, x0: wp.array) -> None:
        """Computes the Hessians of elements at these positions."""
        inputs, outputs = [self.elements, x1, x0, wp.float64(dt)], [self.blocks, self.bends]
        wp.launch(_find_hessians, self.count, inputs=inputs, outputs=outputs, device=self.device)

    def add_gradients(self, dt: float, x1: wp.array, x0: wp.array, multipliers: wp.array) -> None:
        """Adds to the gradients of positions and parameters, given those with respect to forces on unknowns, vec3d."""
        elements = Elements()
        for name in struct_fields(Elements):  # with the gradients that arrays have now
            setattr(elements, name, getattr(self.elements, name))
        inputs, of_forces = [self.corners, multipliers], self._forces
        wp.launch(gather, self.corners.shape, inputs=inputs, outputs=[of_forces], device=self.device)
        inputs = [elements, wp.float64(dt), x1, x0]
        launch_adjoint(energies.elastic_forces, self.count, inputs, [of_forces.flatten()], self.device)


@wp.func
def _store_pair(blocks: wp.array[wp.mat33d], place: int, i: int, j: int, block: wp.mat33d):
    """Writes a block of an element, and its transpose."""
    blocks[place + 4 * i + j] = block
    blocks[place + 4 * j + i] = wp.transpose(block)


@wp.func
def _store_bending_hessian(
    elements: Elements,
    e: int,
    x1: wp.array[wp.vec3d],
    x0: wp.array[wp.vec3d],
    dt: wp.float64,
    blocks: wp.array[wp.mat33d],
):
    """Writes the Hessian of a pair of triangles: that of Gauss and Newton, and moment times that of the angle."""
    turn, moment, curvature = mat43d(), wp.float64(0.0), wp.float64(0.0)
    aa, bb, cc, ac, bc = wp.mat33d(), wp.mat33d(), wp.mat33d(), wp.mat33d(), wp.mat33d()
    if has_energy(elements, ElementKind.BENDING, e, x1):
        turn, _energy, moment, curvature = bend(elements, e, x1, x0, dt)
    if curvature > wp.float64(0.0):
        a, b, c, d = edge_corners(elements, e, x1)
        n1, n2, edge = wp.cross(c - a, d - a), wp.cross(d - b, c - b), d - c
        square_1, square_2, length = wp.dot(n1, n1), wp.dot(n2, n2), wp.length(edge)
        m1, m2, along = n1 / square_1, n2 / square_2, edge / length
        # derivatives of m1 by n1, and of the direction of the edge
        k1 = (identity() - _TWO * wp.outer(n1, m1)) / square_1
        k2 = (identity() - _TWO * wp.outer(n2, m2)) / square_2
        across = (identity() - wp.outer(along, along)) / length
        by_c1, by_c2 = k1 * cross_matrix(d - a), k2 * cross_matrix(d - b)
        aa = -length * (k1 * cross_matrix(edge))
        bb = length * (k2 * cross_matrix(edge))
        ac = wp.outer(m1, along) + length * by_c1
        bc = wp.outer(m2, along) - length * by_c2
        cc = wp.outer(m1, across * (a - d)) + wp.dot(a - d, along) * by_c1
        cc += wp.outer(m2, across * (b - d)) - wp.dot(b - d, along) * by_c2
    ad, bd, cd = -(aa + ac), -(bb + bc), -(wp.transpose(ac) + wp.transpose(bc) + cc)  # a shift of all changes nothing
    place = 16 * e
    _store_pair(blocks, place, 0, 0, moment * aa)
    _store_pair(blocks, place, 0, 1, wp.mat33d())
    _store_pair(blocks, place, 0, 2, moment * ac)
    _store_pair(blocks, place, 0, 3, moment * ad)
    _store_pair(blocks, place, 1, 1, moment * bb)
    _store_pair(blocks, place, 1, 2, moment * bc)
    _store_pair(blocks, place, 1, 3, moment * bd)
    _store_pair(blocks, place, 2, 2, moment * cc)
    _store_pair(blocks, place, 2, 3, moment * cd)
    _store_pair(blocks, place, 3, 3, -moment * (ad + bd + cd))
    for i in range(4):
        for j in range(4):
            k = place + 4 * i + j
            blocks[k] = blocks[k] + curvature * wp.outer(turn[i], turn[j])


@wp.kernel
def _find_hessians(
    # in
    elements: Elements,
    x1: wp.array[wp.vec3d],
    x0: wp.array[wp.vec3d],
    dt: wp.float64,
    # out
    blocks: wp.array[wp.mat33d],
    bends: wp.array[wp.mat33d],
):
    """Computes the Hessian of the energy of each element."""
    i = wp.tid()
    kind = kind_of(elements, i)
    e = i - elements.first[kind]
    if kind == ElementKind.BENDING:
        _store_bending_hessian(elements, e, x1, x0, dt, bends)
    else:
        store_hessian(elements, kind, e, x1, x0, dt, False, blocks)
