"""The record of a measurement: command, commit, date, machine and versions; and the file that holds it."""

import datetime
import json
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import newton
import pytest
import warp as wp
from measured import write_measurement

import warp_bsc
from warp_bsc.bench import record as records
from warp_bsc.bench.record import describe_run, shorten_path, with_record
from warp_bsc.cli.main import main
from warp_bsc.detection.run.launch import count_cores

ROOT = Path(__file__).resolve().parents[2]
GPU = SimpleNamespace(name="a GPU", is_cuda=True)


def git(folder, *arguments):
    identity = ["-c", "user.name=a", "-c", "user.email=a@b"]
    command = ["git", "-C", str(folder), *identity, *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def test_machine_date_and_versions():
    before = datetime.datetime.now(datetime.UTC).replace(microsecond=0)
    record = describe_run(["warp-bsc", "bench"], [wp.get_device("cpu"), GPU])
    assert before <= datetime.datetime.fromisoformat(record["date"]) <= datetime.datetime.now(datetime.UTC)
    assert (record["gpus"], record["cores"]) == (["a GPU"], count_cores())
    assert record["cpu"]
    assert record["load"] is None or record["load"] >= 0.0
    assert record["python"] == sys.version.split()[0]
    versions = record["versions"]
    assert versions["warp-bsc"] == warp_bsc.__version__
    assert (versions["warp-lang"], versions["newton"]) == (wp.__version__, newton.__version__)
    assert "" not in versions.values() and None not in versions.values()


@pytest.mark.skipif(shutil.which("git") is None, reason="needs git")
def test_commit_of_the_checkout_and_whether_it_is_changed(tmp_path, monkeypatch):
    def commit():
        record = describe_run(["x"])
        return record["commit"], record["changed"]

    root = tmp_path.resolve()
    monkeypatch.setattr(records, "_ROOT", root)
    monkeypatch.setenv(records.COMMIT, "0123")
    assert commit() == ("0123", False)
    monkeypatch.delenv(records.COMMIT)
    assert commit() == (None, None)
    git(root, "init")
    (root / "a.py").write_text("1")
    git(root, "add", "a.py")
    git(root, "commit", "-m", "first")
    head = git(root, "rev-parse", "HEAD")
    (root / "untracked").write_text("")
    result = root / "warp_bsc" / "bench" / "measurements" / "a.json"
    result.parent.mkdir(parents=True)
    result.write_text("1")
    git(root, "add", "warp_bsc")
    git(root, "commit", "-m", "second")
    head = git(root, "rev-parse", "HEAD")
    result.write_text("2")  # a result is no change of what is measured
    assert commit() == (head, False)
    (root / "a.py").write_text("2")
    monkeypatch.setenv(records.COMMIT, "0123")  # git knows better
    assert commit() == (head, True)
    monkeypatch.delenv(records.COMMIT)
    (root / "inside").mkdir()
    monkeypatch.setattr(records, "_ROOT", root / "inside")  # installed below a checkout of something else
    assert commit() == (None, None)


@pytest.mark.parametrize(
    ("command", "expected"),
    [
        (["/usr/bin/warp-bsc", "bench", "--quick"], "warp-bsc bench --quick"),
        (["warp-bsc", "bench", "--json", "out.json", "--device", "cpu"], "warp-bsc bench --device cpu"),
        (["warp-bsc", "bench", "--json", "--figure=a.png", "--quick"], "warp-bsc bench --quick"),
        (["warp-bsc", "bench", "newton", "a --b c"], "warp-bsc bench newton 'a --b c'"),
        ([str(ROOT / "examples" / "cloth_env.py"), "--json", "x"], "python examples/cloth_env.py"),
        (["warp-bsc", "replay", str(ROOT / "assets" / "a.usd")], "warp-bsc replay assets/a.usd"),
    ],
)
def test_command_names_no_output_and_no_folder_of_the_machine(command, expected):
    assert describe_run(command)["command"] == expected


def test_paths_below_the_checkout_begin_at_its_root():
    assert shorten_path(str(ROOT / "assets" / "a.usd")) == "assets/a.usd"
    assert shorten_path("cloth:5000") == "cloth:5000"
    assert shorten_path("/elsewhere/a.usd") == "/elsewhere/a.usd"


def test_a_file_is_complete_or_absent(tmp_path):
    path = tmp_path / "found.json"
    with pytest.raises(TypeError):
        write_measurement(path, {"benchmark": object()})
    assert not list(tmp_path.iterdir())
    write_measurement(path, {"benchmark": "a", "rows": [1, 2]}, [GPU])
    found = json.loads(path.read_text())
    record = found.pop("record")
    assert found == {"benchmark": "a", "rows": [1, 2]}
    assert record.keys() == with_record({}, ["x"])["record"].keys()
    assert record["gpus"] == ["a GPU"]
    with pytest.raises(FileNotFoundError, match="there is no folder"):
        write_measurement(tmp_path / "gone" / "a.json", {})


@pytest.mark.slow
@pytest.mark.parametrize("benchmark", ["queries --count 100 --repeat 1", "detector cloth:1000 --repeat 1"])
def test_quick_benchmarks_write_and_print_it(capsys, tmp_path, benchmark):
    """Those that report many runs are tested with their tables."""
    path = tmp_path / "found.json"
    command = ["bench", *benchmark.split(), "--device", "cpu"]
    assert main([*command, "--json", str(path)]) == 0
    assert " on cpu, " in capsys.readouterr().out
    found = json.loads(path.read_text())
    assert found["benchmark"] == command[1]
    assert found["record"]["command"] == " ".join(["warp-bsc", *command])
    assert main([*command, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["record"]["command"] == found["record"]["command"]


@pytest.mark.parametrize("name", ["cloth:1000", "a.ply,b.ply", "a.usd"])
def test_the_file_must_not_be_a_scene(capsys, name):
    assert main(["bench", "detector", "--json", name]) == 2
    assert "this is a scene; name scenes before the options" in capsys.readouterr().err
