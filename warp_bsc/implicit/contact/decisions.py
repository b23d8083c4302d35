"""What each world does next in a Newton step: hold pairs, cut, search, end, or go back."""

import warp as wp

from .system import Progress, Unknowns

wp.set_module_options({"enable_backward": False})

_NOISE = wp.constant(wp.float64(1e-9))
"""Rise of energy that may be rounding, as a share of it."""
PATH = wp.constant(8)
"""Newton steps of which positions are kept."""
_LEAST_SCALE = wp.constant(float(2.0**-12))


@wp.kernel
def take_bound(
    # in and out
    progress: Progress,
    # out
    cuts: wp.array[int],
):
    """Takes the share of each world down to its bound, and says whether one takes less than all."""
    w = wp.tid()
    progress.scale[w] = progress.scale[w] * progress.bound[w]
    progress.bound[w] = 1.0
    if may_cut(progress, w):
        cuts[0] = 1


@wp.func
def may_cut(progress: Progress, w: int) -> bool:
    """Returns whether cuts of vertices may let a world go further: not while something that a program moves comes."""
    return progress.active[w] != 0 and progress.scale[w] < 1.0 and progress.remaining[w] == 0.0


@wp.func
def _may_hold(progress: Progress, w: int) -> bool:
    """Returns whether something would meet in a world, and is to be held."""
    return progress.active[w] != 0 and progress.bound[w] < 1.0


@wp.kernel
def find_meeting(
    # in
    progress: Progress,
    # out
    meets: wp.array[int],
):
    """Says whether something would meet in a world."""
    w = wp.tid()
    if _may_hold(progress, w):
        meets[0] = 1


@wp.kernel
def begin_hold(
    # in
    always: bool,
    # in and out
    progress: Progress,
    ahead: wp.array[int],
):
    """Lets worlds in which something would meet solve once more, ``always`` all of them, and clears their bounds."""
    w = wp.tid()
    ahead[w] = 0
    if _may_hold(progress, w) or (always and progress.active[w] != 0):
        ahead[w] = 1
        progress.bound[w] = 1.0
        progress.held[w] = int(not always)


@wp.func
def _falls(progress: Progress, w: int) -> bool:
    """Returns whether the energy of a world is lower at the displaced positions, as far as rounding tells."""
    before = wp.float64(progress.energy[w])
    return wp.float64(progress.trial[w]) <= before + _NOISE * wp.abs(before)


@wp.kernel
def find_rises(
    # in
    progress: Progress,
    # out
    rises: wp.array[int],
    any_rises: wp.array[int],
):
    """Says in which worlds the energy rises on displacements that are solved with pairs held."""
    w = wp.tid()
    rises[w] = 0
    if progress.active[w] != 0 and progress.held[w] != 0 and progress.remaining[w] == 0.0 and not _falls(progress, w):
        rises[w] = 1
        any_rises[0] = 1


@wp.kernel
def begin_release(
    # in
    unknowns: Unknowns,
    rises: wp.array[int],
    first: wp.array[wp.vec3],
    # in and out
    progress: Progress,
    solution: wp.array[wp.vec3],
):
    """Lets worlds in which the energy rises search along the solution without pairs held instead."""
    i = wp.tid()
    if i < solution.shape[0] and rises[unknowns.world[i]] != 0:
        solution[i] = first[i]
    if i < rises.shape[0]:
        progress.searches[i] = rises[i]
        if rises[i] != 0:
            progress.scale[i] = 1.0
            progress.trial[i] = wp.int64(0)


@wp.kernel
def end_release(
    # in and out
    progress: Progress,
):
    """Lets all worlds search again."""
    w = wp.tid()
    progress.searches[w] = progress.active[w]


