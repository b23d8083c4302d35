"""Kernels of the contact layer."""

import warp as wp

from ...detection.approach_phase import MinDistances
from ...detection.rings import are_within_rings
from ...kernels.pipeline.pairs import distance_of_corners, firsts_of
from ...kernels.polynomials import EDGE_EDGE
from ..contacts.closest import closest_weights
from ..contacts.constraints import contact_friction
from ..contacts.queue import PairQueue, has_pair, vertices_of
from ..contacts.rules import are_on_body
from ..schedule import has_overflowed
from ..state.fixed_sum import with_delta
from ..state.planes import MovingPlanes, signed_distance
from ..state.structs import Motion
from ..state.vectors import ONE, ZERO, corners_of, to_double, to_single
from ..tuning import PARALLEL_IN_LAYER

_UNITS = wp.constant(wp.float64(2.0**40))
"""Units in a metre and in 1; sums are of integers in these units, so that they are the same in any order."""

_ROOT_OF_2 = wp.constant(2.0**0.5)


@wp.struct
class Layer:
    """The layer and what is at its bottom."""

    thickness: wp.float64  # [m]
    distances: MinDistances  # of pairs [m]
    restitution: wp.array[float]  # in [0, 1]


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
def _between(x0: wp.vec3, x1: wp.vec3, theta: wp.float64) -> wp.vec3d:
    return to_double(x1) + theta * (to_double(x0) - to_double(x1))


@wp.func
def _vector(weights: wp.vec4d, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d) -> wp.vec3d:
    return weights[0] * a + weights[1] * b + weights[2] * c + weights[3] * d


@wp.func
def _is_on_the_same_side(motion: Motion, kind: int, corners: wp.vec4i, normal: wp.vec3d) -> bool:
    """Returns whether two elements were on the same sides of each other at the start: not if they have passed."""
    a, b, c, d = corners_of(motion.x0, corners)
    return wp.dot(normal, _vector(closest_weights(kind, a, b, c, d), a, b, c, d)) > ZERO


@wp.func
def _contact_of_pair(motion: Motion, layer: Layer, kind: int, corners: wp.vec4i):
    """Returns the weights of four vertices in a contact, its normal, and its depth in the layer [m], 0 if it is not."""
    _kappa, theta = _gains(layer.restitution[0])
    a = _between(motion.x0[corners[0]], motion.x1[corners[0]], theta)
    b = _between(motion.x0[corners[1]], motion.x1[corners[1]], theta)
    c = _between(motion.x0[corners[2]], motion.x1[corners[2]], theta)
    d = _between(motion.x0[corners[3]], motion.x1[corners[3]], theta)
    weights = closest_weights(kind, a, b, c, d)
    vector = _vector(weights, a, b, c, d)
    distance = wp.length(vector)
    depth = layer.thickness + distance_of_corners(kind, corners, layer.distances.radius) - distance
    if depth <= ZERO or distance <= ZERO:
        return weights, vector, ZERO
    normal = vector / distance
    if are_within_rings(corners, firsts_of(kind), layer.distances.rings) or are_on_body(motion, corners):
        return weights, normal, ZERO
    if not _is_on_the_same_side(motion, kind, corners, normal):
        return weights, normal, ZERO
    if kind == EDGE_EDGE:
        u = b - a
        v = d - c
        sines = wp.length_sq(wp.cross(u, v))
        depth *= sines / (sines + PARALLEL_IN_LAYER * wp.length_sq(u) * wp.length_sq(v))
    return weights, normal, depth


@wp.func
def _contact_with_plane(motion: Motion, planes: MovingPlanes, layer: Layer, plane: int, vertex: int):
    """Returns the normal of a contact of a vertex with a plane, and its depth in the layer [m], 0 if it is not."""
    _kappa, theta = _gains(layer.restitution[0])
    end = planes.end[plane]
    normal = wp.vec3d(end[0], end[1], end[2])
    if planes.world[plane] >= 0 and planes.world[plane] != motion.world[vertex]:
        return normal, ZERO
    before, error = signed_distance(planes.start[plane], motion.x0[vertex])
    after, _error = signed_distance(end, motion.x1[vertex])
    least = layer.distances.radius[vertex] + layer.distances.of_planes
    depth = layer.thickness + least - after - theta * (before - after)
    if not (depth > ZERO and before >= -error):
        return normal, ZERO
    return normal, depth


@wp.func
def _share_of(layer: Layer, depth: wp.float64) -> wp.float64:
    """Returns what a contact of this depth counts where contacts divide the mass of a vertex."""
    return (depth / layer.thickness) * (depth / layer.thickness)


