"""Contacts as constraints on the ends of paths; :mod:`.projection` solves them."""

import warp as wp

from ...detection.approach_phase import distances_of_pair
from ...kernels.pipeline.pairs import points_of_pair
from ...kernels.pipeline.queues import take_slot_int
from ...kernels.polynomials import EDGE_EDGE, VERTEX_EDGE, VERTEX_VERTEX
from ..state.mesh import Connectivity
from ..state.poses import turn_between
from ..state.structs import Constraints, Motion, Vertices
from ..state.vectors import ONE, ZERO, relative, to_double
from ..tuning import RECOVERY, REST, ROUNDING, SHARE_OF_PATH, SLOW_PATH, SMALL_DISTANCE
from .rules import are_on_body, inverse_mass_of, is_movable, met_at_start

VERTEX_FACE_CONTACT, EDGE_EDGE_CONTACT, PLANE_CONTACT, VERTEX_FACE_PROXIMITY, EDGE_EDGE_PROXIMITY = (
    wp.constant(i) for i in range(5)
)
"""Kinds of constraints: contacts of a vertex and a face, of two edges, of a vertex and a plane; proximities of both."""

NO_CONSTRAINT = wp.constant(3)
"""In place of the kind of a contact that has no constraint, in the key of a vertex's first contact."""


TOUCH = wp.constant(wp.float64(1e-100))
"""Position multiplier of contacts that are divided [kg m]: it moves nothing, but lets them change velocities."""

TIME_UNITS = wp.constant(wp.float64(2.0**30))
"""Units of time in a step; times in keys are integers of them."""

RESTING = wp.constant(2)
"""In place of 1 for slow: of near pairs at rest, which are divided before the next detection."""


@wp.struct
class Contacts:
    """The contacts of one kind of pair, unsorted, as the last detection found them."""

    mesh: Connectivity
    kind: int  # VERTEX_FACE, EDGE_EDGE, VERTEX_EDGE or VERTEX_VERTEX
    edges: int  # 1 where they are of two edges, else 0
    elements: wp.array2d[int]
    pairs: wp.array[wp.vec2i]
    counts: wp.array[wp.int64]
    status: wp.array[wp.int8]
    within_tolerance: wp.array[wp.bool]
    toi: wp.array[wp.float64]
    coordinates: wp.array[wp.vec3d]
    normal: wp.array[wp.vec3d]


@wp.func
def update_first_contact(vertices: Vertices, vertex: int, time: wp.float64, kind: int, i: int):
    """Makes contact ``i`` of a kind the first contact of a vertex, if it is earlier than the one so far.

    Keys order contacts by time in their upper 32 bits, then by contact.
    """
    key = (wp.int64(wp.floor(TIME_UNITS * time)) << wp.int64(32)) | wp.int64(4 * i + kind)
    wp.atomic_min(vertices.first_contact, vertex, key)


@wp.func
def truncated_path(x0: wp.vec3d, x1: wp.vec3d, time: wp.float64) -> wp.vec3d:
    """Returns the path of a vertex truncated before its first contact, at ``time`` in [0, 1] [m]."""
    return SHARE_OF_PATH * time * (x1 - x0)


@wp.func
def contact_vertices(contacts: Contacts, i: int) -> wp.vec4i:
    """Returns the four vertices of a contact, those of its first element first."""
    return points_of_pair(contacts.kind, contacts.elements, contacts.pairs[i])


@wp.func
def is_excluded(motion: Motion, contacts: Contacts, i: int, corners: wp.vec4i) -> bool:
    """Returns whether a contact is none that the response resolves, see :mod:`.exclusion`."""
    return not is_movable(motion, corners) or met_at_start(
        motion, contacts.mesh, contacts.edges, contacts.pairs[i], corners, contacts.toi[i]
    )


@wp.func
def contact_weights(kind: int, c: wp.vec3d) -> wp.vec4d:
    """Returns the weights of four vertices in the vector from the second contact point to the first.

    Args:
        kind: The kind of pair.
        c: The coordinates of the contact.
    """
    if kind == EDGE_EDGE:
        return wp.vec4d(ONE - c[0], c[0], c[1] - ONE, -c[1])
    if kind == VERTEX_EDGE:
        return wp.vec4d(ONE, c[0] - ONE, -c[0], ZERO)
    if kind == VERTEX_VERTEX:
        return wp.vec4d(ONE, -ONE, ZERO, ZERO)
    return wp.vec4d(ONE, -c[0], -c[1], -c[2])


