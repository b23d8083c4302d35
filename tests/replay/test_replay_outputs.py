"""The files that a replay writes: the overlay, the page, JSON and CSV, whole, partial or not there at all."""

import base64
import contextlib
import csv
import hashlib
import html
import json
import os
import re
import resource
import shlex
import shutil
import stat
import struct
import subprocess
import sys
import threading
import zlib
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from chromium import CHROMIUM, Browser
from progress_lines import without_progress
from pxr import Sdf, Usd, UsdGeom, UsdShade, UsdUtils
from stages import FALLING, FLOOR, add_floor, add_instancer, add_mesh, animate, falling, moved, new_stage, save

import warp_bsc as bsc
from warp_bsc import _atomic_file
from warp_bsc._atomic_file import OutputFile
from warp_bsc.cli import replay as replay_command
from warp_bsc.cli.main import main
from warp_bsc.replay import html_report, usd_overlay
from warp_bsc.replay.page_view import choose_faces
from warp_bsc.replay.usd_overlay import COLORS, LIFT
from warp_bsc.usd import layer_writer

ASSETS = Path(__file__).resolve().parents[2] / "assets"
HOSTILE = "<img src=x onerror=alert(1)>{{script}}"
KIND_TEXTS = ("vertex-face", "edge-edge", "edge through face", "edge touches face")
OUTPUTS = ("hits.json", "hits.csv", "overlay.usda", "page.html")


@pytest.fixture
def stage(tmp_path):
    """A triangle that falls through a floor of two quads from time 2 to 3, through the second of them."""
    stage = new_stage(tmp_path / "scene.usda")
    (a, b, c, d), (e, f) = FLOOR, [(6, -2, 0), (6, 2, 0)]
    add_mesh(stage, "/World/Floor", [a, b, c, d, e, f], [4, 4], [1, 4, 5, 2, 0, 1, 2, 3])
    heights = {0: 2, 1: 1, 2: 0.25, 3: -0.25, 4: -0.3}
    add_mesh(stage, "/World/Falling", {time: moved(FALLING, (0, 0, z)) for time, z in heights.items()})
    return stage


def replay(stage, *options, status=0):
    """Writes all files beside the scene, and returns their paths."""
    path = Path(save(stage)) if isinstance(stage, Usd.Stage) else Path(stage)
    files = [path.parent / name for name in OUTPUTS]
    named = zip(("--json", "--csv", "--overlay", "--report"), map(str, files), strict=True)
    arguments = [argument for pair in named for argument in pair]
    assert main(["replay", str(path), "--device", "cpu", *arguments, *options]) == status
    return files


def errors_of(stage):
    """What usdchecker finds wrong."""
    validation = pytest.importorskip("pxr.UsdValidation")
    validators = [
        validator
        for validator in validation.ValidationRegistry().GetOrLoadAllValidators()
        if not validator.GetMetadata().name.startswith("warp_bsc.")  # our own rule finds the collisions
    ]
    return [error.GetMessage() for error in validation.ValidationContext(validators).Validate(stage)]


def read_contacts(overlay, time, kinds=("VertexFace", "EdgeEdge"), root="/Collisions"):
    """Points of contact, and the values of each primvar, meshes by their names."""
    prims, points, primvars = overlay.GetPrimAtPath(root).GetAttribute("prims").Get(), [], {}
    for kind in kinds:
        instancer = UsdGeom.PointInstancer(overlay.GetPrimAtPath(f"{root}/{kind}"))
        api = UsdGeom.PrimvarsAPI(instancer)
        points.extend(instancer.GetPositionsAttr().Get(time))
        assert len(instancer.GetProtoIndicesAttr().Get(time)) == len(instancer.GetPositionsAttr().Get(time))
        for name in ("toi", "elementA", "elementB", "primA", "primB"):
            primvar = api.GetPrimvar(name)
            assert primvar.GetInterpolation() == UsdGeom.Tokens.vertex
            values = [tuple(value) if name.startswith("element") else value for value in primvar.Get(time)]
            primvars.setdefault(name, []).extend(
                [prims[value] for value in values] if name.startswith("prim") else values
            )
    return np.array(points).reshape(-1, 3), primvars


