"""Replays by several processes, on this machine and in a cluster, and replays that go on: always the same files."""

import importlib.util
import json
import multiprocessing
import os
import pickle
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections import deque
from concurrent.futures import Future
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from progress_lines import without_progress
from pxr import Ts, UsdGeom, Vt
from usd_stages import FALLING, FLOOR, add_instancer, add_mesh, animate, floor_stage, moved, new_stage, save, with_names

import warp_bsc as bsc
from warp_bsc.cli import replay_run
from warp_bsc.cli.main import main
from warp_bsc.scene_replay import checking, worker, workers

FILES = {"--json": "hits.json", "--csv": "hits.csv", "--overlay": "overlay.usdc", "--report": "page.html"}
FILES["--npz"] = "hits.npz"
FRAMES, SIDE = 24, 3


def add_sheet(stage, name, lag, broken=None):
    """A sheet of quadrilaterals that waves; at one time a point of it may be nowhere."""
    x, y = np.meshgrid(np.linspace(-1, 1, SIDE), np.linspace(-1, 1, SIDE), indexing="ij")
    corner = (np.arange(SIDE - 1)[:, None] * SIDE + np.arange(SIDE - 1)).reshape(-1, 1)
    quads = corner + np.array([0, SIDE, SIDE + 1, 1])
    mesh = UsdGeom.Mesh.Define(stage, name)
    mesh.CreateFaceVertexCountsAttr([4] * len(quads))
    mesh.CreateFaceVertexIndicesAttr(quads.reshape(-1).tolist())
    for frame in range(FRAMES):
        points = np.stack([x, y, 0.2 * np.sin(3 * x + 0.4 * frame + lag)], axis=2).reshape(-1, 3)
        if frame == broken:
            points[3] = np.nan
        mesh.CreatePointsAttr().Set(Vt.Vec3fArray.FromNumpy(points.astype(np.float32)), frame)
    return mesh


@pytest.fixture(scope="module")
def waves(tmp_path_factory):
    """Two sheets that wave through each other."""
    stage = new_stage(tmp_path_factory.mktemp("waves") / "waves.usdc")
    add_sheet(stage, "/World/A", 0.0)
    add_sheet(stage, "/World/B", 2.0)
    return save(stage)


@pytest.fixture(scope="module")
def troubled(tmp_path_factory):
    """The same with all that makes an interval depend on those before it.

    Two meshes break at different times, one jumps, one appears, two share a seam, an instancer places some, and one
    comes to be inside another.
    """
    stage = new_stage(tmp_path_factory.mktemp("troubled") / "troubled.usda")
    add_sheet(stage, "/World/A", 0.0)
    add_sheet(stage, "/World/B", 2.0)
    add_sheet(stage, "/World/Breaks", 1.0, broken=9)
    add_sheet(stage, "/World/BreaksLater", 1.5, broken=17)
    later = add_sheet(stage, "/World/Appears", 0.5)
    UsdGeom.Imageable(later).CreateVisibilityAttr().Set("invisible", 0)
    later.GetVisibilityAttr().Set("inherited", 13)
    spline = Ts.Spline("float")
    for frame, angle in ((0, 0), (5, 180), (12, 90), (FRAMES - 1, 90)):
        knot = Ts.Knot("float")
        knot.SetTime(frame)
        knot.SetValue(angle)
        knot.SetNextInterpolation(Ts.InterpHeld)
        spline.SetKnot(knot)
    turned = add_mesh(stage, "/World/Jumps", moved(FALLING, (-0.5, 0.5, -0.2)))
    assert turned.AddRotateXOp().GetAttr().SetSpline(spline)
    for name, shift in (("SeamA", 0), ("SeamB", 4)):
        floor = moved(FLOOR, (shift - 2, 0, 0))
        add_mesh(stage, f"/World/{name}", {0: floor, FRAMES - 1: moved(floor, (0, 0, 0.3))})
    add_mesh(stage, "/World/Instances/Prototype", FALLING)
    positions = {0: [(0, 0, 0.5), (0.2, 0.2, 0.3)], FRAMES - 1: [(0, 0, -0.5), (0.2, 0.2, -0.6)]}
    add_instancer(stage, "/World/Instances", positions, ["/World/Instances/Prototype"])
    case = UsdGeom.Cube.Define(stage, "/World/Case")
    animate(case, (6, 6, 6))
    animate(add_mesh(stage, "/World/Enters", FALLING), (3, 6, 6), (6, 6, 6), times=[0, FRAMES - 1])
    return save(stage)


