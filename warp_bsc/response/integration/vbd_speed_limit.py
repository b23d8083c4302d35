"""The speed limit of VBD's self-contact, lifted where the collision stage certifies the motion instead."""

import contextlib
from typing import TypeGuard

from newton.solvers import SolverBase, SolverVBD

from ..._private_names.of_newton import vbd_truncation, vbd_truncation_replaced


def has_self_contact(solver: SolverBase) -> TypeGuard[SolverVBD]:
    """Returns whether a solver is VBD with self-contact."""
    return isinstance(solver, SolverVBD) and solver.particle_enable_self_contact


def has_speed_limit(solver: SolverBase) -> TypeGuard[SolverVBD]:
    """Returns whether a solver is VBD with self-contact, whose limit can be lifted; warns if this Newton forbids it.

    Self-contact cuts the path of every particle, near something or not. The path between two detections is at most
    ``0.5 * dat_conservative_bound_relaxation * (margin + gap)``, and ends at planes between features that are near each
    other.
    """
    return has_self_contact(solver) and vbd_truncation(solver) is not None


@contextlib.contextmanager
def without_speed_limit(solver: SolverVBD):
    """Lets VBD step with the forces of its self-contact, but without its cuts of displacements.

    The solver cuts nothing where it has no self-contact, so that it has none for the time of a cut. Cuts before rigid
    shapes remain.

    Args:
        solver: A solver for which :func:`has_speed_limit` is true.
    """
    truncate = vbd_truncation(solver)
    assert truncate is not None

    def truncate_without_self_contact(*arguments, **options):
        solver.particle_enable_self_contact = False
        try:
            truncate(*arguments, **options)
        finally:
            solver.particle_enable_self_contact = True

    with vbd_truncation_replaced(solver, truncate_without_self_contact):
        yield
