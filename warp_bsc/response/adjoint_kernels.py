"""The small steps of a response as kernels that Warp differentiates; :mod:`.adjoint` launches their adjoints.

Each computes what a kernel of the forward pass changes, by the same functions.
"""

import warp as wp

from ..detection.settings import TOLERANCE, Count
from ..kernels.gradients import with_gradients
from ..kernels.pipeline.queues import is_filled
from ..kernels.polynomials import EDGE_EDGE, VERTEX_FACE
from ..kernels.signs import FREE, HIT, UNSURE
from ..kernels.time_of_impact import Impact
from .angular_momentum import HELD, MASS, MOMENTS, Moments, acts, change_by_turn, is_held, moments, torque_of, turns
from .bodies import body_change, sagitta
from .buffers import Constraints, Motion, Progress, Vertices
from .constraints import (
    EDGE_EDGE_CONTACT,
    EDGE_EDGE_PROXIMITY,
    MOST_SAGITTA,
    PLANE_CONTACT,
    VERTEX_FACE_CONTACT,
    Contacts,
    approach_of,
    contact_friction,
    contact_vertices,
    contact_weights,
    feasible,
    feasible_in_contact,
    is_excluded,
    to_double,
    to_single,
    truncated_path,
    widened,
)
from .planes import MovingPlanes, level, offset_from, signed_distance, time_of_entry
from .projection import (
    has_pushed,
    initial_velocity_multiplier,
    is_reversible,
    position_multiplier_after,
    velocity_multiplier_after,
    with_momentum,
)
from .proximities import closest_vector
from .step_record import NO_CONTACT, StepRecord, truncation_at

__all__ = [
    "Cursor",
    "add_moments",
    "add_torques",
    "change_position_multipliers",
    "change_velocity_multipliers",
    "count_grazing",
    "entry_of",
    "initialize_multipliers",
    "make_constraints",
    "torque_and_moments",
    "truncate_paths",
    "truncation_time",
    "turn_velocities",
]


@wp.struct
class Cursor:
    """Where the adjoint is in the record of a step; each field is an array of one element."""

    iteration: wp.array[int]  # of detect and project
    first_sweep: wp.array[int]  # of that iteration
    current_sweep: wp.array[int]  # or -1
    next_sweep: wp.array[int]  # to go back through


_TOLERANCE = wp.constant(wp.float64(TOLERANCE))
_CONTACTS = wp.constant(int(Count.CONTACTS))
_ZERO = wp.constant(wp.float64(0.0))
_ONE = wp.constant(wp.float64(1.0))


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
def entry_of(record: StepRecord, sweep: int, place: int) -> int:
    """Returns the entry of the constraint at a place of a sweep's active set; -1 if the set is smaller."""
    if sweep < 0:
        return -1
    entry = _first_entry(record, sweep) + place
    return wp.where(entry < record.sweep_ends[sweep], entry, -1)


@wp.kernel
def change_position_multipliers(
    # in
    motion: Motion,
    vertices: Vertices,
    constraints: Constraints,
    progress: Progress,
    record: StepRecord,
    cursor: Cursor,
    # out
    multiplier_changes: wp.array[wp.vec3d],
    previous_changes: wp.array[wp.vec3d],
    vertex_changes: wp.array[wp.vec3],
    body_changes: wp.array[wp.spatial_vectord],
):
    """Computes what a sweep on positions changes, see :func:`.projection.project_positions`."""
    entry = entry_of(record, cursor.current_sweep[0], wp.tid())
    if entry < 0:
        return
    i = record.constraint[entry]
    multiplier = position_multiplier_after(
        motion, vertices, constraints, i, not is_reversible(constraints, progress, i)
    )
    previous = constraints.previous_multiplier[i]
    new = with_momentum(multiplier, previous, record.momentum[entry])
    change = new - constraints.position_multiplier[i]
    multiplier_changes[i] = change
    previous_changes[i] = multiplier - previous
    _add_change(motion, vertices, constraints, i, change, motion.x1, vertex_changes, body_changes)


