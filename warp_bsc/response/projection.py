"""Projection: Jacobi sweeps over constraints that move vertices and bodies, and then change velocities."""

import warp as wp

from ..kernels.pipeline.queues import take_slot
from .bodies import activate_bodies, add_body_delta, body_inverse_masses
from .buffers import PROJECTED, Constraints, Motion, Progress, Vertices, has_final_velocity
from .constraints import (
    EDGE_EDGE_PROXIMITY,
    PLANE_CONTACT,
    RESTING,
    are_on_body,
    gap,
    is_dividing,
    is_projecting,
    least_distance,
    relative,
    to_double,
    to_single,
)
from .step_record import StepRecord, end_sweep, is_recording, record_entry

__all__ = [
    "MAX_SWEEPS",
    "SLOW_POSITION_SWEEPS",
    "SLOW_VELOCITY_SWEEPS",
    "SWEEPS_PER_BATCH",
    "activate_position_constraints",
    "activate_velocity_constraints",
    "add_delta",
    "count_active",
    "has_pushed",
    "initial_velocity_multiplier",
    "initialize_velocity_multipliers",
    "is_reversible",
    "moves_body",
    "position_multiplier_after",
    "project_positions",
    "project_velocities",
    "start_sweeps",
    "update_positions",
    "update_velocities",
    "velocity_multiplier_after",
    "with_delta",
    "with_momentum",
]

MAX_SWEEPS, SWEEPS_PER_BATCH = wp.constant(40), wp.constant(4)
"""Most sweeps over constraints, in each iteration on positions, and at the end on velocities; and the sweeps over one
active set, after which the device checks whether a constraint is still active."""
SLOW_POSITION_SWEEPS, SLOW_VELOCITY_SWEEPS = 16, 12
"""Most sweeps over constraints that move no body in worlds without fast contacts: dividing planes resolve what they
leave."""

_RELAXATION = wp.constant(wp.float64(1.5))
"""Active constraints of a vertex that count as one where they only push: mostly they push the same way."""
_PUSHING_MOMENTUM = wp.constant(wp.float64(0.5))
"""Largest momentum of a multiplier that only pushes."""
_SLIDING = wp.constant(wp.float64(0.999))
"""Share of the friction limit from which a contact slides."""
_CREEP = wp.constant(wp.float64(0.1))
"""Longest path of a contact that friction holds, as a share of the tolerance; it adds up over steps."""
_OF_BODIES = wp.constant(wp.float64(0.1))
"""Tolerance of a constraint on a body as a share of that of others: a body moves as one, so that its motion shows."""
_SHARE_OF_DISTANCE = wp.constant(wp.float64(0.5))
"""Largest tolerance of a position constraint as a share of its separation: elements that it holds stay apart."""
_SHARE_OF_CHANGE = wp.constant(wp.float64(0.1))
"""Largest tolerance of a contact with a plane as a share of its change by projection: what rests moves very little."""
_UNITS = wp.constant(wp.float64(2.0**40))
"""Units in a metre; sums are of integers in these units, so that they are the same in any order."""
_ZERO = wp.constant(wp.float64(0.0))
_ONE = wp.constant(wp.float64(1.0))

_NEAR = wp.constant(wp.float64(0.1))
"""Distance of near edges at the start, as a share of their separation, below which they are projected in any case:
planes keep a share of the distance, which becomes ever smaller where something presses."""

_KERNEL = {"enable_backward": False}


@wp.func
def _excess_speed(
    motion: Motion, vertices: Vertices, constraints: Constraints, i: int, restitution: wp.array[float]
) -> wp.float64:
    """Returns the speed at which contact points part less that of restitution [m/s]; negative if violated."""
    normal = constraints.normal[i]
    weights = constraints.weights[i]
    corners = constraints.vertices[i]
    wanted = wp.dot(normal, relative(weights, corners, motion.velocity))
    speed = wp.dot(normal, relative(weights, corners, vertices.velocity))
    return speed - wp.float64(restitution[0]) * wp.max(-wanted, _ZERO)


@wp.func
def _effective_inverse_masses(
    motion: Motion,
    vertices: Vertices,
    constraints: Constraints,
    i: int,
    x: wp.array[wp.vec3],
    relaxation: wp.float64,
):
    """Returns the inverse masses of a constraint [1/kg] along its normal and across it, at positions ``x`` of vertices.

    Its vertices and bodies are split among their active constraints.
    """
    inverse_mass = _ZERO
    for j in range(4):
        vertex = constraints.vertices[i][j]
        parts = wp.max(wp.float64(vertices.active[vertex]) / relaxation, _ONE)
        share = wp.float64(motion.inverse_mass[vertex]) * parts
        inverse_mass += constraints.weights[i][j] * constraints.weights[i][j] * share
    if not motion.bodies.of_vertex:
        return inverse_mass, inverse_mass
    along, across = body_inverse_masses(motion, vertices, constraints, i, x, relaxation)
    return inverse_mass + along, inverse_mass + across


