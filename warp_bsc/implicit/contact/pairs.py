"""Pairs of elements that may come near each other in a step, and the barriers between them and at infinite planes."""

import warp as wp

from ...detection.narrow.rules.approach import KEPT, distances_of_pair
from ...kernels.pipeline.queues import take_slot_int, take_slot_of
from ...kernels.polynomials import EDGE_EDGE, VERTEX_FACE
from ...response.contacts.collect import is_stopped_by_plane
from ...response.contacts.queue import PairQueue, has_pair, pair_count, vertices_of
from ...response.contacts.rules import ContactClass, crossed_at_start, inverse_mass_of, owner_of
from ...response.state.planes import MovingPlanes, is_filtered_by_plane, signed_distance
from ...response.state.structs import Motion, Step, body_of
from ...response.state.vectors import HALF, ONE, ZERO, corners_of, to_double
from . import barrier, distance_bounds
from .system import Progress, key_of_pair
from .team import lower_int_to, on_gpu

wp.set_module_options({"enable_backward": False})

_WITHIN = wp.constant(wp.float64(1.0 - 2.0**-19))
"""Share of its distance at the start that only pairs keep which start within their minimum distance."""
_LEAST_GAP = wp.constant(wp.float64(1e-3))
"""Least gap at the start for a barrier, as a share of its reach: forces stay finite where elements nearly touch."""
_LEAST_REACH = wp.constant(wp.float64(0.1))
"""It is that share of a tenth of the reach at least, however short a step cuts that: positions are rounded."""
_LAYERS = wp.constant(wp.float64(64.0 * barrier.CURVATURE_AT_HALF / barrier.FORCE_AT_FLOOR))
"""For so many layers, 64, that it carries at :data:`.barrier.FLOOR`, the stiffness of a barrier by that for one."""
PARALLEL = wp.constant(wp.float64(1e-3))
"""Square of the sine of the angle below which edges are nearly parallel."""
FAR = wp.constant(2.0)
"""In place of a share of the last displacements: no part of them brings a pair within its reach."""
FAR_TOGETHER = wp.constant(3.0)
"""The same, as long as its vertices take the same part: displacements that hardly differ do not bring it nearer."""
_FARTHER = wp.constant(2.5)
"""What comes within its reach if two vertices go so many times the way of the step before, together, is not far."""


@wp.struct
class Candidates:
    """Pairs of elements that may come near each other in the step, but for those that are excluded.

    Those of a world follow each other. What would come within its reach if vertices went a little farther than in the
    step before comes first there, the others from the end backwards, each in any order: threads that run together then
    mostly do the same, and where vertices do not go that far, only the first ones are looked at.
    """

    start: wp.array[int]  # first of each world
    room: wp.array[int]  # room for those of each world
    near: wp.array[int]  # number of the first ones of each world
    far: wp.array[int]  # number of the others
    used: wp.array[int]  # room that worlds have taken, shape [1]
    # number of pairs of edges of each world that the last displacements may bring within their reach, or that are; -1
    # if they are not known
    listed_edges: wp.array[int]
    listed_others: wp.array[int]  # number of the other ones, or 0
    # those of each world, each twice, and 1 more of those that displacements may not bring together yet, see
    # bounds.list_pair: edges from the start, the others from the end backwards
    list: wp.array[int]
    corners: wp.array[wp.vec4i]  # vertices
    key: wp.array[wp.int64]  # number of the pair, see system.key_of_pair
    # how far the vertices of a pair can go together before it is within its reach, negative if it is [m]
    apart: wp.array[float]
    kept: wp.array[wp.float64]  # distance that each pair keeps in any case [m]; without elements where all is 0
    level: wp.array[wp.float64]  # distance at which its barrier is infinite [m], no more than that
    reach: wp.array[float]  # gap beyond the level from which its barrier pushes [m]
    stiffness: wp.array[wp.float64]  # of its barrier, by what that pushes apart; negative of edges of faces [N/m]
    floor: wp.array[float]  # gap below which it hardly comes nearer in the step [m], see barrier.floor_gap
    share: wp.array[float]  # share of the last displacements before it would meet, FAR or FAR_TOGETHER
    # distance where the Newton step begins, or less, of what was not FAR in the one before [m]
    now: wp.array[float]
    # direction from the second closest point to the first where they were found last, 0 before, see
    # distance_bounds.direction_of_bits
    normal: wp.array[int]


