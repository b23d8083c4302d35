"""Contacts that hold pairs which would meet on the displacements of a Newton step, before it is taken."""

import warp as wp

from ...response.contacts.rules import inverse_mass_of
from ...response.state.planes import signed_distance
from ...response.state.vectors import ONE, ZERO, corners_of, to_double, to_single
from ..vector_access import integers_at, numbers_at, store_block, stored_block
from . import barrier
from .contact_lists import clear_lists
from .flow import Phase, Place, Problem, end_at_planes, go_on, go_on_with_pairs, pair_count
from .pairs import Trial, gap_at_plane, kept_distance, listed, plane_at
from .system import (
    Contacts,
    Unknowns,
    displacement,
    end_of_contacts,
    is_solved,
    key_in_group,
    key_of_pair,
    kind_of_key,
    take_contact,
    write_contact,
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
    gradient, hessian = (stiffness * float(given - short)) * n, wp.mat33d(stiffness * wp.outer(n, n))
    write_contact(contacts, unknowns, slot, corners, weights, n, 0.0, 0.0, gradient, hessian, key)


@wp.func
def hold(at: Place, p: Problem) -> wp.vec4i:
    """Keeps the first solution, before pairs that would meet are held in another solve."""
    for u in range(p.unknowns.of_worlds[at.world] + at.thread, p.unknowns.of_worlds[at.world + 1], at.threads):
        if at.solves == 0:
            p.vectors.first[u] = p.vectors.solution[u]
    return wp.vec4i(int(Phase.RELEASE_HELD), at.then, at.passes, at.solves + 1)


@wp.func
def release_held(at: Place, p: Problem) -> wp.vec4i:
    """Lets pairs go that are held and that the last solution would pull together: they are not in the way."""
    w, contacts = at.world, p.contacts
    if at.thread == 0:
        p.progress.bound[w] = 1.0
        p.progress.held[w] = 1
        clear_lists(w, contacts)
    for i in range(contacts.start[w] + at.thread, end_of_contacts(contacts, w), at.threads):
        if contacts.key[i] < _FIRST_HELD:
            continue
        corners, weights, n = integers_at(contacts.corners, i), numbers_at(contacts.weights, i), contacts.normal[i]
        apart, pull = wp.dot(n, contacts.gradient[i]), stored_block(contacts.hessian, i) * n
        for j in range(4):
            apart += weights[j] * wp.dot(pull, displacement(p.unknowns, corners[j], p.vectors.solution))
        if apart > 0.0:
            contacts.gradient[i] = wp.vec3()
            store_block(contacts.hessian, i, wp.mat33d())
    for u in range(p.unknowns.of_worlds[w] + at.thread, p.unknowns.of_worlds[w + 1], at.threads):
        contacts.end[u] = 0
    return go_on_with_pairs(at, Phase.HOLD_PAIRS, Phase.COUNT)


@wp.func
def hold_pairs(at: Place, p: Problem) -> wp.vec4i:
    """Holds pairs that would meet on the displacements, and vertices that would enter infinite planes.

    Only a pair that is the first, by ``limit``, for one of its vertices: what would come later may not come at all.
    """
    w, group, inverse = at.world, 1 + at.solves, p.vectors.inverse
    for k in range(at.thread, pair_count(p.candidates, p.progress, w, False), at.threads):
        i = listed(p.candidates, w, k) >> 1
        corners, of_reach = integers_at(p.candidates.corners, i), wp.float64(p.candidates.reach[i])
        share, is_first = p.candidates.share[i] + float(0.0), bool(False)
        if share >= 1.0:
            continue
        for j in range(4):
            is_first = is_first or (share <= p.trial.limit[corners[j]] and is_solved(p.unknowns, corners[j]))
        if not is_first:
            continue
        key = p.candidates.key[i] + wp.int64(0)
        kind = kind_of_key(key)
        a, b, c, d = corners_of(p.trial.x, corners)
        q, r, s, t = corners_of(p.trial.displaced, corners)
        time, kept = wp.float64(share), kept_distance(p.candidates, i)
        _weights, distance = barrier.closest_weights_and_gap(kind, a, b, c, d)
        e, f, g, h = a + time * q, b + time * r, c + time * s, d + time * t
        weights, then = barrier.closest_weights_and_gap(kind, e, f, g, h)
        if not then > ZERO:
            continue
        normal = (weights[0] * e + weights[1] * f + weights[2] * g + weights[3] * h) / then
        goal = kept + barrier.goal_gap(distance - kept, of_reach, wp.float64(p.candidates.floor[i]))
        now = wp.dot(normal, weights[0] * a + weights[1] * b + weights[2] * c + weights[3] * d)
        key = key_in_group(group, key)
        _hold(p.contacts, p.unknowns, p.trial, inverse, w, corners, weights, normal, goal - now, key)
    for k in range(p.worlds.first_vertex[w] + at.thread, end_at_planes(p.worlds, p.vertices_at_planes, w), at.threads):
        v = p.worlds.vertices[k] + int(0)
        if v >= p.vertices_at_planes or inverse_mass_of(p.motion, v) == 0.0:
            continue
        for place in range(p.planes.of_worlds.shape[1]):
            plane = p.planes.of_worlds[w, place]
            if plane < 0:
                break
            keeps, _level, reach, floor = gap_at_plane(
                p.motion, p.planes, p.settings, plane, v, to_double(p.motion.x0[v])
            )
            if reach == ZERO:
                continue
            off, _error = signed_distance(plane_at(p.planes, plane, p.progress.plane_share[w]), p.trial.x[v])
            end = plane_at(p.planes, plane, 1.0)
            left, _error_after = signed_distance(end, p.trial.x[v] + p.trial.displaced[v])
            here, _error_now = signed_distance(end, p.trial.x[v])
            gap = off - keeps
            if left - keeps < barrier.least_gap(gap, reach, floor):
                short, up = keeps + barrier.goal_gap(gap, reach, floor) - here, wp.vec3d(end[0], end[1], end[2])
                corners, weights = wp.vec4i(v), wp.vec4d(ONE, ZERO, ZERO, ZERO)
                key = key_of_pair(group, 7, v, plane)
                _hold(p.contacts, p.unknowns, p.trial, inverse, w, corners, weights, up, short, key)
    return go_on(at, at.then)


@wp.func
def begin_release(at: Place, p: Problem) -> wp.vec4i:
    """Goes back to the first solution."""
    for u in range(p.unknowns.of_worlds[at.world] + at.thread, p.unknowns.of_worlds[at.world + 1], at.threads):
        p.vectors.solution[u] = p.vectors.first[u]
    return go_on_with_pairs(at, Phase.DISPLACE, Phase.RELEASED)
