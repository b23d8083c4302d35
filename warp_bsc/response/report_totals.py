"""Totals over all steps of a stage, on the device and as the report gives them."""

from dataclasses import dataclass

import warp as wp


@wp.struct
class StepTotals:
    """Totals over all steps so far on the device, see :class:`Totals`; each field is an array of one element."""

    steps: wp.array[wp.int64]
    substepped_steps: wp.array[wp.int64]
    uncertified_steps: wp.array[wp.int64]
    undetected_steps: wp.array[wp.int64]
    truncated_steps: wp.array[wp.int64]
    frozen_steps: wp.array[wp.int64]
    not_finite_steps: wp.array[wp.int64]
    remaining: wp.array[wp.int64]
    excluded: wp.array[wp.int64]
    strained_steps: wp.array[wp.int64]
    crossing_steps: wp.array[wp.int64]
    inverting_steps: wp.array[wp.int64]
    shape_not_followed: wp.array[wp.int64]  # the last shape with a change that the stage does not follow, from 1
    grazing: wp.array[wp.int64]
    lost_gradients: wp.array[wp.int64]
    outrun_steps: wp.array[wp.int64]
    ambiguous_moves: wp.array[wp.int64]


@dataclass(frozen=True)
class Totals:
    """Totals over all steps so far.

    Attributes:
        steps: Steps.
        substepped_steps: Steps that were taken in substeps, see :mod:`.substeps.substeps`.
        uncertified_steps: Steps that were not certified.
        undetected_steps: Steps that froze all vertices because their detection was incomplete, see
            :attr:`.report.SolverReport.undetected`.
        truncated_steps: Steps in which a path was truncated.
        frozen_steps: Steps in which a vertex or a body was frozen.
        not_finite_steps: Steps with positions or velocities of particles that were not finite.
        remaining: Sum of :attr:`.report.SolverReport.remaining`: contacts that were passed, in steps not certified.
        excluded: Sum of :attr:`.report.SolverReport.excluded`; a pair counts in each step in which it has a contact.
        strained_steps: Steps in which :attr:`.report.SolverReport.strain` was more than 0.2.
        crossing_steps: Steps at whose start :attr:`.report.SolverReport.crossings` was more than 0.
        inverting_steps: Steps in which :attr:`.report.SolverReport.inversions` was more than 0; 0 if the stage was not
            asked to count them.
    """

    steps: int
    substepped_steps: int
    uncertified_steps: int
    undetected_steps: int
    truncated_steps: int
    frozen_steps: int
    not_finite_steps: int
    remaining: int
    excluded: int
    strained_steps: int
    crossing_steps: int
    inverting_steps: int


@dataclass(frozen=True)
class GradientTotals:
    """Totals over all steps on a tape so far.

    Attributes:
        grazing: Contacts whose gradients are clamped. The derivatives of features that slide along each other, or have
            no plane, are unbounded; finite ones replace them, see :mod:`warp_bsc.kernels.gradients`.
        lost_steps: Steps in a CUDA graph whose record did not fit in its buffers. Gradients through such a step are
            NaN, see :class:`.captured_steps.CapturedSteps`.
        layerless_steps: Steps whose contact layer pushed nothing, because a queue of a CUDA graph was too small.
            Contacts then act where they hit, and results are not continuous.
        outrun_steps: Steps in which a contact layer left contacts to the stage: they passed it in one step, or are
            between bodies. Results are not continuous there.
        ambiguous_moves: Gradients of kinematic particles and bodies that a program moved between steps on a tape, and
            that are NaN, as it cannot be known what they are of, see :mod:`.adjoint.between_steps`.
    """

    grazing: int
    lost_steps: int
    layerless_steps: int
    outrun_steps: int
    ambiguous_moves: int
