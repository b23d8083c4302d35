"""What each world does next in a Newton step: hold pairs, cut, search, end, or go back."""

import warp as wp

from ...response.state.vectors import ZERO
from .flow import Phase, Place, Problem, go_on, go_on_with_pairs
from .system import Progress, Unknowns, is_near_end

wp.set_module_options({"enable_backward": False})

_NOISE = wp.constant(wp.float64(1e-9))
"""Rise of energy that may be rounding, as a share of it."""
PATH = wp.constant(8)
"""Newton steps of which positions are kept."""
_LEAST_DAMPING, _GROWTH = wp.constant(float(2.0**-4)), wp.constant(float(1.1))
"""Least share of displacements that a world takes where it goes to and fro, and factor by which that grows again."""
_DAMPED_FROM = wp.constant(10)
"""Newton steps that are not damped: most steps end before, and would end later if they were."""
_LEAST_SCALE = wp.constant(float(2.0**-12))


@wp.func
def take_bound(at: Place, p: Problem) -> wp.vec4i:
    """Takes the share of the world down to its bound."""
    if at.thread == 0:
        p.progress.scale[at.world] = p.progress.scale[at.world] * p.progress.bound[at.world]
    return go_on(at, Phase.MOVE)


@wp.func
def may_cut(progress: Progress, w: int) -> bool:
    """Returns whether cuts of vertices may let a world go further: not while something that a program moves comes."""
    return progress.scale[w] < progress.damping[w] and progress.remaining[w] == 0.0


@wp.func
def _falls(progress: Progress, w: int) -> bool:
    """Returns whether the energy of a world is lower at the displaced positions, as far as rounding tells."""
    before = wp.float64(progress.energy[w])
    return wp.float64(progress.trial[w]) <= before + _NOISE * wp.abs(before)


@wp.func
def rises(w: int, progress: Progress) -> bool:
    """Returns whether the energy of a world rises on displacements that are solved with pairs held."""
    return progress.held[w] != 0 and progress.remaining[w] == 0.0 and not _falls(progress, w)


@wp.func
def take_cut(at: Place, p: Problem) -> wp.vec4i:
    """Keeps the energy of a world before single vertices were cut, and takes its bound after that."""
    w, progress = at.world, p.progress
    if at.thread == 0:
        progress.uncut[w] = progress.trial[w]
        progress.trial[w] = wp.int64(0)
        progress.scale[w] = progress.scale[w] * progress.bound[w]
    return go_on_with_pairs(at, Phase.MOVE, Phase.CHOOSE_CUTS)


@wp.func
def choose_cuts(at: Place, p: Problem) -> wp.vec4i:
    """Keeps the cuts of single vertices in a world whose energy is lower with them."""
    w, progress = at.world, p.progress
    if at.thread == 0:
        cuts = progress.trial[w] < progress.uncut[w]
        if not cuts:
            progress.trial[w] = progress.uncut[w]
            progress.scale[w] = progress.whole[w]
        progress.cuts[w] = int(cuts)
    return go_on(at, Phase.UNDO_CUTS)


@wp.func
def is_far(w: int, far_change: float, progress: Progress) -> bool:
    """Returns whether a world may be far from its end: in its first Newton step, or after a large change or none.

    Hessians of elements are then without what curves downwards, so that the energy falls. Near the end they are exact:
    compressed cloth is softer than without, and changes would become less by a half or less in each Newton step.
    """
    before = progress.before[w]
    return progress.steps[w] == 0 or before > far_change or before < 0.0


@wp.func
def begin(at: Place, p: Problem) -> wp.vec4i:
    """Begins the first Newton step."""
    if at.thread == 0:
        _begin_newton_step(at.world, p.progress)
    return go_on(at, Phase.DIFFERENTIATE)


@wp.func
def _begin_newton_step(w: int, progress: Progress):
    """Clears what a Newton step measures of a world."""
    progress.before[w] = wp.where(progress.scale[w] > 0.0, progress.scale[w] * progress.change[w], -1.0)
    progress.change[w] = 0.0
    progress.remaining[w] = 0.0
    progress.cuts[w] = 0
    progress.held[w] = 0
    progress.scale_before[w] = progress.scale[w]
    progress.scale[w] = progress.damping[w]
    progress.bound[w] = 1.0
    progress.square_before[w] = progress.square[w]
    progress.square[w] = wp.int64(0)
    progress.product[w] = wp.int64(0)
    progress.energy[w] = wp.int64(0)
    progress.trial[w] = wp.int64(0)


