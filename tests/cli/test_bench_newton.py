"""The command ``warp-bsc bench newton``: its rows, its outputs, and what an interrupt leaves."""

import functools
import json

import pytest
from bench_commands import check_interrupt, check_json_file, check_wrong_use, runner

from warp_bsc.bench.measure import newton_examples
from warp_bsc.bench.measure.newton_examples import STAGE_TOTALS, ExampleRun, describe_times


def measurement(**others):
    values = {
        "device": "cpu",
        "particles": 1485,
        "triangles": 2816,
        "tetrahedra": 0,
        "shapes": 3,
        "frames": 6,
        "crossings_at_start": 0,
        "most_crossings": 1234,
        "first_frame_with_crossings": 4,
        "first_frame_not_finite": None,
        "stage": None,
        "test_final": "ok",
        "test_post_step": None,
        "milliseconds": describe_times([10.0, 12.0, 11.0, 2000.0]),
    }
    return values | others


def totals(*numbers):
    return dict(zip(STAGE_TOTALS, numbers, strict=True))


RUNS = {
    ("cloth_twist", "plain"): measurement(),
    ("cloth_twist", "stage"): measurement(most_crossings=0, stage=totals(60, 1, 2, 3)),
    ("cloth_twist", "implicit"): measurement(most_crossings=0, stage=totals(60, 0, 0, 0)),
    ("cloth_hanging --width 9", "plain"): measurement(
        test_final="particles are low [red]", test_post_step="deep", first_frame_not_finite=4
    ),
    ("cloth_hanging --width 9", "stage"): "not applicable: no solver with particles is one of SolverVBD",
    ("cloth_hanging --width 9", "implicit"): "a reason",
}


@pytest.fixture
def measured(monkeypatch):
    """Replaces the runs by made-up ones; returns their options."""
    calls = []

    def measure_example(example, mode, **options):
        calls.append({"example": example.title, "mode": mode, **options})
        options["progress"](1, 6)
        result = RUNS[example.title, mode]
        if isinstance(result, str):
            return ExampleRun(example.title, mode, problem=result)
        return ExampleRun(example.title, mode, measured=result)

    monkeypatch.setattr(newton_examples, "measure_example", measure_example)
    return calls


run = runner("newton")


def test_tables(capsys, monkeypatch, measured):
    monkeypatch.setenv("COLUMNS", "80")
    lines = run(capsys, "cloth_twist", "cloth_hanging --width 9").out.splitlines()
    notes = [line for line in lines if line.startswith("cloth_hanging --width 9,")]  # wrapped only on a terminal
    assert max(len(line) for line in lines if line not in notes) <= 80
    assert any("[ms]" in line for line in lines)  # not taken for markup
    rows = [line.split() for line in lines if line.startswith("cloth_") and line not in notes]
    assert rows == [
        ["cloth_twist", "plain", "11.5", "1,701.8", "2,000.0", "0", "1,234", "ok"],
        ["cloth_twist", "stage", "11.5", "1,701.8", "2,000.0", "0", "0", "ok"],
        ["cloth_twist", "implicit", "11.5", "1,701.8", "2,000.0", "0", "0", "ok"],
        ["cloth_hanging", "--width", "9", "plain", "11.5", "1,701.8", "2,000.0", "0", "1,234", "fail"],
        ["cloth_hanging", "--width", "9", "stage", "not", "run"],
        ["cloth_hanging", "--width", "9", "implicit", "not", "run"],
        ["cloth_twist", "1,485", "2,816", "6", "60", "1", "2", "3"],
        ["cloth_twist,", "implicit", "1,485", "2,816", "6", "60", "0", "0", "0"],
        ["cloth_hanging", "--width", "9", "1,485", "2,816", "6"],
    ]
    assert notes == [
        "cloth_hanging --width 9, plain: test_post_step: deep",
        "cloth_hanging --width 9, plain: test_final: particles are low [red]",
        "cloth_hanging --width 9, plain: positions are not finite at the end of frame 4",
        "cloth_hanging --width 9, stage: not applicable: no solver with particles is one of SolverVBD",
        "cloth_hanging --width 9, implicit: a reason",
    ]
    assert not any("Interrupted" in line for line in lines)


def test_json(capsys, tmp_path, measured):
    arguments = ["cloth_twist", "cloth_hanging --width 9", "--frames", "6", "--check-every", "2", "--download"]
    found = json.loads(run(capsys, *arguments, "--json").out)
    assert [(row["example"], row["mode"]) for row in found["runs"]] == list(RUNS)
    assert (found["benchmark"], found["device"], found["frames_left_out"], found["partial"]) == (
        "newton",
        "cpu",
        2,
        False,
    )
    first, second, _, _, last, _ = found["runs"]
    milliseconds = dict(first["measured"]["milliseconds"])
    assert milliseconds.pop("frames") == [10.0, 12.0, 11.0, 2000.0]
    assert milliseconds == pytest.approx({"median": 11.5, "percentile_95": 1701.8, "worst": 2000.0})
    assert first["problem"] is first["measured"]["stage"] is last["measured"] is None
    totals = {"steps": 60, "uncertified_steps": 1, "truncated_steps": 2, "frozen_steps": 3}
    assert second["measured"]["stage"] == totals
    assert last["problem"].startswith("not applicable: ")
    options = {"device": "cpu", "frames": 6, "check_every": 2, "download": True}
    assert all(call.items() >= options.items() for call in measured)

    path = tmp_path / "found.json"
    check_json_file(run(capsys, *arguments, "--json", path), path, found, "Newton's examples on cpu")


@pytest.mark.parametrize(
    ("modes", "expected"), [("stage", ["stage"]), ("stage,plain,stage", ["stage", "plain"])], ids=["one", "twice"]
)
def test_modes(capsys, measured, modes, expected):
    run(capsys, "cloth_twist", "--modes", modes)
    assert [call["mode"] for call in measured] == expected


@pytest.mark.parametrize("to_file", [False, True], ids=["table", "file"])
def test_an_interrupt_leaves_what_is_done(capsys, monkeypatch, tmp_path, measured, to_file):
    path = tmp_path / "found.json" if to_file else None
    command = functools.partial(run, capsys, "cloth_twist", "cloth_hanging --width 9")
    out = check_interrupt(monkeypatch, newton_examples, "measure_example", measured, command, path)
    assert sum(line.startswith("cloth_twist ") for line in out.splitlines()) == 3


def test_list(capsys, monkeypatch, measured):
    monkeypatch.setenv("COLUMNS", "80")
    lines = [line.rstrip() for line in run(capsys, "--list").out.splitlines()]
    assert max(map(len, lines)) <= 80
    rows = {line.split()[0]: line.split(maxsplit=2)[1:] for line in lines if line.strip()}
    assert rows["cloth_twist"] == ["cloth"]
    assert rows["cloth_franka"] == ["cloth", "needs a download: franka_emika_panda"]
    assert not measured


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (["cloth_twst"], "'cloth_twst': Newton has no example of this name; did you mean cloth_twist"),
        (["--modes", "plain,both"], "must be of plain, stage, implicit, not 'both'"),
        (["cloth_twist", "--frames", "2"], "frames must be more than 2"),
        (["--json", "cloth_twist"], "--json cloth_twist: this is an example; name examples before the options"),
        (["--json", "gone/found.json"], "there is no folder gone"),
    ],
)
def test_wrong_use(capsys, arguments, part):
    check_wrong_use(run(capsys, *arguments, status=2), part)
