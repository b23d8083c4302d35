"""Kernels of substeps."""

import warp as wp

from ...kernels.arcs import Arcs, is_on_arc, on_arc_of
from ..contacts.constraints import NEVER_SWEPT, NEVER_VIOLATED, approach_of
from ..schedule import Loop, Result, SolveStatus
from ..solve.sweeps import add_delta, count_active
from ..state.motion import StateArrays, moves_with_body, predicted_position, predicted_velocity
from ..state.planes import MovingPlanes
from ..state.structs import ContactKind, Motion, Step, can_move, constraint_count
from ..state.vectors import ZERO, to_single
from ..tuning import CALM_STEPS, STRAIN, WHOLE_STRAIN

wp.set_module_options({"enable_backward": False})

_NOT_PROJECTED = wp.constant(-2)
"""Iteration of the last contact of a world that takes no substeps: no iteration projects its vertices."""


@wp.kernel
def begin_step(
    interrupted: wp.array[int],
    has_constraints: wp.array[int],
    extrapolates: bool,
    # in and out
    number: wp.array[int],
    calm: wp.array[int],
    fewest: wp.array[int],
    lasting: wp.array[float],
    # out
    is_extrapolated: wp.array[int],
    needs_whole_step: wp.array[int],
    own_strain: wp.array[float],
    strain: wp.array[float],
    final_strain: wp.array[float],
    is_chosen: wp.array[int],
    must_choose: wp.array[int],
):
    """Says which worlds need no whole step: those with predicted substeps that had contacts. Clears others.

    Forgets the predicted substeps of worlds that were interrupted; brings the trial of those without nearer its end.
    """
    world = wp.tid()
    own_strain[world] = 0.0
    strain[world] = 0.0
    final_strain[world] = 0.0
    if world == 0:
        must_choose[0] = 0
        for i in range(is_chosen.shape[0]):
            is_chosen[i] = 0
    if interrupted[world] == 1:
        number[world] = 0
        calm[world] = 0
        fewest[world] = 0
        lasting[world] = 0.0
    if number[world] == 0:
        calm[world] = wp.min(calm[world] + 1, 0)
    is_extrapolated[world] = wp.where(extrapolates and number[world] > 0, has_constraints[world], 0)
    if is_extrapolated[world] == 0:
        needs_whole_step[0] = 1


@wp.kernel
def extrapolate(
    # in
    start: StateArrays,
    particle_f: wp.array[wp.vec3],
    particle_world: wp.array[int],
    gravity: wp.array[wp.vec3],
    dt: float,
    is_extrapolated: wp.array[int],
    # out
    motion: Motion,
    end: StateArrays,
):
    """Predicts the motion of particles by their velocities, gravity and forces, in worlds that need no whole step."""
    i = wp.tid()
    if is_extrapolated[motion.world[i]] == 0:
        return
    x0 = start.particle_q[i]
    x1 = x0
    velocity = start.particle_qd[i]
    if motion.inverse_mass[i] > 0.0:
        world = particle_world[i]
        acceleration = gravity[wp.where(world < 0, gravity.shape[0] - 1, world)]
        if particle_f:
            acceleration += motion.inverse_mass[i] * particle_f[i]
        velocity += dt * acceleration
        x1 = x0 + dt * velocity
    finite = wp.isfinite(x1) and wp.isfinite(velocity)
    motion.x1[i] = wp.where(finite, x1, motion.x0[i])
    motion.velocity[i] = wp.where(finite, velocity, wp.vec3())
    motion.is_not_finite[i] = wp.where(finite, 0, 1)
    end.particle_q[i] = x1
    end.particle_qd[i] = velocity


@wp.kernel
def find_worlds(step: Step, has_constraints: wp.array[int], threads: int):
    """Marks the worlds that have constraints."""
    for i in range(wp.tid(), constraint_count(step), threads):
        has_constraints[step.motion.world[step.constraints.vertices[i][0]]] = 1


@wp.kernel
def use_substeps(
    has_constraints: wp.array[int], given: int, status: SolveStatus, number: wp.array[int], substeps: wp.array[int]
):
    """Writes the number of substeps of worlds with constraints, and of a step that collides; 0 of others."""
    world = wp.tid()
    number[world] = given * has_constraints[world]
    if world == 0:
        substeps[0] = given * status.loop[Loop.UNFINISHED]


@wp.func
def mark_choice(choices: wp.array[int], n: int, is_chosen: wp.array[int], substeps: wp.array[int]):
    """Marks a number of substeps as one that a world takes."""
    for i in range(choices.shape[0]):
        if choices[i] == n:
            is_chosen[i] = 1
    wp.atomic_max(substeps, 0, n)


