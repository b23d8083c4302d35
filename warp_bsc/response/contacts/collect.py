"""Collects what a detection found: contacts and penetrations of planes become constraints or dividing planes."""

import warp as wp

from ...detection.narrow.rules.approach import KEPT
from ...detection.run.settings import Count
from ...kernels.arcs import Arcs
from ...kernels.closest import contact_weights
from ...kernels.pipeline.queues import filled_entries, has_overflowed
from ...kernels.polynomials import EDGE_EDGE
from ...kernels.signs import FREE
from ..schedule import count_contact, count_filtered, divides_after, widened
from ..state.planes import MovingPlanes, is_filtered_by_plane, signed_distance, time_of_entry
from ..state.status import Detection, Loop, Result, SolveStatus
from ..state.structs import ContactKind, DividingPlanes, Motion, Pace, Step, body_of
from ..state.vectors import ONE, ZERO, relative
from ..tuning import PLANE_APPROACH, PLANE_DEPTH, PLANE_MARGIN
from . import constraints, rules
from .constraints import TOUCH
from .first_contact import update_first_contact
from .planes_between import add_dividing_plane, add_solid
from .queue import PairQueue, has_pair, pair_count, vertices_of
from .rules import ContactClass

wp.set_module_options({"enable_backward": False})


@wp.func
def _count_crossing(
    step: Step, edge: int, face: int, count: wp.array[int], of_worlds: wp.array[int], of_edges: wp.array[int]
):
    mesh = step.mesh
    corners = wp.vec4i(mesh.edges[edge, 0], mesh.edges[edge, 1], mesh.faces[face, 0], mesh.faces[face, 1])
    movable = rules.owner_of(step.motion, corners) == ContactClass.OURS
    if movable or step.motion.inverse_mass[mesh.faces[face, 2]] > 0.0:
        if rules.crosses_face(step, edge, face):
            wp.atomic_add(count, 0, 1)
            wp.atomic_add(of_worlds, step.motion.world[corners[0]], 1)
            wp.atomic_add(of_edges, edge, 1)


@wp.kernel(enable_backward=False)
def count_crossings(
    # in
    step: Step,
    pairs: wp.array[wp.vec2i],
    counts: wp.array[wp.int64],
    # out
    count: wp.array[int],
    of_worlds: wp.array[int],
    of_edges: wp.array[int],
    threads: int,
):
    """Counts the pairs (edge, face) that certainly cross at the start and that the response can move."""
    for i in range(wp.tid(), filled_entries(pairs, counts, Count.QUEUED), threads):
        _count_crossing(step, pairs[i][0], pairs[i][1], count, of_worlds, of_edges)


@wp.kernel(enable_backward=False)
def count_new_crossings(of_edges: wp.array[int], before: wp.array[int], status: SolveStatus):
    """Counts how many more faces edges cross than at the start of the step before."""
    edge = wp.tid()
    more = of_edges[edge] - before[edge]
    if more > 0:
        wp.atomic_add(status.results, int(Result.NEW_CROSSINGS), more)


@wp.func
def is_stopped_by_plane(motion: Motion, planes: MovingPlanes, i: int, vertex: int) -> bool:
    """Returns whether a plane stops a vertex: not one of its own body, or of a shape that it does not collide with."""
    body = body_of(motion, vertex)
    if body < 0:
        return True
    shape = motion.bodies.shape[vertex - motion.bodies.particle_count]
    return body != planes.body[i] and rules.collides(motion.bodies, shape, planes.shape[i])


@wp.func
def level(motion: Motion, planes: MovingPlanes, i: int, vertex: int) -> wp.float64:
    """Returns the distance from a plane that a vertex is kept at, without a minimum distance [m].

    It is 0; less for a vertex of a body that starts in the solid or, if the response moves no bodies there, is
    predicted to end in it: a body goes no deeper.
    """
    lowest = ZERO
    if body_of(motion, vertex) >= 0:
        before, _error = signed_distance(planes.start[i], motion.x0[vertex])
        lowest = wp.min(before, ZERO)
        if motion.bodies.responds == 0:
            predicted, _error_predicted = signed_distance(planes.end[i], motion.x1[vertex])
            lowest = wp.min(predicted, lowest)
    return lowest


@wp.func
def offset_from(step: Step, planes: MovingPlanes, i: int, vertex: int, status: SolveStatus) -> wp.float64:
    """Returns the offset at which constraints keep a vertex that a plane stops, without a minimum distance [m]."""
    distance = level(step.motion, planes, i, vertex)
    if distance == ZERO:
        before, _error = signed_distance(planes.start[i], step.motion.x0[vertex])
        distance = constraints.feasible(step, wp.vec4i(vertex), widened(step.separation, status), before)
    return planes.end[i][3] + distance


