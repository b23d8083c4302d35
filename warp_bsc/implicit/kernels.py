"""Kernels of a step: fixed particles, gradients at its ends, its residual, its polish, and poses of bodies."""

import warp as wp

wp.set_module_options({"enable_backward": False})

FREE, FIXED, HELD = wp.constant(0), wp.constant(1), wp.constant(2)
"""What moves a particle: forces, nothing, or the body to which an attachment of infinite stiffness holds it."""

_ZERO = wp.constant(wp.float64(0.0))


@wp.kernel
def to_double(
    # in
    values: wp.array[wp.vec3],
    # out
    doubles: wp.array[wp.vec3d],
):
    """Converts vectors to float64."""
    i = wp.tid()
    doubles[i] = wp.vec3d(values[i])


@wp.kernel
def find_fixed(
    # in
    flags: wp.array[int],
    active: int,
    mass: wp.array[float],
    # out
    is_fixed: wp.array[int],
):
    """Finds the particles that VBD leaves where they are."""
    i = wp.tid()
    is_fixed[i] = wp.where((flags[i] & active) == 0 or mass[i] == 0.0, FIXED, FREE)


@wp.kernel
def find_held(
    # in
    vertices: wp.array2d[int],
    stiffness: wp.array[float],
    enabled: wp.array[wp.bool],
    # in and out
    is_fixed: wp.array[int],
):
    """Finds the particles that attachments hold, among those that are free."""
    e = wp.tid()
    particle = vertices[e, 0]
    if enabled[e] and wp.isinf(stiffness[e]) and is_fixed[particle] == FREE:
        is_fixed[particle] = HELD


@wp.kernel
def hold_multipliers(
    # in
    dt: wp.float64,
    mass: wp.array[float],
    is_fixed: wp.array[int],
    of_end: wp.array[wp.vec3d],
    of_x1: wp.array[wp.vec3d],
    # out
    multipliers: wp.array[wp.vec3d],
):
    """Computes the gradients with respect to the forces on held particles, 0 for others.

    ``of_end`` is the gradient with respect to the end as :func:`of_end` sums it, and ``of_x1`` that of the forces on
    free particles.
    """
    i = wp.tid()
    multiplier = wp.vec3d()
    if is_fixed[i] == HELD:
        multiplier = dt * dt / wp.float64(mass[i]) * (of_end[i] + of_x1[i])
    multipliers[i] = multiplier


@wp.kernel
def of_end(
    # in
    dt: wp.float64,
    of_positions: wp.array[wp.vec3],
    of_velocities: wp.array[wp.vec3],
    is_fixed: wp.array[int],
    # out
    of_x1: wp.array[wp.vec3d],
    free: wp.array[wp.vec3d],
):
    """Sums the gradients by which the end of a step is felt, as v1 = (x1 - x0) / dt; ``free`` are those to solve for.

    A fixed particle has no velocity at the end, and its position does not depend on others.
    """
    i = wp.tid()
    gradient = wp.vec3d()
    if of_positions:
        gradient += wp.vec3d(of_positions[i])
    if of_velocities:
        if is_fixed[i] != FIXED:
            gradient += wp.vec3d(of_velocities[i]) / dt
    of_x1[i] = gradient
    if is_fixed[i] != FREE:
        gradient = wp.vec3d()
    free[i] = gradient


@wp.kernel
def add_of_start(
    # in
    dt: wp.float64,
    of_velocities: wp.array[wp.vec3],
    is_fixed: wp.array[int],
    of_end: wp.array[wp.vec3d],
    of_x1: wp.array[wp.vec3d],
    of_x0: wp.array[wp.vec3d],
    # out
    of_positions: wp.array[wp.vec3],
):
    """Adds the gradient with respect to the start of a step.

    ``of_end`` is the gradient with respect to the end as :func:`of_end` sums it, ``of_x1`` and ``of_x0`` are those of
    the forces with respect to both ends, the first of interest for fixed particles.
    """
    i = wp.tid()
    gradient = of_x0[i]
    if is_fixed[i] == FIXED:
        gradient += of_end[i] + of_x1[i]
    elif of_velocities:
        gradient -= wp.vec3d(of_velocities[i]) / dt
    of_positions[i] = of_positions[i] + wp.vec3(gradient)


@wp.kernel
def clear_fixed(
    # in
    is_fixed: wp.array[int],
    # out
    values: wp.array[wp.vec3d],
):
    """Sets the values of fixed particles to 0."""
    i = wp.tid()
    if is_fixed[i] != 0:
        values[i] = wp.vec3d()


@wp.kernel
def sum_residuals(
    # in
    is_fixed: wp.array[int],
    mass: wp.array[float],
    gravity: wp.array[wp.vec3],
    particle_world: wp.array[int],
    standard_gravity: wp.float64,
    world: wp.array[int],
    forces: wp.array[wp.vec3d],
    # out
    sums: wp.array2d[wp.float64],
):
    """Adds squares to sums by world: of forces to row 0, of weights to row 1, by standard gravity where it is 0."""
    i = wp.tid()
    if is_fixed[i] == FIXED:
        return
    g = wp.float64(wp.length(gravity[particle_world[i]]))
    if g == _ZERO:
        g = standard_gravity
    weight = g * wp.float64(mass[i])
    wp.atomic_add(sums, 0, world[i], wp.dot(forces[i], forces[i]))
    wp.atomic_add(sums, 1, world[i], weight * weight)


