"""Projection of positions: sweeps over the constraints that move vertices and bodies."""

import functools

import warp as wp

from ..._profiling import phase
from ..contacts.constraints import gap, min_distance_of, moves_body
from ..schedule import divides_after, is_reversible, projects_now
from ..state.fixed_sum import with_delta
from ..state.status import Loop, SolveStatus, start_sweeps
from ..state.structs import PROJECTED, ContactKind, Incidence, Pace, Step, constraint_at, constraint_count
from ..state.team import BLOCK, LARGE_BLOCK, Team, in_one_block, large_team, team_of_world, wait_for_others
from ..state.vectors import ONE, ZERO, relative
from ..state.workspace import Workspace
from ..tuning import (
    CLOSE_EDGES,
    COUNTED,
    MAX_SWEEPS,
    PUSHING_MOMENTUM,
    SWEEPS_PER_BATCH,
    TOLERANCE_OF_BODIES,
    TOLERANCE_OF_CHANGE,
    TOLERANCE_OF_DISTANCE,
)
from . import sweeps
from .bodies import move_bodies, place_vertices
from .kept import KeptConstraint, make_sweeps, values_of
from .kept import project as project_kept

wp.set_module_options({"enable_backward": False})


@wp.func
def _is_active(step: Step, status: SolveStatus, sweep: int, tolerance: wp.float64, i: int) -> bool:
    """Returns whether a constraint is active for positions: it is violated, or may pull something back.

    Skipped are constraints that are met within the tolerance; proximities that a later division will separate, because
    projection ignores elasticity and would stretch a stack, except at rest, where friction must hold them; and edges at
    rest that are not too near each other, because vertex-face proximities, a fourth as many, already hold the stack.
    """
    motion, constraints = step.motion, step.constraints
    corners = constraints.vertices[i]
    world = motion.world[corners[0]]
    kind = constraints.kind[i]
    if kind > ContactKind.PLANE and divides_after(status, world, status.loop[Loop.ITERATION]):
        if constraints.pace[i] != Pace.RESTING:
            return False
        if kind == ContactKind.EDGE_EDGE_PROXIMITY:
            kept = min_distance_of(step, i)
            start = wp.dot(constraints.normal[i], relative(constraints.weights[i], corners, motion.x0))
            if start - kept >= CLOSE_EDGES * (constraints.separation[i] - kept):
                return False
    past = sweep >= sweeps.max_position_sweeps(step, status, i)
    if past or not projects_now(status, world):
        return False
    normal = constraints.normal[i]
    separation = constraints.separation[i]
    distance = gap(step, i)
    if constraints.kind[i] == ContactKind.PLANE:  # whose separation is an offset
        predicted = wp.dot(normal, relative(constraints.weights[i], corners, motion.x1))
        if predicted < separation:
            tolerance = wp.min(tolerance, TOLERANCE_OF_CHANGE * (separation - predicted))
    else:
        tolerance = wp.min(tolerance, TOLERANCE_OF_DISTANCE * (separation - min_distance_of(step, i)))
    tolerance *= wp.where(moves_body(step, i), TOLERANCE_OF_BODIES, ONE)
    active = distance < -tolerance
    if not active and is_reversible(status, constraints.pace[i] != Pace.FAST):
        multiplier = constraints.position_multiplier[i]
        if wp.length_sq(multiplier) > ZERO:
            friction = wp.float64(constraints.friction[i])
            path = sweeps.path_of(step, i)
            active = distance > tolerance or not sweeps.is_held_by_friction(
                multiplier, normal, path, friction, ZERO, tolerance
            )
    return active


@wp.kernel
def activate_position_constraints(step: Step, status: SolveStatus, tolerance: wp.float64, threads: int):
    """Fills the active set for positions."""
    for i in range(wp.tid(), constraint_count(step), threads):
        if _is_active(step, status, status.loop[Loop.SWEEP], tolerance, i):
            sweeps.activate(step, i, 0, 0)


@wp.func
def _project_constraint(step: Step, status: SolveStatus, sweep: int, place: int):
    """Updates the position multiplier of an element of the active set."""
    vertices, constraints = step.vertices, step.constraints
    i = constraints.active_set[place]
    pushes_only = not is_reversible(status, constraints.pace[i] != Pace.FAST)
    momentum = sweeps.momentum_of(step, sweep, i, sweeps.max_position_sweeps(step, status, i))
    if pushes_only:
        violated = gap(step, i) < ZERO
        momentum = wp.where(violated, wp.min(momentum, PUSHING_MOMENTUM), ZERO)
    multiplier = sweeps.position_multiplier_after(step, i, pushes_only)
    old = constraints.position_multiplier[i]
    new = sweeps.after_sweep(step, i, multiplier, momentum)
    constraints.position_multiplier[i] = new
    sweeps.add_delta(step, i, new - old, step.motion.x1, vertices.particle_delta_x, vertices.bodies.delta_x)


