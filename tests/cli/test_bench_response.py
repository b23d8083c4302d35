"""The command ``warp-bsc bench response``: its tables, its outputs, and what an interrupt leaves."""

import functools
import json

import numpy as np
import pytest
from bench_commands import check_interrupt, check_json_file, check_wrong_use, runner

from warp_bsc.bench.measure import response
from warp_bsc.bench.measure.response import CONFIGURATIONS, SCENES, ResponseRun


def measurement(**others):
    values = {
        "device": "cpu",
        "particles": 289,
        "triangles": 512,
        "rate": 60,
        "steps": 150,
        "stretch_at_end": 12.345,
        "stretch_at_most": 1234.5,
        "rest_speed": 40.04,
        "energy_gained": 0.00284,
        "crossings": 1040,
        "collisions": 12345,
        "uncertified_steps": None,
        "milliseconds": {"median": 11.5, "mean": 508.25, "worst": 2000.0},
        "spread": None,
    }
    return values | others


RUNS = {
    ("sphere", "plain"): measurement(),
    ("sphere", "stage"): measurement(
        crossings=0,
        collisions=0,
        uncertified_steps=2,
        energy_gained=None,
        spread={"distance": 1e-6, "stretch_at_end": 0.25, "stretch_at_most": 1.5},
    ),
    ("sphere", "reference"): measurement(rate=1920, steps=4800, collisions=None, uncertified_steps=0),
    ("pile", "plain"): "a reason [red]",
}
EARLY = {
    ("fold", "implicit"): np.zeros((2, 3)),
    ("fold", "converged"): np.array([[0.0, 0.0, 0.005], [0.0, 0.0, 0.0]]),
}


@pytest.fixture
def measured(monkeypatch):
    """Replaces the runs by made-up ones; returns their options."""
    calls = []

    def measure_response(scene, configuration, **options):
        calls.append({"scene": scene, "configuration": configuration, **options})
        options["progress"](2, 6)
        result = RUNS.get((scene, configuration), RUNS["sphere", "plain"])
        problem = result if isinstance(result, str) else None
        early, found = EARLY.get((scene, configuration)), None if problem else result
        return ResponseRun(scene, options["solver"], configuration, early, measured=found, problem=problem)

    monkeypatch.setattr(response, "measure_response", measure_response)
    return calls


run = runner("response")


def test_tables(capsys, monkeypatch, measured):
    monkeypatch.setenv("COLUMNS", "80")
    options = ["--configurations", "plain,stage,reference", "--perturb", "1e-6"]
    lines = run(capsys, "sphere", "pile", *options).out.splitlines()
    assert max(map(len, lines)) <= 80
    assert any("[ms]" in line for line in lines)  # not taken for markup
    rows = [line.split() for line in lines if line.startswith(("plain ", "stage ", "reference "))]
    assert rows == [
        ["plain", "12.35", "1,234", "40.0", "0.0028", "1,040", "12,345", "11.50", "508.25"],
        ["stage", "12.35", "1,234", "40.0", "0", "0", "11.50", "508.25"],
        ["reference", "12.35", "1,234", "40.0", "0.0028", "1,040", "11.50", "508.25"],
        ["plain"],
        ["stage", "12.35", "1,234", "40.0", "0.0028", "1,040", "12,345", "11.50", "508.25"],
        ["reference", "12.35", "1,234", "40.0", "0.0028", "1,040", "12,345", "11.50", "508.25"],
    ]
    assert "289 particles, 512 triangles, 150 steps of 1/60 s or 4,800 steps of 1/1920 s" in lines
    assert "stage: 2 steps not certified" in lines
    assert "stage, moved by 1e-06 m: stretch differs by 0.25 at the end, 1.50 at most" in lines
    assert "plain: not run: a reason [red]" in lines
    assert not any("Interrupted" in line for line in lines)


def test_distances_from_the_converged_run(capsys, measured):
    arguments = ["sphere", "fold", "--configurations", "plain,implicit,converged"]
    lines = run(capsys, *arguments).out.splitlines()
    assert [line for line in lines if "Mean distance" in line] == [
        "Mean distance from converged after 48 steps [mm]: implicit 2.50"
    ]
    rows = json.loads(run(capsys, *arguments, "--json").out)["runs"]
    assert [row["from_converged"] for row in rows] == [None] * 4 + [pytest.approx(2.5), 0.0]
    assert not any("early" in row for row in rows)


