"""Contacts that hold pairs which would meet on the displacements of a Newton step, before it is taken."""

import warp as wp

from ...response.contacts.rules import inverse_mass_of
from ...response.state.planes import MovingPlanes, signed_distance
from ...response.state.structs import Motion
from ...response.state.vectors import ONE, ZERO, corners_of, to_double, to_single
from ..vector_access import integers_at, numbers_at, store_block, stored_block
from . import barrier
from .pairs import BarrierSettings, Candidates, Trial, gap_at_plane, kept_distance, plane_at
from .system import (
    Contacts,
    Unknowns,
    couples,
    displacement,
    is_solved,
    key_in_group,
    key_of_pair,
    kind_of_key,
    take_contact,
    unknowns_of,
)

wp.set_module_options({"enable_backward": False})

_FIRST_HELD = wp.constant(wp.int64(16 << 56))
"""Key from which contacts are held ones."""
_STIFFER = wp.constant(float(10.0))
"""How much stiffer it is held than what moves it."""


@wp.func
def _hold(
    contacts: Contacts,
    unknowns: Unknowns,
    trial: Trial,
    inverse: wp.array[wp.mat33],
    world: int,
    corners: wp.vec4i,
    weights: wp.vec4d,
    normal: wp.vec3d,
    short: wp.float64,
    key: wp.int64,
):
    """Adds a contact that holds a pair which is farther apart along the normal than it shall be, ``short`` if less."""
    compliance = float(0.0)
    given = ZERO
    apart = ZERO
    n = to_single(normal)
    for j in range(4):
        v = corners[j]
        u = unknowns.of_vertex[v]
        w = float(weights[j])
        apart += weights[j] * wp.dot(normal, to_double(trial.displaced[v]))
        if u < 0 and not is_solved(unknowns, v):
            given += weights[j] * wp.dot(normal, to_double(trial.displaced[v]))
        elif u >= 0:
            compliance += w * w * wp.dot(n, inverse[u] * n)
        else:
            turn = wp.cross(unknowns.arm[v], n)
            compliance += w * w * (wp.dot(n, inverse[-2 - u] * n) + wp.dot(turn, inverse[-1 - u] * turn))
    if not compliance > 0.0 or apart >= short:
        return
    slot = take_contact(contacts, world)
    if slot < 0:
        return
    stiffness = _STIFFER / compliance
    of_corners = unknowns_of(unknowns, corners)
    contacts.corners[slot] = corners
    contacts.unknowns[slot] = of_corners
    contacts.weights[slot] = wp.vec4(float(weights[0]), float(weights[1]), float(weights[2]), float(weights[3]))
    contacts.normal[slot] = n
    contacts.load[slot] = 0.0
    contacts.limit[slot] = 0.0
    contacts.gradient[slot] = (stiffness * float(given - short)) * n
    store_block(contacts.hessian, slot, wp.mat33d(stiffness * wp.outer(n, n)))
    contacts.key[slot] = key
    contacts.couples[slot] = couples(of_corners, weights)


@wp.func
def release_held(i: int, unknowns: Unknowns, solution: wp.array[wp.vec3], contacts: Contacts):
    """Lets a pair go that is held and that the solution would pull together: it is not in the way."""
    corners, weights, n = integers_at(contacts.corners, i), numbers_at(contacts.weights, i), contacts.normal[i]
    if contacts.key[i] >= _FIRST_HELD:
        apart, pull = wp.dot(n, contacts.gradient[i]), stored_block(contacts.hessian, i) * n
        for j in range(4):
            apart += weights[j] * wp.dot(pull, displacement(unknowns, corners[j], solution))
        if apart > 0.0:
            contacts.gradient[i] = wp.vec3()
            store_block(contacts.hessian, i, wp.mat33d())


@wp.func
def hold_pair(
    i: int,
    world: int,
    candidates: Candidates,
    trial: Trial,
    unknowns: Unknowns,
    inverse: wp.array[wp.mat33],
    limit: wp.array[float],
    group: int,
    contacts: Contacts,
):
    """Adds a contact that holds a candidate which would meet on the displacements.

    Only one that is the first, by ``limit``, for one of its vertices: what would come later may not come at all.
    """
    corners, reach = integers_at(candidates.corners, i), wp.float64(candidates.reach[i])
    share = candidates.share[i] + float(0.0)
    if share >= 1.0:
        return
    is_first = bool(False)
    for j in range(4):
        is_first = is_first or (share <= limit[corners[j]] and is_solved(unknowns, corners[j]))
    if not is_first:
        return
    key = candidates.key[i] + wp.int64(0)
    kind = kind_of_key(key)
    a, b, c, d = corners_of(trial.x, corners)
    p, q, r, s = corners_of(trial.displaced, corners)
    time = wp.float64(share)
    kept = kept_distance(candidates, i)
    _weights, distance = barrier.closest_weights_and_gap(kind, a, b, c, d)
    gap = distance - kept
    e, f, g, h = a + time * p, b + time * q, c + time * r, d + time * s
    weights, then = barrier.closest_weights_and_gap(kind, e, f, g, h)
    if not then > ZERO:
        return
    normal = (weights[0] * e + weights[1] * f + weights[2] * g + weights[3] * h) / then
    goal = kept + barrier.goal_gap(gap, reach, wp.float64(candidates.floor[i]))
    now = wp.dot(normal, weights[0] * a + weights[1] * b + weights[2] * c + weights[3] * d)
    _hold(contacts, unknowns, trial, inverse, world, corners, weights, normal, goal - now, key_in_group(group, key))


@wp.func
def hold_at_planes(
    vertex: int,
    world: int,
    motion: Motion,
    planes: MovingPlanes,
    plane_share: wp.array[float],
    settings: BarrierSettings,
    trial: Trial,
    unknowns: Unknowns,
    inverse: wp.array[wp.mat33],
    group: int,
    contacts: Contacts,
):
    """Adds contacts that hold a vertex which would enter infinite planes, as :func:`hold_pair`."""
    if inverse_mass_of(motion, vertex) == 0.0:
        return
    for place in range(planes.of_worlds.shape[1]):
        i = planes.of_worlds[world, place]
        if i < 0:
            return
        kept, _level, reach, floor = gap_at_plane(motion, planes, settings, i, vertex, to_double(motion.x0[vertex]))
        if reach == ZERO:
            continue
        gap, _error = signed_distance(plane_at(planes, i, plane_share[world]), trial.x[vertex])
        end = plane_at(planes, i, 1.0)
        left, _error_after = signed_distance(end, trial.x[vertex] + trial.displaced[vertex])
        now, _error_now = signed_distance(end, trial.x[vertex])
        gap -= kept
        if left - kept < barrier.least_gap(gap, reach, floor):
            goal = kept + barrier.goal_gap(gap, reach, floor)
            normal = wp.vec3d(end[0], end[1], end[2])
            weights = wp.vec4d(ONE, ZERO, ZERO, ZERO)
            key = key_of_pair(group, 7, vertex, i)
            _hold(contacts, unknowns, trial, inverse, world, wp.vec4i(vertex), weights, normal, goal - now, key)
