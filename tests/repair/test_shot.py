"""A repaired shot: free of collisions, as it was where it was free, and back where it was after each collision."""

import json

import numpy as np
import pytest
from pxr import Usd, UsdGeom
from stages import add_mesh, find, new_stage, save

from warp_bsc import Scene, replay
from warp_bsc.cli.main import main
from warp_bsc.repair.blend import BLEND, blend
from warp_bsc.repair.findings import find_collisions
from warp_bsc.repair.shot import repair_shot

SIZE, FRAMES, HIT = 8, 34, 16


def sheet(height, bump=0.0):
    """A square sheet of quads, with a bump in its middle."""
    y, x = np.mgrid[: SIZE + 1, : SIZE + 1] / SIZE - 0.5
    z = height + bump * np.exp(-30.0 * (x * x + y * y))
    return np.stack([x, y, z], axis=-1).reshape(-1, 3).astype(np.float32)


def quads():
    corner = np.arange(SIZE)[:, None] * (SIZE + 1) + np.arange(SIZE)
    return np.stack([corner, corner + 1, corner + SIZE + 2, corner + SIZE + 1], axis=-1).reshape(-1).tolist()


def dipping_sheet(folder, last=FRAMES):
    """A sheet whose middle dips through a plate below it, once."""
    stage = new_stage(folder / "shot.usda")
    plate = sheet(0.0) * np.float32(3.0)
    add_mesh(stage, "/World/Plate", [tuple(map(float, point)) for point in plate], [4] * SIZE**2, quads())
    dips = {time: -0.12 if time == HIT else 0.0 for time in range(last)}
    points = {time: [tuple(map(float, p)) for p in sheet(0.1 + 0.001 * time, dips[time])] for time in dips}
    add_mesh(stage, "/World/Sheet", points, [4] * SIZE**2, quads())
    return stage


def repaired(stage, *options, status=0):
    path = save(stage) if isinstance(stage, Usd.Stage) else str(stage)
    output = path.replace("shot.usda", "fixed.usdc")
    assert main(["repair", path, "--output", output, "--device", "cpu", *options]) == status
    return output


def points_of(path, time, prim="/World/Sheet"):
    stage = Usd.Stage.Open(path)
    return np.array(UsdGeom.Mesh(stage.GetPrimAtPath(prim)).GetPointsAttr().Get(time))


@pytest.fixture(scope="module")
def dipped(tmp_path_factory):
    folder = tmp_path_factory.mktemp("shot")
    stage = dipping_sheet(folder)
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/World/Sheet"))
    mesh.CreateExtentAttr([(-0.5, -0.5, 0), (0.5, 0.5, 1)])
    mesh.CreateNormalsAttr([(0, 0, 1)] * (SIZE + 1) ** 2)
    mesh.SetNormalsInterpolation("vertex")
    mesh.CreateVelocitiesAttr([(0, 0, 0)] * (SIZE + 1) ** 2)
    found = find(stage)
    assert sum(len(interval["contacts"]) for interval in found["intervals"])
    return stage, repaired(stage)


def test_repaired_shot_is_free(dipped):
    found = find(dipped[1])
    assert found["complete"] and not found["hits"]
    assert not any(at["crossings"] for at in found["intersections"])


def test_free_frames_keep_every_bit(dipped):
    stage, output = dipped
    margin = BLEND + 2
    moved = []
    for time in range(FRAMES):
        old = np.array(UsdGeom.Mesh(stage.GetPrimAtPath("/World/Sheet")).GetPointsAttr().Get(time))
        if not np.array_equal(old, points_of(output, time)):
            moved.append(time)
    assert HIT in moved
    assert moved[0] >= HIT - margin
    assert moved[-1] < FRAMES - 1
    assert np.array_equal(points_of(output, 0, "/World/Plate"), sheet(0.0) * np.float32(3.0))


def test_displacements_grow_and_fade(dipped):
    stage, output = dipped
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/World/Sheet"))
    added = np.array([points_of(output, time) - np.array(mesh.GetPointsAttr().Get(time)) for time in range(FRAMES)])
    jump = np.linalg.norm(np.diff(added, axis=0), axis=2).max()
    assert jump < 0.5 * np.linalg.norm(added, axis=2).max()


