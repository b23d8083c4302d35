"""Names and contracts of Newton, and what its versions differ in."""

import contextlib
from collections.abc import Iterator
from types import ModuleType
from typing import Any, NamedTuple

import newton
import warp as wp
from newton.solvers import SolverBase, SolverStyle3D, SolverVBD
from newton.solvers.experimental.coupled import CouplingInterface

from .versions import missing, version_of, warn_if_untested

COUPLERS_DECLARE_RESTARTS = hasattr(CouplingInterface, "coupling_notify_iteration_restarts")
"""Whether couplers say, once and before any other hook, whether they restart steps; Newton before 1.8 does not."""

SHAPES_CHANGE = newton.ModelFlags.SHAPE_PROPERTIES | getattr(newton.ModelFlags, "SHAPE_TYPE_AND_SOURCE", 0)
"""Flags of changes of shapes; in Newton 1.6 they keep their type and source."""


def replace_name(module: ModuleType, name: str, value: object) -> None:
    """Replaces a function or a class of a module of Newton, for all that look it up there afterwards.

    Contract: Newton's examples call ``newton.examples.run``, download through ``newton.utils.download_asset`` and
    ``newton.examples.download_external_git_folder``, and make the solvers that :mod:`newton.solvers` names.

    Raises:
        RuntimeError: If the module does not have the name, so that the replacement would have no effect.
    """
    warn_if_untested("newton")
    if not hasattr(module, name):
        raise RuntimeError(f"Newton {version_of('newton')} has no {module.__name__}.{name}, which warp-bsc replaces")
    setattr(module, name, value)


def check_observables(solver: SolverBase, observables: Any, contacts: newton.Contacts | None) -> None:
    """Raises what Newton raises if a step is to write observables that a solver does not have.

    Newton 1.6 has no observables.

    Raises:
        TypeError: If it is to write any, and this version of Newton has none.
    """
    if hasattr(SolverBase, "validate_observables"):
        solver.validate_observables(observables, contacts)
    elif observables is not None:
        raise TypeError(f"observables: Newton {version_of('newton')} has none")


def make_style3d(model: newton.Model, iterations: int) -> SolverStyle3D:
    """Returns Style3D with a number of iterations, which before Newton 1.8 is an argument of its own."""
    if not hasattr(SolverStyle3D, "Config"):
        return SolverStyle3D(model, iterations=iterations)
    return SolverStyle3D(model, config=SolverStyle3D.Config(iterations=iterations))


class AttachmentArrays(NamedTuple):
    """Attachments of particles to points of bodies, arrays of one length.

    Attributes:
        particle: Particle of each, int32.
        body: Body of each, int32.
        body_point: Point in the frame of the body [m], vec3.
        stiffness: Stiffness [N/m], float32; infinite if the particle is held.
        damping: Damping [N s/m], float32.
        enabled: Whether it acts, bool.
    """

    particle: wp.array
    body: wp.array
    body_point: wp.array
    stiffness: wp.array
    damping: wp.array
    enabled: wp.array


def attachment_arrays(model: newton.Model) -> AttachmentArrays | None:
    """Returns the attachments of particles to bodies, None if there are none. Newton 1.6 has none."""
    if not getattr(model, "attachment_particle_body_count", 0):
        return None
    return AttachmentArrays(*(getattr(model, f"attachment_particle_body_{name}") for name in AttachmentArrays._fields))


def has_external_rigid_solver(solver: SolverBase) -> bool:
    """Returns whether a solver is VBD that leaves bodies to another solver.

    Contract: ``SolverVBD`` keeps its argument of this name as the attribute ``integrate_with_external_rigid_solver``.

    Raises:
        RuntimeError: If VBD does not: the stage would push bodies that VBD does not move.
    """
    name = "integrate_with_external_rigid_solver"
    if isinstance(solver, SolverVBD) and not hasattr(solver, name):
        raise missing("newton", f"SolverVBD.{name}", "the stage cannot tell whether VBD moves bodies")
    return getattr(solver, name, False)


def body_q_prev(solver: SolverBase) -> wp.array | None:
    """Returns the poses from which a solver takes the velocities of bodies in its next step, None if it has none.

    Contract: ``SolverVBD`` that integrates bodies has the array ``body_q_prev``, which it reads at the start of a step.

    Raises:
        RuntimeError: If VBD integrates bodies and has no such array: pushed bodies would keep their old velocities.
    """
    poses = getattr(solver, "body_q_prev", None)
    integrates = isinstance(solver, SolverVBD) and solver.model.body_count > 0 and not has_external_rigid_solver(solver)
    if poses is None and integrates:
        raise missing("newton", "SolverVBD.body_q_prev", "the stage cannot push bodies; pass bodies that it leaves")
    return poses


@contextlib.contextmanager
def with_contacts(solver: SolverBase, contacts: Any) -> Iterator[None]:
    """Gives Style3D other contacts than its own while it steps, or none: the stage resolves those.

    Style3D pushes what comes near by stiff springs, and lets sheets rest farther apart than the stage does. Between
    both, sheets that the stage has moved together are thrown apart. Has no effect on other solvers.

    Contract: ``SolverStyle3D.collision`` holds these contacts, whose methods are those of :class:`.Style3DContacts`;
    None disables them.

    Raises:
        RuntimeError: If Style3D has no such attribute.
    """
    if not isinstance(solver, SolverStyle3D):
        yield
        return
    if not hasattr(solver, "collision"):
        raise missing("newton", "SolverStyle3D.collision", "cloth would rest in two places")
    own, solver.collision = solver.collision, contacts
    try:
        yield
    finally:
        solver.collision = own