def test_json(capsys, tmp_path, measured):
    arguments = ["sphere", "pile", "--configurations", "plain,stage", "--perturb", "1e-6", "--seconds", "0.5"]
    arguments += ["--rate", "240", "--reference-rate", "960", "--solver", "xpbd"]
    found = json.loads(run(capsys, *arguments, "--json").out)
    names = [(row["scene"], row["solver"], row["configuration"]) for row in found["runs"]]
    assert names == [(scene, "xpbd", name) for scene in ("sphere", "pile") for name in ("plain", "stage")]
    general = {"benchmark": "response", "device": "cpu", "steps_left_out": 2, "partial": False}
    assert found.items() >= general.items()
    first, second, third, _ = found["runs"]
    milliseconds = first["measured"]["milliseconds"]
    assert milliseconds == {"median": 11.5, "mean": 508.25, "worst": 2000.0}
    assert first["problem"] is first["measured"]["spread"] is third["measured"] is None
    assert third["problem"] == "a reason [red]"
    assert second["measured"]["spread"] == {"distance": 1e-6, "stretch_at_end": 0.25, "stretch_at_most": 1.5}
    options = {"seconds": 0.5, "rate": 240, "reference_rate": 960, "solver": "xpbd", "perturb": 1e-6}
    assert all(call.items() >= options.items() for call in measured)

    path = tmp_path / "found.json"
    check_json_file(run(capsys, *arguments, "--json", path), path, found, "Contact on cpu")


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ([], CONFIGURATIONS),
        (["--no-reference"], CONFIGURATIONS[:-1]),
        (["--solver", "xpbd"], ("plain", "stage", "stage+contacts", "reference")),
        (["--configurations", "stage,plain,stage"], ("stage", "plain")),
        (["--configurations", "reference", "--no-reference"], ("reference",)),
    ],
)
def test_configurations(capsys, measured, arguments, expected):
    run(capsys, "sphere", *arguments)
    assert tuple(call["configuration"] for call in measured) == expected


def test_all_scenes_by_default_and_each_once(capsys, measured):
    run(capsys, "--configurations", "plain")
    assert tuple(call["scene"] for call in measured) == SCENES
    measured.clear()
    run(capsys, "worlds", "ball", "worlds", "--configurations", "plain")
    assert [call["scene"] for call in measured] == ["worlds", "ball"]


@pytest.mark.parametrize("to_file", [False, True], ids=["table", "file"])
def test_an_interrupt_leaves_what_is_done(capsys, monkeypatch, tmp_path, measured, to_file):
    path = tmp_path / "found.json" if to_file else None
    command = functools.partial(run, capsys, "sphere")
    check_interrupt(monkeypatch, response, "measure_response", measured, command, path)


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (["spere"], "'spere': there is no scene of this name; did you mean sphere? The scenes are sphere, box_edge, "),
        (["cube"], "'cube': there is no scene of this name. The scenes are sphere, box_edge, "),
        (
            ["--configurations", "plain,both"],
            "must be of plain, self-contact, stage, stage+contacts, implicit, converged, reference, not 'b",
        ),
        (["--solver", "mpm"], "invalid choice: 'mpm'"),
        (["--seconds", "0"], "--seconds: must be a finite number more than 0, not 0"),
        (["--perturb", "far"], "--perturb: must be a finite number more than 0"),
        (["--perturb", "1e-6", "--configurations", "plain"], "--perturb runs the configuration stage a second time"),
        (["--rate", "0"], "--rate: must be an integer of at least 1"),
        (["--reference-rate", "0"], "--reference-rate: must be an integer of at least 1"),
        (["--json", "sphere"], "--json sphere: this is a scene; name scenes before the options"),
        (["--json", "gone/found.json"], "there is no folder gone"),
    ],
)
def test_wrong_use(capsys, measured, arguments, part):
    check_wrong_use(run(capsys, *arguments, status=2), part)
    assert not measured
