"""Kernels of the contact layer."""

import warp as wp

from ...detection.approach_phase import MinDistances
from ...detection.rings import are_within_rings
from ...kernels.closest import closest_weights
from ...kernels.pipeline.pairs import distance_of_corners, firsts_of
from ...kernels.pipeline.queues import has_overflowed
from ...kernels.polynomials import EDGE_EDGE
from ..contacts.closest import closest_vector
from ..contacts.constraints import contact_friction
from ..contacts.queue import PairQueue, has_pair, vertices_of
from ..contacts.rules import are_on_body
from ..state.fixed_sum import add_to_sum, from_units, sum_of, to_units, with_delta
from ..state.motion import StateArrays
from ..state.planes import MovingPlanes, signed_distance
from ..state.structs import Motion
from ..state.vectors import ONE, ZERO, to_double, to_single
from ..tuning import PARALLEL_IN_LAYER

_ROOT_OF_2 = wp.constant(2.0**0.5)


@wp.struct
class Layer:
    """The layer around a predicted motion."""

    motion: Motion
    planes: MovingPlanes
    thickness: wp.float64  # [m]
    distances: MinDistances  # of pairs [m]
    restitution: wp.array[float]  # in [0, 1]
    shares: wp.array[wp.float64]  # of vertices, summed over contacts, see _share_of
    dt: float  # length of the step [s]


@wp.func
def _gains(restitution: float):
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
def _between(motion: Motion, vertex: int, theta: wp.float64) -> wp.vec3d:
    x1 = to_double(motion.x1[vertex])
    return x1 + theta * (to_double(motion.x0[vertex]) - x1)


@wp.func
def _contact_of_pair(layer: Layer, kind: int, corners: wp.vec4i):
    """Returns the weights of four vertices in a contact, its normal, and its depth in the layer [m], 0 if it is not.

    Elements are in contact only if they are on the same sides of each other as at the start: not if they have passed.
    """
    _kappa, theta = _gains(layer.restitution[0])
    a = _between(layer.motion, corners[0], theta)
    b = _between(layer.motion, corners[1], theta)
    c = _between(layer.motion, corners[2], theta)
    d = _between(layer.motion, corners[3], theta)
    weights = closest_weights(kind, a, b, c, d)
    vector = weights[0] * a + weights[1] * b + weights[2] * c + weights[3] * d
    distance = wp.length(vector)
    depth = layer.thickness + distance_of_corners(kind, corners, layer.distances.radius) - distance
    if depth <= ZERO or distance <= ZERO:
        return weights, vector, ZERO
    normal = vector / distance
    if are_within_rings(corners, firsts_of(kind), layer.distances.rings) or are_on_body(layer.motion, corners):
        return weights, normal, ZERO
    _weights, at_start = closest_vector(layer.motion, corners, kind)
    if not wp.dot(normal, at_start) > ZERO:  # nor if it is not a number
        return weights, normal, ZERO
    if kind == EDGE_EDGE:
        u = b - a
        v = d - c
        sines = wp.length_sq(wp.cross(u, v))
        depth *= sines / (sines + PARALLEL_IN_LAYER * wp.length_sq(u) * wp.length_sq(v))
    return weights, normal, depth


@wp.func
def _contact_with_plane(layer: Layer, plane: int, vertex: int):
    """Returns the normal of a contact of a vertex with a plane, and its depth in the layer [m], 0 if it is not."""
    motion, planes = layer.motion, layer.planes
    _kappa, theta = _gains(layer.restitution[0])
    end = planes.end[plane]
    normal = wp.vec3d(end[0], end[1], end[2])
    if planes.world[plane] >= 0 and planes.world[plane] != motion.world[vertex]:
        return normal, ZERO
    before, error = signed_distance(planes.start[plane], motion.x0[vertex])
    after, _error = signed_distance(end, motion.x1[vertex])
    min_distance = layer.distances.radius[vertex] + layer.distances.of_planes
    depth = layer.thickness + min_distance - after - theta * (before - after)
    if not (depth > ZERO and before >= -error):
        return normal, ZERO
    return normal, depth