@wp.func
def _side(motion: Motion, a: int, b: int) -> wp.float64:
    return wp.length(to_double(motion.x0[a]) - to_double(motion.x0[b]))


@wp.func
def longest_path(motion: Motion, corners: wp.vec4i) -> wp.float64:
    """Returns the length of the longest predicted path of four vertices [m]."""
    path = ZERO
    for j in range(4):
        predicted = to_double(motion.x1[corners[j]]) - to_double(motion.x0[corners[j]])
        path = wp.max(path, wp.length(predicted))
    return path


@wp.func
def is_slow(motion: Motion, corners: wp.vec4i, kind: int) -> int:
    """Returns 1 if two elements move so little for their size that one direction holds for the whole step, else 0.

    The size of points is their distance.
    """
    if kind == VERTEX_VERTEX:
        return wp.where(longest_path(motion, corners) <= SLOW_PATH * _side(motion, corners[0], corners[1]), 1, 0)
    size = _side(motion, corners[2], corners[3])
    if kind == EDGE_EDGE:
        size = wp.min(size, _side(motion, corners[0], corners[1]))
    else:
        size = wp.min(size, _side(motion, corners[1], corners[2]))
    return wp.where(longest_path(motion, corners) <= SLOW_PATH * size, 1, 0)


@wp.func
def distances_at_start(motion: Motion, corners: wp.vec4i, kind: int):
    """Returns the distance of a pair at the start, and the one it is to keep; see :func:`distances_of_pair` [m]."""
    a = to_double(motion.x0[corners[0]])
    b = to_double(motion.x0[corners[1]])
    c = to_double(motion.x0[corners[2]])
    d = to_double(motion.x0[corners[3]])
    return distances_of_pair(motion.distances, kind, corners, a, b, c, d)


@wp.func
def least_distance(constraints: Constraints, i: int) -> wp.float64:
    """Returns the part of the separation of a constraint that is the minimum distance of its pair [m]."""
    if constraints.least:
        return constraints.least[i]
    return ZERO


@wp.func
def is_pushing(motion: Motion, corners: wp.vec4i, weights: wp.vec4d, normal: wp.vec3d, least: wp.float64) -> bool:
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
    return moves and wp.dot(normal, end) <= least


@wp.func
def _may_rest(motion: Motion, corners: wp.vec4i) -> bool:
    """Returns whether one of two elements is of a body, or cannot be moved, or is a plane, so that the other may rest.

    Cloth on cloth is in motion as long as one of the two is.
    """
    is_held = inverse_mass_of(motion, corners[0]) == 0.0 or inverse_mass_of(motion, corners[3]) == 0.0
    return is_held or corners[0] == corners[3] or are_on_body(motion, corners)


@wp.func
def feasible(
    motion: Motion, corners: wp.vec4i, target: wp.float64, start: wp.float64, separation: wp.float64
) -> wp.float64:
    """Returns the separation for slow elements: hardly more than at the start, as standing still should nearly do."""
    path = longest_path(motion, corners)
    before = start
    least = SMALL_DISTANCE * separation
    if _may_rest(motion, corners):
        before = wp.min(start, REST * path)
        x = to_double(motion.x1[corners[0]])
        rounding = ROUNDING * wp.max(wp.abs(x[0]), wp.max(wp.abs(x[1]), wp.abs(x[2])))
        least = wp.min(least, wp.max(REST * path, rounding))
    recovered = wp.max(before + RECOVERY * path, least)
    return wp.min(target, wp.max(start, wp.min(separation, recovered)))


@wp.func
def feasible_in_contact(
    motion: Motion,
    corners: wp.vec4i,
    weights: wp.vec4d,
    normal: wp.vec3d,
    target: wp.float64,
    separation: wp.float64,
    least: wp.float64,
) -> wp.float64:
    """Returns the separation beyond ``least`` for a contact of slow elements, where fast ones get ``target`` [m]."""
    start = wp.dot(normal, relative(weights, corners, motion.x0)) - least
    return feasible(motion, corners, target, start, separation)


