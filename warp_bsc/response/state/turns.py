"""The turns of bodies in a step: which way they go from their pose at the start to that at the end, and their arcs.

A body turns evenly, the shorter way, about an axis of constant direction, while a point of it moves straight. Of a body
that the response can move this point is the centre of mass, as in :func:`.poses.pose_between`. Others go where joints,
motors and programs take them, mostly about an axis that stays: they turn about the axis of their screw, and are then
exactly where a hinge has them. Where that axis is far away, as the body hardly turns, it is the centre of mass again.
"""

import numpy as np
import warp as wp

from ...detection.narrow.rules.arc import allocate_arcs, bound_arc
from ...kernels.arcs import Arcs
from .mesh import ModelMesh
from .poses import point_of, turn_between
from .structs import Motion, MovedBodies, Vertices, can_move
from .vectors import HALF, to_double

wp.set_module_options({"enable_backward": False})

_LEAST_TURN = wp.constant(wp.float64(1e-3))
"""Turn from which a body that the response cannot move turns about the axis of its screw [rad]: that is at most a
thousand times as far away as the body moves."""


@wp.struct
class Turns:
    """Poses of the bodies of a model at both ends of a step, and their arcs; empty if no body has a shape."""

    start: wp.array[wp.transform]
    end: wp.array[wp.transform]  # as predicted
    com: wp.array[wp.vec3]  # centre of mass in the frame of the body [m]
    world: wp.array[int]
    arcs: Arcs


@wp.func
def _are_same(a: wp.quat, b: wp.quat) -> bool:
    """Returns whether two rotations are equal bit for bit; computed, their difference may be more than 0."""
    return a[0] == b[0] and a[1] == b[1] and a[2] == b[2] and a[3] == b[3]


@wp.func
def _write_turn(turns: Turns, body: int, end: wp.transform, is_movable: bool):
    """Writes turn and centre of a body; no turn if a pose is not finite."""
    start = turns.start[body]
    turn = wp.vec3d()
    if not _are_same(wp.transform_get_rotation(start), wp.transform_get_rotation(end)):
        turn = turn_between(start, end)
    centre = point_of(start, turns.com[body])  # of mass
    path = point_of(end, turns.com[body]) - centre
    if not (wp.isfinite(turn) and wp.isfinite(centre) and wp.isfinite(path)):
        turn = wp.vec3d()
        centre = wp.vec3d()
    angle = wp.length(turn)
    if not is_movable and angle >= _LEAST_TURN:
        axis = turn / angle
        across = path - wp.dot(path, axis) * axis
        centre += HALF * (across + wp.cross(axis, across) / wp.tan(HALF * angle))
    turns.arcs.turn[body] = turn
    turns.arcs.centre[body] = centre


@wp.kernel
def _write_turns(turns: Turns, motion: Motion, moved: MovedBodies):
    """Writes how each body turns to where it is now at the end of the step."""
    body = wp.tid()
    if body == 0:
        turns.arcs.turning[0] = 0
    end = turns.end[body]
    is_movable = can_move(motion, body)
    if is_movable:
        end = moved.pose[body]
    _write_turn(turns, body, end, is_movable)


@wp.kernel
def _write_arcs(turns: Turns, motion: Motion, x1: wp.array[wp.vec3], particles: int):
    """Bounds the arcs of all vertices; vertices that nothing can move have one rigid id."""
    vertex = wp.tid()
    bound_arc(turns.arcs, vertex, to_double(motion.x0[vertex]), to_double(x1[vertex]))
    body = turns.arcs.body[vertex]
    rigid_id = int(-1)
    if vertex >= particles:
        rigid_id = wp.where(can_move(motion, body), body + 1, 0)
    elif motion.inverse_mass[vertex] == 0.0:
        rigid_id = 0
    turns.arcs.rigid_id[vertex] = rigid_id


@wp.kernel
def _write_ends(
    motion: Motion, body_q: wp.array[wp.transform], last_q: wp.array[wp.transform], continues: bool, turns: Turns
):
    """Writes the predicted poses. A body that the response cannot move starts where the last step left it.

    So do its vertices, see :mod:`.motion`.
    """
    body = wp.tid()
    before = last_q[body]
    world = turns.world[body]
    is_finite = wp.isfinite(wp.transform_get_translation(before)) and wp.isfinite(wp.transform_get_rotation(before))
    last = motion.interrupted.shape[0] - 1
    is_continued = continues and motion.interrupted[wp.where(world < 0, last, world)] == 0
    if is_finite and is_continued and not can_move(motion, body):
        turns.start[body] = before
    turns.end[body] = body_q[body]


class BodyTurns:
    """Writes the turns of bodies and the arcs of their vertices, on the device of the mesh.

    Attributes:
        turns: The poses and the arcs.
    """

    def __init__(self, mesh: ModelMesh, last: wp.array[wp.transform]):
        """Allocates buffers for a model with bodies, whose poses at the end of the last step are ``last``."""
        self._mesh, self._last, model = mesh, last, mesh.model
        particles = np.full(model.particle_count, -1)
        self.turns = turns = Turns()
        count, device = model.body_count, mesh.device
        turns.arcs = allocate_arcs(np.concatenate([particles, mesh.shape_vertices.body]), count, device)
        turns.start, turns.end = wp.zeros_like(last), wp.zeros_like(last)
        turns.com, turns.world = model.body_com, model.body_world

    def set_start(self, body_q: wp.array[wp.transform]) -> None:
        """Copies the poses at the start of a step."""
        wp.copy(self.turns.start, body_q)

    def set_end(self, motion: Motion, body_q: wp.array[wp.transform], *, continues: bool) -> None:
        """Copies the predicted poses at the end of a step, which ``continues`` the last one unless a world does not."""
        inputs = [motion, body_q, self._last, continues, self.turns]
        wp.launch(_write_ends, len(body_q), inputs=inputs, device=self._mesh.device)

    def write_arcs(self, motion: Motion, vertices: Vertices) -> None:
        """Writes the arcs of the motion as the response has moved it."""
        mesh, turns = self._mesh, self.turns
        wp.launch(_write_turns, len(turns.end), inputs=[turns, motion, vertices.bodies], device=mesh.device)
        inputs = [turns, motion, vertices.x1, mesh.model.particle_count]
        wp.launch(_write_arcs, mesh.vertex_count, inputs=inputs, device=mesh.device)
