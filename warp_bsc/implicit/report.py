"""The report of steps with contact in the solve: that of the collision stage, and how far Newton's method came."""

import numpy as np
import warp as wp

from ..response.report.report import SolverReport
from ..response.state.structs import allocate
from ..response.state.workspace import Workspace
from .contact.results import StepResults
from .gradients.report import GradientCounts, GradientReport


class ImplicitStepReport(SolverReport):
    """Results of the steps of a :class:`warp_bsc.SolverImplicit`; reading one synchronizes with the device.

    ``hits`` are contacts that the solve left, and that the response behind it resolved; ``strain`` is that of a step
    from its start to its end. Impulses of barriers and friction are those at the end of the solve: with those of the
    response they are the change of momentum, as far as the step :attr:`converged`. With ``report=["worlds"]`` also
    ``worlds`` has :attr:`newton_steps`, :attr:`last_change`, :attr:`converged` and :attr:`arrived`.
    """

    strain_cause = ""
    shorter_steps = strain_advice = "take shorter steps, or raise max_iterations if report.converged is false"

    def __init__(self, work: Workspace, *, responds: bool = True):
        """Reports on the steps of a workspace."""
        super().__init__(work, responds=responds)
        self.results = allocate(StepResults, work.worlds, work.device)
        self.unconverged = wp.zeros(1, dtype=wp.int64, device=work.device)
        self.of_gradients = GradientReport(work.worlds, work.device)

    def warn(self) -> None:
        """Warns as of the stage, and once each of gradients that are NaN, or grow, on their way back through steps."""
        super().warn()
        for subject, message in self.of_gradients.warnings().items():
            self._warnings.once(subject, lambda message=message: message)

    @property
    def gradient_counts(self) -> GradientCounts:
        """Totals over all gradients that went back through steps so far, as of this access."""
        self.of_gradients.copy_counts()
        totals = self.of_gradients.totals()  # waits for the copy
        self.warn()
        return totals

    @property
    def gradient_norms(self) -> np.ndarray:
        """Norm of the gradient at the start of each step of the last tape, and at the end of the last one.

        Float64, shape [steps + 1, worlds], in the unit of the loss per metre: that of gradients with respect to
        positions, and with respect to velocities over the length of the step.
        """
        return self.of_gradients.norms

    @property
    def newton_steps(self) -> int:
        """Newton steps of the last step, the most of all worlds."""
        return self._read(self.results.newton_steps)

    @property
    def last_change(self) -> float:
        """Largest change of the velocity of a particle by the last Newton step of a world in the last step [m/s].

        It is infinite where a position, a velocity or a force was not finite.
        """
        return self._read(self.results.last_change)

    @property
    def converged(self) -> bool:
        """Whether the Newton steps of all worlds sufficed for the last step.

        It is false if velocities are farther from where the changes of the last two Newton steps lead than 1 mm/s, or
        1% of the speed of what a program moves up to 10 mm/s, in steps of less than 1/60 s proportionally less; if a
        position, a velocity or a force was not finite, if :attr:`arrived` is false, and if pairs that are near each
        other did not fit into the buffers of a CUDA graph. A step that is not converged is free of collisions all the
        same, if it is certified; it lags behind its forces.
        """
        return bool(self.results.converged.numpy().all())

    @property
    def arrived(self) -> bool:
        """Whether all that a program moves had arrived in the solve of the last step.

        Where it had not, because cloth is in its way, the response behind the solve pushes that aside, or the step is
        not certified.
        """
        return bool(self.results.arrived.numpy().all())

    @property
    def unconverged_steps(self) -> int:
        """Steps so far that were not :attr:`converged`."""
        return self._read(self.unconverged)

    def __str__(self) -> str:
        """Returns the line of the stage, and how many steps did not converge."""
        line = f"{super().__str__()}{self.gradient_counts.text()}"
        return f"{line}, {self.unconverged_steps} whose Newton steps did not converge"
