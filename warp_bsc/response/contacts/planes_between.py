"""Adds dividing planes between two elements."""

import warp as wp

from ...kernels.pairs import firsts_of
from ...kernels.pipeline.queues import take_slot_int
from ..state.structs import DividingPlanes, Motion, Step
from ..state.vectors import HALF, ZERO, to_double
from .closest_points import closest_direction
from .rules import inverse_mass_of

FAR = wp.constant(wp.float64(1.0e300))
"""Farther than anything [m]."""


@wp.func
def _add_node(planes: DividingPlanes, vertex: int, node: int):
    """Puts a node before the list of a vertex."""
    planes.next[node / 2] = wp.atomic_exch(planes.first, vertex, node)


@wp.func
def add_plane(
    motion: Motion,
    planes: DividingPlanes,
    corners: wp.vec4i,
    split: int,
    normal: wp.vec3d,
    distance: wp.float64,
    half: wp.float64,
) -> int:
    """Adds a plane with a unit normal to the lists of those of up to four vertices, -1 for none, that can be moved.

    Vertices before ``split`` stay above the plane, the others below; see :class:`.DividingPlanes`. Where it does not
    fit, they lack one. Returns the index of the plane, -1 if it does not fit.
    """
    plane = take_slot_int(planes.count)
    fits = plane < planes.place.shape[0]
    if fits:
        planes.vertices[plane] = corners
        planes.place[plane] = wp.vec4d(normal[0], normal[1], normal[2], ZERO)
        planes.distance[plane] = distance
        planes.split[plane] = wp.int8(split)
        if planes.half:
            planes.half[plane] = half
    for j in range(4):
        if corners[j] >= 0 and inverse_mass_of(motion, corners[j]) > 0.0:
            if fits:
                _add_node(planes, corners[j], 8 * plane + 2 * j + wp.where(j < split, 0, 1))
            else:
                planes.lacks[corners[j]] = 1
    return wp.where(fits, plane, -1)


@wp.func
def add_solid(motion: Motion, planes: DividingPlanes, vertex: int, normal: wp.vec3d, offset: wp.float64, margin: float):
    """Adds the surface of the solid below an infinite plane, which a vertex stays above, and which does not move."""
    plane = add_plane(motion, planes, wp.vec4i(vertex, -1, -1, -1), 1, normal, ZERO, ZERO)
    if plane >= 0:
        planes.place[plane] = wp.vec4d(normal[0], normal[1], normal[2], offset)
        planes.margin[plane] = margin


@wp.func
def has_planes(planes: DividingPlanes, vertex: int):
    """Returns whether a vertex has planes, and whether it has one for each of its contacts.

    Contacts of elements that touch at the start have none, nor do those whose plane did not fit.
    """
    has_any = planes.first[vertex] >= 0
    return has_any, has_any and planes.lacks[vertex] == 0


@wp.func
def _reach(step: Step, corners: wp.vec4i, begin: int, end: int, origin: wp.vec3d, normal: wp.vec3d, half: wp.float64):
    """Returns how far the vertices from ``begin`` to ``end`` reach against a normal, from an origin [m].

    They reach farther by ``half`` of the distance that they are to keep. The second is how far at the start, the first
    wherever the first pass may take them, no farther than the ball around a path: this is what projection onto a convex
    set does to the end of a path that starts in it. Where later passes take them farther, the next detection finds it.
    """
    start = FAR
    anywhere = FAR
    for j in range(begin, end):
        vertex = corners[j]
        x0 = to_double(step.motion.x0[vertex])
        path = to_double(step.vertices.x1[vertex]) - x0
        before = wp.dot(normal, x0 - origin) - half
        start = wp.min(start, before)
        anywhere = wp.min(anywhere, before + HALF * (wp.dot(normal, path) - wp.length(path)))
    return anywhere, start


@wp.func
def add_dividing_plane(
    step: Step, corners: wp.vec4i, kind: int, min_distance: wp.float64, planes: DividingPlanes, is_contact: bool
) -> bool:
    """Adds a plane between two elements to the lists of those of their vertices that can be moved; returns whether.

    It lies across the shortest vector between them at the start; :mod:`.solve.plane_placement` places it. No plane
    is added between elements that touch at the start, nor between elements that have no contact and that no plane could
    bring together. Half of the distance that the elements must keep, ``min_distance`` [m], is on either side.
    """
    motion = step.motion
    normal = closest_direction(motion, corners, kind)
    origin = to_double(motion.x0[corners[3]])
    split = firsts_of(kind)
    half = HALF * min_distance
    above, start_above = _reach(step, corners, 0, split, origin, normal, half)
    below, start_below = _reach(step, corners, split, 4, origin, -normal, half)
    distance = start_above + start_below
    if not is_contact and (distance <= ZERO or above + below > ZERO):
        return False
    if distance <= ZERO:
        for j in range(4):
            if inverse_mass_of(motion, corners[j]) > 0.0:
                planes.lacks[corners[j]] = 1
        return False
    return add_plane(motion, planes, corners, split, normal, distance, half) >= 0
