"""Holds certified answers to queries with a minimum distance against exact arithmetic.

The table has the share of queries that floating point could not certify. ``ulp`` and ``2^-40``: parallel planes keep
features apart by a distance that is reached exactly, and the minimum distance is that one or a neighbour of it in
floating point, or more or less by 2^-40 of it, scaled from 1e-300 to 1e300. ``trouble``: adversarial queries of the
other certificates, at distances that they come to, and at any others.

``--public`` answers the queries of the public benchmark with 1e-3 of the size of each query's box, beside the minimum
separation of Tight-Inclusion in the IPC Toolkit.
"""

import time

import benchmark_data
import distances
import numpy as np
import warp as wp
from measured import print_rows
from rich.progress import track

import warp_bsc as bsc
from warp_bsc import checker
from warp_bsc.bench.tables import Column
from warp_bsc.detection.narrow.narrow_phase import NarrowPhase
from warp_bsc.detection.narrow.rings import Rings
from warp_bsc.detection.narrow.rules.distance import run_distances
from warp_bsc.detection.run.launch import cores
from warp_bsc.detection.run.phase_timer import PhaseTimer
from warp_bsc.detection.run.settings import Count, PairCounts, PairKind

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
    rows = []
    jobs = [(kind, aim) for kind in distances.KINDS for aim in ("ulp", "2^-40", "float32", "float64")]
    for kind, aim in track(jobs, description="certifying"):
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
        numbers = (len(points), *judge(kind, points, distance, truth))
        rows.append((kind, (aim if known else "trouble", points.dtype.name, numbers)))
    shares = (("Colliding", 1, ".1%"), ("Unsure", 2, ".2%"))
    columns = [Column("Aim", "0"), Column("Type", "1"), Column("Queries", "2.0", "d")]
    columns += [Column(header, lambda row, i=i: row[2][i] / row[2][0], form) for header, i, form in shares]
    columns += [Column(header, f"2.{i}", "d") for i, header in enumerate(("Wrong", "Late", "Early"), 3)]
    print_rows("Kind", columns, rows)
    total, _, unsure, *failed, _ = np.sum([numbers for _, (*_, numbers) in rows], axis=0)
    print(f"{total} queries, {unsure / total:.2%} unsure, {sum(failed)} failures")
    return sum(failed)


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
    rows, missed = [], 0
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
                unsure = (answer.status == 2).sum()
                rows.append((f"{name} {kind}", (n, colliding, program, false, lost, unsure, nanoseconds)))
                missed += lost
            hit, nanoseconds = answer_by_tight_inclusion(kind, points, distance)
            false, lost = (hit & ~truth).sum(), (truth & ~hit).sum()
            rows.append((f"{name} {kind}", (n, colliding, "Tight-Inclusion", false, lost, None, nanoseconds)))
    headers = "Number", "Colliding", "Program", "False positives", "Missed", "Unsure", "ns a query"
    columns = [Column(header, f"{i}", ".0f") for i, header in enumerate(headers)]
    print_rows("Queries", columns, rows)
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
    phase = NarrowPhase(PairKind[kind.upper()], counts, len(rows), pairs[-1] + 1)
    phase.queue.assign(pairs)
    x0, x1 = (wp.array(x.reshape(-1, 3), dtype=wp.vec3d) for x in (points[:, :4], points[:, 4:]))
    inputs = x0, x1, wp.array(radius.ravel(), dtype=wp.float64), Rings()
    elements = wp.array(elements, dtype=int)
    times = []
    options = {"method": "conservative", "timed": timed, "timer": PhaseTimer(None)}
    with cores(1):
        while len(times) < repeat:
            counts.assign(PairCounts(queued=len(rows)))
            start = time.perf_counter()
            run_distances([(phase, elements)], *inputs, **options)
            wp.synchronize()
            times.append(time.perf_counter() - start)
            if phase.grow():
                times.clear()
    return 1e9 * min(times) / len(rows)


OPTIONS = {"--public": {"action": "store_true", "help": "the public queries, beside Tight-Inclusion"}}


def run(arguments):
    """Certifies, or compares, and returns the number of failures."""
    return compare() if arguments.public else certify(arguments.count, arguments.seed)
