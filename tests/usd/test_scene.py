"""The USD reader, on small stages written here."""

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom

from warp_bsc.usd.read.triangulation import triangulate
from warp_bsc.usd.scene import Scene

TRIANGLE = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]


@pytest.fixture
def stage(tmp_path):
    return Usd.Stage.CreateNew(str(tmp_path / "scene.usda"))


def add_mesh(stage, path, points, counts=(3,), indices=(0, 1, 2)):
    """Points: one list, or a dictionary of lists by time."""
    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreateFaceVertexCountsAttr(list(counts))
    mesh.CreateFaceVertexIndicesAttr(list(indices))
    if isinstance(points, dict):
        for time, value in points.items():
            mesh.CreatePointsAttr().Set(value, time)
    else:
        mesh.CreatePointsAttr(points)
    return mesh


def moved(by, points=TRIANGLE):
    return [tuple(map(float, np.add(point, by))) for point in points]


def read(stage, **options):
    stage.GetRootLayer().Save()
    return Scene(stage.GetRootLayer().realPath, **options)


def first_segment(scene):
    return scene.interval(0).segment


def error_of(stage):
    with pytest.raises(ValueError) as error:
        scene = read(stage, strict=True)
        for _ in scene:
            pass
    message = str(error.value)
    assert message.startswith(stage.GetRootLayer().realPath + ": ")
    assert "\n" not in message
    return message


def test_points_without_transform_are_read_as_stored(stage):
    end = [(0.1, 0.2, 0.3), (1.1, 0, 0), (0, 1.1, 0)]
    add_mesh(stage, "/World/Cloth", {1: TRIANGLE, 2.5: end})
    scene = read(stage)
    assert scene.times == [1, 2.5]
    assert first_segment(scene).faces.tolist() == [[0, 1, 2]] and first_segment(scene).faces.dtype == np.int32
    assert first_segment(scene).vertex_count == 3
    assert first_segment(scene).positions(2.5).dtype == np.float32
    np.testing.assert_array_equal(first_segment(scene).positions(2.5), np.array(end, np.float32))
    assert scene.warnings == []


def test_meshes_are_merged_at_the_times_of_all(stage):
    add_mesh(stage, "/A", {0: TRIANGLE, 10: moved((10, 0, 0))})
    add_mesh(stage, "/B", {5: moved((0, 0, 5)), 7: moved((0, 0, 7))})
    add_mesh(stage, "/C", {3: moved((0, 0, 9))})  # one sample is no motion
    scene = read(stage)
    assert scene.times == [0, 5, 7, 10]
    assert [mesh.moves for mesh in first_segment(scene).meshes] == [True, True, False]
    positions = first_segment(scene).positions(5)
    np.testing.assert_allclose(positions[0], (5, 0, 0))
    np.testing.assert_allclose(positions[3], (0, 0, 5))
    np.testing.assert_allclose(first_segment(scene).positions(0)[3], (0, 0, 5))  # held before the first sample
    np.testing.assert_allclose(first_segment(scene).positions(10)[3], (0, 0, 7))
    np.testing.assert_allclose(first_segment(scene).positions(10)[6], (0, 0, 9))
    meshes, points = first_segment(scene).locate_vertices(np.array([0, 4, 8]))
    assert (meshes.tolist(), points.tolist()) == ([0, 1, 2], [0, 1, 2])
    meshes, polygons = first_segment(scene).locate_faces([2])
    assert (meshes.tolist(), polygons.tolist()) == ([2], [0])


def test_transforms_nest_in_double_precision(stage):
    add_mesh(stage, "/World/Group/Mesh", TRIANGLE)
    UsdGeom.XformCommonAPI(UsdGeom.Xform.Define(stage, "/World")).SetTranslate((0.1, 0, 0))
    group = UsdGeom.Xform.Define(stage, "/World/Group")
    group.AddRotateZOp().Set(90)
    group.AddScaleOp().Set(Gf.Vec3f(2, 3, 4))
    translate = UsdGeom.Xformable(stage.GetPrimAtPath("/World/Group/Mesh")).AddTranslateOp()
    for time, x in [(0, 0), (1, 1), (3, 2)]:
        translate.Set((x, 1, 0), time)
    scene = read(stage)
    assert scene.times == [0, 1, 3]
    assert first_segment(scene).positions(0).dtype == np.float64
    expected = np.add(TRIANGLE, (1.5, 1, 0))
    x, y, z = (expected * (2, 3, 4)).T
    np.testing.assert_allclose(
        first_segment(scene).positions(2), np.stack([0.1 - y, x, z], axis=1), rtol=1e-15, atol=1e-15
    )


def test_transform_that_starts_as_the_identity(stage):
    translate = add_mesh(stage, "/Mesh", TRIANGLE).AddTranslateOp()
    translate.Set((0, 0, 0), 0)
    translate.Set((0, 0, 0.1), 1)
    scene = read(stage)
    assert scene.dtype == np.float64
    np.testing.assert_array_equal(first_segment(scene).positions(1)[:, 2], 0.1)


