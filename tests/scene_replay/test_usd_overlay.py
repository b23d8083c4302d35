"""The overlay: a USD layer over the scene that shows what a replay finds."""

import json
import shutil
import struct
from pathlib import Path

import numpy as np
import pytest
from pxr import Sdf, Usd, UsdGeom, UsdShade, UsdUtils
from replay_files import (
    Page,
    errors_of,
    falling_through_quads,
    left_behind,
    near_and_inside_stage,
    prims_of_pairs,
    read_contacts,
    read_polygons,
    replay,
)
from usd_stages import FALLING, FLOOR, add_floor, add_instancer, add_mesh, falling, moved, new_stage, save, with_names

import warp_bsc as bsc
from warp_bsc.cli.main import main
from warp_bsc.scene_replay.usd_overlay import COLORS, LIFT
from warp_bsc.usd.write import layer_writer

ASSETS = Path(__file__).resolve().parents[2] / "assets"


@pytest.fixture
def stage(tmp_path):
    return falling_through_quads(tmp_path)


def read_curves(overlay, time, root="/Collisions"):
    """The ends of the segments in which triangles meet."""
    segments = [np.zeros((0, 2, 3))]
    for curves in map(UsdGeom.BasisCurves, prims_of_pairs(overlay, "Intersections", root)):
        counts = curves.GetCurveVertexCountsAttr().Get(time)
        assert set(counts) <= {2} and curves.GetTypeAttr().Get() == UsdGeom.Tokens.linear
        segments.append(np.array(curves.GetPointsAttr().Get(time)).reshape(-1, 2, 3))
    return np.concatenate(segments)


@pytest.mark.parametrize("suffix", ["usda", "usdc", "usd"])
def test_overlay(stage, tmp_path, suffix):
    scene = Path(save(stage))
    before = scene.read_bytes()
    path = tmp_path / f"overlay.{suffix}"
    assert main(["replay", str(scene), "--device", "cpu", "--overlay", str(path)]) == 0
    assert scene.read_bytes() == before
    assert path.read_bytes().startswith(b"#usda" if suffix == "usda" else b"PXR-USDC")
    overlay = Usd.Stage.Open(str(path))
    assert errors_of(overlay) == []
    assert overlay.GetRootLayer().subLayerPaths == ["./scene.usda"]
    assert [spec.name for spec in overlay.GetRootLayer().rootPrims] == ["Collisions"]  # the scene's stay untouched
    assert overlay.GetPrimAtPath("/World/Falling").IsA(UsdGeom.Mesh)
    points, primvars = read_contacts(overlay, 2)
    np.testing.assert_allclose(points, [(0.5, -0.5, 0)], atol=1e-6)
    assert primvars["toi"] == pytest.approx([0.5], abs=1e-5)
    assert (primvars["primA"], primvars["elementA"]) == (["/World/Falling"], [(0, -1)])
    assert (primvars["primB"], primvars["elementB"]) == (["/World/Floor"], [(1, -1)])
    contacts = overlay.GetPrimAtPath("/Collisions/Floor_with_Falling/VertexFace")
    for time in (0, 1, 3, 4):
        assert len(read_contacts(overlay, time)[0]) == len(read_polygons(overlay, time)) == 0
    low, high = contacts.GetAttribute("extent").Get(2)
    assert np.all(np.array(low) < points[0]) and np.all(points[0] < np.array(high))
    assert left_behind(tmp_path) == []


def test_overlay_emits_light_and_is_a_guide(stage, tmp_path):
    replay(stage)
    overlay = Usd.Stage.Open(str(tmp_path / "overlay.usda"))
    shown = {"Polygons": "Polygons", "VertexFace/Marker": "VertexFace", "Intersections": "Intersections"}
    for path, name in shown.items():
        prim = overlay.GetPrimAtPath(f"/Collisions/Floor_with_Falling/{path}")
        assert UsdGeom.Imageable(prim).ComputePurpose() == UsdGeom.Tokens.guide
        material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
        shader, _, _ = material.ComputeSurfaceSource()
        assert shader.GetShaderId() == "UsdPreviewSurface"
        assert tuple(shader.GetInput("emissiveColor").Get()) == pytest.approx(COLORS[name])
    assert len(set(COLORS.values())) == len(COLORS)


