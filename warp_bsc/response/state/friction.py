"""Coefficients of friction of the vertices and planes of a mesh, from those of particles and shapes, and by pair."""

import newton
import numpy as np
import warp as wp

from .friction_table import FrictionTable
from .mesh import ModelMesh
from .structs import Materials


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
    """Coefficients of friction; that of a contact is that of its pair of materials, if these have one.

    Else it is the geometric mean of those of its two sides.

    Attributes:
        vertices: Coefficients of vertices, Warp array of float, shape [vertex_count].
        planes: Coefficients of infinite planes, Warp array of float, shape [plane_count].
        of_particles: The coefficients of particles from which they are read, shape [1] or [particle_count].
        of_shapes: The coefficients of shapes from which they are read, as ``newton.Model.shape_material_mu``.
        materials: Materials of vertices and planes, with the coefficients of their pairs; empty without a table.
    """

    def __init__(
        self,
        mesh: ModelMesh,
        of_particles: wp.array[float],
        of_shapes: wp.array[float],
        table: FrictionTable | None = None,
    ):
        """Reads the coefficients of the vertices and planes of a mesh for the first time."""
        self.of_particles, self.of_shapes = of_particles, of_shapes
        shapes = mesh.device_shape_vertices.shape, mesh.device_planes.shape
        self._places = [mesh.model.particle_count, *shapes]
        self.vertices = wp.zeros(mesh.vertex_count, dtype=float, device=mesh.device)
        self.planes = wp.zeros(len(shapes[1]), dtype=float, device=mesh.device)
        self.materials = Materials()
        if table is not None:
            particles, shapes = table.materials(mesh.model)
            of_vertices = np.concatenate([particles, shapes[mesh.shape_vertices.shape]])
            self.materials.friction = table.on_device(mesh.model)
            self.materials.of_vertex = wp.array(of_vertices, dtype=int, device=mesh.device)
            self.materials.of_plane = wp.array(shapes[mesh.planes.shape], dtype=int, device=mesh.device)
        self.read()

    @property
    def inputs(self) -> list[wp.array]:
        """The arrays that coefficients are read from: of particles, of shapes and, with a table, of pairs."""
        table = self.materials.friction
        return [self.of_particles, self.of_shapes, *([] if table is None else [table])]

    def read(self) -> None:
        """Reads the coefficients again. Can be captured in a CUDA graph."""
        self._launch([self.vertices, self.planes])

    def read_shapes(self, model: newton.Model) -> None:
        """Reads the coefficients again, those of shapes from the array that a model has now."""
        if model.shape_material_mu is not None:
            self.of_shapes = model.shape_material_mu
        self.read()

    def backward(self, of_vertices: wp.array[float], of_planes: wp.array[float]) -> None:
        """Adds to the gradients of :attr:`of_particles` and :attr:`of_shapes`, given those of vertices and planes."""
        outputs = [of_vertices, of_planes]  # stand in for the outputs, which the adjoint does not read or write
        self._launch(outputs, adjoint=True, adj_inputs=5 * [None], adj_outputs=outputs)

    def _launch(self, outputs, **options):
        size, device = max(map(len, outputs)), self.vertices.device
        inputs = [self.of_particles, self.of_shapes, *self._places]
        wp.launch(_write_friction, size, inputs=inputs, outputs=outputs, device=device, **options)
