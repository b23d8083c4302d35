"""Distances of two features in NumPy, brute force over fine times, and queries whose minimum distance is known.

``python tests/support/distances.py --count 100000`` holds the exact checker against both, prints a table and exits with
status 1 if an answer is wrong.
"""

import argparse
import sys

import numpy as np
from generators import GENERATORS
from rich import box
from rich.console import Console
from rich.progress import track
from rich.table import Table

from warp_bsc import checker

KINDS = ("vertex_face", "edge_edge", "vertex_edge", "vertex_vertex")
POINTS = {"vertex_face": 4, "edge_edge": 4, "vertex_edge": 3, "vertex_vertex": 2}
ROUNDING = 1e-10
"""More than the error of a distance in double precision, as a share of the largest coordinate or minimum distance."""


def dot(x, y):
    return (x * y).sum(axis=-1)


def share(x, y):
    """x / y in [0, 1], 0 where y is 0."""
    positive = y > 0
    return np.where(positive, np.minimum(np.maximum(x / np.where(positive, y, 1), 0), 1), 0)[:, None]


def squared_distances(kind, u, v, w):
    """Least squared distances, shape [n]: of floating-point numbers, or without rounding of fractions."""
    uu, vv, uv, uw, vw = dot(u, u), dot(v, v), dot(u, v), dot(u, w), dot(v, w)
    det = uu * vv - uv * uv
    regular = np.where(det > 0, det, 1)
    first = (uw * vv - uv * vw) / regular
    if kind == "vertex_face":
        second = (vw * uu - uv * uw) / regular
        inside = (first >= 0) & (second >= 0) & (first + second <= 1)
        borders = [w - share(uw, uu) * u, w - share(vw, vv) * v]
        borders.append(w - u - share(dot(w - u, v - u), dot(v - u, v - u)) * (v - u))
        within = w - first[:, None] * u - second[:, None] * v
    else:
        second = (first * uv - vw) / np.where(vv > 0, vv, 1)
        inside = (first >= 0) & (first <= 1) & (second >= 0) & (second <= 1)
        borders = [w - share(uw, uu) * u, w + v - share(dot(w + v, u), uu) * u]
        borders += [w + share(-vw, vv) * v, w - u + share(dot(u - w, v), vv) * v]
        within = first[:, None] * u - w - second[:, None] * v
    least = np.min([dot(border, border) for border in borders], axis=0)
    return np.where((det > 0) & inside, np.minimum(least, dot(within, within)), least)


def as_four_points(kind, points):
    """Returns vertex-edge and vertex-vertex queries as vertex-face ones with a collapsed face, shape (n, 8, 3)."""
    order = {"vertex_edge": [0, 1, 2, 2], "vertex_vertex": [0, 1, 1, 1]}.get(kind, [0, 1, 2, 3])
    half = POINTS[kind]
    return points[:, order + [i + half for i in order]]


def distances_at(kind, points, time):
    """Returns the distances of queries at times, shape (n,)."""
    points = as_four_points(kind, points)
    time = time[:, None, None]
    a, b, c, d = np.moveaxis((1.0 - time) * points[:, :4] + time * points[:, 4:], 1, 0)
    if kind == "edge_edge":
        return np.sqrt(squared_distances("edge_edge", b - a, d - c, c - a))
    return np.sqrt(squared_distances("vertex_face", c - b, d - b, a - b))


