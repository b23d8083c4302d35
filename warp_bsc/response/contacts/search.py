"""Detection without queues, for CUDA graphs whose queues are too small: a thread decides pairs where it finds them."""

import functools

import warp as wp

from ...detection.broad.broad_phase_hierarchy import BroadPhaseHierarchy
from ...detection.broad.element_pairs import filtered_pairs, pair_functions
from ...detection.broad.face_hierarchy import FaceHierarchy, traversal_kernel
from ...detection.narrow.rules.approach import impact_on_arcs_at_distance
from ...detection.run.settings import TOLERANCE
from ...kernels.arcs import Arcs, impact_on_arcs, move_as_one, turns
from ...kernels.ccd import impact_at_distance
from ...kernels.classification import classify
from ...kernels.min_distance import clears_at_once
from ...kernels.motion import motion_and_distance, query_of, relative_motion
from ...kernels.pairs import ABOVE_SUM, distance_of_corners, ends_of
from ...kernels.pipeline.hierarchy import lowest_set_bit
from ...kernels.polynomials import VERTEX_EDGE, VERTEX_VERTEX, coplanarity
from ...kernels.signs import FREE, ROUNDOFF, certified_sign_cubic
from ...kernels.time_of_impact import Impact, impact
from ..schedule import count_contact, count_filtered
from ..state.status import Detection, SolveStatus
from ..state.structs import ContactKind, DividingPlanes, Step
from ..state.vectors import ZERO
from .collect import mark_changed
from .constraints import distances_at_start
from .face_pairs import pair_of_bit
from .first_contact import update_first_contact
from .planes_between import add_dividing_plane
from .rules import ContactClass, classify_contact, owner_of

_TOLERANCE = wp.constant(wp.float64(TOLERANCE))
_POINT_BIT, _POINTS = wp.constant(15), wp.constant(1 << 15)
"""The pair of a point and another cell, behind those of the elements of two faces."""


@wp.struct
class _Arguments:
    """Input of a thread that finds the contacts of two faces and resolves them."""

    faces: FaceHierarchy
    step: Step
    arcs: Arcs
    dividing: DividingPlanes
    status: SolveStatus


@wp.func
def _resolve(
    arguments: _Arguments,
    kind: int,
    pair: wp.vec2i,
    corners: wp.vec4i,
    owner: int,
    bound: wp.float64,
    toi: wp.float64,
    min_distance: wp.float64,
):
    """Counts a pair that is in contact, adds its dividing planes, and finds the first contact of its vertices."""
    if owner == ContactClass.FILTERED:
        count_filtered(arguments.status, arguments.step.motion.world[corners[0]])
        return
    found = classify_contact(arguments.step, kind, pair, corners, owner, bound, True)
    if found == ContactClass.CROSSED:
        wp.atomic_add(arguments.status.detection, int(Detection.EXCLUDED), 1)
    if found == ContactClass.OF_BODIES:
        wp.atomic_add(arguments.status.detection, int(Detection.OF_BODIES), 1)
        mark_changed(arguments.step, arguments.status, corners)
    if found != ContactClass.OURS:
        return
    count_contact(arguments.status, arguments.step.motion.world[corners[0]])
    add_dividing_plane(arguments.step, corners, kind, min_distance, arguments.dividing, True)
    mark_changed(arguments.step, arguments.status, corners)
    for j in range(4):
        update_first_contact(arguments.step.vertices, corners[j], toi, ContactKind.NONE, 0)


@wp.func
def _decide_distance(arguments: _Arguments, kind: int, pair: wp.vec2i, corners: wp.vec4i, owner: int):
    """Resolves a pair if it comes nearer than it may."""
    motion = arguments.step.motion
    a0, b0, c0, d0, a1, b1, c1, d1 = ends_of(motion.x0, arguments.step.vertices.x1, corners)
    most = distance_of_corners(kind, corners, motion.distances.radius)
    relative, scaled = motion_and_distance(kind, a0, b0, c0, d0, a1, b1, c1, d1, most, ROUNDOFF)
    if clears_at_once(relative, scaled):
        return
    start, kept = distances_at_start(motion, corners, kind)
    result = impact_at_distance(kind, a0, b0, c0, d0, a1, b1, c1, d1, kept, ROUNDOFF, True, _TOLERANCE)
    if result.status != FREE:
        _resolve(arguments, kind, pair, corners, owner, start, result.toi, kept)


@wp.func
def _decide_pair(arguments: _Arguments, kind: int, pair: wp.vec2i, corners: wp.vec4i, owner: int):
    """Resolves a pair if it is in contact."""
    a0, b0, c0, d0, a1, b1, c1, d1 = ends_of(arguments.step.motion.x0, arguments.step.vertices.x1, corners)
    relative = relative_motion(kind, a0, b0, c0, d0, a1, b1, c1, d1, ROUNDOFF)
    y = coplanarity(relative)
    if certified_sign_cubic(y.k, y.bound) != 0:
        return
    status = classify(relative, y)
    if status == FREE:
        return
    result = impact(relative, y, status, _TOLERANCE)
    if result.status != FREE:
        _resolve(arguments, kind, pair, corners, owner, result.toi, result.toi, ZERO)


