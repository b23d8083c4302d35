"""Benchmark of elementary queries: the answers that are timed are true, the queries what they are said to be."""

import json

import numpy as np
import pytest
from generators import GENERATORS

import warp_bsc as bsc
from warp_bsc import checker
from warp_bsc.bench.measure import methods
from warp_bsc.bench.measure import queries as bench_queries
from warp_bsc.bench.measure.queries import MODES, benchmark_queries
from warp_bsc.bench.scenes.queries import generate_queries, generate_touching_queries
from warp_bsc.cli.main import main
from warp_bsc.detection.run.settings import SURFACE_KINDS, PairKind


def measure(capsys, device, *arguments):
    status = main(["bench", "queries", "--device", str(device), "--repeat", "2", *arguments])
    output = capsys.readouterr()
    assert status == 0, output.err
    return output.out


@pytest.mark.slow
@pytest.mark.parametrize("kind", SURFACE_KINDS, ids=lambda kind: kind.label)
def test_answers_are_true(kind, device):
    _, status = benchmark_queries(kind, count=1000, device=device, repeat=1)
    truth = getattr(checker, kind.label)(generate_queries(kind, 1000, device=device).numpy())
    certain = status != 2
    assert certain.sum() > 990
    assert np.array_equal(status[certain] == 1, truth[certain])
    assert 20 < truth.sum() < 200


@pytest.mark.parametrize("kind", SURFACE_KINDS, ids=lambda kind: kind.label)
def test_culls_leave_a_third(kind, device):
    measured, status = benchmark_queries(kind, device=device, repeat=1)
    assert len(status) == measured["queries"] == (2**24 if device.is_cuda else 2**18)
    assert measured["survivor_share"] == pytest.approx(1 / 3, abs=0.01)
    assert measured["certified"]["hit"] + measured["certified"]["unsure"] < measured["survivors"]


@pytest.mark.parametrize("kind", SURFACE_KINDS, ids=lambda kind: kind.label)
def test_queries_depend_on_neither_device_nor_count(kind, device):
    many, few = generate_queries(kind, 1000, device=device).numpy(), generate_queries(kind, 10, device="cpu").numpy()
    assert np.array_equal(many[:10], few)
    assert len(np.unique(many.reshape(1000, -1), axis=0)) == 1000


@pytest.mark.parametrize("kind", SURFACE_KINDS, ids=lambda kind: kind.label)
def test_touching_queries_are_for_exact_arithmetic_to_decide(kind, device):
    query = getattr(bsc, f"query_{kind.label}")
    points = generate_touching_queries(kind, 2000, device=device).numpy()
    answer = query(points, toi=False, device=device)
    assert answer.hit.all()
    assert (answer.status == 2).mean() > 0.95


def test_a_wrong_exact_answer_is_noticed(monkeypatch, device):
    monkeypatch.setattr(bench_queries, "generate_touching_queries", generate_queries)
    with pytest.raises(RuntimeError, match="of 1000 touching vertex-face queries were found to be free"):
        benchmark_queries(PairKind.VERTEX_FACE, count=1000, device=device, repeat=1)


@pytest.mark.parametrize(("mode", "kernels"), [("impact", slice(1, 2)), ("queued", slice(2, 4))])
def test_other_answers_are_noticed(monkeypatch, device, mode, kernels):
    right, wrong = (list(bench_queries._kernels(kind)) for kind in SURFACE_KINDS)
    right[kernels] = wrong[kernels]
    monkeypatch.setattr(bench_queries, "_kernels", lambda kind: right)
    with pytest.raises(RuntimeError, match=f"decided differently by mode {mode}"):
        benchmark_queries(PairKind.VERTEX_FACE, count=1000, device=device, repeat=1)


