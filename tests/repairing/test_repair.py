"""Repairs of meshes that cross themselves: free in the end, near, and never worse."""

import itertools
import time
from dataclasses import replace

import contour_kinds
import draped
import numpy as np
import pytest
import trimesh
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import KDTree

import warp_bsc as bsc
from warp_bsc import checker
from warp_bsc.bench.scenes.repair import KINDS, KNOWN, TangledMesh, damaged
from warp_bsc.repairing.closest import closest_points, exit_distances
from warp_bsc.repairing.surface import Surface

NEAREST = 24
"""Triangles of a ball among which is the closest one to a point less than 9 mm from it, by their centres."""


def crossings(faces, x):
    mesh = bsc.CollisionMesh(faces, len(x), device="cpu")
    return len(bsc.CollisionDetector(mesh).find_intersections(x))


def grid_faces(n, m):
    """Returns the faces of a grid of n by m vertices."""
    i = np.arange(n * m).reshape(n, m)
    a, b, c, d = (corners.ravel() for corners in (i[:-1, :-1], i[1:, :-1], i[1:, 1:], i[:-1, 1:]))
    return np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


def bottle(n, m):
    """Returns positions and faces of a Klein bottle of n rings of m vertices."""
    u, v = np.stack(np.meshgrid(np.arange(n) * np.pi / n, np.arange(m) * 2.0 * np.pi / m, indexing="ij")).reshape(2, -1)
    r = 1.0 - np.cos(2.0 * u) / 2.0
    along = np.where(2.0 * u < np.pi, np.cos(2.0 * u) * np.cos(v), np.cos(v + np.pi))
    x = 6.0 * np.cos(2.0 * u) * (1.0 + np.sin(2.0 * u)) + 4.0 * r * along
    y = 16.0 * np.sin(2.0 * u) + np.where(2.0 * u < np.pi, 4.0 * r * np.sin(2.0 * u) * np.cos(v), 0.0)
    i = np.arange(n * m).reshape(n, m)
    a, b = i, np.concatenate([i[1:], i[:1, (m // 2 - np.arange(m)) % m]])
    c, d = np.roll(b, -1, axis=1), np.roll(a, -1, axis=1)
    faces = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)]).reshape(-1, 3)
    return np.stack([x, y, 4.0 * r * np.sin(v)], axis=1), faces


def repair(scene, x, **options):
    """Repairs, and checks what holds for every result."""
    result = bsc.repair(scene.faces, x, fixed=scene.fixed, device="cpu", **options)
    assert result.x.dtype == x.dtype
    assert result.crossings == crossings(scene.faces, result.x) <= result.crossings_before == crossings(scene.faces, x)
    assert result.crossings == sum(len(contour.elements) for contour in result.unresolved)
    still = result.moved == 0.0
    assert result.x[still].tobytes() == x[still].tobytes()
    assert still[scene.fixed].all()
    if result.certified:
        assert not ipctk_finds(scene.faces, result.x)
    return result


def ipctk_finds(faces, x):
    """Whether ipctk finds an intersection; False where it is not installed."""
    try:
        import ipctk  # noqa: PLC0415
    except ImportError:
        return False
    faces = np.asarray(faces, np.int32)
    mesh = ipctk.CollisionMesh(np.asarray(x, float), ipctk.edges(faces), faces)
    return ipctk.has_intersections(mesh, np.asarray(x, float))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("name", ["sheets", "folded"])
def test_known_tangles_come_free_with_little_strain(name, dtype):
    scene = KNOWN[name]()
    result = repair(scene, scene.x.astype(dtype))
    assert result.certified
    assert result.max_strain <= 0.1


def test_sheets_that_have_changed_places_are_put_into_the_nearer_order_which_is_told():
    scene = KNOWN["corner"](24)
    result = repair(scene, scene.x)
    assert result.certified and result.max_strain <= 0.1
    told, other = (repair(scene, scene.x, order=order) for order in (result.order, 1 - result.order))
    assert told.certified and other.certified and told.order is None
    assert (told.moved**2).sum() < 1.1 * (result.moved**2).sum() < 0.5 * (other.moved**2).sum()


def test_a_contour_from_border_to_border_is_named():
    scene = KNOWN["corner"](24)
    edges = bsc.CollisionMesh(scene.faces, len(scene.x), device="cpu")
    borders = edges.edges[np.bincount(edges.face_edges.ravel()) == 1]
    held = replace(scene, fixed=np.isin(np.arange(len(scene.x)), borders) | (scene.sheet == 0))
    result = repair(held, scene.x)
    assert not result.certified and not result.moved.any() and result.order is None
    assert [contour.kind for contour in result.unresolved] == ["border"]
    assert "order" in result.unresolved[0].reason


@pytest.mark.parametrize("kind", contour_kinds.KINDS)
def test_contours_of_each_kind_are_freed_without_a_hint_and_with_little_strain(kind):
    faces, x = contour_kinds.KINDS[kind](20)
    scene = TangledMesh(faces, x, None, np.zeros(len(x), dtype=bool), np.full(len(x), -1))
    result = repair(scene, x)
    assert result.certified and result.crossings_before > 10 and result.max_strain <= 0.1


@pytest.mark.slow
def test_crowded_folds_of_a_draped_cloth_are_strained_by_less_than_a_third():
    """Frame 26 of `draped.py`, of 2,401 vertices."""
    shot = draped.drape(48, 2, 0.15, 0.0002, wp.vec3(-0.4, -0.43, 0.2))
    faces, x = next(itertools.islice(shot, 27, None))
    result = bsc.repair(faces, x, device="cpu")
    assert result.certified and result.crossings_before > 1500 and result.max_strain <= 0.31


def test_a_sheet_that_is_folded_flat_opens_by_a_little():
    n = 10
    u, v = np.stack(np.meshgrid(np.linspace(0.0, 2.0, 2 * n + 1), np.linspace(0.0, 1.0, n + 1), indexing="ij")).reshape(
        2, -1
    )
    x = np.stack([np.where(u < 1.0, u, 2.0 - u), v, 0.0 * u], axis=1)
    result = bsc.repair(grid_faces(2 * n + 1, n + 1), x, device="cpu")
    assert result.certified and result.crossings_before > 1000
    assert result.max_strain < 0.01 and result.moved.max() < 0.01 / n


def test_what_cannot_be_free_is_named_and_not_wrecked():
    """A Klein bottle."""
    x, faces = bottle(24, 10)
    result = bsc.repair(faces, x, device="cpu")
    assert result.crossings_before >= result.crossings > 0 and not result.certified
    assert all("order or x_previous" in contour.reason for contour in result.unresolved)
    surface = Surface(bsc.CollisionMesh(faces, len(x), device="cpu"), x, np.zeros(len(x), dtype=bool))
    assert not surface.is_wrecked(surface.in_units(result.x)) and surface.is_wrecked(2.0 * surface.home)


@pytest.mark.parametrize("hint", ["order", "groups", "x_previous"])
def test_order_or_history_solves_it(hint):
    scene = KNOWN["corner"]()
    groups = [np.flatnonzero(scene.sheet == 0), scene.sheet == 1]
    option = {"order": scene.sheet} if hint == "order" else {"order": groups}
    result = repair(scene, scene.x, **({"x_previous": scene.free} if hint == "x_previous" else option))
    assert result.certified
    assert result.max_strain <= 0.1


@pytest.mark.parametrize("sheet", [0, 1])
def test_what_is_fixed_stays_where_history_has_it_elsewhere(sheet):
    scene = KNOWN["sheets"]()
    held = replace(scene, fixed=scene.sheet == sheet)
    moved = scene.free + np.array([0.0, 0.0, 0.05])
    assert repair(held, scene.x, x_previous=moved).certified


@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=2, deadline=None)
@given(seed=st.integers(0, 19), single=st.booleans())
def test_random_damage_is_never_worse(kind, seed, single):
    scene = damaged(kind, seed)
    repair(scene, scene.x.astype(np.float32 if single else np.float64))


