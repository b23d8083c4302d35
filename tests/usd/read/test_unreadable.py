"""Scenes of which parts cannot be read: these are named and left out, and the rest is checked."""

import json
import random
from itertools import islice

import numpy as np
import pytest
from pxr import Ar, Gf, Sdf, Usd, UsdGeom, UsdShade, UsdSkel, UsdUtils
from replay_files import Page
from usd_stages import (
    FALLING,
    HIT,
    add_falling,
    add_floor,
    add_instancer,
    add_mesh,
    falling_stage,
    find,
    floor_stage,
    hits,
    moved,
    new_stage,
    save,
)

from warp_bsc.cli.main import main
from warp_bsc.usd.scene import Scene


@pytest.fixture
def stage(tmp_path):
    """A triangle that falls through a floor."""
    return falling_stage(tmp_path)


def add_bare_mesh(stage):
    UsdGeom.Mesh.Define(stage, "/World/Odd")


def add_mesh_without_faces(stage):
    UsdGeom.Mesh.Define(stage, "/World/Odd").CreatePointsAttr(FALLING)


def add_mesh_with_a_broken_face(stage):
    add_mesh(stage, "/World/Odd", moved(FALLING, (9, 0, 0)), [3], [0, 1, 7])


def add_points_of_another_type(stage):
    prim = add_mesh(stage, "/World/Odd", FALLING).GetPrim()
    prim.RemoveProperty("points")
    spec = Sdf.AttributeSpec(stage.GetRootLayer().GetPrimAtPath("/World/Odd"), "points", Sdf.ValueTypeNames.Float)
    spec.default = 3.0


def add_faces_of_another_type(stage):
    prim = add_mesh(stage, "/World/Odd", FALLING).GetPrim()
    prim.RemoveProperty("faceVertexCounts")
    layer = stage.GetRootLayer()
    spec = Sdf.AttributeSpec(layer.GetPrimAtPath("/World/Odd"), "faceVertexCounts", Sdf.ValueTypeNames.FloatArray)
    spec.default = [3.0]


def add_missing_reference(stage):
    stage.DefinePrim("/World/Odd").GetReferences().AddReference("./gone.usda")


def add_material(stage):
    stage.DefinePrim("/World/Odd").GetReferences().AddReference("./skin.mtlx", "/MaterialX")


def add_instancer_without_prototype(stage):
    add_instancer(stage, "/World/Odd", {0: [(0, 0, 0)]}, ["/World/Gone"])


def add_instancer_of_itself(stage):
    add_instancer(stage, "/World/Odd", {0: [(0, 0, 0)]}, ["/World/Odd"])


def add_instancer_whose_arrays_do_not_fit(stage):
    add_instancer(stage, "/World/Odd", {0: [(9, 0, 0)], 1: [(9, 0, 1)]}, ["/World/Odd/Leaf"], [0, 0])
    add_mesh(stage, "/World/Odd/Leaf", FALLING)


def add_broken_binding(stage):
    UsdSkel.Root.Define(stage, "/World/Odd")
    skeleton = UsdSkel.Skeleton.Define(stage, "/World/Odd/Skeleton")
    skeleton.CreateJointsAttr(["root"])
    skeleton.CreateBindTransformsAttr([Gf.Matrix4d(1)])
    skeleton.CreateRestTransformsAttr([Gf.Matrix4d(1)])
    mesh = add_mesh(stage, "/World/Odd/Mesh", moved(FALLING, (9, 0, 0)))
    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    binding.CreateJointIndicesPrimvar(False, 1).Set([0, 7, 0])
    binding.CreateJointWeightsPrimvar(False, 1).Set([1, 1, 1])


