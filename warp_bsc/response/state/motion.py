"""The motion of a model in a step: its vertices and planes at the start, and as predicted at the end."""

import newton
import numpy as np
import warp as wp
from newton import BodyFlags

from .friction import Friction
from .last_step import SAME_POSE, LastStep
from .mesh import ModelMesh, Placement, members_of_worlds, vertex_position
from .planes import MovingPlanes, transformed_plane
from .poses import centre_of, velocity_on_body
from .structs import Bodies, Motion, add_zeros, body_of, can_move
from .turns import BodyTurns
from .vectors import to_double

SET_STEPS = wp.constant(4)
"""Steps in a row that a dynamic body does not start where it ended the last one, after which a program moves it."""


@wp.struct
class StateArrays:
    """The arrays of a state, which an attribute of the state may replace later; None where it has none."""

    particle_q: wp.array[wp.vec3]
    particle_qd: wp.array[wp.vec3]
    body_q: wp.array[wp.transform]
    body_qd: wp.array[wp.spatial_vector]


def arrays_of(state: newton.State | newton.Model) -> StateArrays:
    """Returns the arrays of a state as they are now."""
    arrays = StateArrays()
    for name in StateArrays.vars:
        setattr(arrays, name, getattr(state, name))
    return arrays


@wp.func
def plane_in(place: Placement, i: int) -> wp.vec4d:
    """Returns an infinite plane where its body is."""
    shapes = place.shapes
    return transformed_plane(shapes.plane_point[i], shapes.plane_normal[i], shapes.plane_body[i], place.body_q)


@wp.func
def moves_with_body(motion: Motion, vertex: int) -> bool:
    """Returns whether a vertex is of a body that the response can move."""
    return can_move(motion, body_of(motion, vertex))


@wp.func
def predicted_velocity(motion: Motion, vertex: int, x1: wp.vec3) -> wp.vec3:
    """Returns the predicted velocity of a vertex of a body, whose predicted position is ``x1`` [m/s]."""
    body = motion.bodies.of_vertex[vertex]
    arm = to_double(x1) - centre_of(motion.bodies, body, motion.bodies.end[body])
    return velocity_on_body(motion.bodies.velocity[body], arm)


@wp.func
def continues(motion: Motion, world: int) -> bool:
    """Returns whether the step of a world begins where the last one ended; no movable particle was moved between."""
    last = motion.interrupted.shape[0] - 1
    return motion.interrupted[wp.where(world < 0, last, world)] == 0


@wp.func
def takes_part(mask: wp.array[wp.bool], world: int) -> bool:
    """Returns whether a world takes part in a step; -1 stands for everything that is in all worlds.

    In a model of one world, that is in that world.
    """
    last = mask.shape[0] - 1
    if last == 1:
        return mask[0]
    return mask[wp.where(world < 0, last, world)]


@wp.kernel(enable_backward=False)
def _write_start(place: Placement, last: wp.array[wp.vec3], motion: Motion, planes: MovingPlanes):
    """Writes the positions of vertices and the planes at the start of a step, and which worlds were interrupted."""
    i = wp.tid()
    if i < planes.start.shape[0]:
        planes.start[i] = plane_in(place, i)
    if i >= motion.x0.shape[0]:
        return
    x = vertex_position(place, i)
    motion.x0[i] = x
    if last and motion.inverse_mass[i] > 0.0:
        for axis in range(3):
            if x[axis] != last[i][axis]:
                motion.interrupted[motion.world[i]] = 1
                motion.interrupted[motion.interrupted.shape[0] - 1] = 1


@wp.kernel(enable_backward=False)
def find_set_bodies(
    # in
    motion: Motion,
    starts: wp.array[wp.transform],
    ends: wp.array[wp.transform],
    # in and out
    steps: wp.array[int],
    count: wp.array[wp.int64],
):
    """Counts the steps in a row that each body which the response moves starts elsewhere than it ended the last one.

    Then it counts bodies with :data:`SET_STEPS` of them, whose number stays. Worlds that start anew do not count.
    """
    body = wp.tid()
    if steps[body] == SET_STEPS:
        return
    start, end = starts[body], ends[body]
    q, last_q = wp.transform_get_rotation(start), wp.transform_get_rotation(end)
    turned = wp.min(wp.length(q - last_q), wp.length(q + last_q))
    shifted = wp.length(wp.transform_get_translation(start) - wp.transform_get_translation(end))
    is_set = wp.max(turned, shifted) > SAME_POSE and can_move(motion, body)
    steps[body] = wp.where(is_set and continues(motion, motion.bodies.world[body]), steps[body] + 1, 0)
    if steps[body] == SET_STEPS:
        wp.atomic_add(count, 0, wp.int64(1))


