"""Kernels between a detection and the next: contacts are collected, and paths changed that projection does not."""

import warp as wp

from ..detection.settings import Count
from ..kernels.pipeline.queues import is_filled
from ..kernels.polynomials import EDGE_EDGE
from ..kernels.signs import FREE
from .bodies import first_contact_of_body, sagitta
from .buffers import (
    DIVIDED,
    FROZEN,
    LOST,
    NEVER,
    PROJECTED,
    TRUNCATED,
    UNCONSTRAINED,
    Constraints,
    Motion,
    Progress,
    Vertices,
)
from .constraints import (
    EDGE_EDGE_CONTACT,
    EDGE_EDGE_PROXIMITY,
    MOST_SAGITTA,
    NO_CONSTRAINT,
    PLANE_CONTACT,
    RESTING,
    TIME_UNITS,
    TOUCH,
    VERTEX_FACE_CONTACT,
    VERTEX_FACE_PROXIMITY,
    Contacts,
    add_constraint,
    are_on_body,
    contact_friction,
    contact_vertices,
    contact_weights,
    count_contact,
    distances_at_start,
    divides_all_near_pairs,
    divides_near_pairs,
    feasible_in_contact,
    has_overflowed,
    is_dividing,
    is_pushing,
    is_slow,
    least_distance,
    relative,
    to_double,
    to_single,
    truncated_path,
    update_first_contact,
    widened,
)
from .dividing_planes import DividingPlanes, add_dividing_plane, has_all_planes, position_on_sides
from .exclusion import bodies_meet, crossed_at_start, is_movable, met_at_start, touched_at_start
from .hidden_edges import are_hidden
from .projection import has_pushed, moves_body
from .step_record import NO_CONTACT, StepRecord, begin_iteration, is_recording

__all__ = [
    "begin_step",
    "collect_contacts",
    "decide",
    "divide_near_pairs",
    "drop_if_full",
    "freeze_undetected",
    "record_body_truncations",
    "record_offsets",
    "truncate_vertices",
]

_CONTACTS = wp.constant(int(Count.CONTACTS))

_KERNEL = {"enable_backward": False}


@wp.kernel(**_KERNEL)
def begin_step(
    # in
    motion: Motion,
    worlds: int,
    # out
    vertices: Vertices,
    constraints: Constraints,
    dividing: DividingPlanes,
    progress: Progress,
):
    """Initializes the vertices by what is wanted of them, and clears everything else."""
    i = wp.tid()
    if i == 0:
        status = progress.status
        status.active[0] = 0
        status.unfinished[0] = 0
        status.iteration[0] = 0
        status.certified[0] = 0
        status.hits[0] = 0
        status.crossed_hits[0] = 0
        status.body_hits[0] = 0
        status.body_contacts[0] = 0
        status.first_hits[0] = 0
        status.counted[0] = 0
        status.remaining[0] = 0
        status.excluded[0] = 0
        status.newly_frozen[0] = 0
        status.undetected[0] = 0
        status.truncated[0] = 0
        status.frozen[0] = 0
        status.lost[0] = 0
        status.projecting[0] = 0
        status.near[0] = 0
        status.rounds[0] = 0
        constraints.count[0] = 0
        dividing.count[0] = 0
    if i < worlds:
        progress.contact_iteration[i] = -1
        progress.fast[i] = 0
        motion.interrupted[i] = 0
    if i == worlds:
        motion.interrupted[i] = 0
    if i >= vertices.x1.shape[0]:
        return
    for axis in range(3):
        if motion.x0[i][axis] != vertices.x1[i][axis]:  # moved between steps
            progress.status.recount[0] = 1
    vertices.x1[i] = motion.x1[i]
    vertices.velocity[i] = motion.velocity[i]
    for axis in range(3):
        vertices.particle_delta_x[i, axis] = wp.int64(0)
        vertices.particle_delta_v[i, axis] = wp.int64(0)
    vertices.first_contact[i] = NEVER
    vertices.changed[i] = 0
    vertices.outcome[i] = wp.where(motion.is_lost[i] != 0, LOST, 0)
    dividing.first[i] = -1
    dividing.kept[i] = -1


