"""Contacts of a Newton step: pairs of elements that are near each other, and what is near infinite planes."""

import warp as wp

from ...response.contacts.constraints import friction_on_plane, pair_friction
from ...response.contacts.rules import inverse_mass_of
from ...response.state.planes import signed_distance
from ...response.state.structs import Motion
from ...response.state.vectors import ONE, ZERO, corners_of, to_double, to_single
from ..vector_access import integers_at
from . import barrier
from .distance_bounds import ROUNDED_DOWN, direction_in_bits, seen_from_last
from .flow import Phase, Place, Problem, end_at_planes, go_on, go_on_with_pairs, has_few, pair_count
from .merge import clear_buckets, link_contact
from .merit import MEETS, add_energy
from .pairs import (
    FAR,
    BarrierSettings,
    Candidates,
    Trial,
    add_to_list,
    candidate,
    clear_list,
    distance_bound,
    gap_at_plane,
    listed,
    listed_count,
    plane_at,
    stiffness_at_plane,
    stiffness_of_pair,
)
from .system import Contacts, Unknowns, is_solved, key_of_pair, kind_of_key, take_contact, write_contact

wp.set_module_options({"enable_backward": False})


@wp.func
def _merged(corners: wp.vec4i, weights: wp.vec4d) -> wp.vec4d:
    """Returns weights with those of corners that are one vertex, as points have them, at the first of these."""
    merged = weights
    for j in range(3, 1, -1):
        if corners[j] == corners[j - 1]:
            merged[j - 1] = merged[j - 1] + merged[j]
            merged[j] = ZERO
    return merged


@wp.func
def _add_contact(
    motion: Motion,
    contacts: Contacts,
    settings: BarrierSettings,
    trial: Trial,
    unknowns: Unknowns,
    world: int,
    corners: wp.vec4i,
    weights: wp.vec4d,
    normal: wp.vec3d,
    shifted: wp.vec3d,
    approach: wp.float64,
    gap: wp.float64,
    reach: wp.float64,
    stiffness: wp.float64,
    friction: float,
    key: wp.int64,
):
    """Adds a contact, with the derivatives of its barrier and friction.

    ``shifted`` is how far the second point has moved since the start beside its corners, ``approach`` how far what a
    program moves goes along the normal in this Newton step.
    """
    slot = take_contact(contacts, world)
    if slot < 0:
        return
    load = -stiffness * barrier.barrier_slope(gap, reach)
    curvature = stiffness * barrier.barrier_curvature(gap, reach)
    slid, given = -shifted, ZERO
    for j in range(4):
        v = corners[j]
        slid += weights[j] * (trial.exact[v] - to_double(motion.x0[v]))
        if unknowns.of_vertex[v] < 0 and not is_solved(unknowns, v):
            given += weights[j] * wp.dot(normal, to_double(trial.displaced[v]))
    slid -= wp.dot(slid, normal) * normal
    gradient = (-load + curvature * (given - approach)) * normal
    hessian = curvature * wp.outer(normal, normal)
    if friction > 0.0 and load > ZERO:
        length, limit = wp.length(slid), wp.float64(friction) * load
        slope = limit * barrier.friction_slope(length, settings.smoothing)
        gradient += slope * slid
        across = wp.identity(n=3, dtype=wp.float64) - wp.outer(normal, normal)
        if length > ZERO:
            along = slid / length
            more = limit * barrier.friction_curvature(length, settings.smoothing) - slope
            across = slope * across + more * wp.outer(along, along)
        else:
            across = slope * across
        hessian += across
    n, push, hold = to_single(normal), float(load), friction * float(load)
    write_contact(contacts, unknowns, slot, corners, weights, n, push, hold, to_single(gradient), hessian, key)
    link_contact(contacts, world, slot, corners, weights)


@wp.func
def publish(at: Place, p: Problem) -> wp.vec4i:
    """Finds what is near at the end of a step."""
    clear_buckets(at.world, at.thread, at.threads, p.contacts)
    if at.thread == 0:
        p.contacts.count[at.world] = 0
    phase = wp.where(listed_count(p.candidates, at.world) >= 0, int(Phase.FIND_NEAR), int(Phase.BEGIN_LIST))
    return go_on_with_pairs(at, wp.where(p.progress.steps[at.world] == 0, int(Phase.END), phase), Phase.END)


@wp.func
def begin_list(at: Place, p: Problem) -> wp.vec4i:
    """Empties the list of candidates."""
    if at.thread == 0:
        clear_list(p.candidates, at.world)
    return go_on(at, wp.where(has_few(p.candidates, at), int(Phase.LIST_AND_FIND_NEAR), int(Phase.LIST_NEAR)))


