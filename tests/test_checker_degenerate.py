"""The exact checker in degenerate cases, each with its earliest time of contact, decided by hand; None: free."""

import numpy as np
import pytest
from checker_functions import COLLIDES, TOI

FACE = [(0, 0, 0), (4, 0, 0), (0, 4, 0)]
SEGMENT_FACE = [(0, 0, 0), (4, 0, 0), (2, 0, 0)]
POINT_FACE = [(1, 1, 1)] * 3


def tangent_face(x, height=0.0):
    """Returns start and end of a query whose volume is 16 height - 16 (2t - 1)^2."""
    return tuple([(x, 1 + s, s + height), (0, 0, 0), (4, 0, 0), (0, 4, 4 * s)] for s in (-1, 1))


def tangent_edges(x, height=0.0):
    """Returns start and end of a query whose volume is 16 height - 16 (2t - 1)^2."""
    return tuple([(0, 0, 0), (4, 0, 0), (x, s - 1, height - s), (x, s + 3, height + 3 * s)] for s in (-1, 1))


VERTEX_FACE_CASES = {
    "all points equal": ([(1, 2, 3)] * 4, [(4, 5, 6)] * 4, 0),
    "all points equal at the end only": ([(0, 0, 1), *FACE], [(1, 1, 1)] * 4, 1),
    "resting inside, k0 = 0": ([(1, 1, 0), *FACE], [(1, 1, 0), *FACE], 0),
    "resting on a corner": ([(0, 0, 0), *FACE], [(0, 0, 0), *FACE], 0),
    "in the plane beside the face, at rest": ([(3, 3, 0), *FACE], [(3, 3, 0), *FACE], None),
    "lifting off": ([(1, 1, 0), *FACE], [(1, 1, 1), *FACE], 0),
    "landing at the end": ([(1, 1, 1), *FACE], [(1, 1, 0), *FACE], 1),
    "landing at the end on an edge": ([(2, 2, 1), *FACE], [(2, 2, 0), *FACE], 1),
    "landing at the end beside the face": ([(3, 3, 1), *FACE], [(3, 3, 0), *FACE], None),
    "passing through an edge": ([(2, 0, 1), *FACE], [(2, 0, -1), *FACE], 0.5),
    "passing through a corner": ([(4, 0, 1), *FACE], [(4, 0, -3), *FACE], 0.25),
    "passing beside a corner": ([(5, 0, 1), *FACE], [(5, 0, -1), *FACE], None),
    "parallel to the face, above it": ([(-9, 1, 1), *FACE], [(9, 1, 1), *FACE], None),
    "sliding in the plane into the face": ([(-1, 1, 0), *FACE], [(1, 1, 0), *FACE], 0.5),
    "sliding in the plane along an edge's line into a corner": ([(-4, 0, 0), *FACE], [(4, 0, 0), *FACE], 0.5),
    "sliding in the plane past the face": ([(5, -1, 0), *FACE], [(5, 9, 0), *FACE], None),
    "sliding in the plane through a corner": ([(3, -1, 0), *FACE], [(5, 1, 0), *FACE], 0.5),
    "sliding in the plane, there at the end only": ([(8, 0, 0), *FACE], [(4, 0, 0), *FACE], 1),
    "sliding in the plane out of the face": ([(1, 1, 0), *FACE], [(9, 1, 0), *FACE], 0),
    "double root inside the face": (*tangent_face(1), 0.5),
    "double root beside the face": (*tangent_face(5), None),
    "near miss of a double root": (*tangent_face(1, -(2.0**-50)), None),
    "two roots near a double root": (*tangent_face(1, 2.0**-50), 0.5 - 2.0**-26),
    "segment for a face, hit": ([(1, 0, 1), *SEGMENT_FACE], [(1, 0, -1), *SEGMENT_FACE], 0.5),
    "segment for a face, hit from within its plane": ([(1, 1, 0), *SEGMENT_FACE], [(1, -1, 0), *SEGMENT_FACE], 0.5),
    "segment for a face, missed on its line": ([(5, 1, 0), *SEGMENT_FACE], [(5, -1, 0), *SEGMENT_FACE], None),
    "segment for a face, along its line": ([(6, 0, 0), *SEGMENT_FACE], [(2, 0, 0), *SEGMENT_FACE], 0.5),
    "segment for a face, along its line without arriving": (
        [(6, 0, 0), *SEGMENT_FACE],
        [(5, 0, 0), *SEGMENT_FACE],
        None,
    ),
    "point for a face, hit": ([(0, 0, 0), *POINT_FACE], [(4, 4, 4), *POINT_FACE], 0.25),
    "point for a face, missed": ([(0, 0, 0), *POINT_FACE], [(4, 4, 5), *POINT_FACE], None),
    "point for a face, at rest upon it": ([(1, 1, 1), *POINT_FACE], [(1, 1, 1), *POINT_FACE], 0),
    "collapses to a point on the vertex": (
        [(0, 0, 0), (4, 0, 0), (0, 4, 0), (4, 4, 1)],
        [(0, 0, 0), (-4, 0, 0), (0, -4, 0), (-4, -4, -1)],
        0.5,
    ),
    "collapses to a segment away from the vertex": (
        [(9, 0, 1), (0, -1, 0), (4, 0, 0), (0, 1, 0)],
        [(9, 0, -1), (0, 1, 0), (4, 0, 0), (0, -1, 0)],
        None,
    ),
    "collapses to a segment on the vertex": (
        [(1, 0, 1), (0, -1, 0), (4, 0, 0), (0, 1, 0)],
        [(1, 0, -1), (0, 1, 0), (4, 0, 0), (0, -1, 0)],
        0.5,
    ),
    "always collinear, vertex overtakes": (
        [(0, 0, 0), (1, 0, 0), (2, 0, 0), (3, 0, 0)],
        [(4, 0, 0), (1, 0, 0), (2, 0, 0), (3, 0, 0)],
        0.25,
    ),
    "always collinear, carried along ahead": (
        [(0, 0, 0), (1, 0, 0), (2, 0, 0), (3, 0, 0)],
        [(4, 0, 0), (5, 0, 0), (6, 0, 0), (7, 0, 0)],
        None,
    ),
}

