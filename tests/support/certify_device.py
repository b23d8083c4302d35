"""Makes queries on a device, answers them there by every method, and holds the answers against the truth.

Queries are made in batches, answered by "float", by "conservative", by a user's kernel, and by exact arithmetic
whatever the others say, and compared on the device. The truth is known for small integers (lattice_truth.py) and for
minimum distances that are reached exactly (device_distances.py); elsewhere exact arithmetic stands for it. One in
10,000 queries goes to the host, where the checker decides it. It is a failure if two certain answers contradict each
other, or the truth; those of "float" are not certain. ``--count 1 --lattice 5::1000`` runs over a thousandth of
{-1, 0, 1}^24, and little else.

Of the tables, "unsure" are queries that "conservative" does not certify, "unknown" those that exact arithmetic on the
device leaves to the host. With minimum distances these are many, see :mod:`warp_bsc.kernels.exact.distance`.
"""

import argparse
import os
import time
import zlib
from collections import deque
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context

import numpy as np
import warp as wp
from certify_totals import Result, print_totals
from device_distances import choose_distances, make_reached_queries
from device_methods import answer_kernel, count_answers, distance_kernel, exact_distance_kernel, user_kernel
from device_queries import LATTICE, Generator, make_lattice_queries, make_queries
from exact_queries import exact_kernel
from lattice_truth import decide_lattice
from measured import write_measurement
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from warp_bsc import checker
from warp_bsc.cli.tables import Console
from warp_bsc.kernels.exact.distance import BITS as DISTANCE_BITS
from warp_bsc.kernels.exact.polygon import BITS
from warp_bsc.kernels.signs import FREE, HIT, ROUNDOFF, UNSURE

KINDS = ("vertex_face", "edge_edge", "vertex_edge", "vertex_vertex")
ONE_IN = 10_000
"""One in this many queries goes to the checker."""
SHOWN = 16
"""Failures of a batch that are printed; all are counted."""
COPIES = 256
"""Copies of the counts, so that threads seldom wait for one another."""
MAX_PENDING = 1000
"""Batches whose checks on the host may be behind."""
BLOCK = 64
"""Threads of a block on a GPU: few, as those of a block that work long keep the others' place."""
LATTICE_SHARE, DISTANCE_SHARE, WIDE_SHARE = 20.0, 0.1, 0.02
"""Queries of cheap jobs, of those with distances and of those in eight limbs, as a share of the count."""
WIDE = (Generator.MIXED_SCALES, Generator.SUBNORMAL_AND_HUGE)
ROWS = {"vertex_edge": [0, 1, 2, 4, 5, 6], "vertex_vertex": [0, 1, 4, 5]}
"""The points that the checker takes, of the eight of a query."""


@dataclass(frozen=True)
class Job:
    """Queries of one sort.

    Attributes:
        name: What they aim at.
        kind: Their kind, an index of KINDS.
        single: Whether coordinates are in single precision.
        count: How many there are.
        make: Writes queries to the buffers: (judge, number of the first one, how many).
        has_distance: Whether they have minimum distances.
    """

    name: str
    kind: int
    single: bool
    count: int
    make: Callable
    has_distance: bool = False


