"""Advancement through a step with a minimum distance: certified by exact arithmetic, and enough for most queries."""

from fractions import Fraction

import distances
import numpy as np
import pytest
import warp as wp
from outputs import filled_with_nan
from sample_sizes import cases
from sheets import crumpled

import warp_bsc as bsc
from warp_bsc.detection.pipeline import DetectionPipeline
from warp_bsc.detection.run.launch import retry_until_fits
from warp_bsc.detection.run.settings import PairKind
from warp_bsc.kernels.min_distance import _cleared_until
from warp_bsc.kernels.motion import motion_and_distance
from warp_bsc.kernels.polynomials import EDGE_EDGE, VERTEX_FACE
from warp_bsc.kernels.signs import ROUNDOFF


@wp.kernel(enable_backward=False)
def clear(
    kind: int,
    x: wp.array2d[wp.vec3d],
    direction: wp.array[wp.vec3d],
    start: wp.array[wp.float64],
    distance: wp.array[wp.float64],
    end: wp.array[wp.float64],
):
    i = wp.tid()
    motion, scaled = motion_and_distance(
        kind, x[i, 0], x[i, 1], x[i, 2], x[i, 3], x[i, 4], x[i, 5], x[i, 6], x[i, 7], distance[i], ROUNDOFF
    )
    end[i] = _cleared_until(motion, direction[i], start[i], scaled)


def corners(kind, points):
    """The differences of points of both features at both ends, exactly: shape [2, corners, 3]."""
    exact = [[Fraction(c) for c in p] for p in points.tolist()]
    ends = []
    for a, b, c, d in (exact[:4], exact[4:]):
        pairs = [(a, b), (a, c), (a, d)] if kind == int(VERTEX_FACE) else [(c, a), (c, b), (d, a), (d, b)]
        ends.append([[s - t for s, t in zip(p, q, strict=True)] for p, q in pairs])
    return ends


def least_along(ends, direction, time):
    """The least product of a corner with a direction at a time, exactly."""
    t = Fraction(time)
    g = [Fraction(c) for c in direction.tolist()]
    products = [[sum(a * b for a, b in zip(g, x, strict=True)) for x in end] for end in ends]
    return min((1 - t) * a + t * b for a, b in zip(*products, strict=True))


def exceeds(least, direction, distance):
    """Whether the least product is more than the distance times the norm of the direction, exactly."""
    squared = sum(Fraction(c) ** 2 for c in direction.tolist())
    return least > 0 and least**2 > Fraction(distance) ** 2 * squared


@pytest.mark.parametrize("kind", [int(VERTEX_FACE), int(EDGE_EDGE)])
def test_cleared_times_are_certified(kind, device):
    """The distance is the one along the direction at the start, or more or less by 2^-53 to 2^-30 of it, or a half."""
    rng = np.random.default_rng(3)
    n = cases(400)
    points = rng.standard_normal((n, 8, 3)) * 10.0 ** rng.uniform(-3, 3, (n, 8, 1))
    points[: n // 2, 4:] = points[: n // 2, :4] + 1e-3 * rng.standard_normal((n // 2, 4, 3))
    start = np.floor(rng.uniform(0, 1, n) * 2.0**40) * 2.0**-40
    start[::3] = 0.0
    ends = [corners(kind, p) for p in points]
    direction = rng.standard_normal((n, 3))
    least = np.empty(n)
    for i in range(n):
        # towards one corner; the features are moved apart along it
        direction[i] /= np.abs(direction[i]).max()
        shift = 1.0 + abs(float(least_along(ends[i], direction[i], 0.0))) / (direction[i] @ direction[i])
        first = [0, 4] if kind == int(VERTEX_FACE) else [2, 3, 6, 7]
        points[i, first] += shift * direction[i]
        ends[i] = corners(kind, points[i])
        least[i] = float(least_along(ends[i], direction[i], float(start[i])))
    reached = np.maximum(least, 0.0) / np.linalg.norm(direction, axis=1)
    near = reached * (1.0 + rng.integers(-1, 2, n) * 2.0 ** rng.integers(-53, -30, n))
    x, g = wp.array(points, dtype=wp.vec3d), wp.array(direction, dtype=wp.vec3d)
    advanced = {}
    for name, distance in (("near", near), ("half", 0.5 * reached)):
        end = filled_with_nan(n, wp.float64)
        inputs = [wp.array(a, dtype=wp.float64) for a in (start, distance)]
        wp.launch(clear, n, inputs=[kind, x, g, *inputs], outputs=[end])
        found = end.numpy()
        assert ((found >= start) & (found <= 1.0) & (found * 2.0**40 % 1.0 == 0.0)).all()
        advanced[name] = found > start
        for i in np.flatnonzero(advanced[name]):
            for time in (start[i], found[i]):
                assert exceeds(least_along(ends[i], direction[i], float(time)), direction[i], float(distance[i]))
    assert cases(20) < advanced["near"].sum() < n // 2 < advanced["half"].sum()
    assert not (advanced["near"] & (near > reached)).any()


def found_contacts(mesh, x0, x1, **options):
    """Runs a detection, whose buffers are large enough at the end, and returns its pipeline."""
    pipeline = DetectionPipeline(mesh, **options)
    start, end = (wp.array(x, dtype=wp.vec3d) for x in (x0, x1))
    retry_until_fits(lambda: pipeline.find_contacts(start, end), pipeline, mesh.device)
    return pipeline


def test_most_pairs_are_not_subdivided(device):
    x0, x1, faces = crumpled(1, n=12)
    pipeline = found_contacts(bsc.CollisionMesh(faces, len(x0)), x0, x1, min_distance=0.0007)
    for kind in (PairKind.VERTEX_FACE, PairKind.EDGE_EDGE):
        counts = pipeline.counts.pairs[kind]
        assert 0 < counts.subdivided < 0.2 * counts.survivors


def test_pairs_that_subdivision_finds_free_are_not_reported(device):
    """Queries whose least distance is known, 2^-40 of it beside the minimum distance, each in a world of its own."""
    rng = np.random.default_rng(4)
    points, distance = distances.reached(rng, 400, "vertex_face")
    distance, truth = distances.nudged(rng, distance, "2^-40")
    n = len(points)
    x0, x1 = points[:, :4].reshape(-1, 3), points[:, 4:].reshape(-1, 3)
    vertices = 4 * np.arange(n)
    radius = np.zeros(4 * n)
    radius[vertices] = distance
    mesh = bsc.CollisionMesh(
        vertices[:, None] + [1, 2, 3], 4 * n, points=vertices, radius=radius, world=np.repeat(np.arange(n), 4)
    )
    counts = found_contacts(mesh, x0, x1).counts.vertex_face
    assert counts.subdivided > counts.contacts - counts.found > 0
    hits = np.flatnonzero(truth)
    found = bsc.CollisionDetector(mesh, method="exact").detect(x0, x1).vertex_face
    np.testing.assert_array_equal(found, np.stack([4 * hits, hits], axis=1))