ALONG_X = [(0, 0, 0), (4, 0, 0)]
POINT_EDGE = [(1, 0, 0), (1, 0, 0)]

EDGE_EDGE_CASES = {
    "all points equal": ([(1, 2, 3)] * 4, [(4, 5, 6)] * 4, 0),
    "crossing at rest": ([*ALONG_X, (1, -1, 0), (1, 1, 0)], [*ALONG_X, (1, -1, 0), (1, 1, 0)], 0),
    "passing through": ([*ALONG_X, (1, -1, 1), (1, 1, 1)], [*ALONG_X, (1, -1, -1), (1, 1, -1)], 0.5),
    "passing beside": ([*ALONG_X, (5, -1, 1), (5, 1, 1)], [*ALONG_X, (5, -1, -1), (5, 1, -1)], None),
    "end touches an edge": ([*ALONG_X, (1, 0, 1), (1, 1, 1)], [*ALONG_X, (1, 0, -1), (1, 1, -1)], 0.5),
    "end touches an end": ([*ALONG_X, (4, 0, 1), (5, 1, 1)], [*ALONG_X, (4, 0, -1), (5, 1, -1)], 0.5),
    "landing at the end": ([*ALONG_X, (1, -1, 1), (1, 1, 1)], [*ALONG_X, (1, -1, 0), (1, 1, 0)], 1),
    "lifting off": ([*ALONG_X, (1, -1, 0), (1, 1, 0)], [*ALONG_X, (1, -1, 1), (1, 1, 1)], 0),
    "parallel, falling onto each other": ([*ALONG_X, (1, 0, 1), (2, 0, 1)], [*ALONG_X, (1, 0, -1), (2, 0, -1)], 0.5),
    "parallel, falling beside on one line": (
        [*ALONG_X, (5, 0, 1), (9, 0, 1)],
        [*ALONG_X, (5, 0, -1), (9, 0, -1)],
        None,
    ),
    "parallel, falling end to end": ([*ALONG_X, (4, 0, 1), (9, 0, 1)], [*ALONG_X, (4, 0, -1), (9, 0, -1)], 0.5),
    "parallel at rest": ([*ALONG_X, (0, 1, 0), (4, 1, 0)], [*ALONG_X, (0, 1, 0), (4, 1, 0)], None),
    "parallel when in one plane, side by side": (
        [(0, -1, 0), (4, 1, 0), (0, 1, 1), (4, 3, 1)],
        [(0, 1, 0), (4, -1, 0), (0, 3, -1), (4, 1, -1)],
        None,
    ),
    "collinear, overlapping at rest": ([*ALONG_X, (3, 0, 0), (9, 0, 0)], [*ALONG_X, (3, 0, 0), (9, 0, 0)], 0),
    "collinear, apart at rest": ([*ALONG_X, (5, 0, 0), (9, 0, 0)], [*ALONG_X, (5, 0, 0), (9, 0, 0)], None),
    "collinear, inside each other at rest": ([*ALONG_X, (1, 0, 0), (2, 0, 0)], [*ALONG_X, (1, 0, 0), (2, 0, 0)], 0),
    "collinear, running into each other": ([*ALONG_X, (6, 0, 0), (9, 0, 0)], [*ALONG_X, (2, 0, 0), (5, 0, 0)], 0.5),
    "collinear, touching at the end only": ([*ALONG_X, (6, 0, 0), (9, 0, 0)], [*ALONG_X, (4, 0, 0), (7, 0, 0)], 1),
    "collinear, swapping order as points": (
        [*POINT_EDGE, (0, 0, 0), (0, 0, 0)],
        [*POINT_EDGE, (2, 0, 0), (2, 0, 0)],
        0.5,
    ),
    "in one plane, sliding into each other": ([*ALONG_X, (1, 1, 0), (1, 2, 0)], [*ALONG_X, (1, -1, 0), (1, 0, 0)], 0.5),
    "in one plane, sliding past": ([*ALONG_X, (5, 1, 0), (5, 2, 0)], [*ALONG_X, (5, -2, 0), (5, -1, 0)], None),
    "zero-length edge, hit": ([*ALONG_X, (1, 1, 1), (1, 1, 1)], [*ALONG_X, (1, -1, -1), (1, -1, -1)], 0.5),
    "zero-length edge, missed": ([*ALONG_X, (1, 1, 1), (1, 1, 1)], [*ALONG_X, (1, -1, -2), (1, -1, -2)], None),
    "zero-length edge, on the line but beside": (
        [*ALONG_X, (5, 1, 1), (5, 1, 1)],
        [*ALONG_X, (5, -1, -1), (5, -1, -1)],
        None,
    ),
    "zero-length edges, meeting": ([*POINT_EDGE, (1, 0, 4), (1, 0, 4)], [*POINT_EDGE, (1, 0, 0), (1, 0, 0)], 1),
    "zero-length edges, apart": ([*POINT_EDGE, (1, 1, 4), (1, 1, 4)], [*POINT_EDGE, (1, 1, 0), (1, 1, 0)], None),
    "double root inside the edges": (*tangent_edges(1), 0.5),
    "double root beside the edges": (*tangent_edges(5), None),
    "near miss of a double root": (*tangent_edges(1, -(2.0**-50)), None),
    "two roots near a double root": (*tangent_edges(1, 2.0**-50), 0.5 - 2.0**-26),
    "an edge turns into a point on the other": (
        [(0, -1, 1), (2, 1, -1), *ALONG_X],
        [(2, 1, -1), (0, -1, 1), *ALONG_X],
        0,
    ),
    "an edge collapses to a point upon the other": (
        [(1, -1, 2), (1, 1, 2), *ALONG_X],
        [(1, 1, -2), (1, -1, -2), *ALONG_X],
        0.5,
    ),
    "an edge collapses to a point beside the other": (
        [(5, -1, 2), (5, 1, 2), *ALONG_X],
        [(5, 1, -2), (5, -1, -2), *ALONG_X],
        None,
    ),
}

CASES = [
    (kind, name)
    for kind, cases in (("vertex_face", VERTEX_FACE_CASES), ("edge_edge", EDGE_EDGE_CASES))
    for name in cases
]


@pytest.mark.parametrize(("kind", "name"), CASES)
def test_degenerate_case(kind, name):
    start, end, time = (VERTEX_FACE_CASES if kind == "vertex_face" else EDGE_EDGE_CASES)[name]
    points = np.array([[*start, *end]], dtype=np.float64)
    assert COLLIDES[kind](points).tolist() == [time is not None]
    expected = [np.nan, np.nan] if time is None else [time, time]
    assert np.array_equal(TOI[kind](points)[0], expected, equal_nan=True)
