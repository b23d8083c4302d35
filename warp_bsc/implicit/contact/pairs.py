"""Pairs of elements that may come near each other in a step, those that are near, and the bounds that they set."""

import warp as wp

from ...detection.approach_phase import distances_of_pair
from ...kernels.pipeline.queues import take_slot_int
from ...kernels.polynomials import EDGE_EDGE, VERTEX_FACE
from ...response.contacts.collect import is_stopped_by_plane
from ...response.contacts.constraints import friction_on_plane, pair_friction
from ...response.contacts.queue import PairQueue, has_pair, pair_count, vertices_of
from ...response.contacts.rules import ContactClass, crossed_at_start, inverse_mass_of, owner_of
from ...response.state.planes import MovingPlanes, is_filtered_by_plane, signed_distance
from ...response.state.structs import Motion, Step, body_of
from ...response.state.vectors import HALF, ONE, ZERO, corners_of, to_double, to_single
from . import barrier
from .system import Contacts, Progress, Unknowns, contact_count, displacement, is_solved, unknown_of_corner

wp.set_module_options({"enable_backward": False})

_KEPT = wp.constant(wp.float64(1.0 - 2.0**-30))
"""Share of its distance at the start that a pair keeps which starts within its minimum distance."""
_LEAST_GAP = wp.constant(wp.float64(1e-6))
"""Least gap at the start for a barrier, as a share of its reach: forces stay finite where elements nearly touch."""
_PARTED = wp.constant(1e-3)
"""How far what touches a shape is moved off it, as a share of its reach."""
_PARTED_ROUNDED = wp.constant(2.0**-20)
"""The same at least, as a share of its largest coordinate."""
_COUPLES = wp.constant(wp.int64(1 << 61))
"""What is added to the number of a contact that couples, so that it comes last."""
_UNITS_LIMIT = wp.constant(wp.float64(2.0**52))
"""Most units of one energy: a thousand of them fit into a sum, and a speed of 900 m/s into one."""


@wp.struct
class Candidates:
    """Pairs of one kind that may come near each other in the step.

    Attributes:
        queue: The pairs.
        kept: Distance that each pair keeps in any case [m].
        level: Distance at which its barrier is infinite [m], no more than that.
        reach: Gap beyond the level from which its barrier pushes [m]; 0 of a pair that is excluded.
        share: Share of the last displacements before it would meet.
    """

    queue: PairQueue
    kept: wp.array[wp.float64]
    level: wp.array[wp.float64]
    reach: wp.array[float]
    share: wp.array[float]


@wp.struct
class BarrierSettings:
    """What barriers and friction depend on.

    Attributes:
        dt: Length of the step [s].
        reach: Of each vertex: gap from which it pushes [m], infinite for shapes.
        reach_of_bodies: Of each vertex of a body: gap from which it pushes other shapes [m]; infinite for others.
        recovery: By how much more than its gap at the start a pair gets a gap by its barrier [m].
        elasticity: Of each vertex: stiffness of the solid around it against a push [N/m].
        smoothing: Length below which friction is smoothed [m].
        units: Units of energy in a joule, in each world.
    """

    dt: wp.float64
    reach: wp.array[float]
    reach_of_bodies: wp.array[float]
    recovery: wp.float64
    elasticity: wp.array[float]
    smoothing: wp.float64
    units: wp.array[wp.float64]


@wp.struct
class Trial:
    """Positions, and displacements from them, of which each world takes a share.

    Attributes:
        x: Positions of vertices [m].
        displaced: Displacements [m].
        share: Share of its displacement that a vertex takes of what its world takes.
        holder: Vertex whose share each vertex takes: itself, or the first of its body.
        bend: How far arcs of vertices leave their displacements at most, by t (1 - t) at a share t of them [m].
        moved: Positions after displacements.
    """

    x: wp.array[wp.vec3]
    displaced: wp.array[wp.vec3]
    share: wp.array[float]
    holder: wp.array[int]
    bend: wp.array[float]
    moved: wp.array[wp.vec3]


@wp.func
def moved(trial: Trial, scale: float, vertex: int) -> wp.vec3:
    """Returns the position of a vertex after a share of its displacement, rounded as it is stored."""
    return trial.x[vertex] + (scale * trial.share[trial.holder[vertex]]) * trial.displaced[vertex]


@wp.func
def _bends(trial: Trial, scale: float, corners: wp.vec4i) -> wp.vec2d:
    """Returns how far shares of displacements may be off, as :func:`.barrier.safe_share` takes it."""
    first, second = float(0.0), float(0.0)
    for k in range(2):  # corners 0 and 3 are of different elements
        of_first = trial.holder[corners[k]] == trial.holder[corners[0]]
        first = wp.max(first, wp.where(of_first, trial.bend[corners[k]], 0.0))
    for k in range(1, 4):
        of_second = trial.holder[corners[k]] == trial.holder[corners[3]]
        second = wp.max(second, wp.where(of_second, trial.bend[corners[k]], 0.0))
    share = scale * trial.share[trial.holder[corners[0]]]
    other = scale * trial.share[trial.holder[corners[3]]]
    first, second = share * first, other * second
    return wp.vec2d(wp.float64(first + second), wp.float64(share * first + other * second))


