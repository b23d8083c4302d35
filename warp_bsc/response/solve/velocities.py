"""Projection of velocities: sweeps over the constraints that pushed, then the turns that restore angular momentum."""

import functools

import warp as wp

from ..._profiling import phase
from ..contacts.constraints import NEVER_SWEPT, gap, has_pushed, min_distance_of, moves_body
from ..state.cluster import BLOCK, constraints_of_world, wait_for_block, wait_for_others
from ..state.fixed_sum import add_to_sum, with_delta
from ..state.status import Loop, SolveStatus
from ..state.structs import Incidence, Step, constraint_at, constraint_count, has_final_velocity
from ..state.vectors import ONE, ZERO, relative, to_double
from ..state.workspace import Workspace
from ..tuning import MAX_SWEEPS, SWEEPS_PER_BATCH, TOLERANCE_OF_BODIES
from . import sweeps
from .angular_momentum import (
    add_moments,
    add_torques,
    sum_body_moments,
    sum_moments,
    sum_torques,
    turn_bodies,
    turn_vertex,
    turn_vertices,
)
from .bodies import activate_bodies, change_body_velocities, move_to_end, set_vertex_velocities

wp.set_module_options({"enable_backward": False})

_Velocities = wp.types.matrix(shape=(4, 3), dtype=wp.float32)
"""Of the vertices of a constraint [m/s]."""


@wp.func
def _initialize_multiplier(step: Step, i: int):
    """Initializes the velocity multiplier of a constraint, if it pushed, as if the contact had acted at its time.

    This conserves angular momentum, because the two sides of a contact meet in one point at that time only.
    """
    vertices, constraints = step.vertices, step.constraints
    if has_pushed(step, i):
        impulse = sweeps.initial_velocity_multiplier(step, i)
        constraints.velocity_multiplier[i] = impulse
        constraints.resisted[i] = sweeps.resisted_push(step, i)
        for j in range(4):
            vertices.active[constraints.vertices[i][j]] = 1
        if step.motion.bodies.of_vertex:
            activate_bodies(step, i)
        sweeps.add_delta(step, i, impulse, vertices.x1, vertices.particle_delta_v, vertices.bodies.delta_v)
    constraints.previous_multiplier[i] = constraints.velocity_multiplier[i]
    constraints.last_sweep[i] = NEVER_SWEPT


@wp.kernel
def initialize_velocity_multipliers(step: Step, threads: int):
    """Initializes the velocity multipliers of all constraints."""
    for i in range(wp.tid(), constraint_count(step), threads):
        _initialize_multiplier(step, i)


@wp.func
def _is_active(step: Step, tolerance: wp.float64, i: int) -> bool:
    """Returns whether a constraint is active: it pushed, and its contact points are still near each other."""
    constraints = step.constraints
    multiplier = constraints.velocity_multiplier[i]
    acts = wp.length_sq(multiplier) > ZERO
    if not acts:
        if not has_pushed(step, i) or gap(step, i) > constraints.separation[i] - min_distance_of(step, i):
            return False
    tolerance = wp.where(moves_body(step, i), TOLERANCE_OF_BODIES, ONE) * tolerance / step.dt
    excess = sweeps.excess_speed(step, i)
    active = excess < -tolerance
    least = constraints.resisted[i]
    if not active and (acts or least > ZERO):
        velocity = relative(constraints.weights[i], constraints.vertices[i], step.vertices.velocity)
        friction = wp.float64(constraints.friction[i])
        held = sweeps.is_held_by_friction(multiplier, constraints.normal[i], velocity, friction, least, tolerance)
        active = (acts and excess > tolerance) or not held
    return active


@wp.kernel
def activate_velocity_constraints(step: Step, tolerance: wp.float64, threads: int):
    """Fills the active set for velocities."""
    for i in range(wp.tid(), constraint_count(step), threads):
        if _is_active(step, tolerance, i):
            sweeps.activate(step, i, 0, 0)


@wp.func
def _project_constraint(step: Step, sweep: int, place: int):
    """Updates the velocity multiplier of an element of the active set."""
    vertices, constraints = step.vertices, step.constraints
    i = constraints.active_set[place]
    momentum = sweeps.momentum_of(step, sweep, i, MAX_SWEEPS)
    multiplier = sweeps.velocity_multiplier_after(step, i)
    old = constraints.velocity_multiplier[i]
    new = sweeps.after_sweep(step, i, multiplier, momentum)
    constraints.velocity_multiplier[i] = new
    sweeps.add_delta(step, i, new - old, vertices.x1, vertices.particle_delta_v, vertices.bodies.delta_v)


