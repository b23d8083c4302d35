"""The command that an overlay names: it has every option that results depend on, and no other."""

import argparse
import shlex
from pathlib import Path

import pytest

from warp_bsc.cli.options import scene_path
from warp_bsc.cli.replay_options import add_replay_options, command_of

WITHOUT_EFFECT = {
    "overlay",
    "report",
    "json",
    "csv",
    "npz",
    "baseline",
    "fail_on",
    "workers",
    "progress",
    "resume",
    "device",
}
VALUES = {
    "self_collisions": ["--no-self"],
    "between": ["--between", "A B", "C*"],
    "ignore": ["--ignore", "A", "B", "--ignore", "C", "D"],
    "purpose": ["--purpose", "proxy", "guide"],
    "frames": ["--frames", "1.0:20.5:0.25"],
    "strict": ["--strict"],
    "intersections": ["--no-intersections"],
    "clearance": ["--clearance", "0.002"],
    "ignore_initial": ["--ignore-initial"],
    "subdivide": ["--subdivide", "4"],
    "validate": ["--validate", "all"],
    "limit": ["--limit", "100"],
    "triage": ["--triage", "shot of.triage.json"],
    "prims": ["--prims", "/World/A*", "/World/B"],
    "exclude": ["--exclude", "/World/C"],
    "allow_missing": ["--allow-missing", "*.png"],
    "method": ["--method", "conservative"],
}


@pytest.fixture
def parser():
    parser = argparse.ArgumentParser(add_help=False)
    add_replay_options(parser)
    return parser


def test_it_has_every_option_that_results_depend_on(parser):
    """An option that is added later is in one of the two lists, or this test fails."""
    names = vars(parser.parse_args(["scene.usd"])).keys() - {"scene"}
    assert names == VALUES.keys() | WITHOUT_EFFECT
    for name, words in VALUES.items():
        given = parser.parse_args(["my scene.usd", *words])
        again = shlex.split(command_of(given))
        assert again == ["warp-bsc", "replay", "my scene.usd", *words], name
    every = parser.parse_args(["scene.usd", *(word for words in VALUES.values() for word in words)])
    assert parser.parse_args(shlex.split(command_of(every))[2:]) == every


@pytest.mark.parametrize(("frames", "written"), [(":20", ":20.0"), ("1:", "1.0:"), ("1::2", "1.0::2.0")])
def test_frames_without_a_start_or_an_end(parser, frames, written):
    given = parser.parse_args(["scene.usd", "--frames", frames])
    assert command_of(given) == f"warp-bsc replay scene.usd --frames {written}"
    assert parser.parse_args(shlex.split(command_of(given))[2:]).frames == given.frames


def test_options_on_files_and_processes_are_left_out(parser):
    words = ["--json", "hits.json", "--workers", "8", "--resume", "--fail-on", "collisions", "--device", "cpu"]
    assert command_of(parser.parse_args(["scene.usd", *words])) == "warp-bsc replay scene.usd"


def test_demo_is_the_scene_of_the_package_unless_there_is_a_file_of_this_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert Path(scene_path("demo")).is_file() and scene_path("demo.usd") == "demo.usd"
    (tmp_path / "demo").touch()
    assert scene_path("demo") == "demo"