@wp.func
def _collect_contact(
    motion: Motion,
    vertices: Vertices,
    contacts: Contacts,
    i: int,
    constraints: Constraints,
    dividing: DividingPlanes,
    progress: Progress,
    separation: wp.float64,
):
    """Counts a contact, and adds a constraint for it; after the last projection, dividing planes."""
    if not is_filled(i, contacts.pairs, contacts.counts, _CONTACTS):
        return
    near = int(contacts.status[i]) == FREE  # only
    if near and not motion.distances.radius:
        return
    corners = contact_vertices(contacts, i)
    if not is_movable(motion, corners):
        if not near and bodies_meet(motion, corners):
            if not met_at_start(motion, contacts.mesh, contacts.edges, contacts.pairs[i], corners, contacts.toi[i]):
                wp.atomic_add(progress.status.body_hits, 0, 1)
                for j in range(4):
                    vertices.changed[corners[j]] = 1  # so that the next detection finds them again
        return
    least = wp.float64(0.0)
    bound = contacts.toi[i]
    if motion.distances.radius:
        start, kept = distances_at_start(motion, corners, contacts.kind)
        least = kept
        bound = start
    met = touched_at_start(motion, contacts.kind, corners, bound)
    if progress.status.crossings[0] > 0 and not met and contacts.kind <= EDGE_EDGE:
        met = crossed_at_start(motion, contacts.mesh, contacts.edges, contacts.pairs[i])
    if met:
        wp.atomic_add(progress.status.crossed_hits, 0, wp.where(near, 0, 1))
        return
    world = motion.world[corners[0]]
    iteration = progress.status.iteration[0]
    slow = is_slow(motion, corners, contacts.kind)
    weights = contact_weights(contacts.kind, contacts.coordinates[i])
    normal = contacts.normal[i]
    if not near:
        count_contact(progress, world)
        for j in range(4):
            vertices.changed[corners[j]] = 1
        if iteration == 0:
            # planes stand still: they would stop a body that takes along what it pushes
            moves = slow == 0 or are_on_body(motion, corners)
            if moves or is_pushing(motion, corners, weights, normal, least):
                progress.fast[world] = 1
    multiplier = wp.vec3d()
    if near and is_dividing(progress, world, iteration):
        return
    if is_dividing(progress, world, iteration):
        for j in range(4):
            update_first_contact(vertices, corners[j], contacts.toi[i], contacts.edges, i)
        if not dividing.first:
            return
        add_dividing_plane(motion, vertices, corners, contacts.edges, separation, least, dividing, True, True)
        multiplier = TOUCH * normal
    else:
        if not near:
            progress.status.projecting[0] = 1
        if iteration == 0 and contacts.edges == 1:
            time = wp.where(near, wp.float64(0.0), contacts.toi[i])
            if are_hidden(motion, contacts.mesh, contacts.pairs[i], corners, normal, time):
                return  # the next detection finds it, if it is still there
    friction = contact_friction(motion.friction[corners[0]], motion.friction[corners[3]])
    target = widened(separation, progress)
    if slow == 1:
        target = feasible_in_contact(motion, corners, weights, normal, target, separation, least)
    target += sagitta(motion, vertices, corners, MOST_SAGITTA * separation)
    target += least
    if near and wp.dot(normal, relative(weights, corners, vertices.x1)) < target:
        progress.status.near[0] = 1
        progress.status.projecting[0] = 1
        progress.contact_iteration[world] = iteration
    kind = wp.where(contacts.edges == 1, EDGE_EDGE_CONTACT, VERTEX_FACE_CONTACT)
    add_constraint(
        motion,
        vertices,
        constraints,
        corners,
        weights,
        normal,
        target,
        friction,
        slow,
        kind,
        contacts.within_tolerance[i],
        contacts.toi[i],
        multiplier,
        least,
    )


