"""The kernels of an adjoint that are not differentiated: they restore a step from its record, and gather gradients.

A launch over vertices and bodies has a thread for each vertex, then one for each body if the response can move bodies.
"""

import warp as wp

from ..solve.bodies import change_body_velocity, move_body
from ..solve.positions import move_vertex
from ..solve.sweeps import add_delta, count_active
from ..solve.velocities import change_velocity
from ..state.fixed_sum import sums_of
from ..state.record import truncation_at
from ..state.status import Loop, Result
from ..state.structs import Motion, can_move
from .structs import (
    Cursor,
    Gradients,
    ModelGradients,
    Move,
    Paths,
    Projection,
    RestoredStep,
    StateGradients,
    entry_of,
)

wp.set_module_options({"enable_backward": False})


@wp.kernel
def begin_gradients(restored: RestoredStep, of_state: StateGradients, gradients: Gradients, of_motion: Motion):
    """Initializes gradients by those of results; where an undetected step froze everything, only those of starts."""
    motion, undetected, vertex = restored.step.motion, restored.status.results[Result.UNDETECTED] == 1, wp.tid()
    body = vertex - motion.x0.shape[0]
    if body >= 0:
        pose = of_state.body_q[body]
        twist = of_state.body_qd[body]
        if undetected and can_move(motion, body):
            of_motion.bodies.start[body] = pose
            pose = wp.transform(wp.vec3(), wp.quat())
            twist = wp.spatial_vector()
        gradients.bodies.pose[body] = pose
        gradients.bodies.velocity[body] = twist
        return
    x1 = wp.vec3()
    velocity = wp.vec3()
    if vertex < of_state.particle_q.shape[0]:
        x1 = of_state.particle_q[vertex]
        velocity = of_state.particle_qd[vertex]
    of_motion.x0[vertex] = wp.vec3()
    if undetected and motion.inverse_mass[vertex] > 0.0:
        of_motion.x0[vertex] = x1
        x1 = wp.vec3()
        velocity = wp.vec3()
    gradients.x1[vertex] = x1
    gradients.velocity[vertex] = velocity


@wp.kernel
def move_cursor(restored: RestoredStep, move: int):
    """Moves the cursor, and sets the iteration of the status to the one that computed what is there.

    There is nothing to go back through in a record that is not complete.
    """
    record, cursor, status = restored.record, restored.cursor, restored.status
    iteration = cursor.iteration[0]
    first = cursor.first_sweep[0]
    last = cursor.next_sweep[0]
    if record.counts.complete[0] == 0:
        first = 0
        last = -1
    elif move == Move.END:
        iteration = wp.min(status.loop[Loop.ITERATION], status.max_iterations + status.max_truncations + 1)
        status.loop[Loop.ITERATION] = iteration
        cursor.more_iterations[0] = 1
        first = record.sweep_offsets[iteration + 1]
        last = record.counts.sweeps[0] - 1
    elif move == Move.SWEEPS:
        first = record.sweep_offsets[iteration]
        last = record.sweep_offsets[iteration + 1] - 1
    else:
        iteration -= 1
        status.loop[Loop.ITERATION] = wp.max(iteration, 0)
        cursor.more_iterations[0] = wp.where(iteration >= 0, 1, 0)
    cursor.iteration[0] = iteration
    cursor.first_sweep[0] = first
    cursor.current_sweep[0] = -1
    cursor.next_sweep[0] = last
    cursor.more_sweeps[0] = wp.where(last >= first, 1, 0)


@wp.func
def _step_back(cursor: Cursor):
    """Makes the next sweep the current one, and the one before it the next."""
    sweep = cursor.next_sweep[0]
    exists = sweep >= cursor.first_sweep[0]
    cursor.current_sweep[0] = wp.where(exists, sweep, -1)
    cursor.next_sweep[0] = wp.where(exists, sweep - 1, sweep)
    cursor.more_sweeps[0] = wp.where(cursor.next_sweep[0] >= cursor.first_sweep[0], 1, 0)


@wp.kernel
def restore_multipliers(restored: RestoredStep, swept: Projection):
    """Restores multipliers as they were before a sweep, and the sums of what they changed."""
    step, record, sweep = restored.step, restored.record, restored.cursor.next_sweep[0]
    entry = entry_of(record, sweep, wp.tid())
    if sweep < restored.cursor.first_sweep[0] or entry < 0:
        return
    i = record.constraint[entry]
    old = record.multiplier[entry]
    add_delta(step, i, old - swept.multiplier[i], swept.x, swept.sums, swept.body_sums)
    swept.multiplier[i] = old
    step.constraints.previous_multiplier[i] = record.previous_multiplier[entry]
    count_active(step, i)


@wp.kernel
def restore_positions(restored: RestoredStep, gradients: Gradients, sums: wp.array[wp.spatial_vectord]):
    """Restores positions, poses and ``sums`` of their changes before a sweep, and adds up gradients of positions."""
    vertex = wp.tid()
    step = restored.step
    body = vertex - step.motion.x0.shape[0]
    if body >= 0:
        move_body(step, body)
        shift, turn = sums_of(step.vertices.bodies.delta_x, body)
        sums[body] = wp.spatial_vectord(shift[0], shift[1], shift[2], turn[0], turn[1], turn[2])
        return
    if vertex == 0:
        _step_back(restored.cursor)
    gradients.x1[vertex] = gradients.x1[vertex] + gradients.more_x1[vertex]
    gradients.more_x1[vertex] = wp.vec3()
    if step.vertices.active[vertex] != 0:
        move_vertex(step, vertex)


