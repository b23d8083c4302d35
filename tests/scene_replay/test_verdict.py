"""Whether a scene is broken, in one sentence: before all sums, by pairs of meshes, what begins later first."""

import re

import pytest
from pxr import UsdGeom
from replay_files import Page, replay
from usd_stages import (
    CORNERS,
    FALLING,
    add_mesh,
    add_tets,
    floor_stage,
    moved,
    new_stage,
    resting_stage,
    save,
)

from warp_bsc.cli.main import main


def printed(capsys, stage, *options):
    capsys.readouterr()
    assert main(["replay", save(stage), "--device", "cpu", *options]) == 0
    return capsys.readouterr().out


def verdict(capsys, stage, *options):
    """The first line that is neither the scene nor a note."""
    return next(line for line in printed(capsys, stage, *options).splitlines()[1:] if not line.startswith("note: "))


@pytest.fixture
def stage(tmp_path):
    """A triangle falls through a floor from time 0 to 1; another one rests in it from the start, deeper."""
    stage = floor_stage(tmp_path)
    for name, x, heights in (("Falling", 0, [0.25, -0.1, -0.1, -0.1]), ("Resting", -1, [-0.25, -0.25, -0.25, 0.25])):
        add_mesh(stage, f"/World/{name}", {time: moved(FALLING, (x, 1, z)) for time, z in enumerate(heights)})
    UsdGeom.SetStageMetersPerUnit(stage, 0.1)
    return stage


def test_what_begins_later_comes_first(stage, capsys, tmp_path):
    """The triangle that rests is the deeper one: a quarter of a unit, the other a tenth. A unit is 10 cm."""
    text = printed(capsys, stage)
    lines = text.splitlines()
    pairs = [
        number for number, line in enumerate(lines) if re.match(r"  /World/\w+ with /World/\w+: [\d.]+ cm deep", line)
    ]
    later, initial = (lines[number] for number in pairs)
    assert later.startswith("  /World/Falling with /World/Floor: 1 cm deep at 1; ") and "first time" not in later
    assert initial.startswith("  /World/Floor with /World/Resting: 2.5 cm deep at ") and initial.endswith(
        "; from the first time on"
    )
    assert lines[pairs[0] - 1] == (
        "Broken: 2 pairs of meshes collide or intersect, 1 of them only after the first time. The worst of these: "
        "/World/Falling with /World/Floor, 1 cm deep, time 0 to 3."
    )
    assert text.index("Broken: ") < text.index("Collisions in ") < text.index("Frames")
    spans = text.split("Intersections at rest")[1]
    assert spans.index("Falling") < spans.index("Resting")
    page = Page(replay(stage)[3].read_text()).data
    assert page["verdict"] == lines[pairs[0] - 1] and page["centimetres"] == pytest.approx(10.0)
    assert [(max(pair["meshes"]), pair["is_initial"]) for pair in page["pairs"]] == [
        ("/World/Floor", False),
        ("/World/Resting", True),
    ]
    assert [pair["depth"][0] for pair in page["pairs"]] == [pytest.approx(0.1), pytest.approx(0.25)]


def test_what_is_there_from_the_start(tmp_path, capsys):
    stage = floor_stage(tmp_path)
    add_mesh(stage, "/World/Falling", {0: moved(FALLING, (0, 0, -0.1)), 1: moved(FALLING, (0, 0, -0.6))})
    assert verdict(capsys, stage).startswith(
        "Broken: 1 pair of meshes collides or intersects, at the first time already. The worst: /World/F"
    )
    said = verdict(capsys, stage, "--no-intersections")
    assert (
        said.startswith("Broken: 1 pair of meshes collides or intersects. The worst: ")
        and " collisions, time 0 to 1." in said
    )


def test_what_no_sample_shows(tmp_path, capsys):
    """The triangle is above the floor at time 0, and below it at time 1."""
    stage = floor_stage(tmp_path)
    add_mesh(stage, "/World/Falling", {0: moved(FALLING, (0, 0, 1)), 1: moved(FALLING, (0, 0, -2))})
    said = "No mesh intersects at a sample: frames there show nothing, but motion blur and frames in between may."
    assert verdict(capsys, stage).endswith(said)
    assert said not in verdict(capsys, stage, "--no-intersections")


def test_a_clean_scene_names_what_was_checked(tmp_path, capsys):
    stage = new_stage(tmp_path / "soft.usda")
    add_tets(stage, CORNERS, [(0, 1, 2, 3)])
    said = verdict(capsys, stage)
    assert said.startswith("Nothing intersects, no tetrahedron inverts: 1 time of 1 mesh and 4 triangles were checked")
    stage = floor_stage(tmp_path)
    add_mesh(stage, "/World/Falling", {0: moved(FALLING, (0, 0, 1)), 1: moved(FALLING, (0, 0, 2))})
    said = verdict(capsys, stage)
    assert said.startswith("Nothing collides, nothing intersects: 1 interval and 2 times of 2 meshes")
    assert "tetrahedron" not in said
    near = verdict(capsys, stage, "--clearance", "2")
    assert near == "Not broken, but: within 2 of each other: 1 pair of meshes."


def test_tetrahedra_that_invert(tmp_path, capsys):
    stage = new_stage(tmp_path / "soft.usda")
    add_tets(stage, CORNERS, [(1, 0, 2, 3)])
    assert verdict(capsys, stage) == "Broken: tetrahedra of 1 mesh invert."


def test_a_run_that_stops_does_not_call_the_scene_clean(tmp_path, capsys, monkeypatch):
    """Nothing collides in the interval that was checked, and the next one is broken."""
    stage = resting_stage(tmp_path)
    run = __import__("warp_bsc.cli.replay_run", fromlist=["replay"])
    whole = run.replay

    def broken(*arguments, **named):
        yield next(iter(whole(*arguments, **named)))
        raise KeyboardInterrupt

    for time in (1, 2, 3):
        stage.GetPrimAtPath("/World/Falling").GetAttribute("points").Set(moved(FALLING, (0, 0, 1)), time)
    stage.RemovePrim("/World/Resting")
    monkeypatch.setattr(run, "replay", broken)
    assert main(["replay", save(stage), "--device", "cpu"]) == 130
    text = capsys.readouterr().out
    assert "Partial: 1 of " in text and "Nothing collides" not in text and "Broken" not in text
