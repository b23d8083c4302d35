"""Projection of velocities: Jacobi sweeps over the constraints that pushed."""

import warp as wp

from ..contacts.constraints import NEVER_SWEPT, gap, has_pushed, min_distance_of
from ..schedule import SolveStatus
from ..state.fixed_sum import with_delta
from ..state.record import StepRecord, is_recording, record_entry
from ..state.structs import Constraints, Motion, Vertices, has_final_velocity
from ..state.vectors import ONE, ZERO, relative
from ..state.workspace import Workspace
from .angular_momentum import restore_angular_momentum
from .bodies import activate_bodies, add_body_delta, change_body_velocities, move_to_end, set_vertex_velocities
from .sweeps import (
    activate,
    add_delta,
    effective_inverse_masses,
    finish_sweep,
    is_held_by_friction,
    max_sweeps,
    momentum_of,
    multiplier_after,
    repeat,
    tolerance_of,
    with_momentum,
)

wp.set_module_options({"enable_backward": False})


@wp.func
def _excess_speed(
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
    along, across = effective_inverse_masses(motion, vertices, constraints, i, vertices.x1, ONE)
    if along <= ZERO:
        return old
    excess = _excess_speed(motion, vertices, constraints, i, restitution)
    velocity = relative(constraints.weights[i], constraints.vertices[i], vertices.velocity)
    friction = wp.float64(constraints.friction[i])
    return multiplier_after(old, constraints.normal[i], excess, velocity, along, across, friction)


@wp.func
def initial_velocity_multiplier(constraints: Constraints, i: int, dt: wp.float64) -> wp.vec3d:
    """Returns the impulse that goes with the position multiplier, without the part that made the separation."""
    return constraints.position_multiplier[i] * (constraints.approach[i] / dt)


@wp.kernel
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
    constraints.last_sweep[i] = NEVER_SWEPT


@wp.kernel
def activate_velocity_constraints(
    motion: Motion,
    vertices: Vertices,
    constraints: Constraints,
    status: SolveStatus,
    restitution: wp.array[float],
    tolerance: wp.float64,
    dt: wp.float64,
):
    """Fills the active set for velocities: constraints that pushed, whose contact points are still near each other."""
    i = wp.tid()
    if i >= constraints.count[0]:
        return
    if status.loop.sweep[0] >= max_sweeps(motion, constraints, status, i, status.slow_velocity_sweeps):
        return
    multiplier = constraints.velocity_multiplier[i]
    if wp.length_sq(multiplier) == ZERO:
        if not has_pushed(constraints, i):
            return
        if gap(vertices, constraints, i) > constraints.separation[i] - min_distance_of(constraints, i):
            return
    tolerance = tolerance_of(motion, constraints, i, tolerance) / dt
    normal = constraints.normal[i]
    excess = _excess_speed(motion, vertices, constraints, i, restitution)
    active = excess < -tolerance
    if not active and wp.length_sq(multiplier) > ZERO:
        velocity = relative(constraints.weights[i], constraints.vertices[i], vertices.velocity)
        friction = wp.float64(constraints.friction[i])
        active = excess > tolerance or not is_held_by_friction(multiplier, normal, velocity, friction, tolerance)
    if active:
        activate(motion, vertices, constraints, i)


@wp.kernel
def project_velocities(
    motion: Motion,
    vertices: Vertices,
    constraints: Constraints,
    status: SolveStatus,
    record: StepRecord,
    restitution: wp.array[float],
):
    """Updates the velocity multipliers of the active set, in one Jacobi sweep, see :func:`project_positions`."""
    place = wp.tid()
    if wp.int64(place) >= constraints.active_count[0]:
        return
    i = constraints.active_set[place]
    last_sweep = max_sweeps(motion, constraints, status, i, status.slow_velocity_sweeps) - 1
    momentum = momentum_of(constraints, status, i, last_sweep)
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


@wp.kernel
def update_velocities(
    motion: Motion, vertices: Vertices, constraints: Constraints, status: SolveStatus, record: StepRecord, last: bool
):
    """Changes the velocity of each vertex that was not truncated, and finishes the sweep."""
    vertex = wp.tid()
    if vertex == 0:
        finish_sweep(constraints, status, record, last)
    if vertices.active[vertex] == 0:
        return
    if last:
        vertices.active[vertex] = 0
    if motion.inverse_mass[vertex] > 0.0 and not has_final_velocity(vertices.outcome[vertex]):
        vertices.velocity[vertex] = with_delta(motion.velocity[vertex], vertices.particle_delta_v, vertex)


def project(work: Workspace, dt: float) -> None:
    """Solves friction and restitution of all contacts that moved a vertex, and restores angular momentum.

    Args:
        work: The workspace of the step.
        dt: Length of the step [s].
    """
    work.launch_over_bodies(move_to_end)
    inputs = [work.motion.vertices, work.vertices, work.constraints, dt]
    work.launch_over_constraints(initialize_velocity_multipliers, inputs)
    _update(work, last=True)
    repeat(work, lambda first, last: _sweep(work, first, last, dt))
    restore_angular_momentum(work)


def _sweep(work, first, last, dt):
    """Sweeps over the constraints once; the first sweep fills the active set, the last empties it."""
    inputs = [work.motion.vertices, work.vertices, work.constraints, work.status]
    if first:
        options = [work.restitution, work.tolerance, dt]
        work.launch_over_constraints(activate_velocity_constraints, [*inputs, *options])
    work.launch_over_active_set(project_velocities, [*inputs, work.record, work.restitution])
    _update(work, last)


def _update(work, last):
    inputs = [work.motion.vertices, work.vertices, work.constraints, work.status, work.record, last]
    work.launch_over_particles(update_velocities, inputs, at_least_once=True)
    work.launch_over_bodies(change_body_velocities, last)
    work.launch_over_shape_vertices(set_vertex_velocities)
