"""Steps that run from a CUDA graph on a GPU, and as they are on the CPU."""

from collections.abc import Callable

import warp as wp
from newton.solvers import SolverBase

from .._arguments import check_instance, given
from .._one_thread import Occupied, one_at_a_time
from .stage import CollisionStage


class CapturedSteps:
    """Runs a function that steps a solver, on a GPU from a CUDA graph.

    The first run is outside the graph, where buffers grow, and is captured then; later ones launch the graph. On the
    CPU the function runs as it is.

    Example::

        def simulate():
            for start, end in ((state_0, state_1), (state_1, state_0)):  # ends in the state that it began with
                start.clear_forces()
                solver.step(start, end, control, None, dt)

        frame = CapturedSteps(simulate, solver)
        for _ in range(frames):
            frame()

    Attributes:
        graph: The CUDA graph; None before the first run, and on the CPU.
    """

    def __init__(self, steps: Callable[[], object], solver: SolverBase):
        """Captures nothing yet.

        Args:
            steps: Steps the solver, always in the same arrays; in a graph its launches are repeated, and nothing else
                that it does. If it goes back through a tape, it also has to clear the gradients of the tape before
                first, and to keep that tape: a graph clears them again.
            solver: The solver.

        Raises:
            TypeError: If an argument has another type.
        """
        if not callable(steps):
            raise TypeError(f"steps must be a function, not {given(steps)}")
        check_instance(solver, "solver", SolverBase, "a solver of Newton")
        self._lock = Occupied("CapturedSteps")
        self._steps, self._solver = steps, solver
        self.graph = None

    @one_at_a_time
    def __call__(self) -> None:
        """Runs the steps once.

        Raises:
            RuntimeError: If another thread is running them; if CUDA makes no graph of them, for example because they
                write to memory of a tape that is gone.
        """
        if self.graph is not None:
            wp.capture_launch(self.graph)
            if isinstance(self._solver, CollisionStage):
                self._solver.report.warn()
            return
        self._steps()
        device = self._solver.model.device
        if device.is_cuda:
            with wp.ScopedCapture(device) as capture:
                self._steps()
            self.graph = capture.graph