@wp.kernel
def choose_truncation(
    # in
    whole: wp.array[float],
    # in and out
    progress: Progress,
):
    """Keeps the cuts of single vertices in worlds whose energy is lower with them."""
    w = wp.tid()
    if progress.active[w] == 0:
        return
    cuts = progress.searches[w] != 0 and progress.trial_cut[w] < progress.trial[w]
    if cuts:
        progress.trial[w] = progress.trial_cut[w]
    else:
        progress.scale[w] = whole[w]
    progress.cuts[w] = int(cuts)
    progress.searches[w] = 1


@wp.kernel
def begin_newton_step(
    # in and out
    progress: Progress,
):
    """Clears what a Newton step measures."""
    w = wp.tid()
    progress.searches[w] = progress.active[w]
    if progress.active[w] == 0:
        return
    progress.change[w] = 0.0
    progress.remaining[w] = 0.0
    progress.cuts[w] = 0
    progress.held[w] = 0
    progress.scale[w] = 1.0
    progress.bound[w] = 1.0
    progress.energy[w] = wp.int64(0)
    progress.trial[w] = wp.int64(0)
    progress.trial_cut[w] = wp.int64(0)


@wp.kernel
def decide_search(
    # in and out
    progress: Progress,
    # out
    search: wp.array[int],
):
    """Halves the shares of worlds whose energy has not fallen enough; not while something a program moves is coming."""
    w = wp.tid()
    if progress.active[w] == 0 or progress.searches[w] == 0:
        progress.trial[w] = wp.int64(0)
        return
    falls = _falls(progress, w)
    progress.trial[w] = wp.int64(0)
    if falls or progress.remaining[w] > 0.0:
        progress.searches[w] = 0
        return
    progress.scale[w] = 0.5 * progress.scale[w]
    if progress.scale[w] < _LEAST_SCALE:
        progress.scale[w] = 0.0
        progress.searches[w] = 0
        return
    search[0] = 1


@wp.kernel
def decide_step(
    # in
    least_change: float,
    max_steps: int,
    max_late_steps: int,
    # in and out
    progress: Progress,
    plane_share: wp.array[float],
    # out
    goes_on: wp.array[int],
):
    """Ends worlds whose unknowns hardly change, or that have taken all their Newton steps.

    They are counted from when what a program moves arrives, if it does.
    """
    w = wp.tid()
    if progress.active[w] == 0:
        return
    scale = progress.scale[w]
    plane_share[w] = wp.where(scale == 1.0, 1.0, plane_share[w] + (1.0 - plane_share[w]) * scale)
    progress.steps[w] = progress.steps[w] + 1
    arrived = scale == 1.0 or progress.remaining[w] == 0.0
    steps = progress.steps[w]
    if progress.remaining[w] > 0.0:
        progress.late[w] = steps - 1
    ends = arrived and (progress.change[w] <= least_change or steps - progress.late[w] >= max_steps)
    if scale == 0.0 and arrived:
        ends = True
    if ends or (steps >= max_late_steps and not arrived):
        progress.active[w] = 0
        return
    goes_on[0] = 1


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
    progress: Progress,
    unknowns: Unknowns,
    contact_iteration: wp.array[int],
    begins: bool,
    # in and out
    place: wp.array[int],
    # out
    converged: wp.array[wp.bool],
    goes_back: wp.array[int],
    any_goes_back: wp.array[int],
):
    """Lets worlds whose straight way has contacts end a Newton step earlier, down to the first.

    It ``begins`` at the last one. They are not converged. A push out of a contact that the solve knows nothing of would
    give vertices much energy. Worlds in which bodies are solved for stay, as the ways of bodies are not kept.
    """
    w = wp.tid()
    goes_back[w] = 0
    if begins:
        place[w] = wp.where(_moves_bodies(unknowns, w), -1, wp.min(progress.steps[w], PATH) - 1)
    if contact_iteration[w] >= 0 and place[w] >= 0:
        converged[w] = False
        if place[w] > 0:
            place[w] = place[w] - 1
            goes_back[w] = 1
            any_goes_back[0] = 1
