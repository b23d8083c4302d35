"""Tetrahedra that invert: the exact checker's answers, contracts of the result, bad input."""

import itertools
from fractions import Fraction

import numpy as np
import pytest
import warp as wp
from certify_inversions import KINDS, judge

import warp_bsc as bsc
from warp_bsc import checker
from warp_bsc.kernels import FREE, HIT, inversion_tetrahedron

TETS = np.array([[0, 1, 2, 3], [0, 1, 2, 4]])
X = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]])


@pytest.mark.parametrize("kind", KINDS)
def test_results_are_those_of_the_checker(kind, device):
    points = KINDS[kind](np.random.default_rng([5, *kind.encode()]), 200)
    verdict = judge(kind, points, device)
    assert verdict.errors == 0
    assert verdict.inverting > 10
    if kind in ("random", "small_moves", "single_precision"):
        assert verdict.unsure == 0
    if kind in ("lattice", "sliding", "touching"):
        assert verdict.unsure > 10


def volume(points, time):
    a, b, c, d = ([(1 - time) * p + time * q for p, q in zip(*ends, strict=True)] for ends in points)
    u, v, w = ([p - q for p, q in zip(x, a, strict=True)] for x in (b, c, d))
    n = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]]
    return sum(p * q for p, q in zip(w, n, strict=True))


@pytest.mark.parametrize("kind", ["small_moves", "sliding", "touching"])
def test_the_checker_agrees_with_volumes_at_many_times(kind):
    points = KINDS[kind](np.random.default_rng(3), 100)
    inverts, toi = checker.tetrahedron(points), checker.tetrahedron_toi(points)
    for query, is_inverted, (low, high) in zip(points, inverts, toi, strict=True):
        exact = [[[Fraction(x) for x in point] for point in ends] for ends in zip(query[:4], query[4:], strict=True)]
        volumes = {time: volume(exact, time) for time in [Fraction(i, 16) for i in range(17)]}
        assert is_inverted or min(volumes.values()) > 0
        assert is_inverted == bool(low <= high)
        if is_inverted:
            assert all(v > 0 for time, v in volumes.items() if time < low)
            assert low < high or volume(exact, Fraction(high)) <= 0


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_tetrahedra_of_a_mesh(dtype, device):
    mesh = bsc.CollisionMesh(np.zeros((0, 3), int), 5, tets=wp.array(TETS, dtype=int, device=device), device=device)
    x0, x1 = X.astype(dtype), X.astype(dtype)
    for method in ("float", "conservative", "exact"):
        detector = bsc.CollisionDetector(mesh, method=method)
        assert not len(detector.inversions(x0, x0).tets)
        x1[3] = 0.0, 0.0, -1.0  # through the triangle of the others at half time
        found = detector.inversions(x0, wp.array(x1, dtype=wp.vec3 if dtype == np.float32 else wp.vec3d, device=device))
        assert found.tets.tolist() == [0] and found.status.tolist() == [1]
        assert 0.5 - 2.0**-20 <= found.toi[0] <= 0.5
        assert detector.find_inversions(x1).tolist() == [0]
        x1[3] = 0.0, 0.0, 0.0
        assert detector.find_inversions(x1).tolist() == [0]
        assert detector.find_inversions(x0).tolist() == []


def test_a_mesh_without_tetrahedra_has_no_inversions(device):
    detector = bsc.CollisionDetector(bsc.CollisionMesh([[0, 1, 2]], 3, device=device))
    assert not len(detector.inversions(X[:3], -X[:3]).tets) and not len(detector.find_inversions(X[:3]))


def test_bad_input_is_an_error(device):
    for tets, message in (
        ([[0, 1, 2]], r"tets must have shape \(n, 4\)"),
        ([[0, 1, 2, 9]], r"tets\[0\] is \[0, 1, 2, 9\], but the mesh has 5 vertices"),
        ([[0.0, 1.0, 2.0, 3.0]], "tets must be integers"),
    ):
        with pytest.raises(ValueError, match=message):
            bsc.CollisionMesh(np.zeros((0, 3), int), 5, tets=tets, device=device)
    detector = bsc.CollisionDetector(bsc.CollisionMesh(np.zeros((0, 3), int), 6, tets=TETS, device=device))
    x = np.concatenate([X, [[np.nan] * 3]])  # of no tetrahedron
    assert not len(detector.inversions(x, x).tets)
    bad = x.copy()
    bad[2, 1] = np.inf
    with pytest.raises(ValueError, match=r"x1.* finite"):
        detector.inversions(x, bad)
    with pytest.raises(ValueError, match="x must have 6 rows"):
        detector.find_inversions(X)
    with pytest.raises(ValueError, match="x1 must be float32 as x0, not float64"):
        detector.inversions(x.astype(np.float32), x)


@wp.kernel
def of_a_user(x0: wp.array[wp.vec3], x1: wp.array[wp.vec3], status: wp.array[int], toi: wp.array[wp.float64]):
    found = inversion_tetrahedron(x0[0], x0[1], x0[2], x0[3], x1[0], x1[1], x1[2], x1[3], wp.float64(1e-6))
    status[0] = found.status
    toi[0] = found.toi


@pytest.mark.parametrize("last, expected", [((0.0, 0.0, 0.5), FREE), ((0.0, 0.0, -3.0), HIT)])
def test_a_kernel_of_a_user(last, expected, device):
    x0, x1 = X[:4].copy(), X[:4].copy()
    x1[3] = last
    x0, x1 = (wp.array(x, dtype=wp.vec3, device=device) for x in (x0, x1))
    status, toi = wp.zeros(1, dtype=int, device=device), wp.zeros(1, dtype=wp.float64, device=device)
    wp.launch(of_a_user, 1, inputs=[x0, x1], outputs=[status, toi], device=device)
    assert status.numpy()[0] == expected
    assert toi.numpy()[0] == (2.0 if expected == FREE else pytest.approx(0.25, abs=1e-6))


def test_all_orders_of_corners(device):
    """A tetrahedron is inverted in one order of its corners, and not in the other."""
    orders = np.array(list(itertools.permutations(range(4))))
    mesh = bsc.CollisionMesh(np.zeros((0, 3), int), 4, tets=orders, device=device)
    inverted = bsc.CollisionDetector(mesh).find_inversions(X[:4])
    signs = np.sign(np.linalg.det(X[orders][:, 1:] - X[orders][:, :1]))
    assert inverted.tolist() == np.flatnonzero(signs < 0).tolist()
