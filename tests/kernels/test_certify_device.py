"""Certification on a device: the truth is true, queries are what they aim at, and what is wrong is found."""

import argparse
import io
import itertools
import json
import re
import sys
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import certify
import certify_device
import certify_totals
import device_methods
import exact_queries
import numpy as np
import pytest
import warp as wp
from certify_device import KINDS, ROWS, Judge, certify_on_device, jobs_of
from certify_totals import METHODS, Result
from device_queries import LATTICE, Generator, make_lattice_queries
from lattice_truth import LARGEST, decide_lattice
from rich.console import Console
from sample_sizes import cases

from warp_bsc import checker
from warp_bsc.kernels import ccd, classification
from warp_bsc.kernels.exact import first_contact
from warp_bsc.kernels.exact.algebraic import count_cubic_roots
from warp_bsc.kernels.not_inlined import NOT_INLINED
from warp_bsc.kernels.polynomials import Coplanarity, Motion
from warp_bsc.kernels.polynomials import coplanarity as right_coplanarity
from warp_bsc.kernels.signs import FREE, HIT, UNSURE


def run(jobs, device, one_in=10_000):
    """Returns the number of failures, and what is printed."""
    console = Console(file=io.StringIO(), width=120)
    found = certify_on_device(jobs, device, one_in=one_in, size=1024, pool=ThreadPoolExecutor(1), console=console)
    return found["failures"], console.file.getvalue()


# --- Truth on lattices ---


def lattices(rng, n):
    """Queries of small integers: any, at the limit, with few moving points, with equal points, in lines and planes."""
    anything = rng.integers(-LARGEST, LARGEST + 1, (n, 8, 3))
    ternary = rng.integers(-1, 2, (n, 8, 3))
    extreme = LARGEST * rng.choice([-1, 1], (n, 8, 3))
    resting = anything.copy()
    resting[:, 4:] = np.where(rng.random((n, 4, 1)) < 0.7, resting[:, :4], ternary[:, 4:])
    repeated = ternary[np.arange(n)[:, None], rng.integers(0, 4, (n, 8))]
    flat = anything * (rng.random((n, 1, 3)) < 0.6)
    turning = ternary.copy()
    # four points in one plane at all times, differences still at most 4
    turning[:, 3::4] = turning[:, 1::4] + turning[:, 2::4] - turning[:, 0::4]
    line = rng.integers(-1, 2, (n, 8, 1)) * rng.integers(-1, 2, (n, 1, 3))  # all points on one line at all times
    parts = [anything, ternary, extreme, resting, repeated, flat, turning, line]
    return np.concatenate(parts).astype(np.float64)


@pytest.mark.parametrize("kind", [0, 1])
def test_the_truth_on_lattices_is_that_of_the_checker(kind, device):
    points = lattices(np.random.default_rng(kind), 500)
    truth = wp.empty(len(points), dtype=int, device=device)
    inputs = [kind, wp.array(points, dtype=wp.vec3d, device=device)]
    wp.launch(decide_lattice, len(points), inputs=inputs, outputs=[truth], device=device)
    expected = getattr(checker, KINDS[kind])(points)
    assert 0.3 < expected.mean() < 0.7
    assert np.array_equal(truth.numpy(), np.where(expected, HIT, FREE))


def test_the_lattice_counts_in_base_three(device):
    points = wp.empty((4, 8), dtype=wp.vec3d, device=device)
    first, stride = 12_345_678_901, 90_000_000_001
    wp.launch(make_lattice_queries, 4, inputs=[first, stride], outputs=[points], device=device)
    for k, query in enumerate(points.numpy().reshape(4, 24)):
        assert sum(int(digit + 1) * 3**place for place, digit in enumerate(query)) == first + k * stride
    assert first + 3 * stride < LATTICE


# --- Queries ---


@pytest.fixture(scope="module")
def all_jobs():
    return jobs_of(1000, 3)


