"""Contacts as constraints on the ends of paths: collected from detections, and solved by projection."""

import warp as wp

from .kernels.queues import is_filled
from .kernels.signs import FREE
from .narrow_phase import Count

__all__ = [
    "ACTIVE",
    "CERTIFIED",
    "FIRST_HITS",
    "FROZEN_NOW",
    "HITS",
    "PROJECTED",
    "PROJECTIONS",
    "REMAINING",
    "ROUND",
    "STEER",
    "TIMES",
    "Constraints",
    "Contacts",
    "Progress",
    "Vertices",
    "add_contact",
    "collect_contacts",
    "count_violated",
    "is_projecting",
    "project_vertices",
    "push_and_change",
    "solve_violated",
    "to_double",
    "to_single",
]

PROJECTIONS = wp.constant(40)
"""Rounds of projection, after which what still collides is truncated."""
PROJECTED = wp.constant(1)
"""Bit of what has been done to a vertex."""

ACTIVE, ROUND, CERTIFIED, HITS, FIRST_HITS, REMAINING, FROZEN_NOW, STEER = (wp.constant(i) for i in range(8))
"""Places in the array that steers the rounds: whether there is another, how many there were, whether the motion is
certified, contacts counted so far in a detection, those of the first, those of the last, and how many vertices this
round has frozen; and how many places there are."""

TIMES = wp.constant(wp.float64(2.0**30))
"""Units of time in a step, in which times are integers."""

_WIDENING = wp.constant(wp.float64(1.25))
"""Factor by which the separation of new contacts grows from round to round: what is in a jam moves further."""
_WIDEST = wp.constant(wp.float64(100.0))
"""How often the separation it grows to at most."""
_UNITS = wp.constant(wp.float64(2.0**40))
"""Sums are of integers in these units of a metre, so that they are the same in any order."""
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
    wanted_velocity: wp.array[wp.vec3]  # before any contact
    inverse_mass: wp.array[float]
    friction: wp.array[float]
    world: wp.array[int]
    violated: wp.array[int]  # how many violated constraints it has
    displacement: wp.array2d[wp.int64]  # sums over them
    velocity_change: wp.array2d[wp.int64]
    time: wp.array[int]  # of its first contact
    done: wp.array[int]  # what has been done to it, in bits
    movable: int  # no contact counts that has vertices from here on only


@wp.struct
class Progress:
    """How far the response is."""

    steer: wp.array[int]
    contact_round: wp.array[int]  # of each world, the round after which it last had a contact


@wp.struct
class Contacts:
    """The contacts of one kind of pair, unsorted."""

    edges: int  # 1 where they are of edges
    elements: wp.array2d[int]
    pairs: wp.array[wp.vec2i]
    counts: wp.array[wp.int64]
    status: wp.array[wp.int8]
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
    return progress.steer[ROUND] <= PROJECTIONS and progress.contact_round[world] == progress.steer[ROUND] - 1


@wp.func
def add_contact(progress: Progress, world: int):
    """Counts a contact that a detection found."""
    wp.atomic_add(progress.steer, HITS, 1)
    progress.contact_round[world] = progress.steer[ROUND]


@wp.func
def _vertices(contacts: Contacts, i: int) -> wp.vec4i:
    first = contacts.pairs[i][0]
    second = contacts.pairs[i][1]
    if contacts.edges == 1:
        return wp.vec4i(
            contacts.elements[first, 0],
            contacts.elements[first, 1],
            contacts.elements[second, 0],
            contacts.elements[second, 1],
        )
    return wp.vec4i(first, contacts.elements[second, 0], contacts.elements[second, 1], contacts.elements[second, 2])


@wp.func
def _weights(contacts: Contacts, i: int) -> wp.vec4d:
    """Weights of the four vertices in the vector from the contact point of the second feature to that of the first."""
    c = contacts.coordinates[i]
    if contacts.edges == 1:
        return wp.vec4d(_ONE - c[0], c[0], c[1] - _ONE, -c[1])
    return wp.vec4d(_ONE, -c[0], -c[1], -c[2])


@wp.kernel(**_KERNEL)
def collect_contacts(
    vertices: Vertices, contacts: Contacts, constraints: Constraints, progress: Progress, separation: wp.float64
):
    """Counts the contacts, and makes constraints of them; after the last projection, takes down their times."""
    i = wp.tid()
    if not is_filled(i, contacts.pairs, contacts.counts, _CONTACTS) or int(contacts.status[i]) == FREE:
        return
    corners = _vertices(contacts, i)
    if wp.min(corners) >= vertices.movable:
        return
    add_contact(progress, vertices.world[corners[0]])
    finished = progress.steer[ROUND]
    if finished < PROJECTIONS:
        slot = wp.atomic_add(constraints.count, 0, 1)
        if slot < constraints.vertices.shape[0]:
            constraints.vertices[slot] = corners
            constraints.weights[slot] = _weights(contacts, i)
            constraints.normal[slot] = contacts.normal[i]
            constraints.separation[slot] = separation * wp.min(wp.pow(_WIDENING, wp.float64(finished)), _WIDEST)
    else:
        time = int(wp.floor(TIMES * contacts.toi[i]))
        for j in range(4):
            wp.atomic_min(vertices.time, corners[j], time)


