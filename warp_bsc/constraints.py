"""Contacts as constraints on the ends of paths: collected from detections, and solved by projection."""

import warp as wp

from .kernels.queues import is_filled, take_slot
from .kernels.signs import FREE
from .narrow_phase import Count

__all__ = [
    "ACTIVE",
    "ANOTHER",
    "BATCH",
    "CERTIFIED",
    "FIRST_HITS",
    "FROZEN_NOW",
    "HITS",
    "ITERATIONS",
    "NUMBER",
    "PROJECTED",
    "PROJECTIONS",
    "REMAINING",
    "ROUND",
    "STEER",
    "TIMES",
    "UNDETECTED",
    "Constraints",
    "Contacts",
    "Progress",
    "Vertices",
    "accelerate",
    "add_constraint",
    "add_contact",
    "change_velocities",
    "collect_contacts",
    "displace",
    "enlist_accelerating",
    "enlist_displacing",
    "feasible",
    "is_projecting",
    "is_slow",
    "longest_path",
    "move_vertices",
    "relative",
    "start_impulses",
    "to_double",
    "to_single",
    "widened",
]

PROJECTIONS = wp.constant(40)
"""Rounds of projection, after which what still collides is truncated."""
PROJECTED = wp.constant(1)
"""Bit of what has been done to a vertex."""

ACTIVE, ROUND, CERTIFIED, HITS, FIRST_HITS, REMAINING, FROZEN_NOW, UNDETECTED, STEER = (
    wp.constant(i) for i in range(9)
)
"""Places in the array that steers the rounds: whether there is another, how many there were, whether the motion is
certified, contacts counted so far in a detection, those of the first, those of the last, how many vertices this round
has frozen, and whether a detection was incomplete; and how many places there are."""

ITERATIONS, BATCH = wp.constant(40), wp.constant(8)
"""Iterations over constraints at most, in each round on positions, and at the end on velocities; and how many there are
before it is asked whether any constraint still acts."""
ANOTHER, NUMBER = wp.constant(0), wp.constant(1)
"""Places in the array that steers the iterations."""

TIMES = wp.constant(wp.float64(2.0**30))
"""Units of time in a step, in which times are integers."""

_WIDENING = wp.constant(wp.float64(1.25))
"""Factor by which the separation of new contacts grows from round to round: what is in a jam moves further."""
_WIDEST = wp.constant(wp.float64(5.0))
"""How often the separation it grows to at most."""
_SLOW = wp.constant(wp.float64(0.5))
"""How far what is slow moves at most, as a share of the shortest side of the elements."""
_RECOVERY = wp.constant(wp.float64(0.25))
"""How much of the separation that slow ones lack they are given in a step, as a share of how far they wanted to move:
what is given more than it falls in a step hops, and slides meanwhile."""
_RELAXATION = wp.constant(wp.float64(1.5))
"""How many of the constraints that share a vertex count as one where they only push: mostly they ask for the same."""
_PUSHING_MOMENTUM = wp.constant(wp.float64(0.5))
"""How much of its last step a multiplier that only pushes takes again at most."""
_SLIDING = wp.constant(wp.float64(0.999))
"""From which share of what friction can hold on something slides."""
_CREEP = wp.constant(wp.float64(0.1))
"""How far what friction holds may move, as a share of the tolerance: this adds up over steps."""
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
    wanted_x1: wp.array[wp.vec3]  # before any contact
    wanted_velocity: wp.array[wp.vec3]
    inverse_mass: wp.array[float]
    friction: wp.array[float]
    world: wp.array[int]
    active: wp.array[int]  # how many active constraints it has
    displacement: wp.array2d[wp.int64]  # from where it wanted to be, summed over its constraints
    velocity_change: wp.array2d[wp.int64]
    time: wp.array[int]  # of its first contact
    changed: wp.array[int]  # whether it may have other contacts than those that the last detection found
    done: wp.array[int]  # what has been done to it, in bits
    movable: int  # no contact counts that has vertices from here on only


