"""The files that a replay writes: the overlay, the page, JSON and CSV, whole, partial or not there at all."""

import base64
import contextlib
import csv
import hashlib
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
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from chromium import CHROMIUM
from pxr import Sdf, Usd, UsdGeom, UsdUtils
from stages import FALLING, FLOOR, add_falling, add_floor, add_mesh, falling, moved, new_stage, save

from warp_bsc import _atomic_file
from warp_bsc._atomic_file import OutputFile
from warp_bsc.cli import replay as replay_command
from warp_bsc.cli.main import main
from warp_bsc.replay.usd_overlay import COLORS, LIT

ASSETS = Path(__file__).resolve().parents[2] / "assets"
HOSTILE = "<img src=x onerror=alert(1)>"
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
    validators = validation.ValidationRegistry().GetOrLoadAllValidators()
    return [error.GetMessage() for error in validation.ValidationContext(validators).Validate(stage)]


def read_contacts(overlay, time, path="/Collisions/Contacts"):
    points = UsdGeom.Points(overlay.GetPrimAtPath(path))
    api = UsdGeom.PrimvarsAPI(points)
    primvars = {name: list(api.GetPrimvar(name).Get(time)) for name in ("toi", "elementA", "elementB", "displayColor")}
    return np.array(points.GetPointsAttr().Get(time)).reshape(-1, 3), primvars


def floor_colors(overlay, time, path="/World/Floor"):
    primvar = UsdGeom.Gprim(overlay.GetPrimAtPath(path)).GetDisplayColorPrimvar()
    assert primvar.GetInterpolation() == UsdGeom.Tokens.uniform
    return [tuple(color) for color in primvar.Get(time)]


# --- The overlay ---


def test_overlay(stage, tmp_path):
    before = Path(save(stage)).read_bytes()
    replay(stage)
    assert (tmp_path / "scene.usda").read_bytes() == before
    overlay = Usd.Stage.Open(str(tmp_path / "overlay.usda"))
    assert errors_of(overlay) == []
    assert overlay.GetRootLayer().subLayerPaths == ["./scene.usda"]
    assert overlay.GetPrimAtPath("/World/Falling").IsA(UsdGeom.Mesh)
    contacts = overlay.GetPrimAtPath("/Collisions/Contacts")
    assert UsdGeom.Points(contacts).GetPointsAttr().GetTimeSamples() == [0, 1, 2, 3, 4]
    points, primvars = read_contacts(overlay, 2)
    np.testing.assert_allclose(points, [(0.5, -0.5, 0)], atol=1e-6)
    assert primvars["toi"] == pytest.approx([0.5], abs=1e-5)
    assert (primvars["elementA"], primvars["elementB"]) == (["/World/Falling vertex 0"], ["/World/Floor face 1"])
    assert primvars["displayColor"] == [pytest.approx(COLORS["vertex-face"])]
    for time in (0, 1, 3, 4):
        assert len(read_contacts(overlay, time)[0]) == 0
    low, high = UsdGeom.Points(contacts).GetExtentAttr().Get(2)
    assert np.all(np.array(low) < points[0]) and np.all(points[0] < np.array(high))


def test_overlay_colours_the_polygons_that_collide(stage, tmp_path):
    UsdGeom.Gprim(stage.GetPrimAtPath("/World/Floor")).CreateDisplayColorPrimvar("uniform").Set([(0, 0, 1), (0, 1, 0)])
    replay(stage)
    overlay = Usd.Stage.Open(str(tmp_path / "overlay.usda"))
    plain = [(0, 0, 1), (0, 1, 0)]
    lit = [(0, 0, 1), pytest.approx(LIT)]
    assert [floor_colors(overlay, time) for time in (0, 1, 2, 3, 4)] == [plain, plain, lit, plain, plain]
    assert floor_colors(overlay, 2, "/World/Falling") == [pytest.approx(LIT)]


def test_overlay_names_prims_in_the_same_order_every_time(tmp_path):
    stage = new_stage(tmp_path / "scene.usda")
    add_floor(stage)
    names = [f"Falling{number}" for number in range(8)]
    for name in names:
        add_falling(stage, f"/World/{name}")
    replay(stage)
    lines = (tmp_path / "overlay.usda").read_text().splitlines()
    assert [line.split('"')[1] for line in lines if 'over "Falling' in line] == names