@wp.func
def _reach_of(settings: BarrierSettings, corners: wp.vec4i) -> float:
    reach, of_bodies = float(wp.inf), float(wp.inf)
    for j in range(4):
        reach = wp.min(reach, settings.reach[corners[j]])
        of_bodies = wp.min(of_bodies, settings.reach_of_bodies[corners[j]])
    return wp.where(reach < wp.inf, reach, of_bodies)


@wp.func
def _inverse_mass(motion: Motion, vertex: int) -> float:
    inverse = motion.inverse_mass[vertex]
    if inverse == 0.0 and motion.bodies.of_vertex:
        body = motion.bodies.of_vertex[vertex]
        if body >= 0:
            inverse = motion.bodies.inverse_mass[body]
    return inverse


@wp.func
def _compliance(motion: Motion, settings: BarrierSettings, vertex: int) -> wp.float64:
    """Returns how far a force of 1 N moves a vertex in the step [m/N], by its mass and the solid around it."""
    inverse = wp.float64(_inverse_mass(motion, vertex))
    return inverse / (ONE / (settings.dt * settings.dt) + inverse * wp.float64(settings.elasticity[vertex]))


@wp.func
def _stiffness(motion: Motion, settings: BarrierSettings, corners: wp.vec4i, is_edges: bool) -> wp.float64:
    """Returns the stiffness of a barrier [N/m]: at half of its reach, its curvature is that of what it pushes apart."""
    first = _compliance(motion, settings, corners[0])
    second = _compliance(motion, settings, corners[2]) + _compliance(motion, settings, corners[3])
    if is_edges:
        first = HALF * (first + _compliance(motion, settings, corners[1]))
        second = HALF * second
    else:
        second = (second + _compliance(motion, settings, corners[1])) / wp.float64(3.0)
    return ONE / ((first + second) * wp.float64(barrier.CURVATURE_AT_HALF))


@wp.func
def _stiffness_at_plane(motion: Motion, settings: BarrierSettings, vertex: int) -> wp.float64:
    """Returns the stiffness of a barrier between a particle and a plane [N/m], see :func:`_stiffness`."""
    return ONE / (_compliance(motion, settings, vertex) * wp.float64(barrier.CURVATURE_AT_HALF))


@wp.func
def _barrier_of(settings: BarrierSettings, start: wp.float64, kept: wp.float64, reach: float):
    """Returns the level and the reach of the barrier of a pair, by its distance at the start and that to keep.

    The reach of what starts within it ends a little above its gap: a barrier otherwise throws apart, at up to its reach
    a step, what a program puts there or what fell there in the step before.
    """
    whole = wp.float64(reach)
    level = wp.min(kept, start - _LEAST_GAP * whole)
    return level, wp.min(whole, start - level + settings.recovery)


@wp.struct
class Touching:
    """Particles that touch a face of a shape, to part them.

    Attributes:
        face: The first such face of each vertex; :data:`NO_FACE` for none.
        any: 1 if there is one, shape [1].
    """

    face: wp.array[int]
    any: wp.array[int]


NO_FACE = wp.constant(2**31 - 1)


@wp.func
def _prepare(
    step: Step,
    candidates: Candidates,
    settings: BarrierSettings,
    origin: wp.array[wp.vec3],
    crossings: wp.array[int],
    touching: Touching,
    i: int,
):
    motion, queue = step.motion, candidates.queue
    corners = vertices_of(queue, i)
    candidates.reach[i] = 0.0
    candidates.kept[i] = ZERO
    if owner_of(motion, corners) != ContactClass.OURS:
        return
    a, b, c, d = corners_of(origin, corners)
    if not wp.isfinite(a + b + c + d):
        return
    start = ZERO
    if motion.distances.radius:
        found, kept = distances_of_pair(motion.distances, queue.kind, corners, a, b, c, d)
        start = found
        candidates.kept[i] = kept
    else:
        start = barrier.least_distance(queue.kind, a, b, c, d)
    if not start > ZERO:
        if start == ZERO and queue.kind == VERTEX_FACE and settings.reach[corners[1]] == wp.inf:
            if motion.inverse_mass[corners[0]] > 0.0:
                wp.atomic_min(touching.face, corners[0], queue.pairs[i][1])
                touching.any[0] = 1
        return
    if crossings[motion.world[corners[0]]] > 0:
        if crossed_at_start(step, queue.kind, queue.pairs[i]):
            return
    level, reach = _barrier_of(settings, start, candidates.kept[i], _reach_of(settings, corners))
    candidates.level[i] = level
    candidates.reach[i] = float(reach)


@wp.kernel
def prepare_candidates(
    # in
    step: Step,
    settings: BarrierSettings,
    origin: wp.array[wp.vec3],
    crossings: wp.array[int],
    # in and out
    first: Candidates,
    second: Candidates,
    # out
    touching: Touching,
    threads: int,
):
    """Writes distances that candidates keep, and excludes those that touch or cross at the start of the step."""
    for i in range(wp.tid(), wp.max(pair_count(first.queue), pair_count(second.queue)), threads):
        number = int(0)
        while number < 2:
            of = first
            if number == 1:
                of = second
            if has_pair(of.queue, i):
                _prepare(step, of, settings, origin, crossings, touching, i)
            number += 1


