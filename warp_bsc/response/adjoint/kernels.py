"""The small steps of a response as kernels that Warp differentiates, and those that go back, see :mod:`.adjoint`.

Each of the first computes what a kernel of the forward pass changes, by the same functions.
"""

import warp as wp

from ...detection.settings import TOLERANCE, Count
from ..contacts.closest import closest_vector
from ..contacts.collect import level, offset_from
from ..contacts.constraints import (
    approach_of,
    contact_friction,
    contact_weights,
    feasible,
    has_pushed,
    kind_of_pair,
    sagitta,
)
from ..contacts.first_contact import truncated_path
from ..contacts.impacts import impact_of
from ..schedule import MAX_TRUNCATIONS, SolveStatus, is_reversible, widened
from ..solve.angular_momentum import (
    Moments,
    acts,
    change_by_turn,
    is_held,
    moments,
    torque_of,
    turns,
)
from ..solve.bodies import body_change
from ..solve.sweeps import (
    add_delta,
    count_active,
    initial_velocity_multiplier,
    position_multiplier_after,
    velocity_multiplier_after,
    with_momentum,
)
from ..state.fixed_sum import with_delta
from ..state.planes import MovingPlanes, signed_distance, time_of_entry
from ..state.record import NO_CONTACT, StepRecord, truncation_at
from ..state.structs import HELD, MASS, MOMENTS, PROJECTED, Constraints, ContactKind, Motion, Pace, Vertices
from ..state.vectors import ONE, ZERO, relative, to_double, to_single
from ..tuning import MAX_SAGITTA


@wp.struct
class Cursor:
    """Where the adjoint is in the record of a step; each field is an array of one element."""

    iteration: wp.array[int]  # of detect and project
    first_sweep: wp.array[int]  # of that iteration
    current_sweep: wp.array[int]  # or -1
    next_sweep: wp.array[int]  # to go back through


_TOLERANCE = wp.constant(wp.float64(TOLERANCE))

_CONTACTS = wp.constant(int(Count.CONTACTS))


@wp.func
def _add_change(
    motion: Motion,
    vertices: Vertices,
    constraints: Constraints,
    i: int,
    change: wp.vec3d,
    x: wp.array[wp.vec3],
    vertex_changes: wp.array[wp.vec3],
    body_changes: wp.array[wp.spatial_vectord],
):
    """Adds what the change of a multiplier does to its vertices and bodies, at positions ``x`` of vertices.

    :func:`.projection.add_delta` and :func:`.bodies.add_body_delta` do it in integers.
    """
    for j in range(4):
        vertex = constraints.vertices[i][j]
        share = constraints.weights[i][j] * wp.float64(motion.inverse_mass[vertex])
        wp.atomic_add(vertex_changes, vertex, to_single(share * change))
    if motion.bodies.of_vertex:
        for side in range(2):
            body, shift, turn = body_change(motion, vertices, constraints, i, side, change, x)
            if body >= 0:
                wp.atomic_add(
                    body_changes, body, wp.spatial_vectord(shift[0], shift[1], shift[2], turn[0], turn[1], turn[2])
                )


@wp.func
def _first_entry(record: StepRecord, sweep: int) -> int:
    if sweep == 0:
        return 0
    return record.sweep_ends[sweep - 1]


@wp.func
def _entry_of(record: StepRecord, sweep: int, place: int) -> int:
    """Returns the entry of the constraint at a place of a sweep's active set; -1 if the set is smaller."""
    if sweep < 0:
        return -1
    entry = _first_entry(record, sweep) + place
    return wp.where(entry < record.sweep_ends[sweep], entry, -1)