@pytest.mark.parametrize("kind", KINDS)
def test_nothing_moves_where_nothing_crosses(kind):
    scene = damaged(kind, 0)
    result = repair(scene, scene.free, min_distance=1e-3)
    assert result.certified
    assert not result.moved.any()


def test_what_is_fixed_and_crosses_is_named():
    scene = KNOWN["folded"]()
    result = bsc.repair(scene.faces, scene.x, fixed=np.ones(len(scene.x), bool), device="cpu")
    assert result.crossings == result.crossings_before > 0
    assert {contour.reason for contour in result.unresolved} == {"both of its sides are fixed"}


def test_a_sheet_leaves_fixed_bodies_that_cross_each_other():
    ball = trimesh.creation.icosphere(3)
    bodies = trimesh.util.concatenate([ball.copy().apply_translation([x, 0.0, 0.0]) for x in (-0.6, 0.6)])
    u, v = np.stack(np.meshgrid(np.linspace(-1.9, 1.9, 31), np.linspace(-1.3, 1.3, 21), indexing="ij")).reshape(2, -1)
    heights = [np.sqrt(np.maximum(1.0 - (u - x) ** 2 - v**2, 0.09)) for x in (-0.6, 0.6)]
    dip = 0.08 * np.exp(-(u * u + v * v) / 0.12**2)
    x = np.concatenate([bodies.vertices, np.stack([u, v, np.max(heights, axis=0) + 0.03 - dip], axis=1)])
    faces = np.concatenate([bodies.faces, grid_faces(31, 21) + len(bodies.vertices)])
    result = bsc.repair(faces, x, fixed=np.arange(len(bodies.vertices)), device="cpu")
    assert result.crossings_before > result.crossings == crossings(bodies.faces, bodies.vertices) > 0
    assert {contour.reason for contour in result.unresolved} == {"both of its sides are fixed"}


