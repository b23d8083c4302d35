"""Proximities: pairs that are near each other at the start of a step, as constraints before they are contacts."""

import numpy as np
import warp as wp

from ...detection.launch import retry_until_fits
from ...detection.settings import Count, PairKind
from ...kernels.pipeline.pairs import vertices_of_pair
from ...kernels.pipeline.queues import is_filled
from ..schedule import SolveStatus, has_overflowed, is_projecting
from ..state.mesh import Connectivity
from ..state.structs import Constraints, Motion, Vertices
from ..state.vectors import ONE, ZERO, to_double
from ..state.workspace import Workspace
from ..tuning import BEHIND, REACH, RESTING_PATH
from .constraints import (
    EDGE_EDGE_PROXIMITY,
    RESTING,
    VERTEX_FACE_PROXIMITY,
    add_constraint,
    contact_friction,
    distances_at_start,
    feasible,
    is_slow,
    longest_path,
)
from .rules import are_occluded, are_on_body, crossed_at_start, is_movable

wp.set_module_options({"enable_backward": False})

_QUEUED = wp.constant(int(Count.QUEUED))


_PARALLEL = wp.constant(wp.float64(1.0e-12))
"""Squared sine up to which edges, or two sides of a face, count as parallel."""


@wp.struct
class Proximities:
    """The candidate pairs of one kind, among which proximities are looked for."""

    mesh: Connectivity
    edges: int  # 1 where they are of edges: EDGE_EDGE, else VERTEX_FACE
    elements: wp.array2d[int]
    pairs: wp.array[wp.vec2i]
    counts: wp.array[wp.int64]


@wp.func
def weights_across(motion: Motion, corners: wp.vec4i, edges: int):
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
    if nn <= _PARALLEL * wp.length_sq(u) * wp.length_sq(v) or not (s > ZERO and s < nn):
        return weights, n, ZERO
    height = wp.dot(w, n)
    s /= nn
    r /= nn
    if edges == 1:
        height = -height
        r = -r
        weights = wp.vec4d(ONE - s, s, r - ONE, -r)
    else:
        weights = wp.vec4d(ONE, s + r - ONE, -s, -r)
    size = wp.sqrt(nn)
    n *= wp.sign(height) / size
    if r > ZERO and weights[1 + edges] < ZERO:
        return weights, n, wp.abs(height) / size
    return weights, n, ZERO


@wp.func
def _direction(u: wp.vec3d) -> int:
    """Returns to which of the six directions along the axes a vector is nearest."""
    axis = int(0)
    for other in range(1, 3):
        if wp.abs(u[other]) > wp.abs(u[axis]):
            axis = other
    return 2 * axis + wp.where(u[axis] > ZERO, 1, 0)


@wp.kernel
def find_nearest(motion: Motion, vertex_face: Proximities, nearest: wp.array2d[float]):
    """Finds how far each vertex is from the nearest face in each of six directions [m]; ``nearest`` is infinite before.

    Only faces count that have the closest point within them.
    """
    i = wp.tid()
    if not is_filled(i, vertex_face.pairs, vertex_face.counts, _QUEUED):
        return
    corners = vertices_of_pair(0, vertex_face.elements, vertex_face.pairs[i])
    _weights, normal, distance = weights_across(motion, corners, 0)
    if distance > ZERO:
        wp.atomic_min(nearest, corners[0], _direction(-normal), float(distance))


@wp.func
def _is_behind(
    corners: wp.vec4i, edges: int, normal: wp.vec3d, distance: wp.float64, nearest: wp.array2d[float]
) -> bool:
    """Returns whether another face is between two elements: seen from the vertex, or from both ends of an edge."""
    a = nearest[corners[0], _direction(-normal)]
    if edges == 0:
        return distance > BEHIND * wp.float64(a)
    b = nearest[corners[1], _direction(-normal)]
    c = nearest[corners[2], _direction(normal)]
    d = nearest[corners[3], _direction(normal)]
    return distance > BEHIND * wp.float64(wp.min(wp.max(a, b), wp.max(c, d)))