@wp.struct
class BarrierSettings:
    """What barriers and friction depend on."""

    dt: wp.float64  # length of the step [s]
    reach: wp.array[float]  # of each vertex: gap from which it pushes [m], infinite for shapes
    # of each vertex of a body: gap from which it pushes other shapes [m]; infinite for others
    reach_of_bodies: wp.array[float]
    recovery: wp.float64  # by how much more than its gap at the start a pair gets a gap by its barrier [m]
    elasticity: wp.array[float]  # of each vertex: stiffness of the solid around it against a push [N/m]
    is_of_face: wp.array[int]  # 1 of each vertex of a face
    load: wp.array[float]  # of each vertex: about the force of its elements, and more [N]
    smoothing: wp.float64  # length below which friction is smoothed [m]
    units: wp.array[wp.float64]  # units of energy in a joule, in each world


NO_FACE = wp.constant(2**31 - 1)


@wp.struct
class Trial:
    """Positions, and displacements from them, of which each world takes a share."""

    x: wp.array[wp.vec3]  # positions of vertices [m]
    displaced: wp.array[wp.vec3]  # displacements [m]
    share: wp.array[float]  # share of its displacement that a vertex takes of what its world takes
    cut: wp.array[int]  # 1 of each holder whose share the last truncation made smaller
    holder: wp.array[int]  # vertex whose share each vertex takes: itself, or the first of its body
    # how far arcs of vertices leave their displacements at most, by t (1 - t) at a share t of them [m]
    bend: wp.array[float]
    exact: wp.array[wp.vec3d]  # positions without rounding, which for friction is a large part of the way [m]
    moved: wp.array[wp.vec3d]  # the same after displacements; where a Newton step begins, before them
    # positions after the Newton steps of the step: the straight way to the first is free, shape [8, particles]; the
    # last are those after the last of more
    path: wp.array2d[wp.vec3]
    goal: wp.array[wp.vec3]  # where inertia leads [m]
    lower: wp.array[wp.vec3]  # of boxes within which the candidates are all pairs that may come near each other [m]
    upper: wp.array[wp.vec3]  # of these boxes [m]
    margin: wp.array[float]  # by how much these are larger than ways [m]
    limit: wp.array[float]  # share of its displacement before each vertex meets something
    origin: wp.array[wp.vec3]  # where vertices started the step, those that touched a shape a little beside it [m]
    touched: wp.array[int]  # first face of a shape that each particle touches at the start; :data:`NO_FACE` for none
    any_touches: wp.array[int]  # 1 if one does, shape [1]


@wp.func
def moved(trial: Trial, scale: float, vertex: int) -> wp.vec3d:
    """Returns the position of a vertex after a share of its displacement, not on the arc of a body."""
    share = wp.float64(scale * trial.share[trial.holder[vertex]])
    return trial.exact[vertex] + share * to_double(trial.displaced[vertex])


@wp.func
def reach_of(settings: BarrierSettings, corners: wp.vec4i) -> float:
    """Returns the gap from which a pair pushes [m]."""
    reach, of_bodies = float(wp.inf), float(wp.inf)
    for j in range(4):
        reach = wp.min(reach, settings.reach[corners[j]])
        of_bodies = wp.min(of_bodies, settings.reach_of_bodies[corners[j]])
    return wp.where(reach < wp.inf, reach, of_bodies)


@wp.func
def _compliance(motion: Motion, settings: BarrierSettings, layers: wp.float64, vertex: int) -> wp.float64:
    """Returns how far a force of 1 N moves a vertex in the step [m/N], by its mass and the solid around it.

    Its mass is that of so many layers.
    """
    inverse = wp.float64(inverse_mass_of(motion, vertex))
    return inverse / (layers / (settings.dt * settings.dt) + inverse * wp.float64(settings.elasticity[vertex]))


@wp.func
def _layers(fall: float, reach: wp.float64) -> wp.float64:
    """Returns how many layers a barrier is made for: more than 1 where gravity alone would press one far into it."""
    return wp.max(ONE, _LAYERS * wp.float64(fall) / reach)