@wp.func
def _share_of(layer: Layer, depth: wp.float64) -> wp.float64:
    """Returns the share of a contact of this depth where contacts divide the mass of a vertex."""
    return (depth / layer.thickness) * (depth / layer.thickness)


@wp.func
def _push(
    layer: Layer, normal: wp.vec3d, depth: wp.float64, path: wp.vec3d, resistance: wp.float64, friction: float
) -> wp.vec3d:
    """Returns the push of a contact, an impulse times a time [kg m].

    Its first contact point moves along ``path`` relative to the second [m]. The ``resistance`` is the sum over its
    vertices of inverse mass, weight, and the shares of all contacts [1/kg].
    """
    kappa, _theta = _gains(layer.restitution[0])
    part = _share_of(layer, depth) / resistance  # the mass that the vertices have for this contact
    along = kappa * depth * part
    across = path - wp.dot(path, normal) * normal
    length = wp.length(across)
    if length == ZERO:
        return along * normal
    holding = wp.float64(friction) * along / (length * part)  # more than 1 if friction could stop the contact
    return along * normal - across * (part * holding / wp.sqrt(ONE + holding * holding))


@wp.func
def _change_by_plane(layer: Layer, plane: int, vertex: int) -> wp.vec3d:
    """Returns what the push of a plane moves a vertex by [m], 0 if there is none."""
    motion = layer.motion
    normal, depth = _contact_with_plane(layer, plane, vertex)
    resistance = wp.float64(motion.inverse_mass[vertex]) * layer.shares[vertex]
    if depth <= ZERO or resistance <= ZERO:
        return wp.vec3d()
    path = to_double(motion.x1[vertex]) - to_double(motion.x0[vertex])
    friction = contact_friction(motion.friction[vertex], layer.planes.friction[plane])
    return wp.float64(motion.inverse_mass[vertex]) * _push(layer, normal, depth, path, resistance, friction)


@wp.kernel(enable_backward=False)
def place_vertices_between(layer: Layer, y: wp.array[wp.vec3]):
    """Writes the positions at which contacts act, to which the detection is near enough in single precision."""
    vertex = wp.tid()
    _kappa, theta = _gains(layer.restitution[0])
    y[vertex] = to_single(_between(layer.motion, vertex, theta))


@wp.kernel
def sum_shares(layer: Layer, queue: PairQueue, sums: wp.array[wp.int64], differentiable: wp.array[wp.float64]):
    """Adds the shares of contacts to the sums of their vertices, or to ``differentiable`` ones instead."""
    i = wp.tid()
    if not has_pair(queue, i):
        return
    corners = vertices_of(queue, i)
    weights, _normal, depth = _contact_of_pair(layer, queue.kind, corners)
    if depth <= ZERO:
        return
    for j in range(4):
        share = wp.abs(weights[j]) * _share_of(layer, depth)
        if differentiable:
            wp.atomic_add(differentiable, corners[j], share)
        else:
            wp.atomic_add(sums, corners[j], to_units(share))


@wp.kernel(enable_backward=False)
def finish_shares(
    layer: Layer,
    counts: wp.array[wp.int64],
    capacities: wp.array[wp.int64],
    # in and out
    sums: wp.array[wp.int64],
    layerless_steps: wp.array[wp.int64],
):
    """Adds the shares of contacts with planes, and writes the sums; zeros if pairs are missing: then nothing pushes."""
    vertex = wp.tid()
    share = from_units(sums[vertex])
    sums[vertex] = wp.int64(0)
    for plane in range(layer.planes.end.shape[0]):
        _normal, depth = _contact_with_plane(layer, plane, vertex)
        share += _share_of(layer, depth)
    if has_overflowed(counts, capacities):
        share = ZERO
        if vertex == 0:
            layerless_steps[0] += wp.int64(1)
    layer.shares[vertex] = share