def test_reset_of_the_transform_stack(stage):
    world = UsdGeom.Xform.Define(stage, "/World")
    translate = world.AddTranslateOp()
    translate.Set((0, 0, 0), 0)
    translate.Set((100, 0, 0), 8)
    mesh = add_mesh(stage, "/World/Mesh", TRIANGLE)
    mesh.SetResetXformStack(True)
    translate = mesh.AddTranslateOp()
    translate.Set((0, 0, 0), 1)
    translate.Set((0, 0, 1), 2)
    scene = read(stage)
    assert scene.times == [1, 2]  # not those of /World
    np.testing.assert_array_equal(first_segment(scene).positions(2), moved((0, 0, 1)))


def test_transform_that_is_sampled_but_constant_is_no_motion(stage):
    add_mesh(stage, "/Cloth", {0: TRIANGLE, 1: moved((0, 0, 1))})
    shape = add_mesh(stage, "/Shape", moved((0, 0, -1)))
    translate = shape.AddTranslateOp()
    for time in (0, 0.5, 1):
        translate.Set((0, 0, 0), time)
    scene = read(stage)
    assert scene.times == [0, 1]
    assert scene.dtype == np.float32
    assert not first_segment(scene).meshes[1].moves


def test_native_instances_are_read(stage):
    add_mesh(stage, "/Prototype/Mesh", {0: TRIANGLE, 1: moved((0, 0, 1))})
    stage.GetPrimAtPath("/Prototype").SetSpecifier(Sdf.SpecifierClass)
    for number, name in enumerate(("/One", "/Two")):
        prim = UsdGeom.Xform.Define(stage, name)
        prim.AddTranslateOp().Set((10 * number, 0, 0))
        prim.GetPrim().GetReferences().AddInternalReference("/Prototype")
        prim.GetPrim().SetInstanceable(True)
    scene = read(stage)
    assert [mesh.path for mesh in first_segment(scene).meshes] == ["/One/Mesh", "/Two/Mesh"]
    np.testing.assert_array_equal(first_segment(scene).positions(1)[[0, 3]], [(0, 0, 1), (10, 0, 1)])


def test_polygons_become_triangles(stage):
    points = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (2, 0, 0), (2, 1, 0), (3, 0.5, 0)]
    add_mesh(stage, "/Quads", {0: points, 1: moved((0, 0, 1), points)}, (4, 3, 5), (0, 1, 2, 3, 0, 1, 3, 1, 4, 6, 5, 2))
    scene = read(stage)
    assert first_segment(scene).faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 1, 3], [1, 4, 6], [1, 6, 5], [1, 5, 2]]
    assert first_segment(scene).locate_faces(np.arange(6))[1].tolist() == [0, 0, 1, 2, 2, 2]


@pytest.mark.parametrize("rotation", range(6))
@pytest.mark.parametrize("direction", [1, -1])
def test_concave_polygons_are_covered_exactly(rotation, direction):
    outline = np.array([(0, 0), (3, 0), (3, 1), (1, 1), (1, 3), (0, 3)], float)  # an L of area 5
    tilt = np.array([(0.5, 0.2, 0.8), (-0.1, 1, 0.3)])
    points = np.roll(outline, rotation, axis=0)[::direction] @ tilt
    triangles, polygons = triangulate(np.array([6]), np.arange(6), points)
    assert polygons.tolist() == [0] * 4
    a, b, c = points[triangles].transpose(1, 0, 2)
    normals = np.cross(b - a, c - a) / 2
    expected = direction * 5 * np.cross(*tilt)
    np.testing.assert_allclose(normals.sum(axis=0), expected)
    assert (normals @ expected > 0).all()  # none turned over: together they cover the L and nothing else


def test_holes_and_unused_points_are_left_out(stage):
    points = [(9, 9, 9), *TRIANGLE, (1, 1, 0)]
    mesh = add_mesh(stage, "/M", {0: points, 1: moved((0, 0, 1), points)}, (3, 3), (1, 2, 3, 2, 4, 3))
    mesh.CreateHoleIndicesAttr([0])
    scene = read(stage)
    assert first_segment(scene).vertex_count == 3
    assert first_segment(scene).faces.tolist() == [[1, 2, 0]] or first_segment(scene).faces.tolist() == [[0, 2, 1]]
    assert sorted(first_segment(scene).locate_vertices(np.arange(3))[1].tolist()) == [2, 3, 4]
    assert first_segment(scene).locate_faces([0])[1].tolist() == [1]


def test_vertices_in_one_place_at_all_times_are_welded(stage):
    lower, upper = TRIANGLE, [(1, 0, 0), (0, 1, 0), (1, 1, 0)]
    add_mesh(stage, "/Lower", {0: lower, 1: moved((0, 0, 1), lower), 2: lower})
    add_mesh(stage, "/Upper", {0: upper, 1: [(1, 0, 1), (0, 1, 0.5), (1, 1, 1)], 2: upper})
    scene = read(stage)
    assert first_segment(scene).vertex_count == 5  # (0, 1, 0) parts at time 1
    assert len(set(first_segment(scene).faces[0]) & set(first_segment(scene).faces[1])) == 1
    np.testing.assert_array_equal(
        first_segment(scene).positions(1)[first_segment(scene).faces[1]], [(1, 0, 1), (0, 1, 0.5), (1, 1, 1)]
    )
    assert "welded: 1" in scene.warnings[0]


