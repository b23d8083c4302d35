"""Bounds on the displacements of a Newton step: the share of them before two elements meet."""

import warp as wp

from ...response.contacts.rules import inverse_mass_of
from ...response.state.planes import MovingPlanes, signed_distance
from ...response.state.structs import Motion
from ...response.state.vectors import ZERO, corners_of, to_double, to_single
from . import barrier
from .pairs import (
    FAR,
    FAR_TOGETHER,
    ROUNDED_DOWN,
    BarrierSettings,
    Candidates,
    Trial,
    add_to_list,
    distance_bound,
    gap_at_plane,
    kept_distance,
    moved,
    plane_at,
    stays_far,
)
from .system import Progress, kind_of_key, lower_to
from .vector_access import direction_of_bits, integers_at

wp.set_module_options({"enable_backward": False})


_WAYS = wp.constant(wp.float64(6.0 * (1.0 + 2.0**-18)))
"""So many displacements are in :func:`_relative_way` at most, and arcs beside them; and more than rounding changes."""


@wp.func
def _bends(trial: Trial, scale: float, corners: wp.vec4i) -> wp.vec2d:
    """Returns how far shares of displacements may be off, as :func:`.barrier.safe_share` takes it."""
    first, second = float(0.0), float(0.0)
    for k in range(2):  # corners 0 and 3 are of different elements
        of_first = trial.holder[corners[k]] == trial.holder[corners[0]]
        first = wp.max(first, wp.where(of_first, trial.bend[corners[k]], 0.0))
    for k in range(1, 4):
        of_second = trial.holder[corners[k]] == trial.holder[corners[3]]
        second = wp.max(second, wp.where(of_second, trial.bend[corners[k]], 0.0))
    share = scale * trial.share[trial.holder[corners[0]]]
    other = scale * trial.share[trial.holder[corners[3]]]
    first, second = share * first, other * second
    return wp.vec2d(wp.float64(first + second), wp.float64(share * first + other * second))


@wp.func
def _relative_way(p: wp.vec3d, q: wp.vec3d, r: wp.vec3d, s: wp.vec3d) -> wp.float64:
    """Returns how much nearer displacements of corners bring two elements at most: what all do does not count."""
    return wp.length(p - r) + wp.length(q - r) + wp.length(s - r)


@wp.func
def list_pair(i: int, world: int, candidates: Candidates, trial: Trial, progress: Progress, is_shorter: bool) -> bool:
    """Lists a candidate that displacements may bring within its reach; returns whether :func:`bound_by_pair` follows.

    Displacements that are parts of those of the last time are shorter: what was far from each other is so still, and
    what did not meet, or was far from each other as all its vertices do the same, does so where none is cut since.
    """
    # read side by side: most of the time is waiting for memory
    before, now = candidates.share[i] + float(0.0), wp.float64(candidates.now[i])
    kept, reach = kept_distance(candidates, i), wp.float64(candidates.reach[i])
    stays = stays_far(candidates.apart[i] + float(0.0), progress, world)
    if before == FAR and (is_shorter or stays):
        return False
    if before == FAR_TOGETHER and not is_shorter:
        # no displacements that long bring it within its reach, whichever of its vertices have them
        left = now - _WAYS * wp.float64(progress.longest[world])
        if left >= kept + reach:
            candidates.now[i] = float(ROUNDED_DOWN * left)
            return False
    corners = integers_at(candidates.corners, i)
    if is_shorter and (before == 1.0 or before == FAR_TOGETHER):
        cuts = int(0)
        for j in range(4):
            cuts += trial.cut[trial.holder[corners[j]]]
        if cuts == 0:
            if before == 1.0:
                add_to_list(candidates, world, i, False)
            return False
    candidates.share[i] = FAR
    if stays:
        return False
    kind = kind_of_key(candidates.key[i])
    p, q, r, s = corners_of(trial.displaced, corners)
    bends = trial.bend[corners[0]] + trial.bend[corners[1]] + trial.bend[corners[2]] + trial.bend[corners[3]]
    bend, way = wp.float64(bends), _relative_way(p, q, r, s)
    within = kept + reach + bend
    left = now - way
    if is_shorter or before != FAR_TOGETHER or left < within:  # positions are read where displacements do not tell
        a, b, c, d = corners_of(trial.x, corners)
        if before >= FAR:
            now = distance_bound(candidates, i, kind, a, b, c, d)
        left = ZERO
        if now >= within and not is_shorter:
            # what moves together is as far from each other along a vector as at the start or the end, or farther
            n = direction_of_bits(candidates.normal[i])
            at_start = barrier.distance_along(kind, n, a, b, c, d)
            at_end = barrier.distance_along(kind, n, a + p, b + q, c + r, d + s)
            left = wp.max(now - way, ROUNDED_DOWN * wp.min(at_start, at_end))
    if left >= within:
        candidates.share[i] = FAR_TOGETHER
        candidates.now[i] = float(ROUNDED_DOWN * (left - bend))
        return False
    if now >= within and barrier.distance_of_ways(kind, a, b, c, d, p, q, r, s) >= within:
        return False
    candidates.now[i] = float(now)
    candidates.share[i] = 1.0
    add_to_list(candidates, world, i, True)
    return True