@wp.struct
class Progress:
    """How far the response is."""

    steer: wp.array[int]
    contact_round: wp.array[int]  # of each world, the round after which it last had a contact
    iteration: wp.array[int]  # whether there is another batch of iterations, and the number of the iteration


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
    friction: wp.array[float]  # coefficient
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
def _gap(vertices: Vertices, constraints: Constraints, i: int) -> wp.float64:
    """How much more than the separation contact points are apart at the end of the step [m]."""
    end = relative(constraints.weights[i], constraints.vertices[i], vertices.x1)
    return wp.dot(constraints.normal[i], end) - constraints.separation[i]


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
        path = relative(weights, corners, vertices.x1) - relative(weights, corners, vertices.x0)
        lack = -_gap(vertices, constraints, i)
        constraints.urgency[i] = _ONE
        if lack > _ZERO:
            constraints.urgency[i] = wp.clamp(-wp.dot(normal, path) / lack, _ZERO, _ONE)
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
    corners = _vertices(contacts, i)
    if wp.min(corners) >= vertices.movable:
        return
    add_contact(progress, vertices.world[corners[0]])
    for j in range(4):
        vertices.changed[corners[j]] = 1
    if progress.steer[ROUND] < PROJECTIONS:
        friction = wp.sqrt(vertices.friction[corners[0]] * vertices.friction[corners[3]])
        weights = _weights(contacts, i)
        normal = contacts.normal[i]
        asked = widened(separation, progress)
        slow = is_slow(vertices, corners, contacts.edges)
        if slow == 1:
            start = wp.dot(normal, relative(weights, corners, vertices.x0))
            asked = feasible(asked, start, separation, longest_path(vertices, corners))
        add_constraint(vertices, constraints, corners, weights, normal, asked, friction, slow)
    else:
        time = int(wp.floor(TIMES * contacts.toi[i]))
        for j in range(4):
            wp.atomic_min(vertices.time, corners[j], time)


@wp.func
def _parting(vertices: Vertices, constraints: Constraints, i: int, restitution: wp.float64) -> wp.float64:
    """How much faster than restitution asks contact points part [m/s]."""
    normal = constraints.normal[i]
    weights = constraints.weights[i]
    corners = constraints.vertices[i]
    wanted = wp.dot(normal, relative(weights, corners, vertices.wanted_velocity))
    speed = wp.dot(normal, relative(weights, corners, vertices.velocity))
    return speed - restitution * wp.max(-wanted, _ZERO)


@wp.func
def _is_pushing(multiplier: wp.vec3d, normal: wp.vec3d) -> bool:
    return wp.dot(multiplier, normal) > _ZERO


@wp.func
def _mobility(vertices: Vertices, constraints: Constraints, i: int, relaxation: wp.float64) -> wp.float64:
    mobility = _ZERO
    for j in range(4):
        vertex = constraints.vertices[i][j]
        parts = wp.max(wp.float64(vertices.active[vertex]) / relaxation, _ONE)
        share = wp.float64(vertices.inverse_mass[vertex]) * parts
        mobility += constraints.weights[i][j] * constraints.weights[i][j] * share
    return mobility


@wp.func
def updated(
    multiplier: wp.vec3d,
    normal: wp.vec3d,
    excess: wp.float64,
    motion: wp.vec3d,
    mobility: wp.float64,
    friction: wp.float64,
) -> wp.vec3d:
    """A multiplier after a step towards no excess (negative: a lack) along the normal and no motion across it.

    Along the normal it only pushes; across, it is limited by friction (Coulomb). What has been too much is taken back.
    """
    along = wp.max(wp.dot(multiplier, normal) - excess / mobility, _ZERO)
    across = multiplier - wp.dot(multiplier, normal) * normal
    across -= (motion - wp.dot(motion, normal) * normal) / mobility
    length = wp.length(across)
    if length > friction * along:
        across = across * (friction * along / length)
    return along * normal + across


@wp.func
def _add(sums: wp.array2d[wp.int64], vertex: int, x: wp.vec3d):
    for axis in range(3):
        wp.atomic_add(sums, vertex, axis, wp.int64(wp.rint(_UNITS * x[axis])))


@wp.func
def _spread(vertices: Vertices, constraints: Constraints, i: int, x: wp.vec3d, sums: wp.array2d[wp.int64]):
    """Adds what a constraint does to its vertices."""
    for j in range(4):
        vertex = constraints.vertices[i][j]
        share = constraints.weights[i][j] * wp.float64(vertices.inverse_mass[vertex])
        if share != _ZERO:
            _add(sums, vertex, share * x)


@wp.func
def _takes_back(constraints: Constraints, progress: Progress, i: int) -> bool:
    """Whether a constraint takes back what it has done too much, which leaves things nearest to what was wanted.

    What is fast only pushes after the first round, which makes room where contacts come back.
    """
    return progress.steer[ROUND] == 1 or constraints.slow[i] == 1


