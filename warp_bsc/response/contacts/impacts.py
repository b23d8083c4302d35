"""Contacts as differentiable functions of the positions of their vertices."""

import warp as wp

from ...detection.narrow.rings import are_within_rings
from ...detection.narrow.rules.approach import KEPT
from ...detection.run.settings import TOLERANCE
from ...kernels.closest import closest_weights, contact_weights
from ...kernels.gradients import SQUARE_SINE, with_gradients
from ...kernels.pairs import distance_of_corners, firsts_of
from ...kernels.signs import FREE, HIT, UNSURE
from ...kernels.time_of_impact import Impact
from ..state.record import StepRecord
from ..state.structs import ContactKind, Motion, Step
from ..state.vectors import ONE, ZERO, corners_of, relative
from .constraints import kind_of_contact, kind_of_pair
from .queue import PairQueue, has_pair, pair_count, vertices_of
from .rules import ContactClass, classify_contact, owner_of

_TOLERANCE = wp.constant(wp.float64(TOLERANCE))


@wp.func
def impact_of(
    step: Step,
    corners: wp.vec4i,
    kind: int,
    within_tolerance: bool,
    toi: wp.float64,
    coordinates: wp.vec3d,
    normal: wp.vec3d,
) -> Impact:
    """Returns a contact of a ContactKind as a differentiable function of the positions of its vertices."""
    found = Impact()
    found.status = wp.where(within_tolerance, HIT, UNSURE)
    found.within_tolerance = wp.where(within_tolerance, 1, 0)
    found.toi = toi
    found.coordinates = coordinates
    found.normal = normal
    a0, b0, c0, d0 = corners_of(step.motion.x0, corners)
    a1, b1, c1, d1 = corners_of(step.vertices.x1, corners)
    return with_gradients(kind_of_pair(kind), a0, b0, c0, d0, a1, b1, c1, d1, found, _TOLERANCE)


@wp.func
def kept_distance(motion: Motion, corners: wp.vec4i, kind: int):
    """Returns the minimum distance of a pair in the step, and up to which one pairs are near [m]; 0 if it has none.

    Differentiable; the first as of :func:`.constraints.distances_at_start`, but for rounding.
    """
    if not motion.distances.radius or kind == ContactKind.PLANE:
        return ZERO, ZERO
    pair = kind_of_pair(kind)
    if are_within_rings(corners, firsts_of(pair), motion.distances.rings):
        return ZERO, motion.distances.reach
    a, b, c, d = corners_of(motion.x0, corners)
    start = wp.length(relative(closest_weights(pair, a, b, c, d), corners, motion.x0))
    kept = distance_of_corners(pair, corners, motion.distances.radius)
    reach = motion.distances.reach + kept
    kept = wp.min(kept, KEPT * start)
    return kept, reach


@wp.func
def time_at_distance(
    step: Step, corners: wp.vec4i, weights: wp.vec4d, normal: wp.vec3d, distance: wp.float64
) -> wp.float64:
    """Returns when a pair comes within a distance, in [0, 1], given weights and normal of its closest points then.

    These may be constants: closest points do not change the distance to first order. It is clamped where they graze, as
    in :mod:`warp_bsc.kernels.gradients`.
    """
    before = relative(weights, corners, step.motion.x0)
    path = relative(weights, corners, step.vertices.x1) - before
    length = wp.length(path)
    if length == ZERO:
        return ZERO
    rate = wp.min(wp.dot(normal, path), -wp.sqrt(SQUARE_SINE) * length)
    return wp.clamp((distance - wp.dot(normal, before)) / rate, ZERO, ONE)


@wp.func
def contact_at(step: Step, corners: wp.vec4i, kind: int, time: wp.float64):
    """Returns weights and normal of the closest points of a pair at a time, differentiably."""
    a0, b0, c0, d0 = corners_of(step.motion.x0, corners)
    a1, b1, c1, d1 = corners_of(step.vertices.x1, corners)
    a = a0 + time * (a1 - a0)
    b = b0 + time * (b1 - b0)
    c = c0 + time * (c1 - c0)
    d = d0 + time * (d1 - d0)
    weights = closest_weights(kind_of_pair(kind), a, b, c, d)
    return weights, wp.normalize(weights[0] * a + weights[1] * b + weights[2] * c + weights[3] * d)


@wp.func
def contact_within_reach(
    step: Step,
    corners: wp.vec4i,
    kind: int,
    weights: wp.vec4d,
    normal: wp.vec3d,
    distance: wp.float64,
    is_first: bool,
    reach: wp.float64,
):
    """Returns a contact at a minimum distance, given the weights and normal that its detection found.

    They are those of the closest points when the pair comes within that distance. In the first detection of a step it
    is the time when the pair comes within reach of it, the start if it is within reach then.
    """
    within = distance
    if is_first:
        within = reach
    time = time_at_distance(step, corners, weights, normal, within)
    if is_first and wp.length(relative(weights, corners, step.motion.x0)) < reach:
        time *= ZERO
    at_weights, at_normal = contact_at(step, corners, kind, time)
    return at_weights, at_normal


@wp.func
def _count_grazing_at_distance(step: Step, corners: wp.vec4i, weights: wp.vec4d, normal: wp.vec3d, record: StepRecord):
    path = relative(weights, corners, step.vertices.x1) - relative(weights, corners, step.motion.x0)
    if wp.dot(normal, path) > -wp.sqrt(SQUARE_SINE) * wp.length(path):
        wp.atomic_add(record.counts.grazing, 0, 1)


@wp.func
def _count_grazing(step: Step, contacts: PairQueue, i: int, record: StepRecord):
    if not has_pair(contacts, i) or int(contacts.status[i]) == FREE:
        return
    corners = vertices_of(contacts, i)
    owner = owner_of(step.motion, corners)
    if owner != ContactClass.OURS:
        return
    kind = contacts.kind
    toi = contacts.toi[i]
    if step.motion.distances.radius:
        _count_grazing_at_distance(
            step, corners, contact_weights(kind, contacts.coordinates[i]), contacts.normal[i], record
        )
        return
    found = classify_contact(step, kind, contacts.pairs[i], corners, owner, toi, True)
    if found != ContactClass.OURS:
        return
    coordinates = contacts.coordinates[i]
    within = contacts.within_tolerance[i]
    impact = impact_of(step, corners, kind_of_contact(kind), within, toi, coordinates, contacts.normal[i])
    wp.atomic_add(record.counts.grazing, 0, impact.grazing)


@wp.kernel(enable_backward=False)
def count_grazing(step: Step, vertex_face: PairQueue, edge_edge: PairQueue, record: StepRecord, threads: int):
    """Counts the contacts whose gradients are clamped, see :mod:`warp_bsc.kernels.gradients`."""
    for i in range(wp.tid(), wp.max(pair_count(vertex_face), pair_count(edge_edge)), threads):
        _count_grazing(step, vertex_face, i, record)
        _count_grazing(step, edge_edge, i, record)
