"""Vertices in a Newton step: prediction, displacements, inertia, and where they end."""

import warp as wp

from ...response.state.motion import StateArrays, predicted_velocity
from ...response.state.structs import Motion, Vertices
from ...response.state.vectors import HALF, ONE, ZERO, to_double, to_single
from .bodies import SolvedBodies, arm_on_body, bend_of, body_vertex, exact_on_body, inertial_energy
from .conjugate_gradients import Vectors
from .decisions import takes
from .merit import add_energy
from .pairs import BarrierSettings, Trial, moved
from .system import NOT_UNKNOWN, Progress, Unknowns, displacement, is_solved, lower_to, raise_to, unknown_of_corner

wp.set_module_options({"enable_backward": False})

_FINE = wp.constant(wp.float64(2.0**16))
"""Factor on products of displacements: a unit of energy is too coarse for them."""
_ROUNDED = wp.constant(2.0**-20)
"""More than what rounding changes, as a share of a length."""


@wp.kernel
def predict_positions(
    # in
    x0: wp.array[wp.vec3],
    v0: wp.array[wp.vec3],
    force: wp.array[wp.vec3],
    inverse_mass: wp.array[float],
    flags: wp.array[int],
    active_flag: int,
    gravity: wp.array[wp.vec3],
    world: wp.array[int],
    dt: float,
    # out
    x1: wp.array[wp.vec3],
    v1: wp.array[wp.vec3],
):
    """Moves particles as if nothing but gravity and external forces acted on them."""
    i = wp.tid()
    x, v = x0[i] + wp.vec3(), v0[i] + wp.vec3()
    if inverse_mass[i] > 0.0 and wp.isfinite(inverse_mass[i]) and (flags[i] & active_flag) != 0:
        acceleration = gravity[wp.max(world[i], 0) % gravity.shape[0]] + wp.vec3()
        if force:
            acceleration = acceleration + inverse_mass[i] * force[i]
        v = v + dt * acceleration
        x = x + dt * v
    x1[i] = x
    v1[i] = v


@wp.kernel
def begin_unknowns(
    # in
    motion: Motion,
    dt: wp.float64,
    # out
    unknowns: Unknowns,
    goal: wp.array[wp.vec3],
):
    """Finds which particles are solved for, their inertia, and where inertia alone leads."""
    u = wp.tid()
    p = unknowns.particle[u]
    if p < 0:
        return
    unknowns.is_free[u] = 0
    unknowns.inertia[u] = ZERO
    goal[p] = motion.x1[p]
    if motion.inverse_mass[p] > 0.0 and motion.is_not_finite[p] == 0 and wp.isfinite(motion.x0[p]):
        unknowns.is_free[u] = 1
        unknowns.inertia[u] = ONE / (wp.float64(motion.inverse_mass[p]) * dt * dt)