@wp.func
def distances_from_plane(motion: Motion, planes: MovingPlanes, i: int, vertex: int):
    """Returns the distance that a vertex is kept at from a plane, and how much farther away it is near [m].

    Like a pair, a particle may come as near as it was at the start, see
    :mod:`warp_bsc.detection.narrow.rules.approach`.
    """
    if body_of(motion, vertex) >= 0:
        return level(motion, planes, i, vertex), ZERO
    if not motion.distances.radius:
        return ZERO, ZERO
    before, error = signed_distance(planes.start[i], motion.x0[vertex])
    kept = wp.min(motion.distances.radius[vertex] + motion.distances.of_planes[i], KEPT * (before - error))
    return wp.max(kept, ZERO), motion.distances.reach


@wp.func
def mark_changed(step: Step, status: SolveStatus, corners: wp.vec4i):
    """Marks the vertices of a contact for the next detection; a first one notes worlds where one was frozen lately."""
    for j in range(4):
        step.vertices.changed[corners[j]] = 1
        if status.loop[Loop.ITERATION] == 0 and step.vertices.frozen_lately[corners[j]] > 0:
            status.is_stuck[step.motion.world[corners[j]]] = 1


@wp.kernel
def collect_penetrations(step: Step, planes: MovingPlanes, ahead: bool, dividing: DividingPlanes, status: SolveStatus):
    """Adds constraints for vertices that may have entered solids; after the last projection, dividing planes too.

    Vertices that were inside at the start are excluded, like pairs of elements that crossed. Ahead of the first
    detection, contacts are counted as those of the predicted motion only.
    """
    vertex = wp.tid()
    motion, vertices, separation = step.motion, step.vertices, step.separation
    world = motion.world[vertex]
    if rules.inverse_mass_of(motion, vertex) == 0.0:
        return
    for place in range(planes.of_worlds.shape[1]):
        i = planes.of_worlds[world, place]
        if i < 0:
            return
        after, error_after = signed_distance(planes.end[i], vertices.x1[vertex])
        kept, reach = distances_from_plane(motion, planes, i, vertex)
        if not (after <= kept + wp.max(reach, error_after)):  # nor where the plane is not finite
            continue
        near = after > kept + error_after  # not a contact
        if near and not ahead:
            continue
        if kept < ZERO and after >= kept - PLANE_DEPTH * separation:
            continue
        if is_filtered_by_plane(motion, planes, i, vertex):
            if not ahead:
                count_filtered(status, world)
            continue
        if not is_stopped_by_plane(motion, planes, i, vertex):
            continue
        before, error_before = signed_distance(planes.start[i], motion.x0[vertex])
        before -= kept
        after -= kept
        if before < -error_before:
            if not ahead:
                wp.atomic_add(status.detection, int(Detection.EXCLUDED), 1)
            continue
        if ahead:
            wp.atomic_add(status.results, int(Result.FIRST_HITS), wp.where(near, 0, 1))
            if status.of_worlds.hits:
                wp.atomic_add(status.of_worlds.hits, world, wp.where(near, 0, 1))
        else:
            count_contact(status, world)
            mark_changed(step, status, wp.vec4i(vertex))
            if status.loop[Loop.ITERATION] == 0 and body_of(motion, vertex) >= 0:
                status.is_fast[world] = 1  # as between elements, see _collect_contact
        plane = planes.end[i]
        added = constraints.Constraint()
        added.normal = wp.vec3d(plane[0], plane[1], plane[2])
        if divides_after(status, world, status.loop[Loop.ITERATION]):
            update_first_contact(vertices, vertex, time_of_entry(before, after), ContactKind.PLANE, i)
            stays, _error_stays = signed_distance(plane, motion.x0[vertex])
            stays = wp.max(stays - kept, ZERO)
            # what is pressed would come nearer by a share in each step, down to 0
            least = wp.min(stays, constraints.rounding_at(step, motion.x0[vertex]))
            margin = wp.min(PLANE_MARGIN * separation, wp.max(PLANE_APPROACH * stays, least))
            offset = plane[3] + kept + wp.min(wp.float64(2.0) * error_after, margin)
            if kept < ZERO:
                offset = plane[3] + kept - PLANE_DEPTH * separation
            add_solid(motion, dividing, vertex, added.normal, offset, float(margin))
            added.multiplier = TOUCH * added.normal
        else:
            status.loop[Loop.PROJECTING] = 1
        added.vertices = wp.vec4i(vertex)
        added.weights = wp.vec4d(ONE, ZERO, ZERO, ZERO)
        added.min_distance = wp.max(kept, ZERO)
        added.separation = offset_from(step, planes, i, vertex, status) + added.min_distance
        added.friction = constraints.friction_on_plane(motion, planes, i, vertex)
        added.kind = ContactKind.PLANE
        added.plane = i
        added.pace = Pace.SLOW
        constraints.add_constraint(step, added)