@wp.func
def _damp(w: int, progress: Progress):
    """Chooses the share that a world takes at most in its next Newton step.

    Load, direction and place of friction are those where a Newton step begins, so that Newton steps may go to and fro
    for ever: the energy then is higher than the one that the last Newton step has reached. Where a displacement is q
    times the last one, of which a share s was taken, the share s / (1 - q) leads to the end, by Aitken's method. Shares
    grow slowly again.

    References:
        B. M. Irons and R. C. Tuck, A Version of the Aitken Accelerator for Computer Iteration, International Journal
        for Numerical Methods in Engineering 1(3), 1969, doi:10.1002/nme.1620010306.
    """
    before, now = wp.float64(progress.square_before[w]), wp.float64(progress.square[w])
    product, damping = wp.float64(progress.product[w]), progress.damping[w] + float(0.0)
    most, changed = wp.min(_GROWTH * damping, 1.0), before - wp.float64(2.0) * product + now
    energy, reached = wp.float64(progress.energy[w]), wp.float64(progress.reached[w])
    lags = energy > reached + _NOISE * wp.abs(reached)
    falls_fast = damping == 1.0 and wp.float64(4.0) * now <= before
    progress.damping[w] = most
    if lags and not falls_fast and progress.steps[w] >= _DAMPED_FROM and before > ZERO and changed > ZERO:
        share = progress.scale_before[w] * float((before - product) / changed)
        progress.damping[w] = wp.clamp(share, _LEAST_DAMPING, most)


@wp.func
def takes(w: int, progress: Progress) -> bool:
    """Returns whether a world takes its share: its energy falls, what a program moves comes, or it takes none."""
    return progress.remaining[w] > 0.0 or progress.scale[w] == 0.0 or _falls(progress, w)


@wp.func
def decide(at: Place, p: Problem) -> wp.vec4i:
    """Halves the share of a world that has not taken it, or ends its Newton step.

    A world ends whose unknowns hardly change, or that has taken all its Newton steps; others begin the next one. They
    are counted from when what a program moves arrives, if it does.
    """
    w, progress, following = at.world, p.progress, go_on(at, Phase.NEXT)
    if at.thread != 0:
        return following
    takes_share, reaches = takes(w, progress), progress.trial[w] + wp.int64(0)
    progress.trial[w] = wp.int64(0)
    progress.searches[w] = int(not takes_share)
    if not takes_share:
        progress.scale[w] = 0.5 * progress.scale[w]
        if progress.scale[w] < _LEAST_SCALE:
            progress.scale[w] = 0.0
        return following
    scale, was_far = progress.scale[w] + float(0.0), is_far(w, p.far_change, progress)
    planes = progress.plane_share[w] + float(0.0)
    progress.plane_share[w] = wp.where(scale == 1.0, 1.0, planes + (1.0 - planes) * scale)
    steps = progress.steps[w] + 1
    progress.steps[w] = steps
    arrived = scale == 1.0 or progress.remaining[w] == 0.0
    if progress.remaining[w] > 0.0:
        progress.late[w] = steps - 1
    progress.driven[w] = wp.max(progress.driven[w], progress.remaining[w])
    ends = arrived and (is_near_end(progress, w, p.least_change) or steps - progress.late[w] >= p.max_steps)
    if scale == 0.0 and arrived:
        ends = ends or was_far
    if ends or (steps >= p.max_late_steps and not arrived):
        progress.active[w] = 0
        return following
    if arrived and progress.held[w] == 0 and progress.cuts[w] == 0:
        _damp(w, progress)
    progress.reached[w] = reaches
    _begin_newton_step(w, progress)
    return following


@wp.func
def _moves_bodies(unknowns: Unknowns, w: int) -> bool:
    """Returns whether a body is solved for in a world, whose last unknowns are those of bodies."""
    u = unknowns.of_worlds[w + 1] - 1
    moves = bool(False)
    while u >= unknowns.of_worlds[w] and unknowns.body[u] >= 0:
        moves = moves or unknowns.is_free[u] != 0
        u -= 1
    return moves


@wp.kernel
def go_back(
    # in
    unknowns: Unknowns,
    contact_iteration: wp.array[int],
    begins: bool,
    # in and out
    progress: Progress,
    # out
    converged: wp.array[wp.bool],
    any_goes_back: wp.array[int],
):
    """Lets worlds whose straight way has contacts end a Newton step earlier, down to the first.

    It ``begins`` at the last one. They are not converged. A push out of a contact that the solve knows nothing of would
    give vertices much energy. Worlds in which bodies are solved for stay, as the ways of bodies are not kept.
    """
    w = wp.tid()
    progress.goes_back[w] = 0
    if begins:
        progress.place[w] = wp.where(_moves_bodies(unknowns, w), -1, wp.min(progress.steps[w], PATH) - 1)
    if contact_iteration[w] >= 0 and progress.place[w] >= 0:
        converged[w] = False
        if progress.place[w] > 0:
            progress.place[w] = progress.place[w] - 1
            progress.goes_back[w] = 1
            any_goes_back[0] = 1