def add_broken_clip(stage):
    folder = save(stage).rsplit("/", 1)[0]
    with open(f"{folder}/clip.usda", "w") as file:
        file.write("truncated")
    manifest = new_stage(f"{folder}/manifest.usda")
    UsdGeom.Mesh(manifest.OverridePrim("/World/Odd")).CreatePointsAttr()
    save(manifest)
    prim = add_mesh(stage, "/World/Odd", FALLING).GetPrim()
    prim.RemoveProperty("points")
    api = Usd.ClipsAPI(prim)
    api.SetClipAssetPaths(["./clip.usda"])
    api.SetClipPrimPath("/World/Odd")
    api.SetClipManifestAssetPath("./manifest.usda")
    api.SetClipActive([(0, 0)])
    api.SetClipTimes([(0, 0), (1, 1)])


def add_missing_clips(stage):
    api = Usd.ClipsAPI(UsdGeom.Mesh.Define(stage, "/World/Odd").GetPrim())
    api.SetClipAssetPaths(["./gone.usda"])
    api.SetClipPrimPath("/World/Odd")
    api.SetClipActive([(0, 0)])
    api.SetClipTimes([(0, 0), (1, 1)])


def add_clips_without_faces(stage):
    clip = new_stage(f"{save(stage).rsplit('/', 1)[0]}/clip.usda")
    UsdGeom.Mesh(clip.OverridePrim("/World/Odd")).CreatePointsAttr().Set(FALLING, 0)
    save(clip)
    add_missing_clips(stage)
    Usd.ClipsAPI(stage.GetPrimAtPath("/World/Odd")).SetClipAssetPaths(["./clip.usda"])


def add_mesh_without_points(stage):
    add_mesh(stage, "/World/Odd", FALLING).GetPrim().RemoveProperty("points")


BROKEN = {
    add_mesh_without_points: "/World/Odd: the mesh has no points at time 0",
    add_mesh_with_a_broken_face: "/World/Odd: face 0 refers to vertex 7, but the mesh has 3 points",
    add_points_of_another_type: "/World/Odd: attribute points holds float, not point3f[]",
    add_faces_of_another_type: "/World/Odd: faceVertexCounts is not a list of integers",
    add_missing_reference: "gone.usda",
    add_missing_clips: "/World/Odd: value clips default: 1 of 1 files cannot be opened; the first is ./gone.usda",
    add_clips_without_faces: "/World/Odd: its value clips have no faces, edges or points",
    add_instancer_without_prototype: "/World/Odd: instance 0 is of prototype 0, which does not exist",
    add_instancer_of_itself: "/World/Odd: the point instancer contains itself",
    add_instancer_whose_arrays_do_not_fit: "/World/Odd[1]/Leaf: its instancer has no valid transform for it at time 0",
    add_broken_binding: "/World/Odd/Mesh: the binding to /World/Odd/Skeleton is broken",
    add_broken_clip: "clip.usda> is not a valid usda layer",
}


@pytest.mark.parametrize(("add", "reason"), BROKEN.items(), ids=lambda value: getattr(value, "__name__", ""))
def test_what_is_broken_is_left_out(stage, capfd, add, reason):
    add(stage)
    found = find(stage, status=4)
    assert hits(found) == [HIT]
    assert [reason in sentence for sentence in found["left_out"]] == [True]
    assert f"left out: {found['left_out'][0]}" in found["warnings"]
    output = capfd.readouterr()
    text = " ".join(output.out.split())
    assert f"note: left out: {found['left_out'][0]}" in text
    assert "Not checked: 1 part that cannot be read, named as left out." in text


@pytest.mark.parametrize(("add", "reason"), BROKEN.items(), ids=lambda value: getattr(value, "__name__", ""))
def test_nothing_is_left_out_that_must_not_be(stage, capfd, tmp_path, add, reason):
    add(stage)
    path = save(stage)
    capfd.readouterr()
    assert main(["replay", path, "--device", "cpu", "--strict", "--json", str(tmp_path / "hits.json")]) == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith(f"warp-bsc: error: {path}: ") and reason in line