@wp.kernel
def change_multipliers(
    # in
    motion: Motion,
    vertices: Vertices,
    constraints: Constraints,
    status: SolveStatus,
    record: StepRecord,
    cursor: Cursor,
    restitution: wp.array[float],
    of_velocities: bool,
    x: wp.array[wp.vec3],
    # out
    multiplier_changes: wp.array[wp.vec3d],
    previous_changes: wp.array[wp.vec3d],
    vertex_changes: wp.array[wp.vec3],
    body_changes: wp.array[wp.spatial_vectord],
):
    """Computes what a sweep on positions or ``of_velocities`` changes, whose impulses act at positions ``x``.

    See :func:`.projection.project_positions` and :func:`.projection.project_velocities`.
    """
    entry = _entry_of(record, cursor.current_sweep[0], wp.tid())
    if entry < 0:
        return
    i = record.constraint[entry]
    old = constraints.position_multiplier[i]
    multiplier = old
    if of_velocities:
        old = constraints.velocity_multiplier[i]
        multiplier = velocity_multiplier_after(motion, vertices, constraints, i, restitution)
    else:
        pushes_only = not is_reversible(status, constraints.pace[i] != Pace.FAST)
        multiplier = position_multiplier_after(motion, vertices, constraints, i, pushes_only)
    previous = constraints.previous_multiplier[i]
    change = with_momentum(multiplier, previous, record.momentum[entry]) - old
    multiplier_changes[i] = change
    previous_changes[i] = multiplier - previous
    _add_change(motion, vertices, constraints, i, change, x, vertex_changes, body_changes)


@wp.kernel
def initialize_multipliers(
    # in
    motion: Motion,
    vertices: Vertices,
    constraints: Constraints,
    dt: wp.float64,
    # out
    velocity_multipliers: wp.array[wp.vec3d],
    previous_multipliers: wp.array[wp.vec3d],
    vertex_changes: wp.array[wp.vec3],
    body_changes: wp.array[wp.spatial_vectord],
):
    """Computes the initial velocity multipliers, see :func:`.projection.initialize_velocity_multipliers`."""
    i = wp.tid()
    if i < constraints.count[0] and has_pushed(constraints, i):
        first = initial_velocity_multiplier(constraints, i, dt)
        velocity_multipliers[i] = first
        previous_multipliers[i] = first
        _add_change(motion, vertices, constraints, i, first, vertices.x1, vertex_changes, body_changes)


@wp.kernel
def add_torques(motion: Motion, vertices: Vertices, constraints: Constraints, totals: wp.array2d[wp.float64]):
    """Adds the torques of contacts to the totals of their worlds, see :func:`.angular_momentum.sum_torques`."""
    i = wp.tid()
    if i >= constraints.count[0] or not acts(constraints, i):
        return
    world = motion.world[constraints.vertices[i][0]]
    if is_held(motion, vertices, constraints, i):
        totals[world, HELD] = ONE
    else:
        torque = torque_of(motion, vertices, constraints, i)
        for axis in range(3):
            wp.atomic_add(totals, world, axis, torque[axis])


@wp.kernel
def add_moments(motion: Motion, vertices: Vertices, totals: wp.array2d[wp.float64]):
    """Adds the moments of vertices to the totals of their worlds, see :func:`.angular_momentum.sum_moments`."""
    vertex = wp.tid()
    if turns(motion, vertices, vertex):
        added = moments(motion, vertices, vertex)
        for i in range(MOMENTS):
            wp.atomic_add(totals, motion.world[vertex], MASS + i, added[i])


@wp.func
def torque_and_moments(totals: wp.array2d[wp.float64], world: int):
    """Returns the torque on a world and its moments."""
    torque = wp.vec3d(totals[world, 0], totals[world, 1], totals[world, 2])
    total = Moments(
        totals[world, MASS],
        totals[world, MASS + 1],
        totals[world, MASS + 2],
        totals[world, MASS + 3],
        totals[world, MASS + 4],
        totals[world, MASS + 5],
        totals[world, MASS + 6],
        totals[world, MASS + 7],
        totals[world, MASS + 8],
        totals[world, MASS + 9],
        totals[world, MASS + 10],
    )
    return torque, total


