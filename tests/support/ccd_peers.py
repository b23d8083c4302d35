"""Counts the collisions that detectors miss, and those that they report and that are none, on queries with their truth.

``python tests/support/ccd_peers.py`` decides the hand-made queries of Wang et al. 2021 in ``$WARP_BSC_DATA``, whose
truth comes with them, and queries of all generators of ``generators.py``, in double precision, whose truth is that of
``warp_bsc.checker``. Detectors are the methods of this project, the floating-point cubic solver of its benchmarks, and
those of the IPC Toolkit (``pip install ipctk``) with their default settings, which are to miss nothing and may report
what comes near. It prints a row for each, and with ``--by-generator`` one for each generator as well.
"""

import argparse
import time
from collections import defaultdict

import numpy as np
import warp as wp
from benchmark_data import load_queries
from generators import GENERATORS
from rich.console import Console
from rich.table import Table

import warp_bsc as bsc
from warp_bsc import checker
from warp_bsc.bench.measure.methods import MethodRun, Queries, QuerySet
from warp_bsc.bench.peers import ipc_toolkit
from warp_bsc.detection.run.settings import METHODS, PairKind

KINDS = {"vertex_face": PairKind.VERTEX_FACE, "edge_edge": PairKind.EDGE_EDGE}


def adversarial_queries(count, seed):
    """Yields the generator, kind, points and truth of as many queries of each generator and kind."""
    for name, generator in GENERATORS.items():
        for number, kind in enumerate(KINDS):
            points = generator(np.random.default_rng([seed, number]), count, kind, np.float64)
            yield name, kind, points, np.asarray(getattr(checker, kind)(points), dtype=bool)


def decide(method, kind, points):
    """Returns whether each query collides by a method, bool, and the seconds that it took."""
    started = time.perf_counter()
    if method in ipc_toolkit.CCD_CLASSES:
        return ipc_toolkit.decide_queries(method, KINDS[kind], points), time.perf_counter() - started
    if method in METHODS:
        found = getattr(bsc, f"query_{kind}")(points, method=method, toi=False, device="cpu")
        return np.asarray(found.hit), time.perf_counter() - started
    run = MethodRun(method, QuerySet(Queries.of_points(KINDS[kind], points), wp.get_device("cpu")))
    run.launch()
    return run.find_hits(), time.perf_counter() - started


def main():
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--count", type=int, default=200, help="queries of a generator and kind (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--by-generator", action="store_true", help="print a row for each generator as well")
    arguments = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    methods = [*METHODS, "cubic", *(ipc_toolkit.CCD_CLASSES if ipc_toolkit.is_installed() else ())]
    sets = {
        "hand-made": [("hand-made", *rest) for _, *rest in load_queries()],
        "adversarial": list(adversarial_queries(arguments.count, arguments.seed)),
    }
    table = Table("queries", "collide", "do not", *(f"{m}: missed, false" for m in methods))
    for name, queries in sets.items():
        rows = defaultdict(lambda: np.zeros((1 + len(methods), 2), dtype=int))
        for part, kind, points, truth in queries:
            found = [[truth.sum(), (~truth).sum()]]
            for method in methods:
                hits, seconds = decide(method, kind, points)
                found.append([(truth & ~hits).sum(), (~truth & hits).sum()])
                if seconds > 60.0:
                    print(f"{part}, {kind}: {method} took {seconds:.0f} s", flush=True)
            for label in {name, part} if arguments.by_generator else {name}:
                rows[label] += np.array(found)
        for label, ((colliding, free), *counts) in rows.items():
            table.add_row(label, f"{colliding:,}", f"{free:,}", *(f"{missed:,}, {false:,}" for missed, false in counts))
    Console(width=160).print(table)


if __name__ == "__main__":
    main()