@wp.kernel(enable_backward=False)
def _write_bodies(
    end: StateArrays, body_inv_mass: wp.array[float], body_flags: wp.array[int], worlds: int, motion: Motion
):
    """Writes poses, velocities and inverse masses of bodies at the end of the step.

    A body whose pose or velocity is not finite is delegated to the inner solver, and so is one that is in all of
    several worlds.
    """
    body = wp.tid()
    pose = end.body_q[body]
    velocity = end.body_qd[body]
    movable = wp.isfinite(wp.transform_get_translation(pose)) and wp.isfinite(wp.transform_get_rotation(pose))
    movable = movable and wp.isfinite(wp.length(velocity)) and body_flags[body] & BodyFlags.KINEMATIC == 0
    movable = movable and (worlds <= 1 or motion.bodies.world[body] >= 0)
    motion.bodies.end[body] = pose
    motion.bodies.velocity[body] = velocity
    motion.bodies.inverse_mass[body] = wp.where(movable, body_inv_mass[body], 0.0)


@wp.kernel(enable_backward=False)
def _write_end(
    # in
    place: Placement,
    particle_qd: wp.array[wp.vec3],
    dt: float,
    last: wp.array[wp.vec3],
    last_planes: wp.array[wp.vec4d],
    # in and out
    motion: Motion,
    planes: MovingPlanes,
):
    """Writes positions, velocities and planes at the end of a step.

    Velocities of particles and movable bodies are the predicted ones, those of other shapes follow from their paths. A
    vertex without a finite position at the end stays where it was. A vertex that the response cannot move starts where
    the last step left it: it would otherwise pass undetected what is in its way, if a program moves it between steps.
    """
    i = wp.tid()
    if i < planes.end.shape[0]:
        if last and not can_move(motion, planes.body[i]):
            if continues(motion, planes.world[i]) and wp.isfinite(last_planes[i]):
                planes.start[i] = last_planes[i]
        planes.end[i] = plane_in(place, i)
    if i >= motion.x1.shape[0]:
        return
    if last and motion.inverse_mass[i] == 0.0 and not moves_with_body(motion, i):
        if continues(motion, motion.world[i]) and wp.isfinite(last[i]) and wp.isfinite(motion.x0[i]):
            motion.x0[i] = last[i]
    x0 = motion.x0[i]
    x1 = vertex_position(place, i)
    velocity = (x1 - x0) / dt
    if i < particle_qd.shape[0]:
        velocity = particle_qd[i]
    elif moves_with_body(motion, i):
        velocity = predicted_velocity(motion, i, x1)
    finite = wp.isfinite(x1) and wp.isfinite(velocity)
    motion.x1[i] = wp.where(finite, x1, x0)
    motion.velocity[i] = wp.where(finite, velocity, wp.vec3())
    motion.is_not_finite[i] = wp.where(finite, 0, 1)


@wp.kernel(enable_backward=False)
def _jump(place: Placement, x1: wp.array[wp.vec3], planes: wp.array[wp.vec4d]):
    """Writes vertices and planes of shapes that jumped to where a state has them."""
    i = wp.tid()
    shapes = place.shapes
    if i < planes.shape[0] and shapes.jumped[shapes.plane_shape[i]] == 1:
        planes[i] = plane_in(place, i)
    if i < shapes.position.shape[0] and shapes.jumped[shapes.shape[i]] == 1:
        vertex = place.particle_q.shape[0] + i
        x1[vertex] = vertex_position(place, vertex)