def run(scene, folder, *options, status=0):
    """Replays a scene with all files, and returns their content."""
    folder.mkdir(exist_ok=True)
    words = [word for option, name in FILES.items() for word in (option, str(folder / name))]
    assert main(["replay", scene, "--device", "cpu", *words, *options]) == status
    return contents(folder)


def contents(folder):
    return {name: (folder / name).read_bytes() for name in FILES.values()}


def say_where(found, wanted):
    """Which files differ, as a page of bytes would not help."""
    return [name for name in wanted if found[name] != wanted[name]]


OPTIONS = "--ignore-initial", "--clearance", "0.02", "--validate", "1"
"""``--ignore-initial`` needs the first time in every worker, ``--clearance`` the end of a chunk."""

LEFT_OUT = 4
"""The exit status of a scene of which a part is left out."""


@pytest.fixture(scope="module")
def alone(troubled, tmp_path_factory):
    """The files that one process writes, in a folder as far from the scene as those of the tests: overlays name it."""
    return run(troubled, tmp_path_factory.mktemp("alone") / "1", *OPTIONS, status=LEFT_OUT)


def test_two_workers_write_the_same_files(troubled, alone, tmp_path, capsys):
    found = with_names(json.loads(alone["hits.json"]))
    assert found["complete"] and found["hits"] + len(found["ignored"]) > 0
    assert [re.sub(r" at time.*| is not.*", "", line) for line in found["left_out"]] == [
        "from time 8 to 10: /World/Breaks: vertex 3",
        "from time 16 to 18: /World/BreaksLater: vertex 3",
    ]
    assert [span["meshes"] for span in found["intersections"] if span["inside"]] == [["/World/Enters", "/World/Case"]]
    assert any("/World/Jumps jumps 2 times" in warning for warning in found["warnings"])
    capsys.readouterr()
    together = run(troubled, tmp_path / "2", "--workers", "2", *OPTIONS, status=LEFT_OUT)
    assert not say_where(together, alone)
    printed = capsys.readouterr().out
    assert len(re.findall(r"^  \S+:\d+ on cpu: \d+ intervals?, \d+\.\d+ s$", printed, re.MULTILINE)) == 2


@pytest.mark.slow
def test_a_process_for_each_named_device_writes_the_same_files(waves, tmp_path, capsys):
    """Also for one that is named twice, which is how a CPU tries several."""
    wanted = run(waves, tmp_path / "1")
    capsys.readouterr()
    assert not say_where(run(waves, tmp_path / "2", "--device", "cpu,cpu"), wanted)
    assert len(re.findall(r"^  \S+:\d+ on cpu: \d+ intervals?,", capsys.readouterr().out, re.MULTILINE)) == 2


def test_devices_that_are_not_there_or_too_many(waves, capsys):
    for options, said in (
        (("--device", "cpu,cuda:99"), "--device cuda:99: there is no such device here, only cpu"),
        (("--device", "cpu,"), "--device : there is no such device here, only cpu"),
        (("--device", "cpu,cpu", "--workers", "1"), "--workers must be an integer of at least 2"),
        (("--device", "cpu,cpu", "--workers", "tcp://h:1"), "--workers: a cluster takes one device, such as"),
    ):
        assert main(["replay", waves, *options]) == 2
        assert said in capsys.readouterr().err
    with pytest.raises(ValueError, match=r"^workers must be an integer of at least 2"):
        bsc.replay(bsc.Scene(waves), device="cpu,cpu", workers=1)
    assert [workers.checked_workers(None, names) for names in (None, "cpu", "cpu,cpu")] == [1, 1, 2]
    with pytest.raises(ValueError, match="cuda:99: there is no such device here, only cpu"):
        list(bsc.replay(bsc.Scene(waves), device="cpu,cuda:99"))


def test_workers_that_start_before_a_broken_scene_is_read_end(tmp_path, capsys, monkeypatch):
    close, started = workers.LocalWorkers.close, []

    def close_what_has_started(processes):
        started.append(multiprocessing.active_children())
        close(processes)

    monkeypatch.setattr(workers.LocalWorkers, "close", close_what_has_started)
    (tmp_path / "scene.usda").write_text("#usda 1.0\ndef")
    assert main(["replay", str(tmp_path / "scene.usda"), "--device", "cpu", "--workers", "2"]) == 2
    said = capsys.readouterr().err
    assert said.startswith("warp-bsc: error: ") and said.count("\n") == 1 and "scene.usda" in said
    for process in started.pop():
        process.join(10.0)
        assert process.exitcode == -signal.SIGKILL


