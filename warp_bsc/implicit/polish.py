"""Newton steps that finish what the sweeps of VBD began."""

import warp as wp

from . import kernels, matrix_kernels
from .equations import Equations
from .linear import LinearSolver
from .worlds import Worlds

_SHARES = 1.0, 0.5, 0.25, 0.0625
"""Shares of a Newton step that are tried."""

_TOLERANCE = 1e-4
"""Tolerance of the linear solve of a Newton step."""


class Polish:
    """Solves the equations of a step by Newton's method, from a solution that is nearly good enough.

    Each step tries shares of the Newton direction, and takes in each world the one that leaves the least forces in the
    norm of the preconditioner, if that is less than before. A world whose linear solve fails stays as it is.
    """

    def __init__(self, equations: Equations, worlds: Worlds, steps: int, max_iterations: int):
        """Allocates buffers for a number of Newton steps."""
        self._equations, self._worlds, self._steps = equations, worlds, steps
        self._linear = LinearSolver(equations, worlds, tolerance=_TOLERANCE, max_iterations=max_iterations)
        n, device = equations.model.particle_count, equations.device
        self._trial, self._best = (wp.zeros(n, dtype=wp.vec3, device=device) for _ in range(2))
        self._merit, self._least = (wp.zeros(worlds.count, dtype=wp.float64, device=device) for _ in range(2))
        self._is_less = wp.zeros(worlds.count, dtype=int, device=device)

    def run(self, x1: wp.array) -> None:
        """Moves the end of the step that the equations have loaded, vec3."""
        equations, n = self._equations, len(x1)
        world = self._worlds.of_particles
        for _ in range(self._steps):
            forces = equations.evaluate()
            equations.differentiate(transposed=False)
            self._measure(forces, self._least)
            direction = self._linear.solve(forces, failure=0.0)
            wp.copy(self._best, x1)
            for share in _SHARES:
                self._launch(kernels.move, n, [share, x1, direction], [self._trial])
                equations.load_end(self._trial)
                self._measure(equations.evaluate(), self._merit)
                self._launch(kernels.keep_least, self._worlds.count, [self._merit], [self._least, self._is_less])
                self._launch(kernels.copy_where, n, [world, self._is_less, self._trial], [self._best])
            wp.copy(x1, self._best)
            equations.load_end(x1)

    def _measure(self, forces, merit):
        """Computes the squared norm of forces by world."""
        matrix = self._equations.matrix
        assert matrix is not None
        merit.zero_()
        inputs = [self._worlds.of_particles, matrix.roots, forces]
        self._launch(matrix_kernels.sum_scaled_squares, len(forces), inputs, [merit])

    def _launch(self, kernel, size, inputs, outputs):
        wp.launch(kernel, size, inputs=inputs, outputs=outputs, device=self._equations.device)
