"""Replays that are killed, which no handler sees: the finished intervals are there for --resume, and nothing half."""

import json
import os
import signal
import subprocess
import sys
import time

import pytest
from waving_sheets import OUTPUTS, options, write_old, write_scene

from warp_bsc._atomic_file import OutputFile, unfinished_path
from warp_bsc.cli import replay_run
from warp_bsc.cli.main import main
from warp_bsc.scene_replay import hit_files

PART = "hits.json.part"
FRAMES = 12


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return str(write_scene(tmp_path_factory.mktemp("scene") / "waves.usdc", frames=FRAMES))


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def replay(scene, folder, *more, status=0):
    files = ["--json", str(folder / "hits.json"), "--csv", str(folder / "hits.csv"), "--device", "cpu"]
    assert main(["replay", scene, *files, *more]) == status
    return contents(folder)


@pytest.fixture(scope="module")
def whole(scene, tmp_path_factory):
    """The files of a replay that nothing disturbs."""
    return replay(scene, tmp_path_factory.mktemp("whole"))


def kill(scene, folder, count, *more):
    """Starts a replay, and kills it when a number of intervals is on the disk."""
    command = [sys.executable, "-m", "warp_bsc", "replay", scene, *options(folder), *more]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        deadline = time.monotonic() + 120
        part = folder / PART
        while not (part.exists() and part.read_bytes().count(b"\n") > count) and time.monotonic() < deadline:
            assert process.poll() is None
            time.sleep(0.005)
        process.kill()
    assert process.returncode == -signal.SIGKILL


@pytest.mark.slow
def test_killed_twice_and_resumed(tmp_path, scene, capsys):
    """Once alone, then with workers, which go on from the first time."""
    longer = ("--subdivide", "4")
    undisturbed, folder = tmp_path / "whole", tmp_path / "0"
    undisturbed.mkdir()
    folder.mkdir()
    assert main(["replay", scene, *options(undisturbed), *longer]) == 0
    write_old(folder)
    for count, more in ((3, []), (15, ["--resume", "--workers", "2"])):
        kill(scene, folder, count, *longer, *more)
        left = contents(folder)
        assert left.pop(PART).count(b"\n") > count
        assert left == {name: b"old" for name in OUTPUTS.values()}
    capsys.readouterr()
    assert main(["replay", scene, *options(folder), "--resume", *longer]) == 0
    assert contents(folder) == contents(undisturbed)
    taken = int(capsys.readouterr().out.split("Taken from an earlier run: ")[1].split()[0])
    assert 14 <= taken < 4 * (FRAMES - 1)


def cut_in_a_record(hits):
    return hits[: hits.index(b'{"index": 8') + 400]


def cut_after_a_record(hits):
    return hits[: hits.index(b'{"index": 8') - len(b",\n")]


def cut_in_the_end(hits):
    return hits[: hits.index(b'"complete"') + 20]


def with_what_a_disk_returns_after_a_power_failure(hits):
    return cut_in_a_record(hits) + bytes(4096)


@pytest.mark.parametrize(
    ("tear", "count"),
    [
        (cut_in_a_record, 7),
        (cut_after_a_record, 7),
        (cut_in_the_end, FRAMES - 1),
        (with_what_a_disk_returns_after_a_power_failure, 7),
    ],
)
def test_a_torn_file(tmp_path, scene, whole, capsys, tear, count):
    # the last whole interval is checked again: what crosses at its end is in the next one
    (tmp_path / PART).write_bytes(tear(whole["hits.json"]))
    assert replay(scene, tmp_path, "--resume") == whole
    assert f"Taken from an earlier run: {count} intervals." in capsys.readouterr().out


def test_a_finished_file_is_not_torn(tmp_path, scene, whole, capsys):
    (tmp_path / "hits.json").write_bytes(cut_in_a_record(whole["hits.json"]))
    replay(scene, tmp_path, "--resume", status=2)
    assert "error" in capsys.readouterr().err


