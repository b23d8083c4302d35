"""Names and contracts of Newton."""

import contextlib
import copy
from collections.abc import Callable, Iterator, Sequence
from types import ModuleType
from typing import Any

import newton
import warp as wp
from newton.solvers import SolverBase, SolverStyle3D, SolverVBD

from .._warnings import warn_caller
from .versions import missing, version_of, warn_if_untested

_TRUNCATION = "_penetration_free_truncation"
_CUTS = "pos_prev_collision_detection", "particle_displacements", _TRUNCATION
_OVERFLOW = "_soft_contact_source_overflow"


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


def vbd_truncation(solver: SolverVBD) -> Callable[..., None] | None:
    """Returns the method by which VBD cuts displacements of particles; None, with a warning, if it is gone.

    Contract: ``SolverVBD._penetration_free_truncation`` makes all cuts by self-contact, see also
    :func:`displacements_since_detection`. It reads ``particle_enable_self_contact`` when it is called, and without
    self-contact it cuts before rigid shapes only.

    Without the method, or what it cuts, the speed limit of VBD's self-contact stays, and ``report.speed_limit_lifted``
    is False.
    """
    for name in _CUTS:
        if not hasattr(solver, name):
            warn_caller(
                f"newton {newton.__version__} has no SolverVBD.{name}, which warp-bsc replaces: "
                "self-contact of VBD limits the speed of all particles"
            )
            return None
    return getattr(solver, _TRUNCATION)


@contextlib.contextmanager
def vbd_truncation_replaced(solver: SolverVBD, truncate: Callable[..., None]) -> Iterator[None]:
    """Replaces the method of :func:`vbd_truncation` in one solver.

    Contract: VBD looks the method up in the solver at each call, so that an attribute of the solver takes its place.
    """
    replaced = vars(solver).get(_TRUNCATION)
    setattr(solver, _TRUNCATION, truncate)
    try:
        yield
    finally:
        if replaced is None:
            delattr(solver, _TRUNCATION)
        else:
            setattr(solver, _TRUNCATION, replaced)


def displacements_since_detection(solver: SolverVBD) -> tuple[wp.array, wp.array, Callable[..., None]]:
    """Returns where particles were at the last detection of self-contact, their displacements, and what cuts these.

    Contract: ``SolverVBD._penetration_free_truncation(state, None)`` cuts the displacements ``particle_displacements``
    from the positions ``pos_prev_collision_detection``, and writes the sums to ``state.particle_q``.

    Raises:
        RuntimeError: If VBD has not all of them: polish could move particles through each other.
    """
    for name in _CUTS:
        if not hasattr(solver, name):
            raise missing("newton", f"SolverVBD.{name}", "polish has no use with self-contact")
    start, displacements, cut = (getattr(solver, name) for name in _CUTS)
    return start, displacements, cut


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


def may_allocate(solver: SolverBase) -> bool:
    """Returns whether a step of a solver may allocate memory, which the body of a condition in a CUDA graph must not.

    Contract: ``SolverVBD``, and ``SolverStyle3D`` on a CPU, allocate nothing in a step unless they have a collision
    pipeline of their own, or :func:`has_room` is false. On a GPU the inner products of Style3D allocate. Every other
    solver, and every class derived from these, counts as one that allocates. Where the contract is broken, Warp raises
    an error when the step is captured.
    """
    allocates_nothing = type(solver) is SolverVBD or (type(solver) is SolverStyle3D and solver.device.is_cpu)
    return not allocates_nothing or solver.collision_pipeline is not None


def has_room(solver: SolverBase, contacts: newton.Contacts | None) -> bool:
    """Returns whether the buffers of a solver suffice for contacts, so that a step with them need not allocate larger.

    Contract: ``SolverVBD`` that integrates bodies has the array ``body_body_contact_penalty_k``, one row for each rigid
    contact, and every ``SolverVBD`` has ``body_particle_contact_penalty_k``, one for each soft contact. A step with
    contacts of which there may be more replaces these, and others of their size. Where they are gone, there is no room.
    """
    if contacts is None or not isinstance(solver, SolverVBD):
        return True
    capacities = {"body_particle_contact_penalty_k": contacts.soft_contact_max}
    if solver.model.body_count and not has_external_rigid_solver(solver):
        capacities["body_body_contact_penalty_k"] = contacts.rigid_contact_max
    return all(len(getattr(solver, name, ())) >= capacity for name, capacity in capacities.items())