def test_nothing_contradicts_the_truth(all_jobs, device):
    failures, printed = run(all_jobs, device, one_in=50 * 100 // cases(100))
    assert failures == 0, printed
    assert "0 failures" in printed
    wrong = dict(re.findall(r"^(float|conservative|user's kernel|exact) .* ([\d,]+ +[\d,]+) *$", printed, re.MULTILINE))
    assert [method for method, numbers in wrong.items() if numbers.split() == ["0", "0"]] == list(METHODS)[1:]
    assert len(wrong) == len(METHODS)
    for name in ("lattice", "reached", "at_distances", *(generator.name.lower() for generator in Generator)):
        assert name in printed


EXACT_IN_SINGLE = ("coplanar", "integer_lattice", "resting_contact", "collapsing", "touching", "lattice")


def test_queries_aim_at_trouble(all_jobs, device):
    judge = Judge(device, 400)
    for job in all_jobs:
        result = judge.run(job, 0, judge.size)
        colliding = result.of_truth(HIT).sum() / judge.size
        points, distance, _ = judge.read(slice(0, judge.size))
        assert np.isfinite(points).all()
        assert len(np.unique(points.reshape(len(points), -1), axis=0)) > 0.98 * len(points)
        with np.errstate(over="ignore"):
            is_single = np.array_equal(points, points.astype(np.float32))
        assert is_single == (job.single or job.name in EXACT_IN_SINGLE)
        assert (distance > 0.0).mean() > 0.9 if job.has_distance else not distance.any()
        assert colliding > 0.05
        assert colliding < 0.95 or job.name in ("mostly_hits", "touching", "sliding")
        if not job.has_distance and job.name not in ("uniform", "mostly_hits"):
            nearly_double = job.name == "near_double_roots" and job.single
            assert result.counts[:, :, UNSURE].any() or nearly_double  # floats are too few to be so near


@pytest.mark.parametrize("single", [True, False])
def test_one_coordinate_is_moved_to_the_next_number(all_jobs, single, device):
    judge = Judge(device, 300)
    dtype = np.float32 if single else np.float64
    for job in (job for job in all_jobs if job.name == "one_ulp_apart" and job.single == single):
        judge.run(job, 0, judge.size)
        x = judge.read(slice(0, judge.size))[0].reshape(judge.size, 24).astype(dtype)
        moved = 32 * x != np.round(32 * x)  # the others are multiples of 1/32
        assert (moved.sum(axis=1) == 1).all()
        back = [np.nextafter(x[moved], dtype(limit)) for limit in (-np.inf, np.inf)]
        were = np.stack([32 * y == np.round(32 * y) for y in back])
        assert were.any(axis=0).all()
        assert 0.3 < were[0].mean() < 0.7


def test_distances_are_reached_exactly(all_jobs, device):
    judge = Judge(device, 200)
    for job in (job for job in all_jobs if job.name == "reached"):
        judge.run(job, 0, judge.size)
        points, distance, answers = judge.read(slice(0, judge.size))
        kind = KINDS[job.kind]
        hit = getattr(checker, kind)(points[:, ROWS.get(kind, slice(None))], distance)
        assert 0.4 < hit.mean() < 0.8
        assert np.array_equal(answers[:, 0], np.where(hit, HIT, FREE))


def test_other_seeds_and_numbers_make_other_queries(device):
    judge = Judge(device, 50)
    read = []
    for seed, first in ((1, 0), (1, 50), (1, 2**32), (2, 0), (1, 0)):
        job = next(job for job in jobs_of(100, seed) if job.name == "grazing")
        judge.run(job, first, 50)
        read.append(judge.read(slice(0, 50))[0])
    assert np.array_equal(read[0], read[-1])
    for first, second in itertools.combinations(read[:-1], 2):
        assert not np.array_equal(first, second)


# --- Mutations ---


@wp.func
def wrong_coplanarity(motion: Motion) -> Coplanarity:
    y = right_coplanarity(motion)
    y.k = wp.vec4d(y.k[0], y.k[1], y.k[2], -y.k[3])
    return y


@wp.func
def wrong_verdict(signs: wp.vec4i) -> int:
    low = wp.min(wp.min(signs[0], signs[1]), wp.min(signs[2], signs[3]))
    high = wp.max(wp.max(signs[0], signs[1]), wp.max(signs[2], signs[3]))
    if low < 0 and high >= 0:  # as if zero were a sign
        return FREE
    return wp.where(low == high and low != 0, HIT, UNSURE)


@pytest.mark.parametrize(
    ("kernel", "module", "name", "mutant", "method"),
    [
        ("answer_kernel", ccd, "coplanarity", wrong_coplanarity, "conservative"),
        ("user_kernel", classification, "verdict", wrong_verdict, "user's kernel"),
    ],
)
def test_a_wrong_sign_in_a_kernel_is_found(kernel, module, name, mutant, method, monkeypatch, device):
    monkeypatch.setattr(module, name, mutant)
    monkeypatch.setattr(certify_device, kernel, getattr(device_methods, kernel).__wrapped__)
    jobs = [job for job in jobs_of(200, 0) if job.name == "integer_lattice"]
    failures, printed = run(jobs, device)
    assert failures > 10
    assert f"{method} FREE" in printed
    assert printed.count("; minimum distance") + sum(map(int, re.findall(r": (\d+) more", printed))) == failures


@wp.func(**NOT_INLINED)
def without_pairs_of_roots(c0: Any, c1: Any, c2: Any, c3: Any) -> int:
    roots = count_cubic_roots(c0, c1, c2, c3)
    return wp.where(roots == 2, 0, roots)


def test_a_mistake_in_exact_arithmetic_is_found(monkeypatch, device):
    monkeypatch.setattr(first_contact, "count_cubic_roots", without_pairs_of_roots)
    monkeypatch.setattr(certify_device, "exact_kernel", exact_queries.exact_kernel.__wrapped__)
    monkeypatch.setattr(certify_device, "BITS", (1,))
    monkeypatch.setattr(first_contact, "decide_in", first_contact.decide_in.__wrapped__)
    failures, printed = run([job for job in jobs_of(500, 0) if job.name in ("integer_lattice", "grazing")], device)
    assert failures > 10
    assert "truth HIT, exact FREE" in printed


@pytest.mark.parametrize(
    ("name", "count", "least"), [("near_degenerate", 500, 10), ("lattice", 500, 10), ("reached", 10_000, 2)]
)
def test_signs_without_bounds_are_found(name, count, least, monkeypatch, device):
    monkeypatch.setattr(certify_device, "ROUNDOFF", 0.0)
    jobs = [job for job in jobs_of(count, 0, range(0, LATTICE, 10**8)) if job.name == name]
    failures, _ = run(jobs, device)
    assert failures >= least


def test_the_host_holds_against_the_checker(monkeypatch, device):
    decide = checker.vertex_face
    monkeypatch.setattr(checker, "vertex_face", lambda points: ~decide(points))
    jobs = [job for job in jobs_of(100, 0) if job.name == "integer_lattice"]
    failures, printed = run(jobs, device, one_in=10)
    assert failures == 20  # of vertex and face in single and double precision
    assert "the checker: HIT; integer_lattice vertex_face, query 50: truth FREE, exact FREE" in printed


def test_totals_count_what_float_misses_and_what_it_reports_in_vain():
    result = Result(checked=1)
    result.counts[UNSURE, HIT, UNSURE, HIT, FREE] = 5  # exact arithmetic stands for the truth
    result.counts[FREE, FREE, FREE, UNSURE, HIT] = 2
    found = certify_totals.print_totals({("grazing", True): result}, 0.5, Console(file=io.StringIO()))
    names = ("free", "hit", "unsure", "missed", "false")
    expected = {"float": (5, 2, 0, 5, 2), "conservative": (2, 0, 5, 0, 0), "user's kernel": (0, 5, 2, 0, 0)}
    expected["exact"] = (2, 5, 0, 0, 0)
    assert found["methods"] == {method: dict(zip(names, numbers, strict=True)) for method, numbers in expected.items()}
    assert (found["queries"], found["seconds"], found["checked"], found["failures"]) == (7, 0.5, 1, 0)


def test_the_command_prints_failures_in_full_and_writes_totals(monkeypatch, capsys, tmp_path, device):
    path = tmp_path / "certify.json"
    monkeypatch.setattr(certify_device, "ProcessPoolExecutor", lambda *_, **__: ThreadPoolExecutor(1))
    options = ["--device", str(device), "--count", "50", "--lattice", "0:100:7", "--json", str(path)]
    monkeypatch.setattr(sys, "argv", ["certify.py", *options])
    assert certify.main() == 0
    printed, found = capsys.readouterr().out, json.loads(path.read_text())
    assert "0 failures" in printed and f"{found['queries']:,} queries in " in printed
    assert found["failures"] == 0 and found["record"]["command"].endswith("--lattice 0:100:7")
    for name, answers in found["methods"].items():
        numbers = " +".join(f"{number:,}" for number in answers.values())
        assert re.search(rf"^{name} +{numbers}", printed, re.MULTILINE)
        assert answers["free"] + answers["hit"] + answers["unsure"] == found["queries"]
        assert name == "float" or answers["missed"] == answers["false"] == 0
    assert found["methods"]["float"]["missed"] > 0
    monkeypatch.setattr(certify_device, "ROUNDOFF", 0.0)
    assert certify.main() == 1
    lines = capsys.readouterr().out.splitlines()
    at = next(k for k, line in enumerate(lines) if "grazing edge_edge" in line)
    points = np.array([[float.fromhex(word) for word in line.split()] for line in lines[at + 1 : at + 9]])
    (hit,) = checker.edge_edge(points[None])
    said = "HIT" if hit else "FREE"
    assert f"exact {said}, conservative {'FREE' if hit else 'HIT'}" in lines[at]


@pytest.mark.parametrize(
    ("text", "numbers"), [("5:9", range(5, 9)), (":", range(LATTICE)), ("9::7", range(9, LATTICE, 7))]
)
def test_numbers_of_the_lattice(text, numbers):
    assert certify_device.lattice_range(text) == numbers


@pytest.mark.parametrize("text", ["5", "9:5", "a:b", "1:2:3:4", "1:9:0", "9:1:-1", ""])
def test_numbers_that_are_none(text):
    with pytest.raises(argparse.ArgumentTypeError, match="FIRST:LAST"):
        certify_device.lattice_range(text)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--count", "0"], "--count must be at least 1"),
        (["--lattice", "0:9"], "--lattice needs --device"),
        (["--json", "totals.json"], "--json needs --device"),
        (["--device", "cpu", "--method", "user"], "omit --method"),
        (["--device", "cpu", "--lattice", "9"], "not numbers FIRST:LAST"),
    ],
)
def test_wrong_use(arguments, message, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["certify.py", *arguments])
    with pytest.raises(SystemExit, match="2"):
        certify.main()
    assert message in capsys.readouterr().err
