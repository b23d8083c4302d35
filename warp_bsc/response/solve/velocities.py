"""Projection of velocities: sweeps over the constraints that pushed, then the turns that restore angular momentum."""

import functools

import warp as wp

from ..._profiling import phase
from ..contacts.constraints import NEVER_SWEPT, gap, has_pushed, min_distance_of, moves_body
from ..state.fixed_sum import with_delta
from ..state.status import Loop, SolveStatus
from ..state.structs import Incidence, Step, constraint_at, constraint_count, has_final_velocity
from ..state.team import BLOCK, LARGE_BLOCK, Team, in_one_block, large_team, team_of_world, wait_for_others
from ..state.vectors import ONE, ZERO, relative
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
from .kept import KeptConstraint, make_sweeps, values_of
from .kept import project as project_kept

wp.set_module_options({"enable_backward": False})


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


@wp.kernel
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
def _keep(step: Step, i: int, is_here: bool) -> KeptConstraint:
    """Returns a constraint as :func:`make_sweeps` takes it; none of its vertices is of a body."""
    constraints, kept = step.constraints, KeptConstraint()
    kept.is_here = is_here
    kept.corners = constraints.vertices[i]
    kept.weights = constraints.weights[i]
    for j in range(4):
        vertex = kept.corners[j]
        moves = kept.weights[j] != ZERO and step.motion.inverse_mass[vertex] > 0.0
        kept.moves[j] = wp.where(moves and not has_final_velocity(step.vertices.outcome[vertex]), 1, 0)
    kept.normal = constraints.normal[i]
    kept.target = sweeps.speed_of_restitution(step, i)
    kept.inverse_mass = sweeps.inverse_mass_of_vertices(step, i, ONE)
    kept.friction = wp.float64(constraints.friction[i])
    kept.least = constraints.resisted[i]
    kept.most = MAX_SWEEPS
    kept.multiplier = constraints.velocity_multiplier[i]
    kept.previous = constraints.previous_multiplier[i]
    kept.last = constraints.last_sweep[i]
    return kept


@wp.func
def _store(step: Step, i: int, kept: KeptConstraint):
    """Stores what sweeps changed of a constraint."""
    step.constraints.velocity_multiplier[i] = kept.multiplier
    step.constraints.previous_multiplier[i] = kept.previous
    step.constraints.last_sweep[i] = kept.last


@wp.func
def _sweep_in_memory(step: Step, sweep: int, i: int):
    """Makes a sweep over one of more constraints than there are threads."""
    vertices, kept = step.vertices, _keep(step, i, True)
    values = values_of(kept, vertices.velocity)
    _store(step, i, project_kept(kept, values, step.motion.inverse_mass, vertices.particle_delta_v, sweep))


@wp.func
def _sweep_in_registers(step: Step, status: SolveStatus, team: Team, number: int, blocks: int):
    """Makes a number of sweeps over an active set of which each thread has one constraint at most."""
    vertices, constraints = step.vertices, step.constraints
    place = team.first + team.thread
    i = int(constraints.active_set[wp.min(place, team.end - 1)])
    kept = make_sweeps(
        _keep(step, i, place < team.end),
        step.motion.inverse_mass,
        step.motion.velocity,
        vertices.velocity,
        vertices.particle_delta_v,
        status,
        team,
        number,
        blocks,
    )
    if kept.is_here:
        _store(step, i, kept)
        for j in range(4):
            vertices.active[kept.corners[j]] = 0


@wp.func
def _update(step: Step, particles: Incidence, last: bool, team: Team):
    """Changes the velocities of the vertices of a team that were not truncated."""
    for k in range(team.first_particle + team.thread, team.end_particle, team.threads):
        if sweeps.takes_changes(step, last, particles.items[k]):
            _change_velocity(step, particles.items[k])


