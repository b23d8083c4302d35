"""Projection: iterations over constraints that move vertices, and then change velocities, until all are met."""

import warp as wp

from ..kernels.pipeline.queues import take_slot
from .constraints import (
    PROJECTED,
    ROUND,
    Constraints,
    Progress,
    Vertices,
    gap,
    is_projecting,
    relative,
    to_double,
    to_single,
)
from .step_record import end_iteration, is_recording, record_entry

__all__ = [
    "ANOTHER",
    "BATCH",
    "ITERATIONS",
    "NUMBER",
    "accelerate",
    "accelerated",
    "change_velocities",
    "displace",
    "displaced",
    "enlist_accelerating",
    "enlist_displacing",
    "move_vertices",
    "moved",
    "spread",
    "start_impulses",
    "starts",
    "takes_back",
]

ITERATIONS, BATCH = wp.constant(40), wp.constant(8)
"""Iterations over constraints at most, in each round on positions, and at the end on velocities; and how many there are
before it is asked whether any constraint still acts."""
ANOTHER, NUMBER = wp.constant(0), wp.constant(1)
"""Places in the array that steers the iterations."""

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
_ZERO = wp.constant(wp.float64(0.0))
_ONE = wp.constant(wp.float64(1.0))

_KERNEL = {"enable_backward": False}


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
def spread(vertices: Vertices, constraints: Constraints, i: int, x: wp.vec3d, sums: wp.array2d[wp.int64]):
    """Adds what a constraint does to its vertices."""
    for j in range(4):
        vertex = constraints.vertices[i][j]
        share = constraints.weights[i][j] * wp.float64(vertices.inverse_mass[vertex])
        if share != _ZERO:
            _add(sums, vertex, share * x)


@wp.func
def takes_back(constraints: Constraints, progress: Progress, i: int) -> bool:
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
    if is_recording(progress.history):
        end_iteration(progress.history, int(constraints.acting_count[0]))
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
    distance = gap(vertices, constraints, i)
    acts = distance < -tolerance
    if not acts and takes_back(constraints, progress, i):
        done = constraints.displacing[i]
        if wp.length_sq(done) > _ZERO:
            friction = wp.float64(constraints.friction[i])
            path = _path(vertices, constraints, i)
            acts = distance > tolerance or not _is_held(done, constraints.normal[i], path, friction, tolerance)
    if acts:
        _enlist(vertices, constraints, i)


@wp.func
def displaced(vertices: Vertices, constraints: Constraints, i: int, pushes_only: bool) -> wp.vec3d:
    """What the multiplier of a constraint becomes by an iteration on positions, without momentum."""
    old = constraints.displacing[i]
    mobility = _mobility(vertices, constraints, i, wp.where(pushes_only, _RELAXATION, _ONE))
    if mobility <= _ZERO:
        return old
    excess = gap(vertices, constraints, i)
    path = _path(vertices, constraints, i)
    return updated(old, constraints.normal[i], excess, path, mobility, wp.float64(constraints.friction[i]))


@wp.func
def accelerated(vertices: Vertices, constraints: Constraints, i: int, restitution: wp.float64) -> wp.vec3d:
    """What the multiplier of a constraint becomes by an iteration on velocities, without momentum."""
    old = constraints.impulse[i]
    mobility = _mobility(vertices, constraints, i, _ONE)
    if mobility <= _ZERO:
        return old
    excess = _parting(vertices, constraints, i, restitution)
    velocity = relative(constraints.weights[i], constraints.vertices[i], vertices.velocity)
    return updated(old, constraints.normal[i], excess, velocity, mobility, wp.float64(constraints.friction[i]))


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
    pushes_only = not takes_back(constraints, progress, i)
    momentum = _momentum(constraints, progress, i)
    if pushes_only:
        momentum = wp.min(momentum, _PUSHING_MOMENTUM)
    old = constraints.displacing[i]
    if is_recording(progress.history):
        record_entry(progress.history, place, i, old, constraints.reached[i], momentum)
    reached = displaced(vertices, constraints, i, pushes_only)
    new = reached + momentum * (reached - constraints.reached[i])
    constraints.reached[i] = reached
    constraints.displacing[i] = new
    spread(vertices, constraints, i, new - old, vertices.displacement)


@wp.func
def moved(x: wp.vec3, sums: wp.array2d[wp.int64], vertex: int) -> wp.vec3:
    """A position or velocity with what constraints have added to it."""
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
        vertices.x1[vertex] = moved(vertices.wanted_x1[vertex], vertices.displacement, vertex)
        vertices.changed[vertex] = 1
        vertices.done[vertex] = vertices.done[vertex] | PROJECTED


@wp.func
def starts(constraints: Constraints, i: int) -> bool:
    """Whether a constraint has pushed something, which gives it an impulse."""
    return _is_pushing(constraints.displacing[i], constraints.normal[i])


@wp.kernel(**_KERNEL)
def start_impulses(vertices: Vertices, constraints: Constraints, dt: wp.float64):
    """Impulses that go with the displacements, but for the separation: as contacts at their times would have acted.

    Then angular momentum is that of the contacts as well, whose two sides meet in a point (only) at that time.
    """
    i = wp.tid()
    if i >= constraints.count[0]:
        return
    if starts(constraints, i):
        constraints.impulse[i] = constraints.displacing[i] * (constraints.urgency[i] / dt)
        for j in range(4):
            vertices.active[constraints.vertices[i][j]] = 1
        spread(vertices, constraints, i, constraints.impulse[i], vertices.velocity_change)
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
        if not starts(constraints, i):
            return
        if gap(vertices, constraints, i) > constraints.separation[i]:
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
    old = constraints.impulse[i]
    if is_recording(progress.history):
        record_entry(progress.history, place, i, old, constraints.reached[i], momentum)
    reached = accelerated(vertices, constraints, i, restitution)
    new = reached + momentum * (reached - constraints.reached[i])
    constraints.reached[i] = reached
    constraints.impulse[i] = new
    spread(vertices, constraints, i, new - old, vertices.velocity_change)


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
        vertices.velocity[vertex] = moved(vertices.wanted_velocity[vertex], vertices.velocity_change, vertex)
