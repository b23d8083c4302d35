"""Device data of the response: the motion that comes in, the vertices and constraints worked on, and the status."""

import warp as wp

from ..detection.approach_phase import MinDistances

__all__ = [
    "DIVIDED",
    "FROZEN",
    "LOST",
    "NEVER",
    "PROJECTED",
    "TRUNCATED",
    "UNCONSTRAINED",
    "Bodies",
    "Constraints",
    "Motion",
    "MovedBodies",
    "Progress",
    "SolveStatus",
    "SweepStatus",
    "Vertices",
    "allocate_bodies",
    "allocate_constraints",
    "allocate_vertices",
    "has_final_velocity",
]

PROJECTED, DIVIDED, TRUNCATED, FROZEN, LOST, UNCONSTRAINED = (wp.constant(bit) for bit in (1, 2, 4, 8, 16, 32))
"""Bits of the outcome of a vertex or a body: constraints moved it or may change its velocity, dividing planes moved it,
its path was cut, it was left where it was, it was left there because its wanted position was not finite, it was divided
from contacts without constraints."""

NEVER = wp.constant(wp.int64(2**62))
"""The key of a vertex without a contact, see :attr:`Vertices.first_contact`."""


@wp.struct
class Bodies:
    """The rigid bodies, and the motion that the inner solver wants of them; empty if the response moves none.

    Velocities are those of centres of mass, as in ``newton.State.body_qd``.
    """

    responds: int  # 1 if the response keeps bodies apart from each other and from static shapes
    of_vertex: wp.array[int]  # body of a vertex of a shape, -1 of particles and of static shapes
    shape: wp.array[int]  # of a vertex of a shape
    shape_flags: wp.array[int]  # as in newton.Model, of shapes
    shape_collision_group: wp.array[int]
    filtered: wp.array[wp.int64]  # pairs of shapes that do not collide, the smaller times their number plus the other
    particle_count: int  # the vertices of shapes follow the particles
    position: wp.array[wp.vec3]  # of a vertex of a shape, in the frame of its body [m]
    com: wp.array[wp.vec3]  # centre of mass in the frame of the body [m]
    world: wp.array[int]
    mass: wp.array[float]  # [kg]
    inertia: wp.array[wp.mat33]  # about the centre of mass, in the frame of the body [kg m^2]
    inverse_inertia: wp.array[wp.mat33]
    inverse_mass: wp.array[float]  # [1/kg], 0 where the response cannot move the body in this step
    start: wp.array[wp.transform]  # pose at the start of the step
    end: wp.array[wp.transform]  # wanted pose at its end
    velocity: wp.array[wp.spatial_vector]  # wanted velocity at its end, linear and angular [m/s, rad/s]


@wp.struct
class MovedBodies:
    """The bodies as the response moves them; empty if it moves none."""

    pose: wp.array[wp.transform]  # at the end of the step
    velocity: wp.array[wp.spatial_vector]  # at its end
    centre: wp.array[wp.vec3d]  # of mass, where impulses act: as wanted, and in the end as moved [m]
    inverse_inertia: wp.array[wp.mat33d]  # there, in the frame of the world
    active: wp.array[int]  # active constraints of the body
    moved: wp.array[int]  # 1 if its vertices are to follow
    delta_x: wp.array2d[wp.int64]  # changes of centre and turns summed over constraints, see bodies.add_body_delta
    delta_v: wp.array2d[wp.int64]  # changes of velocity summed over constraints
    share: wp.array[wp.int64]  # of its path that is left before its contacts, in units, see bodies.find_body_shares
    first_contact: wp.array[wp.int64]  # of its vertices, see bodies.first_contact_of_body
    loose: wp.array[int]  # 1 if a contact that cuts its path has no constraint or no dividing plane
    outcome: wp.array[int]  # bits of PROJECTED, DIVIDED, TRUNCATED, FROZEN


