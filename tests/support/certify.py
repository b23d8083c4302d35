"""Holds certified answers against exact arithmetic on queries that aim at trouble.

``python tests/support/certify.py --count 4000`` prints the share of queries that floating point could not certify,
generator by generator, and exits with status 1 if a certified answer or a time of impact is wrong.

``python tests/support/certify.py --method user --count 400`` calls ``impact_*`` from a user's kernel, in a module with
the default options, with tolerances in their range and out of it.

``python tests/support/certify.py --method exact --count 4000`` asks exact arithmetic in every width about every query,
also what floating point could decide, and leaves out the generators whose queries it nearly always can.

``python tests/support/certify.py --device cuda:0 --count 100000000`` makes, answers and compares ten billion queries on
a GPU, see certify_device.py; with ``--lattice 5::1000`` these numbers of {-1, 0, 1}^24 among them. ``--json FILE``
writes the totals as well.
"""

import argparse
import sys
from dataclasses import dataclass

import numpy as np
import warp as wp
from certify_device import certify_on_device, jobs_of
from device_queries import LATTICE
from exact_queries import decide_exactly
from generators import GENERATORS
from impacts import impact_kernel
from rich import box
from rich.console import Console
from rich.progress import track
from rich.table import Table

import warp_bsc as bsc
from warp_bsc import checker
from warp_bsc.bench.record import write_measurement
from warp_bsc.kernels.exact.polygon import BITS

KINDS = ("vertex_face", "edge_edge")
TOLERANCE = 2.0**-20
EASY = ("uniform", "mostly_hits")
COSTLY = "subnormal_and_huge"  # for the checker, in double precision
TOLERANCES = (0.0, np.nan, -1.0, 1e-300, 2.0**-38, 2.0**-20, 0.5, 1.0, 2.0, np.inf)


@dataclass
class Verdict:
    """How the answers to one set of queries compare with the truth: numbers of queries."""

    queries: int
    colliding: int
    unsure: int
    wrong: int  # certified FREE but colliding, or certified HIT but free
    missed: int  # not a hit of "conservative" but colliding
    exact_wrong: int
    late: int  # time of impact after the true one
    early: int  # certified HIT with a time more than the tolerance before the true one
    float_wrong: int


def judge(kind, points):
    """Compares all methods with the truth.

    Args:
        kind: "vertex_face" or "edge_edge".
        points: Queries, shape [n, 8, 3].

    Returns:
        Verdict: The comparison.
    """
    query = getattr(bsc, f"query_{kind}")
    interval = getattr(checker, f"{kind}_toi")(points)
    truth = ~np.isnan(interval[:, 0])
    conservative = query(points, method="conservative")
    exact = query(points, method="exact")
    computed = query(points, method="float", toi=False)
    assert np.array_equal(conservative.status, query(points, method="conservative", toi=False).status)
    assert np.array_equal(conservative.status, computed.status)
    certified = conservative.status == 1
    after = np.zeros(len(points), dtype=bool)
    before = np.zeros(len(points), dtype=bool)
    for answer in (conservative, exact):
        # the time of a hit that is none is a lower bound of nothing
        after |= truth & (answer.toi > interval[:, 1])
        before |= (
            truth & (certified if answer is conservative else answer.hit) & (answer.toi < interval[:, 0] - TOLERANCE)
        )
    return Verdict(
        queries=len(points),
        colliding=int(truth.sum()),
        unsure=int((conservative.status == 2).sum()),
        wrong=int(((conservative.status == 0) & truth).sum() + (certified & ~truth).sum()),
        missed=int((~conservative.hit & truth).sum()),
        exact_wrong=int((exact.hit != truth).sum()),
        late=int(after.sum()),
        early=int(before.sum()),
        float_wrong=int((computed.hit != truth).sum()),
    )


@dataclass
class ExactVerdict:
    """How exact answers to one set of queries compare with the truth: numbers of queries."""

    queries: int
    colliding: int
    unsure: int
    narrow: int  # decided in one or two limbs
    wide: int  # decided in four or eight limbs
    host: int  # too wide for eight limbs
    wrong: int  # an answer in any of the widths, or the method's, is not the truth


