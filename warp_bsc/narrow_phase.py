"""The narrow phase: candidate pairs -> culls -> certified classification -> times of impact -> exact answers.

Every stage writes a compact queue for the next, so that no thread waits for a neighbour's harder pair. A queue holds as
many entries as the one before it, so none can overflow.
"""

import functools
import time
from dataclasses import dataclass

import numpy as np
import warp as wp

from . import checker
from .kernels.ccd import edge_edge_motion, vertex_face_motion
from .kernels.classification import classify
from .kernels.closest import contact_at
from .kernels.culling import (
    centroid_direction,
    direction_separates,
    edge_edge_boxes_apart,
    vertex_face_boxes_apart,
)
from .kernels.polynomials import coplanarity
from .kernels.signs import FREE, HIT, ROUNDOFF, UNSURE, certified_sign_cubic
from .kernels.time_of_impact import impact

__all__ = ["METHODS", "TOLERANCE", "Contacts", "StageCounts", "check_method", "check_tolerance", "find_contacts"]

METHODS = ("float", "conservative", "exact")
"""What becomes of a pair that floating point cannot certify: its computed signs decide, it counts as a hit, or exact
arithmetic decides."""

TOLERANCE = 2.0**-20
"""Default tolerance of the time of impact, as a share of the step."""

_KERNEL = {"enable_backward": False, "module": "unique", "module_options": {"fuse_fp": False}}
"""Without fused operations every device computes the same bits."""


def check_method(method):
    """Raises ValueError if there is no such method."""
    if method not in METHODS:
        raise ValueError(f"method must be one of {', '.join(METHODS)}, not {method!r}")


def check_tolerance(tolerance):
    """Raises ValueError if the tolerance is out of the range that halving the step reaches."""
    if not 2.0**-38 <= tolerance <= 1.0:
        raise ValueError(f"tolerance must be in [2^-38, 1], not {tolerance!r}")


@dataclass(frozen=True)
class StageCounts:
    """How many pairs of one kind entered or left each stage.

    Attributes:
        candidates: Pairs whose swept boxes overlap.
        survivors: Candidates that the culls leave.
        free: Candidates certified free, by the culls or by classification.
        hits: Candidates certified to collide.
        unsure: Candidates that floating point could not certify either way.
    """

    candidates: int
    survivors: int
    free: int
    hits: int
    unsure: int


@dataclass(frozen=True)
class Contacts:
    """The pairs that were not certified free, sorted.

    Attributes:
        pairs: (vertex, face) or (edge, edge), int32, shape [n, 2].
        status: What floating point could certify, HIT or UNSURE, int8, shape [n].
        hit: The answer by the method asked for, bool, shape [n].
        toi: Time of impact as a share of the step, float64, shape [n]; 2.0 where there is no hit.
        coordinates: Contact coordinates, float64, shape [n, 3].
        normal: Unit contact normals, float64, shape [n, 3].
        counts: How many pairs entered or left each stage.
        milliseconds: Wall time of every stage.
    """

    pairs: np.ndarray
    status: np.ndarray
    hit: np.ndarray
    toi: np.ndarray
    coordinates: np.ndarray
    normal: np.ndarray
    counts: StageCounts
    milliseconds: dict[str, float]


class _StageClock:
    """Wall time between the ends of stages, each of which has read its results back and so has finished."""

    def __init__(self):
        self.milliseconds = {}
        self._last = time.perf_counter()

    def lap(self, stage):
        now = time.perf_counter()
        self.milliseconds[stage] = 1000.0 * (now - self._last)
        self._last = now


