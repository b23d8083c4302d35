"""Energies of contacts, by which a Newton step is judged, in fixed point."""

import warp as wp

from ...response.contacts.rules import inverse_mass_of
from ...response.state.fixed_sum import add_units
from ...response.state.planes import signed_distance
from ...response.state.structs import Motion
from ...response.state.vectors import HALF, ZERO, corners_of, to_double
from ..elasticity.derivatives import element_energy
from ..elasticity.elements import kind_of
from ..vector_access import integers_at, numbers_at
from . import barrier
from .bodies import SolvedBodies, inertial_energy
from .distance_bounds import seen_from_last
from .flow import Place, Problem, end_at_planes, go_on, pair_count
from .pairs import (
    BarrierSettings,
    Trial,
    distance_bound,
    gap_at_plane,
    listed,
    plane_at,
    stiffness_at_plane,
    stiffness_of_pair,
)
from .system import Contacts, Unknowns, end_of_contacts, kind_of_key

wp.set_module_options({"enable_backward": False})

MEETS = wp.constant(wp.float64(1.0e30))
"""Energy of what meets [J]."""
_UNITS_LIMIT = wp.constant(wp.float64(2.0**52))
"""Most units of one energy: a thousand of them fit into a sum, and a speed of 900 m/s into one."""


@wp.func
def add_energy(energy: wp.array[wp.int64], world: int, value: wp.float64, units: wp.array[wp.float64]):
    """Adds an energy [J] to that of a world, in units, so that the sum does not depend on the order of threads."""
    scaled = wp.clamp(units[world] * value, -_UNITS_LIMIT, _UNITS_LIMIT)
    scaled = wp.where(wp.isfinite(value), scaled, _UNITS_LIMIT)
    add_units(energy, world, wp.int64(wp.rint(scaled)))


@wp.func
def add_inertia(
    u: int,
    world: int,
    motion: Motion,
    settings: BarrierSettings,
    trial: Trial,
    unknowns: Unknowns,
    bodies: SolvedBodies,
    energy: wp.array[wp.int64],
):
    """Adds the energy of inertia of an unknown at ``trial.moved`` to that of its world."""
    if unknowns.is_free[u] == 0:
        return
    p = unknowns.particle[u]
    if p < 0:
        body = unknowns.body[u]
        if u == bodies.unknown[body]:
            add_energy(energy, world, inertial_energy(bodies, motion, body, settings.dt), settings.units)
        return
    off = trial.moved[p] - to_double(trial.goal[p])
    add_energy(energy, world, HALF * unknowns.inertia[u] * wp.dot(off, off), settings.units)


@wp.func
def add_friction_energy(
    i: int,
    world: int,
    motion: Motion,
    contacts: Contacts,
    settings: BarrierSettings,
    trial: Trial,
    energy: wp.array[wp.int64],
):
    """Adds the work of friction over ``trial.moved``, under the load and along the plane of a contact."""
    corners, weights = integers_at(contacts.corners, i), numbers_at(contacts.weights, i)
    limit = wp.where(weights == wp.vec4(), 0.0, contacts.limit[i])  # 0 of what is merged
    if limit > 0.0:
        slid, normal = wp.vec3d(), to_double(contacts.normal[i])
        for j in range(4):
            v = corners[j]
            slid += wp.float64(weights[j]) * (trial.moved[v] - to_double(motion.x0[v]))
        slid -= wp.dot(slid, normal) * normal
        value = wp.float64(limit) * barrier.friction_energy(wp.length(slid), settings.smoothing)
        add_energy(energy, world, value, settings.units)


@wp.func
def find_energy(at: Place, p: Problem) -> wp.vec4i:
    """Finds the energy where vertices are moved to."""
    w, t, n, energy, units = at.world, at.thread, at.threads, p.progress.trial, p.settings.units
    from_middle = (t + n // 2) % n
    for k in range(p.worlds.first_element[w] + n - 1 - t, p.worlds.first_element[w + 1], n):
        i = p.worlds.elements[k] + int(0)
        if i < 0:
            continue
        of_element = element_energy(p.elements, i, kind_of(p.elements, i), p.trial.moved, p.motion.x0, p.settings.dt)
        add_energy(energy, w, of_element, units)
    for u in range(p.unknowns.of_worlds[w] + from_middle, p.unknowns.of_worlds[w + 1], n):
        add_inertia(u, w, p.motion, p.settings, p.trial, p.unknowns, p.bodies, energy)
    for i in range(p.contacts.start[w] + from_middle, end_of_contacts(p.contacts, w), n):
        add_friction_energy(i, w, p.motion, p.contacts, p.settings, p.trial, energy)
    for k in range(t, pair_count(p.candidates, p.progress, w, False), n):
        i = listed(p.candidates, w, k) >> 1
        corners, reach = integers_at(p.candidates.corners, i), wp.float64(p.candidates.reach[i])
        kind, level = kind_of_key(p.candidates.key[i]), p.candidates.level[i] + ZERO
        q, r, s = seen_from_last(p.trial.moved, corners)
        if wp.float64(distance_bound(p.candidates, i, kind, q, r, s)) >= level + reach:
            continue
        a, b, c, d = corners_of(p.trial.moved, corners)
        _weights, distance = barrier.closest_weights_and_gap(kind, a, b, c, d)
        gap = distance - level
        if gap < reach:
            value = MEETS
            if gap > ZERO:
                stiffness = stiffness_of_pair(p.candidates.stiffness[i], p.settings, p.trial, corners, reach)
                value = stiffness * barrier.barrier_energy(gap, reach)
            add_energy(energy, w, value, units)
    now = p.progress.plane_share[w] + float(0.0)
    then = now + (1.0 - now) * p.progress.scale[w]
    for k in range(p.worlds.first_vertex[w] + t, end_at_planes(p.worlds, p.vertices_at_planes, w), n):
        v = p.worlds.vertices[k] + int(0)
        if v >= p.vertices_at_planes or inverse_mass_of(p.motion, v) == 0.0:
            continue
        for place in range(p.planes.of_worlds.shape[1]):
            plane = p.planes.of_worlds[w, place]
            if plane < 0:
                break
            _kept, level, reach, _floor = gap_at_plane(
                p.motion, p.planes, p.settings, plane, v, to_double(p.motion.x0[v])
            )
            distance, _error = signed_distance(plane_at(p.planes, plane, then), p.trial.moved[v])
            gap = distance - level
            if gap < reach:
                value = MEETS
                if gap > ZERO:
                    value = stiffness_at_plane(p.motion, p.settings, p.progress.fall[w], v, reach)
                    value *= barrier.barrier_energy(gap, reach)
                add_energy(energy, w, value, units)
    return go_on(at, at.then)