@wp.func
def _is_held(
    multiplier: wp.vec3d, normal: wp.vec3d, motion: wp.vec3d, friction: wp.float64, tolerance: wp.float64
) -> bool:
    """Whether friction does what it can: there is no motion across the normal, or it slides."""
    along = wp.dot(multiplier, normal)
    if wp.length(multiplier - along * normal) >= _SLIDING * friction * along:
        return True
    return wp.length(motion - wp.dot(motion, normal) * normal) <= _CREEP * tolerance


@wp.func
def _enlist(vertices: Vertices, constraints: Constraints, i: int):
    """Puts a constraint on the list of those that act in this iteration, and counts it for its vertices."""
    constraints.acting[int(take_slot(constraints.acting_count, 0))] = i
    for j in range(4):
        wp.atomic_add(vertices.active, constraints.vertices[i][j], 1)


@wp.func
def _momentum(constraints: Constraints, progress: Progress, i: int) -> wp.float64:
    """How much of its last step a multiplier takes again: ever more (Nesterov), but nothing at the end."""
    iteration = progress.iteration[NUMBER]
    last = constraints.iteration[i]
    constraints.iteration[i] = iteration
    if last != iteration - 1 or iteration == ITERATIONS - 1:
        return _ZERO
    return wp.float64(iteration) / wp.float64(iteration + 3)


@wp.func
def _finish_iteration(constraints: Constraints, progress: Progress):
    """Decides whether there is another batch."""
    iteration = progress.iteration[NUMBER] + 1
    acting = constraints.acting_count[0] > wp.int64(0)
    progress.iteration[NUMBER] = iteration
    progress.iteration[ANOTHER] = wp.where(acting and iteration < ITERATIONS, 1, 0)
    constraints.acting_count[0] = wp.int64(0)


@wp.func
def _path(vertices: Vertices, constraints: Constraints, i: int) -> wp.vec3d:
    weights = constraints.weights[i]
    corners = constraints.vertices[i]
    return relative(weights, corners, vertices.x1) - relative(weights, corners, vertices.x0)


@wp.kernel(**_KERNEL)
def enlist_displacing(vertices: Vertices, constraints: Constraints, progress: Progress, tolerance: wp.float64):
    """Lists the constraints that act on positions: those violated, and those that may take something back.

    What is settled but for the tolerance costs nothing, and moves nothing.
    """
    i = wp.tid()
    if i >= constraints.count[0] or not is_projecting(progress, vertices.world[constraints.vertices[i][0]]):
        return
    gap = _gap(vertices, constraints, i)
    acts = gap < -tolerance
    if not acts and _takes_back(constraints, progress, i):
        done = constraints.displacing[i]
        if wp.length_sq(done) > _ZERO:
            friction = wp.float64(constraints.friction[i])
            path = _path(vertices, constraints, i)
            acts = gap > tolerance or not _is_held(done, constraints.normal[i], path, friction, tolerance)
    if acts:
        _enlist(vertices, constraints, i)


@wp.kernel(**_KERNEL)
def displace(vertices: Vertices, constraints: Constraints, progress: Progress):
    """An iteration over constraints on positions.

    All take a step at once: the mass of a vertex is split among those that act (Tonge et al. 2012), which converges,
    and conserves momentum, because what a contact does to its two sides is opposite and equal. Momentum of the
    multipliers (Nesterov; Mazhar et al. 2015) takes it through a stack in few iterations.
    """
    place = wp.tid()
    if wp.int64(place) >= constraints.acting_count[0]:
        return
    i = constraints.acting[place]
    relaxation = _ONE
    momentum = _momentum(constraints, progress, i)
    if not _takes_back(constraints, progress, i):
        relaxation = _RELAXATION
        momentum = wp.min(momentum, _PUSHING_MOMENTUM)
    mobility = _mobility(vertices, constraints, i, relaxation)
    if mobility <= _ZERO:
        return
    old = constraints.displacing[i]
    reached = updated(
        old,
        constraints.normal[i],
        _gap(vertices, constraints, i),
        _path(vertices, constraints, i),
        mobility,
        wp.float64(constraints.friction[i]),
    )
    new = reached + momentum * (reached - constraints.reached[i])
    constraints.reached[i] = reached
    constraints.displacing[i] = new
    _spread(vertices, constraints, i, new - old, vertices.displacement)