def add_material_library(stage):
    """As of an asset whose look is another file, in any format; only a material is below it."""
    UsdShade.Material.Define(stage, "/World/Odd").GetPrim().GetReferences().AddReference("./gone.usda")


def add_textures(stage):
    shader = UsdShade.Shader.Define(stage, "/World/Looks/Odd/Texture")
    shader.CreateInput("file", Sdf.ValueTypeNames.Asset).Set("./gone.png")
    stage.DefinePrim("/World/Odd").GetReferences().AddReference("./gone.PNG")


def add_package_of_materials(stage):
    stage.DefinePrim("/World/Odd").GetPayloads().AddPayload("./gone.usdz[looks/skin.mtlx]")


EMPTY = "prims without faces, edges or points hold nothing to check: 1, the first is /World/Odd"
NOTED = {
    add_bare_mesh: EMPTY,
    add_mesh_without_faces: EMPTY,
    add_material: "missing: Could not open asset",
    add_material_library: "missing: Could not open asset",
    add_textures: "missing: Could not open asset",
    add_package_of_materials: "missing: Could not open asset",
}


@pytest.mark.parametrize(("add", "note"), NOTED.items(), ids=lambda value: getattr(value, "__name__", ""))
def test_what_holds_no_geometry_is_noted(stage, capfd, add, note):
    add(stage)
    found = find(stage, "--strict")
    assert hits(found) == [HIT] and found["left_out"] == []
    assert [warning for warning in found["warnings"] if warning.startswith(note)]
    assert f"note: {note}" in " ".join(capfd.readouterr().out.split())


@pytest.mark.parametrize(
    ("pattern", "allowed"),
    [
        ("*.usda", True),
        ("*", True),
        ("gone.usda", True),
        ("./props/gone.usda", True),
        ("props", False),
        ("props/*", True),
        ("one.usda", False),
        ("/World/Odd", True),
        ("/World", True),
        ("/World/Od", False),
        ("/World/O*", True),
        ("*.usdc", False),
    ],
)
def test_what_may_be_missing(stage, pattern, allowed):
    stage.DefinePrim("/World/Odd/Prop").GetReferences().AddReference("./props/gone.usda")
    found = find(stage, "--allow-missing", pattern, status=0 if allowed else 4)
    assert hits(found) == [HIT] and found["options"]["allow_missing"] == [pattern]
    assert [len(found["left_out"]), sum("gone.usda" in text for text in found["warnings"])] == [not allowed, 1]


def test_several_may_be_missing(stage):
    add_instancer_without_prototype(stage)
    stage.DefinePrim("/World/Part").GetReferences().AddInternalReference("/World/Nowhere")
    stage.GetRootLayer().subLayerPaths.append("gone.usdc")
    path = save(stage)
    assert len(Scene(path).left_out) == 3
    scene = Scene(path, strict=True, allow_missing=["/World/Odd", "/World/Part", "gone.*"])
    assert scene.left_out == [] and sum(text.startswith("missing: ") for text in scene.warnings) == 3
    with pytest.raises(TypeError, match="allow_missing must be a tuple of strings"):
        Scene(path, allow_missing="gone.*")


def test_collisions_come_before_what_is_left_out(stage):
    add_mesh_with_a_broken_face(stage)
    assert main(["replay", save(stage), "--device", "cpu", "--fail-on", "collisions"]) == 1


def test_what_is_not_selected_need_not_be_whole(stage):
    add_mesh_with_a_broken_face(stage)
    assert find(stage, "--exclude", "/World/Odd", "--strict")["left_out"] == []
    assert find(stage, "--prims", "/World/F*", "--strict")["left_out"] == []


def test_many_are_counted(stage):
    for number in range(30):
        add_mesh(stage, f"/World/Odd{number}", FALLING, [3], [0, 1, 7])
    found = find(stage, status=4)
    assert len(found["left_out"]) == 30
    named = [warning for warning in found["warnings"] if warning.startswith("left out: ")]
    assert len(named) == 6 and named[-1] == "left out: 25 more, 30 in all"


