"""What need not be reported: pairs that are known, overlap at first, or were there in an earlier replay."""

import json

import pytest
from stages import FALLING, add_falling, add_floor, add_mesh, find, moved, new_stage, save

import warp_bsc as bsc
from warp_bsc.cli.main import main
from warp_bsc.usd.selection import Selection


@pytest.fixture
def stage(tmp_path):
    """A triangle falls through a floor from time 0 to 1; another one rests in it, and leaves it from time 2 to 3."""
    stage = new_stage(tmp_path / "scene.usda")
    add_floor(stage)
    add_falling(stage)
    heights = [-0.25, -0.25, -0.25, 0.25]
    add_mesh(stage, "/World/Resting", {t: moved(FALLING, (-1, 1, z)) for t, z in enumerate(heights)})
    return stage


def colliding(found):
    return {tuple(pair["meshes"]): pair["hits"] for pair in found["mesh_pairs"]}


FALLS, RESTS = ("/World/Floor", "/World/Falling"), ("/World/Floor", "/World/Resting")


def test_what_crosses_at_first_is_ignored(stage, capsys):
    whole = find(stage)
    assert colliding(whole).keys() == {FALLS, RESTS}
    capsys.readouterr()
    found = find(stage, "--ignore-initial")
    assert colliding(found) == {FALLS: colliding(whole)[FALLS]}
    assert found["ignored"] == [{"meshes": list(RESTS), "hits": colliding(whole)[RESTS]}]
    assert {tuple(span["meshes"]) for span in found["intersections"]} == {FALLS}
    assert found["intervals"][0]["edges_through_faces"] == []
    printed = capsys.readouterr().out
    assert f"Ignored: 1 colliding pair of 1 pair of meshes.\n  1 of {RESTS[0]} with {RESTS[1]}\n" in printed
    assert found["validation"]["disagreements"] == []


@pytest.mark.parametrize(
    ("options", "left"),
    [
        (["--ignore", "/World/Floor", "/World/Fall*"], RESTS),
        (["--ignore", "/World/R*", "/World/Floor"], FALLS),
        (["--ignore", "/World/R*", "/World/Falling"], None),
        (["--ignore", "/World/R*", "/World/F*", "--ignore", "/World/Falling", "/World/Falling"], FALLS),
    ],
)
def test_pairs_are_ignored_by_their_names(stage, options, left):
    found = find(stage, *options)
    assert colliding(found).keys() == ({FALLS, RESTS} if left is None else {left})


def test_pairs_are_ignored_by_a_file(stage, tmp_path, capsys):
    pairs = tmp_path / "known.txt"
    pairs.write_text("# known\n\n/World/Floor '/World/Falling'  # falls\n/World/Gone /World/*\n")
    found = find(stage, "--ignore-from", str(pairs))
    assert colliding(found).keys() == {RESTS}
    assert "ignore: pairs of patterns that match no meshes: 1, the first is /World/Gone /World/*" in found["warnings"]
    for text, reason in (
        ("/World/A", "line 1: must be two patterns, not 1"),
        ("\n'a b", "line 2: No closing quotation"),
    ):
        pairs.write_text(text)
        capsys.readouterr()
        assert main(["replay", save(stage), "--device", "cpu", "--ignore-from", str(pairs)]) == 2
        assert capsys.readouterr().err == f"warp-bsc: error: {pairs}: {reason}\n"


def test_in_python(stage):
    scene = bsc.Scene(save(stage), selection=Selection(ignore=(RESTS,)))
    first, *_ = bsc.replay(scene, device="cpu")
    assert first.summary.mesh_pairs.keys() == {FALLS} and first.summary.ignored == {}
    results = list(bsc.replay(bsc.Scene(scene.path), device="cpu", ignore_initial=True))
    assert [result.summary.ignored.keys() for result in results] == [set(), set(), {RESTS}]
    with pytest.raises(ValueError, match="ignore_initial: needs intersections=True"):
        next(bsc.replay(scene, device="cpu", ignore_initial=True, intersections=False))


def test_frame_ranges(tmp_path, capsys):
    stage = new_stage(tmp_path / "scene.usda")
    add_floor(stage)
    heights = [0.25, -0.25, 0.25, 1, 0.25, -0.25]
    add_mesh(stage, "/World/Bouncing", {t: moved(FALLING, (0, 0, z)) for t, z in enumerate(heights)})
    found = find(stage)
    assert [(span["since"], span["until"]) for span in found["collision_spans"]] == [(0, 2), (4, 5)]
    assert sum(span["hits"] for span in found["collision_spans"]) == found["hits"]
    assert f"{found['hits']} of /World/Floor with /World/Bouncing, from 0 to 2, 4 to 5\n" in capsys.readouterr().out


