"""Arrays of the response as structs: the predicted motion, the vertices and bodies that it moves, and constraints."""

from collections.abc import Iterable
from enum import IntEnum

import warp as wp

from ..._private_names.of_warp import struct_type
from ...detection.narrow.rules.approach import MinDistances
from ...kernels.pairs import PairFilter


class ContactKind(IntEnum):
    """Kinds of contacts and of constraints."""

    VERTEX_FACE = 0
    EDGE_EDGE = 1
    PLANE = 2
    VERTEX_FACE_PROXIMITY = 3
    EDGE_EDGE_PROXIMITY = 4
    NONE = 5  # of a contact that has no constraint


class Pace(IntEnum):
    """How fast the elements of a constraint are for their size."""

    FAST = 0
    SLOW = 1  # one direction holds for the whole step
    RESTING = 2  # of slow proximities at rest, which are projected before they are divided


PROJECTED, DIVIDED, TRUNCATED, FROZEN, NOT_FINITE, UNCONSTRAINED = (wp.constant(bit) for bit in (1, 2, 4, 8, 16, 32))
"""Bits of the outcome of a vertex or a body: constraints moved it or may change its velocity; dividing planes moved it;
its path was cut; it was frozen at its start; it stayed there because its prediction was not finite; its velocity is
that of its path, as it was divided from contacts without constraints, or moved to prevent inversions."""
UNCERTIFIED, INVALID = (wp.constant(bit) for bit in (64, 128))
"""Bits of the outcome of a vertex in a report: the certificate lacks it; and all elements that have it."""
NEVER = wp.constant(wp.int64(2**63 - 1))
"""In place of the packed contact of a vertex without one, see :attr:`Vertices.first_contact`."""
SUMS, MOMENTS, MASS, HELD = (wp.constant(i) for i in (15, 11, 3, 14))
"""Columns of the sums of a world: their number; the number of moments, which are mass, mass by position, its six second
moments, and mass by the squared change of velocity; where they begin, behind the torque; and the column that is not 0
if a contact is with something that is not free."""


@wp.struct
class Incidence:
    """The elements that each element belongs to: those of element ``i`` are ``items[first[i]:first[i + 1]]``."""

    first: wp.array[int]
    items: wp.array[int]


@wp.struct
class Connectivity:
    """The elements of a mesh, and the elements that each belongs to."""

    faces: wp.array2d[int]
    edges: wp.array2d[int]
    vertex_edges: Incidence
    edge_faces: Incidence