@wp.kernel
def project_positions(step: Step, status: SolveStatus, threads: int):
    """Updates the position multipliers of the active set, in one Jacobi sweep."""
    for place in range(wp.tid(), int(step.constraints.active_count[0]), threads):
        _project_constraint(step, status, status.loop[Loop.SWEEP], place)


@wp.func
def _update_vertex(step: Step, vertex: int):
    """Moves a vertex by the sum of what its constraints did to it, if it can be moved."""
    if step.motion.inverse_mass[vertex] > 0.0:
        step.vertices.x1[vertex] = with_delta(step.motion.x1[vertex], step.vertices.particle_delta_x, vertex)
        step.vertices.changed[vertex] = 1
        step.vertices.outcome[vertex] = step.vertices.outcome[vertex] | PROJECTED


@wp.kernel
def update_positions(step: Step, status: SolveStatus, last: bool):
    """Moves each vertex by the sum of what its constraints did to it, and finishes the sweep."""
    vertex = wp.tid()
    if sweeps.finish_sweep(step, status, last, vertex):
        _update_vertex(step, vertex)


@wp.func
def _keep(step: Step, status: SolveStatus, i: int, is_here: bool) -> KeptConstraint:
    """Returns a constraint as :func:`make_sweeps` takes it; none of its vertices is of a body."""
    constraints, kept = step.constraints, KeptConstraint()
    kept.is_here = is_here
    kept.corners = constraints.vertices[i]
    kept.weights = constraints.weights[i]
    for j in range(4):
        moves = kept.weights[j] != ZERO and step.motion.inverse_mass[kept.corners[j]] > 0.0
        kept.moves[j] = wp.where(moves, 1, 0)
    kept.normal = constraints.normal[i]
    kept.target = constraints.separation[i]
    kept.origin = relative(kept.weights, kept.corners, step.motion.x0)
    kept.pushes_only = not is_reversible(status, constraints.pace[i] != Pace.FAST)
    counted = wp.where(kept.pushes_only, COUNTED, ONE)
    kept.inverse_mass = sweeps.inverse_mass_of_vertices(step, i, counted)
    kept.friction = wp.float64(constraints.friction[i])
    kept.most = sweeps.max_position_sweeps(step, status, i)
    kept.multiplier = constraints.position_multiplier[i]
    kept.previous = constraints.previous_multiplier[i]
    kept.last = constraints.last_sweep[i]
    return kept


@wp.func
def _store(step: Step, i: int, kept: KeptConstraint):
    """Stores what sweeps changed of a constraint."""
    step.constraints.position_multiplier[i] = kept.multiplier
    step.constraints.previous_multiplier[i] = kept.previous
    step.constraints.last_sweep[i] = kept.last


@wp.func
def _sweep_in_memory(step: Step, status: SolveStatus, sweep: int, i: int):
    """Makes a sweep over one of more constraints than there are threads."""
    vertices, kept = step.vertices, _keep(step, status, i, True)
    values = values_of(kept, vertices.x1)
    _store(step, i, project_kept(kept, values, step.motion.inverse_mass, vertices.particle_delta_x, sweep))


@wp.func
def _sweep_in_registers(step: Step, status: SolveStatus, team: Team, number: int, blocks: int):
    """Makes a number of sweeps over an active set of which each thread has one constraint at most."""
    motion, vertices, constraints = step.motion, step.vertices, step.constraints
    place = team.first + team.thread
    i = int(constraints.active_set[wp.min(place, team.end - 1)])
    kept = make_sweeps(
        _keep(step, status, i, place < team.end),
        motion.inverse_mass,
        motion.x1,
        vertices.x1,
        vertices.particle_delta_x,
        status,
        team,
        number,
        blocks,
    )
    if kept.is_here:
        _store(step, i, kept)
        for j in range(4):
            vertex = kept.corners[j]
            vertices.active[vertex] = 0
            if kept.moves[j] != 0:
                vertices.changed[vertex] = 1
                vertices.outcome[vertex] = vertices.outcome[vertex] | PROJECTED


