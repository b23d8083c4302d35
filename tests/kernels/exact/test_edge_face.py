"""Edges against faces at rest in wide integers: the exact checker's answers, in all degenerate positions."""

import numpy as np
import pytest
import warp as wp

from warp_bsc import checker
from warp_bsc.kernels import FREE, HIT, UNSURE
from warp_bsc.kernels.exact.edge_face import BITS, TOUCHES, EdgeAndFace, edge_meets_face_in


def kernel(limbs):
    edge_meets_face = edge_meets_face_in(limbs)

    @wp.kernel(enable_backward=False, module="unique")
    def decide(x: wp.array2d[wp.vec3d], status: wp.array[int]):
        i = wp.tid()
        points = EdgeAndFace()
        for k in range(8):
            points[k] = x[i, k]
        status[i] = edge_meets_face(points)

    return decide


KERNELS = {limbs: kernel(limbs) for limbs in BITS}


def decide(points, limbs):
    """Statuses of queries p q a b c u v w."""
    status = wp.zeros(len(points), dtype=int)
    wp.launch(KERNELS[limbs], len(points), inputs=[wp.array(points, dtype=wp.vec3d)], outputs=[status])
    return status.numpy()


def truth(points):
    edges, faces, across = points[:, :2], points[:, 2:5], points[:, 5:]
    meets = checker.edge_face_crossings(edges, faces)
    return np.where(meets, np.where(checker.edges_pass_faces(edges, faces, across), HIT, TOUCHES), FREE)


def lattice(rng, n, size):
    """Points of a small lattice: most queries are degenerate in one way or another."""
    return rng.integers(0, size, (n, 8, 3)).astype(np.float64)


def flat(rng, n):
    """All points in one plane, often in one line or in one point."""
    x = rng.integers(-2, 3, (n, 8, 3)).astype(np.float64)
    normal = rng.integers(-2, 3, (n, 3))
    x[..., 2] = normal[:, None, 0] * x[..., 0] + normal[:, None, 1] * x[..., 1]
    x[normal[:, 2] == 0, :, 1] = 0.0
    return x[..., rng.permutation(3)]


def copies(rng, n):
    """Edges that run along sides or parts of sides, or between corners, of random faces."""
    x = rng.normal(size=(n, 8, 3))
    corners = np.concatenate([x[:, 2:5], x[:, 2:3]], axis=1)
    x[:, 0] = corners[np.arange(n), rng.integers(0, 4, n)]
    x[:, 1] = np.where(rng.random((n, 1)) < 0.7, corners[np.arange(n), rng.integers(0, 4, n)], x[:, 1])
    x[:, 5:] = x[:, [4, 2, 3]]  # no neighbours
    return x


def wide(rng, n):
    """Lattice points of which coordinates, or whole axes, have exponents far apart."""
    x = lattice(rng, n, 4) - 1.0
    axes = rng.integers(-900, 900, (n, 1, 3))
    within = rng.choice([0, 0, 0, 1, 40, 60, 150], x.shape) * rng.integers(-1, 2, x.shape)
    return np.ldexp(x, np.clip(axes + within, -1070, 1010))


def near_underflow(rng, n):
    return np.ldexp(lattice(rng, n, 3), rng.choice([-1074, -1073, -1022, 1021], (n, 1, 3)))


def noise(rng, n):
    """A flat sheet in floating point that a rotation has left within a rounding of its plane."""
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return (flat(rng, n) / 3.0) @ turn


SOURCES = {
    "lattice": lambda rng, n: lattice(rng, n, 3),
    "larger lattice": lambda rng, n: lattice(rng, n, 6),
    "points": lambda rng, n: lattice(rng, n, 2),
    "flat": flat,
    "copies": copies,
    "wide": wide,
    "near underflow": near_underflow,
    "noise": noise,
}


@pytest.mark.parametrize("limbs", BITS)
@pytest.mark.parametrize("source", SOURCES)
def test_answers_are_those_of_the_checker(source, limbs):
    rng = np.random.default_rng([1, *source.encode()])
    points = SOURCES[source](rng, 600)
    status, expected = decide(points, limbs), truth(points)
    decided = status != UNSURE
    assert decided.mean() > (0.05 if source == "wide" else 0.99)
    np.testing.assert_array_equal(status[decided], expected[decided])
    assert (expected == TOUCHES).sum() > 20


@pytest.mark.parametrize("limbs", BITS)
def test_the_widest_queries_fit(limbs):
    """The largest determinants of differences of as many bits as a width takes; with one bit more none is decided."""
    rng = np.random.default_rng(2)
    points = rng.choice([-1.0, 1.0], (400, 8, 3)) * (1.0 - rng.integers(1, 4, (400, 8, 3)) * 2.0**-53)
    points[:, 0] = 0.0
    for bits, fits in ((BITS[limbs], True), (BITS[limbs] + 1, False)):
        points[:, 5] = np.ldexp(1.0, -bits)
        status = decide(points, limbs)
        if fits:
            np.testing.assert_array_equal(status, truth(points))
            assert len(np.unique(status)) > 1
        else:
            assert (status == UNSURE).all()