@wp.kernel
def change_velocity_multipliers(
    # in
    motion: Motion,
    vertices: Vertices,
    constraints: Constraints,
    record: StepRecord,
    cursor: Cursor,
    restitution: wp.array[float],
    # out
    multiplier_changes: wp.array[wp.vec3d],
    previous_changes: wp.array[wp.vec3d],
    vertex_changes: wp.array[wp.vec3],
    body_changes: wp.array[wp.spatial_vectord],
):
    """Computes what a sweep on velocities changes, see :func:`.projection.project_velocities`."""
    entry = entry_of(record, cursor.current_sweep[0], wp.tid())
    if entry < 0:
        return
    i = record.constraint[entry]
    multiplier = velocity_multiplier_after(motion, vertices, constraints, i, restitution)
    previous = constraints.previous_multiplier[i]
    new = with_momentum(multiplier, previous, record.momentum[entry])
    change = new - constraints.velocity_multiplier[i]
    multiplier_changes[i] = change
    previous_changes[i] = multiplier - previous
    _add_change(motion, vertices, constraints, i, change, vertices.x1, vertex_changes, body_changes)


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
        totals[world, HELD] = _ONE
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
    if not turns(motion, vertices, vertex) or totals[world, HELD] != _ZERO:
        return
    torque, total = torque_and_moments(totals, world)
    changes[vertex] = to_single(change_by_turn(torque, total, to_double(vertices.x1[vertex])))


@wp.func
def impact_of(
    motion: Motion,
    vertices: Vertices,
    corners: wp.vec4i,
    kind: int,
    within_tolerance: bool,
    toi: wp.float64,
    coordinates: wp.vec3d,
    normal: wp.vec3d,
) -> Impact:
    """Returns a contact as a differentiable function of the positions of its vertices."""
    found = Impact()
    found.status = wp.where(within_tolerance, HIT, UNSURE)
    found.within_tolerance = wp.where(within_tolerance, 1, 0)
    found.toi = toi
    found.coordinates = coordinates
    found.normal = normal
    return with_gradients(
        wp.where(kind == EDGE_EDGE_CONTACT, EDGE_EDGE, VERTEX_FACE),
        to_double(motion.x0[corners[0]]),
        to_double(motion.x0[corners[1]]),
        to_double(motion.x0[corners[2]]),
        to_double(motion.x0[corners[3]]),
        to_double(vertices.x1[corners[0]]),
        to_double(vertices.x1[corners[1]]),
        to_double(vertices.x1[corners[2]]),
        to_double(vertices.x1[corners[3]]),
        found,
        _TOLERANCE,
    )