@wp.func
def _make_batch(step: Step, particles: Incidence, status: SolveStatus, team: Team, number: int):
    """Makes a number of sweeps over an active set, by as few blocks as have a thread for each constraint."""
    if team.end - team.first > team.threads:
        for i_of_batch in range(number):
            for place in range(team.first + team.thread, team.end, team.threads):
                i = int(step.constraints.active_set[place])
                _sweep_in_memory(step, status, team.sweep + i_of_batch, i)
            wait_for_others(status, team.blocks)
            for k in range(team.first_particle + team.thread, team.end_particle, team.threads):
                if sweeps.takes_changes(step, i_of_batch == number - 1, particles.items[k]):
                    _update_vertex(step, particles.items[k])
            wait_for_others(status, team.blocks)
    else:
        blocks = wp.where(team.end - team.first > team.block, team.blocks, 1)
        if blocks != 1 or team.thread < team.block:
            _sweep_in_registers(step, status, team, number, blocks)


@functools.cache
def _sweep(cluster: int) -> wp.Kernel:
    """Returns the kernel that makes sweeps over each world by one cluster of blocks, see :mod:`.state.team`."""

    @wp.kernel(module="unique", enable_backward=False, cluster_dim=cluster, launch_bounds=BLOCK)
    def sweep_positions(
        # in and out
        step: Step,
        # in
        particles: Incidence,
        status: SolveStatus,
        tolerance: wp.float64,
        most: int,
        batch: int,
        threads: int,
    ):
        """Makes at most so many sweeps, with a new active set after each ``batch`` of them."""
        world = wp.tid() // threads
        team = team_of_world(step, particles, world, wp.tid() - world * threads, threads)
        first = team.first
        end = first + step.constraints.number[world]
        team = in_one_block(team, end - first)
        sweeps_now = status.loop[Loop.MORE_SWEEPS] == 1 and end > first and team.thread < team.threads
        team.sweep = wp.where(sweeps_now, 0, most)
        while team.sweep < most:
            if team.thread == 0:
                step.constraints.active_count[world] = wp.int64(0)
            wait_for_others(status, team.blocks)
            for place in range(first + team.thread, end, team.threads):
                i = constraint_at(step, place)
                if _is_active(step, status, team.sweep, tolerance, i):
                    sweeps.activate(step, i, world, first)
            wait_for_others(status, team.blocks)
            team.end = first + int(step.constraints.active_count[world])
            if team.end == first:
                break
            _make_batch(step, particles, status, team, batch)
            wait_for_others(status, team.blocks)
            team.sweep += batch

    return sweep_positions


@wp.kernel(module="unique", enable_backward=False, launch_bounds=LARGE_BLOCK)
def sweep_positions_together(step: Step, particles: Incidence, status: SolveStatus, number: int, threads: int):
    """Makes a number of sweeps over the active set of all worlds, by a :func:`.large_team`."""
    team = large_team(step, particles, status, wp.tid(), threads)
    if team.end > 0:
        _make_batch(step, particles, status, team, number)
    if team.thread == 0:
        sweeps.finish_sweeps(step, status, team.sweep + number, team.end, True)


@phase("project positions")
def project(work: Workspace) -> None:
    """Moves vertices and bodies apart at the end of the step, until their constraints are met."""
    if work.sweeping_threads:
        work.sweep_by_world(_sweep, [work.status, work.tolerance, int(MAX_SWEEPS), int(SWEEPS_PER_BATCH)])
        return
    work.repeat_sweeps(lambda: _activate(work), sweep_positions_together, project_positions, _update)


def leave_planes(work: Workspace) -> None:
    """Sweeps once ahead of the first detection, out of infinite planes, so that resting cloth needs one detection."""
    wp.capture_if(work.constraints.count, _leave_planes, work=work)


def _leave_planes(work):
    if work.sweeping_threads:
        work.sweep_by_world(_sweep, [work.status, work.tolerance, 1, 1])
        return
    work.launch(start_sweeps, 1, [work.status])
    work.sweep(1, lambda: _activate(work), sweep_positions_together, project_positions, _update)


def _activate(work):
    work.launch_over_constraints(activate_position_constraints, work.status, work.tolerance)


def _update(work, last):
    work.launch_over_particles(update_positions, work.status, last, at_least_once=True)
    work.launch_over_bodies(move_bodies, last)
    work.launch_over_shape_vertices(place_vertices)
