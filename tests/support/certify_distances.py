"""Holds certified answers to queries with a minimum distance against exact arithmetic.

``python tests/support/certify_distances.py --count 200000`` prints the share of queries that floating point could not
certify, and exits with status 1 if a certified answer or a time is wrong. ``ulp`` and ``2^-40``: parallel planes keep
features apart by a distance that is reached exactly, and the minimum distance is that one or a neighbour of it in
floating point, or more or less by 2^-40 of it, scaled from 1e-300 to 1e300. ``trouble``: adversarial queries of the
other certificates, at distances that they come to, and at any others.

``python tests/support/certify_distances.py --public`` answers the queries of the public benchmark with 1e-3 of the size
of each query's box, beside the minimum separation of Tight-Inclusion in the IPC Toolkit.
"""

import argparse
import sys
import time

import benchmark_data
import distances
import numpy as np
import warp as wp
from rich import box
from rich.console import Console
from rich.progress import track
from rich.table import Table

import warp_bsc as bsc
from warp_bsc import checker
from warp_bsc.detection.narrow.narrow_phase import NarrowPhase
from warp_bsc.detection.narrow.rings import Rings
from warp_bsc.detection.narrow.rules.distance import run_distances
from warp_bsc.detection.run.launch import cores
from warp_bsc.detection.run.settings import Count, DistanceKind, PairCounts
from warp_bsc.detection.run.stage_timer import StageTimer

TOLERANCE = 2.0**-20
ITERATIONS = 20000  # of Tight-Inclusion: with its own limit of 10^7, a few of the queries take minutes each
SHARES = {"vertex_face": 3, "edge_edge": 3, "vertex_edge": 2, "vertex_vertex": 1}


