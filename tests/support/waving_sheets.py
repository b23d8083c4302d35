"""A scene of two sheets that wave through each other, and the options for all files of its replay."""

import numpy as np
from pxr import UsdGeom, Vt
from usd_stages import new_stage, save

OUTPUTS = {
    "--json": "hits.json",
    "--csv": "hits.csv",
    "--overlay": "overlay.usda",
    "--report": "page.html",
    "--npz": "hits.npz",
}
FRAMES, SIDE = 40, 10


def write_scene(path, phase=0.0, frames=FRAMES):
    stage = new_stage(path)
    x, y = np.meshgrid(np.linspace(-1, 1, SIDE), np.linspace(-1, 1, SIDE), indexing="ij")
    corner = (np.arange(SIDE - 1)[:, None] * SIDE + np.arange(SIDE - 1)).reshape(-1, 1)
    quads = corner + np.array([0, SIDE, SIDE + 1, 1])
    for name, lag in (("/World/A", 0), ("/World/B", 2)):
        mesh = UsdGeom.Mesh.Define(stage, name)
        mesh.CreateFaceVertexCountsAttr([4] * len(quads))
        mesh.CreateFaceVertexIndicesAttr(quads.reshape(-1).tolist())
        for frame in range(frames):
            z = 0.2 * np.sin(3 * x + 0.3 * frame + lag + phase)
            points = np.stack([x, y, z], axis=2).reshape(-1, 3).astype(np.float32)
            mesh.CreatePointsAttr().Set(Vt.Vec3fArray.FromNumpy(points), frame)
    return save(stage)


def write_old(folder):
    """What an earlier replay left."""
    for name in OUTPUTS.values():
        (folder / name).write_text("old")


def options(folder):
    return [word for option, name in OUTPUTS.items() for word in (option, str(folder / name))] + ["--device", "cpu"]
