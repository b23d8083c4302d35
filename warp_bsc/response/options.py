"""Checks of the arguments of the collision stage, and defaults that follow from the model or its mesh.

Each function has the errors that :class:`.solver_ccd.SolverCCD` has; arguments and defaults stand in its signature.
"""

from collections.abc import Mapping, Sequence
from typing import Any, Literal, get_args

import newton
import numpy as np
import warp as wp
from newton.solvers import SolverBase, SolverSemiImplicit, SolverVBD, SolverXPBD

from .._arguments import (
    checked_choice,
    checked_distance,
    checked_flag,
    checked_integer,
    checked_number,
    checked_strings,
    given,
)
from .._private_names.of_newton import has_external_rigid_solver
from .state.friction import Friction
from .state.friction_table import FrictionTable, checked_table
from .state.mesh import ModelMesh, dynamic_bodies
from .tuning import CONTACTS_PER_PARTICLE, MIN_CONTACTS, SEPARATION

MAX_SUBSTEPS, MAX_CONTACTS = 1024, 2**28
MAX_FLOAT = float(np.finfo(np.float32).max)
Bodies = Literal["pushed", "separated", "ignored"]
Inversions = Literal["allowed", "reported", "prevented"]
Reported = Literal["contacts", "worlds"]


def moves_bodies(bodies: Bodies, mesh: ModelMesh, solver: SolverBase) -> bool:
    """Returns whether the response can move bodies of a mesh behind a solver that integrates."""
    model = mesh.model
    if bodies == "ignored" or not model.body_count:
        return False
    if bodies == "pushed":
        integrates = isinstance(solver, SolverXPBD | SolverSemiImplicit | SolverVBD)
        if not integrates or has_external_rigid_solver(solver):
            return False
    shaped = np.unique(mesh.shape_vertices.body[mesh.shape_vertices.body >= 0])
    return bool(dynamic_bodies(model)[shaped].any())


def default_separation(mesh: ModelMesh) -> float:
    """Returns the distance that contacts are moved apart by default [m]: a share of the median edge length.

    It has eight bits: copies of a mesh that are turned have other lengths in the last bits, and each world of a model
    moves as it would alone.
    """
    lengths = mesh.particle_edge_lengths()
    if not lengths.any():
        return SEPARATION
    return in_eight_bits(SEPARATION * np.median(lengths))


def in_eight_bits(x: float) -> float:
    """Returns a number rounded to eight bits."""
    fraction, exponent = np.frexp(x)
    return float(np.ldexp(np.round(fraction * 256.0), exponent - 8))


def checked_separation(separation: float | None) -> float | None:
    """Returns the argument ``separation``; None if it follows from the mesh, see :func:`default_separation`."""
    if separation is None:
        return None
    distance = checked_distance(separation, "separation", zero=False)
    return checked_number(distance, "separation", 0.0, MAX_FLOAT)


def checked_report(
    report: Any, model: newton.Model, substeps: int = 1, *, choices: Sequence[str] = get_args(Reported)
) -> tuple[int, bool]:
    """Returns the argument ``report``: contacts to list at most, 0 for none, and whether to count by world."""
    names = [checked_choice(name, "report", choices) for name in checked_strings(report, "report")]
    values = dict(report) if isinstance(report, Mapping) else dict.fromkeys(names, True)
    contacts, worlds = values.get("contacts", False), values.get("worlds", False)
    if contacts is True or contacts is False:
        most = min(substeps * max(MIN_CONTACTS, CONTACTS_PER_PARTICLE * model.particle_count), MAX_CONTACTS)
        contacts = most if contacts else 0
    else:
        contacts = checked_integer(contacts, "report['contacts']", 1, MAX_CONTACTS)
    return contacts, checked_flag(worlds, "report['worlds']")


def checked_friction(friction: Any, model: newton.Model) -> tuple[wp.array, FrictionTable | None, bool]:
    """Returns the argument ``friction``: coefficients of particles, those of pairs, and whether each step reads them.

    By default the coefficient is the model's ``particle_mu``.
    """
    table, friction = checked_table(friction, model)
    reads = model.requires_grad or isinstance(friction, wp.array)
    friction = model.particle_mu if friction is None else friction
    limits = "at least 0, and finite in single precision"
    lengths = 1, model.particle_count
    return _checked_coefficients(friction, "friction", lengths, MAX_FLOAT, limits, model), table, reads


def checked_restitution(restitution, model: newton.Model) -> wp.array:
    """Returns the argument ``restitution``; by default the model's ``soft_contact_restitution``."""
    restitution = model.soft_contact_restitution if restitution is None else restitution
    return _checked_coefficients(restitution, "restitution", (1,), 1.0, "in [0, 1]", model)


def _checked_coefficients(value, name, lengths, most, limits, model):
    """Returns a coefficient, or an array of some, as an array."""
    if isinstance(value, list | tuple | np.ndarray):
        raise TypeError(f"{name} must be a number, or a Warp array of float32, not {given(value)}")
    if not isinstance(value, wp.array):
        values = np.full(1, checked_number(value, name))
    elif value.dtype is not wp.float32 or value.ndim != 1 or len(value) not in lengths:
        allowed = " or ".join(map(str, dict.fromkeys(lengths)))
        raise ValueError(f"{name} must be a number, or a Warp array of float32 of length {allowed}")
    else:
        values = value.numpy()
    if not ((values >= 0.0) & (values <= most)).all():
        raise ValueError(f"{name} must be {limits}, not {value!r}")
    return value if isinstance(value, wp.array) else wp.array(values, dtype=float, device=model.device)


def friction_of(
    mesh: ModelMesh, of_particles: wp.array, of_shapes: wp.array | None = None, table: FrictionTable | None = None
) -> Friction:
    """Returns the coefficients of vertices and of infinite planes, by default those of the model, and of pairs.

    Raises:
        ValueError: If the friction of a shape is negative or no number.
    """
    model = mesh.model
    if of_shapes is None:
        of_shapes = model.shape_material_mu
    if of_shapes is None:
        of_shapes = wp.zeros(0, dtype=float, device=mesh.device)
    assert of_shapes is not None
    values = of_shapes.numpy()
    for shape in np.union1d(mesh.shape_vertices.shape, mesh.planes.shape):
        if not values[shape] >= 0.0:
            raise ValueError(f"shape {shape} ({model.shape_label[shape]!r}) has friction {values[shape]}")
    return Friction(mesh, of_particles, of_shapes, table)
