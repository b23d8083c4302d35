"""The report of the collision stage: what it found and did, read from the device on access."""

import numpy as np
import warp as wp

from ..detection.intersections import find_intersections
from .buffers import FROZEN, TRUNCATED
from .model_mesh import ModelMesh
from .model_motion import ModelMotion
from .response import Response
from .step_record import name_elements

__all__ = ["SolverReport", "StepTotals"]


@wp.struct
class StepTotals:
    """Totals over all steps so far; each field is an array of one element."""

    steps: wp.array[int]
    uncertified_steps: wp.array[int]
    undetected_steps: wp.array[int]
    truncated_steps: wp.array[int]
    frozen_steps: wp.array[int]
    lost_steps: wp.array[int]
    grazing: wp.array[int]  # contacts whose gradients are clamped
    lost_gradients: wp.array[int]  # steps with an incomplete record


class SolverReport:
    """Results of the steps of a :class:`.solver_ccd.SolverCCD`; reading one synchronizes with the device."""

    def __init__(self, motion: ModelMotion, response: Response):
        """Reports on the steps in which a response resolves a motion."""
        self._motion, self._response = motion, response
        self._totals_values = wp.zeros(len(StepTotals.vars), dtype=int, device=response.device)
        self._totals = name_elements(StepTotals, self._totals_values)
        self._start: float | wp.Event | None = None  # of the last step, in seconds, or an event on a GPU
        self._end: float | wp.Event | None = None

    @property
    def certified(self) -> bool:
        """Whether a complete detection found the motion of the last step, as stored, to be free of collisions."""
        return bool(_read(self._response.status.certified))

    @property
    def hits(self) -> int:
        """Contacts of the motion that the inner solver wanted in the last step."""
        return _read(self._response.status.first_hits)

    @property
    def remaining(self) -> int:
        """Contacts of the last step that could not be resolved, because kinematic vertices leave no room."""
        return _read(self._response.status.remaining)

    @property
    def undetected(self) -> bool:
        """Whether the last step froze all vertices because its detection was incomplete.

        Positions were not finite, or the buffers of a CUDA graph were too small, see
        :class:`.captured_steps.CapturedSteps`.
        """
        return bool(_read(self._response.status.undetected))

    @property
    def rounds(self) -> int:
        """Iterations of detection and projection or truncation in the last step."""
        return _read(self._response.status.rounds)

    @property
    def truncated(self) -> int:
        """Vertices whose paths were truncated before a contact in the last step."""
        return self._count_vertices(TRUNCATED)

    @property
    def frozen(self) -> int:
        """Vertices that were frozen where they were at the start of the last step."""
        return self._count_vertices(FROZEN)

    @property
    def intersections(self) -> np.ndarray:
        """Edges and faces of the solver's ``mesh`` that cross at the start of the last step, int32, shape [n, 2].

        The stage does not separate what crosses already. Shapes that cross each other are excluded. Computed on each
        access, in exact arithmetic.
        """
        mesh = self._response.detector.mesh
        assert isinstance(mesh, ModelMesh)
        particles = mesh.model.particle_count
        pairs = find_intersections(mesh, self._motion.vertices.x0)
        of_particles = [elements.min(axis=1) < particles for elements in (mesh.edges, mesh.faces)]
        return pairs[of_particles[0][pairs[:, 0]] | of_particles[1][pairs[:, 1]]]

    @property
    def milliseconds(self) -> float | None:
        """Time of the last step that was not captured, without the inner solver [ms]; None if there was none."""
        if self._start is None:
            return None
        assert self._end is not None
        if isinstance(self._start, wp.Event):
            return wp.get_event_elapsed_time(self._start, self._end)
        return 1e3 * (self._end - self._start)

    @property
    def steps(self) -> int:
        """Steps taken so far."""
        return _read(self._totals.steps)

    @property
    def uncertified_steps(self) -> int:
        """Steps so far that were not certified."""
        return _read(self._totals.uncertified_steps)

    @property
    def undetected_steps(self) -> int:
        """Steps so far that froze all vertices because their detection was incomplete, see :attr:`undetected`."""
        return _read(self._totals.undetected_steps)

    @property
    def truncated_steps(self) -> int:
        """Steps so far in which a path was truncated."""
        return _read(self._totals.truncated_steps)

    @property
    def frozen_steps(self) -> int:
        """Steps so far in which a vertex was frozen."""
        return _read(self._totals.frozen_steps)

    @property
    def grazing(self) -> int:
        """Contacts so far, in steps on a tape, whose gradients are clamped.

        The derivatives of features that slide along each other, or have no plane, are unbounded; finite ones replace
        them, see :mod:`warp_bsc.kernels.gradients`.
        """
        return _read(self._totals.grazing)

    @property
    def lost_gradients(self) -> int:
        """Steps so far on a tape, in a CUDA graph, whose record did not fit in its buffers.

        Gradients through such a step are NaN: see :class:`.captured_steps.CapturedSteps`.
        """
        return _read(self._totals.lost_gradients)

    def __str__(self) -> str:
        """Returns the steps so far, in one line."""
        line = (
            f"{self.steps} steps, {self.truncated_steps} with truncation, {self.frozen_steps} with vertices "
            f"left standing, {self.uncertified_steps} not certified"
        )
        if self.grazing or self.lost_gradients:
            line += f"; gradients: {self.grazing} grazing contacts, {self.lost_gradients} steps lost"
        return line

    def _count_vertices(self, bit):
        return int(np.count_nonzero(self._response.vertices.outcome.numpy() & int(bit)))


def _read(values):
    """Returns the only element of an array."""
    return int(values.numpy()[0])