@wp.func
def _multiplier_after(
    multiplier: wp.vec3d,
    normal: wp.vec3d,
    excess: wp.float64,
    motion: wp.vec3d,
    inverse_mass_along: wp.float64,
    inverse_mass_across: wp.float64,
    friction: wp.float64,
) -> wp.vec3d:
    """Returns a multiplier after a step towards no excess along the normal and no motion across it.

    Along the normal it only pushes; across, it is limited by friction (Coulomb).
    """
    along = wp.max(wp.dot(multiplier, normal) - excess / inverse_mass_along, _ZERO)
    across = multiplier - wp.dot(multiplier, normal) * normal
    across -= (motion - wp.dot(motion, normal) * normal) / inverse_mass_across
    length = wp.length(across)
    if length > friction * along:
        across = across * (friction * along / length)
    return along * normal + across


@wp.func
def _add(sums: wp.array2d[wp.int64], vertex: int, x: wp.vec3d):
    for axis in range(3):
        wp.atomic_add(sums, vertex, axis, wp.int64(wp.rint(_UNITS * x[axis])))


@wp.func
def add_delta(motion: Motion, constraints: Constraints, i: int, change: wp.vec3d, sums: wp.array2d[wp.int64]):
    """Adds what the change of a multiplier does to the vertices of its constraint."""
    for j in range(4):
        vertex = constraints.vertices[i][j]
        share = constraints.weights[i][j] * wp.float64(motion.inverse_mass[vertex])
        if share != _ZERO:
            _add(sums, vertex, share * change)


@wp.func
def with_delta(x: wp.vec3, sums: wp.array2d[wp.int64], vertex: int) -> wp.vec3:
    """Returns a position or velocity plus the sum of what constraints did to it."""
    y = to_double(x)
    for axis in range(3):
        y[axis] += wp.float64(sums[vertex, axis]) / _UNITS
    return to_single(y)


@wp.func
def is_reversible(constraints: Constraints, progress: Progress, i: int) -> bool:
    """Returns whether a constraint may pull back what it pushed too far, which keeps vertices near the wanted motion.

    Constraints of fast elements only push after the first iteration, which makes room where contacts come back.
    """
    return progress.status.iteration[0] == 1 or constraints.slow[i] != 0


@wp.func
def _is_held(
    multiplier: wp.vec3d, normal: wp.vec3d, motion: wp.vec3d, friction: wp.float64, tolerance: wp.float64
) -> bool:
    """Returns whether friction is solved: there is no motion across the normal, or the contact slides."""
    along = wp.dot(multiplier, normal)
    if wp.length(multiplier - along * normal) >= _SLIDING * friction * along:
        return True
    return wp.length(motion - wp.dot(motion, normal) * normal) <= _CREEP * tolerance


@wp.func
def count_active(motion: Motion, vertices: Vertices, constraints: Constraints, i: int):
    """Counts an active constraint for the vertices and bodies that it moves."""
    for j in range(4):
        if constraints.weights[i][j] != _ZERO:
            wp.atomic_add(vertices.active, constraints.vertices[i][j], 1)
    if motion.bodies.of_vertex:
        activate_bodies(motion, vertices, constraints, i)


@wp.func
def _activate(motion: Motion, vertices: Vertices, constraints: Constraints, i: int):
    """Adds a constraint to the active set, and counts it for the vertices and bodies that it moves."""
    constraints.active_set[int(take_slot(constraints.active_count, 0))] = i
    count_active(motion, vertices, constraints, i)


@wp.func
def moves_body(motion: Motion, constraints: Constraints, i: int) -> bool:
    """Returns whether a constraint moves a body."""
    return are_on_body(motion, constraints.vertices[i])


@wp.func
def _tolerance_of(motion: Motion, constraints: Constraints, i: int, tolerance: wp.float64) -> wp.float64:
    """Returns the tolerance of a constraint, less than ``tolerance`` if it moves a body."""
    return wp.where(moves_body(motion, constraints, i), _OF_BODIES, _ONE) * tolerance


