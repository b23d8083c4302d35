"""Takes a step in smaller ones, each a step of its own with its contacts, through which gradients pass.

Where gradients are asked for, and behind a contact layer, substeps are not those of :mod:`.substeps.substeps`: their
number must not depend on what happens, or results would jump, and a tape has to record what each of them did. A step of
length dt becomes n steps of length dt / n, with all that a step does: inner solver, layer, detection, response. Control
and contacts of the program are the same in all of them, and so are its forces on particles and bodies.
"""

from collections.abc import Callable

import newton
import warp as wp

from ..._private_names.of_warp import paused_tape

_FORCES = "particle_f", "body_f"


class SmallSteps:
    """Takes steps in a number of smaller ones.

    Attributes:
        number: The number.
    """

    def __init__(self, model: newton.Model, number: int):
        """Allocates the states between steps that no tape records."""
        self.number, self._model = number, model
        self._states = [model.state(requires_grad=False) for _ in range(min(number - 1, 2))]
        self._forces = {
            name: wp.clone(array, requires_grad=False) for name, array in self._forces_of(self._states[0]).items()
        }

    def take(
        self,
        step: Callable[..., None],
        state_in: newton.State,
        state_out: newton.State,
        dt: float,
        *,
        on_tape: bool,
    ) -> None:
        """Takes the steps, ``step(state_in, state_out, dt)`` each.

        On a tape, each state between two of them is a new one, which the tape keeps.
        """
        forces = self._copy_forces(state_in, on_tape)
        start = state_in
        for i in range(1, self.number + 1):
            if i == self.number:
                end = state_out
            else:
                end = self._new_state() if on_tape else self._states[i % len(self._states)]
            step(start, end, dt / self.number)
            if end is not state_out:
                for name, array in forces.items():  # the inner solver adds its own to those of the start
                    wp.copy(getattr(end, name), array)
            start = end

    def _new_state(self):
        with paused_tape():  # which would record that it begins as a copy of the model
            return self._model.state()

    def _copy_forces(self, state, on_tape):
        """Returns copies of the forces of the program, before the inner solver adds its own."""
        if on_tape:
            return {name: wp.clone(array) for name, array in self._forces_of(state).items()}
        for name, array in self._forces_of(state).items():
            wp.copy(self._forces[name], array)
        return self._forces

    def _forces_of(self, state):
        arrays = {name: getattr(state, name) for name in _FORCES}
        return {name: array for name, array in arrays.items() if array is not None}