@wp.kernel
def use_predicted_substeps(
    # in
    step: Step,
    has_constraints: wp.array[int],
    is_extrapolated: wp.array[int],
    choices: wp.array[int],
    # in and out
    status: SolveStatus,
    calm: wp.array[int],
    own_strain: wp.array[float],
    number: wp.array[int],
    # out
    is_chosen: wp.array[int],
    substeps: wp.array[int],
    chooses: wp.array[int],
):
    """Marks the predicted numbers of substeps; says whether a world without may need some.

    A world whose contacts have ended takes the whole step, unless that strains it by itself; in a world on trial with
    whole steps, the strain counts too. Otherwise a contact that ends would change how stiff elements are.
    """
    world = wp.tid()
    touches = has_constraints[world] == 1
    on_trial = number[world] == 0 and calm[world] < 0
    if is_extrapolated[world] == 1 or not (on_trial or (number[world] > 0 and not touches)):
        own_strain[world] = 0.0
    strains = own_strain[world] > wp.where(on_trial, WHOLE_STRAIN, STRAIN)
    if number[world] > 0 and is_extrapolated[world] == 0 and not (touches or strains):
        number[world] = 0
        calm[world] = -CALM_STEPS
    if number[world] > 0:
        mark_choice(choices, number[world], is_chosen, substeps)
    elif strains or (status.loop[Loop.UNFINISHED] == 1 and (touches or step.constraints.count[0] == 0)):
        chooses[0] = 1


@wp.kernel
def keep_detection(step: Step, status: SolveStatus, detected: wp.array[int], is_fast: wp.array[int]):
    """Keeps the numbers of constraints, contacts and filtered pairs, and which worlds have fast or pushing contacts."""
    world = wp.tid()
    is_fast[world] = status.is_fast[world]
    if world == 0:
        detected[0] = step.constraints.count[0]
        detected[1] = status.results[Result.FIRST_HITS]
        detected[2] = status.results[Result.FILTERED]
        status.loop[Loop.RECOUNT] = 0  # the start remains where crossings are counted


@wp.kernel
def disable_constraints(step: Step, detected: wp.array[int], is_pending: wp.array[int], threads: int):
    """Disables constraints that a pass through the substeps added, in worlds that do not repeat it."""
    constraints = step.constraints
    for i in range(detected[0] + wp.tid(), constraint_count(step), threads):
        if is_pending[step.motion.world[constraints.vertices[i][0]]] == 0:
            constraints.separation[i] = NEVER_VIOLATED


@wp.kernel
def begin_pass(step: Step, passes: wp.array[int], detected: wp.array[int]):
    """Counts a pass through the substeps; in a second one, adds the contacts that the first one missed."""
    if passes[0] > 0:
        detected[0] = constraint_count(step)
    passes[0] += 1


@wp.func
def _reset_constraint(step: Step, i: int, multiplier: wp.vec3d):
    """Prepares a constraint for sweeps that begin with a position multiplier, in a motion of its own."""
    constraints = step.constraints
    constraints.position_multiplier[i] = multiplier
    constraints.velocity_multiplier[i] = wp.vec3d()
    constraints.previous_multiplier[i] = multiplier
    constraints.last_sweep[i] = NEVER_SWEPT
    corners, weights, normal = constraints.vertices[i], constraints.weights[i], constraints.normal[i]
    constraints.approach[i] = approach_of(step, corners, weights, normal, constraints.separation[i])


@wp.kernel
def keep_constraints(step: Step, detected: wp.array[int], number: wp.array[int], threads: int):
    """Keeps the constraints of worlds with substeps beside those that a detection of their motion will add."""
    for i in range(wp.tid(), wp.min(detected[0], constraint_count(step)), threads):
        _reset_constraint(step, i, wp.vec3d())
        if number[step.motion.world[step.constraints.vertices[i][0]]] == 0:
            step.constraints.separation[i] = NEVER_VIOLATED


@wp.kernel
def restore_detection(step: Step, detected: wp.array[int], is_fast: wp.array[int], status: SolveStatus):
    """Counts the contacts and filtered pairs of the step as it was predicted, and its worlds with fast or pushing ones.

    Where something immovable pushes, substeps that follow it may end in contacts that do not look fast; but to divide
    them could leave vertices in its way. Constraints of the substeps leave nothing to do.
    """
    world = wp.tid()
    status.is_fast[world] = wp.max(status.is_fast[world], is_fast[world])
    status.results[Result.FIRST_HITS] = detected[1]
    status.results[Result.FILTERED] = detected[2]
    if world == 0 and status.loop[Loop.ACTIVE] == 0 and step.constraints.count[0] <= detected[0]:
        status.loop[Loop.UNFINISHED] = status.results[Result.UNDETECTED]


