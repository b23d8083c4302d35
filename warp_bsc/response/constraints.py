"""Contacts as constraints on the ends of paths, collected from detections; :mod:`.projection` solves them."""

import warp as wp

from ..detection.settings import Count
from ..kernels.pipeline.pairs import vertices_of_pair
from ..kernels.pipeline.queues import is_filled
from ..kernels.signs import FREE
from .step_record import History

__all__ = [
    "ACTIVE",
    "CERTIFIED",
    "EDGE_EDGE_CONTACT",
    "FIRST_HITS",
    "FROZEN_NOW",
    "HITS",
    "NEAR_EDGES",
    "NEAR_VERTEX_FACE",
    "NEVER",
    "ON_PLANE",
    "PROJECTED",
    "PROJECTIONS",
    "REMAINING",
    "ROUND",
    "SHARE",
    "STEER",
    "TIMES",
    "TRUNCATIONS",
    "UNDETECTED",
    "VERTEX_FACE_CONTACT",
    "Constraints",
    "Contacts",
    "Progress",
    "Vertices",
    "add_constraint",
    "add_contact",
    "collect_contacts",
    "contact_vertices",
    "contact_weights",
    "feasible",
    "feasible_in_contact",
    "gap",
    "is_projecting",
    "is_slow",
    "longest_path",
    "relative",
    "to_double",
    "to_single",
    "touch_in",
    "urgency_of",
    "widened",
]

PROJECTIONS = 40
"""Rounds of projection, after which what still collides is truncated."""
TRUNCATIONS = wp.constant(8)
"""Rounds of truncation, after which what still collides stands still."""
SHARE = wp.constant(wp.float64(0.9))
"""Which part of the way to its first contact a truncated vertex goes."""
PROJECTED = wp.constant(1)
"""Bit of what has been done to a vertex."""

ACTIVE, ROUND, CERTIFIED, HITS, FIRST_HITS, REMAINING, FROZEN_NOW, UNDETECTED, STEER = (
    wp.constant(i) for i in range(9)
)
"""Places in the array that steers the rounds: whether there is another, how many there were, whether the motion is
certified, contacts counted so far in a detection, those of the first, those of the last, how many vertices this round
has frozen, and whether a detection was incomplete; and how many places there are."""

VERTEX_FACE_CONTACT, EDGE_EDGE_CONTACT, ON_PLANE, NEAR_VERTEX_FACE, NEAR_EDGES = (wp.constant(i) for i in range(5))
"""What a constraint is of: contacts of the two kinds, a vertex and a half-space, near pairs of the two kinds."""

TIMES = wp.constant(wp.float64(2.0**30))
"""Units of time in a step, in which times are integers."""
NEVER = wp.constant(wp.int64(2**62))
"""No time."""

_WIDENING = wp.constant(wp.float64(1.25))
"""Factor by which the separation of new contacts grows from round to round: what is in a jam moves further."""
_WIDEST = wp.constant(wp.float64(5.0))
"""How often the separation it grows to at most."""
_SLOW = wp.constant(wp.float64(0.5))
"""How far what is slow moves at most, as a share of the shortest side of the elements."""
_RECOVERY = wp.constant(wp.float64(0.25))
"""How much of the separation that slow ones lack they are given in a step, as a share of how far they wanted to move:
what is given more than it falls in a step hops, and slides meanwhile."""
_CONTACTS = wp.constant(int(Count.CONTACTS))
_ZERO = wp.constant(wp.float64(0.0))
_ONE = wp.constant(wp.float64(1.0))

_KERNEL = {"enable_backward": False}


@wp.struct
class Vertices:
    """The vertices of a motion, and what contacts do to them."""

    x0: wp.array[wp.vec3]
    x1: wp.array[wp.vec3]
    velocity: wp.array[wp.vec3]
    wanted_x1: wp.array[wp.vec3]  # before any contact
    wanted_velocity: wp.array[wp.vec3]
    inverse_mass: wp.array[float]
    friction: wp.array[float]
    world: wp.array[int]
    active: wp.array[int]  # how many active constraints it has
    displacement: wp.array2d[wp.int64]  # from where it wanted to be, summed over its constraints
    velocity_change: wp.array2d[wp.int64]
    time: wp.array[wp.int64]  # of its first contact, and which that is, see touch_in
    changed: wp.array[int]  # whether it may have other contacts than those that the last detection found
    done: wp.array[int]  # what has been done to it, in bits
    movable: int  # no contact counts that has vertices from here on only


@wp.struct
class Progress:
    """How far the response is."""

    steer: wp.array[int]
    projections: int  # rounds of projection at most
    history: History
    contact_round: wp.array[int]  # of each world, the round after which it last had a contact
    iteration: wp.array[int]  # whether there is another batch of iterations, and the number of the iteration