def test_nothing_readable_is_an_error_with_a_status_of_its_own(tmp_path, capsys):
    stage = new_stage(tmp_path / "scene.usda")
    add_bare_mesh(stage)
    assert main(["replay", save(stage), "--device", "cpu"]) == 5
    (line,) = capsys.readouterr().err.splitlines()
    assert line.endswith(f"no visible mesh in the scene, or none is selected; {EMPTY}")


def test_obstacles_are_checked_at_rest_if_all_that_moves_is_left_out(tmp_path):
    stage = floor_stage(tmp_path)
    add_mesh(stage, "/World/Post", moved(FALLING, (0, 0, -0.25)))
    add_mesh(stage, "/World/Odd", {time: [(0, 0, time)] for time in (0, 1)}, [3])
    found = find(stage, status=4)
    (sentence,) = found["left_out"]
    assert sentence.startswith("/World/Odd: faceVertexCounts add up to 3")
    (span,) = found["intersections"]
    assert (span["meshes"], span["since"], span["until"]) == (["/World/Floor", "/World/Post"], 0, 1)


# --- What breaks for some time ---


def add_long_fall(stage):
    """Falls through the floor from time 0 to 1, and from time 4 to 5 again."""
    heights = [0.25, -0.25, 3, 2, 0.25, -0.25]
    return add_mesh(stage, "/World/Falling", {time: moved(FALLING, (0, 0, z)) for time, z in enumerate(heights)})


def add_breaking(stage, points=None):
    """As FALLING from time 0 to 1, beside it; then it breaks."""
    heights = [0.25, -0.25, -0.26, -0.27, -0.28, -0.29]
    beside = {time: moved(FALLING, (-1, 0.1, z)) for time, z in enumerate(heights)}
    return add_mesh(stage, "/World/Breaking", beside | (points or {}))


def break_points(stage):
    add_breaking(stage, {3: [(0, 0, 0), (1, 0, 0), (0, np.nan, 0)]})
    return "from time 2 to 4", "vertex 2 is not finite at time 3"


def block_points(stage):
    add_breaking(stage, {3: Sdf.ValueBlock()})
    return "from time 2 to 4", "the mesh has no points at time 3"


def block_topology(stage):
    counts = add_breaking(stage).GetFaceVertexCountsAttr()
    for time, value in ((0, [3]), (3, Sdf.ValueBlock()), (4, [3])):
        counts.Set(value, time)
    return "from time 3 to 4", "the mesh has no faces"


def break_number_of_points(stage):
    add_breaking(stage, {3: FALLING[:2]})
    return "from time 2 to 4", "2 points at time 3, but 3 at first"


def break_topology(stage):
    indices = add_breaking(stage).GetFaceVertexIndicesAttr()
    for time, corners in ((0, [0, 1, 2]), (3, [0, 1, 9])):
        indices.Set(corners, time)
    return "from time 3 on", "face 0 refers to vertex 9"


def break_a_welded_mesh(stage):
    add_breaking(stage, {3: [(0, 0, 0), (1, 0, 0), (0, np.nan, 0)]})
    shared = stage.GetPrimAtPath("/World/Breaking").GetAttribute("points").Get(0)[1]
    add_mesh(stage, "/World/Seam", [tuple(shared), (-5, 5, 5), (-5, 6, 5)])
    return "from time 2 to 4", "vertex 2 is not finite at time 3"


BREAKS = [
    break_points, block_points, block_topology, break_number_of_points, break_topology, break_a_welded_mesh,
]  # fmt: skip


