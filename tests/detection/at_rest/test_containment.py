"""What is wholly inside what: closed forms on a grid, where every ray is degenerate, and solid angles."""

import numpy as np
import pytest
import trimesh

import warp_bsc as bsc
from warp_bsc import checker
from warp_bsc.detection.at_rest import containment
from warp_bsc.detection.at_rest.containment import ContainmentFinder

BOX = trimesh.creation.box(bounds=[(0, 0, 0), (1, 1, 1)])


def find(solids, *, weld=False, dtype=np.float64, wanted=lambda pairs: np.ones(len(pairs), dtype=bool), worlds=None):
    """Pairs of an inner and an outer solid, each solid given by vertices and faces; and the result."""
    x = np.concatenate([vertices for vertices, _ in solids]).astype(dtype)
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in solids)])
    faces = np.concatenate([np.asarray(own) + start for (_, own), start in zip(solids, starts, strict=False)])
    bodies = np.repeat(np.arange(len(solids)), [len(own) for _, own in solids])
    if weld:
        x, kept = np.unique(x, axis=0, return_inverse=True)
        faces = kept.reshape(-1)[faces]
    mesh = bsc.CollisionMesh(faces, len(x), device="cpu")
    found = bsc.CollisionDetector(mesh).intersection_finder().find(x)
    inside = ContainmentFinder(mesh, bodies, worlds).find(x, found, wanted)
    assert (bodies[inside.faces] == inside.bodies[:, 1]).all()
    return [tuple(pair) for pair in inside.bodies.tolist()], inside, x


def box(low, high, order=slice(None)):
    return BOX.vertices * (np.array(high) - low) + low, BOX.faces[:, order]


@pytest.mark.parametrize(("weld", "dtype"), [(False, np.float32), (True, np.float64)])
def test_boxes_on_a_grid(weld, dtype):
    """A box is inside if it sticks out nowhere and some corner of it is on no side of the other."""
    random = np.random.default_rng(7)
    total = 0
    for _ in range(8):
        corners = np.sort(np.stack([random.permutation(7)[:2] for _ in range(3 * 14)]).reshape(14, 3, 2), axis=2)
        low, high = corners[..., 0], corners[..., 1]
        # rows of the inner box, columns of the outer one
        contained = (low[None] <= low[:, None]).all(axis=2) & (high[:, None] <= high[None]).all(axis=2)
        spans = ((low[:, None] == low[None]) & (high[:, None] == high[None])).any(axis=2)
        expected = [(i, j) for i, j in np.argwhere(contained & ~spans).tolist() if i != j]
        pairs, inside, x = find([box(a, b) for a, b in zip(low, high, strict=True)], weld=weld, dtype=dtype)
        assert pairs == expected
        for (_, j), vertex in zip(pairs, inside.vertices.tolist(), strict=True):
            assert (low[j] < x[vertex]).all() and (x[vertex] < high[j]).all()
        total += len(pairs)
    assert total > 15


