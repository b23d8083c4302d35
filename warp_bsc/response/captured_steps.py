"""Steps on a tape that run from a CUDA graph, and outside it where the buffers of the graph are too small."""

from collections.abc import Callable, Sequence

import newton
import warp as wp
from newton.solvers import SolverBase

from .._arguments import check_instance, given
from .._one_thread import Occupied, one_at_a_time
from .drive.snapshot import Snapshot
from .layer.contact_layer import ContactLayer
from .stage import CollisionStage


class CapturedSteps:
    """Runs a function that steps a solver on a tape, on a GPU from a CUDA graph.

    The record of a step, from which its gradients come, has buffers that cannot grow in a graph. A step on a tape that
    needs larger ones freezes all particles or loses its gradients, and the report counts it. Such a run is taken back:
    the state and the totals of the report become those before it, the function runs outside the graph, where buffers
    grow, and is captured anew. So is the first run. Other solvers have nothing to take back, and on the CPU the
    function runs as it is.

    Without a tape no step of a :class:`.solver_ccd.SolverCCD` needs this: it completes detections for which a graph is
    too small, and any graph will do. Such steps may run here as well, and none is taken back.

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
        layer = solver.solver if isinstance(solver, CollisionStage) else solver
        self._layer = layer if isinstance(layer, ContactLayer) else None
        restored = [] if self._report is None and self._layer is None else list(state)
        if self._report is not None:
            restored.append(self._report.total_values)
        if self._layer is not None:
            restored.append(self._layer.skipped)
        self._before = Snapshot(restored)
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
        self._before.save()
        lost = self._count_lost()
        wp.capture_launch(self.graph)
        if self._count_lost() == lost:
            if self._report is not None:
                self._report.warn()
            return True
        self._before.restore()
        if self._report is not None:
            self._report.copy_totals()
            wp.synchronize_device(self._device)  # so that the next step does not warn of one that was taken back
        self.retaken += 1
        return False

    def _count_lost(self):
        """Returns the steps so far for which the buffers of a graph may have been too small."""
        report, layer = self._report, self._layer
        lost = 0 if layer is None else layer.skipped_steps
        return lost if report is None else lost + report.count_lost()