@pytest.mark.parametrize("breaks", BREAKS)
def test_what_breaks_is_left_out_as_long_as_it_is_broken(tmp_path, capsys, breaks):
    stage = floor_stage(tmp_path)
    add_long_fall(stage)
    when, reason = breaks(stage)
    found = find(stage, status=4)
    assert [interval["start"] for interval in found["intervals"]] == [0, 1, 2, 3, 4]
    assert {"/World/Falling", "/World/Breaking"} <= {hit[0] for hit in hits(found, 0)}
    assert hits(found, 4)[0] == (*HIT[:4], 4.5, HIT[5])
    (sentence,) = found["left_out"]
    assert sentence.startswith(f"{when}: /World/Breaking: ") and reason in sentence
    assert not any("changes its topology" in warning for warning in found["warnings"]) or breaks is break_topology
    capsys.readouterr()
    assert main(["replay", save(stage), "--device", "cpu", "--strict"]) == 2
    assert reason in capsys.readouterr().err.splitlines()[-1]


def test_what_breaks_for_some_time_is_checked_before_and_after(tmp_path):
    stage = floor_stage(tmp_path)
    add_long_fall(stage)
    add_mesh(stage, "/World/Sheet", {0: moved(FALLING, (0, 0, -2)), 5: moved(FALLING, (0, 0, -1.5))})
    add_breaking(stage, {3: [(0, 0, 0), (np.inf, 0, 0), (0, 0, 0)]})
    scene = Scene(save(stage))
    intervals = [scene.interval(index) for index in range(5)]
    names = [[mesh.name for mesh in interval.segment.meshes] for interval in intervals]
    assert ["/World/Breaking" in present for present in names] == [True, True, False, False, True]
    assert all({"/World/Floor", "/World/Falling", "/World/Sheet"} <= set(present) for present in names)
    (warning,) = intervals[2].warnings
    assert warning.startswith("left out: from time 2 to 4: /World/Breaking: ")
    assert all(not interval.warnings for interval in intervals if interval.index != 2)


@pytest.mark.parametrize("beside", [False, True])
@pytest.mark.parametrize("blocked", [{3: Sdf.ValueBlock()}, {3: Sdf.ValueBlock(), 4: Sdf.ValueBlock()}])
def test_a_mesh_is_there_again_when_it_has_points_again(tmp_path, beside, blocked):
    stage = floor_stage(tmp_path)
    heights = [3, 2, 2, 2, 0.5, 0.25, -0.25]
    add_mesh(stage, "/World/Falling", {t: moved(FALLING, (0, 0, z)) for t, z in enumerate(heights)} | blocked)
    if beside:
        add_mesh(stage, "/World/Beside", {0: moved(FALLING, (9, 0, 0)), 6: moved(FALLING, (9, 0, 1))})
    found = find(stage, status=4)
    assert [interval["start"] for interval in found["intervals"]] == list(range(6)) and found["complete"]
    assert hits(found) == [(*HIT[:4], 5.5, HIT[5])]
    end = max(blocked) + 1
    assert found["left_out"] == [f"from time 2 to {end}: /World/Falling: the mesh has no points at time 3"]


def test_a_mesh_that_breaks_again_is_left_out_again(tmp_path):
    stage = floor_stage(tmp_path)
    blocked = {time: Sdf.ValueBlock() for time in (0, 3, 5)}
    heights = [0.25, -0.25, -0.5, -0.75, -1, -1.25, -1.5]
    add_mesh(stage, "/World/Falling", {t: moved(FALLING, (0, 0, z)) for t, z in enumerate(heights, 1)} | blocked)
    found = find(stage, status=4)
    assert hits(found)[0] == (*HIT[:4], 1.5, HIT[5])
    sentences = [("0 to 1", 0), ("2 to 4", 3), ("4 to 6", 5)]
    assert found["left_out"] == [
        f"from time {when}: /World/Falling: the mesh has no points at time {time}" for when, time in sentences
    ]


