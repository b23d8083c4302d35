"""``bsc.check``: each kind of finding, alone and with all of its degenerate cases, and arguments of all kinds."""

import dataclasses
import itertools

import numpy as np
import pytest
import trimesh

import warp_bsc as bsc
from warp_bsc import checker

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=float)
TWO = np.array([[0, 1, 2], [0, 2, 3]])
BALL = trimesh.creation.icosphere(1)


def counts(found):
    """The number of findings of each kind that there are."""
    kinds = {field.name: getattr(found, field.name) for field in dataclasses.fields(found)}
    return {name: len(rows) for name, rows in kinds.items() if name not in ("edges", "component") and len(rows)}


def check(faces, x):
    return bsc.check(np.asarray(faces), np.asarray(x, dtype=float), device="cpu")


def test_a_closed_mesh_is_sound():
    for found in (check(BALL.faces, BALL.vertices), bsc.check(BALL)):
        assert counts(found) == {} and found.component.tolist() == [0] * 80 and len(found.edges) == 120


def test_crossing_and_touching_are_apart():
    faces = np.arange(6).reshape(2, 3)
    base = [[0, 0, 0], [4, 0, 0], [0, 4, 0]]
    through = check(faces, [*base, [1, 1, -1], [1, 1, 1], [9, 9, 1]])
    assert len(through.crossings) == 2 and len(through.touching) == 0
    touches = check(faces, [*base, [1, 1, 0], [1, 1, 1], [9, 9, 1]])
    assert len(touches.crossings) == 0 and len(touches.touching) == 2
    ((edge, face),) = touches.touching[:1]
    assert set(touches.edges[edge]) & {3} and face == 0


@pytest.mark.parametrize("seed", range(5))
def test_crossings_are_those_of_the_checker(seed):
    """On a small lattice, where degenerate cases are common."""
    random = np.random.default_rng(seed)
    x = random.integers(-2, 3, (12, 3)).astype(float)
    x = np.unique(x, axis=0)
    faces = np.array([random.choice(len(x), 3, replace=False) for _ in range(8)])
    found = check(faces, x)
    expected = [
        (edge, face)
        for edge, face in itertools.product(range(len(found.edges)), range(len(faces)))
        if not set(found.edges[edge]) & set(faces[face])
        if checker.edge_face_crossings(x[found.edges[edge]][None], x[faces[face]][None])[0]
    ]
    assert sorted(map(tuple, np.concatenate([found.crossings, found.touching]).tolist())) == expected
    area = [checker_area(x[face]) for face in faces]
    assert found.degenerate_faces.tolist() == [i for i, is_none in enumerate(area) if is_none]


def checker_area(corners):
    """Whether integer corners span no area."""
    a, b, c = corners.astype(int)
    return not np.cross(b - a, c - a).any()


def test_what_is_inside_what():
    small = trimesh.creation.icosphere(1, radius=0.3)
    both = trimesh.util.concatenate([BALL, small])
    found = check(both.faces, both.vertices)
    assert counts(found) == {"inside": 1} and found.inside.tolist() == [[1, 0]]
    assert found.component.tolist() == [0] * 80 + [1] * 80
    open_ball = check(both.faces[1:], both.vertices)
    assert counts(open_ball) == {"borders": 3}  # encloses nothing


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_faces_without_area_are_decided_exactly(dtype):
    """Corners on one line, one bit beside it, one vertex twice; very large and very small."""
    third = dtype(1) / dtype(3)
    line = np.array([[0, 0, 0], [third, third, 0], [2 * third, 2 * third, 0]], dtype=dtype)
    beside = line.copy()
    beside[2, 0] = np.nextafter(beside[2, 0], dtype(2))
    for scale in (1.0, 2.0**-100, 2.0**100, *((2.0**-520, 2.0**600) if dtype is np.float64 else ())):
        for corners, is_degenerate in ((line, True), (beside, False)):
            found = bsc.check(np.array([[0, 1, 2]]), (corners * dtype(scale)).astype(dtype), device="cpu")
            assert found.degenerate_faces.tolist() == [0] * is_degenerate
    assert check([[0, 1, 1], [0, 1, 2], [2, 2, 2]], SQUARE).degenerate_faces.tolist() == [0, 2]


def test_doubled_faces_and_vertices():
    found = check([*TWO, [2, 0, 1]], SQUARE)
    assert found.doubled_faces.tolist() == [[2, 0]] and not len(found.doubled_vertices)
    assert counts(check([*TWO, [0, 1, 2]], SQUARE))["doubled_faces"] == 1
    apart = check([*TWO, [4, 5, 6]], [*SQUARE, *SQUARE[[1, 0, 2]]])
    assert apart.doubled_faces.tolist() == [[2, 0]]
    assert apart.doubled_vertices.tolist() == [[4, 1], [5, 0], [6, 2]]


def test_edges():
    strip = check(TWO, SQUARE)
    assert counts(strip) == {"borders": 4}
    turned = check([[0, 1, 2], [0, 3, 2]], SQUARE)
    assert counts(turned) == {"borders": 4, "misoriented_edges": 1}
    assert turned.edges[turned.misoriented_edges].tolist() == [[0, 2]]
    fin = check([*TWO, [0, 2, 4]], [*SQUARE, [0.5, 0.5, 1.0]])
    assert counts(fin) == {"borders": 6, "nonmanifold_edges": 1}
    assert fin.edges[fin.nonmanifold_edges].tolist() == [[0, 2]]


def test_seams_are_no_borders():
    soup = BALL.vertices[BALL.faces].reshape(-1, 3)
    found = check(np.arange(len(soup)).reshape(-1, 3), soup)
    assert counts(found) == {"doubled_vertices": 240 - 42} and found.component.tolist() == [0] * 80


def test_nothing_to_check_and_vertices_without_faces():
    assert counts(check(np.zeros((0, 3), int), np.zeros((0, 3)))) == {}
    assert counts(check(TWO, [*SQUARE, [np.nan, 0, 0], [0, 0, 0]])) == {"borders": 4}
    with pytest.raises(ValueError, match=r"x\[1\].* finite"):
        check(TWO, np.where(SQUARE > 0.0, np.inf, SQUARE))
