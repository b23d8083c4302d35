"""Moving tetrahedra of many kinds, decided by the detector and by the exact checker.

The table has a row for each kind: how many invert, how many floating point cannot certify, and how many results are
wrong, which must be none.
"""

import time
from dataclasses import dataclass

import numpy as np
from measured import print_rows

import warp_bsc as bsc
from warp_bsc import checker
from warp_bsc.bench.tables import Column


def _upright(rng, n):
    """Tetrahedra of positive volume."""
    x = rng.normal(size=(n, 4, 3))
    volume = np.linalg.det(x[:, 1:] - x[:, :1])
    x[volume < 0.0, :2] = x[volume < 0.0, 1::-1]
    return x


def random(rng, n):
    return rng.normal(size=(n, 8, 3))


def small_moves(rng, n):
    start = _upright(rng, n)
    return np.concatenate([start, start + 0.3 * rng.normal(size=start.shape)], axis=1)


def lattice(rng, n):
    return rng.integers(-1, 2, (n, 8, 3)).astype(np.float64)


def sliding(rng, n):
    """Corners of a lattice of which few move: volumes that are constant, linear, or zero."""
    x = rng.integers(-1, 2, (n, 8, 3)).astype(np.float64)
    x[:, 4:] = x[:, :4] + rng.integers(-1, 2, (n, 4, 3)) * (rng.random((n, 4, 1)) < 0.3)
    return x


def touching(rng, n):
    """Volumes that are a square times a positive number, or nearly: flat at one time, which floating point misses."""
    a, b, size = (rng.integers(1, 6, n).astype(np.float64) for _ in range(3))
    sides = np.zeros((n, 2, 3, 3))
    sides[:, 0, 0, 0], sides[:, 1, 0, 0] = a, -b  # both vanish at the same time
    sides[:, 0, 1, 1], sides[:, 1, 1, 1] = a, -b
    sides[:, :, 2, 2] = size[:, None]
    sides[:, :, 2, :2] = rng.integers(-3, 4, (n, 2, 2))
    shear = np.eye(3) + np.triu(rng.integers(-2, 3, (n, 3, 3)), 1)
    sides = sides @ shear[:, None] + rng.choice([0.0, 0.0, 1e-16, 1e-12, 1e-7], (n, 1, 1, 1)) * rng.normal(
        size=sides.shape
    )
    x = np.zeros((n, 2, 4, 3))
    x[:, :, 1:] = sides
    return x.reshape(n, 8, 3)


def single_precision(rng, n):
    return small_moves(rng, n).astype(np.float32)


def wide(rng, n):
    """Lattice corners whose axes, or single coordinates, have exponents far apart."""
    x = rng.integers(-2, 3, (n, 8, 3)).astype(np.float64)
    within = rng.choice([0, 0, 0, 1, 40, 150], x.shape) * rng.integers(-1, 2, x.shape)
    return np.ldexp(x, np.clip(rng.integers(-900, 900, (n, 1, 3)) + within, -1070, 1010))


def subnormal_and_huge(rng, n):
    exponents = np.where(rng.random((n, 1, 1)) < 0.5, rng.integers(-1074, -1000, (n, 1, 1)), 1020)
    return np.ldexp(rng.integers(-3, 4, (n, 8, 3)).astype(np.float64), exponents)


KINDS = {
    make.__name__: make
    for make in (random, small_moves, lattice, sliding, touching, single_precision, wide, subnormal_and_huge)
}
"""Functions that make moving tetrahedra, rows a0 b0 c0 d0 a1 b1 c1 d1, given a generator and a number."""


@dataclass
class Verdict:
    """What became of tetrahedra.

    Attributes:
        inverting: How many invert.
        unsure: How many floating point cannot certify.
        wrong: Certified statuses that are not true.
        exact_wrong: Results by method "exact" that are not true.
        missed: Tetrahedra that invert, and that "conservative" does not find.
        late: Times after the inversion, of any method that certifies.
        early: Times that are too early by more than the tolerance: of method "exact", of those said to be within it,
            and of certified inversions of "random" and "small_moves".
    """

    inverting: int
    unsure: int
    wrong: int
    exact_wrong: int
    missed: int
    late: int
    early: int

    @property
    def errors(self) -> int:
        return self.wrong + self.exact_wrong + self.missed + self.late + self.early


def judge(kind, points, device="cpu") -> Verdict:
    """Decides tetrahedra by all methods, and compares with the checker."""
    n = len(points)
    x0, x1 = (np.ascontiguousarray(points[:, half]).reshape(-1, 3) for half in (np.s_[:4], np.s_[4:]))
    mesh = bsc.CollisionMesh(np.zeros((0, 3), int), 4 * n, tets=np.arange(4 * n).reshape(-1, 4), device=device)
    truth, bounds = checker.tetrahedron(points), checker.tetrahedron_toi(points)
    status, late, early, found = np.zeros(n, dtype=int), 0, 0, {}
    for method in ("conservative", "exact"):
        inversions = bsc.CollisionDetector(mesh, method=method).inversions(x0, x1)
        found[method] = np.isin(np.arange(n), inversions.tets)
        late += int((inversions.toi > bounds[inversions.tets, 1]).sum())
        status[inversions.tets] = inversions.status
        timely = inversions.within_tolerance | (method == "exact")
        if kind in ("random", "small_moves"):
            timely |= inversions.status == 1
        early += int((inversions.toi < bounds[inversions.tets, 0] - 2.0**-20)[timely].sum())
    return Verdict(
        inverting=int(truth.sum()),
        unsure=int((status == 2).sum()),
        wrong=int(((status == 1) & ~truth).sum()),
        exact_wrong=int((found["exact"] != truth).sum()),
        missed=int((truth & ~found["conservative"]).sum()),
        late=late,
        early=early,
    )


OPTIONS = {"--device": {"default": "cpu"}}


def run(arguments):
    """Judges tetrahedra of all kinds, prints a table, and returns the number of errors."""
    began, each = time.perf_counter(), -(-arguments.count // len(KINDS))
    rows = [
        (kind, judge(kind, make(np.random.default_rng([arguments.seed, *kind.encode()]), each), arguments.device))
        for kind, make in KINDS.items()
    ]
    columns = [Column("tetrahedra", lambda verdict: each), Column("invert", "inverting"), Column("unsure", "unsure")]
    print_rows("kind", [*columns, Column("errors", "errors")], rows)
    errors = sum(verdict.errors for _, verdict in rows)
    print(f"{errors} errors of {each * len(KINDS):,}, {time.perf_counter() - began:.0f} s")
    return errors