@wp.func
def stiffness_by_mass(
    motion: Motion, settings: BarrierSettings, fall: float, corners: wp.vec4i, is_edges: bool, reach: wp.float64
) -> wp.float64:
    """Returns the stiffness of a barrier as :class:`Candidates` has it, given ``fall`` of :class:`.system.Progress`."""
    layers = _layers(fall, reach)
    first = _compliance(motion, settings, layers, corners[0])
    second = _compliance(motion, settings, layers, corners[2]) + _compliance(motion, settings, layers, corners[3])
    if is_edges:
        first = HALF * (first + _compliance(motion, settings, layers, corners[1]))
        second = HALF * second
    else:
        second = (second + _compliance(motion, settings, layers, corners[1])) / wp.float64(3.0)
    of_faces = int(1)
    for j in range(4):
        of_faces = of_faces & settings.is_of_face[corners[j]]
    stiffness = ONE / ((first + second) * wp.float64(barrier.CURVATURE_AT_HALF))
    return wp.where(is_edges and of_faces != 0, -stiffness, stiffness)


@wp.func
def carrying_stiffness(by_mass: wp.float64, settings: BarrierSettings, corners: wp.vec4i, reach: wp.float64):
    """Returns the stiffness of a barrier that carries what presses the pair together [N/m].

    It is more than that by mass where elements, or many layers, push harder than that carries at the gap below which a
    pair hardly comes nearer: what is taut, or under a pile, would otherwise be stuck there.
    """
    load = float(0.0)
    for j in range(4):
        load = wp.max(load, settings.load[corners[j]])
    needed = wp.float64(load) / (reach * wp.float64(barrier.FORCE_AT_FLOOR))
    return wp.max(wp.abs(by_mass), needed)


@wp.func
def share_of_parallel(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d) -> wp.float64:
    """Returns the share of its stiffness that a barrier of two edges of faces has: less where they are nearly parallel.

    Their closest points jump from end to end then; their ends are near these faces, which push as well.
    """
    u, v = b - a, d - c
    scaled = wp.length_sq(wp.cross(u, v)) / (PARALLEL * wp.length_sq(u) * wp.length_sq(v))
    if scaled < ONE:
        return scaled * (wp.float64(2.0) - scaled)
    return ONE


@wp.func
def stiffness_of_pair(
    by_mass: wp.float64, settings: BarrierSettings, trial: Trial, corners: wp.vec4i, reach: wp.float64
) -> wp.float64:
    """Returns the stiffness of a barrier [N/m]: at half of its reach, its curvature is that of what it pushes apart.

    Edges are parallel or not where the Newton step begins.
    """
    stiffness = carrying_stiffness(by_mass, settings, corners, reach)
    if by_mass < ZERO:
        a, b, c, d = corners_of(trial.x, corners)
        stiffness *= share_of_parallel(a, b, c, d)
    return stiffness


@wp.func
def stiffness_at_plane(
    motion: Motion, settings: BarrierSettings, fall: float, vertex: int, reach: wp.float64
) -> wp.float64:
    """Returns the stiffness of a barrier between a vertex and a plane [N/m], as :func:`stiffness_of_pair`."""
    needed = wp.float64(settings.load[vertex]) / (reach * wp.float64(barrier.FORCE_AT_FLOOR))
    compliance = _compliance(motion, settings, _layers(fall, reach), vertex)
    return wp.max(ONE / (compliance * wp.float64(barrier.CURVATURE_AT_HALF)), needed)


@wp.func
def barrier_of(settings: BarrierSettings, start: wp.float64, kept: wp.float64, reach: float):
    """Returns the level and the reach of the barrier of a pair, by its distance at the start and that to keep.

    The reach of what starts within it ends a little above its gap: a barrier otherwise throws apart, at up to its reach
    a step, what a program puts there or what fell there in the step before. That of a pair within its minimum distance
    is as steep as in a press, so that the force on what is gripped there is one that floats can balance.

    The level is below that to keep where the gap is tiny, so that the force is finite. It is so much less as the reach
    is shorter: the barrier would else carry little, and what is pressed together in short steps come ever nearer.
    """
    whole = wp.float64(reach)
    least = _LEAST_GAP * wp.clamp(settings.recovery, _LEAST_REACH * whole, whole)
    if kept > ZERO and kept >= _WITHIN * start:
        least = barrier.FLOOR * whole
    level = wp.min(kept, start - least)
    return level, wp.min(whole, start - level + settings.recovery)


@wp.func
def kept_distance(candidates: Candidates, i: int) -> wp.float64:
    """Returns the distance that a pair keeps in any case [m]."""
    kept = ZERO
    if candidates.kept:
        kept = candidates.kept[i] + ZERO
    return kept


