"""Contacts as constraints on the ends of paths; :mod:`.projection` solves them."""

import warp as wp

from ..detection.approach_phase import distances_of_pair
from ..kernels.pipeline.pairs import points_of_pair
from ..kernels.pipeline.queues import take_slot_int
from ..kernels.polynomials import EDGE_EDGE, VERTEX_EDGE, VERTEX_VERTEX
from .buffers import Constraints, Motion, Progress, Vertices
from .exclusion import Connectivity, is_movable, met_at_start

__all__ = [
    "EDGE_EDGE_CONTACT",
    "EDGE_EDGE_PROXIMITY",
    "MAX_DIVISIONS",
    "MAX_ITERATIONS",
    "MAX_SLOW_ITERATIONS",
    "MAX_TRUNCATIONS",
    "MOST_AT_REST",
    "MOST_SAGITTA",
    "NO_CONSTRAINT",
    "PLANE_CONTACT",
    "RESTING",
    "SMALLEST_DISTANCE",
    "TIME_UNITS",
    "TOUCH",
    "VERTEX_FACE_CONTACT",
    "VERTEX_FACE_PROXIMITY",
    "Contacts",
    "add_constraint",
    "approach_of",
    "are_on_body",
    "contact_friction",
    "contact_vertices",
    "contact_weights",
    "count_contact",
    "distances_at_start",
    "divides_all_near_pairs",
    "divides_near_pairs",
    "feasible",
    "feasible_in_contact",
    "gap",
    "has_overflowed",
    "inverse_mass_of",
    "is_dividing",
    "is_excluded",
    "is_on_body",
    "is_projecting",
    "is_pushing",
    "is_slow",
    "least_distance",
    "longest_path",
    "relative",
    "to_double",
    "to_single",
    "truncated_path",
    "update_first_contact",
    "widened",
]

MAX_ITERATIONS = 40
"""Iterations of detect and project, after which the paths of vertices that still collide are truncated."""
MAX_SLOW_ITERATIONS = 1
"""Iterations of detect and project in worlds without fast contacts. Vertices that then still collide are divided, which
hardly moves them, and costs no sweeps."""
MAX_DIVISIONS = 32
"""Iterations of detect and divide, after which vertices that still collide are frozen, see :mod:`.dividing_planes`."""
MAX_TRUNCATIONS = wp.constant(8)
"""Iterations of detect and truncate of a step that is recorded, after which vertices that still collide are frozen."""

VERTEX_FACE_CONTACT, EDGE_EDGE_CONTACT, PLANE_CONTACT, VERTEX_FACE_PROXIMITY, EDGE_EDGE_PROXIMITY = (
    wp.constant(i) for i in range(5)
)
"""Kinds of constraints: contacts of a vertex and a face, of two edges, of a vertex and a plane; proximities of both."""

NO_CONSTRAINT = wp.constant(3)
"""In place of the kind of a contact that has no constraint, in the key of a vertex's first contact."""
MOST_SAGITTA = wp.constant(wp.float64(4.0))
"""Most that the turn of a body adds to the separation of a contact, in separations."""
TOUCH = wp.constant(wp.float64(1e-100))
"""Position multiplier of contacts that are divided [kg m]: it moves nothing, but lets them change velocities."""
TIME_UNITS = wp.constant(wp.float64(2.0**30))
"""Units of time in a step; times in keys are integers of them."""
RESTING = wp.constant(2)
"""In place of 1 for slow: of near pairs at rest, which are divided before the next detection."""
MOST_AT_REST = wp.constant(wp.float64(4.0))
"""Longest path of near pairs at rest, in separations. Planes stand still: what moves farther together, they would stop,
and what slides, push apart."""
_SHARE = wp.constant(wp.float64(0.9))
"""Share of the way to its first contact that a truncated vertex goes."""
_WIDENING = wp.constant(wp.float64(1.25))
"""Factor by which the separation of new constraints grows with each iteration, so that jams are resolved."""
_WIDEST = wp.constant(wp.float64(5.0))
"""Largest factor on the separation."""
_SLOW = wp.constant(wp.float64(0.5))
"""Longest path of slow elements, as a share of their shortest side."""
_RECOVERY = wp.constant(wp.float64(0.25))
"""Most that the distance of slow elements grows in a step, as a share of their longest path: elements that are pushed
apart further than they fall in a step hop, and slide meanwhile."""
_REST = wp.constant(wp.float64(0.25))
"""Distance of what may rest from slow elements, as a share of their longest path, from which it does not grow: what is
further apart than it comes in a step does not collide in the next, and falls freely every few steps."""
_ROUNDING = wp.constant(wp.float64(2.0**-20))
"""Least distance of what rests, as a share of its coordinates: 16 times their rounding, which closes smaller ones."""
SMALLEST_DISTANCE = wp.constant(wp.float64(0.1))
"""Least distance of other slow elements as a share of the separation, however short their paths are: a distance that is
nearly 0 is closed again by the rounding of positions."""
_ZERO = wp.constant(wp.float64(0.0))
_ONE = wp.constant(wp.float64(1.0))


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
def to_double(x: wp.vec3) -> wp.vec3d:
    """Returns the vector in double precision."""
    return wp.vec3d(wp.float64(x[0]), wp.float64(x[1]), wp.float64(x[2]))


@wp.func
def to_single(x: wp.vec3d) -> wp.vec3:
    """Returns the nearest vector in single precision."""
    return wp.vec3(wp.float32(x[0]), wp.float32(x[1]), wp.float32(x[2]))


@wp.func
def is_dividing(progress: Progress, world: int, iteration: int) -> bool:
    """Returns whether contacts found after ``iteration`` iterations are divided, or truncated, and not projected."""
    if iteration >= progress.max_iterations:
        return True
    return iteration >= progress.max_slow_iterations and progress.fast[world] == 0


