"""Rigid bodies in the solve: each has two unknowns, the shift of its centre of mass, and its turn about that.

The inertia of a turn is that of the rotation vector from the pose to which inertia leads, with the moments there.
Vertices go on arcs: they are where their body is, and a bound on their chords takes off how far arcs leave these.
"""

import numpy as np
import warp as wp
from newton import BodyFlags

from ...response.state.mesh import ModelMesh
from ...response.state.motion import StateArrays
from ...response.state.poses import centre_of, in_world, point_of, turn_between, turned_pose
from ...response.state.structs import Bodies, Motion
from ...response.state.vectors import HALF, ONE, to_double, to_single
from .system import Unknowns

wp.set_module_options({"enable_backward": False})

_ITERATIONS = wp.constant(4)
"""Iterations for the spin that keeps an angular momentum in the middle of a step."""
_SMALL_ANGLE = wp.constant(wp.float64(1e-3))
_TWELFTH = wp.constant(wp.float64(1.0 / 12.0))
_REACH = 0.01
"""Reach of barriers between bodies as a share of the size of the smaller one."""


@wp.struct
class SolvedBodies:
    """The bodies in a solve; empty if none is solved for."""

    unknown: wp.array[int]  # first unknown of each body, -1 for none
    first_vertex: wp.array[int]  # first vertex of each
    goal: wp.array[wp.transform]  # pose to which inertia leads
    pose: wp.array[wp.transform]  # pose now
    moved: wp.array[wp.transform]  # pose after a share of its displacement
    low: wp.array[wp.vec3d]  # what rounding takes from the centre of mass in ``pose`` [m]
    low_moved: wp.array[wp.vec3d]  # the same in ``moved``
    inertia: wp.array[wp.mat33d]  # moments in the goal, in the frame of the world [kg m^2]


def reach_between_bodies(mesh: ModelMesh) -> np.ndarray:
    """Returns the gap from which vertices of bodies push other bodies and static shapes [m]; infinite for others."""
    reach, first = np.full(mesh.vertex_count, np.inf), mesh.model.particle_count
    for body in np.unique(mesh.shape_vertices.body[mesh.shape_vertices.body >= 0]):
        of_body = mesh.shape_vertices.body == body
        positions = mesh.shape_vertices.position[of_body]
        reach[first:][of_body] = _REACH * np.linalg.norm(positions.max(axis=0) - positions.min(axis=0))
    return reach


@wp.func
def predicted_body(
    body: int,
    pose: wp.transform,
    velocity: wp.spatial_vector,
    force: wp.array[wp.spatial_vector],
    gravity: wp.array[wp.vec3],
    bodies: Bodies,
    dt: float,
):
    """Returns where a body ends, and its velocity there, if nothing but gravity and external forces acts on it.

    Its angular momentum stays what it is, and turns it by its spin in the middle of the step.
    """
    linear, spin = wp.spatial_top(velocity), to_double(wp.spatial_bottom(velocity))
    linear += dt * gravity[wp.max(bodies.world[body], 0) % gravity.shape[0]]
    momentum = in_world(bodies.inertia[body], pose) * spin
    if force:
        linear += dt * bodies.inverse_mass[body] * wp.spatial_top(force[body])
        momentum += wp.float64(dt) * to_double(wp.spatial_bottom(force[body]))
    shift, h = wp.float64(dt) * to_double(linear), wp.float64(dt)
    turns = wp.trace(bodies.inverse_inertia[body]) > 0.0
    for _k in range(_ITERATIONS):
        halfway = turned_pose(bodies, body, pose, shift, HALF * h * spin)
        if turns:
            spin = in_world(bodies.inverse_inertia[body], halfway) * momentum
    end = turned_pose(bodies, body, pose, shift, h * spin)
    if turns:
        spin = in_world(bodies.inverse_inertia[body], end) * momentum
    return end, wp.spatial_vector(linear, to_single(spin))