@wp.func
def _max_sweeps(motion: Motion, constraints: Constraints, progress: Progress, i: int, slow: int) -> int:
    """Returns the most sweeps of a constraint: ``slow`` if it moves no body, and its world has no fast contacts."""
    world = motion.world[constraints.vertices[i][0]]
    return wp.where(progress.fast[world] == 1 or moves_body(motion, constraints, i), MAX_SWEEPS, slow)


@wp.func
def _momentum(constraints: Constraints, progress: Progress, i: int, max_sweeps: int) -> wp.float64:
    """Returns the share of its last step that a multiplier repeats: it grows (Nesterov), and is 0 in the last sweep."""
    sweep = progress.sweep.number[0]
    last = constraints.last_sweep[i]
    constraints.last_sweep[i] = sweep
    if last != sweep - 1 or sweep == max_sweeps - 1:
        return _ZERO
    return wp.float64(sweep) / wp.float64(sweep + 3)


@wp.func
def with_momentum(multiplier: wp.vec3d, previous: wp.vec3d, momentum: wp.float64) -> wp.vec3d:
    """Returns a multiplier after a sweep moved on by a share of its step from the previous one."""
    return multiplier + momentum * (multiplier - previous)


@wp.func
def _finish_sweep(constraints: Constraints, progress: Progress, record: StepRecord, last: bool):
    """Counts a sweep; after the last over an active set, empties it, and decides whether another batch is needed."""
    sweep = progress.sweep.number[0] + 1
    active = constraints.active_count[0] > wp.int64(0)
    progress.sweep.number[0] = sweep
    progress.sweep.another[0] = wp.where(active and sweep < MAX_SWEEPS, 1, 0)
    if is_recording(record):
        end_sweep(record, int(constraints.active_count[0]))
    if last:
        constraints.active_count[0] = wp.int64(0)


@wp.kernel(**_KERNEL)
def start_sweeps(progress: Progress):
    """Clears the count of sweeps; there is none in an iteration that divides, or truncates."""
    progress.sweep.number[0] = 0
    status = progress.status
    progress.sweep.another[0] = wp.where(status.active[0] == 0 or status.projecting[0] == 1, 1, 0)
    status.projecting[0] = 0


@wp.func
def _path(motion: Motion, vertices: Vertices, constraints: Constraints, i: int) -> wp.vec3d:
    weights = constraints.weights[i]
    corners = constraints.vertices[i]
    return relative(weights, corners, vertices.x1) - relative(weights, corners, motion.x0)


@wp.kernel(**_KERNEL)
def activate_position_constraints(
    motion: Motion, vertices: Vertices, constraints: Constraints, progress: Progress, tolerance: wp.float64
):
    """Fills the active set for positions: constraints that are violated, and those that may pull something back.

    Constraints met within the tolerance cost nothing, and move nothing. Nor do edges at rest near each other where
    planes divide them afterwards, unless they are too near: a stack has four times as many as of vertices and faces,
    which hold it as well.
    """
    i = wp.tid()
    if i >= constraints.count[0]:
        return
    world = motion.world[constraints.vertices[i][0]]
    resting_edges = constraints.kind[i] == EDGE_EDGE_PROXIMITY and constraints.slow[i] == RESTING
    if resting_edges and is_dividing(progress, world, progress.status.iteration[0]):
        start = relative(constraints.weights[i], constraints.vertices[i], motion.x0)
        least = least_distance(constraints, i)
        if wp.dot(constraints.normal[i], start) - least >= _NEAR * (constraints.separation[i] - least):
            return
    past = progress.sweep.number[0] >= _max_sweeps(motion, constraints, progress, i, progress.slow_position_sweeps)
    if past or not is_projecting(progress, world):
        return
    distance = gap(vertices, constraints, i)
    if constraints.kind[i] == PLANE_CONTACT:  # whose separation is an offset
        wanted = wp.dot(constraints.normal[i], relative(constraints.weights[i], constraints.vertices[i], motion.x1))
        if wanted < constraints.separation[i]:
            tolerance = wp.min(tolerance, _SHARE_OF_CHANGE * (constraints.separation[i] - wanted))
    else:
        tolerance = wp.min(tolerance, _SHARE_OF_DISTANCE * (constraints.separation[i] - least_distance(constraints, i)))
    tolerance = _tolerance_of(motion, constraints, i, tolerance)
    active = distance < -tolerance
    if not active and is_reversible(constraints, progress, i):
        multiplier = constraints.position_multiplier[i]
        if wp.length_sq(multiplier) > _ZERO:
            friction = wp.float64(constraints.friction[i])
            path = _path(motion, vertices, constraints, i)
            active = distance > tolerance or not _is_held(multiplier, constraints.normal[i], path, friction, tolerance)
    if active:
        _activate(motion, vertices, constraints, i)


