"""USD's shapes as polyhedra: their extents, volumes and collisions, from closed forms."""

import numpy as np
import pytest
from pxr import UsdGeom
from usd_stages import FALLING, add_falling, add_mesh, animate, find, moved, new_stage, save

import warp_bsc as bsc

TURN = {"X": 1, "Y": 2, "Z": 0}
"""How far the coordinates of a shape along z are rolled for each axis."""


@pytest.fixture
def stage(tmp_path):
    return new_stage(tmp_path / "scene.usda")


def add_shape(stage, schema, path="/World/Shape", **values):
    shape = schema.Define(stage, path)
    for name, value in values.items():
        attribute = shape.GetPrim().GetAttribute(name)
        if isinstance(value, dict):
            for time, at_time in value.items():
                attribute.Set(at_time, time)
        else:
            attribute.Set(value)
    return shape


def triangles_of(stage):
    interval = bsc.Scene(save(stage)).interval(0)
    return interval.x0[interval.segment.faces]


def volume(triangles):
    return np.einsum("ni,ni->n", triangles[:, 0], np.cross(triangles[:, 1], triangles[:, 2])).sum() / 6


@pytest.mark.parametrize("axis", "XYZ")
@pytest.mark.parametrize(
    ("schema", "values", "half", "exact", "missing"),
    [
        (UsdGeom.Capsule, {"radius": 0.5, "height": 3.0}, (0.5, 0.5, 2.0), np.pi * (0.25 * 3 + 0.5 / 3), 0.02),
        (UsdGeom.Cylinder, {"radius": 0.5, "height": 3.0}, (0.5, 0.5, 1.5), np.pi * 0.25 * 3, 0.01),
        (UsdGeom.Cone, {"radius": 0.5, "height": 3.0}, (0.5, 0.5, 1.5), np.pi * 0.25, 0.01),
    ],
)
def test_shapes_along_an_axis(stage, axis, schema, values, half, exact, missing):
    add_shape(stage, schema, axis=axis, **values)
    triangles = triangles_of(stage)
    corners = triangles.reshape(-1, 3)
    np.testing.assert_allclose(corners.max(axis=0), np.roll(half, TURN[axis]), atol=1e-12)
    np.testing.assert_allclose(corners.min(axis=0), -np.roll(half, TURN[axis]), atol=1e-12)
    assert (1 - missing) * exact < volume(triangles) < exact  # inscribed, its faces turned outwards


def test_the_apex_of_a_cone_is_up(stage):
    add_shape(stage, UsdGeom.Cone, axis="Y", radius=1.0, height=2.0)
    corners = triangles_of(stage).reshape(-1, 3)
    np.testing.assert_allclose(np.unique(corners[corners[:, 1] > 0.999].round(9), axis=0), [[0, 1, 0]])


def test_cubes_and_spheres(stage):
    add_shape(stage, UsdGeom.Cube, size=3.0)
    assert volume(triangles_of(stage)) == pytest.approx(27)
    stage.RemovePrim("/World/Shape")
    add_shape(stage, UsdGeom.Sphere, radius=2.0)
    triangles = triangles_of(stage)
    np.testing.assert_allclose(np.linalg.norm(triangles, axis=2), 2)
    assert 0.98 < volume(triangles) / (4 / 3 * np.pi * 8) < 1


@pytest.mark.parametrize(("axis", "half"), [("X", (0, 2, 1)), ("Y", (1, 0, 2)), ("Z", (1, 2, 0))])
def test_planes(stage, axis, half):
    """The width is along x, or z for axis X; the length along y, or z for axis Y."""
    add_shape(stage, UsdGeom.Plane, axis=axis, width=2.0, length=4.0)
    triangles = triangles_of(stage)
    np.testing.assert_array_equal(triangles.reshape(-1, 3).max(axis=0), half)
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    np.testing.assert_array_equal(np.sign(normals), [np.roll([0, 0, 1], TURN[axis])] * 2)


def test_a_ball_falls_on_a_plane(stage):
    add_shape(stage, UsdGeom.Plane, path="/World/Ground", axis="Z", width=8.0, length=8.0)
    animate(add_shape(stage, UsdGeom.Sphere, path="/World/Ball", radius=1.0), (0.25, 0.5, 3), (0.25, 0.5, -1))
    found = find(stage)
    assert found["meshes"] == ["/World/Ground", "/World/Ball"]
    first = min(
        (contact for interval in found["intervals"] for contact in interval["contacts"]), key=lambda c: c["time"]
    )
    assert first["prims"] == ["/World/Ball", "/World/Ground"]
    assert first["time"] == pytest.approx(0.5, abs=1e-5)
    assert first["position"] == pytest.approx([0.25, 0.5, 0], abs=1e-5)
    assert any("1 Plane, 1 Sphere" in warning for warning in found["warnings"])


def test_a_growing_ball(stage):
    add_shape(stage, UsdGeom.Sphere, radius={0: 1.0, 2: 3.0})
    add_mesh(stage, "/World/Wall", [(2, -9, -9), (2, 9, -9), (2, 0, 9)])
    found = find(stage)
    times = [contact["time"] for interval in found["intervals"] for contact in interval["contacts"]]
    assert min(times) == pytest.approx(1, abs=1e-5)


def test_shapes_in_instancers_and_under_transforms(stage):
    add_falling(stage)
    UsdGeom.Xform.Define(stage, "/World/Group").AddTranslateOp().Set((0, 0, -1))
    add_shape(stage, UsdGeom.Cube, path="/World/Group/Box", size=2.0)
    found = find(stage)
    assert {tuple(pair["meshes"]) for pair in found["mesh_pairs"]} == {("/World/Falling", "/World/Group/Box")}
    add_mesh(stage, "/World/Far", moved(FALLING, (0, 0, 9)))
    assert find(stage, "--exclude", "/World/Group")["mesh_pairs"] == []
