"""Linear solves with the matrix of a step, for all worlds at once; in a CUDA graph the host reads nothing."""

import math

import numpy as np
import warp as wp

from . import linear_kernels
from .linear_kernels import BLOCK, State, Vector
from .matrix_kernels import Matrix

_MAX_BLOCKS = 512
"""Most blocks of threads for a world: each adds up the sums of all."""

_FEW_UNKNOWNS = 16384
"""Most unknowns of which each gets four threads on a GPU, instead of two."""

_BATCH = 16
"""Launches between two looks at whether all worlds are solved; an even number."""


class LinearSolver:
    """Solves A x = b, preconditioned by the blocks of the diagonal.

    Compression can make A indefinite, and friction makes it unsymmetric. Where it is symmetric, conjugate residuals
    solve it, with one product an iteration; BiCGSTAB, with two, solves the rest, and what those did not solve. Worlds
    are independent systems, each of which stops when its residual is small enough.

    Attributes:
        failed: 1 for worlds whose last system was not solved, int32, shape [world_count].
        indefinite: 1 for worlds whose last matrix was found not to be positive definite, likewise.
    """

    def __init__(self, of_worlds: wp.array, world: wp.array, *, tolerance: float, max_iterations: int):
        """Allocates buffers.

        Args:
            of_worlds: First unknown of each world, and the end of the last, int32.
            world: World of each unknown, int32.
            tolerance: Largest norm of the residual of a solution, relative to that of the right-hand side.
            max_iterations: Number of iterations after which a solve ends.
        """
        self._of_worlds, self._world = of_worlds, world
        self._tolerance, self._max_iterations = tolerance, max_iterations
        device = self._device = world.device
        unknowns = np.diff(of_worlds.numpy())
        counts, worlds = np.ones_like(unknowns), len(unknowns)
        self._parts = 1
        if device.is_cuda:
            self._parts = 4 if len(world) <= _FEW_UNKNOWNS else 2
            counts = np.clip(-(-unknowns * self._parts // BLOCK), 1, _MAX_BLOCKS)

        def array(values):
            return wp.array(values.astype(np.int32), dtype=int, device=device)

        self._block_count = int(counts.sum())
        self._world_of_block = array(np.repeat(np.arange(len(counts)), counts))
        self._blocks = array(np.append(0, np.cumsum(counts)))
        self._partials = wp.zeros((2, self._block_count), dtype=wp.vec4d, device=device)
        self._states = wp.zeros((2, worlds), dtype=State, device=device)
        self._unfinished = wp.zeros(1, dtype=int, device=device)
        self._solution = wp.zeros(len(world), dtype=wp.vec3d, device=device)
        self._vectors = wp.zeros((len(Vector), 3 * len(self._solution)), dtype=wp.float64, device=device)
        self.failed, self.indefinite = (wp.zeros(worlds, dtype=int, device=device) for _ in range(2))

    def solve(self, matrix: Matrix, b: wp.array, failure: float = math.nan) -> wp.array:
        """Returns the solution x of A x = b; the next call overwrites it.

        Args:
            matrix: A.
            b: The right-hand side, vec3d, shape [unknown_count].
            failure: The solution of worlds that were not solved.
        """
        self._launch(linear_kernels.begin, len(self.failed), [], [self._states])
        self._vectors[Vector.X].zero_()
        limits = [wp.float64(self._tolerance), self._max_iterations]
        tables = [self._of_worlds, self._world_of_block, self._blocks]
        buffers = [self._states, self._partials, self._vectors]
        launches = [
            wp.launch(
                linear_kernels.advance,
                self._block_count * (BLOCK if self._device.is_cuda else 1),
                inputs=[matrix, b, *tables, *limits, turn, self._parts, *buffers],
                device=self._device,
                block_dim=BLOCK,
                record_cmd=True,
            )
            for turn in (0, 1)
        ]
        self._unfinished.fill_(1)
        wp.capture_while(self._unfinished, self._advance, launches=launches)
        inputs = [self._world, self._states, matrix.roots, self._vectors, wp.float64(failure)]
        self._launch(linear_kernels.finish, len(b), inputs, [self._solution, self.failed, self.indefinite])
        return self._solution

    def _advance(self, launches):
        for _ in range(_BATCH // 2):
            for launch in launches:
                launch.launch()
        self._unfinished.zero_()
        self._launch(linear_kernels.find_unfinished, len(self.failed), [self._states], [self._unfinished])

    def _launch(self, kernel, size, inputs, outputs):
        wp.launch(kernel, size, inputs=inputs, outputs=outputs, device=self._device)
