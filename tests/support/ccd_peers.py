"""Counts the collisions that detectors miss, and those that they report and that are none, on queries with their truth.

``python tests/support/ccd_peers.py`` decides the hand-made queries of Wang et al. 2021 in ``$WARP_BSC_DATA``, whose
truth comes with them, and queries of all generators of ``generators.py``, in double precision, whose truth is that of
``warp_bsc.checker``. Detectors are the methods of this project, the floating-point cubic solver of its benchmarks, and
those of the IPC Toolkit (``pip install ipctk``). A query of the IPC Toolkit that takes longer than ``--limit`` is not
decided. It prints a row for each set of queries and detector, and ``--json`` writes them to a file as well.
"""

import multiprocessing
import os
import signal
from collections import defaultdict

import numpy as np
import warp as wp
from benchmark_data import load_queries
from generators import GENERATORS
from measured import options_of, report

import warp_bsc as bsc
from warp_bsc import checker
from warp_bsc.bench.measure.methods import MethodRun, Queries, QuerySet
from warp_bsc.bench.tables import Column
from warp_bsc.detection.run.settings import METHODS, PairKind

KINDS = {"vertex_face": PairKind.VERTEX_FACE, "edge_edge": PairKind.EDGE_EDGE}
IPC_TOOLKIT = {
    "Tight Inclusion": ("TightInclusionCCD", {}),
    "Tight Inclusion, rescaling 1": ("TightInclusionCCD", {"conservative_rescaling": 1.0}),
    "additive": ("AdditiveCCD", {}),
}
"""Classes of the IPC Toolkit, with the arguments that are not their defaults."""
DETECTORS = (*METHODS, "cubic", *IPC_TOOLKIT)
FREE, HIT, LATE = 0, 1, 2
"""Answers."""


def adversarial_queries(count, seed):
    """Yields the generator, kind, points and truth of as many queries of each generator and kind."""
    for name, generator in GENERATORS.items():
        for number, kind in enumerate(KINDS):
            points = generator(np.random.default_rng([seed, number]), count, kind, np.float64)
            yield name, kind, points, np.asarray(getattr(checker, kind)(points), dtype=bool)


def decide_within(ccd, points, limit):
    """Returns the answers of a function to queries, LATE for those that take more than so much processor time [s].

    Another process asks it, which a timer of the system ends in a query that is late, as nothing else ends a call; then
    a new one goes on with the next query.
    """
    fork = multiprocessing.get_context("fork")
    answers = fork.Array("b", [LATE] * len(points), lock=False)
    asked = fork.Value("i", 0, lock=False)

    def ask(first):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        for stream in (1, 2):  # warnings of the library
            os.dup2(nowhere, stream)
        for i in range(first, len(points)):
            asked.value = i + 1
            signal.setitimer(signal.ITIMER_VIRTUAL, limit)
            answers[i] = int(ccd(*points[i])[0])
        signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)

    while True:
        process = fork.Process(target=ask, args=(asked.value,))
        process.start()
        process.join()
        if process.exitcode == 0:
            return np.array(answers)
        if process.exitcode != -signal.SIGVTALRM:
            raise RuntimeError(f"query {asked.value - 1}: exit code {process.exitcode}")


def decide(detector, kind, points, limit):
    """Returns the answers of a detector to queries."""
    if detector in IPC_TOOLKIT:
        import ipctk  # noqa: PLC0415 (optional)

        name, options = IPC_TOOLKIT[detector]
        ccd = getattr(ipctk, name)(**options)
        ask = ccd.point_triangle_ccd if kind == "vertex_face" else ccd.edge_edge_ccd
        return decide_within(ask, points, limit)
    if detector in METHODS:
        return np.where(getattr(bsc, f"query_{kind}")(points, method=detector, toi=False, device="cpu").hit, HIT, FREE)
    run = MethodRun(detector, QuerySet(Queries.of_points(KINDS[kind], points), wp.get_device("cpu")))
    run.launch()
    return np.where(run.find_hits(), HIT, FREE)


def count_wrong(queries, limit):
    """Yields a row for each set of queries and detector; ``queries`` are set, kind, points and truth."""
    sets = defaultdict(list)
    for name, *rest in queries:
        sets[name].append(rest)
    for name, parts in sets.items():
        truth = np.concatenate([part[2] for part in parts])
        for detector in DETECTORS:
            answers = np.concatenate([decide(detector, kind, points, limit) for kind, points, _ in parts])
            yield {
                "queries": name,
                "detector": detector,
                "colliding": int(truth.sum()),
                "free": int((~truth).sum()),
                "missed": int((truth & (answers == FREE)).sum()),
                "false": int((~truth & (answers == HIT)).sum()),
                "late": int((answers == LATE).sum()),
            }


COLUMNS = [
    Column("Detector", "detector"),
    Column("Collide", "colliding"),
    Column("Free", "free"),
    Column("Missed", "missed"),
    Column("False", "false"),
    Column("Late", "late"),
]


def main():
    """Decides all queries."""
    parser = options_of(__doc__)
    parser.add_argument("--count", type=int, default=100, help="queries of a generator and kind (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--limit", type=float, default=0.5, help="processor time of a query [s] (default: %(default)s)")
    arguments = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    hand_made = [("hand-made", *rest) for _, *rest in load_queries()]
    adversarial = adversarial_queries(arguments.count, arguments.seed)
    rows = list(count_wrong([*hand_made, *adversarial], arguments.limit))
    report(arguments, "ccd_peers", "Queries", COLUMNS, rows, (), name="queries", limit=arguments.limit)


if __name__ == "__main__":
    main()
