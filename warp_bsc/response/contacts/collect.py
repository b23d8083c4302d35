"""Collects what a detection found: contacts and penetrations of planes become constraints or dividing planes."""

import warp as wp

from ...detection.settings import Count
from ...kernels.pipeline.queues import is_filled
from ...kernels.polynomials import EDGE_EDGE
from ...kernels.signs import FREE
from ..schedule import SolveStatus, count_contact, has_overflowed, is_dividing, widened
from ..state.mesh import Connectivity
from ..state.planes import MovingPlanes, signed_distance, time_of_entry
from ..state.record import StepRecord, is_recording
from ..state.structs import Constraints, DividingPlanes, Motion, Vertices
from ..state.vectors import ZERO, relative
from ..tuning import MAX_SAGITTA, PLANE_APPROACH, PLANE_DEPTH, PLANE_MARGIN
from .constraints import (
    EDGE_EDGE_CONTACT,
    PLANE_CONTACT,
    TOUCH,
    VERTEX_FACE_CONTACT,
    Contacts,
    add_constraint,
    contact_friction,
    contact_vertices,
    contact_weights,
    distances_at_start,
    feasible,
    feasible_in_contact,
    is_pushing,
    is_slow,
    sagitta,
    update_first_contact,
)
from .dividing_planes import add_dividing_plane, add_plane
from .rules import (
    are_occluded,
    are_on_body,
    bodies_meet,
    collides,
    crossed_at_start,
    crosses_face,
    inverse_mass_of,
    is_movable,
    is_on_body,
    met_at_start,
    touched_at_start,
)

wp.set_module_options({"enable_backward": False})

_QUEUED = wp.constant(int(Count.QUEUED))


@wp.kernel(enable_backward=False)
def count_crossings(
    # in
    motion: Motion,
    mesh: Connectivity,
    pairs: wp.array[wp.vec2i],
    counts: wp.array[wp.int64],
    # out
    count: wp.array[int],
):
    """Counts the pairs (edge, face) that certainly cross at the start and that the response can move."""
    i = wp.tid()
    if not is_filled(i, pairs, counts, _QUEUED):
        return
    edge = pairs[i][0]
    face = pairs[i][1]
    corners = wp.vec4i(mesh.edges[edge, 0], mesh.edges[edge, 1], mesh.faces[face, 0], mesh.faces[face, 1])
    if is_movable(motion, corners) or motion.inverse_mass[mesh.faces[face, 2]] > 0.0:
        if crosses_face(motion, mesh, edge, face):
            wp.atomic_add(count, 0, 1)


_KEPT = wp.constant(wp.float64(1.0 - 2.0**-30))
"""Share of its distance at the start that a particle keeps."""


@wp.func
def _stops(motion: Motion, planes: MovingPlanes, i: int, vertex: int) -> bool:
    """Returns whether a plane is to stop a vertex: not one of its own body, or of a shape that it passes."""
    if not is_on_body(motion, vertex):
        return True
    body = motion.bodies.of_vertex[vertex]
    shape = motion.bodies.shape[vertex - motion.bodies.particle_count]
    return body != planes.body[i] and collides(motion.bodies, shape, planes.shape[i])


@wp.func
def level(motion: Motion, planes: MovingPlanes, i: int, vertex: int) -> wp.float64:
    """Returns the distance from a plane that a vertex is kept at [m]: 0, or less for one of a body, see the module."""
    least = ZERO
    if is_on_body(motion, vertex):
        before, _error = signed_distance(planes.start[i], motion.x0[vertex])
        least = wp.min(before, ZERO)
        if motion.bodies.responds == 0:
            predicted, _error_predicted = signed_distance(planes.end[i], motion.x1[vertex])
            least = wp.min(predicted, least)
    return least