@wp.kernel
def predict_bodies(
    # in
    body_q: wp.array[wp.transform],
    body_qd: wp.array[wp.spatial_vector],
    force: wp.array[wp.spatial_vector],
    flags: wp.array[int],
    gravity: wp.array[wp.vec3],
    bodies: Bodies,
    dt: float,
    # out
    end_q: wp.array[wp.transform],
    end_qd: wp.array[wp.spatial_vector],
):
    """Moves bodies by :func:`predicted_body`. Kinematic ones and those without mass stay."""
    body = wp.tid()
    end_q[body] = body_q[body]
    end_qd[body] = body_qd[body]
    if bodies.inverse_mass[body] != 0.0 and (flags[body] & BodyFlags.KINEMATIC) == 0:
        end, velocity = predicted_body(body, body_q[body], body_qd[body], force, gravity, bodies, dt)
        end_q[body] = end
        end_qd[body] = velocity


@wp.kernel
def begin_bodies(
    # in
    motion: Motion,
    # out
    unknowns: Unknowns,
    active: wp.array[int],
    bodies: SolvedBodies,
):
    """Takes the poses of bodies from the motion as predicted."""
    body = wp.tid()
    u = bodies.unknown[body]
    if u < 0:
        return
    of_motion = motion.bodies
    is_free = int(of_motion.inverse_mass[body] > 0.0)
    unknowns.is_free[u] = is_free
    unknowns.is_free[u + 1] = wp.where(wp.trace(of_motion.inverse_inertia[body]) > 0.0, is_free, 0)
    if is_free == 0:
        return
    active[wp.max(of_motion.world[body], 0)] = 1
    start, goal = of_motion.start[body], of_motion.end[body]
    bodies.goal[body] = goal
    bodies.inertia[body] = in_world(of_motion.inertia[body], goal)
    bodies.pose[body] = start
    bodies.low[body] = wp.vec3d()
    bodies.moved[body] = start
    bodies.low_moved[body] = wp.vec3d()


@wp.func
def body_vertex(poses: wp.array[wp.transform], motion: Motion, vertex: int) -> wp.vec3:
    """Returns where a vertex of a body is in a pose of that [m]."""
    return wp.transform_point(
        poses[motion.bodies.of_vertex[vertex]], motion.bodies.position[vertex - motion.bodies.particle_count]
    )


@wp.func
def exact_on_body(poses: wp.array[wp.transform], low: wp.array[wp.vec3d], motion: Motion, vertex: int) -> wp.vec3d:
    """Returns where a vertex of a body is in a pose of that, as rounded at the start and not since then [m]."""
    body, of_motion = motion.bodies.of_vertex[vertex], motion.bodies
    position = of_motion.position[vertex - of_motion.particle_count]
    since_start = point_of(poses[body], position) + low[body] - point_of(of_motion.start[body], position)
    return to_double(motion.x0[vertex]) + since_start


@wp.func
def arm_on_body(bodies: SolvedBodies, motion: Motion, vertex: int, x: wp.vec3) -> wp.vec3:
    """Returns the vector to a vertex at ``x`` from the centre of mass of its body [m]."""
    body = motion.bodies.of_vertex[vertex]
    return to_single(to_double(x) - centre_of(motion.bodies, body, bodies.pose[body]))


@wp.func
def bend_of(arm: wp.vec3, turn: wp.vec3) -> float:
    """Returns how far an arc leaves its chord at most, by t (1 - t) at a share t of it [m]."""
    return 0.5 * wp.length(arm) * wp.length_sq(turn)


@wp.func
def gradient_of_turn(inertia: wp.mat33d, turned: wp.vec3d) -> wp.vec3d:
    """Returns the gradient of half of ``turned . inertia turned`` by a turn after that of the rotation vector."""
    gradient = inertia * turned
    angle, factor = wp.length(turned), _TWELFTH
    if angle > _SMALL_ANGLE:
        factor = ONE / (angle * angle) - HALF / (angle * wp.tan(HALF * angle))
    once = wp.cross(turned, gradient)
    return gradient + HALF * once + factor * wp.cross(turned, once)