@wp.kernel
def part_touching(
    # in
    step: Step,
    settings: BarrierSettings,
    touching: Touching,
    # in and out
    trial: Trial,
    origin: wp.array[wp.vec3],
):
    """Moves particles that touch a face of a shape off it a little, to the side to which it faces."""
    v = wp.tid()
    face = touching.face[v]
    if face == NO_FACE:
        return
    x, mesh = trial.x[v] + wp.vec3(), step.mesh
    a, b, c = trial.x[mesh.faces[face, 0]], trial.x[mesh.faces[face, 1]], trial.x[mesh.faces[face, 2]]
    off = wp.max(_PARTED * settings.reach[v], _PARTED_ROUNDED * wp.max(wp.abs(x)))
    parted = x + off * wp.normalize(wp.cross(b - a, c - a))
    trial.x[v] = parted
    origin[v] = parted


@wp.func
def _merged(corners: wp.vec4i, weights: wp.vec4d) -> wp.vec4d:
    """Returns weights with those of corners that are one vertex, as points have them, at the first of these."""
    merged = weights
    for j in range(3, 1, -1):
        if corners[j] == corners[j - 1]:
            merged[j - 1] = merged[j - 1] + merged[j]
            merged[j] = ZERO
    return merged


@wp.func
def _key(group: int, kind: int, first: int, second: int) -> wp.int64:
    """Returns a number of a pair, different for each pair of a kind, and for each group of contacts."""
    return (wp.int64(8 * group + kind) << wp.int64(56)) | (wp.int64(first) << wp.int64(28)) | wp.int64(second)


@wp.func
def _couples(unknowns: Unknowns, corners: wp.vec4i, weights: wp.vec4d) -> int:
    """Returns whether both elements of a contact are solved for, or one is of a body."""
    first, second = int(0), int(0)
    for j in range(4):
        u = unknowns.of_vertex[corners[j]]
        if u < -1:
            return 1
        if u >= 0 and weights[j] > ZERO:
            first = 1
        if u >= 0 and weights[j] < ZERO:
            second = 1
    return first * second


@wp.func
def _add_contact(
    motion: Motion,
    contacts: Contacts,
    settings: BarrierSettings,
    trial: Trial,
    unknowns: Unknowns,
    corners: wp.vec4i,
    weights: wp.vec4d,
    normal: wp.vec3d,
    shifted: wp.vec3d,
    approach: wp.float64,
    gap: wp.float64,
    reach: wp.float64,
    stiffness: wp.float64,
    friction: float,
    key: wp.int64,
):
    """Adds a contact, with the derivatives of its barrier and friction.

    ``shifted`` is how far the second point has moved since the start beside its corners, ``approach`` how far what a
    program moves goes along the normal in this Newton step.
    """
    slot = take_slot_int(contacts.count)
    if slot >= contacts.corners.shape[0]:
        return
    load = -stiffness * barrier.barrier_slope(gap, reach)
    curvature = stiffness * barrier.barrier_curvature(gap, reach)
    slid, given = -shifted, ZERO
    for j in range(4):
        v = corners[j]
        slid += weights[j] * (to_double(trial.x[v]) - to_double(motion.x0[v]))
        if unknowns.of_vertex[v] < 0 and not is_solved(unknowns, v):
            given += weights[j] * wp.dot(normal, to_double(trial.displaced[v]))
    slid -= wp.dot(slid, normal) * normal
    gradient = (-load + curvature * (given - approach)) * normal
    hessian = curvature * wp.outer(normal, normal)
    if friction > 0.0 and load > ZERO:
        length, limit = wp.length(slid), wp.float64(friction) * load
        slope = limit * barrier.friction_slope(length, settings.smoothing)
        gradient += slope * slid
        across = wp.identity(n=3, dtype=wp.float64) - wp.outer(normal, normal)
        if length > ZERO:
            along = slid / length
            more = limit * barrier.friction_curvature(length, settings.smoothing) - slope
            across = slope * across + more * wp.outer(along, along)
        else:
            across = slope * across
        hessian += across
    contacts.corners[slot] = corners
    contacts.weights[slot] = wp.vec4(float(weights[0]), float(weights[1]), float(weights[2]), float(weights[3]))
    contacts.normal[slot] = to_single(normal)
    contacts.load[slot] = float(load)
    contacts.friction[slot] = friction
    contacts.gradient[slot] = to_single(gradient)
    single = wp.mat33()
    for row in range(3):
        for column in range(3):
            single[row, column] = float(hessian[row, column])
    contacts.hessian[slot] = single
    contacts.key[slot] = key
    contacts.couples[slot] = _couples(unknowns, corners, weights)