@wp.kernel
def turn_velocities(
    # in
    motion: Motion,
    vertices: Vertices,
    totals: wp.array2d[wp.float64],
    # out
    changes: wp.array[wp.vec3],
):
    """Computes what the turn of each world changes, see :func:`.angular_momentum.turn_vertices`."""
    vertex = wp.tid()
    world = motion.world[vertex]
    if not turns(motion, vertices, vertex) or totals[world, HELD] != ZERO:
        return
    torque, total = torque_and_moments(totals, world)
    change, _turn = change_by_turn(torque, total, to_double(vertices.x1[vertex]))
    changes[vertex] = to_single(change)


@wp.kernel
def make_constraints(
    # in
    motion: Motion,
    vertices: Vertices,
    planes: MovingPlanes,
    constraints: Constraints,
    status: SolveStatus,
    record: StepRecord,
    cursor: Cursor,
    least: wp.float64,
    # out
    weights: wp.array[wp.vec4d],
    normals: wp.array[wp.vec3d],
    separations: wp.array[wp.float64],
    frictions: wp.array[float],
    approaches: wp.array[wp.float64],
):
    """Computes the constraints that an iteration added, from contacts and proximities.

    See :func:`.constraints.collect_contacts` and :func:`.proximities.collect_proximities`.
    """
    iteration = cursor.iteration[0]
    i = wp.tid()
    if iteration > 0:
        i += record.constraint_offsets[iteration - 1]
    if i >= record.constraint_offsets[iteration]:
        return
    corners = constraints.vertices[i]
    kind = constraints.kind[i]
    weight = constraints.weights[i]
    normal = constraints.normal[i]
    separation = constraints.separation[i]
    friction = float(0.0)
    if kind == ContactKind.PLANE:
        plane = planes.end[constraints.plane[i]]
        normal = wp.vec3d(plane[0], plane[1], plane[2])
        separation = offset_from(motion, planes, constraints.plane[i], corners[0], status, least)
        friction = contact_friction(motion.friction[corners[0]], planes.friction[constraints.plane[i]])
    else:
        friction = contact_friction(motion.friction[corners[0]], motion.friction[corners[3]])
    if kind < ContactKind.PLANE:
        coordinates = wp.vec3d(-weight[1], -weight[2], -weight[3])
        if kind == ContactKind.EDGE_EDGE:
            coordinates = wp.vec3d(weight[1], -weight[3], ZERO)
        within_tolerance = constraints.within_tolerance[i]
        impact = impact_of(motion, vertices, corners, kind, within_tolerance, constraints.toi[i], coordinates, normal)
        weight = contact_weights(kind_of_pair(kind), impact.coordinates)
        normal = impact.normal
        separation = widened(least, status)
        if constraints.pace[i] == Pace.SLOW:
            before = wp.dot(normal, relative(weight, corners, motion.x0))
            separation = feasible(motion, corners, separation, before, least)
        separation += sagitta(motion, vertices, corners, MAX_SAGITTA * least)
    elif kind > ContactKind.PLANE:
        weight, between = closest_vector(motion, corners, kind_of_pair(kind))
        distance = wp.length(between)
        normal = between / distance
        separation = feasible(motion, corners, least, distance, least)
    weights[i] = weight
    normals[i] = normal
    separations[i] = separation
    frictions[i] = friction
    approaches[i] = approach_of(motion, vertices, corners, weight, normal, separation)


