"""Replays of stages with one feature of USD each, whose collisions are known beforehand."""

import numpy as np
import pytest
from pxr import Gf, Sdf, Ts, Usd, UsdGeom, UsdSkel, UsdUtils
from usd_stages import (
    FALLING,
    FLOOR,
    HIT,
    add_falling,
    add_floor,
    add_instancer,
    add_mesh,
    animate,
    falling,
    find,
    hits,
    moved,
    new_stage,
    save,
)


@pytest.fixture
def stage(tmp_path):
    return new_stage(tmp_path / "scene.usda")


def test_points(stage):
    add_floor(stage)
    add_falling(stage)
    found = find(stage)
    assert hits(found) == [HIT]
    contact = found["intervals"][0]["contacts"][0]
    assert contact["kind"] == "vertex-face"
    assert contact["prims"] == ["/World/Falling", "/World/Floor"]
    assert contact["indices"] == [[0], [0]]
    assert contact["toi"] == pytest.approx(0.5, abs=1e-6)
    assert contact["normal"] == pytest.approx([0, 0, 1])
    assert found["validation"]["hits"] == 1 and found["validation"]["disagreements"] == []
    assert found["complete"] and found["certified"]


def test_edges(stage):
    add_mesh(stage, "/World/Rest", [(-1, 0, 0), (1, 0, 0), (0, 0, -3)])
    add_mesh(stage, "/World/Falling", {4: [(0, -1, 1), (0, 1, 1), (0, 0, 3)], 6: [(0, -1, -1), (0, 1, -1), (0, 0, 1)]})
    found = find(stage)
    assert hits(found) == [("/World/Rest", "edge 0-1", "/World/Falling", "edge 0-1", 5, (0, 0, 0))]
    assert found["intervals"][0]["contacts"][0]["indices"] == [[0, 1], [0, 1]]


