"""Proximities: pairs that are near each other at the start of a step, as constraints before they are contacts."""

import warp as wp

from ..detection.settings import Count
from ..kernels.closest import closest_coordinates
from ..kernels.pipeline.pairs import vertices_of_pair
from ..kernels.pipeline.queues import is_filled
from ..kernels.polynomials import EDGE_EDGE, VERTEX_FACE
from .buffers import Constraints, Motion, Progress, Vertices
from .constraints import (
    EDGE_EDGE_PROXIMITY,
    MOST_AT_REST,
    RESTING,
    VERTEX_FACE_PROXIMITY,
    add_constraint,
    are_on_body,
    contact_friction,
    distances_at_start,
    feasible,
    has_overflowed,
    is_projecting,
    is_slow,
    longest_path,
    relative,
    to_double,
)
from .exclusion import Connectivity, crossed_at_start, is_movable
from .hidden_edges import are_hidden

__all__ = [
    "Proximities",
    "closest_direction",
    "closest_vector",
    "collect_proximities",
    "drop_proximities",
    "find_nearest",
]

_QUEUED = wp.constant(int(Count.QUEUED))
_REACH = wp.constant(wp.float64(1.5))
"""Distance in separations up to which pairs are proximities even if they stand still: neighbours in a stack."""
_BEHIND = wp.constant(wp.float64(1.5))
"""Distance, as a multiple of that of the nearest face in its direction, from which an element is behind that face."""
_PARALLEL = wp.constant(wp.float64(1.0e-12))
"""Squared sine up to which edges, or two sides of a face, count as parallel."""
_ZERO = wp.constant(wp.float64(0.0))
_ONE = wp.constant(wp.float64(1.0))

_KERNEL = {"enable_backward": False}


@wp.struct
class Proximities:
    """The candidate pairs of one kind, among which proximities are looked for."""

    mesh: Connectivity
    edges: int  # 1 where they are of edges: EDGE_EDGE, else VERTEX_FACE
    elements: wp.array2d[int]
    pairs: wp.array[wp.vec2i]
    counts: wp.array[wp.int64]


@wp.func
def _are_positive(a: wp.float64, b: wp.float64) -> bool:
    return a > _ZERO and b > _ZERO


@wp.func
def _closest_weights(motion: Motion, corners: wp.vec4i, edges: int) -> wp.vec4d:
    """Returns the weights of four vertices in the vector between the closest points of two elements at the start."""
    a = to_double(motion.x0[corners[0]])
    b = to_double(motion.x0[corners[1]])
    c = to_double(motion.x0[corners[2]])
    d = to_double(motion.x0[corners[3]])
    if edges == 1:
        at = closest_coordinates(EDGE_EDGE, b - a, d - c, c - a)
        return wp.vec4d(_ONE - at[0], at[0], at[1] - _ONE, -at[1])
    at = closest_coordinates(VERTEX_FACE, c - b, d - b, a - b)
    return wp.vec4d(_ONE, at[0] + at[1] - _ONE, -at[0], -at[1])


@wp.func
def _is_within(weights: wp.vec4d, edges: int) -> bool:
    """Returns whether closest points are within both elements, not on their borders."""
    if edges == 1 and not _are_positive(weights[0], weights[1]):
        return False
    return _are_positive(-weights[2], -weights[3]) and (edges == 1 or weights[1] < _ZERO)


@wp.func
def closest_vector(motion: Motion, corners: wp.vec4i, edges: int):
    """Returns the weights of the closest points of two elements at the start, and the vector between them [m]."""
    weights = _closest_weights(motion, corners, edges)
    return weights, relative(weights, corners, motion.x0)


@wp.func
def closest_direction(motion: Motion, corners: wp.vec4i, edges: int) -> wp.vec3d:
    """Returns the unit vector from the second to the first of two elements at the start; zero if they touch.

    Within both elements it is across both, which rounding hardly turns, however near they are.
    """
    weights, between = closest_vector(motion, corners, edges)
    if _is_within(weights, edges):
        b = to_double(motion.x0[corners[1]])
        c = to_double(motion.x0[corners[2]])
        d = to_double(motion.x0[corners[3]])
        across = wp.cross(c - b, d - b)
        if edges == 1:
            across = wp.cross(b - to_double(motion.x0[corners[0]]), d - c)
        if wp.length_sq(across) > _ZERO:
            between = wp.where(wp.dot(across, between) < _ZERO, -across, across)
    return wp.normalize(between)


@wp.func
def _weights_across(motion: Motion, corners: wp.vec4i, edges: int):
    """Returns where the line across both elements at the start meets them.

    Returns:
        The weights of the four vertices in the vector between the two points, the unit vector across both elements,
        from the second to the first, and the distance along it [m], which is 0 unless both points are within the
        elements: only then are they their closest points.
    """
    a = to_double(motion.x0[corners[0]])
    b = to_double(motion.x0[corners[1]])
    c = to_double(motion.x0[corners[2]])
    d = to_double(motion.x0[corners[3]])
    u = wp.where(edges == 1, b - a, c - b)
    v = wp.where(edges == 1, d - c, d - b)
    w = wp.where(edges == 1, c - a, a - b)
    n = wp.cross(u, v)
    nn = wp.length_sq(n)
    s = wp.dot(wp.cross(w, v), n)
    r = wp.dot(wp.cross(u, w), n)
    weights = wp.vec4d()
    if nn <= _PARALLEL * wp.length_sq(u) * wp.length_sq(v) or not (s > _ZERO and s < nn):
        return weights, n, _ZERO
    height = wp.dot(w, n)
    s /= nn
    r /= nn
    if edges == 1:
        height = -height
        r = -r
        weights = wp.vec4d(_ONE - s, s, r - _ONE, -r)
    else:
        weights = wp.vec4d(_ONE, s + r - _ONE, -s, -r)
    size = wp.sqrt(nn)
    n *= wp.sign(height) / size
    if r > _ZERO and weights[1 + edges] < _ZERO:
        return weights, n, wp.abs(height) / size
    return weights, n, _ZERO


