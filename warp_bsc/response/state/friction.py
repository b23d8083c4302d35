"""Coefficients of friction of the vertices and planes of a mesh, from those of particles and shapes."""

import warp as wp

from .mesh import ModelMesh


@wp.kernel
def _write_friction(
    # in
    of_particles: wp.array[float],
    of_shapes: wp.array[float],
    particle_count: int,
    shape_of_vertex: wp.array[int],
    shape_of_plane: wp.array[int],
    # out
    vertices: wp.array[float],
    planes: wp.array[float],
):
    """Writes the coefficients of vertices and planes; negative ones count as 0."""
    i = wp.tid()
    if i < planes.shape[0]:
        planes[i] = wp.max(of_shapes[shape_of_plane[i]], 0.0)
    if i < particle_count:
        vertices[i] = wp.max(of_particles[i % of_particles.shape[0]], 0.0)
    elif i < vertices.shape[0]:
        vertices[i] = wp.max(of_shapes[shape_of_vertex[i - particle_count]], 0.0)


class Friction:
    """Coefficients of friction; that of a contact is the geometric mean of those of its two sides.

    Attributes:
        vertices: Coefficients of vertices, Warp array of float, shape [vertex_count].
        planes: Coefficients of infinite planes, Warp array of float, shape [plane_count].
        of_particles: The coefficients of particles from which they are read, shape [1] or [particle_count].
        of_shapes: The coefficients of shapes from which they are read, as ``newton.Model.shape_material_mu``.
    """

    def __init__(self, mesh: ModelMesh, of_particles: wp.array[float], of_shapes: wp.array[float]):
        """Reads the coefficients of the vertices and planes of a mesh for the first time."""
        self.of_particles, self.of_shapes = of_particles, of_shapes
        shapes = mesh.device_shape_vertices.shape, mesh.device_planes.shape
        self._inputs = [of_particles, of_shapes, mesh.model.particle_count, *shapes]
        self.vertices = wp.zeros(mesh.vertex_count, dtype=float, device=mesh.device)
        self.planes = wp.zeros(len(shapes[1]), dtype=float, device=mesh.device)
        self.read()

    def read(self) -> None:
        """Reads the coefficients again. Can be captured in a CUDA graph."""
        self._launch([self.vertices, self.planes])

    def backward(self, of_vertices: wp.array[float], of_planes: wp.array[float]) -> None:
        """Adds to the gradients of :attr:`of_particles` and :attr:`of_shapes`, given those of vertices and planes."""
        outputs = [of_vertices, of_planes]  # stand in for the outputs, which the adjoint does not read or write
        self._launch(outputs, adjoint=True, adj_inputs=5 * [None], adj_outputs=outputs)

    def _launch(self, outputs, **options):
        size, device = max(map(len, outputs)), self.vertices.device
        wp.launch(_write_friction, size, inputs=self._inputs, outputs=outputs, device=device, **options)