@wp.kernel(**_KERNEL)
def collect_contacts(
    motion: Motion,
    vertices: Vertices,
    vertex_face: Contacts,
    edge_edge: Contacts,
    constraints: Constraints,
    dividing: DividingPlanes,
    progress: Progress,
    separation: wp.float64,
    counts: wp.array[wp.int64],
    capacities: wp.array[wp.int64],
    can_search: bool,
):
    """Counts the contacts of both kinds, and adds constraints for them; after the last projection, dividing planes.

    Then it finds the first contact of each vertex as well. Does nothing if :mod:`.queueless` is to find all contacts,
    because a queue overflowed: which contacts are among those that fit depends on the order of threads.
    """
    i = wp.tid()
    if can_search and has_overflowed(counts, capacities):
        return
    _collect_contact(motion, vertices, vertex_face, i, constraints, dividing, progress, separation)
    _collect_contact(motion, vertices, edge_edge, i, constraints, dividing, progress, separation)


@wp.kernel(**_KERNEL)
def divide_near_pairs(
    motion: Motion,
    vertices: Vertices,
    constraints: Constraints,
    dividing: DividingPlanes,
    progress: Progress,
    separation: wp.float64,
):
    """Adds dividing planes for proximities, see :func:`.constraints.divides_near_pairs`.

    In a stack, a vertex that is moved onto one side comes into the next layer, which would need an iteration for each.
    A constraint whose elements would meet changes velocities too.
    """
    i = wp.tid()
    if i >= constraints.count[0]:
        return
    kind = constraints.kind[i]
    if kind != VERTEX_FACE_PROXIMITY and kind != EDGE_EDGE_PROXIMITY:
        return
    corners = constraints.vertices[i]
    if not divides_near_pairs(progress, motion.world[corners[0]]) or moves_body(motion, constraints, i):
        return
    edges = wp.where(kind == EDGE_EDGE_PROXIMITY, 1, 0)
    all_pairs = divides_all_near_pairs(progress)
    if not all_pairs and constraints.slow[i] != RESTING:
        return
    least = least_distance(constraints, i)
    meets = add_dividing_plane(motion, vertices, corners, edges, separation, least, dividing, False, all_pairs)
    if meets and not has_pushed(constraints, i):
        constraints.position_multiplier[i] = TOUCH * constraints.normal[i]
        for j in range(4):
            vertex = corners[j]
            if motion.inverse_mass[vertex] > 0.0:
                vertices.outcome[vertex] = vertices.outcome[vertex] | PROJECTED


@wp.kernel(**_KERNEL)
def drop_if_full(constraints: Constraints, record: StepRecord, needed: int):
    """Drops all constraints if fewer than ``needed`` more fit, which a detection might add."""
    if constraints.count[0] > constraints.vertices.shape[0] - needed:
        constraints.count[0] = 0
        if is_recording(record):
            record.counts.dropped[0] = 1


@wp.kernel(**_KERNEL)
def record_offsets(constraints: Constraints, progress: Progress, record: StepRecord, after: int):
    """Records the offsets of an iteration, or those after the last; iterations that freeze share one offset."""
    last = progress.max_iterations + progress.max_truncations + 1
    iteration = progress.status.iteration[0]
    if after == 1 or iteration <= last:
        begin_iteration(record, wp.min(iteration, last) + after, constraints.count[0])


