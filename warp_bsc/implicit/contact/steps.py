"""Vertices in a Newton step: prediction, displacements, inertia, and where they end."""

import warp as wp

from ...response.state.motion import StateArrays, predicted_velocity
from ...response.state.poses import turned_pose
from ...response.state.structs import Motion, Vertices
from ...response.state.vectors import ONE, ZERO, to_double, to_single
from .bodies import SolvedBodies, arm_on_body, bend_of, body_vertex, exact_on_body, move_body
from .decisions import may_cut, takes
from .flow import Phase, Place, Problem, end_of_vertices, go_on, go_on_with_pairs, has_few
from .merit import add_energy
from .pairs import Trial, clear_list, moved
from .system import NOT_UNKNOWN, Progress, Unknowns, displacement, is_solved, lower_to, raise_to, unknown_of_corner
from .team import wait_for_team

wp.set_module_options({"enable_backward": False})

_FINE = wp.constant(wp.float64(2.0**16))
"""Factor on products of displacements: a unit of energy is too coarse for them."""
_ROUNDED = wp.constant(2.0**-20)
"""More than what rounding changes, as a share of a length."""
_AT_REST = wp.constant(0.5)
"""Speed, as a share of what gravity adds to it in a step, below which a vertex lies on something and does not fall."""
_TRUNCATIONS = wp.constant(4)
"""Passes in which the displacements of single vertices are cut, before those of their world are."""


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


@wp.func
def _way_without_fall(motion: Motion, gravity: wp.array[wp.vec3], dt: wp.float64, v: int) -> wp.vec3:
    """Returns the predicted way of a vertex in the step without that on which this step's gravity takes it [m]."""
    return motion.x1[v] - motion.x0[v] - float(dt * dt) * gravity[wp.max(motion.world[v], 0) % gravity.shape[0]]


@wp.kernel
def begin_unknowns(
    # in
    motion: Motion,
    gravity: wp.array[wp.vec3],
    dt: wp.float64,
    # out
    unknowns: Unknowns,
    trial: Trial,
    progress: Progress,
):
    """Finds which particles are solved for, their inertia, where inertia alone leads, and the fastest of each world."""
    u = wp.tid()
    p = unknowns.particle[u]
    if p < 0:
        return
    unknowns.is_free[u] = 0
    unknowns.inertia[u] = ZERO
    trial.goal[p] = motion.x1[p]
    if motion.inverse_mass[p] > 0.0 and motion.is_not_finite[p] == 0 and wp.isfinite(motion.x0[p]):
        unknowns.is_free[u] = 1
        unknowns.inertia[u] = ONE / (wp.float64(motion.inverse_mass[p]) * dt * dt)
        raise_to(progress.fastest, motion.world[p], wp.length(_way_without_fall(motion, gravity, dt, p)))