@pytest.mark.parametrize("intervals", [0, 1, 7, 50, 1000])
def test_chunks_are_of_equal_length(waves, monkeypatch, intervals):
    """All workers then end at about the same time; 50 intervals on 4 GPUs are 12 chunks of 4 or 5, 7 are 4 of 1 or 2.

    The first time of a chunk is checked in the chunk before as well, which takes as long as an interval.
    """
    scene = bsc.Scene(waves)
    monkeypatch.setattr(bsc.Scene, "__len__", lambda _: intervals + 3)
    chunks = list(workers.cut_in_chunks(scene, 3, 4))
    assert [number for chunk in chunks for number in range(*chunk)] == list(range(3, intervals + 3))
    lengths = {stop - start for start, stop in chunks}
    assert max(lengths, default=0) - min(lengths, default=0) <= 1 and max(lengths, default=1) <= 16
    assert len(chunks) == {7: 4, 50: 12}.get(intervals, len(chunks))


@pytest.mark.parametrize(
    "options",
    [
        pytest.param((), marks=pytest.mark.slow),
        ("--ignore-initial", "--ignore", "/World/A", "*", "--clearance", "0.02"),
    ],
)
def test_any_number_of_intervals_at_once(troubled, tmp_path, monkeypatch, options):
    """Each by itself, some, or all that have one segment: the files are the same, with all counts."""
    found = []
    for faces in (0, 2000, 10**6):
        monkeypatch.setattr(checking, "FACES_AT_ONCE", faces)
        found.append(run(troubled, tmp_path / str(faces), *options, status=LEFT_OUT))
    intervals = json.loads(found[0]["hits.json"])["intervals"]
    assert sum(bool(interval["hits"]) for interval in intervals) > 10
    assert not say_where(found[1], found[0]) and not say_where(found[2], found[0])


@pytest.mark.slow
def test_workers_compare_with_a_baseline(tmp_path, waves):
    run(waves, tmp_path / "1")
    baseline = tmp_path / "1" / "hits.json"
    options = ("--baseline", str(baseline), "--fail-on", "new", "--workers", "2")
    run(waves, tmp_path / "2", *options)
    run(waves, tmp_path / "2", "--fail-on", "collisions", status=1)
    fewer = json.loads(baseline.read_bytes())
    fewer["collision_spans"] = []
    baseline.write_text(json.dumps(fewer))
    run(waves, tmp_path / "3", *options, status=1)


def test_results_of_workers_in_python(waves):
    scene = bsc.Scene(waves)
    alone = list(bsc.replay(bsc.Scene(waves), device="cpu"))
    together = list(bsc.replay(scene, device="cpu", workers=2, earlier=alone[:3]))[3:]
    assert [result.summary.index for result in together] == list(range(3, FRAMES - 1))
    for one, other in zip(alone[3:], together, strict=True):
        np.testing.assert_array_equal(one.contacts.position, other.contacts.position)
        np.testing.assert_array_equal(one.contacts.interval.x1, other.contacts.interval.x1)
        assert one.summary.mesh_pairs == other.summary.mesh_pairs
        assert one.contacts.element_names(slice(None)) == other.contacts.element_names(slice(None))
        assert other.contacts.segment is scene.segment(other.summary.index)
        assert one.work.worker == "" and re.fullmatch(r".+:\d+", other.work.worker)