@wp.func
def _collect_contact(
    step: Step, contacts: PairQueue, i: int, arcs: Arcs, dividing: DividingPlanes, status: SolveStatus
):
    """Counts a contact, and adds a constraint for it; after the last projection, dividing planes."""
    if not has_pair(contacts, i):
        return
    motion, vertices = step.motion, step.vertices
    near = int(contacts.status[i]) == FREE  # within reach of its minimum distance, but not a contact
    if near and not motion.distances.radius:
        return
    kind = contacts.kind
    toi = contacts.toi[i]
    corners = vertices_of(contacts, i)
    owner = rules.owner_of(motion, corners)
    if owner == ContactClass.NONE or (near and owner != ContactClass.OURS):
        return
    if owner == ContactClass.FILTERED:
        count_filtered(status, motion.world[corners[0]])
        return
    added = constraints.Constraint()
    bound = toi
    if motion.distances.radius:
        start, kept = constraints.distances_at_start(motion, corners, kind)
        added.min_distance = kept
        bound = start
    world = motion.world[corners[0]]
    may_cross = status.crossings[world] > 0
    found = rules.classify_contact(step, kind, contacts.pairs[i], corners, owner, bound, may_cross)
    if found == ContactClass.CROSSED:
        wp.atomic_add(status.detection, int(Detection.EXCLUDED), wp.where(near, 0, 1))
    if found == ContactClass.OF_BODIES:
        wp.atomic_add(status.detection, int(Detection.OF_BODIES), 1)
        mark_changed(step, status, corners)
    if found != ContactClass.OURS:
        return
    iteration = status.loop[Loop.ITERATION]
    added.vertices = corners
    added.pace = constraints.pace_of(motion, corners, kind)
    added.weights = contact_weights(kind, contacts.coordinates[i])
    added.normal = contacts.normal[i]
    added.kind = constraints.kind_of_contact(kind)
    if not near:
        count_contact(status, world)
        mark_changed(step, status, corners)
        if iteration == 0:
            # dividing planes do not follow bodies: they would stop one that takes along what it pushes
            moves = added.pace == Pace.FAST or rules.are_on_body(motion, corners)
            if moves or constraints.is_pushing(motion, corners, added.weights, added.normal, added.min_distance):
                status.is_fast[world] = 1
    if divides_after(status, world, iteration):
        if near:
            return
        for j in range(4):
            update_first_contact(vertices, corners[j], toi, added.kind, i)
        add_dividing_plane(step, corners, kind, added.min_distance, dividing, True)
        added.multiplier = TOUCH * added.normal
    else:
        if not near:
            status.loop[Loop.PROJECTING] = 1
        if iteration == 0 and kind == EDGE_EDGE:
            time = wp.where(near, ZERO, toi)
            skipped = rules.are_occluded(step, contacts.pairs[i], corners, added.normal, time)
            if added.pace == Pace.SLOW:
                skipped = skipped or rules.are_parallel(motion, corners)
            if skipped:
                return  # the next detection finds it, if it is still there
    target = widened(step.separation, status)
    if added.pace == Pace.SLOW:
        before = wp.dot(added.normal, relative(added.weights, corners, motion.x0)) - added.min_distance
        target = constraints.feasible(step, corners, target, before)
    ahead = constraints.ahead_of_chords(step, arcs, corners, added.weights, added.normal, toi)
    target += wp.max(constraints.sagitta(step, corners), ahead)
    target += added.min_distance
    if near and wp.dot(added.normal, relative(added.weights, corners, vertices.x1)) < target:
        status.detection[Detection.TOO_NEAR] = 1
        status.loop[Loop.PROJECTING] = 1
        status.contact_iteration[world] = iteration
    added.separation = target
    added.friction = constraints.pair_friction(motion, corners)
    added.toi = toi
    constraints.add_constraint(step, added)


@wp.kernel
def collect_contacts(
    # in
    first: PairQueue,
    second: PairQueue,
    counts: wp.array[wp.int64],
    capacities: wp.array[wp.int64],
    arcs: Arcs,
    # in and out
    step: Step,
    dividing: DividingPlanes,
    status: SolveStatus,
    threads: int,
):
    """Adds constraints for the contacts of two kinds, and counts them; after the last projection, dividing planes.

    Then it finds the first contact of each vertex as well. Does nothing if :mod:`.search` is to find all contacts
    because a queue overflowed: which contacts are among those that fit depends on the order of threads.
    """
    if has_overflowed(counts, capacities):
        return
    for i in range(wp.tid(), wp.max(pair_count(first), pair_count(second)), threads):
        number = int(0)
        while number < 2:  # one body for both, which is large
            _collect_contact(step, wp.where(number == 0, first, second), i, arcs, dividing, status)
            number += 1


@wp.kernel
def clear_changed(step: Step, needed: int):
    """Clears which vertices changed; drops all constraints if fewer than ``needed`` fit, which a detection may add."""
    vertex = wp.tid()
    step.vertices.changed[vertex] = 0
    if vertex == 0 and step.constraints.count[0] > step.constraints.vertices.shape[0] - needed:
        step.constraints.count[0] = 0
