"""Linear solves with the matrix of a step, for all worlds at once, without synchronizing with the device."""

import math

import warp as wp

from ..response.solve.cluster import blocks_of_cluster
from . import linear_kernels
from .equations import Equations
from .linear_kernels import BLOCK, PARTS
from .worlds import Worlds


class LinearSolver:
    """Solves A x = b, preconditioned by the blocks of the diagonal, in one launch.

    Compression can make A indefinite, and friction makes it unsymmetric. Where it is symmetric, conjugate residuals
    solve it with half of the products that BiCGSTAB takes; BiCGSTAB solves the rest, and what those did not solve.
    Worlds are independent systems, each of which stops when its residual is small enough.

    Attributes:
        failed: 1 for worlds whose last system was not solved, int32, shape [world_count].
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
        blocks = blocks_of_cluster(device)
        self._threads, self._parts = (1, 1) if device.is_cpu else (blocks * BLOCK, PARTS)
        self._partials = wp.zeros((worlds.count, 2, blocks), dtype=wp.vec4d, device=device)
        self._vectors, self._solution = linear_kernels.Vectors(), equations.zeros()
        for name in ("x", "residual", "shadow", "direction", "along", "beyond", "last"):
            setattr(self._vectors, name, equations.zeros())
        self._vectors.products = wp.zeros((2, len(self._solution)), dtype=wp.vec3d, device=device)
        self.failed = wp.zeros(worlds.count, dtype=int, device=device)

    def solve(self, b: wp.array, failure: float = math.nan) -> wp.array:
        """Returns the solution x of A x = b, with the matrix that the equations have; the next call overwrites it.

        Args:
            b: The right-hand side, vec3d, shape [particle_count].
            failure: The solution of worlds that were not solved.
        """
        worlds = self._worlds
        inputs = [self._equations.matrix, worlds.offsets, b, wp.float64(self._tolerance), self._max_iterations]
        inputs += [wp.float64(failure), self._threads, self._parts, self._partials, self._vectors]
        wp.launch(
            linear_kernels.solve,
            worlds.count * self._threads,
            inputs=inputs,
            outputs=[self._solution, self.failed],
            device=self._equations.device,
            block_dim=BLOCK,
        )
        return self._solution