def test_extents_normals_and_velocities_are_made_again(dipped):
    stage = Usd.Stage.Open(dipped[1])
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/World/Sheet"))
    points = np.array(mesh.GetPointsAttr().Get(HIT))
    assert np.array_equal(np.array(mesh.GetExtentAttr().Get(HIT)), [points.min(axis=0), points.max(axis=0)])
    assert np.array_equal(np.array(mesh.GetExtentAttr().Get(0)), [(-0.5, -0.5, 0), (0.5, 0.5, 1)])
    assert np.allclose(np.linalg.norm(mesh.GetNormalsAttr().Get(HIT), axis=1), 1.0, atol=1e-5)
    assert np.array_equal(np.array(mesh.GetNormalsAttr().Get(0)), [(0, 0, 1)] * len(points))
    assert np.abs(mesh.GetVelocitiesAttr().Get(HIT - 1)).max() > 0
    assert not np.any(mesh.GetVelocitiesAttr().Get(0))


def test_free_shot_is_not_written(tmp_path, capsys):
    stage = new_stage(tmp_path / "shot.usda")
    add_mesh(stage, "/World/Sheet", {0: sheet(0.0).tolist(), 1: sheet(0.5).tolist()}, [4] * SIZE**2, quads())
    repaired(stage)
    assert "Nothing was moved" in capsys.readouterr().out
    assert not (tmp_path / "fixed.usdc").exists()


def test_kept_mesh_does_not_move(tmp_path, capsys):
    stage = dipping_sheet(tmp_path)
    output = repaired(stage, "--keep", "/World/Sheet", "--json", "--fail-on", "left", status=1)
    found = json.loads(capsys.readouterr().out)
    assert found["kept"]["/World/Sheet"] == "it is to be kept"
    assert found["left"] == found["before"] and found["output"] is None
    assert not (tmp_path / output).exists()


def test_larger_moves_are_not_made(tmp_path, capsys):
    stage = dipping_sheet(tmp_path)
    repaired(stage, "--max-move", "0.001", "--fail-on", "left", status=1)
    assert "more than 0.001" in capsys.readouterr().out


def test_moved_mesh_with_a_transform(tmp_path):
    stage = dipping_sheet(tmp_path)
    for name in ("Plate", "Sheet"):
        UsdGeom.Xformable(stage.GetPrimAtPath(f"/World/{name}")).AddRotateXYZOp().Set((30, 40, 50))
    output = repaired(stage)
    found = find(output)
    assert not found["hits"]
    old = np.array(UsdGeom.Mesh(stage.GetPrimAtPath("/World/Sheet")).GetPointsAttr().Get(2))
    assert np.array_equal(points_of(output, 2), old)


def test_last_frame_is_repaired(tmp_path):
    output = repaired(dipping_sheet(tmp_path, last=HIT + 1))
    found = find(output)
    assert not found["hits"] and not any(at["crossings"] for at in found["intersections"])
    assert not np.array_equal(points_of(output, HIT), sheet(0.1 + 0.001 * HIT, -0.12))
    assert points_of(output, HIT)[:, 2].min() > 0


def test_blend():
    displacements = np.zeros((21, 3, 3), np.float32)
    displacements[10, 1] = (0.0, 0.0, 1.0)
    blended = blend(displacements)[:, 1, 2]
    assert not blended[: 10 - BLEND - 2].any() and not blended[11 + BLEND + 2 :].any()
    assert (np.diff(blended[:11]) >= 0).all() and np.allclose(blended, blended[::-1])
    assert blended[10] > 0.9
    assert not blend(displacements)[:, [0, 2]].any()


@pytest.mark.parametrize(
    ("options", "error"),
    [
        ({"keep": ("/None",)}, "keep: no mesh matches /None"),
        ({"max_move": -1.0}, "max_move"),
        ({"min_distance": -1.0}, "min_distance"),
    ],
)
def test_errors_name_the_argument(dipped, options, error):
    scene = Scene(dipped[0].GetRootLayer().realPath)
    with pytest.raises(ValueError, match=error):
        repair_shot(scene, [], **options)


def test_findings_know_where_a_mesh_jumps(tmp_path):
    stage = dipping_sheet(tmp_path, last=4)
    scene = Scene(save(stage))
    findings = list(find_collisions(scene, replay(scene, device="cpu")))
    assert [finding.is_joined for finding in findings] == [False, True, True]
    assert all(finding.is_free for finding in findings)
