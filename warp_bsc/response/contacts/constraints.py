"""Constraints: contacts as conditions on the ends of paths, see :mod:`.solve.sweeps`, which solves them."""

import warp as wp

from ...detection.narrow.rules.approach import distances_of_pair
from ...kernels.arcs import Arcs, on_arc_of, turns
from ...kernels.pipeline.queues import take_slot_int
from ...kernels.polynomials import EDGE_EDGE, VERTEX_FACE, VERTEX_VERTEX
from ..state.planes import MovingPlanes
from ..state.poses import turn_between
from ..state.structs import ContactKind, Materials, Motion, Pace, Step, body_of, can_move
from ..state.vectors import ONE, ZERO, corners_of, relative, to_double
from ..tuning import EARLIEST, MAX_SAGITTA, RECOVERY, REST, ROUNDING, SLOW_PATH, SMALL_DISTANCE
from .rules import are_on_body, inverse_mass_of

TOUCH = wp.constant(wp.float64(1e-100))
"""Position multiplier of contacts that are divided [kg m]: it moves nothing, but lets them change velocities. It is the
smallest push rather than a flag, because velocities and angular momentum treat these contacts as those that pushed."""
NEVER_VIOLATED = wp.constant(wp.float64(-1e30))
"""Separation of a constraint that no motion violates, so that it never acts [m]."""
NEVER_SWEPT = wp.constant(-2)
"""Last sweep of a constraint that was never active: no sweep comes right after it."""


@wp.struct
class Constraint:
    """One of the :class:`.Constraints`, as :func:`add_constraint` takes it."""

    vertices: wp.vec4i
    weights: wp.vec4d
    normal: wp.vec3d
    separation: wp.float64
    min_distance: wp.float64
    friction: float
    kind: int
    plane: int
    toi: wp.float64
    pace: int
    multiplier: wp.vec3d


@wp.func
def kind_of_contact(kind: int) -> int:
    """Returns the ContactKind of a contact of a kind of pair: points count as vertices and faces."""
    return wp.where(kind == EDGE_EDGE, int(ContactKind.EDGE_EDGE), int(ContactKind.VERTEX_FACE))


@wp.func
def kind_of_pair(kind: int) -> int:
    """Returns EDGE_EDGE for contacts and proximities of two edges, given a ContactKind, else VERTEX_FACE."""
    of_edges = kind == ContactKind.EDGE_EDGE or kind == ContactKind.EDGE_EDGE_PROXIMITY
    return wp.where(of_edges, EDGE_EDGE, VERTEX_FACE)


@wp.func
def longest_path(motion: Motion, corners: wp.vec4i) -> wp.float64:
    """Returns the length of the longest predicted path of four vertices [m]."""
    path = ZERO
    for j in range(4):
        predicted = to_double(motion.x1[corners[j]]) - to_double(motion.x0[corners[j]])
        path = wp.max(path, wp.length(predicted))
    return path


@wp.func
def pace_of(motion: Motion, corners: wp.vec4i, kind: int) -> int:
    """Returns SLOW if the paths of two elements are short for their shortest side, else FAST; see :class:`.Pace`.

    The side of two points is their distance.
    """
    a, b, c, d = corners_of(motion.x0, corners)
    size = ZERO
    if kind == VERTEX_VERTEX:
        size = wp.length(a - b)
    elif kind == EDGE_EDGE:
        size = wp.min(wp.length(c - d), wp.length(a - b))
    else:
        size = wp.min(wp.length(c - d), wp.length(b - c))
    return wp.where(longest_path(motion, corners) <= SLOW_PATH * size, int(Pace.SLOW), int(Pace.FAST))


@wp.func
def distances_at_start(motion: Motion, corners: wp.vec4i, kind: int):
    """Returns the distance of a pair at the start, and the one that it must keep; see :func:`distances_of_pair` [m]."""
    a, b, c, d = corners_of(motion.x0, corners)
    return distances_of_pair(motion.distances, kind, corners, a, b, c, d)


