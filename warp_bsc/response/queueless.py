"""Detection without queues, for CUDA graphs whose queues are too small: a thread decides pairs where it finds them."""

import functools

import warp as wp

from ..detection.broad_phase_hierarchy import (
    BroadPhaseHierarchy,
    FaceHierarchy,
    overlapping_edges,
    overlapping_vertices,
    traversal_kernel,
)
from ..detection.settings import TOLERANCE
from ..kernels.classification import classify
from ..kernels.motion import relative_motion
from ..kernels.pipeline.hierarchy import lowest_place
from ..kernels.polynomials import EDGE_EDGE, VERTEX_FACE, coplanarity
from ..kernels.signs import FREE, ROUNDOFF, certified_sign_cubic
from ..kernels.time_of_impact import impact
from .buffers import Motion, Progress, Vertices
from .constraints import NO_CONSTRAINT, count_contact, update_first_contact
from .dividing_planes import DividingPlanes, add_dividing_plane
from .exclusion import Connectivity, bodies_meet, crossed_at_start, is_movable

__all__ = ["find_contacts_without_queues"]

_TOLERANCE = wp.constant(wp.float64(TOLERANCE))


@wp.struct
class _Arguments:
    """What a thread needs in order to find the contacts of two faces and to act on them."""

    faces: FaceHierarchy
    mesh: Connectivity
    motion: Motion
    vertices: Vertices
    dividing: DividingPlanes
    progress: Progress
    separation: wp.float64


@wp.func
def _next(corner: int) -> int:
    return wp.where(corner == 2, 0, corner + 1)


@wp.func
def _decide_pair(arguments: _Arguments, kind: int, pair: wp.vec2i, corners: wp.vec4i):
    """Counts a pair that is in contact, adds its dividing planes, and finds the first contact of its vertices."""
    motion = arguments.motion
    movable = is_movable(motion, corners)
    if not movable and not bodies_meet(motion, corners):
        return
    x0 = motion.x0
    x1 = arguments.vertices.x1
    relative = relative_motion(
        kind,
        x0[corners[0]],
        x0[corners[1]],
        x0[corners[2]],
        x0[corners[3]],
        x1[corners[0]],
        x1[corners[1]],
        x1[corners[2]],
        x1[corners[3]],
        ROUNDOFF,
    )
    y = coplanarity(relative)
    if certified_sign_cubic(y.k, y.bound) != 0:
        return
    status = classify(relative, y)
    if status == FREE:
        return
    result = impact(relative, y, status, _TOLERANCE)
    if result.status == FREE:
        return
    edges = wp.where(kind == EDGE_EDGE, 1, 0)
    if crossed_at_start(motion, arguments.mesh, edges, pair, result.toi):
        wp.atomic_add(arguments.progress.status.crossed_hits, 0, wp.where(movable, 1, 0))
        return
    if not movable:
        wp.atomic_add(arguments.progress.status.body_hits, 0, 1)
        for j in range(4):
            arguments.vertices.changed[corners[j]] = 1
        return
    count_contact(arguments.progress, motion.world[corners[0]])
    add_dividing_plane(motion, arguments.vertices, corners, edges, arguments.separation, arguments.dividing, True)
    for j in range(4):
        arguments.vertices.changed[corners[j]] = 1
        update_first_contact(arguments.vertices, corners[j], result.toi, NO_CONSTRAINT, 0)


@wp.func
def _decide_faces(arguments: _Arguments, place: int, other: int):
    """Decides all pairs of elements that two faces represent."""
    mesh = arguments.faces
    left = overlapping_vertices(mesh, place, other, False) >> 3
    left = left | ((overlapping_vertices(mesh, other, place, False) >> 3) << 3)
    left = left | ((overlapping_edges(mesh, place, other, False) >> 9) << 6)
    while left != 0:  # one body for all, which is large
        bit = lowest_place(wp.uint32(left))
        left = left & (left - 1)
        kind = VERTEX_FACE
        pair = wp.vec2i()
        corners = wp.vec4i()
        if bit < 6:
            of = wp.where(bit < 3, place, other)
            face = wp.where(bit < 3, other, place)
            vertex = mesh.faces[of, bit % 3]
            pair = wp.vec2i(vertex, mesh.order[face])
            corners = wp.vec4i(vertex, mesh.faces[face, 0], mesh.faces[face, 1], mesh.faces[face, 2])
        else:
            kind = EDGE_EDGE
            side = (bit - 6) / 3
            other_side = (bit - 6) % 3
            pair = wp.vec2i(mesh.face_edges[place, side], mesh.face_edges[other, other_side])
            corners = wp.vec4i(
                mesh.faces[place, side],
                mesh.faces[place, _next(side)],
                mesh.faces[other, other_side],
                mesh.faces[other, _next(other_side)],
            )
        _decide_pair(arguments, kind, pair, corners)


@wp.func
def _visit(place: int, first: int, found: wp.uint32, arguments: _Arguments):
    while found != wp.uint32(0):
        _decide_faces(arguments, place, first + lowest_place(found))
        found = found & (found - wp.uint32(1))


@functools.cache
def _kernel() -> wp.Kernel:
    """The kernel, made where it is first needed, as it takes long to compile."""
    return traversal_kernel(_visit, _Arguments)


def find_contacts_without_queues(
    broad_phase: BroadPhaseHierarchy,
    mesh: Connectivity,
    motion: Motion,
    vertices: Vertices,
    dividing: DividingPlanes,
    progress: Progress,
    separation: float,
) -> None:
    """Finds all contacts of the motion whose boxes a broad phase has fitted last, however many there are.

    Counts them, adds dividing planes as far as they fit, and finds the first contact of each vertex. Allocates nothing
    and does not synchronize. Slower than the detector, as neighbouring threads decide pairs of different difficulty.

    Args:
        broad_phase: The broad phase, fitted to all of the motion.
        mesh: The connectivity of its mesh.
        motion: The motion that is wanted.
        vertices: The vertices as they are moved.
        dividing: The dividing planes.
        progress: The progress of the response.
        separation: Distance that projection moves contacts apart [m].
    """
    arguments = _Arguments()
    arguments.faces, arguments.mesh, arguments.motion = broad_phase.hierarchy, mesh, motion
    arguments.vertices, arguments.dividing, arguments.progress = vertices, dividing, progress
    arguments.separation = wp.float64(separation)
    broad_phase.traverse(_kernel(), arguments)
