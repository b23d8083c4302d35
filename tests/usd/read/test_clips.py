"""Value clips that OpenUSD passes over: they are named, and left out with status 4."""

import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, Vt
from usd_stages import FALLING, HIT, add_floor, add_mesh, find, floor_stage, hits, moved, new_stage, save

from warp_bsc.usd.scene import Scene


@pytest.fixture
def stage(tmp_path):
    """A floor, and a mesh that value clips move through it from time 0 to 1; without them it rests above."""
    for name, heights in {"clip": (0.25, -0.25), "manifest": ()}.items():
        layer = new_stage(tmp_path / f"{name}.usda")
        mesh = UsdGeom.Mesh(layer.OverridePrim("/Odd"))
        for attribute in (mesh.CreatePointsAttr(), mesh.CreateNormalsAttr()):
            for time, height in enumerate(heights):
                attribute.Set(moved(FALLING, (0, 0, height)), time)
        save(layer)
    save(new_stage(tmp_path / "empty.usda"))
    rest = new_stage(tmp_path / "rest.usda")  # clips are stronger than what a reference has
    add_mesh(rest, "/Odd", moved(FALLING, (0, 0, 0.25)))
    save(rest)
    stage = floor_stage(tmp_path)
    prim = stage.OverridePrim("/World/Falling")
    prim.GetReferences().AddReference("./rest.usda", "/Odd")
    set_clips(stage, {})
    return stage


def set_clips(stage, changes, name="default"):
    values = {
        "primPath": "/Odd",
        "assetPaths": Sdf.AssetPathArray([Sdf.AssetPath("./clip.usda")]),
        "active": Vt.Vec2dArray([(0, 0)]),
        "times": Vt.Vec2dArray([(0, 0), (1, 1)]),
        "manifestAssetPath": Sdf.AssetPath("./manifest.usda"),
    } | changes
    clips = {key: value for key, value in values.items() if value is not None}
    stage.GetPrimAtPath("/World/Falling").SetMetadata("clips", {name: clips})


def assets(*paths):
    return Sdf.AssetPathArray([Sdf.AssetPath(path) for path in paths])


TEMPLATE = {"assetPaths": None, "active": None, "times": None, "templateAssetPath": "./gone.#.usda"}
RANGE = {"templateStartTime": 0.0, "templateEndTime": 1.0, "templateStride": 1.0}
FAULTS = [
    ({"primPath": None}, "they have no primPath"),
    ({"primPath": ""}, "they have no primPath"),
    ({"primPath": "Odd"}, "Odd is not the path of a prim"),
    ({"primPath": "/Nothing"}, "./clip.usda has no prim /Nothing"),
    ({"primPath": "/Nothing", "manifestAssetPath": None}, "./clip.usda has no prim /Nothing"),
    ({"assetPaths": None}, "they have no assetPaths"),
    ({"assetPaths": Sdf.AssetPathArray()}, "they have no assetPaths"),
    ({"active": None}, "they have no active"),
    ({"active": 1.0}, "their active is of another type, float"),
    ({"active": Vt.Vec2dArray([(0, 2)])}, "clip 2 is active, but there are 1"),
    ({"manifestAssetPath": Sdf.AssetPath("./gone.usda")}, "their manifest ./gone.usda cannot be opened"),
    (
        {"manifestAssetPath": Sdf.AssetPath("./empty.usda")},
        "their manifest ./empty.usda has no /Odd.points, of which ./clip.usda has samples",
    ),
    (TEMPLATE, "they have no templateStartTime"),
    (TEMPLATE | RANGE, "no file matches ./gone.#.usda"),
]


@pytest.mark.parametrize(("changes", "reason"), FAULTS, ids=[reason for _, reason in FAULTS])
def test_clips_that_are_passed_over_are_left_out(stage, capsys, changes, reason):
    set_clips(stage, changes)
    found = find(stage, status=4)
    assert found["left_out"] == [f"/World/Falling: value clips default: {reason}"]
    assert hits(found) == [] and "Not checked: 1 part" in capsys.readouterr().out


def test_a_file_of_the_clips_is_missing(stage):
    set_clips(stage, {"assetPaths": assets("./clip.usda", "./gone.usda"), "active": Vt.Vec2dArray([(0, 0), (1, 1)])})
    found = find(stage, status=4)
    first, second = found["left_out"]
    assert first == "/World/Falling: value clips default: 1 of 2 files cannot be opened; the first is ./gone.usda"
    assert second.endswith("/World/Falling: the mesh has no points at time 1")


def test_a_transform_whose_clip_is_missing_is_not_taken_for_at_rest(tmp_path):
    stage = new_stage(tmp_path / "scene.usda")
    manifest = new_stage(tmp_path / "manifest.usda")
    UsdGeom.Xformable(manifest.OverridePrim("/Odd")).GetPrim().CreateAttribute(
        "xformOp:translate", Sdf.ValueTypeNames.Double3
    )
    save(manifest)
    add_floor(stage)
    mesh = add_mesh(stage, "/World/Falling", FALLING)
    mesh.AddTranslateOp()
    set_clips(stage, {"assetPaths": assets("./gone.usda")})
    found = find(stage, status=4)
    assert found["left_out"][0].endswith("1 of 1 files cannot be opened; the first is ./gone.usda")


def test_clips_that_may_be_missing(stage):
    set_clips(stage, {"manifestAssetPath": Sdf.AssetPath("./gone.usda")})
    for pattern in ("gone.usda", "/World/Falling"):
        found = find(stage, "--allow-missing", pattern)
        assert found["left_out"] == [] and any("their manifest ./gone.usda" in text for text in found["warnings"])


WHOLE = [{}, {"times": None}, {"manifestAssetPath": None}, {"templateAssetPath": "./gone.#.usda"} | RANGE]


@pytest.mark.parametrize("changes", WHOLE, ids=["all", "without times", "without manifest", "with a template beside"])
def test_whole_clips_are_read(stage, changes):
    set_clips(stage, changes)
    found = find(stage, "--strict")
    assert hits(found) == [HIT] and found["left_out"] == []


def test_clips_that_are_not_chosen_need_not_be_whole(stage):
    set_clips(stage, {"primPath": None}, name="old")
    Usd.ClipsAPI(stage.GetPrimAtPath("/World/Falling")).SetClipSets(Sdf.StringListOp.CreateExplicit(["new"]))
    assert find(stage)["left_out"] == []


def test_clips_in_memory_are_read():
    clip = Usd.Stage.CreateInMemory()
    add_mesh(clip, "/Odd", {time: moved(FALLING, (0, 0, height)) for time, height in ((0, 0.25), (1, -0.25))})
    stage = Usd.Stage.CreateInMemory()
    mesh = add_mesh(stage, "/World/Falling", FALLING)
    mesh.GetPrim().RemoveProperty("points")
    set_clips(stage, {"assetPaths": assets(clip.GetRootLayer().identifier), "manifestAssetPath": None})
    scene = Scene(stage)
    assert scene.left_out == [] and scene.times == [0, 1]


def test_clips_of_instances_are_named_once(stage, tmp_path):
    set_clips(stage, {"primPath": None})
    save(stage)
    crowd = new_stage(tmp_path / "crowd.usda")
    for number in range(3):
        prim = crowd.DefinePrim(f"/World/Copy{number}")
        prim.GetReferences().AddReference("./scene.usda")
        prim.SetInstanceable(True)
        UsdGeom.Xformable(prim).AddTranslateOp().Set(Gf.Vec3d(9 * number, 0, 0))
    assert Scene(save(crowd)).left_out == ["/World/Copy0/Falling: value clips default: they have no primPath"]