@wp.kernel
def find_truncation_times(
    # in
    motion: Motion,
    vertices: Vertices,
    planes: MovingPlanes,
    record: StepRecord,
    cursor: Cursor,
    # out
    times: wp.array[wp.float64],
):
    """Computes the times of the contacts that an iteration truncated paths before."""
    entry = truncation_at(record, cursor.iteration[0], wp.tid())
    if entry < 0 or record.kind[entry] == NO_CONTACT:
        return
    corners = record.contact[entry]
    if record.kind[entry] == ContactKind.PLANE:
        vertex = corners[0]
        plane = corners[1]
        before, _error = signed_distance(planes.start[plane], motion.x0[vertex])
        after, _error_after = signed_distance(planes.end[plane], vertices.x1[vertex])
        lowest = level(motion, planes, plane, vertex)
        times[entry] = time_of_entry(before - lowest, after - lowest)
    else:
        impact = impact_of(
            motion,
            vertices,
            corners,
            record.kind[entry],
            record.within_tolerance[entry],
            record.toi[entry],
            record.coordinates[entry],
            record.normal[entry],
        )
        times[entry] = impact.toi


@wp.kernel
def truncate_paths(
    # in
    motion: Motion,
    vertices: Vertices,
    times: wp.array[wp.float64],
    record: StepRecord,
    cursor: Cursor,
    dt: wp.float64,
    # out
    end: wp.array[wp.vec3],
    velocity: wp.array[wp.vec3],
):
    """Computes the ends and velocities of truncated paths, see :func:`.kernels.truncate_vertices`.

    Paths that were frozen have time 0.
    """
    entry = truncation_at(record, cursor.iteration[0], wp.tid())
    if entry < 0:
        return
    vertex = record.vertex[entry]
    if vertex < 0:
        return
    x0 = to_double(motion.x0[vertex])
    path = truncated_path(x0, to_double(vertices.x1[vertex]), times[entry])
    end[entry] = to_single(x0 + path)
    velocity[entry] = to_single(path / dt)


@wp.struct
class Gradients:
    """Gradients with respect to positions and velocities at the cursor."""

    x1: wp.array[wp.vec3]
    velocity: wp.array[wp.vec3]
    more_x1: wp.array[wp.vec3]  # added to x1 once everything has read it
    more_velocity: wp.array[wp.vec3]
    velocity_change: wp.array[wp.vec3]  # with respect to what constraints add to velocities


@wp.kernel(enable_backward=False)
def begin_gradients(
    # in
    motion: Motion,
    undetected: wp.array[int],
    particle_q: wp.array[wp.vec3],
    particle_qd: wp.array[wp.vec3],
    # out
    gradients: Gradients,
    x0: wp.array[wp.vec3],
):
    """Initializes gradients by those of the results; where an undetected step froze everything, only that of x0."""
    vertex = wp.tid()
    x1 = wp.vec3()
    velocity = wp.vec3()
    if vertex < particle_q.shape[0]:
        x1 = particle_q[vertex]
        velocity = particle_qd[vertex]
    x0[vertex] = wp.vec3()
    if undetected[0] == 1 and motion.inverse_mass[vertex] > 0.0:
        x0[vertex] = x1
        x1 = wp.vec3()
        velocity = wp.vec3()
    gradients.x1[vertex] = x1
    gradients.velocity[vertex] = velocity


@wp.kernel(enable_backward=False)
def begin_adjoint(
    # in
    record: StepRecord,
    last_iteration: wp.array[int],
    max_iterations: int,
    complete: wp.array[int],
    # out
    cursor: Cursor,
    more_sweeps: wp.array[int],
    more_iterations: wp.array[int],
    iteration: wp.array[int],
):
    """Puts the cursor behind the last sweep on velocities; of an incomplete record, nothing is read."""
    cursor.current_sweep[0] = -1
    if complete[0] == 0:
        cursor.first_sweep[0] = 0
        cursor.next_sweep[0] = -1
        return
    last = wp.min(last_iteration[0], max_iterations + MAX_TRUNCATIONS + 1)
    cursor.iteration[0] = last
    cursor.first_sweep[0] = record.sweep_offsets[last + 1]
    cursor.next_sweep[0] = record.counts.sweeps[0] - 1
    more_sweeps[0] = wp.where(cursor.next_sweep[0] >= cursor.first_sweep[0], 1, 0)
    more_iterations[0] = 1
    iteration[0] = last