@wp.kernel
def begin_step(
    # in
    motion: Motion,
    gravity: wp.array[wp.vec3],
    dt: wp.float64,
    unknowns: Unknowns,
    bodies: SolvedBodies,
    # out
    trial: Trial,
    progress: Progress,
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
        progress.fall[v] = float(dt * dt) * wp.length(gravity[v % gravity.shape[0]])
        progress.plane_share[v] = 0.0
        progress.leaves[v] = 0
    if v >= trial.x.shape[0]:
        return
    x0, x1 = motion.x0[v], motion.x1[v] + wp.vec3()
    trial.x[v] = x0
    trial.exact[v] = to_double(x0)
    trial.moved[v] = to_double(x0)
    trial.displaced[v] = wp.vec3()
    trial.share[v] = 1.0
    trial.bend[v] = 0.0
    if not wp.isfinite(x0):  # without pairs, and without forces on others
        trial.lower[v] = wp.vec3()
        trial.upper[v] = wp.vec3()
        return
    pad = trial.margin[v] + float(0.0)
    u = unknowns.of_vertex[v]
    if u == NOT_UNKNOWN and wp.length_sq(x1 - x0) > 0.0:
        progress.given_moves[motion.world[v]] = 1
    if u < 0:
        trial.goal[v] = x1
    elif unknowns.is_free[u] != 0:
        progress.active[motion.world[v]] = 1
    if is_solved(unknowns, v):
        way = _way_without_fall(motion, gravity, dt, v)
        if wp.length(way) < _AT_REST * wp.length(x1 - x0 - way):
            x1 = x0 + way
        length = wp.length(x1 - x0)
        # where all is slow, little is enough for what a solve adds to ways
        pad = wp.min(pad, 0.5 * pad + wp.max(progress.fastest[motion.world[v]], length)) + 0.25 * length
        if u < 0:
            unknowns.arm[v] = arm_on_body(bodies, motion, v, x0)
    trial.lower[v] = wp.min(x0, x1) - wp.vec3(pad)
    trial.upper[v] = wp.max(x0, x1) + wp.vec3(pad)


@wp.func
def way_of(motion: Motion, trial: Trial, v: int) -> float:
    """Returns how far a vertex is from where it was at the start of the step, here or on its displacement [m]."""
    off = trial.x[v] - motion.x0[v]
    farthest = wp.max(wp.length(off), wp.length(off + trial.displaced[v])) + trial.bend[v]
    return farthest * (1.0 + _ROUNDED) + _ROUNDED * wp.max(wp.abs(trial.x[v]))


@wp.func
def _share_within_box(trial: Trial, v: int) -> float:
    """Returns the share of the displacement of a vertex that stays in its box."""
    x, d, lower, upper = trial.x[v], trial.displaced[v], trial.lower[v], trial.upper[v]
    share = float(1.0)
    for axis in range(3):
        if x[axis] + d[axis] > upper[axis]:
            share = wp.min(share, (upper[axis] - x[axis]) / d[axis])
        elif x[axis] + d[axis] < lower[axis]:
            share = wp.min(share, (lower[axis] - x[axis]) / d[axis])
    return wp.max(share, 0.0)


@wp.func
def displace(at: Place, p: Problem) -> wp.vec4i:
    """Displaces vertices by the solution, and begins the list of candidates that this may bring together.

    Writes whether some leave the boxes of the candidates. After the first solve of a Newton step, products of solutions
    of particles are added up: with themselves, and with the last one.
    """
    w, t, n, progress, solution = at.world, at.thread, at.threads, p.progress, p.vectors.solution
    if t == 0 and at.then == Phase.RELEASED:  # along the solution without pairs held
        progress.scale[w] = progress.damping[w]
        progress.trial[w] = wp.int64(0)
    first_body, end = p.unknowns.first_of_bodies[w] + int(0), p.unknowns.of_worlds[w + 1] + int(0)
    for u in range(first_body + 2 * t, end, 2 * n):
        body = p.unknowns.body[u]
        if p.unknowns.is_free[u] != 0:
            shift, turn = p.bodies.low[body] + to_double(solution[u]), to_double(solution[u + 1])
            p.bodies.moved[body] = turned_pose(p.motion.bodies, body, p.bodies.pose[body], shift, turn)
    if first_body < end:
        wait_for_team(p.flow.arrived, w, at.blocks)
    if at.solves == 0 and at.then == Phase.BOUNDED:
        for u in range(p.unknowns.of_worlds[w] + t, first_body, n):
            now, before = solution[u] + wp.vec3(), p.vectors.last[u] + wp.vec3()
            p.vectors.last[u] = now
            weight = _FINE * p.unknowns.inertia[u]
            add_energy(progress.square, w, weight * wp.float64(wp.dot(now, now)), p.settings.units)
            add_energy(progress.product, w, weight * wp.float64(wp.dot(now, before)), p.settings.units)
    for k in range(p.worlds.first_vertex[w] + t, end_of_vertices(p.worlds, progress, w), n):
        v = p.worlds.vertices[k] + int(0)
        p.trial.limit[v] = 1.0
        if not is_solved(p.unknowns, v):
            continue
        x, d = p.trial.x[v] + wp.vec3(), displacement(p.unknowns, v, solution)
        gradient = p.vectors.gradient[unknown_of_corner(p.unknowns, v)] + wp.vec3()
        of_vertex = p.unknowns.of_vertex[v] + int(0)
        if of_vertex < 0:
            d = body_vertex(p.bodies.moved, p.motion, v) - x
            p.trial.bend[v] = bend_of(p.unknowns.arm[v], solution[-1 - of_vertex])
        if not (wp.isfinite(d) and wp.isfinite(gradient)):  # as a start is not: its world stands
            p.trial.displaced[v] = wp.vec3()
            progress.bound[w] = 0.0
            progress.change[w] = wp.inf
            continue
        p.trial.displaced[v] = d
        raise_to(progress.way, w, way_of(p.motion, p.trial, v))
        raise_to(progress.longest, w, wp.length(d) + p.trial.bend[v])
        share = _share_within_box(p.trial, v)
        if share < 1.0:
            lower_to(progress.bound, w, share)
            progress.leaves[w] = 1
    if t == 0:
        clear_list(p.candidates, w)
    return go_on(at, wp.where(has_few(p.candidates, at), int(Phase.LIST_AND_BOUND), int(Phase.LIST_WAYS)))


@wp.kernel
def renew_boxes(
    # in
    motion: Motion,
    unknowns: Unknowns,
    progress: Progress,
    keeps_ended: int,
    # in and out
    trial: Trial,
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
    if progress.leaves[world] == 0:
        if progress.active[world] == 0 and keeps_ended == 0:
            sought[v] = 0
        return
    x, d = trial.x[v], trial.displaced[v] + wp.vec3()
    if not wp.isfinite(x):
        return
    pad = trial.margin[v] + float(0.0)
    if unknowns.of_vertex[v] != -1:
        longest = 4.0 * pad + wp.length(motion.x1[v] - motion.x0[v])
        d *= wp.min(longest / wp.max(wp.length(d), 1.0e-30), 1.0)
        pad += 0.5 * wp.length(d)
    else:
        d = motion.x1[v] - x
    trial.lower[v] = wp.min(x, x + d) - wp.vec3(pad)
    trial.upper[v] = wp.max(x, x + d) + wp.vec3(pad)


@wp.func
def move(at: Place, p: Problem) -> wp.vec4i:
    """Moves vertices by their shares, to find the energy there."""
    w, t, n, then, scale = at.world, at.thread, at.threads, at.then + int(0), p.progress.scale[at.world] + float(0.0)
    if t == 0:
        p.progress.bound[w] = 1.0
    if then == Phase.JUDGE and at.solves == 0:  # no pairs are held
        then = wp.where(may_cut(p.progress, w), int(Phase.BEGIN_CUTS), int(Phase.TAKE))
    first_body, end = p.unknowns.first_of_bodies[w] + int(0), p.unknowns.of_worlds[w + 1] + int(0)
    for u in range(first_body + 2 * t, end, 2 * n):
        move_body(u, scale, p.motion, p.unknowns, p.trial.share, p.vectors.solution, False, p.bodies)
    if first_body < end:
        wait_for_team(p.flow.arrived, w, at.blocks)
    for k in range(p.worlds.first_vertex[w] + t, end_of_vertices(p.worlds, p.progress, w), n):
        v = p.worlds.vertices[k] + int(0)
        x = moved(p.trial, scale, v)
        if p.unknowns.of_vertex[v] < 0 and is_solved(p.unknowns, v):
            x = exact_on_body(p.bodies.moved, p.bodies.low_moved, p.motion, v)
        p.trial.moved[v] = x
    return go_on_with_pairs(at, Phase.ENERGY, then)


@wp.func
def begin_cuts(at: Place, p: Problem) -> wp.vec4i:
    """Begins to cut single vertices in place of their world, where energies are lower then: to stay in their boxes."""
    w, trial = at.world, p.trial
    for k in range(p.worlds.first_vertex[w] + at.thread, end_of_vertices(p.worlds, p.progress, w), at.threads):
        v = p.worlds.vertices[k] + int(0)
        if is_solved(p.unknowns, v):
            lower_to(trial.share, trial.holder[v], _share_within_box(trial, v))
    return go_on(at, Phase.CUT)  # the first time by the bounds of the displacements, which are known


@wp.func
def cut(at: Place, p: Problem) -> wp.vec4i:
    """Takes the shares of vertices that are solved for down to their bounds, clears these, and notes what it cuts.

    At first, vertices that were to stay in their boxes are cut already.
    """
    w, trial, progress, begins, passes = at.world, p.trial, p.progress, at.passes == 0, at.passes + 1
    if at.thread == 0 and begins:
        progress.whole[w] = progress.scale[w]
        progress.scale[w] = progress.damping[w]
    for k in range(p.worlds.first_vertex[w] + at.thread, end_of_vertices(p.worlds, progress, w), at.threads):
        v = p.worlds.vertices[k] + int(0)
        trial.cut[v] = 0
        if trial.holder[v] == v and is_solved(p.unknowns, v):
            trial.cut[v] = int(trial.limit[v] < 1.0 or (begins and trial.share[v] < 1.0))
            trial.share[v] = trial.share[v] * trial.limit[v]
        trial.limit[v] = 1.0
    ends = passes == _TRUNCATIONS
    if at.thread == 0:
        if begins or ends:
            progress.bound[w] = 1.0
        clear_list(p.candidates, w)
    phase = wp.where(has_few(p.candidates, at), int(Phase.LIST_AND_BOUND), int(Phase.LIST_WAYS))
    return wp.vec4i(phase, wp.where(ends, int(Phase.TAKE_CUT), int(Phase.CUT)), passes, at.solves)


@wp.func
def undo_cuts(at: Place, p: Problem) -> wp.vec4i:
    """Takes back cuts that were not chosen."""
    w = at.world
    for k in range(p.worlds.first_vertex[w] + at.thread, end_of_vertices(p.worlds, p.progress, w), at.threads):
        if p.progress.cuts[w] == 0:
            p.trial.share[p.worlds.vertices[k]] = 1.0
    return go_on(at, Phase.TAKE)


@wp.func
def take(at: Place, p: Problem) -> wp.vec4i:
    """Moves vertices for good by the share of the world, if it takes that; what a program moves arrives exactly."""
    w, t, n, trial, is_taken = at.world, at.thread, at.threads, p.trial, takes(at.world, p.progress)
    scale = p.progress.scale[w] + float(0.0)
    first_body, end = p.unknowns.first_of_bodies[w] + int(0), p.unknowns.of_worlds[w + 1] + int(0)
    for u in range(first_body + 2 * t, end, 2 * n):
        move_body(u, scale, p.motion, p.unknowns, trial.share, p.vectors.solution, is_taken, p.bodies)
    if first_body < end:
        wait_for_team(p.flow.arrived, w, at.blocks)
    if not is_taken:
        return go_on(at, Phase.DECIDE)
    for k in range(p.worlds.first_vertex[w] + t, end_of_vertices(p.worlds, p.progress, w), n):
        v = p.worlds.vertices[k] + int(0)
        given = not is_solved(p.unknowns, v)
        if given and scale == 1.0:
            trial.x[v] = p.motion.x1[v]
            trial.exact[v] = to_double(p.motion.x1[v])
        elif given or p.unknowns.of_vertex[v] >= 0:
            trial.exact[v] = moved(trial, scale, v)
            trial.x[v] = to_single(trial.exact[v])
        else:
            trial.x[v] = body_vertex(p.bodies.pose, p.motion, v)
            trial.exact[v] = exact_on_body(p.bodies.pose, p.bodies.low, p.motion, v)
            p.unknowns.arm[v] = arm_on_body(p.bodies, p.motion, v, trial.x[v])
        trial.moved[v] = trial.exact[v]
        if p.unknowns.of_vertex[v] >= 0:
            trial.path[wp.min(p.progress.steps[w], trial.path.shape[0] - 1), v] = trial.x[v]
        if not given:
            raise_to(p.progress.change, w, wp.length(trial.displaced[v]))
    return go_on(at, Phase.DECIDE)


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
    progress: Progress,
    # in and out
    motion: Motion,
    end: StateArrays,
):
    """Ends the step of worlds that go back where an earlier Newton step led."""
    v = wp.tid()
    world = motion.world[v]
    if progress.goes_back[world] == 0 or unknowns.of_vertex[v] < 0 or not is_solved(unknowns, v):
        return
    x = trial.path[progress.place[world], v]
    velocity = motion.velocity[v] + (x - motion.x1[v]) / dt
    end.particle_q[v] = x
    end.particle_qd[v] = velocity
    motion.x1[v] = x
    motion.velocity[v] = velocity