@contextlib.contextmanager
def iterations_shared(solver: SolverBase, substeps: int, least: int) -> Iterator[None]:
    """Shares the iterations of a solver out to the substeps of a step, each of which gets at least a number of them.

    Contract: VBD reads the attribute ``iterations`` in each step, Style3D the same attribute of ``config``.
    """
    if isinstance(solver, SolverStyle3D):
        holder = solver.config
    elif isinstance(solver, SolverVBD):
        holder = solver
    else:
        yield
        return
    iterations = holder.iterations
    holder.iterations = min(iterations, max(least, -(-iterations // substeps)))
    try:
        yield
    finally:
        holder.iterations = iterations


def attributes_of(solver: SolverBase) -> dict[str, Any]:
    """Returns the attributes of a solver by name, in the dictionary that holds them.

    Contract: All that a step changes of a solver is in this dictionary: Warp arrays, in place, and other attributes, by
    assignment. To write the old values back repeats a step.

    Raises:
        RuntimeError: If the solver has slots, which this dictionary lacks: they would not be restored.
    """
    slots = {name for base in type(solver).__mro__ for name in vars(base).get("__slots__", ())}
    if slots - {"__dict__", "__weakref__"}:
        message = f"{type(solver).__name__} has slots, {', '.join(sorted(slots))}, which substeps cannot restore"
        raise RuntimeError(f"{message}: omit substeps")
    return vars(solver)


@contextlib.contextmanager
def with_contacts(solver: SolverBase, contacts: Any) -> Iterator[None]:
    """Gives Style3D other contacts than its own while it steps, or none: the stage resolves those.

    Style3D pushes what comes near by stiff springs, and lets layers rest farther apart than the stage does. Between
    both, layers that the stage has moved together are thrown apart. Has no effect on other solvers.

    Contract: ``SolverStyle3D.collision`` holds these contacts, see :class:`.substeps.style3d_contacts.Style3DContacts`
    for its methods; None disables them.

    Raises:
        RuntimeError: If Style3D has no such attribute.
    """
    if not isinstance(solver, SolverStyle3D):
        yield
        return
    if not hasattr(solver, "collision"):
        raise missing("newton", "SolverStyle3D.collision", "cloth would rest in two places; omit substeps")
    own, solver.collision = solver.collision, contacts
    try:
        yield
    finally:
        solver.collision = own


def soft_contact_arrays(contacts: newton.Contacts, names: Sequence[str]) -> dict[str, wp.array]:
    """Returns arrays of soft contacts by name, those that contacts have.

    Contract: Arrays are attributes ``soft_contact_*``. ``features``, the features of meshes that contacts are of, are
    ``_soft_contact_mesh_features``, None if contacts are of particles alone. No solver reads other arrays of soft
    contacts: these would no longer belong to the contacts that are left.

    Raises:
        RuntimeError: If this version of Newton has not all of them.
    """
    arrays = {}
    for name in names:
        attribute = _soft_contact_attribute(name)
        if not hasattr(contacts, attribute):
            raise missing("newton", f"Contacts.{attribute}", "contacts cannot be left out in steps with substeps")
        arrays[name] = getattr(contacts, attribute)
    return {name: array for name, array in arrays.items() if array is not None}


def _soft_contact_attribute(name: str) -> str:
    return "_soft_contact_mesh_features" if name == "features" else f"soft_contact_{name}"


def soft_contact_counters(contacts: newton.Contacts, counters: wp.array) -> tuple[wp.array, wp.array]:
    """Returns the number of soft contacts and whether some were dropped, views of an array like ``contact_counters``.

    Contract: ``Contacts.contact_counters`` holds the number of contacts between bodies, that of soft contacts, an
    overflow of no interest here, and ``_soft_contact_source_overflow``: 1 if soft contacts did not fit.

    Raises:
        RuntimeError: If this version of Newton has other counters.
    """
    array = contacts.contact_counters
    for name, i in {"rigid_contact_count": 0, "soft_contact_count": 1, _OVERFLOW: 3}.items():
        view = getattr(contacts, name, None)
        if view is None or array.dtype is not wp.int32 or len(array) <= i or view.ptr != array[i : i + 1].ptr:
            counter = f"Contacts.{name} as number {i} of Contacts.contact_counters"
            raise missing("newton", counter, "contacts cannot be left out in steps with substeps")
    return counters[1:2], counters[3:4]


def contacts_with(contacts: newton.Contacts, counters: wp.array, arrays: dict[str, wp.array]) -> newton.Contacts:
    """Returns a copy of contacts with other counters and arrays of soft contacts; everything else is shared.

    Contract: Solvers can read a shallow copy of ``newton.Contacts``.

    Args:
        contacts: The contacts, which stay as they are.
        counters: An array like ``contact_counters``, see :func:`soft_contact_counters`.
        arrays: Arrays by name, as of :func:`soft_contact_arrays`.
    """
    packed = copy.copy(contacts)
    packed.contact_counters, packed.rigid_contact_count = counters, counters[0:1]
    packed.soft_contact_count = counters[1:2]
    setattr(packed, _OVERFLOW, counters[3:4])
    for name, array in arrays.items():
        setattr(packed, _soft_contact_attribute(name), array)
    return packed
