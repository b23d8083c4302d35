"""The matrix of a step: sparse, of 3 x 3 blocks, whose places do not change but for contacts."""

from collections.abc import Sequence

import warp as wp

from . import matrix_kernels
from .elastic import Elastic
from .elements import Elements
from .matrix_kernels import ContactRows, Matrix


class StepMatrix:
    """Minus the derivative of the forces of a step, scaled so that the blocks of the diagonal are near the identity.

    Inertia and elastic forces have a block for every two particles of an element: a product reads each once, where one
    with the Jacobians of elements reads those of all elements around an edge, which takes five times as long. Contacts
    come and go, so their Jacobians are listed by unknown.
    """

    def __init__(self, elastic: Elastic, springs: Sequence[Elements], is_fixed: wp.array, world: wp.array, worlds: int):
        """Takes elements, springs of one unknown, and the world of each unknown, of so many worlds.

        Rows and columns of unknowns with ``is_fixed``, not 0, are those of 1.
        """
        self._elastic, self._springs, self._is_fixed, self._world = elastic, springs, is_fixed, world
        device, n = is_fixed.device, len(is_fixed)
        self._device = device
        self._blocks = wp.zeros(n, dtype=wp.mat33d, device=device)
        self._counts = wp.zeros(n + 1, dtype=int, device=device)
        matrix = self._matrix = Matrix()
        self._contacts = ContactRows()
        self._contacts.offsets = wp.zeros(n + 1, dtype=int, device=device)
        matrix.offsets, matrix.columns = elastic.rows.first, elastic.rows.column
        matrix.values = wp.zeros(len(matrix.columns), dtype=wp.mat33d, device=device)
        matrix.roots = wp.zeros(n, dtype=wp.mat33d, device=device)
        matrix.eigenvalues = wp.zeros(3 * n, dtype=wp.float64, device=device)
        matrix.unsymmetric = wp.zeros(worlds, dtype=int, device=device)

    def assemble(self, inertia: wp.array, in_contact: Sequence[Elements], *, transposed: bool) -> Matrix:
        """Returns the matrix, or its transpose, of the Jacobians that elements have, and of inertia.

        Elastic forces have a symmetric one. The Jacobians of the elements ``in_contact`` are scaled where they are.
        """
        matrix, n, elastic = self._matrix, len(inertia), self._elastic
        self._blocks.zero_()
        for each in self._springs:
            each.add_blocks(self._is_fixed, self._blocks)
        inputs = [inertia, self._is_fixed, elastic.rows, elastic.blocks, elastic.bends]
        self._launch(matrix_kernels.add_up_rows, n, inputs, [self._blocks, matrix.values])
        for each in in_contact:
            each.add_blocks(self._is_fixed, self._blocks)
        scales = [matrix.roots, matrix.eigenvalues]
        self._launch(matrix_kernels.factor_blocks, n, [inertia, self._blocks], scales)
        self._launch(matrix_kernels.scale_rows, n, [matrix.offsets, matrix.columns, matrix.roots], [matrix.values])
        matrix.unsymmetric.zero_()
        self._contacts.offsets.zero_()
        for each in in_contact:
            self._load_contacts(each, int(transposed))
        matrix.contacts = self._contacts
        return matrix

    def _load_contacts(self, elements, transposed):
        """Scales and lists the Jacobians of contacts."""
        matrix, is_fixed, unknowns = self._matrix, self._is_fixed, elements.rows
        shape = elements.count, unknowns.shape[1]
        n = shape[0] * shape[1]
        inputs = [transposed, unknowns, is_fixed, matrix.roots]
        self._launch(matrix_kernels.scale_jacobians, (*shape, shape[1]), inputs, [elements.jacobian])
        rows = self._contacts
        if rows.entries is None or len(rows.entries) < n:
            rows.entries = wp.zeros(unknowns.size, dtype=int, device=self._device)
        self._counts.zero_()
        inputs, outputs = [unknowns, is_fixed, self._world], [self._counts, matrix.unsymmetric]
        self._launch(matrix_kernels.count_entries, shape, inputs, outputs)
        wp.utils.array_scan(self._counts, rows.offsets, inclusive=False)
        wp.copy(self._counts, rows.offsets)
        self._launch(matrix_kernels.list_entries, shape, [unknowns, is_fixed], [self._counts, rows.entries])
        rows.unknowns, rows.jacobian = unknowns, elements.jacobian

    def _launch(self, kernel, size, inputs, outputs):
        wp.launch(kernel, size, inputs=inputs, outputs=outputs, device=self._device)
