"""A replay from Python: a scene yields intervals, a replay of it yields typed results."""

import subprocess
import sys
import textwrap

import numpy as np
import pytest
from pxr import Ts
from usd_stages import FALLING, add_mesh, falling_stage, moved, save

import warp_bsc as bsc
from warp_bsc.scene_replay.results import IntervalResult, IntervalSummary
from warp_bsc.usd.frames import FrameRange
from warp_bsc.usd.interval import Interval


@pytest.fixture
def stage(tmp_path):
    """A triangle that falls through a floor."""
    return falling_stage(tmp_path)


def test_a_scene_yields_its_intervals(stage):
    add_mesh(stage, "/World/Other", {0: FALLING, 2: moved(FALLING, (0, 5, 5))})
    scene = bsc.Scene(save(stage))
    intervals = list(scene)
    assert len(intervals) == len(scene) == len(scene.times) - 1 > 1
    assert [(interval.start, interval.end) for interval in intervals] == list(
        zip(scene.times[:-1], scene.times[1:], strict=True)
    )
    for index, interval in enumerate(intervals):
        assert isinstance(interval, Interval) and interval.index == index
        assert interval.segment is intervals[0].segment
        np.testing.assert_array_equal(interval.x0, interval.segment.positions(interval.start))
        np.testing.assert_array_equal(interval.x1, interval.segment.positions(interval.end, before=True))
        assert interval.jumps == interval.warnings == ()
    assert [interval.start for interval in scene] == scene.times[:-1]  # again


def test_an_interval_has_its_jumps(stage):
    spline = Ts.Spline("float")
    for time, angle in ((0, 0), (1, 180), (2, 180)):
        knot = Ts.Knot("float")
        knot.SetTime(time)
        knot.SetValue(angle)
        knot.SetNextInterpolation(Ts.InterpHeld)
        spline.SetKnot(knot)
    turned = add_mesh(stage, "/World/Turned", moved(FALLING, (0, 1, 9)))
    assert turned.AddRotateXOp().GetAttr().SetSpline(spline)
    scene = bsc.Scene(save(stage), frames=FrameRange(0, 2, 1))
    first, second = scene.interval(0), scene.interval(1)
    assert first.jumps == first.warnings == ()
    assert second.jumps == ("/World/Turned",)
    (warning,) = second.warnings
    assert warning == "/World/Turned jumps at time 1: what it jumps through is not checked"
    assert warning in scene.warnings
    assert bsc.Scene(scene.path, frames=FrameRange(0, 2, 1)).interval(1).jumps == ()  # the one before was not read


@pytest.mark.parametrize("index", [-1, 1])
def test_an_interval_that_is_not_there(stage, index):
    scene = bsc.Scene(save(stage))
    with pytest.raises(IndexError, match=f"^index: .* has no interval {index * len(scene)}, only 0 to "):
        scene.interval(index * len(scene))


def test_a_replay_yields_results(stage):
    scene = bsc.Scene(save(stage))
    results = list(bsc.replay(scene, device="cpu"))
    assert len(results) == len(scene)
    for interval, result in zip(scene, results, strict=True):
        assert isinstance(result, IntervalResult) and isinstance(result.summary, IntervalSummary)
        assert (result.summary.start, result.summary.end) == (interval.start, interval.end)
        assert result.summary.hits == len(result.contacts) == len(result.contacts.position)
        assert result.contacts.interval.index == result.summary.index == interval.index
    assert sum(result.summary.hits for result in results) > 0


def test_the_program_of_the_documentation(stage, capsys):
    """It runs as it is printed, but for the scene's name."""
    lines = bsc.replay.__doc__.split("::\n\n")[1].split("\n\n    Args:")[0]
    program = (
        textwrap.dedent(lines)
        .replace("scene.usd", save(stage))
        .replace("101.0, 150.0", "0.0, 1.0")
        .replace("Hair", "N*")
    )
    add_mesh(stage, "/World/None", FALLING)
    save(stage)
    exec(program, {"__name__": "__main__"})
    printed = capsys.readouterr().out
    assert "0.0 ('/World/Falling', '/World/Floor') ('vertex 0', 'face 0')" in printed
    for name in ("FrameRange", "IntervalResult", "IntervalSummary", "SceneContacts", "SceneIntersections", "Selection"):
        assert getattr(bsc, name).__name__ == name and name in bsc.__all__


PROGRAMS = [
    "import warp_bsc as bsc; bsc.replay; import warp_bsc.scene_replay.summary",
    "import warp_bsc.scene_replay.summary; import warp_bsc as bsc",
    "import warp_bsc as bsc; from warp_bsc.scene_replay import summary, html_report",
    "from warp_bsc.scene_replay.results import IntervalResult; import warp_bsc as bsc",
    "import warp_bsc.cli.replay; import warp_bsc as bsc; bsc.Scene",
]
"""Programs that import the package in one order or another."""


@pytest.mark.slow
def test_the_function_is_found_whatever_is_imported():
    """In a process of its own, which forgets all modules of the package before each program."""
    ends = "; from warp_bsc import replay; assert bsc.replay is replay; print(replay.__module__, replay.__name__)"
    runner = """
import sys
for program in sys.argv[1:]:
    for name in [name for name in sys.modules if name.partition(".")[0] == "warp_bsc"]:
        del sys.modules[name]
    exec(program, {})
"""
    command = [sys.executable, "-c", runner, *(program + ends for program in PROGRAMS)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.split() == len(PROGRAMS) * ["warp_bsc.scene_replay.intervals", "replay"]
