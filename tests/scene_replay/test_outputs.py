"""All files of a replay together: whole, partial after an interruption or on a full disk, or not there at all."""

import contextlib
import json
import os
import shlex
import shutil
import subprocess
import sys

import numpy as np
import pytest
from progress_lines import without_progress
from pxr import Usd, UsdGeom
from replay_files import (
    OPTIONS,
    OUTPUTS,
    Page,
    errors_of,
    falling_through_quads,
    largest_file,
    left_behind,
    many_hits,
    read_contacts,
    read_polygons,
    replay,
)
from usd_stages import FALLING, add_mesh, floor_stage, moved, new_stage, save

from warp_bsc._atomic_file import OutputFile
from warp_bsc.cli import replay_run
from warp_bsc.cli.main import main
from warp_bsc.usd.write.layer import SceneLayer


@pytest.fixture
def stage(tmp_path):
    return falling_through_quads(tmp_path)


def test_what_is_printed_names_the_files(stage, capsys, tmp_path):
    replay(stage)
    output = capsys.readouterr().out
    for name in OUTPUTS:
        assert f"Wrote {tmp_path / name}." in output
    assert "usdview shows them by Display, Display Purposes, Guide" in " ".join(output.split())
    assert "note: Motion between time samples is taken to be linear." in output


@pytest.mark.parametrize("option", OPTIONS)
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


def check_partial(folder, count, reason):
    found = json.loads((folder / "hits.json").read_text())
    assert count in (None, len(found["intervals"]))
    assert found["complete"] is False and reason in found["stopped"]
    assert (folder / "hits.csv").read_text().splitlines()[-1].startswith(f"# partial: {count or ''}")
    columns = np.load(folder / "hits.npz")
    facts = json.loads(str(columns["facts"]))
    assert facts["complete"] is False and reason in facts["stopped"] and count in (None, len(columns["starts"]))
    assert facts["hits"] == np.count_nonzero(columns["normal"].any(axis=1))
    overlay = Usd.Stage.Open(str(folder / "overlay.usda"))
    assert errors_of(overlay) == []
    assert Page((folder / "page.html").read_text()).data["partial"].startswith("Partial: ")
    data = overlay.GetRootLayer().customLayerData["collisions"]
    assert data["complete"] is False and reason in data["stopped"]
    assert left_behind(folder) == []
    return found, overlay


def test_interrupted(stage, tmp_path, monkeypatch, capsys):
    whole = replay_run.replay

    def interrupted(*arguments, **options):
        for index, found in enumerate(whole(*arguments, **options)):
            if index == 3:
                raise KeyboardInterrupt
            yield found

    monkeypatch.setattr(replay_run, "replay", interrupted)
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
    assert len(np.load(tmp_path / "hits.npz")["starts"]) == 2
    assert (tmp_path / "hits.csv").read_text().splitlines()[-1].startswith("# partial: 2 of 4 intervals")
    overlay = Usd.Stage.Open(str(tmp_path / "overlay.usda"))
    assert errors_of(overlay) == [] and overlay.GetRootLayer().customLayerData["collisions"]["intervals"] == 2


def test_broken_scene_leaves_what_was_finished(stage, tmp_path, capsys):
    points = [(0, 0, 0), (1, 0, 0), (0, float("nan"), 0)]
    UsdGeom.Mesh(stage.GetPrimAtPath("/World/Falling")).GetPointsAttr().Set(points, 3)
    replay(stage, "--strict", status=2)
    check_partial(tmp_path, 2, "vertex 2 is not finite at time 3")
    assert "vertex 2 is not finite" in capsys.readouterr().err


def test_full_disk(tmp_path, capsys):
    stage = floor_stage(tmp_path)
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
    assert errors_of(overlay) == []
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
@pytest.mark.parametrize("size", [600_000, pytest.param(1_600_000, marks=pytest.mark.slow)])
def test_full_disk_has_room_for_all_files(tmp_path, size):
    stage = floor_stage(tmp_path)
    many = [moved(FALLING, (0.01 * number, 0, 0)) for number in range(40)]
    points = {time: [point for part in many for point in moved(part, (0, 0, z))]
              for time, z in ((time, 0.25 if time % 2 else -0.25) for time in range(80))}  # fmt: skip
    add_mesh(stage, "/World/Falling", points, [3] * 40, list(range(120)))
    for name in ("disk", "left"):
        (tmp_path / name).mkdir()
    files = [tmp_path / "disk" / name for name in OUTPUTS]
    named = [str(word) for pair in zip(OPTIONS, files, strict=True) for word in pair]
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
    writing, calls = SceneLayer.writing, []

    @contextlib.contextmanager
    def without_room(*arguments):
        calls.append(arguments)
        with largest_file(10_000) if len(calls) == 1 else contextlib.nullcontext(), writing(*arguments) as layer:
            yield layer

    monkeypatch.setattr(SceneLayer, "writing", without_room)
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

    monkeypatch.setattr(replay_run, "replay", broken)
    replay(stage, status=2)
    assert capsys.readouterr().err.startswith(
        f"warp-bsc: error: {tmp_path}/scene.usda: RuntimeError: of the first interv"
    )
    assert (tmp_path / "hits.json").read_text() == "old"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["hits.json", "scene.usda"]
