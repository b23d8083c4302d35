"""Writes frames of cloth that VBD drapes over a sphere without self-contact, so that it crosses itself, as OBJ files.

Run it as ``python tests/support/draped.py FOLDER FRAME...``: frames of 1/60 s, of which 17 is the second that crosses
itself, and 32 is one of the worst. ``warp-bsc bench repair`` reads the files.
"""

import sys
from pathlib import Path

import newton
import trimesh
import warp as wp

CELLS = 48
STEPS = 2
"""Steps of a frame."""


def main() -> None:
    """Simulates up to the last frame asked for, and writes the frames."""
    folder, *frames = sys.argv[1:]
    numbers = [int(frame) for frame in frames]
    builder = newton.ModelBuilder()
    config = newton.ModelBuilder.ShapeConfig()
    config.mu = 0.5
    builder.add_shape_sphere(body=-1, radius=0.15, cfg=config)
    builder.add_ground_plane(height=-0.35)
    cell = 0.8 / CELLS
    size = {"dim_x": CELLS, "dim_y": CELLS, "cell_x": cell, "cell_y": cell, "mass": 0.0002, "particle_radius": 0.005}
    stiffness = {"tri_ke": 2e2, "tri_ka": 2e2, "tri_kd": 1e-3, "edge_ke": 1e-4, "edge_kd": 1e-5}
    place = {"pos": wp.vec3(-0.4, -0.43, 0.2), "rot": wp.quat_identity(), "vel": wp.vec3()}
    builder.add_cloth_grid(**place, **size, **stiffness)
    builder.color()
    model = builder.finalize()
    model.soft_contact_ke, model.soft_contact_kd, model.soft_contact_mu = 1e4, 1e-2, 0.5
    solver = newton.solvers.SolverVBD(model, iterations=10)
    pipeline = newton.CollisionPipeline(model)
    contacts, control = pipeline.contacts(), model.control()
    state, other = model.state(), model.state()
    faces = model.tri_indices.numpy().reshape(-1, 3)
    for frame in range(max(numbers) + 1):
        for _ in range(STEPS):
            state.clear_forces()
            pipeline.collide(state, contacts)
            solver.step(state, other, control, contacts, 1.0 / (60.0 * STEPS))
            state, other = other, state
        if frame in numbers:
            mesh = trimesh.Trimesh(state.particle_q.numpy(), faces, process=False)
            mesh.export(Path(folder) / f"draped_{frame}.obj", digits=9)


if __name__ == "__main__":
    main()