class ModelMotion:
    """The predicted motion of a model in a step, the input of :func:`.step.resolve`. Each step overwrites its buffers.

    :meth:`set_start` and then :meth:`set_end` write it from the states at both ends of a step.

    Attributes:
        vertices: The vertices, :class:`.state.structs.Motion`.
        planes: The infinite planes, :class:`.state.planes.MovingPlanes`.
        last: Where the last step ended.
        friction: The coefficients of its vertices and planes.
        moves_bodies: Whether the response can move bodies.
        turns: How bodies turn, None if nothing asks for it or no body has a shape.
    """

    def __init__(
        self,
        mesh: ModelMesh,
        friction: Friction,
        *,
        moves_bodies: bool = False,
        responds_to_bodies: bool = False,
        watches_turns: bool = False,
        last: LastStep | None = None,
    ):
        """Allocates buffers, with the model standing still.

        Args:
            mesh: The mesh.
            friction: The coefficients of its vertices and planes.
            moves_bodies: Whether the response can move bodies.
            responds_to_bodies: Whether it keeps bodies apart from each other and from static shapes.
            watches_turns: Whether the arcs of bodies that turn are to be known.
            last: That of another motion, to share it; None for a new one.
        """
        self.mesh, self.friction = mesh, friction
        device, model = mesh.device, mesh.model
        self.vertices = vertices = Motion()
        add_zeros(vertices, ("x0", "x1", "velocity", "is_not_finite"), mesh.vertex_count, device)
        self.last = last or LastStep(mesh)
        vertices.interrupted = self.last.interrupted
        vertices.inverse_mass, vertices.world = mesh.inverse_masses, mesh.device_world
        vertices.friction, vertices.materials = friction.vertices, friction.materials
        vertices.pair_filter = mesh.pair_filter
        if mesh.distances is not None:
            vertices.distances = mesh.distances
        self.planes = planes = MovingPlanes()
        of_planes = mesh.device_planes
        planes.friction, planes.world = friction.planes, of_planes.world
        planes.shape, planes.body, planes.shape_filter = of_planes.shape, of_planes.body, mesh.shape_filter
        of_worlds = members_of_worlds(mesh.planes.world, max(1, model.world_count))
        planes.of_worlds = wp.array(of_worlds, dtype=int, device=device)
        planes.start, planes.end = (wp.zeros_like(self.last.planes) for _ in range(2))
        self._size = max(mesh.vertex_count, len(friction.planes))
        self.moves_bodies = moves_bodies
        if moves_bodies:
            vertices.bodies = self._allocate_bodies()
            vertices.bodies.responds = int(responds_to_bodies)
        has_turns = watches_turns and (mesh.shape_vertices.body >= 0).any()
        self.turns = BodyTurns(mesh, self.last.poses) if has_turns else None
        if last is None:
            self.set_start(arrays_of(model))
            self.set_end(arrays_of(model), 1.0)
            self.last.end(model.body_q, planes.end)

    def _allocate_bodies(self):
        """Returns the bodies of the model, with buffers for their motion."""
        mesh, bodies = self.mesh, Bodies()
        model, device = mesh.model, mesh.device
        pairs = np.sort(np.array(list(model.shape_collision_filter_pairs), dtype=np.int64).reshape(-1, 2), axis=1)
        filtered = np.unique(model.shape_count * pairs[:, 0] + pairs[:, 1])
        bodies.filtered = wp.array(filtered, dtype=wp.int64, device=device)
        bodies.shape = mesh.device_shape_vertices.shape
        bodies.shape_flags, bodies.shape_collision_group = model.shape_flags, model.shape_collision_group
        bodies.particle_count = model.particle_count
        of_vertex = np.concatenate([np.full(model.particle_count, -1, dtype=np.int32), mesh.shape_vertices.body])
        bodies.of_vertex = wp.array(of_vertex, dtype=int, device=device)
        bodies.position = mesh.device_shape_vertices.position
        bodies.com, bodies.world, bodies.mass = model.body_com, model.body_world, model.body_mass
        bodies.inertia, bodies.inverse_inertia = model.body_inertia, model.body_inv_inertia
        add_zeros(bodies, ("inverse_mass", "start", "end", "velocity"), model.body_count, device)
        return bodies

    def follow_shapes(self, not_followed: wp.array[wp.int64]) -> None:
        """Moves shapes to where the model has them now, with the argument of ``ModelMesh.follow_shapes``.

        The last step is made to have ended there, so that nothing sweeps the way.
        """
        self.mesh.follow_shapes(not_followed)
        place = self.mesh.place(self.mesh.model.particle_q, self.last.poses)
        outputs = [self.last.positions, self.last.planes]
        wp.launch(_jump, self._size, inputs=[place], outputs=outputs, device=self.mesh.device)
        wp.copy(self.planes.end, self.last.planes)

    def set_start(self, start: StateArrays) -> None:
        """Copies the positions at the start of a step, with errors as of :meth:`.state.mesh.ModelMesh.positions`."""
        inputs = [self.mesh.place(start.particle_q, start.body_q), self.last.starts, self.vertices, self.planes]
        wp.launch(_write_start, self._size, inputs=inputs, device=self.mesh.device)
        if self.moves_bodies:
            wp.copy(self.vertices.bodies.start, start.body_q)
        if self.turns is not None:
            self.turns.set_start(start.body_q)

    def set_end(self, end: StateArrays, dt: float) -> None:
        """Copies the predicted positions and velocities at the end of a step of length ``dt`` [s], after its start.

        Velocities of bodies are read only if the response can move bodies.
        """
        place = self.mesh.place(end.particle_q, end.body_q)
        if self.moves_bodies:
            self.set_body_ends(end)
        if self.turns is not None:
            self.turns.set_end(self.vertices, end.body_q, continues=self.last.starts is not None)
        inputs = [place, end.particle_qd, dt, self.last.starts, self.last.planes, self.vertices, self.planes]
        wp.launch(_write_end, self._size, inputs=inputs, device=self.mesh.device)

    def set_body_ends(self, end: StateArrays) -> None:
        """Copies the predicted poses and velocities of bodies, but not the positions of their vertices."""
        model = self.mesh.model
        inputs = [end, model.body_inv_mass, model.body_flags, model.world_count]
        wp.launch(_write_bodies, model.body_count, inputs=inputs, outputs=[self.vertices], device=self.mesh.device)
