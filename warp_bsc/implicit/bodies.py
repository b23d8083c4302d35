"""Poses of the bodies that particles touch in a step, and where their gradients go."""

import weakref
from collections.abc import Callable
from typing import NamedTuple

import newton
import numpy as np
import warp as wp
from newton import BodyFlags
from newton.solvers import SolverVBD

from .._private_names.of_newton import pose_rebaseline_mask
from . import kernels
from .elements import with_gradient


class Poses(NamedTuple):
    """Poses of bodies in a step; None without bodies.

    Attributes:
        end: Poses at the end of the step, transform, shape [body_count].
        start: Poses at its start.
        finish: Carries gradients on to arrays of the program, after those of contacts are there; None if they are.
    """

    end: wp.array | None
    start: wp.array | None
    finish: Callable[[], None] | None = None


class BodyPoses:
    """Reads the poses that VBD's contacts use, before it steps.

    Where another solver moves bodies (``integrate_with_external_rigid_solver``), they go from the poses of ``state_in``
    to those of ``state_out``. Kinematic bodies go from where the step before had them to the poses of ``state_in``.
    """

    def __init__(self, solver: SolverVBD):
        """Takes VBD."""
        self._solver, self._model = solver, solver.model
        self._external = solver.integrate_with_external_rigid_solver
        self._last: wp.array | None = None  # poses of the last step, if a tape recorded it
        self._tape: Callable[[], object] = lambda: None  # a weak reference

    def has_dynamic(self) -> bool:
        """Returns whether VBD moves bodies, reading the masses of the model."""
        model = self._model
        if not model.body_count or self._external:
            return False
        assert model.body_inv_mass is not None and model.body_flags is not None
        kinematic = (model.body_flags.numpy() & int(BodyFlags.KINEMATIC)) != 0
        return bool(np.any((model.body_inv_mass.numpy() > 0.0) & ~kinematic))

    def read(self, state_in: newton.State, state_out: newton.State, tape: object) -> Poses:
        """Returns the poses of the step that begins, as copies on a tape; ``tape`` is None without one."""
        if not self._model.body_count:
            return Poses(None, None)
        end, start = state_in.body_q, state_out.body_q
        assert end is not None and start is not None
        if self._external:
            end, start = start, end
            if tape is None:
                return Poses(end, start)
            end, start = (with_gradient(wp.clone(a, requires_grad=False), a.grad) for a in (end, start))
            return Poses(end, start)
        last, given, result = (self._last if tape is not None and self._tape() is tape else None), end, state_out.body_q
        self._last = given if tape is not None else None
        if tape is not None:
            self._tape = weakref.ref(tape)
        mask = pose_rebaseline_mask(self._solver)
        rests = wp.clone(mask)
        start = wp.clone(self._solver.body_q_prev, requires_grad=False)
        self._launch(kernels.rest_at_start, [self._model.body_world, rests, given], [start])
        if tape is None:
            return Poses(given, start)
        of_start = wp.zeros_like(start)
        end = with_gradient(wp.clone(given, requires_grad=False), given.grad)

        def finish():
            gradients = [given.grad, None if last is None else last.grad, None if result is None else result.grad]
            self._launch(kernels.finish_poses, [self._model.body_world, rests], [of_start, *gradients])

        return Poses(end, with_gradient(start, of_start), finish)

    def _launch(self, kernel, inputs, outputs):
        wp.launch(kernel, self._model.body_count, inputs=inputs, outputs=outputs, device=self._model.device)