@wp.func
def _moved(x: wp.vec3, sums: wp.array2d[wp.int64], vertex: int) -> wp.vec3:
    y = to_double(x)
    for axis in range(3):
        y[axis] += wp.float64(sums[vertex, axis]) / _UNITS
    return to_single(y)


@wp.kernel(**_KERNEL)
def move_vertices(vertices: Vertices, constraints: Constraints, progress: Progress):
    """Does to each vertex what its constraints ask for, which ends the iteration."""
    vertex = wp.tid()
    if vertex == 0:
        _finish_iteration(constraints, progress)
    if vertices.active[vertex] == 0:
        return
    vertices.active[vertex] = 0
    if vertices.inverse_mass[vertex] > 0.0:
        vertices.x1[vertex] = _moved(vertices.wanted_x1[vertex], vertices.displacement, vertex)
        vertices.changed[vertex] = 1
        vertices.done[vertex] = vertices.done[vertex] | PROJECTED


@wp.kernel(**_KERNEL)
def start_impulses(vertices: Vertices, constraints: Constraints, dt: wp.float64):
    """Impulses that go with the displacements, but for the separation: as contacts at their times would have acted.

    Then angular momentum is that of the contacts as well, whose two sides meet in a point (only) at that time.
    """
    i = wp.tid()
    if i >= constraints.count[0]:
        return
    if _is_pushing(constraints.displacing[i], constraints.normal[i]):
        constraints.impulse[i] = constraints.displacing[i] * (constraints.urgency[i] / dt)
        for j in range(4):
            vertices.active[constraints.vertices[i][j]] = 1
        _spread(vertices, constraints, i, constraints.impulse[i], vertices.velocity_change)
    constraints.reached[i] = constraints.impulse[i]
    constraints.iteration[i] = -2


@wp.kernel(**_KERNEL)
def enlist_accelerating(
    vertices: Vertices,
    constraints: Constraints,
    restitution: wp.float64,
    tolerance: wp.float64,
    dt: wp.float64,
):
    """Lists the constraints that act on velocities: of those that have displaced something that still is at it."""
    i = wp.tid()
    if i >= constraints.count[0]:
        return
    impulse = constraints.impulse[i]
    if wp.length_sq(impulse) == _ZERO:
        if not _is_pushing(constraints.displacing[i], constraints.normal[i]):
            return
        if _gap(vertices, constraints, i) > constraints.separation[i]:
            return
    tolerance /= dt
    normal = constraints.normal[i]
    excess = _parting(vertices, constraints, i, restitution)
    acts = excess < -tolerance
    if not acts and wp.length_sq(impulse) > _ZERO:
        velocity = relative(constraints.weights[i], constraints.vertices[i], vertices.velocity)
        friction = wp.float64(constraints.friction[i])
        acts = excess > tolerance or not _is_held(impulse, normal, velocity, friction, tolerance)
    if acts:
        _enlist(vertices, constraints, i)


@wp.kernel(**_KERNEL)
def accelerate(vertices: Vertices, constraints: Constraints, progress: Progress, restitution: wp.float64):
    """An iteration over constraints on velocities, see :func:`displace`."""
    place = wp.tid()
    if wp.int64(place) >= constraints.acting_count[0]:
        return
    i = constraints.acting[place]
    momentum = _momentum(constraints, progress, i)
    mobility = _mobility(vertices, constraints, i, _ONE)
    if mobility <= _ZERO:
        return
    old = constraints.impulse[i]
    reached = updated(
        old,
        constraints.normal[i],
        _parting(vertices, constraints, i, restitution),
        relative(constraints.weights[i], constraints.vertices[i], vertices.velocity),
        mobility,
        wp.float64(constraints.friction[i]),
    )
    new = reached + momentum * (reached - constraints.reached[i])
    constraints.reached[i] = reached
    constraints.impulse[i] = new
    _spread(vertices, constraints, i, new - old, vertices.velocity_change)


@wp.kernel(**_KERNEL)
def change_velocities(vertices: Vertices, constraints: Constraints, progress: Progress):
    """Gives each vertex that was not truncated the velocity that its constraints ask for, which ends the iteration."""
    vertex = wp.tid()
    if vertex == 0:
        _finish_iteration(constraints, progress)
    if vertices.active[vertex] == 0:
        return
    vertices.active[vertex] = 0
    if vertices.inverse_mass[vertex] > 0.0 and vertices.done[vertex] <= PROJECTED:
        vertices.velocity[vertex] = _moved(vertices.wanted_velocity[vertex], vertices.velocity_change, vertex)
