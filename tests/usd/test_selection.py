"""The selection: which pairs of meshes are checked, and which are ignored."""

import pytest
from pxr import UsdGeom
from usd_stages import FALLING, add_falling, add_floor, add_mesh, find, moved, new_stage, resting_stage, save

import warp_bsc as bsc
from warp_bsc.cli.main import main
from warp_bsc.usd.selection import Selection


@pytest.fixture
def stage(tmp_path):
    return new_stage(tmp_path / "scene.usda")


@pytest.fixture
def crowd(stage):
    """A floor, a mesh A of two triangles of which one falls through the floor and the other, and B as A's first."""
    add_floor(stage)
    start = [*moved(FALLING, (0, 0, 0.25)), (0.3, -0.7, 0.1), (0.7, -0.4, 0.1), (0.7, -0.7, 0.1)]
    end = moved(FALLING, (0, 0, -0.25)) + start[3:]
    add_mesh(stage, "/World/A/Mesh", {0: start, 1: end}, [3, 3], list(range(6)))
    add_falling(stage, "/World/B")
    UsdGeom.Xformable(stage.GetPrimAtPath("/World/B")).AddTranslateOp().Set((-1.5, 0.1, 0))
    return stage


def pairs(found):
    return {tuple(pair["meshes"]): pair["hits"] for pair in found["mesh_pairs"]}


A, B, GROUND = "/World/A/Mesh", "/World/B", "/World/Floor"


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ([], {(GROUND, A), (A, A), (GROUND, B)}),
        (["--no-self"], {(GROUND, A), (GROUND, B)}),
        (["--self"], {(GROUND, A), (A, A), (GROUND, B)}),
        (["--prims", "/World/A", "/World/Fl*"], {(GROUND, A), (A, A)}),
        (["--prims", "/World/A", "--prims", "/World/B"], {(A, A)}),
        (["--exclude", "/World/A"], {(GROUND, B)}),
        (["--between", "/World/A", "/World/Floor"], {(GROUND, A)}),
        (["--between", "/World/[AB]*", "*"], {(GROUND, A), (A, A), (GROUND, B)}),
        (["--between", "/World/A", "/World/A"], {(A, A)}),
    ],
)
def test_pairs(crowd, options, expected):
    assert set(pairs(find(crowd, *options))) == expected


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--prims", "/World/Z"], "--prims: no mesh matches /World/Z"),
        (["--exclude", "/World/Z*"], "--exclude: no mesh matches /World/Z*"),
        (["--between", "/World/A", "/World/Z"], "--between: no mesh matches /World/Z"),
        (["--frames", "5:9"], "--frames"),
        (["--frames", "3:1"], "--frames"),
        (["--frames", "0:1:0"], "step must be finite and more than 0"),
        (["--frames", "a:b"], "three numbers"),
        (["--subdivide", "0"], "at least 1"),
        (["--validate", "some"], "--validate"),
        (["--purpose", "fun"], "fun"),
        (["--json", "--csv"], "only one of them can be printed"),
        (["--overlay", "out.usdz"], "must end in .usda, .usdc or .usd"),
        (["--report", "gone/out.html"], "there is no folder gone"),
        (["--json", "same.json", "--csv", "same.json"], "named twice"),
    ],
)
def test_wrong_use_is_one_line(crowd, capsys, tmp_path, monkeypatch, options, message):
    monkeypatch.chdir(tmp_path)
    assert main(["replay", save(crowd), "--device", "cpu", *options]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("warp-bsc: error: ") and message in line
    assert {path.name for path in tmp_path.iterdir()} == {"scene.usda"}


@pytest.fixture
def resting(tmp_path):
    return resting_stage(tmp_path)


def colliding(found):
    return {tuple(pair["meshes"]): pair["hits"] for pair in found["mesh_pairs"]}


FALLS, RESTS = ("/World/Floor", "/World/Falling"), ("/World/Floor", "/World/Resting")


def test_what_crosses_at_first_is_ignored(resting, capsys):
    whole = find(resting)
    assert colliding(whole).keys() == {FALLS, RESTS}
    capsys.readouterr()
    found = find(resting, "--ignore-initial")
    assert colliding(found) == {FALLS: colliding(whole)[FALLS]}
    (ignored,) = found["ignored"]
    assert (sorted(ignored["meshes"]), ignored["hits"]) == (sorted(RESTS), colliding(whole)[RESTS])
    assert ignored["edges"] > 0 and ignored["meant"] is None
    assert {tuple(span["meshes"]) for span in found["intersections"]} == {FALLS}
    assert found["intervals"][0]["edges_through_faces"] == []
    printed = capsys.readouterr().out
    first, second = sorted(RESTS)
    assert f"Not counted: 1 ignored pair of meshes, 1 collision.\n  1 of {first} with {second}, at most " in printed
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
def test_pairs_are_ignored_by_their_names(resting, options, left):
    found = find(resting, *options)
    assert colliding(found).keys() == ({FALLS, RESTS} if left is None else {left})


def test_in_python(resting):
    scene = bsc.Scene(save(resting), selection=Selection(ignore=(RESTS,)))
    first, *_ = bsc.replay(scene, device="cpu")
    assert first.summary.mesh_pairs.keys() == {FALLS} and first.summary.ignored == {}
    results = list(bsc.replay(bsc.Scene(scene.path), device="cpu", ignore_initial=True))
    assert [result.summary.ignored.keys() for result in results] == [set(), set(), {RESTS}]
    with pytest.raises(ValueError, match="ignore_initial: needs intersections=True"):
        next(bsc.replay(scene, device="cpu", ignore_initial=True, intersections=False))