@pytest.mark.parametrize("name", ["sheets", "folded"])
def test_what_may_stay_at_its_place_stays_there(name):
    scene = KNOWN[name]()
    result = repair(scene, scene.x)
    edges = np.linalg.norm(scene.x[scene.faces] - scene.x[np.roll(scene.faces, 1, axis=1)], axis=2)
    little = (result.moved > 0.0) & (result.moved < 0.02 * np.median(edges))
    home = np.where(little[:, None], scene.x, result.x)
    assert not little.any() or crossings(scene.faces, home)


def in_halves(scene, gap=0.0):
    """Returns faces and positions of a scene of one sheet in two halves, and both sides of the seam between them."""
    n = len(scene.x)
    is_first = scene.faces.min(axis=1) < int(0.84 * n)
    faces = scene.faces + n * ~is_first[:, None]
    seam = np.intersect1d(scene.faces[is_first], scene.faces[~is_first])
    return faces, np.vstack([scene.x, scene.x + gap]), (seam, seam + n)


def test_seams_stay_closed():
    faces, x, (seam, other) = in_halves(KNOWN["folded"]())
    result = bsc.repair(faces, x, device="cpu")
    assert result.certified
    assert result.moved[seam].any()
    assert (result.x[seam] == result.x[other]).all()
    assert result.doubled == len(seam)
    assert f"{len(seam)} vertices of seams count as one" in str(result)
    assert crossings(faces, result.x) > 0


def test_seams_within_a_tolerance_are_closed_and_without_one_part():
    faces, x, (seam, other) = in_halves(KNOWN["folded"](), gap=1e-9)
    opened = bsc.repair(faces, x, device="cpu")
    assert opened.doubled == 0 and not (opened.x[seam] == opened.x[other]).any()
    for fixed, first in (([], seam), (other[:3], other[:3])):
        result = bsc.repair(faces, x, fixed=fixed, seam_tolerance=1e-8, device="cpu")
        assert result.certified and (result.x[seam] == result.x[other]).all()
        assert not result.moved[fixed].any()
        still = result.moved == 0.0
        assert result.x[still].tobytes() == x[still].tobytes() and still[first].any()
    with pytest.raises(ValueError, match=r"seam_tolerance must not close vertices \d+ and \d+, which are fixed apart"):
        bsc.repair(faces, x, fixed=[seam[0], other[0]], seam_tolerance=1e-8, device="cpu")
    with pytest.raises(ValueError, match=r"seam_tolerance must be less than the edges of face \d+"):
        bsc.repair(faces, x, seam_tolerance=0.1, device="cpu")


def test_a_seam_between_two_sheets_of_an_order_stays_closed():
    """The border of a lining is sewn to that of the coat outside it, which has passed through it."""
    n = 16
    u, v = np.stack(np.meshgrid(*[np.linspace(0.0, 1.0, n)] * 2, indexing="ij")).reshape(2, -1)
    bulge = np.minimum(u, 0.4)
    lining = np.stack([u, v, 0.1 * bulge], axis=1)
    coat = np.stack([u, v, 0.1 * bulge + 0.5 * bulge * (0.3 - v)], axis=1)
    seam = np.flatnonzero(u == 0.0)
    faces, x = np.concatenate([grid_faces(n, n), grid_faces(n, n) + n * n]), np.concatenate([lining, coat])
    sheet = np.repeat([0, 1], n * n)
    result = bsc.repair(faces, x, order=sheet, device="cpu")
    assert result.crossings_before > 10 and result.certified and result.doubled == n
    assert (result.x[seam] == result.x[seam + n * n]).all()


