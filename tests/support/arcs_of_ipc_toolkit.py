"""Asks ``NonlinearCCD`` of the IPC Toolkit, and the search of this package, about the same pairs on arcs.

``python tests/support/arcs_of_ipc_toolkit.py --count 2000`` prints for both how many of the colliding pairs they miss,
how many times of impact are late, and how many they report that do not collide, by the interval arithmetic of
arc_intervals.py; and over how many parts of the step the IPC Toolkit puts chords for a pair. Both get the same bound
of the distance of an arc from its chord. Times are not compared: Python computes the trajectories of the IPC Toolkit.
"""

import argparse

import ipctk
import numpy as np
import warp as wp
from arc_intervals import HIT, decide
from certify_arcs import GENERATORS, KINDS, search
from rich import box
from rich.console import Console
from rich.table import Table


class Arc(ipctk.NonlinearTrajectory):
    """The arc of a point, from its positions at both ends, and the centre and the turn of its body."""

    def __init__(self, x0, x1, centre, turn):
        super().__init__()
        self.x0, self.x1, self.angle = x0, x1, float(np.linalg.norm(turn))
        axis = turn / self.angle if self.angle else turn
        self.across = np.cross(axis, x0 - centre)
        self.inward = np.cross(axis, self.across)
        self.lever, self.parts = float(np.linalg.norm(self.across)), 0

    def __call__(self, time):
        """The position at a time, as of :func:`warp_bsc.kernels.arcs.on_arc`."""
        sine = np.sin(time * self.angle) - time * np.sin(self.angle)
        versine = 2.0 * (np.sin(0.5 * time * self.angle) ** 2 - time * np.sin(0.5 * self.angle) ** 2)
        return (1.0 - time) * self.x0 + time * self.x1 + sine * self.across + versine * self.inward

    def max_distance_from_linear(self, start, end):
        """The bound of the distance from the chord of a part, which counts the parts."""
        self.parts += 1
        return min(((end - start) * self.angle) ** 2 / 8.0, 2.0) * self.lever


def ask_ipc_toolkit(pairs):
    """Whether each pair is reported, its time of impact (2 if it is not), and the parts with chords."""
    ccd = ipctk.NonlinearCCD()
    query = ccd.point_triangle_ccd if pairs.kind == "vertex_face" else ccd.edge_edge_ccd
    reported, toi, parts = np.zeros(len(pairs), dtype=bool), np.full(len(pairs), 2.0), np.zeros(len(pairs), dtype=int)
    for i in range(len(pairs)):
        arcs = [
            Arc(pairs.x0[i, j], pairs.x1[i, j], pairs.centre[i, body], pairs.turn[i, body])
            for j, body in enumerate(pairs.body)
        ]
        reported[i], time = query(*arcs)
        toi[i] = time if reported[i] else 2.0
        parts[i] = arcs[0].parts
    return reported, toi, parts


def main():
    """Runs the program."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--count", type=int, default=2000, help="pairs in all")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    rng = np.random.default_rng(args.seed)
    table = Table(box=box.SIMPLE)
    for column in ("pairs", "colliding", "by", "missed", "late", "reported, but free", "parts: mean", "most"):
        table.add_column(column, justify="left" if column in ("pairs", "by") else "right")
    for name, generate in GENERATORS.items():
        sums = {"IPC Toolkit": np.zeros(3, dtype=int), "warp_bsc": np.zeros(3, dtype=int)}
        total, colliding, parts = 0, 0, []
        for kind in KINDS:
            pairs = generate(kind, rng, -(-args.count // (len(GENERATORS) * len(KINDS))))
            truth = decide(pairs)
            collides = truth.status == HIT
            reported, toi, counts = ask_ipc_toolkit(pairs)
            status, own_toi, _at_once = search(pairs, wp.get_device("cpu"))
            parts.append(counts)
            total, colliding = total + len(pairs), colliding + int(collides.sum())
            for by, found, times in (("IPC Toolkit", reported, toi), ("warp_bsc", status != 0, own_toi)):
                late = collides & found & (times > truth.before)
                sums[by] += [(collides & ~found).sum(), late.sum(), (found & (truth.status == 0)).sum()]
        counts = np.concatenate(parts)
        for by, numbers in sums.items():
            of_pairs = [name, f"{total}: {colliding}"] if by == "IPC Toolkit" else ["", ""]
            of_parts = [f"{counts.mean():.1f}", str(counts.max())] if by == "IPC Toolkit" else ["", ""]
            table.add_row(*of_pairs, by, *map(str, numbers), *of_parts)
    console = Console(width=120)
    console.print(table)
    console.print(f"IPC Toolkit {ipctk.__version__}")


if __name__ == "__main__":
    main()
