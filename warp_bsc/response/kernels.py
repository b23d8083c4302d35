"""Kernels between a detection and the next: the decision whether to iterate again, and the truncation of paths."""

import warp as wp

from .buffers import FROZEN, NEVER, TRUNCATED, Constraints, Motion, Progress, Vertices
from .constraints import (
    EDGE_EDGE_CONTACT,
    MAX_TRUNCATIONS,
    PLANE_CONTACT,
    TIME_UNITS,
    Contacts,
    contact_vertices,
    to_double,
    to_single,
    truncated_path,
)
from .step_record import NO_CONTACT, StepRecord, begin_iteration, is_recording

__all__ = ["decide", "drop_if_full", "freeze_undetected", "record_offsets", "truncate_vertices"]

_KERNEL = {"enable_backward": False}


@wp.kernel(**_KERNEL)
def drop_if_full(constraints: Constraints, record: StepRecord, needed: int):
    """Drops all constraints if fewer than ``needed`` more fit, which a detection might add."""
    if constraints.count[0] > constraints.vertices.shape[0] - needed:
        constraints.count[0] = 0
        if is_recording(record):
            record.counts.dropped[0] = 1


@wp.kernel(**_KERNEL)
def record_offsets(constraints: Constraints, progress: Progress, record: StepRecord, after: int):
    """Records the offsets of an iteration, or those after the last; iterations that freeze share one offset."""
    last = progress.max_iterations + MAX_TRUNCATIONS + 1
    iteration = progress.status.iteration[0]
    if after == 1 or iteration <= last:
        begin_iteration(record, wp.min(iteration, last) + after, constraints.count[0])


@wp.kernel(**_KERNEL)
def decide(progress: Progress, counts: wp.array[wp.int64], capacities: wp.array[wp.int64]):
    """Decides from the contacts counted whether the motion is certified, and whether another iteration is needed."""
    overflowed = bool(False)
    for i in range(counts.shape[0]):
        overflowed = overflowed or counts[i] > capacities[i]
    status = progress.status
    hits = status.hits[0]
    status.hits[0] = 0
    status.remaining[0] = hits
    if status.iteration[0] == 0:
        status.first_hits[0] = status.first_hits[0] + hits
    stuck = status.iteration[0] > progress.max_iterations + MAX_TRUNCATIONS and status.newly_frozen[0] == 0
    status.newly_frozen[0] = 0
    status.certified[0] = wp.where(hits == 0 and not overflowed, 1, 0)
    status.undetected[0] = wp.where(overflowed, 1, 0)
    status.active[0] = wp.where(hits == 0 or overflowed or stuck, 0, 1)
    status.iteration[0] = status.iteration[0] + status.active[0]


@wp.func
def _record_truncation(
    vertices: Vertices, record: StepRecord, vertex: int, cuts: bool, time: wp.float64, first: int, contacts: Contacts
):
    """Records the end of a path before it is truncated before its first contact, or before the vertex is frozen."""
    entry = wp.atomic_add(record.counts.truncations, 0, 1)
    if entry >= record.vertex.shape[0]:
        return
    record.vertex[entry] = vertex
    record.end[entry] = vertices.x1[vertex]
    kind = wp.where(cuts, first & 3, NO_CONTACT)
    i = first >> 2
    record.kind[entry] = kind
    record.contact[entry] = wp.vec4i(vertex, i, 0, 0)
    record.toi[entry] = time
    if kind != PLANE_CONTACT and kind != NO_CONTACT:
        record.contact[entry] = contact_vertices(contacts, i)
        record.localized[entry] = contacts.localized[i]
        record.toi[entry] = contacts.toi[i]
        record.coordinates[entry] = contacts.coordinates[i]
        record.normal[entry] = contacts.normal[i]


@wp.kernel(**_KERNEL)
def truncate_vertices(
    motion: Motion,
    vertices: Vertices,
    progress: Progress,
    record: StepRecord,
    vertex_face: Contacts,
    edge_edge: Contacts,
    dt: wp.float64,
):
    """Truncates the path of each vertex before its first contact; after MAX_TRUNCATIONS iterations, freezes it."""
    vertex = wp.tid()
    key = vertices.first_contact[vertex]
    if key == NEVER:
        return
    vertices.first_contact[vertex] = NEVER
    if motion.inverse_mass[vertex] == 0.0:
        return
    time = wp.float64(key >> wp.int64(32)) / TIME_UNITS
    cuts = progress.status.iteration[0] <= progress.max_iterations + MAX_TRUNCATIONS
    if is_recording(record) and (cuts or vertices.outcome[vertex] & FROZEN == 0):
        first = int(key & wp.int64(0xFFFFFFFF))
        if first & 3 == EDGE_EDGE_CONTACT:
            _record_truncation(vertices, record, vertex, cuts, time, first, edge_edge)
        else:
            _record_truncation(vertices, record, vertex, cuts, time, first, vertex_face)
    if cuts:
        x0 = to_double(motion.x0[vertex])
        path = truncated_path(x0, to_double(vertices.x1[vertex]), time)
        vertices.x1[vertex] = to_single(x0 + path)
        vertices.changed[vertex] = 1
        vertices.velocity[vertex] = to_single(path / dt)
        vertices.outcome[vertex] = vertices.outcome[vertex] | TRUNCATED
    elif vertices.outcome[vertex] & FROZEN == 0:
        vertices.x1[vertex] = motion.x0[vertex]
        vertices.changed[vertex] = 1
        vertices.velocity[vertex] = wp.vec3()
        vertices.outcome[vertex] = vertices.outcome[vertex] | FROZEN
        wp.atomic_add(progress.status.newly_frozen, 0, 1)


@wp.kernel(**_KERNEL)
def freeze_undetected(motion: Motion, vertices: Vertices, progress: Progress):
    """Freezes all vertices if a detection was incomplete: positions were not finite, or a buffer overflowed."""
    vertex = wp.tid()
    if progress.status.undetected[0] == 1 and motion.inverse_mass[vertex] > 0.0:
        vertices.x1[vertex] = motion.x0[vertex]
        vertices.velocity[vertex] = wp.vec3()
        vertices.outcome[vertex] = vertices.outcome[vertex] | FROZEN
