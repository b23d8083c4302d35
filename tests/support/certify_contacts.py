"""Holds certified answers of queries for contacts against exact arithmetic.

By default the tables have the share of queries that floating point could not certify, generator by generator.
``--method user`` calls ``impact_*`` from a user's kernel, in a module with the default options, with tolerances in
their range and out of it. ``--method exact`` asks exact arithmetic in every width about every query, also what floating
point could decide, and leaves out the generators whose queries it nearly always can.
"""

import itertools
from typing import NamedTuple

import numpy as np
import warp as wp
from exact_queries import decide_exactly
from generators import GENERATORS
from impacts import impact_kernel
from measured import print_rows
from rich.progress import track

import warp_bsc as bsc
from warp_bsc import checker
from warp_bsc.bench.tables import Column
from warp_bsc.kernels.exact.polygon import BITS

KINDS = ("vertex_face", "edge_edge")
TOLERANCE = 2.0**-20
EASY = ("uniform", "mostly_hits")
COSTLY = "subnormal_and_huge"  # for the checker, in double precision
TOLERANCES = (0.0, np.nan, -1.0, 1e-300, 2.0**-38, 2.0**-20, 0.5, 1.0, 2.0, np.inf)


class Verdict(NamedTuple):
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


class ExactVerdict(NamedTuple):
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


def _judge_each(names, judged, count, seed):
    """Yields the name of each generator, a type, and the verdicts of both kinds on queries of it together, as an array.

    Args:
        names: The generators.
        judged: Returns the verdict of queries, given their kind and points.
        count: Number of queries of each kind; a fiftieth of those that are costly for the checker, where it says so.
        seed: Seed of the queries.
    """
    jobs = list(itertools.product(names, (np.float32, np.float64)))
    for name, dtype in track(jobs, description="certifying"):
        number = max(1, count // 50) if name == COSTLY and judged is not judge else count
        rngs = [np.random.default_rng([seed, *name.encode()]) for _ in KINDS]
        if judged is judge_exact:
            rngs = rngs[:1] * 2  # edges begin where vertices end, as in the measurements of the page
        found = 0
        for kind, rng in zip(KINDS, rngs, strict=True):
            found = found + np.array(judged(kind, GENERATORS[name](rng, number, kind, dtype)))
        yield name, dtype.__name__, found


def _share(values):
    return f"{values[1] / values[0]:.1%}"


def _columns(*headers, unsure=".2%"):
    """Returns columns of a type and numbers: queries, colliding, unsure, and others by their headers and values."""
    shares = Column("Unsure", lambda row: row[1][2] / row[1][0], unsure)
    first = Column("Type", "0"), Column("Queries", "1.0", "d"), Column("Colliding", "1", _share), shares
    return (*first, *(Column(header, value, "d") for header, value in headers))


def certify_exact(count, seed):
    """Judges the exact answers of the generators that aim at trouble, prints a table and counts the wrong ones."""
    names = [name for name in GENERATORS if name not in EASY]
    rows = [(name, (dtype, found)) for name, dtype, found in _judge_each(names, judge_exact, count, seed)]
    numbers = [(header, f"1.{i}") for i, header in enumerate(("Two limbs", "More", "Host", "Wrong"), 3)]
    print_rows("Generator", _columns(*numbers, unsure=".1%"), rows)
    sums = sum(found for _, (_, found) in rows)
    print(f"{sums[0]} queries, {sums[2] / sums[0]:.1%} unsure, {sums[5]} for the host, {sums[-1]} wrong")
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

    def judged(kind, points):
        interval = getattr(checker, f"{kind}_toi")(points)
        return [(len(points), *judge_user(kind, points, tolerance, interval)) for tolerance in TOLERANCES]

    sums = sum(found for _, _, found in _judge_each(GENERATORS, judged, count, seed))
    columns = [Column("Queries", "0", "d"), Column("Unsure", lambda row: row[1] / row[0], ".2%")]
    columns += [Column(header, f"{i}", "d") for i, header in enumerate(("Wrong", "Late", "Early", "No contact"), 2)]
    print_rows(
        "Tolerance", columns, [(f"{tolerance:.3g}", row) for tolerance, row in zip(TOLERANCES, sums, strict=True)]
    )
    failures = sums[:, 2:].sum()
    print(f"{sums[:, 0].sum()} queries, {failures} failures")
    return failures


def certify_all(count, seed):
    """Judges every generator by all methods, prints a table and counts what is wrong."""
    rows = [(name, (dtype, found)) for name, dtype, found in _judge_each(GENERATORS, judge, count, seed)]
    wrong = "Wrong", lambda row: row[1][3:6].sum()
    columns = _columns(wrong, ("Late", "1.6"), ("Early", "1.7"))
    columns = *columns, Column("Float wrong", lambda row: row[1][8] / row[1][0], ".2%")
    print_rows("Generator", columns, rows)
    sums = sum(found for _, (_, found) in rows)
    failures = sums[3:8].sum()
    print(f"{sums[0]} queries, {failures} failures")
    return failures


METHODS = {"all": certify_all, "exact": certify_exact, "user": certify_user}
OPTIONS = {"--method": {"choices": METHODS, "default": "all"}}


def run(arguments):
    """Certifies as the options say, and returns the number of failures."""
    return METHODS[arguments.method](arguments.count, arguments.seed)
