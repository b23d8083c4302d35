"""Jacobi sweeps over constraints, as those on positions and on velocities share them: multipliers and active sets.

The mass of a vertex or body is split among its active constraints (Tonge et al. 2012), which converges, and conserves
momentum, because a contact changes its two sides oppositely and equally. Momentum of the multipliers (Nesterov; Mazhar
et al. 2015) carries it through a stack in few sweeps.
"""

import warp as wp

from ...kernels.pipeline.queues import take_slot
from ..contacts.constraints import TOUCH, gap, moves_body
from ..state.fixed_sum import add_to_sum
from ..state.status import Loop, SolveStatus
from ..state.structs import Step
from ..state.vectors import ONE, ZERO, relative
from ..tuning import COUNTED, CREEP, MAX_SWEEPS, SLIDING
from .bodies import activate_bodies, add_body_delta, body_inverse_masses


@wp.func
def effective_inverse_masses(step: Step, i: int, x: wp.array[wp.vec3], counted: wp.float64):
    """Returns the inverse masses of a constraint [1/kg] along its normal and across it, at positions ``x`` of vertices.

    Its vertices and bodies are split among the share ``counted`` of their active constraints.
    """
    inverse_mass = ZERO
    weights = step.constraints.weights[i]
    for j in range(4):
        vertex = step.constraints.vertices[i][j]
        parts = wp.max(wp.float64(step.vertices.active[vertex]) * counted, ONE)
        share = wp.float64(step.motion.inverse_mass[vertex]) * parts
        inverse_mass += weights[j] * weights[j] * share
    if not step.motion.bodies.of_vertex:
        return inverse_mass, inverse_mass
    along, across = body_inverse_masses(step, i, x, counted)
    return inverse_mass + along, inverse_mass + across


@wp.func
def multiplier_after(
    multiplier: wp.vec3d,
    normal: wp.vec3d,
    excess: wp.float64,
    motion: wp.vec3d,
    inverse_mass_along: wp.float64,
    inverse_mass_across: wp.float64,
    friction: wp.float64,
    least: wp.float64,
) -> wp.vec3d:
    """Returns a multiplier after a step towards no excess along the normal and no motion across it.

    Along the normal it only pushes; across, it is limited by friction (Coulomb) of that, or of a ``least`` push.
    """
    mass = ONE / inverse_mass_along  # few divisions: they take most of the time of a sweep
    mass_across = mass
    if inverse_mass_across != inverse_mass_along:
        mass_across = ONE / inverse_mass_across
    before = wp.dot(multiplier, normal)
    along = wp.max(before - mass * excess, ZERO)
    across = multiplier - mass_across * motion
    across -= wp.dot(across, normal) * normal
    limit = friction * wp.max(along, least)
    square = wp.length_sq(across)
    if square > limit * limit:
        across *= limit / wp.sqrt(square)
    return along * normal + across


@wp.func
def path_of(step: Step, i: int) -> wp.vec3d:
    """Returns the path of the first contact point relative to the second over the step [m]."""
    weights = step.constraints.weights[i]
    corners = step.constraints.vertices[i]
    return relative(weights, corners, step.vertices.x1) - relative(weights, corners, step.motion.x0)


@wp.func
def position_multiplier_after(step: Step, i: int, pushes_only: bool) -> wp.vec3d:
    """Returns the position multiplier of a constraint after a sweep, without momentum."""
    old = step.constraints.position_multiplier[i]
    counted = wp.where(pushes_only, COUNTED, ONE)
    along, across = effective_inverse_masses(step, i, step.motion.x1, counted)
    if along <= ZERO:
        return old
    excess = gap(step, i)
    if pushes_only and excess >= ZERO:
        return old
    friction = wp.float64(step.constraints.friction[i])
    return multiplier_after(old, step.constraints.normal[i], excess, path_of(step, i), along, across, friction, ZERO)


@wp.func
def speed_of_restitution(step: Step, i: int) -> wp.float64:
    """Returns the speed at which contact points are to part [m/s]."""
    if step.restitution[0] == 0.0:
        return ZERO  # and what is predicted is not read
    predicted = relative(step.constraints.weights[i], step.constraints.vertices[i], step.motion.velocity)
    return wp.float64(step.restitution[0]) * wp.max(-wp.dot(step.constraints.normal[i], predicted), ZERO)


@wp.func
def excess_speed(step: Step, i: int) -> wp.float64:
    """Returns the speed at which contact points part less that of restitution [m/s]; negative if violated."""
    velocity = relative(step.constraints.weights[i], step.constraints.vertices[i], step.vertices.velocity)
    return wp.dot(step.constraints.normal[i], velocity) - speed_of_restitution(step, i)


@wp.func
def velocity_multiplier_after(step: Step, i: int) -> wp.vec3d:
    """Returns the velocity multiplier of a constraint after a sweep, without momentum."""
    old = step.constraints.velocity_multiplier[i]
    along, across = effective_inverse_masses(step, i, step.vertices.x1, ONE)
    if along <= ZERO:
        return old
    velocity = relative(step.constraints.weights[i], step.constraints.vertices[i], step.vertices.velocity)
    friction = wp.float64(step.constraints.friction[i])
    excess = excess_speed(step, i)
    least = step.constraints.resisted[i]
    return multiplier_after(old, step.constraints.normal[i], excess, velocity, along, across, friction, least)