@wp.kernel(**_KERNEL)
def decide(
    constraints: Constraints,
    progress: Progress,
    counts: wp.array[wp.int64],
    capacities: wp.array[wp.int64],
    can_search: bool,
):
    """Decides from the contacts counted whether the motion is certified, and whether another iteration is needed.

    If a queue overflowed, the detection is incomplete. With ``can_search`` it is to be completed by
    :mod:`.queueless`, and decided upon by another launch.
    """
    status = progress.status
    overflowed = has_overflowed(counts, capacities)
    if can_search and overflowed and status.undetected[0] == 0:
        status.undetected[0] = 1
        status.near[0] = 0
        status.hits[0] = 0
        status.crossed_hits[0] = 0
        status.body_hits[0] = 0
        status.iteration[0] = wp.max(status.iteration[0], progress.max_iterations)
        return
    overflowed = overflowed and not can_search
    hits = status.hits[0]
    status.hits[0] = 0
    status.remaining[0] = hits
    status.excluded[0] = status.crossed_hits[0]
    status.crossed_hits[0] = 0
    status.body_contacts[0] = status.body_hits[0]
    status.body_hits[0] = 0
    if status.counted[0] == 0:
        status.first_hits[0] = status.first_hits[0] + hits
        status.counted[0] = 1
    stuck = status.iteration[0] > progress.max_iterations + progress.max_truncations and status.newly_frozen[0] == 0
    status.newly_frozen[0] = 0
    status.certified[0] = wp.where(hits == 0 and not overflowed and counts[0] == wp.int64(0), 1, 0)
    status.undetected[0] = wp.where(overflowed, 1, 0)
    finished = hits == 0 and status.near[0] == 0
    status.near[0] = 0
    status.active[0] = wp.where(finished or overflowed or stuck, 0, 1)
    status.iteration[0] = status.iteration[0] + status.active[0]
    status.rounds[0] = status.rounds[0] + status.active[0]
    status.unfinished[0] = wp.where(status.active[0] == 1 or overflowed or constraints.count[0] > 0, 1, 0)


@wp.func
def _record_truncation(
    vertices: Vertices,
    record: StepRecord,
    vertex: int,
    body: int,
    cuts: bool,
    key: wp.int64,
    vertex_face: Contacts,
    edge_edge: Contacts,
):
    """Records the end of the path of a vertex, or of its body if that is not -1, before it is truncated or frozen."""
    entry = wp.atomic_add(record.counts.truncations, 0, 1)
    if entry >= record.vertex.shape[0]:
        return
    record.vertex[entry] = wp.where(body < 0, vertex, -1)
    record.end[entry] = vertices.x1[vertex]
    record.body[entry] = body
    if body >= 0:
        record.pose[entry] = vertices.bodies.pose[body]
    first = int(key & wp.int64(0xFFFFFFFF))
    if first & 3 == EDGE_EDGE_CONTACT:
        _record_contact(record, entry, vertex, cuts, key, edge_edge)
    else:
        _record_contact(record, entry, vertex, cuts, key, vertex_face)


@wp.func
def _record_contact(record: StepRecord, entry: int, vertex: int, cuts: bool, key: wp.int64, contacts: Contacts):
    """Records the contact that a path is truncated before."""
    first = int(key & wp.int64(0xFFFFFFFF))
    kind = wp.where(cuts, first & 3, NO_CONTACT)
    i = first >> 2
    record.kind[entry] = kind
    record.contact[entry] = wp.vec4i(vertex, i, 0, 0)
    record.toi[entry] = wp.float64(key >> wp.int64(32)) / TIME_UNITS
    if kind != PLANE_CONTACT and kind != NO_CONTACT:
        record.contact[entry] = contact_vertices(contacts, i)
        record.within_tolerance[entry] = contacts.within_tolerance[i]
        record.toi[entry] = contacts.toi[i]
        record.coordinates[entry] = contacts.coordinates[i]
        record.normal[entry] = contacts.normal[i]


@wp.func
def _keep_on_sides(motion: Motion, vertices: Vertices, dividing: DividingPlanes, vertex: int):
    """Moves a vertex without a contact onto its sides, so that it comes into no element while others are divided.

    One without a new plane is there, as no projection follows the first planes of its world.
    """
    first = dividing.first[vertex]
    if motion.inverse_mass[vertex] == 0.0 or first < 0 or first == dividing.kept[vertex]:
        return
    dividing.kept[vertex] = first
    x1 = vertices.x1[vertex]
    end, truncated = position_on_sides(dividing, vertex, motion.x0[vertex], x1)
    if end[0] != x1[0] or end[1] != x1[1] or end[2] != x1[2]:
        vertices.x1[vertex] = end
        vertices.changed[vertex] = 1
        vertices.outcome[vertex] = vertices.outcome[vertex] | wp.where(truncated, DIVIDED | TRUNCATED, DIVIDED)


