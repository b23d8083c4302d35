"""The motion of a model in a step: its vertices and planes at the start, and as wanted at the end."""

import warp as wp

from .buffers import Motion
from .model_mesh import ModelMesh, vertex_position
from .planes import MovingPlanes, transformed_plane

__all__ = ["ModelMotion"]


@wp.struct
class _Placement:
    """Where the vertices and the planes of a mesh are in a state."""

    particle_q: wp.array[wp.vec3]
    body_q: wp.array[wp.transform]
    shape_vertex_position: wp.array[wp.vec3]
    shape_vertex_body: wp.array[int]
    plane_point: wp.array[wp.vec3]
    plane_normal: wp.array[wp.vec3]
    plane_body: wp.array[int]


@wp.func
def _position(placement: _Placement, vertex: int) -> wp.vec3:
    return vertex_position(
        vertex,
        placement.particle_q,
        placement.body_q,
        placement.shape_vertex_position,
        placement.shape_vertex_body,
    )


@wp.func
def _place_plane(placement: _Placement, i: int, planes: wp.array[wp.vec4d]):
    """Writes a plane, if there is one of that number."""
    if i < planes.shape[0]:
        planes[i] = transformed_plane(
            placement.plane_point[i], placement.plane_normal[i], placement.plane_body[i], placement.body_q
        )


@wp.kernel(enable_backward=False)
def _write_start(
    # in
    placement: _Placement,
    # out
    x0: wp.array[wp.vec3],
    planes: wp.array[wp.vec4d],
):
    """Writes the positions of vertices and the planes at the start of a step."""
    i = wp.tid()
    _place_plane(placement, i, planes)
    if i < x0.shape[0]:
        x0[i] = _position(placement, i)


@wp.kernel(enable_backward=False)
def _write_end(
    # in
    placement: _Placement,
    particle_qd: wp.array[wp.vec3],
    dt: float,
    # in and out
    motion: Motion,
    # out
    planes: wp.array[wp.vec4d],
):
    """Writes positions, velocities and planes at the end of a step.

    Velocities are those of particles as they are, and those of shapes from their positions. A vertex without a finite
    position at the end stands where it was.
    """
    i = wp.tid()
    _place_plane(placement, i, planes)
    if i >= motion.x1.shape[0]:
        return
    x0 = motion.x0[i]
    x1 = _position(placement, i)
    velocity = (x1 - x0) / dt
    if i < particle_qd.shape[0]:
        velocity = particle_qd[i]
    finite = wp.isfinite(x1) and wp.isfinite(velocity)
    motion.x1[i] = wp.where(finite, x1, x0)
    motion.velocity[i] = wp.where(finite, velocity, wp.vec3())
    motion.is_lost[i] = wp.where(finite, 0, 1)


class ModelMotion:
    """The input of :meth:`.response.Response.resolve`, whose buffers are reused from step to step.

    Attributes:
        vertices: The vertices, :class:`.buffers.Motion`.
        planes: The infinite planes, :class:`.planes.MovingPlanes`.
    """

    def __init__(self, mesh: ModelMesh, friction: wp.array[float], plane_friction: wp.array[float]):
        """Allocates buffers.

        Args:
            mesh: The mesh.
            friction: Coefficients of its vertices; that of a contact is the geometric mean.
            plane_friction: Coefficients of its planes.
        """
        self._mesh = mesh
        self.vertices = vertices = Motion()
        for name in ("x0", "x1", "velocity"):
            setattr(vertices, name, wp.zeros(mesh.vertex_count, dtype=wp.vec3, device=mesh.device))
        vertices.is_lost = wp.zeros(mesh.vertex_count, dtype=int, device=mesh.device)
        vertices.inverse_mass, vertices.friction, vertices.world = mesh.inverse_masses, friction, mesh.device_world
        self.planes = planes = MovingPlanes()
        planes.friction, planes.world = plane_friction, mesh.device_planes.world
        for name in ("start", "end"):
            setattr(planes, name, wp.zeros(len(plane_friction), dtype=wp.vec4d, device=mesh.device))
        self._size = max(mesh.vertex_count, len(plane_friction))

    def set_start(self, particle_q: wp.array[wp.vec3] | None, body_q: wp.array[wp.transform] | None) -> None:
        """Copies the positions at the start of a step, from arrays as of :meth:`.model_mesh.ModelMesh.positions`."""
        x0, planes = self.vertices.x0, self.planes.start
        self._mesh.check_lengths(particle_q, body_q, x0)
        inputs = [self._placement(particle_q, body_q)]
        wp.launch(_write_start, self._size, inputs=inputs, outputs=[x0, planes], device=self._mesh.device)

    def set_end(
        self,
        particle_q: wp.array[wp.vec3] | None,
        particle_qd: wp.array[wp.vec3] | None,
        body_q: wp.array[wp.transform] | None,
        dt: float,
    ) -> None:
        """Copies the wanted positions and velocities at the end of a step of length ``dt`` [s], after its start."""
        self._mesh.check_lengths(particle_q, body_q, self.vertices.x1)
        inputs = [self._placement(particle_q, body_q), particle_qd, dt]
        outputs = [self.vertices, self.planes.end]
        wp.launch(_write_end, self._size, inputs=inputs, outputs=outputs, device=self._mesh.device)

    def _placement(self, particle_q, body_q):
        mesh, placement = self._mesh, _Placement()
        placement.particle_q, placement.body_q = particle_q, body_q
        placement.shape_vertex_position = mesh.device_shape_vertices.position
        placement.shape_vertex_body = mesh.device_shape_vertices.body
        planes = mesh.device_planes
        placement.plane_point, placement.plane_normal, placement.plane_body = planes.point, planes.normal, planes.body
        return placement
