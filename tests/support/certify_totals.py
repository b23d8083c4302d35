"""What becomes of queries that a device answers by every method: their numbers, and the tables of these."""

from dataclasses import dataclass, field

import numpy as np

from warp_bsc.bench.tables import Column
from warp_bsc.cli.tables import print_table
from warp_bsc.kernels.signs import FREE, HIT, UNSURE

METHODS = {"float": 4, "conservative": 2, "user's kernel": 3, "exact": 1}
"""The axis of each method in counts of answers."""


@dataclass
class Result:
    """What became of queries.

    Attributes:
        counts: Numbers of queries by answers FREE, HIT and UNSURE: axes truth, exact, conservative, user's kernel,
            float.
        checked: Queries that the checker has decided on the host.
        failed: Failures.
        failures: Descriptions of failures, of at most SHOWN a batch.
    """

    counts: np.ndarray = field(default_factory=lambda: np.zeros((3, 3, 3, 3, 3), dtype=np.int64))
    checked: int = 0
    failed: int = 0
    failures: list[str] = field(default_factory=list)

    def add(self, other):
        """Adds another result to this one."""
        self.counts += other.counts
        self.checked += other.checked
        self.failed += other.failed
        self.failures += other.failures

    def of_truth(self, truth):
        """Returns the counts, without their first axis, of queries known to be FREE or HIT."""
        counts = self.counts[truth].copy()
        counts[truth] += self.counts[UNSURE, truth]
        return counts


COLUMNS = (
    Column("Type", lambda row: "float" if row[0] else "double"),
    Column("Number", lambda row: int(row[1].counts.sum())),
    Column("Colliding", lambda row: row[1].of_truth(HIT).sum() / row[1].counts.sum(), ".1%"),
    Column("Unsure", lambda row: row[1].counts[:, :, UNSURE].sum() / row[1].counts.sum(), ".2%"),
    Column("Float missed", lambda row: int(row[1].of_truth(HIT)[..., FREE].sum())),
    Column("False", lambda row: int(row[1].of_truth(FREE)[..., HIT:].sum())),
    Column("Unknown", lambda row: int(row[1].counts[UNSURE, UNSURE].sum())),
    Column("Checked", "1.checked"),
    Column("Failures", "1.failed"),
)


def print_totals(results, seconds, console):
    """Prints what became of all queries, and returns it as :func:`certify_on_device` does."""
    everything = Result()
    for result in results.values():
        everything.add(result)
    rows = [(name, (single, result)) for (name, single), result in results.items()]
    print_table(console, "Queries", COLUMNS, rows)
    methods = {}
    for method, axis in METHODS.items():
        numbers = np.moveaxis(everything.counts, axis, 0).sum(axis=(1, 2, 3, 4))
        of_free, of_hit = (np.moveaxis(everything.of_truth(truth), axis - 1, 0) for truth in (FREE, HIT))
        answers = (*numbers, of_hit[FREE].sum(), of_free[HIT].sum())
        methods[method] = dict(zip(("free", "hit", "unsure", "missed", "false"), map(int, answers), strict=True))
    titles = {
        "FREE": "free",
        "HIT": "hit",
        "UNSURE": "unsure",
        "FREE, but colliding": "missed",
        "HIT, but free": "false",
    }
    print_table(console, "Method", [Column(title, key) for title, key in titles.items()], methods.items())
    number = int(everything.counts.sum())
    rate = f"{number:,} queries in {seconds:.1f} s, {number / seconds:,.0f} a second"
    console.print(f"{rate}; {everything.checked:,} checked on the host, {everything.failed:,} failures")
    totals = {"queries": number, "seconds": seconds, "checked": everything.checked, "failures": everything.failed}
    return totals | {"methods": methods}