@wp.kernel(launch_bounds=(BLOCK, 2))
def project_velocities(step: Step, status: SolveStatus, threads: int):
    """Updates the velocity multipliers of the active set, in one Jacobi sweep."""
    for place in range(wp.tid(), int(step.constraints.active_count[0]), threads):
        _project_constraint(step, status.loop[Loop.SWEEP], place)


@wp.func
def _change_velocity(step: Step, vertex: int):
    """Changes a velocity by the sum of its changes by constraints, if they may change it."""
    motion, vertices = step.motion, step.vertices
    if motion.inverse_mass[vertex] > 0.0 and not has_final_velocity(vertices.outcome[vertex]):
        vertices.velocity[vertex] = with_delta(motion.velocity[vertex], vertices.particle_delta_v, vertex)


@wp.kernel
def update_velocities(step: Step, status: SolveStatus, last: bool):
    """Changes the velocity of each vertex that was not truncated, and finishes the sweep."""
    vertex = wp.tid()
    if sweeps.finish_sweep(step, status, last, vertex):
        _change_velocity(step, vertex)


@wp.func
def _update_world(step: Step, particles: Incidence, world: int, last: bool, thread: int, threads: int):
    """Changes the velocities of the vertices of a world that were not truncated."""
    for k in range(particles.first[world] + thread, particles.first[world + 1], threads):
        if sweeps.takes_changes(step, last, particles.items[k]):
            _change_velocity(step, particles.items[k])


@wp.func
def _sweep_alone(step: Step, sweep: int, batch: int, place: int, end: int):
    """Makes a batch of sweeps over at most as many constraints as a block has threads, none of which moves a body.

    Results are those of any other sweeps. Each thread keeps its constraint and the velocities of its vertices: most of
    the time of a sweep over few is that of one thread's instructions. In cloth_twist of Newton it takes a third less.
    """
    motion, vertices, constraints = step.motion, step.vertices, step.constraints
    is_here = place < end
    i = int(constraints.active_set[wp.min(place, end - 1)])
    corners, weights = wp.vec4i(constraints.vertices[i]), wp.vec4d(constraints.weights[i])  # copies, not references
    normal = wp.vec3d(constraints.normal[i])
    friction, least = wp.float64(constraints.friction[i]), wp.float64(constraints.resisted[i])
    along, _across = sweeps.effective_inverse_masses(step, i, vertices.x1, ONE)
    restitution = sweeps.speed_of_restitution(step, i)
    multiplier = wp.vec3d(constraints.velocity_multiplier[i])
    previous = wp.vec3d(constraints.previous_multiplier[i])
    last = int(constraints.last_sweep[i])
    shares, moves, predicted, velocity = wp.vec4d(), wp.vec4i(), _Velocities(), _Velocities()
    for j in range(4):
        vertex = corners[j]
        shares[j] = weights[j] * wp.float64(motion.inverse_mass[vertex])
        moves[j] = wp.where(shares[j] == ZERO or has_final_velocity(vertices.outcome[vertex]), 0, 1)
        predicted[j] = motion.velocity[vertex]
        velocity[j] = vertices.velocity[vertex]
    for now in range(sweep, sweep + batch):
        if is_here:
            parting = wp.vec3d()
            for j in range(4):
                parting += weights[j] * to_double(velocity[j])
            after = wp.vec3d(multiplier)
            if along > ZERO:
                excess = wp.dot(normal, parting) - restitution
                after = sweeps.multiplier_after(multiplier, normal, excess, parting, along, along, friction, least)
            moved = after + sweeps.momentum_after(last, now, MAX_SWEEPS) * (after - previous)
            for j in range(4):
                if shares[j] != ZERO:
                    add_to_sum(vertices.particle_delta_v, corners[j], 0, shares[j] * (moved - multiplier))
            previous, multiplier, last = after, moved, now
        wait_for_block()
        if is_here:
            for j in range(4):
                if moves[j] != 0:
                    velocity[j] = with_delta(predicted[j], vertices.particle_delta_v, corners[j])
        wait_for_block()
    if not is_here:
        return
    constraints.velocity_multiplier[i] = multiplier
    constraints.previous_multiplier[i] = previous
    constraints.last_sweep[i] = last
    for j in range(4):
        vertices.active[corners[j]] = 0
        if moves[j] != 0:
            vertices.velocity[corners[j]] = velocity[j]


