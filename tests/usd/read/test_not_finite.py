"""Transforms, instances and skeletons that are not finite: their meshes are named and left out, never placed anyway."""

import math

import pytest
from pxr import Gf, UsdGeom, UsdSkel
from usd_stages import FALLING, HIT, add_instancer, add_mesh, falling_stage, find, floor_stage, hits, moved, save

from warp_bsc.usd import scene as scene_module
from warp_bsc.usd.frames import FrameRange
from warp_bsc.usd.scene import Scene

NAN, INF = math.nan, math.inf
LAST = 4
"""The last of the times, from 0 on, at which the floor's neighbour and what is broken have samples."""


def matrix(row, column, value):
    found = Gf.Matrix4d(1)
    found[row, column] = value
    return found


TRANSFORMS = {
    "translate": ("AddTranslateOp", (NAN, 0, 0), (0, 0, 0)),
    "translate infinitely": ("AddTranslateOp", (0, 0, INF), (0, 0, 0)),
    "scale": ("AddScaleOp", (1, NAN, 1), (1, 1, 1)),
    "scale infinitely": ("AddScaleOp", (1, 1, -INF), (1, 1, 1)),
    "rotate": ("AddRotateZOp", INF, 0.0),
    "rotate by three angles": ("AddRotateXYZOp", (0, NAN, 0), (0, 0, 0)),
    # OpenUSD itself makes the identity of this one, and finite matrices of the inverse ones
    "orient": ("AddOrientOp", Gf.Quatf(1, NAN, 0, 0), Gf.Quatf(1)),
    "orient infinitely": ("AddOrientOp", Gf.Quatf(1, INF, 0, 0), Gf.Quatf(1)),
    "unscale": ("inverse AddScaleOp", (1, 1, INF), (1, 1, 1)),
    "matrix": ("AddTransformOp", matrix(0, 0, NAN), Gf.Matrix4d(1)),
    "matrix, off the diagonal": ("AddTransformOp", matrix(1, 2, INF), Gf.Matrix4d(1)),
    "matrix, last column": ("AddTransformOp", matrix(2, 3, NAN), Gf.Matrix4d(1)),
    "inverse matrix": ("inverse AddTransformOp", matrix(1, 1, NAN), Gf.Matrix4d(1)),
}


@pytest.fixture
def stage(tmp_path):
    """A floor, and a triangle that moves from time 0 to 4."""
    stage = floor_stage(tmp_path)
    add_mesh(stage, "/World/Falling", {time: moved(FALLING, (0, 0, 1 - time / 8)) for time in range(LAST + 1)})
    return stage


def set_samples(attribute, bad, good, when):
    """Set an attribute to a bad value at one time and to a good one at the others; ``when`` may say always."""
    if when == "static":
        attribute.Set(bad)
        return
    for time in range(LAST + 1):
        attribute.Set(bad if when in ("always", time) else good, time)


def transform(prim, name, when):
    kind, bad, good = TRANSFORMS[name]
    xformable = UsdGeom.Xformable(prim)
    operation = getattr(xformable, kind.removeprefix("inverse "))()
    if kind.startswith("inverse "):
        attribute = operation.GetAttr()
        xformable.SetXformOpOrder([UsdGeom.XformOp(attribute, True)])
    set_samples(operation.GetAttr(), bad, good, when)


def check_left_out(stage, when, names, why):
    """Check that meshes are there but in the intervals that end or start at a bad time, and named."""
    scene = Scene(save(stage))
    is_always = when in ("static", "always")
    since, until = (0, LAST) if is_always else (max(0, when - 1), min(LAST, when + 1))
    present = [{mesh.name for mesh in interval.segment.meshes} for interval in scene]
    others = {"/World/Floor", "/World/Falling"}
    assert len(present) == LAST and all(others <= found for found in present)
    missing = [set(names) & found for found in present]
    assert missing == [set(names)] * since + [set()] * (until - since) + [set(names)] * (LAST - until)
    assert len(scene.left_out) == len(names)
    for name, sentence in zip(sorted(names), sorted(scene.left_out), strict=True):
        end = f"to {until}" if until < LAST else "on"
        assert sentence.startswith(f"{name}: " if is_always else f"from time {since} {end}: {name}: ")
        assert why in sentence
    with pytest.raises(ValueError, match=f"{names[0].split('[')[0]}.*{why}"):
        list(Scene(save(stage), strict=True))


