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
    with the Jacobians of elements reads those of all elements around an edge, which takes five times as long. So do
    contacts with what is given. Those of two elements come and go, so their Jacobians are listed by unknown.
    """

    def __init__(self, elastic: Elastic, springs: Sequence[Elements], is_fixed: wp.array):
        """Takes elements, and springs of one unknown.

        Rows and columns of unknowns with ``is_fixed``, not 0, are those of 1.
        """
        self._elastic, self._springs, self._is_fixed = elastic, springs, is_fixed
        device, n = is_fixed.device, len(is_fixed)
        self._device = device
        self._blocks = wp.zeros(n, dtype=wp.mat33d, device=device)
        self._counts = wp.zeros(n + 1, dtype=int, device=device)
        self._is_inside = wp.zeros(0, dtype=int, device=device)
        matrix = self._matrix = Matrix()
        self._contacts = ContactRows()
        self._contacts.offsets = wp.zeros(n + 1, dtype=int, device=device)
        matrix.offsets, matrix.columns = elastic.rows.first, elastic.rows.column
        matrix.values = wp.zeros(len(matrix.columns), dtype=wp.mat33d, device=device)
        matrix.roots = wp.zeros(n, dtype=wp.mat33d, device=device)
        matrix.eigenvalues = wp.zeros(n, dtype=wp.vec3d, device=device)

    def assemble(self, inertia: wp.array, in_contact: Elements | None, *, transposed: bool) -> Matrix:
        """Returns the matrix, or its transpose, of the Jacobians that elements have, and of inertia.

        Turns of bodies and contacts are what is not symmetric. The Jacobians ``in_contact`` are scaled where they are.
        """
        matrix, n, rows = self._matrix, len(inertia), self._elastic.rows
        self._blocks.zero_()
        for each in self._springs:
            each.add_blocks(self._blocks, is_fixed=self._is_fixed)
        inputs = [transposed, inertia, self._is_fixed, rows, self._elastic.blocks, self._elastic.bends]
        self._launch(matrix_kernels.add_up_rows, n, inputs, [self._blocks, matrix.values])
        if in_contact is None:
            self._contacts.offsets.zero_()
        else:
            self._find_inside(in_contact)
            self._list_contacts(in_contact, inside=1)
            inputs, outputs = [int(transposed), self._contacts, self._is_fixed, rows], [matrix.values, self._blocks]
            self._launch(matrix_kernels.add_contacts, n, inputs, outputs)
            in_contact.add_blocks(self._blocks, is_fixed=self._is_fixed, leave_out=self._is_inside)
        scales = [matrix.roots, matrix.eigenvalues]
        self._launch(matrix_kernels.factor_blocks, n, [inertia, self._blocks], scales)
        self._launch(matrix_kernels.scale_rows, n, [matrix.offsets, matrix.columns, matrix.roots], [matrix.values])
        if in_contact is not None:
            self._list_contacts(in_contact, inside=0)
            count, size = in_contact.count, in_contact.rows.shape[1]
            inputs = [int(transposed), in_contact.rows, self._is_inside, self._is_fixed, matrix.roots]
            self._launch(matrix_kernels.scale_jacobians, (count, size, size), inputs, [in_contact.jacobian])
        matrix.contacts = self._contacts
        return matrix

    def _find_inside(self, elements):
        if len(self._is_inside) < len(elements.rows):
            self._is_inside = wp.zeros(len(elements.rows), dtype=int, device=self._device)
            self._contacts.entries = wp.zeros(elements.rows.size, dtype=int, device=self._device)
        self._contacts.unknowns, self._contacts.jacobian = elements.rows, elements.jacobian
        inputs = [elements.rows, self._is_fixed, self._elastic.rows]
        self._launch(matrix_kernels.find_inside, elements.count, inputs, [self._is_inside])

    def _list_contacts(self, elements, inside):
        """Lists contacts by unknown."""
        rows, shape = self._contacts, (elements.count, elements.rows.shape[1])
        inputs = [elements.rows, self._is_fixed, self._is_inside, inside]
        self._counts.zero_()
        self._launch(matrix_kernels.count_entries, shape, inputs, [self._counts])
        wp.utils.array_scan(self._counts, rows.offsets, inclusive=False)
        wp.copy(self._counts, rows.offsets)
        self._launch(matrix_kernels.list_entries, shape, inputs, [self._counts, rows.entries])

    def _launch(self, kernel, size, inputs, outputs):
        wp.launch(kernel, size, inputs=inputs, outputs=outputs, device=self._device)