def judge_exact(kind, points):
    """Compares the answers of exact arithmetic in every width with the truth.

    Args:
        kind: "vertex_face" or "edge_edge".
        points: Queries, shape [n, 8, 3].

    Returns:
        ExactVerdict: The comparison.
    """
    truth = getattr(checker, kind)(points)
    answer = getattr(bsc, f"query_{kind}")(points, method="exact", toi=False)
    wrong = answer.hit != truth
    decided = {}
    for limbs in BITS:
        time, _ = decide_exactly(kind, points, limbs)
        decided[limbs] = time >= 0.0
        wrong |= decided[limbs] & ((time < 2.0) != truth)
    one, two, four, eight = decided.values()
    assert not ((one & ~two) | (two & ~four) | (four & ~eight)).any()
    return ExactVerdict(
        queries=len(points),
        colliding=int(truth.sum()),
        unsure=int((answer.status == 2).sum()),
        narrow=int(two.sum()),
        wide=int((eight & ~two).sum()),
        host=int((~eight).sum()),
        wrong=int(wrong.sum()),
    )


def certify_exact(count, seed):
    """Judges the exact answers of the generators that aim at trouble, prints a table and counts the wrong ones."""
    table = Table("Generator", box=box.SIMPLE_HEAD, padding=0, show_edge=False)
    for column in ("Type", "Queries", "Colliding", "Unsure", "Two limbs", "More", "Host", "Wrong"):
        table.add_column(column, justify="right", no_wrap=True)
    console = Console()
    jobs = [(name, dtype) for name in GENERATORS if name not in EASY for dtype in (np.float32, np.float64)]
    sums = np.zeros(len(ExactVerdict.__dataclass_fields__), dtype=int)
    for name, dtype in track(jobs, console=console, description="certifying"):
        number = max(1, count // 50) if name == COSTLY else count
        rng = np.random.default_rng([seed, *name.encode()])
        verdicts = [judge_exact(kind, GENERATORS[name](rng, number, kind, dtype)) for kind in KINDS]
        found = sum(np.array(list(vars(verdict).values())) for verdict in verdicts)
        sums += found
        queries, colliding, unsure, *others = found
        shares = (f"{colliding / queries:.1%}", f"{unsure / queries:.1%}")
        table.add_row(name, dtype.__name__, f"{queries}", *shares, *map(str, others))
    console.print(table)
    console.print(f"{sums[0]} queries, {sums[2] / sums[0]:.1%} unsure, {sums[5]} for the host, {sums[-1]} wrong")
    return sums[-1]


def judge_user(kind, points, tolerance, interval):
    """Compares what a user's kernel finds with the truth.

    Args:
        kind: "vertex_face" or "edge_edge".
        points: Queries, shape [n, 8, 3].
        tolerance: Any number.
        interval: The doubles around each first contact, NaN where there is none, shape [n, 2].

    Returns:
        Numbers of queries: unsure, wrong, late, early, and with coordinates or a normal that are none.
    """
    n = len(points)
    point = wp.vec3 if points.dtype == np.float32 else wp.vec3d
    inputs = [kind == "edge_edge", tolerance, wp.array(points, dtype=point)]
    outputs = [wp.zeros(n, dtype=t) for t in (int, int, int, wp.float64, wp.vec3d, wp.vec3d)]
    wp.launch(impact_kernel(point), n, inputs=inputs, outputs=outputs)
    status, within_tolerance, _, toi, coordinates, normal = (output.numpy() for output in outputs)
    truth = ~np.isnan(interval[:, 0])
    used = tolerance if tolerance > 2.0**-38 else 2.0**-38
    found = status != 0
    inside = (coordinates > -1e-14).all(axis=1) & (coordinates < 1.0 + 1e-14).all(axis=1)
    if kind == "vertex_face":
        inside &= np.abs(coordinates.sum(axis=1) - 1.0) < 1e-14
    else:
        inside &= coordinates[:, 2] == 0.0
    inside &= np.abs(np.linalg.norm(normal, axis=1) - 1.0) < 1e-14
    inside &= (toi >= 0.0) & (toi <= 1.0)
    return np.array(
        [
            (status == 2).sum(),
            ((status == 0) & truth).sum() + ((status == 1) & ~truth).sum() + ((status == 0) & (toi != 2.0)).sum(),
            (truth & (toi > interval[:, 1])).sum(),
            (truth & (within_tolerance == 1) & (toi < interval[:, 0] - used)).sum(),
            (found & ~inside).sum(),
        ]
    )


def certify_user(count, seed):
    """Judges a user's kernel at every tolerance, prints a table and counts what is wrong."""
    table = Table("Tolerance", box=box.SIMPLE_HEAD, padding=0, show_edge=False)
    for column in ("Queries", "Unsure", "Wrong", "Late", "Early", "No contact"):
        table.add_column(column, justify="right", no_wrap=True)
    console = Console()
    jobs = [(name, dtype) for name in GENERATORS for dtype in (np.float32, np.float64)]
    sums = np.zeros((len(TOLERANCES), 5), dtype=int)
    total = 0
    for name, dtype in track(jobs, console=console, description="certifying"):
        number = max(1, count // 50) if name == COSTLY else count
        for kind in KINDS:
            points = GENERATORS[name](np.random.default_rng([seed, *name.encode()]), number, kind, dtype)
            interval = getattr(checker, f"{kind}_toi")(points)
            total += number
            sums += [judge_user(kind, points, tolerance, interval) for tolerance in TOLERANCES]
    for tolerance, (unsure, *others) in zip(TOLERANCES, sums, strict=True):
        table.add_row(f"{tolerance:.3g}", f"{total}", f"{unsure / total:.2%}", *map(str, others))
    console.print(table)
    failures = sums[:, 1:].sum()
    console.print(f"{total * len(TOLERANCES)} queries, {failures} failures")
    return failures


def lattice_range(text):
    """Returns the numbers of queries that FIRST:LAST or FIRST:LAST:STRIDE stands for."""
    try:
        numbers = range(LATTICE)[slice(*(int(part) if part else None for part in text.split(":")))]
    except (TypeError, ValueError):
        numbers = range(0)
    if not numbers or numbers.step < 1 or ":" not in text:
        raise argparse.ArgumentTypeError(f"not numbers FIRST:LAST or FIRST:LAST:STRIDE in 0:{LATTICE}: {text!r}")
    return numbers


def main():
    """Judges every generator and prints a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=1000, help="queries for each generator, kind and type")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--method", choices=["all", "exact", "user"], default="all")
    parser.add_argument("--device", help="make and check queries by every method on this Warp device")
    parser.add_argument(
        "--lattice", type=lattice_range, help="on the device: numbers of {-1, 0, 1}^24, FIRST:LAST:STRIDE"
    )
    parser.add_argument("--json", metavar="FILE", help="on the device: file to which the totals are written as well")
    arguments = parser.parse_args()
    if arguments.count < 1:
        parser.error(f"--count must be at least 1, not {arguments.count}")
    if arguments.lattice and not arguments.device:
        parser.error("--lattice needs --device")
    if arguments.json and not arguments.device:
        parser.error("--json needs --device")
    if arguments.device and arguments.method != "all":
        parser.error("--device runs every method: omit --method")
    wp.config.log_level = wp.LOG_WARNING
    if arguments.device:
        jobs = jobs_of(arguments.count, arguments.seed, arguments.lattice)
        found = certify_on_device(jobs, arguments.device)
        if arguments.json:
            found = {"benchmark": "certify"} | found
            write_measurement(arguments.json, found, sys.argv, [wp.get_device(arguments.device)])
        return 1 if found["failures"] else 0
    if arguments.method != "all":
        certify = certify_exact if arguments.method == "exact" else certify_user
        return 1 if certify(arguments.count, arguments.seed) else 0
    table = Table("Generator", box=box.SIMPLE_HEAD, padding=0, show_edge=False)
    for column in ("Type", "Queries", "Colliding", "Unsure", "Wrong", "Late", "Early", "Float wrong"):
        table.add_column(column, justify="right", no_wrap=True)
    total = 0
    failures = 0
    console = Console()
    jobs = [(name, dtype) for name in GENERATORS for dtype in (np.float32, np.float64)]
    for name, dtype in track(jobs, console=console, description="certifying"):
        verdicts = []
        for kind in KINDS:
            rng = np.random.default_rng([arguments.seed, *name.encode()])
            verdicts.append(judge(kind, GENERATORS[name](rng, arguments.count, kind, dtype)))
        queries, colliding, unsure, wrong, missed, exact, late, early, computed = (
            sum(getattr(verdict, field) for verdict in verdicts) for field in Verdict.__dataclass_fields__
        )
        total += queries
        failures += wrong + missed + exact + late + early
        table.add_row(
            name,
            dtype.__name__,
            f"{queries}",
            f"{colliding / queries:.1%}",
            f"{unsure / queries:.2%}",
            f"{wrong + missed + exact}",
            f"{late}",
            f"{early}",
            f"{computed / queries:.2%}",
        )
    console.print(table)
    console.print(f"{total} queries, {failures} failures")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
