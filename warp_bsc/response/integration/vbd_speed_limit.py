"""The speed limit of VBD's self-contact, lifted where the collision stage certifies the motion instead."""

import contextlib
from typing import TypeGuard

from newton.solvers import SolverBase, SolverVBD

_TRUNCATION = "_penetration_free_truncation"
"""Method of Newton 1.8 that cuts displacements; without self-contact it cuts none. It has no public name."""


def has_speed_limit(solver: SolverBase) -> TypeGuard[SolverVBD]:
    """Returns whether a solver is VBD with self-contact, which cuts the path of every particle, near something or not.

    The path between two detections is at most ``0.5 * dat_conservative_bound_relaxation * (margin + gap)``, and ends at
    planes between features that are near each other.
    """
    return isinstance(solver, SolverVBD) and solver.particle_enable_self_contact and hasattr(solver, _TRUNCATION)


@contextlib.contextmanager
def without_speed_limit(solver: SolverVBD):
    """Lets VBD step with the forces of its self-contact, but without its cuts of displacements.

    The solver cuts nothing where it has no self-contact, so that it has none for the time of a cut. Cuts before rigid
    shapes remain.

    Args:
        solver: A solver for which :func:`has_speed_limit` is true.
    """
    truncate = getattr(solver, _TRUNCATION)

    def truncate_without_self_contact(*arguments, **options):
        solver.particle_enable_self_contact = False
        try:
            truncate(*arguments, **options)
        finally:
            solver.particle_enable_self_contact = True

    own = _TRUNCATION in vars(solver)  # not that of its class
    setattr(solver, _TRUNCATION, truncate_without_self_contact)
    try:
        yield
    finally:
        if own:
            setattr(solver, _TRUNCATION, truncate)
        else:
            delattr(solver, _TRUNCATION)