@wp.kernel
def begin_step(
    # in
    motion: Motion,
    margin: wp.array[float],
    gravity: wp.array[wp.vec3],
    dt: float,
    unknowns: Unknowns,
    bodies: SolvedBodies,
    # out
    goal: wp.array[wp.vec3],
    lower: wp.array[wp.vec3],
    upper: wp.array[wp.vec3],
    trial: Trial,
    progress: Progress,
    plane_share: wp.array[float],
):
    """Takes the motion as predicted, and boxes around the way there. Worlds with unknowns become active."""
    v = wp.tid()
    if v < progress.active.shape[0]:
        progress.steps[v] = 0
        progress.solving[v] = 0
        progress.scale[v] = 1.0
        progress.damping[v] = 1.0
        progress.square[v] = wp.int64(0)
        progress.bound[v] = 1.0
        progress.change[v] = 0.0
        progress.way_before[v] = progress.way[v]
        progress.way[v] = 0.0
        progress.given_way[v] = 0.0
        progress.remaining[v] = 0.0
        progress.late[v] = 0
        progress.driven[v] = 0.0
        progress.fall[v] = dt * dt * wp.length(gravity[v % gravity.shape[0]])
        plane_share[v] = 0.0
    if v >= trial.x.shape[0]:
        return
    x0, x1 = motion.x0[v], motion.x1[v]
    trial.x[v] = x0
    trial.exact[v] = to_double(x0)
    trial.moved[v] = to_double(x0)
    trial.displaced[v] = wp.vec3()
    trial.share[v] = 1.0
    trial.bend[v] = 0.0
    if not wp.isfinite(x0):  # without pairs, and without forces on others
        lower[v] = wp.vec3()
        upper[v] = wp.vec3()
        return
    pad = margin[v] + float(0.0)
    u = unknowns.of_vertex[v]
    if u == NOT_UNKNOWN and wp.length_sq(x1 - x0) > 0.0:
        progress.given_moves[motion.world[v]] = 1
    if u < 0:
        goal[v] = x1
    elif unknowns.is_free[u] != 0:
        progress.active[motion.world[v]] = 1
    if is_solved(unknowns, v):
        pad += 0.25 * wp.length(x1 - x0)
        if u < 0:
            unknowns.arm[v] = arm_on_body(bodies, motion, v, x0)
    lower[v] = wp.min(x0, x1) - wp.vec3(pad)
    upper[v] = wp.max(x0, x1) + wp.vec3(pad)


@wp.func
def truncate(
    v: int,
    unknowns: Unknowns,
    limit: wp.array[float],
    begins: bool,
    trial: Trial,
):
    """Takes the shares of vertices that are solved for down to their bounds, clears these, and notes what it cuts.

    When it ``begins``, vertices that were to stay in their boxes are cut already.
    """
    trial.cut[v] = 0
    if trial.holder[v] == v and is_solved(unknowns, v):
        trial.cut[v] = int(limit[v] < 1.0 or (begins and trial.share[v] < 1.0))
        trial.share[v] = trial.share[v] * limit[v]
    limit[v] = 1.0


@wp.func
def _way(motion: Motion, trial: Trial, v: int) -> float:
    """Returns how far a vertex is from where it was at the start of the step, here or on its displacement [m]."""
    off = trial.x[v] - motion.x0[v]
    farthest = wp.max(wp.length(off), wp.length(off + trial.displaced[v])) + trial.bend[v]
    return farthest * (1.0 + _ROUNDED) + _ROUNDED * wp.max(wp.abs(trial.x[v]))


@wp.func
def find_remaining(
    v: int,
    world: int,
    motion: Motion,
    unknowns: Unknowns,
    trial: Trial,
    progress: Progress,
):
    """Writes the ways that are left of what a program moves, before a solve."""
    trial.share[v] = 1.0
    if not is_solved(unknowns, v) and wp.isfinite(trial.x[v]):
        d = motion.x1[v] - trial.x[v]
        trial.displaced[v] = d
        if wp.length_sq(d) > 0.0:
            raise_to(progress.remaining, world, wp.length(d))
            raise_to(progress.given_way, world, _way(motion, trial, v))


@wp.func
def compare_solutions(
    u: int,
    world: int,
    settings: BarrierSettings,
    unknowns: Unknowns,
    solution: wp.array[wp.vec3],
    last: wp.array[wp.vec3],
    progress: Progress,
):
    """Adds the products of the solution of a particle with itself, and with the ``last`` one, which becomes this."""
    now, before = solution[u] + wp.vec3(), last[u] + wp.vec3()
    last[u] = now
    weight = _FINE * unknowns.inertia[u]
    add_energy(progress.square, world, weight * wp.float64(wp.dot(now, now)), settings.units)
    add_energy(progress.product, world, weight * wp.float64(wp.dot(now, before)), settings.units)


