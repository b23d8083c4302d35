"""Writes a shot of cloth that VBD drapes over a sphere and the ground without self-contact, so that it crosses itself.

Run it as ``python tests/support/draped_shot.py drape.usdc``. ``warp-bsc repair`` reads the file.
"""

import sys
from pathlib import Path

import numpy as np
import warp as wp
from draped import drape
from pxr import Usd, UsdGeom, Vt

FRAMES = 60


def write_shot(path: Path) -> None:
    """Simulates, and writes a frame each 1/60 s to a file."""
    stage = Usd.Stage.CreateNew(str(path))
    mesh = UsdGeom.Mesh.Define(stage, "/World/Cloth")
    points = mesh.CreatePointsAttr()
    shot = drape(24, 8, 0.2, 0.0008, wp.vec3(-0.4, -0.43, 0.25))
    for frame, (faces, x) in zip(range(FRAMES + 1), shot, strict=False):
        if frame == 0:
            mesh.CreateFaceVertexCountsAttr([3] * len(faces))
            mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.ravel().astype(np.int32)))
        points.Set(Vt.Vec3fArray.FromNumpy(x), frame)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(FRAMES)
    stage.GetRootLayer().Save()


if __name__ == "__main__":
    write_shot(Path(sys.argv[1]))
