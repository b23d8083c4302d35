"""Writes a shot of cloth that VBD drapes over a sphere and the ground without self-contact, so that it crosses itself.

Run it as ``python tests/support/draped_shot.py drape.usdc``. ``warp-bsc repair`` reads the file.
"""

import sys

import newton
import numpy as np
import warp as wp
from pxr import Usd, UsdGeom, Vt

CELLS = 24
FRAMES = 60
STEPS = 8
"""Steps of a frame."""


def main() -> None:
    """Simulates, and writes a frame each 1/60 s."""
    builder = newton.ModelBuilder()
    config = newton.ModelBuilder.ShapeConfig()
    config.mu = 0.5
    builder.add_shape_sphere(body=-1, radius=0.2, cfg=config)
    builder.add_ground_plane(height=-0.35)
    cell = 0.8 / CELLS
    size = {"dim_x": CELLS, "dim_y": CELLS, "cell_x": cell, "cell_y": cell, "mass": 0.0008, "particle_radius": 0.005}
    stiffness = {"tri_ke": 2e2, "tri_ka": 2e2, "tri_kd": 1e-3, "edge_ke": 1e-4, "edge_kd": 1e-5}
    place = {"pos": wp.vec3(-0.4, -0.43, 0.25), "rot": wp.quat_identity(), "vel": wp.vec3()}
    builder.add_cloth_grid(**place, **size, **stiffness)
    builder.color()
    model = builder.finalize(device="cpu")
    model.soft_contact_ke, model.soft_contact_kd, model.soft_contact_mu = 1e4, 1e-2, 0.5
    solver = newton.solvers.SolverVBD(model, iterations=10)
    pipeline = newton.CollisionPipeline(model)
    contacts, control = pipeline.contacts(), model.control()
    state, other = model.state(), model.state()
    faces = model.tri_indices.numpy().reshape(-1, 3)
    stage = Usd.Stage.CreateNew(sys.argv[1])
    mesh = UsdGeom.Mesh.Define(stage, "/World/Cloth")
    mesh.CreateFaceVertexCountsAttr([3] * len(faces))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.ravel().astype(np.int32)))
    points = mesh.CreatePointsAttr()
    for frame in range(FRAMES + 1):
        points.Set(Vt.Vec3fArray.FromNumpy(state.particle_q.numpy().copy()), frame)
        for _ in range(STEPS):
            state.clear_forces()
            pipeline.collide(state, contacts)
            solver.step(state, other, control, contacts, 1.0 / (60.0 * STEPS))
            state, other = other, state
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(FRAMES)
    stage.GetRootLayer().Save()


if __name__ == "__main__":
    main()
