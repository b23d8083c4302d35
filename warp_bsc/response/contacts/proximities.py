"""Proximities: pairs that are near each other at the start of a step, as constraints before they are contacts."""

import numpy as np
import warp as wp

from ...detection.broad.broad_phase_hierarchy import BroadPhaseHierarchy
from ...detection.run.launch import retry_until_fits
from ...kernels.closest import weights_across
from ...kernels.pipeline.queues import has_overflowed
from ...kernels.polynomials import EDGE_EDGE
from ..schedule import divides_after, projects_now
from ..state.cluster import BLOCK
from ..state.status import Loop, SolveStatus
from ..state.structs import ContactKind, Pace, Step, constraint_count
from ..state.vectors import ZERO, corners_of
from ..state.workspace import Workspace
from ..tuning import MOST_FACE_PAIRS, MOST_PAIRS_PER_FACE, REACH, RESTING_PATH
from . import constraints
from .closest_points import closest_vector
from .occluders import clip_paths, find_nearest_in_queue, is_behind, nearest_among_faces_kernel
from .queue import PairQueue, has_pair, pair_count, queues_of, vertices_of
from .rules import ContactClass, are_occluded, are_on_body, are_parallel, crossed_at_start, owner_of

wp.set_module_options({"enable_backward": False})


@wp.func
def _add_proximity(
    step: Step,
    kind: int,
    pair: wp.vec2i,
    corners: wp.vec4i,
    weights: wp.vec4d,
    normal: wp.vec3d,
    distance: wp.float64,
    status: SolveStatus,
):
    """Adds a constraint for a pair with given closest points, if it is a proximity."""
    motion, separation = step.motion, step.separation
    added = constraints.Constraint()
    if motion.distances.radius:
        _start, kept = constraints.distances_at_start(motion, corners, kind)
        added.min_distance = kept
    beyond = distance - added.min_distance
    path = constraints.longest_path(motion, corners)
    if beyond > wp.max(path, REACH * separation):
        return
    world = motion.world[corners[0]]
    if owner_of(motion, corners) != ContactClass.OURS or not projects_now(status, world):
        return
    if constraints.pace_of(motion, corners, kind) == Pace.FAST:
        return
    if kind == EDGE_EDGE and are_parallel(motion, corners):
        return
    if status.crossings[world] > 0:
        if crossed_at_start(step, kind, pair):
            return
    if kind == EDGE_EDGE and are_occluded(step, pair, corners, normal, ZERO):
        return
    if are_on_body(motion, corners):
        status.is_fast[world] = 1  # as where bodies are in contact, see collect.collect_contacts
    added.vertices = corners
    added.weights = weights
    added.normal = normal
    added.separation = added.min_distance + constraints.feasible(step, corners, separation, beyond)
    added.friction = constraints.pair_friction(motion, corners)
    of_faces, of_edges = int(ContactKind.VERTEX_FACE_PROXIMITY), int(ContactKind.EDGE_EDGE_PROXIMITY)
    added.kind = wp.where(kind == EDGE_EDGE, of_edges, of_faces)
    added.pace = wp.where(path <= RESTING_PATH * separation, int(Pace.RESTING), int(Pace.SLOW))
    constraints.add_constraint(step, added)


@wp.func
def _consider(
    step: Step, kind: int, pair: wp.vec2i, corners: wp.vec4i, nearest: wp.array2d[float], status: SolveStatus
):
    """Adds a constraint for a candidate if it is a proximity; most are not, and cost little."""
    a, b, c, d = corners_of(step.motion.x0, corners)
    weights, normal, distance = weights_across(kind, a, b, c, d)
    if distance == ZERO:
        return
    if status.crossings[step.motion.world[corners[0]]] == 0:
        if is_behind(corners, kind, normal, distance, nearest):
            return
    _add_proximity(step, kind, pair, corners, weights, normal, distance, status)


@wp.kernel(launch_bounds=(BLOCK, 2))
def collect_proximities(
    step: Step,
    vertex_face: PairQueue,
    edge_edge: PairQueue,
    nearest: wp.array2d[float],
    status: SolveStatus,
    threads: int,
):
    """Adds constraints for the proximities among the candidates of two queues."""
    for i in range(wp.tid(), wp.max(pair_count(vertex_face), pair_count(edge_edge)), threads):
        number = int(0)
        while number < 2:  # one body for both, which is large
            queue = wp.where(number == 0, vertex_face, edge_edge)
            if has_pair(queue, i):
                _consider(step, queue.kind, queue.pairs[i], vertices_of(queue, i), nearest, status)
            number += 1