def read_polygons(overlay, time, root="/Collisions"):
    """The triangles of the polygons that collide, as points: of one side, then of the other."""
    mesh = UsdGeom.Mesh(overlay.GetPrimAtPath(f"{root}/Polygons"))
    points = np.array(mesh.GetPointsAttr().Get(time)).reshape(-1, 3)
    counts, corners = mesh.GetFaceVertexCountsAttr().Get(time), mesh.GetFaceVertexIndicesAttr().Get(time)
    assert list(counts) == [3] * (len(corners) // 3)
    return points[np.array(corners, dtype=int)].reshape(-1, 3, 3)


def read_curves(overlay, time, root="/Collisions"):
    """The ends of the segments in which triangles meet."""
    curves = UsdGeom.BasisCurves(overlay.GetPrimAtPath(f"{root}/Intersections"))
    counts = curves.GetCurveVertexCountsAttr().Get(time)
    assert set(counts) <= {2} and curves.GetTypeAttr().Get() == UsdGeom.Tokens.linear
    return np.array(curves.GetPointsAttr().Get(time)).reshape(-1, 2, 3)


# --- The overlay ---


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
    contacts = overlay.GetPrimAtPath("/Collisions/VertexFace")
    for time in (0, 1, 3, 4):
        assert len(read_contacts(overlay, time)[0]) == len(read_polygons(overlay, time)) == 0
    low, high = contacts.GetAttribute("extent").Get(2)
    assert np.all(np.array(low) < points[0]) and np.all(points[0] < np.array(high))
    assert left_behind(tmp_path) == []


def test_overlay_emits_light_and_is_a_guide(stage, tmp_path):
    replay(stage)
    overlay = Usd.Stage.Open(str(tmp_path / "overlay.usda"))
    shown = {"Polygons": "Polygons", "VertexFace/Marker": "VertexFace", "EdgeEdge/Marker": "EdgeEdge"}
    for path, name in (shown | {"Intersections": "Intersections"}).items():
        prim = overlay.GetPrimAtPath(f"/Collisions/{path}")
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
        api = UsdGeom.PrimvarsAPI(overlay.GetPrimAtPath("/Collisions/Intersections"))
        names = {prims[value] for name in ("primA", "primB") for value in api.GetPrimvar(name).Get(1)}
        assert names == {"/World/Floor", "/World/Falling"}


@pytest.fixture
def near_and_inside(tmp_path):
    """A triangle comes near a floor, in two intervals; a small cube is in a large one all the time."""
    stage = new_stage(tmp_path / "scene.usda")
    add_floor(stage)
    heights = enumerate([1, 0.25, 0.125])
    add_mesh(stage, "/World/Falling", {time: moved(FALLING, (0, 0, height)) for time, height in heights})
    for name, size in (("Case", 1.0), ("Inside", 0.25)):
        cube = UsdGeom.Cube.Define(stage, f"/World/{name}")
        cube.CreateSizeAttr(size)
        animate(cube, (0, 0, 3))
    return stage


@pytest.mark.parametrize("suffix", ["usda", "usdc"])
def test_overlay_has_what_is_near_and_inside(near_and_inside, tmp_path, suffix):
    path = tmp_path / f"overlay.{suffix}"
    arguments = ["replay", save(near_and_inside), "--device", "cpu", "--overlay", str(path)]
    assert main([*arguments, "--clearance", "0.3"]) == 0
    overlay = Usd.Stage.Open(str(path))
    assert errors_of(overlay) == []
    names = overlay.GetPrimAtPath("/Collisions").GetAttribute("prims").Get()
    near, inside = (UsdGeom.PointInstancer(overlay.GetPrimAtPath(f"/Collisions/{name}")) for name in ("Near", "Inside"))
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
    for path in ("Near/Marker", "Inside/Marker"):
        prim = overlay.GetPrimAtPath(f"/Collisions/{path}")
        assert UsdGeom.Imageable(prim).ComputePurpose() == UsdGeom.Tokens.guide
        assert tuple(prim.GetAttribute("primvars:displayColor").Get()[0]) == pytest.approx(
            COLORS[path[: path.index("/")]]
        )
    assert main([*arguments, "--no-intersections"]) == 0
    overlay = Usd.Stage.Open(str(tmp_path / f"overlay.{suffix}"))
    overlay.Reload()
    assert not overlay.GetPrimAtPath("/Collisions/Near") and not overlay.GetPrimAtPath("/Collisions/Inside")


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
        overlay.GetPrimAtPath(f"/Collisions/{kind}").GetAttribute("extent") for kind in ("VertexFace", "EdgeEdge")
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
    found = json.loads(Path(names[0]).read_text())
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


# --- JSON and CSV ---


def test_csv_has_what_json_has(stage, tmp_path):
    replay(stage)
    found = json.loads((tmp_path / "hits.json").read_text())
    row, *at_rest = csv.DictReader((tmp_path / "hits.csv").read_text().splitlines())
    assert {row["kind"] for row in at_rest} == {"edge-face"}
    (contact,) = (contact for interval in found["intervals"] for contact in interval["contacts"])
    assert (row["first_prim"], row["first_element"], row["first_index"]) == ("/World/Falling", "vertex 0", "0")
    assert (row["second_prim"], row["second_element"], row["second_index"]) == ("/World/Floor", "face 1", "1")
    assert [float(row[name]) for name in ("x", "y", "z", "toi", "time")] == [
        *contact["position"], contact["toi"], contact["time"]
    ]  # fmt: skip
    assert (row["kind"], row["interval"], float(row["start"]), float(row["end"])) == ("vertex-face", "2", 2, 3)


@pytest.mark.parametrize("order", [["SCENE", "--json"], ["--json", "SCENE"]])
def test_json_is_printed_without_a_file(stage, capsys, order):
    path = save(stage)
    assert main(["replay", *[path if word == "SCENE" else word for word in order], "--device", "cpu"]) == 0
    assert json.loads(capsys.readouterr().out)["hits"] == 1


def test_csv_is_printed_without_a_file(stage, capsys):
    assert main(["replay", save(stage), "--device", "cpu", "--csv", "--no-intersections"]) == 0
    assert len(capsys.readouterr().out.splitlines()) == 2


def test_what_is_printed_names_the_files(stage, capsys, tmp_path):
    replay(stage)
    output = capsys.readouterr().out
    for name in OUTPUTS:
        assert f"Wrote {tmp_path / name}." in output
    assert "usdview shows them by Display, Display Purposes, Guide" in " ".join(output.split())
    assert "note: Motion between time samples is taken to be linear." in output


# --- Places ---


@pytest.fixture(params=["without a name", "with a name"])
def temporary(request, monkeypatch):
    """Both kinds of temporary file, as far as the system has the first."""
    if request.param == "with a name":
        monkeypatch.setattr(_atomic_file, "_give_name", lambda *_: (_ for _ in ()).throw(OSError("not here")))


@pytest.fixture
def umask():
    old = os.umask(0o027)
    yield
    os.umask(old)


def permissions(file):
    return file.stat().st_mode & 0o777


def test_permissions_are_those_of_the_file_before_or_as_the_umask_has_it(stage, tmp_path, temporary, umask):
    assert [permissions(file) for file in replay(stage)] == [0o640] * 4
    for file in tmp_path.iterdir():
        file.chmod(0o604)
    assert [permissions(file) for file in replay(stage)] == [0o604] * 4
    assert left_behind(tmp_path) == []


def test_links_are_followed(stage, tmp_path, temporary):
    (tmp_path / "elsewhere").mkdir()
    targets = [tmp_path / "elsewhere" / name for name in OUTPUTS]
    for target in targets:
        (tmp_path / target.name).symlink_to(target.relative_to(tmp_path))
    targets[0].write_text("old")  # the others are not there yet
    old = targets[0].stat().st_ino
    with targets[0].open() as reader:
        files = replay(stage)
        assert reader.read() == "old"  # it was replaced, not written to
    assert targets[0].stat().st_ino != old
    for file, target in zip(files, targets, strict=True):
        assert file.is_symlink() and target.is_file() and not target.is_symlink()
    assert json.loads(targets[0].read_text())["hits"] == 1
    assert left_behind(tmp_path) == left_behind(tmp_path / "elsewhere") == []


def test_devices_and_pipes_are_written_to(stage, tmp_path):
    null, pipe = tmp_path / "null", tmp_path / "pipe"
    null.symlink_to("/dev/null")
    os.mkfifo(pipe)
    read = []
    reader = threading.Thread(target=lambda: read.append(pipe.read_text()))
    reader.start()
    files = ["--json", str(null), "--csv", str(pipe)]
    assert main(["replay", save(stage), "--device", "cpu", "--no-intersections", *files]) == 0
    reader.join(10)
    assert null.is_symlink() and stat.S_ISCHR(null.stat().st_mode) and stat.S_ISFIFO(pipe.stat().st_mode)
    assert len(read[0].splitlines()) == 2


def test_open_files_are_written_to(stage, tmp_path):
    log = tmp_path / "log"
    log.write_text("before\n")
    with log.open("a") as file:
        path = f"/dev/fd/{file.fileno()}"
        assert main(["replay", save(stage), "--device", "cpu", "--no-intersections", "--csv", path]) == 0
    lines = log.read_text().splitlines()
    assert lines[0] == "before" and lines[1].startswith("interval,") and len(lines) == 3


def test_json_to_dev_stdout_is_printed_alone(stage, capsys):
    assert main(["replay", save(stage), "--device", "cpu", "--json", "/dev/stdout"]) == 0
    assert json.loads(capsys.readouterr().out)["hits"] == 1
    assert main(["replay", save(stage), "--device", "cpu", "--json", "/dev/stdout", "--csv"]) == 2
    assert "only one" in capsys.readouterr().err


@pytest.mark.parametrize("option", ["--json", "--csv", "--overlay", "--report"])
def test_no_output_replaces_what_the_scene_is_read_from(stage, tmp_path, capsys, option):
    layer = save(stage)
    prop = new_stage(tmp_path / "prop.usda")
    add_mesh(prop, "/World/Prop", moved(FALLING, (0, 0, 9)))
    save(prop)
    shot = new_stage(tmp_path / "shot.usda")
    shot.GetRootLayer().subLayerPaths.append("./scene.usda")
    shot.DefinePrim("/World/Prop").GetReferences().AddReference("./prop.usda")
    link, hard_link = tmp_path / "link.usda", tmp_path / "hard.usda"
    link.symlink_to("prop.usda")
    os.link(layer, hard_link)
    shot = save(shot)
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    for file in (layer, str(tmp_path / "prop.usda"), str(link), str(hard_link)):
        assert main(["replay", shot, "--device", "cpu", option, file]) == 2
        assert f"{file}: the scene is read from this file" in capsys.readouterr().err
    for file in (shot, str(tmp_path / "." / "shot.usda")):
        assert main(["replay", shot, "--device", "cpu", option, file]) == 2
        assert "named twice" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_two_outputs_are_two_files(stage, tmp_path, capsys):
    (tmp_path / "link.csv").symlink_to("hits.json")
    both = ["--json", str(tmp_path / "hits.json"), "--csv", str(tmp_path / "link.csv")]
    assert main(["replay", save(stage), "--device", "cpu", *both]) == 2
    assert "named twice" in capsys.readouterr().err


# --- Interrupted, out of room, broken ---


def left_behind(folder):
    return [path.name for path in folder.iterdir() if path.name.startswith(".")]


def check_partial(folder, count, reason):
    found = json.loads((folder / "hits.json").read_text())
    assert count in (None, len(found["intervals"]))
    assert found["complete"] is False and reason in found["stopped"]
    assert (folder / "hits.csv").read_text().splitlines()[-1].startswith(f"# partial: {count or ''}")
    overlay = Usd.Stage.Open(str(folder / "overlay.usda"))
    data = overlay.GetRootLayer().customLayerData["collisions"]
    assert data["complete"] is False and reason in data["stopped"]
    assert left_behind(folder) == []
    return found, overlay


def test_interrupted(stage, tmp_path, monkeypatch, capsys):
    whole = replay_command.replay

    def interrupted(*arguments, **options):
        for index, found in enumerate(whole(*arguments, **options)):
            if index == 3:
                raise KeyboardInterrupt
            yield found

    monkeypatch.setattr(replay_command, "replay", interrupted)
    replay(stage, status=130)
    found, overlay = check_partial(tmp_path, 3, "interrupted")
    assert found["hits"] == 1
    assert len(read_contacts(overlay, 2)[0]) == 1 and len(read_contacts(overlay, 3)[0]) == 0
    assert len(read_polygons(overlay, 2)) and not len(read_polygons(overlay, 3))  # not known to collide after that
    assert "Partial: 3 of 4 intervals were checked; interrupted." in (tmp_path / "page.html").read_text()
    output = capsys.readouterr()
    assert output.err == "warp-bsc: interrupted\n"
    assert "Partial: 3 of 4 intervals were checked; interrupted." in output.out


def test_interrupted_in_the_middle_of_a_record(stage, tmp_path, monkeypatch):
    write = OutputFile.write

    def interrupted(self, text):
        data = text.encode() if isinstance(text, str) else text
        if b'"index":2,' in data.replace(b" ", b""):  # the third interval, in JSON
            write(self, data[: len(data) // 2])
            raise KeyboardInterrupt
        write(self, data)

    monkeypatch.setattr(OutputFile, "write", interrupted)
    replay(stage, status=130)
    assert len(json.loads((tmp_path / "hits.json").read_text())["intervals"]) == 2
    assert len(Page((tmp_path / "page.html").read_text()).data["intervals"]) == 2
    Usd.Stage.Open(str(tmp_path / "overlay.usda"))


def test_broken_scene_leaves_what_was_finished(stage, tmp_path, capsys):
    points = [(0, 0, 0), (1, 0, 0), (0, float("nan"), 0)]
    UsdGeom.Mesh(stage.GetPrimAtPath("/World/Falling")).GetPointsAttr().Set(points, 3)
    replay(stage, status=2)
    check_partial(tmp_path, 2, "vertex 2 is not finite at time 3")
    assert "vertex 2 is not finite" in capsys.readouterr().err


@contextlib.contextmanager
def largest_file(size):
    """Lets no file become larger: as on a full disk, writing more is an error."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_full_disk(tmp_path, capsys):
    stage = new_stage(tmp_path / "scene.usda")
    add_floor(stage)
    heights = {time: 0.25 if time % 2 else -0.25 for time in range(60)}
    add_mesh(stage, "/World/Falling", {time: moved(FALLING, (0, 0, z)) for time, z in heights.items()})
    replay(stage)  # compiles kernels, whose files are large
    for name in OUTPUTS:
        (tmp_path / name).unlink()
    with largest_file(20_000):
        replay(stage, status=2)
    found = json.loads((tmp_path / "hits.json").read_text())
    count = len(found["intervals"])
    assert 0 < count < 59
    assert found["complete"] is False and found["hits"] == count
    assert (tmp_path / "hits.csv").read_text().splitlines()[-1].startswith("# partial: ")
    overlay = Usd.Stage.Open(str(tmp_path / "overlay.usda"))
    kept = overlay.GetRootLayer().customLayerData["collisions"]["intervals"]
    assert 0 < kept <= count + 1
    assert len(read_contacts(overlay, kept - 1)[0]) == 1
    assert not (tmp_path / "page.html").exists()  # it has no room, and is not cut off
    assert left_behind(tmp_path) == []
    line = capsys.readouterr().err.splitlines()[-1]
    assert line.startswith("warp-bsc: error: ") and ": File too large; " in line  # of the file that was full first
    assert f"{tmp_path / 'page.html'}: not written: " in line


def in_small_disk(folder, size, command):
    """Run a command with a small disk mounted at a folder, of which the files are copied to the folder afterwards."""
    script = f"""
        mount -t tmpfs -o size={size} tmpfs {folder}/disk || exit 77
        {shlex.join(command)}
        status=$?
        cp -r {folder}/disk/. {folder}/left
        exit $status"""
    return subprocess.run(["unshare", "-Urm", "sh", "-c", script], capture_output=True, text=True, check=False)


@pytest.mark.skipif(shutil.which("unshare") is None, reason="no unshare here")
@pytest.mark.parametrize("size", [600_000, 1_600_000])
def test_full_disk_has_room_for_all_files(tmp_path, size):
    stage = new_stage(tmp_path / "scene.usda")
    add_floor(stage)
    many = [moved(FALLING, (0.01 * number, 0, 0)) for number in range(40)]
    points = {time: [point for part in many for point in moved(part, (0, 0, z))]
              for time, z in ((time, 0.25 if time % 2 else -0.25) for time in range(80))}  # fmt: skip
    add_mesh(stage, "/World/Falling", points, [3] * 40, list(range(120)))
    for name in ("disk", "left"):
        (tmp_path / name).mkdir()
    files = [tmp_path / "disk" / name for name in OUTPUTS]
    named = [
        str(word) for pair in zip(("--json", "--csv", "--overlay", "--report"), files, strict=True) for word in pair
    ]
    command = [sys.executable, "-m", "warp_bsc", "replay", save(stage), "--device", "cpu", "--no-self", *named]
    done = in_small_disk(tmp_path, size, command)
    if done.returncode == 77 or "unshare" in done.stderr:
        pytest.skip(f"no disk can be mounted here: {done.stderr}")
    assert done.returncode == 2
    (line,) = without_progress(done.stderr).splitlines()
    assert line.startswith("warp-bsc: error: ") and "No space left on device" in line
    found, _ = check_partial(tmp_path / "left", None, "No space left on device")
    assert 0 < len(found["intervals"]) < 79
    page = Page((tmp_path / "left" / "page.html").read_text())
    assert page.data["partial"].startswith("Partial: ") and "view-0" in page.blocks


@pytest.mark.parametrize("suffix", ["usda", "usdc"])
def test_no_room_at_the_end_is_an_error(tmp_path, monkeypatch, capsys, suffix):
    stage = many_hits(tmp_path / "scene.usda", samples=9)
    path = tmp_path / f"overlay.{suffix}"
    name = {"usda": "write_text_layer", "usdc": "write_binary_layer"}[suffix]
    write, calls = getattr(usd_overlay, name), []

    def without_room(*arguments):
        calls.append(arguments)
        with largest_file(10_000) if len(calls) == 1 else contextlib.nullcontext():
            write(*arguments)

    monkeypatch.setattr(usd_overlay, name, without_room)
    command = ["replay", save(stage), "--device", "cpu", "--no-intersections", "--overlay", str(path)]
    assert main(command) == 2
    assert f"overlay.{suffix}: not all of it is written: [Errno 27] File too large" in capsys.readouterr().err
    overlay = Usd.Stage.Open(str(path))
    data = overlay.GetRootLayer().customLayerData["collisions"]
    assert (data["complete"], data["intervals"], data["stopped"]) == (False, 7, "the disk is full")
    assert len(read_contacts(overlay, 6)[0]) == 240 and len(read_contacts(overlay, 7)[0]) == 0
    assert errors_of(overlay) == []
    assert left_behind(tmp_path) == []


@pytest.mark.parametrize("name", OUTPUTS)
def test_a_file_that_cannot_be_finished_takes_no_other_with_it(stage, tmp_path, monkeypatch, capsys, name):
    commit = OutputFile.commit

    def broken(self):
        if self.path.name == name:
            raise RuntimeError("broken")
        commit(self)

    monkeypatch.setattr(OutputFile, "commit", broken)
    replay(stage, status=2)
    assert f"{tmp_path / name}: not written: RuntimeError: broken" in capsys.readouterr().err
    left = {"hits.json.part"} if name == "hits.json" else set()  # what --resume can go on from
    assert {path.name for path in tmp_path.iterdir()} == {"scene.usda", *OUTPUTS} - {name} | left


def test_what_was_there_stays_if_no_interval_is_finished(stage, tmp_path, monkeypatch, capsys):
    (tmp_path / "hits.json").write_text("old")

    def broken(*arguments, **options):
        assert (tmp_path / "hits.json").read_text() == "old"
        raise RuntimeError("of the first interval")
        yield

    monkeypatch.setattr(replay_command, "replay", broken)
    replay(stage, status=2)
    assert capsys.readouterr().err.startswith(
        f"warp-bsc: error: {tmp_path}/scene.usda: RuntimeError: of the first interv"
    )
    assert (tmp_path / "hits.json").read_text() == "old"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["hits.json", "scene.usda"]


# --- The page ---


class Page(HTMLParser):
    """Tags, handlers, addresses, scripts, data and blocks of a page."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.attributes, self.scripts, self.data, self._packed = set(), [], [], None, {}
        self._inside = None
        self.policy = ""
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        self.attributes += attrs
        attributes = dict(attrs)
        if attributes.get("http-equiv") == "Content-Security-Policy":
            self.policy = attributes["content"]
        self._inside = (tag, attributes.get("type"), attributes.get("id"), attributes.get("data-packed"))

    def handle_data(self, data):
        if self._inside and self._inside[:2] == ("script", "application/json"):
            self.data = json.loads(data)
        elif self._inside and self._inside[:2] == ("script", "text/plain"):
            self._packed[self._inside[2]] = data, self._inside[3]
        elif self._inside and self._inside[:2] == ("script", None):
            self.scripts.append(data)
        self._inside = None

    @property
    def blocks(self):
        """Names of all blocks."""
        return self._packed.keys()

    def block(self, name):
        """The facts and the arrays of a block."""
        text, packed = self._packed[name]
        content = base64.b64decode(text)
        content = zlib.decompress(content) if packed else content
        at = 4 + int.from_bytes(content[:4], "little")
        found = json.loads(content[4:at])
        for key, kind, length in found.pop("arrays"):
            planes = np.frombuffer(content[at : at + 4 * length], np.uint8).reshape(4, length)
            found[key] = np.ascontiguousarray(planes.T).view(f"<{kind}4").reshape(-1)
            at += 4 * length
        assert at == len(content)
        return found


def hostile_stage(folder):
    stage = new_stage(folder / f"{HOSTILE}.usda")
    add_floor(stage).GetPrim().SetDisplayName(HOSTILE)
    falling_mesh = add_mesh(stage, "/World/Falling", falling(0.25, -0.25))
    falling_mesh.GetPrim().SetDisplayName("</script><script>alert(2)</script>")
    falling_mesh.GetPrim().SetCustomDataByKey("note", HOSTILE)
    stage.GetRootLayer().comment = f"<!-- {HOSTILE}"
    stage.GetRootLayer().documentation = f"]]>{HOSTILE}</title>"
    return stage


def test_page_is_self_contained_and_escapes(tmp_path):
    page_path = replay(hostile_stage(tmp_path))[3]
    text = page_path.read_text()
    page = Page(text)
    assert "img" not in page.tags
    assert not [name for name, _ in page.attributes if name.startswith("on")]
    assert not [value for name, value in page.attributes if name in ("src", "href", "action", "data")]
    assert text.count(html.escape(HOSTILE)) == 2  # the title of the document and that of the page
    assert "http" not in re.sub(r'"http://www\.w3\.org/2000/svg"|http-equiv', "", text)
    (script,) = page.scripts
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}'" in page.policy and "default-src 'none'" in page.policy
    assert "unsafe" not in page.policy
    assert page.data["title"] == f"Collisions in {HOSTILE}.usda"
    facts = dict(page.data["facts"])
    assert facts["Mesh /World/Floor"] == HOSTILE
    assert facts["Comment"] == f"<!-- {HOSTILE}"


def test_page_has_every_interval_with_hits(stage, tmp_path):
    found = json.loads(replay(stage, "--validate", "all")[0].read_text())
    page = Page((tmp_path / "page.html").read_text())
    data = page.data
    assert data["intervals"] == [[0, 1, 0, 0], [1, 2, 0, 0], [2, 3, 1, 0], [3, 4, 0, 0]]
    assert [at for at, *_ in data["rest"]] == [0, 1, 2, 3, 4]
    assert [crossings > 0 for _, crossings, *_ in data["rest"]] == [False, False, False, True, True]
    at_rest = [[0, data["rest"][time][1], 0] for time in (3, 4)]
    assert data["rows"] == [[0, 0, 0], [0, 0, 0], [1, 0, 0], *at_rest] and data["near"] == []
    assert sum(data["toi"]) == 1 and data["toi"][9] + data["toi"][10] == 1
    (pair,) = data["pairs"]
    assert (pair["meshes"], pair["hits"]) == (["/World/Floor", "/World/Falling"], 1)
    assert pair["spans"] == [[2, 3, 1]] and pair["rest"] == [[3, 4, data["rest"][3][1], "stays", ""]]
    assert data["up_axis"] == "Z" and data["validation"]["disagreements"] == []
    assert page.blocks == {"view-0", "faces-0", "hits-2", "view-2", "rest-3", "view-3", "rest-4"}
    center = np.array(data["center"])

    (contact,) = (contact for interval in found["intervals"] for contact in interval["contacts"])
    block = page.block("hits-2")
    assert [data["meshes"][int(block[side][0])]["name"] for side in ("first", "second")] == contact["meshes"]
    assert (block["kind"][0], block["elements"][0], block["first_0"][0], block["second_0"][0]) == (0, 1, 0, 1)
    assert block["toi"] == pytest.approx([0.5], abs=1e-5) and block["separate"][0] == 1
    np.testing.assert_allclose(block["position"] + center, contact["position"], atol=1e-6)

    faces, view = page.block("faces-0")["faces"].reshape(-1, 3), page.block("view-2")
    start, end = (view[name].reshape(-1, 3) + center for name in ("start", "end"))
    assert len(faces) == 5 and faces.max() == len(start) - 1 and view["faces"] == 0
    np.testing.assert_allclose((end - start)[-3:], [(0, 0, -0.5)] * 3, atol=1e-6)
    np.testing.assert_allclose(start[-3:], moved(FALLING, (0, 0, 0.25)), atol=1e-6)
    assert [data["meshes"][mesh] for mesh in page.block("faces-0")["mesh_of_vertex"][[0, -1]]] == [
        {"name": "/World/Floor", "moves": False}, {"name": "/World/Falling", "moves": True}
    ]  # fmt: skip

    scene = bsc.Scene(str(tmp_path / "scene.usda"))
    *_, last = bsc.replay(scene, device="cpu")
    for index, at_rest in ((3, last.intersections[0]), (4, last.intersections[1])):
        block = page.block(f"rest-{index}")
        assert (block["kind"] == np.where(at_rest.crosses, 4, 5)).all()
        np.testing.assert_allclose(block["curves"].reshape(-1, 2, 3) + center, at_rest.cuts.points, atol=1e-6)


def test_page_without_collisions(tmp_path):
    stage = new_stage(tmp_path / "scene.usda")
    add_mesh(stage, "/World/Falling", falling(1, 0.5))
    replay(stage)
    page = Page((tmp_path / "page.html").read_text())
    assert page.blocks == {"view-0", "faces-0"}  # the scene is there to be seen
    assert page.data["rows"] == [[0, 0, 0], [0, 0, 0]] and page.data["pairs"] == []


def test_page_has_what_is_near_and_inside(near_and_inside, tmp_path):
    found = json.loads(replay(near_and_inside, "--clearance", "0.3")[0].read_text())
    page = Page((tmp_path / "page.html").read_text())
    data = page.data
    assert data["near"] == [[0, 0], [1, 1], [2, 1]] and [at[3] for at in data["rest"]] == [1, 1, 1]
    assert data["rows"] == [[0, 1, 0], [0, 1, 1], [0, 1, 1]]
    block = page.block("near-2")
    assert (block["kind"][0], block["distance"][0]) == (7, 0.125) and page.block("rest-2")["kind"][0] == 6
    (row,) = found["intervals"][-1]["proximity_pairs_at_end"]
    np.testing.assert_allclose(block["position"] + data["center"], row["position"], atol=1e-6)
    inside, near = data["pairs"]
    assert (inside["rest"], near["near"]) == ([[0, 2, 1, "stays", "/World/Inside"]], [[1, 2, 0.125]])
    assert ["0.125", "smallest distance"] in data["tiles"]
    replay(near_and_inside, "--clearance", "0.1")
    assert ["> 0.1", "smallest distance"] in Page((tmp_path / "page.html").read_text()).data["tiles"]


def test_page_without_intersections(stage, tmp_path):
    replay(stage, "--no-intersections")
    page = Page((tmp_path / "page.html").read_text())
    assert page.data["rest"] == [] and page.blocks == {"view-0", "faces-0", "hits-2", "view-2"}
    assert "separate" not in page.block("hits-2")


@pytest.mark.parametrize("visible", ["inherited", "invisible"])
def test_page_where_little_is_there(tmp_path, visible):
    stage = new_stage(tmp_path / "scene.usda")
    mesh = add_mesh(stage, "/World/Falling", falling(1, 0.5))
    mesh.CreateVisibilityAttr().Set(visible, 0)
    mesh.GetVisibilityAttr().Set("inherited", 1)
    mesh.GetPointsAttr().Set(FALLING, 2)
    replay(stage)
    blocks = Page((tmp_path / "page.html").read_text()).blocks
    assert ("view-0" in blocks) == (visible == "inherited")


def many_hits(path, columns=40, samples=4):
    """Strips that swing through a floor of quads, to and fro: many collisions of three pairs of meshes."""
    stage = new_stage(path)
    x = np.arange(columns, dtype=float)
    add_mesh(stage, "/World/Floor", [(a, b, 0) for b in (-1, 1) for a in [*x, columns]], [4] * columns,
             [i for a in range(columns) for i in (a, a + 1, a + columns + 2, a + columns + 1)])  # fmt: skip
    for number in range(3):
        triangles = [
            (a + 0.2 * number + 0.1 + dx, dy, dz)
            for a in x
            for dx, dy, dz in ((0, 0, 0), (0.1, 0.1, 9), (0.1, -0.1, 9))
        ]
        points = {time: moved(triangles, (0, 0, -0.5 if time % 2 else 0.5)) for time in range(samples)}
        add_mesh(stage, f"/World/Strip{number}", points, [3] * columns, list(range(3 * columns)))
    return stage


def test_page_says_what_it_leaves_out(tmp_path, monkeypatch):
    for name, value in {"_ALL_ROWS": 40, "_FEWEST_ROWS": 5, "_ALL_FACES": 90, "_FEWEST_FACES": 10}.items():
        monkeypatch.setattr(html_report, name, value)
    stage = many_hits(tmp_path / "scene.usda")
    found = json.loads(replay(stage)[0].read_text())
    page = Page((tmp_path / "page.html").read_text())
    listed = sum(hits for hits, *_ in page.data["rows"])
    assert [hits for hits, *_ in page.data["rows"][:3]] == [6, 6, 6] and found["hits"] > 300
    (note, rest) = page.data["notes"][-2:]
    assert (
        note.startswith(f"The table has {listed} of {found['hits']} collisions: ") and "intersections at rest" in rest
    )
    for index in range(3):
        block = page.block(f"hits-{index}")
        assert block["of"] == found["intervals"][index]["hits"]
        assert len(set(block["first"]) | set(block["second"])) == 4  # every pair of meshes is there
        view = page.block(f"view-{index}")
        faces = page.block(f"faces-{view['faces']}")["faces"].reshape(-1, 3)
        assert view["of"] == 200 and 0 < len(faces) <= 30 and view["lit"].max() < len(faces)

    monkeypatch.setattr(html_report, "_VIEW_BYTES", 1000)
    replay(stage)
    page = Page((tmp_path / "page.html").read_text())
    assert "view-0" in page.blocks and "view-2" not in page.blocks and "hits-2" in page.blocks
    assert page.data["notes"][-1].endswith("intervals have no view in 3D, as the page is full.")


def test_faces_around_places_are_chosen():
    rng = np.random.default_rng(1)
    corners = rng.uniform(0, 1, (20_000, 3))
    places = np.array([(0.1, 0.1, 0.1), (0.9, 0.2, 0.5)])
    wanted = np.array([5, 17, 19_000])
    chosen = choose_faces(corners, places, wanted, 2_000)
    assert np.array_equal(chosen, np.unique(chosen)) and set(wanted) <= set(chosen.tolist())
    assert 100 < len(chosen) <= 2_000
    distance = np.abs(corners[:, None] - places).max(axis=2).min(axis=1)
    near, far = distance[np.setdiff1d(chosen, wanted)].max(), np.delete(distance, chosen).min()
    assert near < 3 * far  # cells, not spheres
    assert len(choose_faces(corners, places, wanted, 20_000)) == 20_000
    assert np.array_equal(choose_faces(corners, corners, wanted, 2), wanted[[0, 2]])  # nothing fits but some of these


@pytest.fixture
def browser(tmp_path):
    if CHROMIUM is None:
        pytest.skip("no Chromium here")
    with Browser(tmp_path / "profile") as opened:
        yield opened


@pytest.mark.browser
def test_page_in_chromium(tmp_path, browser):
    scene = tmp_path / "cloth_twist.usd"
    shutil.copy(ASSETS / scene.name, scene)
    page = replay(scene)[3]
    browser.open(page)
    assert browser.value("document.querySelectorAll('.hover').length") == 14 + 14 + 20  # bars: hits, at rest, impacts
    assert browser.value("document.getElementById('viewer-message').hidden")  # it would say why there is no view in 3D
    assert browser.value("document.getElementById('viewer-heading').textContent") == "Time 250 to 251"
    assert browser.value("location.hash") == "#interval=4"

    def pixels():
        picture = tmp_path / "page.png"
        browser.value("document.getElementById('canvas').scrollIntoView({block: 'center'})")
        left, top, right, bottom = map(int, browser.box("#canvas"))
        browser.screenshot(picture, whole=False)
        return np.moveaxis(matplotlib.image.imread(picture)[top:bottom, left:right, :3], 2, 0)

    import matplotlib.image  # noqa: PLC0415

    red, green, blue = pixels()
    assert (blue > red + 0.15).mean() > 0.03  # the cloth
    assert ((red > 0.7) & (green < 0.75) & (blue < 0.4)).sum() > 30  # contacts
    assert ((blue > 0.7) & (green < 0.4) & (red > 0.4) & (red < 0.75)).sum() > 10  # cut curves
    for width in (1400, 390):
        browser.resize(width, 900)
        assert browser.value("document.documentElement.scrollWidth") <= width
        assert browser.box("#viewer-legend")[1] >= browser.box("#canvas")[3]  # the legend does not cover the view
    assert browser.console == []


@pytest.mark.browser
def test_near_and_inside_in_chromium(near_and_inside, tmp_path, browser):
    browser.open(replay(near_and_inside, "--clearance", "0.3")[3])
    assert browser.value("document.getElementById('viewer-title').textContent").endswith(
        "; 1 part inside at the start, 1 at the end; 1 pair near at the start, 1 at the end"
    )
    legend = browser.value("document.getElementById('viewer-legend').textContent")
    assert "part of a mesh inside another" in legend and "proximity" in legend
    kinds = "[...document.querySelectorAll('#rows tr[data-at] td.kind')].map((cell) => cell.textContent)"
    assert browser.value(kinds) == ["inside", "inside", "near", "inside", "near"]
    browser.click("#rows tr[data-at]", 4)
    browser.wait("!document.getElementById('selected').hidden")
    assert browser.value("document.getElementById('selected').textContent").startswith("near at time 2: ")
    assert "0.125 apart" in browser.value("document.getElementById('rows').textContent")
    assert browser.console == []


@pytest.mark.browser
def test_intervals_are_gone_through_in_chromium(stage, tmp_path, browser):
    browser.open(replay(stage)[3])
    heading = "document.getElementById('viewer-heading').textContent"
    assert browser.value(heading) == "Time 2 to 3"
    for key, expected in (
        ("ArrowRight", "3 to 4"),
        ("ArrowRight", "3 to 4"),
        ("ArrowLeft", "2 to 3"),
        ("End", "3 to 4"),
        ("Home", "2 to 3"),
    ):
        browser.press(key)
        assert browser.value(heading) == f"Time {expected}"
    browser.click("#intervals .hover", 3)  # the fourth bar
    assert browser.value(heading) == "Time 3 to 4" and browser.value("location.hash") == "#interval=3"
    browser.click("#intervals .hover", 1)
    browser.wait("!document.getElementById('viewer-message').hidden")
    assert "Nothing collides or intersects here" in browser.value(
        "document.getElementById('viewer-message').textContent"
    )
    browser.click("#next")
    browser.wait("document.getElementById('viewer-message').hidden")
    assert browser.value(heading) == "Time 2 to 3"
    assert browser.value("document.getElementById('time-label').textContent").startswith("time 2.5")
    browser.click("#viewer-heading")  # off the button, which the space bar would press
    browser.press(" ")
    assert browser.value("document.getElementById('play').textContent") == "Pause"
    assert browser.console == []


@pytest.mark.browser
def test_table_is_sorted_and_filtered_in_chromium(tmp_path, browser):
    found = json.loads(replay(many_hits(tmp_path / "scene.usda"))[0].read_text())
    page = tmp_path / "page.html"
    browser.open(page)
    total = sum(map(sum, Page(page.read_text()).data["rows"]))
    count = "document.getElementById('rows-count').textContent"
    assert browser.value(count) == f"{total:,} of {total:,} rows"
    assert (
        browser.value("document.querySelectorAll('#rows tbody tr').length") < 90
    )  # only those around what is in sight
    column = "[...document.querySelectorAll('#rows tr[data-at] td:nth-child({})')].map((cell) => cell.textContent)"

    browser.click("#rows th button", 0)
    browser.click("#rows th button", 0)  # the latest first
    assert browser.value("document.querySelector('#rows th').getAttribute('aria-sort')") == "descending"
    times = [float(text) for text in browser.value(column.format(1))]
    assert times == sorted(times, reverse=True) and times[0] == 3

    browser.press("/")
    browser.type("strip1 face")
    browser.wait(f"{count} !== '{total:,} of {total:,} rows'")
    pairs = list(zip(browser.value(column.format(3)), browser.value(column.format(4)), strict=True))
    assert pairs and all("/World/Strip1" in first + second and "face" in first + second for first, second in pairs)
    of_strip = [
        contact for interval in found["intervals"] for contact in interval["contacts"]
        if "/World/Strip1" in contact["meshes"] and contact["kind"] == "vertex-face"
    ]  # fmt: skip
    browser.value("(byId('kind').value = '0', byId('kind').dispatchEvent(new Event('change')))")
    assert browser.value(count) == f"{len(of_strip):,} of {total:,} rows"

    browser.open(page, "#prim=/World/Strip2")  # an address that leads to a prim
    both = [
        contact
        for interval in found["intervals"]
        for contact in interval["contacts"]
        if "/World/Strip2" in contact["meshes"]
    ]
    names = "[rows.first[row], rows.second[row]].map((mesh) => data.meshes[mesh].name)"
    rows = browser.value(f"table.rows.map((row) => {names})")
    assert len(rows) > len(both) > 0 and all("/World/Strip2" in names for names in rows)
    prim = browser.value("document.querySelectorAll('#rows tr[data-at] a.prim')[1].textContent")
    browser.click("#rows tr[data-at] a.prim", 1)
    browser.wait(f"document.querySelector('.chip').textContent.startsWith('{prim} ')")
    assert browser.value("new URLSearchParams(location.hash.slice(1)).get('prim')") == prim
    browser.click(".chip")
    browser.wait(f"{count} === '{total:,} of {total:,} rows'")

    browser.click("#rows tr[data-at]", 3)
    chosen = browser.value("document.querySelector('#rows tr.chosen').dataset.at")
    browser.wait("!document.getElementById('frame-contacts').hidden")  # the interval of the row is in the view
    assert chosen == "3" and not browser.value("document.getElementById('selected').hidden")
    browser.value("document.getElementById('rows').focus()")
    browser.press("ArrowDown")
    assert browser.value("document.querySelector('#rows tr.chosen').dataset.at") == "4"
    assert browser.value("document.getElementById('selected').textContent").startswith(tuple(KIND_TEXTS))
    assert browser.console == []


@pytest.mark.browser
def test_hostile_names_do_nothing_in_chromium(tmp_path, browser):
    browser.open(replay(hostile_stage(tmp_path))[3])
    assert browser.console == []  # neither an error nor a refusal by the policy: there was nothing to refuse
    dom = browser.value("document.documentElement.outerHTML")
    assert "<img" not in dom
    assert "&lt;img src=x onerror=alert(1)&gt;{{script}}" in dom
