"""Forces of barriers and friction as a kernel over contacts, which Warp differentiates.

The form is that of :mod:`.elements`. An element is a pair of :mod:`..contact.pairs`, or a particle near an infinite
plane. All follows from positions at both ends of the step as in the solve, in float64: the closest points, the reach of
the barrier, which depends on the distance at the start, and its stiffness. The gradient of a distance does not depend
on how closest points move, so that forces are exact; their derivatives do, and have it.
"""

import warp as wp

from ...detection.narrow.rules.approach import distances_of_pair
from ...kernels.polynomials import EDGE_EDGE
from ...response.contacts.constraints import friction_on_plane, pair_friction
from ...response.state.planes import MovingPlanes, signed_distance
from ...response.state.structs import Motion
from ...response.state.vectors import ZERO
from ..contact import barrier
from ..contact.pairs import (
    BarrierSettings,
    barrier_of,
    carrying_stiffness,
    gap_at_plane,
    reach_of,
    share_of_parallel,
    stiffness_at_plane,
    stiffness_by_mass,
)
from ..contact.system import AT_PLANE


@wp.struct
class RecordedContacts:
    """Contacts at the end of a step.

    Attributes:
        kind: Kind of each, -1 beyond their number.
        plane: The plane of a contact at one.
        fall: How far gravity moves what is at rest in the step, by world [m].
    """

    kind: wp.array[int]
    plane: wp.array[int]
    fall: wp.array[float]


@wp.func
def _friction_force(slid: wp.vec3d, normal: wp.vec3d, limit: wp.float64, smoothing: wp.float64) -> wp.vec3d:
    """Returns the force of friction against sliding, whose magnitude is at most the limit."""
    across = slid - wp.dot(slid, normal) * normal
    return -limit * barrier.friction_slope(wp.length(across), smoothing) * across


@wp.kernel
def contact_forces(
    # in
    dt: wp.float64,
    x1: wp.array3d[wp.vec3d],
    x0: wp.array3d[wp.vec3d],
    vertices: wp.array2d[int],
    contacts: RecordedContacts,
    motion: Motion,
    planes: MovingPlanes,
    settings: BarrierSettings,
    # out
    forces: wp.array3d[wp.vec3d],
):
    """Computes the forces of contacts on their corners."""
    e, row = wp.tid()
    for i in range(4):
        forces[e, row, i] = wp.vec3d()
    kind = contacts.kind[e]
    if kind < 0:
        return
    corners = wp.vec4i(vertices[e, 0], vertices[e, 1], vertices[e, 2], vertices[e, 3])
    a, b, c, d = x1[e, row, 0], x1[e, row, 1], x1[e, row, 2], x1[e, row, 3]
    p, q, r, s = x0[e, row, 0], x0[e, row, 1], x0[e, row, 2], x0[e, row, 3]
    fall = contacts.fall[motion.world[corners[0]]]
    if kind == AT_PLANE:
        plane, vertex = contacts.plane[e], corners[0]
        place = planes.end[plane]
        distance, _error = signed_distance(place, a)
        _kept, level, reach, _floor = gap_at_plane(motion, planes, settings, plane, vertex, p)
        gap = distance - level
        if gap >= reach or gap <= ZERO:
            return
        stiffness = stiffness_at_plane(motion, settings, fall, vertex, reach)
        load = -stiffness * barrier.barrier_slope(gap, reach)
        normal = wp.vec3d(place[0], place[1], place[2])
        limit = wp.float64(friction_on_plane(motion, planes, plane, vertex)) * load
        forces[e, row, 0] = load * normal + _friction_force(a - p, normal, limit, settings.smoothing)
        return
    kept = ZERO
    start = barrier.least_distance(kind, p, q, r, s)
    if motion.distances.radius:
        start, kept = distances_of_pair(motion.distances, kind, corners, p, q, r, s)
    level, reach = barrier_of(settings, start, kept, reach_of(settings, corners))
    w, distance = barrier.closest_weights_and_gap(kind, a, b, c, d)
    gap = distance - level
    if gap >= reach or gap <= ZERO:
        return
    by_mass = stiffness_by_mass(motion, settings, fall, corners, kind == EDGE_EDGE, reach)
    stiffness = carrying_stiffness(by_mass, settings, corners, reach)
    if by_mass < ZERO:
        stiffness = stiffness * share_of_parallel(a, b, c, d)
    load = -stiffness * barrier.barrier_slope(gap, reach)
    normal = (w[0] * a + w[1] * b + w[2] * c + w[3] * d) / distance
    slid = w[0] * (a - p) + w[1] * (b - q) + w[2] * (c - r) + w[3] * (d - s)
    limit = wp.float64(pair_friction(motion, corners)) * load
    force = load * normal + _friction_force(slid, normal, limit, settings.smoothing)
    forces[e, row, 0] = w[0] * force
    forces[e, row, 1] = w[1] * force
    forces[e, row, 2] = w[2] * force
    forces[e, row, 3] = w[3] * force
