"""Turns found from transforms: the paths of points are those of the stage, and what does not fit has none."""

import numpy as np
import pytest
from pxr import Gf, Usd, UsdGeom
from usd_stages import FALLING, add_mesh, moved, new_stage, save

import warp_bsc as bsc
from warp_bsc.scene_replay.scene_arcs import arcs_of
from warp_bsc.usd.read.meshes import UsdMesh


@pytest.fixture
def stage(tmp_path):
    return new_stage(tmp_path / "scene.usda")


def turning(operation, *values, times=(0, 1)):
    """Sets the values of an operation at times."""
    for time, value in zip(times, values, strict=True):
        operation.Set(value, time)


def largest_error(stage, times):
    """How far the arcs of the only interval are from the stage's own transforms, as a share of the scene's size."""
    (interval,) = bsc.Scene(save(stage))
    arcs = arcs_of(interval)
    assert arcs is not None and len(interval.turns) == len(interval.segment.meshes)
    errors = []
    for time in times:
        x = arcs.positions(interval.x0, interval.x1, time)
        code = Usd.TimeCode(interval.start + time * (interval.end - interval.start))
        for number, part in enumerate(interval.segment.meshes):
            matrix = np.array(UsdGeom.Imageable(stage.GetPrimAtPath(part.path)).ComputeLocalToWorldTransform(code))
            points = np.array(UsdGeom.Mesh(stage.GetPrimAtPath(part.path)).GetPointsAttr().Get())[part.points]
            expected = points @ matrix[:3, :3] + matrix[3, :3]
            errors.append(np.abs(x[interval.segment.vertices_of(number)] - expected).max())
    return max(errors) / np.abs(interval.x0).max()


@pytest.mark.parametrize("seed", range(12))
def test_arcs_are_the_paths_of_the_stage(stage, seed):
    """One operation that turns, with pivots, scales and a moved origin, under a parent that is placed anyhow."""
    rng = np.random.default_rng(seed)
    parent = UsdGeom.Xform.Define(stage, "/World/Parent")
    parent.AddRotateXYZOp().Set(tuple(rng.uniform(-180, 180, 3)))
    parent.AddScaleOp().Set((2.0, 2.0, -2.0 if seed % 2 else 2.0))
    mesh = add_mesh(stage, "/World/Parent/Mesh", moved(FALLING, rng.uniform(-1, 1, 3)))
    if seed % 3:
        turning(mesh.AddTranslateOp(), *(tuple(v) for v in rng.uniform(-2, 2, (2, 3))))
    if seed % 4 > 1:
        pivot = mesh.AddTranslateOp(opSuffix="pivot")
        pivot.Set(tuple(rng.uniform(-1, 1, 3)))
    mesh.AddRotateZOp().Set(float(rng.uniform(-180, 180)))
    if seed % 2:
        turning(mesh.AddRotateYOp(), *(float(v) for v in rng.uniform(-900, 900, 2)))
    else:
        first = rng.standard_normal(4)
        second = first + 0.7 * rng.standard_normal(4)
        turning(mesh.AddOrientOp(), *(Gf.Quatf(*map(float, q / np.linalg.norm(q))) for q in (first, second)))
    mesh.AddScaleOp().Set(tuple(rng.uniform(0.5, 2.0, 3)))
    if seed % 4 > 1:
        mesh.AddTranslateOp(opSuffix="pivot", isInverseOp=True)
    assert largest_error(stage, rng.uniform(0, 1, 20)) < 2e-6


@pytest.mark.parametrize("start", np.linspace(-6.9, -0.1, 18))
def test_orientations_that_go_past_none_turn(stage, start):
    """OpenUSD takes an angle from the cosine of its half, which near none is coarse in single precision."""
    mesh = add_mesh(stage, "/World/Mesh", FALLING)
    half = np.radians([start, start + 7.0]) / 2.0
    turning(mesh.AddOrientOp(), *(Gf.Quatf(float(np.cos(h)), 0.0, 0.0, float(np.sin(h))) for h in half))
    assert largest_error(stage, np.linspace(0.0, 1.0, 41)) < 7e-4  # a straight path is 2e-3 off


@pytest.mark.parametrize("angles", [(0, 360), (-180, 180), (10, 730), (0, -36000), (0, 180 * 1001), (0, 1)])
def test_any_number_of_turns(stage, angles):
    mesh = add_mesh(stage, "/World/Mesh", FALLING)
    turning(mesh.AddRotateXOp(), *map(float, angles))
    (interval,) = bsc.Scene(save(stage))
    angle = np.radians(angles[1] - angles[0])
    np.testing.assert_allclose(interval.turns[0].vector, [angle, 0, 0], rtol=1e-6, atol=1e-9)
    rounding = 2.0**-23 * abs(angle)  # of angles, which OpenUSD interpolates in single precision
    assert largest_error(stage, np.random.default_rng(0).uniform(0, 1, 20)) < 1e-6 + rounding


def test_a_turn_that_single_precision_cannot_tell_from_a_straight_path_has_none(stage):
    turning(add_mesh(stage, "/World/Mesh", FALLING).AddRotateXOp(), 0.0, 0.01)
    (interval,) = bsc.Scene(save(stage))
    assert interval.turns == {}


def test_a_turning_parent_turns_all_below_about_its_own_axis(stage):
    parent = UsdGeom.Xform.Define(stage, "/World/Parent")
    parent.AddTranslateOp().Set((3, 4, 5))
    turning(parent.AddRotateZOp(), 0.0, 200.0)
    for name in ("A", "B"):
        mesh = add_mesh(stage, f"/World/Parent/{name}", moved(FALLING, (0, 3 * (name == "B"), 0)))
        mesh.AddRotateXOp().Set(30.0)
    assert largest_error(stage, [0.1, 0.5, 0.77]) < 1e-6
    (interval,) = bsc.Scene(save(stage))
    first, second = (interval.turns[number] for number in range(2))
    assert first.is_like(second, 10.0)
    np.testing.assert_allclose(first.centre[:2], [3, 4], atol=1e-9)


