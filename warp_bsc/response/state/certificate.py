"""The certificate of a step: who gives it, and the one function that revokes it.

A step is certified if detection found its motion, as it is stored, to be free of contacts, and of inversions
where those are prevented (:func:`certify`). What is found out later revokes it (:func:`revoke`): a position or velocity
that was not finite, a contact on an arc, and, behind a coupled solver, an end that has not been seen yet in the state
of the program.
"""

import warp as wp

from .status import Result, SolveStatus
from .structs import NOT_FINITE


@wp.func
def certify(results: wp.array[int], is_free: bool):
    """Writes whether detection found the motion to be free, to the results of a step."""
    results[Result.CERTIFIED] = wp.where(is_free, 1, 0)


@wp.func
def is_certified(results: wp.array[int]) -> bool:
    """Returns whether a step is certified, by its results."""
    return results[Result.CERTIFIED] == 1


@wp.func
def revoke(results: wp.array[int]):
    """Takes the certificate from a step, in its results."""
    results[Result.CERTIFIED] = 0


@wp.func
def revoke_if_not_finite(outcome: int, is_particle: bool, status: SolveStatus):
    """Counts a particle without a finite prediction. A step with one, or with such a vertex of a shape, is uncertified.

    What stands in its place is no result of the inner solver.
    """
    if outcome & NOT_FINITE != 0:
        revoke(status.results)
        if is_particle:
            wp.atomic_add(status.results, int(Result.NOT_FINITE), 1)