class Judge:
    """Buffers for a batch of queries on a device."""

    def __init__(self, device, size):
        """Allocates the buffers.

        Args:
            device: Warp device.
            size: Queries of a batch.
        """
        self.device, self.size = wp.get_device(device), size
        self.points = wp.empty((size, 8), dtype=wp.vec3d, device=device)
        self.distance, self.toi, self.time = (wp.empty(size, dtype=wp.float64, device=device) for _ in range(3))
        self.truth, self.bits, self.computed, self.certified, self.of_user = (
            wp.empty(size, dtype=int, device=device) for _ in range(5)
        )
        self.counts = wp.empty((COPIES, 27, 9), dtype=wp.int64, device=device)
        self.wrong = wp.empty(SHOWN, dtype=int, device=device)
        self.wrong_count = wp.empty(1, dtype=int, device=device)

    def launch(self, kernel, n, inputs, outputs):
        """Launches a kernel over the first n queries."""
        wp.launch(kernel, n, inputs=inputs, outputs=outputs, device=self.device, block_dim=BLOCK)

    def run(self, job, first, n):
        """Makes, answers and compares queries.

        Args:
            job: Their sort.
            first: Number of the first one.
            n: How many, at most the size of a batch.

        Returns:
            Result: What the device finds, without the checks of the host.
        """
        self.distance.zero_()
        self.truth.fill_(UNSURE)
        self.time.fill_(-1.0)
        job.make(self, first, n)
        if job.has_distance:
            self._answer_distances(job.kind, n)
        else:
            self._answer(job.kind, n)
        self.counts.zero_()
        self.wrong_count.zero_()
        answers = [self.computed, self.certified, self.of_user, self.time, self.truth]
        self.launch(count_answers, n, answers, [self.counts, self.wrong, self.wrong_count])
        failed = int(self.wrong_count.numpy()[0])
        counts = self.counts.numpy().sum(axis=0).reshape(3, 3, 3, 3, 3)
        failures = []
        for row in sorted(map(int, self.wrong.numpy()[:failed])):
            failures += describe(job, first + row, 1, *self.read(slice(row, row + 1)), [True])
        if failed > SHOWN:
            failures.append(f"{job.name} {KINDS[job.kind]}, queries {first} to {first + n - 1}: {failed - SHOWN} more")
        return Result(counts, failed=failed, failures=failures)

    def _answer(self, kind, n):
        for roundoff, answer in ((0.0, self.computed), (ROUNDOFF, self.certified)):
            self.launch(answer_kernel(), n, [kind, roundoff, self.points], [answer])
        self.launch(user_kernel(), n, [kind, self.points], [self.of_user])
        for limbs in BITS:
            self.launch(exact_kernel(limbs), n, [kind, self.points, False, 20], [self.time, self.bits])

    def _answer_distances(self, kind, n):
        methods = ((0.0, False, self.computed), (ROUNDOFF, True, self.of_user), (ROUNDOFF, False, self.certified))
        for roundoff, fused, answer in methods:
            inputs = [kind, roundoff, self.points, self.distance]
            self.launch(distance_kernel(fused), n, inputs, [answer, self.toi])
        for limbs in DISTANCE_BITS:
            inputs = [kind, self.points, self.distance, self.toi]
            self.launch(exact_distance_kernel(limbs), n, inputs, [self.time])

    def read(self, rows):
        """Returns points, distances and answers of some queries, NumPy arrays.

        Args:
            rows: Slice of the batch.

        Returns:
            Float64 [n, 8, 3] and [n]; int [n, 5]: truth, exact, conservative, user's kernel, float.
        """
        arrays = self.points, self.distance, self.time, self.truth, self.certified, self.of_user, self.computed
        # on the CPU, NumPy's arrays are the buffers themselves, which the next batch overwrites
        points, distance, at, truth, *others = (np.array(array[rows].numpy()) for array in arrays)
        exact = np.where(at < 0.0, UNSURE, np.where(at < 2.0, HIT, FREE))
        return points, distance, np.stack([truth, exact, *others], axis=1)


def describe(job, first, step, points, distance, answers, which):
    """Returns descriptions of some queries.

    Args:
        job: Their sort.
        first: Number of the first query.
        step: Difference of the numbers of two queries.
        points: Points of queries, shape [n, 8, 3].
        distance: Their minimum distances, shape [n].
        answers: Their answers, shape [n, 5].
        which: Which of them to describe, shape [n].
    """
    lines = []
    for k in np.flatnonzero(which):
        names = zip(("truth", "exact", "conservative", "user's kernel", "float"), answers[k], strict=True)
        said = ", ".join(f"{name} {('FREE', 'HIT', 'UNSURE')[answer]}" for name, answer in names)
        coordinates = "\n".join("    " + " ".join(float(c).hex() for c in point) for point in points[k])
        line = f"{job.name} {KINDS[job.kind]}, query {first + step * k}: {said}"
        lines.append(f"{line}; minimum distance {float(distance[k]).hex()}\n{coordinates}")
    return lines


