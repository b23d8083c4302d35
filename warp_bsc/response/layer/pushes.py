"""Contacts in a contact layer: where they are, how deep, and what they push."""

import warp as wp

from ...detection.narrow.rings import are_within_rings
from ...detection.narrow.rules.approach import MinDistances
from ...kernels.closest import closest_weights
from ...kernels.pairs import distance_of_corners, firsts_of
from ...kernels.polynomials import EDGE_EDGE
from ..contacts.closest_points import closest_vector
from ..contacts.constraints import friction_on_plane
from ..contacts.rules import ContactClass, owner_of
from ..state.planes import MovingPlanes, is_filtered_by_plane, signed_distance
from ..state.structs import Motion, MovedBodies, body_of, can_move
from ..state.vectors import ONE, ZERO, to_double
from ..tuning import PARALLEL_IN_LAYER

_ROOT_OF_2 = wp.constant(2.0**0.5)
_ROUNDING = wp.constant(wp.float64(2.0**-40))
"""Distance up to which elements touch, as a share of their coordinates: 4,096 times what one rounds to."""


@wp.struct
class Layer:
    """The layer around a predicted motion."""

    motion: Motion
    planes: MovingPlanes
    thickness: wp.array[wp.float64]  # one number [m]
    distances: MinDistances  # of pairs [m]
    restitution: wp.array[float]  # in [0, 1]
    shares: wp.array[wp.float64]  # of vertices, then of bodies, summed over contacts, see share_of
    bodies: MovedBodies  # centres and inverse inertias where pushes act; empty if it pushes none
    changes: wp.array[wp.spatial_vectord]  # of the centres of bodies by pushes, and their turns [m, rad]
    dt: float  # length of the step [s]


@wp.func
def gains(restitution: float):
    """Returns kappa and theta of the layer for a coefficient of restitution.

    The roots of z^2 - (2 - 2 kappa + kappa theta) z + (1 - kappa + kappa theta) are rho exp(+-i pi / 4). Below a
    restitution of 1/4, theta is negative: contacts act where the motion would be somewhat later.
    """
    rho = float(0.0)
    if restitution > 0.0:  # at 0 there is no derivative
        rho = wp.sqrt(wp.sqrt(restitution))
    kappa = 1.0 + rho * (rho - _ROOT_OF_2)
    theta = rho * (2.0 * rho - _ROOT_OF_2) / kappa
    return wp.float64(kappa), wp.float64(theta)


@wp.func
def position_between(motion: Motion, vertex: int, theta: wp.float64) -> wp.vec3d:
    """Returns the position at which contacts of a vertex act [m]."""
    x1 = to_double(motion.x1[vertex])
    return x1 + theta * (to_double(motion.x0[vertex]) - x1)


@wp.func
def contact_of_pair(layer: Layer, kind: int, corners: wp.vec4i):
    """Returns the weights of four vertices in a contact, its normal, and its depth in the layer [m], 0 if it is not.

    Elements are in contact only if they are on the same sides of each other as at the start: not if they have passed,
    nor if they touch, at the start or now, so that rounding would decide on which side they are.
    """
    _kappa, theta = gains(layer.restitution[0])
    a = position_between(layer.motion, corners[0], theta)
    b = position_between(layer.motion, corners[1], theta)
    c = position_between(layer.motion, corners[2], theta)
    d = position_between(layer.motion, corners[3], theta)
    weights = closest_weights(kind, a, b, c, d)
    vector = weights[0] * a + weights[1] * b + weights[2] * c + weights[3] * d
    distance = wp.length(vector)
    depth = layer.thickness[0] + distance_of_corners(kind, corners, layer.distances.radius) - distance
    largest = wp.max(wp.max(wp.max(wp.abs(a)), wp.max(wp.abs(b))), wp.max(wp.max(wp.abs(c)), wp.max(wp.abs(d))))
    rounding = _ROUNDING * largest
    if depth <= ZERO or distance <= rounding:
        return weights, vector, ZERO
    normal = vector / distance
    if are_within_rings(corners, firsts_of(kind), layer.distances.rings):
        return weights, normal, ZERO
    if owner_of(layer.motion, corners) != ContactClass.OURS:
        return weights, normal, ZERO
    _weights, at_start = closest_vector(layer.motion, corners, kind)
    if not wp.dot(normal, at_start) > rounding:  # nor if it is not a number
        return weights, normal, ZERO
    if kind == EDGE_EDGE:
        u = b - a
        v = d - c
        sines = wp.length_sq(wp.cross(u, v))
        depth *= sines / (sines + PARALLEL_IN_LAYER * wp.length_sq(u) * wp.length_sq(v))
    return weights, normal, depth