@wp.func
def _off_goal(bodies: SolvedBodies, motion: Motion, body: int, pose: wp.transform, low: wp.vec3d):
    """Returns how far a pose is from the goal: its centre [m], and its rotation vector [rad]."""
    goal = bodies.goal[body]
    off = centre_of(motion.bodies, body, pose) + low - centre_of(motion.bodies, body, goal)
    return off, turn_between(goal, pose)


@wp.func
def inertia_of_body(bodies: SolvedBodies, motion: Motion, body: int, u: int, dt: wp.float64):
    """Returns the gradient of the inertia of a body by one of its unknowns, and the block of the diagonal."""
    off, turned = _off_goal(bodies, motion, body, bodies.pose[body], bodies.low[body])
    block = (ONE / wp.float64(motion.bodies.inverse_mass[body])) * wp.identity(n=3, dtype=wp.float64)
    gradient = block * off
    if u != bodies.unknown[body]:
        block = bodies.inertia[body]
        gradient = gradient_of_turn(block, turned)
    return to_single(gradient / (dt * dt)), wp.mat33(block / (dt * dt))


@wp.func
def inertial_energy(bodies: SolvedBodies, motion: Motion, body: int, dt: wp.float64) -> wp.float64:
    """Returns the energy of the inertia of a body after a share of its displacement [J]."""
    off, turned = _off_goal(bodies, motion, body, bodies.moved[body], bodies.low_moved[body])
    value = wp.dot(off, off) / wp.float64(motion.bodies.inverse_mass[body])
    return HALF * (value + wp.dot(turned, bodies.inertia[body] * turned)) / (dt * dt)


@wp.func
def move_body(
    u: int,
    scale: float,
    motion: Motion,
    unknowns: Unknowns,
    share: wp.array[float],
    solution: wp.array[wp.vec3],
    is_taken: bool,
    bodies: SolvedBodies,
):
    """Moves the body of an unknown by what it takes of a share of its displacement, for good if ``is_taken``."""
    body = unknowns.body[u]
    if unknowns.is_free[u] == 0:
        return
    taken = scale * share[bodies.first_vertex[body]]
    pose, low = bodies.pose[body], bodies.low[body] + wp.vec3d()
    bodies.moved[body] = pose
    if taken > 0.0:
        centre, shift = centre_of(motion.bodies, body, pose), low + to_double(taken * solution[u])
        bodies.moved[body] = turned_pose(motion.bodies, body, pose, shift, to_double(taken * solution[u + 1]))
        low = centre + shift - centre_of(motion.bodies, body, bodies.moved[body])
    bodies.low_moved[body] = low
    if is_taken:
        bodies.pose[body] = bodies.moved[body]
        bodies.low[body] = low


@wp.kernel
def finish_bodies(
    # in
    bodies: SolvedBodies,
    unknowns: Unknowns,
    dt: float,
    # in and out
    motion: Motion,
    end: StateArrays,
):
    """Writes where bodies end, and their velocities: what inertia leads to, and what took them off that."""
    body = wp.tid()
    u = bodies.unknown[body]
    if u < 0:
        return
    if unknowns.is_free[u] != 0:
        pose, before = bodies.pose[body], motion.bodies.velocity[body]
        off, turned = _off_goal(bodies, motion, body, pose, bodies.low[body])
        linear = to_double(wp.spatial_top(before)) + off / wp.float64(dt)
        angular = to_double(wp.spatial_bottom(before)) + turned / wp.float64(dt)
        velocity = wp.spatial_vector(to_single(linear), to_single(angular))
        motion.bodies.end[body] = pose
        motion.bodies.velocity[body] = velocity
        end.body_q[body] = pose
        end.body_qd[body] = velocity