@pytest.mark.slow
def test_workers_leave_out_the_same(tmp_path):
    stage = floor_stage(tmp_path)
    add_long_fall(stage)
    add_breaking(stage, {1: Sdf.ValueBlock(), 3: Sdf.ValueBlock()})
    alone = find(stage, status=4)
    assert len(alone["left_out"]) == 2
    together = find(stage, "--workers", "2", status=4)
    assert [together[key] for key in ("intervals", "left_out")] == [alone[key] for key in ("intervals", "left_out")]


def all_files(folder):
    names = {"csv": "csv", "npz": "npz", "report": "html", "overlay": "usda"}
    return [word for option, end in names.items() for word in (f"--{option}", str(folder / f"hits.{end}"))]


def test_all_files_tell_the_same_of_what_is_left_out(stage, tmp_path, capfd):
    add_mesh(stage, "/World/Odd", {0: FALLING, 1: Sdf.ValueBlock()})
    found = find(stage, *all_files(tmp_path), status=4)
    (reason,) = found["left_out"]
    said = "Not checked: 1 part that cannot be read, named as left out."
    assert said in capfd.readouterr().out and reason == "/World/Odd: the mesh has no points at time 1"
    assert (tmp_path / "hits.csv").read_text().splitlines()[-1] == f"# left out: {reason}"
    assert json.loads(str(np.load(tmp_path / "hits.npz")["facts"]))["left_out"] == [reason]
    data = Page((tmp_path / "hits.html").read_text()).data
    assert data["partial"] == said and f"left out: {reason}" in data["notes"] and not data["is_whole"]
    layer = Sdf.Layer.FindOrOpen(str(tmp_path / "hits.usda"))
    assert list(layer.customLayerData["collisions"]["leftOut"]) == [reason] and said in layer.documentation


def test_a_scene_without_anything_that_can_be_read(tmp_path, capfd):
    stage = new_stage(tmp_path / "scene.usda")
    add_mesh(stage, "/World/Odd", {0: FALLING, 1: Sdf.ValueBlock(), 2: FALLING, 3: moved(FALLING, (0, 0, 1))})
    found = find(stage, *all_files(tmp_path), "--clearance", "0.1", status=4)
    assert [interval["start"] for interval in found["intervals"]] == [0, 1, 2] and found["hits"] == 0
    add_mesh_with_a_broken_face(stage)
    stage.GetPrimAtPath("/World/Odd").GetAttribute("points").Clear()
    found = find(stage, *all_files(tmp_path), status=4)
    assert len(found["intervals"]) == 1 and found["meshes"] == []
    assert "No edge meets a face at rest" in capfd.readouterr().out


# --- Where files are ---


def test_files_are_found_by_the_resolver(stage, tmp_path, monkeypatch):
    save(stage)
    monkeypatch.chdir(tmp_path.parent)
    Ar.DefaultResolver.SetDefaultSearchPath([str(tmp_path)])
    try:
        assert len(Scene("scene.usda").times) == 2
    finally:
        Ar.DefaultResolver.SetDefaultSearchPath([])
    with pytest.raises(FileNotFoundError, match=r"^scene\.usda: no such file$"):
        Scene("scene.usda")


def test_a_file_inside_a_package(stage, tmp_path):
    package = tmp_path / "scene.usdz"
    assert UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(save(stage)), str(package))
    assert len(Scene(f"{package}[scene.usda]").times) == 2
    with pytest.raises(FileNotFoundError, match="no such file"):
        Scene(f"{package}[other.usda]")


def test_metres_per_unit_in_single_precision(tmp_path):
    """Old exporters wrote them so, and OpenUSD takes nothing but double precision."""
    stage = new_stage(tmp_path / "scene.usda", meters_per_unit=0.5)
    add_floor(stage)
    add_falling(stage)
    path = tmp_path / "scene.usdc"
    assert stage.GetRootLayer().Export(str(path))
    crate, half = path.read_bytes(), b"\x00\x00\x00\x3f\x00\x00"  # 0.5; its type follows, 9 is double and 8 is float
    assert crate.count(half + b"\x09") == 1
    path.write_bytes(crate.replace(half + b"\x09", half + b"\x08"))
    with pytest.raises(RuntimeError):
        UsdGeom.GetStageMetersPerUnit(Usd.Stage.Open(str(path)))
    found = find(path, "--overlay", str(tmp_path / "overlay.usda"))
    assert hits(found) == [HIT] and found["meters_per_unit"] == 0.5
    assert UsdGeom.GetStageMetersPerUnit(Usd.Stage.Open(str(tmp_path / "overlay.usda"))) == 0.5