@wp.func
def resisted_push(step: Step, i: int) -> wp.float64:
    """Returns the impulse along the normal of a push in positions that something resists, as in a grip [kg m/s].

    It changes no velocity along the normal, but allows friction as it does in positions, so that what is gripped has
    no velocity either. A push that has made half of the way to the separation is not resisted.
    """
    constraints = step.constraints
    normal = constraints.normal[i]
    push = wp.dot(constraints.position_multiplier[i], normal)
    left = -gap(step, i)
    if push <= wp.float64(2.0) * TOUCH or left <= ZERO:
        return ZERO
    predicted = wp.dot(normal, relative(constraints.weights[i], constraints.vertices[i], step.motion.x1))
    share = left / wp.max(constraints.separation[i] - predicted, left)
    return push * wp.max(wp.float64(2.0) * share - ONE, ZERO) / step.dt


@wp.func
def initial_velocity_multiplier(step: Step, i: int) -> wp.vec3d:
    """Returns the impulse that goes with the position multiplier, without the part that made the separation."""
    return step.constraints.position_multiplier[i] * (step.constraints.approach[i] / step.dt)


@wp.func
def is_held_by_friction(
    multiplier: wp.vec3d,
    normal: wp.vec3d,
    motion: wp.vec3d,
    friction: wp.float64,
    least: wp.float64,
    tolerance: wp.float64,
) -> bool:
    """Returns whether friction is solved: there is no motion across the normal, or the contact slides."""
    along = wp.dot(multiplier, normal)
    if wp.length(multiplier - along * normal) >= SLIDING * friction * wp.max(along, least):
        return True
    return wp.length(motion - wp.dot(motion, normal) * normal) <= CREEP * tolerance


@wp.func
def count_active(step: Step, i: int):
    """Counts an active constraint for the vertices and bodies that it moves."""
    for j in range(4):
        if step.constraints.weights[i][j] != ZERO:
            wp.atomic_add(step.vertices.active, step.constraints.vertices[i][j], 1)
    if step.motion.bodies.of_vertex:
        activate_bodies(step, i)


@wp.func
def activate(step: Step, i: int, world: int, first: int):
    """Adds a constraint to the active set, and counts it for the vertices and bodies that it moves.

    The active set is that of a ``world``, from its ``first`` place on; where worlds are not swept apart, both are 0.
    """
    step.constraints.active_set[first + int(take_slot(step.constraints.active_count, world))] = i
    count_active(step, i)


@wp.func
def max_position_sweeps(step: Step, status: SolveStatus, i: int) -> int:
    """Returns the most sweeps of a constraint on positions: few if it moves no body in a world without fast contact."""
    world = step.motion.world[step.constraints.vertices[i][0]]
    return wp.where(status.is_fast[world] == 1 or moves_body(step, i), MAX_SWEEPS, status.slow_position_sweeps)


@wp.func
def momentum_of(step: Step, sweep: int, i: int, most: int) -> wp.float64:
    """Returns the share of its last step that a multiplier repeats: it grows (Nesterov), and is 0 in the last sweep.

    That is the one after which there were the ``most`` sweeps.
    """
    last = step.constraints.last_sweep[i]
    step.constraints.last_sweep[i] = sweep
    return momentum_after(last, sweep, most)


@wp.func
def momentum_after(last: int, sweep: int, most: int) -> wp.float64:
    """Returns what :func:`momentum_of` does, of a multiplier that was active ``last`` in that sweep."""
    if last != sweep - 1 or sweep == most - 1:
        return ZERO
    return wp.float64(float(sweep) / float(sweep + 3))


@wp.func
def add_delta(
    step: Step,
    i: int,
    change: wp.vec3d,
    x: wp.array[wp.vec3],
    sums: wp.array2d[wp.int64],
    body_sums: wp.array2d[wp.int64],
):
    """Adds what the change of a multiplier does to the vertices and bodies of its constraint, at positions ``x``."""
    corners, weights = wp.vec4i(step.constraints.vertices[i]), wp.vec4d(step.constraints.weights[i])  # read once
    for j in range(4):
        share = weights[j] * wp.float64(step.motion.inverse_mass[corners[j]])
        if share != ZERO:
            add_to_sum(sums, corners[j], 0, share * change)
    if step.motion.bodies.of_vertex:
        add_body_delta(step, i, change, x, body_sums)


@wp.func
def after_sweep(step: Step, i: int, multiplier: wp.vec3d, momentum: wp.float64) -> wp.vec3d:
    """Returns a multiplier after a sweep moved on by its momentum, a share of its step from the previous one."""
    previous = step.constraints.previous_multiplier[i]
    step.constraints.previous_multiplier[i] = multiplier
    return multiplier + momentum * (multiplier - previous)


@wp.func
def finish_sweep(step: Step, status: SolveStatus, last: bool, vertex: int) -> bool:
    """Returns whether constraints of a sweep act on a vertex; vertex 0 counts the sweep, and decides on another batch.

    The ``last`` sweep over an active set empties it.
    """
    if vertex == 0:
        sweep = status.loop[Loop.SWEEP] + 1
        count = int(step.constraints.active_count[0])
        status.loop[Loop.SWEEP] = sweep
        status.loop[Loop.MORE_SWEEPS] = wp.where(count > 0 and sweep < MAX_SWEEPS, 1, 0)
        if last:
            step.constraints.active_count[0] = wp.int64(0)
    return takes_changes(step, last, vertex)


@wp.func
def takes_changes(step: Step, last: bool, vertex: int) -> bool:
    """Returns whether constraints of a sweep act on a vertex, of which the ``last`` sweep lets it go."""
    active = step.vertices.active[vertex] != 0
    if active and last:
        step.vertices.active[vertex] = 0
    return active