@pytest.mark.parametrize("kills", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_worker_that_is_killed(waves, kills):
    """What it was checking is checked by another one: nothing is lost, nothing comes twice."""
    alone = [result.summary.mesh_pairs for result in bsc.replay(bsc.Scene(waves), device="cpu")]
    found, killed = [], set()
    for result in bsc.replay(bsc.Scene(waves), device="cpu", workers=2):
        found.append((result.summary.index, result.summary.mesh_pairs))
        pid = int(result.work.worker.rpartition(":")[2])
        if len(killed) < kills and pid not in killed:
            killed.add(pid)
            os.kill(pid, signal.SIGKILL)
    assert len(killed) == kills
    assert found == list(enumerate(alone))


@pytest.mark.slow
def test_a_call_that_kills_every_worker(tmp_path):
    """The error names it, and the calls before it are answered."""
    calls = deque(
        workers.WorkerCall(f"checked interval {number}", function, arguments)
        for number, (function, arguments) in enumerate([(abs, (-1,)), (abs, (-2,)), (os._exit, (1,)), (abs, (-3,))])
    )
    with closing(workers.LocalWorkers(2)) as processes:
        answers = workers.results_in_order(processes, calls)
        assert [next(answers), next(answers)] == [1, 2]
        with pytest.raises(ChildProcessError, match=r"^worker after worker died while it checked interval 2"):
            next(answers)


def in_worker(*lines):
    """The arguments of a call that runs lines of Python in a worker."""
    return exec, "\n".join(("import os, time", "from warp_bsc.scene_replay import worker", *lines))


def test_what_a_worker_has_sent_is_there_before_it_ends_and_after(tmp_path):
    """Also if it dies between two messages; what has not come whole has not come."""
    told = tmp_path / "told"
    with closing(workers.LocalWorkers(1)) as processes:
        call = in_worker(
            "large = bytes(range(256)) * 100_000",
            "worker.send(worker._starter, large)",
            "deadline = time.monotonic() + 30",
            f"while not os.path.exists({str(told)!r}): time.sleep(0.01 if time.monotonic() < deadline else -1)",
            "worker.send(worker._starter, b'second')",
            "worker._starter.sendall(len(large).to_bytes(8, 'little') + large[:1000])",
            "os._exit(1)",
        )
        messages = processes.result(processes.submit(*call))
        assert next(messages) == bytes(range(256)) * 100_000
        told.touch()
        assert list(messages) == [b"second"]
        with pytest.raises(ChildProcessError):
            processes.result(processes.submit(*in_worker("worker._starter.sendall(bytes(4))", "os._exit(1)")))
        with pytest.raises(RuntimeError, match="ZeroDivisionError"):
            processes.result(processes.submit(*in_worker("1 / 0")))
        assert processes.result(processes.submit(abs, -1)) == 1


def test_workers_of_both_kinds_hand_over_the_same(waves, monkeypatch):
    """One on this machine while it checks a chunk, one of a cluster at the end."""
    scene, checks = bsc.Scene(waves), checking.Checks(bsc.Selection(), "exact", "cpu", True, None, 0)
    monkeypatch.setattr(worker, "_local", (0, 1))
    job, found = worker.pack(scene, checks), []
    here, there = socket.socketpair()
    with here, there:
        for starter in (None, there):
            monkeypatch.setattr(worker, "_opened", None)
            monkeypatch.setattr(worker, "_starter", starter)
            parts = worker.check_chunk(job, 0, 4)
            assert len(parts) == (0 if starter else 4)
            parts = parts or [worker.receive(here) for _ in range(4)]
            results = list(worker.unpack(scene, parts))
            at_rest = [found for result in results for found in result.intersections]
            assert [a is b for a, b in zip(at_rest[1::2], at_rest[2::2], strict=False)] == [True] * 3
            found.append([(one.summary.mesh_pairs, one.contacts.interval.x1.tolist()) for one in results])
    assert found[0] == found[1]


def children_of(pid):
    """Processes that check intervals for a process."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            stat, command = (folder / "stat").read_text(), (folder / "cmdline").read_bytes()
        except OSError:
            continue
        if int(stat.rpartition(")")[2].split()[1]) == pid and b"spawn_main" in command:
            found.append(int(folder.name))
    return found


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="finds processes in /proc")
@pytest.mark.parametrize(
    "number", [pytest.param(getattr(signal, "SIGKILL", signal.SIGTERM), marks=pytest.mark.slow), signal.SIGINT]
)
def test_workers_end_with_the_process_that_started_them(tmp_path, waves, number):
    """They say nothing, even if a Ctrl-C, which the terminal sends to all of them, comes while they start.

    If the process is killed before it has told a worker what to do, Python in the worker says that this never came.
    """
    words = [word for option, name in FILES.items() for word in (option, str(tmp_path / name))]
    command = [sys.executable, "-m", "warp_bsc", "replay", waves, "--device", "cpu", "--workers", "2", *words]
    command += ["--subdivide", "100"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True) as process:
        deadline = time.monotonic() + 60
        while len(started := children_of(process.pid)) < 2 and time.monotonic() < deadline:
            time.sleep(0.05)
        assert len(started) == 2
        os.killpg(process.pid, number) if number == signal.SIGINT else process.send_signal(number)
        _, said = process.communicate(timeout=60)
    while any(Path(f"/proc/{pid}").exists() for pid in started) and time.monotonic() < deadline + 10:
        time.sleep(0.05)
    assert not [pid for pid in started if Path(f"/proc/{pid}").exists()]
    assert not list(tmp_path.iterdir())
    interrupted = number == signal.SIGINT
    assert process.returncode == (130 if interrupted else -number)
    if interrupted:
        assert said == "warp-bsc: interrupted\n"


class Inline:
    """Workers that are this process."""

    died: type[Exception] = ChildProcessError
    attempts, count = 1, 2

    def __init__(self):
        self.calls = []

    def close(self):
        pass

    def submit(self, function, *arguments):
        self.calls.append(arguments[1:])
        future = Future()
        future.set_result(function(*arguments))
        return future

    def result(self, future):
        return future.result()


def test_a_chunk_that_takes_long_is_cut(troubled, monkeypatch):
    """So that results do not wait long for others, until a kill loses them; what reading reveals is not lost either."""
    monkeypatch.setattr(worker, "_local", (0, 1))
    monkeypatch.setattr(worker, "_opened", None)
    checks = checking.Checks(bsc.Selection(), "exact", "cpu", True, None, 0)
    found, calls = [], []
    for seconds in (1000.0, 0.0):
        monkeypatch.setattr(worker, "_CHUNK_SECONDS", seconds)
        scene, inline = bsc.Scene(troubled), Inline()
        results = list(workers.check_in_workers(scene, checks, inline))
        sums = [result.summary for result in results]
        assert [one.index for one in sums] == list(range(len(scene)))
        found.append(([(one.mesh_pairs, one.intersections) for one in sums], scene.left_out, scene.warnings))
        calls.append(len(inline.calls))
    assert found[0] == found[1]
    assert len(found[0][1]) == 2 and calls[1] > calls[0]


def test_what_breaks_later_is_not_known_earlier(tmp_path, monkeypatch):
    """A worker that goes back to a chunk that was cut has found meshes to be broken of which nobody knows yet.

    Which vertices coincide depends on how long all meshes are there.
    """
    stage = new_stage(tmp_path / "scene.usda")
    add_sheet(stage, "/World/Breaks", 1.0, broken=9)
    add_mesh(stage, "/World/SeamA", moved(FLOOR, (-2, 0, 0)))
    floor = moved(FLOOR, (2, 0, 0))
    add_mesh(stage, "/World/SeamB", {0: floor, 12: floor, FRAMES - 1: moved(floor, (0, 0, 0.3))})
    path = save(stage)
    monkeypatch.setattr(worker, "_local", (0, 1))
    checks = checking.Checks(bsc.Selection(), "exact", "cpu", True, None, 0)
    found = []
    for count, seconds in ((1, 1000.0), (4, 0.0)):
        monkeypatch.setattr(worker, "_opened", None)
        monkeypatch.setattr(worker, "_CHUNK_SECONDS", seconds)
        scene, inline = bsc.Scene(path), Inline()
        inline.count = count
        results = list(workers.check_in_workers(scene, checks, inline))
        assert all(len(one.contacts.interval.x0) == one.contacts.segment.vertex_count for one in results)
        found.append([(one.summary.mesh_pairs, one.contacts.segment.vertex_count) for one in results])
        assert len(scene.left_out) == 1
    assert found[0] == found[1]


def test_what_breaks_at_the_first_time_is_told(tmp_path, monkeypatch):
    """By the worker that has read it before, to find what to ignore."""
    stage = floor_stage(tmp_path)
    add_sheet(stage, "/World/Breaks", 1.0, broken=1)
    monkeypatch.setattr(worker, "_local", (0, 1))
    monkeypatch.setattr(worker, "_opened", None)
    scene, inline = bsc.Scene(save(stage)), Inline()
    checks = checking.Checks(bsc.Selection(), "exact", "cpu", True, None, 0)
    assert workers.selection_without_initial_in_workers(scene, checks, inline) == checks.selection
    assert list(workers.check_in_workers(scene, checks, inline))
    assert len(scene.left_out) == 1


def test_an_error_in_a_worker(tmp_path, capsys):
    """The intervals before it are there, and the error reads as without workers."""
    stage = floor_stage(tmp_path)
    add_sheet(stage, "/World/A", 0.0, broken=11)
    path, said, found = save(stage), [], []
    for count in ("1", "2"):
        found.append(run(path, tmp_path / count, "--workers", count, "--strict", status=2))
        said.append(capsys.readouterr().err.splitlines()[-1])
    assert said[0] == said[1] and "/World/A: vertex 3 is not finite at time 11" in said[0]
    assert not say_where(found[1], found[0])
    assert len(json.loads(found[0]["hits.json"])["intervals"]) == 10


def stop(monkeypatch, scene, folder, at, *options):
    """Replays a scene until an interval is found, then sends this process SIGINT."""
    whole = replay_run.replay

    def interrupted(*arguments, **named):
        for result in whole(*arguments, **named):
            if result.summary.index == at:
                os.kill(os.getpid(), signal.SIGINT)
            yield result

    with monkeypatch.context() as patch:
        patch.setattr(replay_run, "replay", interrupted)
        run(scene, folder, *options, status=130)
    assert len(json.loads((folder / "hits.json").read_bytes())["intervals"]) == at


@pytest.mark.slow
def test_resumed(troubled, alone, tmp_path, monkeypatch, capsys):
    at, in_workers = 18, ("--workers", "2")
    folder = tmp_path / "stopped"
    stop(monkeypatch, troubled, folder, at, *in_workers, *OPTIONS)
    assert say_where(contents(folder), alone) == list(FILES.values())
    capsys.readouterr()
    resumed = run(troubled, folder, "--resume", *in_workers, *OPTIONS, status=LEFT_OUT)
    assert not say_where(resumed, alone)
    taken = re.search(r"Taken from an earlier run: (\d+) intervals?\.", capsys.readouterr().out)
    assert (int(taken.group(1)) if taken else 0) >= at - 1
    resumed = run(troubled, folder, "--resume", *OPTIONS, status=LEFT_OUT)  # nothing is left to do
    assert not say_where(resumed, alone)


def test_resumed_twice_without_a_file_at_first(tmp_path, monkeypatch, waves):
    whole = run(waves, tmp_path / "whole")
    folder = tmp_path / "stopped"
    for at in (1, 9):
        stop(monkeypatch, waves, folder, at, "--resume")
    assert not say_where(run(waves, folder, "--resume"), whole)


def test_what_cannot_be_resumed(tmp_path, monkeypatch, capsys, waves):
    folder = tmp_path / "stopped"
    scene = str(tmp_path / "scene.usdc")
    shutil.copy(waves, scene)
    stop(monkeypatch, scene, folder, 5, "--clearance", "0.1")

    def refused(*options):
        before = contents(folder)
        run(scene, folder, "--resume", *options, status=2)
        assert contents(folder) == before
        return capsys.readouterr().err.splitlines()[-1]

    place = f"warp-bsc: error: {folder / 'hits.json'}: written with other options or files; cannot resume: "
    assert refused() == place + "clearance was 0.1, and is None"
    same = ("--clearance", "0.1")
    assert refused(*same, "--method", "float") == place + "method was exact, and is float"
    assert refused(*same, "--no-self") == place + "self_collisions was True, and is False"
    assert refused(*same, "--frames", "0:9").startswith(place + "frames was None, and is {'start': 0.0")
    os.utime(scene, ns=(1, 1))
    assert refused(*same) == place + "the scene's files have changed"
    (folder / "hits.json").write_text('{"intervals": []}')
    assert "not a resumable replay of this version" in refused()
    assert main(["replay", scene, "--resume"]) == 2
    assert "--resume needs --json FILE" in capsys.readouterr().err


def test_a_pickled_scene_is_the_same_file(tmp_path, waves):
    path = tmp_path / "scene.usdc"
    shutil.copy(waves, path)
    pickled = pickle.dumps(bsc.Scene(path))
    assert pickle.loads(pickled).times == bsc.Scene(waves).times
    os.utime(path, ns=(1, 1))
    with pytest.raises(ValueError, match=r"scene\.usdc: not the version of the file that the replay was started with"):
        pickle.loads(pickled)


def test_a_pickled_scene_keeps_its_welds(tmp_path, monkeypatch, troubled):
    """A worker does not read the whole shot again to find vertices that always coincide."""
    scene = bsc.Scene(troubled)
    other = pickle.dumps(scene)
    monkeypatch.setattr("warp_bsc.usd.segment.Segment._find_welds", None)
    other = pickle.loads(other)
    assert scene.segment(0).welded > 0
    np.testing.assert_array_equal(other.segment(0).faces, scene.segment(0).faces)
    np.testing.assert_array_equal(other.interval(5).x1, scene.interval(5).x1)


@pytest.mark.parametrize(
    ("name", "number", "gpus", "device"),
    [
        (None, 3, 2, "cuda:1"),
        ("cuda", 1, 1, "cuda:0"),
        ("cuda", 4, 4, "cuda:0"),
        ("cuda:1", 0, 4, "cuda:1"),
        ("cpu", 1, 4, "cpu"),
        (None, 1, 0, None),
        ("cpu,cuda:1", 0, 4, "cpu"),
        ("cpu,cuda:1", 3, 4, "cuda:1"),
        ("cuda:1,cuda:1,cuda:0", 4, 2, "cuda:1"),
    ],
)
def test_each_local_worker_has_a_gpu(name, number, gpus, device):
    assert worker.device_of_worker(name, number, gpus) == device


def test_no_cluster(capsys, monkeypatch, waves):
    for wrong in ("head:8786", "tcp://", "0", "2.5"):
        assert main(["replay", waves, "--workers", wrong]) == 2
        said = (
            f"argument --workers: must be an integer of at least 1, or an address such as tcp://head:8786, not {wrong};"
        )
        assert said in capsys.readouterr().err
    for wrong in ("head", "8", "tcp://"):
        with pytest.raises(ValueError, match=r'^workers must be an integer or an address such as "tcp://head:8786"'):
            bsc.replay(bsc.Scene(waves), workers=wrong)
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert main(["replay", waves, "--workers", "tcp://127.0.0.1:1"]) == 2
    said = "warp-bsc: error: --workers: a cluster needs Dask: pip install 'warp-bsc[cluster]'\n"
    assert capsys.readouterr().err == said


needs_dask = pytest.mark.skipif(importlib.util.find_spec("distributed") is None, reason="needs Dask")


@pytest.fixture
def cluster(tmp_path):
    """The address of a cluster of two workers, each a process, and these processes."""
    folder = tmp_path / "dask"
    folder.mkdir()
    place = folder / "scheduler.json"
    start = [sys.executable, "-m", "dask"]
    options = {"cwd": folder, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    commands = [["scheduler", "--port", "0", "--no-dashboard", "--scheduler-file", str(place)]]
    worker = ["worker", "--scheduler-file", str(place), "--nthreads", "2", "--no-nanny", "--no-dashboard"]
    processes = [subprocess.Popen([*start, *words], **options) for words in [*commands, worker, worker]]
    try:
        deadline = time.monotonic() + 60
        while not place.exists() and time.monotonic() < deadline:
            time.sleep(0.05)
        yield json.loads(place.read_text())["address"], processes
    finally:
        for process in reversed(processes):
            process.kill()
            process.wait()


@needs_dask
@pytest.mark.slow
def test_a_cluster_writes_the_same_files(tmp_path, monkeypatch, cluster, troubled, alone, waves, capsys):
    address, processes = cluster
    assert not say_where(run(troubled, tmp_path / "2", "--workers", address, *OPTIONS, status=LEFT_OUT), alone)

    expected = [result.summary.mesh_pairs for result in bsc.replay(bsc.Scene(waves), device="cpu")]
    found = []
    for result in bsc.replay(bsc.Scene(waves), device="cpu", workers=address):
        found.append((result.summary.index, result.summary.mesh_pairs))
        if len(found) == 4:
            processes[1].kill()
    assert found == list(enumerate(expected))

    capsys.readouterr()
    whole = replay_run.replay

    def lost(*arguments, **named):
        for result in whole(*arguments, **named):
            if result.summary.index == 1:
                os.kill(processes[0].pid, signal.SIGKILL)
            yield result

    with monkeypatch.context() as patch:
        patch.setattr(replay_run, "replay", lost)
        assert main(["replay", waves, "--workers", address, "--subdivide", "100"]) == 2
    said = f"warp-bsc: error: --workers: {address}: lost the scheduler of the Dask cluster\n"
    assert without_progress(capsys.readouterr().err) == said
    assert main(["replay", waves, "--workers", address]) == 2
    assert f"--workers: {address}: cannot reach the scheduler of a Dask cluster" in capsys.readouterr().err