def brute_force(kind, points, distance, halvings=12):
    """Decides queries by distances at up to 2^halvings times, and by the greatest speed between them.

    Args:
        kind: One of KINDS.
        points: Queries, float64.
        distance: Minimum distances, shape (n,).
        halvings: Times are multiples of 2^-(halvings + 1).

    Returns:
        Which certainly collide, and which are certainly free, bool of shape (n,): neither where they graze.
    """
    half = POINTS[kind]
    largest = np.maximum(np.abs(points).max(axis=(1, 2)), distance)
    points = points / largest[:, None, None]
    distance = distance / largest
    velocity = points[:, half:] - points[:, :half]
    first = 2 if kind == "edge_edge" else 1
    relative = velocity[:, :first, None] - velocity[:, None, first:]
    speed = np.linalg.norm(relative, axis=-1).max(axis=(1, 2))
    hit = np.zeros(len(points), dtype=bool)
    for time in (0.0, 1.0):
        hit |= distances_at(kind, points, np.full(len(points), time)) + ROUNDING <= distance
    rows, times, width = np.flatnonzero(~hit), np.full((~hit).sum(), 0.5), 1.0
    for _ in range(halvings):
        found = distances_at(kind, points[rows], times)
        hit[rows[found + ROUNDING <= distance[rows]]] = True
        left = (found - 0.5 * width * speed[rows] <= distance[rows] + ROUNDING) & ~hit[rows]
        rows, times, width = np.repeat(rows[left], 2), np.repeat(times[left], 2), 0.5 * width
        times[0::2] -= 0.5 * width
        times[1::2] += 0.5 * width
    free = ~hit
    free[rows] = False
    return hit, free


# --- Queries ---

