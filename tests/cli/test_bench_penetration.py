"""The command ``warp-bsc bench penetration``: its tables, its outputs, and what an interrupt leaves."""

import functools
import json

import pytest
from bench_commands import check_interrupt, check_json_file, runner

from warp_bsc.bench.measure import penetration
from warp_bsc.bench.measure.penetration import SCENES, SIMULATORS, PenetrationRun


def measurement(**others):
    values = {
        "device": "cpu",
        "version": "1.2.3",
        "particles": 370,
        "triangles": 640,
        "frames": 3,
        "steps": 30,
        "crossings": (0, 1234, 7),
        "shape_crossings": (0, 4, 0),
        "collisions": 1234567,
        "colliding_steps": 2,
        "inverted": (0, 5, 2),
        "speed_kept": 0.3084,
        "stretch": 251313.04,
        "uncertified_steps": None,
        "milliseconds": {"median": 10.0, "mean": 12.5},
    }
    return values | others


RUNS = {
    "vbd": measurement(),
    "ccd-vbd": measurement(
        crossings=(0, 0, 0),
        collisions=3,
        inverted=(0, 0, 0),
        speed_kept=None,
        stretch=1.25,
        uncertified_steps=1,
    ),
    "libuipc": "a reason [red]",
}


@pytest.fixture
def measured(monkeypatch):
    """Replaces the runs by made-up ones; returns their options."""
    calls = []

    def measure_penetration(scene, simulator, **options):
        calls.append({"scene": scene, "simulator": simulator, **options})
        options["progress"](3, 6)
        result = RUNS.get(simulator, RUNS["vbd"])
        problem = result if isinstance(result, str) else None
        return PenetrationRun(scene, simulator, measured=None if problem else result, problem=problem)

    monkeypatch.setattr(penetration, "measure_penetration", measure_penetration)
    return calls


run = runner("penetration")


def test_tables(capsys, monkeypatch, measured):
    monkeypatch.setenv("COLUMNS", "80")
    lines = run(capsys, "--scene", "bullet,soft", "--simulator", "vbd,ccd-vbd,libuipc").out.splitlines()
    assert max(len(line) for line in lines if line.startswith((" ", "VBD  ", "Solver", "─")) and ":" not in line) <= 80
    assert any("[ms]" in line for line in lines)  # not taken for markup
    rows = [line.split() for line in lines if line.startswith(("VBD ", "SolverCCD(VBD) ", "libuipc "))]
    one = [
        ["VBD", "1,234", "1,241", "1,234,567", "5", "30.8", "251,313.0", "10.00"],
        ["SolverCCD(VBD)", "0", "0", "3", "0", "1.2", "10.00"],
        ["libuipc"],
    ]
    assert rows == one * 2
    assert "A patch is shot at a held sheet, at 20 m/s: 370 particles, 640 triangles, 3 frames" in lines
    assert "libuipc: not run: a reason [red]" in lines
    assert "SolverCCD(VBD): 1 step of 30 not certified" in lines
    assert f"VBD: newton 1.2.3; {SIMULATORS['vbd'].settings}; claims nothing of penetration." in lines
    assert any(line.startswith("SolverCCD(VBD): newton 1.2.3; default arguments") for line in lines)
    assert not any("Interrupted" in line for line in lines)


def test_json(capsys, tmp_path, measured):
    arguments = ["--scene", "bullet", "--simulator", "vbd,ccd-vbd,libuipc", "--frames", "3"]
    found = json.loads(run(capsys, *arguments, "--json").out)
    general = {"benchmark": "penetration", "device": "cpu", "steps_left_out": 2, "partial": False}
    assert found.items() >= general.items()
    assert found["scenes"] == {"bullet": SCENES["bullet"]}
    assert list(found["simulators"]) == ["vbd", "ccd-vbd", "libuipc"]
    assert found["simulators"]["ccd-vbd"]["has_stage"] is True
    first, second, third = found["runs"]
    assert (first["scene"], first["simulator"], first["problem"]) == ("bullet", "vbd", None)
    assert first["measured"]["crossings"] == [0, 1234, 7]
    assert first["measured"]["milliseconds"] == {"median": 10.0, "mean": 12.5}
    assert second["measured"]["uncertified_steps"] == 1
    assert (third["measured"], third["problem"]) == (None, "a reason [red]")
    assert [call["frames"] for call in measured] == [3, 3, 3]

    path = tmp_path / "found.json"
    check_json_file(run(capsys, *arguments, "--json", path), path, found, "Penetration, Newton's solvers on cpu")


def test_all_by_default_and_each_once(capsys, measured):
    run(capsys)
    expected = [(scene, simulator) for scene in SCENES for simulator in SIMULATORS]
    assert [(call["scene"], call["simulator"]) for call in measured] == expected
    assert all(call["frames"] is None for call in measured)
    measured.clear()
    run(capsys, "--scene", "soft,bullet,soft", "--simulator", "vbd,vbd")
    assert [call["scene"] for call in measured] == ["soft", "bullet"]


@pytest.mark.parametrize("to_file", [False, True], ids=["table", "file"])
def test_an_interrupt_leaves_what_is_done(capsys, monkeypatch, tmp_path, measured, to_file):
    path = tmp_path / "found.json" if to_file else None
    command = functools.partial(run, capsys)
    check_interrupt(monkeypatch, penetration, "measure_penetration", measured, command, path)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--scene", "bullet,gone"], "--scene: must be of bullet, drape, stack, twist, soft, not 'gone'"),
        (["--simulator", "gone"], "--simulator: must be of vbd, "),
        (["--frames", "0"], "--frames: must be an integer of at least 1"),
        (["--json", "gone/found.json"], "there is no folder gone"),
    ],
)
def test_wrong_use(capsys, measured, arguments, message):
    assert message in run(capsys, *arguments, status=2).err
    assert not measured