def test_diagonals_are_not_edges_of_the_mesh(stage):
    quad = [(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]
    add_mesh(stage, "/World/Quad", quad)
    edge = [(-0.5, 0.5, 1), (0.5, -0.5, 1), (0, 0, 9)]
    add_mesh(stage, "/World/Edge", {0: edge, 1: moved(edge, (0, 0, -2))})
    assert ("/World/Quad", "diagonal 0-2", "/World/Edge", "edge 0-1", 0.5, (0, 0, 0)) in hits(find(stage))


def test_nested_animated_transforms(stage):
    add_floor(stage)
    animate(UsdGeom.Xform.Define(stage, "/World/Group"), (1, 0, 1), (1, 0, 0.75))
    child = add_mesh(stage, "/World/Group/Falling", FALLING)
    animate(child, (-1, 0, -0.75), (-1, 0, -1))
    assert hits(find(stage)) == [("/World/Group/Falling", *HIT[1:])]


@pytest.mark.parametrize(("scale", "place"), [((-2, 1, 2), (-1, -0.5, 0)), ((2, -0.5, 0.5), (1, 0.25, 0))])
def test_mirrored_and_non_uniform_transforms(stage, scale, place):
    add_floor(stage)
    UsdGeom.Xform.Define(stage, "/World/Group").AddScaleOp().Set(Gf.Vec3f(scale))
    add_mesh(stage, "/World/Group/Falling", falling(0.25, -0.25))
    assert hits(find(stage)) == [("/World/Group/Falling", *HIT[1:5], place)]


@pytest.mark.parametrize("kind", ["references", "payloads"])
def test_references_and_payloads(stage, tmp_path, kind):
    asset = new_stage(tmp_path / "asset.usda")
    add_mesh(asset, "/World/Mesh", falling(0.25, -0.25))
    save(asset)
    add_floor(stage)
    prim = stage.DefinePrim("/World/Asset")
    # The asset's times are moved by ten and taken twice as fast.
    offset = Sdf.LayerOffset(10, 0.5)
    if kind == "references":
        prim.GetReferences().AddReference("./asset.usda", offset)
    else:
        prim.GetPayloads().AddPayload(Sdf.Payload("./asset.usda", layerOffset=offset))
    found = find(stage)
    assert [(interval["start"], interval["end"]) for interval in found["intervals"]] == [(10, 10.5)]
    assert hits(found) == [("/World/Asset/Mesh", *HIT[1:4], 10.25, HIT[5])]


@pytest.mark.parametrize("variant", ["through", "above"])
def test_variants(stage, variant):
    add_floor(stage)
    prim = stage.DefinePrim("/World/Group")
    variants = prim.GetVariantSets().AddVariantSet("way")
    for name, end in (("through", -0.25), ("above", 0.1)):
        variants.AddVariant(name)
        variants.SetVariantSelection(name)
        with variants.GetVariantEditContext():
            add_mesh(stage, "/World/Group/Falling", falling(0.25, end))
    variants.SetVariantSelection(variant)
    assert hits(find(stage)) == ([("/World/Group/Falling", *HIT[1:])] if variant == "through" else [])


def test_native_instances(stage):
    add_floor(stage)
    add_mesh(stage, "/Prototype/Mesh", falling(0.25, -0.25))
    stage.GetPrimAtPath("/Prototype").SetSpecifier(Sdf.SpecifierClass)
    for name, x in (("Over", -1.2), ("Beside", 10)):
        prim = UsdGeom.Xform.Define(stage, f"/World/{name}")
        prim.AddTranslateOp().Set((x, 0, 0))
        prim.GetPrim().GetReferences().AddInternalReference("/Prototype")
        prim.GetPrim().SetInstanceable(True)
    assert hits(find(stage)) == [("/World/Over/Mesh", *HIT[1:5], (-0.7, -0.5, 0))]


@pytest.mark.parametrize("place", ["below", "elsewhere"])
def test_point_instancers(stage, place):
    add_floor(stage)
    path = "/World/Leaves/Leaf" if place == "below" else "/Prototypes/Leaf"
    positions = {0: [(0, 0, 5), (0, 0, 0.25), (-1, 0, 0.25)], 1: [(0, 0, 5), (0, 0, -0.25), (-1, 0, -0.25)]}
    instancer = add_instancer(stage, "/World/Leaves", positions, [path])
    add_mesh(stage, path, FALLING)
    if place == "elsewhere":
        stage.GetPrimAtPath("/Prototypes").SetSpecifier(Sdf.SpecifierOver)  # not drawn where it stands
    instancer.CreateInvisibleIdsAttr([2])
    found = find(stage)
    assert hits(found) == [("/World/Leaves[1]/Leaf", *HIT[1:])]
    assert found["intervals"][0]["contacts"][0]["prims"][0] == path
    assert found["meshes"] == ["/World/Floor", "/World/Leaves[0]/Leaf", "/World/Leaves[1]/Leaf"]


def test_transforms_of_prototypes_instances_and_instancer_nest(stage):
    add_floor(stage)
    outer = add_instancer(stage, "/World/Outer", {0: [(0, 0, 10)]}, ["/World/Outer/Proto"])
    outer.AddTranslateOp().Set((0, 0, -11))
    outer.CreateScalesAttr([(1, 1, 2)])
    outer.CreateOrientationsAttr([Gf.Quath(1)])
    UsdGeom.Xform.Define(stage, "/World/Outer/Proto").AddTranslateOp().Set((0, 0, 0.25))
    inner_path = "/World/Outer/Proto/Inner"
    add_instancer(stage, inner_path, {0: [(0, 0, 0), (0, 0, 0.375)], 1: [(0, 0, 0), (0, 0, 0.125)]},
                  [f"{inner_path}/Leaf"])  # fmt: skip
    add_mesh(stage, f"{inner_path}/Leaf", FALLING)
    # height = -11 + 10 + 2 (0.25 + z): from 0.25 to -0.25, and -0.5 for the one that rests
    found = find(stage)
    assert hits(found) == [("/World/Outer[0]/Proto/Inner[1]/Leaf", *HIT[1:])]


def test_instances_come_and_go(stage):
    add_floor(stage)
    # The second instance falls through while it is not there, and is back below.
    positions = {
        0: [(0, 0, 9), (0, 0, 0.25)],
        1: [(0, 0, 9)],
        2: [(0, 0, 9), (0, 0, -0.75)],
        3: [(0, 0, 9), (0, 0, 0.75)],
    }
    instancer = add_instancer(stage, "/World/Leaves", positions, ["/World/Leaves/Leaf"])
    numbers = instancer.GetProtoIndicesAttr()
    numbers.Clear()
    for time, value in positions.items():
        numbers.Set([0] * len(value), time)
    add_mesh(stage, "/World/Leaves/Leaf", FALLING)
    found = find(stage)
    assert [interval["hits"] for interval in found["intervals"]] == [0, 0, 3]
    warnings = "\n".join(found["warnings"])
    assert "/World/Leaves[1]/Leaf vanishes at time 1" in warnings
    assert "/World/Leaves[1]/Leaf appears at time 2" in warnings


def test_instances_that_appear_have_one_note(stage):
    positions = {0: [(9, 0, 0)], 1: [(place, 0, 0) for place in range(9, 19)], 2: [(9, 0, 1)]}
    instancer = add_instancer(stage, "/World/Leaves", positions, ["/World/Leaves/Leaf"])
    numbers = instancer.GetProtoIndicesAttr()
    numbers.Clear()
    for time, value in positions.items():
        numbers.Set([0] * len(value), time)
    add_mesh(stage, "/World/Leaves/Leaf", FALLING)
    split = "its motion is split there, a jump is not checked"
    assert find(stage)["warnings"] == [
        f"each of 9 meshes of /World/Leaves appears at time 1: {split}",
        f"each of 9 meshes of /World/Leaves vanishes at time 2: {split}",
    ]


@pytest.mark.parametrize("orientation", ["rightHanded", "leftHanded"])
def test_orientation(stage, orientation):
    floor = add_floor(stage)
    floor.CreateOrientationAttr(orientation)
    add_falling(stage)
    assert hits(find(stage)) == [HIT]


def comb(teeth):
    """A polygon in the plane z = 0 with teeth that end at y = 1, as wide as the gaps between them, 1 each."""
    outline = [(0, -1, 0), (2 * teeth - 1, -1, 0)]
    for tooth in reversed(range(teeth)):
        outline += [(2 * tooth + 1, 1, 0), (2 * tooth, 1, 0)]
        if tooth:
            outline += [(2 * tooth, 0, 0), (2 * tooth - 1, 0, 0)]
    return outline


def drop(stage, path, places):
    """Needles, triangles that come with their points at places first, fall from 0.5 to -0.5."""
    points = [point for x, y in places for point in ((x, y, 0.5), (x + 0.01, y, 1.6), (x, y + 0.01, 1.6))]
    ends = moved(points, (0, 0, -1))
    counts = [3] * len(places)
    return add_mesh(stage, path, {0: points, 1: ends}, counts, list(range(len(points))))


def test_large_concave_polygons(stage):
    teeth = 40
    outline = comb(teeth)
    assert len(outline) == 4 * teeth
    add_mesh(stage, "/World/Comb", outline)
    drop(stage, "/World/Needles", [(number + 0.5, 0.5) for number in range(2 * teeth - 1)])
    found = find(stage)
    vertices = [hit for hit in hits(found) if hit[1].startswith("vertex")]
    # On a diagonal a point meets two triangles.
    assert {int(hit[1].split()[1]) // 3 for hit in vertices} == set(range(0, 2 * teeth - 1, 2))
    assert {hit[2:4] for hit in vertices} == {("/World/Comb", "face 0")}


def test_hole_faces_and_holes_by_a_bridge(stage):
    # Two quads side by side of which the second is a hole; a square with a hole that a bridge joins to its outline.
    add_mesh(stage, "/World/Quads", [(0, 0, 0), (1, 0, 0), (2, 0, 0), (0, 1, 0), (1, 1, 0), (2, 1, 0)],
             [4, 4], [0, 1, 4, 3, 1, 2, 5, 4]).CreateHoleIndicesAttr([1])  # fmt: skip
    square = [(0, 5, 0), (4, 5, 0), (4, 9, 0), (0, 9, 0), (1, 6, 0), (1, 8, 0), (3, 8, 0), (3, 6, 0)]
    add_mesh(stage, "/World/Bridge", square, [10], [0, 1, 2, 3, 0, 4, 5, 6, 7, 4])
    places = [(0.5, 0.4), (1.5, 0.4), (0.5, 7.1), (2.1, 7.2), (3.5, 7.3), (2.2, 5.3)]
    drop(stage, "/World/Needles", places)
    found = [hit[:4] for hit in hits(find(stage)) if hit[1].startswith("vertex")]
    assert sorted(found) == sorted(
        ("/World/Needles", f"vertex {3 * number}", f"/World/{name}", "face 0")
        for number, name in [(0, "Quads"), (2, "Bridge"), (4, "Bridge"), (5, "Bridge")]
    )


def test_units_and_up_axis(tmp_path):
    stage = new_stage(tmp_path / "scene.usda", up_axis="Y", meters_per_unit=0.01)
    stage.SetTimeCodesPerSecond(30)
    add_mesh(stage, "/World/Floor", [(x, z, y) for x, y, z in FLOOR])
    add_mesh(stage, "/World/Falling", {t: [(x, z, y) for x, y, z in p] for t, p in falling(0.25, -0.25).items()})
    found = find(stage)
    assert (found["up_axis"], found["meters_per_unit"], found["time_codes_per_second"]) == ("Y", 0.01, 30)
    assert hits(found) == [(*HIT[:5], (0.5, 0, -0.5))]


def test_visibility(stage):
    add_floor(stage)
    mesh = add_mesh(stage, "/World/Group/Falling", {0: moved(FALLING, (0, 0, 0.25)), 1: moved(FALLING, (0, 0, -0.25)),
                                                    2: moved(FALLING, (0, 0, 0.25)), 4: FALLING})  # fmt: skip
    group = UsdGeom.Imageable(UsdGeom.Xform.Define(stage, "/World/Group"))
    for time, value in ((0, "invisible"), (1, "inherited"), (3, "invisible")):
        group.CreateVisibilityAttr().Set(value, time)
    found = find(stage)
    # It rises through the floor, and has gone when it would touch it.
    assert [interval["hits"] for interval in found["intervals"]] == [0, 1, 0, 0]
    assert hits(found, 1) == [("/World/Group/Falling", *HIT[1:4], 1.5, HIT[5])]
    assert mesh.GetPath() in found["meshes"]


def test_purpose(stage):
    add_floor(stage)
    add_falling(stage, "/World/Proxy").CreatePurposeAttr("proxy")
    add_falling(stage, "/World/Render", 0.25, 0.1).CreatePurposeAttr("render")
    found = find(stage)
    assert hits(found) == []
    assert "purposes: meshes of purpose proxy are not checked: 1" in found["warnings"]
    assert hits(find(stage, "--purpose", "default", "proxy")) == [("/World/Proxy", *HIT[1:])]


def add_skeleton(stage, *, joints=True):
    """FALLING with a joint, or a blend shape, that takes it from a height of 0.25 to one of -0.25."""
    UsdSkel.Root.Define(stage, "/World/Model")
    skeleton = UsdSkel.Skeleton.Define(stage, "/World/Model/Skeleton")
    skeleton.AddTranslateOp().Set((0, 0, 100))  # in which only points that joints move stand
    skeleton.CreateJointsAttr(["root"])
    skeleton.CreateBindTransformsAttr([Gf.Matrix4d(1)])
    skeleton.CreateRestTransformsAttr([Gf.Matrix4d(1)])
    animation = UsdSkel.Animation.Define(stage, "/World/Model/Animation")
    binding = UsdSkel.BindingAPI.Apply(skeleton.GetPrim())
    binding.CreateAnimationSourceRel().SetTargets([animation.GetPath()])
    mesh = add_mesh(stage, "/World/Model/Falling", moved(FALLING, (0, 0, 0.25)))
    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    if joints:
        animation.CreateJointsAttr(["root"])
        animation.CreateRotationsAttr([Gf.Quatf(1)])
        animation.CreateScalesAttr([Gf.Vec3h(1)])
        for time, z in ((0, -100), (1, -100.5)):
            animation.CreateTranslationsAttr().Set([(0, 0, z)], time)
        binding.CreateJointIndicesPrimvar(False, 1).Set([0, 0, 0])
        binding.CreateJointWeightsPrimvar(False, 1).Set([1, 1, 1])
    else:
        shape = UsdSkel.BlendShape.Define(stage, "/World/Model/Falling/Down")
        shape.CreateOffsetsAttr([(0, 0, -0.5)])
        shape.CreatePointIndicesAttr([0])
        binding.CreateBlendShapesAttr(["down"])
        binding.CreateBlendShapeTargetsRel().SetTargets([shape.GetPath()])
        animation.CreateBlendShapesAttr(["down"])
        for time in (0, 1):
            animation.CreateBlendShapeWeightsAttr().Set([time], time)
    return mesh


@pytest.mark.parametrize("joints", [True, False])
def test_skeletons_and_blend_shapes(stage, joints):
    add_floor(stage)
    add_skeleton(stage, joints=joints)
    found = find(stage)
    assert hits(found) == [("/World/Model/Falling", *HIT[1:])]
    assert "1 mesh is moved by transforms or skeletons" in found["motion"]


def test_skinning_is_what_usd_bakes(stage, tmp_path):
    """Two joints that turn, weights between them, and a mesh with a bind transform: compared with UsdSkel's baking."""
    add_floor(stage)
    UsdSkel.Root.Define(stage, "/World/Model").AddTranslateOp().Set((0, 1, 2))
    skeleton = UsdSkel.Skeleton.Define(stage, "/World/Model/Skeleton")
    skeleton.CreateJointsAttr(["a", "a/b"])
    up = Gf.Matrix4d().SetTranslate((0, 0, 1))
    skeleton.CreateBindTransformsAttr([Gf.Matrix4d(1), up])
    skeleton.CreateRestTransformsAttr([Gf.Matrix4d(1), up])
    animation = UsdSkel.Animation.Define(stage, "/World/Model/Animation")
    animation.CreateJointsAttr(["a/b"])
    animation.CreateTranslationsAttr([(0, 0, 1)])
    animation.CreateScalesAttr([Gf.Vec3h(1, 2, 1)])
    for time, angle in enumerate((0, 10, 30, 60, 90)):
        quaternion = Gf.Rotation((1, 0, 0), angle).GetQuat()
        animation.CreateRotationsAttr().Set([Gf.Quatf(quaternion)], time)
    UsdSkel.BindingAPI.Apply(skeleton.GetPrim()).CreateAnimationSourceRel().SetTargets([animation.GetPath()])
    points = [(0, 0, 0), (1, 0, 1), (0, 1, 2), (1, 1, 3)]
    mesh = add_mesh(stage, "/World/Model/Mesh", points, [3, 3], [0, 1, 2, 2, 1, 3])
    mesh.AddRotateZOp().Set(30)
    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    binding.CreateGeomBindTransformAttr(Gf.Matrix4d().SetTranslate((0.1, 0.2, 0.3)))
    binding.CreateJointIndicesPrimvar(False, 2).Set([0, 1] * 4)
    binding.CreateJointWeightsPrimvar(False, 2).Set([1, 0, 0.75, 0.25, 0.5, 0.5, 0, 1])
    path = save(stage)

    from warp_bsc.usd.scene import Scene  # noqa: PLC0415

    scene = Scene(path)
    assert scene.times == [0, 1, 2, 3, 4]
    baked = Usd.Stage.Open(path)
    baked.SetEditTarget(baked.GetSessionLayer())
    assert UsdSkel.BakeSkinning(Usd.PrimRange.Stage(baked), Gf.Interval(0, 4))
    mesh = UsdGeom.Mesh(baked.GetPrimAtPath("/World/Model/Mesh"))
    for interval in scene:
        (part,) = (part for part in interval.segment.meshes if part.path == "/World/Model/Mesh")
        transform = np.array(mesh.ComputeLocalToWorldTransform(interval.start))
        expected = np.array(mesh.GetPointsAttr().Get(interval.start)) @ transform[:3, :3] + transform[3, :3]
        np.testing.assert_allclose(interval.x0[part.vertices], expected, atol=2e-6)


def test_usdz(stage, tmp_path):
    add_floor(stage)
    add_falling(stage)
    package = tmp_path / "scene.usdz"
    assert UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(save(stage)), str(package))
    assert hits(find(package)) == [HIT]


def test_times_of_different_meshes(stage):
    add_floor(stage)
    add_mesh(stage, "/World/Falling", {0: moved(FALLING, (0, 0, 0.25)), 4: moved(FALLING, (0, 0, -0.25))})
    add_mesh(stage, "/World/Other", {1: moved(FALLING, (0, 0, 9)), 1.5: moved(FALLING, (0, 0, 8))})
    found = find(stage)
    assert [(interval["start"], interval["end"]) for interval in found["intervals"]] == [(0, 1), (1, 1.5), (1.5, 4)]
    assert hits(found) == [(*HIT[:4], 2, HIT[5])]


def test_held_interpolation_is_a_jump(stage):
    add_floor(stage)
    mesh = add_mesh(stage, "/World/Falling", moved(FALLING, (0, 0.5, 0)))
    mesh.AddTranslateOp().Set((0, -0.5, 0.25))
    # Half a turn at time 1, all at once, would take it through the floor.
    spline = Ts.Spline("float")
    for time, angle in ((0, 0), (1, 180), (2, 180)):
        knot = Ts.Knot("float")
        knot.SetTime(time)
        knot.SetValue(angle)
        knot.SetNextInterpolation(Ts.InterpHeld)
        spline.SetKnot(knot)
    assert mesh.AddRotateXOp().GetAttr().SetSpline(spline)
    found = find(stage)
    assert [(interval["start"], interval["end"]) for interval in found["intervals"]] == [(0, 1), (1, 2)]
    assert hits(found) == []
    assert "/World/Falling jumps at time 1: what it jumps through is not checked" in found["warnings"]


def test_topology_that_changes_splits_the_motion(stage):
    add_floor(stage)
    falling_quad = [*FALLING, (0.9, -0.9, 1.0)]
    mesh = add_mesh(stage, "/World/Falling", {
        0: moved(FALLING, (0, 0, 0.25)), 1: moved(FALLING, (0, 0, -0.25)),  # through
        2: moved(falling_quad, (0, 0, 0.75)), 3: moved(falling_quad, (0, 0, -0.25)),  # jumps back up; through
    })  # fmt: skip
    counts, indices = mesh.GetFaceVertexCountsAttr(), mesh.GetFaceVertexIndicesAttr()
    for time, count, corners in ((0, [3], [0, 1, 2]), (2, [3, 3], [0, 1, 2, 1, 3, 2])):
        counts.Set(count, time)
        indices.Set(corners, time)
    found = find(stage)
    assert [interval["hits"] for interval in found["intervals"]] == [1, 0, 1]
    assert hits(found) == [HIT, (*HIT[:4], 2.75, HIT[5])]
    assert (
        "/World/Falling changes its topology at time 2: its motion is split there, a jump is not checked"
        in (found["warnings"])
    )


def test_topology_that_changes_at_the_same_number_of_points_does_not_move_until_then(stage):
    add_floor(stage)
    mesh = add_mesh(stage, "/World/Falling", {0: moved(FALLING, (0, 0, 0.25)), 1: moved(FALLING, (0, 0, -0.25)),
                                              2: moved(FALLING, (0, 0, -0.5))})  # fmt: skip
    for time, corners in ((0, [0, 1, 2]), (1, [0, 2, 1])):
        mesh.GetFaceVertexIndicesAttr().Set(corners, time)
    found = find(stage)
    assert hits(found, 0) == [] and len(found["intervals"]) == 2
    assert any(text.startswith("/World/Falling changes its topology at time 1: ") for text in found["warnings"])


def test_subdivision_follows_turns_about_two_axes(stage):
    # A blade on an arm of length 1 that makes half a turn, and rolls: straight through the middle, or around.
    for name, y in (("Middle", 0), ("Around", 1)):
        add_mesh(stage, f"/World/{name}", moved([(0, -0.5, -1), (0, 0.5, -1), (0, 0, 1)], (0, y, 0)))
    blade = add_mesh(stage, "/World/Blade", [(1, 0, 0), (1.01, 0, 3), (1, 0.01, 3)])
    turn = blade.AddRotateXYZOp()
    for time, roll, angle in ((0, -10, -10), (1, 10, 190)):
        turn.Set((roll, 0, angle), time)

    def struck(*options):
        return {name for hit in hits(find(stage, *options)) for name in (hit[0], hit[2])} - {"/World/Blade"}

    assert struck() == {"/World/Middle"}
    assert struck("--subdivide", "16") == {"/World/Around"}
    found = find(stage, "--subdivide", "4")
    assert [interval["start"] for interval in found["intervals"]] == [0, 0.25, 0.5, 0.75]
    assert "Motion between time samples is taken to be linear." in found["motion"]
    assert "1 mesh is moved by transforms" in found["motion"]
    turn.Set((-10, 0, 190), 1)  # about one axis
    assert struck() == struck("--subdivide", "16") == {"/World/Around"}


def test_instances_are_where_usd_has_them(stage):
    from warp_bsc.usd.scene import Scene  # noqa: PLC0415

    instancer = add_instancer(stage, "/World/Leaves", {0: [(1, 2, 3), (4, 5, 6)], 2: [(2, 2, 3), (4, 0, 6)]},
                              ["/World/Leaves/Leaf"])  # fmt: skip
    turns = [Gf.Rotation((1, 2, 3), angle).GetQuat() for angle in (40, 70)]
    instancer.CreateOrientationsAttr([Gf.Quath(turn) for turn in turns])
    instancer.CreateScalesAttr([(1, 2, 3), (-1, 1, 0.5)])
    instancer.AddRotateYOp().Set(20)
    leaf = add_mesh(stage, "/World/Leaves/Leaf/Mesh", FALLING)
    UsdGeom.Xform.Define(stage, "/World/Leaves/Leaf").AddRotateXOp().Set(33)
    leaf.AddTranslateOp().Set((7, 8, 9))
    interval = Scene(save(stage), subdivide=2).interval(1)
    expected = instancer.ComputeInstanceTransformsAtTime(1, 1)
    world = instancer.ComputeLocalToWorldTransform(1)
    for part, transform in zip(interval.segment.meshes, expected, strict=True):
        matrix = np.array(leaf.GetLocalTransformation() * transform * world)
        world_points = np.array(FALLING) @ matrix[:3, :3] + matrix[3, :3]
        np.testing.assert_allclose(interval.x0[part.vertices], world_points, atol=1e-5)
