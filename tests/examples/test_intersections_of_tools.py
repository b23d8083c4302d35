"""The program that asks tools about intersections, with this package alone."""

import importlib.metadata
import json
import sys

import intersections
import pytest


@pytest.fixture
def ours(monkeypatch):
    """Asks this package alone, in this process."""
    monkeypatch.setattr(intersections, "run_apart", lambda function, *arguments: function(*arguments))
    others = {title: intersections.Tool(title, ("no-such-tool",), None) for title in ("CGAL", "VTK")}
    monkeypatch.setattr(intersections, "TOOLS", {"warp-bsc": intersections.TOOLS["warp-bsc"]} | others)


def test_our_answers_are_right(ours, tmp_path, capsys, monkeypatch):
    file = tmp_path / "found.json"
    monkeypatch.setattr(sys, "argv", ["intersections.py", "--triangles", "160", "--json", str(file)])
    assert intersections.main() == 0
    output = capsys.readouterr().out
    assert "CGAL is left out: it is not installed" in output and "a sphere" in output and "160 " in output
    found = json.loads(file.read_text())
    assert len(found["cases"]) > 30 and not any(case["wrong"] for case in found["cases"])
    assert found["record"]["versions"]["warp-bsc"] == importlib.metadata.version("warp-bsc")
    assert found["times"][0]["seconds"]["warp-bsc"]["total"] > 0.0


def test_a_wrong_answer_is_found(ours, monkeypatch):
    wrong = intersections.Tool("warp-bsc", ("warp-bsc",), lambda x, faces: lambda: True)
    monkeypatch.setitem(intersections.TOOLS, "warp-bsc", wrong)
    monkeypatch.setattr(sys, "argv", ["intersections.py"])
    assert intersections.main() == 1


def test_a_tool_that_fails_is_left_out(capsys):
    assert intersections.run_apart(int, "no number") is None
    assert "no number: ValueError" in capsys.readouterr().out
