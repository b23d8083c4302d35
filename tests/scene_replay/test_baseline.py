"""The comparison with an earlier replay: what is new, and which baselines are refused."""

import json

import pytest
from chromium import Browser
from replay_files import Page, replay
from usd_stages import resting_stage, save

from warp_bsc.cli.main import main


@pytest.fixture
def stage(tmp_path):
    return resting_stage(tmp_path)


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


@pytest.fixture
def compared(stage, tmp_path, capsys):
    """A replay in which a triangle falls through a floor, as it did not in the baseline: the page, and what is new."""
    before, page = tmp_path / "before.json", tmp_path / "page.html"
    falling = stage.GetPrimAtPath(FALLS[1]).GetAttribute("points")
    through = falling.Get(1)
    falling.Set(falling.Get(0), 1)
    assert main(["replay", save(stage), "--device", "cpu", "--json", str(before), "--clearance", "0.3"]) == 0
    falling.Set(through, 1)
    options = ["--baseline", str(before), "--report", str(page), "--clearance", "0.25"]
    capsys.readouterr()
    assert main(["replay", save(stage), "--device", "cpu", *options]) == 0
    return page, capsys.readouterr().out.split("New against the baseline: ")[1]


def test_the_page_marks_what_is_new(compared):
    path, found = compared
    page = Page(path.read_text())
    assert page.data["tiles"][0] == [found.split()[0], "new against the baseline"]
    assert page.data["has_baseline"] and dict(page.data["facts"])["Baseline"].endswith("before.json")
    new = {tuple(pair["meshes"]): pair["new"] for pair in page.data["pairs"]}
    assert new[FALLS[::-1]] == [["collides", 0, 1], *(["crosses", time, time] for time in (1, 2, 3))]
    assert new[RESTS] == []
    names = [mesh["name"] for mesh in page.data["meshes"]]
    marked = set()
    for name in page.blocks:
        if name.startswith(("hits-", "rest-", "near-")):
            block = page.block(name)
            columns = block["first"], block["second"], block["new"]
            marks = {(names[i], names[j], mark) for i, j, mark in zip(*columns, strict=True)}
            could_be_new = not name.startswith("near-")  # it was near before
            assert all(mark == (could_be_new and "Falling" in first + second) for first, second, mark in marks)
            marked |= {(name[:4], bool(mark)) for *_, mark in marks}
    assert marked >= {("hits", True), ("hits", False), ("rest", True), ("rest", False)}


def test_a_page_without_a_baseline_marks_nothing(stage, tmp_path):
    page = Page(replay(stage)[3].read_text())
    assert not page.data["has_baseline"] and "new against the baseline" not in json.dumps(page.data["tiles"])
    assert not any("new" in page.block(name) for name in page.blocks)


@pytest.mark.browser
def test_new_rows_are_shown_alone(compared, tmp_path):
    with Browser(tmp_path / "profile") as browser:
        browser.open(compared[0])
        browser.wait("document.body.dataset.state === 'ready'")
        assert browser.value("document.querySelectorAll('#pairs .new').length") == 1
        browser.click("#only-new")
        badges = browser.value("[...document.querySelectorAll('#rows tr[data-at]')].map((row) => row.innerText)")
        assert len(badges) > 3 and all("new" in text and "Falling" in text for text in badges)
        assert browser.console == []


@pytest.mark.parametrize(
    ("options", "difference"),
    [
        (["--method", "conservative"], "method was exact, and is conservative"),
        (["--ignore", *FALLS], None),
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