def check_on_host(job, first, step, points, distance, answers):
    """Decides queries with the checker, and compares certain answers; arguments as of :func:`describe`."""
    kind = KINDS[job.kind]
    points_of_kind = points[:, ROWS.get(kind, slice(None))]
    if not job.has_distance:
        hit = getattr(checker, kind)(points_of_kind)
    else:
        hit = getattr(checker, kind)(points_of_kind, distance)
    certain = answers[:, :4]  # all but "float"
    wrong = ((certain != UNSURE) & (certain != np.where(hit, HIT, FREE)[:, None])).any(axis=1)
    failures = describe(job, first, step, points, distance, answers, wrong)
    failures = [
        f"the checker: {'HIT' if hit[k] else 'FREE'}; {line}"
        for k, line in zip(np.flatnonzero(wrong), failures, strict=True)
    ]
    return Result(checked=len(points), failed=len(failures), failures=failures)


# --- Jobs ---


@dataclass(frozen=True)
class _Generated:
    """Makes the queries of one generator."""

    generator: Generator
    kind: int
    single: bool
    seed: int

    def __call__(self, judge, first, n):
        inputs = [int(self.generator), self.kind, self.single, self.seed, first]
        judge.launch(make_queries, n, inputs, [judge.points])
        if self.generator == Generator.INTEGER_LATTICE:
            judge.launch(decide_lattice, n, [self.kind, judge.points], [judge.truth])


@dataclass(frozen=True)
class _OfLattice:
    """Makes queries of the lattice {-1, 0, 1}^24."""

    kind: int
    numbers: range

    def __call__(self, judge, first, n):
        judge.launch(make_lattice_queries, n, [self.numbers[first], self.numbers.step], [judge.points])
        judge.launch(decide_lattice, n, [self.kind, judge.points], [judge.truth])


@dataclass(frozen=True)
class _Reached:
    """Makes queries that come exactly as near as a known distance."""

    kind: int
    single: bool
    seed: int

    def __call__(self, judge, first, n):
        outputs = [judge.points, judge.distance, judge.truth]
        judge.launch(make_reached_queries, n, [self.kind, self.single, self.seed, first], outputs)


@dataclass(frozen=True)
class _AtDistances:
    """Makes queries of all generators but one, whose numbers are out of the range of distances, at any distances."""

    kind: int
    single: bool
    seed: int

    def __call__(self, judge, first, n):
        generators = [generator for generator in Generator if generator != Generator.SUBNORMAL_AND_HUGE]
        form = int(KINDS[self.kind] == "edge_edge")
        bounds = np.linspace(0, n, len(generators) + 1).astype(int).tolist()
        for generator, start, end in zip(generators, bounds[:-1], bounds[1:], strict=True):
            inputs = [int(generator), form, self.single, self.seed, first + start]
            if end > start:
                judge.launch(make_queries, end - start, inputs, [judge.points[start:end]])
        judge.launch(choose_distances, n, [self.kind, self.seed ^ 1, first], [judge.points, judge.distance])


