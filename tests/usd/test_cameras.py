"""The cameras of a stage: what they see is what OpenUSD's frustum sees."""

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom

from warp_bsc.usd.cameras import find_cameras, read_camera


def add_camera(stage, path, **attributes):
    camera = UsdGeom.Camera.Define(stage, path)
    for name, value in attributes.items():
        camera.GetPrim().GetAttribute(name).Set(value)
    return camera


def seen(camera, point, row):
    """Where a camera sees a point, from -1 at the left and the bottom of what it sees to 1."""
    axes, window = (rows[min(row, len(rows) - 1)] for rows in (camera.axes, camera.window))
    x, y, z = axes[:3] @ (np.array(point) - axes[3])
    if camera.is_perspective:
        x, y = x / -z, y / -z
    low, high = window[::2], window[1::2]
    return 2 * (np.array([x, y]) - low) / (high - low) - 1


@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
def test_cameras_see_as_their_frustums_do(projection):
    stage = Usd.Stage.CreateInMemory()
    lens = {"horizontalAperture": 36.0, "verticalAperture": 20.0, "horizontalApertureOffset": 3.0}
    camera = add_camera(stage, "/World/Rig/Shot", projection=projection, verticalApertureOffset=-2.0, **lens)
    camera.GetFocalLengthAttr().Set(35.0, 0)
    camera.GetFocalLengthAttr().Set(50.0, 2)
    rig = UsdGeom.Xformable(stage.DefinePrim("/World/Rig", "Xform"))
    rig.AddScaleOp().Set((2, 2, 2))
    turn = UsdGeom.Xformable(camera).AddTransformOp()
    for time in (0, 2):
        eye = Gf.Vec3d(3, 1 + time, 4)
        turn.Set(Gf.Matrix4d().SetLookAt(eye, Gf.Vec3d(0, time, 0), Gf.Vec3d(0, 1, 0)).GetInverse(), time)
    read = read_camera(camera, [0, 1, 2])
    assert read.path == "/World/Rig/Shot" and read.is_perspective == (projection == "perspective")
    assert read.axes.shape == (3, 4, 3) and read.window.shape == (3, 4)
    for row, time in enumerate((0, 1, 2)):
        frustum = camera.GetCamera(time).frustum
        matrix = frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()
        np.testing.assert_allclose(read.axes[row, :3] @ read.axes[row, :3].T, np.eye(3), atol=1e-12)
        for point in ((0, 0, 0), (0.3, -0.4, 0.5), (-1, 2, -0.2)):
            expected = matrix.Transform(Gf.Vec3d(*point))
            np.testing.assert_allclose(seen(read, point, row), expected[:2], atol=1e-6)


def test_cameras_that_stand_still_have_one_row():
    stage = Usd.Stage.CreateInMemory()
    camera = add_camera(stage, "/Camera", focalLength=35.0)
    read = read_camera(camera, [0.0, 1.0, 5.0])
    assert read.axes.shape == (1, 4, 3) and read.window.shape == (1, 4)
    np.testing.assert_array_equal(read.axes[0], [(1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, 0)])


def test_cameras_that_look_nowhere_are_none():
    stage = Usd.Stage.CreateInMemory()
    flat, nowhere = add_camera(stage, "/Flat", horizontalAperture=0.0), add_camera(stage, "/Nowhere")
    UsdGeom.Xformable(nowhere).AddScaleOp().Set((1, 1, 0))
    assert read_camera(flat, [0.0]) is None and read_camera(nowhere, [0.0]) is None


def test_cameras_of_instances_are_found_and_inactive_ones_not():
    stage = Usd.Stage.CreateInMemory()
    add_camera(stage, "/Class/Camera")
    stage.GetPrimAtPath("/Class").SetSpecifier(Sdf.SpecifierClass)
    instance = stage.DefinePrim("/World/Instance", "Xform")
    instance.GetReferences().AddInternalReference("/Class")
    instance.SetInstanceable(True)
    add_camera(stage, "/World/Off").GetPrim().SetActive(False)
    add_camera(stage, "/World/On")
    paths = [str(camera.GetPath()) for camera in find_cameras(stage)]
    assert paths == ["/World/Instance/Camera", "/World/On"]