@pytest.mark.parametrize("when", ["static", "always", 0, 2, LAST])
@pytest.mark.parametrize("name", TRANSFORMS)
def test_transform(stage, name, when):
    transform(add_mesh(stage, "/World/Odd", FALLING).GetPrim(), name, when)
    check_left_out(stage, when, ["/World/Odd"], "its transform is not finite")


@pytest.mark.parametrize("when", ["static", 2])
@pytest.mark.parametrize("name", ["translate infinitely", "orient"])
def test_transform_of_a_parent(stage, name, when):
    transform(UsdGeom.Xform.Define(stage, "/World/Group").GetPrim(), name, when)
    paths = ["/World/Group/A", "/World/Group/B"]
    for path in paths:
        add_mesh(stage, path, FALLING)
    check_left_out(stage, when, paths, "its transform is not finite")


INSTANCES = {
    "positions": ("CreatePositionsAttr", Gf.Vec3f(NAN, 0, 0), Gf.Vec3f(5, 0, 0)),
    "positions at infinity": ("CreatePositionsAttr", Gf.Vec3f(0, 0, INF), Gf.Vec3f(5, 0, 0)),
    "orientations": ("CreateOrientationsAttr", Gf.Quath(NAN, 0, 0, 0), Gf.Quath(1)),
    "orientations in single precision": ("CreateOrientationsfAttr", Gf.Quatf(1, 0, INF, 0), Gf.Quatf(1)),
    "scales": ("CreateScalesAttr", Gf.Vec3f(1, INF, 1), Gf.Vec3f(1)),
}


@pytest.mark.parametrize("when", ["always", 0, 2, LAST])
@pytest.mark.parametrize("name", INSTANCES)
def test_one_instance(stage, name, when):
    create, bad, good = INSTANCES[name]
    instancer = add_instancer(stage, "/World/Leaves", {0: [(5, 0, 0), (6, 0, 0), (7, 0, 0)]}, ["/World/Leaves/Leaf"])
    add_mesh(stage, "/World/Leaves/Leaf", FALLING)
    set_samples(getattr(instancer, create)(), [good, bad, good], [good] * 3, when)
    check_left_out(stage, when, ["/World/Leaves[1]/Leaf"], "its transform is not finite")


@pytest.mark.parametrize("path", ["/World/Leaves", "/World/Leaves/Leaf"])
@pytest.mark.parametrize("name", ["translate", "orient"])
def test_all_instances(stage, path, name):
    add_instancer(stage, "/World/Leaves", {0: [(5, 0, 0), (6, 0, 0)]}, ["/World/Leaves/Leaf"])
    add_mesh(stage, "/World/Leaves/Leaf", FALLING)
    transform(stage.GetPrimAtPath(path), name, "static")
    names = ["/World/Leaves[0]/Leaf", "/World/Leaves[1]/Leaf"]
    check_left_out(stage, "static", names, "its transform is not finite")


def test_an_instance_that_is_not_there_is_not_broken(stage):
    """Its transform is no matrix at all; it appears, and moves, as any other."""
    instancer = add_instancer(
        stage, "/World/Leaves", {0: [(5, 0, 0)], 2: [(5, 0, 0), (6, 0, 0)], 4: [(5, 0, 0), (6, 0, 1)]},
        ["/World/Leaves/Leaf"],
    )  # fmt: skip
    for time, numbers in ((0, [0]), (2, [0, 0])):
        instancer.GetProtoIndicesAttr().Set(numbers, time)
    add_mesh(stage, "/World/Leaves/Leaf", FALLING)
    scene = Scene(save(stage))
    present = [[mesh.name for mesh in interval.segment.meshes if "Leaf" in mesh.name] for interval in scene]
    assert present == [["/World/Leaves[0]/Leaf"]] * 2 + [["/World/Leaves[0]/Leaf", "/World/Leaves[1]/Leaf"]] * 2
    assert scene.left_out == []


