"""Bounds on the displacements of a Newton step: the share of them before two elements meet."""

import warp as wp

from ...response.contacts.rules import inverse_mass_of
from ...response.state.planes import signed_distance
from ...response.state.vectors import ZERO, corners_of, to_double, to_single
from ..vector_access import integers_at
from . import barrier
from .distance_bounds import (
    ROUNDED_DOWN,
    ROUNDED_UP,
    direction_of_bits,
    distance_along,
    distance_of_ways,
    rounding_of,
    seen_from_last,
    way_together,
)
from .flow import Phase, Place, Problem, end_at_planes, go_on, pair_count
from .pairs import (
    FAR,
    FAR_TOGETHER,
    Candidates,
    Trial,
    add_to_list,
    candidate,
    distance_bound,
    gap_at_plane,
    kept_distance,
    listed,
    moved,
    plane_at,
    stays_far,
)
from .system import Progress, kind_of_key, lower_to

wp.set_module_options({"enable_backward": False})


_WAYS = wp.constant(float(6.0 * (1.0 + 2.0**-18)))
"""So many displacements are in :func:`.distance_bounds.way_together` at most, and arcs beside them, with rounding."""


@wp.func
def _bends(trial: Trial, scale: float, corners: wp.vec4i) -> wp.vec2:
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
    return wp.vec2(first + second, share * first + other * second)


@wp.func
def _end_of(trial: Trial, scale: float, vertex: int) -> wp.vec3:
    """Returns where a vertex is after a share of its displacement, as it is kept."""
    return to_single(moved(trial, scale, vertex))


@wp.func
def _last_of_pair(i: int, candidates: Candidates) -> wp.vec4:
    """Returns what tells most candidates apart, for :func:`_list_pair`: read ahead, as most of the time is waiting."""
    within = ROUNDED_UP * (float(kept_distance(candidates, i)) + candidates.reach[i])
    return wp.vec4(candidates.share[i], candidates.now[i], candidates.apart[i], within)


@wp.func
def _list_pair(
    i: int, last: wp.vec4, world: int, candidates: Candidates, trial: Trial, progress: Progress, is_shorter: bool
) -> bool:
    """Lists a candidate that displacements may bring within its reach; returns whether :func:`bound` goes on with it.

    Displacements that are parts of those of the last time are shorter: what was far from each other is so still, and
    what did not meet, or was far from each other as all its vertices do the same, does so where none is cut since.
    """
    before, now, within = last[0], last[1], last[3]
    stays = stays_far(last[2], progress, world)
    if before == FAR and (is_shorter or stays):
        return False
    if before == FAR_TOGETHER and not is_shorter:
        # no displacements that long bring it within its reach, whichever of its vertices have them
        left = ROUNDED_DOWN * now - _WAYS * progress.longest[world]
        if left >= within:
            candidates.now[i] = left
            return False
    corners, kind = integers_at(candidates.corners, i), kind_of_key(candidates.key[i])
    if is_shorter and (before == 1.0 or before == FAR_TOGETHER):
        cuts = int(0)
        for j in range(4):
            cuts += trial.cut[trial.holder[corners[j]]]
        if cuts == 0:
            if before == 1.0:
                add_to_list(candidates, world, kind, i, False)
            return False
    candidates.share[i] = FAR
    if stays:
        return False
    p, q, r = seen_from_last(trial.displaced, corners)
    bends = trial.bend[corners[0]] + trial.bend[corners[1]] + trial.bend[corners[2]] + trial.bend[corners[3]]
    bend, way = ROUNDED_UP * bends, way_together(kind, p, q, r)
    within = ROUNDED_UP * (within + bend)
    left = ROUNDED_DOWN * now - way
    if is_shorter or before != FAR_TOGETHER or left < within:  # positions are read where displacements do not tell
        a, b, c = seen_from_last(trial.x, corners)
        if before >= FAR:
            now = distance_bound(candidates, i, kind, a, b, c)
        left = 0.0
        if now >= within and is_shorter:  # its vertices may take different parts
            s = trial.displaced[corners[3]] + wp.vec3()
            rounding = rounding_of(a, b, c) + rounding_of(p + s, q + s, r + s) + rounding_of(s, s, s)
            if distance_of_ways(kind, a, b, c, p + s, q + s, r + s, s) - rounding >= within:
                return False
        elif now >= within:
            # what moves together is as far from each other along a vector as at the start or the end, or farther
            rounding = rounding_of(a, b, c) + rounding_of(p, q, r)
            n = direction_of_bits(candidates.normal[i])
            at_start = distance_along(kind, n, a, b, c)
            at_end = distance_along(kind, n, a + p, b + q, c + r)
            left = wp.max(wp.min(at_start, at_end), distance_of_ways(kind, a, b, c, p, q, r, wp.vec3())) - rounding
            left = wp.max(ROUNDED_DOWN * now - way, left)
    if left >= within:
        candidates.share[i] = FAR_TOGETHER
        candidates.now[i] = ROUNDED_DOWN * left - bend
        return False
    candidates.now[i] = now
    candidates.share[i] = 1.0
    add_to_list(candidates, world, kind, i, True)
    return True


