"""Jacobi sweeps over constraints, as those on positions and on velocities share them: multipliers and active sets.

The mass of a vertex or body is split among its active constraints (Tonge et al. 2012), which converges, and conserves
momentum, because a contact changes its two sides oppositely and equally. Momentum of the multipliers (Nesterov; Mazhar
et al. 2015) carries it through a stack in few sweeps.
"""

from collections.abc import Callable

import warp as wp

from ...kernels.pipeline.queues import take_slot
from ..contacts.constraints import gap, moves_body
from ..schedule import MAX_SWEEPS, SWEEPS_PER_BATCH, SolveStatus, start_sweeps
from ..state.fixed_sum import add_to_sum
from ..state.record import StepRecord, end_sweep, is_recording, record_entry
from ..state.structs import Constraints, Motion, Vertices
from ..state.vectors import ONE, ZERO, relative
from ..tuning import CREEP, RELAXATION, SLIDING, TOLERANCE_OF_BODIES
from .bodies import activate_bodies, add_body_delta, body_inverse_masses


@wp.func
def _effective_inverse_masses(
    motion: Motion, vertices: Vertices, constraints: Constraints, i: int, x: wp.array[wp.vec3], relaxation: wp.float64
):
    """Returns the inverse masses of a constraint [1/kg] along its normal and across it, at positions ``x`` of vertices.

    Its vertices and bodies are split among their active constraints.
    """
    inverse_mass = ZERO
    for j in range(4):
        vertex = constraints.vertices[i][j]
        parts = wp.max(wp.float64(vertices.active[vertex]) / relaxation, ONE)
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
    along = wp.max(wp.dot(multiplier, normal) - excess / inverse_mass_along, ZERO)
    across = multiplier - wp.dot(multiplier, normal) * normal
    across -= (motion - wp.dot(motion, normal) * normal) / inverse_mass_across
    length = wp.length(across)
    if length > friction * along:
        across = across * (friction * along / length)
    return along * normal + across


@wp.func
def path_of(motion: Motion, vertices: Vertices, constraints: Constraints, i: int) -> wp.vec3d:
    """Returns the path of the first contact point relative to the second over the step [m]."""
    weights = constraints.weights[i]
    corners = constraints.vertices[i]
    return relative(weights, corners, vertices.x1) - relative(weights, corners, motion.x0)


@wp.func
def position_multiplier_after(
    motion: Motion, vertices: Vertices, constraints: Constraints, i: int, pushes_only: bool
) -> wp.vec3d:
    """Returns the position multiplier of a constraint after a sweep, without momentum."""
    old = constraints.position_multiplier[i]
    relaxation = wp.where(pushes_only, RELAXATION, ONE)
    along, across = _effective_inverse_masses(motion, vertices, constraints, i, motion.x1, relaxation)
    if along <= ZERO:
        return old
    excess = gap(vertices, constraints, i)
    if pushes_only and excess >= ZERO:
        return old
    path = path_of(motion, vertices, constraints, i)
    friction = wp.float64(constraints.friction[i])
    return _multiplier_after(old, constraints.normal[i], excess, path, along, across, friction)


@wp.func
def excess_speed(
    motion: Motion, vertices: Vertices, constraints: Constraints, i: int, restitution: wp.array[float]
) -> wp.float64:
    """Returns the speed at which contact points part less that of restitution [m/s]; negative if violated."""
    normal = constraints.normal[i]
    weights = constraints.weights[i]
    corners = constraints.vertices[i]
    predicted = wp.dot(normal, relative(weights, corners, motion.velocity))
    speed = wp.dot(normal, relative(weights, corners, vertices.velocity))
    return speed - wp.float64(restitution[0]) * wp.max(-predicted, ZERO)


@wp.func
def velocity_multiplier_after(
    motion: Motion, vertices: Vertices, constraints: Constraints, i: int, restitution: wp.array[float]
) -> wp.vec3d:
    """Returns the velocity multiplier of a constraint after a sweep, without momentum."""
    old = constraints.velocity_multiplier[i]
    along, across = _effective_inverse_masses(motion, vertices, constraints, i, vertices.x1, ONE)
    if along <= ZERO:
        return old
    excess = excess_speed(motion, vertices, constraints, i, restitution)
    velocity = relative(constraints.weights[i], constraints.vertices[i], vertices.velocity)
    friction = wp.float64(constraints.friction[i])
    return _multiplier_after(old, constraints.normal[i], excess, velocity, along, across, friction)


@wp.func
def initial_velocity_multiplier(constraints: Constraints, i: int, dt: wp.float64) -> wp.vec3d:
    """Returns the impulse that goes with the position multiplier, without the part that made the separation."""
    return constraints.position_multiplier[i] * (constraints.approach[i] / dt)


@wp.func
def is_held_by_friction(
    multiplier: wp.vec3d, normal: wp.vec3d, motion: wp.vec3d, friction: wp.float64, tolerance: wp.float64
) -> bool:
    """Returns whether friction is solved: there is no motion across the normal, or the contact slides."""
    along = wp.dot(multiplier, normal)
    if wp.length(multiplier - along * normal) >= SLIDING * friction * along:
        return True
    return wp.length(motion - wp.dot(motion, normal) * normal) <= CREEP * tolerance