@wp.kernel
def begin_substeps(
    number: wp.array[int],
    is_pending: wp.array[int],
    substeps: int,
    # out
    status: SolveStatus,
    takes_substeps: wp.array[int],
    strain: wp.array[float],
):
    """Marks the worlds that take this number of substeps."""
    world = wp.tid()
    takes_substeps[world] = wp.where(number[world] == substeps, is_pending[world], 0)
    if takes_substeps[world] == 1:
        strain[world] = 0.0
    status.contact_iteration[world] = wp.where(takes_substeps[world] == 1, 0, _NOT_PROJECTED)


@wp.kernel
def start_substep(
    # in, and motion also out
    motion: Motion,
    planes: MovingPlanes,
    substeps: int,
    dt: float,
    remaining: wp.array[int],
    detected: wp.array[int],
    takes_substeps: wp.array[int],
    end: StateArrays,
    arcs: Arcs,
    # in and out
    step: Step,
    status: SolveStatus,
    # out
    substep_planes: MovingPlanes,
):
    """Writes the motion of a substep to that of ``step``, given the motion of the whole step.

    Particles, and bodies that the response can move, end where the inner solver predicts them; shapes go a share of
    their path in the whole step, on arcs if they turn. A particle without a finite prediction is one of the whole step.
    """
    i = wp.tid()
    done = substeps - remaining[0]
    before = float(done) / float(substeps)
    after = float(done + 1) / float(substeps)
    substep, vertices = step.motion, step.vertices
    if i == 0:
        step.constraints.count[0] = detected[0]
        status.loop[Loop.ITERATION] = 0
    if i < planes.start.shape[0]:
        path = planes.end[i] - planes.start[i]
        substep_planes.start[i] = planes.start[i] + wp.float64(before) * path
        substep_planes.end[i] = planes.start[i] + wp.float64(after) * path
    if i >= motion.x0.shape[0]:
        return
    is_not_finite = int(0)
    if i < end.particle_q.shape[0]:
        x0 = substep.x0[i]
        x1 = end.particle_q[i]
        velocity = end.particle_qd[i]
        if not (wp.isfinite(x1) and wp.isfinite(velocity)):
            x1 = x0
            velocity = wp.vec3()
            is_not_finite = 1
            if takes_substeps[motion.world[i]] == 1:  # it stands in the whole step, also if other substeps are finite
                motion.x1[i] = motion.x0[i]
                motion.velocity[i] = velocity
                motion.is_not_finite[i] = 1
    elif moves_with_body(substep, i):
        x1 = predicted_position(substep, i)
        velocity = predicted_velocity(substep, i, x1)
    elif is_on_arc(arcs, i):
        start_of_arc = on_arc_of(arcs, i, motion.x0[i], motion.x1[i], wp.float64(before))
        end_of_arc = on_arc_of(arcs, i, motion.x0[i], motion.x1[i], wp.float64(after))
        x1 = to_single(end_of_arc)
        velocity = float(substeps) / dt * to_single(end_of_arc - start_of_arc)
        substep.x0[i] = to_single(start_of_arc)
    else:
        way = motion.x1[i] - motion.x0[i]
        x1 = motion.x0[i] + after * way
        velocity = way / dt
        substep.x0[i] = motion.x0[i] + before * way
    substep.x1[i] = x1
    substep.velocity[i] = velocity
    substep.is_not_finite[i] = is_not_finite
    vertices.x1[i] = x1
    vertices.velocity[i] = velocity
    vertices.outcome[i] = 0
    vertices.active[i] = 0
    for axis in range(3):
        vertices.particle_delta_x[i, axis] = wp.int64(0)
        vertices.particle_delta_v[i, axis] = wp.int64(0)