@functools.cache
def _kernels(kind, dtype):
    """The kernels for one kind of pair and one type of position, each in a module of its own."""
    motion_of = vertex_face_motion if kind == "vertex_face" else edge_edge_motion
    boxes_apart = vertex_face_boxes_apart if kind == "vertex_face" else edge_edge_boxes_apart

    if kind == "vertex_face":

        @wp.func
        def four_points(x: wp.array[dtype], elements: wp.array2d[int], pair: wp.vec2i):
            face = pair[1]
            return x[pair[0]], x[elements[face, 0]], x[elements[face, 1]], x[elements[face, 2]]
    else:

        @wp.func
        def four_points(x: wp.array[dtype], elements: wp.array2d[int], pair: wp.vec2i):
            first = pair[0]
            second = pair[1]
            return x[elements[first, 0]], x[elements[first, 1]], x[elements[second, 0]], x[elements[second, 1]]

    @wp.kernel(**_KERNEL)
    def cull(
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        elements: wp.array2d[int],
        roundoff: wp.float64,
        candidates: wp.array[wp.vec2i],
        survivors: wp.array[wp.vec2i],
        count: wp.array[int],
    ):
        pair = candidates[wp.tid()]
        a0, b0, c0, d0 = four_points(x0, elements, pair)
        a1, b1, c1, d1 = four_points(x1, elements, pair)
        motion = motion_of(a0, b0, c0, d0, a1, b1, c1, d1, roundoff)
        if motion.finite and boxes_apart(a0, b0, c0, d0, a1, b1, c1, d1):
            return
        if direction_separates(motion, centroid_direction(motion)):
            return
        y = coplanarity(motion)
        if certified_sign_cubic(y.k, y.bound) != 0:
            return
        survivors[wp.atomic_add(count, 0, 1)] = pair

    @wp.kernel(**_KERNEL)
    def classify_survivors(
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        elements: wp.array2d[int],
        roundoff: wp.float64,
        survivors: wp.array[wp.vec2i],
        contacts: wp.array[wp.vec2i],
        status: wp.array[int],
        count: wp.array[int],
    ):
        pair = survivors[wp.tid()]
        a0, b0, c0, d0 = four_points(x0, elements, pair)
        a1, b1, c1, d1 = four_points(x1, elements, pair)
        motion = motion_of(a0, b0, c0, d0, a1, b1, c1, d1, roundoff)
        answer = classify(motion, coplanarity(motion))
        if answer != FREE:
            slot = wp.atomic_add(count, 1, 1)
            contacts[slot] = pair
            status[slot] = answer

    @wp.kernel(**_KERNEL)
    def find_impacts(
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        elements: wp.array2d[int],
        roundoff: wp.float64,
        timed: bool,
        tolerance: wp.float64,
        contacts: wp.array[wp.vec2i],
        status: wp.array[int],
        localized: wp.array[int],
        toi: wp.array[wp.float64],
        coordinates: wp.array[wp.vec3d],
        normal: wp.array[wp.vec3d],
    ):
        i = wp.tid()
        if not timed and status[i] == HIT:
            return
        a0, b0, c0, d0 = four_points(x0, elements, contacts[i])
        a1, b1, c1, d1 = four_points(x1, elements, contacts[i])
        motion = motion_of(a0, b0, c0, d0, a1, b1, c1, d1, roundoff)
        result = impact(motion, coplanarity(motion), status[i], tolerance)
        status[i] = result.status
        localized[i] = result.localized
        toi[i] = result.toi
        coordinates[i] = result.coordinates
        normal[i] = result.normal

    @wp.kernel(**_KERNEL)
    def find_contact_points(
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        elements: wp.array2d[int],
        contacts: wp.array[wp.vec2i],
        toi: wp.array[wp.float64],
        coordinates: wp.array[wp.vec3d],
        normal: wp.array[wp.vec3d],
    ):
        i = wp.tid()
        a0, b0, c0, d0 = four_points(x0, elements, contacts[i])
        a1, b1, c1, d1 = four_points(x1, elements, contacts[i])
        motion = motion_of(a0, b0, c0, d0, a1, b1, c1, d1, wp.float64(0.0))
        at, direction = contact_at(motion, toi[i])
        coordinates[i] = at
        normal[i] = direction

    return cull, classify_survivors, find_impacts, find_contact_points


