"""The matrix of inertia and elastic forces: sparse, symmetric, of 3 x 3 blocks whose places do not change."""

from collections.abc import Sequence

import numpy as np
import warp as wp

from . import matrix_kernels
from .elements import Elements


class ElasticMatrix:
    """Minus the derivative of inertia and elastic forces, a block for every two particles of an element.

    A product reads each block once, where one with the Jacobians of elements reads those of all elements around an
    edge: it takes a fifth of the time.

    Attributes:
        inertia: m / dt^2 of particles, 1 for fixed ones, float64, shape [particle_count].
    """

    def __init__(self, elements: Sequence[Elements], is_fixed: wp.array):
        """Finds the blocks of elements; ``is_fixed`` is 1 for particles whose rows and columns are the identity's."""
        self._elements, self._is_fixed, n = elements, is_fixed, len(is_fixed)
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
        self._offsets = wp.array(offsets, dtype=int, device=device)
        self._columns = wp.array((blocks % n).astype(np.int32), dtype=int, device=device)
        self._values = wp.zeros(len(blocks), dtype=wp.mat33d, device=device)
        self.inertia = wp.zeros(n, dtype=wp.float64, device=device)

    def assemble(self, dt: float, mass: wp.array, diagonal: wp.array) -> None:
        """Computes the blocks from the Jacobians of elements and from masses; writes those of the diagonal, mat33d."""
        self._values.zero_()
        inputs = [wp.float64(dt), mass, self._is_fixed, self._diagonal]
        self._launch(matrix_kernels.set_inertia, len(mass), inputs, [self.inertia, self._values])
        for each, places in zip(self._elements, self._places, strict=True):
            inputs = [each.vertices, self._is_fixed, each.jacobian, places]
            self._launch(matrix_kernels.add_element_blocks, places.shape, inputs, [self._values])
        self._launch(matrix_kernels.copy_diagonal, len(mass), [self._diagonal, self._values], [diagonal])

    def product(self, x: wp.array, y: wp.array, z: wp.array, alpha: float, beta: float) -> None:
        """Sets z to alpha A x + beta y; z may be y, but not x."""
        inputs = [wp.float64(alpha), wp.float64(beta), self._offsets, self._columns, self._values, x, y]
        self._launch(matrix_kernels.sparse_product, len(x), inputs, [z])

    def _launch(self, kernel, size, inputs, outputs):
        wp.launch(kernel, size, inputs=inputs, outputs=outputs, device=self._device)