@wp.func
def _find_near(
    motion: Motion,
    candidates: Candidates,
    settings: BarrierSettings,
    trial: Trial,
    unknowns: Unknowns,
    active: wp.array[int],
    contacts: Contacts,
    i: int,
):
    reach = wp.float64(candidates.reach[i])
    if reach == ZERO:
        return
    queue = candidates.queue
    corners = vertices_of(queue, i)
    if active[motion.world[corners[0]]] == 0:
        return
    a, b, c, d = corners_of(trial.x, corners)
    if barrier.distance_of_boxes(queue.kind, a, b, c, d) >= candidates.level[i] + reach:
        return
    weights, distance = barrier.closest_weights_and_gap(queue.kind, a, b, c, d)
    gap = distance - candidates.level[i]
    if gap >= reach or not gap > ZERO:
        return
    normal = (weights[0] * a + weights[1] * b + weights[2] * c + weights[3] * d) / distance
    stiffness = _stiffness(motion, settings, corners, queue.kind == EDGE_EDGE)
    pair = queue.pairs[i]
    key = _key(0, queue.kind, pair[0], pair[1])
    friction = pair_friction(motion, corners)
    _add_contact(
        motion,
        contacts,
        settings,
        trial,
        unknowns,
        corners,
        _merged(corners, weights),
        normal,
        wp.vec3d(),
        ZERO,
        gap,
        reach,
        stiffness,
        friction,
        key,
    )


@wp.kernel
def find_near(
    # in
    motion: Motion,
    first: Candidates,
    second: Candidates,
    settings: BarrierSettings,
    trial: Trial,
    unknowns: Unknowns,
    active: wp.array[int],
    # out
    contacts: Contacts,
    threads: int,
):
    """Adds contacts for the candidates that are near each other, in active worlds."""
    for i in range(wp.tid(), wp.max(pair_count(first.queue), pair_count(second.queue)), threads):
        number = int(0)
        while number < 2:
            of = first
            if number == 1:
                of = second
            if has_pair(of.queue, i):
                _find_near(motion, of, settings, trial, unknowns, active, contacts, i)
            number += 1


@wp.func
def _plane_gap(motion: Motion, planes: MovingPlanes, settings: BarrierSettings, i: int, vertex: int):
    """Returns the distance that a vertex keeps from a plane, and the level and the reach of its barrier.

    The reach is 0 if it is excluded.
    """
    if is_filtered_by_plane(motion, planes, i, vertex) or not is_stopped_by_plane(motion, planes, i, vertex):
        return ZERO, ZERO, ZERO
    start, error = signed_distance(planes.start[i], motion.x0[vertex])
    if not start >= -error:
        return ZERO, ZERO, ZERO
    kept = wp.min(start - error, ZERO)
    if motion.distances.radius and start > error:
        kept = wp.min(motion.distances.radius[vertex] + motion.distances.of_planes[i], _KEPT * (start - error))
    whole = wp.where(body_of(motion, vertex) < 0, settings.reach[vertex], settings.reach_of_bodies[vertex])
    level, reach = _barrier_of(settings, start, kept, whole)
    return kept, level, reach


@wp.func
def _plane_at(planes: MovingPlanes, i: int, share: float) -> wp.vec4d:
    """Returns a plane after a share of its way in the step."""
    t = wp.float64(share)
    plane = (ONE - t) * planes.start[i] + t * planes.end[i]
    return plane / wp.length(wp.vec3d(plane[0], plane[1], plane[2]))


@wp.kernel
def find_near_planes(
    # in
    motion: Motion,
    planes: MovingPlanes,
    plane_share: wp.array[float],
    settings: BarrierSettings,
    trial: Trial,
    unknowns: Unknowns,
    active: wp.array[int],
    # out
    contacts: Contacts,
):
    """Adds contacts for the particles that are near infinite planes, in active worlds."""
    vertex = wp.tid()
    world = motion.world[vertex]
    if inverse_mass_of(motion, vertex) == 0.0 or active[world] == 0:
        return
    for place in range(planes.of_worlds.shape[1]):
        i = planes.of_worlds[world, place]
        if i < 0:
            return
        plane = _plane_at(planes, i, plane_share[world])
        distance, _error = signed_distance(plane, trial.x[vertex])
        _kept, level, reach = _plane_gap(motion, planes, settings, i, vertex)
        gap = distance - level
        if gap >= reach or not gap > ZERO:
            continue
        normal = wp.vec3d(plane[0], plane[1], plane[2])
        stiffness = _stiffness_at_plane(motion, settings, vertex)
        key = _key(1, 0, vertex, i)
        there, _error_there = signed_distance(planes.end[i], trial.x[vertex])
        since, _since_error = signed_distance(planes.start[i], trial.x[vertex])
        _add_contact(
            motion,
            contacts,
            settings,
            trial,
            unknowns,
            wp.vec4i(vertex),
            wp.vec4d(ONE, ZERO, ZERO, ZERO),
            normal,
            (since - distance) * normal,
            distance - there,
            gap,
            reach,
            stiffness,
            friction_on_plane(motion, planes, i, vertex),
            key,
        )