@wp.struct
class Motion:
    """The motion that the inner solver wants, and properties of its vertices. The response only reads it."""

    x0: wp.array[wp.vec3]  # positions at the start of the step [m]
    x1: wp.array[wp.vec3]  # wanted positions at its end [m]
    velocity: wp.array[wp.vec3]  # wanted velocities at its end [m/s]
    is_lost: wp.array[int]  # 1 where what was wanted is not finite: the vertex stands
    inverse_mass: wp.array[float]  # [1/kg], 0 where a vertex cannot be moved by itself
    friction: wp.array[float]  # coefficient
    world: wp.array[int]
    bodies: Bodies
    distances: MinDistances  # that pairs are to keep; empty if they only must not touch
    interrupted: wp.array[int]  # by world, then of any: 1 where the program moved a movable particle between steps


@wp.struct
class Vertices:
    """The vertices as the response moves them."""

    x1: wp.array[wp.vec3]  # positions at the end of the step [m]
    velocity: wp.array[wp.vec3]  # velocities at its end [m/s]
    active: wp.array[int]  # active constraints that move the vertex
    particle_delta_x: wp.array2d[wp.int64]  # position changes summed over constraints, see projection.add_delta
    particle_delta_v: wp.array2d[wp.int64]  # velocity changes summed over constraints
    first_contact: wp.array[wp.int64]  # key of its first contact, see constraints.update_first_contact
    changed: wp.array[int]  # 1 if it may have other contacts than those that the last detection found
    outcome: wp.array[int]  # bits of PROJECTED, DIVIDED, TRUNCATED, FROZEN, LOST, UNCONSTRAINED
    bodies: MovedBodies


@wp.struct
class Constraints:
    """Contacts of this and earlier iterations as constraints, so that resolving one does not bring back another.

    A constraint keeps two contact points apart along a normal at the end of the step.
    """

    count: wp.array[int]
    vertices: wp.array[wp.vec4i]
    weights: wp.array[wp.vec4d]  # of the vertices in the vector from the second contact point to the first
    normal: wp.array[wp.vec3d]
    separation: wp.array[wp.float64]  # along the normal [m]
    least: wp.array[wp.float64]  # part of it that is the minimum distance [m]; empty without minimum distances
    friction: wp.array[float]  # coefficient
    kind: wp.array[int]  # of contact, plane or proximity, see constraints.VERTEX_FACE_CONTACT and following
    plane: wp.array[int]  # of a contact with a plane
    within_tolerance: wp.array[wp.bool]  # whether its contact is certain to come within the tolerance after toi
    toi: wp.array[wp.float64]  # time of impact
    approach: wp.array[wp.float64]  # over the whole step, as a share of its violation, in [0, 1]
    slow: wp.array[int]  # 1 if its elements move little, see constraints.is_slow, or RESTING, see there
    position_multiplier: wp.array[wp.vec3d]  # [kg m]
    velocity_multiplier: wp.array[wp.vec3d]  # [kg m/s]
    previous_multiplier: wp.array[wp.vec3d]  # either of the two after the last sweep, without momentum
    last_sweep: wp.array[int]  # in which it was active last
    active_set: wp.array[int]  # indices of the active constraints
    active_count: wp.array[wp.int64]