@wp.func
def displace(
    v: int,
    world: int,
    motion: Motion,
    unknowns: Unknowns,
    vectors: Vectors,
    lower: wp.array[wp.vec3],
    upper: wp.array[wp.vec3],
    bodies: SolvedBodies,
    trial: Trial,
    progress: Progress,
    limit: wp.array[float],
    leaves: wp.array[int],
):
    """Writes the displacements of vertices after a solve, and whether some leave the boxes of the candidates."""
    limit[v] = 1.0
    if not is_solved(unknowns, v):
        return
    d = displacement(unknowns, v, vectors.solution)
    gradient = vectors.gradient[unknown_of_corner(unknowns, v)]
    u = unknowns.of_vertex[v]
    if u < 0:
        d = body_vertex(bodies.moved, motion, v) - trial.x[v]
        trial.bend[v] = bend_of(unknowns.arm[v], vectors.solution[-1 - u])
    if not (wp.isfinite(d) and wp.isfinite(gradient)):  # as a start is not: its world stands
        trial.displaced[v] = wp.vec3()
        progress.bound[world] = 0.0
        progress.change[world] = wp.inf
        return
    trial.displaced[v] = d
    raise_to(progress.way, world, _way(motion, trial, v))
    raise_to(progress.longest, world, wp.length(d) + trial.bend[v])
    share = _share_within(trial.x[v], d, lower[v], upper[v])
    if share < 1.0:
        lower_to(progress.bound, world, share)
        leaves[world] = 1


@wp.kernel
def renew_boxes(
    # in
    motion: Motion,
    unknowns: Unknowns,
    margin: wp.array[float],
    trial: Trial,
    leaves: wp.array[int],
    active: wp.array[int],
    keeps_ended: int,
    # in and out
    lower: wp.array[wp.vec3],
    upper: wp.array[wp.vec3],
    # out
    sought: wp.array[int],
):
    """Makes the boxes of vertices those around their last displacement, from where they are now.

    Only in worlds in which one left its box. Pairs of those that have ended are not sought any more, unless they are to
    be kept. A displacement that is far longer than what the step would take without forces counts in part: all may be
    near each other on ways of metres.
    """
    v = wp.tid()
    world = motion.world[v]
    if leaves[world] == 0:
        if active[world] == 0 and keeps_ended == 0:
            sought[v] = 0
        return
    x, d = trial.x[v], trial.displaced[v] + wp.vec3()
    if not wp.isfinite(x):
        return
    pad = margin[v] + float(0.0)
    if unknowns.of_vertex[v] != -1:
        longest = 4.0 * pad + wp.length(motion.x1[v] - motion.x0[v])
        d *= wp.min(longest / wp.max(wp.length(d), 1.0e-30), 1.0)
        pad += 0.5 * wp.length(d)
    else:
        d = motion.x1[v] - x
    lower[v] = wp.min(x, x + d) - wp.vec3(pad)
    upper[v] = wp.max(x, x + d) + wp.vec3(pad)


@wp.func
def _share_within(x: wp.vec3, d: wp.vec3, lower: wp.vec3, upper: wp.vec3) -> float:
    """Returns the share of a displacement that stays in a box."""
    share = float(1.0)
    for axis in range(3):
        if x[axis] + d[axis] > upper[axis]:
            share = wp.min(share, (upper[axis] - x[axis]) / d[axis])
        elif x[axis] + d[axis] < lower[axis]:
            share = wp.min(share, (lower[axis] - x[axis]) / d[axis])
    return wp.max(share, 0.0)


@wp.func
def begin_truncation(
    v: int,
    unknowns: Unknowns,
    lower: wp.array[wp.vec3],
    upper: wp.array[wp.vec3],
    trial: Trial,
):
    """Takes the share of a vertex down to what stays in its box."""
    if is_solved(unknowns, v):
        lower_to(trial.share, trial.holder[v], _share_within(trial.x[v], trial.displaced[v], lower[v], upper[v]))