@wp.func
def _push(
    motion: Motion,
    layer: Layer,
    normal: wp.vec3d,
    depth: wp.float64,
    path: wp.vec3d,
    resistance: wp.float64,
    friction: float,
) -> wp.vec3d:
    """Returns the push of a contact, an impulse times a time [kg m].

    Args:
        motion: The motion.
        layer: The layer.
        normal: The normal.
        depth: The depth [m].
        path: Of the first contact point relative to the second [m].
        resistance: The sum over its vertices of inverse mass, weight, and what all contacts of the vertex count [1/kg].
        friction: The coefficient.
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
def _resistance(motion: Motion, corners: wp.vec4i, weights: wp.vec4d, shares: wp.array[wp.float64]) -> wp.float64:
    resistance = ZERO
    for j in range(4):
        vertex = corners[j]
        resistance += wp.abs(weights[j]) * wp.float64(motion.inverse_mass[vertex]) * shares[vertex]
    return resistance


@wp.func
def _push_of_pair(motion: Motion, layer: Layer, kind: int, corners: wp.vec4i, shares: wp.array[wp.float64]):
    """Returns the weights of four vertices in a contact and its push, 0 if there is none."""
    weights, normal, depth = _contact_of_pair(motion, layer, kind, corners)
    resistance = _resistance(motion, corners, weights, shares)
    if depth <= ZERO or resistance <= ZERO:
        return weights, wp.vec3d()
    path = wp.vec3d()
    for j in range(4):
        vertex = corners[j]
        path += weights[j] * (to_double(motion.x1[vertex]) - to_double(motion.x0[vertex]))
    friction = contact_friction(motion.friction[corners[0]], motion.friction[corners[3]])
    return weights, _push(motion, layer, normal, depth, path, resistance, friction)


@wp.func
def _push_of_plane(
    motion: Motion, planes: MovingPlanes, layer: Layer, plane: int, vertex: int, shares: wp.array[wp.float64]
) -> wp.vec3d:
    """Returns the push of a plane on a vertex, 0 if there is none."""
    normal, depth = _contact_with_plane(motion, planes, layer, plane, vertex)
    resistance = wp.float64(motion.inverse_mass[vertex]) * shares[vertex]
    if depth <= ZERO or resistance <= ZERO:
        return wp.vec3d()
    path = to_double(motion.x1[vertex]) - to_double(motion.x0[vertex])
    friction = contact_friction(motion.friction[vertex], planes.friction[plane])
    return _push(motion, layer, normal, depth, path, resistance, friction)


@wp.kernel(enable_backward=False)
def place_vertices_between(motion: Motion, layer: Layer, y: wp.array[wp.vec3]):
    """Writes the positions at which contacts act, to which the detection is near enough in single precision."""
    vertex = wp.tid()
    _kappa, theta = _gains(layer.restitution[0])
    y[vertex] = to_single(_between(motion.x0[vertex], motion.x1[vertex], theta))


@wp.kernel(enable_backward=False)
def sum_shares(motion: Motion, layer: Layer, of_kind: PairQueue, sums: wp.array[wp.int64]):
    """Adds what contacts count, by their weights, to the sums of their vertices."""
    i = wp.tid()
    if not has_pair(of_kind, i):
        return
    corners = vertices_of(of_kind, i)
    weights, _normal, depth = _contact_of_pair(motion, layer, of_kind.kind, corners)
    if depth > ZERO:
        for j in range(4):
            wp.atomic_add(sums, corners[j], wp.int64(wp.rint(_UNITS * wp.abs(weights[j]) * _share_of(layer, depth))))


@wp.kernel(enable_backward=False)
def finish_shares(
    motion: Motion,
    planes: MovingPlanes,
    layer: Layer,
    counts: wp.array[wp.int64],
    capacities: wp.array[wp.int64],
    sums: wp.array[wp.int64],
    shares: wp.array[wp.float64],
    layerless_steps: wp.array[wp.int64],
):
    """Adds what contacts with planes count, and writes the sums; zeros if pairs are missing, so that nothing pushes."""
    vertex = wp.tid()
    share = wp.float64(sums[vertex]) / _UNITS
    sums[vertex] = wp.int64(0)
    for plane in range(planes.end.shape[0]):
        _normal, depth = _contact_with_plane(motion, planes, layer, plane, vertex)
        share += _share_of(layer, depth)
    if has_overflowed(counts, capacities):
        share = ZERO
        if vertex == 0:
            layerless_steps[0] += wp.int64(1)
    shares[vertex] = share


@wp.kernel(enable_backward=False)
def sum_pushes(
    motion: Motion, layer: Layer, of_kind: PairQueue, shares: wp.array[wp.float64], sums: wp.array2d[wp.int64]
):
    """Adds what contacts move vertices by to their sums."""
    i = wp.tid()
    if not has_pair(of_kind, i):
        return
    corners = vertices_of(of_kind, i)
    weights, push = _push_of_pair(motion, layer, of_kind.kind, corners, shares)
    for j in range(4):
        vertex = corners[j]
        share = weights[j] * wp.float64(motion.inverse_mass[vertex])
        for axis in range(3):
            wp.atomic_add(sums, vertex, axis, wp.int64(wp.rint(_UNITS * share * push[axis])))


@wp.kernel(enable_backward=False)
def move_particles(
    motion: Motion,
    planes: MovingPlanes,
    layer: Layer,
    shares: wp.array[wp.float64],
    dt: float,
    sums: wp.array2d[wp.int64],
    particle_q: wp.array[wp.vec3],
    particle_qd: wp.array[wp.vec3],
):
    """Moves each particle by the pushes of its contacts, in the motion and in the state; others keep every bit."""
    vertex = wp.tid()
    moved = bool(False)
    for plane in range(planes.end.shape[0]):
        push = _push_of_plane(motion, planes, layer, plane, vertex, shares)
        for axis in range(3):
            sums[vertex, axis] += wp.int64(wp.rint(_UNITS * wp.float64(motion.inverse_mass[vertex]) * push[axis]))
    for axis in range(3):
        moved = moved or sums[vertex, axis] != wp.int64(0)
    if moved and motion.is_not_finite[vertex] == 0:
        motion.x1[vertex] = with_delta(motion.x1[vertex], sums, vertex)
        for axis in range(3):
            motion.velocity[vertex][axis] += float(wp.float64(sums[vertex, axis]) / (_UNITS * wp.float64(dt)))
        particle_q[vertex] = motion.x1[vertex]
        particle_qd[vertex] = motion.velocity[vertex]
    for axis in range(3):
        sums[vertex, axis] = wp.int64(0)


@wp.kernel
def add_shares(motion: Motion, layer: Layer, of_kind: PairQueue, shares: wp.array[wp.float64]):
    """Computes what :func:`sum_shares` does."""
    i = wp.tid()
    if not has_pair(of_kind, i):
        return
    corners = vertices_of(of_kind, i)
    weights, _normal, depth = _contact_of_pair(motion, layer, of_kind.kind, corners)
    if depth > ZERO:
        for j in range(4):
            wp.atomic_add(shares, corners[j], wp.abs(weights[j]) * _share_of(layer, depth))


@wp.kernel
def add_shares_of_planes(motion: Motion, planes: MovingPlanes, layer: Layer, shares: wp.array[wp.float64]):
    """Computes what :func:`finish_shares` adds, with a thread for each vertex and plane."""
    vertex, plane = wp.tid()
    _normal, depth = _contact_with_plane(motion, planes, layer, plane, vertex)
    wp.atomic_add(shares, vertex, _share_of(layer, depth))


@wp.kernel
def add_pushes(
    motion: Motion, layer: Layer, of_kind: PairQueue, shares: wp.array[wp.float64], changes: wp.array[wp.vec3]
):
    """Computes what :func:`sum_pushes` does."""
    i = wp.tid()
    if not has_pair(of_kind, i):
        return
    corners = vertices_of(of_kind, i)
    weights, push = _push_of_pair(motion, layer, of_kind.kind, corners, shares)
    for j in range(4):
        share = weights[j] * wp.float64(motion.inverse_mass[corners[j]])
        wp.atomic_add(changes, corners[j], to_single(share * push))


@wp.kernel
def add_pushes_of_planes(
    motion: Motion, planes: MovingPlanes, layer: Layer, shares: wp.array[wp.float64], changes: wp.array[wp.vec3]
):
    """Computes what :func:`move_particles` adds, with a thread for each particle and plane."""
    vertex, plane = wp.tid()
    push = _push_of_plane(motion, planes, layer, plane, vertex, shares)
    wp.atomic_add(changes, vertex, to_single(wp.float64(motion.inverse_mass[vertex]) * push))


@wp.kernel(enable_backward=False)
def begin_backward(
    is_not_finite: wp.array[int],
    dt: float,
    particle_q: wp.array[wp.vec3],
    particle_qd: wp.array[wp.vec3],
    changes: wp.array[wp.vec3],
):
    """Writes the gradient with respect to what contacts move particles by."""
    particle = wp.tid()
    if is_not_finite[particle] == 0:
        changes[particle] = particle_q[particle] + particle_qd[particle] / dt


@wp.kernel(enable_backward=False)
def finish_backward(
    x0: wp.array[wp.vec3],
    x1: wp.array[wp.vec3],
    inverse_mass: wp.array[float],
    start_q: wp.array[wp.vec3],
    particle_q: wp.array[wp.vec3],
    particle_inv_mass: wp.array[float],
):
    """Adds to the gradients of the inputs of the step."""
    particle = wp.tid()
    start_q[particle] = start_q[particle] + x0[particle]
    particle_q[particle] = particle_q[particle] + x1[particle]
    if particle_inv_mass:
        particle_inv_mass[particle] = particle_inv_mass[particle] + inverse_mass[particle]
