"""What became of gradients on their way back through steps, counted on the device."""

import weakref
from dataclasses import dataclass

import numpy as np
import warp as wp

from .between_steps import AMBIGUOUS_MOVES
from .kernels import GROWTH, Count

Place = tuple[int, wp.array]
"""The number of a step on its tape, and the norms of its gradients: at its end, and at its start."""


@dataclass(frozen=True)
class GradientCounts:
    """Totals over all gradients that went back through steps so far.

    Attributes:
        steps: Steps that they went back through.
        unsolved: Worlds of these steps, each step for itself, whose gradients are NaN: the step did not converge in
            them, or the response behind the solve has changed its end.
        failed_solves: Worlds of these steps whose linear solve did not converge: gradients are NaN as well. Worlds
            whose gradients were NaN before do not count.
        growing: Worlds of these steps within which the norm of the gradient grew by more than 1,000.
        ambiguous_moves: Gradients of kinematic particles and bodies that a program moved between steps, and of which it
            cannot be known what they are of: they are NaN, see :mod:`.between_steps`.
        unrepeated: Segments of :func:`.checkpointed` steps that ended elsewhere when they were taken again: gradients
            of what is before them are NaN.
    """

    steps: int
    unsolved: int
    failed_solves: int
    growing: int
    ambiguous_moves: int
    unrepeated: int

    def text(self) -> str:
        """Returns what a line of a report says of them, if anything."""
        lost = self.unsolved + self.failed_solves
        return f"; gradients: NaN in {lost} worlds of steps" if lost else ""


class GradientReport:
    """Counts, and norms of gradients by step.

    The norm is that of gradients with respect to positions, and to velocities over the length of the step: those with
    respect to the ways of particles in a step.
    """

    def __init__(self, worlds: int, device: wp.Device):
        """Begins with no steps."""
        self._worlds, self.counts = worlds, wp.zeros(len(Count), dtype=wp.int64, device=device)
        self._host = wp.zeros(len(Count), dtype=wp.int64, device="cpu", pinned=device.is_cuda)
        self._tape, self._norms = (lambda: None), list[wp.array]()

    def add_step(self, tape: wp.Tape) -> Place:
        """Returns the place of another step of a tape."""
        if self._tape() is not tape:
            self._tape, self._norms = weakref.ref(tape), []
        norms = wp.zeros((2, self._worlds), dtype=wp.float64, device=self.counts.device)
        self._norms.append(norms)
        return len(self._norms) - 1, norms

    def copy_counts(self) -> None:
        """Copies the counts to the host, without waiting for the device, also in a CUDA graph."""
        wp.copy(self._host, self.counts)

    @property
    def norms(self) -> np.ndarray:
        """Norm at the start of each step of the last tape, then at the end of the last, shape [steps + 1, worlds]."""
        if not self._norms:
            return np.zeros((0, self._worlds))
        found = [norms.numpy() for norms in self._norms]
        return np.array([*(both[1] for both in found), found[-1][0]])

    def totals(self) -> GradientCounts:
        """Returns the totals."""
        return GradientCounts(*self.counts.numpy()[: int(Count.STEP)].tolist())

    def warnings(self) -> dict[str, str]:
        """Returns what to warn of, as far as the host knows it, by subject."""
        counts, found = self._host.numpy(), {}
        if counts[Count.UNSOLVED]:
            found["unsolved"] = (
                "a step on a tape did not converge, or left contacts that the response has resolved: gradients are NaN "
                "in its world (see report.gradient_counts.unsolved); take shorter steps, or raise max_iterations"
            )
        if counts[Count.FAILED_SOLVES]:
            found["failed solves"] = (
                "a linear solve of a gradient did not converge: it is NaN (see report.gradient_counts.failed_solves)"
            )
        if counts[Count.GROWING]:
            found["growing"] = (
                f"the norm of the gradient grew by more than {float(GROWTH):,.0f} within step {counts[Count.STEP]} of "
                f"a tape, most of it at particle {counts[Count.PARTICLE]}: where cloth buckles, the end of a step "
                "jumps by tiny changes of its start (see report.gradient_norms)"
            )
        if counts[Count.AMBIGUOUS_MOVES]:
            found["moves"] = f"{AMBIGUOUS_MOVES} (see report.gradient_counts.ambiguous_moves)"
        if counts[Count.UNREPEATED]:
            found["unrepeated"] = (
                "checkpointed steps ended elsewhere when they were taken again: gradients are NaN (see "
                "report.gradient_counts.unrepeated); step must do the same whenever it gets the same number and state"
            )
        return found
