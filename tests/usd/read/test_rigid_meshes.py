"""Meshes that only transforms move, read together, have the positions that each has by itself."""

import pytest
from pxr import Gf, UsdGeom
from usd_stages import FALLING, add_mesh, animate, falling, floor_stage, save

import warp_bsc as bsc


@pytest.fixture
def stage(tmp_path):
    return floor_stage(tmp_path)


def add_group(stage, count=5):
    """Meshes below a group that turns, each carried by itself, and one that is deformed."""
    group = UsdGeom.Xform.Define(stage, "/World/Group").AddRotateXYZOp()
    for time in range(4):
        group.Set(Gf.Vec3f(10.0 * time, -7.0 * time, 3.3 * time), time)
    for number in range(count):
        mesh = add_mesh(stage, f"/World/Group/Mesh{number}", FALLING)
        animate(mesh, *((0.1 * number * time, 0.3 * time, 0.7 * number + 1.0) for time in range(4)))
    add_mesh(stage, "/World/Group/Deformed", falling(2.0, 1.0))


def by_itself(scene, mesh, time, before):
    usd_mesh = scene.prim_of(mesh.name)
    return usd_mesh.read_positions(
        time, before=before, used=mesh.points, point_count=mesh.point_count, dtype=scene.dtype
    )


def test_positions_are_those_of_each_mesh_by_itself(stage):
    add_group(stage)
    scene = bsc.Scene(save(stage))
    for interval in scene:
        for x, time, before in ((interval.x0, interval.start, False), (interval.x1, interval.end, True)):
            for number, mesh in enumerate(interval.segment.meshes):
                found = x[interval.segment.vertices_of(number)]
                assert found.tobytes() == by_itself(scene, mesh, time, before).tobytes()
    assert len({x.tobytes() for x in (scene.interval(0).x0, scene.interval(0).x1, scene.interval(2).x1)}) == 3


def test_points_are_read_once_and_transforms_at_each_time(stage, monkeypatch):
    add_group(stage)
    scene = bsc.Scene(save(stage))
    mesh, reads = scene.prim_of("/World/Group/Mesh0"), []
    read_points = type(mesh).read_points
    monkeypatch.setattr(
        type(mesh),
        "read_points",
        lambda self, *args, **options: reads.append(self) or read_points(self, *args, **options),
    )
    list(scene)
    assert reads.count(mesh) == 1 and reads.count(scene.prim_of("/World/Group/Deformed")) == 4


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_a_broken_transform_leaves_out_its_mesh_alone(stage, bad):
    add_group(stage)
    UsdGeom.Xformable(stage.GetPrimAtPath("/World/Group/Mesh3")).GetOrderedXformOps()[0].Set((bad, 0, 0), 2.0)
    scene = bsc.Scene(save(stage))
    last = list(scene)[-1]
    assert [mesh.name for mesh in last.segment.meshes if "Mesh" in mesh.name] == [
        f"/World/Group/Mesh{number}" for number in (0, 1, 2, 4)
    ]
    assert len(scene.left_out) == 1 and "/World/Group/Mesh3: its transform is not finite" in scene.left_out[0]
    with pytest.raises(ValueError, match="Mesh3: its transform is not finite at time 2"):
        list(bsc.Scene(scene.path, strict=True))