@wp.func
def offset_from(
    motion: Motion, planes: MovingPlanes, i: int, vertex: int, status: SolveStatus, separation: wp.float64
) -> wp.float64:
    """Returns the offset that constraints move a vertex to that a plane stops, without a minimum distance [m]."""
    distance = level(motion, planes, i, vertex)
    if distance == ZERO:
        before, _error = signed_distance(planes.start[i], motion.x0[vertex])
        distance = feasible(motion, wp.vec4i(vertex), widened(separation, status), before, separation)
    return planes.end[i][3] + distance


@wp.func
def _distances_from_plane(motion: Motion, planes: MovingPlanes, i: int, vertex: int):
    """Returns the distance that a vertex is kept at from a plane, and how much farther away it is near [m].

    Like a pair, a particle may come as near as it was at the start, see :mod:`warp_bsc.detection.approach_phase`.
    """
    if is_on_body(motion, vertex):
        return level(motion, planes, i, vertex), ZERO
    if not motion.distances.radius:
        return ZERO, ZERO
    before, error = signed_distance(planes.start[i], motion.x0[vertex])
    least = wp.min(motion.distances.radius[vertex] + motion.distances.of_planes, _KEPT * (before - error))
    return wp.max(least, ZERO), motion.distances.reach


@wp.kernel
def collect_penetrations(
    motion: Motion,
    vertices: Vertices,
    planes: MovingPlanes,
    constraints: Constraints,
    dividing: DividingPlanes,
    status: SolveStatus,
    separation: wp.float64,
    ahead: bool,
):
    """Adds constraints for vertices that may have entered solids; after the last projection, finds when they did.

    Vertices that were inside at the start are excluded, like pairs of elements that crossed. Ahead of the first
    detection, contacts are counted as those of the predicted motion only.
    """
    vertex = wp.tid()
    world = motion.world[vertex]
    if inverse_mass_of(motion, vertex) == 0.0:
        return
    for i in range(planes.end.shape[0]):
        if planes.world[i] >= 0 and planes.world[i] != world:
            continue
        after, error_after = signed_distance(planes.end[i], vertices.x1[vertex])
        least, reach = _distances_from_plane(motion, planes, i, vertex)
        if not (after <= least + wp.max(reach, error_after)):  # nor where the plane is not finite
            continue
        near = after > least + error_after  # only
        if near and not ahead:
            continue
        if least < ZERO and after >= least - PLANE_DEPTH * separation:
            continue
        if not _stops(motion, planes, i, vertex):
            continue
        before, error_before = signed_distance(planes.start[i], motion.x0[vertex])
        before -= least
        after -= least
        if before < -error_before:
            if not ahead:
                wp.atomic_add(status.detection.excluded, 0, 1)
            continue
        if ahead:
            wp.atomic_add(status.results.first_hits, 0, wp.where(near, 0, 1))
        else:
            count_contact(status, world)
            vertices.changed[vertex] = 1
            if status.loop.iteration[0] == 0 and is_on_body(motion, vertex):
                status.is_fast[world] = 1  # as between elements, see kernels.collect_contacts
        plane = planes.end[i]
        normal = wp.vec3d(plane[0], plane[1], plane[2])
        multiplier = wp.vec3d()
        if is_dividing(status, world, status.loop.iteration[0]):
            update_first_contact(vertices, vertex, time_of_entry(before, after), PLANE_CONTACT, i)
            if not dividing.first:
                continue
            stays, _error_stays = signed_distance(plane, motion.x0[vertex])
            margin = wp.min(PLANE_MARGIN * separation, PLANE_APPROACH * wp.max(stays - least, ZERO))
            offset = plane[3] + least + wp.min(wp.float64(2.0) * error_after, margin)
            if least < ZERO:
                offset = plane[3] + least - PLANE_DEPTH * separation
            add_plane(dividing, wp.vec4i(vertex, -1, -1, -1), 1, normal, offset, margin, ZERO)
            multiplier = TOUCH * normal
        else:
            status.loop.projecting[0] = 1
        place = add_constraint(
            motion,
            vertices,
            constraints,
            wp.vec4i(vertex),
            wp.vec4d(wp.float64(1.0), ZERO, ZERO, ZERO),
            normal,
            offset_from(motion, planes, i, vertex, status, separation) + wp.max(least, ZERO),
            contact_friction(motion.friction[vertex], planes.friction[i]),
            1,
            PLANE_CONTACT,
            True,
            ZERO,
            multiplier,
            wp.max(least, ZERO),
        )
        if place < constraints.plane.shape[0]:
            constraints.plane[place] = i