@wp.struct
class Contacts:
    """The contacts of one kind of pair, unsorted."""

    edges: int  # 1 where they are of edges: EDGE_EDGE, else VERTEX_FACE
    elements: wp.array2d[int]
    pairs: wp.array[wp.vec2i]
    counts: wp.array[wp.int64]
    status: wp.array[wp.int8]
    localized: wp.array[wp.bool]
    toi: wp.array[wp.float64]
    coordinates: wp.array[wp.vec3d]
    normal: wp.array[wp.vec3d]


@wp.struct
class Constraints:
    """What the contacts of this and earlier rounds ask for, so that mending one does not bring back another.

    Contact points are to be apart along a normal at the end of the step.
    """

    count: wp.array[int]
    vertices: wp.array[wp.vec4i]
    weights: wp.array[wp.vec4d]  # of the vertices in the vector from the second contact point to the first
    normal: wp.array[wp.vec3d]
    separation: wp.array[wp.float64]  # along the normal [m]
    friction: wp.array[float]  # coefficient
    origin: wp.array[int]  # what it is of
    localized: wp.array[wp.bool]  # whether the contact that it is of is certain to come within the tolerance after
    toi: wp.array[wp.float64]  # its time of impact
    urgency: wp.array[wp.float64]  # share of its violation that a whole step's approach is
    displacing: wp.array[wp.vec3d]  # what it does to displacements, times mass [kg m]
    slow: wp.array[int]  # 1 where it is of what moves little, see is_slow
    impulse: wp.array[wp.vec3d]  # and to velocities [kg m/s]
    reached: wp.array[wp.vec3d]  # either of the two after the last iteration, without momentum
    iteration: wp.array[int]  # in which it acted last
    acting: wp.array[int]  # list of those that act
    acting_count: wp.array[wp.int64]


@wp.func
def to_double(x: wp.vec3) -> wp.vec3d:
    """The same vector in double precision."""
    return wp.vec3d(wp.float64(x[0]), wp.float64(x[1]), wp.float64(x[2]))


@wp.func
def to_single(x: wp.vec3d) -> wp.vec3:
    """The nearest vector in single precision."""
    return wp.vec3(wp.float32(x[0]), wp.float32(x[1]), wp.float32(x[2]))


@wp.func
def is_projecting(progress: Progress, world: int) -> bool:
    """Whether this round projects vertices of a world: one without contacts is left as it is, like one alone."""
    return progress.steer[ROUND] <= progress.projections and progress.contact_round[world] == progress.steer[ROUND] - 1


@wp.func
def add_contact(progress: Progress, world: int):
    """Counts a contact that a detection found."""
    wp.atomic_add(progress.steer, HITS, 1)
    progress.contact_round[world] = progress.steer[ROUND]


@wp.func
def touch_in(vertices: Vertices, vertex: int, time: wp.float64, kind: int, i: int):
    """Takes down that a vertex is in the contact ``i`` of a kind, if it is its first in this step.

    A key orders them: the time, above which of them it is.
    """
    key = (wp.int64(wp.floor(TIMES * time)) << wp.int64(32)) | wp.int64(4 * i + kind)
    wp.atomic_min(vertices.time, vertex, key)


@wp.func
def contact_vertices(contacts: Contacts, i: int) -> wp.vec4i:
    """The four vertices of a contact, those of its first element first."""
    return vertices_of_pair(contacts.edges, contacts.elements, contacts.pairs[i])


@wp.func
def contact_weights(edges: int, c: wp.vec3d) -> wp.vec4d:
    """Weights of the four vertices in the vector from the contact point of the second feature to that of the first.

    Args:
        edges: 1 where the contact is of edges.
        c: Its coordinates.
    """
    if edges == 1:
        return wp.vec4d(_ONE - c[0], c[0], c[1] - _ONE, -c[1])
    return wp.vec4d(_ONE, -c[0], -c[1], -c[2])


@wp.func
def _side(vertices: Vertices, a: int, b: int) -> wp.float64:
    return wp.length(to_double(vertices.x0[a]) - to_double(vertices.x0[b]))


@wp.func
def longest_path(vertices: Vertices, corners: wp.vec4i) -> wp.float64:
    """How far the one of the four vertices wanted to move that wanted to move furthest [m]."""
    path = _ZERO
    for j in range(4):
        wanted = to_double(vertices.wanted_x1[corners[j]]) - to_double(vertices.x0[corners[j]])
        path = wp.max(path, wp.length(wanted))
    return path


@wp.func
def is_slow(vertices: Vertices, corners: wp.vec4i, edges: int) -> int:
    """1 where two elements move so little for their size that one direction holds for all of the step, else 0."""
    size = _side(vertices, corners[2], corners[3])
    if edges == 1:
        size = wp.min(size, _side(vertices, corners[0], corners[1]))
    else:
        size = wp.min(size, _side(vertices, corners[1], corners[2]))
    return wp.where(longest_path(vertices, corners) <= _SLOW * size, 1, 0)


