"""Small USD stages whose collisions are known beforehand, and what a replay finds in them."""

import json

import numpy as np
import pytest
from pxr import Sdf, Usd, UsdGeom

from warp_bsc.cli.main import main

FLOOR = [(-2, -2, 0), (2, -2, 0), (2, 2, 0), (-2, 2, 0)]
FALLING = [(0.5, -0.5, 0.0), (0.9, -0.5, 0.5), (0.5, -0.9, 0.5)]
"""A triangle whose point 0 is 0.5 lower than the others; it is within the floor's first triangle, seen from above."""

HIT = ("/World/Falling", "vertex 0", "/World/Floor", "face 0", 0.5, (0.5, -0.5, 0.0))
"""What FALLING does when it falls from a height of 0.25 to one of -0.25."""

CORNERS = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]
"""Of a tetrahedron that is not inverted."""


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


def add_tets(stage, points, tets=((0, 1, 2, 3),), surface=None, path="/World/Soft"):
    """Tetrahedra, one of CORNERS if none are given; points as of :func:`add_mesh`."""
    mesh = UsdGeom.TetMesh.Define(stage, path)
    mesh.CreateTetVertexIndicesAttr(list(tets))
    if surface:
        mesh.CreateSurfaceFaceVertexIndicesAttr(surface)
    for time, value in points.items() if isinstance(points, dict) else [(Usd.TimeCode.Default(), points)]:
        mesh.CreatePointsAttr().Set(value, time)
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


def with_names(found):
    """The content of a JSON file with the names of two meshes, and in rows their prims, instead of their numbers."""

    def named(value):
        if isinstance(value, list):
            return [named(item) for item in value]
        if not isinstance(value, dict):
            return value
        value = {name: named(item) for name, item in value.items()}
        if "mesh" in value:
            numbers = value.pop("mesh")
            value["meshes"] = [found["meshes"][number] for number in numbers]
            if "kind" in value:
                value["prims"] = [found["prims"][number] for number in numbers]
        return value

    return named(found)


def find(stage, *options, status=0):
    """What a replay finds, as its JSON has it, with names."""
    path = save(stage) if isinstance(stage, Usd.Stage) else str(stage)
    out = f"{path}.json"
    assert main(["replay", path, "--device", "cpu", "--validate", "all", "--json", out, *options]) == status
    with open(out) as file:
        return with_names(json.load(file))


def hits(found, index=None):
    """Names, elements, time and place of each collision, of one interval or of all."""
    return [
        (
            contact["meshes"][0],
            contact["elements"][0],
            contact["meshes"][1],
            contact["elements"][1],
            pytest.approx(contact["time"], abs=1e-5),
            pytest.approx(tuple(contact["position"]), abs=1e-5),
        )
        for interval in found["intervals"]
        if index is None or interval["index"] == index
        for contact in interval["contacts"]
    ]


def add_falling(stage, path="/World/Falling", start=0.25, end=-0.25):
    return add_mesh(stage, path, falling(start, end))


def add_instancer(stage, path, positions, prototypes, numbers=None):
    """Positions by time; all instances are of the first prototype if no numbers are given."""
    instancer = UsdGeom.PointInstancer.Define(stage, path)
    for time, value in positions.items():
        instancer.CreatePositionsAttr().Set(value, time)
    instancer.CreatePrototypesRel().SetTargets([Sdf.Path(prototype) for prototype in prototypes])
    count = len(next(iter(positions.values())))
    instancer.CreateProtoIndicesAttr(numbers or [0] * count)
    return instancer


def floor_stage(folder):
    """A stage with a floor."""
    stage = new_stage(folder / "scene.usda")
    add_floor(stage)
    return stage


def falling_stage(folder):
    """A triangle falls through a floor from time 0 to 1."""
    stage = floor_stage(folder)
    add_falling(stage)
    return stage


def resting_stage(folder):
    """A triangle falls through a floor from time 0 to 1; another one rests in it, and leaves it from time 2 to 3."""
    stage = falling_stage(folder)
    heights = [-0.25, -0.25, -0.25, 0.25]
    add_mesh(stage, "/World/Resting", {t: moved(FALLING, (-1, 1, z)) for t, z in enumerate(heights)})
    return stage
