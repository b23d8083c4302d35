"""A batch of sweeps over constraints that threads keep in registers, each one with the values of its vertices.

Values are positions or velocities. Results are those of any other sweeps. Most of the time of a sweep over few
constraints is that of one thread, which otherwise reads all of its constraint again, and again waits for it.
"""

import warp as wp

from ..state.fixed_sum import add_to_sum, with_delta
from ..state.status import SolveStatus
from ..state.team import Team, wait_for_others
from ..state.vectors import ZERO, to_double
from ..tuning import PUSHING_MOMENTUM
from . import sweeps

Values = wp.types.matrix(shape=(4, 3), dtype=wp.float32)
"""Of the vertices of a constraint [m or m/s]."""


@wp.struct
class KeptConstraint:
    """A constraint of a batch, as sweeps on positions and on velocities need it."""

    is_here: bool  # whether the thread has one
    corners: wp.vec4i
    moves: wp.vec4i  # 1 of corners that take its changes
    weights: wp.vec4d
    normal: wp.vec3d
    target: wp.float64  # of the value between its contact points, along the normal
    origin: wp.vec3d  # that value if nothing moves across the normal
    inverse_mass: wp.float64
    friction: wp.float64
    least: wp.float64  # push for which there is friction in any case
    pushes_only: bool
    most: int  # number of sweeps after which there is none
    multiplier: wp.vec3d
    previous: wp.vec3d
    last: int  # sweep in which it was active last


@wp.func
def _after(kept: KeptConstraint, between: wp.vec3d, excess: wp.float64) -> wp.vec3d:
    """Returns the multiplier after a sweep, without momentum, given the value between contact points."""
    if kept.inverse_mass <= ZERO or (kept.pushes_only and excess >= ZERO):
        return kept.multiplier
    motion, mass = between - kept.origin, kept.inverse_mass
    return sweeps.multiplier_after(kept.multiplier, kept.normal, excess, motion, mass, mass, kept.friction, kept.least)


@wp.func
def project(
    kept: KeptConstraint, values: Values, inverse_mass: wp.array[float], sums: wp.array2d[wp.int64], sweep: int
):
    """Returns a constraint after a sweep, given the values of its vertices, and adds what its change does to sums."""
    between = wp.vec3d()
    for j in range(4):
        between += kept.weights[j] * to_double(values[j])
    excess = wp.dot(kept.normal, between) - kept.target
    momentum = sweeps.momentum_after(kept.last, sweep, kept.most)
    if kept.pushes_only:
        momentum = wp.where(excess < ZERO, wp.min(momentum, PUSHING_MOMENTUM), ZERO)
    after = _after(kept, between, excess)
    moved = after + momentum * (after - kept.previous)
    for j in range(4):
        share = kept.weights[j] * wp.float64(inverse_mass[kept.corners[j]])
        if share != ZERO:
            add_to_sum(sums, kept.corners[j], 0, share * (moved - kept.multiplier))
    kept.previous = after
    kept.multiplier = moved
    kept.last = sweep
    return kept


@wp.func
def values_of(kept: KeptConstraint, values: wp.array[wp.vec3]) -> Values:
    """Returns the values of the vertices of a constraint."""
    found = Values()
    for j in range(4):
        found[j] = values[kept.corners[j]]
    return found


@wp.func
def make_sweeps(
    kept: KeptConstraint,
    inverse_mass: wp.array[float],
    predicted: wp.array[wp.vec3],
    values: wp.array[wp.vec3],
    sums: wp.array2d[wp.int64],
    status: SolveStatus,
    team: Team,
    number: int,
    blocks: int,
) -> KeptConstraint:
    """Makes a number of sweeps, of threads in so many blocks, and returns the constraint after them.

    Values of vertices are those ``predicted`` and the sums of what constraints did.
    """
    now = values_of(kept, values)
    for sweep in range(team.sweep, team.sweep + number):
        if kept.is_here:
            kept = project(kept, now, inverse_mass, sums, sweep)
        wait_for_others(status, blocks)
        if kept.is_here:
            for j in range(4):
                if kept.moves[j] != 0:
                    now[j] = with_delta(predicted[kept.corners[j]], sums, kept.corners[j])
        if sweep < team.sweep + number - 1:
            wait_for_others(status, blocks)
    if kept.is_here:
        for j in range(4):
            if kept.moves[j] != 0:
                values[kept.corners[j]] = now[j]
    return kept