@wp.func
def position_multiplier_after(
    motion: Motion, vertices: Vertices, constraints: Constraints, i: int, pushes_only: bool
) -> wp.vec3d:
    """Returns the position multiplier of a constraint after a sweep, without momentum."""
    old = constraints.position_multiplier[i]
    relaxation = wp.where(pushes_only, _RELAXATION, _ONE)
    along, across = _effective_inverse_masses(motion, vertices, constraints, i, motion.x1, relaxation)
    if along <= _ZERO:
        return old
    excess = gap(vertices, constraints, i)
    if pushes_only and excess >= _ZERO:
        return old
    path = _path(motion, vertices, constraints, i)
    friction = wp.float64(constraints.friction[i])
    return _multiplier_after(old, constraints.normal[i], excess, path, along, across, friction)


@wp.func
def velocity_multiplier_after(
    motion: Motion, vertices: Vertices, constraints: Constraints, i: int, restitution: wp.array[float]
) -> wp.vec3d:
    """Returns the velocity multiplier of a constraint after a sweep, without momentum."""
    old = constraints.velocity_multiplier[i]
    along, across = _effective_inverse_masses(motion, vertices, constraints, i, vertices.x1, _ONE)
    if along <= _ZERO:
        return old
    excess = _excess_speed(motion, vertices, constraints, i, restitution)
    velocity = relative(constraints.weights[i], constraints.vertices[i], vertices.velocity)
    friction = wp.float64(constraints.friction[i])
    return _multiplier_after(old, constraints.normal[i], excess, velocity, along, across, friction)


@wp.kernel(**_KERNEL)
def project_positions(
    motion: Motion, vertices: Vertices, constraints: Constraints, progress: Progress, record: StepRecord
):
    """Updates the position multipliers of the active set, in one Jacobi sweep.

    The mass of a vertex is split among its active constraints (Tonge et al. 2012), which converges, and conserves
    momentum, because a contact changes its two sides oppositely and equally. Momentum of the multipliers (Nesterov;
    Mazhar et al. 2015) carries it through a stack in few sweeps.
    """
    place = wp.tid()
    if wp.int64(place) >= constraints.active_count[0]:
        return
    i = constraints.active_set[place]
    pushes_only = not is_reversible(constraints, progress, i)
    max_sweeps = _max_sweeps(motion, constraints, progress, i, progress.slow_position_sweeps)
    momentum = _momentum(constraints, progress, i, max_sweeps)
    if pushes_only:
        violated = gap(vertices, constraints, i) < _ZERO
        momentum = wp.where(violated, wp.min(momentum, _PUSHING_MOMENTUM), _ZERO)
    old = constraints.position_multiplier[i]
    if is_recording(record):
        record_entry(record, place, i, old, constraints.previous_multiplier[i], momentum)
    multiplier = position_multiplier_after(motion, vertices, constraints, i, pushes_only)
    new = with_momentum(multiplier, constraints.previous_multiplier[i], momentum)
    constraints.previous_multiplier[i] = multiplier
    constraints.position_multiplier[i] = new
    add_delta(motion, constraints, i, new - old, vertices.particle_delta_x)
    if motion.bodies.of_vertex:
        add_body_delta(motion, vertices, constraints, i, new - old, motion.x1, vertices.bodies.delta_x)


@wp.kernel(**_KERNEL)
def update_positions(
    motion: Motion, vertices: Vertices, constraints: Constraints, progress: Progress, record: StepRecord, last: bool
):
    """Moves each vertex by the sum of what its constraints did to it, and finishes the sweep."""
    vertex = wp.tid()
    if vertex == 0:
        _finish_sweep(constraints, progress, record, last)
    if vertices.active[vertex] == 0:
        return
    if last:
        vertices.active[vertex] = 0
    if motion.inverse_mass[vertex] > 0.0:
        vertices.x1[vertex] = with_delta(motion.x1[vertex], vertices.particle_delta_x, vertex)
        vertices.changed[vertex] = 1
        vertices.outcome[vertex] = vertices.outcome[vertex] | PROJECTED


@wp.func
def has_pushed(constraints: Constraints, i: int) -> bool:
    """Returns whether a constraint pushed its vertices apart."""
    return wp.dot(constraints.position_multiplier[i], constraints.normal[i]) > _ZERO


@wp.func
def initial_velocity_multiplier(constraints: Constraints, i: int, dt: wp.float64) -> wp.vec3d:
    """Returns the impulse that goes with the position multiplier, without the part that made the separation."""
    return constraints.position_multiplier[i] * (constraints.approach[i] / dt)


