"""The command ``warp-bsc bench repair``: its tables, its outputs, and what an interrupt leaves."""

import functools
import json

import pytest
from bench_commands import check_interrupt, check_json_file, check_wrong_use, runner

from warp_bsc.bench.measure import repair
from warp_bsc.bench.measure.repair import RepairAttempt, RepairRun
from warp_bsc.bench.peers import ipc_toolkit
from warp_bsc.bench.scenes.repair import KINDS, KNOWN
from warp_bsc.cli import bench_run


def attempt(hint="none", crossings=0, **others):
    values = {
        "certified": crossings == 0,
        "largest_move": 0.4567,
        "mean_move": 0.123,
        "strain": 0.0512,
        "seconds": 0.25,
        "reasons": ("a reason [red]",) if crossings else (),
        "toolkit_crosses": crossings > 0,
    }
    return RepairAttempt(hint=hint, crossings=crossings, **values | others)


ATTEMPTS = {
    ("known", "corner"): (attempt(crossings=156), attempt("order", strain=0.25), attempt("x_previous")),
    ("folds", "1"): (attempt(crossings=1200), attempt("x_previous", crossings=7)),
    ("folds", "2"): (attempt(strain=0.2, toolkit_crosses=True),),
}
CROSSINGS = {("known", "corner"): 156, ("folds", "1"): 1042, ("folds", "2"): 40}
MESH = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"


@pytest.fixture
def measured(monkeypatch):
    """Replaces the repairs by made-up ones; returns the kinds and names of their meshes."""
    calls = []

    def measure_repair(kind, name, mesh, *, device):
        assert str(device) == "cpu"
        calls.append((kind, name))
        attempts = ATTEMPTS.get((kind, name), (attempt(),))
        return RepairRun(kind, name, 2000, 3800, CROSSINGS.get((kind, name), 60), attempts, name != "2")

    monkeypatch.setattr(repair, "measure_repair", measure_repair)
    monkeypatch.setattr(bench_run, "damaged", lambda kind, number: (kind, number))
    monkeypatch.setattr(ipc_toolkit, "version", lambda: "1.5")
    return calls


run = runner("repair")


def test_tables(capsys, monkeypatch, tmp_path, measured):
    monkeypatch.setenv("COLUMNS", "80")
    path = tmp_path / "body.obj"
    path.write_text(MESH)
    lines = run(capsys, path, "--kinds", "folds,soft bodies", "--random", 2, "--seed", 1).out.splitlines()
    assert measured == [
        *(("known", name) for name in KNOWN),
        ("file", str(path)),
        *((kind, number) for kind in ("folds", "soft bodies") for number in "12"),
    ]
    assert max(len(line) for line in lines if ":" not in line) <= 80  # lines below wrap only on a terminal
    assert sum(line.rstrip().endswith("[s]") for line in lines) == 2
    named = ("sheets", "folded", "corner", "body", "folds", "soft", "0 to", "50", "500")
    rows = [line.split() for line in lines if line.startswith(named) and ":" not in line]
    usual = ["0.46", "0.12", "5.1", "0.25"]
    assert rows == [
        ["sheets", "2,000", "60", "0", *usual],
        ["folded", "2,000", "60", "0", *usual],
        ["corner", "2,000", "156", "156", *usual],
        ["corner,", "order=", "2,000", "156", "0", "0.46", "0.12", "25.0", "0.25"],
        ["corner,", "x_previous=", "2,000", "156", "0", *usual],
        ["body.obj", "2,000", "60", "0", *usual],
        ["folds", "2", "1", "1", "1", "40", "to", "1,042"],
        ["soft", "bodies", "2", "2", "2", "2", "60", "to", "60"],
        ["0", "to", "49", "crossings", "1", "1", "1", "1", "40", "to", "40"],
        ["50", "to", "149", "crossings", "2", "2", "2", "2", "60", "to", "60"],
        ["500", "or", "more", "crossings", "1", "0", "0", "0", "1,042", "to", "1,042"],
        ["folds", "0.46", "0.46", "12.6", "20.0", "1", "0.25"],
        ["soft", "bodies", "0.46", "0.46", "5.1", "5.1", "0", "0.25"],
    ]
    assert "corner: 156 to 156 crossings: a reason [red]." in lines
    assert "folds 1: 1,042 to 1,200 crossings: a reason [red]." in lines
    assert "folds 1, x_previous=: 1,042 to 7 crossings: a reason [red]." in lines
    assert "Returned with more crossings: 1 (folds 1) of 11 repairs." in lines
    assert "Changed where nothing crossed: 2 (folds 2, soft bodies 2) of 8 meshes." in lines
    assert "Where IPC Toolkit 1.5 disagrees whether anything crosses: 1 (folds 2) of 11 outputs." in lines
    assert not any("Interrupted" in line for line in lines)


def test_without_the_toolkit(capsys, monkeypatch, measured):
    monkeypatch.setattr(ipc_toolkit, "version", lambda: None)
    output = run(capsys, "--random", 0).out
    assert measured == [("known", name) for name in KNOWN]
    assert "The IPC Toolkit, which would check the outputs, is not installed" in output
    assert "Damage" not in output


def test_json(capsys, tmp_path, measured):
    found = json.loads(run(capsys, "--random", 1, "--json").out)
    assert [(row["kind"], row["name"]) for row in found["runs"]] == measured
    assert measured == [*(("known", name) for name in KNOWN), *((kind, "0") for kind in KINDS)]
    general = {"benchmark": "repair", "device": "cpu", "ipc_toolkit": "1.5", "partial": False}
    assert found.items() >= general.items()
    corner = next(row for row in found["runs"] if row["name"] == "corner")
    assert corner.items() >= {"vertices": 2000, "faces": 3800, "crossings": 156, "keeps_free": True}.items()
    assert [row["hint"] for row in corner["attempts"]] == ["none", "order", "x_previous"]
    assert corner["attempts"][0]["reasons"] == ["a reason [red]"]

    path = tmp_path / "found.json"
    check_json_file(run(capsys, "--random", 1, "--json", path), path, found, "bsc.repair on cpu")


@pytest.mark.parametrize("to_file", [False, True], ids=["table", "file"])
def test_an_interrupt_leaves_what_is_done(capsys, monkeypatch, tmp_path, measured, to_file):
    path = tmp_path / "found.json" if to_file else None
    command = functools.partial(run, capsys)
    check_interrupt(monkeypatch, repair, "measure_repair", measured, command, path, what="repairs")


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (["none.obj"], "none.obj: no such file"),
        (["--kinds", "folds,cubes"], "must be of bodies, garments, stacks, folds, soft bodies, not 'cubes'"),
        (["--random", "-1"], "--random: must be an integer of at least 0"),
        (["--json", "body.obj"], "--json body.obj: this is a mesh file; name meshes before the options"),
        (["--json", "gone/found.json"], "there is no folder gone"),
    ],
)
def test_wrong_use(capsys, measured, arguments, part):
    check_wrong_use(run(capsys, *arguments, status=2), part)
    assert not measured