def test_overlay_blocks_the_indices_of_the_scenes_colours(stage, tmp_path):
    primvar = UsdGeom.Gprim(stage.GetPrimAtPath("/World/Floor")).CreateDisplayColorPrimvar("uniform")
    primvar.Set([(0, 1, 0)])
    primvar.SetIndices([0, 0])
    replay(stage)
    overlay = Usd.Stage.Open(str(tmp_path / "overlay.usda"))
    primvar = UsdGeom.Gprim(overlay.GetPrimAtPath("/World/Floor")).GetDisplayColorPrimvar()
    assert not primvar.IsIndexed()
    assert floor_colors(overlay, 2) == [(0, 1, 0), pytest.approx(LIT)]
    assert errors_of(overlay) == []


def test_overlay_stays_lit_while_the_collisions_last(tmp_path):
    stage = new_stage(tmp_path / "scene.usda")
    add_floor(stage)
    heights = [0.25, -0.25, 0.25, -0.25, -0.3, -0.35, -0.4, 0.2]
    add_mesh(stage, "/World/Falling", {time: moved(FALLING, (0, 0, z)) for time, z in enumerate(heights)})
    replay(stage)
    overlay = Usd.Stage.Open(str(tmp_path / "overlay.usda"))
    lit = [floor_colors(overlay, time) == [pytest.approx(LIT)] for time in range(8)]
    assert lit == [True, True, True, False, False, False, True, False]