@wp.func
def count_active(motion: Motion, vertices: Vertices, constraints: Constraints, i: int):
    """Counts an active constraint for the vertices and bodies that it moves."""
    for j in range(4):
        if constraints.weights[i][j] != ZERO:
            wp.atomic_add(vertices.active, constraints.vertices[i][j], 1)
    if motion.bodies.of_vertex:
        activate_bodies(motion, vertices, constraints, i)


@wp.func
def activate(motion: Motion, vertices: Vertices, constraints: Constraints, i: int):
    """Adds a constraint to the active set, and counts it for the vertices and bodies that it moves."""
    constraints.active_set[int(take_slot(constraints.active_count, 0))] = i
    count_active(motion, vertices, constraints, i)


@wp.func
def tolerance_of(motion: Motion, constraints: Constraints, i: int, tolerance: wp.float64) -> wp.float64:
    """Returns the tolerance of a constraint, less than ``tolerance`` if it moves a body."""
    return wp.where(moves_body(motion, constraints, i), TOLERANCE_OF_BODIES, ONE) * tolerance


@wp.func
def max_sweeps(motion: Motion, constraints: Constraints, status: SolveStatus, i: int, slow: int) -> int:
    """Returns the most sweeps of a constraint: ``slow`` if it moves no body, and its world has no fast contacts."""
    world = motion.world[constraints.vertices[i][0]]
    return wp.where(status.is_fast[world] == 1 or moves_body(motion, constraints, i), MAX_SWEEPS, slow)


@wp.func
def momentum_of(constraints: Constraints, status: SolveStatus, i: int, last_sweep: int) -> wp.float64:
    """Returns the share of its last step that a multiplier repeats: it grows (Nesterov), and is 0 in the last sweep."""
    sweep = status.loop.sweep[0]
    last = constraints.last_sweep[i]
    constraints.last_sweep[i] = sweep
    if last != sweep - 1 or sweep == last_sweep:
        return ZERO
    return wp.float64(sweep) / wp.float64(sweep + 3)


@wp.func
def with_momentum(multiplier: wp.vec3d, previous: wp.vec3d, momentum: wp.float64) -> wp.vec3d:
    """Returns a multiplier after a sweep moved on by a share of its step from the previous one."""
    return multiplier + momentum * (multiplier - previous)


@wp.func
def add_delta(
    motion: Motion,
    vertices: Vertices,
    constraints: Constraints,
    i: int,
    change: wp.vec3d,
    x: wp.array[wp.vec3],
    sums: wp.array2d[wp.int64],
    body_sums: wp.array2d[wp.int64],
):
    """Adds what the change of a multiplier does to the vertices and bodies of its constraint, at positions ``x``."""
    for j in range(4):
        vertex = constraints.vertices[i][j]
        share = constraints.weights[i][j] * wp.float64(motion.inverse_mass[vertex])
        if share != ZERO:
            add_to_sum(sums, vertex, 0, share * change)
    if motion.bodies.of_vertex:
        add_body_delta(motion, vertices, constraints, i, change, x, body_sums)


@wp.func
def after_sweep(
    constraints: Constraints, record: StepRecord, place: int, old: wp.vec3d, multiplier: wp.vec3d, momentum: wp.float64
) -> wp.vec3d:
    """Returns a multiplier of the active set moved on by its momentum, and records what it was before the sweep."""
    i = constraints.active_set[place]
    previous = constraints.previous_multiplier[i]
    if is_recording(record):
        record_entry(record, place, i, old, previous, momentum)
    constraints.previous_multiplier[i] = multiplier
    return with_momentum(multiplier, previous, momentum)


@wp.func
def _finish_sweep(constraints: Constraints, status: SolveStatus, record: StepRecord, last: bool):
    """Counts a sweep; after the last over an active set, empties it, and decides whether another batch is needed."""
    sweep = status.loop.sweep[0] + 1
    active = constraints.active_count[0] > wp.int64(0)
    status.loop.sweep[0] = sweep
    status.loop.more_sweeps[0] = wp.where(active and sweep < MAX_SWEEPS, 1, 0)
    if is_recording(record):
        end_sweep(record, int(constraints.active_count[0]))
    if last:
        constraints.active_count[0] = wp.int64(0)


@wp.func
def finish_sweep(
    vertices: Vertices, constraints: Constraints, status: SolveStatus, record: StepRecord, last: bool, vertex: int
) -> bool:
    """Returns whether constraints of a sweep act on a vertex; for vertex 0, finishes the sweep.

    The ``last`` sweep over an active set empties it.
    """
    if vertex == 0:
        _finish_sweep(constraints, status, record, last)
    active = vertices.active[vertex] != 0
    if active and last:
        vertices.active[vertex] = 0
    return active


def repeat(status: SolveStatus, reserve_entries: Callable[[int], None], sweep: Callable[[bool, bool], None]) -> None:
    """Repeats batches of sweeps until no constraint is active, at most MAX_SWEEPS times; none in divided worlds.

    Args:
        status: The solve status.
        reserve_entries: Reserves entries of the record for sweeps.
        sweep: Sweeps once. Takes whether it is the first of a batch, which fills the active set, and the last.
    """

    def batch():
        reserve_entries(int(SWEEPS_PER_BATCH))
        for i in range(SWEEPS_PER_BATCH):
            sweep(i == 0, i == SWEEPS_PER_BATCH - 1)

    wp.launch(start_sweeps, 1, inputs=[status], device=status.loop.sweep.device)
    wp.capture_while(status.loop.more_sweeps, batch)
