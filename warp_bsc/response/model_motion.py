"""The motion of a model in a step: its vertices and planes at the start, and as wanted at the end."""

import warp as wp

from .buffers import Motion
from .model_mesh import ModelMesh
from .planes import MovingPlanes, transform_planes

__all__ = ["ModelMotion"]


@wp.kernel(enable_backward=False)
def _write_velocities(
    # in
    particle_qd: wp.array[wp.vec3],
    x0: wp.array[wp.vec3],
    x1: wp.array[wp.vec3],
    dt: float,
    # out
    velocity: wp.array[wp.vec3],
):
    """Writes the velocities of particles as they are, and those of shapes from their positions."""
    vertex = wp.tid()
    if vertex < particle_qd.shape[0]:
        velocity[vertex] = particle_qd[vertex]
    else:
        velocity[vertex] = (x1[vertex] - x0[vertex]) / dt


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
        vertices.inverse_mass, vertices.friction, vertices.world = mesh.inverse_masses, friction, mesh.device_world
        self.planes = planes = MovingPlanes()
        planes.friction, planes.world = plane_friction, mesh.device_planes.world
        for name in ("start", "end"):
            setattr(planes, name, wp.zeros(len(plane_friction), dtype=wp.vec4d, device=mesh.device))

    def set_start(self, particle_q: wp.array[wp.vec3] | None, body_q: wp.array[wp.transform] | None) -> None:
        """Copies the positions at the start of a step, from arrays as of :meth:`.model_mesh.ModelMesh.positions`."""
        self._place(particle_q, body_q, self.vertices.x0, self.planes.start)

    def set_end(
        self,
        particle_q: wp.array[wp.vec3] | None,
        particle_qd: wp.array[wp.vec3] | None,
        body_q: wp.array[wp.transform] | None,
        dt: float,
    ) -> None:
        """Copies the wanted positions and velocities at the end of a step of length ``dt`` [s], after its start."""
        vertices = self.vertices
        self._place(particle_q, body_q, vertices.x1, self.planes.end)
        inputs, outputs = [particle_qd, vertices.x0, vertices.x1, dt], [vertices.velocity]
        wp.launch(_write_velocities, len(vertices.x0), inputs=inputs, outputs=outputs, device=self._mesh.device)

    def _place(self, particle_q, body_q, positions, planes):
        self._mesh.positions(particle_q, body_q, positions)
        place = self._mesh.device_planes
        inputs = [place.point, place.normal, place.body, body_q]
        wp.launch(transform_planes, len(planes), inputs=inputs, outputs=[planes], device=self._mesh.device)
