"""Edges that cross faces: the exact checker against clipping, and in cases decided by hand."""

from fractions import Fraction

import numpy as np
import pytest
from exact_vectors import cross, dot, minus

from warp_bsc import checker

FACE = [(0, 0, 0), (4, 0, 0), (0, 4, 0)]
SEGMENT_FACE = [(0, 0, 0), (4, 0, 0), (2, 0, 0)]
POINT_FACE = [(1, 1, 1)] * 3


def clipped(edge, face):
    """Says whether an edge meets a face that is no segment: clips it exactly by the face's and its edges' planes."""
    (p, q), (a, b, c) = ([[Fraction(x) for x in point] for point in points.tolist()] for points in (edge, face))
    normal = cross(minus(b, a), minus(c, a))
    low, high = Fraction(0), Fraction(1)
    sides = [(a, normal), (a, [-x for x in normal])]
    sides += [(start, cross(normal, minus(end, start))) for start, end in ((a, b), (b, c), (c, a))]
    for origin, inward in sides:
        at_p, slope = dot(minus(p, origin), inward), dot(minus(q, p), inward)
        if slope == 0 and at_p < 0:
            return False
        if slope > 0:
            low = max(low, -at_p / slope)
        if slope < 0:
            high = min(high, -at_p / slope)
    return low <= high


@pytest.mark.parametrize("dimensions", [2, 3])
def test_edge_face_crossings_against_clipping(dimensions):
    rng = np.random.default_rng(10)
    points = rng.integers(-2, 3, (600, 5, 3)).astype(np.float64)
    points[..., dimensions:] = 1.0
    edges, faces = points[:, :2], points[:, 2:]
    proper = np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0]).any(axis=1)
    edges, faces = edges[proper], faces[proper]
    truth = [clipped(edge, face) for edge, face in zip(edges, faces, strict=True)]
    assert 0 < sum(truth) < len(truth)
    assert checker.edge_face_crossings(edges, faces).tolist() == truth


@pytest.mark.parametrize(
    ("edge", "face", "truth"),
    [
        ([(1, 1, -1), (1, 1, 1)], FACE, True),
        ([(1, 1, 1), (1, 1, 2)], FACE, False),
        ([(1, 1, 1), (1, 1, 0)], FACE, True),
        ([(2, 2, -1), (2, 2, 1)], FACE, True),
        ([(-1, 1, 0), (9, 1, 0)], FACE, True),
        ([(1, 1, 0), (1, 2, 0)], FACE, True),
        ([(5, 0, 0), (0, 5, 0)], FACE, False),
        ([(1, 1, 0), (1, 1, 0)], FACE, True),
        ([(3, 3, 0), (3, 3, 0)], FACE, False),
        ([(1, 0, -1), (1, 0, 1)], SEGMENT_FACE, True),
        ([(5, 0, 0), (9, 0, 0)], SEGMENT_FACE, False),
        ([(4, 0, 0), (9, 0, 0)], SEGMENT_FACE, True),
        ([(0, 0, 0), (2, 2, 2)], POINT_FACE, True),
        ([(0, 0, 0), (2, 2, 3)], POINT_FACE, False),
        ([(1, 1, 1), (1, 1, 1)], POINT_FACE, True),
    ],
)
def test_edge_face_crossing(edge, face, truth):
    answer = checker.edge_face_crossings(np.array([edge], dtype=np.float32), np.array([face], dtype=np.float64))
    assert answer.tolist() == [truth]