def matrices(mesh):
    turning(mesh.AddTransformOp(), *(Gf.Matrix4d().SetRotate(Gf.Rotation((0, 0, 1), angle)) for angle in (0, 90)))


def two_angles(mesh):
    turning(mesh.AddRotateXYZOp(), (0, 0, 0), (50, 0, 90))


def two_axes(mesh):
    turning(mesh.AddRotateZOp(), 0.0, 90.0)
    turning(mesh.AddRotateXOp(), 0.0, 70.0)


def growing(mesh):
    turning(mesh.AddRotateZOp(), 0.0, 90.0)
    turning(mesh.AddScaleOp(), (1, 1, 1), (1.1, 1.1, 1.1))


def sliding(mesh):
    turning(mesh.AddRotateZOp(), 0.0, 90.0)
    turning(mesh.AddTranslateOp(), (0, 0, 0), (1, 0, 0))


def flat(mesh):
    turning(mesh.AddRotateZOp(), 0.0, 90.0)
    mesh.AddScaleOp().Set((1, 1, 0))


def too_fast(mesh):
    turning(mesh.AddRotateZOp(), 0.0, 360.0 * 600)


@pytest.mark.parametrize("move", [matrices, two_angles, two_axes, growing, sliding, flat, too_fast])
def test_what_is_no_turn_about_one_axis_has_none(stage, move):
    move(add_mesh(stage, "/World/Mesh", FALLING))
    scene = bsc.Scene(save(stage))
    (interval,) = scene
    assert interval.turns == {} and arcs_of(interval) is None
    noted = any("/World/Mesh moves on curves, not by a turn" in warning for warning in scene.warnings)
    assert noted == (move is not matrices)  # which move points straight


def test_deforming_meshes_and_straight_motion_have_none(stage):
    add_mesh(stage, "/World/Deforming", {0: FALLING, 1: moved(FALLING, (0, 0, 1))}).AddRotateZOp().Set(0.0, 0)
    turning(UsdGeom.Xformable(stage.GetPrimAtPath("/World/Deforming")).GetOrderedXformOps()[0], 0.0, 90.0)
    turning(add_mesh(stage, "/World/Straight", FALLING).AddTranslateOp(), (0, 0, 0), (1, 2, 3))
    (interval,) = bsc.Scene(save(stage))
    assert interval.turns == {}


def test_instances_of_an_instancer_turn_each_about_its_own_axis(stage):
    instancer = UsdGeom.PointInstancer.Define(stage, "/World/Fans")
    add_mesh(stage, "/World/Fans/Fan", FALLING)
    instancer.CreatePrototypesRel().SetTargets(["/World/Fans/Fan"])
    instancer.CreateProtoIndicesAttr([0, 0, 0])
    instancer.CreatePositionsAttr([(0, 0, 0), (5, 0, 0), (0, 5, 0)])
    for time, angles in ((0, (0, 0, 0)), (1, (120, -60, 0))):
        turns = [Gf.Quatf(Gf.Rotation((0, 0, 1), angle).GetQuat()) for angle in angles]
        instancer.CreateOrientationsfAttr().Set(turns, time)
    (interval,) = bsc.Scene(save(stage))
    found = {number: np.degrees(turn.vector[2]) for number, turn in interval.turns.items()}
    assert found == {0: pytest.approx(120, abs=1e-4), 1: pytest.approx(-60, abs=1e-4)}
    np.testing.assert_allclose(interval.turns[1].centre, [5, 0, 0], atol=1e-6)


def test_instances_turn_with_what_is_above_their_instancer(stage):
    turning(UsdGeom.Xform.Define(stage, "/World/Arm").AddRotateZOp(), 0.0, 90.0)
    instancer = UsdGeom.PointInstancer.Define(stage, "/World/Arm/Fans")
    add_mesh(stage, "/World/Arm/Fans/Fan", FALLING)
    instancer.CreatePrototypesRel().SetTargets(["/World/Arm/Fans/Fan"])
    instancer.CreateProtoIndicesAttr([0, 0])
    instancer.CreatePositionsAttr([(0, 0, 0), (5, 0, 0)])
    (interval,) = bsc.Scene(save(stage))
    assert [np.degrees(turn.vector[2]) for turn in interval.turns.values()] == pytest.approx([90, 90], abs=1e-4)


def test_transforms_that_translations_alone_change_are_not_read_between_the_times(stage, monkeypatch):
    """A crowd of thousands of instances that slide would be read three times an interval."""
    for name in ("Sliding", "Turning"):
        mesh = add_mesh(stage, f"/World/{name}", FALLING)
        turning(mesh.AddTranslateOp(), (0, 0, 0), (1, 2, 3))
        mesh.AddRotateZOp().Set(30.0)
        if name == "Turning":
            turning(mesh.AddRotateXOp(), 0.0, 90.0)
    scene, read = bsc.Scene(save(stage)), []
    ordinary = UsdMesh.read_transform

    def recorded(mesh, *arguments, **options):
        read.append(mesh.name)
        return ordinary(mesh, *arguments, **options)

    monkeypatch.setattr(UsdMesh, "read_transform", recorded)
    (interval,) = scene
    assert list(interval.turns) == [1] and set(read) == {"/World/Turning"}