@wp.func
def distance_bound(candidates: Candidates, i: int, kind: int, a: wp.vec3, b: wp.vec3, c: wp.vec3) -> float:
    """Returns a lower bound of the distance of a pair: that of boxes, or along where closest points were found last.

    The second is as good as the distance until the elements turn, and much faster to find. Points are seen from d.
    """
    along = distance_bounds.distance_along(kind, distance_bounds.direction_of_bits(candidates.normal[i]), a, b, c)
    return wp.max(along, distance_bounds.distance_of_boxes(kind, a, b, c)) - distance_bounds.rounding_of(a, b, c)


@wp.func
def _place_of(candidates: Candidates, world: int, k: int, first_count: int) -> int:
    """Returns the place of a number in the room of a world: so many stand first, the others from the end backwards."""
    start, place = candidates.start[world], k
    if k >= first_count:
        place = candidates.room[world] - 1 - (k - first_count)
    return start + place


@wp.func
def candidate(candidates: Candidates, world: int, k: int) -> int:
    """Returns a candidate of a world by its number there."""
    return _place_of(candidates, world, k, candidates.near[world])


@wp.func
def add_to_list(candidates: Candidates, world: int, kind: int, i: int, is_new: bool):
    """Lists a pair of a world: edges first, others from the end backwards."""
    first = candidates.start[world] + int(0)
    if kind == EDGE_EDGE:
        first += take_slot_of(candidates.listed_edges, world)
    else:
        first += candidates.room[world] - 1 - take_slot_of(candidates.listed_others, world)
    candidates.list[first] = 2 * i + int(is_new)


@wp.func
def clear_list(candidates: Candidates, world: int):
    """Empties the list of a world."""
    candidates.listed_edges[world] = 0
    candidates.listed_others[world] = 0


@wp.func
def listed_count(candidates: Candidates, world: int) -> int:
    """Returns the length of the list of a world, -1 if it is not known."""
    return candidates.listed_edges[world] + candidates.listed_others[world]


@wp.func
def listed(candidates: Candidates, world: int, k: int) -> int:
    """Returns an entry of the list of a world: threads that run together mostly have pairs of one kind."""
    return candidates.list[_place_of(candidates, world, k, candidates.listed_edges[world])] + int(0)


@wp.func
def stays_far(apart: float, progress: Progress, world: int) -> bool:
    """Returns whether a pair is beyond its reach, whichever of the vertices of its world go the longest ways."""
    return apart >= _longest_ways(progress, world)


@wp.func
def far_ones_stay(progress: Progress, world: int) -> bool:
    """Returns whether all candidates stay beyond their reach that were put to those that are far."""
    return _far(progress, world) >= _longest_ways(progress, world)


@wp.func
def _longest_ways(progress: Progress, world: int) -> float:
    way = progress.way[world]
    return way + wp.max(way, progress.given_way[world])


@wp.func
def _far(progress: Progress, world: int) -> float:
    """Returns how far vertices can go together before a pair is within its reach that counts as far."""
    return _FARTHER * progress.way_before[world]


@wp.func
def _prepare(
    step: Step,
    queue: PairQueue,
    settings: BarrierSettings,
    crossings: wp.array[int],
    progress: Progress,
    candidates: Candidates,
    trial: Trial,
    i: int,
):
    motion = step.motion
    corners = vertices_of(queue, i)
    if owner_of(motion, corners) != ContactClass.OURS:
        return
    a, b, c, d = corners_of(trial.origin, corners)
    if not wp.isfinite(a + b + c + d):
        return
    start, kept, whole = ZERO, ZERO, reach_of(settings, corners)
    if motion.distances.radius:
        start, kept = distances_of_pair(motion.distances, queue.kind, corners, a, b, c, d)
    else:
        u, v, w = distance_bounds.seen_from_last(trial.origin, corners)
        start = wp.float64(
            distance_bounds.distance_of_boxes(queue.kind, u, v, w) - distance_bounds.rounding_of(u, v, w)
        )
        if not start >= wp.float64(whole):  # farther away, all is the same
            start = barrier.least_distance(queue.kind, a, b, c, d)
    if not start > ZERO:
        if start == ZERO and queue.kind == VERTEX_FACE and settings.reach[corners[1]] == wp.inf:
            if motion.inverse_mass[corners[0]] > 0.0:
                lower_int_to(trial.touched, corners[0], queue.pairs[i][1])
                trial.any_touches[0] = 1
        return
    if crossings[motion.world[corners[0]]] > 0:
        if crossed_at_start(step, queue.kind, queue.pairs[i]):
            return
    level, reach = barrier_of(settings, start, kept, whole)
    pair = queue.pairs[i]
    slot = int(0)
    world, apart = motion.world[corners[0]], float((start - kept - reach) * wp.float64(distance_bounds.ROUNDED_DOWN))
    is_far = stays_far(apart, progress, world)
    if apart < _far(progress, world) or not is_far:
        slot = candidates.start[world] + take_slot_of(candidates.near, world)
    else:
        slot = candidates.start[world] + candidates.room[world] - 1 - take_slot_of(candidates.far, world)
    candidates.corners[slot] = corners
    candidates.key[slot] = key_of_pair(0, queue.kind, pair[0], pair[1])
    candidates.apart[slot] = apart
    if candidates.kept:
        candidates.kept[slot] = kept
    candidates.level[slot] = level
    candidates.reach[slot] = float(reach)
    is_edges, fall = queue.kind == EDGE_EDGE, progress.fall[world]
    candidates.stiffness[slot] = stiffness_by_mass(motion, settings, fall, corners, is_edges, wp.float64(float(reach)))
    candidates.floor[slot] = float(barrier.floor_gap(start - kept, reach))
    candidates.share[slot] = wp.where(is_far, FAR, 1.0)
    candidates.normal[slot] = 0