@wp.func
def min_distance_of(step: Step, i: int) -> wp.float64:
    """Returns the part of the separation of a constraint that its pair must keep [m]; 0 without minimum distances."""
    if step.constraints.min_distance:
        return step.constraints.min_distance[i]
    return ZERO


@wp.func
def is_pushing(
    motion: Motion, corners: wp.vec4i, weights: wp.vec4d, normal: wp.vec3d, min_distance: wp.float64
) -> bool:
    """Returns whether two elements in contact would meet even if all that can be moved stood still.

    Dividing planes, which let vertices stand still, are then no way out.
    """
    end = wp.vec3d()
    moves = bool(False)
    for j in range(4):
        vertex = corners[j]
        x = motion.x0[vertex]
        if inverse_mass_of(motion, vertex) == 0.0:
            moves = moves or wp.length_sq(motion.x1[vertex] - x) > 0.0
            x = motion.x1[vertex]
        end += weights[j] * to_double(x)
    return moves and wp.dot(normal, end) <= min_distance


@wp.func
def _may_rest(motion: Motion, corners: wp.vec4i) -> bool:
    """Returns whether one of two elements is of a body, or cannot be moved, or is a plane, so that the other may rest.

    Cloth on cloth is in motion as long as one of the two is.
    """
    is_held = inverse_mass_of(motion, corners[0]) == 0.0 or inverse_mass_of(motion, corners[3]) == 0.0
    return is_held or corners[0] == corners[3] or are_on_body(motion, corners)


@wp.func
def rounding_at(step: Step, x: wp.vec3) -> wp.float64:
    """Returns the least distance of what rests at a position [m], more than 0: rounding closes smaller ones."""
    return ROUNDING * wp.max(wp.float64(wp.max(wp.abs(x))), step.separation)


@wp.func
def feasible(step: Step, corners: wp.vec4i, target: wp.float64, start: wp.float64) -> wp.float64:
    """Returns the separation of slow elements [m]: hardly more than at the start, as standing still should nearly do.

    Fast elements get ``target``, which is the most; ``start`` is the distance at the start. Both, like the result, are
    without minimum distances.
    """
    path = longest_path(step.motion, corners)
    before = start
    least = SMALL_DISTANCE * step.separation
    if _may_rest(step.motion, corners):
        before = wp.min(start, REST * path)
        least = wp.min(least, wp.max(REST * path, rounding_at(step, step.motion.x1[corners[0]])))
    recovered = wp.max(before + RECOVERY * path, least)
    return wp.min(target, wp.max(start, wp.min(step.separation, recovered)))


@wp.func
def _mean_friction(a: float, b: float) -> float:
    """Returns the geometric mean of two coefficients of friction."""
    product = a * b
    if product > 0.0:  # at 0 there is no derivative
        return wp.sqrt(product)
    return 0.0


@wp.func
def _friction_of_materials(materials: Materials, a: int, b: int, mean: float) -> float:
    """Returns the coefficient of friction of two materials; the mean of that of the two sides if they have none."""
    of_pair = materials.friction[wp.min(a, b), wp.max(a, b)]
    if of_pair >= 0.0:
        return of_pair
    return mean


@wp.func
def pair_friction(motion: Motion, corners: wp.vec4i) -> float:
    """Returns the coefficient of friction of two elements."""
    a = corners[0]
    b = corners[3]
    mean = _mean_friction(motion.friction[a], motion.friction[b])
    if motion.materials.friction:
        of_vertex = motion.materials.of_vertex
        return _friction_of_materials(motion.materials, of_vertex[a], of_vertex[b], mean)
    return mean


@wp.func
def friction_on_plane(motion: Motion, planes: MovingPlanes, plane: int, vertex: int) -> float:
    """Returns the coefficient of friction of a vertex and an infinite plane."""
    mean = _mean_friction(motion.friction[vertex], planes.friction[plane])
    if motion.materials.friction:
        of_vertex = motion.materials.of_vertex[vertex]
        return _friction_of_materials(motion.materials, of_vertex, motion.materials.of_plane[plane], mean)
    return mean


