"""Kernels of a step's gradients: what is fixed, gradients at its ends, contacts at its end, and where it failed."""

from enum import IntEnum

import warp as wp

from ...response.state.structs import Motion
from ..contact.pairs import Trial
from ..contact.system import Contacts, Unknowns, end_of_contacts, first_unknown, kind_of_key, second_of_key

wp.set_module_options({"enable_backward": False})

GROWTH = wp.constant(wp.float64(1e3))
"""Factor by which a gradient that grows within a step is reported."""


class Count(IntEnum):
    """What is counted of gradients."""

    STEPS = 0
    UNSOLVED = 1
    FAILED_SOLVES = 2
    GROWING = 3
    AMBIGUOUS_MOVES = 4
    UNREPEATED = 5
    STEP = 6
    """Number on its tape of the first step in which a gradient grew."""
    PARTICLE = 7
    """The particle that had most of it then."""


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
    is_free: wp.array[int],
    # out
    is_fixed: wp.array[int],
):
    """Finds the unknowns that are not solved for."""
    u = wp.tid()
    is_fixed[u] = 1 - is_free[u]


@wp.kernel
def record_contacts(
    # in
    contacts: Contacts,
    unknowns: Unknowns,
    threads: int,
    # in and out
    count: wp.array[int],
    # out
    vertices: wp.array2d[int],
    rows: wp.array2d[int],
    kind: wp.array[int],
    plane: wp.array[int],
    failed: wp.array[int],
):
    """Copies the contacts at the end of a step; so many threads share those of a world.

    ``rows`` are the unknowns of corners, and behind them, if bodies are solved for, the turns of those on bodies.
    Worlds whose contacts do not fit have ``failed``.
    """
    thread, world = wp.tid()
    for i in range(contacts.start[world] + thread, end_of_contacts(contacts, world), threads):
        slot = wp.atomic_add(count, 0, 1)
        if slot >= kind.shape[0]:
            failed[world] = 1
            return
        key = contacts.key[i] + wp.int64(0)
        kind[slot] = kind_of_key(key)
        plane[slot] = second_of_key(key)
        for j in range(4):
            vertex = contacts.corners[i][j]
            vertices[slot, j] = vertex
            u = unknowns.of_vertex[vertex] + int(0)
            rows[slot, j] = first_unknown(u)
            if u < -1:
                rows[slot, 4 + j] = 1 + first_unknown(u)


@wp.kernel
def find_changed(
    # in
    trial: Trial,
    unknowns: Unknowns,
    end: wp.array[wp.vec3],
    world: wp.array[int],
    # in and out
    changed: wp.array[int],
):
    """Marks worlds in which a step did not end where the solve did."""
    p = wp.tid()
    u = unknowns.of_vertex[p]
    if unknowns.is_free[u] != 0 and wp.length_sq(end[p] - trial.x[p]) != 0.0:
        changed[world[p]] = 1


@wp.kernel
def inertia_of(
    # in
    dt: wp.float64,
    inverse_mass: wp.array[float],
    particle: wp.array[int],
    is_fixed: wp.array[int],
    # out
    inertia: wp.array[wp.float64],
):
    """Computes m / dt^2 of particles, 1 for what is fixed, and 0 for bodies, whose inertia has blocks of its own."""
    u = wp.tid()
    inertia[u] = wp.float64(1.0)
    if is_fixed[u] == 0:
        inertia[u] = wp.float64(0.0)
        if particle[u] >= 0:
            inertia[u] = wp.float64(1.0) / (wp.float64(inverse_mass[particle[u]]) * dt * dt)


@wp.kernel
def of_end(
    # in
    dt: wp.float64,
    of_positions: wp.array[wp.vec3],
    of_velocities: wp.array[wp.vec3],
    unknown: wp.array[int],
    is_fixed: wp.array[int],
    is_held: wp.array[int],
    carried: wp.array[wp.vec3d],
    world: wp.array[int],
    # out
    of_unknowns: wp.array[wp.vec3d],
    of_x1: wp.array[wp.vec3d],
    norms: wp.array2d[wp.float64],
):
    """Sums the gradients by which the end of a step is felt: of what is solved for, and of particles that are given.

    The velocity of what is solved for, or held, is (x1 - x0) / dt. ``carried`` are gradients that the next step has by
    where given particles started it. Row 0 of ``norms`` becomes the square of the norm of them in each world, see
    :class:`.report.GradientReport`.
    """
    p = wp.tid()
    gradient = carried[p] + wp.vec3d()
    if of_positions:
        gradient += wp.vec3d(of_positions[p])
    square = wp.length_sq(gradient)
    u = unknown[p]
    if of_velocities:
        of_way = wp.vec3d(of_velocities[p]) / dt
        square += wp.length_sq(of_way)
        if is_fixed[u] == 0 or is_held[p] != 0:
            gradient += of_way
    wp.atomic_add(norms, 0, world[p], square)
    if is_fixed[u] == 0:
        of_unknowns[u] = gradient
    else:
        of_unknowns[u] = wp.vec3d()
        of_x1[p] = gradient


