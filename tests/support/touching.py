"""Measures exactly touching sheets on one core of the CPU, and holds some of the answers against the exact checker.

``python tests/support/touching.py`` prints a table of processor times, and exits with status 1 if an answer is wrong.
The sheets are flat and have the same vertices. "intersections" are all edges that meet faces; "at a distance" are pairs
of sheets that lie one above the other exactly at the minimum distance, at rest or moving together.
"""

import sys
import time

import numpy as np
import warp as wp
from measured import options_of, report
from sheets import grid

import warp_bsc as bsc
from warp_bsc import checker
from warp_bsc.bench.tables import Column
from warp_bsc.bench.timing import limited_threads
from warp_bsc.detection.run.launch import cores

HEIGHT = float(np.float32(0.001))


def layers(count, columns, rows, height=0.0):
    """Sheets of 2 x columns x rows faces in one place, or one above the other: positions and faces."""
    x, faces = grid(max(columns, rows))
    low = (x[:, 0] < 0.01 * (columns + 0.5)) & (x[:, 1] < 0.01 * (rows + 0.5))
    number = np.cumsum(low) - 1
    x, faces = x[low], number[faces[low[faces].all(axis=1)]]
    positions = np.tile(x, (count, 1))
    positions[:, 2] = np.repeat(np.float32(height) * np.arange(count, dtype=np.float32), len(x))
    return positions, np.concatenate([faces + i * len(x) for i in range(count)])


def measure(run):
    """Returns a result and the processor time of a run [s], the second one: the first loads the kernels."""
    run()
    start = time.process_time()
    result = run()
    return result, time.process_time() - start


def share_no_vertex(first, second):
    """Returns which elements, given as rows of vertices, have no vertex in common."""
    return (first[:, :, None] != second[:, None, :]).all(axis=(1, 2))


def judge_intersections(rng, mesh, x, found, count):
    """Returns how many answers are wrong: of pairs that were found, and of their edges with the faces beside these."""
    pairs = np.repeat(found[rng.integers(0, len(found), count)], 2, axis=0)
    pairs[1::2, 1] = (pairs[1::2, 1] + 1) % len(mesh.faces)
    pairs = pairs[share_no_vertex(mesh.edges[pairs[:, 0]], mesh.faces[pairs[:, 1]])]
    truth = checker.edge_face_crossings(x[mesh.edges[pairs[:, 0]]], x[mesh.faces[pairs[:, 1]]])
    known = set(map(tuple, found.tolist()))
    return sum(meets != (tuple(pair) in known) for pair, meets in zip(pairs.tolist(), truth.tolist(), strict=True))


def judge_distances(rng, mesh, x0, x1, collisions, count):
    """Returns how many answers are wrong: of pairs that were found, and of their vertices with the faces beside."""
    found = collisions.vertex_face
    pairs = np.repeat(found[rng.integers(0, len(found), count)], 2, axis=0)
    pairs[1::2, 1] = (pairs[1::2, 1] + 1) % len(mesh.faces)
    pairs = pairs[(np.sign(pairs[:, 0] - mesh.vertex_count // 2 + 0.5) * (pairs[:, 1] - len(mesh.faces) // 2)) < 0]
    corners = np.concatenate([pairs[:, :1], mesh.faces[pairs[:, 1]]], axis=1)
    truth = checker.vertex_face(np.concatenate([x0[corners], x1[corners]], axis=1), HEIGHT)
    known = set(map(tuple, found.tolist()))
    return sum(hit != (tuple(pair) in known) for pair, hit in zip(pairs.tolist(), truth.tolist(), strict=True))


COLUMNS = (
    Column("Sheets", "sheets"),
    Column("Faces of each", "faces"),
    Column("Pairs", "pairs"),
    Column("Seconds", "seconds", ".2f"),
    Column("Pairs a second", lambda row: row["pairs"] / row["seconds"], ",.0f"),
    Column("Wrong", "wrong"),
)


def main():
    """Measures, and judges."""
    parser = options_of(__doc__)
    parser.add_argument("--judged", type=int, default=500, help="pairs of each scene to hold against the checker")
    arguments = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    rng = np.random.default_rng(0)
    rows = []

    def add(question, count, faces, pairs, seconds, wrong):
        row = {"question": question, "sheets": count, "faces": faces // count, "pairs": pairs}
        rows.append(row | {"seconds": seconds, "wrong": int(wrong)})

    with limited_threads(1), cores(1):
        for count, columns, lines in ((2, 32, 32), (2, 42, 42), (8, 32, 16)):
            x, faces = layers(count, columns, lines)
            mesh = bsc.CollisionMesh(faces, len(x), device="cpu")
            found, seconds = measure(lambda mesh=mesh, x=x: bsc.CollisionDetector(mesh).find_intersections(x))
            wrong = judge_intersections(rng, mesh, x, found, arguments.judged)
            add("intersections", count, len(faces), len(found), seconds, wrong)
        for question, shift in (("at a distance, at rest", 0.0), ("at a distance, moving", 0.02)):
            x0, faces = layers(2, 48, 48, HEIGHT)
            x1 = x0 + np.float32(shift)
            mesh = bsc.CollisionMesh(faces, len(x0), device="cpu")
            detector = bsc.CollisionDetector(mesh, method="exact", min_distance=HEIGHT)
            collisions, seconds = measure(lambda detector=detector, ends=(x0, x1): detector.detect(*ends))
            pairs = len(collisions.vertex_face) + len(collisions.edge_edge)
            wrong = judge_distances(rng, mesh, x0, x1, collisions, arguments.judged)
            add(question, 2, len(faces), pairs, seconds, wrong)
    devices = [wp.get_device("cpu")]
    report(arguments, "touching", "Question", COLUMNS, rows, devices, name="question", judged=arguments.judged)
    return 1 if any(row["wrong"] for row in rows) else 0


if __name__ == "__main__":
    sys.exit(main())
