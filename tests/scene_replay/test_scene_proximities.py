"""Proximities at the times themselves: what comes too near, how near, when and where."""

import csv

import numpy as np
import pytest
from usd_stages import FALLING, FLOOR, add_mesh, animate, find, floor_stage, moved, new_stage, save

import warp_bsc as bsc
from warp_bsc.cli.main import main

HEIGHTS = [1, 0.25, 0.125, 0.5]
"""Of FALLING's lowest point, 0.5 below the others, at times 0 to 3."""


@pytest.fixture
def stage(tmp_path):
    """A triangle that comes near a floor and leaves it again."""
    stage = floor_stage(tmp_path)
    add_mesh(stage, "/World/Falling", {t: moved(FALLING, (0, 0, z)) for t, z in enumerate(HEIGHTS)})
    return stage


def test_how_near_when_and_where(stage, capsys, tmp_path):
    out = tmp_path / "hits.csv"
    found = find(stage, "--clearance", "0.3", "--csv", str(out))
    assert found["hits"] == 0 and found["clearance"] == 0.3
    (nearest,) = found["nearest"]
    # vertex 0 with the floor's first triangle; the edge between the triangles is 0.7 away from below it
    assert nearest == {
        "meshes": ["/World/Falling", "/World/Floor"],
        "elements": ["vertex 0", "face 0"],
        "time": 2,
        "distance": 0.125,
        "position": [0.5, -0.5, 0.0625],
        "pairs": 1,
    }
    samples = [interval["proximities"] for interval in found["intervals"]]
    assert [sample["start"]["pairs"] for sample in samples] == [0, 1, 1]
    assert [sample["end"]["pairs"] for sample in samples] == [1, 1, 0]
    rows = [row for interval in found["intervals"] for row in interval["proximity_pairs"]]
    assert [(row["kind"], row["time"], row["distance"], row["phase"]) for row in rows] == [
        ("vertex-face", 1, 0.25, "near"),
        ("vertex-face", 2, 0.125, "near"),
    ]
    assert found["intervals"][-1]["proximity_pairs_at_end"] == []
    with out.open() as file:
        written = list(csv.DictReader(file))
    assert [(row["time"], row["distance"], row["first_element"], row["z"], row["toi"]) for row in written] == [
        ("1.0", "0.25", "vertex 0", "0.125", ""),
        ("2.0", "0.125", "vertex 0", "0.0625", ""),
    ]
    capsys.readouterr()
    assert main(["replay", save(stage), "--device", "cpu", "--clearance", "0.3"]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "at most 0.3 apart at 2 of 4 times" in printed and "between times, distances are not checked" in printed
    assert "The smallest distance is 0.125, at 2" in printed
    assert "/World/Falling, vertex 0, with /World/Floor, face 0.125 2 0.5 -0.5 0.0625 0" in printed  # a folded cell


def test_the_last_time_is_listed(stage):
    found = find(stage, "--clearance", "0.5")
    assert [row["distance"] for row in found["intervals"][-1]["proximity_pairs_at_end"]] == [0.5]


def test_it_can_fail_and_needs_a_distance(stage, capsys):
    path = save(stage)
    arguments = ["replay", path, "--device", "cpu", "--fail-on", "distance"]
    assert main([*arguments, "--clearance", "0.2"]) == 1
    assert main([*arguments, "--clearance", "0.1"]) == 0
    assert "No elements are at most 0.1 apart, at 4 times" in capsys.readouterr().out
    assert main(arguments) == 2
    assert "--fail-on distance needs --clearance" in capsys.readouterr().err
    for wrong in ("0", "-1", "inf", "nan", "far"):
        assert main([*arguments, "--clearance", wrong]) == 2


def test_nothing_is_looked_for_without_a_distance(stage, capsys):
    found = find(stage)
    assert found["nearest"] == [] and found["clearance"] is None
    assert not any({"proximities", "proximity_pairs"} & interval.keys() for interval in found["intervals"])
    assert "apart" not in capsys.readouterr().out
    assert all(result.proximities is None for result in bsc.replay(bsc.Scene(save(stage)), device="cpu"))


def test_a_still_scene_is_checked(tmp_path):
    stage = floor_stage(tmp_path)
    add_mesh(stage, "/World/Above", moved(FLOOR, (0, 0, 0.25)))
    (result,) = bsc.replay(bsc.Scene(save(stage)), device="cpu", clearance=0.25)
    start, end = result.proximities
    assert start is end and len(start) > 8 and set(start.distance.tolist()) == {0.25}
    assert len(result.contacts) == 0


def strip(gap):
    """Two rectangles side by side, joined by a third around a fold: the outer ones face each other at a gap."""
    points = [(0, 0, 0), (0, 1, 0), (4, 0, 0), (4, 1, 0), (4, 0, gap), (4, 1, gap), (0, 0, gap), (0, 1, gap)]
    return points, [4] * 3, [0, 2, 3, 1, 2, 4, 5, 3, 4, 6, 7, 5]


def test_a_mesh_with_itself_but_its_neighbours(tmp_path):
    stage = new_stage(tmp_path / "scene.usda")
    points, counts, indices = strip(0.25)
    add_mesh(stage, "/World/Cloth", {0: points, 1: strip(0.125)[0]}, counts, indices)
    scene = bsc.Scene(save(stage))
    (result,) = bsc.replay(scene, device="cpu", clearance=0.25)
    start, end = result.proximities
    assert len(start) and set(start.distance.tolist()) == {0.25} and set(end.distance.tolist()) == {0.125}
    neighbours = {frozenset(side) for a, b, c in start.segment.faces.tolist() for side in ((a, b), (b, c), (c, a))}
    for near in (start, end):
        for vertices, faces in zip(near.vertices.tolist(), near.faces.tolist(), strict=True):
            first = [vertex for vertex in vertices[0] if vertex >= 0]
            second = [vertex for vertex in vertices[1] if vertex >= 0] or start.segment.faces[faces[1]].tolist()
            assert not any(a == b or frozenset((a, b)) in neighbours for a in first for b in second)
    without = bsc.Scene(scene.path, selection=bsc.Selection(self_collisions=False))
    (result,) = bsc.replay(without, device="cpu", clearance=0.25)
    assert [len(near) for near in result.proximities] == [0, 0]


def test_a_mesh_that_only_its_transform_moves_is_not_checked_with_itself(tmp_path):
    stage = new_stage(tmp_path / "scene.usda")
    mesh = add_mesh(stage, "/World/Clip", *strip(0.25))
    animate(mesh, (0, 0, 0), (0.5, 0, 0))
    (result,) = bsc.replay(bsc.Scene(save(stage)), device="cpu", clearance=0.25)
    assert [len(near) for near in result.proximities] == [0, 0]


def test_ignored_and_unselected_pairs_do_not_count(stage):
    for options in (("--ignore", "*Fall*", "*Floor"), ("--between", "/World/Floor", "/World/Floor")):
        assert find(stage, "--clearance", "0.3", *options)["nearest"] == []


def test_a_time_is_checked_once(tmp_path):
    stage = floor_stage(tmp_path)
    animate(add_mesh(stage, "/World/Falling", FALLING), (0, 0, 0.5), (0, 0, 0.25), (0, 0, 0.125))
    first, second = bsc.replay(bsc.Scene(save(stage)), device="cpu", clearance=1.0)
    ends = [[sample.nearest[0].distance for sample in result.summary.proximities] for result in (first, second)]
    np.testing.assert_allclose(ends, [[0.5, 0.25], [0.25, 0.125]])
    assert first.proximities[1] is second.proximities[0]


def test_some_times_alone(stage):
    found = find(stage, "--clearance", "0.3", "--frames", "0:2")
    assert [row["distance"] for row in found["intervals"][-1]["proximity_pairs_at_end"]] == [0.125]


def test_what_is_near_is_new_against_a_baseline(stage, tmp_path, capsys):
    path, before = save(stage), tmp_path / "before.json"
    arguments = ["replay", path, "--device", "cpu", "--fail-on", "new", "--baseline", str(before)]
    assert main(["replay", path, "--device", "cpu", "--json", str(before)]) == 0
    assert main([*arguments, "--clearance", "0.3"]) == 2  # nothing is known of distances then
    assert f"error: --clearance: {before} lists no proximities" in capsys.readouterr().err
    assert main(arguments) == 0
    assert main(["replay", path, "--device", "cpu", "--json", str(before), "--clearance", "0.2"]) == 0
    capsys.readouterr()
    assert main([*arguments, "--clearance", "0.3"]) == 2
    assert f"--clearance: {before} lists proximities up to 0.2, less than 0.3" in capsys.readouterr().err
    assert main([*arguments, "--clearance", "0.2"]) == main([*arguments, "--clearance", "0.15"]) == 0
    falling = stage.GetPrimAtPath("/World/Falling")
    falling.GetAttribute("points").Set(moved(FALLING, (0, 0, 0.1875)), 1)
    save(stage)
    capsys.readouterr()
    assert main([*arguments, "--clearance", "0.2"]) == 1
    new = capsys.readouterr().out.split("New against the baseline: 1 interval or time.\n")[1]
    assert new.startswith("  /World/Falling with /World/Floor is near at 1\n")


def test_since_when_and_until_when(stage, tmp_path):
    found = find(stage, "--clearance", "0.3")
    assert found["proximity_spans"] == [
        {"meshes": ["/World/Falling", "/World/Floor"], "since": 1, "until": 2, "distance": 0.125, "nearest_at": 2}
    ]
    # where they crossed they were nearer than any distance
    before, path = tmp_path / "before.json", save(stage)
    falling = stage.GetPrimAtPath("/World/Falling").GetAttribute("points")
    falling.Set(moved(FALLING, (0, 0, -0.125)), 1)
    falling.Set(moved(FALLING, (0, 0, -0.125)), 2)
    save(stage)
    options = ["--device", "cpu", "--clearance", "0.05"]
    assert main(["replay", path, *options, "--json", str(before)]) == 0
    falling.Set(moved(FALLING, (0, 0, 0.03125)), 1)
    falling.Set(moved(FALLING, (0, 0, 0.03125)), 2)
    save(stage)
    assert main(["replay", path, *options, "--baseline", str(before), "--fail-on", "new"]) == 0
