"""Meshes that are wholly inside others at the times themselves: which, since when, and what silences them."""

import csv
import json

import pytest
from boxes import CORNERS, SIDES, add_box, sum_up
from usd_stages import FALLING, add_mesh, animate, find, moved, new_stage, save

import warp_bsc as bsc
from warp_bsc.cli.main import main


@pytest.fixture
def stage(tmp_path):
    return new_stage(tmp_path / "scene.usda")


def add_scaled_box(stage, path, size, by=(0, 0, 0), *, is_open=False):
    points = moved([[size * coordinate for coordinate in corner] for corner in CORNERS], by)
    return add_mesh(stage, path, points, [4] * (6 - is_open), SIDES[4 * is_open :])


def test_a_box_in_a_box(stage, capsys, tmp_path):
    add_scaled_box(stage, "/World/Case", 4)
    add_box(stage, "/World/Inside", (1, 1.5, 2))
    out = tmp_path / "hits.csv"
    found = find(stage, "--csv", str(out), "--fail-on", "intersections", status=1)
    printed = capsys.readouterr().out
    assert "Already inside at 0: 1 part inside." in printed
    assert "  /World/Inside inside /World/Case: at 0, 1 part, stays\n" in printed
    (span,) = found["intersections"]
    assert (span["meshes"], span["inside"], span["trend"]) == (["/World/Inside", "/World/Case"], True, "stays")
    (interval,) = found["intervals"]
    assert interval["edges_through_faces"] == interval["contacts"] == []
    assert interval["intersections"]["start"]["inside"] == [{"meshes": ["/World/Inside", "/World/Case"], "parts": 1}]
    (row,) = interval["inside"]
    assert (row["kind"], row["phase"], row["time"]) == ("vertex-face", "inside", 0)
    assert (row["meshes"], row["elements"]) == (["/World/Inside", "/World/Case"], ["vertex 0", "face 5"])
    assert row["position"] == [1, 1.5, 2]
    with out.open() as file:
        (written,) = csv.DictReader(file)
    assert (written["kind"], written["phase"], written["first_mesh"]) == ("vertex-face", "inside", "/World/Inside")
    assert main(["replay", save(stage), "--device", "cpu", "--no-intersections", "--json", str(out)]) == 0
    assert "inside" not in json.loads(out.read_text())["intervals"][0]


@pytest.mark.parametrize("at", [(1, 1, 1), (-0.5, 1, 1), (5, 1, 1), (3, 1, 1), (-1, 1, 1)])
def test_in_an_open_box_through_the_wall_and_beside(stage, at):
    """Only the first two boxes of these are in the case's bounding box, and only one case is closed."""
    add_scaled_box(stage, "/World/Case", 4)
    add_scaled_box(stage, "/World/Open", 4, (0, 20, 0), is_open=True)
    add_box(stage, "/World/One", at)
    add_box(stage, "/World/Two", (at[0], at[1] + 20, at[2]))
    (sample,) = sum_up(bsc.Scene(save(stage))).intersections
    assert sample.inside == ({("/World/One", "/World/Case"): 1} if 0 < at[0] <= 3 else {})
    assert (sample.crossings > 0) == (at[0] == -0.5)  # touching is not crossing
    assert (sample.touches > 0) == (at[0] in (3, -1))


def test_three_in_one_another_and_parts(stage):
    for name, size in (("A", 9), ("B", 6), ("C", 3)):
        add_scaled_box(stage, f"/World/{name}", size, ((9 - size) / 2,) * 3)
    two = [*moved(CORNERS, (4, 4, 4)), *moved(CORNERS, (20, 0, 0))]
    add_mesh(stage, "/World/Two", two, [4] * 12, SIDES + [corner + 8 for corner in SIDES])
    inside = sum_up(bsc.Scene(save(stage))).intersections[0].inside
    names = [("B", "A"), ("C", "A"), ("C", "B"), ("Two", "A"), ("Two", "B"), ("Two", "C")]
    assert inside == {(f"/World/{inner}", f"/World/{outer}"): 1 for inner, outer in names}