def find_contacts(kind, x0, x1, elements, candidates, *, method, localize, timed=True, tolerance=TOLERANCE):
    """Finds which candidate pairs collide, and when and where.

    Args:
        kind: "vertex_face" or "edge_edge".
        x0: Positions at the start of the step, Warp array of vec3 or vec3d.
        x1: Positions at its end, of the same type.
        elements: Vertex indices of the faces (vertex_face) or edges (edge_edge), Warp array of int, two-dimensional.
        candidates: Pairs (vertex, face) or (edge, edge), Warp array of vec2i.
        method: One of :data:`METHODS`.
        localize: Whether the times of certified hits that floating point could not place to within the tolerance
            are found by exact arithmetic on the host; without it they are lower bounds.
        timed: Whether to find times of impact, coordinates and normals.
        tolerance: Of the times of impact, as a share of the step.

    Returns:
        Contacts: The pairs that were not certified free.
    """
    device = x0.device
    cull, classify_survivors, find_impacts, find_contact_points = _kernels(kind, x0.dtype)
    roundoff = 0.0 if method == "float" else ROUNDOFF
    motion = [x0, x1, elements]
    clock = _StageClock()

    counts = wp.zeros(2, dtype=int, device=device)
    survivors = wp.empty(len(candidates), dtype=wp.vec2i, device=device)
    wp.launch(cull, len(candidates), inputs=[*motion, roundoff, candidates], outputs=[survivors, counts], device=device)
    survivor_count = int(counts.numpy()[0])
    clock.lap("cull")

    queue = wp.empty(survivor_count, dtype=wp.vec2i, device=device)
    queue_status = wp.empty(survivor_count, dtype=int, device=device)
    wp.launch(
        classify_survivors,
        survivor_count,
        inputs=[*motion, roundoff, survivors],
        outputs=[queue, queue_status, counts],
        device=device,
    )
    queue_count = int(counts.numpy()[1])
    clock.lap("classify")

    localized = wp.zeros(queue_count, dtype=int, device=device)
    toi = wp.full(queue_count, 2.0, dtype=wp.float64, device=device)
    coordinates = wp.zeros(queue_count, dtype=wp.vec3d, device=device)
    normal = wp.zeros(queue_count, dtype=wp.vec3d, device=device)
    wp.launch(
        find_impacts,
        queue_count,
        inputs=[*motion, roundoff, timed, tolerance, queue],
        outputs=[queue_status, localized, toi, coordinates, normal],
        device=device,
    )
    status = queue_status.numpy()[:queue_count].astype(np.int8)
    pairs = queue.numpy()[:queue_count]
    # threads fill a queue in any order
    order = np.lexsort((pairs[:, 1], pairs[:, 0]))
    order = order[status[order] != FREE]
    pairs, status, localized = pairs[order], status[order], localized.numpy()[order] == 1
    toi, coordinates, normal = toi.numpy()[order], coordinates.numpy()[order], normal.numpy()[order]
    hit = np.ones(len(pairs), dtype=bool)
    clock.lap("time of impact")

    ask = np.zeros(len(pairs), dtype=bool)
    if method == "exact":
        ask |= status == UNSURE
    if localize and timed:
        ask |= (status == HIT) & ~localized
    if ask.any():
        corners = _four_vertices(kind, elements.numpy(), pairs[ask])
        points = np.concatenate([x0.numpy()[corners], x1.numpy()[corners]], axis=1)
        if not timed:
            hit[ask] = getattr(checker, kind)(points)
        else:
            toi[ask] = getattr(checker, f"{kind}_toi")(points)[:, 0]
            hit[ask] = ~np.isnan(toi[ask])
            toi[~hit] = 2.0
            again = np.flatnonzero(ask & hit)
            at = wp.empty(len(again), dtype=wp.vec3d, device=device)
            direction = wp.empty_like(at)
            times = wp.array(toi[again], dtype=wp.float64, device=device)
            contacts = wp.array(pairs[again], dtype=wp.vec2i, device=device)
            inputs = [*motion, contacts, times]
            wp.launch(find_contact_points, len(again), inputs=inputs, outputs=[at, direction], device=device)
            coordinates[again], normal[again] = at.numpy(), direction.numpy()
    clock.lap("exact")

    hits, unsure = int((status == HIT).sum()), int((status == UNSURE).sum())
    counts = StageCounts(
        candidates=len(candidates),
        survivors=survivor_count,
        free=len(candidates) - hits - unsure,
        hits=hits,
        unsure=unsure,
    )
    return Contacts(pairs, status, hit, toi, coordinates, normal, counts, clock.milliseconds)


def _four_vertices(kind, elements, pairs):
    """The vertices of pairs in the order of a query's points, int, shape [n, 4]."""
    if kind == "vertex_face":
        return np.concatenate([pairs[:, :1], elements[pairs[:, 1]]], axis=1)
    return np.concatenate([elements[pairs[:, 0]], elements[pairs[:, 1]]], axis=1)
