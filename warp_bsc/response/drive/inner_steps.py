"""How the inner solver takes the steps of a stage."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import newton
import warp as wp

from ..._profiling import phase


@dataclass(frozen=True)
class StepCall:
    """A call of :meth:`.stage.CollisionStage.step`, whose arguments the first five are, or of one of its substeps."""

    state_in: newton.State
    state_out: newton.State
    control: newton.Control | None
    contacts: newton.Contacts | None
    dt: float
    options: dict[str, Any] = field(default_factory=dict)  # more for the inner solver
    mask: wp.array[wp.bool] | None = None  # which worlds take part, None for all
    tape: wp.Tape | None = None  # the active one if the model requires gradients
    number: int = 0  # of the substep
    count: int = 1  # of substeps

    @property
    def is_recorded(self) -> bool:
        """Whether a tape records the gradients of the step."""
        end = self.state_out.particle_q
        return self.tape is not None and end is not None and end.requires_grad

    @property
    def is_first(self) -> bool:
        """Whether the results of the step begin with this one."""
        return self.number == 0

    @property
    def is_last(self) -> bool:
        """Whether the step ends with this one."""
        return self.number == self.count - 1


class InnerSteps:
    """Steps the inner solver once, with what it was called with; subclasses divide a step, or let it step otherwise."""

    pushes_before: str | None = None
    """What pushes contacts apart before the stage does, so that its impulses are not all; None for nothing."""

    def __init__(self, stage: Any):
        """Steps the ``solver`` of a stage, whichever it is at the time."""
        self._stage = stage

    def parts(self, call: StepCall) -> Iterator[StepCall]:
        """Yields the steps to take, one after the other, here the call; the stage resolves each before the next."""
        yield call

    @phase("inner solver")
    def take(self, call: StepCall) -> None:
        """Steps the inner solver, which predicts the end of the step."""
        self._stage.solver.step(call.state_in, call.state_out, call.control, call.contacts, call.dt, **call.options)