def add_model(stage):
    """A mesh that follows two joints and a blend shape with an in-between."""
    root = UsdSkel.Root.Define(stage, "/World/Model")
    skeleton = UsdSkel.Skeleton.Define(stage, "/World/Model/Skeleton")
    skeleton.CreateJointsAttr(["a", "a/b", "a/c"])
    skeleton.CreateBindTransformsAttr([Gf.Matrix4d(1)] * 3)
    skeleton.CreateRestTransformsAttr([Gf.Matrix4d(1)] * 3)
    animation = UsdSkel.Animation.Define(stage, "/World/Model/Animation")
    animation.CreateJointsAttr(["a", "a/b", "a/c"])
    animation.CreateBlendShapesAttr(["down"])
    for time in range(LAST + 1):
        animation.CreateTranslationsAttr().Set([(0, 0, -0.1 * time), (0, 0, 0), (0, 0, 0)], time)
        animation.CreateRotationsAttr().Set([Gf.Quatf(1)] * 3, time)
        animation.CreateScalesAttr().Set([Gf.Vec3h(1)] * 3, time)
        animation.CreateBlendShapeWeightsAttr().Set([(time + 1) / 8], time)
    UsdSkel.BindingAPI.Apply(skeleton.GetPrim()).CreateAnimationSourceRel().SetTargets([animation.GetPath()])
    mesh = add_mesh(stage, "/World/Model/Odd", moved(FALLING, (9, 0, 0)))
    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    binding.CreateJointIndicesPrimvar(False, 2).Set([0, 1] * 3)
    binding.CreateJointWeightsPrimvar(False, 2).Set([0.5, 0.5] * 3)
    shape = UsdSkel.BlendShape.Define(stage, "/World/Model/Odd/Down")
    shape.CreateOffsetsAttr([(0, 0, -1)])
    shape.CreatePointIndicesAttr([1])
    between = shape.CreateInbetween("between")
    between.SetWeight(0.5)
    between.SetOffsets([(0, 0, -0.25)])
    binding.CreateBlendShapesAttr(["down"])
    binding.CreateBlendShapeTargetsRel().SetTargets([shape.GetPath()])
    return root, skeleton, animation, binding, shape