def test_what_is_passed_over_is_named(stage):
    add_mesh(stage, "/World/Cloth", {0: TRIANGLE, 1: moved((0, 0, 1))})
    hidden = add_mesh(stage, "/World/Hidden", TRIANGLE)
    hidden.CreateVisibilityAttr("invisible")
    UsdGeom.BasisCurves.Define(stage, "/World/Hair")
    add_mesh(stage, "/World/Stand_in", TRIANGLE).CreatePurposeAttr("proxy")
    scene = read(stage)
    assert [mesh.path for mesh in first_segment(scene).meshes] == ["/World/Cloth"]
    warnings = "\n".join(scene.warnings)
    for part in ("1, the first is /World/Hidden", "are not checked: 1 BasisCurves", "purpose proxy are not checked: 1"):
        assert part in warnings


def test_mesh_that_is_shown_later_is_read(stage):
    mesh = add_mesh(stage, "/Cloth", {0: TRIANGLE, 1: moved((0, 0, 1))})
    mesh.CreateVisibilityAttr().Set("invisible", 0)
    mesh.GetVisibilityAttr().Set("inherited", 1)
    assert [mesh.name for mesh in first_segment(read(stage)).meshes] == []


def test_missing_file(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nothing\.usd: no such file"):
        Scene(tmp_path / "nothing.usd")


@pytest.mark.parametrize("content", ["", "hello", "#usda 1.0\ndef Mesh {{"])
def test_file_that_is_not_usd(tmp_path, capfd, content):
    path = tmp_path / "wrong.usda"
    path.write_text(content)
    with pytest.raises(ValueError, match=r"wrong\.usda: not a readable USD file") as error:
        Scene(path)
    assert "\n" not in str(error.value)
    assert capfd.readouterr().err == ""  # pxr's own messages


def test_unresolved_reference(stage, capfd):
    add_mesh(stage, "/Cloth", {0: TRIANGLE, 1: moved((0, 0, 1))})
    stage.DefinePrim("/World/Prop").GetReferences().AddReference("gone.usda")
    capfd.readouterr()
    message = error_of(stage)
    assert "gone.usda" in message and "/World/Prop" in message
    assert capfd.readouterr().err == ""


def test_no_mesh(stage):
    UsdGeom.Xform.Define(stage, "/World")
    assert "no visible mesh" in error_of(stage)


def test_nothing_moves(stage):
    add_mesh(stage, "/Cloth", TRIANGLE)
    stage.SetStartTimeCode(7)
    scene = read(stage)
    assert scene.is_still and scene.times == [7, 7] and len(scene) == 1
    assert scene.warnings == ["nothing moves: checked at rest, at time 7"]
    np.testing.assert_array_equal(scene.interval(0).x0, TRIANGLE)
    np.testing.assert_array_equal(scene.interval(0).x1, TRIANGLE)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_points_that_are_not_finite(stage, bad):
    add_mesh(stage, "/Cloth", {0: TRIANGLE, 1: TRIANGLE, 2: [(0, 0, 0), (1, 0, 0), (0, bad, 0)]})
    message = error_of(stage)
    for part in ("/Cloth", "vertex 2", "time 2", str(bad)):
        assert part in message


def test_number_of_points_that_changes_without_the_topology(stage):
    add_mesh(stage, "/Cloth", {0: TRIANGLE, 1: [*TRIANGLE, (1, 1, 1)]})
    message = error_of(stage)
    assert "/Cloth" in message and "4 points at time 1, but 3 at first" in message


def test_topology_that_is_sampled_but_constant(stage):
    mesh = add_mesh(stage, "/Cloth", {0: TRIANGLE, 1: moved((0, 0, 1))})
    for time in (0, 1):
        mesh.GetFaceVertexIndicesAttr().Set([0, 1, 2], time)
    assert first_segment(read(stage)).faces.tolist() == [[0, 1, 2]]


@pytest.mark.parametrize(
    ("points", "counts", "indices", "message"),
    [
        (TRIANGLE, [3], [0, 1, 7], "face 0 refers to vertex 7, but the mesh has 3 points"),
        (TRIANGLE, [3, 3], [0, 1, 2, 0, -1, 2], "face 1 refers to vertex -1"),
        (TRIANGLE, [3, 3], [0, 1, 2], "faceVertexCounts add up to 6, but there are 3 faceVertexIndices"),
        (TRIANGLE, [3, 2], [0, 1, 2, 0, 1], "face 1 has 2 vertices"),
        ([], [3], [0, 1, 2], "the mesh has no points at time 0"),
    ],
)
def test_broken_mesh(stage, points, counts, indices, message):
    add_mesh(stage, "/Cloth", {0: TRIANGLE, 1: moved((0, 0, 1))})
    add_mesh(stage, "/World/Broken", points, counts, indices)
    assert f"/World/Broken: {message}" in error_of(stage)