@wp.kernel(enable_backward=False)
def enter_iteration(record: StepRecord, cursor: Cursor, more_sweeps: wp.array[int]):
    """Puts the cursor behind the last sweep on positions of its iteration."""
    iteration = cursor.iteration[0]
    cursor.first_sweep[0] = record.sweep_offsets[iteration]
    cursor.next_sweep[0] = record.sweep_offsets[iteration + 1] - 1
    more_sweeps[0] = wp.where(cursor.next_sweep[0] >= cursor.first_sweep[0], 1, 0)


@wp.kernel(enable_backward=False)
def set_detection_iteration(cursor: Cursor, iteration: wp.array[int]):
    """Sets the iteration to that of the detection before the cursor's iteration."""
    iteration[0] = wp.max(cursor.iteration[0] - 1, 0)


@wp.kernel(enable_backward=False)
def leave_iteration(cursor: Cursor, more_iterations: wp.array[int]):
    """Moves the cursor to the iteration before."""
    cursor.iteration[0] = cursor.iteration[0] - 1
    more_iterations[0] = wp.where(cursor.iteration[0] >= 0, 1, 0)


@wp.kernel(enable_backward=False)
def restore_multipliers(
    motion: Motion,
    vertices: Vertices,
    constraints: Constraints,
    record: StepRecord,
    cursor: Cursor,
    multiplier: wp.array[wp.vec3d],
    sums: wp.array2d[wp.int64],
    x: wp.array[wp.vec3],
    body_sums: wp.array2d[wp.int64],
):
    """Restores multipliers as they were before a sweep, and the sums of what they changed, at positions ``x``."""
    entry = _entry_of(record, cursor.next_sweep[0], wp.tid())
    if cursor.next_sweep[0] < cursor.first_sweep[0] or entry < 0:
        return
    i = record.constraint[entry]
    old = record.multiplier[entry]
    add_delta(motion, vertices, constraints, i, old - multiplier[i], x, sums, body_sums)
    multiplier[i] = old
    constraints.previous_multiplier[i] = record.previous_multiplier[entry]
    count_active(motion, vertices, constraints, i)


@wp.func
def _step_back(vertex: int, cursor: Cursor, more_sweeps: wp.array[int]):
    """Makes the next sweep the current one, and the one before it the next."""
    if vertex == 0:
        sweep = cursor.next_sweep[0]
        exists = sweep >= cursor.first_sweep[0]
        cursor.current_sweep[0] = wp.where(exists, sweep, -1)
        cursor.next_sweep[0] = wp.where(exists, sweep - 1, sweep)
        more_sweeps[0] = wp.where(cursor.next_sweep[0] >= cursor.first_sweep[0], 1, 0)


@wp.kernel(enable_backward=False)
def restore_positions(
    motion: Motion, vertices: Vertices, gradients: Gradients, cursor: Cursor, more_sweeps: wp.array[int]
):
    """Restores positions as they were before a sweep, and adds up their gradients."""
    vertex = wp.tid()
    _step_back(vertex, cursor, more_sweeps)
    gradients.x1[vertex] = gradients.x1[vertex] + gradients.more_x1[vertex]
    gradients.more_x1[vertex] = wp.vec3()
    if vertices.active[vertex] != 0 and motion.inverse_mass[vertex] > 0.0:
        vertices.x1[vertex] = with_delta(motion.x1[vertex], vertices.particle_delta_x, vertex)


@wp.kernel(enable_backward=False)
def restore_unturned(motion: Motion, vertices: Vertices):
    """Restores velocities as they were before vertices were turned."""
    vertex = wp.tid()
    if turns(motion, vertices, vertex):
        vertices.velocity[vertex] = with_delta(motion.velocity[vertex], vertices.particle_delta_v, vertex)