@pytest.fixture
def moving(stage):
    """A box that comes into a case through its wall, is inside from 2 to 4, and leaves it through the other wall."""
    add_scaled_box(stage, "/World/Case", 4)
    places = [-3, -0.5, 0.5, 1.5, 2.5, 3.5, 5]
    add_mesh(stage, "/World/Box", {t: moved(CORNERS, (x, 1, 1)) for t, x in enumerate(places)}, [4] * 6, SIDES)
    return stage


def test_since_when_and_until_when(moving, capsys):
    found = find(moving)
    spans = [(span["since"], span["until"], span["inside"], span["trend"]) for span in found["intersections"]]
    assert spans == [(1, 1, False, "then inside"), (2, 4, True, "then crosses"), (5, 5, False, "heals")]
    assert (
        "/World/Box inside /World/Case: from 2 to 4, 1 part at first, 1 at last: then crosses"
        in capsys.readouterr().out
    )
    assert [len(interval["inside"]) for interval in found["intervals"]] == [0, 0, 1, 1, 1, 0]
    assert found["intervals"][-1]["inside_at_end"] == []
    (until,) = find(moving, "--frames", "3:4")["intersections"]
    assert (until["since"], until["until"], until["trend"]) == (3, 4, "stays")
    # a box that leaves was not separate
    separate = [interval["separate_hits"] == interval["hits"] > 0 for interval in found["intervals"]]
    assert separate == [True, False, False, False, False, False]


@pytest.mark.parametrize(
    ("options", "status"),
    [
        ((), 1),
        (("--ignore", "/World/Box", "/World/Case"), 0),
        (("--between", "/World/Box", "/World/Box"), 0),
        (("--ignore-initial",), 0),
        (("--frames", "5:6", "--ignore-initial"), 0),
        (("--frames", "1:2", "--ignore-initial"), 0),
    ],
)
def test_what_is_silenced(moving, options, status):
    options = options if "--frames" in options else (*options, "--frames", "2:4")
    found = find(moving, "--fail-on", "intersections", *options, status=status)
    assert bool(found["intersections"]) == bool(status)


def test_what_is_inside_at_first_still_collides(moving):
    found = find(moving, "--ignore-initial", "--frames", "3:6")
    assert [(span["since"], span["inside"]) for span in found["intersections"]] == [(5, False)]
    assert found["hits"] > 0 and found["intervals"][0]["ignored"] == []


def test_new_against_a_baseline(moving, tmp_path, capsys):
    before, path = tmp_path / "before.json", save(moving)
    arguments = ["replay", path, "--device", "cpu"]
    box = moving.GetPrimAtPath("/World/Box").GetAttribute("points")
    inside = box.Get(3)
    box.Set(box.Get(0), 3)
    save(moving)
    arguments += ["--frames", "0:3"]
    assert main([*arguments, "--json", str(before)]) == 0
    assert main([*arguments, "--baseline", str(before), "--fail-on", "new"]) == 0
    box.Set(inside, 3)
    save(moving)
    capsys.readouterr()
    assert main([*arguments, "--baseline", str(before), "--fail-on", "new"]) == 1
    new = capsys.readouterr().out.split("New against the baseline: 1 interval or time.\n")[1]
    assert new.startswith("  /World/Box is inside /World/Case at 3\n")


def test_a_corner_in_common_is_welded(stage):
    """A box in a corner of its case has no vertex of its own there."""
    add_scaled_box(stage, "/World/Case", 4)
    add_box(stage, "/World/Box", (0, 0, 0))
    add_mesh(stage, "/World/Far", {0: moved(FALLING, (9, 9, 9)), 1: moved(FALLING, (9, 9, 8))})
    scene = bsc.Scene(save(stage))
    summary = sum_up(scene)
    assert summary.scene.interval(0).segment.welded == 1
    assert [sample.inside for sample in summary.intersections] == [{("/World/Box", "/World/Case"): 1}] * 2


def test_in_a_case_that_its_transform_moves(stage):
    case = add_scaled_box(stage, "/World/Case", 4)
    animate(case, (10, 0, 0), (0, 0, 0))
    add_box(stage, "/World/Box", (1, 1, 1))
    summary = sum_up(bsc.Scene(save(stage)))
    assert [bool(sample.inside) for sample in summary.intersections] == [False, True]