@wp.kernel
def count_entries(
    # in
    contacts: Contacts,
    unknowns: Unknowns,
    world: wp.array[int],
    threads: int,
):
    """Counts the contacts of each unknown that is solved for, in ``end``, and those of each world that couple."""
    for i in range(wp.tid(), contact_count(contacts), threads):
        for j in range(4):
            if contacts.weights[i][j] != 0.0:
                vertex = contacts.corners[i][j]
                u = unknown_of_corner(unknowns, vertex)
                if u >= 0:
                    if unknowns.is_free[u] != 0:
                        wp.atomic_add(contacts.end, u, 1)
                        if unknowns.of_vertex[vertex] < 0:
                            wp.atomic_add(contacts.end, u + 1, 1)
        if contacts.couples[i] != 0:
            wp.atomic_add(contacts.coupled_end, world[contacts.corners[i][0]], 1)


@wp.kernel
def place_entries(contacts: Contacts, lacks: wp.array[int]):
    """Gives each unknown room for its contacts, anywhere; ``end`` becomes the first of them. So for each world."""
    u = wp.tid()
    if u == 0 and contacts.count[0] > contacts.corners.shape[0]:
        lacks[0] = 1
    if u < contacts.coupled_first.shape[0]:
        start = wp.atomic_add(contacts.listed, 1, contacts.coupled_end[u])
        contacts.coupled_first[u] = start
        contacts.coupled_end[u] = start
    if u >= contacts.first.shape[0]:
        return
    count = contacts.end[u]
    if count > 0:
        first = wp.atomic_add(contacts.listed, 0, count)
        contacts.first[u] = first
        contacts.end[u] = first
    else:
        contacts.first[u] = 0
        contacts.middle[u] = 0


@wp.func
def _list_entry(contacts: Contacts, u: int, entry: int):
    n = wp.atomic_add(contacts.end, u, 1)
    contacts.unsorted[n] = entry
    contacts.row[n] = u
    contacts.order[n] = wp.int64(contacts.couples[entry >> 2]) * _COUPLES + contacts.key[entry >> 2]


@wp.kernel
def list_entries(
    # in and out
    contacts: Contacts,
    # in
    unknowns: Unknowns,
    world: wp.array[int],
    threads: int,
):
    """Lists the contacts of each unknown, behind its ``end``, which moves on, and those of each world that couple."""
    for i in range(wp.tid(), contact_count(contacts), threads):
        if contacts.couples[i] != 0:
            contacts.coupled[wp.atomic_add(contacts.coupled_end, world[contacts.corners[i][0]], 1)] = i
        for j in range(4):
            if contacts.weights[i][j] != 0.0:
                vertex = contacts.corners[i][j]
                u = unknown_of_corner(unknowns, vertex)
                if u >= 0:
                    if unknowns.is_free[u] != 0:
                        _list_entry(contacts, u, 4 * i + j)
                        if unknowns.of_vertex[vertex] < 0:
                            _list_entry(contacts, u + 1, 4 * i + j)


@wp.kernel
def sort_entries(
    # in and out
    contacts: Contacts,
    threads: int,
):
    """Orders the contacts of each unknown by their pair, so that sums do not depend on the order of threads.

    Those that couple come last.
    """
    for n in range(wp.tid(), contacts.listed[0], threads):
        u, own, entry = contacts.row[n], contacts.order[n] + wp.int64(0), contacts.unsorted[n] + int(0)
        first = contacts.first[u]
        rank, single = int(0), int(0)
        for m in range(first, contacts.end[u]):
            other = contacts.order[m] + wp.int64(0)
            single += wp.where(other < _COUPLES, 1, 0)
            if other < own or (other == own and contacts.unsorted[m] < entry):
                rank += 1
        contacts.entries[first + rank] = entry
        if rank == 0:
            contacts.middle[u] = first + single


# Contacts ahead

_FIRST_HELD = wp.constant(wp.int64(16 << 56))
"""Key from which contacts are held ones."""
_STIFFER = wp.constant(float(10.0))
"""How much stiffer it is held than what moves it."""


@wp.func
def _hold(
    contacts: Contacts,
    unknowns: Unknowns,
    trial: Trial,
    inverse: wp.array[wp.mat33],
    corners: wp.vec4i,
    weights: wp.vec4d,
    normal: wp.vec3d,
    short: wp.float64,
    key: wp.int64,
):
    """Adds a contact that holds a pair which is farther apart along the normal than it shall be, ``short`` if less."""
    compliance = float(0.0)
    given = ZERO
    apart = ZERO
    n = to_single(normal)
    for j in range(4):
        v = corners[j]
        u = unknowns.of_vertex[v]
        w = float(weights[j])
        apart += weights[j] * wp.dot(normal, to_double(trial.displaced[v]))
        if u < 0 and not is_solved(unknowns, v):
            given += weights[j] * wp.dot(normal, to_double(trial.displaced[v]))
        elif u >= 0:
            compliance += w * w * wp.dot(n, inverse[u] * n)
        else:
            turn = wp.cross(unknowns.arm[v], n)
            compliance += w * w * (wp.dot(n, inverse[-2 - u] * n) + wp.dot(turn, inverse[-1 - u] * turn))
    if not compliance > 0.0 or apart >= short:
        return
    slot = take_slot_int(contacts.count)
    if slot >= contacts.corners.shape[0]:
        return
    stiffness = _STIFFER / compliance
    contacts.corners[slot] = corners
    contacts.weights[slot] = wp.vec4(float(weights[0]), float(weights[1]), float(weights[2]), float(weights[3]))
    contacts.normal[slot] = n
    contacts.load[slot] = 0.0
    contacts.friction[slot] = 0.0
    contacts.gradient[slot] = (stiffness * float(given - short)) * n
    contacts.hessian[slot] = stiffness * wp.outer(n, n)
    contacts.key[slot] = key
    contacts.couples[slot] = _couples(unknowns, corners, weights)


