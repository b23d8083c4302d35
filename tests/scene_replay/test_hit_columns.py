"""The columns of a replay for NumPy: the rows of its CSV file, in a fifteenth of the space of its JSON file."""

import csv
import json
import zipfile

import numpy as np
import pytest
from replay_files import falling_through_quads, many_hits, near_and_inside_stage, replay
from usd_stages import save

from warp_bsc.cli.main import main
from warp_bsc.scene_replay import hit_columns


def rows_of_csv(path):
    """Returns the rows of a CSV file."""
    return [row for row in csv.DictReader(path.read_text().splitlines()) if not row["interval"].startswith("#")]


def check_same_rows(folder):
    """Asserts that both files have the same rows, to the precision of the columns; returns the columns."""
    columns, rows = dict(np.load(folder / "hits.npz")), rows_of_csv(folder / "hits.csv")  # read once
    assert len(rows) == len(columns["kind"]) > 0
    times = columns["starts"][columns["interval"]], columns["ends"][columns["interval"]]
    for number, row in enumerate(rows):
        assert int(row["interval"]) == columns["interval"][number]
        assert (row["kind"], row["phase"]) == (
            columns["kinds"][columns["kind"][number]], columns["phases"][columns["phase"][number]]
        )  # fmt: skip
        for side, which in enumerate(("first", "second")):
            mesh = columns["mesh"][number, side]
            assert (row[f"{which}_mesh"], row[f"{which}_prim"]) == (columns["meshes"][mesh], columns["prims"][mesh])
            element = columns["elements"][columns["element"][number, side]]
            indices = [int(row[name] or -1) for name in (f"{which}_index", f"{which}_index_2")]
            assert row[f"{which}_element"].split()[0] == element and indices == columns["index"][number, side].tolist()
        time = times[0][number] + columns["toi"][number] * (times[1][number] - times[0][number])
        assert float(row["time"]) == pytest.approx(time, abs=1e-6)
        assert [float(row[axis]) for axis in "xyz"] == pytest.approx(columns["position"][number].tolist(), rel=1e-6)
        normal = [float(row[f"normal_{axis}"] or 0.0) for axis in "xyz"]
        assert normal == pytest.approx((columns["normal"][number] / 32767.0).tolist(), abs=2e-5)
        assert float(row["distance"] or 0.0) == pytest.approx(columns["distance"][number], rel=1e-6)
    return columns


@pytest.mark.parametrize(
    "make, options", [(falling_through_quads, ()), (near_and_inside_stage, ("--clearance", "0.3"))]
)
def test_columns_have_what_csv_has(make, options, tmp_path):
    replay(make(tmp_path), *options)
    columns = check_same_rows(tmp_path)
    facts, found = json.loads(str(columns["facts"])), json.loads((tmp_path / "hits.json").read_text())
    assert facts["complete"] is True and facts["hits"] == found["hits"]
    assert facts["options"] == found["options"] and facts["meshes"] == found["meshes"]
    assert columns["starts"].tolist() == [interval["start"] for interval in found["intervals"]]


def test_a_hit_takes_less_than_30_bytes(tmp_path):
    replay(many_hits(tmp_path / "scene.usda", columns=200, samples=9))
    columns = check_same_rows(tmp_path)
    words = sum(columns[name].size for name in ("facts", "meshes", "prims", "kinds", "phases", "elements"))
    sizes = {name: (tmp_path / f"hits.{name}").stat().st_size for name in ("json", "npz")}
    assert len(columns["kind"]) > 5000 and words < 100
    assert sizes["npz"] < 30 * len(columns["kind"]) < sizes["json"] / 5


def test_blocks_of_any_size_hold_the_same_columns(tmp_path, monkeypatch):
    """Other programs read the archive as well: sizes and checksums of all members are those of their content."""
    scene, found = many_hits(tmp_path / "scene.usda", columns=20, samples=5), []
    for size, count in ((2**20, 32), (100, 3)):
        monkeypatch.setattr(hit_columns, "_BLOCK", size)
        monkeypatch.setattr(hit_columns, "_BLOCKS_AT_ONCE", count)
        replay(scene)
        with zipfile.ZipFile(tmp_path / "hits.npz") as archive:
            assert archive.testzip() is None
            found.append({name: archive.read(name) for name in archive.namelist()})
    assert found[0] == found[1] and len(found[0]["position.npy"]) > 1000


def test_columns_are_not_printed(tmp_path, capsys):
    assert main(["replay", save(falling_through_quads(tmp_path)), "--device", "cpu", "--npz", "-"]) == 2
    assert "--npz: it is no text" in capsys.readouterr().err
