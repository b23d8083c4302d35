"""The choice of the triangles that the page shows."""

import numpy as np
import pytest
from pxr import Usd, UsdGeom, Vt

from warp_bsc.scene_replay.page_view import choose_faces, find_outline
from warp_bsc.usd.scene import Scene


def test_faces_around_places_are_chosen():
    rng = np.random.default_rng(1)
    corners = rng.uniform(0, 1, (20_000, 3))
    places = np.array([(0.1, 0.1, 0.1), (0.9, 0.2, 0.5)])
    wanted = np.array([5, 17, 19_000])
    chosen = choose_faces(corners, places, wanted, 2_000)
    assert np.array_equal(chosen, np.unique(chosen)) and set(wanted) <= set(chosen.tolist())
    assert 100 < len(chosen) <= 2_000
    distance = np.abs(corners[:, None] - places).max(axis=2).min(axis=1)
    near, far = distance[np.setdiff1d(chosen, wanted)].max(), np.delete(distance, chosen).min()
    assert near < 3 * far  # cells, not spheres
    assert len(choose_faces(corners, places, wanted, 20_000)) == 20_000


def test_faces_around_the_most_crowded_place_are_chosen_if_not_all_fit():
    rng = np.random.default_rng(2)
    corners = rng.uniform(0, 1, (20_000, 3))
    crowd = np.array([0.7, 0.3, 0.6]) + rng.uniform(-1e-3, 1e-3, (30, 3))
    chosen = choose_faces(corners, np.concatenate([corners, crowd]), np.arange(0, 20_000, 2), 300)
    assert len(chosen) == 300 and np.array_equal(chosen, np.unique(chosen))
    distance = np.abs(corners - crowd[0]).max(axis=1)
    assert distance[chosen].max() < np.delete(distance, chosen).min() + 2 / 128
    assert distance[chosen].max() < 0.2  # in one piece


def waving(sides, distance):
    """A segment of two grids above each other, and their positions; the second one is beside the first."""
    stage = Usd.Stage.CreateInMemory()
    for number in range(2):
        x, y = np.meshgrid(np.arange(sides), np.arange(sides), indexing="ij")
        points = np.stack([x, y + number * distance, 0.5 * np.sin(0.3 * x) * np.cos(0.2 * y)], axis=2)
        corner = (np.arange(sides - 1)[:, None] * sides + np.arange(sides - 1)).reshape(-1, 1)
        mesh = UsdGeom.Mesh.Define(stage, f"/Sheet{number}")
        mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points.reshape(-1, 3).astype(np.float32)))
        mesh.CreateFaceVertexCountsAttr([4] * len(corner))
        mesh.CreateFaceVertexIndicesAttr((corner + np.array([0, sides, sides + 1, 1])).reshape(-1).tolist())
    interval = Scene(stage).interval(0)
    return interval.segment, interval.x0


def test_outline_is_a_coarse_copy_of_each_mesh():
    segment, x = waving(60, 59.5)
    assert len(segment.faces) == 2 * 2 * 59**2
    outline = find_outline(segment, x, 1_000)
    assert 400 < len(outline.faces) <= 1_000
    own, corners = segment.vertex_meshes[outline.vertices], x[outline.vertices[outline.faces]].astype(float)
    assert (own[outline.faces] == own[outline.faces][:, :1]).all()  # no face joins the two, although they are near
    length = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    assert length.max() < 12.0  # cells are about 4 wide
    # Seen from above, the faces cover almost all of the sheets, about once.
    a, b, c = corners[:, :, :2].transpose(1, 0, 2)
    area = 0.5 * np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    assert [area[own[outline.faces[:, 0]] == mesh].sum() for mesh in (0, 1)] == pytest.approx([59**2] * 2, rel=0.12)
    assert len(find_outline(segment, x, 100_000).faces) == len(segment.faces)
