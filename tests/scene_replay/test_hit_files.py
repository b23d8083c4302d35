"""The JSON and CSV files of a replay: both list the same, in a file or on standard output."""

import csv
import json

import pytest
from replay_files import falling_through_quads, near_and_inside_stage, replay
from usd_stages import FALLING, add_mesh, moved, save

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


def test_json_names_prims_once(tmp_path):
    """In its first line, whatever it lists: collisions, intersections, proximities, their sums, and ignored pairs."""
    stage = near_and_inside_stage(tmp_path)
    heights = {0: -0.5, 1: 0.25, 2: -0.25}
    add_mesh(stage, "/World/Crossing", {time: moved(FALLING, (0.5, 1.0, z)) for time, z in heights.items()})
    text = replay(stage, "--clearance", "0.3", "--ignore", "/World/Falling", "/World/Crossing")[0].read_text()
    found = json.loads(text)
    assert found["hits"] and found["intersections"] and found["nearest"]
    first, rest = text.split("\n", 1)
    assert "/World/" not in rest
    names = ["/World/Floor", "/World/Falling", "/World/Case", "/World/Inside", "/World/Crossing"]
    assert found["meshes"] == found["prims"] == names
    assert first.count("/World/Floor") == 2  # in these two lists


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
