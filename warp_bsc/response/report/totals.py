"""Totals over all steps of a stage, on the device and as the report gives them."""

from dataclasses import dataclass

import warp as wp


@wp.struct
class StepTotals:
    """Totals over all steps so far on the device, see :class:`Totals`; each field is an array of one element."""

    steps: wp.array[wp.int64]
    uncertified_steps: wp.array[wp.int64]
    truncated_steps: wp.array[wp.int64]
    frozen_steps: wp.array[wp.int64]
    not_finite_steps: wp.array[wp.int64]
    remaining: wp.array[wp.int64]
    excluded: wp.array[wp.int64]
    strained_steps: wp.array[wp.int64]
    crossing_steps: wp.array[wp.int64]
    inverting_steps: wp.array[wp.int64]
    penetrated_steps: wp.array[wp.int64]
    set_bodies: wp.array[wp.int64]
    unseen_steps: wp.array[wp.int64]
    revoked_steps: wp.array[wp.int64]
    shape_not_followed: wp.array[wp.int64]  # the last shape with a change that the stage does not follow, from 1


@dataclass(frozen=True)
class Totals:
    """Totals over all steps so far.

    Attributes:
        steps: Steps. One that is taken in substeps is one step, of which its substeps count together.
        uncertified_steps: Steps that were not certified.
        truncated_steps: Steps in which a path was truncated.
        frozen_steps: Steps in which a vertex or a body was frozen.
        not_finite_steps: Steps with positions or velocities of particles that were not finite.
        remaining: Sum of :attr:`.report.SolverReport.remaining`: contacts that were passed, in steps not certified.
        excluded: Sum of :attr:`.report.SolverReport.excluded`; a pair counts in each step in which it has a contact.
        strained_steps: Steps in which :attr:`.report.SolverReport.strain` was more than 0.2.
        crossing_steps: Steps at whose start :attr:`.report.SolverReport.crossings` was more than 0.
        inverting_steps: Steps in which :attr:`.report.SolverReport.inverting` was more than 0; 0 if the stage was not
            asked to count them.
        penetrated_steps: Steps of which ``passed`` or ``crossed`` of :attr:`.report.SolverReport.penetrated` was more
            than 0, and those in ``revoked_steps``.
        set_bodies: Dynamic bodies, each once, whose pose a program wrote between steps time after time: the stage does
            not see the way of such a body between two steps.
        unseen_steps: Steps behind a coupled solver whose end in the state of the program has not been seen: the last
            one until ``sync_entry_states``, and those before a reset. Not in ``uncertified_steps`` for that.
        revoked_steps: Of the steps that were not certified, those that are free of collisions as their entry sees them,
            but not in the state of the program.
    """

    steps: int
    uncertified_steps: int
    truncated_steps: int
    frozen_steps: int
    not_finite_steps: int
    remaining: int
    excluded: int
    strained_steps: int
    crossing_steps: int
    inverting_steps: int
    penetrated_steps: int
    set_bodies: int
    unseen_steps: int
    revoked_steps: int


@dataclass(frozen=True)
class Penetrated:
    """What passed through something; true if anything did in any step so far, or is inside something now.

    Attributes:
        passed: Contacts that the motion of the last step passes as it is stored, as
            :attr:`.report.SolverReport.remaining`.
        crossed: Faces that edges cross at the start of the last step beyond those that each crossed at the start of the
            step before. A step that was not certified made them, or a program or another solver wrote them in between.
            0 in a first step, and in the first one of worlds after ``reset``.
        inside: Particles inside solids at the end of the last step, see :attr:`.report.SolverReport.inside`.
        steps: Steps so far in which something passed, ``totals.penetrated_steps``.
    """

    passed: int
    crossed: int
    inside: int
    steps: int

    def __bool__(self) -> bool:
        return self.steps > 0 or self.inside > 0