@pytest.mark.parametrize(
    ("factor", "offset", "dtype"),
    [(1e4, 1e13, float), (1e100, 0.0, float), (1e-150, 0.0, float), (1.0, 1e3, np.float32), (1e30, 0.0, np.float32)],
)
def test_coordinates_of_any_size_are_repaired_as_well(factor, offset, dtype):
    """Far from the origin, and where squares of lengths overflow or underflow."""
    scene = KNOWN["folded"]()
    x = (scene.x * factor + offset).astype(dtype)
    begin = time.monotonic()
    result = bsc.repair(scene.faces, x, device="cpu")
    assert time.monotonic() - begin < 5.0
    assert result.certified and result.crossings_before > 50 and result.max_strain <= 0.1
    still = result.moved == 0.0
    assert result.x[still].tobytes() == x[still].tobytes() and still.sum() > 2000
    edges = bsc.CollisionMesh(scene.faces, len(x), device="cpu").edges
    moved = np.flatnonzero(~still)
    near = edges[np.isin(edges, moved).any(axis=1)]
    pairs = np.stack(np.meshgrid(np.arange(len(near)), np.arange(len(scene.faces)), indexing="ij"), -1).reshape(-1, 2)
    ends, corners = near[pairs[:, 0]], scene.faces[pairs[:, 1]]
    places = result.x.astype(float)
    boxes = [(places[of].min(axis=1), places[of].max(axis=1)) for of in (ends, corners)]
    overlap = ((boxes[0][0] <= boxes[1][1]) & (boxes[1][0] <= boxes[0][1])).all(axis=1)
    overlap &= (ends[:, :, None] != corners[:, None, :]).all(axis=(1, 2))
    assert not checker.edge_face_crossings(result.x[ends[overlap]], result.x[corners[overlap]]).any()


def test_no_mesh_of_no_faces_is_built(device, monkeypatch):
    """On a GPU, Warp 1.19 corrupts its memory by one: arrays that are made later would hold other values."""

    class Mesh(wp.Mesh):
        def __init__(self, points, indices, *arguments, **options):
            assert len(indices), "a mesh of no faces"
            super().__init__(points, indices, *arguments, **options)

    monkeypatch.setattr(wp, "Mesh", Mesh)
    scene = KNOWN["corner"]()
    everything = np.ones(len(scene.x), bool)
    for options in ({}, {"order": scene.sheet}):
        result = bsc.repair(scene.faces, scene.x, fixed=everything, device=device, **options)
        assert result.crossings == result.crossings_before > 0
    edges = [[0, 1], [2, 3]]
    mesh = bsc.CollisionMesh(np.zeros((0, 3), int), 4, edges=edges, device=device)
    x = np.array([(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.5, -0.5, 0.001), (0.5, 0.5, 0.001)])
    for options in ({}, {"min_distance": 0.01}, {"min_distance": 0.01, "order": edges}):
        result = bsc.repair(mesh, x, **options)
        assert result.near == 0 and result.near_before == len(options.keys() & {"min_distance"})
    surface = Surface(mesh, x, np.zeros(4, bool))
    with pytest.raises(ValueError, match="faces must not be empty"):
        closest_points(surface, surface.home, np.zeros(0, int), surface.home)
    with pytest.raises(ValueError, match="faces must not be empty"):
        exit_distances(surface, surface.home, np.zeros(0, int), surface.home, np.eye(3))
    arrays = [wp.full(1000, value, dtype=int, device=device) for value in range(100)]
    assert all((array.numpy() == value).all() for value, array in enumerate(arrays))


def panel(cells, place):
    """A square of 1 m, its corner at a place: faces and positions."""
    x = np.array([(i / cells, j / cells, 0.0) for j in range(cells + 1) for i in range(cells + 1)]) + place
    corners = [j * (cells + 1) + i for j in range(cells) for i in range(cells)]
    up = cells + 1
    faces = [[[a, a + 1, a + up + 1], [a, a + up + 1, a + up]] for a in corners]
    return np.concatenate(faces), x


