"""Steps that run from a CUDA graph, and outside it where the buffers of the graph are too small."""

from collections.abc import Callable, Sequence

import newton
import warp as wp
from newton.solvers import SolverBase

from .._arguments import check_instance, given
from .._one_thread import Occupied, one_at_a_time
from .drive.snapshot import Snapshot
from .stage import CollisionStage


class CapturedSteps:
    """Runs a function that steps a solver, on a GPU from a CUDA graph.

    The first run is outside the graph, where buffers grow, and is captured then. A later run in which a step says that
    its detection was incomplete (``report.totals.undetected_steps``) is taken back: the state and the totals of the
    report become those before it, and the function runs outside the graph, and is captured anew. No step of a
    :class:`.solver_ccd.SolverCCD` needs that: it completes detections for which a graph is too small. Other solvers
    have nothing to take back, and on the CPU the function runs as it is.

    Example::

        def simulate():
            for start, end in ((state_0, state_1), (state_1, state_0)):  # ends in the state that it began with
                start.clear_forces()
                solver.step(start, end, control, None, dt)

        frame = CapturedSteps(simulate, solver, [state_0])
        for _ in range(frames):
            frame()

    Attributes:
        graph: The CUDA graph of the last capture; None before, and on the CPU.
        retaken: Runs so far that were taken back.
    """

    def __init__(self, steps: Callable[[], object], solver: SolverBase, state: Sequence[newton.State | wp.array] = ()):
        """Captures nothing yet.

        Args:
            steps: Steps the solver, always in the same arrays; in a graph its launches are repeated, and nothing else
                that it does. If it goes back through a tape, it also has to clear the gradients of the tape before
                first, and to keep that tape: a graph clears them again.
            solver: The solver.
            state: All states and arrays that ``steps`` both reads and changes.

        Raises:
            TypeError: If an argument has another type.
        """
        if not callable(steps):
            raise TypeError(f"steps must be a function, not {given(steps)}")
        check_instance(solver, "solver", SolverBase, "a solver of Newton")
        check_instance(state, "state", (list, tuple), "a list of states and arrays")
        for x in state:
            check_instance(x, "state", (newton.State, wp.array), "a list of states and arrays")
        self._lock = Occupied("CapturedSteps")
        self._steps, self._device = steps, solver.model.device
        self._report = solver.report if isinstance(solver, CollisionStage) else None
        self._before = Snapshot([] if self._report is None else [*state, self._report.total_values])
        self.graph = None
        self.retaken = 0

    @one_at_a_time
    def __call__(self) -> None:
        """Runs the steps once. Synchronizes with the device where a run may have to be taken back.

        Raises:
            RuntimeError: If another thread is running them; if CUDA makes no graph of them, for example because they
                write to memory of a tape that is gone.
        """
        if self.graph is None or not self._launch():
            self._steps()
            self._capture()

    def _capture(self):
        self.graph = None
        if self._device.is_cuda:
            with wp.ScopedCapture(self._device) as capture:
                self._steps()
            self.graph = capture.graph

    def _launch(self):
        """Launches the graph; if its buffers were too small, restores the state and returns False."""
        report = self._report
        if report is None:
            wp.capture_launch(self.graph)
            return True
        self._before.save()
        lost = report.count_lost()
        wp.capture_launch(self.graph)
        if report.count_lost() == lost:
            report.warn()
            return True
        self._before.restore()
        report.copy_totals()
        wp.synchronize_device(self._device)  # so that the next step does not warn of one that was taken back
        self.retaken += 1
        return False