@wp.kernel
def report_residuals(
    # in
    limit: wp.float64,
    sums: wp.array2d[wp.float64],
    # out
    residuals: wp.array2d[wp.float64],
    counts: wp.array[wp.int64],
):
    """Writes the residual of each world to row 0, the largest so far to row 1, and counts a step. One thread."""
    unconverged = int(0)
    for w in range(sums.shape[1]):
        residual = _ZERO
        if sums[1, w] > _ZERO:
            residual = wp.sqrt(sums[0, w] / sums[1, w])
        residuals[0, w] = residual
        residuals[1, w] = wp.max(residuals[1, w], residual)
        if not residual <= limit:
            unconverged = 1
    counts[0] = counts[0] + wp.int64(1)
    counts[1] = counts[1] + wp.int64(unconverged)


@wp.kernel
def count_solves(
    # in
    limit: wp.float64,
    residuals: wp.array[wp.float64],
    failed: wp.array[int],
    indefinite: wp.array[int],
    # out
    rejected: wp.array[int],
    counts: wp.array[wp.int64],
):
    """Counts a solve, the worlds in which it failed, and those whose matrix was not positive definite.

    Of these, it marks and counts the worlds whose step ended with a residual above the limit.
    """
    w = wp.tid()
    if w == 0:
        wp.atomic_add(counts, 2, wp.int64(1))
    wp.atomic_add(counts, 3, wp.int64(failed[w]))
    wp.atomic_add(counts, 6, wp.int64(indefinite[w]))
    rejected[w] = wp.where(residuals[w] <= limit, 0, indefinite[w])
    wp.atomic_add(counts, 7, wp.int64(rejected[w]))


@wp.kernel
def count_dropped(
    # in
    dropped: wp.array[int],
    # out
    counts: wp.array[wp.int64],
):
    """Counts a step in which a world has dropped pairs of self-contact. One thread."""
    n = int(0)
    for w in range(dropped.shape[0]):
        n = wp.max(n, dropped[w])
    counts[4] = counts[4] + wp.int64(n)


@wp.func
def _is_selected(world: wp.array[int], selected: wp.array[wp.bool], body: int):
    """Returns whether the world of a body is selected, the last of the array for bodies of no world."""
    w = world[body]
    if w < 0:
        w = selected.shape[0] - 1
    return selected[w]


@wp.kernel
def rest_at_start(
    # in
    world: wp.array[int],
    rests: wp.array[wp.bool],
    given: wp.array[wp.transform],
    # out
    start: wp.array[wp.transform],
):
    """Lets bodies start where they are given, in worlds whose bodies are at rest."""
    body = wp.tid()
    if _is_selected(world, rests, body):
        start[body] = given[body]


@wp.kernel
def finish_poses(
    # in
    world: wp.array[int],
    rests: wp.array[wp.bool],
    # in and out
    of_start: wp.array[wp.transform],
    of_given: wp.array[wp.transform],
    of_last: wp.array[wp.transform],
    of_result: wp.array[wp.transform],
):
    """Carries gradients from poses at the start of a step and in its result to those that it was given."""
    body = wp.tid()
    gradient = wp.transform(wp.vec3(0.0), wp.quat(0.0, 0.0, 0.0, 0.0))
    if of_result:
        gradient = of_result[body]
        of_result[body] = wp.transform(wp.vec3(0.0), wp.quat(0.0, 0.0, 0.0, 0.0))
    if _is_selected(world, rests, body):
        gradient = gradient + of_start[body]
    elif of_last:
        of_last[body] = of_last[body] + of_start[body]
    if of_given:
        of_given[body] = of_given[body] + gradient
    of_start[body] = wp.transform(wp.vec3(0.0), wp.quat(0.0, 0.0, 0.0, 0.0))


@wp.kernel
def move(
    # in
    share: float,
    x: wp.array[wp.vec3],
    direction: wp.array[wp.vec3d],
    # out
    moved: wp.array[wp.vec3],
):
    """Moves positions by a share of a direction."""
    i = wp.tid()
    moved[i] = wp.vec3(wp.vec3d(x[i]) + wp.float64(share) * direction[i])


@wp.kernel
def keep_least(
    # in
    merit: wp.array[wp.float64],
    # out
    least: wp.array[wp.float64],
    is_less: wp.array[int],
):
    """Finds the worlds whose merit is less than the least so far, and keeps it."""
    w = wp.tid()
    is_less[w] = int(merit[w] < least[w])
    if is_less[w] != 0:
        least[w] = merit[w]


@wp.kernel
def copy_where(
    # in
    world: wp.array[int],
    selected: wp.array[int],
    x: wp.array[wp.vec3],
    # out
    copy: wp.array[wp.vec3],
):
    """Copies the positions of particles in selected worlds."""
    i = wp.tid()
    if selected[world[i]] != 0:
        copy[i] = x[i]


@wp.kernel
def set_velocity(
    # in
    dt: float,
    x0: wp.array[wp.vec3],
    x1: wp.array[wp.vec3],
    # out
    velocity: wp.array[wp.vec3],
):
    """Sets velocities to those of the straight path from x0 to x1."""
    i = wp.tid()
    velocity[i] = (x1[i] - x0[i]) / dt
