"""The command ``warp-bsc repair``: errors by name, and valid partial files."""

import argparse
import json
import os
import shlex
import signal
import time

import pytest
from pxr import Usd, UsdGeom
from replay_files import Page, largest_file
from usd_stages import FALLING, add_falling, add_instancer, add_mesh, animate, floor_stage, new_stage, save

from warp_bsc.cli import device
from warp_bsc.cli.main import main
from warp_bsc.cli.repair import add_to as add_repair
from warp_bsc.detection.run import compilation

SQUARE = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]


def crossing_twice(folder):
    """A quad that dips through a plate at two times that are far apart."""
    stage = new_stage(folder / "shot.usda")
    add_mesh(stage, "/World/Plate", [(9 * x - 4, 9 * y - 4, z) for x, y, z in SQUARE], [4], [0, 1, 2, 3])
    heights = {time: -0.1 if time in (9, 40) else 0.3 for time in range(50)}
    points = {time: [(x, y, height) for x, y, _ in SQUARE] for time, height in heights.items()}
    add_mesh(stage, "/World/Quad", points, [4], [0, 1, 2, 3])
    return save(stage)


def repair(path, output, *options):
    return main(["repair", str(path), "--output", str(output), "--device", "cpu", *options])


@pytest.mark.parametrize(
    ("options", "error"),
    [
        (["--keep", "/None"], "--keep: no mesh matches /None"),
        (["--max-move", "0"], "--max-move"),
        (["--min-distance", "x"], "--min-distance"),
        (["--prims", "/None"], "--prims"),
    ],
)
def test_errors_name_the_option(tmp_path, capsys, options, error):
    path = crossing_twice(tmp_path)
    assert repair(path, tmp_path / "fixed.usdc", *options) == 2
    assert error in capsys.readouterr().err
    assert not (tmp_path / "fixed.usdc").exists()


@pytest.mark.parametrize("output", ["shot.usda", "fixed.txt", "none/fixed.usdc"])
def test_bad_outputs(tmp_path, capsys, output):
    path = crossing_twice(tmp_path)
    assert repair(path, tmp_path / output) == 2
    assert str(tmp_path / output) in capsys.readouterr().err


def stop_after_one_stretch(monkeypatch, stop):
    """Lets a function of no arguments stop the repair after its first stretch."""
    run = __import__("warp_bsc.cli.repair_run", fromlist=["repair_shot"])
    whole = run.repair_shot

    def stopped(*arguments, **options):
        stretches = whole(*arguments, **options)
        yield next(stretches)
        stop()
        yield from stretches

    monkeypatch.setattr(run, "repair_shot", stopped)


def interrupt():
    os.kill(os.getpid(), signal.SIGINT)


def test_interrupted_repair_leaves_a_partial_layer(tmp_path, monkeypatch):
    path = crossing_twice(tmp_path)
    stop_after_one_stretch(monkeypatch, interrupt)
    assert repair(path, tmp_path / "fixed.usdc", "--report", str(tmp_path / "page.html")) == 130
    page = Page((tmp_path / "page.html").read_text())
    assert page.data["partial"] == "Partial: interrupted. The layer has not been replayed."
    assert page.data["after"] is None and page.data["tiles"][0][0] == "?"
    stage = Usd.Stage.Open(str(tmp_path / "fixed.usdc"))
    facts = stage.GetRootLayer().customLayerData["repair"]
    assert facts["complete"] is False and facts["stretches"] == 1 and facts["stopped"] == "interrupted"
    assert 10 < stage.GetEndTimeCode() < 40
    assert stage.GetPrimAtPath("/World/Quad").GetAttribute("points").GetTimeSamples()[-1] == stage.GetEndTimeCode()
    assert not [name for name in os.listdir(tmp_path) if name.startswith(".")]


class Killed(BaseException):
    """Ends a run as if the process had been killed: nothing is written after it."""


@pytest.mark.parametrize("how", ["interrupted", "killed", "killed while it wrote"])
def test_resumed_repair_is_the_same(tmp_path, monkeypatch, capsys, how):
    path = crossing_twice(tmp_path)
    whole, fixed = tmp_path / "whole.usda", tmp_path / "fixed.usda"
    part = tmp_path / "fixed.usda.part"
    assert repair(path, whole) == 0 and not (tmp_path / "whole.usda.part").exists()
    with monkeypatch.context() as patch:
        if how == "interrupted":
            stop_after_one_stretch(patch, interrupt)
            assert repair(path, fixed) == 130
        else:
            run = __import__("warp_bsc.cli.repair_run", fromlist=["RepairRun"])
            patch.setattr(run.RepairRun, "close", lambda run: None)
            stop_after_one_stretch(patch, lambda: (_ for _ in ()).throw(Killed))
            with pytest.raises(Killed):
                repair(path, fixed)
            assert not fixed.exists()
    if how == "killed while it wrote":
        part.write_bytes(part.read_bytes()[:-10])
    capsys.readouterr()
    found = __import__("warp_bsc.cli.repair_run", fromlist=["find"])
    activities = []
    monkeypatch.setattr(found, "find", lambda *args, find=found.find: (activities.append(args[1]), find(*args))[1])
    assert repair(path, fixed, "--resume", "--json") == 0
    assert activities == []  # what the earlier run found was read
    assert fixed.read_text() == whole.read_text() and not part.exists()
    assert len(json.loads(capsys.readouterr().out)["stretches"]) == 2


