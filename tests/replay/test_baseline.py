"""The comparison with an earlier replay: what is new, and which baselines are refused."""

import json

import pytest
from stages import FALLING, add_falling, add_floor, add_mesh, moved, new_stage, save

from warp_bsc.cli.main import main


@pytest.fixture
def stage(tmp_path):
    """A triangle falls through a floor from time 0 to 1; another one rests in it, and leaves it from time 2 to 3."""
    stage = new_stage(tmp_path / "scene.usda")
    add_floor(stage)
    add_falling(stage)
    heights = [-0.25, -0.25, -0.25, 0.25]
    add_mesh(stage, "/World/Resting", {t: moved(FALLING, (-1, 1, z)) for t, z in enumerate(heights)})
    return stage


FALLS, RESTS = ("/World/Floor", "/World/Falling"), ("/World/Floor", "/World/Resting")


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
