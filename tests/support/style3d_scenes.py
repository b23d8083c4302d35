"""Models of cloth for Style3D."""

import newton
import warp as wp
from newton.solvers import SolverStyle3D
from newton_scenes import grid


def add_sheet(builder, cells, height, *, size=0.6, speed=0.0):
    newton.solvers.style3d.add_cloth_grid(
        builder,
        pos=wp.vec3(-0.5 * size, -0.5 * size, height),
        rot=wp.quat_identity(),
        vel=wp.vec3(0.0, 0.0, speed),
        **grid(cells, size / cells),
        mass=5e-4,
        particle_radius=0.002,
        tri_aniso_ke=wp.vec3(2e2, 2e2, 2e1),
        edge_aniso_ke=wp.vec3(2e-5, 1e-5, 5e-6),
    )


def drape(device, *, sheets=1, cells=10):
    builder = newton.ModelBuilder()
    SolverStyle3D.register_custom_attributes(builder)
    builder.add_shape_sphere(body=-1, radius=0.15)
    for i in range(sheets):
        add_sheet(builder, cells, 0.17 + 0.02 * i)
    model = builder.finalize(device=device)
    model.particle_mu = 0.5
    return model
