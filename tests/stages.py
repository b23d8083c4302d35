"""Small USD stages whose collisions are known beforehand."""

import numpy as np
from pxr import Usd, UsdGeom

FLOOR = [(-2, -2, 0), (2, -2, 0), (2, 2, 0), (-2, 2, 0)]
FALLING = [(0.5, -0.5, 0.0), (0.9, -0.5, 0.5), (0.5, -0.9, 0.5)]
"""A triangle whose point 0 is 0.5 lower than the others; it is within the floor's first triangle, seen from above."""


def new_stage(path, *, up_axis="Z", meters_per_unit=1.0):
    """A stage with the metadata that usdchecker asks for."""
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, up_axis)
    UsdGeom.SetStageMetersPerUnit(stage, meters_per_unit)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/World").GetPrim())
    return stage


def add_mesh(stage, path, points, counts=None, indices=None):
    """A mesh of one polygon, or of those given; points are one list, or a dictionary of lists by time."""
    mesh = UsdGeom.Mesh.Define(stage, path)
    first = next(iter(points.values())) if isinstance(points, dict) else points
    mesh.CreateFaceVertexCountsAttr(counts or [len(first)])
    mesh.CreateFaceVertexIndicesAttr(indices or list(range(len(first))))
    mesh.CreateSubdivisionSchemeAttr("none")
    if isinstance(points, dict):
        for time, value in points.items():
            mesh.CreatePointsAttr().Set(value, time)
    else:
        mesh.CreatePointsAttr(points)
    low, high = np.min(first, axis=0), np.max(first, axis=0)
    mesh.CreateExtentAttr([tuple(map(float, low)), tuple(map(float, high))])
    return mesh


def add_floor(stage, path="/World/Floor"):
    return add_mesh(stage, path, FLOOR)


def moved(points, by):
    return [tuple(map(float, np.add(point, by))) for point in points]


def falling(start, end):
    """FALLING, its lowest point from one height to the other."""
    return {0: moved(FALLING, (0, 0, start)), 1: moved(FALLING, (0, 0, end))}


def animate(prim, *values, times=None):
    """Translate a prim to each value at a time."""
    operation = UsdGeom.Xformable(prim).AddTranslateOp()
    for time, value in zip(times or range(len(values)), values, strict=True):
        operation.Set(value, time)
    return operation


def save(stage):
    stage.GetRootLayer().Save()
    return stage.GetRootLayer().realPath