@wp.kernel
def make_constraints(
    # in
    motion: Motion,
    vertices: Vertices,
    planes: MovingPlanes,
    constraints: Constraints,
    progress: Progress,
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
    if kind == PLANE_CONTACT:
        plane = planes.end[constraints.plane[i]]
        normal = wp.vec3d(plane[0], plane[1], plane[2])
        separation = offset_from(motion, planes, constraints.plane[i], corners[0], progress, least)
        friction = contact_friction(motion.friction[corners[0]], planes.friction[constraints.plane[i]])
    else:
        friction = contact_friction(motion.friction[corners[0]], motion.friction[corners[3]])
    if kind < PLANE_CONTACT:
        edges = wp.where(kind == EDGE_EDGE_CONTACT, 1, 0)
        coordinates = wp.vec3d(-weight[1], -weight[2], -weight[3])
        if edges == 1:
            coordinates = wp.vec3d(weight[1], -weight[3], _ZERO)
        within_tolerance = constraints.within_tolerance[i]
        impact = impact_of(motion, vertices, corners, kind, within_tolerance, constraints.toi[i], coordinates, normal)
        weight = contact_weights(edges, impact.coordinates)
        normal = impact.normal
        separation = widened(least, progress)
        if constraints.slow[i] == 1:
            separation = feasible_in_contact(motion, corners, weight, normal, separation, least, wp.float64(0.0))
        separation += sagitta(motion, vertices, corners, MOST_SAGITTA * least)
    elif kind > PLANE_CONTACT:
        weight, between = closest_vector(motion, corners, wp.where(kind == EDGE_EDGE_PROXIMITY, 1, 0))
        distance = wp.length(between)
        normal = between / distance
        separation = feasible(motion, corners, least, distance, least)
    weights[i] = weight
    normals[i] = normal
    separations[i] = separation
    frictions[i] = friction
    approaches[i] = approach_of(motion, vertices, corners, weight, normal, separation)


@wp.func
def truncation_time(
    motion: Motion, vertices: Vertices, planes: MovingPlanes, record: StepRecord, entry: int
) -> wp.float64:
    """Returns the time of the contact that a path was truncated before; 0 if it was frozen."""
    kind = record.kind[entry]
    corners = record.contact[entry]
    toi = _ZERO
    if kind == PLANE_CONTACT:
        vertex = corners[0]
        plane = corners[1]
        before, _error = signed_distance(planes.start[plane], motion.x0[vertex])
        after, _error_after = signed_distance(planes.end[plane], vertices.x1[vertex])
        lowest = level(motion, planes, plane, vertex)
        toi = time_of_entry(before - lowest, after - lowest)
    elif kind != NO_CONTACT:
        impact = impact_of(
            motion,
            vertices,
            corners,
            kind,
            record.within_tolerance[entry],
            record.toi[entry],
            record.coordinates[entry],
            record.normal[entry],
        )
        toi = impact.toi
    return toi


@wp.kernel
def truncate_paths(
    # in
    motion: Motion,
    vertices: Vertices,
    planes: MovingPlanes,
    record: StepRecord,
    cursor: Cursor,
    dt: wp.float64,
    # out
    end: wp.array[wp.vec3],
    velocity: wp.array[wp.vec3],
):
    """Computes the ends and velocities of truncated paths, see :func:`.kernels.truncate_vertices`."""
    entry = truncation_at(record, cursor.iteration[0], wp.tid())
    if entry < 0:
        return
    vertex = record.vertex[entry]
    if vertex < 0:
        return
    toi = truncation_time(motion, vertices, planes, record, entry)
    x0 = to_double(motion.x0[vertex])
    path = truncated_path(x0, to_double(vertices.x1[vertex]), toi)
    end[entry] = to_single(x0 + path)
    velocity[entry] = to_single(path / dt)


@wp.func
def _count_grazing(motion: Motion, vertices: Vertices, contacts: Contacts, i: int, record: StepRecord):
    if not is_filled(i, contacts.pairs, contacts.counts, _CONTACTS) or int(contacts.status[i]) == FREE:
        return
    corners = contact_vertices(contacts, i)
    if is_excluded(motion, contacts, i, corners):
        return
    kind = wp.where(contacts.edges == 1, EDGE_EDGE_CONTACT, VERTEX_FACE_CONTACT)
    at = contacts.coordinates[i]
    impact = impact_of(
        motion, vertices, corners, kind, contacts.within_tolerance[i], contacts.toi[i], at, contacts.normal[i]
    )
    wp.atomic_add(record.counts.grazing, 0, impact.grazing)


@wp.kernel(enable_backward=False)
def count_grazing(motion: Motion, vertices: Vertices, vertex_face: Contacts, edge_edge: Contacts, record: StepRecord):
    """Counts the contacts whose gradients are clamped, see :mod:`warp_bsc.kernels.gradients`."""
    i = wp.tid()
    _count_grazing(motion, vertices, vertex_face, i, record)
    _count_grazing(motion, vertices, edge_edge, i, record)
