"""Rigid bodies in the equations of a step: their inertia, contacts on them, and the states that they start and end in.

A body has two unknowns, the shift of its centre of mass and its turn about it, both from the pose at the end of the
step: derivatives are those at 0. A force on one of its vertices is a force on its shift, and its moment one on its
turn. See :mod:`..contact.bodies` for the inertia of a turn.
"""

import warp as wp

from ...response.state.poses import centre_of, in_world, rotation_of, turn_of, turned_by, turned_pose
from ...response.state.structs import Bodies
from ...response.state.vectors import to_double, to_single
from ..contact.bodies import gradient_of_turn, predicted_body
from .element_kernels import block
from .elements import Elements


@wp.func
def _off_goal(bodies: Bodies, body: int, pose: wp.transform, shift: wp.vec3d, turn: wp.vec3d, goal: wp.transform):
    """Returns how far a pose that is shifted and turned is from the goal: its centre [m], and its turn [rad]."""
    off = centre_of(bodies, body, pose) + shift - centre_of(bodies, body, goal)
    return off, turn_of(turned_by(rotation_of(pose), turn) * wp.quat_inverse(rotation_of(goal)))


@wp.kernel
def inertial_forces_on_bodies(
    # in
    dt: wp.float64,
    x1: wp.array3d[wp.vec3d],
    x0: wp.array3d[wp.vec3d],
    body: wp.array[int],
    is_turn: wp.array[int],
    poses: wp.array[wp.transform],
    goals: wp.array[wp.transform],
    bodies: Bodies,
    # out
    forces: wp.array3d[wp.vec3d],
):
    """The force on the shift, or the moment on the turn, that moves a body to where it would be without others."""
    e, row = wp.tid()
    b, change = body[e], x1[e, row, 0]
    goal = goals[b]
    if is_turn[e] != 0:
        _off, turn = _off_goal(bodies, b, poses[b], wp.vec3d(), change, goal)
        forces[e, row, 0] = -gradient_of_turn(in_world(bodies.inertia[b], goal), turn) / (dt * dt)
    else:
        off, _turn = _off_goal(bodies, b, poses[b], change, wp.vec3d(), goal)
        forces[e, row, 0] = -off / (wp.float64(bodies.inverse_mass[b]) * dt * dt)


@wp.kernel
def predict_goals(
    # in
    is_solved: wp.array[int],
    poses: wp.array[wp.transform],
    velocities: wp.array[wp.spatial_vector],
    force: wp.array[wp.spatial_vector],
    gravity: wp.array[wp.vec3],
    bodies: Bodies,
    dt: float,
    # out
    goals: wp.array[wp.transform],
    goal_velocities: wp.array[wp.spatial_vector],
):
    """Computes where inertia leads bodies that are solved for."""
    b = wp.tid()
    if is_solved[b] != 0:
        goal, velocity = predicted_body(b, poses[b], velocities[b], force, gravity, bodies, dt)
        goals[b] = goal
        goal_velocities[b] = velocity


@wp.kernel
def end_bodies(
    # in
    is_solved: wp.array[int],
    unknown: wp.array[int],
    changes: wp.array[wp.vec3d],
    poses: wp.array[wp.transform],
    goals: wp.array[wp.transform],
    goal_velocities: wp.array[wp.spatial_vector],
    bodies: Bodies,
    dt: wp.float64,
    # out
    end_q: wp.array[wp.transform],
    end_qd: wp.array[wp.spatial_vector],
):
    """Computes the state at the end of bodies that are solved for, given changes of their unknowns."""
    b = wp.tid()
    if is_solved[b] != 0:
        shift, turn = changes[unknown[b]], changes[unknown[b] + 1]
        off, turned = _off_goal(bodies, b, poses[b], shift, turn, goals[b])
        linear = to_double(wp.spatial_top(goal_velocities[b])) + off / dt
        angular = to_double(wp.spatial_bottom(goal_velocities[b])) + turned / dt
        end_q[b] = turned_pose(bodies, b, poses[b], shift, turn)
        end_qd[b] = wp.spatial_vector(to_single(linear), to_single(angular))


@wp.kernel(enable_backward=False)
def find_solved(
    # in
    unknown: wp.array[int],
    is_fixed: wp.array[int],
    # out
    is_solved: wp.array[int],
):
    """Finds bodies that are solved for."""
    b = wp.tid()
    u = unknown[b]
    is_solved[b] = 0
    if u >= 0:
        is_solved[b] = 1 - is_fixed[u]