@wp.func
def contact_with_plane(layer: Layer, plane: int, vertex: int):
    """Returns the normal of a contact of a vertex with a plane, and its depth in the layer [m], 0 if it is not."""
    motion, planes = layer.motion, layer.planes
    _kappa, theta = gains(layer.restitution[0])
    end = planes.end[plane]
    normal = wp.vec3d(end[0], end[1], end[2])
    if planes.world[plane] >= 0 and planes.world[plane] != motion.world[vertex]:
        return normal, ZERO
    if is_filtered_by_plane(motion, planes, plane, vertex):
        return normal, ZERO
    before, error = signed_distance(planes.start[plane], motion.x0[vertex])
    after, _error = signed_distance(end, motion.x1[vertex])
    min_distance = layer.distances.radius[vertex] + layer.distances.of_planes[plane]
    depth = layer.thickness[0] + min_distance - after - theta * (before - after)
    if not (depth > ZERO and before >= -error):
        return normal, ZERO
    return normal, depth


@wp.func
def share_of(layer: Layer, depth: wp.float64) -> wp.float64:
    """Returns the share of a contact of this depth where contacts divide the mass of a vertex."""
    return (depth / layer.thickness[0]) * (depth / layer.thickness[0])


@wp.func
def push_of(
    layer: Layer,
    normal: wp.vec3d,
    depth: wp.float64,
    path: wp.vec3d,
    resistance: wp.float64,
    across_resistance: wp.float64,
    friction: float,
) -> wp.vec3d:
    """Returns the push of a contact, an impulse times a time [kg m].

    Its first contact point moves along ``path`` relative to the second [m]. The resistances, along the normal and
    across it, are sums over its vertices and bodies of inverse mass, weight, and the shares of all contacts [1/kg].
    """
    kappa, _theta = gains(layer.restitution[0])
    share = share_of(layer, depth)
    along = kappa * depth * (share / resistance)
    part = share / across_resistance  # the mass that there is for this contact
    across = path - wp.dot(path, normal) * normal
    length = wp.length(across)
    if length == ZERO:
        return along * normal
    holding = wp.float64(friction) * along / (length * part)  # more than 1 if friction could stop the contact
    return along * normal - across * (part * holding / wp.sqrt(ONE + holding * holding))


@wp.func
def change_by_plane(layer: Layer, plane: int, vertex: int) -> wp.vec3d:
    """Returns what the push of a plane moves a vertex by [m], 0 if there is none."""
    motion = layer.motion
    normal, depth = contact_with_plane(layer, plane, vertex)
    resistance = wp.float64(motion.inverse_mass[vertex]) * layer.shares[vertex]
    if depth <= ZERO or resistance <= ZERO:
        return wp.vec3d()
    path = to_double(motion.x1[vertex]) - to_double(motion.x0[vertex])
    friction = friction_on_plane(motion, layer.planes, plane, vertex)
    push = push_of(layer, normal, depth, path, resistance, resistance, friction)
    return wp.float64(motion.inverse_mass[vertex]) * push


@wp.func
def body_of_side(motion: Motion, corners: wp.vec4i, side: int) -> int:
    """Returns the body of the first or second element of a pair, -1 if it is of none that can be moved."""
    body = body_of(motion, corners[3 * side])
    return wp.where(can_move(motion, body), body, -1)


@wp.func
def arm_of(layer: Layer, corners: wp.vec4i, weights: wp.vec4d, body: int) -> wp.vec3d:
    """Returns the sum of the arms of the vertices of a body, by weight [m]; the other element has another body."""
    arm = wp.vec3d()
    for j in range(4):
        if layer.motion.bodies.of_vertex[corners[j]] == body:
            arm += weights[j] * (to_double(layer.motion.x1[corners[j]]) - layer.bodies.centre[body])
    return arm


@wp.func
def resistances_of_body(layer: Layer, body: int, arm: wp.vec3d, normal: wp.vec3d):
    """Returns what a body adds to the resistances of a contact along its normal and across it [1/kg].

    The inverse mass of a body is a matrix. Across the normal counts its trace there, at least its largest eigenvalue.
    """
    inverse_inertia = layer.bodies.inverse_inertia[body]
    linear = wp.float64(layer.motion.bodies.inverse_mass[body])
    turned = wp.dot(wp.cross(inverse_inertia * wp.cross(arm, normal), arm), normal)
    trace = wp.trace(inverse_inertia) * wp.length_sq(arm) - wp.dot(arm, inverse_inertia * arm)
    share = layer.shares[layer.motion.x0.shape[0] + body]
    return share * (linear + turned), share * (linear + trace - turned)
