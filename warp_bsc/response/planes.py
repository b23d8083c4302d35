"""Infinite planes: each bounds a solid half-space, which vertices stay out of.

Vertices of bodies stay as deep as they began, as the inner solver may have soft contacts of its own with planes, and
as deep as it wanted them, unless the response keeps bodies apart from static shapes. Only corrections by the response
cannot push them in.
"""

import warp as wp

from .buffers import Constraints, Motion, Progress, Vertices
from .constraints import (
    PLANE_CONTACT,
    TOUCH,
    add_constraint,
    contact_friction,
    count_contact,
    feasible,
    inverse_mass_of,
    is_dividing,
    is_on_body,
    to_double,
    update_first_contact,
    widened,
)
from .dividing_planes import DividingPlanes, add_plane
from .exclusion import collides

__all__ = [
    "MovingPlanes",
    "collect_penetrations",
    "level",
    "offset_from",
    "signed_distance",
    "time_of_entry",
    "transformed_plane",
]

_ROUNDOFF = wp.constant(wp.float64(2.0**-50))
_TINY = wp.constant(wp.float64(1e-300))
_MARGIN = wp.constant(wp.float64(0.1))
"""Distance from a plane, as a share of the separation, that a vertex gets if projection has not kept it out."""
_NEARER = wp.constant(wp.float64(0.25))
"""Most of that, as a share of how far the vertex would be where it stands still: see :mod:`.dividing_planes`."""
_DEEPER = wp.constant(wp.float64(0.05))
"""Most that a vertex of a body goes deeper into a solid in a step, as a share of the separation: poses are rounded."""
_KEPT = wp.constant(wp.float64(1.0 - 2.0**-30))
"""Share of its distance at the start that a particle keeps."""
_ZERO = wp.constant(wp.float64(0.0))

_KERNEL = {"enable_backward": False}


@wp.struct
class MovingPlanes:
    """Planes at the start and at the end of a step, each as the unit normal out of its solid and its offset [m].

    Solids are convex, and so is the region of a vertex: a vertex that is outside at both ends is outside between.
    """

    start: wp.array[wp.vec4d]
    end: wp.array[wp.vec4d]
    friction: wp.array[float]
    world: wp.array[int]  # -1 for all
    shape: wp.array[int]
    body: wp.array[int]  # that the plane moves with, -1 for none


@wp.func
def transformed_plane(point: wp.vec3, normal: wp.vec3, body: int, body_q: wp.array[wp.transform]) -> wp.vec4d:
    """Returns a plane where its body is, if it has one, as its unit normal and its offset [m]."""
    if body >= 0:
        point = wp.transform_point(body_q[body], point)
        normal = wp.transform_vector(body_q[body], normal)
    unit = wp.normalize(to_double(normal))
    return wp.vec4d(unit[0], unit[1], unit[2], wp.dot(unit, to_double(point)))


@wp.func
def signed_distance(plane: wp.vec4d, x: wp.vec3):
    """Returns the distance of a point from a plane [m], negative in the solid, and a bound on its rounding error.

    Each of three products, and each of three sums, is off by 2^-53 of itself at most, and by 2^-1075 where it
    underflows.
    """
    value = -plane[3]
    magnitude = wp.abs(plane[3])
    for axis in range(3):
        term = plane[axis] * wp.float64(x[axis])
        value += term
        magnitude += wp.abs(term)
    return value, _ROUNDOFF * magnitude + _TINY


@wp.func
def time_of_entry(before: wp.float64, after: wp.float64) -> wp.float64:
    """Returns when a vertex enters a solid, in [0, 1], from its signed distances at the start and end of a step."""
    return wp.min(wp.max(before, _ZERO) / wp.max(before - after, _TINY), wp.float64(1.0))


@wp.func
def _stops(motion: Motion, planes: MovingPlanes, i: int, vertex: int) -> bool:
    """Returns whether a plane is to stop a vertex: not one of its own body, or of a shape that it passes."""
    if not is_on_body(motion, vertex):
        return True
    body = motion.bodies.of_vertex[vertex]
    shape = motion.bodies.shape[vertex - motion.bodies.particle_count]
    return body != planes.body[i] and collides(motion.bodies, shape, planes.shape[i])


@wp.func
def level(motion: Motion, planes: MovingPlanes, i: int, vertex: int) -> wp.float64:
    """Returns the distance from a plane that a vertex is kept at [m]: 0, or less for one of a body, see the module."""
    least = _ZERO
    if is_on_body(motion, vertex):
        before, _error = signed_distance(planes.start[i], motion.x0[vertex])
        least = wp.min(before, _ZERO)
        if motion.bodies.responds == 0:
            wanted, _error_wanted = signed_distance(planes.end[i], motion.x1[vertex])
            least = wp.min(wanted, least)
    return least