@pytest.mark.parametrize("longer", [PART, "hits.json"])
def test_the_file_with_more_intervals_is_taken(tmp_path, scene, whole, capsys, longer):
    hits = whole["hits.json"]
    (tmp_path / longer).write_bytes(cut_in_the_end(hits) if longer == PART else hits)
    (tmp_path / ({PART, "hits.json"} - {longer}).pop()).write_bytes(cut_after_a_record(hits))
    assert replay(scene, tmp_path, "--resume") == whole
    assert f"Taken from an earlier run: {FRAMES - 1} intervals." in capsys.readouterr().out


def test_a_file_of_other_options_is_not_taken(tmp_path, scene, whole, capsys):
    part = tmp_path / PART
    part.write_bytes(whole["hits.json"])
    replay(scene, tmp_path, "--resume", "--no-self", status=2)
    said = (
        f"warp-bsc: error: {part}: written with other options or files; cannot resume: self_collisions was True, and is"
    )
    assert capsys.readouterr().err.startswith(said)
    assert contents(tmp_path) == {PART: whole["hits.json"]}
    (tmp_path / "hits.json").write_bytes(
        whole["hits.json"].replace(b'"self_collisions": true', b'"self_collisions": false')
    )
    assert (
        json.loads(replay(scene, tmp_path, "--resume", "--no-self")["hits.json"])["options"]["self_collisions"] is False
    )
    assert "Taken from an earlier run" in capsys.readouterr().out


def test_a_run_that_does_not_go_on_replaces_it(tmp_path, scene, whole):
    (tmp_path / PART).write_bytes(b"something else")
    assert replay(scene, tmp_path) == whole


@pytest.mark.parametrize("name", [PART, "hits.json"])
def test_what_is_resumed_is_kept_until_there_is_more(tmp_path, monkeypatch, scene, whole, name):
    """A run that goes on is stopped while it still takes the intervals of the one before."""
    file = tmp_path / name
    earlier = cut_in_the_end(whole["hits.json"]) if name == PART else whole["hits.json"]
    file.write_bytes(earlier)
    original = replay_run.replay

    def interrupted(*arguments, **named):
        for result in original(*arguments, **named):
            if result.summary.index == 5:
                os.kill(os.getpid(), signal.SIGTERM)
            yield result

    with monkeypatch.context() as patch:
        patch.setattr(replay_run, "replay", interrupted)
        left = replay(scene, tmp_path, "--resume", status=128 + signal.SIGTERM)
    assert left.keys() == {name, "hits.csv"} and left[name] == earlier
    assert replay(scene, tmp_path, "--resume") == whole


def test_it_is_saved_every_some_seconds(tmp_path, monkeypatch, scene):
    saved, now = [], [0.0]
    monkeypatch.setattr(hit_files.time, "monotonic", lambda: now[0])
    original = hit_files.HitsJson.add

    def add(self, result):
        now[0] += 9.0
        original(self, result)

    monkeypatch.setattr(hit_files.HitsJson, "add", add)
    save = OutputFile.save
    monkeypatch.setattr(OutputFile, "save", lambda self: saved.append(now[0]) or save(self))
    replay(scene, tmp_path)
    assert saved[:3] == [9.0, 36.0, 63.0] and len(saved) == (FRAMES - 1 + 2) // 3


def test_the_file_in_the_making_is_no_other_file(tmp_path, scene, capsys):
    words = ["--json", str(tmp_path / "hits"), "--csv", str(tmp_path / "hits.part")]
    assert main(["replay", scene, *words]) == 2
    assert "hits.part: named twice, as two files of a replay" in capsys.readouterr().err


def test_two_processes_that_write_the_same_file(tmp_path):
    """Neither takes the other's unfinished file for its own."""
    path = tmp_path / "hits.json"
    first, second = OutputFile(path), OutputFile(path)
    for number, file in enumerate((first, second)):
        file.write(f"{number}")
        file.save()
    with pytest.raises(FileExistsError, match="another process, which writes the same file, has replaced"):
        first.commit()
    second.write("!")
    assert unfinished_path(path).read_text() == "1!"
    second.commit()
    assert path.read_text() == "1!"
    with pytest.raises(FileExistsError, match=r"has replaced .*hits\.json\.part"):
        first.commit()
    first.discard()
    assert list(tmp_path.iterdir()) == [path]