@wp.func
def contact_friction(a: float, b: float) -> float:
    """Returns the coefficient of friction of a contact from those of its two sides: their geometric mean."""
    product = a * b
    if product > 0.0:  # at 0 there is no derivative
        return wp.sqrt(product)
    return 0.0


@wp.func
def gap(vertices: Vertices, constraints: Constraints, i: int) -> wp.float64:
    """Returns the distance of contact points at the end of the step less the separation [m]; negative if violated."""
    end = relative(constraints.weights[i], constraints.vertices[i], vertices.x1)
    return wp.dot(constraints.normal[i], end) - constraints.separation[i]


@wp.func
def approach_of(
    motion: Motion,
    vertices: Vertices,
    corners: wp.vec4i,
    weights: wp.vec4d,
    normal: wp.vec3d,
    separation: wp.float64,
) -> wp.float64:
    """Returns the approach of contact points over the step as a share of their violation, in [0, 1]."""
    end = wp.dot(normal, relative(weights, corners, vertices.x1))
    start = wp.dot(normal, relative(weights, corners, motion.x0))
    if end < separation:
        return wp.clamp((start - end) / (separation - end), ZERO, ONE)
    return ONE


@wp.func
def add_constraint(
    motion: Motion,
    vertices: Vertices,
    constraints: Constraints,
    corners: wp.vec4i,
    weights: wp.vec4d,
    normal: wp.vec3d,
    separation: wp.float64,
    friction: float,
    slow: int,
    kind: int,
    within_tolerance: bool,
    toi: wp.float64,
    multiplier: wp.vec3d,
    least: wp.float64,
) -> int:
    """Adds a constraint with a position multiplier if it fits; counts it in any case, and returns its place."""
    i = take_slot_int(constraints.count)
    if i < constraints.vertices.shape[0]:
        constraints.vertices[i] = corners
        constraints.weights[i] = weights
        constraints.normal[i] = normal
        constraints.separation[i] = separation
        constraints.friction[i] = friction
        constraints.pace[i] = slow
        constraints.kind[i] = kind
        constraints.within_tolerance[i] = within_tolerance
        constraints.toi[i] = toi
        constraints.approach[i] = approach_of(motion, vertices, corners, weights, normal, separation)
        constraints.position_multiplier[i] = multiplier
        constraints.velocity_multiplier[i] = wp.vec3d()
        constraints.previous_multiplier[i] = wp.vec3d()
        constraints.last_sweep[i] = -2
        if constraints.least:
            constraints.least[i] = least
    return i


@wp.func
def moves_body(motion: Motion, constraints: Constraints, i: int) -> bool:
    """Returns whether a constraint moves a body."""
    return are_on_body(motion, constraints.vertices[i])


@wp.func
def has_pushed(constraints: Constraints, i: int) -> bool:
    """Returns whether a constraint pushed its vertices apart."""
    return wp.dot(constraints.position_multiplier[i], constraints.normal[i]) > ZERO


@wp.func
def sagitta(motion: Motion, vertices: Vertices, corners: wp.vec4i, most: wp.float64) -> wp.float64:
    """Returns how far the arcs of vertices on turning bodies are from their chords at most [m], up to ``most``.

    The centre of mass moves straight, so that an arm r that turns by an angle a is off by r (1 - cos(a / 2)).
    """
    off = ZERO
    if motion.bodies.of_vertex:
        for j in range(4):
            body = motion.bodies.of_vertex[corners[j]]
            if body >= 0 and motion.bodies.inverse_mass[body] > 0.0:
                turn = turn_between(motion.bodies.start[body], motion.bodies.end[body])
                half = wp.sin(wp.float64(0.25) * wp.length(turn))
                arm = to_double(motion.x1[corners[j]]) - vertices.bodies.centre[body]
                off = wp.max(off, wp.float64(2.0) * half * half * wp.length(arm))
    return wp.min(off, most)
