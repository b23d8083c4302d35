"""Replays that a signal or an error stops at any moment: files are whole, or valid and marked as partial."""

import json
import os
import random
import re
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from progress_lines import without_progress
from pxr import Sdf, Usd
from replay_files import errors_of
from waving_sheets import FRAMES, OUTPUTS, options, write_old, write_scene

from warp_bsc.cli import replay_run
from warp_bsc.cli.main import main

if sys.platform == "win32":
    pytest.skip("signals of POSIX", allow_module_level=True)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Two sheets that wave through each other, in the binary format, which is read while the replay goes on."""
    return str(write_scene(tmp_path_factory.mktemp("scene") / "waves.usdc"))


def read_left(folder, reason):
    """How many intervals each of the files has, None if it is the old one; all of them are valid."""
    assert {path.name for path in folder.iterdir()} == set(OUTPUTS.values())
    *texts, columns = [(folder / name).read_bytes() for name in OUTPUTS.values()]
    counts = [None] * len(OUTPUTS)
    hits, rows, overlay, page = (text.decode() for text in texts)
    partial = rf"partial: (\d+) of {FRAMES - 1} intervals(?: were checked)?; {reason}"
    if hits != "old":
        found = json.loads(hits)
        counts[0] = len(found["intervals"])
        assert found["complete"] == (counts[0] == FRAMES - 1)
        assert found["complete"] or re.fullmatch(reason, found["stopped"])
    if rows != "old":
        last = rows.splitlines()[-1]
        counts[1] = int(re.match("# " + partial, last).group(1)) if last.startswith("#") else FRAMES - 1
        assert {len(row.split(",")) for row in rows.splitlines() if not row.startswith("#")} == {25}
    if overlay != "old":
        data = Sdf.Layer.FindOrOpen(str(folder / "overlay.usda")).customLayerData["collisions"]
        counts[2] = data["intervals"]
        assert data["complete"] == (counts[2] == FRAMES - 1)
        assert data["complete"] or re.fullmatch(reason, data["stopped"])
    if page != "old":
        assert page.rstrip().endswith("</html>")
        said = re.search("P" + partial[1:], page)
        counts[3] = int(said.group(1)) if said else FRAMES - 1
    if columns != b"old":
        arrays = dict(np.load(folder / "hits.npz"))
        counts[4] = len(arrays["starts"])
        facts = json.loads(str(arrays["facts"]))
        assert facts["complete"] == (counts[4] == FRAMES - 1)
        assert facts["complete"] or re.fullmatch(reason, facts["stopped"])
        assert arrays["interval"].max() < counts[4] and facts["hits"] == arrays["normal"].any(axis=1).sum()
    return counts


def check_stopped(folder, number, moment, scene):
    """Start a replay, send it a signal after some seconds, and look at what is left."""
    write_old(folder)
    command = [sys.executable, "-m", "warp_bsc", "replay", scene, *options(folder)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        time.sleep(moment)
        process.send_signal(number)
        _, said = process.communicate(timeout=60)
    status = process.returncode
    name = number.name
    if number == signal.SIGKILL:
        (folder / "hits.json.part").unlink(missing_ok=True)
    counts = read_left(folder, "interrupted" + (f" by {name}" if number != signal.SIGINT else ""))
    if counts[list(OUTPUTS).index("--overlay")]:
        assert errors_of(Usd.Stage.Open(str(folder / "overlay.usda"))) == []
    if status == 0:  # it was faster
        assert counts == [FRAMES - 1] * len(OUTPUTS)
    elif number == signal.SIGKILL:
        assert status == -number
        assert set(counts) <= {None, FRAMES - 1}
    elif status == -number:  # Python was not there yet, or not any more
        assert counts in ([None] * len(OUTPUTS), [FRAMES - 1] * len(OUTPUTS))
    else:
        assert status == 128 + number
        assert said == "warp-bsc: interrupted" + (f" by {name}\n" if number != signal.SIGINT else "\n")
        assert len(set(counts)) == 1 and counts[0] != 0
    return status, counts


@pytest.fixture(scope="module")
def seconds(scene, tmp_path_factory):
    """How long a whole replay takes."""
    assert main(["replay", scene, "--device", "cpu"]) == 0  # compiles kernels
    start = time.perf_counter()
    command = [sys.executable, "-m", "warp_bsc", "replay", scene, *options(tmp_path_factory.mktemp("whole"))]
    subprocess.run(command, check=True, capture_output=True)
    return time.perf_counter() - start


@pytest.mark.slow
@pytest.mark.parametrize(("number", "times"), [(signal.SIGTERM, 1), (signal.SIGINT, 1), (signal.SIGKILL, 2)])
def test_stopped_at_random_moments(tmp_path, scene, seconds, number, times):
    moments = random.Random(number)
    for place in range(times):
        folder = tmp_path / str(place)
        folder.mkdir()
        check_stopped(folder, number, moments.uniform(0.5, seconds), scene)


def replay_with(monkeypatch, scene, folder, happens, at=3):
    """The exit status of a replay in which something happens before the results of an interval are taken."""
    whole = replay_run.replay

    def interrupted(*arguments, **options):
        for index, found in enumerate(whole(*arguments, **options)):
            if index == at:
                happens()
            yield found

    monkeypatch.setattr(replay_run, "replay", interrupted)
    write_old(folder)
    return main(["replay", scene, *options(folder)])


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGINT])
def test_signal(tmp_path, monkeypatch, capsys, scene, number):
    handlers = [signal.getsignal(each) for each in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT)]
    said = "interrupted" if number == signal.SIGINT else f"interrupted by {number.name}"
    status = replay_with(monkeypatch, scene, tmp_path, lambda: os.kill(os.getpid(), number))
    assert status == 128 + number
    # the line before is there where this process is the first to compile kernels
    assert capsys.readouterr().err.splitlines()[-1] == f"warp-bsc: {said}"
    assert read_left(tmp_path, said) == [3] * len(OUTPUTS)
    assert [signal.getsignal(each) for each in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT)] == handlers


def test_signals_that_follow_disturb_nothing(tmp_path, monkeypatch, scene):
    finish = replay_run.finish_outputs

    def disturbed(*arguments):
        os.kill(os.getpid(), signal.SIGHUP)
        return finish(*arguments)

    monkeypatch.setattr(replay_run, "finish_outputs", disturbed)
    status = replay_with(monkeypatch, scene, tmp_path, lambda: os.kill(os.getpid(), signal.SIGTERM))
    assert status == 128 + signal.SIGTERM
    assert read_left(tmp_path, "interrupted by SIGTERM") == [3] * len(OUTPUTS)


def test_signal_while_the_files_are_finished(tmp_path, monkeypatch, capsys, scene):
    finish = replay_run.finish_outputs

    def disturbed(*arguments):
        os.kill(os.getpid(), signal.SIGTERM)
        return finish(*arguments)

    monkeypatch.setattr(replay_run, "finish_outputs", disturbed)
    write_old(tmp_path)
    assert main(["replay", scene, *options(tmp_path)]) == 128 + signal.SIGTERM
    assert read_left(tmp_path, "") == [FRAMES - 1] * len(OUTPUTS)
    assert capsys.readouterr().err == "warp-bsc: interrupted by SIGTERM\n"


def test_signal_in_a_destructor_is_not_lost(tmp_path, monkeypatch, scene):
    class Sink:
        def __del__(self):
            os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(sys, "unraisablehook", lambda _: None)
    assert replay_with(monkeypatch, scene, tmp_path, Sink) == 128 + signal.SIGTERM
    assert read_left(tmp_path, "interrupted by SIGTERM") == [4] * len(OUTPUTS)


def test_signal_that_the_program_was_told_to_ignore(tmp_path, monkeypatch, scene):
    handler = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        assert replay_with(monkeypatch, scene, tmp_path, lambda: os.kill(os.getpid(), signal.SIGHUP)) == 0
    finally:
        signal.signal(signal.SIGHUP, handler)
    assert read_left(tmp_path, "") == [FRAMES - 1] * len(OUTPUTS)


def test_replay_in_another_thread(tmp_path, monkeypatch, scene):
    """A signal that has stopped an earlier replay of the process does not stop it."""
    (tmp_path / "stopped").mkdir()
    with monkeypatch.context() as patch:
        number = signal.SIGTERM
        assert replay_with(patch, scene, tmp_path / "stopped", lambda: os.kill(os.getpid(), number)) == 128 + number
    status = []
    thread = threading.Thread(target=lambda: status.append(main(["replay", scene, *options(tmp_path)])))
    thread.start()
    thread.join()
    assert status == [0]


@pytest.mark.parametrize(
    "error", [RuntimeError("broken"), TypeError("broken"), MemoryError("broken"), OSError("broken")]
)
def test_error_leaves_what_was_finished(tmp_path, monkeypatch, capsys, scene, error):
    def fail():
        raise error

    assert replay_with(monkeypatch, scene, tmp_path, fail) == 2
    said = without_progress(capsys.readouterr().err)
    assert said.startswith("warp-bsc: error: ") and "broken" in said and len(said.splitlines()) == 1
    assert read_left(tmp_path, "stopped by an error: .*broken.*") == [3] * len(OUTPUTS)


@pytest.mark.parametrize("change", ["another", "cut off", "garbage", "another in its place"])
def test_scene_that_changes_meanwhile(tmp_path, monkeypatch, capfd, change):
    path, other, folder = tmp_path / "scene.usdc", tmp_path / "other.usdc", tmp_path / "left"
    folder.mkdir()
    write_scene(path)
    write_scene(other, phase=0.1)

    def happens():
        if change == "another in its place":
            other.rename(path)
        elif change == "cut off":
            os.truncate(path, 1000)
        else:
            data = other.read_bytes() if change == "another" else b"\xff" * path.stat().st_size
            with path.open("r+b") as file:
                file.write(data)

    assert replay_with(monkeypatch, str(path), folder, happens) == 2
    message = f"{path}: the file has changed since it was opened"
    assert capfd.readouterr().err.splitlines()[-1] == f"warp-bsc: error: {message}"
    left = read_left(folder, f"stopped by an error: {message}")
    assert left == left[:1] * len(OUTPUTS)
    assert left[0] in (None, 1, 2, 3)  # nothing is written any more, of what waits to be