def test_polylines_on_a_grid():
    """One is inside a box if no point of it is outside and some is on no side of the box; its edges touch at most."""
    random = np.random.default_rng(2)
    vertices, faces = box((0, 0, 0), (4, 4, 4))
    lines = random.integers(0, 5, (80, 3, 3)) + random.choice([-1, 0, 1], (80, 3, 3), p=[0.05, 0.9, 0.05])
    x = np.concatenate([vertices, lines.reshape(-1, 3)]).astype(np.float64)
    starts = len(vertices) + 3 * np.arange(len(lines))
    edges = (starts[:, None, None] + np.array([[0, 1], [1, 2]])).reshape(-1, 2)
    mesh = bsc.CollisionMesh(faces, len(x), edges=edges, device="cpu")
    bodies = np.concatenate([np.zeros(len(faces), dtype=int), 1 + np.arange(len(edges)) // 2])
    found = bsc.CollisionDetector(mesh).intersection_finder().find(x)
    inside = ContainmentFinder(mesh, bodies).find(x, found, lambda pairs: np.ones(len(pairs), dtype=bool))
    in_closed = ((lines >= 0) & (lines <= 4)).all(axis=(1, 2))
    in_open = ((lines > 0) & (lines < 4)).all(axis=2).any(axis=1)
    expected = 1 + np.flatnonzero(in_closed & in_open)
    assert 5 < len(expected) < in_closed.sum() < len(lines)
    assert inside.bodies.tolist() == [[body, 0] for body in expected.tolist()]
    assert ((x[inside.vertices] > 0) & (x[inside.vertices] < 4)).all()


def solid_angle(points, corners):
    """Times that a closed surface winds around points, in floating point."""
    a, b, c = (corners[None] - points[:, None, None]).transpose(2, 0, 1, 3)
    la, lb, lc = (np.linalg.norm(side, axis=2) for side in (a, b, c))
    volume = (a * np.cross(b, c)).sum(axis=2)
    size = la * lb * lc + (a * b).sum(axis=2) * lc + (b * c).sum(axis=2) * la + (c * a).sum(axis=2) * lb
    return (2.0 * np.arctan2(volume, size)).sum(axis=1) / (4.0 * np.pi)


@pytest.mark.parametrize("shape", [trimesh.creation.icosphere(2), trimesh.creation.torus(2.0, 0.7), BOX])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_rays_wind_as_solid_angles_do(shape, dtype):
    random = np.random.default_rng(3)
    points = random.uniform(shape.bounds[0] - 0.3, shape.bounds[1] + 0.3, (60, 3)).astype(dtype)
    corners = shape.vertices[shape.faces].astype(dtype)
    turned = np.concatenate([corners[:, ::-1], corners, corners])
    rows, faces = (numbers.ravel() for numbers in np.indices((len(points), len(turned))))
    signs = checker.rays_pass_faces(points[rows], turned[faces]).reshape(len(points), 3, -1)
    expected = np.rint(solid_angle(points.astype(float), corners.astype(float))).astype(int)
    assert {0, 1} == set(expected.tolist())
    assert (signs.astype(int).sum(axis=2) == expected[:, None] * [-1, 1, 1]).all()


def test_rays_through_edges_and_corners():
    octahedron = np.concatenate([2.0 * np.eye(3), -2.0 * np.eye(3)])
    faces = np.array([(0, 1, 2), (1, 3, 2), (3, 4, 2), (4, 0, 2), (1, 0, 5), (3, 1, 5), (4, 3, 5), (0, 4, 5)])
    points = np.stack(np.meshgrid(*[np.arange(-3.0, 4.0)] * 3), axis=-1).reshape(-1, 3)
    for scale in (1.0, 1e-200, 1e200):  # products of the last two are out of range
        at, which = (numbers.ravel() for numbers in np.indices((len(points), len(faces))))
        signs = checker.rays_pass_faces(points[at] * scale, octahedron[faces[which]] * scale)
        turns = signs.reshape(len(points), -1).astype(int).sum(axis=1)
        distance = np.abs(points).sum(axis=1)
        assert (turns[distance < 2] == 1).all() and (turns[distance > 2] == 0).all()


def test_bodies_in_one_place_take_the_square_of_their_number(monkeypatch):
    """As many as there are pairs of bodies, whose vertices are all on each other; a smaller one is in all of them."""
    enclosing, numbers = containment.enclosing_boxes, []
    for count in (4, 8):
        compared = []
        monkeypatch.setattr(
            containment, "enclosing_boxes", lambda *args, to=compared: to.append(enclosing(*args)) or to[-1]
        )
        solids = [box((0, 0, 0), (3, 3, 3))] * count + [box((1, 1, 1), (2, 2, 2))]
        assert find(solids)[0] == [(count, body) for body in range(count)]
        numbers.append(sum(map(len, compared)))
    assert numbers[1] < 4.5 * numbers[0]


def test_worlds_in_one_place_take_as_long_as_one_after_the_other(monkeypatch):
    """Each has a cube and a point in it; what is compared grows with the worlds, not with their square."""
    expand, compared = containment.expand_in_chunks, []

    def expand_and_count(first, last):
        compared.append(int((last - first).sum()))
        return expand(first, last)

    monkeypatch.setattr(containment, "expand_in_chunks", expand_and_count)
    numbers = []
    for count in (4, 16):
        compared.clear()
        x, faces = box((0, 0, 0), (3, 3, 3))
        bodies, x = np.repeat(np.arange(count), len(faces)), np.tile(x, (count, 1))
        faces = np.tile(faces, (count, 1)) + 8 * bodies[:, None]
        worlds, points = np.arange(count)[::-1], np.full((count, 3), (1.0, 1.25, 1.5))
        finder = ContainmentFinder(bsc.CollisionMesh(faces, len(x), device="cpu"), bodies, worlds)
        found = finder.find_points(x, points, np.arange(count), lambda pairs: np.ones(len(pairs), dtype=bool))
        assert found.tolist() == [[point, count - 1 - point] for point in range(count)]
        numbers.append(sum(compared))
    assert numbers[1] == 4 * numbers[0]
    nested = [box((0, 0, 0), (3, 3, 3)), box((1, 1, 1), (2, 2, 2))]
    assert find(nested, worlds=np.array([7, 7]))[0] == [(1, 0)] and find(nested, worlds=np.array([7, 8]))[0] == []


def test_open_and_hollow_and_disoriented_bodies():
    inner = box((2, 2, 2), (3, 3, 3))
    vertices, faces = box((0, 0, 0), (5, 5, 5))
    assert find([(vertices, faces), inner])[0] == [(1, 0)]
    assert find([(vertices, faces[1:]), inner])[0] == []
    assert find([inner, (vertices, faces[:, ::-1])])[0] == [(0, 1)]
    disoriented = faces.copy()
    disoriented[::2] = disoriented[::2, ::-1]
    assert find([(vertices, disoriented), inner])[0] == [(1, 0)]
    # the inner surface of a hollow body is turned inwards, or makes it two bodies in one place
    for order, expected in ((slice(None, None, -1), []), (slice(None), [(1, 0)])):
        cavity, sides = box((1, 1, 1), (4, 4, 4), order)
        hollow = np.concatenate([vertices, cavity]), np.concatenate([faces, sides + len(vertices)])
        assert find([hollow, inner])[0] == expected
    wall, sides = box((0.25, 0.25, 0.25), (0.75, 4.75, 4.75))
    assert find([hollow, (wall, sides)])[0] == [(1, 0)]


def test_parts_of_one_body():
    outer = box((0, 0, 0), (4, 4, 4))
    one, sides = box((1, 1, 1), (2, 2, 2))
    for other, expected in (((9, 9, 9), [(1, 0)]), ((2, 2, 2.5), [(1, 0)] * 2), ((3.5, 2, 2), [(1, 0)])):
        two, _ = box(other, np.add(other, 1))
        parts = np.concatenate([one, two]), np.concatenate([sides, sides + len(one)])
        assert find([outer, parts])[0] == expected  # of the last, one part passes through the outer box
    assert find([parts])[0] == []


def test_an_edge_that_leaves_through_a_corner():
    """An angle's inner corner is a vertex of it: an edge only touches it there, and has its ends on different sides."""
    around = np.array([(0, 0), (4, 0), (4, 2), (2, 2), (2, 4), (0, 4)], float)
    vertices = np.concatenate([np.c_[around, np.full(6, z)] for z in (0.0, 1.0, 2.0)])
    caps = np.array([(3, 4, 5), (3, 5, 0), (3, 0, 1), (3, 1, 2)])
    low = np.concatenate([[(i, (i + 1) % 6, (i + 1) % 6 + 6), (i, (i + 1) % 6 + 6, i + 6)] for i in range(6)])
    angle = vertices, np.concatenate([caps[:, ::-1], low, low + 6, caps + 12])
    for ends, expected in (((1, 3), []), ((0.5, 1.5), [(1, 0)]), ((1, 2), [(1, 0)]), ((2, 3), [])):
        wire = np.array([(end, end, 1.0) for end in (*ends, np.mean(ends))])
        assert find([angle, (wire, np.array([(0, 1, 2)]))])[0] == expected, ends


def test_only_wanted_pairs_are_looked_for():
    nested = [box((n, n, n), (9 - n, 9 - n, 9 - n)) for n in range(3)]
    assert find(nested)[0] == [(1, 0), (2, 0), (2, 1)]
    assert find(nested, wanted=lambda pairs: pairs[:, 1] == 1)[0] == [(2, 1)]


def test_many_bodies(monkeypatch):
    """Boxes in two sizes, each small one in a large one, and one around all."""
    monkeypatch.setattr("warp_bsc._sorted_keys._CHUNK", 100)
    places = np.stack(np.meshgrid(*[np.arange(6.0)] * 3), axis=-1).reshape(-1, 3) * 2.0
    solids = [box(place, place + 1) for place in places]
    solids += [box(place + 0.25, place + 0.75) for place in places] + [box((-1, -1, -1), (12, 12, 12))]
    n = len(places)
    pairs, _, _ = find(solids)
    assert set(pairs) == {(n + i, i) for i in range(n)} | {(i, 2 * n) for i in range(2 * n)}


def test_balls():
    """Polyhedra of 80 faces in balls: inside another ball's if that one's inscribed ball contains the ball."""
    random, ball = np.random.default_rng(5), trimesh.creation.icosphere(1)
    inscribed = np.linalg.norm(ball.triangles_center, axis=1).min()
    center, radius = random.uniform(-1, 1, (60, 3)), random.choice([0.02, 0.1, 0.5, 1.0], 60)
    turned = [trimesh.transformations.random_rotation_matrix(random.random(3))[:3, :3] for _ in center]
    solids = [(r * ball.vertices @ turn + c, ball.faces) for c, r, turn in zip(center, radius, turned, strict=True)]
    distance = np.linalg.norm(center[:, None] - center[None], axis=2)
    surely = distance + radius[:, None] < inscribed * radius[None]
    maybe = distance + inscribed * radius[:, None] < radius[None]
    pairs = set(find(solids, dtype=np.float32)[0])
    assert set(map(tuple, np.argwhere(surely).tolist())) <= pairs <= set(map(tuple, np.argwhere(maybe).tolist()))
    assert 20 < surely.sum() < maybe.sum()