@wp.struct
class SolveStatus:
    """How far the response to a step is, and what came of it; each field is an array of one element."""

    active: wp.array[int]  # 1 while another iteration is needed
    unfinished: wp.array[int]  # 1 if the first detection leaves something to do
    iteration: wp.array[int]  # iterations of detect and project so far; from max_iterations on, all worlds divide
    rounds: wp.array[int]  # iterations of detect and project or divide so far
    certified: wp.array[int]  # 1 if the last detection was complete and found no contact
    hits: wp.array[int]  # contacts found so far by the detection in progress
    crossed_hits: wp.array[int]  # of elements that crossed at the start, found so far by the detection in progress
    first_hits: wp.array[int]  # contacts of the wanted motion
    counted: wp.array[int]  # 1 once they are all counted
    remaining: wp.array[int]  # contacts that the last detection found
    excluded: wp.array[int]  # contacts that the last detection found, of elements that crossed at the start
    newly_frozen: wp.array[int]  # vertices that this iteration froze
    undetected: wp.array[int]  # 1 if the last detection was incomplete
    body_hits: wp.array[int]  # contacts between bodies found so far by the detection in progress
    body_contacts: wp.array[int]  # contacts between bodies that the last detection found, left to the inner solver
    crossings: wp.array[int]  # edges that cross faces at the start
    projecting: wp.array[int]  # 1 if the last detection added constraints
    near: wp.array[int]  # 1 if the wanted motion ends with a pair nearer than its separation, but not in contact
    recount: wp.array[int]  # 1 if crossings may have changed since they were counted
    truncated: wp.array[int]  # 1 if a path was cut
    frozen: wp.array[int]  # 1 if a vertex was frozen
    lost: wp.array[int]  # vertices whose wanted position was not finite


@wp.struct
class SweepStatus:
    """How far the sweeps over constraints are; each field is an array of one element."""

    another: wp.array[int]  # 1 while another batch of sweeps is needed
    number: wp.array[int]  # sweeps so far


@wp.struct
class Progress:
    """How far the response to a step is."""

    status: SolveStatus
    sweep: SweepStatus
    max_iterations: int  # of detect and project; after them vertices are divided, or their paths truncated
    max_slow_iterations: int  # of these in worlds without fast contacts, see constraints.is_dividing
    slow_position_sweeps: int  # most sweeps on positions in these worlds
    slow_velocity_sweeps: int  # most sweeps on velocities in these worlds
    max_truncations: int  # iterations of that; after them vertices are frozen
    contact_iteration: wp.array[int]  # of each world, the iteration after which it last had a contact
    fast: wp.array[int]  # of each world, 1 if wanted paths of fast or pushing elements or bodies collide


@wp.func
def has_final_velocity(outcome: int) -> bool:
    """Returns whether the velocity of a vertex follows from its path, and constraints do not change it."""
    cut = outcome & (DIVIDED | TRUNCATED) == TRUNCATED
    return cut or outcome & (FROZEN | LOST | UNCONSTRAINED) != 0


def allocate_vertices(count, device) -> Vertices:
    """Returns vertices without contacts."""
    vertices = Vertices()
    for name in ("x1", "velocity"):
        setattr(vertices, name, wp.zeros(count, dtype=wp.vec3, device=device))
    for name in ("active", "changed", "outcome"):
        setattr(vertices, name, wp.zeros(count, dtype=int, device=device))
    for name in ("particle_delta_x", "particle_delta_v"):
        setattr(vertices, name, wp.zeros((count, 3), dtype=wp.int64, device=device))
    vertices.first_contact = wp.full(count, int(NEVER), dtype=wp.int64, device=device)
    return vertices


def allocate_bodies(count, device) -> MovedBodies:
    """Returns bodies that nothing has moved."""
    bodies = MovedBodies()
    for name, var in MovedBodies.vars.items():
        shape = (count, 6) if var.type.ndim == 2 else count
        setattr(bodies, name, wp.zeros(shape, dtype=var.type.dtype, device=device))
    return bodies


def allocate_constraints(capacity, device, *, keep_distances: bool = False) -> Constraints:
    """Returns constraints, none yet, with this capacity."""
    constraints = Constraints()
    for name, var in Constraints.vars.items():
        setattr(constraints, name, wp.empty(capacity, dtype=var.type.dtype, device=device))
    if not keep_distances:
        constraints.least = wp.empty(0, dtype=wp.float64, device=device)
    constraints.count = wp.zeros(1, dtype=int, device=device)
    constraints.active_count = wp.zeros(1, dtype=wp.int64, device=device)
    return constraints