@wp.func
def _direction(u: wp.vec3d) -> int:
    """Returns to which of the six directions along the axes a vector is nearest."""
    axis = int(0)
    for other in range(1, 3):
        if wp.abs(u[other]) > wp.abs(u[axis]):
            axis = other
    return 2 * axis + wp.where(u[axis] > _ZERO, 1, 0)


@wp.kernel(**_KERNEL)
def find_nearest(motion: Motion, vertex_face: Proximities, nearest: wp.array2d[float]):
    """Finds how far each vertex is from the nearest face in each of six directions [m]; ``nearest`` is infinite before.

    Only faces count that have the closest point within them.
    """
    i = wp.tid()
    if not is_filled(i, vertex_face.pairs, vertex_face.counts, _QUEUED):
        return
    corners = vertices_of_pair(0, vertex_face.elements, vertex_face.pairs[i])
    _weights, normal, distance = _weights_across(motion, corners, 0)
    if distance > _ZERO:
        wp.atomic_min(nearest, corners[0], _direction(-normal), float(distance))


@wp.func
def _is_behind(
    corners: wp.vec4i, edges: int, normal: wp.vec3d, distance: wp.float64, nearest: wp.array2d[float]
) -> bool:
    """Returns whether another face is between two elements: seen from the vertex, or from both ends of an edge."""
    a = nearest[corners[0], _direction(-normal)]
    if edges == 0:
        return distance > _BEHIND * wp.float64(a)
    b = nearest[corners[1], _direction(-normal)]
    c = nearest[corners[2], _direction(normal)]
    d = nearest[corners[3], _direction(normal)]
    return distance > _BEHIND * wp.float64(wp.min(wp.max(a, b), wp.max(c, d)))


@wp.func
def _collect_proximity(
    motion: Motion,
    vertices: Vertices,
    near: Proximities,
    nearest: wp.array2d[float],
    i: int,
    constraints: Constraints,
    progress: Progress,
    separation: wp.float64,
):
    if not is_filled(i, near.pairs, near.counts, _QUEUED):
        return
    corners = vertices_of_pair(near.edges, near.elements, near.pairs[i])
    weights, normal, distance = _weights_across(motion, corners, near.edges)
    if distance == _ZERO:
        return
    least = _ZERO
    if motion.distances.radius:
        _start, kept = distances_at_start(motion, corners, near.edges)
        least = kept
    path = longest_path(motion, corners)
    if distance - least > wp.max(path, _REACH * separation):
        return
    if not is_movable(motion, corners) or not is_projecting(progress, motion.world[corners[0]]):
        return
    if is_slow(motion, corners, near.edges) == 0:
        return
    if progress.status.crossings[0] > 0:
        if crossed_at_start(motion, near.mesh, near.edges, near.pairs[i]):
            return
    elif nearest and _is_behind(corners, near.edges, normal, distance, nearest):
        return
    if near.edges == 1 and are_hidden(motion, near.mesh, near.pairs[i], corners, normal, _ZERO):
        return
    friction = contact_friction(motion.friction[corners[0]], motion.friction[corners[3]])
    target = least + feasible(motion, corners, separation, distance - least, separation)
    slow = wp.where(path <= MOST_AT_REST * separation, RESTING, 1)
    kind = wp.where(near.edges == 1, EDGE_EDGE_PROXIMITY, VERTEX_FACE_PROXIMITY)
    if are_on_body(motion, corners):
        progress.fast[motion.world[corners[0]]] = 1  # as where bodies are in contact, see kernels.collect_contacts
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
        True,
        _ZERO,
        wp.vec3d(),
        least,
    )


@wp.kernel(**_KERNEL)
def collect_proximities(
    motion: Motion,
    vertices: Vertices,
    vertex_face: Proximities,
    edge_edge: Proximities,
    nearest: wp.array2d[float],
    constraints: Constraints,
    progress: Progress,
    separation: wp.float64,
):
    """Adds constraints for slow pairs whose distance one of the two could cross if the other stood still.

    In a stack that falls on something, only the lowest contact is found at first, and each layer collides as soon as
    the one below stands still: with constraints for contacts alone, each layer would need an iteration. Only pairs
    whose closest points are within both elements are used, because others soon are those of other elements, and none
    with another face between them, if ``nearest`` is known and nothing crosses: neighbours in a stack hold what is
    behind them.
    """
    i = wp.tid()
    _collect_proximity(motion, vertices, vertex_face, nearest, i, constraints, progress, separation)
    _collect_proximity(motion, vertices, edge_edge, nearest, i, constraints, progress, separation)


@wp.kernel(**_KERNEL)
def drop_proximities(
    constraints: Constraints,
    kept: wp.array[int],
    needed: int,
    counts: wp.array[wp.int64],
    capacities: wp.array[wp.int64],
):
    """Drops all proximities, those from ``kept`` on, if some are missing, or if contacts might not fit behind them.

    They only save iterations; but which of them fit would depend on the order of threads.
    """
    if has_overflowed(counts, capacities) or constraints.count[0] > constraints.vertices.shape[0] - needed:
        constraints.count[0] = kept[0]
