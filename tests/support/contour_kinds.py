"""Meshes of grids that cross along a contour of each of seven kinds, and what their repair without a hint gives.

Run it as ``python tests/support/contour_kinds.py [--device DEVICE] [SIZE ...]``, by default 20, 60 and 200 vertices a
side on the CPU. It prints a row for each mesh: crossings, whether the result is certified, the largest strain, moves in
median edge lengths, and the time of a second repair.

References:
    Martin Wicke, Hermes Lanker, and Markus Gross. "Untangling Cloth with Boundaries." Vision, Modeling, and
    Visualization (2006), which tells the kinds apart.
"""

import argparse
import time

import numpy as np
import warp as wp

import warp_bsc as bsc


def one_mesh(*surfaces):
    """Returns the faces and positions of surfaces, each positions and faces."""
    firsts = np.cumsum([0] + [len(x) for x, _ in surfaces])
    faces = np.concatenate([faces + first for (_, faces), first in zip(surfaces, firsts, strict=False)])
    return faces, np.concatenate([x for x, _ in surfaces])


def grid(n, m, place):
    """Returns the positions and faces of a grid of n by m vertices at the places of (u, v) in [0, 1]."""
    u, v = np.meshgrid(np.linspace(0.0, 1.0, n), np.linspace(0.0, 1.0, m), indexing="ij")
    i = np.arange(n * m).reshape(n, m)
    a, b, c, d = (corners.ravel() for corners in (i[:-1, :-1], i[1:, :-1], i[1:, 1:], i[:-1, 1:]))
    return place(u, v).reshape(-1, 3), np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


def flat(n):
    return grid(n, n, lambda u, v: np.stack([u, v, 0.0 * u], -1))


def closed(n):
    """Returns a sheet and the bottom of a bump that has sunk through it: a closed contour."""

    def place(u, v):
        sunk = 0.12 * np.exp(-((u - 0.5) ** 2 + (v - 0.5) ** 2) / 0.02)
        return np.stack([u + 0.0131 / n, v + 0.0177 / n, 0.05 - sunk], -1)

    return one_mesh(flat(n), grid(n, n, place))


def border_border(n):
    """Returns a sheet and a strip through its inside: both ends of the contour are at borders of the strip."""

    def place(u, v):
        return np.stack([0.37 + 0.0131 / n + 0.25 * v, 0.51 + 0.0177 / n + 0.15 * (u - 0.85), 0.6 * (u - 0.85)], -1)

    return one_mesh(flat(n), grid(n, max(4, n // 4), place))


def border_interior(n):
    """Returns two sheets, each halfway into the other: a contour from the border of one to the border of the other."""

    def place(u, v):
        return np.stack([0.75 + 0.0131 / n + u, 0.43 + 0.0177 / n + 0.3 * (v - 0.5), 0.9 * (v - 0.5)], -1)

    return one_mesh(flat(n), grid(n, n, place))


def curled(n, width, shift):
    """Returns a sheet whose end is curled through its middle, with the width and the shift of its end."""
    radius, start, angle = 0.09, 0.35, 1.35 * np.pi

    def place(u, v):
        turn = np.clip((u - start) / radius, 0.0, angle)
        rest = np.maximum(0.0, u - start - radius * angle)
        x = np.where(u < start, u, start + radius * np.sin(turn) + rest * np.cos(angle))
        z = np.where(u < start, 0.0, radius * (1.0 - np.cos(turn)) + rest * np.sin(angle))
        along = turn / angle
        return np.stack([x, 0.5 * (v - 0.5) * (1.0 - along * (1.0 - width)) + shift * along, z], -1)

    return one_mesh(grid(n, n, place))


def border_loop(n):
    """Returns a sheet that crosses itself from its border to a point at which it no longer does."""

    def place(u, v):
        u, w = 2.0 * u - 1.0, 0.8 * (2.0 * v - 1.0) - 0.1
        return np.stack([1.2 * u, w**3 - 0.6 * u * w, 0.8 * w * w], -1)

    return one_mesh(grid(n, n, place))


def loop_loop(n):
    """Returns a sheet that crosses itself in its middle, up to two points at which it does not."""

    def place(u, v):
        u, w = 2.0 * u - 1.0, 1.3 * (2.0 * v - 1.0)
        return np.stack([1.2 * u, w**3 - 0.25 * (1.0 - (u / 0.7) ** 2) * w, 0.8 * w * w], -1)

    return one_mesh(grid(n, n, place))


KINDS = {
    "closed": closed,
    "border to border": border_border,
    "border to inside": border_interior,
    "border to border of itself": lambda n: curled(n, 0.5, 0.0037),
    "border to inside of itself": lambda n: curled(n, 1.0, 0.25),
    "border to loop": border_loop,
    "loop to loop": loop_loop,
}
"""The mesh of each kind, faces and positions, by the number of vertices of a side."""


def main():
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("sizes", nargs="*", type=int, default=[20, 60, 200], metavar="SIZE", help="vertices a side")
    parser.add_argument("--device", default="cpu", help="Warp device (default: cpu)")
    arguments = parser.parse_args()
    device = arguments.device
    wp.config.log_level = wp.LOG_WARNING
    print("kind | vertices | crossings | certified | strain | largest, mean move | time")
    for size in arguments.sizes:
        for kind, make in KINDS.items():
            faces, x = make(size)
            mesh = bsc.CollisionMesh(faces, len(x), device=device)
            edge = np.median(np.linalg.norm(x[mesh.edges[:, 0]] - x[mesh.edges[:, 1]], axis=1))
            bsc.repair(*make(20), device=device)  # loads kernels
            start = time.perf_counter()
            result = bsc.repair(faces, x, device=device)
            seconds = time.perf_counter() - start
            left = len(bsc.CollisionDetector(mesh).find_intersections(result.x))
            if result.certified and left:
                raise AssertionError(f"{kind}, {size}: certified, but {left} edges meet faces")
            moves = result.moved[result.moved > 0.0] / edge if result.moved.any() else np.zeros(1)
            print(
                f"{kind} | {len(x):,} | {result.crossings_before:,} to {left:,} | {'yes' if result.certified else 'no'}"
                f" | {100 * result.max_strain:.1f}% | {moves.max():.2f}, {moves.mean():.2f} | {seconds:.2f} s",
                flush=True,
            )


if __name__ == "__main__":
    main()