@wp.kernel(enable_backward=False)
def restore_velocities(
    motion: Motion, vertices: Vertices, gradients: Gradients, cursor: Cursor, more_sweeps: wp.array[int]
):
    """Restores velocities as they were before a sweep, and adds up their gradients."""
    vertex = wp.tid()
    _step_back(vertex, cursor, more_sweeps)
    gradients.velocity[vertex] = gradients.velocity[vertex] + gradients.more_velocity[vertex]
    gradients.more_velocity[vertex] = wp.vec3()
    gradients.velocity_change[vertex] = wp.vec3()
    if motion.inverse_mass[vertex] > 0.0 and vertices.outcome[vertex] <= PROJECTED:
        gradients.velocity_change[vertex] = gradients.velocity[vertex]
        vertices.velocity[vertex] = with_delta(motion.velocity[vertex], vertices.particle_delta_v, vertex)


@wp.kernel(enable_backward=False)
def restore_paths(
    # in
    vertices: Vertices,
    gradients: Gradients,
    record: StepRecord,
    cursor: Cursor,
    # out
    end: wp.array[wp.vec3],
    velocity: wp.array[wp.vec3],
):
    """Restores the ends of truncated paths; the gradients of their vertices move to ``end`` and ``velocity``."""
    entry = truncation_at(record, cursor.iteration[0], wp.tid())
    if entry < 0:
        return
    vertex = record.vertex[entry]
    if vertex < 0:
        return
    end[entry] = gradients.x1[vertex]
    velocity[entry] = gradients.velocity[vertex]
    gradients.x1[vertex] = wp.vec3()
    gradients.velocity[vertex] = wp.vec3()
    vertices.x1[vertex] = record.end[entry]


@wp.kernel(enable_backward=False)
def finish_gradients(
    # in
    motion: Motion,
    gradients: Gradients,
    x0: wp.array[wp.vec3],
    predicted_x1: wp.array[wp.vec3],
    predicted_velocity: wp.array[wp.vec3],
    inverse_mass: wp.array[float],
    friction: wp.array[float],
    complete: wp.array[int],
    # out
    start_q: wp.array[wp.vec3],
    particle_q: wp.array[wp.vec3],
    particle_qd: wp.array[wp.vec3],
    particle_inv_mass: wp.array[float],
    restitution: wp.array[float],
):
    """Writes the gradients of the inputs of the step; NaN if its record is incomplete.

    Those of vertices of shapes remain gradients with respect to what was predicted of them.
    """
    particle = wp.tid()
    missing = float(0.0)
    if complete[0] == 0:
        missing = wp.nan
    x1 = gradients.x1[particle] + gradients.more_x1[particle] + predicted_x1[particle]
    velocity = gradients.velocity[particle] + gradients.more_velocity[particle] + predicted_velocity[particle]
    friction[particle] = friction[particle] + missing
    if particle == 0 and restitution:
        restitution[0] = restitution[0] + missing
    if particle >= particle_q.shape[0]:
        predicted_x1[particle] = x1
        predicted_velocity[particle] = velocity
        return
    if particle_inv_mass and motion.inverse_mass[particle] > 0.0:
        particle_inv_mass[particle] = particle_inv_mass[particle] + inverse_mass[particle] + missing
    particle_q[particle] = x1 + wp.vec3(missing)
    particle_qd[particle] = velocity + wp.vec3(missing)
    start_q[particle] = start_q[particle] + x0[particle] + wp.vec3(missing)


@wp.kernel(enable_backward=False)
def check_complete(constraints: wp.array[int], record: StepRecord, capacity: int, complete: wp.array[int]):
    """Sets ``complete`` to 1 if everything that a step did fits in its record, else to 0."""
    counts = record.counts
    fits = constraints[0] <= capacity and counts.dropped[0] == 0
    fits = fits and counts.sweeps[0] <= record.sweep_ends.shape[0]
    fits = fits and counts.entries[0] <= record.constraint.shape[0]
    fits = fits and counts.truncations[0] <= record.vertex.shape[0]
    complete[0] = wp.where(fits, 1, 0)