@wp.kernel
def add_shares_of_planes(layer: Layer, sums: wp.array[wp.float64]):
    """Adds as :func:`finish_shares`, differentiably, with a thread for each vertex and plane."""
    vertex, plane = wp.tid()
    _normal, depth = _contact_with_plane(layer, plane, vertex)
    wp.atomic_add(sums, vertex, _share_of(layer, depth))


@wp.kernel
def sum_pushes(layer: Layer, queue: PairQueue, sums: wp.array2d[wp.int64], differentiable: wp.array[wp.vec3]):
    """Adds what contacts move vertices by to the sums of these, or to ``differentiable`` ones instead."""
    i = wp.tid()
    if not has_pair(queue, i):
        return
    motion = layer.motion
    corners = vertices_of(queue, i)
    weights, normal, depth = _contact_of_pair(layer, queue.kind, corners)
    resistance = ZERO
    for j in range(4):
        vertex = corners[j]
        resistance += wp.abs(weights[j]) * wp.float64(motion.inverse_mass[vertex]) * layer.shares[vertex]
    if depth <= ZERO or resistance <= ZERO:
        return
    path = wp.vec3d()
    for j in range(4):
        vertex = corners[j]
        path += weights[j] * (to_double(motion.x1[vertex]) - to_double(motion.x0[vertex]))
    friction = contact_friction(motion.friction[corners[0]], motion.friction[corners[3]])
    push = _push(layer, normal, depth, path, resistance, friction)
    for j in range(4):
        change = weights[j] * wp.float64(motion.inverse_mass[corners[j]]) * push
        if differentiable:
            wp.atomic_add(differentiable, corners[j], to_single(change))
        else:
            add_to_sum(sums, corners[j], 0, change)


@wp.kernel(enable_backward=False)
def move_particles(layer: Layer, sums: wp.array2d[wp.int64], end: StateArrays):
    """Moves each particle by the pushes of its contacts, in the motion and in the state; others keep every bit."""
    motion, vertex = layer.motion, wp.tid()
    for plane in range(layer.planes.end.shape[0]):
        add_to_sum(sums, vertex, 0, _change_by_plane(layer, plane, vertex))
    change = sum_of(sums, vertex, 0)
    if wp.length_sq(change) > ZERO and motion.is_not_finite[vertex] == 0:
        motion.x1[vertex] = with_delta(motion.x1[vertex], sums, vertex)
        motion.velocity[vertex] += to_single(change / wp.float64(layer.dt))
        end.particle_q[vertex] = motion.x1[vertex]
        end.particle_qd[vertex] = motion.velocity[vertex]
    for axis in range(3):
        sums[vertex, axis] = wp.int64(0)


@wp.kernel
def add_pushes_of_planes(layer: Layer, changes: wp.array[wp.vec3]):
    """Adds as :func:`move_particles`, differentiably, with a thread for each particle and plane."""
    vertex, plane = wp.tid()
    wp.atomic_add(changes, vertex, to_single(_change_by_plane(layer, plane, vertex)))


@wp.kernel(enable_backward=False)
def begin_backward(
    layer: Layer, particle_q: wp.array[wp.vec3], particle_qd: wp.array[wp.vec3], changes: wp.array[wp.vec3]
):
    """Writes the gradient with respect to what contacts move particles by."""
    particle = wp.tid()
    if layer.motion.is_not_finite[particle] == 0:
        changes[particle] = particle_q[particle] + particle_qd[particle] / layer.dt


@wp.kernel(enable_backward=False)
def finish_backward(
    of_motion: Motion, start_q: wp.array[wp.vec3], particle_q: wp.array[wp.vec3], particle_inv_mass: wp.array[float]
):
    """Adds to the gradients of the inputs of the step."""
    particle = wp.tid()
    start_q[particle] += of_motion.x0[particle]
    particle_q[particle] += of_motion.x1[particle]
    if particle_inv_mass:
        particle_inv_mass[particle] += of_motion.inverse_mass[particle]
