"""The methods that benchmarks compare with: as right as such methods are, and never broken."""

import numpy as np
import pytest
from benchmark_data import load_queries
from generators import GENERATORS

from warp_bsc import checker
from warp_bsc.bench.measure import methods
from warp_bsc.bench.measure.methods import METHODS, PHASES, MethodRun, Queries, QuerySet, trace
from warp_bsc.detection.run.settings import PairKind
from warp_bsc.kernels.signs import FREE, HIT, UNSURE

KINDS = ("vertex_face", "edge_edge")


def answer(method, kind, points, device="cpu"):
    run = MethodRun(method, QuerySet(Queries.of_points(PairKind[kind.upper()], points), device))
    run.launch()
    return run


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", ["uniform", "mostly_hits"])
def test_all_methods_agree_where_nothing_is_degenerate(name, kind, dtype, device):
    points = GENERATORS[name](np.random.default_rng(1), 400, kind, dtype)
    truth = getattr(checker, kind)(points)
    assert truth.any()
    for method in METHODS:
        assert np.array_equal(answer(method, kind, points, device).find_hits(), truth), method


@pytest.mark.parametrize("kind", KINDS)
def test_degenerate_queries_are_answered(kind):
    """Exact answers are true, conservative ones miss nothing, and the baselines are mostly right."""
    names = ("coplanar", "resting_contact", "collapsing", "touching", "integer_lattice", "grazing")
    points = np.concatenate([GENERATORS[name](np.random.default_rng(2), 150, kind, np.float32) for name in names])
    truth = getattr(checker, kind)(points)
    wrong = {}
    for method in METHODS:
        run = answer(method, kind, points)
        assert set(np.unique(run.read_status())) <= {FREE, HIT, UNSURE}
        wrong[method] = (run.find_hits() != truth).mean()
        if method == "conservative":
            assert run.find_hits()[truth].all()
    assert wrong["exact"] == 0.0
    assert wrong["cubic"] < 0.2
    assert wrong["float"] < 0.2
    assert wrong["reduced"] < 0.3


@pytest.mark.parametrize("kind", KINDS)
def test_what_never_moves_is_answered(kind):
    """All points equal, here or far away, or side by side on a line: nothing is divided by zero, or for ever."""
    line = np.tile(np.arange(8.0)[:, None], 3) % 4
    cases = ((np.zeros((8, 3)), True), (np.full((8, 3), 1e30), True), (line, False), (1e-30 * line, False))
    for points, touches in cases:
        queries = np.stack([points] * 9)
        assert (getattr(checker, kind)(queries) == touches).all()
        for method in METHODS:
            assert (answer(method, kind, queries).find_hits() == touches).all(), method


@pytest.mark.slow
@pytest.mark.data
def test_hand_made_queries():
    """Wang et al. 2021: El Topo's solver has 242 false positives and 2 false negatives there."""
    positives, negatives = dict.fromkeys(METHODS, 0), dict.fromkeys(METHODS, 0)
    for _, kind, points, truth in load_queries():
        for method in METHODS:
            hits = answer(method, kind, points).find_hits()
            positives[method] += int((hits & ~truth).sum())
            negatives[method] += int((~hits & truth).sum())
    assert (positives["exact"], negatives["exact"], negatives["conservative"]) == (0, 0, 0)
    assert 40 < positives["cubic"] < 300
    assert negatives["cubic"] < 10
    assert positives["float"] + negatives["float"] < positives["cubic"] + negatives["cubic"]


@pytest.mark.parametrize("kind", KINDS)
def test_phases_are_those_that_decide(kind):
    rng = np.random.default_rng(3)
    names = ("uniform", "mostly_hits", "touching", "coplanar")
    points = np.concatenate([GENERATORS[name](rng, 100, kind, np.float32) for name in names])
    points[:50, [0, 1, 4, 5] if kind == "edge_edge" else [0, 4]] += 9.0
    queries = QuerySet(Queries.of_points(PairKind[kind.upper()], points), "cpu")
    phases, _ = trace(queries, "exact")
    assert set(phases) == set(range(len(PHASES)))
    assert (phases[:50] == PHASES.index("axis boxes")).all()
    run = MethodRun("conservative", queries)
    run.launch()
    assert np.array_equal(phases == PHASES.index("exact"), run.read_status() == UNSURE)


def test_clock_runs_for_every_query(device):
    points = GENERATORS["uniform"](np.random.default_rng(4), 100, "edge_edge", np.float32)
    queries = QuerySet(Queries.of_points(PairKind.EDGE_EDGE, points), device)
    for method in METHODS:
        _, cycles = trace(queries, method)
        assert cycles.shape == (100,) and (cycles > 0).all()


@pytest.mark.parametrize("method", ["float", "conservative", "exact"])
@pytest.mark.parametrize("kind", KINDS)
def test_the_detectors_own_methods_are_its_narrow_phase(monkeypatch, kind, method):
    """A benchmark that launched a copy of the narrow phase would not see what replaces it."""
    points = GENERATORS["mostly_hits"](np.random.default_rng(5), 100, kind, np.float32)
    run = MethodRun(method, QuerySet(Queries.of_points(PairKind[kind.upper()], points), "cpu"))
    launched = []
    monkeypatch.setattr(methods, "run_contacts", lambda *_, **options: launched.append(options))
    run.launch()
    (options,) = launched
    assert (options["method"], options["timed"]) == (method, False)
