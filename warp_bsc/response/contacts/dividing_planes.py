"""Adds dividing planes between two elements."""

import warp as wp

from ...kernels.pipeline.pairs import firsts_of
from ...kernels.pipeline.queues import take_slot_int
from ..state.structs import DividingPlanes, Step
from ..state.vectors import HALF, ZERO, relative, to_double
from ..tuning import CLOSE_MARGIN, MARGIN, SLACK, SMALL_DISTANCE
from .closest import closest_direction, closest_vector
from .rules import inverse_mass_of

FAR = wp.constant(wp.float64(1.0e300))
"""Farther than anything [m]."""
INCOMPLETE = wp.constant(-2)
"""End of a list that lacks a plane."""


@wp.func
def _add_node(planes: DividingPlanes, vertex: int, node: int):
    """Puts a node before the list of a vertex."""
    after = wp.atomic_exch(planes.first, vertex, node)
    if node >= 0:
        planes.next[node] = after


@wp.func
def add_plane(
    planes: DividingPlanes,
    corners: wp.vec4i,
    split: int,
    normal: wp.vec3d,
    offset: wp.float64,
    margin: wp.float64,
    half: wp.float64,
):
    """Adds a plane with a unit normal to the lists of up to four vertices, -1 for none; see :class:`.DividingPlanes`.

    Vertices before ``split`` stay above the plane, the others below. Where it does not fit, their lists end in
    INCOMPLETE.
    """
    plane = take_slot_int(planes.count)
    fits = plane < planes.normal.shape[0]
    if fits:
        planes.normal[plane] = normal
        planes.offset[plane] = offset
        planes.margin[plane] = float(margin)
        planes.split[plane] = wp.int8(split)
        if planes.half:
            planes.half[plane] = half
    for j in range(4):
        if corners[j] >= 0:
            _add_node(planes, corners[j], wp.where(fits, 4 * plane + j, INCOMPLETE))


@wp.func
def has_planes(planes: DividingPlanes, vertex: int):
    """Returns whether a vertex has planes, and whether it has one for each of its contacts.

    Contacts of elements that touch at the start have none, nor do those whose plane did not fit.
    """
    if not planes.first:
        return False, False
    node = planes.first[vertex]
    has_any = node >= 0
    while node >= 0:
        node = planes.next[node]
    return has_any, has_any and node != INCOMPLETE


@wp.struct
class _Side:
    """How far one of two elements reaches towards the other, along the vector between them [m]."""

    start: wp.float64  # at the start
    end: wp.float64  # at the end
    fixed: wp.float64  # those of its vertices that cannot be moved, at the end
    reach: wp.float64  # wherever planes may take it
    inverse_mass: wp.float64  # sum over its vertices


@wp.func
def _side(
    step: Step, corners: wp.vec4i, begin: int, end: int, origin: wp.vec3d, normal: wp.vec3d, half: wp.float64
) -> _Side:
    """Returns how far the vertices from ``begin`` to ``end`` reach against a normal.

    They reach farther by ``half`` of the distance that they are to keep. Planes take a vertex no farther than the ball
    around its path: this is what projection onto a convex set does to the end of a path that starts in it.
    """
    side = _Side()
    side.reach = FAR
    side.start = FAR
    side.end = FAR
    side.fixed = FAR
    for j in range(begin, end):
        vertex = corners[j]
        start = to_double(step.motion.x0[vertex])
        path = to_double(step.vertices.x1[vertex]) - start
        x0 = wp.dot(normal, start - origin) - half
        x1 = x0 + wp.dot(normal, path)
        side.start = wp.min(side.start, x0)
        side.reach = wp.min(side.reach, HALF * (x0 + x1 - wp.length(path)))
        side.end = wp.min(side.end, x1)
        inverse_mass = wp.float64(inverse_mass_of(step.motion, vertex))
        side.inverse_mass += inverse_mass
        if inverse_mass == ZERO:
            side.fixed = wp.min(side.fixed, x1)
    return side


@wp.func
def add_dividing_plane(
    step: Step,
    corners: wp.vec4i,
    kind: int,
    min_distance: wp.float64,
    planes: DividingPlanes,
    is_contact: bool,
    may_stop: bool,
) -> bool:
    """Adds a plane between two elements to the lists of those of their four vertices that can be moved.

    The plane lies where both would meet at the end by their masses, but between them at the start, and not within a
    vertex that cannot be moved. Elements that touch at the start have none, nor do those without a contact that planes
    cannot bring together. Of the distance that the elements must keep, ``min_distance`` [m], half is on either side.
    With ``may_stop``, elements get a plane that stops them although their closest points do not meet.

    Returns:
        Whether the elements meet at the end, or nearly, without planes.
    """
    motion = step.motion
    normal = closest_direction(motion, corners, kind)
    origin = to_double(motion.x0[corners[3]])
    split = firsts_of(kind)
    half = HALF * min_distance
    above = _side(step, corners, 0, split, origin, normal, half)
    below = _side(step, corners, split, 4, origin, -normal, half)
    distance = above.start + below.start
    if not is_contact and (distance <= ZERO or above.reach + below.reach > ZERO):
        return False
    movable = wp.vec4i()
    for j in range(4):
        movable[j] = wp.where(inverse_mass_of(motion, corners[j]) > 0.0, corners[j], -1)
    if distance <= ZERO:
        for j in range(4):
            if movable[j] >= 0:
                _add_node(planes, movable[j], INCOMPLETE)
        return False
    margin = wp.where(distance < SMALL_DISTANCE * step.separation, CLOSE_MARGIN, MARGIN) * distance
    least = margin + SLACK * distance
    share = above.inverse_mass / (above.inverse_mass + below.inverse_mass)
    offset = above.end + share * (-below.end - above.end)
    offset = wp.clamp(offset, least - below.start, above.start - least)
    # last, what cannot be moved decides
    offset = wp.max(wp.min(offset, above.fixed - margin), margin - below.fixed)
    if not may_stop and (above.end < offset or -below.end > offset):
        weights, _between = closest_vector(motion, corners, kind)
        if wp.dot(normal, relative(weights, corners, step.vertices.x1)) >= half + half + margin:
            return False
    add_plane(planes, movable, split, normal, wp.dot(normal, origin) + offset, margin, half)
    return above.end + below.end < margin
