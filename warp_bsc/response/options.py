"""The arguments of the collision stage as one frozen dataclass, with their checks."""

from dataclasses import dataclass
from typing import Literal, cast, get_args

import newton
import numpy as np
import warp as wp
from newton import BodyFlags
from newton.solvers import SolverBase, SolverSemiImplicit, SolverVBD, SolverXPBD

from .._arguments import (
    checked_choice,
    checked_distance,
    checked_flag,
    checked_integer,
    checked_number,
)
from .._private_names.of_newton import has_external_rigid_solver
from .state.collision_filter import CollisionFilter, checked_filter
from .state.friction import Friction
from .state.friction_table import FrictionTable, checked_table
from .state.kept_distances import KeptDistances
from .state.mesh import ModelMesh
from .tuning import CONTACTS_PER_PARTICLE, MAX_ITERATIONS, MIN_CONTACTS, SEPARATION

MAX_SUBSTEPS, MAX_CONTACTS = 1024, 2**28
MAX_FLOAT = float(np.finfo(np.float32).max)
Bodies = Literal["pushed", "separated", "ignored"]
Inversions = Literal["allowed", "reported", "prevented"]


@dataclass(frozen=True, eq=False)
class StageOptions:
    """The arguments of :class:`.solver_ccd.SolverCCD`, checked, with defaults that follow from the model.

    Coefficients are arrays; ``reads_friction`` says whether each step reads those of friction again. The default of
    ``separation`` follows from the mesh, and is None here. ``report_contacts`` is the number of contacts that are
    listed at most, 0 for none.
    """

    separation: float | None
    friction: wp.array
    friction_table: FrictionTable | None
    reads_friction: bool
    restitution: wp.array
    substeps: int
    bodies: Bodies
    distances: KeptDistances
    collision_filter: CollisionFilter | None
    inversions: Inversions
    contact_layer: bool
    max_iterations: int
    report_contacts: int
    report_worlds: bool

    @classmethod
    def of(
        cls,
        model: newton.Model,
        *,
        separation=None,
        friction=None,
        restitution=None,
        substeps=1,
        bodies="pushed",
        min_distance=None,
        particle_radius=None,
        collision_filter=None,
        inversions="allowed",
        contact_layer=True,
        max_iterations=MAX_ITERATIONS,
        report_contacts: bool | int = False,
        report_worlds=False,
    ) -> "StageOptions":
        """Returns the options, with arguments and errors as of :class:`.solver_ccd.SolverCCD`."""
        if separation is not None:
            separation = checked_distance(separation, "separation", zero=False)
            checked_number(separation, "separation", 0.0, MAX_FLOAT)
        table, friction = checked_table(friction, model)
        substeps = checked_integer(substeps, "substeps", 1, MAX_SUBSTEPS)
        return cls(
            separation=separation,
            friction=checked_friction(friction, model),
            friction_table=table,
            reads_friction=model.requires_grad or isinstance(friction, wp.array),
            restitution=checked_restitution(restitution, model),
            substeps=substeps,
            bodies=cast(Bodies, checked_choice(bodies, "bodies", get_args(Bodies))),
            distances=KeptDistances.of(model, min_distance, particle_radius),
            collision_filter=checked_filter(collision_filter, model),
            inversions=cast(Inversions, checked_choice(inversions, "inversions", get_args(Inversions))),
            contact_layer=checked_flag(contact_layer, "contact_layer"),
            max_iterations=checked_integer(max_iterations, "max_iterations", 0, MAX_ITERATIONS),
            report_contacts=checked_capacity(report_contacts, model, substeps),
            report_worlds=checked_flag(report_worlds, "report_worlds"),
        )

    def moves_bodies(self, mesh: ModelMesh, solver: SolverBase) -> bool:
        """Returns whether the response can move bodies behind a solver."""
        model = mesh.model
        if self.bodies == "ignored" or not model.body_count:
            return False
        if self.bodies == "pushed":
            integrates = isinstance(solver, SolverXPBD | SolverSemiImplicit | SolverVBD)
            if not integrates or has_external_rigid_solver(solver):
                return False
        shaped = np.unique(mesh.shape_vertices.body[mesh.shape_vertices.body >= 0])
        assert model.body_flags is not None and model.body_inv_mass is not None
        kinematic = (model.body_flags.numpy() & BodyFlags.KINEMATIC) != 0
        return bool(((model.body_inv_mass.numpy() > 0.0) & ~kinematic)[shaped].any())


def default_separation(mesh: ModelMesh) -> float:
    """Returns the distance that contacts are moved apart by default [m]: a share of the median edge length.

    It has eight bits: copies of a mesh that are turned have other lengths in the last bits, and each world of a model
    moves as it would alone.
    """
    lengths = particle_edge_lengths(mesh)
    if not lengths.any():
        return SEPARATION
    return in_eight_bits(SEPARATION * np.median(lengths))


def in_eight_bits(x: float) -> float:
    """Returns a number rounded to eight bits."""
    fraction, exponent = np.frexp(x)
    return float(np.ldexp(np.round(fraction * 256.0), exponent - 8))


def particle_edge_lengths(mesh: ModelMesh) -> np.ndarray:
    """Returns the lengths of the edges of cloth, soft bodies and ropes at rest [m], shape [n]."""
    particle_q = mesh.model.particle_q
    rest = np.zeros((0, 3)) if particle_q is None else particle_q.numpy()
    edges = mesh.edges[mesh.edges[:, 1] < mesh.model.particle_count]
    return np.linalg.norm(rest[edges[:, 1]] - rest[edges[:, 0]], axis=1)


def checked_capacity(report_contacts, model: newton.Model, substeps: int) -> int:
    """Returns the argument ``report_contacts`` as a number of contacts, 0 for none."""
    if report_contacts is True or report_contacts is False:
        capacity = substeps * max(MIN_CONTACTS, CONTACTS_PER_PARTICLE * model.particle_count)
        return min(capacity, MAX_CONTACTS) if report_contacts else 0
    return checked_integer(report_contacts, "report_contacts", 1, MAX_CONTACTS)


def checked_friction(friction, model: newton.Model) -> wp.array:
    """Returns the argument ``friction``; by default the model's ``particle_mu``."""
    friction = model.particle_mu if friction is None else friction
    limits = "at least 0, and finite in single precision"
    return _checked_coefficients(friction, "friction", (1, model.particle_count), MAX_FLOAT, limits, model)


def checked_restitution(restitution, model: newton.Model) -> wp.array:
    """Returns the argument ``restitution``; by default the model's ``soft_contact_restitution``."""
    restitution = model.soft_contact_restitution if restitution is None else restitution
    return _checked_coefficients(restitution, "restitution", (1,), 1.0, "in [0, 1]", model)


def _checked_coefficients(value, name, lengths, most, limits, model):
    """Returns a coefficient, or an array of some, as an array."""
    if not isinstance(value, wp.array):
        values = np.full(1, checked_number(value, name))
    elif value.dtype is not wp.float32 or value.ndim != 1 or len(value) not in lengths:
        allowed = " or ".join(map(str, dict.fromkeys(lengths)))
        raise ValueError(f"{name} must be a number, or an array of float32 of length {allowed}")
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
