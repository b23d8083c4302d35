"""Contacts as differentiable functions of the positions of their vertices."""

import warp as wp

from ...detection.settings import TOLERANCE
from ...kernels.gradients import with_gradients
from ...kernels.signs import FREE, HIT, UNSURE
from ...kernels.time_of_impact import Impact
from ..state.record import StepRecord
from ..state.structs import Step
from ..state.vectors import corners_of
from .constraints import kind_of_contact, kind_of_pair
from .queue import PairQueue, has_pair, vertices_of
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
def _count_grazing(step: Step, contacts: PairQueue, i: int, record: StepRecord):
    if not has_pair(contacts, i) or int(contacts.status[i]) == FREE:
        return
    corners = vertices_of(contacts, i)
    owner = owner_of(step.motion, corners)
    if owner != ContactClass.OURS:
        return
    kind = contacts.kind
    toi = contacts.toi[i]
    found = classify_contact(step, kind, contacts.pairs[i], corners, owner, toi, True)
    if found != ContactClass.OURS:
        return
    coordinates = contacts.coordinates[i]
    within = contacts.within_tolerance[i]
    impact = impact_of(step, corners, kind_of_contact(kind), within, toi, coordinates, contacts.normal[i])
    wp.atomic_add(record.counts.grazing, 0, impact.grazing)


@wp.kernel(enable_backward=False)
def count_grazing(step: Step, vertex_face: PairQueue, edge_edge: PairQueue, record: StepRecord):
    """Counts the contacts whose gradients are clamped, see :mod:`warp_bsc.kernels.gradients`."""
    i = wp.tid()
    _count_grazing(step, vertex_face, i, record)
    _count_grazing(step, edge_edge, i, record)
