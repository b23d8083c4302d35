"""Holds certified answers against exact arithmetic on queries that aim at trouble.

``python tests/certify.py --count 4000`` prints the share of queries that floating point could not certify, generator
by generator, and exits with status 1 if a certified answer or a time of impact is wrong.
"""

import argparse
import sys
from dataclasses import dataclass

import numpy as np
import warp as wp
from generators import GENERATORS
from rich import box
from rich.console import Console
from rich.progress import track
from rich.table import Table

import warp_bsc as bsc
from warp_bsc import checker

KINDS = ("vertex_face", "edge_edge")
TOLERANCE = 2.0**-20


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


def main():
    """Judges every generator and prints a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=1000, help="queries for each generator, kind and type")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
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
