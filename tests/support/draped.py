"""Writes frames of cloth that VBD drapes over a sphere without self-contact, so that it crosses itself, as OBJ files.

Run it as ``python tests/support/draped.py FOLDER FRAME...``: frames of 1/60 s, of which 17 is the second that crosses
itself, and 32 is one of the worst. ``warp-bsc bench repair`` reads the files.
"""

import sys
from collections.abc import Iterator
from pathlib import Path

import newton
import numpy as np
import trimesh
import warp as wp


def drape(
    cells: int, steps: int, radius: float, mass: float, corner: wp.vec3
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Simulates a cloth of 0.8 m that falls on a sphere and the ground, and yields its faces and positions by frame.

    Args:
        cells: Cells of the cloth on each side.
        steps: Steps of a frame of 1/60 s.
        radius: Radius of the sphere, which is at the origin [m].
        mass: Mass of each particle [kg].
        corner: Where the cloth begins.
    """
    builder = newton.ModelBuilder()
    config = newton.ModelBuilder.ShapeConfig()
    config.mu = 0.5
    builder.add_shape_sphere(body=-1, radius=radius, cfg=config)
    builder.add_ground_plane(height=-0.35)
    cell = 0.8 / cells
    size = {"dim_x": cells, "dim_y": cells, "cell_x": cell, "cell_y": cell, "mass": mass, "particle_radius": 0.005}
    stiffness = {"tri_ke": 2e2, "tri_ka": 2e2, "tri_kd": 1e-3, "edge_ke": 1e-4, "edge_kd": 1e-5}
    builder.add_cloth_grid(pos=corner, rot=wp.quat_identity(), vel=wp.vec3(), **size, **stiffness)
    builder.color()
    model = builder.finalize(device="cpu")
    model.soft_contact_ke, model.soft_contact_kd, model.soft_contact_mu = 1e4, 1e-2, 0.5
    solver = newton.solvers.SolverVBD(model, iterations=10)
    pipeline = newton.CollisionPipeline(model)
    contacts, control = pipeline.contacts(), model.control()
    state, other = model.state(), model.state()
    faces = model.tri_indices.numpy().reshape(-1, 3)
    while True:
        yield faces, state.particle_q.numpy().copy()
        for _ in range(steps):
            state.clear_forces()
            pipeline.collide(state, contacts)
            solver.step(state, other, control, contacts, 1.0 / (60.0 * steps))
            state, other = other, state


def main() -> None:
    """Simulates up to the last frame asked for, and writes the frames."""
    folder, *frames = sys.argv[1:]
    numbers = [int(frame) for frame in frames]
    shot = drape(48, 2, 0.15, 0.0002, wp.vec3(-0.4, -0.43, 0.2))
    next(shot)  # frame 0 is that after the first sixtieth of a second
    for frame, (faces, x) in zip(range(max(numbers) + 1), shot, strict=False):
        if frame in numbers:
            trimesh.Trimesh(x, faces, process=False).export(Path(folder) / f"draped_{frame}.obj", digits=9)


if __name__ == "__main__":
    main()