@wp.kernel(enable_backward=False)
def leave_out_solved(
    # in
    is_solved: wp.array[int],
    body_of_shape_vertex: wp.array[int],
    first: int,
    # out
    of_x1: wp.array[wp.vec3d],
):
    """Clears gradients with respect to vertices of bodies that are solved for, which solves have gone through."""
    i = wp.tid()
    body = body_of_shape_vertex[i]
    if body >= 0:
        if is_solved[body] != 0:
            of_x1[first + i] = wp.vec3d()


@wp.kernel(enable_backward=False)
def find_arms(
    # in
    vertices: wp.array2d[int],
    rows: wp.array2d[int],
    x1: wp.array[wp.vec3d],
    bodies: Bodies,
    poses: wp.array[wp.transform],
    body_of_shape_vertex: wp.array[int],
    first: int,
    # out
    arms: wp.array2d[wp.vec3d],
):
    """Computes the vectors from centres of mass to corners on bodies that are solved for; 0 for other corners."""
    e, i = wp.tid()
    arms[e, i] = wp.vec3d()
    if rows[e, 4 + i] >= 0:
        body = body_of_shape_vertex[vertices[e, i] - first]
        arms[e, i] = x1[vertices[e, i]] - centre_of(bodies, body, poses[body])


@wp.kernel(enable_backward=False)
def gather_changes(
    # in
    rows: wp.array2d[int],
    arms: wp.array2d[wp.vec3d],
    of_unknowns: wp.array[wp.vec3d],
    # out
    of_corners: wp.array3d[wp.vec3d],
):
    """Computes changes of corners from those of their unknowns; 0 of those that a program puts somewhere."""
    e, i = wp.tid()
    u, turn = rows[e, i], rows[e, 4 + i]
    change = wp.vec3d()
    if u >= 0:
        change = of_unknowns[u]
    if turn >= 0:
        change += wp.cross(of_unknowns[turn], arms[e, i])
    of_corners[e, 0, i] = change


@wp.kernel(enable_backward=False)
def expand_jacobian(
    # in
    arms: wp.array2d[wp.vec3d],
    forces: wp.array3d[wp.vec3d],
    jacobian: wp.array3d[wp.vec3d],
    # out
    expanded: wp.array3d[wp.vec3d],
):
    """Computes the Jacobian of forces and moments by shifts and turns from that of forces on corners by corners."""
    e, i, j = wp.tid()
    of_forces = block(jacobian, e, i, j)
    arm_i, arm_j = wp.skew(arms[e, i]), wp.skew(arms[e, j])
    by_turn = -of_forces * arm_j
    of_moment = arm_i * by_turn
    if i == j:  # a turn turns the arm of the force as well
        of_moment += wp.skew(forces[e, 0, i]) * arm_i
    moments = arm_i * of_forces
    for k in range(3):
        expanded[e, 3 * i + k, j] = of_forces[k]
        expanded[e, 3 * i + k, 4 + j] = by_turn[k]
        expanded[e, 12 + 3 * i + k, j] = moments[k]
        expanded[e, 12 + 3 * i + k, 4 + j] = of_moment[k]


class ContactsOnBodies(Elements):
    """Elements of contacts whose corners may be on bodies that are solved for.

    Columns 4 to 7 of :attr:`rows` are the turns of such corners, and the Jacobian has rows and columns of them.
    """

    def __init__(self, kernel: wp.Kernel, vertices: wp.array, rows: wp.array, *, jacobians: wp.Kernel):
        """Allocates buffers, as of :class:`.Elements`; ``rows`` has shape [capacity, 8]."""
        super().__init__(kernel, vertices, rows, jacobians=jacobians)
        count = len(vertices)
        self._of_corners, self.arms = self.jacobian, wp.zeros((count, 4), dtype=wp.vec3d, device=self.device)
        self.jacobian = wp.zeros((count, 24, 8), dtype=wp.vec3d, device=self.device)

    def differentiate(self, dt: float) -> None:
        """Computes the Jacobian."""
        expanded, self.jacobian = self.jacobian, self._of_corners
        super().differentiate(dt)
        self.jacobian = expanded
        self.compute_forces(dt)
        inputs = [self.arms, self.forces, self._of_corners]
        self._launch(expand_jacobian, (self.count, 4, 4), inputs, [expanded])

    def gather_multipliers(self, of_unknowns: wp.array, of_corners: wp.array) -> None:
        """Copies gradients with respect to forces on unknowns to corners."""
        self._launch(gather_changes, (self.count, 4), [self.rows, self.arms, of_unknowns], [of_corners])
