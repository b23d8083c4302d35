"""Linear solves with the matrix of a step, for all worlds at once, without synchronizing with the device."""

import math

import warp as wp
from warp.optim.linear import CR, BiCGSTAB, LinearOperator

from . import matrix_kernels
from .equations import Equations
from .worlds import Worlds

_CHECK_EVERY = 8
"""Iterations between two looks at the residual on the CPU; on CUDA, the device looks after each by itself."""

_LEAST_NORM = 1e-100
"""Right-hand sides below this count as 0."""

_AIMS = 0.01, 0.1
"""Residuals at which conjugate residuals and BiCGSTAB end, relative to the tolerance.

The residual that iterations update drifts from the true one, which decides. BiCGSTAB begins with what was found before,
and has nothing to do if that is good enough.
"""


class LinearSolver:
    """Solves A x = b or A^T x = b, preconditioned by the blocks of the diagonal.

    Compression can make A indefinite, and friction makes it unsymmetric. Where it is symmetric, conjugate residuals
    solve it in a quarter of the products that BiCGSTAB takes; BiCGSTAB solves the rest, and what those did not solve.
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
        self._equations, self._worlds, self._tolerance = equations, worlds, tolerance
        self._b, self._x, self._residual = equations.zeros(), equations.zeros(), equations.zeros()
        n, device = len(self._b), equations.device
        self.device = device

        def operator(product):
            return LinearOperator((n, n), wp.vec3d, device, product, worlds.offsets, worlds.largest)

        self._matrix, self._transposed = operator(equations.product), operator(equations.transposed_product)
        self._preconditioner = operator(equations.precondition)
        options = {"atol": _LEAST_NORM, "maxiter": max_iterations, "M": self._preconditioner}
        options |= {"check_every": _CHECK_EVERY if device.is_cpu else 0}
        system, (aim, last_aim) = (self._matrix, self._b, self._x), _AIMS
        self._symmetric_solve = CR(*system, tol=aim * tolerance, **options)
        self._general_solve = BiCGSTAB(*system, tol=last_aim * tolerance, **options)
        self._sums = wp.zeros((2, worlds.count), dtype=wp.float64, device=device)
        self.failed = wp.zeros(worlds.count, dtype=int, device=device)

    def solve(self, b: wp.array, *, transposed: bool, symmetric: bool, failure: float = math.nan) -> wp.array:
        """Returns the solution x of A x = b, or of A^T x = b, vec3d, which the next call overwrites.

        Args:
            b: The right-hand side, vec3d.
            transposed: Whether the matrix is A^T.
            symmetric: Whether A is symmetric.
            failure: The solution of worlds that were not solved.
        """
        matrix = self._transposed if transposed else self._matrix
        operands = {"A": matrix, "b": b, "x": self._x, "M": self._preconditioner}
        self._x.zero_()
        if symmetric:
            self._symmetric_solve(**operands)
            self._check(matrix, b, 0.0)
        self._general_solve(**operands)
        self._check(matrix, b, failure)
        return self._x

    def _check(self, matrix, b, failure):
        """Finds the worlds whose true residual is too large, and sets their solution to a value."""
        matrix.matvec(self._x, b, self._residual, -1.0, 1.0)
        self._sums.zero_()
        world, limit = self._worlds.of_particles, wp.float64(self._tolerance)
        self._launch(matrix_kernels.sum_squares, len(b), [world, self._residual, b], [self._sums])
        self._launch(matrix_kernels.find_failed, self._worlds.count, [limit, self._sums], [self.failed])
        self._launch(matrix_kernels.set_failed, len(b), [world, self.failed, wp.float64(failure)], [self._x])

    def _launch(self, kernel, size, inputs, outputs):
        wp.launch(kernel, size, inputs=inputs, outputs=outputs, device=self.device)