@wp.kernel
def finish_gradients(
    # in
    dt: wp.float64,
    of_velocities: wp.array[wp.vec3],
    unknown: wp.array[int],
    is_fixed: wp.array[int],
    is_held: wp.array[int],
    continues: wp.array[int],
    of_x1: wp.array[wp.vec3d],
    of_x0: wp.array[wp.vec3d],
    of_v0: wp.array[wp.vec3d],
    world: wp.array[int],
    # in and out
    of_positions: wp.array[wp.vec3],
    of_velocities_0: wp.array[wp.vec3],
    # out
    carried: wp.array[wp.vec3d],
    norms: wp.array2d[wp.float64],
    largest: wp.array[wp.int64],
):
    """Adds the gradients with respect to the state at the start of a step.

    A given particle ends where that state has it. In worlds that continue it starts where the last step ended, to which
    its gradient is ``carried``. Row 1 of ``norms`` becomes the square of the norm, and ``largest`` says which particle
    has most of it.
    """
    p = wp.tid()
    gradient, of_velocity = of_x0[p] + wp.vec3d(), of_v0[p] + wp.vec3d()
    carried[p] = wp.vec3d()
    is_given = is_fixed[unknown[p]] != 0 and is_held[p] == 0
    if is_given:
        if continues[p] != 0:
            carried[p] = gradient
            gradient = wp.vec3d()
        gradient += of_x1[p]
    if of_velocities:
        if is_given:
            of_velocity += wp.vec3d(of_velocities[p])
        else:
            gradient -= wp.vec3d(of_velocities[p]) / dt
    if of_positions:
        of_positions[p] = of_positions[p] + wp.vec3(gradient)
    if of_velocities_0:
        of_velocities_0[p] = of_velocities_0[p] + wp.vec3(of_velocity)
    square = wp.length_sq(gradient) + wp.length_sq(of_velocity) / (dt * dt)
    wp.atomic_add(norms, 1, world[p], square)
    wp.atomic_max(largest, world[p], (wp.int64(wp.cast(float(square), int)) << wp.int64(32)) | wp.int64(p))


@wp.kernel
def set_failed(
    # in
    world: wp.array[int],
    failed: wp.array[int],
    # in and out
    x: wp.array[wp.vec3d],
):
    """Sets a vector to NaN in worlds that failed."""
    u = wp.tid()
    if failed[world[u]] != 0:
        x[u] = wp.vec3d(wp.float64(wp.nan))


@wp.kernel
def find_continuing(
    # in
    world: wp.array[int],
    interrupted: wp.array[int],
    # out
    continues: wp.array[int],
):
    """Marks what is in worlds in which a step begins where the last one ended; of world -1, what is in all of them."""
    i = wp.tid()
    last = interrupted.shape[0] - 1
    continues[i] = 1 - interrupted[wp.where(world[i] < 0, last, world[i])]


@wp.kernel
def find_held(
    # in
    particle: wp.array[int],
    stiffness: wp.array[float],
    enabled: wp.array[wp.bool],
    motion: Motion,
    # out
    is_held: wp.array[int],
):
    """Finds the particles that attachments hold."""
    e = wp.tid()
    if enabled[e] and wp.isinf(stiffness[e]) and motion.inverse_mass[particle[e]] > 0.0:
        is_held[particle[e]] = 1


@wp.kernel
def begin_failed(
    # in
    converged: wp.array[wp.bool],
    # out
    failed: wp.array[int],
):
    """Marks worlds in which a solve did not converge."""
    w = wp.tid()
    failed[w] = int(not converged[w])


@wp.kernel
def start_poses(
    # in
    given: wp.array[wp.transform],
    continues: wp.array[int],
    is_solved: wp.array[int],
    # in and out
    poses: wp.array[wp.transform],
):
    """Lets bodies start where they are given, if they are solved for or do not start where the last step ended."""
    body = wp.tid()
    if continues[body] == 0 or is_solved[body] != 0:
        poses[body] = given[body]