@wp.func
def offset_from(
    motion: Motion, planes: MovingPlanes, i: int, vertex: int, progress: Progress, separation: wp.float64
) -> wp.float64:
    """Returns the offset that constraints move a vertex to that a plane stops, without a minimum distance [m]."""
    distance = level(motion, planes, i, vertex)
    if distance == _ZERO:
        before, _error = signed_distance(planes.start[i], motion.x0[vertex])
        distance = feasible(motion, wp.vec4i(vertex), widened(separation, progress), before, separation)
    return planes.end[i][3] + distance


@wp.func
def _distances_from_plane(motion: Motion, planes: MovingPlanes, i: int, vertex: int):
    """Returns the distance that a vertex is kept at from a plane, and how much farther away it is near [m].

    Like a pair, a particle may come as near as it was at the start, see :mod:`warp_bsc.detection.approach_phase`.
    """
    if is_on_body(motion, vertex):
        return level(motion, planes, i, vertex), _ZERO
    if not motion.distances.radius:
        return _ZERO, _ZERO
    before, error = signed_distance(planes.start[i], motion.x0[vertex])
    least = wp.min(motion.distances.radius[vertex] + motion.distances.of_planes, _KEPT * (before - error))
    return wp.max(least, _ZERO), motion.distances.reach


@wp.kernel(**_KERNEL)
def collect_penetrations(
    motion: Motion,
    vertices: Vertices,
    planes: MovingPlanes,
    constraints: Constraints,
    dividing: DividingPlanes,
    progress: Progress,
    separation: wp.float64,
    ahead: bool,
):
    """Adds constraints for vertices that may have entered solids; after the last projection, finds when they did.

    Vertices that were inside at the start are excluded, like pairs of elements that crossed. Ahead of the first
    detection, contacts are counted as those of the wanted motion only.
    """
    vertex = wp.tid()
    world = motion.world[vertex]
    if inverse_mass_of(motion, vertex) == 0.0:
        return
    for i in range(planes.end.shape[0]):
        if planes.world[i] >= 0 and planes.world[i] != world:
            continue
        after, error_after = signed_distance(planes.end[i], vertices.x1[vertex])
        least, reach = _distances_from_plane(motion, planes, i, vertex)
        if not (after <= least + wp.max(reach, error_after)):  # nor where the plane is not finite
            continue
        near = after > least + error_after  # only
        if near and not ahead:
            continue
        if least < _ZERO and after >= least - _DEEPER * separation:
            continue
        if not _stops(motion, planes, i, vertex):
            continue
        before, error_before = signed_distance(planes.start[i], motion.x0[vertex])
        before -= least
        after -= least
        if before < -error_before:
            if not ahead:
                wp.atomic_add(progress.status.crossed_hits, 0, 1)
            continue
        if ahead:
            wp.atomic_add(progress.status.first_hits, 0, wp.where(near, 0, 1))
        else:
            count_contact(progress, world)
            vertices.changed[vertex] = 1
            if progress.status.iteration[0] == 0 and is_on_body(motion, vertex):
                progress.fast[world] = 1  # as between elements, see kernels.collect_contacts
        plane = planes.end[i]
        normal = wp.vec3d(plane[0], plane[1], plane[2])
        multiplier = wp.vec3d()
        if is_dividing(progress, world, progress.status.iteration[0]):
            update_first_contact(vertices, vertex, time_of_entry(before, after), PLANE_CONTACT, i)
            if not dividing.first:
                continue
            stays, _error_stays = signed_distance(plane, motion.x0[vertex])
            margin = wp.min(_MARGIN * separation, _NEARER * wp.max(stays - least, _ZERO))
            offset = plane[3] + least + wp.min(wp.float64(2.0) * error_after, margin)
            if least < _ZERO:
                offset = plane[3] + least - _DEEPER * separation
            add_plane(dividing, wp.vec4i(vertex, -1, -1, -1), 1, normal, offset, margin, _ZERO)
            multiplier = TOUCH * normal
        else:
            progress.status.projecting[0] = 1
        place = add_constraint(
            motion,
            vertices,
            constraints,
            wp.vec4i(vertex),
            wp.vec4d(wp.float64(1.0), _ZERO, _ZERO, _ZERO),
            normal,
            offset_from(motion, planes, i, vertex, progress, separation) + wp.max(least, _ZERO),
            contact_friction(motion.friction[vertex], planes.friction[i]),
            1,
            PLANE_CONTACT,
            True,
            _ZERO,
            multiplier,
            wp.max(least, _ZERO),
        )
        if place < constraints.plane.shape[0]:
            constraints.plane[place] = i
