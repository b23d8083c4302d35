"""Benchmark of the detector: what is measured is what the detector finds."""

import json
import os

import pytest
from bench_commands import fail

from warp_bsc import CollisionDetector, CollisionMesh
from warp_bsc.bench.measure.detector import benchmark_detector
from warp_bsc.bench.scenes.detector import load_scene
from warp_bsc.bench.timing import limited_threads
from warp_bsc.cli.main import main
from warp_bsc.detection.run.launch import count_cores


def measure(capsys, *arguments):
    status = main(["bench", "detector", *map(str, arguments), "--device", "cpu", "--repeat", "2"])
    output = capsys.readouterr()
    assert status == 0, output.err
    return output.out


@pytest.mark.parametrize("method", ["float", "conservative", "exact"])
def test_measures_what_the_detector_finds(capsys, method):
    found = json.loads(measure(capsys, "cloth:2000", "--json", "--method", method))
    (measured,) = found["scenes"]
    scene = load_scene("cloth:2000")
    mesh = CollisionMesh(scene.faces, len(scene.x0), device="cpu")
    collisions = CollisionDetector(mesh, method=method).detect(scene.x0, scene.x1)
    for kind in ("vertex_face", "edge_edge"):
        assert measured[kind] == vars(getattr(collisions.stats, kind))
    assert measured["candidates"] == sum(measured[kind]["candidates"] for kind in ("vertex_face", "edge_edge"))
    assert measured["hits"] == len(collisions.vertex_face) + len(collisions.edge_edge)
    assert measured["earliest_toi"] == collisions.earliest_toi
    assert measured["certified"] == (method != "float")
    assert (measured["triangles"], measured["vertices"]) == (len(scene.faces), len(scene.x0))
    assert measured["precision"] == 32
    assert (found["method"], found["device"], found["repeat"]) == (method, "cpu", 2)


def test_worlds_find_each_what_one_finds(capsys):
    (one,), (three,) = (
        json.loads(measure(capsys, "cloth:1000", "--json", *more))["scenes"] for more in ([], ["--worlds", 3])
    )
    assert three["scene"] == f"{one['scene']} in 3 worlds"
    assert one["hits"] > 0
    for count in ("triangles", "vertices", "candidates", "hits"):
        assert three[count] == 3 * one[count]


def test_times_are_consistent(capsys):
    (measured,) = json.loads(measure(capsys, "cloth:2000", "--json"))["scenes"]
    took = measured["milliseconds"]
    assert 0 < took["detect"] <= took["detect_and_read"]
    assert took["cuda_graph"] is None
    assert list(took["stages"]) == ["broad phase", "cull", "classify", "time of impact", "sort", "exact"]
    assert measured["candidates_per_second"] == pytest.approx(1e3 * measured["candidates"] / took["detect"])


def test_on_the_default_device(device):
    """With a GPU, also the CUDA graph, which must find the same."""
    measured = benchmark_detector(load_scene("cloth:2000"), repeat=1)
    assert (measured["milliseconds"]["cuda_graph"] is None) == device.is_cpu
    assert measured["hits"] > 0


def test_tables_fit_a_terminal(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    pytest.importorskip("ipctk")
    lines = measure(capsys, "cloth:2000", "crash:2000", "--compare").splitlines()
    assert max(map(len, lines)) <= 80
    assert sum(line.startswith("cloth:2000") for line in lines) == 4
    assert sum(line.startswith("crash:2000") for line in lines) == 4
    assert lines[0].startswith("Method conservative on cpu, ")


@pytest.mark.parametrize("name", ["cloth:2000", "crash:2000"])
def test_agrees_with_the_ipc_toolkit(name):
    pytest.importorskip("ipctk")
    measured = benchmark_detector(load_scene(name), device="cpu", repeat=1, compare=True)
    other = measured["ipc_toolkit"]
    for kind in ("vertex_face", "edge_edge"):  # its candidates are boxes that meet, ours what culls leave of them
        assert 0 < measured[kind]["candidates"] < other[f"{kind}_candidates"]
    assert other["step_size"] == pytest.approx(measured["earliest_toi"], abs=0.05)


def test_comparison_needs_the_ipc_toolkit(capsys, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert "warp-bsc[bench]" in fail(capsys, "detector", "cloth:1000", "--compare")


def test_usd_scene(capsys, request):
    path = request.config.rootpath / "assets" / "cloth_twist.usd"
    found = json.loads(measure(capsys, path, "--interval", 4, "--method", "exact", "--json"))
    assert found["scenes"][0]["hits"] == 7
    assert "no interval 14, they go from 0 to 13" in fail(capsys, "detector", path, "--interval", 14)


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (["juggler"], "juggler"),
        (["detector", "gone.usd"], "gone.usd: no such file"),
        (["detector", "flood:5000"], "flood:5000: there is no generator flood, only cloth, crash"),
        (["detector", "cloth:many"], "'many'"),
        (["detector", "cloth:3"], "[1000, 20000000], not '3'"),
        (["detector", "cloth:1000", "--worlds", "0"], "--worlds: must be an integer of at least 1"),
        (["detector", "cloth:1000", "--worlds", "2000000000"], "2000000000 worlds have too many vertices"),
        (["detector", "cloth:1000", "--worlds", "2", "--compare"], "the IPC Toolkit has no worlds"),
        (["detector", "cloth:1000", "--repeat", "0"], "--repeat: must be an integer of at least 1"),
        (["detector", "cloth:1000", "--threads", "100000"], "threads must be in [1, "),
        (["detector", "cloth:1000", "--device", "cuda:99"], "--device cuda:99"),
    ],
)
def test_wrong_use(capsys, arguments, part):
    assert part in fail(capsys, *arguments)


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="the system cannot limit threads")
def test_threads(capsys):
    before = os.sched_getaffinity(0)
    with limited_threads(1):
        assert count_cores() == 1
    assert os.sched_getaffinity(0) == before
    assert json.loads(measure(capsys, "cloth:1000", "--threads", 1, "--json"))["threads"] == 1
    assert os.sched_getaffinity(0) == before