@wp.func
def _share_of_pair(i: int, scale: float, candidates: Candidates, trial: Trial) -> float:
    """Returns the share of displacements up to which a candidate does not meet."""
    corners, kind = integers_at(candidates.corners, i), kind_of_key(candidates.key[i])
    kept = kept_distance(candidates, i)
    reach, floor = candidates.reach[i] + float(0.0), candidates.floor[i] + float(0.0)
    now = candidates.now[i] + float(0.0)
    a, b, c = seen_from_last(trial.x, corners)
    p = _end_of(trial, scale, corners[0]) - trial.x[corners[0]]
    q = _end_of(trial, scale, corners[1]) - trial.x[corners[1]]
    r = _end_of(trial, scale, corners[2]) - trial.x[corners[2]]
    s = _end_of(trial, scale, corners[3]) - trial.x[corners[3]]
    bends = _bends(trial, scale, corners)
    rounding = rounding_of(p, q, r) + rounding_of(s, s, s)
    way = way_together(kind, p - s, q - s, r - s) + rounding + bends[0]
    gap = ROUNDED_DOWN * now - ROUNDED_UP * float(kept)
    # the closest points are found for what comes near
    if way <= ROUNDED_DOWN * (gap - barrier.least_gap(gap, reach, floor)):
        return 1.0
    apart = distance_of_ways(kind, a, b, c, p - s, q - s, r - s, wp.vec3()) - rounding_of(a, b, c) - rounding
    if apart >= ROUNDED_UP * (float(kept) + bends[0] + barrier.MOST_LEFT * reach):
        return 1.0
    e, f, g, h = corners_of(trial.x, corners)
    _weights, distance = barrier.closest_weights_and_gap(kind, e, f, g, h)
    least = barrier.least_gap(distance - kept, wp.float64(reach), wp.float64(floor))
    if wp.float64(ROUNDED_UP * way) <= distance - kept - least:
        return 1.0
    # what other pairs allow: more than that changes nothing
    limit = trial.limit
    most = wp.max(wp.max(limit[corners[0]], limit[corners[1]]), wp.max(limit[corners[2]], limit[corners[3]]))
    of_bends = wp.vec2d(wp.float64(bends[0]), wp.float64(bends[1]))
    displaced = barrier.Corners()
    for j in range(4):
        displaced[j] = to_double(_end_of(trial, scale, corners[j])) - to_double(trial.x[corners[j]])
    x = wp.matrix_from_rows(e, f, g, h)
    share = float(barrier.safe_share(kind, x, displaced, kept + least, most, of_bends))
    candidates.share[i] = share
    return share


@wp.func
def list_ways(at: Place, p: Problem) -> wp.vec4i:
    """Lists candidates that displacements may bring together."""
    w, count = at.world, pair_count(p.candidates, p.progress, at.world, True)
    following, of_following = int(0), wp.vec4()
    for k in range(at.thread - at.threads, count, at.threads):
        i, last = int(following), wp.vec4(of_following)
        if k + at.threads < count:
            following = candidate(p.candidates, w, k + at.threads)
            of_following = _last_of_pair(following, p.candidates)
        if k >= 0:
            _list_pair(i, last, w, p.candidates, p.trial, p.progress, at.passes > 0)
    return go_on(at, Phase.BOUND)


@wp.func
def bound(at: Place, p: Problem) -> wp.vec4i:
    """Finds the share of displacements before something meets, by listed candidates or by all, and by planes.

    That of vertices, and of their world.
    """
    w, at_once, limit = at.world, at.phase == Phase.LIST_AND_BOUND, p.trial.limit
    scale = p.progress.scale[w] + float(0.0)
    for k in range(at.thread, pair_count(p.candidates, p.progress, w, at_once), at.threads):
        i, is_new = int(0), bool(False)
        if at_once:
            i = candidate(p.candidates, w, k)
            last = _last_of_pair(i, p.candidates)
            is_new = _list_pair(i, last, w, p.candidates, p.trial, p.progress, at.passes > 0)
        else:
            entry = listed(p.candidates, w, k)
            i, is_new = entry >> 1, (entry & 1) != 0
        if not is_new:
            continue
        corners, share = integers_at(p.candidates.corners, i), _share_of_pair(i, scale, p.candidates, p.trial)
        if share < 1.0:
            lower_to(p.progress.bound, w, share)
            for j in range(4):
                lower_to(limit, corners[j], share)
                if p.trial.holder[corners[j]] != corners[j]:
                    lower_to(limit, p.trial.holder[corners[j]], share)
    now = p.progress.plane_share[w] + float(0.0)
    then = now + (1.0 - now) * scale
    for k in range(p.worlds.first_vertex[w] + at.thread, end_at_planes(p.worlds, p.vertices_at_planes, w), at.threads):
        v = p.worlds.vertices[k] + int(0)
        if v >= p.vertices_at_planes or inverse_mass_of(p.motion, v) == 0.0:
            continue
        for place in range(p.planes.of_worlds.shape[1]):
            plane = p.planes.of_worlds[w, place]
            if plane < 0:
                break
            kept, _level, reach, floor = gap_at_plane(
                p.motion, p.planes, p.settings, plane, v, to_double(p.motion.x0[v])
            )
            if reach == ZERO:
                continue
            before, _error = signed_distance(plane_at(p.planes, plane, now), p.trial.x[v])
            after, _error_after = signed_distance(plane_at(p.planes, plane, then), _end_of(p.trial, scale, v))
            gap, left = before - kept, after - kept
            least = barrier.least_gap(gap, reach, floor)
            taken = scale * p.trial.share[p.trial.holder[v]]
            bend = wp.float64(taken * p.trial.bend[v])
            flat = wp.float64(taken) * bend
            rate, low = gap - left + bend, gap - least
            square = rate * rate - wp.float64(4.0) * flat * low
            if low - rate + flat < ZERO or (square > ZERO and rate > ZERO and rate < wp.float64(2.0) * flat):
                until = float(wp.float64(2.0) * low / (rate + wp.sqrt(wp.max(square, ZERO))))
                lower_to(p.progress.bound, w, until)
                lower_to(limit, p.trial.holder[v], until)
    return go_on(at, at.then)
