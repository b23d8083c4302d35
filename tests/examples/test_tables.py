"""The tables of measurements: they are what the program makes of the files that commands wrote."""

import copy
import dataclasses
import importlib.util
import itertools
import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]


def load(name):
    """A program of examples/figures, as a module."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "examples" / "figures" / f"{name}.py")
    module = sys.modules[name] = importlib.util.module_from_spec(spec)  # its dataclasses look for it there
    spec.loader.exec_module(module)
    return module


rows_of = load("table_rows")
tables = load("tables")
FILES = sorted(tables.MEASUREMENTS.glob("*.json"))
RECORD = {
    "command": "warp-bsc bench x",
    "commit": "0123456789" * 4,
    "changed": False,
    "date": "2026-11-26T05:00:00+00:00",
    "cpu": "a CPU",
    "cores": 2,
    "gpus": [],
    "versions": {"warp-lang": "1.2", "newton": "3.4"},
}


def measured(name):
    return json.loads((tables.MEASUREMENTS / f"{name}.json").read_text())


@pytest.mark.parametrize("path", tables.PAGES, ids=lambda path: path.name)
def test_the_page_is_what_its_measurements_make(path):
    page = path.read_text()
    made, kept = tables.update(page)
    assert made == page, "run python examples/figures/tables.py"
    missing = {file for name in kept for file in tables.TABLES[name].files} - {path.stem for path in FILES}
    assert all(file.endswith("_gpu") for file in missing), missing  # what has a CPU alone can be measured by anybody


def test_each_table_stands_on_the_page_once():
    pages = [path.read_text() for path in tables.PAGES]
    marked = [re.findall(r"<!-- table: (\S+) -->", page) for page in pages]
    front = ["front", "front_detector"]
    assert marked[:2] == [front] * 2
    assert sorted([*front, *itertools.chain(*marked[2:])]) == sorted(tables.TABLES)
    assert [page.count("<!-- end -->") for page in pages] == [len(names) for names in marked]


def test_each_measurement_belongs_to_a_table():
    used = {file for table in tables.TABLES.values() for file in table.files}
    assert {path.stem for path in FILES} <= used


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_each_measurement_can_be_traced(path):
    text = path.read_text()
    record = json.loads(text)["record"]
    assert re.fullmatch("[0-9a-f]{40}", record["commit"])
    assert record["changed"] is False
    assert record.keys() >= RECORD.keys() | {"python"}
    assert not re.search(r'["\s,](/|~|[A-Z]:\\)\w', text)  # folders of one machine
    assert len(text) < 1_000_000


def with_gpu(found):
    """A measurement as if it were of a GPU."""
    found = copy.deepcopy(found)
    found["record"]["gpus"] = ["NVIDIA X"]
    for scene in found["scenes"]:
        scene["milliseconds"]["cuda_graph"] = 1.234
    return found


def test_detections():
    two, one = measured("detector_two_cores"), measured("detector_one_core")
    head, *rows = rows_of.detector(with_gpu(two), two, one)
    assert [row[0].split(",")[0] for row in rows] == ["cloth-funnel", "cloth-ball"]
    assert [row[2] for row in rows] == ["134", "113,854"]
    assert all(len(row) == len(head) for row in rows)
    times = two["scenes"][1]["ipc_toolkit"]
    total = times["build_milliseconds"] + times["step_milliseconds"]
    assert rows[1][6] == rows_of.milliseconds(total) == f"{total / 1e3:.3g} s"
    worlds = copy.deepcopy(with_gpu(two))
    worlds["scenes"][:] = [worlds["scenes"][0] | {"scene": "cloth:1000 in 1,024 worlds"}]
    head, *rows = rows_of.detector_stages(with_gpu(two), worlds)
    assert head[:3] == ("scene", "whole graph", "broad phase")
    assert rows[0][1] == "1.23" and rows[2][0].startswith("cloth in 1,024 worlds, ")


def test_the_front_page():
    two = measured("detector_two_cores")
    gpu = with_gpu(two)
    gpu["record"] = gpu["record"] | {"gpus": ["NVIDIA H200"]}
    head, on_gpu, on_cores, peer = rows_of.front_detector(gpu, two)
    assert "113,854 contacts" in head[0] and "IPC Toolkit" in peer[0]
    assert on_gpu[0].endswith("on an H200") and on_gpu[1] == "1.2 ms" and on_cores[1].endswith(" ms")
    scenes = measured("penetration_twist"), measured("penetration_drape")
    head, *rows = rows_of.front(*scenes)
    assert head[0] == "a second, on an H200"
    for through, price, found in zip(rows[::2], rows[1::2], scenes, strict=True):
        runs = {run["simulator"]: run["measured"] for run in found["runs"] if run["measured"]}
        for column, name in enumerate(("vbd", "vbd-self-contact", "ccd-vbd", "implicit"), 1):
            run = runs[name]
            seconds = rows_of.two(1e-3 * run["milliseconds"]["mean"] * run["steps"])
            assert through[column] == f"{np.max(run['crossings'])}" and price[column] == f"{run['steps']}, {seconds} s"
        assert through[3:] == ("0", "0")


def test_intersections():
    found = measured("intersections_cpu")
    head, *rows = rows_of.intersections(found)
    assert head[2] == "warp-bsc" and set(head[3:]) == set(rows_of.ASKED)
    assert all(row[2] == row[1] for row in rows)  # of this package
    wrong = [cell for row in rows for cell in row if cell.startswith("**")]
    assert wrong and len(wrong) == sum(len(case["wrong"]) for case in found["cases"] if not case["by_definition"])
    by_definition = rows_of.intersections(found, by_definition=True)[1:]
    assert len(rows) + len(by_definition) == len(found["cases"]) and "**" not in str(by_definition)
    head, *rows = rows_of.intersection_times(found)
    assert rows[0][0] == "warp-bsc" and all(len(row) == len(head) == 2 + len(found["times"]) for row in rows)


def test_queries():
    found = measured("queries_one_core")
    faster = copy.deepcopy(found)
    for kind in faster["kinds"]:
        kind["modes"]["queued"]["queries_per_second"] = 7.71e9
    _, *rows = rows_of.queries(faster, found)
    assert rows[2][1:] == ("7.7 billion", "7.7 billion")
    assert rows[3][0].endswith("on one core of the CPU")
    rate = {kind["kind"]: kind["modes"]["queued"]["queries_per_second"] for kind in found["kinds"]}["edge-edge"]
    assert rows[3][1] == f"{rate / 1e6:.3g} million"


def test_certificates_of_several_runs():
    def run(missed):
        answers = {"free": 1000, "hit": 20, "unsure": 3}
        return {
            "methods": {"float": answers | {"missed": missed, "false": 4}, "exact": answers | dict(missed=0, false=0)}
        }

    _, *rows = rows_of.certify(run(7), run(8))
    assert rows == [
        ("`float`", "2,000", "40", "6", "15", "8"),
        ("exact arithmetic on the device", "2,000", "40", "6", "0", "0"),
    ]


def test_detectors():
    def row(queries, detector, missed, false, late):
        counts = {"colliding": 1000, "free": 300, "missed": missed, "false": false, "late": late}
        return {"queries": queries, "detector": detector} | counts

    others = [row(name, detector, 0, 1, 2) for detector in rows_of.DETECTORS for name in ("hand-made", "a", "b")]
    rows = [other for other in others if other["detector"] not in ("float", "additive")]
    rows += [row(name, "float", 5, 6, 0) for name in ("hand-made", "a", "b")]
    rows += [row("hand-made", "additive", 0, 4, 7), row("a", "additive", 0, 0, 1), row("b", "additive", 8, 0, 1)]
    head, *totals = rows_of.detectors({"rows": rows})
    assert head[1:4] == ("hand-made: missed of 1,000", "false of 300", "late")
    assert head[4:] == ("adversarial: missed of 2,000", "false of 600", "late")
    assert totals[0] == ("`exact`", "0", "1", "2", "0", "2", "4")
    assert totals[2] == ("`float`", "5", "6", "0", "10", "12", "0")
    assert totals[6] == ("IPC Toolkit, additive", "0", "4", "7", "8", "0", "2")
    head, *missed = rows_of.detectors_missed({"rows": rows})
    assert head == ("queries", "`float`", "IPC Toolkit, additive")
    assert missed == [("`a`, 1,000 collide", "5", "0"), ("`b`, 1,000 collide", "5", "8")]


def test_repairs_of_shots():
    row = {
        "shot": "a.usd",
        "options": ["--min-distance", "0.1"],
        "before": {"collisions": 1234, "intersections": 5},
        "left": {"collisions": 1, "intersections": 0},
        "intervals": 10,
        "vertices": 5678,
        "largest_move": 0.123,
        "mean_move": 0.012,
        "shortest_edge": 0.8,
        "longest_edge": 1.234,
        "seconds": {"finding": 0.2, "repairing": 0.5},
    }
    _, cells = rows_of.repair_shots({"rows": [row]})
    assert cells[0] == "`a.usd --min-distance 0.1`, 10 intervals, 5,678 vertices"
    assert cells[1:3] == ("1,234 to 1", "5 to 0")
    assert cells[3:] == ("0.12, 0.01", "0.80 to 1.23", "50 ms; 20 ms", "2.5")


def example(mode, **others):
    took = {
        "frames": 20,
        "milliseconds": {"median": 12.34, "percentile_95": 20.0},
        "most_crossings": 1234,
        "test_post_step": None,
        "test_final": "ok",
        "stage": None,
    }
    if mode != "plain":
        took["stage"] = {
            "steps": 200,
            "substepped_steps": 20,
            "uncertified_steps": 3,
            "truncated_steps": 0,
            "frozen_steps": 1,
        }
    return {"example": "cloth_twist", "mode": mode, "problem": None, "measured": took | others}


def test_examples_of_newton():
    stage = example("stage", test_final="no")
    gone = {"example": "gone", "problem": "a reason", "measured": None}
    lost = [gone | {"mode": mode} for mode in ("plain", "stage")]
    _, *rows = rows_of.newton({"runs": [example("plain"), stage]}, {"runs": lost})
    steps = "197 of 200 certified, 20 in substeps, none truncated, 1 with frozen vertices; tests ok / fail"
    assert rows == [
        ("`cloth_twist`, 20 frames", "12.3 (20.0); 1,234", "12.3 (20.0); 1,234", steps),
        ("`gone`", "not run: a reason", "not run: a reason", ""),
    ]
    runs = [example("plain"), stage, example("implicit", most_crossings=0), *lost, gone | {"mode": "implicit"}]
    head, first, second = rows_of.newton({"runs": runs})
    assert head[3] == "with `SolverImplicit` in place of VBD"
    assert first[3:] == ("12.3 (20.0); 0", steps.replace(";", ", `SolverImplicit` 197 of 200;"))
    assert second[3:] == ("not run: a reason", "")


def penetration_run(scene, simulator, problem=None, **others):
    took = {
        "version": "1.2",
        "crossings": [0, 1234, 6],
        "collisions": 5,
        "inverted": [0, 0],
        "speed_kept": None,
        "stretch": 3.456,
        "milliseconds": {"median": 12.3},
    }
    measured = None if problem else took | others
    return {"scene": scene, "simulator": simulator, "problem": problem, "measured": measured}


PENETRATION = {
    "scenes": {"bullet": "a patch flies", "soft": "a block falls"},
    "simulators": {
        "vbd": {"title": "A", "settings": "its own"},
        "libuipc": {"title": "B", "settings": "defaults"},
    },
    "runs": [
        penetration_run("bullet", "vbd", speed_kept=0.305),
        penetration_run("bullet", "libuipc", problem="no GPU: why"),
        penetration_run("soft", "vbd", inverted=[0, 7], crossings=[0, 0, 0], collisions=0),
        penetration_run("soft", "libuipc", problem="no GPU: why"),
    ],
}


def test_penetration():
    assert rows_of.penetration(PENETRATION) == [
        ("simulator", "bullet", "soft"),
        ("A", "1,234; 1,240; 5", "0; 0; 0"),
        ("B", "not run", "not run"),
    ]
    assert rows_of.penetration_costs(PENETRATION)[1:] == [
        ("A", "30% kept, 3.5%, 12 ms", "7 inverted, 3.5%, 12 ms"),
        ("B", "not run", "not run"),
    ]
    assert rows_of.penetration_simulators(PENETRATION)[1:] == [
        ("A", "1.2", "its own", "nothing", ""),
        ("B", "", "defaults", rows_of.SIMULATORS["libuipc"].claims, "no GPU (all)"),
    ]


def contact_run(scene, configuration, **others):
    took = {
        "rate": 60,
        "stretch_at_end": 3.06,
        "stretch_at_most": 15.9,
        "rest_speed": 1234.5,
        "energy_gained": 0.0123,
        "crossings": 0,
        "collisions": 0,
        "uncertified_steps": None,
        "milliseconds": {"median": 8.123, "mean": 123.4, "worst": 200.0},
    }
    return {"scene": scene, "configuration": configuration, "problem": None, "measured": took | others}


def test_scenes_in_contact():
    plain = contact_run("ball", "plain", crossings=1234, collisions=56)
    stage = contact_run("ball", "stage", uncertified_steps=2)
    reference = contact_run("ball", "reference", rate=1920, collisions=None)
    head, row = rows_of.response({"runs": [plain, stage]}, {"runs": [reference]})
    assert head == ("scene", "Newton's contacts", "`SolverCCD`, default", "reference, 1/1920 s")
    moves = "3.1, 16%; 1,234 mm/s"
    assert row == (
        "ball: moved by the program at 40 m/s",
        f"{moves}; 8.12 ms; 1,234 crossings; 56 pairs meet",
        f"{moves}; 8.12 (123) ms; 2 steps not certified",
        moves,
    )
    implicit = contact_run("ball", "implicit", uncertified_steps=0) | {"from_converged": 2.345}
    head, row = rows_of.response({"runs": [implicit]}, {"runs": [reference]})
    assert head[1] == "`SolverImplicit`" and row[1] == f"{moves}; 8.12 (123) ms; 2.3 mm from the converged run"


def test_arcs_worlds_and_inversions():
    names = "detect", "ball, 3 degrees a step", "ball, nothing turns", "boxes that tumble"
    times = [{"name": name, "milliseconds": {"arcs": 3.0, "chords": 2.0}} for name in names]
    found = {"cells": 60, "degrees": 3.0, "rows": times}
    _, *rows = rows_of.arc_cost(found, found | {"cells": 150})
    assert [row[1] for row in rows] == ["7,200"] * 4 + ["45,000"] * 4
    assert rows[0][0].endswith("turns by 3 degrees a step") and rows[0][2:] == ("3 ms", "2 ms", "1.50")

    solvers = "VBD", "VBD, self-contact", "SolverCCD(VBD)", "SolverImplicit"
    rates = {"clock": 1234.0, "processor": 56.7}
    row = {"worlds": 1024, "steps_per_second": rates, "crossings": 5929}
    head, *rows = rows_of.worlds_throughput({"rows": [{"solver": name} | row for name in solvers]})
    assert head == ("worlds", "1,024") and {row[1] for row in rows} == {"1,234 (5,929)"}

    run = {
        "scene": "pile",
        "steps": 120,
        "milliseconds": 4.56,
        "inverting_steps": 0,
        "inverted": 0,
        "truncated_steps": 0,
    }
    runs = [run | {"mode": mode} for mode in ("plain", "allowed", "reported", "prevented")]
    runs[1] |= {"inverting_steps": 3, "inverted": 1234}
    runs[3] |= {"truncated_steps": 4}
    _, row = rows_of.inverting_steps({"rows": runs})
    assert row[0] == "pile, 120" and row[1] == row[3] == "0 (4.56 ms)"
    assert row[2] == "1,234 in 3 steps (4.56 ms)" and row[4] == "0 (4.56 ms), 4 steps with cut paths"


def test_the_picture_of_penetration(tmp_path, monkeypatch):
    figure = load("penetration")
    numbers = figure.count(PENETRATION, lambda took: max(took["crossings"]))
    assert numbers[0].tolist() == [1234.0, 0.0]
    assert np.isnan(numbers[1]).all()
    path, picture = tmp_path / "found.json", tmp_path / "found.png"
    path.write_text(json.dumps(PENETRATION))
    monkeypatch.setattr(sys, "argv", ["penetration.py", str(path), str(picture)])
    figure.main()
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_a_table_has_its_sources_below(tmp_path, monkeypatch):
    monkeypatch.setattr(tables, "MEASUREMENTS", tmp_path)
    monkeypatch.setitem(tables.TABLES, "x", tables.Table(("x_gpu",), lambda found: [("a", "b"), ("1", found["b"])]))
    page = "before\n<!-- table: x -->\nold\n<!-- end -->\nafter\n"
    assert tables.update(page) == (page, ["x"])
    path = tmp_path / "x_gpu.json"

    def write(**others):
        path.write_text(json.dumps({"benchmark": "x", "b": "2", "record": RECORD} | others))

    write()
    source = "*`warp-bsc bench x`: 2026-11-26, commit 0123456, a CPU, 2 cores, Warp 1.2, Newton 3.4*"
    table = f"| a | b |\n| --- | --- |\n| 1 | 2 |\n\n{source}\n"
    assert tables.update(page) == (f"before\n<!-- table: x -->\n\n{table}\n<!-- end -->\nafter\n", [])
    write(benchmark="detector", record=RECORD | {"gpus": ["NVIDIA X"], "changed": True, "load": 0.4})
    assert "0123456 with changes, NVIDIA X, Warp 1.2, Newton 3.4, IPC Toolkit none*" in tables.update(page)[0]
    write(record=RECORD | {"load": 2.5})
    assert "a CPU, 2 cores shared with other programs (load 2.5), Warp" in tables.update(page)[0]
    monkeypatch.setitem(tables.TABLES, "x", dataclasses.replace(tables.TABLES["x"], has_sources=False))
    assert source not in tables.update(page)[0] and "| 1 | 2 |" in tables.update(page)[0]
    path.with_name("y_gpu.json").write_text(path.read_text().replace("bench x", "bench x --rate 2"))
    path.write_text(path.read_text().replace("bench x", "bench x --rate 1"))
    two = tables.Table(("x_gpu", "y_gpu"), lambda x, y: [("a", "b"), (x["b"], y["b"])])
    monkeypatch.setitem(tables.TABLES, "x", two)
    assert "*`warp-bsc bench x --rate 1|2`: 2026-11-26, commit" in tables.update(page)[0]
    path.with_name("y_gpu.json").unlink()
    monkeypatch.setitem(tables.TABLES, "x", dataclasses.replace(two, files=("x_gpu",)))
    write(partial=True)
    with pytest.raises(ValueError, match=r"x_gpu\.json: the measurement was interrupted"):
        tables.update(page)
    path.write_text('{"benchmark": "x"}')
    with pytest.raises(ValueError, match=r"x_gpu\.json: has no record"):
        tables.update(page)
    with pytest.raises(ValueError, match="no table is named y, only front"):
        tables.update(page.replace("x", "y"))


def test_the_program_checks_and_writes(tmp_path, monkeypatch, capsys):
    page = tmp_path / "README.md"
    page.write_text((ROOT / "docs" / "measurements.md").read_text().replace("| 59,912 |", "| 59,913 |"))
    for name, value in {"PAGES": [page], "ROOT": tmp_path}.items():
        monkeypatch.setattr(tables, name, value)
    monkeypatch.setattr(sys, "argv", ["tables.py", "--check"])
    edited = page.read_text()
    assert tables.main() == 1
    assert "README.md is not what its measurements make" in capsys.readouterr().out
    assert page.read_text() == edited
    monkeypatch.setattr(sys, "argv", ["tables.py"])
    assert tables.main() == 0
    assert "| 59,912 |" in page.read_text()
    monkeypatch.setattr(sys, "argv", ["tables.py", "--check"])
    assert tables.main() == 0