@pytest.mark.parametrize("suffix", ["usda", "usdc"])
def test_overlay_lifts_the_polygons_that_collide_and_moves_them(stage, tmp_path, suffix):
    path = tmp_path / f"overlay.{suffix}"
    assert main(["replay", save(stage), "--device", "cpu", "--overlay", str(path)]) == 0
    overlay = Usd.Stage.Open(str(path))
    lift = LIFT * np.linalg.norm(np.ptp(FALLING, axis=0))  # of what moves
    floor = np.array([(-2, -2, lift), (2, -2, lift), (2, 2, lift), (-2, 2, lift)])
    for time, height in ((2, 0.25), (2.5, 0), (2.9999, -0.24995)):
        triangles = read_polygons(overlay, time)
        assert len(triangles) == 2 * (1 + 2)  # one, and the quad's two, on both sides
        normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        above = triangles[
            (triangles.max(axis=(1, 2)) < 3) & (np.abs(triangles[:, :, 2] - lift) < lift / 10).all(axis=1)
        ]
        np.testing.assert_allclose(np.unique(above.reshape(-1, 3), axis=0), np.unique(floor, axis=0), rtol=1e-6)
        own = [t for t in triangles if np.ptp(t[:, 2]) > 0.1]
        assert len(own) == 2
        np.testing.assert_allclose(
            np.mean(own, axis=(0, 1)), np.mean(moved(FALLING, (0, 0, height)), axis=0), atol=2e-6
        )
        normal = np.cross(np.subtract(FALLING[1], FALLING[0]), np.subtract(FALLING[2], FALLING[0]))
        across = (own[0].mean(axis=0) - own[1].mean(axis=0)) @ normal / np.linalg.norm(normal)
        assert abs(across) == pytest.approx(2 * lift, rel=1e-2)
        # Both sides face outwards.
        for triangle, way in zip(triangles, normals, strict=True):
            surface = moved(FALLING, (0, 0, height)) if np.ptp(triangle[:, 2]) > 0.1 else FLOOR
            assert (triangle.mean(axis=0) - surface[0]) @ way > 0


def test_overlay_has_the_curves_along_which_surfaces_cut(tmp_path):
    """A triangle stands still in the floor from time 1 on: they meet along a segment known beforehand."""
    stage = new_stage(tmp_path / "scene.usda")
    add_floor(stage)
    upright = [(0.5, -1.0, -0.5), (1.5, -1.0, -0.5), (1.0, -1.0, 0.5)]  # meets z = 0 from x = 0.75 to 1.25
    places = {0: (0, 0, 3), 1: (0, 0, 0), 2: (0, 0, 0), 3: (0, 0.25, 0), 4: (0, 0, 3)}
    add_mesh(stage, "/World/Falling", {time: moved(upright, by) for time, by in places.items()})
    segments = {1: [(0.75, -1, 0), (1.25, -1, 0)], 3: [(0.75, -0.75, 0), (1.25, -0.75, 0)], None: []}
    samples = {0: None, 0.999: None, 1: 1, 1.5: 1, 2: 1, 2.75: 1, 3: 3, 3.5: 3, 4: None, 5: None}
    for options, last in (((), 6), (("--frames", "0:3"), 3)):
        replay(stage, *options)
        overlay = Usd.Stage.Open(str(tmp_path / "overlay.usda"))
        overlay.Reload()  # the second time
        assert errors_of(overlay) == []
        for time, sample in samples.items():
            ends = read_curves(overlay, time).reshape(-1, 3)
            expected = segments[sample if time < last else 3]  # from the last time on, those of the last time
            assert (len(ends) > 0) == (len(expected) > 0)
            if expected:
                a, b = np.array(expected)
                along = (ends - a) @ (b - a) / ((b - a) @ (b - a))  # 0 at a, 1 at b
                np.testing.assert_allclose(ends, a + along[:, None] * (b - a), atol=1e-6)
                assert (along.min(), along.max()) == pytest.approx((0, 1), abs=1e-6)
        prims = overlay.GetPrimAtPath("/Collisions").GetAttribute("prims").Get()
        api = UsdGeom.PrimvarsAPI(*prims_of_pairs(overlay, "Intersections"))
        names = {prims[value] for name in ("primA", "primB") for value in api.GetPrimvar(name).Get(1)}
        assert names == {"/World/Floor", "/World/Falling"}


@pytest.fixture
def near_and_inside(tmp_path):
    return near_and_inside_stage(tmp_path)