@wp.func
def _list_near(i: int, world: int, candidates: Candidates, trial: Trial) -> bool:
    """Lists a candidate if it may be near each other, for :func:`find_near`, where no displacements told."""
    if candidates.share[i] >= FAR:
        return False
    kind = kind_of_key(candidates.key[i])
    a, b, c = seen_from_last(trial.exact, integers_at(candidates.corners, i))
    apart = distance_bound(candidates, i, kind, a, b, c)
    candidates.now[i] = apart
    is_near = wp.float64(apart) < candidates.level[i] + wp.float64(candidates.reach[i])
    if is_near:
        add_to_list(candidates, world, kind, i, False)
    return is_near


@wp.func
def list_near(at: Place, p: Problem) -> wp.vec4i:
    """Lists candidates that may be near each other: little for each of all, so that what follows has few."""
    for k in range(at.thread, pair_count(p.candidates, p.progress, at.world, True), at.threads):
        _list_near(candidate(p.candidates, at.world, k), at.world, p.candidates, p.trial)
    return go_on(at, Phase.FIND_NEAR)


@wp.func
def find_near(at: Place, p: Problem) -> wp.vec4i:
    """Adds contacts of candidates that are near each other, listed ones or all, and of planes, and their energies."""
    w, at_once, energy = at.world, at.phase == Phase.LIST_AND_FIND_NEAR, p.progress.energy
    for k in range(at.thread, pair_count(p.candidates, p.progress, w, at_once), at.threads):
        i, is_near = int(0), bool(True)
        if at_once:
            i = candidate(p.candidates, w, k)
            is_near = _list_near(i, w, p.candidates, p.trial)
        else:
            i = listed(p.candidates, w, k) >> 1
        if not is_near:
            continue
        corners, reach = integers_at(p.candidates.corners, i), wp.float64(p.candidates.reach[i])
        key = p.candidates.key[i] + wp.int64(0)
        kind = kind_of_key(key)
        q, r, s = seen_from_last(p.trial.exact, corners)
        apart = distance_bound(p.candidates, i, kind, q, r, s)
        p.candidates.now[i] = apart
        if wp.float64(apart) >= p.candidates.level[i] + reach:
            continue
        a, b, c, d = corners_of(p.trial.exact, corners)
        weights, distance = barrier.closest_weights_and_gap(kind, a, b, c, d)
        p.candidates.now[i] = float(distance * wp.float64(ROUNDED_DOWN))
        gap = distance - p.candidates.level[i]
        if not gap > ZERO:
            add_energy(energy, w, MEETS, p.settings.units)
            continue
        normal = (weights[0] * a + weights[1] * b + weights[2] * c + weights[3] * d) / distance
        p.candidates.normal[i] = direction_in_bits(normal)
        if gap >= reach:
            continue
        stiffness = stiffness_of_pair(p.candidates.stiffness[i], p.settings, p.trial, corners, reach)
        add_energy(energy, w, stiffness * barrier.barrier_energy(gap, reach), p.settings.units)
        _add_contact(
            p.motion,
            p.contacts,
            p.settings,
            p.trial,
            p.unknowns,
            w,
            corners,
            _merged(corners, weights),
            normal,
            wp.vec3d(),
            ZERO,
            gap,
            reach,
            stiffness,
            pair_friction(p.motion, corners),
            key,
        )
    for k in range(p.worlds.first_vertex[w] + at.thread, end_at_planes(p.worlds, p.vertices_at_planes, w), at.threads):
        v = p.worlds.vertices[k] + int(0)
        if v >= p.vertices_at_planes or inverse_mass_of(p.motion, v) == 0.0:
            continue
        x = p.trial.exact[v]
        for place in range(p.planes.of_worlds.shape[1]):
            plane = p.planes.of_worlds[w, place]
            if plane < 0:
                break
            now = plane_at(p.planes, plane, p.progress.plane_share[w])
            distance, _error = signed_distance(now, x)
            _kept, level, reach, _floor = gap_at_plane(
                p.motion, p.planes, p.settings, plane, v, to_double(p.motion.x0[v])
            )
            gap = distance - level
            if gap >= reach:
                continue
            if not gap > ZERO:
                add_energy(energy, w, MEETS, p.settings.units)
                continue
            normal = wp.vec3d(now[0], now[1], now[2])
            stiffness = stiffness_at_plane(p.motion, p.settings, p.progress.fall[w], v, reach)
            add_energy(energy, w, stiffness * barrier.barrier_energy(gap, reach), p.settings.units)
            there, _error_there = signed_distance(p.planes.end[plane], x)
            since, _since_error = signed_distance(p.planes.start[plane], x)
            _add_contact(
                p.motion,
                p.contacts,
                p.settings,
                p.trial,
                p.unknowns,
                w,
                wp.vec4i(v),
                wp.vec4d(ONE, ZERO, ZERO, ZERO),
                normal,
                (since - distance) * normal,
                distance - there,
                gap,
                reach,
                stiffness,
                friction_on_plane(p.motion, p.planes, plane, v),
                key_of_pair(1, 0, v, plane),
            )
    return go_on(at, at.then)