_FRAMES = np.array(
    [
        [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
        [[1, 2, 2], [2, 1, -2], [2, -2, 1]],
        [[2, 3, 6], [3, -6, 2], [6, 2, -3]],
        [[4, 3, 0], [-3, 4, 0], [0, 0, 5]],
    ],
    dtype=np.float64,
)
_LENGTHS = np.array([1.0, 3.0, 7.0, 5.0])


def reached(rng, n, kind):
    """Returns queries that come as near as a known distance, and not nearer: points and distances.

    Two parallel planes keep the features apart that far: each feature has one point or more in its plane, the others
    beyond. Where the planes move, they are so near at one end of the step. Where they do not, points slide in them, or
    pass one another at the ends, sides or insides. A third of the features are parallel edges or have collapsed.
    """
    count = POINTS[kind]
    first = 2 if kind == "edge_edge" else 1
    weights = rng.integers(0, 5, (n, count)) * (rng.random((n, count)) < 0.7)
    # local coordinates x, y in the planes and depth z behind them, integers, at the time of the least distance
    local = rng.integers(-8, 9, (n, count, 3)).astype(np.float64)
    local[..., 2] = rng.integers(0, 5, (n, count)) * (weights == 0)
    local[:, 0, 2] = local[:, first, 2] = 0.0
    degenerate = rng.random(n) < 1 / 3
    if count > 2:
        local[degenerate, -1] = local[degenerate, -2] if kind != "edge_edge" else local[degenerate, 2]
    if kind == "edge_edge":
        parallel = degenerate & (rng.random(n) < 0.7)
        local[parallel, 3] = local[parallel, 2] + local[parallel, 1] - local[parallel, 0]
        local[parallel, :, 2] = 0.0
    # the point in the plane of one feature lies above that of the other
    local[:, first:, :2] += (local[:, :1, :2] - local[:, first : first + 1, :2]) * (rng.random((n, 1, 1)) < 0.9)
    height = rng.integers(1, 9, n).astype(np.float64)
    velocity = rng.integers(-8, 9, (n, count, 3)).astype(np.float64) * (rng.random((n, 1, 1)) < 0.9)
    time = rng.choice([0.0, 0.125, 0.5, 0.75, 1.0], n)
    velocity[..., 2] = 0.0
    rise = rng.integers(0, 9, n) * np.where(time == 0.0, 1.0, np.where(time == 1.0, -1.0, 0.0))
    local[:, :first, 2] *= -1.0
    local[:, first:, 2] += height[:, None]
    velocity[:, first:, 2] += rise[:, None]
    # the features may not be nearest at the points in the planes: lift those that are not exactly at that distance
    frame = rng.integers(0, len(_FRAMES), n)
    ends = [local - time[:, None, None] * velocity, local + (1.0 - time)[:, None, None] * velocity]
    points = np.concatenate(ends, axis=1)
    at = np.concatenate([local, local], axis=1)
    exact = distances_at(kind, at, np.zeros(n)) == height
    points = np.einsum("npi,nij->npj", points, _FRAMES[frame])
    return points[exact], (height * _LENGTHS[frame])[exact]


def nudged(rng, distance, by="all"):
    """Returns distances that are changed a little or not at all, and whether they are no less.

    Args:
        rng: Random generator.
        distance: Distances, shape (n,).
        by: "ulp": as they are, or next to them in floating point; "2^-40": off by as much of them; "all": either.
    """
    first, last = {"ulp": (0, 3), "2^-40": (3, 5), "all": (0, 5)}[by]
    how = rng.integers(first, last, len(distance))
    changed = np.select(
        [how == 1, how == 2, how == 3, how == 4],
        [
            np.nextafter(distance, np.inf),
            np.nextafter(distance, 0.0),
            distance * (1.0 + 2.0**-40),
            distance * (1.0 - 2.0**-40),
        ],
        distance,
    )
    return changed, changed >= distance


def scaled(rng, points, distance, low=-1000, high=990):
    """Returns queries and distances times a power of two each: exact, for integers times small powers of two."""
    exponent = rng.integers(low, high + 1, len(points))
    return np.ldexp(points, exponent[:, None, None]), np.ldexp(distance, exponent)


def adversarial(rng, n, kind, dtype=np.float64):
    """Returns queries of every generator, with distances about as large as those that they come to, or any at all."""
    parts, distances = [], []
    for name, generator in GENERATORS.items():
        if name == "subnormal_and_huge":
            continue
        size = n // (len(GENERATORS) - 1) + 1
        points = generator(rng, size, "edge_edge" if kind == "edge_edge" else "vertex_face", np.float64)
        half = POINTS[kind]
        points = points[:, [*range(half), *range(4, 4 + half)]].astype(dtype)
        largest = np.abs(points).max(axis=(1, 2)).astype(np.float64)
        some = rng.random(size)
        wide = points.astype(np.float64)
        with np.errstate(over="ignore", invalid="ignore"):
            at = distances_at(kind, wide / np.maximum(largest, 1e-300)[:, None, None], some) * largest
        distance = np.where(rng.random(size) < 0.5, at, largest * 10.0 ** rng.uniform(-12.0, 0.5, size))
        distance = np.where(rng.random(size) < 0.05, 10.0 ** rng.uniform(-300.0, 300.0, size), distance)
        parts.append(points)
        distances.append(np.nan_to_num(distance))
    return np.concatenate(parts)[:n], np.concatenate(distances)[:n]


def check(count, seed):
    """Holds the checker against brute force and known distances, prints a table, and counts what is wrong."""
    table = Table("Kind", box=box.SIMPLE_HEAD, padding=0, show_edge=False)
    for column in ("Queries", "Aim", "Colliding", "Brute force decides", "Wrong"):
        table.add_column(column, justify="right", no_wrap=True)
    console = Console()
    total = failures = 0
    for kind in track(KINDS, console=console, description="checking"):
        rng = np.random.default_rng([seed, *kind.encode()])
        decide = getattr(checker, kind)
        share_of_kind = {"vertex_face": 3, "edge_edge": 3, "vertex_edge": 2, "vertex_vertex": 1}[kind] * count // 9
        points, distance = reached(rng, share_of_kind, kind)
        points, distance = points[: share_of_kind // 2], distance[: share_of_kind // 2]
        distance, truth = nudged(rng, distance)
        points, distance = scaled(rng, points, distance)
        answer = decide(points, distance)
        wrong = (answer != truth).sum()
        table.add_row(kind, f"{len(points)}", "known", f"{truth.mean():.1%}", "", f"{wrong}")
        total, failures = total + len(points), failures + wrong
        points, distance = adversarial(rng, share_of_kind - len(points), kind)
        answer = decide(points, distance)
        hit, free = brute_force(kind, points, distance)
        wrong = (hit & ~answer).sum() + (free & answer).sum()
        decided = f"{(hit | free).mean():.2%}"
        table.add_row(kind, f"{len(points)}", "trouble", f"{answer.mean():.1%}", decided, f"{wrong}")
        total, failures = total + len(points), failures + wrong
    console.print(table)
    console.print(f"{total} queries, {failures} wrong")
    return failures


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=10000, help="queries in all")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    sys.exit(1 if check(arguments.count, arguments.seed) else 0)