def judge(kind, points, distance, truth=None):
    """Compares the answers with the truth.

    Args:
        kind: One of ``distances.KINDS``.
        points: Queries.
        distance: Minimum distances, shape [n].
        truth: Which collide, where known. Without it the checker says so, and the times of an eighth are compared.

    Returns:
        Numbers of queries: colliding, unsure, wrong, late, early, and false positives of "conservative".
    """
    query = getattr(bsc, f"query_{kind}")
    timed = slice(0, len(points) // 8 if truth is None else 0)
    truth = getattr(checker, kind)(points, distance) if truth is None else truth
    interval = getattr(checker, f"{kind}_toi")(points[timed], distance[timed])
    answer = query(points, min_distance=distance, method="conservative", toi=False)
    wrong = (truth & (answer.status == 0)) | (~truth & (answer.status == 1)) | (truth & ~answer.hit)
    found = query(points[timed], min_distance=distance[timed], method="conservative")
    wrong[timed] |= (found.status != answer.status[timed]) | (truth[timed] != ~np.isnan(interval[:, 0]))
    late = truth[timed] & (found.toi > interval[:, 1])
    early = truth[timed] & (found.status == 1) & (found.toi < interval[:, 0] - TOLERANCE)
    columns = truth, answer.status == 2, wrong, late, early, answer.hit & ~truth
    return np.array([column.sum() for column in columns])


def certify(count, seed):
    """Judges both sets of queries of every kind, prints a table and counts failures."""
    table = Table("Kind", box=box.SIMPLE_HEAD, padding=0, show_edge=False)
    for column in ("Aim", "Type", "Queries", "Colliding", "Unsure", "Wrong", "Late", "Early"):
        table.add_column(column, justify="right", no_wrap=True)
    console = Console()
    total = failures = unsure = 0
    jobs = [(kind, aim) for kind in distances.KINDS for aim in ("ulp", "2^-40", "float32", "float64")]
    for kind, aim in track(jobs, console=console, description="certifying"):
        rng = np.random.default_rng([seed, *kind.encode(), *aim.encode()])
        n = SHARES[kind] * count // sum(SHARES.values())
        truth = None
        known = aim in ("ulp", "2^-40")
        if known:
            points, distance = distances.reached(rng, n, kind)
            points, distance = points[: n // 4], distance[: n // 4]
            distance, truth = distances.nudged(rng, distance, aim)
            points, distance = distances.scaled(rng, points, distance)
        else:
            points, distance = distances.adversarial(rng, n // 4, kind, getattr(np, aim))
        colliding, left, wrong, late, early, _ = judge(kind, points, distance, truth)
        n = len(points)
        cells = aim if known else "trouble", points.dtype.name, f"{n}", f"{colliding / n:.1%}"
        table.add_row(kind, *cells, f"{left / n:.2%}", f"{wrong}", f"{late}", f"{early}")
        total, failures, unsure = total + n, failures + wrong + late + early, unsure + left
    console.print(table)
    console.print(f"{total} queries, {unsure / total:.2%} unsure, {failures} failures")
    return failures


def answer_by_tight_inclusion(kind, points, distance):
    """Returns which queries collide by Tight-Inclusion, and the nanoseconds of a query, calls from Python included."""
    import ipctk  # noqa: PLC0415 (optional)

    ipctk.set_logger_level(ipctk.LoggerLevel.off)
    ccd = ipctk.TightInclusionCCD(max_iterations=ITERATIONS)
    ask = ccd.point_triangle_ccd if kind == "vertex_face" else ccd.edge_edge_ccd
    queries = [(*query, d) for query, d in zip(points, distance, strict=True)]
    start = time.perf_counter()
    hit = [ask(*query)[0] for query in queries]
    return np.array(hit, dtype=bool), 1e9 * (time.perf_counter() - start) / len(queries)


def compare(repeat=5):
    """Answers the public queries, prints a table beside Tight-Inclusion, and counts what conservative answers miss."""
    table = Table(box=box.SIMPLE_HEAD, padding=0, show_edge=False)
    table.add_column("Queries", no_wrap=True)
    for column in ("Number", "Colliding", "Program", "False positives", "Missed", "Unsure", "ns a query"):
        table.add_column(column, justify="right", no_wrap=True)
    missed = 0
    for name, load in (("hand-made", "load_queries"), ("cloth-funnel", "load_cloth_funnel_queries")):
        files = getattr(benchmark_data, load)()
        for kind in ("vertex_face", "edge_edge"):
            points = np.concatenate([points for _, of_file, points, _ in files if of_file == kind])
            distance = 1e-3 * np.ptp(points, axis=1).max(axis=1)
            truth = getattr(checker, kind)(points, distance)
            n, colliding = len(points), truth.sum()
            query = getattr(bsc, f"query_{kind}")
            many = max(1, 20000 // n)
            tiled, distances_of_tiled = np.tile(points, (many, 1, 1)), np.tile(distance, many)
            for toi in (False, True):
                answer = query(points, min_distance=distance, method="conservative", toi=toi)
                nanoseconds = time_queries(kind, tiled, distances_of_tiled, toi, repeat)
                program = "conservative, times" if toi else "conservative"
                false, lost = (answer.hit & ~truth).sum(), (truth & ~answer.hit).sum()
                unsure = f"{(answer.status == 2).sum()}"
                cells = f"{n}", f"{colliding}", program, f"{false}", f"{lost}", unsure, f"{nanoseconds:.0f}"
                table.add_row(f"{name} {kind}", *cells)
                missed += lost
            hit, nanoseconds = answer_by_tight_inclusion(kind, points, distance)
            false, lost = (hit & ~truth).sum(), (truth & ~hit).sum()
            cells = f"{n}", f"{colliding}", "Tight-Inclusion", f"{false}", f"{lost}", "", f"{nanoseconds:.0f}"
            table.add_row(f"{name} {kind}", *cells)
    Console(width=120).print(table)
    return missed


def time_queries(kind, points, distance, timed, repeat):
    """Returns the nanoseconds of a query on one core, the least of several runs, from points on the device."""
    rows = np.arange(len(points), dtype=np.int32)
    firsts = 2 if kind == "edge_edge" else 1
    radius = np.zeros((len(points), 4))
    radius[:, :firsts] = distance[:, None]
    vertices = np.arange(4 * len(points), dtype=np.int32).reshape(-1, 4)
    elements = vertices.reshape(-1, 2) if kind == "edge_edge" else np.ascontiguousarray(vertices[:, 1:])
    pairs = np.stack([2 * rows, 2 * rows + 1] if kind == "edge_edge" else [4 * rows, rows], axis=1)
    counts = wp.zeros(len(Count), dtype=wp.int64)
    phase = NarrowPhase(DistanceKind[kind.upper()], counts, len(rows), pairs[-1] + 1)
    phase.queue.assign(pairs)
    x0, x1 = (wp.array(x.reshape(-1, 3), dtype=wp.vec3d) for x in (points[:, :4], points[:, 4:]))
    inputs = x0, x1, wp.array(radius.ravel(), dtype=wp.float64), Rings()
    elements = wp.array(elements, dtype=int)
    times = []
    options = {"method": "conservative", "timed": timed, "timer": StageTimer(None)}
    with cores(1):
        while len(times) < repeat:
            counts.assign(PairCounts(queued=len(rows)).values())
            start = time.perf_counter()
            run_distances([(phase, elements)], *inputs, **options)
            wp.synchronize()
            times.append(time.perf_counter() - start)
            if phase.grow():
                times.clear()
    return 1e9 * min(times) / len(rows)


def main():
    """Certifies, or compares."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=10000, help="queries in all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--public", action="store_true", help="the public queries, beside Tight-Inclusion")
    arguments = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    return 1 if (compare() if arguments.public else certify(arguments.count, arguments.seed)) else 0


if __name__ == "__main__":
    sys.exit(main())