@wp.func
def _collect_proximity(
    motion: Motion,
    vertices: Vertices,
    near: Proximities,
    nearest: wp.array2d[float],
    i: int,
    constraints: Constraints,
    status: SolveStatus,
    separation: wp.float64,
):
    if not is_filled(i, near.pairs, near.counts, _QUEUED):
        return
    corners = vertices_of_pair(near.edges, near.elements, near.pairs[i])
    weights, normal, distance = weights_across(motion, corners, near.edges)
    if distance == ZERO:
        return
    least = ZERO
    if motion.distances.radius:
        _start, kept = distances_at_start(motion, corners, near.edges)
        least = kept
    path = longest_path(motion, corners)
    if distance - least > wp.max(path, REACH * separation):
        return
    if not is_movable(motion, corners) or not is_projecting(status, motion.world[corners[0]]):
        return
    if is_slow(motion, corners, near.edges) == 0:
        return
    if status.results.crossings[0] > 0:
        if crossed_at_start(motion, near.mesh, near.edges, near.pairs[i]):
            return
    elif nearest and _is_behind(corners, near.edges, normal, distance, nearest):
        return
    if near.edges == 1 and are_occluded(motion, near.mesh, near.pairs[i], corners, normal, ZERO):
        return
    friction = contact_friction(motion.friction[corners[0]], motion.friction[corners[3]])
    target = least + feasible(motion, corners, separation, distance - least, separation)
    slow = wp.where(path <= RESTING_PATH * separation, RESTING, 1)
    kind = wp.where(near.edges == 1, EDGE_EDGE_PROXIMITY, VERTEX_FACE_PROXIMITY)
    if are_on_body(motion, corners):
        status.is_fast[motion.world[corners[0]]] = 1  # as where bodies are in contact, see kernels.collect_contacts
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
        ZERO,
        wp.vec3d(),
        least,
    )


@wp.kernel
def collect_proximities(
    motion: Motion,
    vertices: Vertices,
    vertex_face: Proximities,
    edge_edge: Proximities,
    nearest: wp.array2d[float],
    constraints: Constraints,
    status: SolveStatus,
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
    _collect_proximity(motion, vertices, vertex_face, nearest, i, constraints, status, separation)
    _collect_proximity(motion, vertices, edge_edge, nearest, i, constraints, status, separation)


@wp.kernel
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


def add_proximities(work: Workspace) -> None:
    """Adds constraints for proximities, in worlds that have contacts; in a CUDA graph none if not all fit."""
    detector, motion, vertices = work.detector, work.motion.vertices, work.vertices
    retry_until_fits(detector.find_candidates, detector, work.device)
    wp.copy(work.kept, work.constraints.count)

    def collect() -> None:
        kinds = []
        for narrow_phase in detector.narrow_phases[:2]:
            of_kind = Proximities()
            kinds.append(of_kind)
            of_kind.mesh, of_kind.elements = work.connectivity, detector.mesh.device_elements(narrow_phase.kind)
            of_kind.edges = int(narrow_phase.kind == PairKind.EDGE_EDGE)
            of_kind.pairs, of_kind.counts = narrow_phase.queue, narrow_phase.counts
        queues = [(of_kind.pairs, of_kind.counts, Count.QUEUED) for of_kind in kinds]
        nearest = work.nearest
        if nearest is not None:
            nearest.fill_(np.inf)
            work.launch_over(find_nearest, queues[:1], [motion, kinds[0], nearest])
        inputs = [motion, vertices, *kinds, nearest, work.constraints, work.status, work.separation]
        work.launch_over(collect_proximities, queues, inputs)

    retry_until_fits(collect, work, work.device)
    inputs = [work.constraints, work.kept, work.max_contacts, detector.counters.array, detector.capacities]
    work.launch(drop_proximities, 1, inputs)
