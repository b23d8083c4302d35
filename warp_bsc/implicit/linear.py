"""Linear solves with the matrix of a step, for all worlds at once; in a CUDA graph the host reads nothing."""

import math

import numpy as np
import warp as wp

from . import linear_kernels
from .equations import Equations
from .linear_kernels import BLOCK, State, Vector
from .worlds import Worlds

_MAX_BLOCKS = 512
"""Most blocks of threads for a world: each adds up the sums of all."""

_FEW_PARTICLES = 16384
"""Most particles of which each gets four threads on a GPU, instead of two."""

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

    def __init__(self, equations: Equations, worlds: Worlds, *, tolerance: float, max_iterations: int):
        """Allocates buffers.

        Args:
            equations: The matrix.
            worlds: The worlds of the particles.
            tolerance: Largest norm of the residual of a solution, relative to that of the right-hand side.
            max_iterations: Number of iterations after which a solve ends.
        """
        self._equations, self._worlds = equations, worlds
        self._tolerance, self._max_iterations = tolerance, max_iterations
        device = equations.device
        particles = np.diff(worlds.offsets.numpy())
        counts = np.ones_like(particles)
        self._parts = 1
        if device.is_cuda:
            self._parts = 4 if particles.sum() <= _FEW_PARTICLES else 2
            counts = np.minimum(-(-particles * self._parts // BLOCK), _MAX_BLOCKS)

        def array(values):
            return wp.array(values.astype(np.int32), dtype=int, device=device)

        self._block_count = int(counts.sum())
        self._world_of_block = array(np.repeat(np.arange(len(counts)), counts))
        self._blocks = array(np.append(0, np.cumsum(counts)))
        self._partials = wp.zeros((2, self._block_count), dtype=wp.vec4d, device=device)
        self._states = wp.zeros((2, worlds.count), dtype=State, device=device)
        self._unfinished = wp.zeros(1, dtype=int, device=device)
        self._solution = equations.zeros()
        self._vectors = wp.zeros((len(Vector), 3 * len(self._solution)), dtype=wp.float64, device=device)
        self.failed, self.indefinite = (wp.zeros(worlds.count, dtype=int, device=device) for _ in range(2))

    def solve(self, b: wp.array, failure: float = math.nan) -> wp.array:
        """Returns the solution x of A x = b, with the matrix that the equations have; the next call overwrites it.

        Args:
            b: The right-hand side, vec3d, shape [particle_count].
            failure: The solution of worlds that were not solved.
        """
        worlds, matrix = self._worlds, self._equations.matrix
        assert matrix is not None
        self._launch(linear_kernels.begin, worlds.count, [], [self._states])
        self._vectors[Vector.X].zero_()
        limits = [wp.float64(self._tolerance), self._max_iterations]
        tables = [worlds.offsets, self._world_of_block, self._blocks]
        buffers = [self._states, self._partials, self._vectors]
        launches = [
            wp.launch(
                linear_kernels.advance,
                self._block_count * (BLOCK if self._equations.device.is_cuda else 1),
                inputs=[matrix, b, *tables, *limits, turn, self._parts, *buffers],
                device=self._equations.device,
                block_dim=BLOCK,
                record_cmd=True,
            )
            for turn in (0, 1)
        ]
        self._unfinished.fill_(1)
        wp.capture_while(self._unfinished, self._advance, launches=launches)
        inputs = [worlds.of_particles, self._states, matrix.roots, self._vectors, wp.float64(failure)]
        self._launch(linear_kernels.finish, len(b), inputs, [self._solution, self.failed, self.indefinite])
        return self._solution

    def _advance(self, launches):
        for _ in range(_BATCH // 2):
            for launch in launches:
                launch.launch()
        self._unfinished.zero_()
        self._launch(linear_kernels.find_unfinished, self._worlds.count, [self._states], [self._unfinished])

    def _launch(self, kernel, size, inputs, outputs):
        wp.launch(kernel, size, inputs=inputs, outputs=outputs, device=self._equations.device)