@wp.kernel
def reset_constraints(
    step: Step, status: SolveStatus, detected: wp.array[int], remaining: wp.array[int], substeps: int, threads: int
):
    """Prepares constraints for the sweeps of a substep; those of planes are collected anew in each substep.

    The others begin with the multipliers that they had in the substep before, and with what these do to vertices and
    bodies: a contact at rest needs the same ones again.
    """
    if wp.tid() == 0:
        status.loop[Loop.ITERATION] = 1
        status.loop[Loop.ACTIVE] = 0  # positions and velocities are swept without regard to a detection
    constraints, vertices = step.constraints, step.vertices
    for i in range(wp.tid(), constraint_count(step), threads):
        is_new = i < detected[0] and constraints.kind[i] == ContactKind.PLANE
        if is_new:
            constraints.separation[i] = NEVER_VIOLATED
        is_new = is_new or remaining[0] == substeps
        multiplier = wp.where(is_new, wp.vec3d(), constraints.position_multiplier[i])
        _reset_constraint(step, i, multiplier)
        if wp.length_sq(multiplier) > ZERO:
            count_active(step, i)
            add_delta(step, i, multiplier, step.motion.x1, vertices.particle_delta_x, vertices.bodies.delta_x)


@wp.kernel
def end_substep(step: Step, remaining: wp.array[int], state: StateArrays, body_q_prev: wp.array[wp.transform]):
    """Makes the end of a substep the start of the next, of vertices and of bodies that the response can move."""
    i = wp.tid()
    substep, vertices = step.motion, step.vertices
    if i == 0:
        remaining[0] = remaining[0] - 1
    if i < state.particle_q.shape[0]:
        substep.x0[i] = vertices.x1[i]
        state.particle_q[i] = vertices.x1[i]
        state.particle_qd[i] = vertices.velocity[i]
    elif i < substep.x0.shape[0] and moves_with_body(substep, i):
        substep.x0[i] = vertices.x1[i]
    if i < substep.bodies.inverse_mass.shape[0] and substep.bodies.inverse_mass[i] > 0.0:
        state.body_q[i] = vertices.bodies.pose[i]
        state.body_qd[i] = vertices.bodies.velocity[i]
        if body_q_prev:
            body_q_prev[i] = vertices.bodies.pose[i]


@wp.kernel
def move_bodies(
    # in
    motion: Motion,
    body_q_start: wp.array[wp.transform],
    body_q_end: wp.array[wp.transform],
    substeps: int,
    remaining: wp.array[int],
    # out
    body_q_in: wp.array[wp.transform],
    body_q_out: wp.array[wp.transform],
):
    """Writes poses at both ends of a substep, between those of the whole step, of bodies that cannot be moved."""
    body = wp.tid()
    if can_move(motion, body):
        return
    done = substeps - remaining[0]
    body_q_in[body] = _pose_between(body_q_start[body], body_q_end[body], float(done) / float(substeps))
    body_q_out[body] = _pose_between(body_q_start[body], body_q_end[body], float(done + 1) / float(substeps))


@wp.func
def _pose_between(start: wp.transform, end: wp.transform, share: float) -> wp.transform:
    p = wp.transform_get_translation(start)
    p += share * (wp.transform_get_translation(end) - p)
    return wp.transform(p, wp.quat_slerp(wp.transform_get_rotation(start), wp.transform_get_rotation(end), share))


@wp.kernel
def end_body_substeps(step: Step, takes_substeps: wp.array[int], after: StateArrays, state: StateArrays):
    """Makes the poses after the substeps the predicted ones, in worlds that take substeps."""
    bodies = step.motion.bodies
    body = wp.tid()
    if bodies.inverse_mass[body] == 0.0 or takes_substeps[wp.max(bodies.world[body], 0)] == 0:
        return
    bodies.end[body] = after.body_q[body]
    bodies.velocity[body] = after.body_qd[body]
    state.body_q[body] = after.body_q[body]
    state.body_qd[body] = after.body_qd[body]


@wp.kernel
def end_substeps(step: Step, takes_substeps: wp.array[int], after: StateArrays, state: StateArrays):
    """Makes the substeps the predicted motion, in worlds that take them, and puts vertices back to the start.

    Vertices of bodies follow the predicted poses, so that :func:`end_body_substeps` comes first.
    """
    i = wp.tid()
    motion = step.motion
    step.vertices.x1[i] = motion.x0[i]
    if moves_with_body(motion, i):
        x1 = predicted_position(motion, i)
        motion.x1[i] = x1
        motion.velocity[i] = predicted_velocity(motion, i, x1)
    if i >= after.particle_q.shape[0] or takes_substeps[motion.world[i]] == 0:
        return
    if motion.is_not_finite[i] == 0 and motion.inverse_mass[i] != 0.0:
        motion.x1[i] = after.particle_q[i]
        motion.velocity[i] = after.particle_qd[i]
        state.particle_q[i] = after.particle_q[i]
        state.particle_qd[i] = after.particle_qd[i]