# --- Damaged files ---


def write_model(path):
    """A scene with all that can be damaged: a skeleton, blend shapes, an instancer, a spline, polygons, holes."""
    stage = new_stage(path)
    add_floor(stage)
    add_falling(stage)
    animated = add_mesh(stage, "/World/Group/Turned", [*FALLING, (0.9, -0.9, 1.0)], [3, 3], [0, 1, 2, 1, 3, 2])
    animated.CreateHoleIndicesAttr([1])
    turn = UsdGeom.Xformable(stage.GetPrimAtPath("/World/Group/Turned")).AddRotateZOp()
    for time in (0, 2):
        turn.Set(45.0 * time, time)
    add_instancer(
        stage, "/World/Leaves", {0: [(5, 0, 0), (6, 0, 0)], 2: [(5, 0, 1), (6, 0, 1)]}, ["/World/Leaves/Leaf"]
    )
    add_mesh(stage, "/World/Leaves/Leaf", FALLING)
    UsdSkel.Root.Define(stage, "/World/Model")
    skeleton = UsdSkel.Skeleton.Define(stage, "/World/Model/Skeleton")
    skeleton.CreateJointsAttr(["root"])
    skeleton.CreateBindTransformsAttr([Gf.Matrix4d(1)])
    skeleton.CreateRestTransformsAttr([Gf.Matrix4d(1)])
    animation = UsdSkel.Animation.Define(stage, "/World/Model/Animation")
    animation.CreateJointsAttr(["root"])
    animation.CreateRotationsAttr([Gf.Quatf(1)])
    animation.CreateScalesAttr([Gf.Vec3h(1)])
    animation.CreateBlendShapesAttr(["down"])
    for time in (0, 2):
        animation.CreateTranslationsAttr().Set([(0, 0, -time)], time)
        animation.CreateBlendShapeWeightsAttr().Set([time / 2], time)
    UsdSkel.BindingAPI.Apply(skeleton.GetPrim()).CreateAnimationSourceRel().SetTargets([animation.GetPath()])
    mesh = add_mesh(stage, "/World/Model/Mesh", moved(FALLING, (-6, 0, 0)))
    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    binding.CreateJointIndicesPrimvar(False, 1).Set([0, 0, 0])
    binding.CreateJointWeightsPrimvar(False, 1).Set([1, 1, 1])
    shape = UsdSkel.BlendShape.Define(stage, "/World/Model/Mesh/Down")
    shape.CreateOffsetsAttr([(0, 0, -1)])
    shape.CreatePointIndicesAttr([1])
    binding.CreateBlendShapesAttr(["down"])
    binding.CreateBlendShapeTargetsRel().SetTargets([shape.GetPath()])
    return save(stage)


