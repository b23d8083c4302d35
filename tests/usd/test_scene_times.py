"""What a replay takes for the motion of a stage: its times, turns, splines, skeletons and value clips."""

import math
import random

import numpy as np
import pytest
from pxr import Gf, Ts, Usd, UsdGeom, UsdSkel
from usd_stages import (
    FALLING,
    HIT,
    add_falling,
    add_floor,
    add_instancer,
    add_mesh,
    animate,
    find,
    hits,
    moved,
    new_stage,
    save,
)

from warp_bsc.cli.main import main
from warp_bsc.usd.scene import Scene


@pytest.fixture
def stage(tmp_path):
    return new_stage(tmp_path / "scene.usda")


def starts(found):
    return [interval["start"] for interval in found["intervals"]]


# --- Skeletons of instances ---


def write_character(path, *, own_animation):
    """A tube whose upper half a joint bends, and its animation if it has one of its own."""
    stage = new_stage(path)
    root = UsdSkel.Root.Define(stage, "/Character")
    stage.SetDefaultPrim(root.GetPrim())
    skeleton = UsdSkel.Skeleton.Define(stage, "/Character/Skeleton")
    skeleton.CreateJointsAttr(["a", "a/b"])
    up = Gf.Matrix4d().SetTranslate((0, 0, 1))
    skeleton.CreateBindTransformsAttr([Gf.Matrix4d(1), up])
    skeleton.CreateRestTransformsAttr([Gf.Matrix4d(1), up])
    if own_animation:
        bind_animation(stage, "/Character/Animation", skeleton.GetPrim(), 50)
    sides, rings = 6, 4
    angles = [2 * math.pi * side / sides for side in range(sides)]
    points = [(0.3 * math.cos(a), 0.3 * math.sin(a), 2 * ring / (rings - 1)) for ring in range(rings) for a in angles]
    quads = [
        corner
        for ring in range(0, sides * (rings - 1), sides)
        for side in range(sides)
        for corner in (
            ring + side,
            ring + (side + 1) % sides,
            ring + sides + (side + 1) % sides,
            ring + sides + side,
        )
    ]
    mesh = add_mesh(stage, "/Character/Mesh", points, [4] * (len(quads) // 4), quads)
    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    binding.CreateJointIndicesPrimvar(False, 2).Set([0, 1] * len(points))
    weights = [(1 - w, w) for *_, z in points for w in [min(max(z - 0.5, 0), 1)]]
    binding.CreateJointWeightsPrimvar(False, 2).Set([weight for pair in weights for weight in pair])
    save(stage)


def bind_animation(stage, path, prim, most):
    """Bends joint b to one side by an angle at time 4, and to the other at time 8."""
    animation = UsdSkel.Animation.Define(stage, path)
    animation.CreateJointsAttr(["a/b"])
    animation.CreateTranslationsAttr([(0, 0, 1)])
    animation.CreateScalesAttr([Gf.Vec3h(1)])
    for time, angle in ((0, 0), (4, most), (8, -most)):
        quaternion = Gf.Rotation((1, 0, 0), angle).GetQuat()
        animation.CreateRotationsAttr().Set([Gf.Quatf(quaternion)], time)
    UsdSkel.BindingAPI.Apply(prim).CreateAnimationSourceRel().SetTargets([animation.GetPath()])


@pytest.mark.parametrize("own_animation", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_a_crowd_of_instances_is_the_same_crowd_without(tmp_path, own_animation):
    write_character(tmp_path / "character.usda", own_animation=own_animation)
    found = []
    for instanceable in (False, True):
        stage = new_stage(tmp_path / f"crowd_{instanceable}.usda")
        lots = random.Random(1)
        for number in range(12):
            prim = stage.DefinePrim(f"/World/Person{number}")
            prim.GetReferences().AddReference("./character.usda")
            prim.SetInstanceable(instanceable)
            place = UsdGeom.Xformable(prim)
            place.AddTranslateOp().Set((number % 5 + lots.uniform(-0.1, 0.1), number // 5 + lots.uniform(-0.1, 0.1), 0))
            place.AddRotateZOp().Set(lots.uniform(0, 360))
            if not own_animation:
                bind_animation(stage, f"/World/Animation{number}", prim, lots.uniform(30, 70))
        found.append(find(stage))
    assert len(found[0]["mesh_pairs"]) > 5
    for key in ("start", "contacts"):
        assert [interval[key] for interval in found[0]["intervals"]] == [i[key] for i in found[1]["intervals"]]


# --- Blend shapes ---


def add_face(stage, weights):
    """FALLING, a quarter above the floor; a weight of a half lowers it by 1, one of 1 not at all."""
    UsdSkel.Root.Define(stage, "/World/Model")
    skeleton = UsdSkel.Skeleton.Define(stage, "/World/Model/Skeleton")
    animation = UsdSkel.Animation.Define(stage, "/World/Model/Animation")
    animation.CreateBlendShapesAttr(["other", "dip"])
    for time, weight in weights.items():
        animation.CreateBlendShapeWeightsAttr().Set([0.5 * (time > 0), weight], time)
    UsdSkel.BindingAPI.Apply(skeleton.GetPrim()).CreateAnimationSourceRel().SetTargets([animation.GetPath()])
    mesh = add_mesh(stage, "/World/Model/Falling", moved(FALLING, (0, 0, 0.25)))
    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    targets = []
    for name in ("dip", "other"):
        shape = UsdSkel.BlendShape.Define(stage, f"/World/Model/Falling/{name}")
        shape.CreateOffsetsAttr([(0, 0, 0)] * 3)
        targets.append(shape.GetPath())
    between = UsdSkel.BlendShape(stage.GetPrimAtPath(targets[0])).CreateInbetween("half")
    between.SetWeight(0.5)
    between.SetOffsets([(0, 0, -1)] * 3)
    binding.CreateBlendShapesAttr(["dip", "other"])
    binding.CreateBlendShapeTargetsRel().SetTargets(targets)


@pytest.mark.parametrize(
    ("weights", "bends"),
    [
        ({0: 0.0, 1: 1.0}, [0.5]),
        ({0: 0.0, 4: 0.0, 5: 0.8, 6: 0.3}, [4.625, 5.6]),
        ({0: 0.0, 1: 0.5, 2: 0.0}, []),
        ({0: 0.6, 1: 0.9}, []),
    ],
)
def test_weights_that_pass_an_in_between_are_sampled_there(stage, weights, bends):
    add_floor(stage)
    add_face(stage, weights)
    found = find(stage)
    times = [*starts(found), found["intervals"][-1]["end"]]
    assert times == pytest.approx(sorted({*range(max(weights) + 1), *bends}))
    touched = sorted({round(contact["time"], 5) for interval in found["intervals"] for contact in interval["contacts"]
                      if contact["elements"] == ["vertex 0", "face 0"]})  # fmt: skip
    weight = np.interp(np.linspace(0, times[-1], 100_001), list(weights), list(weights.values()))
    height = 0.25 - np.interp(weight, [0, 0.5, 1], [0, 1, 0])
    (passed,) = np.nonzero(np.diff(height > 0))
    assert touched == pytest.approx((passed + 0.5) * times[-1] / 100_000, abs=2e-4)


# --- Splines ---


def add_spline(operation, *knots, post=None):
    """Knots: time, value and the slope on both sides."""
    spline = Ts.Spline("double")
    for time, value, slope in knots:
        knot = Ts.Knot("double")
        knot.SetTime(time)
        knot.SetValue(value)
        knot.SetNextInterpolation(Ts.InterpCurve)
        for side in ("Pre", "Post"):
            getattr(knot, f"Set{side}TanWidth")(1 / 3)
            getattr(knot, f"Set{side}TanSlope")(slope if side == "Post" else -slope)
        spline.SetKnot(knot)
    if post:
        spline.SetPostExtrapolation(Ts.Extrapolation(post))
    assert operation.GetAttr().SetSpline(spline)


@pytest.mark.parametrize("beside", [True, False])
def test_a_spline_whose_knots_have_equal_values_moves(stage, beside):
    add_floor(stage)
    mesh = add_mesh(stage, "/World/Falling", moved(FALLING, (0, 0, 0.25)))
    add_spline(mesh.AddTranslateZOp(), (1, 0, -4), (2, 0, -4))
    if beside:
        add_mesh(stage, "/World/Beside", {1: moved(FALLING, (9, 0, 0)), 2: moved(FALLING, (9, 0, 1))})
    found = [hit for hit in hits(find(stage)) if hit[1] == "vertex 0"]
    # 4 t (1 - t) = 0.25, down and up again
    assert [hit[:4] for hit in found] == [HIT[:4]] * 2
    times = [(1 - math.sqrt(0.75)) / 2, (1 + math.sqrt(0.75)) / 2]
    np.testing.assert_allclose([hit[4].expected for hit in found], np.add(1, times), atol=0.01)


def test_splines_are_straight_from_time_to_time_but_for_a_hundredth(stage):
    operation = add_mesh(stage, "/World/Mesh", FALLING).AddTranslateZOp()
    add_spline(operation, (0, 0, 5), (3, 2, -1), (3.5, -4, 9), (20, 0, 0.2))
    scene = Scene(save(stage))
    assert {0, 3, 3.5, 20} < set(scene.times) and len(scene.times) < 100
    times = np.linspace(0, 20, 3001)
    true = [operation.GetAttr().Get(time) for time in times]
    straight = np.interp(times, scene.times, [operation.GetAttr().Get(time) for time in scene.times])
    assert np.abs(straight - true).max() < 0.015 * np.ptp(true)


def test_splines_go_on_after_their_last_knot(stage):
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(3)
    add_floor(stage)
    mesh = add_mesh(stage, "/World/Falling", moved(FALLING, (0, 0, 0.25)))
    add_spline(mesh.AddTranslateZOp(), (0, 0, -4), (1, 0, -4), post=Ts.ExtrapLoopRepeat)
    found = find(stage)
    assert found["intervals"][-1]["end"] == 3
    assert len([hit for hit in hits(found) if hit[1] == "vertex 0"]) == 6


# --- Value clips ---


def add_clips(stage, clips, active, times):
    """A floor and what falls onto it, of which clips have the heights by time."""
    folder = save(stage).rsplit("/", 1)[0]
    for name, heights in {**clips, "manifest": {}}.items():
        clip = new_stage(f"{folder}/{name}.usda")
        points = UsdGeom.Mesh(clip.OverridePrim("/World/Falling")).CreatePointsAttr()
        for time, height in heights.items():
            points.Set(moved(FALLING, (0, 0, height)), time)
        save(clip)
    add_floor(stage)
    mesh = add_mesh(stage, "/World/Falling", FALLING)
    mesh.GetPrim().RemoveProperty("points")
    api = Usd.ClipsAPI(stage.GetPrimAtPath("/World"))
    api.SetClipAssetPaths([f"./{name}.usda" for name in clips])
    api.SetClipPrimPath("/World")
    api.SetClipManifestAssetPath("./manifest.usda")
    api.SetClipActive(active)
    api.SetClipTimes(times)


def test_the_jump_from_one_clip_to_the_next_is_no_motion(stage):
    add_clips(stage, {"one": {0: 6, 1: 1}, "two": {0: -1, 1: -3}}, [(10, 0), (11, 1)],
              [(10, 0), (11, 1), (11, 0), (12, 1)])  # fmt: skip
    found = find(stage)
    assert starts(found) == [10, 11] and hits(found) == []
    assert "/World/Falling jumps at time 11: what it jumps through is not checked" in found["warnings"]


def test_a_clip_that_loops_jumps_back(stage):
    add_clips(stage, {"walk": {0: 0.25, 1: -0.25}}, [(0, 0)], [(0, 0), (1, 1), (1, 0), (2, 1)])
    found = find(stage)
    assert starts(found) == [0, 1]
    assert hits(found) == [HIT, (*HIT[:4], 1.5, HIT[5])]
    assert any("jumps at time 1:" in warning for warning in found["warnings"])


def test_a_clip_that_goes_on_where_the_last_one_ended_keeps_its_motion(stage):
    add_clips(stage, {"one": {0: 0.5, 1: 0.25}, "two": {1: 0.25, 2: -0.25}}, [(0, 0), (1, 1)], [(0, 0), (2, 2)])
    found = find(stage)
    assert starts(found) == [0, 1]
    assert hits(found) == [(*HIT[:4], 1.5, HIT[5])]
    assert not any("jumps" in warning for warning in found["warnings"])


def test_clips_of_one_sample_each_move_from_one_to_the_next(stage):
    heights = [0.5, 0.25, -0.25, -0.4]
    clips = {f"frame{time}": {time: height} for time, height in enumerate(heights)}
    add_clips(stage, clips, [(time, time) for time in range(4)], [(0, 0), (3, 3)])
    found = find(stage)
    assert starts(found) == [0, 1, 2]
    assert hits(found) == [(*HIT[:4], 1.5, HIT[5])]


# --- Times that are almost one ---


def test_times_that_rounding_keeps_apart_are_one(stage):
    floor, apart = [(-2, -2, 0), (2, -2, 0), (2, 2, 0)], 5.2e-8
    add_mesh(stage, "/World/Floor", {time: moved(floor, (0, 0, time)) for time in (1, 2, 3)})
    heights = {1: 1.25, 2: 1.75, 3: 2.6}
    points = {time * (1 + apart): moved(FALLING, (0, 0, z)) for time, z in heights.items()}
    add_mesh(stage, "/World/Falling", points)
    found = find(stage)
    assert starts(found) == [1, 2]
    assert hits(found) == [(*HIT[:4], 1.5, (0.5, -0.5, 1.5))]
    assert found["warnings"] == []


def test_a_jump_between_times_that_are_one_ends_where_it_was_before(stage):
    add_floor(stage)
    heights = {0: 0.25, 1 - 1e-7: -0.25, 1: 5, 2: 4}
    add_mesh(stage, "/World/Falling", {time: moved(FALLING, (0, 0, z)) for time, z in heights.items()})
    found = find(stage)
    assert starts(found) == [0, 1]
    assert hits(found) == [HIT]
    assert any("/World/Falling jumps at time 1:" in warning for warning in found["warnings"])


def test_times_of_a_short_scene_stay_apart(stage):
    add_floor(stage)
    heights = {0: 0.5, 1e-7: 0.25, 2e-7: -0.25}
    add_mesh(stage, "/World/Falling", {time: moved(FALLING, (0, 0, z)) for time, z in heights.items()})
    assert starts(find(stage)) == [0, 1e-7]


# --- What only a transform moves ---


def turn(stage, path="/World/Prop"):
    """A group that turns and is carried."""
    group = animate(UsdGeom.Xform.Define(stage, path), (0, 0, 0), (0.1, 0.2, 0.3), (0.2, 0.4, 0.6))
    operation = UsdGeom.Xformable(stage.GetPrimAtPath(path)).AddRotateYOp()
    for time in range(3):
        operation.Set(10.0 * time, time)
    return group


FLAPS = {
    "T-junction": ([(0, 0, 0), (2, 0, 0), (0, 2, 0), (1, 0, 0), (0.5, -1, 0), (1.5, -1, 0)], [0, 1, 2, 3, 4, 5]),
    "coplanar": ([(0, 0, 0.1), (2, 0, 0.1), (0, 2, 0.1), (0.3, 0.3, 0.1), (2, 0.5, 0.1), (0.5, 2, 0.1)], range(6)),
}


@pytest.mark.parametrize("kind", FLAPS)
def test_a_mesh_that_only_its_transform_moves_does_not_collide_with_itself(stage, kind, capsys):
    turn(stage)
    points, indices = FLAPS[kind]
    add_mesh(stage, "/World/Prop/Mesh", points, [3, 3], list(indices))
    found = find(stage)
    assert found["hits"] == 0 and found["mesh_pairs"] == []
    assert found["validation"]["hits"] == 0 and found["validation"]["disagreements"] == []
    assert found["intervals"][0]["stages"]["vertex_face"]["candidates"] > 0
    capsys.readouterr()
    assert main(["replay", save(stage), "--device", "cpu", "--method", "conservative", "--fail-on", "collisions"]) == 0
    assert "No collision in 2 intervals." in capsys.readouterr().out


def test_a_mesh_that_grows_from_a_point_does_not_collide_with_itself(stage):
    add_floor(stage)
    group = UsdGeom.Xform.Define(stage, "/World/Group")
    group.AddTranslateOp().Set((0, 0, 3))
    scale = group.AddScaleOp()
    scale.Set((0, 0, 0), 0)
    scale.Set((1, 1, 1), 1)
    add_mesh(stage, "/World/Group/Mesh", [*FALLING, *moved(FALLING, (0, 0, 1))], [3, 3], list(range(6)))
    assert find(stage)["hits"] == 0


def test_meshes_that_one_transform_moves_are_checked_with_each_other(stage):
    animate(UsdGeom.Xform.Define(stage, "/World/Prop"), (0, 0, 0), (1, 0, 0))
    add_floor(stage, "/World/Prop/Floor")
    add_mesh(stage, "/World/Prop/Mesh", FALLING)
    assert hits(find(stage)) == [("/World/Prop/Mesh", "vertex 0", "/World/Prop/Floor", "face 0", 0, HIT[5])]


def test_a_mesh_whose_points_move_is_checked_with_itself(stage):
    points, indices = FLAPS["T-junction"]
    lower = [*points[:3], *moved(points[3:], (0, 0.1, -0.5))]
    add_mesh(stage, "/World/Mesh", {0: points[:3] + moved(points[3:], (0, 0.1, 0.5)), 1: lower}, [3, 3], indices)
    assert {tuple(pair["meshes"]) for pair in find(stage)["mesh_pairs"]} == {("/World/Mesh", "/World/Mesh")}


def test_a_vertex_that_is_welded_to_another_mesh_is_still_its_own_meshs(stage):
    turn(stage)
    # The tip of the second face of B stands on the first, where a corner of A is.
    tip = (1.0, 1.0, 0.0)
    add_mesh(stage, "/World/Prop/A", [tip, (1.5, 1.0, 2.0), (1.0, 1.5, 2.0)])
    add_mesh(
        stage,
        "/World/Prop/B",
        [(0, 0, 0), (4, 0, 0), (0, 4, 0), tip, (1.5, 1, -2), (1, 1.5, -2)],
        [3, 3],
        list(range(6)),
    )
    found = find(stage)
    assert "vertices with the same position at all times were welded: 1" in found["warnings"]
    assert hits(found) == []


def test_an_edge_that_is_welded_to_another_mesh_is_still_its_own_meshs(stage):
    turn(stage)
    # Faces of B cross in two edges, of which one is A's as well.
    edge = [(0.0, -1.0, 0.0), (0.0, 1.0, 0.0)]
    add_mesh(stage, "/World/Prop/A", [*edge, (0, 0, -5)])
    add_mesh(stage, "/World/Prop/B", [*edge, (0, 0, 5), (-1, 0, 0), (1, 0, 0), (0, 9, -1e-3)], [3, 3], list(range(6)))
    between = [hit for hit in hits(find(stage)) if {hit[1], hit[3]} == {"edge 0-1", "edge 3-4"}]
    assert between == []


# --- What turns ---


def add_propeller(stage, samples):
    """A blade that turns around z, and a pin that it strikes after a quarter of a turn."""
    add_mesh(stage, "/World/Pin", [(0, 1, -1), (0, 1.2, -1), (0, 1, 1)])
    blade = add_mesh(stage, "/World/Blade", [(0.2, 0, 0), (2, 0, 0.1), (2, 0, -0.1)])
    turn = blade.AddRotateZOp()
    for time, angle in samples.items():
        turn.Set(angle, time)
    return blade


def test_what_turns_is_sampled_at_every_whole_time_code(stage):
    add_propeller(stage, {0: 0, 24.5: 360})
    found = find(stage)
    assert starts(found) == list(range(25))
    (interval,) = (interval for interval in found["intervals"] if interval["hits"])
    assert interval["start"] <= 24.5 / 4 <= interval["end"]
    assert starts(find(stage, "--subdivide", "2"))[:4] == [0, 0.5, 1, 1.5]
    assert starts(find(stage, "--frames", "3.5:6")) == [3.5, 4, 5]
    assert starts(find(stage, "--frames", "::12")) == [0, 12]  # what the user asks for


def test_a_whole_turn_from_sample_to_sample_is_a_motion(stage):
    blade = add_propeller(stage, {})
    turn = UsdGeom.Xformable(blade).GetOrderedXformOps()[0]
    turn.Set(-180.0, 0)
    turn.Set(180.0, 8)
    transforms = [np.array(blade.GetLocalTransformation(time)) for time in (0, 8)]
    np.testing.assert_allclose(*transforms, atol=1e-12)
    assert find(stage)["hits"] > 0


def test_what_moves_straight_is_not_sampled_more(stage):
    add_floor(stage)
    animate(add_mesh(stage, "/World/Falling", FALLING), (0, 0, 0.25), (0, 0, -0.25), times=[0, 1000])
    assert starts(find(stage)) == [0]


def test_joints_are_sampled_at_every_whole_time_code(stage, tmp_path):
    write_character(tmp_path / "character.usda", own_animation=True)
    stage.DefinePrim("/World/Person").GetReferences().AddReference("./character.usda")
    assert starts(find(stage)) == list(range(8))


def test_a_turn_of_very_many_time_codes_is_refused(stage, capsys):
    add_propeller(stage, {0: 0, 1e9: 360})
    assert main(["replay", save(stage), "--device", "cpu"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("warp-bsc: error: --frames: ") and "/World/Blade turns from time 0 to 1e+09" in line
    assert starts(find(stage, "--frames", "::5e8")) == [0, 5e8]


@pytest.mark.parametrize("method", ["exact", "conservative", "float"])
def test_what_is_certified_is_said_with_what_it_is_about(stage, capsys, method, tmp_path):
    add_propeller(stage, {0: 0, 1: 360})
    page = tmp_path / "page.html"
    found = find(stage, "--method", method, "--report", str(page))
    assert found["certified_for"] == "vertices that move straight or turn about one axis between the times checked"
    assert "1 mesh is moved by transforms" in found["motion"]
    said = [
        line for line in capsys.readouterr().out.splitlines() if line.startswith(("Certified for", "Not certified"))
    ]
    assert len(said) == 1 and found["certified_for"] in said[0]
    assert f"certified for {found['certified_for']}" in page.read_text()


# --- Clocks, and names of instances ---


@pytest.mark.parametrize("rate", [0.0, -24.0, math.inf])
@pytest.mark.parametrize("above", [True, False])
def test_a_layer_without_a_clock_is_refused(stage, tmp_path, capsys, rate, above):
    add_floor(stage)
    add_falling(stage)
    if above:
        upper = Usd.Stage.CreateNew(str(tmp_path / "upper.usda"))
        upper.GetRootLayer().subLayerPaths = ["./scene.usda"]
    stage.SetTimeCodesPerSecond(rate)
    path = save(stage)
    assert main(["replay", save(upper) if above else path, "--device", "cpu"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"timeCodesPerSecond of {path} is {rate:g}" in line


@pytest.mark.parametrize(
    ("options", "meshes"),
    [
        (["--prims", "/World/Leaves[1]/Leaf", "/World/Floor"], ["/World/Floor", "/World/Leaves[1]/Leaf"]),
        (["--prims", "/World/Leaves[1]", "/World/Floor"], ["/World/Floor", "/World/Leaves[1]/Leaf"]),
        (["--exclude", "/World/Leaves[1]/*"], ["/World/Floor", "/World/Leaves[0]/Leaf"]),
        (["--prims", "/World/Leaves*"], ["/World/Leaves[0]/Leaf", "/World/Leaves[1]/Leaf"]),
        (["--exclude", "/World/[L]*"], ["/World/Floor"]),
    ],
)
def test_instances_are_selected_by_their_names(stage, options, meshes):
    add_floor(stage)
    positions = {0: [(-1, 0, 0.25), (0, 0, 0.25)], 1: [(-1, 0, -0.25), (0, 0, -0.25)]}
    add_instancer(stage, "/World/Leaves", positions, ["/World/Leaves/Leaf"])
    add_mesh(stage, "/World/Leaves/Leaf", FALLING)
    found = find(stage, *options)
    assert found["meshes"] == meshes


def test_pairs_are_chosen_by_the_names_of_instances(stage):
    add_floor(stage)
    positions = {0: [(-1, 0, 0.25), (0, 0, 0.25)], 1: [(-1, 0, -0.25), (0, 0, -0.25)]}
    add_instancer(stage, "/World/Leaves", positions, ["/World/Leaves/Leaf"])
    add_mesh(stage, "/World/Leaves/Leaf", FALLING)
    found = find(stage, "--between", "/World/Leaves[1]/Leaf", "/World/Floor")
    assert hits(found) == [("/World/Leaves[1]/Leaf", *HIT[1:])]
