"""The matrix of a step: sparse, of 3 x 3 blocks, whose places do not change but for contacts."""

from collections.abc import Sequence

import warp as wp

from . import matrix_kernels
from .elastic import Elastic
from .elements import Elements
from .matrix_kernels import ContactRows, Matrix
from .worlds import Worlds

_CONTACTS = "contacts", "pairs"
"""Fields of :class:`.matrix_kernels.Matrix`."""


class StepMatrix:
    """Minus the derivative of the forces of a step, scaled so that the blocks of the diagonal are near the identity.

    Inertia and elastic forces have a block for every two particles of an element: a product reads each once, where one
    with the Jacobians of elements reads those of all elements around an edge, which takes five times as long. Contacts
    come and go, so their Jacobians are listed by particle.
    """

    def __init__(self, elastic: Elastic, springs: Sequence[Elements], is_fixed: wp.array, worlds: Worlds):
        """Takes elements and springs of one particle; rows and columns of particles with ``is_fixed`` are those of 1.

        A particle counts as fixed where that is not 0.
        """
        self._elastic, self._springs, self._is_fixed, self._worlds = elastic, springs, is_fixed, worlds
        device, n = is_fixed.device, len(is_fixed)
        self._device, self._inertia = device, wp.zeros(n, dtype=wp.float64, device=device)
        self._blocks = wp.zeros(n, dtype=wp.mat33d, device=device)
        self._lists: dict[wp.Kernel, _Lists] = {}
        matrix = self._matrix = Matrix()
        matrix.offsets, matrix.columns = elastic.rows.first, elastic.rows.column
        matrix.values = wp.zeros(len(matrix.columns), dtype=wp.mat33d, device=device)
        matrix.roots = wp.zeros(n, dtype=wp.mat33d, device=device)
        matrix.eigenvalues = wp.zeros(3 * n, dtype=wp.float64, device=device)
        matrix.unsymmetric = wp.zeros(worlds.count, dtype=int, device=device)

    def assemble(self, dt: float, mass: wp.array, in_contact: Sequence[Elements], *, transposed: bool) -> Matrix:
        """Returns the matrix, or its transpose, of the Jacobians that elements have, and of masses.

        Elastic forces have a symmetric one. The Jacobians of the elements ``in_contact`` are scaled where they are.
        """
        matrix, n, elastic = self._matrix, len(mass), self._elastic
        self._blocks.zero_()
        for each in self._springs:
            each.add_blocks(self._is_fixed, self._blocks)
        inputs = [wp.float64(dt), mass, self._is_fixed, elastic.rows, elastic.blocks, elastic.bends]
        self._launch(matrix_kernels.add_up_rows, n, inputs, [self._blocks, self._inertia, matrix.values])
        for each in in_contact:
            each.add_blocks(self._is_fixed, self._blocks)
        scales = [matrix.roots, matrix.eigenvalues]
        self._launch(matrix_kernels.factor_blocks, n, [self._inertia, self._blocks], scales)
        self._launch(matrix_kernels.scale_rows, n, [matrix.offsets, matrix.columns, matrix.roots], [matrix.values])
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
