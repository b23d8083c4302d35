"""The report of implicit steps: how well they were solved, and what became of their gradients."""

import numpy as np
import warp as wp

from .._warnings import warn_caller
from ..response.adjoint.between_steps import AMBIGUOUS_MOVES
from .worlds import Worlds

RESIDUAL_LIMIT = 0.01
"""Residual of a step, relative to the weight, above which a step warns: gradients may be off by 10% or more."""

_POLISH = 3
"""Newton steps that finish most steps of ten iterations."""

_SHORTER = "take shorter steps, as SolverCCD does with substeps=4, or more of them"


class ImplicitReport:
    """Residuals of steps and failures of linear solves; reading an attribute synchronizes with the device.

    The residual of a step is the force that is left on free particles at its end, as the root of the sum of squares,
    relative to that of their weights. VBD makes it smaller with each iteration. Gradients are those of a solved step:
    the larger it is, the less they are those of the result that was computed.
    """

    def __init__(self, worlds: Worlds, polish: int):
        """Makes a report of no steps, which are finished by ``polish`` Newton steps."""
        self._worlds, self._polish = worlds, polish
        device, count = worlds.of_particles.device, worlds.count
        self.device_residuals = wp.zeros((2, count), dtype=wp.float64, device=device)  # last, largest
        self.device_counts = wp.zeros(8, dtype=wp.int64, device=device)
        self._host = wp.zeros(8, dtype=wp.int64, device="cpu", pinned=device.is_cuda)
        self._said = set()

    @property
    def worlds(self) -> np.ndarray:
        """The world that each row of :attr:`residuals` is of, -1 for particles of no world, int32, shape [n]."""
        return self._worlds.ids

    @property
    def residuals(self) -> np.ndarray:
        """Residual of the last step on a tape, relative to the weight, float64, shape [n]."""
        return self._read(self.device_residuals)[0]

    @property
    def largest_residuals(self) -> np.ndarray:
        """Largest residual of all steps on tapes, relative to the weight, float64, shape [n]."""
        return self._read(self.device_residuals)[1]

    @property
    def steps(self) -> int:
        """Steps on tapes so far."""
        return self._count(0)

    @property
    def unconverged_steps(self) -> int:
        """Steps on tapes with a residual of more than 0.01 of the weight in a world."""
        return self._count(1)

    @property
    def solves(self) -> int:
        """Steps that gradients went back through."""
        return self._count(2)

    @property
    def failed_solves(self) -> int:
        """Linear solves that did not converge, each world of a step for itself; their gradients are NaN."""
        return self._count(3)

    @property
    def indefinite_solves(self) -> int:
        """Linear solves that found their matrix not to be positive definite, each world of a step for itself.

        Forces then move particles on in a direction instead of back, as where an element is compressed: the end of
        the step balances them, but it is no minimum of energy. Gradients are those of that balance, if the step
        reached it: :attr:`rejected_solves` has the others.
        """
        return self._count(6)

    @property
    def rejected_solves(self) -> int:
        """Linear solves in :attr:`indefinite_solves` of a world that ended a step with more than 0.01 of the weight.

        The step is far from any balance, and other balances are near, so that gradients could be of any size: they are
        NaN.
        """
        return self._count(7)

    @property
    def overflowed_steps(self) -> int:
        """Steps on tapes in which pairs did not fit into the buffers of VBD's self-contact, which drops those.

        Gradients of a world that goes back through one are NaN.
        """
        return self._count(4)

    @property
    def ambiguous_moves(self) -> int:
        """Gradients of kinematic particles and bodies that a program moved between steps on a tape, which are NaN.

        It cannot be known what they are of, see :mod:`.response.adjoint.between_steps`. Behind the collision stage, its
        report counts them, ``gradients.ambiguous_moves``.
        """
        return self._count(5)

    def _count(self, i):
        return int(self._read(self.device_counts)[i])

    def _read(self, array):
        """Returns an array on the host, and warns: the counts were copied before, on the same stream."""
        values = array.numpy()
        self.warn()
        return values

    def copy_counts(self) -> None:
        """Begins to copy the counts to the host, for ``warn``."""
        wp.copy(self._host, self.device_counts)

    def warn(self) -> None:
        """Warns once each of steps not converged and of gradients that are NaN, as far as the host knows."""
        _, unconverged, _, failed, overflowed, ambiguous, _, rejected = self._host.numpy()
        if unconverged:
            advice = "give VBD more iterations, " + ("" if self._polish >= _POLISH else f"pass polish={_POLISH}, ")
            self._warn_once(
                "residual",
                f"a step of VBD on a tape ended with forces of more than {RESIDUAL_LIMIT:.0%} of the weight (see "
                f"report.residuals): gradients are those of a solved step, not of this one; {advice}or {_SHORTER}",
            )
        if rejected:
            self._warn_once(
                "rejected",
                f"the matrix of a step that ended with forces of more than {RESIDUAL_LIMIT:.0%} of the weight is "
                "indefinite, as where cloth buckles: gradients are NaN (see report.rejected_solves); "
                f"{_SHORTER}, or give cloth more bending stiffness",
            )
        if failed:
            self._warn_once("solve", "a linear solve did not converge: gradients are NaN (see report.failed_solves)")
        if overflowed:
            self._warn_once(
                "overflow",
                "self-contact of VBD dropped pairs that did not fit into its buffers: gradients are NaN (see "
                "report.overflowed_steps); raise particle_vertex_contact_buffer_size or "
                "particle_edge_contact_buffer_size of SolverVBD",
            )
        if ambiguous:
            self._warn_once("moves", f"{AMBIGUOUS_MOVES} (see report.ambiguous_moves)")

    def _warn_once(self, subject, message):
        if subject not in self._said:
            self._said.add(subject)
            warn_caller(message)
