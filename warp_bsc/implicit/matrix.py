"""The matrix of a step: sparse, of 3 x 3 blocks, whose places do not change but for contacts."""

from collections.abc import Sequence

import numpy as np
import warp as wp

from . import matrix_kernels
from .elements import Elements
from .matrix_kernels import ContactRows, Matrix
from .worlds import Worlds

_CONTACTS = "contacts", "vertex_triangle", "edge_edge"
"""Fields of :class:`.matrix_kernels.Matrix`."""


class StepMatrix:
    """Minus the derivative of the forces of a step, scaled so that the blocks of the diagonal are near the identity.

    Inertia and elastic forces have a block for every two particles of an element: a product reads each once, where one
    with the Jacobians of elements reads those of all elements around an edge, which takes five times as long. Contacts
    come and go, so their Jacobians are listed by particle.
    """

    def __init__(self, elements: Sequence[Elements], is_fixed: wp.array, worlds: Worlds):
        """Finds the blocks of elements; rows and columns of particles with ``is_fixed`` not 0 are the identity's."""
        self._elements, self._is_fixed, self._worlds, n = elements, is_fixed, worlds, len(is_fixed)
        device = self._device = is_fixed.device
        pairs = [np.arange(n, dtype=np.int64)[:, None] * (n + 1)]  # the diagonal, row n + column
        for each in elements:
            v = each.vertices.numpy().astype(np.int64)
            exists = (v[:, :, None] >= 0) & (v[:, None, :] >= 0)
            pairs.append(np.where(exists, v[:, :, None] * n + v[:, None, :], 0))
        blocks, places = np.unique(np.concatenate([pair.ravel() for pair in pairs]), return_inverse=True)
        splits = np.split(places.astype(np.int32), np.cumsum([pair.size for pair in pairs])[:-1])
        self._diagonal, *self._places = (
            wp.array(split.reshape(pair.shape), dtype=int, device=device)
            for split, pair in zip(splits, pairs, strict=True)
        )
        offsets = np.searchsorted(blocks, np.arange(n + 1, dtype=np.int64) * n).astype(np.int32)
        self._rows = wp.array((blocks // n).astype(np.int32), dtype=int, device=device)
        self._inertia = wp.zeros(n, dtype=wp.float64, device=device)
        self._blocks = wp.zeros(n, dtype=wp.mat33d, device=device)
        self._lists: dict[wp.Kernel, _Lists] = {}
        matrix = self._matrix = Matrix()
        matrix.offsets = wp.array(offsets, dtype=int, device=device)
        matrix.columns = wp.array((blocks % n).astype(np.int32), dtype=int, device=device)
        matrix.values = wp.zeros(len(blocks), dtype=wp.mat33d, device=device)
        matrix.roots = wp.zeros(n, dtype=wp.mat33d, device=device)
        matrix.eigenvalues = wp.zeros(3 * n, dtype=wp.float64, device=device)
        matrix.unsymmetric = wp.zeros(worlds.count, dtype=int, device=device)

    def assemble(self, dt: float, mass: wp.array, in_contact: Sequence[Elements], *, transposed: bool) -> Matrix:
        """Returns the matrix, or its transpose, of the Jacobians that elements have, and of masses.

        Elastic forces have a symmetric one. The Jacobians of the elements ``in_contact`` are scaled where they are.
        """
        matrix, n = self._matrix, len(mass)
        matrix.values.zero_()
        inputs = [wp.float64(dt), mass, self._is_fixed, self._diagonal]
        self._launch(matrix_kernels.set_inertia, n, inputs, [self._inertia, matrix.values])
        for each, places in zip(self._elements, self._places, strict=True):
            inputs = [each.vertices, self._is_fixed, each.jacobian, places]
            self._launch(matrix_kernels.add_element_blocks, places.shape, inputs, [matrix.values])
        self._launch(matrix_kernels.copy_diagonal, n, [self._diagonal, matrix.values], [self._blocks])
        for each in in_contact:
            each.add_blocks(self._is_fixed, self._blocks)
        scales = [matrix.roots, matrix.eigenvalues]
        self._launch(matrix_kernels.factor_blocks, n, [self._inertia, self._blocks], scales)
        inputs = [self._rows, matrix.columns, matrix.roots]
        self._launch(matrix_kernels.scale_blocks, len(self._rows), inputs, [matrix.values])
        self._load_contacts(in_contact, int(transposed))
        return matrix

    def _load_contacts(self, in_contact, transposed):
        """Scales and lists the Jacobians of contacts."""
        matrix, n = self._matrix, len(self._is_fixed)
        matrix.unsymmetric.zero_()
        for name in _CONTACTS:
            setattr(matrix, name, ContactRows())
        for name, elements in zip(_CONTACTS, in_contact, strict=False):
            size = elements.vertices.shape[1]
            inputs = [transposed, elements.vertices, self._is_fixed, matrix.roots]
            shape = elements.count, size, size
            self._launch(matrix_kernels.scale_jacobians, shape, inputs, [elements.jacobian])
            lists = self._lists.get(elements.kernel)
            if lists is None or lists.capacity < elements.count * size:
                lists = self._lists[elements.kernel] = _Lists(n, elements.vertices.size, self._device)
            setattr(matrix, name, lists.load(elements, self._is_fixed, self._worlds.of_particles, matrix.unsymmetric))

    def _launch(self, kernel, size, inputs, outputs):
        wp.launch(kernel, size, inputs=inputs, outputs=outputs, device=self._device)


class _Lists:
    """Elements of one kind by particle."""

    def __init__(self, particle_count, capacity, device):
        self.capacity = capacity
        self._counts, self._offsets, self._ends = (
            wp.zeros(particle_count + 1, dtype=int, device=device) for _ in range(3)
        )
        self._entries = wp.zeros(capacity, dtype=int, device=device)

    def load(self, elements, is_fixed, world, unsymmetric):
        """Lists elements; marks the worlds that have some."""
        shape, vertices, device = (elements.count, elements.vertices.shape[1]), elements.vertices, elements.device
        self._counts.zero_()
        inputs, outputs = [vertices, is_fixed, world], [self._counts, unsymmetric]
        wp.launch(matrix_kernels.count_entries, shape, inputs=inputs, outputs=outputs, device=device)
        wp.utils.array_scan(self._counts, self._offsets, inclusive=False)
        wp.copy(self._ends, self._offsets)
        outputs = [self._ends, self._entries]
        wp.launch(matrix_kernels.list_entries, shape, inputs=[vertices, is_fixed], outputs=outputs, device=device)
        rows = ContactRows()
        rows.offsets, rows.entries = self._offsets, self._entries
        rows.vertices, rows.jacobian = vertices, elements.jacobian
        return rows