def damage(layer, lots):
    """Damage a layer in one of many ways, and say how."""
    specs = []
    layer.Traverse("/", specs.append)
    paths = [path for path in specs if path.IsPropertyPath()]
    prims = [path for path in specs if path.IsPrimPath()]
    path = lots.choice(paths)
    spec = layer.GetObjectAtPath(path)
    kind = lots.choice(["remove", "type", "length", "nan", "huge", "negative", "prim", "reference", "times"])
    is_attribute = isinstance(spec, Sdf.AttributeSpec)
    samples = layer.ListTimeSamplesForPath(path) if is_attribute else []
    time = lots.choice(samples) if samples else None
    value = None
    if is_attribute:
        value = layer.QueryTimeSample(path, time) if samples else spec.default
    if kind == "prim":
        path = lots.choice(prims)
        layer.GetPrimAtPath(path).typeName = lots.choice(["Mesh", "PointInstancer", "SkelRoot", "Skeleton", "Sphere"])
    elif kind == "reference":
        path = lots.choice(prims)
        target = lots.choice([Sdf.Path("/World"), path, Sdf.Path("/Gone"), Sdf.Path("/World/Leaves")])
        layer.GetPrimAtPath(path).referenceList.Prepend(Sdf.Reference("", target))
    elif kind == "times" and is_attribute and value is not None:
        for number in (lots.choice([-1e300, -1e9, -np.inf]), lots.choice([1.0000001, 1e9, 1e300, np.inf])):
            layer.SetTimeSample(path, number, value)
    elif kind == "type" and is_attribute:
        owner, name = spec.owner, spec.name
        owner.RemoveProperty(spec)
        types = Sdf.ValueTypeNames
        kinds = {types.Float: 3.0, types.String: "x", types.IntArray: [1, 2], types.Point3dArray: [(0, 0, 0)],
                 types.TokenArray: ["a"], types.FloatArray: [0.5]}  # fmt: skip
        chosen = lots.choice(list(kinds))
        Sdf.AttributeSpec(owner, name, chosen).default = kinds[chosen]
    elif value is not None and hasattr(value, "__len__") and not isinstance(value, str) and len(value):
        values = list(value)
        if kind == "length":
            values = lots.choice([values[:-1], values * 2, []])
        elif isinstance(values[0], int):
            values[lots.randrange(len(values))] = {"huge": 2**31 - 1, "nan": 10**6}.get(kind, -1)
        elif isinstance(values[0], float):
            values[lots.randrange(len(values))] = {"huge": 3e38, "nan": np.nan}.get(kind, -np.inf)
        elif kind in ("nan", "huge", "negative"):
            number = {"huge": 3e38, "nan": np.nan}.get(kind, -np.inf)
            values[lots.randrange(len(values))] = type(values[0])(number)
        value = type(value)(values)
        if samples:
            layer.SetTimeSample(path, time, value)
        else:
            spec.default = value
    else:
        kind = "remove"
        spec.owner.RemoveProperty(spec)
    return kind, path


@pytest.mark.parametrize("part", range(6))
def test_damaged_scenes_are_read_or_refused_in_one_line(tmp_path, part):
    """Of 150 damaged scenes each is read, what is left out being named, or ends in one line that names the file."""
    source = Sdf.Layer.FindOrOpen(write_model(tmp_path / "whole.usda"))
    lots = random.Random(part)
    counts = {"read": 0, "left out": 0, "refused": 0}
    for number in range(25):
        layer = Sdf.Layer.CreateAnonymous(".usda")
        layer.TransferContent(source)
        done = []
        for _ in range(lots.choice([1, 1, 2, 4])):
            try:
                done.append(damage(layer, lots))
            except (TypeError, ValueError, OverflowError, RuntimeError) as error:  # USD does not let us
                done.append(error)
        path = str(tmp_path / f"damaged{number}.{lots.choice(['usda', 'usdc'])}")
        assert layer.Export(path)
        if lots.random() < 0.2:
            with open(path, "r+b") as file:
                file.truncate(lots.randrange(file.seek(0, 2)))
        try:
            scene = Scene(path)
            for interval in islice(scene, 19):
                assert interval.start < interval.end or interval.end == scene.times[-1]
                positions = interval.x0, interval.x1
                assert all(np.isfinite(x).all() and len(x) == interval.segment.vertex_count for x in positions), done
            counts["left out" if scene.left_out else "read"] += 1
        except ValueError as error:
            assert path in str(error) and "\n" not in str(error), done
            counts["refused"] += 1
    assert counts["read"] and counts["left out"], counts