@pytest.mark.parametrize(
    ("cells", "place", "at_borders", "elsewhere"),
    [
        (1, (0.0, 0.0, 0.0), 20, 0),  # a panel that is there twice
        (1, (1.0, 0.0, 0.0), 12, 0),  # a seam
        (1, (1.0, 1.0, 0.0), 12, 0),  # a corner
        (3, (0.0, 0.0, 0.0), 192, 212),
    ],
)
def test_what_touches_at_borders_in_one_place_does_not_count(cells, place, at_borders, elsewhere):
    """As the guarantees say; surfaces that touch elsewhere are not certified."""
    (faces, x), (others, y) = panel(cells, (0.0, 0.0, 0.0)), panel(cells, place)
    faces, x = np.concatenate([faces, others + len(x)]), np.concatenate([x, y])
    result = bsc.repair(faces, x, device="cpu")
    assert result.certified == (elsewhere == 0) and result.crossings == elsewhere
    edges = bsc.CollisionMesh(faces, len(x), device="cpu").edges
    ends, corners = np.repeat(edges, len(faces), axis=0), np.tile(faces, (len(edges), 1))
    apart = (ends[:, :, None] != corners[:, None, :]).all(axis=(1, 2))
    ends, corners = ends[apart], corners[apart]
    meet = checker.edge_face_crossings(result.x[ends], result.x[corners])
    places = np.unique(result.x, axis=0, return_inverse=True)[1].reshape(-1)
    places[((x[:, :2] != np.floor(x[:, :2])).all(axis=1))] = -1  # inside a panel
    ends, corners = places[ends[meet]], places[corners[meet]]
    share = ((ends[:, :, None] == corners[:, None, :]) & (ends[:, :, None] >= 0)).any(axis=(1, 2))
    assert (share.sum(), (~share).sum()) == (at_borders, elsewhere)


def test_warp_arrays_come_back_as_warp_arrays():
    scene = KNOWN["folded"]()
    result = bsc.repair(scene.faces, wp.array(scene.x, dtype=wp.vec3, device="cpu"), device="cpu")
    assert result.certified
    assert result.x.dtype == wp.vec3


def test_a_minimum_distance_is_kept():
    scene = KNOWN["folded"]()
    result = repair(scene, scene.x, min_distance=1e-3)
    assert not result.crossings


@pytest.mark.parametrize("dtype", [pytest.param(np.float32, marks=pytest.mark.slow), np.float64])
def test_layers_keep_their_own_distances(dtype):
    """Skin, a shirt that dips into it, and a jacket that dips into the shirt: 2 mm, 5 mm and 3 mm, in the end."""
    ball = trimesh.creation.icosphere(3)
    dent = np.exp(-20.0 * ((ball.vertices - [1.0, 0.0, 0.0]) ** 2).sum(axis=1))[:, None]
    layers = [scale * ball.vertices for scale in (0.1 + 0.0 * dent, 0.103 - 0.006 * dent, 0.109 - 0.008 * dent)]
    count = len(ball.vertices)
    x = np.concatenate(layers).astype(dtype)
    faces = np.concatenate([ball.faces + number * count for number in range(3)])
    mesh = bsc.CollisionMesh(faces, len(x), radius=np.repeat([0.0, 0.002, 0.003], count), device="cpu")
    result = bsc.repair(mesh, x, fixed=np.arange(count))
    assert result.certified and not result.near and result.near_before > result.crossings_before > 0
    assert not len(bsc.CollisionDetector(mesh, method="exact").detect(result.x, result.x))
    least = {}
    for inner, outer in ((0, 1), (1, 2), (0, 2)):
        for points, triangles in ((inner, outer), (outer, inner)):
            corners = result.x[ball.faces + triangles * count].astype(float)
            at = np.repeat(result.x[points * count : (points + 1) * count].astype(float), NEAREST, axis=0)
            near = KDTree(corners.mean(axis=1)).query(at[::NEAREST], NEAREST)[1].ravel()
            distance = np.linalg.norm(trimesh.triangles.closest_point(corners[near], at) - at, axis=1).min()
            least[inner, outer] = min(distance, least.get((inner, outer), np.inf))
    assert 0.002 < least[0, 1] < 0.0022 and 0.005 < least[1, 2] < 0.0052 and least[0, 2] > 0.003
    # without radii, or with one distance for all, they are other ones
    assert bsc.repair(faces, x, fixed=np.arange(count), device="cpu").near_before == 0
    both = bsc.repair(mesh, x, fixed=np.arange(count), min_distance=0.001)
    assert both.certified and not both.near and both.near_before > result.near_before


def test_a_previous_configuration_must_be_free():
    scene = KNOWN["folded"]()
    with pytest.raises(ValueError, match="x_previous"):
        repair(scene, scene.x, x_previous=scene.x)


def test_a_time_limit_ends_the_search_and_is_named():
    scene = KNOWN["corner"]()
    begin = time.monotonic()
    result = repair(scene, scene.x, time_limit=0.2)
    assert time.monotonic() - begin < 3.0
    assert not result.certified and {contour.reason for contour in result.unresolved} == {
        "the time limit ended the search for positions without it"
    }
