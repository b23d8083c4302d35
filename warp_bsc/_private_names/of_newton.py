"""Names and contracts of Newton, and what its versions differ in."""

import contextlib
import inspect
from collections.abc import Callable, Iterator
from types import ModuleType
from typing import Any, NamedTuple

import newton
import warp as wp
from newton.solvers import SolverBase, SolverStyle3D, SolverVBD
from newton.solvers.experimental.coupled import CouplingInterface

from .versions import missing, version_of, warn_if_untested

CUTS = "pos_prev_collision_detection", "particle_displacements", "_penetration_free_truncation"
"""Names of VBD that :func:`displacements_since_detection` needs."""

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


def vbd_switch(solver: SolverVBD, name: str) -> bool:
    """Returns whether VBD has switched something on, by the name of an attribute.

    Newton 1.6 lacks ``rigid_soft_enable_dat``, ``rigid_soft_contact_use_log_barrier`` and what they switch on.
    """
    return bool(getattr(solver, name, False))


def displacements_since_detection(solver: SolverVBD) -> tuple[wp.array, wp.array, Callable[[newton.State], None]]:
    """Returns where particles were at the last detection of self-contact, their displacements, and what cuts these.

    Contract: ``SolverVBD._penetration_free_truncation(state, None)`` cuts the displacements ``particle_displacements``
    from the positions ``pos_prev_collision_detection``, and writes the sums to ``state.particle_q``. That of Newton 1.6
    has the array in place of the state, and no second argument.

    Raises:
        RuntimeError: If VBD has not all of them: polish could move particles through each other.
    """
    for name in CUTS:
        if not hasattr(solver, name):
            raise missing("newton", f"SolverVBD.{name}", "polish has no use with self-contact")
    start, displacements, cut = (getattr(solver, name) for name in CUTS)
    takes_array = "particle_q_out" in inspect.signature(cut).parameters
    return start, displacements, lambda state: cut(state.particle_q) if takes_array else cut(state, None)


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


def pose_rebaseline_mask(solver: SolverVBD) -> wp.array:
    """Returns which worlds start their next step with bodies at rest where the state has them.

    Contract: ``SolverVBD`` that integrates bodies has ``_rigid_pose_rebaseline_mask``, bool, one for each world and a
    last one for bodies of no world. Where it is True, a step sets ``body_q_prev`` to the poses of the state.

    Raises:
        RuntimeError: If VBD has no such array: friction of the first step would have another gradient than result.
    """
    name = "_rigid_pose_rebaseline_mask"
    if not hasattr(solver, name):
        raise missing("newton", f"SolverVBD.{name}", "steps with bodies carry no gradients")
    return getattr(solver, name)


@contextlib.contextmanager
def with_contacts(solver: SolverBase, contacts: Any) -> Iterator[None]:
    """Gives Style3D other contacts than its own while it steps, or none: the stage resolves those.

    Style3D pushes what comes near by stiff springs, and lets layers rest farther apart than the stage does. Between
    both, layers that the stage has moved together are thrown apart. Has no effect on other solvers.

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


def has_surface_contacts(contacts: newton.Contacts) -> bool:
    """Returns whether soft contacts may be of edges and faces, and not of particles alone.

    Contract: Then ``Contacts`` has the features of meshes that they are of, ``_soft_contact_mesh_features``; else None.
    Contacts of Newton 1.6, which have no ``soft_contact_rigid_indices``, are of no features of meshes.

    Raises:
        RuntimeError: If this version of Newton has no such attribute.
    """
    name = "_soft_contact_mesh_features"
    if not hasattr(contacts, "soft_contact_rigid_indices"):
        return False
    if not hasattr(contacts, name):
        raise missing("newton", f"Contacts.{name}", "contacts of surfaces would have no gradients; pass no contacts")
    return getattr(contacts, name) is not None