@wp.kernel
def release_held(
    # in
    motion: Motion,
    unknowns: Unknowns,
    solution: wp.array[wp.vec3],
    active: wp.array[int],
    # in and out
    contacts: Contacts,
    threads: int,
):
    """Lets go the pairs that are held and that the solution would pull together: they are not in the way."""
    for i in range(wp.tid(), contact_count(contacts), threads):
        corners, weights, n = contacts.corners[i], contacts.weights[i], contacts.normal[i]
        if contacts.key[i] >= _FIRST_HELD and active[motion.world[corners[0]]] != 0:
            apart = wp.dot(n, contacts.gradient[i])
            for j in range(4):
                apart += weights[j] * wp.dot(contacts.hessian[i] * n, displacement(unknowns, corners[j], solution))
            if apart > 0.0:
                contacts.gradient[i] = wp.vec3()
                contacts.hessian[i] = wp.mat33()


@wp.func
def _hold_pair(
    motion: Motion,
    candidates: Candidates,
    trial: Trial,
    unknowns: Unknowns,
    inverse: wp.array[wp.mat33],
    active: wp.array[int],
    limit: wp.array[float],
    group: int,
    contacts: Contacts,
    i: int,
):
    reach = wp.float64(candidates.reach[i])
    if reach == ZERO:
        return
    queue = candidates.queue
    corners = vertices_of(queue, i)
    world = motion.world[corners[0]]
    if active[world] == 0:
        return
    share = candidates.share[i] + float(0.0)
    if share >= 1.0:
        return
    is_first = bool(False)
    for j in range(4):
        is_first = is_first or share <= limit[corners[j]]
    if not is_first:
        return
    a, b, c, d = corners_of(trial.x, corners)
    p, q, r, s = corners_of(trial.displaced, corners)
    time = wp.float64(share)
    kept = candidates.kept[i]
    _weights, distance = barrier.closest_weights_and_gap(queue.kind, a, b, c, d)
    gap = distance - kept
    e, f, g, h = a + time * p, b + time * q, c + time * r, d + time * s
    weights, then = barrier.closest_weights_and_gap(queue.kind, e, f, g, h)
    if not then > ZERO:
        return
    normal = (weights[0] * e + weights[1] * f + weights[2] * g + weights[3] * h) / then
    goal = kept + barrier.goal_gap(gap, reach)
    now = wp.dot(normal, weights[0] * a + weights[1] * b + weights[2] * c + weights[3] * d)
    pair = queue.pairs[i]
    key = _key(group, queue.kind, pair[0], pair[1])
    _hold(contacts, unknowns, trial, inverse, corners, weights, normal, goal - now, key)


@wp.kernel
def hold_pairs(
    # in
    motion: Motion,
    first: Candidates,
    second: Candidates,
    trial: Trial,
    unknowns: Unknowns,
    inverse: wp.array[wp.mat33],
    active: wp.array[int],
    limit: wp.array[float],
    group: int,
    # in and out
    contacts: Contacts,
    threads: int,
):
    """Adds contacts that hold candidates which would meet on the displacements, in active worlds.

    Only those that are the first, by ``limit``, for one of their vertices: what would come later may not come at all.
    """
    for i in range(wp.tid(), wp.max(pair_count(first.queue), pair_count(second.queue)), threads):
        number = int(0)
        while number < 2:
            of = first
            if number == 1:
                of = second
            if has_pair(of.queue, i):
                _hold_pair(motion, of, trial, unknowns, inverse, active, limit, group, contacts, i)
            number += 1