_CONTACTS = wp.constant(int(Count.CONTACTS))


@wp.func
def _collect_contact(
    motion: Motion,
    vertices: Vertices,
    contacts: Contacts,
    i: int,
    constraints: Constraints,
    dividing: DividingPlanes,
    status: SolveStatus,
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
                wp.atomic_add(status.detection.of_bodies, 0, 1)
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
    if status.results.crossings[0] > 0 and not met and contacts.kind <= EDGE_EDGE:
        met = crossed_at_start(motion, contacts.mesh, contacts.edges, contacts.pairs[i])
    if met:
        wp.atomic_add(status.detection.excluded, 0, wp.where(near, 0, 1))
        return
    world = motion.world[corners[0]]
    iteration = status.loop.iteration[0]
    slow = is_slow(motion, corners, contacts.kind)
    weights = contact_weights(contacts.kind, contacts.coordinates[i])
    normal = contacts.normal[i]
    if not near:
        count_contact(status, world)
        for j in range(4):
            vertices.changed[corners[j]] = 1
        if iteration == 0:
            # planes stand still: they would stop a body that takes along what it pushes
            moves = slow == 0 or are_on_body(motion, corners)
            if moves or is_pushing(motion, corners, weights, normal, least):
                status.is_fast[world] = 1
    multiplier = wp.vec3d()
    if near and is_dividing(status, world, iteration):
        return
    if is_dividing(status, world, iteration):
        for j in range(4):
            update_first_contact(vertices, corners[j], contacts.toi[i], contacts.edges, i)
        if not dividing.first:
            return
        add_dividing_plane(motion, vertices, corners, contacts.edges, separation, least, dividing, True, True)
        multiplier = TOUCH * normal
    else:
        if not near:
            status.loop.projecting[0] = 1
        if iteration == 0 and contacts.edges == 1:
            time = wp.where(near, wp.float64(0.0), contacts.toi[i])
            if are_occluded(motion, contacts.mesh, contacts.pairs[i], corners, normal, time):
                return  # the next detection finds it, if it is still there
    friction = contact_friction(motion.friction[corners[0]], motion.friction[corners[3]])
    target = widened(separation, status)
    if slow == 1:
        target = feasible_in_contact(motion, corners, weights, normal, target, separation, least)
    target += sagitta(motion, vertices, corners, MAX_SAGITTA * separation)
    target += least
    if near and wp.dot(normal, relative(weights, corners, vertices.x1)) < target:
        status.detection.too_near[0] = 1
        status.loop.projecting[0] = 1
        status.contact_iteration[world] = iteration
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


@wp.kernel
def collect_contacts(
    motion: Motion,
    vertices: Vertices,
    vertex_face: Contacts,
    edge_edge: Contacts,
    constraints: Constraints,
    dividing: DividingPlanes,
    status: SolveStatus,
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
    _collect_contact(motion, vertices, vertex_face, i, constraints, dividing, status, separation)
    _collect_contact(motion, vertices, edge_edge, i, constraints, dividing, status, separation)


@wp.kernel
def drop_if_full(constraints: Constraints, record: StepRecord, needed: int):
    """Drops all constraints if fewer than ``needed`` more fit, which a detection might add."""
    if constraints.count[0] > constraints.vertices.shape[0] - needed:
        constraints.count[0] = 0
        if is_recording(record):
            record.counts.dropped[0] = 1
