"""The part of a surface around its contours: searched alone if that suffices, else the whole."""

import numpy as np
import pytest

import warp_bsc as bsc
from warp_bsc.repairing import free, part
from warp_bsc.repairing.part import Part
from warp_bsc.repairing.surface import Surface


def sheets(n, depth, width):
    """Returns the faces and positions of a sheet, and of one above it with a bump that has sunk through it."""
    u, v = np.meshgrid(np.linspace(0.0, 1.0, n), np.linspace(0.0, 1.0, n), indexing="ij")
    i = np.arange(n * n).reshape(n, n)
    a, b, c, d = (corners.ravel() for corners in (i[:-1, :-1], i[1:, :-1], i[1:, 1:], i[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    z = 0.3 / n - depth / n * np.exp(-((u - 0.42) ** 2 + (v - 0.56) ** 2) * (n / width) ** 2)
    flat, bump = np.stack([u, v, 0.0 * u], axis=2), np.stack([u + 0.13 / n, v + 0.27 / n, z], axis=2)
    return np.concatenate([faces, faces + n * n]), np.concatenate([flat, bump]).reshape(-1, 3)


@pytest.fixture
def searched(monkeypatch):
    """The numbers of vertices of parts that are searched, of surfaces of any size."""
    sizes, around = [], Part.around

    def counted(whole, crossings):
        found = around(whole, crossings)
        sizes.append(None if found is None else len(found.home))
        return found

    monkeypatch.setattr(part, "_LEAST_CELLS", 0)
    monkeypatch.setattr(Part, "around", staticmethod(counted))
    return sizes


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("far", [0.0, 700.0])
def test_shallow_contours_are_freed_in_their_part(searched, monkeypatch, dtype, far):
    faces, x = sheets(60, 0.7, 3.0)
    x = (x + far).astype(dtype)
    found = bsc.repair(faces, x, device="cpu")
    assert searched[0] < 0.5 * len(x)
    monkeypatch.setattr(part, "_LEAST_CELLS", 10**9)
    whole = bsc.repair(faces, x, device="cpu")
    assert searched[1:] == [None]
    assert found.certified and whole.certified and found.crossings_before > 20
    assert found.max_strain <= 0.1
    assert (found.moved**2).sum() <= 1.1 * (whole.moved**2).sum()
    still = found.moved == 0.0
    assert still.sum() > 0.9 * len(x) and found.x[still].tobytes() == x[still].tobytes()


def test_the_whole_is_searched_where_the_part_is_too_small(searched, monkeypatch):
    faces, x = sheets(40, 4.0, 4.0)
    monkeypatch.setattr(part, "_REACH", 1.0)
    found = bsc.repair(faces, x, device="cpu")
    monkeypatch.setattr(part, "_LEAST_CELLS", 10**9)
    whole = bsc.repair(faces, x, device="cpu")
    assert searched[0] < 0.3 * len(x)
    assert found.certified and found.x.tobytes() == whole.x.tobytes()


def test_the_whole_is_searched_where_the_part_is_strained(searched, monkeypatch):
    faces, x = sheets(60, 0.7, 3.0)
    monkeypatch.setattr(free, "_found", lambda surface, *_: surface.home)
    assert bsc.repair(faces, x, device="cpu").certified
    assert not bsc.repair(faces, x, max_strain=0.001, device="cpu").certified
    assert len(searched) == 2 and max(searched) < 0.5 * len(x)


def test_what_crosses_and_is_fixed_keeps_no_part_from_being_freed(searched, monkeypatch):
    faces, x = sheets(60, 0.7, 3.0)
    n = len(x)
    # a fixed pair of sheets of its own, which cross each other where the others are, and far away
    body, places = sheets(12, 0.7, 3.0)
    near, far = 0.2 * places + (0.3, 0.4, -0.2), 0.2 * places + (5.0, 5.0, 5.0)
    x, faces = np.concatenate([x, near, far]), np.concatenate([faces, body + n, body + n + len(places)])
    monkeypatch.setattr(free, "_found", lambda surface, *_: surface.home)
    found = bsc.repair(faces, x, fixed=np.arange(n, len(x)), device="cpu")
    assert searched[0] < 0.6 * n
    assert not found.certified and found.crossings < found.crossings_before
    fixed = bsc.CollisionMesh(faces[faces[:, 0] >= n], len(x), device="cpu")
    assert found.crossings == len(bsc.CollisionDetector(fixed).find_intersections(x)) > 0
    assert all(contour.reason == "both of its sides are fixed" for contour in found.unresolved)


def test_without_contours_there_is_no_part():
    faces, x = sheets(20, 0.7, 3.0)
    surface = Surface(bsc.CollisionMesh(faces, len(x), device="cpu"), x, np.zeros(len(x), dtype=bool))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(part, "_LEAST_CELLS", 0)
        assert Part.around(surface, np.zeros((0, 2), dtype=int)) is None


def test_a_large_face_across_the_part_is_no_gap_in_it():
    faces, x = sheets(60, 0.7, 3.0)
    # far corners, a little below the lower sheet
    corners = np.array([[-50.0, -50.0, -0.02], [80.0, -50.0, -0.02], [0.5, 90.0, -0.02]])
    x, faces = np.concatenate([x, corners]), np.concatenate([faces, [[len(x), len(x) + 1, len(x) + 2]]])
    surface = Surface(bsc.CollisionMesh(faces, len(x), device="cpu"), x, np.zeros(len(x), dtype=bool))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(part, "_LEAST_CELLS", 0)
        found = Part.around(surface, surface.crossings(surface.home))
    assert np.isin(len(x) - np.arange(1, 4), found.vertices).all()


def test_a_part_has_all_that_bears_on_its_contours(searched):
    faces, x = sheets(60, 0.7, 3.0)
    rope = np.array([[0.42, 0.56, 0.2], [0.42, 0.56, 0.1], [0.9, 0.9, 0.2]])
    x = np.concatenate([x, rope, [[0.4, 0.5, 0.1]]])
    strands, point = len(x) - 4 + np.array([[0, 1], [1, 2]]), len(x) - 1
    labels = np.random.default_rng(3).integers(1, 2**32, (2, len(x))) | 1
    world = np.zeros(len(x), dtype=int)
    mesh = bsc.CollisionMesh(
        faces, len(x), edges=strands, points=[point], world=world, group=labels[0], mask=labels[1], device="cpu"
    )
    fixed, groups = np.random.default_rng(4).random(len(x)) < 0.1, np.where(np.arange(len(x)) % 7 == 0, 5, -1)
    surface = Surface(mesh, x, fixed, rigid=np.where(fixed, -1, groups))
    crossings = surface.crossings(surface.home)
    found = Part.around(surface, crossings)
    own = found.crossings(found.home)
    ours = np.hstack([found.vertices[found.mesh.edges[own[:, 0]]], found.vertices[found.mesh.faces[own[:, 1]]]])
    theirs = np.hstack([mesh.edges[crossings[:, 0]], mesh.faces[crossings[:, 1]]])
    assert len(ours) and sorted(map(tuple, ours)) == sorted(map(tuple, theirs))
    assert len(found.mesh.free_edges) >= 1 and len(found.mesh.points) == 1
    for name in ("world", "group", "mask"):
        assert (getattr(found.mesh, name) == getattr(mesh, name)[found.vertices]).all()
    assert found.fixed[surface.fixed[found.vertices]].all()
    assert (found.in_whole(found.home) == surface.home).all() and found.is_apart(found.home)
    (outside,) = np.nonzero(~np.isin(np.arange(len(x)), found.vertices))
    (edges,) = np.nonzero(np.isin(mesh.edges, outside).sum(axis=1) == 1)
    is_shared = np.isin(found.vertices, mesh.edges[edges])
    assert is_shared.any() and found.fixed[is_shared].all()
    (beside,) = np.nonzero(is_shared[found.mesh.edges].sum(axis=1) == 1)
    for vertex in np.setdiff1d(found.mesh.edges[beside], np.flatnonzero(is_shared))[::9]:
        moved = found.home.copy()
        moved[vertex] += 0.01
        assert not found.is_apart(moved)

    def is_apart_after(vertex, by):
        moved = found.home.copy()
        moved[vertex, 2] += by
        return found.is_apart(moved)

    inner = [vertex for vertex in np.flatnonzero(~found.fixed)[::50] if is_apart_after(vertex, 1e-3)]
    assert inner and not any(is_apart_after(vertex, 100.0) for vertex in inner)  # where other cells may be
    moved = found.home.copy()
    moved[~found.fixed] += 0.01
    assert (surface.moved(found.in_whole(moved))[found.vertices] == found.moved(moved)).all()