@wp.func
def gap(step: Step, i: int) -> wp.float64:
    """Returns the distance of contact points at the end of the step less the separation [m]; negative if violated."""
    constraints = step.constraints
    end = relative(constraints.weights[i], constraints.vertices[i], step.vertices.x1)
    return wp.dot(constraints.normal[i], end) - constraints.separation[i]


@wp.func
def approach_of(
    step: Step, corners: wp.vec4i, weights: wp.vec4d, normal: wp.vec3d, separation: wp.float64
) -> wp.float64:
    """Returns the approach of contact points over the step as a share of their violation, in [0, 1]."""
    end = wp.dot(normal, relative(weights, corners, step.vertices.x1))
    start = wp.dot(normal, relative(weights, corners, step.motion.x0))
    if end < separation:
        return wp.clamp((start - end) / (separation - end), ZERO, ONE)
    return ONE


@wp.func
def add_constraint(step: Step, added: Constraint):
    """Adds a constraint if it fits; counts it in any case."""
    constraints = step.constraints
    i = take_slot_int(constraints.count)
    if i < constraints.vertices.shape[0]:
        constraints.vertices[i] = added.vertices
        constraints.weights[i] = added.weights
        constraints.normal[i] = added.normal
        constraints.separation[i] = added.separation
        constraints.friction[i] = added.friction
        constraints.kind[i] = added.kind
        constraints.plane[i] = added.plane
        constraints.toi[i] = added.toi
        constraints.approach[i] = approach_of(step, added.vertices, added.weights, added.normal, added.separation)
        constraints.pace[i] = added.pace
        constraints.position_multiplier[i] = added.multiplier
        constraints.velocity_multiplier[i] = wp.vec3d()
        constraints.previous_multiplier[i] = wp.vec3d()
        constraints.last_sweep[i] = NEVER_SWEPT
        if constraints.min_distance:
            constraints.min_distance[i] = added.min_distance


@wp.func
def moves_body(step: Step, i: int) -> bool:
    """Returns whether a constraint moves a body."""
    return are_on_body(step.motion, step.constraints.vertices[i])


@wp.func
def has_pushed(step: Step, i: int) -> bool:
    """Returns whether a constraint pushed its vertices apart, or is of a contact that was divided, see TOUCH."""
    return wp.dot(step.constraints.position_multiplier[i], step.constraints.normal[i]) > ZERO


@wp.func
def sagitta(step: Step, corners: wp.vec4i) -> wp.float64:
    """Returns how far the arcs of vertices on turning bodies are from their chords [m], up to ``MAX_SAGITTA``.

    The centre of mass moves straight, so that an arm r that turns by an angle a is off by r (1 - cos(a / 2)).
    """
    off = ZERO
    bodies = step.motion.bodies
    for j in range(4):
        body = body_of(step.motion, corners[j])
        if can_move(step.motion, body):
            turn = turn_between(bodies.start[body], bodies.end[body])
            half = wp.sin(wp.float64(0.25) * wp.length(turn))
            arm = to_double(step.motion.x1[corners[j]]) - step.vertices.bodies.centre[body]
            off = wp.max(off, wp.float64(2.0) * half * half * wp.length(arm))
    return wp.min(off, MAX_SAGITTA * step.separation)


@wp.func
def ahead_of_chords(
    step: Step, arcs: Arcs, corners: wp.vec4i, weights: wp.vec4d, normal: wp.vec3d, time: wp.float64
) -> wp.float64:
    """Returns how much farther apart than by their chords two elements must end so that arcs meet at no time [m].

    At the time of their contact, arcs are ahead of the chords by some distance along the normal. On the straight way to
    the ends, a share of the distance there, by the time, is to make up for it.
    """
    ahead = ZERO
    if turns(arcs, corners) and time <= ONE:
        for j in range(4):
            vertex = corners[j]
            x0 = to_double(step.motion.x0[vertex])
            x1 = to_double(step.vertices.x1[vertex])
            off = on_arc_of(arcs, vertex, x0, x1, time) - ((ONE - time) * x0 + time * x1)
            ahead -= weights[j] * wp.dot(normal, off)
        ahead /= wp.max(time, EARLIEST)
    return wp.max(ahead, ZERO)