@wp.func
def _depth(vertices: Vertices, constraints: Constraints, i: int) -> wp.float64:
    """How much a constraint is violated [m]."""
    corners = constraints.vertices[i]
    weights = constraints.weights[i]
    end = wp.vec3d()
    for j in range(4):
        end += weights[j] * to_double(vertices.x1[corners[j]])
    return constraints.separation[i] - wp.dot(constraints.normal[i], end)


@wp.func
def _is_violated(vertices: Vertices, constraints: Constraints, progress: Progress, i: int) -> bool:
    if i >= constraints.count[0] or not is_projecting(progress, vertices.world[constraints.vertices[i][0]]):
        return False
    return _depth(vertices, constraints, i) > _ZERO


@wp.kernel(**_KERNEL)
def count_violated(vertices: Vertices, constraints: Constraints, progress: Progress):
    """Counts the violated constraints of each vertex."""
    i = wp.tid()
    if _is_violated(vertices, constraints, progress, i):
        for j in range(4):
            wp.atomic_add(vertices.violated, constraints.vertices[i][j], 1)


@wp.func
def _against_sliding(x: wp.vec3d, normal: wp.vec3d, limit: wp.float64) -> wp.vec3d:
    """What friction does to a relative motion: it takes all that is not along the normal, up to a limit."""
    slide = x - wp.dot(x, normal) * normal
    length = wp.length(slide)
    if length <= limit:
        return -slide
    return -(limit / length) * slide


@wp.func
def push_and_change(
    normal: wp.vec3d,
    depth: wp.float64,
    path: wp.vec3d,
    velocity: wp.vec3d,
    wanted_velocity: wp.vec3d,
    friction: wp.float64,
    restitution: wp.float64,
):
    """Changes of the relative position and velocity at a contact that is violated by a depth.

    Along the normal, the velocity becomes what restitution gives back of the wanted one. Friction takes from the
    sliding no more than its coefficient times what changes along the normal (Coulomb). The push itself is no part of
    the velocity: it would turn separation into speed.
    """
    push = depth * normal + _against_sliding(path, normal, friction * depth)
    rebound = restitution * wp.max(-wp.dot(wanted_velocity, normal), _ZERO)
    bounce = wp.max(rebound - wp.dot(velocity, normal), _ZERO)
    change = bounce * normal + _against_sliding(velocity, normal, friction * bounce)
    return push, change


@wp.func
def _add(sums: wp.array2d[wp.int64], vertex: int, x: wp.vec3d):
    for axis in range(3):
        wp.atomic_add(sums, vertex, axis, wp.int64(wp.rint(_UNITS * x[axis])))


@wp.kernel(**_KERNEL)
def solve_violated(vertices: Vertices, constraints: Constraints, progress: Progress, restitution: wp.float64):
    """Sums up what violated constraints ask of their vertices.

    All do so at once: the mass of a vertex is split among them (Tonge et al. 2012), which converges, and conserves
    momentum, because what a contact does to its two sides is opposite and equal.
    """
    i = wp.tid()
    if not _is_violated(vertices, constraints, progress, i):
        return
    corners = constraints.vertices[i]
    weights = constraints.weights[i]
    path = wp.vec3d()
    velocity = wp.vec3d()
    wanted_velocity = wp.vec3d()
    mobility = _ZERO
    for j in range(4):
        vertex = corners[j]
        path += weights[j] * (to_double(vertices.x1[vertex]) - to_double(vertices.x0[vertex]))
        velocity += weights[j] * to_double(vertices.velocity[vertex])
        wanted_velocity += weights[j] * to_double(vertices.wanted_velocity[vertex])
        share = wp.float64(vertices.inverse_mass[vertex]) * wp.float64(vertices.violated[vertex])
        mobility += weights[j] * weights[j] * share
    if mobility <= _ZERO:
        return
    friction = wp.sqrt(wp.float64(vertices.friction[corners[0]]) * wp.float64(vertices.friction[corners[3]]))
    depth = _depth(vertices, constraints, i)
    push, change = push_and_change(constraints.normal[i], depth, path, velocity, wanted_velocity, friction, restitution)
    for j in range(4):
        vertex = corners[j]
        share = weights[j] * wp.float64(vertices.inverse_mass[vertex]) / mobility
        if share != _ZERO:
            _add(vertices.displacement, vertex, share * push)
            _add(vertices.velocity_change, vertex, share * change)


@wp.func
def _sum(sums: wp.array2d[wp.int64], vertex: int) -> wp.vec3d:
    return wp.vec3d(
        wp.float64(sums[vertex, 0]) / _UNITS, wp.float64(sums[vertex, 1]) / _UNITS, wp.float64(sums[vertex, 2]) / _UNITS
    )


@wp.kernel(**_KERNEL)
def project_vertices(vertices: Vertices):
    """Does to each vertex what its constraints ask for."""
    vertex = wp.tid()
    if vertices.violated[vertex] == 0:
        return
    vertices.violated[vertex] = 0
    if vertices.inverse_mass[vertex] == 0.0:
        return
    vertices.x1[vertex] = to_single(to_double(vertices.x1[vertex]) + _sum(vertices.displacement, vertex))
    vertices.velocity[vertex] = to_single(to_double(vertices.velocity[vertex]) + _sum(vertices.velocity_change, vertex))
    vertices.done[vertex] = vertices.done[vertex] | PROJECTED
    for axis in range(3):
        vertices.displacement[vertex, axis] = wp.int64(0)
        vertices.velocity_change[vertex, axis] = wp.int64(0)