ORIGIN, BROKEN = Gf.Vec3f(0), Gf.Vec3f(0, NAN, 0)
NO_INVERSE, NOT_FINITE = "the bind transform of joint a/b has no inverse", "is not finite"
SKINS = {  # how to break it, when, and what is said
    "translations": (lambda r, s, a, b, h: a.GetTranslationsAttr().Set([ORIGIN, BROKEN, ORIGIN], 2), 2, NOT_FINITE),
    "rotations": (
        lambda r, s, a, b, h: a.GetRotationsAttr().Set([Gf.Quatf(1), Gf.Quatf(NAN, 0, 0, 0), Gf.Quatf(1)], 2),
        2,
        NOT_FINITE,
    ),
    "scales": (
        lambda r, s, a, b, h: a.GetScalesAttr().Set([Gf.Vec3h(1), Gf.Vec3h(1, INF, 1), Gf.Vec3h(1)], LAST),
        LAST,
        NOT_FINITE,
    ),
    "weights of blend shapes": (lambda r, s, a, b, h: a.GetBlendShapeWeightsAttr().Set([NAN], 2), 2, NOT_FINITE),
    # its in-between takes its place up to a weight of 0.5
    "offsets": (lambda r, s, a, b, h: h.GetOffsetsAttr().Set([BROKEN]), LAST, NOT_FINITE),
    "offsets of an in-between": (
        lambda r, s, a, b, h: h.GetInbetween("between").SetOffsets([BROKEN]), "static", NOT_FINITE,
    ),
    "weight of an in-between": (
        lambda r, s, a, b, h: h.GetInbetween("between").SetWeight(NAN), "static", "the weight of an in-between",
    ),
    "weights of joints": (
        lambda r, s, a, b, h: b.GetJointWeightsAttr().Set([0.5, 0.5, NAN, 0.5, 0.5, 0.5]), "static", NOT_FINITE,
    ),
    "bind transforms": (
        lambda r, s, a, b, h: s.GetBindTransformsAttr().Set([Gf.Matrix4d(1), matrix(1, 1, NAN), Gf.Matrix4d(1)]),
        "static",
        NO_INVERSE,
    ),
    "bind transforms without inverse": (
        lambda r, s, a, b, h: s.GetBindTransformsAttr().Set([Gf.Matrix4d(1), Gf.Matrix4d(0), Gf.Matrix4d(1)]),
        "static",
        NO_INVERSE,
    ),
    "bind transform of the mesh": (
        lambda r, s, a, b, h: b.CreateGeomBindTransformAttr(matrix(3, 0, INF)), "static", NOT_FINITE,
    ),
    "transform of the skeleton": (lambda r, s, a, b, h: transform(s.GetPrim(), "orient", 2), 2, NOT_FINITE),
    "transform of the root": (
        lambda r, s, a, b, h: transform(r.GetPrim(), "translate", "static"), "static", NOT_FINITE,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", SKINS)
def test_skin(stage, name):
    breaks, when, why = SKINS[name]
    breaks(*add_model(stage))
    check_left_out(stage, when, ["/World/Model/Odd"], why)


def test_a_joint_that_moves_nothing_may_be_broken(stage):
    _, skeleton, *_ = add_model(stage)
    skeleton.GetBindTransformsAttr().Set([Gf.Matrix4d(1), Gf.Matrix4d(1), Gf.Matrix4d(0)])
    scene = Scene(save(stage))
    assert all("/World/Model/Odd" in [mesh.name for mesh in interval.segment.meshes] for interval in scene)
    assert scene.left_out == []


@pytest.mark.parametrize("name", ["translate", "orient"])
def test_a_transform_beside_the_chosen_time_is_not_read(stage, name):
    path = save(stage)
    transform(add_mesh(stage, "/World/Odd", FALLING).GetPrim(), name, LAST)
    save(stage)
    scene = Scene(path, frames=FrameRange(0, 3))
    assert [len(interval.segment.meshes) for interval in scene] == [3, 3, 3] and scene.left_out == []


def test_status(tmp_path):
    stage = falling_stage(tmp_path)
    transform(add_mesh(stage, "/World/Odd", moved(FALLING, (0, 0, -0.1))).GetPrim(), "translate", "static")
    found = find(stage, status=4)
    assert hits(found) == [HIT]
    assert found["left_out"] == ["/World/Odd: its transform is not finite"]


def test_a_scene_in_which_nothing_moves(tmp_path):
    stage = floor_stage(tmp_path)
    add_mesh(stage, "/World/Near", moved(FALLING, (0, 0, -0.25)))
    transform(add_mesh(stage, "/World/Odd", FALLING).GetPrim(), "scale", "static")
    add_mesh(stage, "/World/Points", [*FALLING[:2], (0, NAN, 0)])
    found = find(stage, status=4)
    assert [sentence.split(":")[0] for sentence in found["left_out"]] == ["/World/Odd", "/World/Points"]
    assert [span["meshes"] for span in found["intersections"]] == [["/World/Floor", "/World/Near"]]


def test_many_instances_are_left_out_at_once(stage, monkeypatch):
    """Not one by one, each by reading the others again."""
    count = 50
    add_instancer(stage, "/World/Leaves", {0: [(5, 0, place) for place in range(count)]}, ["/World/Leaves/Leaf"])
    add_mesh(stage, "/World/Leaves/Leaf", FALLING)
    transform(stage.GetPrimAtPath("/World/Leaves"), "translate", "static")
    made = []
    segment = scene_module.Segment
    monkeypatch.setattr(scene_module, "Segment", lambda *arguments: made.append(1) or segment(*arguments))
    assert len(Scene(save(stage)).left_out) == count and len(made) == 1
