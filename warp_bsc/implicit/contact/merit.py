"""Energies of contacts, by which a Newton step is judged, in fixed point."""

import warp as wp

from ...response.contacts.rules import inverse_mass_of
from ...response.state.planes import MovingPlanes, signed_distance
from ...response.state.structs import Motion
from ...response.state.vectors import ZERO, corners_of, to_double
from ..vector_access import integers_at, numbers_at
from . import barrier
from .distance_bounds import seen_from_last
from .pairs import (
    BarrierSettings,
    Candidates,
    Trial,
    distance_bound,
    gap_at_plane,
    plane_at,
    stiffness_at_plane,
    stiffness_of_pair,
)
from .system import Contacts, Progress, kind_of_key

wp.set_module_options({"enable_backward": False})

MEETS = wp.constant(wp.float64(1.0e30))
"""Energy of what meets [J]."""
_UNITS_LIMIT = wp.constant(wp.float64(2.0**52))
"""Most units of one energy: a thousand of them fit into a sum, and a speed of 900 m/s into one."""


@wp.func_native(
    snippet="""
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 800
    // one atomic for all threads of a warp that are here, if of one world; in parts whose sums fit into 32 bits
    const unsigned mask = __activemask();
    int of_one_world;
    __match_all_sync(mask, world, &of_one_world);
    if (of_one_world) {
        unsigned long long bits = (unsigned long long)units;
        const unsigned low = __reduce_add_sync(mask, (unsigned)(bits & 0x3fffffu));
        const unsigned middle = __reduce_add_sync(mask, (unsigned)((bits >> 22) & 0x1fffffu));
        const unsigned high = __reduce_add_sync(mask, (unsigned)(bits >> 43));
        bits = low + ((unsigned long long)middle << 22) + ((unsigned long long)high << 43);
        if ((threadIdx.x & 31) == __ffs(mask) - 1)
            atomicAdd((unsigned long long*)&energy.data[world], bits);
        return;
    }
#endif
#if defined(__CUDA_ARCH__)
    atomicAdd((unsigned long long*)&energy.data[world], (unsigned long long)units);
#else
    energy.data[world] += units;
#endif
"""
)
def _add_units(energy: wp.array[wp.int64], world: int, units: wp.int64): ...


@wp.func
def add_energy(energy: wp.array[wp.int64], world: int, value: wp.float64, units: wp.array[wp.float64]):
    """Adds an energy [J] to that of a world, in units, so that the sum does not depend on the order of threads."""
    scaled = wp.clamp(units[world] * value, -_UNITS_LIMIT, _UNITS_LIMIT)
    scaled = wp.where(wp.isfinite(value), scaled, _UNITS_LIMIT)
    _add_units(energy, world, wp.int64(wp.rint(scaled)))


@wp.func
def add_pair_energy(
    i: int,
    world: int,
    candidates: Candidates,
    settings: BarrierSettings,
    trial: Trial,
    progress: Progress,
):
    """Adds the energy of the barrier of a candidate at the displaced positions."""
    corners, reach = integers_at(candidates.corners, i), wp.float64(candidates.reach[i])
    kind = kind_of_key(candidates.key[i])
    u, v, w = seen_from_last(trial.moved, corners)
    if wp.float64(distance_bound(candidates, i, kind, u, v, w)) >= candidates.level[i] + reach:
        return
    a, b, c, d = corners_of(trial.moved, corners)
    _weights, distance = barrier.closest_weights_and_gap(kind, a, b, c, d)
    gap = distance - candidates.level[i]
    if gap < reach:
        value = MEETS
        if gap > ZERO:
            stiffness = stiffness_of_pair(candidates.stiffness[i], settings, trial, corners, reach)
            value = stiffness * barrier.barrier_energy(gap, reach)
        add_energy(progress.trial, world, value, settings.units)


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
def add_plane_energies(
    vertex: int,
    world: int,
    motion: Motion,
    planes: MovingPlanes,
    plane_share: wp.array[float],
    settings: BarrierSettings,
    trial: Trial,
    progress: Progress,
):
    """Adds the energies of a vertex at infinite planes at the displaced positions."""
    if inverse_mass_of(motion, vertex) == 0.0:
        return
    scale, now = progress.scale[world], plane_share[world]
    for place in range(planes.of_worlds.shape[1]):
        i = planes.of_worlds[world, place]
        if i < 0:
            return
        _kept, level, reach, _floor = gap_at_plane(motion, planes, settings, i, vertex, to_double(motion.x0[vertex]))
        plane = plane_at(planes, i, now + (1.0 - now) * scale)
        distance, _error = signed_distance(plane, trial.moved[vertex])
        gap = distance - level
        if gap < reach:
            value = MEETS
            if gap > ZERO:
                value = stiffness_at_plane(motion, settings, progress.fall[world], vertex, reach)
                value *= barrier.barrier_energy(gap, reach)
            add_energy(progress.trial, world, value, settings.units)