@wp.kernel
def hold_at_planes(
    # in
    motion: Motion,
    planes: MovingPlanes,
    plane_share: wp.array[float],
    settings: BarrierSettings,
    trial: Trial,
    unknowns: Unknowns,
    inverse: wp.array[wp.mat33],
    active: wp.array[int],
    group: int,
    # in and out
    contacts: Contacts,
):
    """Adds contacts that hold particles which would enter infinite planes, as :func:`hold_pairs`."""
    vertex = wp.tid()
    world = motion.world[vertex]
    if inverse_mass_of(motion, vertex) == 0.0 or active[world] == 0:
        return
    for place in range(planes.of_worlds.shape[1]):
        i = planes.of_worlds[world, place]
        if i < 0:
            return
        kept, _level, reach = _plane_gap(motion, planes, settings, i, vertex)
        if reach == ZERO:
            continue
        gap, _error = signed_distance(_plane_at(planes, i, plane_share[world]), trial.x[vertex])
        end = _plane_at(planes, i, 1.0)
        left, _error_after = signed_distance(end, trial.x[vertex] + trial.displaced[vertex])
        now, _error_now = signed_distance(end, trial.x[vertex])
        gap -= kept
        if left - kept < barrier.least_gap(gap, reach):
            goal = kept + barrier.goal_gap(gap, reach)
            normal = wp.vec3d(end[0], end[1], end[2])
            weights = wp.vec4d(ONE, ZERO, ZERO, ZERO)
            key = _key(group, 7, vertex, i)
            _hold(contacts, unknowns, trial, inverse, wp.vec4i(vertex), weights, normal, goal - now, key)


# Bounds


@wp.func
def _bound(
    motion: Motion,
    candidates: Candidates,
    trial: Trial,
    progress: Progress,
    active: wp.array[int],
    limit: wp.array[float],
    i: int,
):
    candidates.share[i] = 1.0
    if candidates.reach[i] == 0.0:
        return
    queue = candidates.queue
    corners = vertices_of(queue, i)
    world = motion.world[corners[0]]
    if active[world] == 0:
        return
    a, b, c, d = corners_of(trial.x, corners)
    scale = progress.scale[world]
    p = to_double(moved(trial, scale, corners[0])) - a
    q = to_double(moved(trial, scale, corners[1])) - b
    r = to_double(moved(trial, scale, corners[2])) - c
    s = to_double(moved(trial, scale, corners[3])) - d
    # far apart for their ways: no need to find the closest points
    way = wp.length(p - r) + wp.length(q - r) + wp.length(s - r)
    kept = candidates.kept[i]
    reach = wp.float64(candidates.reach[i])
    apart = barrier.distance_of_boxes(queue.kind, a, b, c, d) - kept
    bends = _bends(trial, scale, corners)
    if way + bends[0] <= apart - barrier.least_gap(apart, reach):
        return
    _weights, distance = barrier.closest_weights_and_gap(queue.kind, a, b, c, d)
    least = barrier.least_gap(distance - kept, reach)
    if way + bends[0] <= distance - kept - least:
        return
    # what other pairs allow: more than that changes nothing
    most = wp.max(wp.max(limit[corners[0]], limit[corners[1]]), wp.max(limit[corners[2]], limit[corners[3]]))
    share = float(barrier.safe_share(queue.kind, a, b, c, d, p, q, r, s, kept + least, most, bends))
    candidates.share[i] = share
    if share < 1.0:
        wp.atomic_min(progress.bound, world, share)
        for j in range(4):
            wp.atomic_min(limit, corners[j], share)
            if trial.holder[corners[j]] != corners[j]:
                wp.atomic_min(limit, trial.holder[corners[j]], share)


@wp.kernel
def bound_by_pairs(
    # in
    motion: Motion,
    first: Candidates,
    second: Candidates,
    trial: Trial,
    active: wp.array[int],
    # in and out
    progress: Progress,
    limit: wp.array[float],
    threads: int,
):
    """Finds the share of displacements up to which no two elements meet: by vertex, and for all of a world."""
    for i in range(wp.tid(), wp.max(pair_count(first.queue), pair_count(second.queue)), threads):
        number = int(0)
        while number < 2:
            of = first
            if number == 1:
                of = second
            if has_pair(of.queue, i):
                _bound(motion, of, trial, progress, active, limit, i)
            number += 1


@wp.kernel
def bound_by_planes(
    # in
    motion: Motion,
    planes: MovingPlanes,
    plane_share: wp.array[float],
    settings: BarrierSettings,
    trial: Trial,
    active: wp.array[int],
    # in and out
    progress: Progress,
    limit: wp.array[float],
):
    """Finds the share of displacements up to which no particle meets an infinite plane, as :func:`bound_by_pairs`."""
    vertex = wp.tid()
    world = motion.world[vertex]
    if inverse_mass_of(motion, vertex) == 0.0 or active[world] == 0:
        return
    scale, now = progress.scale[world], plane_share[world]
    for place in range(planes.of_worlds.shape[1]):
        i = planes.of_worlds[world, place]
        if i < 0:
            return
        kept, _level, reach = _plane_gap(motion, planes, settings, i, vertex)
        if reach == ZERO:
            continue
        before, _error = signed_distance(_plane_at(planes, i, now), trial.x[vertex])
        then = now + (1.0 - now) * scale
        after, _error_after = signed_distance(_plane_at(planes, i, then), moved(trial, scale, vertex))
        gap, left = before - kept, after - kept
        least = barrier.least_gap(gap, reach)
        taken = scale * trial.share[trial.holder[vertex]]
        bend = wp.float64(taken * trial.bend[vertex])
        flat = wp.float64(taken) * bend
        rate, low = gap - left + bend, gap - least
        square = rate * rate - wp.float64(4.0) * flat * low
        if low - rate + flat < ZERO or (square > ZERO and rate > ZERO and rate < wp.float64(2.0) * flat):
            share = float(wp.float64(2.0) * low / (rate + wp.sqrt(wp.max(square, ZERO))))
            wp.atomic_min(progress.bound, world, share)
            wp.atomic_min(limit, trial.holder[vertex], share)