def test_json_is_consistent(capsys, device):
    found = json.loads(measure(capsys, device, "--count", "1000", "--json"))
    assert (found["benchmark"], found["device"], found["repeat"]) == ("queries", str(device), 2)
    assert [measured["kind"] for measured in found["kinds"]] == ["vertex-face", "edge-edge"]
    for kind, measured in zip(SURFACE_KINDS, found["kinds"], strict=True):
        _, status = benchmark_queries(kind, count=1000, device=device, repeat=1)
        assert measured["certified"] == dict(
            zip(("free", "hit", "unsure"), np.bincount(status, minlength=3), strict=True)
        )
        assert sum(measured["certified"].values()) == measured["queries"] == 1000
        assert measured["survivor_share"] == measured["survivors"] / 1000
        assert list(measured["modes"]) == list(MODES)
        for mode in measured["modes"].values():
            rate = 1000 / (1e-3 * mode["milliseconds"])
            assert mode["queries_per_second"] == pytest.approx(rate)
            assert mode["bytes_per_second"] == pytest.approx(rate * mode["bytes_per_query"])
            assert mode["share_of_copy"] == pytest.approx(mode["bytes_per_second"] / found["copy_bytes_per_second"])


def test_tables_fit_a_terminal(capsys, monkeypatch, device):
    monkeypatch.setenv("COLUMNS", "80")
    lines = measure(capsys, device, "--count", "100000").splitlines()
    assert max(map(len, lines)) <= 80
    for kind in ("vertex-face", "edge-edge"):
        assert sum(line.startswith(f"{kind} ") for line in lines) == 1
        for mode in MODES:
            assert sum(line.startswith(f"{kind}, {mode} ") for line in lines) == 1


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (["--count", "0"], "--count: must be an integer of at least 1"),
        (["--count", "many"], "not many"),
        (["--count", "1000000000"], "--count must be in [1, 67108864], not 1000000000"),
        (["--repeat", "0"], "--repeat: must be an integer of at least 1"),
        (["--threads", "100000"], "threads must be in [1, "),
        (["--device", "cuda:99"], "--device cuda:99"),
        (["no-such-file.csv"], "no-such-file.csv: no such file"),
        (["no-such-file.csv", "--count", "10"], "--count is for random queries"),
    ],
)
def test_wrong_use(capsys, arguments, part):
    assert main(["bench", "queries", *arguments]) == 2
    output = capsys.readouterr()
    assert output.out == ""
    (line,) = output.err.splitlines()
    assert line.startswith("warp-bsc: error: ")
    assert part in line


def write_queries(folder, kind, points):
    """Writes a file of queries with integer coordinates."""
    folder = folder / kind
    folder.mkdir(parents=True)
    rows = [",".join(f"{int(x)},1" for x in row) for row in points.reshape(-1, 3)]
    (folder / "data.csv").write_text("\n".join(rows) + "\n")


def test_methods_are_measured_on_files(capsys, monkeypatch, tmp_path, device):
    rng = np.random.default_rng(1)
    points = {kind: GENERATORS["integer_lattice"](rng, 50, kind.label, np.float64) for kind in SURFACE_KINDS}
    for kind in SURFACE_KINDS:
        write_queries(tmp_path / "lattice", kind.display_name, points[kind])
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setattr(methods, "_SMALLEST_LAUNCH", {False: 2**10, True: 2**10})  # the times may be inexact
    lines = measure(capsys, device, str(tmp_path / "lattice")).splitlines()
    assert max(map(len, lines)) <= 80
    assert sum("lattice," in line for line in lines) == len(SURFACE_KINDS)
    for kind in SURFACE_KINDS:  # in a line of its own beside long times
        assert sum(kind.display_name in line for line in lines) == 1
    measured = json.loads(measure(capsys, device, str(tmp_path / "lattice"), "--json"))["queries"]
    by_kind = {row["kind"]: row for row in measured}
    for kind in SURFACE_KINDS:
        row = by_kind[kind.display_name]
        truth = getattr(checker, kind.label)(points[kind])
        assert (row["name"], row["queries"], row["hits"]) == ("lattice", 50, truth.sum())
        assert set(row["nanoseconds"]) == {"float", "conservative", "exact", "cubic"}
        assert all(took > 0.0 for took in row["nanoseconds"].values())