@wp.struct
class Bodies:
    """The rigid bodies and their predicted motion; empty if the response moves none.

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
    end: wp.array[wp.transform]  # predicted pose at its end
    velocity: wp.array[wp.spatial_vector]  # predicted velocity at its end, linear and angular [m/s, rad/s]


@wp.struct
class MovedBodies:
    """The bodies as the response moves them; empty if it moves none."""

    pose: wp.array[wp.transform]  # at the end of the step
    velocity: wp.array[wp.spatial_vector]  # at its end
    centre: wp.array[wp.vec3d]  # of mass, where impulses act: as predicted, and in the end as moved [m]
    inverse_inertia: wp.array[wp.mat33d]  # there, in the frame of the world
    active: wp.array[int]  # active constraints of the body
    moved: wp.array[int]  # 1 if its vertices follow
    delta_x: wp.array2d[wp.int64]  # changes of centre and turns summed over constraints, see bodies.add_body_delta
    delta_v: wp.array2d[wp.int64]  # changes of velocity summed over constraints
    share: wp.array[wp.int64]  # of its path that remains before its contacts, in units, see division.find_body_shares
    loose: wp.array[int]  # 1 if a contact that cuts its path has no constraint or no dividing plane
    outcome: wp.array[int]  # bits of PROJECTED, DIVIDED, TRUNCATED, FROZEN


@wp.struct
class Materials:
    """Materials of vertices and infinite planes, and friction by pair of them; empty without a friction table."""

    friction: wp.array2d[float]  # coefficient of two materials, the smaller first; negative if they have none
    of_vertex: wp.array[int]
    of_plane: wp.array[int]


@wp.struct
class Motion:
    """The predicted motion, and properties of its vertices. The response only reads it."""

    x0: wp.array[wp.vec3]  # positions at the start of the step [m]
    x1: wp.array[wp.vec3]  # predicted positions at its end [m]
    velocity: wp.array[wp.vec3]  # predicted velocities at its end [m/s]
    is_not_finite: wp.array[int]  # 1 where the prediction is not finite: the vertex stays at its start
    inverse_mass: wp.array[float]  # [1/kg], 0 where a vertex cannot be moved by itself
    friction: wp.array[float]  # coefficient
    materials: Materials
    world: wp.array[int]
    bodies: Bodies
    distances: MinDistances  # of pairs; empty if pairs only must not touch
    pair_filter: PairFilter  # groups and masks of vertices; empty if no pair is left out
    interrupted: wp.array[int]  # by world, then of any: 1 where the program moved a movable particle between steps


@wp.struct
class Vertices:
    """The vertices as the response moves them."""

    x1: wp.array[wp.vec3]  # positions at the end of the step [m]
    velocity: wp.array[wp.vec3]  # velocities at its end [m/s]
    active: wp.array[int]  # active constraints that move the vertex
    particle_delta_x: wp.array2d[wp.int64]  # position changes summed over constraints, see sweeps.add_delta
    particle_delta_v: wp.array2d[wp.int64]  # velocity changes summed over constraints
    first_contact: wp.array[wp.int64]  # see first_contact.packed_contact
    frozen_lately: wp.array[int]  # steps for which it counts as one that was, see STUCK_STEPS
    changed: wp.array[int]  # 1 if it may have other contacts than those that the last detection found
    outcome: wp.array[int]  # bits of PROJECTED, DIVIDED, TRUNCATED, FROZEN, NOT_FINITE, UNCONSTRAINED
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
    min_distance: wp.array[wp.float64]  # part of it that the pair must keep [m]; empty without minimum distances
    friction: wp.array[float]  # coefficient
    kind: wp.array[int]  # a ContactKind
    plane: wp.array[int]  # of a contact with a plane
    toi: wp.array[wp.float64]  # time of impact
    approach: wp.array[wp.float64]  # over the whole step, as a share of its violation, in [0, 1]
    pace: wp.array[int]  # a Pace
    position_multiplier: wp.array[wp.vec3d]  # [kg m]
    velocity_multiplier: wp.array[wp.vec3d]  # [kg m/s]
    resisted: wp.array[wp.float64]  # impulse of its push in positions if that is resisted, see sweeps.resisted_push
    previous_multiplier: wp.array[wp.vec3d]  # either of the two after the last sweep, without momentum
    last_sweep: wp.array[int]  # in which it was active last, or NEVER_SWEPT
    active_set: wp.array[int]  # indices of the active constraints; if worlds are swept apart, from ``first`` of each
    active_count: wp.array[wp.int64]  # of each world that is swept apart, or of all
    of_worlds: wp.array[int]  # indices of all constraints, world by world; empty if they are not swept apart
    first: wp.array[int]  # of a world that is swept apart, where its constraints begin in of_worlds
    number: wp.array[int]  # of its constraints, then of those in all worlds


@wp.struct
class Step:
    """A mesh, its motion, and what the response moves and knows of it, as kernels take them."""

    mesh: Connectivity
    motion: Motion
    vertices: Vertices
    constraints: Constraints
    separation: wp.float64  # distance that projection moves contacts apart [m]
    restitution: wp.array[float]  # share of the approaching velocity that comes back, one number
    dt: wp.float64  # length of the step whose velocities are projected [s]


@wp.func
def constraint_count(step: Step) -> int:
    """Returns the number of constraints; those that did not fit are counted, but are not there."""
    return wp.min(step.constraints.count[0], step.constraints.vertices.shape[0])


@wp.func
def constraint_at(step: Step, place: int) -> int:
    """Returns the index of the constraint at a place of the list by worlds, which is the place if there is no list."""
    if step.constraints.of_worlds:
        return step.constraints.of_worlds[place]
    return place


@wp.struct
class Tetrahedra:
    """The tetrahedra of soft bodies whose inversions are looked for."""

    corners: wp.array2d[int]  # particles, shape [n, 4]
    first_inversion: wp.array[wp.int64]  # of particles, see first_contact.packed_contact; empty if none is prevented


@wp.func
def body_of(motion: Motion, vertex: int) -> int:
    """Returns the body of a vertex of a shape; -1 if it has none, or if the response moves no bodies."""
    if motion.bodies.of_vertex:
        return motion.bodies.of_vertex[vertex]
    return -1


@wp.func
def can_move(motion: Motion, body: int) -> bool:
    """Returns whether the response can move a body in this step, -1 for none."""
    if body < 0 or not motion.bodies.inverse_mass:
        return False
    return motion.bodies.inverse_mass[body] > 0.0


@wp.func
def has_final_velocity(outcome: int) -> bool:
    """Returns whether the velocity of a vertex follows from its path, and constraints do not change it."""
    cut = outcome & (DIVIDED | TRUNCATED) == TRUNCATED
    return cut or outcome & (FROZEN | NOT_FINITE | UNCONSTRAINED) != 0


NO_NODE = wp.constant(-1)
"""In place of a node: the end of a list."""
NOT_PLACED, PLACED, CUT_SHORT = (wp.constant(i) for i in (0, 1, 2))
"""Of a vertex: it has no wanted end; it has one; projection found it no position above its planes but on its way."""


@wp.struct
class DividingPlanes:
    """Planes that vertices stay above or below, and a list for each vertex of those that concern it.

    The planes of two elements have four vertices, so that there are four nodes for each. A node is the number
    ``8 plane + 2 corner + side``, side 1 of a vertex below, as this is what its vertex asks for: less to read where all
    is scattered in memory. These planes move, see :mod:`.solve.plane_placement`.
    """

    count: wp.array[int]  # of planes, whether they fit or not
    vertices: wp.array[wp.vec4i]  # of both elements, -1 for none
    place: wp.array[wp.vec4d]  # the normal, then the coordinate along it [m]
    distance: wp.array[wp.float64]  # of both elements along the normal at the start, without that to keep [m]
    half: wp.array[wp.float64]  # of the minimum distance of both elements [m]; empty without minimum distances
    margin: wp.array[float]  # by which projection exceeds it [m]
    split: wp.array[wp.int8]  # the first corner that stays below
    next: wp.array[int]  # of half of a node, the next one in the list of the same vertex, or NO_NODE
    first: wp.array[int]  # node of a vertex, or NO_NODE
    listed: wp.array[int]  # particles that have planes
    listed_count: wp.array[int]  # their number
    lacks: wp.array[int]  # of a vertex, 1 if it has contacts without a plane
    placed: wp.array[int]  # of a vertex: NOT_PLACED, PLACED or CUT_SHORT
    wanted: wp.array[wp.vec3]  # where a vertex is to end, as near as its planes let it come [m]
    reached: wp.array[wp.vec3]  # an end of its path above its planes [m]
    moved: wp.array[int]  # of a world, the pass after which a vertex had moved last
    missed: wp.array[int]  # of a world, the pass after which a vertex was last not where it is wanted


def add_zeros(struct, names: Iterable[str], size: int | tuple[int, ...], device: wp.Device) -> None:
    """Sets arrays of a struct, given by name, to zeros of a size."""
    for name in names:
        dtype = struct_type(struct).vars[name].type.dtype
        setattr(struct, name, wp.zeros(size, dtype=dtype, device=device))


def allocate(of_type: type, size: int, device: wp.Device, **sizes):
    """Returns a struct whose arrays are zeros of a size, those named in ``sizes`` of their own sizes."""
    struct = of_type()
    for name, var in of_type.vars.items():
        if hasattr(var.type, "dtype"):  # not a struct
            add_zeros(struct, [name], sizes.get(name, size), device)
    return struct
