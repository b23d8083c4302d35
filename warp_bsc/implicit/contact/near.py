"""Contacts of a Newton step: pairs of elements that are near each other, and what is near infinite planes."""

import warp as wp

from ...response.contacts.constraints import friction_on_plane, pair_friction
from ...response.contacts.rules import inverse_mass_of
from ...response.state.planes import MovingPlanes, signed_distance
from ...response.state.structs import Motion
from ...response.state.vectors import ONE, ZERO, corners_of, to_double, to_single
from ..vector_access import integers_at, store_block
from . import barrier
from .distance_bounds import ROUNDED_DOWN, direction_in_bits, seen_from_last
from .merge import link_contact
from .merit import MEETS, add_energy
from .pairs import (
    FAR,
    BarrierSettings,
    Candidates,
    Trial,
    add_to_list,
    distance_bound,
    gap_at_plane,
    plane_at,
    stiffness_at_plane,
    stiffness_of_pair,
)
from .system import (
    Contacts,
    Progress,
    Unknowns,
    couples,
    is_solved,
    key_of_pair,
    kind_of_key,
    take_contact,
    unknowns_of,
)

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
    of_corners = unknowns_of(unknowns, corners)
    contacts.corners[slot] = corners
    contacts.unknowns[slot] = of_corners
    contacts.weights[slot] = wp.vec4(float(weights[0]), float(weights[1]), float(weights[2]), float(weights[3]))
    contacts.normal[slot] = to_single(normal)
    contacts.load[slot] = float(load)
    contacts.limit[slot] = friction * float(load)
    contacts.gradient[slot] = to_single(gradient)
    store_block(contacts.hessian, slot, hessian)
    contacts.key[slot] = key
    contacts.couples[slot] = couples(of_corners, weights)
    link_contact(contacts, world, slot, corners, weights)


@wp.func
def list_near(i: int, world: int, candidates: Candidates, trial: Trial) -> bool:
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
def find_near(
    i: int,
    world: int,
    motion: Motion,
    candidates: Candidates,
    settings: BarrierSettings,
    trial: Trial,
    unknowns: Unknowns,
    progress: Progress,
    contacts: Contacts,
):
    """Adds a contact if a candidate is near each other, and its energy."""
    corners, reach = integers_at(candidates.corners, i), wp.float64(candidates.reach[i])
    key = candidates.key[i] + wp.int64(0)
    kind = kind_of_key(key)
    u, v, w = seen_from_last(trial.exact, corners)
    apart = distance_bound(candidates, i, kind, u, v, w)
    candidates.now[i] = apart
    if wp.float64(apart) >= candidates.level[i] + reach:
        return
    a, b, c, d = corners_of(trial.exact, corners)
    weights, distance = barrier.closest_weights_and_gap(kind, a, b, c, d)
    candidates.now[i] = float(distance * wp.float64(ROUNDED_DOWN))
    gap = distance - candidates.level[i]
    if not gap > ZERO:
        add_energy(progress.energy, world, MEETS, settings.units)
        return
    normal = (weights[0] * a + weights[1] * b + weights[2] * c + weights[3] * d) / distance
    candidates.normal[i] = direction_in_bits(normal)
    if gap >= reach:
        return
    stiffness = stiffness_of_pair(candidates.stiffness[i], settings, trial, corners, reach)
    add_energy(progress.energy, world, stiffness * barrier.barrier_energy(gap, reach), settings.units)
    friction = pair_friction(motion, corners)
    _add_contact(
        motion,
        contacts,
        settings,
        trial,
        unknowns,
        world,
        corners,
        _merged(corners, weights),
        normal,
        wp.vec3d(),
        ZERO,
        gap,
        reach,
        stiffness,
        friction,
        key,
    )


@wp.func
def find_near_planes(
    vertex: int,
    world: int,
    motion: Motion,
    planes: MovingPlanes,
    plane_share: wp.array[float],
    settings: BarrierSettings,
    trial: Trial,
    unknowns: Unknowns,
    progress: Progress,
    contacts: Contacts,
):
    """Adds contacts for a vertex that is near infinite planes, and their energies."""
    if inverse_mass_of(motion, vertex) == 0.0:
        return
    for place in range(planes.of_worlds.shape[1]):
        i = planes.of_worlds[world, place]
        if i < 0:
            return
        plane = plane_at(planes, i, plane_share[world])
        distance, _error = signed_distance(plane, trial.exact[vertex])
        _kept, level, reach, _floor = gap_at_plane(motion, planes, settings, i, vertex, to_double(motion.x0[vertex]))
        gap = distance - level
        if gap >= reach:
            continue
        if not gap > ZERO:
            add_energy(progress.energy, world, MEETS, settings.units)
            continue
        normal = wp.vec3d(plane[0], plane[1], plane[2])
        stiffness = stiffness_at_plane(motion, settings, progress.fall[world], vertex, reach)
        add_energy(progress.energy, world, stiffness * barrier.barrier_energy(gap, reach), settings.units)
        key = key_of_pair(1, 0, vertex, i)
        there, _error_there = signed_distance(planes.end[i], trial.exact[vertex])
        since, _since_error = signed_distance(planes.start[i], trial.exact[vertex])
        _add_contact(
            motion,
            contacts,
            settings,
            trial,
            unknowns,
            world,
            wp.vec4i(vertex),
            wp.vec4d(ONE, ZERO, ZERO, ZERO),
            normal,
            (since - distance) * normal,
            distance - there,
            gap,
            reach,
            stiffness,
            friction_on_plane(motion, planes, i, vertex),
            key,
        )