@functools.cache
def _sweep(cluster: int) -> wp.Kernel:
    """Returns the kernel that solves velocities of each world by one cluster of blocks, see :mod:`.state.cluster`."""

    @wp.kernel(module="unique", enable_backward=False, cluster_dim=cluster, launch_bounds=BLOCK)
    def sweep_velocities(
        step: Step, particles: Incidence, tolerance: wp.float64, batch: int, sums: wp.array2d[wp.int64], threads: int
    ):
        """Solves velocities, with a new active set after each ``batch`` of sweeps, and restores angular momentum."""
        world = wp.tid() // threads
        thread = wp.tid() - world * threads
        constraints = step.constraints
        first = int(constraints.first[world])
        end = first + constraints_of_world(step, world)
        if end == first:
            return
        for column in range(thread, sums.shape[1], threads):
            sums[world, column] = wp.int64(0)
        for place in range(first + thread, end, threads):
            _initialize_multiplier(step, constraint_at(step, place))
        wait_for_others()
        _update_world(step, particles, world, True, thread, threads)
        wait_for_others()
        sweep = int(0)
        while sweep < MAX_SWEEPS:
            if thread == 0:
                constraints.active_count[world] = wp.int64(0)
            wait_for_others()
            for place in range(first + thread, end, threads):
                i = constraint_at(step, place)
                if _is_active(step, tolerance, i):
                    sweeps.activate(step, i, world, first)
            wait_for_others()
            active_end = first + int(constraints.active_count[world])
            if active_end == first:
                break
            if active_end - first <= wp.min(threads, BLOCK):
                if thread < BLOCK:
                    _sweep_alone(step, sweep, batch, first + thread, active_end)
                wait_for_others()
                sweep += batch
                continue
            for i_of_batch in range(batch):
                for place in range(first + thread, active_end, threads):
                    _project_constraint(step, sweep, place)
                wait_for_others()
                _update_world(step, particles, world, i_of_batch == batch - 1, thread, threads)
                wait_for_others()
                sweep += 1
        add_torques(step, first + thread, end, threads, sums)
        wait_for_others()
        add_moments(step, particles, particles.first[world] + thread, particles.first[world + 1], threads, sums)
        wait_for_others()
        for k in range(particles.first[world] + thread, particles.first[world + 1], threads):
            turn_vertex(step, sums, particles.items[k])

    return sweep_velocities


@phase("project velocities")
def project(work: Workspace, dt: float) -> None:
    """Solves friction and restitution of all contacts that moved a vertex in a step of length ``dt`` [s].

    Then restores angular momentum: turns all that collided in each world where nothing is held, which removes the
    torque that contacts added.
    """
    work.step.dt = dt
    if work.sweeping_threads:
        work.sweep_by_world(_sweep, [work.tolerance, int(SWEEPS_PER_BATCH), work.moments])
        return
    work.launch_over_bodies(move_to_end)
    work.launch_over_constraints(initialize_velocity_multipliers)
    _update(work, last=True)
    activate = functools.partial(work.launch_over_constraints, activate_velocity_constraints, work.tolerance)
    work.repeat_sweeps(activate, project_velocities, _update)
    _restore_angular_momentum(work)


def _update(work, last):
    work.launch_over_particles(update_velocities, work.status, last, at_least_once=True)
    work.launch_over_bodies(change_body_velocities, last)
    work.launch_over_shape_vertices(set_vertex_velocities)


def _restore_angular_momentum(work):
    sums, threads = work.moments, work.summing_threads
    sums.zero_()
    work.launch(sum_torques, threads, [work.step, threads, sums])
    work.launch(sum_moments, threads, [work.step, work.particles, threads, sums])
    work.launch_over_bodies(sum_body_moments, sums)
    work.launch_over_particles(turn_vertices, sums)
    work.launch_over_bodies(turn_bodies, sums)