@wp.func
def bound_by_pair(
    i: int,
    world: int,
    candidates: Candidates,
    trial: Trial,
    progress: Progress,
    limit: wp.array[float],
):
    """Finds the share of displacements up to which a candidate does not meet: for its vertices, and for its world."""
    corners, kind, kept = (
        integers_at(candidates.corners, i),
        kind_of_key(candidates.key[i]),
        kept_distance(candidates, i),
    )
    reach, floor = wp.float64(candidates.reach[i]), wp.float64(candidates.floor[i])
    now = wp.float64(candidates.now[i])
    a, b, c, d = corners_of(trial.x, corners)
    scale = progress.scale[world]
    p = to_double(to_single(moved(trial, scale, corners[0]))) - a
    q = to_double(to_single(moved(trial, scale, corners[1]))) - b
    r = to_double(to_single(moved(trial, scale, corners[2]))) - c
    s = to_double(to_single(moved(trial, scale, corners[3]))) - d
    bends = _bends(trial, scale, corners)
    way = _relative_way(p, q, r, s) + bends[0]
    # the closest points are found for what comes near
    if way <= now - kept - barrier.least_gap(now - kept, reach, floor):
        return
    apart = barrier.distance_of_ways(kind, a, b, c, d, p - r, q - r, wp.vec3d(), s - r)
    if apart >= kept + bends[0] + barrier.MOST_LEFT * reach:
        return
    _weights, distance = barrier.closest_weights_and_gap(kind, a, b, c, d)
    least = barrier.least_gap(distance - kept, reach, floor)
    if way <= distance - kept - least:
        return
    # what other pairs allow: more than that changes nothing
    most = wp.max(wp.max(limit[corners[0]], limit[corners[1]]), wp.max(limit[corners[2]], limit[corners[3]]))
    share = float(barrier.safe_share(kind, a, b, c, d, p, q, r, s, kept + least, most, bends))
    candidates.share[i] = share
    if share < 1.0:
        lower_to(progress.bound, world, share)
        for j in range(4):
            lower_to(limit, corners[j], share)
            if trial.holder[corners[j]] != corners[j]:
                lower_to(limit, trial.holder[corners[j]], share)


@wp.func
def bound_by_planes(
    vertex: int,
    world: int,
    motion: Motion,
    planes: MovingPlanes,
    plane_share: wp.array[float],
    settings: BarrierSettings,
    trial: Trial,
    progress: Progress,
    limit: wp.array[float],
):
    """Finds the share of displacements up to which a vertex meets no infinite plane, as :func:`bound_by_pair`."""
    if inverse_mass_of(motion, vertex) == 0.0:
        return
    scale, now = progress.scale[world], plane_share[world]
    for place in range(planes.of_worlds.shape[1]):
        i = planes.of_worlds[world, place]
        if i < 0:
            return
        kept, _level, reach, floor = gap_at_plane(motion, planes, settings, i, vertex)
        if reach == ZERO:
            continue
        before, _error = signed_distance(plane_at(planes, i, now), trial.x[vertex])
        then = now + (1.0 - now) * scale
        after, _error_after = signed_distance(plane_at(planes, i, then), to_single(moved(trial, scale, vertex)))
        gap, left = before - kept, after - kept
        least = barrier.least_gap(gap, reach, floor)
        taken = scale * trial.share[trial.holder[vertex]]
        bend = wp.float64(taken * trial.bend[vertex])
        flat = wp.float64(taken) * bend
        rate, low = gap - left + bend, gap - least
        square = rate * rate - wp.float64(4.0) * flat * low
        if low - rate + flat < ZERO or (square > ZERO and rate > ZERO and rate < wp.float64(2.0) * flat):
            share = float(wp.float64(2.0) * low / (rate + wp.sqrt(wp.max(square, ZERO))))
            lower_to(progress.bound, world, share)
            lower_to(limit, trial.holder[vertex], share)