@wp.kernel
def count_candidates(
    # in
    world: wp.array[int],
    first: PairQueue,
    second: PairQueue,
    # in and out
    candidates: Candidates,
    threads: int,
):
    """Counts the pairs of each world in two queues."""
    for i in range(wp.tid(), wp.max(pair_count(first), pair_count(second)), threads):
        if has_pair(first, i):
            take_slot_of(candidates.room, world[vertices_of(first, i)[0]])
        if has_pair(second, i):
            take_slot_of(candidates.room, world[vertices_of(second, i)[0]])


@wp.kernel
def place_candidates(candidates: Candidates):
    """Gives each world room for its pairs."""
    w = wp.tid()
    candidates.start[w] = wp.atomic_add(candidates.used, 0, candidates.room[w])


@wp.kernel
def prepare_candidates(
    # in
    step: Step,
    settings: BarrierSettings,
    crossings: wp.array[int],
    progress: Progress,
    first: PairQueue,
    second: PairQueue,
    # in and out
    candidates: Candidates,
    trial: Trial,
    threads: int,
):
    """Adds the pairs of two queues to the candidates, but for those that touch or cross at the start of the step."""
    begin, end, stride = wp.tid(), wp.max(pair_count(first), pair_count(second)), threads + int(0)
    if on_gpu() == 0:  # pairs of a world follow each other: a core has all of most worlds
        piece = (end + threads - 1) // threads
        begin, stride = piece * take_slot_int(candidates.used), 1
        end = wp.min(end, begin + piece)
    for i in range(begin, end, stride):
        number = int(0)
        while number < 2:
            of = first
            if number == 1:
                of = second
            if has_pair(of, i):
                _prepare(step, of, settings, crossings, progress, candidates, trial, i)
            number += 1


@wp.func
def gap_at_plane(motion: Motion, planes: MovingPlanes, settings: BarrierSettings, i: int, vertex: int, x0: wp.vec3d):
    """Returns the distance that a vertex keeps from a plane, the level and the reach of its barrier, and its floor.

    The reach is 0 if it is excluded. The vertex starts the step at ``x0``.
    """
    if is_filtered_by_plane(motion, planes, i, vertex) or not is_stopped_by_plane(motion, planes, i, vertex):
        return ZERO, ZERO, ZERO, ZERO
    start, error = signed_distance(planes.start[i], x0)
    if not start >= -error:
        return ZERO, ZERO, ZERO, ZERO
    kept = wp.min(start - error, ZERO)
    if motion.distances.radius and start > error:
        kept = wp.min(motion.distances.radius[vertex] + motion.distances.of_planes[i], KEPT * (start - error))
    whole = wp.where(body_of(motion, vertex) < 0, settings.reach[vertex], settings.reach_of_bodies[vertex])
    level, reach = barrier_of(settings, start, kept, whole)
    return kept, level, reach, barrier.floor_gap(start - kept, reach)


@wp.func
def plane_at(planes: MovingPlanes, i: int, share: float) -> wp.vec4d:
    """Returns a plane after a share of its way in the step."""
    t = wp.float64(share)
    plane = (ONE - t) * planes.start[i] + t * planes.end[i]
    return plane / wp.length(wp.vec3d(plane[0], plane[1], plane[2]))