@wp.kernel(**_KERNEL)
def truncate_vertices(
    motion: Motion,
    vertices: Vertices,
    progress: Progress,
    record: StepRecord,
    dividing: DividingPlanes,
    vertex_face: Contacts,
    edge_edge: Contacts,
    dt: wp.float64,
):
    """Moves each vertex that has planes onto its sides, or truncates its path before its first contact.

    Paths are truncated where the step is recorded, and where contacts have no dividing planes. After
    ``max_truncations`` iterations vertices that still collide are frozen.
    """
    vertex = wp.tid()
    key = vertices.first_contact[vertex]
    if key == NEVER:
        if dividing.first:
            _keep_on_sides(motion, vertices, dividing, vertex)
        return
    vertices.first_contact[vertex] = NEVER
    if motion.inverse_mass[vertex] == 0.0:
        return
    time = wp.float64(key >> wp.int64(32)) / TIME_UNITS
    cuts = progress.status.iteration[0] <= progress.max_iterations + progress.max_truncations
    if is_recording(record) and (cuts or vertices.outcome[vertex] & FROZEN == 0):
        _record_truncation(vertices, record, vertex, -1, cuts, key, vertex_face, edge_edge)
    outcome = vertices.outcome[vertex]
    if cuts:
        x0 = motion.x0[vertex]
        end = vertices.x1[vertex]
        divides = bool(False)
        complete = bool(False)
        if dividing.first:
            divides = dividing.first[vertex] >= 0
            complete = divides and has_all_planes(dividing, vertex)
        if divides:
            end, truncated = position_on_sides(dividing, vertex, x0, end)
            outcome = outcome | wp.where(truncated, DIVIDED | TRUNCATED, DIVIDED)
        if not complete:
            path = truncated_path(to_double(x0), to_double(end), time)
            end = to_single(to_double(x0) + path)
            outcome = outcome | TRUNCATED
            if not divides:
                vertices.velocity[vertex] = to_single(path / dt)
        if divides and int(key & wp.int64(3)) == NO_CONSTRAINT:
            vertices.velocity[vertex] = (end - x0) / float(dt)
            outcome = outcome | UNCONSTRAINED
        vertices.x1[vertex] = end
        vertices.changed[vertex] = 1
        vertices.outcome[vertex] = outcome
    elif outcome & FROZEN == 0:
        vertices.x1[vertex] = motion.x0[vertex]
        vertices.changed[vertex] = 1
        vertices.velocity[vertex] = wp.vec3()
        vertices.outcome[vertex] = outcome | FROZEN
        wp.atomic_add(progress.status.newly_frozen, 0, 1)


@wp.kernel(**_KERNEL)
def record_body_truncations(
    motion: Motion, vertices: Vertices, record: StepRecord, vertex_face: Contacts, edge_edge: Contacts
):
    """Records the pose of each body whose path is to be truncated before the first contact of its vertices."""
    vertex = motion.bodies.particle_count + wp.tid()
    key = vertices.first_contact[vertex]
    if key == NEVER:
        return
    vertices.first_contact[vertex] = NEVER
    body = motion.bodies.of_vertex[vertex]
    if body < 0 or motion.bodies.inverse_mass[body] == 0.0 or vertices.bodies.outcome[body] & FROZEN != 0:
        return
    if vertices.bodies.first_contact[body] == first_contact_of_body(key, vertex):
        cuts = vertices.bodies.share[body] >= wp.int64(0)
        _record_truncation(vertices, record, vertex, body, cuts, key, vertex_face, edge_edge)


@wp.kernel(**_KERNEL)
def freeze_undetected(motion: Motion, vertices: Vertices, progress: Progress):
    """Freezes all vertices if a detection was incomplete, because a buffer overflowed."""
    vertex = wp.tid()
    if progress.status.undetected[0] == 1 and motion.inverse_mass[vertex] > 0.0:
        vertices.x1[vertex] = motion.x0[vertex]
        vertices.velocity[vertex] = wp.vec3()
        vertices.outcome[vertex] = vertices.outcome[vertex] | FROZEN