@wp.func
def _make_batch(step: Step, particles: Incidence, status: SolveStatus, team: Team, number: int):
    """Makes a number of sweeps over an active set, by as few blocks as have a thread for each constraint."""
    if team.end - team.first > team.threads:
        for i_of_batch in range(number):
            for place in range(team.first + team.thread, team.end, team.threads):
                i = int(step.constraints.active_set[place])
                _sweep_in_memory(step, team.sweep + i_of_batch, i)
            wait_for_others(status, team.blocks)
            _update(step, particles, i_of_batch == number - 1, team)
            wait_for_others(status, team.blocks)
    else:
        blocks = wp.where(team.end - team.first > team.block, team.blocks, 1)
        if blocks != 1 or team.thread < team.block:
            _sweep_in_registers(step, status, team, number, blocks)


@functools.cache
def _sweep(cluster: int) -> wp.Kernel:
    """Returns the kernel that solves velocities of each world by one cluster of blocks, see :mod:`.state.team`."""

    @wp.kernel(module="unique", enable_backward=False, cluster_dim=cluster, launch_bounds=BLOCK)
    def sweep_velocities(
        # in and out
        step: Step,
        # in
        particles: Incidence,
        status: SolveStatus,
        tolerance: wp.float64,
        batch: int,
        # out
        sums: wp.array2d[wp.int64],
        # in
        threads: int,
    ):
        """Solves velocities, with a new active set after each ``batch`` of sweeps, and restores angular momentum."""
        world = wp.tid() // threads
        team = team_of_world(step, particles, world, wp.tid() - world * threads, threads)
        thread, first = team.thread, team.first
        end = first + step.constraints.number[world]
        if end == first:
            return
        for column in range(thread, sums.shape[1], threads):
            sums[world, column] = wp.int64(0)
        for place in range(first + thread, end, threads):
            _initialize_multiplier(step, constraint_at(step, place))
        wait_for_others(status, team.blocks)
        _update(step, particles, True, team)
        wait_for_others(status, team.blocks)
        team = in_one_block(team, end - first)
        most = wp.where(thread < team.threads, int(MAX_SWEEPS), 0)
        while team.sweep < most:
            if thread == 0:
                step.constraints.active_count[world] = wp.int64(0)
            wait_for_others(status, team.blocks)
            for place in range(first + thread, end, team.threads):
                i = constraint_at(step, place)
                if _is_active(step, tolerance, i):
                    sweeps.activate(step, i, world, first)
            wait_for_others(status, team.blocks)
            team.end = first + int(step.constraints.active_count[world])
            if team.end == first:
                break
            _make_batch(step, particles, status, team, batch)
            wait_for_others(status, team.blocks)
            team.sweep += batch
        wait_for_others(status, 0)
        add_torques(step, first + thread, end, threads, sums)
        wait_for_others(status, 0)
        add_moments(step, particles, team.first_particle + thread, team.end_particle, threads, sums)
        wait_for_others(status, 0)
        for k in range(team.first_particle + thread, team.end_particle, threads):
            turn_vertex(step, sums, particles.items[k])

    return sweep_velocities


@wp.kernel(module="unique", enable_backward=False, launch_bounds=LARGE_BLOCK)
def sweep_velocities_together(step: Step, particles: Incidence, status: SolveStatus, number: int, threads: int):
    """Makes a number of sweeps over the active set of all worlds, by a :func:`.large_team`."""
    team = large_team(step, particles, status, wp.tid(), threads)
    if team.end > 0:
        _make_batch(step, particles, status, team, number)
    if team.thread == 0:
        sweeps.finish_sweeps(step, status, team.sweep + number, team.end, True)


@phase("project velocities")
def project(work: Workspace, dt: float) -> None:
    """Solves friction and restitution of all contacts that moved a vertex in a step of length ``dt`` [s].

    Then restores angular momentum: turns all that collided in each world where nothing is held, which removes the
    torque that contacts added.
    """
    work.step.dt = dt
    if work.sweeping_threads:
        work.sweep_by_world(_sweep, [work.status, work.tolerance, int(SWEEPS_PER_BATCH), work.moments])
        return
    work.launch_over_bodies(move_to_end)
    work.launch_over_constraints(initialize_velocity_multipliers)
    _update_all(work, last=True)
    activate = functools.partial(work.launch_over_constraints, activate_velocity_constraints, work.tolerance)
    work.repeat_sweeps(activate, sweep_velocities_together, project_velocities, _update_all)
    _restore_angular_momentum(work)


def _update_all(work, last):
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
