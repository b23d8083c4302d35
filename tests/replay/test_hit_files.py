"""The JSON and CSV files of a replay: both list the same, in a file or on standard output."""

import csv
import json

import pytest
from replay_files import falling_through_quads, replay
from stages import save

from warp_bsc.cli.main import main


@pytest.fixture
def stage(tmp_path):
    return falling_through_quads(tmp_path)


def test_csv_has_what_json_has(stage, tmp_path):
    replay(stage)
    found = json.loads((tmp_path / "hits.json").read_text())
    row, *at_rest = csv.DictReader((tmp_path / "hits.csv").read_text().splitlines())
    assert {row["kind"] for row in at_rest} == {"edge-face"}
    (contact,) = (contact for interval in found["intervals"] for contact in interval["contacts"])
    assert (row["first_prim"], row["first_element"], row["first_index"]) == ("/World/Falling", "vertex 0", "0")
    assert (row["second_prim"], row["second_element"], row["second_index"]) == ("/World/Floor", "face 1", "1")
    assert [float(row[name]) for name in ("x", "y", "z", "toi", "time")] == [
        *contact["position"], contact["toi"], contact["time"]
    ]  # fmt: skip
    assert (row["kind"], row["interval"], float(row["start"]), float(row["end"])) == ("vertex-face", "2", 2, 3)


@pytest.mark.parametrize("order", [["SCENE", "--json"], ["--json", "SCENE"]])
def test_json_is_printed_without_a_file(stage, capsys, order):
    path = save(stage)
    assert main(["replay", *[path if word == "SCENE" else word for word in order], "--device", "cpu"]) == 0
    assert json.loads(capsys.readouterr().out)["hits"] == 1


def test_csv_is_printed_without_a_file(stage, capsys):
    assert main(["replay", save(stage), "--device", "cpu", "--csv", "--no-intersections"]) == 0
    assert len(capsys.readouterr().out.splitlines()) == 2


def test_json_to_dev_stdout_is_printed_alone(stage, capsys):
    assert main(["replay", save(stage), "--device", "cpu", "--json", "/dev/stdout"]) == 0
    assert json.loads(capsys.readouterr().out)["hits"] == 1
    assert main(["replay", save(stage), "--device", "cpu", "--json", "/dev/stdout", "--csv"]) == 2
    assert "only one" in capsys.readouterr().err
