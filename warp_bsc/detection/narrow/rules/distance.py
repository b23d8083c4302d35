"""The narrow phase of pairs with a minimum distance: culls -> advancement -> subdivision -> exact phase.

The host decides the rest exactly. The minimum distance of a pair is the sum of two radii, rounded to double precision:
the radius of a vertex is its own, that of an edge or a face the largest one of its vertices.
"""

from typing import Any

import warp as wp

from ....kernels.min_distance import Search, advance, begin_search, clears_at_once, end_search, visit_part
from ....kernels.motion import all_finite, motion_and_distance
from ....kernels.pairs import distance_of_corners, ends_of, firsts_of, points_of_pair
from ....kernels.pipeline.queues import filled_entries, take_slot
from ....kernels.polynomials import Motion
from ....kernels.signs import FREE, HIT, ROUNDOFF, UNSURE
from ...run.launch import launch_over, made_once
from ...run.phase_timer import PhaseTimer
from ...run.settings import NO_FUSED_OPERATIONS, TOLERANCE, Count, Method
from ..exact_phase import launch_exact_distances
from ..narrow_phase import Phases, buffers_of, launch_culls
from ..pair_kernels import PairBuffers, PairRule, count_found, take_contact, write_decision, write_impact
from ..rings import Rings, are_within_rings

_BLOCK = 64
"""Threads of a block that searches."""
_ADVANCING, _SUBDIVIDING = 384, 256
"""Threads of a multiprocessor that search, limited by their registers, each for one pair after another. On a CPU, each
thread searches for one pair."""


@wp.struct
class Options:
    """Options of the rule."""

    radius: wp.array[wp.float64]  # of each vertex
    rings: Rings  # vertices whose elements are excluded
    # body of each vertex: pairs whose vertices are all of one body from -1 are excluded. Without it none are.
    body: wp.array[int]
    roundoff: wp.float64  # roundoff of floating point, 0 if its computed signs decide
    timed: bool  # whether to find times of impact within the tolerance
    tolerance: wp.float64  # of the times of impact, as a share of the step


@wp.func
def _excludes(options: Options, kind: int, v: wp.vec4i) -> bool:
    if not options.body:
        return False
    b = options.body[v[0]]
    return b >= -1 and options.body[v[1]] == b and options.body[v[2]] == b and options.body[v[3]] == b


@wp.func
def _clears(options: Options, kind: int, v: wp.vec4i, x0: wp.array[Any], x1: wp.array[Any]) -> bool:
    a0, b0, c0, d0, a1, b1, c1, d1 = ends_of(x0, x1, v)
    distance = distance_of_corners(kind, v, options.radius)
    motion, scaled = motion_and_distance(kind, a0, b0, c0, d0, a1, b1, c1, d1, distance, options.roundoff)
    return clears_at_once(motion, scaled) or are_within_rings(v, firsts_of(kind), options.rings)


_RULE = PairRule(Options, _excludes, _clears)


@wp.struct
class _PairSearch:
    """A search, its motion, and the minimum distance in the scale of that."""

    motion: Motion
    distance: wp.float64
    search: Search


@wp.func
def _decide_contact(k: int, kind: int, at: _PairSearch, timed: bool, buffers: PairBuffers):
    """Writes the result of a search to contact k, if that is not negative, and counts it if it is not free."""
    result = end_search(kind, at.motion, at.search)
    if result.status != FREE:
        count_found(result.status, buffers)
    if result.status == UNSURE or (timed and result.status == HIT and result.within_tolerance == 0):
        take_slot(buffers.counts, Count.FOR_EXACT)
    if k >= 0:
        write_impact(k, result, buffers)
        write_decision(k, result.status, buffers)