@wp.func
def _disable_if_behind(step: Step, nearest: wp.array2d[float], status: SolveStatus, i: int):
    added = step.constraints
    if added.pace[i] != Pace.SLOW or added.kind[i] >= ContactKind.PLANE:
        return
    corners = added.vertices[i]
    world = step.motion.world[corners[0]]
    if status.crossings[world] > 0 or not divides_after(status, world, status.loop[Loop.ITERATION]):
        return
    kind = constraints.kind_of_pair(added.kind[i])
    _weights, between = closest_vector(step.motion, corners, kind)
    distance = wp.length(between)
    if distance > ZERO and is_behind(corners, kind, between / distance, distance, nearest):
        added.separation[i] = constraints.NEVER_VIOLATED


@wp.kernel
def disable_contacts_behind(step: Step, nearest: wp.array2d[float], status: SolveStatus, threads: int):
    """Disables constraints for slow contacts of elements with another face between them at the start.

    What falls by more than the sheets of a stack are apart would collide with many of them, but meets only the nearest.
    If it still collides with others after the projection, planes divide them.
    """
    for i in range(wp.tid(), constraint_count(step), threads):
        _disable_if_behind(step, nearest, status, i)


@wp.kernel
def drop_proximities(
    step: Step, kept: wp.array[int], needed: int, counts: wp.array[wp.int64], capacities: wp.array[wp.int64]
):
    """Drops all proximities, those from ``kept`` on, if some are missing, or if contacts might not fit behind them.

    They only save iterations; but which of them fit would depend on the order of threads.
    """
    count = step.constraints.count
    if has_overflowed(counts, capacities) or count[0] > step.constraints.vertices.shape[0] - needed:
        count[0] = kept[0]


def add_proximities(work: Workspace) -> None:
    """Adds constraints for slow pairs whose distance one of the two could cross if the other stood still.

    In a stack that falls on something, only the lowest contact is found at first, and each sheet collides as soon as
    the one below stands still: with constraints for contacts alone, each sheet would need an iteration. Only pairs in
    worlds that have contacts, and whose closest points are within both elements, are used, because others soon are
    those of other elements, and none with another face between them, if nothing crosses: neighbours in a stack hold
    what is behind them.

    In a CUDA graph, none are added if not all fit.
    """
    nearest, ends = work.nearest, work.clipped
    wp.copy(work.kept, work.constraints.count)
    nearest.fill_(np.inf)
    if not _find_nearest(work):
        return
    work.launch_over_constraints(disable_contacts_behind, nearest, work.status)
    work.launch(clip_paths, len(ends), [work.step, nearest, work.status, ends])
    _collect(work, ends)
    inputs = [work.step, work.kept, work.max_contacts, work.detector.counters.array, work.detector.capacities]
    work.launch(drop_proximities, 1, inputs)


def _find_nearest(work):
    """Finds the nearest faces on the ways of all vertices in the last detection; returns False if these are too many.

    Those of fast elements, which have no proximities, may overlap all others: their pairs would fill the memory.
    """
    detector, broad_phase = work.detector, work.detector.broad_phase
    has_hierarchy = isinstance(broad_phase, BroadPhaseHierarchy)

    def find() -> None:
        detector.counters.array.zero_()
        if has_hierarchy:  # pairs of elements need no queue
            among_faces = nearest_among_faces_kernel, [work.step, work.nearest]
            broad_phase.pair_faces(work.step.motion.x0, work.vertices.x1, work.active, True, among_faces)
        else:
            broad_phase.pair_vertices_with_faces(detector.vertex_face.counts, detector.vertex_face.queue)

    find()
    while not work.device.is_capturing:
        if detector.counters.read().face_pairs > min(MOST_PAIRS_PER_FACE * len(work.mesh.cells), MOST_FACE_PAIRS):
            return False
        if not detector.grow():
            break
        find()
    if not has_hierarchy:
        inputs = [work.step, queues_of(detector, candidates=True)[0], work.nearest]
        work.launch_over_entries(find_nearest_in_queue, inputs)
    return True


def _collect(work, ends):
    """Adds constraints for the proximities among the pairs whose boxes overlap on the way to some ends."""
    detector, x0 = work.detector, work.step.motion.x0

    def collect() -> None:
        queues = queues_of(detector, candidates=True)[:2]
        inputs = [work.step, *queues, work.nearest, work.status]
        work.launch_over_entries(collect_proximities, inputs, is_large=True)

    retry_until_fits(lambda: detector.find_overlapping(x0, ends, again=True), detector, work.device)
    retry_until_fits(collect, work, work.device)