def jobs_of(count, seed, lattice=None):
    """Returns all jobs.

    Args:
        count: Queries of most jobs.
        seed: Other ones make other queries.
        lattice: Numbers of the queries of {-1, 0, 1}^24, a range; default: some from all over it.
    """

    def seed_of(*names):
        return zlib.crc32(repr((seed, *names)).encode()) & 0x7FFFFFFF

    if lattice is None:
        stride = max(1, int(LATTICE // (LATTICE_SHARE * count)))
        stride -= stride % 3 == 0  # all digits change
        lattice = range(seed % stride, LATTICE, stride)
    jobs = []
    for generator in Generator:
        number = max(1, int(count * (WIDE_SHARE if generator in WIDE else 1.0)))
        for single in (True, False):
            for kind in (0, 1):
                make = _Generated(generator, kind, single, seed_of(generator.name, kind, single))
                jobs.append(Job(generator.name.lower(), kind, single, number, make))
    jobs += [Job("lattice", kind, True, len(lattice), _OfLattice(kind, lattice)) for kind in (0, 1)]
    number = max(1, int(count * DISTANCE_SHARE))
    for name, make in (("reached", _Reached), ("at_distances", _AtDistances)):
        for single in (True, False):
            for kind in range(len(KINDS)):
                queries = make(kind, single, seed_of(name, kind, single))
                jobs.append(Job(name, kind, single, number, queries, has_distance=True))
    return jobs


# --- Runs ---


class _HostChecks:
    """Checks of the host that run while the device goes on, and the results that they are added to."""

    def __init__(self, pool, console):
        self.pool, self.console, self.pending = pool, console, deque()

    def submit(self, result, *arguments):
        """Starts a check; waits where too many have not ended, so that memory suffices."""
        self.pending.append((result, self.pool.submit(check_on_host, *arguments)))
        while self.pending and (self.pending[0][1].done() or len(self.pending) > MAX_PENDING):
            self.collect()

    def collect(self):
        """Adds the results of the oldest check, and prints its failures."""
        result, check = self.pending.popleft()
        found = check.result()
        result.add(found)
        show(found, self.console)


def show(result, console):
    """Prints failures."""
    for failure in result.failures:
        console.print(failure, style="red", highlight=False, soft_wrap=True)


def _batches(jobs, size):
    """Yields each job, the number of the first query of a batch, and how many are in it."""
    for job in jobs:
        for first in range(0, job.count, size):
            yield job, first, min(size, job.count - first)


def certify_on_device(jobs, device, *, one_in=ONE_IN, size=None, pool=None, console=None):
    """Runs jobs, prints tables, the rate and all failures.

    Args:
        jobs: The jobs.
        device: Warp device.
        one_in: One in so many queries goes to the checker.
        size: Queries of a batch; default: by the device.
        pool: Executor in which the checker runs; default: as many processes as there are cores.
        console: Where to print; default: the standard output, 120 columns wide.

    Returns:
        Plain data for JSON: ``queries``, ``seconds``, ``checked``: queries that the checker has decided, ``failures``,
        where a query may fail on the device and on the host; ``methods``: by method its answers ``free``, ``hit`` and
        ``unsure``, and those that are wrong, ``missed`` (FREE, but colliding) and ``false`` (HIT, but free).
    """
    console = console or Console(width=120)
    judge = Judge(device, size or (2**22 if wp.get_device(device).is_cuda else 2**14))
    with console.status("compiling kernels"):
        for job in jobs:
            judge.run(job, 0, 1)
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[rate]}"), TimeRemainingColumn())
    results = {(job.name, job.single): Result() for job in jobs}
    pool = pool or ProcessPoolExecutor(os.cpu_count(), mp_context=get_context("spawn"))
    with pool, Progress(*columns, console=console) as progress:
        checks = _HostChecks(pool, console)
        task = progress.add_task("certifying", total=sum(job.count for job in jobs), rate="")
        began = time.perf_counter()
        for job, first, n in _batches(jobs, judge.size):
            result = results[job.name, job.single]
            found = judge.run(job, first, n)
            result.add(found)
            show(found, console)
            start = -first % one_in
            if start < n:
                sample = judge.read(slice(start, n, one_in))
                checks.submit(result, job, first + start, one_in, *sample)
            progress.advance(task, n)
            rate = progress.tasks[task].completed / (time.perf_counter() - began)
            progress.update(task, rate=f"{rate:,.0f} queries/s")
        seconds = time.perf_counter() - began
        task = progress.add_task("checking on the host", total=len(checks.pending), rate="")
        while checks.pending:
            checks.collect()
            progress.advance(task)
    return print_totals(results, seconds, console)


def lattice_range(text):
    """Returns the numbers of queries that FIRST:LAST or FIRST:LAST:STRIDE stands for."""
    try:
        numbers = range(LATTICE)[slice(*(int(part) if part else None for part in text.split(":")))]
    except (TypeError, ValueError):
        numbers = range(0)
    if not numbers or numbers.step < 1 or ":" not in text:
        raise argparse.ArgumentTypeError(f"not numbers FIRST:LAST or FIRST:LAST:STRIDE in 0:{LATTICE}: {text!r}")
    return numbers


OPTIONS = {
    "--device": {"help": "the Warp device"},
    "--lattice": {"type": lattice_range, "help": "numbers of {-1, 0, 1}^24, FIRST:LAST:STRIDE"},
    "--json": {"metavar": "FILE", "help": "file to which the totals are written as well"},
}


def run(arguments):
    """Certifies as the options say, and returns the number of failures."""
    jobs = jobs_of(arguments.count, arguments.seed, arguments.lattice)
    found = certify_on_device(jobs, arguments.device)
    if arguments.json:
        devices = [wp.get_device(arguments.device)]
        write_measurement(arguments.json, {"benchmark": "certify"} | found, devices)
    return found["failures"]
