"""Projection of velocities: sweeps over the constraints that pushed, then the turns that restore angular momentum."""

import warp as wp

from ..contacts.constraints import NEVER_SWEPT, gap, has_pushed, min_distance_of
from ..schedule import SolveStatus
from ..state.fixed_sum import with_delta
from ..state.record import StepRecord
from ..state.structs import Constraints, Motion, Vertices, has_final_velocity
from ..state.vectors import ZERO, relative
from ..state.workspace import Workspace
from .angular_momentum import sum_body_moments, sum_moments, sum_torques, turn_bodies, turn_vertices
from .bodies import activate_bodies, change_body_velocities, move_to_end, set_vertex_velocities
from .sweeps import (
    activate,
    add_delta,
    after_sweep,
    excess_speed,
    finish_sweep,
    initial_velocity_multiplier,
    is_held_by_friction,
    max_sweeps,
    momentum_of,
    repeat,
    tolerance_of,
    velocity_multiplier_after,
)

wp.set_module_options({"enable_backward": False})


@wp.kernel
def initialize_velocity_multipliers(motion: Motion, dt: wp.float64, vertices: Vertices, constraints: Constraints):
    """Initializes the velocity multipliers of all constraints that pushed, as if contacts had acted at their times.

    This conserves angular momentum, because the two sides of a contact meet in one point at that time only.
    """
    i = wp.tid()
    if i >= constraints.count[0]:
        return
    if has_pushed(constraints, i):
        impulse = initial_velocity_multiplier(constraints, i, dt)
        constraints.velocity_multiplier[i] = impulse
        for j in range(4):
            vertices.active[constraints.vertices[i][j]] = 1
        if motion.bodies.of_vertex:
            activate_bodies(motion, vertices, constraints, i)
        sums = vertices.particle_delta_v
        add_delta(motion, vertices, constraints, i, impulse, vertices.x1, sums, vertices.bodies.delta_v)
    constraints.previous_multiplier[i] = constraints.velocity_multiplier[i]
    constraints.last_sweep[i] = NEVER_SWEPT


@wp.kernel
def activate_velocity_constraints(
    # in
    motion: Motion,
    status: SolveStatus,
    restitution: wp.array[float],
    tolerance: wp.float64,
    dt: wp.float64,
    # in and out
    vertices: Vertices,
    constraints: Constraints,
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
    excess = excess_speed(motion, vertices, constraints, i, restitution)
    active = excess < -tolerance
    if not active and wp.length_sq(multiplier) > ZERO:
        velocity = relative(constraints.weights[i], constraints.vertices[i], vertices.velocity)
        friction = wp.float64(constraints.friction[i])
        held = is_held_by_friction(multiplier, constraints.normal[i], velocity, friction, tolerance)
        active = excess > tolerance or not held
    if active:
        activate(motion, vertices, constraints, i)


@wp.kernel
def project_velocities(
    # in
    motion: Motion,
    status: SolveStatus,
    restitution: wp.array[float],
    # in and out
    vertices: Vertices,
    constraints: Constraints,
    record: StepRecord,
):
    """Updates the velocity multipliers of the active set, in one Jacobi sweep."""
    place = wp.tid()
    if wp.int64(place) >= constraints.active_count[0]:
        return
    i = constraints.active_set[place]
    last_sweep = max_sweeps(motion, constraints, status, i, status.slow_velocity_sweeps) - 1
    momentum = momentum_of(constraints, status, i, last_sweep)
    multiplier = velocity_multiplier_after(motion, vertices, constraints, i, restitution)
    old = constraints.velocity_multiplier[i]
    new = after_sweep(constraints, record, place, old, multiplier, momentum)
    constraints.velocity_multiplier[i] = new
    sums = vertices.particle_delta_v
    add_delta(motion, vertices, constraints, i, new - old, vertices.x1, sums, vertices.bodies.delta_v)


@wp.func
def change_velocity(motion: Motion, vertices: Vertices, vertex: int) -> bool:
    """Changes a velocity by the sum of its changes by constraints, if they may change it; returns whether they may."""
    is_free = motion.inverse_mass[vertex] > 0.0 and not has_final_velocity(vertices.outcome[vertex])
    if is_free:
        vertices.velocity[vertex] = with_delta(motion.velocity[vertex], vertices.particle_delta_v, vertex)
    return is_free


@wp.kernel
def update_velocities(
    motion: Motion, last: bool, vertices: Vertices, constraints: Constraints, status: SolveStatus, record: StepRecord
):
    """Changes the velocity of each vertex that was not truncated, and finishes the sweep."""
    vertex = wp.tid()
    if not finish_sweep(vertices, constraints, status, record, last, vertex):
        return
    change_velocity(motion, vertices, vertex)


def project(work: Workspace, dt: float) -> None:
    """Solves friction and restitution of all contacts that moved a vertex in a step of length ``dt`` [s].

    Then restores angular momentum.
    """
    work.launch_over_bodies(move_to_end)
    inputs = [work.motion.vertices, dt, work.vertices, work.constraints]
    work.launch_over_constraints(initialize_velocity_multipliers, inputs)
    _update(work, last=True)
    repeat(work.status, work.reserve_entries, lambda first, last: _sweep(work, first, last, dt))
    _restore_angular_momentum(work)


def _sweep(work, first, last, dt):
    """Sweeps over the constraints once; the first sweep fills the active set, the last empties it."""
    inputs, changed = [work.motion.vertices, work.status, work.restitution], [work.vertices, work.constraints]
    if first:
        work.launch_over_constraints(activate_velocity_constraints, [*inputs, work.tolerance, dt, *changed])
    work.launch_over_active_set(project_velocities, [*inputs, *changed, work.record])
    _update(work, last)


def _update(work, last):
    inputs = [work.motion.vertices, last, work.vertices, work.constraints, work.status, work.record]
    work.launch_over_particles(update_velocities, inputs, at_least_once=True)
    work.launch_over_bodies(change_body_velocities, last)
    work.launch_over_shape_vertices(set_vertex_velocities)


def _restore_angular_momentum(work):
    """Turns all that collided in each world where nothing is held, which removes the torque that contacts added."""
    inputs, threads = [work.motion.vertices, work.vertices], work.summing_threads
    work.turn.zero_()
    for kernel, summed in ((sum_torques, work.constraints), (sum_moments, work.particle_count)):
        work.launch(kernel, threads, [*inputs, summed, threads, work.turn])
    work.launch_over_bodies(sum_body_moments, work.turn)
    work.launch_over_particles(turn_vertices, [*inputs, work.turn])
    work.launch_over_bodies(turn_bodies, work.turn)