@made_once
def _search_kernels(dtype: type) -> tuple[wp.Kernel, wp.Kernel]:
    """Returns the kernels that advance and that subdivide, for one type of position."""

    @wp.func
    def search_next(
        before: _PairSearch,
        kind: int,
        # mesh
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        elements: wp.array2d[int],
        # next pair
        pairs: wp.array[wp.vec2i],
        index: int,
        options: Options,
    ) -> _PairSearch:
        """Returns a search that has not ended as it is, otherwise one that begins with the next pair."""
        # this return keeps Warp from selecting between two searches, which takes registers for both
        if not before.search.ended:
            return before
        new = _PairSearch()
        v = points_of_pair(kind, elements, pairs[index])
        a0, b0, c0, d0, a1, b1, c1, d1 = ends_of(x0, x1, v)
        distance = distance_of_corners(kind, v, options.radius)
        motion, scaled = motion_and_distance(kind, a0, b0, c0, d0, a1, b1, c1, d1, distance, options.roundoff)
        new.motion = motion
        new.distance = scaled
        new.search = begin_search(motion, scaled, options.tolerance)
        new.search.ended = not all_finite(a0, b0, c0, d0, a1, b1, c1, d1)
        return new

    @wp.kernel(**NO_FUSED_OPERATIONS)
    def advance_distances(
        first: int,
        # mesh
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        # in
        options: Options,
        kind: int,
        threads: wp.uint32,
        # in and out
        buffers: PairBuffers,
    ):
        filled = wp.uint32(filled_entries(buffers.survivors, buffers.counts, Count.SURVIVORS))
        i = wp.uint32(first + wp.tid())
        at = _PairSearch()
        at.search.ended = True
        # the threads of a warp advance together, each with a pair of its own
        while i < filled:
            at = search_next(at, kind, x0, x1, buffers.elements, buffers.survivors, int(i), options)
            at.search = advance(at.motion, at.distance, options.timed, at.search)
            if at.search.ended and at.search.status != FREE:
                k = take_contact(buffers.survivors[int(i)], buffers)
                if not at.search.given_up:
                    _decide_contact(k, kind, at, options.timed, buffers)
                elif k >= 0:
                    buffers.for_exact[wp.int32(take_slot(buffers.counts, Count.SUBDIVIDED))] = k
            if at.search.ended:
                i += threads

    @wp.kernel(**NO_FUSED_OPERATIONS)
    def subdivide_distances(
        first: int,
        # mesh
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        # in
        options: Options,
        kind: int,
        threads: wp.uint32,
        # in and out
        buffers: PairBuffers,
    ):
        filled = wp.uint32(buffers.counts[Count.SUBDIVIDED])
        i = wp.uint32(first + wp.tid())
        at = _PairSearch()
        at.search.ended = True
        while i < filled:
            k = buffers.for_exact[int(i)]
            at = search_next(at, kind, x0, x1, buffers.elements, buffers.contacts.pairs, k, options)
            at.search = visit_part(kind, at.motion, at.distance, options.timed, at.search)
            if at.search.ended:
                _decide_contact(k, kind, at, options.timed, buffers)
                i += threads

    return advance_distances, subdivide_distances


def run_distances(
    phases: Phases,
    x0: wp.array,
    x1: wp.array,
    radius: wp.array,
    rings: Rings,
    *,
    method: Method,
    body: wp.array | None = None,
    timed: bool = True,
    tolerance: float = TOLERANCE,
    timer: PhaseTimer,
) -> None:
    """Launches all phases but the sorting over the queued pairs, without synchronizing with a GPU.

    Arguments are those of :func:`.run_contacts` and the :class:`Options`. With "exact", pairs that stay UNSURE are
    delegated to :func:`.decide_on_host`.
    """
    options = Options()
    options.radius, options.rings, options.body = radius, rings, body
    options.roundoff = 0.0 if method == "float" else ROUNDOFF
    options.timed, options.tolerance = timed, tolerance
    buffers, device = buffers_of(phases), x0.device
    with timer.phase("cull"):
        launch_culls(_RULE, buffers, x0, x1, options)
    advance_distances, subdivide_distances = _search_kernels(x0.dtype)
    for name, kernel, count, threads_of_multiprocessor in (
        ("classify", advance_distances, Count.SURVIVORS, _ADVANCING),
        ("time of impact", subdivide_distances, Count.SUBDIVIDED, _SUBDIVIDING),
    ):
        with timer.phase(name):
            for kind, s in buffers.items():
                entries = threads = threads_of_multiprocessor * device.sm_count
                if device.is_cpu:
                    entries = min(len(s.survivors), int(s.counts.numpy()[count]))
                    threads = 2**31
                inputs = [x0, x1, options, int(kind), threads]
                launch_over(kernel, entries, inputs=inputs, outputs=[s], device=device, block_dim=_BLOCK)
    if method == "exact":
        with timer.phase("exact"):
            of_times = {"timed": timed, "tolerance": tolerance}
            for kind, s in buffers.items():
                launch_exact_distances(x0, x1, radius, kind, **of_times, buffers=s)