@wp.kernel
def finish_poses(
    # in
    continues: wp.array[int],
    is_solved: wp.array[int],
    of_pose_1: wp.array[wp.transform],
    of_pose_0: wp.array[wp.transform],
    # in and out
    of_given: wp.array[wp.transform],
    # out
    carried: wp.array[wp.transform],
):
    """Adds the gradients with respect to poses at both ends of a step to those of the poses that it was given.

    Bodies that are not solved for start where the last step ended in worlds that continue, to which their gradient is
    ``carried``.
    """
    body = wp.tid()
    gradient = of_pose_1[body]
    if is_solved[body] != 0:  # its pose at the end is what was solved for
        gradient = wp.transform(wp.vec3(0.0), wp.quat(0.0, 0.0, 0.0, 0.0))
    carried[body] = wp.transform(wp.vec3(0.0), wp.quat(0.0, 0.0, 0.0, 0.0))
    if continues[body] != 0 and is_solved[body] == 0:
        carried[body] = of_pose_0[body]
    else:
        gradient = gradient + of_pose_0[body]
    if of_given:
        of_given[body] = of_given[body] + gradient


@wp.kernel
def add_inverse_masses(
    # in
    of_vertices: wp.array[float],
    inverse_mass: wp.array[float],
    # in and out
    of_particles: wp.array[float],
):
    """Adds gradients with respect to inverse masses of vertices to those of particles that have a mass."""
    p = wp.tid()
    if inverse_mass[p] > 0.0:
        of_particles[p] = of_particles[p] + of_vertices[p]


@wp.kernel
def report_gradients(
    # in
    number: int,
    failed: wp.array[int],
    not_solved: wp.array[int],
    largest: wp.array[wp.int64],
    # in and out
    norms: wp.array2d[wp.float64],
    counts: wp.array[wp.int64],
):
    """Counts what became of the gradients of a step in each world, and takes the roots of their squared norms.

    ``number`` is that of the step on its tape. See :class:`.report.GradientReport` for the counts.
    """
    w = wp.tid()
    if w == 0:
        wp.atomic_add(counts, int(Count.STEPS), wp.int64(1))
    before, after = norms[0, w] + wp.float64(0.0), norms[1, w] + wp.float64(0.0)  # copies
    norms[0, w] = wp.sqrt(before)
    norms[1, w] = wp.sqrt(after)
    if failed[w] != 0 and before > wp.float64(0.0):
        wp.atomic_add(counts, int(Count.UNSOLVED), wp.int64(1))
    if not_solved[w] != 0 and wp.isfinite(before):
        wp.atomic_add(counts, int(Count.FAILED_SOLVES), wp.int64(1))
    if after > GROWTH * GROWTH * before and before > wp.float64(0.0):
        if wp.atomic_add(counts, int(Count.GROWING), wp.int64(1)) == wp.int64(0):
            counts[int(Count.STEP)] = wp.int64(number)
            counts[int(Count.PARTICLE)] = largest[w] & wp.int64(4294967295)


@wp.kernel
def add_of_bodies(
    # in
    is_solved: wp.array[int],
    unknown: wp.array[int],
    of_changes: wp.array[wp.vec3d],
    # out
    of_unknowns: wp.array[wp.vec3d],
):
    """Copies the gradients by which the end of bodies is felt to those of their unknowns."""
    b = wp.tid()
    if is_solved[b] != 0:
        u = unknown[b]
        of_unknowns[u] = of_changes[u]
        of_unknowns[u + 1] = of_changes[u + 1]


@wp.kernel
def split_end_poses(
    # in
    is_solved: wp.array[int],
    of_end: wp.array[wp.transform],
    # in and out
    of_given: wp.array[wp.transform],
):
    """Adds the gradients with respect to poses at the end to those of bodies that are not solved for."""
    b = wp.tid()
    if is_solved[b] == 0:
        of_given[b] = of_given[b] + of_end[b]
    else:
        of_given[b] = wp.transform(wp.vec3(0.0), wp.quat(0.0, 0.0, 0.0, 0.0))


@wp.kernel
def add_to(
    # in
    values: wp.array[float],
    # in and out
    sums: wp.array[float],
):
    """Adds values to others."""
    i = wp.tid()
    sums[i] = sums[i] + values[i]
