"""Projection of positions: sweeps over the constraints that move vertices and bodies."""

import functools

import warp as wp

from ..._profiling import phase
from ..contacts.constraints import gap, min_distance_of, moves_body
from ..schedule import divides_after, is_reversible, projects_now
from ..state.cluster import BLOCK, constraints_of_world, wait_for_others
from ..state.fixed_sum import with_delta
from ..state.status import Loop, SolveStatus, has_sweeps, start_sweeps
from ..state.structs import PROJECTED, ContactKind, Incidence, Pace, Step, constraint_at, constraint_count
from ..state.vectors import ONE, ZERO, relative
from ..state.workspace import Workspace
from ..tuning import (
    CLOSE_EDGES,
    MAX_SWEEPS,
    PUSHING_MOMENTUM,
    SWEEPS_PER_BATCH,
    TOLERANCE_OF_BODIES,
    TOLERANCE_OF_CHANGE,
    TOLERANCE_OF_DISTANCE,
)
from . import sweeps
from .bodies import move_bodies, place_vertices

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


@wp.kernel(launch_bounds=(BLOCK, 2))
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


@functools.cache
def _sweep(cluster: int) -> wp.Kernel:
    """Returns the kernel that makes sweeps over each world by one cluster of blocks, see :mod:`.state.cluster`."""

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
        thread = wp.tid() - world * threads
        constraints = step.constraints
        first = int(constraints.first[world])
        end = first + constraints_of_world(step, world)
        sweep = int(wp.where(has_sweeps(status) and end > first, 0, most))
        while sweep < most:
            if thread == 0:
                constraints.active_count[world] = wp.int64(0)
            wait_for_others()
            for place in range(first + thread, end, threads):
                i = constraint_at(step, place)
                if _is_active(step, status, sweep, tolerance, i):
                    sweeps.activate(step, i, world, first)
            wait_for_others()
            active_end = first + int(constraints.active_count[world])
            if active_end == first:
                break
            for i_of_batch in range(batch):
                for place in range(first + thread, active_end, threads):
                    _project_constraint(step, status, sweep, place)
                wait_for_others()
                for k in range(particles.first[world] + thread, particles.first[world + 1], threads):
                    if sweeps.takes_changes(step, i_of_batch == batch - 1, particles.items[k]):
                        _update_vertex(step, particles.items[k])
                wait_for_others()
                sweep += 1

    return sweep_positions


@phase("project positions")
def project(work: Workspace) -> None:
    """Moves vertices and bodies apart at the end of the step, until their constraints are met."""
    if work.sweeping_threads:
        work.sweep_by_world(_sweep, [work.status, work.tolerance, int(MAX_SWEEPS), int(SWEEPS_PER_BATCH)])
        return
    work.repeat_sweeps(lambda: _activate(work), project_positions, _update)


def leave_planes(work: Workspace) -> None:
    """Sweeps once ahead of the first detection, out of infinite planes, so that resting cloth needs one detection."""
    wp.capture_if(work.constraints.count, _leave_planes, work=work)


def _leave_planes(work):
    if work.sweeping_threads:
        work.sweep_by_world(_sweep, [work.status, work.tolerance, 1, 1])
        return
    work.launch(start_sweeps, 1, [work.status])
    work.sweep(1, lambda: _activate(work), project_positions, _update)


def _activate(work):
    work.launch_over_constraints(activate_position_constraints, work.status, work.tolerance)


def _update(work, last):
    work.launch_over_particles(update_positions, work.status, last, at_least_once=True)
    work.launch_over_bodies(move_bodies, last)
    work.launch_over_shape_vertices(place_vertices)