@wp.func
def feasible(asked: wp.float64, start: wp.float64, separation: wp.float64, path: wp.float64) -> wp.float64:
    """The separation to ask of what is slow: hardly more than at the start, as standing still should nearly do."""
    return wp.min(asked, wp.max(start, wp.min(separation, start + _RECOVERY * path)))


@wp.func
def feasible_in_contact(
    vertices: Vertices,
    corners: wp.vec4i,
    weights: wp.vec4d,
    normal: wp.vec3d,
    asked: wp.float64,
    separation: wp.float64,
) -> wp.float64:
    """The separation to ask of a contact of what is slow, where ``asked`` is asked of others."""
    start = wp.dot(normal, relative(weights, corners, vertices.x0))
    return feasible(asked, start, separation, longest_path(vertices, corners))


@wp.func
def widened(separation: wp.float64, progress: Progress) -> wp.float64:
    """The separation that is asked for in a round."""
    return separation * wp.min(wp.pow(_WIDENING, wp.float64(progress.steer[ROUND])), _WIDEST)


@wp.func
def relative(weights: wp.vec4d, corners: wp.vec4i, x: wp.array[wp.vec3]) -> wp.vec3d:
    """From the second contact point to the first, or its velocity."""
    result = wp.vec3d()
    for j in range(4):
        result += weights[j] * to_double(x[corners[j]])
    return result


@wp.func
def gap(vertices: Vertices, constraints: Constraints, i: int) -> wp.float64:
    """How much more than the separation contact points are apart at the end of the step [m]."""
    end = relative(constraints.weights[i], constraints.vertices[i], vertices.x1)
    return wp.dot(constraints.normal[i], end) - constraints.separation[i]


@wp.func
def urgency_of(
    vertices: Vertices, corners: wp.vec4i, weights: wp.vec4d, normal: wp.vec3d, separation: wp.float64
) -> wp.float64:
    """Which share of its violation the approach of a whole step is."""
    end = wp.dot(normal, relative(weights, corners, vertices.x1))
    start = wp.dot(normal, relative(weights, corners, vertices.x0))
    if end < separation:
        return wp.clamp((start - end) / (separation - end), _ZERO, _ONE)
    return _ONE


@wp.func
def add_constraint(
    vertices: Vertices,
    constraints: Constraints,
    corners: wp.vec4i,
    weights: wp.vec4d,
    normal: wp.vec3d,
    separation: wp.float64,
    friction: float,
    slow: int,
    origin: int,
    localized: bool,
    toi: wp.float64,
):
    """Adds a constraint that does nothing yet, if there is room."""
    i = wp.atomic_add(constraints.count, 0, 1)
    if i < constraints.vertices.shape[0]:
        constraints.vertices[i] = corners
        constraints.weights[i] = weights
        constraints.normal[i] = normal
        constraints.separation[i] = separation
        constraints.friction[i] = friction
        constraints.slow[i] = slow
        constraints.origin[i] = origin
        constraints.localized[i] = localized
        constraints.toi[i] = toi
        constraints.urgency[i] = urgency_of(vertices, corners, weights, normal, separation)
        constraints.displacing[i] = wp.vec3d()
        constraints.impulse[i] = wp.vec3d()
        constraints.reached[i] = wp.vec3d()
        constraints.iteration[i] = -2


@wp.kernel(**_KERNEL)
def collect_contacts(
    vertices: Vertices, contacts: Contacts, constraints: Constraints, progress: Progress, separation: wp.float64
):
    """Counts the contacts, and makes constraints of them; after the last projection, takes down their times."""
    i = wp.tid()
    if not is_filled(i, contacts.pairs, contacts.counts, _CONTACTS) or int(contacts.status[i]) == FREE:
        return
    corners = contact_vertices(contacts, i)
    if wp.min(corners) >= vertices.movable:
        return
    add_contact(progress, vertices.world[corners[0]])
    for j in range(4):
        vertices.changed[corners[j]] = 1
    if progress.steer[ROUND] < progress.projections:
        friction = wp.sqrt(vertices.friction[corners[0]] * vertices.friction[corners[3]])
        weights = contact_weights(contacts.edges, contacts.coordinates[i])
        normal = contacts.normal[i]
        asked = widened(separation, progress)
        slow = is_slow(vertices, corners, contacts.edges)
        if slow == 1:
            asked = feasible_in_contact(vertices, corners, weights, normal, asked, separation)
        origin = wp.where(contacts.edges == 1, EDGE_EDGE_CONTACT, VERTEX_FACE_CONTACT)
        localized = contacts.localized[i]
        toi = contacts.toi[i]
        add_constraint(vertices, constraints, corners, weights, normal, asked, friction, slow, origin, localized, toi)
    else:
        for j in range(4):
            touch_in(vertices, corners[j], contacts.toi[i], contacts.edges, i)