@pytest.mark.parametrize("suffix", ["usda", "usdc"])
def test_overlay_has_what_is_near_and_inside(near_and_inside, tmp_path, suffix):
    path = tmp_path / f"overlay.{suffix}"
    arguments = ["replay", save(near_and_inside), "--device", "cpu", "--overlay", str(path)]
    assert main([*arguments, "--clearance", "0.3"]) == 0
    overlay = Usd.Stage.Open(str(path))
    assert errors_of(overlay) == []
    names = overlay.GetPrimAtPath("/Collisions").GetAttribute("prims").Get()
    near, inside = (UsdGeom.PointInstancer(*prims_of_pairs(overlay, name)) for name in ("Near", "Inside"))
    places = [[*map(tuple, near.GetPositionsAttr().Get(time))] for time in (0, 0.5, 1, 1.5, 2)]
    assert places == [[], [], [(0.5, -0.5, 0.125)], [(0.5, -0.5, 0.125)], [(0.5, -0.5, 0.0625)]]
    primvars = UsdGeom.PrimvarsAPI(near)
    values = {name: primvars.GetPrimvar(name).Get(2)[0] for name in ("distance", "primA", "primB", "elementA")}
    assert values["distance"] == 0.125 and tuple(values["elementA"]) == (0, -1)
    assert [names[values[name]] for name in ("primA", "primB")] == ["/World/Falling", "/World/Floor"]
    for time in (0, 1.5, 2):
        (place,) = inside.GetPositionsAttr().Get(time)
        np.testing.assert_allclose(np.abs(np.subtract(place, (0, 0, 3))), 0.125, atol=1e-6)
        numbers = [UsdGeom.PrimvarsAPI(inside).GetPrimvar(name).Get(time)[0] for name in ("primA", "primB")]
        assert [names[number] for number in numbers] == ["/World/Inside", "/World/Case"]
    for instancer in (near, inside):
        name, marker = instancer.GetPrim().GetName(), instancer.GetPrim().GetChild("Marker")
        assert UsdGeom.Imageable(marker).ComputePurpose() == UsdGeom.Tokens.guide
        assert tuple(marker.GetAttribute("primvars:displayColor").Get()[0]) == pytest.approx(COLORS[name])
    assert main([*arguments, "--no-intersections"]) == 0
    overlay = Usd.Stage.Open(str(tmp_path / f"overlay.{suffix}"))
    overlay.Reload()
    assert prims_of_pairs(overlay, "Near") == prims_of_pairs(overlay, "Inside") == []


