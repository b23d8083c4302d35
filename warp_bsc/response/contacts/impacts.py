"""Contacts as differentiable functions of the positions of their vertices."""

import warp as wp

from ...detection.settings import TOLERANCE, Count
from ...kernels.gradients import with_gradients
from ...kernels.pipeline.queues import is_filled
from ...kernels.polynomials import EDGE_EDGE, VERTEX_FACE
from ...kernels.signs import FREE, HIT, UNSURE
from ...kernels.time_of_impact import Impact
from ..state.record import StepRecord
from ..state.structs import Motion, Vertices
from ..state.vectors import to_double
from .constraints import EDGE_EDGE_CONTACT, VERTEX_FACE_CONTACT, Contacts, contact_vertices, is_excluded

_TOLERANCE = wp.constant(wp.float64(TOLERANCE))
_CONTACTS = wp.constant(int(Count.CONTACTS))


@wp.func
def impact_of(
    motion: Motion,
    vertices: Vertices,
    corners: wp.vec4i,
    kind: int,
    within_tolerance: bool,
    toi: wp.float64,
    coordinates: wp.vec3d,
    normal: wp.vec3d,
) -> Impact:
    """Returns a contact as a differentiable function of the positions of its vertices."""
    found = Impact()
    found.status = wp.where(within_tolerance, HIT, UNSURE)
    found.within_tolerance = wp.where(within_tolerance, 1, 0)
    found.toi = toi
    found.coordinates = coordinates
    found.normal = normal
    return with_gradients(
        wp.where(kind == EDGE_EDGE_CONTACT, EDGE_EDGE, VERTEX_FACE),
        to_double(motion.x0[corners[0]]),
        to_double(motion.x0[corners[1]]),
        to_double(motion.x0[corners[2]]),
        to_double(motion.x0[corners[3]]),
        to_double(vertices.x1[corners[0]]),
        to_double(vertices.x1[corners[1]]),
        to_double(vertices.x1[corners[2]]),
        to_double(vertices.x1[corners[3]]),
        found,
        _TOLERANCE,
    )


@wp.func
def _count_grazing(motion: Motion, vertices: Vertices, contacts: Contacts, i: int, record: StepRecord):
    if not is_filled(i, contacts.pairs, contacts.counts, _CONTACTS) or int(contacts.status[i]) == FREE:
        return
    corners = contact_vertices(contacts, i)
    if is_excluded(motion, contacts, i, corners):
        return
    kind = wp.where(contacts.edges == 1, EDGE_EDGE_CONTACT, VERTEX_FACE_CONTACT)
    at = contacts.coordinates[i]
    impact = impact_of(
        motion, vertices, corners, kind, contacts.within_tolerance[i], contacts.toi[i], at, contacts.normal[i]
    )
    wp.atomic_add(record.counts.grazing, 0, impact.grazing)


@wp.kernel(enable_backward=False)
def count_grazing(motion: Motion, vertices: Vertices, vertex_face: Contacts, edge_edge: Contacts, record: StepRecord):
    """Counts the contacts whose gradients are clamped, see :mod:`warp_bsc.kernels.gradients`."""
    i = wp.tid()
    _count_grazing(motion, vertices, vertex_face, i, record)
    _count_grazing(motion, vertices, edge_edge, i, record)