@functools.cache
def _arc_function(keep_distances: bool) -> wp.Function:
    """Returns the function for pairs with a turning vertex: with distances or without, each is large to compile."""

    @wp.func
    def decide_on_arcs(arguments: _Arguments, kind: int, pair: wp.vec2i, corners: wp.vec4i, owner: int):
        """Resolves a pair with a turning vertex if it is in contact on its arcs, or comes nearer there than it may."""
        motion, arcs = arguments.step.motion, arguments.arcs
        a0, b0, c0, d0, a1, b1, c1, d1 = ends_of(motion.x0, arguments.step.vertices.x1, corners)
        most = distance_of_corners(kind, corners, arcs.deviation)
        if wp.static(keep_distances):
            most = ABOVE_SUM * (most + distance_of_corners(kind, corners, motion.distances.radius))
        relative, scaled = motion_and_distance(kind, a0, b0, c0, d0, a1, b1, c1, d1, most, ROUNDOFF)
        if clears_at_once(relative, scaled):
            return
        start = ZERO
        kept = ZERO
        result = Impact()
        if wp.static(keep_distances):
            start, kept = distances_at_start(motion, corners, kind)
            result = impact_on_arcs_at_distance(kind, corners, motion.x0, arguments.step.vertices.x1, arcs, kept)
        else:
            query = query_of(a0, b0, c0, d0, a1, b1, c1, d1)
            result = impact_on_arcs(kind, corners, query, arcs, ZERO)
            start = result.toi
        if result.status != FREE:
            _resolve(arguments, kind, pair, corners, owner, start, result.toi, kept)

    return decide_on_arcs


@wp.func
def _point_pair(mesh: FaceHierarchy, point: int, other: int):
    """Returns kind, elements and vertices of a pair of a point and another cell, at two places; kind -1 if none."""
    p = mesh.faces[point, 0]
    q = mesh.faces[other, 0]
    if mesh.order[other] >= mesh.point_start:
        return VERTEX_VERTEX, wp.vec2i(p, q), wp.vec4i(p, q, q, q)
    if mesh.order[other] >= mesh.face_count:
        return VERTEX_EDGE, wp.vec2i(p, mesh.face_edges[other, 0]), wp.vec4i(p, q, mesh.faces[other, 1], q)
    return -1, wp.vec2i(), wp.vec4i()


@functools.cache
def _kernel(keep_distances: bool, padded: bool, on_arcs: bool) -> wp.Kernel:
    """The kernel, made where it is first needed, as it takes long to compile."""
    decide, decide_on_arcs = _decide_distance if keep_distances else _decide_pair, _arc_function(keep_distances)
    element_pairs = pair_functions(padded, False).element_pairs

    @wp.func
    def visit(place: int, first: int, found: wp.uint32, arguments: _Arguments):
        mesh = arguments.faces
        while found != wp.uint32(0):
            other = first + lowest_set_bit(found)
            found = found & (found - wp.uint32(1))
            left = element_pairs(mesh, place, other)
            left = left & ~filtered_pairs(mesh, place, other, left)
            point = int(-1)
            if wp.static(keep_distances):
                if mesh.order[place] >= mesh.point_start:
                    point = place
                elif mesh.order[other] >= mesh.point_start:
                    point = other
                if point >= 0 and place != other:
                    left = left | _POINTS
            while left != 0:  # one body for all, which is large
                bit = lowest_set_bit(wp.uint32(left))
                left = left & (left - 1)
                kind, pair, corners = pair_of_bit(mesh, place, other, wp.where(bit < _POINT_BIT, bit, 0))
                if wp.static(keep_distances):
                    if bit == _POINT_BIT:
                        kind, pair, corners = _point_pair(mesh, point, place + other - point)
                owner = int(ContactClass.NONE)
                if kind >= 0:
                    owner = owner_of(arguments.step.motion, corners)
                straight = bool(True)
                if wp.static(on_arcs):
                    if owner != ContactClass.NONE:
                        if turns(arguments.arcs, corners):
                            straight = False
                            if not move_as_one(arguments.arcs, corners):
                                decide_on_arcs(arguments, kind, pair, corners, owner)
                if owner != ContactClass.NONE and straight:
                    decide(arguments, kind, pair, corners, owner)

    # by default, 3, NVRTC takes 1.7 times as long
    return traversal_kernel(visit, _Arguments, padded, optimization_level=2)


def find_contacts_without_queues(
    broad_phase: BroadPhaseHierarchy, step: Step, arcs: Arcs, dividing: DividingPlanes, status: SolveStatus
) -> None:
    """Finds all contacts of the motion that a broad phase has fitted last, as a whole, however many there are.

    Counts them, adds dividing planes as far as they fit, and finds the first contact of each vertex. Allocates nothing
    and does not synchronize. Slower than the detector, as neighbouring threads decide pairs of different difficulty.
    """
    arguments = _Arguments()
    arguments.faces, arguments.step, arguments.arcs = broad_phase.hierarchy, step, arcs
    arguments.dividing, arguments.status = dividing, status
    kernel = _kernel(bool(step.motion.distances.radius), broad_phase.is_padded, bool(arcs.turning))
    broad_phase.traverse(kernel, arguments)