def test_other_options_cannot_resume(tmp_path, monkeypatch, capsys):
    path = crossing_twice(tmp_path)
    with monkeypatch.context() as patch:
        stop_after_one_stretch(patch, interrupt)
        assert repair(path, tmp_path / "fixed.usdc") == 130
    for options, error in (
        (["--max-move", "0.5"], "max_move was None, and is 0.5"),
        (["--keep", "/World/Plate"], "keep was [], and is ['/World/Plate']"),
    ):
        assert repair(path, tmp_path / "fixed.usdc", "--resume", *options) == 2
        assert (
            f"fixed.usdc.part: written with other options or files; cannot resume: {error}" in capsys.readouterr().err
        )
    with open(path, "a") as file:
        file.write("\n")
    assert repair(path, tmp_path / "fixed.usdc", "--resume") == 2
    assert "the scene's files have changed" in capsys.readouterr().err
    (tmp_path / "fixed.usdc.part").write_text("other")
    assert repair(path, tmp_path / "fixed.usdc", "--resume") == 2
    assert "fixed.usdc.part: not a resumable repair of this version" in capsys.readouterr().err


def test_full_disk(tmp_path, capsys):
    path = crossing_twice(tmp_path)
    assert repair(path, tmp_path / "fixed.usda") == 0  # compiles kernels, whose files are large
    size = (tmp_path / "fixed.usda").stat().st_size
    (tmp_path / "fixed.usda").unlink()
    with largest_file(size * 3 // 4):
        assert repair(path, tmp_path / "fixed.usda") == 2
    stage = Usd.Stage.Open(str(tmp_path / "fixed.usda"))
    assert stage.GetRootLayer().customLayerData["repair"]["complete"] is False
    assert 10 < stage.GetEndTimeCode() < 49
    assert "not all of it is written" in capsys.readouterr().err
    assert not [name for name in os.listdir(tmp_path) if name.startswith(".")]


@pytest.mark.parametrize(
    ("mover", "is_named"), [("mesh", True), ("transform", False), ("shape", False), ("instance", False)]
)
def test_replay_says_how_to_repair_only_what_a_repair_moves(tmp_path, capsys, mover, is_named):
    stage = floor_stage(tmp_path)
    heights = (0, 0, 0.25), (0, 0, -0.25)
    if mover == "mesh":
        add_falling(stage)
    elif mover == "transform":
        animate(add_mesh(stage, "/World/Falling", FALLING), *heights)
    elif mover == "shape":
        sphere = UsdGeom.Sphere.Define(stage, "/World/Ball")
        sphere.CreateRadiusAttr(0.25)
        animate(sphere, (0, 0, 1), (0, 0, -1))
    else:
        places = dict(enumerate([[height] for height in heights]))
        add_instancer(stage, "/World/Leaves", places, ["/World/Leaves/Leaf"])
        add_mesh(stage, "/World/Leaves/Leaf", FALLING)
    assert main(["replay", save(stage), "--device", "cpu"]) == 0
    said = capsys.readouterr().out
    assert "Collisions in 1 of 1 interval" in said and ("To repair: " in said) == is_named


def test_replay_says_how_to_repair(tmp_path, capsys):
    """With all options that both commands have."""
    path, triage = crossing_twice(tmp_path), tmp_path / "shot.triage.json"
    triage.write_text('{"version": 1, "meant": []}')
    options = ["--device", "cpu", "--no-self", "--strict", "--frames", "0.0:20.0", "--purpose", "default", "proxy"]
    options += ["--prims", "/World/*", "--ignore", "/World/Quad", "/World/Q 2", "--triage", str(triage)]
    assert main(["replay", path, *options, "--clearance", "0.1"]) == 0
    (line,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("To repair: ")]
    words = shlex.split(line.removeprefix("To repair: "))
    assert words[:3] == ["warp-bsc", "repair", path] and words[-2:] == ["--output", "shot_repaired.usdc"]
    parser = argparse.ArgumentParser()
    add_repair(parser.add_subparsers(), "")
    given = parser.parse_args(["repair", path, *options, *words[-2:]])
    assert vars(parser.parse_args(words[1:])) == vars(given)


@pytest.mark.parametrize("options", [[], ["--json"]])
def test_a_repair_that_compiles_says_so(tmp_path, capsys, monkeypatch, options):
    """On standard error, beside the bar, and not in what programs read."""
    run = __import__("warp_bsc.cli.repair_run", fromlist=["repair_shot"])
    whole = run.repair_shot

    def compiled(*arguments, **named):
        compilation.report_compilation(is_cpu=True)
        time.sleep(0.1)
        compilation.report_compilation(is_cpu=True)
        yield from whole(*arguments, **named)

    path = crossing_twice(tmp_path)
    assert repair(path, tmp_path / "first.usdc") == 0  # compiles what is not in the cache
    monkeypatch.setattr(device, "_SILENT_SECONDS", 0.02)
    monkeypatch.setattr(run, "repair_shot", compiled)
    capsys.readouterr()
    assert repair(path, tmp_path / "fixed.usdc", *options) == 0
    printed = capsys.readouterr()
    assert printed.err.count("Compiling kernels for cpu") == 1 and "Compiling" not in printed.out
    if options:
        assert json.loads(printed.out)["output"] == str(tmp_path / "fixed.usdc")