def test_overlay_shows_nothing_between_its_samples(tmp_path):
    stage = new_stage(tmp_path / "scene.usda")
    add_floor(stage)
    places = [(0, 0.25), (0, -0.25), (0.4, 0.25), (0.4, -0.25), (0.4, -0.3), (0, 0.25), (0, 1)]
    add_mesh(stage, "/World/Falling", {3 * time: moved(FALLING, (x, 0, z)) for time, (x, z) in enumerate(places)})
    found = json.loads(replay(stage)[0].read_text())
    overlay = Usd.Stage.Open(str(tmp_path / "overlay.usda"))
    at_start = [[contact["position"] for contact in interval["contacts"]] for interval in found["intervals"]]
    assert [len(points) > 0 for points in at_start] == [True, True, True, False, True, False]
    extents = [
        prim.GetAttribute("extent") for kind in ("VertexFace", "EdgeEdge") for prim in prims_of_pairs(overlay, kind)
    ]
    for time in (0, 1, 2.999, 3, 4.5, 5.999, 6, 7, 9, 10, 11.999, 12, 13, 14.999, 15, 16.5, 18, 20):
        expected = at_start[int(time // 3)] if time < 18 else []
        points, primvars = read_contacts(overlay, time)
        np.testing.assert_array_equal(points, np.float32(expected).reshape(-1, 3))
        assert {len(values) for values in primvars.values()} == {len(expected)}
        corners = np.concatenate([extent.Get(time) for extent in extents])
        assert np.all(corners.min(axis=0) <= points) and np.all(points <= corners.max(axis=0))
        assert (len(read_polygons(overlay, time)) > 0) == bool(expected)
    assert errors_of(overlay) == []


def test_overlay_of_a_scene_whose_default_prim_is_not_there(stage, tmp_path):
    stage.GetRootLayer().defaultPrim = "Gone"
    replay(stage)
    assert Usd.Stage.Open(str(tmp_path / "overlay.usda")).GetDefaultPrim().GetPath() == "/World"


def test_meters_per_unit_stored_as_a_float(stage, tmp_path):
    UsdGeom.SetStageMetersPerUnit(stage, float(np.float32(0.01)))
    stage.GetRootLayer().Export(str(tmp_path / "doubles.usdc"))
    data = (tmp_path / "doubles.usdc").read_bytes()
    stored = struct.pack("<fHBB", 0.01, 0, 9, 0x40)  # the number, its type (9: double, 8: float), that it is inline
    assert data.count(stored) == 1
    (tmp_path / "floats.usdc").write_bytes(data.replace(stored, stored[:6] + b"\x08\x40"))
    found = json.loads(replay(tmp_path / "floats.usdc")[0].read_text())
    assert found["hits"] == 1
    assert found["meters_per_unit"] == pytest.approx(0.01, rel=1e-6)
    assert UsdGeom.GetStageMetersPerUnit(Usd.Stage.Open(str(tmp_path / "overlay.usda"))) == found["meters_per_unit"]


def test_overlay_of_instances_a_package_and_another_overlay(tmp_path):
    stage = new_stage(tmp_path / "asset.usda")
    add_floor(stage)
    add_mesh(stage, "/World/Prototype/Mesh", falling(0.25, -0.25))
    stage.GetPrimAtPath("/World/Prototype").SetSpecifier(Sdf.SpecifierClass)
    one = UsdGeom.Xform.Define(stage, "/World/One").GetPrim()
    one.GetReferences().AddInternalReference("/World/Prototype")
    one.SetInstanceable(True)
    package = tmp_path / "scene.usdz"
    assert UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(save(stage)), str(package))
    replay(package)
    overlay = Usd.Stage.Open(str(tmp_path / "overlay.usda"))
    assert overlay.GetPrimAtPath("/World/One").IsInstance()
    assert len(read_polygons(overlay, 0)) == 2 * (1 + 2)
    assert len(read_contacts(overlay, 0)[0]) == 1

    again = tmp_path / "again"
    again.mkdir()
    assert main(["replay", str(tmp_path / "overlay.usda"), "--device", "cpu", "--overlay", str(again / "o.usda")]) == 0
    second = Usd.Stage.Open(str(again / "o.usda"))
    assert second.GetRootLayer().subLayerPaths == ["../overlay.usda"]
    np.testing.assert_array_equal(read_contacts(second, 0)[0], read_contacts(second, 0, root="/Collisions_")[0])


def test_overlay_shows_the_polygons_of_instancers_too(tmp_path):
    stage = new_stage(tmp_path / "scene.usda")
    add_floor(stage)
    add_mesh(stage, "/World/Instancer/Prototype", FALLING)
    add_instancer(stage, "/World/Instancer", {0: [(0, 0, 0.25)], 1: [(0, 0, -0.25)]}, ["/World/Instancer/Prototype"])
    replay(stage)
    overlay = Usd.Stage.Open(str(tmp_path / "overlay.usda"))
    assert len(read_polygons(overlay, 0)) == 2 * (1 + 2)


def test_overlay_and_page_of_a_still_stage(tmp_path):
    """A stage in which nothing moves is one interval without length: what intersects there stays."""
    stage = new_stage(tmp_path / "scene.usda")
    add_floor(stage)
    add_mesh(stage, "/World/Upright", [(0.5, -1.0, -0.5), (1.5, -1.0, -0.5), (1.0, -1.0, 0.5)])
    replay(stage)
    overlay = Usd.Stage.Open(str(tmp_path / "overlay.usda"))
    assert errors_of(overlay) == []
    for time in (Usd.TimeCode.EarliestTime(), 0, 5):
        ends = read_curves(overlay, time).reshape(-1, 3)
        assert (ends[:, 0].min(), ends[:, 0].max()) == pytest.approx((0.75, 1.25), abs=1e-6)
    page = Page((tmp_path / "page.html").read_text())
    (start, end, *hits), ((time, crossings, touches, _),) = page.data["intervals"][0], page.data["rest"]
    assert start == end == time and hits == [0, 0] and crossings + touches > 0
    assert page.data["rows"] == [[0, crossings + touches, 0], [0, 0, 0]]
    assert page.blocks == {"rest-0", "view-0", "faces-0"}


def test_overlay_where_the_topology_changes(tmp_path):
    stage = new_stage(tmp_path / "scene.usda")
    add_floor(stage)
    quad = [*FALLING, (0.9, -0.9, 1.0)]
    mesh = add_mesh(stage, "/World/Falling", {0: moved(FALLING, (0, 0, 0.25)), 1: moved(FALLING, (0, 0, -0.25)),
                                              2: moved(quad, (0, 0, 0.25)), 3: moved(quad, (0, 0, -0.2))})  # fmt: skip
    for time, count, corners in ((0, [3], [0, 1, 2]), (2, [3, 3], [0, 1, 2, 1, 3, 2])):
        mesh.GetFaceVertexCountsAttr().Set(count, time)
        mesh.GetFaceVertexIndicesAttr().Set(corners, time)
    replay(stage)
    overlay = Usd.Stage.Open(str(tmp_path / "overlay.usda"))
    at_floor = [np.ptp(read_polygons(overlay, time)[:, :, 2], axis=1) < 0.1 for time in (0, 2)]
    assert [np.bincount(flat).tolist() for flat in at_floor] == [[2, 4], [2, 4]]
    assert errors_of(overlay) == []


@pytest.mark.parametrize("suffix", ["usda", "usdc"])
def test_overlay_agrees_with_json(tmp_path, suffix):
    scene = tmp_path / "cloth_twist.usd"
    shutil.copy(ASSETS / scene.name, scene)
    names = [str(tmp_path / name) for name in ("hits.json", f"overlay.{suffix}")]
    assert main(["replay", str(scene), "--device", "cpu", "--json", names[0], "--overlay", names[1]]) == 0
    found = with_names(json.loads(Path(names[0]).read_text()))
    overlay = Usd.Stage.Open(names[1])
    positions = {}
    for result in bsc.replay(bsc.Scene(str(scene)), device="cpu"):
        positions[result.summary.start] = result.contacts.interval.x0[result.contacts.segment.faces]
        cuts = result.intersections[0].cuts.points
        np.testing.assert_array_equal(read_curves(overlay, result.summary.start), np.float32(cuts))
        assert len(cuts) > 0
    for interval in found["intervals"]:
        points, primvars = read_contacts(overlay, interval["start"])
        contacts = interval["contacts"]
        expected = np.array([contact["position"] for contact in contacts], dtype=np.float32).reshape(-1, 3)
        np.testing.assert_array_equal(points, expected)
        np.testing.assert_array_equal(primvars["toi"], np.float32([contact["toi"] for contact in contacts]))
        for side, name in enumerate("AB"):
            assert primvars[f"prim{name}"] == [contact["meshes"][side] for contact in contacts]
            numbers = [contact["indices"][side] for contact in contacts]
            assert primvars[f"element{name}"] == [tuple([*both, -1][:2]) for both in numbers]
        triangles = read_polygons(overlay, interval["start"])
        faces = {contact["indices"][1][0] for contact in contacts if contact["kind"] == "vertex-face"}
        middles = triangles.mean(axis=1)
        for middle in positions[interval["start"]].mean(axis=1)[sorted(faces)]:
            assert np.sort(np.linalg.norm(middles - middle, axis=1))[1] < 2 * LIFT * 2  # the scene's size is below 2
    assert sum(len(interval["contacts"]) for interval in found["intervals"]) == found["hits"] == 33


def test_binary_overlay_saves_its_samples_as_they_get_many(tmp_path, monkeypatch):
    """The same content, whatever is held in memory at once."""
    scene = tmp_path / "cloth_twist.usd"
    shutil.copy(ASSETS / scene.name, scene)
    texts = []
    for size in (1, 1 << 25):
        monkeypatch.setattr(layer_writer, "_SAVED", size)
        path = tmp_path / "overlay.usdc"
        assert main(["replay", str(scene), "--device", "cpu", "--overlay", str(path)]) == 0
        texts.append(Sdf.Layer.OpenAsAnonymous(str(path)).ExportToString())
    assert texts[0] == texts[1]
    assert main(["replay", str(scene), "--device", "cpu", "--overlay", str(tmp_path / "overlay.usda")]) == 0
    assert Sdf.Layer.OpenAsAnonymous(str(tmp_path / "overlay.usda")).ExportToString() == texts[0]