@wp.func
def add_inertia(
    u: int,
    world: int,
    motion: Motion,
    settings: BarrierSettings,
    trial: Trial,
    goal: wp.array[wp.vec3],
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
    off = trial.moved[p] - to_double(goal[p])
    add_energy(energy, world, HALF * unknowns.inertia[u] * wp.dot(off, off), settings.units)


@wp.func
def write_moved(
    v: int,
    scale: float,
    motion: Motion,
    unknowns: Unknowns,
    bodies: SolvedBodies,
    trial: Trial,
):
    """Writes where a vertex is after a share of its displacement."""
    x = moved(trial, scale, v)
    if unknowns.of_vertex[v] < 0 and is_solved(unknowns, v):
        x = exact_on_body(bodies.moved, bodies.low_moved, motion, v)
    trial.moved[v] = x


@wp.func
def take(
    v: int,
    world: int,
    motion: Motion,
    unknowns: Unknowns,
    bodies: SolvedBodies,
    progress: Progress,
    trial: Trial,
):
    """Moves a vertex by the share of its world, if that takes it; what a program moves arrives exactly."""
    if not takes(world, progress):
        return
    scale = progress.scale[world]
    given = not is_solved(unknowns, v)
    if given and scale == 1.0:
        trial.x[v] = motion.x1[v]
        trial.exact[v] = to_double(motion.x1[v])
    elif given or unknowns.of_vertex[v] >= 0:
        trial.exact[v] = moved(trial, scale, v)
        trial.x[v] = to_single(trial.exact[v])
    else:
        trial.x[v] = body_vertex(bodies.pose, motion, v)
        trial.exact[v] = exact_on_body(bodies.pose, bodies.low, motion, v)
        unknowns.arm[v] = arm_on_body(bodies, motion, v, trial.x[v])
    trial.moved[v] = trial.exact[v]
    if unknowns.of_vertex[v] >= 0:
        trial.path[wp.min(progress.steps[world], trial.path.shape[0] - 1), v] = trial.x[v]
    if not given:
        raise_to(progress.change, world, wp.length(trial.displaced[v]))


@wp.kernel
def finish(
    # in
    trial: Trial,
    unknowns: Unknowns,
    dt: float,
    # in and out
    motion: Motion,
    vertices: Vertices,
    end: StateArrays,
    progress: Progress,
):
    """Writes where the step ends, and the predicted velocity with what the step has added to it.

    The change is infinite in worlds with a vertex whose prediction is not finite.
    """
    v = wp.tid()
    x = trial.x[v]
    if motion.is_not_finite[v] != 0:
        progress.change[motion.world[v]] = wp.inf
    if not is_solved(unknowns, v):
        return
    # not by the way from the start, which in short steps is rounding
    off = to_single(trial.exact[v] - to_double(motion.x1[v]))
    velocity = motion.velocity[v] + off / dt
    if unknowns.of_vertex[v] < 0:
        velocity = predicted_velocity(motion, v, x)
    else:
        end.particle_q[v] = x
        end.particle_qd[v] = velocity
    motion.x1[v] = x
    motion.velocity[v] = velocity
    vertices.x1[v] = x
    vertices.velocity[v] = velocity


@wp.kernel
def retreat(
    # in
    trial: Trial,
    unknowns: Unknowns,
    dt: float,
    goes_back: wp.array[int],
    place: wp.array[int],
    # in and out
    motion: Motion,
    end: StateArrays,
):
    """Ends the step of worlds that go back where an earlier Newton step led."""
    v = wp.tid()
    world = motion.world[v]
    if goes_back[world] == 0 or unknowns.of_vertex[v] < 0 or not is_solved(unknowns, v):
        return
    x = trial.path[place[world], v]
    velocity = motion.velocity[v] + (x - motion.x1[v]) / dt
    end.particle_q[v] = x
    end.particle_qd[v] = velocity
    motion.x1[v] = x
    motion.velocity[v] = velocity