def test_overlay_shows_nothing_between_its_samples(tmp_path):
    stage = new_stage(tmp_path / "scene.usda")
    add_floor(stage)
    places = [(0, 0.25), (0, -0.25), (0.4, 0.25), (0.4, -0.25), (0.4, -0.3), (0, 0.25), (0, 1)]
    add_mesh(stage, "/World/Falling", {3 * time: moved(FALLING, (x, 0, z)) for time, (x, z) in enumerate(places)})
    found = json.loads(replay(stage)[0].read_text())
    overlay = Usd.Stage.Open(str(tmp_path / "overlay.usda"))
    at_start = [[contact["position"] for contact in interval["contacts"]] for interval in found["intervals"]]
    assert [len(points) > 0 for points in at_start] == [True, True, True, False, True, False]
    extent = UsdGeom.Points(overlay.GetPrimAtPath("/Collisions/Contacts")).GetExtentAttr()
    unlit = [pytest.approx((0.6, 0.6, 0.6))]
    for time in (0, 1, 2.999, 3, 4.5, 5.999, 6, 7, 9, 10, 11.999, 12, 13, 14.999, 15, 16.5, 18, 20):
        expected = at_start[int(time // 3)] if time < 18 else []
        points, primvars = read_contacts(overlay, time)
        np.testing.assert_array_equal(points, np.float32(expected).reshape(-1, 3))
        assert {len(values) for values in primvars.values()} == {len(expected)}
        low, high = np.array(extent.Get(time))
        assert np.all(low <= points) and np.all(points <= high)
        assert floor_colors(overlay, time, "/World/Falling") == ([pytest.approx(LIT)] if expected else unlit)
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
    assert floor_colors(overlay, 0, "/World/One/Mesh") == [pytest.approx(LIT)]
    assert len(read_contacts(overlay, 0)[0]) == 1

    again = tmp_path / "again"
    again.mkdir()
    assert main(["replay", str(tmp_path / "overlay.usda"), "--device", "cpu", "--overlay", str(again / "o.usda")]) == 0
    second = Usd.Stage.Open(str(again / "o.usda"))
    assert second.GetRootLayer().subLayerPaths == ["../overlay.usda"]
    np.testing.assert_array_equal(read_contacts(second, 0)[0], read_contacts(second, 0, "/Collisions_/Contacts")[0])


def test_overlay_where_the_topology_changes(tmp_path):
    stage = new_stage(tmp_path / "scene.usda")
    add_floor(stage)
    quad = [*FALLING, (0.9, -0.9, 1.0)]
    mesh = add_mesh(stage, "/World/Falling", {0: moved(FALLING, (0, 0, 0.25)), 1: moved(FALLING, (0, 0, -0.25)),
                                              2: moved(quad, (0, 0, 0.25)), 3: moved(quad, (0, 0, 0.125))})  # fmt: skip
    for time, count, corners in ((0, [3], [0, 1, 2]), (2, [3, 3], [0, 1, 2, 1, 3, 2])):
        mesh.GetFaceVertexCountsAttr().Set(count, time)
        mesh.GetFaceVertexIndicesAttr().Set(corners, time)
    replay(stage)
    overlay = Usd.Stage.Open(str(tmp_path / "overlay.usda"))
    assert [len(floor_colors(overlay, time, "/World/Falling")) for time in (0, 1, 2, 3)] == [1, 1, 2, 2]


def test_overlay_agrees_with_json(tmp_path):
    scene = tmp_path / "cloth_twist.usd"
    shutil.copy(ASSETS / scene.name, scene)
    replay(scene)
    found = json.loads((tmp_path / "hits.json").read_text())
    overlay = Usd.Stage.Open(str(tmp_path / "overlay.usda"))
    for interval in found["intervals"]:
        points, primvars = read_contacts(overlay, interval["start"])
        contacts = interval["contacts"]
        expected = np.array([contact["position"] for contact in contacts], dtype=np.float32).reshape(-1, 3)
        np.testing.assert_array_equal(points, expected)
        np.testing.assert_array_equal(primvars["toi"], np.float32([contact["toi"] for contact in contacts]))
        names = [f"{contact['meshes'][1]} {contact['elements'][1]}" for contact in contacts]
        assert primvars["elementB"] == names
        colors = floor_colors(overlay, interval["start"], "/root/model/triangles")
        lit = {number for number, color in enumerate(colors) if color == pytest.approx(LIT)}
        faces = {contact["indices"][1][0] for contact in contacts if contact["kind"] == "vertex-face"}
        assert faces <= lit and bool(lit) == bool(contacts)
    assert sum(len(interval["contacts"]) for interval in found["intervals"]) == found["hits"] == 33


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
    return [path.name for path in folder.iterdir() if path.name.endswith(".tmp")]


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
    assert floor_colors(overlay, 3)[1] != pytest.approx(LIT)  # it is not known to collide after that
    assert "Partial: 3 of 4 intervals were checked; interrupted." in (tmp_path / "page.html").read_text()
    output = capsys.readouterr()
    assert output.err == "warp-bsc: interrupted\n"
    assert "Partial: 3 of 4 intervals were checked; interrupted." in output.out


def test_interrupted_in_the_middle_of_a_record(stage, tmp_path, monkeypatch):
    write = OutputFile.write
    calls = []

    def interrupted(self, text):
        calls.append(text)
        if len(calls) == 17:  # in the third interval
            write(self, text[: len(text) // 2])
            raise KeyboardInterrupt
        write(self, text)

    monkeypatch.setattr(OutputFile, "write", interrupted)
    replay(stage, status=130)
    counts = {len(json.loads((tmp_path / "hits.json").read_text())["intervals"])}
    assert counts <= {2, 3}
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
    assert f"{tmp_path / 'hits.json'}: File too large" in line
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
    (line,) = done.stderr.splitlines()
    assert line.startswith("warp-bsc: error: ") and "No space left on device" in line
    found, _ = check_partial(tmp_path / "left", None, "No space left on device")
    assert 0 < len(found["intervals"]) < 79
    page = Page((tmp_path / "left" / "page.html").read_text())
    assert page.data["partial"].startswith("Partial: ") and page.data["view"]


def test_no_room_at_the_end_is_an_error(stage, tmp_path, capsys):
    replay(stage)
    size = (tmp_path / "overlay.usda").stat().st_size
    capsys.readouterr()
    with largest_file(size - 100):  # room for JSON and CSV, and for what waits of the overlay
        assert main(["replay", save(stage), "--device", "cpu", "--overlay", str(tmp_path / "overlay.usda")]) == 2
    assert "overlay.usda: not all of it is written" in capsys.readouterr().err
    overlay = Usd.Stage.Open(str(tmp_path / "overlay.usda"))
    data = overlay.GetRootLayer().customLayerData["collisions"]
    assert (data["complete"], data["intervals"], data["stopped"]) == (False, 3, "no room for more")


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
    assert {path.name for path in tmp_path.iterdir()} == {"scene.usda", *OUTPUTS} - {name}


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
    """Tags, handlers, addresses, scripts and data of a page."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.attributes, self.scripts, self.data = set(), [], [], None
        self._inside = None
        self.policy = ""
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        self.attributes += attrs
        attributes = dict(attrs)
        if attributes.get("http-equiv") == "Content-Security-Policy":
            self.policy = attributes["content"]
        self._inside = (tag, attributes.get("type"))

    def handle_data(self, data):
        if self._inside == ("script", "application/json"):
            self.data = json.loads(data)
        elif self._inside == ("script", None):
            self.scripts.append(data)
        self._inside = None


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
    assert "http" not in re.sub(r'"http://www\.w3\.org/2000/svg"|http-equiv', "", text)
    (script,) = page.scripts
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}'" in page.policy and "default-src 'none'" in page.policy
    assert "unsafe" not in page.policy
    assert page.data["title"] == f"Collisions in {HOSTILE}.usda"
    facts = dict(page.data["facts"])
    assert facts["Mesh /World/Floor"] == HOSTILE
    assert facts["Comment"] == f"<!-- {HOSTILE}"


def test_page_shows_the_worst_interval(stage, tmp_path):
    replay(stage, "--validate", "all")
    data = Page((tmp_path / "page.html").read_text()).data
    assert data["intervals"] == [[0, 1, 0, 0], [1, 2, 0, 0], [2, 3, 1, 0], [3, 4, 0, 0]]
    assert sum(data["toi"]) == 1 and data["toi"][9] + data["toi"][10] == 1
    assert data["pairs"] == [{"text": "/World/Floor with /World/Falling", "under": "", "hits": 1}]
    assert (data["view"]["from"], data["view"]["to"], data["view"]["up_axis"]) == (2, 3, "Z")
    faces = np.frombuffer(base64.b64decode(data["view"]["faces"]), dtype="<u4").reshape(-1, 3)
    start = np.frombuffer(base64.b64decode(data["view"]["start"]), dtype="<f4").reshape(-1, 3)
    end = np.frombuffer(base64.b64decode(data["view"]["end"]), dtype="<f4").reshape(-1, 3)
    assert len(faces) == 5 and faces.max() == len(start) - 1
    np.testing.assert_allclose((end - start)[-3:], [(0, 0, -0.5)] * 3, atol=1e-6)
    assert data["validation"]["disagreements"] == []


def test_page_without_collisions(tmp_path):
    stage = new_stage(tmp_path / "scene.usda")
    add_mesh(stage, "/World/Falling", falling(1, 0.5))
    replay(stage)
    view = Page((tmp_path / "page.html").read_text()).data["view"]
    assert (view["from"], view["contacts"], view["lit"]) == (0, "", "")
    assert view["faces"]  # the scene is there to be seen


@pytest.mark.parametrize("visible", ["inherited", "invisible"])
def test_page_where_little_is_there(tmp_path, visible):
    stage = new_stage(tmp_path / "scene.usda")
    mesh = add_mesh(stage, "/World/Falling", falling(1, 0.5))
    mesh.CreateVisibilityAttr().Set(visible, 0)
    mesh.GetVisibilityAttr().Set("inherited", 1)
    mesh.GetPointsAttr().Set(FALLING, 2)
    replay(stage)
    view = Page((tmp_path / "page.html").read_text()).data["view"]
    assert (view is None) == (visible == "invisible")


def browse(page, profile, *options):
    """What headless Chromium prints, and what the page wrote to its console."""
    command = [
        CHROMIUM, "--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--use-gl=angle",
        "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--window-size=1200,1800",
        "--virtual-time-budget=4000", "--enable-logging=stderr", f"--user-data-dir={profile}", *options,
        page.resolve().as_uri(),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120)
    return done.stdout, [line for line in done.stderr.splitlines() if "CONSOLE" in line]


@pytest.mark.browser
def test_page_in_chromium(tmp_path):
    scene = tmp_path / "cloth_twist.usd"
    shutil.copy(ASSETS / scene.name, scene)
    page = replay(scene)[3]
    dom, console = browse(page, tmp_path / "profile", "--dump-dom")
    assert console == []
    assert dom.count('class="hover"') == 14 + 20  # a bar an interval, and a bar a part of the interval
    assert re.search(r'id="viewer-message" hidden', dom)  # it would say why there is no view in 3D
    assert "/root/model/triangles" in dom and "time 250 to 251" in dom

    picture = tmp_path / "page.png"
    _, console = browse(page, tmp_path / "profile", f"--screenshot={picture}")
    assert console == []
    import matplotlib.image  # noqa: PLC0415

    pixels = matplotlib.image.imread(picture)[:, :, :3]
    red, green, blue = np.moveaxis(pixels[200:720, 100:1100], 2, 0)
    assert (blue > red + 0.15).mean() > 0.03  # the cloth
    assert ((red > 0.7) & (green < 0.75) & (blue < 0.4)).sum() > 30  # contacts


@pytest.mark.browser
def test_hostile_names_do_nothing_in_chromium(tmp_path):
    page = replay(hostile_stage(tmp_path))[3]
    dom, console = browse(page, tmp_path / "profile", "--dump-dom")
    assert console == []  # neither an error nor a refusal by the policy: there was nothing to refuse
    assert "<img" not in dom
    assert "&lt;img src=x onerror=alert(1)&gt;" in dom
