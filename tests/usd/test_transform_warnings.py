"""Warnings of transforms that straight paths hide: large turns between two times, and scales of 0."""

import numpy as np
import pytest
from pxr import Gf, UsdGeom
from usd_stages import FALLING, add_instancer, add_mesh, animate, floor_stage, moved, save

import warp_bsc as bsc


@pytest.fixture
def stage(tmp_path):
    return floor_stage(tmp_path)


def add_turning(stage, path="/World/Fan", angles=None):
    """A mesh whose transform has an angle at each of some times, and tilts as well, so that it is on no arc."""
    mesh, angles = UsdGeom.Xformable(add_mesh(stage, path, FALLING)), angles or {0: 0.0, 1: 360.0}
    operation, tilt = mesh.AddRotateZOp(), mesh.AddRotateXOp()
    for number, (time, angle) in enumerate(angles.items()):
        operation.Set(angle, time)
        tilt.Set(10.0 * (number % 2), time)


def warnings(stage, word, **options):
    return [warning for warning in bsc.Scene(save(stage), **options).warnings if word in warning]


def test_a_whole_turn_between_two_times_is_named(stage):
    add_turning(stage)
    assert warnings(stage, "turns") == [
        "subdivide: /World/Fan turns by up to 360 degrees to the next time, at time 0: its vertices move straight, and "
        "what it turns through is not checked; in 8 parts it turns by 45 degrees or less"
    ]
    assert warnings(stage, "turns", subdivide=2) and not warnings(stage, "turns", subdivide=8)


def test_turns_that_are_checked_on_their_arcs_are_not_named(stage):
    operation = UsdGeom.Xformable(add_mesh(stage, "/World/Fan", FALLING)).AddRotateZOp()
    for time, angle in ((0, 0.0), (1, 360.0), (2, 100.0)):
        operation.Set(angle, time)
    scene = bsc.Scene(save(stage))
    np.testing.assert_allclose(scene.interval(0).x0, scene.interval(0).x1, atol=1e-12)  # it seems to stand still
    assert len(scene.interval(0).turns) == 1 and not warnings(stage, "turns")
    deforming = UsdGeom.Mesh(stage.GetPrimAtPath("/World/Fan"))
    for time in (0, 1):
        deforming.GetPointsAttr().Set(moved(FALLING, (0, 0, 0.1 * time)), time)
    (warning,) = warnings(stage, "turns")
    assert "2 times, first at time 0" in warning


@pytest.mark.parametrize(("angle", "is_named"), [(179.0, False), (180.0, True), (-270.0, True), (5 * 360.0, True)])
def test_turns_of_half_a_turn_and_more_are_named(stage, angle, is_named):
    add_turning(stage, angles={0: 10.0, 1: 10.0 + angle})
    assert len(warnings(stage, f"by up to {abs(angle):g} degrees")) == is_named == len(warnings(stage, "turns"))


def test_turns_that_are_sampled_at_whole_times_are_named_only_where_a_step_skips_these(stage):
    add_turning(stage, angles={0: 0.0, 24: 360.0, 48: 0.0})
    assert not warnings(stage, "turns")
    assert not warnings(stage, "turns", frames=bsc.FrameRange(step=6))
    (warning,) = warnings(stage, "turns", frames=bsc.FrameRange(step=24))
    assert "360 degrees" in warning and "2 times, first at time 0" in warning
    (warning,) = warnings(stage, "turns", frames=bsc.FrameRange(step=48))  # there and back again
    assert "720 degrees" in warning


def test_a_group_that_turns_is_named_once(stage):
    operation = UsdGeom.Xform.Define(stage, "/World/Group").AddRotateXYZOp()
    for time, angle in ((0, 0.0), (1, 360.0)):
        operation.Set(Gf.Vec3f(0.1 * angle, angle, 10.0), time)
    for name in ("A", "B"):
        add_mesh(stage, f"/World/Group/{name}", FALLING)
    (warning,) = warnings(stage, "turns")
    assert warning.startswith("subdivide: /World/Group with 2 meshes turns by up to 360 degrees")


def test_a_group_is_named_if_one_of_its_meshes_is_on_no_arc(stage):
    operation = UsdGeom.Xform.Define(stage, "/World/Group").AddRotateYOp()
    tilt = UsdGeom.Xformable(add_mesh(stage, "/World/Group/A", FALLING)).AddRotateXOp()
    UsdGeom.Xformable(add_mesh(stage, "/World/Group/B", FALLING)).AddTranslateOp().Set(Gf.Vec3d(1.0, 0.0, 0.0))
    for time, angle in ((0, 0.0), (1, 360.0)):
        operation.Set(angle, time)
    assert not warnings(stage, "turns")
    for time in (0, 1):
        tilt.Set(20.0 * time, time)
    assert len(warnings(stage, "turns")) == 1


def test_many_turning_prims_are_counted(stage):
    for number in range(8):
        add_turning(stage, f"/World/Fan{number}")
    found = warnings(stage, "turn")
    assert len(found) == 6 and found[-1] == "subdivide: 3 more prims turn by half a turn or more between two times"


def test_meshes_hidden_by_a_scale_of_zero_are_named(stage):
    for name, scale in (("Rock", (0, 0, 0)), ("Flat", (1, 0, 1)), ("Tiny", (1e-6, 1e-6, 1e-6))):
        mesh = add_mesh(stage, f"/World/{name}", FALLING)
        animate(mesh, (0, 0, 1), (0, 0, 2), (0, 0, 3))
        operation = UsdGeom.Xformable(mesh).AddScaleOp()
        for time, value in ((0, (1, 1, 1)), (1, scale), (2, scale)):
            operation.Set(Gf.Vec3f(value), time)
    assert warnings(stage, "hidden") == [
        "/World/Rock is hidden by a scale of 0 at time 1: all of it is at one point there"
    ]


def test_matrices_of_zero_hide_all_meshes_below(stage):
    group = UsdGeom.Xform.Define(stage, "/World/Group")
    group.AddTransformOp().Set(Gf.Matrix4d(np.diag([0.0, 0.0, 0.0, 1.0])))
    for name in ("A", "B"):
        animate(add_mesh(stage, f"/World/Group/{name}", FALLING), (0, 0, 1), (0, 0, 2))
    (warning,) = warnings(stage, "hidden")
    assert warning.startswith("2 meshes are hidden by a scale of 0") and warning.endswith(
        "the first is /World/Group/A at time 0"
    )


def test_instances_hidden_by_a_scale_of_zero_are_named(stage):
    add_mesh(stage, "/World/Proto", FALLING)
    positions = [(x, 0, 1) for x in range(3)]
    add_instancer(stage, "/World/Instancer", {0: positions, 1: positions, 2: positions}, ["/World/Proto"])
    scales = UsdGeom.PointInstancer(stage.GetPrimAtPath("/World/Instancer")).CreateScalesAttr()
    for time, second in ((0, 1.0), (1, 0.0), (2, 0.5)):
        scales.Set([(1, 1, 1), (second,) * 3, (1, 0, 1)], time)
    (warning,) = warnings(stage, "hidden")
    assert warning.startswith("/World/Instancer[1]/Proto is hidden by a scale of 0 at time 1:")