def test_what_is_new_against_a_baseline(stage, tmp_path, capsys):
    before, options = tmp_path / "before.json", ["--device", "cpu", "--baseline"]
    falling = stage.GetPrimAtPath(FALLS[1]).GetAttribute("points")
    through = falling.Get(1)
    falling.Set(falling.Get(0), 1)
    path = save(stage)
    assert main(["replay", path, "--device", "cpu", "--json", str(before)]) == 0
    falling.Set(through, 1)
    save(stage)
    capsys.readouterr()
    assert main(["replay", path, *options, str(before), "--fail-on", "new"]) == 1
    printed = capsys.readouterr().out
    assert "/World/Floor with /World/Falling collides from 0 to 1\n" in printed
    assert "/World/Floor with /World/Falling crosses at 1\n" in printed
    assert "Resting" not in printed.split("New against the baseline")[1]
    assert main(["replay", path, "--device", "cpu", "--json", str(before)]) == 0
    assert main(["replay", path, *options, str(before), "--fail-on", "new"]) == 0
    assert "Nothing is new against the baseline." in capsys.readouterr().out
    before.write_text(json.dumps(json.loads(before.read_text()), indent=1))  # as other programs write it
    assert main(["replay", path, *options, str(before), "--fail-on", "new,collisions"]) == 1
    assert "Nothing is new" in capsys.readouterr().out
    whole = before.read_text()
    before.write_text(whole.replace('"complete": true', '"complete": false'))
    assert main(["replay", path, *options, str(before)]) == 2
    assert "before.json: its replay was stopped; the baseline must be complete" in capsys.readouterr().err
    before.write_text(whole.replace('"intersections": true', '"intersections": false'))
    assert main(["replay", path, *options, str(before)]) == 2
    assert f"error: --intersections: {before} lists none" in capsys.readouterr().err
    assert main(["replay", path, *options, str(before), "--no-intersections", "--fail-on", "new"]) == 0
    before.unlink()
    assert main(["replay", path, *options, str(before)]) == 2
    assert f"error: {before}: No such file or directory\n" in capsys.readouterr().err
    for text in ("{}", "[]", "no JSON", ""):
        before.write_text(text)
        assert main(["replay", path, *options, str(before)]) == 2
        assert "before.json: not a JSON file of this version's replay" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "difference"),
    [
        (["--method", "conservative"], "method was exact, and is conservative"),
        (["--ignore", *FALLS], "ignore was [], and is [['/World/Floor', '/World/Falling']]"),
        (["--frames", "0:1"], "frames was None, and is {'start': 0.0, 'end': 1.0, 'step': None}"),
        (["--no-self"], "self_collisions was True, and is False"),
        (["--ignore-initial"], "ignore_initial was False, and is True"),
        (["--validate", "1", "--strict"], None),
    ],
)
def test_a_baseline_with_other_options(stage, tmp_path, capsys, options, difference):
    before, path = str(tmp_path / "before.json"), save(stage)
    assert main(["replay", path, "--device", "cpu", "--json", before]) == 0
    capsys.readouterr()
    status = main(["replay", path, "--device", "cpu", "--baseline", before, "--fail-on", "new", *options])
    said = f"warp-bsc: error: {before}: written with other options; cannot compare: {difference}\n"
    assert (status, capsys.readouterr().err) == ((2, said) if difference else (0, ""))


@pytest.mark.parametrize(
    ("options", "status"),
    [
        ([], 0),
        (["--fail-on", "intersections"], 1),
        (["--fail-on", "collisions,intersections"], 1),
        (["--fail-on", "intersections", "--ignore", "/World/*", "/World/*"], 0),
        (["--fail-on", "collisions", "--prims", "/World/Floor", "/World/Resting", "--frames", "0:2"], 0),
        (["--fail-on", "intersections", "--prims", "/World/Floor", "/World/Falling", "--frames", "0:1"], 1),
        (["--fail-on", "new"], 2),
        (["--fail-on", "anything"], 2),
        (["--fail-on", "intersections", "--no-intersections"], 2),
        (["--ignore-initial", "--no-intersections"], 2),
    ],
)
def test_exit_status(stage, options, status):
    assert main(["replay", save(stage), "--device", "cpu", *options]) == status
