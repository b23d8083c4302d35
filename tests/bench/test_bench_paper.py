"""The paper's benchmarks: what is measured is what the methods answer, and a run ends in tables, JSON and a figure."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp
from bench_commands import fail

from warp_bsc import CollisionDetector, CollisionMesh, checker
from warp_bsc.bench.measure import methods
from warp_bsc.bench.measure import paper as bench_paper
from warp_bsc.bench.measure.methods import METHODS, PHASES
from warp_bsc.bench.measure.paper import Effort, benchmark_scene, find_places
from warp_bsc.bench.measure.worst_case import find_worst
from warp_bsc.bench.peers import ipc_toolkit
from warp_bsc.bench.peers.ipc_toolkit import time_queries
from warp_bsc.bench.scenes.detector import load_intervals, load_scene, paper_scenes
from warp_bsc.cli.main import main
from warp_bsc.detection.run.launch import cores
from warp_bsc.detection.run.settings import SURFACE_KINDS, PairKind

TINY = Effort(intervals=2, queries=3000, sample=100, ipc_queries=20, adversaries=50, repeat=1)


@pytest.fixture(autouse=True)
def tiny(monkeypatch):
    monkeypatch.setattr(bench_paper, "QUICK", TINY)
    monkeypatch.setattr(methods, "_SMALLEST_LAUNCH", {False: 1, True: 1})
    monkeypatch.setattr("warp_bsc.bench.measure.worst_case._SUSPECTS", 2)
    monkeypatch.setattr("warp_bsc.bench.measure.worst_case._CPU_NANOSECONDS", 1e4)


def bench(capsys, *arguments):
    status = main(["bench", *map(str, arguments), "--device", "cpu", "--quick"])
    output = capsys.readouterr()
    assert status == 0, output.err
    return output.out


def test_json_has_everything(capsys):
    found = json.loads(bench(capsys, "cloth:1000", "--json"))
    assert (found["benchmark"], found["quick"], found["methods"]) == ("paper", True, list(METHODS))
    assert found["record"]["command"].startswith("warp-bsc bench")
    (scene,) = found["scenes"]
    assert (scene["name"], scene["triangles"], scene["precision"]) == ("cloth:1000", 1000, 32)
    step = load_scene("cloth:1000")
    collisions = CollisionDetector(CollisionMesh(step.faces, len(step.x0), device="cpu"), method="exact").detect(
        step.x0, step.x1
    )
    total = sum(scene["queries"].values())
    assert total <= 3002
    assert sum(scene["decided_by"].values()) == total
    assert list(scene["decided_by"]) == list(PHASES)
    assert total == scene["overlapping"]
    assert scene["collisions"] == len(collisions.vertex_face) + len(collisions.edge_edge)
    assert scene["errors"]["exact"] == {"hits": scene["collisions"], "false_positives": 0, "false_negatives": 0}
    assert scene["errors"]["conservative"]["false_negatives"] == 0
    assert scene["disagreeing"] == 0
    one, *_ = scene["timings"]
    assert (one["place"], one["cores"]) == ("CPU, 1 core", 1)
    for timing in scene["timings"]:
        assert all(timing["nanoseconds"][method] > 0.0 for method in METHODS)
    for method in METHODS:
        worst = one["worst"][method]
        assert worst["nanoseconds"].keys() == set(METHODS)
        assert np.array(worst["points"]).shape == (8, 3)
    (adversarial,) = found["adversarial"]
    assert adversarial["worst"].keys() == set(METHODS)
    assert scene["frame_milliseconds"] > 0.0
    assert list(scene["stage_milliseconds"])[:2] == ["broad phase", "cull"]


@pytest.mark.slow
def test_tables_files_and_figure(capsys, monkeypatch, tmp_path):
    pytest.importorskip("matplotlib")
    monkeypatch.setenv("COLUMNS", "100")
    times, figure = tmp_path / "times.json", tmp_path / "times.png"
    lines = bench(capsys, "cloth:1000", "crash:1000", "--json", times, "--figure", figure).splitlines()
    assert max(map(len, lines)) <= 100
    for start in ("Scene ", "ns a query, CPU, 1 core", "Slowest query, ns", "Wrong results", "ms a frame"):
        assert any(line.startswith(start) for line in lines), start
    assert [scene["name"] for scene in json.loads(times.read_text())["scenes"]] == ["cloth:1000", "crash:1000"]
    assert figure.read_bytes().startswith(b"\x89PNG")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["times.json", "times.png"]


def test_the_ipc_toolkit_is_measured(capsys):
    pytest.importorskip("ipctk")
    (scene,) = json.loads(bench(capsys, "cloth:1000", "--json"))["scenes"]
    assert scene["ipc_toolkit"].keys() == {"tight inclusion", "additive"}
    for took in scene["ipc_toolkit"].values():
        assert took["false_negatives"] == 0
        assert took["call_nanoseconds"] > 0.0
        assert took["checked"] > 0


@pytest.mark.parametrize(("query", "expected"), [(350, 250), (60, 0)])
@pytest.mark.parametrize("kind", SURFACE_KINDS, ids=lambda kind: kind.label)
def test_what_a_call_takes_is_taken_off(monkeypatch, kind, query, expected):
    """By a clock that a call advances by 100 ns, where the features are far apart, and a query otherwise."""
    clock = SimpleNamespace(now=0.0)

    def ask(*points):
        far = np.linalg.norm(points[0] - points[3]) > 1e3
        clock.now += 1e-9 * (100 if far else query)

    monkeypatch.setattr(ipc_toolkit, "_ccd", lambda method, kind: ask)
    monkeypatch.setattr(ipc_toolkit, "time", SimpleNamespace(perf_counter=lambda: clock.now))
    points = np.random.default_rng(1).uniform(size=(20, 8, 3))
    assert time_queries("additive", kind, points) == pytest.approx((expected, 100))


def test_wrong_answers_are_counted(monkeypatch):
    """Against a checker that says the opposite, every answer that was checked is wrong."""
    for kind in SURFACE_KINDS:
        truth = getattr(checker, kind.label)
        monkeypatch.setattr(checker, kind.label, lambda points, truth=truth: ~truth(points))
    places = find_places([wp.get_device("cpu")])[:1]
    found = benchmark_scene("cloth:1000", load_intervals("cloth:1000", most=1), places, TINY)
    exact = found["errors"]["exact"]
    assert exact["false_positives"] == exact["hits"] > 0
    assert exact["false_negatives"] == found["checked"] - exact["hits"] == found["sample"]


def test_usd_scene_has_intervals(request):
    path = request.config.rootpath / "assets" / "cloth_twist.usd"
    intervals = load_intervals(str(path), most=3)
    assert [number for number, _ in intervals] == [2, 7, 11]
    for number, scene in intervals:
        expected = load_scene(str(path), interval=number)
        assert np.array_equal(scene.x0, expected.x0) and np.array_equal(scene.x1, expected.x1)
    assert len(load_intervals(str(path), most=100)) == 14


def test_worst_query_is_one_of_those_asked():
    intervals = load_intervals("crash:1000", most=1)
    queries, _ = bench_paper.gather_queries(intervals, wp.get_device("cpu"), 2000)
    with cores(1):
        worst = find_worst(queries[PairKind.EDGE_EDGE], wp.get_device("cpu"), repeat=1)
    assert list(worst) == list(METHODS)
    for query in worst.values():
        assert np.array_equal(query["points"], queries[PairKind.EDGE_EDGE].points([query["number"]])[0])


def test_scenes_come_with_a_checkout(capsys, monkeypatch, tmp_path):
    monkeypatch.setattr(
        "warp_bsc.bench.scenes.detector.__file__", str(tmp_path / "warp_bsc" / "bench" / "scenes" / "detector.py")
    )
    with pytest.raises(FileNotFoundError, match="come with a checkout"):
        paper_scenes()
    for arguments in ([], ["--quick"], ["funnel"]):
        assert "or name other scenes, such as cloth:20000" in fail(capsys, *arguments)


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (["gone.usd"], "gone.usd: no such file"),
        (["paper", "flood:5000"], "there is no generator flood"),
        (["cloth:1000", "--figure", "times.txt"], "--figure times.txt: its name must end in one of .png, .svg, .pdf"),
        (["cloth:1000", "--figure", "nowhere/times.png"], "there is no folder nowhere"),
        (["--json", "cloth:1000"], "name scenes before the options"),
        (["cloth:1000", "--device", "cuda:99"], "--device cuda:99"),
        (["cloth:1000", "--threads", "100000"], "threads must be in [1, "),
    ],
)
def test_wrong_use(capsys, monkeypatch, tmp_path, arguments, part):
    monkeypatch.chdir(tmp_path)
    assert part in fail(capsys, *arguments)
    assert not list(tmp_path.iterdir())


def test_figure_needs_matplotlib(capsys, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert "warp-bsc[bench]" in fail(capsys, "cloth:1000", "--figure", "times.png")
