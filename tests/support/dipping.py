"""A shot that collides once, and its repair by the command line."""

import numpy as np
from pxr import Usd, UsdGeom
from usd_stages import add_mesh, new_stage, save

from warp_bsc.cli.main import main

SIZE, FRAMES, HIT = 8, 34, 16


def sheet(height, bump=0.0):
    """A square sheet of quads, with a bump in its middle."""
    y, x = np.mgrid[: SIZE + 1, : SIZE + 1] / SIZE - 0.5
    z = height + bump * np.exp(-30.0 * (x * x + y * y))
    return np.stack([x, y, z], axis=-1).reshape(-1, 3).astype(np.float32)


def quads():
    """Vertices of the faces of a sheet."""
    corner = np.arange(SIZE)[:, None] * (SIZE + 1) + np.arange(SIZE)
    return np.stack([corner, corner + 1, corner + SIZE + 2, corner + SIZE + 1], axis=-1).reshape(-1).tolist()


def dipping_sheet(folder, last=FRAMES, dip=-0.12):
    """A sheet whose middle dips through a plate below it, once."""
    stage = new_stage(folder / "shot.usda")
    plate = sheet(0.0) * np.float32(3.0)
    add_mesh(stage, "/World/Plate", [tuple(map(float, point)) for point in plate], [4] * SIZE**2, quads())
    dips = {time: dip if time == HIT else 0.0 for time in range(last)}
    points = {time: [tuple(map(float, p)) for p in sheet(0.1 + 0.001 * time, dips[time])] for time in dips}
    add_mesh(stage, "/World/Sheet", points, [4] * SIZE**2, quads())
    return stage


def repaired(stage, *options, status=0):
    """Repairs a shot, and returns the path of the layer."""
    path = save(stage) if isinstance(stage, Usd.Stage) else str(stage)
    output = path.replace("shot.usda", "fixed.usdc")
    assert main(["repair", path, "--output", output, "--device", "cpu", *options]) == status
    return output


def points_of(path, time, prim="/World/Sheet"):
    """Points of a prim at a time."""
    stage = Usd.Stage.Open(str(path))
    return np.array(UsdGeom.Mesh(stage.GetPrimAtPath(prim)).GetPointsAttr().Get(time))
