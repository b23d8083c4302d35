"""Projection of positions: Jacobi sweeps over the constraints that move vertices and bodies."""

import warp as wp

from ..contacts.constraints import gap, min_distance_of
from ..schedule import SolveStatus, is_dividing, is_projecting, is_reversible, start_sweeps
from ..state.fixed_sum import with_delta
from ..state.record import StepRecord, is_recording, record_entry
from ..state.structs import PROJECTED, Constraints, ContactKind, Motion, Pace, Vertices
from ..state.vectors import ONE, ZERO, relative
from ..state.workspace import Workspace
from ..tuning import CLOSE_EDGES, PUSHING_MOMENTUM, RELAXATION, TOLERANCE_OF_CHANGE, TOLERANCE_OF_DISTANCE
from .bodies import add_body_delta, move_bodies, place_vertices
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
def _path(motion: Motion, vertices: Vertices, constraints: Constraints, i: int) -> wp.vec3d:
    weights = constraints.weights[i]
    corners = constraints.vertices[i]
    return relative(weights, corners, vertices.x1) - relative(weights, corners, motion.x0)


@wp.kernel
def activate_position_constraints(
    motion: Motion, vertices: Vertices, constraints: Constraints, status: SolveStatus, tolerance: wp.float64
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
    resting_edges = constraints.kind[i] == ContactKind.EDGE_EDGE_PROXIMITY and constraints.pace[i] == Pace.RESTING
    if resting_edges and is_dividing(status, world, status.loop.iteration[0]):
        start = relative(constraints.weights[i], constraints.vertices[i], motion.x0)
        least = min_distance_of(constraints, i)
        if wp.dot(constraints.normal[i], start) - least >= CLOSE_EDGES * (constraints.separation[i] - least):
            return
    past = status.loop.sweep[0] >= max_sweeps(motion, constraints, status, i, status.slow_position_sweeps)
    if past or not is_projecting(status, world):
        return
    distance = gap(vertices, constraints, i)
    if constraints.kind[i] == ContactKind.PLANE:  # whose separation is an offset
        predicted = wp.dot(constraints.normal[i], relative(constraints.weights[i], constraints.vertices[i], motion.x1))
        if predicted < constraints.separation[i]:
            tolerance = wp.min(tolerance, TOLERANCE_OF_CHANGE * (constraints.separation[i] - predicted))
    else:
        tolerance = wp.min(
            tolerance, TOLERANCE_OF_DISTANCE * (constraints.separation[i] - min_distance_of(constraints, i))
        )
    tolerance = tolerance_of(motion, constraints, i, tolerance)
    active = distance < -tolerance
    if not active and is_reversible(status, constraints.pace[i] != Pace.FAST):
        multiplier = constraints.position_multiplier[i]
        if wp.length_sq(multiplier) > ZERO:
            friction = wp.float64(constraints.friction[i])
            path = _path(motion, vertices, constraints, i)
            active = distance > tolerance or not is_held_by_friction(
                multiplier, constraints.normal[i], path, friction, tolerance
            )
    if active:
        activate(motion, vertices, constraints, i)


@wp.func
def position_multiplier_after(
    motion: Motion, vertices: Vertices, constraints: Constraints, i: int, pushes_only: bool
) -> wp.vec3d:
    """Returns the position multiplier of a constraint after a sweep, without momentum."""
    old = constraints.position_multiplier[i]
    relaxation = wp.where(pushes_only, RELAXATION, ONE)
    along, across = effective_inverse_masses(motion, vertices, constraints, i, motion.x1, relaxation)
    if along <= ZERO:
        return old
    excess = gap(vertices, constraints, i)
    if pushes_only and excess >= ZERO:
        return old
    path = _path(motion, vertices, constraints, i)
    friction = wp.float64(constraints.friction[i])
    return multiplier_after(old, constraints.normal[i], excess, path, along, across, friction)


@wp.kernel
def project_positions(
    motion: Motion, vertices: Vertices, constraints: Constraints, status: SolveStatus, record: StepRecord
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
    pushes_only = not is_reversible(status, constraints.pace[i] != Pace.FAST)
    last_sweep = max_sweeps(motion, constraints, status, i, status.slow_position_sweeps) - 1
    momentum = momentum_of(constraints, status, i, last_sweep)
    if pushes_only:
        violated = gap(vertices, constraints, i) < ZERO
        momentum = wp.where(violated, wp.min(momentum, PUSHING_MOMENTUM), ZERO)
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


@wp.kernel
def update_positions(
    motion: Motion, vertices: Vertices, constraints: Constraints, status: SolveStatus, record: StepRecord, last: bool
):
    """Moves each vertex by the sum of what its constraints did to it, and finishes the sweep."""
    vertex = wp.tid()
    if vertex == 0:
        finish_sweep(constraints, status, record, last)
    if vertices.active[vertex] == 0:
        return
    if last:
        vertices.active[vertex] = 0
    if motion.inverse_mass[vertex] > 0.0:
        vertices.x1[vertex] = with_delta(motion.x1[vertex], vertices.particle_delta_x, vertex)
        vertices.changed[vertex] = 1
        vertices.outcome[vertex] = vertices.outcome[vertex] | PROJECTED


def project(work: Workspace, tolerance: float = 1.0) -> None:
    """Moves vertices and bodies apart at the end of the step, until their constraints are met.

    Args:
        work: The workspace of the step.
        tolerance: Tolerance as a share of that of a whole step.
    """
    repeat(work, lambda first, last: _sweep(work, first, last, tolerance))


def leave_planes(work: Workspace) -> None:
    """Sweeps once ahead of the first detection, out of infinite planes, so that resting cloth needs one detection."""
    wp.capture_if(work.constraints.count, _leave_planes, work=work)


def _leave_planes(work):
    work.launch(start_sweeps, 1, [work.status])
    work.reserve_entries(1)
    _sweep(work, True, True, 1.0)


def _sweep(work, first, last, tolerance):
    """Sweeps over the constraints once; the first sweep fills the active set, the last empties it."""
    inputs = [work.motion.vertices, work.vertices, work.constraints, work.status]
    if first:
        work.launch_over_constraints(activate_position_constraints, [*inputs, tolerance * work.tolerance])
    inputs.append(work.record)
    work.launch_over_active_set(project_positions, inputs)
    work.launch_over_particles(update_positions, [*inputs, last], at_least_once=True)
    work.launch_over_bodies(move_bodies, last)
    work.launch_over_shape_vertices(place_vertices)