@wp.kernel(**_KERNEL)
def initialize_velocity_multipliers(motion: Motion, vertices: Vertices, constraints: Constraints, dt: wp.float64):
    """Initializes the velocity multipliers of all constraints that pushed, as if contacts had acted at their times.

    This conserves angular momentum, because the two sides of a contact meet in one point at that time only.
    """
    i = wp.tid()
    if i >= constraints.count[0]:
        return
    if has_pushed(constraints, i):
        constraints.velocity_multiplier[i] = initial_velocity_multiplier(constraints, i, dt)
        for j in range(4):
            vertices.active[constraints.vertices[i][j]] = 1
        add_delta(motion, constraints, i, constraints.velocity_multiplier[i], vertices.particle_delta_v)
        if motion.bodies.of_vertex:
            activate_bodies(motion, vertices, constraints, i)
            impulse = constraints.velocity_multiplier[i]
            add_body_delta(motion, vertices, constraints, i, impulse, vertices.x1, vertices.bodies.delta_v)
    constraints.previous_multiplier[i] = constraints.velocity_multiplier[i]
    constraints.last_sweep[i] = -2


@wp.kernel(**_KERNEL)
def activate_velocity_constraints(
    motion: Motion,
    vertices: Vertices,
    constraints: Constraints,
    progress: Progress,
    restitution: wp.array[float],
    tolerance: wp.float64,
    dt: wp.float64,
):
    """Fills the active set for velocities: constraints that pushed, whose contact points are still near each other."""
    i = wp.tid()
    if i >= constraints.count[0]:
        return
    if progress.sweep.number[0] >= _max_sweeps(motion, constraints, progress, i, progress.slow_velocity_sweeps):
        return
    multiplier = constraints.velocity_multiplier[i]
    if wp.length_sq(multiplier) == _ZERO:
        if not has_pushed(constraints, i):
            return
        if gap(vertices, constraints, i) > constraints.separation[i] - least_distance(constraints, i):
            return
    tolerance = _tolerance_of(motion, constraints, i, tolerance) / dt
    normal = constraints.normal[i]
    excess = _excess_speed(motion, vertices, constraints, i, restitution)
    active = excess < -tolerance
    if not active and wp.length_sq(multiplier) > _ZERO:
        velocity = relative(constraints.weights[i], constraints.vertices[i], vertices.velocity)
        friction = wp.float64(constraints.friction[i])
        active = excess > tolerance or not _is_held(multiplier, normal, velocity, friction, tolerance)
    if active:
        _activate(motion, vertices, constraints, i)


@wp.kernel(**_KERNEL)
def project_velocities(
    motion: Motion,
    vertices: Vertices,
    constraints: Constraints,
    progress: Progress,
    record: StepRecord,
    restitution: wp.array[float],
):
    """Updates the velocity multipliers of the active set, in one Jacobi sweep, see :func:`project_positions`."""
    place = wp.tid()
    if wp.int64(place) >= constraints.active_count[0]:
        return
    i = constraints.active_set[place]
    max_sweeps = _max_sweeps(motion, constraints, progress, i, progress.slow_velocity_sweeps)
    momentum = _momentum(constraints, progress, i, max_sweeps)
    old = constraints.velocity_multiplier[i]
    if is_recording(record):
        record_entry(record, place, i, old, constraints.previous_multiplier[i], momentum)
    multiplier = velocity_multiplier_after(motion, vertices, constraints, i, restitution)
    new = with_momentum(multiplier, constraints.previous_multiplier[i], momentum)
    constraints.previous_multiplier[i] = multiplier
    constraints.velocity_multiplier[i] = new
    add_delta(motion, constraints, i, new - old, vertices.particle_delta_v)
    if motion.bodies.of_vertex:
        add_body_delta(motion, vertices, constraints, i, new - old, vertices.x1, vertices.bodies.delta_v)


@wp.kernel(**_KERNEL)
def update_velocities(
    motion: Motion, vertices: Vertices, constraints: Constraints, progress: Progress, record: StepRecord, last: bool
):
    """Changes the velocity of each vertex that was not truncated, and finishes the sweep."""
    vertex = wp.tid()
    if vertex == 0:
        _finish_sweep(constraints, progress, record, last)
    if vertices.active[vertex] == 0:
        return
    if last:
        vertices.active[vertex] = 0
    if motion.inverse_mass[vertex] > 0.0 and not has_final_velocity(vertices.outcome[vertex]):
        vertices.velocity[vertex] = with_delta(motion.velocity[vertex], vertices.particle_delta_v, vertex)