# Energies


@wp.func
def add_energy(energy: wp.array[wp.int64], world: int, value: wp.float64, units: wp.array[wp.float64]):
    """Adds an energy [J] to that of a world, in units, so that the sum does not depend on the order of threads."""
    scaled = wp.clamp(units[world] * value, -_UNITS_LIMIT, _UNITS_LIMIT)
    scaled = wp.where(wp.isfinite(value), scaled, _UNITS_LIMIT)
    wp.atomic_add(energy, world, wp.int64(wp.rint(scaled)))


@wp.func
def _pair_energy(
    motion: Motion,
    candidates: Candidates,
    settings: BarrierSettings,
    trial: Trial,
    progress: Progress,
    displaced: bool,
    energy: wp.array[wp.int64],
    i: int,
):
    reach = wp.float64(candidates.reach[i])
    if reach == ZERO:
        return
    queue = candidates.queue
    corners = vertices_of(queue, i)
    world = motion.world[corners[0]]
    if progress.active[world] == 0 or (displaced and progress.searches[world] == 0):
        return
    a, b, c, d = corners_of(trial.moved, corners)
    if barrier.distance_of_boxes(queue.kind, a, b, c, d) >= candidates.level[i] + reach:
        return
    _weights, distance = barrier.closest_weights_and_gap(queue.kind, a, b, c, d)
    gap = distance - candidates.level[i]
    if gap < reach:
        value = wp.float64(1.0e30)
        if gap > ZERO:
            stiffness = _stiffness(motion, settings, corners, queue.kind == EDGE_EDGE)
            value = stiffness * barrier.barrier_energy(gap, reach)
        add_energy(energy, world, value, settings.units)


@wp.kernel
def add_pair_energies(
    # in
    motion: Motion,
    first: Candidates,
    second: Candidates,
    settings: BarrierSettings,
    trial: Trial,
    progress: Progress,
    displaced: bool,
    # in and out
    energy: wp.array[wp.int64],
    threads: int,
):
    """Adds the energies of barriers between elements, at positions or at the displaced ones."""
    for i in range(wp.tid(), wp.max(pair_count(first.queue), pair_count(second.queue)), threads):
        number = int(0)
        while number < 2:
            of = first
            if number == 1:
                of = second
            if has_pair(of.queue, i):
                _pair_energy(motion, of, settings, trial, progress, displaced, energy, i)
            number += 1


@wp.kernel
def add_friction_energies(
    # in
    motion: Motion,
    contacts: Contacts,
    settings: BarrierSettings,
    trial: Trial,
    progress: Progress,
    displaced: bool,
    # in and out
    energy: wp.array[wp.int64],
    threads: int,
):
    """Adds the work of friction, under the loads and along the planes of the contacts."""
    for i in range(wp.tid(), contact_count(contacts), threads):
        corners, weights = contacts.corners[i], contacts.weights[i]
        world = motion.world[corners[0]]
        limit = contacts.friction[i] * contacts.load[i]
        if limit > 0.0 and not (displaced and progress.searches[world] == 0):
            slid, normal = wp.vec3d(), to_double(contacts.normal[i])
            for j in range(4):
                v = corners[j]
                slid += wp.float64(weights[j]) * (to_double(trial.moved[v]) - to_double(motion.x0[v]))
            slid -= wp.dot(slid, normal) * normal
            value = wp.float64(limit) * barrier.friction_energy(wp.length(slid), settings.smoothing)
            add_energy(energy, world, value, settings.units)


@wp.kernel
def add_plane_energies(
    # in
    motion: Motion,
    planes: MovingPlanes,
    plane_share: wp.array[float],
    settings: BarrierSettings,
    trial: Trial,
    progress: Progress,
    displaced: bool,
    # in and out
    energy: wp.array[wp.int64],
):
    """Adds the energies of barriers at infinite planes."""
    vertex = wp.tid()
    world = motion.world[vertex]
    if inverse_mass_of(motion, vertex) == 0.0 or progress.active[world] == 0:
        return
    if displaced and progress.searches[world] == 0:
        return
    scale, now = wp.where(displaced, progress.scale[world], 0.0), plane_share[world]
    for place in range(planes.of_worlds.shape[1]):
        i = planes.of_worlds[world, place]
        if i < 0:
            return
        _kept, level, reach = _plane_gap(motion, planes, settings, i, vertex)
        plane = _plane_at(planes, i, now + (1.0 - now) * scale)
        distance, _error = signed_distance(plane, trial.moved[vertex])
        gap = distance - level
        if gap < reach:
            value = wp.float64(1.0e30)
            if gap > ZERO:
                value = _stiffness_at_plane(motion, settings, vertex) * barrier.barrier_energy(gap, reach)
            add_energy(energy, world, value, settings.units)