@wp.func
def divides_near_pairs(progress: Progress, world: int) -> bool:
    """Returns whether near pairs of a world without fast contacts are divided in this iteration, as contacts are.

    Those at rest are after the last projection, and all of them in the next iteration, if contacts are left.
    """
    last = progress.status.iteration[0] - 1
    if progress.contact_iteration[world] != last or progress.fast[world] == 1:
        return False
    return last == progress.max_slow_iterations - 1 or divides_all_near_pairs(progress)


@wp.func
def divides_all_near_pairs(progress: Progress) -> bool:
    """Returns whether all near pairs are divided in this iteration, also where that stops what moves together."""
    return progress.status.iteration[0] - 1 == progress.max_slow_iterations


@wp.func
def is_projecting(progress: Progress, world: int) -> bool:
    """Returns whether this iteration projects vertices of a world: one without contacts stays as it is."""
    iteration = progress.status.iteration[0]
    return progress.contact_iteration[world] == iteration - 1 and not is_dividing(progress, world, iteration - 1)


@wp.func
def has_overflowed(counts: wp.array[wp.int64], capacities: wp.array[wp.int64]) -> bool:
    """Returns whether a queue of the detector was too small for a detection."""
    for i in range(1, counts.shape[0]):  # the first counts positions that are not finite
        if counts[i] > capacities[i]:
            return True
    return False


@wp.func
def inverse_mass_of(motion: Motion, vertex: int) -> float:
    """Returns the inverse mass of a vertex, or of the body that it moves with [1/kg]; 0 where nothing can move it."""
    if motion.bodies.of_vertex:
        body = motion.bodies.of_vertex[vertex]
        if body >= 0:
            return motion.bodies.inverse_mass[body]
    return motion.inverse_mass[vertex]


@wp.func
def count_contact(progress: Progress, world: int):
    """Counts a contact that a detection found."""
    wp.atomic_add(progress.status.hits, 0, 1)
    progress.contact_iteration[world] = progress.status.iteration[0]


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
    return _SHARE * time * (x1 - x0)


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
        return wp.vec4d(_ONE - c[0], c[0], c[1] - _ONE, -c[1])
    if kind == VERTEX_EDGE:
        return wp.vec4d(_ONE, c[0] - _ONE, -c[0], _ZERO)
    if kind == VERTEX_VERTEX:
        return wp.vec4d(_ONE, -_ONE, _ZERO, _ZERO)
    return wp.vec4d(_ONE, -c[0], -c[1], -c[2])


@wp.func
def _side(motion: Motion, a: int, b: int) -> wp.float64:
    return wp.length(to_double(motion.x0[a]) - to_double(motion.x0[b]))


@wp.func
def longest_path(motion: Motion, corners: wp.vec4i) -> wp.float64:
    """Returns the length of the longest wanted path of four vertices [m]."""
    path = _ZERO
    for j in range(4):
        wanted = to_double(motion.x1[corners[j]]) - to_double(motion.x0[corners[j]])
        path = wp.max(path, wp.length(wanted))
    return path


@wp.func
def is_slow(motion: Motion, corners: wp.vec4i, kind: int) -> int:
    """Returns 1 if two elements move so little for their size that one direction holds for the whole step, else 0.

    The size of points is their distance.
    """
    if kind == VERTEX_VERTEX:
        return wp.where(longest_path(motion, corners) <= _SLOW * _side(motion, corners[0], corners[1]), 1, 0)
    size = _side(motion, corners[2], corners[3])
    if kind == EDGE_EDGE:
        size = wp.min(size, _side(motion, corners[0], corners[1]))
    else:
        size = wp.min(size, _side(motion, corners[1], corners[2]))
    return wp.where(longest_path(motion, corners) <= _SLOW * size, 1, 0)


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
    return _ZERO


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
def is_on_body(motion: Motion, vertex: int) -> bool:
    """Returns whether a vertex is of a body; False if the response moves none."""
    if motion.bodies.of_vertex:
        return motion.bodies.of_vertex[vertex] >= 0
    return False


@wp.func
def are_on_body(motion: Motion, corners: wp.vec4i) -> bool:
    """Returns whether one of two elements is of a body that can be moved."""
    if motion.bodies.of_vertex:
        for side in range(2):
            body = motion.bodies.of_vertex[corners[3 * side]]
            if body >= 0 and motion.bodies.inverse_mass[body] > 0.0:
                return True
    return False


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
    least = SMALLEST_DISTANCE * separation
    if _may_rest(motion, corners):
        before = wp.min(start, _REST * path)
        x = to_double(motion.x1[corners[0]])
        rounding = _ROUNDING * wp.max(wp.abs(x[0]), wp.max(wp.abs(x[1]), wp.abs(x[2])))
        least = wp.min(least, wp.max(_REST * path, rounding))
    recovered = wp.max(before + _RECOVERY * path, least)
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
def widened(separation: wp.float64, progress: Progress) -> wp.float64:
    """Returns the separation of constraints that are added in this iteration."""
    return separation * wp.min(wp.pow(_WIDENING, wp.float64(progress.status.iteration[0])), _WIDEST)


@wp.func
def relative(weights: wp.vec4d, corners: wp.vec4i, x: wp.array[wp.vec3]) -> wp.vec3d:
    """Returns the vector from the second contact point to the first, or its velocity."""
    result = wp.vec3d()
    for j in range(4):
        result += weights[j] * to_double(x[corners[j]])
    return result


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
        return wp.clamp((start - end) / (separation - end), _ZERO, _ONE)
    return _ONE


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
        constraints.slow[i] = slow
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