@wp.kernel
def restore_velocities(restored: RestoredStep, gradients: Gradients):
    """Restores velocities as they were before a sweep, and adds up their gradients, over vertices and bodies."""
    vertex = wp.tid()
    step = restored.step
    body = vertex - step.motion.x0.shape[0]
    if body >= 0:
        change = wp.spatial_vectord()
        if change_body_velocity(step, body):
            for i in range(6):
                change[i] = wp.float64(gradients.bodies.velocity[body][i])
        gradients.bodies.velocity_change[body] = change
        return
    if vertex == 0:
        _step_back(restored.cursor)
    gradients.velocity[vertex] = gradients.velocity[vertex] + gradients.more_velocity[vertex]
    gradients.more_velocity[vertex] = wp.vec3()
    is_free = change_velocity(step, vertex)
    gradients.velocity_change[vertex] = wp.where(is_free, gradients.velocity[vertex], wp.vec3())


@wp.kernel
def restore_paths(restored: RestoredStep, gradients: Gradients, of_paths: Paths):
    """Restores paths before truncation; the gradients of their vertices and bodies move to ``of_paths``."""
    step, record = restored.step, restored.record
    entry = truncation_at(record, restored.cursor.iteration[0], wp.tid())
    if entry < 0:
        return
    vertex = record.vertex[entry]
    body = record.body[entry]
    if vertex >= 0:
        of_paths.end[entry] = gradients.x1[vertex]
        of_paths.velocity[entry] = gradients.velocity[vertex]
        gradients.x1[vertex] = wp.vec3()
        gradients.velocity[vertex] = wp.vec3()
        step.vertices.x1[vertex] = record.end[entry]
    elif body >= 0:
        of_paths.pose[entry] = gradients.bodies.pose[body]
        of_paths.twist[entry] = gradients.bodies.velocity[body]
        gradients.bodies.pose[body] = wp.transform(wp.vec3(), wp.quat())
        gradients.bodies.velocity[body] = wp.spatial_vector()
        step.vertices.bodies.pose[body] = record.pose[entry]


@wp.kernel
def collect_gradients_on_bodies(
    motion: Motion, gradients: Gradients, of_vertices: wp.array[wp.vec3], more: wp.array[wp.vec3]
):
    """Moves the gradients with respect to vertices of bodies to ``gradients.on_bodies``."""
    vertex = motion.bodies.particle_count + wp.tid()
    body = motion.bodies.of_vertex[vertex]
    collected = wp.vec3()
    if can_move(motion, body):
        collected = of_vertices[vertex] + more[vertex]
        of_vertices[vertex] = wp.vec3()
        more[vertex] = wp.vec3()
    gradients.on_bodies[vertex] = collected


@wp.kernel
def finish_gradients(
    restored: RestoredStep, gradients: Gradients, of_motion: Motion, of_state: StateGradients, of_model: ModelGradients
):
    """Writes the gradients of the inputs of the step; NaN if its record is incomplete.

    Those of vertices of shapes remain gradients with respect to what was predicted of them.
    """
    particle = wp.tid()
    missing = wp.where(restored.record.counts.complete[0] == 0, wp.nan, float(0.0))
    x1 = gradients.x1[particle] + gradients.more_x1[particle] + of_motion.x1[particle]
    velocity = gradients.velocity[particle] + gradients.more_velocity[particle] + of_motion.velocity[particle]
    of_motion.friction[particle] += missing
    if particle == 0 and of_motion.materials.friction and restored.record.counts.complete[0] == 0:
        for i in range(of_motion.materials.friction.shape[0]):
            for j in range(of_motion.materials.friction.shape[1]):
                of_motion.materials.friction[i, j] = wp.nan
    if particle == 0 and of_model.restitution:
        of_model.restitution[0] += missing
    if particle >= of_state.particle_q.shape[0]:
        of_motion.x1[particle] = x1
        of_motion.velocity[particle] = velocity
        return
    masses = of_model.particle_inv_mass
    if masses and restored.step.motion.inverse_mass[particle] > 0.0:
        masses[particle] = masses[particle] + of_motion.inverse_mass[particle] + missing
    of_state.particle_q[particle] = x1 + wp.vec3(missing)
    of_state.particle_qd[particle] = velocity + wp.vec3(missing)
    of_state.start_q[particle] = of_state.start_q[particle] + of_motion.x0[particle] + wp.vec3(missing)


@wp.kernel
def finish_body_gradients(
    restored: RestoredStep, gradients: Gradients, of_motion: Motion, of_state: StateGradients, of_model: ModelGradients
):
    """Writes the gradients of poses, velocities and masses of bodies; NaN if the record of the step is incomplete.

    Where the response moves no bodies, only those of poses change.
    """
    motion, body = restored.step.motion, wp.tid()
    missing = wp.where(restored.record.counts.complete[0] == 0, wp.nan, float(0.0))
    start = of_state.start_body_q[body] + of_motion.bodies.start[body]
    end = of_motion.bodies.end[body]
    if motion.bodies.of_vertex:
        velocity = gradients.bodies.velocity[body] + of_motion.bodies.velocity[body]
        for i in range(6):
            velocity[i] = velocity[i] + missing
        of_state.body_qd[body] = velocity
        if can_move(motion, body):
            masses = of_model.body_inv_mass
            if masses:
                masses[body] = masses[body] + of_motion.bodies.inverse_mass[body] + missing
            if of_model.body_inv_inertia:
                of_model.body_inv_inertia[body] += missing * wp.identity(3, dtype=float)
            if of_model.body_mass:
                of_model.body_mass[body] += missing
            if of_model.body_inertia:
                of_model.body_inertia[body] += missing * wp.identity(3, dtype=float)
    else:
        end = end + of_state.body_q[body]
    for i in range(7):
        start[i] = start[i] + missing
        end[i] = end[i] + missing
    of_state.start_body_q[body] = start
    of_state.body_q[body] = end
